"""Line cameras in orbit: lines of sight of pixels in the body frame, exposure times, changes of geometry.

Body frame (the instrument's base): X forward, Z toward the scene, Y = Z x X. The look of a pixel is its line of sight,
a unit vector toward the scene. A pixel's ray has an origin as well as a direction, because the chief rays of a mirror
camera do not meet in one exact point. Both are smooth functions of the pixel and are stored as Chebyshev series over
the line: exact for an ideal projection with distortion, which is a polynomial, and as accurate as the ray trace for a
traced line.

The module also corrects the lines of an instrument for changes that its on-board monitor has estimated. The effect of a
change on the lines of sight is computed by `analysis.orbit.forward_intersection.CalibratedLine.corrected`, which is
also used for forward intersection; here the result is converted to the line of an orbiting sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from analysis.orbit.forward_intersection import CalibratedLine
from optics.geometry.pose import about_axis, rotation_matrix
from optics.geometry.tree import State
from optics.numerics.array_math import in_span
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import chief_rays
from optics.raytrace.system import assemble
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE
from scenes.specs.orbit.three_line_camera import CcdSpec, LineCameraSpec, ThreeLineCameraSpec
from twin.monitor.truth import LineSight

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import OrbitCalibrationSpec
    from scenes.specs.orbit.scene import OrbitSimulateSpec


@dataclass(frozen=True, eq=False)
class LineTimes:
    """Exposure times of image lines, interpolated linearly between tabulated lines.

    The table extends to half a line beyond its first and its last line.

    Attributes
    ----------
    line : (K,) ndarray for K lines
        Image coordinates of lines, increasing; the middle of the first line is 0.
    time : (K,) ndarray
        Middle of the exposure, seconds of the trajectory, increasing.
    """

    line: Array
    time: Array

    @classmethod
    def of(cls, line: ArrayLike, time: ArrayLike) -> LineTimes:
        """Make the table of line times from rows, with checks.

        Parameters
        ----------
        line : (K,) array_like for K lines
            Image coordinates of at least two lines.
        time : (K,) array_like
            Middle of the exposure of each line, seconds.

        Raises
        ------
        ValueError
            Shapes do not match, there are fewer than two rows, or values are not finite or do not increase.
        """
        at, moment = np.array(line, np.float64), np.array(time, np.float64)
        if at.ndim != 1 or at.shape != moment.shape or len(at) < 2:
            raise ValueError("line times: at least two lines are needed, each with a time")
        if not (np.all(np.isfinite(at)) and np.all(np.isfinite(moment))):
            raise ValueError("line times: a value is not finite")
        if not (np.all(np.diff(at) > 0.0) and np.all(np.diff(moment) > 0.0)):
            raise ValueError("line times: lines and times must increase")
        return cls(at, moment)

    @classmethod
    def even(cls, first_time: float, line_time: float, lines: int) -> LineTimes:
        """Return the times of lines at a constant interval, from line 0 on, in seconds."""
        last = float(max(lines - 1, 1))
        return cls.of([0.0, last], [first_time, first_time + last * line_time])

    @property
    def line_time(self) -> float:
        """Mean time from one line to the next, seconds."""
        return float((self.time[-1] - self.time[0]) / (self.line[-1] - self.line[0]))

    def at(self, line: ArrayLike) -> np.ndarray:
        """Return the times of lines (...), in seconds, extrapolated linearly beyond the table's ends."""
        x = np.asarray(line, dtype=np.float64)
        k = np.clip(np.searchsorted(self.line, x, side="right") - 1, 0, len(self.line) - 2)
        slope = (self.time[k + 1] - self.time[k]) / (self.line[k + 1] - self.line[k])
        return np.asarray(self.time[k] + (x - self.line[k]) * slope)


def changed_payload(
    spec: OrbitCalibrationSpec | OrbitSimulateSpec, payload: ThreeLineCameraSpec
) -> ThreeLineCameraSpec:
    """Return the payload after launch, with the changes of interior orientation of a test's `perturb`.

    Parameters
    ----------
    spec : OrbitCalibrationSpec or OrbitSimulateSpec
        Test whose `perturb` names lines.
    payload : ThreeLineCameraSpec
        Payload as measured in the laboratory.
    """
    lines = dict(payload.lines)
    for name, change in spec.perturb.items():
        line = lines[name]
        point = tuple(a + b for a, b in zip(line.principal_point, change.principal_point, strict=True))
        focal = line.principal_distance + change.principal_distance
        lines[name] = line.model_copy(update={"principal_distance": focal, "principal_point": point})
    return payload.model_copy(update={"lines": FrozenMap(lines)})


def drifted_payload(payload: ThreeLineCameraSpec, drift: Mapping[str, np.ndarray]) -> ThreeLineCameraSpec:
    """Return the payload with each line rotated in its own axes and its principal distance changed.

    The rotation is Rx(d_beta) Ry(d_alpha) Rz(d_gamma), the principal distance f + d_f.

    Parameters
    ----------
    payload : ThreeLineCameraSpec
        Payload before the drift.
    drift : mapping of str to (4,) ndarray
        Name of the line -> rotations d_alpha, d_beta, d_gamma (radians) and change d_f of the principal distance f
        (metres).
    """
    lines = dict(payload.lines)
    for name, (alpha, beta, gamma, d_f) in drift.items():
        line = lines[name]
        rotation = rotation_matrix(np.array(line.rotate)) @ about_axis(0, beta) @ about_axis(1, alpha)
        rotate = tuple(Rotation.from_matrix(rotation @ about_axis(2, gamma)).as_rotvec().tolist())
        focal = line.principal_distance + float(d_f)
        lines[name] = line.model_copy(update={"rotate": rotate, "principal_distance": focal})
    return payload.model_copy(update={"lines": FrozenMap(lines)})


TRACED_POINTS = 49
"""Number of traced points of a line; an unperturbed line needs nine Chebyshev terms, the others represent figure errors
of the mirrors.
"""
_NOISE = 1e-14
"""Relative size below which terms of a traced Chebyshev series are rounding errors and are dropped (one pixel is 1e-6
rad).
"""
_PLANE_POINTS = 1001
"""Number of evenly spread pixels to which the plane of a whole line is fitted."""
_LOOK_TERMS = 12
"""Number of Chebyshev terms for the tangent of a look angle within 30 deg over one CCD.

The terms decrease by a factor of a thousand every few terms.
"""


@dataclass(frozen=True, eq=False)
class LinePiece:
    """Single CCD of a line, with the lines of sight of its pixels.

    Attributes
    ----------
    first, last : int
        First and last pixel of the CCD, counted over the line.
    directions : (K, 3) ndarray
        K Chebyshev coefficients, over the CCD's pixels, of a vector along the line of sight, body frame.
    """

    first: int
    last: int
    directions: np.ndarray


@dataclass(frozen=True, eq=False)
class LineCamera:
    """Line of pixels with their rays (origins and lines of sight) in the body frame.

    Pixels are counted along +Y' of the real focal plane, the centre of the first is 0, so they see the scene from +Y to
    -Y of the body. A position on the line is any real number from -0.5 to pixels - 0.5.

    Attributes
    ----------
    name : str
        Name of the line.
    pixels : int
        Number of pixels.
    directions : (K, 3) ndarray
        K Chebyshev coefficients over the line of a vector along the line of sight, body frame; its length does not
        matter.
    origins : (J, 3) ndarray
        J Chebyshev coefficients over the line of a point on the ray, body frame, metres.
    pieces : tuple of LinePiece
        CCDs of a line that consists of several, in the order of the pixels; their directions replace `directions`,
        which then describe a line without offsets of its CCDs.
    """

    name: str
    pixels: int
    directions: np.ndarray
    origins: np.ndarray
    pieces: tuple[LinePiece, ...] = ()

    def rotated(self, rotation: np.ndarray) -> LineCamera:
        """Return the line with its lines of sight rotated by a (3, 3) matrix in body axes: new = old @ rotation."""
        pieces = tuple(replace(piece, directions=piece.directions @ rotation) for piece in self.pieces)
        return replace(self, directions=self.directions @ rotation, pieces=pieces)

    def look(self, pixel: np.ndarray) -> np.ndarray:
        """Return the lines of sight of N pixels: unit vectors toward the scene, body frame, (N, 3).

        Raises
        ------
        ValueError
            A pixel lies outside the line.
        """
        vector = self._vector(pixel)[0]
        return vector / np.linalg.norm(vector, axis=-1, keepdims=True)

    def look_and_slope(self, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lines of sight of N pixels and their derivatives with respect to the pixel (rad/pixel), (N, 3).

        The lines of sight are unit vectors in the body frame; the derivatives are perpendicular to them.
        """
        vector, change = self._vector(pixel)
        length = np.linalg.norm(vector, axis=-1, keepdims=True)
        look = vector / length
        return look, (change - look * np.sum(look * change, axis=-1, keepdims=True)) / length

    def relative_illumination(self, pixel: np.ndarray) -> np.ndarray:
        """Return the irradiance on N pixels relative to the line's middle, (N,), for ground of uniform radiance.

        The entrance pupil is foreshortened by cos w at the field angle w, and a pixel sees the solid angle of its angle
        along the line times its angle across, pitch x cos w / f. The product is cos^4 w for a projection without
        distortion, and follows the distortion otherwise.

        Raises
        ------
        ValueError
            A pixel lies outside the line.
        """
        look, slope = self.look_and_slope(np.concatenate([[0.5 * (self.pixels - 1)], np.asarray(pixel, np.float64)]))
        rate = np.linalg.norm(slope, axis=-1)
        return np.asarray((look[1:] @ look[0]) ** 2 * rate[1:] / rate[0])

    def origin(self, pixel: np.ndarray) -> np.ndarray:
        """Return points on the rays, body frame: (N, 3) for N pixels, in metres.

        Raises
        ------
        ValueError
            A pixel lies outside the line.
        """
        return self._series(self.origins, self._checked(pixel))

    def _vector(self, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return vectors along the lines of sight of N pixels and their derivatives per pixel, both (N, 3)."""
        pixels = self._checked(pixel)
        change = self._series(chebyshev.chebder(self.directions), pixels) * (2.0 / self.pixels)
        vector = self._series(self.directions, pixels)
        for piece in self.pieces:
            inside = (pixels >= piece.first - 0.5) & (pixels <= piece.last + 0.5)
            width = piece.last - piece.first + 1
            x = (2.0 * (pixels[inside] - piece.first) + 1.0) / width - 1.0
            slope = chebyshev.chebder(piece.directions) * (2.0 / width)
            vector[inside] = np.moveaxis(chebyshev.chebval(x, piece.directions), 0, -1)
            change[inside] = np.moveaxis(chebyshev.chebval(x, slope), 0, -1)
        return vector, change

    def _checked(self, pixel: np.ndarray) -> np.ndarray:
        """Return pixel positions, those outside the line by rounding clipped; raise ValueError for others outside."""
        if not np.all(in_span(pixel, -0.5, self.pixels - 0.5)):
            raise ValueError(
                f"a pixel lies outside the line {self.name!r}, which extends from -0.5 to {self.pixels - 0.5}"
            )
        return np.clip(pixel, -0.5, self.pixels - 0.5)

    def _series(self, coefficients: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Evaluate a Chebyshev series over the line at pixels."""
        x = (2.0 * pixel + 1.0) / self.pixels - 1.0
        return np.moveaxis(chebyshev.chebval(x, coefficients), 0, -1)


def line_cameras(spec: ThreeLineCameraSpec) -> dict[str, LineCamera]:
    """Return the line cameras of a payload, ideal projections with distortion, by name (exact Chebyshev series)."""
    return {
        name: _ideal_line(name, line, spec.pixels_of(name), spec.pitch_of(name)) for name, line in spec.lines.items()
    }


def polynomial_line(name: str, pixels: int, forward: ArrayLike, right: ArrayLike) -> LineCamera:
    """Return a line camera whose look angles have tangents that are polynomials in the pixel (exact).

    Parameters
    ----------
    name : str
        Name of the line.
    pixels : int
        Number of pixels.
    forward : (K,) array_like for K coefficients
        Coefficients of the tangent of the forward look angle, ascending powers of the pixel.
    right : (K,) array_like
        Coefficients of the tangent of the look angle to the right, ascending powers of the pixel.
    """
    ahead, aside = np.atleast_1d(forward), np.atleast_1d(right)

    def look(pixel: np.ndarray) -> np.ndarray:
        x, y = (np.polynomial.polynomial.polyval(pixel, c) for c in (ahead, aside))
        return np.stack([x, y, np.ones_like(pixel)], axis=-1)

    directions = _coefficients(look, pixels, max(len(ahead), len(aside)))
    return LineCamera(name, pixels, directions, np.zeros((1, 3)))


def _ideal_line(name: str, line: LineCameraSpec, pixels: int, pitch: float) -> LineCamera:
    """Return a line of an ideal projection with radial distortion and offsets of its CCDs."""
    to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
    degree = 5 if line.k2 else 3

    def look(pixel: np.ndarray, ccd: CcdSpec | None = None) -> np.ndarray:
        x, y = (_ccd_positions(line, ccd, pixel, pixels, pitch) - np.array(line.principal_point)).T
        square = x**2 + y**2
        corrected = 1.0 + line.k1 * square + line.k2 * square**2
        return np.stack([-x * corrected, -y * corrected, np.full_like(y, line.principal_distance)], axis=-1) @ to_body.T

    pieces = []
    for ccd in line.ccds:
        terms = degree + 1 if ccd.psi_x is None else max(_LOOK_TERMS, len(ccd.psi_x), len(ccd.psi_y or ()))
        width = ccd.last - ccd.first + 1
        nodes = ccd.first + _nodes(width, terms)
        pieces.append(LinePiece(ccd.first, ccd.last, _through(look(nodes, ccd))))
    straight = _coefficients(look, pixels, degree + 1)
    return LineCamera(name, pixels, straight, np.array([line.position]), tuple(pieces))


def pixel_positions(line: LineCameraSpec, pixel: np.ndarray, pixels: int, pitch: float) -> np.ndarray:
    """Return focal-plane positions of a line's pixels, x (flight) and y (along the line) from its centre, in metres.

    Parameters
    ----------
    line : LineCameraSpec
        Line of a payload.
    pixel : (N,) ndarray for N pixels
        Positions on the line, pixels.
    pixels : int
        Number of pixels of the line.
    pitch : float
        Pixel pitch, metres.

    Returns
    -------
    (N, 2) ndarray
        Positions x and y, metres.
    """
    at = np.asarray(pixel, dtype=np.float64)
    position = _ccd_positions(line, None, at, pixels, pitch)
    for ccd in line.ccds:
        here = (at >= ccd.first - 0.5) & (at <= ccd.last + 0.5)
        position[here] = _ccd_positions(line, ccd, at[here], pixels, pitch)
    return position


def _ccd_positions(
    line: LineCameraSpec, ccd: CcdSpec | None, pixel: np.ndarray, pixels: int, pitch: float
) -> np.ndarray:
    """Return x and y, in metres, of pixels of one CCD, or of a straight line if `ccd` is None, (N, 2) for N pixels."""
    straight = (pixel - 0.5 * (pixels - 1)) * pitch
    if ccd is None:
        return np.stack([np.zeros_like(straight), straight], axis=-1)
    if ccd.psi_x is not None and ccd.psi_y is not None:
        x, y = (np.tan(np.polynomial.polynomial.polyval(pixel, c)) for c in (ccd.psi_x, ccd.psi_y))
        return np.array(line.principal_point) - line.principal_distance * np.stack([x, y], axis=-1)
    middle = (0.5 * (ccd.first + ccd.last) - 0.5 * (pixels - 1)) * pitch
    along, angle = straight - middle, ccd.rotate
    return np.stack([ccd.shift[0] - along * np.sin(angle), ccd.shift[1] + middle + along * np.cos(angle)], axis=-1)


def traced_line_cameras(instrument: Instrument, backend: Backend, state: State | None = None) -> dict[str, LineCamera]:
    """Trace the chief rays of an instrument of mirror cameras and return its line cameras, by name."""
    names = list(instrument.cameras)
    states: list[State] = [state or {}]
    placed = instrument.assembly.place(states)
    lines = {name: instrument.cameras[name].spec.line for name in names}
    points, guesses = [], []
    for name, line in lines.items():
        y = (_nodes(line.pixels, TRACED_POINTS) - 0.5 * (line.pixels - 1)) * line.pitch
        on_line = np.stack([np.zeros_like(y), y, np.zeros_like(y)], axis=-1)
        points.append(points_to_world(placed, line_body(f"{BASE}/{name}"), on_line))
        guesses.append(instrument.toward_optics(placed, name))
    to_stop = assemble(instrument.assembly, [f"{name}/image_to_stop" for name in names], states, placed=placed)
    to_object = assemble(instrument.assembly, [f"{name}/image_to_object" for name in names], states, placed=placed)
    image, guess = np.concatenate(points), np.concatenate(guesses)[:, None]
    position, direction = chief_rays(backend, to_stop, to_object, image, guess, np.array([0.0, 1.0, 0.0]))
    cameras = {}
    for i, (name, line) in enumerate(lines.items()):
        camera_origin = np.array(instrument.spec.cameras[name].position)
        offset = position[i] - camera_origin
        nearest = position[i] - direction[i] * np.sum(offset * direction[i], axis=-1, keepdims=True)
        series = [_chopped(_through(values)) for values in (direction[i], nearest)]
        cameras[name] = LineCamera(name, line.pixels, series[0], series[1])
    return cameras


def look_angle(a: LineCamera, b: LineCamera) -> float:
    """Return the angle between the lines of sight of the middles of two lines, in radians, 0 to pi."""
    first, second = (camera.look(np.array([0.5 * (camera.pixels - 1)]))[0] for camera in (a, b))
    return _angle(first, second)


def along_track_angle(a: LineCamera, b: LineCamera) -> float:
    """Return the angle along the track from the middle of line b to that of line a, in radians.

    It is the rotation about the mean direction of the two detector lines, positive where `a` looks ahead of `b`: the
    part of `look_angle` that determines heights by parallax. Lines that look in one direction side by side have the
    angle 0. The direction of a detector line is perpendicular to its central line of sight, in the plane of its lines
    of sight.
    """
    first, second = (camera.look(np.array([0.5 * (camera.pixels - 1)]))[0] for camera in (a, b))
    sides = [np.cross(look, line_normal(camera)) for look, camera in ((first, a), (second, b))]
    axis = sum(side / np.linalg.norm(side) for side in sides)
    axis = axis / np.linalg.norm(axis)
    return float(np.arctan2(axis @ np.cross(second, first), first @ second - (first @ axis) * (second @ axis)))


def dihedral_angle(
    a: LineCamera, b: LineCamera, pixels: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
) -> float:
    """Return the angle between the planes of two lines, in radians, 0 to pi/2.

    The plane of a line goes through the station and fits its lines of sight best (total least squares over the whole
    line, or over the given `pixels` of each line). Ground points of the strips give this angle (paper 000, Liu and
    Huang 2014, eqs. 1 to 7). It differs from `look_angle` when the lines are not parallel.
    """
    angle = _angle(*(line_normal(camera, pixel) for camera, pixel in zip((a, b), pixels, strict=True)))
    return min(angle, np.pi - angle)


@dataclass(frozen=True, eq=False)
class LineAngles:
    """Angles between pairs of lines, name of the angle -> radians.

    Attributes
    ----------
    cameras : mapping of str to LineCamera
        Camera of each line.
    pairs : mapping of str to tuple of str
        The two lines of each angle.
    pixel : mapping of str to (n,) ndarray for n points
        Positions of the ground points on each line whose angles are measured, pixels.
    """

    cameras: Mapping[str, LineCamera]
    pairs: Mapping[str, tuple[str, str]]
    pixel: Mapping[str, np.ndarray]

    @property
    def look(self) -> dict[str, float]:
        """Angles between the lines of sight of the lines' centres, name of the angle -> radians, 0 to pi."""
        return {name: look_angle(self.cameras[a], self.cameras[b]) for name, (a, b) in self.pairs.items()}

    @property
    def along_track(self) -> dict[str, float]:
        """Signed along-track components of `look`, in radians, positive where the first line looks ahead."""
        return {name: along_track_angle(self.cameras[a], self.cameras[b]) for name, (a, b) in self.pairs.items()}

    @property
    def dihedral(self) -> dict[str, float]:
        """Angles between the planes of the lines, fitted at the ground points' pixels, name of the angle -> radians."""
        return {
            name: dihedral_angle(self.cameras[a], self.cameras[b], (self.pixel[a], self.pixel[b]))
            for name, (a, b) in self.pairs.items()
        }


def line_normal(camera: LineCamera, pixel: np.ndarray | None = None) -> np.ndarray:
    """Return the unit normal of a line's best plane through the station, body frame, (3,), on the forward side (+X).

    Parameters
    ----------
    camera : LineCamera
        Line camera.
    pixel : ndarray or None
        Pixels to which the plane is fitted; None for the whole line.
    """
    looks = camera.look(np.linspace(0.0, camera.pixels - 1.0, _PLANE_POINTS) if pixel is None else pixel)
    # The singular vector is not taken from the normal equations, which would lose half of the digits.
    normal = np.linalg.svd(looks, full_matrices=False)[2][-1]
    return normal if normal[0] > 0.0 else -normal


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two vectors, in radians."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _nodes(pixels: int, count: int) -> np.ndarray:
    """Return the Chebyshev points of the line, (count,), in pixels."""
    return 0.5 * (chebyshev.chebpts1(count) + 1.0) * pixels - 0.5


def _through(values: np.ndarray) -> np.ndarray:
    """Return the coefficients (K, 3) of the Chebyshev series with given values (K, 3) at K Chebyshev points."""
    count = len(values)
    basis = chebyshev.chebvander(chebyshev.chebpts1(count), count - 1)
    weight = np.full(count, 2.0 / count)
    weight[0] = 1.0 / count
    return weight[:, None] * (basis.T @ values)  # the basis is orthogonal at the points, so no equations are solved


def _coefficients(function: Callable[[np.ndarray], np.ndarray], pixels: int, count: int) -> np.ndarray:
    """Return the Chebyshev coefficients (count, 3) of a vector function of the pixel."""
    return _through(function(_nodes(pixels, count)))


def _chopped(coefficients: np.ndarray) -> np.ndarray:
    """Return the Chebyshev series without those of its last terms that are only rounding errors."""
    size = np.max(np.abs(coefficients), axis=-1)
    used = np.flatnonzero(size > _NOISE * np.max(size))
    return coefficients[: used[-1] + 1]


def calibrated_line(line: LineCamera, axes: np.ndarray, principal_distance: float) -> CalibratedLine:
    """Convert a traced line to the camera model that the analysis uses.

    Parameters
    ----------
    line : LineCamera
        Line of one CCD.
    axes : (3, 3) ndarray
        Axes X, Y, Z of its camera in the body frame as columns, about which the camera's changes are rotations.
    principal_distance : float
        Principal distance of the line, metres.
    """
    return CalibratedLine(line.pixels, line.directions, line.origins, axes, principal_distance)


def calibrated_lines(
    lines: Mapping[str, LineCamera], instrument: Instrument, backend: Backend
) -> dict[str, CalibratedLine]:
    """Convert the lines of an instrument to the camera models that the analysis uses, by camera.

    Parameters
    ----------
    lines : mapping of str to LineCamera
        Lines of the unperturbed instrument, from `twin.orbit.flight.line_camera.traced_line_cameras`.
    instrument : Instrument
        The unperturbed instrument.
    backend : Backend
        Array backend that traces the rays.
    """
    sight = LineSight(instrument, backend)
    distance = sight.truth([{}]).principal_distance
    return {name: calibrated_line(line, sight.axes[name], distance[name]) for name, line in lines.items()}


def corrected_line(line: LineCamera, calibrated: CalibratedLine, change: ArrayLike) -> LineCamera:
    """Return a line corrected for a change of its camera.

    Parameters
    ----------
    line : LineCamera
        Line camera as it was calibrated.
    calibrated : CalibratedLine
        The same line as the analysis models it, from `calibrated_lines`.
    change : (4,) array_like
        Rotations d_alpha, d_beta, d_gamma about the camera's Y, X and line of sight (rad), and change d_f of the
        principal distance (m), since the calibration.

    Raises
    ------
    ValueError
        The change has another shape, is not finite, or leaves no positive principal distance.
    """
    return replace(line, directions=calibrated.corrected(change).directions)
