"""The turntable test of paper 004 (section 3.3): a table whose dividing error nobody knows is compared with a
reference, five fits are made of the comparisons and judged on angles that no fit has seen.

The analysis gets the comparisons and the certificate of the reference, of a simulated bench or from files of
measurements. The true dividing error of a simulated table is only compared with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.turntable.dividing_error import (
    FITS,
    AngleFit,
    CalibrationSeries,
    Choice,
    DividingCompensation,
    angles_left,
    choose,
    compensate,
    fewest,
)
from optics.numerics.backend import Backend, one_blas_thread
from scenes.specs.resolved import ExperimentSetup
from scenes.specs.turntable import MeasuredTurntableSpec, TurntableFiles, TurntableTestSpec
from twin.framework.procedure import Advance, silent
from twin.laboratory.measured_readings import Comparisons, read_turntable
from twin.laboratory.turntable_bench import TurntableModel

TRUTH_READINGS = 4000
"""Readings at which fits are compared with the true curve."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class TurntableRun:
    """One turntable test, on a simulated bench or on measured readings.

    Attributes:
        spec: of the test.
        seed: of all that is drawn: the simulated bench, and the network's starts.
        series: comparisons at the calibrated readings.
        held_out: comparisons at readings that no fit has seen; None if there are none.
        choice: fits and their cross-validation.
        compensation: of the chosen fit.
        model: the simulated table and reference, which hold the truth; None for measurements.
        tables: the series as read from files; empty for a simulated bench.
        too_few: fits that need more angles than there are.
    """

    spec: TurntableTestSpec | MeasuredTurntableSpec
    seed: int
    series: CalibrationSeries
    held_out: CalibrationSeries | None
    choice: Choice
    compensation: DividingCompensation
    model: TurntableModel | None = None
    tables: tuple[Comparisons, ...] = ()
    too_few: tuple[str, ...] = ()

    @property
    def fits(self) -> dict[str, AngleFit]:
        """The fits that succeeded, in the order in which they were made."""
        return {name: trial.fit for name, trial in self.choice.trials.items()}

    def residual(self, name: str) -> Array:
        """Measured - fitted dividing error at the calibrated readings, (N,), radians."""
        return self.series.mean - self.fits[name](self.series.angle)

    def true_residual(self, name: str) -> Array:
        """Fitted - true dividing error of a simulated table at `truth_readings`, radians."""
        return self.fits[name](self.truth_readings) - self.true_error

    def held_out_residual(self, name: str) -> Array:
        """Measured - fitted dividing error at the held-out readings, radians."""
        assert self.held_out is not None
        return self.held_out.mean - self.fits[name](self.held_out.angle)

    def held_out_rms(self, name: str) -> float | None:
        """RMS of `held_out_residual`, radians; None without held-out readings."""
        return None if self.held_out is None else rms(self.held_out_residual(name))

    def _judged(self, name: str) -> float:
        held_out = self.held_out_rms(name)
        return self.choice[name].validation.rms if held_out is None else held_out

    @cached_property
    def ranking(self) -> tuple[str, ...]:
        """Names of the fits by their RMS at the held-out readings, the best first; without such readings by
        cross-validation.
        """
        return tuple(sorted(self.fits, key=self._judged))

    @cached_property
    def chi_square(self) -> tuple[float, float]:
        """Chi-square of the chosen fit at the calibrated readings, against their sigmas, and its degrees of freedom."""
        square = float(np.sum((self.residual(self.choice.chosen) / self.series.sigma) ** 2))
        return square, len(self.series.angle) - self.compensation.fit.effective_parameters

    @cached_property
    def held_out_chi_square(self) -> tuple[float, int] | tuple[None, None]:
        """Chi-square at the held-out readings, against all that the compensation states, and its degrees of freedom;
        None without such readings.
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
        # multiples of the golden ratio: no common measure with the signal's period, unlike an even grid
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
    names: Sequence[str] = tuple(FITS),
) -> TurntableRun:
    """Simulate or read the comparisons, clean them, fit them, choose a fit and make the compensation of it.

    Args:
        spec: of the test.
        seed: of all that is drawn; with the spec it determines everything.
        progress: told what is being done.
        names: of the fits; the network takes nearly all of the time.

    Raises:
        InputError: a table cannot be used, or there are fewer angles than a fit and its cross-validation need.
    """
    say = progress or (lambda text: None)
    model: TurntableModel | None = None
    tables: tuple[Comparisons, ...] = ()
    held_out: CalibrationSeries | None = None
    too_few: tuple[str, ...] = ()
    if isinstance(spec, MeasuredTurntableSpec):
        say("read the comparisons")
        tables, folds = read_turntable(spec.measured), spec.measured.folds
        names, too_few = usable_fits(spec.measured, tables[0], names)
        series, held_out = tables[0].series, tables[1].series if len(tables) > 1 else None
    else:
        folds = spec.calibration.folds
        _check_count(spec, names)
        say("compare the table with the reference")
        model = TurntableModel(spec, seed)
        series, held_out = model.calibrate(), model.held_out()
    # the network's matrices are small
    with one_blas_thread():
        choice = choose(series, seed, names, folds, say)
        compensation = compensate(series, choice, held_out)
    return TurntableRun(spec, seed, series, held_out, choice, compensation, model, tables, too_few)


def _check_count(spec: TurntableTestSpec, names: Sequence[str]) -> None:
    """InputError unless the simulated calibration has angles enough for every fit."""
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


def usable_fits(
    files: TurntableFiles, found: Comparisons, names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The fits of which there are angles enough, and the others.

    Raises:
        InputError: there are enough for none.
    """
    count = len(found.series.angle)
    left = angles_left(count, files.folds)
    enough = tuple(name for name in names if left >= fewest(name))
    if not enough:
        text = f"{count} angles, {left} of them without a fold of the cross-validation"
        issue = files.error("too few angles for any fit", ("comparisons",), found=text, allowed="more angles or folds")
        raise issue
    return enough, tuple(name for name in names if name not in enough)


def rms(value: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(value**2)))


def run_turntable_test(
    setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> TurntableRun:
    """``python -m twin.lab turntable``; nothing is traced, so that the backend is not used. Raises InputError."""
    return run_turntable(setup.test, seed, lambda part: advance(part, 0, 1))
