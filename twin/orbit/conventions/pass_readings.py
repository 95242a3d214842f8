"""A pass in files before anything is read into its numbers, and every reading of it in other conventions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import names_text, nearest, shown
from scenes.yaml.units import TIME
from twin.orbit.measured.clock import Readings
from twin.orbit.measured.dimap_file import is_dimap, read_dimap
from twin.orbit.measured.ground_files import GroundFile, read_ground_points
from twin.orbit.measured.measurement_tables import COLUMNS, image_covariance, require_known
from twin.orbit.measured.pass_measurements import ImagePoints
from twin.orbit.measured.platform_files import Conventions, PlatformReadings, clock_of, read_platform
from twin.orbit.measured.platform_readings import AttitudeReadings, OrbitReadings
from twin.orbit.measured.xml_file import first_lines

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data import ImagePointsFileSpec, LineTimesFileSpec, OrbitCheckSpec
    from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec


_LINES = (
    Column("camera", text=True),
    Column("line"),
    Column("time", TIME, needed=False),
    Column("date_time", text=True, needed=False),
)
_AROUND = 120.0
"""Seconds of orbit and attitude before and after the lines that are kept: time scales differ by 70 s."""
_LEAST_AROUND = 12
"""Readings that are kept there at least."""


@dataclass(frozen=True, eq=False)
class LineClock:
    """When lines were exposed, as a clock showed it.

    Attributes:
        line: (K,) numbers of lines, rising.
        clock: K readings.
    """

    line: np.ndarray
    clock: Readings


@dataclass(frozen=True)
class PassConventions:
    """What the numbers of a pass mean.

    Attributes:
        platform: orbit and attitude.
        line_scale: time scale of the lines.
        line_offset: seconds to be added to their times.
        moment: which moment of its exposure a line's time is: start, middle or end.
        line_origin: image coordinate of the middle of the line that the table of times calls 0.
        pixel_origin: image coordinate of the middle of the first pixel.
        sees: to which side of the track the first pixel looks.
        backward: whether lines are counted from the last.
    """

    platform: Conventions
    line_scale: str
    line_offset: float
    moment: str
    line_origin: float
    pixel_origin: float
    sees: str
    backward: bool = False


@dataclass(frozen=True, eq=False)
class PassReadings:
    """What the files of a pass hold.

    Attributes:
        platform: orbit and attitude about the lines' times.
        lines: camera -> line times.
        ground: points on the ground.
        images: camera -> image points, line and pixel as they are written.
    """

    platform: PlatformReadings
    lines: Mapping[str, LineClock]
    ground: GroundFile
    images: Mapping[str, ImagePoints]


def read_pass(spec: OrbitCheckSpec, camera: ThreeLineCameraSpec, folder: Path) -> tuple[PassReadings, PassConventions]:
    """What the files of a pass hold, and what is stated of it.

    Args:
        spec: the files.
        camera: its lines.
        folder: that relative paths start from.

    Raises:
        InputError: a file that cannot be read, or names in one that another does not have.
    """
    platform, meant = read_platform(spec.platform, folder)
    lines = read_line_clocks(spec.lines, tuple(camera.lines), folder)
    ground = read_ground_points(spec.ground, folder)
    if Path(spec.image_points.file).suffix.lower() == ".gcp":
        images = _gcp_points(spec, ground, lines, folder)
    else:
        images = _image_points(spec.image_points, ground, lines, folder)
    half = 0.5 if spec.image_points.centre == "half" else 0.0
    stated = PassConventions(
        meant,
        spec.lines.time_scale,
        0.0,
        spec.lines.moment,
        half,
        half + spec.image_points.first_pixel,
        spec.image_points.first_pixel_sees,
    )
    return PassReadings(_around(platform, lines), lines, ground, images), stated


def read_line_clocks(spec: LineTimesFileSpec, cameras: tuple[str, ...], folder: Path) -> dict[str, LineClock]:
    """Line times of every camera that the table has.

    Args:
        spec: the table, and what it does not say itself.
        cameras: names that may stand in it.
        folder: that relative paths start from.

    Raises:
        InputError: the table cannot be read, a camera that is none, fewer than two lines of one, lines or times that do
            not rise.
    """
    if is_dimap(list(first_lines(folder / spec.file, "line times: CSV, or DIMAP"))):
        return _scene_lines(spec, cameras, folder)
    table = read_table(folder / spec.file, _LINES, 2)
    clock = clock_of(table, spec)
    names = table["camera"].astype(str)
    require_known(table, "camera", cameras)
    found = {}
    for name in dict.fromkeys(names.tolist()):
        rows = np.flatnonzero(names == name)
        if len(rows) < 2:
            raise table.error(int(rows[0]), "line", f"one line of {name} tells no line time", None, "two or more")
        line, taken = table["line"][rows], clock.taken(rows)
        step = np.diff(taken.day) * 86400.0 + np.diff(taken.second)
        for what, rise in (("line", np.diff(line)), ("time", step)):
            if np.any(rise <= 0.0):
                row, head = int(rows[int(np.argmax(rise <= 0.0)) + 1]), what if what in table else "date_time"
                raise table.error(row, head, f"{what}s of {name} do not rise", None, "rows in order, each line once")
        found[name] = LineClock(line, taken)
    return found


def _scene_lines(spec: LineTimesFileSpec, cameras: tuple[str, ...], folder: Path) -> dict[str, LineClock]:
    """Line times of a DIMAP file, which has one line; its lines count from 0."""
    if len(cameras) != 1:
        allowed = "a camera of one line, or a table"
        raise spec.error("a scene has the times of one line", ("file",), found=names_text(cameras), allowed=allowed)
    if spec.time_scale != "UTC":
        raise spec.error("a scene's times are in UTC", ("time_scale",), found=spec.time_scale, allowed="UTC")
    read = read_dimap(folder / spec.file)
    last = max(read.lines - 1, 1)
    second = read.first_line.second[0] + np.array([0.0, last * read.line_time])
    over = np.floor(second / 86400.0)
    clock = Readings(read.first_line.day[0] + over.astype(np.int64), second - 86400.0 * over)
    return {cameras[0]: LineClock(np.array([0.0, float(last)]), clock)}


def _image_points(
    spec: ImagePointsFileSpec, ground: GroundFile, lines: Mapping[str, LineClock], folder: Path
) -> Mapping[str, ImagePoints]:
    table = read_table(folder / spec.file, COLUMNS["image_points"])
    known = {str(name): k for k, name in enumerate(ground.points.ids)}
    names, cameras = table["point"].astype(str), table["camera"].astype(str)
    require_known(table, "camera", tuple(lines))
    number = np.array([known.get(name, -1) for name in names.tolist()])
    if np.any(number < 0):
        row = int(np.argmax(number < 0))
        name = str(names[row])
        raise table.error(row, "point", "no such ground point", shown(name), None, nearest(name, known))
    found = {}
    for camera in dict.fromkeys(cameras.tolist()):
        rows = np.flatnonzero(cameras == camera)
        _, first = np.unique(number[rows], return_index=True)
        if len(first) != len(rows):
            row = int(rows[np.setdiff1d(np.arange(len(rows)), first)[0]])
            raise table.error(row, "point", f"twice in {camera}", shown(str(names[row])), "each point once")
        spread = image_covariance(table, rows)
        found[camera] = ImagePoints(number[rows], table["line"][rows], table["pixel"][rows], spread)
    return FrozenMap(found)


def _gcp_points(
    spec: OrbitCheckSpec, ground: GroundFile, lines: Mapping[str, LineClock], folder: Path
) -> Mapping[str, ImagePoints]:
    """Image points of the .gcp file that holds the ground points; an image is that of the line of its name."""
    file = spec.image_points.file
    if (folder / file) != (folder / spec.ground.file):
        allowed = "the file of `ground`, or a table"
        raise spec.image_points.error("image points of another .gcp file", ("file",), found=file, allowed=allowed)
    found = {}
    for image, rows in ground.images.items():
        camera = Path(image).stem
        if camera not in lines:
            problem, allowed = (
                "an image that is none of the camera's lines",
                names_text(f"{name}.tif" for name in lines),
            )
            raise spec.image_points.error(problem, ("file",), found=shown(image), allowed=allowed)
        number = rows[:, 0].astype(np.intp)
        covariance = rows[:, 3:, None] ** 2 * np.eye(2)
        found[camera] = ImagePoints.of(number, rows[:, 1], rows[:, 2], covariance)
    if not found:
        raise spec.image_points.error("a .gcp file without images", ("file",), allowed="image, column, row, two sigmas")
    return FrozenMap(found)


def _around(platform: PlatformReadings, lines: Mapping[str, LineClock]) -> PlatformReadings:
    """The part of orbit and attitude that any reading of the line times can need."""
    ends = [(c.clock.day[k], c.clock.second[k]) for c in lines.values() for k in (0, -1)]
    day, second = min(ends)
    last = max((d - day) * 86400.0 + s - second for d, s in ends)

    def cut(clock: Readings) -> slice:
        since = (clock.day - day) * 86400.0 + clock.second - second
        begin, end = (int(np.searchsorted(since, t)) for t in (-_AROUND, last + _AROUND))
        return slice(max(begin - _LEAST_AROUND, 0), end + _LEAST_AROUND)

    orbit, attitude = platform.orbit, platform.attitude
    a, b = cut(orbit.clock), cut(attitude.clock)
    if len(orbit.clock.taken(a)) < 2 or len(attitude.clock.taken(b)) < 2:
        return platform  # told by what needs it
    return replace(platform, orbit=_orbit_part(orbit, a), attitude=_attitude_part(attitude, b))


def _orbit_part(orbit: OrbitReadings, part: slice) -> OrbitReadings:
    speed = None if orbit.velocity is None else orbit.velocity[part]
    return replace(orbit, clock=orbit.clock.taken(part), position=orbit.position[part], velocity=speed)


def _attitude_part(attitude: AttitudeReadings, part: slice) -> AttitudeReadings:
    q = None if attitude.quaternion is None else attitude.quaternion[part]
    angles = None if attitude.angles is None else attitude.angles[part]
    return replace(attitude, clock=attitude.clock.taken(part), quaternion=q, angles=angles)


_SCALES = ("UTC", "GPS", "TAI", "TT")
_FRAMES = ("ITRS", "GCRS", "EME2000", "TEME")
_TURNED = {"forward": "back", "back": "forward", "right": "left", "left": "right", "down": "up", "up": "down"}


@dataclass(frozen=True)
class Question:
    """A convention and what it may be.

    Attributes:
        title: for readers.
        get: of a reading.
        put: a reading with another value of it.
        values: that it may have, for a stated reading.
        text: of a value, for readers.
    """

    title: str
    get: Callable[[PassConventions], Any]
    put: Callable[[PassConventions, Any], PassConventions]
    values: Callable[[PassConventions], tuple[Any, ...]]
    text: Callable[[Any], str] = str


def _of_platform(title: str, key: str, values: tuple[Any, ...], text: Callable[[Any], str] = str) -> Question:
    return Question(
        title,
        lambda c: getattr(c.platform, key),
        lambda c, v: replace(c, platform=replace(c.platform, **{key: v})),
        lambda c: values,
        text,
    )


def _of_pass(title: str, key: str, values: tuple[Any, ...], text: Callable[[Any], str] = str) -> Question:
    return Question(title, lambda c: getattr(c, key), lambda c, v: replace(c, **{key: v}), lambda c: values, text)


def _turned(c: PassConventions) -> tuple[tuple[str, str, str], ...]:
    """The body's axes as stated, and turned by half a turn about each of them."""
    a = c.platform.body_axes
    x, y, z = (_TURNED[v] for v in a)
    return a, (a[0], y, z), (x, a[1], z), (x, y, a[2])


def _seconds(value: float) -> str:
    return f"{value:+g} s" if value else "none"


QUESTIONS: Mapping[str, Question] = FrozenMap(
    {
        "quaternion_scalar": _of_platform("scalar of the quaternion", "scalar", ("last", "first")),
        "quaternion_turns": _of_platform("quaternion turns", "turns", ("body_to_frame", "frame_to_body")),
        "body_axes": Question(
            "body x, y, z point",
            lambda c: c.platform.body_axes,
            lambda c, v: replace(c, platform=replace(c.platform, body_axes=v)),
            _turned,
            ", ".join,
        ),
        "angle_sequence": _of_platform(
            "sequence of the angles", "sequence", ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
        ),
        "attitude_frame": _of_platform("frame of the attitude", "attitude_frame", _FRAMES),
        "orbit_frame": _of_platform("frame of the orbit", "orbit_frame", _FRAMES),
        "orbit_time_scale": _of_platform("time scale of the orbit", "orbit_scale", _SCALES),
        "attitude_time_scale": _of_platform("time scale of the attitude", "attitude_scale", _SCALES),
        "line_time_scale": _of_pass("time scale of the lines", "line_scale", _SCALES),
        "line_time_offset": _of_pass("offset of the line times", "line_offset", (0.0, -1.0, 1.0), _seconds),
        "line_moment": _of_pass("moment of a line's time", "moment", ("start", "middle", "end")),
        "line_origin": _of_pass(
            "coordinate of the middle of line 0", "line_origin", (0.0, 0.5, 1.0), lambda v: f"{v:g}"
        ),
        "pixel_origin": _of_pass(
            "coordinate of the middle of the first pixel", "pixel_origin", (0.0, 0.5, 1.0, 1.5), lambda v: f"{v:g}"
        ),
        "first_pixel_sees": _of_pass("first pixel sees", "sees", ("right", "left")),
        "line_axis": _of_pass(
            "lines are counted", "backward", (False, True), lambda v: "from the last" if v else "from the first"
        ),
    }
)
"""Name -> what is asked of a reading."""


def asked(stated: PassConventions, quaternions: bool) -> dict[str, tuple[Any, ...]]:
    """Question -> values that it may have beside the stated one; those that do not arise are left out.

    Args:
        stated: the reading that the file states.
        quaternions: whether the attitude is one of quaternions, and not of angles.
    """
    without = {"angle_sequence"} if quaternions else {"quaternion_scalar", "quaternion_turns"}
    found = {}
    for name, question in QUESTIONS.items():
        here = question.get(stated)
        if name in without or (name == "attitude_frame" and here == "orbital"):
            continue
        found[name] = tuple(v for v in question.values(stated) if v != here)
    return found


Changes = tuple[tuple[str, Any], ...]
"""Questions with another value than the stated one."""


def singles_and_pairs(others: Mapping[str, tuple[Any, ...]], start: Changes = ()) -> Iterator[Changes]:
    """Changes of one or two questions, beside those of `start`, which comes first.

    Args:
        others: question -> values beside the stated one.
        start: changes that all of them have.
    """
    yield start
    taken = {name for name, _ in start}
    one = [(name, value) for name, values in others.items() if name not in taken for value in values]
    for change in one:
        yield (*start, change)
    for k, first in enumerate(one):
        for second in one[k + 1 :]:
            if first[0] != second[0]:
                yield (*start, first, second)


def changed(stated: PassConventions, changes: Changes) -> PassConventions:
    """The reading with these changes."""
    for name, value in changes:
        stated = QUESTIONS[name].put(stated, value)
    return stated
