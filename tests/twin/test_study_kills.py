"""Processes of a study killed at random moments: what is done is kept, and at the end every byte is as if nothing had
happened.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from tests.twin.study_bench import ROOT, alive, children, chunks, same_bytes, start, wait_for, write_study
from twin.run.cluster import local_workers
from twin.study.runs.chunk_store import ChunkStore
from twin.study.runs.engine import Engine, IncompleteError
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

pytestmark = pytest.mark.second
RUNS = 150
"""With 6 blocks a killing has something to hit; a few seconds of work."""


def run_to_end(*arguments: object) -> None:
    process = start(*arguments)
    _, errors = process.communicate(timeout=180)
    assert process.returncode == 0, errors


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """File of a study, and its bytes when nobody disturbs it."""
    folder = tmp_path_factory.mktemp("undisturbed")
    path = write_study(folder, ("runs: 100", f"runs: {RUNS}"))
    run_to_end(path, "--out", folder / "run", "--workers", 2, "--quiet")
    return path, same_bytes(folder / "run")


def check_result(path, folder, expected: dict[str, bytes]) -> None:
    resume = ["--resume"] if folder.exists() else []
    run_to_end(path, "--out", folder, "--workers", 2, "--quiet", *resume)
    assert same_bytes(folder) == expected
    with xr.open_dataset(folder / "study.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data["run"].values, np.arange(RUNS))
        assert not data["failed"].values.any()
    assert not list((folder / "chunks").glob("*.partial"))
    assert not list((folder / "chunks").glob("*.corrupt"))


def test_runs_that_kill_their_worker_are_named(tmp_path, monkeypatch) -> None:
    """One block of five takes its process down each time; the others are done, and the message says which it is."""
    plan = Plan.of(resolve_study(write_study(tmp_path / "in", ("runs: 100", "runs: 125"))))

    # inside the test, so that Dask hands the code itself over: workers cannot import this file
    def deadly(task):
        import os

        from twin.study.runs.task import evaluate

        if task.first <= 3 < task.first + len(task.blocks):
            os._exit(9)
        return evaluate(task)

    monkeypatch.setattr("twin.study.runs.task.evaluate", deadly)
    store = ChunkStore(tmp_path, plan)
    store.open()
    before = dict(os.environ)
    with local_workers(1) as workers, pytest.raises(IncompleteError, match=r"runs 75-99 .*workers died"):
        Engine(plan, store, chunk_blocks=2).run(workers)
    assert store.missing == [3]
    # what workers are told by the environment is not left to this process
    assert dict(os.environ) == before


def test_a_command_that_is_killed_is_resumed(undisturbed, tmp_path) -> None:
    path, expected = undisturbed
    folder = tmp_path / "run"
    process = start(path, "--out", folder, "--workers", 2)
    try:
        wait_for(lambda: chunks(folder) >= 2)
        below = children(process.pid)
        process.kill()
        process.wait(10)
        wait_for(lambda: not any(alive(pid) for pid in below), 30.0)
    finally:
        process.kill()
    assert not (folder / "study.nc").exists()
    done = chunks(folder)
    assert done >= 2
    check_result(path, folder, expected)


def test_a_scheduler_that_is_killed(undisturbed, tmp_path) -> None:
    """The command says that the scheduler is gone and keeps what is done; local workers finish the rest."""
    path, expected = undisturbed
    folder, place = tmp_path / "run", tmp_path / "scheduler.json"
    quiet = {"cwd": ROOT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    tool = [sys.executable, "-m"]
    scheduler = subprocess.Popen(
        [*tool, "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)],
        **quiet,
    )
    wait_for(lambda: place.exists() and place.stat().st_size > 0)
    address = json.loads(place.read_text("utf-8"))["address"]
    worker = subprocess.Popen(
        [*tool, "distributed.cli.dask_worker", address, "--nthreads", "1", "--death-timeout", "5"], **quiet
    )
    process = start(path, "--out", folder, "--scheduler", address)
    try:
        wait_for(lambda: chunks(folder) >= 2)
        scheduler.kill()
        _, errors = process.communicate(timeout=60)
    finally:
        for each in (process, scheduler, worker):
            each.kill()
            each.wait(10)
    assert process.returncode == 1, errors
    assert "scheduler is gone" in errors
    assert "--resume" in errors
    assert "Traceback" not in errors
    check_result(path, folder, expected)
