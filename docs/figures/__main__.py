"""Measured figures of README and docs: `python -m docs.figures` measures them, writes figures.yaml and the pages."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from docs.figures.pages import fill
from docs.figures.sources import measure, read_figures, write_figures

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command()
def main(
    only: Annotated[str, typer.Option(help="Beginning of the names of the figures to measure; all if not given.")] = "",
    fill_only: Annotated[
        bool, typer.Option("--fill", help="Measure nothing; put the file's numbers into the pages.")
    ] = False,
) -> None:
    """Measure the figures that pages quote, write docs/figures/figures.yaml, and put them into the pages.

    Those of the papers' checks are read from docs/validation, which a full run of twin.validate makes; the others are
    measured here; the studies among them take half an hour.

    Example: python -m docs.figures --only launch
    """
    if not fill_only:
        write_figures(measure(read_figures(), only))
    for page in fill(read_figures()):
        sys.stdout.write(f"{page}\n")


if __name__ == "__main__":
    app()
