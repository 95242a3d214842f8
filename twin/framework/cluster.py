"""Worker processes: a local cluster that a command starts and stops, or a running cluster that it uses."""

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
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from optics.numerics.backend import ONE_THREAD, cores
from twin.framework import cli, durable, provenance

if TYPE_CHECKING:  # its import takes half a second, and a study's file is read before workers are started
    from distributed import Client

    from scenes.specs.study import LimitsSpec

CONNECT_SECONDS = 5.0
"""Time within which a scheduler has to answer, in seconds."""
LOST_SECONDS = 10.0
"""Time without a scheduler after which the command gives up, in seconds."""
WORKER_SECONDS = 60.0
"""Time to wait for the first worker, and for a replacement of the last one, in seconds."""
LEAST_MEMORY = 0.5e9
"""Smallest memory that a worker process needs, in bytes: interpreter, libraries, an instrument with its calibration."""
RETRIES = 2
"""Number of times that a task is given to another worker after its worker died."""
SCHEMES = ("tcp://", "tls://", "ws://", "wss://")
ENCRYPTED = ("tls://", "wss://")
SCRATCH = "twin-study-"
"""Prefix of the names of the temporary folders in which worker processes write files."""


AHEAD = 4
"""Number of tasks submitted per worker: one is being computed, the others wait, so that no worker is idle."""


class ClusterError(cli.Incomplete):
    """Failure of the workers; the message gives the reason."""


@dataclass(eq=False)
class Workers:
    """Worker processes of a command.

    Attributes
    ----------
    client : Client
        Dask's client.
    local : bool
        True if this command started the workers.
    warnings : list of str
        Warnings for the user.
    """

    client: Client
    local: bool
    warnings: list[str] = field(default_factory=list)
    _finished: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)

    @property
    def count(self) -> int:
        """Number of worker processes that the scheduler knows now."""
        return len(self.client.scheduler_info(n_workers=-1)["workers"])

    def submit(self, work: Callable[[Any], Any], argument: Any) -> Any:
        """Submit a task; ``next_finished`` returns its future when it is done."""
        future = self.client.submit(work, argument, pure=False, retries=0)
        future.add_done_callback(self._finished.put)
        return future

    def next_finished(self, tick: Callable[[], None] = lambda: None) -> Any:
        """Return the next future that is done, successfully or not.

        Parameters
        ----------
        tick : callable
            Called about twice a second while waiting.

        Raises
        ------
        ClusterError
            The scheduler is gone, or all processes of this command died and none was replaced.
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
                        raise ClusterError(f"all workers ended, and none restarted within {WORKER_SECONDS:.0f} s")
                else:
                    alone = None
                continue
            lost = time.monotonic() if lost is None else lost
            if self.client.status in ("closing", "closed") or time.monotonic() - lost > LOST_SECONDS:
                raise ClusterError("the connection to the scheduler is lost")

    def each(self, work: Callable[[Any], Any], arguments: Iterable[Any]) -> Iterator[list[tuple[int, Any]]]:
        """Run a function on every argument, with only a few tasks submitted ahead.

        Parameters
        ----------
        work : callable
            Function of one argument.
        arguments : iterable
            Argument of each task.

        Yields
        ------
        list of (int, Any)
            Index of the argument and future of each task finished since the last yield, successfully or not; at least
            one.

        Raises
        ------
        ClusterError
            The workers cannot be used, see ``next_finished``.
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
            if done := [
                running.pop(completed.key)
                for completed in finished
                if completed.key in running and completed.status != "cancelled"
            ]:
                yield done


def killed(error: BaseException) -> bool:
    """Return True if a task failed because its workers died."""
    from distributed.scheduler import KilledWorker

    return isinstance(error, KilledWorker)


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Start worker processes on this machine with one thread each; they and their files on disk end with the block.

    Whoever may send a task to a worker can run programs as its user, and a port of this machine is open to all users.
    All connections therefore use TLS with a key that is made for the command and kept in memory; a peer without it is
    refused.
    """
    with TemporaryDirectory(prefix=SCRATCH, ignore_cleanup_errors=True) as folder, _cluster(count, folder) as workers:
        yield workers


@contextmanager
def _cluster(count: int, folder: str) -> Iterator[Workers]:
    """Start local worker processes that write their files below the folder ``folder``."""
    import dask
    from distributed import Client, LocalCluster
    from distributed.security import Security

    settings = {
        # set before the processes start, since NumPy reads them when it is imported
        "distributed.nanny.pre-spawn-environ": {**ONE_THREAD},
        "distributed.scheduler.allowed-failures": RETRIES,
        # no information about the scheduler or the workers is served by HTTP
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        # results are small and sent at once; a worker must never pause for memory
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
        "distributed.scheduler.worker-ttl": None,
        "distributed.admin.large-graph-warning-threshold": "1GB",
        "distributed.comm.timeouts.connect": "60s",
        "temporary-directory": folder,
        "logging": {"distributed": "critical", "distributed.nanny": "critical", "tornado": "critical"},
    }
    with _restored_environment():
        _silence()
        with dask.config.set(settings), ExitStack() as stack:
            with durable.ending_later(), _children_ignore_interrupts():
                cluster = LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    protocol="tls",
                    security=Security.temporary(),
                    # no dashboard; a port is required all the same, so a free one of this machine only
                    dashboard_address="127.0.0.1:0",
                    worker_dashboard_address="127.0.0.1:0",
                    scheduler_kwargs={"dashboard": False},
                    local_directory=folder,
                    memory_limit=0,
                    silence_logs=logging.CRITICAL,
                )
                stack.enter_context(cluster)
            yield Workers(stack.enter_context(Client(cluster, set_as_default=False)), True)


@contextmanager
def _children_ignore_interrupts() -> Iterator[None]:
    """Block SIGINT for threads that begin inside the block, and for the processes that they start.

    A terminal sends SIGINT to all processes of a command. The command ends its workers itself; otherwise each worker
    would print a traceback while it imports or computes.
    """
    # starting the tracker unblocks the signal, so it is started before
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _restored_environment() -> Iterator[None]:
    """Restore the environment variables of this process at the end: Dask's nannies set those of their workers here."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


@contextmanager
def remote_workers(address: str, notify: Callable[[str], None]) -> Iterator[Workers]:
    """Connect to the workers of a running cluster.

    Parameters
    ----------
    address : str
        Address of the scheduler, ``tls://host:port`` or ``tcp://host:port``. For TLS, Dask reads the certificates from
        its own configuration, ``distributed.comm.tls``.
    notify : callable
        Called with a message if there are no workers yet.

    Raises
    ------
    InputErrorText
        The scheduler cannot be reached, no certificates are configured, or the workers do not have the twin.
    ClusterError
        The cluster has no workers.
    """
    _check_address(address)
    import dask
    from distributed import Client

    _silence()
    settings = {
        "distributed.comm.timeouts.connect": f"{CONNECT_SECONDS}s",
        "logging": {"distributed": "critical"},
        "distributed.comm.retry.count": 0,
    }
    with dask.config.set(settings):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            text = f"the scheduler {address} cannot be reached ({reason}); start it with `dask scheduler`"
            raise cli.InputErrorText(text) from None
        try:
            workers = Workers(client, False)
            _wait_for_worker(workers, address, notify)
            workers.warnings += _differences(client)
            yield workers
        finally:
            client.close(timeout=2)


@contextmanager
def chosen_workers(
    count: int | None, scheduler: str | None, warn: Callable[[str], None], limits: LimitsSpec | None = None
) -> Iterator[Workers]:
    """Provide the workers that the user chose: those of a running cluster, or as many local processes as memory allows.

    Parameters
    ----------
    count : int | None
        Number of local processes; None for one per core.
    scheduler : str | None
        Address of a running cluster.
    warn : callable
        Called with each warning for the user.
    limits : LimitsSpec | None
        Limits of the memory.

    Raises
    ------
    InputErrorText
        Both are chosen, or the cluster cannot be used.
    ClusterError
        The cluster has no workers.
    """
    refuse_both(count, scheduler)
    who: AbstractContextManager[Workers]
    if scheduler is not None:
        who = remote_workers(scheduler, warn)
    else:
        wanted = cores() if count is None else count
        fit = wanted if limits is None else max(1, min(wanted, int(limits.bytes // LEAST_MEMORY)))
        if limits is not None and fit < wanted:
            warn(f"{fit} workers instead of {wanted}: no more fit into the memory limit, {limits.memory}")
        who = local_workers(fit)
    with who as workers:
        for text in workers.warnings:
            warn(text)
        yield workers


def refuse_both(workers: int | None, scheduler: str | None) -> None:
    """Raise InputErrorText if both local processes and a running cluster are requested.

    Raises
    ------
    InputErrorText
        Both are requested.
    """
    if workers is not None and scheduler is not None:
        raise cli.InputErrorText("--workers and --scheduler exclude each other: a cluster has its own workers")


def _check_address(address: str) -> None:
    """Check the address of a scheduler and, for TLS, that certificates are configured.

    Raises
    ------
    InputErrorText
        The address is invalid, or there are no certificates.
    """
    try:
        parts = urlsplit(address)
        whole = parts.hostname and parts.port
    except ValueError:
        whole = None
    if not (address.startswith(SCHEMES) and whole):
        raise cli.InputErrorText(
            f"--scheduler {address}: not a valid address; write it as tls://host:8786 or tcp://host:8786"
        )
    if not address.startswith(ENCRYPTED):
        return
    from distributed.security import Security

    names = "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ...__CLIENT__CERT and ...__CLIENT__KEY (docs/studies.md)"
    try:
        known = Security().get_connection_args("client").get("ssl_context")
    except (OSError, ValueError, TypeError) as error:
        text = f"--scheduler {address}: the certificates configured for Dask cannot be used ({error}); see {names}"
        raise cli.InputErrorText(text) from None
    if known is None:
        raise cli.InputErrorText(f"--scheduler {address}: TLS needs certificates; configure them for Dask with {names}")


def _wait_for_worker(workers: Workers, address: str, notify: Callable[[str], None]) -> None:
    """Wait for the first worker of a running cluster."""
    end = time.monotonic() + WORKER_SECONDS
    announced = False
    while not workers.count:
        if not announced:
            notify(f"the scheduler {address} has no workers yet; waiting for `dask worker {address} --nthreads 1`")
            announced = True
        if time.monotonic() > end:
            raise ClusterError(f"the scheduler {address} had no workers for {WORKER_SECONDS:.0f} s")
        time.sleep(0.2)


def _differences(client: Client) -> list[str]:
    """Return warnings about package versions of the workers that differ from those here, which may change results.

    Raises
    ------
    InputErrorText
        A worker cannot import the twin, or has other source files of it.
    """
    try:
        replies = client.run(_program, on_error="return")
    except Exception as error:
        raise ClusterError(f"the workers do not answer: {error}") from error
    ours, source = _program()
    out = []
    for address, reply in replies.items():
        if isinstance(reply, BaseException):
            text = f"the worker {address} cannot import the twin ({reply}); start it from the twin's environment"
            raise cli.InputErrorText(text)
        if reply[1] != source:
            text = f"the worker {address} has other source files of the twin or its extensions; install the same"
            raise cli.InputErrorText(text)
        different = [
            f"{name} {reply[0].get(name)} instead of {version}"
            for name, version in ours.items()
            if reply[0].get(name) != version
        ]
        if different:
            out.append(f"the worker {address} has other package versions: {', '.join(different)}")
    return out


def _program() -> tuple[dict[str, str], str]:
    """Return the versions of the installed packages, and one checksum of the program's source files."""
    return provenance.versions(), provenance.source_digest()


def _silence() -> None:
    """Silence Dask's log, which prints every lost connection; the command reports those that matter."""
    for name in ("distributed", "distributed.client", "distributed.core", "distributed.nanny", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")
