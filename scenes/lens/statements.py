"""Foreign prescription files as numbered statements: encodings, words, numbers, and what is said of a wrong one."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scenes.lens.prescription import Note
from scenes.yaml.errors import InputError, Issue, shown
from scenes.yaml.input_file import read_bytes

LARGEST_FILE = 16 << 20
"""Bytes; prescriptions have some ten thousand."""
LONGEST_LINE = 100_000
LARGEST_NUMBER = 1e20
"""Objects at infinity are written as 1e10 to 1e18 millimetres; more is no length."""
MOST_SURFACES = 2000

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
_MARKS = ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"\xef\xbb\xbf", "utf-8-sig"))


@dataclass(frozen=True)
class Statement:
    """A command of a file with its words.

    Attributes:
        line: on which it begins, counted from 1.
        command: in capitals.
        words: after it.
        text: the whole of it, as it stands there.
    """

    line: int
    command: str
    words: tuple[str, ...]
    text: str


@dataclass
class Source:
    """A file while it is read.

    Attributes:
        file: path as the user gave it.
        notes: what was not understood so far.
    """

    file: str
    notes: list[Note] = field(default_factory=list)

    def error(
        self,
        problem: str,
        line: int | None = None,
        found: object = None,
        allowed: str | None = None,
        suggestion: str | None = None,
    ) -> InputError:
        """What is wrong at a line."""
        text = None if found is None else shown(found)
        return InputError(Issue(problem, self.file, line, (), text, allowed, suggestion))

    def note(self, statement: Statement, text: str) -> None:
        """Remember what became of a statement."""
        whole = statement.text if len(statement.text) <= 60 else statement.text[:57] + "..."
        self.notes.append(Note(statement.line, whole, text))

    def number(self, statement: Statement, place: int, what: str, default: float | None = None) -> float:
        """The number in one of the statement's words.

        Raises:
            InputError: there is none and no default, or it is none, or too large for anything.
        """
        if place >= len(statement.words):
            if default is not None:
                return default
            raise self.error(f"{statement.command} lacks {what}", statement.line, statement.text, "a number")
        return self.value(statement, statement.words[place], what)

    def value(self, statement: Statement, word: str, what: str) -> float:
        """The number that a word of a statement is. Raises InputError as ``number``."""
        if word.upper() in ("INFINITY", "INF"):
            return math.inf
        if not _NUMBER.fullmatch(word):
            raise self.error(f"{what} of {statement.command} is not a number", statement.line, word, "a number")
        value = float(word.upper().replace("D", "E"))
        if not abs(value) <= LARGEST_NUMBER:
            raise self.error(f"{what} of {statement.command} is too large", statement.line, word)
        return value

    def finite(self, statement: Statement, place: int, what: str, default: float | None = None) -> float:
        """As ``number``, refusing infinity."""
        value = self.number(statement, place, what, default)
        if not math.isfinite(value):
            raise self.error(f"{what} of {statement.command} is infinite", statement.line, statement.text)
        return value

    def whole(
        self, statement: Statement, place: int, what: str, least: int, most: int, default: int | None = None
    ) -> int:
        """A whole number between limits. Raises InputError as ``number``."""
        value = self.finite(statement, place, what, default)
        if value != int(value) or not least <= value <= most:
            raise self.error(
                f"{what} of {statement.command}", statement.line, value, f"whole numbers {least} to {most}"
            )
        return int(value)


def is_number(word: str) -> bool:
    """Whether a word is a number."""
    return _NUMBER.fullmatch(word) is not None


def read_lines(source: Source, what: str = "a prescription", most: int = LARGEST_FILE) -> list[str]:
    """The lines of a source's file: UTF-16 of either order, with or without a mark, UTF-8, or one byte a character.

    Args:
        source: to read from.
        what: its file should be, for messages.
        most: bytes that it may have.

    Raises:
        InputError: the file cannot be read, is too large or empty, or holds bytes that no text of its encoding has,
            with their line.
    """
    content = read_bytes(source.file, what, most, (Path(source.file).suffix,))
    if not content.strip(b"\0 \t\r\n"):
        raise source.error("an empty file", 1, allowed=what)
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "")
    if not encoding:
        head = content[:400]
        even, odd = head[0::2].count(0), head[1::2].count(0)
        if max(even, odd) > len(head) // 4:
            encoding = "utf-16-be" if even > odd else "utf-16-le"
    try:
        text = content.decode(encoding or "utf-8")
    except UnicodeDecodeError as error:
        if not encoding:
            text = content.decode("iso-8859-1")
            source.notes.append(Note(0, "", "not UTF-8: read as ISO 8859-1, one byte a character"))
        else:
            # by places of two bytes: one byte alone may be a newline's half
            before = content[: error.start].decode(encoding, "replace")
            problem = f"not {encoding.upper()} text: {error.reason}"
            raise source.error(problem, before.count("\n") + 1) from None
    lines = re.split(r"\r\n|\r|\n", text)
    for k, line in enumerate(lines, start=1):
        odd_one = next((c for c in line if (c < " " and c not in "\t\f\x1a") or c in "\x7f\ufffe\ufffd"), None)
        if odd_one is not None:
            raise source.error("a character that text does not have", k, odd_one, "text in UTF-16, UTF-8 or ISO 8859-1")
        if len(line) > LONGEST_LINE:
            raise source.error("a line too long for a prescription", k, allowed=f"at most {LONGEST_LINE} characters")
    return lines


def split_words(text: str) -> tuple[str, ...]:
    """Words of a statement; what stands in quotes is one word, with its quotes."""
    return tuple(re.findall(r"\"[^\"]*\"|'[^']*'|[^\s\"']+|[\"']", text))


def joined(words: Sequence[str]) -> str:
    """Words as a text, without quotes around it."""
    return " ".join(words).strip().strip("\"'").strip()
