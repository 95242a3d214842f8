"""Passes adjusted on tie points before their check points are intersected (paper 003: calibrate with control points,
adjust, intersect check points), by every scheme of parameters.

Slow errors of the attitude over a field's control points go into its interior orientation, where no later adjustment
finds them. So the calibration is also done with the tie points of its pass in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from analysis.orbit.adjustment import Adjustment, adjust
from analysis.orbit.calibration_parameters import CalibrationField
from analysis.orbit.forward_intersection import CheckErrors, check_errors, intersect
from analysis.orbit.strip_adjustment import Datum, StripAdjustment, adjust_strip
from analysis.orbit.three_line_model import LineModel, Rays
from optics.frozen_map import FrozenMap
from optics.threads import one_blas_thread
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.schemes import GAUGE, averaged
from twin.trial.result import Advance


@dataclass(frozen=True, eq=False)
class Strips:
    """Passes adjusted on their tie points.

    Attributes:
        ties: field -> how many tie points two lines or more see.
        schemes: scheme -> field -> errors at its check points, calibrated on control points; the last lets each field
            use its own parameters.
        tied: likewise, calibrated on control and tie points.
        p_values: field -> chance of the fit of its strip with its own parameters, from control and tie points.
        datum: of the first field with these: turns of the whole pass, sigma before and after.
    """

    ties: Mapping[str, int]
    schemes: Mapping[str, Mapping[str, CheckErrors]]
    tied: Mapping[str, Mapping[str, CheckErrors]]
    p_values: Mapping[str, float]
    datum: tuple[Datum, ...]


def strips_adjusted(campaign: Campaign, alone: Mapping[str, Adjustment], advance: Advance) -> Strips | None:
    """Every field by every scheme; None for a file without a strip.

    Args:
        campaign: measurements and schemes.
        alone: field -> it calibrated by itself.
        advance: how far it is.

    Raises:
        CalibrationError: a strip cannot be adjusted.
    """
    spec = campaign.spec
    if spec.strip is None:
        return None
    parts = 2 * (len(spec.schemes) + 1) * len(campaign.passes)
    with one_blas_thread():
        schemes, _ = _by_scheme(campaign, alone, lambda done: advance("strips", done, parts))
        with_ties = {p.name: calibrated_with_ties(campaign, p) for p in campaign.passes}
        tied, own = _by_scheme(campaign, with_ties, lambda done: advance("strips", parts // 2 + done, parts))
    return Strips(
        FrozenMap({name: int(np.isfinite(s.ground[:, 0]).sum()) for name, s in own.items()}),
        schemes,
        tied,
        FrozenMap({name: s.p_value for name, s in own.items()}),
        own[campaign.passes[0].name].datum,
    )


def calibrated_with_ties(campaign: Campaign, one: FieldPass) -> Adjustment:
    """A field by itself, with the tie points of its pass.

    Raises:
        CalibrationError: it cannot be solved.
    """
    return adjust([field_with_ties(campaign, one)], campaign.laboratory, campaign.noise, gauge=GAUGE)


def field_with_ties(campaign: Campaign, one: FieldPass) -> CalibrationField:
    """Control and tie points of a pass; of points measured in images the field has both already."""
    field = one.control
    if not one.ties:
        return field
    ground = intersect(one.ties, campaign.laboratory, campaign.noise).ground
    count, ties = len(field.ground), len(ground)
    rays = {line: _joined(row, one.ties[line], count) for line, row in field.rays.items()}
    return replace(
        field,
        rays=rays,
        ground=np.concatenate([field.ground, ground]),
        covariance=np.concatenate([field.covariance, np.zeros((ties, 3, 3))]),
        control=np.concatenate([field.control, np.zeros(ties, bool)]),
    )


def tie_rays(one: FieldPass) -> Mapping[str, Rays]:
    """The strip's tie points; where points are measured in images, all those that the calibration uses."""
    return one.ties or one.control.rays


def adjusted_strip(
    campaign: Campaign, one: FieldPass, cameras: Mapping[str, LineModel], bias: np.ndarray
) -> StripAdjustment:
    """One pass on its tie points.

    Raises:
        CalibrationError: it cannot be adjusted.
    """
    return adjust_strip(tie_rays(one), cameras, campaign.noise, bias=bias)


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
    campaign: Campaign, alone: Mapping[str, Adjustment], advance: Callable[[int], None]
) -> tuple[FrozenMap[str, FrozenMap[str, CheckErrors]], dict[str, StripAdjustment]]:
    """Errors by scheme and field, and the strips with each field's own parameters."""
    found: dict[str, FrozenMap[str, CheckErrors]] = {}
    own: dict[str, StripAdjustment] = {}
    done = 0
    for k, scheme in enumerate((*campaign.spec.schemes, None)):
        errors = {}
        for one in campaign.passes:
            names = scheme or (one.name,)
            cameras, bias = averaged(campaign, [alone[name] for name in names], names)
            strip = adjusted_strip(campaign, one, cameras, bias)
            errors[one.name] = tested_in_strip(campaign, one, strip, cameras, bias)
            if scheme is None:
                own[one.name] = strip
            done += 1
            advance(done)
        found[str(k + 1)] = FrozenMap(errors)
    return FrozenMap(found), own
