"""Optimises a mirror prescription by least squares with exact Jacobians, under constraints.

Constraints are held by the shifted-penalty form of the method of multipliers: a violation g adds the residual
rho (g + u), and after each round u takes up what is left of g; so they hold exactly in the end without a penalty so
steep that it would hide the image errors. A much shorter envelope is reached in steps, each from the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from optics.design.design_rays import Beams
from optics.design.design_variables import Prescription, Variable
from optics.design.merit_function import Evaluation, MeritFunction, Operands
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError

PENALTY = 300.0
"""Residual per metre of violation at the first round: 0.3 waves rms for 1 mm."""
STEEPER = 3.0
ROUNDS = 10
HELD = 2e-6
"""Violation, metres, below which a constraint counts as held."""
LOST = 1e3
"""Residual of everything when light does not get through, so that the step is refused."""

Advance = Callable[[int, int], None]


class DesignError(ValueError):
    """The constraints cannot be held together, or the start does not pass light."""


@dataclass(frozen=True, eq=False)
class Design:
    """An optimised prescription.

    Attributes:
        prescription: what came out.
        before, after: judgements of the start and of the result.
        variables: what was varied.
        merit: evaluated both; it names the passages.
        evaluations: traces with derivatives that it took.
    """

    prescription: Prescription
    before: Evaluation
    after: Evaluation
    variables: tuple[Variable, ...]
    merit: MeritFunction
    evaluations: int


def constraint_values(evaluation: Evaluation, operands: Operands) -> tuple[np.ndarray, list[str]]:
    """Violations (C,), metres, positive when violated (the first, of the principal distance, in both directions), and
    what each is about.
    """
    out, names = [], []
    if operands.principal_distance is not None:
        out.append(evaluation.principal_distance - operands.principal_distance)
        names.append("principal distance")
    if operands.envelope is not None:
        # one constraint for each pair of surfaces: their largest alone would have a kink wherever two pairs are equal
        out += list(evaluation.extents - operands.envelope)
        names += ["envelope"] * len(evaluation.extents)
    if operands.clearance is not None:
        out += list(operands.clearance - evaluation.clearances)
        names += ["clearance"] * len(evaluation.clearances)
    return np.array(out), names


def _constraint_slopes(evaluation: Evaluation, operands: Operands) -> np.ndarray:
    """Derivatives of the violations, (V, C)."""
    assert evaluation.d_residuals is not None
    columns: list[np.ndarray] = []
    if operands.principal_distance is not None:
        assert evaluation.d_principal_distance is not None
        columns.append(evaluation.d_principal_distance)
    if operands.envelope is not None:
        assert evaluation.d_extents is not None
        columns += list(evaluation.d_extents.T)
    if operands.clearance is not None:
        assert evaluation.d_clearances is not None
        columns += list(-evaluation.d_clearances.T)
    return np.stack(columns, axis=1) if columns else np.zeros((len(evaluation.d_residuals), 0))


def optimise(
    backend: Backend,
    start: Prescription,
    variables: Sequence[Variable],
    beams: Beams,
    operands: Operands,
    steps: int = 1,
    iterations: int = 60,
    advance: Advance | None = None,
) -> Design:
    """Optimise a prescription.

    Args:
        backend: where to trace.
        start: where to begin; it must pass all light.
        variables: what may vary, and within which bounds.
        beams: fields and pupil.
        operands: merit and constraints.
        steps: of the envelope from the start's to the goal's.
        iterations: of least squares, at most, in each round.
        advance: told (done, total) after each round of the last step, or each step before it.

    Raises:
        DesignError: the start passes no light or breaks a bound, or constraints cannot be held together.
    """
    variables = tuple(variables)
    x = start.values(variables)
    for variable, value in zip(variables, x, strict=True):
        if not variable.low <= value <= variable.high:
            raise DesignError(f"{variable.name} starts at {value:.6g}, outside its bounds")
    try:
        merit = MeritFunction.of(backend, start, beams, operands)
        before = merit.evaluate(start)
    except (AimError, BeamMissedError) as error:
        raise DesignError(f"the prescription that the design starts from passes no light: {error}") from error
    evaluations, current = 0, start
    total = steps + ROUNDS
    for step in range(1, steps + 1):
        eased = operands
        if operands.envelope is not None:
            share = step / steps
            eased = replace(operands, envelope=before.envelope + share * (operands.envelope - before.envelope))
        own = replace(merit, operands=eased)
        shift: np.ndarray | None = None
        penalty = PENALTY
        rounds = ROUNDS if step == steps else 1
        for turn in range(rounds):
            current, spent, shift, worst = _round(own, current, variables, shift, penalty, iterations)
            evaluations += spent
            if advance is not None:
                advance(steps + turn if step == steps else step, total)
            if worst < HELD and turn >= 1:
                break
            penalty *= STEEPER
    after = merit.evaluate(current)
    _require_held(merit, after)
    if advance is not None:
        advance(total, total)
    return Design(current, before, after, variables, merit, evaluations)


def _round(
    merit: MeritFunction,
    start: Prescription,
    variables: tuple[Variable, ...],
    shift: np.ndarray | None,
    penalty: float,
    iterations: int,
) -> tuple[Prescription, int, np.ndarray, float]:
    """One least-squares solution; the prescription, evaluations, new shifts and the worst violation, metres."""
    equal = merit.operands.principal_distance is not None
    last: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    x0 = start.values(variables)
    size = np.maximum(np.abs(x0), [_SMALLEST[v.quantity] for v in variables])

    def both(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if "at" in last and np.array_equal(last["at"][0], u):
            return last["at"][1:]
        try:
            evaluated = merit.evaluate(start.with_values(variables, u * size), variables)
        except (AimError, BeamMissedError):
            value, slope = last["at"][1:]
            return np.full_like(value, LOST), slope
        assert evaluated.d_residuals is not None
        g, _ = constraint_values(evaluated, merit.operands)
        shifted = g + (0.0 if shift is None else shift)
        active = shifted > 0.0
        if equal:
            active[0] = True
        bound = penalty * np.where(active, shifted, 0.0)
        slopes = penalty * np.where(active, _constraint_slopes(evaluated, merit.operands), 0.0)
        value = np.concatenate([evaluated.residuals, bound])
        slope = np.concatenate([evaluated.d_residuals, slopes], axis=1).T * size
        last["at"] = (u.copy(), value, slope)
        return value, slope

    bounds = (np.array([v.low for v in variables]) / size, np.array([v.high for v in variables]) / size)
    both(x0 / size)
    found = least_squares(
        lambda u: both(u)[0],
        x0 / size,
        lambda u: both(u)[1],
        bounds,
        x_scale="jac",
        max_nfev=iterations,
        ftol=1e-6,
        xtol=1e-13,
        gtol=1e-13,
    )
    ended = start.with_values(variables, found.x * size)
    g, _ = constraint_values(merit.evaluate(ended), merit.operands)
    moved = g + (0.0 if shift is None else shift)
    moved = np.concatenate([moved[: int(equal)], np.maximum(moved[int(equal) :], 0.0)]) / STEEPER
    worst = np.maximum(g, 0.0)
    if equal:
        worst[0] = abs(g[0])
    return ended, int(found.njev), moved, float(worst.max(initial=0.0))


_SMALLEST = {
    "curvature": 1e-2,
    "conic": 1.0,
    "A4": 1e-3,
    "A6": 1e-3,
    "A8": 1e-3,
    "z": 0.1,
    "y": 0.01,
    "tilt": 0.01,
    "field_bias": 0.01,
}
"""Least sizes by which variables are made dimensionless."""


def _require_held(merit: MeritFunction, after: Evaluation) -> None:
    """Raise DesignError that names the constraints which are not held."""
    g, names = constraint_values(after, merit.operands)
    failed = []
    for value, name in zip(g, names, strict=True):
        if (abs(value) if name == "principal distance" else value) > 50.0 * HELD:
            failed.append((name, float(value)))
    if not failed:
        return
    parts = []
    for name in dict.fromkeys(name for name, _ in failed):
        worst = max((value for own, value in failed if own == name), key=abs)
        parts.append(f"{name} (off by {1e3 * worst:.3g} mm)")
    raise DesignError(
        f"no prescription near the start holds all constraints: {', '.join(parts)}; allow a longer envelope, less "
        "clearance, a larger field bias, or more variables"
    )
