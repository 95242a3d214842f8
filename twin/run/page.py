"""Templates of the reports, artefacts as they want them, and the run folder of a test."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from twin.run.artefact import Artefact, Cell, Data, PngFigure, SvgFigure, Table, plain, significant
from twin.run.data_files import FrameFacts, frame_files
from twin.run.further_sections import further_sections
from twin.run.reference_frames import described
from twin.run.report import Report, Section
from twin.run.run_folder import RunFolder, write_manifest
from twin.run.versions import versions

SHARED = "twin.run"
"""Package of the style sheet and of the macros."""


def environment(package: str) -> Environment:
    """Environment that finds the templates of ``package`` and the shared ones."""
    loader = FileSystemLoader([str(files(package)), str(files(SHARED))])
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def reproduce(*words: str) -> str:
    """The command that makes a run again from its own folder: program, subcommand and options, empty ones left out."""
    return " ".join(["python -m", *filter(None, words), "--out again"])


def artefact_content(artefact: Artefact, file: str | None) -> dict[str, Any]:
    """An artefact, and the file that holds it, for the macro ``show``."""
    out: dict[str, Any] = {
        "name": artefact.name,
        "title": artefact.title,
        "caption": artefact.caption,
        "file": file,
        "svg": None,
        "image": None,
        "table": None,
        "csv": None,
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
        out["csv"] = artefact.address
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


TEMPLATE = "test.html.j2"


@dataclass(frozen=True)
class RunFacts:
    """How a test was run.

    Attributes:
        config: the test with all it refers to, as YAML; it can be given in place of the test's file.
        file: the test's file as the user gave it.
        backend: where it was traced.
        seed: of everything that is drawn; None where nothing is.
        started: seconds since the epoch.
        seconds: that it took.
        program: that ran it, as the user calls it.
        command: its subcommand.
        again: the command that runs it again, where it is not the test with the run's own config.yaml.
    """

    config: str
    file: str
    backend: str
    seed: int | None
    started: float
    seconds: float
    program: str
    command: str
    again: str = ""


def place(artefact: Artefact) -> str:
    """File of an artefact in the run folder."""
    return f"artefacts/{artefact.name}.{artefact.kind}"


def write_artefacts(artefacts: Iterable[Artefact], folder: RunFolder) -> None:
    """Write artefacts to their places in an open run folder."""
    for artefact in artefacts:
        folder.write_bytes(place(artefact), artefact.content())


def section_contents(sections: Sequence[Section]) -> list[dict[str, Any]]:
    """Sections as the templates want them."""
    return [
        {
            "title": section.title,
            "folded": section.folded,
            "text": section.text,
            "artefacts": [artefact_content(a, place(a)) for a in section.artefacts],
        }
        for section in sections
    ]


def render_report(kind: str, report: Report, facts: RunFacts) -> str:
    """``report.html`` as text; its numbers are in KIND.json."""
    seed = "" if facts.seed is None else f"--seed {facts.seed}"
    options = f"{seed} --backend {facts.backend}".strip()
    return (
        environment(__package__)
        .get_template(TEMPLATE)
        .render(
            kind=kind,
            title=report.title,
            verdict=report.verdict,
            warnings=report.warnings,
            report=report,
            summary=artefact_content(report.summary, place(report.summary)),
            sections=section_contents(report.sections),
            facts=facts,
            command=facts.again or reproduce(facts.program, facts.command, "config.yaml", options),
            versions=versions(),
        )
    )


def write_test(kind: str, numbers: Mapping[str, Any], report: Report, facts: RunFacts, folder: RunFolder) -> None:
    """Write everything into an open run folder: config, numbers, report, artefacts, images, the manifest.

    Args:
        kind: of the test.
        numbers: of its run; KIND.json gets them after their frames.
        report: of the test.
        facts: how it was run.
        folder: open.
    """
    report = replace(report, sections=(*report.sections, *further_sections(kind, numbers)))
    folder.write_text("config.yaml", facts.config)
    folder.write_json(f"{kind}.json", described(kind, numbers))
    write_artefacts((report.summary, *(a for section in report.sections for a in section.artefacts)), folder)
    for name, frames in report.images.items():
        for file, content in frame_files(name, frames, report.image_facts.get(name, FrameFacts()), stretch=None):
            folder.write_bytes(file, content)
    folder.write_text("report.html", render_report(kind, report, facts))
    entries = {"test": kind, "backend": facts.backend, "seed": facts.seed or 0, "warnings": list(report.warnings)}
    write_manifest(folder, facts.program, facts.started, facts.seconds, **entries)
