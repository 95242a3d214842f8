"""Numbers of errors at check points, by scheme of parameters, as calibration.json has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analysis.orbit.forward_intersection import CheckErrors
from twin.orbit.calibration.calibration_run import CalibrationRun
from twin.orbit.calibration.camera_drift import Monitoring, PooledErrors, Treatment
from twin.orbit.calibration.schemes import Repeats, SchemeMeans
from twin.orbit.calibration.strip import Strips

Array = NDArray[np.float64]


def meets(errors: Mapping[str, CheckErrors], plan: float, height: float) -> bool:
    """Whether every field's RMS errors lie within the limits, metres."""
    return all(e.plan_rms <= plan and e.height_rms <= height for e in errors.values())


def schemes_within(run: CalibrationRun) -> list[str]:
    """Names of the schemes that meet the limits of the test's file."""
    limits = run.setup.test.limits
    return [name for name, errors in run.schemes.items() if meets(errors, limits.plan, limits.height)]


@dataclass(frozen=True)
class ErrorNumbers:
    """RMS errors at check points: east and north together, and up."""

    plan_rms_m: float
    height_rms_m: float

    @classmethod
    def by_field(cls, errors: Mapping[str, CheckErrors]) -> dict[str, Self]:
        """Field -> numbers."""
        return {name: cls(e.plan_rms, e.height_rms) for name, e in errors.items()}

    @classmethod
    def pooled(cls, errors: PooledErrors) -> Self:
        """Of several fields."""
        return cls(errors.plan, errors.height)


@dataclass(frozen=True)
class MeanNumbers:
    """Errors over the fields by scheme."""

    plan_mean_m: Array
    plan_spread_m: Array
    height_mean_m: Array
    height_spread_m: Array

    @classmethod
    def of(cls, means: SchemeMeans) -> Self:
        """Of the schemes."""
        return cls(means.plan, means.plan_spread, means.height, means.height_spread)


@dataclass(frozen=True)
class RepeatedScheme:
    """A scheme over the campaigns: mean and spread of the fields' RMS errors."""

    plan_rms_m: Array
    plan_spread_m: Array
    height_rms_m: Array
    height_spread_m: Array
    share_within_limits: float


@dataclass(frozen=True)
class CampaignNumbers:
    """Campaigns repeated with everything drawn anew."""

    count: int
    schemes: Mapping[str, RepeatedScheme]

    @classmethod
    def of(cls, repeats: Repeats, plan: float, height: float) -> Self:
        """Of the repeats, with the limits in metres."""
        return cls(
            count=len(repeats.plan),
            schemes={
                scheme: RepeatedScheme(
                    repeats.plan[:, k].mean(axis=1),
                    repeats.plan[:, k].std(axis=1),
                    repeats.height[:, k].mean(axis=1),
                    repeats.height[:, k].std(axis=1),
                    float(met),
                )
                for k, (scheme, met) in enumerate(zip(repeats.schemes, repeats.met(plan, height), strict=True))
            },
        )


@dataclass(frozen=True)
class TreatmentNumbers:
    """Drifting cameras, with the monitor or without."""

    all_fields: ErrorNumbers
    p_value: float
    schemes: Mapping[str, ErrorNumbers]

    @classmethod
    def of(cls, one: Treatment) -> Self:
        """Of one treatment."""
        schemes = {scheme: ErrorNumbers.pooled(errors) for scheme, errors in one.schemes.items()}
        return cls(ErrorNumbers.pooled(one.together), one.p_value, schemes)


@dataclass(frozen=True)
class DriftNumbers:
    """One size of the cameras' drift."""

    factor: float
    d_alpha_sigma_rad: float
    without_monitor: TreatmentNumbers
    with_monitor: TreatmentNumbers | None


@dataclass(frozen=True)
class MonitoringNumbers:
    """Errors by size of the drift, with and without the monitor."""

    d_alpha_sigma_rad: float
    height_for_1_arcsec_m: float
    noise_counts_as: str
    sizes: tuple[DriftNumbers, ...]

    @classmethod
    def of(cls, found: Monitoring) -> Self:
        """Of all sizes."""
        sizes = tuple(
            DriftNumbers(
                size.factor,
                size.factor * found.angle,
                TreatmentNumbers.of(size.without),
                None if size.monitored is None else TreatmentNumbers.of(size.monitored),
            )
            for size in found.sizes
        )
        return cls(found.angle, found.metres, "independent", sizes)


@dataclass(frozen=True)
class TieNumbers:
    """A scheme without tie points and with them."""

    without_ties: ErrorNumbers
    with_ties: ErrorNumbers


@dataclass(frozen=True)
class TiedSigma:
    """How well a part of the datum is known before and after the adjustment of the strip."""

    sigma_before: float
    sigma_after: float
    unit: str


@dataclass(frozen=True)
class StripNumbers:
    """Passes adjusted on tie points."""

    ties: Mapping[str, int]
    p_value: Mapping[str, float]
    schemes: Mapping[str, TieNumbers]
    datum: Mapping[str, TiedSigma]

    @classmethod
    def of(cls, found: Strips, before: Mapping[str, Mapping[str, CheckErrors]]) -> Self:
        """Of the strips; before: scheme -> field -> errors without ties."""
        return cls(
            ties=found.ties,
            p_value=found.p_values,
            schemes={
                scheme: TieNumbers(
                    ErrorNumbers.pooled(PooledErrors.of(before[scheme].values())),
                    ErrorNumbers.pooled(PooledErrors.of(fields.values())),
                )
                for scheme, fields in found.schemes.items()
            },
            datum={d.name: TiedSigma(d.before, d.after, "rad/s" if "rate" in d.name else "rad") for d in found.datum},
        )


@dataclass(frozen=True)
class VerdictNumbers:
    """Which schemes stay within the limits in every field."""

    scale: str
    plan_limit_m: float
    height_limit_m: float
    source: str
    before: bool
    schemes: Mapping[str, bool]

    @classmethod
    def of(cls, run: CalibrationRun) -> Self:
        """Of a run."""
        limits = run.campaign.spec.limits
        return cls(
            scale="1:50000",
            plan_limit_m=limits.plan,
            height_limit_m=limits.height,
            source="of the file",
            before=meets(run.before, limits.plan, limits.height),
            schemes={k: meets(errors, limits.plan, limits.height) for k, errors in run.schemes.items()},
        )
