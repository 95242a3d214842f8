"""Worker processes: a local cluster that is made for a command and ends with it, or one that somebody else runs."""

from __future__ import annotations

import logging
import os
import queue
import signal
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from optics.numerics.backend import ONE_THREAD, cores
from twin.framework import cli, durable, owned_files, provenance

if TYPE_CHECKING:  # it takes half a second, and a study's file is read before workers are started
    from distributed import Client

    from scenes.specs.study import LimitsSpec

REACH_SECONDS = 5.0
"""How long a scheduler may take to answer before the user is told that it does not."""
LOST_SECONDS = 10.0
"""How long a scheduler may be away before the command breaks off."""
WORKER_SECONDS = 60.0
"""How long to wait for the first worker, and for one that takes the place of the last."""
LEAST_MEMORY = 0.5e9
"""Bytes that a worker process takes at least: interpreter, libraries, an instrument with its calibration."""
RETRIES = 2
"""How often a task is given to another worker after the one that had it died."""
SCHEMES = ("tcp://", "tls://", "ws://", "wss://")
ENCRYPTED = ("tls://", "wss://")
SCRATCH = "twin-study"
"""Beginning of the names of folders that workers write into."""


AHEAD = 4
"""Pieces of work that are handed over for each worker: one is done, the others wait."""


class ClusterError(cli.Incomplete):
    """The workers cannot be used any longer; the message says why."""


@dataclass(eq=False)
class Workers:
    """Worker processes of a command.

    Attributes
    ----------
    client : Client
        Of Dask.
    local : bool
        Whether they are this command's own.
    warnings : list[str]
        What the user should know.
    """

    client: Client
    local: bool
    warnings: list[str] = field(default_factory=list)
    _finished: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)

    @property
    def count(self) -> int:
        """Number of worker processes that the scheduler knows of now."""
        return len(self.client.scheduler_info(n_workers=-1)["workers"])

    def submit(self, work: Callable[[Any], Any], argument: Any) -> Any:
        """Start a piece of work; ``next_finished`` hands it back when it is done."""
        future = self.client.submit(work, argument, pure=False, retries=0)
        future.add_done_callback(self._finished.put)
        return future

    def next_finished(self, tick: Callable[[], None] = lambda: None) -> Any:
        """The next piece of work that is done, well or not.

        Parameters
        ----------
        tick : Callable[[], None]
            Called about twice a second while waiting.

        Raises
        ------
        ClusterError
            The scheduler is gone, or all processes of this command and none has come back.
        """
        lost: float | None = None
        alone: float | None = None
        while True:
            try:
                future = self._finished.get(timeout=0.5)
            except queue.Empty:
                tick()
            else:
                if future.status != "cancelled":
                    return future
            if self.client.status == "running":
                lost = None
                if self.local and not self.count:
                    alone = time.monotonic() if alone is None else alone
                    if time.monotonic() - alone > WORKER_SECONDS:
                        raise ClusterError(f"no worker process has come back for {WORKER_SECONDS:.0f} s")
                else:
                    alone = None
                continue
            lost = time.monotonic() if lost is None else lost
            if self.client.status in ("closing", "closed") or time.monotonic() - lost > LOST_SECONDS:
                raise ClusterError("the scheduler is gone")

    def each(self, work: Callable[[Any], Any], arguments: Iterable[Any]) -> Iterator[list[tuple[int, Any]]]:
        """Do a piece of work with every argument, never more than a few ahead.

        Parameters
        ----------
        work : Callable[[Any], Any]
            Function of one argument.
        arguments : Iterable[Any]
            Of the pieces.

        Yields
        ------
        list[tuple[int, Any]]
            Numbers of the arguments with the futures of their pieces that are done meanwhile, well or not; one at
            least.

        Raises
        ------
        ClusterError
            As of ``next_finished``.
        """
        left = enumerate(arguments)
        running: dict[Any, tuple[int, Any]] = {}
        while True:
            for number, argument in islice(left, max(0, AHEAD * max(1, self.count) - len(running))):
                future = self.submit(work, argument)
                running[future.key] = number, future
            if not running:
                return
            finished = [self.next_finished()]
            while not self._finished.empty():
                finished.append(self._finished.get())
            if done := [running.pop(one.key) for one in finished if one.key in running and one.status != "cancelled"]:
                yield done


def killed(error: BaseException) -> bool:
    """Whether a task failed because the workers that had it died."""
    from distributed.scheduler import KilledWorker

    return isinstance(error, KilledWorker)


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Worker processes on this machine with one thread each; they, and what they leave on disk, end with the block.

    Whoever may send a task to a worker runs programs as its user, and a port of this machine is open to all its users.
    So all speak TLS with a key that is made for the command and kept in memory, and a peer without it is refused.
    """
    with owned_files.scratch(SCRATCH) as place, _cluster(count, place) as workers:
        yield workers


@contextmanager
def _cluster(count: int, place: Path) -> Iterator[Workers]:
    """Workers of this command's own, who write below ``place``."""
    import dask
    from distributed import Client, LocalCluster
    from distributed.security import Security

    settings = {
        # set before the processes start: NumPy reads them when it is imported
        "distributed.nanny.pre-spawn-environ": {**ONE_THREAD},
        "distributed.scheduler.allowed-failures": RETRIES,
        # what is computed is small and handed over at once; a worker is never to wait for memory
        # nothing is told by HTTP, neither about the scheduler nor about the workers
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
        "distributed.scheduler.worker-ttl": None,
        "distributed.admin.large-graph-warning-threshold": "1GB",
        "distributed.comm.timeouts.connect": "60s",
        "temporary-directory": str(place),
        "logging": {"distributed": "critical", "distributed.nanny": "critical", "tornado": "critical"},
    }
    with _kept_environment():
        _silence()
        with dask.config.set(settings), ExitStack() as stack:
            with durable.ending_later(), _children_deaf_to_ctrl_c():
                cluster = LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    protocol="tls",
                    security=Security.temporary(),
                    # no dashboard; its port cannot be left out, so it is a free one, seen by this machine only
                    dashboard_address="127.0.0.1:0",
                    worker_dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    local_directory=str(place),
                    memory_limit=0,
                    silence_logs=logging.CRITICAL,
                )
                stack.enter_context(cluster)
            yield Workers(stack.enter_context(Client(cluster, set_as_default=False)), True)


@contextmanager
def _children_deaf_to_ctrl_c() -> Iterator[None]:
    """Threads that begin inside the block, and the processes that they start, do not hear SIGINT.

    A terminal sends it to all processes of a command. This one ends its workers, which otherwise, while they import
    and while they compute, would each tell of it with a traceback.
    """
    # whoever starts the tracker unblocks the signal, so that it is started before
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _kept_environment() -> Iterator[None]:
    """Restore the variables of this process at the end: Dask's nannies set here what their workers are to inherit."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


@contextmanager
def remote_workers(address: str, tell: Callable[[str], None]) -> Iterator[Workers]:
    """Workers of a running cluster.

    Parameters
    ----------
    address : str
        Of its scheduler, ``tls://host:port`` or ``tcp://host:port``. For TLS Dask is told the certificates by its own
        configuration, ``distributed.comm.tls``.
    tell : Callable[[str], None]
        Told that there are no workers yet.

    Raises
    ------
    InputErrorText
        It cannot be reached, no certificates are named, or its workers do not have the twin.
    ClusterError
        It has no workers.
    """
    _check_address(address)
    import dask
    from distributed import Client

    _silence()
    settings = {
        "distributed.comm.timeouts.connect": f"{REACH_SECONDS}s",
        "logging": {"distributed": "critical"},
        "distributed.comm.retry.count": 0,
    }
    with dask.config.set(settings):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                client = Client(address, timeout=REACH_SECONDS, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            text = f"the scheduler {address} cannot be reached ({reason}); start it with `dask scheduler`"
            raise cli.InputErrorText(text) from None
        try:
            workers = Workers(client, False)
            _wait_for_worker(workers, address, tell)
            workers.warnings += _differences(client)
            yield workers
        finally:
            client.close(timeout=2)


@contextmanager
def chosen_workers(
    count: int | None, scheduler: str | None, warn: Callable[[str], None], limits: LimitsSpec | None = None
) -> Iterator[Workers]:
    """Workers that the user chose, inside the block: those of a running cluster, or processes of this machine, as many
    as fit into the memory.

    Parameters
    ----------
    count : int | None
        Of processes of this machine, None for one per core.
    scheduler : str | None
        Address of a running cluster.
    warn : Callable[[str], None]
        Told what the user should know.
    limits : LimitsSpec | None
        Of the memory.

    Raises
    ------
    InputErrorText
        Both are chosen, or a cluster that cannot be used.
    ClusterError
        a cluster without workers.
    """
    refuse_both(count, scheduler)
    who: AbstractContextManager[Workers]
    if scheduler is not None:
        who = remote_workers(scheduler, warn)
    else:
        wanted = cores() if count is None else count
        fit = wanted if limits is None else max(1, min(wanted, int(limits.bytes // LEAST_MEMORY)))
        if limits is not None and fit < wanted:
            warn(f"{fit} workers instead of {wanted}: no more fit into the memory of its limits, {limits.memory}")
        who = local_workers(fit)
    with who as workers:
        for text in workers.warnings:
            warn(text)
        yield workers


def refuse_both(workers: int | None, scheduler: str | None) -> None:
    """See that not both are asked for: processes of this machine, and a running cluster.

    Raises
    ------
    InputErrorText
        Both are.
    """
    if workers is not None and scheduler is not None:
        raise cli.InputErrorText("--workers and --scheduler exclude each other: a cluster has its own workers")


def _check_address(address: str) -> None:
    """Whether a scheduler can be there at all, and what TLS needs to reach it.

    Raises
    ------
    InputErrorText
        No address, or no certificates.
    """
    try:
        parts = urlsplit(address)
        whole = parts.hostname and parts.port
    except ValueError:
        whole = None
    if not (address.startswith(SCHEMES) and whole):
        raise cli.InputErrorText(
            f"--scheduler {address}: not an address; write it as tls://host:8786 or tcp://host:8786"
        )
    if not address.startswith(ENCRYPTED):
        return
    from distributed.security import Security

    names = "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ...__CLIENT__CERT and ...__CLIENT__KEY (docs/studies.md)"
    try:
        known = Security().get_connection_args("client").get("ssl_context")
    except (OSError, ValueError, TypeError) as error:
        text = f"--scheduler {address}: the certificates that Dask is told of cannot be used ({error}); see {names}"
        raise cli.InputErrorText(text) from None
    if known is None:
        raise cli.InputErrorText(f"--scheduler {address}: TLS needs certificates; name them to Dask by {names}")


def _wait_for_worker(workers: Workers, address: str, tell: Callable[[str], None]) -> None:
    end = time.monotonic() + WORKER_SECONDS
    announced = False
    while not workers.count:
        if not announced:
            tell(f"the scheduler {address} has no workers yet; waiting for `dask worker {address} --nthreads 1`")
            announced = True
        if time.monotonic() > end:
            raise ClusterError(f"the scheduler {address} had no workers for {WORKER_SECONDS:.0f} s")
        time.sleep(0.2)


def _differences(client: Client) -> list[str]:
    """Versions of the workers that differ from ours: their numbers may differ in the last digits, or more.

    Raises
    ------
    InputErrorText
        They cannot import the twin, or have another one.
    """
    try:
        theirs = client.run(_program, on_error="return")
    except Exception as error:
        raise ClusterError(f"the workers do not answer: {error}") from error
    ours, source = _program()
    out = []
    for address, found in theirs.items():
        if isinstance(found, BaseException):
            text = f"the worker {address} cannot import the twin ({found}); start it from the twin's environment"
            raise cli.InputErrorText(text)
        if found[1] != source:
            text = f"the worker {address} has other source files of the twin or its extensions; install the same there"
            raise cli.InputErrorText(text)
        different = [
            f"{name} {found[0].get(name)} instead of {own}" for name, own in ours.items() if found[0].get(name) != own
        ]
        if different:
            out.append(f"the worker {address} has other versions: {', '.join(different)}")
    return out


def _program() -> tuple[dict[str, str], str]:
    """Versions of the packages, checksum of the program's own source files."""
    return provenance.versions(), provenance.source_digest()


def _silence() -> None:
    """Dask tells of every lost connection on the terminal; what matters of it the command says itself."""
    for name in ("distributed", "distributed.client", "distributed.core", "distributed.nanny", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")
