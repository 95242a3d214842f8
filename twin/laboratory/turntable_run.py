"""The turntable test of paper 004 (section 3.3): a table whose dividing error nobody knows is compared with a
reference, five fits are made of the comparisons and judged on angles that no fit has seen.

The analysis gets the comparisons and the certificate of the reference. The true dividing error is only compared with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.turntable.angle_fits import FITS, AngleFit, angles_left, fewest
from analysis.turntable.dividing_error import CalibrationSeries, Choice, DividingCompensation, choose, compensate
from optics.numerics.backend import Backend
from optics.numerics.threads import one_blas_thread
from scenes.specs.lab_setup import TurntableSetup
from scenes.specs.turntable_test import TurntableTestSpec
from twin.laboratory.turntable_bench import TurntableModel
from twin.run.procedure import Advance, silent

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
        return tuple(sorted(self.fits, key=lambda name: rms(self.held_out_residual(name))))

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


def rms(value: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(value**2)))


def run_turntable_test(setup: TurntableSetup, backend: Backend, seed: int, advance: Advance = silent) -> TurntableRun:
    """``python -m twin.lab turntable``; nothing is traced, so that the backend is not used. Raises InputError."""
    return run_turntable(setup.test, seed, lambda part: advance(part, 0, 1))
