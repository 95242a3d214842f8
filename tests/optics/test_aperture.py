"""Apertures and edges of surfaces: what they hold, areas, turns, the same edge in a frame that is turned over."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Outline

from optics.geometry.aperture import Aperture, Circle, Edge, Ellipse, Polygon, Ray, Rectangle, flipped_y
from optics.geometry.surface import Surface, plane
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


L_SHAPE = ((0.0, 0.0), (1.0, 0.0), (1.0, 0.4), (0.4, 0.4), (0.4, 1.0), (0.0, 1.0))
SHAPES = (
    (Circle(0.8, (0.1, -0.2)), np.pi * 0.64),
    (Circle(0.8, (0.1, -0.2), 0.3), np.pi * (0.64 - 0.09)),
    (Rectangle(0.5, 0.2, (-0.1, 0.3)), 0.4),
    (Ellipse(0.5, 0.2, (-0.1, 0.3)), np.pi * 0.1),
    (Ray(0.3, (0.5, 0.1)), 0.3 * 1.5),  # as far as the field reaches, which is x = 2
    (Polygon(L_SHAPE), 0.64),
)


def field(count: int = 400_000) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over -2 .. 2."""
    x, y = np.random.default_rng(5).uniform(-2.0, 2.0, (2, count))
    return x, y


@pytest.mark.parametrize(("shape", "area"), SHAPES, ids=lambda one: type(one).__name__)
def test_the_area_is_the_shape_s_and_the_rest_is_the_other_way_round(shape, area) -> None:
    x, y = field()
    clear = Edge(shape).passes(x, y)
    share = area / 16.0
    # binomial: five standard deviations are passed once in two million
    assert np.mean(clear) == pytest.approx(share, abs=5.0 * np.sqrt(share * (1.0 - share) / x.size))
    np.testing.assert_array_equal(Edge(shape, blocks=True).passes(x, y), ~clear)


@pytest.mark.parametrize("shape", [shape for shape, _ in SHAPES if not isinstance(shape, Polygon)], ids=repr)
def test_a_turn_is_right_handed_about_the_shape_s_own_centre(shape) -> None:
    x, y = field(20_000)
    turn = 0.7
    cx, cy = shape.centre
    moved = (
        cx + np.cos(turn) * (x - cx) - np.sin(turn) * (y - cy),
        cy + np.sin(turn) * (x - cx) + np.cos(turn) * (y - cy),
    )
    same = Edge(shape, rotation=turn).passes(*moved) == Edge(shape).passes(x, y)
    assert np.mean(same) == 1.0
    if not isinstance(shape, Circle):
        assert np.mean(Edge(shape, rotation=turn).passes(x, y) == Edge(shape).passes(x, y)) < 0.999


@pytest.mark.parametrize("shape", [shape for shape, _ in SHAPES], ids=lambda one: type(one).__name__)
def test_turned_over_it_is_the_same_edge_at_minus_y(shape) -> None:
    x, y = field(20_000)
    edge = Edge(shape, blocks=True, rotation=0.0 if isinstance(shape, Polygon) else 0.4)
    np.testing.assert_array_equal(flipped_y(edge).passes(x, -y), edge.passes(x, y))
    assert flipped_y(flipped_y(edge)) == edge


def test_a_polygon_is_matplotlibs() -> None:
    x, y = field(20_000)
    radii, turns = np.tile([1.5, 0.6], 5), np.arange(10) * np.pi / 5.0
    star = tuple(map(tuple, np.stack([radii * np.cos(turns), radii * np.sin(turns)], axis=-1).tolist()))
    inside = Outline(np.array([*star, star[0]]), closed=True).contains_points(np.stack([x, y], axis=-1))
    np.testing.assert_array_equal(Edge(Polygon(star)).passes(x, y), inside)


CURVATURE, CONIC = st.floats(-0.5, 0.5), st.floats(-4.0, 2.0)
PLACES = np.random.default_rng(1).uniform(-0.5, 0.5, (2, 40))


@pytest.mark.second
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
