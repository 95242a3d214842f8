"""Least-squares calibration of a campaign, field by field or all fields at once: unknowns, gauge and priors.

The attitude bias is also fitted against latitude. An adjustment of all fields gives each field's bias with its
covariance, which includes the offsets of the orbit. For each axis

    bias(field) = amplitude sin(latitude - reference) + constant + season

is fitted by generalised least squares, where season is a random remainder of each field. The reference is the middle of
the fields' latitudes; another one only changes the constant. The remainders are first tested against the biases'
covariance (chi-square). Then their standard deviation is estimated as the value for which the chi-square equals the
degrees of freedom (Paule and Mandel, J. Res. NBS 87, 377 (1982)), and is included in the sigmas of amplitude and
constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from analysis import statistics
from analysis.block.reweighting import Robust
from analysis.calibration.adjustment import FALSE_ALARM, Adjustment, adjust
from analysis.orbit.calibration_parameters import OFFSET, RATE, Gauge, Prior, Unknowns, index
from analysis.orbit.three_line_model import BIAS
from optics.numerics.number_tree import FrozenMap
from twin.orbit.calibration.campaign import Campaign, DetectedDrift, FieldPass

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
