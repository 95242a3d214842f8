"""Shadows that the edges of surfaces throw into exit pupils: obscurations, vanes, vignetting.

An edge lies on a surface, a pupil is a function over the stop. The rays of one image meet the surface at places that
are a smooth function of the stop's coordinates, as long as edges stop no ray in the trace. This function is fitted by
polynomials and inverted at the corners of the edge's outline. What the edge blocks then is convex polygons on the stop,
which ``optics.waves.pupil_shadow`` takes out of the pupil exactly.

The part of a stop that light comes through: a quadrature over it, and whether it is a ring.

Of a smooth integrand the whole disk is integrated by Gauss' rule, and what shadows take is taken off again, each of
them by a rule of its own that ends at their sides. So edges leave no raster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optics.geometry.aperture import Circle, Edge, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.polygon import area, area_in_disk, compact, intersect, sides, widened
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.quadrature import PupilNodes
from optics.waves.pupil_shadow import RIM_SIDES, SMALLEST, quadrature_within, separate, tiled, without
from optics.waves.pupil_terms import products, smooth_terms, to_terms

DEGREE = 10
"""Degree of the polynomials that map the stop to a surface."""

ROUND_SIDES = (48, 96, 192)
"""Of the polygon that stands for a round edge and has its area, the fewest that do: where circles nearly touch or
nearly coincide, what is between two of them is thinner than what is between a circle and its polygon."""

FINE_SHARE, COARSE_SHARE = 3e-4, 3e-3
"""Change of a shadow's share of the stop by twice as many sides: up to the first the fewer do, up to the second the
more. They are right to a third of it."""

MOST_PIECES = 160
"""Of a shadow: the time of a transfer function grows with the square of their number."""

_WINDOW, _WINDOW_SIDES = 1.2, 16
"""Polygon about the stop's unit disk to which outlines are cut before their corners are followed to their rays."""

_STEPS, _CLOSE = 12, 1e-9
"""Newton's steps for a corner at most, and when it has arrived, in radii of the stop."""

WORST_FIT = 3e-4
"""Largest distance of the rays from the polynomials, in units of the beam's size on the surface."""


@dataclass(frozen=True, eq=False)
class StopOutlines:
    """Outlines of edges as the images see them on the stop's unit disk: convex polygons, counterclockwise.

    Attributes
    ----------
    clear : tuple[np.ndarray, ...]
        Light comes through inside of all of them only, (B, V, 2) each.
    blocked : tuple[np.ndarray, ...]
        Light is stopped in any of them, (B, V, 2) each; some are empty.
    """

    clear: tuple[np.ndarray, ...] = ()
    blocked: tuple[np.ndarray, ...] = ()

    def __add__(self, other: StopOutlines) -> StopOutlines:
        """The edges of both."""
        return StopOutlines(self.clear + other.clear, self.blocked + other.blocked)

    def take(self, which: np.ndarray | slice) -> StopOutlines:
        """Those of the images of the given indices."""
        return StopOutlines(tuple(one[which] for one in self.clear), tuple(one[which] for one in self.blocked))

    def shadows(self, count: int, further: Sequence[np.ndarray] = ()) -> np.ndarray:
        """What edges and other shadows take of ``count`` pupils.

        Parameters
        ----------
        count : int
            B.
        further : Sequence[np.ndarray]
            Convex polygons of other shadows, counterclockwise, (B, V, 2) each.

        Returns
        -------
        np.ndarray
            Convex polygons that do not overlap, (B, K, W, 2); some are empty.
        """
        # each image by itself: what is one piece in one of them may be many in another
        each = [self._of_one(number, further) for number in range(count)]
        pieces, corners = (max(shape[k] for shape in (one.shape for one in each)) for k in (0, 1))
        out = np.zeros((count, pieces, corners, 2))
        for number, one in enumerate(each):
            out[number, : len(one)] = widened(one, corners)
        return out

    def _of_one(self, number: int, further: Sequence[np.ndarray]) -> np.ndarray:
        """``shadows`` of one image, (K, W, 2)."""
        some = slice(number, number + 1)
        lit = _window(1)
        for polygon in self.clear:
            lit = compact(intersect(lit, *sides(polygon[some])))
        # what is dark already outside of the clear edges is no matter of the others
        dark = [intersect(polygon[some], *sides(lit)) for polygon in (*self.blocked, *further)]
        dark = [compact(piece) for piece in dark if area_in_disk(piece)[0] > SMALLEST]
        beyond = [compact(piece[None]) for piece in _around(lit[0])] if self.clear else []
        pieces, _ = separate(dark, fewest=True)
        every = [*(pieces[0] if dark else ()), *(piece[0] for piece in beyond)]
        width = max((len(piece) for piece in every), default=3)
        return np.stack([widened(piece[None], width)[0] for piece in every]) if every else np.zeros((0, 3, 2))


def settled_shadows(
    outlines: Callable[[int], StopOutlines], count: int, further: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, float]:
    """Shadows of ``count`` pupils with as many sides of round edges as they need.

    Parameters
    ----------
    outlines : Callable[[int], StopOutlines]
        Of the edges, by the number of sides that stand for a round one.
    count : int
        B.
    further : Sequence[np.ndarray]
        As of ``StopOutlines.shadows``.

    Returns
    -------
    tuple[np.ndarray, float]
        Pieces as of ``StopOutlines.shadows``, and how much of the stop their shares are right to.

    Raises
    ------
    UnphysicalError
        As of ``StopOutlines.shadows``, or edges that all sides are too few for.
    """
    few, *more = ROUND_SIDES
    pieces = _few_enough(outlines(few).shadows(count, further))
    share = shares_of_stop(pieces)
    for sides_of_round in more:
        finer = outlines(sides_of_round).shadows(count, further)
        before, share = share, shares_of_stop(finer)
        change = float(np.max(np.abs(share - before), initial=0.0))
        if change < FINE_SHARE:
            return pieces, change
        pieces = _few_enough(finer)
        if change < COARSE_SHARE:
            return pieces, change / 3.0
    raise UnphysicalError(
        f"polygons of {more[-1]} sides for its round edges take {change:.2g} more or less of the pupil than those of "
        "half as many: edges all but coincide"
    )


def _few_enough(pieces: np.ndarray) -> np.ndarray:
    """Pieces of shadows (B, K, V, 2). Raises UnphysicalError where there are too many for a transfer function."""
    if pieces.shape[1] > MOST_PIECES:
        raise UnphysicalError(
            f"edges cut the pupil into {pieces.shape[1]} pieces of shadow, more than {MOST_PIECES}, which its transfer "
            "function does not take"
        )
    return pieces


def shares_of_stop(pieces: np.ndarray) -> np.ndarray:
    """Shares of the stop that pieces of shadows (B, K, V, 2), which do not overlap, take, (B,)."""
    return np.asarray(np.sum(area_in_disk(pieces), axis=-1) / np.pi)


def nodes_in_shadows(pieces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quadrature over the part within the stop of pieces of shadows, with ``count`` nodes along each side of a box.

    Parameters
    ----------
    pieces : np.ndarray
        Convex polygons that do not overlap, counterclockwise, (B, K, V, 2); K may be 0.
    count : int
        nodes.

    Returns
    -------
    tuple[np.ndarray, np.ndarray, np.ndarray]
        Points, complex, (B, Q), weights of the area, (B, Q), and the areas of the pieces, (B, K).
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
    places: np.ndarray,
    edges: Sequence[Edge],
    nodes: PupilNodes,
    round_sides: int = ROUND_SIDES[0],
    lit: np.ndarray | None = None,
) -> StopOutlines:
    """The edges of one surface as B images see them.

    Parameters
    ----------
    places : np.ndarray
        Where the rays through ``nodes`` meet the surface, in its own x and y, (B, N, 2), metres; of rays that edges
        stop, too.
    edges : Sequence[Edge]
        Of the surface; light comes through where all let it.
    nodes : PupilNodes
        Quadrature over the stop's unit disk.
    round_sides : int
        Of the polygon that stands for a round edge.
    lit : np.ndarray | None
        Which rays no edge before the surface stops, (B, N); None for all. Where light is stopped already, nothing is
        left to be cut, and the polynomials go on smoothly.

    Raises
    ------
    UnphysicalError
        Places that no polynomials follow, as of a surface near a focus.
    """
    known = np.all(np.isfinite(places), axis=-1)
    lit = known if lit is None else lit & known
    middle = np.mean(places, axis=1, keepdims=True, where=lit[..., None])
    # far outside of the light polynomials say nothing of where an edge would be
    around = middle + _AROUND * (places - middle)
    edges = [edge for edge in edges if not _idle(edge, around, lit)]
    if not edges:
        return StopOutlines()
    beam = 2.0 * np.max(np.abs(places - middle), axis=(1, 2), where=lit[..., None], initial=0.0)

    def missed(terms: np.ndarray) -> float:
        off = np.linalg.norm(products(nodes.x, nodes.y, DEGREE) @ terms - places, axis=-1) / beam[:, None]
        return float(np.max(off, where=lit, initial=0.0))

    terms = to_terms(nodes, DEGREE) @ places
    worst = missed(terms)
    if not worst < WORST_FIT and not np.all(lit):
        terms = smooth_terms(products(nodes.x, nodes.y, DEGREE), nodes.weight, lit, places)
        worst = missed(terms)
    if not worst < WORST_FIT:
        raise UnphysicalError(
            f"rays meet a surface with edges at places that polynomials of degree {DEGREE} miss by {worst:.2g} of the "
            f"beam's size (at most {WORST_FIT:g}): no pupil can be cut there"
        )
    clear, blocked = [], []
    for edge in edges:
        for outlines, blocks in _outlines(edge, round_sides):
            seen = [_on_the_stop(outline, terms) for outline in outlines]
            if edge.blocks and isinstance(edge.shape, Circle) and edge.shape.inner and _covers(edge, edge.shape, terms):
                # a ring that reaches beyond every beam lets light through its hole alone
                hole = Edge(Circle(edge.shape.inner, edge.shape.centre), turn=edge.turn)
                clear += [_on_the_stop(outline, terms) for outline in next(_outlines(hole, round_sides))[0]]
            elif blocks:
                blocked += seen
            elif len(seen) == 1:
                clear += seen
            else:
                blocked += _outside(seen, len(places))
    return StopOutlines(tuple(clear), tuple(blocked))


def _idle(edge: Edge, around: np.ndarray, lit: np.ndarray) -> bool:
    """Whether a clear edge without a hole lets all of the light through that comes to places (B, N, 2), those lit."""
    if edge.blocks or (isinstance(edge.shape, Circle) and edge.shape.inner):
        return False
    return bool(np.all(edge.passes(around[..., 0], around[..., 1]), where=lit))


_AROUND = 1.1
"""Times the light about its middle: a clear edge beyond stops nothing of it, as nodes stand nearer to each other."""


def _covers(edge: Edge, ring: Circle, terms: np.ndarray) -> bool:
    """Whether the disk within the outer edge of a ring holds all of the stop in every image."""
    disk = Edge(replace(ring, inner=0.0), edge.blocks, edge.turn)
    (outline,), _ = next(_outlines(disk, ROUND_SIDES[0]))
    rim = _window(len(terms), 1.0, RIM_SIDES)
    inside = intersect(rim, *sides(_on_the_stop(outline, terms)))
    return bool(np.all(area(rim) - area(inside) < SMALLEST))


def _disk(count: int) -> np.ndarray:
    """The polygon of a disk of radius 1, which has its area, (count, 2)."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.asarray(np.sqrt(angle[1] / np.sin(angle[1])) * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def _outlines(edge: Edge, round_sides: int) -> Iterator[tuple[list[np.ndarray], bool]]:
    """Convex outlines (V, 2) on the surface, and whether light is stopped in them or outside of all of them."""
    shape, unit = edge.shape, _disk(round_sides)
    match shape:
        case Circle():
            outer = shape.radius * unit
            if not shape.inner:
                yield _turned([outer], edge), edge.blocks
            elif edge.blocks:
                # sectors whose corners are those of their neighbours, so that no gap opens between them on the stop
                both = np.stack([outer, np.roll(outer, -1, axis=0)], axis=1)
                sectors = np.concatenate([both, (shape.inner / shape.radius) * both[:, ::-1]], axis=1)
                yield _turned(list(sectors), edge), True
            else:
                yield _turned([outer], edge), False
                yield _turned([shape.inner * unit], edge), True
        case Ellipse():
            yield _turned([unit * np.array([shape.half_x, shape.half_y])], edge), edge.blocks
        case Rectangle():
            corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
            yield _turned([_divided(corners * np.array([shape.half_x, shape.half_y]))], edge), edge.blocks
        case Ray():
            half = 0.5 * shape.width
            yield _turned([np.array([[0.0, -half], [_FAR, -half], [_FAR, half], [0.0, half]])], edge), edge.blocks
        case Polygon():
            corners = np.array(shape.corners) - np.array(shape.centre)
            yield _turned(_convex_parts(corners), edge), edge.blocks


_FAR = 100.0
"""Where a vane ends, metres: outside of every beam."""


def _turned(outlines: list[np.ndarray], edge: Edge) -> list[np.ndarray]:
    """Outlines about the origin at the edge's place and turn."""
    c, s = np.cos(edge.turn), np.sin(edge.turn)
    return [outline @ np.array([[c, s], [-s, c]]) + np.array(edge.shape.centre) for outline in outlines]


def _convex_parts(corners: np.ndarray) -> list[np.ndarray]:
    """A polygon (V, 2) whose sides do not cross, as convex ones: itself, or triangles cut off ear by ear."""
    rest = corners if area(corners[None])[0] > 0.0 else corners[::-1]
    out = []
    while len(rest) > 3:
        before, after = np.roll(rest, 1, axis=0), np.roll(rest, -1, axis=0)
        turn = _cross(rest - before, after - rest)
        if np.all(turn >= 0.0):
            break
        for k in np.flatnonzero(turn > 0.0):
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
    """A polygon (V, 2) with further corners on its sides, which may bend on the stop."""
    share = np.arange(_PARTS)[:, None] / _PARTS
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


_PARTS = 8
"""Parts into which each side of a rectangle is divided."""


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _window(count: int, radius: float = _WINDOW, number: int = _WINDOW_SIDES) -> np.ndarray:
    """A regular polygon about a disk, (B, number, 2)."""
    angle = 2.0 * np.pi * (np.arange(number) + 0.5) / number
    corners = radius / np.cos(np.pi / number) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.broadcast_to(corners, (count, *corners.shape))


def _on_the_stop(outline: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """An outline (V, 2) on the surface as seen on the stop of B images, counterclockwise, (B, W, 2); empty where it
    lies outside of the beam.
    """
    # place of the ray through the middle of the stop, and the derivatives of places there
    values, rise = _followed(terms, np.zeros((len(terms), 1, 2)))
    middle, slope = values[:, 0], rise[:, 0]
    place = np.broadcast_to(outline, (len(terms), *outline.shape))
    guess = np.einsum("bij,bvj->bvi", np.linalg.inv(slope), place - middle[:, None])
    packed = np.concatenate([guess, place], axis=-1)
    turned = area(packed) < 0.0
    packed = np.where(turned[:, None, None], packed[:, ::-1], packed)
    cut = intersect(packed, *sides(_window(len(terms))))
    at, place = cut[..., :2].copy(), cut[..., 2:]
    empty = area(cut) < SMALLEST
    for _ in range(_STEPS):
        values, rise = _followed(terms, at)
        step = np.einsum("bvij,bvj->bvi", np.linalg.inv(rise), place - values)
        at += np.where(empty[:, None, None], 0.0, step)
        if np.max(np.abs(step), where=~empty[:, None, None], initial=0.0) < _CLOSE:
            break
    return np.where(empty[:, None, None], at[:, :1], at)


def _followed(terms: np.ndarray, at: np.ndarray, step: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """Places (B, V, 2) of rays through points (B, V, 2) of the stop, and their derivatives, (B, V, 2, 2)."""

    def value(points: np.ndarray) -> np.ndarray:
        return np.asarray(products(points[..., 0], points[..., 1], DEGREE) @ terms)

    ways = step * np.eye(2)
    rise = np.stack([(value(at + way) - value(at - way)) / (2.0 * step) for way in ways], axis=-1)
    return value(at), rise


def _around(lit: np.ndarray) -> np.ndarray:
    """What the stop has outside of a convex polygon (V, 2) in the window, counterclockwise: a convex piece beyond each
    side, (K, W, 2), without those that lie beyond the stop.
    """
    lit = compact(lit[None])[0]
    if area(lit) < SMALLEST:
        return _window(1)
    (normal,), (limit,) = sides(lit[None])
    middle = np.mean(lit, axis=0)
    # the polygon grows about its middle until it holds the stop
    size = float(np.max((1.0 - normal @ middle) / np.maximum(limit - normal @ middle, _THINNEST)))
    far = middle + max(size, 1.0) * (lit - middle)
    pieces = np.stack([lit, far, np.roll(far, -1, axis=0), np.roll(lit, -1, axis=0)], axis=1)
    pieces = pieces[area_in_disk(pieces) > SMALLEST]
    normal, limit = sides(_window(1))
    return intersect(pieces, *(np.broadcast_to(part, (len(pieces), *part.shape[1:])) for part in (normal, limit)))


_THINNEST = 1e-6
"""Distance of a polygon's middle from its sides, in radii of the stop, below which the polygon is a line."""


def _outside(clear: list[np.ndarray], count: int) -> list[np.ndarray]:
    """What the window has outside of all clear polygons (B, V, 2), as convex pieces."""
    rest = [_window(count)]
    for polygon in clear:
        rest = [piece for part in rest for piece in without(part, polygon, fewest=True)]
    return rest


ROUND = 1e-4
"""By how much the second moment of a shadow may exceed that of a disk about the stop's middle with its area: of all
shapes it has the least."""


@dataclass(frozen=True, eq=False)
class LitStop:
    """Quadratures over the light of F beams.

    Attributes
    ----------
    x, y : np.ndarray
        Nodes, in units of the stop's radius, (F, N).
    weight : np.ndarray
        Of the area, (F, N); negative in shadows, 0 for what only fills the rows.
    """

    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, pieces: np.ndarray, rings: int, count: int) -> LitStop:
        """The stop without shadows.

        Parameters
        ----------
        pieces : np.ndarray
            Convex polygons on the unit disk that do not overlap, (F, K, V, 2).
        rings : int
            Of the rule over the whole stop.
        count : int
            Nodes along each side of a shadow's box.
        """
        nodes = quadrature.disk(rings)
        points, dark, _ = nodes_in_shadows(pieces, count)
        whole = (len(pieces), nodes.count)
        x, y = (
            np.concatenate([np.broadcast_to(own, whole), taken], axis=1)
            for own, taken in ((nodes.x, points.real), (nodes.y, points.imag))
        )
        return cls(x, y, np.concatenate([np.broadcast_to(nodes.weight, whole), -dark], axis=1))

    @property
    def light(self) -> np.ndarray:
        """Share of the stop that light comes through, (F,)."""
        return np.asarray(np.sum(self.weight, axis=1) / np.pi)


def holes(pieces: np.ndarray) -> np.ndarray:
    """Radius of the hole of each stop whose shadow is one disk about its middle, in units of the stop's, (F,); 0 where
    there is no shadow, NaN where it is another.

    Parameters
    ----------
    pieces : np.ndarray
        Convex polygons that do not overlap, (F, K, V, 2).
    """
    points, weight, _ = nodes_in_shadows(pieces, 4)
    taken = np.sum(weight, axis=1)
    moment = np.sum(weight * np.abs(points) ** 2, axis=1)
    least = taken**2 / (2.0 * np.pi)
    is_round = moment <= (1.0 + ROUND) * least
    return np.asarray(np.where(is_round, np.sqrt(np.maximum(taken, 0.0) / np.pi), np.nan))
