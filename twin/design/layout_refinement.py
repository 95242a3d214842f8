"""The best layout of a search made better by exact gradients.

What is wanted is the least of a largest ratio: of each quantity that is left to what is wanted of it. Such a minimum
lies where several ratios are equal, and has no gradient of its own. So each step is a linear programme over all ratios
at once, within a box about the layout and within the ranges of its numbers (Fletcher and Sainz de la Maza, Math.
Programming 43, 235, 1989); the box grows where the layout that is then built keeps what was promised, and shrinks where
it does not. Whether bodies have room is asked of every layout that is built. Where they have none, the numbers that no
goal depends on, most of those that place prisms, are drawn anew a few times to make room for the step; if that does not
help, its numbers are changed one by one, and those that make the layout better stay.

The gradients: where prisms and facets stand is itself found by tracing, so no chain of closed formulas leads from a
pupil offset to a sigma. Two parts do: the sigma's derivative by the traced derivatives A of the spots and by their
noise R is exact matrix calculus (``Information.slopes``); A and R, which are smooth in every number of a layout, are
differentiated by central differences of high order of layouts that are built anew. The stated error has two parts from
the same layouts: the difference from the next lower order, and a jump within the steps, as where a 180-deg prism is
exchanged for its mirror image (``monitor_chain``) of a beam in the plane of symmetry. A slope across a jump does not
exist; its error is as large as itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import linprog

from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.instrument_builder import build_instrument
from scenes.models.monitor_layout import Beam, Layout, layout_spec, number_of, ranges
from scenes.yaml.errors import InputError
from twin.design.layout_bench import FULLEST, LayoutBench, LayoutFacts
from twin.monitor.information import Information

FIRST_BOX = 0.1
"""Half of its side at first, relative to the range of each number."""
LEAST_BOX = 2e-3
"""Half of the box's side below which nothing more is sought."""
WORTH = 1e-3
"""Share of the largest ratio that a number has to be worth over its whole range to be moved for its own sake."""
ROOM, ROOM_STEP = 8, 0.06
"""How often room is sought for a step, and by how much all else is changed then, relative to its range, rms."""
_KEPT = 0.2  # share of what a step promised that makes it a good one
_ORDER = 2  # of the differences: right to a per cent, which is all that a step can make use of

Ask = Callable[[str, Sequence[Any]], list[Any]]
"""Part of the search and items -> what comes of them."""


def ratios(sigmas: Mapping[str, Mapping[str, float]], bench: LayoutBench) -> dict[tuple[str, str], float]:
    """Disturbances and quantity -> what is left of it over what is wanted, of all goals.

    Parameters
    ----------
    sigmas : Mapping[str, Mapping[str, float]]
        Disturbances -> quantity -> sigma, SI.
    bench : LayoutBench
        Of the design.
    """
    wanted = bench.setup.test.goal.wanted.items()
    return {
        (name, key): own[key] / goal
        for name, own in sigmas.items()
        for what, goal in wanted
        for key in bench.goals_of(what)
    }


def refined(
    bench: LayoutBench, ask: Ask, part: str, facts: LayoutFacts, steps: int, rng: np.random.Generator
) -> list[LayoutFacts]:
    """Layouts on the way from one to the best near it, each better than the one before.

    Parameters
    ----------
    bench : LayoutBench
        Of the design.
    ask : Ask
        For slopes and layouts.
    part : str
        Of the search, for the progress.
    facts : LayoutFacts
        Of the layout to begin with, which can stand.
    steps : int
        Gradients that are asked for, at most.
    rng : np.random.Generator
        Source of all that is drawn to make room.

    Returns
    -------
    list[LayoutFacts]
        At least the first.
    """
    way, box = [facts], FIRST_BOX
    every = numbers = numbers_of(bench, facts.beams, _ORDER)
    for _ in range(steps):
        here = way[-1]
        slopes = ask(f"{part}: slopes", [replace(one, beams=here.beams) for one in numbers])
        slopes = [slope for slope in slopes if not slope.refused and _worth(bench, here, slope) > WORTH]
        if not slopes:
            break
        # what no goal depends on here it will not depend on a step away
        numbers = tuple(slope.number for slope in slopes)
        better = None
        while better is None and box >= LEAST_BOX:
            change, promised = _step(bench, here, slopes, box)
            if promised <= 0.0:
                break
            wanted = _moved(bench, here.beams, numbers, change)
            found = ask(f"{part}: layout", [wanted])[0]
            if found.refused:
                idle = [one for one in every if (one.beam, one.name) not in {(n.beam, n.name) for n in numbers}]
                found = _with_room(bench, ask, part, wanted, idle, rng)
            if found.refused:
                found = _one_by_one(bench, ask, part, here, slopes, change)
            gained = _largest(here, bench) - _largest(found, bench)
            if gained > _KEPT * promised:
                box = min(2.0 * box, 0.5)
            else:
                box *= 0.5
            better = found if gained > 0.0 else None
        if better is None:
            break
        way.append(better)
    return way


def _largest(facts: LayoutFacts, bench: LayoutBench) -> float:
    return max(ratios(facts.sigmas, bench).values())


def _slopes_of(bench: LayoutBench, facts: LayoutFacts, slope: Slope) -> np.ndarray:
    """Change of every ratio over the whole range of a number, (Q,)."""
    low, high = ranges(bench.setup)[slope.number.name]
    out, goal = [], bench.setup.test.goal.wanted
    for name, key in ratios(facts.sigmas, bench):
        value = slope.values[name].get(key, 0.0)
        out.append(value * (high - low) / goal[key.rpartition("/")[2]])
    return np.array(out)


def _worth(bench: LayoutBench, facts: LayoutFacts, slope: Slope) -> float:
    """Largest change of a ratio that a number is worth over its range, relative to the largest ratio."""
    return float(np.max(np.abs(_slopes_of(bench, facts, slope)))) / _largest(facts, bench)


def _step(bench: LayoutBench, facts: LayoutFacts, slopes: Sequence[Slope], box: float) -> tuple[np.ndarray, float]:
    """Changes of V numbers, relative to their ranges, that make the largest ratio least as far as slopes tell, and by
    how much it then falls.
    """
    now = np.array(list(ratios(facts.sigmas, bench).values()))
    table = np.stack([_slopes_of(bench, facts, slope) for slope in slopes], axis=1)
    ends = [ranges(bench.setup)[slope.number.name] for slope in slopes]
    full = np.stack([slope.brightest * (high - low) for slope, (low, high) in zip(slopes, ends, strict=True)], axis=1)
    bounds = []
    for slope, (low, high) in zip(slopes, ends, strict=True):
        own = number_of(bench.setup, facts.beams[slope.number.beam], slope.number.name)
        place = (own - low) / (high - low)
        bounds.append((min(0.0, max(-box, -place)), max(0.0, min(box, 1.0 - place))))
    # unknowns: the changes, and the largest ratio
    rows = np.concatenate([np.hstack([table, -np.ones((len(now), 1))]), np.hstack([full, np.zeros((len(full), 1))])])
    limits = np.concatenate([-now, np.maximum(FULLEST - facts.brightest, 0.0)])
    cost = np.concatenate([np.zeros(len(slopes)), [1.0]])
    found = linprog(cost, rows, limits, bounds=[*bounds, (None, None)], method="highs")
    if found.x is None:
        return np.zeros(len(slopes)), 0.0
    return found.x[:-1], float(now.max() - found.x[-1])


def _moved(bench: LayoutBench, beams: Layout, numbers: Sequence[LayoutNumber], change: np.ndarray) -> Layout:
    out: list[Beam] = list(beams)
    for number, part in zip(numbers, change, strict=True):
        low, high = ranges(bench.setup)[number.name]
        value = number_of(bench.setup, out[number.beam], number.name) + float(part) * (high - low)
        out[number.beam] = out[number.beam].changed({number.name: float(np.clip(value, low, high))})
    return tuple(out)


def _with_room(
    bench: LayoutBench, ask: Ask, part: str, beams: Layout, idle: Sequence[LayoutNumber], rng: np.random.Generator
) -> LayoutFacts:
    """The best that stands of a layout with its idle numbers drawn anew; one that is refused where none does."""
    tried = [_moved(bench, beams, idle, ROOM_STEP * rng.standard_normal(len(idle))) for _ in range(ROOM if idle else 0)]
    found = [facts for facts in ask(f"{part}: room", tried) if not facts.refused]
    return min(found, key=lambda facts: _largest(facts, bench), default=LayoutFacts(beams, refused="no room"))


def _one_by_one(
    bench: LayoutBench, ask: Ask, part: str, facts: LayoutFacts, slopes: Sequence[Slope], change: np.ndarray
) -> LayoutFacts:
    """The best layout that some of a step's changes make, tried in turn, the most promising first."""
    worst = int(np.argmax(list(ratios(facts.sigmas, bench).values())))
    gain = [abs(_slopes_of(bench, facts, slope)[worst] * c) for slope, c in zip(slopes, change, strict=True)]
    for k in np.argsort(gain)[::-1]:
        if change[k] == 0.0:
            continue
        found = ask(f"{part}: layout", [_moved(bench, facts.beams, [slopes[k].number], change[[k]])])[0]
        if not found.refused and _largest(found, bench) < _largest(facts, bench):
            facts = found
    return facts


STEP = 0.01
"""Step of a number, relative to the range in which it may vary: A is smooth over all of it, and aimed to 1e-9 of it."""
ORDER = 6
"""Order of the central differences, where nothing else is asked for."""
_WEIGHTS = {2: {1: 1.0 / 2.0}, 4: {1: 8.0 / 12.0, 2: -1.0 / 12.0}, 6: {1: 45.0 / 60.0, 2: -9.0 / 60.0, 3: 1.0 / 60.0}}
"""Order -> weights of central differences by the number of steps (Fornberg, Math. Comp. 51, 699, 1988)."""
_JUMP = {4: {1: 4.0 / 3.0, 2: -1.0 / 3.0}, 6: {1: 1.5, 2: -0.6, 3: 0.1}}
"""Order -> weights of f(k h) + f(-k h) - 2 f(0). Their sum is what that tends to with k, extrapolated by even powers:
nothing of a smooth f. Of a jump J anywhere within the steps it is such a part of J that, over h, it bounds what J does
to the central difference: J of the first step against 0.62 J, J/2 of the second against 0.13 J, J/10 of the third
against 0.02 J for order 6.
"""


@dataclass(frozen=True)
class LayoutNumber:
    """One of the numbers of a layout.

    Attributes
    ----------
    beams : Layout
        The layout.
    beam : int
        Which of them, counted from 0.
    name : str
        Of the number, one of ``monitor_layout.CONTINUOUS``.
    order : int
        Of the differences, 2, 4 or 6.
    """

    beams: Layout
    beam: int
    name: str
    order: int = ORDER

    def moved(self, bench: LayoutBench, by: float) -> Layout:
        """The layout with this number changed.

        Parameters
        ----------
        bench : LayoutBench
            Of the design.
        by : float
            The change, SI.
        """
        own = self.beams[self.beam]
        value = number_of(bench.setup, own, self.name) + by
        return (*self.beams[: self.beam], own.changed({self.name: value}), *self.beams[self.beam + 1 :])


@dataclass(frozen=True, eq=False)
class Slope:
    """Derivative of what a layout leaves by one of its numbers.

    Attributes
    ----------
    number : LayoutNumber
        which.
    refused : str
        Why it cannot be told, empty where it can; nothing else is then known.
    values : Mapping[str, Mapping[str, float]]
        Disturbances -> quantity -> d(sigma)/d(number), SI.
    errors : Mapping[str, Mapping[str, float]]
        Likewise, by how much each may be wrong; empty for differences of second order, below which is none.
    brightest : np.ndarray
        Derivative of how full the brightest pixel of each of C spots is, (C,), per SI unit.
    """

    number: LayoutNumber
    refused: str = ""
    values: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    errors: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    brightest: np.ndarray = field(default_factory=lambda: np.zeros(0))


def numbers_of(bench: LayoutBench, beams: Layout, order: int = ORDER) -> tuple[LayoutNumber, ...]:
    """All numbers of a layout that may vary.

    Parameters
    ----------
    bench : LayoutBench
        Of the design.
    beams : Layout
        The layout.
    order : int
        Of the differences.
    """
    names = [name for name, (low, high) in ranges(bench.setup).items() if high > low]
    return tuple(LayoutNumber(beams, k, name, order) for k in range(len(beams)) for name in names)


@lru_cache(maxsize=2)
def _known_here(bench: LayoutBench, beams: Layout) -> dict[str, Information]:
    """Result of ``known_of``, kept for the layout at which all numbers are differentiated."""
    return known_of(bench, beams)


def known_of(bench: LayoutBench, beams: Layout) -> dict[str, Information]:
    """What a layout's spots know, by the names of the disturbances, whether or not its bodies have room.

    Parameters
    ----------
    bench : LayoutBench
        Of the design.
    beams : Layout
        The layout.

    Raises
    ------
    InputError
        Its prisms or facets cannot be placed.
    BeamMissedError, AimError
        Light does not come to its area CCDs.
    """
    spec = layout_spec(bench.setup, beams)
    instrument = build_instrument(spec, bench.setup.cameras, bench.backend, free_beams=False, free_bodies=False)
    return bench.information(instrument, beams[0], single=False)


def slope_of(bench: LayoutBench, number: LayoutNumber) -> Slope:
    """Derivative of all sigmas of a layout by one of its numbers.

    Parameters
    ----------
    bench : LayoutBench
        Of the design.
    number : LayoutNumber
        Of a layout.
    """
    low, high = ranges(bench.setup)[number.name]
    step, high_order, low_order = STEP * (high - low), _WEIGHTS[number.order], _WEIGHTS.get(number.order - 2, {})
    try:
        here = _known_here(bench, number.beams)
        best, lower, jump = ({name: _Sum.none(one) for name, one in here.items()} for _ in range(3))
        jumps = _JUMP.get(number.order, {})
        for name, one in here.items():
            jump[name].add(-2.0 * sum(jumps.values()) / step, one)
        for k, weight in high_order.items():
            for sign in (1.0, -1.0):
                for name, one in known_of(bench, number.moved(bench, sign * k * step)).items():
                    best[name].add(sign * weight / step, one)
                    lower[name].add(sign * low_order.get(k, 0.0) / step, one)
                    jump[name].add(jumps.get(k, 0.0) / step, one)
    except (InputError, AimError, BeamMissedError, ValueError) as error:
        return Slope(number, refused=str(error))
    values: dict[str, dict[str, float]] = {}
    errors: dict[str, dict[str, float]] = {}
    for name, one in here.items():
        slopes = {key: one.slopes(key) for key in one.quantities if one.sigma(key) > 0.0}
        values[name] = {key: best[name].along(*slope) for key, slope in slopes.items()}
        if low_order:
            errors[name] = {
                key: abs(values[name][key] - lower[name].along(*slope)) + abs(jump[name].along(*slope))
                for key, slope in slopes.items()
            }
    return Slope(number, values=values, errors=errors, brightest=next(iter(best.values())).brightest)


@dataclass(eq=False)
class _Sum:
    """Weighted sum of A, of R, and of how full the brightest pixels are."""

    spots: np.ndarray
    noise: np.ndarray
    brightest: np.ndarray

    @classmethod
    def none(cls, like: Information) -> _Sum:
        return cls(*(np.zeros_like(a) for a in (like.disturbances.spots, like.noise, like.brightest)))

    def add(self, weight: float, one: Information) -> None:
        self.spots += weight * one.disturbances.spots
        self.noise += weight * one.noise
        self.brightest += weight * one.brightest

    def along(self, by_spots: np.ndarray, by_noise: np.ndarray) -> float:
        return float(np.sum(by_spots * self.spots) + np.sum(by_noise * self.noise))
