"""Loops that act on what a monitor reads: integrators with a delay, by readings.

At reading k an estimate says what is left of a quantity, e = p + m a, where p is what would be there without a
correction, a the position of a mechanism and m what it does to the quantity. The command changes by

    c(k) = c(k - 1) - g e(k) / m,

and the mechanism stands at it d readings later, so that the reading after the next but d sees it. The open loop is

    L(z) = g z^-(d + 1) / (1 - 1/z),

as of every integrator with a delay (Astrom, Wittenmark, Computer-Controlled Systems, 1997, ch. 3; in adaptive optics:
Gendron, Lena, Astron. Astrophys. 291, 1994, 337). Its phase is -180 degrees at w = pi / (2 d + 1) per reading, where
its size is g / (2 sin(w / 2)): the loop is stable below

    g = 2 sin(pi / (4 d + 2)).

Corrections that act on each other's quantities are stable together if the eigenvalues of their common recursion lie
within the unit circle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array

DECAYING = 1.0 - 1e-12
"""Largest eigenvalue of loops that are stable: of one that only comes to rest somewhere else rounding makes either."""
_LEAST, _MOST = 1e-6, 1e6
"""Gain margins that are as bad and as good as any."""
_CLOSE = 1e-12
"""Relative, to which a gain margin is found."""
_SETTLING, _WATCHED = 400, 400
"""Readings before a limit cycle is looked at, and for which it is."""
_OFFSETS = 41
"""Places of the uncorrected quantity between two steps for which limit cycles are looked for."""


def open_loop(gain: float, delay: int, frequency: ArrayLike) -> NDArray[np.complex128]:
    """Transfer L of the open loop.

    Parameters
    ----------
    gain : float
        g.
    delay : int
        d, readings.
    frequency : ArrayLike
        Of any shape, cycles per reading, above 0 up to 0.5.
    """
    turn = np.exp(-2j * np.pi * np.asarray(frequency, np.float64))
    return np.asarray(gain * turn ** (delay + 1) / (1.0 - turn))


def rejection(gain: float, delay: int, frequency: ArrayLike) -> Array:
    """Size of what is left of a quantity that swings, over the swing: |1 + m a / p| when images are taken.

    Images are taken after the command of the same reading: of delay 0 and gain 1 nothing is left, whatever the
    frequency.

    Parameters
    ----------
    gain : float
        g.
    delay : int
        d, readings.
    frequency : ArrayLike
        Of any shape, cycles per reading, above 0 up to 0.5.
    """
    turn = np.exp(-2j * np.pi * np.asarray(frequency, np.float64))
    return np.asarray(np.abs(1.0 - gain * turn**delay / (1.0 - turn + gain * turn ** (delay + 1))))


@dataclass(frozen=True)
class Margins:
    """How far a loop is from becoming unstable.

    Attributes
    ----------
    limit : float
        Gain below which a loop with this delay is stable.
    gain : float
        The limit over the loop's own gain; infinite for gain 0.
    phase_deg : float
        What the phase may lose where the open loop's size is 1; NaN where it is larger or smaller at all frequencies.
    crossover : float
        That frequency, cycles per reading; NaN likewise.
    """

    limit: float
    gain: float
    phase_deg: float
    crossover: float

    @property
    def stable(self) -> bool:
        """Whether errors decay."""
        return self.gain > 1.0


def margins(gain: float, delay: int) -> Margins:
    """Margins of one loop by itself.

    Parameters
    ----------
    gain : float
        g, 0 or more.
    delay : int
        d, readings.
    """
    limit = 2.0 * math.sin(math.pi / (4 * delay + 2))
    if not 0.0 < gain <= 2.0:
        return Margins(limit, math.inf if gain == 0.0 else limit / gain, math.nan, math.nan)
    w = 2.0 * math.asin(0.5 * gain)
    phase = math.degrees(0.5 * math.pi - (delay + 0.5) * w)
    return Margins(limit, limit / gain, phase, w / (2.0 * math.pi))


def spectral_radius(
    coupling: ArrayLike, gains: Sequence[float], delays: Sequence[int], quantities: Sequence[int] | None = None
) -> float:
    """Largest size of the eigenvalues of n loops together: below 1 all errors decay.

    A loop of gain 0, which does nothing, does not count. Loops on one quantity add up the same numbers, so that what
    their mechanisms do against each other is not a state of its own.

    Parameters
    ----------
    coupling : ArrayLike
        (n, n) what the mechanism of a column does to the quantity of a row, over what the row's own mechanism does to
        it; 1 on the diagonal.
    gains : Sequence[float]
        (n,) of the loops.
    delays : Sequence[int]
        (n,) of them, readings.
    quantities : Sequence[int] | None
        (n,) which quantity each acts on, by number; by default each on its own.
    """
    every, g = np.asarray(coupling, np.float64), np.asarray(gains, np.float64)
    acting = np.flatnonzero(g != 0.0).tolist()
    if not acting:
        return 0.0
    named = list(range(len(g)) if quantities is None else quantities)
    first: dict[int, int] = {}
    for k in acting:
        first.setdefault(named[k], k)
    rows, place = list(first.values()), {name: at for at, name in enumerate(first)}
    n, longest = len(rows), max(int(delays[k]) for k in acting)
    # states are sums of what was left, of each quantity over what its first mechanism does, the newest first
    step = np.zeros((n * (longest + 1),) * 2)
    step[:n, :n] = np.eye(n)
    for k in acting:
        at = place[named[k]]
        step[:n, n * int(delays[k]) + at] -= g[k] * every[rows, k] / every[rows[at], k]
    step[n:, : n * longest] = np.eye(n * longest)
    return float(np.abs(np.linalg.eigvals(step)).max())


def common_margin(
    coupling: ArrayLike, gains: Sequence[float], delays: Sequence[int], quantities: Sequence[int] | None = None
) -> float:
    """By how much all gains together may be larger (or must be smaller) for the loops to be at the limit of stability.

    Parameters
    ----------
    coupling : ArrayLike
        (n, n) as of `spectral_radius`.
    gains : Sequence[float]
        (n,) likewise.
    delays : Sequence[int]
        (n,) likewise.
    quantities : Sequence[int] | None
        (n,) likewise.
    """
    g = np.asarray(gains, np.float64)
    if not np.any(g):
        return math.inf

    def stable(factor: float) -> bool:
        return spectral_radius(coupling, (factor * g).tolist(), delays, quantities) < DECAYING

    low, high = _LEAST, 1.0
    if not stable(low):
        return 0.0
    while stable(high):
        low, high = high, 2.0 * high
        if high > _MOST:
            return math.inf
    while high > low * (1.0 + _CLOSE):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True)
class LimitCycle:
    """How a mechanism of whole steps goes on moving although nothing changes, at the worst place between two steps.

    Attributes
    ----------
    steps : int
        Largest distance between positions that it goes to and fro, steps; 0 where it comes to rest everywhere.
    left : float
        Largest of what is then left of the quantity, in what one step does to it.
    period : float
        Readings of the longest cycle; 0 for none, NaN where it does not come back within the time watched.
    """

    steps: int
    left: float
    period: float


def limit_cycle(gain: float, delay: int, dead_band: float = 0.0) -> LimitCycle:
    """The limit cycle of a mechanism of whole steps, by going through the recursion.

    Parameters
    ----------
    gain : float
        g.
    delay : int
        d, readings.
    dead_band : float
        What is left and is smaller is left alone, in what one step does.
    """
    offset = np.linspace(0.0, 1.0, _OFFSETS) + 0.5 / _OFFSETS
    command = np.zeros((delay + 2, len(offset)))
    seen = []
    for k in range(_SETTLING + _WATCHED):
        left = offset + np.round(command[delay])
        change = np.where(np.abs(left) > dead_band, gain * left, 0.0)
        command = np.concatenate([command[:1] - change, command[:-1]])
        if k >= _SETTLING:
            seen.append(np.round(command[delay]))
    places = np.array(seen)
    steps = np.ptp(places, axis=0)
    periods = [_period(column) for column in places.T[steps > 0.0]]
    return LimitCycle(int(steps.max()), float(np.abs(offset + places).max()), float(max(periods)) if periods else 0.0)


def _period(places: Array) -> float:
    """Readings after which places repeat themselves; NaN for never."""
    for length in range(1, len(places) // 2):
        if np.array_equal(places[length:], places[:-length]):
            return float(length)
    return math.nan
