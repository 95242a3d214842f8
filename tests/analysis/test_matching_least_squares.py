"""Least squares matching against textures that are known exactly: accuracy without noise, covariance with it."""

import numpy as np
import pytest
from scipy import stats

from analysis.matching.correlation import MatchOptions, Reason, SplineStack, resampled
from analysis.matching.least_squares import least_squares
from tests.analysis.refusals import refuses
from tests.analysis.texture_image import Texture, detected, lattice
from tests.tiers import quick

SIZE = 346
PLACES = lattice(10, 28, 47, seed=3)  # windows of 25 px do not overlap: errors are independent


@pytest.fixture(scope="module")
def texture():
    return Texture(1)


@pytest.fixture(scope="module")
def clean(texture):
    return texture.grid(np.arange(SIZE), np.arange(SIZE))


@pytest.fixture(scope="module")
def templates(texture):
    return texture.patches(PLACES)


def started(seed=4):
    return PLACES + np.random.default_rng(seed).uniform(-0.7, 0.7, PLACES.shape)


def chi_square(error, covariance):
    return float(np.einsum("ni,nij,nj->", error, np.linalg.inv(covariance), error))


def limits(freedom):
    """Of chi-square, false alarm 1e-4."""
    return stats.chi2.ppf([0.5e-4, 1 - 0.5e-4], freedom)


def test_windows_that_leave_the_image_on_any_side_are_told(texture, clean):
    """Whole pixels, so that the window ends on the first or last row or column, or one beyond it."""
    first = 15 - MatchOptions().margin
    last = SIZE - 1 - first
    inside = np.array([[first, 100], [last, 100], [100, first], [100, last], [first, last]], float)
    beyond = inside + np.array([[-1, 0], [1, 0], [0, -1], [0, 1], [-1, 0]])
    places = np.concatenate([inside, beyond, np.full((2, 2), 100.0)])
    start = places.copy()
    start[[10, 11], [0, 1]] = np.nan
    fits = least_squares(clean, texture.patches(places), start)
    assert np.all(fits.reason == [Reason.ACCEPTED] * 5 + [Reason.OUTSIDE] * 5 + [Reason.TEMPLATE] * 2)
    assert np.abs(fits.position[:5] - inside).max() < 0.005
    assert np.all(np.isnan(fits.position[5:]))


@pytest.mark.second
def test_affine_change_without_noise(texture, templates):
    matrix = np.array([[1.03, 0.02], [-0.04, 0.98]])
    shift = np.array([12.3, 20.7])
    grey = texture.grid(np.arange(SIZE), np.arange(SIZE), matrix=matrix, shift=shift)
    inside = np.linalg.solve(matrix, (PLACES - shift).T).T
    used = np.all((inside > 15) & (inside < SIZE - 16), axis=1)
    assert used.sum() > 60
    fits = least_squares(0.6 * grey + 40.0, templates[used], inside[used] + 0.4)
    assert np.all(fits.reason == Reason.ACCEPTED)
    assert np.abs(fits.position - inside[used]).max() < 0.006
    # the place's error over half a window of 12 px
    assert np.abs(fits.affine - matrix).max() < 1e-3
    # the second derivatives share in the gain: spline error again
    assert np.abs(fits.gain - 0.6).max() < 0.02


@pytest.mark.parametrize(
    ("sharp", "largest"), quick(1, [((0.45, 0.45), 0.006), ((0.1, 0.4), 0.008), ((0.1, 0.1), 0.008)])
)
@pytest.mark.parametrize("sharpness", quick(0, [True, False]))
def test_other_radiometry_and_sharpness(texture, clean, sharp, largest, sharpness):
    """An MTF of 0.25 at the limit in the image against others in the template, gain 0.7: with the terms for sharpness
    still the spline's error; without them chance correlations of slopes and bends, below 0.02 px.
    """
    other = 0.7 * texture.patches(PLACES, sharp=sharp) + 90.0
    fits = least_squares(clean, other, started(), MatchOptions(sharpness=sharpness))
    error = fits.position - PLACES
    assert np.all(fits.reason == Reason.ACCEPTED)
    assert np.abs(error).max() < (largest if sharpness else 0.02)
    assert np.abs(error.mean(axis=0)).max() < 0.001


@pytest.mark.second
def test_scatter_reaches_the_bound(texture, clean, templates):
    """Cramer-Rao bound for place, affine change, offset, gain and sharpness from the texture's exact derivatives and
    the known noise of each pixel. Equal weights lose a per cent to it; the noise's estimate has 4 per cent a point.
    """
    fits = least_squares(detected(clean, 41), templates, started())
    offset, bounds = np.arange(-12, 13), []
    for row, column in PLACES:
        r, c = np.rint(row) + offset, np.rint(column) + offset
        grey, by_row, by_column, bend_row, bend_column = (
            texture.grid(r, c, order=order) for order in ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2))
        )
        dr, dc = np.meshgrid(r - row, c - column, indexing="ij")
        columns = [by_row, by_column, by_row * dr, by_row * dc, by_column * dr, by_column * dc]
        columns += [np.ones_like(grey), grey, bend_row, bend_column]
        design = np.stack([x.ravel() for x in columns]) / np.sqrt(grey.ravel() + 400.0 + 1 / 12)
        scale = np.linalg.norm(design, axis=1)
        unit = design / scale[:, None]
        bounds.append(np.linalg.inv(unit @ unit.T)[:2, :2] / np.outer(scale[:2], scale[:2]))
    bound, error = np.array(bounds), fits.position - PLACES
    low, high = limits(error.size)
    assert low < chi_square(error, bound) < 1.03 * high
    # of noise alone: interpolation and relief are not in the bound; 100 points of some 10 per cent each
    noise = fits.spread.covariance(fits.reason == Reason.ACCEPTED)
    claimed = np.trace(noise, axis1=1, axis2=2) / np.trace(bound, axis1=1, axis2=2)
    assert 0.95 < claimed.mean() < 1.07
    assert fits.sigma.mean() == pytest.approx(np.sqrt(800 + 400), rel=0.02)


def test_spline_and_its_derivatives_follow_the_texture():
    """Band-limited to 0.2 cycles a pixel; the middle of the template, where its rim is forgotten."""
    smooth = Texture(6, top=0.2)
    stack = SplineStack(smooth.patches([[100.0, 100.0], [130.0, 90.0]]))
    rng = np.random.default_rng(7)
    row, column = rng.uniform(12, 18, (2, 1, 40))
    values = stack(row, column, np.array([1]), order=3)
    kinds = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
    # relative to contrast 120: the spline's order falls by one a derivative
    bounds = {0: 2e-4, 1: 1e-3, 2: 6e-3, 3: 4e-2}
    for value, order in zip(values, kinds, strict=True):
        exact = [
            smooth.grid([130.0 + r - 15], [90.0 + c - 15], order=order)[0, 0]
            for r, c in zip(row[0], column[0], strict=True)
        ]
        assert np.abs(value[0] - exact).max() < bounds[sum(order)] * 120.0


def test_resampling_keeps_knots_and_marks_what_is_missing():
    image = np.random.default_rng(8).uniform(0, 1, (60, 80))
    rows, columns = np.mgrid[20:31.0, 30:41.0]
    assert resampled(image, rows, columns) == pytest.approx(image[20:31, 30:41], abs=1e-12)
    out = resampled(image, rows - 25.0, columns)
    assert np.array_equal(np.isnan(out), np.broadcast_to(rows < 25, out.shape))
    image[25, 35] = np.nan
    out = resampled(image, rows[None], columns[None] + 0.3)
    assert np.isnan(out[0, 5, 5])
    # three knots to each side
    assert np.isnan(out).sum() == 49
    assert np.isnan(resampled(image, rows + 1000, columns)).all()


def test_bad_input_is_told():
    image, patch = np.zeros((50, 50)), np.zeros((3, 15, 15))
    with pytest.raises(ValueError, match=r"one band.*|plane of real grey values"):
        least_squares(np.zeros((5, 5, 3)), patch, np.zeros((3, 2)))
    refuses(ValueError, r"k odd.*\(3, 14, 14\)", least_squares, image, np.zeros((3, 14, 14)), np.zeros((3, 2)))
    refuses(ValueError, r"need \(3, 2\) positions.*\(2, 2\)", least_squares, image, patch, np.zeros((2, 2)))
    refuses(ValueError, "take 17 px or more", least_squares, image, patch, np.zeros((3, 2)), MatchOptions(margin=5))
    refuses(ValueError, "largest_sigma must be positive", MatchOptions, largest_sigma=0.0)
    refuses(ValueError, "is too small for a move", MatchOptions, largest_move=3.0)
    refuses(ValueError, r"grids of one shape", resampled, image, np.zeros((3, 3)), np.zeros((3, 4)))
