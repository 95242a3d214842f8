"""Paper 004, section 3.3: distortion tests from rendered spots, Table 2, equations (1) to (4), sources of error."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import ARCSEC, Array
from analysis.arrays import MM_PER_M as MM
from analysis.arrays import UM_PER_M as UM
from optics.numerics.backend import one_blas_thread
from scenes.specs.resolved import resolve_distortion
from twin.laboratory.distortion_bench import DistortionBench
from twin.laboratory.distortion_run import SimulatedDistortion, measure
from twin.laboratory.turntable_run import rms
from twin.run.artefact import Cell
from twin.run.svg import BLUE, GREY, INK, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import Check, CheckResult, Chosen, mean_of, median_of
from twin.validation.checks.group import Context, group_of, load_printed
from twin.validation.paper_004 import equations_004
from twin.validation.paper_004.equations_004 import ACCURACY_UM, POINTS, SpotTest, evaluate_equations, rendered
from twin.validation.paper_004.turntable_checks import FIT_RMS_ARCSEC, dividing

TEST = "distortion"
SETS = load_printed("004").whole("distortion.sets")
RAW, COMPENSATED = (np.array(load_printed("004").column(f"table2.{name}_um")) for name in ("raw", "compensated"))
TESTS, FAST_TESTS = 60, 14
"""Simulated tests: another turntable, calibration, zero, axis, detector and noise in each."""


_PRINTED_ONLY = ("004.table2.reduction", "004.table2.mean", "004.table2.largest", "004.table2.bound")


def run(context: Context) -> Iterator[CheckResult]:
    """Table 2 by itself, and distortion tests from rendered spots."""
    yield from _table2(context)
    if not context.selected - set(_PRINTED_ONLY):
        return
    runs = measured_tests(context)
    yield from evaluate_equations(context, runs)
    yield from evaluate_sensitivity(context, runs)
    yield evaluate_angles(context.check("004.turntable.compensated"), runs)
    yield _accuracy(context.check("004.table2.accuracy"), runs)
    yield _compensation(context.check("004.table2.compensation"), runs)
    yield _points(context.check("004.table2.points"), runs)
    _show(context, runs)


def measured_tests(context: Context) -> list[SimulatedDistortion]:
    """Tests from rendered spots, each with a turntable of its own."""
    with one_blas_thread():
        context.progress(0.0, "build the bench")
        bench = DistortionBench.build(resolve_distortion(TEST), context.backend)
        count = context.count(TESTS, FAST_TESTS)
        runs = []
        for k, seed in enumerate(np.random.SeedSequence(context.seed).generate_state(count)):
            context.progress(0.05 + 0.9 * k / count, f"test {k + 1} of {count}")
            runs.append(measure(bench, int(seed)))
    return runs


def lower(raw: float | np.floating, compensated: float | np.floating) -> float:
    """Reduction, percent."""
    return float(100.0 * (1.0 - compensated / raw))


def _table2(context: Context) -> Iterator[CheckResult]:
    """What the printed columns give."""
    raw, own = RAW, COMPENSATED
    changed = raw != own
    top = [np.eye(len(raw))[np.argmax(values)] for values in (raw, own)]
    share = [np.full(len(raw), 1.0 / len(raw))] * 2
    # derivatives of each statistic by the entries, over the statistic
    kinds = (
        ("reduction", rms(raw), rms(own), raw / np.sum(raw**2), own / np.sum(own**2)),
        ("mean", np.mean(raw), np.mean(own), share[0] / np.mean(raw), share[1] / np.mean(own)),
        ("largest", np.max(raw), np.max(own), top[0] / np.max(raw), top[1] / np.max(own)),
    )
    more = (
        f" Of the {len(raw)} points {np.sum(changed)} change at all, {100.0 * np.mean(changed):.1f} %; point "
        f"{int(np.argmin(raw - own)) + 1} gets worse. The text calls the table Table 3."
    )
    for name, first, second, before, after in kinds:
        value = lower(first, second)
        # the last digit stands for values within 0.1; a point that is the same in both columns has one rounding
        parts = np.where(changed, np.hypot(before, after), np.abs(before - after))
        sigma = (100.0 - value) * 0.1 / np.sqrt(12.0) * float(np.linalg.norm(parts))
        how = f"Printed columns: {first:.3f} and {second:.3f} µm; sigma by their rounding."
        check = context.check(f"004.table2.{name}")
        yield check.evaluate(value, sigma, how + more * (name == "reduction"))
    how = (
        f"Point {int(np.argmax(own)) + 1} of the printed column. An RMS of the distortion over repeated tests is no "
        "accuracy, for it holds the camera's distortion and not what the table's dividing error adds to every test "
        "alike; 004.table2.accuracy compares with the truth."
    )
    yield context.check("004.table2.bound").evaluate(float(np.max(own)), None, how)


def _accuracy(check: Check, runs: Sequence[SimulatedDistortion]) -> CheckResult:
    raw, own = _errors(runs).T
    how = (
        f"{len(runs)} rendered tests, {POINTS} points and {SETS} sets each, against "
        f"exact chief rays: median {np.median(own):.2f} µm, largest {np.max(own):.2f} µm; with angles as read "
        f"{np.median(raw):.2f} and {np.max(raw):.2f} µm. The fit has the constant term that (1) lacks."
    )
    value = float(np.max(own))
    return check.evaluate(value, None, how, inputs=[dividing(value)])


def _compensation(check: Check, runs: Sequence[SimulatedDistortion]) -> CheckResult:
    raw, own = _errors(runs).T
    over_sets = [lower(rms(r.raw.rms_over_sets), rms(r.compensated.rms_over_sets)) for r in runs]
    less = 100.0 * (1.0 - own / raw)
    low, high = np.percentile(less, [25.0, 75.0])
    how = (
        f"{len(runs)} tables and tests: RMS error against exact chief rays, compensated over raw. Reductions from "
        f"{np.min(less):.0f} to {np.max(less):.0f} %, half of them between {low:.0f} and {high:.0f} %: it depends on "
        "the table. The RMS of the distortion itself, which Table 2 prints, holds the design's distortion of gf7 and "
        f"changes by {-np.median(over_sets):+.1f} % (median; {-np.max(over_sets):+.0f} to {-np.min(over_sets):+.0f} "
        f"%). The median is known to {median_of(less)[1]:.1f} %; but the printed figure is of one table, so that sigma "
        "is the scatter of one."
    )
    value = float(np.median(less))
    return check.evaluate(value, float(np.std(less, ddof=1)), how, inputs=[dividing(value, 0.0)])


def _points(check: Check, runs: Sequence[SimulatedDistortion]) -> CheckResult:
    columns = [np.round(UM * np.array([m.rms_over_sets for m in pair]), 1) for pair in
               ((r.raw, r.compensated) for r in runs)]  # fmt: skip
    share = np.array([100.0 * np.mean(raw != own) for raw, own in columns])
    worse = 100.0 * float(np.mean([own > raw for raw, own in columns]))
    value, sigma = mean_of(share)
    # two values d apart are the same tenth of a micrometre with a chance of 1 - d / 0.1 um
    moved = np.abs(UM * np.array([_moved(SpotTest(run)) for run in runs]))
    expected = 100.0 * float(np.mean(np.minimum(moved / 0.1, 1.0)))
    how = (
        f"{len(runs)} rendered tests, RMS of the distortion over the sets rounded to 0.1 µm as printed: from "
        f"{np.min(share):.0f} to {np.max(share):.0f} % of the points change, and {worse:.0f} % get larger. In the "
        "table most of the points that change end at 0.0 or near it."
    )
    return check.evaluate(value, sigma, how, None, [expected])


def _moved(test: SpotTest) -> Array:
    """By how much a correction of the readings moves the distortion of each point, (N,), metres: f times the
    correction, less what zero, f and p take up of it.
    """
    correction = test.camera.f * (test.turn - test.run.raw.fit.angle)
    columns = np.tan(test.turn)[:, None] ** np.arange(3)
    return np.asarray(correction - columns @ np.linalg.lstsq(columns, correction)[0])


def _errors(runs: Sequence[SimulatedDistortion]) -> Array:
    """RMS error of the distortion with raw and with compensated angles, (T, 2), micrometres."""
    return np.array([[UM * rms(run.error(m)) for m in (run.raw, run.compensated)] for run in runs])


def _show(context: Context, runs: Sequence[SimulatedDistortion]) -> None:
    raw, own = RAW, COMPENSATED
    changes = {"paper 004, Table 2": (raw[None], own[None])}
    kinds: dict[str, Callable[[SimulatedDistortion], tuple[Array, Array]]] = {
        "error of the distortion (needs the truth)": lambda r: (r.error(r.raw), r.error(r.compensated)),
        "distance from a smooth curve": lambda r: (r.raw.smooth.residual, r.compensated.smooth.residual),
        "RMS of distortion over the sets": lambda r: (r.raw.rms_over_sets, r.compensated.rms_over_sets),
    }
    for name, pick in kinds.items():
        both = np.abs(UM * np.array([pick(run) for run in runs]))
        changes[name] = both[:, 0], both[:, 1]
    context.table(
            "table2",
            "Table 2 and the simulation",
            f"Over the {POINTS} points, µm: raw and compensated angles; median of {len(runs)} "
            "simulated tests, reductions too.",
            ("quantity", "RMS, raw", "RMS, comp.", "lower, %", "mean, raw", "mean, comp.", "lower, %",
             "largest, raw", "largest, comp.", "lower, %"),
            [[name, *_statistics(*both)] for name, both in changes.items()],
        )  # fmt: skip
    context.figure(
        "reduction",
        "What compensation brings, table by table",
        "A point per simulated turntable and test: RMS error of the distortion. The square is the RMS of the "
        "paper's Table 2, which holds the distortion of its camera as well.",
        reduction_svg(
            _errors(runs), (rms(raw), rms(own)), 0.01 * load_printed("004").number("distortion.reduction_percent")
        ),
    )
    tests = [SpotTest(r) for r in runs]
    context.figure(
        "principal-point",
        "The principal point by (2) and by (2) with a constant term",
        "A point per simulated test. Left: p of (2) follows the error of the zero of W; the line is what the "
        "traced camera makes of it. Right: with a constant beside (2), error bars one stated sigma; the traced "
        "camera's p is zero on this scale, and a pixel is thinner than the line.",
        points_svg(*equations_004.principal_points(tests)),
    )


def _statistics(raw: Array, compensated: Array) -> list[Cell]:
    """RMS, mean and largest over the points of each test (T, N), and by how much they fall: medians of the tests."""
    out: list[Cell] = []
    for size in (lambda v: np.sqrt(np.mean(v**2, axis=1)), lambda v: np.mean(v, axis=1), lambda v: np.max(v, axis=1)):
        before, after = size(raw), size(compensated)
        values = np.median(before), np.median(after), np.median(100.0 * (1.0 - after / before))
        out += [f"{values[0]:.3f}", f"{values[1]:.3f}", f"{values[2]:.1f}"]
    return out


FEW = 5
"""Every fifth point, for the effect of their number."""


def evaluate_sensitivity(context: Context, runs: Sequence[SimulatedDistortion]) -> Iterator[CheckResult]:
    """The rows of the sources of error."""
    if not context.wants("004.sensitivity"):
        return
    tests = [SpotTest(run) for run in runs]
    count = len(tests)
    half = np.flatnonzero(np.abs(tests[0].run.bench.turn) <= 0.5 * tests[0].run.bench.turn[-1])
    whole = slice(None)
    raw = [np.asarray(t.run.raw.fit.angle) for t in tests]
    all_raw, inner = (np.array([t.errors(w, k) for t, w in zip(tests, raw, strict=True)]) for k in (whole, half))
    own = np.array([t.errors(t.turn, whole)[1] for t in tests])
    spots = np.array([t.errors(t.true_turn, whole)[1] for t in tests])
    share = 100.0 * (1.0 - rms(spots) ** 2 / rms(own) ** 2)
    how = (
        f"{rendered(tests)}. With compensated angles D errs by {UM * rms(own):.2f} µm RMS, with the true angles and "
        f"the same images by {UM * rms(spots):.2f} µm; with angles as read by {UM * rms(all_raw[:, 1]):.2f} µm."
    )
    by_spots, by_angles = rms(spots) ** 2, rms(own) ** 2 - rms(spots) ** 2
    chosen = Chosen(
        "dividing error of scenes/lab/turntable.yaml, times", 1.0, "1",
        lambda factor: 100.0 * (1.0 - by_spots / (by_spots + factor**2 * by_angles)),
    )  # fmt: skip
    yield context.check("004.sensitivity.angle").evaluate(share, None, how, 50.0, inputs=[chosen])
    for name, column, over, under in (("field", 1, all_raw, inner), ("distance", 0, inner, all_raw)):
        top, bottom = rms(over[:, column]), rms(under[:, column])
        unit, scale = ("µm", UM) if column else ("mm", MM)
        how = f"{count} tests of {POINTS} points; {len(half)} of them lie in the inner half: {scale * top:.3g} "
        how += f"against {scale * bottom:.3g} {unit} RMS."
        yield context.check(f"004.sensitivity.{name}").evaluate(top / bottom, _ratio(over, under, column), how, 1.0)
    few = np.array([[t.errors(t.turn, slice(k, None, FEW))[0] for k in range(FEW)] for t in tests])
    every = np.array([t.errors(t.turn, whole)[0] for t in tests])
    gain = rms(few) / rms(every)
    how = (
        f"{count} tests, angles compensated: RMS error of f {MM * rms(every):.3f} mm with {POINTS} points, "
        f"{MM * rms(few):.3f} mm with {POINTS // FEW}. Independent errors would gain {FEW**0.5:.2f}; what the "
        "compensation leaves is common to neighbouring points and gains nothing."
    )
    yield context.check("004.sensitivity.points").evaluate(gain, None, how, 1.0)
    yield _requirement(context, tests)


def _ratio(over: Array, under: Array, column: int) -> float:
    """Standard deviation of a ratio of RMS over tests, by leaving one out at a time."""
    n = len(over)
    keep = ~np.eye(n, dtype=bool)
    values = np.array([rms(over[k, column]) / rms(under[k, column]) for k in keep])
    return float(np.sqrt((n - 1) * np.var(values)))


def evaluate_angles(check: Check, runs: Sequence[SimulatedDistortion]) -> CheckResult:
    """What is left of the dividing error in the angles of the tests."""
    tests = [SpotTest(run) for run in runs]
    own, raw = (
        np.array([np.std(angle(t) - t.true_turn) for t in tests]) / ARCSEC
        for angle in (lambda t: t.turn, lambda t: t.run.raw.fit.angle)
    )
    how = (
        f"{len(tests)} tests, angles of {POINTS} points against the true ones: median {np.median(own):.3f}″; "
        f"angles as read {np.median(raw):.3f}″, largest {np.max(raw):.3f}″. What all points share is the zero, see "
        "004.eq1.constant."
    )
    value = float(np.max(own))
    return check.evaluate(value, None, how, inputs=[dividing(value)])


def _requirement(context: Context, tests: Sequence[SpotTest]) -> CheckResult:
    rng = np.random.default_rng(np.random.SeedSequence(context.seed, spawn_key=(1,)))
    wrong = FIT_RMS_ARCSEC * ARCSEC
    error = [t.errors(t.true_turn + rng.normal(0.0, wrong, len(t.turn)), slice(None))[1] for t in tests]
    f, points = float(np.mean([t.camera.f for t in tests])), len(tests[0].turn)
    expected = f * wrong * np.sqrt(1.0 - 3.0 / points)
    how = (
        f"The rendered spots of {len(tests)} tests with their true angles and errors of {FIT_RMS_ARCSEC:g}″ drawn from "
        "point to point; constant, f and p fitted. Errors with long waves would leave less."
    )
    needed = FIT_RMS_ARCSEC * ACCURACY_UM / (UM * expected)
    sigma = UM * expected / np.sqrt(2.0 * points * len(tests))
    return context.check("004.sensitivity.requirement").evaluate(
        UM * rms(np.array(error)), sigma, how, None, [UM * expected], facts={"asked": FIT_RMS_ARCSEC, "needed": needed}
    )


def reduction_svg(errors: NDArray[np.float64], paper: tuple[float, float], reduction: float) -> str:
    """RMS with compensated over RMS with raw angles, micrometres.

    Args:
        errors: of each test (T, 2), raw and compensated.
        paper: the same of the paper's Table 2.
        reduction: that the paper claims.
    """
    with look("reduction-004"):
        figure = new_figure(4.2)
        axes = figure.subplots()
        top = 1.08 * max(float(np.max(errors)), *paper)
        ends = np.array([0.0, top])
        share = 1.0 - reduction
        axes.plot(ends, ends, color=GREY, lw=0.8)
        axes.plot(ends, share * ends, color=GREY, lw=0.8, ls="--")
        for slope, text in ((1.0, "no change"), (share, f"{100 * reduction:.0f} % lower, as printed")):
            axes.annotate(text, (top, slope * top), (4, 0), textcoords="offset points", va="center", color=GREY)
        axes.plot(*errors.T, "o", color=BLUE, ms=6.0, mec="white", mew=0.6, label="simulated test, error")
        axes.plot([paper[0]], [paper[1]], "s", color=INK, ms=7.0, label="paper 004, Table 2")
        axes.set_xlim(0.0, top)
        axes.set_ylim(0.0, top)
        axes.set_xlabel("RMS, angles as read [µm]")
        axes.set_ylabel("RMS, compensated angles [µm]")
        axes.legend(loc="upper left")
        plain_axes(axes)
        return to_svg(figure)


def points_svg(by_eq2: NDArray[np.float64], free: NDArray[np.float64]) -> str:
    """Principal points of T tests.

    Args:
        by_eq2: error of the zero in arcsec, p of (2) and p that the zero explains in mm, (T, 3).
        free: p with a constant term and its sigma, mm, (T, 2).
    """
    with look("principal-point-004"):
        figure = new_figure(3.6)
        left, right = figure.subplots(1, 2)
        zero, found, explained = by_eq2[np.argsort(by_eq2[:, 0])].T
        left.plot(zero, explained, color=GREY, lw=0.9, label="traced camera, zero wrong by so much")
        left.plot(zero, found, "o", color=BLUE, ms=5.0, mec="white", mew=0.5, label="p of (2), rendered spots")
        left.set_xlabel("error of the zero of W [arcsec]")
        left.set_ylabel("p [mm]")
        left.set_title("(2) as printed")
        left.legend(loc="best")
        number = np.arange(1, len(free) + 1)
        right.axhline(0.0, color=INK, lw=0.7)
        right.errorbar(number, free[:, 0], free[:, 1], fmt="o", color=VERMILION, ms=4.0, lw=0.9)
        right.set_xlabel("test")
        right.set_ylabel("p [mm]")
        right.set_title("with a constant term")
        for axes in (left, right):
            plain_axes(axes)
        return to_svg(figure)


GROUP = group_of("004.distortion", run)
