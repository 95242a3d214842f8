"""Batched operations on convex polygons: hulls, clipping, differences, and quadrature over them.

A batch holds N polygons of V corners, an array (N, V, D). The first two of the D columns are the coordinates x, y in
the plane; the others are interpolated along with them (such as the corner's position in space). A polygon of fewer
corners repeats one; a polygon without area is empty.
"""

from collections.abc import Iterable
from functools import cache

import numpy as np

from optics.numerics.quadrature import gauss

_NO_LIMIT = 1e30
"""Limit that replaces that of a side of zero length, which has no direction; finite, so that it can be multiplied."""

_BLOCK_NODES = 2**13
"""Number of boundary nodes processed in one block: their polynomials stay in the processor's cache."""

_COINCIDENT = 1e-13
"""Distance below which two corners of a polygon count as one, in the unit of their coordinates."""


def area(polygons: np.ndarray) -> np.ndarray:
    """Return the signed areas (...) of polygons, positive counterclockwise.

    ``polygons`` (..., V, D) holds V corners each, whose first two of D columns are x and y.
    """
    x, y = polygons[..., 0] - polygons[..., :1, 0], polygons[..., 1] - polygons[..., :1, 1]
    return np.asarray(0.5 * np.sum(x[..., :-1] * y[..., 1:] - x[..., 1:] * y[..., :-1], axis=-1))


def area_in_disk(polygons: np.ndarray) -> np.ndarray:
    """Return the signed areas (...) of the parts of polygons inside the unit disk, positive counterclockwise.

    ``polygons`` (..., V, D) holds V corners each, whose first two of D columns are x and y. The area is the sum, over
    the sides, of the area between the side and the centre: a triangle where the side runs inside the disk, a sector
    where it runs outside.
    """
    start = polygons[..., 0] + 1j * polygons[..., 1]
    end = np.roll(start, -1, axis=-1)
    side = end - start
    length = np.abs(side)
    unit = side / np.where(length > _COINCIDENT, length, 1.0)
    along = (np.conj(unit) * start).real  # from the foot of the centre's perpendicular on the side
    half = np.sqrt(np.maximum(1.0 - np.abs(start - along * unit) ** 2, 0.0))
    first, second = (start + (np.clip(position, along, along + length) - along) * unit for position in (-half, half))
    sectors = np.angle(np.conj(start) * first) + np.angle(np.conj(second) * end)
    return np.asarray(0.5 * np.sum((np.conj(first) * second).imag + sectors, axis=-1))


def covered(polygons: np.ndarray, points: np.ndarray, smallest: float = 0.0) -> np.ndarray:
    """Return the mask (B, N) of points that lie in any of the convex counterclockwise polygons of each batch.

    Parameters
    ----------
    polygons : (B, K, V, 2) ndarray
        K polygons of V corners in each of B batches; those whose corners all coincide are empty.
    points : (N, 2) ndarray
        N points, common to all batches.
    smallest : float
        Area up to which a polygon counts as empty.
    """
    out = np.zeros((len(polygons), len(points)), bool)
    full = area(polygons) > smallest
    for k in range(polygons.shape[1]):
        corner = polygons[:, k]
        side = np.roll(corner, -1, axis=1) - corner
        side[np.hypot(side[..., 0], side[..., 1]) <= _COINCIDENT] = 0.0  # its direction would be rounding error
        within = np.repeat(full[:, k, None], len(points), axis=1)
        for v in range(corner.shape[1]):
            x, y = (points[:, i] - corner[:, v, i, None] for i in (0, 1))
            within &= side[:, v, 0, None] * y - side[:, v, 1, None] * x >= 0.0
        out |= within
    return out


def hull(points: np.ndarray) -> np.ndarray:
    """Return the convex hulls of N sets of P points, counterclockwise, as polygons (N, V, D) of V corners.

    The first two of the D columns of ``points`` (N, P, D) are x and y, which decide the hull; the other columns belong
    to the points and stay with them.
    """
    x, y = points[..., 0], points[..., 1]
    rows = np.arange(len(points))
    start = np.lexsort((y, x), axis=-1)[:, 0]
    order, current, done = [start], start, np.zeros(len(points), bool)
    direction = np.broadcast_to([0.0, -1.0], (len(points), 2))
    for _ in range(points.shape[1] - 1):
        dx, dy = x - x[rows, current][:, None], y - y[rows, current][:, None]
        angle = np.arctan2(direction[:, :1] * dy - direction[:, 1:] * dx, direction[:, :1] * dx + direction[:, 1:] * dy)
        angle[angle < -0.5 * np.pi] = np.pi  # points on the previous side, to rounding
        angle[(dx == 0.0) & (dy == 0.0)] = np.inf
        best = np.argmin(angle, axis=-1)
        done |= (best == start) | np.isinf(angle[rows, best])
        current = np.where(done, current, best)
        if np.all(done):
            break
        direction = np.stack([dx[rows, best], dy[rows, best]], axis=-1)
        order.append(current)
    return np.asarray(points[rows[:, None], np.stack(order, axis=-1)])


def clip(polygons: np.ndarray, normal: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return the part of each polygon where the scalar product of ``normal`` and (x, y) is at most ``limit``.

    The algorithm is that of Sutherland and Hodgman, Commun. ACM 17, 32 (1974).

    Parameters
    ----------
    polygons : (N, V, D) ndarray
        N convex polygons of V corners, with x and y in the first two of D columns.
    normal : (N, 2) ndarray
        One normal for each polygon.
    limit : (N,) ndarray
        One limit for each polygon: for a unit normal, the distance of the clipping line from the origin along it.

    Returns
    -------
    (N, W, D) ndarray
        Clipped polygons of W corners, in the original order.
    """
    depth = limit[:, None] - polygons[..., 0] * normal[:, :1] - polygons[..., 1] * normal[:, 1:]
    inside = depth >= 0.0
    if np.all(inside):
        return polygons
    after, depth_after, inside_after = (np.roll(a, -1, axis=1) for a in (polygons, depth, inside))
    crossing = inside != inside_after
    share = depth / np.where(crossing, depth - depth_after, 1.0)
    count, corners, numbers = polygons.shape
    candidates = np.empty((count, 2 * corners, numbers))
    candidates[:, 0::2], candidates[:, 1::2] = polygons, polygons + share[..., None] * (after - polygons)
    selected = np.empty((count, 2 * corners), bool)
    selected[:, 0::2], selected[:, 1::2] = inside, crossing
    return _packed(candidates, selected)


def padded(polygons: np.ndarray, corners: int) -> np.ndarray:
    """Return polygons with corners repeated until each has at least ``corners``.

    ``polygons`` (N, V, D) are N polygons of V corners with D columns, of which x and y come first.
    """
    missing = corners - polygons.shape[1]
    if missing <= 0:
        return polygons
    return np.concatenate([polygons, np.repeat(polygons[:, -1:], missing, axis=1)], axis=1)


def compact(polygons: np.ndarray) -> np.ndarray:
    """Return polygons without the corners that coincide, to rounding, with the corner before them.

    ``polygons`` (N, V, D) are N polygons of V corners with D columns, of which x and y come first.
    """
    step = polygons[..., :2] - np.roll(polygons[..., :2], 1, axis=1)
    selected = np.hypot(step[..., 0], step[..., 1]) > _COINCIDENT
    return _packed(polygons, selected)


def _packed(corners: np.ndarray, selected: np.ndarray) -> np.ndarray:
    """Return the corners selected by a mask, in polygons of as few corners as possible.

    ``corners`` (N, V, D) are N polygons of V corners with D columns, and ``selected`` (N, V) is the mask. A polygon
    without a selected corner keeps its first corner.
    """
    many = np.maximum(np.sum(selected, axis=1), 1)
    order = np.argsort(~selected, axis=1, kind="stable")
    index = np.take_along_axis(order, np.minimum(np.arange(np.max(many, initial=1)), many[:, None] - 1), axis=1)
    return np.take_along_axis(corners, index[..., None], axis=1)


def sides(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outward unit normals (N, W, 2) and limits (N, W) of the W sides of N counterclockwise polygons.

    A point lies on the inner side of a side where its scalar product with the normal is at most the limit. A side
    without length, whose direction would be rounding error, gets a limit that no point exceeds.
    """
    step = np.roll(windows[..., :2], -1, axis=1) - windows[..., :2]
    length = np.hypot(step[..., 0], step[..., 1])
    normal = np.stack([step[..., 1], -step[..., 0]], axis=-1) / np.where(length > _COINCIDENT, length, 1.0)[..., None]
    limit = np.where(length > _COINCIDENT, np.sum(normal * windows[..., :2], axis=-1), _NO_LIMIT)
    return normal, limit


def intersect(polygons: np.ndarray, normal: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return the part of each polygon that lies in all of W half-planes.

    Parameters
    ----------
    polygons : (N, V, D) ndarray
        N convex polygons of V corners, with x and y in the first two of D columns.
    normal : (N, W, 2) ndarray
        Outward normals of the half-planes.
    limit : (N, W) ndarray
        Largest scalar products of a normal and (x, y) inside.

    Returns
    -------
    (N, U, D) ndarray
        The clipped polygons, of U corners.
    """
    height = np.einsum("nvx,nwx->nwv", polygons[..., :2], normal)
    beyond = np.sum(height > limit[..., None], axis=-1)
    # for each polygon, first the half-plane that leaves it the fewest corners
    order = np.argsort(-beyond, axis=1, kind="stable")[:, : np.max(np.count_nonzero(beyond, axis=1), initial=0)]
    for column in order.T:
        rows = np.flatnonzero(np.take_along_axis(beyond, column[:, None], axis=1)[:, 0])
        clipped = clip(polygons[rows], normal[rows, column[rows]], limit[rows, column[rows]])
        if len(rows) == len(polygons):
            polygons = clipped
        else:
            polygons = padded(polygons, clipped.shape[1]).copy()
            polygons[rows] = padded(clipped, polygons.shape[1])
    return polygons


def difference(polygons: np.ndarray, holes: np.ndarray, order: Iterable[int] | None = None) -> list[np.ndarray]:
    """Return the parts of convex polygons that lie outside convex holes, as convex polygons.

    Parameters
    ----------
    polygons : (N, V, D) ndarray
        N convex polygons of V corners, with x and y in the first two of D columns.
    holes : (N, W, D) ndarray
        One hole of W corners for each polygon, counterclockwise and convex.
    order : iterable of int, optional
        Order in which the sides of the holes are used for clipping, one result for each; first to last by default.

    Returns
    -------
    list of (N, U, D) ndarray
        For each order, convex polygons of U corners, many of them empty, that together cover the polygon without its
        hole.
    """
    normal, limit = sides(holes)
    out = []
    for w in range(limit.shape[1]) if order is None else order:
        out.append(clip(polygons, -normal[:, w], -limit[:, w]))
        polygons = clip(polygons, normal[:, w], limit[:, w])
    return out


def quadrature(polygons: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes that integrate polynomials of degree below ``count`` in x and in y exactly over each polygon.

    The nodes are Gauss points of the polygon's bounding box; the weights are the integrals of the Lagrange polynomials,
    by Green's theorem along the sides.

    Parameters
    ----------
    polygons : (N, V, D) ndarray
        N polygons of V corners, of either orientation, with x and y in the first two of D columns.
    count : int
        Number of nodes along each side of the box.

    Returns
    -------
    points : (N, count^2) ndarray
        Nodes as complex numbers x + iy.
    weights : (N, count^2) ndarray
        Area weights.
    """
    xy = polygons[..., :2]
    step = np.roll(xy, -1, axis=1) - xy
    points, weights = gauss(count)
    nodes = xy[:, :, None] + step[:, :, None] * (0.5 * (points + 1.0))[:, None]
    rise = 0.5 * weights * step[..., 1:]
    corners = polygons.shape[1] * count
    nodes, rise = nodes.reshape(len(nodes), corners, 2), rise.reshape(len(rise), corners)
    return from_boundary(nodes, rise, xy.min(axis=1), xy.max(axis=1), count)


def from_boundary(
    nodes: np.ndarray, rise: np.ndarray, low: np.ndarray, high: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and area weights for integrals over regions that are given by nodes on their boundaries.

    They integrate polynomials of degree below ``count`` in x and in y exactly, if the boundary nodes do.

    Parameters
    ----------
    nodes : (N, P, 2) ndarray
        P quadrature nodes (x, y) on the boundary of each of N regions.
    rise : (N, P) ndarray
        Quadrature weights of these nodes for line integrals over dy along the boundary.
    low, high : (N, 2) ndarray
        Opposite corners of boxes about the regions.
    count : int
        Number of nodes along each side of the box.

    Returns
    -------
    points : (N, count^2) ndarray
        Nodes in the box as complex numbers x + iy.
    weights : (N, count^2) ndarray
        Area weights.
    """
    rows = len(nodes)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = np.where(half > 0.0, half, 1.0)
    # Nodes lie in the box to rounding. A sliver's box has almost no height, so that this rounding is many times the
    # box, and the polynomials would amplify it to arbitrary weights.
    local = np.clip((nodes - middle[:, None]) / half[:, None], -1.0, 1.0)
    rise = rise / half[:, 1:]
    step = max(1, _BLOCK_NODES // max(nodes.shape[1], 1))
    blocks = [slice(k, k + step) for k in range(0, rows, step)]
    moments = np.concatenate([np.zeros((0, count, count)), *(_moments(local[s], rise[s], count) for s in blocks)])
    moments *= (np.sign(moments[:, 0, 0]) * half[:, 0] * half[:, 1])[:, None, None]
    unit, to_weights = gauss(count)[0], _lagrange(count)
    weights = to_weights @ moments @ to_weights.T
    points = (middle[:, :1] + half[:, :1] * unit)[:, :, None] + 1j * (middle[:, 1:] + half[:, 1:] * unit)[:, None]
    return points.reshape(rows, count**2), weights.reshape(rows, count**2)


def _moments(nodes: np.ndarray, rise: np.ndarray, count: int) -> np.ndarray:
    """Return the integrals (N, count, count) of products P_i(x) P_j(y) of Legendre polynomials over N regions.

    Parameters
    ----------
    nodes : (N, P, 2) ndarray
        P nodes on the boundary of each region.
    rise : (N, P) ndarray
        Quadrature weights of these nodes for line integrals over dy along the boundary.
    count : int
        Number of polynomials along each axis.
    """
    x, y = _legendre(nodes[..., 0], count + 1), _legendre(nodes[..., 1], count)
    primitive = np.empty((count, *rise.shape))  # integrals of P_0, P_1, ... along x
    primitive[0] = x[1]
    np.subtract(x[2:], x[:-2], out=primitive[1:])
    primitive[1:] /= (2 * np.arange(1, count) + 1)[:, None, None]
    primitive *= rise
    return np.asarray(primitive.transpose(1, 0, 2) @ y.transpose(1, 2, 0))


@cache
def _lagrange(count: int) -> np.ndarray:
    """Return the matrix (count, count) that turns integrals of Legendre polynomials into weights of Gauss points."""
    points, weights = gauss(count)
    out = np.asarray(weights[:, None] * _legendre(points, count).T * (np.arange(count) + 0.5))
    out.setflags(write=False)
    return out


def _legendre(x: np.ndarray, count: int) -> np.ndarray:
    """Return the Legendre polynomials P_0 .. P_(count - 1) at x, shape (count, ...)."""
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
