"""What tries beams and layouts for a search, here or in other processes; what comes of them is kept in a journal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from optics.numerics.threads import one_blas_thread
from scenes.models.monitor_layout import Beam
from twin.design.layout_bench import BeamFacts, LayoutBench, LayoutFacts, Seen, bench_of
from twin.design.layout_refinement import LayoutNumber, Slope, slope_of
from twin.run import cluster, procedure
from twin.run.cli import Incomplete
from twin.run.journal import Journal

Item = Beam | tuple[Beam, ...] | LayoutNumber
"""What can be tried."""


def journal_of(file: Path | None, config: str) -> Journal:
    """The journal of a search.

    Args:
        file: of the journal, None to keep nothing.
        config: what the search is about.
    """
    return Journal(file, config, "search", (Beam, BeamFacts, LayoutFacts, LayoutNumber, Seen, Slope))


class Workers:
    """Context manager; inside it things can be asked for. Results do not depend on the number of processes.

    Args:
        bench: of the design.
        count: processes beside this one, 0 for none.
        journal: keeps what was tried.
        advance: shows how far it is.

    Raises:
        RunFolderError: on entering, the journal is another search's, or cannot be written.
    """

    def __init__(self, bench: LayoutBench, count: int, journal: Journal, advance: procedure.Advance) -> None:
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

        Args:
            part: of the search, for the progress.
            items: beams to be tried alone, layouts to be built, numbers of layouts by which to differentiate.

        Raises:
            Incomplete: the processes died.
        """
        known = self.journal.known
        missing = [item for item in items if repr(item) not in known]
        self.advance(part, len(items) - len(missing), len(items))
        for results in self._results(missing):
            self.journal.keep(results)
            self.advance(part, sum(repr(item) in known for item in items), len(items))
        return [known[repr(item)] for item in items]

    def _results(self, items: Sequence[Item]) -> Iterator[dict[str, Any]]:
        """What comes of items, by their names, as it comes."""
        if self._pool is None:
            for item in items:
                yield {repr(item): _answer(self.bench, item)}
            return
        asked: Iterable[Any] = ((self._config, self.bench.backend.name, item) for item in items)
        for finished in self._pool.each(_there, asked):
            for _, future in finished:
                if future.status != "finished" and cluster.killed(future.exception()):
                    raise Incomplete("the worker processes died")
            yield {repr(items[k]): future.result() for k, future in finished}


def _there(item: tuple[str, str, Any]) -> Any:
    return _answer(bench_of(item[0], item[1]), item[2])


def _answer(bench: LayoutBench, item: Any) -> Any:
    with one_blas_thread():
        if isinstance(item, Beam):
            return bench.try_beam(item)
        return slope_of(bench, item) if isinstance(item, LayoutNumber) else bench.try_layout(item)
