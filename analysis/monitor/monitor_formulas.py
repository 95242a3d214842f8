"""Formulas of paper 001: camera parameters from spot shifts, change of the intersection angle, ground errors.

Paper 001 is Wang et al., Acta Photonica Sinica 47(10) 1012001, 2018.

**Camera parameters.** Axes: the column direction of an area CCD is the paper's x (flight direction), the row direction
its y (along the line CCD). Sides: index 0 = left CCD (at the +Y end of the line, index 1 of the paper), 1 = right CCD
(index 2 of the paper). A shift is after - before; the paper's X_L = x01 - x11 and Y_L = y01 - y11 are before - after.
Vector of pixel coordinates: [left row, left column, right row, right column]. Vector of parameters: [d_alpha, d_beta,
d_gamma (rad), d_f (m)].

There are three sets of formulas, which differ only where the paper is inconsistent:

- `paper_single`: eq. (2), (3), (5), (7) as printed, with the arctangent.
- `paper_joint`: Table 1, "expression of uncertain changes", as printed. The table does not define the sign of Y_L, and
  uses it in both d_beta and d_f; each row here takes the sign that agrees with the single-change formula beside it: Y_L
  = y01 - y11 for d_beta, Y_L = y11 - y01 for d_f. Its d_f is then +1/2 of eq. (7), and its d_gamma equals eq. (5).
- `derived`: the response of a plane-mirror return to first order. A shift s of the focal plane moves the spot by 2 s
  against it, so d_alpha and d_beta are shift/(2f) without the cos^2 (which is a field-angle factor of the line of
  sight, not of the spot); d_gamma = (X_L - X_R) delta / (2 L), half of the printed (5); d_f by (7). A field-biased
  camera adds three calibrated numbers: its plate scale across the line f_x (d_alpha divides by it, d_gamma carries
  f/f_x) and the gradients of principal distance and of line tilt over the field, which enter d_f by d_alpha and d_gamma
  by d_beta. With f_x = f and no gradients the formulas are those of a distortion-free camera.

**Intersection angle.** The change of the angle between the lines of sight of two cameras follows from the readings of
their monitors (paper 001, Fig. 4). Each camera is mounted in the base frame at a look angle: a rotation about Y,
positive toward +X (forward). Its line of sight rotates in its own frame by the rotation vector (d_beta about X, d_alpha
about Y, 0); d_gamma rotates about the line of sight and leaves it unchanged. To first order only the rotation about the
common axis Y counts: change = d_alpha_forward - d_alpha_backward, where "forward" is the camera of the larger look
angle. Unless the covariance between the two cameras is given, their errors are taken as independent.

**Errors on the ground.** Points are located with a stereo pair's cameras as they were before the change. Both cameras
fly along one circular orbit over a sphere, look down along the track at their look angles, and see a point one after
the other; attitude and orbit are known. A ray at the look angle a meets the ground at the incidence i, R sin i = (R +
h) sin a, after the slant range R sin(i - a) / sin a. A changed camera's ray is the nominal one rotated and, off the
line's middle, scaled by the change of its principal distance; the point is located where both rays are nearest to each
other (least squares of the distances). Axes on the ground: along the track, across it (to the right), up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import ARCSEC, UM_PER_M, Array, StateArrays, UndeterminedError, shows

FORMULAS = ("paper_single", "paper_joint", "derived")
PARAMETERS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
"""Names of the four parameters of a camera in files of results; each ends in the parameter's unit."""
PER_SI = np.array([1 / ARCSEC, 1 / ARCSEC, 1 / ARCSEC, UM_PER_M])
"""Number of the units arcsec, arcsec, arcsec, um in one SI unit (rad, m), for the four parameters."""


@shows("principal_distance_m [m]", "separation_m [mm]", "pitch_m [um]", "field_alpha_rad [deg]", "field_beta_rad [deg]")
@dataclass(frozen=True)
class MonitorGeometry:
    """Geometry of one camera's monitor for the formulas.

    Attributes
    ----------
    principal_distance_m : float
        Principal distance f, m.
    separation_m : float
        Distance L of the two area CCDs, m.
    pitch_m : float
        Pixel pitch delta, m.
    field_alpha_rad, field_beta_rad : float
        Angles alpha and beta in the cos^2 of (2), (3) and Table 1, rad.
    principal_distance_across_m : float or None
        Plate scale across the line, m, where calibration finds it different from f (anamorphism); default
        `principal_distance_m`. Only `derived` uses it.
    d_f_per_alpha_m : float
        Change of the principal distance per rad of d_alpha, m, from the calibrated distortion: a rotation of the line
        of sight moves the line to a field where the plate scale differs. Only `derived` uses it.
    d_gamma_per_beta : float
        Rotation of the imaged line per rad of d_beta, for the same reason. Only `derived` uses it.

    Raises
    ------
    ValueError
        A value is invalid; the message names the field.

    Examples
    --------
    A camera of f = 2 m whose monitor spots lie 0.2 m apart on CCDs with 10 um pixels. One pixel is 2.5 urad:

    >>> import analysis
    >>> geometry = analysis.MonitorGeometry(principal_distance_m=2.0, separation_m=0.2, pitch_m=10e-6)
    >>> geometry.pitch_m / (2 * geometry.principal_distance_m)
    2.5e-06
    """

    principal_distance_m: float
    separation_m: float
    pitch_m: float
    field_alpha_rad: float = 0.0
    field_beta_rad: float = 0.0
    principal_distance_across_m: float | None = None
    d_f_per_alpha_m: float = 0.0
    d_gamma_per_beta: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            angle = field.name.endswith("_rad")
            if "_per_" in field.name:
                if not math.isfinite(value):
                    raise ValueError(f"monitor geometry: {field.name} must be finite, found {value!r}")
                continue
            if not math.isfinite(value) or (abs(value) >= math.pi / 2 if angle else value <= 0):
                allowed = "within +-pi/2" if angle else "finite and > 0"
                raise ValueError(f"monitor geometry: {field.name} must be {allowed}, found {value!r}")


@shows("d_alpha_rad [arcsec]", "d_beta_rad [arcsec]", "d_gamma_rad [arcsec]", "d_f_m [um]")
@dataclass(frozen=True, eq=False)
class CameraParameters(StateArrays):
    """Changes of one camera: numbers for one state, or arrays of one common shape for many states.

    Attributes
    ----------
    d_alpha_rad, d_beta_rad, d_gamma_rad : ndarray
        Rotations of the camera about Y, X, Z, rad.
    d_f_m : ndarray
        Change of the principal distance, m.
    covariance : (..., 4, 4) ndarray
        Covariance of d_alpha, d_beta, d_gamma (rad), d_f (m) due to the noise of the images.
    total : (..., 4, 4) ndarray or None
        Covariance due to the noise and to the estimator's error under the disturbances of the prior; None without a
        prior.
    """

    d_alpha_rad: Array
    d_beta_rad: Array
    d_gamma_rad: Array
    d_f_m: Array
    covariance: Array
    total: Array | None = None

    @classmethod
    def from_vector(cls, values: ArrayLike, covariance: ArrayLike, total: ArrayLike | None = None) -> CameraParameters:
        """Return the changes of one camera from plain arrays.

        Parameters
        ----------
        values : (..., 4) array_like
            Changes d_alpha, d_beta, d_gamma (rad), d_f (m).
        covariance : (..., 4, 4) array_like
            Covariance due to the noise.
        total : (..., 4, 4) array_like or None
            Covariance due to noise and misfit; None without a prior.
        """
        vector, spread = np.asarray(values, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
        if vector.shape[-1:] != (4,) or spread.shape[-2:] != (4, 4):
            raise ValueError(f"camera parameters: need (..., 4) and (..., 4, 4), found {vector.shape}, {spread.shape}")
        spread = np.broadcast_to(spread, (*vector.shape, 4))
        whole = None if total is None else np.broadcast_to(np.asarray(total, np.float64), spread.shape)
        return cls(vector[..., 0], vector[..., 1], vector[..., 2], vector[..., 3], spread, whole)

    @property
    def vector(self) -> Array:
        """Changes of the camera's parameters d_alpha, d_beta, d_gamma (rad) and d_f (m), (..., 4)."""
        return np.stack([self.d_alpha_rad, self.d_beta_rad, self.d_gamma_rad, self.d_f_m], axis=-1)

    @property
    def error_covariance(self) -> Array:
        """Covariance of the total error in rad and m, (..., 4, 4); without a prior, that due to noise alone."""
        return self.covariance if self.total is None else self.total

    @property
    def sigma(self) -> Array:
        """Standard deviations of the total error of d_alpha, d_beta, d_gamma (rad) and d_f (m), (..., 4).

        Without a prior they are those due to noise alone.
        """
        return np.sqrt(np.diagonal(self.error_covariance, axis1=-2, axis2=-1))

    @property
    def sigma_noise(self) -> Array:
        """Standard deviations due to the noise of the images alone, (..., 4): three angles in rad, d_f in m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    def to_dict(self) -> dict[str, Any]:
        """Return the changes with their total and noise standard deviations as plain data for files of results.

        The keys are d_alpha_arcsec, d_beta_arcsec, d_gamma_arcsec and d_f_um, and these with _sigma and _sigma_noise;
        values are floats, or nested lists for arrays.
        """
        values, sigma, noise = self.vector, self.sigma, self.sigma_noise
        out: dict[str, Any] = {}
        for k, (key, scale) in enumerate(zip(PARAMETERS, PER_SI, strict=True)):
            out[key] = (values[..., k] * scale).tolist()
            out[f"{key}_sigma"] = (sigma[..., k] * scale).tolist()
            out[f"{key}_sigma_noise"] = (noise[..., k] * scale).tolist()
        return out


def coefficients(name: str, geometry: MonitorGeometry) -> Array:
    """Return the coefficients of a set of formulas, (4, 4) rad and m per pixel of shift.

    Rows are [d_alpha, d_beta, d_gamma, d_f] (rad, m), columns [left row, left column, right row, right column], after -
    before. For `paper_single` it is the argument of the arctangents. Multiplied by the Jacobian (4, M) of the spot
    shifts with respect to M motions, it gives the changes that the formulas report for each motion (a crosstalk table).
    """
    if name not in FORMULAS:
        raise ValueError(f"monitoring: no estimator {name!r}; there are {', '.join(FORMULAS)}")
    delta, f, length = geometry.pitch_m, geometry.principal_distance_m, geometry.separation_m
    paper = name != "derived"
    f_x = f if paper or geometry.principal_distance_across_m is None else geometry.principal_distance_across_m
    beta = delta * (math.cos(geometry.field_beta_rad) ** 2 if paper else 1.0) / (2 * f) / 2
    alpha = delta * (math.cos(geometry.field_alpha_rad) ** 2 if paper else 1.0) / (2 * f_x) / 2
    gamma = delta / length if paper else delta / (2 * length) * f / f_x
    scale = delta * f / (length * {"paper_single": 2, "paper_joint": 4, "derived": 2}[name])
    matrix = np.array(
        [[0.0, -alpha, 0.0, -alpha], [-beta, 0.0, -beta, 0.0], [0.0, -gamma, 0.0, gamma], [scale, 0.0, -scale, 0.0]]
    )
    if not paper:
        matrix[2] += geometry.d_gamma_per_beta * matrix[1]
        matrix[3] += geometry.d_f_per_alpha_m * matrix[0]
    return matrix


def paper_single(
    before: ArrayLike, after: ArrayLike, covariance: ArrayLike, geometry: MonitorGeometry
) -> CameraParameters:
    """Return the changes by eq. (2), (3), (5), (7) of paper 001 (Wang et al. 2018) as printed, with the arctangent.

    Parameters
    ----------
    before : (..., 2 channels, 2) array_like
        Spot positions (row, column) of the nominal state, px.
    after : (..., 2 channels, 2) array_like
        Spot positions of the changed state, px.
    covariance : (..., 4, 4) array_like
        Covariance of after - before, px^2, in order [left row, left column, right row, right column]; zeros without
        noise.
    geometry : MonitorGeometry
        Geometry of the camera's monitor.
    """
    argument, spread = linear(coefficients("paper_single", geometry), before, after, covariance)
    values = argument.copy()
    values[..., :3] = np.arctan(argument[..., :3])
    slope = np.ones_like(argument)
    slope[..., :3] = 1 / (1 + argument[..., :3] ** 2)
    return CameraParameters.from_vector(values, slope[..., :, None] * spread * slope[..., None, :])


def paper_joint(
    before: ArrayLike, after: ArrayLike, covariance: ArrayLike, geometry: MonitorGeometry
) -> CameraParameters:
    """Return the changes by the last column of Table 1 of paper 001 (Wang et al. 2018), as printed.

    The table does not define the sign of Y_L; each row takes the sign that agrees with the single-change formula beside
    it.

    Parameters
    ----------
    before : (..., 2 channels, 2) array_like
        Spot positions (row, column) of the nominal state, px.
    after : (..., 2 channels, 2) array_like
        Spot positions of the changed state, px.
    covariance : (..., 4, 4) array_like
        Covariance of after - before, px^2, in order [left row, left column, right row, right column]; zeros without
        noise.
    geometry : MonitorGeometry
        Geometry of the camera's monitor.
    """
    return CameraParameters.from_vector(*linear(coefficients("paper_joint", geometry), before, after, covariance))


def derived(before: ArrayLike, after: ArrayLike, covariance: ArrayLike, geometry: MonitorGeometry) -> CameraParameters:
    """Return the changes by the corrected formulas, the first-order response of a plane-mirror return.

    Parameters
    ----------
    before : (..., 2 channels, 2) array_like
        Spot positions (row, column) of the nominal state, px.
    after : (..., 2 channels, 2) array_like
        Spot positions of the changed state, px.
    covariance : (..., 4, 4) array_like
        Covariance of after - before, px^2, in order [left row, left column, right row, right column]; zeros without
        noise.
    geometry : MonitorGeometry
        Geometry of the camera's monitor.
    """
    return CameraParameters.from_vector(*linear(coefficients("derived", geometry), before, after, covariance))


def linear(matrix: Array, before: ArrayLike, after: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """Return the product of a coefficient matrix with the shifts, (..., 4), and its covariance, (..., 4, 4).

    Parameters
    ----------
    matrix : (4, 4) ndarray
        Coefficients, as from `coefficients`.
    before : (..., 2 channels, 2) array_like
        Spot positions (row, column) of the nominal state, px.
    after : (..., 2 channels, 2) array_like
        Spot positions of the changed state, px.
    covariance : (..., 4, 4) array_like
        Covariance of after - before, px^2, in order [left row, left column, right row, right column]; zeros without
        noise.
    """
    start, end = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    spread = np.asarray(covariance, dtype=np.float64)
    if start.shape[-2:] != (2, 2) or end.shape[-2:] != (2, 2) or spread.shape[-2:] != (4, 4):
        raise ValueError(
            "monitoring: before and after must be (..., 2 channels, 2 (row, column)) and covariance (..., 4, 4),"
            f" found {start.shape}, {end.shape}, {spread.shape}"
        )
    shift = end - start
    shift = shift.reshape(*shift.shape[:-2], 4)
    if not (np.all(np.isfinite(shift)) and np.all(np.isfinite(spread))):
        raise ValueError("monitoring: positions and covariance must be finite")
    return shift @ matrix.T, matrix @ spread @ matrix.T


@shows()
@dataclass(frozen=True, eq=False)
class IntersectionAngleChange(StateArrays):
    """Change of the angle between two cameras' lines of sight.

    Attributes
    ----------
    change_rad : (...) ndarray
        Angle of the changed instrument minus nominal angle, rad.
    sigma_rad : (...) ndarray
        Standard deviation of its error, rad.
    sigma_noise_rad : (...) ndarray or None
        Standard deviation due to the noise of the images, rad; None where that is the whole error.
    """

    change_rad: Array
    sigma_rad: Array
    sigma_noise_rad: Array | None = None

    @property
    def noise_rad(self) -> Array:
        """Standard deviation of the angle's change due to the noise of the images alone, (...) rad."""
        return self.sigma_rad if self.sigma_noise_rad is None else self.sigma_noise_rad


def exact(
    forward: CameraParameters,
    backward: CameraParameters,
    forward_look_rad: float,
    backward_look_rad: float,
    across: Array | None = None,
    across_total: Array | None = None,
) -> IntersectionAngleChange:
    """Return the change of the angle between the two rotated lines of sight in space, without linearisation.

    Parameters
    ----------
    forward : CameraParameters
        Changes of the camera of the larger look angle.
    backward : CameraParameters
        Changes of the other camera.
    forward_look_rad : float
        Look angle of the first camera, rad.
    backward_look_rad : float
        Look angle of the other camera, rad.
    across : (..., 4, 4) ndarray or None
        Cross-covariance of the forward and the backward parameters due to noise; None if they are independent.
    across_total : (..., 4, 4) ndarray or None
        Cross-covariance of the total errors of the forward and the backward parameters; None if they are independent.

    Raises
    ------
    ValueError
        Look angles are not within +-pi/2, or are equal.
    """
    for name, look in (("forward", forward_look_rad), ("backward", backward_look_rad)):
        if not (math.isfinite(look) and abs(look) < math.pi / 2):
            raise ValueError(f"intersection angle: {name}_look_rad must be within +-pi/2, found {look!r}")
    nominal = abs(forward_look_rad - backward_look_rad)
    if nominal < 1e-3:
        raise UndeterminedError(
            "intersection angle: the lines of sight are parallel, so that the plane of the angle is undefined"
        )
    rotations = (forward.d_alpha_rad, forward.d_beta_rad, backward.d_alpha_rad, backward.d_beta_rad)
    angles_now = np.stack(np.broadcast_arrays(*(np.asarray(angle, np.float64) for angle in rotations)))
    # the angle at the rotations, and with a step forward and back in each
    step = 1e-5
    moves = np.concatenate([np.zeros((1, 4)), step * np.eye(4), -step * np.eye(4)]).T
    d_alpha, d_beta, other_alpha, other_beta = angles_now[:, None] + moves.reshape(4, 9, *(1,) * (angles_now.ndim - 1))
    angles = _between(
        _line_of_sight(d_alpha, d_beta, forward_look_rad), _line_of_sight(other_alpha, other_beta, backward_look_rad)
    )
    each = (angles[1:5] - angles[5:]) / (2 * step)
    slopes = [np.stack([each[2 * k], each[2 * k + 1]], axis=-1) for k in range(2)]

    def sigma(covariances: tuple[Array, Array], shared: Array | None) -> Array:
        variance: Any = 0.0
        for slope, covariance in zip(slopes, covariances, strict=True):
            variance = variance + np.einsum("...i,...ij,...j->...", slope, covariance[..., :2, :2], slope)
        if shared is not None:
            variance = variance + 2 * np.einsum("...i,...ij,...j->...", slopes[0], shared[..., :2, :2], slopes[1])
        return np.sqrt(variance)

    change = angles[0] - nominal
    noise = sigma((forward.covariance, backward.covariance), across)
    if forward.total is None or backward.total is None:
        return IntersectionAngleChange(change, noise)
    return IntersectionAngleChange(change, sigma((forward.total, backward.total), across_total), noise)


def _between(u: tuple[Array, Array, Array], v: tuple[Array, Array, Array]) -> Array:
    """Return the angle, rad, between two unit vectors given by their components."""
    (ux, uy, uz), (vx, vy, vz) = u, v
    sine = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2)
    return np.asarray(np.arctan2(sine, ux * vx + uy * vy + uz * vz))


def _line_of_sight(d_alpha: Array, d_beta: Array, look: float) -> tuple[Array, Array, Array]:
    """Return the components of the line of sight, a unit vector in the base frame.

    It is +Z rotated by the rotation vector (d_beta, d_alpha, 0), then by the look angle.
    """
    angle = np.hypot(d_alpha, d_beta)
    ratio = np.sinc(angle / np.pi)
    x, y, z = ratio * d_alpha, -ratio * d_beta, np.cos(angle)
    c, s = math.cos(look), math.sin(look)
    return c * x + s * z, y, c * z - s * x


EARTH_RADIUS_M = 6_371_000.0
"""Mean radius of the Earth (IUGG), m.

The Earth's flattening and rotation change the results here by less than 1 %.
"""
_GROUND_POINTS = 9
"""Number of positions along the line CCD over which rms values of ground errors are taken."""


@shows()
@dataclass(frozen=True, eq=False)
class GroundError(StateArrays):
    """Errors of points on the ground for S states.

    Attributes
    ----------
    error_m : (S, 3) ndarray
        Located minus true position along the track, across it and up, at the middle of the line, when the cameras'
        changes are ignored.
    sigma_m : (S, 3) ndarray
        Standard deviation of the error after correction by the estimate.
    sigma_noise_m : (S, 3) ndarray
        Standard deviation of the error that is due to the noise of the images alone.
    plan_rms_m, height_rms_m : (S,) ndarray
        Standard deviations after correction, rms over the line: of both plan axes together, and of the height.
    """

    error_m: Array
    sigma_m: Array
    sigma_noise_m: Array
    plan_rms_m: Array
    height_rms_m: Array


@dataclass(frozen=True)
class GroundGeometry:
    """Geometry of a pair of line cameras that looks at the ground from an orbit.

    Attributes
    ----------
    altitude_m : float
        Altitude of the orbit, m.
    cameras : tuple of str
        Names of the two cameras, in the calibration's order.
    looks_rad : tuple of float
        Their look angles, forward positive, rad.
    half_field : tuple of float
        Tangent of half the field across the track that both lines see, of each camera.

    Raises
    ------
    ValueError
        A camera does not look at the Earth, or both look in the same direction.
    """

    altitude_m: float
    cameras: tuple[str, str]
    looks_rad: tuple[float, float]
    half_field: tuple[float, float]

    def __post_init__(self) -> None:
        """Raise UndeterminedError if the rays of the two cameras do not intersect on the ground."""
        if any(abs(math.sin(a)) * (EARTH_RADIUS_M + self.altitude_m) >= EARTH_RADIUS_M for a in self.looks_rad):
            raise UndeterminedError("ground error: a camera looks past the Earth")
        if abs(self.looks_rad[0] - self.looks_rad[1]) < 1e-3:
            raise UndeterminedError("ground error: the lines of sight are parallel and do not intersect")

    @cached_property
    def incidences_rad(self) -> tuple[float, float]:
        """Angles of incidence of the two cameras' rays at the ground, from the vertical, rad."""
        ratio = 1.0 + self.altitude_m / EARTH_RADIUS_M
        first, second = (math.asin(ratio * math.sin(a)) for a in self.looks_rad)
        return first, second

    @cached_property
    def ranges_m(self) -> tuple[float, float]:
        """Distances from the cameras to the ground along their rays, in the plane of the orbit, m."""
        first, second = (
            EARTH_RADIUS_M * math.sin(i - a) / math.sin(a) if abs(a) > 1e-9 else self.altitude_m
            for i, a in zip(self.incidences_rad, self.looks_rad, strict=True)
        )
        return first, second

    @cached_property
    def matrices(self) -> Array:
        """Matrices from changes of the two cameras to shifts on the ground at P positions along the line, (P, 3, 8).

        Rows of a matrix are the shifts along the track, across it and up, in m; columns are the changes. The changes
        are d_alpha, d_beta, d_gamma (rad), d_f / f of the first camera, then of the second. The middle of the line is
        the middle position.
        """
        half_swath = min(r * t for r, t in zip(self.ranges_m, self.half_field, strict=True))
        return np.stack([self._at(c) for c in np.linspace(-half_swath, half_swath, _GROUND_POINTS)])

    def _at(self, across: float) -> Array:
        """Return the matrix (3, 8) from changes of both cameras to shifts on the ground at one place.

        ``across`` is the distance of the place from the middle of the line, across the track, in m.
        """
        normal, right = np.zeros((3, 3)), []
        for incidence, far in zip(self.incidences_rad, self.ranges_m, strict=True):
            t = across / far
            ray = np.array([0.0, t, 1.0])
            # rotations (d_beta, d_alpha, d_gamma) about X, Y, Z of the camera; a longer f narrows the field
            change = np.array([[1.0, 0.0, -t, 0.0], [0.0, -1.0, 0.0, -t], [0.0, t, 0.0, 0.0]])
            c, s = math.cos(incidence), math.sin(incidence)
            level = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])  # along, right, down
            ray, change = level @ ray, level @ change
            square = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            normal += square
            right.append(square @ change * far)
        # points are located with the nominal rays, hence minus the effect of the change
        matrix = -np.linalg.solve(normal, np.concatenate(right, axis=1))
        matrix[2] *= -1.0  # up
        return matrix

    def rows(self, principal_distances_m: tuple[float, float]) -> Array:
        """Return the matrices from changes of the two cameras, with d_f in metres, to ground shifts, (places, 3, 8).

        Parameters
        ----------
        principal_distances_m : tuple of float
            Principal distances of the two cameras, m.
        """
        out = self.matrices.copy()
        for k, f in enumerate(principal_distances_m):
            out[..., 4 * k + 3] /= f
        return out

    def fitted_to_ground(self, true: Array, assumed: Array) -> Array:
        """Return the exact error along, across and up, (..., 3) m, of points that are located along assumed rays.

        Parameters
        ----------
        true : (..., 2, 3) ndarray
            True directions of the two rays in the base frame (X along the track, Z down).
        assumed : (..., 2, 3) ndarray
            Assumed directions of the two rays.
        """
        normal: Any = 0.0
        right: Any = 0.0
        for k, (incidence, look, far) in enumerate(
            zip(self.incidences_rad, self.looks_rad, self.ranges_m, strict=True)
        ):
            rotation = incidence - look
            c, s = math.cos(rotation), math.sin(rotation)
            level = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
            real, ray = (np.asarray(v, np.float64)[..., k, :] @ level.T for v in (true, assumed))
            down = np.linalg.norm(ray, axis=-1, keepdims=True)
            ray = ray / down
            station = -far * real / np.linalg.norm(real, axis=-1, keepdims=True)
            square = np.eye(3) - ray[..., :, None] * ray[..., None, :]
            normal = normal + square
            right = right + np.einsum("...ij,...j->...i", square, station)
        out = np.linalg.solve(normal, right[..., None])[..., 0]
        return np.asarray(out * np.array([1.0, 1.0, -1.0]))

    def error(
        self, values: Array, noise: Array, total: Array, principal_distances_m: tuple[float, float]
    ) -> GroundError:
        """Return the errors on the ground due to estimated changes, and the standard deviations after their correction.

        Dimensions: S states.

        Parameters
        ----------
        values : (S, 8) ndarray
            Estimated changes d_alpha, d_beta, d_gamma (rad) and d_f (m) of the first camera, then of the second.
        noise : (S, 8, 8) ndarray
            Covariance of the changes due to noise.
        total : (S, 8, 8) ndarray
            Covariance of their total error.
        principal_distances_m : tuple of float
            Principal distances of the two cameras, m.
        """
        rows = self.rows(principal_distances_m)
        middle = rows[_GROUND_POINTS // 2]
        left = np.einsum("pai,sij,paj->spa", rows, total, rows)
        return GroundError(
            error_m=values @ middle.T,
            sigma_m=np.sqrt(np.einsum("ai,sij,aj->sa", middle, total, middle)),
            sigma_noise_m=np.sqrt(np.einsum("ai,sij,aj->sa", middle, noise, middle)),
            plan_rms_m=np.sqrt(left[..., :2].sum(axis=-1).mean(axis=-1)),
            height_rms_m=np.sqrt(left[..., 2].mean(axis=-1)),
        )
