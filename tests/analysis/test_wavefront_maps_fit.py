"""Pupils found by their light; terms fitted over any of it, with sigmas that hold for correlated noise, too."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from analysis.arrays import UndeterminedError
from analysis.wavefront_maps.map_files import MapError, WavefrontMap
from analysis.wavefront_maps.pupil_fit import Pupil, find_pupil, fit_map
from analysis.wavefront_maps.zernike_table import circle_terms
from tests.analysis.refusals import refuses
from tests.tiers import quick


def map_of(values: np.ndarray) -> WavefrontMap:
    return WavefrontMap(values, math.nan, None, None)


def disk(size: int, x: float, y: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    return (columns - x) / radius, (rows - y) / radius


LIGHT = {
    "disk": lambda x, y: np.hypot(x, y) <= 1.0,
    "ring": lambda x, y: np.abs(np.hypot(x, y) - 0.675) <= 0.325,
    "spiders": lambda x, y: (np.abs(np.hypot(x, y) - 0.675) <= 0.325) & (np.abs(x) > 0.04) & (np.abs(y) > 0.04),
    "cut": lambda x, y: (np.hypot(x, y) <= 1.0) & (y < 0.5) & (x > -0.8),
    "dropouts": lambda x, y: (np.hypot(x, y) <= 1.0) & (np.random.default_rng(2).random(x.shape) > 0.05),
    "specks": lambda x, y: (np.hypot(x, y) <= 1.0) | (np.hypot(x - 1.08, y - 1.05) < 0.04),
    "beyond the camera": lambda x, y: np.hypot(x, y) <= 1.0,
}


@pytest.mark.parametrize("light", quick(3, LIGHT))
def test_the_pupil_is_found_by_its_light(light):
    """To a tenth of a pixel where a radius has a hundred: half a pixel in the edge's steps, of which there are many."""
    rng = np.random.default_rng(5)
    for _ in range(3):
        at_x, at_y, radius = rng.uniform(115, 130), rng.uniform(115, 130), rng.uniform(85, 105)
        x, y = disk(250, at_x, at_y, radius)
        lit = LIGHT[light](x, y)
        # where the map ends in the light there is no edge
        first = int(at_x - 0.8 * radius) if light == "beyond the camera" else 0
        last = int(at_x + 0.9 * radius) if light == "beyond the camera" else 250
        found = find_pupil(map_of(np.where(lit, 0.0, np.nan)[:, first:last]))
        np.testing.assert_allclose([found.x + first, found.y, found.radius], [at_x, at_y, radius], rtol=0, atol=0.12)


def test_light_without_a_round_edge_needs_a_stated_pupil():
    values = np.full((60, 60), np.nan)
    refuses(UndeterminedError, "no lit pixel", find_pupil, map_of(values))
    values[10:50, 10:30] = 0.0
    refuses(UndeterminedError, "state them in pixels", find_pupil, map_of(values))
    with pytest.raises(UndeterminedError, match="state them in pixels"):
        find_pupil(map_of(np.zeros((20, 20))))  # steps at the end of a map are no edge
    refuses(MapError, "radii are positive", Pupil, 1.0, 2.0, 0.0)


@pytest.mark.parametrize("light", ["disk", "ring", "spiders", "cut"])
def test_coefficients_come_back_exactly(light):
    x, y = disk(90, 44.3, 45.1, 40.0)
    lit = LIGHT[light](x, y)
    terms = tuple(range(1, 29))
    truth = np.random.default_rng(1).normal(size=28) * 1e-7
    values = np.full(x.shape, np.nan)
    values[lit] = circle_terms(terms, x[lit], y[lit]) @ truth
    found = fit_map(map_of(values), terms, Pupil(44.3, 45.1, 40.0))
    np.testing.assert_allclose(found.coefficients, truth, rtol=0, atol=1e-19)
    np.testing.assert_allclose(found.parts, found.factor @ truth, rtol=0, atol=1e-20)
    # parts are shares of the rms over the light
    assert np.sum(found.parts[1:] ** 2) == pytest.approx(found.rms**2, rel=1e-12)
    assert found.points == np.count_nonzero(lit)
    assert found.beyond == 0
    assert found.residual_rms < 1e-20


def test_distortion_of_the_picture_of_the_pupil():
    """A wavefront seen through a lens that moves points of the pupil comes back with the mapping and not without."""
    terms = tuple(range(1, 16))
    truth = np.random.default_rng(2).normal(size=15) * 1e-7
    pupil = Pupil(60.0, 58.0, 50.0, (0.04, -0.01))
    rows, columns = np.meshgrid(np.arange(120.0), np.arange(120.0), indexing="ij")
    x, y = pupil.unit(columns, rows)
    r = np.hypot(columns - 60.0, rows - 58.0) / 50.0
    # the edge stays, other points move by the stated polynomial
    np.testing.assert_allclose(np.hypot(x, y), r * (1 + 0.04 * (r**2 - 1) - 0.01 * (r**4 - 1)), rtol=1e-12, atol=1e-15)
    values = np.full(x.shape, np.nan)
    values[r <= 1.0] = circle_terms(terms, x[r <= 1.0], y[r <= 1.0]) @ truth
    np.testing.assert_allclose(fit_map(map_of(values), terms, pupil).coefficients, truth, rtol=0, atol=1e-18)
    plain = fit_map(map_of(values), terms, Pupil(60.0, 58.0, 50.0)).coefficients
    assert np.abs(plain - truth).max() > 5e-9


def noise_map(rng: np.random.Generator, size: int, length: float) -> np.ndarray:
    """Noise of unit rms with a Gaussian correlation, whose smoothing has the length in pixels."""
    white = rng.normal(size=(2 * size, 2 * size))
    smooth = gaussian_filter(white, length, mode="wrap") if length else white
    return (smooth / smooth.std())[:size, :size]


@pytest.mark.parametrize(
    ("length", "light", "low", "high"),
    quick(1, [(0.0, "disk", 0.9, 1.1), (2.0, "cut", 0.9, 1.15), (2.0, "ring", 0.9, 1.15), (5.0, "disk", 0.85, 1.2)]),
)
def test_sigmas_hold_for_correlated_noise(length, light, low, high):
    """Mean square of errors over sigmas, and coverage of 68 and 95 %: 40 maps of 11 terms.

    With 5 px there are only some 50 independent pixels, so that the covariance is itself an estimate. Taken for
    independent, the pixels would make sigmas 7 and 18 times too small with 2 and 5 px.
    """
    rng = np.random.default_rng(17)
    x, y = disk(150, 75.0, 74.0, 70.0)
    lit = LIGHT[light](x, y)
    terms = tuple(range(1, 12))
    scores, independent = [], []
    for _ in range(40):
        values = np.where(lit, 1e-8 * noise_map(rng, 150, length), np.nan)
        found = fit_map(map_of(values), terms, Pupil(75.0, 74.0, 70.0))
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
        scores.append(found.parts / np.sqrt(np.diag(found.parts_covariance)))
        independent.append(found.independent)
    scores = np.array(scores)
    assert low < np.sqrt(np.mean(scores**2)) < high
    covered = np.mean(np.abs(scores) < 1.0), np.mean(np.abs(scores) < 1.96)
    # binomial limits of 440 independent numbers, three sigmas, about the coverage of normal ones of that size
    normal = [math.erf(k / math.sqrt(2.0) / size) for k, size in ((1.0, high), (1.96, high))]
    assert covered[0] > normal[0] - 0.07
    assert covered[1] > normal[1] - 0.035
    expected = np.count_nonzero(lit) / (4.0 * math.pi * length**2 if length else 1.0)
    assert np.mean(independent) == pytest.approx(expected, rel=0.35)


def test_terms_that_the_light_does_not_tell_apart():
    x, y = disk(100, 50.0, 50.0, 45.0)
    values = np.where((np.abs(y) < 1e-9) & (np.abs(x) <= 1.0), 0.0, np.nan)
    with pytest.raises(UndeterminedError, match="Z3 cannot be told from the terms before it"):
        fit_map(map_of(values), range(1, 5), Pupil(50.0, 50.0, 45.0))
    with pytest.raises(UndeterminedError, match="0 lit pixels lie within the pupil"):
        fit_map(map_of(values), range(1, 5), Pupil(500.0, 50.0, 45.0))
    refuses(MapError, "ascending order", fit_map, map_of(values), [1, 4, 2], Pupil(50.0, 50.0, 45.0))


@pytest.mark.second
def test_correlation_within_its_own_noise_counts_as_none():
    """Of white noise: the mean correlation of a ring scatters by one over the root of its pairs, and lies below that
    with a chance of 0.84, where all pixels count as independent. Of 100 maps 65 at least, but for a chance of 1e-5."""
    rng, whole = np.random.default_rng(1), 0
    x, y = disk(64, 31.5, 31.5, 30.5)
    for _ in range(100):
        values = np.where(np.hypot(x, y) <= 0.98, 1e-8 * rng.standard_normal((64, 64)), np.nan)
        found = fit_map(map_of(values), range(1, 7), Pupil(31.5, 31.5, 30.5))
        whole += found.independent > 0.999 * found.points
    assert whole >= 65
