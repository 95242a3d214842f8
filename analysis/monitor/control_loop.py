"""Control loops that act on a monitor's readings: integrators with a delay, in discrete time.

At reading k an estimate gives the residual of a quantity, e = p + m a, where p is its value without correction, a the
position of a mechanism and m the mechanism's effect on the quantity. The command changes by

    c(k) = c(k - 1) - g e(k) / m,

and the mechanism reaches it d readings later, so that the reading after the next but d sees it. The open loop is

    L(z) = g z^-(d + 1) / (1 - 1/z),

as for every integrator with a delay (Astrom, Wittenmark, Computer-Controlled Systems, 1997, ch. 3; in adaptive optics:
Gendron, Lena, Astron. Astrophys. 291, 1994, 337). Its phase is -180 degrees at the angular frequency w = pi / (2 d +
1), in radians per reading, where its modulus is g / (2 sin(w / 2)): the loop is stable below

    g = 2 sin(pi / (4 d + 2)).

Corrections that act on each other's quantities are stable together if the eigenvalues of their common recursion lie
within the unit circle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array

DECAYING = 1.0 - 1e-12
"""Largest absolute eigenvalue of loops that count as stable: errors decay from reading to reading.

The margin to 1 covers rounding for loops that are marginally stable.
"""
_LEAST, _MOST = 1e-6, 1e6
"""Gain margins (factors) at which the search ends: a smaller one counts as 0, a larger one as infinite."""
_CLOSE = 1e-12
"""Relative accuracy to which a gain margin is computed."""
_SETTLING, _WATCHED = 400, 400
"""Numbers of simulated readings in the search for limit cycles: those for settling, then those examined."""
_OFFSETS = 41
"""Number of constant values of the uncorrected quantity, spread over one step, for which limit cycles are searched."""


@dataclass(frozen=True)
class Margins:
    """Stability margins of a control loop: how far its gain and phase are from instability.

    Attributes
    ----------
    limit : float
        Gain below which a loop with this delay is stable.
    gain : float
        Gain margin: the limit over the loop's own gain; infinite for gain 0.
    phase_deg : float
        Phase margin, degrees: distance of the open loop's phase from -180 degrees where its modulus is 1; NaN where it
        is larger or smaller at all frequencies.
    crossover : float
        Frequency at which the modulus of the open loop's transfer function is 1, cycles per reading; NaN if there is
        none.
    """

    limit: float
    gain: float
    phase_deg: float
    crossover: float

    @property
    def stable(self) -> bool:
        """True if errors decay: the gain is below the limit of stability."""
        return self.gain > 1.0


def margins(gain: float, delay: int) -> Margins:
    """Return the stability margins of a single loop, an integrator with a delay.

    Parameters
    ----------
    gain : float
        Gain, 0 or more: the fraction of the residual that one reading corrects.
    delay : int
        Delay of the mechanism, in readings.
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
    """Return the largest absolute eigenvalue of the common recursion of n coupled loops: below 1 all errors decay.

    A loop of gain 0, which does nothing, does not count. Loops that act on one quantity integrate the same readings;
    motions of their mechanisms that cancel in the quantity are therefore no separate state of the recursion.

    Parameters
    ----------
    coupling : (n, n) array_like
        Element (i, j): effect of the mechanism of loop j on the quantity of loop i, divided by the effect of loop i's
        own mechanism; 1 on the diagonal.
    gains : (n,) sequence of float
        Gains of the loops.
    delays : (n,) sequence of int
        Delays of the loops, readings.
    quantities : (n,) sequence of int or None
        Index of the quantity that each loop acts on; by default each has its own.
    """
    coupling_matrix, g = np.asarray(coupling, np.float64), np.asarray(gains, np.float64)
    acting = np.flatnonzero(g != 0.0).tolist()
    if not acting:
        return 0.0
    named = list(range(len(g)) if quantities is None else quantities)
    first: dict[int, int] = {}
    for k in acting:
        first.setdefault(named[k], k)
    rows, row = list(first.values()), {name: at for at, name in enumerate(first)}
    n, longest = len(rows), max(int(delays[k]) for k in acting)
    # states are sums of what was left, of each quantity over what its first mechanism does, the newest first
    step = np.zeros((n * (longest + 1),) * 2)
    step[:n, :n] = np.eye(n)
    for k in acting:
        at = row[named[k]]
        step[:n, n * int(delays[k]) + at] -= g[k] * coupling_matrix[rows, k] / coupling_matrix[rows[at], k]
    step[n:, : n * longest] = np.eye(n * longest)
    return float(np.abs(np.linalg.eigvals(step)).max())


def common_margin(
    coupling: ArrayLike, gains: Sequence[float], delays: Sequence[int], quantities: Sequence[int] | None = None
) -> float:
    """Return the common factor of all gains at which coupled loops reach the limit of stability.

    Dimensions: n loops.

    Parameters
    ----------
    coupling : (n, n) array_like
        Element (i, j): effect of the mechanism of loop j on the quantity of loop i, divided by the effect of loop i's
        own mechanism.
    gains : (n,) sequence of float
        Gains of the loops.
    delays : (n,) sequence of int
        Delays of the loops, readings.
    quantities : (n,) sequence of int or None
        Index of the quantity that each loop acts on; by default each has its own.
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
    """Limit cycle of a mechanism that moves by whole steps, while the uncorrected quantity is constant.

    It is the worst case over all positions of the desired value between two steps.

    Attributes
    ----------
    steps : int
        Largest distance between positions of the cycle, steps; 0 where the mechanism always comes to rest.
    left : float
        Largest residual of the quantity during the cycle, in units of the effect of one step.
    period : float
        Number of readings of the longest cycle; 0 if there is none, NaN where it does not repeat within the simulated
        time.
    """

    steps: int
    left: float
    period: float


def limit_cycle(gain: float, delay: int, dead_band: float = 0.0) -> LimitCycle:
    """Return the limit cycle of a mechanism that moves by whole steps, by simulation of the control loop.

    Parameters
    ----------
    gain : float
        Gain: the fraction of the residual that one reading corrects.
    delay : int
        Delay of the mechanism, in readings.
    dead_band : float
        Residual, in units of the effect of one step, below which no correction is made.
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
    positions = np.array(seen)
    steps = np.ptp(positions, axis=0)
    periods = [_period(column) for column in positions.T[steps > 0.0]]
    return LimitCycle(
        int(steps.max()), float(np.abs(offset + positions).max()), float(max(periods)) if periods else 0.0
    )


def _period(positions: Array) -> float:
    """Return the number of readings after which the positions of a mechanism repeat; NaN if they do not."""
    for length in range(1, len(positions) // 2):
        if np.array_equal(positions[length:], positions[:-length]):
            return float(length)
    return math.nan
