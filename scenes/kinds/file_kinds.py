"""All kinds of YAML files, how one is told from its keys, and which command reads it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.file_kind import FileKind
from scenes.yaml.yaml_file import read_yaml

Given = TypeVar("Given")

SLIPS = 1
"""Keys that a file of a kind may have and the kind does not know: a typing error does not make it another kind."""

_MOST = 2
"""Kinds that a file may be and be told as such; of more its keys say nothing."""

_VALIDATED = "the checks of `python -m twin.validate`"

FILE_KINDS = (
    FileKind("job", "scenes.specs.job:JobSpec", "a job of the monitor", "twin.render", needs=("instrument",)),
    FileKind(
        "measurement",
        "scenes.specs.measured.monitor_frames:MeasurementSpec",
        "a measurement of a monitor",
        "twin.recover",
        needs=("frames",),
    ),
    FileKind(
        "instrument",
        "scenes.specs.instrument:InstrumentSpec",
        "an instrument",
        place="a job's `instrument: FILE`",
        needs=("cameras", "name"),
    ),
    FileKind(
        "as_built_instrument",
        "scenes.specs.as_built:AsBuiltInstrumentSpec",
        "an instrument as built",
        place="a job's `instrument: FILE`",
        needs=("design", "name"),
    ),
    FileKind(
        "camera",
        "scenes.specs.camera:CameraSpec",
        "a camera's prescription",
        "twin.camera",
        "an instrument's `cameras: {NAME: {camera: FILE}}`",
        needs=("mirrors", "focal_length"),
    ),
    FileKind(
        "detector",
        "scenes.specs.detector:DetectorSpec",
        "a detector's data sheet",
        place="`detector: FILE` of an area CCD or a band",
        needs=("bit_depth", "full_well_e"),
    ),
    FileKind(
        "disturbances",
        "scenes.specs.disturbances:DisturbancesSpec",
        "a list of disturbances",
        place="a job's `disturbances: FILE`",
        one_of=("causes", "joint"),
        needs=("name",),
    ),
    FileKind(
        "error_budget",
        "scenes.specs.disturbances:ErrorBudgetSpec",
        "an error budget",
        place=_VALIDATED,
        needs=("angle_errors", "disturbances"),
    ),
    FileKind(
        "principle_experiment",
        "scenes.specs.autocollimators:AutocollimatorTestSpec",
        "a test of two autocollimators",
        place=_VALIDATED,
        needs=("autocollimator", "programme"),
    ),
    *(
        replace(kind, command=f"twin.{command}")
        for command, procedure in PROCEDURES.items()
        for kind in procedure.files
    ),
    FileKind(
        "orbit_data",
        "scenes.specs.measured.orbit_data:OrbitDataSpec",
        "measurements of passes",
        place="`data: DIR` of a test on measurements",
        needs=("conventions", "passes"),
    ),
    FileKind(
        "three_line_camera",
        "scenes.specs.orbit.three_line_camera:ThreeLineCameraSpec",
        "a three-line payload",
        place="`camera: FILE` of a test in orbit",
        needs=("lines", "pixels"),
    ),
    FileKind(
        "telemetry",
        "scenes.specs.measured.telemetry:TelemetrySpec",
        "what tables of readings hold",
        "twin.operate ingest",
        needs=("instrument", "readings"),
    ),
    FileKind(
        "operation",
        "scenes.specs.operation:OperationSpec",
        "a plan of operation",
        "twin.operate status",
        needs=("instrument", "disturbances"),
    ),
    FileKind("study", "scenes.specs.study:StudySpec", "a study", "twin.study", needs=("base", "factors")),
    FileKind(
        "tolerance",
        "scenes.specs.tolerance:ToleranceBudgetSpec",
        "a tolerance budget",
        "twin.tolerance",
        needs=("merits", "tolerances"),
    ),
)
"""Every kind, in the order in which their schemas are listed; those of tests are in the list of these."""

_RESOLVED = {"job": "job", "study": "study"}
"""Key of a config.yaml that names its kind; those of tests have ``test``, which is told as its own file would be."""


def kind_of(data: Any) -> FileKind | None:
    """The kind of file, or of a run's config.yaml, that these plain data can only be; None where that is not clear."""
    nearest = kinds_of(data)
    return nearest[0] if len(nearest) == 1 else None


def kinds_of(data: Any) -> tuple[FileKind, ...]:
    """The kinds that these plain data can be: more than one where no key tells them apart."""
    if not isinstance(data, Mapping):
        return ()
    keys = {key for key in data if isinstance(key, str)}
    for key, name in _RESOLVED.items():
        if key in keys:
            return (next(kind for kind in FILE_KINDS if kind.name == name),)
    if "test" in keys:
        return kinds_of(data["test"])
    found = [(strange, kind) for kind in FILE_KINDS if (strange := kind.strangers(keys)) is not None]
    least = min((strange for strange, _ in found), default=SLIPS + 1)
    return tuple(kind for strange, kind in found if strange == least <= SLIPS)


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
            kinds = kinds_of(read_yaml(file).data)
        except InputError:
            raise error from None
        if not kinds or len(kinds) > _MOST or any(kind.command == command for kind in kinds):
            raise
        what, there = " or ".join(kind.what for kind in kinds), ", or ".join(_place(kind, file) for kind in kinds)
        raise InputError(Issue(f"this is {what}, which {command} does not read; {there}", str(file))) from None


def _place(kind: FileKind, file: Path) -> str:
    """Which command reads a file of a kind, and where its name belongs."""
    reads = f"python -m {kind.command} {file} does" if kind.command else ""
    named = f"its name belongs into {kind.place}" if kind.place else ""
    return ", or ".join(filter(None, (reads, named)))
