"""From when to when numbers that were estimated for one time can be used.

Used at another time t', the estimate p(t) of a time t is wrong by p(t) - P(t'), P the truth. p(t') is the mean of P(t')
given the same readings and p(t) follows from these readings, so that the mean square of the error is exactly

    sigma(t')^2 + (p(t') - p(t))^2.

The estimate holds as long as the root of this is at most 1 + `SHARE` times sigma(t) for every quantity, within the
readings and the forecast, and not across what is known to have changed the instrument.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.monitor.limits import Quantity
from twin.operate.record.entries import MICRO

SHARE = 0.2
"""By which an error may be larger than at the time of the estimate."""
_FIRST = MICRO
"""Microseconds: the shortest time that is looked at."""
_STEPS = 48
"""Times on either side, one after the other by equal factors; then as often between the last that holds and the first
that does not."""


class Estimates(Protocol):
    """Estimates at T times."""

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Q of them."""
        ...

    @property
    def values(self) -> Array:
        """(T, Q) in each quantity's unit."""
        ...

    @property
    def sigmas(self) -> Array:
        """(T, Q) likewise."""
        ...


@dataclass(frozen=True)
class Mark:
    """What an estimate does not hold across.

    Attributes:
        time: microseconds of TAI since 2000.
        reason: in words.
    """

    time: int
    reason: str


@dataclass(frozen=True)
class Validity:
    """Span in which an estimate holds.

    Attributes:
        since, until: microseconds of TAI since 2000.
        since_reason, until_reason: why it does not hold before and after.
    """

    since: int
    until: int
    since_reason: str
    until_reason: str


def validity(
    estimates: Callable[[Sequence[int]], Estimates],
    time: int,
    first: Mark,
    last: Mark,
    marks: Sequence[Mark] = (),
    beside: Estimates | None = None,
) -> Validity:
    """The span in which the estimate of a time holds.

    Args:
        estimates: at times in ascending order.
        time: of the estimate.
        first: from when on there are estimates.
        last: until when.
        marks: what lies between; one at the time itself counts as before it.
        beside: the estimate just beside the time, in place of that at it.
    """
    low = max((one for one in (first, *marks) if one.time <= time), key=lambda one: one.time)
    high = min((one for one in (last, *marks) if one.time > time), key=lambda one: one.time, default=last)
    here = beside or estimates([time])
    ends = {-1: time - low.time, 1: high.time - time}
    found = _looked_at(estimates, here, time, {sign: (0, _distances(0, span)) for sign, span in ends.items()})
    again = {sign: (one.good, _distances(one.good, one.bad, evenly=True)) for sign, one in found.items()}
    found |= _looked_at(estimates, here, time, again)
    since, until = (
        Mark(time + sign * found[sign].good, found[sign].reason) if sign in found else mark
        for sign, mark in ((-1, low), (1, high))
    )
    return Validity(since.time, until.time, since.reason, until.reason)


@dataclass(frozen=True)
class _Found:
    """Where an estimate ceases to hold on one side of a time.

    Attributes:
        good, bad: distances, microseconds: the last at which it holds and the first at which it does not.
        reason: why it does not.
    """

    good: int
    bad: int
    reason: str


def _distances(good: int, end: int, evenly: bool = False) -> NDArray[np.int64]:
    """Distances beyond one at which an estimate holds, up to an end, microseconds, increasing."""
    if end <= good:
        return np.empty(0, np.int64)
    if evenly:
        away = np.linspace(good, end, _STEPS + 1)[1:]
    else:
        away = np.geomspace(min(_FIRST, end), end, _STEPS)
    return np.unique(np.round(away).astype(np.int64))


def _looked_at(
    estimates: Callable[[Sequence[int]], Estimates],
    here: Estimates,
    time: int,
    sides: Mapping[int, tuple[int, NDArray[np.int64]]],
) -> dict[int, _Found]:
    """Where the estimate ceases to hold, by the sign of the side; sides on which it holds are missing.

    Args:
        estimates: asked once for the times of all sides.
        here: the estimate.
        time: of it.
        sides: sign -> a distance at which it holds, and those to look at, (T,), increasing.
    """
    times = np.unique(np.concatenate([np.empty(0, np.int64), *(time + sign * own for sign, (_, own) in sides.items())]))
    if not len(times):
        return {}
    course = estimates(times.tolist())
    sigma = np.where(here.sigmas[0] > 0.0, here.sigmas[0], np.inf)
    error = np.hypot(course.sigmas, course.values - here.values[0]) / sigma
    out = {}
    for sign, (good, own) in sides.items():
        at = np.searchsorted(times, time + sign * own)
        over = np.flatnonzero(np.max(error[at], axis=1, initial=0.0) > 1.0 + SHARE)
        if not over.size:
            continue
        k = int(over[0])
        q = int(np.argmax(error[at[k]]))
        one = here.quantities[q]
        moved = abs(course.values[at[k], q] - here.values[0, q]) > course.sigmas[at[k], q] - here.sigmas[0, q]
        what = "its estimate goes on" if moved else "its sigma grows"
        reason = f"{one.group} {one.key} would be wrong by {100.0 * SHARE:g} percent more: {what}"
        out[sign] = _Found(int(own[k - 1]) if k else good, int(own[k]), reason)
    return out
