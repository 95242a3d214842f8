"""Focal plane fitted to measured defocus, the rigid motion that corrects it, and shims for the motion.

**Plane.** The frame is the assembly's own, O'-X'Y'Z': X' flight direction, Y' along the line CCD, Z' along the normal,
in the direction of the light; O' is the line's centre. The defocus of a position is the distance of the best focus from
the CCD along +Z', so the assembly has to move onto the plane

    defocus = piston + slope_x X' + slope_y Y'.

A small rotation (wx, wy, wz) lifts a point by wx Y' - wy X'; the correction is therefore wx = +slope_y, wy = -slope_x,
the shift (0, 0, piston), and wz = -(measured level of the line). `FocalPlaneFit.correction` is the finite rotation for
which this holds exactly.

**Shims** under a focal-plane assembly (paper 004, Li et al. 2020, section 2). The assembly rests on pads at its
mounting holes. The pads' normal n points from the camera's structure into the assembly, so a thicker shim moves the
assembly along +n. Shims realise the part of a rigid motion that they can: the lift along n and the tilts about axes in
the mounting surface. The rotation about n and the slide in the surface are set by hand, within the clearance of the
screws in their holes.

In an off-axis camera n is inclined against the focal plane's normal Z' by an angle i, and the two parts mix. With the
inclination about X', n = (0, sin i, cos i), and a required tilt w about Y', a rotation of w sin i about n is needed.
Without it, the shims alone give a tilt of w cos^2 i, and the line loses its level by -w sin i cos i; shims that force
the whole tilt without a rotation (another w / cos^2 i) would lose w tan i. A tilt about the axis of the inclination
itself does not mix. `ShimPlan.shims_only` includes these effects.

All quantities are in metres and radians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from analysis import statistics
from analysis.arrays import Array, MeasurementError

_LEAST_SPREAD = 1e-6
"""Smallest spread of the positions in one direction, relative to their largest, that determines a slope."""


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Small rigid motion of the focal-plane assembly: rotation about the line's centre O', then a shift.

    Both are in the assembly's frame O'-X'Y'Z' before the motion.

    Attributes
    ----------
    rotation : (3,) ndarray
        Rotation vector, right-handed, in radians.
    shift : (3,) ndarray
        Shift, in metres.
    covariance : (6, 6) ndarray
        Covariance of rotation and shift together, in rad and m; zero if unknown.
    """

    rotation: Array
    shift: Array
    covariance: Array

    @classmethod
    def of(cls, rotation: ArrayLike, shift: ArrayLike, covariance: ArrayLike | None = None) -> RigidMotion:
        """Return a rigid motion after checking its values.

        Parameters
        ----------
        rotation : (3,) array_like
            Small rotation about X', Y', Z', in radians.
        shift : (3,) array_like
            Shift, in metres.
        covariance : (6, 6) array_like, optional
            Covariance of both, in radians and metres; zero by default.

        Raises
        ------
        ValueError
            A shape is wrong, or a value is not finite.
        """
        rotation_vector, translation = np.asarray(rotation, np.float64), np.asarray(shift, np.float64)
        spread = np.zeros((6, 6)) if covariance is None else np.asarray(covariance, np.float64)
        if rotation_vector.shape != (3,) or translation.shape != (3,) or spread.shape != (6, 6):
            raise ValueError(
                "rigid motion: rotation and shift must be (3,), covariance (6, 6), found"
                f" {rotation_vector.shape}, {translation.shape}, {spread.shape}"
            )
        if not (
            np.all(np.isfinite(rotation_vector)) and np.all(np.isfinite(translation)) and np.all(np.isfinite(spread))
        ):
            raise ValueError("rigid motion: rotation, shift and covariance must be finite")
        return cls(rotation_vector, translation, spread)

    @property
    def matrix(self) -> Array:
        """Rotation matrix (3, 3) of the motion, in the assembly's frame."""
        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix())

    @property
    def line_rotation(self) -> float:
        """Angle by which the motion rotates the line CCD (the Y' axis) about +Z', in radians.

        The rotated line is projected on the X'Y' plane.
        """
        line = self.matrix[:, 1]
        return float(np.arctan2(-line[0], line[1]))

    def moved(self, point: ArrayLike) -> Array:
        """Return the positions of points of the assembly, (..., 3), after the motion, in metres."""
        return np.asarray(np.asarray(point, np.float64) @ self.matrix.T + self.shift)

    def displacement(self, point: ArrayLike) -> Array:
        """Return the displacements of points of the assembly, (..., 3), due to the motion, in metres."""
        return self.moved(point) - np.asarray(point, np.float64)


class ObservabilityError(MeasurementError, ValueError):
    """Error raised for measured positions that do not determine piston and both slopes of the focal plane."""


@dataclass(frozen=True, eq=False)
class LineLevel:
    """Level of the line CCD: its rotation about +Z' out of the Y' axis.

    Attributes
    ----------
    angle : float
        Rotation, right-handed about +Z', in radians.
    sigma : float
        Standard deviation of the angle, in radians.
    """

    angle: float
    sigma: float


@dataclass(frozen=True, eq=False)
class FocalPlaneFit:
    """Weighted plane through the defocus at N positions.

    Attributes
    ----------
    piston : float
        Height of the plane at O', in metres.
    slope_x, slope_y : float
        Slopes of the best focus along +X' and +Y', in radians.
    covariance : (3, 3) ndarray
        Covariance of piston (metres), slope_x and slope_y (radians).
    position : (N, 2) ndarray
        Positions X', Y', in metres.
    residual : (N,) ndarray
        Defocus minus plane, in metres.
    sigma : (N,) ndarray
        A-priori standard deviations of the defocus, in metres.
    chi_square : float
        Chi-square with the a-priori sigmas.
    degrees_of_freedom : int
        Degrees of freedom of the chi-square.
    p_value : float
        p-value of the chi-square, if the best foci lie on a plane and the sigmas are right; 1 without redundancy.
    extra_sigma : float
        Scatter of the positions about the plane beyond their sigmas (chips that are not coplanar, field curvature), in
        metres, for which the weighted chi-square equals the degrees of freedom; 0 if not estimated or not present.
        Weights and all covariances include it.
    """

    piston: float
    slope_x: float
    slope_y: float
    covariance: Array
    position: Array
    residual: Array
    sigma: Array
    chi_square: float
    degrees_of_freedom: int
    p_value: float
    extra_sigma: float

    @property
    def noise_covariance(self) -> Array:
        """Covariance (3, 3) of piston, slope_x, slope_y from the a-priori sigmas alone.

        It describes the scatter of repeated measurements of the same assembly, whose chips keep their heights.
        """
        weight = 1.0 / (self.sigma**2 + self.extra_sigma**2)
        gain = self.covariance @ (_design(self.position) * weight[:, None]).T
        return np.asarray((gain * self.sigma**2) @ gain.T)

    def plane(self, position: ArrayLike) -> tuple[Array, Array]:
        """Return the height of the fitted plane at positions X', Y' (..., 2), and its sigma, both (...), in metres."""
        design = _design(np.asarray(position, np.float64))
        height = design @ np.array([self.piston, self.slope_x, self.slope_y])
        return np.asarray(height), np.sqrt(np.einsum("...i,ij,...j->...", design, self.covariance, design))

    def predicted_defocus(self) -> tuple[Array, Array]:
        """Return the defocus at the N positions predicted after an exact correction, in metres, and its covariance.

        The covariance is (N, N), in m^2.

        True heights are the plane plus independent deviations of extra_sigma. The prediction is the best linear one:
        each residual is multiplied by extra_sigma^2 / (extra_sigma^2 + sigma^2), so it is zero for a true plane, and
        the covariance includes the error of the fitted plane. A measurement after the correction adds its own sigma.
        """
        design = _design(self.position)
        weight = 1.0 / (self.sigma**2 + self.extra_sigma**2)
        hat = design @ self.covariance @ (design.T * weight)
        identity = np.eye(len(weight))
        shrink = (self.extra_sigma**2 * weight)[:, None] * (identity - hat)
        # error = e - hat (e + n) - shrink (e + n) for deviations e and noise n
        gain = -(hat + shrink)
        spread = self.extra_sigma**2 * (identity + gain) @ (identity + gain).T + (gain * self.sigma**2) @ gain.T
        return self.extra_sigma**2 * weight * self.residual, spread

    def correction(self, level: LineLevel | None = None) -> RigidMotion:
        """Return the motion about O' that brings every position to the fitted plane and levels the line.

        The finite rotation first rotates the line by -level about Z' and then tilts the plane about the horizontal
        axis.

        Parameters
        ----------
        level : LineLevel, optional
            Measured level of the line; without it the line's projection on X'Y' keeps its direction to second order
            of the tilt.
        """
        steepness = float(np.hypot(self.slope_x, self.slope_y))
        ratio = np.arctan(steepness) / steepness if steepness > 0 else 1.0
        tilt = Rotation.from_rotvec(ratio * np.array([self.slope_y, -self.slope_x, 0.0]))
        angle, variance = (0.0, 0.0) if level is None else (level.angle, level.sigma**2)
        rotation = tilt * Rotation.from_rotvec([0.0, 0.0, -angle])
        # (wx, wy, wz, x, y, z) from (piston, slope_x, slope_y, level), first order
        map_ = np.zeros((6, 4))
        map_[0, 2], map_[1, 1], map_[2, 3], map_[5, 0] = 1.0, -1.0, -1.0, 1.0
        source = np.zeros((4, 4))
        source[:3, :3], source[3, 3] = self.covariance, variance
        return RigidMotion.of(rotation.as_rotvec(), [0.0, 0.0, self.piston], map_ @ source @ map_.T)


def fit_focal_plane(
    position: ArrayLike, defocus: ArrayLike, sigma: ArrayLike, *, estimate_extra: bool = False
) -> FocalPlaneFit:
    """Fit a plane to the defocus at several positions of a focal plane by weighted least squares.

    Parameters
    ----------
    position : (N, 2) array_like
        Positions X', Y' of N measurements in the focal plane, in metres.
    defocus : (N,) array_like
        Best focus minus detector along +Z', in metres.
    sigma : float or (N,) array_like
        Standard deviations of the defocus, in metres.
    estimate_extra : bool
        True to estimate a common extra scatter if the residuals exceed their sigmas, and to weight with it.

    Returns
    -------
    FocalPlaneFit
        `piston` (metres), `slope_x` and `slope_y` with their `covariance`, residuals, chi-square, and the rigid motion
        that corrects them, `correction`.

    Raises
    ------
    ValueError
        Positions that do not determine both slopes, arrays of other shapes, values that are not finite, or a sigma that
        is not positive.

    Notes
    -----
    The extra scatter follows Paule and Mandel, J. Res. NBS 87, 377 (1982).

    Examples
    --------
    Defocus of six places, from 10 um of piston and 2e-4 of tilt about Y':

    >>> import numpy as np
    >>> import analysis
    >>> place = np.array([[x, y] for x in (-0.02, 0.02) for y in (-0.1, 0.0, 0.1)])
    >>> fit = analysis.fit_focal_plane(place, 10e-6 + 2e-4 * place[:, 0], 1e-6)
    >>> round(fit.piston, 9), round(fit.slope_x, 9), round(abs(fit.slope_y), 9)
    (1e-05, 0.0002, 0.0)
    >>> np.round(np.sqrt(np.diag(fit.covariance)) * 1e6, 2)
    array([ 0.41, 20.41,  5.  ])

    Height and sigma of the plane at the edge:

    >>> height, sigma = fit.plane([0.02, 0.1])
    >>> round(float(height) * 1e6, 3), round(float(sigma) * 1e6, 2)
    (14.0, 0.76)
    """
    spots, height = np.asarray(position, np.float64), np.asarray(defocus, np.float64)
    if spots.ndim != 2 or spots.shape[1] != 2 or height.shape != spots.shape[:1]:
        raise ValueError(
            f"focal plane: position must be (N, 2) and defocus (N,), found {spots.shape} and {height.shape}"
        )
    spread = np.asarray(np.broadcast_to(np.asarray(sigma, np.float64), height.shape))
    if not (np.all(np.isfinite(spots)) and np.all(np.isfinite(height)) and np.all(np.isfinite(spread))):
        raise ValueError("focal plane: position, defocus and sigma must be finite; exclude positions without a focus")
    if not np.all(spread > 0):
        raise ValueError("focal plane: every sigma must be positive")
    _check_positions(spots)
    design = _design(spots)
    freedom = len(height) - 3

    def solve(extra: float) -> tuple[Array, Array, float]:
        """Return parameters, covariance and weighted chi-square of the plane for a given extra scatter, in metres."""
        root = 1.0 / np.sqrt(spread**2 + extra**2)
        inverse = statistics.gain(design * root[:, None])
        parameters = inverse @ (height * root)
        return parameters, inverse @ inverse.T, float(np.sum(((height - design @ parameters) * root) ** 2))

    parameters, covariance, chi_square = solve(0.0)
    extra = 0.0
    if estimate_extra and freedom > 0 and chi_square > freedom:
        # chi-square decreases with the extra scatter and is below the degrees of freedom at this upper bound
        most = float(np.sqrt(np.sum((height - design @ parameters) ** 2) / freedom))
        extra = float(brentq(lambda s: solve(s)[2] - freedom, 0.0, most, xtol=1e-6 * most))
        parameters, covariance, _ = solve(extra)
    return FocalPlaneFit(
        piston=float(parameters[0]),
        slope_x=float(parameters[1]),
        slope_y=float(parameters[2]),
        covariance=covariance,
        position=spots,
        residual=height - design @ parameters,
        sigma=spread,
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        p_value=statistics.p_value(chi_square, freedom),
        extra_sigma=extra,
    )


def _design(position: Array) -> Array:
    """Return the derivatives (1, X', Y') of a plane's height with respect to piston and slopes, (..., 3)."""
    return np.stack([np.ones(position.shape[:-1]), position[..., 0], position[..., 1]], axis=-1)


def _check_positions(position: Array) -> None:
    """Raise ObservabilityError, with the geometric reason, if the positions do not determine both slopes."""
    if len(position) < 3:
        raise ObservabilityError(
            f"focal plane: {len(position)} positions do not determine piston, slope_x, slope_y; measure at least 3"
        )
    offset = position - position.mean(axis=0)
    _, values, axes = np.linalg.svd(offset, full_matrices=False)
    scale = max(float(values[0]), 1e-6 * float(np.max(np.abs(position))))
    if values[-1] > _LEAST_SPREAD * scale:
        return
    if values[0] <= _LEAST_SPREAD * scale:
        raise ObservabilityError("focal plane: all positions coincide and determine neither slope")
    direction = axes[0]
    if abs(direction[0]) < 1e-3:
        where, slope = "X' = constant (the line CCD alone)", "slope_x"
    elif abs(direction[1]) < 1e-3:
        where, slope = "Y' = constant", "slope_y"
    else:
        where, slope = f"one straight line along ({direction[0]:+.3g}, {direction[1]:+.3g})", "the slope across it"
    raise ObservabilityError(
        f"focal plane: all positions lie on {where} and do not determine {slope}; measure another band as well or move"
        " some of them off that line"
    )


_LEAST_WIDTH = 1e-3
"""Smallest spread of the holes, relative to their largest, that supports a tilt: 0.3 mm in 0.3 m."""


class ShimError(MeasurementError, ValueError):
    """Error raised for a motion that cannot be realised with this mount and these shims.

    Attributes
    ----------
    holes : tuple of int
        Indices of the holes at fault, empty for the mount as a whole. The message counts them from 1.
    slides : tuple of float
        Displacements of these holes, in metres; empty if these are not the reason.
    """

    def __init__(self, message: str, holes: tuple[int, ...] = (), slides: tuple[float, ...] = ()) -> None:
        super().__init__(message)
        self.holes = holes
        self.slides = slides


@dataclass(frozen=True, eq=False)
class Mount:
    """Mounting of a focal-plane assembly on the pads at its screw holes, where shims are inserted.

    Attributes
    ----------
    holes : (H, 3) ndarray
        Centres of the H pads in the assembly's frame O'-X'Y'Z', in metres.
    normal : (3,) ndarray
        Unit vector from the structure into the assembly.
    clearance : float
        Largest slide of a hole against its screw, a radius in metres.
    step : float
        Resolution to which the workshop grinds shims, in metres.
    """

    holes: Array
    normal: Array
    clearance: float
    step: float

    @classmethod
    def of(cls, holes: ArrayLike, normal: ArrayLike, clearance: float, step: float) -> Mount:
        """Return a validated mount with a normal of unit length.

        Parameters
        ----------
        holes : (H, 3) array_like
            Centres of the H pads in the assembly's frame O'-X'Y'Z', in metres.
        normal : (3,) array_like
            Direction from the structure into the assembly, of any length.
        clearance : float
            Largest slide of a hole against its screw, a radius in metres.
        step : float
            Resolution to which the workshop grinds shims, in metres.

        Raises
        ------
        ShimError
            The holes cannot support a tilt.
        ValueError
            Other input is invalid.
        """
        pads, unit_normal = np.asarray(holes, np.float64), np.asarray(normal, np.float64)
        if pads.ndim != 2 or pads.shape[1] != 3 or unit_normal.shape != (3,):
            raise ValueError(f"mount: holes must be (H, 3) and normal (3,), found {pads.shape} and {unit_normal.shape}")
        length = float(np.linalg.norm(unit_normal))
        if not (np.all(np.isfinite(pads)) and np.isfinite(length) and length > 0):
            raise ValueError("mount: holes must be finite and the normal a finite vector other than zero")
        if not (0 <= clearance < np.inf and 0 < step < np.inf):
            raise ValueError(f"mount: clearance {clearance} must not be negative and step {step} must be positive")
        if len(pads) < 3:
            raise ShimError(f"mount: {len(pads)} holes do not fix a plane; at least three are needed")
        unit_normal = unit_normal / length
        offset = pads - pads.mean(axis=0)
        spread = np.linalg.svd(offset - np.outer(offset @ unit_normal, unit_normal), compute_uv=False)
        if spread[1] <= _LEAST_WIDTH * spread[0] or spread[0] == 0:
            raise ShimError(
                "mount: the holes lie on one line (seen along the normal), so shims cannot tilt the assembly about it;"
                " add a hole off that line"
            )
        return cls(pads, unit_normal, float(clearance), float(step))


@dataclass(frozen=True, eq=False)
class ShimPlan:
    """Shims to grind, adjustments by hand, and the resulting motion.

    Attributes
    ----------
    mount : Mount
        Mounting of the assembly.
    wanted : RigidMotion
        Required motion.
    change : (H,) ndarray
        Exact change of the shim's thickness at each of the H holes, in metres; positive is thicker.
    change_covariance : (H, H) ndarray
        Covariance of the changes from that of the required motion, without rounding, in m^2.
    rounded_change : (H,) ndarray
        Changes that are ground, in metres.
    thickness : (H,) ndarray
        Thicknesses of the new shims, multiples of the step, in metres.
    slide : (H, 3) ndarray
        Displacement of each hole in the mounting surface that is set by hand, in metres.
    rotation : float
        Rotation about the normal that is set by hand, right-handed, in radians; the twist of the required rotation.
    achieved : RigidMotion
        Motion with the rounded shims and the required rotation and slide; with more than three holes, that of the plane
        that fits the pads best.
    shims_only : RigidMotion
        Motion *without* rotation and slide, with the holes' centre moving only along the normal.
    """

    mount: Mount
    wanted: RigidMotion
    change: Array
    change_covariance: Array
    rounded_change: Array
    thickness: Array
    slide: Array
    rotation: float
    achieved: RigidMotion
    shims_only: RigidMotion

    @property
    def change_sigma(self) -> Array:
        """Standard deviations of the exact changes of thickness at the H holes, (H,), in metres."""
        return np.sqrt(np.diag(self.change_covariance))

    @property
    def level_coupling(self) -> float:
        """Rotation of the line about +Z' that remains if shims alone are used, in radians."""
        return self.shims_only.line_rotation - self.wanted.line_rotation

    def focus_error(self, position: ArrayLike) -> Array:
        """Return the defocus that remains at positions (..., 2) because shims are rounded, in metres.

        It is the focus minus the CCD along +Z'.
        """
        spots = np.asarray(position, np.float64)
        point = np.concatenate([spots, np.zeros((*spots.shape[:-1], 1))], axis=-1)
        return np.asarray((self.wanted.moved(point) - self.achieved.moved(point))[..., 2])


def shim_plan(correction: RigidMotion, mount: Mount, present: ArrayLike) -> ShimPlan:
    """Return the shims that realise a rigid motion of the assembly about O'.

    A hole that moves by d needs n . d more shim; the rest of d lies in the mounting surface.

    Parameters
    ----------
    correction : RigidMotion
        Required motion, for example `FocalPlaneFit.correction()`.
    mount : Mount
        Mounting of the assembly.
    present : float or (H,) array_like
        Present thickness of the shims, in metres: one value, or one for each of H holes.

    Raises
    ------
    ShimError
        A hole would slide beyond its clearance, or a shim would have a negative thickness.
    ValueError
        A thickness is not finite.
    """
    normal, holes = mount.normal, mount.holes
    displacement = correction.displacement(holes)
    change = displacement @ normal
    slide = displacement - np.outer(change, normal)
    _check_clearance(slide, mount.clearance)
    present_thickness = np.asarray(np.broadcast_to(np.asarray(present, np.float64), change.shape))
    if not np.all(np.isfinite(present_thickness)):
        raise ValueError("shims: the present thicknesses must be finite")
    thickness = np.round((present_thickness + change) / mount.step) * mount.step
    _check_thickness(thickness, present_thickness, mount.step)
    rounded = thickness - present_thickness
    # change = (r x n) . rotation + n . shift to first order
    slope = np.concatenate([np.cross(holes, normal), np.broadcast_to(normal, holes.shape)], axis=1)
    # Twist of the rotation about n (swing-twist decomposition of its quaternion).
    quaternion = Rotation.from_rotvec(correction.rotation).as_quat()
    twist = 2 * float(np.arctan2(quaternion[:3] @ normal, quaternion[3]))
    achieved = _seated(correction, mount, rounded)
    centre = holes.mean(axis=0)
    untwisted = Rotation.from_rotvec(correction.rotation) * Rotation.from_rotvec(-twist * normal)
    lifted = centre + normal * float(np.mean(change))
    start = RigidMotion.of(untwisted.as_rotvec(), lifted - untwisted.apply(centre))
    return ShimPlan(
        mount=mount,
        wanted=correction,
        change=change,
        change_covariance=slope @ correction.covariance @ slope.T,
        rounded_change=rounded,
        thickness=thickness,
        slide=slide,
        rotation=twist,
        achieved=achieved,
        shims_only=_seated(start, mount, change),
    )


def _seated(motion: RigidMotion, mount: Mount, change: Array) -> RigidMotion:
    """Return the motion after the assembly has settled on H shims changed by `change`, in metres.

    It is the nearest motion whose holes rise by `change` in the least-squares sense. The assembly settles by tilts
    about axes in the mounting surface through the holes' centre and a lift along the normal, so rotation and slide stay
    the same.
    """
    up = mount.normal
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first = first / np.linalg.norm(first)
    second = np.cross(up, first)
    rotation, shift = Rotation.from_rotvec(motion.rotation), motion.shift
    # The first step is accurate to a few 1e-6 of itself, the next ones to rounding.
    for _ in range(3):
        positions = rotation.apply(mount.holes) + shift
        misfit = change - (positions - mount.holes) @ up
        centre = positions.mean(axis=0)
        offset = positions - centre
        # a tilt by (a, b) about (first, second) lifts a hole by a (second . arm) - b (first . arm)
        design = np.stack([offset @ second, -(offset @ first), np.ones(len(offset))], axis=1)
        step = np.linalg.lstsq(design, misfit, rcond=None)[0]
        tilt = Rotation.from_rotvec(step[0] * first + step[1] * second)
        rotation, shift = tilt * rotation, tilt.apply(shift - centre) + centre + step[2] * up
    return RigidMotion.of(rotation.as_rotvec(), shift)


def _check_clearance(slide: Array, clearance: float) -> None:
    """Raise ShimError, naming the holes and their slides, if holes would slide beyond the clearance."""
    size = np.linalg.norm(slide, axis=1)
    beyond = np.flatnonzero(size > clearance)
    if not beyond.size:
        return
    text = ", ".join(f"hole {h + 1} by {1e3 * size[h]:.4g} mm" for h in beyond)
    raise ShimError(
        f"shims: the motion would slide {text}; the screws allow {1e3 * clearance:.4g} mm, which is"
        f" {1e3 * (size.max() - clearance):.4g} mm too little; widen the holes by as much",
        tuple(int(h) for h in beyond),
        tuple(float(size[h]) for h in beyond),
    )


def _check_thickness(thickness: Array, now: Array, step: float) -> None:
    """Raise ShimError, naming the holes and a remedy, if shims would have a negative thickness."""
    thin = np.flatnonzero(thickness < -1e-9 * step)
    if not thin.size:
        return
    text = ", ".join(f"hole {h + 1} would get {1e3 * thickness[h]:.4g} mm" for h in thin)
    short = step * float(np.ceil(np.max(-thickness) / step - 1e-9))
    raise ShimError(
        f"shims: {text}; move the seat back and start from shims that are"
        f" {1e3 * short:.4g} mm thicker at all holes, {1e3 * (float(now.max()) + short):.4g} mm at the thickest",
        tuple(int(h) for h in thin),
    )
