"""Paper 004, sections 3.2 and 3.3: the turntable's dividing error, its repeats and its fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import erfc
from scipy.stats import norm

from analysis.arrays import ARCSEC, Array
from analysis.turntable.angle_network import NotConvergedError
from analysis.turntable.dividing_error import FITS, CalibrationSeries, fit, rejection_rate
from optics.numerics.backend import one_blas_thread
from scenes.specs.resolved import resolve_turntable
from scenes.specs.turntable import TurntableTestSpec
from twin.laboratory.turntable_bench import TurntableModel
from twin.laboratory.turntable_run import rms, run_turntable
from twin.run.artefact import Cell, Table
from twin.validation.checks.check import Check, CheckResult, Chosen, median_of
from twin.validation.checks.group import Context, group_of, load_printed

TEST = "turntable"
REPEATS = load_printed("004").whole("turntable.repeats")
REPEAT_RMS_ARCSEC = load_printed("004").number("turntable.repeat_rms_arcsec")
FIT_RMS_ARCSEC = load_printed("004").number("turntable.fit_rms_arcsec")
TABLES, FAST_TABLES = 1000, 200
"""Turntables that are calibrated; quick."""
FURTHER = 1.6
"""Factor on an input at which tables are calibrated again, to see what hangs on it."""
FITTED, FAST_FITTED = 60, 12
"""Turntables whose calibration is fitted."""
NETWORK = "network"
_REPEATED = tuple(f"004.turntable.{name}" for name in ("repeat", "criterion", "chauvenet", "chauvenet_mean"))
FIT_NAMES = {name: name.replace("_", " ") for name in FITS} | {"fourier": "Fourier series"}
CLOSED_FORMS = tuple(name for name in FITS if name != NETWORK)


@dataclass(frozen=True, eq=False)
class FittedTable:
    """One turntable, fitted.

    Attributes:
        chosen: the closed form that cross-validation on the calibration points chooses.
        held_out: RMS of each fit at readings that no fit has seen, radians; infinite where it failed.
    """

    chosen: str
    held_out: Mapping[str, float]


def run(context: Context) -> Iterator[CheckResult]:
    """Calibrate many tables; fit some of them."""
    spec = resolve_turntable(TEST).test
    # two streams, so that what one part draws does not hang on whether the other runs
    first, second = np.random.SeedSequence(context.seed).spawn(2)
    if context.wants(*_REPEATED):
        count = context.count(TABLES, FAST_TABLES)
        context.progress(0.0, f"calibrate {count} tables")
        seeds = first.generate_state(count)
        series = [TurntableModel(spec, int(seed)).calibrate() for seed in seeds]
        if "004.turntable.criterion" in context.selected:
            yield _criterion(context.check("004.turntable.criterion"), series)
        yield from _repeats(context, series, spec, seeds)
    rows = {"interpolation": _interpolation, "fit": _bound, "network": _network}
    if not context.wants(*(f"004.turntable.{name}" for name in rows)):
        return
    tables = []
    count = context.count(FITTED, FAST_FITTED)
    with one_blas_thread():
        for k, seed in enumerate(second.generate_state(count)):
            context.progress(0.05 + 0.95 * k / count, f"fit table {k + 1} of {count}")
            tables.append(fit_table(spec, int(seed)))
    for name, row in rows.items():
        if f"004.turntable.{name}" in context.selected:
            yield row(context.check(f"004.turntable.{name}"), tables)
    context.add(_table(tables))


def _criterion(check: Check, series: Sequence[CalibrationSeries]) -> CheckResult:
    """Where the rule begins to reject, from the readings that it kept and rejected."""
    readings, keep = (np.concatenate([getattr(s, name) for s in series]) for name in ("comparisons", "keep"))
    size = np.abs(readings - readings.mean(axis=1, keepdims=True)) / readings.std(axis=1, ddof=1, keepdims=True)
    kept, gone = float(np.max(size[keep])), float(np.min(size[~keep]))
    # half a reading is expected beyond it, two-sided
    wanted = brentq(lambda x: REPEATS * erfc(x / np.sqrt(2.0)) - 0.5, 0.1, 5.0)
    how = (
        f"{len(series)} simulated tables, {size.size} readings: largest deviation that is kept {kept:.4f}, smallest "
        f"that is rejected {gone:.4f}; the middle of the two counts. Implied is the root of 10 P(|z| > x) = 1/2."
    )
    return check.evaluate(0.5 * (kept + gone), None, how, wanted)


def fit_table(spec: TurntableTestSpec, seed: int) -> FittedTable:
    """Calibrate a table, fit it in all five ways, and look at the readings in between."""
    done = run_turntable(spec, seed, names=CLOSED_FORMS)
    series, held = done.series, done.held_out
    assert held is not None
    found = {name: rms(done.held_out_residual(name)) for name in done.fits}
    try:
        # without its cross-validation, which takes ten times as long and chooses nothing here
        network = fit(NETWORK, series.angle, series.mean, series.sigma, seed)
        found[NETWORK] = rms(held.mean - network(held.angle))
    except NotConvergedError:
        pass
    return FittedTable(done.choice.chosen, {name: found.get(name, float("inf")) for name in FITS})


def _repeats(
    context: Context, series: Sequence[CalibrationSeries], spec: TurntableTestSpec, seeds: NDArray[np.integer]
) -> Iterator[CheckResult]:
    values = {
        "004.turntable.repeat": np.array([np.max(s.rms_before) for s in series]) / ARCSEC,
        "004.turntable.chauvenet": np.array([np.max(s.rms_after) for s in series]) / ARCSEC,
        "004.turntable.chauvenet_mean": np.array([s.averaging_alone for s in series]) / ARCSEC,
    }
    rejected = float(np.mean([s.rejected for s in series]))
    good = rejection_rate(REPEATS) * series[0].comparisons.size
    kept = float(np.median([s.mean_rms for s in series])) / ARCSEC
    alone = REPEAT_RMS_ARCSEC / REPEATS**0.5
    more = {
        "004.turntable.repeat": "Repeatability and gross errors are chosen for this number, so that it shows their "
        "class only.",
        "004.turntable.chauvenet": f"The criterion rejects {rejected:.1f} of {series[0].comparisons.size} readings, "
        f"{good:.1f} of them expected without any gross error. Repeatability is chosen for this number too.",
        "004.turntable.chauvenet_mean": f"The mean of the readings that the criterion keeps has {kept:.4f}″ at worst.",
    }
    for identifier, found in values.items():
        if identifier in context.selected:
            low, high = np.percentile(found, [25.0, 75.0])
            how = (
                f"Median of {len(found)} simulated tables; half of them lie between {low:.4f}″ and {high:.4f}″. "
                f"{more[identifier]}"
            )
            check, (value, sigma) = context.check(identifier), median_of(found)
            inputs = _readings(spec, seeds[:FAST_TABLES], identifier, value) if check.basis == "chosen" else []
            yield check.evaluate(value, sigma, how, None, [alone] if identifier.endswith("mean") else [], inputs)


def _readings(spec: TurntableTestSpec, seeds: NDArray[np.integer], identifier: str, value: float) -> list[Chosen]:
    """What the largest RMS of the repeats hangs on: the scatter of a reading, and before the criterion gross errors."""
    scatter = float(np.hypot(spec.dividing_error.repeatability, spec.reference.noise)) / ARCSEC
    if identifier.endswith("chauvenet"):
        return [Chosen.power("scatter of a reading", scatter, "arcsec", value)]
    out = []
    for name, size, changed in (
        ("scatter of a reading", scatter, _with_errors(spec, FURTHER, 1.0)),
        ("gross error", spec.reference.gross_error / ARCSEC, _with_errors(spec, 1.0, FURTHER)),
    ):
        found = [np.max(TurntableModel(changed, int(seed)).calibrate().rms_before) / ARCSEC for seed in seeds]
        # both errors go into the RMS in square
        growth = (float(np.median(found)) ** 2 - value**2) / (FURTHER**2 - 1.0)

        def response(factor: float, growth: float = growth) -> float:
            return float(np.sqrt(max(value**2 + (factor**2 - 1.0) * growth, 0.0)))

        out.append(Chosen(name, size, "arcsec", response))
    return out


def _with_errors(spec: TurntableTestSpec, scatter: float, gross: float) -> TurntableTestSpec:
    """The test with the scatter of its readings and its gross errors times factors."""
    table, reference = spec.dividing_error, spec.reference
    noise = {"noise": scatter * reference.noise, "gross_error": gross * reference.gross_error}
    update = {
        "dividing_error": table.model_copy(update={"repeatability": scatter * table.repeatability}),
        "reference": reference.model_copy(update=noise),
    }
    return spec.model_copy(update=update)


def dividing(value: float, power: float = 1.0) -> Chosen:
    """The dividing error, to which what fits leave of it is proportional, and what that does to the distortion."""
    return Chosen.power("dividing error of scenes/lab/turntable.yaml, times", 1.0, "1", value, power)


def _interpolation(check: Check, tables: Sequence[FittedTable]) -> CheckResult:
    lines = np.array([table.held_out["piecewise_linear"] for table in tables]) / ARCSEC
    how = f"{len(tables)} simulated tables, straight lines between 41 means: median {np.median(lines):.3f}″."
    value = float(np.max(lines))
    return check.evaluate(value, None, how, inputs=[dividing(value)])


def _bound(check: Check, tables: Sequence[FittedTable]) -> CheckResult:
    chosen = np.array([table.held_out[table.chosen] for table in tables]) / ARCSEC
    network = np.array([table.held_out[NETWORK] for table in tables]) / ARCSEC
    often = {name: sum(table.chosen == name for table in tables) for name in CLOSED_FORMS}
    names = ", ".join(f"{FIT_NAMES[name]} {count}" for name, count in often.items() if count)
    how = (
        f"{len(tables)} simulated tables; cross-validation on the calibration points chooses among the fits other than "
        f"the network ({names}). At the held-out readings: median {np.median(chosen):.3f}″, largest "
        f"{np.max(chosen):.3f}″; the network: {np.median(network):.3f}″ and {np.max(network):.3f}″."
    )
    value = float(np.max(chosen))
    return check.evaluate(value, None, how, inputs=[dividing(value)])


def _ranks(tables: Sequence[FittedTable]) -> dict[str, Array]:
    """Rank of each fit on each table, 1 the best."""
    return {
        name: np.array([1.0 + sum(v < t.held_out[name] for v in t.held_out.values()) for t in tables]) for name in FITS
    }


def _network(check: Check, tables: Sequence[FittedTable]) -> CheckResult:
    rank = _ranks(tables)[NETWORK]
    rivals = [min(t.held_out[name] for name in CLOSED_FORMS) for t in tables]
    best = np.array([t.held_out[NETWORK] / rival for t, rival in zip(tables, rivals, strict=True)])
    ratio = np.array([t.held_out[NETWORK] / t.held_out[t.chosen] for t in tables])
    how = (
        f"{len(tables)} simulated tables, all fits on the same 41 means. RMS of the network over that of the fit that "
        f"cross-validation chooses among the others: {np.min(ratio):.3f} to {np.max(ratio):.3f}; over that of the best "
        f"other fit, known afterwards only: mean {np.mean(best):.3f}. The network is the best of five on "
        f"{np.sum(rank == 1.0)} tables, its mean rank is {np.mean(rank):.1f}."
    )
    # of a median, by the median distance from it: a training that ends in a bad minimum now and then is far off
    middle = float(np.median(ratio))
    sigma = float(np.sqrt(0.5 * np.pi / len(ratio)) * np.median(np.abs(ratio - middle)) / norm.ppf(0.75))
    return check.evaluate(middle, sigma, how, 0.9, [1.0])


def _table(tables: Sequence[FittedTable]) -> Table:
    ranks = _ranks(tables)
    rows: list[list[Cell]] = []
    for name in sorted(FITS, key=lambda n: float(np.mean(ranks[n]))):
        values = np.array([table.held_out[name] for table in tables]) / ARCSEC
        rows.append(
            [
                FIT_NAMES[name],
                f"{np.mean(ranks[name]):.2f}",
                int(np.sum(ranks[name] == 1.0)),
                f"{np.median(values):.4f}",
                f"{np.max(values):.4f}",
            ]
        )
    return Table(
        "fits",
        "Five fits of the dividing error",
        f"RMS at held-out readings, arcsec, over {len(tables)} simulated tables.",
        ("fit", "mean rank", "best on", "median", "largest"),
        rows,
    )


GROUP = group_of("004.turntable_fits", run)
