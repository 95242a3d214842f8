"""Second process of a command for tasks that can run in parallel, such as drawing.

It imports the drawing libraries while the first process computes; then both take task after task. It is a fork of the
command, made before anything was computed, and does only the tasks that it is sent: it touches no device, writes into
no run folder and ends with the command. Tasks that fail there are repeated by the command itself, which raises the
errors; so no result is lost, and results are the same with and without the second process.
"""

from __future__ import annotations

import gc
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, connection, get_context, parent_process
from pathlib import Path
from typing import Any

from optics.numerics.backend import cores

PATIENCE = 120.0
"""Time that the command, once idle, waits for the second process before it repeats the task itself, in seconds."""
_TASKS: dict[str, Callable[[], Any]] = {}
"""Tasks that the second process was sent; empty in the first one."""


class SecondProcess:
    """Context manager that runs the second process, if the machine has a core for it.

    Parameters
    ----------
    prepare
        Function that the second process calls at once, mainly to import modules.
    wanted
        False to do all tasks in this process.
    """

    def __init__(self, prepare: Callable[[], object], wanted: bool = True) -> None:
        self._prepare, self._wanted = prepare, wanted
        self._pool: ProcessPoolExecutor | None = None
        self._tasks: dict[str, Callable[[], Any]] = {}
        self._sent: dict[str, Future[Any]] = {}
        self._apart: set[str] = set()
        self._files: list[Path] = []

    def __enter__(self) -> SecondProcess:
        alone = threading.current_thread() is threading.main_thread()
        if self._wanted and hasattr(os, "fork") and alone and cores() > 1:
            others = set(active_children())
            self._pool = ProcessPoolExecutor(1, get_context("fork"), _begin, (self._prepare,))
            self._pool.submit(os.getpid)  # makes the fork now
            (self._child,) = set(active_children()) - others
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._child.kill()
            self._pool.shutdown(cancel_futures=True)
            self._child.close()
        for file in self._files:
            file.unlink(missing_ok=True)

    def __contains__(self, name: str) -> bool:
        """Return True if a task of that name has been started."""
        return name in self._tasks

    def start(self, tasks: Mapping[str, Callable[[], Any]], apart: Collection[str] = ()) -> None:
        """Start some tasks, beside those that were started before.

        Tasks that cannot be pickled, because of user extensions, are left to this process.

        Parameters
        ----------
        tasks : mapping of str to callable
            Name -> task, the longest first. Tasks see the values that they hold as they are now.
        apart : collection of str
            Names of tasks that only the second process does, first, if it exists: it has already imported the modules
            they need, and this process need not import them as well.
        """
        self._tasks |= tasks
        self._apart |= set(apart)
        if self._pool is None:
            return
        try:
            # all in one piece, since they have large values in common; a file, since the pool would copy them twice
            with tempfile.NamedTemporaryFile(prefix="camtwin-tasks-", delete=False) as file:
                self._files.append(Path(file.name))
                pickle.dump(dict(tasks), file, pickle.HIGHEST_PROTOCOL)
            self._pool.submit(_keep, file.name)
            for name in sorted(tasks, key=lambda name: name not in apart):
                self._sent[name] = self._pool.submit(_do, name)
        except (pickle.PicklingError, TypeError, AttributeError, BrokenProcessPool):
            return  # the first process does them

    def results(self) -> dict[str, Any]:
        """Return the result of every task by its name; exceptions of tasks are raised here."""
        results: dict[str, Any] = {}
        for name, task in reversed(self._tasks.items()):
            sent = self._sent.get(name)
            if sent is None or (name not in self._apart and sent.cancel()):
                results[name] = task()
        for name, task in self._tasks.items():
            if name not in results:
                try:
                    results[name] = self._sent[name].result(PATIENCE)
                except Exception:
                    self._child.kill()  # so that none of the others waits
                    results[name] = task()
        return {name: results[name] for name in self._tasks}


def _begin(prepare: Callable[[], object]) -> None:
    """Separate the second process from the terminal and the signals of the first, and end it with the first."""
    gc.disable()  # leaves the memory pages shared with the first process untouched
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends it
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    threading.Thread(target=_end_with_the_first, daemon=True).start()
    prepare()


def _end_with_the_first() -> None:
    """Wait for the end of the first process, also of a killed one, and end this one with it."""
    first = parent_process()
    assert first is not None
    connection.wait([first.sentinel])
    os._exit(0)


def _keep(path: str) -> None:
    """Store tasks that were pickled to a file in the second process, and delete the file."""
    with open(path, "rb") as file:
        os.unlink(path)
        _TASKS.update(pickle.load(file))


def _do(name: str) -> Any:
    """Return the result of a task in the second process."""
    return _TASKS[name]()
