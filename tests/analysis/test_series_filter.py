"""Readings followed one by one, held against the joint normal of the whole series and against what a refit says."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.filter_state import Observed
from analysis.monitor.kalman_filter import SeriesFilter, smooth_jointly
from analysis.monitor.series_smoother import smooth_series
from analysis.monitor.state_space import HeatInputs, StateSpace
from tests.analysis.followed_series import follow, of_shifts, whole_steps
from tests.analysis.stated_motions import SpotNoise, correlation_of, disturbances
from tests.analysis.test_series_smoother import joint_normal

LAWS = (
    TimeLaw(),
    TimeLaw(white=True),
    TimeLaw(drift_s=30.0),
    TimeLaw(period_s=7.0),
    TimeLaw(drift_s=50.0, period_s=11.0),
    TimeLaw(trend_s=40.0),
    TimeLaw(trend_s=40.0, period_s=9.0),
    TimeLaw(relaxation_s=12.0, since_s=5.0),
    TimeLaw(event=((20.3, 1.0),)),
    TimeLaw(event=((10.0, 0.0), (15.0, 0.4), (18.0, 1.0))),
    TimeLaw(event=((30.0, 1.0),), drift_s=10.0, period_s=6.0),
)
SPOTS, PARAMETERS = 5, 6
NOISE, REFERENCE = 0.05, 0.02
"""Px, of each shift and of the reference that all are counted from."""


def stated(laws, seed: int = 0, each: int = 3) -> Disturbances:
    """Three motions of each law that go together."""
    rng, every = np.random.default_rng(seed), tuple(law for law in laws for _ in range(each))
    correlation, spots = correlation_of(rng, every), rng.normal(size=(SPOTS, len(every)))
    return disturbances(every, spots, 1e-6 * rng.normal(size=(PARAMETERS, len(every))), correlation=correlation)


BOTH = SpotNoise(NOISE**2 * np.eye(SPOTS), REFERENCE**2 * np.eye(SPOTS))


def series(count: int, size: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of a size that mean nothing."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, 60.0, count))
    times[count // 3] = times[count // 3 - 1]  # two readings of one moment
    return times, size * rng.normal(size=(count, SPOTS))


@pytest.mark.second
@pytest.mark.parametrize("laws", [(law,) for law in LAWS] + [LAWS], ids=lambda laws: str(len(laws)))
def test_the_same_as_the_joint_normal_of_the_series(laws) -> None:
    """Values to 1e-9 of sigma and covariances to 1e-9 of themselves, at readings, between, before and after them."""
    told, (times, shifts) = stated(laws), series(40, NOISE)
    wanted = np.concatenate([times, np.random.default_rng(2).uniform(-3.0, 70.0, 25)])
    whole = smooth_series(told, times, shifts, BOTH, wanted)
    how = SeriesFilter(told, REFERENCE**2 * np.eye(SPOTS), window=0)
    found = follow(how, of_shifts(times, shifts, NOISE**2 * np.eye(SPOTS)), wanted)
    for one, two in ((whole.filtered, found.filtered), (whole.smoothed, found.smoothed)):
        sigma = np.sqrt(np.diagonal(one.total, 0, 1, 2))
        # beside float64's rounding of what is known of the states before any reading
        prior = np.sqrt(np.diag(told.parameter_covariance))
        assert np.all(np.abs(one.values - two.values) <= 1e-9 * sigma + 1e-11 * prior)
        limit = 1e-9 * sigma[:, :, None] * sigma[:, None, :] + 1e-11 * np.outer(prior, prior)
        assert np.all(np.abs(one.total - two.total) <= limit)
    squares = np.array([one.chi_square for one in found.innovations])
    assert squares.sum() == pytest.approx(whole.consistency.chi_square, rel=1e-9)


def test_times_together_are_those_of_the_joint_normal() -> None:
    """Mean and covariance between times: before, between and after readings and at one of them."""
    told, (times, shifts) = stated(LAWS, seed=3), series(25, NOISE)
    wanted = np.sort(np.concatenate([np.random.default_rng(5).uniform(18.0, 31.0, 6), times[12:13], [-2.0]]))
    how = SeriesFilter(told, REFERENCE**2 * np.eye(SPOTS), window=0)
    read = of_shifts(times, shifts, NOISE**2 * np.eye(SPOTS))
    left = [np.zeros(0)] * len(times)
    for asked in (wanted, np.append(wanted, [66.0, 70.0])):
        mean, covariance = smooth_jointly(how, how.start(-3.0), read, asked, left)
        gain, before, after, _ = joint_normal(told, times, BOTH, asked, None)
        sigma, start = np.sqrt(np.diag(after)), np.sqrt(np.diag(before))
        assert np.all(np.abs(mean.ravel() - gain @ shifts.ravel()) <= 1e-9 * sigma + 1e-10 * start)
        off = np.abs(covariance.reshape(after.shape) - after)
        assert np.all(off <= 1e-9 * np.outer(sigma, sigma) + 1e-10 * np.outer(start, start))


def test_pieces_do_not_matter(monkeypatch) -> None:
    told, (times, shifts) = stated(LAWS[:6]), series(30, 1.0)
    how, read = SeriesFilter(told, window=0), of_shifts(times, shifts, NOISE**2 * np.eye(SPOTS))
    whole = follow(how, read, times)
    monkeypatch.setattr("analysis.monitor.kalman_filter._PIECE", 7)
    pieces = follow(how, read, times)
    sigma = np.sqrt(np.diagonal(whole.smoothed.total, 0, 1, 2))
    assert np.all(np.abs(whole.smoothed.values - pieces.smoothed.values) < 1e-9 * sigma)
    assert np.allclose(whole.smoothed.total, pieces.smoothed.total, rtol=1e-9, atol=0.0)


JUMPING = (TimeLaw(drift_s=30.0), TimeLaw(), TimeLaw(jump=True))


def test_what_is_looked_for_is_that_of_the_whole_series() -> None:
    """Scores and information of steps before each reading, found one by one, against the Cholesky factor of all."""
    told, (times, shifts) = stated(JUMPING, seed=4), series(20, NOISE)
    how = SeriesFilter(told, window=60)
    belief = how.start(times[0])
    for one in of_shifts(times, shifts, NOISE**2 * np.eye(SPOTS)):
        belief, _ = how.update(belief, one)
    whole = whole_steps(told, times, shifts, NOISE)
    # the first reading has none before it, and of two readings of one moment the second has none either
    assert np.array_equal(belief.until, whole.until)
    assert np.allclose(belief.state.score, whole.score, rtol=1e-9, atol=1e-9 * np.abs(whole.score).max())
    assert np.allclose(belief.state.information, whole.information, rtol=1e-9, atol=1e-9 * whole.information.max())


def jumped(size: float, seed: int = 6, count: int = 30) -> tuple[Disturbances, np.ndarray, np.ndarray]:
    """A series of what is stated in which one motion jumps before reading 20."""
    rng, told = np.random.default_rng(seed), stated(JUMPING, seed=4)
    times = np.arange(float(count))
    shifts = NOISE * rng.normal(size=(count, SPOTS))
    drift = np.zeros((count, 3))
    drift[0] = rng.normal(size=3)
    for k in range(1, count):
        kept = np.exp(-1.0 / 30.0)
        drift[k] = kept * drift[k - 1] + np.sqrt(1.0 - kept**2) * rng.normal(size=3)
    shifts += 0.1 * drift @ told.spots[:, :3].T
    shifts += (times >= 20.0)[:, None] * size * told.spots[:, 7]
    scale = np.ones(9)
    scale[:3] = 0.1
    return told.scaled(scale), times, shifts


def test_a_jump_is_told_and_counts_as_if_it_had_been_known() -> None:
    """The estimate after it is that of a filter that was told of the jump's time and prior before."""
    told, times, shifts = jumped(3.0)
    how = SeriesFilter(told, life_s=30.0)
    read = of_shifts(times, shifts, NOISE**2 * np.eye(SPOTS))
    found = follow(how, read, times)
    (jump,) = found.jumps
    assert (jump.body, jump.after, jump.until) == ("body7", 19.0, 20.0)
    (size,), (sigma,) = jump.sizes, jump.sigmas
    assert abs(size - 3.0) < 4.0 * sigma
    knowing = SeriesFilter(
        told.with_copies(jump.motions, jump.times, TimeLaw(event=((19.5, 1.0),))), life_s=30.0, window=0
    )
    known = follow(knowing, read, times)
    sigmas = np.sqrt(np.diagonal(known.filtered.total, 0, 1, 2))
    after = slice(25, None)
    assert np.all(np.abs(found.filtered.values - known.filtered.values)[after] < 1e-6 * sigmas[after])
    assert np.allclose(found.filtered.total[after], known.filtered.total[after], rtol=1e-6)


def heated(sigma: float) -> tuple[Disturbances, HeatInputs]:
    """Two bodies that wander in temperature, with a sensor each, beside a mount that drifts."""
    told = stated((TimeLaw(drift_s=30.0), TimeLaw(drift_s=200.0)), seed=9, each=2)
    told = replace(told, correlation=np.eye(4))
    motions = np.array([0, 1])
    return told, HeatInputs(motions, ("body0", "body1"), np.diag([0.5, 0.8]), motions, ("body0", "body1"), sigma)


def test_a_factor_of_what_heat_does_is_found() -> None:
    """What the first body's heat does is 1.4 times the computed. Sensors tell how warm it is, spots what that does."""
    told, heat = heated(0.3)
    rng, factor, times = np.random.default_rng(3), np.array([1.4, 1.0]), np.arange(0.0, 400.0, 2.0)
    warm = np.zeros((len(times), 2))
    for k in range(1, len(times)):
        kept = np.exp(-2.0 / 30.0)
        warm[k] = kept * warm[k - 1] + np.sqrt(1.0 - kept**2) * rng.normal(size=2)
    how = SeriesFilter(told, heat=heat, window=0)
    belief = how.start(0.0)
    for time, state in zip(times.tolist(), warm, strict=True):
        read = Observed(time, np.array([0.5, 0.8]) * state + 0.01 * rng.normal(size=2), 1e-4 * np.eye(2), (0, 1))
        belief, _ = how.update(belief, read)
        shifts = told.spots[:, :2] @ (factor * state) + NOISE * rng.normal(size=SPOTS)
        belief, _ = how.update(belief, Observed(time, shifts, NOISE**2 * np.eye(SPOTS)))
    own = how.space.factors
    found, sigma = 1.0 + belief.mean[own], np.sqrt(np.diag(belief.covariance[own, own]))
    assert np.all(np.abs(found - factor) < 4.0 * sigma)
    assert np.all(sigma < 0.05)


def test_a_sensor_says_what_a_body_does() -> None:
    """With exact coefficients the answer is that of one joint normal, sensors being further rows."""
    told, heat = heated(1e-9)
    how = SeriesFilter(told, heat=heat, window=0, leaving_out=False)  # no motion makes such shifts
    belief = how.start(0.0)
    read, shift = np.array([0.3, -0.2]), np.full(SPOTS, 0.4)
    belief, _ = how.update(belief, Observed(1.0, read, 1e-4 * np.eye(2), (0, 1)))
    belief, _ = how.update(belief, Observed(1.0, shift, NOISE**2 * np.eye(SPOTS)))
    values, total = how.parameters(how.mixture(belief), 1.0)
    rows = np.concatenate([np.pad(heat.rows, ((0, 0), (0, 2))), told.spots])
    noise = np.diag([1e-4, 1e-4, *[NOISE**2] * SPOTS])
    across = told.parameters @ rows.T
    gain = across @ np.linalg.inv(rows @ rows.T + noise)
    assert np.allclose(values, gain @ np.concatenate([read, shift]), rtol=1e-6, atol=1e-14)
    assert np.allclose(total, told.parameters @ told.parameters.T - gain @ across.T, rtol=1e-5, atol=1e-18)


def test_motions_of_a_state_are_those_of_one_joint_normal() -> None:
    told, shift = stated(LAWS[:3], seed=8), np.full(SPOTS, 0.7)
    how = SeriesFilter(told, window=0, leaving_out=False)  # no motion makes such shifts
    belief, _ = how.update(how.start(0.0), Observed(0.0, shift, NOISE**2 * np.eye(SPOTS)))
    found, spread = how.motions_of(belief.mean, belief.covariance, 0.0, 0.0)
    gain = told.correlation @ told.spots.T @ np.linalg.inv(told.spot_covariance + NOISE**2 * np.eye(SPOTS))
    assert np.allclose(found, gain @ shift, atol=1e-9)
    assert np.allclose(spread, told.correlation - gain @ told.spots @ told.correlation, atol=1e-9)
    # as many states as outputs, where many motions share a law; twice as many of a swing
    assert StateSpace(stated((LAWS[2],), each=40)).size == SPOTS + PARAMETERS
    assert StateSpace(stated((LAWS[3],), each=40)).size == 2 * (SPOTS + PARAMETERS)
