"""Numbers of a turntable test, as turntable.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.turntable.angle_fits import AngleFit
from analysis.turntable.dividing_error import CalibrationSeries, expected_rejections
from analysis.units import ARCSEC
from twin.laboratory.measured_readings import Comparisons
from twin.laboratory.turntable_bench import TurntableModel
from twin.laboratory.turntable_run import TurntableRun, rms
from twin.run.plain_data import WHERE_KNOWN, plain_data

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitNumbers:
    """One fit: RMS at the held-out readings, at the calibrated ones, and by cross-validation."""

    heldout_rms_arcsec: float | None
    train_rms_arcsec: float
    cross_validation_rms_arcsec: float
    effective_parameters: float
    settings: Mapping[str, Any]

    @classmethod
    def of(cls, run: TurntableRun, name: str) -> FitNumbers:
        """Of one fit by name."""
        series, fit, validation = run.series, run.fits[name], run.choice[name].validation
        assert validation is not None
        return cls(
            heldout_rms_arcsec=None if run.held_out is None else rms(run.held_out_residual(name)) / ARCSEC,
            train_rms_arcsec=rms(series.mean - fit(series.angle)) / ARCSEC,
            cross_validation_rms_arcsec=validation.rms / ARCSEC,
            effective_parameters=fit.effective_parameters,
            settings=fit.settings,
        )


@dataclass(frozen=True)
class CompensationNumbers:
    """Sigma of a compensated angle: common to all, along the curve, of each reading by itself."""

    common_arcsec: float
    smooth_arcsec: float
    white_arcsec: float


@dataclass(frozen=True)
class PointNumbers:
    """One angle, for figures of one's own."""

    reading_deg: float
    mean_arcsec: float
    sigma_arcsec: float
    rms_before_arcsec: float
    rms_after_arcsec: float
    comparisons_arcsec: Array
    kept: np.ndarray
    fitted_arcsec: Mapping[str, float]

    @classmethod
    def of(cls, series: CalibrationSeries, fits: Mapping[str, AngleFit]) -> tuple[PointNumbers, ...]:
        """Of all angles."""
        fitted = {name: fit(series.angle) / ARCSEC for name, fit in fits.items()}
        return tuple(
            cls(
                reading_deg=float(np.degrees(series.angle[i])),
                mean_arcsec=float(series.mean[i]) / ARCSEC,
                sigma_arcsec=float(series.sigma[i]) / ARCSEC,
                rms_before_arcsec=float(series.rms_before[i]) / ARCSEC,
                rms_after_arcsec=float(series.rms_after[i]) / ARCSEC,
                comparisons_arcsec=series.comparisons[i][series.taken[i]] / ARCSEC,
                kept=series.keep[i][series.taken[i]],
                fitted_arcsec={name: float(values[i]) for name, values in fitted.items()},
            )
            for i in range(len(series.angle))
        )


@dataclass(frozen=True)
class TrueFitNumbers:
    """A fit against the true curve; ``spread``: without a constant, which differences of angles do not see."""

    true_rms_arcsec: float
    true_spread_arcsec: float


@dataclass(frozen=True)
class TurntableTruth:
    """What no test in a laboratory has."""

    fits: Mapping[str, TrueFitNumbers]
    dividing_error_spread_arcsec: float
    part_rms_full_circle_arcsec: Mapping[str, float]

    @classmethod
    def of(cls, run: TurntableRun, model: TurntableModel) -> TurntableTruth:
        """Of a run on a simulated table."""
        fits = {}
        for name, fit in run.fits.items():
            left = fit(run.truth_readings) - run.true_error
            fits[name] = TrueFitNumbers(rms(left) / ARCSEC, float(np.std(left)) / ARCSEC)
        return cls(
            fits=fits,
            dividing_error_spread_arcsec=float(np.std(run.true_error)) / ARCSEC,
            part_rms_full_circle_arcsec={name: p.rms / ARCSEC for name, p in model.error.parts.items()},
        )


@dataclass(frozen=True)
class FileNumbers:
    """A file of measurements: rows below its heads, SHA-256 of its contents."""

    file: str
    rows: int
    sha256: str


@dataclass(frozen=True)
class RejectedNumbers:
    """A comparison that Chauvenet's criterion takes out, and where it stands."""

    file: str
    line: int
    reading_deg: float
    from_mean_arcsec: float

    @classmethod
    def of(cls, comparisons: Comparisons) -> tuple[RejectedNumbers, ...]:
        """All of a series."""
        series = comparisons.series
        return tuple(
            cls(
                comparisons.file.file,
                int(comparisons.lines[i, k]),
                float(np.degrees(series.angle[i])),
                float(series.comparisons[i, k] - series.mean[i]) / ARCSEC,
            )
            for i, k in np.argwhere(series.taken & ~series.keep)
        )


@dataclass(frozen=True)
class TurntableNumbers:
    """turntable.json. The four RMS at the top are the largest of any angle. Chi-square of the chosen fit: against the
    sigmas of the calibrated means; at the held-out readings against all that the compensation states.
    """

    name: str
    seed: int
    repeat_rms_arcsec: float
    chauvenet_rms_arcsec: float
    averaging_alone_rms_arcsec: float
    mean_rms_arcsec: float
    repeatability_arcsec: float
    rejected: int
    rejected_expected_of_good: float
    suspect_angles: int
    heldout_sigma_arcsec: float | None
    fits: Mapping[str, FitNumbers]
    failed: Mapping[str, str | None]
    chosen: str
    ranking: Sequence[str]
    compensation: CompensationNumbers
    points: tuple[PointNumbers, ...]
    heldout_points: tuple[PointNumbers, ...]
    fit_chi_square: float
    fit_degrees_of_freedom: float
    heldout_chi_square: float | None
    heldout_degrees_of_freedom: int | None
    rejected_readings: tuple[RejectedNumbers, ...] | None = field(default=None, metadata=WHERE_KNOWN)
    too_few_angles_for: Sequence[str] | None = field(default=None, metadata=WHERE_KNOWN)
    files: tuple[FileNumbers, ...] | None = field(default=None, metadata=WHERE_KNOWN)
    truth: TurntableTruth | None = field(default=None, metadata=WHERE_KNOWN)

    @classmethod
    def of(cls, run: TurntableRun) -> TurntableNumbers:
        """Of a run."""
        series, compensation, tables = run.series, run.compensation, run.tables
        square, freedom = run.chi_square
        held, held_freedom = run.held_out_chi_square or (None, None)
        return cls(
            name=run.spec.name,
            seed=run.seed,
            repeat_rms_arcsec=float(np.max(series.rms_before)) / ARCSEC,
            chauvenet_rms_arcsec=float(np.max(series.rms_after)) / ARCSEC,
            averaging_alone_rms_arcsec=series.averaging_alone / ARCSEC,
            mean_rms_arcsec=series.mean_rms / ARCSEC,
            repeatability_arcsec=series.repeatability / ARCSEC,
            rejected=series.rejected,
            rejected_expected_of_good=expected_rejections(series.counts),
            suspect_angles=int(np.sum(series.suspect)),
            heldout_sigma_arcsec=None if run.held_out is None else rms(run.held_out.sigma) / ARCSEC,
            fits={name: FitNumbers.of(run, name) for name in run.fits},
            failed={trial.name: trial.failure for trial in run.choice.trials if trial.fit is None},
            chosen=run.choice.chosen,
            ranking=run.ranking,
            compensation=CompensationNumbers(
                compensation.common / ARCSEC, compensation.smooth / ARCSEC, compensation.white / ARCSEC
            ),
            points=PointNumbers.of(series, run.fits),
            heldout_points=() if run.held_out is None else PointNumbers.of(run.held_out, run.fits),
            fit_chi_square=square,
            fit_degrees_of_freedom=freedom,
            heldout_chi_square=held,
            heldout_degrees_of_freedom=held_freedom,
            rejected_readings=tuple(one for table in tables for one in RejectedNumbers.of(table)) if tables else None,
            too_few_angles_for=run.too_few if tables else None,
            files=tuple(FileNumbers(**asdict(table.file)) for table in tables) or None,
            truth=None if run.model is None else TurntableTruth.of(run, run.model),
        )


def turntable_numbers(run: TurntableRun) -> dict[str, Any]:
    """Contents of turntable.json without its frames."""
    return dict(plain_data(TurntableNumbers.of(run)))
