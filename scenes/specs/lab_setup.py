"""A laboratory test together with everything it refers to, so that one file says all that went into a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.camera import CameraSpec
from scenes.specs.camera_tests import DistortionTestSpec, FocusTestSpec, MeasuredDistortionSpec, MeasuredFocusSpec
from scenes.specs.detector import DetectorSpec, require_detector
from scenes.specs.load import (
    find_camera,
    find_turntable_test,
    load_band_detectors,
    load_camera,
    load_lab_test,
    load_turntable_test,
)
from scenes.specs.resolved import ExperimentSetup, read_setup
from scenes.specs.turntable_test import MeasuredTurntableSpec, TurntableFiles, TurntableTestSpec
from scenes.yaml.errors import names_text, nearest
from scenes.yaml.input_file import is_file, unusable
from scenes.yaml.spec import Paths, Spec
from scenes.yaml.yaml_file import read_yaml

MEASURED = "measured"
"""Key of a test whose data come from files and not from a simulated bench."""
DATA_FILES = ("comparisons", "held_out", "spots", "mtf", "images")
"""Keys of `measured` that name files."""
MeasuredSetup = TypeVar("MeasuredSetup", bound="ExperimentSetup[Any]")


class FocusSetup(ExperimentSetup[FocusTestSpec]):
    """A focal-plane alignment with its camera and detectors.

    Attributes:
        camera: prescription and bands.
        detectors: as the bands name them -> data sheet.
    """

    camera: CameraSpec
    detectors: Paths[DetectorSpec]


class DistortionSetup(ExperimentSetup[DistortionTestSpec]):
    """A distortion test with its camera, detectors and turntable.

    Attributes:
        turntable: its dividing error and calibration.
        camera: prescription and bands.
        detectors: as the bands name them -> data sheet.
    """

    turntable: TurntableTestSpec
    camera: CameraSpec
    detectors: Paths[DetectorSpec]


class TurntableSetup(ExperimentSetup[TurntableTestSpec]):
    """A turntable test, which refers to nothing else."""


class MeasuredFocusSetup(ExperimentSetup[MeasuredFocusSpec]):
    """A focal-plane alignment on measurements."""


class MeasuredDistortionSetup(ExperimentSetup[MeasuredDistortionSpec]):
    """A distortion test on measurements."""


class MeasuredTurntableSetup(ExperimentSetup[MeasuredTurntableSpec]):
    """A turntable test on measurements."""


def resolve_focus(path: str | Path) -> FocusSetup:
    """Read a focal-plane alignment and all it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: any of the files cannot be read or is not valid.
    """
    if (again := read_setup(FocusSetup, path)) is not None:
        _require_plane(again.test, again.camera)
        _require_detectors(again, again.camera, again.detectors)
        return again
    test = load_lab_test(FocusTestSpec, path)
    camera = load_camera(find_camera(test))
    _require_plane(test, camera)
    return FocusSetup.model_construct(test=test, camera=camera, detectors=FrozenMap(load_band_detectors(camera)))


def resolve_distortion(path: str | Path) -> DistortionSetup:
    """Read a distortion test and all it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: any of the files cannot be read or is not valid.
    """
    if (again := read_setup(DistortionSetup, path)) is not None:
        _require_bands(again.test, again.camera, again.test.band)
        _require_detectors(again, again.camera, again.detectors)
        return again
    test = load_lab_test(DistortionTestSpec, path)
    camera = load_camera(find_camera(test))
    _require_bands(test, camera, test.band)
    turntable = load_turntable_test(find_turntable_test(test))
    return DistortionSetup.model_construct(
        test=test, turntable=turntable, camera=camera, detectors=FrozenMap(load_band_detectors(camera))
    )


def resolve_turntable(path: str | Path) -> TurntableSetup:
    """Read a turntable test; a run's config.yaml can be given in its place.

    Raises:
        InputError: the file cannot be read or is not valid.
    """
    if (again := read_setup(TurntableSetup, path)) is not None:
        return again
    return TurntableSetup.model_construct(test=load_turntable_test(path))


def resolve_focus_test(path: str | Path) -> FocusSetup | MeasuredFocusSetup:
    """As `resolve_focus`, for a simulated bench or, with `measured:` in the file, for measurements."""
    if is_measured(path):
        return _measured(MeasuredFocusSetup, MeasuredFocusSpec, path)
    return resolve_focus(path)


def resolve_distortion_test(path: str | Path) -> DistortionSetup | MeasuredDistortionSetup:
    """As `resolve_distortion`, for a simulated bench or, with `measured:` in the file, for measurements."""
    if is_measured(path):
        return _measured(MeasuredDistortionSetup, MeasuredDistortionSpec, path)
    return resolve_distortion(path)


def resolve_turntable_test(path: str | Path) -> TurntableSetup | MeasuredTurntableSetup:
    """As `resolve_turntable`, for a simulated bench or, with `measured:` in the file, for measurements."""
    if is_measured(path):
        return _measured(MeasuredTurntableSetup, MeasuredTurntableSpec, path)
    return resolve_turntable(path)


def is_measured(path: str | Path) -> bool:
    """Whether a test's file, or a run's config.yaml, takes its data from measurements.

    Raises:
        InputError: it cannot be read.
    """
    if not (isinstance(path, Path) or "/" in str(path) or str(path).endswith((".yaml", ".yml"))):
        return False
    data = read_yaml(path).data
    inner = data.get("test", data) if isinstance(data, dict) else None
    return isinstance(inner, dict) and MEASURED in inner


def _measured(setup: type[MeasuredSetup], model: type[Spec], path: str | Path) -> MeasuredSetup:
    """The test with the paths of its data made absolute, so that a run's config.yaml finds them from anywhere."""
    again = read_setup(setup, path)
    test: Spec = load_lab_test(model, path) if again is None else again.test
    folder = Path(test.source.file).parent.absolute()
    measured = getattr(test, MEASURED)
    changed = {MEASURED: _absolute(measured, folder)}
    return cast(MeasuredSetup, setup.model_construct(test=test.model_copy(update=changed)))


def _absolute(files: Spec, folder: Path) -> Spec:
    """The same section with every path absolute."""
    changed: dict[str, Any] = {}
    for name in type(files).model_fields:
        value = getattr(files, name)
        if isinstance(value, TurntableFiles):
            changed[name] = _absolute(value, folder)
        elif name in DATA_FILES and value is not None:
            changed[name] = str(_found(files, name, folder / value))
    return files.model_copy(update=changed)


def _found(files: Spec, name: str, path: Path) -> Path:
    """The path, if there is such a file."""
    if is_file(path):
        return path
    try:
        beside = [str(other.relative_to(path.parent)) for other in path.parent.iterdir() if other.suffix == path.suffix]
    except OSError:
        beside = []
    meant = nearest(path.name, beside)
    raise files.error(unusable(path), (name,), allowed="a CSV file, relative to this file", suggestion=meant)


def _require_plane(test: Spec, camera: CameraSpec) -> None:
    """Bands at one X' alone do not tell the tilt about the line."""
    _require_bands(test, camera)
    if len({band.offset for band in camera.bands.values()}) < 2:
        raise test.error(
            f"all bands of the camera {camera.name} stand at one X', so the tilt about the line cannot be told",
            ("camera",),
            allowed="a camera with bands at different offsets",
        )


def _require_detectors(setup: Spec, camera: CameraSpec, detectors: Mapping[str, DetectorSpec]) -> None:
    """InputError unless the data sheets of all bands are there."""
    for name, band in camera.bands.items():
        require_detector(setup, ("camera", "bands", name, "detector"), band.detector, detectors)


def _require_bands(test: Spec, camera: CameraSpec, band: str | None = None) -> None:
    if not camera.bands:
        raise test.error(
            f"the camera {camera.name} has no line CCDs", ("camera",), allowed="a camera with `bands:` in its file"
        )
    if band is not None and band not in camera.bands:
        names = tuple(camera.bands)
        meant = nearest(band, names)
        raise test.error("no such band", ("band",), found=band, allowed=names_text(names), suggestion=meant)
