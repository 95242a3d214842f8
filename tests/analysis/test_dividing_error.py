"""Chauvenet's criterion on printed examples and on normal noise, series of comparisons, the compensation's sigmas.

Chi-square tests have a false-alarm rate of 1e-4 each, two-sided; seeds are fixed, so that they pass or fail for good.
"""

import math

import numpy as np
import pytest

from analysis.arrays import UndeterminedError
from analysis.turntable.dividing_error import (
    CalibrationSeries,
    DividingCompensation,
    chauvenet,
    choose,
    compensate,
    covered,
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
        ([1.0, 2.0, 3.0], np.zeros((3, 1)), "one repeat only"),
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
