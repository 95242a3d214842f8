"""``python -m twin.study --gradient``: a study differentiated at its base."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from scenes.kinds.file_kinds import read_for
from scenes.models.camera_sharpness import blur_warnings
from twin.run.cli import InputErrorText, Options, print_verdict, print_whole, result_table
from twin.run.command import Result, print_warnings, run_command
from twin.run.procedure import WRITE, Session
from twin.run.provenance import inputs_in
from twin.run.reference_frames import described
from twin.run.run_folder import write_manifest
from twin.sensors.area_detector import coarse_warnings
from twin.study.gradient.gradient_numbers import gradient_numbers, whole_table
from twin.study.gradient.gradient_report import response_table, verdict, write_report
from twin.study.gradient.study_gradient import Gradient, study_gradient
from twin.study.runs.setup import StudySetup, base_of, resolve_study
from twin.study.runs.study_folder import PROGRAM
from twin.study.study_command import StudyOptions


def run_gradient(file: Path, options: StudyOptions, as_json: bool, quiet: bool) -> None:
    """Read a study, differentiate it at its base, write gradient.json, gradient.csv and a report, print what they say.

    Args:
        file: of the study, or a config.yaml.
        options: what the user chose.
        as_json: print the numbers as JSON.
        quiet: print nothing.

    Raises:
        typer.Exit: with the exit code of a failure, which has been told.
    """

    def resolve() -> StudySetup:
        for given, name in (
            (options.workers is not None, "--workers"),
            (options.scheduler is not None, "--scheduler"),
            (options.resume, "--resume"),
            (options.confirmed, "--yes"),
        ):
            if given:
                raise InputErrorText(f"--gradient differentiates at the base in this process, so {name} has no meaning")
        return read_for(PROGRAM, file, resolve_study)

    shared = Options(options.out, None, options.backend, options.force, as_json, quiet)
    run_command(f"{file.stem}-gradient", shared, resolve, _work)


def _work(setup: StudySetup, session: Session) -> Result:
    found = study_gradient(setup, session.backend, session.advance)
    session.advance(WRITE, 0, 1)
    folder = session.folder
    numbers = described("gradient", {**gradient_numbers(found), "verdict": verdict(found)})
    folder.write_text("config.yaml", setup.to_yaml())
    folder.write_json("gradient.json", numbers)
    folder.write_bytes("gradient.csv", whole_table(found).content())
    base = base_of(setup)
    warnings = (*blur_warnings(base, session.backend), *coarse_warnings(base))
    write_report(setup, found, folder, warnings)
    entries: dict[str, Any] = {"gradient": True, "backend": session.backend.name, "worst_relative": found.worst}
    entries["again"] = [PROGRAM, "config.yaml", "--gradient", "--backend", session.backend.name]
    entries["inputs"] = inputs_in(setup.tree)
    write_manifest(folder, PROGRAM, session.started, session.seconds, warnings=list(warnings), **entries)
    return Result(numbers, lambda console: _print_result(found, warnings, console))


def _print_result(found: Gradient, warnings: Sequence[str], console: Console) -> None:
    print_verdict(console, verdict(found))
    table = result_table(f"{len(found.responses)} responses by {len(found.factors)} factors")
    picked = [0, 1, 2, 3, 4, 5, 8]
    heads = ("response", "strongest factor", "derivative", "unit", "per spread", "all, rss", "AD-diff.")
    for head, k in zip(heads, picked, strict=True):
        table.add_column(head, justify="left" if k in (0, 1, 3) else "right", no_wrap=True)
    for row in response_table(found).rows:
        table.add_row(*(str(row[k]) for k in picked))
    print_whole(console, table)
    print_warnings(console, warnings)
