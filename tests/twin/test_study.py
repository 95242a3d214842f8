"""`python -m twin.study` as a user runs it: the same numbers however it is run, and what it refuses."""

import asyncio
import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest
import xarray as xr

import twin.study.__main__ as command
from tests.twin.commands import invoke
from tests.twin.study_bench import ROOT, alive, blocks, children, same_bytes, start, wait_for, write_study
from twin.framework import cluster
from twin.framework.cluster import local_workers
from twin.study.runs.blocks import Engine, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

pytestmark = [pytest.mark.second, pytest.mark.drawn]

run = partial(invoke, command.app)


@pytest.fixture(scope="module")
def workers():
    """Two worker processes for all tests of this file."""
    with local_workers(2) as found:
        yield found


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A study of 110 runs, one of which fails, done by the command with one worker: folder, file, stdout."""
    folder = tmp_path_factory.mktemp("study")
    rows = ["z,x", *(f"{0.01 * k} um,{k % 7} nm" for k in range(109)), "3 mm,0 nm"]
    (folder / "table.csv").write_text("\n".join(rows) + "\n", "utf-8")
    path = write_study(
        folder,
        ("normal: {mean: 0 um, sigma: 1 um}", "table: {file: table.csv, column: z}"),
        ("uniform: [-1 um, 1 um]", "table: {file: table.csv, column: x}"),
        ("design: {kind: monte_carlo, runs: 100, seed: 3}", "design: {seed: 3}"),
    )
    process = start(path, "--out", folder / "run", "--workers", 1, "--json")
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert errors.startswith("warning: 1 of 110 runs failed and are excluded from all statistics.")
    assert errors.count("\n") == 1
    return folder / "run", path, json.loads(out)


def test_dataset(done) -> None:
    folder, _, numbers = done
    with xr.open_dataset(folder / "study.nc", engine="h5netcdf") as data:
        # the table's values, in the unit of the first of them
        np.testing.assert_allclose(data["m2z"].values, [*(0.01 * k for k in range(109)), 3000.0], rtol=1e-12)
        np.testing.assert_allclose(data["m2x"].values[:9], [0, 1, 2, 3, 4, 5, 6, 0, 1])
        assert data["failed"].values.tolist() == [0] * 109 + [1]
        assert [bool(text) for text in data["message"].values] == [False] * 109 + [True]
        assert np.flatnonzero(np.isnan(data["df"].values)).tolist() == [109]
        off = (data["df"] - data["true_df"]).values[:-1] / data["df_sigma"].values[:-1]
        # 109 errors in units of their sigma; 4.5 sigma is passed once in 1300 such sets
        assert np.max(np.abs(off)) < 4.5
    assert (numbers["runs"], numbers["failed"]) == (110, 1)
    with (folder / "study.csv").open(encoding="utf-8", newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert (last["df [um]"], last["failed"]) == ("", "1")


def test_two_workers_give_the_same_numbers(done, workers, tmp_path) -> None:
    folder, _, _ = done
    # from the config.yaml, which needs no other file
    plan = Plan.of(resolve_study(folder / "config.yaml"))
    with journal_of(plan.setup, tmp_path / "blocks.journal") as journal:
        engine = Engine(plan, journal)
        engine.run(workers)
        result = engine.result()
    with xr.open_dataset(folder / "study.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(result.values[:, 0], data["df"].values)
        np.testing.assert_array_equal(result.values[:, 1], data["true_df"].values)
        np.testing.assert_array_equal(result.sigmas[:, 0], data["df_sigma"].values)


def test_noise_that_cannot_be_is_bad_input_and_nothing_is_lost(done, monkeypatch) -> None:
    """Everything is written and shown; the file is to blame, at its key."""
    folder, path, _ = done
    before, plan = same_bytes(folder), Plan.of(resolve_study(path))
    fault = plan.setup.error("states too much", ("responses", "df", "sigma"), "the noise alone")
    answers = iter((None, fault))  # the report asks first, and stays as it is
    monkeypatch.setattr("twin.study.report.study_statistics.impossible_noise", lambda runs: next(answers))
    result = run(path, "--out", folder, "--resume")
    assert (result.exit_code, "df" in result.stdout, same_bytes(folder) == before) == (2, True, True)
    assert re.search(r"study.yaml:8: responses.df.sigma: states too much; allowed: the noise alone", result.stderr)


def test_nobody_else_can_talk_to_the_workers(workers) -> None:
    """Whoever may send them a task runs programs as this user: without the study's own key nobody may."""
    from distributed.security import Security

    facts = workers.client.scheduler_info(n_workers=-1)
    addresses = [facts["address"]]
    for address, worker in facts["workers"].items():
        addresses += [address, worker["nanny"]]
    assert len(addresses) == 5
    for address in addresses:
        assert address.startswith("tls://127.0.0.1:"), address
        for security in (None, Security.temporary()):
            plain = address.replace("tls://", "tcp://") if security is None else address
            with pytest.raises((OSError, TimeoutError)):
                asyncio.run(greet(plain, security))
    # what Dask serves by HTTP has a port of its own, with nothing on it; and there is no other
    ports = [facts["services"]["dashboard"], *(w["services"]["dashboard"] for w in facts["workers"].values())]
    assert listening() == {("127.0.0.1", port) for port in (*(int(a.rpartition(":")[2]) for a in addresses), *ports)}
    for port in ports:
        for page in ("", "health", "info/main/workers.html", "metrics", "json/identity.json"):
            with pytest.raises(HTTPError, match="404"):
                urlopen(f"http://127.0.0.1:{port}/{page}", timeout=10)


def listening() -> set[tuple[str, int]]:
    """Where this process and those below it can be reached from outside of them."""
    import psutil

    own = psutil.Process()
    found = [c for process in (own, *own.children(recursive=True)) for c in process.net_connections()]
    return {tuple(c.laddr) for c in found if c.status == psutil.CONN_LISTEN}


async def greet(address: str, security: Any) -> object:
    """What a server of Dask says of itself."""
    from distributed.core import rpc

    async with rpc(address, connection_args={} if security is None else security.get_connection_args("client")) as it:
        return await asyncio.wait_for(it.identity(), 5)


def test_workers_that_do_not_come_back_are_not_waited_for(monkeypatch) -> None:
    monkeypatch.setattr(cluster, "WORKER_SECONDS", 1.0)
    with local_workers(1) as alone:
        assert alone.submit(abs, -1).result(timeout=60) == alone.next_finished().result() == 1
        alone.client.cluster.scale(0)
        alone.submit(time.sleep, 60)
        with pytest.raises(cluster.ClusterError, match="none restarted within"):
            alone.next_finished()


def test_resume_of_a_finished_study_computes_nothing(done) -> None:
    folder, path, _ = done
    before = same_bytes(folder)
    begun = time.monotonic()
    result = run(path, "--out", folder, "--resume", "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["runs_computed"] == 0
    assert same_bytes(folder) == before
    assert time.monotonic() - begun < 30.0
    taken = run(path, "--out", folder)
    assert (taken.exit_code, "--force" in taken.stderr) == (2, True)
    assert not folder.with_name("run.blocks").exists()


@pytest.mark.parametrize(
    ("address", "told"),
    [
        *((address, "not a valid address") for address in ("nowhere", "tls://", "tcp://host", "tcp://host:99999999")),
        ("tls://127.0.0.1:1", "TLS needs certificates; configure them for Dask with DASK_DISTRIBUTED__COMM__TLS__CA"),
    ],
)
def test_a_scheduler_that_cannot_be_reached_by_what_is_given(tmp_path, address, told) -> None:
    result = run(write_study(tmp_path / "in"), "--out", tmp_path / "run", "--scheduler", address)
    assert result.exit_code == 2
    assert told in " ".join(result.stderr.split())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_keeps_what_is_done(tmp_path, number, code) -> None:
    """A signal to the whole group of processes, as the terminal's Ctrl-C is, or to the command alone, as kill is."""
    path = write_study(tmp_path / "in", ("runs: 100", "runs: 4000"))
    process = start(path, "--out", tmp_path / "run", "--workers", 1)
    try:
        wait_for(lambda: blocks(tmp_path / "run") >= 1)
        second = run(path, "--out", tmp_path / "run", "--resume")
        assert second.exit_code == 2
        assert "another command" in second.stderr
        below = children(process.pid)
        assert below
        os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
        _, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == code, errors
    assert re.search(r"finished work is kept, continue with: .*--resume", errors), errors
    assert "Traceback" not in errors, errors
    assert blocks(tmp_path / "run") >= 1
    assert not (tmp_path / "run").exists()


def test_a_real_scheduler_with_two_workers(done, tmp_path) -> None:
    """A cluster by TLS, as a user sets it up by hand, gives the numbers of the local processes."""
    from distributed.security import Security

    folder, path, _ = done
    key, options, environment = Security.temporary(), [], dict(os.environ)
    for name, variable, text in (
        ("ca-file", "CA_FILE", key.tls_ca_file),
        ("cert", "CLIENT__CERT", key.tls_client_cert),
        ("key", "CLIENT__KEY", key.tls_client_key),
    ):
        (tmp_path / f"{name}.pem").write_text(text, "utf-8")
        options += [f"--tls-{name}", str(tmp_path / f"{name}.pem")]
        environment[f"DASK_DISTRIBUTED__COMM__TLS__{variable}"] = str(tmp_path / f"{name}.pem")
    place = tmp_path / "scheduler.json"
    quiet = {"cwd": ROOT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    words = ["--protocol", "tls", *options, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    words += ["--scheduler-file", str(place)]
    others = [subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *words], **quiet)]
    try:
        wait_for(lambda: place.exists() and place.stat().st_size > 0)
        address = json.loads(place.read_text("utf-8"))["address"]
        program = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
        for k in range(2):
            name = ["--local-directory", str(tmp_path), "--name", f"w{k}"]
            others.append(subprocess.Popen([*program, *options, *name], **quiet))
        study = [sys.executable, "-m", "twin.study", str(path), "--out", str(tmp_path / "run"), "--scheduler", address]
        ran = subprocess.run(study, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900, check=False)
        assert ran.returncode == 0, ran.stderr
        assert same_bytes(tmp_path / "run") == same_bytes(folder)
    finally:
        for process in others:
            process.terminate()
        for process in others:
            process.wait(60)


def test_killed_workers_and_commands_lose_nothing(tmp_path) -> None:
    """A worker is killed and replaced, then the command itself; gone on with, every byte is as if nobody had killed."""
    path = write_study(tmp_path, ("runs: 100", "runs: 200"))
    folder, whole = tmp_path / "run", tmp_path / "whole"
    process = start(path, "--out", folder, "--workers", 2)
    try:
        wait_for(lambda: blocks(folder) >= 1)
        below = children(process.pid)
        assert len(below) == 2
        os.kill(below[0], signal.SIGKILL)
        wait_for(lambda: blocks(folder) >= 3)
        below = children(process.pid)
        assert process.poll() is None
        process.kill()
        process.wait(10)
        # workers notice that the command is gone
        wait_for(lambda: not any(alive(pid) for pid in below), 30.0)
    finally:
        process.kill()
        process.communicate()
    assert not folder.exists()
    for out, options in ((folder, ["--resume"]), (whole, [])):
        done = run(path, "--out", out, "--workers", 1, "--quiet", *options)
        assert done.exit_code == 0, done.stderr  # a warning of memory, where others use it
    assert same_bytes(folder) == same_bytes(whole)
    assert not [place.name for place in tmp_path.iterdir() if place.name.startswith((".run", "run."))]
