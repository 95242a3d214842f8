"""Readings of a digital autocollimator, and the relations between two of them that paper 001 tests.

The relations are those of the principle experiment (Wang et al. 2018, section 3.1, Table 2).

An autocollimator measures two angles of a plane mirror, the rotations of its normal about the instrument's own X and Y
(Z is its viewing direction, X up). A rotation of the mirror about its own normal does not change the returned beam. Two
autocollimators view two mirrors that are b = 2 theta apart on one turntable; frame 2 is frame 1 rotated about X by b,
so that

    Y1 = Y2 cos b - Z2 sin b,    Z1 = Y2 sin b + Z2 cos b,

and a rotation of the table by a small angle reads

- by d_beta about X1: d_beta about X1 at mirror 1, d_beta about X2 at mirror 2;
- by d_alpha about Y1: d_alpha about Y1 at mirror 1, d_alpha cos b about Y2 at mirror 2;
- by d_gamma about Z1: nothing at mirror 1, d_gamma sin b about Y2 at mirror 2.

The paper prints the same factors with "beta" for b, but calls the last one a rotation of mirror 2 "about its own Z".
That rotation is d_gamma cos b and cannot be measured; the one that is d_gamma sin b, and that the autocollimator reads,
is the rotation about Y2. The paper also prints readings of mirror 1 about Z, which do not exist.

Angles are in radians. A reading is (about X, about Y) = (atan(n_y / -n_z), atan(-n_x / -n_z)) of the mirror's normal n
in the autocollimator's frame; a rotation about X alone or about Y alone reads exactly as itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, UndeterminedError

AXES = ("X", "Y", "Z")


def mirror_rotation(shift_m: ArrayLike, focal_length_m: float) -> Array:
    """Return a mirror's rotation, rad, from its spot's shift, m, by eq. (1) of paper 001 (Wang et al. 2018)."""
    return np.asarray(0.5 * np.arctan(np.asarray(shift_m, np.float64) / focal_length_m))


def reading_of_normal(normal: ArrayLike) -> Array:
    """Return the autocollimator's readings for unit normals of the mirror.

    Readings (..., 2) are the angles about X and about Y, rad; normals (..., 3) are in the instrument's frame, and the
    normal (0, 0, -1) reads zero.
    """
    n = np.asarray(normal, np.float64)
    return np.stack([np.arctan2(n[..., 1], -n[..., 2]), np.arctan2(-n[..., 0], -n[..., 2])], axis=-1)


def column_component(axis: str) -> int:
    """Return which component of the readings Table 2 lists for a rotation about an axis: 0 about X, 1 about Y.

    Table 2 of paper 001 (Wang et al. 2018) compares the readings of two autocollimators that view mirrors on one
    turntable. For the axis Z it is 1: mirror 2 rotates about its own Y.
    """
    if axis not in AXES:
        raise ValueError(f"readings: axis must be X, Y or Z, found {axis!r}")
    return 0 if axis == "X" else 1


def relation_factor(axis: str, unit: int, between: float) -> float:
    """Return the factor from a small rotation of the turntable to the reading of autocollimator 1 or 2.

    Parameters
    ----------
    axis : str
        Axis X, Y or Z of frame 1.
    unit : int
        Autocollimator, 1 or 2.
    between : float
        Angle between the viewing directions of the two autocollimators, rad.
    """
    if axis not in AXES or unit not in (1, 2):
        raise ValueError(f"relations: axis must be X, Y or Z and unit 1 or 2, found {axis!r} and {unit!r}")
    if unit == 1:
        return 0.0 if axis == "Z" else 1.0
    return {"X": 1.0, "Y": float(np.cos(between)), "Z": float(np.sin(between))}[axis]


def exact_reading(axis: str, angle: ArrayLike, unit: int, between: float) -> Array:
    """Return the exact readings of one autocollimator, (..., 2) rad, for rotations of the turntable by any angle.

    The two mirrors are perpendicular to their autocollimators at first.

    With u the axis and a the angle of the rotation in the autocollimator's frame, n0 the mirror's first normal and b
    the angle between the autocollimators, the normal becomes n = n0 cos a + (u x n0) sin a + u (u . n0)(1 - cos a), n0
    = -Z. The difference from the first-order relations (`relation_factor`) is, about Y2, a relative -sin^2(b) a^2 / 6
    for a rotation about Y1 (-cos^2(b) a^2 / 6 about Z1), 0.0003" at 720"; about X2, a second-order term of size sin(b)
    cos(b) a^2 / 2, 0.54" at 720" and 30 or 60 deg.

    Parameters
    ----------
    axis : str
        Axis of the rotation: X, Y or Z of frame 1.
    angle : array_like
        Angles, rad.
    unit : int
        Autocollimator, 1 or 2.
    between : float
        Angle b between the two autocollimators, rad.
    """
    a = np.asarray(angle, np.float64)
    b = between if unit == 2 else 0.0
    relation_factor(axis, unit, between)  # checks the names
    u = {
        "X": np.array([1.0, 0.0, 0.0]),
        "Y": np.array([0.0, np.cos(b), -np.sin(b)]),
        "Z": np.array([0.0, np.sin(b), np.cos(b)]),
    }[axis]
    n0 = np.array([0.0, 0.0, -1.0])
    # 1 - cos a without cancellation
    versine = 2.0 * np.sin(0.5 * a) ** 2
    return reading_of_normal(
        n0 + np.sin(a)[..., None] * np.cross(u, n0) + versine[..., None] * (u * float(u @ n0) - n0)
    )


def mean_difference(first: ArrayLike, second: ArrayLike) -> float:
    """Return the mean absolute difference of two columns of readings.

    The last line of Table 2 of paper 001 (Wang et al. 2018) is this number.

    About X and Y that line compares the reading of mirror 1 with the scaled reading of mirror 2; about Z, however, the
    scaled reading of mirror 2 with the *turntable's* angle.
    """
    return float(np.mean(np.abs(np.asarray(first, np.float64) - np.asarray(second, np.float64))))


@dataclass(frozen=True, eq=False)
class ReadingMap:
    """Calibration of an autocollimator: polynomial from the position of its spot to the reading.

    The lens images f tan(2 theta) only to first order: it distorts by some 1e-4. As manufacturers do, the map is
    determined once by rotating a mirror by known angles, and is used from then on. (f is the focal length, theta the
    rotation of the mirror.)

    Attributes
    ----------
    centre : (2,) ndarray
        Origin (row, column) of the polynomial, px.
    scale : float
        Half range of the spots, px.
    degree : int
        Largest sum of the exponents of row and column.
    coefficients : (terms, 2) ndarray
        Coefficients of the rotations about X and about Y, rad, for each product of powers of row and column.
    residual : float
        Rms residual of the calibration, rad.
    """

    centre: Array
    scale: float
    degree: int
    coefficients: Array
    residual: float

    @classmethod
    def fit(cls, position: ArrayLike, reading: ArrayLike, degree: int = 5) -> ReadingMap:
        """Fit the polynomial map from spot positions to readings by least squares over P known rotations.

        Parameters
        ----------
        position : (P, 2) array_like
            Positions of the spot (row, column), px.
        reading : (P, 2) array_like
            Known rotations about X and about Y, rad.
        degree : int
            Degree of the polynomials.

        Raises
        ------
        ValueError
            There are too few rotations.
        """
        spots, readings = np.asarray(position, np.float64), np.asarray(reading, np.float64)
        if spots.ndim != 2 or spots.shape[1] != 2 or readings.shape != spots.shape:
            raise ValueError(f"reading map: position {spots.shape} and reading {readings.shape} must both be (P, 2)")
        centre = 0.5 * (spots.min(axis=0) + spots.max(axis=0))
        scale = float(np.max(np.abs(spots - centre)))
        design = _monomials((spots - centre) / max(scale, 1e-300), degree)
        solution, _, rank, _ = np.linalg.lstsq(design, readings, rcond=None)
        if rank < design.shape[1]:
            raise UndeterminedError(f"reading map: {len(spots)} spots do not settle a polynomial of degree {degree}")
        rms = float(np.sqrt(np.mean((design @ solution - readings) ** 2)))
        return cls(centre, scale, degree, np.asarray(solution, dtype=np.float64), rms)

    def __call__(self, position: ArrayLike) -> Array:
        """Return the rotations of the mirror about X and Y, (..., 2) rad, for spot positions (row, column) in px."""
        reduced = (np.asarray(position, np.float64) - self.centre) / self.scale
        return np.asarray(_monomials(reduced, self.degree) @ self.coefficients)

    def slope(self, position: ArrayLike) -> Array:
        """Return the derivatives of both angles with respect to the spot's row and column, (..., 2, 2) rad/px."""
        spot = np.asarray(position, np.float64)
        step = 0.5 * np.eye(2)
        return np.stack([self(spot + step[k]) - self(spot - step[k]) for k in range(2)], axis=-1)

    def covariance(self, position: ArrayLike, spot_covariance: ArrayLike) -> Array:
        """Return the covariance of the two angles read, (..., 2, 2) rad^2, from that of the spot's position in px^2.

        ``position`` is the spot's row and column, (..., 2) px, and ``spot_covariance`` the covariance of both, (..., 2,
        2) px^2.
        """
        slope = self.slope(position)
        return np.asarray(slope @ np.asarray(spot_covariance, np.float64) @ np.swapaxes(slope, -1, -2))


def _monomials(spot: Array, degree: int) -> Array:
    """Return all products row^i column^j with i + j up to a degree, for spot positions (..., 2): (..., terms)."""
    row, column = spot[..., 0], spot[..., 1]
    return np.stack([row**i * column**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)
