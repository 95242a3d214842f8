"""Files of a test's run folder."""

from __future__ import annotations

from dataclasses import dataclass

from twin.artefact import Artefact
from twin.image_file import preview_png, tiff
from twin.report.page import artefact_content, environment
from twin.run_folder import MANIFEST, RunFolder
from twin.trial.result import LabResult
from twin.versions import versions

TEMPLATE = "trial.html.j2"


@dataclass(frozen=True)
class RunFacts:
    """How a test was run.

    Attributes:
        config: the test with all it refers to, as YAML; it can be given in place of the test's file.
        file: the test's file as the user gave it.
        backend: where it was traced.
        seed: of everything that is drawn.
        started: seconds since the epoch.
        seconds: that it took.
        program: that ran it, as the user calls it.
        command: its subcommand.
    """

    config: str
    file: str
    backend: str
    seed: int
    started: float
    seconds: float
    program: str
    command: str


def place(artefact: Artefact) -> str:
    """File of an artefact in the run folder."""
    return f"artefacts/{artefact.name}.{artefact.kind}"


def render_report(result: LabResult, facts: RunFacts) -> str:
    """``report.html`` as text."""
    options = f"--seed {facts.seed} --backend {facts.backend} --out again"
    return (
        environment(__package__)
        .get_template(TEMPLATE)
        .render(
            result=result,
            summary=artefact_content(result.summary, place(result.summary)),
            sections=[
                {
                    "title": section.title,
                    "text": section.text,
                    "artefacts": [artefact_content(a, place(a)) for a in section.artefacts],
                }
                for section in result.sections
            ],
            facts=facts,
            command=f"python -m {facts.program} {facts.command} config.yaml {options}",
            versions=versions(),
        )
    )


def write_lab(result: LabResult, facts: RunFacts, folder: RunFolder) -> None:
    """Write everything into an open run folder: config, numbers, report, artefacts, images, the manifest."""
    folder.write_text("config.yaml", facts.config)
    folder.write_json(f"{result.kind}.json", result.document)
    for artefact in (result.summary, *(a for section in result.sections for a in section.artefacts)):
        folder.write_bytes(place(artefact), artefact.content())
    for name, frames in result.images.items():
        folder.write_bytes(f"images/{name}.tiff", tiff(frames))
        folder.write_bytes(f"images/{name}.png", preview_png(frames, stretch=None))
    folder.write_text("report.html", render_report(result, facts))
    manifest = {
        "program": facts.program,
        "test": result.kind,
        "versions": versions(),
        "backend": facts.backend,
        "seed": facts.seed,
        "started_unix_s": facts.started,
        "wall_time_s": facts.seconds,
        "warnings": list(result.warnings),
        "sha256": folder.checksums(),
    }
    folder.write_json(MANIFEST, manifest)
