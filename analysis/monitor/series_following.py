"""A whole series of readings: forward one by one, as they came, then backward for what all of them say of times past.

The smoother goes backwards over the same readings (Bryson, Frazier; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085): it
needs no inverse of a covariance, and of the filter only what is of the size of a reading. It is worked in pieces, the
filter being run a second time in each, so that memory does not grow with states times readings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.monitor.jump_detection import Jump
from analysis.monitor.series_filter import Belief, Innovation, Observed, SeriesFilter, Step, Whitened, series_of
from analysis.monitor.series_smoother import SeriesChanges

__all__ = ["Followed", "follow"]

Array = NDArray[np.float64]
_PIECE = 400
"""Readings whose covariances are held at once."""


@dataclass(frozen=True, eq=False)
class Followed:
    """What a whole series said.

    Attributes:
        filtered: at the wanted times, from the readings up to each.
        smoothed: from all readings.
        innovations: one for each reading, in the order of time.
        jumps: that were told, in the order in which they were; filtered changes know of them from then on.
        belief: after the last reading.
    """

    filtered: SeriesChanges
    smoothed: SeriesChanges
    innovations: tuple[Innovation, ...]
    jumps: tuple[Jump, ...]
    belief: Belief


def follow(
    how: SeriesFilter,
    observed: Sequence[Observed],
    wanted: ArrayLike,
    start: float | None = None,
    advance: Callable[[int], None] = lambda done: None,
) -> Followed:
    """All readings of a series, one by one, and what all of them say of times past.

    Args:
        how: the filter.
        observed: N readings in the order of time.
        wanted: (T,) times, seconds, in any order.
        start: time before which nothing is read, seconds; the earliest of all by default.
        advance: called with the number of readings that are done.
    """
    times = np.asarray(wanted, np.float64)
    earliest = min([*(one.time for one in observed[:1]), *times.tolist(), *([] if start is None else [start])])
    order = np.argsort(times, kind="stable")
    belief, filtered = how.start(earliest), _of_nothing(len(times))
    innovations: list[Innovation] = []
    left = _Left(how, observed)
    ahead = 0
    for k, one in enumerate(observed):
        while ahead < len(order) and times[order[ahead]] < one.time:
            filtered[order[ahead]] = how.parameters(belief, times[order[ahead]])
            ahead += 1
        before = belief
        belief, found = how.update(belief, one)
        innovations.append(found)
        if found.jump is not None:
            left.note(before)
        left.note(belief, 1)
        advance(k + 1)
    left.note(belief)
    for k in order[ahead:]:
        filtered[k] = how.parameters(belief, times[k])
    jumps = tuple(one.jump for one in innovations if one.jump is not None)
    knowing = replace(how, steps=(*how.steps, *map(Step.of, jumps)), window=0)
    smoothed = _smoothed(knowing, observed, times, order, earliest, left)
    width = how.stated.parameters.shape[0]
    return Followed(series_of(filtered, width), series_of(smoothed, width), tuple(innovations), jumps, belief)


class _Left:
    """What share of the mean square of jumps before each reading cannot be told, once all is known that will be."""

    def __init__(self, how: SeriesFilter, observed: Sequence[Observed]) -> None:
        self._how = how
        self._number = {one.time: k for k, one in enumerate(observed) if one.spots}
        self._share = np.ones((len(observed), len(how.walking)))
        spots = np.array([one.spots for one in observed], bool)
        # of other readings that of the next one of spots
        self._next = np.minimum(np.cumsum(np.append(False, spots[:-1])), max(int(spots.sum()) - 1, 0))
        self._spots = np.flatnonzero(spots)

    def note(self, belief: Belief, count: int | None = None) -> None:
        """Keep it of the oldest steps that are looked for, or of all."""
        if self._share.shape[1] and len(belief.until[:count]):
            at = [self._number[time] for time in belief.until[:count].tolist()]
            self._share[at] = self._how.unseen(belief, count)

    def __getitem__(self, number: int) -> Array:
        """(m,) before reading ``number``."""
        if not len(self._spots):
            return self._share[number]
        return np.asarray(self._share[self._spots[self._next[number]]])


def _of_nothing(count: int) -> list[tuple[Array, Array]]:
    return [(np.empty(0), np.empty(0))] * count


def _smoothed(
    how: SeriesFilter, observed: Sequence[Observed], times: Array, order: NDArray[np.intp], start: float, left: _Left
) -> list[tuple[Array, Array]]:
    """Parameters at all times by all readings: forward to where pieces begin, then backward piece by piece."""
    beliefs, belief = [], how.start(start)
    for k, one in enumerate(observed):
        if k % _PIECE == 0:
            beliefs.append(belief)
        belief, _ = how.update(replace(belief, left=left[k]), one)
    if not observed:
        beliefs.append(belief)
    out = _of_nothing(len(times))
    size = how.space.size
    carried, known = np.zeros(size), np.zeros((size, size))
    when = np.array([one.time for one in observed])
    # number of the first reading after each wanted time: it is worked out in the piece of that one
    behind = np.searchsorted(when, times[order], side="right")
    for piece in reversed(range(len(beliefs))):
        first, last = piece * _PIECE, min((piece + 1) * _PIECE, len(observed))
        final = last == len(observed)
        steps = list(_again(how, beliefs[piece], observed[first:last], [left[k] for k in range(first, last)]))
        belief = beliefs[piece] if not steps else steps[-1][0]
        own = order[behind == last] if final else order[:0]
        for k in own[::-1]:  # after the last reading nothing comes to correct the filter
            out[k] = how.parameters(belief, times[k])
        for number in reversed(range(first, last)):
            before, whitened = steps[number - first][1:]
            moved = how.space.moved
            # across the reading; the short form, in which N's own terms cancel, is not stable
            kept = np.eye(size) - whitened.gain.T @ whitened.rows
            known = kept.T @ known @ kept + whitened.rows.T @ whitened.rows
            carried = kept.T @ carried + whitened.rows.T @ whitened.white
            for k in order[behind == number][::-1]:
                time = times[k]
                there = how.at(replace(before, left=left[number]), time)
                back = moved(carried[:, None], time, observed[number].time, back=True)[:, 0]
                both = moved(
                    moved(known, time, observed[number].time, back=True).T, time, observed[number].time, back=True
                )
                gained = there.covariance @ both @ there.covariance
                out[k] = how.parameters(there, time, there.covariance @ back, gained)
            then, now = before.time, observed[number].time
            carried = moved(carried[:, None], then, now, back=True)[:, 0]
            known = moved(moved(known, then, now, back=True).T, then, now, back=True)
    return out


def _again(
    how: SeriesFilter, belief: Belief, observed: Sequence[Observed], left: Sequence[Array]
) -> Iterator[tuple[Belief, Belief, Whitened]]:
    """What is known after each reading, before it was moved to, and the reading, of one piece."""
    for one, share in zip(observed, left, strict=True):
        before = replace(belief, left=share)
        whitened = how.whitened(how.at(before, one.time).state, one)
        belief, _ = how.update(before, one)
        yield belief, before, whitened
