"""Worker processes of this machine or of a cluster that reduce the points of a block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from analysis.arrays import MeasurementError
from optics.numerics.backend import one_blas_thread
from twin.framework.cluster import ClusterError, Workers, chosen_workers

_LOST = "a worker was lost with its share of the points; adjust the block again"


@dataclass(frozen=True, eq=False)
class PointWorkers:
    """Workers as `analysis.block.point_reduction` uses them: one share for each of those that there are at the start.

    Attributes:
        workers: the processes.
        count: of them.
    """

    workers: Workers
    count: int

    def hold(self, things: Sequence[Any]) -> Sequence[Any]:
        """Give each thing to a worker, in turn."""
        client = self.workers.client
        addresses = sorted(client.scheduler_info(n_workers=-1)["workers"])
        return [
            client.scatter(one, workers=[addresses[k % len(addresses)]], hash=False) for k, one in enumerate(things)
        ]

    def results(self, work: Callable[[tuple[Any, ...]], Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Work done with each of the arguments, in their order.

        Raises:
            MeasurementError: a share that cannot be reduced.
            ClusterError: a worker or the scheduler is gone.
        """
        futures = [self.workers.submit(_on_one_thread, (work, *one)) for one in arguments]

        def look() -> None:
            if any(one.status in ("lost", "cancelled") for one in futures):
                raise ClusterError(_LOST)

        for _ in futures:
            done = self.workers.next_finished(look)
            if done.status == "finished":
                continue
            error = done.exception()
            if isinstance(error, MeasurementError):
                raise error
            raise ClusterError(f"{_LOST} ({type(error).__name__}: {error})")
        return [one.result() for one in futures]


def _on_one_thread(given: tuple[Any, ...]) -> Any:
    work, *rest = given
    with one_blas_thread():
        return work(tuple(rest))


@contextmanager
def point_workers(
    count: int | None, scheduler: str | None, warn: Callable[[str], None]
) -> Iterator[PointWorkers | None]:
    """Workers inside the block; none where neither a number nor a scheduler is given.

    Args:
        count: of processes of this machine.
        scheduler: address of a running cluster.
        warn: told what the user should know.

    Raises:
        InputErrorText: both are given, or a cluster that cannot be used.
        ClusterError: a cluster without workers.
    """
    if scheduler is None and (count is None or count < 2):
        yield None
        return
    with chosen_workers(count, scheduler, warn) as workers:
        yield PointWorkers(workers, workers.count)
