"""``summary/``: what was found, as a page of Markdown with its figures, short enough to stand beside a README."""

from __future__ import annotations

from collections.abc import Iterator

from twin.artefact import PngFigure, SvgFigure
from twin.validation.check import CONFIRMED, PAPERS, VERDICTS, CheckResult
from twin.validation.report import command, duration_text, measured_text, printed_text, sigma_text
from twin.validation.runner import Validation

SUMMARY = "summary"
"""Folder of the summary in the run folder."""
PAGE = "README.md"
"""So that a code host shows it when the folder is opened."""


def summary_files(validation: Validation) -> dict[str, bytes]:
    """Name -> content: the page and the figures that it shows."""
    figures = {
        f"{run.group.prefix}-{a.name}.{a.kind}": a
        for run in validation.runs
        for a in run.artefacts
        if isinstance(a, SvgFigure | PngFigure)
    }
    lines = [*_head(validation), *_tables(validation), *_corrections(validation)]
    if figures:
        lines += ["## Figures", ""]
    for name, artefact in figures.items():
        lines += [f"### {artefact.title}", "", f"![{artefact.title}]({name})", "", artefact.caption, ""]
    page = "\n".join(lines).rstrip() + "\n"
    return {PAGE: page.encode(), **{name: a.content() for name, a in figures.items()}}


def _head(validation: Validation) -> Iterator[str]:
    yield "# What the simulation says of the papers"
    yield ""
    took = duration_text(validation.seconds)
    yield f"Made by `{command(validation)}` in {took}; its validation.html has every row in full."
    yield ""
    yield "| verdict | checks | meaning |"
    yield "|---|---:|---|"
    for verdict, meaning in VERDICTS.items():
        if validation.counts[verdict]:
            yield f"| {verdict} | {validation.counts[verdict]} | {meaning} |"
    yield ""


def _tables(validation: Validation) -> Iterator[str]:
    for number, title in PAPERS.items():
        rows = [result for result in validation.results if result.paper == number]
        if not rows:
            continue
        yield f"## Paper {number}: {title}"
        yield ""
        yield "| check | what is compared | printed | measured | verdict |"
        yield "|---|---|---:|---:|---|"
        for r in rows:
            cells = (f"`{r.id}`", f"{r.equation}: {r.statement}", printed_text(r), _measured(r), r.verdict)
            yield "| " + " | ".join(_cell(cell) for cell in cells) + " |"
        yield ""


def _measured(result: CheckResult) -> str:
    """Value, sigma and unit."""
    text, sigma = measured_text(result), sigma_text(result)
    parts = [text, f"± {sigma}" if sigma else "", "" if result.unit == "1" or result.measured is None else result.unit]
    return " ".join(part for part in parts if part)


def _corrections(validation: Validation) -> Iterator[str]:
    """Everything that is not simply confirmed, with its reason."""
    found = [result for result in validation.results if result.verdict != CONFIRMED]
    if not found:
        return
    yield "## Corrections, refutations and gaps"
    yield ""
    for result in found:
        lines = result.how.splitlines()
        # how it was measured, reason, comparison; without a comparison only the reason
        reason = lines[-2] if len(lines) > 1 else lines[0]
        yield f"- `{result.id}` ({result.equation}), {result.verdict}: {_cell(reason)}"
    yield ""


def _cell(text: str) -> str:
    """Text that no table of Markdown takes for its own signs."""
    return text.replace("|", "\\|").replace("\n", " ")
