"""A test of one's own, from outside: what it takes to make a command and a base of studies of it."""

import io
import json
import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from rich.console import Console

from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera import CameraSpec
from scenes.specs.load import load_camera
from scenes.specs.procedures import PROCEDURES, Procedure
from scenes.specs.resolved import ExperimentSetup
from scenes.yaml.spec import Name, Number, Seed, Spec, Whole
from tests.twin.commands import files, invoke
from tests.twin.test_blurred_cameras import gf7_with
from twin.framework import cli, record
from twin.framework.artefact import PngFigure, SvgFigure, Table
from twin.framework.cli import heartbeat
from twin.framework.command import add_tests, progress_shown
from twin.framework.procedure import Advance, BenchError
from twin.framework.record import plain_data
from twin.framework.report import Report, Section, answer
from twin.study.runs.base_job import Failure, ProcedureBase, Run

FILE = "name: levels\nreadings: 5\nsigma_arcsec: 0.5\nseed: 3\n"
MOST = 100


class LevelSpec(Spec):
    name: Name
    readings: Whole
    sigma_arcsec: Number
    seed: Seed = 1


class LevelSetup(ExperimentSetup[LevelSpec]):
    pass


@dataclass(frozen=True)
class LevelRun:
    setup: LevelSetup
    seed: int
    backend: str
    readings: np.ndarray


@dataclass(frozen=True)
class LevelNumbers:
    seed: int
    mean_arcsec: float
    mean_arcsec_sigma: float
    readings_arcsec: np.ndarray


def measure(setup: LevelSetup, backend: Backend, seed: int, advance: Advance) -> LevelRun:
    test = setup.test
    if test.readings > MOST:
        raise BenchError("the memory of the level is full", ("readings",), f"{MOST} or fewer")
    advance("read", test.readings, test.readings)
    readings = np.random.default_rng(seed).normal(0.0, test.sigma_arcsec, test.readings)
    return LevelRun(setup, seed, backend.name, readings)


def numbers(run: LevelRun) -> dict:
    scatter = float(np.std(run.readings, ddof=1))
    return plain_data(LevelNumbers(run.seed, np.mean(run.readings), scatter / len(run.readings) ** 0.5, run.readings))


def report(run: LevelRun) -> Report:
    rows = [(k, float(v)) for k, v in enumerate(run.readings)]
    figure = SvgFigure("scatter", "Scatter", "All readings.", "<svg></svg>")
    return Report(
        title="Level",
        verdict=f"{len(rows)} readings.",
        lead=(),
        facts=(("sigma", f"{run.setup.test.sigma_arcsec} arcsec"),),
        summary=Table("readings", "Readings", "", ("number", "arcsec"), rows),
        sections=(Section("Readings", (), (figure,)),),
        images={"level": np.zeros((1, 4, 4), np.uint16)},
        warnings=("a toy",),
    )


SHOWN = Table("readings", "Readings", "", ("number",), [])


@pytest.mark.parametrize("verdict", ["", "No full stop", "One sentence. And another. And more.", "Is it? No. Yes."])
def test_a_verdict_is_two_sentences_at_most(verdict: str) -> None:
    with pytest.raises(ValueError, match="a verdict must be one or two sentences"):
        Report("Level", verdict, (), (), SHOWN, ())


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: SvgFigure("A b", "A", "B", "<svg></svg>"), "only small letters"),
        (lambda: SvgFigure("a", "A", "B", "<p>"), "not an <svg>"),
        (lambda: PngFigure("a", "A", "B", b"GIF"), "not a PNG"),
        (lambda: Table("a", "A", "B", ("x", "y"), [(1,)]), "a row of 1 cells under 2 heads"),
        (lambda: Report("Level", "It holds.", (), (), SHOWN, (Section("A", (), (SHOWN,)),)), "has the name readings"),
    ],
)
def test_what_is_no_artefact_is_refused(make: Callable[[], object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()


def test_numbers_have_no_verdict_but_the_reports() -> None:
    told = Report("Level", "It holds.", (), (), SHOWN, ())
    expected = {"a": 1, "verdict": "It holds.", "warnings": []}
    assert told.with_verdict({"a": 1, "verdict": "It holds."}) == told.with_verdict({"a": 1}) == expected
    with pytest.raises(ValueError, match="verdict"):
        told.with_verdict({"verdict": {"before": False}})


def test_statements_become_a_verdict_and_what_follows_it() -> None:
    assert answer("Heights err by 3 m.", "", "the rest is 0.5 m") == ("Heights err by 3 m. The rest is 0.5 m.", ())
    assert answer("it is", "MTF falls", "Δα is read", "base/forward moves") == (
        "It is. MTF falls.",
        ("Δα is read.", "base/forward moves."),
    )


LEVEL = Procedure("level", LevelSetup, measure, numbers, report, about="Read a level.", varied=True)


def program(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> typer.Typer:
    """Return a program with the test as its command, but for what is changed."""
    frames = {**record.FRAMES, "level": {"readings_arcsec": "about the level's own axis"}}
    monkeypatch.setattr(record, "FRAMES", FrozenMap(frames))
    monkeypatch.setitem(PROCEDURES, "bench level", replace(LEVEL, **changes))
    app = typer.Typer()
    app.callback()(lambda: None)
    add_tests(app, "bench")
    return app


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable:
    return partial(invoke, program(monkeypatch, run=lambda *given: LEVEL.run(*given)))


@pytest.mark.second
def test_progress_is_told_where_there_is_no_terminal(run: Callable, tmp_path: Path, monkeypatch) -> None:
    """Also while one part of the work takes long."""
    monkeypatch.setattr(cli, "TICK_SECONDS", 0.05)
    path = tmp_path / "level.yaml"
    path.write_text(FILE, "utf-8")
    measured = LEVEL.run

    def read(*given: Any) -> Any:
        for done in (0, 2):
            given[3]("read", done, 5)
            time.sleep(0.35)
        return measured(*given)

    slow = replace(LEVEL, run=read)
    monkeypatch.setattr(sys.modules[__name__], "LEVEL", slow)
    said = run("level", path, "--out", tmp_path / "run").stderr.splitlines()
    assert len(said) >= 3
    for line in said:
        assert re.fullmatch(r"progress: (start|write.*|read: \d of 5), \d+ s so far(, about \d+ s left)?", line), line
    assert "progress: read: 2 of 5, 0 s so far, about 1 s left" in said
    for option in ("--quiet", "--json"):
        assert run("level", path, "--out", tmp_path / option.strip("-"), option).stderr == ""


@pytest.mark.parametrize("silent", [False, True])
def test_work_that_takes_long_says_so_once_by_its_first_pieces(silent: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part that begins again, of a second course for instance, has its own time."""
    now = [100.0]
    monkeypatch.setattr(cli, "time", SimpleNamespace(monotonic=lambda: now[0]))
    said = io.StringIO()
    with progress_shown(Console(file=said), silent) as advance:
        for part, first, total in (("passes", 20, 120), ("fit", 0, 10)):
            for done in range(first, first + 5):
                advance(part, done, total)
                now[0] += 4.0
        for done in (1, 2, 25, 1, 2):
            advance("ground", done, 25)
            now[0] += 6.0 if done < 25 else 600.0
    assert said.getvalue() == ("" if silent else "note: passes: about 7 min left\n")


@pytest.mark.second
def test_a_terminal_shows_progress_itself() -> None:
    shown = io.StringIO()
    with heartbeat(Console(file=shown, force_terminal=True), lambda: "far", False, 0.02):
        time.sleep(0.1)
    assert shown.getvalue() == ""
    with heartbeat(Console(file=shown), lambda: "far", False, 0.02):
        time.sleep(0.1)
    assert set(shown.getvalue().splitlines()) == {"progress: far"}


@pytest.mark.second
def test_command(run: Callable, tmp_path: Path) -> None:
    """What a test of one's own gives: --json, files, and the same again from its config.yaml."""
    path = tmp_path / "level.yaml"
    path.write_text(FILE, "utf-8")
    done = run("level", path, "--out", tmp_path / "run", "--seed", 7, "--json")
    assert done.exit_code == 0, done.stderr
    data = json.loads((tmp_path / "run" / "level.json").read_text("utf-8"))
    assert json.loads(done.stdout) == data
    assert data["seed"] == 7
    assert data["readings_arcsec"] == np.random.default_rng(7).normal(0.0, 0.5, 5).tolist()
    assert {"artefacts/readings.csv", "artefacts/scatter.svg", "images/level.tiff"} <= files(tmp_path / "run")
    again = run("level", tmp_path / "run" / "config.yaml", "--out", tmp_path / "again", "--quiet")
    assert again.exit_code == 0, again.stderr
    assert (tmp_path / "again" / "level.json").read_bytes() == (tmp_path / "run" / "level.json").read_bytes()


def test_what_fails_on_the_bench_is_told_at_the_line_of_the_file(run: Callable, tmp_path: Path) -> None:
    path = tmp_path / "level.yaml"
    path.write_text(FILE.replace("readings: 5", "readings: 500"), "utf-8")
    done = run("level", path, "--out", tmp_path / "run")
    assert done.exit_code == 2
    assert f"{path}:2: readings" in done.stderr
    assert "100 or fewer" in done.stderr
    assert files(tmp_path) == {"level.yaml"}


def test_a_blurred_camera_is_told_wherever_a_test_has_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In the terminal, the manifest and the report; beside the error where the test fails; in a study not at all."""
    camera = load_camera(gf7_with(tmp_path, "-2.02 m"))

    class FocusedSetup(ExperimentSetup[LevelSpec]):
        camera: CameraSpec

        @classmethod
        def parts(cls, test: LevelSpec) -> dict[str, Any]:
            return {"camera": camera}

    app = program(monkeypatch, setup=FocusedSetup)
    path, out = tmp_path / "level.yaml", tmp_path / "run"
    path.write_text(FILE, "utf-8")
    done = invoke(app, "level", path, "--out", out)
    assert done.exit_code == 0, done.stderr
    told = json.loads((out / "manifest.json").read_text("utf-8"))["warnings"]
    assert len(told) == 2
    assert "is blurred as designed: its wavefront error is 6.85 waves rms" in told[0]
    assert told[1] == "a toy"
    assert f"warning: {told[0]}" in done.stdout
    assert "is blurred as designed: its wavefront error is 6.85 waves rms" in (out / "report.html").read_text("utf-8")
    path.write_text(FILE.replace("readings: 5", "readings: 500"), "utf-8")
    failed = invoke(app, "level", path, "--out", tmp_path / "none")
    assert failed.exit_code == 2
    text = " ".join(failed.stderr.split())
    assert "the memory of the level is full" in text
    assert "is blurred as designed: its wavefront error is 6.85 waves rms" in text


def test_base_of_studies(backend: Backend, tmp_path: Path) -> None:
    """Numbers without frames, of the base's seed or the run's own; a run that fails says why and leaves the others."""
    path = tmp_path / "level.yaml"
    path.write_text(FILE, "utf-8")
    base = ProcedureBase(LEVEL)
    tree = base.resolve(path).plain()
    readings = ("test", "readings")
    runs = (Run(0, (), None), Run(1, (), 4), Run(2, ((readings, 500),), None))
    first, second, third = base.evaluate(tree, runs, backend)
    assert set(first) == {"level"}
    assert first["level"] == numbers(measure(base.resolve(path), backend, 3, lambda *_: None))
    assert second["level"]["seed"] == 4
    assert third == Failure("the memory of the level is full")


def test_a_report_that_cannot_be_made_costs_no_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are written, with a note where the report would be; exit code and manifest say so."""

    def fail(run: object) -> Report:
        raise RuntimeError("no such\nfont")

    app = program(monkeypatch, report=fail)
    path, out = tmp_path / "level.yaml", tmp_path / "run"
    path.write_text(FILE, "utf-8")
    done = invoke(app, "level", path, "--out", out)
    assert done.exit_code == 1
    assert "Traceback" in done.stderr
    assert f"error: the report could not be made; everything else is in {out}" in " ".join(done.stderr.split())
    assert len(json.loads((out / "level.json").read_text("utf-8"))["readings_arcsec"]) == 5
    told = "the report could not be made: RuntimeError: no such font"
    assert told in json.loads((out / "manifest.json").read_text("utf-8"))["warnings"]
    assert told in (out / "report.html").read_text("utf-8")


def test_remaining_time_never_grows(monkeypatch) -> None:
    """Work that becomes ten times slower stays at its shortest estimate, and another part begins anew."""
    clock = [0.0]
    monkeypatch.setattr(cli.time, "monotonic", lambda: clock[0])
    state, left = cli.WorkProgress(), []
    for done, now in ((0, 0.0), (1, 1.0), (2, 2.0), (3, 12.0), (4, 22.0), (9, 23.0)):
        clock[0] = now
        state.advance("trace", done, 10)
        left.append(state.left)
    assert left[1:] == sorted(left[1:], reverse=True)
    assert left[2] == left[3] == 8.0
    state.advance("write", 0, 2)
    clock[0] += 60.0
    state.advance("write", 1, 2)
    assert state.left == 60.0
