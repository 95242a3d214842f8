"""Lines of numbers in text files of other people's formats, with errors that name file and line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from scenes.yaml.csv_table import LARGEST_NUMBER, table_text
from scenes.yaml.errors import InputError, Issue, Problem, shown
from twin.orbit.measured.clock import Readings


def text_lines(path: str | Path, what: str) -> list[str]:
    """Lines of a file without their ends; raises as `scenes.yaml.csv_table.table_text`."""
    text = table_text(path, what)
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise InputError(Issue("not text: a zero byte", str(path), line, allowed=what))
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def first_lines(path: str | Path, what: str, count: int = 20) -> Iterator[str]:
    """The first lines that are not empty, to tell a format by."""
    filled = (line for line in text_lines(path, what) if line.strip())
    yield from (line for _, line in zip(range(count), filled, strict=False))


def numbers(file: str, cells: Sequence[Sequence[str]], lines: Sequence[int], heads: Sequence[str]) -> np.ndarray:
    """(N, K) floats of N rows of K texts.

    Args:
        file: for messages.
        cells: the rows.
        lines: (N,) of the rows in the file.
        heads: (K,) what the columns are, for messages.

    Raises:
        InputError: a row with another number of texts, one that is no number, not finite, or beyond LARGEST_NUMBER.
    """
    width = len(heads)
    uneven = next((k for k, row in enumerate(cells) if len(row) != width), None)
    if uneven is not None:
        found = f"{len(cells[uneven])} numbers"
        raise InputError(Issue("a row of another length", file, lines[uneven], found=found, allowed=", ".join(heads)))
    try:
        values = np.array([list(map(float, row)) for row in cells], dtype=np.float64).reshape(len(cells), width)
    except ValueError:
        values = np.full((len(cells), width), np.nan)
        for k, row in enumerate(cells):
            for j, text in enumerate(row):
                if not _is_number(text):
                    raise InputError(
                        Issue("not a number", file, lines[k], (heads[j],), shown(text), "a number")
                    ) from None
    bad = ~np.isfinite(values)
    if np.any(bad):
        k, j = (int(v) for v in np.argwhere(bad)[0])
        raise InputError(Issue("not a finite number", file, lines[k], (heads[j],), shown(cells[k][j]), "a number"))
    huge = np.abs(values) > LARGEST_NUMBER
    if np.any(huge):
        k, j = (int(v) for v in np.argwhere(huge)[0])
        raise InputError(Issue("larger than any quantity", file, lines[k], (heads[j],), shown(cells[k][j]), "a number"))
    return values


def readings(file: str, texts: Sequence[str], lines: Sequence[int]) -> Readings:
    """Clock readings of N calendar texts on these lines; InputError for one that is none."""
    try:
        return Readings.of_texts(texts)
    except Problem as problem:
        (row,) = problem.within
        raise InputError(
            Issue(problem.problem, file, lines[int(row)], ("time",), problem.found, problem.allowed)
        ) from None


def require_rising(file: str, clock: Readings, lines: Sequence[int]) -> None:
    """InputError unless each of the readings (N,) on these lines is later than the one before it."""
    back = (np.diff(clock.day) * 86400.0 + np.diff(clock.second)) <= 0.0
    if np.any(back):
        row = int(np.argmax(back)) + 1
        problem = "a time that is not later than the one before it"
        raise InputError(Issue(problem, file, lines[row], allowed="times in rising order, each once"))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text
