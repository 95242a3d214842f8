"""Answers of the computing process to the server's questions, as bytes and plain data."""

from __future__ import annotations

import json
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scenes.yaml.errors import InputError
from twin.live.camera_pictures import CameraPictures
from twin.live.live_bench import LOST, LiveBench
from twin.live.messages import AskedState, AskedView, BlindState, Opened, packed
from twin.live.recording import course_text, job_text
from twin.live.source import read_source
from twin.pictures.scene_file import write_scene
from twin.scripting.instrument_twin import InstrumentTwin

KEPT = 3
"""Instruments of a study that stay built."""


class Answers:
    """An instrument that is ready to answer.

    Args:
        what: as of `twin.live.source.read_source`.
        backend: where to trace.
        advance: told of each part of the preparation.
        run: of a study, as of `twin.live.source.read_source`.

    Raises:
        InputError, BackendUnavailable, LibraryMissing: it cannot be built.
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

        Raises:
            InputError: they cannot be.
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
                    {**knob.plain(), "now": factors.get(knob.name, knob.value)} for knob in self.source.factors
                ],
            }
            with tempfile.TemporaryDirectory() as folder:
                place = Path(folder) / "scene.glb"
                write_scene(bench.twin.experiment, {}, place)
                scene = place.read_bytes()
            self._built[key] = bench, CameraPictures(bench.twin.experiment), Opened(greeting, scene)
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
                asked.view,
                asked.camera,
                asked.field,
                state,
                asked.state.frames,
                self.bench.seed_of(asked.state.seed),
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
