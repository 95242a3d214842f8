"""What limits the readings of a monitor: the variance of every quantity motion by motion, and by each stated number.

With spots s = A x + noise, parameters p = B x, x ~ N(0, C) and a quantity q = r p, an estimate g s is wrong by
(g A - r B) x + g noise. With e = g A - r B the share of motion i in the variance e C e' is e_i (C e)_i: the shares add
up to the variance, and those of motions that go together can be negative.

A number of the statement is one standard deviation that a cause gives to motions of several bodies: ``figure Z7: 2 nm``
of all mirrors. Of an estimate with the error (g A - r B) x + g noise, e = g A - r B, motions i and j make the part
e_i C_ij e_j of the variance V, which goes with the square of the numbers, so that sigma follows a number s with

    d ln sigma / d ln s = sum of e_i (C e)_i / V over the number's motions,

its elasticity: a number of elasticity 0.4 that is 10 % larger makes sigma 4 % larger. For the best estimator this holds
whether it is told of the change or not, since its gain is where the variance is least (the envelope theorem); how large
sigma becomes if the number is twice as large is worked out for both.

A statement that is a guess has heavier tails than a normal one. With each number multiplied by 1 / sqrt(w), w from a
gamma distribution of shape nu / 2 and mean 1, motions have Student's distribution with nu degrees of freedom (Lange,
Little and Taylor, Journal of the American Statistical Association 84, 881 (1989)): rare states are far out, and a
number is then wrong for all bodies at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, ndtr

from analysis.arrays import Array
from analysis.monitor import parameters
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP, CameraCalibration, Parameter


@dataclass(frozen=True, eq=False)
class Quantity:
    """Something that is read, to first order a row on the parameters of all cameras.

    Attributes
    ----------
    group : str
        a camera, ``intersection_angle`` or ``ground``.
    parameter : Parameter
        Which of its readings.
    row : Array
        (4 K,) in the reading's unit per rad and m of d_alpha, d_beta, d_gamma, d_f of one camera after the other.
    """

    group: str
    parameter: Parameter
    row: Array

    @property
    def key(self) -> str:
        """In results, ends in its unit."""
        return self.parameter.key

    @property
    def name(self) -> str:
        """Group and key, as plans of operation name it: ``forward d_f_um``."""
        return f"{self.group} {self.parameter.key}"


def quantities(cameras: Mapping[str, CameraCalibration], ground: GroundGeometry | None = None) -> tuple[Quantity, ...]:
    """All that is read of an instrument: every parameter; of a pair the intersection angle; where its altitude is
    known the errors at the middle of the line on the ground.

    Parameters
    ----------
    cameras : Mapping[str, CameraCalibration]
        By name, in the order of the spots.
    ground : GroundGeometry | None
        Of a pair.
    """
    count = 4
    unit = np.eye(count * len(cameras))
    out = [
        Quantity(name, one, row @ unit[count * c : count * (c + 1)])
        for c, (name, camera) in enumerate(cameras.items())
        for one, row in zip(parameters.CAMERA_PARAMETERS.values(), parameters.rows_of(camera), strict=True)
    ]
    if len(cameras) == 2:
        first, second = (camera.look_rad for camera in cameras.values())
        # positive where the lines of sight open: the forward one's d_alpha minus the other's
        sign = parameters.ANGLE.per_si if first > second else -parameters.ANGLE.per_si
        out.append(Quantity(ANGLE_GROUP, parameters.ANGLE, sign * (unit[0] - unit[count])))
    if ground is not None:
        one_f, two_f = (camera.geometry.principal_distance_m for camera in cameras.values())
        rows = ground.rows((one_f, two_f))
        middle = rows[len(rows) // 2]
        out += [Quantity(GROUND_GROUP, axis, row) for axis, row in zip(parameters.GROUND, middle, strict=True)]
    return tuple(out)


_UNMOVED, _NEGLIGIBLE = 1e-7, 1e-9
"""Share of what a motion does to a camera, angles and relative changes alike, and of what any motion does, below which
derivatives are rounding."""


def unmoved(
    stated: Disturbances, cameras: Mapping[str, CameraCalibration], ground: GroundGeometry | None = None
) -> frozenset[tuple[str, str]]:
    """Return group and key of the quantities that no motion of the prior changes, so that they have no posterior.

    Parameters
    ----------
    stated : Disturbances
        The prior.
    cameras : Mapping[str, CameraCalibration]
        What is calibrated of each.
    ground : GroundGeometry | None
        Of a pair whose altitude is known.
    """
    unit = np.concatenate([(1.0, 1.0, 1.0, one.geometry.principal_distance_m) for one in cameras.values()])
    size = np.max(np.abs(stated.parameters) / unit[:, None], axis=0, initial=0.0)
    least = np.maximum(_UNMOVED * size, _NEGLIGIBLE * np.max(size, initial=0.0))
    return frozenset(
        (one.group, one.key)
        for one in quantities(cameras, ground)
        if np.all(np.abs(one.row @ stated.parameters) <= float(np.abs(one.row) @ unit) * least)
    )


@dataclass(frozen=True, eq=False)
class Split:
    """The variance of Q quantities by the M stated motions.

    Attributes
    ----------
    before : Array
        (Q, M) shares without any measurement, units of the quantities squared.
    after : Array
        (Q, M) shares of what an estimator makes wrong; negative ones are possible where motions go together.
    noise : Array
        (Q,) what the noise of the images adds to ``after``.
    """

    before: Array
    after: Array
    noise: Array

    @property
    def sigma_before(self) -> Array:
        """(Q,) standard deviations without a measurement."""
        return np.sqrt(self.before.sum(axis=1))

    @property
    def sigma(self) -> Array:
        """(Q,) of the estimate's error."""
        return np.sqrt(self.after.sum(axis=1) + self.noise)

    @staticmethod
    def by(shares: Array, names: Sequence[str]) -> dict[str, Array]:
        """Shares summed over the motions of one name each, (Q,); in the order of the names' first mention.

        Parameters
        ----------
        shares : Array
            (Q, M).
        names : Sequence[str]
            (M,), for example their bodies.
        """
        own = np.array(names)
        return {name: shares[:, own == name].sum(axis=1) for name in dict.fromkeys(names)}


def split(rows: Array, stated: Disturbances, noise: Array, gain: Array) -> Split:
    """The variance of quantities by motions, before a measurement and after it.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves.
    noise : Array
        (D, D) of the shifts, px^2.
    gain : Array
        (4 K, D) of an estimator.
    """
    prior, reading = rows @ stated.parameters, rows @ gain
    error = reading @ stated.spots - prior
    by_noise = np.einsum("qd,de,qe->q", reading, noise, reading)
    return Split(prior * (prior @ stated.correlation), error * (error @ stated.correlation), by_noise)


def posterior_sigma(rows: Array, stated: Disturbances, noise: Array) -> Array:
    """(Q,) standard deviations that the best linear unbiased prediction leaves.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves, with any number of spots.
    noise : Array
        (D, D) of their shifts, px^2.
    """
    return split(rows, stated, noise, stated.best_gain(noise)).sigma


@dataclass(frozen=True, eq=False)
class LeastSeen:
    """The most likely motions by which a quantity is wrong by one sigma though all spots have been measured.

    Attributes
    ----------
    amounts : Array
        (M,) in standard deviations.
    change : float
        Of the quantity, its posterior standard deviation.
    spots : Array
        (D,) px by which the spots move with them.
    noise : Array
        (D,) px, standard deviations of the measured shifts.
    """

    amounts: Array
    change: float
    spots: Array
    noise: Array


def least_seen(row: Array, stated: Disturbances, noise: Array) -> LeastSeen:
    """The combination of motions that hides best from the spots and still changes a quantity.

    With Q the posterior covariance of the motions and b = row B it is Q b / sqrt(b' Q b): of all combinations that
    change the quantity by its posterior sigma the one of the largest posterior probability.

    Parameters
    ----------
    row : Array
        (4 K,) of the quantity.
    stated : Disturbances
        What moves.
    noise : Array
        (D, D) of the shifts, px^2.
    """
    b = row @ stated.parameters
    spread = stated.spot_covariance + noise
    across = stated.spots @ stated.correlation  # (D, M)
    direction = stated.correlation @ b - across.T @ np.linalg.lstsq(spread, across @ b, rcond=1e-13)[0]
    change = float(np.sqrt(max(float(b @ direction), 0.0)))
    if change > 0.0:
        direction = direction / change
    return LeastSeen(direction, change, stated.spots @ direction, np.sqrt(np.diagonal(noise)))


def known_sigma(rows: Array, stated: Disturbances, noise: Array, groups: Sequence[Sequence[str]]) -> Array:
    """(G, Q) standard deviations that the best linear unbiased prediction leaves, if some motions were known exactly.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves.
    noise : Array
        (D, D) of the shifts, px^2.
    groups : Sequence[Sequence[str]]
        G times the labels of motions that are known; those that go with them are then known better, too.
    """
    prior, c, labels = rows @ stated.parameters, stated.correlation, np.array(stated.labels)
    both = np.concatenate([stated.spots, prior])
    spread, count = both @ c @ both.T, len(noise)
    spread[:count, :count] += noise
    out = np.empty((len(groups), len(rows)))
    for g, group in enumerate(groups):
        own = np.isin(labels, group)
        told = both @ c[:, own]
        left = spread - told @ np.linalg.pinv(c[np.ix_(own, own)], hermitian=True) @ told.T
        solved = np.linalg.solve(left[:count, :count], left[:count, count:])
        variance = np.diagonal(left)[count:] - np.einsum("qd,dq->q", left[count:, :count], solved)
        out[g] = np.sqrt(np.maximum(variance, 0.0))
    return out


def extended(stated: Disturbances, spots: Array, own: Sequence[bool]) -> Disturbances:
    """Disturbances seen by further spots that are measured at the same time.

    Parameters
    ----------
    stated : Disturbances
        What moves.
    spots : Array
        (D', M) px for one standard deviation of the motions.
    own : Sequence[bool]
        (M,) whether a body exists once more for the further spots, as the prisms of their channels do, and moves there
        as much but independently.
    """
    apart = np.array(own, bool)
    copies = np.flatnonzero(apart)
    count, more = len(stated.labels), len(copies)
    moved = np.zeros((len(stated.spots) + len(spots), count + more))
    moved[: len(stated.spots), :count] = stated.spots
    moved[len(stated.spots) :, :count] = np.where(apart, 0.0, spots)
    moved[len(stated.spots) :, count:] = spots[:, copies]
    correlation = np.zeros((count + more, count + more))
    correlation[:count, :count] = stated.correlation
    correlation[count:, count:] = stated.correlation[np.ix_(copies, copies)]

    def with_copies(values: tuple[str, ...]) -> tuple[str, ...]:
        return (*values, *(values[k] for k in copies))

    laws: tuple[TimeLaw, ...] = (*stated.laws, *(stated.laws[k] for k in copies))
    return Disturbances(
        name=stated.name,
        labels=with_copies(stated.labels),
        bodies=with_copies(stated.bodies),
        causes=with_copies(stated.causes),
        sigmas=np.concatenate([stated.sigmas, stated.sigmas[copies]]),
        units=with_copies(stated.units),
        spots=moved,
        parameters=np.concatenate([stated.parameters, np.zeros((len(stated.parameters), more))], axis=1),
        correlation=correlation,
        laws=laws,
        jump_false_alarm=stated.jump_false_alarm,
    )


def field_covariance(
    direction_rad: float, cameras: Mapping[str, CameraCalibration], half_field: Sequence[float]
) -> Array:
    """(4 K, 4 K) of parameters that points on the ground give, when they fix the directions of the line's middle and of
    each half of the line against the other to some angle: d_gamma and d_f are that angle at the line's end.

    Parameters
    ----------
    direction_rad : float
        Standard deviation of a direction, rad.
    cameras : Mapping[str, CameraCalibration]
        By name.
    half_field : Sequence[float]
        Tangent of half the field along the line, of each camera.
    """
    sigma = [
        direction_rad * np.array([1.0, 1.0, 1.0 / t, camera.geometry.principal_distance_m / t])
        for camera, t in zip(cameras.values(), half_field, strict=True)
    ]
    return np.asarray(np.diag(np.concatenate(sigma) ** 2))


def calibrated_sigma(rows: Array, stated: Disturbances, noise: Array, field: Array, gap_s: float) -> Array:
    """(Q,) standard deviations when a test field on the ground gave the parameters some time ago and the monitor
    measured then as well as now: what is the same as then is known, what went on is not.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves, with its laws in time; motions that go together have the same one.
    noise : Array
        (D, D) of the shifts, px^2, of each of the two measurements.
    field : Array
        (4 K, 4 K) covariance of what the test field gives.
    gap_s : float
        Since then, seconds.
    """
    before, across, after = np.array([law.over(0.0, gap_s) for law in stated.laws]).reshape(-1, 3).T
    now, then, old_now = stated.correlation * after, stated.correlation * across, stated.correlation * before
    a, b = stated.spots, stated.parameters
    measured = np.concatenate([a, a, b])
    parts = len(a), 2 * len(a)
    old = np.arange(len(measured)) >= parts[0]
    same = old[:, None] == old[None, :]
    own = np.where(old, measured @ old_now @ measured.T, measured @ now @ measured.T)
    spread = np.where(same, own, measured @ then @ measured.T)
    spread[: parts[0], : parts[0]] += noise
    spread[parts[0] : parts[1], parts[0] : parts[1]] += noise
    spread[parts[1] :, parts[1] :] += field
    across = rows @ b @ np.where(old, then @ measured.T, now @ measured.T)
    # pixels and radians side by side: solved in units of their own spread
    unit = np.sqrt(np.diagonal(spread))
    solved = np.linalg.solve(spread / (unit[:, None] * unit), (across / unit).T)
    prior = np.einsum("qm,mn,qn->q", rows @ b, now, rows @ b)
    return np.sqrt(np.maximum(prior - np.einsum("qd,dq->q", across / unit, solved), 0.0))


UNSEEN = 0.1
"""Share of the noise of a shift. The derivative by a motion that moves spots by less is nearly zero."""
SHARE = 0.01
"""Share of the variance of a quantity from which an unseen body is reported."""
DEGREES = 4.0
"""Degrees of freedom of Student's distribution, for numbers that nobody measured."""
_DRAWS = 8_000
_STEPS = 100
_ROUNDING = 1e-12
"""Of a half width, at which Newton's steps end; each doubles the digits."""
_LEVELS = (0.6826894921370859, 0.9544997361036416, 0.9973002039367398)
"""Levels of 1, 2 and 3 standard deviations of a normal error."""


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Answer of Q quantities to one stated number.

    Attributes
    ----------
    number : str
        Its cause and motion: ``mirror_figure figure Z7``.
    size, unit : float
        As stated.
    bodies : tuple[str, ...]
        That have it.
    elasticity : Array
        (Q,) relative change of sigma per relative change of the number.
    doubled : Array
        (Q,) sigma of the error if it is twice as large and nobody says so.
    told : Array
        (Q,) sigma if it is twice as large and stated so.
    """

    number: str
    size: float
    unit: str
    bodies: tuple[str, ...]
    elasticity: Array
    doubled: Array
    told: Array


@dataclass(frozen=True, eq=False)
class HeavyTail:
    """What a statement with heavy tails would leave of Q quantities, read by the same estimator.

    Attributes
    ----------
    degrees : float
        Of freedom.
    rms : Array
        (Q,) root of the mean square error.
    held : Array
        (3, Q) half widths that hold as many errors as 1, 2 and 3 sigma of a normal statement do.
    beyond : Array
        (Q,) chance of an error beyond 3 of the stated sigmas, 0.0027 of a normal statement.
    """

    degrees: float
    rms: Array
    held: Array
    beyond: Array


def stated_numbers(stated: Disturbances) -> dict[str, list[int]]:
    """Number -> its motions. Axes that a cause gives the same standard deviation are one number.

    Parameters
    ----------
    stated : Disturbances
        What moves.
    """
    sizes: dict[tuple[str, str], set[float]] = {}
    whats = [label.removeprefix(f"{body} ") for label, body in zip(stated.labels, stated.bodies, strict=True)]
    for cause, what, sigma in zip(stated.causes, whats, stated.sigmas.tolist(), strict=True):
        sizes.setdefault((cause, what.split()[0]), set()).add(sigma)
    out: dict[str, list[int]] = {}
    for k, (cause, what) in enumerate(zip(stated.causes, whats, strict=True)):
        kind = what.split()[0]
        alike = kind != "figure" and len(sizes[cause, kind]) == 1
        out.setdefault(f"{cause} {kind if alike else what}", []).append(k)
    return out


def elasticities(rows: Array, stated: Disturbances, noise: Array, gain: Array) -> tuple[Elasticity, ...]:
    """Elasticities of all stated numbers, the one first that makes most of the first quantity's variance.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves.
    noise : Array
        (D, D) of the shifts, px^2.
    gain : Array
        (4 K, D) of the estimator.
    """
    reading = rows @ gain
    error = reading @ stated.spots - rows @ stated.parameters
    shares = error * (error @ stated.correlation)
    total = shares.sum(axis=1) + np.einsum("qd,de,qe->q", reading, noise, reading)
    safe = np.where(total > 0.0, total, np.inf)
    out = []
    for number, own in stated_numbers(stated).items():
        factors = np.ones(len(stated.labels))
        factors[own] = 2.0
        wider = error * factors
        doubled = total - shares.sum(axis=1) + np.sum(wider * (wider @ stated.correlation), axis=1)
        out.append(
            Elasticity(
                number=number,
                size=float(stated.sigmas[own[0]]),
                unit=stated.units[own[0]],
                bodies=tuple(dict.fromkeys(stated.bodies[k] for k in own)),
                elasticity=shares[:, own].sum(axis=1) / safe,
                doubled=np.sqrt(np.maximum(doubled, 0.0)),
                told=posterior_sigma(rows, stated.scaled(factors), noise),
            )
        )
    return tuple(sorted(out, key=lambda one: -float(one.elasticity[0])))


def unseen(rows: Array, stated: Disturbances, noise: Array, gain: Array) -> dict[str, Array]:
    """Body -> (Q,) shares of the variances that are made by stated motions of it which have next to no derivative in
    the spots; of bodies for which a share is more than `SHARE`.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves.
    noise : Array
        (D, D) of the shifts, px^2.
    gain : Array
        (4 K, D) of the estimator.
    """
    still = np.all(np.abs(stated.spots) < UNSEEN * np.sqrt(np.diag(noise))[:, None], axis=0)
    found = split(rows, stated, noise, gain)
    shares = found.after / np.where(found.sigma > 0.0, found.sigma**2, np.inf)[:, None]
    by_body: dict[str, Array] = {}
    for k in np.flatnonzero(still).tolist():
        by_body[stated.bodies[k]] = by_body.get(stated.bodies[k], np.zeros(len(rows))) + shares[:, k]
    return {body: own for body, own in by_body.items() if np.max(own) > SHARE}


def heavy_tails(rows: Array, stated: Disturbances, noise: Array, gain: Array, degrees: float = DEGREES) -> HeavyTail:
    """Errors of an estimator whose statement has Student's distribution, each number in place of its standard deviation
    with one scale for all its motions.

    Parameters
    ----------
    rows : Array
        (Q, 4 K) of the quantities.
    stated : Disturbances
        What moves; its standard deviations are the scales.
    noise : Array
        (D, D) of the shifts, px^2.
    gain : Array
        (4 K, D) of the estimator.
    degrees : float
        Of freedom, above 2.
    """
    if degrees <= 2.0:
        raise ValueError(f"heavy tails: Student's distribution has a variance above 2 degrees, found {degrees}")
    reading = rows @ gain
    error = reading @ stated.spots - rows @ stated.parameters
    groups = list(stated_numbers(stated).values())
    parts = np.stack([_of(error, own) for own in groups], axis=1)
    # (Q, G, G) what numbers g and h together make of the variance
    pairs = np.einsum("qgm,mn,qhn->qgh", parts, stated.correlation, parts)
    by_noise = np.einsum("qd,de,qe->q", reading, noise, reading)
    scales = np.random.default_rng(1).gamma(0.5 * degrees, 2.0 / degrees, (_DRAWS, len(groups))) ** -0.5
    variance = np.stack([np.einsum("ng,gh,nh->n", scales, pair, scales) for pair in pairs], axis=1) + by_noise
    sigma = np.sqrt(np.maximum(variance, 0.0))
    normal = np.sqrt(np.maximum(pairs.sum(axis=(1, 2)) + by_noise, 0.0))
    mean = degrees / (degrees - 2.0)
    own = np.einsum("qgg->qg", pairs)
    # the mean of 1 / sqrt(w) is Gamma((nu - 1) / 2) / Gamma(nu / 2) sqrt(nu / 2)
    root = float(np.exp(0.5 * np.log(0.5 * degrees) + gammaln(0.5 * (degrees - 1.0)) - gammaln(0.5 * degrees)))
    across = pairs.sum(axis=(1, 2)) - own.sum(axis=1)
    return HeavyTail(
        degrees=degrees,
        rms=np.sqrt(np.maximum(mean * own.sum(axis=1) + root**2 * across + by_noise, 0.0)),
        held=np.stack([_half_widths(sigma, level) for level in _LEVELS]),
        beyond=np.mean(2.0 * ndtr(-3.0 * normal / np.where(sigma > 0.0, sigma, np.inf)), axis=0),
    )


def _of(error: Array, own: Sequence[int]) -> Array:
    """(Q, M) the part of some motions alone."""
    out = np.zeros_like(error)
    out[:, own] = error[:, own]
    return out


def _half_widths(sigma: Array, level: float) -> Array:
    """(Q,) half widths that hold a share of normal errors of these standard deviations (N, Q).

    The share that is held grows with the half width ever more slowly. So Newton's method from 0 comes nearer from below
    at every step.
    """
    inverse = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    sure = np.mean(sigma <= 0.0, axis=0)  # errors that are none
    width = np.zeros(sigma.shape[1])
    for _ in range(_STEPS):
        ratio = width * inverse
        held = np.mean(1.0 - 2.0 * ndtr(-ratio), axis=0) + sure
        slope = np.sqrt(2.0 / np.pi) * np.mean(np.exp(-0.5 * ratio**2) * inverse, axis=0)
        step = np.maximum(level - held, 0.0) / np.where(slope > 0.0, slope, np.inf)
        width = width + step
        if np.all(step <= _ROUNDING * width):
            return width
    raise ArithmeticError(f"half widths of heavy tails: Newton's method finds no end in {_STEPS} steps")
