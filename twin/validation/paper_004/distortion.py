"""Checks of paper 004 (Li et al. 2020), sections 3.1 and 3.3: eqs. (1) to (4), Table 2 and sources of error.

Distortion tests use rendered collimator spots and exact chief rays. Measured values are positions of spots in rendered
images and angles from the readings of a compensated turntable. True values are chief rays of the as-built camera traced
at the true angles, and the nearest camera without distortion. Without noise the equations are solved on chief rays of
the camera as designed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

from analysis.arrays import ARCSEC, Array
from analysis.arrays import MM_PER_M as MM
from analysis.arrays import UM_PER_M as UM
from analysis.orientation.interior import distortion, principal_distance, principal_distance_and_point, principal_point
from analysis.statistics import rms
from optics.geometry.pose import rotation_matrix
from optics.numerics.backend import Backend, one_blas_thread
from scenes.models.camera_model import ROOT, build_camera_under_test
from scenes.specs.resolved import DistortionSetup
from twin.framework.artefact import Cell
from twin.framework.svg import BLUE, GREY, INK, VERMILION
from twin.laboratory.distortion_bench import DistortionBench
from twin.laboratory.distortion_run import SimulatedDistortion, measure
from twin.targets.target_path import TargetPath
from twin.validation.check import CheckResult, Chosen, mean_of, median_of
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.paper_004.turntable_checks import FIT_RMS_ARCSEC, dividing

TEST = "distortion"
_PRINTED = load_printed("004")
ACCURACY_UM = _PRINTED.number("distortion.accuracy_um")
POINTS, SETS = (_PRINTED.whole(f"distortion.{name}") for name in ("points", "sets"))
RAW, COMPENSATED = (np.array(_PRINTED.column(f"table2.{name}_um")) for name in ("raw", "compensated"))
TESTS, FAST_TESTS = 60, 14
"""Numbers of simulated distortion tests in a full and in a fast run.

Each has another turntable, calibration, zero, axis, detector and noise.
"""
FEW = 5
"""Step between the points of a reduced set (every fifth point), to check the effect of the number of points."""
UNEVEN = slice(0, 44)
"""Points from one end of the line to six tenths of the other half, for the check of uneven spacing.

For these points the estimates of f and p by eq. (2) are correlated, and the camera's radial distortion causes a
principal point p of 54 mm, far above the noise.
"""
_PRINTED_ONLY = {f"004.table2.{name}" for name in ("reduction", "mean", "largest", "bound")}


@dataclass(frozen=True, eq=False)
class Perspective:
    """Distortion-free camera that fits chief rays best, L = f tan(W - w) + f tan w.

    L is the position along the line, W the angle of the direction, w the tilt of the camera's axis.

    Attributes
    ----------
    f : float
        Principal distance, metres.
    p : float
        Principal point f tan w, metres.
    rest : Array
        Distortion of the N rays: their positions minus this model, (N,), metres.
    """

    f: float
    p: float
    rest: Array

    @property
    def slope(self) -> float:
        """Slope dL / d tan W at the middle, f / cos² w, in metres.

        It replaces f in eq. (1), which expands to first order in the tilt w; it differs from f by p² / f.
        """
        return self.f + self.p**2 / self.f

    @classmethod
    def nearest(cls, where: Array, angle: Array, tilted: bool = True) -> Perspective:
        """Fit the distortion-free camera to chief rays by nonlinear least squares, without series expansion.

        Parameters
        ----------
        where : (N,) ndarray
            Positions of N chief rays along the line, metres.
        angle : (N,) ndarray
            Angles W of their directions, radians.
        tilted : bool
            True to estimate the principal point p; False for p = 0.
        """
        start = (where[-1] - where[0]) / (np.tan(angle[-1]) - np.tan(angle[0]))

        def rest(guess: Array) -> Array:
            f, w = start * (1.0 + guess[0]), guess[1] if tilted else 0.0
            return np.asarray(where - f * (np.tan(angle - w) + np.tan(w)))

        fit = least_squares(rest, np.zeros(1 + tilted), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        f = start * (1.0 + float(fit.x[0]))
        return cls(f, f * float(np.tan(fit.x[1])) if tilted else 0.0, rest(fit.x))


@dataclass(frozen=True, eq=False)
class SpotTest:
    """Positions L and angles W of one rendered distortion test, with their true values.

    L is the position of a point along the line CCD, W the angle of its direction.
    """

    run: SimulatedDistortion

    @cached_property
    def position(self) -> Array:
        """Positions L of the N points along the line, measured in the images, (N,), metres."""
        return self.run.compensated.fit.position

    @cached_property
    def angle(self) -> Array:
        """Angles W of the N points by compensated readings, from the zero that the operator set, (N,), radians."""
        return self.run.compensated.fit.angle

    @cached_property
    def zeroed(self) -> Array:
        """Angles W of the N points, from the zero that a fit with a constant term estimates, (N,), radians."""
        return np.asarray(self.angle - self.run.compensated.zero)

    @cached_property
    def true_position(self) -> Array:
        """True positions L of the N chief rays along the line, (N,), metres."""
        return self.run.means.mean(self.run.truth.position[..., 0])

    @cached_property
    def true_angle(self) -> Array:
        """True angles W of the N points, (N,), radians."""
        return self.run.means.mean(self.run.truth.field_angle)

    @cached_property
    def camera(self) -> Perspective:
        """Principal distance, principal point and distortion of the traced camera."""
        return Perspective.nearest(self.true_position, self.true_angle)

    @cached_property
    def part(self) -> Perspective:
        """Principal distance, principal point and distortion of the traced camera from unevenly spaced points."""
        return Perspective.nearest(self.true_position[UNEVEN], self.true_angle[UNEVEN])

    @property
    def zero(self) -> float:
        """Error of the zero of the angles W, mean over the points, in radians."""
        return float(np.mean(self.angle - self.true_angle))

    def shifted(self, *powers: int) -> tuple[Array, Array]:
        """Return the effect of the wrong angle zero alone on a least-squares fit of powers of tan W to the chief rays.

        The effect consists of the coefficients of the P powers, (P,), and of the residuals at the N points, (N,), in
        metres.
        """
        columns = np.tan(self.true_angle)[:, None] ** np.array(powers)
        # what the camera images to W stands beside W + zero
        moved = -self.camera.f * self.zero * (1.0 + np.tan(self.true_angle) ** 2)
        coefficients = np.linalg.lstsq(columns, moved)[0]
        return coefficients, np.asarray(moved - columns @ coefficients)

    def errors(self, angle: Array, points: slice | NDArray[np.intp]) -> tuple[float, float]:
        """Return the error of f and the RMS error of the distortion, metres, for selected points with given angles.

        A constant, f and p are fitted to these points.
        """
        f, rest = _fitted(self.position[points], angle[points])
        f_true, rest_true = _fitted(self.true_position[points], self.true_angle[points])
        return f - f_true, rms(rest - rest_true)


def _fitted(where: Array, angle: Array) -> tuple[float, Array]:
    columns = np.tan(angle)[:, None] ** np.arange(3)
    coefficients = np.linalg.lstsq(columns, where)[0]
    return float(coefficients[1]), np.asarray(where - columns @ coefficients)


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the checks of Table 2 and of distortion tests from rendered spots."""
    yield from _table2(context)
    if not context.selected - _PRINTED_ONLY:
        return
    tests = [SpotTest(run) for run in measured_tests(context)]
    points, sets = tests[0].run.record.reading.shape
    spots = len(tests) * points * sets
    facts: dict[str, Any] = {
        "tests": tests,
        "rendered": f"{len(tests)} tests of {points} points and {sets} sets, {spots} spots rendered",
        "points": POINTS,
        "sets": SETS,
        "accuracy": ACCURACY_UM,
    }
    yield from _eq1(context, tests, facts)
    yield from _eq2(context, tests, facts)
    yield _uneven(context, tests, facts, "004.eq4.uneven", lambda t, at: principal_point(*at, t.part.slope))
    yield from _sensitivity(context, tests, facts)
    yield from _errors_of_tests(context, tests, facts)
    _show(context, tests)


def measured_tests(context: Context) -> list[SimulatedDistortion]:
    """Run tests with rendered spots, each with another turntable."""
    with one_blas_thread():
        context.progress(0.0, "build the bench")
        bench = DistortionBench.build(DistortionSetup.read(TEST), context.backend)
        count = context.count(TESTS, FAST_TESTS)
        runs = []
        for k, seed in enumerate(np.random.SeedSequence(context.seed).generate_state(count)):
            context.progress(0.05 + 0.9 * k / count, f"test {k + 1} of {count}")
            runs.append(measure(bench, int(seed)))
    return runs


def lower(raw: float | np.floating, compensated: float | np.floating) -> float:
    """Return by how much the compensation reduces an error, in percent of the error with raw angles."""
    return float(100.0 * (1.0 - compensated / raw))


def _table2(context: Context) -> Iterator[CheckResult]:
    """Check the printed columns of Table 2."""
    raw, compensated = RAW, COMPENSATED
    changed = raw != compensated
    top = [np.eye(len(raw))[np.argmax(values)] for values in (raw, compensated)]
    share = [np.full(len(raw), 1.0 / len(raw))] * 2
    # derivatives of each statistic by the entries, over the statistic
    kinds = (
        ("reduction", rms(raw), rms(compensated), raw / np.sum(raw**2), compensated / np.sum(compensated**2)),
        ("mean", np.mean(raw), np.mean(compensated), share[0] / np.mean(raw), share[1] / np.mean(compensated)),
        ("largest", np.max(raw), np.max(compensated), top[0] / np.max(raw), top[1] / np.max(compensated)),
    )
    facts: dict[str, Any] = {"points": raw, "changed": np.sum(changed), "share": 100.0 * np.mean(changed)}
    facts |= {"worse": int(np.argmin(raw - compensated)) + 1, "worst": int(np.argmax(compensated)) + 1}
    for name, first, second, before, after in kinds:
        value = lower(first, second)
        # the last digit stands for values within 0.1; a point that is the same in both columns has one rounding
        parts = np.where(changed, np.hypot(before, after), np.abs(before - after))
        sigma = (100.0 - value) * 0.1 / np.sqrt(12.0) * float(np.linalg.norm(parts))
        yield context.row(f"004.table2.{name}", value, sigma, first=first, second=second, **facts)
    yield context.row("004.table2.bound", float(np.max(compensated)), **facts)


Facts = Mapping[str, Any]
"""Computed values that the texts of all checks with rendered tests may name."""


def _eq1(context: Context, tests: Sequence[SpotTest], facts: Facts) -> Iterator[CheckResult]:
    printed, freed = (np.array([_by_eq1(t, w(t)) for t in tests]) for w in (lambda t: t.angle, lambda t: t.zeroed))
    left = rms([t.shifted(1, 2)[1] for t in tests])
    alone = rms([t.position - principal_distance(t.position, t.angle) * np.tan(t.angle) - t.camera.rest for t in tests])
    zero = rms([t.zero for t in tests])
    need = ACCURACY_UM / (UM * left) * zero
    noise = UM * rms(freed) / np.sqrt(len(tests))
    more: dict[str, Any] = {"zero": zero, "alone": alone, "need": need, "freed": freed}
    yield context.row("004.eq1.constant", UM * rms(printed), noise, None, [UM * left], **facts, **more)
    value = UM * float(np.max(freed))
    yield context.row("004.eq1.zero", value, inputs=[dividing(value)], **facts, **more)


def _by_eq1(test: SpotTest, angle: Array) -> float:
    """Return the RMS error of the distortion by eq. (1) with f and p of eq. (2), in metres."""
    f, p = principal_distance_and_point(test.position, angle)
    return rms(distortion(test.position, angle, f, p) - test.camera.rest)


def _eq2(context: Context, tests: Sequence[SpotTest], facts: Facts) -> Iterator[CheckResult]:
    f_true, p_true = (np.array([getattr(t.camera, name) for t in tests]) for name in ("f", "p"))
    both = np.array([principal_distance_and_point(t.position, t.angle) for t in tests])
    alone = np.array([principal_distance(t.position, t.angle) for t in tests])
    fits = [t.run.compensated.fit for t in tests]
    f, f_sigma, p, p_sigma = (
        np.array([getattr(fit, part)(name) for fit in fits])
        for name in ("principal_distance", "principal_point")
        for part in ("value", "sigma")
    )

    def distance(fitted: Array, equation: str) -> CheckResult:
        scatter = MM * float(np.std(fitted - f_true, ddof=1))
        # truth differs by a micrometre between tests
        value, truth = MM * (np.mean(f_true) + np.mean(fitted - f_true)), MM * float(np.mean(f_true))
        sigma = scatter / np.sqrt(len(tests))
        return context.row("004.eq2.f", value, sigma, truth, equation=equation, scatter=scatter, **facts)

    def zero(fitted: Array, predicted: Array, equation: str) -> CheckResult:
        """Check the principal point by one of the paper's equations, which depends on the error of the angles' zero."""
        error, offset = fitted - p_true, rms([t.zero for t in tests])
        more: dict[str, Any] = {
            "equation": equation,
            "true": np.mean(p_true),
            "zero": offset,
            "rest": rms(error - predicted),
        }
        more["per_arcsec"] = MM * rms(predicted) / (offset / ARCSEC)
        sigma = MM * rms(p_sigma) / np.sqrt(len(tests))
        return context.row("004.eq2.p", MM * rms(error), sigma, None, [MM * rms(predicted)], **facts, **more)

    yield context.check("004.eq2.f").worse(distance(both[:, 0], "(2)"), distance(alone, "(3)"))
    score = (f - f_true) / f_sigma
    more = {"within": np.sum(np.abs(score) < 2.0), "f_sigma": f_sigma}
    yield context.row("004.eq2.distance", rms(score), 1.0 / np.sqrt(2 * len(tests)), 1.0, **facts, **more)
    known = np.array([principal_point(t.position, t.angle, t.camera.f) for t in tests])
    predicted = [np.array([-t.shifted(*powers)[0][-1] for t in tests]) for powers in ((1, 2), (2,))]
    check = context.check("004.eq2.p")
    yield check.worse(zero(both[:, 1], predicted[0], "(2)"), zero(known, predicted[1], "(4)"))
    yield _uneven(context, tests, facts, "004.eq2.uneven", lambda t, at: principal_distance_and_point(*at)[1])
    pitch = tests[0].run.bench.ccd.band.pitch
    error, sigma = rms(p - p_true) / pitch, rms(p_sigma) / pitch
    more = {
        "edge": float(np.tan(tests[0].true_angle[-1]) ** 2),
        "error": pitch * error,
        "predicted": pitch * sigma,
        "correlation": np.median([[abs(fit.correlation[2, k]) for k in (0, 1)] for fit in fits], axis=0),
    }
    yield context.row("004.eq2.point", error, error / np.sqrt(2 * len(tests)), None, [sigma], **facts, **more)


def _uneven(
    context: Context,
    tests: Sequence[SpotTest],
    facts: Facts,
    identifier: str,
    solve: Callable[[SpotTest, tuple[Array, Array]], Any],
) -> CheckResult:
    """Check the principal point by one of the paper's equations for unevenly spaced points."""
    points = np.array([solve(t, (t.position[UNEVEN], t.zeroed[UNEVEN])) for t in tests])
    true, angle = np.array([t.part.p for t in tests]), tests[0].true_angle[UNEVEN]
    scatter = MM * float(np.std(points - true, ddof=1))
    value, truth = MM * float(np.mean(true) + np.mean(points - true)), MM * float(np.mean(true))
    more: dict[str, Any] = {"uneven": angle, "scatter": scatter}
    return context.row(identifier, value, scatter / np.sqrt(len(tests)), truth, **facts, **more)


def _sensitivity(context: Context, tests: Sequence[SpotTest], facts: Facts) -> Iterator[CheckResult]:
    """Check the paper's statements about the sources of error."""
    if not context.wants("004.sensitivity"):
        return
    half = np.flatnonzero(np.abs(tests[0].run.bench.field_angle) <= 0.5 * tests[0].run.bench.field_angle[-1])
    whole = slice(None)
    raw = [np.asarray(t.run.raw.fit.angle) for t in tests]
    all_raw, inner = (np.array([t.errors(w, k) for t, w in zip(tests, raw, strict=True)]) for k in (whole, half))
    with_compensation = rms([t.errors(t.angle, whole)[1] for t in tests])
    spots = rms([t.errors(t.true_angle, whole)[1] for t in tests])
    by_spots, by_angles = spots**2, with_compensation**2 - spots**2
    chosen = Chosen(
        "dividing error of scenes/lab/turntable.yaml, times", 1.0, "1",
        lambda factor: 100.0 * (1.0 - by_spots / (by_spots + factor**2 * by_angles)),
    )  # fmt: skip
    more: dict[str, Any] = {"compensated": with_compensation, "spots": spots, "as_read": rms(all_raw[:, 1])}
    share = 100.0 * (1.0 - by_spots / with_compensation**2)
    yield context.row("004.sensitivity.angle", share, None, 50.0, inputs=[chosen], **facts, **more)
    for name, column, over, under in (("field", 1, all_raw, inner), ("distance", 0, inner, all_raw)):
        top, bottom = rms(over[:, column]), rms(under[:, column])
        more = {"half": half, "top": top, "bottom": bottom}
        sigma = _ratio(over, under, column)
        yield context.row(f"004.sensitivity.{name}", top / bottom, sigma, 1.0, **facts, **more)
    few = rms([t.errors(t.angle, slice(k, None, FEW))[0] for t in tests for k in range(FEW)])
    total = rms([t.errors(t.angle, whole)[0] for t in tests])
    more = {"few": few, "total": total, "fewer": POINTS // FEW, "gain": FEW**0.5}
    yield context.row("004.sensitivity.points", few / total, None, 1.0, **facts, **more)
    rng = np.random.default_rng(np.random.SeedSequence(context.seed, spawn_key=(1,)))
    wrong = FIT_RMS_ARCSEC * ARCSEC
    error = UM * rms([t.errors(t.true_angle + rng.normal(0.0, wrong, len(t.angle)), whole)[1] for t in tests])
    points = len(tests[0].angle)
    expected = UM * float(np.mean([t.camera.f for t in tests])) * wrong * np.sqrt(1.0 - 3.0 / points)
    more = {"asked": FIT_RMS_ARCSEC, "needed": FIT_RMS_ARCSEC * ACCURACY_UM / expected}
    sigma = expected / np.sqrt(2.0 * points * len(tests))
    yield context.row("004.sensitivity.requirement", error, sigma, None, [expected], **facts, **more)


def _ratio(over: Array, under: Array, column: int) -> float:
    """Return the jackknife standard deviation of a ratio of RMS values over several tests."""
    n = len(over)
    keep = ~np.eye(n, dtype=bool)
    values = np.array([rms(over[k, column]) / rms(under[k, column]) for k in keep])
    return float(np.sqrt((n - 1) * np.var(values)))


def _errors_of_tests(context: Context, tests: Sequence[SpotTest], facts: Facts) -> Iterator[CheckResult]:
    """Check the remaining dividing error of the angles and the remaining error of the distortion."""
    compensated, raw = (
        np.array([np.std(angle(t) - t.true_angle) for t in tests]) / ARCSEC
        for angle in (lambda t: t.angle, lambda t: t.run.raw.fit.angle)
    )
    value = float(np.max(compensated))
    row = "004.turntable.compensated"
    yield context.row(row, value, inputs=[dividing(value)], compensated=compensated, raw=raw, **facts)
    raw, compensated = _errors(tests).T
    value = float(np.max(compensated))
    yield context.row("004.table2.accuracy", value, inputs=[dividing(value)], compensated=compensated, raw=raw, **facts)
    runs = [t.run for t in tests]
    less = 100.0 * (1.0 - compensated / raw)
    # known better than sigma, but the printed figure is of one table
    more: dict[str, Any] = {
        "less": less,
        "quartiles": np.percentile(less, [25.0, 75.0]),
        "over_sets": [-lower(rms(r.raw.rms_over_sets), rms(r.compensated.rms_over_sets)) for r in runs],
        "known": median_of(less)[1],
    }
    value, sigma = float(np.median(less)), float(np.std(less, ddof=1))
    yield context.row("004.table2.compensation", value, sigma, inputs=[dividing(value, 0.0)], **facts, **more)
    columns = [[np.round(UM * m.rms_over_sets, 1) for m in (r.raw, r.compensated)] for r in runs]
    share = np.array([100.0 * np.mean(first != second) for first, second in columns])
    # two values d apart are the same tenth of a micrometre with a chance of 1 - d / 0.1 um
    moved = np.abs(UM * np.array([_moved(test) for test in tests]))
    expected = 100.0 * float(np.mean(np.minimum(moved / 0.1, 1.0)))
    more = {"share": share, "worse": 100.0 * float(np.mean([second > first for first, second in columns]))}
    value, sigma = mean_of(share)
    yield context.row("004.table2.points", value, sigma, None, [expected], **facts, **more)


def _moved(test: SpotTest) -> Array:
    """Return the change of the distortion at N points due to a correction of the readings, (N,), in metres.

    It is the principal distance f times the correction, without the part that the fit of zero, f and p absorbs.
    """
    correction = test.camera.f * (test.angle - test.run.raw.fit.angle)
    columns = np.tan(test.angle)[:, None] ** np.arange(3)
    return np.asarray(correction - columns @ np.linalg.lstsq(columns, correction)[0])


def _errors(tests: Sequence[SpotTest]) -> Array:
    """Return the RMS errors of the distortion in T tests with raw and with compensated angles, (T, 2), micrometres."""
    runs = [test.run for test in tests]
    return np.array([[UM * rms(run.error(m)) for m in (run.raw, run.compensated)] for run in runs])


def _show(context: Context, tests: Sequence[SpotTest]) -> None:
    raw, compensated = RAW, COMPENSATED
    changes = {"paper 004, Table 2": (raw[None], compensated[None])}
    kinds: dict[str, Callable[[SimulatedDistortion], tuple[Array, Array]]] = {
        "error of the distortion (needs the truth)": lambda r: (r.error(r.raw), r.error(r.compensated)),
        "distance from a smooth curve": lambda r: (r.raw.smooth.residual, r.compensated.smooth.residual),
        "RMS of distortion over the sets": lambda r: (r.raw.rms_over_sets, r.compensated.rms_over_sets),
    }
    for name, pick in kinds.items():
        both = np.abs(UM * np.array([pick(test.run) for test in tests]))
        changes[name] = both[:, 0], both[:, 1]
    rows: list[list[Cell]] = [[name, *_statistics(*both)] for name, both in changes.items()]
    context.table("table2", rows, points=POINTS, tests=tests)
    reduction = 0.01 * _PRINTED.number("distortion.reduction_percent")
    context.figure("reduction", reduction_svg(_errors(tests), (rms(raw), rms(compensated)), reduction))
    # error of the zero, p of (2), and p that the zero explains
    by_eq2 = [
        (t.zero / ARCSEC, MM * principal_distance_and_point(t.position, t.angle)[1], -MM * t.shifted(1, 2)[0][1])
        for t in tests
    ]
    fits = [t.run.compensated.fit for t in tests]
    free = [(MM * fit.value("principal_point"), MM * fit.sigma("principal_point")) for fit in fits]
    context.figure("principal-point", points_svg(np.array(by_eq2, np.float64), np.array(free)))


def _statistics(raw: Array, compensated: Array) -> list[Cell]:
    """Return RMS, mean and maximum of the errors over N points, with the reductions by compensation.

    They are medians over T tests; ``raw`` and ``compensated`` hold the errors, (T, N).
    """
    out: list[Cell] = []
    for size in (lambda v: np.sqrt(np.mean(v**2, axis=1)), lambda v: np.mean(v, axis=1), lambda v: np.max(v, axis=1)):
        before, after = size(raw), size(compensated)
        values = np.median(before), np.median(after), np.median(100.0 * (1.0 - after / before))
        out += [f"{values[0]:.3f}", f"{values[1]:.3f}", f"{values[2]:.1f}"]
    return out


@drawing("reduction-004", 4.2)
def reduction_svg(figure: Figure, errors: NDArray[np.float64], paper: tuple[float, float], reduction: float) -> None:
    """Draw the RMS error with compensated angles divided by that with raw angles, for T tests and for the paper.

    The errors are (T, 2), raw and compensated, in micrometres; the reduction is the one that the paper claims.
    """
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


@drawing("principal-point-004", 3.6)
def points_svg(figure: Figure, by_eq2: NDArray[np.float64], free: NDArray[np.float64]) -> None:
    """Draw the principal points p of T tests.

    The first array (T, 3) has the error of the angles' zero in arcsec, p by eq. (2) and the p that this error explains,
    in mm; the second (T, 2) has p from a fit with a constant term and its sigma, in mm.
    """
    left, right = figure.subplots(1, 2)
    zero, estimated, explained = by_eq2[np.argsort(by_eq2[:, 0])].T
    left.plot(zero, explained, color=GREY, lw=0.9, label="traced camera, zero wrong by so much")
    left.plot(zero, estimated, "o", color=BLUE, ms=5.0, mec="white", mew=0.5, label="p of (2), rendered spots")
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


def chief_rays(setup: DistortionSetup, backend: Backend) -> Callable[[Array], Array]:
    """Return the exact mapping of the camera as designed from rotations of a table to image positions.

    Rotations W of N points, (N,), in radians, are about the camera's X; positions L, (N,), in metres, are those of
    chief rays along the line, from the image of W = 0.
    """
    test = setup.test
    camera = build_camera_under_test(test, setup.camera, backend)
    path = TargetPath(camera.assembly, ROOT, ROOT, camera.model, backend)
    middle = path.directions(np.array([[0.0, setup.camera.bands[test.band].offset]]))[0]
    axis = np.array([1.0, 0.0, 0.0])

    def positions(angle: Array) -> Array:
        light = rotation_matrix(np.append(angle, 0.0)[:, None] * axis) @ middle
        along = path.positions({}, light)[:, 0]
        return np.asarray(along[:-1] - along[-1])

    return positions


def run_equations(context: Context) -> Iterator[CheckResult]:
    """Check the printed equations on traced chief rays, without noise."""
    context.progress(0.0, "trace chief rays")
    setup = DistortionSetup.read(TEST)
    positions = chief_rays(setup, context.backend)
    band, test = setup.camera.bands[setup.test.band], setup.test
    half = 0.5 * test.extent * band.pixels * band.pitch
    rough = float(positions(np.array([1e-3]))[0]) / 1e-3
    edge = float(np.arctan(half / rough))
    yield from _solutions(context, positions, edge)
    yield _ignored(context, positions, edge * np.linspace(-1.0, 1.0, test.points), band.pitch)
    end, most = 0.5 * band.pixels * band.pitch, 1.02 * edge / test.extent
    whole = _angle_to(positions, end, most) - _angle_to(positions, -end, most)
    yield context.row("004.turntable.range", np.degrees(whole), band=band)


def _angle_to(positions: Callable[[Array], Array], wanted: float, most: float) -> float:
    """Return the rotation of the table, within ±``most``, that is imaged to a given position on the line, radians."""
    return float(brentq(lambda w: float(positions(np.array([w]))[0]) - wanted, -most, most, xtol=1e-14))


def _ignored(context: Context, positions: Callable[[Array], Array], angle: Array, pitch: float) -> CheckResult:
    """Check eq. (3) with positions and angles counted from a point one pixel off the middle of the line."""
    where, beside = positions(angle), _angle_to(positions, pitch, float(angle[-1]))
    shift = float(positions(np.array([beside]))[0])
    first = distortion(where, angle, principal_distance(where, angle))
    moved = where - shift, angle - beside
    second = distortion(*moved, principal_distance(*moved))
    change = float(np.max(np.abs(second - first)))
    facts: dict[str, Any] = {
        "angle": angle,
        "shift": shift,
        "change": change,
        "undistorted": pitch * np.tan(angle[-1]) ** 2,
        "accuracy": ACCURACY_UM,
        "most": MM * pitch * 1e-6 * ACCURACY_UM / change,
    }
    return context.row("004.eq3.ignored", UM * change, **facts)


def _solutions(context: Context, positions: Callable[[Array], Array], edge: float) -> Iterator[CheckResult]:
    """Check eqs. (2), (3) and (4) against a singular value decomposition of eq. (1)."""
    # not even about the middle, so that no sum vanishes and an error in any of them shows
    angle = edge * np.linspace(-1.0, 0.6, POINTS)
    where, t = positions(angle), np.tan(angle)
    f, p = (float(v) for v in principal_distance_and_point(where, angle))
    alone = float(principal_distance(where, angle))
    known = float(principal_point(where, angle, alone))
    columns = np.column_stack([t, -(t**2)])
    both = np.linalg.lstsq(columns, where)[0]
    first = np.linalg.lstsq(columns[:, :1], where)[0]
    second = np.linalg.lstsq(columns[:, 1:], where - alone * t)[0]
    solutions = {
        "eq2": (np.array([f, p]) - both, f"f = {MM * f:.4f} mm, p = {MM * p:.4f} mm"),
        "eq3": (alone - first, f"f = {MM * alone:.4f} mm"),
        "eq4": (known - second, f"p = {MM * known:.4f} mm with f of (3)"),
    }
    for name, (difference, values) in solutions.items():
        worst = UM * float(np.max(np.abs(difference)))
        yield context.row(f"004.{name}.solution", worst, implied=0.0, angle=angle, values=values)


GROUP = group_of("004.distortion", run)
EQUATIONS = group_of("004.equations", run_equations)
FIGURES = group_of("004.figures")
"""Group of checks about the paper's figures without numbers, for which nothing can be compared."""
