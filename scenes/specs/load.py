"""Resolution of references: names in the library of the twin, paths of a user's files, or mappings instead of a file.

The library's folders are cameras, instruments, detectors, payloads, disturbances and budgets in scenes/library,
scenes/lab (experiments on the ground) and scenes/orbit (in flight). The name of a file there is its file name without
.yaml.
"""

from pathlib import Path
from typing import Any, TypeVar

from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera import CameraSpec
from scenes.specs.camera_tests import AutocollimatorSetup, AutocollimatorTestSpec, CameraUnderTestSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.disturbances import NONE, DisturbancesSpec, ErrorBudgetSpec
from scenes.specs.instrument import BASE, DESIGN, AsBuiltInstrumentSpec, InstrumentSpec
from scenes.specs.job import JobSpec, with_tables
from scenes.yaml.errors import InputError, Issue, KeyPath, names_text, nearest, shown, unknown
from scenes.yaml.input_file import is_file, unusable
from scenes.yaml.spec import Inline, Source, Spec, validate
from scenes.yaml.yaml_file import YamlFile, read_yaml

SpecType = TypeVar("SpecType", bound=Spec)
TestType = TypeVar("TestType", bound=CameraUnderTestSpec)

SCENES = Path(__file__).resolve().parent.parent
LIBRARY = SCENES / "library"
EXAMPLES = SCENES / "examples"
CAMERAS, INSTRUMENTS, DETECTORS = "cameras", "instruments", "detectors"
LAB, BUDGETS, ORBIT, PAYLOADS, DISTURBANCES = "lab", "budgets", "orbit", "payloads", "disturbances"


def _folder(name: str) -> Path:
    """Return the folder of one kind of library file."""
    return (SCENES if name in (LAB, ORBIT, "examples") else LIBRARY) / name


def library_names(folder: str) -> tuple[str, ...]:
    """Return the sorted names in one folder of the library, such as "cameras", "instruments" or "detectors"."""
    return tuple(sorted(path.stem for path in _folder(folder).glob("*.yaml")))


def load_job(path: str | Path) -> JobSpec:
    """Read a job; its instrument must exist but is not read.

    Raises
    ------
    InputError
        The file cannot be read or is not a valid job, or there is no such instrument; one issue for each fault.
    """
    job = with_tables(validate(JobSpec, read_yaml(path)))
    _instrument_file(job.instrument, job, ("instrument",))
    return job


def _instrument_file(reference: str | Path, owner: Spec | None, key: KeyPath) -> YamlFile:
    """Return the file of an instrument or, as an instrument without a monitor, of a camera."""
    alone = str(reference) not in library_names(INSTRUMENTS) and str(reference) in library_names(CAMERAS)
    folder = CAMERAS if alone and not isinstance(reference, Inline) else INSTRUMENTS
    return read_reference(folder, reference, owner, key, (CAMERAS,))


def load_error_budget(name_or_path: str | Path) -> ErrorBudgetSpec:
    """Read an error budget, given by its name in the library or its path.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file.
    """
    return load_named(ErrorBudgetSpec, BUDGETS, name_or_path)


def load_instrument(reference: str | Path, owner: Spec | None = None, key: KeyPath = ()) -> InstrumentSpec:
    """Read an instrument; its cameras and detector must exist but are not read.

    For an instrument as built, the design is also read; its errors are reported and its paths are relative to its file.

    Parameters
    ----------
    reference : str | Path
        Name in the library, path from the folder of the owner's file (anything with a slash or ending in .yaml or
        .yml), or the mapping itself. A camera becomes the instrument that consists of this camera alone.
    owner : Spec | None
        Specification that has the reference; None for a path from the current folder.
    key : KeyPath
        Key of the reference in the owner.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file; one issue for each fault.
    """
    text = _instrument_file(reference, owner, key)
    data = text.data if isinstance(text.data, dict) else {}
    if "mirrors" in data:
        camera, path = validate(CameraSpec, text), Path(text.file)
        reference_in_file = path.stem if path.parent == _folder(CAMERAS) else path.name
        if isinstance(reference, Inline):
            reference_in_file = Inline(camera.name, text)
        return InstrumentSpec.of_camera(camera.name, reference_in_file).with_source(Source(text.file))
    if DESIGN in data:
        return _as_built(validate(AsBuiltInstrumentSpec, text))
    instrument = validate(InstrumentSpec, text)
    for name, mounted in instrument.cameras.items():
        read_reference(CAMERAS, mounted.camera, instrument, ("cameras", name, "camera"))
    if instrument.monitor is not None:
        read_reference(DETECTORS, instrument.monitor.area_ccd.detector, instrument, AREA_CCD)
    return instrument


def _as_built(spec: AsBuiltInstrumentSpec) -> InstrumentSpec:
    """Return the instrument as built, made from its design."""
    data = _instrument_file(spec.design, spec, (DESIGN,)).data
    if isinstance(data, dict) and DESIGN in data:
        problem, name = "this design is itself an instrument as built", shown(data[DESIGN])
        allowed = f"its design, {name}, with all deviations below as_built"
        raise spec.error(problem, (DESIGN,), value=spec.design, allowed=allowed)
    disturbances = spec.disturbances
    if disturbances is not None and disturbances != NONE:
        disturbances = portable_reference(DISTURBANCES, disturbances, spec, ("disturbances",))
    return spec.from_design(load_instrument(spec.design, spec, (DESIGN,)), disturbances)


def is_instrument(data: Any) -> bool:
    """Return whether plain data of a file are those of an instrument, nominal or as built."""
    return isinstance(data, dict) and bool({"cameras", DESIGN} & set(data)) and not _OTHERS & set(data)


_OTHERS = {"job", "study", "test", "detector", "camera"}
"""Keys that occur in a run's config.yaml and in no instrument's file."""


def load_disturbances(reference: str | Path, owner: Spec | None = None, key: KeyPath = ()) -> DisturbancesSpec:
    """Read a disturbances file.

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
    return load_named(DisturbancesSpec, DISTURBANCES, reference, owner, key).with_tables()


def find_disturbances(job: JobSpec, instrument: InstrumentSpec) -> DisturbancesSpec | None:
    """Return the disturbances of a job, its own or its instrument's, with the job's changes; None if it has none.

    Raises
    ------
    InputError
        The file is missing or invalid, or the job changes a cause that the file does not have.
    """
    changes = job.disturbances
    owner: Spec = job
    reference = None if changes is None else changes.file
    key: KeyPath = ("disturbances", "file")
    if reference is None:
        owner, reference, key = instrument, instrument.disturbances, ("disturbances",)
    if reference is None or reference == NONE:
        if changes is not None and (changes.causes or changes.without):
            text = "there is no disturbances file to change"
            raise job.error(text, ("disturbances",), allowed="the name of one as file")
        return None
    disturbances = load_disturbances(reference, owner, key)
    return disturbances if changes is None else disturbances.changed(changes)


AREA_CCD: KeyPath = ("monitor", "area_ccd", "detector")
"""Key of the data sheet of an instrument's area CCDs."""


def load_cameras(instrument: InstrumentSpec) -> FrozenMap[str, CameraSpec]:
    """Return the prescriptions of an instrument's cameras by the references in its file.

    Raises
    ------
    InputError
        A camera is missing or invalid, or two different cameras in the file have one name.
    """
    cameras: dict[str, CameraSpec] = {}
    for name, mounted in instrument.cameras.items():
        key: KeyPath = ("cameras", name, "camera")
        camera = load_camera(mounted.camera, instrument, key)
        if cameras.setdefault(str(mounted.camera), camera) != camera:
            raise instrument.error("another camera of this instrument has the same name", (*key, "name"))
    return FrozenMap(cameras)


def load_camera(reference: str | Path, owner: Spec | None = None, key: KeyPath = ()) -> CameraSpec:
    """Read a camera's file.

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
    text = read_reference(CAMERAS, reference, owner, key)
    if isinstance(text.data, dict) and DESIGN in text.data:
        problem = "an instrument as built is not a prescription of a camera"
        line, key_path = text.lines.get((*text.prefix, DESIGN)), (*text.prefix, DESIGN)
        raise InputError(Issue(problem, text.file, line, key_path, None, "its design's camera"))
    return validate(CameraSpec, text).with_curves()


def load_detector(reference: str | Path, owner: Spec | None = None, key: KeyPath = ()) -> DetectorSpec:
    """Read a detector's data sheet.

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
    return load_named(DetectorSpec, DETECTORS, reference, owner, key)


def load_autocollimator_test(name_or_path: str | Path = "principle_experiment") -> AutocollimatorSetup:
    """Read a test with two autocollimators, by name or path, and the data sheet of their CCDs.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file.
    """
    spec = load_named(AutocollimatorTestSpec, LAB, name_or_path)
    key = ("autocollimator", "area_ccd", "detector")
    return AutocollimatorSetup(spec, load_detector(spec.autocollimator.area_ccd.detector, spec, key))


def load_camera_under_test(test: TestType) -> tuple[TestType, CameraSpec]:
    """Return a test and its camera; for a camera as built, its deviations are added to the test's `as_built`.

    Parameters
    ----------
    test : TestType
        Test whose camera is a prescription, or an instrument as built that consists of one camera.

    Raises
    ------
    InputError
        The camera is missing or invalid, the instrument has several cameras, or both files have deviations of one body.
    """
    key = ("camera",)
    text = read_reference(CAMERAS, test.camera, test, key)
    if not (isinstance(text.data, dict) and DESIGN in text.data):
        return test, load_camera(test.camera, test, key)
    instrument = load_instrument(test.camera, test, key)
    if len(instrument.cameras) > 1:
        problem = f"the test needs a single camera, but {instrument.name} has {names_text(instrument.cameras)}"
        raise test.error(problem, key, value=test.camera, allowed="an instrument as built to a camera's design")
    (name, mounted), *_ = instrument.cameras.items()
    built = dict(test.as_built)
    for node, what in (instrument.as_built or {}).items():
        # the pose of the whole camera has no effect in front of a collimator
        if node in (f"{BASE}/{name}", name):
            continue
        part = node.removeprefix(f"{BASE}/").removeprefix(f"{name}/")
        if part in built:
            raise test.error(f"{text.file} already has this body", ("as_built", part), allowed="one of the two")
        built[part] = what
    return test.model_copy(update={"as_built": FrozenMap(built)}), load_cameras(instrument)[mounted.camera]


def load_band_detectors(camera: CameraSpec) -> FrozenMap[str, DetectorSpec]:
    """Return reference of each band -> data sheet of its line CCD.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file.
    """
    bands = camera.bands.items()
    return FrozenMap({b.detector: load_detector(b.detector, camera, ("bands", name, "detector")) for name, b in bands})


def load_named(
    model: type[SpecType], folder: str, reference: str | Path, owner: Spec | None = None, key: KeyPath = ()
) -> SpecType:
    """Read a file of one folder of the library, a user's file of that kind, or the mapping in its place.

    Parameters
    ----------
    model : type[SpecType]
        Model of this kind of file.
    folder : str
        Folder of the library, for a name.
    reference : str | Path
        Name in the library, path, or the mapping itself.
    owner : Spec | None
        Specification that has the reference.
    key : KeyPath
        Key of the reference in the owner.

    Raises
    ------
    InputError
        The file is missing or invalid.
    """
    return validate(model, read_reference(folder, reference, owner, key))


def _names(folders: tuple[str, ...]) -> list[str]:
    """Return the names of all files in some folders of the library, those of the first folder first."""
    return list(dict.fromkeys(name for folder in folders for name in library_names(folder)))


def _names_and_paths(folders: tuple[str, ...]) -> str:
    first, *rest = (names_text((*library_names(f), *([NONE] if f == DISTURBANCES else []))) for f in folders)
    others = "".join(f"; {f}: {names}" for f, names in zip(folders[1:], rest, strict=True))
    return f"{first}{others}, or the path of a .yaml file"


def read_reference(
    folder: str, reference: str | Path, owner: Spec | None = None, key: KeyPath = (), others: tuple[str, ...] = ()
) -> YamlFile:
    """Return the content to which a reference leads; all names, paths and mappings are resolved here.

    Parameters
    ----------
    folder : str
        Folder of the library, for a name.
    reference : str | Path
        Name in that folder, path from the folder of the owner's file, or the mapping itself.
    owner : Spec | None
        Specification that has the reference; None for a path from the current folder.
    key : KeyPath
        Key of the reference in the owner.
    others : tuple[str, ...]
        Further folders whose names are allowed there, and are suggested for an unknown name.

    Raises
    ------
    InputError
        The file is missing or cannot be read; with the line of the reference and the nearest name.
    """
    if isinstance(reference, Inline):
        return reference.placed(Source() if owner is None else owner.source, key).yaml
    return read_yaml(find_named(folder, reference, owner, key, others))


def find_named(
    folder: str, reference: str | Path, owner: Spec | None, key: KeyPath, others: tuple[str, ...] = ()
) -> Path:
    """Return the path of the file to which a name in the library or a path leads.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file.
    """
    path = reference_path(folder, reference, owner)
    folders = (folder, *others)
    if path is None:
        text = f"no such name in {' or '.join(folders)}"
        problem = unknown(text, str(reference), _names(folders), allowed=_names_and_paths(folders))
        raise InputError(problem.at("")) if owner is None else owner.error(problem, key)
    if owner is not None and not is_file(path):
        near = nearest(path.stem, _names(folders))
        raise owner.error(unusable(path), key, allowed=_names_and_paths(folders), suggestion=near)
    return path


def portable_reference(folder: str, reference: str, owner: Spec, key: KeyPath, others: tuple[str, ...] = ()) -> str:
    """Return a reference that is valid from any folder: a library name, an absolute path, or a mapping.

    Raises
    ------
    InputError
        The file cannot be read or is not valid, or there is no such file.
    """
    if isinstance(reference, Inline):
        return reference.placed(owner.source, key)
    if not is_path(reference) and any(reference in library_names(other) for other in others):
        return reference
    path = find_named(folder, reference, owner, key, others)
    return str(path.absolute()) if is_path(reference) else reference


def is_path(name_or_path: str | Path) -> bool:
    """Return whether a reference is a path instead of a name in the library."""
    text = str(name_or_path)
    return isinstance(name_or_path, Path) or "/" in text or text.endswith((".yaml", ".yml"))


def reference_path(folder: str, reference: str | Path, owner: Spec | None) -> Path | None:
    """Return the path of a reference: a library file that exists, or a path that may not; None for an unknown name."""
    text = str(reference)
    if is_path(reference):
        return (Path(owner.source.file).parent if owner is not None and owner.source.file else Path()) / text
    return _folder(folder) / f"{text}.yaml" if text in library_names(folder) else None
