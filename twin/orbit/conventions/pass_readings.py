"""Files of a pass, their interpretation under any conventions, and the fit of an interpretation to ground points.

Each image point is projected to the height of its ground point, and the difference of the two in plan is the residual.
It is due to errors of the image point, of the ground point, and of camera and platform. The latter are within the
uncertainty that the file specifies: a rotation and a shift of the platform and a shift of the times, which all points
share, and a shift and a scale of each line. The residuals are therefore strongly correlated. A wrong convention whose
effect looks like one of these errors cannot be detected from the points; any other wrong convention is clearly
detected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from optics.geometry.pose import rotation_matrix
from optics.numerics.array_math import in_span
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import InputError, Problem, names_text, nearest, shown
from scenes.yaml.units import TIME
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.line_camera import LineCamera, LineTimes
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import LightEffects, Sensor
from twin.orbit.measured.dimap_file import is_dimap, read_dimap
from twin.orbit.measured.earth_orientation import Readings, constant_orientation
from twin.orbit.measured.ground_files import GroundFile, read_ground_points
from twin.orbit.measured.measurement_tables import COLUMNS, image_covariance, require_known
from twin.orbit.measured.pass_measurements import ImagePoints
from twin.orbit.measured.platform_files import Conventions, PlatformReadings, clock_of, platform_table, read_platform
from twin.orbit.measured.xml_file import first_lines

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import ImagePointsFileSpec, LineTimesFileSpec, OrbitCheckSpec, UncertaintySpec
    from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec

_LINES = (
    Column("camera", text=True),
    Column("line"),
    Column("time", TIME, needed=False),
    Column("date_time", text=True, needed=False),
)
_AROUND = 120.0
"""Duration of orbit and attitude data retained before and after the times of the lines, in seconds, because time scales
(such as UTC and TAI) differ by up to 70 s.
"""
_LEAST_AROUND = 12
"""Smallest number of readings of orbit and attitude retained before and after the times of the lines."""


@dataclass(frozen=True, eq=False)
class LineClock:
    """Exposure times of image lines as clock readings, before interpretation.

    Attributes
    ----------
    line : (K,) ndarray for K lines
        Numbers of lines, increasing.
    clock : Readings
        K readings of the clock, one for each line.
    """

    line: np.ndarray
    clock: Readings


@dataclass(frozen=True)
class PassConventions:
    """Conventions of a pass: one interpretation of its files.

    Attributes
    ----------
    platform : Conventions
        Conventions of orbit and attitude.
    line_scale : str
        Time scale of the lines.
    line_offset : float
        Seconds to be added to the lines' times.
    moment : str
        Moment of the exposure to which a line's time refers: start, middle or end.
    line_origin : float
        Image coordinate of the middle of the line that the table of times calls 0.
    pixel_origin : float
        Image coordinate of the middle of the first pixel.
    first_pixel_sees : str
        Side of the track to which the first pixel looks, right or left.
    backward : bool
        True if image lines are counted from the last one exposed.
    """

    platform: Conventions
    line_scale: str
    line_offset: float
    moment: str
    line_origin: float
    pixel_origin: float
    first_pixel_sees: str
    backward: bool = False


@dataclass(frozen=True, eq=False)
class PassReadings:
    """Content of a pass's files before interpretation.

    Attributes
    ----------
    platform : PlatformReadings
        Orbit and attitude about the lines' times.
    lines : mapping of str to LineClock
        Line times by camera.
    ground : GroundFile
        Ground points.
    images : mapping of str to ImagePoints
        Image points by camera, with the line and pixel numbers of the file.
    """

    platform: PlatformReadings
    lines: Mapping[str, LineClock]
    ground: GroundFile
    images: Mapping[str, ImagePoints]


def read_pass(spec: OrbitCheckSpec, camera: ThreeLineCameraSpec, folder: Path) -> tuple[PassReadings, PassConventions]:
    """Read the files of a pass, with the conventions that the test file specifies.

    Parameters
    ----------
    spec : OrbitCheckSpec
        Paths of the files, and their conventions.
    camera : ThreeLineCameraSpec
        Payload with the lines.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    InputError
        A file cannot be read, or has names that another file does not have.
    """
    platform, conventions = read_platform(spec.platform, folder)
    lines = read_line_clocks(spec.lines, tuple(camera.lines), folder)
    ground = read_ground_points(spec.ground, folder)
    if Path(spec.image_points.file).suffix.lower() == ".gcp":
        images = _gcp_points(spec, ground, lines, folder)
    else:
        images = _image_points(spec.image_points, ground, lines, folder)
    half, points = 0.5 if spec.image_points.centre == "half" else 0.0, spec.image_points
    origins = (half, half + points.first_pixel, points.first_pixel_sees)
    specified = PassConventions(conventions, spec.lines.time_scale, 0.0, spec.lines.moment, *origins)
    return PassReadings(_around(platform, lines), lines, ground, images), specified


def read_line_clocks(spec: LineTimesFileSpec, cameras: tuple[str, ...], folder: Path) -> dict[str, LineClock]:
    """Read the line times of every camera in the table.

    Parameters
    ----------
    spec : LineTimesFileSpec
        Path of the table, and what the table itself does not specify.
    cameras : tuple of str
        Allowed names of cameras.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    InputError
        The table cannot be read, a camera is unknown or has fewer than two lines, or lines or times do not increase.
    """
    if is_dimap(list(first_lines(folder / spec.file, "line times: CSV, or DIMAP"))):
        return _scene_lines(spec, cameras, folder)
    table = read_table(folder / spec.file, _LINES, 2)
    clock = clock_of(table, spec)
    names = table["camera"].astype(str)
    require_known(table, "camera", cameras)
    clocks = {}
    for name in dict.fromkeys(names.tolist()):
        rows = np.flatnonzero(names == name)
        if len(rows) < 2:
            raise table.error(int(rows[0]), "line", f"one line of {name} gives no line time", None, "two or more")
        line, times = table["line"][rows], clock.taken(rows)
        step = np.diff(times.day) * 86400.0 + np.diff(times.second)
        for what, rise in (("line", np.diff(line)), ("time", step)):
            if np.any(rise <= 0.0):
                row, head = int(rows[int(np.argmax(rise <= 0.0)) + 1]), what if what in table else "date_time"
                raise table.error(
                    row, head, f"{what}s of {name} do not increase", None, "rows in order, each line once"
                )
        clocks[name] = LineClock(line, times)
    return clocks


def _scene_lines(spec: LineTimesFileSpec, cameras: tuple[str, ...], folder: Path) -> dict[str, LineClock]:
    """Return the line times of a DIMAP file, which has a single line camera; its lines count from 0."""
    if len(cameras) != 1:
        allowed = "a camera of one line, or a table"
        raise spec.error("a scene has the times of one line", ("file",), value=names_text(cameras), allowed=allowed)
    if spec.time_scale != "UTC":
        raise spec.error("a scene's times are in UTC", ("time_scale",), value=spec.time_scale, allowed="UTC")
    read = read_dimap(folder / spec.file)
    last = max(read.lines - 1, 1)
    second = read.first_line.second[0] + np.array([0.0, last * read.line_time])
    over = np.floor(second / 86400.0)
    clock = Readings(read.first_line.day[0] + over.astype(np.int64), second - 86400.0 * over)
    return {cameras[0]: LineClock(np.array([0.0, float(last)]), clock)}


def _image_points(
    spec: ImagePointsFileSpec, ground: GroundFile, lines: Mapping[str, LineClock], folder: Path
) -> Mapping[str, ImagePoints]:
    """Read the table of image points, with the line and pixel numbers of the file."""
    table = read_table(folder / spec.file, COLUMNS["image_points"])
    known = {str(name): k for k, name in enumerate(ground.points.ids)}
    names, cameras = table["point"].astype(str), table["camera"].astype(str)
    require_known(table, "camera", tuple(lines))
    number = np.array([known.get(name, -1) for name in names.tolist()])
    for row in np.flatnonzero(number < 0)[:1]:
        name = str(names[row])
        raise table.error(int(row), "point", "no such ground point", shown(name), None, nearest(name, known))
    points = {}
    for camera in dict.fromkeys(cameras.tolist()):
        rows = np.flatnonzero(cameras == camera)
        _, first = np.unique(number[rows], return_index=True)
        if len(first) != len(rows):
            row = int(rows[np.setdiff1d(np.arange(len(rows)), first)[0]])
            raise table.error(row, "point", f"twice in {camera}", shown(str(names[row])), "each point once")
        spread = image_covariance(table, rows)
        points[camera] = ImagePoints(number[rows], table["line"][rows], table["pixel"][rows], spread)
    return FrozenMap(points)


def _gcp_points(
    spec: OrbitCheckSpec, ground: GroundFile, lines: Mapping[str, LineClock], folder: Path
) -> Mapping[str, ImagePoints]:
    """Return the image points in the .gcp file of the ground points; an image's name is that of its line camera."""
    file = spec.image_points.file
    if (folder / file) != (folder / spec.ground.file):
        allowed = "the file of `ground`, or a table"
        raise spec.image_points.error("image points of another .gcp file", ("file",), value=file, allowed=allowed)
    points = {}
    for image, rows in ground.images.items():
        camera = Path(image).stem
        if camera not in lines:
            problem, allowed = ("an image of none of the camera's lines", names_text(f"{name}.tif" for name in lines))
            raise spec.image_points.error(problem, ("file",), value=shown(image), allowed=allowed)
        covariance = rows[:, 3:, None] ** 2 * np.eye(2)
        points[camera] = ImagePoints.of(rows[:, 0].astype(np.intp), rows[:, 1], rows[:, 2], covariance)
    if not points:
        raise spec.image_points.error("a .gcp file without images", ("file",), allowed="image, column, row, two sigmas")
    return FrozenMap(points)


def _around(platform: PlatformReadings, lines: Mapping[str, LineClock]) -> PlatformReadings:
    """Cut orbit and attitude to the part that some interpretation of the line times can need."""
    ends = [(c.clock.day[k], c.clock.second[k]) for c in lines.values() for k in (0, -1)]
    day, second = min(ends)
    last = max((d - day) * 86400.0 + s - second for d, s in ends)

    def covering(clock: Readings) -> slice:
        since = (clock.day - day) * 86400.0 + clock.second - second
        begin, end = (int(np.searchsorted(since, t)) for t in (-_AROUND, last + _AROUND))
        return slice(max(begin - _LEAST_AROUND, 0), end + _LEAST_AROUND)

    orbit, attitude = platform.orbit, platform.attitude
    a, b = covering(orbit.clock), covering(attitude.clock)
    if len(orbit.clock.taken(a)) < 2 or len(attitude.clock.taken(b)) < 2:
        return platform  # the caller reports missing readings
    return replace(platform, orbit=orbit.taken(a), attitude=attitude.taken(b))


_SCALES = ("UTC", "GPS", "TAI", "TT")
_FRAMES = ("ITRS", "GCRS", "EME2000", "TEME")
_OPPOSITE = {"forward": "back", "back": "forward", "right": "left", "left": "right", "down": "up", "up": "down"}


@dataclass(frozen=True)
class TestedConvention:
    """Convention that a check tests, with its possible values.

    Attributes
    ----------
    title : str
        Name of the convention in reports.
    key : str
        Attribute of the conventions of a pass or, after ``platform.``, of those of its platform.
    values : tuple
        Possible values; empty if they depend on the specified one.
    text : callable
        Function that returns a value as text for reports.
    """

    title: str
    key: str
    values: tuple[Any, ...]
    text: Callable[[Any], str] = str

    def get(self, conventions: PassConventions) -> Any:
        """Return the value of the convention."""
        return attrgetter(self.key)(conventions)

    def put(self, conventions: PassConventions, value: Any) -> PassConventions:
        """Return the conventions with another value of this one."""
        name = self.key.removeprefix("platform.")
        if name == self.key:
            return replace(conventions, **{name: value})
        return replace(conventions, platform=replace(conventions.platform, **{name: value}))


def _rotated_axes(c: PassConventions) -> tuple[tuple[str, str, str], ...]:
    """Return the body axes that the file specifies, and these axes rotated by 180 degrees about each of them."""
    a = c.platform.body_axes
    x, y, z = (_OPPOSITE[v] for v in a)
    return a, (a[0], y, z), (x, a[1], z), (x, y, a[2])


def _seconds(value: float) -> str:
    """Return an offset of the times, in seconds, as text for reports."""
    return f"{value:+g} s" if value else "none"


TESTED_CONVENTIONS: Mapping[str, TestedConvention] = FrozenMap(
    {
        "quaternion_scalar": TestedConvention("scalar of the quaternion", "platform.scalar", ("last", "first")),
        "quaternion_turns": TestedConvention("quaternion turns", "platform.sense", ("body_to_frame", "frame_to_body")),
        "body_axes": TestedConvention("body x, y, z point", "platform.body_axes", (), ", ".join),
        "angle_sequence": TestedConvention(
            "sequence of the angles", "platform.sequence", ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
        ),
        "attitude_frame": TestedConvention("frame of the attitude", "platform.attitude_frame", _FRAMES),
        "orbit_frame": TestedConvention("frame of the orbit", "platform.orbit_frame", _FRAMES),
        "orbit_time_scale": TestedConvention("time scale of the orbit", "platform.orbit_scale", _SCALES),
        "attitude_time_scale": TestedConvention("time scale of the attitude", "platform.attitude_scale", _SCALES),
        "line_time_scale": TestedConvention("time scale of the lines", "line_scale", _SCALES),
        "line_time_offset": TestedConvention("offset of the line times", "line_offset", (0.0, -1.0, 1.0), _seconds),
        "line_moment": TestedConvention("moment of a line's time", "moment", ("start", "middle", "end")),
        "line_origin": TestedConvention(
            "coordinate of the middle of line 0", "line_origin", (0.0, 0.5, 1.0), lambda v: f"{v:g}"
        ),
        "pixel_origin": TestedConvention(
            "coordinate of the middle of the first pixel", "pixel_origin", (0.0, 0.5, 1.0, 1.5), lambda v: f"{v:g}"
        ),
        "first_pixel_sees": TestedConvention("first pixel sees", "first_pixel_sees", ("right", "left")),
        "line_axis": TestedConvention(
            "lines are counted", "backward", (False, True), lambda v: "from the last" if v else "from the first"
        ),
    }
)
"""Conventions that a check tests, with their possible values, by name."""


def alternatives(specified: PassConventions, quaternions: bool) -> dict[str, tuple[Any, ...]]:
    """Return the values of each convention other than the specified one, without conventions that do not apply.

    Parameters
    ----------
    specified : PassConventions
        Specified interpretation of the files.
    quaternions : bool
        True if the attitude is quaternions, False if it is angles.
    """
    without = {"angle_sequence"} if quaternions else {"quaternion_scalar", "quaternion_turns"}
    values = {}
    for name, convention in TESTED_CONVENTIONS.items():
        here = convention.get(specified)
        if name in without or (name == "attitude_frame" and here == "orbital"):
            continue
        possible = convention.values or _rotated_axes(specified)
        values[name] = tuple(v for v in possible if v != here)
    return values


Changes = tuple[tuple[str, Any], ...]
"""Conventions whose value differs from the specified one: pairs of the convention's name and its value."""


def singles_and_pairs(others: Mapping[str, tuple[Any, ...]], start: Changes = ()) -> Iterator[Changes]:
    """Yield `start`, then `start` with each change of one or two further conventions.

    Parameters
    ----------
    others : mapping of str to tuple
        Values of each convention other than the specified one.
    start : Changes
        Changes that all yielded sets of changes include.
    """
    yield start
    taken = {name for name, _ in start}
    singles = [(name, value) for name, values in others.items() if name not in taken for value in values]
    for change in singles:
        yield (*start, change)
    for k, first in enumerate(singles):
        for second in singles[k + 1 :]:
            if first[0] != second[0]:
                yield (*start, first, second)


def changed(conventions: PassConventions, changes: Changes) -> PassConventions:
    """Return the specified interpretation of the files with these changes."""
    for name, value in changes:
        conventions = TESTED_CONVENTIONS[name].put(conventions, value)
    return conventions


_ROTATION, _SHIFT, _DELAY, _RISE = 1e-5, 10.0, 1e-3, 10.0
"""Steps of the numerical derivatives with respect to rotation (radians), shift (metres), delay (seconds) and height
(metres).
"""
_TICKS = 1000
"""Number of lines of the auxiliary sensor; they only subdivide its time span."""


class ImpossibleError(ValueError):
    """Error raised for an interpretation of the files under which the points cannot have been imaged.

    The message gives the reason.
    """


@dataclass(frozen=True, eq=False)
class _PerturbedPlatform:
    """Platform with a small rotation and shift added at each of several times, for numerical derivatives."""

    path: TabulatedTrajectory
    rotation: np.ndarray | None = None
    shift: np.ndarray | None = None

    def position(self, seconds: Any) -> np.ndarray:
        position = self.path.position(seconds)
        # The sensor also requests its first and last line.
        return position if self.shift is None or len(position) != len(self.shift) else position + self.shift

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        return self.path.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        matrix = self.path.body_to_itrs(seconds)
        return matrix if self.rotation is None else matrix @ self.rotation


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of one interpretation of the files to the ground points.

    Attributes
    ----------
    residual : (n, 2) ndarray for n image points
        Residuals east and north, metres.
    rms : float
        RMS distance in plan, metres.
    rms_pixels : float
        RMS of the residuals in the image (along the track and along the line), pixels.
    left : (n, 2) ndarray
        Residuals after removal of the most likely errors of camera and platform, metres.
    noise : (n, 2, 2) ndarray
        Covariance of each point's residual without the part shared with others, m^2.
    chi_square : float
        Chi-square of the residuals with their full covariance.
    cost : float
        Chi-square plus the logarithm of the covariance's determinant: minus twice the log likelihood.
    freedom : int
        Degrees of freedom: number of residuals.
    """

    residual: np.ndarray
    rms: float
    rms_pixels: float
    left: np.ndarray
    noise: np.ndarray
    chi_square: float
    cost: float
    freedom: int


@dataclass(eq=False)
class PassBench:
    """Files of a pass with its cameras, and methods that fit interpretations (readings) of the files.

    Attributes
    ----------
    readings : PassReadings
        Content of the files before interpretation.
    specified : PassConventions
        Interpretation that the test file specifies.
    cameras : mapping of str to LineCamera
        Geometry of each line.
    uncertainty : UncertaintySpec
        Uncertainty of camera and platform.
    effects : LightEffects
        Effects on the light.
    epoch : str
        Instant from which times count, UTC.
    """

    readings: PassReadings
    specified: PassConventions
    cameras: Mapping[str, LineCamera]
    uncertainty: UncertaintySpec
    effects: LightEffects
    epoch: str
    _paths: dict[Conventions, TabulatedTrajectory | ImpossibleError] = field(default_factory=dict)

    def without(self, wrong: Mapping[str, np.ndarray]) -> PassBench:
        """Return a copy without the wrong image points, given as a mask (n,) for the n points of each line."""
        images = {name: raw.taken(~wrong[name]) for name, raw in self.readings.images.items()}
        remaining = {name: raw for name, raw in images.items() if len(raw.line)}
        return replace(self, readings=replace(self.readings, images=remaining), _paths=self._paths)

    def path(self, conventions: Conventions) -> TabulatedTrajectory:
        """Return the trajectory under the conventions of a platform, or raise ImpossibleError."""
        if conventions not in self._paths:
            self._paths[conventions] = self._made(conventions)
        path = self._paths[conventions]
        if isinstance(path, ImpossibleError):
            raise path
        return path

    def _made(self, conventions: Conventions) -> TabulatedTrajectory | ImpossibleError:
        """Return the trajectory under the conventions of a platform, or the error that prevents it."""
        platform = self.readings.platform
        if platform.earth is None:
            # UT1 - UTC is below a second, some hundred metres; other readings of an inertial frame are farther off.
            platform = replace(platform, earth=constant_orientation(self.epoch, 0.0, (0.0, 0.0)))
        try:
            return TabulatedTrajectory(platform_table(platform, conventions, self.epoch), conventions.law)
        except InputError as error:
            return ImpossibleError(error.issues[0].problem)

    def positions(self, reading: PassConventions, most: int | None = None) -> dict[str, np.ndarray]:
        """Return the ground positions of image points by line, ITRS, (n, 3) for n points, in metres.

        Parameters
        ----------
        reading : PassConventions
            Interpretation of the files.
        most : int or None
            Largest number of points of each line, spread over them; None for all.

        Raises
        ------
        ImpossibleError
            The points have no position on the ground.
        """
        positions = {}
        for name, raw in self.readings.images.items():
            part = raw if most is None else raw.taken(spread(len(raw.line), most))
            positions[name] = self._ground(name, reading, part, _PerturbedPlatform(self.path(reading.platform)))[0]
        return positions

    def residuals(self, reading: PassConventions, most: int | None = None) -> np.ndarray:
        """Return the residuals of the image points of all lines, east and north, (n, 2) for n points, in metres.

        Parameters
        ----------
        reading : PassConventions
            Interpretation of the files.
        most : int or None
            Largest number of points of each line, spread over them; None for all.

        Raises
        ------
        ImpossibleError
            The points have no position on the ground.
        """
        known, residuals = self.readings.ground.points.itrs, []
        for name, at in self.positions(reading, most).items():
            point = self.readings.images[name].point
            residuals.append(_plan(known[point[spread(len(point), most or len(point))]], at))
        return np.concatenate(residuals)

    def fit(self, reading: PassConventions) -> Fit:
        """Fit one interpretation of the files to the ground points, or raise ImpossibleError."""
        path, rows, common, noise, sizes = self.path(reading.platform), [], [], [], []
        size = self.uncertainty
        line_terms: list[np.ndarray] = []
        for name, raw in self.readings.images.items():
            steps, pixel_step, line_time = self._steps(name, reading, raw, path)
            known = self.readings.ground.points
            here, *moved = (_plan(known.itrs[raw.point], step) for step in steps)
            slope = [step - here for step in moved]
            rotation = np.stack(slope[:3], axis=-1) / _ROTATION * size.attitude
            shift = np.stack(slope[3:6], axis=-1) / _SHIFT * size.position
            delay = slope[6] / _DELAY
            line, pixel, rise = delay * line_time[:, None], slope[7] / pixel_step[:, None], slope[8] / _RISE
            rows.append(here)
            common.append(np.concatenate([rotation, shift, delay[..., None] * size.time], axis=-1))
            pixels = self.cameras[name].pixels
            scale = size.scale * (pixel_of(reading, raw, pixels) - 0.5 * (pixels - 1))[:, None]
            line_terms.append(np.stack([line * size.interior, pixel * size.interior, pixel * scale], axis=-1))
            image = np.stack([line, pixel], axis=-1)
            noise.append(image @ raw.covariance @ np.swapaxes(image, 1, 2) + _ground_noise(known, raw.point, rise))
            sizes.append(np.sqrt(0.5 * np.sum(line**2 + pixel**2, axis=1)))
        residual = np.concatenate(rows)
        covariance, shared = _covariance(noise, common, line_terms)
        r = residual.ravel()
        factor = cho_factor(covariance, lower=True)
        weighted = cho_solve(factor, r)
        chi_square = float(r @ weighted)
        left = r - shared @ weighted
        logarithm = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
        square = np.sum(residual**2, axis=1)
        rms, rms_pixels = (float(np.sqrt(np.mean(v))) for v in (square, square / np.concatenate(sizes) ** 2))
        cost = chi_square + logarithm
        return Fit(residual, rms, rms_pixels, left.reshape(-1, 2), np.concatenate(noise), chi_square, cost, len(r))

    def _steps(
        self, name: str, reading: PassConventions, raw: ImagePoints, path: TabulatedTrajectory
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Return ground positions for finite differences, the steps of the pixels, and line times.

        The positions are the unchanged ones, and those after a small rotation about and shift along each axis, a delay,
        a step of one pixel, and a step in height.
        """
        n, pixels = len(raw.line), self.cameras[name].pixels
        rotation, shift = np.broadcast_to(np.eye(3), (10, n, 3, 3)).copy(), np.zeros((10, n, 3))
        rotation[1:4] = rotation_matrix(_ROTATION * np.eye(3))[:, None]
        shift[4:7] = _SHIFT * np.eye(3)[:, None]
        delay, step, rise = np.zeros((10, n)), np.zeros((10, n)), np.zeros((10, n))
        direction = np.where(pixel_of(reading, raw, pixels) + 1.0 <= pixels - 0.5, 1.0, -1.0)
        delay[7], step[8], rise[9] = _DELAY, direction, _RISE
        moved = _PerturbedPlatform(path, rotation.reshape(-1, 3, 3), shift.reshape(-1, 3))
        repeated = raw.taken(np.tile(np.arange(n), 10))
        ground, line_time = self._ground(name, reading, repeated, moved, delay.ravel(), step.ravel(), rise.ravel())
        return list(ground.reshape(10, n, 3)), direction, line_time[:n]

    def _ground(
        self,
        name: str,
        reading: PassConventions,
        raw: ImagePoints,
        platform: _PerturbedPlatform,
        delay: np.ndarray | float = 0.0,
        step: np.ndarray | float = 0.0,
        rise: np.ndarray | float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return n image points' ITRS positions at their ground points' heights, (n, 3), in m, and line times, in s."""
        clock = self.readings.lines[name]
        number = line_of(reading, raw, clock)
        for worst in number[~in_span(number, clock.line[0] - 1.0, clock.line[-1] + 1.0)][:1]:
            span = f"{clock.line[0]:.10g} to {clock.line[-1]:.10g}"
            raise ImpossibleError(f"line {worst:.10g} of {name} is not in the table of times, which covers {span}")
        times, line_time = line_times(clock, reading, self.epoch, number)
        path, camera = platform.path, self.cameras[name]
        pixel = pixel_of(reading, raw, camera.pixels) + step
        for worst in pixel[~in_span(pixel, -0.5, camera.pixels - 0.5)][:1]:
            raise ImpossibleError(f"pixel {worst:.6g} of {name} does not exist; the line has {camera.pixels} pixels")
        first, last = path.first, path.last
        if not np.all(in_span(times, first, last)):
            raise ImpossibleError(f"{name} was exposed outside of orbit and attitude")
        height = Earth().geodetic(self.readings.ground.points.itrs[raw.point])[2] + rise
        tick = (last - first) / _TICKS
        try:
            sensor = Sensor(camera, platform, Earth(), tick, first + 0.5 * tick, _TICKS, self.effects)
            line = np.clip((times + delay - first) / tick - 0.5, -0.5, _TICKS - 0.5)
            ground = sensor.ground(line, pixel, height)
        except ValueError as error:
            raise ImpossibleError(str(error)) from None
        if not np.all(np.isfinite(ground)):
            raise ImpossibleError(f"looks of {name} miss the Earth")
        return ground, line_time


def line_times(
    clock: LineClock, reading: PassConventions, epoch: str, line: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of each line's exposure and the time to the next line, in seconds, (n,) each for n lines.

    Parameters
    ----------
    clock : LineClock
        Clock readings at numbered lines.
    reading : PassConventions
        Interpretation of the files.
    epoch : str
        Instant from which times count, UTC.
    line : (n,) ndarray
        Line numbers, counted as in the table of times.

    Raises
    ------
    ImpossibleError
        The clock cannot have shown its readings in this time scale.
    """
    try:
        seconds = clock.clock.instants(reading.line_scale).since(epoch) + reading.line_offset
    except Problem as problem:
        raise ImpossibleError(problem.problem) from None
    table = LineTimes.of(clock.line, seconds)
    each = np.interp(line, clock.line, np.gradient(seconds, clock.line))
    half = {"start": 0.5, "middle": 0.0, "end": -0.5}[reading.moment]
    return table.at(line) + half * each, each


def spread(count: int, most: int) -> np.ndarray:
    """Return at most `most` evenly spread indices of a sequence of `count` items."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def line_of(reading: PassConventions, raw: ImagePoints, clock: LineClock) -> np.ndarray:
    """Return the lines of n image points, (n,), in the numbering of the table of times."""
    number = raw.line - reading.line_origin
    return clock.line[0] + clock.line[-1] - number if reading.backward else number


def pixel_of(reading: PassConventions, raw: ImagePoints, pixels: int) -> np.ndarray:
    """Return the pixels of n image points, (n,), counted from the pixel that looks farthest right of the track."""
    number = raw.pixel - reading.pixel_origin
    return number if reading.first_pixel_sees == "right" else pixels - 1.0 - number


def _plan(known: np.ndarray, computed: np.ndarray) -> np.ndarray:
    """Return the distances east and north from n known points to the computed ones, (n, 2), in metres."""
    lon, lat, _ = Earth().geodetic(known)
    axes = east_north_up(lon, lat)[:, :2]
    return np.asarray(np.einsum("nij,nj->ni", axes, computed - known))


def _ground_noise(known: Any, point: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return the covariances of n residuals due to errors of the ground points, (n, 2, 2), in m^2.

    `rise` (n, 2) is the displacement of the imaged position east and north per metre of height.
    """
    lon, lat, _ = Earth().geodetic(known.itrs[point])
    axes = east_north_up(lon, lat)
    level = axes @ known.covariance[point] @ np.swapaxes(axes, 1, 2)
    jacobian = np.concatenate([np.broadcast_to(-np.eye(2), (len(point), 2, 2)), rise[:, :, None]], axis=-1)
    return np.asarray(jacobian @ level @ np.swapaxes(jacobian, 1, 2))


def _covariance(
    noise: list[np.ndarray], common: list[np.ndarray], line_terms: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of all residuals of n points, and its part due to shared errors, (2n, 2n), in m^2."""
    common_terms = np.concatenate(common).reshape(-1, common[0].shape[-1])
    by_line = [terms.reshape(-1, terms.shape[-1]) for terms in line_terms]
    shared = common_terms @ common_terms.T + block_diag(*(terms @ terms.T for terms in by_line))
    return shared + block_diag(*np.concatenate(noise)), shared
