"""Limits allocated anew: the yield that is asked at the least cost.

The same draws serve all limits: with x = scale * u the merits follow from their model to the second order, and the
yield's quantile of the worst margin has a gradient. A Monte Carlo run through the exact trace judges what comes out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from scenes.specs.tolerance import AllocationSpec, ToleranceSetup, amount_si, amount_text
from scenes.yaml.units import split_quantity
from twin.run.procedure import Advance, silent
from twin.tolerance.merit_models import MeritModel
from twin.tolerance.tolerance_bench import ToleranceBench

DRAWS = 4000
"""Cameras by which limits are chosen."""
_STEPS = 60
_NEAR = 0.02
"""Share of the cameras about the quantile whose gradients are averaged."""
_SAFE = 1.0
"""Standard deviations of the yield's own uncertainty by which the chosen limits are to exceed it."""


@dataclass(frozen=True, eq=False)
class Allocation:
    """Limits that were chosen.

    Attributes:
        scales: of every entry, new limit over the old one, before and after rounding, (E,) each.
        limits: entry -> new limit as files have it.
        cost: of all entries, before and after.
        predicted: yield by the model, of the old and of the new limits.
        reached: whether the model reaches the yield that was asked.
    """

    scales: np.ndarray
    rounded: np.ndarray
    limits: Mapping[str, str | float]
    cost: tuple[float, float]
    predicted: tuple[float, float]
    reached: bool


class _Trade:
    """Cost and worst margins of cameras as functions of the limits."""

    def __init__(self, bench: ToleranceBench, model: MeritModel, draws: np.ndarray, setup: ToleranceSetup) -> None:
        self.bench, self.model, self.draws = bench, model, draws
        entries = list(setup.test.tolerances.values())
        self.cost_of = np.array([one.cost for one in entries])
        self.exponent = np.array([one.exponent for one in entries])
        self.kept = np.array([one.kept for one in entries])
        self.owner = np.empty(len(bench.numbers), dtype=int)
        for e, own in enumerate(bench.entries.values()):
            self.owner[list(own)] = e

    def cost(self, level: np.ndarray) -> float:
        """Of limits at exp(level) times the old ones."""
        return float(np.sum(self.cost_of * np.exp(-self.exponent * level)))

    def cost_slope(self, level: np.ndarray) -> np.ndarray:
        return np.asarray(-self.exponent * self.cost_of * np.exp(-self.exponent * level))

    def margins(self, level: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Worst margin of every camera, which merit has it, and x, (S,), (S,), (S, K)."""
        x = self.draws * np.exp(level)[self.owner]
        values = self.bench.values(self.model.quadratic(x))
        each = np.stack([merit.margin(values[:, m]) for m, merit in enumerate(self.bench.merits)], axis=-1)
        worst = np.argmax(each, axis=-1)
        return each[np.arange(len(each)), worst], worst, x

    def quantile(self, level: np.ndarray, share: float) -> tuple[float, np.ndarray]:
        """The margin that a share of the cameras keep, and its gradient by ``level``."""
        margin, worst, x = self.margins(level)
        order = np.argsort(margin)
        at = min(len(order) - 1, int(np.ceil(share * len(order))) - 1)
        half = max(8, int(_NEAR * len(order)))
        near = order[max(0, at - half) : at + half + 1]
        # a share of each number of the last digits: differences of the model at these cameras
        step = 1e-4
        slope = np.zeros(len(level))
        for e in np.flatnonzero(~self.kept):
            moved = x[near].copy()
            moved[:, self.owner == e] *= np.exp(step)
            values = self.bench.values(self.model.quadratic(moved))
            ahead = np.choose(worst[near], [m.margin(values[:, k]) for k, m in enumerate(self.bench.merits)])
            slope[e] = float(np.mean(ahead - margin[near])) / step
        return float(margin[order[at]]), slope


def allocate(
    setup: ToleranceSetup,
    bench: ToleranceBench,
    model: MeritModel,
    draws: np.ndarray,
    spec: AllocationSpec,
    advance: Advance = silent,
) -> Allocation:
    """Choose limits.

    Args:
        setup: the budget.
        bench: of it.
        model: of its merits.
        draws: of the numbers that vary, in units of their sizes, (S, K).
        spec: what is asked.
        advance: shows how far it is.
    """
    trade = _Trade(bench, model, draws[:DRAWS], setup)
    count = len(trade.draws)
    safe = spec.target + _SAFE * float(np.sqrt(spec.target * (1.0 - spec.target) / count))
    share = min(safe, 1.0 - 1.0 / count)
    low, high = -np.log(spec.tightest), np.log(spec.loosest)
    bounds = [(0.0, 0.0) if kept else (low, high) for kept in trade.kept]
    start = np.zeros(len(trade.kept))
    # limits that fail are tightened together until they pass, so that the search begins where the yield is met
    for level in np.linspace(0.0, low, 24):
        start = np.where(trade.kept, 0.0, level)
        if trade.quantile(start, share)[0] <= 0.0:
            break
    reached = trade.quantile(start, share)[0] <= 0.0
    best = start
    if reached and not trade.kept.all():
        size = trade.cost(np.zeros(len(start)))
        steps = [0]

        def told(_: np.ndarray) -> None:
            steps[0] += 1
            advance("allocation", min(steps[0], _STEPS), _STEPS)

        found = minimize(
            lambda level: trade.cost(level) / size,
            start,
            jac=lambda level: trade.cost_slope(level) / size,
            bounds=bounds,
            constraints={
                "type": "ineq",
                "fun": lambda level: -trade.quantile(level, share)[0],
                "jac": lambda level: -trade.quantile(level, share)[1],
            },
            method="SLSQP",
            options={"maxiter": _STEPS, "ftol": 1e-6},
            callback=told,
        )
        level = np.clip(found.x, low, high)
        if trade.quantile(level, share)[0] <= 0.0 and trade.cost(level) < trade.cost(start):
            best = level
        else:
            best = _between(trade, start, level, share)
    advance("allocation", _STEPS, _STEPS)
    limits, rounded = _graded(setup, trade, best, share, spec, reached)
    passing = [float(np.mean(trade.margins(level)[0] <= 0.0)) for level in (np.zeros(len(best)), np.log(rounded))]
    costs = trade.cost(np.zeros(len(best))), trade.cost(np.log(rounded))
    return Allocation(np.exp(best), rounded, limits, costs, (passing[0], passing[1]), reached)


def _between(trade: _Trade, inside: np.ndarray, outside: np.ndarray, share: float) -> np.ndarray:
    """The cheapest limits that pass on the way from those that do to others."""
    best = inside
    for part in np.linspace(0.0, 1.0, 33)[1:]:
        level = inside + part * (outside - inside)
        if trade.quantile(level, share)[0] <= 0.0 and trade.cost(level) < trade.cost(best):
            best = level
    return best


def _graded(
    setup: ToleranceSetup,
    trade: _Trade,
    level: np.ndarray,
    share: float,
    spec: AllocationSpec,
    reached: bool,
) -> tuple[dict[str, str | float], np.ndarray]:
    """Limits rounded down to grades, then one after the other a grade up wherever the yield allows it."""
    entries = list(setup.test.tolerances.items())
    ladders = [
        [one.limit_si] if one.kept else _ladder(one.limit, one.parts[1], one.limit_si * np.exp(size), spec.grades)
        for (_, one), size in zip(entries, level, strict=True)
    ]
    old = np.array([one.limit_si for _, one in entries])
    chosen = np.zeros(len(entries), dtype=int)

    def scales(which: np.ndarray) -> np.ndarray:
        return np.array([ladder[k] for ladder, k in zip(ladders, which, strict=True)]) / old

    if reached:
        gain = trade.cost_of * trade.exponent
        for e in np.argsort(-gain):
            for k in range(1, len(ladders[e])):
                tried = chosen.copy()
                tried[e] = k
                if trade.quantile(np.log(scales(tried)), share)[0] > 0.0:
                    break
                chosen = tried
    rounded = scales(chosen)
    names = (name for name, _ in entries)
    limits = {
        name: one.limit if rounded[e] == 1.0 else amount_text(_clean(rounded[e] * old[e]), one.parts[1])
        for e, (name, (_, one)) in enumerate(zip(names, entries, strict=True))
    }
    return limits, rounded


def _clean(value: float) -> float:
    """A number without the last digits of a product."""
    return float(f"{value:.12g}")


def _ladder(limit: str | float, kind: str, value: float, grades: Sequence[float]) -> list[float]:
    """The grade at or below a value and the next two above it, SI; grades are counted in the unit of the old limit."""
    parts = split_quantity(limit)
    unit = amount_si(f"1 {parts[1]}", kind) if parts is not None else 1.0
    number = value / unit
    decade = int(np.floor(np.log10(number)))
    steps = sorted(g * 10.0**d for d in (decade - 1, decade, decade + 1) for g in grades)
    below = max((k for k, step in enumerate(steps) if step <= number * (1.0 + 1e-9)), default=0)
    return [unit * step for step in steps[below : below + 3]]
