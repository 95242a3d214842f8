"""A camera's prescription optimised with exact Jacobians: the run and its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.design.merit_function import MeritFunction, Operands
from optics.design.optimiser import Design, DesignError, optimise
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.camera_design import (
    CameraDesignSetup,
    beams_of,
    camera_file,
    camera_of,
    operands_of,
    prescription_of,
    resolve_design,
    variables_of,
)
from scenes.models.camera_model import derive_camera
from twin.run.procedure import Advance, BenchError, Procedure, silent

REMARK = """Prescription frame: z along the parent axis, light enters toward +z, y in the plane of symmetry, x along the
line CCD. Made by python -m twin.design from {start}: least squares of the wavefront error over the field."""


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
        first = MeritFunction.of(backend, start, beams, Operands(camera.wavelength)).evaluate(start)
    except (AimError, BeamMissedError) as error:
        problem = f"no beams to design with come through: {str(error).partition(';')[0]}"
        raise camera.error(problem, ("mirrors",), allowed="a camera whose whole field gets light") from error
    operands = operands_of(setup, first.principal_distance, first.envelope)
    try:
        found = optimise(
            backend,
            start,
            variables_of(test),
            beams,
            operands,
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
        "fields_deg": np.degrees(found.merit.beams.fields).tolist(),
        "principal_distance_m": {"before": before.principal_distance, "after": after.principal_distance},
        "envelope_m": {"before": before.envelope, "after": after.envelope},
        "clearance_m": {"before": before.clearances.tolist(), "after": after.clearances.tolist()},
        "jacobians": found.evaluations,
    }


DESIGN = Procedure("design", CameraDesignSetup, resolve_design, run_design, design_numbers)
