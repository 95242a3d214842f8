"""Which place of the terrain every point of a part of an image sees.

The rigorous sensor is evaluated at Chebyshev nodes over lines, pixels and heights; between them east and north are
analytic, and as many nodes are taken as keep the interpolation below a tolerance that is measured. The place on the
terrain follows from the look's east and north over height, by secant steps between bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from optics.threads import one_blas_thread
from twin.orbit.ground.frame import GroundFrame
from twin.orbit.ground.terrain import Terrain
from twin.orbit.sensor import Sensor

TOLERANCE = 2e-4
"""Metres: largest interpolation error of the look's place at given heights."""
_COUNTS = (4, 6, 8, 12, 16, 24, 32, 48)
_HEIGHTS = 4
"""The look bends over the ellipsoid's curvature by 3 cm in 500 m of height, and by nothing more."""
_MET = 1e-4
"""Metres of height between look and terrain."""
_MOST_STEPS = 40


class SteepTerrainError(ValueError):
    """Terrain that is steeper than a look: a part of it is hidden."""


@dataclass(frozen=True, eq=False)
class LookMap:
    """The looks of a part of an image; made by `prepare`.

    Attributes:
        frame: coordinates of the ground.
        terrain: of the ground.
        span: first and last line, first and last pixel, lowest and highest height (metres) of the nodes.
        east, north: Chebyshev coefficients over height, line and pixel, (heights, K, M), metres.
        error: largest difference to the rigorous sensor that was found between the nodes, metres.
    """

    frame: GroundFrame
    terrain: Terrain
    span: np.ndarray
    east: np.ndarray
    north: np.ndarray
    error: float

    @classmethod
    def prepare(
        cls,
        sensor: Sensor,
        frame: GroundFrame,
        terrain: Terrain,
        lines: tuple[float, float],
        pixels: tuple[float, float],
        tolerance: float = TOLERANCE,
    ) -> LookMap:
        """For the part of an image between given lines and pixels, both inclusive.

        Raises:
            ValueError: a part outside the image, a look that misses the Earth, or an attitude too rough for the nodes.
        """
        low, high = terrain.limits
        span = np.array([lines, pixels, (low - 1.0, high + 1.0)])
        random = np.random.default_rng(0)
        probe = [random.uniform(ends[0], ends[1], 200) for ends in span]
        exact = np.stack(_local(sensor, frame, *probe))
        error = np.inf
        for count in _COUNTS:
            nodes = [_nodes(ends, n) for ends, n in zip(span, (count, count, _HEIGHTS), strict=True)]
            grid = [a.ravel() for a in np.meshgrid(nodes[2], nodes[0], nodes[1], indexing="ij")]
            known = [v.reshape(_HEIGHTS, count, count) for v in _local(sensor, frame, grid[1], grid[2], grid[0])]
            east, north = (_coefficients(v) for v in known)
            one = cls(frame, terrain, span, east, north, error)
            error = float(np.max(np.abs(one._at(*probe) - exact)))
            if error <= tolerance:
                return cls(frame, terrain, span, east, north, error)
        raise ValueError(f"{_COUNTS[-1]} nodes along lines and pixels leave {error:.2g} m, more than {tolerance:g} m")

    def ground(self, lines: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """East, north and height of the terrain that a grid of image points sees: (L,), (P,) -> (L, P) each, metres.

        Raises:
            SteepTerrainError: the terrain is as steep as the look somewhere.
        """
        with one_blas_thread():
            along = self._basis(0, lines, self.east.shape[1])
            across = self._basis(1, pixels, self.east.shape[2])
            # as polynomials in x, height over the span: -1 at the lowest
            power = np.zeros((_HEIGHTS, _HEIGHTS))
            for k in range(_HEIGHTS):
                power[k, : k + 1] = chebyshev.cheb2poly([0.0] * k + [1.0])
            east, north = (
                [along @ np.tensordot(power[:, k], c, 1) @ across.T for k in range(_HEIGHTS)]
                for c in (self.east, self.north)
            )
        return self._met(east, north)

    def _met(self, east: list[np.ndarray], north: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where looks, polynomials in x, meet the terrain."""
        low, high = self.span[2]
        middle, half = 0.5 * (low + high), 0.5 * (high - low)

        def excess(h: np.ndarray) -> np.ndarray:
            x = (h - middle) / half
            return self.terrain.height(_horner(east, x), _horner(north, x)) - h

        # the terrain lies between the span's ends, so that there is always a place between `below` and `above`
        below, above = np.full(east[0].shape, low), np.full(east[0].shape, high)
        before, excess_before = np.full(east[0].shape, middle), excess(np.full(east[0].shape, middle))
        height = before + excess_before
        for k in range(_MOST_STEPS):
            now = excess(height)
            if np.max(np.abs(now)) <= _MET:
                x = (height - middle) / half
                return _horner(east, x), _horner(north, x), height
            np.copyto(below, height, where=now > 0.0)
            np.copyto(above, height, where=now < 0.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = height - now * (height - before) / (now - excess_before)
            if k % 4 == 3:  # secants alone may creep toward a place from one side
                step[np.abs(now) > 1.0] = np.nan
            inside = (step > below) & (step < above)
            arrived = np.abs(now) <= _MET
            following = np.where(inside, step, 0.5 * (below + above))
            before, excess_before, height = height, now, np.where(arrived, height, following)
        raise SteepTerrainError(
            f"looks and terrain do not meet within {_MET:g} m in {_MOST_STEPS} steps: the terrain is nearly as steep "
            "as the look"
        )

    def run(self) -> tuple[float, float]:
        """How far the middle look moves east and north for each metre that it is followed up."""
        low, high = self.span[2]
        ends = np.full(2, self.span[0].mean()), np.full(2, self.span[1].mean()), np.array([low, high])
        east, north = self._at(*ends)
        return float((east[1] - east[0]) / (high - low)), float((north[1] - north[0]) / (high - low))

    def _at(self, line: np.ndarray, pixel: np.ndarray, height: np.ndarray) -> np.ndarray:
        """East and north at single places, (2, N)."""
        count = self.east.shape[1]
        a, b = self._basis(0, line, count), self._basis(1, pixel, self.east.shape[2])
        c = self._basis(2, height, _HEIGHTS)
        return np.stack([np.einsum("hij,nh,ni,nj->n", v, c, a, b, optimize=True) for v in (self.east, self.north)])

    def _basis(self, axis: int, place: np.ndarray, count: int) -> np.ndarray:
        first, last = self.span[axis]
        return chebyshev.chebvander((2.0 * np.asarray(place) - first - last) / (last - first), count - 1)


def _nodes(ends: np.ndarray, count: int) -> np.ndarray:
    return np.asarray(0.5 * (ends[0] + ends[1]) + 0.5 * (ends[1] - ends[0]) * chebyshev.chebpts1(count))


def _coefficients(values: np.ndarray) -> np.ndarray:
    """Chebyshev coefficients of values at the nodes, along every axis."""
    for axis, count in enumerate(values.shape):
        to = chebyshev.chebvander(chebyshev.chebpts1(count), count - 1).T * (2.0 / count)
        to[0] *= 0.5
        values = np.moveaxis(np.tensordot(to, values, (1, axis)), 0, axis)
    return values


def _local(
    sensor: Sensor, frame: GroundFrame, line: np.ndarray, pixel: np.ndarray, height: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    points = sensor.ground(line, pixel, height)
    if not np.all(np.isfinite(points)):
        raise ValueError("a look misses the Earth")
    return frame.local(points)[:2]


def _horner(terms: list[np.ndarray], x: np.ndarray) -> np.ndarray:
    out = terms[-1] * x
    for term in terms[-2:0:-1]:
        out += term
        out *= x
    out += terms[0]
    return out
