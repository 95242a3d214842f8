"""Shadows of surfaces' edges in exit pupils (obscurations, vanes, vignetting), and the illuminated part of a stop.

An edge lies on a surface, a pupil is a function over the stop. The rays of one image meet the surface at positions that
are a smooth function of the stop's coordinates, as long as edges block no ray in the trace. This function is fitted by
polynomials and inverted at the corners of the edge's outline. The blocked part of the stop is then a set of convex
polygons, which ``optics.waves.pupil_shadow`` subtracts from the pupil exactly.

``IlluminatedStop`` is a quadrature over the illuminated part of a stop. A smooth integrand is integrated over the whole
disk by Gauss' rule, and each shadow is subtracted by a rule of its own that ends at its sides. Edges are thus not
sampled on a raster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from optics.geometry.aperture import Circle, Edge, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.polygon import area, area_in_disk, compact, intersect, padded, sides
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.quadrature import PupilNodes, circle
from optics.waves.pupil_shadow import RIM_SIDES, SMALLEST, quadrature_within, separate, tiled, without
from optics.waves.pupil_terms import products, smooth_terms, to_terms

DEGREE = 10
"""Degree of the polynomials that map a point of the stop to the point where its ray meets a surface."""

ROUND_SIDES = (48, 96, 192)
"""Numbers of sides, tried in this order, of the polygon of equal area that represents a round edge.

Where circles nearly touch or nearly coincide, the area between two of them is thinner than that between a circle and
its polygon.
"""

FINE_SHARE, COARSE_SHARE = 3e-4, 3e-3
"""Limits of the change of a shadow's area, as a fraction of the stop, when round edges get twice as many sides.

Up to the first, the smaller number of sides is used; up to the second, the larger one, whose error is a third of the
change.
"""

MOST_PIECES = 160
"""Largest number of polygons of a shadow: the time of a transfer function grows with the square of their number."""

_WINDOW, _WINDOW_SIDES = 1.2, 16
"""Radius, in radii of the stop, and number of corners of a polygon around the stop to which outlines are clipped.

Outlines outside the stop have no effect on its light.
"""

_STEPS, _CLOSE = 12, 1e-9
"""Largest number of Newton steps for a corner, and tolerance of its position in radii of the stop."""

WORST_FIT = 3e-4
"""Largest allowed distance of rays from the polynomials fitted to them, in units of the beam's size on the surface."""


@dataclass(frozen=True, eq=False)
class StopOutlines:
    """Outlines of edges projected onto the stop's unit disk for B images: convex polygons, counterclockwise.

    Attributes
    ----------
    clear : tuple of (B, V, 2) ndarray
        Polygons of V corners, inside all of which light passes.
    blocked : tuple of (B, V, 2) ndarray
        Polygons of V corners, inside any of which light is blocked; some are empty.
    """

    clear: tuple[np.ndarray, ...] = ()
    blocked: tuple[np.ndarray, ...] = ()

    def __add__(self, other: StopOutlines) -> StopOutlines:
        """Return the outlines of both objects together, such as those of the edges of two surfaces."""
        return StopOutlines(self.clear + other.clear, self.blocked + other.blocked)

    def take(self, images: np.ndarray | slice) -> StopOutlines:
        """Return the outlines of some of the images, given by their indices."""
        return StopOutlines(tuple(p[images] for p in self.clear), tuple(p[images] for p in self.blocked))

    def shadows(self, count: int, further: Sequence[np.ndarray] = ()) -> np.ndarray:
        """Return the shadows of edges and of other bodies in ``count`` pupils.

        Parameters
        ----------
        count : int
            Number of images B.
        further : sequence of (B, V, 2) ndarray
            Convex polygons of V corners, other shadows, counterclockwise.

        Returns
        -------
        (B, K, W, 2) ndarray
            K convex polygons of W corners that do not overlap; some are empty.
        """
        # each image separately: one piece in one of them may be many in another
        shadows = [self._of_beam(number, further) for number in range(count)]
        pieces, corners = (max(shape[k] for shape in (polygons.shape for polygons in shadows)) for k in (0, 1))
        out = np.zeros((count, pieces, corners, 2))
        for number, polygons in enumerate(shadows):
            out[number, : len(polygons)] = padded(polygons, corners)
        return out

    def _of_beam(self, number: int, further: Sequence[np.ndarray]) -> np.ndarray:
        """Return the shadows in the pupil of image ``number``: K polygons of W corners without overlap, (K, W, 2)."""
        image = slice(number, number + 1)
        clear_area = _window(1)
        for polygon in self.clear:
            clear_area = compact(intersect(clear_area, *sides(polygon[image])))
        # shadows matter only inside the clear edges
        dark = [intersect(polygon[image], *sides(clear_area)) for polygon in (*self.blocked, *further)]
        dark = [compact(piece) for piece in dark if area_in_disk(piece)[0] > SMALLEST]
        beyond = [compact(piece[None]) for piece in _outside_of(clear_area[0])] if self.clear else []
        pieces, _ = separate(dark, fewest=True)
        all_pieces = [*(pieces[0] if dark else ()), *(piece[0] for piece in beyond)]
        width = max((len(piece) for piece in all_pieces), default=3)
        return np.stack([padded(piece[None], width)[0] for piece in all_pieces]) if all_pieces else np.zeros((0, 3, 2))


def converged_shadows(
    outlines: Callable[[int], StopOutlines], count: int, further: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, float]:
    """Return the shadows of ``count`` pupils, with round edges of as many sides as needed.

    Parameters
    ----------
    outlines : callable
        Number of sides of a round edge's polygon -> StopOutlines.
    count : int
        Number of images B.
    further : sequence of (B, V, 2) ndarray
        Convex polygons of V corners, other shadows, counterclockwise.

    Returns
    -------
    pieces : (B, K, W, 2) ndarray
        Shadows as K convex polygons of W corners that do not overlap.
    error : float
        Accuracy of the fraction of the stop that they cover.

    Raises
    ------
    UnphysicalError
        There are too many polygons, or the largest number of sides is too small.
    """
    few, *finer_sides = ROUND_SIDES
    pieces = _require_few(outlines(few).shadows(count, further))
    share = shares_of_stop(pieces)
    for sides_of_round in finer_sides:
        finer = outlines(sides_of_round).shadows(count, further)
        before, share = share, shares_of_stop(finer)
        change = float(np.max(np.abs(share - before), initial=0.0))
        if change < FINE_SHARE:
            return pieces, change
        pieces = _require_few(finer)
        if change < COARSE_SHARE:
            return pieces, change / 3.0
    raise UnphysicalError(
        f"the shadow of round edges changes by {change:.2g} of the pupil between polygons of {ROUND_SIDES[-1]} sides "
        "and of half as many: edges nearly coincide"
    )


def _require_few(pieces: np.ndarray) -> np.ndarray:
    """Return the polygons of shadows; raise UnphysicalError where there are too many for a transfer function.

    ``pieces`` (B, K, V, 2) are K polygons of V corners in each of B pupils.
    """
    if pieces.shape[1] > MOST_PIECES:
        raise UnphysicalError(
            f"edges cut the pupil into {pieces.shape[1]} pieces of shadow, but its transfer "
            f"function allows at most {MOST_PIECES}"
        )
    return pieces


def shares_of_stop(pieces: np.ndarray) -> np.ndarray:
    """Return, for each of B pupils, the fraction of the stop covered by its shadows, (B,).

    ``pieces`` (B, K, V, 2) are K polygons of V corners in each pupil that do not overlap.
    """
    return np.asarray(np.sum(area_in_disk(pieces), axis=-1) / np.pi)


def nodes_in_shadows(pieces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a quadrature over the parts of shadows within the stop, with ``count`` nodes along each side of a box.

    Parameters
    ----------
    pieces : (B, K, V, 2) ndarray
        K convex polygons of V corners in each of B pupils that do not overlap, counterclockwise; K may be 0.
    count : int
        Number of nodes along each side.

    Returns
    -------
    points : (B, Q) ndarray
        Q nodes in units of the stop's radius, as complex numbers x + iy.
    weights : (B, Q) ndarray
        Area weights.
    areas : (B, K) ndarray
        Areas of the polygons.
    """
    images, number = pieces.shape[:2]
    if not number:
        return np.zeros((images, 0), complex), np.zeros((images, 0)), np.zeros((images, 0))
    tiles, tiled_from = tiled(pieces)
    flat = tiles.reshape(-1, *tiles.shape[2:])
    points, weights = quadrature_within(flat, np.ones((len(flat), 1), complex), count)
    of_tiles = np.sum(weights.reshape(*tiles.shape[:2], -1), axis=-1)
    areas = of_tiles @ (tiled_from[:, None] == np.arange(number))
    return points.reshape(images, -1), weights.reshape(images, -1), areas


def outlines_on_stop(
    positions: np.ndarray,
    edges: Sequence[Edge],
    nodes: PupilNodes,
    round_sides: int = ROUND_SIDES[0],
    bright: np.ndarray | None = None,
) -> StopOutlines:
    """Return the outlines of one surface's edges on the stop, for B images.

    Parameters
    ----------
    positions : (B, N, 2) ndarray
        Intersections of N rays through ``nodes`` with the surface, in its own x and y, metres; also of rays that edges
        block.
    edges : sequence of Edge
        Edges of the surface; light passes where all let it.
    nodes : PupilNodes
        Quadrature over the stop's unit disk.
    round_sides : int
        Number of sides of the polygon that represents a round edge.
    bright : (B, N) ndarray of bool, optional
        Mask of the rays that no edge before the surface blocks; None for all. Where light is blocked already, there is
        nothing left to block, and the polynomials are only continued smoothly.

    Raises
    ------
    UnphysicalError
        Polynomials do not follow the intersections, as on a surface near a focus.
    """
    finite = np.all(np.isfinite(positions), axis=-1)
    bright = finite if bright is None else bright & finite
    middle = np.mean(positions, axis=1, keepdims=True, where=bright[..., None])
    # far outside the light the polynomials do not give the position of an edge
    around = middle + _BEAM_MARGIN * (positions - middle)
    edges = [edge for edge in edges if not _passes_all(edge, around, bright)]
    if not edges:
        return StopOutlines()
    beam = 2.0 * np.max(np.abs(positions - middle), axis=(1, 2), where=bright[..., None], initial=0.0)

    def worst_miss(terms: np.ndarray) -> float:
        miss = np.linalg.norm(products(nodes.x, nodes.y, DEGREE) @ terms - positions, axis=-1) / beam[:, None]
        return float(np.max(miss, where=bright, initial=0.0))

    terms = to_terms(nodes, DEGREE) @ positions
    worst = worst_miss(terms)
    if not worst < WORST_FIT and not np.all(bright):
        terms = smooth_terms(products(nodes.x, nodes.y, DEGREE), nodes.weight, bright, positions)
        worst = worst_miss(terms)
    if not worst < WORST_FIT:
        raise UnphysicalError(
            f"polynomials of degree {DEGREE} miss the rays on a surface with edges by {worst:.2g} of the beam's size "
            f"(at most {WORST_FIT:g}): its shadow in the pupil cannot be computed"
        )
    clear, blocked = [], []
    for edge in edges:
        for outlines, blocks in _outlines(edge, round_sides):
            projected = [_on_stop(outline, terms) for outline in outlines]
            if edge.blocks and isinstance(edge.shape, Circle) and edge.shape.inner and _covers(edge, edge.shape, terms):
                # a ring that extends beyond every beam passes light through its hole only
                hole = Edge(Circle(edge.shape.inner, edge.shape.centre), rotation=edge.rotation)
                clear += [_on_stop(outline, terms) for outline in next(_outlines(hole, round_sides))[0]]
            elif blocks:
                blocked += projected
            elif len(projected) == 1:
                clear += projected
            else:
                blocked += _outside(projected, len(positions))
    return StopOutlines(tuple(clear), tuple(blocked))


def _passes_all(edge: Edge, around: np.ndarray, bright: np.ndarray) -> bool:
    """Return True for an edge without a hole, inside which light passes, if all illuminated rays pass with a margin.

    ``around`` (B, N, 2) are the positions of N rays in B images, moved outward by the margin, and ``bright`` is the
    mask of illuminated rays.
    """
    if edge.blocks or (isinstance(edge.shape, Circle) and edge.shape.inner):
        return False
    return bool(np.all(edge.passes(around[..., 0], around[..., 1]), where=bright))


_BEAM_MARGIN = 1.1
"""Factor by which the beam is enlarged about its middle to test whether an edge blocks some of it.

The quadrature nodes that represent the beam do not reach its rim.
"""


def _covers(edge: Edge, ring: Circle, terms: np.ndarray) -> bool:
    """Return True when the disk inside a ring's outer edge contains the whole beam in every image.

    ``terms`` are the coefficients of the polynomials that map a point of the stop to its ray's point on the surface.
    """
    disk = Edge(replace(ring, inner=0.0), edge.blocks, edge.rotation)
    (outline,), _ = next(_outlines(disk, ROUND_SIDES[0]))
    rim = _window(len(terms), 1.0, RIM_SIDES)
    inside = intersect(rim, *sides(_on_stop(outline, terms)))
    return bool(np.all(area(rim) - area(inside) < SMALLEST))


def _disk(count: int) -> np.ndarray:
    """Return the regular polygon (count, 2) with the area of the unit disk."""
    side = 2.0 * np.pi / count
    return np.asarray(np.sqrt(side / np.sin(side)) * circle(count))


def _outlines(edge: Edge, round_sides: int) -> Iterator[tuple[list[np.ndarray], bool]]:
    """Yield convex outlines (V, 2) of V corners on the surface, and whether light is blocked inside or outside them.

    The flag is True where light is blocked inside each of them, False where it is blocked outside all.
    """
    shape, unit = edge.shape, _disk(round_sides)
    match shape:
        case Circle():
            outer = shape.radius * unit
            if not shape.inner:
                yield _placed([outer], edge), edge.blocks
            elif edge.blocks:
                # sectors that share their corners, so that no gap opens between them on the stop
                both = np.stack([outer, np.roll(outer, -1, axis=0)], axis=1)
                sectors = np.concatenate([both, (shape.inner / shape.radius) * both[:, ::-1]], axis=1)
                yield _placed(list(sectors), edge), True
            else:
                yield _placed([outer], edge), False
                yield _placed([shape.inner * unit], edge), True
        case Ellipse():
            yield _placed([unit * np.array([shape.half_x, shape.half_y])], edge), edge.blocks
        case Rectangle():
            corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
            yield _placed([_divided(corners * np.array([shape.half_x, shape.half_y]))], edge), edge.blocks
        case Ray():
            half = 0.5 * shape.width
            yield _placed([np.array([[0.0, -half], [_FAR, -half], [_FAR, half], [0.0, half]])], edge), edge.blocks
        case Polygon():
            corners = np.array(shape.corners) - np.array(shape.centre)
            yield _placed(_convex_parts(corners), edge), edge.blocks


_FAR = 100.0
"""Length of a vane, metres: beyond every beam."""


def _placed(outlines: list[np.ndarray], edge: Edge) -> list[np.ndarray]:
    """Return outlines about the origin moved to the edge's position and rotated as the edge is."""
    c, s = np.cos(edge.rotation), np.sin(edge.rotation)
    return [outline @ np.array([[c, s], [-s, c]]) + np.array(edge.shape.centre) for outline in outlines]


def _convex_parts(corners: np.ndarray) -> list[np.ndarray]:
    """Return the convex polygons that make up a polygon whose sides do not cross: itself, or triangles by ear clipping.

    ``corners`` (V, 2) are its V corners.
    """
    rest = corners if area(corners[None])[0] > 0.0 else corners[::-1]
    out = []
    while len(rest) > 3:
        before, after = np.roll(rest, 1, axis=0), np.roll(rest, -1, axis=0)
        orientation = _cross(rest - before, after - rest)
        if np.all(orientation >= 0.0):
            break
        for k in np.flatnonzero(orientation > 0.0):
            ear = np.stack([before[k], rest[k], after[k]])
            others = np.delete(rest, [(k - 1) % len(rest), k, (k + 1) % len(rest)], axis=0)
            normal, limit = sides(ear[None])
            if not np.any(np.all(others @ normal[0].T <= limit[0], axis=-1)):
                out.append(ear)
                rest = np.delete(rest, k, axis=0)
                break
        else:
            raise UnphysicalError("the sides of a polygonal edge cross each other")
    return [*out, rest]


def _divided(corners: np.ndarray) -> np.ndarray:
    """Return a polygon (V, 2) of V corners with further corners on its sides, which may be curved on the stop."""
    fraction = np.arange(_PARTS)[:, None] / _PARTS
    return np.concatenate([a + fraction * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


_PARTS = 8
"""Number of parts into which each side of a rectangle is divided, as it may be curved when projected onto the stop."""


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of vectors in a plane: x_a y_b - y_a x_b."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _window(count: int, radius: float = _WINDOW, number: int = _WINDOW_SIDES) -> np.ndarray:
    """Return a regular polygon of ``number`` corners about a disk of ``radius``, repeated for ``count`` images.

    It has the shape (count, number, 2).
    """
    angle = 2.0 * np.pi * (np.arange(number) + 0.5) / number
    corners = radius / np.cos(np.pi / number) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.broadcast_to(corners, (count, *corners.shape))


def _on_stop(outline: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return an outline of the surface projected onto the stop of B images, counterclockwise, (B, W, 2) with W corners.

    ``outline`` (V, 2) has V corners. The result is empty where the outline lies outside the beam.
    """
    # surface position of the ray through the middle of the stop, and the derivatives there
    values, slopes = _surface_positions(terms, np.zeros((len(terms), 1, 2)))
    middle, slope = values[:, 0], slopes[:, 0]
    targets = np.broadcast_to(outline, (len(terms), *outline.shape))
    guess = np.einsum("bij,bvj->bvi", np.linalg.inv(slope), targets - middle[:, None])
    packed = np.concatenate([guess, targets], axis=-1)
    clockwise = area(packed) < 0.0
    packed = np.where(clockwise[:, None, None], packed[:, ::-1], packed)
    clipped = intersect(packed, *sides(_window(len(terms))))
    points, targets = clipped[..., :2].copy(), clipped[..., 2:]
    empty = area(clipped) < SMALLEST
    for _ in range(_STEPS):
        values, slopes = _surface_positions(terms, points)
        step = np.einsum("bvij,bvj->bvi", np.linalg.inv(slopes), targets - values)
        points += np.where(empty[:, None, None], 0.0, step)
        if np.max(np.abs(step), where=~empty[:, None, None], initial=0.0) < _CLOSE:
            break
    return np.where(empty[:, None, None], points[:, :1], points)


def _surface_positions(terms: np.ndarray, centre: np.ndarray, step: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays through V points of the stop meet the surface in B images, (B, V, 2), metres, and derivatives.

    The derivatives (B, V, 2, 2) are with respect to the point of the stop.
    """

    def value(points: np.ndarray) -> np.ndarray:
        return np.asarray(products(points[..., 0], points[..., 1], DEGREE) @ terms)

    shifts = step * np.eye(2)
    rise = np.stack([(value(centre + shift) - value(centre - shift)) / (2.0 * step) for shift in shifts], axis=-1)
    return value(centre), rise


def _outside_of(bright: np.ndarray) -> np.ndarray:
    """Return the part of the stop outside a convex counterclockwise polygon, as K convex polygons (K, W, 2).

    ``bright`` (V, 2) are its V corners. There is one polygon of W corners beyond each side; those beyond the stop are
    omitted.
    """
    bright = compact(bright[None])[0]
    if area(bright) < SMALLEST:
        return _window(1)
    (normal,), (limit,) = sides(bright[None])
    middle = np.mean(bright, axis=0)
    # the polygon is scaled about its middle until it contains the stop
    size = float(np.max((1.0 - normal @ middle) / np.maximum(limit - normal @ middle, _MIN_HALF_WIDTH)))
    far = middle + max(size, 1.0) * (bright - middle)
    pieces = np.stack([bright, far, np.roll(far, -1, axis=0), np.roll(bright, -1, axis=0)], axis=1)
    pieces = pieces[area_in_disk(pieces) > SMALLEST]
    normal, limit = sides(_window(1))
    return intersect(pieces, *(np.broadcast_to(part, (len(pieces), *part.shape[1:])) for part in (normal, limit)))


_MIN_HALF_WIDTH = 1e-6
"""Distance of a polygon's middle from its sides, in radii of the stop, below which the polygon is a line."""


def _outside(clear: list[np.ndarray], count: int) -> list[np.ndarray]:
    """Return the part of a window about the stop that lies in none of the clear polygons, as convex polygons.

    ``clear`` are polygons (B, V, 2) of V corners in B images.
    """
    rest = [_window(count)]
    for polygon in clear:
        rest = [piece for part in rest for piece in without(part, polygon, fewest=True)]
    return rest


@dataclass(frozen=True, eq=False)
class SurfaceEdges:
    """Edges of a camera's surfaces, and where the rays of B images meet these surfaces.

    Attributes
    ----------
    edges : mapping of str to tuple of Edge
        Surface -> its edges, in the order of the light, of every surface that has some.
    points : mapping of str to (B, N, 2) ndarray
        Surface -> points where N rays meet it, stopped or not, in its own x and y, metres of nominal size.
    nodes : PupilNodes
        Points of the stop, through which the rays go.
    """

    edges: Mapping[str, tuple[Edge, ...]]
    points: Mapping[str, np.ndarray]
    nodes: PupilNodes

    @cached_property
    def passed(self) -> list[np.ndarray]:
        """Masks of the rays that no edge up to and including each surface blocks, (B, N) for N rays of B images."""
        through = [
            np.all([edge.passes(points[..., 0], points[..., 1]) for edge in self.edges[name]], axis=0)
            for name, points in self.points.items()
        ]
        return list(accumulate(through, np.logical_and))

    def outlines(self, round_sides: int) -> StopOutlines:
        """Return the outlines on the stop, with ``round_sides`` sides for a circle.

        Raises
        ------
        UnphysicalError
            Rays meet a surface at places that no polynomials follow.
        """
        outlines = StopOutlines()
        for (name, points), bright in zip(self.points.items(), [None, *self.passed[:-1]], strict=True):
            outlines += outlines_on_stop(points, self.edges[name], self.nodes, round_sides, bright)
        return outlines


ROUND = 1e-4
"""Relative excess of a shadow's second moment over that of a centred disk up to which it counts as that disk.

The disk of the shadow's area has the smallest second moment of all shapes of its area.
"""


@dataclass(frozen=True, eq=False)
class IlluminatedStop:
    """Quadratures of N nodes over the illuminated parts of a stop for F beams.

    Attributes
    ----------
    x, y : (F, N) ndarray
        Nodes, in units of the stop's radius.
    weight : (F, N) ndarray
        Area weights; negative in shadows, 0 for padding.
    """

    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, pieces: np.ndarray, rings: int, count: int) -> IlluminatedStop:
        """Return the quadrature over the stop without shadows.

        Parameters
        ----------
        pieces : (F, K, V, 2) ndarray
            Shadows of F beams: K convex polygons of V corners on the unit disk that do not overlap.
        rings : int
            Number of rings of the rule over the whole stop.
        count : int
            Number of nodes along each side of a shadow's box.
        """
        nodes = quadrature.disk(rings)
        points, dark, _ = nodes_in_shadows(pieces, count)
        whole = (len(pieces), nodes.count)
        x, y = (
            np.concatenate([np.broadcast_to(disk_nodes, whole), shadow_nodes], axis=1)
            for disk_nodes, shadow_nodes in ((nodes.x, points.real), (nodes.y, points.imag))
        )
        return cls(x, y, np.concatenate([np.broadcast_to(nodes.weight, whole), -dark], axis=1))

    @property
    def light(self) -> np.ndarray:
        """Fraction of the stop that is illuminated, for each of F beams, (F,)."""
        return np.asarray(np.sum(self.weight, axis=1) / np.pi)


def holes(pieces: np.ndarray) -> np.ndarray:
    """Return the radius of the central obscuration of each of F stops, in units of the stop's radius, (F,).

    It is 0 where there is no shadow, and NaN where the shadow is not one disk about the stop's middle.

    Parameters
    ----------
    pieces : (F, K, V, 2) ndarray
        Shadows: K convex polygons of V corners that do not overlap.
    """
    points, weight, _ = nodes_in_shadows(pieces, 4)
    blocked = np.sum(weight, axis=1)
    moment = np.sum(weight * np.abs(points) ** 2, axis=1)
    least = blocked**2 / (2.0 * np.pi)
    is_round = moment <= (1.0 + ROUND) * least
    return np.asarray(np.where(is_round, np.sqrt(np.maximum(blocked, 0.0) / np.pi), np.nan))
