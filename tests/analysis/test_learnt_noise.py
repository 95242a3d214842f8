"""A shift by a shape that was learnt from the image before: what noise does to it, image by image and in a series.

Centroids that know no shape, in images with defects: what is put in by the fit, taken off, and what it costs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.frame_screening import ScreenedFrames
from analysis.spots.learnt_template import FittedSpot, learn_template, learnt_shift
from analysis.spots.likelihood import EDGE_PX
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import FitTerms, ScreenedFit, fit_screened
from analysis.spots.spot_image import SeriesNoise, SpotError, SpotPositions
from analysis.spots.spot_template import SpotTemplate
from analysis.spots.static_defects import _off, repaired_centroid
from tests.analysis.refusals import refuses
from tests.analysis.test_spot_centroids import airy
from tests.tiers import quick

NOISE = NoiseModel(0.16, 12.0, 0.5, 100.0, 0.005, 5.0, 16100.0)
SHAPE = (64, 64)
FRAMES = 9
FIRST = np.array([30.7, 32.2])


def spot(place, peak=9000.0, width=2.6):
    """A spot of normal distribution, a little longer in rows, on the detector's dark level; DN."""
    row, column = (np.arange(n) for n in SHAPE)
    along = np.exp(-0.5 * ((row - place[0]) / (1.2 * width)) ** 2)
    return NOISE.dark_level_dn + peak * np.outer(along, np.exp(-0.5 * ((column - place[1]) / width) ** 2))


def screened(mean, good=None, frames=FRAMES):
    used = np.ones(SHAPE, bool) if good is None else good
    return ScreenedFrames(mean, np.full(SHAPE, float(frames)), used, frames, frames, np.zeros((2, 2)), ())


def fitted(frames, learnt, offset=(0, 0)):
    """The shape held against an image, and what the noise of its shift rests on."""
    own = replace(learnt.shape, shape=frames.mean.shape)
    fit = fit_screened(frames.mean, frames.counts, frames.good, NOISE, own, FitTerms(learnt=True))
    return FittedSpot(fit.positions, frames.counts, np.zeros((2, 2)), fit.others, fit.smear, offset)


def shift(before, after):
    """(2,) px, the shape learnt anew."""
    learnt = learn_template(before, NOISE)
    return (fitted(after, learnt).positions.position - fitted(before, learnt).positions.position)[0]


def core(place, radius):
    row, column = np.indices(SHAPE)
    return np.hypot(row - place[0], column - place[1]) < radius


@pytest.mark.second
@pytest.mark.parametrize("case", quick(1, ["alike", "core", "holes"]))
def test_influence_of_the_image_before_is_the_derivative_of_the_shift(case):
    """Whole chains, learning included, with the image before changed by a little noise along and against, of the
    frequencies that learning passes and of all others.

    Against along leaves terms of third order only, 1e-2 of the change by a tenth of the noise.
    """
    place = FIRST + np.array([4.3, -3.6])
    good = [np.ones(SHAPE, bool), np.ones(SHAPE, bool)]
    if case == "core":
        good[1] = ~core(place, 3.0)
    if case == "holes":
        good[0] = ~core(FIRST + np.array([1.0, -2.0]), 1.5)
        good[0][:, 39] = False
    rng = np.random.default_rng(3)
    sigma = np.sqrt(NOISE.temporal_variance_dn2(spot(FIRST), FRAMES))
    # noise in the image, for the frequencies that are passed to end where they do in life
    base = spot(FIRST) + sigma * rng.standard_normal(SHAPE)
    after = screened(spot(place, 14000.0 if case == "core" else 9000.0), good[1])
    learnt = learn_template(screened(base, good[0]), NOISE)
    first, second = (fitted(one, learnt) for one in (screened(base, good[0]), after))
    found = learnt_shift(learnt, first, second, NOISE, SHAPE)
    maps = found.parts[1].pattern[0, :, 2 * base.size : 3 * base.size].reshape(2, *SHAPE)
    maps = maps / np.sqrt(first.temporal(NOISE))
    expected, seen = [], []
    for _ in range(12):
        change = 0.1 * sigma * rng.standard_normal(SHAPE)
        ends = [shift(screened(base + way * change, good[0]), after) for way in (1.0, -1.0)]
        seen.append(0.5 * (ends[0] - ends[1]))
        expected.append(-(maps * change).sum(axis=(1, 2)))
    spread = np.std(expected, axis=0)
    assert np.all(spread > 0.0)
    left = np.sqrt(np.mean(np.square((np.array(seen) - expected) / spread), axis=0))
    # where holes are filled the start of the filling is not followed
    assert np.all(left < (0.1 if case == "holes" else 0.05)), left


def test_noise_of_a_series_is_that_of_its_shifts():
    """Of three images against the same one before, of which two show the spot at one place: the covariance of each
    shift is its own, and in the difference of those two the image before cancels, and the pattern with it.
    """
    rng = np.random.default_rng(6)

    def noisy(place):
        mean = spot(place)
        return screened(mean + np.sqrt(NOISE.temporal_variance_dn2(mean, FRAMES)) * rng.standard_normal(SHAPE))

    before = noisy(FIRST)
    learnt = learn_template(before, NOISE)
    first = fitted(before, learnt)
    after = [fitted(noisy(FIRST + by), learnt) for by in ((0.0, 0.0), (5.3, 1.2), (5.3, 1.2))]
    found = [learnt_shift(learnt, first, one, NOISE, SHAPE) for one in after]
    series = SeriesNoise(found[0].parts[0], most_apart=3)
    for one in found:
        series.add(one.parts[1])
    whole = series.covariance(np.arange(3)).reshape(3, 2, 3, 2)
    for k, one in enumerate(found):
        np.testing.assert_allclose(whole[k, :, k], one.covariance, rtol=1e-5, atol=1e-6 * one.covariance.max())
        assert np.linalg.eigvalsh(one.covariance).min() > 0.0
    difference = whole[1, :, 1] + whole[2, :, 2] - whole[1, :, 2] - whole[2, :, 1]
    own = after[1].positions.temporal_covariance[0] + after[2].positions.temporal_covariance[0]
    # places and light of both differ by their noise, 1e-3 px of 3 and 1e-3 of the light
    np.testing.assert_allclose(difference, own, rtol=2e-2, atol=2e-2 * own.max())
    # what is left of a spot that has not moved is the noise of two images
    still = first.positions.temporal_covariance[0] + after[0].positions.temporal_covariance[0]
    np.testing.assert_allclose(found[0].covariance, still, rtol=2e-2, atol=2e-2 * still.max())


@pytest.mark.parametrize(("width", "narrow"), [(0.6, True), (0.75, True), (1.2, False)])
def test_a_spot_that_pixels_do_not_sample_is_refused(width, narrow):
    """What is finer than two pixels folds into other frequencies, and no interpolation can bring it back."""
    rng = np.random.default_rng(9)
    mean = spot(FIRST, width=width)
    mean = mean + np.sqrt(NOISE.temporal_variance_dn2(mean, FRAMES)) * rng.standard_normal(SHAPE)
    if not narrow:
        assert learn_template(screened(mean), NOISE).light > 0.0
        return
    refuses(SpotError, "too narrow", learn_template, screened(mean), NOISE)


def test_a_spot_beyond_the_template_is_refused():
    """A shape known in 96 x 96 pixels fills 64 x 64 of them for a spot within some 13 pixels of their middle."""
    row, column = np.indices((96, 96)) - 48.0
    template = SpotTemplate.from_image(np.exp(-0.055 * (row**2 + column**2)), 48.0, 48.0, SHAPE)
    for place, reached in ((FIRST, True), ((50.0, 50.0), False)):
        image = screened(spot(place))
        given = (image.mean, image.counts, image.good, NOISE, template)
        if reached:
            assert np.abs(fit_screened(*given).positions.position[0] - place).max() < 0.1
        else:
            refuses(SpotError, "left the range of the template", fit_screened, *given)


def test_a_shape_that_is_mostly_noise_is_refused():
    """Its covariance ends where the noise's own slopes are most of what the fit seems to know."""
    before = screened(spot(FIRST))
    learnt = learn_template(before, NOISE)
    first, second = fitted(before, learnt), fitted(screened(spot(FIRST + 1.3)), learnt)
    # as if the frames before had hundreds of times the noise, in the shape only
    with pytest.raises(SpotError, match="mostly noise"):
        learnt_shift(learnt, replace(first, counts=np.full(SHAPE, 1e-5)), second, NOISE, SHAPE)


# --- repaired image ---------------------------------------------------------------------------------------------------

PLACE, LIGHT = (31.4, 30.7), 4e5
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
