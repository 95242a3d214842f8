"""Positions of spots that small windows undersample, against spots of another model: sums of Gaussians, averaged over
pixels, with warm pixels, uneven response and shot noise, of which the fit knows nothing."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import erf

import analysis
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotError
from analysis.spots.window_series import CAUSES, SeriesPrior, fit_window_series

NOISE = NoiseModel(gain_dn_per_e=0.15, dark_noise_e=20.0)
FALSE_ALARM = 1e-3


def box(away, sigma):
    """Gaussian averaged over a pixel."""
    return 0.5 * (erf((away + 0.5) / sigma / 2**0.5) - erf((away - 0.5) / sigma / 2**0.5))


def core_and_wing(down, right):
    """A sharp spot with an eccentric wing."""
    return 0.8 * box(down, 0.55) * box(right, 0.6) + 0.2 * box(down - 0.5, 1.3) * box(right + 0.3, 1.1)


def ring(down, right):
    """A defocused star, brighter on one side."""
    turns = np.linspace(0.0, 2 * np.pi, 9)[:-1]
    return sum((1 + 0.3 * np.cos(a)) / 8 * box(down - np.cos(a), 0.5) * box(right - np.sin(a), 0.5) for a in turns)


def series(shape, frames, drift, flux, side, seed, jitter=0.003):
    """(images, corners, positions) of a window that follows a drifting spot in steps of a pixel."""
    rng = np.random.default_rng(seed)
    position = side / 2 - 0.6 + np.arange(frames)[:, None] * drift + jitter * rng.standard_normal((frames, 2))
    corner = np.floor(position - position[0] + 0.5).astype(int)
    size = side + int(np.ptp(corner, axis=0).max()) + 1
    corner, position = corner - corner.min(axis=0), position - corner.min(axis=0)
    dark, response = 30.0 * rng.gamma(0.5, 1.4, (size, size)), 1 + 0.01 * rng.standard_normal((size, size))
    images = []
    for (r, c), (row, column) in zip(corner, position, strict=True):
        part = np.s_[r : r + side, c : c + side]
        rows, columns = np.arange(r, r + side) - row, np.arange(c, c + side) - column
        light = 20.0 + flux * shape(rows[:, None], columns[None, :]) * response[part]
        grey = NOISE.gain_dn_per_e * rng.poisson(light / NOISE.gain_dn_per_e) + dark[part]
        images.append(grey + rng.normal(0.0, 3.0, grey.shape))
    return np.round(images), corner, position


CASES = [
    (core_and_wing, 10, (0.0005, -0.0003), 36000, 8),
    (ring, 14, (0.004, 0.05), 12000, 6),
    (ring, 14, (0.05, 0.01), 44000, 6),
]


def normalised(fit, position):
    """Chi-square of the errors about their mean, and its degrees of freedom."""
    error = (fit.position - position - np.mean(fit.position - position, axis=0)).ravel()
    left = np.linalg.svd(np.kron(np.ones((1, len(position))), np.eye(2)))[2][2:]
    contrast = left @ error
    return float(contrast @ np.linalg.solve(left @ fit.covariance @ left.T, contrast)), len(left)


@pytest.mark.second
@pytest.mark.parametrize("case", range(3))
def test_coverage(case):
    """Chi-square of errors over six series: both limits at a false-alarm rate of 1e-3, noise learnt and specified."""
    chi, degrees = 0.0, 0
    for seed in range(6):
        images, corners, position = series(*CASES[case], seed)
        fit = fit_window_series(images, NOISE if seed % 2 else None, corners=corners)
        one, free = normalised(fit, position)
        chi, degrees = chi + one, degrees + free
        np.testing.assert_allclose(sum(fit.parts.values()), fit.covariance, atol=1e-12)
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], degrees)
    assert low < chi < high, (chi, degrees)


def test_one_series_with_its_residuals():
    images, corners, position = series(*CASES[1], 3)
    used = np.ones((6, 6), bool)
    used[np.ix_([0, -1], [0, -1])] = False
    fit = analysis.fit_window_series(np.where(used, images, np.nan), NOISE, corners=corners, used=used)
    chi, degrees = normalised(fit, position)
    assert stats.chi2.sf(chi, degrees) > FALSE_ALARM
    assert set(fit.parts) == set(CAUSES)
    assert np.array_equal(np.isnan(fit.residual[0]), ~used)
    assert abs(fit.reduced_chi_square - 1.0) < 0.25
    # the Cramer-Rao bound of a known shape is a lower limit, the shape and the pattern add to it
    assert np.all(np.diagonal(fit.parts[CAUSES[0]]) < np.diagonal(fit.covariance))
    time = np.arange(len(position))
    chi, degrees, residual = fit.scatter(np.vander(time, 2))
    assert degrees == 2 * len(position) - 4
    assert residual.shape == position.shape
    assert fit.scatter(np.vander(time, 2), CAUSES[0])[0] > chi


def test_a_prior_is_used_as_it_is():
    images, corners, _ = series(*CASES[0], 1)
    prior = SeriesPrior(0.1, 1.0, 1.5, 0.01, 30.0, 0.15, 3.0)
    fit = fit_window_series(images, corners=corners, prior=prior)
    assert fit.prior == prior
    less = fit_window_series(images, corners=corners, prior=SeriesPrior(0.1, 1.0, 1.5, 0.01, 30.0, 0.30, 3.0))
    assert np.all(less.sigma > 1.2 * fit.sigma)


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (lambda image: image[:2], ValueError, "at least 3 frames of 5 x 5 px"),
        (lambda image: image[:, :4], ValueError, "at least 3 frames of 5 x 5 px"),
        (lambda image: np.where(image > 5000, np.nan, image), ValueError, "must be finite"),
        (lambda image: np.tile(image, (9, 1, 1)), ValueError, "at most 4000"),
        (lambda image: 0.0 * image + 100.0, SpotError, "no spot"),
    ],
)
def test_refusals(change, kind, words):
    images, _, _ = series(*CASES[0], 2)
    with pytest.raises(kind, match=words):
        fit_window_series(change(images), NOISE)


def test_saturated_and_other_corners():
    images, _, _ = series(*CASES[0], 2)
    with pytest.raises(SpotError, match="saturated"):
        fit_window_series(images, NoiseModel(saturation_dn=4000.0))
    with pytest.raises(ValueError, match="corners must be"):
        fit_window_series(images, NOISE, corners=[0, 0])


@pytest.mark.parametrize("method", ["gaussian", "energy", "ml"])
def test_small_windows_are_measured_by_every_method(method):
    """A Gaussian that is sampled well in 8 x 8 px: errors within their sigmas, as in large images."""
    rng, errors = np.random.default_rng(5), []
    row, column = np.mgrid[:8, :8]
    wide = np.mgrid[:41, :41] - 20.0
    template = analysis.SpotTemplate.from_image(np.exp(-0.5 * (wide**2).sum(axis=0) / 1.2**2), 20, 20, (8, 8))
    for _ in range(40):
        place = 3.5 + rng.uniform(-0.3, 0.3, 2)
        image = 20.0 + 4000.0 * np.exp(-0.5 * ((row - place[0]) ** 2 + (column - place[1]) ** 2) / 1.2**2)
        fit = analysis.fit_spot(rng.poisson(image), NoiseModel(), method=method, template=template)
        errors.append((np.array([fit.row, fit.column]) - place) / fit.sigma)
    # the energy centroid loses light at the window's edge, which shifts it by a share of the distance from the middle
    limit = 1.8 if method == "energy" else 1.4
    assert np.sqrt(np.mean(np.square(errors))) < limit
