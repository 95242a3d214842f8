"""Allocation of tolerance limits: the limits that reach a required yield at the lowest cost.

The same random numbers serve all limits: each varied parameter of a random camera is its limit times a fixed random
number, the merits follow from their second-order model, and the quantile of the worst margin at the required yield (the
fraction of cameras that pass) has a gradient with respect to the limits. A margin is the excess of a merit over its
requirement, relative to the requirement. The limits change by a bounded factor in each round. Then the model is
computed again about the new limits, and exact traces of some of the cameras correct its quantile by an offset. A Monte
Carlo run of independent cameras validates the result.
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
"""Number of random cameras from which the limits are chosen."""
CHECKED = 1000
"""Number of the ``DRAWS`` cameras that are traced exactly in every round."""
ROUNDS = 6
"""Largest number of rounds in which limits are changed and the model is computed again."""
BOUND = 2.0
"""Largest factor by which a limit may change in a round."""
_STEPS = 60
"""Largest number of iterations of the optimiser in a round."""
_STEP = 1e-5
"""Step, in the natural logarithm of a limit, of the numerical derivative of the margins."""
_SETTLED = 0.1
"""Largest change of the natural logarithm of any limit in a round that ends the iteration."""
_LAST = 4
"""Largest number of final rounds that tighten all limits together while exact traces miss the required yield."""
_NEAR = 0.02
"""Fraction of all cameras, on either side of the quantile of the worst margin, whose gradients are averaged."""
_SAFE = 1.0
"""Margin of the chosen limits: the yield exceeds the required one by this many standard deviations.

The standard deviation is that of a yield estimated from a sample of cameras.
"""


@dataclass(frozen=True, eq=False)
class Allocation:
    """Result of an allocation: the chosen limits with their costs and yields.

    Array dimensions: E tolerances.

    Attributes
    ----------
    scales, rounded : (E,) ndarray
        Ratio of the new to the specified limit of every tolerance, before and after rounding to the grades (preferred
        values).
    limits : dict
        New limit of every tolerance by name, in the notation of a budget file: a quantity with its unit, or a pure
        number.
    costs : (2, E) ndarray
        Cost of every limit in the budget's unit of cost, before and after the allocation.
    predicted : tuple of float
        Yield (fraction of cameras that meet all requirements) of the specified and of the new limits, by the corrected
        model.
    reached : bool
        True if the yield of the rounded limits reaches the required yield.
    unrounded : bool
        True if the yield of the limits before rounding reaches the required yield.
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
        """Total cost of all limits, before and after the allocation."""
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
    """Choose the limits that reach the required yield at the lowest cost.

    Parameters
    ----------
    setup : ToleranceSetup
        Tolerance budget.
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits.
    model : MeritModel
        Second-order model of the merits at the specified limits.
    samples : Samples
        Monte Carlo cameras of the budget.
    spec : AllocationSpec
        Required yield, bounds of the limits and grades.
    advance : Advance
        Callback that reports progress.

    Returns
    -------
    Allocation
        Chosen limits, rounded to the grades.
    """
    costs = _Costs.of(setup)
    checked = min(CHECKED, len(samples.x))
    share = spec.target + _SAFE * float(np.sqrt(spec.target * (1.0 - spec.target) / checked))
    share = min(share, 1.0 - 1.0 / checked)
    total = np.zeros(len(costs.fixed))
    low, high = -np.log(spec.tightest), np.log(spec.loosest)
    trade = _MarginModel(bench, model, samples, costs, share, samples.values)
    first, nothing = trade.passing(total), np.zeros(len(total))
    cheapest = (costs.of_level(total), total, trade) if trade.quantile(nothing)[0] <= 0.0 else None
    for iteration in range(ROUNDS):
        advance("allocation", iteration, ROUNDS)
        bounds = np.clip([low - total, high - total], -np.log(BOUND), np.log(BOUND))
        step = trade.cheapest(np.where(costs.fixed, 0.0, bounds[0]), np.where(costs.fixed, 0.0, bounds[1]), total)
        total, trade = total + step, _MarginModel.at(bench, total + step, samples, costs, share)
        price = costs.of_level(total)
        if (cheapest is None or price < cheapest[0]) and trade.quantile(nothing)[0] <= 0.0:
            cheapest = price, total, trade
        if np.max(np.abs(step)) < _SETTLED:
            break
    if cheapest is not None:
        # limits that pass exact traces: the model ignores the ends of the compensators' ranges and may mislead
        _, total, trade = cheapest
    for _ in range(_LAST):
        if trade.quantile(nothing)[0] <= 0.0:
            break
        total = total + trade.tightened(np.where(costs.fixed, 0.0, np.clip(low - total, -np.log(BOUND), 0.0)))
        trade = _MarginModel.at(bench, total, samples, costs, share)
    passes = trade.quantile(nothing)[0] <= 0.0
    for looser in (passes, False):
        limits, rounded = _rounded_to_grades(setup, trade, total, spec, looser)
        final = _MarginModel.at(bench, np.log(rounded), samples, costs, share)
        if final.quantile(nothing)[0] <= 0.0:
            break
    predicted = final.passing(nothing)
    advance("allocation", ROUNDS, ROUNDS)
    cost = np.stack([costs.of_each(nothing), costs.of_each(np.log(rounded))])
    reached = predicted >= spec.target, trade.passing(nothing) >= spec.target
    return Allocation(np.exp(total), rounded, FrozenMap(limits), cost, (first, predicted), *reached)


class CostCurve:
    """Cost of a tolerance limit as a function of the limit, interpolated monotonically in logarithms of both.

    Beyond the given points the curve continues as a straight line in logarithms.

    Parameters
    ----------
    points : sequence of tuple
        Pairs (ratio of the limit to the specified limit, cost of that limit), ascending; at least two.
    """

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        self._x, self._y = np.log(np.array(points)).T
        self._line = PchipInterpolator(self._x, self._y)
        self._slope = self._line.derivative()

    def __call__(self, level: float) -> tuple[float, float]:
        """Return the natural logarithm of the cost, and its derivative with respect to ``level``.

        ``level`` is the natural logarithm of the ratio of the limit to the specified one.
        """
        x, y = self._x, self._y
        if x[0] <= level <= x[-1]:
            return float(self._line(level)), float(self._slope(level))
        near, inner = (0, 1) if level < x[0] else (-1, -2)
        slope = float((y[near] - y[inner]) / (x[near] - x[inner]))
        return float(y[near] + slope * (level - x[near])), slope


@dataclass(frozen=True, eq=False)
class _Costs:
    """Costs of all limits of a budget with E tolerances.

    Attributes
    ----------
    curves : tuple of CostCurve
        Curve of every tolerance (E): logarithm of the cost against the logarithm of the ratio to the specified limit.
    fixed : (E,) ndarray of bool
        True for a limit that the allocation must not change: the file fixes it, or its distribution is not centred on
        zero.
    """

    curves: tuple[CostCurve, ...]
    fixed: np.ndarray

    @classmethod
    def of(cls, setup: ToleranceSetup) -> _Costs:
        """Return the cost curves of all limits of a budget, and which limits are fixed."""
        entries = list(setup.test.tolerances.values())
        fixed = [
            tolerance.kept or tolerance.mean is not None or tolerance.measured is not None for tolerance in entries
        ]
        return cls(tuple(CostCurve(tolerance.cost_points) for tolerance in entries), np.array(fixed))

    def of_each(self, level: np.ndarray) -> np.ndarray:
        """Return the cost of every limit, (E,) for E tolerances, with limits at exp(level) times the specified ones."""
        return np.exp([curve(x)[0] for curve, x in zip(self.curves, level.tolist(), strict=True)])

    def of_level(self, level: np.ndarray) -> float:
        """Return the total cost of all limits, with limits at exp(level) times the specified ones."""
        return float(np.sum(self.of_each(level)))

    def slope(self, level: np.ndarray) -> np.ndarray:
        """Return the derivative of each limit's cost with respect to the limit's natural logarithm."""
        values = np.array([curve(x) for curve, x in zip(self.curves, level.tolist(), strict=True)])
        return np.asarray(np.exp(values[:, 0]) * values[:, 1])


class _MarginModel:
    """Model of each random camera's worst margin as a function of the limits, about the limits of a budget.

    A margin is the excess of a merit over its requirement, relative to the requirement.

    Array dimensions: S cameras, M merits.

    Parameters
    ----------
    bench : ToleranceBench
        Camera of the budget, at whose limits the model was made.
    model : MeritModel
        Second-order model of the merits.
    samples : Samples
        Random parameters of the cameras, and the seeds of their adjustment errors.
    costs : _Costs
        Costs of the limits.
    share : float
        Fraction of the cameras that must pass (required yield).
    values : (S, M) ndarray, optional
        Merits of the first cameras by exact traces; traced here by default.
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
            values = bench.values(bench.adjust_cameras(samples.x[:count] * bench.sizes, errors).parts)
        exact = self._margins(values[:count])
        modelled = self._worst(self.model.parts(np.ones(len(costs.fixed))))[:count]
        self.offset = float(np.quantile(exact, share) - np.quantile(modelled, share))

    @classmethod
    def at(
        cls, bench: ToleranceBench, total: np.ndarray, samples: Samples, costs: _Costs, share: float
    ) -> _MarginModel:
        """Build the model of the margins about new limits, exp(total) times those of a budget's camera.

        ``total`` has one entry for each tolerance.
        """
        now = bench.scaled(np.exp(total))
        return cls(now, sensitivities(now).model, samples, costs, share)

    def _margins(self, values: np.ndarray) -> np.ndarray:
        """Return the worst margin of every camera, (S,), from M merits of S cameras, (S, M).

        A margin is the excess of a merit over its requirement, relative to the requirement, negative where it is met;
        it is large but finite for a camera without light.
        """
        worst = self.bench.worst_margins(values)
        return np.asarray(np.where(np.isinf(worst), 1e3, worst))

    def _worst(self, parts: np.ndarray) -> np.ndarray:
        return self._margins(self.bench.values(parts))

    def passing(self, level: np.ndarray) -> float:
        """Return the fraction of cameras that pass, with limits at exp(level) times the present ones.

        A camera passes if it meets all requirements.
        """
        return float(np.mean(self._worst(self.model.parts(np.exp(level))) + self.offset <= 0.0))

    def quantile(self, level: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the quantile of the worst margin at the required yield, and its gradient.

        The gradient, with respect to the natural logarithms of the limits, is averaged over cameras near the quantile.
        ``level`` holds the logarithms of the ratios of the limits to the present ones.
        """
        parts = self.model.parts(np.exp(level))
        margin = self._worst(parts)
        order = np.argsort(margin)
        at = min(len(order) - 1, int(np.ceil(self.share * len(order))) - 1)
        half = max(8, int(_NEAR * len(order)))
        near = order[max(0, at - half) : at + half + 1]
        change = self.model.slope(np.exp(level), near)
        slope = np.zeros(len(level))
        for e in np.flatnonzero(~self.costs.fixed):
            ahead = self._worst(parts[near] + _STEP * change[:, :, e])
            slope[e] = float(np.mean(ahead - margin[near])) / _STEP
        return float(margin[order[at]]) + self.offset, slope

    def cheapest(self, low: np.ndarray, high: np.ndarray, total: np.ndarray) -> np.ndarray:
        """Return the step to the cheapest limits that reach the required yield, or else to the tightest limits.

        A step is a change of the natural logarithms of the limits of E tolerances.

        Parameters
        ----------
        low, high : (E,) ndarray
            Bounds of the step.
        total : (E,) ndarray
            Logarithms of the ratios of the present limits to the specified ones.

        Returns
        -------
        (E,) ndarray
            Step in the logarithms of the limits.
        """
        start = self.tightened(low)
        if self.costs.fixed.all() or self.quantile(start)[0] > 0.0:
            return start
        size = self.costs.of_level(total)
        solution = minimize(
            lambda step: self.costs.of_level(total + step) / size,
            start,
            jac=lambda step: self.costs.slope(total + step) / size,
            bounds=list(zip(low, high, strict=True)),
            constraints={"type": "ineq"}
            | {"fun": lambda s: -self.quantile(s)[0], "jac": lambda s: -self.quantile(s)[1]},
            method="SLSQP",
            options={"maxiter": _STEPS, "ftol": 1e-4},
        )
        return self._between(start, np.clip(solution.x, low, high), total)

    def tightened(self, low: np.ndarray) -> np.ndarray:
        """Return the shortest step towards the tightest limits that reaches the required yield.

        If none does, it is the whole step.

        ``low`` and the result are changes of the logarithms of the limits, one per tolerance.
        """
        for part in np.linspace(0.0, 1.0, 33):
            if self.quantile(part * low)[0] <= 0.0:
                return np.asarray(part * low)
        return low

    def _between(self, inside: np.ndarray, outside: np.ndarray, total: np.ndarray) -> np.ndarray:
        """Return the cheapest passing step on the line between two steps, of which only ``inside`` passes.

        A step is a change of the logarithms of the limits; it passes if it reaches the required yield.
        """
        best = inside
        for part in np.linspace(0.0, 1.0, 17)[1:]:
            step = inside + part * (outside - inside)
            cheaper = self.costs.of_level(total + step) < self.costs.of_level(total + best)
            if cheaper and self.quantile(step)[0] <= 0.0:
                best = step
        return best


def _rounded_to_grades(
    setup: ToleranceSetup, trade: _MarginModel, total: np.ndarray, spec: AllocationSpec, looser: bool
) -> tuple[dict[str, str | float], np.ndarray]:
    """Round limits down to grades (preferred values); if ``looser``, raise them again while the yield suffices.

    Array dimensions: E tolerances.

    Returns
    -------
    limits : dict
        Limit of every tolerance by name, in the notation of a budget file.
    scales : (E,) ndarray
        Ratios of the limits to the specified ones.
    """
    entries = list(setup.test.tolerances.items())
    old = np.array([tolerance.limit_si for _, tolerance in entries])
    ladders: list[list[tuple[str | float, float]]] = []
    for e, (_, tolerance) in enumerate(entries):
        stays = [(tolerance.limit, tolerance.limit_si)]
        steps = _grades_near(
            tolerance.limit, tolerance.parts[1], tolerance.limit_si * float(np.exp(total[e])), spec.grades
        )
        ladders.append(stays if trade.costs.fixed[e] else steps)
    chosen = np.zeros(len(entries), dtype=int)

    def scales(indices: np.ndarray) -> np.ndarray:
        return np.array([ladder[k][1] for ladder, k in zip(ladders, indices, strict=True)]) / old

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


def _grades_near(
    limit: str | float, kind: str, value: float, grades: Sequence[float]
) -> list[tuple[str | float, float]]:
    """Return the preferred value (grade) at or below a value and the next ones above it.

    Each is given in the notation of a file, in the unit of the old limit, and in SI units.
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
