"""Errors at check points without ground control, by scheme of averaged parameters, and their dependence on the method.

Schemes (paper 003, section 4.4): the parameters of several fields, each calibrated by itself, are averaged, and tested
by forward intersection of the check points of all fields. The gain of averaging depends on how well the parameters
repeat from field to field, which `repeatability` computes.

Strips: passes are adjusted on tie points before their check points are intersected. Slow errors of the attitude over a
field's control points go into its interior orientation and bias. Adjusting the attitude afterwards with these
parameters as if they were exact would count that part twice and increase the errors. The calibration whose parameters
are used therefore includes the tie points of its pass, which separates the two.

Monitoring: where the cameras change from field to field (papers 001 and 003), the campaign is adjusted as if nothing
drifted, and with the readings of an on-board monitor. Both adjustments treat the noise of attitude and orbit as
independent, which takes a tenth of the time and hardly changes the errors at check points.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.stats import chi2

from analysis.calibration.adjustment import Adjustment, adjust
from analysis.calibration.strip_adjustment import Datum, StripAdjustment, adjust_strip
from analysis.orbit.calibration_parameters import CalibrationField, Prior, Unknowns, monitor_priors
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from analysis.orbit.three_line_model import BIAS, LineModel, Rays
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from twin.framework.procedure import Advance
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import calibrated_alone, gauge_of, simultaneous
from twin.orbit.calibration.flown_campaign import reading_sigma

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import MapLimitsSpec

RMS = ("plan_rms", "height_rms")
"""Names of the attributes of `CheckErrors` and `FieldErrors` with the RMS errors in plan and in height."""


@dataclass(frozen=True)
class FieldErrors:
    """RMS errors at the check points of several fields, in metres.

    Attributes
    ----------
    plan_rms : float
        RMS error in plan, both axes together.
    height_rms : float
        RMS error in height.
    """

    plan_rms: float
    height_rms: float

    @classmethod
    def pooled(cls, errors: Iterable[CheckErrors]) -> FieldErrors:
        """Return the RMS errors over the check points of all fields together, each point with equal weight."""
        rows = list(errors)
        count = [e.count for e in rows]
        plan, height = (np.average(np.square([getattr(e, what) for e in rows]), weights=count) for what in RMS)
        return cls(float(np.sqrt(plan)), float(np.sqrt(height)))


def meets(errors: Mapping[str, CheckErrors], limits: MapLimitsSpec) -> bool:
    """Return True if the RMS errors of every field lie within the limits of a map."""
    return all(e.plan_rms <= limits.plan and e.height_rms <= limits.height for e in errors.values())


@dataclass(frozen=True, eq=False)
class SchemeMeans:
    """Means over the fields of each scheme's errors, the scheme with the fewest averaged fields first.

    Attributes
    ----------
    plan : ndarray
        Mean over the fields of the RMS error in plan of each scheme, in metres.
    plan_spread : ndarray
        Standard deviation over the fields of the RMS error in plan, in metres.
    height, height_spread : ndarray
        Mean and standard deviation of the RMS error in height, in metres.
    """

    plan: np.ndarray
    plan_spread: np.ndarray
    height: np.ndarray
    height_spread: np.ndarray

    @classmethod
    def of(cls, schemes: Mapping[str, Mapping[str, CheckErrors]]) -> SchemeMeans | None:
        """Return means and spreads of the schemes; None for a single scheme of averaged parameters.

        Parameters
        ----------
        schemes : Mapping[str, Mapping[str, CheckErrors]]
            All schemes; the last one, in which each field uses its own parameters, is not averaged and is excluded.
        """
        if len(schemes) < _LEAST_SCHEMES:
            return None
        plan, height = (np.array([values_of(e, what) for e in schemes.values()])[:-1] for what in RMS)
        return cls(plan.mean(axis=1), plan.std(axis=1), height.mean(axis=1), height.std(axis=1))

    @property
    def height_change(self) -> float:
        """Largest change of the mean height error between schemes, relative to the first scheme."""
        return float(np.ptp(self.height) / self.height[0])


_LEAST_SCHEMES = 3
"""Smallest number of schemes for a comparison: two with averaged parameters, and the one in which each field uses its
own.
"""


def values_of(errors: Mapping[str, CheckErrors], what: str) -> np.ndarray:
    """Return one kind of RMS error, an attribute of `RMS`, of every field, as an array in metres."""
    return np.array([getattr(e, what) for e in errors.values()])


T = TypeVar("T")


def evaluate_schemes(
    campaign: Campaign,
    alone: Mapping[str, Adjustment],
    test: Callable[[FieldPass, Mapping[str, LineModel], np.ndarray], T],
) -> FrozenMap[str, FrozenMap[str, T]]:
    """Evaluate every scheme on every field; return scheme -> field -> result.

    Parameters
    ----------
    campaign : Campaign
        Campaign with its schemes and fields.
    alone : Mapping[str, Adjustment]
        Calibration of each field by itself, by field.
    test : callable
        Function of a field's pass, the cameras and the attitude bias (3,). Cameras and bias are means over the scheme's
        fields; in the last scheme they are those of the tested field.
    """
    results = {}
    for k, scheme in enumerate((*campaign.spec.schemes, None)):
        errors = {}
        for flight in campaign.passes:
            names = scheme or (flight.name,)
            errors[flight.name] = test(flight, *mean_parameters(campaign, [alone[name] for name in names], names))
        results[str(k + 1)] = FrozenMap(errors)
    return FrozenMap(results)


def scheme_errors(campaign: Campaign, alone: Mapping[str, Adjustment]) -> FrozenMap[str, FrozenMap[str, CheckErrors]]:
    """Return the errors at the check points of every field with every scheme: scheme -> field -> errors.

    Parameters
    ----------
    campaign : Campaign
        Campaign with its schemes and fields.
    alone : Mapping[str, Adjustment]
        Calibration of each field by itself, by field.
    """
    return evaluate_schemes(campaign, alone, partial(check_point_errors, campaign))


def laboratory_errors(campaign: Campaign) -> FrozenMap[str, CheckErrors]:
    """Return the errors at the check points of each field with the laboratory's camera."""
    cameras, bias = campaign.laboratory, np.zeros(3)
    return FrozenMap({p.name: check_point_errors(campaign, p, cameras, bias) for p in campaign.passes})


def check_point_errors(
    campaign: Campaign, flight: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> CheckErrors:
    """Intersect a field's check points with the given cameras and attitude bias and return their errors.

    Parameters
    ----------
    campaign : Campaign
        Campaign whose noise weights the rays.
    flight : FieldPass
        Pass over the field.
    cameras : mapping of str to LineModel
        Line -> camera model.
    bias : (3,) ndarray
        Attitude bias (rotations about three axes), radians.
    """
    return check_errors(intersect(flight.check, cameras, campaign.noise, bias=bias).ground, flight.check_ground)


def mean_parameters(
    campaign: Campaign, results: Sequence[Adjustment], names: Sequence[str]
) -> tuple[dict[str, LineModel], np.ndarray]:
    """Return the mean cameras and mean bias (3,) of these fields, each calibrated by itself."""
    cameras = {
        line: camera.with_interior(np.mean([r.cameras[line].interior for r in results], axis=0))
        for line, camera in campaign.laboratory.items()
    }
    return cameras, np.mean([r.bias(name) for name, r in zip(names, results, strict=True)], axis=0)


@dataclass(frozen=True)
class Repeatability:
    """Scatter of one parameter over the fields, each calibrated by itself, in metres or radians.

    Attributes
    ----------
    name : str
        Name of the parameter, without a field.
    scatter : float
        Standard deviation over the fields.
    sigma : float
        Standard deviation that the adjustments of single fields predict, root mean square; 0 where the gauge holds it.
    p_value : float or None
        Probability of a scatter at least as large if the parameter is the same in all fields; None where the gauge
        holds it.
    """

    name: str
    scatter: float
    sigma: float
    p_value: float | None


def repeatability(campaign: Campaign, alone: Mapping[str, Adjustment]) -> tuple[Repeatability, ...]:
    """Return the repeatability of the interior orientation, then of the biases; empty for fewer than two fields.

    Parameters
    ----------
    campaign : Campaign
        Campaign with its fields.
    alone : Mapping[str, Adjustment]
        Calibration of each field by itself, by field.
    """
    if len(alone) < 2:
        return ()
    rows = []
    for name in (*campaign.inner, *BIAS):
        names = {field: f"{field} {name}" if name in BIAS else name for field in alone}
        value = np.array([adjustment.value(names[field]) for field, adjustment in alone.items()])
        sigma = np.array([adjustment.sigma[names[field]] for field, adjustment in alone.items()])
        scatter, claimed = float(value.std(ddof=1)), float(np.sqrt(np.mean(sigma**2)))
        p_value = None
        if claimed > 0.0:
            weight = sigma**-2.0
            mean = float(np.sum(weight * value) / np.sum(weight))
            p_value = float(chi2.sf(np.sum(weight * (value - mean) ** 2), len(value) - 1))
        rows.append(Repeatability(name, scatter, claimed, p_value))
    return tuple(rows)


@dataclass(frozen=True, eq=False)
class Strips:
    """Results of passes that are adjusted on their tie points.

    Attributes
    ----------
    ties : Mapping[str, int]
        Field -> number of tie points that at least two lines see.
    schemes : Mapping[str, Mapping[str, CheckErrors]]
        Scheme -> field -> errors at its check points, calibrated on control and tie points and adjusted on tie points;
        in the last scheme each field uses its own parameters.
    p_values : Mapping[str, float]
        Field -> p-value of the fit of its strip with its own parameters.
    datum : tuple of Datum
        Rotations of the whole first pass, with their sigmas before and after the adjustment.
    """

    ties: Mapping[str, int]
    schemes: Mapping[str, Mapping[str, CheckErrors]]
    p_values: Mapping[str, float]
    datum: tuple[Datum, ...]


def adjust_strips(campaign: Campaign, advance: Advance) -> Strips | None:
    """Adjust every field's strip with every scheme's parameters; return None for a file without a strip.

    Parameters
    ----------
    campaign : Campaign
        Campaign with measurements and schemes.
    advance : Advance
        Callback that reports the progress.

    Raises
    ------
    CalibrationError
        A strip cannot be adjusted.
    """
    spec = campaign.spec
    if not spec.strip:
        return None
    parts, done = (len(spec.schemes) + 2) * len(campaign.passes), itertools.count(1)
    calibrated, strips = {}, {}

    def in_strip(flight: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
        # strips of the last scheme, with each field's own parameters, replace the others
        strips[flight.name] = strip = adjust_pass_strip(campaign, flight, cameras, bias)
        advance("strips", next(done), parts)
        return strip_check_errors(campaign, flight, strip, cameras, bias)

    with one_blas_thread():
        for flight in campaign.passes:
            field, gauge = field_with_ties(campaign, flight), gauge_of(campaign)
            calibrated[flight.name] = adjust([field], campaign.laboratory, campaign.noise, gauge=gauge)
            advance("strips", next(done), parts)
        schemes = evaluate_schemes(campaign, calibrated, in_strip)
    return Strips(
        FrozenMap({name: int(np.isfinite(s.ground[:, 0]).sum()) for name, s in strips.items()}),
        schemes,
        FrozenMap({name: s.p_value for name, s in strips.items()}),
        strips[campaign.passes[0].name].datum,
    )


def field_with_ties(campaign: Campaign, flight: FieldPass) -> CalibrationField:
    """Return the control and tie points of a pass; points measured in images already contain both."""
    if not flight.ties:
        return flight.control
    return with_points(flight.control, flight.ties, intersect(flight.ties, campaign.laboratory, campaign.noise).ground)


def with_points(field: CalibrationField, rays: Mapping[str, Rays], ground: np.ndarray) -> CalibrationField:
    """Return a field with n further points (n, 3) without given coordinates, whose rays are numbered from zero."""
    more, joined = len(ground), {}
    for line, row in field.rays.items():
        names = ("image", "station", "attitude", "time")
        pairs = [(getattr(row, name), getattr(rays[line], name)) for name in names]
        point = np.concatenate([row.point, rays[line].point + len(field.ground)])
        joined[line] = Rays.of(point, *(np.concatenate(pair) for pair in pairs))
    return replace(
        field,
        rays=joined,
        ground=np.concatenate([field.ground, ground]),
        covariance=np.concatenate([field.covariance, np.zeros((more, 3, 3))]),
        control=np.concatenate([field.control, np.zeros(more, bool)]),
    )


def adjust_pass_strip(
    campaign: Campaign, flight: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> StripAdjustment:
    """Adjust one pass on its tie points; with points measured in images, on all those that the calibration uses.

    Raises
    ------
    CalibrationError
        The strip cannot be adjusted.
    """
    return adjust_strip(flight.ties or flight.control.rays, cameras, campaign.noise, bias=bias)


def strip_check_errors(
    campaign: Campaign, flight: FieldPass, strip: StripAdjustment, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> CheckErrors:
    """Return the errors at a field's check points, intersected with the strip's adjusted attitude and orbit."""
    rays = {line: strip.corrected(row) for line, row in flight.check.items()}
    return check_errors(intersect(rays, cameras, campaign.noise, bias=bias).ground, flight.check_ground)


@dataclass(frozen=True, eq=False)
class Treatment:
    """Errors of one campaign, adjusted with the monitor's readings or without.

    Attributes
    ----------
    together : FieldErrors
        Errors with all fields adjusted at once, each field with its own bias.
    p_value : float
        p-value of that adjustment.
    schemes : Mapping[str, FieldErrors]
        Scheme -> errors of all fields without ground control; in the last scheme each field uses its own parameters.
    """

    together: FieldErrors
    p_value: float
    schemes: Mapping[str, FieldErrors]


@dataclass(frozen=True, eq=False)
class Monitoring:
    """Comparison of calibrations of drifting cameras with and without the on-board monitor.

    Attributes
    ----------
    without : Treatment
        Errors of the adjustment that assumes no drift.
    monitored : Treatment
        Errors of the adjustment with the monitor's readings.
    """

    without: Treatment
    monitored: Treatment

    @classmethod
    def of(cls, campaign: Campaign) -> Monitoring | None:
        """Adjust a campaign without and with the monitor's readings; return None for a campaign without readings.

        Raises
        ------
        CalibrationError
            The campaign cannot be adjusted.
        """
        if not campaign.passes[0].readings:
            return None
        return cls(without_monitor(campaign.independent), with_monitor(campaign.independent))


def _treatment(
    campaign: Campaign, adjustment: Adjustment, schemes: Mapping[str, Mapping[str, CheckErrors]]
) -> Treatment:
    flown = ((p, adjustment.cameras_of(p.name), adjustment.bias(p.name)) for p in campaign.passes)
    errors = FieldErrors.pooled(check_point_errors(campaign, *part) for part in flown)
    pooled = {name: FieldErrors.pooled(fields.values()) for name, fields in schemes.items()}
    return Treatment(errors, adjustment.p_value, FrozenMap(pooled))


def without_monitor(campaign: Campaign) -> Treatment:
    """Adjust a campaign as if no camera drifted, and return the errors at its check points."""
    alone = {p.name: calibrated_alone(campaign, p) for p in campaign.passes}
    return _treatment(campaign, simultaneous(campaign), scheme_errors(campaign, alone))


def with_monitor(campaign: Campaign) -> Treatment:
    """Adjust a campaign with the monitor's readings, and return the errors at its check points.

    The readings enter the calibration of a field as observations, and correct the cameras when its check points are
    intersected.
    """

    def drifted(flight: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray) -> CheckErrors:
        corrected = {line: camera.drifted(flight.readings[line]) for line, camera in cameras.items()}
        return check_point_errors(campaign, flight, corrected, bias)

    alone = {p.name: adjust_field_with_readings(campaign, p) for p in campaign.passes}
    return _treatment(campaign, adjust_with_readings(campaign), evaluate_schemes(campaign, alone, drifted))


def adjust_with_readings(campaign: Campaign) -> Adjustment:
    """Adjust all fields at once, with each camera's drift in each field as unknowns that the monitor observes."""
    priors = tuple(p for flight in campaign.passes for p in _reading_priors(campaign, flight))
    return simultaneous(campaign, drift=True, monitor=priors)


def adjust_field_with_readings(campaign: Campaign, flight: FieldPass) -> Adjustment:
    """Adjust one field with the monitor's readings, for the interior orientation of the cameras without drift."""
    field, priors, gauge = [flight.control], _reading_priors(campaign, flight), gauge_of(campaign)
    drift = Unknowns(drift=True)
    return adjust(field, campaign.laboratory, campaign.noise, unknowns=drift, priors=priors, gauge=gauge)


def _reading_priors(campaign: Campaign, flight: FieldPass) -> list[Prior]:
    sigma = reading_sigma(campaign.simulated)
    return [p for line, reading in flight.readings.items() for p in monitor_priors(flight.name, line, reading, sigma)]
