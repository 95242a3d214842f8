"""The adjustment of a campaign, of one field by itself and of all at once: what is solved for, what is held, what is
known beforehand.

How the attitude bias differs from field to field: with latitude, and by what is left over, the season.

An adjustment of all fields gives each field's bias with covariance, the orbit's offsets within. For each axis

    bias(field) = amplitude sin(latitude - reference) + constant + season

is fitted by generalised least squares. The reference is the middle of the fields: another one only goes into the
constant. What remains is first judged against the biases' own covariance (chi-square), then its standard deviation is
estimated as the one with which the chi-square equals the degrees of freedom (Paule and Mandel, J. Res. NBS 87, 377
(1982)), and the sigmas of amplitude and constant contain it.
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
from twin.orbit.calibration.campaign import Campaign, FieldPass, FoundDrift

GAUGE = Gauge(held=("nadir x", "nadir y"))
"""Gauge of three lines. The nadir line's principal point keeps its laboratory value: x is not observable against pitch,
and y against roll so weakly that one field would not determine it to a pixel.
"""
_LEAST_OFFSET = 1e-3
"""Metres; sigma of an orbit without a drift along one axis."""
_LEAST_RATE = 1e-11
"""Radians per second; sigma of a rate about an axis that has none, where another one has: 1e-4 arcsec in a minute."""


def gauge_of(campaign: Campaign) -> Gauge:
    """The principal point of one line is held; see `GAUGE`. What the points know less well than launch leaves to expect
    keeps near the laboratory's values, to the sigmas of launch and season.
    """
    launch, season = campaign.spec.launch, np.array(campaign.spec.errors.season)
    start = dict.fromkeys(campaign.inner, launch.interior)
    turns = np.hypot(launch.bias, season).tolist()
    start |= {f"{p.name} {axis}": s for p in campaign.passes for axis, s in zip(BIAS, turns, strict=True) if s > 0.0}
    return Gauge(held=(f"{campaign.reference} x", f"{campaign.reference} y"), start=FrozenMap(start))


def _rates_of(campaign: Campaign) -> np.ndarray:
    """(3,) standard deviations of the attitude's rate in each pass, stated or found in residuals, rad/s."""
    stated = campaign.spec.errors.star_tracker.drift if campaign.spec.errors.switched_on else None
    found = (0.0, 0.0, 0.0) if campaign.drifts is None else campaign.drifts.rate
    return np.asarray(np.hypot(stated or (0.0, 0.0, 0.0), found))


def _rate_priors(campaign: Campaign, passes: Sequence[FieldPass], common: Sequence[Prior] = ()) -> tuple[Prior, ...]:
    """Priors on the rate of each pass; empty where none drifts by itself.

    Parameters
    ----------
    campaign : Campaign
        For what is stated.
    passes : Sequence[FieldPass]
        That are adjusted.
    common : Sequence[Prior]
        What is known of a rate that all of them have; its error then counts as one of each.
    """
    sigma = _rates_of(campaign)
    if not np.any(sigma):
        return tuple(common)
    known = {next(iter(p.weights)): (p.value, p.sigma) for p in common}
    found = []
    for one in passes:
        for name, own in zip(RATE, np.maximum(sigma, _LEAST_RATE).tolist(), strict=True):
            value, error = known.get(name, (0.0, 0.0))
            found.append(Prior({f"{one.name} {name}": 1.0}, value, float(np.hypot(own, error)), "bias rate"))
    return tuple(found)


def calibrated_alone(campaign: Campaign, one: FieldPass) -> Adjustment:
    """A field by itself, with paper 003's twelve unknowns less the gauge, and its rate where the attitude drifts.

    Parameters
    ----------
    campaign : Campaign
        For the laboratory's camera and the noise.
    one : FieldPass
        The field.

    Raises
    ------
    CalibrationError
        It cannot be solved.
    """
    rates = _rate_priors(campaign, [one])
    return adjust(
        [one.control],
        campaign.laboratory,
        campaign.noise,
        unknowns=Unknowns(rate="field" if rates else "none"),
        priors=rates,
        gauge=gauge_of(campaign),
    )


def drift_looked_for(campaign: Campaign, rates: tuple[Prior, ...] = ()) -> Campaign:
    """The campaign, or where residuals show a drift of the attitude that nobody stated, with this among its noise: a
    random walk by its variance component, and a rate of each pass. False alarms: `FALSE_ALARM` for either test.

    Parameters
    ----------
    campaign : Campaign
        As it is stated.
    rates : tuple[Prior, ...]
        What is known of a rate that all passes have.

    Raises
    ------
    CalibrationError
        It cannot be solved.
    """
    found = simultaneous(campaign, rates)
    rate_chance = 1.0 if found.rates is None else found.rates.p_value
    if min(rate_chance, found.courses.p_value) >= FALSE_ALARM:
        return campaign
    sigma = np.zeros(3)
    if found.rates is not None:
        size = np.where(np.isfinite(found.rates.sigma), np.hypot(found.rates.estimate, found.rates.sigma), 0.0)
        sigma = size.reshape(-1, 3).max(axis=0)
    focal = min(float(m.interior[0]) for m in campaign.laboratory.values())
    trial = max(campaign.noise.image / focal, campaign.noise.attitude_walk)
    walking = replace(campaign, noise=replace(campaign.noise, attitude_walk=trial))
    factor = simultaneous(walking, rates, components=("attitude walk",)).factors["attitude walk"]
    walk = float(trial * np.sqrt(factor))
    roll, pitch, yaw = sigma.tolist()
    drifts = FoundDrift((roll, pitch, yaw), walk, rate_chance, found.courses.p_value)
    return replace(walking, noise=replace(walking.noise, attitude_walk=walk), drifts=drifts)


def simultaneous(
    campaign: Campaign,
    rates: tuple[Prior, ...] = (),
    robust: Robust | None = None,
    drift: bool = False,
    monitor: tuple[Prior, ...] = (),
    components: Sequence[str] = (),
) -> Adjustment:
    """All fields at once: one interior, a bias and, where the orbit drifts, an offset with its prior for each field.

    Parameters
    ----------
    campaign : Campaign
        The fields.
    rates : tuple[Prior, ...]
        What is known of a drift of the bias that all passes have.
    robust : Robust | None
        Weights of the image points.
    drift : bool
        Whether the cameras' changes in each pass are unknowns, too; `monitor` must tell them.
    monitor : tuple[Prior, ...]
        What an on-board monitor tells of these.
    components : Sequence[str]
        Groups whose variance is estimated.

    Raises
    ------
    CalibrationError
        It cannot be solved.
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
"""Two are spent on the fit; one degree of freedom is no estimate of what remains."""
_LEAST_FREEDOM = 3
_ONE_LATITUDE = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class LatitudeFit:
    """One axis.

    Attributes
    ----------
    axis : str
        Of roll, pitch, yaw.
    latitude : np.ndarray
        (K,) of the fields, radians. reference: where the sine vanishes, radians.
    value, sigma : np.ndarray
        (K,) biases of the fields, radians.
    fit : np.ndarray
        (K,) fitted.
    amplitude, constant : float
        Radians, with their sigmas, which contain what remains.
    chi_square : float
        With the biases' own covariance. degrees_of_freedom: K - 2.
    remainder : float
        Standard deviation of what remains beside the biases' own sigmas, radians; 0 when these explain it.
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
        """Chance of such a chi-square if latitude is all that matters."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    def curve(self, latitude: np.ndarray) -> np.ndarray:
        """Fitted bias, radians."""
        return np.asarray(self.amplitude * np.sin(latitude - self.reference) + self.constant)


def latitude_fits(campaign: Campaign, together: Adjustment) -> tuple[LatitudeFit, ...]:
    """Roll, pitch and yaw; empty for fewer than `LEAST_FIELDS` fields, or fields within one degree of latitude."""
    latitude = np.array([p.latitude for p in campaign.passes])
    if len(latitude) < LEAST_FIELDS or np.ptp(latitude) < _ONE_LATITUDE:
        return ()
    found = []
    for axis in BIAS:
        where = [index(together.names, f"{p.name} {axis}") for p in campaign.passes]
        found.append(fitted(axis, latitude, together.values[where], together.covariance[np.ix_(where, where)]))
    return tuple(found)


def rate_priors(campaign: Campaign, fits: tuple[LatitudeFit, ...]) -> tuple[Prior, ...]:
    """How fast the biases drift during the passes, as they do from field to field: amplitude times the change of the
    sine of latitude in a second, mean of the passes. Empty for fits of fewer than `_LEAST_FREEDOM` degrees of freedom.

    The outer lines see a field half a minute before and after the nadir line, so that their x and y take up the drift.
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


def _sine_rate(one: FieldPass, reference: float) -> float:
    """Change of sin(latitude - reference) at a pass's middle by the measured orbit, 1/s."""
    path, middle, step = one.measured, one.middle, np.array([-1.0, 1.0])
    known = path.known(middle + step)[:, None]
    # by the velocity where a second farther there are no readings
    on = path.position(middle) + step[:, None] * path.velocity(middle)
    ends = np.where(known, path.position(middle + np.where(known[:, 0], step, 0.0)), on)
    latitude = one.data.earth.geodetic(ends)[1]
    return float(np.diff(np.sin(latitude - reference))[0] / 2.0)


def fitted(axis: str, latitude: np.ndarray, value: np.ndarray, covariance: np.ndarray) -> LatitudeFit:
    """Fit biases (K,) with covariance (K, K) at latitudes (K,), radians."""
    reference = float(0.5 * (latitude.min() + latitude.max()))
    design = np.stack([np.sin(latitude - reference), np.ones_like(latitude)], axis=1)
    freedom = len(value) - 2

    def solved(extra: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Values (2,), covariance (2, 2), chi-square."""
        weight = np.linalg.inv(covariance + extra**2 * np.eye(len(value)))
        spread = np.linalg.inv(design.T @ weight @ design)
        best = spread @ design.T @ weight @ value
        rest = value - design @ best
        return best, spread, float(rest @ weight @ rest)

    chi_square = solved(0.0)[2]
    remainder = 0.0
    if chi_square > freedom:
        # with this much extra the chi-square is below a thousandth of the degrees of freedom
        most = float(np.linalg.norm(value - value.mean())) * 100.0
        remainder = float(brentq(lambda s: solved(s)[2] - freedom, 0.0, most, xtol=1e-12))
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
