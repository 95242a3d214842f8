"""Jobs, laboratory tests and cameras together with the content of all their references."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar, cast

from pydantic import Field

from optics.numerics.number_tree import FrozenMap
from scenes.specs import load
from scenes.specs.camera import PANCHROMATIC, CameraSpec
from scenes.specs.camera_tests import (
    DistortionTestSpec,
    FocusTestSpec,
    MeasuredDistortionSpec,
    MeasuredFocusSpec,
    MeasuredTurntableSpec,
    TurntableFiles,
    TurntableTestSpec,
)
from scenes.specs.detector import DetectorSpec, require_detector
from scenes.specs.disturbances import DisturbancesSpec, ErrorBudgetSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.job import JobSpec, PerturbationSpec, TargetsSpec, with_tables
from scenes.specs.perturbation import IN_WORDS
from scenes.yaml.errors import InputError, Issue, unknown
from scenes.yaml.input_file import is_file
from scenes.yaml.spec import Flag, Name, Paths, Spec, validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml, read_yaml

TestType = TypeVar("TestType", bound=Spec)


class ResolvedJob(Spec):
    """Job with the content of all files to which it refers: instrument, cameras, detectors, disturbances.

    Attributes
    ----------
    job : JobSpec
        The job with its defaults.
    instrument : InstrumentSpec
        Instrument to which `job.instrument` refers.
    cameras : Mapping[str, CameraSpec]
        Reference in `instrument.cameras.<name>.camera` -> prescription.
    detector : DetectorSpec | None
        Data sheet of the monitor's area CCDs; None without a monitor.
    line_detectors : Mapping[str, DetectorSpec] | None
        Reference of a camera -> data sheet of the line CCD that images targets; None without targets.
    disturbances : DisturbancesSpec | None
        Disturbances on which the sigmas are based, with the job's changes; None for the noise alone.
    """

    job: JobSpec
    instrument: InstrumentSpec
    cameras: Annotated[Paths[CameraSpec], Field(min_length=1)]
    detector: DetectorSpec | None = None
    line_detectors: Paths[DetectorSpec] | None = None
    disturbances: DisturbancesSpec | None = None

    @property
    def frames(self) -> int:
        """Number of frames of an exposure: that of the job, else that of the monitor, else one."""
        monitor = self.instrument.monitor
        return self.job.render.frames or (1 if monitor is None else monitor.frames)

    @property
    def area_detector(self) -> DetectorSpec:
        """Data sheet of the monitor's area CCDs. Raises InputError if the instrument has no monitor."""
        self.instrument.autocollimator  # noqa: B018 - raises if there is none
        assert self.detector is not None
        return self.detector

    @property
    def quality(self) -> bool:
        """True if image quality is computed: if the job asks for it, and always without a monitor."""
        return self.job.render.quality or self.instrument.monitor is None

    @property
    def targets(self) -> TargetsSpec:
        """Orientation and exposure of test targets, with the number of frames filled in."""
        targets = self.job.render.targets or TargetsSpec()
        return targets if targets.frames else targets.model_copy(update={"frames": self.frames})

    @property
    def seed(self) -> int:
        """Seed of the random numbers of all noise."""
        return self.job.render.seed

    def with_seed(self, seed: int) -> ResolvedJob:
        """Return the job with another seed and an explicit number of frames."""
        return self.with_render(self.frames, seed)

    def with_job(self, job: JobSpec) -> ResolvedJob:
        """Return a job on the same instrument, with the content of its files, for another job specification."""
        return self.model_copy(update={"job": job})

    def with_render(self, frames: int, seed: int) -> ResolvedJob:
        """Return the job with another number of frames and another seed, for values that a command overrides."""
        render = self.job.render.model_copy(update={"frames": frames, "seed": seed})
        return self.model_copy(update={"job": self.job.model_copy(update={"render": render})})

    def instrument_file(self) -> dict[str, Any]:
        """Return the content of a self-contained instrument file, without references and disturbances."""
        plain = self.plain()
        instrument: dict[str, Any] = plain["instrument"]
        instrument.pop("disturbances", None)
        for mounted in instrument["cameras"].values():
            mounted["camera"] = plain["cameras"][mounted["camera"]]
        if "detector" in plain:
            instrument["monitor"]["area_ccd"]["detector"] = plain["detector"]
        return instrument

    def to_yaml(self) -> str:
        """Return the text of a config.yaml; `resolve` reads it back to exactly the same values."""
        return dump_yaml(self.plain())


def resolve(path: str | Path) -> ResolvedJob:
    """Read a job and all files to which it refers, or the config.yaml of an earlier run.

    Raises
    ------
    InputError
        A file cannot be read or is not valid.
    """
    yaml = read_yaml(path)
    if isinstance(yaml.data, dict) and "job" in yaml.data:
        return _complete(validate(ResolvedJob, yaml))
    return resolve_job(load.load_job(path))


def resolve_job(job: JobSpec) -> ResolvedJob:
    """Return a job with the content of all files to which it refers.

    Raises
    ------
    InputError
        A file cannot be read or is not valid.
    """
    return _with_instrument(job, load.load_instrument(job.instrument, job, ("instrument",)))


def _with_instrument(job: JobSpec, instrument: InstrumentSpec) -> ResolvedJob:
    detector = None
    if instrument.monitor is not None:
        detector = load.load_detector(instrument.monitor.area_ccd.detector, instrument, load.AREA_CCD)
    cameras = load.load_cameras(instrument)
    line_detectors = None
    if job.render.target_images:
        line_detectors = FrozenMap({name: line_detector(camera) for name, camera in cameras.items()})
    # The parts are already validated; validating again would require quantities as text.
    parts: dict[str, Any] = {"detector": detector, "line_detectors": line_detectors}
    parts["disturbances"] = load.find_disturbances(job, instrument)
    return ResolvedJob.model_construct(job=job, instrument=instrument, cameras=cameras, **parts)


def resolve_budget(budget: ErrorBudgetSpec) -> ResolvedJob:
    """Return the job of the unperturbed instrument of an error budget, with the budget's disturbances.

    Raises
    ------
    InputError
        A file cannot be read or is not valid, or the budget has no disturbances.
    """
    resolved = resolve_on(budget, budget.instrument, budget.disturbances)
    if resolved.disturbances is None:
        text = "an error budget needs disturbances"
        raise budget.error(text, ("disturbances",), value=budget.disturbances, allowed="the name of a file of them")
    return resolved


def resolve_on(owner: Spec, instrument: str, disturbances: Any = None) -> ResolvedJob:
    """Return the job of the unperturbed instrument to which another file refers.

    Parameters
    ----------
    owner : Spec
        File with the keys `instrument` and `disturbances`.
    instrument : str
        Reference to the instrument.
    disturbances : str, mapping or None
        Reference to the disturbances, as in a job; None for the instrument's.

    Raises
    ------
    InputError
        A file cannot be read or is not valid.
    """
    plain = {"instrument": instrument, "disturbances": disturbances}
    return resolve_job(JobSpec.model_validate(plain).with_source(owner.source))


def resolve_with(file: str | Path, disturbances: str | None = None) -> ResolvedJob:
    """Read a job, or an instrument as the job without perturbation, with the content of all its files.

    Parameters
    ----------
    file : str | Path
        Path of a job, an instrument or the config.yaml of a run, or name of an instrument in the library.
    disturbances : str | None
        Name in the library or path of a disturbances file that replaces those of the file; None to keep them.

    Raises
    ------
    InputError
        A file cannot be read or is not valid, or there is no such instrument or disturbances file.
    """
    text = str(file)
    named = not load.is_path(text) and not Path(text).is_file()
    data = None if named else read_yaml(file).data
    if named or load.is_instrument(data) or (isinstance(data, dict) and "mirrors" in data):
        instrument = load.load_instrument(text if named else Path(text))
        job = JobSpec.model_validate({"instrument": text})
        resolved = _with_instrument(job, instrument)
    else:
        resolved = resolve(file)
    if disturbances is None:
        return resolved
    return resolved.model_copy(update={"disturbances": load.load_disturbances(disturbances)})


def target_band(camera: CameraSpec) -> str:
    """Return the band whose line CCD images test targets: P (panchromatic) if the camera has it, else the first.

    Raises
    ------
    InputError
        The camera has no bands.
    """
    if not camera.bands:
        raise camera.error("images of targets need a line CCD, but this camera has no bands", ("bands",))
    return PANCHROMATIC if PANCHROMATIC in camera.bands else next(iter(camera.bands))


def line_detector(camera: CameraSpec) -> DetectorSpec:
    """Return the data sheet of the line CCD with which a camera images test targets.

    Parameters
    ----------
    camera : CameraSpec
        Camera with bands.

    Raises
    ------
    InputError
        The camera has no band, or there is no such data sheet.
    """
    return load.load_band_detectors(camera)[camera.bands[target_band(camera)].detector]


def _complete(resolved: ResolvedJob) -> ResolvedJob:
    """Return a job of a config.yaml with its tables read; raise `InputError` if cameras or data sheets are missing."""
    if (resolved.detector is None) != (resolved.instrument.monitor is None):
        text = "the data sheet of the monitor's area CCDs belongs to an instrument with a monitor"
        raise resolved.error(text, ("detector",), allowed="both, or neither")
    for mounted in resolved.instrument.cameras.values():
        if mounted.camera not in resolved.cameras:
            raise resolved.error(f"camera {mounted.camera!r} of the instrument is missing", ("cameras",))
        if resolved.job.render.target_images and mounted.camera not in (resolved.line_detectors or {}):
            text = f"images of targets need the data sheet of the line CCD of camera {mounted.camera!r}"
            allowed = "a config.yaml of a run with targets, or the job's own file"
            raise resolved.error(text, ("line_detectors",), allowed=allowed)
    return resolved.model_copy(update={"job": with_tables(resolved.job)})


class ExperimentSetup(Spec, Generic[TestType]):
    """Test with the content of all its files, so that one config.yaml documents all inputs of a run.

    Each kind of test is a subclass: its fields hold the content, ``parts`` reads it, and ``checked`` checks that the
    parts fit together.

    Attributes
    ----------
    test : TestType
        Content of the test's file.
    """

    FOLDER: ClassVar[str] = load.LAB
    """Folder of the library with tests of this kind."""

    test: TestType

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a test's file and all files to which it refers.

        Parameters
        ----------
        path : str | Path
            Path of the test's file or of a run's config.yaml, or name of a test in the library.

        Raises
        ------
        InputError
            A file cannot be read or is not valid, or the files do not fit together.
        """
        yaml = load.read_reference(cls.FOLDER, path)
        if isinstance(yaml.data, dict) and "test" in yaml.data:
            return validate(cls, yaml).checked()
        model = cast(type[Spec], cls.model_fields["test"].annotation)
        test = validate(model, yaml)
        return cast(Self, cls.model_construct(**{"test": test, **cls.parts(test)})).checked()

    @classmethod
    def parts(cls, test: Any) -> dict[str, Any]:
        """Read the files to which a test refers; return field of the set-up -> content.

        Raises InputError if a file cannot be read.
        """
        return {}

    def checked(self) -> Self:
        """Check that the test and the content of its files fit together; return the complete set-up.

        Raises InputError if they do not.
        """
        return self

    @classmethod
    def measured_by(cls, keys: Mapping[str, Any]) -> bool:
        """Return whether a file with these keys is a test on measurements of this kind.

        Only set-ups for measurements are asked.
        """
        return MEASURED in keys

    @property
    def seed(self) -> int:
        """Seed of all random numbers; 0 if there are none."""
        return getattr(self.test, "seed", 0)

    def with_seed(self, seed: int) -> Self:
        """Return the set-up with a seed from the command line; unchanged if the test draws no random numbers."""
        if "seed" not in type(self.test).model_fields:
            return self
        return self.with_test(seed=seed)

    def with_test(self, **values: Any) -> Self:
        """Return the set-up with other values of some keys of the test, which must already be checked."""
        return self.model_copy(update={"test": self.test.model_copy(update=values)})

    def to_yaml(self) -> str:
        """Return the text of a config.yaml, which ``read`` reads back to the same values."""
        return dump_yaml(self.plain())


MEASURED = "measured"
"""Key of a test whose data come from files instead of a simulated bench."""
DATA_FILES = ("comparisons", "held_out", "spots", "mtf", "images")
"""Keys of the section `measured` whose values are paths of files."""


class CameraTestSetup(ExperimentSetup[TestType], Generic[TestType]):
    """Laboratory test of a camera, with the content of the files of camera and detectors.

    Attributes
    ----------
    camera : CameraSpec
        Prescription and bands.
    detectors : Mapping[str, DetectorSpec]
        Reference of a band -> data sheet.
    """

    camera: CameraSpec
    detectors: Paths[DetectorSpec]

    @classmethod
    def parts(cls, test: Any) -> dict[str, Any]:
        """Read the camera with its detectors, and add the camera's deviations to the test; return field -> content."""
        test, camera = load.load_camera_under_test(test)
        return {"test": test, "camera": camera, "detectors": load.load_band_detectors(camera)}

    def checked(self) -> Self:
        """Check that the camera has line CCDs and that their data sheets are present; return the set-up."""
        if not self.camera.bands:
            text = f"the camera {self.camera.name} has no line CCDs"
            raise self.test.error(text, ("camera",), allowed="a camera with `bands:` in its file")
        for name, band in self.camera.bands.items():
            require_detector(self, ("camera", "bands", name, "detector"), band.detector, self.detectors)
        return self


class FocusSetup(CameraTestSetup[FocusTestSpec]):
    """Focal-plane alignment, with the content of the files of camera and detectors."""

    def checked(self) -> Self:
        """Check the camera, and that its bands have different offsets X', which the tilt about the line requires."""
        super().checked()
        if len({band.offset for band in self.camera.bands.values()}) < 2:
            text = (
                f"all bands of {self.camera.name} have the same X', which leaves the tilt about the line undetermined"
            )
            raise self.test.error(text, ("camera",), allowed="a camera with bands at different offsets")
        return self


class DistortionSetup(CameraTestSetup[DistortionTestSpec]):
    """Distortion test, with the content of the files of camera, detectors and turntable.

    Attributes
    ----------
    turntable : TurntableTestSpec
        Dividing error and calibration of the turntable.
    """

    turntable: TurntableTestSpec

    @classmethod
    def parts(cls, test: DistortionTestSpec) -> dict[str, Any]:
        """Read the camera with its detectors, and the turntable; return field -> content."""
        turntable = load.load_named(TurntableTestSpec, load.LAB, test.turntable, test, ("turntable",))
        return {**super().parts(test), "turntable": turntable}

    def checked(self) -> Self:
        """Check the camera, and that it has the band that is measured; return the set-up."""
        super().checked()
        if self.test.band not in self.camera.bands:
            raise self.test.error(unknown("no such band", self.test.band, self.camera.bands), ("band",))
        return self


class TurntableSetup(ExperimentSetup[TurntableTestSpec]):
    """Simulated turntable test, which refers to no other files."""


class MeasuredSetup(ExperimentSetup[TestType], Generic[TestType]):
    """Base of laboratory tests on measurements."""

    def checked(self) -> Self:
        """Return the set-up with absolute paths of the data, so that a run's config.yaml is valid from any folder."""
        folder = Path(self.test.source.file).parent.absolute()
        measured = _absolute(getattr(self.test, MEASURED), folder)
        return self.model_copy(update={"test": self.test.model_copy(update={MEASURED: measured})})


class MeasuredFocusSetup(MeasuredSetup[MeasuredFocusSpec]):
    """Focal-plane alignment from a measured through-focus series."""


class MeasuredDistortionSetup(MeasuredSetup[MeasuredDistortionSpec]):
    """Distortion test from measured angles and spot positions."""


class MeasuredTurntableSetup(MeasuredSetup[MeasuredTurntableSpec]):
    """Turntable test from measured comparisons with a reference."""


def test_keys(path: str | Path) -> Mapping[str, Any]:
    """Return the top-level mapping of a test's file, or of the test in a run's config.yaml; empty for a library name.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    data = read_yaml(path).data if load.is_path(path) else {}
    inner = data.get("test", data) if isinstance(data, dict) else {}
    return inner if isinstance(inner, dict) else {}


def _absolute(files: Spec, folder: Path) -> Spec:
    """Return a section of a test in which the paths of files are absolute."""
    changed: dict[str, Any] = {}
    for name in type(files).model_fields:
        value = getattr(files, name)
        if isinstance(value, TurntableFiles):
            changed[name] = _absolute(value, folder)
        elif name in DATA_FILES and value is not None:
            changed[name] = str(files.file_at((name,), value, folder, "a CSV file"))
    return files.model_copy(update=changed)


ALLOWED = "the file of a camera or of an instrument, or the config.yaml of a run with one"


class CameraSetup(Spec):
    """Camera, alone or as mounted in its instrument, with the content of all its files.

    Attributes
    ----------
    camera : CameraSpec
        Prescription of the camera.
    mounted : str | None
        Name of the camera in the instrument.
    instrument : InstrumentSpec | None
        Instrument that carries the camera; None for a camera alone.
    cameras : Mapping[str, CameraSpec]
        Reference in the instrument -> prescription.
    perturb : Mapping[str, PerturbationSpec]
        Perturbations of bodies of the instrument, as in a job; for a camera alone of its parts.
    refocus : bool
        True if the camera is refocused in that state, as in a job.
    """

    camera: CameraSpec
    mounted: Name | None = None
    instrument: InstrumentSpec | None = None
    cameras: Paths[CameraSpec] = Field(default_factory=FrozenMap)
    perturb: Annotated[Paths[PerturbationSpec], IN_WORDS] = Field(default_factory=FrozenMap)
    refocus: Annotated[Flag, Field(exclude_if=lambda refocus: not refocus)] = False
    seed: ClassVar[int] = 0

    def with_seed(self, seed: int) -> CameraSetup:
        """Return the camera unchanged, since it has no random numbers."""
        return self

    @property
    def mounted_instrument(self) -> tuple[InstrumentSpec, Mapping[str, CameraSpec], str]:
        """Instrument that carries the camera, prescriptions of all its cameras, and the name of this camera in it.

        A camera alone forms an instrument.
        """
        if self.instrument is not None and self.mounted is not None:
            return self.instrument, self.cameras, self.mounted
        name = self.camera.name
        return InstrumentSpec.of_camera(name, name), {name: self.camera}, name

    @property
    def job(self) -> JobSpec:
        """Job of the instrument that carries the camera, with the camera's perturbations."""
        job = JobSpec.model_construct(instrument=self.mounted_instrument[0].name, perturb=self.perturb)
        return job.with_source(self._source)

    def perturbed(self, words: Sequence[str]) -> CameraSetup:
        """Return the camera with further perturbations.

        Parameters
        ----------
        words : Sequence[str]
            Texts such as ``M2 shift z 20 um``; they replace earlier perturbations of the same node.

        Raises
        ------
        InputError
            A text is not a perturbation.
        """
        if not words:
            return self
        job = validate(
            JobSpec, YamlFile("--perturb", {"instrument": self.mounted_instrument[0].name, "perturb": [*words]}, {})
        )
        return self.model_copy(update={"perturb": FrozenMap({**self.perturb, **job.perturb})})

    @property
    def title(self) -> str:
        """Name of the camera in a report."""
        return self.camera.name if self.instrument is None else f"{self.camera.name} as {self.mounted} of {self.where}"

    @property
    def where(self) -> str:
        """Name of the instrument that carries the camera; empty for a camera alone."""
        return "" if self.instrument is None else self.instrument.name

    def to_yaml(self) -> str:
        """Return the text of a config.yaml, which ``resolve_camera`` reads back to the same values."""
        return dump_yaml({key: value for key, value in self.plain().items() if value != {}})


def resolve_camera(file: Path | str, name: str | None = None) -> CameraSetup:
    """Read a camera with the content of all files to which it refers.

    Parameters
    ----------
    file : Path | str
        Name of a camera or instrument of the library, path of such a file, of a job, or of a run's config.yaml; a job's
        perturbations are included.
    name : str | None
        Name of the camera, if there are several.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, holds no camera, or several of which ``name`` selects none.
    """
    text = str(file)
    reference: Path | str = text if not load.is_path(text) and not is_file(Path(text)) else Path(text)
    folder = load.CAMERAS if text in load.library_names(load.CAMERAS) else load.INSTRUMENTS
    yaml = load.read_reference(folder, reference, others=(load.CAMERAS,))
    data = yaml.data if isinstance(yaml.data, dict) else {}
    if "mirrors" in data:
        return _alone(load.load_camera(reference), text, name)
    if "camera" in data and {"mounted", "perturb"} & set(data) and "test" not in data:
        return validate(CameraSetup, yaml)
    if "job" in data or ("instrument" in data and "mounted" not in data and "study" not in data):
        return _of_job(resolve(file), text, name)
    if load.is_instrument(data):
        return _mounted(load.load_instrument(reference), text, name)
    return _of_run(yaml, name)


def _of_job(resolved: ResolvedJob, file: str, name: str | None) -> CameraSetup:
    """Return a camera of a job's instrument with the job's perturbations."""
    job = resolved.job
    if job.course is not None:
        problem = "a camera is analysed in one state, but this job describes a course (states over time)"
        raise job.error(problem, ("course",), allowed="a job with a single state, or python -m twin.render")
    chosen = _chosen(tuple(resolved.instrument.cameras), file, name)
    camera = resolved.cameras[resolved.instrument.cameras[chosen].camera]
    return CameraSetup.model_construct(
        camera=camera,
        mounted=chosen,
        instrument=resolved.instrument,
        cameras=resolved.cameras,
        perturb=job.perturb,
        refocus=job.refocus,
    ).with_source(job.source)


def _alone(camera: CameraSpec, file: str, name: str | None) -> CameraSetup:
    if name is not None and name != camera.name:
        raise InputError(Issue(f"--camera {name}: the file holds one camera, {camera.name}", file))
    return CameraSetup.model_construct(camera=camera, mounted=None, instrument=None, cameras=FrozenMap())


def _mounted(instrument: InstrumentSpec, file: str, name: str | None) -> CameraSetup:
    chosen, cameras = _chosen(tuple(instrument.cameras), file, name), load.load_cameras(instrument)
    camera = cameras[instrument.cameras[chosen].camera]
    return CameraSetup.model_construct(camera=camera, mounted=chosen, instrument=instrument, cameras=cameras)


def _of_run(yaml: YamlFile, name: str | None) -> CameraSetup:
    """Return a camera of a run's config.yaml; the config.yaml of a study has the camera's job below ``base``."""
    below = yaml.data if isinstance(yaml.data, dict) else {}
    if "study" in below and isinstance(below.get("base"), dict):
        yaml, below = yaml.part("base"), below["base"]
    single, several = below.get("camera"), below.get("cameras")
    if isinstance(single, dict) and "mirrors" in single:
        return _alone(validate(CameraSpec, yaml.part("camera")), yaml.file, name)
    cameras = {key: c for key, c in several.items() if isinstance(c, dict)} if isinstance(several, dict) else {}
    if cameras and all("mirrors" in camera for camera in cameras.values()):
        camera = validate(CameraSpec, yaml.part("cameras", _chosen(tuple(cameras), yaml.file, name)))
        return CameraSetup.model_construct(camera=camera, mounted=None, instrument=None, cameras=FrozenMap())
    raise InputError(Issue("this file contains no prescription of a camera", yaml.file, 1, allowed=ALLOWED))


def _chosen(names: tuple[str, ...], file: str, name: str | None) -> str:
    """Return the name of the selected camera; raise `InputError` if it is unknown or not specified among several."""
    if name is None:
        if len(names) == 1:
            return names[0]
        raise InputError(Issue("the file has several cameras", file, allowed=f"--camera {names[0]} ..."))
    if name not in names:
        raise InputError(unknown("no such camera", name, names).at(file))
    return name
