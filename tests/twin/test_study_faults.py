"""What physics forbids is a run that failed; a fault of the program stops the study, and says where it is."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import twin.study.__main__ as command
from analysis.measurement_error import MeasurementError
from optics.numerics.physical_error import PhysicalError
from scenes.specs.procedures import Procedure
from tests.twin.commands import invoke
from tests.twin.study_bench import ROOT, wait_for, write_study
from twin.sensors.area_detector import EmvaDetector
from twin.study import study_command
from twin.study.runs.base_job import Failure, ProcedureBase, Run
from twin.study.runs.chunk_store import ChunkStore
from twin.study.runs.engine import Engine, ProgramFault
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study
from twin.study.study_command import StudyRun

OF_OTHERS = {
    *("BackendUnavailable", "LibraryMissing", "VariantUnavailable", "ImageError", "_Wrong"),
    *("InputError", "Problem"),
}
"""Errors of what is installed and of what is read."""


class Here:
    """Workers in this process: a task is done at once."""

    count = 1

    def __init__(self) -> None:
        self._done: list[SimpleNamespace] = []

    def submit(self, work, argument):
        future = SimpleNamespace(key=object(), status="finished", result=None, exception=None, traceback=None)
        try:
            result = work(argument)
            future.result = lambda: result
        except Exception as error:
            caught = error
            future.status, future.exception, future.traceback = "error", lambda: caught, lambda: caught.__traceback__
        self._done.append(future)
        return future

    def next_finished(self, tick=None):
        return self._done.pop(0)


@pytest.mark.second
def test_a_wrong_shape_in_the_detector_stops_the_study(tmp_path, monkeypatch) -> None:
    """Once a block is stored: what was done before is kept, the message says in which runs, the trace where."""
    plan = Plan.of(resolve_study(write_study(tmp_path / "in")))
    store = ChunkStore(tmp_path, plan)
    store.open()
    right = EmvaDetector.expose

    def expose(self, photons, *args, **kwargs):
        return right(self, photons[..., :-1] if store.entries else photons, *args, **kwargs)

    monkeypatch.setattr(EmvaDetector, "expose", expose)
    with pytest.raises(ProgramFault, match=r"^the program failed: ValueError: .* in runs \d+ to \d+$") as caught:
        Engine(plan, store, chunk_blocks=1).run(Here())
    assert "Traceback" in caught.value.trace
    assert "area_detector.py" in caught.value.trace
    assert 1 <= len(store.entries) < plan.blocks
    again = ChunkStore(tmp_path, plan)
    again.open()
    assert again.runs == store.runs > 0
    monkeypatch.setattr(EmvaDetector, "expose", right)
    Engine(plan, again, chunk_blocks=1).run(Here())
    assert not again.result().failed.any()


@pytest.mark.parametrize("fault", [ValueError, ZeroDivisionError, np.linalg.LinAlgError, FloatingPointError, KeyError])
def test_only_named_errors_are_failures(fault) -> None:
    class Toy:
        @classmethod
        def model_validate(cls, data):
            raise {"fault": fault, "lost": NamedLoss, "unmeasured": NamedMeasurement}[data["what"]]("no light")

    class NamedLoss(PhysicalError, RuntimeError):
        pass

    class NamedMeasurement(MeasurementError, ValueError):
        pass

    base = ProcedureBase(Procedure("toy", Toy, None, None, None, None))
    for what in ("lost", "unmeasured"):
        assert base.evaluate({"what": what}, [Run(0, (), None)], None) == [Failure("no light")]
    with pytest.raises(fault, match="no light"):
        base.evaluate({"what": "fault"}, [Run(0, (), None)], None)


def test_every_error_of_optics_and_analysis_says_whether_it_is_one_of_physics() -> None:
    """A new class of error that is not derived from one of both would stop studies."""
    bases: dict[str, set[str]] = {}
    for package in ("optics", "analysis", "scenes", "twin/monitor", "twin/targets", "twin/path_tracing"):
        for path in (ROOT / package).rglob("*.py"):
            for name, above in re.findall(r"^class (\w+)\((.+)\):", path.read_text("utf-8"), re.M):
                bases.setdefault(name, set()).update(word.strip() for word in above.split(","))

    def above(name: str) -> set[str]:
        return {name}.union(*(above(base) for base in bases.get(name, ())))

    found = {name for name in bases if above(name) & {"Exception", "ValueError", "RuntimeError", "ImportError"}}
    physical = {name for name in found if above(name) & {"PhysicalError", "MeasurementError"}}
    assert found - physical == OF_OTHERS
    assert {"AimError", "MisplacedError", "SpotError", "RankError", "TargetLostError", "NominalPathLost"} <= physical


def test_a_study_all_of_whose_runs_failed_ends_with_1(tmp_path, monkeypatch) -> None:
    for failed, code in ((99, 0), (100, 1)):
        numbers = {"name": "study", "runs": 100, "failed": failed, "responses": {}}
        done = StudyRun(numbers, "Nothing.", tmp_path / "run")
        monkeypatch.setattr(study_command, "run_study", lambda *_, done=done: done)
        said = invoke(command.app, tmp_path / "study.yaml")
        assert said.exit_code == code
        assert ("all 100 runs failed" in said.stderr) == bool(code)


@pytest.fixture(scope="module")
def faulty(tmp_path_factory) -> Path:
    """The program, with frames that lose a row in its detector."""
    root = tmp_path_factory.mktemp("faulty")
    for package in ("optics", "scenes", "twin", "analysis"):
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__"))
    place = root / "twin/sensors/area_detector.py"
    text, line = place.read_text("utf-8"), "        lead, (height, width) = light.shape[:-2], light.shape[-2:]\n"
    assert text.count(line) == 1
    place.write_text(text.replace(line, f"{line}        height = height - 1\n"), "utf-8")
    return root


def begin(root: Path, *words: object) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(root)}
    return subprocess.Popen(
        [sys.executable, *map(str, words)],
        cwd=root,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("scheduler", [False, True])
def test_a_fault_in_the_source(faulty, tmp_path, scheduler) -> None:
    """In processes of its own and on a cluster."""
    path = write_study(tmp_path / "in")
    others, where = [], ["--workers", "2"]
    if scheduler:
        place = tmp_path / "scheduler.json"
        tool = ["--scheduler-file", place]
        others.append(begin(faulty, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", *tool))
        wait_for(place.exists)
        others.append(begin(faulty, "-m", "distributed.cli.dask_worker", *tool, "--nthreads", "1"))
        import json

        wait_for(lambda: place.read_text("utf-8").strip() != "")
        where = ["--scheduler", json.loads(place.read_text("utf-8"))["address"]]
    try:
        study = begin(faulty, "-m", "twin.study", path, "--out", tmp_path / "run", *where)
        _, said = study.communicate(timeout=120)
    finally:
        for one in others:
            one.kill()
            one.communicate()
    assert study.returncode == 1, said
    assert "Traceback" in said
    assert "area_detector.py" in said or "analysis" in said
    assert "the program failed: ValueError" in said
    assert not (tmp_path / "run" / "manifest.json").exists()


@pytest.mark.slow
def test_all_runs_fail(tmp_path) -> None:
    """Mirrors far off: everything is written, and the exit code says that nothing came of it."""
    path = write_study(
        tmp_path / "in", ("mean: 0 um, sigma: 1 um", "mean: 90 mm, sigma: 1 um"), ("runs: 100", "runs: 25")
    )
    study = begin(ROOT, "-m", "twin.study", path, "--out", tmp_path / "run", "--workers", "1")
    _, said = study.communicate(timeout=120)
    assert study.returncode == 1, said
    assert "all 25 runs failed" in said
    assert (tmp_path / "run" / "manifest.json").exists()
