"""Edges of surfaces as shadows in pupils, against a raster of the same edges."""

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Edge, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.polygon import area, covered
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.waves import edge_shadow
from optics.waves.edge_shadow import IlluminatedStop, holes
from optics.waves.pupil_shadow import separate
from optics.waves.pupil_terms import products, smooth_terms
from tests.tiers import quick

NODES = quadrature.disk(14)
AXIS = (np.arange(300) + 0.5) / 150.0 - 1.0
POINTS = np.stack([a.ravel() for a in np.meshgrid(AXIS, AXIS)], axis=-1)
POINTS = POINTS[np.hypot(*POINTS.T) < 1.0]


def seen(points: np.ndarray, number: int) -> np.ndarray:
    """Where rays through points of the stop meet a surface: scaled, turned over, shifted, a little bent; metres."""
    x, y = points.T
    flip = -1.0 if number % 2 else 1.0
    bend = 0.005 * (x * x + y * y)
    return 0.15 * np.stack([(1.0 + bend) * x + 0.05 * number, flip * (0.97 + bend) * y], axis=-1)


def lit(edges: list[Edge], number: int) -> np.ndarray:
    places = seen(POINTS, number)
    return np.all([edge.passes(*places.T) for edge in edges], axis=0)


def shadows(edges: list[Edge], count: int = 3) -> np.ndarray:
    places = np.stack([seen(np.stack([NODES.x, NODES.y], axis=-1), k) for k in range(count)])
    return edge_shadow.outlines_on_stop(places, edges, NODES).shadows(count)


VANES = [Edge(Ray(0.006), True, turn) for turn in np.radians([30.0, 150.0, 270.0])]
STAR = Polygon(((0.05, 0.0), (0.015, 0.015), (0.0, 0.06), (-0.015, 0.015), (-0.05, 0.0), (0.0, -0.03)))


EDGES = {
    "spider": [Edge(Circle(0.05), True), *VANES],
    "annulus": [Edge(Circle(0.16, inner=0.04))],
    "mixed": [Edge(Rectangle(0.1, 0.13), rotation=0.3), Edge(Ellipse(0.03, 0.06), True, 0.7)],
    "star-hole": [Edge(STAR)],
    "obscured": [Edge(Circle(0.05), True)],
    "vignetted": [Edge(Circle(0.14, (0.02, 0.0)))],
    "hole": [Edge(Circle(0.5, inner=0.12), True)],
    "hole of one": [Edge(Circle(0.152, inner=0.12), True)],
    "ring": [Edge(Circle(0.09, (0.03, 0.02), inner=0.05), True)],
    "star": [Edge(STAR, True)],
    "nested": [Edge(Circle(0.16)), *(Edge(Circle(*c), True) for c in ((0.05,), (0.049,), (0.05, (1e-12, 0.0))))],
}


@pytest.mark.second
@pytest.mark.parametrize("name", quick(1, EDGES))
def test_shadows_are_what_edges_block(name: str) -> None:
    edges = EDGES[name]
    pieces = shadows(edges)
    for number in range(len(pieces)):
        expected, found = lit(edges, number), ~covered(pieces, POINTS)[number]
        # along an edge single points of the raster fall on the other side of the polygon that stands for a circle
        assert np.mean(expected != found) < 4e-3
        assert np.mean(expected) == pytest.approx(np.mean(found), abs=1.5e-3)


def test_a_polygon_that_is_empty_but_for_rounding_leaves_a_part_once() -> None:
    """Of two images one has a sliver where the other has a square: what it is cut from counts once in both."""
    square = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.4], [0.0, 0.4]])
    sliver = np.array([[0.1, 0.1], [0.3, 0.1], [0.3, 0.1 + 1e-10], [0.1, 0.1 + 1e-10]])
    first, second = np.stack([square, sliver]), np.stack([square + 0.2, square + 0.2])
    for fewest in (False, True):
        pieces, _ = separate([first, second], fewest=fewest)
        assert np.sum(area(pieces), axis=-1) == pytest.approx([0.28, 0.16], abs=1e-8)


def test_too_many_pieces_and_rays_that_no_polynomials_follow_are_refused(monkeypatch) -> None:
    with pytest.raises(UnphysicalError, match="polynomials of degree"):
        edge_shadow.outlines_on_stop(
            np.stack([NODES.x, np.sign(NODES.y)], axis=-1)[None], [Edge(Circle(0.3), True)], NODES
        )
    monkeypatch.setattr(edge_shadow, "MOST_PIECES", 3)
    with pytest.raises(UnphysicalError, match="pieces of shadow"):
        edge_shadow.converged_shadows(by_sides([Edge(Circle(0.3), True), *VANES]), 1)


def test_edges_that_stop_nothing_leave_no_shadow() -> None:
    assert shadows([Edge(Circle(1.0)), Edge(Circle(0.02, (3.0, 0.0)), True)]).shape[1] == 0
    assert edge_shadow.StopOutlines().shadows(2).shape == (2, 0, 3, 2)


def by_sides(edges: list[Edge]):
    """Outlines on a stop that rays meet as they meet the surface, one image, by the sides of a round edge."""
    places = np.stack([NODES.x, NODES.y], axis=-1)[None]
    return lambda count: edge_shadow.outlines_on_stop(places, edges, NODES, count)


@pytest.mark.parametrize("turn", np.arange(0.0, 6.0, 0.9))
def test_a_polygon_falls_into_the_same_parts_wherever_it_is_turned_to(turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    arrow = np.array([[0.4, 0.0], [-0.4, 0.4], [-0.08, 0.0], [-0.4, -0.4]]) @ np.array([[c, s], [-s, c]])
    edge = Edge(Polygon(tuple(map(tuple, arrow))), True)
    dark = covered(by_sides([edge])(8).shadows(1), POINTS)[0]
    assert np.mean(dark == edge.passes(*POINTS.T)) < 1e-3


def test_circles_that_nearly_coincide_get_more_sides() -> None:
    """Between two circles that all but coincide lies less than between a circle and its polygon."""
    one, error = edge_shadow.converged_shadows(by_sides([Edge(Circle(0.5), True)]), 1)
    assert error < 1e-6
    assert edge_shadow.shares_of_stop(one)[0] == pytest.approx(0.25, abs=1e-6)
    # one circle twice, by polygons whose corners are not the same: what both let through is smaller than either
    twice = [Edge(Circle(0.8)), Edge(Circle(0.8), rotation=np.pi / edge_shadow.ROUND_SIDES[0])]
    few = edge_shadow.shares_of_stop(by_sides(twice)(edge_shadow.ROUND_SIDES[0]).shadows(1))[0]
    many, error = edge_shadow.converged_shadows(by_sides(twice), 1)
    assert few - 0.36 > edge_shadow.FINE_SHARE > error > 0.0
    assert edge_shadow.shares_of_stop(many)[0] == pytest.approx(0.36, abs=error)


def test_edges_that_no_sides_are_enough_for_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(edge_shadow, "FINE_SHARE", 1e-12)
    monkeypatch.setattr(edge_shadow, "COARSE_SHARE", 1e-12)
    with pytest.raises(UnphysicalError, match="edges nearly coincide"):
        edge_shadow.converged_shadows(by_sides([Edge(Circle(0.5, (0.8, 0.0)), True)]), 1)


def test_clear_edges_beyond_the_light_are_followed_nowhere() -> None:
    """What an edge before it has stopped is no matter of the next: its rays there may go anywhere."""
    lit = np.hypot(NODES.x, NODES.y) < 0.6
    wild = np.stack([NODES.x, NODES.y], axis=-1) * np.where(lit, 1.0, 5.0 * np.cos(40.0 * NODES.x))[:, None]
    edges = [Edge(Circle(0.9))]
    with pytest.raises(UnphysicalError, match="polynomials of degree"):
        edge_shadow.outlines_on_stop(wild[None], edges, NODES)
    assert not edge_shadow.outlines_on_stop(wild[None], edges, NODES, bright=lit[None]).clear


@pytest.mark.second
def test_a_stop_without_its_shadows() -> None:
    """Area and moments of a ring, and whether it is one: a vane or a shift makes it none."""
    ring = edge_shadow.converged_shadows(by_sides([Edge(Circle(0.6), True)]), 1)[0]
    stop = IlluminatedStop.of(ring, 6, 6)
    assert stop.light[0] == pytest.approx(1.0 - 0.36, abs=1e-6)
    fourth = float(stop.weight[0] @ (stop.x[0] ** 2 + stop.y[0] ** 2) ** 2)
    assert fourth == pytest.approx(np.pi / 3.0 * (1.0 - 0.6**6), rel=1e-4)
    assert holes(ring)[0] == pytest.approx(0.6, abs=1e-4)
    assert holes(np.zeros((1, 0, 3, 2)))[0] == 0.0
    for edges in (
        [Edge(Circle(0.6), True), Edge(Ray(0.01), True)],
        [Edge(Circle(0.6, (0.02, 0.0)), True)],
        [Edge(Circle(0.95))],
    ):
        assert np.isnan(holes(edge_shadow.converged_shadows(by_sides(edges), 1)[0])[0])
    assert edge_shadow.nodes_in_shadows(np.zeros((2, 0, 3, 2)), 4)[0].shape == (2, 0)


def test_polynomials_follow_the_light_and_stay_near_it_in_the_dark() -> None:
    """Rays in the dark, wild ones and those that are lost, change nothing; a crescent's wavefront is followed."""
    nodes = quadrature.disk(20)
    lit = (nodes.y < 0.35 + 0.1 * nodes.x) & (np.hypot(nodes.x, nodes.y) > 0.25)
    wave = np.cos(3.0 * nodes.x + nodes.y) + 0.02 * nodes.x**12
    design = products(nodes.x, nodes.y, 16)
    wild = np.where(lit, wave, np.where(nodes.x > 0.0, np.nan, 1e6 * nodes.y))
    terms, same = (smooth_terms(design, nodes.weight, lit[None], one[None, :, None]) for one in (wild, wave))
    assert np.array_equal(terms, same)
    told = design @ terms[0, :, 0]
    assert np.std((told - wave)[lit]) < 1e-4
    # and runs no farther in the dark
    assert np.ptp(told) < 2.0 * np.ptp(wave[lit])
