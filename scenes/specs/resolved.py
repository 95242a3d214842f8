"""A job, or a test, together with everything it refers to, so that one file says all that went into a run."""

from pathlib import Path
from typing import Annotated, Generic, Self, TypeVar, cast

from pydantic import Field

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.camera import CameraSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.instrument import ErrorBudgetSpec, InstrumentSpec
from scenes.specs.job import JobSpec, TargetsSpec, with_tables
from scenes.specs.load import (
    find_disturbances,
    instrument_path,
    load_band_detectors,
    load_camera,
    load_detector,
    load_disturbances,
    load_instrument,
    load_job,
    path_of_detector,
    paths_of_cameras,
)
from scenes.yaml.spec import Paths, Source, Spec
from scenes.yaml.translate import validate
from scenes.yaml.yaml_file import dump_yaml, read_yaml

TestType = TypeVar("TestType", bound=Spec)
SetupType = TypeVar("SetupType", bound="ExperimentSetup")
PANCHROMATIC = "P"
"""Name of a camera's panchromatic band."""


class ResolvedJob(Spec):
    """A job with its instrument, cameras and detector.

    Attributes:
        job: as the user wrote it, defaults filled in.
        instrument: what `job.instrument` names.
        cameras: what `instrument.cameras.<name>.camera` says -> prescription.
        detector: data sheet of the monitor's area CCDs.
        line_detectors: as cameras -> data sheet of the line CCD on which targets are imaged, None without targets.
        disturbances: on which the sigmas rest, the job's changes made; None for the noise alone.
    """

    job: JobSpec
    instrument: InstrumentSpec
    cameras: Annotated[Paths[CameraSpec], Field(min_length=1)]
    detector: DetectorSpec
    line_detectors: Paths[DetectorSpec] | None = None
    disturbances: DisturbancesSpec | None = None

    @property
    def frames(self) -> int:
        """Number of frames: the job's if it gives one, else the instrument's."""
        return self.job.render.frames or self.instrument.monitor.frames

    @property
    def targets(self) -> TargetsSpec:
        """How test targets are recorded, with the number of frames filled in."""
        targets = self.job.render.targets or TargetsSpec()
        return targets if targets.frames else targets.model_copy(update={"frames": self.frames})

    def with_render(self, frames: int, seed: int) -> "ResolvedJob":
        """The same with this number of frames and this seed, for values that a command overrides."""
        render = self.job.render.model_copy(update={"frames": frames, "seed": seed})
        return self.model_copy(update={"job": self.job.model_copy(update={"render": render})})

    def to_yaml(self) -> str:
        """The text of a config.yaml; `resolve` reads it back to exactly the same values."""
        return dump_yaml(self.plain())


def resolve(path: str | Path) -> ResolvedJob:
    """Read a job and all it refers to. The config.yaml of an earlier run can be given in place of a job.

    Raises:
        InputError: any of the files cannot be read or is not valid.
    """
    yaml = read_yaml(path)
    if isinstance(yaml.data, dict) and "job" in yaml.data:
        return _complete(validate(ResolvedJob, yaml))
    return resolve_job(load_job(path))


def resolve_job(job: JobSpec) -> ResolvedJob:
    """A job with all it refers to. Raises InputError as `resolve`."""
    return _with_instrument(job, load_instrument(instrument_path(job)))


def _with_instrument(job: JobSpec, instrument: InstrumentSpec) -> ResolvedJob:
    files = paths_of_cameras(instrument)
    cameras = {mounted.camera: load_camera(files[name]) for name, mounted in instrument.cameras.items()}
    detector = load_detector(path_of_detector(instrument))
    line_detectors = None
    if job.render.target_images:
        line_detectors = FrozenMap({name: _line_detector(camera) for name, camera in cameras.items()})
    # Built from checked parts: validating again would ask for quantities as text.
    return ResolvedJob.model_construct(
        job=job,
        instrument=instrument,
        cameras=FrozenMap(cameras),
        detector=detector,
        line_detectors=line_detectors,
        disturbances=find_disturbances(job, instrument),
    )


def resolve_budget(budget: ErrorBudgetSpec) -> ResolvedJob:
    """The nominal job on an error budget's instrument, with what the budget states to change.

    Raises:
        InputError: as `resolve`; or the budget names no disturbances.
    """
    named = {"file": budget.disturbances}
    job = JobSpec.model_validate({"instrument": budget.instrument, "disturbances": named}).with_source(budget.source)
    resolved = resolve_job(cast(JobSpec, job))
    if resolved.disturbances is None:
        text = "an error budget is one of disturbances"
        raise budget.error(text, ("disturbances",), found=budget.disturbances, allowed="the name of a file of them")
    return resolved


def resolve_with(file: str | Path, disturbances: str | None = None) -> ResolvedJob:
    """A job, or an instrument to which nothing happens, with all it refers to.

    Args:
        file: of a job or an instrument, the config.yaml of a run, or the name of an instrument in the library.
        disturbances: name in the library or path of a disturbances file, in place of what is stated; None for that.

    Raises:
        InputError: as `resolve`; there is no such instrument or no such disturbances file.
    """
    text = str(file)
    named = "/" not in text and not text.endswith((".yaml", ".yml")) and not Path(text).is_file()
    if named or "monitor" in _keys(file):
        instrument = load_instrument(text if named else Path(text))
        job = JobSpec.model_validate({"instrument": text})
        resolved = _with_instrument(job, instrument)
    else:
        resolved = resolve(file)
    if disturbances is None:
        return resolved
    return resolved.model_copy(update={"disturbances": load_disturbances(disturbances)})


def _keys(file: str | Path) -> tuple[str, ...]:
    """What a file says something of, at its top."""
    data = read_yaml(file).data
    return tuple(data) if isinstance(data, dict) else ()


def target_band(camera: CameraSpec) -> str:
    """The band on whose line CCD a camera images test targets: P (panchromatic) if it has one, else its first.

    Raises:
        InputError: it has none.
    """
    if not camera.bands:
        raise camera.error("images of targets need a line CCD, and this camera describes none", ("bands",))
    return PANCHROMATIC if PANCHROMATIC in camera.bands else next(iter(camera.bands))


def _line_detector(camera: CameraSpec) -> DetectorSpec:
    """Data sheet of the line CCD that images the targets."""
    return load_band_detectors(camera)[camera.bands[target_band(camera)].detector]


def _complete(resolved: ResolvedJob) -> ResolvedJob:
    """Check that every camera of the instrument is there, and let the job know where it was read."""
    for mounted in resolved.instrument.cameras.values():
        if mounted.camera not in resolved.cameras:
            raise resolved.error(f"camera {mounted.camera!r} of the instrument is missing", ("cameras",))
        if resolved.job.render.target_images and mounted.camera not in (resolved.line_detectors or {}):
            text = f"images of targets need the data sheet of the line CCD of camera {mounted.camera!r}"
            allowed = "a config.yaml of a run with targets, or the job's own file"
            raise resolved.error(text, ("line_detectors",), allowed=allowed)
    source = resolved.source
    job = cast(JobSpec, resolved.job.with_source(Source(source.file, source.lines, ("job",))))
    changed: dict[str, Spec] = {"job": with_tables(job)}
    if resolved.disturbances is not None:
        changed["disturbances"] = resolved.disturbances.with_source(
            Source(source.file, source.lines, ("disturbances",))
        )
    return resolved.model_copy(update=changed)


class ExperimentSetup(Spec, Generic[TestType]):
    """A test together with all it refers to, so that one file says all that went into a run.

    Attributes:
        test: what the test's file says.
    """

    test: TestType

    def with_seed(self, seed: int) -> Self:
        """The same with another seed, for one that a command overrides."""
        return self.model_copy(update={"test": self.test.model_copy(update={"seed": seed})})

    def to_yaml(self) -> str:
        """Text of a config.yaml, which ``read_setup`` reads back to the same values."""
        return dump_yaml(self.plain())


def read_setup(model: type[SetupType], path: str | Path) -> SetupType | None:
    """The setup that a run's config.yaml holds; None for the file, or the name in the library, of a test alone.

    Raises:
        InputError: the file cannot be read, or is a config.yaml that is not valid.
    """
    if not (isinstance(path, Path) or "/" in str(path) or str(path).endswith((".yaml", ".yml"))):
        return None
    yaml = read_yaml(path)
    if not (isinstance(yaml.data, dict) and "test" in yaml.data):
        return None
    setup = validate(model, yaml)
    # the test knows where it was read, so that what is found wrong later is told by its line
    test = setup.test.with_source(Source(setup.source.file, setup.source.lines, ("test",)))
    return setup.model_copy(update={"test": test})
