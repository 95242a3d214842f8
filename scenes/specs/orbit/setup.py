"""Tests in orbit with the content of all their references: simulated, or on measurements without random numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, Self

from pydantic import Field

from optics.numerics.number_tree import FrozenMap
from scenes.specs import load
from scenes.specs.camera import CameraSpec
from scenes.specs.course import DEFAULT_PIVOT
from scenes.specs.detector import DetectorSpec, require_detector
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.orbit import measurements
from scenes.specs.orbit.adjust import MeasuredAdjustSpec, OrbitAdjustSpec
from scenes.specs.orbit.angle import LINES, OrbitAngleSpec, usual_angles
from scenes.specs.orbit.calibration import OrbitCalibrationSpec, checked_schemes
from scenes.specs.orbit.jitter_search import OrbitJitterSpec
from scenes.specs.orbit.monitor import MechanismsSpec, OrbitMonitorSpec
from scenes.specs.orbit.rational import RationalAdjustSpec, RationalMatchSpec
from scenes.specs.orbit.scene import LineImageSpec, OrbitSimulateSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, TestType, resolve_job
from scenes.yaml.errors import KeyPath, Problem, names_text, unknown
from scenes.yaml.input_file import MISSING, no_file
from scenes.yaml.spec import Inline, Paths, Spec, validate
from scenes.yaml.units import ANGLE, format_quantity
from scenes.yaml.yaml_file import read_yaml


def load_three_line_camera(reference: str | Path, owner: Spec | None = None, key: KeyPath = ()) -> ThreeLineCameraSpec:
    """Read the file of a three-line payload.

    Parameters
    ----------
    reference : str | Path
        Name in the library, path, or the mapping itself, as in a file of the twin.
    owner : Spec | None
        Specification that has the reference; None for a path from the current folder.
    key : KeyPath
        Key of the reference in the owner.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file.
    """
    return load.load_named(ThreeLineCameraSpec, load.PAYLOADS, reference, owner, key)


def _line_detectors(camera: ThreeLineCameraSpec) -> FrozenMap[str, DetectorSpec]:
    """Return reference of each image section of a payload -> data sheet of the line CCD."""
    sections: list[tuple[KeyPath, LineImageSpec | None]] = [(("image",), camera.image)]
    sections += [(("lines", name, "image"), line.image) for name, line in camera.lines.items()]
    used = [(key, image.detector) for key, image in sections if image is not None]
    return FrozenMap({name: load.load_detector(name, camera, (*key, "detector")) for key, name in used})


class AngleSetup(ExperimentSetup[OrbitAngleSpec]):
    """Intersection-angle test with its camera: a payload, or an instrument with its cameras.

    Attributes
    ----------
    camera : ThreeLineCameraSpec | None
        The payload; None for an instrument.
    instrument : InstrumentSpec | None
        The instrument; None for a payload.
    cameras : Mapping[str, CameraSpec]
        Reference in `instrument.cameras.<name>.camera` -> prescription; empty for a payload.
    """

    FOLDER = load.ORBIT

    camera: ThreeLineCameraSpec | None = None
    instrument: InstrumentSpec | None = None
    cameras: Paths[CameraSpec] = Field(default_factory=FrozenMap)

    @classmethod
    def parts(cls, test: OrbitAngleSpec) -> dict[str, Any]:
        """Read the payload, or the instrument with its cameras; return field -> content."""
        reference, key = test.camera, ("camera",)
        folders = (load.PAYLOADS, load.INSTRUMENTS)
        known = next((folder for folder in folders if load.reference_path(folder, reference, test) is not None), None)
        if known is None and not isinstance(reference, Inline):
            payloads, instruments = (load.library_names(folder) for folder in folders)
            allowed = f"{names_text(payloads)}, an instrument ({names_text(instruments)}), or the path of a .yaml file"
            problem = "no such name in payloads or instruments"
            raise test.error(unknown(problem, reference, (*payloads, *instruments), allowed=allowed), key)
        if not load.is_instrument(load.read_reference(known or load.PAYLOADS, reference, test, key).data):
            return {"camera": load_three_line_camera(reference, test, key)}
        instrument = load.load_instrument(reference, test, key)
        return {"instrument": instrument, "cameras": load.load_cameras(instrument)}

    @property
    def pixels(self) -> Mapping[str, int]:
        """Name of each line -> number of its pixels, in the order of the file."""
        if self.instrument is not None:
            return {name: self.cameras[m.camera].line.pixels for name, m in self.instrument.cameras.items()}
        assert self.camera is not None
        return {name: self.camera.pixels_of(name) for name in self.camera.lines}

    @property
    def usual_pixels(self) -> int:
        """Number of pixels of the standard line, to which the pixel positions of the strips in the file refer."""
        return self.camera.pixels if self.camera is not None else next(iter(self.pixels.values()))

    @property
    def camera_name(self) -> str:
        """Name of the payload or instrument."""
        return (self.camera or self.instrument).name  # type: ignore[union-attr]

    @property
    def angles(self) -> Mapping[str, tuple[str, str]]:
        """Name of each intersection angle -> its two lines, including the defaults."""
        return self.test.angles or {}

    def checked(self) -> Self:
        """Return the set-up with default angles, after a check that angles, changes and strips fit the lines."""
        if (self.camera is None) == (self.instrument is None):
            value = "neither" if self.camera is None else "both"
            raise self.error("one camera is needed", ("camera",), value=value, allowed="`camera:` or `instrument:`")
        for name, mounted in self.instrument.cameras.items() if self.instrument is not None else ():
            if mounted.camera not in self.cameras:
                problem = f"camera {mounted.camera!r} of the instrument's {name} is missing"
                raise self.error(problem, ("cameras",), allowed=f"cameras.{mounted.camera}: its prescription")
        test, lines = self.test, tuple(self.pixels)
        has = f"{names_text(lines)} in {self.camera_name}"
        if len(lines) < 2:
            allowed = "a camera with two lines or more"
            raise test.error("an angle needs two lines", ("camera",), value=has, allowed=allowed)
        angles = test.angles or usual_angles(lines)
        if angles is None:
            problem = "the lines of the angles are missing"
            allowed = "`angles:` with a name and two lines for each, as alpha: [forward, nadir]"
            raise test.error(problem, ("camera",), value=has, allowed=allowed)
        for name, pair in angles.items():
            for k, line in enumerate(pair):
                if line not in lines:
                    raise test.error(unknown("no such line", line, lines), ("angles", name, k))
        if self.camera is not None:
            _require_rotations(test, lines)
        ends = (test.strips.first, test.strips.last)
        _require_ends(test, "strips", ends, self.usual_pixels, f"the lines of {self.camera_name}")
        return self.model_copy(update={"test": test.model_copy(update={"angles": FrozenMap(angles)})})


class PayloadSetup(ExperimentSetup[TestType], Generic[TestType]):
    """Test of a payload, with the content of the payload's file.

    Attributes
    ----------
    camera : ThreeLineCameraSpec
        The payload.
    """

    FOLDER = load.ORBIT

    camera: ThreeLineCameraSpec

    @classmethod
    def parts(cls, test: Any) -> dict[str, Any]:
        """Read the payload, and make the paths of the test absolute; return field -> content."""
        camera = load_three_line_camera(test.camera, test, ("camera",))
        return {"test": _placed(test), "camera": camera}


class CalibrationSetup(PayloadSetup[OrbitCalibrationSpec]):
    """In-orbit calibration, with the content of its camera's file.

    Attributes
    ----------
    detectors : Mapping[str, DetectorSpec]
        Data sheets of the camera's line CCDs, if images are rendered.
    """

    detectors: Paths[DetectorSpec] = Field(default_factory=FrozenMap)

    @classmethod
    def parts(cls, test: OrbitCalibrationSpec) -> dict[str, Any]:
        """Read the payload, and data sheets if images are rendered; return field of the set-up -> content."""
        parts = super().parts(test)
        return parts if test.images is None else {**parts, "detectors": _line_detectors(parts["camera"])}

    def checked(self) -> Self:
        """Check that the camera has the three lines, and that points and changes lie on them; return the set-up."""
        test, camera = self.test, self.camera
        if missing := [name for name in LINES if name not in camera.lines]:
            value = f"{names_text(tuple(camera.lines))} in {camera.name}"
            problem = f"the camera has no {' and no '.join(missing)} line"
            raise test.error(problem, ("camera",), value=value, allowed=_THREE_LINES)
        _require_known("line", test, ("perturb",), test.perturb, LINES)
        _require_known("line", test, ("drift",), test.drift, LINES)
        _require_movable(test, (*test.perturb, *test.drift), camera)
        if "nadir" in test.perturb and any(test.perturb["nadir"].principal_point):
            problem, where = "the nadir line's principal point is the gauge", ("perturb", "nadir", "principal_point")
            allowed = "no change; rotate the whole camera instead, by errors.star_tracker.bias"
            raise test.error(problem, where, allowed=allowed)
        fewest = min(camera.pixels_of(name) for name in LINES)
        if test.points is not None:
            _require_ends(test, "points", (test.points.first, test.points.last), fewest, f"the lines of {camera.name}")
        if test.images is None:
            return self
        _require_images_of(test, LINES, camera)
        _require_detectors(self, tuple(camera.lines), camera, self.detectors)
        for k, patch in enumerate(test.images.patches):
            key, pixels = ("images", "patches", k, "pixel"), camera.pixels_of("nadir")
            _require_pixel(test, key, patch.pixel, pixels, f"the nadir line of {camera.name}")
        return self


_JOB_PARTS = ("instrument", "cameras", "detector", "disturbances")
"""Contents of files that a test of monitoring shares with the job of its images."""


class MonitorSetup(ExperimentSetup[OrbitMonitorSpec]):
    """Monitored stereo pair along its orbit, with the content of its instrument's files.

    Attributes
    ----------
    instrument : InstrumentSpec
        Cameras and monitors on their base.
    cameras : Mapping[str, CameraSpec]
        Reference in the instrument -> prescription.
    detector : DetectorSpec
        Data sheet of the monitor's area CCDs.
    disturbances : DisturbancesSpec | None
        Expected disturbances; None if there is none.
    """

    FOLDER = load.ORBIT

    instrument: InstrumentSpec
    cameras: Paths[CameraSpec]
    detector: DetectorSpec
    disturbances: DisturbancesSpec | None = None

    @classmethod
    def parts(cls, test: OrbitMonitorSpec) -> dict[str, Any]:
        """Read the instrument with its cameras, data sheets and disturbances; return field -> content."""
        job = resolve_job(test.job)
        return {key: getattr(job, key) for key in _JOB_PARTS}

    def checked(self) -> Self:
        """Check that test and instrument fit together; return the set-up."""
        _require_pair(self.test, self.instrument, self.cameras)
        if self.test.mechanisms is not None:
            _require_mechanisms(self, self.test.mechanisms)
        return self

    @property
    def resolved(self) -> ResolvedJob:
        """Job of the monitor's images with the content of all files to which it refers."""
        parts = {key: getattr(self, key) for key in _JOB_PARTS}
        return ResolvedJob.model_construct(job=self.test.job, line_detectors=None, **parts)

    @property
    def pair(self) -> tuple[str, str]:
        """Names of the two cameras of the stereo pair."""
        first, second = self.test.cameras or tuple(self.instrument.cameras)
        return first, second


class SimulateSetup(PayloadSetup[OrbitSimulateSpec]):
    """Simulation of images of a patch of ground, with the content of its camera's file.

    Attributes
    ----------
    detectors : Mapping[str, DetectorSpec]
        Reference of an image section -> data sheet of a line CCD.
    """

    detectors: Paths[DetectorSpec]

    @classmethod
    def parts(cls, test: OrbitSimulateSpec) -> dict[str, Any]:
        """Read the payload and the data sheets of its line CCDs; return field -> content."""
        parts = super().parts(test)
        return {**parts, "detectors": _line_detectors(parts["camera"])}

    def checked(self) -> Self:
        """Check that the lines exist and can be rendered, and that the patch lies on one of them."""
        test, camera = self.test, self.camera
        names = tuple(camera.lines)
        named = [(("patch", "line"), test.patch.line), *((("perturb", name), name) for name in test.perturb)]
        for key, name in [*((("lines",), name) for name in test.lines), *named]:
            if name not in names:
                allowed = f"{names_text(names)}, the lines of {camera.name}"
                raise test.error(unknown("no such line", name, names, allowed=allowed), key)
        _require_movable(test, test.perturb, camera)
        _require_images_of(test, test.lines, camera)
        line, pixels = f"the line {test.patch.line} of {camera.name}", camera.pixels_of(test.patch.line)
        _require_pixel(test, ("patch", "pixel"), test.patch.pixel, pixels, line)
        if wrong := test.orbit.misses(test.patch.time):
            raise test.error(wrong, ("patch", "time"))
        _require_detectors(self, test.lines, camera, self.detectors)
        return self


class JitterSetup(PayloadSetup[OrbitJitterSpec]):
    """Search for jitter in a simulated pass, with the content of its camera's file."""

    def checked(self) -> Self:
        """Check that the camera has two or more of the lines in the file; return the set-up."""
        _require_several(self.test, self.test.lines, self.camera)
        _require_known("line", self.test, ("points", "line_noise"), self.test.points.line_noise, self.camera.lines)
        return self


class AdjustSetup(PayloadSetup[OrbitAdjustSpec]):
    """Bundle adjustment of a simulated block, with the content of its camera's file."""

    def checked(self) -> Self:
        """Check that the camera has the lines, and the block the excluded sensors; return the set-up."""
        for k, name in enumerate(self.test.lines):
            if name not in self.camera.lines:
                raise self.test.error(unknown("no such line", name, self.camera.lines), ("lines", k))
        _require_sensors(self.test)
        return self


class CheckSetup(PayloadSetup[measurements.OrbitCheckSpec]):
    """Check of the conventions of a pass, with the content of its camera's file."""


class MatchSetup(PayloadSetup[measurements.OrbitMatchSpec]):
    """Matching of points in a user's images, with the content of the camera's file."""

    def checked(self) -> Self:
        """Check that the camera has the lines of the images; return the set-up."""
        _require_known("line", self.test, ("images",), self.test.images, self.camera.lines)
        return self


class MeasuredPassesSetup(PayloadSetup[TestType], Generic[TestType]):
    """Base of tests on measurements of passes, with the content of the camera's file.

    Attributes
    ----------
    data : OrbitDataSpec
        Passes with absolute paths.
    """

    data: measurements.OrbitDataSpec

    @classmethod
    def measured_by(cls, keys: Mapping[str, Any]) -> bool:
        """Return whether a file with these keys is a test on measured passes.

        In such a file `passes` is a mapping; in a simulation it is a number.
        """
        return "data" in keys or "conventions" in keys or isinstance(keys.get("passes"), dict)

    @classmethod
    def parts(cls, test: Any) -> dict[str, Any]:
        """Read the payload and the description of the passes; return field -> content."""
        return {**super().parts(test), "data": data_of(test)}


class MeasuredCalibrationSetup(MeasuredPassesSetup[measurements.MeasuredCalibrationSpec]):
    """In-orbit calibration on measured passes, with the content of the camera's file."""

    def checked(self) -> Self:
        """Check that the schemes refer to existing passes; return the set-up."""
        try:
            checked_schemes(self.test.schemes, self.data.passes)
        except Problem as problem:
            raise self.test.error(problem) from None
        return self


class MeasuredAngleSetup(MeasuredPassesSetup[measurements.MeasuredAngleSpec]):
    """Intersection angles from measured passes, with the content of the camera's file."""


class MeasuredJitterSetup(MeasuredPassesSetup[measurements.MeasuredJitterSpec]):
    """Search for jitter in a measured pass, with the content of the camera's file."""

    def checked(self) -> Self:
        """Check that the camera has two or more of the lines in the file; return the set-up."""
        _require_several(self.test, self.test.lines, self.camera)
        return self


class MeasuredAdjustSetup(MeasuredPassesSetup[MeasuredAdjustSpec]):
    """Bundle adjustment of a block of measured passes, with the content of the camera's file."""

    @classmethod
    def measured_by(cls, keys: Mapping[str, Any]) -> bool:
        """Return whether a file with these keys is a block of measured passes.

        A simulated block also has a mapping of passes.
        """
        return "data" in keys or "conventions" in keys

    def checked(self) -> Self:
        """Check that all passes, lines and sensors in the test exist; return the set-up."""
        test, passes = self.test, self.data.passes
        _require_known("pass", test, ("trackers",), test.trackers, passes)
        _require_known("line", test, ("changes",), test.changes, self.camera.lines)
        readings = {} if test.monitor is None else test.monitor.readings
        _require_known("pass", test, ("monitor", "readings"), readings, passes)
        for name, lines in readings.items():
            _require_known("line", test, ("monitor", "readings", name), lines, test.changes)
        _require_sensors(test)
        return self


class RationalSetup(ExperimentSetup[TestType], Generic[TestType]):
    """Base of tests of images with rational polynomials."""

    FOLDER = load.ORBIT

    @classmethod
    def parts(cls, test: Any) -> dict[str, Any]:
        """Make the paths of the test absolute; return field -> content."""
        return {"test": measurements.with_absolute_files(test, None, test)}

    @classmethod
    def measured_by(cls, keys: Mapping[str, Any]) -> bool:
        """Return whether a file with these keys is a test of images with rational polynomials, without a camera."""
        return "images" in keys and "camera" not in keys


class RationalAdjustSetup(RationalSetup[RationalAdjustSpec]):
    """Block adjustment of images with rational polynomials."""


class RationalMatchSetup(RationalSetup[RationalMatchSpec]):
    """Matching of tie points between images with rational polynomials."""


AnyAdjust = AdjustSetup | MeasuredAdjustSetup | RationalAdjustSetup
AnyAngle = AngleSetup | MeasuredAngleSetup
AnyCalibration = CalibrationSetup | MeasuredCalibrationSetup
AnyJitter = JitterSetup | MeasuredJitterSetup
"""Set-up of a search for jitter, in a simulated or in a measured pass."""


def _placed(test: Any) -> Any:
    """Return the test with absolute paths of its files and of its record; the URL of a database is unchanged."""
    if isinstance(test, measurements.OrbitCheckSpec | measurements.OrbitMatchSpec):
        return measurements.with_absolute_files(test)
    source = getattr(test, "monitor_record", None)
    if source is None:
        return test
    folder = Path(test.source.file).parent if test.source.file else Path()
    record = source.record if "://" in source.record else str((folder / source.record).resolve())
    plan = None if source.plan is None else str((folder / source.plan).resolve())
    return test.model_copy(update={"monitor_record": source.model_copy(update={"record": record, "plan": plan})})


DATA_FILE = "data.yaml"
"""Name of the file that describes a folder of measurements."""


def data_of(test: measurements.MeasuredTestSpec) -> measurements.OrbitDataSpec:
    """Return the passes of a test with absolute paths.

    Raises
    ------
    InputError
        The folder or a file is missing or invalid, or the conventions of an attitude table are missing.
    """
    file = Path(test.source.file)
    if test.data is None:
        sections: dict[str, Any] = {"conventions": test.conventions, "passes": test.passes}
        data = measurements.OrbitDataSpec.model_construct(**sections).with_source(test.source)
    else:
        path = file.parent / test.data
        file = path / DATA_FILE if path.is_dir() else path
        if (wrong := no_file(file)) is not None:
            allowed = f"a folder with a {DATA_FILE}, or the path of such a file"
            problem = "no such measurements" if wrong == MISSING else f"no measurements: {wrong}"
            raise test.error(problem, ("data",), value=str(path), allowed=allowed)
        data = validate(measurements.OrbitDataSpec, read_yaml(file))
    tables = any(not isinstance(item.platform, measurements.PlatformFilesSpec) for item in data.passes.values())
    for key in ("quaternion", "body_axes"):
        if tables and getattr(data.conventions, key) is None:
            problem = f"{key} is missing: a table of an attitude does not contain this convention"
            raise data.error(problem, ("conventions",), allowed=f"`{key}:`")
    return measurements.with_absolute_files(data, file.parent, data)


def without_sensors(setup: AnyAdjust, names: Sequence[str]) -> AnyAdjust:
    """Return a block whose adjustment excludes further sensors.

    Parameters
    ----------
    setup : AnyAdjust
        The block.
    names : Sequence[str]
        Names of the sensors.

    Raises
    ------
    InputError
        The block has no such sensor.
    """
    if not names:
        return setup
    excluded = tuple(dict.fromkeys((*setup.test.without, *names)))
    test = setup.test.model_copy(update={"without": excluded})
    _require_sensors(test)
    return setup.model_copy(update={"test": test})


def _require_known(what: str, test: Spec, key: KeyPath, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise `InputError` at the first unknown name below a key."""
    for name in names:
        if name not in known:
            raise test.error(unknown(f"no such {what}", name, known), (*key, name))


def _require_sensors(test: OrbitAdjustSpec | MeasuredAdjustSpec | RationalAdjustSpec) -> None:
    """Raise `InputError` for an excluded sensor that the block does not have."""
    for name in test.without:
        if name not in test.sensors:
            raise test.error(unknown("the block has no such sensor", name, test.sensors), ("without",))


def _require_rotations(test: OrbitAngleSpec, lines: tuple[str, ...]) -> None:
    """Raise `InputError` unless every change rotates one of a payload's lines.

    For an instrument, the actions of its nodes are checked when it is built.
    """
    _require_known("line", test, ("perturb",), test.perturb, lines)
    for name, change in test.perturb.items():
        for action in change.needs():
            if action != "rotate":
                problem, key = f"a payload's line does not allow {action}", ("perturb", name, action)
                allowed = "a rotation, or an instrument of traced cameras instead of a payload"
                raise test.error(problem, key, allowed=allowed)
        if change.pivot != DEFAULT_PIVOT:
            problem = "a payload's line has no pivots"
            raise test.error(problem, ("perturb", name, "pivot"), value=change.pivot, allowed="no pivot")


def _require_mechanisms(setup: MonitorSetup, loop: MechanismsSpec) -> None:
    """Raise `InputError` unless there are disturbances and all mechanisms act on the pair."""
    test = setup.test
    if setup.disturbances is None:
        problem = "there are no disturbances, so that spots say nothing of what to correct"
        raise test.error(problem, ("disturbances",), allowed="the name of a file in scenes/library/disturbances")
    for name, correction in loop.corrections.items():
        if correction.camera not in setup.pair:
            unknown_camera = unknown("no camera of the pair", correction.camera, setup.pair)
            raise test.error(unknown_camera, ("mechanisms", "corrections", name, "camera"))


def _require_pair(test: OrbitMonitorSpec, instrument: InstrumentSpec, cameras: Paths[CameraSpec]) -> None:
    """Raise `InputError` unless the pair has monitors and two look angles, and the points lie on the second line."""
    names = tuple(instrument.cameras)
    for name in names:
        mounted = instrument.cameras[name].camera
        if mounted not in cameras:
            raise test.error(f"camera {mounted!r} of the instrument is missing", ("instrument",))
    if test.cameras is None and len(names) != 2:
        value = f"{names_text(names)} in {instrument.name}"
        allowed = "two cameras for a stereo pair; of more than two, name them as cameras: [first, second]"
        raise test.error("the instrument is not a stereo pair", ("instrument",), value=value, allowed=allowed)
    pair = test.cameras or names
    for name in pair:
        if name not in names:
            allowed = f"{names_text(names)}, which have monitors in {instrument.name}"
            raise test.error(unknown("no camera with a monitor", name, names, allowed=allowed), ("cameras",))
    looks = [instrument.cameras[name].look for name in pair]
    if abs(looks[0] - looks[1]) < _LEAST_ANGLE:
        value = " and ".join(format_quantity(look, ANGLE) for look in looks)
        raise test.error("equal look angles of the cameras", ("cameras",), value=value, allowed="1 deg apart or more")
    pixels = cameras[instrument.cameras[pair[1]].camera].line.pixels
    _require_ends(test, "ground", (test.ground.first, test.ground.last), pixels, f"the line of {pair[1]}")


_LEAST_ANGLE = 0.0174
"""Smallest angle between the cameras of a stereo pair, in radians (1 deg)."""


def _require_several(test: Spec, named: tuple[str, ...] | None, camera: ThreeLineCameraSpec) -> None:
    """Raise `InputError` unless all lines exist and there are two or more."""
    names = tuple(camera.lines)
    for k, name in enumerate(named or ()):
        if name not in names:
            allowed = f"{names_text(names)}, the lines of {camera.name}"
            raise test.error(unknown("no such line", name, names, allowed=allowed), ("lines", k))
    if len(named or names) < 2:
        value = f"{names_text(names)} in {camera.name}"
        raise test.error("a search for jitter needs two lines", ("camera",), value=value, allowed="a camera with two")


_THREE_LINES = "a camera with lines forward, nadir and backward"


def _require_movable(test: Spec, changes: Iterable[str], camera: ThreeLineCameraSpec) -> None:
    """Raise `InputError` for a change of the interior orientation of a line that is defined by look angles."""
    for name in changes:
        if name in camera.lines and camera.lines[name].by_look_angles:
            problem = f"{name} of {camera.name} is defined by look angles, which have no lens that could change"
            raise test.error(problem, ("perturb", name), allowed="a line with `shift` and `rotate` of its CCDs")


def _require_images_of(test: Spec, lines: Iterable[str], camera: ThreeLineCameraSpec) -> None:
    """Raise `InputError` unless the camera defines the image formation of each line."""
    for name in lines:
        if camera.image_of(name) is None:
            problem = f"{camera.name} does not describe the image formation of its line {name}"
            raise test.error(problem, ("camera",), value=camera.name, allowed="a payload with a section `image`")


def _require_detectors(
    setup: Spec, lines: Iterable[str], camera: ThreeLineCameraSpec, detectors: Mapping[str, DetectorSpec]
) -> None:
    """Raise `InputError` unless the data sheets of all these lines are present."""
    for name in lines:
        image = camera.image_of(name)
        if image is not None:
            image_key = ("lines", name, "image") if camera.lines[name].image is not None else ("image",)
            require_detector(setup, ("camera", *image_key, "detector"), image.detector, detectors)


def _require_ends(test: Spec, section: str, ends: tuple[float, float], pixels: int, line: str) -> None:
    """Raise `InputError` unless ``first`` and ``last`` of a section lie on a line with this number of pixels."""
    for key, pixel in zip(("first", "last"), ends, strict=True):
        _require_pixel(test, (section, key), pixel, pixels, line)


def _require_pixel(test: Spec, key: KeyPath, pixel: float, pixels: int, line: str) -> None:
    """Raise `InputError` unless a position lies on a line with this number of pixels.

    ``line`` is the line's name in messages.
    """
    last = pixels - 0.5
    if not -0.5 <= pixel <= last:
        allowed = f"-0.5 to {last:g}, the ends of {line}"
        raise test.error("outside the line", key, value=f"pixel {pixel:g}", allowed=allowed)
