"""Comparison of the estimates of a simulated life with its truth, as numbers, a table and a figure.

A life is the simulated operation of an instrument over a mission. It is filtered reading by reading. Four estimates of
the cameras are compared at every reading: the ground calibration, the single reading, the filtered estimate from the
readings so far, and the smoothed estimate from all readings. Forecasts are compared with the later true state. The
truth is read only after all estimates have been made.
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
    "ground": "ground calibration",
    "single": "single readings",
    "filtered": "filtered estimate",
    "smoothed": "smoothed estimate",
}
"""Names in the report of the four compared estimates, by key."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values and standard deviations (T, Q) of one estimate, in each quantity's unit; NaN where unknown.

    Array dimensions: T times, Q quantities.
    """

    values: Array
    sigmas: Array


@dataclass(frozen=True, eq=False)
class JudgedLife:
    """Four estimates of the state of a simulated instrument over its life, and the truth.

    Array dimensions: T times.

    Attributes
    ----------
    times : (T,) ndarray of int64
        Times of the readings, in microseconds of TAI since 2000.
    quantities : tuple[Quantity, ...]
        The Q quantities.
    true : (T, Q) ndarray
        True changes, in each quantity's unit.
    methods : Mapping[str, Estimate | Course]
        Key in `METHODS` -> estimate at the times of the readings.
    horizon : float
        Horizon of the forecasts, in seconds.
    forecast : Estimate
        Forecast (T, Q) made at each reading for the first reading at least a horizon later.
    outcomes : (T, Q) ndarray
        True changes at the forecast times; NaN where the life ends before.
    interrupted : (T,) ndarray of bool
        True where an event occurred between the reading and the forecast time, which no forecast can predict.
    filter_result : FilterResult
        Result of filtering all readings.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    true: Array
    methods: Mapping[str, Estimate | Course]
    horizon: float
    forecast: Estimate
    outcomes: Array
    interrupted: NDArray[np.bool_]
    filter_result: FilterResult

    def errors(self, method: str) -> Array:
        """Return the errors (T, Q) of an estimate, in each quantity's unit.

        Array dimensions: T times, Q quantities.
        """
        return self.methods[method].values - self.true

    def number(self, group: str, key: str) -> int:
        """Return the index of a quantity.

        Parameters
        ----------
        group : str
            Camera, ``intersection_angle`` or ``ground``.
        key : str
            Key of the quantity in the group.
        """
        return next(k for k, quantity in enumerate(self.quantities) if (quantity.group, quantity.key) == (group, key))


def judged(plan: OperationSetup, files: Path, truth: Mapping[str, Any], advance: Advance) -> JudgedLife:
    """Estimate a simulated life reading by reading in a temporary record, and compare it with the truth.

    Parameters
    ----------
    plan : OperationSetup
        Plan of operation of the instrument.
    files : Path
        YAML file that describes the tables of the life.
    truth : Mapping[str, Any]
        Truth of the life: the content of its truth file as nested mappings and lists.
    advance : Advance
        Callback that receives the progress.
    """
    with tempfile.TemporaryDirectory() as folder:
        initialise_record(folder, plan.model, simulated=True)
        with History(folder) as history:
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
    # the record has no ground errors of a reading; its run folder has
    single = _single(read_json(files.parent / RESULTS["monitor"])["series"], operation.quantities)
    quantities = operation.quantities
    true = true_changes(truth, quantities, times)
    outcomes = np.full_like(true, np.nan)
    there = ahead < len(times)
    outcomes[there] = true[ahead[there]]
    targets = np.where(there, times[np.minimum(ahead, len(times) - 1)], times)
    dates = np.array([time for time, *_ in filter_result.events], np.int64)
    interrupted = np.any((dates > times[:, None]) & (dates <= targets[:, None]), axis=1)
    filtered, forecast = (
        Estimate(*(np.concatenate([getattr(course, part) for course in courses]) for part in ("values", "sigmas")))
        for courses in (now, later)
    )
    methods: dict[str, Estimate | Course] = {"ground": ground, "single": single}
    methods |= {"filtered": filtered, "smoothed": smoothed}
    return JudgedLife(times, quantities, true, methods, horizon, forecast, outcomes, interrupted, filter_result)


def _prior(operation: Operation, times: NDArray[np.int64]) -> Estimate:
    """Return the estimate without any reading: zero change, with the standard deviations of the prior."""
    series_filter, rows = operation.model.series_filter, operation.model.rows
    seconds = ((times - times[0]) / MICRO).tolist()
    start = series_filter.start(seconds[0])
    estimates = [series_filter.parameters(start, time) for time in seconds]
    values = np.array([mean for mean, _ in estimates]) @ rows.T
    spread = np.array([covariance for _, covariance in estimates])
    return Estimate(values, np.sqrt(np.einsum("qi,tij,qj->tq", rows, spread, rows)))


class StepwiseIngest:
    """Files of a simulated life, ingested into a record step by step in the order of time.

    Array dimensions: T times.

    Parameters
    ----------
    history
        Record of the instrument in operation.
    file
        YAML file that describes the tables.

    Attributes
    ----------
    times
        (T,) times of the readings of the monitor, in microseconds of TAI since 2000.
    """

    def __init__(self, history: History, file: Path) -> None:
        self._history, self._taken = history, -(2**62)
        spec = read_telemetry(file, history)
        self._contents = [
            read_table_file(table, path, history) for table in spec.readings for path in tables_of(spec, table)
        ]
        moments = {entry.time for content in self._contents for entry in _entries(content) if entry.kind == "monitor"}
        self.times = np.array(sorted(moments), np.int64)

    def take(self, until: int) -> None:
        """Ingest the entries after the previous call up to a time.

        Parameters
        ----------
        until : int
            Time of the newest entry, in microseconds of TAI since 2000.
        """
        for content in self._contents:
            entries = [entry for entry in _entries(content) if self._taken < entry.time <= until]
            if entries:
                self._history.ingest(
                    FileContent(content.file, content.sha256, content.meaning, entries, content.frames)
                )
        self._taken = until


def _entries(content: FileContent) -> list[Entry]:
    return [item for item in content.items if isinstance(item, Entry)]


def true_changes(truth: Mapping[str, Any], quantities: Sequence[Quantity], times: NDArray[np.int64]) -> Array:
    """Return the true changes (T, Q) in each quantity's unit.

    Array dimensions: T times.

    Parameters
    ----------
    truth : Mapping[str, Any]
        Truth of the life: the content of its truth file as nested mappings and lists.
    quantities : Sequence[Quantity]
        The Q quantities.
    times : (T,) ndarray of int64
        Times at which the truth is known, in microseconds of TAI since 2000.
    """
    at = {moment: k for k, moment in enumerate(truth["times_us"])}
    rows = [at[moment] for moment in times.tolist()]
    columns = []
    for quantity in quantities:
        group = (
            truth[quantity.group] if quantity.group in (ANGLE_GROUP, GROUND_GROUP) else truth["cameras"][quantity.group]
        )
        columns.append(np.array(group[quantity.key])[rows])
    return np.stack(columns, axis=1)


def _single(readings: Sequence[Mapping[str, Any]], quantities: Sequence[Quantity]) -> Estimate:
    """Return the estimate from each reading alone, with minimum variance for the specified disturbances."""
    values, sigmas = [], []
    for read in readings:
        groups = {**read["cameras"], **{name: read[name] for name in (ANGLE_GROUP, GROUND_GROUP) if name in read}}
        estimates = [groups[quantity.group]["posterior"] for quantity in quantities]
        values.append([estimate[item.key] for estimate, item in zip(estimates, quantities, strict=True)])
        sigmas.append([estimate[f"{item.key}_sigma"] for estimate, item in zip(estimates, quantities, strict=True)])
    return Estimate(np.array(values), np.array(sigmas))


def covered(error: Array, sigma: Array, times: float) -> tuple[int, int]:
    """Return the number of errors within a multiple of sigma, and the number of known errors.

    Parameters
    ----------
    error : ndarray
        Errors; NaN is ignored.
    sigma : ndarray
        Standard deviations of the errors, of the same shape.
    times : float
        Multiple of sigma.
    """
    ratio = np.abs(error / sigma)
    known = np.isfinite(ratio)
    return int(np.count_nonzero(ratio[known] <= times)), int(known.sum())


def rms(error: Array) -> float:
    """Return the root mean square of errors, ignoring NaN."""
    return float(np.sqrt(np.nanmean(np.square(error)))) if np.any(np.isfinite(error)) else math.nan


SHARES = {1.0: math.erf(math.sqrt(0.5)), 2.0: math.erf(math.sqrt(2.0))}
"""Multiple of sigma -> share of normally distributed errors within it."""
EXCEEDANCE = 1e-3
"""Probability that the share of independent normal errors within a multiple of sigma lies outside the limits in the
report.
"""
SHOWN = ((ANGLE_GROUP, "change_arcsec"), (GROUND_GROUP, "height_m"))
"""Group and key of the quantities that the figure shows, where the instrument has them.

The figure also shows a camera's change of focal length.
"""
_DAY = 86_400 * MICRO
_YEAR = 365.25 * _DAY
FORECAST = "forecast"
_COVERED = ("filtered", FORECAST)
"""Estimates for which the table gives the share of errors within one and two sigmas."""


def judged_numbers(life: JudgedLife) -> dict[str, Any]:
    """Return the comparison of the estimates with the truth as plain data, for judged.json.

    It holds, for each quantity and estimate, the RMS error, errors and sigmas at all readings and the shares within one
    and two sigmas; the same of the forecasts; and the scores, explained scatter, sensors and jumps of the filter.

    Parameters
    ----------
    life : JudgedLife
        Estimates and truth of the simulated life.
    """
    out_by_group: dict[str, dict[str, Any]] = {}
    for number, quantity in enumerate(life.quantities):
        summary = {
            method: _error_summary(life.errors(method)[:, number], estimate.sigmas[:, number])
            for method, estimate in life.methods.items()
        }
        for name, which in ((FORECAST, ~life.interrupted), ("forecast_over_events", life.interrupted)):
            error = (life.forecast.values - life.outcomes)[which, number]
            summary[name] = _error_summary(error, life.forecast.sigmas[which, number])
        out_by_group.setdefault(quantity.group, {})[quantity.key] = summary
    filter_result = life.filter_result.to_dict()
    scores = life.filter_result.scores
    return {
        "readings": len(life.times),
        "first_utc": utc_text(int(life.times[0])),
        "last_utc": utc_text(int(life.times[-1])),
        "times_utc": [utc_text(int(time)) for time in life.times],
        "horizon_s": life.horizon,
        "quantities": out_by_group,
        "predictions": {
            "components": scores.components,
            "within_one": scores.within_one / scores.components if scores.components else None,
            "within_one_limits": list(likely_shares(scores.components, 1.0)),
            "within_two": scores.within_two / scores.components if scores.components else None,
            "within_two_limits": list(likely_shares(scores.components, 2.0)),
            "limits_exceedance_probability": EXCEEDANCE,
        },
        "explained_by_temperatures": filter_result["explained"],
        "sensors": filter_result["sensors"],
        "jumps": filter_result["jumps"],
    }


def _error_summary(error: Any, sigma: Any) -> dict[str, Any]:
    """Return the RMS of errors and their shares within one and two sigmas as plain data, ignoring NaN."""
    value = rms(error)
    out: dict[str, Any] = {"rms": value if math.isfinite(value) else None}
    out |= {"errors": _rounded(error), "sigmas": _rounded(sigma)}
    for times, name in ((1.0, "within_one"), (2.0, "within_two")):
        inside, known = covered(error, sigma, times)
        out[name] = inside / known if known else None
        out["known"] = known
    return out


def _rounded(values: Any) -> list[float | None]:
    """Return values rounded to four digits; None for NaN."""
    return [float(f"{value:.4g}") if math.isfinite(value) else None for value in np.asarray(values).tolist()]


def likely_shares(count: int, times: float) -> tuple[float, float]:
    """Return limits for the share of `count` independent normal errors that lie within a multiple of sigma.

    The share lies outside them with the probability ``EXCEEDANCE``. Without errors they are 0 and 1.

    Parameters
    ----------
    count : int
        Number of independent errors.
    times : float
        Multiple of sigma.
    """
    low, high = binom.ppf([0.5 * EXCEEDANCE, 1.0 - 0.5 * EXCEEDANCE], count, SHARES[times])
    return (float(low) / count, float(high) / count) if count else (0.0, 1.0)


def judged_report(life: JudgedLife, name: str) -> Report:
    """Return the report on the comparison of the estimates with the truth.

    Parameters
    ----------
    life : JudgedLife
        Estimates and truth of the simulated life.
    name : str
        Name of the instrument.
    """
    numbers = judged_numbers(life)
    shown = _shown(life)
    verdict, lead = answer(*_verdict_sentences(life, numbers, shown))
    years = (int(life.times[-1]) - int(life.times[0])) / _YEAR
    facts = (
        ("instrument", name),
        ("readings", f"{len(life.times)} in {years:.2g} years, from {utc_text(int(life.times[0]))}"),
        ("forecasts", f"{life.horizon / 86_400.0:.3g} days ahead"),
    )
    caption = (
        "Errors are estimate minus truth. The ground calibration ignores all changes since; a single reading uses the "
        "prior of the motions; the filtered and the smoothed estimate use readings, temperatures and events. Errors "
        "at neighbouring times are correlated: shares scatter more than those of as many independent errors."
    )
    figure = SvgFigure("with_and_without", "Errors of four estimates", caption, judged_svg(life, shown))
    section = Section("Errors over the years", (), (figure,), name="errors")
    return Report(
        f"{name}: estimates of a simulated life against its truth",
        verdict,
        lead,
        facts,
        _methods_table(life),
        (section,),
    )


def _shown(life: JudgedLife) -> tuple[tuple[str, str], ...]:
    """Return group and key of the quantities in the figure."""
    names = [(quantity.group, quantity.key) for quantity in life.quantities]
    focal = next(name for name in names if name[1] == "d_f_um")
    return (*(shown for shown in SHOWN if shown in names), focal)


def _verdict_sentences(life: JudgedLife, numbers: dict[str, Any], shown: Sequence[tuple[str, str]]) -> list[str]:
    """Return the sentences at the top of the report: errors of the estimates, and coverage by their sigmas."""
    out_by_group = []
    for group, key in shown[-2:] if len(shown) > 1 else shown:
        quantity, estimate = life.quantities[life.number(group, key)], numbers["quantities"][group][key]
        values = " / ".join(_short(estimate[method]["rms"]) for method in METHODS)
        out_by_group.append(f"{group} {quantity.parameter.symbol} {values} {quantity.parameter.unit}")
    made = numbers["predictions"]
    low, high = made["within_one_limits"]
    out = [
        f"RMS errors of ground calibration / single readings / filtered / smoothed estimate: {', '.join(out_by_group)}"
    ]
    if made["components"]:
        out.append(
            f"{100 * made['within_one']:.1f} % of the {made['components']} components of the readings are within 1 σ "
            f"of their predictions and {100 * made['within_two']:.1f} % within 2 σ; chance allows {100 * low:.1f} to "
            f"{100 * high:.1f} % within 1 σ"
        )
    group, key = shown[-1]
    explained = numbers["explained_by_temperatures"].get(f"{group} {key}")
    if explained is not None:
        symbol = life.quantities[life.number(group, key)].parameter.symbol
        out.append(f"temperatures explain {100 * explained:.0f} % of the scatter of {group} {symbol}")
    bad = [sensor for sensor in numbers["sensors"] if sensor["state"] != "ok"]
    out += [f"the sensor of {sensor['body']} is {sensor['state']}: {sensor['reason']}" for sensor in bad]
    return out


def _methods_table(life: JudgedLife) -> Table:
    """Return the table of RMS errors, and of shares within one and two sigmas, of each estimate."""
    heads = ("quantity", *("RMS: " + method for method in METHODS), "forecast")
    heads += tuple(f"{method} within {n} σ [%]" for method in _COVERED for n in (1, 2))
    rows: list[list[Cell]] = []
    quantities = judged_numbers(life)["quantities"]
    for quantity in life.quantities:
        estimate = quantities[quantity.group][quantity.key]
        row: list[Cell] = [f"{quantity.group} {quantity.parameter.label}"]
        row += [_cell(estimate[method]["rms"]) for method in (*METHODS, FORECAST)]
        for method in _COVERED:
            row += [_cell(estimate[method][key], 100.0) for key in ("within_one", "within_two")]
        rows.append(row)
    caption = "RMS errors of four estimates of the cameras against the truth, and shares of errors within 1 and 2 σ."
    return Table("methods", "Four estimates of the cameras", caption, heads, rows, digits=3)


def _cell(value: float | None, times: float = 1.0) -> Cell:
    return "" if value is None else times * value


def _short(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2g}"


def judged_svg(life: JudgedLife, quantities: Sequence[tuple[str, str]]) -> str:
    """Draw the errors of quantities over time for each estimate, with bands of one and two sigmas, as SVG text.

    Parameters
    ----------
    life : JudgedLife
        Estimates and truth of the simulated life.
    quantities : Sequence[tuple[str, str]]
        Group and key of each quantity; one column of the figure each.
    """
    with svg.look("operation"):
        figure = svg.new_figure(8.4)
        grid = figure.subplots(len(METHODS), len(quantities), sharex=True, squeeze=False)
        for column, name in enumerate(quantities):
            number = life.number(*name)
            quantity = life.quantities[number]
            group_text = "" if quantity.group in (ANGLE_GROUP, GROUND_GROUP) else f"{quantity.group} "
            for row, (method, title) in enumerate(METHODS.items()):
                axes = grid[row, column]
                _panel(axes, life, method, number)
                size = f"RMS {rms(life.errors(method)[:, number]):.2g} {quantity.parameter.unit}"
                axes.set_title(f"{title}: {size}", loc="left", fontsize=8.0)
                axes.set_ylabel(f"error of {group_text}{quantity.parameter.label}")
                if row > 2:  # same scale for the filtered and the smoothed estimate
                    axes.sharey(grid[row - 1, column])
            grid[-1, column].set_xlabel("years in operation")
        svg.shared_legend(figure, grid[-1, 0])
        figure.align_ylabels()
        return svg.to_svg(figure)


def _panel(axes: Any, life: JudgedLife, method: str, number: int) -> None:
    """Draw the errors of one estimate with its sigma, the events, and the intervals of the detected jumps."""
    years = (life.times - life.times[0]) / _YEAR
    error, sigma = life.errors(method)[:, number], life.methods[method].sigmas[:, number]
    svg.gridded(axes)
    axes.axhline(0.0, color=svg.GREY, lw=0.7)
    for times, colour, name in ((2.0, svg.SHADE, "±2σ"), (1.0, svg.LIGHT, "±σ")):
        if np.any(np.isfinite(sigma)):
            axes.fill_between(years, -times * sigma, times * sigma, color=colour, lw=0.0, label=name)
    for k, (moment, *_) in enumerate(life.filter_result.events):
        axes.axvline((moment - life.times[0]) / _YEAR, color=svg.ORANGE, lw=0.9, ls="--", label="" if k else "event")
    for k, jump in enumerate(life.filter_result.jumps):
        low, high = ((moment - life.times[0]) / _YEAR for moment in (jump.after_us, jump.until_us))
        axes.axvspan(low, high, color=svg.PURPLE, alpha=0.5, lw=1.0, label="" if k else "detected jump")
    axes.plot(years, error, color=svg.BLUE, lw=1.1, label="estimate minus truth")
