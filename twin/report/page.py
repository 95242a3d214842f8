"""Templates of the reports, and artefacts as the templates want them."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from twin.artefact import Artefact, Cell, Data, PngFigure, SvgFigure, Table
from twin.report.numbers import plain, significant

SHARED = "twin.report"
"""Package of the style sheet and of the macros."""


def environment(package: str) -> Environment:
    """Environment that finds the templates of ``package`` and the shared ones."""
    loader = FileSystemLoader([str(files(package)), str(files(SHARED))])
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def artefact_content(artefact: Artefact, file: str | None) -> dict[str, Any]:
    """An artefact, and the file that holds it, for the macro ``show``."""
    out: dict[str, Any] = {
        "title": artefact.title,
        "caption": artefact.caption,
        "file": file,
        "svg": None,
        "image": None,
        "table": None,
    }
    if isinstance(artefact, SvgFigure):
        # drawn by this program, not by a user
        out["svg"] = Markup(artefact.svg)
    elif isinstance(artefact, PngFigure):
        out["image"] = artefact.address
    elif isinstance(artefact, Table):
        rows = [[cell_text(value) for value in row] for row in artefact.shown()]
        texts = [all(isinstance(row[k], str) for row in artefact.rows) for k in range(len(artefact.heads))]
        out["table"] = {"heads": artefact.heads, "rows": rows, "texts": texts}
    elif not isinstance(artefact, Data):
        raise TypeError(f"the report cannot show {type(artefact).__name__}")
    return out


def cell_text(value: Cell) -> str:
    """A cell of a table, with at most six digits."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return plain(value) if isinstance(value, int) else significant(value, 6, floor=0.0)
