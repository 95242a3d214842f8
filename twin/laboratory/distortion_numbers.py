"""Numbers of a distortion test, as distortion.json has them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from analysis.arrays import ARCSEC, MM_PER_M, Array
from analysis.orientation.interior import LINE_TERMS, InteriorOrientation, LineOrientation
from analysis.turntable.dividing_error import DividingCompensation, expected_rejections
from twin.framework.quantity import Quantity, Record
from twin.laboratory import turntable_run
from twin.laboratory.distortion_run import DistortionRun, Estimate, SimulatedDistortion
from twin.laboratory.measured_readings import DataFile, SpotReadings
from twin.laboratory.turntable_run import rms

JOINT_MODEL = "L = constant + principal_distance tan W - principal_point tan^2 W + radial3 tan^3 W"
_LINE_UNIT = np.array([1.0 / ARCSEC, MM_PER_M, MM_PER_M, 1.0])

POINTS: Record[DistortionRun] = Record(
    "One point of the line: means of the sets that Chauvenet's criterion keeps.",
    Quantity("point", lambda r: np.arange(len(r.reading)) + 1, "number along the line"),
    Quantity("reading_deg", lambda r: r.means.mean(r.reading), "reading of the turntable", decimals=5),
    Quantity("field_deg", lambda r: r.compensated.fit.angle, "W, the camera's angle", "W", 5),
    Quantity("position_mm", lambda r: r.compensated.fit.position, "L, the spot's place along the line", "L", 4),
    Quantity("distortion_raw_um", lambda r: r.raw.distortion, "D with angles as read"),
    Quantity("distortion_compensated_um", lambda r: r.compensated.distortion, "D", "D", 2),
    Quantity("distortion_raw_um_sigma", lambda r: r.raw.sigma, "standard deviation of D with angles as read"),
    Quantity("distortion_compensated_um_sigma", lambda r: r.compensated.sigma, "standard deviation of D", "sigma", 2),
    Quantity("residual_raw_um", lambda r: r.raw.smooth.residual, "from a smooth curve, with angles as read"),
    Quantity("residual_compensated_um", lambda r: r.compensated.smooth.residual, "from a curve", "from smooth", 2),
    Quantity("rms_over_sets_raw_um", lambda r: r.raw.rms_over_sets, "RMS of D of single sets, angles as read"),
    Quantity("rms_over_sets_compensated_um", lambda r: r.compensated.rms_over_sets, "RMS of D of single sets"),
    Quantity("sets_kept", lambda r: r.means.keep.sum(axis=1), "sets that are kept"),
)
CORRELATIONS: Record[InteriorOrientation] = Record(
    "Correlations of the terms of a fit.",
    Quantity("terms", lambda fit: fit.terms, "names of rows and columns"),
    Quantity("matrix", lambda fit: fit.correlation, "coefficients"),
)
LINE: Record[LineOrientation] = Record(
    "The joint model as a line of a payload's file: tan of the angle from the camera's Z is (y - y0) times "
    "(1 + k1 (y - y0)^2) / f, with y the place along the line. Units: axis, the camera's Z from the zero of the "
    "angles, arcsec; principal_distance and principal_point mm; k1 1/m^2; the covariance in these.",
    Quantity("terms", lambda line: LINE_TERMS, "names of the unknowns"),
    Quantity("values", lambda line: line.values * _LINE_UNIT, "unknowns"),
    Quantity("values_sigma", lambda line: line.sigma * _LINE_UNIT, "standard deviations"),
    Quantity("covariance", lambda line: line.covariance * np.outer(_LINE_UNIT, _LINE_UNIT), "of the unknowns"),
)
JOINT: Record[DistortionRun] = Record(
    "Constant, f, p and radial term of one model, which belong together and reproduce the spots. Its f is the slope in "
    "the middle of the field, not the balanced one.",
    Quantity("model", lambda r: JOINT_MODEL, "formula"),
    Quantity("terms", lambda r: r.compensated.smooth.terms, "names of the unknowns"),
    Quantity("values_mm", lambda r: r.compensated.smooth.values, "unknowns"),
    Quantity("values_mm_sigma", lambda r: np.sqrt(np.diagonal(r.compensated.smooth.covariance)), "standard deviations"),
    Quantity("covariance_mm2", lambda r: r.compensated.smooth.covariance, "of the unknowns"),
    Quantity("line", lambda r: r.line, "of a payload's file", record=LINE),
)
ESTIMATE: Record[Estimate] = Record(
    "One way to f, p and distortion; no sigma where an equation gives none.",
    Quantity("principal_distance_mm", lambda e: e.f, "f", "f", 4),
    Quantity("principal_distance_mm_sigma", lambda e: e.f_sigma, "standard deviation of f", "sigma of f", 3),
    Quantity("principal_point_mm", lambda e: e.p, "p; zero where it is not fitted", "p", 3),
    Quantity("principal_point_mm_sigma", lambda e: e.p_sigma, "standard deviation of p", "sigma of p", 3),
    Quantity("distortion_rms_um", lambda e: rms(e.distortion), "RMS over the points", "D, rms", 2),
)
NOISE: Record[DistortionRun] = Record(
    "What scatters, RMS.",
    Quantity("centroid_um", lambda r: rms(r.spots.temporal), "noise of one spot's place"),
    Quantity("centroid_columns_um", lambda r: rms(r.spots.fixed), "part that stays from set to set"),
    Quantity("exposure_um", lambda r: r.means.scatter, "scatter of one spot between the sets"),
    Quantity("white_raw_um", lambda r: r.raw.white, "points about a smooth curve beyond stated noise, angles as read"),
    Quantity("white_compensated_um", lambda r: r.compensated.white, "points about a smooth curve beyond stated noise"),
    Quantity("rejected", lambda r: int(np.sum(r.rejected)), "spots that Chauvenet's criterion takes out"),
    Quantity("rejected_expected_of_good", lambda r: expected_rejections(r.present.sum(axis=1)), "average of good ones"),
)
COMPENSATION: Record[DividingCompensation] = Record(
    "The turntable's dividing error, as it is compensated.",
    Quantity("fit", lambda table: table.fit.name, "fit that cross-validation chooses"),
    Quantity("repeatability_arcsec", lambda table: table.repeatability, "standard deviation of one comparison"),
    *turntable_run.COMPENSATION,
)
_Pair: TypeAlias = tuple[Estimate, Estimate]
TRUE_ESTIMATE: Record[_Pair] = Record(
    "The same estimate from exact chief rays at the true angles.",
    Quantity("principal_distance_mm", lambda e: e[1].f, "true f"),
    Quantity("principal_point_mm", lambda e: e[1].p, "true p"),
    Quantity("distortion_error_rms_um", lambda e: rms(e[0].distortion - e[1].distortion), "measured minus true D, RMS"),
)


def _f_error(run: SimulatedDistortion) -> float:
    fit = run.compensated.fit
    error = fit.value("principal_distance") - run.true_fit().value("principal_distance")
    return float(error / fit.sigma("principal_distance"))


def _correlation(run: DistortionRun) -> float:
    fit = run.compensated.fit
    return float(fit.correlation[fit.terms.index("principal_distance"), fit.terms.index("principal_point")])


def _read(run: DistortionRun) -> SpotReadings:
    assert run.readings is not None
    return run.readings


def _across(run: DistortionRun) -> float | None:
    across = None if run.readings is None else run.readings.across
    return None if across is None else float(np.ptp(across))


def _files(run: DistortionRun) -> list[DataFile] | None:
    return None if run.readings is None else [run.readings.file, *(table.file for table in run.tables)]


def _from_mean(run: DistortionRun) -> Array:
    """Rejected exposures minus the mean of their point, in what the sets are compared by, metres."""
    rest = run.compensated.position - run.about * np.tan(run.compensated.angle)
    return np.asarray((rest - run.means.mean(rest)[:, None])[run.rejected])


def _estimates(run: SimulatedDistortion) -> dict[str, _Pair]:
    return {name: (found, run.true_estimates[name]) for name, found in run.estimates.items()}


TRUTH: Record[SimulatedDistortion] = Record(
    "What the analysis does not know.",
    Quantity("principal_distance_mm", lambda r: r.true_fit().value("principal_distance"), "true balanced f"),
    Quantity("principal_point_mm", lambda r: r.true_fit().value("principal_point"), "true p"),
    Quantity("zero_arcsec", lambda r: r.truth.zero, "error of the zero of the angles"),
    Quantity("axis_tilt_arcsec", lambda r: r.truth.axis[1:] / r.truth.axis[0], "tilt of the axis along and across"),
    Quantity("distortion_um", lambda r: r.true_distortion, "true D of the points"),
    Quantity("error_rms_raw_um", lambda r: rms(r.error(r.raw)), "RMS error of D with angles as read"),
    Quantity("error_rms_compensated_um", lambda r: rms(r.error(r.compensated)), "RMS error of D"),
    Quantity("reduction", lambda r: 1.0 - rms(r.error(r.compensated)) / rms(r.error(r.raw)), "share that is gone"),
    Quantity("principal_distance_error_sigma", _f_error, "error of the balanced f in its sigmas"),
    Quantity("gross_errors", lambda r: int(np.sum(r.truth.gross)), "exposures with a gross error"),
    Quantity("gross_errors_kept", lambda r: int(np.sum(r.truth.gross & r.means.keep)), "those that stay in the means"),
    Quantity("row_smile_um", lambda r: float(np.ptp(r.truth.place[..., 1])), "range of the spots along the track"),
    Quantity("estimates", _estimates, "name -> the same by exact chief rays", record=TRUE_ESTIMATE),
    Quantity(
        "centroid_minus_chief_ray_left_um",
        lambda r: r.bench.true_offset - r.bench.design_offset,
        "energy centroid minus chief ray of the as-built camera beyond that of the design",
    ),
)
REJECTED: Record[DistortionRun] = Record(
    "An exposure that Chauvenet's criterion takes out, and where it stands.",
    Quantity("file", lambda r: [_read(r).file.file] * int(np.sum(r.rejected)), "path of the table"),
    Quantity("line", lambda r: _read(r).lines[r.rejected], "line in this file"),
    Quantity("point", lambda r: np.nonzero(r.rejected)[0] + 1, "number of the point"),
    Quantity("reading_deg", lambda r: r.reading[r.rejected], "reading of the turntable"),
    Quantity("from_mean_um", _from_mean, "spot minus the mean of the spots that stay"),
)
DISTORTION: Record[DistortionRun] = Record(
    "distortion.json. Without a calibration of the turntable raw and compensated are the same.",
    Quantity("name", lambda r: r.test.name, "name of the test"),
    Quantity("seed", lambda r: r.seed, "seed of all that was drawn"),
    Quantity("principal_distance_mm", lambda r: r.compensated.fit.value("principal_distance"), "balanced f"),
    Quantity("principal_distance_mm_sigma", lambda r: r.compensated.fit.sigma("principal_distance"), "sigma of f"),
    Quantity("principal_point_mm", lambda r: r.compensated.fit.value("principal_point"), "p of the balanced f"),
    Quantity("principal_point_mm_sigma", lambda r: r.compensated.fit.sigma("principal_point"), "sigma of p"),
    Quantity("correlation", _correlation, "of the balanced f and p"),
    Quantity("principal_point_observable", lambda r: bool(r.compensated.fit.point.observable), "sigma within 10 um"),
    Quantity("principal_point_statement", lambda r: r.compensated.fit.point.statement, "what can be said of p"),
    Quantity("rms_raw_um", lambda r: rms(r.raw.smooth.residual), "points about a smooth curve, angles as read"),
    Quantity("rms_compensated_um", lambda r: rms(r.compensated.smooth.residual), "points about a smooth curve"),
    Quantity("zero_arcsec", lambda r: r.compensated.zero, "error of the zero of the angles, from the constant"),
    Quantity("joint", lambda r: r, "model with a radial term", record=JOINT),
    Quantity("points", POINTS.rows, "points of the line"),
    Quantity("radial3_mm", lambda r: r.compensated.smooth.value("radial3"), "of `joint`, whose f is another"),
    Quantity("radial3_mm_sigma", lambda r: r.compensated.smooth.sigma("radial3"), "standard deviation"),
    Quantity("correlations", lambda r: r.compensated.smooth, "of `joint`", record=CORRELATIONS),
    Quantity("estimates", lambda r: r.estimates, "name -> printed equation or fit", record=ESTIMATE),
    Quantity("noise", lambda r: r, "what scatters", record=NOISE),
    Quantity("compensation", lambda r: r.compensation, "of the turntable", record=COMPENSATION),
    Quantity("chi_square", lambda r: r.stated.chi_square, "of the smooth model against the stated noise alone"),
    Quantity("degrees_of_freedom", lambda r: r.stated.degrees_of_freedom, "points minus unknowns"),
    Quantity("probability", lambda r: r.stated.probability, "of such a chi-square or a larger one"),
    Quantity("covariance_terms", lambda r: r.compensated.fit.terms, "rows and columns of `covariance_mm2`"),
    Quantity("covariance_mm2", lambda r: r.compensated.fit.covariance, "of constant, balanced f and p"),
    Quantity("stated_exposure_um", lambda r: np.sqrt(np.mean(r.spots.temporal**2, where=r.present)), "noise of a spot"),
    Quantity("across_range_um", _across, "range of the spots across the line"),
    Quantity("rejected_readings", lambda r: r.readings and REJECTED.rows(r), "of spots", where_known=True),
    Quantity(
        "rejected_comparisons",
        lambda r: r.readings and turntable_run.rejected_rows(r.tables),
        "in files",
        where_known=True,
    ),
    Quantity("files", _files, "that were read", record=turntable_run.DATA_FILE, where_known=True),
    Quantity("truth", lambda r: r if isinstance(r, SimulatedDistortion) else None, record=TRUTH, where_known=True),
)
