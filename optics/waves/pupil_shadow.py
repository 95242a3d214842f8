"""Shadows of bodies in exit pupils: quadrature over their parts of the overlap of a pupil with itself.

A shadow is a set of convex polygons in the normalised pupil plane, whose points are complex numbers p = x + iy with the
pupil's edge near the unit circle. With P the clear pupil and S the shadow, the overlap of the vignetted pupil P - S
with itself, shifted by -s/2 and +s/2, is that of P less S - s/2 and S + s/2; their common part counts once. All of
these are intersections of convex regions, and the integrand is smooth in each of them.
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
"""Number of sides of the polygon that represents the pupil's edge where it meets a shadow.

It has the edge's area; the part of a shadow that an arc of it cuts off is accurate to some 1e-6 of a round pupil, and
to 4e-6 where the same arc cuts twice.
"""

FEW_SIDES = 64
"""Number of sides of the polygon that represents a pupil's edge if many pupils are computed at once.

The errors are 16 times those with ``RIM_SIDES``.
"""

MAX_PIECE = 0.5
"""Largest size along x and y of a polygon of a shadow, in radii of the pupil; larger ones are divided.

A wavefront is extrapolated from a polygon to its box, whose corners may lie outside the pupil.
"""

_ITERATIONS = 3
"""Number of iterations for intersections with a nearly circular edge.

Each step reduces the error by a factor of the size of the edge's harmonics.
"""

_MOST_ITERATIONS = 40
"""Largest number of iterations for the edge's radius, which converge faster the rounder the edge is; the least round
edges take some 25.
"""

_ANGLE_TOLERANCE = 1e-12
"""Angle of an arc, radians, below which it is zero to rounding."""

_MIN_TERM = 1e-10
"""Modulus below which a Fourier term of the radius of a pupil's edge is omitted, in radii of the pupil."""

_AREA_TOLERANCE = 1e-5
"""Tolerance of the area of a part of a polygon, for a pupil of radius 1: arcs are integrated by Gauss' rule."""

SMALLEST = 1e-9
"""Area of a polygon, for a pupil of radius 1, below which it counts as empty."""


@dataclass(frozen=True, eq=False)
class PupilShadow:
    """Shadows in B pupils, in normalised pupil coordinates.

    Attributes
    ----------
    pieces : (B, K, V, 2) ndarray
        K convex polygons of V corners in each pupil that do not overlap, counterclockwise; some are empty.
    radius : (B, H) ndarray
        Radii of the pupils' edges as H complex Fourier terms over the angle about the origin.
    """

    pieces: np.ndarray
    radius: np.ndarray

    @classmethod
    def within(cls, polygons: np.ndarray, harmonics: np.ndarray, rim_sides: int = RIM_SIDES) -> PupilShadow:
        """Return the parts of polygons that lie in B pupils with given edges.

        Parameters
        ----------
        polygons : (B, K, V, 2) ndarray
            K polygons of V corners in the pupil planes, which do not overlap.
        harmonics : (2H + 1, B) ndarray
            Complex coefficients c_n, n = -H to H, of the edges' points sum c_n exp(i n a), with a the angle on the
            stop's rim.
        rim_sides : int
            Number of sides of the polygon that represents an edge.
        """
        radius = edge_radius(harmonics)
        return cls(tiled(within_edge(polygons, radius, rim_sides))[0], radius)

    @property
    def area(self) -> np.ndarray:
        """Area of the shadow of each of B pupils, (B,), in units of the square of the pupil's radius."""
        return np.asarray(np.sum(area(self.pieces), axis=-1))

    @cached_property
    def least_nodes(self) -> int:
        """Number of quadrature nodes on each side of the box about a region of a shadow, for cameras near their focus.

        The wavefront is extrapolated beyond the pupil in corners of the box. With the nodes that its phase needs in
        addition (``quadrature.nodes_for``) the transfer function is accurate to 1e-5, also with 0.06 waves of spherical
        aberration and astigmatism.
        """
        return 1 + int(np.ceil(8.0 * float(np.max(np.ptp(self.pieces, axis=-2), initial=0.0))))

    def take(self, which: np.ndarray | slice) -> PupilShadow:
        """Return the shadows of some of the pupils, given by their indices."""
        return PupilShadow(self.pieces[which], self.radius[which])

    def whole(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a quadrature over the shadows' polygons: complex nodes (B, K, count^2) and area weights.

        There are K polygons in each of B pupils, and ``count`` nodes along each side of a polygon's box.
        """
        number = self.pieces.shape[:2]
        points, weights = quadrature(self.pieces.reshape(-1, *self.pieces.shape[2:]), count)
        return points.reshape(*number, -1), weights.reshape(*number, -1)

    def overlap(self, shift: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a quadrature over the shadows' parts of the overlap of pupils shifted by -s/2 and +s/2.

        Parameters
        ----------
        shift : (B, S) ndarray
            S complex shifts s of each of B pupils.
        count : int
            Number of nodes along each side of a region's bounding box.

        Returns
        -------
        points : (B, S, Q) ndarray
            Q complex nodes, in coordinates midway between those of the two shifted pupils.
        weights : (B, S, Q) ndarray
            Area weights, negative where one shadow blocks light and positive where two shadows overlap: to be added to
            ``PupilEdge.overlap``.
        """
        parts = self.parts(shift, count)
        middle = parts.points - 0.5 * (parts.sign * shift[parts.pupil, parts.step])[:, None]
        rows = parts.pupil * shift.shape[1] + parts.step
        order, column, width = in_rows(rows, shift.size)
        points, weights = np.zeros((shift.size, width, count**2), complex), np.zeros((shift.size, width, count**2))
        points[rows[order], column], weights[rows[order], column] = middle[order], parts.weights[order]
        return points.reshape(*shift.shape, -1), weights.reshape(*shift.shape, -1)

    def parts(self, shift: np.ndarray, count: int) -> ShadowParts:
        """Return a quadrature over the shadows' parts of the overlap of each pupil with itself, region by region.

        Parameters
        ----------
        shift : (B, S) ndarray
            S complex shifts of each of B pupils.
        count : int
            Number of nodes along each side of a region's bounding box.
        """
        moves = np.stack([shift.real, shift.imag], axis=-1)
        full = area(self.pieces) > SMALLEST
        points, weights = self.whole(count)
        # c + sign s/2 lies in the shadow and c - sign s/2 in the pupil: the shadow within the pupil moved by sign s
        sign = np.array([1.0, -1.0])
        offset = sign[:, None] * moves[:, :, None]
        smallest, largest = _least(self.radius), _most(self.radius)
        x, y = (self.pieces[:, None, None, ..., k] - offset[..., None, None, k] for k in (0, 1))
        inside = np.max(x * x + y * y, axis=-1) < smallest[:, None, None, None] ** 2
        centre = np.mean(self.pieces, axis=2)
        size = np.sqrt(np.max(np.sum((self.pieces - centre[:, :, None]) ** 2, axis=-1), axis=-1))
        near = centre[:, None, None] - offset[..., None, :]
        near = np.hypot(near[..., 0], near[..., 1]) - size[:, None, None] < largest[:, None, None, None]
        full_at = np.nonzero(inside & full[:, None, None])
        b, s, g, k = np.nonzero(~inside & near & full[:, None, None])
        corners = self._corners
        polygon_points, polygon_weights = np.empty((len(b), count**2), complex), np.empty((len(b), count**2))
        for group, (corner_limit,) in _similar(corners[b, k]):
            moved = self.pieces[b[group], k[group], :corner_limit] - offset[b[group], s[group], g[group]][:, None]
            polygon_points[group], polygon_weights[group] = quadrature_within(moved, self.radius[b[group]], count)
        polygon_points += (sign[g] * shift[b, s])[:, None]
        pair = self._pairs(moves, full)
        shared_points, shared_weights = np.empty((len(pair[0]), count**2), complex), np.empty((len(pair[0]), count**2))
        for group, (corner_limit, others) in _similar(corners[pair[0], pair[2]], corners[pair[0], pair[3]]):
            pupil, step, first, second = (index[group] for index in pair)
            windows = self.pieces[:, :, :others]
            normal, limit = sides(windows.reshape(-1, *windows.shape[2:]))
            normal, limit = (a.reshape(*windows.shape[:2], *a.shape[1:])[pupil, second] for a in (normal, limit))
            limit = limit + np.einsum("fwx,fx->fw", normal, moves[pupil, step])
            shared = intersect(self.pieces[pupil, first, :corner_limit], normal, limit)
            shared_points[group], shared_weights[group] = quadrature(shared, count)
            if not np.all(np.abs(np.sum(shared_weights[group], axis=-1) - np.abs(area(shared))) < _AREA_TOLERANCE):
                raise UnphysicalError("the quadrature of the intersection of two shadows does not have its area")
        return ShadowParts(
            pupil=np.concatenate([full_at[0], b, pair[0]]),
            step=np.concatenate([full_at[1], s, pair[1]]),
            sign=np.concatenate([sign[full_at[2]], sign[g], np.ones(len(pair[0]))]),
            piece=full_at[3],
            whole=points,
            points=np.concatenate([points[full_at[0], full_at[3]], polygon_points, shared_points]),
            weights=np.concatenate([-weights[full_at[0], full_at[3]], -polygon_weights, shared_weights]),
        )

    @cached_property
    def _corners(self) -> np.ndarray:
        """Number of corners of each of K polygons in B pupils without those that repeat its last, (B, K)."""
        apart = np.any(self.pieces[:, :, 1:] != self.pieces[:, :, :-1], axis=-1)
        last = self.pieces.shape[2] - 1 - np.argmax(apart[..., ::-1], axis=-1)
        return np.asarray(np.where(np.any(apart, axis=-1), last + 1, 1))

    def _pairs(self, moves: np.ndarray, full: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the pairs of polygons of which the second, moved by a shift, may intersect the first.

        ``moves`` (B, S, 2) are S shifts of B pupils, and ``full`` is the mask of polygons that are not empty. The
        result is the indices of pupil, shift, and both polygons.
        """
        low, high = self.pieces.min(axis=2), self.pieces.max(axis=2)
        moved_low, moved_high = (end[:, None, None] + moves[:, :, None, None] for end in (low, high))
        apart = (high[:, None, :, None] <= moved_low) | (moved_high <= low[:, None, :, None])
        both = full[:, None, :, None] & full[:, None, None]
        return np.nonzero(~np.any(apart, axis=-1) & both)


_CORNER_LIMITS = (12, 20, 32, 52)
"""Numbers of corners up to which polygons are processed together: one with hundreds of them would slow all down."""


def _similar(*corners: np.ndarray) -> Iterator[tuple[np.ndarray | slice, tuple[int | None, ...]]]:
    """Yield groups (indices) of polygons with similar numbers of corners, and upper bounds of these numbers.

    ``corners`` are the numbers of corners for one or more sets of polygons; a group's k-th members in all sets are
    processed together, and there is a bound for each set. The bounds are None where all polygons form one group.
    """
    if max((int(np.max(count, initial=0)) for count in corners), default=0) <= _CORNER_LIMITS[0]:
        yield slice(None), (None,) * len(corners)
        return
    bounds = [np.searchsorted(_CORNER_LIMITS, count) for count in corners]
    code = np.ravel_multi_index(tuple(bounds), (len(_CORNER_LIMITS) + 1,) * len(corners))
    for value in np.unique(code):
        limits = np.unravel_index(value, (len(_CORNER_LIMITS) + 1,) * len(corners))
        yield (
            np.flatnonzero(code == value),
            tuple(_CORNER_LIMITS[k] if k < len(_CORNER_LIMITS) else None for k in limits),
        )


@dataclass(frozen=True, eq=False)
class ShadowParts:
    """Quadrature over F regions that shadows cut out of overlaps of B pupils with themselves, for S shifts each.

    A region is given by its position in a shadow: for light that passes a point q of the pupil there, and q - sign *
    shift in the other pupil.

    Attributes
    ----------
    pupil, step : (F,) ndarray of int
        Index of the pupil, and of its shift.
    sign : (F,) ndarray
        Sign of the shift of the pupil that the shadow belongs to.
    piece : (W,) ndarray of int
        Index of the polygon for the first W regions, which are whole polygons.
    whole : (B, K, Q) ndarray
        Q complex nodes in each of all K polygons.
    points : (F, Q) ndarray
        Complex nodes q of each region.
    weights : (F, Q) ndarray
        Area weights, with the signs of ``PupilShadow.overlap``.
    """

    pupil: np.ndarray
    step: np.ndarray
    sign: np.ndarray
    piece: np.ndarray
    whole: np.ndarray
    points: np.ndarray
    weights: np.ndarray


def separate(polygons: list[np.ndarray], fewest: bool = False) -> tuple[np.ndarray, list[int]]:
    """Return the union of polygons as convex polygons that do not overlap.

    Parameters
    ----------
    polygons : list of (B, V, 2) ndarray
        Convex polygons of V corners in B pupils, counterclockwise.
    fewest : bool
        True to take the largest polygons first and cut each other one along the sides that cut off most, which leaves
        few results of polygons with many sides.

    Returns
    -------
    pieces : (B, K, W, 2) ndarray
        K convex polygons of W corners.
    owners : list of int
        Index of the given polygon that each is a part of; a common part belongs to the first polygon.
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
    """Return what lies of ``part`` outside ``before``, as convex polygons.

    The result is ``part`` itself if the two do not intersect in any of the pupils.

    Parameters
    ----------
    part : (B, V, 2) ndarray
        One convex polygon of V corners in each of B pupils.
    before : (B, W, 2) ndarray
        One convex polygon of W corners in each pupil, counterclockwise; some may be empty.
    fewest : bool
        True to leave few polygons, by cutting along the sides that cut off most.
    """
    empty = area(before) < SMALLEST
    if np.all(empty | (area(intersect(part, *sides(before))) < SMALLEST)):
        return [part]
    whole = np.where(empty[:, None, None], part, part[:, :1])  # an empty polygon excludes nothing
    if fewest:
        normal, limit = sides(before)
        # the part does not extend beyond the other sides
        height = np.einsum("bvx,bwx->bwv", part[..., :2], normal)
        beyond = np.flatnonzero(np.any(height > limit[..., None], axis=(0, 2)))
        remaining_area = [float(np.mean(area(clip(part, -normal[:, w], -limit[:, w])))) for w in beyond]
        pieces = difference(part, before, beyond[np.argsort(remaining_area)[::-1]])
    else:
        pieces = difference(part, before)
    # a polygon empty to rounding still has sides, and would return the part a second time
    pieces = [np.where(empty[:, None, None], piece[:, :1], piece) for piece in pieces]
    return [piece for piece in (whole, *pieces) if np.any(area(piece) > SMALLEST)]


def tiled(pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide the polygons of shadows into parts no larger than MAX_PIECE along x and y.

    ``pieces`` (B, K, V, 2) are K polygons of V corners in each of B pupils.

    Returns
    -------
    pieces : (B, L, W, 2) ndarray
        L polygons of W corners.
    owners : (L,) ndarray of int
        Index, among the K given polygons, of the one that each is a part of.
    """
    owners = np.arange(pieces.shape[1])
    for axis in (0, 1):
        done, numbers = [], []
        for owner, piece in zip(owners, np.moveaxis(pieces, 1, 0), strict=True):
            low = piece[..., axis].min(axis=1)
            size = piece[..., axis].max(axis=1) - low
            parts = max(int(np.ceil(np.max(size, initial=0.0) / MAX_PIECE)), 1)
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
    """Return the K Fourier terms (B, K) of the radius of B edges, as a function of the angle about the origin.

    The radius is the real part of the sum of c_k exp(i k angle) with these terms c_k. ``harmonics`` (2H + 1, B) are the
    coefficients d_n, n = -H to H, of the edges' points sum d_n exp(i n a), with a the angle on the stop's rim.
    """
    last = len(harmonics) // 2
    order = np.abs(np.arange(-last, last + 1))
    used = int(np.max(order[np.max(np.abs(harmonics), axis=1) > _ANGLE_TOLERANCE]))
    used_harmonics = harmonics[last - used : last + used + 1]
    count = 8 * used + 4
    angle = np.broadcast_to(2.0 * np.pi * np.arange(count) / count, (harmonics.shape[1], count))
    edge, angles, back = PupilEdge(used_harmonics), angle, np.exp(-1j * angle[0])
    for _ in range(_MOST_ITERATIONS):
        point = edge.boundary(angles)[0]
        error = np.angle(point * back)
        if np.max(np.abs(error), initial=0.0) < _ANGLE_TOLERANCE:
            break
        angles = angles - error
    terms = np.fft.rfft(np.abs(point), axis=-1)[:, : 2 * used + 1] / count
    terms[:, 1:] *= 2.0
    significant = np.flatnonzero(np.max(np.abs(terms), axis=0) > _MIN_TERM)
    return np.asarray(terms[:, : significant[-1] + 1])


def _radius(terms: np.ndarray, phasor: np.ndarray) -> np.ndarray:
    """Return the radius of N edges in given directions, (N, ...), from its Fourier terms.

    ``terms`` (N, K) are K terms of each edge, and ``phasor`` (N, ...) is exp(i angle) of the directions.
    """
    over = (slice(None),) + (None,) * (phasor.ndim - 1)
    total = np.zeros_like(phasor)
    for k in range(terms.shape[1] - 1, 0, -1):
        total = (total + terms[:, k][over]) * phasor
    return np.asarray(total.real + terms[:, 0].real[over])


def within_edge(polygons: np.ndarray, radius: np.ndarray, rim_sides: int) -> np.ndarray:
    """Return the part of each polygon inside an edge, counterclockwise.

    A polygon of the same area represents the edge.

    Parameters
    ----------
    polygons : (B, K, V, 2) ndarray
        K polygons of V corners in each of B pupils, in normalised pupil coordinates.
    radius : (B, H) ndarray
        Radii of the edges as H complex Fourier terms over the angle.
    rim_sides : int
        Number of sides of the polygon that represents an edge.
    """
    number = polygons.shape[1]
    flat = polygons.reshape(-1, *polygons.shape[2:])
    flat = np.where((area(flat) < 0.0)[:, None, None], flat[:, ::-1], flat)
    extent = np.max(np.hypot(flat[..., 0], flat[..., 1]), axis=-1, initial=0.0)
    beyond = np.flatnonzero((extent > np.repeat(_least(radius), number)) & (area(flat) > SMALLEST))
    if len(beyond):
        step = 2.0 * np.pi / rim_sides
        phasor = np.broadcast_to(np.exp(1j * step * np.arange(rim_sides)), (len(radius), rim_sides))
        rim = phasor * _radius(radius, phasor) * np.sqrt(step / np.sin(step))
        # a polygon has few sides inside the rim
        inner = compact(intersect(np.stack([rim.real, rim.imag], axis=-1)[beyond // number], *sides(flat[beyond])))
        flat = padded(flat, inner.shape[1]).copy()
        flat[beyond] = padded(inner, flat.shape[1])
    flat = compact(flat)
    return flat.reshape(*polygons.shape[:2], *flat.shape[1:])


def _least(radius: np.ndarray) -> np.ndarray:
    """Return a lower bound of the radius of each of N edges, (N,), from its Fourier terms."""
    return np.asarray(np.abs(radius[:, 0]) - np.sum(np.abs(radius[:, 1:]), axis=-1))


def _most(radius: np.ndarray) -> np.ndarray:
    """Return an upper bound of the radius of each of N edges, (N,), from its Fourier terms."""
    return np.asarray(np.sum(np.abs(radius), axis=-1))


def quadrature_within(polygons: np.ndarray, radius: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a quadrature over the intersection of polygons with the inside of edges.

    Every part of a polygon's boundary that lies outside the edge is moved inward along the radius onto it. That changes
    no winding number of a point inside the edge, so that the new boundary goes once around the intersection and around
    nothing else. Each side becomes an arc, a straight line and an arc; most of them have no length.

    Parameters
    ----------
    polygons : (F, V, 2) ndarray
        F polygons of V corners, in normalised pupil coordinates.
    radius : (F, H) ndarray
        Radius of the edge of each as H complex Fourier terms over the angle.
    count : int
        Number of nodes along each of the two directions.
    """
    start = polygons[..., 0] + 1j * polygons[..., 1]
    after = np.roll(start, -1, axis=1)
    side = after - start
    length = np.abs(side)
    unit = side / np.where(length > 0.0, length, 1.0)
    nearest = -(start * np.conj(unit)).real  # nearest point of the whole line, as a distance from the start
    within = np.abs(start) < _least(radius)[:, None]
    within &= np.roll(within, -1, axis=1)
    beyond = np.abs(start + np.clip(nearest, 0.0, length) * unit) > _most(radius)[:, None]
    ends = np.zeros(length.shape), np.where(within, length, 0.0)
    crossed = np.nonzero(~within & ~beyond)
    terms, direction, nearest = radius[crossed[0]], unit[crossed], nearest[crossed]
    foot = start[crossed] + nearest * direction
    foot_square = np.abs(foot) ** 2
    for sign, end in zip((-1.0, 1.0), ends, strict=True):
        size = terms[:, 0].real
        for _ in range(_ITERATIONS):
            half = np.sqrt(np.maximum(size**2 - foot_square, 0.0))
            size = _radius(terms, _direction(foot + sign * half * direction))
        position = nearest + sign * np.sqrt(np.maximum(size**2 - foot_square, 0.0))
        end[crossed] = np.clip(position, 0.0, length[crossed])
    enter, leave = (start + end * unit for end in ends)
    node, weight = gauss(count + 1)
    share = 0.5 * (node + 1.0)
    (first, last), straight = _selected(np.stack([enter, leave]), ends[1] - ends[0] > _ANGLE_TOLERANCE)
    position = first[..., None] + (last - first)[..., None] * share
    rise = 0.5 * weight * (last - first).imag[..., None]
    outside = np.concatenate([ends[0] > _ANGLE_TOLERANCE, length - ends[1] > _ANGLE_TOLERANCE], axis=1)
    pairs = np.stack([np.concatenate([start, leave], axis=1), np.concatenate([enter, after], axis=1)])
    (begin, end), bent = _selected(pairs, outside)
    angle = np.angle(end * np.conj(begin))
    phasor = _direction(begin)[..., None] * np.exp(1j * angle[..., None] * share)
    size, slope = _radius_and_slope(radius, phasor)
    arc = phasor * size
    arc_rise = 0.5 * weight * angle[..., None] * (phasor * (slope + 1j * size)).imag
    # the region's box, from both ends of straight pieces and the nodes on arcs
    corners = np.concatenate([first, last, arc.reshape(len(arc), arc.shape[1] * arc.shape[2])], axis=1)
    counted = np.concatenate([straight, straight, np.repeat(bent, len(share), axis=1)], axis=1)
    low, high = (
        np.stack([f(c, axis=1, where=counted, initial=limit) for c in (corners.real, corners.imag)], axis=-1)
        for f, limit in ((np.min, np.inf), (np.max, -np.inf))
    )
    none = ~np.any(counted, axis=1)
    low[none], high[none] = 0.0, 0.0
    # Padding must not lie on the pupil's edge: in units of a narrow box that is millions away, where the polynomials
    # amplify a rounding error of 1e-17 in its angle to any number.
    middle = 0.5 * (low + high) @ np.array([1.0, 1j])
    used = np.concatenate([np.repeat(kept, len(share), axis=1) for kept in (straight, bent)], axis=1)
    all_nodes, all_weights = (
        np.concatenate([part.reshape(len(part), part.shape[1] * part.shape[2]) for part in both], axis=1)
        for both in ((position, arc), (rise, arc_rise))
    )
    all_nodes, all_weights = np.where(used, all_nodes, middle[:, None]), np.where(used, all_weights, 0.0)
    points, weights = from_boundary(np.stack([all_nodes.real, all_nodes.imag], axis=-1), all_weights, low, high, count)
    total = np.sum(weights, axis=-1)
    if not np.all((total > -_AREA_TOLERANCE) & (total < np.abs(area(polygons)) + _AREA_TOLERANCE)):
        raise UnphysicalError("the quadrature of the part of a shadow inside the pupil is larger than the shadow")
    return points, weights


def _selected(pairs: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the selected pairs of points of N boundaries, packed, and the mask (N, W) of valid ones.

    ``pairs`` (2, N, V) are V pairs per boundary, and ``mask`` (N, V) selects up to W of them, which are returned as (2,
    N, W). In the padding both points of a pair coincide.
    """
    counts = np.sum(mask, axis=1)
    width = max(int(np.max(counts, initial=0)), 1)
    order = np.argsort(~mask, axis=1, kind="stable")[:, :width]
    first, last = (np.take_along_axis(points, order, axis=1) for points in pairs)
    valid = np.arange(width) < counts[:, None]
    return np.stack([first, np.where(valid, last, first)]), valid


def _direction(point: np.ndarray) -> np.ndarray:
    """Return the complex number of modulus 1 in the direction of a complex point; 1 at the origin."""
    size = np.abs(point)
    return np.asarray(np.where(size > 0.0, point, 1.0) / np.where(size > 0.0, size, 1.0))


def _radius_and_slope(terms: np.ndarray, phasor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the radius of edges in given directions, and its derivative with respect to the angle, per radian.

    ``terms`` and ``phasor`` are the radius's Fourier terms and exp(i angle) of the directions.
    """
    over = (slice(None),) + (None,) * (phasor.ndim - 1)
    total, slope = np.zeros_like(phasor), np.zeros_like(phasor)
    for k in range(terms.shape[1] - 1, 0, -1):
        slope = slope * phasor + (1j * k) * terms[:, k][over]
        total = (total + terms[:, k][over]) * phasor
    return total.real + terms[:, 0].real[over], (slope * phasor).real


def in_rows(owner: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return how to arrange F items in a table with one row per owner: order of the items, their columns, longest row.

    ``owner`` (F,) is the row to which each item belongs, one of ``rows``.
    """
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=rows)
    column = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return order, column, int(np.max(counts, initial=0))
