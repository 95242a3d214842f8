"""What commands tell of an estimate, and the alarms that they raise: once each."""

import html
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import norm

from optics.numerics.backend import load_backend
from scenes.specs.operation import OperationSpec, RequirementSpec
from tests.twin.commands import invoke
from tests.twin.operation_records import START, entries_of, given, life_of, plan_of, record_of
from tests.twin.study_bench import REFUSED
from twin.framework.provenance import negative_verdicts
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.__main__ import app
from twin.operate.estimate.estimate_snapshot import Violation
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.operation_model import store_plan
from twin.operate.estimate.reported_estimate import (
    AGAIN,
    DetectedJump,
    FilterResult,
    RequirementStatus,
    SensorState,
    alarms_of,
    raise_alarms,
    with_current_interval,
)
from twin.operate.record.entries import MICRO, Entry, utc_text
from twin.operate.record.history import History

DAY = 86_400 * MICRO
EVERY, DAYS = 4, 120
SLIPPED = 62
"""Day of a slip that is far larger than what the mounts drift by from reading to reading."""
BODY = "base/backward/M2"
TABLE = """instrument: monitor_pair
readings:
  - {kind: temperature, files: t.csv, time: UTC, columns: {base/forward: {column: T, unit: K, sigma: 0.05 K}}}
"""


@pytest.fixture(scope="module")
def life(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a plan, and a record in which a mount slips and a sensor gets stuck; it keeps no plan."""
    folder = tmp_path_factory.mktemp("life")
    plan = plan_of(folder)
    experiment = MonitorExperiment(plan.model, load_backend())
    stated = experiment.disturbances
    assert stated is not None
    slip = stated.labels.index(f"{BODY} shift x")
    drawn = life_of(stated, DAYS, EVERY, 3, {SLIPPED: {slip: 60.0}})

    def sensor(body: str, k: int, kelvin: float) -> float:
        return 292.0 if k > 15 and body == "base/backward" else round(kelvin, 2)

    entries = entries_of((plan, experiment, stated), drawn, 3, sensor=sensor)
    entries.append(Entry("event", "safe_mode", START + 30 * DAY + DAY // 2, {}))
    entries.sort(key=lambda one: one.time)
    with record_of(folder / "record", plan) as history:
        assert not history.ingest(given("all", entries)).refused
    return folder


@pytest.fixture
def record(life: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(life / "record", tmp_path / "record"))


def run(*words: object) -> Any:
    return invoke(app, *words)


def said(*words: object) -> Any:
    done = run(*words, "--json")
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def filter_result(life: Path, tmp_path_factory: pytest.TempPathFactory) -> FilterResult:
    place = Path(shutil.copytree(life / "record", tmp_path_factory.mktemp("followed") / "record"))
    with History(str(place)) as history:
        return Operation(history, plan_of(life)).filter_readings()


# --- without a plan, and with one ------------------------------------------------------------------------


@pytest.mark.second
def test_without_a_plan_there_is_no_estimate(record: Path, life: Path) -> None:
    assert said("status", record)["estimate"] is None
    (line,) = (line for line in " ".join(run("status", record).stdout.split()).split(". ") if "no estimate" in line)
    assert (
        "no estimate: the record has no plan of operation; name one, or store one: python -m twin.operate init" in line
    )
    for words in (("forecast", record), ("ingest", record, life / "plan.yaml", "--report", life / "r.html")):
        done = run(*words)
        assert done.exit_code == 2
        assert "has no plan of operation" in done.stderr
    # one that is named counts for this command alone
    told = said("status", record, life / "plan.yaml")
    assert told["estimate"]["readings"] == DAYS // EVERY
    assert said("status", record)["estimate"] is None


def test_a_record_without_a_reading_of_the_monitor(life: Path, tmp_path: Path) -> None:
    plan = plan_of(life)
    with record_of(tmp_path / "record", plan) as history:
        store_plan(plan, life / "plan.yaml", history)
    assert said("status", tmp_path / "record")["estimate"] is None
    (tmp_path / "tm.yaml").write_text(TABLE)
    (tmp_path / "t.csv").write_text("UTC,T\n2026-06-25T06:00:00Z,293.1\n")
    ingest = ("ingest", tmp_path / "record", tmp_path / "tm.yaml", "--report", tmp_path / "r.html")
    for words, code in ((("forecast", tmp_path / "record"), 2), (ingest, 0)):
        done = run(*words)
        assert done.exit_code == code
        assert "the record has no reading of the monitor" in done.stderr


def test_status_tells_how_the_instrument_stands(record: Path, life: Path) -> None:
    assert run("init", record, "monitor_pair", "--plan", life / "plan.yaml").exit_code == 0
    done = run("status", record)
    assert done.exit_code == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert f"estimate at {utc_text(START + (DAYS - EVERY) * DAY)} from 30 readings of the monitor" in text
    assert f"jump of {BODY} between {utc_text(START + 60 * DAY)} and {utc_text(START + 64 * DAY)}: shift x" in text
    assert "sensors: 1 of 2 are in order" in text
    assert "base/backward: stuck since" in text
    assert "Δθ between the cameras 30 arcsec" in text
    assert "% within one sigma (68.3 % expected)" in text
    assert "2 alarms are open" in text
    told = said("status", record)
    assert told["open_alarms"] == 2
    assert {one["degrees_of_freedom"] for one in told["estimate"]["innovations"]} == {8}
    (size, *_) = told["estimate"]["jumps"][0]["sizes"]
    # 120 micrometres, and a jump is found with its size within 4 of its sigmas
    assert abs(size["size"] - 120.0) < 4.0 * size["sigma"]


# --- forecast --------------------------------------------------------------------------------------------


@pytest.mark.second
def test_a_forecast_begins_now_and_its_sigma_grows(record: Path, life: Path) -> None:
    run("init", record, "monitor_pair", "--plan", life / "plan.yaml")
    told, now = said("forecast", record), said("status", record)["estimate"]["now"]
    assert len(told["times_utc"]) == 5
    assert told["times_utc"][0] == now["times_utc"][0]
    assert told["times_utc"][-1] == utc_text(START + (DAYS - EVERY + 30) * DAY)
    key = "d_alpha_arcsec"
    assert told["forward"][key][0] == now["forward"][key][0]
    assert told["forward"][f"{key}_sigma"] == sorted(told["forward"][f"{key}_sigma"])
    (requirement,) = told["requirements"]
    angle = told["intersection_angle"]
    beyond = [
        2.0 - norm.cdf((30.0 - value) / sigma) - norm.cdf((30.0 + value) / sigma)
        for value, sigma in zip(angle["change_arcsec"], angle["change_arcsec_sigma"], strict=True)
    ]
    assert requirement["chances"] == pytest.approx(beyond, rel=1e-6, abs=1e-15)  # 1 - cdf cancels below 1e-16
    assert requirement["chances"][0] == requirement["chance_now"]
    assert (requirement["quantity"], requirement["limit"]) == ("intersection_angle change_arcsec", 30.0)
    until = said("forecast", record, "--until", "2026-07-01T00:00:00Z", "--steps", 2)
    assert until["times_utc"][2] == "2026-07-01T00:00:00Z"
    done = run("forecast", record)
    assert "forecast from 2026-06-25T00:00:00Z to 2026-07-25T00:00:00Z" in done.stdout
    assert "P(exceeded) of" in done.stdout


@pytest.mark.second
@pytest.mark.parametrize(("until", "text"), REFUSED["past_forecasts"])
def test_a_forecast_of_what_is_past(until: str, text: str, record: Path, life: Path) -> None:
    done = run("forecast", record, life / "plan.yaml", "--until", until)
    assert (done.exit_code, text in done.stderr) == (2, True), done.stderr


# --- alarms ----------------------------------------------------------------------------------------------


def test_ingest_raises_alarms_once(record: Path, life: Path, tmp_path: Path) -> None:
    run("init", record, "monitor_pair", "--plan", life / "plan.yaml")
    (tmp_path / "tm.yaml").write_text(TABLE)
    (tmp_path / "t.csv").write_text("time,T\n2026-06-25T06:00:00Z,293.1\n".replace("time", "UTC"))
    first = said("ingest", record, tmp_path / "tm.yaml", "--report", tmp_path / "r.html")
    assert first["new"] == 1
    page = (tmp_path / "r.html").read_text("utf-8")
    assert all(html.escape(one.removeprefix("alarm: ")) in page for one in first["alarms"])
    assert len(first["alarms"]) == 2
    assert any(f"{BODY} jumped between" in one for one in first["alarms"])
    (tmp_path / "t.csv").write_text("UTC,T\n2026-06-25T12:00:00Z,293.1\n")
    done = run("ingest", record, tmp_path / "tm.yaml")
    assert "alarm: " not in done.stdout
    assert len(said("alarms", record)["alarms"]) == 2


@pytest.mark.second
def test_a_page_is_written_anew_though_nothing_came(record: Path, life: Path, tmp_path: Path) -> None:
    run("init", record, "monitor_pair", "--plan", life / "plan.yaml")
    (tmp_path / "tm.yaml").write_text(TABLE)
    (tmp_path / "t.csv").write_text("UTC,T\n2026-06-25T06:00:00Z,293.1\n")
    assert len(said("ingest", record, tmp_path / "tm.yaml", "--report", tmp_path / "r.html")["alarms"]) == 2
    before = (tmp_path / "r.html").stat().st_mtime_ns
    assert said("ingest", record, tmp_path / "tm.yaml", "--report", tmp_path / "r.html")["alarms"] == []
    assert (tmp_path / "r.html").stat().st_mtime_ns > before
    done = run("ingest", record, tmp_path / "tm.yaml", "--report", tmp_path / "no" / "r.html")
    assert (done.exit_code, "r.html cannot be written" in done.stderr) == (1, True), done.stderr


def test_an_estimate_that_fails_does_not_hide_what_was_taken(record: Path, life: Path, tmp_path: Path) -> None:
    with History(str(record)) as history:
        content = plan_of(life).plain()
        content["operation"]["window"] = -1  # as of another program
        history.store_plan("plan.yaml", content)
    (tmp_path / "tm.yaml").write_text(TABLE)
    (tmp_path / "t.csv").write_text("UTC,T\n2026-06-25T06:00:00Z,293.1\n")
    done = run("ingest", record, tmp_path / "tm.yaml")
    assert done.exit_code == 0
    assert "1 taken" in done.stdout
    said_so = " ".join(done.stderr.split())
    assert "the readings are in the record, but the estimate cannot be computed: the record's plan" in said_so


@pytest.mark.second
def test_alarms_are_listed_and_acknowledged(record: Path, life: Path) -> None:
    run("status", record, life / "plan.yaml")
    assert "2 alarms are open, 2 in all" in run("alarms", record).stdout
    done = run("alarms", record, "--acknowledge", 2, "--by", "Ann", "--note", "after safe mode")
    assert done.exit_code == 0, done.stderr
    *_, last = done.stdout.splitlines()
    assert last.startswith("alarm 2")
    assert "(seen by Ann: after safe mode)" in last
    told = said("alarms", record)
    assert told["open"] == 1
    assert told["alarms"][1]["acknowledged"]["note"] == "after safe mode"
    assert "1 alarm is open" in run("status", record, life / "plan.yaml").stdout


@pytest.mark.parametrize(("words", "text"), REFUSED["unseen_alarms"])
def test_who_has_seen_which_alarm(words: tuple[object, ...], text: str, record: Path) -> None:
    done = run("alarms", record, *words)
    assert (done.exit_code, text in done.stderr) == (2, True), done.stderr


PLAN = OperationSpec(
    instrument="monitor_pair",
    disturbances="own",
    mission="87600 h",
    requirements=(RequirementSpec(quantity="forward d_f_um", limit="20 um"),),
)


def told_of(filter_result: FilterResult) -> Iterator[tuple[str, str]]:
    return ((one.kind, one.text) for one in alarms_of(PLAN, filter_result))


def clean(filter_result: FilterResult) -> FilterResult:
    """With nothing to be told of."""
    return replace(filter_result, requirements=(), jumps=(), sensors=(), innovations=())


@pytest.mark.second
def test_what_contradicts_the_plan_is_in_the_numbers(filter_result: FilterResult) -> None:
    calm = replace(clean(filter_result), sigma_inflation=1.0, too_many_jumps=False, bad_readings=((1, "x"), (2, "y")))
    good = calm.to_dict()
    assert (good["agrees"], good["warnings"]) == (True, [])
    for change, words in (
        ({"undecided": True}, "the newest reading may be an outlier: y; until then sigmas allow for both"),
        ({"bad_readings": ((1, "x"),) * 3}, "3 readings were rejected as outliers"),
        ({"understated_causes": ("heat", "mounts")}, "sensors of several bodies jointly disagree with heat, mounts"),
        ({"sigma_inflation": 1.01}, "all sigmas are inflated by a factor of 1.01"),
    ):
        (text,) = replace(calm, **change).warnings
        assert words in text
    bad = replace(clean(filter_result), sigma_inflation=2.5, too_many_jumps=True).to_dict()
    assert not bad["agrees"]
    assert [text.partition(";")[0] for text in bad["warnings"]] == [
        "the first or the latest readings contradict the prior",
        "0 jumps are more than the plan states: other motions, or larger ones, occur",
    ]
    assert negative_verdicts({"estimate": bad}) == ["estimate.agrees"]


def test_what_is_told_of_requirements(filter_result: FilterResult) -> None:
    one = RequirementStatus("forward d_f_um", "µm", 20.0, 0.95, 0.12, False, filter_result.time)
    soon = replace(one, chance_now=0.01, holds_now=True, breaks_us=filter_result.time + 3 * DAY)
    never = replace(soon, breaks_us=None)
    assert list(told_of(replace(clean(filter_result), requirements=(one, soon, never)))) == [
        ("broken", "Δf of forward exceeds 20 µm with a probability of 12 %; 5.0 % is allowed"),
        (
            "breaks",
            f"Δf of forward may exceed 20 µm (probability above 5.0 %) from "
            f"{utc_text(filter_result.time + 3 * DAY)[:10]} on",
        ),
    ]


def test_a_reading_that_contradicts_what_is_stated(filter_result: FilterResult) -> None:
    """The newest of several; the chance of a false alarm is spent by time, and a jump explains what came with it."""
    times = [filter_result.time - k * DAY for k in (4, 3, 2, 1)]
    own = clean(filter_result)
    # of eight coordinates 50 is exceeded with a chance of 4e-8; a day's share of 1e-3 in ten years is 2.7e-7
    seen = tuple((time, square, 8) for time, square in zip(times, (90.0, 50.0, 50.0, 8.0), strict=True))
    (found,) = alarms_of(PLAN, replace(own, innovations=seen))
    assert (found.kind, found.time) == ("contradiction", times[2])
    assert "chi-square 50 for 8 degrees of freedom, limit 45.7" in found.text
    assert found.content["degrees_of_freedom"] == 8
    assert list(alarms_of(PLAN, replace(own, innovations=tuple((t, 45.0, 8) for t in times)))) == []
    jump = DetectedJump("base/forward/M1", times[1], times[2], times[3], (), 30.0, 1e-9, {})
    kinds = [kind for kind, _ in told_of(replace(own, innovations=seen[1:], jumps=(jump,)))]
    assert kinds == ["jump"]
    # it explains the reading with which it was told, and not the last one before it
    for after, until, wanted in ((times[1], times[2], ["jump"]), (times[2], times[3], ["jump", "contradiction"])):
        one = replace(jump, after_us=after, detected_us=until)
        alone = tuple((time, 50.0 if time == times[2] else 8.0, 8) for time in times)
        assert [kind for kind, _ in told_of(replace(own, innovations=alone, jumps=(one,)))] == wanted


def test_an_undecided_reading_is_not_called_rejected(filter_result: FilterResult) -> None:
    bad = ((filter_result.time, "entry 1: far away; the next reading decides whether it is excluded"),)
    first = replace(clean(filter_result), bad_readings=bad, undecided=True, readings=0)
    ((_, text),) = told_of(first)
    assert text.startswith(f"the reading of {utc_text(filter_result.time)} may be an outlier: entry 1")
    assert first.readings_text == "0 readings of the monitor (and a newer one that may be an outlier)"
    later = replace(first, undecided=False, readings=1)
    ((_, text),) = told_of(later)
    assert text.startswith(f"the reading of {utc_text(filter_result.time)} was rejected as an outlier: entry 1")
    assert later.readings_text == "1 reading of the monitor"


def test_bodies_that_explain_a_jump_nearly_as_well_are_named(filter_result: FilterResult) -> None:
    """Within a difference of log likelihoods of three, and three of them at most."""
    (jump,) = filter_result.jumps
    many = {f"body{k}": 28.0 + k for k in range(5)}
    for rivals, named in (({"a": 27.1, "b": 26.9}, "a"), ({"b": 26.9}, ""), (many, "body0, body1, body2")):
        ((_, text),) = told_of(replace(clean(filter_result), jumps=(replace(jump, log_ratio=30.0, rivals=rivals),)))
        assert text.partition("; ")[2] == (f"{named} would explain it nearly as well" if named else "")


def test_what_goes_on_is_told_again_a_month_after_somebody_has_seen_it(
    record: Path, filter_result: FilterResult
) -> None:
    def raised(history: History, days: float) -> list[str]:
        time = filter_result.time + round(days * DAY)
        one = RequirementStatus("forward d_f_um", "µm", 20.0, 0.95, 0.12, False, time)
        seen = ((time - DAY, 5.0, 8), (time, 80.0, 8))
        sensor = SensorState("base/forward", "doubtful", time, time, "3 of the last 10 readings")
        span = Violation(one.quantity, one.limit, filter_result.time, time, 2, time, 19.0, 1.0, 0.12)
        now = replace(clean(filter_result), time=time, requirements=(one,), innovations=seen, sensors=(sensor,))
        now = replace(now, violations=(span,))
        return [alarm.kind for alarm in raise_alarms(history, PLAN, now)]

    assert AGAIN == 30 * DAY
    with History(str(record)) as history:
        assert raised(history, 0) == ["broken", "sensor", "contradiction"]
        assert raised(history, 0) == raised(history, 40) == []
        for k in (1, 2, 3):
            history.acknowledge(k, "Ann", "")
        assert raised(history, 0) == []
        assert raised(history, 29) == ["contradiction"]  # every reading is one of its own
        history.acknowledge(4, "Ann", "")
        assert raised(history, 30) == ["broken", "sensor", "contradiction"]


def test_a_past_violation_raises_one_alarm_with_its_span(record: Path, filter_result: FilterResult) -> None:
    """Spans of a requirement less than a month apart are one; one that lasted when its alarm was raised is not new."""
    end = filter_result.time - 100 * DAY
    first, second, third, other = (
        Violation("forward d_f_um", limit, end + day * DAY, end + day * DAY, 1, end + day * DAY, value, 0.5, 0.8)
        for day, value, limit in ((0, -20.4, 20.0), (10, 19.9, 20.0), (80, 20.1, 20.0), (11, 20.2, 10.0))
    )
    spans = other.appended_to(third.appended_to(second.appended_to(first.appended_to(()))))
    assert spans == (replace(first, until_us=second.until_us, readings=2), third, other)
    holds = RequirementStatus("forward d_f_um", "µm", 20.0, 0.95, 0.01, True, None)
    now = replace(clean(filter_result), requirements=(holds,))
    with History(str(record)) as history:
        lasting = replace(now, time=end, violations=(first,), requirements=(replace(holds, holds_now=False),))
        (alarm,) = raise_alarms(history, PLAN, lasting)
        assert alarm.time == end
        (alarm,) = raise_alarms(history, PLAN, replace(now, violations=spans))
        assert raise_alarms(history, PLAN, replace(now, violations=spans)) == []
    assert (alarm.kind, alarm.time) == ("broken", third.until_us)
    assert alarm.text.startswith(f"Δf of forward exceeded 20 µm at the reading of {utc_text(third.since_us)} with a")
    text = next(iter(told_of(replace(now, violations=spans))))[1]
    assert text == (
        f"Δf of forward exceeded 20 µm at 2 readings between {utc_text(end)} and {utc_text(end + 10 * DAY)} with a "
        f"probability above 5.0 %; the largest change was −20.40 ± 0.50 µm at {utc_text(end)}, beyond the limit with a "
        "probability of 80 %"
    )


def test_a_jump_whose_time_is_known_better_is_the_same(record: Path, filter_result: FilterResult) -> None:
    (jump,) = filter_result.jumps
    with History(str(record)) as history:
        assert [one.subject for one in raise_alarms(history, PLAN, replace(clean(filter_result), jumps=(jump,)))] == [
            BODY
        ]
        better = replace(jump, after_us=jump.after_us + DAY, until_us=jump.until_us - DAY)
        assert raise_alarms(history, PLAN, replace(clean(filter_result), jumps=(better,))) == []
        (row,) = history.alarms()
        text = with_current_interval(row, [better])["text"]
        assert text.startswith(f"{BODY} jumped {better.summary}")
        assert text != row["text"]
        assert with_current_interval(row, []) == with_current_interval(row, [replace(better, body="other")]) == row
        other = replace(jump, after_us=jump.until_us, until_us=jump.until_us + DAY)
        assert len(raise_alarms(history, PLAN, replace(clean(filter_result), jumps=(jump, other)))) == 1
        history.acknowledge(1, "Ann", "")
        assert raise_alarms(history, PLAN, replace(clean(filter_result), jumps=(jump, other))) == []
