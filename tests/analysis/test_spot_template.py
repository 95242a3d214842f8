"""Interpolation of the calibrated spot against the closed form of the Airy pattern."""

import numpy as np
import pytest

from analysis.spots.spot_template import SmearedShape, SpotTemplate, TemplateRangeError
from tests.analysis.refusals import refuses
from tests.analysis.test_spot_centroids import FIRST_ZERO_PX, airy


@pytest.mark.parametrize("oversampling", [1, 2])
def test_interpolation_error(oversampling):
    """Value to 1e-5 of the peak, position to 1e-4 px (least squares of the error on the gradient), random shifts."""
    side = 128 * oversampling
    centre = (63.7 * oversampling, 63.2 * oversampling)
    image = airy(*centre, (side, side), FIRST_ZERO_PX * oversampling)
    template = SpotTemplate.from_image(image, *centre, (96, 96), oversampling)
    flux = image.sum() / oversampling**2
    rng = np.random.default_rng(1)
    rows, columns = rng.uniform(36, 60, (2, 24))
    value, d_row, d_column = template.evaluate(rows, columns)
    assert value.shape == d_row.shape == d_column.shape == (24, 96, 96)
    for b in range(24):
        true = airy(rows[b], columns[b], (96, 96))
        error = flux * value[b] - true
        assert np.abs(error).max() < 1e-5
        for slope in (d_row[b], d_column[b]):
            assert abs(np.sum(error * slope) / np.sum(slope * slope) / flux) < 1e-4
    assert template.truncation < 1e-7


def test_gradient_is_the_derivative():
    """Central differences with step h are good to h^2/6 * third derivative: 1e-8 for h = 1e-4."""
    image = airy(40.3, 41.8, (80, 82))
    template = SpotTemplate.from_image(image, 40.3, 41.8, (48, 48))
    h = 1e-4
    _, d_row, d_column = template.evaluate(24.3, 22.9)
    by_row = (template.evaluate(24.3 + h, 22.9)[0] - template.evaluate(24.3 - h, 22.9)[0]) / (2 * h)
    by_column = (template.evaluate(24.3, 22.9 + h)[0] - template.evaluate(24.3, 22.9 - h)[0]) / (2 * h)
    scale = np.abs(d_row).max()
    assert np.abs(by_row - d_row).max() < 1e-7 * scale
    assert np.abs(by_column - d_column).max() < 1e-7 * scale


def test_range_is_tight_and_explained():
    template = SpotTemplate.from_image(airy(40, 40, (80, 80)), 40, 40, (48, 48))
    (low, high), columns = template.supported()
    assert columns == (low, high)
    for good in (low, high):
        template.evaluate(good, 24.0)
    for bad in (low - 0.01, high + 0.01, np.nan):
        with pytest.raises(TemplateRangeError, match="spot 1") as caught:
            template.evaluate([24.0, bad], [24.0, 24.0])
        assert caught.value.indices == [1]


@pytest.mark.parametrize(
    ("image", "words"),
    [(np.ones((40, 40)), "margin"), (np.full((80, 80), np.nan), "finite"), (np.zeros((80, 80)), "no flux")],
)
def test_bad_calibration_images(image, words):
    refuses(ValueError, words, SpotTemplate.from_image, image, 20, 20, (48, 48))


# --- smeared ----------------------------------------------------------------------------------------------------------


def smeared(oversampling=1, zero=FIRST_ZERO_PX):
    side = 120 * oversampling
    centre = (59.4 * oversampling, 60.3 * oversampling)
    image = airy(*centre, (side, side), zero * oversampling)
    template = SpotTemplate.from_image(image, *centre, (64, 64), oversampling)
    return template, SmearedShape(template)


@pytest.mark.parametrize("oversampling", [1, 2])
@pytest.mark.parametrize("covariance", [[[0, 0], [0, 0]], [[0.3, 0.2], [0.2, 0.5]], [[1.0, -1.0], [-1.0, 1.0]]])
def test_smear_is_the_mean_over_places(oversampling, covariance):
    """Against the shape itself at the nodes of a product rule of 9 points, exact but for terms of 18th order; also the
    sign of the cross term. What is left is the interpolation's own error, 1e-5 of the peak and five times that of the
    slopes at the detector's pitch, a thirtieth of it at half of that. Without smear it is the shape.
    """
    template, shape = smeared(oversampling)
    matrix = np.array(covariance, float)
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    values, vectors = np.linalg.eigh(matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    expected = 0.0
    for x, a in zip(nodes, weights, strict=True):
        for y, b in zip(nodes, weights, strict=True):
            d = root @ (x, y)
            expected = expected + a * b / (2 * np.pi) * np.stack(template.evaluate(31.3 + d[0], 30.8 + d[1]))[:, 0]
    found = shape.evaluate(shape.smeared(matrix), 31.3, 30.8)
    for one, other, own in zip(found[:3], expected, (1e-5, 5e-5, 5e-5), strict=True):
        tolerance = own * (1.0 if oversampling == 1 else 1 / 30) if np.any(matrix) else 1e-8
        assert np.abs(one - other).max() < tolerance * np.abs(other).max()
    if np.any(matrix):
        assert np.abs(found[0] - template.evaluate(31.3, 30.8)[0][0]).max() > 0.02 * found[0].max()


def test_derivatives_of_a_smeared_shape():
    """Second derivatives by differences of the first, those by the smear by differences of the smear: half of them."""
    _, shape = smeared()
    matrix = np.array([[0.6, 0.25], [0.25, 0.4]])
    at = shape.evaluate(shape.smeared(matrix), 30.2, 33.7)
    h = 1e-4
    coefficients = shape.smeared(matrix)
    ends = [shape.evaluate(coefficients, 30.2 + a, 33.7 + b) for a, b in ((h, 0), (-h, 0), (0, h), (0, -h))]
    by_row, by_column = (ends[0] - ends[1]) / (2 * h), (ends[2] - ends[3]) / (2 * h)
    pairs = [(by_row[0], 1), (by_column[0], 2), (by_row[1], 3), (by_row[2], 4), (by_column[1], 4), (by_column[2], 5)]
    for found, number in pairs:
        assert np.abs(found - at[number]).max() < 1e-6 * np.abs(at[number]).max()
    for step, number, share in (([[1, 0], [0, 0]], 3, 0.5), ([[0, 1], [1, 0]], 4, 1.0), ([[0, 0], [0, 1]], 5, 0.5)):
        both = [shape.evaluate(shape.smeared(matrix + sign * h * np.array(step)), 30.2, 33.7)[0] for sign in (1, -1)]
        slope = (both[0] - both[1]) / (2 * h)
        # the spline's second derivative is good to its fourth order in the frequencies of the spot
        assert np.abs(slope - share * at[number]).max() < 2e-3 * np.abs(at[number]).max()


def test_a_smeared_shape_keeps_its_light_and_its_range():
    template, shape = smeared()
    whole = shape.smeared(np.diag([2.0, 1.0]))
    assert whole.sum() == pytest.approx(shape.smeared(np.zeros((2, 2))).sum(), rel=1e-12)
    low, high = template.supported()[0]
    with pytest.raises(TemplateRangeError):
        shape.evaluate(whole, high + 0.01, 31.0)
    assert np.all(np.isfinite(shape.evaluate(whole, low, 31.0)))
