"""A whole series of readings: forward one by one, as they came, then backward for what all of them say of times past.

The smoother goes backwards over the same readings (Bryson, Frazier; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085): it
needs no inverse of a covariance, and of the filter only what is of the size of a reading. It is worked in pieces, the
filter being run a second time in each, so that memory does not grow with states times readings.

On its way it has score and information of a step before every reading, by all readings (de Jong, Penzer, J. Am. Stat.
Assoc. 93, 1998, 796): a first way back finds what jumps the readings hint at that were not told (`untold_jumps`), and
the second takes these for steps of their chances and sizes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array
from analysis.monitor.filter_state import Belief, Observed, Whitened
from analysis.monitor.series_filter import SeriesFilter
from analysis.monitor.untold_jumps import added

T = TypeVar("T")
_PIECE = 400
"""Readings whose covariances are held at once."""


def hinted(
    how: SeriesFilter, knowing: SeriesFilter, start: Belief, observed: Sequence[Observed], left: Sequence[Array]
) -> tuple[Belief, list[Array]]:
    """What is known before the first reading, and N times (m,) what share of the mean square of jumps could not be
    told, with jumps that all readings hint at.

    Args:
        how: the filter that looked for jumps.
        knowing: the same, which looks for none but knows of those that were told.
        start: as for `smoothed`.
        observed: N readings in the order of time.
        left: as for `smoothed`.
    """
    if not how.jumpers or not observed:
        return start, list(left)
    at = how.space.level
    levels = [how.space.level_of(one.motions)[at] @ one.root for one in how.jumpers]
    score = [np.empty((len(observed), level.shape[1])) for level in levels]
    information = [np.empty((*one.shape, one.shape[1])) for one in score]
    scores = np.empty((_PIECE, at.stop - at.start))
    known_of = np.empty((*scores.shape, scores.shape[1]))

    def note(number: int, carried: Array, known: Array) -> None:
        place = number % _PIECE
        scores[place], known_of[place] = carried[at], known[at, at]
        if place == 0:  # readings come from the last to the first
            there = slice(number, min(number + _PIECE, len(observed)))
            count = there.stop - number
            for level, one, more in zip(levels, score, information, strict=True):
                one[there], more[there] = scores[:count] @ level, level.T @ (known_of[:count] @ level)

    plain = replace(knowing, unfound=False)
    none = np.zeros(0)
    smoothed(plain, replace(start, left=none), observed, none, [none] * len(observed), knowing.parameters_of, note)
    first = how.before_s if math.isnan(start.last) else 0.0
    gap = np.diff([one.time for one in observed], prepend=observed[0].time - first)
    place = {k: i for i, k in enumerate(how.walking.tolist())}
    out = np.array(left)
    for one, more in zip(how.jumpers, added(score, information, gap, how.jumpers, how.window), strict=True):
        out[:, [place[k] for k in one.motions]] += more
    return how.with_walk(start, out[0] - left[0], first), list(out)


def smoothed(
    how: SeriesFilter,
    start: Belief,
    observed: Sequence[Observed],
    wanted: ArrayLike,
    left: Sequence[Array],
    each: Callable[[Array, Array, float], T],
    note: Callable[[int, Array, Array], None] = lambda number, score, information: None,
) -> list[T]:
    """What all readings say of times past: forward to where pieces begin, then backward piece by piece.

    Args:
        how: a filter that looks for no jumps, since it knows of them.
        start: what is known before the first reading.
        observed: N readings in the order of time.
        wanted: (T,) times, seconds, in any order, none before ``start``.
        left: N times (m,) what share of the mean square of jumps could not be told, as the filter had it before each
            reading: the process is then the filter's, and a part of a series gives what the whole gives.
        each: (n,) mean and (n, n) covariance of the states at a wanted time, and the time -> what is made of them.
        note: called with the number of each reading, and score (n,) and information (n, n) of a change of the states
            just before it by the readings from it on.
    """
    times = np.asarray(wanted, np.float64)
    order = np.argsort(times, kind="stable")
    beliefs, belief = [start], start
    for k, one in enumerate(observed):
        if k and k % _PIECE == 0:
            beliefs.append(belief)
        there = how.at(replace(belief, left=left[k]), one.time)
        belief = replace(there, state=how.taken(there.state, one)[0])
    out: dict[int, T] = {}
    size, moved = how.space.size, how.space.moved
    carried, known = np.zeros(size), np.zeros((size, size))
    # number of the first reading after each wanted time: it is worked out in the piece of that one
    behind = np.searchsorted(np.array([one.time for one in observed]), times[order], side="right")
    for k in order[behind == len(observed)]:  # after the last reading nothing comes to correct the filter
        there = how.at(belief, times[k])
        out[int(k)] = each(there.mean, there.covariance, float(times[k]))
    for piece in reversed(range(len(beliefs))):
        first, last = piece * _PIECE, min((piece + 1) * _PIECE, len(observed))
        steps = list(_again(how, beliefs[piece], observed[first:last], left[first:last]))
        for number in reversed(range(first, last)):
            before, whitened = steps[number - first]
            now = observed[number].time
            # across the reading: (1 - KH)' N (1 - KH) + H' S^-1 H, in the form that stays symmetric to the bit; others
            # of as little work lose N to rounding
            away = whitened.gain @ known
            half = away - 0.5 * (np.eye(len(away)) + away @ whitened.gain.T) @ whitened.rows
            change = whitened.rows.T @ half
            known = known - (change + change.T)
            carried = carried + whitened.rows.T @ (whitened.white - whitened.gain @ carried)
            note(number, carried, known)
            for k in order[behind == number]:
                there = how.at(before, times[k])
                back = moved(carried[:, None], times[k], now, back=True)[:, 0]
                both = how.space.moved_both(known, times[k], now, back=True)
                gained = there.covariance @ both @ there.covariance
                out[int(k)] = each(there.mean + there.covariance @ back, there.covariance - gained, float(times[k]))
            carried = moved(carried[:, None], before.time, now, back=True)[:, 0]
            known = how.space.moved_both(known, before.time, now, back=True)
    return [out[k] for k in range(len(times))]


def jointly(
    how: SeriesFilter, start: Belief, observed: Sequence[Observed], wanted: ArrayLike, left: Sequence[Array]
) -> tuple[Array, Array]:
    """What all readings say of times past together: values (T, P) of the parameters, and their covariance (T, P, T, P).

    The states at the wanted times go along with the filter, as copies that move no more, up to the last of them; what
    comes after that is what the smoother carries back to it.

    Args:
        how: a filter that looks for no jumps, since it knows of them.
        start: what is known before the first reading.
        observed: N readings in the order of time.
        wanted: (T,) times, seconds, in order, none before ``start``.
        left: as of `smoothed`.
    """
    times, space = np.asarray(wanted, np.float64), how.space
    size, ahead = space.size, 0
    behind = np.searchsorted(np.array([one.time for one in observed]), times, side="right")
    last = int(behind[-1]) if len(times) else 0
    means, own = np.empty((0, size)), np.empty((0, size, 0, size))
    across, belief = np.empty((0, size, size)), start  # of each copy, the states now with it
    for k in range(last + 1):
        if k < len(observed):
            belief = replace(belief, left=left[k])
        while ahead < len(times) and behind[ahead] == k:
            across = space.moved(across, belief.time, times[ahead])
            belief = how.at(belief, times[ahead])
            own = np.concatenate([own, across.transpose(0, 2, 1)[:, :, None]], axis=2)
            row = np.concatenate([across.transpose(1, 0, 2), belief.covariance[:, None]], axis=1)
            own, across = np.concatenate([own, row[None]]), np.concatenate([across, belief.covariance[None]])
            means = np.concatenate([means, belief.mean[None]])
            ahead += 1
        if k == last:
            break
        across = space.moved(across, belief.time, observed[k].time)
        there = how.at(belief, observed[k].time)
        whitened = how.whitened(there.state, observed[k])
        gain = whitened.rows @ across
        means = means + np.einsum("kdn,d->kn", gain, whitened.white)
        own = own - np.einsum("kdn,ldm->knlm", gain, gain)
        across = across - whitened.gain.T @ gain
        belief = replace(there, state=how.taken(there.state, observed[k], whitened)[0])
    after: list[tuple[Array, Array]] = []

    def note(number: int, carried: Array, known: Array) -> None:
        if number == 0:
            after.append((carried, known))

    smoothed(how, belief, observed[last:], np.zeros(0), left[last:], how.parameters_of, note)
    for carried, known in after:
        until = observed[last].time
        back = space.moved(carried[:, None], belief.time, until, back=True)[:, 0]
        both = space.moved_both(known, belief.time, until, back=True)
        means = means + np.einsum("kmn,m->kn", across, back)
        own = own - np.einsum("kmn,mo,lop->knlp", across, both, across, optimize=True)
    values, covariance = space.outputs_jointly(means, own, times)
    width = space.width
    return values[:, width:], covariance[:, width:, :, width:]


def _again(
    how: SeriesFilter, belief: Belief, observed: Sequence[Observed], left: Sequence[Array]
) -> Iterator[tuple[Belief, Whitened]]:
    """What is known before each reading of one piece, before it was moved to it, and the reading."""
    for one, share in zip(observed, left, strict=True):
        before = replace(belief, left=share)
        there = how.at(before, one.time)
        whitened = how.whitened(there.state, one)
        yield before, whitened
        belief = replace(there, state=how.taken(there.state, one, whitened)[0])
