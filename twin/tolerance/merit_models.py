"""Merits as functions of what varies: first and second derivatives, sensitivities, and limits for a stated loss.

Where a camera is at its best a slope says nothing: there the second derivative is what a motion costs. So the models
are of the merits' smooth parts, to the second order, and every sensitivity and every limit is traced exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.specs.tolerance import OF_MONITOR
from twin.camera.varied_beams import AT_ONCE
from twin.framework.procedure import Advance, silent
from twin.tolerance.tolerance_bench import ToleranceBench, Tried

MOST_PAIRED = 600
"""Numbers up to which the second order has products of two: of more they would fill the memory."""
FARTHEST = 10.0
"""Largest and, inverted, smallest share of its limit at which a tolerance is tried."""
_MOST_TURNS = 40
_GRID = 241
_CLOSE = 1e-4
"""Share of the loss to which a limit is found."""
_AT_ONCE = 8_000_000
"""Numbers of a product that are held in memory."""
_MOST_HELD, _FEWEST = 25_000_000, 500
"""Numbers of a scaled model that are held in memory, and draws that it has at least."""


@dataclass(frozen=True, eq=False)
class MeritModel:
    """Parts of the merits to the second order: parts = nominal + slope x + x curvature x / 2.

    x are the numbers that vary, in units of their sizes; compensators follow ideally.

    Attributes
    ----------
    nominal : np.ndarray
        Of the designed camera, adjusted, (P,).
    slope : np.ndarray
        (P, K).
    curvature : np.ndarray
        Symmetric, (P, K, K).
    paired : bool
        Whether products of two numbers are in it.
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


@dataclass(frozen=True, eq=False)
class ScaledModel:
    """A model at fixed draws of which every tolerance may be scaled.

    Attributes
    ----------
    nominal : np.ndarray
        Parts of the designed camera, (P,).
    first : np.ndarray
        What each tolerance adds by itself to the first order, (S, P, E).
    second : np.ndarray
        What pairs add to the second, symmetric, halves counted, (S, P, E, E).
    """

    nominal: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(cls, model: MeritModel, x: np.ndarray, entries: Sequence[Sequence[int]]) -> ScaledModel:
        """Make it of a model.

        Parameters
        ----------
        model : MeritModel
            Of the numbers that vary.
        x : np.ndarray
            Draws, (S, K); of many numbers only as many are kept as the memory holds.
        entries : Sequence[Sequence[int]]
            Numbers of each tolerance, E.
        """
        count, parts = len(entries), len(model.nominal)
        draws = x[: max(_FEWEST, _MOST_HELD // (parts * count**2))]
        first = np.stack([draws[:, own] @ model.slope[:, own].T for own in map(list, entries)], axis=-1)
        second = np.zeros((len(draws), parts, count, count))
        for e, own in enumerate(map(list, entries)):
            pulled = np.einsum("sk,pkl->spl", draws[:, own], model.curvature[:, own], optimize=True)
            for f, other in enumerate(map(list, entries[: e + 1])):
                pair = 0.5 * np.einsum("spl,sl->sp", pulled[:, :, other], draws[:, other])
                second[:, :, e, f] = second[:, :, f, e] = pair
        return cls(model.nominal, first, second)

    def parts(self, scales: np.ndarray) -> np.ndarray:
        """Parts (S, P) where tolerances are scales (E,) times what they are."""
        return np.asarray(self.nominal + (self.first + self.second @ scales) @ scales)

    def slope(self, scales: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Derivatives of the parts (W, P, E) of some draws by the logarithms of the scales."""
        return np.asarray((self.first[which] + 2.0 * (self.second[which] @ scales)) * scales)


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """What every tolerance does by itself.

    Attributes
    ----------
    nominal : np.ndarray
        Values of the merits of the designed camera, adjusted, (M,).
    values : np.ndarray
        With each tolerance at its limit, below and above, (E, 2, M); of a figure error what its terms come to on the
        average.
    moves : np.ndarray
        Of the compensators for that, SI, (E, 2, C); NaN for a figure error.
    problems : tuple[str, ...]
        Why a camera has no light there, empty where it has, (E,).
    model : MeritModel
        Of all numbers together.
    """

    nominal: np.ndarray
    values: np.ndarray
    moves: np.ndarray
    problems: tuple[str, ...]
    model: MeritModel


def sensitivities(bench: ToleranceBench, advance: Advance = silent) -> Sensitivities:
    """Try every number at plus and minus its size; products of two follow from the wavefronts' derivatives."""
    count = len(bench.numbers)
    x = np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)])
    done = []
    for start in range(0, len(x), AT_ONCE):
        advance("sensitivities", start, len(x))
        done.append(bench.try_out(x[start : start + AT_ONCE] * bench.sizes, paths=True))
    advance("sensitivities", len(x), len(x))
    tried = Tried.joined(done)
    nominal, plus, minus = tried.parts[0], tried.parts[1 : 1 + count], tried.parts[1 + count :]
    paired = count <= MOST_PAIRED
    curvature = np.zeros((bench.parts, count, count))
    if paired and tried.paths is not None:
        curvature = bench.pair_curvature(0.5 * (tried.paths[1 : 1 + count] - tried.paths[1 + count :]))
    k = np.arange(count)
    curvature[:, k, k] = (plus + minus - 2.0 * nominal).T
    model = MeritModel(nominal, np.nan_to_num(0.5 * (plus - minus).T), np.nan_to_num(curvature), paired)
    values = np.empty((len(bench.entries), 2, len(bench.merits)))
    moves = np.full((len(bench.entries), 2, len(bench.ranges)), np.nan)
    problems = []
    for e, own in enumerate(bench.entries.values()):
        rows = np.array(own)
        if len(rows) == 1:
            ends = np.array([1 + count + rows[0], 1 + rows[0]])
            values[e], moves[e] = bench.values(tried.parts[ends]), tried.moves[ends]
        else:
            values[e] = bench.values(_spread(bench, model, rows, np.ones(1))[0])
        told = [tried.problems[r] for r in (*(1 + rows), *(1 + count + rows))]
        problems.append(next((text for text in told if text), ""))
    return Sensitivities(bench.values(nominal), values, moves, tuple(problems), model)


def _spread(bench: ToleranceBench, model: MeritModel, rows: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Parts (L, P) that stand for a figure error of shares (L,) of its limit: of what bends the mean, else the rms."""
    mean = 0.5 * np.outer(share**2, model.curvature[:, rows, rows].sum(axis=1))
    rms = np.outer(share, np.sqrt(np.sum(model.slope[:, rows] ** 2, axis=1)))
    bends = np.zeros(bench.parts, dtype=bool)
    for merit in bench.merits:
        bends[merit.parts] = merit.spec.kind in ("wavefront", "mtf", *OF_MONITOR)
    return np.asarray(model.nominal + np.where(bends, mean, rms))


@dataclass(frozen=True, eq=False)
class InverseLimits:
    """At which share of its limit each tolerance by itself spoils each merit by its loss.

    Attributes
    ----------
    losses : np.ndarray
        Of the merits, SI, (M,).
    shares : np.ndarray
        (E, M); infinite where the loss is not reached at ``FARTHEST`` times the limit, NaN for a figure error whose
        mean cannot tell.
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
    """Find the limits by exact traces of both signs, from where the model has them; those of a figure error by it."""
    losses = default_losses(bench, found.nominal)
    entries = list(bench.entries.values())
    guess = np.array([[_modelled_share(bench, found, own, m, losses) for m in range(len(losses))] for own in entries])
    open_ = [(e, m) for e, own in enumerate(entries) for m in range(len(losses)) if len(own) == 1 and losses[m] > 0.0]
    shares = guess.copy()
    if open_:
        which = np.array(open_)

        def excess(rows: np.ndarray, level: np.ndarray) -> np.ndarray:
            """Logarithm of the larger loss of both signs over the allowed one, at shares exp(level)."""
            own, m = np.array([entries[e][0] for e in which[rows, 0]]), which[rows, 1]
            x = np.zeros((2, len(rows), len(bench.numbers)))
            x[0, np.arange(len(rows)), own], x[1, np.arange(len(rows)), own] = np.exp(level), -np.exp(level)
            values = bench.values(bench.try_out(x.reshape(-1, x.shape[-1]) * bench.sizes).parts).reshape(
                2, len(rows), -1
            )
            worst = np.max([_loss(bench, found, values[:, k, j], j) for k, j in enumerate(m)], axis=1)
            return np.asarray(np.log(np.maximum(worst / losses[m], 1e-12)))

        start = np.log(np.clip(guess[which[:, 0], which[:, 1]], FARTHEST**-2, FARTHEST))
        shares[which[:, 0], which[:, 1]] = np.exp(_roots(excess, start, advance))
    return InverseLimits(losses, shares)


def _loss(bench: ToleranceBench, found: Sensitivities, values: np.ndarray, m: int) -> np.ndarray:
    """By how much values of a merit are worse than the designed camera's; infinite where the light is lost."""
    lost = bench.merits[m].worse(values, found.nominal[m])
    return np.asarray(np.where(np.isnan(lost), np.inf, lost))


def _modelled_share(
    bench: ToleranceBench, found: Sensitivities, own: Sequence[int], m: int, losses: np.ndarray
) -> float:
    """Share of a tolerance's limit at which the model has the loss of a merit; infinite beyond ``FARTHEST``."""
    if not losses[m] > 0.0:
        return np.nan
    share = np.geomspace(FARTHEST**-2, FARTHEST, _GRID)
    model, rows = found.model, np.array(own)
    if len(rows) > 1:
        parts = [_spread(bench, model, rows, share)]
    else:
        bent = model.nominal + 0.5 * np.outer(share**2, model.curvature[:, rows[0], rows[0]])
        parts = [bent + np.outer(sign * share, model.slope[:, rows[0]]) for sign in (1.0, -1.0)]
    lost = np.max([_loss(bench, found, bench.merits[m].values(one), m) for one in parts], axis=0)
    beyond = np.flatnonzero(lost >= losses[m])
    return float(share[beyond[0]]) if beyond.size else np.inf


def _roots(excess: Callable[[np.ndarray, np.ndarray], np.ndarray], start: np.ndarray, advance: Advance) -> np.ndarray:
    """Where functions that grow cross zero, each from its own start, all together; infinite beyond the farthest level.

    First a step that doubles until the zero lies between two levels, then the straight line through both ends, of which
    the one that stays twice counts half (Illinois).

    Parameters
    ----------
    excess : Callable[[np.ndarray, np.ndarray], np.ndarray]
        Numbers of the functions and a level for each -> values.
    start : np.ndarray
        Levels, (R,).
    advance : Advance
        Shows how far it is.
    """
    count = len(start)
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    below, above = np.full(count, np.nan), np.full(count, np.nan)
    side, step, out = np.zeros(count), np.full(count, 0.05), np.full(count, np.nan)
    level = start.copy()
    top, bottom = np.log(FARTHEST), -2.0 * np.log(FARTHEST)
    for _ in range(_MOST_TURNS):
        advance("limits for a loss", count - int(np.isnan(out).sum()), count)
        rows = np.flatnonzero(np.isnan(out))
        if not rows.size:
            break
        here = np.clip(excess(rows, level[rows]), -60.0, 60.0)
        for r, value in zip(rows, here, strict=True):
            under = value < 0.0
            if abs(value) < _CLOSE:
                out[r] = level[r]
            elif under and level[r] >= top:
                out[r] = np.inf
            elif not under and level[r] <= bottom:
                out[r] = bottom
            elif under:
                above[r] *= 0.5 if side[r] < 0.0 else 1.0
                low[r], below[r], side[r] = level[r], value, -1.0
            else:
                below[r] *= 0.5 if side[r] > 0.0 else 1.0
                high[r], above[r], side[r] = level[r], value, 1.0
            if np.isfinite(low[r]) and np.isfinite(high[r]):
                level[r] = low[r] - below[r] * (high[r] - low[r]) / (above[r] - below[r])
                if high[r] - low[r] < _CLOSE:
                    out[r] = level[r]
            else:
                level[r] = min(top, low[r] + step[r]) if under else max(bottom, high[r] - step[r])
                step[r] *= 3.0
    advance("limits for a loss", count, count)
    return np.where(np.isnan(out), level, out)
