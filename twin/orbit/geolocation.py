"""Ground coordinates of every pixel of a whole image, fast.

Along the track nothing is interpolated, so that no smoothness of attitude or orbit is assumed: every line is computed
by the rigorous model at a few Chebyshev points of the line. Between them the ground point is an analytic function of
the pixel, and one matrix product takes a block of lines from the points to all pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from twin.orbit.sensor import Sensor

_COUNTS = (8, 12, 16, 24, 32, 48)
_TRIAL_LINES = 9


@dataclass(frozen=True, eq=False)
class GeolocationGrid:
    """How the ground coordinates of an image are interpolated along its lines; made by `prepare`.

    Attributes:
        sensor: the rigorous model.
        height: of the surface, above the ellipsoid, metres.
        nodes: pixels where the rigorous model is evaluated, (K,).
        error: largest difference between interpolation and rigorous model that was found half-way between the nodes
            and at the line's ends, on lines over the whole image, metres.
    """

    sensor: Sensor
    height: float
    nodes: np.ndarray
    error: float

    @classmethod
    def prepare(cls, sensor: Sensor, height: float = 0.0, tolerance: float = 1e-6) -> GeolocationGrid:
        """Take as few nodes as keep the error below a tolerance, metres.

        Raises:
            ValueError: a look misses the Earth, or the camera's looks are too rough for the tolerance.
        """
        line = np.linspace(-0.5, sensor.lines - 0.5, _TRIAL_LINES)
        error = np.inf
        for count in _COUNTS:
            grid = cls(sensor, height, _nodes(count, sensor.camera.pixels), error)
            ends = np.array([-0.5, sensor.camera.pixels - 0.5])
            between = np.concatenate([0.5 * (grid.nodes[1:] + grid.nodes[:-1]), ends])
            exact = _rigorous(sensor, line, between, height)
            error = float(np.max(np.linalg.norm(grid._interpolated(line, between) - exact, axis=-1)))
            if error <= tolerance:
                return cls(sensor, height, grid.nodes, error)
        raise ValueError(f"{_COUNTS[-1]} nodes leave an error of {error:.3g} m, more than {tolerance:.3g} m")

    def blocks(self, lines: np.ndarray, pixels: np.ndarray, block: int = 128) -> Iterator[tuple[slice, np.ndarray]]:
        """Ground points of all these lines and pixels, block by block.

        Args:
            lines: image coordinates, (L,), any real numbers inside the image.
            pixels: likewise, (P,).
            block: lines at a time; the memory is about 24 block P bytes.

        Yields:
            Which of the lines, and their points in the ITRS, (n, P, 3), metres (float64; a view whose coordinates lie
            in planes, so that ``[..., 0]`` is contiguous).

        Raises:
            ValueError: a line or pixel outside the image, or a look that misses the Earth.
        """
        lines, pixels = np.asarray(lines, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
        if not np.all((pixels >= -0.5) & (pixels <= self.sensor.camera.pixels - 0.5)):
            raise ValueError(f"a pixel outside the line, which reaches from -0.5 to {self.sensor.camera.pixels - 0.5}")
        weights = self._weights(pixels)
        for start in range(0, len(lines), block):
            part = slice(start, min(start + block, len(lines)))
            yield part, self._spread(lines[part], weights)

    def _interpolated(self, lines: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        return self._spread(lines, self._weights(pixels))

    def _spread(self, lines: np.ndarray, weights: np.ndarray) -> np.ndarray:
        known = _rigorous(self.sensor, lines, self.nodes, self.height)
        planes = np.ascontiguousarray(np.moveaxis(known, -1, 0))
        return np.moveaxis((planes.reshape(-1, len(self.nodes)) @ weights).reshape(3, len(lines), -1), 0, -1)

    def _weights(self, pixels: np.ndarray) -> np.ndarray:
        """Values at the nodes -> values at pixels: (K, P)."""
        count = len(self.nodes)
        scale = np.full(count, 2.0 / count)
        scale[0] = 1.0 / count
        at_nodes, at_pixels = (
            chebyshev.chebvander((2.0 * place + 1.0) / self.sensor.camera.pixels - 1.0, count - 1)
            for place in (self.nodes, pixels)
        )
        return np.asarray((at_nodes * scale) @ at_pixels.T)


def _nodes(count: int, pixels: int) -> np.ndarray:
    return 0.5 * (chebyshev.chebpts1(count) + 1.0) * pixels - 0.5


def _rigorous(sensor: Sensor, lines: np.ndarray, pixels: np.ndarray, height: float) -> np.ndarray:
    """Points (L, P, 3).

    Raises:
        ValueError: a look misses the Earth; interpolation would spread it over the line.
    """
    line, pixel = np.meshgrid(lines, pixels, indexing="ij")
    points = sensor.ground(line.ravel(), pixel.ravel(), height).reshape(*line.shape, 3)
    if not np.all(np.isfinite(points)):
        raise ValueError("a look misses the Earth")
    return points
