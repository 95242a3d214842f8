"""Convex polygons in batches: hulls, cuts, differences, and quadrature over them.

A batch holds N polygons of V corners, (N, V, D): the first two of D numbers are the place in the plane, others ride
along (the corner in space, say). A polygon of fewer corners repeats one; a polygon without area is empty.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import numpy as np

from optics.numerics.quadrature import gauss

_NO_LIMIT = 1e30
"""Limit that a side without length gets: finite, so that it can be multiplied."""

_AT_ONCE = 2**13
"""Nodes on boundaries worked on together: their polynomials stay in the cache."""

_SAME = 1e-13
"""Distance below which two corners are one."""


def area(polygons: np.ndarray) -> np.ndarray:
    """Areas, positive counterclockwise, (...), of polygons (..., V, D)."""
    x, y = polygons[..., 0] - polygons[..., :1, 0], polygons[..., 1] - polygons[..., :1, 1]
    return np.asarray(0.5 * np.sum(x[..., :-1] * y[..., 1:] - x[..., 1:] * y[..., :-1], axis=-1))


def area_in_disk(polygons: np.ndarray) -> np.ndarray:
    """Areas within the unit disk, positive counterclockwise, (...), of polygons (..., V, D).

    It is the sum over the sides of what lies between each and the middle: a triangle where the side runs within the
    disk, a sector where it runs outside.
    """
    start = polygons[..., 0] + 1j * polygons[..., 1]
    end = np.roll(start, -1, axis=-1)
    way = end - start
    size = np.abs(way)
    unit = way / np.where(size > _SAME, size, 1.0)
    along = (np.conj(unit) * start).real  # of the start, from the foot of the middle's perpendicular on the side
    half = np.sqrt(np.maximum(1.0 - np.abs(start - along * unit) ** 2, 0.0))
    first, second = (start + (np.clip(place, along, along + size) - along) * unit for place in (-half, half))
    sectors = np.angle(np.conj(start) * first) + np.angle(np.conj(second) * end)
    return np.asarray(0.5 * np.sum((np.conj(first) * second).imag + sectors, axis=-1))


def covered(polygons: np.ndarray, points: np.ndarray, smallest: float = 0.0) -> np.ndarray:
    """Which points (N, 2) lie in any of the convex counterclockwise polygons (B, K, V, 2), (B, N).

    Parameters
    ----------
    polygons : np.ndarray
        Some may be empty, all their corners alike.
    points : np.ndarray
        The same for all B.
    smallest : float
        Area up to which a polygon is nothing.
    """
    out = np.zeros((len(polygons), len(points)), bool)
    full = area(polygons) > smallest
    for k in range(polygons.shape[1]):
        corner = polygons[:, k]
        way = np.roll(corner, -1, axis=1) - corner
        way[np.hypot(way[..., 0], way[..., 1]) <= _SAME] = 0.0  # the direction of such a side is rounding
        within = np.repeat(full[:, k, None], len(points), axis=1)
        for v in range(corner.shape[1]):
            x, y = (points[:, i] - corner[:, v, i, None] for i in (0, 1))
            within &= way[:, v, 0, None] * y - way[:, v, 1, None] * x >= 0.0
        out |= within
    return out


def hull(points: np.ndarray) -> np.ndarray:
    """Convex hulls of N sets of P points, (N, P, D), counterclockwise, (N, V, D)."""
    x, y = points[..., 0], points[..., 1]
    rows = np.arange(len(points))
    start = np.lexsort((y, x), axis=-1)[:, 0]
    order, here, done = [start], start, np.zeros(len(points), bool)
    way = np.broadcast_to([0.0, -1.0], (len(points), 2))
    for _ in range(points.shape[1] - 1):
        dx, dy = x - x[rows, here][:, None], y - y[rows, here][:, None]
        turn = np.arctan2(way[:, :1] * dy - way[:, 1:] * dx, way[:, :1] * dx + way[:, 1:] * dy)
        turn[turn < -0.5 * np.pi] = np.pi  # points of the side before, but for rounding
        turn[(dx == 0.0) & (dy == 0.0)] = np.inf
        best = np.argmin(turn, axis=-1)
        done |= (best == start) | np.isinf(turn[rows, best])
        here = np.where(done, here, best)
        if np.all(done):
            break
        way = np.stack([dx[rows, best], dy[rows, best]], axis=-1)
        order.append(here)
    return np.asarray(points[rows[:, None], np.stack(order, axis=-1)])


def clip(polygons: np.ndarray, normal: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The part of each polygon where normal . (x, y) <= limit (Sutherland and Hodgman, Commun. ACM 17, 32 (1974)).

    Parameters
    ----------
    polygons : np.ndarray
        (N, V, D).
    normal : np.ndarray
        (N, 2).
    limit : np.ndarray
        (N,).

    Returns
    -------
    np.ndarray
        (N, W, D), corners in the order they had.
    """
    depth = limit[:, None] - polygons[..., 0] * normal[:, :1] - polygons[..., 1] * normal[:, 1:]
    inside = depth >= 0.0
    if np.all(inside):
        return polygons
    after, depth_after, inside_after = (np.roll(a, -1, axis=1) for a in (polygons, depth, inside))
    crossing = inside != inside_after
    share = depth / np.where(crossing, depth - depth_after, 1.0)
    count, corners, numbers = polygons.shape
    both = np.empty((count, 2 * corners, numbers))
    both[:, 0::2], both[:, 1::2] = polygons, polygons + share[..., None] * (after - polygons)
    kept = np.empty((count, 2 * corners), bool)
    kept[:, 0::2], kept[:, 1::2] = inside, crossing
    return _packed(both, kept)


def widened(polygons: np.ndarray, corners: int) -> np.ndarray:
    """Polygons (N, V, D) with corners repeated so that each has at least ``corners``."""
    missing = corners - polygons.shape[1]
    if missing <= 0:
        return polygons
    return np.concatenate([polygons, np.repeat(polygons[:, -1:], missing, axis=1)], axis=1)


def compact(polygons: np.ndarray) -> np.ndarray:
    """Polygons (N, V, D) without corners that repeat the one before them but for rounding."""
    step = polygons[..., :2] - np.roll(polygons[..., :2], 1, axis=1)
    kept = np.hypot(step[..., 0], step[..., 1]) > _SAME
    return _packed(polygons, kept)


def _packed(corners: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Those of the corners (N, V, D) that are kept, (N, V), in polygons of as few corners as all allow; of a polygon
    that keeps none the first corner stays.
    """
    many = np.maximum(np.sum(kept, axis=1), 1)
    order = np.argsort(~kept, axis=1, kind="stable")
    which = np.take_along_axis(order, np.minimum(np.arange(np.max(many, initial=1)), many[:, None] - 1), axis=1)
    return np.take_along_axis(corners, which[..., None], axis=1)


def sides(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward unit normals (N, W, 2) and limits (N, W) of counterclockwise polygons. A side without length, the
    direction of which is rounding, has none.
    """
    step = np.roll(windows[..., :2], -1, axis=1) - windows[..., :2]
    length = np.hypot(step[..., 0], step[..., 1])
    normal = np.stack([step[..., 1], -step[..., 0]], axis=-1) / np.where(length > _SAME, length, 1.0)[..., None]
    limit = np.where(length > _SAME, np.sum(normal * windows[..., :2], axis=-1), _NO_LIMIT)
    return normal, limit


def intersect(polygons: np.ndarray, normal: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Cut each polygon by W half-planes.

    Parameters
    ----------
    polygons : np.ndarray
        (N, V, D).
    normal : np.ndarray
        (N, W, 2).
    limit : np.ndarray
        (N, W).

    Returns
    -------
    np.ndarray
        (N, U, D).
    """
    height = np.einsum("nvx,nwx->nwv", polygons[..., :2], normal)
    beyond = np.sum(height > limit[..., None], axis=-1)
    # of each polygon first what leaves it the fewest corners
    order = np.argsort(-beyond, axis=1, kind="stable")[:, : np.max(np.count_nonzero(beyond, axis=1), initial=0)]
    for column in order.T:
        some = np.flatnonzero(np.take_along_axis(beyond, column[:, None], axis=1)[:, 0])
        cut = clip(polygons[some], normal[some, column[some]], limit[some, column[some]])
        if len(some) == len(polygons):
            polygons = cut
        else:
            polygons = widened(polygons, cut.shape[1]).copy()
            polygons[some] = widened(cut, polygons.shape[1])
    return polygons


def difference(polygons: np.ndarray, holes: np.ndarray, order: Iterable[int] | None = None) -> list[np.ndarray]:
    """What is left of each convex polygon (N, V, D) outside of a counterclockwise convex one (N, W, D): some convex
    pieces, (N, ., D) each, many of them empty.

    Parameters
    ----------
    polygons : np.ndarray
        convex.
    holes : np.ndarray
        Counterclockwise, convex.
    order : Iterable[int] | None
        In which the holes' sides are cut along, one piece for each; from the first to the last if not given.
    """
    normal, limit = sides(holes)
    out = []
    for w in range(limit.shape[1]) if order is None else order:
        out.append(clip(polygons, -normal[:, w], -limit[:, w]))
        polygons = clip(polygons, normal[:, w], limit[:, w])
    return out


def quadrature(polygons: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that integrate polynomials of degree below ``count`` in x and in y exactly over each polygon.

    They are Gauss' in the polygon's bounding box; the weights are the integrals of Lagrange's polynomials, by Green's
    theorem along the sides.

    Parameters
    ----------
    polygons : np.ndarray
        (N, V, D), of either sense.
    count : int
        Nodes along each side of the box.

    Returns
    -------
    tuple[np.ndarray, np.ndarray]
        Points x + iy and weights of the area, (N, count^2) each.
    """
    place = polygons[..., :2]
    step = np.roll(place, -1, axis=1) - place
    points, weights = gauss(count)
    on = place[:, :, None] + step[:, :, None] * (0.5 * (points + 1.0))[:, None]
    rise = 0.5 * weights * step[..., 1:]
    corners = polygons.shape[1] * count
    on, rise = on.reshape(len(on), corners, 2), rise.reshape(len(rise), corners)
    return from_boundary(on, rise, place.min(axis=1), place.max(axis=1), count)


def from_boundary(
    place: np.ndarray, rise: np.ndarray, low: np.ndarray, high: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """``quadrature`` over regions whose boundary is given by nodes of integrals along it.

    Parameters
    ----------
    place : np.ndarray
        Nodes on the boundary, (N, P, 2).
    rise : np.ndarray
        Their weights in integrals over dy, (N, P).
    low : np.ndarray
        Corners of boxes about the regions, (N, 2).
    high : np.ndarray
        The opposite ones.
    count : int
        Nodes along each side of the box.
    """
    rows = len(place)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = np.where(half > 0.0, half, 1.0)
    # Nodes lie in the box but for rounding. Of a sliver, whose box has no height to speak of, this rounding is many
    # times the box, and polynomials make any weight of it.
    at = np.clip((place - middle[:, None]) / half[:, None], -1.0, 1.0)
    rise = rise / half[:, 1:]
    step = max(1, _AT_ONCE // max(place.shape[1], 1))
    some = [slice(k, k + step) for k in range(0, rows, step)]
    moments = np.concatenate([np.zeros((0, count, count)), *(_moments(at[s], rise[s], count) for s in some)])
    moments *= (np.sign(moments[:, 0, 0]) * half[:, 0] * half[:, 1])[:, None, None]
    own, to_weights = gauss(count)[0], _lagrange(count)
    weights = to_weights @ moments @ to_weights.T
    points = (middle[:, :1] + half[:, :1] * own)[:, :, None] + 1j * (middle[:, 1:] + half[:, 1:] * own)[:, None]
    return points.reshape(rows, count**2), weights.reshape(rows, count**2)


def _moments(at: np.ndarray, rise: np.ndarray, count: int) -> np.ndarray:
    """Integrals of Legendre's P_i(x) P_j(y) over N regions with nodes (N, P, 2) on their boundaries, (N, count, count).

    Parameters
    ----------
    at : np.ndarray
        The nodes.
    rise : np.ndarray
        Their weights in integrals over dy, (N, P).
    count : int
        Of polynomials.
    """
    x, y = _legendre(at[..., 0], count + 1), _legendre(at[..., 1], count)
    primitive = np.empty((count, *rise.shape))  # of P_0, P_1, ... along x
    primitive[0] = x[1]
    np.subtract(x[2:], x[:-2], out=primitive[1:])
    primitive[1:] /= (2 * np.arange(1, count) + 1)[:, None, None]
    primitive *= rise
    return np.asarray(primitive.transpose(1, 0, 2) @ y.transpose(1, 2, 0))


@cache
def _lagrange(count: int) -> np.ndarray:
    """From integrals of Legendre's polynomials to weights of Gauss' points, (count, count)."""
    points, weights = gauss(count)
    out = np.asarray(weights[:, None] * _legendre(points, count).T * (np.arange(count) + 0.5))
    out.setflags(write=False)
    return out


def _legendre(x: np.ndarray, count: int) -> np.ndarray:
    """P_0 .. P_(count - 1) at x, (count, ...)."""
    out = np.empty((count, *x.shape))
    out[0] = 1.0
    if count > 1:
        out[1] = x
    before = np.empty_like(x)
    for n in range(2, count):
        np.multiply(x, out[n - 1], out=out[n])
        out[n] *= (2 * n - 1) / n
        out[n] -= np.multiply(out[n - 2], (n - 1) / n, out=before)
    return out
