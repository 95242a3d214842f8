"""A whole series of readings for tests: forward one by one, as they came, then what all of them say of times past."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.monitor.filter_state import Belief, Innovation, Observed
from analysis.monitor.jump_detection import Jump, Step
from analysis.monitor.series_filter import SeriesFilter
from analysis.monitor.series_following import hinted, smoothed
from analysis.monitor.series_smoother import SeriesChanges

Array = NDArray[np.float64]


def of_shifts(times: ArrayLike, shifts: Array, noise: Array) -> tuple[Observed, ...]:
    """Readings of spots.

    Args:
        times: (N,) seconds, in any order.
        shifts: (N, D) px.
        noise: (D, D) of each, or (N, D, D), px^2.
    """
    when = np.asarray(times, np.float64)
    each = np.broadcast_to(noise, (len(when), *noise.shape[-2:]))
    return tuple(Observed(float(when[k]), shifts[k], each[k]) for k in np.argsort(when, kind="stable"))


@dataclass(frozen=True, eq=False)
class Followed:
    """What a whole series said.

    Attributes:
        filtered: at the wanted times, from the readings up to each.
        smoothed: from all readings.
        innovations: one for each reading, in the order of time.
        jumps: that were told, in the order in which they were; filtered changes know of them from then on.
        belief: after the last reading.
        left_out: numbers of readings that were taken for bad ones, the last one where that is not decided yet, too;
            changes do not know of them.
    """

    filtered: SeriesChanges
    smoothed: SeriesChanges
    innovations: tuple[Innovation, ...]
    jumps: tuple[Jump, ...]
    belief: Belief
    left_out: tuple[int, ...] = ()


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
    left: list[Array] = []
    bad: list[int] = []
    ahead = 0
    for k, one in enumerate(observed):
        if ahead < len(order) and times[order[ahead]] < one.time:
            now = how.blended(belief)
        while ahead < len(order) and times[order[ahead]] < one.time:
            filtered[order[ahead]] = how.parameters(now, times[order[ahead]])
            ahead += 1
        left.append(belief.left)
        belief, found = how.update(belief, one)
        if found.earlier is not None:
            bad.pop()
        if found.bad is not None:
            bad.append(k)
        innovations.append(found)
        advance(k + 1)
    now = how.blended(belief)
    for k in order[ahead:]:
        filtered[k] = how.parameters(now, times[k])
    jumps = tuple(one.jump for one in innovations if one.jump is not None)
    knowing = replace(how, steps=(*how.steps, *map(Step.of, jumps)), window=0)
    begin = knowing.start(earliest)
    good = [k for k in range(len(observed)) if k not in bad]
    taken = [observed[k] for k in good]
    begin, left = hinted(how, knowing, begin, taken, [left[k] for k in good])
    late = smoothed(knowing, begin, taken, times, left, knowing.parameters_of)
    width = how.stated.parameters.shape[0]
    return Followed(series_of(filtered, width), series_of(late, width), tuple(innovations), jumps, belief, tuple(bad))


def _of_nothing(count: int) -> list[tuple[Array, Array]]:
    return [(np.empty(0), np.empty(0))] * count


def forecast(how: SeriesFilter, belief: Belief, times: ArrayLike) -> SeriesChanges:
    """Forecast from what is known: parameters at times that are not before the newest reading.

    Args:
        how: the filter.
        belief: so far.
        times: (T,) seconds.
    """
    now = how.blended(belief)
    found = [how.parameters(now, time) for time in np.asarray(times, np.float64).tolist()]
    return series_of(found, how.stated.parameters.shape[0])


def series_of(found: Sequence[tuple[Array, Array]], width: int) -> SeriesChanges:
    """Parameters and covariances at T times as one series; what noise alone does is not known, NaN.

    Args:
        found: (P,) and (P, P) at each time.
        width: P.
    """
    values = np.array([one for one, _ in found]).reshape(-1, width)
    total = np.array([one for _, one in found]).reshape(-1, width, width)
    return SeriesChanges(values, np.full_like(total, np.nan), total)
