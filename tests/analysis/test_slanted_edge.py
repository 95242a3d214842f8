"""Slanted-edge MTF against images whose MTF is known exactly.

Truth is independent of the estimator: the optical transfer function of a circular pupil by formula, times the pixel's
sincs; the edge-spread function by Gauss-Legendre
quadrature over frequency, evaluated at each pixel's distance from the edge. Nothing is oversampled, binned or cut off.

Statistical limits are two-sided chi-square quantiles with a false-alarm rate of 1e-6 per comparison.
"""

import math
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.interpolate import CubicSpline

from analysis.mtf.edge_location import EdgeError, locate_edge, pixel_noise
from analysis.mtf.slanted_edge import slanted_edge_mtf
from analysis.spots.noise import NoiseModel
from analysis.statistics import rice_sigma, signal_modulus
from tests.analysis.refusals import refuses
from tests.tiers import quick

FALSE_ALARM = 1e-6
WAVELENGTH, F_NUMBER = 650e-9, 9.2
PAN, MULTISPECTRAL = 7e-6, 28e-6
DARK, BRIGHT = 150.0, 1150.0
MIDDLE = (0.13, 0.21)
# Required of the laboratory: 0.005 (perfect pupil). The estimator keeps a tenth of it.
ACCURACY = 5e-4


def transfer(f, angle, pitch=PAN):
    """OTF at f cycles/pixel along the normal of an edge tilted by angle."""
    s = np.minimum(f / pitch * WAVELENGTH * F_NUMBER, 1.0)
    along, across = f * math.cos(angle), f * math.sin(angle)
    pupil = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    return pupil * np.sinc(along) * np.sinc(across)


@cache
def edge_spread(angle, reach, pitch):
    """E(d) = 1/2 + int_0^fc Im(H exp(2 pi i f d)) / (pi f) df on a grid of 0.01 px, as a spline."""
    cutoff = pitch / (WAVELENGTH * F_NUMBER)
    x, w = np.polynomial.legendre.leggauss(32)
    # a panel covers at most four periods; sin places panels closely at the cut-off, where H ends as (1 - s)^1.5
    panels = np.sin(np.linspace(0, np.pi / 2, math.ceil(cutoff * reach / 2.5) + 4)) * cutoff
    half, mid = np.diff(panels)[:, None] / 2, (panels[1:] + panels[:-1])[:, None] / 2
    f, weight = (mid + half * x).ravel(), (half * w).ravel()
    step, fine, whole = 0.01, 100, np.arange(-reach - 1, reach + 2)
    coarse = np.exp(2j * np.pi * np.outer(whole, f)) * (weight * transfer(f, angle, pitch) / (np.pi * f))
    table = coarse @ np.exp(2j * np.pi * np.outer(f, np.arange(fine) * step))
    return CubicSpline((whole[:, None] + np.arange(fine) * step).ravel(), 0.5 + table.imag.ravel())


def edge_image(degrees, rows=64, columns=None, pitch=PAN, bend=0.0):
    """Noise-free grey values of a near-vertical edge through (row, column) = middle + MIDDLE, bright on the right."""
    angle, columns = math.radians(degrees), columns or rows
    row = np.arange(rows)[:, None] - (rows - 1) / 2 - MIDDLE[0]
    column = np.arange(columns) - (columns - 1) / 2 - MIDDLE[1] - bend * row**2 / 2
    spread = edge_spread(angle, 6 + math.ceil(math.hypot(rows, columns) / 2), pitch)
    return DARK + (BRIGHT - DARK) * spread(column * math.cos(angle) - row * math.sin(angle))


def error_of(edge, degrees, **optics):
    """Largest error up to Nyquist, and up to 1 cycle/pixel."""
    truth = np.abs(transfer(edge.frequency, math.radians(degrees), **optics))
    error = np.abs(edge.mtf - truth)
    return error[edge.frequency <= 0.5].max(), error.max()


def detector(contrast_e):
    """A detector of 0.5 DN per electron whose bright side is at contrast_e above the dark side."""
    return NoiseModel(0.5, 6.0, 0.0, 64.0, 0.0, 0.0, 60000.0), 64 + 0.05 * contrast_e, 0.5 * contrast_e


@cache
def repeats(contrast_e, count=200, use_model=True, degrees=4):
    """Measurements of `count` noisy frames of the same edge."""
    model, dark, contrast = detector(contrast_e)
    mean = dark + contrast * (edge_image(degrees) - DARK) / (BRIGHT - DARK)
    rng = np.random.default_rng([17, contrast_e])
    # shot and read noise as Gaussians, then rounding to whole grey values
    sigma = np.sqrt(model.temporal_variance_dn2(mean, 1) - 1 / 12)
    noise = model if use_model else None
    return [slanted_edge_mtf(np.round(rng.normal(mean, sigma)), noise=noise) for _ in range(count)]


def chi_square_limits(count):
    return stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], count - 1)


# --- accuracy ---


@pytest.mark.second
@pytest.mark.parametrize("pitch", [PAN, MULTISPECTRAL])
@pytest.mark.parametrize("size", quick(1, [64, 96, 128]))
@pytest.mark.parametrize("degrees", [2, 3, 5, 7, 10])
def test_perfect_pupil(degrees, size, pitch):
    image = edge_image(degrees, size, pitch=pitch)
    # 28 um: the image is aliased, with 13% of contrast left at 1.5 cycles/pixel
    across_columns = slanted_edge_mtf(image, uniform_light=True)
    across_rows = slanted_edge_mtf(np.ascontiguousarray(image.T))
    for edge, axis, levels in ((across_columns, "x", 0.1), (across_rows, "y", 0.2)):
        assert edge.axis == axis
        near, far = error_of(edge, degrees, pitch=pitch)
        assert near < ACCURACY
        assert far < 2 * ACCURACY
        # 1e-4 rad over 64 rows blurs by 0.003 px
        assert edge.angle == pytest.approx(math.radians(degrees), abs=1e-4)
        column = (size - 1) / 2 + MIDDLE[1] - MIDDLE[0] * math.tan(math.radians(degrees))
        assert edge.position == pytest.approx(column, abs=2e-3)
        # the plateaus are extrapolated: at 32 px the diffraction tail still holds 1.7 DN of 1000, and levels that may
        # be planes tell less of it
        assert (edge.dark, edge.bright) == pytest.approx((DARK, BRIGHT), abs=levels)


def test_all_ways_round():
    """Bright left, right, up, down, tilted either way: the same MTF; the angle's sign and the position follow."""
    image = edge_image(5)
    first = slanted_edge_mtf(image)
    for changed, angle, position in (
        (image[:, ::-1], -first.angle, 63 - first.position),
        (image[::-1], -first.angle, first.position),
        (BRIGHT + DARK - image, first.angle, first.position),
        (image.T, first.angle, first.position),
        (image.T[::-1], -first.angle, 63 - first.position),
    ):
        edge = slanted_edge_mtf(changed)
        # mirrored pixels meet the knots at other places, so the spline differs by its own error
        assert_allclose(edge.mtf[:33], first.mtf[:33], atol=1e-4)
        assert edge.angle == pytest.approx(angle, abs=1e-5)
        assert edge.position == pytest.approx(position, abs=1e-3)


def test_spread_functions():
    edge = slanted_edge_mtf(edge_image(5))
    truth = edge_spread(math.radians(5), 6 + math.ceil(64 / math.sqrt(2)), PAN)
    near = np.abs(edge.distance) < 20
    assert_allclose(edge.esf[near], DARK + (BRIGHT - DARK) * truth(edge.distance[near]), atol=5e-4 * (BRIGHT - DARK))
    assert_allclose(edge.lsf[near], truth(edge.distance[near], 1), atol=0.005)
    # 16 to a pixel, alike on both sides, to the last pixel of the side that has fewer
    assert np.diff(edge.distance) == pytest.approx(1 / 16, abs=1e-12)
    assert edge.distance == pytest.approx(-edge.distance[::-1], abs=1e-12)
    reach = min(edge.pixel_distance.max(), -edge.pixel_distance.min())
    assert 25 < edge.distance[-1] <= reach < edge.distance[-1] + 1 / 16


def test_interpolation_and_mtf50():
    edge = slanted_edge_mtf(edge_image(5))
    f = 0.3337
    two = slanted_edge_mtf(edge_image(5), frequency=[0.0, 0.5])
    assert two.mtf == pytest.approx([1.0, edge.mtf[32]], abs=1e-12)
    assert edge.at(f)[0] == pytest.approx(transfer(np.array([f]), math.radians(5))[0], abs=ACCURACY)
    half, sigma = edge.frequency_at(0.5)
    assert transfer(np.array([half]), math.radians(5))[0] == pytest.approx(0.5, abs=ACCURACY)
    assert sigma > 0
    assert math.isnan(slanted_edge_mtf(edge_image(5), frequency=[0.0, 0.1, 0.2]).frequency_at(0.5)[0])
    refuses(ValueError, "outside", edge.at, 1.2)


# --- noise ---


@pytest.mark.second
@pytest.mark.parametrize(("contrast_e", "use_model"), quick(1, [(4000, True), (4000, False), (600, True)]))
def test_sigma_agrees_with_the_scatter(contrast_e, use_model):
    edges = repeats(contrast_e, use_model=use_model)
    low, high = chi_square_limits(len(edges))
    checked = 0
    for k in (4, 8, 16, 24, 32):
        mtf, sigma = (np.array([getattr(edge, name)[k] for edge in edges]) for name in ("mtf", "sigma"))
        if mtf.mean() > 5 * sigma.mean():
            assert low < np.sum((mtf - mtf.mean()) ** 2) / np.mean(sigma**2) < high
            checked += 1
    assert checked >= 4
    for name in ("angle", "position", "curvature"):
        value = np.array([getattr(edge, name) for edge in edges])
        sigma = np.array([getattr(edge, f"{name}_sigma") for edge in edges])
        assert low < np.sum((value - value.mean()) ** 2) / np.mean(sigma**2) < high
    # no sigma at zero frequency, where the normalisation makes 1
    assert all(edge.sigma[0] < 1e-9 for edge in edges)


def test_the_angle_enters_the_sigma():
    """A slope that is wrong by d shifts row v by v d cos: 1 - mean cos(2 pi f v d cos) is k z^2 of a normal z, whose
    mean square is 3 k^2. The angle's sigma is that of d times cos^2. Even in this noise it counts for little."""
    for edge in repeats(200, 3):
        cosine, rows = math.cos(edge.angle), np.arange(64) - 31.5
        k = 0.5 * (2 * np.pi * edge.frequency * edge.angle_sigma / cosine) ** 2 * np.mean(rows**2)
        signal = signal_modulus(edge.mtf, edge.sigma_along, edge.sigma_across)
        noise = rice_sigma(signal, edge.sigma_along, edge.sigma_across)
        assert edge.sigma**2 == pytest.approx(noise**2 + 3 * (k * edge.mtf) ** 2, rel=1e-9)
        assert np.any(edge.sigma[:33] > 1.00001 * noise[:33])


def test_frames_and_fixed_pattern_enter_the_sigma():
    image = np.round(edge_image(4) + np.random.default_rng(3).normal(0, 4, (64, 64)))
    plain = NoiseModel(0.5, 6.0, 0.0, 64.0, 0.0, 0.0, 60000.0)
    uneven = NoiseModel(0.5, 6.0, 0.0, 64.0, 0.02, 10.0, 60000.0)
    one, many = (slanted_edge_mtf(image, noise=plain, frames=n) for n in (1, 16))
    # temporal noise alone: a quarter. The term of the angle is of second order.
    assert many.sigma[16] == pytest.approx(one.sigma[16] / 4, rel=0.01)
    assert slanted_edge_mtf(image, noise=uneven, frames=16).sigma[16] > 2 * many.sigma[16]


def test_curvature_is_found():
    bend = 4e-4
    edge = slanted_edge_mtf(edge_image(4, bend=bend))
    # the shape is made along the row, and the fit of a straight line takes part of the blur: 10%
    assert edge.curvature == pytest.approx(bend, rel=0.1)
    assert edge.curvature > 5 * edge.curvature_sigma
    assert abs(slanted_edge_mtf(edge_image(4)).curvature) < 1e-6


# --- bad input ---


def noisy(image, sigma=2.0):
    return image + np.random.default_rng(5).normal(0, sigma, image.shape)


def with_nan():
    image = edge_image(5)
    image[3, 4] = np.nan
    return image


def two_edges(centre):
    row, column = np.indices((64, 64)) - 31.5
    return noisy(DARK + 1000.0 * (np.abs(column - 0.1 * row - centre) < 12))


def corner():
    image = edge_image(5)
    image[:32, :] = DARK
    return noisy(image)


def spot():
    """6 px wide; of the blocks of 4 px that are looked at, the one whose middle is row 14, column 54 is full of it."""
    image = edge_image(5)
    image[10:16, 50:56] += 400
    return noisy(image)


def ramp(degrees):
    """Distance from the edge, px."""
    row, column = np.indices((64, 64)) - 31.5
    return column * math.cos(math.radians(degrees)) - row * math.sin(math.radians(degrees))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (noisy(np.full((64, 64), 500.0)), "no edge in the region.*move"),
        (np.full((64, 64), 500), "all pixels have the same value"),
        (np.tile(np.linspace(0, 1000, 64), (64, 1)) + noisy(np.zeros((64, 64))), "no sharp edge|only"),
        # of a ramp of 30 px eight tenths lie between 10% and 90%; seen in steps of half a pixel at either end
        (noisy(DARK + 1000 / 30 * np.clip(ramp(5) + 15, 0, 30)), r"no sharp edge.* over 2[45] px"),
        (np.minimum(noisy(edge_image(5), 8), 1150), "share the highest value 1150.*lower the exposure"),
        (np.maximum(noisy(edge_image(5), 8), 150), "share the lowest value 150.*raise the offset"),
        (edge_image(5)[:16, :], "too small: take at least 32"),
        (edge_image(5, 64)[:, 18:46], "28 px across the near-vertical edge"),
        (noisy(edge_image(0)), "0.00 deg.*2 to 10 deg"),
        (noisy(edge_image(0.3)), "leaves gaps of .* longer along the edge"),
        (noisy(edge_image(45)), "near 45 deg.*tilt the target by 2 to 10 deg|gaps"),
        (noisy(edge_image(10, 200, 64)[:, 18:]), "the edge leaves the region.*wider or shorter"),
        (noisy(edge_image(5)[:, 26:58]), "px of the region's side.*centre"),
        (noisy(edge_image(5, 64, 96)[:, 46:78]), "the edge lies at the region's side or leaves it"),
        (two_edges(0.0), "no single edge.*two edges"),
        (two_edges(14.0), "two edges|second edge|more than one"),
        (corner(), "cannot be followed|more than one"),
        (spot(), "more than one straight edge: near its row 14, column 54 .*speck"),
        (noisy(edge_image(5), 300.0), "contrast of .* times the noise of a pixel.*average more frames"),
        (with_nan(), "1 pixels of the region are not finite"),
        (np.zeros((4, 64, 64)), r"must be a plane.*\(4, 64, 64\)"),
        (edge_image(5).astype(complex), "real grey values"),
    ],
)
def test_bad_regions_are_explained(image, message):
    refuses(EdgeError, message, slanted_edge_mtf, image)


@pytest.mark.parametrize("turned", [slice(None), slice(None, None, -1)])
def test_both_sides_need_the_same_margin(turned):
    """10 px from the line's end to the last column: a column fewer is refused, wherever the bright side is."""
    image = noisy(edge_image(5))
    edge = slanted_edge_mtf(image)
    end = edge.position + math.tan(abs(edge.angle)) * 63 / 2
    enough = math.ceil(end + 10.0)
    for level in (image, BRIGHT + DARK - image):
        assert slanted_edge_mtf(level[:, : enough + 1][:, turned]).mtf[0] == pytest.approx(1.0)
        refuses(
            EdgeError, r"comes within 9\.\d px of the region's side", slanted_edge_mtf, level[:, :enough][:, turned]
        )


def test_stated_saturation():
    image = noisy(edge_image(5))
    refuses(EdgeError, "pixels reach the saturation level of 1100: lower", slanted_edge_mtf, image, saturation=1100)
    with pytest.raises(EdgeError, match="saturation level of 1000"):
        slanted_edge_mtf(image, noise=NoiseModel(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1000.0))
    # a computed image in whole grey values has a true plateau
    plateau = np.round(edge_image(5, pitch=MULTISPECTRAL) / 4)
    refuses(EdgeError, "computed without noise", slanted_edge_mtf, plateau)
    truth = transfer(np.array([0.5]), math.radians(5), MULTISPECTRAL)[0]
    # steps of 1 in 250, pi cycles of slope: 0.004 rms if they were independent
    assert slanted_edge_mtf(plateau, saturation=math.inf).mtf[32] == pytest.approx(truth, abs=0.01)


@pytest.mark.parametrize("wrong", [{"frequency": [0.5]}, {"frequency": [0.0, 3.0]}])
def test_arguments_that_make_no_sense(wrong):
    refuses(ValueError, "frequency", slanted_edge_mtf, edge_image(5), **wrong)


def test_noise_of_a_pixel_is_seen_on_slopes():
    """A plane and a step along the columns drop out of the checkerboard; a median of 160 000 is good to 0.4%."""
    row, column = np.indices((400, 400))
    noise = 3.0 * np.random.default_rng(4).standard_normal((400, 400))
    for shading in (0.0, 5.0 * row - 2.0 * column, 100.0 * (column > 150)):
        assert pixel_noise(noise + shading) == pytest.approx(3.0, rel=0.016)


def half_an_edge():
    """Sharp in the lower part; above, the same step so smooth that no row tells where it is."""
    image = edge_image(5)
    image[:26, :] = np.linspace(DARK, BRIGHT, 64)
    return image


def test_an_edge_has_to_be_there_in_most_rows():
    refuses(EdgeError, "cannot be followed", slanted_edge_mtf, noisy(half_an_edge()))


@pytest.mark.parametrize("turned", [False, True])
def test_edges_up_to_40_deg_have_a_direction(turned):
    """Steeper ones are near 45 deg, whichever way they are counted."""
    for degrees in (39.0, 41.0):
        image = edge_image(degrees, 24, 96)
        image = image.T if turned else image
        if degrees < 40.0:
            assert math.degrees(locate_edge(image).angle) == pytest.approx(degrees, abs=0.1)
        else:
            refuses(EdgeError, r"near 45 deg.*tilt the target", locate_edge, image)
