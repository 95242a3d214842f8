"""Fits of a curve over angles: what each must reproduce, SciPy's smoothing spline, that no fit sees what it is judged
by, propagated noise, and errors.

Chi-square tests have a false-alarm rate of 1e-4 each, two-sided; seeds are fixed, so that they pass or fail for good.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import minimize

from analysis.turntable import angle_network
from analysis.turntable.angle_network import NotConvergedError
from analysis.turntable.dividing_error import FITS, CalibrationSeries, angles_left, choose, cross_validate, fewest, fit
from tests.analysis.refusals import refuses
from tests.tiers import quick

LINEAR = tuple(name for name in FITS if name != "network")
ANGLE = np.radians(np.linspace(92.0, 112.0, 41))
BETWEEN = np.radians(np.random.default_rng(7).uniform(92.0, 112.0, 60))


def wave(angle: np.ndarray, period_deg: float = 8.0) -> np.ndarray:
    """A wave on a ramp: its ends do not meet."""
    return np.asarray(np.sin(2.0 * np.pi * np.degrees(angle) / period_deg) + 0.1 * (np.degrees(angle) - 92.0))


def noisy(sigma: float, seed: int, angle: np.ndarray = ANGLE) -> np.ndarray:
    return wave(angle) + sigma * np.random.default_rng(seed).standard_normal(len(angle))


@pytest.mark.second
@pytest.mark.parametrize("name", LINEAR)
def test_linear_fits_are_their_weights(name: str) -> None:
    """They add up to one, so that a shift of all values shifts the curve; and the curve is the same where angles are
    counted from the middle of the points: 1e-16 of an angle over a step of 0.01."""
    value, turn = noisy(0.1, 1), np.radians(-102.0)
    made, there = fit(name, ANGLE, value, 0.1), fit(name, ANGLE + turn, value, 0.1)
    np.testing.assert_allclose(made.weights(BETWEEN) @ value, made(BETWEEN), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(made.weights(BETWEEN).sum(axis=1), 1.0, rtol=0.0, atol=1e-8)
    assert there.settings == pytest.approx(made.settings)
    np.testing.assert_allclose(there(BETWEEN + turn), made(BETWEEN), rtol=0.0, atol=1e-9)


def test_a_polynomial_is_found() -> None:
    x = np.degrees(ANGLE) - 102.0
    made = fit("polynomial", ANGLE, x**3 - 20.0 * x, 1.0)
    at = np.degrees(BETWEEN) - 102.0
    np.testing.assert_allclose(made(BETWEEN), at**3 - 20.0 * at, rtol=0.0, atol=1e-9 * 1000.0)
    # with noise the order stays near the true one: leave-one-out does not run away to the highest
    noise = 10.0 * np.random.default_rng(3).standard_normal(41)
    assert 3 <= fit("polynomial", ANGLE, x**3 - 20.0 * x + noise, 10.0).settings["order"] <= 8


def test_smoothing_spline_is_scipys() -> None:
    """The same minimum with the smoothing that was selected, from SciPy's B-spline solver; unequal weights."""
    sigma = np.where(np.arange(41) % 5 == 0, 0.6, 0.3)
    value = wave(ANGLE) + sigma * np.random.default_rng(4).standard_normal(41)
    made = fit("cubic_spline", ANGLE, value, sigma)
    assert made.settings["smoothing"] > 0.0
    step = ANGLE[1] - ANGLE[0]
    weight = sigma**-2 / np.mean(sigma**-2)
    peer = make_smoothing_spline(ANGLE / step, value, weight, lam=made.settings["smoothing"])
    np.testing.assert_allclose(made(BETWEEN), peer(BETWEEN / step), rtol=0.0, atol=1e-7)


@pytest.mark.second
def test_network_derivative_is_that_of_the_trained_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Central differences of weights found by BFGS from a loss that is written down here; more decay than in use, so
    that the minimum is sharp enough for differences.
    """
    monkeypatch.setattr(angle_network, "DECAY", 0.1)
    rng = np.random.default_rng(11)
    n, h = 15, 4
    x, y, weight = np.linspace(-5.0, 5.0, n), rng.standard_normal(n), rng.uniform(0.5, 2.0, n)

    def output(theta: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.asarray(np.tanh(np.outer(at, theta[:h]) + theta[h : 2 * h]) @ theta[2 * h : 3 * h] + theta[-1])

    def trained(value: np.ndarray, start: np.ndarray) -> np.ndarray:
        def loss(z: np.ndarray) -> np.ndarray:
            decay = np.sum(z[:h] ** 2) + np.sum(z[2 * h : 3 * h] ** 2)
            return np.asarray(0.5 * np.sum(weight * (output(z, x) - value) ** 2) + 0.5 * angle_network.DECAY * decay)

        def slope(theta: np.ndarray) -> np.ndarray:
            """By complex step, exact to rounding."""
            return np.array([loss(z).imag / 1e-30 for z in theta + 1e-30j * np.eye(len(theta))])

        return np.asarray(minimize(loss, start, jac=slope, method="BFGS", options={"gtol": 1e-10}).x)

    theta = trained(y, rng.standard_normal(3 * h + 1))
    net = SimpleNamespace(
        coefs_=[theta[None, :h], theta[2 * h : 3 * h, None]], intercepts_=[theta[h : 2 * h], theta[-1:]]
    )
    at = np.linspace(-5.0, 5.0, 23)
    told = angle_network.gradient(net, at) @ angle_network.response(net, x, y, weight)
    step = 1e-4
    for i in (2, 7, 12):
        change = np.where(np.arange(n) == i, step, 0.0)
        found = output(trained(y + change, theta), at) - output(trained(y - change, theta), at)
        # the minimiser stops some 1e-9 short, over the step and the least curvature
        np.testing.assert_allclose(found / (2.0 * step), told[:, i], rtol=0.0, atol=1e-3)
    assert np.max(np.abs(told)) > 0.5


@pytest.mark.second
@pytest.mark.parametrize("name", quick(2, sorted(LINEAR, key="fourier".__eq__)))
def test_cross_validation_does_not_see_what_it_predicts(name: str) -> None:
    """A left-out value that changes by one changes its residual by exactly one, whatever a fit selects."""
    value = noisy(0.1, 8)
    plain = cross_validate(name, ANGLE, value, 0.1)
    for i in (1, 17, 39):
        changed = cross_validate(name, ANGLE, value + (np.arange(41) == i), 0.1)
        assert changed.residual[i - 1] - plain.residual[i - 1] == pytest.approx(1.0, abs=1e-12)


def test_cross_validation_states_its_noise() -> None:
    """Of a value and of what a fit without it predicts there, by the fit's weights."""
    sigma = np.where(np.arange(41) % 3 == 0, 0.2, 0.1)
    checked = cross_validate("piecewise_linear", ANGLE, wave(ANGLE), sigma)
    for i in (1, 20, 39):
        others = np.arange(41) != i
        weight = fit("piecewise_linear", ANGLE[others], wave(ANGLE[others]), sigma[others]).weights(ANGLE[i : i + 1])[0]
        assert checked.variance[i - 1] == pytest.approx(sigma[i] ** 2 + weight**2 @ sigma[others] ** 2, rel=1e-9)


@pytest.mark.parametrize("name", FITS)
def test_too_few_angles(name: str) -> None:
    count = fewest(name)
    with pytest.raises(ValueError, match=f"{name}: {count - 1} angles, but at least {count} are needed"):
        fit(name, ANGLE[: count - 1], ANGLE[: count - 1], 1.0)
    assert fit(name, ANGLE[:count], wave(ANGLE[:count]), 1.0).name == name
    assert angles_left(41, 10) == 37
    refuses(ValueError, "cross-validation leaves", cross_validate, name, ANGLE[:count], wave(ANGLE[:count]), 1.0)


@pytest.mark.parametrize("name", FITS)
def test_bad_angles(name: str) -> None:
    refuses(ValueError, "all 41 angles are the same; step the table", fit, name, np.full(41, 1.7), ANGLE, 1.0)
    refuses(ValueError, "average the repeats", fit, name, np.repeat(ANGLE[:20], 2), np.zeros(40), 1.0)
    refuses(ValueError, "finite", fit, name, ANGLE, np.where(np.arange(41) == 3, np.nan, 0.0), 1.0)
    refuses(ValueError, "greater than zero", fit, name, ANGLE, ANGLE, 0.0)


def test_unknown_fit_and_outside_of_the_points() -> None:
    refuses(ValueError, r"'bezier'.*piecewise_linear", fit, "bezier", ANGLE, ANGLE, 1.0)
    made = fit("cubic_spline", ANGLE, ANGLE, 1.0)
    with pytest.raises(ValueError, match=r"calibrated from 92\.0000 to 112\.0000 deg; calibrate the whole range"):
        made(np.radians(112.1))


def test_network_that_does_not_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(angle_network, "MOST_ITERATIONS", 2)
    refuses(NotConvergedError, "none of 4 trainings", fit, "network", ANGLE, wave(ANGLE), 0.1)
    series = CalibrationSeries(ANGLE, wave(ANGLE)[:, None] + np.random.default_rng(1).normal(0.0, 0.1, (41, 5)))
    choice = choose(series, names=("network", "cubic_spline"))
    assert choice.chosen == "cubic_spline"
    assert "none of 4" in choice.failed["network"]
    refuses(ValueError, "no fit of the dividing error succeeded", choose, series, names=("network",))
