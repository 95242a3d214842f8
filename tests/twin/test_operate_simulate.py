"""Simulated lives: motions that go on as their laws say, readings that the record takes as any others, and the truth
beside it.
"""

import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.monitor.disturbances import TimeLaw
from scenes.models.disturbances import Component, DisturbancePrior, drawn_course
from scenes.specs.disturbances import TimeLawSpec
from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve_with
from tests.twin.commands import invoke
from tests.twin.study_bench import refusals
from twin.operate import simulation_run
from twin.operate.__main__ import app
from twin.operate.judged_life import covered, likely_shares
from twin.operate.record.entries import MICRO, micros
from twin.operate.record.history import History, content_of, initialise_record
from twin.operate.record.telemetry import MOST_DEPARTURE
from twin.operate.simulate import Life, Simulation, drawn_life, sensed_temperatures
from twin.operate.simulation_run import ingest_files
from twin.verify import app as verify

PLAN = EXAMPLES / "operation.yaml"
START = micros("2027-01-01T00:00:00Z")
DAY = 86_400.0
SAMPLES = 40_000
LARGEST = 6.0
"""Sampled covariances lie within so many of their standard deviations: one in 10^9 is beyond."""


def run(*words: object):
    return invoke(app, *words)


# --- what is drawn ---------------------------------------------------------------------------------------

AT = np.array([0.0, 0.4, 3.0, 10.0, 11.0, 30.0]) * DAY
LAWS = {
    "white": (TimeLawSpec(kind="white"), TimeLaw(white=True)),
    "constant": (TimeLawSpec(kind="constant"), TimeLaw()),
    "drift": (TimeLawSpec(drift="5 d"), TimeLaw(drift_s=5 * DAY)),
    "period": (TimeLawSpec(period="7 d"), TimeLaw(period_s=7 * DAY)),
    "drift, period": (TimeLawSpec(drift="9 d", period="7 d"), TimeLaw(drift_s=9 * DAY, period_s=7 * DAY)),
    "trend": (TimeLawSpec(trend="20 d", since="1 d"), TimeLaw(trend_s=20 * DAY, since_s=DAY)),
    "trend, period": (TimeLawSpec(trend="20 d", period="7 d"), TimeLaw(trend_s=20 * DAY, period_s=7 * DAY)),
    "relaxation": (TimeLawSpec(relaxation="6 d", since="2 d"), TimeLaw(relaxation_s=6 * DAY, since_s=2 * DAY)),
    "event": (TimeLawSpec(event="5 d"), TimeLaw(event=((5 * DAY, 1.0),))),
    "event, drift, period": (
        TimeLawSpec(event="5 d", drift="9 d", period="7 d"),
        TimeLaw(drift_s=9 * DAY, period_s=7 * DAY, event=((5 * DAY, 1.0),)),
    ),
    "jump": (TimeLawSpec(kind="jump"), TimeLaw(jump=True)),
}


@pytest.mark.parametrize("name", LAWS)
def test_courses_have_the_covariance_of_their_law(name: str) -> None:
    spec, law = LAWS[name]
    found = drawn_course(spec, AT, np.random.default_rng(4), SAMPLES)
    wanted = law.covariance(AT[:, None], AT)
    sample = found @ found.T / SAMPLES
    spread = np.sqrt((wanted**2 + np.outer(np.diag(wanted), np.diag(wanted))) / SAMPLES)
    # rounding alone where a covariance has no spread
    assert np.all(np.abs(sample - wanted) <= LARGEST * spread + 1e-12)


def two(law: TimeLawSpec, kind: str = "shift", correlation: float = 0.0, bodies: tuple[str, str] = ("a", "a")):
    """Two components of one cause with standard deviations of 2 and 3 um, or kelvin."""
    size = 1.0 if kind == "temperature" else 1e-6
    parts = tuple(
        Component("slip", body, kind, k, "origin", s * size)
        for k, (body, s) in enumerate(zip(bodies, (2, 3), strict=True))
    )
    return DisturbancePrior("some", parts, np.array([[1.0, correlation], [correlation, 1.0]]), (law, law))


def life(stated: DisturbancePrior, days: np.ndarray, seed: int, **more) -> Life:
    times = START + np.round(days * DAY * MICRO).astype(np.int64)
    return drawn_life(stated, times, START, seed, **{"causes": {}, **more})


def test_components_go_together_at_all_times_as_they_are_correlated() -> None:
    stated = two(TimeLawSpec(drift="1 d"), correlation=0.8)
    found = life(stated, np.arange(40_000.0), 3).amounts  # a day apart they know little of each other
    wanted = stated.covariance
    slack = LARGEST * np.sqrt(1.4 * 2.0 / len(found)) * np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert np.all(np.abs(found.T @ found / len(found) - wanted) < slack)  # 1.4: a sum over lags of exp(-2 n)


@pytest.mark.second
def test_steps_come_at_their_mean_rate_and_all_motions_of_a_body_step_together() -> None:
    stated = two(TimeLawSpec(jump="50 d"), correlation=0.5)
    days = np.linspace(0.0, 50_000.0, 1000)
    found = life(stated, days, 5)
    count = len(found.steps)
    assert abs(count - 1000) < LARGEST * math.sqrt(1000.0)
    sizes = np.array([step.sizes for step in found.steps])
    assert np.all(sizes != 0.0)
    assert np.corrcoef(sizes.T)[0, 1] == pytest.approx(0.5, abs=LARGEST * 0.75 / math.sqrt(count))
    assert np.allclose(sizes.std(axis=0), [2e-6, 3e-6], rtol=LARGEST / math.sqrt(2.0 * count))
    assert np.allclose(found.amounts[-1], sizes.sum(axis=0))
    assert np.all(np.diff([step.time for step in found.steps]) >= 0)
    bodies = life(two(TimeLawSpec(jump="50 d"), bodies=("a", "b")), days, 5).steps
    assert {step.body: tuple(np.flatnonzero(step.sizes)) for step in bodies} == {"a": (0,), "b": (1,)}
    assert life(two(TimeLawSpec(kind="jump")), days, 5).steps == ()


def test_an_event_makes_the_motions_of_its_causes_step_at_its_date() -> None:
    dates = [(START + 10 * MICRO, "safe_mode"), (START + 20 * MICRO, "refocus")]
    days = np.array([0.0, 9.9, 10.0, 15.0, 21.0]) / DAY
    found = life(two(TimeLawSpec(kind="constant")), days, 1, causes={"safe_mode": ["slip"]}, dates=dates)
    assert [(step.time, step.event) for step in found.steps] == [(START + 10 * MICRO, "safe_mode")]
    assert found.dates == tuple(dates)
    assert np.array_equal(found.amounts[2:] - found.amounts[:2][[1, 1, 1]], np.tile(found.steps[0].sizes, (3, 1)))
    assert np.all(found.steps[0].sizes)
    drawn = life(two(TimeLawSpec(kind="constant")), np.arange(100.0), 1, causes={"safe_mode": ["slip"], "refocus": []})
    assert sorted(name for _, name in drawn.dates) == ["refocus", "safe_mode"]
    assert all(START + 9.9 * DAY * MICRO <= moment <= START + 89.1 * DAY * MICRO for moment, _ in drawn.dates)


def test_coefficients_scale_what_temperatures_do_and_not_what_sensors_read() -> None:
    stated = two(TimeLawSpec(kind="white"), "temperature", bodies=("a", "b"))
    found = life(stated, np.arange(5.0), 1, coefficient_error=0.3)
    assert set(found.coefficients) == {"a", "b"}
    assert all(value != 0.0 for value in found.coefficients.values())
    assert np.allclose(found.acting, found.amounts * (1.0 + np.array(list(found.coefficients.values()))))
    assert np.array_equal(found.temperatures["b"], found.amounts[:, 1])
    every = np.array(
        [list(life(stated, np.arange(2.0), n, coefficient_error=0.3).coefficients.values()) for n in range(2000)]
    )
    assert every.std() == pytest.approx(0.3, rel=LARGEST / math.sqrt(2.0 * every.size))
    turned = life(two(TimeLawSpec(kind="white")), np.arange(5.0), 1, coefficient_error=0.3)
    assert np.array_equal(turned.acting, turned.amounts)


def test_what_one_cause_draws_does_not_depend_on_the_others() -> None:
    one = two(TimeLawSpec(drift="1 d"))
    other = Component("other", "c", "shift", 0, "origin", 1e-6)
    more = DisturbancePrior("more", (*one.components, other), np.eye(3), (*one.laws, TimeLawSpec(jump="1 d")))
    assert np.array_equal(life(one, np.arange(9.0), 2).amounts, life(more, np.arange(9.0), 2).amounts[:, :2])
    assert not np.array_equal(life(one, np.arange(9.0), 2).amounts, life(one, np.arange(9.0), 3).amounts)


def test_sensors_err_fall_silent_and_get_stuck() -> None:
    days = np.arange(2000.0)
    found = life(two(TimeLawSpec(drift="99 d"), "temperature", bodies=("a", "b")), days, 1)
    at = START + round(1000 * DAY * MICRO)
    what = Simulation(START, 2000 * DAY, DAY, 1, sensor_sigma=0.05, dead={"a": at}, stuck={"b": at})
    said = sensed_temperatures(293.0, what, found)
    assert np.array_equal(what.times, found.times)
    assert np.all(np.isnan(said["a"][1000:]))
    assert np.all(said["b"][1000:] == said["b"][999])
    error = np.concatenate([said[body][:1000] - 293.0 - found.temperatures[body][:1000] for body in "ab"])
    assert abs(error.mean()) < LARGEST * 0.05 / math.sqrt(error.size)
    assert error.std() == pytest.approx(0.05, rel=LARGEST / math.sqrt(2.0 * error.size))
    assert list(sensed_temperatures(293.0, Simulation(START, 1.0, 1.0, sensors=("b",)), found)) == ["b"]


# --- the command -----------------------------------------------------------------------------------------

BASE, FORWARD = "base", "base/forward"
WORDS = ("--from", "2027-01-01T00:00:00Z", "--days", 18, "--every", "6d", "--frames", 2, "--coefficient-error", "30%")
SENSORS = ("--sensor", BASE, "--sensor", FORWARD, "--dead", f"{BASE}@2027-01-05T00:00:00Z")
EVENTS = ("--event", "safe_mode@2027-01-08T12:00:00Z")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Mapping]:
    """Record, truth and what was told of a life of three readings."""
    folder = tmp_path_factory.mktemp("life")
    truth = folder / "truth.json"
    words = ("simulate", PLAN, folder / "record", *WORDS, *SENSORS, *EVENTS, "--truth", truth, "--json")
    done = run(*words)
    assert done.exit_code == 0, done.stderr
    return folder / "record", truth, json.loads(done.stdout)


def entries(record: Path) -> list[dict]:
    with History(str(record)) as history:
        return list(history.entries())


@pytest.mark.second
def test_a_life_is_a_record_as_any_other(made: tuple[Path, Path, Mapping]) -> None:
    record, truth, told = made
    found = entries(record)
    assert (told["readings"], told["entries"]) == (3, len(found))
    days = ["2027-01-01T00:00:00Z", "2027-01-07T00:00:00Z", "2027-01-13T00:00:00Z"]
    kinds = {subject: [one for one in found if one["subject"] == subject] for subject in {e["subject"] for e in found}}
    assert {subject: [one["time_utc"] for one in some] for subject, some in kinds.items()} == {
        "safe_mode": ["2027-01-08T12:00:00Z"],
        "monitor": days,
        BASE: days[:1],
        FORWARD: days,
    }
    warm = content_of(kinds[FORWARD][0])
    assert (warm["sigma"], warm["unit"]) == (0.05, "K")
    assert abs(warm["values"][0] - 293.0) < MOST_DEPARTURE
    numbers = content_of(kinds["monitor"][1])["numbers"]
    assert {"cameras", "intersection_angle", "spots", "disturbances", "sigma_holds", "frames"} <= set(numbers)
    assert numbers["frames"] == 2
    assert json.loads(run("status", record, "--json").stdout)["open"] == 0
    assert truth.is_file()
    assert {Path(one["file"]).name for one in found} == {"events.csv", "temperatures.csv", "passes.csv"}


def test_the_files_of_a_life_make_its_record_again(made: tuple[Path, Path, Mapping], tmp_path: Path) -> None:
    """The readings are those of its files; a second record that takes these holds the same."""
    record, _, told = made
    initialise_record(str(tmp_path / "again"), resolve_with("gf7_pair"), simulated=True)
    with History(str(tmp_path / "again")) as history:
        assert sum(one.new for one in ingest_files(history, Path(told["files"]) / "telemetry.yaml")) == told["entries"]
    assert [one["sha256"] for one in entries(tmp_path / "again")] == [one["sha256"] for one in entries(record)]


@pytest.mark.second
def test_the_files_of_a_life_are_made_again_and_verified(made: tuple[Path, Path, Mapping]) -> None:
    record, _, _ = made
    done = invoke(verify, record / "simulated")
    assert done.exit_code == 0, done.stdout + done.stderr
    assert "has the same numbers in all" in done.stdout


# --- what is made of it ----------------------------------------------------------------------------------


@pytest.mark.second
def test_a_life_is_followed_and_held_against_its_truth(made: tuple[Path, Path, Mapping], tmp_path: Path) -> None:
    record, truth, _ = made
    done = run("judge", record, "--truth", truth, "--out", tmp_path / "judged", "--json")
    assert done.exit_code == 0, done.stderr
    numbers, true = json.loads(done.stdout), json.loads(truth.read_text("utf-8"))
    assert numbers["times_utc"] == true["times_utc"]
    assert numbers["predictions"]["components"] == 24  # three readings of eight numbers
    own = numbers["quantities"]["forward"]["d_f_um"]
    # who keeps the calibration takes nothing to have changed
    assert np.allclose(own["ground"]["errors"], -np.array(true["cameras"]["forward"]["d_f_um"]), rtol=1e-3)
    assert own["ground"]["rms"] == pytest.approx(math.sqrt(np.mean(np.square(own["ground"]["errors"]))), rel=1e-3)
    for group in numbers["quantities"].values():
        for said in group.values():
            for way in ("single", "filtered", "smoothed"):
                ratio = np.abs(np.array(said[way]["errors"]) / np.array(said[way]["sigmas"]))
                assert np.max(ratio) < 5.0  # of 36 numbers that go together none is beyond five sigmas
                assert said[way]["within_two"] == np.mean(ratio <= 2.0)
            # at the last reading there is no later one
            assert said["filtered"]["errors"][-1] == said["smoothed"]["errors"][-1]
            assert said["forecast"]["known"] + said["forecast_over_events"]["known"] == 0  # of 18 days none is 30 ahead
    assert {one["body"]: one["state"] for one in numbers["sensors"]}[FORWARD] == "ok"
    assert (tmp_path / "judged/artefacts/with_and_without.svg").is_file()
    assert (tmp_path / "judged/report.html").is_file()


def test_shares_that_chance_allows() -> None:
    low, high = likely_shares(1000, 1.0)
    assert low < 0.6827 < high
    assert high - low == pytest.approx(2.0 * 3.29 * math.sqrt(0.6827 * 0.3173 / 1000), rel=0.05)  # normal limit
    assert likely_shares(0, 1.0) == (0.0, 1.0)
    assert covered(np.array([0.5, -1.5, 3.0, np.nan]), np.ones(4), 2.0) == (2, 3)


@pytest.mark.parametrize(
    ("truth", "told"),
    [(None, "no simulated life in"), ("gone.json", "no truth in"), ("other.json", "not the truth of")],
)
def test_what_is_no_life_is_not_judged(
    made: tuple[Path, Path, Mapping], tmp_path: Path, truth: str | None, told: str
) -> None:
    (tmp_path / "other.json").write_text("{}", "utf-8")
    place = tmp_path if truth is None else made[0]
    more = () if truth is None else ("--truth", tmp_path / truth)
    done = run("judge", place, *more, "--out", tmp_path / "judged")
    assert done.exit_code == 2
    assert told in done.stderr.replace("\n", " ")
    assert not (tmp_path / "judged").exists()


# --- what is refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("words", "told"), refusals("lives"))
def test_options_that_mean_nothing_are_told_before_anything_is_made(tmp_path: Path, words: tuple, told: str) -> None:
    place = words[0] if "://" in words[0] else tmp_path / "record"
    done = run("simulate", PLAN, place, *WORDS, *words[place == words[0] :])
    assert done.exit_code == 2
    assert told in done.stderr.replace("\n", " ")
    assert not (tmp_path / "record").exists()


def test_a_record_that_holds_readings_or_real_ones_is_refused(made: tuple[Path, Path, Mapping], tmp_path: Path) -> None:
    record, _, _ = made
    copy = shutil.copytree(record, tmp_path / "copy")
    assert run("init", tmp_path / "real", "gf7_pair").exit_code == 0
    cases = ((copy, "the record holds readings already"), (tmp_path / "real", "init --simulated makes such a record"))
    for place, words in cases:
        done = run("simulate", PLAN, place, *WORDS)
        assert (done.exit_code, words in " ".join(done.stderr.split())) == (2, True), done.stderr


@pytest.mark.second
def test_a_life_without_a_record_is_its_files_alone(tmp_path: Path) -> None:
    words = ("--from", "2027-01-01T00:00:00Z", "--days", 1, "--every", "6d", "--frames", 2)
    done = run("simulate", PLAN, *words, "--out", tmp_path / "files", "--truth", "none", "--json")
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["record"], told["entries"], told["readings"]) == (None, 0, 1)
    assert not (tmp_path / "files/life.json").exists()
    assert not (tmp_path / "none").exists()
    assert run("init", tmp_path / "record", "gf7_pair", "--simulated").exit_code == 0
    taken = json.loads(run("ingest", tmp_path / "record", tmp_path / "files/telemetry.yaml", "--json").stdout)
    assert (taken["new"], taken["refused"]) == (17, 0)  # a reading, 14 temperatures, two events


@pytest.mark.second
def test_readings_that_could_not_be_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the terminal, in the numbers and in the manifest; a life without any reading is refused."""
    simulation, words = simulation_run.simulate_record, (*WORDS[:3], 1, *WORDS[4:8])
    found: list = []
    when = micros("2027-01-01T06:00:00Z")

    def simulate_record(*what: object) -> object:
        found.append(found[0] if found else simulation(*what))
        return replace(found[0], lost=((when, "it misses"),))

    monkeypatch.setattr(simulation_run, "simulate_record", simulate_record)
    done = run("simulate", PLAN, *words, "--out", tmp_path / "files")
    lost = "no reading at 2027-01-01T06:00:00Z: it misses"
    assert f"warning: {lost}" in done.stdout
    assert json.loads((tmp_path / "files/manifest.json").read_text("utf-8"))["warnings"] == [lost]
    done = run("simulate", PLAN, *words, "--out", tmp_path / "more", "--truth", tmp_path / "no/truth.json")
    assert (done.exit_code, "--truth: " in done.stderr, "cannot be written" in done.stderr) == (2, True, True)
    assert run("init", tmp_path / "record", "gf7_pair", "--simulated").exit_code == 0
    taken = [SimpleNamespace(refused=((3, "no such body"),)), SimpleNamespace(refused=())]
    monkeypatch.setattr(simulation_run, "ingest_files", lambda *_: taken)
    done = run("simulate", PLAN, tmp_path / "record", *words, "--out", tmp_path / "refused")
    told = "1 simulated readings were refused, the first: no such body"
    assert (done.exit_code, told in " ".join(done.stderr.split())) == (2, True), done.stderr
    monkeypatch.setattr(
        simulation_run, "simulate_record", lambda *a: SimpleNamespace(readings=(), lost=((when, "it misses"),))
    )
    done = run("simulate", PLAN, *words, "--out", tmp_path / "none")
    said = " ".join(done.stderr.split())
    assert (done.exit_code, "the monitor can read no state; the first because: it misses" in said) == (2, True), said
    assert not (tmp_path / "none").exists()


def test_a_sensor_on_a_body_that_is_not_stated_to_get_warmer(tmp_path: Path) -> None:
    done = run("simulate", PLAN, tmp_path / "record", *WORDS, "--stuck", "base/forward/M7@2027-01-05T00:00:00Z")
    assert (done.exit_code, "--stuck: no such name" in done.stderr) == (2, True), done.stderr
    assert not any(tmp_path.iterdir())
    done = run("simulate", PLAN, tmp_path / "record", *WORDS, "--out", tmp_path)
    assert (done.exit_code, f"output folder {tmp_path} exists" in done.stderr.replace("\n", "")) == (2, True), (
        done.stderr
    )
    assert not any(tmp_path.iterdir())
