"""Laws of surfaces, apertures and Zernike terms, whatever the numbers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.surface import Surface

CURVATURE, CONIC = st.floats(-0.5, 0.5), st.floats(-4.0, 2.0)
PLACES = np.random.default_rng(1).uniform(-0.5, 0.5, (2, 40))


@given(CURVATURE, CONIC)
def test_a_conic_is_a_quadric(curvature, conic) -> None:
    """c (r^2 + (1 + k) z^2) = 2 z, on the sheet through the vertex."""
    x, y = PLACES
    z = Surface(curvature, conic).sag(x, y)
    np.testing.assert_allclose(curvature * (x * x + y * y + (1.0 + conic) * z * z), 2.0 * z, rtol=0, atol=1e-15)
    assert np.all((1.0 + conic) * curvature * z < 1.0)


def _apertures() -> st.SearchStrategy[Aperture]:
    size, place = st.floats(0.05, 2.0), st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
    return st.one_of(
        st.builds(Circle, size, place), st.builds(Rectangle, size, size, place), st.builds(Ellipse, size, size, place)
    )


@given(_apertures(), st.floats(0.0, 0.999), st.integers(0, 94))
def test_apertures_are_convex_within_their_outline_and_bounds(aperture, shrink, k) -> None:
    centre = np.array(aperture.centre)
    outline = aperture.outline(96)
    inner = centre + shrink * (outline - centre)
    assert np.all(aperture.contains(*inner.T))
    assert not np.any(aperture.contains(*(centre + 1.001 * (outline - centre)).T))
    between = 0.5 * (inner + np.roll(inner, k, axis=0))
    assert np.all(aperture.contains(*between.T))
    x_min, x_max, y_min, y_max = aperture.bounds
    x, y = (centre[:, None] + 3.0 * PLACES)[:, np.newaxis].reshape(2, -1)
    inside = aperture.contains(x, y)
    assert np.all((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max) | ~inside)
