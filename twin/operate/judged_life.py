"""A simulated life followed reading by reading, as it would have been, and what was said of it held against the truth.

Four ways to know the cameras are compared at every reading: the calibration on the ground, kept; each reading by
itself; the operation with the readings up to then; and the operation with all readings. What was forecast at a reading
is compared with what came. The truth is read after all that.

What was said of a simulated life against its truth, as numbers, a table and a figure.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from analysis.arrays import Array
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from scenes.specs.operation import OperationSetup
from scenes.yaml.input_file import read_json
from twin.framework import svg
from twin.framework.artefact import Cell, SvgFigure, Table
from twin.framework.procedure import Advance
from twin.framework.report import Report, Section, answer
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.reported_estimate import Course, FilterResult
from twin.operate.record.entries import MICRO, Entry, FileContent, utc_text
from twin.operate.record.history import History, initialise_record
from twin.operate.record.telemetry import RESULTS, read_table_file, read_telemetry, tables_of

FOLLOW = "follow the readings"
METHODS = {
    "ground": "calibration on the ground, kept",
    "single": "each reading by itself",
    "filtered": "operation, readings so far",
    "smoothed": "operation, all readings",
}
"""Way to know the cameras -> what it is called."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What one way says at T times: values and standard deviations, (T, Q) in each quantity's unit; NaN for nothing."""

    values: Array
    sigmas: Array


@dataclass(frozen=True, eq=False)
class JudgedLife:
    """Four ways to know a simulated instrument, and the truth.

    Attributes
    ----------
    times : NDArray[np.int64]
        (T,) microseconds of TAI since 2000 of the readings.
    quantities : tuple[Quantity, ...]
        Q of them.
    true : Array
        (T, Q) in each quantity's unit.
    ways : Mapping[str, Estimate | Course]
        As `WAYS` -> what it says.
    horizon : float
        Of the forecasts, seconds.
    forecast : Estimate
        Made at each reading for the first reading that is not nearer than the horizon, (T, Q).
    came : Array
        (T, Q) what then was; NaN where the life is over before.
    interrupted : NDArray[np.bool_]
        (T,) whether an event came in between, which no forecast knows of.
    following : Following
        After the last reading.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    true: Array
    methods: Mapping[str, Estimate | Course]
    horizon: float
    forecast: Estimate
    updated: Array
    interrupted: NDArray[np.bool_]
    filter_result: FilterResult

    def errors(self, way: str) -> Array:
        """(T, Q) of one way, in each quantity's unit."""
        return self.methods[way].values - self.true

    def number(self, group: str, key: str) -> int:
        """Of a quantity.

        Parameters
        ----------
        group : str
            Camera, ``intersection_angle`` or ``ground``.
        key : str
            Which of its readings.
        """
        return next(k for k, quantity in enumerate(self.quantities) if (quantity.group, quantity.key) == (group, key))


def judged(plan: OperationSetup, files: Path, truth: Mapping[str, Any], advance: Advance) -> JudgedLife:
    """Follow a life in a record of its own, reading by reading.

    Parameters
    ----------
    plan : OperationSetup
        Of the operation.
    files : Path
        That says what the tables of the life hold.
    truth : Mapping[str, Any]
        Of the life, plain data of its file.
    advance : Advance
        Told of the progress.
    """
    with tempfile.TemporaryDirectory() as place:
        initialise_record(place, plan.model, simulated=True)
        with History(place) as history:
            steps = StepwiseIngest(history, files)
            times = steps.times
            horizon = plan.operation.horizon
            ahead = np.searchsorted(times, times + round(horizon * MICRO))
            now: list[Course] = []
            later: list[Course] = []
            operation: Operation | None = None
            advance(FOLLOW, 0, len(times))
            for k, moment in enumerate(times.tolist()):
                steps.take(moment)
                operation = Operation(history, plan) if operation is None else operation.updated()
                filter_result = operation.filter_readings()
                now.append(filter_result.now)
                target = times[ahead[k]] if ahead[k] < len(times) else moment + round(horizon * MICRO)
                later.append(operation.forecast(np.array([target])))
                advance(FOLLOW, k + 1, len(times))
            assert operation is not None  # a life has a reading
            smoothed = operation.smoothed(times)
            ground = _prior(operation, times)
    # the record keeps no errors on the ground of a reading, the run that read it does
    single = _single(read_json(files.parent / RESULTS["monitor"])["series"], operation.quantities)
    quantities = operation.quantities
    true = true_changes(truth, quantities, times)
    updated = np.full_like(true, np.nan)
    there = ahead < len(times)
    updated[there] = true[ahead[there]]
    targets = np.where(there, times[np.minimum(ahead, len(times) - 1)], times)
    dates = np.array([time for time, *_ in filter_result.events], np.int64)
    interrupted = np.any((dates > times[:, None]) & (dates <= targets[:, None]), axis=1)
    filtered, forecast = (
        Estimate(*(np.concatenate([getattr(one, part) for one in courses]) for part in ("values", "sigmas")))
        for courses in (now, later)
    )
    methods: dict[str, Estimate | Course] = {"ground": ground, "single": single}
    methods |= {"filtered": filtered, "smoothed": smoothed}
    return JudgedLife(times, quantities, true, methods, horizon, forecast, updated, interrupted, filter_result)


def _prior(operation: Operation, times: NDArray[np.int64]) -> Estimate:
    """What is known without any reading: nothing has changed, but for what is stated to move."""
    series_filter, rows = operation.model.series_filter, operation.model.rows
    seconds = ((times - times[0]) / MICRO).tolist()
    start = series_filter.start(seconds[0])
    found = [series_filter.parameters(start, time) for time in seconds]
    values = np.array([mean for mean, _ in found]) @ rows.T
    spread = np.array([covariance for _, covariance in found])
    return Estimate(values, np.sqrt(np.einsum("qi,tij,qj->tq", rows, spread, rows)))


class StepwiseIngest:
    """The files of a life, taken into a record up to one moment after the other.

    Parameters
    ----------
    history
        The record.
    file
        That says what the tables hold.
    """

    def __init__(self, history: History, file: Path) -> None:
        self._history, self._taken = history, -(2**62)
        spec = read_telemetry(file, history)
        self._given = [
            read_table_file(table, path, history) for table in spec.readings for path in tables_of(spec, table)
        ]
        every = {entry.time for given in self._given for entry in _entries(given) if entry.kind == "monitor"}
        self.times = np.array(sorted(every), np.int64)

    def take(self, until: int) -> None:
        """Take what came since the last time.

        Parameters
        ----------
        until : int
            Microseconds of TAI since 2000.
        """
        for given in self._given:
            own = [entry for entry in _entries(given) if self._taken < entry.time <= until]
            if own:
                self._history.ingest(FileContent(given.file, given.sha256, given.meaning, own, given.frames))
        self._taken = until


def _entries(given: FileContent) -> list[Entry]:
    return [item for item in given.items if isinstance(item, Entry)]


def true_changes(truth: Mapping[str, Any], quantities: Sequence[Quantity], times: NDArray[np.int64]) -> Array:
    """(T, Q) true changes in each quantity's unit.

    Parameters
    ----------
    truth : Mapping[str, Any]
        Plain data of a life's file.
    quantities : Sequence[Quantity]
        Q of them.
    times : NDArray[np.int64]
        (T,) at which it is known, microseconds of TAI since 2000.
    """
    at = {moment: k for k, moment in enumerate(truth["times_us"])}
    own = [at[moment] for moment in times.tolist()]
    columns = []
    for quantity in quantities:
        group = (
            truth[quantity.group] if quantity.group in (ANGLE_GROUP, GROUND_GROUP) else truth["cameras"][quantity.group]
        )
        columns.append(np.array(group[quantity.key])[own])
    return np.stack(columns, axis=1)


def _single(readings: Sequence[Mapping[str, Any]], quantities: Sequence[Quantity]) -> Estimate:
    """What each reading says by itself: that of the best estimator for stated disturbances."""
    values, sigmas = [], []
    for read in readings:
        groups = {**read["cameras"], **{name: read[name] for name in (ANGLE_GROUP, GROUND_GROUP) if name in read}}
        own = [groups[quantity.group]["posterior"] for quantity in quantities]
        values.append([found[one.key] for found, one in zip(own, quantities, strict=True)])
        sigmas.append([found[f"{one.key}_sigma"] for found, one in zip(own, quantities, strict=True)])
    return Estimate(np.array(values), np.array(sigmas))


def covered(error: Array, sigma: Array, times: float) -> tuple[int, int]:
    """How many errors lie within so many sigmas, and of how many; NaN is left out.

    Parameters
    ----------
    error : Array
        Of any shape.
    sigma : Array
        likewise.
    times : float
        sigmas.
    """
    ratio = np.abs(error / sigma)
    known = np.isfinite(ratio)
    return int(np.count_nonzero(ratio[known] <= times)), int(known.sum())


def rms(error: Array) -> float:
    """Root mean square of what is known of errors."""
    return float(np.sqrt(np.nanmean(np.square(error)))) if np.any(np.isfinite(error)) else math.nan


SHARES = {1.0: math.erf(math.sqrt(0.5)), 2.0: math.erf(math.sqrt(2.0))}
"""Sigmas -> share of normal errors within so many."""
CHANCE = 1e-3
"""That a share of independent normal numbers lies beyond the limits that are told."""
SHOWN = ((ANGLE_GROUP, "change_arcsec"), (GROUND_GROUP, "height_m"))
"""Group and key of what the figure shows, of instruments that have it, beside a camera's change of focal length."""
_DAY = 86_400 * MICRO
_YEAR = 365.25 * _DAY
FORECAST = "forecast"
_COVERED = ("filtered", FORECAST)
"""Of which the table tells how often sigma holds."""


def judged_numbers(life: JudgedLife) -> dict[str, Any]:
    """As plain data: for each quantity and way the RMS error, errors and sigmas at all readings and the shares within
    one and two sigmas, those of the forecasts, and what the operation said of its predictions, of temperatures, sensors
    and jumps.

    Parameters
    ----------
    life : JudgedLife
        That was followed.
    """
    told: dict[str, dict[str, Any]] = {}
    for number, quantity in enumerate(life.quantities):
        own = {
            way: _error_summary(life.errors(way)[:, number], said.sigmas[:, number])
            for way, said in life.methods.items()
        }
        for name, which in ((FORECAST, ~life.interrupted), ("forecast_over_events", life.interrupted)):
            error = (life.forecast.values - life.updated)[which, number]
            own[name] = _error_summary(error, life.forecast.sigmas[which, number])
        told.setdefault(quantity.group, {})[quantity.key] = own
    filter_result = life.filter_result.to_dict()
    scores = life.filter_result.scores
    return {
        "readings": len(life.times),
        "first_utc": utc_text(int(life.times[0])),
        "last_utc": utc_text(int(life.times[-1])),
        "times_utc": [utc_text(int(time)) for time in life.times],
        "horizon_s": life.horizon,
        "quantities": told,
        "predictions": {
            "components": scores.components,
            "within_one": scores.within_one / scores.components,
            "within_one_limits": list(likely_shares(scores.components, 1.0)),
            "within_two": scores.within_two / scores.components,
            "within_two_limits": list(likely_shares(scores.components, 2.0)),
            "limits_hold_but_for": CHANCE,
        },
        "explained_by_temperatures": filter_result["explained"],
        "sensors": filter_result["sensors"],
        "jumps": filter_result["jumps"],
    }


def _error_summary(error: Any, sigma: Any) -> dict[str, Any]:
    """RMS and coverage of what is known."""
    value = rms(error)
    out: dict[str, Any] = {"rms": value if math.isfinite(value) else None}
    out |= {"errors": _rounded(error), "sigmas": _rounded(sigma)}
    for times, name in ((1.0, "within_one"), (2.0, "within_two")):
        inside, known = covered(error, sigma, times)
        out[name] = inside / known if known else None
        out["known"] = known
    return out


def _rounded(values: Any) -> list[float | None]:
    """To four digits, with nothing where nothing is known."""
    return [float(f"{value:.4g}") if math.isfinite(value) else None for value in np.asarray(values).tolist()]


def likely_shares(count: int, times: float) -> tuple[float, float]:
    """Least and largest share of independent normal numbers within so many sigmas, but for a chance of ``CHANCE``.

    Parameters
    ----------
    count : int
        Of the numbers.
    times : float
        sigmas.
    """
    low, high = binom.ppf([0.5 * CHANCE, 1.0 - 0.5 * CHANCE], count, SHARES[times])
    return float(low) / count, float(high) / count


def judged_report(life: JudgedLife, name: str) -> Report:
    """The report.

    Parameters
    ----------
    life : JudgedLife
        That was followed.
    name : str
        Of the instrument.
    """
    numbers = judged_numbers(life)
    shown = _shown(life)
    verdict, lead = answer(*_sentences(life, numbers, shown))
    years = (int(life.times[-1]) - int(life.times[0])) / _YEAR
    facts = (
        ("instrument", name),
        ("readings", f"{len(life.times)} in {years:.2g} years, from {utc_text(int(life.times[0]))}"),
        ("forecasts", f"{life.horizon / 86_400.0:.3g} days ahead"),
    )
    caption = (
        "Errors are estimate minus truth. The instrument has changed since its calibration on the ground; a reading "
        "by itself is read with what is stated to move; the operation follows readings, temperatures and events. "
        "Errors at neighbouring times are alike: shares scatter more than those of as many independent errors."
    )
    figure = SvgFigure("with_and_without", "With and without the twin's operation", caption, judged_svg(life, shown))
    section = Section("Errors over the years", (), (figure,), name="errors")
    return Report(f"{name}: what was said of a simulated life", verdict, lead, facts, _table(life), (section,))


def _shown(life: JudgedLife) -> tuple[tuple[str, str], ...]:
    """Group and key of what the figure shows."""
    names = [(quantity.group, quantity.key) for quantity in life.quantities]
    focal = next(name for name in names if name[1] == "d_f_um")
    return (*(one for one in SHOWN if one in names), focal)


def _sentences(life: JudgedLife, numbers: dict[str, Any], shown: Sequence[tuple[str, str]]) -> list[str]:
    told = []
    for group, key in shown[-2:] if len(shown) > 1 else shown:
        one, said = life.quantities[life.number(group, key)], numbers["quantities"][group][key]
        values = " / ".join(_short(said[way]["rms"]) for way in METHODS)
        told.append(f"{group} {one.parameter.symbol} {values} {one.parameter.unit}")
    made = numbers["predictions"]
    low, high = made["within_one_limits"]
    out = [
        f"RMS errors with the calibration on the ground / each reading by itself / the operation / all its readings: "
        f"{', '.join(told)}",
        f"of {made['components']} predictions of a reading before it came {100 * made['within_one']:.1f} % are within "
        f"1 σ and {100 * made['within_two']:.1f} % within 2 σ; chance allows {100 * low:.1f} to {100 * high:.1f} % "
        "within 1 σ",
    ]
    group, key = shown[-1]
    explained = numbers["explained_by_temperatures"].get(f"{group} {key}")
    if explained is not None:
        symbol = life.quantities[life.number(group, key)].parameter.symbol
        out.append(f"temperatures explain {100 * explained:.0f} % of the scatter of {group} {symbol}")
    bad = [one for one in numbers["sensors"] if one["state"] != "ok"]
    out += [f"the sensor of {one['body']} is {one['state']}: {one['reason']}" for one in bad]
    return out


def _table(life: JudgedLife) -> Table:
    """RMS errors by way, and shares within one and two sigmas."""
    heads = ("quantity", *("RMS: " + way for way in METHODS), "forecast")
    heads += tuple(f"{way} within {n} σ [%]" for way in _COVERED for n in (1, 2))
    rows: list[list[Cell]] = []
    quantities = judged_numbers(life)["quantities"]
    for quantity in life.quantities:
        said = quantities[quantity.group][quantity.key]
        row: list[Cell] = [f"{quantity.group} {quantity.parameter.label}"]
        row += [_cell(said[way]["rms"]) for way in (*METHODS, FORECAST)]
        for way in _COVERED:
            row += [_cell(said[way][key], 100.0) for key in ("within_one", "within_two")]
        rows.append(row)
    caption = "RMS errors against the truth by four ways to know the cameras, and how often sigma holds them."
    return Table("ways", "Four ways to know the cameras", caption, heads, rows, digits=3)


def _cell(value: float | None, times: float = 1.0) -> Cell:
    return "" if value is None else times * value


def _short(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2g}"


def judged_svg(life: JudgedLife, quantities: Sequence[tuple[str, str]]) -> str:
    """Errors of some quantities by four ways to know them, with one and two sigmas, over the years.

    Parameters
    ----------
    life : JudgedLife
        That was followed.
    quantities : Sequence[tuple[str, str]]
        Group and key of each, one column for each.
    """
    with svg.look("operation"):
        figure = svg.new_figure(8.4)
        grid = figure.subplots(len(METHODS), len(quantities), sharex=True, squeeze=False)
        for column, name in enumerate(quantities):
            number = life.number(*name)
            one = life.quantities[number]
            own = "" if one.group in (ANGLE_GROUP, GROUND_GROUP) else f"{one.group} "
            for row, (way, title) in enumerate(METHODS.items()):
                axes = grid[row, column]
                _panel(axes, life, way, number)
                size = f"RMS {rms(life.errors(way)[:, number]):.2g} {one.parameter.unit}"
                axes.set_title(f"{title}: {size}", loc="left", fontsize=8.0)
                axes.set_ylabel(f"error of {own}{one.parameter.label}")
                if row > 2:  # the operation's two panels are compared with each other
                    axes.sharey(grid[row - 1, column])
            grid[-1, column].set_xlabel("years in operation")
        svg.shared_legend(figure, grid[-1, 0])
        figure.align_ylabels()
        return svg.to_svg(figure)


def _panel(axes: Any, life: JudgedLife, way: str, number: int) -> None:
    """Errors of one way with its sigma, when events came, and between which readings jumps that were told."""
    years = (life.times - life.times[0]) / _YEAR
    error, sigma = life.errors(way)[:, number], life.methods[way].sigmas[:, number]
    svg.gridded(axes)
    axes.axhline(0.0, color=svg.GREY, lw=0.7)
    for times, colour, name in ((2.0, svg.SHADE, "±2σ"), (1.0, svg.LIGHT, "±σ")):
        if np.any(np.isfinite(sigma)):
            axes.fill_between(years, -times * sigma, times * sigma, color=colour, lw=0.0, label=name)
    for k, (moment, *_) in enumerate(life.filter_result.events):
        axes.axvline((moment - life.times[0]) / _YEAR, color=svg.ORANGE, lw=0.9, ls="--", label="" if k else "event")
    for k, jump in enumerate(life.filter_result.jumps):
        low, high = ((moment - life.times[0]) / _YEAR for moment in (jump.after_us, jump.until_us))
        axes.axvspan(low, high, color=svg.PURPLE, alpha=0.5, lw=1.0, label="" if k else "jump that was told")
    axes.plot(years, error, color=svg.BLUE, lw=1.1, label="estimate minus truth")
