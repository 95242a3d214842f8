"""Jumps: steps of a body at a time that nobody knows, found in a series of measurements.

Whitened shifts u = L^-1 s of a series in which nothing jumps are independent numbers of unit variance, with L the
Cholesky factor of their covariance by all else that moves and by noise. A step of amounts z of some motions between the
measurements k - 1 and k adds G_k A z to them, G_k = L^-1 (e_k x 1), e_k being 1 from measurement k on. The generalised
likelihood ratio of that step against none, its amounts being free, is

    2 log ratio = b' J^-1 b,   b = A' G_k' u,   J = A' G_k' G_k A,

which without a step is chi-square of as many degrees of freedom as the spots see motions (Willsky, Jones, IEEE Trans.
Automat. Contr. 21, 1976, 108; Basseville, Nikiforov, Detection of Abrupt Changes, 1993, ch. 7). It is looked for at
every measurement, with every motion alone and with all motions of a body together. The chance of as large a ratio
anywhere is at most the sum of the chances of all these looks (Boole's inequality), whatever their correlations, and a
jump is reported where this sum is below the chance that is stated: a bound that needs no simulation, and from which
false alarms are rarer than stated. A jump that was found becomes an event, and the next one is looked for in what that
leaves; the last look, the one that finds nothing, is the one that can be wrong in a series whose jumps have all been
found, so that further looks do not add up (as in Holm's procedure).

Jumps that are too small to be found remain in the readings. Where it is stated how often a motion jumps, the smoother
takes them for a walk of their mean square.

Whose jump it was: a jump that was told, by the chances of all bodies and places that can explain it.

Which body jumped the spots often cannot tell, and what it did to the line depends on it. Each body counts by its
chance, all of its motions being free, before each reading before which the step can have come.
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
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.statistics import limit_of

MOST = 100
"""Jumps that are looked for in one series."""
UNSEEN = 1e-9
"""Of the largest eigenvalue of J, in standard deviations that are stated: what the spots see less of is not looked for,
since there float64 leaves nothing of it."""
_UNLIKELY = 1e-4
"""Likelihood over that of the likeliest time, below which the step did not come at a time."""
_AHEAD = 100.0
"""Lengths of the series after its end for which a forecast knows that jumps go on."""
_AGAIN, _TWO_VALUED = 1.0, 1.5
"""Times that, for a smoother, what spots leave unknown of a told jump counts once more, and what it did counts."""
_INFLATIONS = np.logspace(0.0, 8.0, 161)
"""By how much the variance of a jump is tried to be larger than stated."""
_SIZES = np.linspace(0.0, 8.0, 401)
_MEAN_SQUARE = 2.0 * (_SIZES[1] - _SIZES[0]) * _SIZES**2 * np.exp(-0.5 * _SIZES**2) / np.sqrt(2.0 * np.pi)
"""Shares of the mean square of a normal number by its size in standard deviations."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Motions that may jump together.

    Attributes
    ----------
    body : str
        Whose they are.
    motions : tuple[int, ...]
        Their numbers among the disturbances.
    spots : Array
        (D, r) px, for independent amounts of unit variance that make the stated motions.
    root : Array
        (r, r) the motions by these amounts.
    """

    body: str
    motions: tuple[int, ...]
    spots: Array
    root: Array


@dataclass(frozen=True, eq=False)
class Steps:
    """Of steps at K times, what all of them need; `likeliest` takes it for motions of any body.

    Attributes
    ----------
    after, until : Array
        (K,) the step comes after the one and not after the other, seconds.
    score : Array
        (K, D) G' u.
    information : Array
        (K, D, D) G' G.
    """

    after: Array
    until: Array
    score: Array
    information: Array


@dataclass(frozen=True)
class Jump:
    """A jump that was found.

    Attributes
    ----------
    body : str
        That explains it best.
    motions : tuple[int, ...]
        Numbers of its motions among the disturbances; labels, units: theirs.
    sizes : tuple[float, ...]
        Of the jump in these units; sigmas: their standard deviations.
    after, until : float
        Between which measurements it is likeliest, seconds.
    chances : tuple[tuple[float, float], ...]
        (time, chance that it has come by then), seconds, linear between.
    log_ratio : float
        Of the likelihoods with it and without it.
    chance : float
        Of as large a ratio anywhere in the series if nothing jumps, at most.
    rivals : Mapping[str, float]
        Other bodies -> their best log ratio at the same time, best first.
    times : float
        Standard deviations of the jump over those stated, which the smoother takes it to have.
    parts : tuple[tuple[tuple[int, ...], float], ...]
        (motions, variance) of each body that may have jumped, over that stated and times the chance that it was this
        body; empty for the motions above alone.
    change : tuple[float, ...]
        (D + P) of the spots, px, and of the parameters by the jump, whichever body it was; empty where that is not
        worked out. spread: covariance of its error; width: D.
    rest : tuple[float, int]
        Chi-square and degrees of freedom of what no jump of this body explains of a step at the same time.
    """

    body: str
    motions: tuple[int, ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    sizes: tuple[float, ...]
    sigmas: tuple[float, ...]
    after: float
    until: float
    chances: tuple[tuple[float, float], ...]
    log_ratio: float
    chance: float
    rivals: Mapping[str, float]
    times: float
    parts: tuple[tuple[tuple[int, ...], float], ...] = ()
    change: tuple[float, ...] = ()
    spread: tuple[tuple[float, ...], ...] = ()
    width: int = 0
    rest: tuple[float, int] = (0.0, 0)

    @cached_property
    def law(self) -> TimeLaw:
        """What it is once it was found."""
        return TimeLaw(event=self.chances)

    def to_dict(self) -> dict[str, Any]:
        """As JSON files have it."""
        amounts = zip(self.labels, self.units, self.sizes, self.sigmas, strict=True)
        return {
            "body": self.body,
            "after_s": self.after,
            "until_s": self.until,
            "sizes": [{"name": n, "unit": u, "size": z, "sigma": s} for n, u, z, s in amounts],
            "log_ratio": self.log_ratio,
            "false_alarm": self.chance,
            "rivals": [{"body": body, "log_ratio": ratio} for body, ratio in self.rivals.items()],
        }


@dataclass(frozen=True, eq=False)
class Step:
    """Motions that step once, by amounts that nobody knows: at an event, or a jump that was told.

    Attributes
    ----------
    parts : tuple[tuple[tuple[int, ...], float], ...]
        (motions, variance over that stated) of what steps, independent of each other.
    chances : tuple[tuple[float, float], ...]
        (time, chance that it has come by then) in the order of time, linear between; one entry (time, 1) for a known
        moment, seconds.
    moment : Array | None
        (D + P, D + P) mean square of what it does to spots and parameters; None for that of independent parts.
    """

    parts: tuple[tuple[tuple[int, ...], float], ...]
    chances: tuple[tuple[float, float], ...]
    moment: Array | None = None

    @classmethod
    def of(cls, jump: Jump) -> Step:
        """Of a jump that was told, for a smoother: its mean square as it was found, one body having made it. What the
        readings said of it they will say once more, so that what they left unknown of what spots see counts twice; what
        spots do not see stays as it is. Between the readings around it the state is one of two, the jump away from each
        other, and no normal: half of its square more.
        """
        moment = None
        if jump.change:
            change = np.array(jump.change)
            spread, spots = np.array(jump.spread), slice(jump.width)
            seen = spread[:, spots] @ np.linalg.pinv(spread[spots, spots], hermitian=True) @ spread[spots]
            moment = _TWO_VALUED * np.outer(change, change) + spread + _AGAIN * seen
        return cls(jump.parts or ((jump.motions, jump.times**2),), jump.chances, moment)

    def come(self, time: float) -> float:
        """Chance that it has come by a time, seconds."""
        at, chance = np.array(self.chances).T
        if len(at) == 1:
            return float((time >= at[0]) * chance[0])
        return float(np.interp(time, at, chance))


@dataclass(frozen=True, eq=False)
class Amounts:
    """How much motions have jumped, for each place of the step: mean (L, r), covariance (L, r, r), log weights (L,)."""

    mean: Array
    covariance: Array
    log_weight: Array

    @classmethod
    def of(cls, score: Array, information: Array, outputs: Array, times: float) -> Amounts:
        """By what is known of steps.

        Parameters
        ----------
        score : Array
            (L, q) as of `Steps`.
        information : Array
            (L, q, q) likewise.
        outputs : Array
            (q, r) what the motions do.
        times : float
            Their standard deviations over those of ``outputs``.
        """
        information = outputs.T @ information @ outputs
        score = score @ outputs
        prior = np.eye(outputs.shape[1]) / times**2
        covariance = np.asarray(np.linalg.inv(information + prior), np.float64)
        mean = np.einsum("kij,kj->ki", covariance, score)
        _, size = np.linalg.slogdet(np.eye(outputs.shape[1]) + times**2 * information)
        return cls(mean, covariance, 0.5 * (np.sum(mean * score, axis=1) - size))


def candidates(stated: Disturbances) -> tuple[Candidate, ...]:
    """What may jump: each motion whose law is `jump` alone, and those of a body together.

    Parameters
    ----------
    stated : Disturbances
        Disturbances; motions that move no spot are left out.
    """
    jumping = [k for k, law in enumerate(stated.laws) if law.jump and np.any(stated.spots[:, k])]
    bodies: dict[str, list[int]] = {}
    for k in jumping:
        bodies.setdefault(stated.bodies[k], []).append(k)
    groups = [(k,) for k in jumping] + [tuple(own) for own in bodies.values() if len(own) > 1]
    out = []
    for own in groups:
        values, vectors = np.linalg.eigh(stated.correlation[np.ix_(own, own)])
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        out.append(Candidate(stated.bodies[own[0]], own, stated.spots[:, own] @ root, root))
    return tuple(out)


def steps(root: Array, white: Array, when: Array, inside: slice, reference: float | None) -> Steps:
    """Steps between any two measurements that follow each other.

    Parameters
    ----------
    root : Array
        L, (n D, n D) lower triangular.
    white : Array
        (n D,) L^-1 s.
    when : Array
        (n,) times of the measurements, seconds, ascending.
    inside : slice
        Measurements of which each may be the first after the step; of all, of the piece that is looked at.
    reference : float | None
        From when changes are counted, seconds; None for the calibration, and a step before the first measurement is
        then no step.
    """
    each = len(white) // len(when)
    before = np.concatenate([[np.inf if reference is None else reference], when[:-1]])
    after = before if reference is None else np.where(when > reference, np.maximum(before, reference), before)
    at = np.arange(len(when))[inside]
    at = at[after[at] < when[at]]
    come = (when[:, None] >= when[at]).astype(np.float64)
    if reference is not None:
        come -= reference >= when[at]
    every = solve_triangular(root, np.kron(come, np.eye(each)), lower=True).reshape(len(white), len(at), each)
    every = every.transpose(1, 2, 0)
    return Steps(after[at], when[at], every @ white, every @ every.transpose(0, 2, 1))


def likeliest(found: Sequence[Steps], may: Sequence[Candidate], stated: Disturbances) -> Jump | None:
    """The jump that is hardest to explain by chance; None where nothing can be looked for. Its sizes are not yet known.

    Parameters
    ----------
    found : Sequence[Steps]
        Steps at all times that are looked at, piece by piece.
    may : Sequence[Candidate]
        What may jump.
    stated : Disturbances
        Disturbances that have these motions.
    """
    parts = [one for one in found if len(one.until)]
    if not parts or not may:
        return None
    score, information = (np.concatenate([getattr(p, name) for p in parts]) for name in ("score", "information"))
    after, until = (np.concatenate([getattr(p, name) for p in parts]) for name in ("after", "until"))
    squares, logs = np.empty((len(may), len(until))), np.empty((len(may), len(until)))
    for c, one in enumerate(may):
        values, vectors = np.linalg.eigh(one.spots.T @ information @ one.spots)
        along = np.einsum("kij,ki->kj", vectors, score @ one.spots)
        seen = values > UNSEEN * values.max()
        squares[c] = np.sum(np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0), axis=1)
        logs[c] = _log_chance(squares[c], np.sum(seen, axis=1))
    which, k = np.unravel_index(int(np.argmin(logs)), logs.shape)
    best = may[int(which)]
    own = list(best.motions)
    rivals: dict[str, float] = {}
    for c, one in enumerate(may):
        if one.body != best.body:
            rivals[one.body] = max(rivals.get(one.body, 0.0), 0.5 * float(squares[c, k]))
    return Jump(
        body=best.body,
        motions=best.motions,
        labels=tuple(stated.labels[m] for m in own),
        units=tuple(stated.units[m] for m in own),
        sizes=(np.nan,) * len(own),
        sigmas=(np.nan,) * len(own),
        after=float(after[k]),
        until=float(until[k]),
        chances=_chances(after, until, 0.5 * squares[which]),
        log_ratio=0.5 * float(squares[which, k]),
        chance=float(np.exp(min(0.0, logs[which, k] + np.log(logs.size)))),
        rivals=dict(sorted(rivals.items(), key=lambda item: -item[1])),
        times=larger(best.spots.T @ information[k] @ best.spots, score[k] @ best.spots),
    )


def _log_chance(square: Array, degrees: NDArray[np.int_]) -> Array:
    """Logarithm of the chance of a larger chi-square, also where the chance is too small for float64."""
    half, shape = 0.5 * square, 0.5 * np.maximum(degrees, 1)
    chance = gammaincc(shape, half)
    far = (shape - 1.0) * np.log(np.maximum(half, 1.0)) - half - gammaln(shape)
    return np.asarray(np.where(chance > 1e-280, np.log(np.maximum(chance, 1e-280)), far))


def _chances(after: Array, until: Array, log_ratio: Array) -> tuple[tuple[float, float], ...]:
    """When the step came, all times between the first and the last being as likely before the measurements."""
    weight = np.exp(log_ratio - log_ratio.max())
    weight = np.where(weight < _UNLIKELY, 0.0, weight * (until - after))
    return knots(after, until, weight / weight.sum())


def knots(after: Array, until: Array, weight: Array) -> tuple[tuple[float, float], ...]:
    """(time, chance that a step has come by then), linear between.

    Parameters
    ----------
    after : Array
        (L,) seconds, ascending; the step comes after the one and not after the other.
    until : Array
        (L,) likewise.
    weight : Array
        (L,) chances of each place, together 1.
    """
    sure = np.minimum(np.cumsum(weight), 1.0)
    out: dict[float, float] = {}
    for k in np.flatnonzero(weight):
        out.setdefault(float(after[k]), float(sure[k - 1]) if k else 0.0)
        out[float(until[k])] = float(sure[k])
    return tuple(sorted(out.items()))


def larger(information: Array, score: Array) -> float:
    """Standard deviation over that stated that makes a jump most likely, not less than the jump itself, nor than 1.

    Parameters
    ----------
    information : Array
        (r, r) of its amounts.
    score : Array
        (r,) of them.
    """
    values, vectors = np.linalg.eigh(information)
    values, along = np.maximum(values, 0.0), vectors.T @ score
    added = _INFLATIONS[:, None] * values
    gain = 0.5 * np.sum(_INFLATIONS[:, None] * along**2 / (1.0 + added) - np.log1p(added), axis=1)
    variance = _INFLATIONS[int(np.argmax(gain))]
    size = variance * along / (1.0 + variance * values)
    return float(np.sqrt(max(1.0, variance, size @ size)))


def with_jumps(stated: Disturbances, found: Sequence[Jump]) -> Disturbances:
    """Disturbances in which jumps that were found are events, after all that was stated and in this order.

    Parameters
    ----------
    stated : Disturbances
        disturbances.
    found : Sequence[Jump]
        Jumps of their motions.
    """
    for one in found:
        stated = stated.with_copies(one.motions, one.times, one.law)
    return stated


def untold_share(limit: float, seen: Array) -> Array:
    """(n,) share of the mean square of normal jumps that is of those which are not told.

    Parameters
    ----------
    limit : float
        Standard deviations from which on a jump is told.
    seen : Array
        (n,) standard deviations by which a jump of the stated size is seen.
    """
    return np.asarray(ndtr(limit - _SIZES * seen[:, None]) @ _MEAN_SQUARE)


def with_unfound(
    model: Disturbances, found: Sequence[Steps], stated: Disturbances, looks: int, last: float
) -> Disturbances:
    """Disturbances with what jumps leave that are too small to be found, where it is stated how often a motion jumps: a
    walk whose variance grows by the mean square of such steps, the more where measurements are few.

    Parameters
    ----------
    model : Disturbances
        Disturbances with the jumps that were found.
    found : Sequence[Steps]
        Steps at all times, with those jumps known.
    stated : Disturbances
        Disturbances as stated, which the first motions of ``model`` are.
    looks : int
        Of the search.
    last : float
        Time of the last measurement, seconds; from there on no jump is found.
    """
    after, until, information = (
        np.concatenate([getattr(one, name) for one in found]) for name in ("after", "until", "information")
    )
    if not looks or not len(until):
        return model
    limit = float(np.sqrt(limit_of(stated.jump_false_alarm / looks, 1)))
    for k, law in enumerate(stated.laws):
        if law.every_s is None:
            continue
        column = stated.spots[:, k]
        seen = np.sqrt(np.maximum(column @ information @ column, 0.0))
        left = untold_share(limit, seen)
        grown = np.cumsum(left * (until - after)) / law.every_s
        ahead = _AHEAD * (last - float(after[0]))
        knots = [(float(after[0]), 0.0), *zip(until.tolist(), grown.tolist(), strict=True)]
        knots.append((last + ahead, float(grown[-1]) + ahead / law.every_s))
        model = model.with_copies((k,), 1.0, TimeLaw(event=tuple(knots)))
    return model


def sized(one: Jump, stated: Disturbances, root: Array, white: Array, when: Array, reference: float | None) -> Jump:
    """The jump with its sizes, as all measurements and all other jumps leave them.

    Parameters
    ----------
    one : Jump
        a jump of some motions.
    stated : Disturbances
        Disturbances that have these motions.
    root : Array
        L, with all jumps that were found as events.
    white : Array
        L^-1 s.
    when : Array
        Times of the measurements, seconds.
    reference : float | None
        From when changes are counted, seconds; None for the calibration.
    """
    own = list(one.motions)
    prior = one.times**2 * stated.correlation[np.ix_(own, own)]
    come = one.law.come(when) - (0.0 if reference is None else float(one.law.come(reference)))
    weights = solve_triangular(root, np.kron(come[:, None], stated.spots[:, own] @ prior), lower=True)
    sizes = stated.sigmas[own] * (weights.T @ white)
    left = np.maximum(np.diag(prior) - np.sum(weights**2, axis=0), 0.0)
    return replace(one, sizes=tuple(sizes.tolist()), sigmas=tuple((stated.sigmas[own] * np.sqrt(left)).tolist()))


@dataclass(frozen=True, eq=False)
class Bodies:
    """Bodies that may have jumped, B of them, before each of L readings.

    Attributes
    ----------
    own : tuple[Candidate, ...]
        All motions of each that may jump.
    times : tuple[float, ...]
        (B,) standard deviations of its jump over those stated.
    weight : Array
        (B, L) chances, together 1.
    judged : tuple[Amounts, ...]
        Amounts by the filter that looks for jumps; amounts: by the other.
    """

    own: tuple[Candidate, ...]
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
        """All that are not much less likely than the likeliest.

        Parameters
        ----------
        may : Sequence[Candidate]
            What may jump.
        jump : Jump
            That was told.
        until : Array
            (L,) times of the readings, seconds.
        gap : Array
            (L,) seconds from the reading before each.
        looking : tuple[Array, Array]
            Score (L, q) and information (L, q, q) by which bodies and places are judged.
        state : tuple[Array, Array]
            Likewise, by which amounts are for the estimate.
        """
        place, found = int(np.argmin(np.abs(until - jump.until))), []
        for body in dict.fromkeys(one.body for one in may):
            one = max((one for one in may if one.body == body), key=lambda one: len(one.motions))
            known = one.spots.T @ looking[1][place] @ one.spots, looking[0][place] @ one.spots
            times = jump.times if body == jump.body else larger(*known)
            found.append((one, times, Amounts.of(*looking, one.spots, times), Amounts.of(*state, one.spots, times)))
        logs = np.array([judged.log_weight for _, _, judged, _ in found])
        weight = np.exp(logs - logs.max()) * gap
        weight = np.where(weight > _UNLIKELY * weight.max(), weight, 0.0)
        kept = np.flatnonzero(weight.sum(axis=1))
        own, times_of, judged, amounts = zip(*(found[b] for b in kept), strict=True)
        return cls(own, times_of, weight[kept] / weight.sum(), judged, amounts)

    @property
    def spots(self) -> list[Array]:
        """(q, r) of each what unit amounts do to the outputs that are read."""
        return [one.spots for one in self.own]

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], float], ...]:
        """Motions of each, and their variance over that stated times the chance that it was this body."""
        chance = self.weight.sum(axis=1)
        every = zip(self.own, chance.tolist(), self.times, strict=True)
        return tuple((one.motions, share * times**2) for one, share, times in every)

    def known(
        self, mean: Array, covariance: Array, response: Array, levels: Sequence[Array], amounts: Sequence[Amounts]
    ) -> tuple[Array, Array]:
        """States of a filter as if it had known of the jump: mean (n,) and covariance (n, n), over bodies and places.

        Parameters
        ----------
        mean : Array
            (n,) of the filter.
        covariance : Array
            (n, n) of it.
        response : Array
            (L, n, q) of the mean to steps of unit outputs at each place.
        levels : Sequence[Array]
            (n, r) of each body, what unit amounts do to the states.
        amounts : Sequence[Amounts]
            Of each.
        """
        shift, spread = np.zeros(len(mean)), np.zeros(covariance.shape)
        for one, share, level, does in zip(amounts, self.weight, levels, self.spots, strict=True):
            moved = level - response @ does
            each = np.einsum("knr,kr->kn", moved, one.mean)
            shift += share @ each
            spread += (share[:, None] * each).T @ each
            inner = np.matmul(share[:, None, None] * moved, one.covariance)
            spread += np.tensordot(inner, moved, axes=([0, 2], [0, 2]))
        out = covariance + spread - np.outer(shift, shift)
        return mean + shift, 0.5 * (out + out.T)


def mixed(amounts: Sequence[Amounts], does: Sequence[Array], weight: Array) -> tuple[Array, Array]:
    """Mean and covariance of what jumps do, each body and place counting by its chance.

    Parameters
    ----------
    amounts : Sequence[Amounts]
        Of B bodies at L places.
    does : Sequence[Array]
        (o, r) of each body, what unit amounts do.
    weight : Array
        (B, L) chances, together 1.
    """
    each = np.stack([one.mean @ do.T for one, do in zip(amounts, does, strict=True)])
    mean = np.einsum("bk,bko->o", weight, each)
    away = each - mean
    spread = np.einsum("bk,bko,bkp->op", weight, away, away)
    for one, do, share in zip(amounts, does, weight, strict=True):
        spread += do @ np.einsum("k,krs->rs", share, one.covariance) @ do.T
    return mean, spread
