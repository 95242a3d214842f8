"""The process that computes, and the handle by which the server asks it.

One process does all computing, so that a page's drag does not take the cores from its own readings; asked for more than
it can do, the server asks it for the last state only (`twin.live.clients`).
"""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Literal

from twin.live.messages import Opened

Kind = Literal["state", "view", "hidden", "job", "course", "factors"]
BeforeKey = tuple[bool, int, int]
ENDS = 3.0
"""Seconds that the process is given to end by itself."""


class ComputerLost(Exception):
    """The process that computes ended; the next question starts another."""


class CannotStart(Exception):
    """The instrument cannot be built; the text says why, as a command tells it."""


class Computer:
    """The process that computes, asked from an event loop; one question after the other.

    Args:
        what: as of `twin.live.source.read_source`.
        backend: where to trace.
        run: of a study, likewise.
    """

    def __init__(self, what: str, backend: str, run: int | None = None) -> None:
        self._what, self._backend, self._run = what, backend, run
        self._process: Any = None
        self._pipe: Connection | None = None
        self._turn = asyncio.Lock()
        self.opened = Opened({}, b"")

    def start(self, advance: Callable[[str], None] = lambda part: None) -> None:
        """Start the process and wait until every kernel is compiled.

        Args:
            advance: told of each part when it begins.

        Raises:
            CannotStart: why.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=compute, args=(theirs, self._what, self._backend, self._run), daemon=True
        )
        self._process.start()
        theirs.close()
        try:
            while True:
                said, value = self._pipe.recv()
                if said == "part":
                    advance(value)
                elif said == "ready":
                    self.opened = value
                    return
                else:
                    raise CannotStart(value)
        except (EOFError, OSError) as error:
            raise CannotStart(f"the process that computes ended ({self._process.exitcode})") from error

    async def ask(self, kind: Kind, question: Any) -> Any:
        """The answer to a question.

        Raises:
            ComputerLost: the process ended.
        """
        async with self._turn:
            if self._process is None or not self._process.is_alive():
                await asyncio.get_running_loop().run_in_executor(None, self.start)
            assert self._pipe is not None
            pipe = self._pipe

            def exchange() -> Any:
                pipe.send((kind, question))
                return pipe.recv()

            try:
                return await asyncio.get_running_loop().run_in_executor(None, exchange)
            except (EOFError, OSError) as error:
                self._process.join(ENDS)
                raise ComputerLost(f"the process that computes ended ({self._process.exitcode})") from error

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return None if self._process is None else self._process.pid

    def stop(self) -> None:
        """End the process."""
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.join(ENDS)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()


def compute(pipe: Connection, what: str, backend: str, run: int | None) -> None:
    """What the process does: build the instrument, then answer until the pipe is closed.

    Args:
        pipe: to the server.
        what: as of `Computer`.
        backend: likewise.
        run: likewise.
    """
    # Ctrl-C goes to the whole group of the terminal; the server ends this process by closing the pipe
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(os.getppid())
    from optics.numerics.backend import BackendUnavailable
    from optics.numerics.llvm import LibraryMissing
    from optics.numerics.threads import cores, kernel_threads, one_blas_thread
    from scenes.yaml.errors import InputError
    from twin.live.answers import Answers

    with one_blas_thread():
        try:
            answers = Answers(what, backend, lambda part: pipe.send(("part", part)), run)
            pipe.send(("ready", answers.opened))
            # what is built stays; looking through it again and again would cost every state some milliseconds
            gc.collect()
            gc.freeze()
        except (InputError, BackendUnavailable, LibraryMissing, ValueError) as error:
            pipe.send(("failed", str(error)))
            return
        while True:
            try:
                kind, question = pipe.recv()
            except (EOFError, OSError):
                return
            # a state is many small kernels; whatever else is asked for may have large ones
            kernel_threads(1 if kind == "state" else cores())
            pipe.send(answers.to(kind, question))


def _end_with(parent: int) -> None:
    """End this process when the server was killed, even in the middle of a state."""

    def watch() -> None:
        while os.getppid() == parent:
            threading.Event().wait(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
