"""What an estimate of an instrument in operation rests on beside its readings: what moves and what that does to light,
what sensors see of it, and what is read.

Plans of operation of a record: read from a file, checked against the record's instrument, and kept in the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from analysis.arrays import Array
from analysis.monitor.kalman_filter import SeriesFilter
from analysis.monitor.limits import Quantity, quantities
from analysis.monitor.parameters import ANGLE, ANGLE_GROUP, CAMERA_PARAMETERS, GROUND, GROUND_GROUP
from analysis.monitor.state_space import HeatInputs
from optics.thermal.heat import Temperature
from scenes.models.disturbances import HEAT, StatedMotions
from scenes.models.thermal_model import ThermalModel
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.operation import OperationSetup, read_operation
from scenes.yaml.errors import Problem, names_text, nearest, shown
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.record.entries import digest_of_data, digest_of_job
from twin.operate.record.history import History

BEFORE = 0.01
"""Share of the mission that passes between the calibration and the first reading: so large are the chance of a jump
then and its part of the chance of a false alarm.
"""


@dataclass(frozen=True, eq=False)
class OperationModel:
    """What an estimate rests on beside readings.

    Attributes
    ----------
    how : SeriesFilter
        The filter, which knows of no events yet.
    spots : tuple[tuple[str, str], ...]
        (camera, channel) of each spot, in the order of shifts.
    quantities : tuple[Quantity, ...]
        Q of them that are read.
    reading : Array
        (4 K, D) parameters per px by the estimator `model`, by which every camera moves as a whole.
    """

    how: SeriesFilter
    spots: tuple[tuple[str, str], ...]
    quantities: tuple[Quantity, ...]
    reading: Array

    @cached_property
    def rows(self) -> Array:
        """(Q, 4 K) each in its unit per rad and m of the parameters of one camera after the other."""
        return np.stack([one.row for one in self.quantities])


def traced_model(
    setup: OperationSetup, reference_sigma: Array, sensors: Sequence[str], experiment: MonitorExperiment
) -> OperationModel:
    """Trace what is stated to move.

    Parameters
    ----------
    setup : OperationSetup
        The plan with its instrument.
    reference_sigma : Array
        (C, 2) px of the spots that all shifts are counted from, row and column.
    sensors : Sequence[str]
        Bodies of which there are temperatures.
    experiment : MonitorExperiment
        On the instrument.

    Raises
    ------
    InputError
        a body that the instrument does not have, or that cannot move or be warmed so.
    """
    plan = setup.operation
    stated, motions = experiment.disturbances, experiment.stated
    assert stated is not None  # a plan states what moves
    assert motions is not None
    stepping = {cause for causes in plan.events.values() for cause in causes}
    how = SeriesFilter(
        stated,
        np.diag(reference_sigma.ravel() ** 2),
        heat_inputs(motions, experiment.thermal, sensors, plan.coefficients),
        life_s=plan.mission,
        window=plan.window,
        stepping=tuple(k for k, cause in enumerate(stated.causes) if cause in stepping),
        before_s=BEFORE * plan.mission,
    )
    spots = [(name, channel) for name, one in experiment.cameras.items() for channel in one.channels]
    alone = [one.parameter_jacobian @ np.linalg.pinv(one.spot_jacobian) for one in experiment.cameras.values()]
    return OperationModel(
        how, tuple(spots), quantities(experiment.cameras, experiment.ground), np.asarray(block_diag(*alone))
    )


def heat_inputs(
    stated: StatedMotions, thermal: ThermalModel, sensors: Sequence[str], sigma: float
) -> HeatInputs | None:
    """What sensors of bodies read of the temperatures that are stated; None if none of them reads any.

    A sensor stands at its body's origin. A body of which no temperature is stated has that of the body that carries it.

    Parameters
    ----------
    stated : StatedMotions
        All that moves or gets warm, M components.
    thermal : ThermalModel
        Of the instrument.
    sensors : Sequence[str]
        bodies.
    sigma : float
        Standard deviation of the factor of what heat of each body does.
    """
    heat = [k for k, one in enumerate(stated.components) if one.kind in HEAT]
    still = {stated.components[k].body: Temperature() for k in heat}
    rows = np.zeros((len(sensors), len(heat)))
    for column, k in enumerate(heat):
        one = stated.components[k]
        gradient = tuple(one.sigma if one.kind == "gradient" and one.axis == axis else 0.0 for axis in range(3))
        own = Temperature(one.sigma if one.kind == "temperature" else 0.0, (gradient[0], gradient[1], gradient[2]))
        fields = thermal.fields({**still, one.body: own})
        rows[:, column] = [fields[body].change if body in fields else 0.0 for body in sensors]
    read = np.any(rows != 0.0, axis=1)
    seen = np.any(rows != 0.0, axis=0)
    if not np.any(seen):
        return None
    motions = np.array(heat)[seen]
    bodies = [stated.components[k].body for k in motions.tolist()]
    names = tuple(dict.fromkeys(bodies))
    told = tuple(body for body, own in zip(sensors, read, strict=True) if own)
    factors = np.array([names.index(body) for body in bodies])
    return HeatInputs(motions, told, rows[np.ix_(read, seen)], factors, names, sigma)


def read_plan(path: Path, history: History) -> OperationSetup:
    """The plan in a file.

    Raises
    ------
    InputError
        It cannot be read, is not valid, or is of another instrument than the record; a requirement is of a quantity
        that the instrument does not have.
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
    names = [f"{camera} {one.key}" for camera in cameras for one in CAMERA_PARAMETERS.values()]
    if len(cameras) == 2:
        names.append(f"{ANGLE_GROUP} {ANGLE.key}")
        names += [f"{GROUND_GROUP} {one.key}" for one in GROUND] if instrument.altitude is not None else []
    return tuple(names)


def store_plan(setup: OperationSetup, file: Path, history: History) -> bool:
    """Keep a plan in the record, with the instrument and the disturbances that it names; whether it is a new one."""
    return history.store_plan(str(file.absolute()), setup.plain())


def stored_plan(history: History) -> OperationSetup | None:
    """The plan that the record keeps and that counts; None for none.

    Raises
    ------
    InputError
        It is of a program that wrote it otherwise.
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
