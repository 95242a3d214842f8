"""Computing process of the live twin, its answers, and the object by which the server uses it.

One process does all computing, so that the pages do not compete for the processor cores. Under overload the server
requests only the latest state of each page (`twin.live.clients`).
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
from itertools import pairwise
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, Literal

from optics.numerics.backend import BackendUnavailable, cores, kernel_threads, one_blas_thread
from optics.numerics.llvm import LibraryMissing
from scenes.specs.course import DEFAULT_PIVOT, FEWEST, MOST, moment
from scenes.specs.job import JobSpec
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml
from twin.framework.provenance import Provenance, versions
from twin.live.camera_design import DESIGN, CameraPictures, camera_text
from twin.live.knobs import AXES, Knob, perturbation
from twin.live.live_bench import IMPOSSIBLE, LiveBench
from twin.live.messages import AskedState, AskedView, BlindState, Opened, packed
from twin.live.source import read_source
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.scene_file import scene_bytes
from twin.scripting.instrument_twin import InstrumentTwin

MOST_BUILT = 3
"""Largest number of instruments of a study, with different factors, that are kept in memory."""


class RequestHandler:
    """Built instrument that answers the requests of pages in the computing process.

    Parameters
    ----------
    what
        Name of an instrument or camera in the library, or path of a file or run folder, as for `read_source`.
    backend
        Array backend of the ray trace.
    advance
        Callback that receives the name of each part of the preparation.
    run
        Number of one of a study's runs, from 0; None for its base.

    Raises
    ------
    InputError, BackendUnavailable, LibraryMissing
        The instrument cannot be built.
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
        """Return the instrument for given values of a study's factors, building it if necessary.

        Raises
        ------
        InputError
            The values are not possible.
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
        while len(self._built) > MOST_BUILT:
            self._built.popitem(last=False)
        return self._built[key]

    def handle(self, kind: str, question: Any) -> Any:
        """Return the answer to a request; ``kind`` names the method that computes it."""
        return getattr(self, f"_{kind}")(question)

    def _factors(self, factors: Mapping[str, float]) -> Opened | str:
        """Switch to an instrument with other values of a study's factors; an error is returned as text."""
        try:
            self.bench, self.pictures, self.opened = self._open(factors)
        except IMPOSSIBLE as error:
            return str(error)[:1000]
        return self.opened

    def _state(self, question: tuple[AskedState, tuple[bool, int, int] | None]) -> bytes:
        """Return the message with a state and its images, and with the reference images if the page lacks them."""
        asked, known = question
        message, after = self.bench.state(asked)
        images = {**({} if after is None else {"after": after}), **message.pop("pictures", {})}
        key = (asked.noise, asked.frames, asked.seed)
        if key != known:
            images["before"] = self.bench.before(asked)
        if message.get("guess") and "image" in message["guess"]:
            images["guess"] = message["guess"].pop("image")
        return packed(message, images)

    def _view(self, asked: AskedView) -> str:
        """Return the message with a picture of a camera as SVG."""
        message: dict[str, Any] = {"type": "view", "n": asked.n, "view": asked.view, "camera": asked.camera}
        try:
            state, now = self.bench.states(asked.state), self.bench.perturbed(asked.state).experiment
            field, seed = self.bench.field(asked.state) or (asked.field, 0.0), self.bench.seed_of(asked.state.seed)
            message["svg"] = self.pictures.draw(asked.view, asked.camera, field, state, asked.state.frames, seed, now)
        except IMPOSSIBLE as error:
            message["problem"] = str(error)[:1000]
        return json.dumps(message)

    def _hidden(self, asked: BlindState) -> str:
        """Return the message that reveals the hidden motions and the resulting true changes."""
        return json.dumps({"type": "revealed", **self.bench.hidden(asked)})

    def _job(self, asked: AskedState) -> str:
        """Return the message with a job file that describes a state."""
        return self._file("job.yaml", lambda: job_text(self.bench, asked))

    def _camera(self, asked: AskedState) -> str:
        """Return the message with the file of the camera as the knobs design it."""
        return self._file("camera.yaml", lambda: camera_file(self.bench, asked))

    def _course(self, kept: Sequence[tuple[float, AskedState]]) -> str:
        """Return the message with a job file that contains the recorded states as a time series."""
        return self._file("course.yaml", lambda: course_text(self.bench, kept))

    def _file(self, name: str, text: Callable[[], str]) -> str:
        """Return the message with the name and text of a file to be saved, or with an error."""
        message: dict[str, Any] = {"type": "file", "name": name}
        try:
            message["text"] = text()
        except (InputError, ValueError) as error:
            message["problem"] = str(error)[:1000]
        return json.dumps(message)


Kind = Literal["state", "view", "hidden", "job", "course", "camera", "factors"]
BeforeKey = tuple[bool, int, int]
EXIT_TIMEOUT = 3.0
"""Time that the process may take to end by itself before it is killed, in seconds."""


class ComputerLost(Exception):
    """Error that the computing process has ended or cannot be started; the message says how or why."""


class Computer:
    """Object by which the server's event loop uses the computing process; it answers one request at a time.

    Parameters
    ----------
    what
        Name of an instrument or camera in the library, or path of a file or run folder, as for `read_source`.
    backend
        Array backend of the ray trace.
    run
        Number of one of a study's runs, from 0; None for its base.
    """

    def __init__(self, what: str, backend: str, run: int | None = None) -> None:
        self._what, self._backend, self._run = what, backend, run
        self._process: Any = None
        self._pipe: Connection | None = None
        self._request_lock = asyncio.Lock()
        self._asked = False
        self.opened = Opened({}, b"")

    def start(self, advance: Callable[[str], None] = lambda part: None) -> None:
        """Start the process and wait until all kernels are compiled.

        Parameters
        ----------
        advance : Callable[[str], None]
            Callback that receives the name of each part of the preparation when it begins.

        Raises
        ------
        ComputerLost
            The instrument cannot be built, or the process ended during its start.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, child_pipe = context.Pipe()
        self._process = context.Process(
            target=compute, args=(child_pipe, self._what, self._backend, self._run), daemon=True
        )
        # Ctrl-C reaches the whole process group; the server ends this process by closing the pipe. The process inherits
        # the mask, so that Ctrl-C does not interrupt its imports either; the start of the tracker would unblock it.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        child_pipe.close()
        try:
            while True:
                kind_of_answer, value = self._pipe.recv()
                if kind_of_answer == "part":
                    advance(value)
                elif kind_of_answer == "ready":
                    self.opened = value
                    return
                else:
                    raise ComputerLost(value)
        except (EOFError, OSError) as error:
            raise ComputerLost(self._describe_end()) from error

    async def ask(self, kind: Kind, question: Any) -> Any:
        """Return the answer to a request.

        Raises
        ------
        ComputerLost
            The process ended.
        """
        async with self._request_lock:
            answer = await asyncio.get_running_loop().run_in_executor(None, self._exchange, kind, question)
            if kind == "factors" and not isinstance(answer, str):
                self.opened = answer
            return answer

    def _exchange(self, kind: Kind, question: Any) -> Any:
        """Send a request to the computing process and wait for its answer."""
        assert self._pipe is not None
        self._asked = True
        try:
            self._pipe.send((kind, question))
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            raise ComputerLost(self._describe_end()) from error
        finally:
            self._asked = False

    def _describe_end(self) -> str:
        """Wait for the end of a process that has closed its pipe, and return how it ended."""
        last = time.monotonic() + EXIT_TIMEOUT
        while self._process.is_alive():
            if time.monotonic() > last:
                self._process.kill()
            time.sleep(0.01)
        code = self._process.exitcode
        how = f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
        return f"the computing process ended ({how})"

    def leave(self) -> None:
        """Prepare the end of the server: kill the process if an answer is awaited, which would delay the server."""
        if self._asked:
            self._process.kill()

    def stop(self) -> None:
        """End the computing process."""
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.join(EXIT_TIMEOUT)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()


def compute(pipe: Connection, what: str, backend: str, run: int | None) -> None:
    """Run the computing process: build the instrument, then answer requests until the pipe is closed.

    Parameters
    ----------
    pipe : Connection
        Pipe to the server.
    what : str
        Name of an instrument or camera in the library, or path of a file or run folder.
    backend : str
        Backend that traces.
    run : int | None
        Number of a study's run.
    """
    _end_with(os.getppid())
    with one_blas_thread():
        try:
            answers = RequestHandler(what, backend, lambda part: pipe.send(("part", part)), run)
            pipe.send(("ready", answers.opened))
            # what is built stays; collecting garbage in it would cost every state some milliseconds
            gc.collect()
            gc.freeze()
        except (InputError, BackendUnavailable, LibraryMissing, ValueError) as error:
            pipe.send(("failed", str(error)))
            return
        except BrokenPipeError:  # the server has ended, by Ctrl-C while this process was starting
            return
        while True:
            try:
                kind, question = pipe.recv()
            except (EOFError, OSError):
                return
            # a state consists of many small kernels; other requests may have large ones
            kernel_threads(1 if kind == "state" else cores())
            pipe.send(answers.handle(kind, question))


def _end_with(parent: int) -> None:
    """End this process when the server (process id ``parent``) has been killed, even during a computation."""

    def watch() -> None:
        while os.getppid() == parent:
            threading.Event().wait(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


HEAD = "# Recorded with python -m twin.live; repeat it: python -m twin.render THIS_FILE\n"
"""Comment in the first line of a saved file."""


def _head() -> str:
    """Return the comment that states where a file was recorded."""
    made, by = Provenance.here(), versions()
    kernels = ", ".join(
        dict.fromkeys(f"{library.name} {library.version} for {library.kernels}" for library in made.blas)
    )
    return (
        f"{HEAD}# made by space-camera-twin {by['space-camera-twin']}, source {made.source}, Python {by['python']}, "
        f"numpy {by['numpy']}, Dr.Jit {by['drjit']}, on {made.processor}; {kernels}\n"
    )


GUESSED = (
    "# Saved while motions were hidden: this job holds the guess of the knobs alone, so that twin.render gives the\n"
    "# spots of the guess and not those that were shown.\n"
)
"""Comment at the top of a job file that was saved while motions were hidden, which it does not contain."""


def job_text(bench: LiveBench, asked: AskedState) -> str:
    """Return a self-contained job file of one state; for a job with a time series, that at the selected time.

    Parameters
    ----------
    bench : LiveBench
        Instrument that is evaluated.
    asked : AskedState
        State of the knobs to be saved.

    Raises
    ------
    InputError
        A job's file could not have a value.
    """
    resolved = bench.perturbed(asked).resolved.with_render(asked.frames, bench.seed_of(asked.seed))
    plain = resolved.plain()
    if asked.time is not None and resolved.job.course is not None:
        plain["job"]["course"]["detail"] = moment(resolved.job.course.times[asked.time])
    hidden = GUESSED if isinstance(asked, BlindState) else ""
    return _head() + hidden + dump_yaml(plain)


def camera_file(bench: LiveBench, asked: AskedState) -> str:
    """Return the file of the camera with the prescription of the knobs, which ``twin.camera`` reads.

    Raises
    ------
    InputError
        The camera cannot have such a prescription.
    ValueError
        The instrument is no single camera.
    """
    if bench.design is None:
        raise ValueError("only the design of a single camera without a monitor can be saved")
    made = bench.perturbed(asked).resolved
    knobs = ((bench.knobs[name], value) for name, value in asked.knobs.items())
    changes = [f"{knob.name} {value:g} {knob.unit}".strip() for knob, value in knobs if knob.kind == DESIGN]
    lines = [f"{bench.design.spec.name}, saved with python -m twin.live: {'; '.join(changes) or 'unchanged'}"]
    if made.job.perturb:
        lines.append("Motions and temperatures of bodies are not part of a camera's file.")
    return camera_text(made.cameras[bench.design.reference], bench.design.spec, "\n".join(lines))


def course_text(bench: LiveBench, kept: Sequence[tuple[float, AskedState]]) -> str:
    """Return a job file with the recorded states as a time series (``course``), timed to the millisecond.

    Parameters
    ----------
    bench : LiveBench
        Instrument that is evaluated.
    kept : Sequence[tuple[float, AskedState]]
        (seconds since the recording began, state) in the order in which they were shown.

    Raises
    ------
    ValueError
        There are too few states, or something changed that a job's time series cannot change.
    """
    steps = _limited_times(kept)
    if len(steps) < FEWEST:
        raise ValueError(f"a course has at least {FEWEST} different times; move a knob while recording")
    first = steps[0][1]
    if any(step.time is not None for _, step in steps):
        raise ValueError("a course of the job was shown; it is in the job's own file")
    if bench.design is not None and any(name in bench.design.knobs for _, step in steps for name in step.knobs):
        raise ValueError("a course holds motions and temperatures, not another design; save the camera instead")
    if any(step.pivots != first.pivots for _, step in steps):
        raise ValueError(
            "a course rotates each body about one pivot at all times; record again without changing pivots"
        )
    knobs = bench.knobs
    fixed, moving = _split([dict(step.knobs) for _, step in steps], knobs)
    resolved = bench.twin.resolved.with_render(first.frames, bench.seed_of(first.seed))
    plain = resolved.plain()
    job = plain["job"]
    job["perturb"] = perturbation(fixed, first.pivots, knobs, job.get("perturb", {}))
    job["course"] = {"times": [f"{time!r} s" for time, _ in steps], **_courses(moving, first.pivots, knobs, len(steps))}
    validate(JobSpec, YamlFile("", job, {}))
    return _head() + dump_yaml(plain)


def _limited_times(kept: Sequence[tuple[float, AskedState]]) -> list[tuple[float, AskedState]]:
    """Return states at ascending times in milliseconds, at most as many as a job's time series may have.

    The first and the last state are among them.
    """
    out: list[tuple[float, AskedState]] = []
    for seconds, state in kept:
        rounded = round(seconds, 3)
        if out and rounded <= out[-1][0]:
            out[-1] = (out[-1][0], state)
        else:
            out.append((rounded, state))
    if len(out) <= MOST:
        return out
    chosen = sorted({round(k * (len(out) - 1) / (MOST - 1)) for k in range(MOST)})
    return [out[k] for k in chosen]


def _split(
    states: Sequence[Mapping[str, float]], knobs: Mapping[str, Knob]
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Separate knobs that change over the recorded states from constant ones.

    Returns
    -------
    tuple of dict
        Constant knob -> its value, and changing knob -> its values at each time.

    Raises
    ------
    ValueError
        The figure of a surface changes, which a job's time series cannot contain.
    """
    names = dict.fromkeys(name for state in states for name in state)
    moving = {}
    fixed = {}
    for name in names:
        values = [state.get(name, 0.0) for state in states]
        if all(a == b for a, b in pairwise(values)):
            fixed[name] = values[0]
        elif knobs[name].kind == "figure":
            raise ValueError(f"{name}: a course holds motions and temperatures, not figures; save the job instead")
        else:
            moving[name] = values
    if not moving:
        raise ValueError("nothing moved while recording; save the job instead")
    # a body's constant motion belongs to its course, too
    bodies = {(knobs[name].node, knobs[name].kind) for name in moving}
    for name in list(fixed):
        if (knobs[name].node, knobs[name].kind) in bodies:
            moving[name] = [fixed.pop(name)] * len(states)
    return fixed, moving


def _courses(
    moving: Mapping[str, Sequence[float]], pivots: Mapping[str, str], knobs: Mapping[str, Knob], count: int
) -> dict[str, Any]:
    """Return the entries ``temperature`` and ``motion`` of a job's time series (``course``) for changing knobs."""
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for name in moving:
        knob = knobs[name]
        heat = knob.kind in ("temperature", "gradient")
        key = {"temperature": "change"}.get(knob.kind, knob.kind)
        body = out.setdefault("temperature" if heat else "motion", {}).setdefault(knob.node, {})
        if key in body:
            continue
        axes = AXES if knob.kind in ("rotate", "shift", "gradient") else ("",)
        columns = [moving.get(f"{knob.node} {knob.kind} {axis}".strip(), [0.0] * count) for axis in axes]
        rows = [[f"{value!r} {knob.unit}" for value in row] for row in zip(*columns, strict=True)]
        body[key] = rows if len(axes) > 1 else [row[0] for row in rows]
        if not heat and pivots.get(knob.node, DEFAULT_PIVOT) != DEFAULT_PIVOT:
            body["pivot"] = pivots[knob.node]
    return out
