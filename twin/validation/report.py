"""``report.html`` of a validation: one self-contained page with every check, printed beside measured."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from twin.artefact import Artefact, Data, PngFigure, SvgFigure, Table
from twin.report.numbers import decimals_for, fixed, plain, significant
from twin.validation.check import AGREES, DIFFERS, DOUBTFUL, FAILED, PAPERS, SIGMAS, VERDICTS, CheckResult, Verdict
from twin.validation.runner import GroupRun, Validation
from twin.versions import versions

TEMPLATE = "validation.html.j2"
MARKS: dict[Verdict, tuple[str, str]] = {
    AGREES: ("=", "agrees"),
    DIFFERS: ("≠", "differs"),
    DOUBTFUL: ("?", "doubtful"),
    FAILED: ("✕", "failed"),
}
"""Verdict -> mark, so that no meaning hangs on a colour, and class in the page."""


def render_report(validation: Validation) -> str:
    """The page as text."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files(__package__).joinpath(TEMPLATE).read_text(encoding="utf-8"))
    results = validation.results
    papers = [
        {"number": number, "title": title, "rows": [_row(r) for r in results if r.paper == number]}
        for number, title in PAPERS.items()
    ]
    groups = [_group(run) for run in validation.runs if run.artefacts or run.files]
    return template.render(
        papers=[paper for paper in papers if paper["rows"]],
        groups=groups,
        counts=[
            {"verdict": v, "mark": MARKS[v][0], "kind": MARKS[v][1], "count": validation.counts[v], "meaning": meaning}
            for v, meaning in VERDICTS.items()
        ],
        total=len(results),
        sigmas=f"{SIGMAS:g}",
        command=command(validation),
        backend=validation.backend,
        seconds=f"{validation.seconds:.1f}",
        seed=validation.seed,
        versions=versions(),
    )


def command(validation: Validation) -> str:
    """What repeats this validation."""
    only = "" if validation.only is None else f" --only {validation.only.replace(' ', '')}"
    return f"python -m twin.validate{only} --seed {validation.seed} --backend {validation.backend} --out again"


def measured_text(result: CheckResult) -> str:
    """The measured value with the digits that its sigma leaves."""
    if result.measured is None:
        return "\N{EM DASH}"
    if result.sigma:
        return fixed(result.measured, decimals_for(result.sigma))
    return significant(result.measured, 6, floor=0.0)


def sigma_text(result: CheckResult) -> str:
    """Two digits of sigma, nothing without noise."""
    return fixed(result.sigma, decimals_for(result.sigma)) if result.sigma else ""


def printed_text(result: CheckResult) -> str:
    """What the paper prints."""
    return "\N{EM DASH}" if result.printed is None else plain(result.printed)


def _row(result: CheckResult) -> dict[str, Any]:
    mark, kind = MARKS[result.verdict]
    return {
        "id": result.id,
        "equation": result.equation,
        "statement": result.statement,
        "printed": printed_text(result),
        "measured": measured_text(result),
        "sigma": sigma_text(result),
        "unit": "" if result.unit == "1" else result.unit,
        "verdict": result.verdict,
        "mark": mark,
        "kind": kind,
        "how": [_typeset(line) for line in result.how.splitlines()],
    }


def _typeset(text: str) -> str:
    """Hyphens before numbers as minus signs."""
    return re.sub(r"(?<![\w.,-])-(?=[\d.])|(?<=\de)-(?=\d)", "\N{MINUS SIGN}", text)


def _group(run: GroupRun) -> dict[str, Any]:
    return {
        "prefix": run.group.prefix,
        "title": run.group.title,
        "artefacts": [_artefact(run, a) for a in run.artefacts],
        "files": list(run.files),
    }


def _artefact(run: GroupRun, artefact: Artefact) -> dict[str, Any]:
    out: dict[str, Any] = {
        "title": artefact.title,
        "caption": artefact.caption,
        "file": run.place(artefact),
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
        rows = [[_cell(value) for value in row] for row in artefact.rows]
        texts = [all(isinstance(row[k], str) for row in artefact.rows) for k in range(len(artefact.heads))]
        out["table"] = {"heads": artefact.heads, "rows": rows, "texts": texts}
    elif not isinstance(artefact, Data):
        raise TypeError(f"the report cannot show {type(artefact).__name__}")
    return out


def _cell(value: str | float | int | None) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return plain(value) if isinstance(value, int) else significant(value, 6, floor=0.0)
