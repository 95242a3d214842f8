"""Schemes of averaged parameters (paper 003, section 4.4), tested on all fields by forward intersection without ground
control: on one campaign, and on campaigns repeated with everything drawn anew. What averaging can gain depends on how
well the parameters repeat from field to field, which stands here, too.

Passes adjusted on tie points before their check points are intersected (paper 003: calibrate with control points,
adjust, intersect check points), by every scheme of parameters.

Slow errors of the attitude over a field's control points go into its interior orientation and bias. To adjust the
attitude afterwards, with these as if they were exact, counts that part twice and makes errors larger. So the
calibration whose parameters are used has the tie points of its pass in it, and tells both apart.

What an on-board monitor of the cameras buys where they change from field to field (papers 001 and 003): campaigns
with the same draws and a drift of several sizes, adjusted as if nothing drifted and with the monitor's readings.

Effects on the light that are corrected are left out of these campaigns, and the noise of attitude and orbit counts as
independent: both take most of the time and change the errors at check points hardly at all.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment, adjust
from analysis.calibration.strip_adjustment import Datum, StripAdjustment, adjust_strip
from analysis.orbit.calibration_parameters import CalibrationField, Prior, Unknowns, monitor_priors
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from analysis.orbit.three_line_model import BIAS, LineModel, Rays
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from twin.framework.procedure import Advance
from twin.framework.random_streams import stream
from twin.orbit.calibration.campaign import EFFECTS, Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import calibrated_alone, gauge_of, simultaneous
from twin.orbit.calibration.flown_campaign import fly_fields, reading_sigma

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

    Attributes
    ----------
    plan : np.ndarray
        Mean over the fields of the RMS in plan, metres, each scheme.
    plan_spread : np.ndarray
        Standard deviation over the fields.
    height, height_spread : np.ndarray
        likewise.
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

    Attributes
    ----------
    schemes : tuple[str, ...]
        Names, the last lets each field use its own parameters.
    plan, height : np.ndarray
        (N, schemes, fields) RMS at check points, metres.
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


T = TypeVar("T")


def by_scheme(
    campaign: Campaign,
    alone: Mapping[str, Adjustment],
    test: Callable[[FieldPass, Mapping[str, LineModel], np.ndarray], T],
) -> FrozenMap[str, FrozenMap[str, T]]:
    """Return what a test of the schemes gives, scheme -> field.

    Parameters
    ----------
    campaign : Campaign
        Schemes and fields.
    alone : Mapping[str, Adjustment]
        Field -> it calibrated by itself.
    test : Callable[[FieldPass, Mapping[str, LineModel], np.ndarray], T]
        Of a field by cameras and bias, which are means of the scheme's fields; by its own in the last scheme.
    """
    found = {}
    for k, scheme in enumerate((*campaign.spec.schemes, None)):
        errors = {}
        for one in campaign.passes:
            names = scheme or (one.name,)
            errors[one.name] = test(one, *averaged(campaign, [alone[name] for name in names], names))
        found[str(k + 1)] = FrozenMap(errors)
    return FrozenMap(found)


def schemes_tested(campaign: Campaign, alone: Mapping[str, Adjustment]) -> FrozenMap[str, FrozenMap[str, CheckErrors]]:
    """Scheme -> field -> errors at its check points; arguments as of `by_scheme`."""
    return by_scheme(campaign, alone, lambda one, cameras, bias: tested(campaign, one, cameras, bias))


def tested_before(campaign: Campaign) -> FrozenMap[str, CheckErrors]:
    """Field -> errors with the laboratory's camera."""
    return FrozenMap({p.name: tested(campaign, p, campaign.laboratory, np.zeros(3)) for p in campaign.passes})


def tested(campaign: Campaign, one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
    """Errors at a field's check points."""
    return check_errors(intersect(one.check, cameras, campaign.noise, bias=bias).ground, one.check_ground)


def repeated(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance) -> Repeats | None:
    """Fly and calibrate as many campaigns as the file asks for; None for none. Only errors at check points count.

    Raises
    ------
    CalibrationError
        One of them cannot be solved.
    """
    count = setup.test.repeats
    test = setup.test
    if test.effects.corrected:
        # what a correction leaves, 0.004 px, is no part of the scatter; flying without effects takes half of the time
        none = test.effects.model_copy(update=dict.fromkeys(EFFECTS, False))
        setup = setup.model_copy(update={"test": test.model_copy(update={"effects": none})})
    plan, height = [], []
    names: tuple[str, ...] = ()
    for k, own in enumerate(seed.spawn(count)):
        campaign = fly_fields(setup, own).independent
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

    Attributes
    ----------
    name : str
        Of the parameter, without a field.
    scatter : float
        Standard deviation over the fields.
    sigma : float
        That the adjustments claim, root mean square; 0 where held.
    p_value : float | None
        Chance of such a scatter or a larger one if the parameter is the same in all fields; None where held.
    """

    name: str
    scatter: float
    sigma: float
    p_value: float | None


def repeatability(campaign: Campaign, alone: Mapping[str, Adjustment]) -> tuple[Repeatability, ...]:
    """Interior orientation, then biases; empty for fewer than two fields.

    Parameters
    ----------
    campaign : Campaign
        The fields.
    alone : Mapping[str, Adjustment]
        Field -> it calibrated by itself.
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


@dataclass(frozen=True, eq=False)
class Strips:
    """Passes adjusted on their tie points.

    Attributes
    ----------
    ties : Mapping[str, int]
        Field -> how many tie points two lines or more see.
    schemes : Mapping[str, Mapping[str, CheckErrors]]
        Scheme -> field -> errors at its check points, calibrated on control and tie points and adjusted on tie points;
        the last lets each field use its own parameters.
    p_values : Mapping[str, float]
        Field -> chance of the fit of its strip with its own parameters.
    datum : tuple[Datum, ...]
        Of the first field with these: turns of the whole pass, sigma before and after.
    """

    ties: Mapping[str, int]
    schemes: Mapping[str, Mapping[str, CheckErrors]]
    p_values: Mapping[str, float]
    datum: tuple[Datum, ...]


def strips_adjusted(campaign: Campaign, advance: Advance) -> Strips | None:
    """Every field by every scheme; None for a file without a strip.

    Parameters
    ----------
    campaign : Campaign
        Measurements and schemes.
    advance : Advance
        How far it is.

    Raises
    ------
    CalibrationError
        a strip cannot be adjusted.
    """
    spec = campaign.spec
    if not spec.strip:
        return None
    parts, done = (len(spec.schemes) + 2) * len(campaign.passes), itertools.count(1)
    calibrated, strips = {}, {}

    def in_strip(one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
        # those of the last scheme, with each field's own parameters, stay
        strips[one.name] = strip = adjusted_strip(campaign, one, cameras, bias)
        advance("strips", next(done), parts)
        return tested_in_strip(campaign, one, strip, cameras, bias)

    with one_blas_thread():
        for one in campaign.passes:
            field, gauge = field_with_ties(campaign, one), gauge_of(campaign)
            calibrated[one.name] = adjust([field], campaign.laboratory, campaign.noise, gauge=gauge)
            advance("strips", next(done), parts)
        schemes = by_scheme(campaign, calibrated, in_strip)
    return Strips(
        FrozenMap({name: int(np.isfinite(s.ground[:, 0]).sum()) for name, s in strips.items()}),
        schemes,
        FrozenMap({name: s.p_value for name, s in strips.items()}),
        strips[campaign.passes[0].name].datum,
    )


def field_with_ties(campaign: Campaign, one: FieldPass) -> CalibrationField:
    """Control and tie points of a pass; of points measured in images the field has both already."""
    if not one.ties:
        return one.control
    return with_points(one.control, one.ties, intersect(one.ties, campaign.laboratory, campaign.noise).ground)


def with_points(field: CalibrationField, rays: Mapping[str, Rays], ground: np.ndarray) -> CalibrationField:
    """A field with more points (n, 3), ITRS, metres, without given coordinates; their rays are numbered from zero."""
    more, joined = len(ground), {}
    for line, row in field.rays.items():
        pairs = ((getattr(one, name) for one in (row, rays[line])) for name in ("image", "station", "attitude", "time"))
        point = np.concatenate([row.point, rays[line].point + len(field.ground)])
        joined[line] = Rays.of(point, *(np.concatenate(list(pair)) for pair in pairs))
    return replace(
        field,
        rays=joined,
        ground=np.concatenate([field.ground, ground]),
        covariance=np.concatenate([field.covariance, np.zeros((more, 3, 3))]),
        control=np.concatenate([field.control, np.zeros(more, bool)]),
    )


def adjusted_strip(
    campaign: Campaign, one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> StripAdjustment:
    """One pass on its tie points; where points are measured in images, on all those that the calibration uses.

    Raises
    ------
    CalibrationError
        It cannot be adjusted.
    """
    return adjust_strip(one.ties or one.control.rays, cameras, campaign.noise, bias=bias)


def tested_in_strip(
    campaign: Campaign, one: FieldPass, strip: StripAdjustment, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> CheckErrors:
    """Errors at a field's check points, intersected with the strip's attitude and orbit."""
    rays = {line: strip.corrected(row) for line, row in one.check.items()}
    return check_errors(intersect(rays, cameras, campaign.noise, bias=bias).ground, one.check_ground)


FACTORS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Sizes of the drift against the file's."""


@dataclass(frozen=True, eq=False)
class Treatment:
    """One campaign in one treatment.

    Attributes
    ----------
    together : FieldErrors
        All fields adjusted at once, each field with its own bias.
    p_value : float
        Of that adjustment.
    schemes : Mapping[str, FieldErrors]
        Scheme -> all fields without ground control; the last lets each field use its own parameters.
    """

    together: FieldErrors
    p_value: float
    schemes: Mapping[str, FieldErrors]


@dataclass(frozen=True, eq=False)
class DriftSize:
    """A drift of one size.

    Attributes
    ----------
    factor : float
        Against the file's.
    without : Treatment
        Adjusted as if nothing drifted.
    monitored : Treatment | None
        With the monitor's readings; None without a monitor.
    """

    factor: float
    without: Treatment
    monitored: Treatment | None


@dataclass(frozen=True, eq=False)
class Monitoring:
    """Drift and monitor.

    Attributes
    ----------
    sizes : tuple[DriftSize, ...]
        Of `FACTORS`.
    angle : float
        Root mean square over the lines that drift of the file's sigma of d_alpha, radians.
    metres : float
        By which heights change for 1 arcsec of d_alpha of the forward line, mean of the first field.
    """

    sizes: tuple[DriftSize, ...]
    angle: float
    metres: float

    def at(self, factor: float) -> DriftSize:
        """One size."""
        return next(s for s in self.sizes if s.factor == factor)


def monitored(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance) -> Monitoring | None:
    """Fly the same campaign with drifts of several sizes; None for a file without drift.

    Parameters
    ----------
    setup : CalibrationSetup
        Test and camera.
    seed : np.random.SeedSequence
        Of the campaign. It is left as it is.
    advance : Advance
        How far it is.

    Raises
    ------
    CalibrationError
        a campaign cannot be adjusted.
    BenchError
        It cannot be flown.
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


def _treatment(campaign: Campaign, found: Adjustment, schemes: Mapping[str, Mapping[str, CheckErrors]]) -> Treatment:
    errors = (tested(campaign, p, found.cameras_of(p.name), found.bias(p.name)) for p in campaign.passes)
    pooled = {name: FieldErrors.pooled(fields.values()) for name, fields in schemes.items()}
    return Treatment(FieldErrors.pooled(errors), found.p_value, FrozenMap(pooled))


def without_monitor(campaign: Campaign) -> Treatment:
    """Adjust a campaign as if no camera drifted."""
    alone = {p.name: calibrated_alone(campaign, p) for p in campaign.passes}
    return _treatment(campaign, simultaneous(campaign), schemes_tested(campaign, alone))


def with_monitor(campaign: Campaign) -> Treatment:
    """Adjust a campaign with the monitor's readings, which are observations where a field is calibrated and correct the
    cameras where it is tested.
    """

    def drifted(one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
        own = {line: camera.drifted(one.readings[line]) for line, camera in cameras.items()}
        return tested(campaign, one, own, bias)

    alone = {p.name: adjust_field_with_readings(campaign, p) for p in campaign.passes}
    return _treatment(campaign, adjust_with_readings(campaign), by_scheme(campaign, alone, drifted))


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
