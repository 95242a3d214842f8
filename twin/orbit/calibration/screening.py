"""Screening of measured points (robust weights, wrong names, intersections of check points), and ground sampling.

Points that the adjustment rejects are removed from the measurements, and the sigmas of image points are enlarged
where the residuals of the remaining points require it. The truth is used for the counts alone.
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
"""Largest number of rounds in which the adjustment is repeated with rescaled sigmas of image points."""
_SETTLED = 1.05
"""Smallest factor on the sigmas of all lines together that is applied; factors below 1 are never applied. Errors common
to the matches of the three lines with one template cannot be seen in residuals, because they move the adjusted
point.
"""
_OUTLIER_SIGMAS = 4.0
"""Number of sigmas by which the variance of one line in one pass must exceed those of the others to get a separate
factor; by chance this happens with a probability of 3e-5. A variance from the median of n correct points has a
relative standard deviation of 1.44 / sqrt(n), where 1.44 = 1 / ln 2.
"""
_MEDIAN_SPREAD = 1.0 / np.log(2.0)
"""Relative standard deviation of a variance estimated from the median of n squared residuals, times the square root of
n.
"""
_FALSE_ALARM = 1e-4
"""Probability that a correct check point is rejected, the same as for image points in the adjustment."""


_FAR_SCATTERS, _FAR_SIGMAS = 10.0, 20.0
"""Limits of the distance of an image point from its expected position, beyond which it is taken to show another ground
point than that of its name: in units of the scatter of the line's image points about their common misclosure, and in
sigmas of an image point. The nearest of 100 points in a strip of 60 km is typically (median) 1000 sigmas away.
"""
_LEAST_OF_LINE = 8
"""Smallest number of control points in a line from which wrongly named points are searched for."""
_SLOPE_POINTS = 500
"""Largest number of points from which the slope of the misclosures over the pixel is computed."""
_Accepted = dict[str, dict[str, np.ndarray]]


def mislabelled_points(campaign: Campaign, flight: FieldPass) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return masks of the image points that do not show the ground point of their name.

    Errors of camera and platform displace the image points of a line almost equally, apart from a small rotation and
    change of scale. They are modelled by a straight line over the pixel, fitted to the misclosures by medians, which
    tolerates up to half of the points being wrong.

    Returns
    -------
    wrong : dict of str to (n,) ndarray of bool for n image points
        Line -> mask of its wrong image points of control points.
    wrong_check : (m,) ndarray of bool for m check points
        Check points that are wrong in at least one line.
    """
    wrong, wrong_check, still = {}, np.zeros(len(flight.check_ground), bool), np.zeros(3)
    for name, rays in flight.control.rays.items():
        control = flight.is_control[rays.point]
        wrong[name] = np.zeros(len(control), bool)
        if control.sum() < _LEAST_OF_LINE:
            continue
        control_rays, model = rays.taken(control), campaign.laboratory[name]
        miss = misclosure(model, control_rays, flight.control.ground[control_rays.point], still, still)
        sample = np.unique(np.linspace(0, len(miss) - 1, min(_SLOPE_POINTS, len(miss))).round().astype(int))
        fits = [siegelslopes(miss[sample, k], control_rays.image[sample, 1]) for k in (0, 1)]

        def size(rays: Rays, miss: np.ndarray, fits: list[Any] = fits) -> np.ndarray:
            return np.hypot(*(miss[:, k] - fits[k][1] - fits[k][0] * rays.image[:, 1] for k in (0, 1)))

        scatter = np.sqrt(robust_variance(size(control_rays, miss) ** 2))
        limit = max(_FAR_SCATTERS * scatter, _FAR_SIGMAS * campaign.noise.image)
        wrong[name][control] = size(control_rays, miss) > limit
        if name in flight.check:
            check = flight.check[name]
            away = misclosure(model, check, flight.check_ground[check.point], still, still)
            wrong_check[check.point[size(check, away) > limit]] = True
    return wrong, wrong_check


def require_correct_names(campaign: Campaign) -> None:
    """Raise an error if image points do not show the ground points of their names.

    Raises
    ------
    FarPointsError
        Image points belong to other ground points; the message names them.
    """
    for name, rejected in _without_mislabelled(campaign)[1].items():
        if rejected.points:
            shown = listed([f"{point} in {line}" for point, line in rejected.points])
            raise FarPointsError(
                f"calibration: image points of {name} do not lie where their ground points are: {shown}"
            )


def _without_mislabelled(campaign: Campaign) -> tuple[Campaign, dict[str, Rejected]]:
    """Return the campaign without image points of wrongly named ground points, and the points removed, by field."""
    passes, gross = [], {}
    for flight in campaign.passes:
        wrong, wrong_check = mislabelled_points(campaign, flight)
        good = {name: ~mask for name, mask in wrong.items()}
        gross[flight.name] = _rejected(flight, good, ~wrong_check, {})
        passes.append(_reduced(flight, good, np.ones(len(flight.control_ground), bool), ~wrong_check))
    if not any(flight.points or flight.check_points for flight in gross.values()):
        return campaign, gross
    return _with_light(campaign, tuple(passes)), gross


def _with_light(campaign: Campaign, passes: tuple[FieldPass, ...]) -> Campaign:
    """Return the campaign with the image points of `passes`, corrected for the same effects on the light as before."""
    removed = campaign.effects if campaign.spec.effects.corrected else NO_EFFECTS
    return replace(campaign, passes=passes).without_effects(removed)


def screen_campaign(campaign: Campaign) -> Campaign:
    """Return the campaign without mislabelled and rejected points, with image sigmas rescaled to the residuals.

    Raises
    ------
    CalibrationError
        The campaign cannot be adjusted.
    """
    gross: dict[str, Rejected] = {}
    if campaign.images is None:  # points matched by this program have the right names
        campaign, gross = _without_mislabelled(campaign)
    adjustment, good = _robust(campaign)
    total: dict[tuple[str, str], float] = {(p.name, line): 1.0 for p in campaign.passes for line in p.control_images}
    for _ in range(_ROUNDS):
        factors = _factors(adjustment, good)
        if not factors:
            break
        for key, factor in factors.items():
            total[key] *= factor
        campaign = _rescaled(campaign, factors)
        adjustment, good = _robust(campaign)
    passes, rejected, judged = [], {}, []
    for k, flight in enumerate(campaign.passes):
        reduced, keep_check = _without(campaign, flight, good[flight.name], adjustment)
        passes.append(reduced)
        scales = FrozenMap({line: total[flight.name, line] for line in flight.control_images})
        rejected[flight.name] = _rejected(flight, good[flight.name], keep_check, scales)
        if campaign.images is None:
            rejected[flight.name] = rejected[flight.name].after(gross[flight.name])
        else:
            shown = campaign.images[k]
            judged.append(replace(shown, screening=_counted(flight, shown, good[flight.name], keep_check)))
    images = None if campaign.images is None else tuple(judged)
    return _with_light(replace(campaign, images=images, rejected=FrozenMap(rejected)), tuple(passes))


def _robust(campaign: Campaign) -> tuple[Adjustment, _Accepted]:
    """Return the adjustment with robust weights, and masks of the accepted image points, field -> line."""
    fit = simultaneous(campaign, robust="igg")
    good: _Accepted = {}
    for name, lines in fit.residual.items():
        good[name] = {}
        for line, residual in lines.items():
            far = np.linalg.norm(residual, axis=1) > REJECT
            good[name][line] = (fit.weight[name][line] > 0.0) & ~far
    return fit, good


def _factors(fit: Adjustment, good: _Accepted) -> dict[tuple[str, str], float]:
    """Return factors on image sigmas by (field, line), from the median of the accepted standardised residuals.

    A line has a separate factor where its residuals are significantly larger than its sigmas and than those of all
    other lines; all others share one factor. The result is empty where no factor is needed.
    """
    squares = {
        (name, line): np.sum(residual**2, axis=1)[good[name][line]]
        for name, lines in fit.residual.items()
        for line, residual in lines.items()
    }
    separate: dict[tuple[str, str], float] = {}
    while len(separate) < len(squares):
        # the worst line first, so that its residuals do not affect the variance of the others
        variances = {key: robust_variance(row) for key, row in squares.items() if key not in separate and len(row)}
        if not variances:
            break
        common = max(robust_variance(np.concatenate([squares[key] for key in variances])), 1.0)
        beyond = {k: (v / common - 1.0) * np.sqrt(len(squares[k])) / _MEDIAN_SPREAD for k, v in variances.items()}
        worst = max(beyond, key=lambda k: beyond[k])
        if beyond[worst] <= _OUTLIER_SIGMAS:
            factor = float(np.sqrt(robust_variance(np.concatenate([squares[key] for key in variances]))))
            return separate | (dict.fromkeys(variances, factor) if factor > _SETTLED else {})
        separate[worst] = float(np.sqrt(variances[worst]))
    return separate


def _rescaled(campaign: Campaign, factors: Mapping[tuple[str, str], float]) -> Campaign:
    """Return the campaign with the sigmas of image points multiplied by the factor of their pass and line."""

    def rescaled(flight: FieldPass, images: Mapping[str, ImagePoints]) -> FrozenMap[str, ImagePoints]:
        return FrozenMap(
            {
                line: replace(row, covariance=row.covariance * factors.get((flight.name, line), 1.0) ** 2)
                for line, row in images.items()
            }
        )

    passes = tuple(
        replace(
            p,
            control_images=rescaled(p, p.control_images),
            check_images=rescaled(p, p.check_images),
            tie_images=rescaled(p, p.tie_images),
        )
        for p in campaign.passes
    )
    return _with_light(campaign, passes)


def _without(
    campaign: Campaign, flight: FieldPass, good: dict[str, np.ndarray], fit: Adjustment
) -> tuple[FieldPass, np.ndarray]:
    """Return a pass without its rejected points, and the mask of accepted check points.

    The rejected points are the outliers among image points, tie points that only one line still sees, and check points
    whose rays do not intersect.
    """
    count = len(flight.control_ground)
    seen = np.zeros(count, int)
    for name, row in flight.control_images.items():
        np.add.at(seen, row.point[good[name]], 1)
    remain = np.where(flight.is_control, seen > 0, seen > 1)
    keep = np.ones(len(flight.check_ground), bool)
    if flight.check:
        intersection = intersect(flight.check, fit.cameras_of(flight.name), campaign.noise, bias=fit.bias(flight.name))
        # two conditions per ray, less three coordinates
        keep = intersection.chi_square <= statistics.limit_of(_FALSE_ALARM, 2 * intersection.rays - 3)
    return _reduced(flight, good, remain, keep), keep


def _reduced(flight: FieldPass, good: dict[str, np.ndarray], remain: np.ndarray, good_checks: np.ndarray) -> FieldPass:
    """Return a pass with only the image points, n ground points and m check points that the masks select."""
    images = {
        name: _renumbered(row.taken(good[name] & remain[row.point]), remain)
        for name, row in flight.control_images.items()
    }
    check = {
        name: _renumbered(row.taken(good_checks[row.point]), good_checks) for name, row in flight.check_images.items()
    }
    return replace(
        flight,
        control_images=FrozenMap(images),
        control_ground=flight.control_ground[remain],
        control_covariance=flight.control_covariance[remain],
        is_control=flight.is_control[remain],
        control_ids=flight.control_ids[remain],
        check_images=FrozenMap(check),
        check_ground=flight.check_ground[good_checks],
        check_ids=flight.check_ids[good_checks],
    )


def _renumbered(row: ImagePoints, retained: np.ndarray) -> ImagePoints:
    """Return image points renumbered for those of the n ground points that remain, given as a mask (n,)."""
    return replace(row, point=(np.cumsum(retained) - 1)[row.point])


def _rejected(
    flight: FieldPass, good: dict[str, np.ndarray], check: np.ndarray, factors: Mapping[str, float]
) -> Rejected:
    """Return the names of the rejected points and the numbers of points before and after screening."""
    points = [
        (str(flight.control_ids[point]), name)
        for name, row in flight.control_images.items()
        for point in row.point[~good[name]].tolist()
    ]
    entered = sum(len(row.point) for row in flight.control_images.values())
    checks = tuple(str(name) for name in flight.check_ids[~check])
    return Rejected(entered, entered - len(points), tuple(points), len(check), int(check.sum()), checks, factors)


def _counted(flight: FieldPass, shown: FieldImages, good: dict[str, np.ndarray], check: np.ndarray) -> Screening:
    entered = left = wrong_entered = wrong_left = right_lost = 0
    for name, row in flight.control_images.items():
        wrong, stays = shown.wrong[name][row.point], good[name]
        entered, left = entered + len(wrong), left + int(stays.sum())
        wrong_entered, wrong_left = wrong_entered + int(wrong.sum()), wrong_left + int((wrong & stays).sum())
        right_lost += int((~wrong & ~stays).sum())
    bad = np.any(list(shown.wrong_check.values()), axis=0)
    return Screening(
        entered, left, wrong_entered, wrong_left, right_lost, len(check), int(check.sum()), int((bad & check).sum())
    )


@dataclass(frozen=True)
class IntersectionFit:
    """Chi-square of the intersections of the check points' rays, with the sigmas of image points and readings.

    Attributes
    ----------
    chi_square : float
        Chi-square, summed over all check points.
    degrees_of_freedom : int
        Two for each ray minus three for each point.
    """

    chi_square: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Probability of a chi-square at least as large.

        The test takes into account that points exposed within a few readings have correlated errors, and the errors of
        the calibration itself.
        """
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)


def intersection_fit(campaign: Campaign, flight: FieldPass, adjustment: Adjustment) -> IntersectionFit:
    """Intersect a pass's check points with the cameras and the bias of an adjustment, and return the fit.

    Raises
    ------
    CalibrationError
        The check points cannot be intersected.
    """
    intersection = intersect(
        flight.check, adjustment.cameras_of(flight.name), campaign.noise, bias=adjustment.bias(flight.name)
    )
    seen = intersection.rays > 1
    return IntersectionFit(float(np.sum(intersection.chi_square[seen])), int(np.sum(2 * intersection.rays[seen] - 3)))


def ground_sample(flight: FieldPass, line: str) -> tuple[float, float]:
    """Return the ground sample distance of the middle of a line's image along and across the track, in metres."""
    sensor = flight.data.sensors[line]
    row = flight.control_images.get(line)
    middle = 0.5 * (sensor.lines - 1) if row is None or not len(row.line) else float(np.mean(row.line))
    pixel = 0.5 * (sensor.camera.pixels - 1)
    step = 0.5 if 0.0 <= middle - 0.5 and middle + 0.5 <= sensor.lines - 1 else 0.25
    points = np.array([[middle - step, pixel], [middle + step, pixel], [middle, pixel - step], [middle, pixel + step]])
    ground = sensor.ground(points[:, 0], points[:, 1], flight.data.height)
    along, across = (float(np.linalg.norm(ground[k + 1] - ground[k])) / (2.0 * step) for k in (0, 2))
    return along, across
