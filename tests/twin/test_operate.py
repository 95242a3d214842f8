"""The record of an instrument in operation: what is taken, what is known already, what is refused and why."""

import csv
import hashlib
import json
import os
import re
import shutil
import sqlite3
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy.exc import IntegrityError

from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve_with
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.commands import invoke
from tests.twin.record_bench import MINUTE, START, TELEMETRY, given, made, pair, run_folder, spots, table, temperatures
from tests.twin.study_bench import REFUSED as INPUTS
from twin.operate.__main__ import _record_warnings, app
from twin.operate.record import FILE, NotARecord, RecordFailed, schema
from twin.operate.record.entries import (
    Alarm,
    Entry,
    FileContent,
    digest_of_job,
    instrument_digest,
    micros,
    now,
    utc_text,
)
from twin.operate.record.history import History, content_of, initialise_record
from twin.operate.record.ingest import Ingest
from twin.operate.record.record_tables import tables
from twin.operate.record.telemetry import time_of_name


def run(*words: object):
    return invoke(app, *words)


def status(record: Path) -> dict:
    return json.loads(run("status", record, "--json").stdout)


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("record") / "record"
    made(place).close()
    return place


@pytest.fixture
def record(tmp_path: Path, empty: Path) -> Path:
    return Path(shutil.copytree(empty, tmp_path / "record"))


def written(folder: Path, text: str, tables: dict[str, str]) -> Path:
    for name, content in tables.items():
        (folder / name).write_text(content, "utf-8")
    (folder / "telemetry.yaml").write_text(text, "utf-8")
    return folder / "telemetry.yaml"


# --- what is taken ---------------------------------------------------------------------------------------


@pytest.mark.second
def test_the_example_is_taken_once_and_told_the_second_time(tmp_path: Path) -> None:
    record, file = tmp_path / "record", EXAMPLES / "telemetry.yaml"
    assert run("init", record, "gf7_pair").exit_code == 0
    first, second = (json.loads(run("ingest", record, file, "--json").stdout) for _ in range(2))
    assert (first["new"], first["known"], first["refused"]) == (13, 0, 0)
    assert (second["new"], second["known"], second["refused"]) == (0, 13, 0)
    assert all(one["before"] for one in second["files"])
    told = status(record)
    assert told["entries"] == 13
    assert told["guarded"]
    assert {one["kind"]: one["entries"] for one in told["streams"] if one["subject"] != "base"} == {
        "attitude": 2,
        "event": 1,
        "focus": 1,
        "temperature": 3,
    }


def test_a_record_is_exported_with_units(tmp_path: Path) -> None:
    """Values in the file's units come out in those of the heads: 20.12 degC as kelvin, GPS time as UTC."""
    record, out = tmp_path / "record", tmp_path / "tables"
    run("init", record, "gf7_pair")
    run("ingest", record, EXAMPLES / "telemetry.yaml")
    assert run("export", record, "--out", out).exit_code == 0
    rows = {path.stem: list(csv.DictReader(path.open())) for path in out.glob("*.csv")}
    assert set(rows) == {"temperature", "attitude", "focus", "event"}
    (warm,) = (r for r in rows["temperature"] if (r["subject"], r["time_utc"][11:16]) == ("base/forward/M1", "00:00"))
    assert float(warm["temperature_K [K]"]) == pytest.approx(293.27, abs=1e-12)
    assert float(warm["temperature_K_sigma [K]"]) == 0.05
    assert float(rows["focus"][0]["defocus_um [um]"]) == pytest.approx(12.5, abs=1e-12)
    assert float(rows["focus"][0]["defocus_um_sigma [um]"]) == pytest.approx(4.0, abs=1e-12)
    # GPS time is ahead of UTC by 18 s in 2026
    assert rows["attitude"][0]["time_utc"] == "2026-03-05T00:00:00Z"
    assert float(rows["attitude"][0]["angle_arcsec_sigma [arcsec]"]) == pytest.approx(2.0, abs=1e-12)
    assert [r["subject"] for r in rows["event"]] == ["safe_mode", "heater_set_point"]
    again = run("export", record, "--out", out)
    assert again.exit_code == 2
    assert "exists; choose another" in again.stderr
    assert run("export", record, "--out", out, "--force").exit_code == 0
    assert "neither a run folder nor" in run("ingest", record, tmp_path).stderr  # exported tables are no reading
    (out / "mine.txt").write_text("mine", "utf-8")
    kept = run("export", record, "--out", out, "--force")
    assert (kept.exit_code, "mine.txt" in kept.stderr) == (2, True), kept.stderr
    assert "did you mean 'parquet'" in run("export", record, "--tables", "parket", "--out", tmp_path / "x").stderr


def test_parquet_has_units_and_meanings(record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    with History(str(record)) as history:
        history.ingest(given("t", temperatures(0, 5)))
    assert run("export", record, "--tables", "parquet", "--out", tmp_path / "p").exit_code == 0
    found = parquet.read_table(tmp_path / "p/temperature.parquet")
    assert found.num_rows == 5
    assert found.schema.field("temperature_K").metadata[b"unit"] == b"K"
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    without = run("export", record, "--tables", "parquet", "--out", tmp_path / "q")
    assert (without.exit_code, "needs the package pyarrow" in without.stderr) == (2, True), without.stderr


def test_a_run_folder_is_a_reading_with_its_frames(record: Path, tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", angle=1.25)
    first = run("ingest", record, folder, "--time", "2026-03-05T03:05:00Z", "--json")
    assert (first.exit_code, json.loads(first.stdout)["new"]) == (0, 1)
    with History(str(record)) as history:
        (entry,) = history.entries("monitor")
        by_name = {one.name: one for one in tables(history)}
        with history.reading() as connection:
            frames = connection.exec_driver_sql("SELECT file, length(sha256) FROM frame").all()
    assert content_of(entry)["numbers"]["cameras"]["forward"]["posterior"]["d_alpha_arcsec"] == 1.25
    assert by_name["monitor"].column("d_alpha_arcsec").plain == [1.25]
    assert by_name["intersection_angle"].column("change_arcsec_sigma").plain == [0.1]
    assert [tuple(row) for row in frames] == [("images/forward_left_after.tiff", 64)]
    # the same frames cannot be of another moment
    other = run("ingest", record, folder, "--time", "2026-03-06T03:05:00Z")
    assert other.exit_code == 2
    assert "same frames as the reading of 2026-03-05T03:05:00Z" in other.stdout
    for place, words in ((folder, "the run folder has no time"), (tmp_path / "run/images", "neither a run folder")):
        silent = run("ingest", record, place)
        assert (silent.exit_code, words in " ".join(silent.stderr.split())) == (2, True), silent.stderr


@pytest.mark.second
def test_a_run_of_measured_frames_states_its_instrument_below_model(record: Path, tmp_path: Path) -> None:
    """With an exposure of its own, which makes no other instrument."""
    model = json.loads(json.dumps(pair().plain()))
    model["instrument"]["monitor"]["area_ccd"]["exposure"] = "7 ms"
    folder = run_folder(tmp_path / "run", config=dump_yaml({"test": {"exposure": "7 ms"}, "model": model}))
    result = run("ingest", record, folder, "--time", "2026-03-05T03:05:00Z", "--json")
    assert (result.exit_code, json.loads(result.stdout)["new"]) == (0, 1), result.stdout


def test_a_calibration_is_of_the_instrument_that_is_said(record: Path, tmp_path: Path) -> None:
    """A run of twin.orbit does not say it itself."""
    folder = run_folder(tmp_path / "run", config="test: {}\n")
    (folder / "recovered.json").rename(folder / "calibration.json")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["sha256"]["calibration.json"] = manifest["sha256"].pop("recovered.json")
    (folder / "manifest.json").write_text(json.dumps(manifest))
    words = ("ingest", record, folder, "--time", "2026-03-05T03:05:00Z")
    assert "--instrument NAME" in run(*words).stdout
    other = run(*words, "--instrument", "gf7_pair_two")
    assert (other.exit_code, "not of gf7_pair_two" in other.stderr) == (2, True)
    assert run(*words, "--instrument", "gf7_pair").exit_code == 0
    with History(str(record)) as history:
        (found,) = tables(history)[:1]
        assert (found.name, found.column("kind").plain) == ("run", ["calibration"])


def rewritten(folder: Path, data: object) -> Path:
    """Another content of a run's results, as if it had written that."""
    (folder / "recovered.json").write_text(json.dumps(data))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["sha256"]["recovered.json"] = hashlib.sha256((folder / "recovered.json").read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.mark.second
def test_results_that_are_none_are_refused(record: Path, tmp_path: Path) -> None:
    apart, bare = "times and states differ in number", "a state without cameras or without a time"
    cases = [([], "no results"), ({"times_s": [0, 1], "series": [{"cameras": {}}]}, apart), ({"series": {}}, bare)]
    cases += [({"series": [{}]}, bare), ({"times_s": ["x"], "series": [{"cameras": {}}]}, bare)]
    cases += [({"cameras": {"forward": 4_000_001 * "x"}}, "too large")]
    cases += [({"series": 3}, apart), ({"cameras": {"forward": float("nan")}}, "")]
    for k, (data, words) in enumerate(cases):
        folder = rewritten(run_folder(tmp_path / f"run{k}", frame=bytes([k])), data)
        done = run("ingest", record, folder, "--time", "2026-03-05T03:05:00Z")
        assert (done.exit_code, words in done.stdout, "0 taken" in done.stdout) == (2, True, True), done.stdout
    assert status(record)["entries"] == 0


def watched(record: Path, what: Path, steps: list, monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """What is told while one thing more happens before each look."""

    def sleep(seconds: float) -> None:
        if not steps:
            raise KeyboardInterrupt
        steps.pop(0)()

    monkeypatch.setattr("twin.operate.__main__.time.sleep", sleep)
    result = run("ingest", record, what, "--watch", "--json")
    return list(map(json.loads, result.stdout.splitlines()))


def aged(path: Path, seconds: float = 60.0) -> None:
    os.utime(path, (time.time() - seconds,) * 2)


def test_watching_takes_what_comes_and_what_grows(
    record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each look one thing more has happened; a file that is still being written is left for the next look."""
    file = written(tmp_path, TELEMETRY, {"t_1.csv": table(0, 3)})

    def come(text: str, seconds: float) -> None:
        (tmp_path / "t_2.csv").write_text(text)
        aged(tmp_path / "t_2.csv", seconds)

    aged(tmp_path / "t_1.csv")
    steps = [
        lambda: come(table(3, 2)[:-9], 0),  # half a line
        lambda: come(table(3, 2), 50),
        lambda: None,
        lambda: come(table(3, 4), 40),
    ]
    *looks, total = watched(record, file, steps, monkeypatch)
    assert [(Path(one["file"]).name, one["new"], one["known"]) for one in looks] == [
        ("t_1.csv", 3, 0),
        ("t_2.csv", 2, 0),
        ("t_2.csv", 2, 2),
    ]
    assert (total["new"], total["refused"]) == (7, 0)


def test_watching_takes_run_folders_that_come(record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One whose name says its time; one that a table names before it is finished; one that nobody says the time of."""
    inbox = tmp_path / "inbox"
    inbox.mkdir()
    text = "instrument: gf7_pair\nreadings:\n  - {kind: monitor, files: passes.csv, time: UTC, name: run}\n"

    def come(name: str) -> None:
        aged(run_folder(inbox / name, frame=name.encode()) / "manifest.json")

    def name_a_run() -> None:
        written(inbox, text, {"passes.csv": "UTC,run\n2026-03-06T00:00:00Z,late\n"})
        aged(inbox / "passes.csv")

    steps = [
        lambda: come("recover-2026-03-05T03-05-00Z"),
        name_a_run,
        lambda: come("late"),
        lambda: come("recover-001"),
        lambda: None,
    ]
    *looks, total = watched(record, inbox, steps, monkeypatch)
    assert [(one["new"], [r["reason"] for r in one["refused"]]) for one in looks] == [
        (1, []),
        (0, [looks[1]["refused"][0]["reason"]]),
        (1, []),
        (0, [looks[3]["refused"][0]["reason"]]),
    ]
    assert "no reading in" in looks[1]["refused"][0]["reason"]
    assert "put the UTC into its name" in looks[3]["refused"][0]["reason"]
    assert (total["new"], total["refused"]) == (2, 2)
    with History(str(record)) as history:
        assert [row["time_utc"] for row in history.entries("monitor")] == [
            "2026-03-05T03:05:00Z",
            "2026-03-06T00:00:00Z",
        ]


@pytest.mark.parametrize(
    ("name", "utc"),
    [
        ("recover-2026-03-05T03-05-00Z", "2026-03-05T03:05:00Z"),
        ("20260305T030500.25Z-pass", "2026-03-05T03:05:00.25Z"),
        ("2026-03-05T03:05:00Z", "2026-03-05T03:05:00Z"),
        ("recover-2026-13-05T03-05-00Z", None),
        ("recover-2026-03-05", None),
    ],
)
def test_the_time_in_a_folders_name(name: str, utc: str | None) -> None:
    assert time_of_name(name) == (None if utc is None else micros(utc))


def test_an_interruption_says_what_is_kept(record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(tmp_path, TELEMETRY, {"t_1.csv": table(0, 3), "t_2.csv": table(3, 2)})
    take = History.ingest

    def interrupted(self: History, given: FileContent, late: bool = False):
        if given.file.endswith("t_2.csv"):
            raise KeyboardInterrupt
        return take(self, given, late)

    monkeypatch.setattr(History, "ingest", interrupted)
    result = run("ingest", record, file)
    assert (result.exit_code, "the files reported above are in the record" in result.stderr) == (130, True)
    assert status(record)["entries"] == 3


# --- what is refused -------------------------------------------------------------------------------------

KELVIN = TELEMETRY.replace("degC", "K")
EVENTS = "instrument: gf7_pair\nreadings: [{kind: event, files: t_1.csv, time: UTC, name: T}]\n"
PASSES = EVENTS.replace("event", "monitor")
REFUSED = [
    (KELVIN, b"2026-01-01T00:00:00Z,20.1", "273 K from the instrument's 293.15 K", "unit: degC"),
    (TELEMETRY, b"2026-01-01T00:00:00Z,293.2", "from the instrument's 293.15 K", "unit: K"),
    (TELEMETRY, b"2026-01-01T00:00:00Z,120.1", "from the instrument's 293.15 K", ""),
    (TELEMETRY, b"2026-01-01T00:00:00Z,-80.1", "from the instrument's 293.15 K", ""),
    (TELEMETRY, b"2026-01-01T00:00:00Z,warm", "not a number with a unit", ""),
    (TELEMETRY, b"01.02.2026 00:00,20.1", "not a date and time", "2011-03-05T03:05:00.25"),
    (TELEMETRY, b"2026-01-01T00:00:00Z,20.1,3", "3 cells under 2 heads", ""),
    (TELEMETRY, b"2026-01-01T23:59:60Z,20.1", "no leap second on this day", ""),
    (TELEMETRY, b'2026-01-01T00:00:00Z,"2\x000.1"', "", ""),
    (TELEMETRY, b"2026-01-01T00:00:00Z,\xff\xfe20.1", "", ""),
    (TELEMETRY, b"2026-01-01T00:00:00Z," + b"x" * 5000, "not a number", ""),
    (TELEMETRY, b"2" * 5000 + b",20.1", "not a date and time", ""),
    (TELEMETRY, b'2026-01-01T00:00:00Z,"20.1', "", ""),
    (TELEMETRY, b"2026-01-01T00:00:00Z," + b"2" * 200_000, "", ""),
    (TELEMETRY, b"2026-01-01T00:00:00Z,1e999", "", ""),
    (EVENTS, b"2026-01-01T00:00:00Z,safe_mod", "unknown event; did you mean 'safe_mode'?", ""),
    *((PASSES, b"2026-01-01T00:00:00Z," + x, "", "") for x in (b'"a\x00b"', b"x" * 5000, b"\xff", b"/", b"..", b'"')),
]
GOOD = {KELVIN: ["293.2", "392.9", "193.5"], TELEMETRY: ["20.2", "119.9", "-79.9"], EVENTS: ["refocus"], PASSES: []}
"""Of each table, cells that are taken."""


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_a_row_that_cannot_be_is_refused_and_the_others_are_taken(case: int, record: Path, tmp_path: Path) -> None:
    """With its line and in few words, whatever is in it."""
    text, row, *words = REFUSED[case]
    good = [f"2026-01-{k:02d}T00:10:00Z,{cell}".encode() for k, cell in enumerate(GOOD[text], 1)]
    file = written(tmp_path, text, {"t_1.csv": ""})
    (tmp_path / "t_1.csv").write_bytes(b"\n".join([b"UTC,T", row, *good, b""]))
    result = run("ingest", record, file, "--json")
    assert result.exit_code == 2
    (file,) = json.loads(result.stdout)["files"]
    (one,) = file["refused"]
    assert (file["new"], one["line"], len(one["reason"]) < 500 or text == PASSES) == (len(good), 2, True)
    assert all(word in one["reason"] for word in words), one["reason"]
    assert [(r["line"], r["reason"]) for r in status(record)["refused"]] == [(2, one["reason"])]


def test_a_place_that_cannot_be_written_is_told(record: Path) -> None:
    below = record / FILE / "below"
    for words, code, told in (
        (("init", below, "gf7_pair"), 2, "no folder can be made at"),
        (("export", record, "--out", below), 2, "cannot make the output folder"),
    ):
        done = run(*words)
        assert (done.exit_code, told in " ".join(done.stderr.split())) == (code, True), done.stderr


@pytest.mark.second
def test_a_refused_row_of_a_growing_table_counts_once(record: Path, tmp_path: Path) -> None:
    """One row before its time and one without a number; the table grows, and a copy of it lies elsewhere."""
    rows = ["2026-01-02T00:00:00Z,20.0", "2026-01-01T00:00:00Z,20.1", "2026-01-03T00:00:00Z,warm"]
    rows += [f"2026-01-{day:02}T00:00:00Z,20.0" for day in range(4, 9)]
    (tmp_path / "copy").mkdir()
    for count in range(3, len(rows) + 1):
        text = "UTC,T\n" + "\n".join(rows[:count]) + "\n"
        result = run("ingest", record, written(tmp_path, TELEMETRY, {"t_1.csv": text}), "--json")
        told = json.loads(result.stdout)
        assert (result.exit_code, told["refused"], told["refused_before"]) == (2, *((2, 0) if count == 3 else (0, 2)))
        assert len(told["files"][0]["refused"]) == 2  # told again: the file is not all taken
    run("ingest", record, written(tmp_path / "copy", TELEMETRY, {"t_1.csv": text}))
    held = status(record)
    assert (held["open"], held["entries"], sorted(one["line"] for one in held["refused"])) == (2, 6, [3, 4])


ATTACKS = INPUTS["attacks"]


@pytest.mark.second
@pytest.mark.parametrize("attached", [False, True])
@pytest.mark.parametrize("attack", ATTACKS)
def test_the_database_refuses_to_replace_rows(attack: str, attached: bool, record: Path) -> None:
    with History(str(record)) as history:
        history.ingest(given("a", temperatures(0, 3)))
    base = sqlite3.connect(":memory:" if attached else record / FILE)
    if attached:
        base.execute("ATTACH ? AS record", (str(record / FILE),))
    with pytest.raises(sqlite3.IntegrityError, match="a record is never altered"):
        base.execute(ATTACKS[attack].format(to="record." if attached else ""))
    base.close()
    held = status(record)
    assert (held["guarded"], held["altered"], held["entries_checked"]) == (True, [], 3)


def test_the_status_finds_what_was_altered_behind_the_guard(record: Path) -> None:
    """Triggers taken out of the schema, rows altered and removed, and the triggers put back: digests do not agree."""
    with History(str(record)) as history:
        history.ingest(given("a", temperatures(0, 700)))
    base = sqlite3.connect(record / FILE)
    guards = base.execute("SELECT * FROM sqlite_master WHERE type = 'trigger'").fetchall()
    base.execute("PRAGMA writable_schema = ON")
    base.execute("DELETE FROM sqlite_master WHERE type = 'trigger'")
    base.commit()
    base.close()
    base = sqlite3.connect(record / FILE)
    base.execute("UPDATE entry SET content = replace(content, '293.', '300.') WHERE id IN (1, 690)")
    base.execute("UPDATE entry SET time_utc = '2026-01-01T00:00:00Z' WHERE id = 695")
    base.execute("DELETE FROM entry WHERE id = 300")
    base.commit()
    result = run("status", record)
    assert "the triggers that protect the record were removed or changed" in " ".join(result.stdout.split())
    for row in guards:
        base.execute(row[4])
    base.commit()
    base.close()
    held = status(record)
    assert (held["guarded"], held["entries_checked"]) == (True, 500)
    assert [text.split(",")[0] for text in held["altered"]] == ["1 entry has been removed", "entry 690", "entry 695"]
    held = json.loads(run("status", record, "--check-all", "--json").stdout)
    assert held["entries_checked"] == 699
    assert [text.split(",")[0] for text in held["warnings"]][1:] == ["entry 1", "entry 690", "entry 695"]


def test_a_guard_that_is_not_there_is_told_by_kind_of_database() -> None:
    guards = [(True, "sqlite:///x"), (False, "sqlite:///x"), (False, "mysql://x")]
    said = [_record_warnings({"altered": [], "guarded": guarded, "record": url}) for guarded, url in guards]
    assert [len(one) for one in said] == [0, 1, 1]
    assert ("status --check-all" in said[1][0], "does not protect its rows" in said[2][0]) == (True, True)


@pytest.mark.parametrize("beaten", [1, 2])
def test_a_writer_that_another_beats_twice_is_told(beaten: int, record: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a database without a lock; once is tried again."""
    taken, errors = Ingest.ingest, [IntegrityError("", None, Exception("UNIQUE constraint\nfailed"))] * beaten

    def take(self: Ingest, file: FileContent) -> object:
        if errors:
            raise errors.pop()
        return taken(self, file)

    monkeypatch.setattr(Ingest, "ingest", take)
    with History(str(record)) as history:
        file = given("t", temperatures(0, 3))
        if beaten == 2:
            with pytest.raises(RecordFailed, match=r"^UNIQUE constraint failed$"):
                history.ingest(file)
        assert history.ingest(file).new == 3


def test_a_clock_that_runs_backwards(record: Path) -> None:
    first, second, third = temperatures(0, 3)
    with History(str(record)) as history:
        taken = history.ingest(given("t", [second, first, third]))
        assert taken.new == 2
        assert "the clock runs backwards: 2026-01-01T00:00:00Z after 2026-01-01T00:01:00Z" in taken.refused[0][1]
        # another body's clock is another one
        assert history.ingest(given("u", [replace(first, subject="base/forward/M1")])).new == 1


@pytest.mark.second
def test_a_late_reading_waits_for_who_knows(record: Path) -> None:
    early, late = temperatures(0, 1), temperatures(5, 1)
    with History(str(record)) as history:
        history.ingest(given("b", late))
        refused = history.ingest(given("a", early))
        assert refused.new == 0
        assert "--late takes it" in refused.refused[0][1]
        assert status(record)["open"] == 1
        assert history.ingest(given("a", early)).refused == refused.refused
        assert len(status(record)["refused"]) == 1  # told once, however often it is tried
        assert history.ingest(given("a", early), late=True).new == 1
    told = status(record)
    assert (told["entries"], told["open"], [one["taken_since"] for one in told["refused"]]) == (2, 0, [True])


@pytest.mark.parametrize("late", [False, True])
def test_other_numbers_of_a_moment_do_not_replace_those_that_are_there(record: Path, late: bool) -> None:
    (one,) = temperatures(0, 1)
    other = replace(one, content={**one.content, "values": [299.0]})
    with History(str(record)) as history:
        history.ingest(given("a", [one]))
        assert "has another reading of base" in history.ingest(given("b", [other]), late).refused[0][1]
        assert [content_of(row)["values"] for row in history.entries()] == [[293.0]]
        in_one = [replace(e, time=e.time + MINUTE) for e in (one, other)]
        assert "another reading of base" in history.ingest(given("c", in_one), late).refused[0][1]


def test_a_time_still_to_come_is_of_a_wrong_clock(tmp_path: Path) -> None:
    """A clock of the computer's may be a day behind, and no more; simulated readings come whenever they do."""
    (one,) = temperatures(0, 1)
    far = [replace(one, time=now() + round((24 + 0.2) * 3600e6))]
    with made(tmp_path / "real", simulated=False) as history:
        assert history.ingest(given("b", [replace(one, time=now() + round((24 - 0.2) * 3600e6))])).new == 1
        assert "is in the future" in history.ingest(given("a", far)).refused[0][1]
    with made(tmp_path / "simulated") as history:
        assert history.ingest(given("a", far)).new == 1


def test_every_transaction_is_on_the_disk_with_its_folder_before_it_is_over(record: Path) -> None:
    """SQLite's synchronous = EXTRA, a journal that is removed, foreign keys, and no functions from the schema."""
    with History(str(record)) as history, history.reading() as connection:
        wanted = {"synchronous": 3, "journal_mode": "delete", "foreign_keys": 1, "trusted_schema": 0}
        assert {name: connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in wanted} == wanted


def test_readings_of_another_instrument(record: Path, tmp_path: Path) -> None:
    other = run_folder(tmp_path / "other", config=resolve_with("gf7_pair_two").to_yaml())
    result = run("ingest", record, other, "--time", "2026-01-01T00:00:00Z")
    assert result.exit_code == 2
    assert "is of another instrument, gf7_pair_two" in result.stdout
    file = written(tmp_path, TELEMETRY.replace("gf7_pair", "gf7_pair_two"), {"t_1.csv": table(0, 1)})
    result = run("ingest", record, file)
    assert result.exit_code == 2
    assert re.search(r"telemetry\.yaml:1: instrument: tables of another instrument", result.stderr)
    silent = run_folder(tmp_path / "silent", config="test: {}\n")
    assert "does not name its instrument" in run("ingest", record, silent, "--time", "2026-01-01T00:00:00Z").stdout
    assert status(record)["entries"] == 0
    assert "not of gf7_pair_two" in run("init", record, "gf7_pair_two").stderr


@pytest.mark.second
def test_a_reading_against_other_reference_images(record: Path, tmp_path: Path) -> None:
    """Those of the earliest reading count, in a file and after it; the same images with a pixel less are the same."""

    def taken(name: str, hour: int, before: float | None, *words: str) -> tuple[int, str]:
        folder = run_folder(tmp_path / name, frame=name.encode(), before=before)
        done = run("ingest", record, folder, "--time", f"2026-03-05T{hour:02d}:00:00Z", *words)
        return done.exit_code, done.stdout

    assert taken("bare", 1, None)[0] == 0  # without spots there is nothing to compare
    with History(str(record)) as history:
        (entry,) = history.entries("monitor")
    shutil.rmtree(record)
    made(record).close()
    assert taken("first", 2, 47.5)[0] == 0
    assert taken("same", 3, 47.5 + 0.0001)[0] == 0
    code, said = taken("other", 4, 47.5014)
    assert code == 2
    assert "measured against other reference images than the reading of 2026-03-05T02:00:00Z" in said
    assert "1.4 sigma" in said
    assert taken("earlier", 1, 47.5014, "--late")[0] == 2
    told = status(record)
    assert (told["entries"], told["open"]) == (2, 2)
    base = content_of(entry)["numbers"]
    own = [Entry("monitor", "monitor", START + k * MINUTE, {"numbers": {**base, "spots": spots(40.0)}}) for k in (0, 1)]
    for k, axis in enumerate(("row", "column"), 1):  # one coordinate of two, by 1.4 sigma
        moved = json.loads(json.dumps(spots(40.0)))
        for spot in moved["forward"].values():
            spot["before"][axis] += 0.0014
        own.append(Entry("monitor", "monitor", START + (k + 1) * MINUTE, {"numbers": {**base, "spots": moved}}))
    shutil.rmtree(record)
    with made(record) as history:
        done = history.ingest(given("series", own))
    assert done.new == 2
    assert ["differ by 0.99 sigma" in reason for _, reason in done.refused] == [True, True]


def test_a_run_that_was_changed_is_refused(record: Path, tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run")
    (folder / "recovered.json").write_text((folder / "recovered.json").read_text().replace("1.0", "1.5"))
    result = run("ingest", record, folder, "--time", "2026-01-01T00:00:00Z")
    assert (result.exit_code, "changed since its run: recovered.json" in result.stdout) == (2, True)


def test_an_instrument_is_its_content(tmp_path: Path) -> None:
    """What is only said of it does not count; a prescription's number does."""
    plain = json.loads(json.dumps(pair().plain()))
    own = instrument_digest(plain["instrument"], plain["cameras"])
    assert own == digest_of_job(pair())
    assert instrument_digest({**plain["instrument"], "description": "another"}, plain["cameras"]) == own
    (name, camera), *_ = plain["cameras"].items()
    mirrors = {**camera["mirrors"], "M1": {**camera["mirrors"]["M1"], "radius": "-1.0 m"}}
    assert instrument_digest(plain["instrument"], {name: {**camera, "mirrors": mirrors}}) != own


BAD = INPUTS["telemetry_files"]


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_description_names_its_line(case: str, record: Path, tmp_path: Path) -> None:
    old, new, words, line = BAD[case]
    file = written(tmp_path, TELEMETRY.replace(old, new), {"t_1.csv": table(0, 1)})
    result = run("ingest", record, file)
    said = result.stdout if line is None else result.stderr
    assert (result.exit_code, words in said, line is None or f"yaml:{line}: " in said) == (2, True, True), said


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "an empty table"), (b"UTC,T,T\n", "more than one column 'T'"), (b"UTC,\xff\n", "allowed: a header row")],
)
def test_a_table_that_is_none_is_refused_as_a_whole(content: bytes, words: str, record: Path, tmp_path: Path) -> None:
    file = written(tmp_path, TELEMETRY, {})
    (tmp_path / "t_1.csv").write_bytes(content)
    result = run("ingest", record, file)
    assert (result.exit_code, words in result.stdout) == (2, True), result.stdout


def test_a_place_without_a_record() -> None:
    for place, words in (
        ("/nowhere/at/all", "error: no record at"),
        ("nodialect://x/y", "error: no such kind of database: nodialect"),
        ("a://b://c:d", "error: not an address of a database"),
        ("mysql+pymysql://x/y", "pip install -e"),
    ):
        result = run("status", place)
        assert (result.exit_code, words in result.stderr) == (2, True), result.stderr


# --- times -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["1999-12-31T23:59:28Z", "2016-12-31T23:59:59.999999Z", "2016-12-31T23:59:60.5Z", "2017-01-01T00:00:00Z"]
)
def test_times_read_back_to_the_microsecond(text: str) -> None:
    assert utc_text(micros(text)) == text


def test_times_count_leap_seconds() -> None:
    assert micros("2017-01-01T00:00:00Z") - micros("2016-12-31T23:59:59Z") == 2_000_000
    assert micros("2000-01-01T00:00:00", "TAI") == 0
    assert micros("2000-01-01T00:00:00", "TT") == -32_184_000


# --- nothing is altered ----------------------------------------------------------------------------------


def test_the_database_refuses_to_alter_a_record(record: Path) -> None:
    with History(str(record)) as history:
        history.ingest(given("a", [*temperatures(1, 1), *temperatures(0, 1)]))
        history.store_plan("plan.yaml", {"window": 60})
        history.raise_alarm(Alarm("jump", "base/forward/M2", START, "it jumped"))
        history.acknowledge(1, "Ann", "looked at")
        history.save_checkpoint("a" * 64, 0, START + 2 * MINUTE, 1, b"state")
    base = sqlite3.connect(record / FILE)
    names = [name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    full = [name for name in names if base.execute(f"SELECT count(*) FROM {name}").fetchone()[0]]
    given_once = {"entry", "refused", "source", "instrument", "record_schema", "plan", "alarm", "acknowledgement"}
    assert given_once | {"checkpoint"} == set(full)
    for name in given_once:
        for what in (f"DELETE FROM {name}", f"UPDATE {name} SET id = id + 1"):
            with pytest.raises(sqlite3.IntegrityError, match="a record is never altered"):
                base.execute(what)
    base.execute("DELETE FROM checkpoint")  # derived: it is made again
    base.close()


# --- versions --------------------------------------------------------------------------------------------


def test_a_record_of_another_version_is_left_alone(record: Path) -> None:
    base = sqlite3.connect(record / FILE)
    later = schema.VERSION + 1
    base.execute(f"INSERT INTO record_schema VALUES (9, {later}, '2030-01-01T00:00:00Z', 'x')")
    base.commit()
    base.close()
    for opened in (lambda: History(str(record)), lambda: initialise_record(str(record), pair())):
        with pytest.raises(NotARecord, match=f"has version {later}, this program needs"):
            opened()
