"""Specifications from files: from the library that comes with the twin, by name, or from a user's own files, by path.

The library's folders are cameras, instruments, detectors, payloads, disturbances and budgets in scenes/library,
scenes/lab (experiments on the ground) and scenes/orbit (in flight); a file's name without .yaml is its name there.
"""

from pathlib import Path
from typing import Any, TypeVar

from optics.numerics.number_tree import FrozenMap
from scenes.specs.as_built import DESIGN, AsBuiltInstrumentSpec
from scenes.specs.autocollimators import AutocollimatorSetup, AutocollimatorTestSpec
from scenes.specs.camera import CameraDesignSpec, CameraSpec, MonitorDesignSpec
from scenes.specs.camera_tests import CameraUnderTestSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.disturbances import NONE, DisturbancesSpec, ErrorBudgetSpec
from scenes.specs.instrument import BASE, InstrumentSpec
from scenes.specs.job import JobSpec, with_tables
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown, unknown
from scenes.yaml.input_file import is_file, unusable
from scenes.yaml.spec import Source, Spec, validate
from scenes.yaml.yaml_file import YamlFile, read_yaml

SpecType = TypeVar("SpecType", bound=Spec)
TestType = TypeVar("TestType", bound=CameraUnderTestSpec)

SCENES = Path(__file__).resolve().parent.parent
LIBRARY = SCENES / "library"
EXAMPLES = SCENES / "examples"
CAMERAS, INSTRUMENTS, DETECTORS = "cameras", "instruments", "detectors"
LAB, BUDGETS, ORBIT, PAYLOADS, DISTURBANCES = "lab", "budgets", "orbit", "payloads", "disturbances"


def _folder(name: str) -> Path:
    """Where the files of one kind stand."""
    return (SCENES if name in (LAB, ORBIT, "examples") else LIBRARY) / name


def library_names(folder: str) -> tuple[str, ...]:
    """The names in one folder of the library ("cameras", "instruments" or "detectors"), sorted."""
    return tuple(sorted(path.stem for path in _folder(folder).glob("*.yaml")))


def load_job(path: str | Path) -> JobSpec:
    """Read a job. The instrument it names is looked for, not read.

    Raises:
        InputError: the file cannot be read or is not a valid job, or there is no such instrument; one issue for each
            fault.
    """
    job = with_tables(validate(JobSpec, read_yaml(path)))
    instrument_path(job)
    return job


def instrument_path(job: JobSpec) -> Path:
    """The file of the job's instrument.

    Raises:
        InputError: there is none, said with the line of the job's file.
    """
    return find_named(_folder_of_instrument(job.instrument), job.instrument, job, ("instrument",), (CAMERAS,))


def _folder_of_instrument(reference: str | Path) -> str:
    """Where the library has what a reference calls an instrument: a camera alone is one, too."""
    alone = place_of(INSTRUMENTS, reference, Path()) is None and str(reference) in library_names(CAMERAS)
    return CAMERAS if alone else INSTRUMENTS


def load_error_budget(name_or_path: str | Path) -> ErrorBudgetSpec:
    """Read an error budget; arguments and errors as `load_instrument`."""
    return load_named(ErrorBudgetSpec, BUDGETS, name_or_path)


def load_instrument(name_or_path: str | Path) -> InstrumentSpec:
    """Read an instrument. The cameras and the detector it names are looked for, not read. Of one as built the design
    is read as well, to which its errors and its paths belong.

    Args:
        name_or_path: a name in the library, or a path from the current folder (anything with a slash or ending in
            .yaml or .yml). Of a camera it is the instrument that consists of this camera alone.

    Raises:
        InputError: as `load_job`.
    """
    path, text = _read_named(_folder_of_instrument(name_or_path), name_or_path, (CAMERAS,))
    if isinstance(text.data, dict) and "mirrors" in text.data:
        camera = validate(CameraSpec, text)
        own = path.stem if path.parent == _folder(CAMERAS) else path.name
        return InstrumentSpec.of_camera(camera.name, own).with_source(Source(str(path)))
    if isinstance(text.data, dict) and DESIGN in text.data:
        return _as_built(validate(AsBuiltInstrumentSpec, text))
    instrument = validate(InstrumentSpec, text)
    paths_of_cameras(instrument)
    if instrument.monitor is not None:
        path_of_detector(instrument)
    return instrument


def _as_built(spec: AsBuiltInstrumentSpec) -> InstrumentSpec:
    """The instrument that was built to the design of a file."""
    path = find_named(_folder_of_instrument(spec.design), spec.design, spec, (DESIGN,), (CAMERAS,))
    data = read_yaml(path).data
    if isinstance(data, dict) and DESIGN in data:
        problem, its = "this design is itself an instrument as built", shown(data[DESIGN])
        allowed = f"the drawing that it names, {its}, and all that departs from it below as_built"
        raise spec.error(problem, (DESIGN,), found=spec.design, allowed=allowed)
    stated = spec.disturbances
    if stated is not None and stated != NONE:
        found = find_named(DISTURBANCES, stated, spec, ("disturbances",))
        stated = str(found.absolute()) if is_path(stated) else stated
    return spec.made_of(load_instrument(path), stated)


def is_instrument(data: Any) -> bool:
    """Whether plain data of a file are an instrument's, as drawn or as built."""
    return isinstance(data, dict) and bool({"cameras", DESIGN} & set(data)) and not _OTHERS & set(data)


_OTHERS = {"job", "study", "test", "detector", "camera"}
"""Keys of a run's config.yaml, and no instrument's."""


def load_disturbances(name_or_path: str | Path) -> DisturbancesSpec:
    """Read a disturbances file; arguments and errors as `load_instrument`."""
    return load_named(DisturbancesSpec, DISTURBANCES, name_or_path).with_tables()


def find_disturbances(job: JobSpec, instrument: InstrumentSpec) -> DisturbancesSpec | None:
    """What is stated for a job: its own file or its instrument's, with the job's changes; None for nothing.

    Raises:
        InputError: there is no such file or it is not valid, or a change of what it does not have.
    """
    asked = job.disturbances
    owner: Spec = job
    reference = None if asked is None else asked.file
    key: KeyPath = ("disturbances", "file")
    if reference is None:
        owner, reference, key = instrument, instrument.disturbances, ("disturbances",)
    if reference is None or reference == NONE:
        if asked is not None and (asked.causes or asked.without):
            text = "there is no disturbances file that could be changed"
            raise job.error(text, ("disturbances",), allowed="the name of one as file")
        return None
    stated = load_disturbances(find_named(DISTURBANCES, reference, owner, key))
    return stated if asked is None else stated.changed(asked)


def read_design(design: MonitorDesignSpec) -> dict[str, Any]:
    """What a search for a layout refers to: the instrument to start from, its cameras by the name that it gives them,
    detector (its area CCD), disturbances by their names in the design, and detectors, data sheets of the area CCDs that
    it may choose.

    Raises:
        InputError: a file is not there or not valid, or nothing is stated to move.
    """
    start = load_instrument(find_named(INSTRUMENTS, design.instrument, design, ("instrument",)))
    if start.as_built:
        problem = f"{start.name} is an instrument as built, and a layout is drawn"
        raise design.error(problem, ("instrument",), allowed="the drawing that its file names as its design")
    owner: Spec = design
    references = design.disturbances
    if references is None:
        owner, references = start, () if start.disturbances in (None, NONE) else (str(start.disturbances),)
    if not references:
        problem = f"there is no prior on disturbances in {start.name}"
        raise design.error(problem, ("disturbances",), allowed="disturbances files, by name or path")
    stated = {}
    for k, reference in enumerate(references):
        key: KeyPath = ("disturbances", k) if owner is design else ("disturbances",)
        stated[reference] = load_disturbances(find_named(DISTURBANCES, reference, owner, key))
    sheets = {
        name: load_detector(find_named(DETECTORS, one.detector, design, ("area_ccds", name, "detector")))
        for name, one in (design.area_ccds or {}).items()
    }
    return {
        "instrument": start,
        "cameras": load_cameras(start),
        "detector": load_detector(path_of_detector(start)),
        "disturbances": FrozenMap(stated),
        "detectors": FrozenMap(sheets),
    }


def paths_of_cameras(instrument: InstrumentSpec) -> dict[str, Path]:
    """Name in the instrument -> file of its camera. Raises InputError if there is none."""
    return {
        name: find_named(CAMERAS, mounted.camera, instrument, ("cameras", name, "camera"))
        for name, mounted in instrument.cameras.items()
    }


def load_cameras(instrument: InstrumentSpec) -> FrozenMap[str, CameraSpec]:
    """The prescriptions of an instrument's cameras, by the names that its file gives them. Raises InputError."""
    files = paths_of_cameras(instrument)
    return FrozenMap({mounted.camera: load_camera(files[name]) for name, mounted in instrument.cameras.items()})


def path_of_detector(instrument: InstrumentSpec) -> Path:
    """The file of the area CCD's data sheet. Raises InputError: there is none, or no monitor that has one."""
    key = ("monitor", "area_ccd", "detector")
    return find_named(DETECTORS, instrument.autocollimator.area_ccd.detector, instrument, key)


def load_camera(name_or_path: str | Path) -> CameraSpec:
    """Read a camera; arguments and errors as `load_instrument`."""
    path, text = _read_named(CAMERAS, name_or_path)
    if isinstance(text.data, dict) and DESIGN in text.data:
        problem = "an instrument as built is no prescription of a camera"
        raise InputError(Issue(problem, str(path), text.lines.get((DESIGN,)), (DESIGN,), None, "its design's camera"))
    return validate(CameraSpec, text).with_curves()


def load_detector(name_or_path: str | Path) -> DetectorSpec:
    """Read a detector's data sheet; arguments and errors as `load_instrument`."""
    return load_named(DetectorSpec, DETECTORS, name_or_path)


def load_autocollimator_test(name_or_path: str | Path = "principle_experiment") -> AutocollimatorSetup:
    """Read a test with two autocollimators and the data sheet of their CCDs; arguments, errors as `load_instrument`."""
    spec = load_named(AutocollimatorTestSpec, LAB, name_or_path)
    reference = spec.autocollimator.area_ccd.detector
    detector = find_named(DETECTORS, reference, spec, ("autocollimator", "area_ccd", "detector"))
    return AutocollimatorSetup(spec, load_detector(detector))


def find_camera(test: CameraUnderTestSpec | CameraDesignSpec) -> Path:
    """The file of the camera under test, or that a design starts from. Raises InputError if there is none."""
    return find_named(CAMERAS, test.camera, test, ("camera",))


def load_camera_under_test(test: TestType) -> tuple[TestType, CameraSpec]:
    """The camera under test and the test; of a camera as built, with what was built in the test's `as_built`.

    Args:
        test: names the camera: a prescription, or an instrument as built that consists of one camera.

    Raises:
        InputError: as `load_instrument`; the instrument has several cameras, or both files say how a body was built.
    """
    path = find_camera(test)
    data = read_yaml(path).data
    if not (isinstance(data, dict) and DESIGN in data):
        return test, load_camera(path)
    instrument = load_instrument(path)
    if len(instrument.cameras) > 1:
        problem = f"one camera is tested, and {instrument.name} has {names_text(instrument.cameras)}"
        raise test.error(problem, ("camera",), found=test.camera, allowed="an instrument as built to a camera's design")
    (name, mounted), *_ = instrument.cameras.items()
    built = dict(test.as_built)
    for node, what in (instrument.as_built or {}).items():
        # where the whole camera stands makes no difference before a collimator
        if node in (f"{BASE}/{name}", name):
            continue
        own = node.removeprefix(f"{BASE}/").removeprefix(f"{name}/")
        if own in built:
            raise test.error(f"{path} says how this body was built", ("as_built", own), allowed="one of the two")
        built[own] = what
    return test.model_copy(update={"as_built": FrozenMap(built)}), load_cameras(instrument)[mounted.camera]


def load_band_detectors(camera: CameraSpec) -> dict[str, DetectorSpec]:
    """Data sheets of a camera's line CCDs, by the name that the bands give. Raises InputError as `load_instrument`."""
    return {
        band.detector: load_detector(find_named(DETECTORS, band.detector, camera, ("bands", name, "detector")))
        for name, band in camera.bands.items()
    }


def load_named(model: type[SpecType], folder: str, name_or_path: str | Path) -> SpecType:
    """Read a file of one folder of the library, or a user's own of that kind.

    Args:
        model: what its kind of files may say.
        folder: of the library, for a name.
        name_or_path: as of `load_instrument`.

    Raises:
        InputError: as `load_instrument`.
    """
    return validate(model, _read_named(folder, name_or_path)[1])


def _read_named(folder: str, name_or_path: str | Path, others: tuple[str, ...] = ()) -> tuple[Path, YamlFile]:
    """The file that a reference leads to, and what it says; arguments as of `find_named`, errors as `load_named`."""
    path = place_of(folder, name_or_path, Path())
    if path is None:
        raise InputError(_no_such_name(str(name_or_path), folder, *others).at(""))
    return path, read_yaml(path)


def _names(folders: tuple[str, ...]) -> list[str]:
    """All names in folders of the library, those of the first folder first."""
    return list(dict.fromkeys(name for folder in folders for name in library_names(folder)))


def _names_and_paths(folders: tuple[str, ...]) -> str:
    first, *rest = (names_text((*library_names(f), *([NONE] if f == DISTURBANCES else []))) for f in folders)
    others = "".join(f"; {f}: {names}" for f, names in zip(folders[1:], rest, strict=True))
    return f"{first}{others}, or the path of a .yaml file"


def _no_such_name(name: str, *folders: str) -> Problem:
    problem = f"no such name in {' or '.join(folders)}"
    return unknown(problem, name, _names(folders), allowed=_names_and_paths(folders))


def find_named(folder: str, reference: str, owner: Spec, key: KeyPath, others: tuple[str, ...] = ()) -> Path:
    """The file that a specification refers to.

    Args:
        folder: of the library, for a name.
        reference: a name there, or a path from the folder of the specification's file.
        owner: the specification.
        key: where it refers to it.
        others: folders whose names may be meant by a name that is unknown, since they may stand here as well.

    Raises:
        InputError: there is no such file; with the line of the reference and the nearest name.
    """
    file = owner.source.file
    path = place_of(folder, reference, Path(file).parent if file else Path())
    folders = (folder, *others)
    if path is None:
        raise owner.error(_no_such_name(reference, *folders), key)
    if not is_file(path):
        meant = nearest(path.stem, _names(folders))
        raise owner.error(unusable(path), key, allowed=_names_and_paths(folders), suggestion=meant)
    return path


def is_path(name_or_path: str | Path) -> bool:
    """Whether a reference is a path, and not a name in the library."""
    text = str(name_or_path)
    return isinstance(name_or_path, Path) or "/" in text or text.endswith((".yaml", ".yml"))


def place_of(folder: str, name_or_path: str | Path, base: Path) -> Path | None:
    """Where a reference leads: a library file that exists, a path that may not, or None for an unknown name."""
    text = str(name_or_path)
    if is_path(name_or_path):
        return base / text
    path = _folder(folder) / f"{text}.yaml"
    return path if text in library_names(folder) else None
