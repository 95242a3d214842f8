"""Interior orientation and distortion along a line CCD: the equations of paper 004 as printed, and the terms of the
model that goes beyond them.

A collimator stands still and the camera turns on a turntable. W (rad) is the angle of a direction from the one that
images to the centre O of the line, L (m) the place of its spot from O. Both count in the same sense, so that f > 0.
Paper 004 (Li et al., doi 10.3788/IRLA20200143) defines the distortion of a point

    D = L - f tan W + p tan^2 W    (1)

and chooses f and p such that sum D^2 over the points is least (2), f alone with p = 0 (3), or p alone (4).

What (1) means: a camera without distortion whose principal point lies p from O images to
L = f tan(W - w) + f tan w with tan w = p / f, which is f tan W - p tan^2 W up to terms of the order p^2 / f. There is
no constant term as long as W counts exactly from the direction that images to O. An error d of that zero of W adds
-f d (1 + tan^2 W): (3) leaves f d in the distortion of every point, and (2) puts f d (1 + 5 / (3 tan^2 W_edge)) into p,
which is 3500 f d for a field of +-1.25 deg. The model with a constant is free of this:

    L = c + f tan W - p tan^2 W + k3 tan^3 W

- `constant` c, `principal_distance` f, `principal_point` p: the interior orientation, metres. In one dimension a
  decentring distortion d2 tan^2 W is the same function as a principal point p = -d2, and so is, to first order, a
  radial distortion whose centre lies off the zero of W by w: -3 k3 w tan^2 W. No measurement along one line separates
  them;
- `radial3` k3, m: radial distortion. With r = f tan W it is K1 r^3, K1 = k3 / f^3 (1/m^2); positive is a pincushion.
  Software that *adds* a correction to the image has the other sign.

Angles in radians, lengths in metres. Leading axes of L and W are sets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError

# power of tan W and sign of each term
_POWER = {"constant": (0, 1.0), "principal_distance": (1, 1.0), "principal_point": (2, -1.0), "radial3": (3, 1.0)}
TERMS = tuple(_POWER)
# Line cameras see a few degrees; beyond this an angle is rather in degrees than in radians.
_WIDEST = np.pi / 4
# Determinant of (2) relative to its first product; one part in 1e9 leaves six digits of the sums' rounding.
_SINGULAR = 1e-9


class OrientationError(MeasurementError, ValueError):
    """The readings do not determine what is asked for; the message says what to change."""


def readings(position: ArrayLike, angle: ArrayLike) -> tuple[Array, Array]:
    """L and W as float64 arrays of one shape (..., N), checked.

    Raises OrientationError for sizes that differ, no points, values that are not finite, angles beyond 45 deg.
    """
    where, turned = np.asarray(position, dtype=np.float64), np.asarray(angle, dtype=np.float64)
    if where.ndim == 0 or turned.ndim == 0 or where.shape[-1] != turned.shape[-1]:
        raise OrientationError(
            f"interior orientation: {where.shape} spot positions and {turned.shape} angles; give one angle per spot"
        )
    try:
        where, turned = np.broadcast_arrays(where, turned)
    except ValueError as error:
        raise OrientationError(
            f"interior orientation: sets of spot positions {where.shape} and angles {turned.shape} do not match"
        ) from error
    if where.size == 0:
        raise OrientationError("interior orientation: no points; give at least one angle with its spot position")
    for name, values in (("spot position", where), ("angle", turned)):
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            place = ", ".join(str(k) for k in bad[0])
            raise OrientationError(
                f"interior orientation: {name} [{place}] is not finite ({len(bad)} in all); leave those points out"
            )
    widest = float(np.max(np.abs(turned)))
    if widest > _WIDEST:
        raise OrientationError(
            f"interior orientation: an angle of {np.rad2deg(widest):.6g} deg ({widest:.6g} rad) is beyond 45 deg;"
            " give radians, counted from the direction that images to the centre of the line"
        )
    return where, turned


def distortion(
    position: ArrayLike, angle: ArrayLike, principal_distance: ArrayLike, principal_point: ArrayLike = 0.0
) -> Array:
    """Distortion (..., N), m, of each point: paper 004, eq. (1).

    Raises OrientationError for bad readings.

    Args:
        position: (..., N), m.
        angle: (..., N), rad.
        principal_distance: (...) m, one per set.
        principal_point: likewise.
    """
    where, turned = readings(position, angle)
    t = np.tan(turned)
    f = np.asarray(principal_distance, dtype=np.float64)[..., None]
    p = np.asarray(principal_point, dtype=np.float64)[..., None]
    return np.asarray(where - f * t + p * t**2)


def principal_distance_and_point(position: ArrayLike, angle: ArrayLike) -> tuple[Array, Array]:
    """Principal distance f and point p, each (...), m: paper 004, eq. (2).

    position, angle: (..., N) m, rad, at least two different angles other than zero in each set.
    Raises OrientationError for bad or too few readings and for angles that count against the positions.
    """
    where, turned = readings(position, angle)
    if where.shape[-1] < 2:
        raise OrientationError("interior orientation: 1 angle for the 2 unknowns f and p; measure at more angles")
    t = np.tan(turned)
    t2, t3, t4 = np.sum(t**2, axis=-1), np.sum(t**3, axis=-1), np.sum(t**4, axis=-1)
    lt, lt2 = np.sum(where * t, axis=-1), np.sum(where * t**2, axis=-1)
    determinant = t3**2 - t2 * t4
    if np.any(np.abs(determinant) <= _SINGULAR * t2 * t4):
        raise OrientationError(
            "interior orientation: f and p cannot be separated, for the angles are (nearly) all the same or zero;"
            " turn the turntable between the readings"
        )
    f = (lt2 * t3 - lt * t4) / determinant
    p = (lt2 * t2 - lt * t3) / determinant
    _same_sense(f)
    return np.asarray(f), np.asarray(p)


def principal_distance(position: ArrayLike, angle: ArrayLike) -> Array:
    """Balanced principal distance f (...), m, which leaves the smallest distortion with p = 0: paper 004, eq. (3).

    position, angle: (..., N) m, rad. Raises OrientationError for bad readings, angles that are all zero, and angles
    that count against the positions.
    """
    where, turned = readings(position, angle)
    t = np.tan(turned)
    t2 = np.sum(t**2, axis=-1)
    if np.any(t2 == 0):
        raise OrientationError("interior orientation: all angles are zero and say nothing of f; turn the turntable")
    f = np.sum(where * t, axis=-1) / t2
    _same_sense(f)
    return np.asarray(f)


def principal_point(position: ArrayLike, angle: ArrayLike, principal_distance: ArrayLike) -> Array:
    """Principal point p (...), m, for a known f (...), m: paper 004, eq. (4).

    Raises OrientationError for bad readings and angles that are all zero.

    Args:
        position: (..., N), m.
        angle: (..., N), rad.
        principal_distance: (...), m, one per set.
    """
    where, turned = readings(position, angle)
    t = np.tan(turned)
    t4 = np.sum(t**4, axis=-1)
    if np.any(t4 == 0):
        raise OrientationError("interior orientation: all angles are zero and say nothing of p; turn the turntable")
    f = np.asarray(principal_distance, dtype=np.float64)
    return np.asarray((f * np.sum(t**3, axis=-1) - np.sum(where * t**2, axis=-1)) / t4)


def design(angle: ArrayLike, terms: Sequence[str]) -> Array:
    """dL/d(term) (..., P) at angles (...), rad. Raises OrientationError for unknown or repeated terms."""
    unknown = [term for term in terms if term not in _POWER]
    if unknown or len(set(terms)) != len(terms):
        raise OrientationError(f"interior orientation: terms must be different ones of {TERMS}, found {tuple(terms)}")
    t = np.tan(np.asarray(angle, dtype=np.float64))
    return np.stack([sign * t**power for power, sign in (_POWER[term] for term in terms)], axis=-1)


def slope(angle: ArrayLike, terms: Sequence[str], values: ArrayLike) -> Array:
    """dL/dW (...), m/rad, of the model with these terms and values (P,) at angles (...), rad.

    Args:
        angle: (...), rad.
        terms: names out of `TERMS`.
        values: of the terms, (P,), m.
    """
    t = np.tan(np.asarray(angle, dtype=np.float64))
    powers = [_POWER[term] for term in terms]
    steps = np.stack([sign * power * t ** max(power - 1, 0) for power, sign in powers], axis=-1)
    return np.asarray((steps @ np.asarray(values, dtype=np.float64)) * (1.0 + t**2))


def _same_sense(f: Array) -> None:
    if np.any(f <= 0):
        raise OrientationError(
            f"interior orientation: the principal distance comes out as {float(np.min(f)):.6g} m; angles and spot"
            " positions count in opposite senses, change the sign of one of them"
        )
