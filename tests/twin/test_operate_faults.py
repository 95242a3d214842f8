"""Whatever happens while a record is written: no reading is lost or doubled, and the record opens."""

import json
import os
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from optics.numerics.backend import load_backend
from scenes.specs.resolved import resolve_with
from tests.twin.commands import invoke
from tests.twin.operation_records import life_of, monitor_entry, plan_of
from tests.twin.record_bench import (
    TELEMETRY,
    given,
    ingesting,
    made,
    postgres_programs,
    postgres_server,
    table,
    temperatures,
)
from tests.twin.test_durability import mounted
from twin.framework.data_files import TABLE_FORMATS
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.__main__ import app
from twin.operate.estimate.operation_filter import Operation
from twin.operate.record import FILE, RecordFailed
from twin.operate.record.entries import Alarm
from twin.operate.record.history import History, initialised
from twin.operate.record.record_tables import tables

FILES, ROWS = 12, 400


def telemetry(folder: Path) -> Path:
    """Twelve tables, each taken in one step."""
    folder.mkdir()
    for k in range(FILES):
        (folder / f"t_{k:02d}.csv").write_text(table(ROWS * k, ROWS))
    (folder / "telemetry.yaml").write_text(TELEMETRY)
    return folder / "telemetry.yaml"


def times(place: Path | str) -> list[int]:
    with History(str(place)) as history:
        return [row["time_us"] for row in history.entries()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float, bytes]:
    """Description of the tables, seconds that an undisturbed ingest takes, and what it exports."""
    folder = tmp_path_factory.mktemp("whole")
    file = telemetry(folder / "tm")
    made(folder / "record").close()
    start = time.monotonic()
    process = ingesting(folder / "record", file, "--json")
    out, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    assert json.loads(out)["new"] == FILES * ROWS
    return file, time.monotonic() - start, exported(folder / "record")


def exported(place: Path | str) -> bytes:
    with History(str(place)) as history:
        return b"".join(TABLE_FORMATS["csv"](one) for one in tables(history))


def two_writers(place: str, file: Path) -> None:
    writers = [ingesting(place, file, "--json") for _ in range(2)]
    done = [(one.communicate(timeout=240), one.returncode) for one in writers]
    assert [code for _, code in done] == [0, 0], done
    new = [json.loads(out)["new"] for (out, _), _ in done]
    known = [json.loads(out)["known"] for (out, _), _ in done]
    assert sum(new) == FILES * ROWS
    assert [a + b for a, b in zip(new, known, strict=True)] == [FILES * ROWS] * 2


@pytest.mark.second
def test_two_writers_at_once(tmp_path: Path, whole: tuple[Path, float, bytes]) -> None:
    made(tmp_path / "record").close()
    two_writers(str(tmp_path / "record"), whole[0])
    assert exported(tmp_path / "record") == whole[2]


@pytest.mark.second
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to mount a small file system")
def test_a_full_disk(tmp_path: Path) -> None:
    """What does not fit is refused as a whole, what was taken stays, and there is room again when the disk has some."""
    told = []
    with mounted("-t", "tmpfs", "-o", "size=700k", "tmpfs", at=tmp_path / "disk") as disk:
        taken = 0
        with made(disk / "record") as history:
            for k in range(20):
                try:
                    taken += history.take(given(f"t{k}", temperatures(100 * k, 100))).new
                except RecordFailed as error:
                    told.append(str(error))
        assert set(told) == {"database or disk is full"}
        assert taken > 0
        there = times(disk / "record")
        assert len(there) == len(set(there)) == taken
        shutil.copytree(disk / "record", tmp_path / "larger")
    base = sqlite3.connect(tmp_path / "larger" / FILE)
    assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    base.close()
    with History(str(tmp_path / "larger")) as history:
        for k in range(20):
            history.take(given(f"t{k}", temperatures(100 * k, 100)), late=True)
    assert len(times(tmp_path / "larger")) == 2000


def test_the_command_tells_of_a_database_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(tmp_path / "record").close()
    base = sqlite3.connect(tmp_path / "record" / FILE)
    base.execute("BEGIN EXCLUSIVE")
    monkeypatch.setattr("twin.operate.record.schema.WAIT", 0.1)
    result = invoke(app, "status", tmp_path / "record")
    base.close()
    assert (result.exit_code, "database is locked" in result.stderr) == (1, True)


PROGRAMS = postgres_programs()
HAS_SERVER = pytest.mark.skipif(
    PROGRAMS is None, reason="no PostgreSQL server: Debian's package postgresql is not installed"
)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Address of an empty database of a server of its own."""
    pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")
    assert PROGRAMS is not None
    with tempfile.TemporaryDirectory(prefix="pg-") as place:  # a socket's path is short
        Path(place).chmod(0o755)
        with postgres_server(PROGRAMS, Path(place) / "server") as url:
            yield url


def database(server: str, name: str) -> str:
    """Address of another database of the server."""
    import psycopg

    with psycopg.connect(dbname="template1", user="twin", host=server.partition("host=")[2], autocommit=True) as base:
        base.execute(f"CREATE DATABASE {name} TEMPLATE template0")
    return server.replace("/record?", f"/{name}?")


@HAS_SERVER
@pytest.mark.second
def test_the_same_record_on_a_postgresql_server(server: str, tmp_path: Path) -> None:
    """The same readings give the same bytes as in SQLite; nothing can be altered; what is known is recognised."""
    import psycopg

    assert "no record" in invoke(app, "status", server).stderr
    for place in (server, str(tmp_path / "record")):
        with made(place) as history:
            assert history.take(given("a", temperatures(5, 600))).new == 600
            assert history.take(given("b", temperatures(0, 10))).refused[0][1].endswith("--late takes it")
            assert history.take(given("b", temperatures(0, 10)), late=True).new == 5
            assert history.take(given("c", temperatures(0, 605))).known == 605
    with History(server) as one, History(str(tmp_path / "record")) as two:
        kept = [[t for t in tables(history) if t.name != "refused"] for history in (one, two)]
        assert [TABLE_FORMATS["csv"](t) for t in kept[0]] == [TABLE_FORMATS["csv"](t) for t in kept[1]]
        told = one.status()
        assert (told["entries"], told["guarded"], told["open"], len(told["refused"])) == (605, True, 0, 5)
        assert told["streams"] == two.status()["streams"]
    with psycopg.connect(dbname="record", user="twin", host=server.partition("host=")[2]) as base:
        for what in ("DELETE FROM entry", "UPDATE source SET file = 'x'", "TRUNCATE refused", "DELETE FROM alarm"):
            with pytest.raises(psycopg.errors.RaiseException, match="a record is never altered"), base.transaction():
                base.execute(what)


@HAS_SERVER
@pytest.mark.second
def test_the_same_estimate_on_a_postgresql_server(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known now, of the past and ahead: the same bytes, also where it goes on from what was kept."""
    monkeypatch.setattr("twin.operate.estimate.operation_filter.HEAD", 1)
    plan = plan_of(tmp_path)
    experiment = MonitorExperiment(plan.model, load_backend())
    stated = experiment.disturbances
    assert stated is not None
    slip = next(k for k, label in enumerate(stated.labels) if "forward/M2 shift z" in label)
    life = life_of(stated, 60.0, 3.0, 2, {30.0: {slip: 4.0}})
    entries = [monitor_entry(experiment, stated, life, k, 2) for k in range(len(life.times))]
    found = []
    for place in (database(server, "estimate"), str(tmp_path / "record")):
        initialised(place, resolve_with("monitor_pair"), True)
        with History(place) as history:
            for name, own in (("a", entries[:12]), ("b", entries[12:])):
                assert not history.take(given(name, own)).refused
                estimate = Operation(history, plan)
                told = estimate.follow().to_dict()
            ahead = estimate.forecast(life.times[-1:] + 86_400_000_000).to_dict()
            found.append(json.dumps([told, estimate.smoothed(life.times).to_dict(), ahead]))
    assert json.loads(found[0])[0]["jumps"]
    assert found[0] == found[1]


@HAS_SERVER
@pytest.mark.second
def test_what_is_derived_on_a_postgresql_server(server: str) -> None:
    """Plans, checkpoints and alarms as in SQLite."""
    url = database(server, "derived")
    with made(url) as history:
        assert history.take(given("a", temperatures(0, 3))).new == 3
        assert history.keep_plan("plan.yaml", {"window": 60})
        assert history.raise_alarm(Alarm("jump", "base", 0, "it jumped"))
        history.acknowledge(1, "Ann", "seen")
        times = [row["time_us"] for row in history.entries()]
        for k, time_us in enumerate(times):
            assert history.save_checkpoint("a" * 64, k, time_us, 3, b"\0%d" % k)
        assert history.save_checkpoint("a" * 64, 0, times[0], 3, b"other")
        assert history.take(given("b", temperatures(1, 1, "base/forward"))).new == 1
        assert [(one.number, one.content) for one in history.checkpoints("a" * 64)] == [(0, b"other")]
        assert history.drop_checkpoints("a" * 64, 0) == 1
        assert history.alarms()[0]["acknowledged"]["by"] == "Ann"
        assert history.status()["guarded"]
