"""Least squares under equality and inequality constraints, with exact Jacobians: sequential quadratic programming.

Every step solves a damped linear least-squares problem under the linearised constraints (by its dual, which is a
non-negative least-squares problem: Lawson and Hanson, Solving Least Squares Problems, chapter 23). Steps are judged by
the cost and the sum of all violations at a penalty above every multiplier (Han's exact penalty function). A
second-order correction solves the step's problem again with the residuals and constraints evaluated at its end, so that
curved constraints and a curved valley are followed and not cut short (Nocedal and Wright, Numerical Optimization, 2nd
ed., section 18.3). After a rejected step the damping is increased and a smaller fraction of the violations is removed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

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
