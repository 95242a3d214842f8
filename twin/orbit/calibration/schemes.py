"""Schemes of averaged parameters (paper 003, section 4.4), tested on all fields by forward intersection without ground
control: on one campaign, and on campaigns repeated with everything drawn anew. What averaging can gain depends on how
well the parameters repeat from field to field, which stands here, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from analysis.calibration.adjustment import Adjustment
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from analysis.orbit.three_line_model import BIAS, LineModel
from optics.numerics.number_tree import FrozenMap
from twin.framework.procedure import Advance
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import calibrated_alone
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.observations import EFFECTS

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import MapLimitsSpec
    from scenes.specs.orbit.setup import CalibrationSetup

RMS = ("plan_rms", "height_rms")
"""Attributes of `CheckErrors` and of `FieldErrors`."""


@dataclass(frozen=True)
class FieldErrors:
    """RMS errors at the check points of several fields, metres: in plan (both axes) and in height."""

    plan_rms: float
    height_rms: float

    @classmethod
    def pooled(cls, errors: Iterable[CheckErrors]) -> FieldErrors:
        """RMS errors over all check points, so that a field weighs by the number of its points."""
        rows = list(errors)
        count = [e.count for e in rows]
        plan, height = (np.average(np.square([getattr(e, what) for e in rows]), weights=count) for what in RMS)
        return cls(float(np.sqrt(plan)), float(np.sqrt(height)))

    @classmethod
    def mean(cls, errors: Mapping[str, CheckErrors]) -> FieldErrors:
        """Means of the fields' RMS errors."""
        return cls(*(float(values_of(errors, what).mean()) for what in RMS))


def meets(errors: Mapping[str, CheckErrors], limits: MapLimitsSpec) -> bool:
    """Whether the RMS errors of every field lie within the limits of a map."""
    return all(e.plan_rms <= limits.plan and e.height_rms <= limits.height for e in errors.values())


@dataclass(frozen=True, eq=False)
class SchemeMeans:
    """Errors of the schemes of averaged parameters over the fields, fewest fields first.

    Attributes:
        plan: mean over the fields of the RMS in plan, metres, each scheme.
        plan_spread: standard deviation over the fields.
        height, height_spread: likewise.
    """

    plan: np.ndarray
    plan_spread: np.ndarray
    height: np.ndarray
    height_spread: np.ndarray

    @classmethod
    def of(cls, schemes: Mapping[str, Mapping[str, CheckErrors]]) -> SchemeMeans | None:
        """Means and spreads of the schemes; None for a single scheme of averaged parameters.

        schemes: all of them; the last, each field its own, is not averaged and does not count.
        """
        if len(schemes) < _LEAST_SCHEMES:
            return None
        plan, height = (np.array([values_of(e, what) for e in schemes.values()])[:-1] for what in RMS)
        return cls(plan.mean(axis=1), plan.std(axis=1), height.mean(axis=1), height.std(axis=1))

    @property
    def height_change(self) -> float:
        """Largest change of the mean height error between schemes, relative to the first."""
        return float(np.ptp(self.height) / self.height[0])


_LEAST_SCHEMES = 3
"""Two of averaged parameters, and each field its own."""


@dataclass(frozen=True, eq=False)
class Repeats:
    """Campaigns over the same fields with everything drawn anew.

    Attributes:
        schemes: names, the last lets each field use its own parameters.
        plan, height: (N, schemes, fields) RMS at check points, metres.
    """

    schemes: tuple[str, ...]
    plan: np.ndarray
    height: np.ndarray

    def met(self, plan: float, height: float) -> np.ndarray:
        """(schemes,) share of the campaigns in which every field is within limits, metres."""
        good = np.all((self.plan <= plan) & (self.height <= height), axis=2)
        return np.asarray(good.mean(axis=0))


def values_of(errors: Mapping[str, CheckErrors], what: str) -> np.ndarray:
    """(fields,) RMS of one sort of `RMS`, metres."""
    return np.array([getattr(e, what) for e in errors.values()])


def schemes_tested(campaign: Campaign, alone: Mapping[str, Adjustment]) -> FrozenMap[str, FrozenMap[str, CheckErrors]]:
    """Scheme -> field -> errors at its check points.

    Args:
        campaign: schemes and check points.
        alone: field -> it calibrated by itself.
    """
    found = {}
    for k, names in enumerate(campaign.spec.schemes):
        cameras, bias = averaged(campaign, [alone[name] for name in names], names)
        found[str(k + 1)] = FrozenMap({p.name: tested(campaign, p, cameras, bias) for p in campaign.passes})
    own = {p.name: tested(campaign, p, *averaged(campaign, [alone[p.name]], [p.name])) for p in campaign.passes}
    found[str(len(campaign.spec.schemes) + 1)] = FrozenMap(own)
    return FrozenMap(found)


def tested_before(campaign: Campaign) -> FrozenMap[str, CheckErrors]:
    """Field -> errors with the laboratory's camera."""
    return FrozenMap({p.name: tested(campaign, p, campaign.laboratory, np.zeros(3)) for p in campaign.passes})


def tested(campaign: Campaign, one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
    """Errors at a field's check points."""
    return check_errors(intersect(one.check, cameras, campaign.noise, bias=bias).ground, one.check_ground)


def repeated(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance) -> Repeats | None:
    """Fly and calibrate as many campaigns as the file asks for; None for none. Only errors at check points count.

    Raises:
        CalibrationError: one of them cannot be solved.
    """
    count = setup.test.repeats
    test = setup.test
    if test.effects.corrected:
        # what a correction leaves, 0.004 px, is no part of the scatter; flying without effects takes half of the time
        none = test.effects.model_copy(update=dict.fromkeys(EFFECTS, False))
        setup = setup.model_copy(update={"test": test.model_copy(update={"effects": none})})
    plan, height = [], []
    names: tuple[str, ...] = ()
    for k, stream in enumerate(seed.spawn(count)):
        campaign = fly_fields(setup, stream).independent
        schemes = schemes_tested(campaign, {p.name: calibrated_alone(campaign, p) for p in campaign.passes})
        names = tuple(schemes)
        plan.append([values_of(e, "plan_rms") for e in schemes.values()])
        height.append([values_of(e, "height_rms") for e in schemes.values()])
        advance("campaigns", k + 1, count)
    return Repeats(names, np.array(plan), np.array(height)) if count else None


def averaged(
    campaign: Campaign, results: Sequence[Adjustment], names: Sequence[str]
) -> tuple[dict[str, LineModel], np.ndarray]:
    """Cameras and bias (3,): means of the parameters of these fields, each calibrated by itself."""
    cameras = {
        line: camera.with_interior(np.mean([r.cameras[line].interior for r in results], axis=0))
        for line, camera in campaign.laboratory.items()
    }
    return cameras, np.mean([r.bias(name) for name, r in zip(names, results, strict=True)], axis=0)


@dataclass(frozen=True)
class Repeatability:
    """One parameter over the fields, each calibrated by itself, metres or radians.

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


def repeatability(campaign: Campaign, alone: Mapping[str, Adjustment]) -> tuple[Repeatability, ...]:
    """Interior orientation, then biases; empty for fewer than two fields.

    Args:
        campaign: the fields.
        alone: field -> it calibrated by itself.
    """
    if len(alone) < 2:
        return ()
    found = []
    for name in (*campaign.inner, *BIAS):
        names = {field: f"{field} {name}" if name in BIAS else name for field in alone}
        value = np.array([one.value(names[field]) for field, one in alone.items()])
        sigma = np.array([one.sigma[names[field]] for field, one in alone.items()])
        scatter, claimed = float(value.std(ddof=1)), float(np.sqrt(np.mean(sigma**2)))
        chance = None
        if claimed > 0.0:
            weight = sigma**-2.0
            mean = float(np.sum(weight * value) / np.sum(weight))
            chance = float(chi2.sf(np.sum(weight * (value - mean) ** 2), len(value) - 1))
        found.append(Repeatability(name, scatter, claimed, chance))
    return tuple(found)
