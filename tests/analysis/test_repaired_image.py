"""Centroids that know no shape, in images with defects: what is put in by the fit, taken off, and what it costs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.frame_screening import ScreenedFrames
from analysis.spots.likelihood import EDGE_PX
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import FitTerms, ScreenedFit, fit_screened
from analysis.spots.spot_positions import SpotError, SpotPositions
from analysis.spots.spot_template import SpotTemplate
from analysis.spots.static_defects import _off, repaired_centroid
from tests.analysis.refusals import refuses
from tests.analysis.test_spot_centroids import airy

NOISE = NoiseModel(0.16, 12.0, 0.5, 100.0, 0.005, 5.0, 16100.0)
PLACE, LIGHT, FRAMES = (31.4, 30.7), 4e5, 9
OTHER = (42.3, 41.2, 0.03)


@dataclass
class Bench:
    """An image of a spot, perhaps with slopes and a second one, and what is left out of it."""

    template: SpotTemplate
    image: np.ndarray
    good: np.ndarray
    terms: FitTerms

    def screened(self, image: np.ndarray) -> ScreenedFrames:
        counts = np.full(image.shape, float(FRAMES))
        counts[28, 20:40] = FRAMES - 1
        return ScreenedFrames(image, counts, self.good, FRAMES, FRAMES, np.zeros((2, 2)), ())

    def fit(self, image: np.ndarray) -> ScreenedFit:
        one = self.screened(image)
        return fit_screened(one.mean, one.counts, one.good, NOISE, self.template, self.terms)

    def place(self, image: np.ndarray, measure: Callable) -> tuple[SpotPositions, float]:
        return repaired_centroid(self.screened(image), self.fit(image), NOISE, self.template, measure)


@pytest.fixture(scope="module")
def template() -> SpotTemplate:
    return SpotTemplate.from_image(airy(60.2, 59.6, (120, 120), 6.0), 60.2, 59.6, (64, 64))


def bench(template: SpotTemplate, kind: str) -> Bench:
    """The model's own image without noise."""
    image = 120.0 + LIGHT * template.evaluate(*PLACE)[0][0]
    good, terms = np.ones((64, 64), dtype=bool), FitTerms()
    if kind in ("holes", "all"):
        good[33, 31] = good[30, 28] = good[27, 33] = good[40, 20] = False
        good[:, 36] = False
    if kind in ("beside", "all"):
        v, u = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64), indexing="ij")
        image = image + 30.0 * v - 20.0 * u + OTHER[2] * LIGHT * template.evaluate(*OTHER[:2])[0][0]
        terms = FitTerms(1, (OTHER[:2],), kind == "all")
    image = np.where(good, image, 9000.0)
    return Bench(template, image, good, terms)


def gaussian(image: np.ndarray, noise: NoiseModel) -> SpotPositions:
    return gaussian_fit(image, FRAMES, noise)


def energy(image: np.ndarray, noise: NoiseModel) -> SpotPositions:
    return energy_centroid(image, FRAMES, noise)


MEASURES = [gaussian, energy]


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("kind", ["holes", "beside", "all"])
def test_a_repaired_image_has_the_centre_of_the_clean_one(template, measure, kind):
    """Without noise the fit is exact, and so is the repair."""
    clean = measure(bench(template, "clean").image[None], NOISE)
    dirty = bench(template, kind)
    found, _ = dirty.place(dirty.image, measure)
    # the fit ends within 1e-6 px
    np.testing.assert_allclose(found.position, clean.position, rtol=0, atol=3e-6)
    # and without repair it is another one
    assert np.abs(measure(np.minimum(dirty.image, 9000.0)[None], NOISE).position - clean.position).max() > 1e-3


def test_a_spot_that_ends_at_the_side_is_refused(template):
    """It was inside in the image before, from whose place the fit starts."""
    whole = np.full((64, 64), 9.0), np.ones((64, 64), bool), NOISE, template, FitTerms()
    inside, side = (120.0 + LIGHT * template.evaluate(EDGE_PX + by, 30.7)[0][0] for by in (2.0, -1.0))
    near = fit_screened(inside, *whole)
    refuses(SpotError, "edge", fit_screened, side, *whole, near)


def test_three_pixels_tell_no_spot(template):
    good = np.zeros((64, 64), bool)
    good[30:33, 31] = True
    image = 120.0 + LIGHT * template.evaluate(31.0, 31.0)[0][0]
    refuses(SpotError, "too few good pixels", fit_screened, image, np.full((64, 64), 9.0), good, NOISE, template)


@pytest.mark.second
@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("kind", ["holes", "beside", "all"])
def test_the_influence_of_every_pixel_is_the_change_it_makes(template, measure, kind):
    """Directional derivatives through fit, repair and centroid, along random images: the fit's information is that of
    expected second derivatives and its weights are held, which is exact where model and image agree.
    """
    dirty = bench(template, kind)
    found, _ = dirty.place(dirty.image, measure)
    assert found.gain_maps is not None
    random = np.random.default_rng(3)
    for _ in range(3):
        way = random.standard_normal(dirty.image.shape)
        size = 2e-2
        ends = [dirty.place(dirty.image + sign * size * way, measure)[0].position[0] for sign in (1, -1)]
        change = (ends[0] - ends[1]) / (2 * size)
        expected = np.einsum("ahw,hw->a", found.gain_maps[0], way)
        scale = np.sqrt(np.einsum("ahw,ahw->a", found.gain_maps[0], found.gain_maps[0]))
        np.testing.assert_array_less(np.abs(change - expected), 0.01 * scale)
    assert np.all(found.gain_maps[0][:, ~dirty.good] == 0.0)


@pytest.mark.parametrize("level", [0.1, 30.0])
def test_pixels_are_off_by_sigmas_whatever_the_noise(level):
    """Of 4096 pixels one is beyond six sigmas with a chance of 1e-5; a pixel of twelve is."""
    residual = np.random.default_rng(2).standard_normal((64, 64))
    residual[20, 30] += 12.0
    found = _off(level * residual, np.full((64, 64), level**2), np.ones((64, 64), bool), 6.0)
    assert np.argwhere(found).tolist() == [[20, 30]]


@pytest.mark.parametrize(("width", "fits"), [(4.0, True), (7.0, False)])
def test_a_spot_that_is_smeared_beyond_its_shape_is_another(template, width, fits):
    """No vibration moves a spot by more than 5 px rms: what is wider is no smeared one, and does not fit."""
    one = bench(template, "clean")
    one.terms = FitTerms(smear=True)
    found = one.fit(120.0 + gaussian_filter(one.image - 120.0, width))
    assert (found.core[0] < 1.0) == fits
