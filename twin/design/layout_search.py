"""Search for layouts: beams at random, tried alone; their combinations compared without a trace; the best built as a
whole; their beams changed and combined anew.

Everything that is drawn is drawn here, in one order, and results are taken in the order in which they were asked for:
so the same seed finds the same, however many workers there are and wherever it was broken off.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations, zip_longest
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from optics.numerics.threads import LIMIT, one_blas_thread
from scenes.models.monitor_layout import Beam, Layout, changed_beam, drawn_beam, kinds_of, start_beams
from twin.design.layout_bench import BeamFacts, LayoutBench, LayoutFacts, bench_of, combined, touching
from twin.design.search_journal import Journal
from twin.run.procedure import Advance

Result = TypeVar("Result", BeamFacts, LayoutFacts)
Do = Callable[[Callable[..., Any], Sequence[Any]], Iterable[Any]]
"""Gives what a piece of work makes of every item, in their order."""
FIRST_STEP = 0.15
"""Of the first change of a beam, relative to the range of each number."""
_BATCHES = 4  # of layouts that are built until one stands
KEPT = 2
"""Layouts of each number of beams whose beams the next round changes."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A combination of beams that were tried alone.

    Attributes:
        beams: their numbers among all that were tried, rising.
        merit: what they promise: the largest ratio of what is left to what is wanted.
    """

    beams: tuple[int, ...]
    merit: float


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found.

    Attributes:
        start: the layout that it started from.
        layouts: all that were built as a whole and can stand, best first.
        refused: why others cannot, with how many.
        beams: that were tried.
        standing: of these, that can stand alone.
        compared: combinations whose merit was worked out.
        built: of these, built as a whole.
        progress: best merit after the first draw and after each round.
        seconds: that each part took.
    """

    start: LayoutFacts
    layouts: tuple[LayoutFacts, ...]
    refused: Mapping[str, int]
    beams: int
    standing: int
    compared: int
    built: int
    progress: tuple[float, ...]
    seconds: Mapping[str, float]


def merit(sigmas: Mapping[str, Mapping[str, float]], bench: LayoutBench) -> float:
    """Largest ratio of what is left to what is wanted, over all disturbances and goals; 1 or less reaches them all.

    Args:
        sigmas: disturbances -> quantity -> sigma, SI.
        bench: of the design.
    """
    wanted = bench.setup.test.goal.wanted
    return max(
        own[key] / goal for own in sigmas.values() for name, goal in wanted.items() for key in bench.goals_of(name)
    )


class Search:
    """A search at work.

    Args:
        bench: of the design.
        workers: processes beside this one, 0 for none.
        seed: of everything drawn.
        journal: file that keeps what was tried, None for none.
        advance: shows how far it is.
    """

    def __init__(self, bench: LayoutBench, workers: int, seed: int, journal: Path | None, advance: Advance) -> None:
        self.bench, self.setup, self.advance = bench, bench.setup, advance
        self.workers = workers
        self.rng = np.random.default_rng(np.random.SeedSequence([seed, 0]))
        self.config = bench.setup.to_yaml()
        self.journal = Journal(journal, f"{seed}\n{self.config}")
        self.pool: list[BeamFacts] = []
        self.tried: list[Beam] = []
        self.built: dict[tuple[int, ...], LayoutFacts] = {}
        self.compared: dict[tuple[int, ...], float] = {}
        self.apart: dict[tuple[int, int], bool] = {}
        self.refused: dict[str, int] = {}

    def run(self) -> Found:
        """Search."""
        spec = self.setup.test.search
        marks: dict[str, float] = {}
        start = self.bench.judged(start_beams(self.setup), self.bench.start, limited=False)
        with self._workers() as do, self.journal:
            clock = time.monotonic()
            first = [*dict.fromkeys(start_beams(self.setup))]
            while len(first) < spec.beams:
                first.append(drawn_beam(self.setup, self.rng))
            self._try(do, "beams one by one", first)
            marks["beams"] = time.monotonic() - clock
            clock = time.monotonic()
            self._build(do, "layouts as a whole", spec.exact)
            progress, step = [self._best()], FIRST_STEP
            for number in range(spec.rounds):
                parents = self._parents()
                if not parents:
                    break
                changed = [
                    changed_beam(self.setup, parents[k % len(parents)], step, self.rng) for k in range(spec.changed)
                ]
                self._try(do, f"round {number + 1}: beams", changed)
                self._build(do, f"round {number + 1}: layouts", spec.exact)
                progress.append(self._best())
                step = step if progress[-1] < 0.98 * progress[-2] else 0.5 * step
            marks["rounds"] = time.monotonic() - clock
        standing = [facts for facts in self.built.values() if not facts.refused]
        return Found(
            start,
            tuple(sorted(standing, key=lambda one: merit(one.sigmas, self.bench))),
            self.refused,
            len(self.tried),
            len(self.pool),
            len(self.compared),
            len(self.built),
            tuple(progress),
            marks,
        )

    def _try(self, do: Do, part: str, beams: Sequence[Beam]) -> None:
        """Try beams alone; those that stand join the pool."""
        self.tried += beams
        for facts in self._asked(do, part, _beam_work, beams):
            if facts.refused:
                self._refuse(facts.refused)
            else:
                self.pool.append(facts)

    def _build(self, do: Do, part: str, count: int) -> None:
        """Build the most promising layouts that were not built yet, until some stand."""
        for _ in range(_BATCHES):
            chosen = self._chosen(count)
            layouts = [tuple(self.pool[k].beam for k in candidate.beams) for candidate in chosen]
            stood = False
            for candidate, facts in zip(chosen, self._asked(do, part, _layout_work, layouts), strict=True):
                self.built[candidate.beams] = facts
                stood = stood or not facts.refused
                if facts.refused:
                    self._refuse(facts.refused)
            if stood or not chosen:
                break

    def _chosen(self, count: int) -> list[Candidate]:
        """The most promising layouts that were not built yet, in turn of each number of beams, the largest first."""
        waiting = [one for one in self._ranked() if one.beams not in self.built]
        sizes = sorted({len(one.beams) for one in waiting}, reverse=True)
        by_size = [[one for one in waiting if len(one.beams) == size] for size in sizes]
        turns = [one for turn in zip_longest(*(some[:count] for some in by_size)) for one in turn if one is not None]
        return turns[:count]

    def _ranked(self) -> list[Candidate]:
        """All beams alone, and to the best of each number of beams every further one; most promising first."""
        spec = self.setup.test
        every = [self._candidate((k,)) for k in range(len(self.pool))]
        level = every
        for _ in range(spec.beams - 1):
            width = max(spec.search.layouts // max((spec.beams - 1) * len(self.pool), 1), 1)
            best = sorted(level, key=lambda one: one.merit)[:width]
            sets = {tuple(sorted({*one.beams, k})) for one in best for k in range(len(self.pool)) if k not in one.beams}
            level = [self._candidate(beams) for beams in sorted(sets) if self._may_stand(beams)]
            every = [*every, *level]
        return sorted(every, key=lambda one: (one.merit, one.beams))

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
        return self._alike(beams) and self._within(beams) and self._fits(beams)

    def _alike(self, beams: Sequence[int]) -> bool:
        """Whether all beams have the same kinds of reflectors: an instrument's channels are traced together."""
        return len({kinds_of(self.setup, self.pool[k].beam) for k in beams}) == 1

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
                self.apart[pair] = not touching(self.pool[pair[0]], self.pool[pair[1]])
            if not self.apart[pair]:
                return False
        return True

    def _parents(self) -> list[Beam]:
        """Beams of the best layouts that stand, of each number of beams: a pair may have to change before it is better
        than a beam alone.
        """
        standing = [facts for facts in self.built.values() if not facts.refused]
        best = sorted(standing, key=lambda one: merit(one.sigmas, self.bench))
        sizes = sorted({len(one.beams) for one in best})
        kept = [[one for one in best if len(one.beams) == size][:KEPT] for size in sizes]
        return list(dict.fromkeys(beam for some in reversed(kept) for one in some for beam in one.beams))

    def _best(self) -> float:
        return min((merit(f.sigmas, self.bench) for f in self.built.values() if not f.refused), default=float("inf"))

    def _refuse(self, reason: str) -> None:
        # names and numbers differ from one to the next
        words = ["…" if any(c.isdigit() or c == "/" for c in word) else word for word in reason.split(":")[0].split()]
        kind = " ".join(words)
        self.refused[kind] = self.refused.get(kind, 0) + 1

    def _asked(self, do: Do, part: str, work: Callable[..., Result], items: Sequence[Any]) -> list[Result]:
        """Results in the order of the items; those that the journal has are not worked out again."""
        out: dict[int, Result] = {}
        missing = []
        for k, item in enumerate(items):
            known = self.journal.known(item)
            if known is None:
                missing.append(k)
            else:
                out[k] = known
        self.advance(part, len(out), len(items))
        backend = self.bench.backend.name
        for k, result in zip(missing, do(work, [(self.config, backend, items[m]) for m in missing]), strict=True):
            out[k] = result
            self.journal.keep(items[k], result)
            self.advance(part, len(out), len(items))
        return [out[k] for k in range(len(items))]

    @contextmanager
    def _workers(self) -> Iterator[Do]:
        """What does work on all items, in order, here or in processes of one thread each."""
        if not self.workers:
            yield lambda work, items: (_here(work, self.bench, item) for item in items)
            return
        before = os.environ.get(LIMIT)
        os.environ[LIMIT] = "1"  # read by the processes as they start
        try:
            with ProcessPoolExecutor(self.workers, multiprocessing.get_context("spawn")) as pool:
                yield lambda work, items: pool.map(work, items)
        finally:
            if before is None:
                os.environ.pop(LIMIT)
            else:
                os.environ[LIMIT] = before


def _here(work: Callable[..., Any], bench: LayoutBench, item: tuple[str, str, Any]) -> Any:
    with one_blas_thread():
        return bench.try_beam(item[2]) if work is _beam_work else bench.try_layout(item[2])


def _beam_work(item: tuple[str, str, Beam]) -> BeamFacts:
    with one_blas_thread():
        return bench_of(item[0], item[1]).try_beam(item[2])


def _layout_work(item: tuple[str, str, Layout]) -> LayoutFacts:
    with one_blas_thread():
        return bench_of(item[0], item[1]).try_layout(item[2])
