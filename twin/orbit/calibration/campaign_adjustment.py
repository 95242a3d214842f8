"""Least-squares calibration of a campaign, field by field or all fields at once: unknowns, gauge and priors.

The attitude bias is also fitted against latitude. An adjustment of all fields gives each field's bias with its
covariance, which includes the offsets of the orbit. For each axis

    bias(field) = amplitude sin(latitude - reference) + constant + season

is fitted by generalised least squares, where season is a random remainder of each field. The reference is the middle of
the fields' latitudes; another one only changes the constant. The remainders are first tested against the biases'
covariance (chi-square). Then their standard deviation is estimated as the value for which the chi-square equals the
degrees of freedom (Paule and Mandel, J. Res. NBS 87, 377 (1982)), and is included in the sigmas of amplitude and
constant.

Screening of measured points (robust weights, wrong names, intersections of check points), and ground sampling.

Points that the adjustment rejects are removed from the measurements, and the sigmas of image points are enlarged
where the residuals of the remaining points require it. The truth is used for the counts alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.optimize import brentq
from scipy.stats import siegelslopes

from analysis import statistics
from analysis.block.reweighting import REJECT, Robust
from analysis.calibration.adjustment import FALSE_ALARM, Adjustment, FarPointsError, adjust
from analysis.orbit.calibration_parameters import OFFSET, RATE, Gauge, Prior, Unknowns, index
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import BIAS, Rays, misclosure
from analysis.statistics import robust_variance
from optics.numerics.number_tree import FrozenMap
from twin.orbit.calibration.campaign import Campaign, DetectedDrift, FieldImages, FieldPass, Rejected, Screening
from twin.orbit.flight.sensor import NO_EFFECTS
from twin.orbit.measured.pass_measurements import ImagePoints, listed

GAUGE = Gauge(held=("nadir x", "nadir y"))
"""Gauge of three lines: the nadir line's principal point keeps its laboratory value. Its x cannot be separated from
pitch, and its y from roll so weakly that one field would not determine it to a pixel.
"""
_LEAST_OFFSET = 1e-3
"""Smallest prior sigma of an orbit's offset along an axis, in metres, used where the file gives no drift along that
axis.
"""
_LEAST_RATE = 1e-11
"""Smallest prior sigma of an attitude rate about an axis, in radians per second, used where only other axes have rates:
1e-4 arcsec in a minute.
"""


def gauge_of(campaign: Campaign) -> Gauge:
    """Return the gauge, which fixes the principal point of one line at its laboratory value.

    Unknowns that the points determine less well than the prior stay near the laboratory's values, within the prior
    sigmas of changes at launch and with the season.
    """
    launch, season = campaign.spec.launch, np.array(campaign.spec.errors.season)
    start = dict.fromkeys(campaign.inner, launch.interior)
    rotations = np.hypot(launch.bias, season).tolist()
    start |= {
        f"{p.name} {axis}": s for p in campaign.passes for axis, s in zip(BIAS, rotations, strict=True) if s > 0.0
    }
    return Gauge(held=(f"{campaign.reference} x", f"{campaign.reference} y"), start=FrozenMap(start))


def _rates_of(campaign: Campaign) -> np.ndarray:
    """Return the (3,) standard deviations of each pass's attitude rate, specified and detected, in rad/s."""
    prior = campaign.spec.errors.star_tracker.drift if campaign.spec.errors.switched_on else None
    detected = (0.0, 0.0, 0.0) if campaign.drifts is None else campaign.drifts.rate
    return np.asarray(np.hypot(prior or (0.0, 0.0, 0.0), detected))


def _rate_priors(campaign: Campaign, passes: Sequence[FieldPass], common: Sequence[Prior] = ()) -> tuple[Prior, ...]:
    """Return the priors on the attitude rate of each pass; only the common ones where no pass drifts by itself.

    Parameters
    ----------
    campaign : Campaign
        Campaign with the drift that is specified in the file or detected.
    passes : sequence of FieldPass
        Passes that are adjusted.
    common : sequence of Prior
        Prior of a rate that all passes share. Its error is then treated as independent from pass to pass.
    """
    sigma = _rates_of(campaign)
    if not np.any(sigma):
        return tuple(common)
    common_rates = {next(iter(p.weights)): (p.value, p.sigma) for p in common}
    priors = []
    for flight in passes:
        for name, scatter in zip(RATE, np.maximum(sigma, _LEAST_RATE).tolist(), strict=True):
            value, error = common_rates.get(name, (0.0, 0.0))
            priors.append(Prior({f"{flight.name} {name}": 1.0}, value, float(np.hypot(scatter, error)), "bias rate"))
    return tuple(priors)


def calibrated_alone(campaign: Campaign, flight: FieldPass) -> Adjustment:
    """Calibrate one field by itself, with the unknowns of paper 003 (Mo et al. 2015) that the gauge leaves free.

    Paper 003 has twelve: principal distance and principal point of three lines, and the attitude biases about three
    axes. A rate of the attitude is added where the attitude drifts.

    Parameters
    ----------
    campaign : Campaign
        Campaign with the laboratory's camera and the noise.
    flight : FieldPass
        Pass over the field.

    Raises
    ------
    CalibrationError
        The adjustment cannot be solved.
    """
    rates = _rate_priors(campaign, [flight])
    return adjust(
        [flight.control],
        campaign.laboratory,
        campaign.noise,
        unknowns=Unknowns(rate="field" if rates else "none"),
        priors=rates,
        gauge=gauge_of(campaign),
    )


def with_detected_drift(campaign: Campaign, rates: tuple[Prior, ...] = ()) -> Campaign:
    """Return the campaign with a drift of the attitude in its noise model, if the residuals show one.

    Only a drift that the file does not specify is tested. It is modelled as a random walk, whose sigma is estimated as
    a variance component, and a rate of each pass. The false-alarm rate of either test is `FALSE_ALARM`.

    Parameters
    ----------
    campaign : Campaign
        Campaign with the noise that the file specifies.
    rates : tuple of Prior
        Priors of a rate that all passes share.

    Raises
    ------
    CalibrationError
        The adjustment cannot be solved.
    """
    adjustment = simultaneous(campaign, rates)
    rate_p_value = 1.0 if adjustment.rates is None else adjustment.rates.p_value
    if min(rate_p_value, adjustment.slow_variations.p_value) >= FALSE_ALARM:
        return campaign
    sigma = np.zeros(3)
    if adjustment.rates is not None:
        size = np.where(
            np.isfinite(adjustment.rates.sigma), np.hypot(adjustment.rates.estimate, adjustment.rates.sigma), 0.0
        )
        sigma = size.reshape(-1, 3).max(axis=0)
    focal = min(float(m.interior[0]) for m in campaign.laboratory.values())
    trial = max(campaign.noise.image / focal, campaign.noise.attitude_walk)
    walking = replace(campaign, noise=replace(campaign.noise, attitude_walk=trial))
    factor = simultaneous(walking, rates, components=("attitude walk",)).factors["attitude walk"]
    walk = float(trial * np.sqrt(factor))
    roll, pitch, yaw = sigma.tolist()
    drifts = DetectedDrift((roll, pitch, yaw), walk, rate_p_value, adjustment.slow_variations.p_value)
    return replace(walking, noise=replace(walking.noise, attitude_walk=walk), drifts=drifts)


def simultaneous(
    campaign: Campaign,
    rates: tuple[Prior, ...] = (),
    robust: Robust | None = None,
    drift: bool = False,
    monitor: tuple[Prior, ...] = (),
    components: Sequence[str] = (),
) -> Adjustment:
    """Adjust all fields at once, with one interior orientation for all and a bias for each field.

    Where the orbit drifts, each field also has an offset with its prior.

    Parameters
    ----------
    campaign : Campaign
        Campaign to adjust.
    rates : tuple of Prior
        Priors of a drift of the bias that all passes share.
    robust : Robust, optional
        Robust weight function of the image points.
    drift : bool
        True to estimate the cameras' changes in each pass, which `monitor` must then observe.
    monitor : tuple of Prior
        Readings of an on-board monitor as observations of these changes.
    components : sequence of str
        Groups of observations whose variance is estimated.

    Raises
    ------
    CalibrationError
        The adjustment cannot be solved.
    """
    errors = campaign.spec.errors
    offsets = bool(errors.switched_on and any(errors.gps.drift))
    drifts = tuple(
        Prior({f"{p.name} offset {axis}": 1.0}, 0.0, max(sigma, _LEAST_OFFSET), "orbit")
        for p in campaign.passes
        for axis, sigma in zip(OFFSET, errors.gps.drift, strict=True)
    )
    rated = _rate_priors(campaign, campaign.passes, rates)
    kind: Literal["common", "field", "none"] = "none"
    if rated:
        kind = "field" if np.any(_rates_of(campaign)) else "common"
    return adjust(
        [p.control for p in campaign.passes],
        campaign.laboratory,
        campaign.noise,
        unknowns=Unknowns(offsets, drift, kind),
        priors=(*(drifts if offsets else ()), *rated, *monitor),
        gauge=gauge_of(campaign),
        robust=robust,
        variance_components=components or False,
    )


LEAST_FIELDS = 4
"""Smallest number of fields for a fit against latitude: the fit has two parameters, and a single degree of freedom does
not suffice to estimate the scatter beyond the sigmas.
"""
_LEAST_FREEDOM = 3
"""Smallest number of degrees of freedom of a fit against latitude from which rates during the passes are predicted: the
variance of Student's t exists from three on.
"""
_SAME_LATITUDE = np.radians(1.0)
"""Range of the fields' latitudes, in radians, below which no fit against latitude is made."""


@dataclass(frozen=True, eq=False)
class LatitudeFit:
    """Fit of one axis of the attitude bias against latitude.

    Attributes
    ----------
    axis : str
        Axis of the bias: roll, pitch or yaw.
    latitude : (K,) ndarray for K fields
        Latitudes of the fields, in radians.
    reference : float
        Latitude at which the sine vanishes, in radians.
    value, sigma : (K,) ndarray
        Biases of the fields and their standard deviations, in radians.
    fit : (K,) ndarray
        Fitted biases, in radians.
    amplitude, constant : float
        Parameters of the fit, in radians.
    amplitude_sigma, constant_sigma : float
        Their standard deviations, in radians, which include the remainder.
    chi_square : float
        Chi-square of the fit with the biases' own covariance.
    degrees_of_freedom : int
        Number of fields K minus 2.
    remainder : float
        Standard deviation of the scatter beyond the biases' own sigmas, in radians; 0 when these explain all of it.
    """

    axis: str
    latitude: np.ndarray
    reference: float
    value: np.ndarray
    sigma: np.ndarray
    fit: np.ndarray
    amplitude: float
    amplitude_sigma: float
    constant: float
    constant_sigma: float
    chi_square: float
    degrees_of_freedom: int
    remainder: float

    @property
    def p_value(self) -> float:
        """Probability of a chi-square at least as large if the bias depends on latitude alone."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    def curve(self, latitude: np.ndarray) -> np.ndarray:
        """Return the fitted attitude bias, in radians, at latitudes, in radians."""
        return np.asarray(self.amplitude * np.sin(latitude - self.reference) + self.constant)


def latitude_fits(campaign: Campaign, together: Adjustment) -> tuple[LatitudeFit, ...]:
    """Fit roll, pitch and yaw of the fields against latitude.

    Returns an empty tuple for fewer than `LEAST_FIELDS` fields, or for fields within one degree of latitude.
    """
    latitude = np.array([p.latitude for p in campaign.passes])
    if len(latitude) < LEAST_FIELDS or np.ptp(latitude) < _SAME_LATITUDE:
        return ()
    fits = []
    for axis in BIAS:
        where = [index(together.names, f"{p.name} {axis}") for p in campaign.passes]
        fits.append(fit_latitude(axis, latitude, together.values[where], together.covariance[np.ix_(where, where)]))
    return tuple(fits)


def rate_priors(campaign: Campaign, fits: tuple[LatitudeFit, ...]) -> tuple[Prior, ...]:
    """Return priors of the biases' rates during the passes, predicted from their change with latitude.

    A rate is the fitted amplitude times the rate of sin(latitude - reference), mean of the passes. The outer lines see
    a field half a minute before and after the nadir line, so that without these priors their principal points x, y
    would absorb the drift. The result is empty for fits of fewer than `_LEAST_FREEDOM` degrees of freedom.
    """
    if not fits or fits[0].degrees_of_freedom < _LEAST_FREEDOM:
        return ()
    # a sigma from f degrees of freedom: the error over it is Student's, of variance f / (f - 2)
    student = float(np.sqrt(fits[0].degrees_of_freedom / (fits[0].degrees_of_freedom - 2.0)))
    speed = float(np.mean([_sine_rate(p, fits[0].reference) for p in campaign.passes]))
    spread = student * abs(speed)
    return tuple(
        Prior({f"{f.axis} rate": 1.0}, f.amplitude * speed, f.amplitude_sigma * spread, "bias rate") for f in fits
    )


def _sine_rate(flight: FieldPass, reference: float) -> float:
    """Return the rate of sin(latitude - reference) at a pass's middle, from the measured orbit, in 1/s."""
    path, middle, step = flight.measured, flight.middle, np.array([-1.0, 1.0])
    covered = path.covers(middle + step)[:, None]
    # where readings end within a second, extrapolated by the velocity
    on = path.position(middle) + step[:, None] * path.velocity(middle)
    ends = np.where(covered, path.position(middle + np.where(covered[:, 0], step, 0.0)), on)
    latitude = flight.data.earth.geodetic(ends)[1]
    return float(np.diff(np.sin(latitude - reference))[0] / 2.0)


def fit_latitude(axis: str, latitude: np.ndarray, value: np.ndarray, covariance: np.ndarray) -> LatitudeFit:
    """Fit the biases (K,) of K fields, with covariance (K, K), against their latitudes (K,), all in radians."""
    reference = float(0.5 * (latitude.min() + latitude.max()))
    design = np.stack([np.sin(latitude - reference), np.ones_like(latitude)], axis=1)
    freedom = len(value) - 2

    def solved(extra: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Solve the fit with an extra standard deviation; return parameters (2,), covariance (2, 2) and chi-square.

        The extra standard deviation, in radians, is added in quadrature to that of each field's bias.
        """
        weight = np.linalg.inv(covariance + extra**2 * np.eye(len(value)))
        spread = np.linalg.inv(design.T @ weight @ design)
        best = spread @ design.T @ weight @ value
        residual = value - design @ best
        return best, spread, float(residual @ weight @ residual)

    chi_square = solved(0.0)[2]
    remainder = 0.0
    if chi_square > freedom:
        # at this upper bound the chi-square is below a thousandth of the degrees of freedom
        upper = float(np.linalg.norm(value - value.mean())) * 100.0
        remainder = float(brentq(lambda s: solved(s)[2] - freedom, 0.0, upper, xtol=1e-12))
    best, spread, _ = solved(remainder)
    sigma = np.sqrt(np.diag(spread))
    return LatitudeFit(
        axis,
        latitude,
        reference,
        value,
        np.sqrt(np.diag(covariance)),
        design @ best,
        float(best[0]),
        float(sigma[0]),
        float(best[1]),
        float(sigma[1]),
        chi_square,
        freedom,
        remainder,
    )


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
