"""Diffraction images: the matrix Fourier transform of a traced pupil onto a detector's own grid, and Huygens' sum.

Convention: time factor exp(-i w t), a wave of phase exp(+i k L) with L its optical path.

Near the image point P0 every traced ray is a local plane wave of direction cosines (u, v) along the detector's x and y
and of eikonal L (the optical path to the wave's plane through P0). The field on the detector is the sum of these waves,

    U(x, y) = 1/lambda * sum_j w_j a_j exp(i k (L_j + u_j x + v_j y)),

with w_j the pupil element. Because exp(ik(ux + vy)) factors, U on a grid of R x C pixels is the product of an (R x N)
and an (N x C) matrix: no FFT grid, no padding, pixels wherever the detector has them (Soummer et al., Opt. Express
15, 15935 (2007), here with arbitrary pupil nodes). Plancherel: with sum w_j |a_j|^2 = P over du dv the image
integrates to P.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import j1


@dataclass(frozen=True, eq=False)
class PupilField:
    """Plane waves that make B images, N nodes each.

    Attributes:
        u, v: direction cosines along the detector's x and y, (B, N).
        eikonal: optical path to the plane wave through the image's origin, metres, (B, N), common piston removed.
        amplitude: a_j * w_j * du dv, such that the formula above holds with unit total power, (B, N); 0 = blocked.
        wavelength: metres.
    """

    u: np.ndarray
    v: np.ndarray
    eikonal: np.ndarray
    amplitude: np.ndarray
    wavelength: float

    def __getitem__(self, piece: slice) -> PupilField:
        """Some of the images."""
        return PupilField(self.u[piece], self.v[piece], self.eikonal[piece], self.amplitude[piece], self.wavelength)


def image(field: PupilField, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Irradiance on the grid of columns x and rows y by the matrix Fourier transform.

    Args:
        field: B pupils.
        x: (C,) or (B, C) detector x of the columns, metres from each image's origin.
        y: (R,) or (B, R) detector y of the rows.

    Returns:
        Shape (B, R, C), 1/m^2 for unit power through the pupil.
    """
    k = 2.0 * np.pi / field.wavelength
    rows = _waves(k * np.atleast_2d(y)[:, :, None] * field.v[:, None, :])
    phase = field.amplitude * np.exp(1j * k * field.eikonal)
    columns = _waves(k * field.u[:, :, None] * np.atleast_2d(x)[:, None, :])
    columns *= phase[:, :, None]
    amplitude = rows @ columns
    return np.asarray(amplitude.real**2 + amplitude.imag**2) / field.wavelength**2


def _waves(phase: np.ndarray) -> np.ndarray:
    out = np.empty(phase.shape, np.complex128)
    np.cos(phase, out=out.real)
    np.sin(phase, out=out.imag)
    return out


def huygens(
    points: np.ndarray,
    path: np.ndarray,
    direction: np.ndarray,
    amplitude: np.ndarray,
    wavelength: float,
    pixels: np.ndarray,
    normal: np.ndarray | None = None,
    chunk: int = 256,
) -> np.ndarray:
    """Irradiance by Huygens' sum of spherical wavelets from points on the exit wavefront; slow, the check of ``image``.

    Args:
        points: (N, 3) points on the exit reference sphere, metres.
        path: (N,) optical path at these points.
        direction: (N, 3) unit ray directions there.
        amplitude: (N,) area element times field amplitude at the points (m^2 * field).
        wavelength: metres.
        pixels: (M, 3) points where the irradiance is wanted.
        normal: (3,) unit normal of the detector: each wavelet counts with the root of the cosine of its incidence, so that
            the result is power per detector area, as in ``image``; None: square to the light.
        chunk: pixels done at once, to bound memory.

    Returns:
        (M,) irradiance, 1/m^2 for unit power (sum amplitude * field = 1).
    """
    k = 2.0 * np.pi / wavelength
    out = np.empty(len(pixels))
    for start in range(0, len(pixels), chunk):
        arm = pixels[start : start + chunk, None, :] - points[None]
        distance = np.linalg.norm(arm, axis=-1)
        obliquity = np.einsum("mnx,nx->mn", arm, direction) / distance
        if normal is not None:
            obliquity = obliquity * np.sqrt(np.abs(arm @ normal) / distance)
        phase = k * ((path - path[0]) + (distance - distance[:, :1]))
        field = np.sum(amplitude * obliquity / distance * np.exp(1j * phase), axis=1) / wavelength
        out[start : start + chunk] = np.abs(field) ** 2
    return out


def airy(radius: np.ndarray, wavelength: float, f_number: float) -> np.ndarray:
    """Airy pattern of a clear circular pupil, 1 at the centre; ``radius`` in metres."""
    z = np.pi * np.asarray(radius) / (wavelength * f_number)
    safe = np.where(z == 0.0, 1.0, z)
    return np.where(z == 0.0, 1.0, (2.0 * j1(safe) / safe) ** 2)
