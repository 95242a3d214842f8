"""Simulated life of an instrument in operation.

Random time series of all specified motions are drawn according to the time laws in the file of disturbances; the
monitor's images are rendered and measured for every reading; and telemetry as of a real instrument is written to files,
which the record ingests like any others. The truth is written to a separate file, which the operation never reads.

Motions without steps are drawn by `scenes.models.drawn_motions`; steps occur at random times with a specified mean
rate, or at the dates of events. The filter and the smoother, which are tested with such simulations, are not used here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from optics.numerics.array_math import covariance_root
from scenes.models.disturbances import Component, DisturbancePrior, causes_of, drawn_motions, states_of
from scenes.specs.operation import OperationSetup
from scenes.yaml.spec import Inline
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.procedure import Advance, stream
from twin.framework.record import described
from twin.framework.run_folder import RunFolder
from twin.main_job.monitor_reading import MonitorReading, rounded
from twin.monitor.crosstalk import CameraCrosstalk, crosstalk
from twin.monitor.monitor_experiment import MonitorExperiment, largest_piece
from twin.monitor.observation import Observation, ObservationOptions, observe, shared_detector
from twin.monitor.reading_table import ReadingTable, reading_table
from twin.operate.record.entries import MICRO, utc_text
from twin.operate.record.telemetry import CONFIG, RESULTS

Moments = NDArray[np.int64]

_MOTIONS, _JUMPS, _EVENTS, _DATES, _COEFFICIENTS = 10, 11, 12, 13, 14
"""Numbers of the random streams of a seed: motions, jumps, steps at events, dates of events, errors of thermal
coefficients. The detectors' exposures use smaller numbers (`MonitorExperiment.frames_after`).
"""
_MARGIN = 0.1
"""Share of a life's duration, at its beginning and at its end, in which no random dates of events are drawn.

The effect of each event can thus be observed.
"""


@dataclass(frozen=True)
class Step:
    """Step of the motions of one or more bodies at one moment.

    Array dimensions: M motions.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    cause : str
        Cause in the disturbances file.
    body : str
        Body that stepped; empty if all bodies of the cause stepped at an event.
    event : str
        Event of the step; empty for a jump at an unknown time.
    sizes : (M,) ndarray
        Sizes in SI units, zero for components that did not step.
    """

    time: int
    cause: str
    body: str
    event: str
    sizes: Array


@dataclass(frozen=True, eq=False)
class Life:
    """Amounts of all specified motions of an instrument at T times of its simulated operation.

    Attributes
    ----------
    times : (T,) ndarray of int64
        Microseconds of TAI since 2000, ascending.
    components : tuple[Component, ...]
        The M components.
    drawn : (T, M) ndarray
        Amounts according to the time laws of the disturbances, without steps, in SI units.
    steps : tuple[Step, ...]
        Steps in the order of time.
    dates : tuple[tuple[int, str], ...]
        (time in microseconds, name) of every event.
    coefficients : Mapping[str, float]
        Body with a temperature -> relative error of its thermal coefficient: ratio of the true to the computed optical
        effect of its temperature, minus 1.
    """

    times: Moments
    components: tuple[Component, ...]
    drawn: Array
    steps: tuple[Step, ...]
    dates: tuple[tuple[int, str], ...]
    coefficients: Mapping[str, float]

    @cached_property
    def amounts(self) -> Array:
        """Amounts of the motions at all times including steps, (T, M), in SI units.

        Array dimensions: T times, M motions.
        """
        out = self.drawn.copy()
        for step in self.steps:
            out[self.times >= step.time] += step.sizes
        return out

    @cached_property
    def acting(self) -> Array:
        """Effective amounts of the motions, as they act on light, (T, M), in SI units.

        Temperatures are multiplied by the ratio of the true to the computed optical effect of their body. Array
        dimensions: T times, M motions.
        """
        factor = [1.0 + self.coefficients.get(c.body, 0.0) * (c.kind == "temperature") for c in self.components]
        return np.asarray(self.amounts * np.array(factor))

    @cached_property
    def temperatures(self) -> dict[str, Array]:
        """Temperature of each body minus the instrument's, (T,), in kelvin, by the body's path.

        Array dimensions: T times.
        """
        out: dict[str, Array] = {}
        for k, component in enumerate(self.components):
            if component.kind == "temperature":
                out[component.body] = out.get(component.body, np.zeros(len(self.times))) + self.amounts[:, k]
        return out


def drawn_life(
    prior: DisturbancePrior,
    times: Moments,
    zero: int,
    seed: int,
    causes: Mapping[str, Sequence[str]],
    dates: Sequence[tuple[int, str]] | None = None,
    coefficient_error: float = 0.0,
) -> Life:
    """Draw the amounts of all motions over time at random, with steps and events.

    Array dimensions: T times.

    Parameters
    ----------
    prior : DisturbancePrior
        The motions and their time laws.
    times : (T,) ndarray of int64
        Microseconds of TAI since 2000, ascending.
    zero : int
        Time at which the time laws begin, in microseconds of TAI since 2000.
    seed : int
        Seed of all random numbers; those of one cause do not depend on the others.
    causes : Mapping[str, Sequence[str]]
        Event -> causes whose motions step when it occurs.
    dates : Sequence[tuple[int, str]] | None
        (time, event) of every event; None to draw one date for each.
    coefficient_error : float
        Relative standard deviation of the ratio of the true to the computed optical effect of a body's temperature.
    """
    seconds = (times - zero) / MICRO
    drawn = drawn_motions(prior, seconds, lambda number: np.random.default_rng(stream(seed, _MOTIONS, number)))
    motions_of_cause, steps = causes_of(prior), list[Step]()
    for number, (cause, where) in enumerate(motions_of_cause.items()):
        steps += _jumps(prior, cause, where, times, np.random.default_rng(stream(seed, _JUMPS, number)))
    event_dates = _drawn_dates(sorted(causes), times, seed) if dates is None else tuple(sorted(dates))
    for number, (moment, name) in enumerate(event_dates):
        for k, cause in enumerate(causes.get(name, ())):
            rng = np.random.default_rng(stream(seed, _EVENTS, number, k))
            steps.append(Step(moment, cause, "", name, _step(prior, motions_of_cause.get(cause, []), rng)))
    rng = np.random.default_rng(stream(seed, _COEFFICIENTS))
    warm = dict.fromkeys(c.body for c in prior.components if c.kind == "temperature")
    coefficients = dict(zip(warm, (coefficient_error * rng.standard_normal(len(warm))).tolist(), strict=True))
    return Life(times, prior.components, drawn, tuple(sorted(steps, key=_when)), event_dates, coefficients)


def _jumps(
    prior: DisturbancePrior, cause: str, motions: Sequence[int], times: Moments, rng: np.random.Generator
) -> Iterator[Step]:
    """Yield random steps of a cause whose time law has jumps at a mean interval.

    The motions of one body step together.
    """
    mean_interval = prior.laws[motions[0]].jump
    if mean_interval is None:
        return
    span = (int(times[-1]) - int(times[0])) / MICRO
    for body in dict.fromkeys(prior.components[k].body for k in motions):
        stepping = [k for k in motions if prior.components[k].body == body]
        for second in np.sort(rng.uniform(0.0, span, rng.poisson(span / mean_interval))).tolist():
            yield Step(int(times[0]) + round(second * MICRO), cause, body, "", _step(prior, stepping, rng))


def _step(prior: DisturbancePrior, where: Sequence[int], rng: np.random.Generator) -> Array:
    """Draw the sizes (M,) of a step of some motions, in SI units, correlated as specified; zero for the others.

    Array dimensions: M motions.
    """
    out = np.zeros(len(prior.components))
    root = covariance_root(prior.correlation[np.ix_(where, where)])
    out[list(where)] = rng.standard_normal(len(where)) @ root * prior.sigma[list(where)]
    return out


def _drawn_dates(events: Sequence[str], times: Moments, seed: int) -> tuple[tuple[int, str], ...]:
    """Draw one date for each event, uniformly distributed over the life except for its margins."""
    first, span = int(times[0]), int(times[-1]) - int(times[0])
    rng = np.random.default_rng(stream(seed, _DATES))
    shares = rng.uniform(_MARGIN, 1.0 - _MARGIN, len(events)).tolist()
    return tuple(sorted((first + round(share * span), name) for share, name in zip(shares, events, strict=True)))


def _when(step: Step) -> tuple[int, str, str]:
    """Return the key by which steps are sorted: time, cause and body."""
    return step.time, step.cause, step.body


FOLDER = "simulated"
"""Subfolder of a record with the files of its simulated readings."""
TELEMETRY, LIFE = "telemetry.yaml", "life"
TEMPERATURES, PASSES, EVENTS = "temperatures.csv", "passes.csv", "events.csv"
RENDER = "render and recover"
_SENSORS = 15
"""Number of the random stream of the temperature sensors' errors."""
_KELVIN = 4
"""Number of decimals of a simulated sensor's temperature in kelvin; real sensors have as many or fewer."""


@dataclass(frozen=True)
class Simulation:
    """Parameters of a simulated operation (life) of an instrument.

    Attributes
    ----------
    start : int
        Time of the first reading and origin of the time laws, in microseconds of TAI since 2000.
    seconds : float
        Length of the life, in seconds.
    interval : float
        Interval between readings of the monitor, in seconds; temperatures are read at the same times.
    seed : int
        Seed of all random numbers.
    frames : int
        Number of frames of each exposure.
    coefficient_error : float
        Relative standard deviation, from body to body, of the ratio of the true to the computed optical effect of a
        temperature.
    sensor_sigma : float
        Standard deviation of a temperature sensor, in kelvin.
    sensors : tuple[str, ...] | None
        Bodies with a sensor; None for all bodies with a specified temperature.
    dead : Mapping[str, int]
        Body -> time from which its sensor gives no readings.
    stuck : Mapping[str, int]
        Body -> time from which its sensor repeats its last reading.
    dates : tuple[tuple[int, str], ...] | None
        (time, event) of every event; None to draw one date for each event of the plan.
    words : tuple[str, ...]
        Command-line options of the simulation, without the seed.
    """

    start: int
    seconds: float
    interval: float
    seed: int = 0
    frames: int = 10
    coefficient_error: float = 0.0
    sensor_sigma: float = 0.05
    sensors: tuple[str, ...] | None = None
    dead: Mapping[str, int] = field(default_factory=dict)
    stuck: Mapping[str, int] = field(default_factory=dict)
    dates: tuple[tuple[int, str], ...] | None = None
    words: tuple[str, ...] = ()

    @property
    def times(self) -> np.ndarray:
        """Times of the readings within the life, (T,), in microseconds of TAI since 2000.

        Array dimensions: T times.
        """
        count = max(1, math.ceil(self.seconds / self.interval - 1e-9))
        return self.start + np.array([round(k * self.interval * MICRO) for k in range(count)], np.int64)


@dataclass(frozen=True, eq=False)
class SimulatedRecord:
    """Result of a simulated life.

    Array dimensions: R readings.

    Attributes
    ----------
    life : Life
        Random motions of the life.
    times : (R,) ndarray of int64
        Times of the readings of the monitor, in microseconds of TAI since 2000.
    readings : tuple[dict[str, Any], ...]
        Content of recovered.json for each reading.
    truth : Mapping[str, Any]
        True changes of the cameras at these times, nested as in JSON files.
    lost : tuple[tuple[int, str], ...]
        Time of each reading that could not be measured, and the reason.
    """

    life: Life
    times: np.ndarray
    readings: tuple[dict[str, Any], ...]
    truth: Mapping[str, Any]
    lost: tuple[tuple[int, str], ...]


def simulate_record(
    plan: OperationSetup, experiment: MonitorExperiment, what: Simulation, advance: Advance
) -> SimulatedRecord:
    """Draw the motions of a simulated life, trace and render its states, and recover the monitor's readings.

    Parameters
    ----------
    plan : OperationSetup
        Plan of the operation: the disturbances, and the effects of events.
    experiment : MonitorExperiment
        Monitor experiment of its instrument with its disturbances.
    what : Simulation
        Parameters of the simulation.
    advance : Advance
        Callback that receives the progress.
    """
    motions = experiment.prior
    assert motions is not None  # a plan states them
    causes = plan.operation.events
    life = drawn_life(motions, what.times, what.start, what.seed, causes, what.dates, what.coefficient_error)
    lost: list[tuple[int, str]] = []
    record = shared_detector(experiment, what.frames, what.seed)
    chunk = largest_piece(what.frames * math.prod(experiment.nominal_photons.shape))

    def leave(number: int, why: str) -> None:
        lost.append((int(life.times[number]), why))

    tables: list[ReadingTable] = []
    readings: list[dict[str, Any]] = []
    numbers: list[int] = []
    suspects: Mapping[str, CameraCrosstalk] | None = None
    how = ObservationOptions(record, chunk=chunk, omit=leave)
    advance(RENDER, 0, len(life.times))
    for first in range(0, len(life.times), chunk):
        piece = np.arange(first, min(first + chunk, len(life.times)))
        states = states_of(life.acting[piece], life.components, experiment.thermal)
        for observation in observe(experiment, states, how, piece):
            suspects = crosstalk(experiment, observation.recovery.shift_covariance[0]) if suspects is None else suspects
            readings += _readings(experiment, observation, what.frames, suspects)
            tables.append(
                reading_table(
                    observation.recovery,
                    experiment.cameras,
                    observation.truth,
                    experiment.ground,
                    experiment.disturbances,
                )
            )
            numbers += observation.numbers.tolist()
        advance(RENDER, int(piece[-1]) + 1, len(life.times))
    truth = ReadingTable.joined(tables).true() if tables else {}
    return SimulatedRecord(life, life.times[numbers], tuple(readings), truth, tuple(lost))


def _readings(
    experiment: MonitorExperiment, observation: Observation, frames: int, suspects: Mapping[str, CameraCrosstalk]
) -> Iterator[dict[str, Any]]:
    """Yield the monitor's results for each simulated state, as the content of recovered.json."""
    channels = tuple((channel.camera, channel.name) for channel in experiment.path.channels)
    common = channels, experiment.cameras, experiment.ground, experiment.disturbances
    centroid = experiment.resolved.job.analysis.centroid
    for k in range(len(observation.numbers)):
        reading = MonitorReading(*common, observation.recovery.at(slice(k, k + 1)), suspects, frames, centroid)
        yield rounded(reading.recovered_dict())


def write_simulated(
    folder: RunFolder, plan: OperationSetup, experiment: MonitorExperiment, what: Simulation, simulated: SimulatedRecord
) -> None:
    """Write the telemetry of a simulated life, and the YAML file that describes its tables, but not the truth.

    Parameters
    ----------
    folder : RunFolder
        Open folder.
    plan : OperationSetup
        Plan of the operation.
    experiment : MonitorExperiment
        Monitor experiment of its instrument.
    what : Simulation
        Parameters of the simulation.
    simulated : SimulatedRecord
        Result of the simulation.
    """
    folder.write_text(CONFIG, dump_yaml(plan.plain()))
    seconds = ((simulated.times - simulated.times[0]) / MICRO).tolist()
    last = simulated.readings[-1]
    numbers = {**last, "times_s": seconds, "series": list(simulated.readings)}
    folder.write_json(RESULTS["monitor"], described("recovered", numbers))
    folder.write_text(PASSES, f"UTC,run\n{utc_text(int(simulated.times[0]))},.\n")
    events = "".join(f"{utc_text(moment)},{name}\n" for moment, name in simulated.life.dates)
    folder.write_text(EVENTS, f"UTC,what\n{events}")
    sensed = sensed_temperatures(experiment.instrument.spec.temperature, what, simulated.life)
    heads = {body: f"T_{body.removeprefix('base/').replace('/', '_')}" for body in sensed}
    rows = [",".join(("UTC", *heads.values()))]
    for k, moment in enumerate(simulated.life.times.tolist()):
        cells = (
            "" if math.isnan(temperatures[k]) else f"{temperatures[k]:.{_KELVIN}f}" for temperatures in sensed.values()
        )
        rows.append(",".join((utc_text(moment), *cells)))
    folder.write_text(TEMPERATURES, "\n".join(rows) + "\n")
    columns = {
        body: {"column": head, "unit": "K", "sigma": f"{what.sensor_sigma:.12g} K"} for body, head in heads.items()
    }
    tables: list[dict[str, Any]] = [{"kind": "event", "files": EVENTS, "time": "UTC", "name": "what"}]
    if columns:
        tables.append({"kind": "temperature", "files": TEMPERATURES, "time": "UTC", "columns": columns})
    tables.append({"kind": "monitor", "files": PASSES, "time": "UTC", "name": "run"})
    folder.write_text(TELEMETRY, dump_yaml({"instrument": _portable_instrument(plan), "readings": tables}))


def _portable_instrument(plan: OperationSetup) -> str | dict[str, Any]:
    """Return the reference of a plan to its instrument, or the whole instrument if the plan contains it."""
    reference = plan.operation.instrument
    if not isinstance(reference, Inline):
        return reference
    job = plan.model
    plain = job.instrument.plain()
    plain.pop("disturbances", None)
    for name, site in job.instrument.cameras.items():
        plain["cameras"][name]["camera"] = job.cameras[site.camera].plain()
    if job.detector is not None:
        plain["monitor"]["area_ccd"]["detector"] = job.detector.plain()
    return plain


def sensed_temperatures(reference: float, what: Simulation, life: Life) -> dict[str, np.ndarray]:
    """Simulate the readings of each body's temperature sensor, (T,), in kelvin; NaN where it gives none.

    Array dimensions: T times.

    Parameters
    ----------
    reference : float
        Temperature of the instrument, in kelvin.
    what : Simulation
        Parameters of the simulation.
    life : Life
        Random motions of the life.
    """
    out: dict[str, np.ndarray] = {}
    for number, (body, change) in enumerate(life.temperatures.items()):
        if what.sensors is not None and body not in what.sensors:
            continue
        rng = np.random.default_rng(stream(what.seed, _SENSORS, number))
        values = np.round(reference + change + what.sensor_sigma * rng.standard_normal(len(change)), _KELVIN)
        if body in what.stuck:
            late = life.times >= what.stuck[body]
            before = np.flatnonzero(~late)
            values[late] = values[before[-1]] if len(before) else values[0]
        if body in what.dead:
            values[life.times >= what.dead[body]] = np.nan
        out[body] = values
    return out


def truth_numbers(plan: OperationSetup, what: Simulation, simulated: SimulatedRecord) -> dict[str, Any]:
    """Return the truth of a simulated life as plain data.

    It holds the traced changes of cameras, angle and ground, steps, coefficients and temperatures.

    Parameters
    ----------
    plan : OperationSetup
        Plan of the operation.
    what : Simulation
        Parameters of the simulation.
    simulated : SimulatedRecord
        Result of the simulation.
    """
    life = simulated.life
    steps = [
        {
            "time_utc": utc_text(step.time),
            "time_us": step.time,
            "cause": step.cause,
            "body": step.body,
            "event": step.event,
            "sizes": {
                f"{component.name} [{component.unit}]": float(size) / component.unit_size
                for component, size in zip(life.components, step.sizes, strict=True)
                if size != 0.0
            },
        }
        for step in life.steps
    ]
    return {
        "instrument": plan.model.instrument.name,
        "disturbances": plan.disturbances.name,
        "seed": what.seed,
        "times_us": simulated.times.tolist(),
        "times_utc": [utc_text(moment) for moment in simulated.times.tolist()],
        **simulated.truth,
        "steps": steps,
        "events": [{"time_utc": utc_text(moment), "event": name} for moment, name in life.dates],
        "coefficients": dict(life.coefficients),
        "temperature_times_us": life.times.tolist(),
        "temperature_changes_K": {body: temperatures.tolist() for body, temperatures in life.temperatures.items()},
        "sensors_dead": {body: utc_text(moment) for body, moment in what.dead.items()},
        "sensors_stuck": {body: utc_text(moment) for body, moment in what.stuck.items()},
        "lost": [{"time_utc": utc_text(moment), "reason": why} for moment, why in simulated.lost],
    }
