"""Plans of operation of a record: read from a file, checked against the record's instrument, and kept in the record."""

from __future__ import annotations

from pathlib import Path

from analysis.monitor.parameters import ANGLE, ANGLE_GROUP, CAMERA_PARAMETERS, GROUND, GROUND_GROUP
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.operation import OperationSetup, read_operation
from scenes.yaml.errors import Problem, names_text, nearest, shown
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from twin.operate.record.entries import digest_of_data, digest_of_job
from twin.operate.record.history import History


def read_plan(path: Path, history: History) -> OperationSetup:
    """The plan in a file.

    Raises:
        InputError: it cannot be read, is not valid, or is of another instrument than the record; a requirement is of a
            quantity that the instrument does not have.
    """
    setup = read_operation(path)
    operation, digest = setup.operation, digest_of_job(setup.model)
    if digest != history.sha256:
        problem = f"a plan of another instrument than the record's ({digest[:12]}, not {history.sha256[:12]})"
        raise operation.error(problem, ("instrument",), found=operation.instrument, allowed=history.name)
    names = quantity_names(setup.model.instrument)
    for k, one in enumerate(operation.requirements):
        if one.name not in names:
            text, near = f"{history.name} has no such quantity", nearest(one.name, names)
            wrong = Problem(text, shown(one.quantity), names_text(names), near)
            raise operation.error(wrong, ("requirements", k, "quantity"))
    return setup


def quantity_names(instrument: InstrumentSpec) -> tuple[str, ...]:
    """Group and key of all that is read of an instrument, as `analysis.monitor.limits.quantities` has them."""
    cameras = tuple(instrument.cameras)
    names = [f"{camera} {one.key}" for camera in cameras for one in CAMERA_PARAMETERS]
    if len(cameras) == 2:
        names.append(f"{ANGLE_GROUP} {ANGLE.key}")
        names += [f"{GROUND_GROUP} {one.key}" for one in GROUND] if instrument.altitude is not None else []
    return tuple(names)


def keep_plan(setup: OperationSetup, file: Path, history: History) -> bool:
    """Keep a plan in the record, with the instrument and the disturbances that it names; whether it is a new one."""
    return history.keep_plan(str(file.absolute()), setup.plain())


def kept_plan(history: History) -> OperationSetup | None:
    """The plan that the record keeps and that counts; None for none.

    Raises:
        InputError: it is of a program that wrote it otherwise.
    """
    row = history.plan()
    return None if row is None else validate(OperationSetup, YamlFile("the record's plan", row["content"], {}))


def plan_digest(setup: OperationSetup) -> str:
    """SHA-256 of all of a plan, and of what it names, on which an estimate rests: not of what has to be kept, nor of
    where its files stand.
    """
    plain = setup.plain()
    own = {key: value for key, value in plain["operation"].items() if key not in _NO_PART}
    return digest_of_data({"operation": own, "model": {k: v for k, v in plain["model"].items() if k != "job"}})


_NO_PART = ("instrument", "disturbances", "horizon", "requirements")
"""Keys of a plan that do not change what an estimate of the past and of now is."""
