"""Line cameras in orbit: what every pixel looks along in the body frame, when lines are exposed, what drifts.

Body frame (the instrument's base): X forward, Z toward the scene, Y = Z x X. A pixel's ray has an origin as well as a
direction, because the chief rays of a mirror camera do not meet in one exact point. Both are smooth functions of the
pixel and are kept as Chebyshev series over the line: exact for an ideal projection with distortion, which is a
polynomial, and for a traced line as good as the trace.

Lines of an instrument after changes that its on-board monitor has estimated.

What a change does to the looks of a line is `analysis.orbit.forward_intersection.CalibratedLine.corrected`, which also
corrects lines that are intersected; here the corrected looks go back into the line that a sensor flies with.
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
    """Times at lines of an image, linear between them and as far as half a line beyond the first and the last.

    Attributes
    ----------
    line : Array
        (K,) image coordinates, increasing; the middle of the first line is 0.
    time : Array
        (K,) middle of the exposure, seconds of the trajectory, increasing.
    """

    line: Array
    time: Array

    @classmethod
    def of(cls, line: ArrayLike, time: ArrayLike) -> LineTimes:
        """The table, checked.

        Parameters
        ----------
        line : ArrayLike
            (K,), at least two.
        time : ArrayLike
            (K,), seconds.

        Raises
        ------
        ValueError
            Shapes that do not match, fewer than two rows, values that are not finite or do not increase.
        """
        at, moment = np.array(line, np.float64), np.array(time, np.float64)
        if at.ndim != 1 or at.shape != moment.shape or len(at) < 2:
            raise ValueError("line times: two lines or more, with a time for each")
        if not (np.all(np.isfinite(at)) and np.all(np.isfinite(moment))):
            raise ValueError("line times: a value is not finite")
        if not (np.all(np.diff(at) > 0.0) and np.all(np.diff(moment) > 0.0)):
            raise ValueError("line times: lines and times must increase")
        return cls(at, moment)

    @classmethod
    def even(cls, first_time: float, line_time: float, lines: int) -> LineTimes:
        """Times of lines that follow one another evenly, from line 0 on, seconds."""
        last = float(max(lines - 1, 1))
        return cls.of([0.0, last], [first_time, first_time + last * line_time])

    @property
    def line_time(self) -> float:
        """Mean time from one line to the next, seconds."""
        return float((self.time[-1] - self.time[0]) / (self.line[-1] - self.line[0]))

    def at(self, line: ArrayLike) -> np.ndarray:
        """Times of lines (...), seconds; beyond the ends by the slope there."""
        x = np.asarray(line, dtype=np.float64)
        k = np.clip(np.searchsorted(self.line, x, side="right") - 1, 0, len(self.line) - 2)
        slope = (self.time[k + 1] - self.time[k]) / (self.line[k + 1] - self.line[k])
        return np.asarray(self.time[k] + (x - self.line[k]) * slope)


def changed_payload(
    spec: OrbitCalibrationSpec | OrbitSimulateSpec, payload: ThreeLineCameraSpec
) -> ThreeLineCameraSpec:
    """The camera as it is after launch.

    Parameters
    ----------
    spec : OrbitCalibrationSpec | OrbitSimulateSpec
        a test, whose ``perturb`` names lines.
    payload : ThreeLineCameraSpec
        As the laboratory has measured it.
    """
    lines = {}
    for name, line in payload.lines.items():
        if name in spec.perturb:
            change = spec.perturb[name]
            point = tuple(a + b for a, b in zip(line.principal_point, change.principal_point, strict=True))
            focal = line.principal_distance + change.principal_distance
            line = line.model_copy(update={"principal_distance": focal, "principal_point": point})
        lines[name] = line
    return payload.model_copy(update={"lines": FrozenMap(lines)})


def drifted_payload(payload: ThreeLineCameraSpec, drift: Mapping[str, np.ndarray]) -> ThreeLineCameraSpec:
    """The camera with each line turned in its own axes, Rx(d_beta) Ry(d_alpha) Rz(d_gamma), and with f + d_f.

    Parameters
    ----------
    payload : ThreeLineCameraSpec
        The camera.
    drift : Mapping[str, np.ndarray]
        Line -> (4,) d_alpha, d_beta, d_gamma (radians) and d_f (metres).
    """
    lines = dict(payload.lines)
    for name, (alpha, beta, gamma, longer) in drift.items():
        line = lines[name]
        turn = (
            rotation_matrix(np.array(line.rotate)) @ about_axis(0, beta) @ about_axis(1, alpha) @ about_axis(2, gamma)
        )
        rotate = tuple(Rotation.from_matrix(turn).as_rotvec().tolist())
        lines[name] = line.model_copy(
            update={"rotate": rotate, "principal_distance": line.principal_distance + float(longer)}
        )
    return payload.model_copy(update={"lines": FrozenMap(lines)})


TRACED_POINTS = 49
"""Points of a traced line. An unperturbed line needs nine terms; the rest is for figure errors."""
_NOISE = 1e-14
"""Terms of a traced series below this share are rounding and are dropped (one pixel is 1e-6 rad)."""
_PLANE_POINTS = 1001
_LOOK_TERMS = 12
"""Terms for the tangent of a look angle within 30 deg over one CCD. They fall off by a thousandfold every few terms."""


@dataclass(frozen=True, eq=False)
class LinePiece:
    """One CCD of a line.

    Attributes
    ----------
    first, last : int
        Its pixels.
    directions : np.ndarray
        As those of `LineCamera`, over its own pixels.
    """

    first: int
    last: int
    directions: np.ndarray


@dataclass(frozen=True, eq=False)
class LineCamera:
    """One line of pixels and what it sees.

    Pixels are counted along +Y' of the real focal plane, the centre of the first is 0, so they see the scene from +Y to
    -Y of the body. A place on the line is any real number from -0.5 to pixels - 0.5.

    Attributes
    ----------
    name : str
        Of the line.
    pixels : int
        How many.
    directions : np.ndarray
        Chebyshev coefficients over the line of a vector along the look, body frame, (K, 3); its length does not matter.
    origins : np.ndarray
        Those of a point on the ray, body frame, (J, 3), metres.
    pieces : tuple[LinePiece, ...]
        Of a line of several CCDs, from its first pixel on, in place of ``directions``, which then are those without
        offsets.
    """

    name: str
    pixels: int
    directions: np.ndarray
    origins: np.ndarray
    pieces: tuple[LinePiece, ...] = ()

    def turned(self, turn: np.ndarray) -> LineCamera:
        """The line with its looks turned in body axes, look @ turn, (3, 3)."""
        pieces = tuple(replace(piece, directions=piece.directions @ turn) for piece in self.pieces)
        return replace(self, directions=self.directions @ turn, pieces=pieces)

    def look(self, pixel: np.ndarray) -> np.ndarray:
        """Unit directions toward the scene, body frame: pixels (N,) -> (N, 3).

        Raises
        ------
        ValueError
            a pixel outside the line.
        """
        vector = self._vector(pixel)[0]
        return vector / np.linalg.norm(vector, axis=-1, keepdims=True)

    def look_and_slope(self, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`look` and its derivative by the pixel, radians per pixel, both (N, 3); the derivative is square to the look.

        Raises
        ------
        ValueError
            a pixel outside the line.
        """
        vector, change = self._vector(pixel)
        length = np.linalg.norm(vector, axis=-1, keepdims=True)
        look = vector / length
        return look, (change - look * np.sum(look * change, axis=-1, keepdims=True)) / length

    def relative_illumination(self, pixel: np.ndarray) -> np.ndarray:
        """Return the light on pixels (N,) over that on the line's middle, (N,), of ground of one radiance.

        An entrance pupil of one size is seen foreshortened, by cos w of the field angle w, from a pixel that looks over
        a solid angle of its angle along the line by its angle across, pitch x cos w / f. That is cos^4 w of a
        projection without distortion, and follows the distortion of another.

        Raises
        ------
        ValueError
            a pixel outside the line.
        """
        look, slope = self.look_and_slope(np.concatenate([[0.5 * (self.pixels - 1)], np.asarray(pixel, np.float64)]))
        rate = np.linalg.norm(slope, axis=-1)
        return np.asarray((look[1:] @ look[0]) ** 2 * rate[1:] / rate[0])

    def origin(self, pixel: np.ndarray) -> np.ndarray:
        """Points on the rays, body frame: pixels (N,) -> (N, 3), metres.

        Raises
        ------
        ValueError
            a pixel outside the line.
        """
        return self._series(self.origins, self._checked(pixel))

    def _vector(self, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A vector along the look and its derivative by the pixel, both (N, 3)."""
        at = self._checked(pixel)
        change = self._series(chebyshev.chebder(self.directions), at) * (2.0 / self.pixels)
        vector = self._series(self.directions, at)
        for piece in self.pieces:
            here = (at >= piece.first - 0.5) & (at <= piece.last + 0.5)
            width = piece.last - piece.first + 1
            place = (2.0 * (at[here] - piece.first) + 1.0) / width - 1.0
            slope = chebyshev.chebder(piece.directions) * (2.0 / width)
            vector[here] = np.moveaxis(chebyshev.chebval(place, piece.directions), 0, -1)
            change[here] = np.moveaxis(chebyshev.chebval(place, slope), 0, -1)
        return vector, change

    def _checked(self, pixel: np.ndarray) -> np.ndarray:
        """Return pixels on the line; those outside it by rounding lie at its end, on the piece that ends there."""
        if not np.all(in_span(pixel, -0.5, self.pixels - 0.5)):
            raise ValueError(f"a pixel outside the line {self.name!r}: it reaches from -0.5 to {self.pixels - 0.5}")
        return np.clip(pixel, -0.5, self.pixels - 0.5)

    def _series(self, coefficients: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        place = (2.0 * pixel + 1.0) / self.pixels - 1.0
        return np.moveaxis(chebyshev.chebval(place, coefficients), 0, -1)


def line_cameras(spec: ThreeLineCameraSpec) -> dict[str, LineCamera]:
    """The lines of a payload of ideal projections with distortion, by name (no approximation)."""
    return {
        name: _ideal_line(name, line, spec.pixels_of(name), spec.pitch_of(name)) for name, line in spec.lines.items()
    }


def polynomial_line(name: str, pixels: int, forward: ArrayLike, right: ArrayLike) -> LineCamera:
    """A line whose looks have polynomials of the pixel as tangents (no approximation).

    Parameters
    ----------
    name : str
        Of the line.
    pixels : int
        How many.
    forward : ArrayLike
        Coefficients (K,) of the tangent of a look's angle forward, ascending powers of the pixel.
    right : ArrayLike
        Likewise to the right.
    """
    ahead, aside = np.atleast_1d(forward), np.atleast_1d(right)

    def look(pixel: np.ndarray) -> np.ndarray:
        x, y = (np.polynomial.polynomial.polyval(pixel, c) for c in (ahead, aside))
        return np.stack([x, y, np.ones_like(pixel)], axis=-1)

    directions = _coefficients(look, pixels, max(len(ahead), len(aside)))
    return LineCamera(name, pixels, directions, np.zeros((1, 3)))


def _ideal_line(name: str, line: LineCameraSpec, pixels: int, pitch: float) -> LineCamera:
    to_body = about_axis(1, line.look) @ rotation_matrix(np.array(line.rotate))
    degree = 5 if line.k2 else 3

    def look(pixel: np.ndarray, ccd: CcdSpec | None = None) -> np.ndarray:
        x, y = (_ccd_places(line, ccd, pixel, pixels, pitch) - np.array(line.principal_point)).T
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


def pixel_places(line: LineCameraSpec, pixel: np.ndarray, pixels: int, pitch: float) -> np.ndarray:
    """Where pixels of a line lie in its focal plane, x (flight) and y (along the line) from the line's centre, metres.

    Parameters
    ----------
    line : LineCameraSpec
        Of a payload.
    pixel : np.ndarray
        Places on the line, (N,).
    pixels : int
        How many it has.
    pitch : float
        Of its pixels, metres.

    Returns
    -------
    np.ndarray
        (N, 2).
    """
    at = np.asarray(pixel, dtype=np.float64)
    found = _ccd_places(line, None, at, pixels, pitch)
    for ccd in line.ccds:
        here = (at >= ccd.first - 0.5) & (at <= ccd.last + 0.5)
        found[here] = _ccd_places(line, ccd, at[here], pixels, pitch)
    return found


def _ccd_places(line: LineCameraSpec, ccd: CcdSpec | None, pixel: np.ndarray, pixels: int, pitch: float) -> np.ndarray:
    """Places of pixels of one CCD, or of a straight line without CCDs; see `pixel_places`."""
    straight = (pixel - 0.5 * (pixels - 1)) * pitch
    if ccd is None:
        return np.stack([np.zeros_like(straight), straight], axis=-1)
    if ccd.psi_x is not None and ccd.psi_y is not None:
        x, y = (np.tan(np.polynomial.polynomial.polyval(pixel, c)) for c in (ccd.psi_x, ccd.psi_y))
        return np.array(line.principal_point) - line.principal_distance * np.stack([x, y], axis=-1)
    middle = (0.5 * (ccd.first + ccd.last) - 0.5 * (pixels - 1)) * pitch
    along, turn = straight - middle, ccd.rotate
    return np.stack([ccd.shift[0] - along * np.sin(turn), ccd.shift[1] + middle + along * np.cos(turn)], axis=-1)


def traced_line_cameras(instrument: Instrument, backend: Backend, state: State | None = None) -> dict[str, LineCamera]:
    """The lines of an instrument of mirror cameras, by exact chief rays of their pixels.

    Parameters
    ----------
    instrument : Instrument
        Cameras on their base, which is the satellite's body frame.
    backend : Backend
        Where to trace.
    state : State | None
        What is perturbed; None for nothing.

    Returns
    -------
    dict[str, LineCamera]
        Camera -> its line. The origins are the points of the chief rays nearest to the camera's nominal origin.

    Raises
    ------
    AimError, BeamMissedError
        The perturbation moves the image off the mirrors.
    """
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
    """Angle between the looks of the middles of two lines, radians, 0 to pi."""
    first, second = (camera.look(np.array([0.5 * (camera.pixels - 1)]))[0] for camera in (a, b))
    return _angle(first, second)


def along_track_angle(a: LineCamera, b: LineCamera) -> float:
    """Turn about the lines' mean direction that takes the middle of b to that of a, radians; + where a looks ahead.

    The part of `look_angle` that makes heights: it has a sign, and lines that look the same way but side by side have
    none. A line's direction is square to the look of its middle, in its plane.
    """
    first, second = (camera.look(np.array([0.5 * (camera.pixels - 1)]))[0] for camera in (a, b))
    sides = [np.cross(look, line_normal(camera)) for look, camera in ((first, a), (second, b))]
    axis = sum(side / np.linalg.norm(side) for side in sides)
    axis = axis / np.linalg.norm(axis)
    return float(np.arctan2(axis @ np.cross(second, first), first @ second - (first @ axis) * (second @ axis)))


def dihedral_angle(
    a: LineCamera, b: LineCamera, places: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
) -> float:
    """Angle between the planes of two lines, radians, 0 to pi/2.

    A line's plane is the one through the station that its looks depart from least (total least squares over the whole
    line, or over the pixels `places`, each (N,)). It is what ground points of the strips give (paper 000, eqs. 1 to 7),
    and differs from `look_angle` when the lines are not parallel.
    """
    angle = _angle(*(line_normal(camera, place) for camera, place in zip((a, b), places, strict=True)))
    return min(angle, np.pi - angle)


@dataclass(frozen=True, eq=False)
class LineAngles:
    """Angles between pairs of lines, radians, by the angle's name.

    Attributes
    ----------
    cameras : Mapping[str, LineCamera]
        Line -> camera.
    pairs : Mapping[str, tuple[str, str]]
        Angle -> the two lines that it lies between.
    pixel : Mapping[str, np.ndarray]
        Line -> places of its points, (n,), of the lines that angles are measured of.
    """

    cameras: Mapping[str, LineCamera]
    pairs: Mapping[str, tuple[str, str]]
    pixel: Mapping[str, np.ndarray]

    @property
    def look(self) -> dict[str, float]:
        """Angles between the lines of sight of the lines' centres; see `look_angle`."""
        return {name: look_angle(self.cameras[a], self.cameras[b]) for name, (a, b) in self.pairs.items()}

    @property
    def along_track(self) -> dict[str, float]:
        """Signed part of `look` along the track, positive where the first line looks ahead of the second."""
        return {name: along_track_angle(self.cameras[a], self.cameras[b]) for name, (a, b) in self.pairs.items()}

    @property
    def dihedral(self) -> dict[str, float]:
        """Angles between the planes of the lines where the points are; see `dihedral_angle`."""
        return {
            name: dihedral_angle(self.cameras[a], self.cameras[b], (self.pixel[a], self.pixel[b]))
            for name, (a, b) in self.pairs.items()
        }


def line_normal(camera: LineCamera, pixel: np.ndarray | None = None) -> np.ndarray:
    """Unit normal of a line's best plane through the station, body frame, (3,), on the forward side (+X).

    pixel: (N,) places that the plane is fitted to; None for the whole line.
    """
    looks = camera.look(np.linspace(0.0, camera.pixels - 1.0, _PLANE_POINTS) if pixel is None else pixel)
    # the singular vector itself, not that of the normal equations: half of the digits would be lost there
    normal = np.linalg.svd(looks, full_matrices=False)[2][-1]
    return normal if normal[0] > 0.0 else -normal


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _nodes(pixels: int, count: int) -> np.ndarray:
    """Chebyshev points of the line, (count,), in pixels."""
    return 0.5 * (chebyshev.chebpts1(count) + 1.0) * pixels - 0.5


def _through(values: np.ndarray) -> np.ndarray:
    """Coefficients (K, 3) of the series that has these values (K, 3) at the Chebyshev points."""
    count = len(values)
    basis = chebyshev.chebvander(chebyshev.chebpts1(count), count - 1)
    weight = np.full(count, 2.0 / count)
    weight[0] = 1.0 / count
    return weight[:, None] * (basis.T @ values)  # the points are orthogonal: no equations to solve


def _coefficients(function: Callable[[np.ndarray], np.ndarray], pixels: int, count: int) -> np.ndarray:
    return _through(function(_nodes(pixels, count)))


def _chopped(coefficients: np.ndarray) -> np.ndarray:
    """The series without its last terms that are rounding."""
    size = np.max(np.abs(coefficients), axis=-1)
    used = np.flatnonzero(size > _NOISE * np.max(size))
    return coefficients[: used[-1] + 1]


def calibrated_line(line: LineCamera, axes: np.ndarray, principal_distance: float) -> CalibratedLine:
    """A traced line in the analysis's form.

    Parameters
    ----------
    line : LineCamera
        Of one CCD.
    axes : np.ndarray
        (3, 3) columns X, Y, Z of its camera in the body, about which changes count.
    principal_distance : float
        Of it, metres.
    """
    return CalibratedLine(line.pixels, line.directions, line.origins, axes, principal_distance)


def calibrated_lines(
    lines: Mapping[str, LineCamera], instrument: Instrument, backend: Backend
) -> dict[str, CalibratedLine]:
    """Lines of an instrument as its calibration knows them, by camera.

    Parameters
    ----------
    lines : Mapping[str, LineCamera]
        Of the unperturbed instrument, as `twin.orbit.flight.line_camera.traced_line_cameras` finds them.
    instrument : Instrument
        That is unperturbed.
    backend : Backend
        Where to trace.
    """
    sight = LineSight(instrument, backend)
    distance = sight.truth([{}]).principal_distance
    return {name: calibrated_line(line, sight.axes[name], distance[name]) for name, line in lines.items()}


def corrected_line(line: LineCamera, calibrated: CalibratedLine, change: ArrayLike) -> LineCamera:
    """A line after a change.

    Parameters
    ----------
    line : LineCamera
        As it was calibrated.
    calibrated : CalibratedLine
        The same line, by `calibrated_lines`.
    change : ArrayLike
        (4,) d_alpha, d_beta, d_gamma (rad) and d_f (m) since then.

    Raises
    ------
    ValueError
        Another shape, numbers that are not finite, no principal distance left.
    """
    return replace(line, directions=calibrated.corrected(change).directions)
