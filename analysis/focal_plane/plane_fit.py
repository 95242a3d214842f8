"""From the defocus at many places to the rigid motion that brings a focal-plane assembly into focus.

The frame is the assembly's own, O'-X'Y'Z': X' flight direction, Y' along the line CCD, Z' along the normal, with the
light; O' is the line's centre. The defocus of a place is how far the best focus lies from the CCD along +Z', so the
assembly has to move onto the plane

    defocus = piston + slope_x X' + slope_y Y'.

A small rotation (wx, wy, wz) lifts a point by wx Y' - wy X'; the correction is therefore wx = +slope_y,
wy = -slope_x, the shift (0, 0, piston), and wz = -(measured level of the line). `FocalPlaneFit.correction` is the
finite rotation for which this holds exactly. Metres and radians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError

# Two directions are told apart when the places spread across them by more than this part of their largest spread.
_LEAST_SPREAD = 1e-6


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Rotation about O' and then a shift, both in the frame from before the motion.

    rotation: (3,) rotation vector, radians, right-handed. shift: (3,) metres.
    covariance: (6, 6) of rotation and shift together, rad and m; zero when nothing is known of it.
    """

    rotation: Array
    shift: Array
    covariance: Array

    @classmethod
    def of(cls, rotation: ArrayLike, shift: ArrayLike, covariance: ArrayLike | None = None) -> RigidMotion:
        """The motion, with its input checked. Raises ValueError for wrong shapes or numbers that are not finite.

        Args:
            rotation: small, about X', Y', Z', (3,), radians.
            shift: (3,), metres.
            covariance: (6, 6) of both, radians and metres; exact by default.
        """
        turn, move = np.asarray(rotation, np.float64), np.asarray(shift, np.float64)
        spread = np.zeros((6, 6)) if covariance is None else np.asarray(covariance, np.float64)
        if turn.shape != (3,) or move.shape != (3,) or spread.shape != (6, 6):
            raise ValueError(
                "rigid motion: rotation and shift must be (3,), covariance (6, 6), found"
                f" {turn.shape}, {move.shape}, {spread.shape}"
            )
        if not (np.all(np.isfinite(turn)) and np.all(np.isfinite(move)) and np.all(np.isfinite(spread))):
            raise ValueError("rigid motion: rotation, shift and covariance must be finite")
        return cls(turn, move, spread)

    @property
    def matrix(self) -> Array:
        """(3, 3) rotation matrix."""
        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix())

    @property
    def line_turn(self) -> float:
        """Angle, radians, by which the projection of the line CCD (the Y' axis) turns in the X'Y' plane, about +Z'."""
        line = self.matrix[:, 1]
        return float(np.arctan2(-line[0], line[1]))

    def moved(self, point: ArrayLike) -> Array:
        """Points (..., 3), metres, after the motion."""
        return np.asarray(np.asarray(point, np.float64) @ self.matrix.T + self.shift)

    def displacement(self, point: ArrayLike) -> Array:
        """How far points (..., 3) go, metres."""
        return self.moved(point) - np.asarray(point, np.float64)


class ObservabilityError(MeasurementError, ValueError):
    """The places measured cannot tell one of the rotations."""


@dataclass(frozen=True, eq=False)
class LineLevel:
    """Level of the line CCD: its rotation about +Z' out of the Y' axis.

    Attributes:
        angle: radians, right-handed about +Z'.
        sigma: standard deviation of the angle, radians.
    """

    angle: float
    sigma: float


@dataclass(frozen=True, eq=False)
class FocalPlaneFit:
    """A weighted plane through the defocus of N places.

    Attributes:
        piston: metres.
        slope_x, slope_y: rises of the best focus along +X' and +Y', radians.
        covariance: of piston, slope_x and slope_y, (3, 3).
        place: (N, 2), metres.
        residual: defocus minus plane, (N,), metres.
        sigma: of the defocus as given, (N,), metres.
        chi_square, degrees_of_freedom: with the sigmas as given.
        p_value: chance of such a chi-square or a larger one, if the best foci lie on a plane and the sigmas are right;
            1 without redundancy.
        extra_sigma: scatter of the places about the plane beyond their sigmas (chips that are not coplanar, curvature
            of field), metres, for which the weighted chi-square equals the degrees of freedom; 0 when it was not asked
            for or is not there. The weights and all covariances include it.
    """

    piston: float
    slope_x: float
    slope_y: float
    covariance: Array
    place: Array
    residual: Array
    sigma: Array
    chi_square: float
    degrees_of_freedom: int
    p_value: float
    extra_sigma: float

    @property
    def noise_covariance(self) -> Array:
        """(3, 3) of piston, slope_x, slope_y from the places' own sigmas alone.

        How much another measurement of the same assembly would scatter: chips that are not coplanar stay as they are.
        """
        weight = 1.0 / (self.sigma**2 + self.extra_sigma**2)
        gain = self.covariance @ (_design(self.place) * weight[:, None]).T
        return np.asarray((gain * self.sigma**2) @ gain.T)

    def plane(self, place: ArrayLike) -> tuple[Array, Array]:
        """Height (...) of the fitted plane at places (..., 2), and its sigma (...); metres."""
        design = _design(np.asarray(place, np.float64))
        height = design @ np.array([self.piston, self.slope_x, self.slope_y])
        return np.asarray(height), np.sqrt(np.einsum("...i,ij,...j->...", design, self.covariance, design))

    def predicted_defocus(self) -> tuple[Array, Array]:
        """What defocus the places will really have after an exact correction: (N,) metres, and (N, N) covariance.

        True heights are the plane plus independent deviations of extra_sigma. The prediction is the best linear one:
        each residual shrunk by extra_sigma^2 / (extra_sigma^2 + sigma^2), so zero for a true plane, and the covariance
        has what the plane was misjudged by. A measurement afterwards adds its own sigma.
        """
        design = _design(self.place)
        weight = 1.0 / (self.sigma**2 + self.extra_sigma**2)
        hat = design @ self.covariance @ (design.T * weight)
        own = np.eye(len(weight))
        shrink = (self.extra_sigma**2 * weight)[:, None] * (own - hat)
        # error = e - hat (e + n) - shrink (e + n) for deviations e and noise n
        gain = -(hat + shrink)
        spread = self.extra_sigma**2 * (own + gain) @ (own + gain).T + (gain * self.sigma**2) @ gain.T
        return self.extra_sigma**2 * weight * self.residual, spread

    def correction(self, level: LineLevel | None = None) -> RigidMotion:
        """The motion of the assembly about O' that puts every place on the fitted plane and levels the line.

        level: the measured level of the line; without it the line's projection on X'Y' keeps its direction to second
            order of the tilt.
        The finite rotation first turns the line by -level about Z' and then tilts the plane about the horizontal axis.
        """
        steepness = float(np.hypot(self.slope_x, self.slope_y))
        ratio = np.arctan(steepness) / steepness if steepness > 0 else 1.0
        tilt = Rotation.from_rotvec(ratio * np.array([self.slope_y, -self.slope_x, 0.0]))
        angle, variance = (0.0, 0.0) if level is None else (level.angle, level.sigma**2)
        turn = tilt * Rotation.from_rotvec([0.0, 0.0, -angle])
        # (wx, wy, wz, x, y, z) from (piston, slope_x, slope_y, level), first order
        map_ = np.zeros((6, 4))
        map_[0, 2], map_[1, 1], map_[2, 3], map_[5, 0] = 1.0, -1.0, -1.0, 1.0
        source = np.zeros((4, 4))
        source[:3, :3], source[3, 3] = self.covariance, variance
        return RigidMotion.of(turn.as_rotvec(), [0.0, 0.0, self.piston], map_ @ source @ map_.T)


def fit_focal_plane(
    place: ArrayLike, defocus: ArrayLike, sigma: ArrayLike, *, estimate_extra: bool = False
) -> FocalPlaneFit:
    """Weighted least-squares plane through the defocus of N places.

    Args:
        place: (N, 2) X', Y', metres.
        defocus: (N,) metres, best focus minus CCD along +Z'.
        sigma: (N,) or a number, metres.
        estimate_extra: when the residuals are larger than the sigmas say, estimate a common extra scatter (Paule and
            Mandel, J. Res. NBS 87, 377 (1982)) and weight with it; see FocalPlaneFit.extra_sigma.

    Raises:
        ObservabilityError: the places lie so that a slope cannot be told.
        ValueError: wrong shapes, numbers that are not finite, a sigma that is not positive.
    """
    spots, height = np.asarray(place, np.float64), np.asarray(defocus, np.float64)
    if spots.ndim != 2 or spots.shape[1] != 2 or height.shape != spots.shape[:1]:
        raise ValueError(f"focal plane: place must be (N, 2) and defocus (N,), found {spots.shape} and {height.shape}")
    spread = np.asarray(np.broadcast_to(np.asarray(sigma, np.float64), height.shape))
    if not (np.all(np.isfinite(spots)) and np.all(np.isfinite(height)) and np.all(np.isfinite(spread))):
        raise ValueError("focal plane: place, defocus and sigma must be finite; leave out places without a focus")
    if not np.all(spread > 0):
        raise ValueError("focal plane: every sigma must be positive")
    _check_places(spots)
    design = _design(spots)
    freedom = len(height) - 3

    def solve(extra: float) -> tuple[Array, Array, float]:
        """Parameters, covariance and weighted chi-square with an extra scatter."""
        root = 1.0 / np.sqrt(spread**2 + extra**2)
        length = np.linalg.norm(design * root[:, None], axis=0)
        inverse = np.linalg.pinv(design * root[:, None] / length) / length[:, None]
        found = inverse @ (height * root)
        return found, inverse @ inverse.T, float(np.sum(((height - design @ found) * root) ** 2))

    found, covariance, chi_square = solve(0.0)
    extra = 0.0
    if estimate_extra and freedom > 0 and chi_square > freedom:
        # chi-square falls with the extra scatter; with this much of it, it is below the degrees of freedom for sure
        most = float(np.sqrt(np.sum((height - design @ found) ** 2) / freedom))
        extra = float(brentq(lambda s: solve(s)[2] - freedom, 0.0, most, xtol=1e-6 * most))
        found, covariance, _ = solve(extra)
    return FocalPlaneFit(
        piston=float(found[0]),
        slope_x=float(found[1]),
        slope_y=float(found[2]),
        covariance=covariance,
        place=spots,
        residual=height - design @ found,
        sigma=spread,
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        p_value=float(chi2.sf(chi_square, freedom)) if freedom > 0 else 1.0,
        extra_sigma=extra,
    )


def _design(place: Array) -> Array:
    """Columns 1, X', Y', (..., 3)."""
    return np.stack([np.ones(place.shape[:-1]), place[..., 0], place[..., 1]], axis=-1)


def _check_places(place: Array) -> None:
    """ObservabilityError when the places do not determine both slopes, with the reason in terms of where they lie."""
    if len(place) < 3:
        raise ObservabilityError(
            f"focal plane: {len(place)} places cannot tell piston, slope_x, slope_y; measure at least 3"
        )
    arm = place - place.mean(axis=0)
    _, values, axes = np.linalg.svd(arm, full_matrices=False)
    scale = max(float(values[0]), 1e-6 * float(np.max(np.abs(place))))
    if values[-1] > _LEAST_SPREAD * scale:
        return
    if values[0] <= _LEAST_SPREAD * scale:
        raise ObservabilityError("focal plane: all places are one; neither slope can be told")
    direction = axes[0]
    if abs(direction[0]) < 1e-3:
        where, slope = "X' = constant (the line CCD alone)", "slope_x"
    elif abs(direction[1]) < 1e-3:
        where, slope = "Y' = constant", "slope_y"
    else:
        where, slope = f"one straight line along ({direction[0]:+.3g}, {direction[1]:+.3g})", "the slope across it"
    raise ObservabilityError(
        f"focal plane: all places lie on {where}, so {slope} cannot be told; measure another band as well or place some"
        " of them off that line"
    )
