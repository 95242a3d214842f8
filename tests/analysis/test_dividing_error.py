"""Chauvenet's criterion on printed examples and on normal noise, series of comparisons, the compensation's sigmas.

Chi-square tests have a false-alarm rate of 1e-4 each, two-sided; seeds are fixed, so that they pass or fail for good.

Fits of a curve over angles: what each must reproduce, SciPy's smoothing spline, that no fit sees what it is judged
by, propagated noise, and errors.

Chi-square tests have a false-alarm rate of 1e-4 each, two-sided; seeds are fixed, so that they pass or fail for good.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import minimize

from analysis.arrays import UndeterminedError
from analysis.turntable import dividing_error
from analysis.turntable.dividing_error import (
    FITS,
    CalibrationSeries,
    DividingCompensation,
    NotConvergedError,
    angles_left,
    chauvenet,
    choose,
    compensate,
    covered,
    cross_validate,
    fewest,
    fit_dividing_error,
    normal_reduction,
    rejection_rate,
    step_kernel,
)
from tests.analysis.refusals import refuses
from tests.tiers import quick

ARCSEC = math.pi / 648000
ANGLE = np.radians(np.linspace(92.0, 112.0, 41))


def curve(angle: np.ndarray) -> np.ndarray:
    return np.asarray(0.4 * ARCSEC * np.sin(2.0 * np.pi * np.degrees(angle) / 9.0))


def series(seed: int, sigma: float = 0.03 * ARCSEC, repeats: int = 10, angle: np.ndarray = ANGLE) -> CalibrationSeries:
    noise = np.random.default_rng(seed).normal(0.0, sigma, (len(angle), repeats))
    return CalibrationSeries(angle, curve(angle)[:, None] + noise)


@pytest.mark.parametrize(
    ("readings", "rejected"),
    [
        # J. R. Taylor, An Introduction to Error Analysis, 2nd ed., section 6.2: 58 is expected 0.16 times, so it goes
        ([46, 48, 44, 38, 45, 47, 58, 44, 45, 43], [58]),
        # the same, section 6.1: six periods of a pendulum; 1.8 is expected 0.3 times
        ([3.8, 3.5, 3.9, 3.9, 3.4, 1.8], [1.8]),
    ],
)
def test_printed_examples(readings: list[float], rejected: list[float]) -> None:
    values = np.array(readings, float)
    assert values[~chauvenet(values)].tolist() == rejected


def test_few_or_equal_readings_stay() -> None:
    """Of up to four readings none can deviate by more than the limit: (n - 1)/sqrt(n) is less than it."""
    for n in range(1, 5):
        assert chauvenet([0.0] * (n - 1) + [1e6]).all()
    assert not chauvenet([0.0, 0.1, -0.1, 0.05, 1e6]).all()
    # equal but for the rounding of a sum
    assert chauvenet([0.1 + 0.2] * 9 + [0.3]).all()
    refuses(ValueError, "finite", chauvenet, [0.0, np.nan, 1.0])


@pytest.mark.parametrize("n", [5, 10, 20])
def test_what_normal_noise_loses(n: int) -> None:
    """Formulas for the single pass against 20 000 series: 4 sigma of the counts; the variance within 1%."""
    readings = np.random.default_rng(n).standard_normal((20_000, n))
    keep = chauvenet(readings)
    rate = rejection_rate(n)
    assert np.mean(~keep) == pytest.approx(rate, abs=4.0 * math.sqrt(rate / keep.size))
    left = readings - np.mean(readings, axis=1, keepdims=True, where=keep)
    pooled = np.sum(left**2, where=keep) / np.sum(keep.sum(axis=1) - 1)
    # sqrt(2 / (20 000 (n - 1))) is 0.5% at n = 5; that two go at once is not in the formula
    assert pooled == pytest.approx(normal_reduction(n), rel=0.01)
    assert normal_reduction(n) < 0.93


@pytest.mark.second
def test_repeatability_is_unbiased() -> None:
    """The trimming is undone: 200 series of 41 angles. Their 74 000 degrees of freedom give 0.3%."""
    told = np.array([series(seed).repeatability for seed in range(200)])
    assert np.sqrt(np.mean(told**2)) == pytest.approx(0.03 * ARCSEC, rel=0.01)


def test_one_gross_error() -> None:
    """Its angle has the largest RMS before, and averaging alone leaves a tenth of the error in the mean."""
    clean = series(3)
    comparisons = clean.comparisons.copy()
    comparisons[7, 2] += 0.5 * ARCSEC
    dirty = CalibrationSeries(ANGLE, comparisons)
    assert np.argmax(dirty.rms_before) == 7
    assert not dirty.keep[7, 2]
    assert dirty.averaging_alone == pytest.approx(dirty.rms_before[7] / math.sqrt(10.0))
    # mean of the nine others
    assert dirty.mean[7] == pytest.approx(np.mean(np.delete(comparisons[7], 2)), rel=1e-12)
    assert dirty.mean_rms < 0.6 * dirty.averaging_alone


def test_two_gross_errors_that_hide_each_other_are_named() -> None:
    comparisons = series(4).comparisons.copy()
    comparisons[11, [0, 1]] += 0.3 * ARCSEC
    dirty = CalibrationSeries(ANGLE, comparisons)
    assert dirty.keep[11, [0, 1]].all()
    assert np.flatnonzero(dirty.suspect).tolist() == [11]
    # the bias, 0.06 arcsec, is within two of the sigmas that the angle is given, and far beyond that of the others
    assert dirty.sigma[11] > 0.03 * ARCSEC > 2.0 * dirty.sigma[12]
    # one series in a thousand is accused falsely; none of these 100 (probability of more than two: 2e-4)
    assert sum(int(series(seed).suspect.any()) for seed in range(100)) <= 2


@pytest.mark.second
def test_misfits_are_told_apart() -> None:
    """A constant that the calibration does not share, and an error that is new at every reading."""
    angle = 0.5 * (ANGLE[1:] + ANGLE[:-1])
    white = []
    common = []
    for seed in range(20):
        own = np.random.default_rng((seed, 1)).normal(0.0, 0.05 * ARCSEC, 40)
        held = series(1000 + seed, angle=angle)
        held = CalibrationSeries(angle, held.comparisons + own[:, None] + 0.1 * ARCSEC)
        calibration = series(seed)
        choice = choose(calibration, names=("cubic_spline",))
        made = compensate(calibration, choice, held)
        white.append(made.white / ARCSEC)
        common.append(made.common / ARCSEC)
        assert compensate(calibration, choice).white == 0.0
    # each is estimated from 40 readings, to 1 / sqrt(80) = 11%, the mean of 20 estimates to 2.5%: 4 sigma
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(0.05, rel=0.1)
    assert np.mean(common) == pytest.approx(0.1, rel=0.1)


@pytest.mark.second
def test_covariance_of_two_sets_of_readings() -> None:
    calibration = series(6)
    choice = choose(calibration, names=("fourier",))
    made = DividingCompensation(choice["fourier"].fit, calibration.step, 3e-8, 2e-8, 1e-8, 1e-7, calibration.step)  # type: ignore[arg-type]
    both = np.radians([95.0, 95.1, 103.0])
    whole = made.covariance(both)
    np.testing.assert_allclose(made.covariance(both[:1], both[1:]), whole[:1, 1:], rtol=1e-12)
    np.testing.assert_allclose(made.sigma(both) ** 2, np.diag(whole), rtol=1e-12)
    assert step_kernel(both, both, calibration.step)[0].tolist() == pytest.approx([1.0, 0.8, 0.0])


@pytest.mark.parametrize(
    ("angle", "comparisons", "text"),
    [
        (np.full(5, 1.7), np.zeros((5, 3)), "all 5 angles are the same; step the table"),
        ([1.0, 3.0, 2.0], np.zeros((3, 3)), "must increase"),
        ([1.0, 2.0, 3.0], np.zeros((3, 1)), "one repeat does not determine the noise"),
        ([1.0, 2.0, 3.0], np.zeros((2, 3)), "found"),
        ([1.0, 2.0, 3.0], np.full((3, 3), np.inf), "finite"),
    ],
)
def test_bad_series(angle: list[float], comparisons: np.ndarray, text: str) -> None:
    refuses(ValueError, text, CalibrationSeries, np.array(angle), comparisons)


def slow_error(rng: np.random.Generator, reading: np.ndarray) -> np.ndarray:
    """An error of a table of 1 arcsec with waves of 6 deg and longer, random for each table."""
    waves = 2.0 * np.pi / np.radians(np.array([6.0, 11.0, 23.0, 60.0]))
    size, phase = rng.normal(size=4) * ARCSEC, rng.uniform(0.0, 2.0 * np.pi, 4)
    return np.asarray(size @ np.sin(waves[:, None] * reading + phase[:, None]))


@pytest.mark.parametrize("name", quick(1, ["piecewise_linear", "cubic_spline"]))
def test_a_gap_is_outside_and_a_missing_angle_has_a_sigma_that_holds(name: str) -> None:
    """One angle of 41 was not compared, and eight elsewhere in a row. The readings in the first gap are met by sigma,
    whose mean square is one within four sigma of its own scatter over 25 tables; those in the second are refused.
    """
    angle = np.radians(np.delete(np.arange(-20.0, 20.5, 1.0), [10, *range(24, 32)]))
    missing, ratios = np.radians(-10.0), []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        at = np.append(angle, missing)
        truth = slow_error(rng, at)
        series = CalibrationSeries(angle, truth[:-1, None] + rng.normal(0.0, 0.03 * ARCSEC, (len(angle), 8)), 1e-9)
        made = compensate(series, choose(series, names=(name,)))
        ratios.append((made.error(missing) - truth[-1]) / made.sigma(missing)[0])
        for inside in (4.5, 8.0, 11.9):
            refuses(UndeterminedError, "lies in a gap of the calibration", made.correct, np.radians([0.0, inside]))
    # the misfit is stated from all angles, so that sigma may be on the safe side
    assert np.mean(np.square(ratios)) < 1.0 + 4.0 * np.sqrt(2.0 / len(ratios))
    assert not np.any(covered(angle, np.radians([3.5, 8.0, 20.1])))
    assert np.all(covered(angle, np.radians([-20.0, -10.0, 3.0, 12.0, 20.0])))


# --- angle fits -------------------------------------------------------------------------------------------------------

LINEAR = tuple(name for name in FITS if name != "network")
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
    made, there = fit_dividing_error(ANGLE, value, 0.1, name), fit_dividing_error(ANGLE + turn, value, 0.1, name)
    np.testing.assert_allclose(made.weights(BETWEEN) @ value, made(BETWEEN), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(made.weights(BETWEEN).sum(axis=1), 1.0, rtol=0.0, atol=1e-8)
    assert there.settings == pytest.approx(made.settings)
    np.testing.assert_allclose(there(BETWEEN + turn), made(BETWEEN), rtol=0.0, atol=1e-9)


def test_a_polynomial_is_found() -> None:
    x = np.degrees(ANGLE) - 102.0
    made = fit_dividing_error(ANGLE, x**3 - 20.0 * x, 1.0, "polynomial")
    at = np.degrees(BETWEEN) - 102.0
    np.testing.assert_allclose(made(BETWEEN), at**3 - 20.0 * at, rtol=0.0, atol=1e-9 * 1000.0)
    # with noise the order stays near the true one: leave-one-out does not run away to the highest
    noise = 10.0 * np.random.default_rng(3).standard_normal(41)
    assert 3 <= fit_dividing_error(ANGLE, x**3 - 20.0 * x + noise, 10.0, "polynomial").settings["order"] <= 8


def test_smoothing_spline_is_scipys() -> None:
    """The same minimum with the smoothing that was selected, from SciPy's B-spline solver; unequal weights."""
    sigma = np.where(np.arange(41) % 5 == 0, 0.6, 0.3)
    value = wave(ANGLE) + sigma * np.random.default_rng(4).standard_normal(41)
    made = fit_dividing_error(ANGLE, value, sigma)
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
    monkeypatch.setattr(dividing_error, "DECAY", 0.1)
    rng = np.random.default_rng(11)
    n, h = 15, 4
    x, y, weight = np.linspace(-5.0, 5.0, n), rng.standard_normal(n), rng.uniform(0.5, 2.0, n)

    def output(theta: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.asarray(np.tanh(np.outer(at, theta[:h]) + theta[h : 2 * h]) @ theta[2 * h : 3 * h] + theta[-1])

    def trained(value: np.ndarray, start: np.ndarray) -> np.ndarray:
        def loss(z: np.ndarray) -> np.ndarray:
            decay = np.sum(z[:h] ** 2) + np.sum(z[2 * h : 3 * h] ** 2)
            return np.asarray(0.5 * np.sum(weight * (output(z, x) - value) ** 2) + 0.5 * dividing_error.DECAY * decay)

        def slope(theta: np.ndarray) -> np.ndarray:
            """By complex step, exact to rounding."""
            return np.array([loss(z).imag / 1e-30 for z in theta + 1e-30j * np.eye(len(theta))])

        return np.asarray(minimize(loss, start, jac=slope, method="BFGS", options={"gtol": 1e-10}).x)

    theta = trained(y, rng.standard_normal(3 * h + 1))
    net = SimpleNamespace(
        coefs_=[theta[None, :h], theta[2 * h : 3 * h, None]], intercepts_=[theta[h : 2 * h], theta[-1:]]
    )
    at = np.linspace(-5.0, 5.0, 23)
    told = dividing_error.gradient(net, at) @ dividing_error.response(net, x, y, weight)
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
        weight = fit_dividing_error(ANGLE[others], wave(ANGLE[others]), sigma[others], "piecewise_linear").weights(
            ANGLE[i : i + 1]
        )[0]
        assert checked.variance[i - 1] == pytest.approx(sigma[i] ** 2 + weight**2 @ sigma[others] ** 2, rel=1e-9)


@pytest.mark.parametrize("name", FITS)
def test_too_few_angles(name: str) -> None:
    count = fewest(name)
    with pytest.raises(ValueError, match=f"{name}: {count - 1} angles, but at least {count} are needed"):
        fit_dividing_error(ANGLE[: count - 1], ANGLE[: count - 1], 1.0, name)
    assert fit_dividing_error(ANGLE[:count], wave(ANGLE[:count]), 1.0, name).name == name
    assert angles_left(41, 10) == 37
    refuses(ValueError, "cross-validation leaves", cross_validate, name, ANGLE[:count], wave(ANGLE[:count]), 1.0)


@pytest.mark.parametrize("name", FITS)
def test_bad_angles(name: str) -> None:
    refuses(
        ValueError, "all 41 angles are the same; step the table", fit_dividing_error, np.full(41, 1.7), ANGLE, 1.0, name
    )
    refuses(ValueError, "average the repeats", fit_dividing_error, np.repeat(ANGLE[:20], 2), np.zeros(40), 1.0, name)
    refuses(ValueError, "finite", fit_dividing_error, ANGLE, np.where(np.arange(41) == 3, np.nan, 0.0), 1.0, name)
    refuses(ValueError, "greater than zero", fit_dividing_error, ANGLE, ANGLE, 0.0, name)


def test_unknown_fit_and_outside_of_the_points() -> None:
    refuses(ValueError, r"'bezier'.*piecewise_linear", fit_dividing_error, ANGLE, ANGLE, 1.0, "bezier")
    made = fit_dividing_error(ANGLE, ANGLE, 1.0)
    with pytest.raises(ValueError, match=r"calibrated from 92\.0000 to 112\.0000 deg; calibrate the whole range"):
        made(np.radians(112.1))


def test_network_that_does_not_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dividing_error, "MOST_ITERATIONS", 2)
    refuses(NotConvergedError, "none of 4 trainings", fit_dividing_error, ANGLE, wave(ANGLE), 0.1, "network")
    series = CalibrationSeries(ANGLE, wave(ANGLE)[:, None] + np.random.default_rng(1).normal(0.0, 0.1, (41, 5)))
    choice = choose(series, names=("network", "cubic_spline"))
    assert choice.chosen == "cubic_spline"
    assert "none of 4" in choice.failed["network"]
    refuses(ValueError, "no fit of the dividing error succeeded", choose, series, names=("network",))
