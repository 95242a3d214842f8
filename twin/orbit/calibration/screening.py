"""What measured points say of themselves: robust weights of the adjustment, whether the rays of check points meet, how
large a pixel is on the ground.

What the adjustment leaves out is taken from the measurements for good, and the sigmas of matching grow where the
residuals of the rest ask for it. Nothing here uses the truth but the counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import siegelslopes

from analysis import statistics
from analysis.block.reweighting import REJECT
from analysis.calibration.adjustment import Adjustment, FarPointsError
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import Rays, misclosure
from analysis.statistics import robust_variance
from optics.numerics.number_tree import FrozenMap
from twin.orbit.calibration.campaign import Campaign, FieldImages, FieldPass, Rejected, Screening
from twin.orbit.calibration.campaign_adjustment import simultaneous
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.measured.pass_measurements import ImagePoints, listed

_ROUNDS = 3
_SETTLED = 1.05
"""A factor on the sigmas of all lines together that is as small is not applied, and none below 1: what the three lines'
matches with one template have in common does not show in residuals, because it moves the adjusted point."""
_OWN_SIGMAS = 4.0
"""By which the variance of a line of a pass must stand out to have a factor of its own, 3e-5 by chance. A variance by
the median of n good points is uncertain by 1.44 / sqrt(n) of itself (1 / ln 2 of its root mean square)."""
_MEDIAN_SPREAD = 1.0 / np.log(2.0)
_FALSE_ALARM = 1e-4
"""False-alarm rate of check points, the same as for image points in the adjustment."""


_FAR_SCATTERS, _FAR_SIGMAS = 10.0, 20.0
"""Scatters of a line's image points about their common misclosure, and sigmas of an image point, beyond which a point
is not that of its name. The nearest of 100 points in a strip of 60 km lies 1000 sigmas away in the median."""
_LEAST_OF_LINE = 8
"""Control points in a line by which the others are judged."""
_SLOPE_POINTS = 500
_Kept = dict[str, dict[str, np.ndarray]]


def mislabelled(campaign: Campaign, one: FieldPass) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return which image points of a pass show another place than the ground point of their name.

    The camera's and the platform's errors move the image points of a line alike, turned and scaled a little: a straight
    line in the pixel through the medians of misclosures, which half of the points may miss.

    Returns
    -------
    tuple[dict[str, np.ndarray], np.ndarray]
        Line -> mask of its image points (n,), of control points alone; mask of the check points (m,) that some line
        shows elsewhere.
    """
    wrong, wrong_check, still = {}, np.zeros(len(one.check_ground), bool), np.zeros(3)
    for name, rays in one.control.rays.items():
        control = one.is_control[rays.point]
        wrong[name] = np.zeros(len(control), bool)
        if control.sum() < _LEAST_OF_LINE:
            continue
        known, model = rays.taken(control), campaign.laboratory[name]
        miss = misclosure(model, known, one.control.ground[known.point], still, still)
        some = np.unique(np.linspace(0, len(miss) - 1, min(_SLOPE_POINTS, len(miss))).round().astype(int))
        fits = [siegelslopes(miss[some, k], known.image[some, 1]) for k in (0, 1)]

        def size(rays: Rays, miss: np.ndarray, fits: list[Any] = fits) -> np.ndarray:
            return np.hypot(*(miss[:, k] - fits[k][1] - fits[k][0] * rays.image[:, 1] for k in (0, 1)))

        scatter = np.sqrt(robust_variance(size(known, miss) ** 2))
        limit = max(_FAR_SCATTERS * scatter, _FAR_SIGMAS * campaign.noise.image)
        wrong[name][control] = size(known, miss) > limit
        if name in one.check:
            check = one.check[name]
            away = misclosure(model, check, one.check_ground[check.point], still, still)
            wrong_check[check.point[size(check, away) > limit]] = True
    return wrong, wrong_check


def require_labelled(campaign: Campaign) -> None:
    """Refuse a campaign whose image points show other places than the ground points of their names.

    Raises
    ------
    FarPointsError
        Some do; with their names.
    """
    for name, gone in _relabelled(campaign)[1].items():
        if gone.points:
            shown = listed([f"{point} in {line}" for point, line in gone.points])
            raise FarPointsError(f"calibration: image points of {name} lie elsewhere than those around: {shown}")


def _relabelled(campaign: Campaign) -> tuple[Campaign, dict[str, Rejected]]:
    """The campaign without mislabelled points, and field -> these."""
    passes, gross = [], {}
    for one in campaign.passes:
        wrong, wrong_check = mislabelled(campaign, one)
        kept = {name: ~mask for name, mask in wrong.items()}
        gross[one.name] = _rejected(one, kept, ~wrong_check, {})
        passes.append(_reduced(one, kept, np.ones(len(one.control_ground), bool), ~wrong_check))
    if not any(one.points or one.check_points for one in gross.values()):
        return campaign, gross
    return _with_light(campaign, tuple(passes)), gross


def _with_light(campaign: Campaign, passes: tuple[FieldPass, ...]) -> Campaign:
    """The campaign with other image points, of which effects on the light are taken out as before."""
    removed = campaign.effects if campaign.spec.effects.corrected else NO_EFFECTS
    return replace(campaign, passes=passes).without_effects(removed)


def screened(campaign: Campaign) -> Campaign:
    """The campaign without what is mislabelled or the adjustment rejects, with sigmas of the image points that fit the
    residuals.

    Raises
    ------
    CalibrationError
        It cannot be adjusted.
    """
    gross: dict[str, Rejected] = {}
    if campaign.images is None:  # names of points that were matched here are right
        campaign, gross = _relabelled(campaign)
    found, kept = _robust(campaign)
    total: dict[tuple[str, str], float] = {(p.name, line): 1.0 for p in campaign.passes for line in p.control_images}
    for _ in range(_ROUNDS):
        factors = _factors(found, kept)
        if not factors:
            break
        for key, factor in factors.items():
            total[key] *= factor
        campaign = _rescaled(campaign, factors)
        found, kept = _robust(campaign)
    passes, rejected, judged = [], {}, []
    for k, one in enumerate(campaign.passes):
        less, keep_check = _without(campaign, one, kept[one.name], found)
        passes.append(less)
        own = FrozenMap({line: total[one.name, line] for line in one.control_images})
        rejected[one.name] = _rejected(one, kept[one.name], keep_check, own)
        if campaign.images is None:
            rejected[one.name] = rejected[one.name].after(gross[one.name])
        else:
            shown = campaign.images[k]
            judged.append(replace(shown, screening=_counted(one, shown, kept[one.name], keep_check)))
    images = None if campaign.images is None else tuple(judged)
    return _with_light(replace(campaign, images=images, rejected=FrozenMap(rejected)), tuple(passes))


def _robust(campaign: Campaign) -> tuple[Adjustment, _Kept]:
    """The adjustment with robust weights, and field -> line -> which image points it keeps."""
    found = simultaneous(campaign, robust="igg")
    kept: _Kept = {}
    for name, lines in found.residual.items():
        kept[name] = {}
        for line, residual in lines.items():
            far = np.linalg.norm(residual, axis=1) > REJECT
            kept[name][line] = (found.weight[name][line] > 0.0) & ~far
    return found, kept


def _factors(found: Adjustment, kept: _Kept) -> dict[tuple[str, str], float]:
    """(field, line) -> factor on the sigmas of its image points, by the median of the standardised residuals that are
    kept: its own where a line stands out from the sigmas and from all others, else that of all these together. Empty
    where none is needed.
    """
    squares = {
        (name, line): np.sum(residual**2, axis=1)[kept[name][line]]
        for name, lines in found.residual.items()
        for line, residual in lines.items()
    }
    own: dict[tuple[str, str], float] = {}
    while len(own) < len(squares):
        # the worst first: its residuals are no measure of the others
        rest = {key: robust_variance(row) for key, row in squares.items() if key not in own and len(row)}
        if not rest:
            break
        common = max(robust_variance(np.concatenate([squares[key] for key in rest])), 1.0)
        beyond = {k: (v / common - 1.0) * np.sqrt(len(squares[k])) / _MEDIAN_SPREAD for k, v in rest.items()}
        worst = max(beyond, key=lambda k: beyond[k])
        if beyond[worst] <= _OWN_SIGMAS:
            factor = float(np.sqrt(robust_variance(np.concatenate([squares[key] for key in rest]))))
            return own | (dict.fromkeys(rest, factor) if factor > _SETTLED else {})
        own[worst] = float(np.sqrt(rest[worst]))
    return own


def _rescaled(campaign: Campaign, factors: Mapping[tuple[str, str], float]) -> Campaign:
    """The campaign with sigmas of image points times the factor of their pass and line."""

    def grown(one: FieldPass, images: Mapping[str, ImagePoints]) -> FrozenMap[str, ImagePoints]:
        return FrozenMap(
            {
                line: replace(row, covariance=row.covariance * factors.get((one.name, line), 1.0) ** 2)
                for line, row in images.items()
            }
        )

    passes = tuple(
        replace(
            p,
            control_images=grown(p, p.control_images),
            check_images=grown(p, p.check_images),
            tie_images=grown(p, p.tie_images),
        )
        for p in campaign.passes
    )
    return _with_light(campaign, passes)


def _without(
    campaign: Campaign, one: FieldPass, kept: dict[str, np.ndarray], found: Adjustment
) -> tuple[FieldPass, np.ndarray]:
    """A pass without rejected image points, ties that are left to one line, check points whose rays do not meet."""
    count = len(one.control_ground)
    seen = np.zeros(count, int)
    for name, row in one.control_images.items():
        np.add.at(seen, row.point[kept[name]], 1)
    stays = np.where(one.is_control, seen > 0, seen > 1)
    keep = np.ones(len(one.check_ground), bool)
    if one.check:
        meeting = intersect(one.check, found.cameras_of(one.name), campaign.noise, bias=found.bias(one.name))
        # three rays are six conditions of three coordinates
        keep = meeting.chi_square <= statistics.limit_of(_FALSE_ALARM, 2 * meeting.rays - 3)
    return _reduced(one, kept, stays, keep), keep


def _reduced(one: FieldPass, kept: dict[str, np.ndarray], stays: np.ndarray, keep: np.ndarray) -> FieldPass:
    """A pass with some image points (line -> mask), some ground points (n,) and some check points (m,) alone."""
    images = {
        name: _renumbered(row.taken(kept[name] & stays[row.point]), stays) for name, row in one.control_images.items()
    }
    check = {name: _renumbered(row.taken(keep[row.point]), keep) for name, row in one.check_images.items()}
    return replace(
        one,
        control_images=FrozenMap(images),
        control_ground=one.control_ground[stays],
        control_covariance=one.control_covariance[stays],
        is_control=one.is_control[stays],
        control_ids=one.control_ids[stays],
        check_images=FrozenMap(check),
        check_ground=one.check_ground[keep],
        check_ids=one.check_ids[keep],
    )


def _renumbered(row: ImagePoints, stays: np.ndarray) -> ImagePoints:
    """Image points of ground points that stay (n,), which are counted anew."""
    return replace(row, point=(np.cumsum(stays) - 1)[row.point])


def _rejected(one: FieldPass, kept: dict[str, np.ndarray], check: np.ndarray, factors: Mapping[str, float]) -> Rejected:
    """Names of what was left out."""
    points = [
        (str(one.control_ids[point]), name)
        for name, row in one.control_images.items()
        for point in row.point[~kept[name]].tolist()
    ]
    entered = sum(len(row.point) for row in one.control_images.values())
    gone = tuple(str(name) for name in one.check_ids[~check])
    return Rejected(entered, entered - len(points), tuple(points), len(check), int(check.sum()), gone, factors)


def _counted(one: FieldPass, shown: FieldImages, kept: dict[str, np.ndarray], check: np.ndarray) -> Screening:
    entered = left = wrong_entered = wrong_left = right_lost = 0
    for name, row in one.control_images.items():
        wrong, stays = shown.wrong[name][row.point], kept[name]
        entered, left = entered + len(wrong), left + int(stays.sum())
        wrong_entered, wrong_left = wrong_entered + int(wrong.sum()), wrong_left + int((wrong & stays).sum())
        right_lost += int((~wrong & ~stays).sum())
    bad = np.any(list(shown.wrong_check.values()), axis=0)
    return Screening(
        entered, left, wrong_entered, wrong_left, right_lost, len(check), int(check.sum()), int((bad & check).sum())
    )


@dataclass(frozen=True)
class Meeting:
    """How well the rays of check points meet, by the sigmas of image points and readings.

    Attributes
    ----------
    chi_square : float
        Of all of them.
    degrees_of_freedom : int
        Two for each ray less three for each point.
    """

    chi_square: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one. Points exposed within a few readings err alike, and the
        calibration's own errors are in it.
        """
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)


def meeting_of(campaign: Campaign, one: FieldPass, adjustment: Adjustment) -> Meeting:
    """Intersect a pass's check points by the cameras and the bias of an adjustment.

    Raises
    ------
    CalibrationError
        They cannot be intersected.
    """
    found = intersect(one.check, adjustment.cameras_of(one.name), campaign.noise, bias=adjustment.bias(one.name))
    seen = found.rays > 1
    return Meeting(float(np.sum(found.chi_square[seen])), int(np.sum(2 * found.rays[seen] - 3)))


def ground_sample(one: FieldPass, line: str) -> tuple[float, float]:
    """Ground sample distance of the middle of a line's image along and across the track, metres."""
    sensor = one.data.sensors[line]
    row = one.control_images.get(line)
    middle = 0.5 * (sensor.lines - 1) if row is None or not len(row.line) else float(np.mean(row.line))
    pixel = 0.5 * (sensor.camera.pixels - 1)
    step = 0.5 if 0.0 <= middle - 0.5 and middle + 0.5 <= sensor.lines - 1 else 0.25
    places = np.array([[middle - step, pixel], [middle + step, pixel], [middle, pixel - step], [middle, pixel + step]])
    ground = sensor.ground(places[:, 0], places[:, 1], one.data.height)
    along, across = (float(np.linalg.norm(ground[k + 1] - ground[k])) / (2.0 * step) for k in (0, 2))
    return along, across
