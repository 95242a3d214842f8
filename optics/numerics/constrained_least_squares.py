"""Least squares under equations and inequalities, with exact Jacobians: sequential quadratic programming.

Every step solves a damped linear least squares problem under the linearised constraints (by its dual, which is a
non-negative least squares problem: Lawson and Hanson, Solving Least Squares Problems, chapter 23). Steps are judged by
the cost and the sum of all violations at a price above every multiplier (Han's exact penalty). A second-order
correction solves the step's problem again with the residuals and constraints that were found where it ended, so that
curved constraints and a curved valley are followed and not cut short (Nocedal and Wright, Numerical Optimization,
2nd ed., section 18.3). A step that is refused is damped more and asked for a smaller share of what is violated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-20, 1e6
"""Damping relative to the squares of the Jacobian's columns: at first, at least, and where no better place is near."""
_RIDGE = 1e-12
"""Added to the unit diagonal of the dual problem: constraints may depend on each other, or contradict each other."""
_DEAREST = 1e3
"""Largest price of a violation: constraints that contradict each other have no multipliers."""
_ACCEPTED = 1e-3
"""Least share of what a step promised that it has to keep."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Residuals and constraints at one place, R and C of them.

    Attributes
    ----------
    residuals : np.ndarray
        (R,).
    constraints : np.ndarray
        (C,), each zero (equations) or not above zero (inequalities) where it is held.
    d_residuals, d_constraints : np.ndarray | None
        Derivatives (R, V), (C, V); None where they were not asked for.
    """

    residuals: np.ndarray
    constraints: np.ndarray
    d_residuals: np.ndarray | None = None
    d_constraints: np.ndarray | None = None

    @property
    def cost(self) -> float:
        """Half the sum of squares."""
        return 0.5 * float(self.residuals @ self.residuals)


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a search ended.

    Attributes
    ----------
    x : np.ndarray
        (V,).
    sample : Sample
        There, with derivatives.
    multipliers : np.ndarray
        Of the constraints (C,), not negative for inequalities: by how much the cost falls per unit by which the
        constraint is eased.
    converged : bool
        Whether it ended because no step is worth taking, not for want of iterations.
    jacobians : int
        Samples with derivatives that it took.
    """

    x: np.ndarray
    sample: Sample
    multipliers: np.ndarray
    converged: bool
    jacobians: int


Evaluate = Callable[[np.ndarray, bool], Sample | None]
"""Sample at x, with derivatives if the second argument is true; None where there is nothing (the step is refused)."""


def violations(constraints: np.ndarray, equal: np.ndarray) -> np.ndarray:
    """By how much constraints (C,) are violated, not negative; ``equal`` (C,) tells which are equations."""
    return np.where(equal, np.abs(constraints), np.maximum(constraints, 0.0))


def constrained_least_squares(
    evaluate: Evaluate,
    start: np.ndarray,
    equal: np.ndarray,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    iterations: int = 100,
    tolerance: float = 1e-8,
    held: float = 1e-8,
) -> Solution:
    """Least sum of squares under constraints, near a start.

    Parameters
    ----------
    evaluate : Evaluate
        Residuals and constraints.
    start : np.ndarray
        (V,), between the bounds.
    equal : np.ndarray
        Which constraints are equations, (C,).
    low : np.ndarray | None
        Least x, (V,), held at every step; None for none.
    high : np.ndarray | None
        Largest x, likewise.
    iterations : int
        At most, one Jacobian each.
    tolerance : float
        Ends where two steps after each other promise, or bring, less than this share of the cost.
    held : float
        Violation that counts as none.

    Raises
    ------
    ValueError
        There is nothing at the start.
    """
    here = evaluate(start, True)
    if here is None:
        raise ValueError("least squares have to start where there are residuals")
    x, count = np.asarray(start, dtype=float), len(start)
    low = np.full(count, -np.inf) if low is None else low
    high = np.full(count, np.inf) if high is None else high
    damping, idle, jacobians, price = _FIRST_DAMPING, 0, 1, 0.0
    widths = np.zeros(count)
    multipliers = np.zeros(len(equal))
    for _ in range(iterations):
        assert here.d_residuals is not None
        widths = np.maximum(widths, np.linalg.norm(here.d_residuals, axis=0))
        share, growth, moved = 1.0, 2.0, False
        while True:
            model = _Model.of(here, widths, damping, equal, (low - x, high - x))
            step, found = model.solve(here.residuals, here.constraints, share)
            if share == 1.0:
                multipliers = found
            price = max(price, min(2.0 * float(np.abs(found).max(initial=0.0)), _DEAREST))
            start_merit, promised = _merit(here, equal, price), model.promised(step, price)
            trial = evaluate(x + step, False)
            taken = _merit(trial, equal, price)
            if trial is not None:
                remains = trial.residuals - here.d_residuals @ step, trial.constraints - model.slopes @ step
                second, _ = model.solve(*remains, share)
                corrected = _merit(evaluate(x + second, False), equal, price)
                if corrected < taken:
                    step, taken = second, corrected
            ratio = (start_merit - taken) / promised if promised > 0.0 else -1.0
            moved = ratio > _ACCEPTED
            if moved:
                damping *= max(0.1, 1.0 - (2.0 * min(ratio, 1.2) - 1.0) ** 3)
                damping = max(damping, _LEAST_DAMPING)
                break
            if promised <= tolerance * here.cost or damping > _MOST_DAMPING:
                break
            damping, growth, share = damping * growth, 2.0 * growth, 0.5 * share
        violated = float(violations(here.constraints, equal).max(initial=0.0))
        if not moved:
            return Solution(x, here, multipliers, violated <= held, jacobians)
        worth = max(promised, start_merit - taken) > tolerance * here.cost or violated > held
        there = evaluate(x + step, True)
        assert there is not None
        x, here, jacobians, idle = x + step, there, jacobians + 1, 0 if worth else idle + 1
        if idle >= 2:
            return Solution(x, here, multipliers, True, jacobians)
    return Solution(x, here, multipliers, False, jacobians)


def _merit(sample: Sample | None, equal: np.ndarray, price: float) -> float:
    """Cost and the price of violations; infinite where there is nothing."""
    if sample is None or not np.all(np.isfinite(sample.residuals)):
        return np.inf
    return sample.cost + price * float(violations(sample.constraints, equal).sum())


@dataclass(frozen=True, eq=False)
class _Model:
    """A step's problem: least squares damped by D, min |J p + r|^2 + |D p|^2, under linearised constraints.

    Attributes
    ----------
    sample : Sample
        Where the step begins.
    triangle : np.ndarray
        R of the QR decomposition of J above D, (V, V).
    basis : np.ndarray
        Its Q, (R, V), of the rows of J.
    equal : np.ndarray
        Which constraints are equations.
    room : tuple[np.ndarray, np.ndarray]
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
        assert sample.d_residuals is not None
        most = widths.max(initial=0.0)
        damp = np.sqrt(damping) * np.maximum(widths, 1e-8 * most if most > 0.0 else 1.0)
        basis, triangle = np.linalg.qr(np.concatenate([sample.d_residuals, np.diag(damp)]))
        return cls(sample, triangle, basis[: len(sample.residuals)], equal, room)

    @property
    def slopes(self) -> np.ndarray:
        """Derivatives of the constraints, (C, V)."""
        assert self.sample.d_constraints is not None
        return self.sample.d_constraints

    def solve(self, residuals: np.ndarray, constraints: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """The step (V,) and the multipliers (C,) if residuals and constraints at its foot were these.

        With R p = z - q, where q is Q^T r, it is the shortest z that takes away a ``share`` of what is violated:
        equations by their pseudoinverse, inequalities G z <= h by the dual, y >= 0 with least |G^T y|^2 / 2 + h y.
        """
        low, high = self.room
        eye = np.eye(len(low))
        upper, lower = np.isfinite(high), np.isfinite(low)
        aims = np.where(self.equal, share * constraints, np.where(constraints > 0.0, share, 1.0) * constraints)
        slopes = np.concatenate([self.slopes, eye[upper], -eye[lower]])
        aims = np.concatenate([aims, -high[upper], low[lower]])
        equal = np.concatenate([self.equal, np.zeros(len(aims) - len(self.equal), dtype=bool)])
        shift = self.basis.T @ residuals
        turned = solve_triangular(self.triangle, slopes.T, trans="T").T
        aims = turned @ shift - aims
        size = np.linalg.norm(turned, axis=1)
        size = np.where(size > 0.0, size, 1.0)
        turned, aims = turned / size[:, None], aims / size
        multipliers = np.zeros(len(aims))
        inverse = np.linalg.pinv(turned[equal])
        fixed = inverse @ aims[equal]
        z = fixed
        if not equal.all():
            free = np.eye(len(low)) - inverse @ turned[equal]
            rows = turned[~equal] @ free
            rest = aims[~equal] - turned[~equal] @ fixed
            factor = np.linalg.cholesky(rows @ rows.T + _RIDGE * np.eye(len(rows)))
            goal = solve_triangular(factor, -rest, lower=True)
            multipliers[~equal] = nnls(factor.T, goal, maxiter=30 * len(rows))[0]
            z = fixed - rows.T @ multipliers[~equal]
        multipliers[equal] = -inverse.T @ (z + turned[~equal].T @ multipliers[~equal])
        step = solve_triangular(self.triangle, z - shift)
        return np.clip(step, low, high), (multipliers / size)[: len(constraints)]

    def promised(self, step: np.ndarray, price: float) -> float:
        """By how much the merit falls if residuals and constraints are linear."""
        assert self.sample.d_residuals is not None
        linear = Sample(
            self.sample.residuals + self.sample.d_residuals @ step, self.sample.constraints + self.slopes @ step
        )
        return _merit(self.sample, self.equal, price) - _merit(linear, self.equal, price)
