"""Optimisation of a camera's optical prescription from several starts with exact Jacobians, and its result file."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from optics.design import optimiser
from optics.design.merit_function import Evaluation, MeritFunction, Operands, Prescription, trace_beams
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models import camera_design
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import BLURRED
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.record import Quantity, Record

REMARK = """Prescription frame: z along the parent axis, light enters toward +z, y in the plane of symmetry, x along the
line CCD. Made by python -m twin.design from {start}: least squares of the wavefront error over the field."""
"""Comment at the top of the new camera's file."""


LEAST_BENEFIT = 0.01
"""Smallest benefit of easing a constraint for which the verdict names it.

The benefit is the decrease of the wavefront error per millimetre by which the constraint is eased, relative to the
error.
"""

_KEYS = {"envelope": ("envelope",), "clearance": ("clearance",), "anamorphism": ("anamorphism",)}
"""Constraint that can be eased -> its keys in the design's file.

The principal distance is not among them, since the variables hold it exactly.
"""
_REMEDIES = {"envelope": "a larger envelope", "clearance": "a smaller clearance", "anamorphism": "more anamorphism"}
"""Constraint that can be eased -> advice for the report."""


@dataclass(frozen=True, eq=False)
class DesignRun:
    """Result of the optimisation of a camera's prescription.

    Attributes
    ----------
    setup : CameraDesignSetup
        Specification of the design.
    searched : Search
        Results of the optimisation from all starts.
    text : str
        Text of the new camera's file.
    warnings : tuple of str
        Warnings for the user.
    """

    setup: camera_design.CameraDesignSetup
    searched: optimiser.Search
    text: str
    warnings: tuple[str, ...] = ()

    @property
    def best(self) -> optimiser.Design:
        """Design of smallest wavefront error among all starts, with the prescription before and after."""
        return self.searched.best


def run_design(
    setup: camera_design.CameraDesignSetup, backend: Backend, seed: int = 0, advance: Advance = silent
) -> DesignRun:
    """Optimise the prescription of the camera from several starts.

    Parameters
    ----------
    setup : CameraDesignSetup
        Specification of the design.
    backend : Backend
        Array backend of the ray trace.
    seed : int
        Seed of the random starts.
    advance : Advance
        Callback that reports progress.

    Raises
    ------
    InputError
        The camera passes no light.
    BenchError
        The constraints cannot be satisfied.
    """
    test, camera = setup.test, setup.camera
    start, beams = camera_design.prescription_of(camera), camera_design.beams_of(camera)
    try:
        first = MeritFunction.of(backend, start, beams, Operands(camera.wavelength)).evaluate(start)
    except (AimError, BeamMissedError) as error:
        problem = f"the beams of the design do not pass the camera: {str(error).partition(';')[0]}"
        raise camera.error(problem, ("mirrors",), allowed="a camera whose whole field gets light") from error
    operands = camera_design.operands_of(setup, first.principal_distance, first.envelope)
    try:
        variables, show = camera_design.variables_of(test), partial(advance, "optimise")
        searched = optimiser.search(
            backend, start, variables, beams, operands, test.steps, test.starts, seed, advance=show
        )
    except optimiser.DesignError as error:
        key = next((_KEYS[kind] for kind in error.violated if kind in _KEYS), ("vary",))
        remedies = [_REMEDIES[kind] for kind in _REMEDIES if kind in error.violated]
        least = float(MeritFunction.of(backend, start, beams, operands).evaluate(start).clearances.min(initial=np.inf))
        if "clearance" in error.violated and least < 0.0:
            # an on-axis telescope, whose secondary obstructs the beam
            remedies.insert(0, f"clearance: {np.floor(1e3 * least):g} mm, as {camera.name} obscures its own beams")
        raise BenchError(str(error), key, ", ".join([*remedies, "more to vary, or more starts"])) from error
    design = searched.best
    remark = REMARK.format(start=camera.name)
    if test.envelope is not None:
        remark += (
            f"\nIts extent along z is {100 * design.after.envelope / design.before.envelope:.2f} % of {camera.name}'s."
        )
    spec = camera_design.camera_of(camera, design.prescription, test.name, test.description)
    if camera.stop_diameter is not None:
        # its beams are as wide as the entrance pupil in the middle of the field
        free = derive_camera(spec.model_copy(update={"stop_diameter": None}), backend).first_order
        width = spec.entrance_pupil * np.sqrt(np.abs(np.linalg.det(free.entrance_magnification[0])))
        spec = spec.model_copy(update={"stop_diameter": float(width)})
    derive_camera(spec, backend)  # it can be used as a camera
    warnings = []
    worst = float(design.after.errors.max())
    if worst > BLURRED:
        text = f"{worst:.3g} waves rms in its worst field, more than {BLURRED:g}"
        warnings.append(f"camera {spec.name} is blurred: {text}")
    return DesignRun(setup, searched, spec.file_text(remark), tuple(warnings))


def _known(of: Callable[[optimiser.Design], Any]) -> Callable[[optimiser.Attempt], Any]:
    """Return a function that takes a number from the design reached from a start; None if none was reached."""
    return lambda attempt: None if attempt.design is None else of(attempt.design)


def _pair(of: Callable[[Evaluation], Any]) -> Callable[[DesignRun], Any]:
    """Return a function that takes a number of the camera before and after the optimisation, as a pair."""
    return lambda run: {"before": of(run.best.before), "after": of(run.best.after)}


def _chief_rays(run: DesignRun) -> dict[str, np.ndarray]:
    """Return the angles of all chief rays to the normal of the focal plane, radians, before and after."""
    design, merit = run.best, run.best.merit

    def angles(prescription: Prescription) -> np.ndarray:
        direction = trace_beams(merit.backend, prescription, merit.beams).direction[:, 0]
        return np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), np.abs(direction[:, 2]))

    return {"before": angles(design.initial), "after": angles(design.prescription)}


def _anamorphism(held: optimiser.ActiveConstraint) -> bool:
    return held.name.startswith("anamorphism")


ACTIVE_CONSTRAINT: Record[optimiser.ActiveConstraint] = Record(
    "An active constraint, which limits the camera.",
    Quantity("constraint", lambda held: held.name, "its name"),
    Quantity("limit_m", lambda held: None if _anamorphism(held) else held.limit, "its limit"),
    Quantity("limit_percent", lambda held: held.limit if _anamorphism(held) else None, "limit of the anamorphism"),
    Quantity("broken_at_start_m", lambda held: max(held.start, 0.0), "violation by the start"),
    Quantity(
        "sensitivity_waves_per_mm",
        lambda held: 1e-3 * held.sensitivity,
        "decrease of the error per millimetre of easing",
        converted=False,
    ),
)
START: Record[optimiser.Attempt] = Record(
    "One start of the search and its result.",
    Quantity("drawn", lambda attempt: attempt.drawn, "true if it was drawn at random"),
    Quantity("steps", lambda attempt: attempt.steps, "steps in which the constraints were brought in"),
    Quantity("wfe_rms_waves", _known(lambda optimised: optimiser.rms_error(optimised.after)), "rms over the field"),
    Quantity("wfe_worst_waves", _known(lambda optimised: optimised.after.errors.max()), "rms in the worst field"),
    Quantity("converged", lambda a: a.design is not None and a.design.converged, "true if the search converged"),
    Quantity("jacobians", _known(lambda optimised: optimised.evaluations), "Jacobians that were traced"),
    Quantity("problem", lambda attempt: attempt.problem, "why the constraints cannot be held, empty where they can"),
)


def _unsettled(run: DesignRun) -> str:
    return (
        f"the search for {run.setup.test.name} had not converged when it ended, after {optimiser.ITERATIONS} iterations"
    )


DESIGN: Record[DesignRun] = Record(
    "design.json: an optimised camera, before and after.",
    Quantity("camera", lambda run: run.setup.test.name, "name of the new camera"),
    Quantity("start", lambda run: run.setup.camera.name, "name of the camera that it was made from"),
    Quantity("wfe_rms_waves", _pair(lambda design: design.errors), "of every field, rms, without piston and tilt"),
    Quantity("fields_deg", lambda run: run.best.merit.beams.fields, "the fields, x and y"),
    Quantity("principal_distance_m", _pair(lambda design: design.principal_distance), "principal distance"),
    Quantity("envelope_m", _pair(lambda design: design.envelope), "extent along the axis"),
    Quantity(
        "anamorphism", _pair(lambda design: design.anamorphism), "focal length along the line over that across it"
    ),
    Quantity("chief_ray_deg", _chief_rays, "angle of the chief ray from the normal of the focal plane, by field"),
    Quantity("clearance_m", _pair(lambda design: design.clearances), "room between beams and edges, by passage"),
    Quantity("improved", lambda run: run.best.improved, "whether the new camera is better"),
    Quantity("active_constraints", lambda run: run.best.active, "the most costly first", record=ACTIVE_CONSTRAINT),
    Quantity("jacobians", lambda run: run.best.evaluations, "Jacobians that were traced for the best"),
    Quantity("converged", lambda run: run.best.converged, "true if the best search converged", warning=_unsettled),
    Quantity("starts", lambda run: run.searched.attempts, "results of all starts", record=START),
    Quantity("starts_at_best", lambda run: run.searched.agreeing, "starts that end within a share of the best"),
    Quantity("local_optimum", lambda run: run.searched.local, "whether starts end at different cameras"),
)


def difference_text(run: DesignRun) -> str:
    """Return a sentence on whether other starts end at an equally good camera."""
    searched, count = run.searched, len(run.searched.attempts)
    if count == 1:
        return "A local optimum: a single start does not show whether there is a better one (starts: 6 tries more)"
    failed = sum(attempt.design is None for attempt in searched.attempts)
    unheld = f", {failed} cannot hold the constraints" if failed else ""
    if not searched.local:
        return f"All {count} starts end within {100 * optimiser.SAME:g} % of the best"
    worst = max(attempt.error for attempt in searched.attempts if attempt.design is not None)
    return (
        f"A local optimum: of {count} starts {searched.agreeing} "
        f"{'ends' if searched.agreeing == 1 else 'end'} within {100 * optimiser.SAME:g} % of the best, others at up to "
        f"{worst:.4f} waves{unheld}"
    )


def verdict(run: DesignRun) -> str:
    """Return one or two sentences on whether the camera has improved, and which constraints limit it."""
    design, start, name = run.best, run.setup.camera.name, run.setup.test.name
    across = design.before.distance_across
    before, after = (f"{optimiser.rms_error(evaluation):.4f}" for evaluation in (design.before, design.after))
    errors = f"{after} waves rms over the field ({before} in {start})"
    held = tuple(
        constraint
        for constraint in design.active
        if 1e-3 * constraint.sensitivity > LEAST_BENEFIT * optimiser.rms_error(design.after)
    )
    if design.improved:
        text = f"Improved: {name} has a wavefront error of {errors}"
        return f"{text}; limited by {_held_text(held, start, across)}." if held else f"{text}."
    if held:
        return f"Not improved, limited by {_held_text(held, start, across)}: a wavefront error of {errors}."
    return f"Not improved: no variable makes {start} better; {name} has a wavefront error of {errors}."


def _held_text(held: tuple[optimiser.ActiveConstraint, ...], start: str, across: float) -> str:
    """Return a text on the constraints that cost most, at most three, each with its cost in wavefront error.

    Parameters
    ----------
    held : tuple of ActiveConstraint
        Constraints that are active in the optimised camera.
    start : str
        Name of the camera from which the design starts.
    across : float
        Its principal distance across the line, metres, to which the anamorphism refers.
    """
    parts = []
    for constraint in held[:3]:
        limit = f"{constraint.limit:.6g} m" if constraint.limit > 1.0 else f"{1e3 * constraint.limit:.4g} mm"
        step, unit = 1e-3, "mm"
        if _anamorphism(constraint):
            limit, step, unit = f"{100 * constraint.limit:.4g} %", 1e-2 * across, "%"
        text = f"the {constraint.name} ({limit}"
        if constraint.start > optimiser.MET:
            text += f", violated by {start} by {constraint.start / step:.3g} {unit}"
        parts.append(f"{text}; easing it by 1 {unit} reduces the error by {step * constraint.sensitivity:.2g} waves)")
    return " and ".join(parts)
