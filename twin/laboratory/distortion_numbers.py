"""Numbers of a distortion test, as distortion.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.orientation.interior import LINE_TERMS, LineOrientation
from analysis.turntable.dividing_error import expected_rejections
from analysis.units import ARCSEC
from twin.laboratory.distortion_run import DistortionRun, FoundEstimate, SimulatedDistortion, rms
from twin.laboratory.measured_readings import SpotReadings
from twin.laboratory.turntable_numbers import FileNumbers, RejectedNumbers
from twin.run.plain_data import WHERE_KNOWN, plain_data

Array = NDArray[np.float64]
JOINT_MODEL = "L = constant + principal_distance tan W - principal_point tan^2 W + radial3 tan^3 W"


@dataclass(frozen=True)
class PointNumbers:
    """One point of the line; rms_over_sets: of the distortion of single sets."""

    point: int
    reading_deg: float
    field_deg: float
    position_mm: float
    distortion_raw_um: float
    distortion_compensated_um: float
    sigma_raw_um: float
    sigma_um: float
    residual_raw_um: float
    residual_compensated_um: float
    rms_over_sets_raw_um: float
    rms_over_sets_compensated_um: float
    sets_kept: int

    @classmethod
    def of(cls, run: DistortionRun) -> tuple[PointNumbers, ...]:
        """Of all points."""
        raw, own = run.raw, run.compensated
        kept = run.means.keep.sum(axis=1)
        reading, field = np.degrees(run.means.mean(run.reading)), np.degrees(own.fit.angle)
        return tuple(
            cls(
                point=i + 1,
                reading_deg=float(reading[i]),
                field_deg=float(field[i]),
                position_mm=1e3 * float(own.fit.position[i]),
                distortion_raw_um=1e6 * float(raw.distortion[i]),
                distortion_compensated_um=1e6 * float(own.distortion[i]),
                sigma_raw_um=1e6 * float(raw.sigma[i]),
                sigma_um=1e6 * float(own.sigma[i]),
                residual_raw_um=1e6 * float(raw.smooth.residual[i]),
                residual_compensated_um=1e6 * float(own.smooth.residual[i]),
                rms_over_sets_raw_um=1e6 * float(raw.rms_over_sets[i]),
                rms_over_sets_compensated_um=1e6 * float(own.rms_over_sets[i]),
                sets_kept=int(kept[i]),
            )
            for i in range(len(kept))
        )


@dataclass(frozen=True)
class CorrelationNumbers:
    """Of the terms of a fit."""

    terms: Sequence[str]
    matrix: Array


@dataclass(frozen=True)
class LineNumbers:
    """The joint model as a line of a payload's file: tan of the angle from the camera's Z is (y - y0) times
    (1 + k1 (y - y0)^2) / f, with y the place along the line. Units: axis, the camera's Z from the zero of the angles,
    arcsec; focal_length and principal_point mm; k1 1/m^2; the covariance in these.
    """

    terms: Sequence[str]
    values: Array
    sigma: Array
    covariance: Array

    @classmethod
    def of(cls, line: LineOrientation) -> LineNumbers:
        """Of a fit."""
        unit = np.array([1.0 / ARCSEC, 1e3, 1e3, 1.0])
        return cls(LINE_TERMS, line.values * unit, line.sigma * unit, line.covariance * np.outer(unit, unit))


@dataclass(frozen=True)
class JointNumbers:
    """Constant, f, p and radial term of one model, which belong together and reproduce the spots; units mm and mm^2.
    Its f is the slope in the middle of the field, not the balanced one.
    """

    model: str
    terms: Sequence[str]
    values_mm: Array
    sigma_mm: Array
    covariance_mm2: Array
    line: LineNumbers

    @classmethod
    def of(cls, run: DistortionRun) -> JointNumbers:
        """Of the smooth model with compensated angles."""
        fit = run.compensated.smooth
        return cls(
            model=JOINT_MODEL,
            terms=fit.terms,
            values_mm=1e3 * fit.values,
            sigma_mm=1e3 * np.sqrt(np.diagonal(fit.covariance)),
            covariance_mm2=1e6 * fit.covariance,
            line=LineNumbers.of(run.line),
        )


@dataclass(frozen=True)
class EstimateNumbers:
    """One way to f, p and distortion; no sigma where an equation gives none."""

    principal_distance_mm: float
    principal_distance_mm_sigma: float | None
    principal_point_mm: float
    principal_point_mm_sigma: float | None
    distortion_rms_um: float

    @classmethod
    def of(cls, e: FoundEstimate) -> EstimateNumbers:
        """Of one estimate."""
        return cls(
            principal_distance_mm=1e3 * e.f,
            principal_distance_mm_sigma=None if e.f_sigma is None else 1e3 * e.f_sigma,
            principal_point_mm=1e3 * e.p,
            principal_point_mm_sigma=None if e.p_sigma is None else 1e3 * e.p_sigma,
            distortion_rms_um=1e6 * e.rms,
        )


@dataclass(frozen=True)
class NoiseNumbers:
    """What scatters, RMS; white: of the points about a smooth curve beyond what is known."""

    centroid_um: float
    centroid_columns_um: float
    exposure_um: float
    white_raw_um: float
    white_compensated_um: float
    rejected: int
    rejected_expected_of_good: float


@dataclass(frozen=True)
class CompensationNumbers:
    """Of the turntable's dividing error."""

    fit: str
    repeatability_arcsec: float
    common_arcsec: float
    smooth_arcsec: float
    white_arcsec: float


@dataclass(frozen=True)
class TrueEstimateNumbers:
    """The same estimate from exact chief rays at the true angles."""

    principal_distance_mm: float
    principal_point_mm: float
    distortion_error_rms_um: float


@dataclass(frozen=True)
class TruthNumbers:
    """What the analysis does not know."""

    principal_distance_mm: float
    principal_point_mm: float
    zero_arcsec: float
    axis_tilt_arcsec: Array
    distortion_um: Array
    error_rms_raw_um: float
    error_rms_compensated_um: float
    reduction: float
    principal_distance_error_sigma: float
    gross_errors: int
    gross_errors_kept: int
    row_smile_um: float
    estimates: Mapping[str, TrueEstimateNumbers]
    centroid_minus_chief_ray_left_um: Array

    @classmethod
    def of(cls, run: SimulatedDistortion) -> TruthNumbers:
        """Of a run."""
        exact, fit = run.true_fit(), run.compensated.fit
        raw, compensated = (rms(run.error(measured)) for measured in (run.raw, run.compensated))
        error = fit.value("principal_distance") - exact.value("principal_distance")
        return cls(
            principal_distance_mm=1e3 * exact.value("principal_distance"),
            principal_point_mm=1e3 * exact.value("principal_point"),
            zero_arcsec=run.truth.zero / ARCSEC,
            axis_tilt_arcsec=run.truth.axis[1:] / run.truth.axis[0] / ARCSEC,
            distortion_um=1e6 * run.true_distortion,
            error_rms_raw_um=1e6 * raw,
            error_rms_compensated_um=1e6 * compensated,
            reduction=1.0 - compensated / raw,
            principal_distance_error_sigma=error / fit.sigma("principal_distance"),
            gross_errors=int(np.sum(run.truth.gross)),
            gross_errors_kept=int(np.sum(run.truth.gross & run.means.keep)),
            row_smile_um=1e6 * float(np.ptp(run.truth.place[..., 1])),
            estimates={
                name: TrueEstimateNumbers(1e3 * e.f_true, 1e3 * e.p_true, 1e6 * e.error)
                for name, e in run.estimates.items()
            },
            centroid_minus_chief_ray_left_um=1e6 * (run.bench.true_offset - run.bench.design_offset),
        )


@dataclass(frozen=True)
class RejectedSpotNumbers:
    """An exposure that Chauvenet's criterion takes out, and where it stands."""

    file: str
    line: int
    point: int
    reading_deg: float
    from_mean_um: float

    @classmethod
    def of(cls, run: DistortionRun, readings: SpotReadings) -> tuple[RejectedSpotNumbers, ...]:
        """All of them, of a run on measurements."""
        own = run.compensated
        # what the sets are compared by
        rest = own.position - run.about * np.tan(own.angle)
        mean = run.means.mean(rest)
        return tuple(
            cls(
                readings.file.file,
                int(readings.lines[i, s]),
                int(i) + 1,
                float(np.degrees(run.reading[i, s])),
                1e6 * float(rest[i, s] - mean[i]),
            )
            for i, s in np.argwhere(run.rejected)
        )


@dataclass(frozen=True)
class DistortionNumbers:
    """distortion.json. Without a calibration of the turntable raw and compensated are the same.

    principal_distance_mm is the balanced one, the slope that leaves the smallest distortion over these points, and
    principal_point_mm belongs to it; radial3_mm is that of `joint`, whose f is another. chi_square is that of the
    smooth model against the stated noise alone; covariance_mm2 that of constant, principal distance and principal
    point.
    """

    name: str
    seed: int
    principal_distance_mm: float
    principal_distance_mm_sigma: float
    principal_point_mm: float
    principal_point_mm_sigma: float
    correlation: float
    principal_point_observable: bool
    principal_point_statement: str
    rms_raw_um: float
    rms_compensated_um: float
    zero_arcsec: float
    joint: JointNumbers
    points: tuple[PointNumbers, ...]
    radial3_mm: float
    radial3_mm_sigma: float
    correlations: CorrelationNumbers
    estimates: Mapping[str, EstimateNumbers]
    noise: NoiseNumbers
    compensation: CompensationNumbers | None
    chi_square: float
    degrees_of_freedom: int
    probability: float
    covariance_terms: Sequence[str]
    covariance_mm2: Array
    stated_exposure_um: float
    across_range_um: float | None
    rejected_readings: tuple[RejectedSpotNumbers, ...] | None = field(default=None, metadata=WHERE_KNOWN)
    rejected_comparisons: tuple[RejectedNumbers, ...] | None = field(default=None, metadata=WHERE_KNOWN)
    files: tuple[FileNumbers, ...] | None = field(default=None, metadata=WHERE_KNOWN)
    truth: TruthNumbers | None = field(default=None, metadata=WHERE_KNOWN)

    @classmethod
    def of(cls, run: DistortionRun) -> DistortionNumbers:
        """Of a run."""
        fit, smooth, table, readings = run.compensated.fit, run.compensated.smooth, run.compensation, run.readings
        f, p = (fit.terms.index(term) for term in ("principal_distance", "principal_point"))
        across = None if readings is None else readings.across
        return cls(
            name=run.test.name,
            seed=run.seed,
            principal_distance_mm=1e3 * fit.value("principal_distance"),
            principal_distance_mm_sigma=1e3 * fit.sigma("principal_distance"),
            principal_point_mm=1e3 * fit.value("principal_point"),
            principal_point_mm_sigma=1e3 * fit.sigma("principal_point"),
            correlation=float(fit.correlation[f, p]),
            principal_point_observable=bool(fit.point.observable),
            principal_point_statement=fit.point.statement,
            rms_raw_um=1e6 * rms(run.raw.smooth.residual),
            rms_compensated_um=1e6 * rms(smooth.residual),
            zero_arcsec=run.compensated.zero / ARCSEC,
            joint=JointNumbers.of(run),
            points=PointNumbers.of(run),
            radial3_mm=1e3 * smooth.value("radial3"),
            radial3_mm_sigma=1e3 * smooth.sigma("radial3"),
            correlations=CorrelationNumbers(smooth.terms, smooth.correlation),
            estimates={key: EstimateNumbers.of(e) for key, e in run.found_estimates.items()},
            noise=NoiseNumbers(
                centroid_um=1e6 * rms(run.spots.temporal),
                centroid_columns_um=1e6 * rms(run.spots.fixed),
                exposure_um=1e6 * run.means.scatter,
                white_raw_um=1e6 * run.raw.white,
                white_compensated_um=1e6 * run.compensated.white,
                rejected=int(np.sum(run.present)) - int(np.sum(run.means.keep)),
                rejected_expected_of_good=expected_rejections(run.present.sum(axis=1)),
            ),
            compensation=None
            if table is None
            else CompensationNumbers(
                fit=table.fit.name,
                repeatability_arcsec=table.repeatability / ARCSEC,
                common_arcsec=table.common / ARCSEC,
                smooth_arcsec=table.smooth / ARCSEC,
                white_arcsec=table.white / ARCSEC,
            ),
            chi_square=run.stated.chi_square,
            degrees_of_freedom=run.stated.degrees_of_freedom,
            probability=run.stated.probability,
            covariance_terms=fit.terms,
            covariance_mm2=1e6 * fit.covariance,
            stated_exposure_um=1e6 * float(np.sqrt(np.mean(run.spots.temporal**2, where=run.present))),
            across_range_um=None if across is None else 1e6 * float(np.ptp(across)),
            rejected_readings=None if readings is None else RejectedSpotNumbers.of(run, readings),
            rejected_comparisons=None
            if readings is None
            else tuple(one for table in run.tables for one in RejectedNumbers.of(table)),
            files=None
            if readings is None
            else tuple(FileNumbers(**asdict(file)) for file in (readings.file, *(one.file for one in run.tables))),
            truth=TruthNumbers.of(run) if isinstance(run, SimulatedDistortion) else None,
        )


def distortion_numbers(run: DistortionRun) -> dict[str, Any]:
    """Contents of distortion.json without its frames."""
    return dict(plain_data(DistortionNumbers.of(run)))
