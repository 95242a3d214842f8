"""Shadows of bodies in exit pupils: which parts of the overlap of a pupil with itself they take.

A shadow is some convex polygons in the normalised pupil plane. With P the clear pupil and S the shadow, the overlap of
the cut pupil P - S with itself, shifted by -s/2 and +s/2, is that of P less S - s/2 and S + s/2; what both take counts
once. All of these are intersections of convex regions, and the integrand is smooth in each of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optics.geometry.polygon import area, clip, compact, difference, from_boundary, intersect, padded, quadrature, sides
from optics.numerics.array_math import UnphysicalError
from optics.numerics.quadrature import gauss
from optics.waves.pupil_terms import PupilEdge

RIM_SIDES = 256
"""Sides of the polygon that stands for the pupil's edge where it meets a shadow. It has the edge's area; what an arc of
it takes of a shadow is right to some 1e-6 of a round pupil, and where the same arc cuts twice to 4e-6."""

FEW_SIDES = 64
"""Sides of that polygon for many pupils at once: 16 times the errors."""

LARGEST = 0.5
"""Size of a piece, in radii of the pupil: a wavefront is continued from a piece to its box, the corners of which may
lie outside of the pupil."""

_ITERATIONS = 3
"""For crossings with an edge that is nearly a circle: each step leaves an error smaller by the edge's harmonics."""

_MOST_ITERATIONS = 40
"""For the edge's radius, each of them the better the rounder the edge: the least round ones take some 25."""

_TURNED = 1e-12
"""Angle of an arc, radians, below which it is none but for rounding."""

_ROUND = 1e-10
"""Term of an edge's radius, below which it is none."""

_ROOM = 1e-5
"""By which the area of a part of a polygon may leave what is possible, of a pupil of radius 1: arcs are integrated by
Gauss' rule."""

SMALLEST = 1e-9
"""Area of a piece, of a pupil of radius 1, below which it is nothing."""


@dataclass(frozen=True, eq=False)
class PupilShadow:
    """Shadows in B pupils.

    Attributes
    ----------
    pieces : np.ndarray
        Convex polygons that do not overlap, in the pupil, (B, K, V, 2), counterclockwise; some are empty.
    radius : np.ndarray
        Of the pupils' edges as Fourier terms over the angle about p = 0, complex, (B, H).
    """

    pieces: np.ndarray
    radius: np.ndarray

    @classmethod
    def within(cls, polygons: np.ndarray, harmonics: np.ndarray, rim_sides: int = RIM_SIDES) -> PupilShadow:
        """What polygons (B, K, V, 2), which do not overlap, take of pupils with edges of ``harmonics`` (2H + 1, B).

        Parameters
        ----------
        polygons : np.ndarray
            In the pupils, which do not overlap, (B, K, V, 2).
        harmonics : np.ndarray
            Of the pupils' edges, complex (2H + 1, B).
        rim_sides : int
            Of the polygon that stands for an edge.
        """
        radius = edge_radius(harmonics)
        return cls(tiled(cut(polygons, radius, rim_sides))[0], radius)

    @property
    def area(self) -> np.ndarray:
        """Area of each pupil's shadow, (B,), in p."""
        return np.asarray(np.sum(area(self.pieces), axis=-1))

    @cached_property
    def least_nodes(self) -> int:
        """Nodes on each side of a region's box for the wavefronts of cameras near their focus; in corners of the box a
        wavefront is continued beyond the pupil. With those that the phase needs (``quadrature.nodes_for``) the transfer
        function is right to 1e-5, with 0.06 waves of spherical aberration and astigmatism too.
        """
        return 1 + int(np.ceil(8.0 * float(np.max(np.ptp(self.pieces, axis=-2), initial=0.0))))

    def take(self, which: np.ndarray | slice) -> PupilShadow:
        """Those of the given pupils."""
        return PupilShadow(self.pieces[which], self.radius[which])

    def whole(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature over the pieces: points (B, K, count^2), complex, and weights of the area."""
        number = self.pieces.shape[:2]
        points, weights = quadrature(self.pieces.reshape(-1, *self.pieces.shape[2:]), count)
        return points.reshape(*number, -1), weights.reshape(*number, -1)

    def overlap(self, shift: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature over what the shadows take of the overlap of pupils shifted by -s/2 and +s/2.

        Parameters
        ----------
        shift : np.ndarray
            s, complex, (B, S).
        count : int
            Nodes along each side of a region's bounding box.

        Returns
        -------
        tuple[np.ndarray, np.ndarray]
            Points c, complex, (B, S, Q), and weights of the area, negative where light is taken once and positive where
            two shadows have taken it twice: to be added to ``PupilEdge.overlap``.
        """
        parts = self.parts(shift, count)
        middle = parts.points - 0.5 * (parts.sign * shift[parts.pupil, parts.step])[:, None]
        rows = parts.pupil * shift.shape[1] + parts.step
        order, place, most = in_rows(rows, shift.size)
        points, weights = np.zeros((shift.size, most, count**2), complex), np.zeros((shift.size, most, count**2))
        points[rows[order], place], weights[rows[order], place] = middle[order], parts.weights[order]
        return points.reshape(*shift.shape, -1), weights.reshape(*shift.shape, -1)

    def parts(self, shift: np.ndarray, count: int) -> ShadowParts:
        """Quadrature as ``overlap`` gives it, part by part."""
        moves = np.stack([shift.real, shift.imag], axis=-1)
        full = area(self.pieces) > SMALLEST
        points, weights = self.whole(count)
        # c + sign s/2 lies in the shadow and c - sign s/2 in the pupil: the shadow within the pupil moved by sign s
        sign = np.array([1.0, -1.0])
        away = sign[:, None] * moves[:, :, None]
        least, most = _least(self.radius), _most(self.radius)
        x, y = (self.pieces[:, None, None, ..., k] - away[..., None, None, k] for k in (0, 1))
        inside = np.max(x * x + y * y, axis=-1) < least[:, None, None, None] ** 2
        centre = np.mean(self.pieces, axis=2)
        size = np.sqrt(np.max(np.sum((self.pieces - centre[:, :, None]) ** 2, axis=-1), axis=-1))
        near = centre[:, None, None] - away[..., None, :]
        near = np.hypot(near[..., 0], near[..., 1]) - size[:, None, None] < most[:, None, None, None]
        full_at = np.nonzero(inside & full[:, None, None])
        b, s, g, k = np.nonzero(~inside & near & full[:, None, None])
        corners = self._corners
        cut_points, cut_weights = np.empty((len(b), count**2), complex), np.empty((len(b), count**2))
        for some, (many,) in _alike(corners[b, k]):
            moved = self.pieces[b[some], k[some], :many] - away[b[some], s[some], g[some]][:, None]
            cut_points[some], cut_weights[some] = quadrature_within(moved, self.radius[b[some]], count)
        cut_points += (sign[g] * shift[b, s])[:, None]
        pair = self._pairs(moves, full)
        shared_points, shared_weights = np.empty((len(pair[0]), count**2), complex), np.empty((len(pair[0]), count**2))
        for some, (many, others) in _alike(corners[pair[0], pair[2]], corners[pair[0], pair[3]]):
            at, step, first, second = (index[some] for index in pair)
            windows = self.pieces[:, :, :others]
            normal, limit = sides(windows.reshape(-1, *windows.shape[2:]))
            normal, limit = (a.reshape(*windows.shape[:2], *a.shape[1:])[at, second] for a in (normal, limit))
            limit = limit + np.einsum("fwx,fx->fw", normal, moves[at, step])
            shared = intersect(self.pieces[at, first, :many], normal, limit)
            shared_points[some], shared_weights[some] = quadrature(shared, count)
            if not np.all(np.abs(np.sum(shared_weights[some], axis=-1) - np.abs(area(shared))) < _ROOM):
                raise UnphysicalError("what two shadows share came out of another size than it has")
        return ShadowParts(
            pupil=np.concatenate([full_at[0], b, pair[0]]),
            step=np.concatenate([full_at[1], s, pair[1]]),
            sign=np.concatenate([sign[full_at[2]], sign[g], np.ones(len(pair[0]))]),
            piece=full_at[3],
            whole=points,
            points=np.concatenate([points[full_at[0], full_at[3]], cut_points, shared_points]),
            weights=np.concatenate([-weights[full_at[0], full_at[3]], -cut_weights, shared_weights]),
        )

    @cached_property
    def _corners(self) -> np.ndarray:
        """Corners of each piece without those that repeat its last, (B, K)."""
        apart = np.any(self.pieces[:, :, 1:] != self.pieces[:, :, :-1], axis=-1)
        last = self.pieces.shape[2] - 1 - np.argmax(apart[..., ::-1], axis=-1)
        return np.asarray(np.where(np.any(apart, axis=-1), last + 1, 1))

    def _pairs(self, moves: np.ndarray, full: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pupils, steps and numbers of two pieces of which the second, moved by (B, S, 2), may meet the first."""
        low, high = self.pieces.min(axis=2), self.pieces.max(axis=2)
        moved_low, moved_high = (end[:, None, None] + moves[:, :, None, None] for end in (low, high))
        apart = (high[:, None, :, None] <= moved_low) | (moved_high <= low[:, None, :, None])
        both = full[:, None, :, None] & full[:, None, None]
        return np.nonzero(~np.any(apart, axis=-1) & both)


_LIKE = (12, 20, 32, 52)
"""Numbers of corners up to which polygons are worked on together: one with hundreds of them makes all as slow."""


def _alike(*corners: np.ndarray) -> Iterator[tuple[np.ndarray | slice, tuple[int | None, ...]]]:
    """Which of F sets of polygons have like numbers of corners, (F,) each, and bounds of these; None: all of them."""
    if max((int(np.max(one, initial=0)) for one in corners), default=0) <= _LIKE[0]:
        yield slice(None), (None,) * len(corners)
        return
    bounds = [np.searchsorted(_LIKE, one) for one in corners]
    code = np.ravel_multi_index(tuple(bounds), (len(_LIKE) + 1,) * len(corners))
    for value in np.unique(code):
        which = np.unravel_index(value, (len(_LIKE) + 1,) * len(corners))
        yield np.flatnonzero(code == value), tuple(_LIKE[k] if k < len(_LIKE) else None for k in which)


@dataclass(frozen=True, eq=False)
class ShadowParts:
    """Quadrature over F regions that shadows take of overlaps of B pupils with themselves, for S shifts each.

    A region is told where it lies in a shadow: for light that goes through q there and, in the other pupil, through
    q - sign s.

    Attributes
    ----------
    pupil, step : np.ndarray
        Which pupil and which of its shifts, (F,).
    sign : np.ndarray
        Of the shift of the pupil that the shadow belongs to, (F,).
    piece : np.ndarray
        Of the first W regions, which are whole pieces: their number, (W,).
    whole : np.ndarray
        Nodes of all pieces, complex, (B, K, Q).
    points : np.ndarray
        q, complex, (F, Q).
    weights : np.ndarray
        Of the area, as in ``PupilShadow.overlap``, (F, Q).
    """

    pupil: np.ndarray
    step: np.ndarray
    sign: np.ndarray
    piece: np.ndarray
    whole: np.ndarray
    points: np.ndarray
    weights: np.ndarray


def separate(polygons: list[np.ndarray], fewest: bool = False) -> tuple[np.ndarray, list[int]]:
    """Pieces that do not overlap.

    Parameters
    ----------
    polygons : list[np.ndarray]
        Convex, counterclockwise, (B, V, 2) each.
    fewest : bool
        Take the largest polygons first and cut each other one along the sides that cut off most, which leaves few
        pieces of polygons with many sides.

    Returns
    -------
    tuple[np.ndarray, list[int]]
        Pieces (B, K, W, 2), and of which polygon each is; what several share belongs to the first.
    """
    done: list[np.ndarray] = []
    owners: list[int] = []
    order = list(range(len(polygons)))
    if fewest:
        order = sorted(order, key=lambda number: -float(np.mean(area(polygons[number]))))
    for number in order:
        parts = [polygons[number]]
        for before in done:
            parts = [rest for part in parts for rest in without(part, before, fewest)]
        done += parts
        owners += [number] * len(parts)
    width = max((part.shape[1] for part in done), default=3)
    pieces = np.stack([padded(part, width) for part in done], axis=1) if done else np.zeros((0, 0, 3, 2))
    return pieces, owners


def without(part: np.ndarray, before: np.ndarray, fewest: bool = False) -> list[np.ndarray]:
    """Pieces of ``part`` outside of ``before``; itself if they do not meet in any of the pupils.

    Parameters
    ----------
    part : np.ndarray
        Convex, (B, V, 2).
    before : np.ndarray
        Convex, counterclockwise, (B, W, 2); some may be empty.
    fewest : bool
        As in `separate`.
    """
    empty = area(before) < SMALLEST
    if np.all(empty | (area(intersect(part, *sides(before))) < SMALLEST)):
        return [part]
    whole = np.where(empty[:, None, None], part, part[:, :1])  # an empty polygon has no sides that could bound it
    if fewest:
        normal, limit = sides(before)
        # beyond the other sides there is nothing of it
        height = np.einsum("bvx,bwx->bwv", part[..., :2], normal)
        beyond = np.flatnonzero(np.any(height > limit[..., None], axis=(0, 2)))
        off = [float(np.mean(area(clip(part, -normal[:, w], -limit[:, w])))) for w in beyond]
        pieces = difference(part, before, beyond[np.argsort(off)[::-1]])
    else:
        pieces = difference(part, before)
    # of a polygon that is empty but for rounding the sides are there, and would leave the part a second time
    pieces = [np.where(empty[:, None, None], piece[:, :1], piece) for piece in pieces]
    return [piece for piece in (whole, *pieces) if np.any(area(piece) > SMALLEST)]


def tiled(pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut shadows (B, K, V, 2) into pieces that are no larger than LARGEST along x and y, (B, L, W, 2), and of which
    of the K each is, (L,).
    """
    owners = np.arange(pieces.shape[1])
    for axis in (0, 1):
        done, numbers = [], []
        for owner, piece in zip(owners, np.moveaxis(pieces, 1, 0), strict=True):
            low = piece[..., axis].min(axis=1)
            size = piece[..., axis].max(axis=1) - low
            parts = max(int(np.ceil(np.max(size, initial=0.0) / LARGEST)), 1)
            normal = np.zeros((len(piece), 2))
            normal[:, axis] = 1.0
            for k in range(1, parts):
                limit = low + size * (k / parts)
                done.append(clip(piece, normal, limit))
                piece = clip(piece, -normal, -limit)
            done.append(piece)
            numbers += [owner] * parts
        width = max((part.shape[1] for part in done), default=pieces.shape[2])
        if done:
            pieces, owners = np.stack([padded(part, width) for part in done], axis=1), np.array(numbers)
    return pieces, owners


def edge_radius(harmonics: np.ndarray) -> np.ndarray:
    """Fourier terms c of the radius Re sum c_k exp(ik angle) of edges with ``harmonics`` (2H + 1, B), (B, K)."""
    last = len(harmonics) // 2
    order = np.abs(np.arange(-last, last + 1))
    used = int(np.max(order[np.max(np.abs(harmonics), axis=1) > _TURNED]))
    own = harmonics[last - used : last + used + 1]
    count = 8 * used + 4
    angle = np.broadcast_to(2.0 * np.pi * np.arange(count) / count, (harmonics.shape[1], count))
    edge, at, back = PupilEdge(own), angle, np.exp(-1j * angle[0])
    for _ in range(_MOST_ITERATIONS):
        point = edge.boundary(at)[0]
        off = np.angle(point * back)
        if np.max(np.abs(off), initial=0.0) < _TURNED:
            break
        at = at - off
    terms = np.fft.rfft(np.abs(point), axis=-1)[:, : 2 * used + 1] / count
    terms[:, 1:] *= 2.0
    some = np.flatnonzero(np.max(np.abs(terms), axis=0) > _ROUND)
    return np.asarray(terms[:, : some[-1] + 1])


def _radius(terms: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Radius (N, ...) of edges with ``terms`` (N, K) in directions exp(i angle), (N, ...)."""
    over = (slice(None),) + (None,) * (turn.ndim - 1)
    total = np.zeros_like(turn)
    for k in range(terms.shape[1] - 1, 0, -1):
        total = (total + terms[:, k][over]) * turn
    return np.asarray(total.real + terms[:, 0].real[over])


def cut(polygons: np.ndarray, radius: np.ndarray, rim_sides: int) -> np.ndarray:
    """The part of each polygon (B, K, V, 2) inside of edges with Fourier terms ``radius`` (B, H), for which polygons of
    the same area with so many sides stand; counterclockwise.

    Parameters
    ----------
    polygons : np.ndarray
        (B, K, V, 2), in p.
    radius : np.ndarray
        Of the edges as Fourier terms over the angle, complex (B, H).
    rim_sides : int
        Of the polygon of the same area that stands for an edge.
    """
    number = polygons.shape[1]
    flat = polygons.reshape(-1, *polygons.shape[2:])
    flat = np.where((area(flat) < 0.0)[:, None, None], flat[:, ::-1], flat)
    reach = np.max(np.hypot(flat[..., 0], flat[..., 1]), axis=-1, initial=0.0)
    beyond = np.flatnonzero((reach > np.repeat(_least(radius), number)) & (area(flat) > SMALLEST))
    if len(beyond):
        step = 2.0 * np.pi / rim_sides
        turn = np.broadcast_to(np.exp(1j * step * np.arange(rim_sides)), (len(radius), rim_sides))
        rim = turn * _radius(radius, turn) * np.sqrt(step / np.sin(step))
        # a polygon has few sides inside of the rim
        inner = compact(intersect(np.stack([rim.real, rim.imag], axis=-1)[beyond // number], *sides(flat[beyond])))
        flat = padded(flat, inner.shape[1]).copy()
        flat[beyond] = padded(inner, flat.shape[1])
    flat = compact(flat)
    return flat.reshape(*polygons.shape[:2], *flat.shape[1:])


def _least(radius: np.ndarray) -> np.ndarray:
    """A bound below each edge's radius, (N,)."""
    return np.asarray(np.abs(radius[:, 0]) - np.sum(np.abs(radius[:, 1:]), axis=-1))


def _most(radius: np.ndarray) -> np.ndarray:
    """A bound above each edge's radius, (N,)."""
    return np.asarray(np.sum(np.abs(radius), axis=-1))


def quadrature_within(polygons: np.ndarray, radius: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature over the intersection of polygons with the inside of edges.

    Whatever of a polygon's boundary lies outside of the edge is drawn in along the radius. That changes no winding
    number of a point inside of the edge, so that the new boundary goes once around the intersection and around nothing
    else. Each side becomes an arc, a straight piece and an arc; most of them are of no length.

    Parameters
    ----------
    polygons : np.ndarray
        (F, V, 2), in p.
    radius : np.ndarray
        Of the edge of each as Fourier terms over the angle, complex (F, H).
    count : int
        Nodes along each of the two directions.
    """
    start = polygons[..., 0] + 1j * polygons[..., 1]
    after = np.roll(start, -1, axis=1)
    way = after - start
    length = np.abs(way)
    unit = way / np.where(length > 0.0, length, 1.0)
    nearest = -(start * np.conj(unit)).real  # of the whole line, as a distance from the start
    within = np.abs(start) < _least(radius)[:, None]
    within &= np.roll(within, -1, axis=1)
    beyond = np.abs(start + np.clip(nearest, 0.0, length) * unit) > _most(radius)[:, None]
    ends = np.zeros(length.shape), np.where(within, length, 0.0)
    crossed = np.nonzero(~within & ~beyond)
    own, direction, nearest = radius[crossed[0]], unit[crossed], nearest[crossed]
    foot = start[crossed] + nearest * direction
    off = np.abs(foot) ** 2
    for sign, end in zip((-1.0, 1.0), ends, strict=True):
        size = own[:, 0].real
        for _ in range(_ITERATIONS):
            half = np.sqrt(np.maximum(size**2 - off, 0.0))
            size = _radius(own, _direction(foot + sign * half * direction))
        place = nearest + sign * np.sqrt(np.maximum(size**2 - off, 0.0))
        end[crossed] = np.clip(place, 0.0, length[crossed])
    enter, leave = (start + end * unit for end in ends)
    node, weight = gauss(count + 1)
    share = 0.5 * (node + 1.0)
    (first, last), straight = _some(np.stack([enter, leave]), ends[1] - ends[0] > _TURNED)
    place = first[..., None] + (last - first)[..., None] * share
    rise = 0.5 * weight * (last - first).imag[..., None]
    outside = np.concatenate([ends[0] > _TURNED, length - ends[1] > _TURNED], axis=1)
    pairs = np.stack([np.concatenate([start, leave], axis=1), np.concatenate([enter, after], axis=1)])
    (begin, end), bent = _some(pairs, outside)
    angle = np.angle(end * np.conj(begin))
    turn = _direction(begin)[..., None] * np.exp(1j * angle[..., None] * share)
    size, slope = _radius_and_slope(radius, turn)
    arc = turn * size
    arc_rise = 0.5 * weight * angle[..., None] * (turn * (slope + 1j * size)).imag
    # the region's box: of both ends of straight pieces, and of nodes on arcs
    corners = np.concatenate([first, last, arc.reshape(len(arc), arc.shape[1] * arc.shape[2])], axis=1)
    counted = np.concatenate([straight, straight, np.repeat(bent, len(share), axis=1)], axis=1)
    low, high = (
        np.stack([f(c, axis=1, where=counted, initial=limit) for c in (corners.real, corners.imag)], axis=-1)
        for f, limit in ((np.min, np.inf), (np.max, -np.inf))
    )
    none = ~np.any(counted, axis=1)
    low[none], high[none] = 0.0, 0.0
    # What only fills the rows must not lie on the pupil's edge: in units of a narrow box that is millions away, where
    # polynomials make of a rounding error in its angle, 1e-17, any number.
    middle = 0.5 * (low + high) @ np.array([1.0, 1j])
    used = np.concatenate([np.repeat(kept, len(share), axis=1) for kept in (straight, bent)], axis=1)
    every, rises = (
        np.concatenate([part.reshape(len(part), part.shape[1] * part.shape[2]) for part in both], axis=1)
        for both in ((place, arc), (rise, arc_rise))
    )
    every, rises = np.where(used, every, middle[:, None]), np.where(used, rises, 0.0)
    points, weights = from_boundary(np.stack([every.real, every.imag], axis=-1), rises, low, high, count)
    total = np.sum(weights, axis=-1)
    if not np.all((total > -_ROOM) & (total < np.abs(area(polygons)) + _ROOM)):
        raise UnphysicalError("a part of a shadow within the pupil came out larger than the whole of it")
    return points, weights


def _some(pairs: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of pairs of points (2, N, V) that are kept, (N, V), as (2, N, W), and which of these are, (N, W); others
    begin and end at one place.
    """
    many = np.sum(kept, axis=1)
    width = max(int(np.max(many, initial=0)), 1)
    order = np.argsort(~kept, axis=1, kind="stable")[:, :width]
    first, last = (np.take_along_axis(points, order, axis=1) for points in pairs)
    some = np.arange(width) < many[:, None]
    return np.stack([first, np.where(some, last, first)]), some


def _direction(point: np.ndarray) -> np.ndarray:
    size = np.abs(point)
    return np.asarray(np.where(size > 0.0, point, 1.0) / np.where(size > 0.0, size, 1.0))


def _radius_and_slope(terms: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radius and its derivative by the angle, as ``_radius``."""
    over = (slice(None),) + (None,) * (turn.ndim - 1)
    total, slope = np.zeros_like(turn), np.zeros_like(turn)
    for k in range(terms.shape[1] - 1, 0, -1):
        slope = slope * turn + (1j * k) * terms[:, k][over]
        total = (total + terms[:, k][over]) * turn
    return total.real + terms[:, 0].real[over], (slope * turn).real


def in_rows(owner: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray, int]:
    """How to pack things (F,) of given owners in rows: their order, the place of each in its row, and rows' length."""
    order = np.argsort(owner, kind="stable")
    many = np.bincount(owner, minlength=rows)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(many) - many, many)
    return order, place, int(np.max(many, initial=0))
