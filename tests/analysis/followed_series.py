"""A whole series of readings for tests: forward one by one, as they came, then what all of them say of times past."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.filter_state import FilterState, Innovation, Observed
from analysis.monitor.jump_detection import Jump, Step, Steps, steps
from analysis.monitor.kalman_filter import SeriesFilter, smoothed, with_indicated_jumps
from analysis.monitor.series_smoother import SeriesChanges
from analysis.monitor.state_space import StateSpace

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
    belief: FilterState
    left_out: tuple[int, ...] = ()


def follow(how: SeriesFilter, observed: Sequence[Observed], wanted: ArrayLike) -> Followed:
    """Follow all readings of a series, N in the order of time, and smooth: parameters at (T,) times in any order."""
    times, moments = np.asarray(wanted, np.float64), [one.time for one in observed]
    earliest = min(*moments[:1], *times.tolist())
    beliefs, innovations, bad = [how.start(earliest)], [], []
    for k, one in enumerate(observed):
        belief, found = how.update(beliefs[-1], one)
        beliefs.append(belief)
        innovations.append(found)
        if found.earlier is not None:
            bad.pop()
        if found.bad is not None:
            bad.append(k)
    known = np.searchsorted(moments, times, side="right").tolist()
    now = {n: how.mixture(beliefs[n]) for n in set(known)}
    filtered = [how.parameters(now[n], time) for n, time in zip(known, times.tolist(), strict=True)]
    jumps = tuple(one.jump for one in innovations if one.jump is not None)
    knowing = replace(how, steps=(*how.steps, *map(Step.of, jumps)), window=0)
    good = [k for k in range(len(observed)) if k not in bad]
    taken = [observed[k] for k in good]
    begin, left = with_indicated_jumps(
        how, knowing, knowing.start(earliest), taken, [beliefs[k].undetected for k in good]
    )
    late = smoothed(knowing, begin, taken, times, left, knowing.parameters_of)
    return Followed(series_of(filtered), series_of(late), tuple(innovations), jumps, beliefs[-1], tuple(bad))


def series_of(found: Sequence[tuple[Array, Array]]) -> SeriesChanges:
    """Parameters (P,) and covariances (P, P) at T times as one series; what noise alone does is not known, NaN."""
    values, total = (np.array(each) for each in zip(*found, strict=True))
    return SeriesChanges(values, np.full_like(total, np.nan), total)


def whole_steps(told: Disturbances, times: Array, shifts: Array, noise: float) -> Steps:
    """Scores and information of steps before every reading, by the Cholesky factor of the whole series' covariance."""
    space, width = StateSpace(told), shifts.shape[1]
    pairs = np.zeros((len(times), width, len(times), width))
    for i, early in enumerate(times):
        mean, covariance = space.start(early)
        for j in range(i, len(times)):
            rows = [space.outputs(mean, covariance, t)[1][:width] for t in (early, times[j])]
            pairs[j, :, i] = rows[1] @ space.moved(covariance, early, times[j]) @ rows[0].T
            pairs[i, :, j] = pairs[j, :, i].T
    root = np.linalg.cholesky(pairs.reshape(shifts.size, -1) + noise**2 * np.eye(shifts.size))
    return steps(root, np.linalg.solve(root, shifts.ravel()), times, slice(0, len(times)), None)
