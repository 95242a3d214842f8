"""Detection of jumps: steps of a body at an unknown time in a series of measurements.

Whitened shifts u = L^-1 s of a series without jumps are independent numbers of unit variance, with L the Cholesky
factor of their covariance due to all other motions and to noise. A step of amounts z of some motions between the
measurements k - 1 and k adds G_k A z to them, G_k = L^-1 (e_k x 1), e_k being 1 from measurement k on. The generalised
likelihood ratio of that step against none, its amounts being free, is

    2 log ratio = b' J^-1 b,   b = A' G_k' u,   J = A' G_k' G_k A,

which without a step is chi-square distributed with as many degrees of freedom as there are motions that the spots
observe (Willsky, Jones, IEEE Trans. Automat. Contr. 21, 1976, 108; Basseville, Nikiforov, Detection of Abrupt Changes,
1993, ch. 7). The step is tested at every measurement, with every motion alone and with all motions of a body together.
The probability of as large a ratio anywhere is at most the sum of the probabilities of all these tests (Boole's
inequality), whatever their correlations, and a jump is reported where this sum is below the specified probability: a
bound that needs no simulation, so that false alarms are rarer than specified. A detected jump becomes an event, and the
next one is searched for with it known; the last search, which finds nothing, is the one that can be wrong in a series
whose jumps have all been detected, so that further searches do not add up (as in Holm's procedure).

Jumps that are too small to be detected remain in the readings. Where the rate of jumps is known, the smoother
represents them by a random walk of their mean square.

The spots often cannot determine which body has jumped, and the effect on the line of sight depends on it. After a
detection each body is weighted by its probability, all of its motions being free, before each reading before which the
step can have occurred (`Bodies`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import gammaincc, gammaln, ndtr

from analysis.arrays import Array
from analysis.monitor.disturbances import Disturbances, TimeLaw, step_probability
from analysis.statistics import limit_of

MOST = 100
"""Largest number of jumps that are searched for in one series of measurements."""
UNOBSERVABLE = 1e-9
"""Eigenvalue of a step's information matrix, relative to the largest, that counts as unobservable.

Below it, float64 has no significant digits of the combination of motions.
"""
_UNLIKELY = 1e-4
"""Likelihood of a time of a jump, relative to the most likely time, below which that time is excluded."""
_AHEAD = 100.0
"""Length of time after the end of a series, in units of its length, over which a forecast includes further jumps."""
_AGAIN, _TWO_VALUED = 1.0, 1.5
"""Factors of a smoother's additional variance around a detected jump.

The first multiplies the part of the jump's variance that the spots observe, which counts twice: filter and smoother
both use the readings. The second multiplies the square of the jump, as the state between the readings around it is one
of two values.
"""
_INFLATIONS = np.logspace(0.0, 8.0, 161)
"""Factors by which the prior variance of a jump is increased in the search for the variance of the largest likelihood.
"""
_SIZES = np.linspace(0.0, 8.0, 401)
_MEAN_SQUARE = 2.0 * (_SIZES[1] - _SIZES[0]) * _SIZES**2 * np.exp(-0.5 * _SIZES**2) / np.sqrt(2.0 * np.pi)
"""Contribution of each size in _SIZES (in standard deviations) to the mean square of a normal number."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Motions of one body, one or all, that are tested for having jumped together.

    Dimensions: D spot coordinates (row and column of every spot), r motions of the body that may jump.

    Attributes
    ----------
    body : str
        Body of the motions.
    motions : tuple of int
        Indices of the motions among the disturbances.
    spots : (D, r) ndarray
        Spot shifts, px, due to independent amounts of unit variance that make up the motions.
    root : (r, r) ndarray
        Matrix from these amounts to the motions, in prior standard deviations.
    """

    body: str
    motions: tuple[int, ...]
    spots: Array
    root: Array


@dataclass(frozen=True, eq=False)
class Steps:
    """Score and information of a step at each of K times, from which the motions of any body are tested.

    Dimensions: D spot coordinates (row and column of every spot).

    Attributes
    ----------
    after, until : (K,) ndarray
        Interval in which the step occurs, s.
    score : (K, D) ndarray
        Score G' u, with the whitened shifts u and the whitened effect G of a unit step of each spot coordinate.
    information : (K, D, D) ndarray
        Information G' G.
    """

    after: Array
    until: Array
    score: Array
    information: Array


@dataclass(frozen=True)
class Jump:
    """Detected jump: a step of one body's motions, with its estimated sizes, time and significance.

    Attributes
    ----------
    body : str
        Body that explains it best.
    motions : tuple of int
        Indices of its motions among the disturbances.
    labels, units : tuple of str
        Names and units of these motions.
    sizes, sigmas : tuple of float
        Sizes of the jump in these units, and their standard deviations.
    after, until : float
        Times of the measurements between which it is most likely, s.
    time_distribution : tuple of (float, float)
        Pairs (time, probability that it has occurred by then), s, linear between.
    log_ratio : float
        Logarithm of the ratio of the likelihoods with it and without it.
    false_alarm : float
        Upper bound of the probability of as large a ratio anywhere in a series without a jump.
    rivals : mapping of str to float
        Best log ratio of other bodies at the same time, best first.
    times : float
        Ratio of the jump's standard deviations to the prior ones, as used by the smoother.
    parts : tuple of (tuple of int, float)
        For each body that may have jumped, its motions and its variance, relative to the prior and multiplied by the
        probability of the body; empty for the motions above alone.
    change : tuple of float
        Change of the D spot coordinates, px, and of the P parameters by the jump, whichever body it was; empty where it
        is not computed.
    spread : tuple of tuples of float
        Covariance of the error of `change`.
    width : int
        Number of spot coordinates D in `change`.
    rest : tuple of (float, int)
        Chi-square and degrees of freedom of the part of a step at the same time that no jump of this body explains.
    """

    body: str
    motions: tuple[int, ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    sizes: tuple[float, ...]
    sigmas: tuple[float, ...]
    after: float
    until: float
    time_distribution: tuple[tuple[float, float], ...]
    log_ratio: float
    false_alarm: float
    rivals: Mapping[str, float]
    times: float
    parts: tuple[tuple[tuple[int, ...], float], ...] = ()
    change: tuple[float, ...] = ()
    spread: tuple[tuple[float, ...], ...] = ()
    width: int = 0
    rest: tuple[float, int] = (0.0, 0)

    @cached_property
    def law(self) -> TimeLaw:
        """Time law of the jump once it is detected: a step with a known distribution of its time."""
        return TimeLaw(event=self.time_distribution)

    def to_dict(self) -> dict[str, Any]:
        """Return the jump as plain data for the JSON files of results."""
        amounts = zip(self.labels, self.units, self.sizes, self.sigmas, strict=True)
        return {
            "body": self.body,
            "after_s": self.after,
            "until_s": self.until,
            "sizes": [{"name": n, "unit": u, "size": z, "sigma": s} for n, u, z, s in amounts],
            "log_ratio": self.log_ratio,
            "false_alarm": self.false_alarm,
            "rivals": [{"body": body, "log_ratio": ratio} for body, ratio in self.rivals.items()],
        }


@dataclass(frozen=True, eq=False)
class Step:
    """Step of motions by unknown amounts, either at the time of a specified event or as a detected jump.

    Dimensions: D spot coordinates (row and column of every spot), P parameters.

    Attributes
    ----------
    parts : tuple of (tuple of int, float)
        Motions and variance relative to the prior of each independent part of the step.
    time_distribution : tuple of (float, float)
        Pairs (time, probability that it has occurred by then), s, in the order of time, linear between; one pair (time,
        1) for a known time.
    moment : (D + P, D + P) ndarray or None
        Mean square of its effect on the D spot coordinates and P parameters; None if that of the independent `parts`
        applies.
    """

    parts: tuple[tuple[tuple[int, ...], float], ...]
    time_distribution: tuple[tuple[float, float], ...]
    moment: Array | None = None

    @classmethod
    def of(cls, jump: Jump) -> Step:
        """Return the step of a detected jump for a smoother, with the mean square found at the detection.

        One body is assumed to have jumped. The information of the readings on the jump is used once more by the
        smoother, so that the uncertainty that they left in the spots counts twice; unobservable parts are unchanged.
        Between the readings around the jump the state is one of two values, which is not normal: half of the jump's
        square is added.
        """
        moment = None
        if jump.change:
            change = np.array(jump.change)
            spread, spots = np.array(jump.spread), slice(jump.width)
            seen = spread[:, spots] @ np.linalg.pinv(spread[spots, spots], hermitian=True) @ spread[spots]
            moment = _TWO_VALUED * np.outer(change, change) + spread + _AGAIN * seen
        return cls(jump.parts or ((jump.motions, jump.times**2),), jump.time_distribution, moment)

    def step_probability(self, time: float) -> float:
        """Return the probability that the step has occurred by a time in seconds."""
        return float(step_probability(self.time_distribution, time))


@dataclass(frozen=True, eq=False)
class Amounts:
    """Estimated amounts of a jump's motions under each of L hypotheses about its time.

    Each hypothesis is that the jump occurred just before a certain reading. The amounts are independent under the
    prior; together they make up the motions of the body.

    The fields are the means of the amounts (L, r), their covariances (L, r, r) and the log weights of the hypotheses
    (L,).

    Dimensions: r motions of the body that may jump.
    """

    mean: Array
    covariance: Array
    log_weight: Array

    @classmethod
    def of(cls, score: Array, information: Array, outputs: Array, times: float) -> Amounts:
        """Compute the amounts of a jump from the score and information of a step before each reading.

        Dimensions: L gaps between readings, in each of which a step may have occurred, q values that readings can
        contain (outputs), r motions of the body that may jump.

        Parameters
        ----------
        score : (L, q) ndarray
            Score of a step before each reading: weighted sum of the whitened readings after it.
        information : (L, q, q) ndarray
            Information (inverse covariance) on the step's effect on the outputs.
        outputs : (q, r) ndarray
            Derivatives of the outputs with respect to the r independent amounts that make up the body's motions.
        times : float
            Standard deviation of the amounts before the readings; 1 for the prior of the motions.
        """
        information = outputs.T @ information @ outputs
        score = score @ outputs
        prior = np.eye(outputs.shape[1]) / times**2
        covariance = np.asarray(np.linalg.inv(information + prior), np.float64)
        mean = np.einsum("kij,kj->ki", covariance, score)
        _, size = np.linalg.slogdet(np.eye(outputs.shape[1]) + times**2 * information)
        return cls(mean, covariance, 0.5 * (np.sum(mean * score, axis=1) - size))


def candidates(prior: Disturbances) -> tuple[Candidate, ...]:
    """Return the sets of motions that are tested for jumps: each that may jump alone, and those of a body together.

    Parameters
    ----------
    prior : Disturbances
        Prior of the disturbances; motions that move no spot are excluded.
    """
    jumping = [k for k, law in enumerate(prior.laws) if law.jump and np.any(prior.spots[:, k])]
    bodies: dict[str, list[int]] = {}
    for k in jumping:
        bodies.setdefault(prior.bodies[k], []).append(k)
    groups = [(k,) for k in jumping] + [tuple(members) for members in bodies.values() if len(members) > 1]
    out = []
    for members in groups:
        values, vectors = np.linalg.eigh(prior.correlation[np.ix_(members, members)])
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        out.append(Candidate(prior.bodies[members[0]], members, prior.spots[:, members] @ root, root))
    return tuple(out)


def steps(root: Array, white: Array, when: Array, inside: slice, reference: float | None) -> Steps:
    """Return score and information of a step between any two consecutive measurements of a series.

    Dimensions: n measurements, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    root : (n D, n D) ndarray
        Lower triangular Cholesky factor L of the covariance of all shifts, in the order of time.
    white : (n D,) ndarray
        Whitened shifts L^-1 s, with the measured shifts s.
    when : (n,) ndarray
        Times of the measurements, s, ascending.
    inside : slice
        Measurements that may be the first after the step.
    reference : float or None
        Time from which changes are counted, s; None for the calibration, and a step before the first measurement is
        then excluded.
    """
    each = len(white) // len(when)
    before = np.concatenate([[np.inf if reference is None else reference], when[:-1]])
    after = before if reference is None else np.where(when > reference, np.maximum(before, reference), before)
    at = np.arange(len(when))[inside]
    at = at[after[at] < when[at]]
    come = (when[:, None] >= when[at]).astype(np.float64)
    if reference is not None:
        come -= reference >= when[at]
    responses = solve_triangular(root, np.kron(come, np.eye(each)), lower=True).reshape(len(white), len(at), each)
    responses = responses.transpose(1, 2, 0)
    return Steps(after[at], when[at], responses @ white, responses @ responses.transpose(0, 2, 1))


def most_likely_jump(intervals: Sequence[Steps], may: Sequence[Candidate], prior: Disturbances) -> Jump | None:
    """Return the jump that is least likely to be due to chance, without its sizes; None if nothing can be tested.

    Parameters
    ----------
    intervals : sequence of Steps
        Steps at all times that are tested, one object for each section of the series.
    may : sequence of Candidate
        Candidates for jumps.
    prior : Disturbances
        Prior that contains these motions.
    """
    parts = [candidate for candidate in intervals if len(candidate.until)]
    if not parts or not may:
        return None
    score, information = (np.concatenate([getattr(p, name) for p in parts]) for name in ("score", "information"))
    after, until = (np.concatenate([getattr(p, name) for p in parts]) for name in ("after", "until"))
    squares, logs = np.empty((len(may), len(until))), np.empty((len(may), len(until)))
    for c, candidate in enumerate(may):
        values, vectors = np.linalg.eigh(candidate.spots.T @ information @ candidate.spots)
        along = np.einsum("kij,ki->kj", vectors, score @ candidate.spots)
        seen = values > UNOBSERVABLE * values.max()
        squares[c] = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
        logs[c] = _log_p_value(squares[c], np.sum(seen, axis=1))
    which, k = np.unravel_index(int(np.argmin(logs)), logs.shape)
    best = may[int(which)]
    members = list(best.motions)
    rivals: dict[str, float] = {}
    for c, candidate in enumerate(may):
        if candidate.body != best.body:
            rivals[candidate.body] = max(rivals.get(candidate.body, 0.0), 0.5 * float(squares[c, k]))
    return Jump(
        body=best.body,
        motions=best.motions,
        labels=tuple(prior.labels[m] for m in members),
        units=tuple(prior.units[m] for m in members),
        sizes=(np.nan,) * len(members),
        sigmas=(np.nan,) * len(members),
        after=float(after[k]),
        until=float(until[k]),
        time_distribution=_time_distribution(after, until, 0.5 * squares[which]),
        log_ratio=0.5 * float(squares[which, k]),
        false_alarm=float(np.exp(min(0.0, logs[which, k] + np.log(logs.size)))),
        rivals=dict(sorted(rivals.items(), key=lambda item: -item[1])),
        times=jump_scale(best.spots.T @ information[k] @ best.spots, score[k] @ best.spots),
    )


def _log_p_value(square: Array, degrees: NDArray[np.int_]) -> Array:
    """Return the natural logarithm of the probability of a larger chi-square, also where it underflows in float64."""
    half, shape = 0.5 * square, 0.5 * np.maximum(degrees, 1)
    p_value = gammaincc(shape, half)
    far = (shape - 1.0) * np.log(np.maximum(half, 1.0)) - half - gammaln(shape)
    return np.asarray(np.where(p_value > 1e-280, np.log(np.maximum(p_value, 1e-280)), far))


def _time_distribution(after: Array, until: Array, log_ratio: Array) -> tuple[tuple[float, float], ...]:
    """Return the distribution of the time of a step from its log likelihood ratio in each interval.

    It consists of pairs (time in seconds, probability that the step has occurred by then); all times have equal prior
    probability.
    """
    weight = np.exp(log_ratio - log_ratio.max())
    weight = np.where(weight < _UNLIKELY, 0.0, weight * (until - after))
    return knots(after, until, weight / weight.sum())


def knots(after: Array, until: Array, weight: Array) -> tuple[tuple[float, float], ...]:
    """Return pairs (time, probability that a step has occurred by then), with linear interpolation between them.

    Dimensions: L gaps between readings, in each of which a step may have occurred.

    Parameters
    ----------
    after : (L,) ndarray
        Start of the interval in which the step occurs, s, ascending.
    until : (L,) ndarray
        End of that interval, s.
    weight : (L,) ndarray
        Probability of each interval; their sum is 1.
    """
    sure = np.minimum(np.cumsum(weight), 1.0)
    out: dict[float, float] = {}
    for k in np.flatnonzero(weight):
        out.setdefault(float(after[k]), float(sure[k - 1]) if k else 0.0)
        out[float(until[k])] = float(sure[k])
    return tuple(sorted(out.items()))


def jump_scale(information: Array, score: Array) -> float:
    """Return the ratio of a jump's most likely standard deviation to the prior one.

    It is at least the size of the jump itself, and at least 1.

    Parameters
    ----------
    information : (r, r) ndarray
        Information (inverse covariance) of the readings on the jump's r amounts.
    score : (r,) ndarray
        Score of these amounts: information times their estimate.
    """
    values, vectors = np.linalg.eigh(information)
    values, along = np.maximum(values, 0.0), vectors.T @ score
    added = _INFLATIONS[:, None] * values
    gain = 0.5 * np.sum(_INFLATIONS[:, None] * along**2 / (1.0 + added) - np.log1p(added), axis=1)
    variance = _INFLATIONS[int(np.argmax(gain))]
    size = variance * along / (1.0 + variance * values)
    return float(np.sqrt(max(1.0, variance, size @ size)))


def with_jumps(prior: Disturbances, jumps: Sequence[Jump]) -> Disturbances:
    """Return the prior with a step of the same motions, of known distribution in time, added for each detected jump.

    Parameters
    ----------
    prior : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    jumps : sequence of Jump
        Jumps of their motions.
    """
    for jump in jumps:
        prior = prior.with_copies(jump.motions, jump.times, jump.law)
    return prior


def subthreshold_share(limit: float, seen: Array) -> Array:
    """Return the fraction of the mean square of normally distributed jumps that is due to undetected ones, (n,).

    Dimensions: n jumps.

    Parameters
    ----------
    limit : float
        Detection limit, in standard deviations of the measured jump.
    seen : (n,) ndarray
        Size of a jump of one prior standard deviation, in the standard deviations of the measured jump.
    """
    return np.asarray(ndtr(limit - _SIZES * seen[:, None]) @ _MEAN_SQUARE)


def with_subthreshold_jumps(
    model: Disturbances, intervals: Sequence[Steps], prior: Disturbances, looks: int, last: float
) -> Disturbances:
    """Return the prior with a random walk for jumps too small to be detected, for motions with a known jump rate.

    The variance of the walk grows by the mean square of such steps, faster where measurements are few.

    Parameters
    ----------
    model : Disturbances
        Prior with the detected jumps.
    intervals : sequence of Steps
        Steps at all times, with those jumps known.
    prior : Disturbances
        Original prior, whose motions are the first of ``model``.
    looks : int
        Number of tests of the search.
    last : float
        Time of the last measurement, s, after which no jump is detected.
    """
    after, until, information = (
        np.concatenate([getattr(part, name) for part in intervals]) for name in ("after", "until", "information")
    )
    if not looks or not len(until):
        return model
    limit = float(np.sqrt(limit_of(prior.jump_false_alarm / looks, 1)))
    for k, law in enumerate(prior.laws):
        if law.every_s is None:
            continue
        column = prior.spots[:, k]
        detectability = np.sqrt(np.maximum(column @ information @ column, 0.0))
        left = subthreshold_share(limit, detectability)
        variance = np.cumsum(left * (until - after)) / law.every_s
        ahead = _AHEAD * (last - float(after[0]))
        knots = [(float(after[0]), 0.0), *zip(until.tolist(), variance.tolist(), strict=True)]
        knots.append((last + ahead, float(variance[-1]) + ahead / law.every_s))
        model = model.with_copies((k,), 1.0, TimeLaw(event=tuple(knots)))
    return model


def with_sizes(
    jump: Jump, disturbances: Disturbances, root: Array, white: Array, when: Array, reference: float | None
) -> Jump:
    """Return the jump with its sizes, estimated from all measurements with all other jumps known.

    Dimensions: n measurements, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    jump : Jump
        Jump of some motions.
    disturbances : Disturbances
        Prior that contains these motions.
    root : (n D, n D) ndarray
        Lower triangular Cholesky factor L of the covariance of all shifts, with all detected jumps as events.
    white : (n D,) ndarray
        Whitened shifts L^-1 s, with the measured shifts s.
    when : (n,) ndarray
        Times of the measurements, s.
    reference : float or None
        Time from which changes are counted, s; None for the calibration.
    """
    members = list(jump.motions)
    prior = jump.times**2 * disturbances.correlation[np.ix_(members, members)]
    occurred_before = 0.0 if reference is None else float(jump.law.step_probability(reference))
    occurred = jump.law.step_probability(when) - occurred_before
    weights = solve_triangular(root, np.kron(occurred[:, None], disturbances.spots[:, members] @ prior), lower=True)
    sizes = disturbances.sigmas[members] * (weights.T @ white)
    left = np.maximum(np.diag(prior) - np.sum(weights**2, axis=0), 0.0)
    return replace(
        jump, sizes=tuple(sizes.tolist()), sigmas=tuple((disturbances.sigmas[members] * np.sqrt(left)).tolist())
    )


@dataclass(frozen=True, eq=False)
class Bodies:
    """Hypotheses after a detected jump: which of B bodies has jumped, and before which of L readings.

    Attributes
    ----------
    candidates : tuple of Candidate
        For each body, all of its motions that may jump.
    times : tuple of float
        Ratio of the standard deviations assumed for each body's jump to the prior ones.
    weight : (B, L) ndarray
        Probability of each hypothesis (body and reading); their sum is 1.
    judged : tuple of Amounts
        Estimated amounts of the jump, by the filter that detects jumps.
    amounts : tuple of Amounts
        Estimated amounts of the jump, by the filter of the estimate.
    """

    candidates: tuple[Candidate, ...]
    times: tuple[float, ...]
    weight: Array
    judged: tuple[Amounts, ...]
    amounts: tuple[Amounts, ...]

    @classmethod
    def of(
        cls,
        may: Sequence[Candidate],
        jump: Jump,
        until: Array,
        gap: Array,
        looking: tuple[Array, Array],
        state: tuple[Array, Array],
    ) -> Bodies:
        """Return all hypotheses that are not much less likely than the most likely one.

        Dimensions: L gaps between readings, in each of which a step may have occurred, q values that readings can
        contain (outputs).

        Parameters
        ----------
        may : sequence of Candidate
            Candidates for jumps.
        jump : Jump
            Detected jump.
        until : (L,) ndarray
            Times of the readings, s.
        gap : (L,) ndarray
            Time since the reading before each, s.
        looking : tuple of ndarray
            Score (L, q) and information (L, q, q) of a step in each gap, which give the probabilities of bodies and
            gaps.
        state : tuple of ndarray
            Score and information that give the amounts for the estimate.
        """
        interval, out = int(np.argmin(np.abs(until - jump.until))), []
        for body in dict.fromkeys(c.body for c in may):
            c = max((c for c in may if c.body == body), key=lambda c: len(c.motions))
            evidence = c.spots.T @ looking[1][interval] @ c.spots, looking[0][interval] @ c.spots
            times = jump.times if body == jump.body else jump_scale(*evidence)
            out.append((c, times, Amounts.of(*looking, c.spots, times), Amounts.of(*state, c.spots, times)))
        logs = np.array([judged.log_weight for _, _, judged, _ in out])
        weight = np.exp(logs - logs.max()) * gap
        weight = np.where(weight > _UNLIKELY * weight.max(), weight, 0.0)
        likely = np.flatnonzero(weight.sum(axis=1))
        bodies, times_of, judged, amounts = zip(*(out[b] for b in likely), strict=True)
        return cls(bodies, times_of, weight[likely] / weight.sum(), judged, amounts)

    @property
    def spots(self) -> list[Array]:
        """Derivatives of the q outputs with respect to the r amounts of a jump, one array (q, r) for each body.

        Outputs are the values that readings can contain.

        Dimensions: r motions of the body that may jump.
        """
        return [candidate.spots for candidate in self.candidates]

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], float], ...]:
        """For each body, the indices of its motions and their relative variance times the body's probability."""
        probability = self.weight.sum(axis=1)
        rows = zip(self.candidates, probability.tolist(), self.times, strict=True)
        return tuple((candidate.motions, share * times**2) for candidate, share, times in rows)

    def known(
        self, mean: Array, covariance: Array, response: Array, levels: Sequence[Array], amounts: Sequence[Amounts]
    ) -> tuple[Array, Array]:
        """Return mean (n,) and covariance (n, n) that a filter would have if it had known of the jump from its start.

        Dimensions: n states of the filter, L gaps between readings, in each of which a step may have occurred, q values
        that readings can contain (outputs), r motions of the body that may jump.

        Parameters
        ----------
        mean : (n,) ndarray
            Mean of the filter.
        covariance : (n, n) ndarray
            Covariance of the filter.
        response : (L, n, q) ndarray
            Change of the mean by a step before each reading that shifts each output by one unit.
        levels : sequence of (n, r) ndarrays
            For each body, derivatives of the states with respect to the r amounts of a jump.
        amounts : sequence of Amounts
            Estimated amounts of the jump, for each body.
        """
        moved = [level - response @ effect for level, effect in zip(levels, self.spots, strict=True)]
        return jump_mixture(mean, covariance, self.weight, amounts, moved)


def jump_mixture(
    mean: Array, covariance: Array, weight: Sequence[Array] | Array, amounts: Sequence[Amounts], moved: Sequence[Array]
) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of states with one of several jumps, weighted by its probability.

    Dimensions: n states of the filter, L gaps between readings, in each of which a step may have occurred, r motions of
    the body that may jump.

    Parameters
    ----------
    mean : (n,) ndarray
        Mean of the states without a jump.
    covariance : (n, n) ndarray
        Covariance of the states without a jump.
    weight : sequence of (L,) ndarrays
        For each body, the probability of a jump in each gap.
    amounts : sequence of Amounts
        For each body, means (L, r) and covariances (L, r, r) of the amounts of a jump.
    moved : sequence of (L, n, r) ndarrays
        For each body, derivatives of the states with respect to the amounts.
    """
    shift, spread = np.zeros(len(mean)), np.zeros(covariance.shape)
    for amount, share, effect in zip(amounts, weight, moved, strict=True):
        each = np.einsum("knr,kr->kn", effect, amount.mean)
        shift += share @ each
        spread += (share[:, None] * each).T @ each
        inner = np.matmul(share[:, None, None] * effect, amount.covariance)
        spread += np.tensordot(inner, effect, axes=([0, 2], [0, 2]))
    out = covariance + spread - np.outer(shift, shift)
    return mean + shift, 0.5 * (out + out.T)


def mixture_moments(amounts: Sequence[Amounts], effects: Sequence[Array], weight: Array) -> tuple[Array, Array]:
    """Return mean and covariance of the effect of a jump, averaged over the hypotheses by their probabilities.

    Dimensions: o values affected by the jump, r motions of the body that may jump.

    Parameters
    ----------
    amounts : sequence of Amounts
        Amounts of each of B bodies if it has jumped before each of L readings.
    effects : sequence of (o, r) ndarrays
        For each body, derivatives of the o values with respect to the r amounts of its jump.
    weight : (B, L) ndarray
        Probability of each hypothesis (body and reading); their sum is 1.
    """
    each = np.stack([amount.mean @ effect.T for amount, effect in zip(amounts, effects, strict=True)])
    mean = np.einsum("bk,bko->o", weight, each)
    away = each - mean
    spread = np.einsum("bk,bko,bkp->op", weight, away, away)
    for amount, effect, share in zip(amounts, effects, weight, strict=True):
        spread += effect @ np.einsum("k,krs->rs", share, amount.covariance) @ effect.T
    return mean, spread
