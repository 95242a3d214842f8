"""What ``python -m twin.study --gradient`` does between its options and its files."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.numerics.backend import load_backend
from twin.run.artefact import Artefact, SvgFigure
from twin.run.cli import InputErrorText, check_backend
from twin.run.reference_frames import described
from twin.run.run_folder import RunFolder, chosen, write_manifest
from twin.run.versions import versions
from twin.study.gradient.study_gradient import AD, Gradient, study_gradient
from twin.study.runs.setup import StudySetup, resolve_study
from twin.study.runs.study_folder import PROGRAM
from twin.study.study_command import StudyOptions, broken_by_signals

TEMPLATE = "gradient.html.j2"


@dataclass(frozen=True, eq=False)
class GradientRun:
    """A differentiated study.

    Attributes:
        gradient: the Jacobian.
        numbers: contents of gradient.json.
        folder: where it is.
    """

    gradient: Gradient
    numbers: dict[str, Any]
    folder: Path


def run_gradient(file: Path, options: StudyOptions, advance: Callable[[str], None] = lambda text: None) -> GradientRun:
    """Read a study, differentiate it at its base, write gradient.json, gradient.csv and a report.

    Args:
        file: of the study, or a config.yaml.
        options: what the user chose.
        advance: told what is being done.

    Raises:
        InputError, InputErrorText, RunFolderError: bad input; nothing that was there is lost.
        Broken: SIGINT, SIGTERM or SIGHUP; nothing is kept.
    """
    check_backend(options.backend)
    for given, name in (
        (options.workers is not None, "--workers"),
        (options.scheduler is not None, "--scheduler"),
        (options.resume, "--resume"),
        (options.confirmed, "--yes"),
    ):
        if given:
            raise InputErrorText(f"--gradient differentiates at the base in this process, so {name} has no meaning")
    setup = resolve_study(file)
    started, began = time.time(), time.perf_counter()
    with broken_by_signals(), RunFolder(chosen(options.out, f"{file.stem}-gradient"), options.force) as folder:
        found = study_gradient(setup, load_backend(options.backend), advance)
        advance("writing the report")
        from twin.study.gradient.gradient_report import plain_data, whole_table

        numbers = described("gradient", plain_data(found))
        folder.write_text("config.yaml", setup.to_yaml())
        folder.write_json("gradient.json", numbers)
        folder.write_bytes("gradient.csv", whole_table(found).content())
        _write_report(found, setup, folder)
        told = {"gradient": True, "backend": options.backend, "worst_relative": found.worst}
        write_manifest(folder, PROGRAM, started, time.perf_counter() - began, **told)
    return GradientRun(found, numbers, folder.target)


def _write_report(found: Gradient, setup: StudySetup, folder: RunFolder) -> None:
    # drawing libraries are not needed before
    from twin.run.artefact import significant
    from twin.run.page import artefact_content, environment, place, reproduce
    from twin.run.svg import look, to_svg
    from twin.study.gradient.gradient_report import doubtful, factor_rows, heat_map, response_table, tornado

    with look("gradient"):
        figures = [
            SvgFigure(
                "heat-map",
                "Which factor moves which response",
                "Change of each response per spread of each factor, as a share of the response's largest one; the "
                "scale is logarithmic above 0.001.",
                to_svg(heat_map(found)),
            ),
            SvgFigure(
                "tornado",
                "Largest changes",
                "Change of each response when a factor rises by its spread, the largest first; in brackets the root of "
                "the sum of squares over all factors.",
                to_svg(tornado(found)),
            ),
        ]
    tables: list[Artefact] = [response_table(found), factor_rows(found)]
    for artefact in (*figures, *tables):
        folder.write_bytes(place(artefact), artefact.content())
    page = (
        environment(__package__)
        .get_template(TEMPLATE)
        .render(
            study=setup.study,
            found=found,
            exact=int((found.method == AD).sum()),
            entries=found.method.size,
            worst=significant(found.worst, 3, floor=0.0) if found.worst is not None else None,
            doubtful=doubtful(found),
            tables=[artefact_content(a, place(a)) for a in tables],
            figures=[artefact_content(a, place(a)) for a in figures],
            command=reproduce(PROGRAM, "config.yaml", "--gradient"),
            versions=versions(),
        )
    )
    folder.write_text("report.html", page)
