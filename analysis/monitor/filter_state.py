"""State of the filter of a series: its readings, their innovations, and the estimate with its covariance.

Jumps that the readings hint at and that are not told, since chance might explain them: their chances, and what they
add to the state.

A jump is told where hardly any series without one would look like it; long before that, and where it stays too small
for ever, one is likelier than none. Score b and information J of a step of independent amounts at one place, of
variance s^2 each, make it

    B = exp(b' (J + I/s^2)^-1 b / 2) / det(I + s^2 J)^(1/2)

times likelier than none (`jump_detection` has b and J), its amounts then being normal about (J + I/s^2)^-1 b. The
statement gives the root mean square of the sizes alone, of which few large ones make nearly all: s is one of several
sizes down to an eighth of that, each as likely. With the gap between readings over the mean time between two jumps as
chance beforehand, and one jump at most within a window, the chance of one at a place is

    p = w / (1 + sum w),   w = B gap / every,

sums over the places of the window and over bodies.

A reading that is wrong by itself, weighed against a jump whose size is bounded by what is stated.

Both explain a reading that is far from its prediction. Beforehand a reading is bad with a small chance c, a body jumps
before it with the chance gap / every of a jump, above. A bad reading has errors at some of its D coordinates, of
variance v each, and none at the others. With nu the difference from the prediction and S its covariance,

    B(bad) = c N(nu; 0, S + V) / N(nu; 0, S)

is averaged over the sizes of errors, over the number of coordinates and over which they are: the worst is added first,
then the one that explains most of what is left, and so on. For a jump the ratio of likelihoods with it and without it,
averaged over its size, is that above; sizes well above those stated have small chances of their own, so
that a very large jump is believed when the next reading shows it once more, and not before. A step of the readings
that no body explains has a place among jumps, too, with the least chance: several readings that agree with each other
are not bad.

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
    """One reading: of all spots, or of d sensors or combinations of parameters.

    Attributes
    ----------
    time : float
        seconds.
    value : Array
        (D,) shifts of the spots since the reference, px; (d,) of another reading, in its unit.
    noise : Array
        Its covariance.
    sensors : tuple[int, ...]
        Numbers of the sensors of `HeatInputs` that read it, d of them.
    parameters : Array | None
        (d, P) rows on the parameters that it reads.
    """

    time: float
    value: Array
    noise: Array
    sensors: tuple[int, ...] = ()
    parameters: Array | None = None

    @property
    def spots(self) -> bool:
        """Return whether the reading is one of the spots."""
        return not self.sensors and self.parameters is None


@dataclass(frozen=True)
class BadReading:
    """Evidence that a reading is bad.

    Attributes
    ----------
    log_ratio : float
        Logarithm of the likelihood if it is bad, chance beforehand included, over that if it is not.
    z : float
        The coordinate that is furthest from what all others and the past make of it, in standard deviations.
    coordinate : int
        Number of it.
    """

    log_ratio: float
    z: float
    coordinate: int


@dataclass(frozen=True, eq=False)
class Innovation:
    """A reading against what was expected of it before it came.

    Attributes
    ----------
    observed : Observed
        The reading.
    white : Array
        (d,) the difference in independent standard deviations.
    log_score : float
        Logarithm of the density that was stated for what came.
    jump : Jump | None
        Told at this reading; None for none.
    bad : BadReading | None
        What speaks for the reading being bad, where it was set aside; None where it was taken.
    earlier : Innovation | None
        The reading that was set aside before it, if that was taken after all.
    settled : bool
        Whether one was set aside before it, of which it is decided now whether it is taken or left out.
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
        """Return chi-square, of as many degrees of freedom as numbers were read."""
        return float(self.white @ self.white)


@dataclass(frozen=True, eq=False)
class Track:
    """A filter, and what steps just before each of L readings would do to it.

    Attributes
    ----------
    mean : Array
        (n,); covariance: (n, n).
    response : Array
        (L, n, q) of the mean to steps of unit outputs.
    score : Array
        (L, q) b of the module's text; information: (L, q, q) J.
    """

    mean: Array
    covariance: Array
    response: Array
    score: Array
    information: Array

    def alone(self) -> Track:
        """The filter without steps that are looked for."""
        return replace(self, response=self.response[:0], score=self.score[:0], information=self.information[:0])


@dataclass(frozen=True, eq=False)
class Whitened:
    """A reading divided by the root of its covariance.

    Attributes
    ----------
    root : Array
        Cholesky factor (d, d) of its covariance, noise included.
    white : Array
        (d,) root^-1 (value - what was expected).
    rows : Array
        (d, n) root^-1 H; gain: (d, n) root^-1 H P; picked: (d, q) root^-1 what unit outputs do to it.
    """

    root: Array
    white: Array
    rows: Array
    gain: Array
    picked: Array


@dataclass(frozen=True, eq=False)
class Aside:
    """A reading that was set aside until the next one, since it may be bad or the first after a jump.

    Attributes
    ----------
    taken : Belief
        What is known if it is good.
    innovation : Innovation
        Of it.
    log_odds : float
        Logarithm of the odds that it is bad.
    """

    taken: Belief
    innovation: Innovation
    log_odds: float


@dataclass(frozen=True, eq=False)
class Belief:
    """All that is known from the readings so far.

    Attributes
    ----------
    time : float
        Of the newest reading or of the start, seconds.
    last : float
        Time of the newest reading of spots; NaN before the first.
    after, until : Array
        (L,) between which times each step that is looked for comes, seconds.
    state : Track
        The filter. search: the one that looks for jumps, which knows of no walk; None where they are the same.
    left : Array
        (m,) what share of the mean square of jumps cannot be told, of each motion of a stated rate.
    recent : tuple[bool, ...]
        Whether each of the last readings of spots was left out as a bad one.
    aside : Aside | None
        a reading after which this is what is known if it is bad; None for none.
    """

    time: float
    last: float
    after: Array
    until: Array
    state: Track
    search: Track | None
    left: Array
    recent: tuple[bool, ...] = ()
    aside: Aside | None = None

    @property
    def mean(self) -> Array:
        """(n,) of the states."""
        return self.state.mean

    @property
    def covariance(self) -> Array:
        """(n, n) of the states."""
        return self.state.covariance

    @property
    def looking(self) -> Track:
        """The filter that looks for jumps."""
        return self.state if self.search is None else self.search


_SCALES = (0.125, 0.25, 0.5, 1.0, 2.0)
"""Sizes of jumps over those stated."""
_AGAIN = 2.0
"""Factor of what a hinted jump adds for a smoother: the readings that said that it came, and how large, pull at it once
more."""


@dataclass(frozen=True, eq=False)
class Jumper:
    """A body that jumps at a stated rate.

    Attributes
    ----------
    motions : tuple[int, ...]
        r numbers of all its motions that jump.
    spots : Array
        (q, r) what independent amounts of unit variance do that make the stated motions.
    root : Array
        (r, r) the motions by these amounts.
    every_s : float
        Mean time between two jumps, seconds.
    """

    motions: tuple[int, ...]
    spots: Array
    root: Array
    every_s: float


def jumpers(stated: Disturbances, may: Sequence[Candidate], otherwise: float | None = None) -> tuple[Jumper, ...]:
    """Bodies of which all motions that jump do so at a stated rate.

    Parameters
    ----------
    stated : Disturbances
        disturbances.
    may : Sequence[Candidate]
        What may jump.
    otherwise : float | None
        Seconds between two jumps of a motion of which no rate is stated; None for bodies with a rate alone.
    """
    out = []
    for body in dict.fromkeys(one.body for one in may):
        one = max((one for one in may if one.body == body), key=lambda one: len(one.motions))
        rates = [otherwise if (rate := stated.laws[k].every_s) is None else rate for k in one.motions]
        every = [rate for rate in rates if rate is not None]
        if len(every) == len(rates):
            out.append(Jumper(one.motions, one.spots, one.root, min(every)))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Hint:
    """Of a jump of a body whose size is not known, for each of L places.

    Attributes
    ----------
    log_weight : Array
        (L,) logarithm of w.
    mean : Array
        (L, r) of the amounts if it came there.
    covariance : Array
        (L, r, r) of them.
    """

    log_weight: Array
    mean: Array
    covariance: Array

    @classmethod
    def of(cls, looked: tuple[Array, Array], own: tuple[Array, Array], outputs: Array, expected: Array) -> Hint:
        """From scores and information.

        Parameters
        ----------
        looked : tuple[Array, Array]
            Score (L, q) and information (L, q, q) by which it is judged.
        own : tuple[Array, Array]
            Likewise, by which its amounts are.
        outputs : Array
            (q, r) what unit amounts do.
        expected : Array
            (L,) mean number of jumps in the gap of each place; 0 where there is no gap.
        """
        logs, means, squares = [], [], []
        for times in _SCALES:
            amounts = Amounts.of(*own, outputs, times)
            judged = amounts if looked is own else Amounts.of(*looked, outputs, times)
            logs.append(judged.log_weight)
            means.append(amounts.mean)
            squares.append(amounts.covariance + amounts.mean[:, :, None] * amounts.mean[:, None, :])
        together = np.logaddexp.reduce(logs, axis=0)
        share = np.exp(np.array(logs) - together)
        mean = np.einsum("sk,ski->ki", share, means)
        square = np.einsum("sk,skij->kij", share, squares)
        with np.errstate(divide="ignore"):
            weight = together - np.log(len(_SCALES)) + np.log(expected)
        return cls(weight, mean, square - mean[:, :, None] * mean[:, None, :])


def _chances(hints: Sequence[Hint], window: int | None = None) -> list[Array]:
    """(L,) chance p of a jump of each body at each place, one at most among so many places on either side, or all."""
    every = np.logaddexp.reduce([one.log_weight for one in hints], axis=0)
    if window is None:
        total = np.logaddexp(0.0, np.logaddexp.reduce(every))
    else:
        padded = np.pad(every, window, constant_values=-np.inf)
        near = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1)
        total = np.logaddexp(0.0, np.logaddexp.reduce(near, axis=1))
    return [np.exp(one.log_weight - total) for one in hints]


def blended(mean: Array, covariance: Array, hints: Sequence[Hint], moved: Sequence[Array]) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of states where a jump that is not told counts by its chance.

    Parameters
    ----------
    mean : Array
        (n,) of the states without one.
    covariance : Array
        (n, n) likewise.
    hints : Sequence[Hint]
        Of each body.
    moved : Sequence[Array]
        (L, n, r) of each body, what unit amounts at each place have done to the states by now.
    """
    found = _chances(hints)
    away = [np.einsum("knr,kr->kn", m, one.mean) for m, one in zip(moved, hints, strict=True)]
    shift = np.asarray(sum(p @ a for p, a in zip(found, away, strict=True)))
    out = covariance - np.outer(shift, shift)
    for chance, each, m, one in zip(found, away, moved, hints, strict=True):
        inner = np.matmul(chance[:, None, None] * m, one.covariance)
        out = out + (chance[:, None] * each).T @ each + np.tensordot(inner, m, axes=([0, 2], [0, 2]))
    return mean + shift, 0.5 * (out + out.T)


def added(
    score: Sequence[Array], information: Sequence[Array], gap: Array, bodies: Sequence[Jumper], window: int
) -> list[Array]:
    """(N, r) of each body, what a smoother takes jumps to add that were not told, over the mean square that the motions
    are stated to have at their rate.

    Parameters
    ----------
    score : Sequence[Array]
        (N, r) of each body, of unit amounts before each of N readings, by all readings.
    information : Sequence[Array]
        (N, r, r) of each, likewise.
    gap : Array
        (N,) seconds from the reading before, 0 where none is.
    bodies : Sequence[Jumper]
        That jump.
    window : int
        Readings among which one jump is looked for.
    """
    if not bodies:
        return []
    hints = []
    for one, b, j in zip(bodies, score, information, strict=True):
        own = b, j
        hints.append(Hint.of(own, own, np.eye(len(one.motions)), gap / one.every_s))
    out = []
    for one, hint, chance in zip(bodies, hints, _chances(hints, window // 2), strict=True):
        square = (hint.mean @ one.root.T) ** 2 + np.einsum("ij,kjl,il->ki", one.root, hint.covariance, one.root)
        over = np.divide(chance * one.every_s, gap, out=np.zeros_like(gap), where=gap > 0.0)
        out.append(_AGAIN * over[:, None] * square)
    return out


# chance beforehand that a reading is bad
_SHARE = 1e-3
# logarithms of the odds above which a reading is set aside, against one to which nothing has happened and against the
# first one after a jump: the second is low, since an error at one coordinate and a jump of a body that moves spots in
# any way look alike, and since nobody knows well how often readings are bad
_UNSURE, _SURE = math.log(0.05 / 0.95), math.log(1e-3)
# chance at most that a reading which was set aside counts with as the first after a jump, for the same reason
_MOST_FOR_JUMP = 0.8
# where so many of the last readings were left out, none more is: then the prior is wrong, and not the readings
RECENT, _MOST = 10, 5
# sizes of errors over the noise of a coordinate, each as likely
_ERRORS = np.array([10.0, 50.0, 250.0, 1250.0, 6250.0])
# sizes of jumps over those stated, and the logarithms of their chances
_SIZES = np.array([0.125, 0.25, 0.5, 1.0, 2.0, 8.0, 64.0])
_LOG_SIZE = np.log([0.2, 0.2, 0.2, 0.2, 0.2, 1e-2, 1e-4])
# logarithm of the chance of a step that nothing stated explains, over that of a jump of one body in the whole life
_UNSTATED = math.log(1e-3)


def may_be_bad(bad: BadReading | None, log_odds: float, recent: Sequence[bool]) -> bool:
    """Return whether a reading is set aside until the next one.

    Parameters
    ----------
    bad : BadReading | None
        What speaks for it being bad; None where nothing does.
    log_odds : float
        Logarithm of the odds of that against all else.
    recent : Sequence[bool]
        Whether each of the last readings was left out.
    """
    return bad is not None and bad.log_ratio > _UNSURE and log_odds > _SURE and sum(recent) < _MOST


def chance_good(log_odds: float) -> float:
    """Return the chance with which a reading that is set aside counts as a good one meanwhile.

    Parameters
    ----------
    log_odds : float
        Logarithm of the odds that it is bad.
    """
    return min(_MOST_FOR_JUMP, float(expit(-log_odds)))


def bad_reading(white: Array, root: Array, noise: Array) -> BadReading | None:
    """Return a reading as one with errors weighed against one without; None where it cannot be set aside.

    Parameters
    ----------
    white : Array
        (D,) root^-1 times its difference from the prediction.
    root : Array
        (D, D) Cholesky factor of the covariance of that difference.
    noise : Array
        (D, D) of the reading.
    """
    count = len(white)
    if 0.5 * float(white @ white) + math.log(_SHARE) < _UNSURE:  # no errors explain more than all of it
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
    """(D,) log likelihood ratio with errors at the 1, 2, ... coordinates that explain most."""
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


def jump_evidence(track: Track, gap: Array, bodies: Sequence[Jumper], life: float, noise: Array) -> float:
    """Logarithm of the likelihood of all readings with a jump at one of L places or none, over that with none.

    Parameters
    ----------
    track : Track
        The filter, with what steps at the L places would do.
    gap : Array
        (L,) seconds within which each comes.
    bodies : Sequence[Jumper]
        That jump.
    life : float
        Seconds in which a step that nothing explains comes with a small chance.
    noise : Array
        (D, D) of the reading, whose multiples are the sizes of such a step.
    """
    if not len(gap):
        return 0.0
    unstated = np.eye(track.score.shape[1])[:, : len(noise)] * np.sqrt(np.diag(noise))
    cases = [(unstated, _ERRORS, np.full(len(_ERRORS), _UNSTATED - math.log(len(_ERRORS) * life)))]
    cases += [(one.spots, _SIZES, _LOG_SIZE - math.log(one.every_s)) for one in bodies]
    found = [0.0]
    log_gap = np.log(np.maximum(gap, 1e-300))
    for outputs, scale, beforehand in cases:
        values, vectors = np.linalg.eigh(outputs.T @ track.information @ outputs)
        along = np.einsum("kij,ki->kj", vectors, track.score @ outputs)
        square = scale[:, None, None] ** 2
        inner = 1.0 + square * np.maximum(values, 0.0)
        gain = 0.5 * np.sum(square * along**2 / inner - np.log(inner), axis=2)
        found.append(float(logsumexp(gain + beforehand[:, None] + log_gap)))
    return float(logsumexp(found))
