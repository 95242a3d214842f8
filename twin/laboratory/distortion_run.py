"""Interior orientation and distortion by paper 004 (Li et al. 2020, section 3).

The run goes from the turntable's calibration to distortion.json.

The analysis gets frames, turntable readings, the calibration of the table and what a laboratory knows beforehand: the
pixels, their noise, and the energy centroid of a spot minus its chief ray by the camera's design; or spots and readings
from files of measurements. The true values of a simulated bench come from exact chief rays of the as-built camera at
the true angles, from which the same equations compute the true orientation and distortion.

The records at the end define the contents of distortion.json.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import ARCSEC, MM_PER_M, Array
from analysis.orientation import interior
from analysis.spots.spot_image import SpotError
from analysis.statistics import rms
from analysis.turntable.dividing_error import (
    FITS,
    CalibrationSeries,
    DividingCompensation,
    choose,
    compensate,
    covered,
    expected_rejections,
)
from optics.numerics.backend import Backend
from scenes.specs.camera_tests import DistortionFiles, DistortionTestSpec, MeasuredDistortionSpec
from scenes.specs.resolved import DistortionSetup, ExperimentSetup, MeasuredDistortionSetup
from scenes.yaml.errors import InputError, Issue
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.record import Quantity, Record
from twin.laboratory import measured_readings, turntable_run
from twin.laboratory.distortion_bench import DistortionBench, DistortionRecord, DistortionTruth
from twin.laboratory.turntable_run import TurntableModel, usable_fits

CLOSED_FORMS = tuple(name for name in FITS if name != "network")
"""Names of the closed-form fits of the turntable's dividing error from which the compensation is chosen.

The neural network, which takes minutes to train, is compared in the turntable test only.
"""
MAX_FIELD_ANGLE = np.radians(40.0)
"""Largest plausible angle from the middle of the line, radians.

The distortion model uses tangents of the angle only up to 45 deg.
"""
_EXACT = 1e-9
"""Nominal noise given to the true positions, metres, because a fit needs a weight; the estimates do not depend on it.
"""
_GREY, _SPOT_PIXEL = 2.0, 33.0
"""Memory per pixel, in bytes: of a frame, and of the mean image of a spot with its fit."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimate of principal distance, principal point and distortion.

    Attributes
    ----------
    f, p : float
        Principal distance and principal point, metres; p is zero where it is not fitted.
    distortion : (N,) ndarray
        Distortion of the N points, metres.
    f_sigma, p_sigma : float or None
        Standard deviations of f and p, metres; None where an equation gives none.
    """

    f: float
    p: float
    distortion: Array
    f_sigma: float | None = None
    p_sigma: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class DistortionRun:
    """Results of a distortion test on a simulated bench or on measured angles and spots.

    Dimensions: N points (nominal angles of the turntable), S sets of repeated exposures.

    Attributes
    ----------
    test : DistortionTestSpec or MeasuredDistortionSpec
        Specification from the test's file.
    seed : int
        Seed of all random numbers.
    approximate_f : float
        Approximate principal distance, metres, used to compare sets with each other.
    reading : (N, S) ndarray
        Readings of the turntable, radians.
    present : (N, S) ndarray of bool
        Exposures that were made.
    calibration : CalibrationSeries or None
        Calibration of the turntable; None if readings are used uncorrected.
    compensation : DividingCompensation or None
        Compensation of the dividing error; None without a calibration.
    spots : Spots
        Measured spots on the line.
    means : PointMeans
        Reduction of the sets to one mean per point.
    raw, compensated : Distortion
        Distortion with angles as read, and with angles corrected for the dividing error; equal without a calibration.
    specified_fit : InteriorOrientation
        Fit of the smooth model weighted with the specified noise alone, for its chi-square.
    readings : SpotReadings or None
        Table of spots that was read; None for a simulated bench.
    tables : tuple of Comparisons
        Tables of the turntable's calibration that were read.
    """

    test: DistortionTestSpec | MeasuredDistortionSpec
    seed: int
    approximate_f: float
    reading: Array
    present: NDArray[np.bool_]
    calibration: CalibrationSeries | None
    compensation: DividingCompensation | None
    spots: interior.Spots
    means: interior.PointMeans
    raw: interior.Distortion
    compensated: interior.Distortion
    specified_fit: interior.InteriorOrientation
    readings: measured_readings.SpotReadings | None = None
    tables: tuple[measured_readings.Comparisons, ...] = ()

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """Mask of the exposures that Chauvenet's criterion rejects, (N, S) for N points and S sets."""
        return self.present & ~self.means.keep

    @cached_property
    def line(self) -> interior.LineOrientation:
        """Joint model of orientation and radial distortion, as the parameters of a line in a payload's file.

        It uses compensated angles.
        """
        return interior.line_orientation(self.compensated.smooth)

    @cached_property
    def estimates(self) -> Mapping[str, Estimate]:
        """Name -> estimate by equations of paper 004 or by a fit with a constant term, all with compensated angles."""
        return _estimates(self.compensated.fit, self.compensated.smooth, self.compensated.zero)


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedDistortion(DistortionRun):
    """Distortion test on the simulated bench, with the true values.

    Attributes
    ----------
    bench : DistortionBench
        Bench of the test.
    record : DistortionRecord
        Measurements that the analysis got.
    truth : DistortionTruth
        True values that the analysis did not get.
    table : TurntableModel
        Turntable with its true dividing error.
    calibration : CalibrationSeries
        Calibration of the turntable.
    compensation : DividingCompensation
        Compensation of the dividing error.
    """

    calibration: CalibrationSeries
    compensation: DividingCompensation
    bench: DistortionBench
    record: DistortionRecord
    truth: DistortionTruth
    table: TurntableModel

    @property
    def setup(self) -> DistortionSetup:
        """Test with the contents of all files that it refers to."""
        return self.bench.setup

    def true_fit(self, terms: Sequence[str] = interior.CALIBRATED) -> interior.InteriorOrientation:
        """Fit the orientation model to exact chief rays at the true angles.

        The fit has the terms and exposures of the measurement's fit.
        """
        position, angles = self.means.mean(self.truth.position[..., 0]), self.means.mean(self.truth.field_angle)
        return interior.fit_interior_orientation(position, angles, _EXACT, terms)

    @cached_property
    def true_distortion(self) -> Array:
        """True distortion of the chief rays at the N points, (N,), metres."""
        return self.true_fit().residual

    def error(self, measured: interior.Distortion) -> Array:
        """Return measured minus true distortion at the N points, (N,), metres."""
        return np.asarray(measured.distortion - self.true_distortion)

    @cached_property
    def true_estimates(self) -> Mapping[str, Estimate]:
        """Name -> estimate from exact chief rays at the true angles, by the same equations as ``estimates``."""
        return _estimates(self.true_fit(), self.true_fit(interior.SMOOTH), 0.0)


def _estimates(
    fit: interior.InteriorOrientation, smooth: interior.InteriorOrientation, zero: float
) -> dict[str, Estimate]:
    """Return name -> estimate by equations (2), (3) and (4), and by the fits with a constant term.

    The equations are those of paper 004 (Li et al. 2020). Equation (4) uses the principal distance of (3). Equation
    (2) is also evaluated with the angles counted from `zero`, radians.
    """
    position, angles = fit.position, fit.angle

    def printed(f: Array | float, p: Array | float, angle: Array) -> Estimate:
        return Estimate(float(f), float(p), interior.distortion(position, angle, f, p))

    balanced_f, shifted = interior.principal_distance(position, angles), angles - zero
    out = {
        "eq2": printed(*interior.principal_distance_and_point(position, angles), angles),
        "eq3": printed(balanced_f, 0.0, angles),
        "eq4": printed(balanced_f, interior.principal_point(position, angles, balanced_f), angles),
        "eq2_zero_from_constant": printed(*interior.principal_distance_and_point(position, shifted), shifted),
    }
    f, p = "principal_distance", "principal_point"
    for name, model in (("constant", fit), ("constant_radial3", smooth)):
        residual = model.position - _calibrated(model)
        out[name] = Estimate(model.value(f), model.value(p), residual, model.sigma(f), model.sigma(p))
    return out


def _calibrated(fit: interior.InteriorOrientation) -> Array:
    """Return the distortion-free positions c + f tan W - p tan^2 W of a fit at its N angles W, (N,), metres.

    c is the constant, f the principal distance, p the principal point; distortion is measured from these positions.
    """
    tangent = np.tan(fit.angle)
    c, f, p = (fit.value(term) for term in interior.CALIBRATED)
    return np.asarray(c + f * tangent - p * tangent**2)


def measure(bench: DistortionBench, seed: int, advance: Advance = silent) -> SimulatedDistortion:
    """Simulate the calibration of the table and the distortion test, and analyse both.

    Raises
    ------
    BenchError
        The recorded spots cannot be measured, or the calibration has too few angles.
    """
    setup = bench.setup
    table = TurntableModel(setup.turntable, seed)
    series, held_out = table.calibrate(), table.held_out()
    plan = setup.turntable.calibration
    try:
        compensation = compensate(series, choose(series, seed, CLOSED_FORMS, plan.folds), held_out)
    except ValueError as error:
        raise BenchError(str(error), ("turntable",), "a turntable file with a finer or longer calibration") from error
    record, truth = bench.record(table, seed, advance)
    spots = _locate(bench, record)
    # the line's middle was aligned to the pinhole at the camera's angle; the prescription's focal length serves to
    # compare sets only
    args = record.reading, spots, setup.turntable.camera_angle, bench.path.model.line_principal_distance
    try:
        return SimulatedDistortion(
            test=setup.test,
            seed=seed,
            calibration=series,
            compensation=compensation,
            bench=bench,
            record=record,
            truth=truth,
            table=table,
            **reduce(*args, compensation),
        )
    except interior.OrientationError as error:
        allowed = f"{len(interior.SMOOTH) + 1} or more, over the whole field"
        raise BenchError(str(error), ("points",), allowed) from error


def reduce(
    reading: Array,
    spots: interior.Spots,
    zero: float,
    approximate_f: float,
    compensation: DividingCompensation | None,
    angle_sigma: float = 0.0,
    reverse: bool = False,
    present: NDArray[np.bool_] | None = None,
) -> dict[str, Any]:
    """Reduce readings and spots of a simulated or real bench to interior orientation and distortion.

    Parameters
    ----------
    reading : (N, S) ndarray
        Readings of the turntable at N points in S sets, radians.
    spots : Spots
        Spots on the line.
    zero : float
        Reading at which the middle of the line is imaged, radians.
    approximate_f : float
        Approximate principal distance, metres, used to compare sets with each other.
    compensation : DividingCompensation or None
        Compensation of the turntable's dividing error; None to use angles as read.
    angle_sigma : float
        Standard deviation of the angles as read, without a compensation, radians.
    reverse : bool
        True if readings increase where positions on the line decrease.
    present : (N, S) ndarray of bool, optional
        Exposures that were made; by default all.

    Returns
    -------
    dict
        Attributes of a `DistortionRun` that follow from readings and spots.

    Raises
    ------
    OrientationError
        There are fewer points than unknowns, or the angles do not determine them.
    """
    sense = -1.0 if reverse else 1.0
    raw_angles = sense * (reading - zero)
    if compensation is None:
        means = interior.reduce_sets(raw_angles, spots, approximate_f, 0.0, present)
        common = angle_sigma**2 * np.eye(len(reading))
        raw = compensated = interior.Distortion.measure(raw_angles, spots, means, common)
    else:
        corrected_angles = sense * (compensation.correct(reading) - float(compensation.correct(zero)))
        single = approximate_f * compensation.repeatability
        means = interior.reduce_sets(corrected_angles, spots, approximate_f, single, present)
        # the residuals of this test estimate the white part at more angles than the calibration did
        common = replace(compensation, white=0.0).covariance(means.mean(reading))
        raw = interior.Distortion.measure(raw_angles, spots, means)
        compensated = interior.Distortion.measure(corrected_angles, spots, means, common)
    fit = compensated.fit
    return {
        "reading": reading,
        "spots": spots,
        "approximate_f": approximate_f,
        "present": np.ones(reading.shape, bool) if present is None else present,
        "means": means,
        "raw": raw,
        "compensated": compensated,
        "specified_fit": interior.fit_interior_orientation(
            fit.position, fit.angle, means.sigma, interior.SMOOTH, angle_covariance=common
        ),
    }


def measure_files(spec: MeasuredDistortionSpec, seed: int) -> DistortionRun:
    """Read measured angles and spots from files, and compute interior orientation and distortion.

    Raises
    ------
    InputError
        A table cannot be used, or does not determine the unknowns.
    """
    files = spec.measured
    readings = measured_readings.read_spots(files)
    compensation, series, zero = None, None, files.zero
    tables: tuple[measured_readings.Comparisons, ...] = ()
    if files.turntable is not None:
        tables = measured_readings.read_turntable(files.turntable)
        cal, *held = tables
        series = cal.series
        # whole turns between the calibration's readings and those of the test
        middle = 0.5 * float(series.angle[0] + series.angle[-1])
        whole_circles = measured_readings.unwrapped(np.array([files.zero]), middle)[0] - files.zero
        zero, readings = files.zero + whole_circles, replace(readings, reading=readings.reading + whole_circles)
        _check_region(files, readings, series, zero)
        names, _ = usable_fits(files.turntable, cal, CLOSED_FORMS)
        choice = choose(series, seed, names, files.turntable.folds)
        compensation = compensate(series, choice, held[0].series if held else None)
    _check_angles(files, readings, zero)
    scatter = files.angle_sigma or 0.0, files.reversed, readings.present
    try:
        reduced = reduce(readings.reading, readings.spots, zero, spec.principal_distance, compensation, *scatter)
    except interior.OrientationError as error:
        text = str(error).removeprefix("interior orientation: ")
        allowed = "reversed: true, where readings rise as places fall" if "opposite senses" in text else None
        raise files.error(text, ("spots",), allowed=allowed) from error
    return DistortionRun(
        test=spec, seed=seed, calibration=series, compensation=compensation, readings=readings, tables=tables, **reduced
    )


def _check_region(
    files: DistortionFiles, readings: measured_readings.SpotReadings, series: CalibrationSeries, zero: float
) -> None:
    """Raise InputError if a reading lies outside of the calibrated region of the turntable."""
    allowed = f"{measured_readings.calibrated_text(series.angle)}, the calibrated range"
    if not covered(series.angle, zero):
        shown = f"{np.degrees(files.zero):.9g} deg"
        raise files.error("the turntable is not calibrated at this reading", ("zero",), value=shown, allowed=allowed)
    beyond = ~covered(series.angle, readings.reading) & (readings.lines > 0)
    if np.any(beyond):
        first = np.argwhere(beyond)[0]
        shown = f"{np.degrees(readings.reading[tuple(first)]):.9g} deg"
        line = int(readings.lines[tuple(first)])
        text = "the turntable is not calibrated at this reading"
        raise InputError(Issue(text, readings.file.file, line, (readings.head,), shown, allowed))


def _check_angles(files: DistortionFiles, readings: measured_readings.SpotReadings, zero: float) -> None:
    """Raise InputError for readings far from the angle zero, which suggest a wrong zero or unit in the file."""
    distance = np.abs(readings.reading - zero) * (readings.lines > 0)
    if np.max(distance) > MAX_FIELD_ANGLE:
        index = np.unravel_index(int(np.argmax(distance)), distance.shape)
        shown = f"{np.degrees(readings.reading[index]):.9g} deg, {np.degrees(distance[index]):.4g} deg from the zero"
        widest = f"{np.degrees(MAX_FIELD_ANGLE):.0f} deg"
        allowed = f"within {widest} of `zero`, the reading at which the line's middle is imaged"
        line = int(readings.lines[index])
        raise InputError(Issue("an angle beyond any field", readings.file.file, line, (readings.head,), shown, allowed))


def _locate(bench: DistortionBench, record: DistortionRecord) -> interior.Spots:
    """Measure the spots in the recorded frames; raise BenchError if any cannot be measured."""
    try:
        line = bench.middle_column, bench.ccd.band.pitch, bench.noise
        return interior.locate_spots(record.frames, record.column, *line, bench.radius, bench.design_offset)
    except SpotError as error:
        reason = next(iter(error.reasons.values()))
        bad = f"{len(error.reasons)} of {record.column.size} spots cannot be measured"
        problem = f"{bad}; reason for the first: {reason}"
        remedy = "less light: 30 to 80 percent is good" if "saturated" in reason else "more light or more frames"
        raise BenchError(problem, ("light",), remedy) from error


def run_distortion(
    setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> DistortionRun:
    """Run the test of ``python -m twin.lab distortion``, simulated or from measurements.

    Raises
    ------
    InputError
        ``as_built`` names a body that the camera does not have, or a table of measurements cannot be used.
    BenchError
        The test cannot be carried out or measured as its file specifies.
    """
    if isinstance(setup, MeasuredDistortionSetup):
        advance("read and fit", 0, 1)
        return measure_files(setup.test, seed)
    assert isinstance(setup, DistortionSetup)
    test = setup.test
    each = test.points * test.window**2 * (test.frames * _GREY + _SPOT_PIXEL)
    require_memory(Lowered(test, ("sets",), test.sets, "sets", lambda sets: sets * each))
    return measure(DistortionBench.build(setup, backend, advance), seed, advance)


JOINT_MODEL = "L = constant + principal_distance tan W - principal_point tan^2 W + radial3 tan^3 W"
_LINE_UNIT = np.array([1.0 / ARCSEC, MM_PER_M, MM_PER_M, 1.0])
"""Factors from SI units to the units in which the parameters of `LINE` are reported: arcsec, mm, mm, 1/m^2."""

POINTS: Record[DistortionRun] = Record(
    "One point of the line: means of the sets that Chauvenet's criterion accepts.",
    Quantity("point", lambda r: np.arange(len(r.reading)) + 1, "number along the line"),
    Quantity("reading_deg", lambda r: r.means.mean(r.reading), "reading of the turntable", decimals=5),
    Quantity("field_deg", lambda r: r.compensated.fit.angle, "W, the camera's angle", "W", 5),
    Quantity("position_mm", lambda r: r.compensated.fit.position, "L, the spot's position along the line", "L", 4),
    Quantity("distortion_raw_um", lambda r: r.raw.distortion, "D with angles as read"),
    Quantity("distortion_compensated_um", lambda r: r.compensated.distortion, "D", "D", 2),
    Quantity("distortion_raw_um_sigma", lambda r: r.raw.sigma, "standard deviation of D with angles as read"),
    Quantity("distortion_compensated_um_sigma", lambda r: r.compensated.sigma, "standard deviation of D", "sigma", 2),
    Quantity("residual_raw_um", lambda r: r.raw.smooth.residual, "residual from a smooth curve, angles as read"),
    Quantity(
        "residual_compensated_um",
        lambda r: r.compensated.smooth.residual,
        "residual from a smooth curve",
        "from smooth",
        2,
    ),
    Quantity("rms_over_sets_raw_um", lambda r: r.raw.rms_over_sets, "RMS of D of single sets, angles as read"),
    Quantity("rms_over_sets_compensated_um", lambda r: r.compensated.rms_over_sets, "RMS of D of single sets"),
    Quantity("sets_kept", lambda r: r.means.keep.sum(axis=1), "number of sets that are accepted"),
)
CORRELATIONS: Record[interior.InteriorOrientation] = Record(
    "Correlations of the terms of a fit.",
    Quantity("terms", lambda fit: fit.terms, "names of rows and columns"),
    Quantity("matrix", lambda fit: fit.correlation, "coefficients"),
)
LINE: Record[interior.LineOrientation] = Record(
    "The joint model as a line of a payload's file: tan of the angle from the camera's Z is (y - y0) times "
    "(1 + k1 (y - y0)^2) / f, with y the position along the line. Units: axis, the camera's Z from the zero of the "
    "angles, arcsec; principal_distance and principal_point mm; k1 1/m^2; the covariance in these.",
    Quantity("terms", lambda line: interior.LINE_TERMS, "names of the unknowns"),
    Quantity("values", lambda line: line.values * _LINE_UNIT, "unknowns"),
    Quantity("values_sigma", lambda line: line.sigma * _LINE_UNIT, "standard deviations"),
    Quantity("covariance", lambda line: line.covariance * np.outer(_LINE_UNIT, _LINE_UNIT), "covariance matrix"),
)
JOINT: Record[DistortionRun] = Record(
    "Constant, f, p and radial term of one model, to be used together. Its f is the slope in "
    "the middle of the field, not the balanced one.",
    Quantity("model", lambda r: JOINT_MODEL, "formula"),
    Quantity("terms", lambda r: r.compensated.smooth.terms, "names of the unknowns"),
    Quantity("values_mm", lambda r: r.compensated.smooth.values, "unknowns"),
    Quantity("values_mm_sigma", lambda r: np.sqrt(np.diagonal(r.compensated.smooth.covariance)), "standard deviations"),
    Quantity("covariance_mm2", lambda r: r.compensated.smooth.covariance, "covariance matrix"),
    Quantity("line", lambda r: r.line, "as a line of a payload's file", record=LINE),
)
ESTIMATE: Record[Estimate] = Record(
    "Estimate of f, p and distortion; no sigma where an equation gives none.",
    Quantity("principal_distance_mm", lambda e: e.f, "f", "f", 4),
    Quantity("principal_distance_mm_sigma", lambda e: e.f_sigma, "standard deviation of f", "sigma of f", 3),
    Quantity("principal_point_mm", lambda e: e.p, "p; zero where it is not fitted", "p", 3),
    Quantity("principal_point_mm_sigma", lambda e: e.p_sigma, "standard deviation of p", "sigma of p", 3),
    Quantity("distortion_rms_um", lambda e: rms(e.distortion), "RMS over the points", "D, rms", 2),
)
NOISE: Record[DistortionRun] = Record(
    "Noise and scatter, RMS.",
    Quantity("centroid_um", lambda r: rms(r.spots.temporal), "noise of one spot's position"),
    Quantity("centroid_columns_um", lambda r: rms(r.spots.fixed), "part that is the same in all sets"),
    Quantity("exposure_um", lambda r: r.means.scatter, "scatter of one spot between the sets"),
    Quantity(
        "white_raw_um", lambda r: r.raw.white, "scatter about a smooth curve beyond specified noise, angles as read"
    ),
    Quantity(
        "white_compensated_um", lambda r: r.compensated.white, "scatter about a smooth curve beyond specified noise"
    ),
    Quantity("rejected", lambda r: int(np.sum(r.rejected)), "spots that Chauvenet's criterion rejects"),
    Quantity("rejected_expected_by_chance", lambda r: expected_rejections(r.present.sum(axis=1)), "expected by chance"),
)
COMPENSATION: Record[DividingCompensation] = Record(
    "Compensation of the turntable's dividing error.",
    Quantity("fit", lambda table: table.fit.name, "fit that cross-validation chooses"),
    Quantity("repeatability_arcsec", lambda table: table.repeatability, "standard deviation of one comparison"),
    *turntable_run.COMPENSATION,
)
_Pair: TypeAlias = tuple[Estimate, Estimate]
TRUE_ESTIMATE: Record[_Pair] = Record(
    "Estimate from exact chief rays at the true angles.",
    Quantity("principal_distance_mm", lambda e: e[1].f, "true f"),
    Quantity("principal_point_mm", lambda e: e[1].p, "true p"),
    Quantity("distortion_error_rms_um", lambda e: rms(e[0].distortion - e[1].distortion), "measured minus true D, RMS"),
)


def _f_error(run: SimulatedDistortion) -> float:
    """Return the error of the principal distance from the fit with a constant term, in units of its sigma."""
    fit = run.compensated.fit
    error = fit.value("principal_distance") - run.true_fit().value("principal_distance")
    return float(error / fit.sigma("principal_distance"))


def _correlation(run: DistortionRun) -> float:
    """Return the correlation coefficient of the errors of principal distance and principal point."""
    fit = run.compensated.fit
    return float(fit.correlation[fit.terms.index("principal_distance"), fit.terms.index("principal_point")])


def _read(run: DistortionRun) -> measured_readings.SpotReadings:
    assert run.readings is not None
    return run.readings


def _across(run: DistortionRun) -> float | None:
    """Return the range of the spots' positions across the line, metres, or None if they were not measured."""
    across = None if run.readings is None else run.readings.across
    return None if across is None else float(np.ptp(across))


def _files(run: DistortionRun) -> list[measured_readings.DataFile] | None:
    return None if run.readings is None else [run.readings.file, *(table.file for table in run.tables)]


def _from_mean(run: DistortionRun) -> Array:
    """Return the distances of rejected exposures from the mean of their point, metres along the line."""
    rest = run.compensated.position - run.approximate_f * np.tan(run.compensated.angle)
    return np.asarray((rest - run.means.mean(rest)[:, None])[run.rejected])


def _paired(run: SimulatedDistortion) -> dict[str, _Pair]:
    """Return name -> (measured estimate, the same estimate computed from the true values)."""
    return {name: (estimate, run.true_estimates[name]) for name, estimate in run.estimates.items()}


TRUTH: Record[SimulatedDistortion] = Record(
    "Truth, which the analysis does not know.",
    Quantity("principal_distance_mm", lambda r: r.true_fit().value("principal_distance"), "true balanced f"),
    Quantity("principal_point_mm", lambda r: r.true_fit().value("principal_point"), "true p"),
    Quantity("zero_arcsec", lambda r: r.truth.zero, "error of the zero of the angles"),
    Quantity("axis_tilt_arcsec", lambda r: r.truth.axis[1:] / r.truth.axis[0], "tilt of the axis along and across"),
    Quantity("distortion_um", lambda r: r.true_distortion, "true D of the points"),
    Quantity("error_rms_raw_um", lambda r: rms(r.error(r.raw)), "RMS error of D with angles as read", decimals=3),
    Quantity("error_rms_compensated_um", lambda r: rms(r.error(r.compensated)), "RMS error of D", decimals=3),
    Quantity(
        "reduction",
        lambda r: 1.0 - rms(r.error(r.compensated)) / rms(r.error(r.raw)),
        "reduction of the RMS error by the compensation, as a fraction",
    ),
    Quantity("principal_distance_error_sigma", _f_error, "error of the balanced f in its sigmas"),
    Quantity("gross_errors", lambda r: int(np.sum(r.truth.gross)), "exposures with a gross error"),
    Quantity(
        "gross_errors_kept",
        lambda r: int(np.sum(r.truth.gross & r.means.keep)),
        "exposures with a gross error that was not rejected",
    ),
    Quantity("row_smile_um", lambda r: float(np.ptp(r.truth.position[..., 1])), "range of the spots along the track"),
    Quantity("estimates", _paired, "name -> estimate from exact chief rays", record=TRUE_ESTIMATE),
    Quantity(
        "centroid_minus_chief_ray_residual_um",
        lambda r: r.bench.true_offset - r.bench.design_offset,
        "energy centroid minus chief ray of the as-built camera beyond that of the design",
    ),
)
REJECTED: Record[DistortionRun] = Record(
    "Exposure that Chauvenet's criterion rejects, and its line in the file.",
    Quantity("file", lambda r: [_read(r).file.file] * int(np.sum(r.rejected)), "path of the table"),
    Quantity("line", lambda r: _read(r).lines[r.rejected], "line in this file"),
    Quantity("point", lambda r: np.nonzero(r.rejected)[0] + 1, "number of the point"),
    Quantity("reading_deg", lambda r: r.reading[r.rejected], "reading", decimals=6),
    Quantity("from_mean_um", _from_mean, "difference from the mean of the accepted exposures", "from the mean", 3),
)
DISTORTION: Record[DistortionRun] = Record(
    "distortion.json. Without a calibration of the turntable raw and compensated are the same.",
    Quantity("name", lambda r: r.test.name, "name of the test"),
    Quantity("seed", lambda r: r.seed, "seed of all that was drawn"),
    Quantity(
        "principal_distance_mm", lambda r: r.compensated.fit.value("principal_distance"), "balanced f", decimals=4
    ),
    Quantity("principal_distance_mm_sigma", lambda r: r.compensated.fit.sigma("principal_distance"), "sigma of f"),
    Quantity("principal_point_mm", lambda r: r.compensated.fit.value("principal_point"), "principal point", decimals=3),
    Quantity("principal_point_mm_sigma", lambda r: r.compensated.fit.sigma("principal_point"), "sigma of p"),
    Quantity("correlation", _correlation, "correlation of the two", decimals=3),
    Quantity("principal_point_observable", lambda r: bool(r.compensated.fit.point.observable), "sigma within 10 um"),
    Quantity(
        "principal_point_statement",
        lambda r: r.compensated.fit.point.sentence,
        "statement about p and its observability",
    ),
    Quantity(
        "rms_raw_um", lambda r: rms(r.raw.smooth.residual), "RMS about a smooth curve, angles as read", decimals=3
    ),
    Quantity(
        "rms_compensated_um", lambda r: rms(r.compensated.smooth.residual), "RMS about a smooth curve", decimals=3
    ),
    Quantity("zero_arcsec", lambda r: r.compensated.zero, "error of the zero of the angles, from the constant"),
    Quantity("joint", lambda r: r, "model with a radial term", record=JOINT),
    Quantity("points", POINTS.rows, "points of the line"),
    Quantity(
        "radial3_mm", lambda r: r.compensated.smooth.value("radial3"), "radial term of the joint model", decimals=3
    ),
    Quantity("radial3_mm_sigma", lambda r: r.compensated.smooth.sigma("radial3"), "standard deviation"),
    Quantity("correlations", lambda r: r.compensated.smooth, "correlations of `joint`", record=CORRELATIONS),
    Quantity("estimates", lambda r: r.estimates, "name -> printed equation or fit", record=ESTIMATE),
    Quantity("noise", lambda r: r, "noise and scatter", record=NOISE),
    Quantity("compensation", lambda r: r.compensation, "compensation of the turntable", record=COMPENSATION),
    Quantity("chi_square", lambda r: r.specified_fit.chi_square, "chi-square with the specified noise", decimals=1),
    Quantity(
        "degrees_of_freedom", lambda r: r.specified_fit.degrees_of_freedom, "degrees of freedom, points minus unknowns"
    ),
    Quantity("probability", lambda r: r.specified_fit.probability, "p-value of this chi-square"),
    Quantity("covariance_terms", lambda r: r.compensated.fit.terms, "rows and columns of `covariance_mm2`"),
    Quantity("covariance_mm2", lambda r: r.compensated.fit.covariance, "covariance of constant, balanced f and p"),
    Quantity(
        "specified_exposure_um",
        lambda r: np.sqrt(np.mean(r.spots.temporal**2, where=r.present)),
        "specified noise of a spot",
    ),
    Quantity("across_range_um", _across, "range of the spots across the line"),
    Quantity("rejected_readings", lambda r: r.readings and REJECTED.rows(r), "rejected spots", where_known=True),
    Quantity(
        "rejected_comparisons",
        lambda r: r.readings and turntable_run.rejected_rows(r.tables),
        "rejected comparisons of the turntable",
        where_known=True,
    ),
    Quantity("files", _files, "files that were read", record=turntable_run.DATA_FILE, where_known=True),
    Quantity("truth", lambda r: r if isinstance(r, SimulatedDistortion) else None, record=TRUTH, where_known=True),
)
