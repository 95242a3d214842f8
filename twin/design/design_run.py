"""``python -m twin.design``: optimise a camera's prescription with exact Jacobians; before, after, the new file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import typer

from optics.design.merit_function import Goals, Judge, Judgement
from optics.design.optimiser import Design, DesignError, optimise
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.camera_design import (
    CameraDesignSetup,
    beams_of,
    camera_file,
    camera_of,
    goals_of,
    prescription_of,
    resolve_design,
    variables_of,
)
from scenes.models.camera_model import derive_camera
from twin.pictures.design_figures import error_figure, layout_figure
from twin.run.artefact import Data, SvgFigure, Table
from twin.run.cli import AsJson, BackendName, File, Force, Options, Out, Quiet
from twin.run.command import run_test
from twin.run.procedure import Advance, BenchError, Procedure, silent
from twin.run.report import Report, Section
from twin.run.svg import look, to_svg

PROGRAM = "twin.design"
REMARK = """Prescription frame: z along the parent axis, light enters toward +z, y in the plane of symmetry, x along the
line CCD. Made by python -m twin.design from {start}: least squares of the wavefront error over the field."""


@dataclass(frozen=True, eq=False)
class CameraFile(Data):
    """The optimised camera as a file of the library; ``data`` is its YAML text."""

    @property
    def kind(self) -> str:
        """Ending of the file."""
        return "yaml"

    def content(self) -> bytes:
        """The file."""
        return str(self.data).encode()


@dataclass(frozen=True, eq=False)
class DesignRun:
    """An optimised camera.

    Attributes:
        setup: what its file says.
        found: prescription before and after.
        text: the new camera's file.
    """

    setup: CameraDesignSetup
    found: Design
    text: str


def run_design(setup: CameraDesignSetup, backend: Backend, seed: int = 0, advance: Advance = silent) -> DesignRun:
    """Optimise the camera; nothing is drawn at random, the seed is not used.

    Raises:
        InputError: the camera passes no light.
        BenchError: the constraints cannot be held.
    """
    test, camera = setup.test, setup.camera
    start, beams = prescription_of(camera), beams_of(camera)
    try:
        first = Judge.of(backend, start, beams, Goals(camera.wavelength)).judge(start)
    except (AimError, BeamMissedError) as error:
        problem = f"no beams to design with come through: {str(error).partition(';')[0]}"
        raise camera.error(problem, ("mirrors",), allowed="a camera whose whole field gets light") from error
    goals = goals_of(setup, first.principal_distance, first.envelope)
    try:
        found = optimise(
            backend,
            start,
            variables_of(test),
            beams,
            goals,
            test.steps,
            advance=lambda done, total: advance("optimise", done, total),
        )
    except DesignError as error:
        remedy = "a larger envelope, a smaller clearance, or more to vary"
        raise BenchError(str(error), ("envelope",) if test.envelope is not None else ("vary",), remedy) from error
    remark = REMARK.format(start=camera.name)
    if test.envelope is not None:
        remark += (
            f"\nIts extent along z is {100 * found.after.envelope / found.before.envelope:.2f} % of {camera.name}'s."
        )
    spec = camera_of(camera, found.prescription, test.name, test.description)
    derive_camera(spec, backend)  # it can be used as a camera
    return DesignRun(setup, found, camera_file(spec, remark))


def design_numbers(run: DesignRun) -> dict[str, Any]:
    """Contents of design.json without its frames."""
    found, setup = run.found, run.setup
    before, after = found.before, found.after
    return {
        "camera": setup.test.name,
        "start": setup.camera.name,
        "wavefront_error_waves": {"before": before.errors.tolist(), "after": after.errors.tolist()},
        "fields_deg": np.degrees(found.judge.beams.fields).tolist(),
        "principal_distance_m": {"before": before.principal_distance, "after": after.principal_distance},
        "envelope_m": {"before": before.envelope, "after": after.envelope},
        "clearance_m": {"before": before.clearances.tolist(), "after": after.clearances.tolist()},
        "jacobians": found.evaluations,
    }


DESIGN = Procedure("design", CameraDesignSetup, resolve_design, run_design, design_numbers)


def design_report(run: DesignRun) -> Report:
    """Report of an optimised camera."""
    setup, found = run.setup, run.found
    before, after = found.before, found.after
    worst = float(after.errors.max())
    lead = (
        f"The worst field of {setup.test.name} has a wavefront error of {worst:.4f} waves rms "
        f"({before.errors.max():.4f} in {setup.camera.name}); its extent along the axis is "
        f"{1e3 * after.envelope:.1f} mm ({1e3 * before.envelope:.1f} mm).",
    )
    numbers = _numbers(before, after)
    summary = Table("merit", "The camera before and after", "", ("", "before", "after"), numbers, (None, 4, 4))
    fields = np.degrees(found.judge.beams.fields)
    by_field = Table(
        "fields",
        "Wavefront error by field",
        "Waves rms, piston and tilt removed; the other half of the field is the mirror image.",
        ("x, deg", "y, deg", "before", "after"),
        [
            [float(x), float(y), float(b), float(a)]
            for (x, y), b, a in zip(fields, before.errors, after.errors, strict=True)
        ],
        (3, 3, 4, 4),
    )
    changed = Table(
        "variables",
        "What was varied",
        "SI units.",
        ("variable", "before", "after"),
        [
            [v.name, float(prescription_of(setup.camera).value(v)), float(found.prescription.value(v))]
            for v in found.variables
        ],
    )
    names = ("scene", *found.prescription.names)
    passages = Table(
        "clearances",
        "Room between beams and edges",
        "Least distance in y of every stretch of the beams from the edge that it passes, in the plane of symmetry, mm.",
        ("from", "to", "passes", "before", "after"),
        [
            [names[p.stretch], names[p.stretch + 1], names[p.surface], 1e3 * float(b), 1e3 * float(a)]
            for p, b, a in zip(found.judge.passages, before.clearances, after.clearances, strict=True)
        ],
        (None, None, None, 1, 1),
    )
    with look("design"):
        layout = to_svg(layout_figure(found, prescription_of(setup.camera)))
        errors = to_svg(error_figure(found))
    sections = (
        Section(
            "Layout",
            ("Chief ray and edges of the beam of the middle of the field, in the plane of symmetry.",),
            (SvgFigure("layout", "Before and after", "To one scale.", layout), passages),
        ),
        Section("Image quality", (), (SvgFigure("errors", "Wavefront error over the field", "", errors), by_field)),
        Section(
            "Prescription",
            (f"{found.evaluations} Jacobians were traced. The camera's file can be used as it is.",),
            (
                changed,
                CameraFile(setup.test.name.lower(), "The new camera", "A file for scenes/library/cameras.", run.text),
            ),
        ),
    )
    facts = (("start", setup.camera.name), ("variables", str(len(found.variables))))
    return Report(f"Design of {setup.test.name}", lead, facts, summary, sections)


def _numbers(before: Judgement, after: Judgement) -> list[list[str | float]]:
    def row(name: str, of: Callable[[Judgement], float]) -> list[str | float]:
        return [name, float(of(before)), float(of(after))]

    return [
        row("wavefront error, worst field, waves rms", lambda j: j.errors.max()),
        row("wavefront error, rms over the field, waves", lambda j: np.sqrt(np.mean(j.errors**2))),
        row("principal distance, m", lambda j: j.principal_distance),
        row("extent along the axis, m", lambda j: j.envelope),
        row("least clearance, m", lambda j: j.clearances.min()),
    ]


app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    file: File,
    out: Out = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Optimise a camera's prescription: curvatures, conics, aspheric terms and places vary; the wavefront error over
    the field is made least, with the focal length, the envelope and free beams as constraints.

    An example is scenes/examples/design_gf7_short.yaml. The run folder gets the new camera's file in artefacts/,
    design.json, config.yaml and a report.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    run_test(PROGRAM, "", file, DESIGN, design_report, Options(out, None, backend, force, as_json, quiet))


if __name__ == "__main__":
    sys.exit(app())
