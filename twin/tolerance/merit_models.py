"""Merits as functions of what varies: first and second derivatives, sensitivities, and limits for a stated loss.

Where a camera is at its best a slope says nothing: there the second derivative is what a motion costs. So the models are
of the merits' smooth parts, to the second order, and every sensitivity and every limit is traced exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twin.run.procedure import Advance, silent
from twin.tolerance.tolerance_bench import AT_ONCE, ToleranceBench, Tried

MOST_PAIRED = 150
"""Numbers up to which all pairs of them are tried; of more the second order has no products of two."""
FARTHEST = 10.0
"""Largest and, inverted, smallest share of its limit at which a tolerance is tried."""
_HALVINGS = 14
_CLOSE = 1e-4
"""Share of the loss to which a limit is found."""
_AT_ONCE = 2_000_000
"""Numbers of a product that are held in memory."""


@dataclass(frozen=True, eq=False)
class MeritModel:
    """Parts of the merits to the second order: parts = nominal + slope x + x curvature x / 2.

    x are the numbers that vary, in units of their sizes; compensators follow ideally.

    Attributes:
        nominal: of the designed camera, adjusted, (P,).
        slope: (P, K).
        curvature: symmetric, (P, K, K).
        paired: whether products of two numbers are in it.
    """

    nominal: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    paired: bool = True

    def linear(self, x: np.ndarray) -> np.ndarray:
        """Parts (S, P) to the first order at x (S, K)."""
        return np.asarray(self.nominal + x @ self.slope.T)

    def quadratic(self, x: np.ndarray) -> np.ndarray:
        """Parts (S, P) to the second order at x (S, K)."""
        step = max(1, _AT_ONCE // max(1, self.curvature.shape[0] * x.shape[1]))
        parts = [self.linear(own) + 0.5 * self._bent(own) for own in (x[s : s + step] for s in range(0, len(x), step))]
        return np.concatenate(parts)

    def _bent(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum((x @ self.curvature).transpose(1, 0, 2) * x[:, None], axis=-1))

    def quadratic_slope(self, x: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Derivatives (S, K) at x (S, K) of one part (S,) each."""
        return np.asarray(self.slope[parts] + np.einsum("skl,sl->sk", self.curvature[parts], x))


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """What every tolerance does by itself.

    Attributes:
        nominal: values of the merits of the designed camera, adjusted, (M,).
        values: with each tolerance at its limit, below and above; of a figure error what its mean squares come to,
            (E, 2, M).
        moves: of the compensators for that, SI, (E, 2, C); NaN for a figure error.
        problems: why a camera has no light there, empty where it has, (E,).
        model: of all numbers together.
    """

    nominal: np.ndarray
    values: np.ndarray
    moves: np.ndarray
    problems: tuple[str, ...]
    model: MeritModel


def sensitivities(bench: ToleranceBench, advance: Advance = silent) -> Sensitivities:
    """Try every number at plus and minus its size, and all pairs."""
    count = len(bench.numbers)
    first = np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)])
    i, j = np.triu_indices(count, 1)
    paired = count <= MOST_PAIRED
    pairs = np.eye(count)[i] + np.eye(count)[j] if paired else np.empty((0, count))
    # a little less than the whole way, where numbers of two bodies add up to more than either may
    total = len(first) + len(pairs)
    alone = _tried(bench, first, 0, total, advance)
    both = _tried(bench, pairs, len(first), total, advance) if len(pairs) else None
    nominal, plus, minus = alone.parts[0], alone.parts[1 : 1 + count], alone.parts[1 + count :]
    curvature = np.zeros((bench.parts, count, count))
    k = np.arange(count)
    curvature[:, k, k] = (plus + minus - 2.0 * nominal).T
    if both is not None:
        product = (both.parts - plus[i] - plus[j] + nominal).T
        curvature[:, i, j] = curvature[:, j, i] = product
    model = MeritModel(nominal, 0.5 * (plus - minus).T, np.nan_to_num(curvature), paired)
    values = np.empty((len(bench.entries), 2, len(bench.merits)))
    moves = np.full((len(bench.entries), 2, len(bench.ranges)), np.nan)
    problems = []
    for e, own in enumerate(bench.entries.values()):
        rows = np.array(own)
        if len(rows) == 1:
            ends = np.array([1 + count + rows[0], 1 + rows[0]])
            values[e], moves[e] = bench.values(alone.parts[ends]), alone.moves[ends]
        else:
            mean = nominal + 0.5 * np.sum(curvature[:, rows, rows], axis=1)
            values[e] = bench.values(mean)
        told = [alone.problems[r] for r in (*(1 + rows), *(1 + count + rows))]
        problems.append(next((text for text in told if text), ""))
    return Sensitivities(bench.values(nominal), values, moves, tuple(problems), model)


def _tried(bench: ToleranceBench, x: np.ndarray, done: int, total: int, advance: Advance) -> Tried:
    parts = []
    for start in range(0, len(x), AT_ONCE):
        advance("sensitivities", done + start, total)
        parts.append(bench.try_out(x[start : start + AT_ONCE] * bench.sizes))
    advance("sensitivities", done + len(x), total)
    return Tried(
        np.concatenate([one.moves for one in parts]),
        np.concatenate([one.parts for one in parts]),
        tuple(text for one in parts for text in one.problems),
        np.concatenate([one.settled for one in parts]),
    )


@dataclass(frozen=True, eq=False)
class InverseLimits:
    """At which share of its limit each tolerance by itself spoils each merit by its loss.

    Attributes:
        losses: of the merits, SI, (M,).
        shares: (E, M); infinite where the loss is not reached at ``FARTHEST`` times the limit, NaN for a figure error
            whose mean cannot tell.
    """

    losses: np.ndarray
    shares: np.ndarray


def default_losses(bench: ToleranceBench, nominal: np.ndarray) -> np.ndarray:
    """What one tolerance may spoil of every merit, SI, (M,): as stated, or what is left between design and requirement
    over the square root of the number of tolerances; NaN where nothing is left.
    """
    share = 1.0 / np.sqrt(len(bench.entries))
    out = []
    for merit, value in zip(bench.merits, nominal, strict=True):
        left = float(merit.worse(np.array(merit.spec.requirement), value))
        stated = merit.spec.loss_si
        out.append(stated if stated is not None else left * share if left > 0.0 else np.nan)
    return np.array(out)


def inverse_limits(bench: ToleranceBench, found: Sensitivities, advance: Advance = silent) -> InverseLimits:
    """Find the limits by exact traces: by halving in the logarithm, both signs, all tolerances and merits together."""
    losses = default_losses(bench, found.nominal)
    entries = list(bench.entries.values())
    low = np.full((len(entries), len(losses)), np.log(1.0 / FARTHEST))
    high = -low
    known = np.isfinite(losses)

    def loss_at(level: np.ndarray) -> np.ndarray:
        """Largest loss of both signs at shares exp(level) (E, M), over the loss that is allowed."""
        x = np.zeros((2, *level.shape, len(bench.numbers)))
        spread = []
        for e, own in enumerate(entries):
            if len(own) == 1:
                x[0, e, :, own[0]], x[1, e, :, own[0]] = np.exp(level[e]), -np.exp(level[e])
            else:
                spread.append(e)
        tried = bench.try_out(x.reshape(-1, x.shape[-1]) * bench.sizes)
        values = bench.values(tried.parts).reshape(2, *level.shape, -1)
        lost = np.stack(
            [merit.worse(values[..., m, m], found.nominal[m]) for m, merit in enumerate(bench.merits)], axis=-1
        )
        worst = np.where(np.isnan(lost), np.inf, lost).max(axis=0)
        for e in spread:
            rows = np.array(entries[e])
            own = found.model.curvature[:, rows, rows].sum(axis=1)
            mean = found.model.nominal + 0.5 * np.exp(2.0 * level[e])[:, None] * own
            each = bench.values(mean)
            worst[e] = [float(merit.worse(each[m, m], found.nominal[m])) for m, merit in enumerate(bench.merits)]
        return np.asarray(worst / losses)

    return InverseLimits(losses, np.where(known, _crossing(loss_at, low, high, advance), np.nan))


def _crossing(
    ratio: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, advance: Advance
) -> np.ndarray:
    """exp of where ratios reach 1 between two levels; infinite where they do not, and exp(low) where they have before.

    Losses grow with about the first or the second power of a share: a straight line through both ends in logarithms,
    kept within them (Illinois), halves the interval many times at once.
    """
    at_low, at_high = (np.log(np.maximum(ratio(level), 1e-12)) for level in (low, high))
    out = np.where(at_high < 0.0, np.inf, np.where(at_low > 0.0, low, np.nan))
    below, above = np.maximum(at_low, -60.0), np.minimum(at_high, 60.0)
    side = np.zeros(low.shape)
    for step in range(_HALVINGS):
        advance("limits for a loss", step, _HALVINGS)
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = low - below * (high - low) / (above - below)
        middle = np.where(np.isfinite(middle), middle, 0.5 * (low + high))
        here = np.clip(np.log(np.maximum(ratio(middle), 1e-12)), -60.0, 60.0)
        left = here < 0.0
        # the end that stays twice counts half, so that the other comes nearer
        above = np.where(left & (side < 0), 0.5 * above, np.where(left, above, here))
        below = np.where(~left & (side > 0), 0.5 * below, np.where(left, here, below))
        low, high = np.where(left, middle, low), np.where(left, high, middle)
        side = np.where(left, -1.0, 1.0)
        found = np.abs(here) < _CLOSE
        out = np.where(np.isnan(out) & found, middle, out)
        if not np.isnan(out).any():
            break
    advance("limits for a loss", _HALVINGS, _HALVINGS)
    return np.exp(np.where(np.isnan(out), 0.5 * (low + high), out))
