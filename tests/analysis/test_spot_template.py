"""Interpolation of the calibrated spot against the closed form of the Airy pattern."""

import numpy as np
import pytest
from scipy.special import j1

from analysis.spots.spot_template import SpotTemplate, TemplateRangeError

FIRST_ZERO_PX = 7.0


def airy(row, column, shape, zero=FIRST_ZERO_PX):
    r, c = np.indices(shape)
    x = np.maximum(np.hypot(r - row, c - column) * (3.8317059702075125 / zero), 1e-9)
    return (2 * j1(x) / x) ** 2


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
    checked = 0
    for b in range(24):
        true = airy(rows[b], columns[b], (96, 96))
        error = flux * value[b] - true
        assert np.abs(error).max() < 1e-5
        for slope in (d_row[b], d_column[b]):
            assert abs(np.sum(error * slope) / np.sum(slope * slope) / flux) < 1e-4
            checked += 1
    assert checked == 48
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


def test_returns_the_calibration_image_and_moves_down_for_a_larger_row():
    image = airy(40, 40, (80, 80))
    template = SpotTemplate.from_image(image, 40, 40, (48, 48), tolerance=1e-12)
    value, _, _ = template.evaluate(24, 24)
    assert np.abs(value[0] * image.sum() - image[16:64, 16:64]).max() < 1e-10
    value, _, _ = template.evaluate(30, 20)
    assert np.unravel_index(value[0].argmax(), (48, 48)) == (30, 20)


def test_stack_keeps_each_shape():
    one = SpotTemplate.from_image(airy(40, 40, (80, 80)), 40, 40, (48, 48))
    two = SpotTemplate.from_image(airy(40, 40, (80, 80), 9.0), 40, 40, (48, 48))
    both = SpotTemplate.stack([one, two])
    place = np.array([23.4, 25.1, 22.2])
    value, _, _ = both.evaluate(place, place)
    assert np.allclose(value[0], one.evaluate(23.4, 23.4)[0][0], rtol=0, atol=1e-15)
    assert np.allclose(value[1], two.evaluate(25.1, 25.1)[0][0], rtol=0, atol=1e-15)
    assert np.allclose(value[2], one.evaluate(22.2, 22.2)[0][0], rtol=0, atol=1e-15)
    chosen, _, _ = both.evaluate([25.1], [25.1], np.array([1]))
    assert np.allclose(chosen[0], value[1], rtol=0, atol=1e-15)


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
    [
        (np.ones((40, 40)), "margin"),
        (np.full((80, 80), np.nan), "finite"),
        (np.zeros((80, 80)), "no flux"),
    ],
)
def test_bad_calibration_images(image, words):
    with pytest.raises(ValueError, match=words):
        SpotTemplate.from_image(image, 20, 20, (48, 48))


@pytest.mark.parametrize("oversampling", [1, 2])
def test_the_smallest_calibration_image_has_one_place(oversampling):
    """Quintic splines take six samples: five more than from the first pixel to the last. One fewer is refused."""
    rows, columns = 9 * oversampling + 6, 7 * oversampling + 6
    image = airy(rows // 2, columns // 2, (rows, columns))
    template = SpotTemplate.from_image(image, rows // 2, columns // 2, (10, 8), oversampling)
    for low, high in template.supported():
        assert 0 <= high - low <= 1 / oversampling
    template.evaluate(*(low for low, _ in template.supported()))
    for less in (image[:-1], image[:, :-1]):
        with pytest.raises(ValueError, match="margin"):
            SpotTemplate.from_image(less, rows // 2, columns // 2, (10, 8), oversampling)
