"""The best layout of a search made better by exact gradients.

What is wanted is the least of a largest ratio: of each quantity that is left to what is wanted of it. Such a minimum
lies where several ratios are equal, and has no gradient of its own. So each step is a linear programme over all ratios
at once, within a box about the layout and within the ranges of its numbers (Fletcher and Sainz de la Maza, Math.
Programming 43, 235, 1989); the box grows where the layout that is then built keeps what was promised, and shrinks where
it does not. Whether bodies have room is asked of every layout that is built. Where they have none, the numbers that no
goal depends on, most of those that place prisms, are drawn anew a few times to make room for the step; if that does not
help, its numbers are changed one by one, and those that make the layout better stay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import linprog

from scenes.models.monitor_layout import Beam, Layout, number_of, ranges
from twin.design.layout_bench import FULLEST, LayoutBench, LayoutFacts
from twin.design.layout_gradient import LayoutNumber, Slope, numbers_of

FIRST_BOX = 0.1
"""Half of its side at first, relative to the range of each number."""
LEAST_BOX = 2e-3
"""The same below which nothing more is sought."""
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

    Args:
        sigmas: disturbances -> quantity -> sigma, SI.
        bench: of the design.
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

    Args:
        bench: of the design.
        ask: for slopes and layouts.
        part: of the search, for the progress.
        facts: of the layout to begin with, which can stand.
        steps: gradients that are asked for, at most.
        rng: source of all that is drawn to make room.

    Returns:
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
