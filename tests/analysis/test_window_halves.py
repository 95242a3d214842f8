"""Differences of the two halves of a window: their covariance, and the test for steps that stands on it."""

import numpy as np
import pytest
from scipy import stats

from analysis.matching.window_checks import FALSE_ALARM, STEP, WindowHalves, relief_field, risk, window_halves
from tests.analysis.test_residual_correlation import SIDE, designs, fitted
from tests.tiers import quick

COUNT = 2000
NONE = np.zeros(COUNT)


def halved(seed, displacement=None, noise=0.3):
    """Halves of windows of a smooth texture, and the noise's variance; displacement (SIDE, SIDE) along rows, px, adds
    what it does to the grey.
    """
    rng = np.random.default_rng(seed)
    design = designs(rng, COUNT)
    grey = noise * rng.standard_normal((COUNT, SIDE**2))
    if displacement is not None:
        grey = grey + displacement.ravel() * design[:, 0]
    return window_halves(design, fitted(design, grey)[1], SIDE), NONE + noise**2


@pytest.mark.second
def test_differences_of_halves_keep_in_their_covariances():
    """Of white noise: chi-square of two degrees of freedom in each of the four splits, to four sigmas."""
    halves, variance = halved(1)
    square = np.einsum("nsi,nsij,nsj->ns", halves.apart, np.linalg.inv(halves.white), halves.apart) / variance[:, None]
    assert np.abs(square.mean(axis=0) - 2.0).max() < 4.0 * 2.0 / np.sqrt(COUNT)
    chance, _power = halves.judged(variance, 0.0)
    # the four splits overlap, so fewer than stated; a Poisson number otherwise
    assert (chance < FALSE_ALARM).sum() <= stats.poisson.isf(1e-3, COUNT * FALSE_ALARM)
    assert COUNT * 0.02 < (chance < 0.05).sum() < COUNT * 0.05 + 4 * np.sqrt(COUNT * 0.05)


@pytest.mark.second
@pytest.mark.parametrize("split", quick(1, range(4)))
def test_a_step_between_halves_is_found_as_often_as_the_power_says(split):
    """A step of STEP along rows between halves, in noise that the weakest split can hardly see it in."""
    row, column = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    step = [row, column, row + column, row - column][split] > 0
    halves, variance = halved(2, STEP * step, noise=2.0)
    assert halves.apart[:, split].mean(axis=0) == pytest.approx(
        [STEP, 0.0], abs=4 * np.sqrt(variance[0] * np.trace(halves.white[:, split].mean(axis=0)) / COUNT)
    )
    chance, power = halves.judged(variance, 0.0)
    found = (chance < FALSE_ALARM).mean()
    assert 0.1 < power.mean() < 1.0
    # power is that of the weakest split and direction
    assert found > power.mean() - 4 * np.sqrt(0.25 / COUNT)


@pytest.mark.second
def test_covariance_of_relief_is_that_of_fields_drawn():
    """Displacements of both axes drawn from the field's covariance, hardly any noise: chi-square of the differences in
    the covariance for tau of 1 px has two degrees of freedom, to four sigmas.
    """
    rng = np.random.default_rng(4)
    design = designs(rng, COUNT)
    share, field, _middle = relief_field(SIDE)
    drawn = rng.standard_normal((COUNT, 2, len(field))) @ np.linalg.cholesky(field + 1e-9 * np.eye(len(field))).T
    grey = np.einsum("nap,nap->np", drawn @ share.T, design[:, :2])
    halves = window_halves(design, fitted(design, grey)[1], SIDE)
    square = np.einsum("nsi,nsij,nsj->ns", halves.apart, np.linalg.inv(halves.effect), halves.apart)
    assert np.abs(square.mean(axis=0) - 2.0).max() < 4.0 * 2.0 / np.sqrt(COUNT)


def test_chance_and_power_by_hand():
    """One split 0.3 and -0.4 px apart with sigmas of 0.1 and 0.2 px, the others together; half of the variance is the
    relief's. The weakest direction of all splits has 0.25 px.
    """
    apart = np.zeros((1, 4, 2))
    apart[0, 2] = 0.3, -0.4
    half = np.tile(0.5 * np.diag([0.1, 0.2]) ** 2, (1, 4, 1, 1))
    half[0, 1] = 0.5 * np.diag([0.25, 0.05]) ** 2
    chance, power = WindowHalves(apart, 0.25 * half, 100.0 * half).judged(np.array([4.0]), 0.01)
    assert chance == pytest.approx(4.0 * stats.chi2.sf(9.0 + 4.0, 2))
    assert power == pytest.approx(stats.ncx2.sf(stats.chi2.isf(FALSE_ALARM / 4.0, 2), 2, (STEP / 0.25) ** 2))


def test_risk_is_what_bayes_leaves():
    """Half of the windows with steps and no power: half; with full power or no steps: none."""
    assert risk(0.5, np.array([0.0, 0.5, 1.0])) == pytest.approx([0.5, 1.0 / 3.0, 0.0])
    assert np.all(risk(0.0, np.array([0.0, 1.0])) == 0.0)


def test_windows_without_a_fit_have_no_verdict():
    design = designs(np.random.default_rng(5), 3)
    residual = np.zeros((3, SIDE**2))
    residual[1] = np.nan
    chance, power = window_halves(design, residual, SIDE).judged(np.ones(3), 0.0)
    assert np.array_equal(np.isnan(chance), [False, True, False])
    assert np.array_equal(np.isnan(power), [False, True, False])
