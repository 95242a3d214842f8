"""The next move of an instrument's actuators, and what one more measurement would be worth before it is made.

A merit is the sum of squares of numbers that change linearly with small motions: r = r0 + D x + A a, of a state x of
which a posterior is known and moves a. Its expectation is |E r|^2 + tr(D P D'), so that of all moves the one that makes
|r0 + D E x + A a|^2 least is best. A move of relative error e adds e^2 |A_k a_k|^2. Moves by whole steps are found by
branch and bound (Land & Doig, Econometrica 28, 497, 1960).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from analysis.arrays import Array

_MOST_NODES = 600
"""Nodes of the search; the best move found by then is told, and that it may not be the best of all."""
_CLOSE = 1e-3
"""Share of the merit by which another move would have to be better."""
_TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Actuators:
    """What can be moved.

    Attributes:
        names: (C,).
        low, high: (C,) limits of the next move, SI.
        steps: (C,) of which moves are whole numbers, SI; 0 for any amount.
        relative: (C,) standard deviation of a move as a share of it.
        absolute: (C,) standard deviation of any move, SI.
    """

    names: tuple[str, ...]
    low: Array
    high: Array
    steps: Array
    relative: Array
    absolute: Array

    def made(self, wanted: Array, errors: Array) -> Array:
        """What moves (..., C) come to with random errors; an actuator that is not moved makes none.

        Args:
            wanted: the moves.
            errors: standard normal, (..., 2, C): of the share and of the amount.
        """
        moved = wanted != 0.0
        share, amount = errors[..., 0, :], errors[..., 1, :]
        return np.asarray(wanted * (1.0 + self.relative * share) + moved * self.absolute * amount)


@dataclass(frozen=True, eq=False)
class NextMove:
    """A move.

    Attributes:
        amounts: (C,) SI.
        expected: merit after it, by the linear model and with the errors of the move; the part due to what is not known
            of the state is not in it.
        searched: whether all whole steps were enumerated.
    """

    amounts: Array
    expected: float
    searched: bool


def best_move(residual: Array, slope: Array, actuators: Actuators) -> NextMove:
    """The move that makes the expected merit least.

    Args:
        residual: r0 + D E x, (R,).
        slope: A, (R, C), per SI unit of each actuator.
        actuators: limits, steps and errors.
    """
    count = slope.shape[1]
    length = np.linalg.norm(slope, axis=0)
    whole_slope = np.concatenate([slope, np.diag(actuators.relative * length)])
    whole = np.concatenate([residual, np.zeros(count)])
    low, high = np.minimum(actuators.low, 0.0), np.maximum(actuators.high, 0.0)

    def cost(amounts: Array) -> float:
        left = whole + whole_slope @ amounts
        return float(left @ left + np.sum((amounts != 0.0) * (actuators.absolute * length) ** 2))

    best, searched = _whole_steps(whole_slope, whole, low, high, actuators.steps)
    still = np.zeros(count)
    if cost(still) <= cost(best):
        best = still
    return NextMove(best, cost(best), searched)


def measurement_worth(
    spread: Array, slope: Array, actuators: Actuators, response: Array, candidates: Mapping[str, Array]
) -> dict[str, float]:
    """By how much one more measurement is expected to lower the merit after the move that follows from it.

    What is not known of the state costs only where actuators could have mended it: tr(H D P D' H) with H the projection
    on what they reach.

    Args:
        spread: P = spread spread', (U, U) in independent units of the prior.
        slope: D, derivatives of the merit's numbers by these units, (R, U).
        actuators: as of ``best_move``; steps and limits do not count here.
        response: A, (R, C).
        candidates: name -> whitened derivatives of its numbers by the units, (N, U).
    """
    length = np.linalg.norm(response, axis=0)
    used = (length > 0.0) & (actuators.high > actuators.low)
    reach = np.concatenate([response[:, used], np.diag((actuators.relative * length)[used])])
    q, _ = np.linalg.qr(reach)
    padded = np.concatenate([slope, np.zeros((int(np.sum(used)), slope.shape[1]))])
    mendable = q.T @ padded @ spread
    before = float(np.sum(mendable**2))
    out = {}
    for name, rows in candidates.items():
        table = rows @ spread
        root = np.linalg.inv(np.linalg.cholesky(np.eye(spread.shape[1]) + table.T @ table)).T
        out[name] = before - float(np.sum((mendable @ root) ** 2))
    return out


def _bounded(slope: Array, residual: Array, low: Array, high: Array) -> Array:
    """Amounts within limits that make |residual + slope amounts| least; those whose limits are equal stand there."""
    out = np.clip(np.zeros(slope.shape[1]), low, high)
    length = np.linalg.norm(slope, axis=0)
    used = (length > 0.0) & (high > low)
    if not used.any():
        return out
    size = 1.0 / length[used]
    rest = residual + slope[:, ~used] @ out[~used]
    found = lsq_linear(slope[:, used] * size, -rest, (low[used] / size, high[used] / size), "bvls", tol=1e-12)
    out[used] = np.clip(found.x * size, low[used], high[used])
    return out


def _whole_steps(slope: Array, residual: Array, low: Array, high: Array, steps: Array) -> tuple[Array, bool]:
    """Amounts within limits, by whole steps where there are such, that make |residual + slope amounts| least; and
    whether no better ones exist.

    Branch and bound: amounts between steps bound from below what whole steps can reach, and the actuator whose rounding
    costs most is branched upon first.
    """
    length = np.linalg.norm(slope, axis=0)
    best, least = np.zeros(slope.shape[1]), np.inf
    first_low = np.where(steps > 0.0, np.ceil(low / np.where(steps > 0.0, steps, 1.0) - _TINY) * steps, low)
    first_high = np.where(steps > 0.0, np.floor(high / np.where(steps > 0.0, steps, 1.0) + _TINY) * steps, high)
    boxes = [(first_low, first_high)]
    for node in range(_MOST_NODES):
        if not boxes:
            return best, True
        lows, highs = boxes.pop()
        amounts = _bounded(slope, residual, lows, highs)
        left = residual + slope @ amounts
        if left @ left >= least * (1.0 - _CLOSE):
            continue
        parts = np.where(steps > 0.0, amounts / np.where(steps > 0.0, steps, 1.0), 0.0)
        away = np.abs(parts - np.round(parts))
        if node == 0 or node % 8 == 0:
            whole = _rounded(slope, residual, amounts, lows, highs, steps)
            rest = residual + slope @ whole
            if rest @ rest < least:
                best, least = whole, float(rest @ rest)
        if np.max(away) < _TINY:
            if left @ left < least:
                best, least = np.where(steps > 0.0, np.round(parts) * steps, amounts), float(left @ left)
            continue
        k = int(np.argmax(away * steps * length))
        below, above = highs.copy(), lows.copy()
        below[k], above[k] = np.floor(parts[k]) * steps[k], np.ceil(parts[k]) * steps[k]
        halves = [(lows, below), (above, highs)]
        # the nearer half is looked into first
        boxes += halves[::-1] if parts[k] - np.floor(parts[k]) < 0.5 else halves
    return best, False


def _rounded(slope: Array, residual: Array, amounts: Array, low: Array, high: Array, steps: Array) -> Array:
    """Whole steps one actuator after the other, the strongest first; the others follow what it has become."""
    lows, highs, out = low.copy(), high.copy(), amounts
    for k in np.argsort(-np.linalg.norm(slope, axis=0) * steps):
        if steps[k] > 0.0:
            lows[k] = highs[k] = np.clip(np.round(out[k] / steps[k]) * steps[k], low[k], high[k])
            out = _bounded(slope, residual, lows, highs)
    return out
