"""Export of a camera's lines on their trajectory as models for other software, with images where there are any.

The lines come from a simulated pass or a test in orbit. The camera is that of the laboratory and the trajectory the
measured one, as the user of the images knows them; on request, both are the true ones. An instrument's cameras can be
those that its monitor has estimated in orbit. The scene of a DIMAP file has the rigorous model of that file.

The quality of exported models comprises their errors on the ground due to the uncertainty of camera and trajectory, the
correction of the polynomials by control points, and the difference of a product's own polynomials from its rigorous
model.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import tifffile
from numpy.typing import NDArray

from analysis.orbit.forward_intersection import CalibratedLine
from analysis.orbit.rational_polynomial import ImageCorrection, Kind, RationalPolynomial
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
    """Control points with their image positions.

    Attributes
    ----------
    file : str
        File of the points.
    read : GroundFile
        Content of the file; image positions count from the centre of the first pixel.
    kind : Kind
        Kind of image correction that is fitted to them, shift or affine.
    """

    file: str
    read: GroundFile
    kind: Kind


@dataclass(frozen=True, eq=False)
class ControlledPolynomial:
    """Rational polynomials of a line, corrected with control points.

    Attributes
    ----------
    names : (N,) ndarray of object for N points
        Names of the points.
    correction : ImageCorrection
        Correction in the image.
    after : RationalPolynomial
        Polynomials that include the correction.
    """

    names: NDArray[np.object_]
    correction: ImageCorrection
    after: RationalPolynomial

    @property
    def rejected_points(self) -> list[str]:
        """Names of the points whose residuals are too large for their covariances."""
        return [str(name) for name in self.names[~self.correction.used]]


@dataclass(frozen=True)
class ProductPolynomial:
    """Comparison of a product's rational polynomials with its rigorous model: polynomials minus rigorous model.

    The comparison covers the whole image and the range of heights of the polynomials.

    Attributes
    ----------
    file : str
        File of the polynomials.
    mean : tuple of float
        Mean difference of line and sample, in pixels.
    rms : tuple of float
        Root mean square about the mean, of line and sample, in pixels.
    largest : float
        Largest absolute difference, in pixels.
    heights : tuple of float
        Lowest and highest ground that the polynomials cover, in metres.
    """

    file: str
    mean: tuple[float, float]
    rms: tuple[float, float]
    largest: float
    heights: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Quality:
    """Accuracy of the models of an export.

    Attributes
    ----------
    maps : Mapping[str, AccuracyMap]
        Name of the line, or `together` for points intersected from all lines -> map of errors on the ground; empty
        where not requested.
    control : Mapping[str, ControlledPolynomial]
        Line -> rational polynomials corrected with control points.
    products : Mapping[str, ProductPolynomial]
        Line -> comparison of the product's own polynomials with its rigorous model.
    """

    maps: Mapping[str, AccuracyMap] = field(default_factory=FrozenMap)
    control: Mapping[str, ControlledPolynomial] = field(default_factory=FrozenMap)
    products: Mapping[str, ProductPolynomial] = field(default_factory=FrozenMap)


def read_control(path: Path, kind: Kind) -> ControlPoints:
    """Read control points from a .gcp file of the Ames Stereo Pipeline.

    Parameters
    ----------
    path : Path
        Path of the file; without a header `# WKT:`, its latitudes, longitudes and heights refer to WGS 84.
    kind : Kind
        Kind of the image correction to be fitted, shift or affine.

    Raises
    ------
    InputError
        The file cannot be read, or has no image positions.
    """
    if path.suffix.lower() != ".gcp":
        raise InputError(Issue("not a .gcp file", str(path), allowed="control points with image positions, .gcp"))
    has_crs = any("WKT:" in line for line in text_lines(path, "a .gcp file") if line.lstrip().startswith("#"))
    spec = GroundFileSpec(file=str(path), crs=None if has_crs else "EPSG:4979")
    points = read_ground_points(spec, Path())
    if not points.images:
        allowed = "after the sigmas of each point: image, column, row, two sigmas"
        raise InputError(Issue("control points without image positions", str(path), allowed=allowed))
    return ControlPoints(str(path), points, kind)


READS = ("orbit_simulate", "orbit_angle")
"""Kinds of test files from which an export can read a camera and its trajectory."""
_PAYLOAD_HINT = "a payload has no orbit: the YAML file of a simulation or of a test of angles that names it"


@dataclass(frozen=True, eq=False)
class ExportSource:
    """Simulation or test whose lines are exported.

    Attributes
    ----------
    setup : SimulateSetup or AngleSetup
        Resolved test file.
    config : str
        Test as YAML, with everything that it refers to.
    folder : Path or None
        Run folder of a simulation; None for a file.
    seed : int
        Seed of the measured orbit and attitude.
    windows : Mapping[str, tuple[int, int, int, int]]
        Line -> first line, first pixel, number of lines and of pixels of the images of a run.
    """

    setup: SimulateSetup | AngleSetup
    config: str
    folder: Path | None
    seed: int
    windows: Mapping[str, tuple[int, int, int, int]]


@dataclass(frozen=True, eq=False)
class SceneSource:
    """Scene of a DIMAP file.

    Attributes
    ----------
    scene : DimapScene
        Content of the file.
    config : str
        Path of the file and chosen band, as YAML.
    """

    scene: DimapScene
    config: str
    folder: ClassVar[None] = None
    seed: ClassVar[int] = 0


@dataclass(frozen=True, eq=False)
class ImagedWindow:
    """Window of a line's image, rendered or not.

    Attributes
    ----------
    name : str
        Name of the line.
    sensor : Sensor
        Sensor whose lines are those of the window.
    first_pixel, pixels : int
        First pixel and number of pixels of the window on the line.
    pitch : float
        Pixel pitch, in metres.
    frame : (lines, pixels) ndarray or None
        Grey values; None where nothing was rendered.
    calibrated : CalibratedLine or None
        Line camera without its change estimated in orbit; None where none was estimated.
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
    """Exported models of a line.

    Attributes
    ----------
    window : ImagedWindow
        Window of the image.
    scanner : LineScanner
        Community sensor model.
    polynomial : RationalPolynomial or None
        Rational polynomials; None where they cannot be fitted.
    refused : str
        Reason why there are no polynomials; empty where there are.
    ground : GroundSigma or None
        Ground error due to the uncertainty of the camera's estimated change; None where none was estimated.
    """

    window: ImagedWindow
    scanner: LineScanner
    polynomial: RationalPolynomial | None
    refused: str
    ground: GroundSigma | None = None


@dataclass(frozen=True, eq=False)
class Export:
    """All models of an export.

    Attributes
    ----------
    source : ExportSource or SceneSource
        Source of the lines.
    epoch : str
        UTC of second 0 of the orbit.
    truth : bool
        True if camera and orbit are the true ones.
    heights : tuple of float
        Lowest, middle and highest ground above the ellipsoid to which models were fitted, in metres.
    lines : Mapping[str, ExportedLine]
        Models by name of the line.
    quality : Quality
        Accuracy of the models; empty where not requested.
    """

    source: ExportSource | SceneSource
    epoch: str
    truth: bool
    heights: tuple[float, float, float]
    lines: Mapping[str, ExportedLine]
    quality: Quality = field(default_factory=Quality)


def read_exportable(path: Path, seed: int | None = None, band: str | None = None) -> ExportSource | SceneSource:
    """Read a source of lines to export: a run folder or YAML file, or the DIMAP file of a scene.

    Parameters
    ----------
    path : Path
        Path of the file or run folder.
    seed : int, optional
        Seed instead of the file's.
    band : str, optional
        Band of a scene whose bands have different lines of sight.

    Raises
    ------
    InputError
        The source is neither of them, or cannot be read.
    """
    if path.is_file() and path.suffix.lower() in _SCENES:
        return SceneSource(read_scene(path, band), dump_yaml({"source": str(path)} | ({"band": band} if band else {})))
    if path.is_file() and path.suffix.lower() in _NITF:
        allowed = "the scene's DIM_NAME.XML, or its rational polynomials as NAME_RPC.TXT, RPC_NAME.XML or GeoTIFF"
        raise InputError(Issue("a NITF file, which is not read", str(path), allowed=allowed))
    if band is not None:
        raise band_error(path, band)
    return read_source(path, seed)


def band_error(path: Path, band: str) -> InputError:
    """Return the error that reports a band requested from a source without bands."""
    return InputError(Issue("only the scene of a DIMAP file has bands", str(path), None, ("band",), band))


_SCENES = (".xml", ".dim")
_NITF = (".ntf", ".nitf", ".nsf")


def read_source(path: Path, seed: int | None = None) -> ExportSource:
    """Read the run folder of a simulation or of a test of angles, or the YAML file of one.

    Parameters
    ----------
    path : Path
        Path of the file or run folder.
    seed : int, optional
        Seed instead of the file's.

    Raises
    ------
    InputError
        The source is neither of them, or cannot be read.
    """
    if path.is_dir():
        return _of_run(path)
    kind = kind_of(read_yaml(path).data)
    if kind is None or kind.name not in READS:
        value = None if kind is None else kind.what
        allowed = "a simulation, a test of intersection angles, the run folder of one, or DIM_NAME.XML of a scene"
        hint = _PAYLOAD_HINT if kind is not None and kind.name in ("three_line_camera", "instrument") else allowed
        raise InputError(Issue("twin.orbit export does not read this", str(path), value=value, allowed=hint))
    setup: SimulateSetup | AngleSetup = (SimulateSetup if kind.name == "orbit_simulate" else AngleSetup).read(path)
    return ExportSource(setup, setup.to_yaml(), None, setup.test.seed if seed is None else seed, FrozenMap())


def _of_run(folder: Path) -> ExportSource:
    manifest = read_manifest(folder)
    if manifest is None or manifest.program != "twin.orbit" or manifest.test not in ("simulate", "angle"):
        value = None if manifest is None else f"a run of {' '.join(filter(None, (manifest.program, manifest.test)))}"
        raise InputError(Issue("not the run folder of twin.orbit simulate or angle", str(folder), value=value))
    if manifest.test == "angle":  # has no images
        tested = AngleSetup.read(folder / "config.yaml")
        return ExportSource(tested, tested.to_yaml(), None, manifest.seed, FrozenMap())
    setup = SimulateSetup.read(folder / "config.yaml")
    numbers = read_yaml(folder / "simulate.json").data
    try:
        windows, keys = {}, ("first_line", "first_pixel", "lines", "pixels")
        for name in setup.test.lines:
            first_line, first_pixel, lines, pixels = (int(numbers["lines"][name][key]) for key in keys)
            windows[name] = first_line, first_pixel, lines, pixels
    except (KeyError, TypeError, ValueError):
        problem, where = "the positions of the images are missing", str(folder / "simulate.json")
        raise InputError(Issue(problem, where, allowed="as the run wrote it")) from None
    return ExportSource(setup, setup.to_yaml(), folder, manifest.seed, FrozenMap(windows))


def run_export(
    source: ExportSource | SceneSource,
    backend: Backend,
    heights: tuple[float, float] | None,
    truth: bool = False,
    advance: Advance = silent,
    changes: Mapping[str, EstimatedChange] | None = None,
) -> Export:
    """Fit the export models (line scanner and rational polynomials) of all lines.

    Parameters
    ----------
    source : ExportSource or SceneSource
        Source of the lines.
    backend : Backend
        Backend on which the lines of an instrument are traced.
    heights : tuple of float, optional
        Lowest and highest ground above the ellipsoid, in metres; None for those of a run's elevation model, or 0 to
        2000 m where there is none.
    truth : bool
        True for the true camera and orbit instead of those that the user knows.
    advance : Advance
        Callback that reports the progress.
    changes : Mapping[str, EstimatedChange], optional
        Camera -> its change estimated in orbit; only for an instrument, and not with `truth`.

    Raises
    ------
    InputError
        An image of the run is missing or has another size.
    BenchError
        No such orbit exists, or the ground cannot be modelled.
    ValueError
        Changes are given for a payload, or with `truth`.
    """
    setup = None if isinstance(source, SceneSource) else source.setup
    if changes is not None and (truth or not isinstance(setup, AngleSetup) or setup.instrument is None):
        raise ValueError("only the cameras of an instrument, as their user knows them, have estimated changes")
    chosen = _heights(source, heights)
    epoch, windows = _windows(source, backend, truth, changes)
    lines, level = {}, _level(source, chosen)
    for k, (name, window) in enumerate(windows.items()):
        advance("models", k, len(windows))
        lines[name] = _exported(window, epoch, chosen, None if changes is None else changes[name], level)
    advance("models", len(windows), len(windows))
    return Export(source, epoch, truth, chosen, FrozenMap(lines))


USUAL_HEIGHTS = (0.0, 2000.0)
"""Lowest and highest ground by default, in metres above the ellipsoid."""
_ROOM = 100.0
"""Margin added below and above the heights of an elevation model, which has errors, in metres."""


def _heights(source: ExportSource | SceneSource, heights: tuple[float, float] | None) -> tuple[float, float, float]:
    if heights is not None:
        return heights[0], 0.5 * (heights[0] + heights[1]), heights[1]
    if source.folder is None:
        return USUAL_HEIGHTS[0], 0.5 * sum(USUAL_HEIGHTS), USUAL_HEIGHTS[1]
    ground = _image(source.folder, "dem")
    low, high = float(np.min(ground)) - _ROOM, float(np.max(ground)) + _ROOM
    return low, float(np.mean(ground)), high


def _level(source: ExportSource | SceneSource, heights: tuple[float, float, float]) -> float:
    """Return the mean height of the ground, in metres: that of a test's terrain, within the modelled heights."""
    if isinstance(source, ExportSource) and isinstance(source.setup, AngleSetup):
        return float(np.clip(source.setup.test.terrain.height, heights[0], heights[2]))
    return heights[1]


def _windows(
    source: ExportSource | SceneSource, backend: Backend, truth: bool, changes: Mapping[str, EstimatedChange] | None
) -> tuple[str, dict[str, ImagedWindow]]:
    """Return the epoch (UTC), and the image window to be exported of each line."""
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
                value, allowed = f"{frame.shape[0]} lines of {frame.shape[1]} pixels", f"{lines} lines of {pixels}"
                where = str(_file(source.folder, name))
                raise InputError(Issue("an image of another size", where, value=value, allowed=allowed))
        part = replace(sensor, first_line_time=float(sensor.time(np.array([first_line]))[0]), lines=lines)
        windows[name] = ImagedWindow(name, part, first_pixel, pixels, setup.camera.pitch_of(name), frame)
    return str(setup.test.orbit.epoch), windows


def _of_angle(
    setup: AngleSetup, backend: Backend, seed: int, truth: bool, changes: Mapping[str, EstimatedChange] | None
) -> dict[str, ImagedWindow]:
    """Return square image windows about the moment of a test of angles, with line spacing equal to pixel spacing."""
    camera = angle_camera(setup, backend)
    flight = fly(setup, camera, np.random.SeedSequence(seed))
    windows = {}
    chosen, calibrated = camera.cameras if truth else camera.laboratory, {}
    if changes is not None and setup.instrument is not None:
        instrument = build_instrument(setup.instrument, setup.cameras, backend)
        calibrated = calibrated_lines(camera.laboratory, instrument, backend)
        chosen = {name: corrected_line(line, calibrated[name], changes[name].values) for name, line in chosen.items()}
    for name, line in chosen.items():
        pitch = _pitch(setup, name)
        time = setup.test.time
        room = min(time - flight.trajectory.first, flight.trajectory.last - time)
        step = _line_time(line, flight.trajectory, flight.earth, time) if room > 2.0 * _PROBE else np.inf
        lines = min(line.pixels, int(2.0 * room / step) - 1)
        if lines < 2:
            raise BenchError("the orbit ends at the moment of the test", ("time",), "a longer orbit")
        first = time - 0.5 * (lines - 1) * step
        sensor = Sensor(line, flight.trajectory, flight.earth, step, first, lines, flight.effects)
        windows[name] = ImagedWindow(name, sensor, 0, line.pixels, pitch, None, calibrated.get(name))
    return windows


def _of_scene(scene: DimapScene, truth: bool) -> dict[str, ImagedWindow]:
    """Return the image window of a scene, its whole image; raise an error if the truth is requested."""
    read = scene.read
    if truth:
        raise InputError(Issue("the truth of a scene is not known", read.file, allowed="no --truth"))
    name = _UNSAFE.sub("_", read.name)[:_LONGEST] or "scene"
    return {name: ImagedWindow(name, scene.sensor, 0, read.pixels, read.pitch or _USUAL_PITCH, None)}


_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")
"""Characters of a data set's name that are replaced in file names."""
_LONGEST = 100
_USUAL_PITCH = 13e-6
"""Pixel pitch assumed where the file gives none, that of Pleiades, in metres; its value has no effect, because the
principal distance scales with it.
"""


def _pitch(setup: AngleSetup, name: str) -> float:
    """Return the pitch of a line's pixels, in metres."""
    if setup.camera is not None:
        return setup.camera.pitch_of(name)
    assert setup.instrument is not None
    return float(setup.cameras[setup.instrument.cameras[name].camera].line.pitch)


_PROBE = 1e-3
"""Time over which the motion of the image is computed to get the line time, in seconds."""


def _line_time(line: LineCamera, trajectory: Trajectory, earth: Any, time: float) -> float:
    """Return the time in which the image at the line's middle moves by one pixel along the track, in seconds."""
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
        extent = window.first_pixel, window.pixels
        notes = () if change is None else change.notes
        scanner = line_scanner(window.sensor, window.name, epoch, window.pitch, heights, extent, notes)
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
    """Return the (rows, columns) array of a run's image."""
    path = _file(folder, name)
    try:
        return np.asarray(tifffile.imread(path, key=0)).squeeze()
    # readers of damaged files raise many kinds of errors
    except Exception as error:
        raise InputError(Issue(f"cannot be read: {error}", str(path), allowed="the file as the run wrote it")) from None
