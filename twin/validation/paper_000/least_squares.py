"""Paper 000's sum of squares (2) and its derivatives (4), with what tells them apart from (5): (2) minimised and
differentiated by its values alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_STEP = 1e-3


def sum_of_squares(slopes: Array, points: Array, station: Array) -> float:
    """S of (2) for slopes a0, a1 (2,), with a2 by (1); points (n, 3) and station (3,), metres. Square metres."""
    x, y, z = points.T
    x0, y0, z0 = station
    a0, a1 = slopes
    return float(np.sum((a0 * x + a1 * y + (z0 - a0 * x0 - a1 * y0) - z) ** 2))


def derivatives(slopes: Array, points: Array, station: Array) -> Array:
    """The left sides of (4), (2,), square metres."""
    x, y, z = points.T
    x0, y0, z0 = station
    a0, a1 = slopes
    miss = a0 * x + a1 * y + z0 - a0 * x0 - a1 * y0 - z
    return np.array([np.sum(2.0 * miss * (x - x0)), np.sum(2.0 * miss * (y - y0))])


def numerical_derivatives(slopes: Array, points: Array, station: Array) -> Array:
    """Derivatives of S by central differences, (2,); of a square form they are exact but for rounding."""
    out = []
    for step in _STEP * np.eye(2):
        above, below = (sum_of_squares(slopes + sign * step, points, station) for sign in (1.0, -1.0))
        out.append((above - below) / (2.0 * _STEP))
    return np.array(out)


def least_slopes(points: Array, station: Array) -> Array:
    """The slopes that make S least, (2,): the vertex of a parabola through its values, found twice, as the second time
    it is near and keeps more digits.
    """
    place, size = np.zeros(2), 1.0
    for _ in range(3):
        step = size * np.eye(2)

        def value(shift: Array, place: Array = place) -> float:
            return sum_of_squares(place + shift, points, station)

        middle = value(np.zeros(2))
        up, down = ([value(sign * e) for e in step] for sign in (1.0, -1.0))
        slope = (np.array(up) - np.array(down)) / (2.0 * size)
        curve = np.diag((np.array(up) + np.array(down) - 2.0 * middle) / size**2)
        curve[0, 1] = curve[1, 0] = (value(step[0] + step[1]) - up[0] - up[1] + middle) / size**2
        place, size = place - np.linalg.solve(curve, slope), _STEP
    return place
