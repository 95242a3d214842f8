"""What pixel area and an extended incoherent source do to a well-sampled image: a short exact filter."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import j1

from optics.numerics.invariants import PhysicalError
from optics.numerics.threads import cores

FIT_ERROR = 1e-6
"""Largest error of the matched transfer function; kernels grow until they reach it."""

MAX_REACH = 10
"""Pixels to which a kernel may reach: enough for three quarters of what pixels can sample."""


class UnsampledImageError(PhysicalError, ValueError):
    """An image is too fine for its pixels, or the source's image too wide for the filter.

    Attributes:
        remedy: what would do.
        of_source: whether that is a smaller source.
    """

    def __init__(self, text: str, remedy: str, of_source: bool) -> None:
        self.remedy = remedy
        self.of_source = of_source
        super().__init__(text)


@dataclass(frozen=True, eq=False)
class PixelResponse:
    """Filter that turns irradiance at pixel centres into the mean over the pixel, convolved with a disk source.

    A diffraction image holds no frequency above its optical cut-off. Below it, the transfer function of pixel and
    disk is matched by a small symmetric kernel, so that no oversampling is needed; above half the sampling frequency
    it is not possible and the fit says so.

    Attributes:
        kernel: (2 reach + 1, 2 reach + 1).
    """

    kernel: np.ndarray

    @property
    def reach(self) -> int:
        """Pixels by which the filter shrinks an image on every side."""
        return self.kernel.shape[0] // 2

    @classmethod
    def fit(cls, pitch: float, disk: float, cutoff: float) -> PixelResponse:
        """Fit the kernel.

        Args:
            pitch: pixel pitch, metres (the whole pixel is sensitive).
            disk: diameter of the source's image, metres; 0 for a point.
            cutoff: highest spatial frequency of the irradiance, cycles/m.

        Raises:
            UnsampledImageError: the image is not well enough sampled by the pixels.
        """
        limit = cutoff * pitch  # cycles per pixel
        if limit > 0.45:
            raise UnsampledImageError(
                f"the image has up to {limit:.2f} cycles per pixel, and its pixels sample 0.45",
                "smaller pixels, a longer focal length, a longer wavelength or a narrower beam",
                of_source=False,
            )
        f = np.linspace(-limit, limit, 41)
        fx, fy = (a.ravel() for a in np.meshgrid(f, f))
        inside = np.hypot(fx, fy) <= limit
        fx, fy = fx[inside], fy[inside]
        wanted = np.sinc(fx) * np.sinc(fy) * _jinc(np.pi * np.hypot(fx, fy) * disk / pitch)
        for reach in range(1, MAX_REACH + 1):
            kernel, error = _symmetric_kernel(fx, fy, wanted, reach)
            if error <= FIT_ERROR:
                kernel.setflags(write=False)
                return cls(kernel)
        raise UnsampledImageError(
            f"pixels and a source of {disk / pitch:.3g} pixels cannot be followed to better than {error:.1g} of the "
            f"peak in an image of up to {limit:.2f} cycles per pixel",
            "a smaller source or smaller pixels",
            of_source=disk > pitch,
        )

    def apply(self, images: np.ndarray) -> np.ndarray:
        """Filter images (B, R, C); returns (B, R - 2 reach, C - 2 reach)."""
        r = self.reach
        out = np.empty((len(images), images.shape[1] - 2 * r, images.shape[2] - 2 * r))

        def work(number: int) -> None:
            out[number] = cv2.filter2D(images[number], cv2.CV_64F, self.kernel)[r:-r, r:-r]

        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(work, range(len(images))))
        return out


def _symmetric_kernel(fx: np.ndarray, fy: np.ndarray, wanted: np.ndarray, reach: int) -> tuple[np.ndarray, float]:
    """Least-squares kernel of eightfold symmetry with a given transfer function, and its largest error."""
    orbits = []
    for i in range(reach + 1):
        for j in range(i + 1):
            orbits.append(sorted({(a * p, b * q) for p, q in ((i, j), (j, i)) for a in (1, -1) for b in (1, -1)}))
    columns = [sum(np.cos(2.0 * np.pi * (fx * a + fy * b)) for a, b in orbit) for orbit in orbits]
    matrix = np.stack(columns, axis=-1)
    solution, *_ = np.linalg.lstsq(matrix, wanted, rcond=1e-13)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for orbit, value in zip(orbits, solution, strict=True):
        for a, b in orbit:
            kernel[reach + a, reach + b] = value
    return kernel, float(np.max(np.abs(matrix @ solution - wanted)))


def _jinc(z: np.ndarray) -> np.ndarray:
    safe = np.where(z == 0.0, 1.0, z)
    return np.where(z == 0.0, 1.0, 2.0 * j1(safe) / safe)
