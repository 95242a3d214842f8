"""Model on which the estimate of an instrument in operation depends, and its plans of operation.

`traced_model` traces the effect of each specified motion on the monitor's spots and on the cameras' parameters, and
relates temperatures to the readings of the sensors. Plans of operation are read from a file, checked against the
record's instrument and stored in the record.
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
from analysis.monitor.parameters import ANGLE, ANGLE_GROUP, CAMERA_PARAMETERS, FOCUS, GROUND, GROUND_GROUP
from analysis.monitor.state_space import HeatInputs
from optics.thermal.heat import Temperature
from scenes.models.disturbances import HEAT, DisturbancePrior
from scenes.models.thermal_model import ThermalModel
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.operation import OperationSetup, read_operation
from scenes.yaml.errors import Problem, names_text, nearest, shown
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from twin.monitor.monitor_derivative import linear_disturbances
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.record.entries import digest_of_data, digest_of_job
from twin.operate.record.history import History

BEFORE = 0.01
"""Assumed time between the calibration and the first reading, as a share of the mission's duration.

The probability of a jump in that time, and its part of the false-alarm probability, are proportional to it.
"""


@dataclass(frozen=True, eq=False)
class OperationModel:
    """Linear model of the instrument under a plan of operation, from ray traces.

    Array dimensions: K cameras with 4 parameters each, D spot coordinates.

    Attributes
    ----------
    series_filter : SeriesFilter
        Kalman filter of the model, without the steps at the record's events.
    spots : tuple[tuple[str, str], ...]
        (camera, channel) of each spot, in the order of the spot shifts.
    quantities : tuple[Quantity, ...]
        The Q estimated quantities.
    reading : (4 K, D) ndarray
        Derivatives of the camera parameters with respect to spot shifts (rad/px and m/px) according to the estimator
        `model`, which assumes that every camera moves as a whole.
    """

    series_filter: SeriesFilter
    spots: tuple[tuple[str, str], ...]
    quantities: tuple[Quantity, ...]
    reading: Array

    @cached_property
    def rows(self) -> Array:
        """Derivatives (Q, 4 K) of the quantities with respect to the cameras' parameters.

        Numerators are in the quantities' units; denominators are rad and m of one camera after the other.

        Array dimensions: Q quantities, K cameras with 4 parameters each.
        """
        return np.stack([quantity.row for quantity in self.quantities])


def traced_model(
    setup: OperationSetup, reference_sigma: Array, sensors: Sequence[str], experiment: MonitorExperiment
) -> OperationModel:
    """Trace the effects of all specified motions and build the filter.

    Array dimensions: C spots.

    Parameters
    ----------
    setup : OperationSetup
        Plan of operation with its instrument.
    reference_sigma : (C, 2) ndarray
        Standard deviations of the spots in the reference images, row and column in pixels.
    sensors : Sequence[str]
        Bodies that have a temperature sensor.
    experiment : MonitorExperiment
        Monitor experiment of the instrument.

    Returns
    -------
    OperationModel
        Filter, spots, quantities, and camera parameters per pixel of spot shift.

    Raises
    ------
    InputError
        The instrument lacks a body of the plan, or the body cannot move or be warmed as specified.
    """
    plan = setup.operation
    disturbances, motions = experiment.disturbances, experiment.prior
    assert disturbances is not None  # a plan states what moves
    assert motions is not None
    stepping = {cause for causes in plan.events.values() for cause in causes}
    series_filter = SeriesFilter(
        disturbances,
        np.diag(reference_sigma.ravel() ** 2),
        heat_inputs(motions, experiment.thermal, sensors, plan.coefficients),
        life_s=plan.mission,
        window=plan.window,
        stepping=tuple(k for k, cause in enumerate(disturbances.causes) if cause in stepping),
        before_s=BEFORE * plan.mission,
    )
    spots = [(name, channel) for name, calibration in experiment.cameras.items() for channel in calibration.channels]
    alone = [camera.parameter_jacobian @ np.linalg.pinv(camera.spot_jacobian) for camera in experiment.cameras.values()]
    return OperationModel(
        series_filter, tuple(spots), quantities(experiment.cameras, experiment.ground), np.asarray(block_diag(*alone))
    )


def focus_model(setup: OperationSetup, experiment: MonitorExperiment) -> OperationModel:
    """Return the model of an estimate from readings of focus, which are amounts of one motion.

    Parameters
    ----------
    setup : OperationSetup
        Plan of operation with `focus`, and its instrument.
    experiment : MonitorExperiment
        Experiment of the instrument, which needs no monitor.

    Raises
    ------
    InputError
        The plan's disturbances have another motion.
    """
    plan, prior = setup.operation, experiment.prior
    assert plan.focus is not None
    assert prior is not None  # a plan requires disturbances
    names = [component.name for component in prior.components]
    if set(names) != {plan.focus.motion}:
        other = next((name for name in names if name != plan.focus.motion), "no motion")
        problem = "the readings of focus are amounts of another motion than the disturbances have"
        raise plan.error(problem, ("focus", "motion"), value=plan.focus.motion, allowed=f"{other}, and no other motion")
    effect = np.ones((1, len(names)))
    disturbances = linear_disturbances(prior, effect, effect)
    stepping = {cause for causes in plan.events.values() for cause in causes}
    series_filter = SeriesFilter(
        disturbances,
        life_s=plan.mission,
        window=plan.window,
        stepping=tuple(k for k, cause in enumerate(disturbances.causes) if cause in stepping),
    )
    quantity = Quantity(plan.focus.camera, FOCUS, np.array([FOCUS.per_si]))
    return OperationModel(series_filter, ((plan.focus.camera, "focus"),), (quantity,), np.ones((1, 1)))


def heat_inputs(
    prior: DisturbancePrior, thermal: ThermalModel, sensors: Sequence[str], sigma: float
) -> HeatInputs | None:
    """Return the model of the sensors' readings as a linear function of the prior's temperatures.

    None is returned if no sensor reads a temperature of the prior. A sensor is located at its body's origin. A body
    without a specified temperature has that of the body that carries it.

    Parameters
    ----------
    prior : DisturbancePrior
        All M specified components of motion and temperature.
    thermal : ThermalModel
        Thermal model of the instrument.
    sensors : Sequence[str]
        Bodies that have a sensor.
    sigma : float
        Relative standard deviation, over the bodies, of the ratio of the true to the computed optical effect of a
        body's temperature.
    """
    heat = [k for k, component in enumerate(prior.components) if component.kind in HEAT]
    still = {prior.components[k].body: Temperature() for k in heat}
    rows = np.zeros((len(sensors), len(heat)))
    for column, k in enumerate(heat):
        heat_component = prior.components[k]
        gradient = tuple(
            heat_component.sigma if heat_component.kind == "gradient" and heat_component.axis == axis else 0.0
            for axis in range(3)
        )
        temperature = Temperature(
            heat_component.sigma if heat_component.kind == "temperature" else 0.0,
            (gradient[0], gradient[1], gradient[2]),
        )
        fields = thermal.fields({**still, heat_component.body: temperature})
        rows[:, column] = [fields[body].change if body in fields else 0.0 for body in sensors]
    read = np.any(rows != 0.0, axis=1)
    observed = np.any(rows != 0.0, axis=0)
    if not np.any(observed):
        return None
    motions = np.array(heat)[observed]
    bodies = [prior.components[k].body for k in motions.tolist()]
    names = tuple(dict.fromkeys(bodies))
    reading_bodies = tuple(body for body, temperature in zip(sensors, read, strict=True) if temperature)
    factors = np.array([names.index(body) for body in bodies])
    return HeatInputs(motions, reading_bodies, rows[np.ix_(read, observed)], factors, names, sigma)


def read_plan(path: Path, history: History) -> OperationSetup:
    """Read a plan of operation from a file.

    Parameters
    ----------
    path : Path
        The file.
    history : History
        Record; the plan must be for its instrument.

    Raises
    ------
    InputError
        The file cannot be read, is not valid, or is for a different instrument from the record's; or it requires a
        quantity that the instrument does not have.
    """
    setup = read_operation(path)
    operation, digest = setup.operation, digest_of_job(setup.model)
    if digest != history.sha256:
        problem = f"a plan of another instrument than the record's ({digest[:12]}, not {history.sha256[:12]})"
        raise operation.error(problem, ("instrument",), value=operation.instrument, allowed=history.name)
    names = quantity_names(setup.model.instrument)
    if operation.focus is not None:
        names = (f"{operation.focus.camera} {FOCUS.key}",)
    for k, requirement in enumerate(operation.requirements):
        if requirement.name not in names:
            text, near = f"{history.name} has no such quantity", nearest(requirement.name, names)
            wrong = Problem(text, shown(requirement.quantity), names_text(names), near)
            raise operation.error(wrong, ("requirements", k, "quantity"))
    return setup


def quantity_names(instrument: InstrumentSpec) -> tuple[str, ...]:
    """Return group and key of all quantities of an instrument, such as ``forward d_alpha_arcsec``.

    Their order is that of `analysis.monitor.limits.quantities`.
    """
    cameras = tuple(instrument.cameras)
    names = [f"{camera} {parameter.key}" for camera in cameras for parameter in CAMERA_PARAMETERS.values()]
    if len(cameras) == 2:
        names.append(f"{ANGLE_GROUP} {ANGLE.key}")
        names += [f"{GROUND_GROUP} {parameter.key}" for parameter in GROUND] if instrument.altitude is not None else []
    return tuple(names)


def store_plan(setup: OperationSetup, file: Path, history: History) -> bool:
    """Store a plan in the record with its instrument and disturbances, and return whether it is a new one."""
    return history.store_plan(str(file.absolute()), setup.plain())


def stored_plan(history: History) -> OperationSetup | None:
    """Return the newest plan stored in the record; None if it has none.

    Raises
    ------
    InputError
        Another version of the program stored the plan in a different form.
    """
    row = history.plan()
    return None if row is None else validate(OperationSetup, YamlFile("the record's plan", row["content"], {}))


def plan_digest(setup: OperationSetup) -> str:
    """Return the SHA-256 of the parts of a plan that the estimate depends on.

    Requirements and the locations of files do not affect it.
    """
    plain = setup.plain()
    operation = {key: value for key, value in plain["operation"].items() if key not in _NO_PART}
    return digest_of_data({"operation": operation, "model": {k: v for k, v in plain["model"].items() if k != "job"}})


_NO_PART = ("instrument", "disturbances", "horizon", "requirements")
"""Keys of a plan that do not affect the estimate of the present and past, and are therefore not part of its digest."""
