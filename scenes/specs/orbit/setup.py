"""A test in orbit together with everything it refers to, by name or by path."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from optics.numerics.number_tree import FrozenMap
from scenes.specs import load
from scenes.specs.camera import CameraSpec
from scenes.specs.course import DEFAULT_PIVOT
from scenes.specs.detector import DetectorSpec, require_detector
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.orbit.angle import LINES, OrbitAngleSpec, usual_angles
from scenes.specs.orbit.calibration import OrbitCalibrationSpec
from scenes.specs.orbit.flight import PayloadTestSpec
from scenes.specs.orbit.jitter_search import OrbitJitterSpec
from scenes.specs.orbit.monitor import MechanismsSpec, OrbitMonitorSpec
from scenes.specs.orbit.scene import LineImageSpec
from scenes.specs.orbit.simulate import OrbitSimulateSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, line_detector, read_setup, resolve_job
from scenes.yaml.errors import KeyPath, names_text, unknown
from scenes.yaml.spec import Paths, Spec
from scenes.yaml.units import ANGLE, format_quantity
from scenes.yaml.yaml_file import read_yaml


def load_three_line_camera(name_or_path: str | Path) -> ThreeLineCameraSpec:
    """Read a three-line payload; arguments and errors as `load_instrument`."""
    return load.load_named(ThreeLineCameraSpec, load.PAYLOADS, name_or_path)


def load_payload(
    test: OrbitAngleSpec | OrbitCalibrationSpec | OrbitSimulateSpec | PayloadTestSpec,
) -> ThreeLineCameraSpec:
    """The payload of a test in orbit. Raises InputError if there is none, or it is not valid."""
    return load_three_line_camera(load.find_named(load.PAYLOADS, test.camera, test, ("camera",)))


def _find_orbit_camera(test: OrbitAngleSpec) -> Path:
    """The file of the payload or instrument of a test in orbit. Raises InputError if there is none."""
    reference, file = test.camera, test.source.file
    for folder in (load.PAYLOADS, load.INSTRUMENTS):
        if load.place_of(folder, reference, Path(file).parent if file else Path()) is not None:
            return load.find_named(folder, reference, test, ("camera",))
    payloads, instruments = load.library_names(load.PAYLOADS), load.library_names(load.INSTRUMENTS)
    allowed = f"{names_text(payloads)}, an instrument ({names_text(instruments)}), or the path of a .yaml file"
    problem = "no such name in payloads or instruments"
    raise test.error(unknown(problem, reference, (*payloads, *instruments), allowed=allowed), ("camera",))


def _line_detectors(camera: ThreeLineCameraSpec) -> dict[str, DetectorSpec]:
    """Data sheets of a payload's line CCDs, by the name that the image sections give. Raises InputError as
    `load_instrument`.
    """
    sections: list[tuple[KeyPath, LineImageSpec | None]] = [(("image",), camera.image)]
    sections += [(("lines", name, "image"), line.image) for name, line in camera.lines.items()]
    return {
        image.detector: load.load_detector(load.find_named(load.DETECTORS, image.detector, camera, (*key, "detector")))
        for key, image in sections
        if image is not None
    }


class AngleSetup(ExperimentSetup[OrbitAngleSpec]):
    """An intersection-angle test with its camera: a payload, or an instrument with the cameras that it names.

    Attributes:
        camera: the payload, None for an instrument.
        instrument: the instrument, None for a payload.
        cameras: what `instrument.cameras.<name>.camera` says -> prescription; empty for a payload.
    """

    camera: ThreeLineCameraSpec | None = None
    instrument: InstrumentSpec | None = None
    cameras: Paths[CameraSpec] = Field(default_factory=FrozenMap)

    @property
    def pixels(self) -> Mapping[str, int]:
        """Line -> how many pixels it has, in the order of the file."""
        if self.instrument is not None:
            return {name: self.cameras[m.camera].line.pixels for name, m in self.instrument.cameras.items()}
        assert self.camera is not None
        return {name: self.camera.pixels_of(name) for name in self.camera.lines}

    @property
    def usual_pixels(self) -> int:
        """Number of pixels of the line in whose pixels the test gives places."""
        return self.camera.pixels if self.camera is not None else next(iter(self.pixels.values()))

    @property
    def camera_name(self) -> str:
        """Name of the payload or instrument."""
        return (self.camera or self.instrument).name  # type: ignore[union-attr]

    @property
    def angles(self) -> Mapping[str, tuple[str, str]]:
        """Angle -> its two lines; `resolve_angle` has filled in the usual ones."""
        return self.test.angles or {}


def resolve_angle(path: str | Path) -> AngleSetup:
    """Read a test and the payload or instrument it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or test and camera do not fit.
    """
    setup = read_setup(AngleSetup, path)
    if setup is None:
        test = load.load_named(OrbitAngleSpec, load.ORBIT, path)
        setup = _with_camera(test, _find_orbit_camera(test))
    if (setup.camera is None) == (setup.instrument is None):
        found = "neither" if setup.camera is None else "both"
        raise setup.error("one camera is tested", ("camera",), found=found, allowed="`camera:` or `instrument:`")
    for name, mounted in setup.instrument.cameras.items() if setup.instrument is not None else ():
        if mounted.camera not in setup.cameras:
            problem = f"camera {mounted.camera!r} of the instrument's {name} is missing"
            raise setup.error(problem, ("cameras",), allowed=f"cameras.{mounted.camera}: its prescription")
    return _checked_angles(setup)


def _with_camera(test: OrbitAngleSpec, file: Path) -> AngleSetup:
    """The test with what its camera's file holds: an instrument has cameras, a payload has lines."""
    if not load.is_instrument(read_yaml(file).data):
        return AngleSetup.model_construct(
            test=test, camera=load_three_line_camera(file), instrument=None, cameras=FrozenMap()
        )
    instrument = load.load_instrument(file)
    cameras = load.load_cameras(instrument)
    return AngleSetup.model_construct(test=test, camera=None, instrument=instrument, cameras=cameras)


def _checked_angles(setup: AngleSetup) -> AngleSetup:
    """The set-up with its angles filled in. InputError unless angles, changes and strips fit the camera's lines."""
    test, lines = setup.test, tuple(setup.pixels)
    has = f"{names_text(lines)} in {setup.camera_name}"
    if len(lines) < 2:
        raise test.error("an angle needs two lines", ("camera",), found=has, allowed="a camera with two lines or more")
    angles = test.angles or usual_angles(lines)
    if angles is None:
        problem = "which lines the angles lie between is not said"
        allowed = "`angles:` with a name and two lines for each, as alpha: [forward, nadir]"
        raise test.error(problem, ("camera",), found=has, allowed=allowed)
    for name, pair in angles.items():
        for k, line in enumerate(pair):
            if line not in lines:
                raise test.error(unknown("no such line", line, lines), ("angles", name, k))
    if setup.camera is not None:
        _require_turns(test, lines)
    ends = (test.strips.first, test.strips.last)
    _require_ends(test, "strips", ends, setup.usual_pixels, f"the lines of {setup.camera_name}")
    return setup.model_copy(update={"test": test.model_copy(update={"angles": FrozenMap(angles)})})


def _require_turns(test: OrbitAngleSpec, lines: tuple[str, ...]) -> None:
    """InputError unless every change turns one of a payload's lines. What an instrument's nodes allow is told when it
    is built.
    """
    _require_lines(test, test.perturb, lines)
    for name, change in test.perturb.items():
        for action in change.needs():
            if action != "rotate":
                allowed = "a rotation, or an instrument of traced cameras instead of a payload"
                raise test.error(
                    f"a payload's line does not allow {action}", ("perturb", name, action), allowed=allowed
                )
        if change.pivot != DEFAULT_PIVOT:
            problem = "a payload's line has no pivots"
            raise test.error(problem, ("perturb", name, "pivot"), found=change.pivot, allowed="no pivot")


class CalibrationSetup(ExperimentSetup[OrbitCalibrationSpec]):
    """An in-orbit calibration with its camera.

    Attributes:
        camera: the payload.
        detectors: data sheets of its line CCDs where images are rendered.
    """

    camera: ThreeLineCameraSpec
    detectors: Paths[DetectorSpec] = Field(default_factory=FrozenMap)


def resolve_calibration(path: str | Path) -> CalibrationSetup:
    """Read a calibration and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or test and camera do not fit.
    """
    setup = read_setup(CalibrationSetup, path)
    if setup is None:
        test = load.load_named(OrbitCalibrationSpec, load.ORBIT, path)
        camera = load_payload(test)
        detectors = FrozenMap({} if test.images is None else _line_detectors(camera))
        setup = CalibrationSetup.model_construct(test=test, camera=camera, detectors=detectors)
    _require_calibration(setup.test, setup.camera)
    if setup.test.images is not None:
        _require_detectors(setup, tuple(setup.camera.lines), setup.camera, setup.detectors)
    return setup


class MonitorSetup(ExperimentSetup[OrbitMonitorSpec]):
    """A stereo pair along its orbit, monitored, with its instrument.

    Attributes:
        instrument: cameras and monitors on their base.
        cameras: what the instrument's cameras are called -> prescription.
        detector: data sheet of the monitor's area CCDs.
        disturbances: what is stated to move, None for nothing.
        line_detectors: as cameras -> data sheet of the line CCD that images; None where no line images are rendered.
    """

    instrument: InstrumentSpec
    cameras: Paths[CameraSpec]
    detector: DetectorSpec
    disturbances: DisturbancesSpec | None = None
    line_detectors: Paths[DetectorSpec] | None = None

    @property
    def resolved(self) -> ResolvedJob:
        """The job of the monitor's images, with all that it refers to."""
        return ResolvedJob.model_construct(
            job=self.test.job,
            instrument=self.instrument,
            cameras=self.cameras,
            detector=self.detector,
            line_detectors=None,
            disturbances=self.disturbances,
        )

    @property
    def pair(self) -> tuple[str, str]:
        """The two cameras."""
        first, second = self.test.cameras or tuple(self.instrument.cameras)
        return first, second


def resolve_monitor(path: str | Path) -> MonitorSetup:
    """Read a monitored orbit and the instrument it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, test and instrument do not fit, or nothing is stated to move
            that mechanisms could act on.
    """
    setup = read_setup(MonitorSetup, path)
    if setup is None:
        test = load.load_named(OrbitMonitorSpec, load.ORBIT, path)
        parts = dict(resolve_job(test.job))
        sheets = None
        if test.mechanisms is not None and test.mechanisms.images is not None:
            sheets = FrozenMap({name: line_detector(camera) for name, camera in parts["cameras"].items()})
        parts = {key: parts[key] for key in ("instrument", "cameras", "detector", "disturbances")}
        setup = MonitorSetup.model_construct(test=test, line_detectors=sheets, **parts)
    _require_pair(setup.test, setup.instrument, setup.cameras)
    if setup.test.mechanisms is not None:
        _require_mechanisms(setup, setup.test.mechanisms)
    return setup


def _require_mechanisms(setup: MonitorSetup, loop: MechanismsSpec) -> None:
    """InputError unless something is stated to move, mechanisms act on the pair, and its images have data sheets."""
    test = setup.test
    if setup.disturbances is None:
        problem = "nothing is stated to move, so that spots say nothing of what to correct"
        raise test.error(problem, ("disturbances",), allowed="the name of a file in scenes/library/disturbances")
    if loop.images is not None:
        for name in setup.cameras:
            if name not in (setup.line_detectors or {}):
                problem = f"images need the data sheet of the line CCD of camera {name!r}"
                allowed = "line_detectors with one for each camera"
                raise test.error(problem, ("mechanisms", "images"), allowed=allowed)
    for name, correction in loop.corrections.items():
        if correction.camera not in setup.pair:
            wrong = unknown("no camera of the pair", correction.camera, setup.pair)
            raise test.error(wrong, ("mechanisms", "corrections", name, "camera"))


def _require_pair(test: OrbitMonitorSpec, instrument: InstrumentSpec, cameras: Paths[CameraSpec]) -> None:
    """InputError unless the pair has monitors and looks two ways, and the points lie on the second line."""
    names = tuple(instrument.cameras)
    for name in names:
        mounted = instrument.cameras[name].camera
        if mounted not in cameras:
            raise test.error(f"camera {mounted!r} of the instrument is missing", ("instrument",))
    if test.cameras is None and len(names) != 2:
        found = f"{names_text(names)} in {instrument.name}"
        allowed = "two cameras for a stereo pair; of more than two, name them as cameras: [first, second]"
        raise test.error("the instrument is no stereo pair", ("instrument",), found=found, allowed=allowed)
    pair = test.cameras or names
    for name in pair:
        if name not in names:
            allowed = f"{names_text(names)}, which have monitors in {instrument.name}"
            raise test.error(unknown("no camera with a monitor", name, names, allowed=allowed), ("cameras",))
    looks = [instrument.cameras[name].look for name in pair]
    if abs(looks[0] - looks[1]) < _LEAST_ANGLE:
        found = " and ".join(format_quantity(look, ANGLE) for look in looks)
        raise test.error("the cameras look the same way", ("cameras",), found=found, allowed="1 deg apart or more")
    pixels = cameras[instrument.cameras[pair[1]].camera].line.pixels
    _require_ends(test, "ground", (test.ground.first, test.ground.last), pixels, f"the line of {pair[1]}")


_LEAST_ANGLE = 0.0174
"""Radians between the cameras of a stereo pair."""


class SimulateSetup(ExperimentSetup[OrbitSimulateSpec]):
    """A pass over a patch of ground with its camera.

    Attributes:
        camera: the payload.
        detectors: data sheets of its line CCDs, by the name that the image sections give.
    """

    camera: ThreeLineCameraSpec
    detectors: Paths[DetectorSpec]


def resolve_simulate(path: str | Path) -> SimulateSetup:
    """Read a pass and the camera and detectors it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or test and camera do not fit.
    """
    setup = read_setup(SimulateSetup, path)
    if setup is None:
        test = load.load_named(OrbitSimulateSpec, load.ORBIT, path)
        camera = load_payload(test)
        detectors = FrozenMap(_line_detectors(camera))
        setup = SimulateSetup.model_construct(test=test, camera=camera, detectors=detectors)
    _require_images(setup.test, setup.camera)
    _require_detectors(setup, setup.test.lines, setup.camera, setup.detectors)
    return setup


class JitterSetup(ExperimentSetup[OrbitJitterSpec]):
    """A pass whose jitter is sought, with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec


def resolve_jitter(path: str | Path) -> JitterSetup:
    """Read a simulated search for jitter and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    setup = read_setup(JitterSetup, path)
    if setup is None:
        test = load.load_named(OrbitJitterSpec, load.ORBIT, path)
        setup = JitterSetup.model_construct(test=test, camera=load_payload(test))
    require_lines(setup.test, setup.test.lines, setup.camera)
    for name in setup.test.points.line_noise:
        if name not in setup.camera.lines:
            raise setup.test.error(unknown("no such line", name, setup.camera.lines), ("points", "line_noise", name))
    return setup


def require_lines(test: Spec, named: tuple[str, ...] | None, camera: ThreeLineCameraSpec) -> None:
    """InputError unless all lines that are named exist, and there are two or more."""
    names = tuple(camera.lines)
    for k, name in enumerate(named or ()):
        if name not in names:
            allowed = f"{names_text(names)}, the lines of {camera.name}"
            raise test.error(unknown("no such line", name, names, allowed=allowed), ("lines", k))
    if len(named or names) < 2:
        found = f"{names_text(names)} in {camera.name}"
        raise test.error("jitter is seen by two lines or more", ("camera",), found=found, allowed="a camera of several")


def _require_images(test: OrbitSimulateSpec, camera: ThreeLineCameraSpec) -> None:
    """InputError unless all lines that are named exist and can be rendered, and the patch lies on one of them."""
    names = tuple(camera.lines)
    named = [(("patch", "line"), test.patch.line), *((("perturb", name), name) for name in test.perturb)]
    for key, name in [*((("lines",), name) for name in test.lines), *named]:
        if name not in names:
            allowed = f"{names_text(names)}, the lines of {camera.name}"
            raise test.error(unknown("no such line", name, names, allowed=allowed), key)
    _require_places(test, test.perturb, camera)
    _require_images_of(test, test.lines, camera)
    line, pixels = f"the line {test.patch.line} of {camera.name}", camera.pixels_of(test.patch.line)
    _require_pixel(test, ("patch", "pixel"), test.patch.pixel, pixels, line)
    if wrong := test.orbit.misses(test.patch.time):
        raise test.error(wrong, ("patch", "time"))


def _require_calibration(test: OrbitCalibrationSpec, camera: ThreeLineCameraSpec) -> None:
    """InputError unless the camera has the three lines, and points and changes lie on them."""
    if missing := [name for name in LINES if name not in camera.lines]:
        found = f"{names_text(tuple(camera.lines))} in {camera.name}"
        problem = f"the camera has no {' and no '.join(missing)} line"
        raise test.error(problem, ("camera",), found=found, allowed=_THREE_LINES)
    _require_lines(test, test.perturb, LINES)
    _require_lines(test, test.drift, LINES, "drift")
    _require_places(test, (*test.perturb, *test.drift), camera)
    if "nadir" in test.perturb and any(test.perturb["nadir"].principal_point):
        raise test.error(
            "the nadir line's principal point is the gauge",
            ("perturb", "nadir", "principal_point"),
            allowed="no change; turn the whole camera instead, by errors.star_tracker.bias",
        )
    fewest = min(camera.pixels_of(name) for name in LINES)
    if test.points is not None:
        _require_ends(test, "points", (test.points.first, test.points.last), fewest, f"the lines of {camera.name}")
    if test.images is None:
        return
    _require_images_of(test, LINES, camera)
    for k, place in enumerate(test.images.patches):
        key, pixels = ("images", "patches", k, "pixel"), camera.pixels_of("nadir")
        _require_pixel(test, key, place.pixel, pixels, f"the nadir line of {camera.name}")


_THREE_LINES = "a camera with lines forward, nadir and backward"


def _require_places(test: Spec, changes: Iterable[str], camera: ThreeLineCameraSpec) -> None:
    """InputError for a change of a line that is known by looks and not by places."""
    for name in changes:
        if name in camera.lines and camera.lines[name].by_look_angles:
            problem = f"{name} of {camera.name} is known by look angles, which say nothing of a changed lens"
            raise test.error(problem, ("perturb", name), allowed="a line with `shift` and `rotate` of its CCDs")


def _require_lines(test: Spec, changes: Iterable[str], lines: tuple[str, ...], key: str = "perturb") -> None:
    """InputError unless every change is one of a line."""
    for name in changes:
        if name not in lines:
            raise test.error(unknown("no such line", name, lines), (key, name))


def _require_images_of(test: Spec, lines: Iterable[str], camera: ThreeLineCameraSpec) -> None:
    """InputError unless the camera says of each line how it forms its image."""
    for name in lines:
        if camera.image_of(name) is None:
            problem = f"{camera.name} does not say how its line {name} forms an image"
            raise test.error(problem, ("camera",), found=camera.name, allowed="a payload with a section `image`")


def _require_detectors(
    setup: Spec, lines: Iterable[str], camera: ThreeLineCameraSpec, detectors: Mapping[str, DetectorSpec]
) -> None:
    """InputError unless the data sheets of all these lines are there."""
    for name in lines:
        image = camera.image_of(name)
        if image is not None:
            own = ("lines", name, "image") if camera.lines[name].image is not None else ("image",)
            require_detector(setup, ("camera", *own, "detector"), image.detector, detectors)


def _require_ends(test: Spec, section: str, ends: tuple[float, float], pixels: int, line: str) -> None:
    """InputError unless ``first`` and ``last`` of a section lie on a line of so many pixels."""
    for key, pixel in zip(("first", "last"), ends, strict=True):
        _require_pixel(test, (section, key), pixel, pixels, line)


def _require_pixel(test: Spec, key: KeyPath, pixel: float, pixels: int, line: str) -> None:
    """InputError unless a place lies on a line of so many pixels, which is told as the text says."""
    last = pixels - 0.5
    if not -0.5 <= pixel <= last:
        allowed = f"-0.5 to {last:g}, the ends of {line}"
        raise test.error("outside the line", key, found=f"pixel {pixel:g}", allowed=allowed)
