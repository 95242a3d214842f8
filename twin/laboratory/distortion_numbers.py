"""Numbers of a distortion test, as distortion.json has them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.orientation.interior import LINE_TERMS, InteriorOrientation, LineOrientation
from analysis.turntable.dividing_error import DividingCompensation, expected_rejections
from analysis.units import ARCSEC, MM_PER_M
from twin.laboratory.distortion_run import DistortionRun, Estimate, FoundEstimate, SimulatedDistortion, rms
from twin.laboratory.measured_readings import SpotReadings
from twin.laboratory.turntable_numbers import RejectedNumbers
from twin.run.quantity import Quantity, Record

Array = NDArray[np.float64]
JOINT_MODEL = "L = constant + principal_distance tan W - principal_point tan^2 W + radial3 tan^3 W"
_LINE_UNIT = np.array([1.0 / ARCSEC, MM_PER_M, MM_PER_M, 1.0])

POINTS: Record[DistortionRun] = Record(
    "One point of the line: means of the sets that Chauvenet's criterion keeps.",
    Quantity("point", lambda run: np.arange(len(run.reading)) + 1, "number along the line"),
    Quantity("reading_deg", lambda run: run.means.mean(run.reading), "reading of the turntable", decimals=5),
    Quantity("field_deg", lambda run: run.compensated.fit.angle, "W, the camera's angle", "W", 5),
    Quantity("position_mm", lambda run: run.compensated.fit.position, "L, the spot's place along the line", "L", 4),
    Quantity("distortion_raw_um", lambda run: run.raw.distortion, "D with angles as read"),
    Quantity("distortion_compensated_um", lambda run: run.compensated.distortion, "D", "D", 2),
    Quantity("sigma_raw_um", lambda run: run.raw.sigma, "standard deviation of D with angles as read"),
    Quantity("sigma_um", lambda run: run.compensated.sigma, "standard deviation of D", decimals=2),
    Quantity("residual_raw_um", lambda run: run.raw.smooth.residual, "from a smooth curve, with angles as read"),
    Quantity(
        "residual_compensated_um", lambda run: run.compensated.smooth.residual, "from a smooth curve", "from smooth", 2
    ),
    Quantity("rms_over_sets_raw_um", lambda run: run.raw.rms_over_sets, "RMS of D of single sets, angles as read"),
    Quantity("rms_over_sets_compensated_um", lambda run: run.compensated.rms_over_sets, "RMS of D of single sets"),
    Quantity("sets_kept", lambda run: run.means.keep.sum(axis=1), "sets that are kept"),
)
CORRELATIONS: Record[InteriorOrientation] = Record(
    "Correlations of the terms of a fit.",
    Quantity("terms", lambda fit: fit.terms, "names of rows and columns"),
    Quantity("matrix", lambda fit: fit.correlation),
)
LINE: Record[LineOrientation] = Record(
    "The joint model as a line of a payload's file: tan of the angle from the camera's Z is (y - y0) times "
    "(1 + k1 (y - y0)^2) / f, with y the place along the line. Units: axis, the camera's Z from the zero of the "
    "angles, arcsec; focal_length and principal_point mm; k1 1/m^2; the covariance in these.",
    Quantity("terms", lambda line: LINE_TERMS),
    Quantity("values", lambda line: line.values * _LINE_UNIT),
    Quantity("sigma", lambda line: line.sigma * _LINE_UNIT),
    Quantity("covariance", lambda line: line.covariance * np.outer(_LINE_UNIT, _LINE_UNIT)),
)
JOINT: Record[DistortionRun] = Record(
    "Constant, f, p and radial term of one model, which belong together and reproduce the spots. Its f is the slope in "
    "the middle of the field, not the balanced one.",
    Quantity("model", lambda run: JOINT_MODEL),
    Quantity("terms", lambda run: run.compensated.smooth.terms),
    Quantity("values_mm", lambda run: run.compensated.smooth.values),
    Quantity("sigma_mm", lambda run: np.sqrt(np.diagonal(run.compensated.smooth.covariance))),
    Quantity("covariance_mm2", lambda run: run.compensated.smooth.covariance),
    Quantity("line", lambda run: run.line, record=LINE),
)
ESTIMATE: Record[FoundEstimate] = Record(
    "One way to f, p and distortion; no sigma where an equation gives none.",
    Quantity("principal_distance_mm", lambda e: e.f),
    Quantity("principal_distance_mm_sigma", lambda e: e.f_sigma),
    Quantity("principal_point_mm", lambda e: e.p),
    Quantity("principal_point_mm_sigma", lambda e: e.p_sigma),
    Quantity("distortion_rms_um", lambda e: e.rms),
)
NOISE: Record[DistortionRun] = Record(
    "What scatters, RMS.",
    Quantity("centroid_um", lambda run: rms(run.spots.temporal), "noise of one spot's place"),
    Quantity("centroid_columns_um", lambda run: rms(run.spots.fixed), "of it what stays from set to set"),
    Quantity("exposure_um", lambda run: run.means.scatter, "scatter of one spot between the sets"),
    Quantity("white_raw_um", lambda run: run.raw.white, "of the points about a smooth curve beyond what is known"),
    Quantity("white_compensated_um", lambda run: run.compensated.white, "the same with compensated angles"),
    Quantity("rejected", lambda run: int(np.sum(run.present)) - int(np.sum(run.means.keep)), "spots taken out"),
    Quantity(
        "rejected_expected_of_good",
        lambda run: expected_rejections(run.present.sum(axis=1)),
        "spots that Chauvenet's criterion takes out of good ones",
    ),
)
COMPENSATION: Record[DividingCompensation] = Record(
    "The turntable's dividing error, as it is compensated.",
    Quantity("fit", lambda table: table.fit.name),
    Quantity("repeatability_arcsec", lambda table: table.repeatability),
    Quantity("common_arcsec", lambda table: table.common),
    Quantity("smooth_arcsec", lambda table: table.smooth),
    Quantity("white_arcsec", lambda table: table.white),
)
TRUE_ESTIMATE: Record[Estimate] = Record(
    "The same estimate from exact chief rays at the true angles.",
    Quantity("principal_distance_mm", lambda e: e.f_true),
    Quantity("principal_point_mm", lambda e: e.p_true),
    Quantity("distortion_error_rms_um", lambda e: e.error),
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


def _rejected(run: DistortionRun) -> Any:
    """Rows of `REJECTED`."""
    return None if run.readings is None else REJECTED.rows(run)


def _across(run: DistortionRun) -> float | None:
    across = None if run.readings is None else run.readings.across
    return None if across is None else float(np.ptp(across))


def _files(run: DistortionRun) -> list[dict[str, Any]] | None:
    if run.readings is None:
        return None
    return [asdict(run.readings.file), *(asdict(table.file) for table in run.tables)]


def _comparisons(run: DistortionRun) -> list[RejectedNumbers] | None:
    return None if run.readings is None else [one for table in run.tables for one in RejectedNumbers.of(table)]


def _from_mean(run: DistortionRun) -> Array:
    """Of the rejected exposures, in what the sets are compared by."""
    rest = run.compensated.position - run.about * np.tan(run.compensated.angle)
    return (rest - run.means.mean(rest)[:, None])[run.rejected]


TRUTH: Record[SimulatedDistortion] = Record(
    "What the analysis does not know.",
    Quantity("principal_distance_mm", lambda run: run.true_fit().value("principal_distance")),
    Quantity("principal_point_mm", lambda run: run.true_fit().value("principal_point")),
    Quantity("zero_arcsec", lambda run: run.truth.zero),
    Quantity("axis_tilt_arcsec", lambda run: run.truth.axis[1:] / run.truth.axis[0]),
    Quantity("distortion_um", lambda run: run.true_distortion),
    Quantity("error_rms_raw_um", lambda run: rms(run.error(run.raw))),
    Quantity("error_rms_compensated_um", lambda run: rms(run.error(run.compensated))),
    Quantity("reduction", lambda run: 1.0 - rms(run.error(run.compensated)) / rms(run.error(run.raw))),
    Quantity("principal_distance_error_sigma", _f_error),
    Quantity("gross_errors", lambda run: int(np.sum(run.truth.gross))),
    Quantity("gross_errors_kept", lambda run: int(np.sum(run.truth.gross & run.means.keep))),
    Quantity("row_smile_um", lambda run: float(np.ptp(run.truth.place[..., 1]))),
    Quantity("estimates", lambda run: run.estimates, record=TRUE_ESTIMATE),
    Quantity("centroid_minus_chief_ray_left_um", lambda run: run.bench.true_offset - run.bench.design_offset),
)
REJECTED: Record[DistortionRun] = Record(
    "An exposure that Chauvenet's criterion takes out, and where it stands.",
    Quantity("file", lambda run: [_read(run).file.file] * int(np.sum(run.rejected))),
    Quantity("line", lambda run: _read(run).lines[run.rejected]),
    Quantity("point", lambda run: np.nonzero(run.rejected)[0] + 1),
    Quantity("reading_deg", lambda run: run.reading[run.rejected]),
    Quantity("from_mean_um", _from_mean),
)
DISTORTION: Record[DistortionRun] = Record(
    "distortion.json. Without a calibration of the turntable raw and compensated are the same.",
    Quantity("name", lambda run: run.test.name),
    Quantity("seed", lambda run: run.seed),
    Quantity(
        "principal_distance_mm",
        lambda run: run.compensated.fit.value("principal_distance"),
        "the balanced one, the slope that leaves the smallest distortion over these points",
    ),
    Quantity("principal_distance_mm_sigma", lambda run: run.compensated.fit.sigma("principal_distance")),
    Quantity(
        "principal_point_mm",
        lambda run: run.compensated.fit.value("principal_point"),
        "belongs to the balanced principal distance",
    ),
    Quantity("principal_point_mm_sigma", lambda run: run.compensated.fit.sigma("principal_point")),
    Quantity("correlation", _correlation),
    Quantity("principal_point_observable", lambda run: bool(run.compensated.fit.point.observable)),
    Quantity("principal_point_statement", lambda run: run.compensated.fit.point.statement),
    Quantity("rms_raw_um", lambda run: rms(run.raw.smooth.residual)),
    Quantity("rms_compensated_um", lambda run: rms(run.compensated.smooth.residual)),
    Quantity("zero_arcsec", lambda run: run.compensated.zero),
    Quantity("joint", lambda run: run, record=JOINT),
    Quantity("points", POINTS.rows),
    Quantity("radial3_mm", lambda run: run.compensated.smooth.value("radial3"), "of `joint`, whose f is another"),
    Quantity("radial3_mm_sigma", lambda run: run.compensated.smooth.sigma("radial3")),
    Quantity("correlations", lambda run: run.compensated.smooth, record=CORRELATIONS),
    Quantity("estimates", lambda run: run.found_estimates, record=ESTIMATE),
    Quantity("noise", lambda run: run, record=NOISE),
    Quantity("compensation", lambda run: run.compensation, record=COMPENSATION),
    Quantity("chi_square", lambda run: run.stated.chi_square, "of the smooth model against the stated noise alone"),
    Quantity("degrees_of_freedom", lambda run: run.stated.degrees_of_freedom),
    Quantity("probability", lambda run: run.stated.probability),
    Quantity("covariance_terms", lambda run: run.compensated.fit.terms),
    Quantity(
        "covariance_mm2",
        lambda run: run.compensated.fit.covariance,
        "of constant, principal distance and principal point",
    ),
    Quantity("stated_exposure_um", lambda run: float(np.sqrt(np.mean(run.spots.temporal**2, where=run.present)))),
    Quantity("across_range_um", _across),
    Quantity("rejected_readings", _rejected, where_known=True),
    Quantity("rejected_comparisons", _comparisons, where_known=True),
    Quantity("files", _files, where_known=True),
    Quantity(
        "truth", lambda run: run if isinstance(run, SimulatedDistortion) else None, record=TRUTH, where_known=True
    ),
)
