"""Terms that the filter learns, against least squares of SciPy, plain NumPy and analytic responses."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.filter_state import Observed
from analysis.monitor.kalman_filter import SeriesFilter, smoothed
from analysis.monitor.learned_terms import Decay, Input, Move, Slope, Term, Terms

NOISE = 0.3


def series(times: np.ndarray, values: np.ndarray, **more) -> Input:
    return Input("input", 0, 0.0, 1.0, times, values, 0.0, **{**OFF, **more})


OFF = {"window": None, "relative": False, "lag": None, "spread": None, "gap": 1e9}


def filtered(terms: Terms, times: np.ndarray, values: np.ndarray):
    """State after all readings, linearised again until the point stays."""
    for _ in range(20):
        how = SeriesFilter(unit(), window=0, terms=terms, leaving_out=False)
        current = how.start(float(times[0]))
        for time, value in zip(times.tolist(), values.tolist(), strict=True):
            current, _ = how.update(current, Observed(time, np.array([value]), np.array([[NOISE**2]])))
        at = how.space.term_states
        moved = terms.relinearised(current.mean[at], current.covariance[at, at])
        if moved is None:
            return how, current, current.mean[at], current.covariance[at, at]
        terms = moved
    raise AssertionError("no convergence")


def unit() -> Disturbances:
    """One motion of unit effect that does not move by itself: its white part is far below the noise."""
    return Disturbances.of([[1.0, 1e-9]], [[1.0, 1e-9]], [TimeLaw(jump=True), TimeLaw(white=True)])


def test_a_constant_slopes_and_moves_are_generalised_least_squares():
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(0.0, 100.0, 60))
    own = (
        Term("constant", 0, 1.0, 3.0),
        Slope("early", 0, 0.0, 2.0, 0.0, 10.0),
        Slope("broken", 0, 0.0, 2.0, 60.0, 10.0),
        Move("move", 0, 2.0, 0.5, 40.0),
        Move("before", 0, -1.0, 0.2, -5.0),
        Move("exact", 0, 1.0, 0.0, 70.0),
    )
    gains = np.stack(
        [np.ones(60), times / 10.0, np.maximum(times - 60.0, 0.0) / 10.0, times >= 40.0, np.ones(60), times >= 70.0], 1
    ).astype(float)
    values = gains @ [0.5, 1.0, -2.0, 2.3, -1.1, 1.0] + NOISE * rng.standard_normal(60)
    how, last, mean, covariance = filtered(Terms(own, times), times, values)
    prior_mean, prior = np.array([t.mean for t in own]), np.diag([t.sigma**2 for t in own])
    spread = gains @ prior @ gains.T + NOISE**2 * np.eye(60)
    gain = prior @ gains.T @ np.linalg.inv(spread)
    assert mean == pytest.approx(prior_mean + gain @ (values - gains @ prior_mean), abs=1e-7)
    assert covariance == pytest.approx(prior - gain @ gains @ prior, abs=1e-8)
    assert covariance[5, 5] == 0.0
    assert mean[5] == 1.0
    # the past from all readings, and the mean from the present: the same states
    observed = [Observed(t, np.array([v]), np.array([[NOISE**2]])) for t, v in zip(times, values, strict=True)]
    past = smoothed(how, how.start(times[0]), observed, [times[20]], [np.zeros(0)] * 60, how.parameters_of)[0]
    row = gains[20]
    assert past[0][0] == pytest.approx(row @ mean, abs=1e-7)
    assert past[1][0, 0] == pytest.approx(row @ covariance @ row, abs=1e-8)
    assert last.time == times[-1]


def test_decays_with_unknown_rates_are_the_posterior_mode_of_nonlinear_least_squares():
    rng = np.random.default_rng(2)
    times = np.linspace(0.0, 300.0, 200)
    values = 2.0 + 20.0 * np.exp(-times / 60.0) + 8.0 * np.exp(-times / 10.0) + NOISE * rng.standard_normal(200)
    own = (
        Term("constant", 0, 0.0, 10.0),
        Decay("slow", 0, 15.0, 10.0, 0.0, 100.0, 0.5),
        Decay("fast", 0, 5.0, 5.0, 0.0, 15.0, 0.5),
    )
    how, _, mean, covariance = filtered(Terms(own, times), times, values)
    terms = Terms(own, times)

    def residuals(p):
        model = p[0] + p[1] * np.exp(-times / (100.0 * np.exp(p[3]))) + p[2] * np.exp(-times / (15.0 * np.exp(p[4])))
        return np.concatenate([(values - model) / NOISE, (p[:3] - terms.mean[:3]) / terms.sigma[:3], p[3:] / 0.5])

    mode = least_squares(residuals, [0.0, 15.0, 5.0, 0.0, 0.0], xtol=1e-14, ftol=1e-14)
    expected = np.linalg.inv(mode.jac.T @ mode.jac)
    sigma = np.sqrt(np.diag(expected))
    # the last linearisation is within a quarter of sigma of the mode: to second order, a few percent of sigma
    assert np.all(np.abs(mean[:3] - mode.x[:3]) < 0.1 * sigma[:3])
    assert np.sqrt(np.diag(covariance)) == pytest.approx(sigma, rel=0.1)
    assert np.all(np.abs(mode.x - [2.0, 20.0, 8.0, np.log(0.6), np.log(10.0 / 15.0)]) < 4.0 * sigma)
    assert how.terms.logs + mean[3:] == pytest.approx(mode.x[3:], abs=0.1 * sigma[3:].max())


@pytest.mark.parametrize("constant", [0.01, 3.0, 1000.0])
def test_a_lag_answers_a_ramp_as_a_first_order_system_does(constant: float):
    """Of u = t from t = 0, before which it is constant: t - T (1 - exp(-t / T)), also at uneven samples."""
    times = np.concatenate([[0.0], np.sort(np.random.default_rng(3).uniform(0.0, 20.0, 50)), [20.0]])
    ramp = series(times, times.copy(), lag=constant)
    assert ramp.gain(20.0, 0.0)[0] == pytest.approx(20.0 - constant * -np.expm1(-20.0 / constant), rel=1e-9)
    slower = ramp.gain(20.0, np.log(2.0))[0]
    assert slower == pytest.approx(20.0 - 2.0 * constant * -np.expm1(-10.0 / constant), rel=1e-9)


def test_a_window_ends_at_the_reading_and_may_be_longer_than_the_series():
    times, values = np.arange(10.0), np.arange(10.0) ** 2
    assert series(times, values, window=3.0).gain(8.5, 0.0)[0] == pytest.approx(np.mean(values[6:9]))
    assert series(times, values, window=3.0, relative=True).gain(8.0, 0.0)[0] == pytest.approx(
        64.0 - np.mean(values[6:9])
    )
    assert series(times, values, window=1e6).gain(9.0, 0.0)[0] == pytest.approx(values.mean())
    noisy = Input("input", 0, 0.0, 1.0, times, values, 0.1, **{**OFF, "window": 4.0, "relative": True})
    assert noisy.gain(9.0, 0.0)[1] == pytest.approx(0.01 * (1.0 - 1.0 / 4.0))
    assert np.isnan(series(times, values).gain(-1.0, 0.0)[0])
    assert np.isnan(series(times, values, gap=0.5).gain(9.6, 0.0)[0])


def test_an_input_in_a_gap_has_the_scatter_of_the_readings_before():
    rng = np.random.default_rng(4)
    times = np.arange(20.0)
    one, two = rng.normal(2.0, 1.0, 20), rng.normal(-1.0, 3.0, 20)
    both = Terms((series(times, one, gap=0.1), series(times, two, gap=0.1)), np.arange(30.0))
    gains, spread = both.gains(25.0)
    assert gains == pytest.approx([one.mean(), two.mean()])
    assert spread == pytest.approx(np.cov(one, two))
    gains, spread = both.gains(10.5)  # the future is not known
    assert gains == pytest.approx([one[:11].mean(), two[:11].mean()])
    assert both.gains(5.0)[0] == pytest.approx([one[5], two[5]])
    assert both.missing("input") == 10


def test_the_day_of_a_move_widens_the_readings_around_it_alone():
    move = Terms((Move("move", 0, 10.0, 1.0, 50.0, 2.0),), np.arange(100.0))
    how = SeriesFilter(unit(), window=0, terms=move)
    for time, p in ((30.0, 0.0), (50.0, 0.5), (70.0, 1.0)):
        mean, covariance = how.parameters(how.start(0.0), time)
        assert mean[0] == pytest.approx(10.0 * p, abs=1e-6)
        # sigma of the size, and two values of the step: the variance of a Bernoulli number times the mean square
        assert covariance[0, 0] == pytest.approx(p**2 + p * (1.0 - p) * 101.0, abs=1e-6)


@pytest.mark.parametrize(("constant", "known"), [(4.0, True), (1e5, False), (1e-4, False)])
def test_a_lag_is_learned_where_the_input_shows_it(constant: float, known: bool):
    """Hourly samples over 400 h: a lag far beyond the series, or far below a sample, keeps the sigma of its prior."""
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 400.0)
    values = np.cumsum(rng.normal(0.0, 0.3, 400))
    acts = np.zeros(400)
    for k in range(1, 400):  # in a thousand steps of an hour, by Euler
        for step in range(50):
            u = values[k - 1] + (values[k] - values[k - 1]) * step / 50.0
            acts[k] = acts[k - 1] if step == 0 else acts[k]
            acts[k] += min(0.02 / constant, 1.0) * (u - acts[k])
    readings = times[::4]
    read = 2.0 * acts[::4] + NOISE * rng.standard_normal(100)
    prior = {4.0: 6.0}.get(constant, constant)
    own = Input("input", 0, 1.0, 1.0, times, values, 0.0, **{**OFF, "lag": prior, "spread": 0.5})
    how, _, mean, covariance = filtered(Terms((own,), readings), readings, read)
    sigma = np.sqrt(np.diag(covariance))
    assert (sigma[1] < 0.3) == known
    if known:
        log = how.terms.logs[0] + mean[1]
        assert prior * np.exp(log) == pytest.approx(constant, rel=3.5 * sigma[1])
        assert mean[0] == pytest.approx(2.0, abs=3.5 * sigma[0])
    else:
        assert sigma[1] > 0.9 * 0.5
