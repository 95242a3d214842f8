"""Tests in orbit on measurements, together with the camera and the files that they refer to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, load_named
from scenes.specs.measured import orbit_data
from scenes.specs.measured.pass_files import PlatformFilesSpec, with_absolute_files
from scenes.specs.orbit.calibration import checked_schemes
from scenes.specs.orbit.setup import (
    AngleSetup,
    CalibrationSetup,
    JitterSetup,
    load_payload,
    require_lines,
    resolve_angle,
    resolve_calibration,
    resolve_jitter,
)
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, TestType, read_setup, test_keys
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.input_file import MISSING, no_file
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import read_yaml

DATA_FILE = "data.yaml"
"""Name of the file that says what a folder of measurements holds."""


class FixedSetup(ExperimentSetup[TestType], Generic[TestType]):
    """A test of a payload in which nothing is drawn.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec

    def with_seed(self, seed: int) -> Self:
        """Return this set-up: nothing is drawn."""
        return self


class MeasuredCalibrationSetup(FixedSetup[orbit_data.MeasuredCalibrationSpec]):
    """A calibration on measurements, with its camera.

    Attributes:
        camera: the payload.
        data: the passes, with paths that hold from anywhere.
    """

    data: orbit_data.OrbitDataSpec


class MeasuredAngleSetup(FixedSetup[orbit_data.MeasuredAngleSpec]):
    """Intersection angles on measurements, with the camera.

    Attributes:
        camera: the payload.
        data: the passes, with paths that hold from anywhere.
    """

    data: orbit_data.OrbitDataSpec


class MeasuredJitterSetup(FixedSetup[orbit_data.MeasuredJitterSpec]):
    """A search for jitter on measurements, with the camera.

    Attributes:
        camera: the payload.
        data: the passes, with paths that hold from anywhere.
    """

    data: orbit_data.OrbitDataSpec


Setup = TypeVar("Setup", MeasuredCalibrationSetup, MeasuredAngleSetup, MeasuredJitterSetup)


def is_measured(path: str | Path) -> bool:
    """Whether a file, or a run's config.yaml, is a test on measurements; not of a block, whose simulation has a mapping
    of passes, too (`adjust_setup.resolve_any_adjust`). InputError if it cannot be read.
    """
    said = test_keys(path)
    # `passes` of a simulation is a number
    return "data" in said or "conventions" in said or isinstance(said.get("passes"), dict)


def resolve_measured_calibration(path: str | Path) -> MeasuredCalibrationSetup:
    """Read a calibration on measurements and what it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or the schemes name passes that are none.
    """
    setup = _resolved(MeasuredCalibrationSetup, orbit_data.MeasuredCalibrationSpec, path)
    try:
        checked_schemes(setup.test.schemes, setup.data.passes)
    except Problem as problem:
        raise setup.test.error(problem) from None
    return setup


AnyCalibration = CalibrationSetup | MeasuredCalibrationSetup
"""On a simulation, or on measurements."""


def resolve_any_calibration(path: str | Path) -> AnyCalibration:
    """Read a calibration as `resolve_calibration`, or `resolve_measured_calibration` for a file that names
    measurements.
    """
    return resolve_measured_calibration(path) if is_measured(path) else resolve_calibration(path)


def resolve_measured_angle(path: str | Path) -> MeasuredAngleSetup:
    """Read intersection angles on measurements and what they refer to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid.
    """
    return _resolved(MeasuredAngleSetup, orbit_data.MeasuredAngleSpec, path)


AnyAngle = AngleSetup | MeasuredAngleSetup
"""On a simulation, or on measurements."""


def resolve_any_angle(path: str | Path) -> AnyAngle:
    """Read intersection angles as `resolve_angle`, or `resolve_measured_angle` for a file that names measurements."""
    return resolve_measured_angle(path) if is_measured(path) else resolve_angle(path)


AnyJitter = JitterSetup | MeasuredJitterSetup
"""On a simulation, or on measurements."""


def resolve_any_jitter(path: str | Path) -> AnyJitter:
    """Read a search for jitter as `resolve_jitter`, or one on measurements for a file that names them; a run's
    config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    if not is_measured(path):
        return resolve_jitter(path)
    setup = _resolved(MeasuredJitterSetup, orbit_data.MeasuredJitterSpec, path)
    require_lines(setup.test, setup.test.lines, setup.camera)
    return setup


def _resolved(model: type[Setup], kind: type[Any], path: str | Path) -> Setup:
    setup = read_setup(model, path)
    if setup is not None:
        return setup
    test: Any = load_named(kind, ORBIT, path)
    return model.model_construct(test=test, camera=load_payload(test), data=data_of(test))


def data_of(test: orbit_data.MeasuredTestSpec) -> orbit_data.OrbitDataSpec:
    """The passes of a test, with paths that hold from anywhere.

    Raises:
        InputError: there is no such folder, or its file is not valid.
    """
    folder = Path(test.source.file).parent if test.source.file else Path()
    if test.data is None:
        assert test.conventions is not None
        assert test.passes is not None
        data = orbit_data.OrbitDataSpec.model_construct(
            conventions=test.conventions, passes=_placed(test, test.passes, folder)
        )
        return _with_quaternions_said(test, data)
    place = folder / test.data
    file = place / DATA_FILE if place.is_dir() else place
    wrong = no_file(file)
    if wrong is not None:
        allowed = f"a folder with a {DATA_FILE}, or the path of such a file"
        problem = "no such measurements" if wrong == MISSING else f"no measurements: {wrong}"
        raise test.error(problem, ("data",), found=str(place), allowed=allowed)
    data = validate(orbit_data.OrbitDataSpec, read_yaml(file))
    return _with_quaternions_said(data, data.model_copy(update={"passes": _placed(data, data.passes, file.parent)}))


def _placed(
    owner: Spec, passes: Mapping[str, orbit_data.PassFilesSpec], folder: Path
) -> FrozenMap[str, orbit_data.PassFilesSpec]:
    """The passes with absolute paths. InputError, at the key of the owner, for a file that is not there."""
    found = {}
    for name, one in passes.items():
        files: dict[str, Any] = {
            key: str(owner.file_at(("passes", name, key), value, folder, "a CSV file"))
            for key, value in one.files.items()
        }
        if isinstance(one.platform, PlatformFilesSpec):
            others = {
                ("orbit", "file"): one.platform.orbit.file,
                ("attitude", "file"): one.platform.attitude.file,
                ("earth_orientation",): one.platform.earth_orientation,
            }
            for key, value in others.items():
                if value is not None:
                    owner.file_at(("passes", name, "platform", *key), value, folder, "a file")
            files["platform"] = with_absolute_files(one.platform, folder)
        found[name] = one.model_copy(update=files)
    return FrozenMap(found)


def _with_quaternions_said(owner: Spec, data: orbit_data.OrbitDataSpec) -> orbit_data.OrbitDataSpec:
    """Return the data. InputError where nothing says how a table of an attitude is to be read."""
    tables = any(not isinstance(one.platform, PlatformFilesSpec) for one in data.passes.values())
    for key in ("quaternion", "body_axes"):
        if tables and getattr(data.conventions, key) is None:
            problem = f"{key} is missing: a table of an attitude does not say how it is to be read"
            raise owner.error(problem, ("conventions",), allowed=f"`{key}:`")
    return data


class CheckSetup(FixedSetup[orbit_data.OrbitCheckSpec]):
    """A check of a pass in files with its camera.

    Attributes:
        camera: the payload.
    """


def resolve_check(path: str | Path) -> CheckSetup:
    """Read a check and the camera it refers to; a run's config.yaml can be given in its place. Paths of the files of
    the pass are made absolute, so that the config.yaml is good anywhere.

    Raises:
        InputError: a file cannot be read or is not valid.
    """
    setup = read_setup(CheckSetup, path)
    if setup is not None:
        return setup
    test = load_named(orbit_data.OrbitCheckSpec, ORBIT, path)
    return CheckSetup.model_construct(test=with_absolute_files(test), camera=load_payload(test))


class MatchSetup(FixedSetup[orbit_data.OrbitMatchSpec]):
    """Points in a user's images with the camera.

    Attributes:
        camera: the payload.
    """


def resolve_match(path: str | Path) -> MatchSetup:
    """Read what is to be matched and the camera it refers to; a run's config.yaml can be given in its place. Paths of
    files are made absolute, so that the config.yaml is good anywhere.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    setup = read_setup(MatchSetup, path)
    if setup is None:
        test = load_named(orbit_data.OrbitMatchSpec, ORBIT, path)
        setup = MatchSetup.model_construct(test=with_absolute_files(test), camera=load_payload(test))
    for name in setup.test.images:
        if name not in setup.camera.lines:
            raise setup.test.error(unknown("no such line", name, setup.camera.lines), ("images", name))
    return setup
