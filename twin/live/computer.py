"""The process that computes, its answers, and the handle by which the server asks it.

One process does all computing, so that a page's drag does not take the cores from its own readings; asked for more than
it can do, the server asks it for the last state only (`twin.live.clients`).
"""

from __future__ import annotations

import asyncio
import gc
import json
import multiprocessing
import os
import signal
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from optics.numerics.backend import BackendUnavailable, cores, kernel_threads, one_blas_thread
from optics.numerics.llvm import LibraryMissing
from scenes.yaml.errors import InputError
from twin.live.camera_pictures import CameraPictures
from twin.live.live_bench import LOST, LiveBench, course_text, job_text
from twin.live.messages import AskedState, AskedView, BlindState, Opened, packed
from twin.live.source import read_source
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.scene_file import scene_bytes
from twin.scripting.instrument_twin import InstrumentTwin

KEPT = 3
"""Instruments of a study that stay built."""


class Answers:
    """An instrument that is ready to answer.

    Parameters
    ----------
    what
        As of `twin.live.source.read_source`.
    backend
        Where to trace.
    advance
        Told of each part of the preparation.
    run
        Of a study, as of `twin.live.source.read_source`.

    Raises
    ------
    InputError, BackendUnavailable, LibraryMissing
        It cannot be built.
    """

    def __init__(self, what: str, backend: str, advance: Callable[[str], None], run: int | None = None) -> None:
        advance("build the instrument")
        self.source = read_source(what, run)
        self._backend = backend
        self._built: OrderedDict[str, tuple[LiveBench, CameraPictures, Opened]] = OrderedDict()
        self.bench, self.pictures, self.opened = self._open({}, advance)

    def _open(
        self, factors: Mapping[str, float], advance: Callable[[str], None] = lambda part: None
    ) -> tuple[LiveBench, CameraPictures, Opened]:
        """The instrument with these values of a study's factors, built if it is not.

        Raises
        ------
        InputError
            They cannot be.
        """
        key = json.dumps(dict(sorted(factors.items())))
        if key not in self._built:
            bench = LiveBench(InstrumentTwin.of(self.source.with_factors(factors), self._backend))
            bench.warm(advance)
            greeting = {
                **bench.greeting(),
                "opened": self.source.name,
                "about": " ".join((f"{self.source.about}.", *(f"{note}." for note in self.source.notes))),
                "factors": [
                    {**asdict(knob), "now": factors.get(knob.name, knob.value)} for knob in self.source.factors
                ],
            }
            experiment = bench.twin.experiment
            light = trace_light_paths(experiment.instrument, experiment.backend, {})
            scene = scene_bytes(experiment.instrument, {}, light)
            self._built[key] = bench, CameraPictures(experiment), Opened(greeting, scene)
        self._built.move_to_end(key)
        while len(self._built) > KEPT:
            self._built.popitem(last=False)
        return self._built[key]

    def to(self, kind: str, question: Any) -> Any:
        """The answer to one question; see the methods."""
        return getattr(self, f"_{kind}")(question)

    def _factors(self, factors: Mapping[str, float]) -> Opened | str:
        """Turn to an instrument with other values of factors; a text says why that cannot be."""
        try:
            self.bench, self.pictures, self.opened = self._open(factors)
        except LOST as error:
            return str(error)[:1000]
        return self.opened

    def _state(self, question: tuple[AskedState, tuple[bool, int, int] | None]) -> bytes:
        """A state's message with its images; with those before, if the page does not have them."""
        asked, known = question
        told, after = self.bench.state(asked)
        images = {} if after is None else {"after": after}
        key = (asked.noise, asked.frames, asked.seed)
        if key != known:
            images["before"] = self.bench.before(asked)
        if told.get("guess") and "image" in told["guess"]:
            images["guess"] = told["guess"].pop("image")
        return packed(told, images)

    def _view(self, asked: AskedView) -> str:
        """A picture's message."""
        told: dict[str, Any] = {"type": "view", "n": asked.n, "view": asked.view, "camera": asked.camera}
        try:
            state = self.bench.states(asked.state)
            told["svg"] = self.pictures.draw(
                asked.view, asked.camera, asked.field, state, asked.state.frames, self.bench.seed_of(asked.state.seed)
            )
        except LOST as error:
            told["problem"] = str(error)[:1000]
        return json.dumps(told)

    def _hidden(self, asked: BlindState) -> str:
        """What was hidden, and what it truly did."""
        return json.dumps({"type": "revealed", **self.bench.hidden(asked)})

    def _job(self, asked: AskedState) -> str:
        """A job file of a state."""
        return self._file("job.yaml", lambda: job_text(self.bench, asked))

    def _course(self, kept: Sequence[tuple[float, AskedState]]) -> str:
        """A job file with a course of what was recorded."""
        return self._file("course.yaml", lambda: course_text(self.bench, kept))

    def _file(self, name: str, text: Callable[[], str]) -> str:
        told: dict[str, Any] = {"type": "file", "name": name}
        try:
            told["text"] = text()
        except (InputError, ValueError) as error:
            told["problem"] = str(error)[:1000]
        return json.dumps(told)


Kind = Literal["state", "view", "hidden", "job", "course", "factors"]
BeforeKey = tuple[bool, int, int]
Condition = Literal["starts", "runs", "stopped", "ended"]
ENDS = 3.0
"""Seconds that the process is given to end by itself."""
ATTEMPTS = 3
"""How often it is started again when it ends while it starts."""


class ComputerLost(Exception):
    """The process that computes ended; the text says how."""


class CannotStart(Exception):
    """The instrument cannot be built; the text says why, as a command tells it."""


class Computer:
    """The process that computes, asked from an event loop; one question after the other.

    Parameters
    ----------
    what
        As of `twin.live.source.read_source`.
    backend
        Where to trace.
    run
        Of a study, likewise.
    """

    def __init__(self, what: str, backend: str, run: int | None = None) -> None:
        self._what, self._backend, self._run = what, backend, run
        self._process: Any = None
        self._pipe: Connection | None = None
        self._turn = asyncio.Lock()
        self._starting = self._asked = self._leaving = False
        # two threads that ask the system for one process' end take it from each other
        self._looks = threading.Lock()
        self._factors: Any = None
        self.opened = Opened({}, b"")

    def start(self, advance: Callable[[str], None] = lambda part: None) -> None:
        """Start the process and wait until every kernel is compiled.

        Parameters
        ----------
        advance : Callable[[str], None]
            Told of each part when it begins.

        Raises
        ------
        CannotStart
            why.
        """
        try:
            self._start(advance)
        except ComputerLost as error:
            raise CannotStart(str(error)) from error

    def _start(self, advance: Callable[[str], None] = lambda part: None) -> None:
        """Start the process once and wait until it is ready, as `start` says.

        Raises
        ------
        CannotStart
            The instrument cannot be built.
        ComputerLost
            The process ended before it was.
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
            raise ComputerLost(self._end_of_it()) from error

    def _start_again(self) -> None:
        """Start it as it was: with what was last made of a study's factors.

        Raises
        ------
        CannotStart
            why.
        """
        for attempt in range(1, ATTEMPTS + 1):
            try:
                self._start()
                if self._factors is not None:
                    found = self._exchange("factors", self._factors)
                    if not isinstance(found, str):
                        self.opened = found
                return
            except ComputerLost as error:
                if attempt == ATTEMPTS or self._leaving:
                    raise CannotStart(f"{error}, {attempt} times when it was started again") from error

    async def start_again(self) -> None:
        """Start another process in place of one that ended, as that was.

        Raises
        ------
        CannotStart
            why.
        """
        async with self._turn:
            self._starting = True
            try:
                await asyncio.get_running_loop().run_in_executor(None, self._start_again)
            finally:
                self._starting = False

    async def ask(self, kind: Kind, question: Any) -> Any:
        """The answer to a question.

        Raises
        ------
        ComputerLost
            The process ended.
        """
        async with self._turn:
            answer = await asyncio.get_running_loop().run_in_executor(None, self._exchange, kind, question)
            if kind == "factors" and not isinstance(answer, str):
                self._factors, self.opened = question, answer
            return answer

    def _exchange(self, kind: Kind, question: Any) -> Any:
        assert self._pipe is not None
        self._asked = True
        try:
            self._pipe.send((kind, question))
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            raise ComputerLost(self._end_of_it()) from error
        finally:
            self._asked = False

    def _end_of_it(self) -> str:
        """How it ended, of a process that has closed its pipe; whatever is left of it is ended."""
        last = time.monotonic() + ENDS
        while self._alive():
            if time.monotonic() > last:
                self.kill()
            time.sleep(0.01)
        return self.ending

    def _alive(self) -> bool:
        with self._looks:
            return self._process is not None and bool(self._process.is_alive())

    @property
    def ending(self) -> str:
        """In words, how the process ended that has."""
        code = None if self._process is None else self._process.exitcode
        if code is None:
            return "the process that computes ended"
        how = f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
        return f"the process that computes ended ({how})"

    @property
    def pid(self) -> int | None:
        """Number of the process; None before it was started."""
        return None if self._process is None else self._process.pid

    @property
    def condition(self) -> Condition:
        """How the process is: stopped by a signal, or ended by itself or by somebody."""
        alive = self._alive()
        if alive and _stopped(self._process.pid):
            return "stopped"
        return "starts" if self._starting else "runs" if alive else "ended"

    def kill(self) -> None:
        """End it at once; whoever waits for an answer is told that it ended."""
        with self._looks:
            if self._process is not None:
                self._process.kill()

    def leave(self) -> None:
        """The server ends: nobody waits for an answer any more, and one that is awaited would keep the server."""
        self._leaving = True
        if self._asked or self._starting or self.condition == "stopped":
            self.kill()

    def stop(self) -> None:
        """End the process."""
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.join(ENDS)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()


def _stopped(pid: int) -> bool:
    """Whether a process was stopped by a signal, but not by a debugger; False where the system does not tell."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return False
    return told.rpartition(")")[2].split()[:1] == ["T"]


def compute(pipe: Connection, what: str, backend: str, run: int | None) -> None:
    """What the process does: build the instrument, then answer until the pipe is closed.

    Parameters
    ----------
    pipe : Connection
        To the server.
    what : str
        As of `Computer`.
    backend : str
        likewise.
    run : int | None
        likewise.
    """
    # Ctrl-C goes to the whole group of the terminal; the server ends this process by closing the pipe
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(os.getppid())
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
