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
import select
import signal
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import IO, Any

from optics.numerics.backend import cores

MOST_TASKS = 256
"""Largest number of tasks: a task number is one byte."""
_HEAD = struct.Struct("=QB")
"""Binary header of a batch of tasks: its size in bytes, and the number of its tasks that are for the second process
alone.
"""
PATIENCE = 120.0
"""Time that the command, once idle, waits for the second process before it repeats the task itself, in seconds."""


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
        self._child = 0
        self._tasks: dict[str, Callable[[], Any]] = {}

    def __enter__(self) -> SecondProcess:
        alone = threading.current_thread() is threading.main_thread()
        if self._wanted and hasattr(os, "fork") and alone and cores() > 1:
            self._begin()
        return self

    def __exit__(self, *_: object) -> None:
        if self._child:
            self._wait_for_end(0.0)
            self._from_child.close()

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

        Raises
        ------
        ValueError
            There are more than ``MOST_TASKS`` tasks in total.
        """
        first = len(self._tasks)
        if first + len(tasks) > MOST_TASKS:
            raise ValueError(f"more than {MOST_TASKS} tasks: {first + len(tasks)}")
        self._tasks |= tasks
        if not self._child:
            return
        numbers = dict(zip(tasks, range(first, first + len(tasks)), strict=True))
        try:
            content = pickle.dumps({numbers[name]: task for name, task in tasks.items()}, pickle.HIGHEST_PROTOCOL)
        except (pickle.PicklingError, TypeError, AttributeError):
            return
        # through a file, since a full pipe without a reader would block this process
        os.pwrite(self._to_child.fileno(), content, self._sent)
        self._sent += len(content)
        alone = bytes(number for name, number in numbers.items() if name in apart)
        try:
            # in this order: when a task number can be read, its batch has been announced
            os.write(self._batches, _HEAD.pack(len(content), len(alone)) + alone)
            os.write(self._requests[1], bytes(number for name, number in numbers.items() if name not in apart))
        except BrokenPipeError:
            pass  # the second process has ended

    def results(self) -> dict[str, Any]:
        """Return the result of every task by its name; exceptions of tasks are raised here."""
        names, results = list(self._tasks), {}
        if self._child:
            self._close_pipes()
            for number in _received_numbers(self._requests[0]):
                results[names[number]] = self._tasks[names[number]]()
            self._wait_for_end(PATIENCE)
            for number, result in _stored_results(self._from_child):
                results[names[number]] = result
        return {name: results[name] if name in results else task() for name, task in self._tasks.items()}

    def _begin(self) -> None:
        """Fork the second process."""
        sys.stdout.flush()
        sys.stderr.flush()
        # the process that reads a byte has the task of that number; a pipe gives each byte to one reader
        self._requests, batches = os.pipe(), os.pipe()
        os.set_blocking(self._requests[0], False)  # of two processes that wait for a byte, one would wait for ever
        self._to_child: IO[bytes] = tempfile.TemporaryFile()
        self._from_child: IO[bytes] = tempfile.TemporaryFile()
        self._sent = 0
        child = os.fork()
        if child == 0:
            try:
                os.close(batches[1])
                os.close(self._requests[1])
                self._work(batches[0])
            finally:
                os._exit(0)  # no buffer of the command is flushed twice
        os.close(batches[0])
        self._batches = batches[1]
        self._child, self._sending = child, True

    def _work(self, batches: int) -> None:
        """Run the second process: receive tasks, do them and store their results."""
        gc.disable()  # leaves the memory pages shared with the first process untouched
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends it
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        # every copy of a lock file's descriptor holds the lock, so close all other descriptors
        first, requests = 3, self._requests[0]
        for kept in sorted((batches, requests, self._to_child.fileno(), self._from_child.fileno())):
            os.closerange(first, kept)
            first = kept + 1
        os.closerange(first, os.sysconf("SC_OPEN_MAX"))
        self._prepare()
        tasks: dict[int, Callable[[], Any]] = {}
        waiting, read = [batches, requests], 0
        while waiting:
            ready, _, _ = select.select(waiting, (), ())
            if batches in ready:
                head = os.read(batches, _HEAD.size)
                if not head:
                    waiting.remove(batches)
                    continue
                length, count = _HEAD.unpack(head)
                alone = os.read(batches, count) if count else b""
                tasks |= pickle.loads(os.pread(self._to_child.fileno(), length, read))
                read += length
                for task in alone:
                    self._do(task, tasks)
                continue
            try:
                request = os.read(requests, 1)
            except BlockingIOError:  # the first process has taken the task
                continue
            if not request:
                waiting.remove(requests)
                continue
            self._do(request[0], tasks)

    def _do(self, number: int, tasks: Mapping[int, Callable[[], Any]]) -> None:
        """Do a task in the second process and store its result."""
        pickle.dump((number, tasks[number]()), self._from_child)
        self._from_child.flush()

    def _close_pipes(self) -> None:
        """Close the pipes, which tells the second process that no further tasks come."""
        if self._sending:
            self._sending = False
            os.close(self._requests[1])
            os.close(self._batches)
            self._to_child.close()

    def _wait_for_end(self, patience: float) -> None:
        """Wait for the end of the second process, and kill it if it takes longer than ``patience`` seconds."""
        self._close_pipes()
        last = time.monotonic() + patience
        while os.waitpid(self._child, os.WNOHANG) == (0, 0):
            if time.monotonic() > last:
                os.kill(self._child, signal.SIGKILL)
                os.waitpid(self._child, 0)
                break
            time.sleep(0.002)
        self._child = 0
        os.close(self._requests[0])


def _received_numbers(pipe: int) -> Iterator[int]:
    """Yield numbers of tasks from a pipe that both processes read, so that each task is done by one of them.

    It ends when no task is left.
    """
    while True:
        select.select([pipe], (), ())
        try:
            number = os.read(pipe, 1)
        except BlockingIOError:  # the other process has taken the task
            continue
        if not number:
            return
        yield number[0]


def _stored_results(file: IO[bytes]) -> Any:
    """Yield all complete results in a file."""
    with file:
        file.seek(0)
        while True:
            try:
                yield pickle.load(file)
            except (EOFError, pickle.UnpicklingError):  # the end of the file, or the process was killed while it wrote
                return
