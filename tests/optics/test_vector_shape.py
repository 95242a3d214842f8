"""Spectra of shapes against quadrature and against each other; shapes under maps."""

from itertools import pairwise

import numpy as np
import pytest

from optics.geometry.vector_shape import Disk, HalfPlane, Polygon
from optics.numerics import quadrature
from tests.tiers import quick

RNG = np.random.default_rng(4)
ARROW = np.array([[3.0, 1.0], [9.0, 0.0], [7.0, 4.0], [10.0, 9.0], [5.0, 6.0], [1.0, 8.0]]) * 1e-5  # not convex
BAR = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 50.0], [0.0, 50.0]]) * 7e-6
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 3e-5


def by_quadrature(vertices: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Sum of the signed triangles of a fan, each by a Gauss-Legendre product rule collapsed to the triangle."""
    s, w = np.polynomial.legendre.leggauss(80)
    s, w = 0.5 * (s + 1.0), 0.5 * w
    u, v = s[:, None], s[:, None] * s  # (u, v) in the triangle 0 < v < u < 1
    weight = (w * s)[:, None] * w
    total = np.zeros(fx.shape, complex)
    apex = vertices[0]
    for b, c in pairwise(vertices[1:]):
        p, q = b - apex, c - b
        x, y = (apex[i] + u * p[i] + v * q[i] for i in (0, 1))
        twice_area = p[0] * q[1] - p[1] * q[0]
        wave = np.exp(-2j * np.pi * (fx[:, None, None] * x + fy[:, None, None] * y))
        total += twice_area * np.einsum("fij,ij->f", wave, weight)
    return total


def frequencies(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sizes from 0 to some ten cycles over the shape; directions at random, along the edges and square to them."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    along = np.arctan2(edge[:, 1], edge[:, 0])
    angle = np.concatenate([RNG.uniform(0.0, 2.0 * np.pi, 12), along, along + 0.5 * np.pi])
    across = np.ptp(vertices, axis=0).max()
    size = np.concatenate([[0.0], np.logspace(-12, -1, 12), np.linspace(0.13, 10.0, 20)]) / across
    fx, fy = size[:, None] * np.cos(angle), size[:, None] * np.sin(angle)
    return fx.ravel(), fy.ravel()


@pytest.mark.second
@pytest.mark.parametrize(
    "vertices", quick(1, [SQUARE, ARROW, BAR, SQUARE + 2e-3]), ids=["square", "arrow", "bar", "far"]
)
def test_polygon_against_quadrature(vertices: np.ndarray) -> None:
    fx, fy = frequencies(vertices)
    shape = Polygon(vertices)
    got, want = shape.spectrum(fx, fy), by_quadrature(vertices, fx, fy)
    # the rule is exact here; both round: sums of some hundred terms, and the phases of a far shape (400 cycles)
    np.testing.assert_allclose(got / shape.area, want / shape.area, rtol=0, atol=1e-12)
    assert np.min(np.abs(want)) < 0.01 * shape.area  # it is not only asked near 0


def test_thin_bar_is_sinc_times_sinc() -> None:
    """On the axes, beside them and far out: 1500 cycles along the bar."""
    fx = np.array([0.0, 1e-9, 3.0, 1e3, 7e4, 1.0 / 7e-6, 4e6])
    fy = np.concatenate([fx, -fx, [1e4]])[:, None]
    wide, long = 7e-6, 350e-6
    want = wide * np.sinc(fx * wide) * np.exp(-1j * np.pi * fx * wide) * long
    want = want * np.sinc(fy * long) * np.exp(-1j * np.pi * fy * long)
    np.testing.assert_allclose(Polygon(BAR).spectrum(fx, fy) / (wide * long), want / (wide * long), rtol=0, atol=1e-12)


def test_ellipse_against_quadrature() -> None:
    shape = Disk((1e-5, 5e-6), 3e-5, [[1.3, 0.4], [-0.2, 0.8]])
    nodes = quadrature.disk(30, 120)
    x, y = shape.centre[:, None] + shape.radius * shape.linear_map @ np.stack([nodes.x, nodes.y])
    fx, fy = RNG.uniform(-1e5, 1e5, (2, 50))
    fx[:2], fy[:2] = (0.0, 1e-9), 0.0
    wave = np.exp(-2j * np.pi * (fx[:, None] * x + fy[:, None] * y))
    want = wave @ (nodes.weight * shape.radius**2 * np.linalg.det(shape.linear_map))
    np.testing.assert_allclose(shape.spectrum(fx, fy), want, rtol=0, atol=1e-13 * shape.area)
    x0, x1, y0, y1 = shape.bounds
    assert (x0 < x.min()) & (x.max() < x1) & (y0 < y.min()) & (y.max() < y1)
    assert x1 - x.max() < 0.02 * shape.radius


AFFINE = np.array([[-0.9, 0.1], [0.2, -1.1]])


def affine(points: np.ndarray) -> np.ndarray:
    return points @ AFFINE.T + [1e-3, -2e-3]


def quadratic(points: np.ndarray) -> np.ndarray:
    """Bends lines along y, moves points along x only; lines along x stay straight."""
    return points + np.stack([3.0 * points[:, 1] ** 2, np.zeros(len(points))], axis=-1)


def test_affine_map_of_polygon_moves_its_vertices() -> None:
    mapped = Polygon(ARROW).mapped(affine)
    np.testing.assert_array_equal(mapped.vertices, affine(ARROW))


def test_affine_map_of_disk_is_an_ellipse() -> None:
    disk = Disk((1e-5, 2e-5), 4e-5, [[1.0, 0.2], [0.0, 1.0]])
    mapped = disk.mapped(affine)
    assert isinstance(mapped, Disk)
    np.testing.assert_allclose(mapped.centre, affine(disk.centre[None])[0], rtol=0, atol=1e-17)
    np.testing.assert_allclose(mapped.linear_map, AFFINE @ disk.linear_map, rtol=0, atol=1e-12)


def test_quadratic_map_bends_edges_within_the_tolerance() -> None:
    """An edge of length l along y bends by 3 l^2/4 between its ends, n^2 times less in n pieces."""
    side, tolerance = 6e-5 * 10, 1e-9
    mapped = Polygon(10.0 * SQUARE).mapped(quadratic, tolerance)
    pieces = int(np.ceil(np.sqrt(0.75 * side**2 / tolerance)))
    assert pieces > 10
    # the straight edges keep their one piece; one more piece is allowed to rounding
    assert 2 * pieces + 2 <= len(mapped.vertices) <= 2 * pieces + 4
    y = np.linspace(-0.5, 0.5, 20001) * side
    right = mapped.vertices[mapped.vertices[:, 0] > 0.0]
    right = right[np.argsort(right[:, 1])]
    off = np.abs(np.interp(y, right[:, 1], right[:, 0]) - (0.5 * side + 3.0 * y**2))
    assert 0.5 * tolerance < np.max(off) <= tolerance * (1.0 + 1e-6)
    # edges along x bend as those along y do
    other = Polygon(10.0 * SQUARE).mapped(lambda points: quadratic(points[:, ::-1])[:, ::-1], tolerance)
    assert len(other.vertices) == len(mapped.vertices)
    # the map is a shear: it keeps areas, and so do the chords on both sides alike
    assert mapped.area == pytest.approx(side**2, rel=1e-12)


def test_bent_disk_becomes_a_polygon() -> None:
    radius, tolerance = 3e-4, 1e-9
    disk = Disk((1e-4, 0.0), radius)
    mapped = disk.mapped(quadratic, tolerance)
    assert isinstance(mapped, Polygon)
    back = mapped.vertices - np.stack([3.0 * mapped.vertices[:, 1] ** 2, np.zeros(len(mapped.vertices))], axis=-1)
    np.testing.assert_allclose(np.hypot(*(back - disk.centre).T), radius, rtol=0, atol=1e-15)
    # a shear keeps the area; chords lose at most the tolerance along the rim, by the parabola's 2/3
    lost = disk.area - mapped.area
    assert 0.0 < lost < 2.0 / 3.0 * tolerance * 2.0 * np.pi * radius
    assert isinstance(Disk((1e-4, 0.0), 1e-5).mapped(quadratic, tolerance), Disk)  # a small one bends by 3e-10 m


@pytest.mark.parametrize("mirrored", [False, True])
def test_half_plane_takes_the_tangent(mirrored: bool) -> None:
    edge = HalfPlane((2e-4, 3e-4), (2.0, 0.5))

    def bend(points: np.ndarray) -> np.ndarray:
        out = quadratic(points) * [-1.0 if mirrored else 1.0, 1.0]
        return out + np.array([5e-4, 0.0])

    mapped = edge.mapped(bend)
    tangent = np.array([-edge.normal[1] + 6.0 * 3e-4 * edge.normal[0], edge.normal[0]])
    tangent[0] *= -1.0 if mirrored else 1.0
    np.testing.assert_allclose(mapped.point, bend(edge.point[None])[0], rtol=0, atol=0)
    # central differences of a quadratic are exact, but for rounding of 1e-19 m over 1e-5 m
    assert abs(mapped.normal @ tangent) < 1e-13
    inside = bend((edge.point + 1e-6 * edge.normal)[None])[0]
    assert mapped.distance(*inside) > 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Polygon(SQUARE).mapped(lambda p: p * np.nan), "may extend beyond the field"),
        (lambda: Polygon(SQUARE).mapped(lambda p: p[:, :1]), r"\(N, 2\)"),
        (lambda: Polygon(SQUARE).mapped(lambda p: p + RNG.normal(0.0, 1e-6, p.shape)), "bends an edge too much"),
        (lambda: Polygon(SQUARE).mapped(affine, 0.0), "tolerance must be positive"),
        (lambda: HalfPlane((0.0, 0.0), (1.0, 0.0)).mapped(lambda p: p * [0.0, 1.0]), "no inverse"),
        (lambda: Polygon(SQUARE).spectrum(np.zeros((2, 1, 1)), np.zeros((1, 2, 3))), "at most two axes, found 3"),
    ],
)
def test_bad_input_is_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
