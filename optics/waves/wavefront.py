"""Wavefront of a traced bundle: eikonal at the image point, optical path difference on the exit pupil, Zernike fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.geometry import zernike
from optics.numerics.invariants import UnphysicalError


def eikonal(position: np.ndarray, direction: np.ndarray, path: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Optical path of each ray's plane wave through ``origin``: path - d . (position - origin).

    Args:
        position: where the path was measured, (..., N, 3), metres (image space, index 1).
        direction: unit directions, (..., N, 3).
        path: optical paths, (..., N).
        origin: the image point, broadcastable to (..., 1, 3).

    Returns:
        (..., N), metres.
    """
    return np.asarray(path - np.sum(direction * (position - origin), axis=-1))


def path_to_sphere(
    position: np.ndarray, direction: np.ndarray, path: np.ndarray, origin: np.ndarray, radius: float = np.inf
) -> np.ndarray:
    """Optical path of each ray to the sphere of a radius about ``origin``, plus that radius.

    Args:
        position: rays near the image, (..., N, 3), metres.
        direction: unit directions there.
        path: optical paths to ``position``, (..., N).
        origin: the image point, broadcastable to (..., 1, 3).
        radius: of the sphere, metres, positive when the exit pupil lies upstream; for an infinite one this is the
            ``eikonal``.

    Returns:
        (..., N) metres.
    """
    offset = position - origin
    along = np.sum(direction * offset, axis=-1)
    # path back to the sphere minus the radius, written so that nothing cancels and an infinite radius is allowed
    bend = along**2 - np.sum(offset**2, axis=-1)
    back = along if np.isinf(radius) else along + bend / (radius + np.sign(radius) * np.sqrt(radius**2 + bend))
    return np.asarray(path - back)


@dataclass(frozen=True, eq=False)
class WavefrontFit:
    """Zernike coefficients of a wavefront (Noll order, index 0 = Z1), metres rms each, and the rms that remains.

    Attributes:
        coefficients: (..., last).
        rms: (...,) rms wavefront error after piston and tilt are taken out, metres.
        residual_rms: (...,) rms left by the fit.
    """

    coefficients: np.ndarray
    rms: np.ndarray
    residual_rms: np.ndarray


def fit_wavefront(
    x: np.ndarray, y: np.ndarray, weight: np.ndarray, difference: np.ndarray, last: int = 28
) -> WavefrontFit:
    """Fit Z1..Z_last to path differences at pupil coordinates x, y (unit disk) with quadrature weights.

    Piston and tilt are removed from ``rms`` (they move the image, they do not blur it); defocus is kept.

    Args:
        x: on the unit disk, (N,).
        y: likewise.
        weight: of a quadrature, (N,).
        difference: of optical paths, (..., N), metres.
        last: highest Noll index.
    """
    coefficients = zernike.fit(last, x, y, difference, weight)
    share = weight / np.sum(weight)
    fitted = coefficients @ zernike.basis(last, x, y).T
    plane = coefficients[..., :3] @ zernike.basis(3, x, y).T
    rest = difference - plane
    rest = rest - np.sum(rest * share, axis=-1, keepdims=True)
    rms = np.sqrt(np.sum(rest**2 * share, axis=-1))
    residual = np.sqrt(np.sum((difference - fitted) ** 2 * share, axis=-1))
    return WavefrontFit(coefficients, rms, residual)


def orthonormal_parts(
    x: np.ndarray, y: np.ndarray, weight: np.ndarray, difference: np.ndarray, last: int
) -> np.ndarray:
    """What Zernike terms make of the rms of path differences over any part of the unit disk, in Noll's order.

    The terms are made orthonormal over the weight one after the other (Gram and Schmidt, as of annular pupils: Mahajan,
    J. Opt. Soc. Am. 71, 75, 1981). Over the whole disk they are themselves; over a part of it fitted coefficients are
    no parts of the rms: two terms that are alike there may each be larger than the whole.

    Args:
        x: on the unit disk, (N,).
        y: likewise.
        weight: of a quadrature over what is lit, (N,); 0 where no light is.
        difference: of optical paths, (N,).
        last: highest Noll index.

    Returns:
        (last,), in the unit of ``difference``, with the signs of the terms.
    """
    lit = weight > 0.0
    root = np.sqrt(weight[lit] / np.sum(weight))
    q, r = np.linalg.qr(zernike.basis(last, x[lit], y[lit]) * root[:, None])
    return np.asarray(np.sign(np.diag(r)) * (q.T @ (difference[lit] * root)))


@dataclass(frozen=True, eq=False)
class PartFit:
    """A wavefront over a part of the unit disk, piston and tilt taken out.

    Attributes:
        level: piston and the two tilts that were taken out, coefficients of Z1 to Z3, (3,).
        coefficients: of Zernike terms in Noll's order, (last,), by least squares; they share among them what is alike
            over the part.
        parts: as of ``orthonormal_parts``, (last,).
        rms: of the path differences.
        residual_rms: that the terms leave.
        strehl: square of the mean phasor, for path differences in waves.
    """

    level: np.ndarray
    coefficients: np.ndarray
    parts: np.ndarray
    rms: float
    residual_rms: float
    strehl: float


def fit_part(x: np.ndarray, y: np.ndarray, weight: np.ndarray, difference: np.ndarray, last: int) -> PartFit:
    """Fit Z1..Z_last to a wavefront over a part of the unit disk by a quadrature whose weights may be negative, as of
    what shadows take off again.

    Args:
        x: near the unit disk, (N,).
        y: likewise.
        weight: of the area, (N,), with a positive sum.
        difference: of optical paths, waves, (N,).
        last: highest Noll index.

    Raises:
        UnphysicalError: a quadrature over which the terms have no squares above zero: too few nodes, or next to no
            area.
    """
    share = weight / np.sum(weight)
    basis = zernike.basis(last, x, y)

    def orthonormal(count: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = basis[:, :count]
        try:
            root = np.linalg.cholesky(own.T @ (share[:, None] * own))
        except np.linalg.LinAlgError as error:
            raise UnphysicalError(
                f"{count} Zernike terms are not independent over the light that comes through"
            ) from error
        parts = np.linalg.solve(root, own.T @ (share * values))
        return parts, np.linalg.solve(root.T, parts)

    _, level = orthonormal(3, difference)
    flat = difference - basis[:, :3] @ level
    parts, coefficients = orthonormal(last, flat)
    square = float(share @ flat**2)
    left = float(share @ (flat - basis @ coefficients) ** 2)
    phasor = share @ np.exp(2j * np.pi * flat)
    return PartFit(
        level,
        coefficients,
        parts,
        float(np.sqrt(max(square, 0.0))),
        float(np.sqrt(max(left, 0.0))),
        float(abs(phasor) ** 2),
    )
