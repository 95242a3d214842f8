"""What an on-board monitor of the cameras buys where they change from field to field (papers 001 and 003): campaigns
with the same draws and a drift of several sizes, adjusted as if nothing drifted and with the monitor's readings.

Effects on the light that are corrected are left out of these campaigns, and the noise of attitude and orbit counts as
independent: both take most of the time and change the errors at check points hardly at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment, adjust
from analysis.orbit.calibration_parameters import Prior, Unknowns, monitor_priors
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from optics.numerics.number_tree import FrozenMap
from twin.framework.procedure import Advance
from twin.framework.random_streams import stream
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import calibrated_alone, gauge_of, simultaneous
from twin.orbit.calibration.flown_campaign import fly_fields, reading_sigma
from twin.orbit.calibration.observations import EFFECTS
from twin.orbit.calibration.schemes import FieldErrors, averaged, schemes_tested, tested

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import CalibrationSetup

FACTORS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Sizes of the drift against the file's."""


@dataclass(frozen=True, eq=False)
class Treatment:
    """One campaign in one treatment.

    Attributes:
        together: all fields adjusted at once, each field with its own bias.
        p_value: of that adjustment.
        schemes: scheme -> all fields without ground control; the last lets each field use its own parameters.
    """

    together: FieldErrors
    p_value: float
    schemes: Mapping[str, FieldErrors]


@dataclass(frozen=True, eq=False)
class DriftSize:
    """A drift of one size.

    Attributes:
        factor: against the file's.
        without: adjusted as if nothing drifted.
        monitored: with the monitor's readings; None without a monitor.
    """

    factor: float
    without: Treatment
    monitored: Treatment | None


@dataclass(frozen=True, eq=False)
class Monitoring:
    """Drift and monitor.

    Attributes:
        sizes: of `FACTORS`.
        angle: root mean square over the lines that drift of the file's sigma of d_alpha, radians.
        metres: by which heights change for 1 arcsec of d_alpha of the forward line, mean of the first field.
    """

    sizes: tuple[DriftSize, ...]
    angle: float
    metres: float

    def at(self, factor: float) -> DriftSize:
        """One size."""
        return next(s for s in self.sizes if s.factor == factor)


def monitored(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance) -> Monitoring | None:
    """Fly the same campaign with drifts of several sizes; None for a file without drift.

    Args:
        setup: test and camera.
        seed: of the campaign. It is left as it is.
        advance: how far it is.

    Raises:
        CalibrationError: a campaign cannot be adjusted.
        BenchError: it cannot be flown.
    """
    if not setup.test.drift:
        return None
    sizes = []
    metres = 0.0
    for k, factor in enumerate(FACTORS):
        campaign = flown(setup, factor, seed)
        treatment = with_monitor(campaign) if setup.test.monitor is not None else None
        sizes.append(DriftSize(factor, without_monitor(campaign), treatment))
        if factor == 0.0:
            metres = height_per_arcsec(campaign)
        advance("drift", k + 1, len(FACTORS))
    angles = [one.angles[0] for one in setup.test.drift.values() if any(one.angles) or one.principal_distance]
    return Monitoring(tuple(sizes), float(np.sqrt(np.mean(np.square(angles or [0.0])))), metres)


def flown(setup: CalibrationSetup, factor: float, seed: np.random.SeedSequence) -> Campaign:
    """The campaign with the file's drift times a factor and no effects on the light that would be taken out again.

    All else is drawn as without the drift. The seed is left as it is.
    """
    test = setup.test
    drift = {
        name: one.model_copy(
            update={
                "angles": tuple(factor * v for v in one.angles),
                "principal_distance": factor * one.principal_distance,
            }
        )
        for name, one in test.drift.items()
    }
    update: dict[str, object] = {"drift": FrozenMap(drift), "strip": None}
    if test.effects.corrected:
        update["effects"] = test.effects.model_copy(update=dict.fromkeys(EFFECTS, False))
    return fly_fields(setup.model_copy(update={"test": test.model_copy(update=update)}), stream(seed)).independent


def without_monitor(campaign: Campaign) -> Treatment:
    """Adjust a campaign as if no camera drifted."""
    found = simultaneous(campaign)
    errors = [tested(campaign, p, found.cameras, found.bias(p.name)) for p in campaign.passes]
    schemes = schemes_tested(campaign, {p.name: calibrated_alone(campaign, p) for p in campaign.passes})
    pooled = FrozenMap({name: FieldErrors.pooled(fields.values()) for name, fields in schemes.items()})
    return Treatment(FieldErrors.pooled(errors), found.p_value, pooled)


def with_monitor(campaign: Campaign) -> Treatment:
    """Adjust a campaign with the monitor's readings, which are observations where a field is calibrated and correct the
    cameras where it is tested.
    """
    found = adjust_with_readings(campaign)
    errors = [tested(campaign, p, found.cameras_of(p.name), found.bias(p.name)) for p in campaign.passes]
    alone = {p.name: adjust_field_with_readings(campaign, p) for p in campaign.passes}
    schemes = {}
    for k, names in enumerate(campaign.spec.schemes):
        schemes[str(k + 1)] = FieldErrors.pooled(_scheme(campaign, alone, names, p) for p in campaign.passes)
    own = (_scheme(campaign, alone, (p.name,), p) for p in campaign.passes)
    schemes[str(len(campaign.spec.schemes) + 1)] = FieldErrors.pooled(own)
    return Treatment(FieldErrors.pooled(errors), found.p_value, FrozenMap(schemes))


def adjust_with_readings(campaign: Campaign) -> Adjustment:
    """All fields at once, with the drift of every camera in every field as unknowns that the readings tell."""
    return simultaneous(
        campaign, drift=True, monitor=tuple(p for one in campaign.passes for p in _reading_priors(campaign, one))
    )


def adjust_field_with_readings(campaign: Campaign, one: FieldPass) -> Adjustment:
    """A field by itself with its readings; the interior orientation is that of the cameras without their drift."""
    return adjust(
        [one.control],
        campaign.laboratory,
        campaign.noise,
        unknowns=Unknowns(drift=True),
        priors=_reading_priors(campaign, one),
        gauge=gauge_of(campaign),
    )


def height_per_arcsec(campaign: Campaign) -> float:
    """Mean change of the first field's heights for 1 arcsec of d_alpha of the forward line that the cameras do not
    have, metres.
    """
    one, cameras = campaign.passes[0], dict(campaign.truth)
    ground = [
        intersect(one.check, {**cameras, "forward": turned}, campaign.noise, bias=one.bias).ground
        for turned in (cameras["forward"], cameras["forward"].drifted(np.array([ARCSEC, 0.0, 0.0, 0.0])))
    ]
    return float(np.nanmean(check_errors(ground[1], ground[0]).error[:, 2]))


def _reading_priors(campaign: Campaign, one: FieldPass) -> list[Prior]:
    sigma = reading_sigma(campaign.simulated)
    return [p for line, told in one.readings.items() for p in monitor_priors(one.name, line, told, sigma)]


def _scheme(campaign: Campaign, alone: Mapping[str, Adjustment], names: tuple[str, ...], one: FieldPass) -> CheckErrors:
    """Errors of a field by the mean parameters of these fields, drifted by the field's own readings."""
    cameras, bias = averaged(campaign, [alone[name] for name in names], names)
    own = {line: camera.drifted(one.readings[line]) for line, camera in cameras.items()}
    return tested(campaign, one, own, bias)
