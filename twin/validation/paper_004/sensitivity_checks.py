"""Paper 004, sections 3.1 and 3.3: what it says of the sources of error, against rendered spots and the trace."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.units import ARCSEC
from analysis.units import MM_PER_M as MM
from analysis.units import UM_PER_M as UM
from twin.laboratory.distortion_run import SimulatedDistortion, rms
from twin.validation.checks.check import Check, CheckResult
from twin.validation.checks.chosen import Chosen
from twin.validation.checks.group import Context
from twin.validation.paper_004.orientation import ACCURACY_UM, POINTS, SpotTest, rendered
from twin.validation.paper_004.turntable_checks import FIT_RMS_ARCSEC, dividing

Array = NDArray[np.float64]
FEW = 5
"""Every fifth point, for the effect of their number."""


def evaluate_sensitivity(context: Context, runs: Sequence[SimulatedDistortion]) -> Iterator[CheckResult]:
    """The rows of the sources of error."""
    if not context.wants("004.sensitivity"):
        return
    tests = [SpotTest(run) for run in runs]
    count = len(tests)
    half = np.flatnonzero(np.abs(tests[0].run.bench.turn) <= 0.5 * tests[0].run.bench.turn[-1])
    whole = slice(None)
    raw = [np.asarray(t.run.raw.fit.angle) for t in tests]
    all_raw, inner = (np.array([t.errors(w, k) for t, w in zip(tests, raw, strict=True)]) for k in (whole, half))
    own = np.array([t.errors(t.turn, whole)[1] for t in tests])
    spots = np.array([t.errors(t.true_turn, whole)[1] for t in tests])
    share = 100.0 * (1.0 - rms(spots) ** 2 / rms(own) ** 2)
    how = (
        f"{rendered(tests)}. With compensated angles D errs by {UM * rms(own):.2f} µm RMS, with the true angles and "
        f"the same images by {UM * rms(spots):.2f} µm; with angles as read by {UM * rms(all_raw[:, 1]):.2f} µm."
    )
    by_spots, by_angles = rms(spots) ** 2, rms(own) ** 2 - rms(spots) ** 2
    chosen = Chosen(
        "dividing error of scenes/lab/turntable.yaml, times", 1.0, "1",
        lambda factor: 100.0 * (1.0 - by_spots / (by_spots + factor**2 * by_angles)),
    )  # fmt: skip
    yield context.check("004.sensitivity.angle").evaluate(share, None, how, 50.0, inputs=[chosen])
    for name, column, over, under in (("field", 1, all_raw, inner), ("distance", 0, inner, all_raw)):
        top, bottom = rms(over[:, column]), rms(under[:, column])
        unit, scale = ("µm", UM) if column else ("mm", MM)
        how = f"{count} tests of {POINTS} points; {len(half)} of them lie in the inner half: {scale * top:.3g} "
        how += f"against {scale * bottom:.3g} {unit} RMS."
        yield context.check(f"004.sensitivity.{name}").evaluate(top / bottom, _ratio(over, under, column), how, 1.0)
    few = np.array([[t.errors(t.turn, slice(k, None, FEW))[0] for k in range(FEW)] for t in tests])
    every = np.array([t.errors(t.turn, whole)[0] for t in tests])
    gain = rms(few) / rms(every)
    how = (
        f"{count} tests, angles compensated: RMS error of f {MM * rms(every):.3f} mm with {POINTS} points, "
        f"{MM * rms(few):.3f} mm with {POINTS // FEW}. Independent errors would gain {FEW**0.5:.2f}; what the "
        "compensation leaves is common to neighbouring points and gains nothing."
    )
    yield context.check("004.sensitivity.points").evaluate(gain, None, how, 1.0)
    yield _requirement(context, tests)


def _ratio(over: Array, under: Array, column: int) -> float:
    """Standard deviation of a ratio of RMS over tests, by leaving one out at a time."""
    n = len(over)
    keep = ~np.eye(n, dtype=bool)
    values = np.array([rms(over[k, column]) / rms(under[k, column]) for k in keep])
    return float(np.sqrt((n - 1) * np.var(values)))


def evaluate_angles(check: Check, runs: Sequence[SimulatedDistortion]) -> CheckResult:
    """What is left of the dividing error in the angles of the tests."""
    tests = [SpotTest(run) for run in runs]
    own, raw = (
        np.array([np.std(angle(t) - t.true_turn) for t in tests]) / ARCSEC
        for angle in (lambda t: t.turn, lambda t: t.run.raw.fit.angle)
    )
    how = (
        f"{len(tests)} tests, angles of {POINTS} points against the true ones: median {np.median(own):.3f}″; "
        f"angles as read {np.median(raw):.3f}″, largest {np.max(raw):.3f}″. What all points share is the zero, see "
        "004.eq1.constant."
    )
    value = float(np.max(own))
    return check.evaluate(value, None, how, inputs=[dividing(value)])


def _requirement(context: Context, tests: Sequence[SpotTest]) -> CheckResult:
    rng = np.random.default_rng(np.random.SeedSequence(context.seed, spawn_key=(1,)))
    wrong = FIT_RMS_ARCSEC * ARCSEC
    error = [t.errors(t.true_turn + rng.normal(0.0, wrong, len(t.turn)), slice(None))[1] for t in tests]
    f, points = float(np.mean([t.camera.f for t in tests])), len(tests[0].turn)
    expected = f * wrong * np.sqrt(1.0 - 3.0 / points)
    how = (
        f"The rendered spots of {len(tests)} tests with their true angles and errors of {FIT_RMS_ARCSEC:g}″ drawn from "
        "point to point; constant, f and p fitted. Errors with long waves would leave less."
    )
    needed = FIT_RMS_ARCSEC * ACCURACY_UM / (UM * expected)
    sigma = UM * expected / np.sqrt(2.0 * points * len(tests))
    return context.check("004.sensitivity.requirement").evaluate(
        UM * rms(np.array(error)), sigma, how, None, [UM * expected], asked=FIT_RMS_ARCSEC, needed=needed
    )
