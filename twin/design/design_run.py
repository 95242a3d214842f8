"""A camera's prescription optimised with exact Jacobians from several starts: the run and its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.design.design_rays import trace_beams
from optics.design.merit_function import MeritFunction, Operands
from optics.design.optimiser import HELD, ITERATIONS, Design, DesignError, Held, rms_error
from optics.design.starts import SAME, Attempt, Search, search
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.camera_design import (
    CameraDesignSetup,
    beams_of,
    camera_of,
    operands_of,
    prescription_of,
    variables_of,
)
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import BLURRED
from twin.run.procedure import Advance, BenchError, silent

REMARK = """Prescription frame: z along the parent axis, light enters toward +z, y in the plane of symmetry, x along the
line CCD. Made by python -m twin.design from {start}: least squares of the wavefront error over the field."""


WORTH = 0.01
"""Share of the error that a constraint has to be worth, eased by a millimetre, to be spoken of."""

_KEYS = {"envelope": ("envelope",), "clearance": ("clearance",), "anamorphism": ("anamorphism",)}
"""Keys of the constraints that can be eased; the principal distance is held by what varies."""
_REMEDIES = {"envelope": "a larger envelope", "clearance": "a smaller clearance", "anamorphism": "more anamorphism"}


@dataclass(frozen=True, eq=False)
class DesignRun:
    """An optimised camera.

    Attributes:
        setup: what its file says.
        searched: what came of every start.
        text: the new camera's file.
        warnings: what its user should know.
    """

    setup: CameraDesignSetup
    searched: Search
    text: str
    warnings: tuple[str, ...] = ()

    @property
    def found(self) -> Design:
        """The best: prescription before and after."""
        return self.searched.best


def run_design(setup: CameraDesignSetup, backend: Backend, seed: int = 0, advance: Advance = silent) -> DesignRun:
    """Optimise the camera; the seed is that of the starts that are drawn.

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
        searched = search(
            backend,
            start,
            variables_of(test),
            beams,
            operands,
            test.steps,
            test.starts,
            seed,
            advance=lambda done, total: advance("optimise", done, total),
        )
    except DesignError as error:
        key = next((_KEYS[kind] for kind in error.violated if kind in _KEYS), ("vary",))
        remedies = [_REMEDIES[kind] for kind in _REMEDIES if kind in error.violated]
        raise BenchError(str(error), key, ", ".join([*remedies, "more to vary, or more starts"])) from error
    found = searched.best
    remark = REMARK.format(start=camera.name)
    if test.envelope is not None:
        remark += (
            f"\nIts extent along z is {100 * found.after.envelope / found.before.envelope:.2f} % of {camera.name}'s."
        )
    spec = camera_of(camera, found.prescription, test.name, test.description)
    derive_camera(spec, backend)  # it can be used as a camera
    warnings = []
    worst = float(found.after.errors.max())
    if worst > BLURRED:
        told = f"{worst:.3g} waves rms in its worst field, more than {BLURRED:g}"
        warnings.append(f"camera {spec.name} is blurred: {told}")
    if not found.converged:
        warnings.append(f"the search for {spec.name} was still getting better when it ended, after {ITERATIONS} steps")
    return DesignRun(setup, searched, spec.file_text(remark), tuple(warnings))


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
        "anamorphism": {"before": before.anamorphism, "after": after.anamorphism},
        "chief_ray_deg": {"before": _chief_rays(found, False), "after": _chief_rays(found, True)},
        "clearance_m": {"before": before.clearances.tolist(), "after": after.clearances.tolist()},
        "improved": found.improved,
        "held_by": [
            {
                "constraint": held.name,
                "limit_m": held.limit,
                "broken_at_start_m": max(held.start, 0.0),
                "worth_waves_per_mm": 1e-3 * held.worth,
            }
            for held in found.held
        ],
        "jacobians": found.evaluations,
        "converged": found.converged,
        "starts": [_start(attempt) for attempt in run.searched.attempts],
        "starts_at_best": run.searched.agreeing,
        "local_optimum": run.searched.local,
    }


def _start(attempt: Attempt) -> dict[str, Any]:
    """One start and what came of it."""
    found = attempt.design
    return {
        "drawn": attempt.drawn,
        "steps": attempt.steps,
        "wavefront_error_waves": None if found is None else rms_error(found.after),
        "worst_field_waves": None if found is None else float(found.after.errors.max()),
        "converged": found is not None and found.converged,
        "jacobians": None if found is None else found.evaluations,
        "problem": attempt.problem,
    }


def _chief_rays(found: Design, after: bool) -> list[float]:
    """Angles of the fields' chief rays from the normal of the focal plane, degrees."""
    prescription = found.prescription if after else found.begun
    direction = trace_beams(found.merit.backend, prescription, found.merit.beams).direction[:, 0]
    return np.degrees(np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), np.abs(direction[:, 2]))).tolist()


def agreement(run: DesignRun) -> str:
    """Whether other starts end at as good a camera; a sentence."""
    searched, count = run.searched, len(run.searched.attempts)
    if count == 1:
        return "A local optimum: from one start it is not known whether there is a better one (starts: 6 tries more)"
    failed = sum(attempt.design is None for attempt in searched.attempts)
    unheld = f", {failed} cannot hold the constraints" if failed else ""
    if not searched.local:
        return f"All {count} starts end within {100 * SAME:g} % of it"
    worst = max(attempt.error for attempt in searched.attempts if attempt.design is not None)
    return (
        f"A local optimum: of {count} starts {searched.agreeing} "
        f"{'ends' if searched.agreeing == 1 else 'end'} within {100 * SAME:g} % of the best, others at up to "
        f"{worst:.4f} waves{unheld}"
    )


def verdict(run: DesignRun) -> str:
    """Whether the camera has become better, and which constraints keep it from more; one sentence or two."""
    found, start, name = run.found, run.setup.camera.name, run.setup.test.name
    errors = f"{rms_error(found.after):.4f} waves rms over the field ({rms_error(found.before):.4f} in {start})"
    held = tuple(one for one in found.held if 1e-3 * one.worth > WORTH * rms_error(found.after))
    if found.improved:
        text = f"Improved: {name} has a wavefront error of {errors}"
        return f"{text}; more is held by {_held_text(held, start)}." if held else f"{text}."
    if held:
        return f"Not improved, held by {_held_text(held, start)}: a wavefront error of {errors}."
    return f"Not improved: nothing that varies makes {start} better; {name} has a wavefront error of {errors}."


def _held_text(held: tuple[Held, ...], start: str) -> str:
    """The dearest constraints, at most three, each with by how much."""
    parts = []
    for one in held[:3]:
        if one.name.startswith("anamorphism"):
            limit = f"{100 * one.limit:.4g} %"
        else:
            limit = f"{one.limit:.6g} m" if one.limit > 1.0 else f"{1e3 * one.limit:.4g} mm"
        text = f"the {one.name} ({limit}"
        if one.start > HELD:
            text += f", which {start} breaks by {1e3 * one.start:.3g} mm"
        parts.append(f"{text}; easing it by 1 mm is worth {1e-3 * one.worth:.2g} waves)")
    return " and ".join(parts)
