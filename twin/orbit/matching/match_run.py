"""Measurement of control, check and tie points in a user's line images: ``python -m twin.orbit match``.

Images and maps are related by the known geometry: the laboratory's camera, orbit and attitude, line times. The method
is the one for simulated patches (`twin.orbit.images.image_points`). The quantities at the end of the module are those
of match.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.orbit.calibration_parameters import level_covariance
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.setup import RationalMatchSetup
from scenes.yaml.errors import names_text, nearest
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.record import Quantity, Record
from twin.orbit.conventions.pass_readings import (
    ImpossibleError,
    LineClock,
    PassConventions,
    line_times,
    read_line_clocks,
)
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineCamera, LineTimes, line_cameras
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import LightEffects, Sensor
from twin.orbit.ground.grid import GroundFrame
from twin.orbit.ground.orthophoto import Maps
from twin.orbit.images.image_points import (
    POINTS_REMEDY,
    ImagedGround,
    LineFrame,
    MatchedPoints,
    PatchPoints,
    PointsError,
    measure_points,
)
from twin.orbit.images.pushbroom import Window
from twin.orbit.images.simulate_run import POINTS
from twin.orbit.matching.pixels import read_pixels
from twin.orbit.matching.rational_match import RATIONAL, RationalMatch, rational_files, run_rational_match
from twin.orbit.measured.maps import MapPart, UserMap
from twin.orbit.measured.measurement_tables import campaign_files
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements
from twin.orbit.measured.platform_files import platform_table, read_platform

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.measurements import LineImageFileSpec, OrbitMatchSpec
    from scenes.specs.orbit.setup import MatchSetup

_BORDER = 5
"""Number of positions along each side of an image that are projected to the ground to find its extent."""
_SPARE = 300.0
"""Margin of the map about the images' ground, in metres, in addition to the search range, for errors of camera and
platform.
"""


@dataclass(frozen=True, eq=False)
class UserGround(ImagedGround):
    """Patch of ground with a user's images of it, orthophoto and elevation model."""

    control: Maps[MapPart]


@dataclass(frozen=True, eq=False)
class Match:
    """Points measured in a user's images.

    Attributes
    ----------
    setup : MatchSetup
        Test file with the camera.
    ground : UserGround
        Images and maps.
    points : PatchPoints
        Measured points.
    measurements : PassMeasurements
        Points with orbit, attitude and line times, in the form that a calibration uses as input.
    accuracy : float or None
        Accuracy of the maps' transformation to WGS 84 according to its authority (such as EPSG), metres; None where
        none is given.
    """

    setup: MatchSetup
    ground: UserGround
    points: PatchPoints
    measurements: PassMeasurements
    accuracy: float | None


def run_match(
    setup: MatchSetup | RationalMatchSetup, backend: Backend | None, seed: int, advance: Advance = silent
) -> Match | RationalMatch:
    """Measure control, check and tie points in a user's images; nothing is traced or drawn at random.

    Images with rational polynomials have tie points only.

    Raises
    ------
    InputError
        Files cannot be read, or do not fit together.
    BenchError
        Points cannot be measured.
    """
    if isinstance(setup, RationalMatchSetup):
        return run_rational_match(setup, advance)
    advance("points", 0, 3)
    spec, folder = setup.test, Path()
    readings, conventions = read_platform(spec.platform, folder)
    table = platform_table(readings, conventions)
    path = TabulatedTrajectory(table)
    clocks = read_line_clocks(spec.lines, tuple(setup.camera.lines), folder)
    cameras = line_cameras(setup.camera)
    light = LightEffects.of(spec.effects)
    times = {}
    for name in spec.images:
        if name not in clocks:
            suggestion, known = nearest(name, clocks), f"{names_text(clocks)}, of which the table has times"
            raise spec.error("no such line", ("images", name), allowed=known, suggestion=suggestion)
        times[name] = _times(spec, clocks[name], table.epoch)
    photo = UserMap.open(spec.orthophoto, folder)
    dem = UserMap.open(spec.dem, folder, heights=True)
    sensors = {name: _sensor(spec, name, cameras[name], path, times[name], light) for name in spec.images}
    images = {name: _image(file, name, sensors[name], folder, len(sensors)) for name, file in spec.images.items()}
    limits = dem.limits()
    frame, ends = _extent(spec, images, limits)
    maps = Maps(photo.part(frame, ends), dem.part(frame, ends, heights=True))
    height = float(np.median(maps.dem.values if maps.dem.valid is None else maps.dem.values[maps.dem.valid]))
    images = {
        name: replace(image, sample=image.window.sample(image.measured, height)) for name, image in images.items()
    }
    ground = UserGround(frame, FrozenMap(images), maps)
    advance("points", 1, 3)
    try:
        points = measure_points(ground, spec.points)
    except PointsError as error:
        raise BenchError(str(error), ("points",), POINTS_REMEDY) from error
    except ValueError as error:
        raise BenchError(f"the images cannot be matched: {error}", ("images",), "images of the map's ground") from error
    advance("points", 3, 3)
    measured = PassMeasurements(spec.name, table, FrozenMap(times), *_measured(points, spec))
    accuracies = photo.to_geographic.accuracy, dem.to_geographic.accuracy
    # a negative accuracy is an unknown one: the known accuracy of the other map does not replace it
    return Match(setup, ground, points, measured, max(accuracies) if min(accuracies) >= 0.0 else None)


def _times(spec: OrbitMatchSpec, clock: LineClock, epoch: str) -> LineTimes:
    """Return the exposure times of a line camera's image lines, counted from the first in the table, which is 0."""
    reading = PassConventions(None, spec.lines.time_scale, 0.0, spec.lines.moment, 0.0, 0.0, "right")  # type: ignore[arg-type]
    try:
        middle, _ = line_times(clock, reading, epoch, clock.line)
        return LineTimes.of(clock.line - clock.line[0], middle)
    except (ImpossibleError, ValueError) as error:
        raise spec.lines.error(str(error), ("file",)) from None


def _sensor(
    spec: OrbitMatchSpec,
    name: str,
    camera: LineCamera,
    path: TabulatedTrajectory,
    times: LineTimes,
    light: LightEffects,
) -> Sensor:
    """Return the sensor of a line, or raise InputError if its lines lie outside orbit and attitude."""
    try:
        return Sensor.of_lines(camera, path, Earth(), times, light)
    except ValueError as error:
        problem = f"{name}: lines outside of orbit and attitude: {error}"
        raise spec.lines.error(problem, ("file",), allowed="times within those of orbit and attitude") from None


def _image(spec: LineImageFileSpec, name: str, sensor: Sensor, folder: Path, count: int) -> LineFrame:
    """Return the image of a line, one of `count`, with columns along the line's pixels."""
    path = folder / spec.file
    part = spec.window
    frame = read_pixels(spec.model_copy(update={"file": str(path)}), part, count)
    row, column = (0, 0) if part is None else (part.row, part.column)
    rows, columns = frame.shape
    first_line = spec.first_line + row
    if spec.first_pixel_sees == "right":
        first_pixel = spec.first_pixel + column
    else:
        frame = np.ascontiguousarray(frame[:, ::-1])
        first_pixel = sensor.camera.pixels - spec.first_pixel - column - columns
    if first_pixel < 0 or first_pixel + columns > sensor.camera.pixels:
        value = f"columns {column} to {column + columns - 1} from pixel {spec.first_pixel}"
        allowed = (
            f"{sensor.camera.pixels} pixels of {name}; `first_pixel` of the image's first column, and its `window`"
        )
        raise spec.error("an image wider than its line", ("first_pixel",), value=value, allowed=allowed)
    if first_line + rows > sensor.lines + 1:
        value = f"lines to {first_line + rows - 1}"
        allowed = f"lines to {sensor.lines - 1}, of which the table has times; or a `window`"
        raise spec.error("an image longer than its line times", ("first_line",), value=value, allowed=allowed)
    return LineFrame(frame, Window(first_line, first_pixel, rows, columns), sensor, (1.0, 1.0))


def _extent(
    spec: OrbitMatchSpec, images: Mapping[str, LineFrame], heights: tuple[float, float]
) -> tuple[GroundFrame, tuple[float, float, float, float]]:
    """Return plane coordinates of the ground, and the images' bounds west, east, south and north, in metres."""
    seen, margin = [], spec.points.search_radius + spec.points.template
    for name, image in images.items():
        window = image.window
        side = [np.linspace(-margin, n - 1.0 + margin, _BORDER) for n in (window.lines, window.pixels)]
        row, column = (v.ravel() for v in np.meshgrid(*side, indexing="ij"))
        line, pixel = image.image_point(row, column)
        sensor = image.measured
        line, pixel = np.clip(line, -0.5, sensor.lines - 0.5), np.clip(pixel, -0.5, sensor.camera.pixels - 0.5)
        for height in heights:
            points = sensor.ground(line, pixel, height)
            if not np.all(np.isfinite(points)):
                remedy = "conventions under which the lines look at the Earth; find them with `twin.orbit check`"
                raise spec.error(f"the image of {name} looks past the Earth", ("images", name), allowed=remedy)
            seen.append(points)
    corners = np.concatenate(seen)
    longitude, latitude, _ = Earth().geodetic(np.mean(corners, axis=0))
    frame = GroundFrame(float(longitude), float(latitude))
    east, north, _ = frame.local(corners)
    ends = (east.min() - _SPARE, east.max() + _SPARE, north.min() - _SPARE, north.max() + _SPARE)
    return frame, (float(ends[0]), float(ends[1]), float(ends[2]), float(ends[3]))


def _measured(points: PatchPoints, spec: OrbitMatchSpec) -> tuple[GroundPoints, Mapping[str, ImagePoints]]:
    """Return the accepted points: control and check points, then tie points."""
    ids: list[str] = []
    places, roles = [], []
    rows: dict[str, list[ImagePoints]] = {name: [] for name in spec.images}
    for sort, group in points.sorts.items():
        keep = _used(group)
        start = len(ids)
        number = {int(k): start + n for n, k in enumerate(np.flatnonzero(keep))}
        ids += [f"{sort[0]}{k}" for k in number]
        places.append(np.where(sort == "tie", np.nan, group.ground[keep]))
        roles += ["tie" if sort == "tie" else "check" if group.check[k] else "control" for k in number]
        for name, line in group.lines.items():
            good = np.flatnonzero(line.accepted & keep)
            rows[name].append(line.measured(good, np.array([number[int(k)] for k in good], np.intp)))
    itrs, role = np.concatenate(places), np.array(roles, object)
    covariance = np.zeros((len(ids), 3, 3))
    known = role != "tie"
    plan, height = spec.control_sigma
    each = np.ones(int(known.sum()))
    covariance[known] = level_covariance(itrs[known], plan * each, height * each)
    return GroundPoints.of(np.array(ids, object), itrs, covariance, role), FrozenMap(
        {name: ImagePoints.joined(parts) for name, parts in rows.items()}
    )


def _used(points: MatchedPoints) -> np.ndarray:
    """Return the mask (n,) of those of n points that are accepted in enough lines: one, or two for tie points."""
    seen = np.sum([line.accepted for line in points.lines.values()], axis=0)
    return np.asarray(seen >= (2 if points.kind == "tie" else 1))


IMAGE: Record[LineFrame] = Record(
    "A line's image: the part that was matched, and its sample distances on the ground.",
    Quantity("first_line", lambda image: image.window.first_line, "first line, from the first in the table of times"),
    Quantity("first_pixel", lambda image: image.window.first_pixel, "first pixel, counted from the right"),
    Quantity("lines", lambda image: image.window.lines, "number of lines"),
    Quantity("pixels", lambda image: image.window.pixels, "number of pixels"),
    Quantity("sample_along_line_m", lambda image: image.sample[0], "distance of neighbouring pixels on the ground"),
    Quantity("sample_along_track_m", lambda image: image.sample[1], "distance of neighbouring lines on the ground"),
)
MAP: Record[MapPart] = Record(
    "Part of a map that was used.",
    Quantity("system", lambda part: part.raster.crs.name, "coordinate reference system"),
    Quantity("first_row", lambda part: part.first[0], "first row of the part in the map"),
    Quantity("first_column", lambda part: part.first[1], "first column of the part in the map"),
    Quantity("rows", lambda part: part.values.shape[0], "number of rows"),
    Quantity("columns", lambda part: part.values.shape[1], "number of columns"),
    Quantity("spacing_m", lambda part: part.spacing, "spacing of rows and columns on the ground, geometric mean"),
    Quantity(
        "share_without_values",
        lambda part: 0.0 if part.valid is None else 1.0 - float(np.mean(part.valid)),
        "share of the pixels without values",
    ),
)
MATCH: Record[Match] = Record(
    "match.json. Points measured in a user's images.",
    Quantity("epoch_utc", lambda run: run.measurements.platform.epoch, "zero of the times"),
    Quantity("images", lambda run: run.ground.images, "image of each line", record=IMAGE),
    Quantity("orthophoto", lambda run: run.ground.control.orthophoto, "part of the orthophoto", record=MAP),
    Quantity("dem", lambda run: run.ground.control.dem, "part of the elevation model", record=MAP),
    Quantity("map_accuracy_m", lambda run: run.accuracy, "accuracy of the maps' transformation to WGS 84"),
    Quantity(
        "control_points",
        lambda run: np.sum(run.measurements.ground.role == "control"),
        "points whose coordinates are used",
    ),
    Quantity(
        "check_points", lambda run: np.sum(run.measurements.ground.role == "check"), "points that only test the result"
    ),
    Quantity("tie_points", lambda run: np.sum(run.measurements.ground.role == "tie"), "points without coordinates"),
    Quantity("points", lambda run: run.points.sorts, "points measured in the images, by kind", record=POINTS),
)


def match_numbers(run: Match | RationalMatch) -> dict[str, Any]:
    """Return the content of match.json."""
    return RATIONAL(run) if isinstance(run, RationalMatch) else MATCH(run)


def exported(run: Match | RationalMatch) -> Mapping[str, str | bytes]:
    """Return the files of a folder with the measurements of the pass, or of the tie points, path -> content."""
    if isinstance(run, RationalMatch):
        return rational_files(run)
    return campaign_files([run.measurements], run.setup.camera.plain())
