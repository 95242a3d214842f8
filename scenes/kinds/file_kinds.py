"""All kinds of YAML files, how one is told from its keys, and which command reads it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from scenes.specs.autocollimators import AutocollimatorTestSpec
from scenes.specs.camera import CameraDesignSpec, CameraSpec, MonitorDesignSpec
from scenes.specs.camera_tests import DistortionTestSpec, FocusTestSpec, MeasuredDistortionSpec, MeasuredFocusSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.instrument import ErrorBudgetSpec, InstrumentSpec
from scenes.specs.job import JobSpec
from scenes.specs.measured.monitor_frames import MeasurementSpec
from scenes.specs.measured.orbit_data import (
    MeasuredAngleSpec,
    MeasuredCalibrationSpec,
    OrbitCheckSpec,
    OrbitDataSpec,
    OrbitMatchSpec,
)
from scenes.specs.orbit.angle import OrbitAngleSpec
from scenes.specs.orbit.calibration import OrbitCalibrationSpec
from scenes.specs.orbit.monitor import OrbitMonitorSpec
from scenes.specs.orbit.simulate import OrbitSimulateSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.study import StudySpec
from scenes.specs.turntable import MeasuredTurntableSpec, TurntableTestSpec
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.spec import Spec
from scenes.yaml.yaml_file import read_yaml

Given = TypeVar("Given")

SLIPS = 1
"""Keys that a file of a kind may have and the kind does not know: a typing error does not make it another kind."""


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes:
        name: of its JSON Schema.
        model: what it may say.
        what: it is, with article, for messages.
        command: that reads it, as the user calls it; empty for what only other files name.
        place: where other files name it; empty for what only a command reads.
    """

    name: str
    model: type[Spec]
    what: str
    command: str = ""
    place: str = ""

    def strangers(self, keys: set[str]) -> int | None:
        """How many of the keys are none of this kind's; None if one that it needs is missing."""
        fields = self.model.model_fields
        needed = {name for name, item in fields.items() if item.is_required()}
        return len(keys - set(fields)) if needed <= keys else None


_VALIDATED = "the checks of `python -m twin.validate`"

FILE_KINDS = (
    FileKind("job", JobSpec, "a job of the monitor", "twin.render"),
    FileKind("measurement", MeasurementSpec, "a measurement of a monitor", "twin.recover"),
    FileKind("instrument", InstrumentSpec, "an instrument", place="a job's `instrument: FILE`"),
    FileKind(
        "camera",
        CameraSpec,
        "a camera's prescription",
        "twin.camera",
        "an instrument's `cameras: {NAME: {camera: FILE}}`",
    ),
    FileKind("camera_design", CameraDesignSpec, "an optimisation of a camera", "twin.design camera"),
    FileKind("monitor_design", MonitorDesignSpec, "a search for a monitor's layout", "twin.design monitor"),
    FileKind("detector", DetectorSpec, "a detector's data sheet", place="`detector: FILE` of an area CCD or a band"),
    FileKind(
        "disturbances",
        DisturbancesSpec,
        "a list of disturbances",
        place="a job's `disturbances: FILE`",
    ),
    FileKind("error_budget", ErrorBudgetSpec, "an error budget", place=_VALIDATED),
    FileKind("principle_experiment", AutocollimatorTestSpec, "a test of two autocollimators", place=_VALIDATED),
    FileKind("focus_test", FocusTestSpec, "a focus test", "twin.lab focus"),
    FileKind("distortion_test", DistortionTestSpec, "a distortion test", "twin.lab distortion"),
    FileKind("turntable_test", TurntableTestSpec, "a turntable test", "twin.lab turntable"),
    FileKind("measured_focus", MeasuredFocusSpec, "a focus test on measurements", "twin.lab focus"),
    FileKind("measured_distortion", MeasuredDistortionSpec, "a distortion test on measurements", "twin.lab distortion"),
    FileKind("measured_turntable", MeasuredTurntableSpec, "a turntable test on measurements", "twin.lab turntable"),
    FileKind("orbit_angle", OrbitAngleSpec, "a test of intersection angles", "twin.orbit angle"),
    FileKind("orbit_calibration", OrbitCalibrationSpec, "an in-orbit calibration", "twin.orbit calibrate"),
    FileKind("orbit_simulate", OrbitSimulateSpec, "a simulation of images of the ground", "twin.orbit simulate"),
    FileKind("orbit_check", OrbitCheckSpec, "a check of the conventions of a pass", "twin.orbit check"),
    FileKind("orbit_match", OrbitMatchSpec, "points to be measured in line images", "twin.orbit match"),
    FileKind("orbit_monitor", OrbitMonitorSpec, "a test of monitoring in orbit", "twin.orbit monitor"),
    FileKind("measured_calibration", MeasuredCalibrationSpec, "a calibration on measurements", "twin.orbit calibrate"),
    FileKind("measured_angle", MeasuredAngleSpec, "intersection angles on measurements", "twin.orbit angle"),
    FileKind("orbit_data", OrbitDataSpec, "measurements of passes", place="`data: DIR` of a test on measurements"),
    FileKind(
        "three_line_camera", ThreeLineCameraSpec, "a three-line payload", place="`camera: FILE` of a test in orbit"
    ),
    FileKind("study", StudySpec, "a study", "twin.study"),
)
"""Every kind, in the order in which their schemas are listed."""

_RESOLVED = {"job": "job", "study": "study"}
"""Key of a config.yaml that names its kind; those of tests have ``test``, which is told as its own file would be."""


def kind_of(data: Any) -> FileKind | None:
    """The kind of file, or of a run's config.yaml, that these plain data can only be; None where that is not clear."""
    if not isinstance(data, Mapping):
        return None
    keys = {key for key in data if isinstance(key, str)}
    for key, name in _RESOLVED.items():
        if key in keys:
            return next(kind for kind in FILE_KINDS if kind.name == name)
    if "test" in keys:
        return kind_of(data["test"])
    found = [(strange, kind) for kind in FILE_KINDS if (strange := kind.strangers(keys)) is not None]
    least = min((strange for strange, _ in found), default=SLIPS + 1)
    nearest = [kind for strange, kind in found if strange == least]
    return nearest[0] if least <= SLIPS and len(nearest) == 1 else None


def read_for(command: str, file: Path, resolve: Callable[[Path], Given]) -> Given:
    """What ``resolve`` makes of the file that was given to a command.

    Args:
        command: as the user calls it, ``twin.lab focus``.
        file: given to it.
        resolve: raises InputError.

    Raises:
        InputError: as ``resolve``; for a file of another kind it says what the file is and which command reads it.
    """
    try:
        return resolve(file)
    except InputError as error:
        try:
            kind = kind_of(read_yaml(file).data)
        except InputError:
            raise error from None
        if kind is None or kind.command == command:
            raise
        reads = f"python -m {kind.command} {file} does" if kind.command else ""
        named = f"its name belongs into {kind.place}" if kind.place else ""
        there = ", or ".join(filter(None, (reads, named)))
        raise InputError(Issue(f"this is {kind.what}, which {command} does not read; {there}", str(file))) from None
