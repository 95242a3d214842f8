"""How well the parameters repeat from field to field, each calibrated by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from analysis.orbit.three_line_model import BIAS
from twin.orbit.calibration.calibration_run import CalibrationRun


@dataclass(frozen=True)
class Repeatability:
    """One parameter over the fields, metres or radians.

    Attributes:
        name: of the parameter, without a field.
        scatter: standard deviation over the fields.
        sigma: that the adjustments claim, root mean square; 0 where held.
        p_value: chance of such a scatter or a larger one if the parameter is the same in all fields; None where held.
    """

    name: str
    scatter: float
    sigma: float
    p_value: float | None


def repeatability(run: CalibrationRun) -> tuple[Repeatability, ...]:
    """Interior orientation, then biases; empty for fewer than two fields."""
    if len(run.fields) < 2:
        return ()
    found = []
    for name in (*run.campaign.inner, *BIAS):
        alone = [(field, r.adjustment) for field, r in run.fields.items()]
        names = [f"{field} {name}" if name in BIAS else name for field, _ in alone]
        value = np.array([a.value(n) for n, (_, a) in zip(names, alone, strict=True)])
        sigma = np.array([a.sigma[n] for n, (_, a) in zip(names, alone, strict=True)])
        scatter, claimed = float(value.std(ddof=1)), float(np.sqrt(np.mean(sigma**2)))
        chance = None
        if claimed > 0.0:
            weight = sigma**-2.0
            mean = float(np.sum(weight * value) / np.sum(weight))
            chance = float(chi2.sf(np.sum(weight * (value - mean) ** 2), len(value) - 1))
        found.append(Repeatability(name, scatter, claimed, chance))
    return tuple(found)
