"""Refinement of the best layout of a search by exact gradients.

The objective is the largest ratio of a standard deviation to its goal. Such a minimax optimum lies where several ratios
are equal, and is not differentiable. So each step is a linear programme over all ratios at once, within a trust region
(box) about the layout and within the ranges of its parameters (Fletcher and Sainz de la Maza, Math. Programming 43,
235, 1989); the box grows if the layout that is then built achieves the predicted improvement, and shrinks if not.
Collisions of bodies are checked for every layout that is built. Where there are some, parameters on which no goal
depends, mostly positions of prisms, are replaced a few times by random values to make room for the step; if that fails,
the parameters are changed one by one, and changes that improve the layout are kept.

Gradients: positions of prisms and facets are themselves found by tracing, so there is no closed formula from a pupil
offset to a sigma. The derivative of sigma with respect to A, the matrix of the traced derivatives of the spots with
respect to the motions, and with respect to R, the spots' noise covariance, is exact matrix calculus
(``Information.slopes``). A and R, which are smooth in every parameter of a layout, are differentiated by central
differences of high order of layouts that are built again. The reported error has two parts from the same layouts: the
difference from the next lower order, and a jump within the steps, for example where a 180-deg prism of a beam in the
plane of symmetry is exchanged for its mirror image (``monitor_chain``). A derivative across a jump does not exist; its
error is as large as itself.
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
from twin.monitor.monitor_derivative import Information

FIRST_BOX = 0.1
"""Initial half-width of the trust region, relative to the range of each parameter."""
LEAST_BOX = 2e-3
"""Half-width of the trust region, relative to the parameters' ranges, below which the refinement ends."""
LEAST_BENEFIT = 1e-3
"""Smallest effect for which a parameter of the layout is optimised.

It is the change of the ratio of a sigma to its goal over the parameter's whole range, relative to the largest ratio.
"""
ROOM, ROOM_STEP = 8, 0.06
"""Number of random changes of idle parameters that are tried to make a step feasible, and their rms size.

The size is relative to the ranges of the parameters.
"""
_KEPT = 0.2  # share of the predicted improvement above which the box grows
_ORDER = 2  # order of the differences: accurate to 1 %, which suffices for a step

Ask = Callable[[str, Sequence[Any]], list[Any]]
"""Function that evaluates items: from the name of a stage of the search and the items to their results."""


def ratios(sigmas: Mapping[str, Mapping[str, float]], bench: LayoutBench) -> dict[tuple[str, str], float]:
    """Return (disturbances, quantity) -> ratio of the quantity's standard deviation to its goal.

    Parameters
    ----------
    sigmas : dict
        Disturbances -> quantity -> sigma, SI units.
    bench : LayoutBench
        Evaluator of the layouts of the design.
    """
    wanted = bench.setup.test.goal.wanted.items()
    return {
        (name, key): values[key] / goal
        for name, values in sigmas.items()
        for name_of_goal, goal in wanted
        for key in bench.goals_of(name_of_goal)
    }


def refined(
    bench: LayoutBench, ask: Ask, part: str, facts: LayoutFacts, steps: int, rng: np.random.Generator
) -> list[LayoutFacts]:
    """Return successively better layouts from a starting one to the local optimum.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    ask : Ask
        Function that evaluates derivatives and layouts.
    part : str
        Stage of the search, for the progress display.
    facts : LayoutFacts
        Feasible layout at the start.
    steps : int
        Largest number of steps, each with new gradients.
    rng : Generator
        Random generator for the parameters that are varied at random to avoid collisions.

    Returns
    -------
    list of LayoutFacts
        The starting layout and its improvements.
    """
    path, box = [facts], FIRST_BOX
    all_numbers = numbers = numbers_of(bench, facts.beams, _ORDER)
    for _ in range(steps):
        current = path[-1]
        slopes = ask(f"{part}: slopes", [replace(number, beams=current.beams) for number in numbers])
        slopes = [slope for slope in slopes if not slope.refused and _benefit(bench, current, slope) > LEAST_BENEFIT]
        if not slopes:
            break
        # parameters without effect on any goal here have none a step away either
        numbers = tuple(slope.number for slope in slopes)
        better = None
        while better is None and box >= LEAST_BOX:
            change, promised = _step(bench, current, slopes, box)
            if promised <= 0.0:
                break
            wanted = _moved(bench, current.beams, numbers, change)
            layout = ask(f"{part}: layout", [wanted])[0]
            if layout.refused:
                idle = [
                    number
                    for number in all_numbers
                    if (number.beam, number.name) not in {(n.beam, n.name) for n in numbers}
                ]
                layout = _with_room(bench, ask, part, wanted, idle, rng)
            if layout.refused:
                layout = _improved_singly(bench, ask, part, current, slopes, change)
            gained = _largest(current, bench) - _largest(layout, bench)
            if gained > _KEPT * promised:
                box = min(2.0 * box, 0.5)
            else:
                box *= 0.5
            better = layout if gained > 0.0 else None
        if better is None:
            break
        path.append(better)
    return path


def _largest(facts: LayoutFacts, bench: LayoutBench) -> float:
    return max(ratios(facts.sigmas, bench).values())


def _slopes_of(bench: LayoutBench, facts: LayoutFacts, slope: Slope) -> np.ndarray:
    """Return the linearised change of Q ratios of sigma to goal over a parameter's whole range, (Q,)."""
    low, high = ranges(bench.setup)[slope.number.name]
    out, goal = [], bench.setup.test.goal.wanted
    for name, key in ratios(facts.sigmas, bench):
        value = slope.values[name].get(key, 0.0)
        out.append(value * (high - low) / goal[key.rpartition("/")[2]])
    return np.array(out)


def _benefit(bench: LayoutBench, facts: LayoutFacts, slope: Slope) -> float:
    """Return the largest change of a ratio of sigma to goal over a parameter's range, relative to the largest ratio."""
    return float(np.max(np.abs(_slopes_of(bench, facts, slope)))) / _largest(facts, bench)


def _step(bench: LayoutBench, facts: LayoutFacts, slopes: Sequence[Slope], box: float) -> tuple[np.ndarray, float]:
    """Return the parameter changes that minimise the largest linearised ratio of sigma to goal, and its decrease.

    The changes are relative to the ranges of the parameters.
    """
    now = np.array(list(ratios(facts.sigmas, bench).values()))
    table = np.stack([_slopes_of(bench, facts, slope) for slope in slopes], axis=1)
    ends = [ranges(bench.setup)[slope.number.name] for slope in slopes]
    full = np.stack([slope.brightest * (high - low) for slope, (low, high) in zip(slopes, ends, strict=True)], axis=1)
    bounds = []
    for slope, (low, high) in zip(slopes, ends, strict=True):
        value = number_of(bench.setup, facts.beams[slope.number.beam], slope.number.name)
        position = (value - low) / (high - low)
        bounds.append((min(0.0, max(-box, -position)), max(0.0, min(box, 1.0 - position))))
    # unknowns: the changes, and the largest ratio
    rows = np.concatenate([np.hstack([table, -np.ones((len(now), 1))]), np.hstack([full, np.zeros((len(full), 1))])])
    limits = np.concatenate([-now, np.maximum(FULLEST - facts.brightest, 0.0)])
    cost = np.concatenate([np.zeros(len(slopes)), [1.0]])
    solution = linprog(cost, rows, limits, bounds=[*bounds, (None, None)], method="highs")
    if solution.x is None:
        return np.zeros(len(slopes)), 0.0
    return solution.x[:-1], float(now.max() - solution.x[-1])


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
    """Return the best feasible layout after random changes of the parameters on which no goal depends.

    If none is feasible, it is one with the reason of refusal.
    """
    tried = [_moved(bench, beams, idle, ROOM_STEP * rng.standard_normal(len(idle))) for _ in range(ROOM if idle else 0)]
    feasible = [facts for facts in ask(f"{part}: room", tried) if not facts.refused]
    return min(feasible, key=lambda facts: _largest(facts, bench), default=LayoutFacts(beams, refused="no room"))


def _improved_singly(
    bench: LayoutBench, ask: Ask, part: str, facts: LayoutFacts, slopes: Sequence[Slope], change: np.ndarray
) -> LayoutFacts:
    """Return a layout improved by the single parameter changes of a step, tried in turn, the most promising first."""
    worst = int(np.argmax(list(ratios(facts.sigmas, bench).values())))
    gain = [abs(_slopes_of(bench, facts, slope)[worst] * c) for slope, c in zip(slopes, change, strict=True)]
    for k in np.argsort(gain)[::-1]:
        if change[k] == 0.0:
            continue
        layout = ask(f"{part}: layout", [_moved(bench, facts.beams, [slopes[k].number], change[[k]])])[0]
        if not layout.refused and _largest(layout, bench) < _largest(facts, bench):
            facts = layout
    return facts


STEP = 0.01
"""Step of a parameter in the central differences, relative to its range.

The traced derivatives of the spots are smooth over the whole range, and rays are aimed to 1e-9 of it.
"""
ORDER = 6
"""Default order of the central differences (error proportional to the step to this power)."""
_WEIGHTS = {2: {1: 1.0 / 2.0}, 4: {1: 8.0 / 12.0, 2: -1.0 / 12.0}, 6: {1: 45.0 / 60.0, 2: -9.0 / 60.0, 3: 1.0 / 60.0}}
"""Order -> number k of steps -> weight of the difference f(k h) - f(-k h) in a central difference with step h.

The weights are those of Fornberg, Math. Comp. 51, 699, 1988.
"""
_JUMP = {4: {1: 4.0 / 3.0, 2: -1.0 / 3.0}, 6: {1: 1.5, 2: -0.6, 3: 0.1}}
"""Order -> number k of steps -> weight of the second difference f(k h) + f(-k h) - 2 f(0), to detect jumps of f.

f is a function of a layout parameter and h the step. The weighted sum is extrapolated by even powers of h and tends to
zero for a smooth f. If f has a jump J anywhere within the steps, the sum keeps a part of J that, divided by h, is an
upper limit for the effect of J on the central difference. For order 6 the part and the effect (times h) are J and 0.62
J for a jump within the first step, J/2 and 0.13 J within the second, J/10 and 0.02 J within the third.
"""


@dataclass(frozen=True)
class LayoutNumber:
    """Continuous parameter of a monitor layout, such as the position of a beam in the pupil.

    Attributes
    ----------
    beams : Layout
        Layout of the monitor (its beams).
    beam : int
        Index of the beam, from 0.
    name : str
        Name of the parameter, one of ``monitor_layout.CONTINUOUS``.
    order : int
        Order of the central differences with respect to it, 2, 4 or 6.
    """

    beams: Layout
    beam: int
    name: str
    order: int = ORDER

    def moved(self, bench: LayoutBench, by: float) -> Layout:
        """Return the layout with this parameter changed by an amount.

        Parameters
        ----------
        bench : LayoutBench
            Evaluator of the layouts of the design.
        by : float
            Change, SI units.
        """
        beam = self.beams[self.beam]
        value = number_of(bench.setup, beam, self.name) + by
        return (*self.beams[: self.beam], beam.changed({self.name: value}), *self.beams[self.beam + 1 :])


@dataclass(frozen=True, eq=False)
class Slope:
    """Derivatives of a layout's standard deviations with respect to one of its parameters.

    Attributes
    ----------
    number : LayoutNumber
        The parameter.
    refused : str
        Reason why they cannot be computed, empty if they can; the other attributes are then empty.
    values : dict
        Disturbances -> quantity -> d(sigma)/d(parameter), SI units.
    errors : dict
        Numerical error of each derivative, in the same form; empty for differences of second order.
    brightest : (C,) ndarray
        Derivatives, per SI unit, of the signal of the brightest pixel of each of C spots as a fraction of its capacity.
    """

    number: LayoutNumber
    refused: str = ""
    values: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    errors: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    brightest: np.ndarray = field(default_factory=lambda: np.zeros(0))


def numbers_of(bench: LayoutBench, beams: Layout, order: int = ORDER) -> tuple[LayoutNumber, ...]:
    """Return all continuous parameters of a layout that may vary.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    beams : Layout
        Layout of the monitor (its beams).
    order : int
        Order of the central differences by which they are differentiated.
    """
    names = [name for name, (low, high) in ranges(bench.setup).items() if high > low]
    return tuple(LayoutNumber(beams, k, name, order) for k in range(len(beams)) for name in names)


@lru_cache(maxsize=2)
def _known_here(bench: LayoutBench, beams: Layout) -> dict[str, Information]:
    """Return the Fisher information of a layout's spots, cached for the layout that is differentiated."""
    return known_of(bench, beams)


def known_of(bench: LayoutBench, beams: Layout) -> dict[str, Information]:
    """Return disturbances -> Fisher information of a layout's spots about the cameras; collisions are not checked.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    beams : Layout
        Layout of the monitor (its beams).

    Raises
    ------
    InputError
        Its prisms or facets cannot be placed.
    BeamMissedError, AimError
        Light does not reach its area CCDs.
    """
    spec = layout_spec(bench.setup, beams)
    instrument = build_instrument(spec, bench.setup.cameras, bench.backend, free_beams=False, free_bodies=False)
    return bench.information(instrument, beams[0], single=False)


def slope_of(bench: LayoutBench, number: LayoutNumber) -> Slope:
    """Return the derivatives of all standard deviations of a layout with respect to one of its parameters.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    number : LayoutNumber
        Parameter of a layout.
    """
    low, high = ranges(bench.setup)[number.name]
    step, high_order, low_order = STEP * (high - low), _WEIGHTS[number.order], _WEIGHTS.get(number.order - 2, {})
    try:
        centre = _known_here(bench, number.beams)
        best, lower, jump = ({name: _Sum.none(info) for name, info in centre.items()} for _ in range(3))
        jumps = _JUMP.get(number.order, {})
        for name, info in centre.items():
            jump[name].add(-2.0 * sum(jumps.values()) / step, info)
        for k, weight in high_order.items():
            for sign in (1.0, -1.0):
                for name, info in known_of(bench, number.moved(bench, sign * k * step)).items():
                    best[name].add(sign * weight / step, info)
                    lower[name].add(sign * low_order.get(k, 0.0) / step, info)
                    jump[name].add(jumps.get(k, 0.0) / step, info)
    except (InputError, AimError, BeamMissedError, ValueError) as error:
        return Slope(number, refused=str(error))
    values: dict[str, dict[str, float]] = {}
    errors: dict[str, dict[str, float]] = {}
    for name, info in centre.items():
        slopes = {key: info.slopes(key) for key in info.quantities if info.sigma(key) > 0.0}
        values[name] = {key: best[name].along(*slope) for key, slope in slopes.items()}
        if low_order:
            errors[name] = {
                key: abs(values[name][key] - lower[name].along(*slope)) + abs(jump[name].along(*slope))
                for key, slope in slopes.items()
            }
    return Slope(number, values=values, errors=errors, brightest=next(iter(best.values())).brightest)


@dataclass(eq=False)
class _Sum:
    """Weighted sum of spot derivatives, noise covariances and brightest-pixel signals of several layouts."""

    spots: np.ndarray
    noise: np.ndarray
    brightest: np.ndarray

    @classmethod
    def none(cls, like: Information) -> _Sum:
        return cls(*(np.zeros_like(a) for a in (like.disturbances.spots, like.noise, like.brightest)))

    def add(self, weight: float, info: Information) -> None:
        self.spots += weight * info.disturbances.spots
        self.noise += weight * info.noise
        self.brightest += weight * info.brightest

    def along(self, by_spots: np.ndarray, by_noise: np.ndarray) -> float:
        return float(np.sum(by_spots * self.spots) + np.sum(by_noise * self.noise))
