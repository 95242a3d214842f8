"""Pupils found by their light; terms fitted over any of it."""

import math

import numpy as np
import pytest

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


@pytest.mark.second
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


@pytest.mark.second
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
    # parts are shares of the rms over the light
    assert np.sum(found.parts[1:] ** 2) == pytest.approx(np.var(values[lit]), rel=1e-12)


def test_terms_that_the_light_does_not_tell_apart():
    x, y = disk(100, 50.0, 50.0, 45.0)
    values = np.where((np.abs(y) < 1e-9) & (np.abs(x) <= 1.0), 0.0, np.nan)
    with pytest.raises(UndeterminedError, match="Z3 cannot be told from the terms before it"):
        fit_map(map_of(values), range(1, 5), Pupil(50.0, 50.0, 45.0))
    with pytest.raises(UndeterminedError, match="0 lit pixels lie within the pupil"):
        fit_map(map_of(values), range(1, 5), Pupil(500.0, 50.0, 45.0))
    refuses(MapError, "ascending order", fit_map, map_of(values), [1, 4, 2], Pupil(50.0, 50.0, 45.0))
