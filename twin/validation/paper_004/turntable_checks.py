"""Checks of paper 004 (Li et al. 2020), sections 3.2 and 3.3: dividing error, repeated readings and fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import erfc
from scipy.stats import norm

from analysis.arrays import ARCSEC, Array
from analysis.statistics import rms
from analysis.turntable.dividing_error import (
    FITS,
    CalibrationSeries,
    NotConvergedError,
    fit_dividing_error,
    rejection_rate,
)
from optics.numerics.backend import one_blas_thread
from scenes.specs.camera_tests import TurntableTestSpec
from scenes.specs.resolved import TurntableSetup
from twin.framework.artefact import Cell
from twin.laboratory.turntable_run import TurntableModel, run_turntable
from twin.validation.check import CheckResult, Chosen, median_of
from twin.validation.group import Context, group_of, load_printed

TEST = "turntable"
REPEATS = load_printed("004").whole("turntable.repeats")
REPEAT_RMS_ARCSEC = load_printed("004").number("turntable.repeat_rms_arcsec")
FIT_RMS_ARCSEC = load_printed("004").number("turntable.fit_rms_arcsec")
TABLES, FAST_TABLES = 1000, 200
"""Numbers of simulated turntables that are calibrated, in a full and in a fast run."""
FURTHER = 1.6
"""Factor on an input (not printed in the paper) for a second calibration of the tables, which shows how the result
depends on it.
"""
FITTED, FAST_FITTED = 60, 12
"""Numbers of simulated turntables whose calibration is fitted, in a full and in a fast run."""
NETWORK = "network"
_REPEATED = tuple(f"004.turntable.{name}" for name in ("repeat", "criterion", "chauvenet", "chauvenet_mean"))
FIT_NAMES = {name: name.replace("_", " ") for name in FITS} | {"fourier": "Fourier series"}
CLOSED_FORMS = tuple(name for name in FITS if name != NETWORK)


@dataclass(frozen=True, eq=False)
class FittedTable:
    """Turntable with its fits of the dividing error.

    Attributes
    ----------
    chosen : str
        Closed-form fit that cross-validation on the calibration points selects.
    held_out : mapping of str to float
        RMS of each fit at readings that no fit has used, radians; infinite if the fit failed.
    """

    chosen: str
    held_out: Mapping[str, float]


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the turntable checks: calibrate many tables and fit some of them."""
    spec = TurntableSetup.read(TEST).test
    # two streams, so that what one part draws does not hang on whether the other runs
    first, second = np.random.SeedSequence(context.seed).spawn(2)
    if context.wants(*_REPEATED):
        count = context.count(TABLES, FAST_TABLES)
        context.progress(0.0, f"calibrate {count} tables")
        seeds = first.generate_state(count)
        series = [TurntableModel(spec, int(seed)).calibrate() for seed in seeds]
        if "004.turntable.criterion" in context.selected:
            yield _criterion(context, series)
        yield from _repeats(context, series, spec, seeds)
    if not context.wants(*(f"004.turntable.{name}" for name in ("interpolation", "fit", "network"))):
        return
    tables = []
    count = context.count(FITTED, FAST_FITTED)
    with one_blas_thread():
        for k, seed in enumerate(second.generate_state(count)):
            context.progress(0.05 + 0.95 * k / count, f"fit table {k + 1} of {count}")
            tables.append(fit_table(spec, int(seed)))
    lines, chosen, network = (
        np.array([table.held_out[name or table.chosen] for table in tables]) / ARCSEC
        for name in ("piecewise_linear", "", NETWORK)
    )
    often = {name: sum(table.chosen == name for table in tables) for name in CLOSED_FORMS}
    names = {FIT_NAMES[name]: count for name, count in often.items() if count}
    facts: dict[str, Any] = {"tables": tables, "lines": lines, "chosen": chosen, "network": network, "names": names}
    for name, fitted in (("interpolation", lines), ("fit", chosen)):
        value = float(np.max(fitted))
        yield context.row(f"004.turntable.{name}", value, inputs=[dividing(value)], **facts)
    if "004.turntable.network" in context.selected:
        yield _network(context, tables)
    _show(context, tables)


def _criterion(context: Context, series: Sequence[CalibrationSeries]) -> CheckResult:
    """Check the limit of the outlier rejection by the readings that it accepted and rejected."""
    readings, keep = (np.concatenate([getattr(s, name) for s in series]) for name in ("comparisons", "keep"))
    size = np.abs(readings - readings.mean(axis=1, keepdims=True)) / readings.std(axis=1, ddof=1, keepdims=True)
    largest_accepted, smallest_rejected = float(np.max(size[keep])), float(np.min(size[~keep]))
    # half a reading is expected beyond it, two-sided
    wanted = brentq(lambda x: REPEATS * erfc(x / np.sqrt(2.0)) - 0.5, 0.1, 5.0)
    facts: dict[str, Any] = {"series": series, "size": size, "kept": largest_accepted, "gone": smallest_rejected}
    return context.row("004.turntable.criterion", 0.5 * (largest_accepted + smallest_rejected), None, wanted, **facts)


def fit_table(spec: TurntableTestSpec, seed: int) -> FittedTable:
    """Calibrate a table, fit its dividing error with all five models, and test them at readings in between."""
    done = run_turntable(spec, seed, names=CLOSED_FORMS)
    series, excluded = done.series, done.held_out
    assert excluded is not None
    residual_rms = {name: rms(done.held_out_residual(name)) for name in done.fits}
    try:
        # without its cross-validation, which takes ten times as long and chooses nothing here
        network = fit_dividing_error(series.angle, series.mean, series.sigma, NETWORK, seed)
        residual_rms[NETWORK] = rms(excluded.mean - network(excluded.angle))
    except NotConvergedError:
        pass
    return FittedTable(done.choice.chosen, {name: residual_rms.get(name, float("inf")) for name in FITS})


def _repeats(
    context: Context, series: Sequence[CalibrationSeries], spec: TurntableTestSpec, seeds: NDArray[np.integer]
) -> Iterator[CheckResult]:
    values = {
        "repeat": np.array([np.max(s.rms_before) for s in series]) / ARCSEC,
        "chauvenet": np.array([np.max(s.rms_after) for s in series]) / ARCSEC,
        "chauvenet_mean": np.array([s.averaging_alone for s in series]) / ARCSEC,
    }
    facts: dict[str, Any] = {
        "rejected": np.mean([s.rejected for s in series]),
        "comparisons": series[0].comparisons,
        "good": rejection_rate(REPEATS) * series[0].comparisons.size,
        "kept": np.median([s.mean_rms for s in series]),
    }
    for name, repeats in values.items():
        identifier = f"004.turntable.{name}"
        if identifier in context.selected:
            value, sigma = median_of(repeats)
            chosen = context.check(identifier).basis == "chosen"
            inputs = _readings(spec, seeds[:FAST_TABLES], identifier, value) if chosen else []
            explained = [REPEAT_RMS_ARCSEC / REPEATS**0.5] if name.endswith("mean") else []
            more: dict[str, Any] = {"simulated": repeats, "quartiles": np.percentile(repeats, [25.0, 75.0])}
            yield context.row(identifier, value, sigma, None, explained, inputs, **facts, **more)


def _readings(spec: TurntableTestSpec, seeds: NDArray[np.integer], identifier: str, value: float) -> list[Chosen]:
    """Return the inputs that the paper does not print, on which the largest RMS of repeated readings depends.

    They are the scatter of a reading and, before the rejection criterion, gross errors.
    """
    scatter = float(np.hypot(spec.dividing_error.repeatability, spec.reference.noise)) / ARCSEC
    if identifier.endswith("chauvenet"):
        return [Chosen.power("scatter of a reading", scatter, "arcsec", value)]
    out = []
    for name, size, changed in (
        ("scatter of a reading", scatter, _with_errors(spec, FURTHER, 1.0)),
        ("gross error", spec.reference.gross_error / ARCSEC, _with_errors(spec, 1.0, FURTHER)),
    ):
        largest = [np.max(TurntableModel(changed, int(seed)).calibrate().rms_before) / ARCSEC for seed in seeds]
        # both errors go into the RMS in square
        increase = (float(np.median(largest)) ** 2 - value**2) / (FURTHER**2 - 1.0)

        def response(factor: float, increase: float = increase) -> float:
            return float(np.sqrt(max(value**2 + (factor**2 - 1.0) * increase, 0.0)))

        out.append(Chosen(name, size, "arcsec", response))
    return out


def _with_errors(spec: TurntableTestSpec, scatter: float, gross: float) -> TurntableTestSpec:
    """Return the test with the scatter of its readings and its gross errors multiplied by factors."""
    table, reference = spec.dividing_error, spec.reference
    noise = {"noise": scatter * reference.noise, "gross_error": gross * reference.gross_error}
    update = {
        "dividing_error": table.model_copy(update={"repeatability": scatter * table.repeatability}),
        "reference": reference.model_copy(update=noise),
    }
    return spec.model_copy(update=update)


def dividing(value: float, power: float = 1.0) -> Chosen:
    """Return the dividing error as an input that the paper does not print.

    The remaining error of fits and its effect are proportional to it.
    """
    return Chosen.power("dividing error of scenes/lab/turntable.yaml, times", 1.0, "1", value, power)


def _ranks(tables: Sequence[FittedTable]) -> dict[str, Array]:
    """Return the rank of each fit on each turntable, 1 for the smallest error."""
    return {
        name: np.array([1.0 + sum(v < t.held_out[name] for v in t.held_out.values()) for t in tables]) for name in FITS
    }


def _network(context: Context, tables: Sequence[FittedTable]) -> CheckResult:
    rivals = [min(t.held_out[name] for name in CLOSED_FORMS) for t in tables]
    best = np.array([t.held_out[NETWORK] / rival for t, rival in zip(tables, rivals, strict=True)])
    ratio = np.array([t.held_out[NETWORK] / t.held_out[t.chosen] for t in tables])
    rank = _ranks(tables)[NETWORK]
    facts: dict[str, Any] = {"tables": tables, "ratio": ratio, "best": best, "rank": rank, "wins": np.sum(rank == 1.0)}
    # of a median, by the median distance from it: a training that ends in a bad minimum now and then is far off
    middle = float(np.median(ratio))
    sigma = float(np.sqrt(0.5 * np.pi / len(ratio)) * np.median(np.abs(ratio - middle)) / norm.ppf(0.75))
    return context.row("004.turntable.network", middle, sigma, 0.9, [1.0], **facts)


def _show(context: Context, tables: Sequence[FittedTable]) -> None:
    ranks = _ranks(tables)
    rows: list[list[Cell]] = []
    for name in sorted(FITS, key=lambda n: float(np.mean(ranks[n]))):
        rank, values = ranks[name], np.array([table.held_out[name] for table in tables]) / ARCSEC
        best = int(np.sum(rank == 1.0))
        rows.append([FIT_NAMES[name], f"{rank.mean():.2f}", best, f"{np.median(values):.4f}", f"{values.max():.4f}"])
    context.table("fits", rows, tables=tables)


GROUP = group_of("004.turntable_fits", run)
