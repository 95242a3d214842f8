"""Search for layouts: beams at random, tried alone; their combinations compared without a trace; the best built as a
whole; their beams changed and combined anew; the best of all made better by gradients.

Everything that is drawn is drawn here, in one order, and results are taken in the order in which they were asked for:
so the same seed finds the same, however many workers there are and wherever it was broken off.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations, islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from optics.numerics.backend import one_blas_thread
from scenes.models.monitor_layout import Beam, changed_beam, drawn_beam, kinds_of, start_beams
from twin.design.layout_bench import BeamFacts, LayoutBench, LayoutFacts, Seen, bench_of, combined, touching
from twin.design.layout_refinement import Ask, LayoutNumber, Slope, ratios, refined, slope_of
from twin.framework import cluster
from twin.framework.cli import Incomplete
from twin.framework.journal import Journal
from twin.framework.procedure import Advance

FIRST_STEP = 0.15
"""Size of the first change of a beam, relative to the range of each number."""
_BATCHES = 4  # of layouts that are built until one stands
KEPT = 2
"""Layouts of each number of beams whose beams the next round changes."""
ALIKE = 0.02
"""Relative difference of what two searches end with that is taken for none."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A combination of beams that were tried alone.

    Attributes
    ----------
    beams : tuple[int, ...]
        Their numbers among all that were tried, rising.
    merit : float
        What they promise: the largest ratio of what is left to what is wanted.
    """

    beams: tuple[int, ...]
    merit: float


@dataclass(frozen=True, eq=False)
class End:
    """Where one search came to.

    Attributes
    ----------
    name : str
        Of where it began: the instrument, or ``start 1``.
    layouts : tuple[LayoutFacts, ...]
        All that it built as a whole and that can stand, best first.
    progress : tuple[float, ...]
        Best merit after the first draw and after each round.
    refined : tuple[float, ...]
        Merits on the way by gradients; empty for none.
    tried : int
        beams.
    standing : int
        Of these, that can stand alone.
    compared : int
        Combinations whose merit was worked out.
    built : int
        Of these, built as a whole.
    refused : Mapping[str, int]
        Why beams and layouts cannot stand, with how many.
    """

    name: str
    layouts: tuple[LayoutFacts, ...]
    progress: tuple[float, ...]
    refined: tuple[float, ...]
    tried: int
    standing: int
    compared: int
    built: int
    refused: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found, with all its starts.

    Attributes
    ----------
    start : LayoutFacts
        The layout of the instrument that it started from.
    layouts : tuple[LayoutFacts, ...]
        All that were built as a whole and can stand, best first.
    ends : tuple[End, ...]
        Of the search from it, and of those from beams at random.
    seconds : float
        That it took.
    """

    start: LayoutFacts
    layouts: tuple[LayoutFacts, ...]
    ends: tuple[End, ...]
    seconds: float

    @property
    def refused(self) -> dict[str, int]:
        """Why others cannot stand, with how many."""
        out: Counter[str] = Counter()
        for end in self.ends:
            out.update(end.refused)
        return dict(out)

    @property
    def beams(self) -> int:
        """That were tried."""
        return sum(end.tried for end in self.ends)

    @property
    def standing(self) -> int:
        """Beams that can stand alone."""
        return sum(end.standing for end in self.ends)

    @property
    def compared(self) -> int:
        """Combinations whose merit was worked out."""
        return sum(end.compared for end in self.ends)

    @property
    def built(self) -> int:
        """Layouts that were built as a whole."""
        return sum(end.built for end in self.ends)


def merit(sigmas: Mapping[str, Mapping[str, float]], bench: LayoutBench) -> float:
    """Largest ratio of what is left to what is wanted, over all disturbances and goals; 1 or less reaches them all.

    Parameters
    ----------
    sigmas : Mapping[str, Mapping[str, float]]
        Disturbances -> quantity -> sigma, SI.
    bench : LayoutBench
        Of the design.
    """
    return max(ratios(sigmas, bench).values())


def optima(found: Found, bench: LayoutBench) -> list[list[End]]:
    """Searches by what they end with: each group's merits lie within ``ALIKE`` of its best, the best group first.

    Parameters
    ----------
    found : Found
        Of a search; ends without a layout are left out.
    bench : LayoutBench
        Of the design.
    """

    def least(end: End) -> float:
        return merit(end.layouts[0].sigmas, bench)

    groups: list[list[End]] = []
    for end in sorted((end for end in found.ends if end.layouts), key=least):
        if groups and least(end) <= (1.0 + ALIKE) * least(groups[-1][0]):
            groups[-1].append(end)
        else:
            groups.append([end])
    return groups


Item = Beam | tuple[Beam, ...] | LayoutNumber
"""What can be tried."""


def journal_of(file: Path | None, config: str) -> Journal:
    """The journal of a search.

    Parameters
    ----------
    file : Path | None
        Of the journal, None to keep nothing.
    config : str
        What the search is about.
    """
    return Journal(file, config, "search", (Beam, BeamFacts, LayoutFacts, LayoutNumber, Seen, Slope))


class Workers:
    """Context manager; inside it things can be asked for. Results do not depend on the number of processes.

    Parameters
    ----------
    bench
        Of the design.
    count
        Processes beside this one, 0 for none.
    journal
        Keeps what was tried.
    advance
        Shows how far it is.

    Raises
    ------
    RunFolderError
        On entering, the journal is another search's, or cannot be written.
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
        """What comes of every item, in their order; what the journal has is not worked out again.

        Parameters
        ----------
        part : str
            Of the search, for the progress.
        items : Sequence[Item]
            Beams to be tried alone, layouts to be built, numbers of layouts by which to differentiate.

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
        """What comes of items by their names, as it comes."""
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


class Search:
    """A search at work, with its starts.

    Parameters
    ----------
    bench
        Of the design.
    workers
        Processes beside this one, 0 for none.
    seed
        Of everything drawn.
    journal
        File that keeps what was tried, None for none.
    advance
        Shows how far it is.
    """

    def __init__(self, bench: LayoutBench, workers: int, seed: int, journal: Path | None, advance: Advance) -> None:
        self.bench, self.seed = bench, seed
        kept = journal_of(journal, f"{seed}\n{bench.setup.to_yaml()}")
        self.workers = Workers(bench, workers, kept, advance)

    def run(self) -> Found:
        """Search."""
        begun, setup = time.monotonic(), self.bench.setup
        beams = start_beams(setup)
        start = self.bench.judged(beams, self.bench.start, limited=False)
        with self.workers as workers:
            ends = [_OneSearch(self.bench, workers.ask, self._rng(0), "").run(beams)]
            for number in range(1, setup.test.search.starts + 1):
                name = f"start {number}"
                ends.append(_OneSearch(self.bench, workers.ask, self._rng(number), name).run(()))
        every = sorted((f for end in ends for f in end.layouts), key=lambda one: merit(one.sigmas, self.bench))
        return Found(start, tuple(every), tuple(ends), time.monotonic() - begun)

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.seed, number]))


def _promise(one: Candidate) -> tuple[float, tuple[int, ...]]:
    return one.merit, one.beams


def spread(level: Sequence[Candidate], width: int) -> list[Candidate]:
    """So many of ranked layouts: half of them the best, the others evenly over the rest. The best are often much alike,
    and have room for the same few others.

    Parameters
    ----------
    level : Sequence[Candidate]
        Most promising first.
    width : int
        How many.
    """
    best, rest = list(level[: (width + 1) // 2]), level[(width + 1) // 2 :]
    count = min(width - len(best), len(rest))
    return [*best, *(rest[k * len(rest) // count] for k in range(count))]


class _OneSearch:
    """A search from one set of beams.

    Parameters
    ----------
    bench
        Of the design.
    ask
        For beams, layouts and slopes.
    rng
        Source of everything drawn.
    name
        Of where it begins; empty for the instrument that the design starts from.
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
        """Search from these beams, and from as many more at random as the design asks for."""
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
        layouts = self._standing()
        way = (
            refined(self.bench, self.ask, self._part("refinement"), layouts[0], spec.refine, self.rng)
            if layouts
            else []
        )
        return End(
            self.name or self.setup.instrument.name,
            (*reversed(way[1:]), *layouts),
            tuple(progress),
            tuple(merit(facts.sigmas, self.bench) for facts in way[1:]),
            len(self.tried),
            len(self.pool),
            len(self.compared),
            len(self.built),
            dict(self.refused),
        )

    def _part(self, words: str) -> str:
        return f"{self.name}: {words}" if self.name else words

    def _standing(self) -> list[LayoutFacts]:
        standing = [facts for facts in self.built.values() if not facts.refused]
        return sorted(standing, key=lambda one: merit(one.sigmas, self.bench))

    def _with_other_ccds(self) -> list[Beam]:
        """The beams of the best layout with each other area CCD, which only all of them together can have."""
        others, standing = self.setup.test.area_ccds or {}, self._standing()
        beams = standing[0].beams if standing else ()
        wanted = [replace(beam, area_ccd=name) for name in others for beam in beams]
        return [beam for beam in wanted if beam not in self.tried]

    def _try(self, part: str, beams: Sequence[Beam]) -> None:
        """Try beams alone; those that stand join the pool."""
        self.tried += beams
        for facts in self.ask(part, beams):
            if facts.refused:
                self._refuse(facts.refused)
            else:
                self.pool.append(facts)

    def _build(self, part: str, count: int) -> None:
        """Build the most promising layouts that were not built yet, until some stand."""
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
        """The most promising layouts that were not built yet, in turn of each number of beams, the largest first."""
        by_size = [[one for one in some if one.beams not in self.built][:count] for some in reversed(self._ranked())]
        turns = [one for turn in zip_longest(*by_size) for one in turn if one is not None]
        return turns[:count]

    def _ranked(self) -> list[list[Candidate]]:
        """Layouts of one beam, of two, and so on, that may stand, the most promising first: all beams alone, and to the
        best of each number of beams every further one.

        They are compared before it is asked whether they may stand: that is asked of the most promising ones alone, and
        a pair whose beams are good together is found though neither is good alone.
        """
        spec, size = self.setup.test, len(self.pool)
        level = sorted((self._candidate((k,)) for k in range(size)), key=_promise)
        every = [level]
        for _ in range(spec.beams - 1):
            width = max(spec.search.layouts // max((spec.beams - 1) * size, 1), 1)
            sets = {
                tuple(sorted({*one.beams, k}))
                for one in spread(level, width)
                for k in range(size)
                if k not in one.beams
            }
            promising = sorted((self._candidate(beams) for beams in sets if self._alike(beams)), key=_promise)
            standing = (one for one in promising if one.beams in self.built or self._may_stand(one.beams))
            level = [*islice(standing, width + len(self.built))]
            every.append(level)
        return every

    def _candidate(self, beams: tuple[int, ...]) -> Candidate:
        if beams not in self.compared:
            facts, wanted = [self.pool[k] for k in beams], self.setup.test.goal.wanted
            worst = 0.0
            for name in self.setup.disturbances:
                left = combined(facts, name)
                for goal, value in wanted.items():
                    for key in self.bench.goals_of(goal):
                        rows = self.bench.rows[key]
                        worst = max(worst, float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", rows, left, rows)))) / value)
            self.compared[beams] = worst
        return Candidate(beams, self.compared[beams])

    def _may_stand(self, beams: Sequence[int]) -> bool:
        return self._within(beams) and self._fits(beams)

    def _alike(self, beams: Sequence[int]) -> bool:
        """Whether all beams have the same kinds of reflectors, since an instrument's channels are traced together, and
        the same area CCD.
        """
        some = [self.pool[k].beam for k in beams]
        return len({(kinds_of(self.setup, beam), beam.area_ccd) for beam in some}) == 1

    def _within(self, beams: Sequence[int]) -> bool:
        """Whether beams together keep the limits of mass and pupil."""
        limits, facts = self.setup.test.limits, [self.pool[k] for k in beams]
        if limits.mass is not None and sum(one.mass for one in facts) > limits.mass:
            return False
        if limits.pupil_share is None:
            return True
        taken = np.bitwise_or.reduce([one.taken for one in facts])
        own = self.bench.imaging_shape
        return float(np.unpackbits(taken)[: int(np.prod(own))].reshape(own).mean(axis=-1).max()) <= limits.pupil_share

    def _fits(self, beams: Sequence[int]) -> bool:
        """Whether prisms of no two beams stand in each other."""
        for pair in combinations(beams, 2):
            if pair not in self.apart:
                one, other = (self.pool[k] for k in pair)
                self.apart[pair] = self.bench.boards_apart(one.beam, other.beam) and not touching(one, other)
            if not self.apart[pair]:
                return False
        return True

    def _parents(self) -> list[Beam]:
        """Beams of the best layouts that stand, of each number of beams: a pair may have to change before it is better
        than a beam alone.
        """
        best = self._standing()
        sizes = sorted({len(one.beams) for one in best})
        kept = [[one for one in best if len(one.beams) == size][:KEPT] for size in sizes]
        return list(dict.fromkeys(beam for some in reversed(kept) for one in some for beam in one.beams))

    def _best(self) -> float:
        return min((merit(f.sigmas, self.bench) for f in self.built.values() if not f.refused), default=float("inf"))

    def _refuse(self, reason: str) -> None:
        # names and numbers differ from one to the next
        words = ["…" if any(c.isdigit() or c == "/" for c in word) else word for word in reason.split(":")[0].split()]
        self.refused[" ".join(words)] += 1
