"""Optimisation of a mirror prescription by constrained least squares with exact Jacobians, from one or several starts.

Constraints are linearised at every step and fulfilled exactly (``optics.design.optimiser``), so that
no penalty term balances image errors against constraints. A much shorter envelope (the extent of all surfaces along z)
is reached in steps, each from the one before. The result from one start is a local optimum, and another may be better;
``search`` tries several.

The first start is the prescription itself with the envelope shortened in steps, the second the same with it shortened
at once; others are random prescriptions about it, alternately in steps and at once.

Least squares under equality and inequality constraints, with exact Jacobians: sequential quadratic programming.

Every step solves a damped linear least-squares problem under the linearised constraints (by its dual, which is a
non-negative least-squares problem: Lawson and Hanson, Solving Least Squares Problems, chapter 23). Steps are judged by
the cost and the sum of all violations at a penalty above every multiplier (Han's exact penalty function). A
second-order correction solves the step's problem again with the residuals and constraints evaluated at its end, so that
curved constraints and a curved valley are followed and not cut short (Nocedal and Wright, Numerical Optimization, 2nd
ed., section 18.3). After a rejected step the damping is increased and a smaller fraction of the violations is removed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from optics.design.merit_function import BIAS, Beams, Evaluation, MeritFunction, Operands, Prescription, Variable
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-20, 1e6
"""Damping relative to the squared norms of the Jacobian's columns.

They are the first damping, the smallest one, and the one above which the search ends without a better point.
"""
_RIDGE = 1e-12
"""Number added to the unit diagonal of the dual problem, as constraints may be dependent or contradictory."""
_MAX_PENALTY = 1e3
"""Largest factor of the sum of violations in the merit; contradictory constraints have no finite multipliers."""
_MIN_GAIN_RATIO = 1e-3
"""Smallest ratio of actual to predicted decrease of the merit for which a step is accepted."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Residuals and constraints at one point x, a vector of V variables.

    Attributes
    ----------
    residuals : (R,) ndarray
        R residuals, the sum of whose squares is minimised.
    constraints : (C,) ndarray
        C constraints; fulfilled where zero (equations) or not positive (inequalities).
    d_residuals, d_constraints : ndarray, optional
        Derivatives (R, V) and (C, V) with respect to the variables; None where they were not requested.
    """

    residuals: np.ndarray
    constraints: np.ndarray
    d_residuals: np.ndarray | None = None
    d_constraints: np.ndarray | None = None

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(self.residuals @ self.residuals)


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a constrained least-squares search over V variables with C constraints.

    Attributes
    ----------
    x : (V,) ndarray
        Final point.
    sample : Sample
        Residuals and constraints there, with derivatives.
    multipliers : (C,) ndarray
        Lagrange multipliers, not negative for inequalities: decrease of the cost (half the sum of squared residuals)
        per unit by which a constraint is relaxed.
    converged : bool
        True when no further step improves the solution; False when the iterations were used up.
    jacobians : int
        Number of evaluations with derivatives.
    """

    x: np.ndarray
    sample: Sample
    multipliers: np.ndarray
    converged: bool
    jacobians: int


Evaluate = Callable[[np.ndarray, bool], Sample | None]
"""Function of x that returns residuals and constraints there, with derivatives if its second argument is true.

It returns None where x is not admissible, which rejects the step.
"""


def violations(constraints: np.ndarray, equal: np.ndarray) -> np.ndarray:
    """Return by how much C constraints (C,) are violated, not negative; ``equal`` (C,) is the mask of the equations."""
    return np.where(equal, np.abs(constraints), np.maximum(constraints, 0.0))


def constrained_least_squares(
    evaluate: Evaluate,
    start: np.ndarray,
    equal: np.ndarray,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    iterations: int = 100,
    tolerance: float = 1e-8,
    constraint_tolerance: float = 1e-8,
) -> Solution:
    """Minimise a sum of squares of V variables under C constraints, from a starting point.

    Parameters
    ----------
    evaluate : callable
        Function (x, with derivatives or not) -> ``Sample`` at x, or None where there is none.
    start : (V,) ndarray
        Starting point, between the bounds.
    equal : (C,) ndarray of bool
        Mask of the constraints that are equations.
    low : (V,) ndarray, optional
        Lower bounds of x, respected at every step; none by default.
    high : (V,) ndarray, optional
        Upper bounds of x, respected at every step; none by default.
    iterations : int
        Largest number of iterations, one Jacobian each.
    tolerance : float
        Relative decrease of the cost; the search ends after two successive steps that promise, or bring, less.
    constraint_tolerance : float
        Violation below which a constraint counts as fulfilled.

    Raises
    ------
    ValueError
        ``evaluate`` returns None at the start.
    """
    sample = evaluate(start, True)
    if sample is None:
        raise ValueError("the residuals cannot be evaluated at the starting point")
    x, count = np.asarray(start, dtype=float), len(start)
    low = np.full(count, -np.inf) if low is None else low
    high = np.full(count, np.inf) if high is None else high
    damping, stalled, jacobians, penalty = _FIRST_DAMPING, 0, 1, 0.0
    widths = np.zeros(count)
    multipliers = np.zeros(len(equal))
    for _ in range(iterations):
        assert sample.d_residuals is not None
        widths = np.maximum(widths, np.linalg.norm(sample.d_residuals, axis=0))
        fraction, factor, moved = 1.0, 2.0, False
        while True:
            model = _Model.of(sample, widths, damping, equal, (low - x, high - x))
            step, step_multipliers = model.solve(sample.residuals, sample.constraints, fraction)
            if fraction == 1.0:
                multipliers = step_multipliers
            penalty = max(penalty, min(2.0 * float(np.abs(step_multipliers).max(initial=0.0)), _MAX_PENALTY))
            start_merit, promised = _merit(sample, equal, penalty), model.promised(step, penalty)
            trial = evaluate(x + step, False)
            new_merit = _merit(trial, equal, penalty)
            if trial is not None:
                remains = trial.residuals - sample.d_residuals @ step, trial.constraints - model.slopes @ step
                second, _ = model.solve(*remains, fraction)
                corrected = _merit(evaluate(x + second, False), equal, penalty)
                if corrected < new_merit:
                    step, new_merit = second, corrected
            ratio = (start_merit - new_merit) / promised if promised > 0.0 else -1.0
            moved = ratio > _MIN_GAIN_RATIO
            if moved:
                damping *= max(0.1, 1.0 - (2.0 * min(ratio, 1.2) - 1.0) ** 3)
                damping = max(damping, _LEAST_DAMPING)
                break
            if promised <= tolerance * sample.cost or damping > _MOST_DAMPING:
                break
            damping, factor, fraction = damping * factor, 2.0 * factor, 0.5 * fraction
        violated = float(violations(sample.constraints, equal).max(initial=0.0))
        if not moved:
            return Solution(x, sample, multipliers, violated <= constraint_tolerance, jacobians)
        progress = max(promised, start_merit - new_merit) > tolerance * sample.cost or violated > constraint_tolerance
        new_sample = evaluate(x + step, True)
        assert new_sample is not None
        x, sample, jacobians, stalled = x + step, new_sample, jacobians + 1, 0 if progress else stalled + 1
        if stalled >= 2:
            return Solution(x, sample, multipliers, True, jacobians)
    return Solution(x, sample, multipliers, False, jacobians)


def _merit(sample: Sample | None, equal: np.ndarray, penalty: float) -> float:
    """Return the merit by which steps are judged: cost plus ``penalty`` times the sum of violations.

    It is infinite where there is no sample; ``equal`` is the mask of the constraints that are equations.
    """
    if sample is None or not np.all(np.isfinite(sample.residuals)):
        return np.inf
    return sample.cost + penalty * float(violations(sample.constraints, equal).sum())


@dataclass(frozen=True, eq=False)
class _Model:
    """Damped linear least-squares problem whose solution is one step of the search, under linearised constraints.

    It minimises |J p + r|^2 + |D p|^2 over the step p of V variables, with R residuals r, their Jacobian J (R, V), the
    diagonal damping D, and C constraints.

    Attributes
    ----------
    sample : Sample
        Sample at which the step begins.
    triangle : (V, V) ndarray
        Triangular factor of the QR decomposition of J stacked on D.
    basis : (R, V) ndarray
        Rows of its orthogonal factor Q that belong to J.
    equal : (C,) ndarray of bool
        Mask of the constraints that are equations.
    room : (ndarray, ndarray)
        Lower and upper bounds of the step, (V,) each.
    """

    sample: Sample
    triangle: np.ndarray
    basis: np.ndarray
    equal: np.ndarray
    room: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(
        cls, sample: Sample, widths: np.ndarray, damping: float, equal: np.ndarray, room: tuple[np.ndarray, np.ndarray]
    ) -> _Model:
        """Return the damped linear problem at a sample.

        ``widths`` (V,) are the largest norms of the Jacobian's V columns so far, to which the damping is relative.
        """
        assert sample.d_residuals is not None
        most = widths.max(initial=0.0)
        damp = np.sqrt(damping) * np.maximum(widths, 1e-8 * most if most > 0.0 else 1.0)
        basis, triangle = np.linalg.qr(np.concatenate([sample.d_residuals, np.diag(damp)]))
        return cls(sample, triangle, basis[: len(sample.residuals)], equal, room)

    @property
    def slopes(self) -> np.ndarray:
        """Derivatives (C, V) of the C constraints with respect to the V variables."""
        assert self.sample.d_constraints is not None
        return self.sample.d_constraints

    def solve(self, residuals: np.ndarray, constraints: np.ndarray, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the step (V,) of V variables and the multipliers (C,) of C constraints.

        ``residuals`` and ``constraints`` are those at the start of the step, and ``fraction`` is the fraction of the
        violations that the step has to remove. With R p = z - q, where R is ``triangle``, p the step and q the
        residuals times the transpose of ``basis``, the shortest z is computed: for equations by their pseudoinverse,
        for inequalities G z <= h by the dual problem, the y >= 0 with the smallest |G^T y|^2 / 2 + h y.
        """
        low, high = self.room
        eye = np.eye(len(low))
        upper, lower = np.isfinite(high), np.isfinite(low)
        targets = np.where(self.equal, fraction * constraints, np.where(constraints > 0.0, fraction, 1.0) * constraints)
        slopes = np.concatenate([self.slopes, eye[upper], -eye[lower]])
        targets = np.concatenate([targets, -high[upper], low[lower]])
        equal = np.concatenate([self.equal, np.zeros(len(targets) - len(self.equal), dtype=bool)])
        shift = self.basis.T @ residuals
        rotated = solve_triangular(self.triangle, slopes.T, trans="T").T
        targets = rotated @ shift - targets
        size = np.linalg.norm(rotated, axis=1)
        size = np.where(size > 0.0, size, 1.0)
        rotated, targets = rotated / size[:, None], targets / size
        multipliers = np.zeros(len(targets))
        inverse = np.linalg.pinv(rotated[equal])
        fixed = inverse @ targets[equal]
        z = fixed
        if not equal.all():
            free = np.eye(len(low)) - inverse @ rotated[equal]
            rows = rotated[~equal] @ free
            rest = targets[~equal] - rotated[~equal] @ fixed
            factor = np.linalg.cholesky(rows @ rows.T + _RIDGE * np.eye(len(rows)))
            goal = solve_triangular(factor, -rest, lower=True)
            multipliers[~equal] = nnls(factor.T, goal, maxiter=30 * len(rows))[0]
            z = fixed - rows.T @ multipliers[~equal]
        multipliers[equal] = -inverse.T @ (z + rotated[~equal].T @ multipliers[~equal])
        step = solve_triangular(self.triangle, z - shift)
        return np.clip(step, low, high), (multipliers / size)[: len(constraints)]

    def promised(self, step: np.ndarray, penalty: float) -> float:
        """Return the decrease of the merit that a step would bring if residuals and constraints were linear."""
        assert self.sample.d_residuals is not None
        linear = Sample(
            self.sample.residuals + self.sample.d_residuals @ step, self.sample.constraints + self.slopes @ step
        )
        return _merit(self.sample, self.equal, penalty) - _merit(linear, self.equal, penalty)


STEP_ITERATIONS = 4
"""Number of least-squares iterations at each step in which the envelope is shortened, before the last step.

They are enough to stay near the optimum of that length.
"""
ITERATIONS = 400
"""Largest number of least-squares iterations at the last step, at which the envelope has its required length."""
TOLERANCE = 1e-6
"""Relative decrease of the mean square error per iteration below which the search ends."""
MET = 2e-6
"""Largest violation of a constraint, metres, with which it still counts as fulfilled."""
MIN_GAIN = 1e-3
"""Smallest relative decrease of the rms error that counts as an improvement: the accuracy of the least squares."""

Advance = Callable[[int, int], None]


class DesignError(PhysicalError, ValueError):
    """The constraints cannot be fulfilled together, or no light passes the initial prescription.

    Attributes
    ----------
    violated : tuple of str
        Kinds of the violated constraints; first the one with the largest violation relative to its limit.
    """

    def __init__(self, problem: str, violated: tuple[str, ...] = ()) -> None:
        super().__init__(problem)
        self.violated = violated


@dataclass(frozen=True)
class ActiveConstraint:
    """Constraint that an optimised prescription just fulfils, so that relaxing it would reduce the error.

    Attributes
    ----------
    name : str
        Name of the constrained quantity.
    limit : float
        Limit, metres; for the anamorphism, relative to f.
    start : float
        Violation of the constraint in the initial prescription, metres (for the anamorphism, relative to f); negative
        where it was fulfilled with a margin.
    sensitivity : float
        Decrease of the rms error over the fields per metre by which the limit is relaxed, waves/m, from the
        constraint's Lagrange multiplier.
    """

    name: str
    limit: float
    start: float
    sensitivity: float


@dataclass(frozen=True, eq=False)
class Design:
    """Optimised prescription.

    Attributes
    ----------
    initial : Prescription
        Prescription with which it is compared.
    prescription : Prescription
        Optimised prescription.
    before, after : Evaluation
        Evaluations of both.
    variables : tuple of Variable
        Variables of the optimisation.
    merit : MeritFunction
        Merit function of both evaluations; it names the passages.
    evaluations : int
        Number of traces with derivatives.
    converged : bool
        True when the search ended at a local optimum; False when the iterations were used up.
    active : tuple of ActiveConstraint
        Active constraints, the most costly first.
    """

    initial: Prescription
    prescription: Prescription
    before: Evaluation
    after: Evaluation
    variables: tuple[Variable, ...]
    merit: MeritFunction
    evaluations: int
    converged: bool = True
    active: tuple[ActiveConstraint, ...] = ()

    @property
    def improved(self) -> bool:
        """True when the rms error over the fields has fallen by at least the fraction ``MIN_GAIN``."""
        return rms_error(self.after) < (1.0 - MIN_GAIN) * rms_error(self.before)


def _violations(
    operands: Operands, along: Any, across: Any, extents: np.ndarray, clearances: np.ndarray, factor: float = 1.0
) -> np.ndarray:
    """Return violations of C constraints (C,), metres; positive when violated.

    The first, of the principal distance, is an equation: it is violated with either sign.

    Parameters
    ----------
    operands : Operands
        Targets and limits.
    along : float or ndarray
        Principal distance along the line, metres.
    across : float or ndarray
        Principal distance across the line, metres.
    extents : (E,) ndarray
        Extents along z of E pairs of surfaces, metres.
    clearances : (P,) ndarray
        Distances between beams and the edges of surfaces, for P passages, metres.
    factor : float
        Factor by which the limits are multiplied: 1 for values. With 0, and with the derivatives of the quantities
        above with respect to V variables (last axis) instead of their values, the result is the derivatives of the
        violations, (C, V).
    """
    out: list[Any] = []
    if operands.principal_distance is not None:
        out.append(along - factor * operands.principal_distance)
    if operands.anamorphism is not None:
        out += [along - (1.0 + operands.anamorphism) * across, (1.0 - operands.anamorphism) * across - along]
    if operands.envelope is not None:
        # one constraint for each pair of surfaces, since the largest extent has a kink wherever two pairs are equal
        out += list(extents - factor * operands.envelope)
    if operands.clearance is not None:
        out += list(factor * operands.clearance - clearances)
    return np.array(out)


def _values(evaluation: Evaluation, operands: Operands) -> np.ndarray:
    """Return the violations of the C constraints in an evaluation, (C,), metres; positive when violated."""
    e = evaluation
    return _violations(operands, e.principal_distance, e.distance_across, e.extents, e.clearances)


def _slopes(evaluation: Evaluation, operands: Operands) -> np.ndarray:
    """Return the derivatives (V, C) of the violations of C constraints with respect to V variables."""
    e = evaluation
    assert e.d_residuals is not None
    assert e.d_extents is not None
    assert e.d_clearances is not None
    slopes = _violations(operands, e.d_principal_distance, e.d_distance_across, e.d_extents.T, e.d_clearances.T, 0.0)
    return np.ascontiguousarray(slopes.reshape(-1, len(e.d_residuals)).T)


def _limits(evaluation: Evaluation, operands: Operands) -> list[tuple[str, float]]:
    """Return the kind and the limit of each constraint, in metres; that of the anamorphism is relative."""
    limits = (
        ("principal distance", operands.principal_distance, 1),
        ("anamorphism", operands.anamorphism, 2),
        ("envelope", operands.envelope, len(evaluation.extents)),
        ("clearance", operands.clearance, len(evaluation.clearances)),
    )
    return [(kind, limit) for kind, limit, count in limits if limit is not None for _ in range(count)]


def _equations(operands: Operands, count: int) -> np.ndarray:
    """Return the mask (C,) of the C constraints that are equations and not inequalities."""
    return (operands.principal_distance is not None) & (np.arange(count) == 0)


def initial_merit(
    backend: Backend, start: Prescription, variables: Sequence[Variable], beams: Beams, operands: Operands
) -> tuple[MeritFunction, Evaluation]:
    """Return the merit function for designs that start from a prescription, and the evaluation of that prescription.

    Raises
    ------
    DesignError
        No light passes the start, or it violates a bound of a variable.
    """
    for variable, value in zip(variables, start.values(variables), strict=True):
        if not variable.low <= value <= variable.high:
            raise DesignError(f"{variable.name} starts at {value:.6g}, outside its bounds")
    try:
        merit = MeritFunction.of(backend, start, beams, operands)
        return merit, merit.evaluate(start)
    except (AimError, BeamMissedError) as error:
        raise DesignError(f"no light passes the initial prescription: {error}") from error


def descend(
    merit: MeritFunction,
    initial: Prescription,
    before: Evaluation,
    start: Prescription,
    variables: Sequence[Variable],
    steps: int = 1,
    iterations: int = ITERATIONS,
    advance: Advance | None = None,
) -> Design:
    """Return the local optimum that the constrained least squares reach from a start.

    ``start`` may differ from the prescription by which ``merit`` determined the sides on which beams pass surfaces.

    Parameters
    ----------
    merit : MeritFunction
        Merit function with the constraints.
    initial : Prescription
        Prescription with which the result is compared.
    before : Evaluation
        Evaluation of ``initial``.
    start : Prescription
        Prescription from which the search begins; it passes all light and is inside the bounds.
    variables : sequence of Variable
        Variables of the optimisation.
    steps : int
        Number of steps in which the envelope goes from that of the start to the required one.
    iterations : int
        Largest number of least-squares iterations at the last step.
    advance : callable, optional
        Called with (done, total) after each step.

    Raises
    ------
    DesignError
        The constraints cannot be fulfilled together.
    """
    variables, operands = tuple(variables), merit.operands
    current, evaluations, converged = start, 0, False
    first = merit.evaluate(start).envelope
    for step in range(1, steps + 1):
        relaxed = operands
        if operands.envelope is not None:
            relaxed = replace(operands, envelope=first + step / steps * (operands.envelope - first))
        limit = iterations if step == steps else min(STEP_ITERATIONS, iterations)
        current, used, converged = _step(replace(merit, operands=relaxed), current, variables, limit)
        evaluations += used
        if advance is not None:
            advance(step, steps)
    after = merit.evaluate(current)
    _require_fulfilled(merit, after)
    active = active_constraints(merit, current, variables, before)
    return Design(initial, current, before, after, variables, merit, evaluations, converged, active)


def _step(
    merit: MeritFunction, start: Prescription, variables: tuple[Variable, ...], iterations: int
) -> tuple[Prescription, int, bool]:
    """Run one constrained least-squares search from a prescription.

    Returned are the optimised prescription, the number of evaluations with derivatives, and True if the search
    converged.
    """
    size = _sizes(start, variables)

    def evaluate(x: np.ndarray, differentiate: bool) -> Sample | None:
        try:
            evaluation = merit.evaluate(start.with_values(variables, x * size), variables if differentiate else None)
        except (AimError, BeamMissedError):
            return None
        g = _values(evaluation, merit.operands)
        if evaluation.d_residuals is None:
            return Sample(evaluation.residuals, g)
        slopes = _slopes(evaluation, merit.operands) * size[:, None]
        return Sample(evaluation.residuals, g, evaluation.d_residuals.T * size, slopes.T)

    x0 = start.values(variables) / size
    equal = _equations(merit.operands, len(_values(merit.evaluate(start), merit.operands)))
    low, high = np.array([v.low for v in variables]) / size, np.array([v.high for v in variables]) / size
    evaluation = constrained_least_squares(evaluate, x0, equal, low, high, iterations, TOLERANCE, 0.1 * MET)
    return start.with_values(variables, evaluation.x * size), evaluation.jacobians, evaluation.converged


def rms_error(evaluation: Evaluation) -> float:
    """Return the rms error over the fields, in waves."""
    return float(np.sqrt(np.mean(evaluation.errors**2)))


def active_constraints(
    merit: MeritFunction, prescription: Prescription, variables: tuple[Variable, ...], before: Evaluation
) -> tuple[ActiveConstraint, ...]:
    """Return the constraints that limit an optimum, with the decrease of the error if each were relaxed.

    At an optimum the gradient of the mean square error is a combination of the gradients of the active constraints,
    with weights (Lagrange multipliers) that are not negative; each weight is the decrease of the error when its limit
    is relaxed.

    Parameters
    ----------
    merit : MeritFunction
        Merit function with the constraints.
    prescription : Prescription
        Optimised prescription.
    variables : tuple of Variable
        Variables of the optimisation.
    before : Evaluation
        Evaluation of the start.
    """
    evaluation = merit.evaluate(prescription, variables)
    g, limits = _values(evaluation, merit.operands), _limits(evaluation, merit.operands)
    if not limits:
        return ()
    assert evaluation.d_residuals is not None
    size = _sizes(prescription, variables)
    gradient = -2.0 * (evaluation.d_residuals @ evaluation.residuals) * size
    slopes = _slopes(evaluation, merit.operands) * size[:, None]
    equal = _equations(merit.operands, len(g))
    at_limit = np.flatnonzero((g > -_AT_LIMIT) | equal)
    columns = [slopes[:, k] for k in at_limit]
    owners = [int(k) for k in at_limit]
    if equal.any():  # an equation acts in both directions
        columns.append(-slopes[:, 0])
        owners.append(0)
    weights, _ = nnls(np.stack(columns, axis=1), gradient)
    start = _values(before, merit.operands)
    gains: dict[int, float] = {}
    for owner, weight in zip(owners, weights, strict=True):
        gains[owner] = gains.get(owner, 0.0) + float(weight) / (2.0 * rms_error(evaluation))
    names = _constraint_names(merit, prescription, [kind for kind, _ in limits])
    constraints = [
        ActiveConstraint(names[k], limits[k][1], float(start[k]), gain) for k, gain in gains.items() if gain > 0.0
    ]
    return tuple(sorted(constraints, key=lambda constraint: -constraint.sensitivity))


def _constraint_names(merit: MeritFunction, prescription: Prescription, names: Sequence[str]) -> list[str]:
    """Return a distinct name for each constraint: its kind, and the surfaces if there are several of a kind."""
    surfaces = ("scene", *prescription.names)
    passages = iter(merit.passages)
    sides = iter(("long", "short"))
    count = len(prescription.names)
    pairs = iter([(i, j) for i in range(count) for j in range(count) if i != j])
    out = []
    for name in names:
        if name == "clearance":
            p = next(passages)
            segment = f"{surfaces[p.segment]} to {surfaces[p.segment + 1]}"
            out.append(f"clearance of the beams from {segment} beside {surfaces[p.surface]}")
        elif name == "envelope":
            i, j = next(pairs)
            out.append(f"envelope, from {prescription.names[j]} to {prescription.names[i]}")
        elif name == "anamorphism":
            out.append(f"anamorphism, f along the line too {next(sides)} for f across")
        else:
            out.append(name)
    return out


_AT_LIMIT = 20e-6
"""Largest distance of a constrained quantity from its limit, metres, with which the constraint counts as active."""


def _sizes(prescription: Prescription, variables: Sequence[Variable]) -> np.ndarray:
    """Return the typical size of each variable in its SI unit, by which its values are scaled in the least squares."""
    least = [_SMALLEST[v.quantity] for v in variables]
    return np.asarray(np.maximum(np.abs(prescription.values(variables)), least))


_SMALLEST = {"conic": 1.0, "z": 0.1}
_SMALLEST |= dict.fromkeys(("A4", "A6", "A8"), 1e-3) | dict.fromkeys(("curvature", "y", "tilt", "field_bias"), 1e-2)
"""Quantity -> smallest typical size of a variable of this kind in its SI unit, for scaling in the least squares."""


def _require_fulfilled(merit: MeritFunction, after: Evaluation) -> None:
    """Raise DesignError that names the violated constraints, the worst first, if there are any."""
    g, constraints = _values(after, merit.operands), _limits(after, merit.operands)
    names = [kind for kind, _ in constraints]
    violated = np.where(_equations(merit.operands, len(g)), np.abs(g), g)
    kinds = tuple(dict.fromkeys(name for value, name in zip(violated, names, strict=True) if not value < 50.0 * MET))
    if not kinds:
        return
    worst = {kind: max((k for k, name in enumerate(names) if name == kind), key=violated.__getitem__) for kind in kinds}
    limits = np.abs([limit for _, limit in constraints])
    limits = np.where(np.array(names) == "anamorphism", limits * after.distance_across, limits)
    kinds = tuple(sorted(kinds, key=lambda kind: -violated[worst[kind]] / max(limits[worst[kind]], MET)))
    violation = {
        kind: f"{100.0 * g[k] / after.distance_across:.3g} %" if kind == "anamorphism" else f"{1e3 * g[k]:.3g} mm"
        for kind, k in worst.items()
    }
    parts = [f"{kind} (off by {violation[kind]})" for kind in kinds]
    raise DesignError(
        f"no prescription near the start fulfils all constraints: {', '.join(parts)}; allow a longer envelope, less "
        "clearance, a larger field bias, or more variables",
        kinds,
    )


SAME = 0.01
"""Relative difference of the rms error within which two starts count as having reached equally good prescriptions."""
DRAWS_PER_SPREAD = 8
"""Number of random starts that may fail in a row before their spread about the nominal prescription is halved."""
_SHARE = {"curvature": 0.01, "A4": 0.3, "A6": 0.3, "A8": 0.3}
"""Quantity -> standard deviation of its random change in a random start, relative to its value in the nominal design.

For an aspheric coefficient it is relative to the largest nominal coefficient of that order among the varied surfaces.
"""
_SPREAD = {"conic": 0.3, "y": 1e-3, "tilt": 1e-3, BIAS: 1e-3}
"""Quantity -> standard deviation of its random change in a random start, SI units, for quantities not in ``_SHARE``."""
_POSITION_SPREAD = 0.01
"""Standard deviation of the random change of positions along z in a random start, relative to the envelope's length."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """Result of one start.

    Attributes
    ----------
    drawn : bool
        True when the start was random; False when it is the prescription itself.
    steps : int
        Number of steps in which the envelope was shortened from its initial to the required length.
    design : Design, optional
        Result; None where the constraints could not be fulfilled.
    problem : str
        Reason of the failure; empty without one.
    """

    drawn: bool
    steps: int
    design: Design | None
    problem: str = ""

    @property
    def error(self) -> float:
        """Rms error over the fields, waves; infinite where the constraints are not fulfilled."""
        return np.inf if self.design is None else rms_error(self.design.after)


@dataclass(frozen=True, eq=False)
class Search:
    """Results of several starts.

    Attributes
    ----------
    attempts : tuple of Attempt
        One for each start, in their order.
    """

    attempts: tuple[Attempt, ...]

    @property
    def best(self) -> Design:
        """Design with the smallest rms error over the fields; of equal ones, that of the earliest start."""
        design = min(self.attempts, key=lambda attempt: attempt.error).design
        assert design is not None
        return design

    @property
    def agreeing(self) -> int:
        """Number of starts whose final rms error is within the fraction ``SAME`` of the best one's, itself included."""
        least = rms_error(self.best.after)
        return sum(attempt.error <= (1.0 + SAME) * least for attempt in self.attempts)

    @property
    def local(self) -> bool:
        """True when only a local optimum is known: there was one start, or starts ended at different optima."""
        return len(self.attempts) == 1 or self.agreeing < len(self.attempts)


def search(
    backend: Backend,
    start: Prescription,
    variables: Sequence[Variable],
    beams: Beams,
    operands: Operands,
    steps: int = 1,
    starts: int = 1,
    seed: int = 0,
    iterations: int = ITERATIONS,
    advance: Advance | None = None,
) -> Search:
    """Optimise a prescription from several starts.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    start : Prescription
        First start; beams keep to the sides of surfaces on which they pass there.
    variables : sequence of Variable
        Variables with their bounds.
    beams : Beams
        Fields and pupil.
    operands : Operands
        Merit and constraints.
    steps : int
        Number of steps of the envelope from the start's to the required one, for every other start.
    starts : int
        Number of starts.
    seed : int
        Seed of the starts drawn at random; the n-th start does not depend on their number.
    iterations : int
        Largest number of least-squares iterations at the last step of each start.
    advance : callable, optional
        Called with (done, total) after each step.

    Raises
    ------
    DesignError
        No light passes the start, it violates a bound, or the constraints cannot be fulfilled together from any start.
    """
    variables = tuple(variables)
    merit, before = initial_merit(backend, start, variables, beams, operands)
    if operands.envelope is None:
        steps = 1
    plan = [(number, steps if number % 2 == 0 else 1) for number in range(starts)]
    total, done = sum(count for _, count in plan), 0
    attempts, first = [], None
    for number, count in plan:
        drawn = number > int(steps > 1)
        initial = drawn_start(merit, start, variables, np.random.default_rng([seed, number])) if drawn else start

        def report(step: int, _: int, done: int = done) -> None:
            if advance is not None:
                advance(done + step, total)

        try:
            design, problem = descend(merit, start, before, initial, variables, count, iterations, report), ""
        except DesignError as error:
            design, problem, first = None, str(error), first or error
        attempts.append(Attempt(drawn, count, design, problem))
        done += count
    if first is not None and all(attempt.design is None for attempt in attempts):
        raise first
    return Search(tuple(attempts))


def drawn_start(
    merit: MeritFunction, nominal: Prescription, variables: Sequence[Variable], rng: np.random.Generator
) -> Prescription:
    """Return a prescription with random variables about a nominal one, through which light passes.

    The spread is halved whenever ``DRAWS_PER_SPREAD`` random prescriptions in a row pass no light.

    Parameters
    ----------
    merit : MeritFunction
        Merit function whose beams have to pass.
    nominal : Prescription
        Prescription about which the random ones are distributed.
    variables : sequence of Variable
        Variables that are random, inside their bounds.
    rng : np.random.Generator
        Random number generator.
    """
    values = nominal.values(variables)
    envelope = merit.evaluate(nominal).envelope
    kinds = {v.quantity for v in variables}
    largest = {k: max(abs(x) for v, x in zip(variables, values, strict=True) if v.quantity == k) for k in kinds}
    spread = np.empty(len(values))
    for n, (variable, value) in enumerate(zip(variables, values, strict=True)):
        kind = variable.quantity
        if kind == "z":
            spread[n] = _POSITION_SPREAD * envelope
        elif kind in _SHARE:
            spread[n] = _SHARE[kind] * (abs(value) if kind == "curvature" else largest[kind])
        else:
            spread[n] = _SPREAD[kind]
    low, high = np.array([v.low for v in variables]), np.array([v.high for v in variables])
    while True:
        for _ in range(DRAWS_PER_SPREAD):
            drawn = np.clip(values + spread * rng.standard_normal(len(values)), low, high)
            candidate = nominal.with_values(variables, drawn)
            try:
                merit.evaluate(candidate)
            except (AimError, BeamMissedError):
                continue
            return candidate
        spread = 0.5 * spread
