"""An instrument in operation without one: its life is drawn, every reading is rendered and recovered, and what a real
instrument would send down is written as files, which the record takes as it takes any others.

What only a simulation knows stands in a file of its own, which nothing of the operation reads.

A life that could have been: amounts of every stated motion over time, drawn by the laws of their disturbances.

Laws without steps are drawn by `scenes.models.drawn_motions`; steps come by chance at a stated mean rate, or at the
dates of events. Nothing here uses the filter or the smoother that such lives test.
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
from scenes.models.disturbances import Component, StatedMotions, causes_of, drawn_motions, states_of
from scenes.specs.operation import OperationSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.procedure import Advance
from twin.framework.random_streams import stream
from twin.framework.reference_frames import described
from twin.framework.run_folder import RunFolder
from twin.main_job.monitor_reading import MonitorReading, stated
from twin.monitor.crosstalk import CameraCrosstalk, crosstalk
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_memory import largest_piece
from twin.monitor.observation import Observation, Observing, observe, one_detector
from twin.monitor.reading_table import ReadingTable, reading_table
from twin.operate.record.entries import MICRO, utc_text
from twin.operate.record.telemetry import CONFIG, RESULTS

Moments = NDArray[np.int64]

_MOTIONS, _JUMPS, _EVENTS, _DATES, _COEFFICIENTS = 10, 11, 12, 13, 14
"""Random streams of a seed; the exposures of the detectors have the first ones (`MonitorExperiment.frames_after`)."""
_MARGIN = 0.1
"""Part of a life at its beginning and its end in which no date of an event is drawn: something has to be seen of what
it does."""


@dataclass(frozen=True)
class Step:
    """Motions that stepped at one moment.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    cause : str
        Of the disturbances file.
    body : str
        Whose motions; empty where those of all bodies of the cause stepped, by an event.
    event : str
        That made them step; empty for a jump at a time that nobody knows.
    sizes : Array
        (M,) SI, zero for what did not step.
    """

    time: int
    cause: str
    body: str
    event: str
    sizes: Array


@dataclass(frozen=True, eq=False)
class Life:
    """What every stated motion of an instrument does at T times.

    Attributes
    ----------
    times : Moments
        (T,) microseconds of TAI since 2000, rising.
    components : tuple[Component, ...]
        M of them.
    drawn : Array
        (T, M) SI, as the laws say and without steps.
    steps : tuple[Step, ...]
        In the order of time.
    dates : tuple[tuple[int, str], ...]
        When which event came: microseconds, name.
    coefficients : Mapping[str, float]
        Body with a temperature -> by which part its temperature does more to light than is computed.
    """

    times: Moments
    components: tuple[Component, ...]
    drawn: Array
    steps: tuple[Step, ...]
    dates: tuple[tuple[int, str], ...]
    coefficients: Mapping[str, float]

    @cached_property
    def amounts(self) -> Array:
        """(T, M) SI, steps included."""
        out = self.drawn.copy()
        for step in self.steps:
            out[self.times >= step.time] += step.sizes
        return out

    @cached_property
    def acting(self) -> Array:
        """(T, M) SI as they act on light: of a temperature that a sensor would read, more or less of it by the body's
        coefficient.
        """
        factor = [1.0 + self.coefficients.get(c.body, 0.0) * (c.kind == "temperature") for c in self.components]
        return np.asarray(self.amounts * np.array(factor))

    @cached_property
    def temperatures(self) -> dict[str, Array]:
        """Body -> (T,) change of its temperature against the instrument's, kelvin."""
        out: dict[str, Array] = {}
        for k, component in enumerate(self.components):
            if component.kind == "temperature":
                out[component.body] = out.get(component.body, np.zeros(len(self.times))) + self.amounts[:, k]
        return out


def drawn_life(
    stated: StatedMotions,
    times: Moments,
    zero: int,
    seed: int,
    causes: Mapping[str, Sequence[str]],
    dates: Sequence[tuple[int, str]] | None = None,
    coefficient_error: float = 0.0,
) -> Life:
    """Draw what every motion does.

    Parameters
    ----------
    stated : StatedMotions
        The motions and their laws of time.
    times : Moments
        (T,) microseconds of TAI since 2000, rising.
    zero : int
        From which the laws count their seconds, likewise.
    seed : int
        Of everything that is drawn; what one cause draws does not depend on the others.
    causes : Mapping[str, Sequence[str]]
        Event -> names of the causes whose motions step when it comes.
    dates : Sequence[tuple[int, str]] | None
        When which event comes; None to draw one date for each.
    coefficient_error : float
        Standard deviation of what a body's temperature does to light beyond what is computed, relative.
    """
    seconds = (times - zero) / MICRO
    drawn = drawn_motions(stated, seconds, lambda number: np.random.default_rng(stream(seed, _MOTIONS, number)))
    own, steps = causes_of(stated), list[Step]()
    for number, (cause, where) in enumerate(own.items()):
        steps += _jumps(stated, cause, where, times, np.random.default_rng(stream(seed, _JUMPS, number)))
    updated = _drawn_dates(sorted(causes), times, seed) if dates is None else tuple(sorted(dates))
    for number, (moment, name) in enumerate(updated):
        for k, cause in enumerate(causes.get(name, ())):
            rng = np.random.default_rng(stream(seed, _EVENTS, number, k))
            steps.append(Step(moment, cause, "", name, _step(stated, own.get(cause, []), rng)))
    rng = np.random.default_rng(stream(seed, _COEFFICIENTS))
    warm = dict.fromkeys(c.body for c in stated.components if c.kind == "temperature")
    coefficients = dict(zip(warm, (coefficient_error * rng.standard_normal(len(warm))).tolist(), strict=True))
    return Life(times, stated.components, drawn, tuple(sorted(steps, key=_when)), updated, coefficients)


def _jumps(
    stated: StatedMotions, cause: str, where: Sequence[int], times: Moments, rng: np.random.Generator
) -> Iterator[Step]:
    """Steps of a cause whose law is a jump with a mean time between two: those of one body come together."""
    every = stated.laws[where[0]].jump
    if every is None:
        return
    span = (int(times[-1]) - int(times[0])) / MICRO
    for body in dict.fromkeys(stated.components[k].body for k in where):
        own = [k for k in where if stated.components[k].body == body]
        for second in np.sort(rng.uniform(0.0, span, rng.poisson(span / every))).tolist():
            yield Step(int(times[0]) + round(second * MICRO), cause, body, "", _step(stated, own, rng))


def _step(stated: StatedMotions, where: Sequence[int], rng: np.random.Generator) -> Array:
    """(M,) SI by which some motions step, together as they are correlated; others by nothing."""
    out = np.zeros(len(stated.components))
    root = covariance_root(stated.correlation[np.ix_(where, where)])
    out[list(where)] = rng.standard_normal(len(where)) @ root * stated.sigma[list(where)]
    return out


def _drawn_dates(events: Sequence[str], times: Moments, seed: int) -> tuple[tuple[int, str], ...]:
    """One date for each event, as likely at any time of a life but for its ends."""
    first, span = int(times[0]), int(times[-1]) - int(times[0])
    rng = np.random.default_rng(stream(seed, _DATES))
    shares = rng.uniform(_MARGIN, 1.0 - _MARGIN, len(events)).tolist()
    return tuple(sorted((first + round(share * span), name) for share, name in zip(shares, events, strict=True)))


def _when(step: Step) -> tuple[int, str, str]:
    return step.time, step.cause, step.body


FOLDER = "simulated"
"""Of a record in a folder: the files that its readings are taken from."""
TELEMETRY, LIFE = "telemetry.yaml", "life"
TEMPERATURES, PASSES, EVENTS = "temperatures.csv", "passes.csv", "events.csv"
RENDER = "render and recover"
_SENSORS = 15
"""Random stream of the sensors' errors."""
_KELVIN = 4
"""Decimals of a temperature in kelvin: sensors show no more, and few less."""


@dataclass(frozen=True)
class Simulation:
    """What is simulated.

    Attributes
    ----------
    start : int
        Of the first reading, microseconds of TAI since 2000; the laws of time count from it.
    seconds : float
        That the life takes.
    every : float
        From one reading of the monitor to the next, seconds; the temperatures are read with it.
    seed : int
        Of everything that is drawn.
    frames : int
        Of each exposure.
    coefficient_error : float
        Standard deviation, from body to body, of what a temperature does to light beyond what is computed, relative.
    sensor_sigma : float
        Of a sensor of temperature, kelvin.
    sensors : tuple[str, ...] | None
        Bodies that have one; None for all that are stated to get warmer.
    dead : Mapping[str, int]
        Body -> moment from which on its sensor says nothing; stuck: from which on it repeats what it said last.
    dates : tuple[tuple[int, str], ...] | None
        When which event came; None to draw one date for each of the plan's.
    words : tuple[str, ...]
        By which a command asks for it, all but the seed.
    """

    start: int
    seconds: float
    every: float
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
        """(T,) microseconds of TAI since 2000 of the readings, before the life is over."""
        count = max(1, math.ceil(self.seconds / self.every - 1e-9))
        return self.start + np.array([round(k * self.every * MICRO) for k in range(count)], np.int64)


@dataclass(frozen=True, eq=False)
class SimulatedRecord:
    """What came of a simulated life.

    Attributes
    ----------
    life : Life
        As it was drawn.
    times : np.ndarray
        (R,) microseconds of TAI since 2000 of the readings of the monitor.
    readings : tuple[dict[str, Any], ...]
        What recovered.json has of each.
    truth : Mapping[str, Any]
        What the cameras truly did at these times, as JSON files nest it.
    lost : tuple[tuple[int, str], ...]
        Moment of a reading that could not be, and why.
    """

    life: Life
    times: np.ndarray
    readings: tuple[dict[str, Any], ...]
    truth: Mapping[str, Any]
    lost: tuple[tuple[int, str], ...]


def simulate_record(
    plan: OperationSetup, experiment: MonitorExperiment, what: Simulation, advance: Advance
) -> SimulatedRecord:
    """Draw a life, trace and render its states, and recover what the monitor reads of them.

    Parameters
    ----------
    plan : OperationSetup
        Of the operation: what moves, and what events do.
    experiment : MonitorExperiment
        On its instrument, with its disturbances.
    what : Simulation
        Is simulated.
    advance : Advance
        Told of the progress.
    """
    motions = experiment.stated
    assert motions is not None  # a plan states them
    causes = plan.operation.events
    life = drawn_life(motions, what.times, what.start, what.seed, causes, what.dates, what.coefficient_error)
    lost: list[tuple[int, str]] = []
    record = one_detector(experiment, what.frames, what.seed)
    chunk = largest_piece(what.frames * math.prod(experiment.nominal_photons.shape))

    def leave(number: int, why: str) -> None:
        lost.append((int(life.times[number]), why))

    tables: list[ReadingTable] = []
    readings: list[dict[str, Any]] = []
    numbers: list[int] = []
    suspects: Mapping[str, CameraCrosstalk] | None = None
    how = Observing(record, chunk=chunk, leave=leave)
    advance(RENDER, 0, len(life.times))
    for first in range(0, len(life.times), chunk):
        piece = np.arange(first, min(first + chunk, len(life.times)))
        states = states_of(life.acting[piece], life.components, experiment.thermal)
        for found in observe(experiment, states, how, piece):
            suspects = crosstalk(experiment, found.recovery.shift_covariance[0]) if suspects is None else suspects
            readings += _readings(experiment, found, what.frames, suspects)
            tables.append(
                reading_table(
                    found.recovery, experiment.cameras, found.truth, experiment.ground, experiment.disturbances
                )
            )
            numbers += found.numbers.tolist()
        advance(RENDER, int(piece[-1]) + 1, len(life.times))
    truth = ReadingTable.joined(tables).true() if tables else {}
    return SimulatedRecord(life, life.times[numbers], tuple(readings), truth, tuple(lost))


def _readings(
    experiment: MonitorExperiment, found: Observation, frames: int, suspects: Mapping[str, CameraCrosstalk]
) -> Iterator[dict[str, Any]]:
    """What recovered.json has of each state."""
    channels = tuple((channel.camera, channel.name) for channel in experiment.path.channels)
    told = channels, experiment.cameras, experiment.ground, experiment.disturbances
    centroid = experiment.resolved.job.analysis.centroid
    for k in range(len(found.numbers)):
        one = MonitorReading(*told, found.recovery.at(slice(k, k + 1)), suspects, frames, centroid)
        yield stated(one.recovered_dict())


def write_simulated(
    folder: RunFolder, plan: OperationSetup, experiment: MonitorExperiment, what: Simulation, found: SimulatedRecord
) -> None:
    """Write what the instrument would send down, and a file that says what its tables hold; not the truth.

    Parameters
    ----------
    folder : RunFolder
        open.
    plan : OperationSetup
        Of the operation.
    experiment : MonitorExperiment
        On its instrument.
    what : Simulation
        Was simulated.
    found : Recorded
        What came of it.
    """
    folder.write_text(CONFIG, dump_yaml(plan.plain()))
    seconds = ((found.times - found.times[0]) / MICRO).tolist()
    last = found.readings[-1]
    numbers = {**last, "times_s": seconds, "series": list(found.readings)}
    folder.write_json(RESULTS["monitor"], described("recovered", numbers))
    folder.write_text(PASSES, f"UTC,run\n{utc_text(int(found.times[0]))},.\n")
    events = "".join(f"{utc_text(moment)},{name}\n" for moment, name in found.life.dates)
    folder.write_text(EVENTS, f"UTC,what\n{events}")
    sensed = sensed_temperatures(experiment.instrument.spec.temperature, what, found.life)
    heads = {body: f"T_{body.removeprefix('base/').replace('/', '_')}" for body in sensed}
    rows = [",".join(("UTC", *heads.values()))]
    for k, moment in enumerate(found.life.times.tolist()):
        cells = ("" if math.isnan(own[k]) else f"{own[k]:.{_KELVIN}f}" for own in sensed.values())
        rows.append(",".join((utc_text(moment), *cells)))
    folder.write_text(TEMPERATURES, "\n".join(rows) + "\n")
    columns = {
        body: {"column": head, "unit": "K", "sigma": f"{what.sensor_sigma:.12g} K"} for body, head in heads.items()
    }
    tables: list[dict[str, Any]] = [{"kind": "event", "files": EVENTS, "time": "UTC", "name": "what"}]
    if columns:
        tables.append({"kind": "temperature", "files": TEMPERATURES, "time": "UTC", "columns": columns})
    tables.append({"kind": "monitor", "files": PASSES, "time": "UTC", "name": "run"})
    folder.write_text(TELEMETRY, dump_yaml({"instrument": plan.operation.instrument, "readings": tables}))


def sensed_temperatures(reference: float, what: Simulation, life: Life) -> dict[str, np.ndarray]:
    """Body -> (T,) what its sensor says, kelvin; NaN where it says nothing.

    Parameters
    ----------
    reference : float
        Temperature of the instrument, kelvin.
    what : Simulation
        Is simulated.
    life : Life
        As it was drawn.
    """
    out: dict[str, np.ndarray] = {}
    for number, (body, change) in enumerate(life.temperatures.items()):
        if what.sensors is not None and body not in what.sensors:
            continue
        rng = np.random.default_rng(stream(what.seed, _SENSORS, number))
        said = np.round(reference + change + what.sensor_sigma * rng.standard_normal(len(change)), _KELVIN)
        if body in what.stuck:
            late = life.times >= what.stuck[body]
            before = np.flatnonzero(~late)
            said[late] = said[before[-1]] if len(before) else said[0]
        if body in what.dead:
            said[life.times >= what.dead[body]] = np.nan
        out[body] = said
    return out


def truth_numbers(plan: OperationSetup, what: Simulation, found: SimulatedRecord) -> dict[str, Any]:
    """What only the simulation knows, as plain data: changes of cameras, angle and ground by the exact trace, steps,
    coefficients and temperatures.

    Parameters
    ----------
    plan : OperationSetup
        Of the operation.
    what : Simulation
        Was simulated.
    found : Recorded
        What came of it.
    """
    life = found.life
    steps = [
        {
            "time_utc": utc_text(step.time),
            "time_us": step.time,
            "cause": step.cause,
            "body": step.body,
            "event": step.event,
            "sizes": {
                f"{one.name} [{one.unit}]": float(size) / one.unit_size
                for one, size in zip(life.components, step.sizes, strict=True)
                if size != 0.0
            },
        }
        for step in life.steps
    ]
    return {
        "instrument": plan.model.instrument.name,
        "disturbances": plan.disturbances.name,
        "seed": what.seed,
        "times_us": found.times.tolist(),
        "times_utc": [utc_text(moment) for moment in found.times.tolist()],
        **found.truth,
        "steps": steps,
        "events": [{"time_utc": utc_text(moment), "event": name} for moment, name in life.dates],
        "coefficients": dict(life.coefficients),
        "temperature_times_us": life.times.tolist(),
        "temperature_changes_K": {body: own.tolist() for body, own in life.temperatures.items()},
        "sensors_dead": {body: utc_text(moment) for body, moment in what.dead.items()},
        "sensors_stuck": {body: utc_text(moment) for body, moment in what.stuck.items()},
        "lost": [{"time_utc": utc_text(moment), "reason": why} for moment, why in found.lost],
    }
