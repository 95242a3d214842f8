"""Convex polygons in batches against qhull, against sums of their parts, and known integrals."""

from math import factorial

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from optics.geometry import polygon as polygons
from optics.waves.pupil_shadow import FEW_SIDES, PupilShadow, quadrature_within, separate
from optics.waves.pupil_terms import PupilEdge
from scenes.models.shadow import Shadows
from tests.tiers import quick

RNG = np.random.default_rng(7)
SOME, OTHERS = (polygons.hull(RNG.normal(size=(60, count, 2))) for count in (7, 6))


def test_hulls_have_the_area_of_qhull() -> None:
    points = RNG.normal(size=(40, 9, 2))
    points[:, 8] = points[:, 0]  # a corner that is there twice
    np.testing.assert_allclose(polygons.area(polygons.hull(points)), [ConvexHull(p).volume for p in points], rtol=1e-12)


def test_areas_within_the_unit_disk() -> None:
    """Of polygons that hold it, lie within it, cut a segment or half of it off; and of others by their parts."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    beyond = 0.4  # of x: the segment on the far side
    segment = np.arccos(beyond) - beyond * np.sqrt(1.0 - beyond**2)
    found = polygons.area_in_disk(
        np.stack([5.0 * square, 0.3 * square, 5.0 * square + [5.4, 0.0], 2.0 * square + [0.0, 2.0]])
    )
    np.testing.assert_allclose(found, [np.pi, 0.36, segment, 0.5 * np.pi], atol=1e-14)
    assert polygons.area_in_disk(0.5 * square[None, ::-1]) == pytest.approx(-1.0)
    assert polygons.area_in_disk(0.2 * square[None] + 3.0) == pytest.approx(0.0, abs=1e-14)
    inside, outside = polygons.intersect(SOME, *polygons.sides(OTHERS)), polygons.difference(SOME, OTHERS)
    parts = polygons.area_in_disk(inside) + sum(polygons.area_in_disk(part) for part in outside)
    np.testing.assert_allclose(parts, polygons.area_in_disk(SOME), atol=1e-13)
    assert (
        np.count_nonzero(
            (polygons.area_in_disk(SOME) > 0.1) & (polygons.area_in_disk(SOME) < polygons.area(SOME) - 0.1)
        )
        > 20
    )


def test_what_is_cut_off_and_what_stays_make_the_whole() -> None:
    inside, outside = polygons.intersect(SOME, *polygons.sides(OTHERS)), polygons.difference(SOME, OTHERS)
    np.testing.assert_allclose(
        polygons.area(inside) + sum(polygons.area(part) for part in outside), polygons.area(SOME), atol=1e-13
    )
    np.testing.assert_allclose(
        polygons.area(inside), polygons.area(polygons.intersect(OTHERS, *polygons.sides(SOME))), atol=1e-13
    )


def test_half_planes_and_empty_polygons() -> None:
    square = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
    normal = np.array([[1.0, 0.0]])
    for limit, left in ((2.0, 1.0), (0.25, 0.25), (-1.0, 0.0)):
        assert polygons.area(polygons.clip(square, normal, np.array([limit])))[0] == left
    twice = np.repeat(square, 2, axis=1)
    assert polygons.compact(twice).shape == square.shape
    assert polygons.area(polygons.compact(twice))[0] == 1.0


@pytest.mark.parametrize("count", [2, 3, 5])
def test_quadrature_is_exact_for_its_polynomials(count: int) -> None:
    """Integrals over a triangle: a! b! / (a + b + 2)!; a polygon's are those of its triangles."""
    triangle = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    points, weights = polygons.quadrature(triangle, count)
    for a in range(count):
        for b in range(count):
            want = factorial(a) * factorial(b) / factorial(a + b + 2)
            assert np.sum(weights * points.real**a * points.imag**b) == pytest.approx(want, rel=1e-12)
    points, weights = polygons.quadrature(SOME[:, ::-1], count)  # of the other sense
    np.testing.assert_allclose(weights.sum(axis=-1), polygons.area(SOME), rtol=1e-12)


def test_shadows_that_overlap_count_once() -> None:
    pieces, owners = separate([SOME, OTHERS])
    union = (
        polygons.area(SOME) + polygons.area(OTHERS) - polygons.area(polygons.intersect(SOME, *polygons.sides(OTHERS)))
    )
    np.testing.assert_allclose(polygons.area(pieces).sum(axis=-1), union, atol=1e-12)
    assert owners[0] == 0
    assert set(owners[1:]) == {1}
    # where one is nothing in a pupil, the other stays whole there
    nothing = np.where(np.arange(60)[:, None, None] % 2 == 0, SOME[:, :1], SOME)
    pieces, _ = separate([nothing, OTHERS])
    np.testing.assert_allclose(polygons.area(pieces).sum(axis=-1)[::2], polygons.area(OTHERS)[::2], atol=1e-12)


def test_rounding_in_corners_cuts_nothing_off() -> None:
    """Corners 1e-17 apart have a side of no direction."""
    square = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
    rough = np.repeat(square, 2, axis=1)
    rough[0, 1::2] += 1e-17 * np.array([[3.0, 1.0], [-1.0, 2.0], [1.0, -5.0], [0.0, 4.0]])
    assert polygons.area(polygons.intersect(square, *polygons.sides(rough)))[0] == 1.0


def test_an_edge_that_is_no_circle() -> None:
    """The part of a polygon within the pupil's true edge against a fine polygon of that edge."""
    harmonics = np.zeros((7, 1), complex)
    harmonics[[4, 6, 0], 0] = 1.0, 0.015 + 0.01j, 0.01j
    angle = 2.0 * np.pi * np.arange(4096) / 4096
    edge = PupilEdge(harmonics[:, 0]).boundary(angle)[0]
    fine = np.stack([edge.real, edge.imag], axis=-1)[None]
    box = np.array([[[[0.5, 0.3], [0.9, 0.3], [0.9, 1.2], [0.5, 1.2]]]])
    shadow = PupilShadow.within(box, harmonics, FEW_SIDES)
    want = polygons.area(polygons.intersect(fine, *polygons.sides(box[0])))[0]
    # chords of 64 sides lie (pi/64)^2 / 3 = 0.8e-3 inside of a circle, for which their area is made up; this edge's
    # curvature is another by a sixth along an arc of 0.55: 7e-5
    assert shadow.area[0] == pytest.approx(want, abs=7e-5)
    shift = np.array([0.4 + 0.2j])
    _, weights = shadow.overlap(shift[None], 3)
    move = np.array([0.4, 0.2])
    own = polygons.intersect(fine, *polygons.sides(box[0]))
    far = [polygons.intersect(own, *polygons.sides(fine + sign * move)) for sign in (1.0, -1.0)]
    both = polygons.intersect(own, *polygons.sides(own + move))
    want = -sum(polygons.area(part)[0] for part in far) + polygons.area(both)[0]
    assert weights.sum() == pytest.approx(want, abs=2 * 7e-5)


def _random_shadow(rng: np.random.Generator) -> np.ndarray:
    """A convex outline of any place, size and thinness, (1, V, 2); one of four is a sliver, one touches the rim."""
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, rng.integers(3, 9)))
    thin = 10.0 ** rng.uniform(-8.0, 0.0) if rng.random() < 0.5 else 1.0
    own = 10.0 ** rng.uniform(-2.0, 0.0) * np.stack([np.cos(angle), thin * np.sin(angle)], axis=-1)
    # slivers along an axis, whose box is as thin as they are, and turned ones
    turn = rng.choice([0.0, 0.5 * np.pi, rng.uniform(0.0, np.pi)])
    own = own @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    middle = rng.uniform(-1.0, 1.0, 2)
    if rng.random() < 0.25:
        way = middle / np.hypot(*middle)
        reach = own @ way
        touching = rng.choice([np.max(reach), np.min(reach)])  # from within, and from without
        middle = way * (1.0 - touching + 10.0 ** rng.uniform(-14.0, -4.0) * rng.choice([-1.0, 1.0]))
    return np.asarray((own + middle)[None])


@pytest.mark.parametrize("thin", [1e-4, 1e-6, 1e-8, 1e-11])
@pytest.mark.parametrize("across", [0.0, -0.4600344734959])
def test_a_sliver_within_a_pupil_has_its_area_and_no_more(thin: float, across: float) -> None:
    sliver = np.array([[[-0.5, across], [0.3, across], [0.4, across + thin], [-0.3, across + thin]]])
    for outline in (sliver, sliver[..., ::-1][:, ::-1]):
        points, weights = quadrature_within(outline, np.ones((1, 1), complex), 5)
        assert np.sum(weights) == pytest.approx(0.75 * thin, rel=1e-3)
        assert np.sum(np.abs(weights)) < 2.0 * 0.75 * thin
        assert np.max(np.abs(points)) < 1.0


@pytest.mark.second
@pytest.mark.parametrize("count", quick(1, [40, 300]))
def test_random_shadows_in_a_pupil_take_what_a_dense_raster_of_it_says(count) -> None:
    """Of pupils with one to six shadows, slivers and outlines that touch the rim or each other among them."""
    rng = np.random.default_rng(33)
    line = (np.arange(300) + 0.5) / 150.0 - 1.0
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    raster = np.stack([x, y], axis=-1)[np.hypot(x, y) < 1.0]
    for _ in range(count):
        outlines = [_random_shadow(rng) for _ in range(rng.integers(1, 7))]
        if len(outlines) > 1 and rng.random() < 0.3:  # shares a side with the first
            outlines[-1] = outlines[0] + (outlines[0][:, 1] - outlines[0][:, 0])[:, None]
        shadows = Shadows.of([(str(k), outline) for k, outline in enumerate(outlines)], 1)
        shares = shadows.shares()
        taken = polygons.covered(np.stack([polygons.padded(o, 9) for o in outlines], axis=1), raster)[0]
        # a raster is right to the square root of the length of edges that it counts, some 1e-3 here
        assert sum(float(share[0]) for share in shares.values()) == pytest.approx(np.mean(taken), abs=4e-3)
        assert all(-1e-6 < float(share[0]) < 1.0 + 1e-6 for share in shares.values())
        # squares of wavefronts are sums of these weights, which alternate where a sliver lies in a corner of its box
        assert np.sum(np.abs(shadows.weights)) < 100.0 * np.sum(shadows.areas) + 1e-3
