"""What tries beams and layouts for a search, here or in processes of one thread each, and keeps what came of them."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from types import TracebackType
from typing import Any

from optics.numerics.threads import LIMIT, one_blas_thread
from scenes.models.monitor_layout import Beam
from twin.design.layout_bench import LayoutBench, bench_of
from twin.design.layout_gradient import LayoutNumber, slope_of
from twin.design.search_journal import Journal
from twin.run.procedure import Advance


class Workers:
    """Context manager; inside it things can be asked for. Results do not depend on the number of processes.

    Args:
        bench: of the design.
        count: processes beside this one, 0 for none.
        journal: keeps what was tried; None for no file.
        advance: shows how far it is.

    Raises:
        RunFolderError: on entering, the journal is another search's, or cannot be written.
    """

    def __init__(self, bench: LayoutBench, count: int, journal: Journal, advance: Advance) -> None:
        self.bench, self.count, self.journal, self.advance = bench, count, journal, advance
        self._config = bench.setup.to_yaml()
        self._pool: ProcessPoolExecutor | None = None
        self._before: str | None = None

    def __enter__(self) -> Workers:
        """Open the journal and start the processes."""
        self.journal.__enter__()
        if self.count:
            self._before = os.environ.get(LIMIT)
            os.environ[LIMIT] = "1"  # read by the processes as they start
            self._pool = ProcessPoolExecutor(self.count, multiprocessing.get_context("spawn"))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the processes and close the journal."""
        try:
            if self._pool is not None:
                self._pool.shutdown(cancel_futures=True)
                if self._before is None:
                    os.environ.pop(LIMIT)
                else:
                    os.environ[LIMIT] = self._before
        finally:
            self.journal.__exit__(kind, error, at)

    def ask(self, part: str, items: Sequence[Any]) -> list[Any]:
        """What comes of every item, in their order; what the journal has is not worked out again.

        Args:
            part: of the search, for the progress.
            items: beams to be tried alone, layouts to be built, numbers of layouts by which to differentiate.
        """
        out: dict[int, Any] = {}
        missing = []
        for k, item in enumerate(items):
            known = self.journal.known(item)
            if known is None:
                missing.append(k)
            else:
                out[k] = known
        self.advance(part, len(out), len(items))
        asked = [(self._config, self.bench.backend.name, items[m]) for m in missing]
        results = map(self._here, asked) if self._pool is None else self._pool.map(_there, asked)
        for k, result in zip(missing, results, strict=True):
            out[k] = result
            self.journal.keep(items[k], result)
            self.advance(part, len(out), len(items))
        return [out[k] for k in range(len(items))]

    def _here(self, item: tuple[str, str, Any]) -> Any:
        return _answer(self.bench, item[2])


def _there(item: tuple[str, str, Any]) -> Any:
    return _answer(bench_of(item[0], item[1]), item[2])


def _answer(bench: LayoutBench, item: Any) -> Any:
    with one_blas_thread():
        if isinstance(item, Beam):
            return bench.try_beam(item)
        return slope_of(bench, item) if isinstance(item, LayoutNumber) else bench.try_layout(item)
