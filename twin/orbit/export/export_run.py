"""What is exported: lines of a camera on their way, from a simulated pass or a test in orbit, as models for other
software, with their images where there are any.

The camera is the laboratory's and the way the measured one, as the user of the images knows them; or, where asked for,
both as they truly are. An instrument's cameras can be those that its monitor has estimated in orbit. The scene of a
DIMAP file is as that file tells it.

What is told of the worth of exported models: their errors on the ground by what is uncertain of camera and way, how
control points correct the polynomials, and how a product's own polynomials agree with its rigorous model.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from analysis.orbit.forward_intersection import CalibratedLine
from analysis.orbit.image_correction import ImageCorrection, Kind
from analysis.orbit.rational_polynomial import RationalPolynomial
from optics.numerics.number_tree import FrozenMap
from scenes.models.instrument_builder import build_instrument
from scenes.specs.file_kinds import kind_of
from scenes.specs.orbit.measurements import GroundFileSpec
from scenes.specs.orbit.setup import AngleSetup, SimulateSetup
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.run_folder import read_manifest
from twin.orbit.angle.angle_flight import angle_camera, fly
from twin.orbit.export.ground_accuracy import AccuracyMap, EstimatedChange, GroundSigma, ground_sigma
from twin.orbit.export.line_scanner import LineScanner, line_scanner
from twin.orbit.export.rational_polynomial import sensor_polynomial
from twin.orbit.flight.line_camera import LineCamera, calibrated_lines, corrected_line
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Trajectory
from twin.orbit.images.simulate_run import fly_simulation
from twin.orbit.measured.ground_files import GroundFile, read_ground_points
from twin.orbit.measured.platform_files import DimapScene, read_scene
from twin.orbit.measured.xml_file import text_lines

if TYPE_CHECKING:
    from optics.numerics.backend import Backend


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Control points with their places in images.

    Attributes
    ----------
    file : str
        That they are from.
    read : GroundFile
        What it holds; places count from the centre of the first pixel.
    kind : Kind
        Of the correction that they determine.
    """

    file: str
    read: GroundFile
    kind: Kind


@dataclass(frozen=True, eq=False)
class Controlled:
    """A line's polynomials after control.

    Attributes
    ----------
    names : NDArray[np.object_]
        (N,) of the points.
    correction : ImageCorrection
        Of the image.
    after : RationalPolynomial
        Polynomials with the correction inside.
    """

    names: NDArray[np.object_]
    correction: ImageCorrection
    after: RationalPolynomial

    @property
    def left_out(self) -> list[str]:
        """Names of the points that lie beyond their covariances."""
        return [str(name) for name in self.names[~self.correction.used]]


@dataclass(frozen=True)
class ProductPolynomial:
    """Rational polynomials that came with a product, against its rigorous model, over the image and the heights that
    the polynomials cover; polynomials minus rigorous.

    Attributes
    ----------
    file : str
        Where they are from.
    mean : tuple[float, float]
        Mean difference of line and sample, pixels.
    rms : tuple[float, float]
        Root mean square about the mean, likewise.
    most : float
        Largest of all differences, pixels.
    heights : tuple[float, float]
        Lowest and highest ground that the polynomials cover, metres.
    """

    file: str
    mean: tuple[float, float]
    rms: tuple[float, float]
    most: float
    heights: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Quality:
    """What the models of an export are worth.

    Attributes
    ----------
    maps : Mapping[str, AccuracyMap]
        Line, or `together` for points that all lines intersect -> errors on the ground; empty where nobody asked.
    control : Mapping[str, Controlled]
        Line -> how control points corrected its polynomials.
    products : Mapping[str, ProductPolynomial]
        Line -> polynomials that came with it.
    """

    maps: Mapping[str, AccuracyMap] = field(default_factory=FrozenMap)
    control: Mapping[str, Controlled] = field(default_factory=FrozenMap)
    products: Mapping[str, ProductPolynomial] = field(default_factory=FrozenMap)


def read_control(path: Path, kind: Kind) -> ControlPoints:
    """Control points of a .gcp file of the Ames Stereo Pipeline.

    Parameters
    ----------
    path : Path
        Of it; without a header `# WKT:` its latitudes and longitudes are those of WGS 84, heights above it.
    kind : Kind
        Of the correction.

    Raises
    ------
    InputError
        It cannot be read, or has no places in images.
    """
    if path.suffix.lower() != ".gcp":
        raise InputError(Issue("not a .gcp file", str(path), allowed="control points with places in images, .gcp"))
    stated = any("WKT:" in line for line in text_lines(path, "a .gcp file") if line.lstrip().startswith("#"))
    spec = GroundFileSpec(file=str(path), crs=None if stated else "EPSG:4979")
    found = read_ground_points(spec, Path())
    if not found.images:
        allowed = "after the sigmas of each point: image, column, row, two sigmas"
        raise InputError(Issue("control points without places in images", str(path), allowed=allowed))
    return ControlPoints(str(path), found, kind)


READS = ("orbit_simulate", "orbit_angle")
"""Kinds of files that say a camera and its way."""
_PAYLOAD_HINT = "a payload has no orbit: the YAML file of a simulation or of a test of angles that names it"


@dataclass(frozen=True, eq=False)
class ExportSource:
    """What was read.

    Attributes
    ----------
    setup : SimulateSetup | AngleSetup
        Of the test.
    config : str
        It, as YAML with all that it refers to.
    folder : Path | None
        Of a simulation's run, None for a file.
    seed : int
        Of the measured orbit and attitude.
    windows : Mapping[str, tuple[int, int, int, int]]
        Line -> its first line, first pixel, lines and pixels, of the images of a run.
    """

    setup: SimulateSetup | AngleSetup
    config: str
    folder: Path | None
    seed: int
    windows: Mapping[str, tuple[int, int, int, int]]


@dataclass(frozen=True, eq=False)
class SceneSource:
    """The scene of a DIMAP file.

    Attributes
    ----------
    scene : DimapScene
        What the file tells.
    config : str
        Its path and what was chosen of it, as YAML.
    """

    scene: DimapScene
    config: str

    @property
    def folder(self) -> None:
        """No run."""
        return None

    @property
    def seed(self) -> int:
        """Any: nothing is drawn."""
        return 0


@dataclass(frozen=True, eq=False)
class ImagedWindow:
    """A line's image, or where it would be.

    Attributes
    ----------
    name : str
        Of the line.
    sensor : Sensor
        Its lines are those of the window.
    first_pixel, pixels : int
        Of the window on the line.
    pitch : float
        Of the pixels, metres.
    frame : np.ndarray | None
        Grey values, (lines, pixels); None where nothing was rendered.
    calibrated : CalibratedLine | None
        The line before its estimated change; None where none was estimated.
    """

    name: str
    sensor: Sensor
    first_pixel: int
    pixels: int
    pitch: float
    frame: np.ndarray | None
    calibrated: CalibratedLine | None = None


@dataclass(frozen=True, eq=False)
class ExportedLine:
    """A line as other software gets it.

    Attributes
    ----------
    window : ImagedWindow
        Of it.
    scanner : LineScanner
        Community sensor model.
    polynomial : RationalPolynomial | None
        Rational polynomials; None where they cannot be, and why.
    refused : str
        Why there are no polynomials, empty where there are.
    ground : GroundSigma | None
        What is uncertain of the camera's estimated change, on the ground; None where none was estimated.
    """

    window: ImagedWindow
    scanner: LineScanner
    polynomial: RationalPolynomial | None
    refused: str
    ground: GroundSigma | None = None


@dataclass(frozen=True, eq=False)
class Export:
    """All that is written.

    Attributes
    ----------
    source : ExportSource | SceneSource
        What was read.
    epoch : str
        UTC of second 0 of the orbit.
    truth : bool
        Whether camera and orbit are the true ones.
    heights : tuple[float, float, float]
        Of the ground above the ellipsoid that models were fitted to: lowest, middle, highest, metres.
    lines : Mapping[str, ExportedLine]
        By name.
    quality : Quality
        What they are worth; None where it was not looked at.
    """

    source: ExportSource | SceneSource
    epoch: str
    truth: bool
    heights: tuple[float, float, float]
    lines: Mapping[str, ExportedLine]
    quality: Quality = field(default_factory=Quality)


def read_exportable(path: Path, seed: int | None = None, band: str | None = None) -> ExportSource | SceneSource:
    """Whatever has a camera and its way: what `read_source` takes, or the DIMAP file of a scene.

    Parameters
    ----------
    path : Path
        Of it.
    seed : int | None
        In place of the file's.
    band : str | None
        Of a scene whose bands do not look alike.

    Raises
    ------
    InputError
        It is neither, or cannot be read.
    """
    if path.is_file() and path.suffix.lower() in _SCENES:
        return SceneSource(read_scene(path, band), dump_yaml({"source": str(path)} | ({"band": band} if band else {})))
    if path.is_file() and path.suffix.lower() in _NITF:
        allowed = "the scene's DIM_NAME.XML, or its rational polynomials as NAME_RPC.TXT, RPC_NAME.XML or GeoTIFF"
        raise InputError(Issue("a NITF file, which is not read", str(path), allowed=allowed))
    if band is not None:
        raise no_bands(path, band)
    return read_source(path, seed)


def no_bands(path: Path, band: str) -> InputError:
    """Return the error of a band that was asked for of a source without bands."""
    return InputError(Issue("only the scene of a DIMAP file has bands", str(path), None, ("band",), band))


_SCENES = (".xml", ".dim")
_NITF = (".ntf", ".nitf", ".nsf")


def read_source(path: Path, seed: int | None = None) -> ExportSource:
    """The run folder of a simulation or of a test of angles, or the YAML file of one.

    Parameters
    ----------
    path : Path
        Of it.
    seed : int | None
        In place of the file's.

    Raises
    ------
    InputError
        It is neither, or cannot be read.
    """
    if path.is_dir():
        return _of_run(path)
    kind = kind_of(read_yaml(path).data)
    if kind is None or kind.name not in READS:
        found = None if kind is None else kind.what
        allowed = "a simulation, a test of intersection angles, the run folder of one, or DIM_NAME.XML of a scene"
        hint = _PAYLOAD_HINT if kind is not None and kind.name in ("three_line_camera", "instrument") else allowed
        raise InputError(Issue("twin.orbit export does not read this", str(path), found=found, allowed=hint))
    resolve: Callable[[Path], SimulateSetup | AngleSetup] = (
        SimulateSetup.read if kind.name == "orbit_simulate" else AngleSetup.read
    )
    setup = resolve(path)
    return ExportSource(setup, setup.to_yaml(), None, setup.test.seed if seed is None else seed, FrozenMap())


def _of_run(folder: Path) -> ExportSource:
    manifest = read_manifest(folder)
    if manifest is None or manifest.program != "twin.orbit" or manifest.test not in ("simulate", "angle"):
        found = None if manifest is None else f"a run of {' '.join(filter(None, (manifest.program, manifest.test)))}"
        raise InputError(Issue("not the run folder of twin.orbit simulate or angle", str(folder), found=found))
    if manifest.test == "angle":  # has no images
        tested = AngleSetup.read(folder / "config.yaml")
        return ExportSource(tested, tested.to_yaml(), None, manifest.seed, FrozenMap())
    setup = SimulateSetup.read(folder / "config.yaml")
    numbers = read_yaml(folder / "simulate.json").data
    try:
        windows = {}
        for name in setup.test.lines:
            one = numbers["lines"][name]
            windows[name] = int(one["first_line"]), int(one["first_pixel"]), int(one["lines"]), int(one["pixels"])
    except (KeyError, TypeError, ValueError):
        where = str(folder / "simulate.json")
        raise InputError(Issue("does not say where the images lie", where, allowed="as the run wrote it")) from None
    return ExportSource(setup, setup.to_yaml(), folder, manifest.seed, FrozenMap(windows))


def run_export(
    source: ExportSource | SceneSource,
    backend: Backend,
    heights: tuple[float, float] | None,
    truth: bool = False,
    advance: Advance = silent,
    changes: Mapping[str, EstimatedChange] | None = None,
) -> Export:
    """Fit the models of all lines.

    Parameters
    ----------
    source : ExportSource | SceneSource
        What was read.
    backend : Backend
        Where the lines of an instrument are traced.
    heights : tuple[float, float] | None
        Lowest and highest ground above the ellipsoid, metres; None for those of a run's elevation model, else for 0 to
        2 000 m.
    truth : bool
        Camera and orbit as they are in place of those that the user knows.
    advance : Advance
        Told how far it is.
    changes : Mapping[str, EstimatedChange] | None
        Camera -> what is estimated of it in orbit; of an instrument, and not of the truth.

    Raises
    ------
    InputError
        An image of the run is missing or another one.
    BenchError
        No such orbit, or ground that cannot be modelled.
    ValueError
        Changes of a payload, or of the truth.
    """
    setup = None if isinstance(source, SceneSource) else source.setup
    if changes is not None and (truth or not isinstance(setup, AngleSetup) or setup.instrument is None):
        raise ValueError("only the cameras of an instrument, as their user knows them, have estimated changes")
    chosen = _heights(source, heights)
    epoch, windows = _windows(source, backend, truth, changes)
    lines = {}
    for k, (name, window) in enumerate(windows.items()):
        advance("models", k, len(windows))
        lines[name] = _exported(
            window, epoch, chosen, None if changes is None else changes[name], _level(source, chosen)
        )
    advance("models", len(windows), len(windows))
    return Export(source, epoch, truth, chosen, FrozenMap(lines))


USUAL_HEIGHTS = (0.0, 2000.0)
"""Metres above the ellipsoid."""
_ROOM = 100.0
"""Metres about the heights of an elevation model, which has errors."""


def _heights(source: ExportSource | SceneSource, heights: tuple[float, float] | None) -> tuple[float, float, float]:
    if heights is not None:
        return heights[0], 0.5 * (heights[0] + heights[1]), heights[1]
    if source.folder is None:
        return USUAL_HEIGHTS[0], 0.5 * sum(USUAL_HEIGHTS), USUAL_HEIGHTS[1]
    ground = _image(source.folder, "dem")
    low, high = float(np.min(ground)) - _ROOM, float(np.max(ground)) + _ROOM
    return low, float(np.mean(ground)), high


def _level(source: ExportSource | SceneSource, heights: tuple[float, float, float]) -> float:
    """Mean height of the ground, metres: that of a test's terrain, within the heights that are modelled."""
    if isinstance(source, ExportSource) and isinstance(source.setup, AngleSetup):
        return float(np.clip(source.setup.test.terrain.height, heights[0], heights[2]))
    return heights[1]


def _windows(
    source: ExportSource | SceneSource, backend: Backend, truth: bool, changes: Mapping[str, EstimatedChange] | None
) -> tuple[str, dict[str, ImagedWindow]]:
    """Epoch, and the images by line."""
    if isinstance(source, SceneSource):
        return source.scene.epoch, _of_scene(source.scene, truth)
    setup = source.setup
    if isinstance(setup, AngleSetup):
        return str(setup.test.orbit.epoch), _of_angle(setup, backend, source.seed, truth, changes)
    flight = fly_simulation(setup, source.seed)
    windows = {}
    for name, sensor in (flight.sensors if truth else flight.users).items():
        pixels, frame = sensor.camera.pixels, None
        first_line, first_pixel, lines = 0, 0, sensor.lines
        if source.folder is not None:
            first_line, first_pixel, lines, pixels = source.windows[name]
            frame = _image(source.folder, name)
            if frame.shape != (lines, pixels):
                found = f"{frame.shape[0]} lines of {frame.shape[1]} pixels"
                where = str(_file(source.folder, name))
                raise InputError(Issue("another image", where, found=found, allowed=f"{lines} lines of {pixels}"))
        part = replace(sensor, first_line_time=float(sensor.time(np.array([first_line]))[0]), lines=lines)
        windows[name] = ImagedWindow(name, part, first_pixel, pixels, setup.camera.pitch_of(name), frame)
    return str(setup.test.orbit.epoch), windows


def _of_angle(
    setup: AngleSetup, backend: Backend, seed: int, truth: bool, changes: Mapping[str, EstimatedChange] | None
) -> dict[str, ImagedWindow]:
    """Images as long as they are wide, their lines spaced as their pixels are, about the moment of the test."""
    camera = angle_camera(setup, backend)
    flown = fly(setup, camera, np.random.SeedSequence(seed))
    windows = {}
    chosen, known = camera.cameras if truth else camera.laboratory, {}
    if changes is not None and setup.instrument is not None:
        instrument = build_instrument(setup.instrument, setup.cameras, backend)
        known = calibrated_lines(camera.laboratory, instrument, backend)
        chosen = {name: corrected_line(line, known[name], changes[name].values) for name, line in chosen.items()}
    for name, line in chosen.items():
        pitch = _pitch(setup, name)
        time = setup.test.time
        room = min(time - flown.trajectory.first, flown.trajectory.last - time)
        step = _line_time(line, flown.trajectory, flown.earth, time) if room > 2.0 * _PROBE else np.inf
        lines = min(line.pixels, int(2.0 * room / step) - 1)
        if lines < 2:
            raise BenchError("the orbit ends at the moment of the test", ("time",), "a longer orbit")
        first = time - 0.5 * (lines - 1) * step
        sensor = Sensor(line, flown.trajectory, flown.earth, step, first, lines, flown.effects)
        windows[name] = ImagedWindow(name, sensor, 0, line.pixels, pitch, None, known.get(name))
    return windows


def _of_scene(scene: DimapScene, truth: bool) -> dict[str, ImagedWindow]:
    """The one image of a scene. What is told of it is all that is known."""
    read = scene.read
    if truth:
        raise InputError(Issue("nobody knows the truth of a scene", read.file, allowed="no --truth"))
    name = _UNSAFE.sub("_", read.name)[:_LONGEST] or "scene"
    return {name: ImagedWindow(name, scene.sensor, 0, read.pixels, read.pitch or _USUAL_PITCH, None)}


_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")
"""Letters of a data set's name that names of files do without."""
_LONGEST = 100
_USUAL_PITCH = 13e-6
"""Metres, of Pleiades; a camera model is the same for every pitch, as its principal distance goes with it."""


def _pitch(setup: AngleSetup, name: str) -> float:
    """Pitch of a line's pixels, metres."""
    if setup.camera is not None:
        return setup.camera.pitch_of(name)
    assert setup.instrument is not None
    return float(setup.cameras[setup.instrument.cameras[name].camera].line.pitch)


_PROBE = 1e-3
"""Seconds over which the motion of an image is looked at."""


def _line_time(line: LineCamera, trajectory: Trajectory, earth: Any, time: float) -> float:
    """Seconds in which the image of the line's middle moves by a pixel along the track."""
    middle = np.array([0.5 * (line.pixels - 1)])
    probe = Sensor(line, trajectory, earth, _PROBE, time, 1)
    ground = probe.ground(np.array([0.0, 0.0]), middle + np.array([-0.5, 0.5]), 0.0)
    after = replace(probe, first_line_time=time + _PROBE).ground(np.array([0.0]), middle, 0.0)
    before = probe.ground(np.array([0.0]), middle, 0.0)
    return _PROBE * float(np.linalg.norm(ground[1] - ground[0]) / np.linalg.norm(after[0] - before[0]))


def _exported(
    window: ImagedWindow, epoch: str, heights: tuple[float, float, float], change: EstimatedChange | None, level: float
) -> ExportedLine:
    ground = None
    try:
        place = window.first_pixel, window.pixels
        notes = () if change is None else change.notes
        scanner = line_scanner(window.sensor, window.name, epoch, window.pitch, heights, place, notes)
        if change is not None and window.calibrated is not None:
            ground = ground_sigma(window.sensor, window.calibrated, change, level)
    except ValueError as error:
        raise BenchError(f"{window.name}: {error}", ("orbit",), "an orbit over ground that every line sees") from error
    try:
        ends = heights[0], heights[2]
        polynomial = sensor_polynomial(window.sensor, window.first_pixel, window.pixels, ends)
    except ValueError as error:
        return ExportedLine(window, scanner, None, str(error), ground)
    if ground is not None:
        polynomial = replace(polynomial, bias_m=ground.bias_m, random_m=ground.random_m)
    return ExportedLine(window, scanner, polynomial, "", ground)


def _file(folder: Path, name: str) -> Path:
    return folder / "images" / f"{name}.tiff"


def _image(folder: Path, name: str) -> np.ndarray:
    """(rows, columns) of a run's image."""
    path = _file(folder, name)
    try:
        return np.asarray(tifffile.imread(path, key=0)).squeeze()
    # readers of spoilt files fail in ways that cannot be foreseen
    except Exception as error:
        raise InputError(Issue(f"cannot be read: {error}", str(path), allowed="as the run wrote it")) from None
