"""A second process of a command for what can be done apart: it imports what draws while the first one still computes,
and then both take piece after piece of the drawing.

It is a fork of the command, made before anything was computed, and does nothing but what it is sent: it touches no
device, writes into no run folder and ends with the command. What it fails to give the command does itself, and that
raises the errors; so a result is never lost, and is the same with the second process as without it.
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
_HEAD = struct.Struct("=QB")
"""What tells of tasks: bytes that they take, and how many of them the second process does alone."""
PATIENCE = 120.0
"""Seconds for which one task may keep the command waiting that has nothing else to do; then it is done here, too."""


class SecondProcess:
    """Use as a context: from its beginning on the process is there, if the machine has a core for it.

    Parameters
    ----------
    prepare
        Done in it at once, imports most of all.
    wanted
        False for none: everything is done here.
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
            self._ended(0.0)
            self._from_child.close()

    def __contains__(self, name: str) -> bool:
        """Whether a task of that name has been started."""
        return name in self._tasks

    def start(self, tasks: Mapping[str, Callable[[], Any]], apart: Collection[str] = ()) -> None:
        """Let it begin with some tasks, beside those that it may have already. Tasks that cannot be pickled, because of
        what a user has added, are left to this process.

        Parameters
        ----------
        tasks : Mapping[str, Callable[[], Any]]
            Name -> what is to be done, the longest first. They see the values that they hold as they are now.
        apart : Collection[str]
            Names of tasks that the second process does first and alone where there is one: what they import it has
            imported already, and this process need not import it as well.

        Raises
        ------
        ValueError
            There are more than ``MOST_TASKS`` in all.
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
        # through a file: a pipe that nobody reads yet would keep this process waiting
        os.pwrite(self._to_child.fileno(), content, self._sent)
        self._sent += len(content)
        alone = bytes(number for name, number in numbers.items() if name in apart)
        try:
            # in this order: a turn is of a task that the second process has or finds announced
            os.write(self._batches, _HEAD.pack(len(content), len(alone)) + alone)
            os.write(self._turns[1], bytes(number for name, number in numbers.items() if name not in apart))
        except BrokenPipeError:
            pass  # it is gone

    def results(self) -> dict[str, Any]:
        """Name -> result of every task. Raises whatever a task does."""
        names, found = list(self._tasks), {}
        if self._child:
            self._nothing_more()
            for number in _turns(self._turns[0]):
                found[names[number]] = self._tasks[names[number]]()
            self._ended(PATIENCE)
            for number, result in _stored(self._from_child):
                found[names[number]] = result
        return {name: found[name] if name in found else task() for name, task in self._tasks.items()}

    def _begin(self) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        # whoever reads a byte has the task of that number; a pipe gives each to one reader alone
        self._turns, batches = os.pipe(), os.pipe()
        os.set_blocking(self._turns[0], False)  # of two that wait for a byte one would wait in vain
        self._to_child: IO[bytes] = tempfile.TemporaryFile()
        self._from_child: IO[bytes] = tempfile.TemporaryFile()
        self._sent = 0
        child = os.fork()
        if child == 0:
            try:
                os.close(batches[1])
                os.close(self._turns[1])
                self._work(batches[0])
            finally:
                os._exit(0)  # nothing of the command is closed, written or told twice
        os.close(batches[0])
        self._batches = batches[1]
        self._child, self._sending = child, True

    def _work(self, batches: int) -> None:
        """All that the second process does."""
        gc.disable()  # what the first process computes with is left alone
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first one ends it
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        # a lock on a run folder ends with the process that holds it, and is held by every copy of its file
        first, turns = 3, self._turns[0]
        for kept in sorted((batches, turns, self._to_child.fileno(), self._from_child.fileno())):
            os.closerange(first, kept)
            first = kept + 1
        os.closerange(first, os.sysconf("SC_OPEN_MAX"))
        self._prepare()
        tasks: dict[int, Callable[[], Any]] = {}
        waiting, read = [batches, turns], 0
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
                for own in alone:
                    self._do(own, tasks)
                continue
            try:
                turn = os.read(turns, 1)
            except BlockingIOError:  # the first process has taken it
                continue
            if not turn:
                waiting.remove(turns)
                continue
            self._do(turn[0], tasks)

    def _do(self, number: int, tasks: Mapping[int, Callable[[], Any]]) -> None:
        """Do a task in the second process, and store its result."""
        pickle.dump((number, tasks[number]()), self._from_child)
        self._from_child.flush()

    def _nothing_more(self) -> None:
        """There are no further tasks: who waits for one is told so."""
        if self._sending:
            self._sending = False
            os.close(self._turns[1])
            os.close(self._batches)
            self._to_child.close()

    def _ended(self, patience: float) -> None:
        """Wait for its end, and bring it about when it takes too long."""
        self._nothing_more()
        last = time.monotonic() + patience
        while os.waitpid(self._child, os.WNOHANG) == (0, 0):
            if time.monotonic() > last:
                os.kill(self._child, signal.SIGKILL)
                os.waitpid(self._child, 0)
                break
            time.sleep(0.002)
        self._child = 0
        os.close(self._turns[0])


def _turns(pipe: int) -> Iterator[int]:
    """Numbers of tasks that nobody else has, until there are no more."""
    while True:
        select.select([pipe], (), ())
        try:
            number = os.read(pipe, 1)
        except BlockingIOError:  # the other process has taken it
            continue
        if not number:
            return
        yield number[0]


def _stored(file: IO[bytes]) -> Any:
    """All whole results in a file."""
    with file:
        file.seek(0)
        while True:
            try:
                yield pickle.load(file)
            except (EOFError, pickle.UnpicklingError):  # nothing more, or it was killed while it wrote
                return
