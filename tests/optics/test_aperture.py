import numpy as np
import pytest

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.surface import plane
from optics.numerics.backend import Backend
from tests.optics.bench import PASS, Stage, beam, build, run


def test_circle() -> None:
    ring = Circle(2.0, (1.0, -1.0), inner=0.5)
    x, y = np.array([1.0, 1.0, 3.0, 3.1, 1.5]), np.array([-1.0, 0.0, -1.0, -1.0, -1.0])
    np.testing.assert_array_equal(ring.contains(x, y), [False, True, True, False, True])
    assert ring.bounds == (-1.0, 3.0, -3.0, 1.0)
    np.testing.assert_allclose(np.linalg.norm(ring.outline(33) - (1.0, -1.0), axis=-1), 2.0)


@pytest.mark.parametrize(
    "aperture",
    [
        Circle(1.0, (0.3, -0.4)),
        Circle(1.0, (0.3, -0.4), inner=0.5),
        Ellipse(1.2, 0.7, (0.3, -0.4)),
        Rectangle(1.2, 0.7, (0.3, -0.4)),
    ],
)
def test_rays_pass_where_a_decentred_aperture_is_open(backend: Backend, aperture: Aperture) -> None:
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (400, 2))
    assembly = build(Stage(plane(), PASS, aperture=aperture))
    *_, valid = run(backend, assembly, *beam(points, -1.0, np.array([0.0, 0.0, 1.0])))
    np.testing.assert_array_equal(valid, aperture.contains(*points.T))
    assert 20 < np.count_nonzero(valid) < 380


def test_a_rectangle_is_walked_in_even_steps() -> None:
    """Each corner once: from a point to the next it is a tenth of a side."""
    steps = np.linalg.norm(np.diff(Rectangle(2.0, 1.0).outline(40), axis=0), axis=-1)
    np.testing.assert_allclose(steps, np.repeat([0.4, 0.2, 0.4, 0.2], 10), rtol=1e-12)
