"""The state of an instrument from measurements of several kinds, and the next move, on linear and curved models."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.stats import chi2

from analysis.arrays import UndeterminedError
from analysis.instrument_state.linearity import effective_share
from analysis.instrument_state.state_estimate import (
    Actuators,
    MeasuredGroup,
    StateEstimate,
    StatePrior,
    best_move,
    combinations,
    estimate_state,
    merit_reduction,
)
from tests.analysis.refusals import refuses

M = 7


def random_prior(rng: np.random.Generator, count: int = M) -> StatePrior:
    """Sigmas over three orders of magnitude, with correlations."""
    root = rng.normal(size=(count, count)) * 10.0 ** rng.uniform(-6, -3, (count, 1))
    return StatePrior.of([f"motion {k}" for k in range(count)], root @ root.T)


def random_group(
    rng: np.random.Generator, name: str, count: int, biases: int = 0, free: bool = False, blocks: int = 1
) -> MeasuredGroup:
    spread = rng.normal(size=(count, count)) + 2.0 * np.eye(count)
    sigmas = np.full(biases, np.inf) if free else rng.uniform(0.5, 3.0, biases)
    return MeasuredGroup(
        name,
        "numbers",
        tuple(f"number {k}" for k in range(count)),
        np.zeros(count),
        spread @ spread.T,
        rng.normal(size=(count, biases)),
        sigmas,
        tuple(f"block {k * blocks // count}" for k in range(count)),
    )


class Linear:
    """A linear instrument with groups of measurements."""

    def __init__(self, rng: np.random.Generator, prior: StatePrior, groups: list[MeasuredGroup]) -> None:
        self.rng, self.prior, self.groups = rng, prior, groups
        count = sum(len(group.values) for group in groups)
        self.table = rng.normal(size=(count, len(prior.mean))) / prior.sigma * 3.0

    def predict(self, states: np.ndarray) -> np.ndarray:
        return np.asarray(states @ self.table.T)

    def slope(self, state: np.ndarray) -> np.ndarray:
        return self.table

    def drawn(self) -> tuple[np.ndarray, list[MeasuredGroup]]:
        """A state of the prior, and what is measured of it."""
        state = self.prior.mean + self.prior.root @ self.rng.standard_normal(self.prior.root.shape[1])
        values = self.predict(state[None])[0]
        out, start = [], 0
        for group in self.groups:
            own = slice(start, start + len(group.values))
            start += len(group.values)
            noise = np.linalg.cholesky(group.covariance) @ self.rng.standard_normal(len(group.values))
            size = np.where(np.isinf(group.bias_sigmas), 50.0, group.bias_sigmas)
            noise = noise + group.biases @ (size * self.rng.standard_normal(len(size)))
            out.append(group.with_values(values[own] + noise))
        return state, out

    def estimate(self, groups: list[MeasuredGroup]) -> StateEstimate:
        return estimate_state(self.prior, groups, self.predict, self.slope)


def closed_form(
    prior: StatePrior, table: np.ndarray, group: MeasuredGroup, free: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a linear normal model, biases by a covariance; free ones with a standard deviation."""
    sigma = np.where(np.isinf(group.bias_sigmas), free, group.bias_sigmas)
    spread = group.covariance + (group.biases * sigma**2) @ group.biases.T
    whole = table @ prior.covariance @ table.T + spread
    gain = prior.covariance @ table.T @ np.linalg.inv(whole)
    return gain @ group.values, prior.covariance - gain @ table @ prior.covariance


@pytest.mark.parametrize("free", [False, True])
def test_linear_models_have_the_closed_form(free: bool) -> None:
    """A free bias is the limit of a large standard deviation, which is 1e4 of the errors here: 1e-8 of the variances
    are left of it.
    """
    rng = np.random.default_rng(3)
    model = Linear(rng, random_prior(rng), [random_group(rng, "one", 12, 2, free)])
    _, groups = model.drawn()
    found = model.estimate(groups)
    mean, covariance = closed_form(model.prior, model.table, groups[0], 1e4)
    scale = model.prior.sigma
    assert_allclose(found.mean / scale, mean / scale, atol=1e-6 if free else 1e-10)
    assert_allclose(found.covariance / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=1e-6)
    assert found.converged


def test_agreements_are_predictions_from_all_others() -> None:
    """Of each measurement and block: its mean and covariance by one joint normal of all other numbers."""
    rng = np.random.default_rng(7)
    groups = [random_group(rng, "one", 9, 1, False, 3), random_group(rng, "two", 5, 1)]
    model = Linear(rng, random_prior(rng), groups)
    _, measured = model.drawn()
    found = model.estimate(measured)
    value = np.concatenate([group.values for group in measured])
    noise = block_diag(*(g.covariance + (g.biases * g.bias_sigmas**2) @ g.biases.T for g in measured))
    whole = model.table @ model.prior.covariance @ model.table.T + noise
    assert found.whole.chi_square == pytest.approx(value @ np.linalg.solve(whole, value), rel=1e-8)
    assert found.whole.degrees == 14
    block = np.arange(14) // 3 == 1
    # a block that is left out takes what its own measurement's bias tells with it
    for own, agreement in ((np.arange(14) < 9, found.measurements[0]), (block, found.blocks["one"][1])):
        across = whole[np.ix_(own, ~own)] @ np.linalg.inv(whole[np.ix_(~own, ~own)])
        off = value[own] - across @ value[~own]
        spread = whole[np.ix_(own, own)] - across @ whole[np.ix_(~own, own)]
        assert agreement.chi_square == pytest.approx(off @ np.linalg.solve(spread, off), rel=1e-6)
        assert agreement.degrees == own.sum()
        assert agreement.p_value == pytest.approx(chi2.sf(agreement.chi_square, own.sum()))


def test_a_gross_error_is_left_out() -> None:
    """A block that is far off leaves the estimate as if it had not been measured, and is named."""
    rng = np.random.default_rng(11)
    model = Linear(rng, random_prior(rng), [random_group(rng, "one", 24, 0, False, 8), random_group(rng, "two", 8)])
    _, (one, two) = model.drawn()
    assert not model.estimate([one, two]).excluded
    values = one.values + 300.0 * (np.arange(24) // 3 == 2)
    found = model.estimate([one.with_values(values), two])
    assert [(name, block) for name, block, _ in found.excluded] == [("one", "block 2")]
    kept = np.array([block != "block 2" for block in one.blocks])
    labels, blocks = (tuple(np.array(each)[kept]) for each in (one.labels, one.blocks))
    spread = one.covariance[np.ix_(kept, kept)]
    fewer = MeasuredGroup("one", "n", labels, one.values[kept], spread, one.biases[kept], one.bias_sigmas, blocks)
    table = model.table[np.concatenate([kept, np.ones(8, dtype=bool)])]
    other = estimate_state(model.prior, [fewer, two], lambda x: x @ table.T, lambda x: table)
    assert_allclose(found.mean / model.prior.sigma, other.mean / model.prior.sigma, atol=1e-9)


def test_a_curved_instrument_settles_at_the_mode() -> None:
    """Of a model with squares the estimate is where the derivative of the cost by every motion vanishes."""
    rng = np.random.default_rng(17)
    prior = StatePrior.of("abc", np.diag([1.0, 4.0, 0.25]))
    table, bent = rng.normal(size=(9, 3)), 0.15 * rng.normal(size=(9, 3))

    def predict(x: np.ndarray) -> np.ndarray:
        return np.asarray(x @ table.T + (x**2) @ bent.T)

    def slope(x: np.ndarray) -> np.ndarray:
        return np.asarray(table + 2.0 * bent * x)

    true = np.array([0.8, -1.5, 0.4])
    values = predict(true[None])[0] + 0.05 * rng.standard_normal(9)
    empty = np.zeros((9, 0)), np.zeros(0)
    group = MeasuredGroup("one", "numbers", ("n",) * 9, values, 0.05**2 * np.eye(9), *empty, tuple("abcdefghi"))
    found = estimate_state(prior, [group], predict, slope)
    assert found.converged
    left = (values - predict(found.mean[None])[0]) / 0.05**2
    pull = slope(found.mean).T @ left - np.linalg.solve(prior.covariance, found.mean)
    assert np.all(np.abs(pull) * found.sigma < 0.01)
    assert np.all(np.abs(found.mean - true) < 4.5 * found.sigma)


def test_nothing_and_impossible_errors_are_refused() -> None:
    """No measurement, a covariance that is none, and an instrument without light have messages of their own."""
    prior, still = StatePrior.of("ab", np.eye(2)), (lambda x: x, lambda x: np.eye(2))

    def group(spread):
        return MeasuredGroup("one", "n", ("a", "b"), np.zeros(2), spread, np.zeros((2, 0)), np.zeros(0), ("a", "b"))

    refuses(UndeterminedError, "nothing was measured", estimate_state, prior, [], *still)
    for spread, said in (
        (np.ones((2, 2)) + np.eye(2)[::-1], "not positive definite"),
        (0.0 * np.eye(2), "standard deviation of a number is zero"),
    ):
        refuses(UndeterminedError, said, estimate_state, prior, [group(spread)], *still)
    refuses(UndeterminedError, "no light", estimate_state, prior, [group(np.eye(2))], lambda x: x * np.nan, still[1])
    refuses(ValueError, "do not have the shape for 2 numbers", group, np.eye(3))
    refuses(ValueError, "need as many labels and blocks", replace, group(np.eye(2)), blocks=("a",))


def test_combinations_are_independent_and_keep_their_prior_where_nothing_is_measured() -> None:
    """Values of combinations in drawn states have unit variance and no correlation before, their sigma after."""
    rng = np.random.default_rng(19)
    model = Linear(rng, random_prior(rng), [random_group(rng, "one", 3)])
    _, groups = model.drawn()
    found = model.estimate(groups)
    known = combinations(found)
    assert [one.known for one in known[3:]] == [False] * 4
    assert_allclose([one.sigma for one in known[3:]], 1.0, atol=1e-9)
    scale = model.prior.sigma
    rows = np.stack([one.weights for one in known]) / scale
    assert_allclose(rows @ model.prior.covariance @ rows.T, np.eye(M), atol=1e-8)
    assert_allclose(rows @ found.covariance @ rows.T, np.diag([one.sigma**2 for one in known]), atol=1e-8)
    assert_allclose(rows @ found.mean, [one.value for one in known], atol=1e-8)


def actuators(count: int, step: float = 0.5, reach: float = 2.0, relative: float = 0.02) -> Actuators:
    ends = np.full(count, reach)
    return Actuators(
        tuple("abcdef"[:count]), -ends, ends, np.full(count, step), np.full(count, relative), np.full(count, 0.03)
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_best_move_is_the_best_of_all(seed: int) -> None:
    """Branch and bound against every whole step of three actuators, two of which do nearly the same."""
    rng = np.random.default_rng(seed)
    slope = rng.normal(size=(6, 3))
    slope[:, 2] = slope[:, 1] + 0.05 * rng.normal(size=6)
    residual = 3.0 * rng.normal(size=6)
    parts = actuators(3)
    found = best_move(residual, slope, parts)
    length = np.linalg.norm(slope, axis=0)

    def cost(move: np.ndarray) -> float:
        left = residual + slope @ move
        spread = (parts.relative * move) ** 2 + (move != 0.0) * parts.absolute**2
        return float(left @ left + spread @ length**2)

    best = min(cost(0.5 * np.array(n)) for n in product(range(-4, 5), repeat=3))
    assert found.searched
    # what a fixed error of any move costs is not searched for
    assert cost(found.amounts) <= best * (1.0 + 2e-3) + 3 * 0.03**2 * np.sum(length**2)
    assert found.expected == pytest.approx(cost(found.amounts))
    assert_allclose(found.amounts, 0.5 * np.round(found.amounts / 0.5), atol=1e-12)


def test_no_range_no_move_and_free_amounts_solve_the_equations() -> None:
    """An actuator of no range stays; without steps, limits and errors the move is that of least squares."""
    rng = np.random.default_rng(2)
    slope, residual = rng.normal(size=(6, 2)), rng.normal(size=6)
    still = Actuators(("a", "b"), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2))
    assert not np.any(best_move(residual, slope, still).amounts)
    wide = Actuators(("a", "b"), np.full(2, -99.0), np.full(2, 99.0), np.zeros(2), np.zeros(2), np.zeros(2))
    found = best_move(residual, slope, wide).amounts
    assert_allclose(found, np.linalg.lstsq(slope, -residual, rcond=None)[0], atol=1e-9)


def test_the_worth_of_a_measurement_is_what_it_saves() -> None:
    """Against drawn states: the merit after the move that follows from the estimate with and without it."""
    rng = np.random.default_rng(23)
    units, response = 5, rng.normal(size=(8, 2))
    slope = rng.normal(size=(8, units))
    old, new = 2.0 * rng.normal(size=(3, units)), 3.0 * rng.normal(size=(2, units))
    covariance = np.linalg.inv(np.eye(units) + old.T @ old)
    root = np.linalg.cholesky(covariance)
    free = Actuators(("a", "b"), np.full(2, -1e3), np.full(2, 1e3), np.zeros(2), np.zeros(2), np.zeros(2))
    worth = merit_reduction(root, slope, free, response, {"new": new})["new"]
    states = rng.standard_normal((4000, units)) @ root.T
    after = np.linalg.inv(np.linalg.inv(covariance) + new.T @ new)
    read = states @ new.T + rng.standard_normal((4000, 2))
    guess = read @ (after @ new.T).T
    undo = response @ np.linalg.pinv(response)

    def merit(mean: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum((states @ slope.T - mean @ slope.T @ undo.T) ** 2, axis=1))

    saved = merit(np.zeros_like(states)) - merit(guess)
    assert abs(np.mean(saved) - worth) < 4.5 * np.std(saved) / np.sqrt(len(saved))


def test_linear_readings_have_draws_of_the_exact_posterior() -> None:
    """Directions that are hardly determined count as undetermined, which costs 1e-5."""
    rng = np.random.default_rng(3)
    groups = [random_group(rng, "one", 5), random_group(rng, "two", 4, 2, True)]
    instrument = Linear(rng, random_prior(rng), groups)
    state = estimate_state(instrument.prior, instrument.drawn()[1], instrument.predict, instrument.slope)
    assert effective_share(state, instrument.predict) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("bend", [0.0, 0.1, 0.2])
def test_share_of_a_bent_reading_is_that_of_its_integral(bend: float) -> None:
    """y = x + bend x^2, x ~ N(0, 1), with an error of 0.3: the share is (E w)^2 / E w^2 over the linear posterior."""
    group = MeasuredGroup(
        "y", "numbers", ("y",), np.array([0.5]), np.array([[0.09]]), np.zeros((1, 0)), np.zeros(0), ("y",)
    )
    curve = lambda x: x + bend * x**2  # noqa: E731
    state = estimate_state(
        StatePrior.of(["x"], np.eye(1)), [group], curve, lambda x: np.array([[1.0 + 2.0 * bend * x[0]]])
    )
    x = state.unit[0] + state.root[0, 0] * np.linspace(-4.5, 4.5, 20001)
    linear = np.exp(-0.5 * ((x - state.unit[0]) / state.root[0, 0]) ** 2)
    exact = np.exp(-0.5 * ((0.5 - curve(x)) / 0.3) ** 2 - 0.5 * x**2)
    share = exact.sum() ** 2 / linear.sum() / (exact**2 / linear).sum()
    assert effective_share(state, curve, count=40000) == pytest.approx(share, rel=0.03)
    assert (share > 0.999) == (bend == 0.0)
