"""What physics forbids is a run that failed; a fault of the program stops the study, and says where it is."""

from types import SimpleNamespace

import numpy as np
import pytest

import twin.study.__main__ as command
from analysis.arrays import MeasurementError
from optics.numerics.array_math import PhysicalError
from scenes.specs.procedures import Procedure
from tests.twin.commands import invoke
from tests.twin.study_bench import write_study
from twin.sensors.area_detector import EmvaDetector
from twin.study import study_command
from twin.study.runs.base_job import BlockResult, Failure, ProcedureBase, Run
from twin.study.runs.chunk_store import ChunkStore
from twin.study.runs.engine import Engine, IncompleteError, ProgramFault, Progress
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study
from twin.study.runs.task import Pilot
from twin.study.study_command import StudyRun


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
    assert base.block == 1  # a slow run is kept as soon as it is there
    for what in ("lost", "unmeasured"):
        assert base.evaluate({"what": what}, [Run(0, (), None)], None) == [Failure("no light")]
    with pytest.raises(fault, match="no light"):
        base.evaluate({"what": "fault"}, [Run(0, (), None)], None)


def test_a_study_all_of_whose_runs_failed_ends_with_1(tmp_path, monkeypatch) -> None:
    for failed, code in ((99, 0), (100, 1)):
        numbers = {"name": "study", "runs": 100, "failed": failed, "responses": {}}
        done = StudyRun(numbers, "Nothing.", tmp_path / "run")
        monkeypatch.setattr(study_command, "run_study", lambda *_, done=done: done)
        said = invoke(command.app, tmp_path / "study.yaml")
        assert said.exit_code == code
        assert ("all 100 runs failed" in said.stderr) == bool(code)


def test_what_workers_make_of_a_study_is_told(tmp_path, monkeypatch) -> None:
    """Workers that die, a pilot that fails, a first block without a good run, and processes that need much memory."""
    from distributed.scheduler import KilledWorker

    plan = Plan.of(resolve_study(write_study(tmp_path / "in", ("runs: 100", "runs: 75"))))
    dead = KilledWorker("task", SimpleNamespace(address="here"), 3)
    lost = BlockResult.of([Failure("no light")] * 25, plan.setup.study.responses)

    def begun(pilot: object, evaluate: object = None) -> tuple[Engine, list[str]]:
        def done(what: object) -> object:
            if isinstance(what, Exception):
                raise what
            return what

        monkeypatch.setattr("twin.study.runs.task.pilot", lambda _: done(pilot))
        monkeypatch.setattr("twin.study.runs.task.evaluate", lambda _: done(evaluate))
        told: list[str] = []
        store = ChunkStore(tmp_path / f"store{len(list(tmp_path.iterdir()))}", plan)
        store.folder.parent.mkdir()
        store.open()
        return Engine(plan, store, progress=Progress(warn=told.append), chunk_blocks=1), told

    for pilot, error, text in (
        (dead, IncompleteError, "the workers died in the first block, runs 0-24"),
        (ValueError("x"), ProgramFault, "the program failed: ValueError: x"),
    ):
        with pytest.raises(error, match=text):
            begun(pilot)[0].run(Here())
    engine, told = begun(Pilot(lost, None, 0.0, 1e12), [lost])
    engine.run(Here())
    assert told[0] == "all runs of the first block fail: no light"
    assert told[1].startswith("the processes need about 1000.0 GB, more than the study's")
    assert len(told) == 2
    engine, told = begun(Pilot(lost, None, 0.0, 1e6), dead)
    with pytest.raises(IncompleteError, match=r"not computed: runs 25-49, 50-74 \(the workers died\)"):
        engine.run(Here())
    assert len(told) == 1


def test_options_that_do_not_go_together_are_refused(tmp_path) -> None:
    file = tmp_path / "study.yaml"
    for words, told in (
        (("--resume", "--force", "--out", tmp_path / "x"), "choose one of them"),
        (("--resume",), "--resume needs the folder to go on with"),
        (("--workers", 2, "--scheduler", "tcp://127.0.0.1:1"), "--workers and --scheduler exclude each other"),
    ):
        said = invoke(command.app, file, *words)
        assert (said.exit_code, told in " ".join(said.stderr.split())) == (2, True), said.stderr
    small = resolve_study(write_study(tmp_path / "in", ("seed: 3}", "seed: 3}\nlimits: {memory: 1 GB}")))
    told = []
    for workers in (8, 1):
        with study_command._workers(study_command.StudyOptions(workers=workers), small, told.append):
            pass
    assert told == ["2 workers instead of 8: no more fit into the study's 1 GB"]
