"""State of a Kalman filter of a series, with tests of bad readings and probabilities of undetected jumps.

**Undetected jumps.** A jump is reported where hardly any series without one would look like it; long before that, and
where it stays too small for ever, a jump may be more likely than none. Score b and information J of a step of
independent amounts before one reading, of variance s^2 each, make it

    B = exp(b' (J + I/s^2)^-1 b / 2) / det(I + s^2 J)^(1/2)

times more likely than none (`jump_detection` defines b and J), its amounts then being normal about (J + I/s^2)^-1 b.
The prior gives only the root mean square of the sizes, to which few large ones contribute nearly all: s is one of
several sizes down to an eighth of that, with equal probabilities. With the gap between readings over the mean time
between two jumps as prior probability, and one jump at most within a window, the probability of a jump before a reading
is

    p = w / (1 + sum w),   w = B gap / every,

with sums over the readings of the window and over bodies.

**Bad readings.** A reading that is wrong by itself is weighed against a jump whose size is bounded by the prior. Both
explain a reading that is far from its prediction. A priori a reading is bad with a small probability c, and a body
jumps before it with the probability gap / every, as above. A bad reading has errors at some of its D coordinates, of
variance v each (diagonal matrix V), and none at the others. With nu the difference from the prediction, S its
covariance and N the normal density,

    B(bad) = c N(nu; 0, S + V) / N(nu; 0, S)

is averaged over the sizes of errors, over the number of coordinates and over which they are: the worst is added first,
then the one that explains most of the rest, and so on. For a jump the ratio of likelihoods with it and without it,
averaged over its size, is that above; sizes well above the prior's have small probabilities of their own, so that a
very large jump is accepted only when the next reading confirms it. A step of the readings that no body explains is a
jump too, with the smallest probability: several readings that agree with each other are not bad.

Reference: Box, Tiao, A Bayesian approach to some outlier problems, Biometrika 55, 1968, 119.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, gammaln, logsumexp

from analysis.arrays import Array
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.jump_detection import Amounts, Candidate, Jump


@dataclass(frozen=True, eq=False)
class Observed:
    """One reading at one time: of all spots, of d temperature sensors, or of d combinations of camera parameters.

    Dimensions: D spot coordinates (row and column of every spot).

    Attributes
    ----------
    time : float
        Time of the reading, s.
    value : ndarray
        (D,) shifts of the spots since the reference, px; (d,) values of another reading, in its unit.
    noise : ndarray
        Covariance of the values.
    sensors : tuple of int
        Indices of the d sensors of `HeatInputs` that were read.
    parameters : (d, P) ndarray or None
        Coefficients of the d combinations of the P parameters that were read; None for other readings.
    """

    time: float
    value: Array
    noise: Array
    sensors: tuple[int, ...] = ()
    parameters: Array | None = None

    @property
    def spots(self) -> bool:
        """True if this is a reading of the spots, False for temperatures or camera parameters."""
        return not self.sensors and self.parameters is None


@dataclass(frozen=True)
class BadReading:
    """Evidence that a reading is faulty (bad), as opposed to showing a real change.

    Attributes
    ----------
    log_ratio : float
        Logarithm of the ratio of the likelihood if it is bad, times the prior probability of a bad reading, to that if
        it is good.
    z : float
        Deviation of the worst coordinate from its prediction by all others and the past, in standard deviations.
    coordinate : int
        Index of that coordinate.
    """

    log_ratio: float
    z: float
    coordinate: int


@dataclass(frozen=True, eq=False)
class Innovation:
    """Difference of a reading from its prediction by all earlier ones, with the decisions that followed from it.

    Dimensions: d values of the reading.

    Attributes
    ----------
    observed : Observed
        Reading.
    white : (d,) ndarray
        Difference from the prediction, transformed to independent numbers of unit variance.
    log_score : float
        Logarithm of the predicted density at the reading.
    jump : Jump or None
        Jump detected at this reading; None if there is none.
    bad : BadReading or None
        Evidence that the reading is bad, where it was set aside; None where it was accepted.
    earlier : Innovation or None
        Innovation of the reading that was set aside before, if that was accepted now.
    settled : bool
        True if a reading was set aside before, and its acceptance or exclusion is decided now.
    """

    observed: Observed
    white: Array
    log_score: float
    jump: Jump | None = None
    bad: BadReading | None = None
    earlier: Innovation | None = None
    settled: bool = False

    @property
    def chi_square(self) -> float:
        """Sum of squares of the whitened difference, with as many degrees of freedom as values were read."""
        return float(self.white @ self.white)


@dataclass(frozen=True, eq=False)
class Track:
    """Kalman filter together with the effect that a step just before each of the last L readings would have had.

    Dimensions: n states of the filter, q values that readings can contain (outputs).

    Attributes
    ----------
    mean : (n,) ndarray
        Mean of the states.
    covariance : (n, n) ndarray
        Covariance of the states.
    response : (L, n, q) ndarray
        Change of the mean by a step before each of the last L readings that shifts each output by one unit.
    score : (L, q) ndarray
        Score b of each step: weighted sum of the readings after it, from which its size is estimated.
    information : (L, q, q) ndarray
        Information J (inverse covariance) of each step's size.
    """

    mean: Array
    covariance: Array
    response: Array
    score: Array
    information: Array

    def alone(self) -> Track:
        """Return the filter's mean and covariance without the hypotheses of steps before the last readings."""
        return replace(self, response=self.response[:0], score=self.score[:0], information=self.information[:0])


@dataclass(frozen=True, eq=False)
class Whitened:
    """Reading transformed by the root of its predicted covariance, to independent values of unit variance.

    Dimensions: d values of the reading, n states of the filter, q values that readings can contain (outputs).

    Attributes
    ----------
    root : (d, d) ndarray
        Cholesky factor of the reading's predicted covariance, noise included.
    white : (d,) ndarray
        Whitened innovation, root^-1 (value - prediction).
    rows : (d, n) ndarray
        Whitened observation matrix, root^-1 H, where H is the derivative of the reading with respect to the states.
    gain : (d, n) ndarray
        Product root^-1 H P with the covariance P of the states.
    picked : (d, q) ndarray
        Whitened change of the reading for a change of each output by one unit.
    """

    root: Array
    white: Array
    rows: Array
    gain: Array
    picked: Array


@dataclass(frozen=True, eq=False)
class PendingReading:
    """Reading that is set aside until the next one, since it may be bad or the first after a jump.

    Attributes
    ----------
    ingested : FilterState
        State of the filter if the reading is good.
    innovation : Innovation
        Difference of the reading from its prediction, with the decisions that followed.
    log_odds : float
        Logarithm of the odds that it is bad.
    """

    ingested: FilterState
    innovation: Innovation
    log_odds: float


@dataclass(frozen=True, eq=False)
class FilterState:
    """State of the Kalman filter and of its jump detection after the readings so far.

    Dimensions: L gaps between readings, in each of which a step may have occurred, m motions that jump at a known rate.

    Attributes
    ----------
    time : float
        Time of the newest reading or of the start, s.
    last : float
        Time of the newest reading of spots, s; NaN before the first.
    after, until : (L,) ndarray
        Interval in which each step hypothesis occurs, s.
    state : Track
        Filter of the estimate.
    search : Track or None
        Filter that detects jumps, which does not include the random walk; None where they are the same.
    undetected : (m,) ndarray
        Share of the mean square of jumps that is too small to be detected, for each motion with a known jump rate.
    recent : tuple of bool
        For each of the last readings of spots, True if it was excluded as bad.
    pending : PendingReading or None
        Reading set aside; this state is then the one in which it is bad.
    """

    time: float
    last: float
    after: Array
    until: Array
    state: Track
    search: Track | None
    undetected: Array
    recent: tuple[bool, ...] = ()
    pending: PendingReading | None = None

    @property
    def mean(self) -> Array:
        """Mean of the n states of the filter, (n,)."""
        return self.state.mean

    @property
    def covariance(self) -> Array:
        """Covariance of the n states of the filter, (n, n)."""
        return self.state.covariance

    @property
    def jump_track(self) -> Track:
        """Filter in which jumps are detected: `search` if there is one, otherwise `state`."""
        return self.state if self.search is None else self.search


_SCALES = (0.125, 0.25, 0.5, 1.0, 2.0)
"""Assumed sizes of undetected jumps, relative to their prior root mean square size."""
_AGAIN = 2.0
"""Factor of the variance that an undetected jump adds for a smoother.

It is above 1 since the readings that indicated the jump and its size are used once more.
"""


@dataclass(frozen=True, eq=False)
class JumpingBody:
    """Body whose motions jump at a known mean rate.

    Attributes
    ----------
    motions : tuple of int
        Indices of its r motions that jump.
    spots : (q, r) ndarray
        Effect on the q outputs (values that readings can contain) of independent amounts of unit variance that make up
        the jumping motions.
    root : (r, r) ndarray
        Matrix from these amounts to the motions, in prior standard deviations.
    every_s : float
        Mean time between two jumps, s.
    """

    motions: tuple[int, ...]
    spots: Array
    root: Array
    every_s: float


def jumping_bodies(
    prior: Disturbances, may: Sequence[Candidate], otherwise: float | None = None
) -> tuple[JumpingBody, ...]:
    """Return the bodies of which all jumping motions have a known rate.

    Parameters
    ----------
    prior : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    may : sequence of Candidate
        Motions, alone or of one body together, that may jump.
    otherwise : float or None
        Mean time between two jumps, s, of motions without a known rate; None to return only bodies with a rate.
    """
    out = []
    for body in dict.fromkeys(c.body for c in may):
        c = max((c for c in may if c.body == body), key=lambda c: len(c.motions))
        rates = [otherwise if (rate := prior.laws[k].every_s) is None else rate for k in c.motions]
        intervals = [rate for rate in rates if rate is not None]
        if len(intervals) == len(rates):
            out.append(JumpingBody(c.motions, c.spots, c.root, min(intervals)))
    return tuple(out)


def undetected(looked: tuple[Array, Array], evidence: tuple[Array, Array], outputs: Array, expected: Array) -> Amounts:
    """Return the amounts of a jump of unknown size of one body before each of the last L readings.

    The log weight of a hypothesis is the logarithm of its likelihood ratio times its prior probability.

    Dimensions: L gaps between readings, in each of which a step may have occurred, q values that readings can
    contain (outputs), r motions of the body that may jump.

    Parameters
    ----------
    looked : tuple of ndarray
        Score (L, q) and information (L, q, q) of steps from which the weights of the hypotheses are computed.
    evidence : tuple of ndarray
        Score and information of steps from which the amounts of the jump are computed.
    outputs : (q, r) ndarray
        Effect on the outputs of the r independent amounts of unit prior variance that make up the jump.
    expected : (L,) ndarray
        Mean number of jumps in the gap before each reading; 0 where there is no gap.
    """
    logs, means, squares = [], [], []
    for times in _SCALES:
        amounts = Amounts.of(*evidence, outputs, times)
        judged = amounts if looked is evidence else Amounts.of(*looked, outputs, times)
        logs.append(judged.log_weight)
        means.append(amounts.mean)
        squares.append(amounts.covariance + amounts.mean[:, :, None] * amounts.mean[:, None, :])
    together = np.logaddexp.reduce(logs, axis=0)
    share = np.exp(np.array(logs) - together)
    mean = np.einsum("sk,ski->ki", share, means)
    square = np.einsum("sk,skij->kij", share, squares)
    with np.errstate(divide="ignore"):
        weight = together - np.log(len(_SCALES)) + np.log(expected)
    return Amounts(mean, square - mean[:, :, None] * mean[:, None, :], weight)


def jump_probabilities(hints: Sequence[Amounts], window: int | None = None) -> list[Array]:
    """Return for each body the probability of a jump before each reading, (L,), with at most one jump in a window.

    The window extends over the given number of readings on either side, or over all.

    Dimensions: L gaps between readings, in each of which a step may have occurred.
    """
    log_weights = np.logaddexp.reduce([hint.log_weight for hint in hints], axis=0)
    if window is None:
        total = np.logaddexp(0.0, np.logaddexp.reduce(log_weights))
    else:
        padded = np.pad(log_weights, window, constant_values=-np.inf)
        near = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1)
        total = np.logaddexp(0.0, np.logaddexp.reduce(near, axis=1))
    return [np.exp(hint.log_weight - total) for hint in hints]


def undetected_variance(
    score: Sequence[Array], information: Sequence[Array], gap: Array, bodies: Sequence[JumpingBody], window: int
) -> list[Array]:
    """Return the variance that a smoother adds for undetected jumps, an array (N, r) for each body.

    It is relative to the mean square of the motions at their prior rate.

    Dimensions: r motions of the body that may jump.

    Parameters
    ----------
    score : sequence of (N, r) ndarrays
        For each body, the score of a step before each of N readings: weighted sum of all readings, from which the
        amounts of the step are estimated.
    information : sequence of (N, r, r) ndarrays
        For each body, the information (inverse covariance) on these amounts.
    gap : (N,) ndarray
        Time since the reading before, s; 0 where there is none.
    bodies : sequence of JumpingBody
        Bodies that jump.
    window : int
        Number of readings among which one jump is assumed.
    """
    if not bodies:
        return []
    hints = []
    for body, b, j in zip(bodies, score, information, strict=True):
        evidence = b, j
        hints.append(undetected(evidence, evidence, np.eye(len(body.motions)), gap / body.every_s))
    out = []
    for body, hint, probability in zip(bodies, hints, jump_probabilities(hints, window // 2), strict=True):
        square = (hint.mean @ body.root.T) ** 2 + np.einsum("ij,kjl,il->ki", body.root, hint.covariance, body.root)
        over = np.divide(probability * body.every_s, gap, out=np.zeros_like(gap), where=gap > 0.0)
        out.append(_AGAIN * over[:, None] * square)
    return out


# prior probability that a reading is bad
_SHARE = 1e-3
# logarithms of the odds above which a reading is set aside, against an undisturbed one and against the first one after
# a jump: the second is low, since an error at one coordinate and a jump of a body that moves spots in any way look
# alike, and since the rate of bad readings is not known well
_UNSURE, _SURE = math.log(0.05 / 0.95), math.log(1e-3)
# largest probability with which a reading that is set aside counts as the first after a jump, for the same reason
_MOST_FOR_JUMP = 0.8
# number of last readings, and of these the number of excluded ones above which no further reading is excluded: then the
# prior is wrong, and not the readings
RECENT, _MOST = 10, 5
# sizes of errors relative to the noise of a coordinate, with equal probabilities
_ERRORS = np.array([10.0, 50.0, 250.0, 1250.0, 6250.0])
# sizes of jumps relative to the prior, and the logarithms of their probabilities
_SIZES = np.array([0.125, 0.25, 0.5, 1.0, 2.0, 8.0, 64.0])
_LOG_SIZE = np.log([0.2, 0.2, 0.2, 0.2, 0.2, 1e-2, 1e-4])
# logarithm of the probability of a step that no body explains, relative to a jump of one body in the whole life
_UNSTATED = math.log(1e-3)


def may_be_bad(bad: BadReading | None, log_odds: float, recent: Sequence[bool]) -> bool:
    """Return True if a reading may be faulty and is to be set aside until the next one decides.

    Parameters
    ----------
    bad : BadReading or None
        Evidence that it is bad; None without any.
    log_odds : float
        Logarithm of the odds that it is bad.
    recent : sequence of bool
        For each of the last readings, True if it was excluded.
    """
    return bad is not None and bad.log_ratio > _UNSURE and log_odds > _SURE and sum(recent) < _MOST


def probability_good(log_odds: float) -> float:
    """Return the probability with which a reading that was set aside still counts as good until it is decided.

    Parameters
    ----------
    log_odds : float
        Logarithm of the odds that it is bad.
    """
    return min(_MOST_FOR_JUMP, float(expit(-log_odds)))


def bad_reading(white: Array, root: Array, noise: Array) -> BadReading | None:
    """Return the evidence that coordinates of a reading have gross errors; None if there is none.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    white : (D,) ndarray
        Whitened difference from the prediction.
    root : (D, D) ndarray
        Cholesky factor of the covariance of that difference.
    noise : (D, D) ndarray
        Covariance of the reading.
    """
    count = len(white)
    if 0.5 * float(white @ white) + math.log(_SHARE) < _UNSURE:  # no errors explain more than chi-square
        return None
    back = np.linalg.inv(root)
    precision = back.T @ back
    pulled = back.T @ white
    z = pulled / np.sqrt(np.diag(precision))
    worst = int(np.argmax(np.abs(z)))
    size = np.diag(noise).copy()
    size = np.where(size > 0.0, size, 1e-6 * np.diag(root @ root.T))
    chosen = np.arange(1, count + 1)
    beforehand = -math.log(count) - (gammaln(count + 1) - gammaln(chosen + 1) - gammaln(count - chosen + 1))
    logs = [_with_errors(precision, pulled, scale**2 * size) + beforehand for scale in _ERRORS.tolist()]
    total = float(logsumexp(logs)) - math.log(len(_ERRORS)) + math.log(_SHARE)
    return BadReading(total, float(z[worst]), worst)


def _with_errors(precision: Array, pulled: Array, variance: Array) -> Array:
    """Return log likelihood ratios for errors at the k coordinates that explain a reading best, k = 1 to D, (D,).

    ``precision`` is the inverse covariance (D, D) of the reading's difference from its prediction, ``pulled`` that
    inverse times the difference, ``variance`` that of an error at each coordinate.
    """
    free, total, out = np.ones(len(pulled), bool), 0.0, np.empty(len(pulled))
    for number in range(len(pulled)):
        inner = 1.0 + variance * np.diag(precision)
        gain = np.where(free, 0.5 * (variance * pulled**2 / inner - np.log(inner)), -np.inf)
        k = int(np.argmax(gain))
        total += float(gain[k])
        column, share = precision[:, k], variance[k] / inner[k]
        precision, pulled = precision - share * np.outer(column, column), pulled - share * column * pulled[k]
        free[k] = False
        out[number] = total
    return out


def jump_evidence(track: Track, gap: Array, bodies: Sequence[JumpingBody], life: float, noise: Array) -> float:
    """Return the log likelihood ratio of the last readings with at most one jump to that without any jump.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    track : Track
        Filter with a step hypothesis for each of L gaps between readings.
    gap : (L,) ndarray
        Length of the interval in which each occurs, s.
    bodies : sequence of JumpingBody
        Bodies that jump.
    life : float
        Time, s, in which a step that no body explains occurs with a small probability.
    noise : (D, D) ndarray
        Covariance of the reading, whose multiples are the sizes of such a step.
    """
    if not len(gap):
        return 0.0
    unstated = np.eye(track.score.shape[1])[:, : len(noise)] * np.sqrt(np.diag(noise))
    cases = [(unstated, _ERRORS, np.full(len(_ERRORS), _UNSTATED - math.log(len(_ERRORS) * life)))]
    cases += [(body.spots, _SIZES, _LOG_SIZE - math.log(body.every_s)) for body in bodies]
    logs = [0.0]
    log_gap = np.log(np.maximum(gap, 1e-300))
    for outputs, scale, beforehand in cases:
        values, vectors = np.linalg.eigh(outputs.T @ track.information @ outputs)
        along = np.einsum("kij,ki->kj", vectors, track.score @ outputs)
        square = scale[:, None, None] ** 2
        inner = 1.0 + square * np.maximum(values, 0.0)
        gain = 0.5 * np.sum(square * along**2 / inner - np.log(inner), axis=2)
        logs.append(float(logsumexp(gain + beforehand[:, None] + log_gap)))
    return float(logsumexp(logs))
