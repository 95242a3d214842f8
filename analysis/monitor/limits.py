"""Error budget of a monitor: contributions of every motion and of every number of the prior to the variances.

With spot shifts s = A x + noise, camera parameters p = B x, amounts x ~ N(0, C) of the motions and a quantity q = r p
(a linear combination of the parameters with coefficients r), an estimate g s has the error (g A - r B) x + g noise.
With e = g A - r B the contribution of motion i to the variance e C e' is e_i (C e)_i: the contributions add up to the
variance, and those of correlated motions can be negative.

A number of the prior is one standard deviation that a cause gives to motions of several bodies: ``figure Z7: 2 nm`` of
all mirrors. Motions i and j contribute e_i C_ij e_j to the variance V of an estimate's error, which is proportional to
the square of the numbers, so that sigma depends on a number s by

    d ln sigma / d ln s = sum of e_i (C e)_i / V over the number's motions,

its elasticity: a number of elasticity 0.4 that is 10 % larger makes sigma 4 % larger. For the best estimator this holds
whether its prior is changed as well or not, since its gain is where the variance is smallest (the envelope theorem);
sigma for a number twice as large is computed for both cases.

A prior that is a guess has heavier tails than a normal one. With each number multiplied by 1 / sqrt(w), w from a gamma
distribution of shape nu / 2 and mean 1, motions have Student's distribution with nu degrees of freedom (Lange, Little
and Taylor, Journal of the American Statistical Association 84, 881 (1989)): rare states are far out, and a number is
then wrong for all bodies at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, ndtr

from analysis.arrays import Array
from analysis.monitor import parameters
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP, CameraCalibration, Parameter


@dataclass(frozen=True, eq=False)
class Quantity:
    """Quantity read by the monitor, to first order a linear combination of the parameters of all cameras.

    Dimensions: K cameras.

    Attributes
    ----------
    group : str
        Name of a camera, ``intersection_angle`` or ``ground``.
    parameter : Parameter
        Declaration of the quantity of that camera, pair or ground point, with its unit.
    row : (4 K,) ndarray
        Coefficients of the linear combination, in the quantity's unit per rad of d_alpha, d_beta and d_gamma and per m
        of d_f, of one camera after the other.
    """

    group: str
    parameter: Parameter
    row: Array

    @property
    def key(self) -> str:
        """Name of the quantity in files of results, which ends in its unit: ``d_f_um``."""
        return self.parameter.key

    @property
    def name(self) -> str:
        """Name of the quantity in operation plans, made of its group and its key: ``forward d_f_um``."""
        return f"{self.group} {self.parameter.key}"


def quantities(cameras: Mapping[str, CameraCalibration], ground: GroundGeometry | None = None) -> tuple[Quantity, ...]:
    """Return all quantities that the monitor of an instrument reads.

    They are every parameter; for a pair the intersection angle; where the altitude is known, the errors on the ground
    at the middle of the line.

    Parameters
    ----------
    cameras : mapping of str to CameraCalibration
        Calibration of each camera, in the order of the spots.
    ground : GroundGeometry or None
        Ground geometry of a pair.
    """
    count = 4
    unit = np.eye(count * len(cameras))
    out = [
        Quantity(name, parameter, row @ unit[count * c : count * (c + 1)])
        for c, (name, camera) in enumerate(cameras.items())
        for parameter, row in zip(parameters.CAMERA_PARAMETERS.values(), parameters.rows_of(camera), strict=True)
    ]
    if len(cameras) == 2:
        first, second = (camera.look_rad for camera in cameras.values())
        # positive if the angle opens: d_alpha of the forward camera minus that of the other
        sign = parameters.ANGLE.per_si if first > second else -parameters.ANGLE.per_si
        out.append(Quantity(ANGLE_GROUP, parameters.ANGLE, sign * (unit[0] - unit[count])))
    if ground is not None:
        first_f, second_f = (camera.geometry.principal_distance_m for camera in cameras.values())
        rows = ground.rows((first_f, second_f))
        middle = rows[len(rows) // 2]
        out += [Quantity(GROUND_GROUP, axis, row) for axis, row in zip(parameters.GROUND, middle, strict=True)]
    return tuple(out)


_UNMOVED, _NEGLIGIBLE = 1e-7, 1e-9
"""Thresholds below which the derivative of a camera's parameter with respect to a motion is rounding error.

The first is relative to the whole effect of this motion on the cameras (angles and relative changes alike), the second
to the largest effect of any motion.
"""


def unchanged_quantities(
    disturbances: Disturbances, cameras: Mapping[str, CameraCalibration], ground: GroundGeometry | None = None
) -> frozenset[tuple[str, str]]:
    """Return group and key of the quantities that no motion of the prior changes, so that they have no posterior.

    Parameters
    ----------
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    ground : GroundGeometry or None
        Ground geometry of a pair whose altitude is known.
    """
    unit = np.concatenate([(1.0, 1.0, 1.0, item.geometry.principal_distance_m) for item in cameras.values()])
    size = np.max(np.abs(disturbances.parameters) / unit[:, None], axis=0, initial=0.0)
    least = np.maximum(_UNMOVED * size, _NEGLIGIBLE * np.max(size, initial=0.0))
    return frozenset(
        (item.group, item.key)
        for item in quantities(cameras, ground)
        if np.all(np.abs(item.row @ disturbances.parameters) <= float(np.abs(item.row) @ unit) * least)
    )


@dataclass(frozen=True, eq=False)
class Split:
    """Contributions of each motion of the prior and of the noise to the variances of Q quantities.

    Dimensions: M motions.

    Attributes
    ----------
    before : (Q, M) ndarray
        Contributions without any measurement, units of the quantities squared.
    after : (Q, M) ndarray
        Contributions to the variance of an estimator's error; they can be negative where motions are correlated.
    noise : (Q,) ndarray
        Variance that the noise of the images adds to ``after``.
    """

    before: Array
    after: Array
    noise: Array

    @property
    def sigma_before(self) -> Array:
        """Prior standard deviations of the quantities, without a measurement, (Q,), in their units.

        Dimensions: Q quantities.
        """
        return np.sqrt(self.before.sum(axis=1))

    @property
    def sigma(self) -> Array:
        """Standard deviations of the estimates' errors due to motions and noise, (Q,), in the units of the quantities.

        Dimensions: Q quantities.
        """
        return np.sqrt(self.after.sum(axis=1) + self.noise)

    @staticmethod
    def by(shares: Array, names: Sequence[str]) -> dict[str, Array]:
        """Return a mapping from each name to the sum of the contributions of the motions with that name, (Q,).

        The names are in the order of their first occurrence.

        Dimensions: Q quantities, M motions.

        Parameters
        ----------
        shares : (Q, M) ndarray
            Contributions of the motions.
        names : (M,) sequence of str
            Name of each motion's group, for example its body.
        """
        groups = np.array(names)
        return {name: shares[:, groups == name].sum(axis=1) for name in dict.fromkeys(names)}


def split(rows: Array, disturbances: Disturbances, noise: Array, gain: Array) -> Split:
    """Compute the contributions of the motions to the variances of quantities, before and after a measurement.

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    gain : (4 K, D) ndarray
        Gain of an estimator, rad and m per px.
    """
    prior, reading = rows @ disturbances.parameters, rows @ gain
    error = reading @ disturbances.spots - prior
    by_noise = np.einsum("qd,de,qe->q", reading, noise, reading)
    return Split(prior * (prior @ disturbances.correlation), error * (error @ disturbances.correlation), by_noise)


def posterior_sigma(rows: Array, disturbances: Disturbances, noise: Array) -> Array:
    """Return the standard deviations of quantities after the best linear unbiased prediction, (Q,), in their units.

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances, with any number of spots.
    noise : (D, D) ndarray
        Covariance of their shifts, px^2.
    """
    return split(rows, disturbances, noise, disturbances.best_gain(noise)).sigma


@dataclass(frozen=True, eq=False)
class LeastObservable:
    """Most likely motions by which a quantity is wrong by one sigma although all spots have been measured.

    Dimensions: M motions, D spot coordinates (row and column of every spot).

    Attributes
    ----------
    amounts : (M,) ndarray
        Motions in standard deviations.
    change : float
        Change of the quantity due to these motions, equal to its posterior standard deviation.
    spots : (D,) ndarray
        Spot shifts due to these motions, px.
    noise : (D,) ndarray
        Standard deviations of the measured shifts, px.
    """

    amounts: Array
    change: float
    spots: Array
    noise: Array


def least_seen(row: Array, disturbances: Disturbances, noise: Array) -> LeastObservable:
    """Return the combination of motions that the spots reveal least and that still changes a quantity.

    With the posterior covariance Q of the motions and the effect b = row B of each motion on the quantity, the
    combination is Q b / sqrt(b' Q b): of all combinations that change the quantity by its posterior sigma the one of
    the largest posterior probability.

    Dimensions: K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    row : (4 K,) ndarray
        Coefficients of the quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    """
    b = row @ disturbances.parameters
    spread = disturbances.spot_covariance + noise
    across = disturbances.spots @ disturbances.correlation  # (D, M)
    direction = disturbances.correlation @ b - across.T @ np.linalg.lstsq(spread, across @ b, rcond=1e-13)[0]
    change = float(np.sqrt(max(float(b @ direction), 0.0)))
    if change > 0.0:
        direction = direction / change
    return LeastObservable(direction, change, disturbances.spots @ direction, np.sqrt(np.diagonal(noise)))


def sigma_if_known(rows: Array, disturbances: Disturbances, noise: Array, groups: Sequence[Sequence[str]]) -> Array:
    """Return the posterior standard deviations of quantities if some motions were known exactly, (G, Q).

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    groups : sequence of sequences of str
        For each of G cases, the labels of the known motions; motions correlated with them are then known better, too.
    """
    prior, c, labels = rows @ disturbances.parameters, disturbances.correlation, np.array(disturbances.labels)
    both = np.concatenate([disturbances.spots, prior])
    spread, count = both @ c @ both.T, len(noise)
    spread[:count, :count] += noise
    out = np.empty((len(groups), len(rows)))
    for g, group in enumerate(groups):
        known = np.isin(labels, group)
        cross = both @ c[:, known]
        left = spread - cross @ np.linalg.pinv(c[np.ix_(known, known)], hermitian=True) @ cross.T
        solved = np.linalg.solve(left[:count, :count], left[:count, count:])
        variance = np.diagonal(left)[count:] - np.einsum("qd,dq->q", left[count:, :count], solved)
        out[g] = np.sqrt(np.maximum(variance, 0.0))
    return out


def with_further_spots(disturbances: Disturbances, spots: Array, individual: Sequence[bool]) -> Disturbances:
    """Return the prior for a monitor with further spots that are measured at the same time as the existing ones.

    Dimensions: D spot coordinates (row and column of every spot), M motions.

    Parameters
    ----------
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    spots : (D', M) ndarray
        Shifts of D' further spot coordinates for one standard deviation of the motions, px.
    individual : (M,) sequence of bool
        True for a motion of a body of which the further spots have their own copy (such as the prisms of their
        channels); the copy moves as much as the original but independently.
    """
    apart = np.array(individual, bool)
    both = disturbances.with_copies(np.flatnonzero(apart).tolist(), 1.0)
    more = len(both.labels) - len(disturbances.labels)
    further = np.concatenate([np.where(apart, 0.0, spots), spots[:, apart]], axis=1)
    existing = np.concatenate([disturbances.spots, np.zeros((len(disturbances.spots), more))], axis=1)
    parameters = np.concatenate([disturbances.parameters, np.zeros((len(disturbances.parameters), more))], axis=1)
    return replace(both, spots=np.concatenate([existing, further]), parameters=parameters)


def field_covariance(
    direction_rad: float, cameras: Mapping[str, CameraCalibration], half_field: Sequence[float]
) -> Array:
    """Return the covariance of the camera parameters (rad, m) as measured with ground control points, (4 K, 4 K).

    The points determine the direction of the line's middle, and of each half of the line relative to the other, to some
    angle: d_gamma and d_f are that angle at the line's end.

    Dimensions: K cameras.

    Parameters
    ----------
    direction_rad : float
        Standard deviation of a direction, rad.
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    half_field : sequence of float
        Tangent of half the field along the line, of each camera.
    """
    sigma = [
        direction_rad * np.array([1.0, 1.0, 1.0 / t, camera.geometry.principal_distance_m / t])
        for camera, t in zip(cameras.values(), half_field, strict=True)
    ]
    return np.asarray(np.diag(np.concatenate(sigma) ** 2))


def calibrated_sigma(rows: Array, disturbances: Disturbances, noise: Array, field: Array, gap_s: float) -> Array:
    """Return the standard deviations of quantities some time after a calibration on a test field, (Q,).

    The test field on the ground gave the parameters, and the monitor measured then as well as now: unchanged motions
    are known, later changes are not.

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances with its laws in time; correlated motions have the same law.
    noise : (D, D) ndarray
        Covariance of the shifts of each of the two measurements, px^2.
    field : (4 K, 4 K) ndarray
        Covariance of the parameters from the test field.
    gap_s : float
        Time since the calibration, s.
    """
    before, across, after = np.array([law.two_time_moments(0.0, gap_s) for law in disturbances.laws]).reshape(-1, 3).T
    now, then, old_now = (disturbances.correlation * moment for moment in (after, across, before))
    a, b = disturbances.spots, disturbances.parameters
    measured = np.concatenate([a, a, b])
    parts = len(a), 2 * len(a)
    old = np.arange(len(measured)) >= parts[0]
    same = old[:, None] == old[None, :]
    within = np.where(old, measured @ old_now @ measured.T, measured @ now @ measured.T)
    spread = np.where(same, within, measured @ then @ measured.T)
    spread[: parts[0], : parts[0]] += noise
    spread[parts[0] : parts[1], parts[0] : parts[1]] += noise
    spread[parts[1] :, parts[1] :] += field
    across = rows @ b @ np.where(old, then @ measured.T, now @ measured.T)
    # pixels and radians are mixed: solved in units of their standard deviations
    unit = np.sqrt(np.diagonal(spread))
    solved = np.linalg.solve(spread / (unit[:, None] * unit), (across / unit).T)
    prior = np.einsum("qm,mn,qn->q", rows @ b, now, rows @ b)
    return np.sqrt(np.maximum(prior - np.einsum("qd,dq->q", across / unit, solved), 0.0))


UNOBSERVED = 0.1
"""Ratio of the spot shift due to a motion to the noise of the shift below which the spot does not show the motion."""
SHARE = 0.01
"""Smallest fraction of a quantity's variance at which a body that the spots do not reveal is reported."""
DEGREES = 4.0
"""Degrees of freedom of Student's distribution assumed for standard deviations of the prior that are guesses."""
_DRAWS = 8_000
_STEPS = 100
_ROUNDING = 1e-12
"""Relative step at which Newton's method for the half width of an interval ends; each step doubles the digits."""
_LEVELS = (0.6826894921370859, 0.9544997361036416, 0.9973002039367398)
"""Probabilities within 1, 2 and 3 standard deviations of a normal error."""


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Sensitivity of the sigmas of Q quantities to one standard deviation specified in the prior.

    One such number is the standard deviation that a cause gives to a motion of one or several bodies.

    Attributes
    ----------
    number : str
        Cause and motion of the number: ``mirror_figure figure Z7``.
    size, unit : float, str
        Value of the number and its unit.
    bodies : tuple of str
        Bodies that have it.
    elasticity : (Q,) ndarray
        Relative change of a quantity's sigma divided by the relative change of the number.
    doubled : (Q,) ndarray
        Sigma of the error if the real number is twice as large but the estimator still assumes the original prior.
    doubled_in_prior : (Q,) ndarray
        Sigma of the error if the number is twice as large in reality and in the estimator's prior.
    """

    number: str
    size: float
    unit: str
    bodies: tuple[str, ...]
    elasticity: Array
    doubled: Array
    doubled_in_prior: Array


@dataclass(frozen=True, eq=False)
class HeavyTail:
    """Errors of Q quantities if the motions have heavier tails than the normal prior that the estimator assumes.

    Attributes
    ----------
    degrees : float
        Degrees of freedom of Student's distribution.
    rms : (Q,) ndarray
        Root of the mean square error, in the units of the quantities.
    half_widths : (3, Q) ndarray
        Half widths of the intervals that contain the error with the probabilities 68.3 %, 95.4 % and 99.7 %.
    beyond : (Q,) ndarray
        Probability of an error beyond 3 of the reported sigmas, 0.0027 for a normal prior.
    """

    degrees: float
    rms: Array
    half_widths: Array
    beyond: Array


def prior_numbers(disturbances: Disturbances) -> dict[str, list[int]]:
    """Return, for each standard deviation specified in the prior, the indices of the motions that have it.

    The keys of the result name the cause and the kind of motion.

    Parameters
    ----------
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    """
    sizes: dict[tuple[str, str], set[float]] = {}
    named = zip(disturbances.labels, disturbances.bodies, strict=True)
    whats = [label.removeprefix(f"{body} ") for label, body in named]
    for cause, what, sigma in zip(disturbances.causes, whats, disturbances.sigmas.tolist(), strict=True):
        sizes.setdefault((cause, what.split()[0]), set()).add(sigma)
    out: dict[str, list[int]] = {}
    for k, (cause, what) in enumerate(zip(disturbances.causes, whats, strict=True)):
        kind = what.split()[0]
        shared = kind != "figure" and len(sizes[cause, kind]) == 1
        out.setdefault(f"{cause} {kind if shared else what}", []).append(k)
    return out


def elasticities(rows: Array, disturbances: Disturbances, noise: Array, gain: Array) -> tuple[Elasticity, ...]:
    """Return the relative sensitivity of sigma to each standard deviation of the prior, d ln sigma / d ln s.

    Sigma is that of a quantity's error, s the standard deviation that a cause gives to a motion of one or several
    bodies. The results are in descending order of the first quantity's sensitivity.

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    gain : (4 K, D) ndarray
        Gain of the estimator, rad and m per px.
    """
    reading = rows @ gain
    error = reading @ disturbances.spots - rows @ disturbances.parameters
    shares = error * (error @ disturbances.correlation)
    total = shares.sum(axis=1) + np.einsum("qd,de,qe->q", reading, noise, reading)
    safe = np.where(total > 0.0, total, np.inf)
    out = []
    for number, indices in prior_numbers(disturbances).items():
        factors = np.ones(len(disturbances.labels))
        factors[indices] = 2.0
        wider = error * factors
        doubled = total - shares.sum(axis=1) + np.sum(wider * (wider @ disturbances.correlation), axis=1)
        out.append(
            Elasticity(
                number=number,
                size=float(disturbances.sigmas[indices[0]]),
                unit=disturbances.units[indices[0]],
                bodies=tuple(dict.fromkeys(disturbances.bodies[k] for k in indices)),
                elasticity=shares[:, indices].sum(axis=1) / safe,
                doubled=np.sqrt(np.maximum(doubled, 0.0)),
                doubled_in_prior=posterior_sigma(rows, disturbances.scaled(factors), noise),
            )
        )
    return tuple(sorted(out, key=lambda elasticity: -float(elasticity.elasticity[0])))


def unobserved_bodies(rows: Array, disturbances: Disturbances, noise: Array, gain: Array) -> dict[str, Array]:
    """Return the fraction of each quantity's variance due to motions that hardly move the spots, (Q,), by body.

    Only bodies for which a share exceeds `SHARE` are returned.

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    gain : (4 K, D) ndarray
        Gain of the estimator, rad and m per px.
    """
    still = np.all(np.abs(disturbances.spots) < UNOBSERVED * np.sqrt(np.diag(noise))[:, None], axis=0)
    contributions = split(rows, disturbances, noise, gain)
    shares = contributions.after / np.where(contributions.sigma > 0.0, contributions.sigma**2, np.inf)[:, None]
    by_body: dict[str, Array] = {}
    for k in np.flatnonzero(still).tolist():
        by_body[disturbances.bodies[k]] = by_body.get(disturbances.bodies[k], np.zeros(len(rows))) + shares[:, k]
    return {body: body_shares for body, body_shares in by_body.items() if np.max(body_shares) > SHARE}


def heavy_tails(
    rows: Array, disturbances: Disturbances, noise: Array, gain: Array, degrees: float = DEGREES
) -> HeavyTail:
    """Compute the errors of an estimator if the motions have Student's and not a normal distribution.

    All motions that share a standard deviation specified in the prior are multiplied by one random scale.

    Dimensions: Q quantities, K cameras, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    rows : (Q, 4 K) ndarray
        Coefficients of each quantity on the parameters of all cameras (rad and m).
    disturbances : Disturbances
        Prior of the disturbances; its standard deviations are the scales.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    gain : (4 K, D) ndarray
        Gain of the estimator, rad and m per px.
    degrees : float
        Degrees of freedom, above 2.
    """
    if degrees <= 2.0:
        raise ValueError(f"heavy tails: Student's t distribution needs more than 2 degrees of freedom, found {degrees}")
    reading = rows @ gain
    error = reading @ disturbances.spots - rows @ disturbances.parameters
    groups = list(prior_numbers(disturbances).values())
    parts = np.stack([_of(error, diagonal) for diagonal in groups], axis=1)
    # (Q, G, G) contribution of the numbers g and h together to the variance
    pairs = np.einsum("qgm,mn,qhn->qgh", parts, disturbances.correlation, parts)
    by_noise = np.einsum("qd,de,qe->q", reading, noise, reading)
    scales = np.random.default_rng(1).gamma(0.5 * degrees, 2.0 / degrees, (_DRAWS, len(groups))) ** -0.5
    variance = np.stack([np.einsum("ng,gh,nh->n", scales, pair, scales) for pair in pairs], axis=1) + by_noise
    sigma = np.sqrt(np.maximum(variance, 0.0))
    normal = np.sqrt(np.maximum(pairs.sum(axis=(1, 2)) + by_noise, 0.0))
    mean = degrees / (degrees - 2.0)
    diagonal = np.einsum("qgg->qg", pairs)
    # the mean of 1 / sqrt(w) is Gamma((nu - 1) / 2) / Gamma(nu / 2) sqrt(nu / 2)
    root = float(np.exp(0.5 * np.log(0.5 * degrees) + gammaln(0.5 * (degrees - 1.0)) - gammaln(0.5 * degrees)))
    across = pairs.sum(axis=(1, 2)) - diagonal.sum(axis=1)
    return HeavyTail(
        degrees=degrees,
        rms=np.sqrt(np.maximum(mean * diagonal.sum(axis=1) + root**2 * across + by_noise, 0.0)),
        half_widths=np.stack([_half_widths(sigma, level) for level in _LEVELS]),
        beyond=np.mean(2.0 * ndtr(-3.0 * normal / np.where(sigma > 0.0, sigma, np.inf)), axis=0),
    )


def _of(error: Array, indices: Sequence[int]) -> Array:
    """Return the error of each quantity per unit of each motion (Q, M), set to zero except for selected motions.

    Dimensions: Q quantities, M motions.
    """
    out = np.zeros_like(error)
    out[:, indices] = error[:, indices]
    return out


def _half_widths(sigma: Array, level: float) -> Array:
    """Return the half widths (Q,) of intervals with a given probability, for normal errors of random sigmas (N, Q).

    The probability grows with the half width ever more slowly. Newton's method from 0 therefore approaches from below
    at every step.

    Dimensions: N random draws, Q quantities.
    """
    inverse = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    sure = np.mean(sigma <= 0.0, axis=0)  # errors of zero variance
    width = np.zeros(sigma.shape[1])
    for _ in range(_STEPS):
        ratio = width * inverse
        probability = np.mean(1.0 - 2.0 * ndtr(-ratio), axis=0) + sure
        slope = np.sqrt(2.0 / np.pi) * np.mean(np.exp(-0.5 * ratio**2) * inverse, axis=0)
        step = np.maximum(level - probability, 0.0) / np.where(slope > 0.0, slope, np.inf)
        width = width + step
        if np.all(step <= _ROUNDING * width):
            return width
    raise ArithmeticError(f"half widths of heavy tails: Newton's method does not converge in {_STEPS} steps")
