"""Whatever happens while a record is written: no reading is lost or doubled, and the record opens. And what it keeps
besides readings: plans, where an estimate stood, alarms and who has seen them.
"""

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
from scenes.specs.load import EXAMPLES
from scenes.specs.operation import read_operation
from scenes.specs.resolved import resolve_with
from scenes.yaml.errors import Problem
from tests.twin.commands import invoke
from tests.twin.operation_records import life_of, monitor_entry, plan_of
from tests.twin.record_bench import (
    MINUTE,
    START,
    TELEMETRY,
    given,
    ingesting,
    made,
    postgres_programs,
    postgres_server,
    table,
    temperatures,
)
from tests.twin.study_bench import REFUSED
from tests.twin.test_durability import mounted
from twin.framework.data_files import TABLE_FORMATS
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.__main__ import app
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.operation_model import plan_digest, quantity_names, read_plan, stored_plan
from twin.operate.record import FILE, RecordFailed
from twin.operate.record.entries import Alarm
from twin.operate.record.history import History, initialise_record
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
                    taken += history.ingest(given(f"t{k}", temperatures(100 * k, 100))).new
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
            history.ingest(given(f"t{k}", temperatures(100 * k, 100)), late=True)
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
            assert history.ingest(given("a", temperatures(5, 600))).new == 600
            assert history.ingest(given("b", temperatures(0, 10))).refused[0][1].endswith("--late takes it")
            assert history.ingest(given("b", temperatures(0, 10)), late=True).new == 5
            assert history.ingest(given("c", temperatures(0, 605))).known == 605
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
    monkeypatch.setattr("twin.operate.estimate.operation_filter.HEAD_READINGS", 1)
    plan = plan_of(tmp_path)
    experiment = MonitorExperiment(plan.model, load_backend())
    stated = experiment.disturbances
    assert stated is not None
    slip = next(k for k, label in enumerate(stated.labels) if "forward/M2 shift z" in label)
    life = life_of(stated, 60.0, 3.0, 2, {30.0: {slip: 4.0}})
    entries = [monitor_entry(experiment, stated, life, k, 2) for k in range(len(life.times))]
    found = []
    for place in (database(server, "estimate"), str(tmp_path / "record")):
        initialise_record(place, resolve_with("monitor_pair"), True)
        with History(place) as history:
            for name, own in (("a", entries[:12]), ("b", entries[12:])):
                assert not history.ingest(given(name, own)).refused
                estimate = Operation(history, plan)
                told = estimate.filter_readings().to_dict()
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
        assert history.ingest(given("a", temperatures(0, 3))).new == 3
        assert history.store_plan("plan.yaml", {"window": 60})
        assert history.raise_alarm(Alarm("jump", "base", 0, "it jumped"))
        history.acknowledge(1, "Ann", "seen")
        times = [row["time_us"] for row in history.entries()]
        for k, time_us in enumerate(times):
            assert history.save_checkpoint("a" * 64, k, time_us, 3, b"\0%d" % k)
        assert history.save_checkpoint("a" * 64, 0, times[0], 3, b"other")
        assert history.ingest(given("b", temperatures(1, 1, "base/forward"))).new == 1
        assert [(one.number, one.content) for one in history.checkpoints("a" * 64)] == [(0, b"other")]
        assert history.drop_checkpoints("a" * 64, 0) == 1
        assert history.alarms()[0]["acknowledged"]["by"] == "Ann"
        assert history.status()["guarded"]


# --- what a record keeps besides readings: plans, checkpoints, alarms -------------------------------------------------


PLAN_DIGEST = "a" * 64


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("record") / "record"
    made(place).close()
    return place


@pytest.fixture
def record(tmp_path: Path, empty: Path) -> Path:
    return Path(shutil.copytree(empty, tmp_path / "record"))


# --- entries ---------------------------------------------------------------------------------------------


@pytest.mark.second
def test_entries_after_a_place_in_their_order(record: Path) -> None:
    """Two bodies at the same minutes, the second one taken later."""
    with History(str(record)) as history:
        history.ingest(given("a", temperatures(0, 4)))
        history.ingest(given("b", temperatures(0, 4, "base/forward")))

        def found(**limits: int) -> list[tuple[int, int]]:
            return [((row["time_us"] - START) // MINUTE, row["id"]) for row in history.entries("", **limits)]

        everything = found()
        assert everything == [(0, 1), (0, 5), (1, 2), (1, 6), (2, 3), (2, 7), (3, 4), (3, 8)]
        at = START + MINUTE
        assert found(after_us=at) == everything[4:]
        assert [row["id"] for row in history.entries("temperature", after_us=at)] == [3, 7, 4, 8]
        with history.reading() as connection:
            plan = connection.exec_driver_sql(
                "EXPLAIN QUERY PLAN SELECT * FROM entry WHERE time_us > 5 ORDER BY time_us, id"
            ).all()
        # without a table of its own to sort in, ten years are read from where they are wanted
        assert len(plan) == 1
        assert "entry_time" in plan[0][-1]


# --- where an estimate stood -----------------------------------------------------------------------------


def test_checkpoints_are_kept_replaced_and_dropped(record: Path) -> None:
    with History(str(record)) as history:
        history.ingest(given("a", temperatures(0, 3)))
        for k in (1, 0, 2):
            assert history.save_checkpoint(PLAN_DIGEST, k, START + MINUTE * k, 3, b"%d" % k)
        assert history.save_checkpoint(PLAN_DIGEST, 1, START + MINUTE, 3, b"again \0")
        assert history.save_checkpoint("b" * 64, 0, START, 3, b"of another plan")
        assert [(one.number, one.time_us, one.entry_id, one.content) for one in history.checkpoints(PLAN_DIGEST)] == [
            (0, START, 3, b"0"),
            (1, START + MINUTE, 3, b"again \0"),
            (2, START + 2 * MINUTE, 3, b"2"),
        ]
        assert history.drop_checkpoints(PLAN_DIGEST, START + MINUTE) == 2
        assert [one.number for one in history.checkpoints(PLAN_DIGEST)] == [0]
        assert len(history.checkpoints("b" * 64)) == 1


def test_a_reading_drops_what_was_derived_without_it(record: Path) -> None:
    """Whether it is late in its own stream or only comes after those of others."""
    with History(str(record)) as history:
        history.ingest(given("a", [*temperatures(0, 1), *temperatures(2, 3)]))
        for k in range(5):
            assert history.save_checkpoint(PLAN_DIGEST, k, START + MINUTE * k, 4, b"")
        history.ingest(given("b", temperatures(5, 1)))
        assert len(history.checkpoints(PLAN_DIGEST)) == 5
        history.ingest(given("c", temperatures(4, 1, "base/forward")))
        assert [one.number for one in history.checkpoints(PLAN_DIGEST)] == [0, 1, 2, 3]
        assert history.ingest(given("d", temperatures(1, 1))).new == 0  # it is refused
        assert len(history.checkpoints(PLAN_DIGEST)) == 4
        assert history.ingest(given("d", temperatures(1, 1)), late=True).new == 1
        assert [one.number for one in history.checkpoints(PLAN_DIGEST)] == [0]


def test_a_checkpoint_that_a_reading_has_overtaken_is_not_kept(record: Path) -> None:
    """Another process took a reading while the estimate was worked out."""
    with History(str(record)) as history:
        history.ingest(given("a", temperatures(0, 3)))
        history.ingest(given("b", temperatures(1, 1, "base/forward")))
        assert not history.save_checkpoint(PLAN_DIGEST, 0, START + 2 * MINUTE, 3, b"")
        assert history.save_checkpoint(PLAN_DIGEST, 0, START, 3, b"")
        assert history.save_checkpoint(PLAN_DIGEST, 1, START + 2 * MINUTE, 4, b"")


# --- alarms ----------------------------------------------------------------------------------------------


def test_an_alarm_is_raised_once_and_acknowledged_once(record: Path) -> None:
    with History(str(record)) as history:
        alarm = Alarm("jump", "base/forward/M2", START, "it jumped", {"sigma": 0.5})
        assert history.raise_alarm(alarm)
        assert not history.raise_alarm(Alarm("jump", "base/forward/M2", START, "in other words"))
        assert history.raise_alarm(Alarm("jump", "base/forward/M1", START, "it jumped, too"))
        with pytest.raises(Problem, match="no such alarm"):
            history.acknowledge(3, "Ann", "")
        history.acknowledge(1, "Ann", "after safe mode")
        with pytest.raises(Problem, match="alarm 1 was acknowledged by Ann at "):
            history.acknowledge(1, "Bob", "")
        first, second = history.alarms()
    assert (first["text"], first["content"], first["time_utc"]) == ("it jumped", {"sigma": 0.5}, "2026-01-01T00:00:00Z")
    assert (first["acknowledged"]["by"], first["acknowledged"]["note"]) == ("Ann", "after safe mode")
    assert (second["id"], second["acknowledged"]) == (2, None)


# --- plans -----------------------------------------------------------------------------------------------


@pytest.mark.second
def test_the_newest_plan_counts_and_reads_back(record: Path, tmp_path: Path) -> None:
    file = tmp_path / "plan.yaml"
    first = json.loads(invoke(app, "init", record, "gf7_pair", "--plan", EXAMPLES / "operation.yaml", "--json").stdout)
    again = json.loads(invoke(app, "init", record, "gf7_pair", "--plan", EXAMPLES / "operation.yaml", "--json").stdout)
    assert (first["new_plan"], again["new_plan"]) == (True, False)
    file.write_text("instrument: gf7_pair\ndisturbances: launch\nwindow: 20\n")
    assert "counts" in invoke(app, "init", record, "gf7_pair", "--plan", file).stdout
    with History(str(record)) as history:
        kept = stored_plan(history)
        assert kept == read_plan(file, history)
        assert kept is not None
        assert (kept.operation.window, kept.disturbances.name) == (20, "launch")
        with history.reading() as connection:
            assert connection.exec_driver_sql("SELECT count(*) FROM plan").scalar() == 2


@pytest.mark.second
def test_an_estimate_rests_on_a_part_of_the_plan(tmp_path: Path) -> None:
    text = "instrument: gf7_pair\ndisturbances: in_service\n"

    def digest(more: str) -> str:
        (tmp_path / "plan.yaml").write_text(text + more)
        return plan_digest(read_operation(tmp_path / "plan.yaml"))

    own = digest("")
    assert digest("horizon: 24 h\nrequirements: [{quantity: forward d_f_um, limit: 2 um}]\n") == own
    assert len({own, *(digest(more) for more in ("window: 61\n", "coefficients: 31 percent\n", "mission: 1 h\n"))}) == 4
    shipped = (EXAMPLES.parent / "library/disturbances/in_service.yaml").read_text()
    (tmp_path / "in_service.yaml").write_text(shipped)
    text = text.replace("in_service", "./in_service.yaml")
    assert digest("") == own  # where it stands is no matter
    (tmp_path / "in_service.yaml").write_text(shipped.replace("scale: 5 ppm", "scale: 6 ppm"))
    assert digest("") != own


@pytest.mark.second
@pytest.mark.parametrize(("text", "said"), REFUSED["plans"])
def test_a_plan_that_is_not_of_the_record(text: str, said: str, record: Path, tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").write_text(text)
    result = invoke(app, "init", record, "gf7_pair", "--plan", tmp_path / "plan.yaml")
    assert result.exit_code == 2
    assert said in result.stderr
    with History(str(record)) as history:
        assert history.plan() is None


def test_quantities_are_those_that_are_read() -> None:
    from analysis.monitor.limits import quantities
    from optics.numerics.backend import load_backend
    from twin.monitor.monitor_experiment import MonitorExperiment

    setup = read_operation(EXAMPLES / "operation.yaml")
    experiment = MonitorExperiment(setup.model, load_backend())
    own = quantities(experiment.cameras, experiment.ground)
    assert quantity_names(setup.model.instrument) == tuple(f"{one.group} {one.key}" for one in own)
