"""What a drift of the attitude within the passes does to a calibration: by how much parameters move that do not know of
it, what the residuals show of it, and what was assumed where they show one that nobody stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from analysis.orbit.adjustment import Adjustment
from analysis.orbit.residual_tests import FALSE_ALARM, Rates
from analysis.units import ARCSEC
from scenes.specs.measured.orbit_data import MeasuredCalibrationSpec
from twin.orbit.calibration.campaign import Campaign

UNSEEN = 3.0
"""Sigmas of an unknown, by a drift that residuals show only in half of all cases, from which on a file has to say
whether there is one."""


@dataclass(frozen=True)
class DriftNumbers:
    """Drift of the attitude during the passes.

    Attributes:
        seconds: from when the first line sees a field to when the last one does, mean of the passes.
        sigmas_per_arcsec: name of an unknown -> its change, in its sigmas, for a drift of 1 arcsec in these seconds
            (one standard deviation about each axis in each pass) that is no unknown; None where rates are unknowns.
        seen_arcsec: drift about body X, Y, Z in these seconds that residuals show in half of all cases; None likewise.
        unseen_sigmas: by how many of its sigmas the most sensitive unknown is then wrong; None likewise.
        rate_p_value, course_p_value: chance of the residuals without rates, and without errors that change slowly along
            the lines; below false_alarm they count as found.
        false_alarm: of either test.
        assumed_rate_rad_s, assumed_walk_rad: what was taken into the noise since; None where nothing was found.
    """

    seconds: float
    sigmas_per_arcsec: Mapping[str, float] | None
    seen_arcsec: NDArray[np.float64] | None
    unseen_sigmas: float | None
    rate_p_value: float | None
    course_p_value: float
    false_alarm: float
    assumed_rate_rad_s: tuple[float, float, float] | None
    assumed_walk_rad: float | None

    @classmethod
    def of(cls, campaign: Campaign, found: Adjustment) -> Self:
        """Of the adjustment of all fields."""
        seconds = float(np.mean([p.seconds_apart for p in campaign.passes]))
        effect = seen = unseen = None
        chance = None
        if found.rates is not None and seconds > 0.0:
            assert isinstance(found.rates.terms, Rates)
            sigma = np.array([found.sigma[n] for n in found.names])
            change = np.linalg.norm(found.rates.moved, axis=1) * ARCSEC / seconds
            effect = {n: float(c / s) for n, c, s in zip(found.names, change, sigma, strict=True) if s > 0.0}
            # of a test of all rates together, each alone
            power = np.sqrt(chi2.isf(FALSE_ALARM, max(found.rates.degrees_of_freedom, 1)))
            alone = found.rates.sigma_alone.reshape(-1, 3)
            seen = power * np.sqrt(1.0 / np.mean(alone**-2.0, axis=0) / len(alone)) * seconds / ARCSEC
            limit = np.where(np.isfinite(alone), alone, 0.0).ravel() * power
            wrong = np.abs(found.rates.moved) * limit
            unseen = float(np.max(wrong[sigma > 0.0] / sigma[sigma > 0.0][:, None], initial=0.0))
            chance = found.rates.p_value
        drifts = campaign.drifts
        if drifts is not None:
            chance = drifts.rate_p_value
        return cls(
            seconds,
            effect,
            seen,
            unseen,
            chance,
            found.courses.p_value if drifts is None else drifts.course_p_value,
            FALSE_ALARM,
            None if drifts is None else drifts.rate,
            None if drifts is None else drifts.walk,
        )

    @property
    def most(self) -> tuple[str, float]:
        """The unknown that drift moves by the most of its sigmas, and by how many; ("", 0) where rates are unknowns."""
        if not self.sigmas_per_arcsec:
            return "", 0.0
        name = max(self.sigmas_per_arcsec, key=lambda n: (self.sigmas_per_arcsec or {})[n])
        return name, self.sigmas_per_arcsec[name]


def drift_warnings(campaign: Campaign, numbers: DriftNumbers) -> list[str]:
    """That residuals show a drift, or that a file does not say whether there is one that would matter."""
    if numbers.assumed_walk_rad is not None and numbers.assumed_rate_rad_s is not None:
        rate = max(numbers.assumed_rate_rad_s) * numbers.seconds / ARCSEC
        chance = min(numbers.course_p_value, 1.0 if numbers.rate_p_value is None else numbers.rate_p_value)
        return [
            "the attitude drifts during the passes, or image points err alike along the lines: residuals of"
            f" neighbouring exposures are alike (chance {chance:.1g}). A random walk of"
            f" {numbers.assumed_walk_rad / ARCSEC:.2g} arcsec in a second and rates of {rate:.2g} arcsec in"
            f" {numbers.seconds:.0f} s have been taken into the sigmas, which are as good as this guess: state"
            " errors.star_tracker.drift and walk"
        ]
    name, ratio = numbers.most
    spec, unseen = campaign.spec, numbers.unseen_sigmas or 0.0
    if isinstance(spec, MeasuredCalibrationSpec) and spec.errors.star_tracker.drift is None and unseen > UNSEEN:
        seen = float(np.min(numbers.seen_arcsec)) if numbers.seen_arcsec is not None else np.inf
        return [
            f"nothing is said of a drift of the attitude within a pass: 1 arcsec in {numbers.seconds:.0f} s moves"
            f" {name} by {ratio:.2g} of its sigmas, and the residuals of these points show it from {seen:.2g} arcsec:"
            " state errors.star_tracker.drift, [0 arcsec, 0 arcsec, 0 arcsec] where there is none"
        ]
    return []
