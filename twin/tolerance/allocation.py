"""Limits allocated anew: the yield that is asked at the least cost.

The same draws serve all limits: with x = scale * u the merits follow from their model to the second order, and the
yield's quantile of the worst margin has a gradient. Limits move by a bounded factor in each round; then the model is
made anew, and exact traces of some of the cameras say by how much it is off. A Monte Carlo run of other cameras judges
what comes out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize

from optics.numerics.number_tree import FrozenMap
from scenes.specs.tolerance import AllocationSpec, ToleranceSetup, amount_si
from scenes.yaml.units import split_quantity
from twin.framework.procedure import Advance, silent
from twin.tolerance.merit_models import MeritModel, ScaledModel, sensitivities
from twin.tolerance.samples import Samples, adjustment_errors
from twin.tolerance.tolerance_bench import ToleranceBench

DRAWS = 2000
"""Cameras by which limits are chosen."""
CHECKED = 1000
"""Of these, cameras that are traced in every round."""
ROUNDS = 6
BOUND = 2.0
"""By which factor a limit may change in a round."""
_STEPS = 60
_STEP = 1e-5
"""Step of the logarithm of a limit by which margins are differentiated: along the parts' own derivatives."""
_SETTLED = 0.1
"""Change of the logarithms of the limits below which no further round is made."""
_LAST = 4
"""Times that all limits are tightened together at last, where exact traces say that the yield is not met."""
_NEAR = 0.02
"""Share of the cameras about the quantile whose gradients are averaged."""
_SAFE = 1.0
"""Standard deviations of the checked yield's own uncertainty by which the chosen limits are to exceed what is asked."""


@dataclass(frozen=True, eq=False)
class Allocation:
    """Limits that were chosen.

    Attributes
    ----------
    scales : np.ndarray
        Of every entry, new limit over the old one, before and after rounding, (E,) each.
    limits : Mapping[str, str | float]
        Entry -> new limit as files have it.
    costs : np.ndarray
        Of every entry, before and after, (2, E).
    predicted : tuple[float, float]
        Yield of the old and of the new limits, by the model as it was corrected.
    reached : bool
        Whether the yield of the new limits, as they are rounded, reaches what was asked.
    unrounded : bool
        Whether that of the limits before rounding does.
    """

    scales: np.ndarray
    rounded: np.ndarray
    limits: Mapping[str, str | float]
    costs: np.ndarray
    predicted: tuple[float, float]
    reached: bool
    unrounded: bool

    @property
    def cost(self) -> tuple[float, float]:
        """Of all entries, before and after."""
        before, after = np.sum(self.costs, axis=1)
        return float(before), float(after)


def allocate(
    setup: ToleranceSetup,
    bench: ToleranceBench,
    model: MeritModel,
    samples: Samples,
    spec: AllocationSpec,
    advance: Advance = silent,
) -> Allocation:
    """Choose limits.

    Parameters
    ----------
    setup : ToleranceSetup
        The budget.
    bench : ToleranceBench
        Of it.
    model : MeritModel
        Of its merits.
    samples : Samples
        Cameras of it.
    spec : AllocationSpec
        What is asked.
    advance : Advance
        Shows how far it is.
    """
    costs = _Costs.of(setup)
    checked = min(CHECKED, len(samples.x))
    share = spec.target + _SAFE * float(np.sqrt(spec.target * (1.0 - spec.target) / checked))
    share = min(share, 1.0 - 1.0 / checked)
    total = np.zeros(len(costs.kept))
    low, high = -np.log(spec.tightest), np.log(spec.loosest)
    trade = _Trade(bench, model, samples, costs, share, samples.values)
    first, nothing = trade.passing(total), np.zeros(len(total))
    cheapest = (costs.of_level(total), total, trade) if trade.quantile(nothing)[0] <= 0.0 else None
    for turn in range(ROUNDS):
        advance("allocation", turn, ROUNDS)
        bounds = np.clip([low - total, high - total], -np.log(BOUND), np.log(BOUND))
        step = trade.cheapest(np.where(costs.kept, 0.0, bounds[0]), np.where(costs.kept, 0.0, bounds[1]), total)
        total, trade = total + step, _Trade.at(bench, total + step, samples, costs, share)
        price = costs.of_level(total)
        if (cheapest is None or price < cheapest[0]) and trade.quantile(nothing)[0] <= 0.0:
            cheapest = price, total, trade
        if np.max(np.abs(step)) < _SETTLED:
            break
    if cheapest is not None:
        # what exact traces pass; the model knows nothing of adjustments at the end of their range, and may lead astray
        _, total, trade = cheapest
    for _ in range(_LAST):
        if trade.quantile(nothing)[0] <= 0.0:
            break
        total = total + trade.tightened(np.where(costs.kept, 0.0, np.clip(low - total, -np.log(BOUND), 0.0)))
        trade = _Trade.at(bench, total, samples, costs, share)
    passes = trade.quantile(nothing)[0] <= 0.0
    for looser in (passes, False):
        limits, rounded = _graded(setup, trade, total, spec, looser)
        final = _Trade.at(bench, np.log(rounded), samples, costs, share)
        if final.quantile(nothing)[0] <= 0.0:
            break
    predicted = final.passing(nothing)
    advance("allocation", ROUNDS, ROUNDS)
    cost = np.stack([costs.of_each(nothing), costs.of_each(np.log(rounded))])
    return Allocation(
        np.exp(total),
        rounded,
        FrozenMap(limits),
        cost,
        (first, predicted),
        predicted >= spec.target,
        trade.passing(nothing) >= spec.target,
    )


class CostCurve:
    """What a limit costs: through stated points a smooth line that never rises, straight beyond them, in logarithms.

    Parameters
    ----------
    points
        Limits over the stated one and their costs, ascending, two at least.
    """

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        self._x, self._y = np.log(np.array(points)).T
        self._line = PchipInterpolator(self._x, self._y)
        self._slope = self._line.derivative()

    def __call__(self, level: float) -> tuple[float, float]:
        """Logarithm of the cost, and its derivative, at the logarithm of a limit over the stated one."""
        x, y = self._x, self._y
        if x[0] <= level <= x[-1]:
            return float(self._line(level)), float(self._slope(level))
        near, inner = (0, 1) if level < x[0] else (-1, -2)
        slope = float((y[near] - y[inner]) / (x[near] - x[inner]))
        return float(y[near] + slope * (level - x[near])), slope


@dataclass(frozen=True, eq=False)
class _Costs:
    """What limits cost.

    Attributes
    ----------
    curves : tuple[CostCurve, ...]
        Logarithm of the cost of every entry by that of its limit over the stated one, E.
    kept : np.ndarray
        Whether its limit stays: as stated, and where its distribution is not about zero.
    """

    curves: tuple[CostCurve, ...]
    kept: np.ndarray

    @classmethod
    def of(cls, setup: ToleranceSetup) -> _Costs:
        entries = list(setup.test.tolerances.values())
        kept = [one.kept or one.mean is not None or one.measured is not None for one in entries]
        return cls(tuple(CostCurve(one.cost_points) for one in entries), np.array(kept))

    def of_each(self, level: np.ndarray) -> np.ndarray:
        """Of every entry, (E,), with limits at exp(level) times the stated ones."""
        return np.exp([curve(x)[0] for curve, x in zip(self.curves, level.tolist(), strict=True)])

    def of_level(self, level: np.ndarray) -> float:
        """Of all entries."""
        return float(np.sum(self.of_each(level)))

    def slope(self, level: np.ndarray) -> np.ndarray:
        """Derivatives of the costs by the level, (E,)."""
        both = np.array([curve(x) for curve, x in zip(self.curves, level.tolist(), strict=True)])
        return np.asarray(np.exp(both[:, 0]) * both[:, 1])


class _Trade:
    """Worst margins of cameras as functions of the limits, about those of a bench.

    Parameters
    ----------
    bench
        At whose limits the model was made.
    model
        Of its merits.
    samples
        Draws and the errors of their adjustments.
    costs
        Of the limits.
    share
        Of the cameras that is to pass.
    values
        Of the merits of the first of the cameras by exact traces; they are traced if they are not given.
    """

    def __init__(
        self,
        bench: ToleranceBench,
        model: MeritModel,
        samples: Samples,
        costs: _Costs,
        share: float,
        values: np.ndarray | None = None,
    ) -> None:
        self.bench, self.costs, self.share = bench, costs, share
        self.model = ScaledModel.of(model, samples.x[:DRAWS], list(bench.entries.values()))
        count = min(CHECKED, len(self.model.first))
        if values is None:
            errors = adjustment_errors(bench, samples.seeds[:count].tolist())
            values = bench.values(bench.try_out(samples.x[:count] * bench.sizes, errors).parts)
        exact = self._margins(values[:count])
        own = self._worst(self.model.parts(np.ones(len(costs.kept))))[:count]
        self.offset = float(np.quantile(exact, share) - np.quantile(own, share))

    @classmethod
    def at(cls, bench: ToleranceBench, total: np.ndarray, samples: Samples, costs: _Costs, share: float) -> _Trade:
        """About limits at exp(total) (E,) times those of a bench."""
        now = bench.scaled(np.exp(total))
        return cls(now, sensitivities(now).model, samples, costs, share)

    def _margins(self, values: np.ndarray) -> np.ndarray:
        """Worst margin of every camera, (S,), of values (S, M); without light one that quantiles can be taken of."""
        worst = self.bench.worst_margins(values)
        return np.asarray(np.where(np.isinf(worst), 1e3, worst))

    def _worst(self, parts: np.ndarray) -> np.ndarray:
        return self._margins(self.bench.values(parts))

    def passing(self, level: np.ndarray) -> float:
        """Share of the cameras that pass with limits at exp(level) times the bench's."""
        return float(np.mean(self._worst(self.model.parts(np.exp(level))) + self.offset <= 0.0))

    def quantile(self, level: np.ndarray) -> tuple[float, np.ndarray]:
        """The margin that the share keeps, and its gradient by ``level``, the mean of those of cameras near it."""
        parts = self.model.parts(np.exp(level))
        margin = self._worst(parts)
        order = np.argsort(margin)
        at = min(len(order) - 1, int(np.ceil(self.share * len(order))) - 1)
        half = max(8, int(_NEAR * len(order)))
        near = order[max(0, at - half) : at + half + 1]
        change = self.model.slope(np.exp(level), near)
        slope = np.zeros(len(level))
        for e in np.flatnonzero(~self.costs.kept):
            ahead = self._worst(parts[near] + _STEP * change[:, :, e])
            slope[e] = float(np.mean(ahead - margin[near])) / _STEP
        return float(margin[order[at]]) + self.offset, slope

    def cheapest(self, low: np.ndarray, high: np.ndarray, total: np.ndarray) -> np.ndarray:
        """The step (E,) within bounds to the cheapest limits that pass; without any, to the tightest.

        Parameters
        ----------
        low : np.ndarray
            Bounds of the step, (E,).
        high : np.ndarray
            likewise.
        total : np.ndarray
            Where the bench's own limits are, (E,).
        """
        start = self.tightened(low)
        if self.costs.kept.all() or self.quantile(start)[0] > 0.0:
            return start
        size = self.costs.of_level(total)
        found = minimize(
            lambda step: self.costs.of_level(total + step) / size,
            start,
            jac=lambda step: self.costs.slope(total + step) / size,
            bounds=list(zip(low, high, strict=True)),
            constraints={
                "type": "ineq",
                "fun": lambda step: -self.quantile(step)[0],
                "jac": lambda step: -self.quantile(step)[1],
            },
            method="SLSQP",
            options={"maxiter": _STEPS, "ftol": 1e-4},
        )
        return self._between(start, np.clip(found.x, low, high), total)

    def tightened(self, low: np.ndarray) -> np.ndarray:
        """The first step (E,) on the way to the tightest limits, ``low``, that passes; that to the tightest if none
        does.
        """
        for part in np.linspace(0.0, 1.0, 33):
            if self.quantile(part * low)[0] <= 0.0:
                return np.asarray(part * low)
        return low

    def _between(self, inside: np.ndarray, outside: np.ndarray, total: np.ndarray) -> np.ndarray:
        """The cheapest limits that pass on the way from those that do to others."""
        best = inside
        for part in np.linspace(0.0, 1.0, 17)[1:]:
            step = inside + part * (outside - inside)
            cheaper = self.costs.of_level(total + step) < self.costs.of_level(total + best)
            if cheaper and self.quantile(step)[0] <= 0.0:
                best = step
        return best


def _graded(
    setup: ToleranceSetup, trade: _Trade, total: np.ndarray, spec: AllocationSpec, looser: bool
) -> tuple[dict[str, str | float], np.ndarray]:
    """Limits rounded down to grades; then, if some may be looser, one after the other goes up where the yield allows.

    Returns
    -------
    tuple[dict[str, str | float], np.ndarray]
        Entry -> limit, and limits over the stated ones, (E,).
    """
    entries = list(setup.test.tolerances.items())
    old = np.array([one.limit_si for _, one in entries])
    ladders: list[list[tuple[str | float, float]]] = []
    for e, (_, one) in enumerate(entries):
        stays = [(one.limit, one.limit_si)]
        own = _ladder(one.limit, one.parts[1], one.limit_si * float(np.exp(total[e])), spec.grades)
        ladders.append(stays if trade.costs.kept[e] else own)
    chosen = np.zeros(len(entries), dtype=int)

    def scales(which: np.ndarray) -> np.ndarray:
        return np.array([ladder[k][1] for ladder, k in zip(ladders, which, strict=True)]) / old

    if looser:
        gain = -trade.costs.slope(total)
        for e in np.argsort(-gain, kind="stable"):
            for k in range(1, len(ladders[e])):
                tried = chosen.copy()
                tried[e] = k
                if scales(tried)[e] > spec.loosest or trade.quantile(np.log(scales(tried)) - total)[0] > 0.0:
                    break
                chosen = tried
    limits = {name: ladder[k][0] for (name, _), ladder, k in zip(entries, ladders, chosen, strict=True)}
    return limits, scales(chosen)


def _ladder(limit: str | float, kind: str, value: float, grades: Sequence[float]) -> list[tuple[str | float, float]]:
    """The grade at or below a value and those near above it, as files have them and in SI; grades are counted in the
    unit of the old limit.
    """
    parts = split_quantity(limit)
    unit = amount_si(f"1 {parts[1]}", kind) if parts is not None else 1.0
    number = value / unit
    decade = int(np.floor(np.log10(number)))
    steps = sorted(float(f"{g}e{d}") for d in (decade - 1, decade, decade + 1) for g in grades)
    below = max((k for k, step in enumerate(steps) if step <= number * (1.0 + 1e-9)), default=0)
    texts: list[str | float] = [f"{step:g} {parts[1]}" if parts is not None else step for step in steps]
    # farther than in a round the model is not trusted
    near = [text for text, step in zip(texts, steps, strict=True) if step <= BOUND * number]
    return [(text, amount_si(text, kind)) for text in near[below:]]
