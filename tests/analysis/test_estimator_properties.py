"""Laws of the estimators, whatever the numbers: what moves, grows or changes places in the input does so in the end."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.noise import NoiseModel
from tests.tiers import quick

NOISE = NoiseModel(0.06, 16.0, 0.0, 64.0, 0.01, 5.0, 4095.0)


def blob(row: float, column: float, size: int = 64) -> np.ndarray:
    """A smooth spot that is no Gaussian, in grey values."""
    r, c = np.indices((size, size))
    far = ((r - row) / 4.0) ** 2 + ((c - column) / 5.0) ** 2 + 0.05 * (r - row) * (c - column) / 20.0
    return 64.0 + 2500.0 / (1.0 + far) ** 4


PLACE = st.floats(30.0, 34.0)


@pytest.mark.parametrize("estimate", quick(1, [energy_centroid, gaussian_fit]))
@settings(max_examples=12)
@given(row=PLACE, column=PLACE, down=st.integers(-6, 6), across=st.integers(-6, 6))
def test_a_spot_that_moves_by_whole_pixels(estimate, row, column, down, across) -> None:
    """Its centroid does, to what the iterations leave (1e-7 px); the spot's wings move over the image's edge."""
    images = np.stack([blob(row, column), blob(row + down, column + across)])
    first, second = estimate(images, 9, NOISE).position
    limit = 1e-5 if estimate is gaussian_fit else 2e-3
    np.testing.assert_allclose(second - first, [down, across], rtol=0, atol=limit)


@settings(max_examples=12)
@given(row=PLACE, column=PLACE, gain=st.floats(0.3, 1.4), sky=st.floats(0.0, 300.0))
def test_the_energy_centroid_knows_no_brightness_and_no_background(row, column, gain, sky) -> None:
    """Both drop out of the first moment exactly; what is left is where the window comes to rest."""
    image = blob(row, column)
    first, second = energy_centroid(np.stack([image, 64.0 + gain * (image - 64.0) + sky]), 9, NOISE).position
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-6)


@pytest.mark.parametrize("estimate", [energy_centroid, gaussian_fit])
@settings(max_examples=12)
@given(row=PLACE, column=PLACE)
def test_an_image_in_the_mirror(estimate, row, column) -> None:
    image = blob(row, column)
    plain, flipped, turned = estimate(np.stack([image, image[::-1], image.T]), 9, NOISE).position
    np.testing.assert_allclose(flipped, [63.0 - plain[0], plain[1]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(turned, plain[::-1], rtol=0, atol=1e-6)
