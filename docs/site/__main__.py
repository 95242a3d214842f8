"""Build the documentation: `python -m docs.site --out DIR`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from docs.site.build import BuildError, build

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="Folder for the site; a former site there is replaced.")] = Path(
        "build/site"
    ),
    notebooks: Annotated[bool, typer.Option(help="Whether to run the notebooks (minutes).")] = True,
) -> None:
    """Build the documentation as web pages that need no network: guides, notebooks, and the reference, made from the
    program. Sphinx's warnings are errors, every link is followed. Needs the extra `docs`.
    """
    try:
        count = build(out, notebooks)
    except BuildError as error:
        sys.stderr.write(f"{error}\n")
        raise typer.Exit(1) from None
    sys.stdout.write(f"{count} pages: {out / 'index.html'}\n")


if __name__ == "__main__":
    app()
