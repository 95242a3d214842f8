"""Search for monitor layouts.

Random beams are evaluated alone; their combinations are compared without a trace; the best are built as a whole; their
beams are varied and combined again; the best layout is refined by gradients.

All random numbers are generated in this file in a fixed order, and results are used in the order of the requests. So
the same seed gives the same result for any number of workers and after any interruption.

Refinement of the best layout of a search by exact gradients.

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

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations, islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linprog

from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.instrument_builder import build_instrument
from scenes.models.monitor_layout import (
    Beam,
    Layout,
    changed_beam,
    drawn_beam,
    kinds_of,
    layout_spec,
    number_of,
    ranges,
    start_beams,
)
from scenes.yaml.errors import InputError
from twin.design.layout_bench import FULLEST, BeamFacts, LayoutBench, LayoutFacts, Seen, bench_of, combined, touching
from twin.framework import cluster
from twin.framework.cli import Incomplete
from twin.framework.journal import Journal
from twin.framework.procedure import Advance
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
        least = LEAST_BENEFIT * _largest(current, bench)
        feasible = [slope for slope in slopes if not slope.refused]
        slopes = [slope for slope in feasible if np.max(np.abs(_slopes_of(bench, current, slope))) > least]
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
    brightest : (C,) ndarray
        Derivatives, per SI unit, of the signal of the brightest pixel of each of C spots as a fraction of its capacity.
    """

    number: LayoutNumber
    refused: str = ""
    values: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
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
    step = STEP * (high - low)
    try:
        centre = _known_here(bench, number.beams)
        sums = {name: _Sum.none(info) for name, info in centre.items()}
        for k, weight in _WEIGHTS[number.order].items():
            for sign in (1.0, -1.0):
                for name, info in known_of(bench, number.moved(bench, sign * k * step)).items():
                    sums[name].add(sign * weight / step, info)
    except (InputError, AimError, BeamMissedError, ValueError) as error:
        return Slope(number, refused=str(error))
    values = {
        name: {key: sums[name].along(*info.slopes(key)) for key in info.quantities if info.sigma(key) > 0.0}
        for name, info in centre.items()
    }
    return Slope(number, values=values, brightest=next(iter(sums.values())).brightest)


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


FIRST_STEP = 0.15
"""Size of the random changes of a beam in the first round, relative to the range of each parameter."""
_BATCHES = 4  # batches of layouts that are built until one is feasible
KEPT = 2
"""Number of layouts whose beams are varied in the next round, for each number of beams."""
ALIKE = 0.02
"""Relative difference of merits up to which two searches are considered to have reached the same optimum.

The merit of a layout is its largest ratio of a standard deviation to its goal.
"""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Combination of monitor beams, each evaluated alone, that may become a layout.

    Attributes
    ----------
    beams : tuple of int
        Indices of the beams among all feasible ones of the search, ascending.
    merit : float
        Predicted merit: the largest ratio of a standard deviation to its goal.
    """

    beams: tuple[int, ...]
    merit: float


@dataclass(frozen=True, eq=False)
class End:
    """Result of one search for a layout from one start.

    Attributes
    ----------
    name : str
        Name of its start: the instrument, or ``start 1``.
    layouts : tuple of LayoutFacts
        All feasible layouts that it built as a whole, best first.
    progress : tuple of float
        Best merit (largest ratio of sigma to goal) after the first random beams and after each round.
    refined : tuple of float
        Merits during the refinement by gradients; empty without one.
    tried : int
        Number of beams evaluated alone.
    feasible : int
        Number of these beams that are feasible.
    compared : int
        Number of combinations whose merit was computed.
    built : int
        Number of combinations that were built as a whole.
    refused : dict
        Reason why beams and layouts are not feasible -> their number.
    """

    name: str
    layouts: tuple[LayoutFacts, ...]
    progress: tuple[float, ...]
    refined: tuple[float, ...]
    tried: int
    feasible: int
    compared: int
    built: int
    refused: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Results of a search from all its starts.

    Attributes
    ----------
    start : LayoutFacts
        Layout of the instrument from which it started.
    layouts : tuple of LayoutFacts
        All feasible layouts that were built as a whole, best first.
    ends : tuple of End
        Results of the search from the instrument, and of those from random beams.
    seconds : float
        Computing time.
    """

    start: LayoutFacts
    layouts: tuple[LayoutFacts, ...]
    ends: tuple[End, ...]
    seconds: float

    @property
    def refused(self) -> dict[str, int]:
        """Reason why beams or layouts are not feasible -> their number, over all searches."""
        out: Counter[str] = Counter()
        for end in self.ends:
            out.update(end.refused)
        return dict(out)

    def total(self, number: str) -> int:
        """Return the sum over all searches of ``tried``, ``feasible``, ``compared`` or ``built``."""
        return sum(getattr(end, number) for end in self.ends)


def merit(sigmas: Mapping[str, Mapping[str, float]], bench: LayoutBench) -> float:
    """Return the merit of a layout: its largest ratio of a standard deviation to its goal (1 reaches all goals).

    Parameters
    ----------
    sigmas : dict
        Disturbances -> quantity -> sigma, SI units.
    bench : LayoutBench
        Evaluator of the layouts of the design.
    """
    return max(ratios(sigmas, bench).values())


def optima(result: SearchResult, bench: LayoutBench) -> list[list[End]]:
    """Return the searches in groups that reached the same optimum, the best group first.

    The merits of a group lie within ``ALIKE`` of its best.

    Parameters
    ----------
    result : Found
        Results from all starts; those without a feasible layout are omitted.
    bench : LayoutBench
        Evaluator of the layouts of the design.
    """

    def least(end: End) -> float:
        return merit(end.layouts[0].sigmas, bench)

    groups: list[list[End]] = []
    for end in sorted((end for end in result.ends if end.layouts), key=least):
        if groups and least(end) <= (1.0 + ALIKE) * least(groups[-1][0]):
            groups[-1].append(end)
        else:
            groups.append([end])
    return groups


Item = Beam | tuple[Beam, ...] | LayoutNumber
"""Item that can be evaluated: a beam, a layout, or a parameter of a layout for derivatives."""


def journal_of(file: Path | None, config: str) -> Journal:
    """Return the journal of a search, the file that holds its finished evaluations.

    Parameters
    ----------
    file : Path or None
        File of the journal, None to store nothing.
    config : str
        Text that identifies the search.
    """
    return Journal(file, config, "search", (Beam, BeamFacts, LayoutFacts, LayoutNumber, Seen, Slope))


class Workers:
    """Context manager of the processes that evaluate beams, layouts and derivatives.

    The results do not depend on the number of processes.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    count : int
        Number of further processes, 0 for none.
    journal : Journal
        Journal of finished evaluations.
    advance : Advance
        Callback that reports progress.

    Raises
    ------
    RunFolderError
        On entering: the journal belongs to a different search, or cannot be written.
    """

    def __init__(self, bench: LayoutBench, count: int, journal: Journal, advance: Advance) -> None:
        self.bench, self.count, self.journal, self.advance = bench, count, journal, advance
        self._config = bench.setup.to_yaml()
        self._pool: cluster.Workers | None = None
        self._open = ExitStack()

    def __enter__(self) -> Workers:
        """Open the journal and start the processes."""
        with ExitStack() as stack:
            stack.enter_context(self.journal)
            self._pool = stack.enter_context(cluster.local_workers(self.count)) if self.count else None
            self._open = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes and close the journal."""
        self._open.close()

    def ask(self, part: str, items: Sequence[Item]) -> list[Any]:
        """Return the results of all items in their order; those in the journal are not computed again.

        Parameters
        ----------
        part : str
            Stage of the search, for the progress display.
        items : sequence of Item
            Beams, layouts, or parameters of layouts.

        Raises
        ------
        Incomplete
            The processes died.
        """
        known, names = self.journal.known, [repr(item) for item in items]
        missing = {name: item for name, item in zip(names, items, strict=True) if name not in known}
        done = len(items) - len(missing)
        self.advance(part, done, len(items))
        for results in self._results(missing):
            self.journal.keep(results)
            done += len(results)
            self.advance(part, done, len(items))
        return [known[name] for name in names]

    def _results(self, items: Mapping[str, Item]) -> Iterator[dict[str, Any]]:
        """Yield name -> result for a few items at a time, as they are finished."""
        if self._pool is None:
            for name, item in items.items():
                yield {name: _answer(self.bench, item)}
            return
        names = [*items]
        asked: Iterable[Any] = ((self._config, self.bench.backend.name, item) for item in items.values())
        for finished in self._pool.each(_there, asked):
            if any(future.status != "finished" and cluster.killed(future.exception()) for _, future in finished):
                raise Incomplete("the worker processes died")
            yield {names[k]: future.result() for k, future in finished}


def _there(item: tuple[str, str, Any]) -> Any:
    return _answer(bench_of(item[0], item[1]), item[2])


def _answer(bench: LayoutBench, item: Any) -> Any:
    with one_blas_thread():
        if isinstance(item, Beam):
            return bench.try_beam(item)
        return slope_of(bench, item) if isinstance(item, LayoutNumber) else bench.try_layout(item)


def search(bench: LayoutBench, workers: int, seed: int, journal: Path | None, advance: Advance) -> SearchResult:
    """Search for layouts from the instrument and from random beams.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    workers : int
        Number of further processes, 0 for none.
    seed : int
        Seed of all random numbers.
    journal : Path or None
        File that stores finished evaluations, None for none.
    advance : Advance
        Callback that reports progress.
    """
    begun, beams = time.monotonic(), start_beams(bench.setup)
    start, ends = bench.judged(beams, bench.start, limited=False), []
    store = journal_of(journal, f"{seed}\n{bench.setup.to_yaml()}")
    with Workers(bench, workers, store, advance) as processes:
        for number in range(bench.setup.test.search.starts + 1):
            rng, name = np.random.default_rng(np.random.SeedSequence([seed, number])), f"start {number}" * bool(number)
            ends.append(_SingleSearch(bench, processes.ask, rng, name).run(() if number else beams))
    layouts = sorted((f for end in ends for f in end.layouts), key=lambda layout: merit(layout.sigmas, bench))
    return SearchResult(start, tuple(layouts), tuple(ends), time.monotonic() - begun)


def _promise(candidate: Candidate) -> tuple[float, tuple[int, ...]]:
    return candidate.merit, candidate.beams


def spread(level: Sequence[Candidate], width: int) -> list[Candidate]:
    """Return ``width`` of the ranked candidates: half of them the best, the others evenly spaced over the rest.

    The best ones alone would not do, because they are often similar and compatible with the same few other beams.

    Parameters
    ----------
    level : sequence of Candidate
        Candidates, the most promising first.
    width : int
        Number of candidates.
    """
    best, rest = list(level[: (width + 1) // 2]), level[(width + 1) // 2 :]
    count = min(width - len(best), len(rest))
    return [*best, *(rest[k * len(rest) // count] for k in range(count))]


class _SingleSearch:
    """Search for layouts from one set of beams.

    Parameters
    ----------
    bench : LayoutBench
        Evaluator of the layouts of the design.
    ask : Ask
        Function that evaluates beams, layouts and derivatives.
    rng : Generator
        Random generator of the search.
    name : str
        Name of the start; empty for the instrument from which the design starts.
    """

    def __init__(self, bench: LayoutBench, ask: Ask, rng: np.random.Generator, name: str) -> None:
        self.bench, self.setup, self.ask, self.rng, self.name = bench, bench.setup, ask, rng, name
        self.pool: list[BeamFacts] = []
        self.tried: list[Beam] = []
        self.built: dict[tuple[int, ...], LayoutFacts] = {}
        self.compared: dict[tuple[int, ...], float] = {}
        self.apart: dict[tuple[int, int], bool] = {}
        self.refused: Counter[str] = Counter()

    def run(self, beams: Sequence[Beam]) -> End:
        """Search for layouts from these beams, plus as many random ones as the design's number of beams requires."""
        spec = self.setup.test.search
        first = [*dict.fromkeys(beams)]
        while len(first) < spec.beams:
            first.append(drawn_beam(self.setup, self.rng))
        self._try(self._part("beams one by one"), first)
        self._build(self._part("layouts as a whole"), spec.exact)
        progress, step = [self._best()], FIRST_STEP
        for number in range(spec.rounds):
            parents = self._parents()
            if not parents:
                break
            changed = [changed_beam(self.setup, parents[k % len(parents)], step, self.rng) for k in range(spec.changed)]
            self._try(self._part(f"round {number + 1}: beams"), [*changed, *self._with_other_ccds()])
            self._build(self._part(f"round {number + 1}: layouts"), spec.exact)
            progress.append(self._best())
            step = step if progress[-1] < 0.98 * progress[-2] else 0.5 * step
        layouts = self._feasible()
        path = (
            refined(self.bench, self.ask, self._part("refinement"), layouts[0], spec.refine, self.rng)
            if layouts
            else []
        )
        merits = tuple(merit(facts.sigmas, self.bench) for facts in path[1:])
        tried, feasible = len(self.tried), len(self.pool)
        compared, built, refused = len(self.compared), len(self.built), dict(self.refused)
        name, layouts = self.name or self.setup.instrument.name, [*reversed(path[1:]), *layouts]
        return End(name, tuple(layouts), tuple(progress), merits, tried, feasible, compared, built, refused)

    def _part(self, words: str) -> str:
        return f"{self.name}: {words}" if self.name else words

    def _feasible(self) -> list[LayoutFacts]:
        feasible = [facts for facts in self.built.values() if not facts.refused]
        return sorted(feasible, key=lambda layout: merit(layout.sigmas, self.bench))

    def _with_other_ccds(self) -> list[Beam]:
        """Return the beams of the best layout with each other area CCD that the design's file lists.

        All beams of a layout have the same area CCD, so that they can only change it together.
        """
        others, feasible = self.setup.test.area_ccds or {}, self._feasible()
        beams = feasible[0].beams if feasible else ()
        wanted = [replace(beam, area_ccd=name) for name in others for beam in beams]
        return [beam for beam in wanted if beam not in self.tried]

    def _try(self, part: str, beams: Sequence[Beam]) -> None:
        """Evaluate beams alone; the feasible ones are added to those that are combined to layouts."""
        self.tried += beams
        for facts in self.ask(part, beams):
            if facts.refused:
                self._refuse(facts.refused)
            else:
                self.pool.append(facts)

    def _build(self, part: str, count: int) -> None:
        """Build the most promising layouts that have not been built yet, until some are feasible."""
        for _ in range(_BATCHES):
            chosen = self._chosen(count)
            layouts = [tuple(self.pool[k].beam for k in candidate.beams) for candidate in chosen]
            stood = False
            for candidate, facts in zip(chosen, self.ask(part, layouts), strict=True):
                self.built[candidate.beams] = facts
                stood = stood or not facts.refused
                if facts.refused:
                    self._refuse(facts.refused)
            if stood or not chosen:
                break

    def _chosen(self, count: int) -> list[Candidate]:
        """Return the most promising layouts not built yet, alternating between the numbers of beams."""
        by_size = [
            [candidate for candidate in level if candidate.beams not in self.built][:count]
            for level in reversed(self._ranked())
        ]
        alternating = [candidate for group in zip_longest(*by_size) for candidate in group if candidate is not None]
        return alternating[:count]

    def _ranked(self) -> list[list[Candidate]]:
        """Return layouts of one beam, of two, and so on, in each case the most promising first.

        The best of each number of beams are extended by every further beam. Layouts are compared before their
        feasibility is checked, which is done for the most promising ones alone; so a pair whose beams complement each
        other is found although neither is good alone.
        """
        spec, size = self.setup.test, len(self.pool)
        level = sorted((self._candidate((k,)) for k in range(size)), key=_promise)
        levels = [level]
        for _ in range(spec.beams - 1):
            width = max(spec.search.layouts // max((spec.beams - 1) * size, 1), 1)
            sets = {
                tuple(sorted({*candidate.beams, k}))
                for candidate in spread(level, width)
                for k in range(size)
                if k not in candidate.beams
            }
            promising = sorted((self._candidate(beams) for beams in sets if self._alike(beams)), key=_promise)
            feasible = (
                candidate
                for candidate in promising
                if candidate.beams in self.built or (self._within(candidate.beams) and self._fits(candidate.beams))
            )
            level = [*islice(feasible, width + len(self.built))]
            levels.append(level)
        return levels

    def _candidate(self, beams: tuple[int, ...]) -> Candidate:
        if beams not in self.compared:
            facts, wanted = [self.pool[k] for k in beams], self.setup.test.goal.wanted
            worst = 0.0
            for name in self.setup.disturbances:
                covariance = combined(facts, name)
                for goal, value in wanted.items():
                    for key in self.bench.goals_of(goal):
                        rows = self.bench.rows[key]
                        worst = max(
                            worst, float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", rows, covariance, rows)))) / value
                        )
            self.compared[beams] = worst
        return Candidate(beams, self.compared[beams])

    def _alike(self, beams: Sequence[int]) -> bool:
        """Return True if all beams have the same kinds of reflectors and the same area CCD.

        The channels of an instrument are traced together, which requires equal kinds of reflectors.
        """
        selected = [self.pool[k].beam for k in beams]
        return len({(kinds_of(self.setup, beam), beam.area_ccd) for beam in selected}) == 1

    def _within(self, beams: Sequence[int]) -> bool:
        """Return True if beams together satisfy the limits of mass and of the obstructed fraction of the pupil."""
        limits, facts = self.setup.test.limits, [self.pool[k] for k in beams]
        if limits.mass is not None and sum(beam.mass for beam in facts) > limits.mass:
            return False
        if limits.pupil_share is None:
            return True
        taken = np.bitwise_or.reduce([beam.taken for beam in facts])
        shape = self.bench.imaging_shape
        return (
            float(np.unpackbits(taken)[: int(np.prod(shape))].reshape(shape).mean(axis=-1).max()) <= limits.pupil_share
        )

    def _fits(self, beams: Sequence[int]) -> bool:
        """Return True if the prisms of no two beams overlap."""
        for pair in combinations(beams, 2):
            if pair not in self.apart:
                first, second = (self.pool[k] for k in pair)
                self.apart[pair] = self.bench.boards_apart(first.beam, second.beam) and not touching(first, second)
            if not self.apart[pair]:
                return False
        return True

    def _parents(self) -> list[Beam]:
        """Return the beams of the best feasible layouts of each number of beams, to be varied in the next round.

        A pair may have to change before it is better than a single beam.
        """
        best = self._feasible()
        sizes = sorted({len(layout.beams) for layout in best})
        groups = [[layout for layout in best if len(layout.beams) == size][:KEPT] for size in sizes]
        return list(dict.fromkeys(beam for group in reversed(groups) for layout in group for beam in layout.beams))

    def _best(self) -> float:
        return min((merit(f.sigmas, self.bench) for f in self.built.values() if not f.refused), default=float("inf"))

    def _refuse(self, reason: str) -> None:
        # names and numbers differ from one to the next
        words = ["…" if any(c.isdigit() or c == "/" for c in word) else word for word in reason.split(":")[0].split()]
        self.refused[" ".join(words)] += 1
