"""Measured figures of README and docs: `python -m docs.figures` measures them, writes figures.yaml and the pages.

A page marks a place that quotes a figure with a comment behind the number, ``0.195<!-- 004.table1.P -->``, which no
reader of the page sees. A number in the form ``0.149 ± 0.001`` is quoted with its sigma. ``:1`` behind the name asks
for another number of decimals than the figure's own, ``:-1`` for tens.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from docs.figures.sources import ROOT, Figure, measure, read_figures, write_figures

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
_PLACE = re.compile(r"(?P<text>−?\d+(?:\.\d+)?(?: ± \d+(?:\.\d+)?)?)<!-- (?P<name>[\w.]+)(?::(?P<digits>-?\d))? -->")
_MARK = re.compile(r"<!-- [\w.]+(?::-?\d)? -->")


@app.command()
def main(
    only: Annotated[str, typer.Option(help="Beginning of the names of the figures to measure; all if not given.")] = "",
    fill_only: Annotated[
        bool, typer.Option("--fill", help="Measure nothing; put the file's numbers into the pages.")
    ] = False,
) -> None:
    """Measure the figures that pages quote, write docs/figures/figures.yaml, and insert them into the pages.

    Figures of the papers' checks are read from docs/validation, which a full run of twin.validate writes; the others
    are measured here, which takes half an hour because of the studies among them.

    Example: python -m docs.figures --only launch
    """
    if not fill_only:
        write_figures(measure(read_figures(), only))
    for page in fill(read_figures()):
        sys.stdout.write(f"{page}\n")


def pages() -> list[Path]:
    """Return README and all Markdown pages of docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def places(text: str, figures: Mapping[str, Figure]) -> Iterator[tuple[str, str, str]]:
    """Yield name of the figure, present text and correct text of each marked number of a page.

    Raises
    ------
    ValueError
        A mark has no number before it, or names no figure.
    """
    marks = list(_PLACE.finditer(text))
    if len(marks) != len(_MARK.findall(text)):
        loose = sorted({*_MARK.findall(text)} - {place[0][len(place["text"]) :] for place in marks})
        raise ValueError(f"these marks have no number before them: {loose}")
    for place in marks:
        yield place["name"], place["text"], _quoted(place, figures)


def filled(text: str, figures: Mapping[str, Figure]) -> str:
    """Return a page with its figures updated. Exceptions are those of `places`."""
    list(places(text, figures))
    return _PLACE.sub(lambda place: _quoted(place, figures) + place[0][len(place["text"]) :], text)


def fill(figures: Mapping[str, Figure]) -> list[Path]:
    """Write the figures into all pages; return those that changed."""
    changed = []
    for page in pages():
        text = page.read_text("utf-8")
        new = filled(text, figures)
        if new != text:
            page.write_text(new, "utf-8")
            changed.append(page)
    return changed


def _quoted(place: re.Match[str], figures: Mapping[str, Figure]) -> str:
    """Return the text of a figure for a marked number."""
    if place["name"] not in figures:
        raise ValueError(f"no such figure: {place['name']}")
    figure = figures[place["name"]]
    digits = figure.digits if place["digits"] is None else int(place["digits"])
    text = _decimal(figure.value, digits)
    if "±" in place["text"]:
        if figure.sigma is None:
            raise ValueError(f"{place['name']} has no sigma")
        text += f" ± {_decimal(figure.sigma, digits)}"
    return text


def _decimal(value: float, digits: int) -> str:
    """Return a rounded number as text."""
    return f"{round(value, digits):.{max(digits, 0)}f}".replace("-", "−")


if __name__ == "__main__":
    app()
