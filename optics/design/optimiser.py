"""Optimises a mirror prescription by least squares with exact Jacobians, under constraints.

Constraints are held by the shifted-penalty form of the method of multipliers: a violation g adds the residual
rho (g + u), and after each round u takes up what is left of g; so they hold exactly in the end without a penalty so
steep that it would hide the image errors. A much shorter envelope is reached in steps, each from the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, nnls

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
LEAST_GAIN = 1e-3
"""Share by which the rms error has to fall for a prescription to count as improved: where least squares ends."""
LOST = 1e3
"""Residual of everything when light does not get through, so that the step is refused."""

Advance = Callable[[int, int], None]


class DesignError(ValueError):
    """The constraints cannot be held together, or the start does not pass light."""


@dataclass(frozen=True)
class Held:
    """A constraint at which an optimised prescription stands.

    Attributes:
        name: what it is about.
        limit: what it asks for, metres.
        start: by how much the start broke it, metres; negative for room that the start had.
        worth: by how much the rms error over the fields would fall per metre that the limit is eased, waves/m, from the
            constraint's Lagrange multiplier.
    """

    name: str
    limit: float
    start: float
    worth: float


@dataclass(frozen=True, eq=False)
class Design:
    """An optimised prescription.

    Attributes:
        prescription: what came out.
        before, after: judgements of the start and of the result.
        variables: what was varied.
        merit: evaluated both; it names the passages.
        evaluations: traces with derivatives that it took.
        held: the constraints that keep it from being better, the dearest first.
    """

    prescription: Prescription
    before: Evaluation
    after: Evaluation
    variables: tuple[Variable, ...]
    merit: MeritFunction
    evaluations: int
    held: tuple[Held, ...] = ()

    @property
    def improved(self) -> bool:
        """Whether the rms error over the fields has fallen, by a thousandth at least."""
        return rms_error(self.after) < (1.0 - LEAST_GAIN) * rms_error(self.before)


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
    return Design(current, before, after, variables, merit, evaluations, held_by(merit, current, variables, before))


def rms_error(evaluation: Evaluation) -> float:
    """Rms error over the fields, waves."""
    return float(np.sqrt(np.mean(evaluation.errors**2)))


def held_by(
    merit: MeritFunction, prescription: Prescription, variables: tuple[Variable, ...], before: Evaluation
) -> tuple[Held, ...]:
    """Constraints that hold an optimum, by their Lagrange multipliers.

    At an optimum the slope of the mean square error is a sum of the slopes of the constraints at their limits, with
    weights that are not negative; each weight is what the error falls by when its limit is eased.

    Args:
        merit: with the constraints.
        prescription: optimised.
        variables: what was varied.
        before: the start.
    """
    there = merit.evaluate(prescription, variables)
    g, names = constraint_values(there, merit.operands)
    if not len(g):
        return ()
    assert there.d_residuals is not None
    size = _sizes(prescription, variables)
    fall = -2.0 * (there.d_residuals @ there.residuals) * size
    slopes = _constraint_slopes(there, merit.operands) * size[:, None]
    equal = merit.operands.principal_distance is not None
    at_limit = np.flatnonzero((g > -_AT_LIMIT) | (equal & (np.arange(len(g)) == 0)))
    columns = [slopes[:, k] for k in at_limit]
    owners = [int(k) for k in at_limit]
    if equal:  # held in both directions
        columns.append(-slopes[:, 0])
        owners.append(0)
    weights, _ = nnls(np.stack(columns, axis=1), fall)
    start = constraint_values(before, merit.operands)[0]
    worth: dict[int, float] = {}
    for owner, weight in zip(owners, weights, strict=True):
        worth[owner] = worth.get(owner, 0.0) + float(weight) / (2.0 * rms_error(there))
    limits = _limits(merit.operands, len(there.extents), len(there.clearances))
    told = _constraint_names(merit, prescription, names)
    found = [Held(told[k], limits[k], float(start[k]), gain) for k, gain in worth.items() if gain > 0.0]
    return tuple(sorted(found, key=lambda held: -held.worth))


def _limits(operands: Operands, extents: int, clearances: int) -> list[float]:
    """What every one of ``constraint_values`` asks for, metres."""
    out = [] if operands.principal_distance is None else [operands.principal_distance]
    out += [] if operands.envelope is None else [operands.envelope] * extents
    return out + ([] if operands.clearance is None else [operands.clearance] * clearances)


def _constraint_names(merit: MeritFunction, prescription: Prescription, names: Sequence[str]) -> list[str]:
    """Names that tell the constraints of one kind apart."""
    surfaces = ("scene", *prescription.names)
    passages = iter(merit.passages)
    count = len(prescription.names)
    pairs = iter([(i, j) for i in range(count) for j in range(count) if i != j])
    out = []
    for name in names:
        if name == "clearance":
            p = next(passages)
            way = f"{surfaces[p.stretch]} to {surfaces[p.stretch + 1]}"
            out.append(f"clearance of the beams from {way} beside {surfaces[p.surface]}")
        elif name == "envelope":
            i, j = next(pairs)
            out.append(f"envelope, from {prescription.names[j]} to {prescription.names[i]}")
        else:
            out.append(name)
    return out


_AT_LIMIT = 20e-6
"""Room, metres, below which a constraint is at its limit."""


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
    size = _sizes(start, variables)

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


def _sizes(prescription: Prescription, variables: Sequence[Variable]) -> np.ndarray:
    """By which variables are made dimensionless."""
    least = [_SMALLEST[v.quantity] for v in variables]
    return np.asarray(np.maximum(np.abs(prescription.values(variables)), least))


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
