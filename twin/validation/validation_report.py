"""Report of the validation, its summary page, and the files of its run folder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from twin.framework.artefact import Data, Marked, PngFigure, SvgFigure, Table, decimals_for, fixed, plain, significant
from twin.framework.page import links, report_page, reproduce
from twin.framework.report import Report, Section, answer
from twin.framework.run_folder import RunFolder, write_manifest
from twin.validation.check import AGREED, PAPERS, SIGMAS, VERDICTS, CheckResult, Verdict
from twin.validation.row_names import REAL
from twin.validation.runner import GroupRun, Validation

PROGRAM = "twin.validate"
SUMMARY = "summary"
"""Name of the folder in the run folder that contains the summary page and its figures."""
PAGE = "README.md"
"""Name of the summary page; code hosts show a README.md when its folder is opened."""


def summary_files(validation: Validation) -> dict[str, bytes]:
    """Return the files of the summary, content by name: the page and the figures that it shows."""
    figures = {
        f"{run.group.prefix}-{a.name}.{a.kind}": a
        for run in validation.runs
        for a in run.artefacts
        if isinstance(a, SvgFigure | PngFigure)
    }
    lines = [*_head(validation), *_tables(validation), *_chosen(validation), *_corrections(validation)]
    if any(result.paper == REAL for result in validation.results):
        lines += _measured_data(validation)
    if figures:
        lines += ["## Figures", ""]
    for name, artefact in figures.items():
        lines += [f"### {artefact.title}", "", f"![{artefact.title}]({name})", "", artefact.caption, ""]
    page = _angles("\n".join(lines).rstrip() + "\n")
    return {PAGE: page.encode(), **{name: a.content() for name, a in figures.items()}}


def _head(validation: Validation) -> Iterator[str]:
    real = {r.paper for r in validation.results} == {REAL}
    title = "# Measured data of others" if real else "# What the simulation says of the papers"
    made = f"Made by `{command(validation)}` in {duration_text(validation.seconds)}"
    yield from (title, "", f"{made}; its validation.html has every row in full.", "")
    counted = ((v, str(validation.counts[v]), meaning) for v, meaning in VERDICTS.items() if validation.counts[v])
    yield from _table_lines(("verdict", "checks", "meaning"), counted, right=(1,))
    if real:
        return
    yield (
        "**Claim**: what the paper prints, or in brackets what its statement implies. **Tolerance**: how far claim and "
        "measurement may be apart without the noise, and why. **Finds**: the smallest error of the statement that the "
        "row would have found, tolerance plus three sigma, and its share of the claim; an error just so large is found "
        "half the time. **Sides**: two-sided where a measurement can disagree on both sides of the claim; at most and "
        "at least where it agrees however far below or above it lies. **Alternative**: the nearest other statement "
        "and how far away it is; a row that finds only errors larger than that is undecided."
    )
    yield ""


def _tables(validation: Validation) -> Iterator[str]:
    for number, title in PAPERS.items():
        rows = [result for result in validation.results if result.paper == number]
        if not rows:
            continue
        if number == REAL:
            yield from _real_table(title, rows)
            continue
        yield from (f"## Paper {number}: {title}", "")
        cells = []
        for r in rows:
            names, about = " = ".join(f"`{name}`" for name in (r.id, *r.also)), f"{r.equation}: {r.statement}"
            about += f". Theory: {r.theory}" if r.theory else ""
            cells.append((names, about, claim_text(r), comparison_text(r), _measured(r), *_limits(r), r.verdict))
        heads = "check, what is compared, claim, sides, measured, tolerance, finds, alternative, verdict".split(", ")
        yield from _table_lines(heads, cells, right=(2, 4))


def _real_table(title: str, rows: Sequence[CheckResult]) -> Iterator[str]:
    """Yield the lines of the table of rows on measured data."""
    yield from (f"## {title}", "")
    cells = []
    for r in rows:
        unit = "" if r.unit == "1" or r.measured is None else f" {r.unit}"
        refuted = ""
        if r.power is not None and r.claim is not None:
            side = {"two-sided": "off", "at most": "above it", "at least": "below it"}[r.comparison]
            refuted = f"{side} by more than {plain(r.power, 2)}{unit} ({r.because}); the alternative, {r.against}, is "
            refuted += f"{plain(r.tells or 0.0, 2)}{unit} away"
        about = f"{r.equation}: {r.statement}"
        measured = f"{measured_text(r)}{unit}"
        cells.append((f"`{r.id}`", about, claim_text(r), measured, sigma_text(r), r.verdict, refuted))
    heads = "row, statement, printed by others, measured here, sigma, verdict, what would have refuted it".split(", ")
    yield from _table_lines(heads, cells, right=(2, 3, 4))
    yield from ("## Numbers of each row", "")
    for r in rows:
        # the last line is the comparison, which the table has
        lines = r.how.splitlines() if r.power is None else r.how.splitlines()[:-1]
        if lines:
            yield f"- `{r.id}`: {_cell(' '.join(lines))}"
    yield ""


def _measured(result: CheckResult) -> str:
    """Return the simulated value with its sigma and unit as text."""
    text, sigma = measured_text(result), sigma_text(result)
    parts = [text, f"± {sigma}" if sigma else "", "" if result.unit == "1" or result.measured is None else result.unit]
    return " ".join(part for part in parts if part)


def _limits(result: CheckResult) -> tuple[str, str, str]:
    """Return tolerance with reason, smallest detectable error, and alternative statement, as text."""
    if result.power is None or result.tells is None:
        return ("", "", "")
    unit = "" if result.unit == "1" else f" {result.unit}"
    tolerance = f"{plain(result.tolerance)}{unit}: {result.because}"
    return tolerance, power_text(result), f"{result.against}, {plain(result.tells, 3)}{unit} away"


def _chosen(validation: Validation) -> Iterator[str]:
    """Yield the lines that list the inputs chosen here, since no paper prints them, with their ranges."""
    results = [result for result in validation.results if result.inputs]
    if not results:
        return
    about = "What the paper does not print and these rows need, and where each may be moved before its row fails."
    yield from ("## Chosen inputs", "", about, "")
    for result in results:
        yield f"- `{result.id}`: {_cell('; '.join(i.text for i in result.inputs))}"
    yield ""


def _corrections(validation: Validation) -> Iterator[str]:
    """Yield the lines that list all checks without agreement, with the reason."""
    results = [result for result in validation.results if result.verdict not in AGREED.values()]
    if not results:
        return
    yield from ("## Corrections, refutations, the undecided and gaps", "")
    for result in results:
        lines = result.how.splitlines()
        # how it was measured, reason, comparison; without a comparison only the reason
        reason = lines[-2] if len(lines) > 1 else lines[0]
        yield f"- `{result.id}` ({result.equation}), {result.verdict}: {_cell(reason)}"
    yield ""


def _measured_data(validation: Validation) -> Iterator[str]:
    """Yield the lines with the tables of rows on measured data, the data's files, and the choices made on them."""
    from twin.validation.group import load_printed
    from twin.validation.measured_data import published

    tables = (a for run in validation.runs for a in run.artefacts if run.group.prefix.startswith(REAL))
    for table in tables:
        if not isinstance(table, Table):
            continue
        yield from (f"## {table.title}", "", table.caption, "")
        digits = table.decimals or (None,) * len(table.heads)
        yield from _table_lines(table.heads, ([*map(_decimal, row, digits)] for row in table.rows))
    yield from ("## Where the data are published", "")
    yield "None of these files is part of the project; `--real DIR` names a folder that contains them."
    yield ""
    files = ((f"`{name}`", source, f"`{checksum}`") for name, (checksum, source) in published().items())
    yield from _table_lines(("file", "published in", "SHA-256"), files)
    yield from ("## Choices that were made on these files", "")
    yield from (f"- {choice}" for choice in load_printed(REAL).content.data["choices"])
    yield ""


def _decimal(cell: Any, decimals: int | None) -> str:
    """Return a cell as text, a float with the given number of decimals if there is one."""
    return str(cell) if decimals is None or not isinstance(cell, float) else fixed(cell, decimals)


def _table_lines(heads: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> Iterator[str]:
    """Yield the lines of a Markdown table and an empty one; columns with the indices ``right`` are right-aligned."""
    yield "| " + " | ".join(heads) + " |"
    yield "|" + "".join("---:|" if k in right else "---|" for k in range(len(heads)))
    yield from ("| " + " | ".join(map(_cell, row)) + " |" for row in rows)
    yield ""


def _cell(text: str) -> str:
    """Escape text for a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


_LOOKS = "confirmed", "reproduced", "consistent", "corrected", "refuted", "undecided", "silent", "failed", "silent"
MARKS: dict[Verdict, tuple[str, str]] = dict(zip(VERDICTS, zip("=⊜∼≈≠±?✕–", _LOOKS, strict=True), strict=True))
"""Verdict -> its character and CSS class in the report; the character shows the meaning without colour."""


def render_report(validation: Validation) -> str:
    """Return the report page as HTML."""
    count = len(validation.results)
    checks = f"{count} check{'' if count == 1 else 's'}"
    lead = (
        f"What the papers print, beside what the simulation gives: {checks}, {duration_text(validation.seconds)}"
        f"{', fast' if validation.fast else ''}."
    )
    strange = Markup("; ").join(
        Markup('<a href="#{0}">{0}</a> is {1} where earlier work found {2}').format(r.id, r.verdict, e)
        for r, e in validation.unexpected
    )
    expected = Markup("Not as expected: {}.").format(strange) if strange else ""
    report = Report(
        f"Validation of the source papers: {checks}",
        verdict(validation),
        tuple(filter(None, (lead, expected))),
        (("Verdicts", VERDICTS_TEXT),),
        _count_table(validation),
        (*_papers(validation), *(_group(run) for run in validation.runs if run.artefacts or run.files)),
    )
    made_with = f"{validation.seed}, {validation.backend}, float64"
    rows = [("Numbers", links(("validation.json",))), ("Seed, backend", made_with)]
    return _angles(report_page(report, _words(validation), rows))


VERDICTS_TEXT = (
    "A verdict is the outcome of a comparison, never an opinion: the tolerance and its reason are fixed before "
    f"anything is computed, {SIGMAS:g} standard deviations of the measured value are allowed on top, and both stand in "
    "the last line of each finding; together they are the smallest error of the statement that the row would have "
    "found, half the time. A row that could not tell the nearest other statement confirms nothing. In brackets: "
    "implied, not printed. Under a claim stands on which sides of it a measurement can disagree; at most and at least "
    "agree however far below or above it lies. ± is one standard deviation."
)


def verdict(validation: Validation) -> str:
    """Return the outcome of all checks in two sentences."""
    counts = ", ".join(f"{validation.counts[v]} {v}" for v in VERDICTS if validation.counts[v])
    count, strange = len(validation.results), [r.id for r, _ in validation.unexpected]
    expected = "all verdicts are as expected from earlier work"
    if strange:
        expected = f"{len(strange)} of the verdicts {'is' if len(strange) == 1 else 'are'} not as expected: "
        expected += f"look at {', '.join(strange)}"
    text, _ = answer(f"{count} check{'' if count == 1 else 's'}: {counts or 'no verdict'}", expected)
    return text


def _papers(validation: Validation) -> Iterator[Section]:
    """Yield a report section for each paper, with all its checks."""
    for number, title in PAPERS.items():
        results = [result for result in validation.results if result.paper == number]
        if results:
            head = "Measured data" if number == REAL else f"Paper {number}"
            yield Section(head, (title,), (_paper_table(number, results),), name=f"paper-{number}")


def _paper_table(paper: str, results: Sequence[CheckResult]) -> Table:
    """Return the table of a paper's checks; its downloadable form has all digits."""
    heads = ("id", "equation", "statement", "printed", "sides", "measured", "sigma", "unit", "verdict", "finds", "how")
    full = [
        (
            *(r.id, r.equation, r.statement, r.printed, comparison_text(r)),
            *(r.measured, r.sigma, r.unit, str(r.verdict), r.power, r.how),
        )
        for r in results
    ]
    shown = ("Printed, and what is compared", "claim", "measured", "Verdict", "How, and what was found")
    name, title = f"paper-{paper}", f"Paper {paper}"
    return Table(name, "", "", shown, [_row(r) for r in results], within="", full=Table(name, title, "", heads, full))


def _count_table(validation: Validation) -> Table:
    heads = ("verdict", "checks", "meaning")
    full = [(str(verdict), validation.counts[verdict], meaning) for verdict, meaning in VERDICTS.items()]
    rows = [
        (Marked(f"{mark} {row[0]}", "", f"verdict {look}"), *row[1:])
        for row, (mark, look) in zip(full, (MARKS[verdict] for verdict in VERDICTS), strict=True)
    ]
    digits = Table("verdicts", "Verdicts", "", heads, full)
    return Table("verdicts", "Verdicts", "", heads, rows, within="", full=digits)


def duration_text(seconds: float) -> str:
    """Return a duration in minutes, or in seconds if it is short."""
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"


def command(validation: Validation) -> str:
    """Return the command line that repeats a validation."""
    return reproduce(_words(validation))


def _words(validation: Validation) -> list[str]:
    only = [] if validation.only is None else ["--only", validation.only.replace(" ", "")]
    fast = ["--fast"] if validation.fast else []
    return [PROGRAM, *only, *fast, "--seed", str(validation.seed), "--backend", validation.backend]


def measured_text(result: CheckResult) -> str:
    """Return the simulated value as text, with the digits that its sigma justifies."""
    if result.measured is None:
        return "\N{EM DASH}"
    if result.sigma:
        return fixed(result.measured, decimals_for(result.sigma))
    return significant(result.measured, 6, floor=0.0)


def sigma_text(result: CheckResult) -> str:
    """Return sigma with two digits; empty if there is no noise."""
    return fixed(result.sigma, decimals_for(result.sigma)) if result.sigma else ""


def claim_text(result: CheckResult) -> str:
    """Return the printed value, or in brackets the value that the statement implies."""
    if result.printed is None:
        return "\N{EM DASH}" if result.implied is None else f"[{plain(result.implied)}]"
    return plain(result.printed)


def comparison_text(result: CheckResult) -> str:
    """Return on which sides of the paper's number a value disagrees, as text; empty if nothing is compared."""
    return result.comparison if result.power is not None else ""


def power_text(result: CheckResult) -> str:
    """Return the smallest error that the check would have detected, in its unit and relative to the paper's number."""
    if result.power is None:
        return "\N{EM DASH}"
    text = significant(result.power, 2, floor=0.0)
    unit = "" if result.unit == "1" else f" {result.unit}"
    share = f", {significant(100.0 * result.power / abs(result.claim), 2, floor=0.0)} %" if result.claim else ""
    return f"{text}{unit}{share}"


def _row(result: CheckResult) -> tuple[Marked, ...]:
    names = Markup(" = ").join(Markup('<code id="{0}">{0}</code>').format(name) for name in (result.id, *result.also))
    theory = f" · theory: {result.theory}" if result.theory else ""
    about = Markup("{} · {}{}").format(result.equation, names, theory)
    unit = "" if result.unit == "1" else f" {result.unit}"
    claim, measured = (text + unit * (text != "\N{EM DASH}") for text in (claim_text(result), measured_text(result)))
    mark, look = MARKS[result.verdict]
    finds = "" if result.tells is None or result.power is None else f"finds {power_text(result)}"
    sigma = f"± {sigma_text(result)}" if sigma_text(result) else ""
    how, *last = _typeset(result.how).rsplit("\n", 1)
    return (
        Marked(result.statement, about, "text"),
        Marked(claim, comparison_text(result), "number"),
        Marked(measured, sigma, "number"),
        Marked(f"{mark} {result.verdict}", finds, f"verdict {look}"),
        Marked(how, "".join(last), "text how"),
    )


def _typeset(text: str) -> str:
    """Return text with minus signs instead of hyphens before numbers."""
    return re.sub(r"(?<![\w.,-])-(?=[\d.])|(?<=\de)-(?=\d)", "\N{MINUS SIGN}", text)


def _angles(page: str) -> str:
    """Return a report page with angles written in the unit symbols of all reports.

    The papers, and with them the checks, print 0.1 arcsec as 0.1″.
    """
    page = re.sub(r"(?<=/)\N{DOUBLE PRIME}", "arcsec", page)
    page = re.sub(r"[ \N{NO-BREAK SPACE}]?\N{DOUBLE PRIME}", " arcsec", page)
    return re.sub(r"(?<=[\d)])\N{PRIME}", " arcmin", page)


def _group(run: GroupRun) -> Section:
    shown = tuple(replace(artefact, within=run.path_of(artefact)) for artefact in run.artefacts)
    files = tuple(Data(f"file-{k}", "", "", None, within=file) for k, file in enumerate(run.files))
    return Section(f"{run.group.title} ({run.group.prefix})", (), (*shown, *files), name=f"group-{run.group.prefix}")


def write_validation(validation: Validation, folder: RunFolder) -> None:
    """Write validation.json, validation.html, summary/, the groups' artefacts and the manifest."""
    for run in validation.runs:
        for artefact in run.artefacts:
            folder.write_bytes(run.path_of(artefact), artefact.content())
    folder.write_json("validation.json", {**validation.to_dict(), "verdict": verdict(validation)})
    folder.write_text("validation.html", render_report(validation))
    for name, content in summary_files(validation).items():
        folder.write_bytes(f"{SUMMARY}/{name}", content)
    entries: dict[str, Any] = {name: getattr(validation, name) for name in ("backend", "seed", "only", "fast")}
    again = _words(validation)
    write_manifest(folder, PROGRAM, validation.started, validation.seconds, **entries, again=again)
