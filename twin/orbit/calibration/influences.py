"""Errors that the fit of a calibration hardly shows, and their tests.

Ground coordinates in a wrong datum are absorbed by the parameters; estimates far from their expected values indicate
them. A drift of the attitude within the passes and steps between the chips of a line are tested on the residuals: the
smallest detectable size, and whether they are significant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.stats import chi2, norm

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import FALSE_ALARM, Adjustment, Rates, Steps
from analysis.orbit.calibration_parameters import OFFSET
from analysis.orbit.three_line_model import BIAS
from scenes.specs.orbit.measurements import MeasuredCalibrationSpec
from twin.orbit.calibration.campaign import Campaign, DetectedDrift

UNEXPECTED_SIGMAS = 4.0
"""Difference of an unknown from its expected value, in units of its expected standard deviation, beyond which it is
reported; with seventy unknowns, a false alarm occurs in 1 of 200 campaigns.
"""
UNDETECTED_SIGMAS = 3.0
"""Error of an unknown due to a barely detectable drift, in its sigmas, above which the file must specify whether the
attitude drifts; barely detectable is a drift that the residuals show in half of all cases.
"""
_STEP_ALARM = 1e-4
"""Probability that any of a run's tests of steps between chips raises a false alarm."""


@dataclass(frozen=True)
class UnexpectedChange:
    """Estimate that differs significantly from its expected value.

    Attributes
    ----------
    name : str
        Name of the unknown.
    change : float
        Estimated minus expected value, in metres or radians.
    expected : float
        Expected standard deviation of the change, in the same unit.
    """

    name: str
    change: float
    expected: float

    @property
    def ratio(self) -> float:
        """Absolute change divided by its expected standard deviation."""
        return abs(self.change) / self.expected


def unexpected_changes(campaign: Campaign, adjustment: Adjustment) -> tuple[UnexpectedChange, ...]:
    """Return the estimates that differ from expectation by over `UNEXPECTED_SIGMAS` sigmas, largest ratio first."""
    expected = _expected(campaign)
    known = [(name, *prior) for name, prior in expected.items() if name in adjustment.names]
    changes = [UnexpectedChange(n, float(adjustment.value(n) - v), s) for n, v, s in known]
    return tuple(sorted((s for s in changes if s.ratio > UNEXPECTED_SIGMAS), key=lambda s: -s.ratio))


def _expected(campaign: Campaign) -> dict[str, tuple[float, float]]:
    """Return the expected value and standard deviation of each unknown, according to the priors of launch and orbit."""
    launch, errors = campaign.spec.launch, campaign.spec.errors
    inner = campaign.inner
    start = dict(zip(inner, np.ravel([campaign.laboratory[line].interior for line in campaign.lines]), strict=True))
    expected = {name: (start[name], launch.interior) for name in inner}
    for flight in campaign.passes:
        # the season's part is expected, too
        spread = np.hypot(launch.bias, np.array(errors.season))
        biases = zip(BIAS, spread.tolist(), strict=True)
        expected |= {f"{flight.name} {axis}": (0.0, s) for axis, s in biases if s > 0.0}
        if errors.switched_on:
            drift = zip(OFFSET, errors.gps.drift, strict=True)
            expected |= {f"{flight.name} offset {axis}": (0.0, s) for axis, s in drift if s > 0.0}
    return expected


@dataclass(frozen=True)
class AttitudeDrift:
    """Effect of an attitude drift during the passes on the unknowns, and its test on the residuals.

    Attributes
    ----------
    seconds : float
        Time from when the first line sees a field to when the last one does, mean of the passes.
    sigmas_per_arcsec : Mapping[str, float] or None
        Change of each unknown, divided by its sigma, due to a drift that is not estimated and has a standard deviation
        of 1 arcsec in `seconds` about each axis in each pass; None where rates are unknowns.
    detectable : (3,) ndarray or None
        Drift about body X, Y, Z within `seconds` that the test on the residuals detects in half of all cases, in
        radians; None where rates are unknowns.
    undetected_sigmas : float or None
        Error of the most sensitive unknown due to the `detectable` drift, divided by its sigma; None where rates are
        unknowns.
    rate_p_value, course_p_value : float or None
        p-values of the tests for rates and for slowly varying errors, from the residuals of an adjustment without them;
        below `FALSE_ALARM` they count as detected.
    assumed : DetectedDrift or None
        Drift that was added to the noise model; None where none was detected.
    """

    seconds: float
    sigmas_per_arcsec: Mapping[str, float] | None
    detectable: np.ndarray | None
    undetected_sigmas: float | None
    rate_p_value: float | None
    course_p_value: float
    assumed: DetectedDrift | None

    @classmethod
    def of(cls, campaign: Campaign, fit: Adjustment) -> Self:
        """Compute the effect of an attitude drift on the unknowns, and its test, from an adjustment of all fields."""
        seconds = float(np.mean([p.seconds_apart for p in campaign.passes]))
        effect = detectable = undetected = None
        rate_p_value = None
        if fit.rates is not None and seconds > 0.0:
            assert isinstance(fit.rates.terms, Rates)
            sigma = np.array([fit.sigma[n] for n in fit.names])
            change = np.linalg.norm(fit.rates.bias, axis=1) * ARCSEC / seconds
            effect = {n: float(c / s) for n, c, s in zip(fit.names, change, sigma, strict=True) if s > 0.0}
            # detectable size of each rate alone in a test of all rates together
            power = np.sqrt(chi2.isf(FALSE_ALARM, max(fit.rates.degrees_of_freedom, 1)))
            alone = fit.rates.sigma_alone.reshape(-1, 3)
            detectable = power * np.sqrt(1.0 / np.mean(alone**-2.0, axis=0) / len(alone)) * seconds
            limit = np.where(np.isfinite(alone), alone, 0.0).ravel() * power
            wrong = np.abs(fit.rates.bias) * limit
            undetected = float(np.max(wrong[sigma > 0.0] / sigma[sigma > 0.0][:, None], initial=0.0))
            rate_p_value = fit.rates.p_value
        course, drifts = fit.slow_variations.p_value, campaign.drifts
        if drifts is not None:
            rate_p_value, course = drifts.rate_p_value, drifts.course_p_value
        return cls(seconds, effect, detectable, undetected, rate_p_value, course, drifts)

    @property
    def most(self) -> tuple[str, float]:
        """Name of the unknown that a drift changes by the most sigmas, and this change in sigmas.

        The value is ("", 0) where rates are estimated as unknowns.
        """
        if not self.sigmas_per_arcsec:
            return "", 0.0
        return max(self.sigmas_per_arcsec.items(), key=lambda item: item[1])


def drift_warnings(campaign: Campaign, drift: AttitudeDrift) -> list[str]:
    """Return warnings of a detected attitude drift, or of one that may be harmful without being detectable."""
    if drift.assumed is not None:
        rate = max(drift.assumed.rate) * drift.seconds / ARCSEC
        p_value = min(drift.course_p_value, 1.0 if drift.rate_p_value is None else drift.rate_p_value)
        return [
            "the attitude drifts during the passes, or errors of image points are correlated along the lines: residuals"
            f" of neighbouring exposures are correlated (p = {p_value:.1g}). The sigmas include a random walk of"
            f" {drift.assumed.walk / ARCSEC:.2g} arcsec in a second and rates of {rate:.2g} arcsec in"
            f" {drift.seconds:.0f} s, estimated from these residuals: specify errors.star_tracker.drift and walk"
        ]
    name, ratio = drift.most
    spec, undetected = campaign.spec, drift.undetected_sigmas or 0.0
    unspecified = isinstance(spec, MeasuredCalibrationSpec) and spec.errors.star_tracker.drift is None
    if unspecified and undetected > UNDETECTED_SIGMAS:
        least = float(np.min(drift.detectable)) / ARCSEC if drift.detectable is not None else np.inf
        return [
            f"the file specifies no drift of the attitude within a pass: 1 arcsec in {drift.seconds:.0f} s changes"
            f" {name} by {ratio:.2g} of its sigmas, and the residuals show a drift only above {least:.2g} arcsec:"
            " specify errors.star_tracker.drift, [0 arcsec, 0 arcsec, 0 arcsec] where there is none"
        ]
    return []


@dataclass(frozen=True)
class ChipStep:
    """Test of a step between the chips of a line, in x (along the track) or y.

    Attributes
    ----------
    line : str
        Name of the line camera.
    axis : str
        Direction of the step, x or y.
    position : float
        Position y of the joint in the focal plane, in metres.
    step : float
        Estimated displacement of all pixels beyond the joint, in metres.
    sigma : float or None
        Standard deviation of the step, estimated together with all other unknowns, in metres; None where it is not
        observable.
    detectable : float or None
        Step that is detected in half of all cases, in metres; None where it is not observable.
    detected : bool
        True where the step is significant, at a false-alarm probability of 1e-4 for all steps together.
    """

    line: str
    axis: str
    position: float
    step: float
    sigma: float | None
    detectable: float | None
    detected: bool

    @classmethod
    def of(cls, campaign: Campaign, together: Adjustment) -> tuple[Self, ...]:
        """Test the steps between the chips of all lines, with the residuals of the adjustment of all fields."""
        steps = Steps(_joints(campaign))
        test = together.omitted_terms_test(steps)
        limit = float(norm.isf(0.5 * _STEP_ALARM / max(steps.size, 1)))
        chip_steps = []
        for k, (value, sigma) in enumerate(zip(test.estimate.tolist(), test.sigma.tolist(), strict=True)):
            line, position = steps.positions[k // 2]
            values = (value, sigma, limit * sigma, abs(value) > limit * sigma)
            chip_steps.append(
                cls(line, "xy"[k % 2], position, *(values if np.isfinite(sigma) else (0.0, None, None, False)))
            )
        return tuple(chip_steps)


def _joints(campaign: Campaign) -> tuple[tuple[str, float], ...]:
    """Return (line, y) of the joints between chips, y in metres; for a line of one chip, its middle."""
    data = campaign.passes[0].data
    joints = []
    for name in campaign.lines:
        ccds = data.lines[name].ccds or ()
        pixels = [0.5 * (a.last + b.first) for a, b in pairwise(ccds)]
        pixels = pixels or [0.5 * (data.sensors[name].camera.pixels - 1)]
        joints += [(name, float(y)) for y in data.positions(name, np.array(pixels))[:, 1]]
    return tuple(joints)


def step_warnings(numbers: tuple[ChipStep, ...]) -> list[str]:
    """Return a warning that lists the significant steps between chips, if there are any."""
    detected = [n for n in numbers if n.detected]
    if not detected:
        return []
    listed = ", ".join(
        f"{n.line} {n.axis} {1e6 * n.step:+.1f} ± {1e6 * (n.sigma or 0.0):.1f} µm at {1e3 * n.position:.1f} mm"
        for n in detected
    )
    return [f"residuals show a step within a line: {listed}; the positions of its chips in the camera's file are wrong"]
