"""Images of one patch of ground by the lines of a camera, with control data, and comparison with the truth.

    lines = imaged_lines(sensors, measured, optics, seed)
    patch = fly_patch(lines, place, (600, 600), ground, control, seed)
    patch.images["nadir"].frame                         # uint16, grey values of the detector
    patch.images["nadir"].image_point(row, column)      # line and pixel of the whole image
    patch.images["nadir"].measured                      # Sensor: the laboratory's camera on the measured trajectory
    patch.control.orthophoto, patch.control.dem

An analysis may use `frame`, `window`, `measured` and the control's rasters. `sensor`, `terrain`, the control's errors
and the comparison of points with the truth must not enter an analysis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis import statistics
from optics.numerics.array_math import PhysicalError
from optics.numerics.number_tree import FrozenMap
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import stream
from twin.orbit.flight.sensor import Sensor
from twin.orbit.ground.grid import GroundFrame, Terrain
from twin.orbit.ground.orthophoto import Control, Extent, apparent, around, make_control, reflectance
from twin.orbit.images import pushbroom
from twin.orbit.images.image_points import ImagedGround, LineFrame, MatchedPoints
from twin.orbit.images.line_optics import ImageMotion, LineOptics, with_mean_jitter
from twin.orbit.images.pushbroom import BORDER, LookMap, PushbroomScene, Window
from twin.sensors.area_detector import FixedPattern

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import ControlSpec, GroundSpec
    from scenes.yaml.errors import KeyPath

LARGEST_GROUND = 40_000.0
"""Largest accepted side of the ground of one patch, in metres, so that no input exceeds the memory."""
_PIXEL, _SAMPLE = 150.0, 47.0
"""Memory per pixel of a line's image, and per sample of the ground's texture, in bytes."""


class PatchError(PhysicalError, ValueError):
    """Error of a patch that cannot be imaged.

    Attributes
    ----------
    part
        Part of the input that must change: ``span`` of the pass, ``place``, ``size`` or ``terrain``.
    line
        Name of the line that cannot image the patch; empty where the cause is not a single line.
    """

    def __init__(self, problem: str, part: str, line: str = "") -> None:
        super().__init__(problem)
        self.part, self.line = part, line


@dataclass(frozen=True, eq=False)
class ImagedLine:
    """Line camera that records images, with its true and its known geometry.

    Attributes
    ----------
    sensor : Sensor
        True sensor.
    measured : Sensor
        Sensor as the user knows it: the laboratory's camera on the measured trajectory.
    optics : LineOptics
        Lens and CCD.
    pattern : FixedPattern
        Fixed-pattern noise of its pixels.
    """

    sensor: Sensor
    measured: Sensor
    optics: LineOptics
    pattern: FixedPattern


@dataclass(frozen=True, eq=False, kw_only=True)
class LineImage(LineFrame):
    """Image of a patch by one line, uint16, with its truth.

    Attributes
    ----------
    sensor : Sensor
        True sensor.
    motion : ImageMotion
        Motion of the image over the line, in the window's middle.
    nyquist : tuple of float
        Modulation transfer at the Nyquist frequencies: half a cycle per pixel along the line, and half a cycle per line
        along the track.
    saturated : int
        Number of saturated pixels.
    error : float
        Largest difference of an interpolated position of the renderer from the rigorous one, pixels.
    """

    sensor: Sensor
    motion: ImageMotion
    nyquist: tuple[float, float]
    saturated: int
    error: float


@dataclass(frozen=True, eq=False)
class Patch(ImagedGround):
    """Patch of simulated ground with its images and its true heights.

    Attributes
    ----------
    terrain : Terrain
        True heights.
    """

    images: Mapping[str, LineImage]
    control: Control
    terrain: Terrain

    def true_point(self, name: str, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the points of the true terrain that positions of a line's frame see, ITRS, in metres, (N, 3).

        It is the exact inverse of `Sensor.image`. The N rows and columns must lie on the frame.
        """
        image = self.images[name]
        line, pixel = (np.ravel(v) for v in image.image_point(row, column))
        height = np.full(line.shape, 0.5 * sum(self.terrain.limits))
        # Each step is smaller by the terrain's slope times the look's.
        for _ in range(60):
            points = image.sensor.ground(line, pixel, height)
            east, north, _ = self.frame.local(points)
            ground_height = self.terrain.height(east, north)
            away, height = np.max(np.abs(ground_height - height)), 0.5 * (ground_height + height)
            if away < 1e-5:
                return points
        raise PatchError("the terrain is as steep as the look", "terrain", name)


def fly_patch(
    lines: Mapping[str, ImagedLine],
    position: tuple[float, float],
    size: tuple[int, int],
    ground: GroundSpec,
    control: ControlSpec,
    seed: np.random.SeedSequence,
    oversampling: int = 3,
    advance: Callable[[int], None] = lambda done: None,
) -> Patch:
    """Image a patch of ground with every line.

    The windows of all lines have the same size and are centred on the patch's middle to half a pixel.

    Parameters
    ----------
    lines : mapping of str to ImagedLine
        Name -> line that records images.
    position : tuple of float
        Longitude and latitude of the patch's middle, radians.
    size : tuple of int
        Lines and pixels of every window.
    ground : GroundSpec
        Terrain, texture and light.
    control : ControlSpec
        Orthophoto and elevation model.
    seed : SeedSequence
        Seed of the ground, of the control's errors and of the frames' noise.
    oversampling : int
        Number of ground samples along each side of a pixel.
    advance : callable
        Callback that receives the number of lines whose images are finished.

    Raises
    ------
    PatchError
        A line does not see the patch within its image, terrain hides a part of itself, or the patch is too large for
        the ground or the memory.
    """
    for_terrain, for_ground, for_control, for_frames = (stream(seed, k) for k in range(4))
    frame = GroundFrame(*position)
    guess = {name: window_of(name, line.sensor, frame, ground.terrain.height, size) for name, line in lines.items()}
    side = max(_side(line.sensor, guess[name], frame, ground.terrain.height) for name, line in lines.items())
    if side > LARGEST_GROUND:
        raise PatchError(f"the patch is {side / 1e3:.0f} km long, more than {LARGEST_GROUND / 1e3:g} km", "size")
    terrain = Terrain.from_spec(ground.terrain, side, for_terrain)
    middle = float(terrain.height(np.zeros(1), np.zeros(1))[0])
    windows = {name: window_of(name, line.sensor, frame, middle, size) for name, line in lines.items()}
    looks, extents = {}, []
    for name, line in lines.items():
        try:
            looks[name] = pushbroom.look_map(line.sensor, frame, terrain, windows[name])
            extents.append(pushbroom.extent_of(looks[name]))
            pushbroom.require_open(looks[name], extents[-1])
        except pushbroom.SteepTerrainError as error:
            raise PatchError(f"{name}: {error}", "terrain", name) from error
    extent = around(extents)
    _require_memory(len(lines), size, extent, ground.texture.spacing)
    seen = apparent(reflectance(extent, ground.texture, for_ground), terrain, ground.light)
    scene = PushbroomScene(frame, terrain, seen)
    images = {}
    for k, (name, line) in enumerate(lines.items()):
        images[name] = _recorded(line, scene, windows[name], looks[name], oversampling, stream(for_frames, k))
        advance(k + 1)
    known = make_control(frame, extent, terrain, ground.texture, control, for_ground, for_control)
    return Patch(frame, FrozenMap(images), known, terrain)


class _Size:
    """Source of error messages about the size of a patch, for callers that know no input file."""

    def error(self, problem: str, key: KeyPath, *, value: object, allowed: str) -> PatchError:
        return PatchError(f"{problem}; {value} lines or pixels, allowed: {allowed}", "size")


def _require_memory(count: int, size: tuple[int, int], extent: Extent, spacing: float) -> None:
    """Raise an error if the images of `count` lines, and the texture of their ground, do not fit into the memory."""
    lines, pixels = size
    texture = math.prod(len(axis) for axis in extent.axes(spacing))
    each = count * _PIXEL + texture / (lines * pixels) * _SAMPLE

    def needed(most: int) -> float:
        return min(lines, most) * min(pixels, most) * each

    require_memory(Lowered(_Size(), (), max(size), "lines and pixels", needed, 16))


def imaged_lines(
    sensors: Mapping[str, Sensor],
    measured: Mapping[str, Sensor],
    optics: Mapping[str, LineOptics],
    seed: np.random.SeedSequence,
) -> dict[str, ImagedLine]:
    """Combine sensors and optics to line cameras that record images, by name.

    Parameters
    ----------
    sensors : mapping of str to Sensor
        True sensors, by name.
    measured : mapping of str to Sensor
        Sensors as the user knows them.
    optics : mapping of str to LineOptics
        Lens and CCD.
    seed : SeedSequence
        Seed of the fixed-pattern noise, which is the same in all images of a line.
    """
    lines = {}
    for k, (name, sensor) in enumerate(sensors.items()):
        of, pattern = optics[name], optics[name].ccd.pattern(stream(seed, k))
        lines[name] = ImagedLine(with_mean_jitter(sensor, of), measured[name], of, pattern)
    return lines


def window_of(name: str, sensor: Sensor, frame: GroundFrame, height: float, size: tuple[int, int]) -> Window:
    """Return the window of an image with the frame's origin, at a height in metres, in its middle.

    Raises
    ------
    PatchError
        The window does not lie inside the image.
    """
    (line,), (pixel,) = sensor.image(frame.itrs(0.0, 0.0, height))
    if not np.isfinite(line):
        raise _not_seen(name, sensor, frame, height)
    first = [round(float(at) - 0.5 * (count - 1)) for at, count in zip((line, pixel), size, strict=True)]
    window = Window(first[0], first[1], *size)
    if not window.fits(sensor):
        long = window.first_line < BORDER or window.first_line + window.lines + BORDER > sensor.lines
        raise PatchError(
            f"the window of {name}, lines {window.first_line} to {window.first_line + window.lines - 1} and pixels "
            f"{window.first_pixel} to {window.first_pixel + window.pixels - 1}, reaches into the last {BORDER} lines "
            f"or pixels of the image of {sensor.lines} lines and {sensor.camera.pixels} pixels, or beyond",
            "span" if long else "size",
            name,
        )
    return window


def _not_seen(name: str, sensor: Sensor, frame: GroundFrame, height: float) -> PatchError:
    """Return the error of a patch outside an image, which lies before or after the pass or beside the swath."""
    ends, middle = np.array([0.0, sensor.lines - 1.0]), np.array([0.5 * (sensor.camera.pixels - 1)])
    begin, end = np.stack(frame.local(sensor.ground(ends, middle, height))[:2], axis=-1)
    track = end - begin
    share = float(-begin @ track / (track @ track))
    if 0.0 <= share <= 1.0:
        beside = float(np.linalg.norm(begin + share * track))
        return PatchError(
            f"the patch lies outside the swath of the {name} line, {beside / 1e3:.0f} km beside its middle pixel",
            "place",
            name,
        )
    early = -share if share < 0.0 else share - 1.0
    seconds = early * sensor.lines * sensor.line_time
    when = "before the orbit data begin" if share < 0.0 else "after the orbit data end"
    return PatchError(f"the {name} line sees the patch {seconds:.1f} s {when}", "span", name)


def _side(sensor: Sensor, window: Window, frame: GroundFrame, height: float) -> float:
    """Return the length of the longer side of the ground that a window sees, in metres."""
    lines = window.first_line + np.array([0.0, 0.0, 1.0, 1.0]) * (window.lines - 1)
    pixels = window.first_pixel + np.array([0.0, 1.0, 0.0, 1.0]) * (window.pixels - 1)
    east, north, _ = frame.local(sensor.ground(lines, pixels, height))
    return float(max(np.ptp(east), np.ptp(north)))


def _recorded(
    imaged: ImagedLine,
    scene: PushbroomScene,
    window: Window,
    looks: LookMap,
    oversampling: int,
    seed: np.random.SeedSequence,
) -> LineImage:
    """Return the image of one line, rendered and exposed."""
    done = pushbroom.render_patch(imaged.sensor, imaged.optics, scene, window, oversampling, looks)
    frame = imaged.optics.ccd.expose(done.photons[None], window.first_pixel, imaged.pattern, 1, seed)[0, 0]
    line, pixel = window.middle
    height = float(looks.ground(np.array([line]), np.array([pixel]))[2][0, 0])
    half = np.array([0.5, 0.0])
    along, across = np.abs(imaged.optics.transfer(half, half[::-1], done.motion))
    return LineImage(
        frame=frame,
        window=window,
        measured=imaged.measured,
        sample=window.sample(imaged.sensor, height),
        sensor=imaged.sensor,
        motion=done.motion,
        nyquist=(float(along), float(across)),
        saturated=int(imaged.optics.ccd.detector.saturated(frame[None]).pixels),
        error=done.error,
    )


WRONG_PIXELS, WRONG_SIGMAS, WRONG_FLOOR = 3.0, 5.0, 1.0
"""Limits of the error of a match, above which it counts as wrong.

They are a limit in pixels, and another in sigmas of the match, to which the third number, in pixels, is added.
"""
WRONG = f"more than {WRONG_PIXELS:g} px off, or more than {WRONG_SIGMAS:g} sigmas and {WRONG_FLOOR:g} px"
"""Text for reports that defines a wrong match."""


@dataclass(frozen=True, eq=False)
class LineComparison:
    """Points measured in one line compared with the truth.

    Attributes
    ----------
    measured, matched, accepted : int
        Number of positions that were measured, that matching accepted, and that also agree with their neighbours
        (consensus).
    wrong_measured, wrong_matched, wrong_accepted : int
        Number of wrong positions (see `WRONG`) among each of these.
    right_rejected_by_consensus : int
        Number of right positions that were rejected because they disagree with their neighbours.
    error : (n, 2) ndarray for n points
        Measured minus true, lines and pixels; NaN without a measurement.
    wrong : (n,) ndarray of bool
        Mask of wrong measurements.
    rms : (2,) ndarray
        RMS error of accepted positions that are not wrong, lines and pixels.
    mean : (2,) ndarray
        Mean error of these positions, lines and pixels.
    chi_square : float
        Chi-square of the errors of these positions, with their covariances.
    degrees_of_freedom : int
        Degrees of freedom, two for each position.
    """

    measured: int
    matched: int
    accepted: int
    wrong_measured: int
    wrong_matched: int
    wrong_accepted: int
    right_rejected_by_consensus: int
    error: np.ndarray
    wrong: np.ndarray
    rms: np.ndarray
    mean: np.ndarray
    chi_square: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Probability of a chi-square at least as large if the covariances are right."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)


def true_ground(patch: Patch, points: MatchedPoints) -> np.ndarray:
    """Return the true ground points that the measured points show, ITRS, (n, 3) for n points, in metres.

    The ground shown at a position of a map lies at that position minus the map's error in plan; a tie point is the
    ground that the pixel of the frame in which it was chosen truly sees.
    """
    if points.kind == "map":
        east, north = patch.control.error(points.east, points.north)
        east, north = points.east - east, points.north - north
        return patch.frame.itrs(east, north, patch.terrain.height(east, north))
    source = points.source
    assert source is not None
    position = points.lines[source].position
    return patch.true_point(source, position[:, 0], position[:, 1])


def judged(patch: Patch, points: MatchedPoints) -> Mapping[str, LineComparison]:
    """Compare measured points with the truth in each line, except the frame in which tie points were chosen."""
    truth = true_ground(patch, points)
    judgements = {}
    for name, line in points.searched_lines.items():
        true = np.stack(patch.images[name].sensor.image(truth), axis=-1)
        error = line.image - true
        size = np.linalg.norm(error, axis=1)
        worst = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(line.covariance))[:, 1])
        # Comparisons with NaN are false.
        wrong = (size > WRONG_PIXELS) | (size > WRONG_SIGMAS * worst + WRONG_FLOOR)
        right = line.accepted & ~wrong
        good = error[right]
        square = float(np.einsum("ni,nij,nj->", good, np.linalg.inv(line.covariance[right]), good))
        judgements[name] = LineComparison(
            measured=int(np.isfinite(size).sum()),
            matched=int(line.matched.sum()),
            accepted=int(line.accepted.sum()),
            wrong_measured=int(wrong.sum()),
            wrong_matched=int((wrong & line.matched).sum()),
            wrong_accepted=int((wrong & line.accepted).sum()),
            right_rejected_by_consensus=int((line.matched & ~line.accepted & ~wrong).sum()),
            error=error,
            wrong=wrong,
            rms=np.sqrt(np.mean(good**2, axis=0)) if len(good) else np.full(2, np.nan),
            mean=good.mean(axis=0) if len(good) else np.full(2, np.nan),
            chi_square=square,
            degrees_of_freedom=2 * len(good),
        )
    return FrozenMap(judgements)
