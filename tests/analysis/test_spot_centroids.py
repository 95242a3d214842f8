"""Spot estimators on simulated Airy spots: bias, stated sigma against scatter, efficiency, cancellation of the fixed
pattern.

The frames are drawn here from their own few lines of numpy and not by the twin's detector, so that the analysis is
tested by itself. Statistical limits are two-sided chi-square quantiles with a false-alarm rate of 1e-6 per comparison.
Each spot has a fixed pattern of its own: the pattern's scatter can only be seen over many detectors.
"""

import numpy as np
import pytest
from scipy import stats
from scipy.special import j1

from analysis.spots.centroid import _GAUSS_MOVE_PX, _wandered, energy_centroid, gaussian_fit, mean_frames
from analysis.spots.likelihood import _bound, image_bound, maximum_likelihood_fit
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotError, difference_covariance, sane, template_model
from analysis.spots.spot_template import SpotTemplate
from tests.analysis.refusals import refuses
from tests.tiers import quick

FALSE_ALARM, FIRST_ZERO_PX = 1e-6, 7.0
SHAPE = (96, 96)
FRAMES = 9
GAIN, DARK_NOISE_E, OFFSET, PRNU, DSNU_E = 0.06, 16.0, 64.0, 0.01, 5.0
NOISE = NoiseModel(GAIN, DARK_NOISE_E, 0.0, OFFSET, PRNU, DSNU_E, 4095.0)
PEAK_E, SKY_E = 50000.0, 3.0


def cramer_rao_bound(template, row, column, flux, background, noise, frames):
    """Least covariance (B, 2, 2) px^2 of places of spots (B,) of which the template is known, but for their light.

    Inverse Fisher information of the normal likelihood (Kay, Estimation Theory, 1993, eq. 3.31) without the term of
    the variance's own derivative, which Poisson noise does not have.
    """
    theta = np.stack(np.broadcast_arrays(row, column, flux, background), axis=1)
    return _bound(*template_model(theta, np.arange(len(theta)) % template.count, template), noise, frames)


def airy(row, column, shape=SHAPE, zero=FIRST_ZERO_PX):
    r, c = np.indices(shape)
    x = np.maximum(np.hypot(r - row, c - column) * (3.8317059702075125 / zero), 1e-9)
    return (2 * j1(x) / x) ** 2


def electrons(places):
    return np.stack([PEAK_E * airy(r, c) + SKY_E for r, c in places])


def pattern(count, seed):
    rng = np.random.default_rng(seed)
    return 1 + PRNU * rng.standard_normal((count, *SHAPE)), DSNU_E * rng.standard_normal((count, *SHAPE))


def record(light, fixed, seed, frames=FRAMES):
    """Mean frames (B, H, W): rounding to whole DN of each frame included."""
    rng = np.random.default_rng(seed)
    total = np.zeros(light.shape)
    for _ in range(frames):
        read = DARK_NOISE_E * rng.standard_normal(light.shape) + fixed[1]
        total += np.rint(GAIN * (rng.poisson(light * fixed[0]) + read) + OFFSET)
    return total / frames


@pytest.fixture(scope="module")
def template():
    return SpotTemplate.from_image(airy(73.7, 73.2, (148, 148)), 73.7, 73.2, SHAPE)


@pytest.fixture(scope="module")
def places():
    return np.random.default_rng(5).uniform(44, 51, (200, 2))


@pytest.fixture(scope="module")
def light(places):
    return electrons(places)


@pytest.fixture(scope="module")
def fixed():
    return pattern(200, 1)


@pytest.fixture(scope="module")
def before(light, fixed):
    return record(light, fixed, 2)


def measure(name, mean, template, frames=FRAMES):
    if name == "likelihood":
        return maximum_likelihood_fit(mean, frames, NOISE, template)
    if name == "energy":
        return energy_centroid(mean, frames, NOISE)
    return gaussian_fit(mean, frames, NOISE, elliptical=name == "gauss elliptical")


ALL = ["likelihood", "energy", "gauss", "gauss elliptical"]


def agrees(error, covariance):
    """Chi-square of (B, 2) errors with (B, 2, 2) covariance is inside its two-sided limits."""
    chi2 = np.einsum("bi,bij,bj->", error, np.linalg.inv(covariance), error)
    return FALSE_ALARM / 2 < stats.chi2.sf(chi2, error.size) < 1 - FALSE_ALARM / 2


# Without noise. The likelihood fit has only the interpolation error (1e-4 px asked of the template, 2e-6 px reached).
# The others are exact by symmetry but for the pixels that their window's edge cuts: some 1e-4 px.
@pytest.mark.second
@pytest.mark.parametrize(("name", "limit"), [("likelihood", 1e-5), ("energy", 3e-4), ("gauss", 1e-4)])
def test_bias_without_noise(name, limit, template, places, light):
    clean = GAIN * light[:60] + OFFSET
    found = measure(name, clean, template)
    error = np.abs(found.position - places[:60])
    assert np.all(found.converged)
    assert error.max() < limit
    # and the covariance states more than the bias, so that the bias cannot spoil the scatter tests below
    assert error.max() < 0.25 * found.sigma_row.min()


@pytest.mark.second
@pytest.mark.parametrize("name", quick(2, ALL))
def test_scatter_agrees_with_stated_sigma(name, template, places, before):
    found = measure(name, before, template)
    assert np.all(found.converged)
    assert agrees(found.position - places, found.covariance)
    # the fixed pattern is a large part here: leaving it out must fail, or the test would prove little
    assert not agrees(found.position - places, found.temporal_covariance)


@pytest.fixture(scope="module", params=quick(1, [1.3, 0.0, 12.0]))
def moved(request, places, fixed):
    """How far the spots moved, and what the same pixels then record."""
    step = np.array([request.param, -0.5 * request.param])
    return step, record(electrons(places + step), fixed, 3)


@pytest.mark.parametrize("name", quick(0, ["likelihood", "energy", "gauss"]))
def test_difference_agrees_with_stated_sigma(name, moved, template, before):
    """Before and after on the same pixels: at rest the pattern cancels, moved by a spot's size it counts twice."""
    step, after = moved
    move = step[0]
    one = measure(name, before, template)
    two = measure(name, after, template)
    covariance = difference_covariance(one, two, NOISE)
    assert agrees(two.position - one.position - step, covariance)
    temporal = one.temporal_covariance + two.temporal_covariance
    ratio = covariance[:, 0, 0] / temporal[:, 0, 0]
    if move == 0:
        assert np.all(np.abs(ratio - 1) < 0.01)
    else:
        assert np.all(ratio > 1.1)
    if move == 12:
        separate = one.covariance + two.covariance
        # Airy rings still overlap a little
        assert np.all(np.abs(covariance[:, 0, 0] / separate[:, 0, 0] - 1) < 0.15)


def test_the_bound_of_an_image_is_that_of_its_shape(template):
    """Without a template, from slopes of the image. Differences of fourth order miss (k h)^4 / 30 of a frequency k, 5 %
    at the cut-off of 2 pi / 5.7 px and a tenth of that in the mean over the spot: at most 5e-3 of a variance.
    """
    places = np.array([[47.3, 47.9], [45.0, 50.5]])
    flux = GAIN * PEAK_E * airy(73.7, 73.2, (148, 148)).sum()
    background = GAIN * SKY_E + OFFSET
    bound = cramer_rao_bound(template, places[:, 0], places[:, 1], flux, background, NOISE, FRAMES)
    wide = np.stack([GAIN * PEAK_E * airy(r + 2, c + 2, (100, 100)) for r, c in places])
    found = image_bound(wide, background, NOISE, FRAMES)
    assert np.diagonal(found, axis1=1, axis2=2) == pytest.approx(np.diagonal(bound, axis1=1, axis2=2), rel=5e-3)


@pytest.mark.second
def test_shape_that_does_not_fit_shows_in_chi_square(template, light, before, places):
    good = maximum_likelihood_fit(before, FRAMES, NOISE, template).reduced_chi_square
    # each has 9212 degrees of freedom: sigma 1.5%; 6 sigma on 200 spots is a false alarm of 4e-7
    assert np.all(np.abs(good - 1) < 6 * np.sqrt(2 / 9212))
    ghost = before[:4] + GAIN * 2000 * np.stack([airy(r + 9, c) for r, c in places[:4]])
    assert np.all(maximum_likelihood_fit(ghost, FRAMES, NOISE, template).reduced_chi_square > 2)


@pytest.mark.second
def test_chi_square_of_a_gaussian_fit_is_per_degree_of_freedom():
    """Draws that are orthogonal to each other have the mean of all draws, but for what is not linear (1e-5)."""
    row, column = np.indices((24, 24))
    level = GAIN * (PEAK_E * np.exp(-((row - 11.2) ** 2 + (column - 11.7) ** 2) / 3.0) + SKY_E) + OFFSET
    noise = NoiseModel(GAIN, DARK_NOISE_E, 0.0, OFFSET, 0.0, 0.0, 4095.0)
    drawn = 24.0 * np.linalg.qr(np.random.default_rng(3).standard_normal((576, 576)))[0].reshape(576, 24, 24)
    found = gaussian_fit(level + np.sqrt(noise.temporal_variance_dn2(level, 1)) * drawn, 1, noise)
    assert np.mean(found.reduced_chi_square) == pytest.approx(1.0, abs=1e-4)


def test_influence_maps_predict_small_changes(template, light):
    """Position change from a small random disturbance against the maps; the rest is of second order."""
    clean = (GAIN * light + OFFSET)[:3]
    rng = np.random.default_rng(8)
    for name in ALL:
        noise = rng.standard_normal(clean.shape) * np.sqrt(clean) * 0.02
        plus, minus = (measure(name, clean + sign * noise, template).position for sign in (1, -1))
        maps = measure(name, clean, template).gain_maps
        predicted = np.einsum("bihw,bhw->bi", maps, noise)
        # Fisher scoring leaves the change of the weights out, which the residual multiplies: zero for a perfect shape
        assert np.abs((plus - minus) / 2 - predicted).max() < 5e-3 * np.abs(predicted).max(), name


def test_one_before_serves_many_states_and_threads_do_not_matter(template, before):
    first = maximum_likelihood_fit(before[:4], FRAMES, NOISE, template)
    all_states = maximum_likelihood_fit(before[:12], FRAMES, NOISE, template, threads=2)
    alone = maximum_likelihood_fit(before[:12], FRAMES, NOISE, template)
    assert np.array_equal(all_states.row, alone.row)
    joint = difference_covariance(first, all_states, NOISE)
    tiled = maximum_likelihood_fit(np.tile(before[:4], (3, 1, 1)), FRAMES, NOISE, template)
    assert np.allclose(joint, difference_covariance(tiled, all_states, NOISE), rtol=1e-9, atol=1e-16)


def test_mean_frames_is_exact():
    frames = np.full((2, 7, 3, 3), 65535, dtype=np.uint16)
    frames[0, 0] = 0
    mean = mean_frames(frames)
    assert mean.shape == (2, 3, 3)
    assert mean[0, 0, 0] == 65535 * 6 / 7
    assert mean[1, 0, 0] == 65535
    refuses(ValueError, "integers", mean_frames, frames.astype(float))


@pytest.mark.parametrize("name", ["likelihood", "energy", "gauss"])
def test_bad_spots_are_named(name, template, before):
    batch = before[:20].copy()
    rng = np.random.default_rng(4)
    batch[3] = OFFSET + 0.3 * rng.standard_normal(SHAPE)
    batch[11] = np.minimum(OFFSET + 2 * (batch[11] - OFFSET), 4095.0)
    batch[17] = np.roll(batch[17], -42, axis=0)
    with pytest.raises(SpotError) as caught:
        measure(name, batch, template)
    assert caught.value.indices == [3, 11, 17]
    assert "no spot" in caught.value.reasons[3]
    assert "saturated" in caught.value.reasons[11]
    assert "edge" in caught.value.reasons[17]
    assert "spot 3: " in str(caught.value)


def test_spot_beyond_the_template_is_named(before):
    narrow = SpotTemplate.from_image(airy(51.7, 51.2, (104, 104)), 51.7, 51.2, SHAPE)
    refuses(SpotError, "larger margin", maximum_likelihood_fit, np.roll(before[:2], 25, axis=1), FRAMES, NOISE, narrow)


def test_bad_input(template, before):
    refuses(ValueError, "not finite", maximum_likelihood_fit, np.full(SHAPE, np.nan), FRAMES, NOISE, template)
    refuses(ValueError, "template is for", maximum_likelihood_fit, before[:1, :90], FRAMES, NOISE, template)
    found = maximum_likelihood_fit(before[:1], FRAMES, NOISE, template, keep_maps=False)
    refuses(ValueError, "keep_maps", difference_covariance, found, found, NOISE)


@pytest.mark.parametrize("move", [(1.1, 0.0), (-1.1, 0.0), (0.0, 1.1), (0.0, -1.1)])
def test_a_gaussian_that_wanders_is_told_whichever_way_it_goes(move):
    row, column = np.array([20.0]), np.array([30.0])
    theta = np.array([[20.0 + _GAUSS_MOVE_PX * move[0], 30.0 + _GAUSS_MOVE_PX * move[1], 1.0, 0.0, 1.0]])
    assert _wandered(theta, row, column).all()
    assert not _wandered(np.array([[20.0, 30.0, 1.0, 0.0, 1.0]]), row, column).any()


def test_faint_and_narrow_gaussians_are_still_gaussians():
    """Less than one unit of light, and narrower than a pixel; not those without light or without width."""
    good = np.array([[20.0, 30.0, 0.3, 0.0, 0.2]])
    assert sane(good).all()
    assert not sane(good * [[1, 1, -1, 1, 1]]).any()
    assert not sane(good * [[1, 1, 1, 1, -1]]).any()
