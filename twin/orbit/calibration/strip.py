"""Passes adjusted on tie points before their check points are intersected (paper 003: calibrate with control points,
adjust, intersect check points), by every scheme of parameters.

Slow errors of the attitude over a field's control points go into its interior orientation and bias. To adjust the
attitude afterwards, with these as if they were exact, counts that part twice and makes errors larger. So the
calibration whose parameters are used has the tie points of its pass in it, and tells both apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from analysis.calibration.adjustment import Adjustment, adjust
from analysis.calibration.strip_adjustment import Datum, StripAdjustment, adjust_strip
from analysis.orbit.calibration_parameters import CalibrationField
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from analysis.orbit.three_line_model import LineModel, Rays
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from twin.framework.procedure import Advance
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import gauge_of
from twin.orbit.calibration.schemes import averaged


@dataclass(frozen=True, eq=False)
class Strips:
    """Passes adjusted on their tie points.

    Attributes:
        ties: field -> how many tie points two lines or more see.
        schemes: scheme -> field -> errors at its check points, calibrated on control and tie points and adjusted on tie
            points; the last lets each field use its own parameters.
        p_values: field -> chance of the fit of its strip with its own parameters.
        datum: of the first field with these: turns of the whole pass, sigma before and after.
    """

    ties: Mapping[str, int]
    schemes: Mapping[str, Mapping[str, CheckErrors]]
    p_values: Mapping[str, float]
    datum: tuple[Datum, ...]


def strips_adjusted(campaign: Campaign, advance: Advance) -> Strips | None:
    """Every field by every scheme; None for a file without a strip.

    Args:
        campaign: measurements and schemes.
        advance: how far it is.

    Raises:
        CalibrationError: a strip cannot be adjusted.
    """
    spec = campaign.spec
    if not spec.strip:
        return None
    fields = len(campaign.passes)
    parts = (len(spec.schemes) + 2) * fields
    calibrated = {}
    with one_blas_thread():
        for k, one in enumerate(campaign.passes):
            calibrated[one.name] = calibrated_with_ties(campaign, one)
            advance("strips", k + 1, parts)
        schemes, own = _by_scheme(campaign, calibrated, lambda done: advance("strips", fields + done, parts))
    return Strips(
        FrozenMap({name: int(np.isfinite(s.ground[:, 0]).sum()) for name, s in own.items()}),
        schemes,
        FrozenMap({name: s.p_value for name, s in own.items()}),
        own[campaign.passes[0].name].datum,
    )


def calibrated_with_ties(campaign: Campaign, one: FieldPass) -> Adjustment:
    """A field by itself, with the tie points of its pass.

    Raises:
        CalibrationError: it cannot be solved.
    """
    return adjust([field_with_ties(campaign, one)], campaign.laboratory, campaign.noise, gauge=gauge_of(campaign))


def field_with_ties(campaign: Campaign, one: FieldPass) -> CalibrationField:
    """Control and tie points of a pass; of points measured in images the field has both already."""
    if not one.ties:
        return one.control
    return with_points(one.control, one.ties, intersect(one.ties, campaign.laboratory, campaign.noise).ground)


def with_points(field: CalibrationField, rays: Mapping[str, Rays], ground: np.ndarray) -> CalibrationField:
    """A field with more points (n, 3), ITRS, metres, without given coordinates; their rays are numbered from zero."""
    count, more = len(field.ground), len(ground)
    return replace(
        field,
        rays={line: _joined(row, rays[line], count) for line, row in field.rays.items()},
        ground=np.concatenate([field.ground, ground]),
        covariance=np.concatenate([field.covariance, np.zeros((more, 3, 3))]),
        control=np.concatenate([field.control, np.zeros(more, bool)]),
    )


def _tie_rays(one: FieldPass) -> Mapping[str, Rays]:
    """The strip's tie points; where points are measured in images, all those that the calibration uses."""
    return one.ties or one.control.rays


def adjusted_strip(
    campaign: Campaign, one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> StripAdjustment:
    """One pass on its tie points.

    Raises:
        CalibrationError: it cannot be adjusted.
    """
    return adjust_strip(_tie_rays(one), cameras, campaign.noise, bias=bias)


def tested_in_strip(
    campaign: Campaign, one: FieldPass, strip: StripAdjustment, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> CheckErrors:
    """Errors at a field's check points, intersected with the strip's attitude and orbit."""
    rays = {line: strip.corrected(row) for line, row in one.check.items()}
    return check_errors(intersect(rays, cameras, campaign.noise, bias=bias).ground, one.check_ground)


def _joined(control: Rays, ties: Rays, count: int) -> Rays:
    """Rays of both, with times; points of the second are numbered after the first's."""
    pairs = ((getattr(control, name), getattr(ties, name)) for name in ("image", "station", "attitude", "time"))
    return Rays.of(np.concatenate([control.point, ties.point + count]), *(np.concatenate(pair) for pair in pairs))


def _by_scheme(
    campaign: Campaign, calibrated: Mapping[str, Adjustment], advance: Callable[[int], None]
) -> tuple[FrozenMap[str, FrozenMap[str, CheckErrors]], dict[str, StripAdjustment]]:
    """Errors by scheme and field, and the strips with each field's own parameters."""
    found: dict[str, FrozenMap[str, CheckErrors]] = {}
    own: dict[str, StripAdjustment] = {}
    done = 0
    for k, scheme in enumerate((*campaign.spec.schemes, None)):
        errors = {}
        for one in campaign.passes:
            names = scheme or (one.name,)
            cameras, bias = averaged(campaign, [calibrated[name] for name in names], names)
            strip = adjusted_strip(campaign, one, cameras, bias)
            errors[one.name] = tested_in_strip(campaign, one, strip, cameras, bias)
            if scheme is None:
                own[one.name] = strip
            done += 1
            advance(done)
        found[str(k + 1)] = FrozenMap(errors)
    return FrozenMap(found), own
