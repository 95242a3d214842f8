"""Spots worked out once more from the traced rays alone: no node classes, no Zernike map, no matrix, no pixel filter.

The rays' density in direction cosines comes from a polar grid by differentiation along its radii and around its rings.
The wave at a point is the plain sum over rays, and a pixel that is lit by an extended pinhole is the mean of the
irradiance over box and disk, by Gauss' rule.
"""

from __future__ import annotations

import numpy as np

from optics.geometry.tree import State
from optics.numerics.quadrature import PupilNodes
from twin.monitor.monitor_beams import CcdRays, MonitorBeams
from twin.monitor.monitor_path import MonitorPath

RINGS_PER_RADIAN, LEAST_RINGS = 1.2, 48
"""Rings for the phase from the middle to the edge of the pupil, four times as many arms: more than a smooth pupil
needs, since an edge that cuts the beam leaves an error that falls only with the number of rings.
"""
FEW_RINGS = 12
"""Of the rays that say how many more are needed."""


def polar_grid(rings: int, arms: int) -> PupilNodes:
    """Gauss' points along the radius, equal angles around."""
    radius, weight = _radii(rings)
    angle = 2.0 * np.pi * np.arange(arms) / arms
    x, y = (radius[:, None] * part(angle) for part in (np.cos, np.sin))
    return PupilNodes(x.ravel(), y.ravel(), np.repeat(weight * radius * 2.0 * np.pi / arms, arms))


def _radii(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the rings, and weights of an integral over the radius."""
    points, weights = np.polynomial.legendre.leggauss(rings)
    return 0.5 * (points + 1.0), 0.5 * weights


def _along_radius(values: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Derivative of the polynomial through values on rings (R, A), (R, A): barycentric differentiation (Berrut and
    Trefethen, SIAM Review 46, 501 (2004), sec. 9.3).
    """
    apart = radius[:, None] - radius
    np.fill_diagonal(apart, 1.0)
    # products of hundreds of distances: by their logarithms
    size = -np.sum(np.log(np.abs(apart)), axis=1)
    sign = np.prod(np.sign(apart), axis=1)
    ratio = sign * sign[:, None] * np.exp(size - size[:, None]) / apart
    np.fill_diagonal(ratio, 0.0)
    np.fill_diagonal(ratio, -ratio.sum(axis=1))
    return np.asarray(ratio @ values)


class DenseImages:
    """Images of one state's spots.

    Args:
        path: the monitor; only its rays are used, and what its instrument says of pinhole and light.
        state: of the instrument.

    Attributes:
        phase: that rays from the middle to the edge of the pupil may differ by on a pixel, radians.
    """

    def __init__(self, path: MonitorPath, state: State) -> None:
        self.path = path
        few = self._rays(state, FEW_RINGS)
        lean = np.linalg.norm((few.direction - np.mean(few.direction, axis=1, keepdims=True))[..., :2], axis=-1)
        half = 0.5 * path.pitch * np.array(path.shape[::-1])
        reach = np.linalg.norm(np.abs(few.position[..., :2]) + half, axis=-1)
        # the outermost of few rays stand a little inside the edge
        self.phase = float(
            2.0 * np.pi / path.wavelength * np.max(lean) * np.max(reach) * np.sqrt(1.0 + 0.5 / FEW_RINGS)
        )
        self._state = state

    def trace(self) -> None:
        """Trace as many rays as the images need."""
        rings = max(LEAST_RINGS, int(np.ceil(RINGS_PER_RADIAN * self.phase)))
        self.shape = rings, 4 * rings
        rays = self._rays(self._state, rings)
        size = rays.size[:, None]
        self._u, self._v = (rays.direction[..., axis] * size for axis in (0, 1))
        # optical path to the plane wave through the CCD's middle
        self._path = rays.path - size * np.sum(rays.position * rays.direction, axis=-1)
        self._valid = rays.valid

    def _rays(self, state: State, rings: int) -> CcdRays:
        return MonitorBeams(self.path.instrument, self.path.backend, polar_grid(rings, 4 * rings)).rays([state])

    def photons(self, channel: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Expected photons per frame on pixels, (P,).

        Args:
            channel: its number.
            rows, columns: of the pixels, (P,) each.
        """
        monitor = self.path.instrument.spec.monitor
        pitch, spread = self.path.pitch, monitor.reticle.pinhole
        (x, y), weight = _box_and_disk(pitch, spread)
        px = (columns - 0.5 * (self.path.shape[1] - 1)) * pitch
        py = (rows - 0.5 * (self.path.shape[0] - 1)) * pitch
        seen = self._irradiance(channel, (px[:, None] + x).ravel(), (py[:, None] + y).ravel())
        mean = seen.reshape(len(rows), -1) @ weight
        return np.asarray(mean * pitch**2 * monitor.reticle.photons_per_frame)

    def _irradiance(self, channel: int, x: np.ndarray, y: np.ndarray, chunk: int = 64) -> np.ndarray:
        """At points of the CCD from its middle, (Q,), 1/m^2 for a channel's whole light."""
        wave = self.path.wavelength
        u, v, valid = self._u[channel], self._v[channel], self._valid[channel]
        amplitude = self._amplitude(u, v, valid) * valid
        length = self._path[channel] - self._path[channel][0]
        own = np.flatnonzero(valid)
        u, v, length, amplitude = u[own] / wave, v[own] / wave, length[own] / wave, amplitude[own].astype(np.float32)
        out = np.empty(len(x))
        for start in range(0, len(x), chunk):
            some = slice(start, start + chunk)
            turns = length + x[some, None] * u + y[some, None] * v
            turns -= np.rint(turns)
            phase = (2.0 * np.pi * turns).astype(np.float32)
            out[some] = (np.cos(phase) @ amplitude) ** 2.0 + (np.sin(phase) @ amplitude) ** 2.0
        return out / wave**2

    def _amplitude(self, u: np.ndarray, v: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Of every ray, (N,): the wave's is such that each part of the face holds its share of the light."""
        rings, arms = self.shape
        u, v = u.reshape(rings, arms), v.reshape(rings, arms)

        def around(a: np.ndarray) -> np.ndarray:
            f = np.fft.fftfreq(arms, 1.0 / arms)
            return np.asarray(np.fft.ifft(1j * f * np.fft.fft(a, axis=1), axis=1).real)

        ring, weight = _radii(rings)
        # a lost ray's numbers are anything, and must not reach the whole radius
        cut = not np.all(valid)
        along = [np.gradient(a, ring, axis=0, edge_order=2) if cut else _along_radius(a, ring) for a in (u, v)]
        across = [around(a) for a in (u, v)]
        # per area of the face, times the area that each ray stands for
        jacobian = (along[0] * across[1] - along[1] * across[0]) / ring[:, None]
        return np.asarray(np.sqrt(np.abs(jacobian) / np.pi) * (weight * ring)[:, None] * 2.0 * np.pi / arms).ravel()


def _box_and_disk(pitch: float, disk: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, Q) and weights of the mean over a pixel and over a disk source's image that is laid over it."""
    # an image that its pixels sample has less than half a wave on each
    s, w = np.polynomial.legendre.leggauss(4)
    x, y = np.meshgrid(0.5 * pitch * s, 0.5 * pitch * s)
    box, share = np.stack([x.ravel(), y.ravel()]), np.outer(w, w).ravel() / 4.0
    rings = 2 + int(np.ceil(0.5 * disk / pitch))
    t, v = np.polynomial.legendre.leggauss(rings)
    radius, angle = 0.5 * disk * np.sqrt(0.5 * (t + 1.0)), 2.0 * np.pi * np.arange(4 * rings) / (4 * rings)
    spot = np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()])
    of_spot = np.repeat(0.5 * v, 4 * rings) / (4 * rings)
    points = box[:, :, None] + spot[:, None, :]
    return points.reshape(2, -1), np.outer(share, of_spot).ravel()
