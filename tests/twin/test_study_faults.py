"""What physics forbids is a run that failed; a fault of the program stops the study, and says where it is."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

import twin.study.__main__ as command
from analysis.arrays import MeasurementError
from optics.numerics.array_math import PhysicalError
from scenes.specs.procedures import Procedure
from tests.twin.commands import invoke
from tests.twin.study_bench import write_study
from twin.framework import cluster
from twin.framework.cli import Incomplete
from twin.sensors.area_detector import EmvaDetector
from twin.study.runs.base_job import BlockResult, Failure, ProcedureBase, Run
from twin.study.runs.blocks import Engine, Pilot, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study


class Here(cluster.Workers):
    """Workers in this process: a task is done at once."""

    count = 1

    def __init__(self) -> None:
        super().__init__(None, True)

    def submit(self, work, argument):
        future = SimpleNamespace(key=object(), status="finished", result=None, exception=None, traceback=None)
        try:
            result = work(argument)
            future.result = lambda: result
        except Exception as error:
            caught = error
            future.status, future.exception, future.traceback = "error", lambda: caught, lambda: caught.__traceback__
        self._finished.put(future)
        return future


@pytest.mark.second
def test_a_wrong_shape_in_the_detector_stops_the_study(tmp_path, monkeypatch) -> None:
    """Once a block is stored: what was done before is kept, the message says in which runs, the trace where."""
    plan = Plan.of(resolve_study(write_study(tmp_path / "in")))
    right, file = EmvaDetector.expose, tmp_path / "blocks.journal"
    with journal_of(plan.setup, file) as journal:

        def expose(self, photons, *args, **kwargs):
            return right(self, photons[..., :-1] if journal.known else photons, *args, **kwargs)

        monkeypatch.setattr(EmvaDetector, "expose", expose)
        with pytest.raises(Incomplete, match=r"^the program failed: ValueError: .* in runs \d+ to \d+$") as caught:
            Engine(plan, journal).run(Here())
        kept = {*journal.known}
    assert "Traceback" in caught.value.trace
    assert "area_detector.py" in caught.value.trace
    assert 1 <= len(kept) < plan.blocks
    monkeypatch.setattr(EmvaDetector, "expose", right)
    with journal_of(plan.setup, file) as again:
        assert {*again.known} == kept
        engine = Engine(plan, again)
        engine.run(Here())
    assert not engine.result().failed.any()


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

    base = ProcedureBase(Procedure("toy", Toy, None, None, None))
    assert base.block == 1  # a slow run is kept as soon as it is there
    for what in ("lost", "unmeasured"):
        assert base.evaluate({"what": what}, [Run(0, (), None)], None) == [Failure("no light")]
    with pytest.raises(fault, match="no light"):
        base.evaluate({"what": "fault"}, [Run(0, (), None)], None)


@pytest.mark.second
def test_a_study_all_of_whose_runs_failed_ends_with_1(tmp_path) -> None:
    file = write_study(
        tmp_path / "in", ("runs: 100", "runs: 4"), ("normal: {mean: 0 um, sigma: 1 um}", "values: [3 mm]")
    )
    said = invoke(command.app, file, "--out", tmp_path / "run", "--workers", 1)
    assert said.exit_code == 1
    assert "all 4 runs failed, see report.html; all else is in" in said.stderr
    assert (tmp_path / "run" / "study.nc").exists()


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

        monkeypatch.setattr("twin.study.runs.blocks.pilot", lambda _: done(pilot))
        monkeypatch.setattr("twin.study.runs.blocks.evaluate", lambda _: done(evaluate))
        told: list[str] = []
        return Engine(plan, journal_of(plan.setup, None), warn=told.append), told

    for pilot, text in (
        (dead, "the workers died in the first block, runs 0-24"),
        (ValueError("x"), "the program failed: ValueError: x"),
    ):
        with pytest.raises(Incomplete, match=text):
            begun(pilot)[0].run(Here())
    engine, told = begun(Pilot(lost, None, 0.0, 1e12), lost)
    engine.run(Here())
    assert told[0] == "all runs of the first block fail: no light"
    assert told[1].startswith("the processes need about 1000.0 GB, more than the study's")
    assert len(told) == 2
    engine, told = begun(Pilot(lost, None, 0.0, 1e6), dead)
    with pytest.raises(Incomplete, match=r"not computed: runs 25-49, 50-74 \(the workers died\)"):
        engine.run(Here())
    assert len(told) == 1


def test_options_that_do_not_go_together_are_refused(tmp_path, monkeypatch) -> None:
    said = invoke(command.app, tmp_path / "study.yaml", "--workers", 2, "--scheduler", "tcp://127.0.0.1:1")
    assert said.exit_code == 2
    assert "--workers and --scheduler exclude each other" in " ".join(said.stderr.split())
    small = resolve_study(write_study(tmp_path / "in", ("seed: 3}", "seed: 3}\nlimits: {memory: 1 GB}")))
    monkeypatch.setattr(cluster, "local_workers", lambda count: nullcontext(SimpleNamespace(warnings=[], count=count)))
    told = []
    for workers in (8, 1):
        with cluster.chosen_workers(workers, None, told.append, small.study.limits) as found:
            assert found.count == min(workers, 2)
    assert told == ["2 workers instead of 8: no more fit into the memory of its limits, 1 GB"]
