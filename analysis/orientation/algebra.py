"""Linear algebra of the distortion fit: columns of very different size, noise that is common to many points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.orientation.distortion_model import InseparableTermsError, OrientationError

__all__ = ["condition_number", "gain", "noise_matrix", "noise_root"]

Array = NDArray[np.float64]
# With columns of length one, the worst combination of terms has this many times the sigma of the best. Five terms over
# half a field have 270; f and a constant reach 1000 when the angles lie within 1 % of each other.
_WORST_CONDITION = 1e3


def gain(columns: Array, root: Array | None = None) -> Array:
    """Least-squares inverse (P, N) of columns (N, P): all points alike, or generalised least squares.

    root: (N, N) from `noise_root`. Columns are scaled to length one, for powers of tan W differ by magnitudes.
    """
    white = columns if root is None else np.linalg.solve(root, columns)
    length = np.linalg.norm(white, axis=0)
    inverse = np.linalg.pinv(white / length) / length[:, None]
    return np.asarray(inverse if root is None else inverse @ np.linalg.inv(root), dtype=np.float64)


def condition_number(columns: Array, names: tuple[str, ...], angle: Array) -> float:
    """Condition number of columns (N, P) of these terms at angles (N,), rad, scaled to length one.

    Raises InseparableTermsError, naming the terms that take part in the worst combination, when it is too large.
    """
    length = np.linalg.norm(columns, axis=0)
    _, values, vt = np.linalg.svd(columns / np.where(length > 0, length, 1.0))
    condition = float(values[0] / max(values[-1], 1e-300))
    if condition <= _WORST_CONDITION:
        return condition
    part = np.abs(vt[-1]) / np.max(np.abs(vt[-1]))
    mixed = tuple(name for name, share in zip(names, part, strict=True) if share > 0.1)
    null = vt[-1:] / np.where(length > 0, length, 1.0)
    low, high = np.rad2deg(np.min(angle)), np.rad2deg(np.max(angle))
    side = ", all on one side of zero" if low * high > 0 else ""
    raise InseparableTermsError(
        f"interior orientation: angles from {low:.6g} to {high:.6g} deg{side}, cannot separate {', '.join(mixed)}"
        f" (condition number {condition:.2g}); measure at more angles over both halves of the"
        " field, or leave a term out",
        null / np.max(np.abs(null)),
        mixed,
    )


def noise_matrix(given: ArrayLike, count: int, name: str) -> Array:
    """Covariance (N, N) from a covariance (N, N) or sigmas (N,) or ().

    Raises OrientationError, with the given name, for another shape, values that are not finite, negative sigmas.
    """
    noise = np.asarray(given, dtype=np.float64)
    if not np.all(np.isfinite(noise)):
        raise OrientationError(f"interior orientation: {name} is not finite")
    if noise.shape in ((), (count,)):
        if np.any(noise < 0):
            raise OrientationError(f"interior orientation: {name} holds negative sigmas")
        return np.diag(np.broadcast_to(noise, (count,)) ** 2)
    if noise.shape != (count, count):
        raise OrientationError(
            f"interior orientation: {name} is {noise.shape}; {count} points need ({count}, {count}), or {count} sigmas"
        )
    if np.max(np.abs(noise - noise.T)) > 1e-9 * np.max(np.abs(noise)):
        raise OrientationError(f"interior orientation: {name} is not symmetric")
    return 0.5 * (noise + noise.T)


def noise_root(noise: Array) -> Array:
    """Cholesky factor of a covariance (N, N): solve(root, x) has unit covariance.

    Raises OrientationError when the covariance is not positive definite.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(noise), 0.0))
    least = np.min(np.linalg.eigvalsh(noise / np.outer(sigma, sigma))) if np.all(sigma > 0) else 0.0
    # eigenvalues below the rounding of a matrix of this size are not known to be positive
    if least <= 1e-14 * len(noise):
        raise OrientationError(
            "interior orientation: the noise is zero or fully common in some combination of points (its covariance is"
            " not positive definite); add the sigmas of the single spots"
        )
    return np.asarray(np.linalg.cholesky(noise))
