"""Constrained least squares on problems of Hock and Schittkowski with known solutions."""

from collections.abc import Callable

import numpy as np
import pytest

from optics.design.optimiser import Sample, constrained_least_squares, violations

Functions = Callable[[np.ndarray], np.ndarray]
ROOT = np.sqrt(7.0)
# number in Hock and Schittkowski, Test Examples for Nonlinear Programming Codes (1981): residuals, constraints (not
# above zero), how many of them are equations, start, largest size of x, sum of squares and x at the solution
PROBLEMS = {
    14: (
        (lambda x: x - [2.0, 1.0], lambda x: np.array([x[0] - 2.0 * x[1] + 1.0, x[0] ** 2 / 4.0 + x[1] ** 2 - 1.0]), 1),
        ((2.0, 2.0), None, 9.0 - 2.875 * ROOT, (0.5 * (ROOT - 1.0), 0.25 * (ROOT + 1.0))),
    ),
    22: (
        (lambda x: x - [2.0, 1.0], lambda x: np.array([x[0] + x[1] - 2.0, x[0] ** 2 - x[1]]), 0),
        ((2.0, 2.0), None, 1.0, (1.0, 1.0)),
    ),
    42: (
        (lambda x: x - [1.0, 2.0, 3.0, 4.0], lambda x: np.array([x[0] - 2.0, x[2] ** 2 + x[3] ** 2 - 2.0]), 2),
        ((1.0,) * 4, None, 28.0 - 10.0 * np.sqrt(2.0), (2.0, 2.0, 0.6 * np.sqrt(2.0), 0.8 * np.sqrt(2.0))),
    ),
    65: (
        (
            lambda x: np.array([x[0] - x[1], (x[0] + x[1] - 10.0) / 3.0, x[2] - 5.0]),
            lambda x: np.array([x @ x - 48.0]),
            0,
        ),
        ((-4.0, 4.0, 0.0), (4.5, 4.5, 5.0), 0.9535288567, (3.650461821, 3.65046168, 4.6204170507)),
    ),
}


def slopes(function: Functions, x: np.ndarray) -> np.ndarray:
    """Derivatives of an analytic function by complex steps, exact."""
    return np.stack([function(x + 1e-30j * unit).imag / 1e-30 for unit in np.eye(len(x))], axis=-1)


def evaluated(residuals: Functions, constraints: Functions):
    def evaluate(x: np.ndarray, differentiate: bool) -> Sample:
        value = Sample(residuals(x), constraints(x))
        if not differentiate:
            return value
        return Sample(value.residuals, value.constraints, slopes(residuals, x), slopes(constraints, x))

    return evaluate


@pytest.mark.parametrize("number", PROBLEMS)
def test_known_solutions(number: int) -> None:
    (residuals, constraints, equations), (start, bounds, least, where) = PROBLEMS[number]
    begin = np.array(start)
    high = None if bounds is None else np.array(bounds)
    low = None if high is None else -high
    equal = np.arange(len(constraints(begin))) < equations
    found = constrained_least_squares(evaluated(residuals, constraints), begin, equal, low, high, tolerance=1e-12)
    assert found.converged
    assert found.jacobians < 30
    assert violations(found.sample.constraints, equal).max() < 1e-8
    # as many digits as the book prints; where nothing but rounding is left of the cost, x is as sharp as its root
    assert 2.0 * found.sample.cost == pytest.approx(least, abs=1e-8)
    np.testing.assert_allclose(found.x, where, atol=1e-5)


def test_multipliers_are_what_easing_a_constraint_is_worth() -> None:
    (residuals, constraints, _), (start, *_) = PROBLEMS[14]
    equal = np.array([True, False])
    costs = []
    for ease in (0.0, 1e-5):
        eased = evaluated(residuals, lambda x, ease=ease: constraints(x) - [0.0, ease])
        found = constrained_least_squares(eased, np.array(start), equal, tolerance=1e-14)
        costs.append(found.sample.cost)
    assert found.multipliers[1] > 0.1
    # the difference's own third order, and what rounding leaves of a cost of 0.7
    assert (costs[0] - costs[1]) / 1e-5 == pytest.approx(found.multipliers[1], rel=1e-3)


def test_constraints_that_contradict_each_other() -> None:
    """x below -1 and above 1: the search ends between them, without an answer."""
    evaluate = evaluated(lambda x: x - 5.0, lambda x: np.array([x[0] + 1.0, 1.0 - x[0]]))
    found = constrained_least_squares(evaluate, np.array([7.0]), np.array([False, False]))
    assert not found.converged
    assert violations(found.sample.constraints, np.array([False, False])).sum() == pytest.approx(2.0, abs=1e-6)
    assert -1.0 - 1e-6 <= found.x[0] <= 1.0 + 1e-6


def test_steps_to_where_there_is_nothing_are_refused() -> None:
    """A root whose argument must not be negative, in whose neighbourhood the first step would end."""
    inside = evaluated(lambda x: np.sqrt(x) - 0.1, lambda x: np.empty(0))
    tried = []

    def evaluate(x: np.ndarray, differentiate: bool) -> Sample | None:
        tried.append(float(x[0]))
        return None if x[0] < 0.0 else inside(x, differentiate)

    found = constrained_least_squares(evaluate, np.array([4.0]), np.zeros(0, dtype=bool), tolerance=1e-14)
    assert min(tried) < 0.0
    assert found.x[0] == pytest.approx(0.01, rel=1e-6)
    with pytest.raises(ValueError, match="start"):
        constrained_least_squares(evaluate, np.array([-1.0]), np.zeros(0, dtype=bool))
