"""``summary/``: what was found, as a page of Markdown with its figures, short enough to stand beside a README."""

from __future__ import annotations

from collections.abc import Iterator

from twin.artefact import PngFigure, SvgFigure
from twin.report.numbers import plain
from twin.validation.check import AGREED, PAPERS, VERDICTS, CheckResult
from twin.validation.report import claim_text, command, duration_text, measured_text, power_text, sigma_text
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
    lines = [*_head(validation), *_tables(validation), *_chosen(validation), *_corrections(validation)]
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
    yield (
        "**Claim**: what the paper prints, or in brackets what its statement implies. **Tolerance**: how far claim and "
        "measurement may be apart without the noise, and why. **Finds**: the smallest error of the statement that the "
        "row would have found, tolerance plus three sigma, and its share of the claim; an error just so large is found "
        "half the time. **To be told from**: the nearest other statement and how far away it is; a row that finds less "
        "than that is undecided."
    )
    yield ""


def _tables(validation: Validation) -> Iterator[str]:
    for number, title in PAPERS.items():
        rows = [result for result in validation.results if result.paper == number]
        if not rows:
            continue
        yield f"## Paper {number}: {title}"
        yield ""
        yield "| check | what is compared | claim | measured | tolerance | finds | to be told from | verdict |"
        yield "|---|---|---:|---:|---|---|---|---|"
        for r in rows:
            names, about = " = ".join(f"`{name}`" for name in (r.id, *r.also)), f"{r.equation}: {r.statement}"
            about += f". Theory: {r.theory}" if r.theory else ""
            cells = (names, about, claim_text(r), _measured(r), *_limits(r), r.verdict)
            yield "| " + " | ".join(_cell(cell) for cell in cells) + " |"
        yield ""


def _measured(result: CheckResult) -> str:
    """Value, sigma and unit."""
    text, sigma = measured_text(result), sigma_text(result)
    parts = [text, f"± {sigma}" if sigma else "", "" if result.unit == "1" or result.measured is None else result.unit]
    return " ".join(part for part in parts if part)


def _limits(result: CheckResult) -> tuple[str, str, str]:
    """Tolerance with its reason, what an error must have to be found, and what is to be told."""
    if result.power is None or result.tells is None:
        return ("", "", "")
    unit = "" if result.unit == "1" else f" {result.unit}"
    tolerance = f"{plain(result.tolerance)}{unit}: {result.because}"
    return tolerance, power_text(result), f"{result.against}, {plain(result.tells, 3)}{unit} away"


def _chosen(validation: Validation) -> Iterator[str]:
    """Inputs that were chosen here, and how far each may move."""
    found = [result for result in validation.results if result.inputs]
    if not found:
        return
    yield "## Chosen inputs"
    yield ""
    yield "What the paper does not print and these rows need, and where each may be moved before its row fails."
    yield ""
    for result in found:
        yield f"- `{result.id}`: {_cell('; '.join(i.text for i in result.inputs))}"
    yield ""


def _corrections(validation: Validation) -> Iterator[str]:
    """Everything that does not agree, with its reason."""
    found = [result for result in validation.results if result.verdict not in AGREED.values()]
    if not found:
        return
    yield "## Corrections, refutations, the undecided and gaps"
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
