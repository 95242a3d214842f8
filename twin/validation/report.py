"""``validation.html`` of a validation: one self-contained page with every check, printed beside measured."""

from __future__ import annotations

import re
from typing import Any

from twin.report.numbers import decimals_for, fixed, plain, significant
from twin.report.page import artefact_content, environment
from twin.validation.check import (
    CONFIRMED,
    CONSISTENT,
    CORRECTED,
    FAILED,
    NOT_CHECKABLE,
    PAPERS,
    REFUTED,
    REPRODUCED,
    SIGMAS,
    UNDECIDED,
    VERDICTS,
    CheckResult,
    Verdict,
)
from twin.validation.runner import GroupRun, Validation
from twin.versions import versions

TEMPLATE = "validation.html.j2"
MARKS: dict[Verdict, tuple[str, str]] = {
    CONFIRMED: ("=", "confirmed"),
    REPRODUCED: ("⊜", "reproduced"),
    CONSISTENT: ("∼", "consistent"),
    CORRECTED: ("≈", "corrected"),
    REFUTED: ("≠", "refuted"),
    UNDECIDED: ("±", "undecided"),
    NOT_CHECKABLE: ("?", "silent"),
    FAILED: ("✕", "failed"),
}
"""Verdict -> mark, so that no meaning hangs on a colour, and class in the page."""


def render_report(validation: Validation) -> str:
    """The page as text."""
    template = environment(__package__).get_template(TEMPLATE)
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
        unexpected=[{"id": r.id, "verdict": r.verdict, "expected": expected} for r, expected in validation.unexpected],
        fast=validation.fast,
        sigmas=f"{SIGMAS:g}",
        command=command(validation),
        backend=validation.backend,
        duration=duration_text(validation.seconds),
        seed=validation.seed,
        versions=versions(),
    )


def duration_text(seconds: float) -> str:
    """A time as one says it."""
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"


def command(validation: Validation) -> str:
    """What repeats this validation."""
    only = "" if validation.only is None else f" --only {validation.only.replace(' ', '')}"
    fast = " --fast" if validation.fast else ""
    return f"python -m twin.validate{only}{fast} --seed {validation.seed} --backend {validation.backend} --out again"


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


def claim_text(result: CheckResult) -> str:
    """What the paper prints, or in brackets what its statement implies."""
    if result.printed is None and result.implied is not None:
        return f"[{plain(result.implied)}]"
    return printed_text(result)


def power_text(result: CheckResult) -> str:
    """The smallest error of the statement that the row would have found, in its unit and of the claim."""
    if result.power is None:
        return "\N{EM DASH}"
    text = significant(result.power, 2, floor=0.0)
    unit = "" if result.unit == "1" else f" {result.unit}"
    share = f", {significant(100.0 * result.power / abs(result.claim), 2, floor=0.0)} %" if result.claim else ""
    return f"{text}{unit}{share}"


def _row(result: CheckResult) -> dict[str, Any]:
    mark, kind = MARKS[result.verdict]
    return {
        "id": result.id,
        "equation": result.equation,
        "statement": result.statement,
        "also": list(result.also),
        "theory": result.theory,
        "printed": claim_text(result),
        "power": power_text(result),
        "tells": "" if result.tells is None or result.power is None else significant(result.tells, 3, floor=0.0),
        "against": result.against,
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
        "artefacts": [artefact_content(a, run.place(a)) for a in run.artefacts],
        "files": list(run.files),
    }
