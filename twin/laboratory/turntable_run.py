"""The turntable test of paper 004 (section 3.3): a table whose dividing error nobody knows is compared with a
reference, five fits are made of the comparisons and judged on angles that no fit has seen.

The analysis gets the comparisons and the certificate of the reference. The true dividing error is only compared with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.turntable.angle_fits import FITS, AngleFit, angles_left, fewest
from analysis.turntable.chauvenet import rejection_rate
from analysis.turntable.dividing_error import CalibrationSeries, Choice, DividingCompensation, choose, compensate
from analysis.units import ARCSEC
from optics.numerics.threads import one_blas_thread
from scenes.specs.turntable_test import TurntableTestSpec
from twin.laboratory.turntable_bench import TurntableModel

Array = NDArray[np.float64]
TRUTH_READINGS = 4000
"""Readings at which fits are compared with the true curve."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class TurntableRun:
    """One turntable test.

    Attributes:
        model: the table and the reference; holds the truth.
        series: comparisons at the calibrated readings.
        held_out: comparisons at readings that no fit has seen.
        choice: fits and their cross-validation.
        compensation: of the chosen fit.
    """

    model: TurntableModel
    series: CalibrationSeries
    held_out: CalibrationSeries
    choice: Choice
    compensation: DividingCompensation

    @property
    def fits(self) -> dict[str, AngleFit]:
        """The fits that succeeded, in the order in which they were made."""
        return {trial.name: trial.fit for trial in self.choice.trials if trial.fit is not None}

    @property
    def spec(self) -> TurntableTestSpec:
        """Of the test."""
        return self.model.spec

    def held_out_residual(self, name: str) -> Array:
        """Measured - fitted dividing error at the held-out readings, radians."""
        return self.held_out.mean - self.fits[name](self.held_out.angle)

    @cached_property
    def ranking(self) -> tuple[str, ...]:
        """Names of the fits by their RMS at the held-out readings, the best first."""
        return tuple(sorted(self.fits, key=lambda name: _rms(self.held_out_residual(name))))

    @cached_property
    def truth_readings(self) -> Array:
        """Readings spread evenly over the region and over the phases of the grating's signal, increasing, radians."""
        first, last = self.compensation.region
        # multiples of the golden ratio: no common measure with the signal's period, unlike an even grid
        return np.sort(first + (last - first) * np.mod(_GOLDEN * np.arange(1, TRUTH_READINGS + 1), 1.0))

    @cached_property
    def true_error(self) -> Array:
        """True dividing error at `truth_readings`, radians."""
        return self.model.error(self.truth_readings)

    def to_dict(self) -> dict[str, Any]:
        """turntable.json: every number in the unit that its key ends in."""
        series, held = self.series, self.held_out
        fits = {}
        for name, fit in self.fits.items():
            validation = self.choice[name].validation
            assert validation is not None
            fits[name] = {
                "heldout_rms_arcsec": _rms(self.held_out_residual(name)) / ARCSEC,
                "train_rms_arcsec": _rms(series.mean - fit(series.angle)) / ARCSEC,
                "cross_validation_rms_arcsec": validation.rms / ARCSEC,
                "effective_parameters": fit.effective_parameters,
                "settings": dict(fit.settings),
            }
        compensation = self.compensation
        return {
            "name": self.spec.name,
            "seed": self.model.seed,
            "repeat_rms_arcsec": float(np.max(series.rms_before)) / ARCSEC,
            "chauvenet_rms_arcsec": float(np.max(series.rms_after)) / ARCSEC,
            "averaging_alone_rms_arcsec": series.averaging_alone / ARCSEC,
            "mean_rms_arcsec": series.mean_rms / ARCSEC,
            "repeatability_arcsec": series.repeatability / ARCSEC,
            "rejected": series.rejected,
            "rejected_expected_of_good": rejection_rate(series.repeats) * series.comparisons.size,
            "suspect_angles": int(np.sum(series.suspect)),
            "heldout_sigma_arcsec": _rms(held.sigma) / ARCSEC,
            "fits": fits,
            "failed": {trial.name: trial.failure for trial in self.choice.trials if trial.fit is None},
            "chosen": self.choice.chosen,
            "ranking": list(self.ranking),
            "compensation": {
                "common_arcsec": compensation.common / ARCSEC,
                "smooth_arcsec": compensation.smooth / ARCSEC,
                "white_arcsec": compensation.white / ARCSEC,
            },
            "points": _points(series, self.fits),
            "heldout_points": _points(held, self.fits),
            "truth": self._truth(),
        }

    def _truth(self) -> dict[str, Any]:
        fits = {}
        for name, fit in self.fits.items():
            left = fit(self.truth_readings) - self.true_error
            fits[name] = {"true_rms_arcsec": _rms(left) / ARCSEC, "true_spread_arcsec": float(np.std(left)) / ARCSEC}
        return {
            "fits": fits,
            "dividing_error_spread_arcsec": float(np.std(self.true_error)) / ARCSEC,
            "part_rms_full_circle_arcsec": {name: p.rms / ARCSEC for name, p in self.model.error.parts.items()},
        }


def run_turntable(
    spec: TurntableTestSpec,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    names: Sequence[str] = tuple(FITS),
) -> TurntableRun:
    """Simulate the comparison, clean it, fit it, choose.

    Args:
        spec: of the test.
        seed: of the table, the reference, the noise and the network's starts; with the spec it determines everything.
        progress: told what is being done.
        names: of the fits; the network takes nearly all of the time.

    Raises:
        InputError: fewer angles than a fit and its cross-validation need.
    """
    say = progress or (lambda text: None)
    plan = spec.calibration
    left = angles_left(plan.count, plan.folds)
    short = [name for name in names if left < fewest(name)]
    if short:
        raise spec.error(
            f"too few angles for the fit {short[0]!r}",
            ("calibration", "step"),
            found=f"{plan.count} angles, {left} of them without a fold of the cross-validation",
            allowed=f"steps that leave {fewest(short[0])} or more",
        )
    say("compare the table with the reference")
    model = TurntableModel(spec, seed)
    series, held_out = model.calibrate(), model.held_out()
    # the network's matrices are small
    with one_blas_thread():
        choice = choose(series, seed, names, plan.folds, say)
        return TurntableRun(model, series, held_out, choice, compensate(series, choice, held_out))


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2)))


def _points(series: CalibrationSeries, fits: dict[str, AngleFit]) -> list[dict[str, Any]]:
    """One entry for each angle, for figures of one's own."""
    fitted = {name: fit(series.angle) / ARCSEC for name, fit in fits.items()}
    return [
        {
            "reading_deg": float(np.degrees(series.angle[i])),
            "mean_arcsec": float(series.mean[i]) / ARCSEC,
            "sigma_arcsec": float(series.sigma[i]) / ARCSEC,
            "rms_before_arcsec": float(series.rms_before[i]) / ARCSEC,
            "rms_after_arcsec": float(series.rms_after[i]) / ARCSEC,
            "comparisons_arcsec": (series.comparisons[i] / ARCSEC).tolist(),
            "kept": series.keep[i].tolist(),
            "fitted_arcsec": {name: float(values[i]) for name, values in fitted.items()},
        }
        for i in range(len(series.angle))
    ]
