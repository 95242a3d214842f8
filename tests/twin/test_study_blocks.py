"""What is kept of a study while it runs, which program may go on with it, and what failures and faults make of it."""

import hashlib
import json
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import twin.framework.provenance
import twin.study.__main__ as command
from analysis.arrays import MeasurementError
from optics.numerics.array_math import PhysicalError
from scenes.specs.procedures import Procedure
from tests.twin.commands import invoke
from tests.twin.study_bench import write_study
from twin.framework import cluster
from twin.framework.cli import Incomplete
from twin.framework.provenance import source_digest, sources
from twin.framework.run_folder import RunFolderError
from twin.sensors.area_detector import EmvaDetector
from twin.study.runs.base_job import BlockResult, Failure, ProcedureBase, Run
from twin.study.runs.blocks import BLOCKS, Engine, OtherProgramError, Pilot, Task, evaluate, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup, resolve_study

run = partial(invoke, command.app)


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> StudySetup:
    return resolve_study(write_study(tmp_path_factory.mktemp("in")))


def block(plan: Plan, number: int) -> BlockResult:
    runs = np.array(plan.block(number), float)
    values = np.stack([runs, -runs], axis=1)
    return BlockResult(values, values, values, ("",) * len(runs), 0.5, ("",) * len(runs))


@pytest.fixture
def kept(setup, tmp_path) -> Path:
    """The journal of a study of four blocks."""
    plan, file = Plan.of(setup), tmp_path / BLOCKS
    with journal_of(setup, file) as journal:
        for number in range(plan.blocks):
            journal.keep({str(number): block(plan, number)})
    return file


def opened(setup: StudySetup, file: Path) -> tuple[list[int], list[str]]:
    """Return the blocks that are missing, and what is told of the journal."""
    told: list[str] = []
    with journal_of(setup, file) as journal:
        return Engine(Plan.of(setup), journal, warn=told.append).missing, told


def test_what_is_kept_is_read(setup, kept) -> None:
    with journal_of(setup, kept) as journal:
        result = Engine(Plan.of(setup), journal).result()
    np.testing.assert_array_equal(result.values[:, 0], np.arange(100.0))
    with kept.open("ab") as file:
        file.write(b'0123456789abcdef {"of": "5')  # the power failed
    assert opened(setup, kept) == ([], [])


def doctored(part: str, value: object) -> bytes:
    """A line with its right checksum and a block that no program writes."""
    number = {"array": "float64", "shape": [25, 2], "data": "AAAA" * 133 + "AA=="}
    block = {"values": number, "sigmas": number, "noises": number, "messages": [""] * 25, "doubts": [""] * 25}
    text = json.dumps({"of": "1", "is": {"class": "BlockResult", "with": block | {"seconds": 0.5, part: value}}})
    return hashlib.sha256(text.encode()).hexdigest()[:16].encode() + b" " + text.encode()


@pytest.mark.parametrize(
    "line",
    [
        *(b"", b"[]", b"null", b"\xff\xfe", b"[" * 100_000),
        doctored("values", 1.0),
        doctored("values", {"array": "float64", "shape": [25, 3], "data": "AAAA"}),
        doctored("sigmas", {"array": "object", "shape": [1], "data": "AAAAAAAAAAA="}),
        doctored("noises", {"array": "float64", "shape": [1, 1], "data": "AAAAAAAAAAA="}),
        doctored("messages", [0] * 25),
        doctored("doubts", ["x"]),
        doctored("more", 1),
    ],
)
def test_a_doctored_line_is_computed_again(setup, kept, line) -> None:
    lines = kept.read_bytes().split(b"\n")
    lines[2] = line
    kept.write_bytes(b"\n".join(lines))
    assert opened(setup, kept)[0] == [1]


def test_a_damaged_line_is_told_and_a_damaged_head_refused(setup, kept) -> None:
    lines = kept.read_bytes().split(b"\n")
    kept.write_bytes(b"\n".join([lines[0], lines[1][:-9], *lines[2:]]))
    missing, (told,) = opened(setup, kept)
    assert missing == [0]
    assert told.endswith("1 line of it is corrupt; what it held is computed again")
    kept.write_bytes(b"\n".join([lines[0][:-9], *lines[1:]]))
    with pytest.raises(RunFolderError, match="cannot be read; start again without --resume"):
        opened(setup, kept)


@pytest.mark.parametrize("kind", ["link", "folder"])
def test_only_a_file_in_the_folder_is_read(setup, kept, tmp_path, kind) -> None:
    elsewhere = kept.rename(tmp_path / "elsewhere")
    kept.symlink_to(elsewhere) if kind == "link" else kept.mkdir()
    with pytest.raises(RunFolderError, match="cannot use"):
        opened(setup, kept)


@pytest.mark.parametrize("change", ["edited", "new", "gone"])
def test_other_code_is_not_mixed_in(setup, kept, monkeypatch, change) -> None:
    """The detector's quantum efficiency halved in the source between two commands, and the like."""
    other, before, fingerprint = dict(sources()), kept.read_bytes(), replace(setup).fingerprint
    if change == "gone":
        del other["twin/sensors/area_detector.py"]
    else:
        other["twin/sensors/area_detector.py" if change == "edited" else "twin/new.py"] = "0" * 16
    monkeypatch.setattr(twin.framework.provenance, "sources", lambda: other)
    named = "twin/new.py" if change == "new" else "twin/sensors/area_detector.py"
    with pytest.raises(RunFolderError, match=rf"another version of the program.*changed: {named}.*--resume.*--out"):
        opened(setup, kept)
    assert kept.read_bytes() == before
    assert replace(setup).fingerprint != fingerprint


def test_another_version_of_a_package_is_named(setup, kept, monkeypatch) -> None:
    other = twin.framework.provenance.versions() | {"numpy": "1.0"}
    monkeypatch.setattr("twin.framework.provenance.versions", lambda: other)
    with pytest.raises(RunFolderError, match=r"numpy was [0-9.]+ and is 1\.0"):
        opened(setup, kept)


def test_sources_change_with_the_files(tmp_path, monkeypatch) -> None:
    for name in ("optics/a.py", "twin/b.py", "twin/validation/c.py", "scenes/d.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(twin.framework.provenance, "ROOT", tmp_path)
    read = sources.__wrapped__
    first = read()
    assert set(first) == {"optics/a.py", "twin/b.py"}
    (tmp_path / "twin/b.py").write_text("x = 2\n")
    assert read()["twin/b.py"] != first["twin/b.py"]
    assert read()["optics/a.py"] == first["optics/a.py"]


def test_a_worker_with_other_code_computes_nothing(setup) -> None:
    """Files that are edited while a study runs: a worker that is started afterwards refuses its task."""
    plan = Plan.of(setup)
    with pytest.raises(OtherProgramError, match="other source files"):
        evaluate(Task(plan.config, "0" * 64, "llvm", (plan.run(0),)))
    assert not evaluate(Task(plan.config, source_digest(), "llvm", (plan.run(0),))).failed.any()


SIGMA = "[recovered, cameras, forward, model, d_f_um_sigma]"
DF = f"  df: {{key: [recovered, cameras, forward, model, d_f_um], sigma: {SIGMA}}}\n"
TRUE = "  true_df: {key: [truth, cameras, forward, d_f_um]}\n"


def test_words_may_be_others_when_a_study_is_gone_on_with(setup, kept, tmp_path) -> None:
    """Names, units and what the report shows change no run."""
    more = ("name: study", "name: renamed\ndescription: all of it\nreport: {sobol: true}\nlimits: {runs: 999}")
    unit = (TRUE, "  is: {key: [truth, cameras, forward, d_f_um], unit: mm}\n")
    words = resolve_study(write_study(tmp_path / "words", more, unit))
    assert words.content == setup.content
    assert opened(words, kept) == ([], [])


@pytest.mark.parametrize("change", [(f"{DF}{TRUE}", f"{TRUE}{DF}"), ("seed: 3", "seed: 4"), (f", sigma: {SIGMA}", "")])
def test_what_makes_other_numbers_may_not(kept, tmp_path, change) -> None:
    """Also responses in another order: a block keeps them by their places."""
    with pytest.raises(RunFolderError, match="holds another study"):
        opened(resolve_study(write_study(tmp_path / "other", change)), kept)


def test_what_was_begun_is_gone_on_with_or_dropped(tmp_path, monkeypatch) -> None:
    """Neither by mistake: without --resume and --force a command refuses; with --force the old folder stands."""
    file, out, seen = write_study(tmp_path / "in"), tmp_path / "run", []

    def broken(setup, session, place, *_: object) -> None:
        plan = Plan.of(setup)
        with journal_of(setup, place / BLOCKS) as journal:
            seen.append([*journal.known])
            journal.keep({str(len(journal.known)): block(plan, len(journal.known))})
        raise Incomplete("the workers died")

    monkeypatch.setattr("twin.study.study_command.run_study", broken)
    first = run(file, "--out", out)
    again = f"the workers died; finished work is kept, continue with: python -m twin.study {file} --out {out} --resume"
    assert (first.exit_code, again in first.stderr) == (1, True), first.stderr
    refused = run(file, "--out", out)
    assert (refused.exit_code, "start again with --force" in refused.stderr) == (2, True)
    assert run(file, "--out", out, "--resume").exit_code == 1
    assert run(file, "--out", out, "--force").exit_code == 1
    assert seen == [[], ["0"], []]
    assert not out.exists()
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for word in ("--resume", "--force"):
        assert run(file, "--out", out, word).exit_code == 2
    assert (out / "mine.txt").read_text() == "mine"


# --- what is a failed run and what a fault of the program -------------------------------------------------------------


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
    assert "all 4 runs failed, see report.html; everything else is in" in said.stderr
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
    assert told == ["2 workers instead of 8: no more fit into the memory limit, 1 GB"]
