"""Tests in orbit on measurements, together with the camera and the files that they refer to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.measured.orbit_data import (
    MeasuredAngleSpec,
    MeasuredCalibrationSpec,
    MeasuredTestSpec,
    OrbitCheckSpec,
    OrbitDataSpec,
    OrbitMatchSpec,
    PassFilesSpec,
)
from scenes.specs.measured.pass_files import PlatformFilesSpec, with_absolute_files
from scenes.specs.orbit.setup import (
    AngleSetup,
    CalibrationSetup,
    find_payload,
    load_orbit_test,
    load_three_line_camera,
    resolve_angle,
    resolve_calibration,
)
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, read_setup
from scenes.yaml.errors import Problem, names_text, nearest
from scenes.yaml.input_file import MISSING, no_file
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import read_yaml

DATA_FILE = "data.yaml"
"""Of a folder of measurements."""


class MeasuredCalibrationSetup(ExperimentSetup[MeasuredCalibrationSpec]):
    """A calibration on measurements, with its camera.

    Attributes:
        camera: the payload.
        data: the passes, with paths that hold from anywhere.
    """

    camera: ThreeLineCameraSpec
    data: OrbitDataSpec

    def with_seed(self, seed: int) -> MeasuredCalibrationSetup:
        """The same: nothing is drawn."""
        return self


class MeasuredAngleSetup(ExperimentSetup[MeasuredAngleSpec]):
    """Intersection angles on measurements, with the camera.

    Attributes:
        camera: the payload.
        data: the passes, with paths that hold from anywhere.
    """

    camera: ThreeLineCameraSpec
    data: OrbitDataSpec

    def with_seed(self, seed: int) -> MeasuredAngleSetup:
        """The same: nothing is drawn."""
        return self


Setup = TypeVar("Setup", MeasuredCalibrationSetup, MeasuredAngleSetup)


def is_measured(path: str | Path) -> bool:
    """Whether a file, or a run's config.yaml, is a test on measurements. InputError if it cannot be read."""
    if not (isinstance(path, Path) or "/" in str(path) or str(path).endswith((".yaml", ".yml"))):
        return False
    data = read_yaml(path).data
    if isinstance(data, dict) and isinstance(data.get("test"), dict):
        data = data["test"]
    # `passes` of a simulation is a number
    return isinstance(data, dict) and ("data" in data or "conventions" in data or isinstance(data.get("passes"), dict))


def resolve_measured_calibration(path: str | Path) -> MeasuredCalibrationSetup:
    """Read a calibration on measurements and what it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or the schemes name passes that are none.
    """
    setup = _resolved(MeasuredCalibrationSetup, MeasuredCalibrationSpec, path)
    try:
        setup.test.check_schemes(setup.data.passes)
    except Problem as problem:
        raise setup.test.error(
            problem.problem,
            problem.within,
            found=problem.found,
            allowed=problem.allowed,
            suggestion=problem.suggestion,
        ) from None
    return setup


AnyCalibration = CalibrationSetup | MeasuredCalibrationSetup
"""On a simulation, or on measurements."""


def resolve_any_calibration(path: str | Path) -> AnyCalibration:
    """As `resolve_calibration`, or `resolve_measured_calibration` for a file that names measurements."""
    return resolve_measured_calibration(path) if is_measured(path) else resolve_calibration(path)


def resolve_measured_angle(path: str | Path) -> MeasuredAngleSetup:
    """Read intersection angles on measurements and what they refer to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid.
    """
    return _resolved(MeasuredAngleSetup, MeasuredAngleSpec, path)


AnyAngle = AngleSetup | MeasuredAngleSetup
"""On a simulation, or on measurements."""


def resolve_any_angle(path: str | Path) -> AnyAngle:
    """As `resolve_angle`, or `resolve_measured_angle` for a file that names measurements."""
    return resolve_measured_angle(path) if is_measured(path) else resolve_angle(path)


def _resolved(model: type[Setup], kind: type[Any], path: str | Path) -> Setup:
    setup = read_setup(model, path)
    if setup is not None:
        return setup
    test: Any = load_orbit_test(kind, path)
    return model.model_construct(test=test, camera=load_three_line_camera(find_payload(test)), data=data_of(test))


def data_of(test: MeasuredTestSpec) -> OrbitDataSpec:
    """The passes of a test, with paths that hold from anywhere.

    Raises:
        InputError: there is no such folder, or its file is not valid.
    """
    folder = Path(test.source.file).parent if test.source.file else Path()
    if test.data is None:
        assert test.conventions is not None
        assert test.passes is not None
        data = OrbitDataSpec.model_construct(conventions=test.conventions, passes=_placed(test, test.passes, folder))
        return _with_quaternions_said(test, data)
    place = folder / test.data
    file = place / DATA_FILE if place.is_dir() else place
    wrong = no_file(file)
    if wrong is not None:
        allowed = f"a folder with a {DATA_FILE}, or the path of such a file"
        problem = "no such measurements" if wrong == MISSING else f"no measurements: {wrong}"
        raise test.error(problem, ("data",), found=str(place), allowed=allowed)
    data = validate(OrbitDataSpec, read_yaml(file))
    return _with_quaternions_said(data, data.model_copy(update={"passes": _placed(data, data.passes, file.parent)}))


def _placed(owner: Spec, passes: Mapping[str, PassFilesSpec], folder: Path) -> FrozenMap[str, PassFilesSpec]:
    """The passes with absolute paths. InputError, at the key of the owner, for a file that is not there."""
    found = {}
    for name, one in passes.items():
        files: dict[str, Any] = {
            key: _present(owner, ("passes", name, key), folder, value) for key, value in one.files.items()
        }
        if isinstance(one.platform, PlatformFilesSpec):
            others = {
                ("orbit", "file"): one.platform.orbit.file,
                ("attitude", "file"): one.platform.attitude.file,
                ("earth_orientation",): one.platform.earth_orientation,
            }
            for key, value in others.items():
                if value is not None:
                    _present(owner, ("passes", name, "platform", *key), folder, value, "a file")
            files["platform"] = with_absolute_files(one.platform, folder)
        found[name] = one.model_copy(update=files)
    return FrozenMap(found)


def _present(owner: Spec, key: tuple[str, ...], folder: Path, value: str, what: str = "a CSV file") -> str:
    """The absolute path of a file. InputError, at the key of the owner, where it is not there."""
    place = folder / value
    wrong = no_file(place)
    if wrong is not None and wrong != MISSING:
        raise owner.error(wrong, key, found=value, allowed=f"{what}, its path relative to this one")
    if wrong is not None:
        beside = [place.with_name(other.name) for other in _beside(place)]
        meant = nearest(str(place), [str(other) for other in beside])
        told = None if meant is None else str(Path(value).with_name(Path(meant).name))
        allowed = f"{what}, its path relative to this one"
        raise owner.error(MISSING, key, found=value, allowed=allowed, suggestion=told)
    return str(place.absolute())


def _with_quaternions_said(owner: Spec, data: OrbitDataSpec) -> OrbitDataSpec:
    """The same. InputError where a table of an attitude is not said how to be read."""
    tables = any(not isinstance(one.platform, PlatformFilesSpec) for one in data.passes.values())
    for key in ("quaternion", "body_axes"):
        if tables and getattr(data.conventions, key) is None:
            problem = f"{key} is missing: a table of an attitude does not say how it is to be read"
            raise owner.error(problem, ("conventions",), allowed=f"`{key}:`")
    return data


def _beside(place: Path) -> list[Path]:
    """Files in the same folder."""
    try:
        return sorted(other for other in place.parent.iterdir() if other.is_file())
    except (OSError, ValueError):
        return []


class CheckSetup(ExperimentSetup[OrbitCheckSpec]):
    """A check of a pass in files with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec

    def with_seed(self, seed: int) -> CheckSetup:
        """The same: nothing is drawn."""
        return self


def resolve_check(path: str | Path) -> CheckSetup:
    """Read a check and the camera it refers to; a run's config.yaml can be given in its place. Paths of the files of
    the pass are made absolute, so that the config.yaml is good anywhere.

    Raises:
        InputError: a file cannot be read or is not valid.
    """
    setup = read_setup(CheckSetup, path)
    if setup is not None:
        return setup
    test = load_orbit_test(OrbitCheckSpec, path)
    camera = load_three_line_camera(find_payload(test))
    return CheckSetup.model_construct(test=with_absolute_files(test), camera=camera)


class MatchSetup(ExperimentSetup[OrbitMatchSpec]):
    """Points in a user's images with the camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec

    def with_seed(self, seed: int) -> MatchSetup:
        """The same: nothing is drawn."""
        return self


def resolve_match(path: str | Path) -> MatchSetup:
    """Read what is to be matched and the camera it refers to; a run's config.yaml can be given in its place. Paths of
    files are made absolute, so that the config.yaml is good anywhere.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    setup = read_setup(MatchSetup, path)
    if setup is None:
        test = load_orbit_test(OrbitMatchSpec, path)
        camera = load_three_line_camera(find_payload(test))
        setup = MatchSetup.model_construct(test=with_absolute_files(test), camera=camera)
    for name in setup.test.images:
        if name not in setup.camera.lines:
            allowed, meant = names_text(setup.camera.lines), nearest(name, setup.camera.lines)
            raise setup.test.error("no such line", ("images", name), found=name, allowed=allowed, suggestion=meant)
    return setup
