"""The daily report of an instrument in operation: what it says first, what it lists, and that it needs nothing else."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binomtest

from scenes.yaml.errors import Problem
from tests.twin.commands import invoke
from tests.twin.operate_bench import COUNT, DAY, EVIL, HOUR, StandIn, filled, lived, monitor_entry
from tests.twin.policed_page import breaches
from tests.twin.record_bench import START, given, made
from twin.framework.page import report_page
from twin.operate import daily_report as daily
from twin.operate.__main__ import app
from twin.operate.daily_report import _warnings, daily_report, end_of_day, state_table
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.operation_model import stored_plan
from twin.operate.estimate.reported_estimate import percent
from twin.operate.overview import Overview, coverage, evenly_spaced, reading_span, readings, single_readings, trend
from twin.operate.record.entries import Alarm, Entry, micros, utc_text
from twin.operate.record.history import History, content_of, initialise_record


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory):
    with filled(tmp_path_factory.mktemp("record") / "record") as history:
        yield history


@pytest.fixture(scope="module")
def overview(history: History) -> Overview:
    return Overview.of(history, StandIn(history))


@pytest.fixture(scope="module")
def page(history: History, overview: Overview) -> str:
    made = daily_report(history, overview, end_of_day(None, overview.time))
    return report_page(made, ("twin.operate", "report", "record"))


def shown(page: str, words: str) -> bool:
    return words in re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))


@pytest.mark.second
def test_the_first_sentence_is_the_state_and_the_second_what_changed(history, overview):
    made = daily_report(history, overview, end_of_day(None, overview.time))
    first, second = made.verdict.split(". ", 1)[0], made.verdict
    assert first.startswith(
        "1 of 2 requirements does not hold: Δα of forward is 1.014 ± 0.050 arcsec, limit 0.4 arcsec"
    )
    assert second.endswith("One event was recorded and one alarm was raised on 2026-01-20.")
    assert first.endswith("; 1 alarm is open")
    assert made.unmet
    assert made.lead[0].startswith(
        "Δθ between the cameras may violate its requirement of 20 arcsec (probability above 5.0 %) from 2026-01-29 on"
    )
    assert any("alarm is open" in one for one in made.warnings)
    assert "all sigmas are inflated by a factor of 1.5" in made.warnings[0]
    for day, text in (
        ("2026-01-10", "Nothing happened on it"),
        ("2026-01-13", "One jump was detected and one alarm was raised on it"),
        ("2026-01-19", "One sensor became unreliable on it"),
    ):
        end = end_of_day(day, 0)
        assert overview.change_sentence(end - DAY, end, "on it") == text


@pytest.mark.parametrize(
    ("holds", "breaks", "opened", "first", "unmet"),
    [
        (True, None, 0, "Both requirements hold now", False),
        (True, None, 5, "5 alarms are open; both requirements hold now", True),
        (True, 36 * HOUR, 0, "Δα of forward may violate its requirement of 0.4 arcsec (probability above", True),
        (False, None, 2, "2 of 2 requirements do not hold", True),
    ],
)
def test_the_headline_leads_with_what_is_urgent(overview, holds, breaks, opened, first, unmet) -> None:
    result = overview.filter_result
    when = None if breaks is None else overview.time + breaks
    needs = [replace(one, holds_now=holds, breaks_us=when) for one in result.requirements]
    alarms = tuple({"acknowledged": None, "time_us": k, "text": "", "kind": "jump"} for k in range(opened))
    asked = replace(overview, filter_result=replace(result, requirements=needs), alarms=alarms)
    sentences = asked.headline()
    assert sentences[0].startswith(first)
    assert asked.unmet == unmet
    if breaks is not None:
        assert sentences[0].endswith(f" %) from {utc_text(when)[:10]} on")
        assert any(one.startswith("Both requirements hold now") for one in sentences[1:])
    elif opened and not holds:
        assert sentences[0].endswith("; 2 alarms are open")


def test_the_most_critical_requirement_is_the_next_to_be_violated(overview) -> None:
    """The soonest date decides, then the change plus its sigma over the limit; a present probability does not."""
    alpha, theta = overview.filter_result.requirements
    result, soon = overview.filter_result, overview.time + 3 * DAY
    for dates, named in (((None, soon), "Δθ"), ((soon, soon - DAY), "Δθ"), ((None, None), "Δα"), ((soon, soon), "Δα")):
        needs = [
            replace(one, holds_now=True, breaks_us=date, chance_now=chance)
            for one, date, chance in zip((alpha, theta), dates, (1e-9, 1e-12), strict=True)
        ]
        sentence = replace(overview, filter_result=replace(result, requirements=needs)).state_sentence()
        assert sentence.startswith(f"Both requirements hold now; the most critical: {named}")
    needs = [replace(one, holds_now=False) for one in (alpha, theta)]
    sentence = replace(overview, filter_result=replace(result, requirements=needs)).state_sentence()
    assert sentence.startswith("2 of 2 requirements do not hold; the worst: Δα of forward is 1.014 ±")


def test_the_table_has_every_quantity_with_its_requirement(overview):
    table = state_table(overview)
    assert len(table.rows) == len(overview.quantities)
    assert table.full is not None
    rows = {(row[0], row[1]): row for row in table.full.rows}
    broken = rows["forward", "Δα [arcsec]"]
    assert (broken[2], broken[3]) == pytest.approx((1.01375, 0.05))
    assert [str(cell) for cell in broken[4:]] == ["±0.4", "more than 99.9999", "1.0", "no", "violated"]
    holds = rows["angle between the cameras", "Δθ [arcsec]"]
    assert (holds[7], holds[8]) == ("yes", "2026-01-29")
    assert rows["ground", "height [m]"][4] == ""
    assert list(table.bands.values()) == ["forward", "backward", "angle between the cameras", "ground"]


@pytest.mark.second
def test_motions_are_those_of_most_sigmas_with_all_causes_together(history, overview):
    made = daily_report(history, overview, end_of_day(None, overview.time))
    (section,) = (one for one in made.sections if one.name == "motions")
    rows, days = section.artefacts[0].rows, (overview.time - START) / DAY
    assert len(rows) == 12
    best: dict[str, list[float]] = {}
    for k, one in enumerate(overview.operation.experiment.prior.components):
        own = best.setdefault(f"{one.name} [{one.unit}]", [0.0, 0.0])
        size = one.sigma / one.unit_size
        own[0] += 0.1 * days * size * (0.1 if k % 3 else 1.0)
        own[1] = np.hypot(own[1], np.sqrt(0.3) * size)
    for name, mean, sigma, ratio in rows:
        assert (float(mean), float(sigma)) == pytest.approx(best[name], rel=1e-9)
        assert float(ratio) == pytest.approx(best[name][0] / best[name][1])
    assert [float(row[3]) for row in rows] == sorted((float(row[3]) for row in rows), reverse=True)
    assert not any("temperature" in str(row[0]) for row in rows)


def test_the_page_needs_nothing_else_and_runs_nothing_that_a_text_brings(page):
    assert breaches(page) == []
    assert EVIL not in page
    assert "&lt;img src=x" in page
    assert not re.search(r'(src|href)="(?!#|data:)', page)


@pytest.mark.parametrize(
    ("age", "alarms", "states", "told"),
    [
        (DAY, 0, "ok", []),
        (
            2 * DAY,
            1,
            "ok stuck dead",
            [
                "the newest reading is 2 d older than the end of the day",
                "one alarm is open; the newest: alarm 0",
                "faulty sensors: body1 (stuck), body2 (dead)",
            ],
        ),
        (0, 3, "", ["3 alarms are open; the newest: alarm 0"]),
    ],
)
def test_what_a_reader_has_to_know_is_told_and_nothing_else(age: int, alarms: int, states: str, told: list) -> None:
    """A reading more than a day old, alarms that wait, sensors that fail; beside what the estimate warns of."""
    sensors = [SimpleNamespace(body=f"body{k}", state=state) for k, state in enumerate(states.split())]
    filter_result = SimpleNamespace(warnings=["doubt"], sensors=sensors)
    waiting = [{"text": f"alarm {k}"} for k in range(alarms)]
    overview = SimpleNamespace(filter_result=filter_result, time=0, open_alarms=lambda: waiting)
    assert _warnings(overview, age) == ("doubt", *told)


def test_of_many_rows_the_newest_are_shown_and_all_can_be_taken_away() -> None:
    """Forty on the page: the first of a table, which begins with the newest, and the last of what changed."""
    for count in (40, 41):
        rows = [[k] for k in range(count)]
        table = daily._newest("jumps", "Jumps", "In UTC.", ("k",), rows)
        assert table.rows == rows[:40]
        assert table.full is None or table.full.rows == rows
        assert table.caption == ("In UTC." if count == 40 else "The newest 40 of 41. In UTC.")
    changes = [SimpleNamespace(time=START + k * HOUR, text=f"change {k}", again=k == 5) for k in range(50)]
    section = daily._changed_section(SimpleNamespace(changed=lambda begin, end: changes), START, START + 3 * DAY)
    assert [one.split(": ")[1] for one in section.artefacts[0].points] == [f"change {k}" for k in range(10, 50)]


@pytest.mark.parametrize(("within", "count"), [(0, 10), (10, 10), (800, 1272), (1, 3), (0, 0)])
def test_intervals_are_the_exact_binomial_ones(within, count):
    found = coverage(1, within, count)
    exact = binomtest(within, count).proportion_ci(0.95, "exact") if count else SimpleNamespace(low=0.0, high=1.0)
    assert (found.low, found.high) == pytest.approx((exact.low, exact.high), abs=1e-12)
    assert np.isnan(found.share) == (count == 0)
    assert found.expected == pytest.approx(0.682689492, abs=1e-9)
    assert found.holds == (found.low <= found.expected <= found.high)


@pytest.mark.parametrize(
    ("chance", "text"),
    [
        (1.0, "more than 99.9999 %"),
        (1e-9, "less than 0.0001 %"),
        (0.5, "50 %"),
        (0.993, "99.30 %"),
        (0.99993, "99.9930 %"),
        (0.012, "1.2 %"),
    ],
)
def test_a_chance_is_told_apart_from_certainty(chance, text):
    assert percent(chance) == text


def test_a_day_is_a_date_of_utc():
    assert end_of_day("2026-01-02", 0) == micros("2026-01-03T00:00:00Z")
    assert end_of_day(None, START + HOUR) == micros("2026-01-02T00:00:00Z")
    # a leap second belongs to the day that it ends
    assert end_of_day("2016-12-31", 0) == micros("2017-01-01T00:00:00Z") - 1_000_000
    for bad in ("yesterday", "2026-13-01", "2026-01-02T00:00", "", "2026-1-2"):
        with pytest.raises(Problem):
            end_of_day(bad, 0)


def test_points_are_what_the_readings_say(history, overview):
    found = readings(history, START, START + 40 * DAY, 1000)
    assert len(found) == COUNT
    points = single_readings(found, overview.quantities)
    assert points.values[7, 0] == pytest.approx(0.14 + 0.3 * np.sin(4.9))
    assert points.sigmas[7, 0] == 0.3
    names = [(one.group, one.key) for one in overview.quantities]
    assert points.values[7, names.index(("intersection_angle", "change_arcsec"))] == pytest.approx(0.28)
    assert np.isnan(points.values[7, names.index(("ground", "height_m"))])


def test_of_many_readings_some_are_shown_and_the_newest_is_one(history):
    found = [one["time_us"] for one in readings(history, START, START + 40 * DAY, 25)]
    assert len(found) <= 25
    assert (START, found[-1]) == reading_span(history)
    assert len(set(np.diff(found))) == 1


def test_a_trend_has_times_at_both_sides_of_a_jump(history, overview):
    found = trend(history, overview, START, START + 30 * DAY)
    jump = overview.filter_result.jumps[0]
    assert {jump.after_us, jump.until_us} <= set(found.past.times.tolist())
    assert found.past.times[-1] == overview.time == found.future.times[0]
    assert found.future.times[-1] == START + 30 * DAY
    assert (np.diff(found.past.times) > 0).all()
    assert trend(history, overview, START, overview.time - DAY).future is None
    assert len(evenly_spaced(5, 5, 10)) == 1


def test_the_past_is_without_what_came_later_and_takes_nothing(tmp_path: Path):
    with filled(tmp_path / "record", 24) as history:
        until = START + DAY
        history.raise_alarm(Alarm("jump", "x", until, "then"))
        history.save_checkpoint("p", 1, until - HOUR, 99, b"early")
        history.save_checkpoint("p", 2, until + HOUR, 99, b"late")
        with History(str(tmp_path / "record"), until) as past:
            assert max(one["time_us"] for one in past.entries("monitor")) == until
            assert [one["text"] for one in past.alarms()] == ["then"]
            assert [one.content for one in past.checkpoints("p")] == [b"early"]
            assert not past.save_checkpoint("p", 3, until, 9, b"new")
            assert not past.raise_alarm(Alarm("jump", "y", until, "new"))
            assert past.drop_checkpoints("p", 0) == 0
            with pytest.raises(TypeError):
                past.ingest(given("more.csv", [monitor_entry(99)]))
        assert [one.content for one in history.checkpoints("p")] == [b"early", b"late"]


# --- of a record, by the command --------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def life(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return lived(tmp_path_factory.mktemp("life"))


def run(*words: object):
    return invoke(app, "report", *words)


@pytest.mark.second
def test_the_command_writes_the_report_of_the_newest_day(life, tmp_path):
    record, _ = life
    told = run(record, "--out", tmp_path / "r.html", "--json")
    assert told.exit_code == 0
    said = json.loads(told.stdout)
    page = (tmp_path / "r.html").read_text("utf-8")
    assert said["verdict"] in html.unescape(page)
    assert said["verdict"].startswith("1 alarm is open; the requirement holds: Δθ between the cameras is ")
    assert breaches(page) == []
    for words in ("base/backward/M2", "safe mode, which may step settling", "monitor_pair in operation, 2026-05-16"):
        assert shown(page, words), words
    with History(str(record)) as history:
        assert {one["kind"] for one in history.alarms()} == {"jump"}


@pytest.mark.second
def test_the_report_of_a_past_day_is_what_was_known_then(life, tmp_path):
    record, _ = life
    for day, jumps in (("2026-04-20", False), ("2026-04-25", True)):
        assert run(record, "--day", day, "--out", tmp_path / "r.html", "--force", "--quiet").exit_code == 0
        page = (tmp_path / "r.html").read_text("utf-8")
        assert shown(page, "Detected jumps") == jumps
        assert f"--day {day}" in page
    # a record that ended then says the same, to the last digit of the table of the state
    with History(str(record)) as history:
        end = end_of_day("2026-04-25", 0)
        with History(str(record), end) as past:
            then = state_table(Overview.of(past, Operation(past, stored_plan(history)))).content()
        initialise_record(str(tmp_path / "short"), stored_plan(history).model, True)
        with History(str(tmp_path / "short")) as short:
            rows = [one for one in history.entries() if one["time_us"] <= end]
            entries = [
                Entry(one["kind"], one["subject"], one["time_us"], content_of(one), None, one["origin"] or "")
                for one in rows
            ]
            assert not short.ingest(given("all", entries)).refused
            assert state_table(Overview.of(short, Operation(short, stored_plan(history)))).content() == then


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--day", "2026-3-1"], "--day: not a day"),
        (["--day", "2026-02-27"], "no reading of the monitor before the end"),
        (["nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_what_cannot_be_reported_is_told(life, tmp_path, words, said):
    out = tmp_path / "r.html"
    told = run(life[0], *words, "--out", out)
    assert told.exit_code == 2
    assert said in told.stderr
    assert not out.exists()


@pytest.mark.second
def test_a_place_that_cannot_be_written_and_a_record_without_a_plan_are_told(life, tmp_path, history):
    assert run(life[0], "--out", tmp_path / "no" / "r.html").exit_code == 1
    told = run(Path(history.url.removeprefix("sqlite:///")).parent)
    assert told.exit_code == 2
    assert "has no plan" in told.stderr
    made(tmp_path / "empty").close()
    told = run(tmp_path / "empty")
    assert (told.exit_code, "no reading of the monitor; ingest some first" in told.stderr) == (2, True), told.stderr
