"""First-order quantities by derivatives of the exact trace, and changes of a line camera by exact chief rays.

First-order data are parabasal about a chief ray, or paraxial about the axis. The changes of a line camera are its line
of sight, roll and principal distance.
"""

from dataclasses import dataclass

import numpy as np

from optics.numerics.array_math import determinant, inner, inverse, product
from optics.numerics.backend import Backend
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import SystemBatch
from optics.raytrace.trace import jvp, make_rays, require_rays, trace


@dataclass(frozen=True, eq=False)
class RayMatrix:
    """Derivatives of one ray of each of B systems with respect to its launch, in transverse coordinates.

    Attributes
    ----------
    image_by_position, image_by_angle : (B, 2, 2) ndarray
        Derivatives of the position x, y on the last element with respect to the launch position (dimensionless) and to
        the launch direction (m/rad), each along the two launch axes.
    direction_by_position, direction_by_angle : (B, 2, 2) ndarray
        Derivatives of the direction cosines x, y at the last element, in 1/m and dimensionless.
    stop_by_position, stop_by_angle : (B, 2, 2) ndarray
        Derivatives of the position x, y on the stop, dimensionless and in m/rad.
    direction : (B, 3) ndarray
        Unit direction of the ray at the last element, in its frame.
    """

    image_by_position: np.ndarray
    image_by_angle: np.ndarray
    direction_by_position: np.ndarray
    direction_by_angle: np.ndarray
    stop_by_position: np.ndarray
    stop_by_angle: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """First-order quantities of B systems about their chief rays.

    Attributes
    ----------
    scale : (B, 2, 2) ndarray
        Derivative of the image position x, y with respect to the object angle about the two launch axes, for a fixed
        point of the stop, metres per radian: the local principal distance along each axis, for the plane where the
        image is taken; off-diagonal terms are rotation and anamorphism.
    principal_distance : (B,) ndarray
        Square root of the modulus of the determinant of ``scale``, metres.
    entrance_magnification : (B, 2, 2) ndarray
        Derivative of the position x, y on the stop with respect to that at the launch.
    exit_pupil_distance : (B,) ndarray
        Distance of the exit pupil from the image, upstream along the chief ray, mean over both axes, metres; negative
        when the pupil lies downstream, large when the image space is telecentric.
    """

    scale: np.ndarray
    principal_distance: np.ndarray
    entrance_magnification: np.ndarray
    exit_pupil_distance: np.ndarray


def ray_matrix(
    backend: Backend, systems: SystemBatch, stop: int, position: np.ndarray, direction: np.ndarray, axes: np.ndarray
) -> RayMatrix:
    """Differentiate one ray per system by forward-mode automatic differentiation.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    systems : SystemBatch
        B systems.
    stop : int
        Index of the stop in the sequence.
    position : (B, 3) ndarray
        Launch points in the world frame, metres.
    direction : (B, 3) ndarray
        Unit directions in the world frame.
    axes : (B, 2, 3) ndarray
        Two launch axes perpendicular to the direction.
    """
    zero = np.zeros_like(axes)
    start, heading = (np.repeat(vector[:, None], 4, axis=1) for vector in (position, direction))
    shift, tilt = (np.concatenate(pair, axis=1) for pair in ((axes, zero), (zero, axes)))
    out = jvp(backend, systems, start, heading, shift, tilt, keep=(stop,))
    # columns are launch steps, rows x and y
    image, angle, hit = (np.swapaxes(shift[..., :2], 1, 2) for shift in (out.position, out.direction, out.hits[stop]))
    parts = (image[..., :2], image[..., 2:], angle[..., :2], angle[..., 2:], hit[..., :2], hit[..., 2:])
    return RayMatrix(*parts, out.traced.numpy()[1][:, 0])


def first_order(matrix: RayMatrix) -> FirstOrder:
    """Return the first-order quantities about chief rays from their derivatives with respect to the launch.

    They follow from rays of neighbouring field points that pass the same point of the stop.
    """
    to_stop = -product(inverse(matrix.stop_by_position), matrix.stop_by_angle)
    scale = matrix.image_by_angle + product(matrix.image_by_position, to_stop)
    angle = matrix.direction_by_angle + product(matrix.direction_by_position, to_stop)
    principal_distance = np.sqrt(np.abs(determinant(scale)))
    # two chief rays cross where image step - s * direction step vanishes, s measured upstream
    distance = np.sum(scale * angle, axis=(-1, -2)) / np.maximum(np.sum(angle * angle, axis=(-1, -2)), 1e-30)
    return FirstOrder(scale, principal_distance, matrix.stop_by_position, distance)


@dataclass(frozen=True, eq=False)
class Paraxial:
    """Paraxial data of one system about a ray along its axis; lengths in metres, angles in radians.

    Attributes
    ----------
    focal_length : float
        Effective focal length, the magnitude 1 / sqrt|det d(direction)/d(launch)|; independent of the position of the
        image plane, and infinite without power.
    back_focal_length : float
        Distance of the paraxial focus from the last surface, downstream; infinite without power.
    entrance_pupil : float
        Distance of the entrance pupil from the first surface, positive toward the scene.
    exit_pupil : float
        Distance of the exit pupil from the image plane, upstream; infinite where chief rays leave parallel.
    exit_magnification : float
        Diameter of the exit pupil divided by that of the entrance pupil.
    angular_magnification : float
        Angle between two chief rays after the system divided by that before it, at the pupils; in an afocal system,
        which has no focal length, that of any two collimated beams.
    """

    focal_length: float
    back_focal_length: float
    entrance_pupil: float
    exit_pupil: float
    exit_magnification: float
    angular_magnification: float


@np.errstate(divide="ignore", invalid="ignore")
def paraxial(matrix: RayMatrix, before: float, behind: float) -> Paraxial:
    """Return the paraxial data of the first system of a ray matrix.

    Displacements of the ray at the image are taken perpendicular to the ray, so that the tilt of the image plane has no
    effect.

    Parameters
    ----------
    matrix : RayMatrix
        Derivatives about the ray along the axis, from ``ray_matrix``.
    before : float
        Distance along the ray from its launch point to the first surface, metres.
    behind : float
        Distance along the ray from the last surface to the image, metres.
    """
    ray = matrix.direction[0]
    axes = transverse_axes(ray, np.array([1.0, 0.0, 0.0]))
    # components along these axes of a step in the plane, and of a step of the unit direction
    from_position = axes[:, :2]
    from_angle = axes[:, :2] - np.outer(axes[:, 2], ray[:2]) / ray[2]
    position, shift = from_position @ matrix.image_by_position[0], from_position @ matrix.image_by_angle[0]
    power, angle = from_angle @ matrix.direction_by_position[0], from_angle @ matrix.direction_by_angle[0]
    to_stop = -inverse(matrix.stop_by_position)[0] @ matrix.stop_by_angle[0]
    chief, chief_angle = shift + position @ to_stop, angle + power @ to_stop
    square = float(np.sum(chief_angle**2))
    exit_pupil = np.sum(chief * chief_angle) / square if square else np.inf
    return Paraxial(
        focal_length=float(1.0 / np.sqrt(np.abs(determinant(power)))),
        back_focal_length=float(behind - np.sum(position * power) / np.sum(power**2)),
        entrance_pupil=float(before + 0.5 * np.trace(to_stop)),
        exit_pupil=float(exit_pupil),
        exit_magnification=float(np.sqrt(np.abs(determinant(position - exit_pupil * power)))) if square else np.inf,
        angular_magnification=float(np.sqrt(np.abs(determinant(chief_angle)))),
    )


def equal_area_radius(points: np.ndarray) -> float:
    """Return the radius of the circle that has the area of a closed smooth curve.

    ``points`` (N, 2) are N points evenly spaced along the curve.
    """
    return float(np.sqrt(enclosed_area(points) / np.pi))


def enclosed_area(points: np.ndarray) -> float:
    """Return the area enclosed by a closed smooth curve through N points (N, 2) that are evenly spaced along it.

    It is the area of the polygon times the ratio of a circle's area to that of its inscribed regular polygon: exact for
    an ellipse.
    """
    u, v = points.T
    polygon = 0.5 * abs(float(np.sum(u * np.roll(v, -1) - v * np.roll(u, -1))))
    step = 2.0 * np.pi / len(u)
    return polygon * step / np.sin(step)


def aim_chief_rays(
    backend: Backend,
    to_stop: SystemBatch,
    points: np.ndarray,
    guess: np.ndarray,
    transverse: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[RayFan, np.ndarray, np.ndarray]:
    """Aim rays of M image points at the centre of the stop, in each of B systems.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    to_stop : SystemBatch
        B systems from the image side to the stop (last element).
    points : (B, M, 3) ndarray
        Image points in the world frame, metres.
    guess : ndarray
        Rough direction from the image to the last mirror, broadcastable to (B, M, 3).
    transverse : (3,) ndarray
        Direction near which the first transverse axis is taken.
    start : (ndarray, ndarray), optional
        Parameters (B, M, 2) and Jacobian (B, M, 2, 2) of nearby rays, as returned by this function.

    Returns
    -------
    fan : RayFan
        Family of the rays.
    q : (B, M, 2) ndarray
        Parameters of the rays: their tilts from the rough direction about two transverse axes.
    jacobian : (B, M, 2, 2) ndarray
        Derivatives of the position on the stop, metres, with respect to the parameters.

    Raises
    ------
    AimError
        No ray reaches the centre of the stop.
    """
    fan = RayFan.toward(points, guess, transverse)
    initial, slope = (None, None) if start is None else start
    return fan, *aim(backend, to_stop, fan, np.zeros(2), initial, slope)


def chief_rays(
    backend: Backend,
    to_stop: SystemBatch,
    to_object: SystemBatch,
    points: np.ndarray,
    guess: np.ndarray,
    transverse: np.ndarray,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the chief rays of image points, traced backward from the image through the centre of the stop.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    to_stop : SystemBatch
        B systems from the image side to the stop (last element).
    to_object : SystemBatch
        The same systems, continued to the first mirror.
    points : (B, M, 3) ndarray
        M image points in the world frame, metres.
    guess : ndarray
        Rough direction from the image to the last mirror, broadcastable to (B, M, 3).
    transverse : (3,) ndarray
        Direction near which the first transverse axis is taken.
    start : (ndarray, ndarray), optional
        Parameters (B, M, 2) and Jacobian (B, M, 2, 2) of nearby rays, as ``aim_chief_rays`` returns them.

    Returns
    -------
    position : (B, M, 3) ndarray
        Points on the rays after the first mirror, world frame, metres.
    direction : (B, M, 3) ndarray
        Object-space unit directions toward the scene, world frame.

    Raises
    ------
    AimError, BeamMissedError
        A ray does not reach the stop or the first mirror.
    """
    fan, q, _ = aim_chief_rays(backend, to_stop, points, guess, transverse, start)
    position, direction = fan.at(q)
    out = trace(backend, to_object, make_rays(backend, position, direction), world=True)
    assert out.world is not None
    origins, leaving, _, valid = out.numpy(out.world)
    require_rays(valid, "the imaging path")
    return origins, leaving


@dataclass(frozen=True, eq=False)
class LineChange:
    """True changes of a line camera in B perturbed states against its nominal state.

    "The line" is the line in object space that the camera's line CCD images. L is the distance of a point from the
    centre of the line CCD and W the angle of its chief ray from the line of sight.

    Attributes
    ----------
    d_alpha, d_beta : (B,) ndarray
        Rotation of the line of sight about the nominal camera's Y and X, radians (right-hand rule).
    d_gamma : (B,) ndarray
        Rotation of the imaged line about the line of sight, radians.
    principal_distance : (B,) ndarray
        f = sum(L tan W)/sum(tan^2 W) over the line (Li et al., 2020, doi 10.3788/IRLA20200143, eq. 3), metres. L is
        counted in pixels times their nominal pitch, so that f describes the angle of a pixel: a camera that expands
        together with its line CCD keeps that angle, and so f.
    d_f : (B,) ndarray
        Change of the principal distance, metres.
    nominal_distance : float
        Principal distance of the nominal state, metres.
    """

    d_alpha: np.ndarray
    d_beta: np.ndarray
    d_gamma: np.ndarray
    principal_distance: np.ndarray
    d_f: np.ndarray
    nominal_distance: float

    @property
    def vector(self) -> np.ndarray:
        """Changes d_alpha, d_beta, d_gamma (radians) and d_f (metres) of each of the B states, (B, 4)."""
        return np.stack([self.d_alpha, self.d_beta, self.d_gamma, self.d_f], axis=-1)


def line_tangents(
    sight: np.ndarray, position: np.ndarray, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines of sight, the rolls, and the tangents of the view angles along the imaged line, for S states.

    Parameters
    ----------
    sight : (S, M, 3) ndarray
        Object-space directions of M points of the line in the world frame; M odd, the middle point is the line's
        centre.
    position : (M,) ndarray
        Coordinate of the points along camera Y on the nominal line CCD, metres.
    camera : (3, 3) ndarray
        Nominal camera axes X, Y, Z in the world as columns.

    Returns
    -------
    axis : (S, 3) ndarray
        Lines of sight in the camera's axes.
    roll : (S,) ndarray
        Rotation of the imaged line about the line of sight, radians.
    tangent : (S, M) ndarray
        Tangents of the angles from the line of sight along the imaged line, with the sign of ``position``.
    """
    local = product(sight, camera)
    middle = sight.shape[1] // 2
    axis = local[:, middle]
    # tangent-plane coordinates about each state's own line of sight, its X axis kept square to the nominal Y axis
    forward = axis[:, None]
    across = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    along = np.cross(forward, across)
    depth = np.sum(local * forward, axis=-1)
    x = np.sum(local * across, axis=-1) / depth
    y = np.sum(local * along, axis=-1) / depth
    # a lens inverts: an image point at +L looks toward -tan W
    weight = position / np.sum(position**2)
    roll = np.arctan2(inner(x, weight), -inner(y, weight))
    return axis, roll, -(y * np.cos(roll)[:, None] - x * np.sin(roll)[:, None])


def line_change(sight: np.ndarray, position: np.ndarray, camera: np.ndarray) -> LineChange:
    """Return the changes of a line camera in B perturbed states against its nominal state.

    Parameters
    ----------
    sight : (1 + B, M, 3) ndarray
        Object-space directions of M points of the line in the world frame; entry 0 is the nominal state; M odd, the
        middle point is the line's centre.
    position : (M,) ndarray
        Coordinate of the points along camera Y on the nominal line CCD, metres.
    camera : (3, 3) ndarray
        Nominal camera axes X, Y, Z in the world as columns; Z is the nominal line of sight.
    """
    axis, roll, tangent = line_tangents(sight, position, camera)
    distance = inner(tangent, position) / np.sum(tangent**2, axis=-1)
    rolled = roll[1:] - roll[0]
    # a camera with an upright image has a roll of 180 deg, of either sign
    rolled = rolled - 2.0 * np.pi * np.round(rolled / (2.0 * np.pi))
    return LineChange(
        d_alpha=np.arctan2(axis[1:, 0], axis[1:, 2]),
        d_beta=np.arctan2(-axis[1:, 1], np.hypot(axis[1:, 0], axis[1:, 2])),
        d_gamma=rolled,
        principal_distance=distance[1:],
        d_f=distance[1:] - distance[0],
        nominal_distance=float(distance[0]),
    )
