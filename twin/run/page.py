"""Templates of the reports, artefacts as they want them, and the run folder of a test."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from twin.run.artefact import Artefact, Cell, Data, PngFigure, SvgFigure, Table, Undrawn, plain, significant
from twin.run.data_files import FrameFacts, frame_files
from twin.run.further_sections import further_sections
from twin.run.page_policy import page_policy
from twin.run.provenance import SelfCheck, checks_in, inputs_in
from twin.run.reference_frames import described
from twin.run.report import Report, Section
from twin.run.run_folder import RunFolder, write_manifest
from twin.run.versions import versions


def environment(package: str) -> Environment:
    """Environment that finds the templates of ``package`` and the shared ones."""
    loader = FileSystemLoader([str(files(package)), str(files(__package__))])
    out = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    out.globals["page_policy"] = page_policy
    return out


def reproduce(words: Sequence[str]) -> str:
    """The command line of a program, its subcommand and options that makes a run again, as one types it."""
    return f"python -m {shlex.join(words)} --out again"


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
    elif isinstance(artefact, Undrawn):
        out["caption"] = f"{artefact.note[0].upper()}{artefact.note[1:]}."
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
        again: words of the command that runs it again, program first, where it is not the test with the run's own
            config.yaml.
        named: plain data in which files stand that the run read, by their absolute paths.
        given: further files and folders that it read, as the user gave them.
        checks: what it checked of itself beside what stands in its numbers.
    """

    config: str
    file: str
    backend: str
    seed: int | None
    started: float
    seconds: float
    program: str
    command: str
    again: tuple[str, ...] = ()
    named: Any = None
    given: tuple[Path, ...] = ()
    checks: tuple[SelfCheck, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """Of the command that makes the run again in its folder."""
        if self.again:
            return self.again
        seed = () if self.seed is None else ("--seed", str(self.seed))
        command = (self.command,) if self.command else ()
        return (self.program, *command, "config.yaml", *seed, "--backend", self.backend)

    def kept(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """What a manifest says of it: how to make it again, what was read, what it checked of itself.

        Args:
            numbers: of the run.
        """
        place = {"started_in": str(Path.cwd())} if self.given else {}
        checks = [check.to_dict() for check in self.checks or checks_in(numbers)]
        return {"again": list(self.words), **place, "inputs": inputs_in(self.named, self.given), "checks": checks}


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
            command=reproduce(facts.words),
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
    write_manifest(folder, facts.program, facts.started, facts.seconds, **entries, **facts.kept(numbers))
