"""How the attitude bias differs from field to field: with latitude, and by what is left over, the season.

An adjustment of all fields gives each field's bias with covariance, the orbit's offsets within. For each axis

    bias(field) = amplitude sin(latitude - reference) + constant + season

is fitted by generalised least squares. The reference is the middle of the fields: another one only goes into the
constant. What remains is first judged against the biases' own covariance (chi-square), then its standard deviation is
estimated as the one with which the chi-square equals the degrees of freedom (Paule and Mandel, J. Res. NBS 87, 377
(1982)), and the sigmas of amplitude and constant contain it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from analysis import statistics
from analysis.calibration.adjustment import Adjustment
from analysis.orbit.calibration_parameters import Prior, index
from analysis.orbit.three_line_model import BIAS
from twin.orbit.calibration.campaign import Campaign, FieldPass

LEAST_FIELDS = 4
"""Two are spent on the fit; one degree of freedom is no estimate of what remains."""
_LEAST_FREEDOM = 3
_ONE_LATITUDE = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class LatitudeFit:
    """One axis.

    Attributes:
        axis: of roll, pitch, yaw.
        latitude: (K,) of the fields, radians. reference: where the sine vanishes, radians.
        value, sigma: (K,) biases of the fields, radians.
        fit: (K,) fitted.
        amplitude, constant: radians, with their sigmas, which contain what remains.
        chi_square: with the biases' own covariance. degrees_of_freedom: K - 2.
        remainder: standard deviation of what remains beside the biases' own sigmas, radians; 0 when these explain it.
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
