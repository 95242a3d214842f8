"""Turntable test of paper 004 (Li et al. 2020, section 3.3).

It determines the dividing error of a table from comparisons with a reference.

Five functions are fitted to the comparisons and ranked on angles that no fit has used. The analysis gets the
comparisons and the certificate of the reference, of a simulated bench or from files of measurements. The true dividing
error of a simulated table serves for comparison only.

Dividing error = reading - true angle: the table that reads R is at the true angle phi = R - e(R) with the dividing
error e. It is a sum of harmonics of the full turn; the subdivision error, a part of it, is a few harmonics of the
grating's signal. All coefficients are drawn from the seed, so that the turntable test and the distortion test of one
seed use the same table. All angles are in radians.

The records at the end define the contents of turntable.json.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.statistics import p_value_of, rms
from analysis.turntable import dividing_error
from optics.numerics.backend import Backend, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera_tests import DividingErrorSpec, MeasuredTurntableSpec, TurntableFiles, TurntableTestSpec
from scenes.specs.resolved import ExperimentSetup
from twin.framework.procedure import Advance, silent, stream
from twin.framework.record import Quantity, Record
from twin.laboratory.measured_readings import Comparisons, DataFile, read_turntable

_TABLE, _CALIBRATION, _HELD_OUT, _SPREAD = range(4)
"""Numbers of the random streams of the seed.

They are for the table's dividing error, the comparisons of the calibration, the held-out comparisons, and the random
offsets of their angles.
"""
_FIXED_POINT_STEPS = 8
"""Fixed-point iterations from a true angle to a reading; they leave less than rounding errors."""


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Periodic function of a turntable reading R: sum over k of cosine_k cos(k R) + sine_k sin(k R), radians.

    Attributes
    ----------
    order : (K,) ndarray of int
        Numbers k of periods in a full turn, for K harmonics.
    cosine, sine : (K,) ndarray
        Coefficients, radians.
    """

    order: NDArray[np.int64]
    cosine: Array
    sine: Array

    @classmethod
    def draw(cls, order: ArrayLike, rms: Array, rng: np.random.Generator) -> Harmonics:
        """Return a function with random, normally distributed coefficients of its harmonics.

        The mean square of harmonic k over the circle is rms_k^2 on average.

        Parameters
        ----------
        order : (K,) array_like of int
            Numbers k of periods in a full turn, for K harmonics.
        rms : (K,) ndarray
            RMS of each harmonic, radians.
        rng : Generator
            Random generator.
        """
        k = np.asarray(order, np.int64)
        cosine, sine = rng.standard_normal((2, len(k))) * rms
        return cls(k, cosine, sine)

    def __call__(self, reading: ArrayLike) -> Array:
        """Return the value of the function at turntable readings (radians), in their shape, radians."""
        at = np.asarray(reading, np.float64)
        phase = at.ravel()[:, None] * self.order
        return (np.cos(phase) @ self.cosine + np.sin(phase) @ self.sine).reshape(at.shape)

    @property
    def rms(self) -> float:
        """RMS of the function over the full circle, radians."""
        return float(np.sqrt(0.5 * np.sum(self.cosine**2 + self.sine**2)))


@dataclass(frozen=True, eq=False)
class DividingError:
    """True dividing error of one table, reading - true angle, as a function of the reading.

    Attributes
    ----------
    parts : mapping
        Cause -> harmonics: axis, eccentricity, graduation, subdivision.
    """

    parts: Mapping[str, Harmonics]

    @classmethod
    def draw(cls, spec: DividingErrorSpec, seed: int) -> DividingError:
        """Return the random dividing error of a table, which specification and seed determine."""
        rng = np.random.default_rng(stream(seed, _TABLE))
        g, sub = spec.graduation, spec.subdivision
        lines = np.arange(g.first, g.last + 1)
        fall = lines ** -float(g.slope)
        waves = sub.lines * np.array(sub.harmonics)
        return cls(
            FrozenMap(
                {
                    "axis": Harmonics.draw([1, 2], np.full(2, spec.axis / np.sqrt(2.0)), rng),
                    "eccentricity": Harmonics.draw([1], np.full(1, spec.eccentricity), rng),
                    "graduation": Harmonics.draw(lines, spec.graduation.rms * fall / np.linalg.norm(fall), rng),
                    "subdivision": Harmonics.draw(waves, np.full(len(waves), sub.rms / np.sqrt(len(waves))), rng),
                }
            )
        )

    def __call__(self, reading: ArrayLike) -> Array:
        """Return the exact dividing error at readings, in their shape, radians."""
        return np.asarray(sum(part(reading) for part in self.parts.values()), np.float64)


@dataclass(frozen=True, eq=False)
class TurntableModel:
    """Simulated turntable and the reference with which it is compared.

    Attributes
    ----------
    spec : TurntableTestSpec
        Specification of the test.
    seed : int
        Seed of all random numbers.
    """

    spec: TurntableTestSpec
    seed: int

    @cached_property
    def error(self) -> DividingError:
        """True dividing error of the simulated table, which the analysis does not know."""
        return DividingError.draw(self.spec.dividing_error, self.seed)

    def true_angle(self, reading: ArrayLike, rng: np.random.Generator | None = None) -> Array:
        """Return the true angles of the table at these readings, in the shape of the readings, radians.

        Parameters
        ----------
        reading : array_like
            Readings, radians.
        rng : Generator, optional
            Random generator of the repeatability; None for a table that repeats perfectly.
        """
        readings = np.asarray(reading, np.float64)
        return readings - self.error(readings) - self._scatter(readings.shape, rng)

    def reading(self, true_angle: ArrayLike, rng: np.random.Generator | None = None) -> Array:
        """Return the readings of the table at these true angles, the inverse of `true_angle`, radians.

        For a true angle phi the reading R = phi + e(R), with the dividing error e, is solved by fixed-point iteration:
        |de/dR| is a few times 1e-2 (subdivision), so that eight steps leave less than rounding errors.
        """
        phi = np.asarray(true_angle, np.float64)
        scatter = self._scatter(phi.shape, rng)
        reading = phi + scatter
        for _ in range(_FIXED_POINT_STEPS):
            reading = phi + scatter + self.error(reading)
        return reading

    def _scatter(self, shape: tuple[int, ...], rng: np.random.Generator | None) -> Array:
        """Return random repeatability errors, radians; zeros without a generator."""
        if rng is None:
            return np.zeros(shape)
        return rng.normal(0.0, self.spec.dividing_error.repeatability, shape)

    def calibrate(self) -> dividing_error.CalibrationSeries:
        """Simulate the comparison of the table with the reference at equidistant readings of the region."""
        plan = self.spec.calibration
        return self._compare(self._steps(0.0, plan.count), plan.repeats, _CALIBRATION)

    def held_out(self) -> dividing_error.CalibrationSeries:
        """Simulate a separate series for validation, at angles between those of the calibration.

        The angles are in the middle of the steps, displaced at random by up to the specified spread.
        """
        plan = self.spec.calibration
        rng = np.random.default_rng(stream(self.seed, _SPREAD))
        off = rng.uniform(-plan.held_out.spread, plan.held_out.spread, plan.count - 1)
        return self._compare(self._steps(0.5, plan.count - 1) + off, plan.held_out.repeats, _HELD_OUT)

    def _steps(self, start: float, count: int) -> Array:
        """Return ``count`` readings one step apart, radians.

        The first one is ``start`` steps after the first calibrated reading.
        """
        plan = self.spec.calibration
        return np.asarray(plan.first + plan.step * (np.arange(count) + start), np.float64)

    def _compare(self, angle: Array, repeats: int, number: int) -> dividing_error.CalibrationSeries:
        """Simulate repeated comparisons of the table with the reference at given readings."""
        rng = np.random.default_rng(stream(self.seed, number))
        reference = self.spec.reference
        shape = len(angle), repeats
        reference_error = rng.normal(0.0, reference.calibration, len(angle))
        readings = np.broadcast_to(angle[:, None], shape)
        measured = self.true_angle(readings, rng) + reference_error[:, None] + rng.normal(0.0, reference.noise, shape)
        gross = rng.random(shape) < reference.gross_probability
        measured = measured + gross * rng.choice([-1.0, 1.0], shape) * reference.gross_error
        return dividing_error.CalibrationSeries(angle, readings - measured, reference.calibration)


TRUTH_READINGS = 4000
"""Number of readings at which fits are compared with the true curve."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
"""Golden ratio minus one; its multiples modulo 1 spread the readings evenly."""


@dataclass(frozen=True, eq=False)
class TurntableRun:
    """Turntable test on a simulated bench or on measured readings.

    Attributes
    ----------
    spec : TurntableTestSpec or MeasuredTurntableSpec
        Specification of the test.
    seed : int
        Seed of all random numbers: of the simulated bench, and of the network's starting values.
    series : CalibrationSeries
        Comparisons at the calibrated readings.
    held_out : CalibrationSeries or None
        Comparisons at readings that no fit has used; None if there are none.
    choice : Choice
        Fits and their cross-validation.
    compensation : DividingCompensation
        Compensation by the chosen fit.
    model : TurntableModel or None
        Simulated table and reference, which hold the true values; None for measurements.
    tables : tuple of Comparisons
        Series that were read from files; empty for a simulated bench.
    too_few : tuple of str
        Fits that need more angles than there are.
    """

    spec: TurntableTestSpec | MeasuredTurntableSpec
    seed: int
    series: dividing_error.CalibrationSeries
    held_out: dividing_error.CalibrationSeries | None
    choice: dividing_error.Choice
    compensation: dividing_error.DividingCompensation
    model: TurntableModel | None = None
    tables: tuple[Comparisons, ...] = ()
    too_few: tuple[str, ...] = ()

    @property
    def fits(self) -> dict[str, dividing_error.AngleFit]:
        """Name -> fit of the dividing error, for all fits that succeeded, in the order in which they were made."""
        return {name: trial.fit for name, trial in self.choice.trials.items()}

    def residual(self, name: str) -> Array:
        """Return measured - fitted dividing error at the N calibrated readings, (N,), radians."""
        return self.series.mean - self.fits[name](self.series.angle)

    def true_residual(self, name: str) -> Array:
        """Return fitted - true dividing error of a simulated table at `truth_readings`, radians."""
        return self.fits[name](self.truth_readings) - self.true_error

    def held_out_residual(self, name: str) -> Array:
        """Return measured - fitted dividing error at the held-out readings, radians."""
        assert self.held_out is not None
        return self.held_out.mean - self.fits[name](self.held_out.angle)

    def held_out_rms(self, name: str) -> float | None:
        """Return the RMS of measured - fitted dividing error at the held-out readings, radians; None without them."""
        return None if self.held_out is None else rms(self.held_out_residual(name))

    def _judged(self, name: str) -> float:
        """Return the RMS by which a fit is ranked, radians: at the held-out readings, or else by cross-validation."""
        held_out = self.held_out_rms(name)
        return self.choice[name].validation.rms if held_out is None else held_out

    @cached_property
    def ranking(self) -> tuple[str, ...]:
        """Names of the fits, the best first, by their RMS at held-out readings.

        Without held-out readings the RMS of the cross-validation is used.
        """
        return tuple(sorted(self.fits, key=self._judged))

    @cached_property
    def chi_square(self) -> tuple[float, float]:
        """Chi-square of the chosen fit's residuals at the calibrated readings, and its degrees of freedom."""
        square = float(np.sum((self.residual(self.choice.chosen) / self.series.sigma) ** 2))
        return square, len(self.series.angle) - self.compensation.fit.effective_parameters

    @cached_property
    def held_out_chi_square(self) -> tuple[float, int] | tuple[None, None]:
        """Chi-square of the residuals at the held-out readings, and its degrees of freedom; None without such readings.

        Their covariance is that of the readings plus the full covariance of the compensation.
        """
        if self.held_out is None:
            return None, None
        held, fit = self.held_out, self.compensation
        rest = held.mean - fit.error(held.angle)
        spread = np.diag(held.sigma**2) + fit.covariance(held.angle)
        return float(rest @ np.linalg.solve(spread, rest)), len(rest)

    @cached_property
    def truth_readings(self) -> Array:
        """Readings spread evenly over the region and over the phases of the grating's signal, increasing, radians."""
        first, last = self.compensation.region
        # multiples of the golden ratio have no common measure with the signal's period, unlike an even grid
        return np.sort(first + (last - first) * np.mod(_GOLDEN * np.arange(1, TRUTH_READINGS + 1), 1.0))

    @cached_property
    def true_error(self) -> Array:
        """True dividing error of a simulated table at `truth_readings`, radians."""
        assert self.model is not None
        return self.model.error(self.truth_readings)


def run_turntable(
    spec: TurntableTestSpec | MeasuredTurntableSpec,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    names: Sequence[str] = tuple(dividing_error.FITS),
) -> TurntableRun:
    """Simulate or read the comparisons, reject outliers, fit them, choose a fit and build its compensation.

    Parameters
    ----------
    spec : TurntableTestSpec or MeasuredTurntableSpec
        Specification of the test.
    seed : int
        Seed of all random numbers; with the specification it determines everything.
    progress : callable, optional
        Called with a text that says what is being done.
    names : sequence of str
        Names of the fits to make; the neural network takes nearly all of the time.

    Raises
    ------
    InputError
        A table cannot be used, or there are fewer angles than a fit and its cross-validation need.
    """
    report = progress or (lambda text: None)
    model: TurntableModel | None = None
    tables: tuple[Comparisons, ...] = ()
    held_out: dividing_error.CalibrationSeries | None = None
    too_few: tuple[str, ...] = ()
    if isinstance(spec, MeasuredTurntableSpec):
        report("read the comparisons")
        tables, folds = read_turntable(spec.measured), spec.measured.folds
        names, too_few = usable_fits(spec.measured, tables[0], names)
        series, held_out = tables[0].series, tables[1].series if len(tables) > 1 else None
    else:
        folds = spec.calibration.folds
        _check_count(spec, names)
        report("compare the table with the reference")
        model = TurntableModel(spec, seed)
        series, held_out = model.calibrate(), model.held_out()
    # the network's matrices are small
    with one_blas_thread():
        choice = dividing_error.choose(series, seed, names, folds, report)
        compensation = dividing_error.compensate(series, choice, held_out)
    return TurntableRun(spec, seed, series, held_out, choice, compensation, model, tables, too_few)


def _check_count(spec: TurntableTestSpec, names: Sequence[str]) -> None:
    """Raise InputError if the simulated calibration has too few angles for a fit."""
    plan = spec.calibration
    left = dividing_error.angles_left(plan.count, plan.folds)
    short = [name for name in names if left < dividing_error.fewest(name)]
    if short:
        value = f"{plan.count} angles, {left} of them without a fold of the cross-validation"
        problem, allowed = f"too few angles for the fit {short[0]!r}", dividing_error.fewest(short[0])
        key = ("calibration", "step")
        raise spec.error(problem, key, value=value, allowed=f"steps that leave {allowed} or more")


def usable_fits(
    files: TurntableFiles, comparisons: Comparisons, names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the fits for which there are enough angles, and the others.

    Raises
    ------
    InputError
        There are too few angles for any fit.
    """
    count = len(comparisons.series.angle)
    left = dividing_error.angles_left(count, files.folds)
    enough = tuple(name for name in names if left >= dividing_error.fewest(name))
    if not enough:
        text = f"{count} angles, {left} of them without a fold of the cross-validation"
        issue = files.error("too few angles for any fit", ("comparisons",), value=text, allowed="more angles or folds")
        raise issue
    return enough, tuple(name for name in names if name not in enough)


def run_turntable_test(
    setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> TurntableRun:
    """Run ``python -m twin.lab turntable``; no rays are traced, so that the backend is not used.

    Raises
    ------
    InputError
        A table cannot be used, or there are too few angles.
    """
    return run_turntable(setup.test, seed, lambda part: advance(part, 0, 1))


DOUBTFUL = 1e-3
"""p-value of a chi-square below which a warning is given."""


def likely(chi_square: float, degrees: int) -> bool | None:
    """Return True if the p-value of a chi-square is at least DOUBTFUL; None without degrees of freedom.

    Parameters
    ----------
    chi_square : float
        Chi-square of residuals against their sigmas.
    degrees : int
        Degrees of freedom.
    """
    return bool(p_value_of(chi_square, degrees) >= DOUBTFUL) if degrees else None


DATA_FILE: Record[DataFile] = Record(
    "A file of measurements.",
    Quantity("file", lambda f: f.file, "path as given"),
    Quantity("rows", lambda f: f.rows, "rows below its heads"),
    Quantity("sha256", lambda f: f.sha256, "SHA-256 of its contents"),
    Quantity("copied", lambda f: f.copied, "rows that repeat another one to the last digit"),
)
REJECTED: Record[Comparisons] = Record(
    "Comparison that Chauvenet's criterion rejects, and its line in the file.",
    Quantity("file", lambda c: [c.file.file] * c.series.rejected, "path of its table"),
    Quantity("line", lambda c: c.lines[c.series.excluded_comparisons], "line in this file"),
    Quantity(
        "reading_deg", lambda c: c.series.angle[np.nonzero(c.series.excluded_comparisons)[0]], "reading", decimals=6
    ),
    Quantity(
        "from_mean_arcsec",
        lambda c: c.series.from_mean[c.series.excluded_comparisons],
        "difference from the mean",
        "from the mean",
        3,
    ),
)
FIT: Record[tuple[TurntableRun, str]] = Record(
    "One fit of the dividing error; the source is the run and the fit's name.",
    Quantity("heldout_rms_arcsec", lambda s: s[0].held_out_rms(s[1]), "RMS residual", "held out", 4),
    Quantity("train_rms_arcsec", lambda s: rms(s[0].residual(s[1])), "RMS residual", "training points", 4),
    Quantity("cross_validation_rms_arcsec", lambda s: s[0].choice[s[1]].validation.rms, "RMS", "cross-validation", 4),
    Quantity("effective_parameters", lambda s: s[0].fits[s[1]].effective_parameters, "trace of smoothing", decimals=1),
    Quantity("settings", lambda s: s[0].fits[s[1]].settings, "selected settings: order, period, smoothing, trainings"),
)
COMPENSATION: Record[dividing_error.DividingCompensation] = Record(
    "Standard deviations of the errors of a compensated angle beyond the calibration's noise.",
    Quantity("common_arcsec", lambda c: c.common, "a constant, the same at all readings", decimals=4),
    Quantity("smooth_arcsec", lambda c: c.smooth, "misfit along the curve, correlated over one step", decimals=4),
    Quantity("white_arcsec", lambda c: c.white, "misfit, independent from reading to reading", decimals=4),
)
TRUE_FIT: Record[Any] = Record(
    "A fit minus the true curve.",
    Quantity("true_rms_arcsec", rms, "RMS difference", "truth", 4),
    Quantity(
        "true_spread_arcsec",
        np.std,
        "RMS difference without a constant, which angle differences do not show",
        "truth, no constant",
        4,
    ),
)
TRUTH: Record[TurntableRun] = Record(
    "Truth, which no test in a laboratory has.",
    Quantity("fits", lambda r: {n: r.true_residual(n) for n in r.fits}, "name -> fit minus truth", record=TRUE_FIT),
    Quantity("dividing_error_spread_arcsec", lambda r: np.std(r.true_error), "RMS of the true curve about its mean"),
    Quantity("part_rms_full_circle_arcsec", lambda r: _parts(r), "cause -> RMS of its error over the full circle"),
)
_Points: TypeAlias = tuple[TurntableRun, dividing_error.CalibrationSeries]
POINTS: Record[_Points] = Record(
    "One reading and its comparisons with the reference, reading minus reference.",
    Quantity("reading_deg", lambda s: s[1].angle, "reading of the table"),
    Quantity("mean_arcsec", lambda s: s[1].mean, "mean of the accepted comparisons"),
    Quantity("mean_arcsec_sigma", lambda s: s[1].sigma, "standard deviation of this mean"),
    Quantity("rms_before_arcsec", lambda s: s[1].rms_before, "RMS scatter of all comparisons"),
    Quantity("rms_after_arcsec", lambda s: s[1].rms_after, "RMS scatter of the accepted comparisons"),
    Quantity("comparisons_arcsec", lambda s: _each(s[1], s[1].comparisons), "all comparisons"),
    Quantity("kept", lambda s: _each(s[1], s[1].keep), "true for each comparison that Chauvenet's criterion accepts"),
    Quantity("fitted_arcsec", lambda s: _fitted(*s), "fit -> fitted dividing error"),
)


def _each(series: dividing_error.CalibrationSeries, values: Any) -> list[Any]:
    """Return values of a series as a list for each reading, without missing comparisons.

    ``values`` is an array (N, repeats) for N readings.
    """
    return [row[taken] for row, taken in zip(values, series.taken, strict=True)]


def _fitted(run: TurntableRun, series: dividing_error.CalibrationSeries) -> list[dict[str, float]]:
    """Return fit -> dividing error, radians, at every reading of a series."""
    values = {name: fit(series.angle) for name, fit in run.fits.items()}
    return [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]


def _parts(run: TurntableRun) -> dict[str, float]:
    """Return cause -> RMS of its dividing error over the full circle, radians; empty for measurements."""
    return {} if run.model is None else {name: part.rms for name, part in run.model.error.parts.items()}


def rejected_rows(tables: tuple[Comparisons, ...]) -> list[dict[str, Any]]:
    """Return the comparisons that Chauvenet's criterion rejects, of all tables that were read, for turntable.json."""
    return [row for table in tables for row in REJECTED.rows(table)]


TURNTABLE: Record[TurntableRun] = Record(
    "turntable.json.",
    Quantity("name", lambda r: r.spec.name, "name of the test"),
    Quantity("seed", lambda r: r.seed, "seed of all that was drawn"),
    Quantity(
        "repeat_rms_arcsec",
        lambda r: np.max(r.series.rms_before),
        "largest RMS of the repeats at a reading",
        decimals=3,
    ),
    Quantity(
        "chauvenet_rms_arcsec",
        lambda r: np.max(r.series.rms_after),
        "largest RMS of the accepted repeats at a reading",
        decimals=3,
    ),
    Quantity(
        "averaging_alone_rms_arcsec",
        lambda r: r.series.averaging_alone,
        "largest RMS of the mean of all repeats",
        decimals=3,
    ),
    Quantity(
        "mean_rms_arcsec", lambda r: r.series.mean_rms, "largest RMS of the mean of the accepted repeats", decimals=3
    ),
    Quantity("repeatability_arcsec", lambda r: r.series.repeatability, "one comparison, pooled σ", decimals=3),
    Quantity("rejected", lambda r: r.series.rejected, "comparisons that Chauvenet's criterion rejects"),
    Quantity(
        "rejected_expected_by_chance",
        lambda r: dividing_error.expected_rejections(r.series.counts),
        "rejections expected by chance",
    ),
    Quantity("suspect_angles", lambda r: np.sum(r.series.suspect), "readings that still scatter after the criterion"),
    Quantity("heldout_arcsec_sigma", lambda r: r.held_out and rms(r.held_out.sigma), "RMS sigma of the held-out means"),
    Quantity("fits", lambda r: {n: (r, n) for n in r.fits}, "name -> fit", record=FIT),
    Quantity("failed", lambda r: r.choice.failed, "name of a fit -> reason of its failure"),
    Quantity("chosen", lambda r: r.choice.chosen, "fit that cross-validation chooses"),
    Quantity("ranking", lambda r: r.ranking, "fits by their RMS at held-out readings or cross-validation, best first"),
    Quantity("compensation", lambda r: r.compensation, "compensation by the chosen fit", record=COMPENSATION),
    Quantity("points", lambda r: POINTS.rows((r, r.series)), "calibrated readings"),
    Quantity("heldout_points", lambda r: POINTS.rows((r, r.held_out)) if r.held_out else [], "held-out readings"),
    Quantity("fit_chi_square", lambda r: r.chi_square[0], "chi-square against the sigmas of the means", decimals=1),
    Quantity("fit_degrees_of_freedom", lambda r: r.chi_square[1], "means minus effective parameters", decimals=1),
    Quantity(
        "heldout_chi_square",
        lambda r: r.held_out_chi_square[0],
        "chi-square of held-out readings against the compensation",
        decimals=1,
    ),
    Quantity("heldout_degrees_of_freedom", lambda r: r.held_out_chi_square[1], "number of held-out readings"),
    Quantity(
        "heldout_agrees",
        lambda r: r.held_out and likely(*r.held_out_chi_square),
        "true if its p-value is 0.001 or more",
    ),
    Quantity(
        "rejected_readings",
        lambda r: rejected_rows(r.tables) if r.tables else None,
        "rejected comparisons in the files",
        where_known=True,
    ),
    Quantity(
        "too_few_angles_for", lambda r: r.too_few if r.tables else None, "fits that were omitted", where_known=True
    ),
    Quantity(
        "files",
        lambda r: [t.file for t in r.tables] or None,
        "files that were read",
        record=DATA_FILE,
        where_known=True,
    ),
    Quantity("truth", lambda r: r.model and r, "truth of a simulated table", record=TRUTH, where_known=True),
)
