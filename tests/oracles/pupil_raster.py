"""MTF of batoid's telescopes: its rays, its obscurations and its paths on a fine raster of the exit pupil, and an FFT.

Nothing of the twin is in it. The raster is even in direction cosines at the image, in which a transfer function is an
autocorrelation. Cells at an edge count with the share of them that light reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.ndimage import binary_dilation

CELLS = 384
"""Across the pupil."""

PARTS = 8
"""Of a side of a cell at an edge."""

AROUND = 3
"""Rays of the coarse raster beyond the light that its polynomials follow."""

DEGREE = 10
"""Of the polynomials from direction cosines to the incoming wavefront."""


@dataclass(frozen=True, eq=False)
class PupilRaster:
    """An exit pupil.

    Attributes:
        step: of the raster in direction cosines.
        share: of each cell that light comes through, (n, n), rows v, columns u.
        amplitude: per root of the area in direction cosines, (n, n).
        path: from the incoming wavefront to the image point, metres, (n, n).
        stop: places on the incoming wavefront, in units of the launched radius, (n, n, 2).
        wavelength: metres.
    """

    step: float
    share: np.ndarray
    amplitude: np.ndarray
    path: np.ndarray
    stop: np.ndarray
    wavelength: float

    def transfer(self, perfect: bool = False) -> np.ndarray:
        """Transfer function at shifts of whole cells, (2 n, 2 n), along u in columns; zero shift at [0, 0]."""
        phase = np.zeros_like(self.path) if perfect else 2.0 * np.pi / self.wavelength * self.path
        wave = self.share * self.amplitude * np.exp(1j * phase)
        size = 2 * len(wave)
        overlap = np.fft.ifft2(np.abs(np.fft.fft2(wave, (size, size))) ** 2)
        # a cell that is half lit overlaps itself by a half
        overlap = overlap / np.sum(self.share * self.amplitude**2)
        overlap[0, 0] = 1.0
        return np.asarray(overlap)

    def shifts(self, count: int) -> np.ndarray:
        """From 0 to the raster's width in even steps of whole cells, at most (count,)."""
        return np.arange(0, len(self.share), -(-(len(self.share) - 1) // (count - 1)))

    def mtf(self, shifts: np.ndarray, perfect: bool = False) -> np.ndarray:
        """Along u and along v at shifts (M,) of cells, (2, M)."""
        both = np.abs(self.transfer(perfect))
        return np.stack([both[0, shifts], both[shifts, 0]])


def raster(telescope: Any, wavelength: float, heading: np.ndarray, radius: float, cells: int = CELLS) -> PupilRaster:
    """The pupil of a batoid telescope for one direction, see ``raster_of``.

    Args:
        telescope: a ``batoid.Optic``.
        wavelength: metres.
        heading: direction of the light in batoid's axes, (3,), down from +z.
        radius: of the beam that is launched about the axis' first surface, metres: more than what comes through.
        cells: across the beam.
    """
    way = heading / np.linalg.norm(heading)
    first = np.cross([0.0, 1.0, 0.0], way)
    first = first / np.linalg.norm(first)
    second = np.cross(way, first)
    outside, inside = (float(medium.getN(wavelength)) for medium in (telescope.inMedium, telescope.outMedium))

    def traced(stop: np.ndarray) -> tuple[np.ndarray, ...]:
        import batoid

        start = radius * (stop[:, :1] * first + stop[:, 1:] * second) - 20.0 * way
        velocity = np.tile(way / outside, (len(stop), 1))
        rays = batoid.RayVector(*np.ascontiguousarray(start.T), *np.ascontiguousarray(velocity.T))
        rays.wavelength[:] = wavelength
        telescope.trace(rays)
        rays.toCoordSys(telescope.itemDict[list(telescope.itemDict)[-1]].coordSys)
        return rays.r, inside * rays.v, rays.t, ~(rays.failed | rays.vignetted), ~rays.failed

    return raster_of(traced, wavelength, cells, inside, outside)


def raster_of(
    traced: Callable[[np.ndarray], tuple[np.ndarray, ...]],
    wavelength: float,
    cells: int = CELLS,
    inside: float = 1.0,
    outside: float = 1.0,
) -> PupilRaster:
    """The pupil of any tracing.

    Args:
        traced: of points (N, 2) of the incoming wavefront in units of a radius that holds all of the light: places and
            directions times the index at the image, (N, 3), paths, and which rays come through and which are known.
        wavelength: metres.
        cells: across the light.
        inside: index at the image.
        outside: index before the first surface.
    """
    axis = np.linspace(-1.0, 1.0, 97)
    few = np.stack([a.ravel() for a in np.meshgrid(axis, axis)], axis=-1)
    place, leaving, _, lit, known = traced(few)
    # rays far beyond the rims of lenses are those of no polynomials
    about = binary_dilation(lit.reshape(97, 97), iterations=AROUND).ravel()
    origin = np.mean(place[lit], axis=0)
    cosines = leaving[:, :2]
    low, high = (end(cosines[lit], axis=0) for end in (np.min, np.max))
    middle, half = 0.5 * (low + high), 0.55 * float(np.max(high - low))

    def terms(at: np.ndarray) -> np.ndarray:
        p = (at - middle) / (1.3 * half)
        both = chebyshev.chebvander2d(p[..., 0], p[..., 1], (DEGREE, DEGREE))
        i, j = np.indices((DEGREE + 1, DEGREE + 1))
        return np.asarray(both[..., (i + j <= DEGREE).ravel()])

    near = known & about & np.all(np.abs(cosines - middle) < 1.0 * half, axis=-1)
    solution = np.linalg.lstsq(terms(cosines[near]), few[near], rcond=None)[0]
    step = 2.0 * half / cells
    grid = half * (2.0 * (np.arange(cells) + 0.5) / cells - 1.0)
    u, v = np.meshgrid(middle[0] + grid, middle[1] + grid)

    def stop_at(at: np.ndarray) -> np.ndarray:
        parts = [terms(part) @ solution for part in np.array_split(at, max(1, len(at) // 50_000))]
        return np.concatenate(parts)

    at = np.stack([u.ravel(), v.ravel()], axis=-1)
    stop = stop_at(at)
    place, leaving, time, lit, known = traced(stop)
    off = np.max(np.abs(leaving[lit, :2] - at[lit]), initial=0.0)
    assert off < 0.02 * step, f"polynomials miss the raster by {off / step} cells"
    path = time / outside - np.einsum("ni,ni->n", leaving, place - origin)
    path = np.where(known, path - np.median(path[lit]), 0.0).reshape(u.shape)
    sides = [(stop_at(at + h) - stop_at(at - h)) / step for h in 0.5 * step * np.eye(2)]
    density = np.abs(sides[0][:, 0] * sides[1][:, 1] - sides[0][:, 1] * sides[1][:, 0])
    mask = lit.reshape(u.shape)
    edge = np.zeros_like(mask)
    padded = np.pad(mask, 2)
    for i in range(5):
        for j in range(5):
            edge |= padded[i : i + cells, j : j + cells] != mask
    share = mask.astype(float)
    inner = step * ((np.arange(PARTS) + 0.5) / PARTS - 0.5)
    du, dv = (a.ravel() for a in np.meshgrid(inner, inner))
    fine = np.stack([u[edge][:, None] + du, v[edge][:, None] + dv], axis=-1).reshape(-1, 2)
    share[edge] = traced(stop_at(fine))[3].reshape(-1, PARTS**2).mean(axis=-1)
    return PupilRaster(step, share, np.sqrt(density).reshape(u.shape), path, stop.reshape(*u.shape, 2), wavelength)
