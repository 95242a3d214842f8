"""Bad readings, decisions on them, contradicted starts and laws that are too small, in a record."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.yaml.errors import Problem
from tests.twin.commands import invoke
from tests.twin.operation_records import given, life_of, monitor_entry, plan_of, record_of, temperature_entry
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.__main__ import app
from twin.operate.estimate import operation as operation_module
from twin.operate.estimate.alarms import alarms_of
from twin.operate.estimate.operation import Operation
from twin.operate.record.entries import Entry

BAD = 20
"""Number of the bad reading."""


@pytest.fixture(scope="module")
def known(tmp_path_factory, backend):
    """A plan, its instrument and what is stated to move."""
    plan = plan_of(tmp_path_factory.mktemp("plan"))
    experiment = MonitorExperiment(plan.model, backend)
    return plan, experiment, experiment.disturbances


def readings(known, seed: int, error: float, slips=None, scale: float = 1.0):
    """30 readings of a life of which the one number `BAD` has an error in one coordinate, px; and the life."""
    _, experiment, stated = known
    life = life_of(stated, 90.0, 3.0, seed, slips or {})
    life = replace(life, motions=scale * life.motions, changes=scale * life.changes)
    entries = [monitor_entry(experiment, stated, life, k, seed) for k in range(len(life.times))]
    place = entries[BAD].content["numbers"]["spots"]["forward"]["left"]["after"]
    place["row"] += error
    return entries, life


def off(operation: Operation, life, k: int) -> float:
    """The largest error over sigma now, of all quantities."""
    now = operation.follow().now
    return float(np.abs((now.values[0] - operation.model.rows @ life.changes[k]) / now.sigmas[0]).max())


@pytest.mark.second
def test_a_bad_reading_is_named_left_out_and_forgotten(known, tmp_path, monkeypatch) -> None:
    """With it, one reading later and at the end; the past is that of a record without it. What is kept in between does
    not matter, to the bit.
    """
    monkeypatch.setattr(operation_module, "EVERY", 5)
    monkeypatch.setattr(operation_module, "HEAD", 0)
    plan = known[0]
    entries, life = readings(known, 21, 3.0)
    history = record_of(tmp_path / "record", plan)
    for k in range(len(entries)):
        history.take(given(f"file{k}", entries[k : k + 1]))
        if k in (BAD - 1, BAD, BAD + 1):
            estimate = Operation(history, plan)
            told = estimate.follow()
            assert told.undecided == (k == BAD)
            assert any("may be bad" in doubt for doubt in told.warnings) == (k == BAD)
            assert off(estimate, life, k) < 5.0
    told = Operation(history, plan).follow()
    assert not told.jumps
    ((time, _, _, reason),) = told.left_out
    assert time == life.times[BAD]
    assert f"entry {BAD + 1}: the row of the spot forward/left is" in reason
    assert told.readings == len(entries) - 1
    assert any("taken for a bad one" in one.text for one in alarms_of(plan.operation, told))
    clean = record_of(tmp_path / "clean", plan)
    clean.take(given("clean", entries[:BAD] + entries[BAD + 1 :]))
    own, other = (Operation(one, plan).smoothed(life.times) for one in (history, clean))
    assert np.all(np.abs(own.values - other.values) < 1e-6 * other.sigmas)
    whole = record_of(tmp_path / "whole", plan)
    whole.take(given("whole", entries))
    assert Operation(whole, plan).follow().to_dict() == told.to_dict()


@pytest.mark.second
def test_a_slip_that_looks_like_an_error_is_taken_with_the_next_reading(known, tmp_path) -> None:
    """Far above what is stated of slips: set aside at first, and then neither left out nor forgotten."""
    plan, _, stated = known
    slip = next(k for k, label in enumerate(stated.labels) if "forward/M2 shift x" in label)
    entries, life = readings(known, 22, 0.0, {3.0 * BAD: {slip: 60.0}})
    history = record_of(tmp_path / "record", plan)
    history.take(given("all", entries))
    estimate = Operation(history, plan)
    told = estimate.follow()
    assert not told.left_out
    assert told.readings == len(entries)
    assert told.jumps[0].told_us <= life.times[BAD + 1]
    assert off(estimate, life, len(entries) - 1) < 5.0


def test_a_person_decides(known, tmp_path) -> None:
    """An entry is excluded and included again by entries that are added; no row goes, and the estimate follows."""
    plan = known[0]
    entries, _ = readings(known, 23, 3.0)
    place = str(tmp_path / "record")
    history = record_of(tmp_path / "record", plan)
    history.take(given("all", entries))
    rows = list(history.entries())
    before = Operation(history, plan).follow()
    done = invoke(app, "exclude", place, "6", "--why", "the base was turned")
    assert done.exit_code == 0, done.output
    without = Operation(history, plan).follow()
    assert without.readings == before.readings - 1
    assert "entry 6 was excluded: the base was turned" in [reason for *_, reason in without.left_out]
    clean = record_of(tmp_path / "clean", plan)
    clean.take(given("clean", entries[:5] + entries[6:]))
    assert np.array_equal(Operation(clean, plan).follow().now.values, without.now.values)
    assert "is excluded already" in invoke(app, "exclude", place, "6", "--why", "again").output
    assert invoke(app, "exclude", place, "999", "--why", "x").exit_code == 2
    assert invoke(app, "exclude", place, "6", "--why", " ").exit_code == 2
    assert invoke(app, "exclude", place, "6", "--include", "--why", "it was not").exit_code == 0
    assert Operation(history, plan).follow().to_dict() == before.to_dict()
    with pytest.raises(Problem, match="no such reading"):
        history.decide(len(entries) + 1, False, "a decision is no reading")
    history.decide(BAD + 1, True, "it moved so")
    assert Operation(history, plan).follow().readings == len(entries)
    assert [one for one in history.entries() if one["kind"] != "decision"] == rows
    assert len(list(history.entries("decision"))) == 3


def test_a_contradicted_start_stays_in_sigma(known, tmp_path) -> None:
    """All motions are twelve times as large as stated: the first readings say so, and sigma still does at the end."""
    plan = known[0]
    entries, _ = readings(known, 24, 0.0, scale=12.0)
    history = record_of(tmp_path / "record", plan)
    history.take(given("all", entries))
    estimate = Operation(history, plan)
    squares = estimate._unexplained(estimate.standing().first)
    start = operation_module.widening(np.zeros((30, 2)), [30], False, [(0, squares)])[0]
    assert start > 2.0
    told = estimate.follow()
    assert told.widened >= start
    assert any("contradict what is stated" in doubt for doubt in told.warnings)
    wide = estimate._widened_at(np.array([one.time for one in entries[12:20]]))
    assert np.all(wide >= start)


@pytest.mark.parametrize("together", [True, False])
def test_sensors_that_disagree_together_accuse_the_prior(known, tmp_path, together: bool) -> None:
    """A cycle ten times the stated in both cameras is no fault of two sensors; in one alone it is one of its sensor."""
    plan, experiment, stated = known
    life = life_of(stated, 90.0, 3.0, 25, {})
    out: list[Entry] = []
    for k, time in enumerate(life.times.tolist()):
        for camera in ("forward", "backward"):
            body = f"base/{camera}"
            kelvin = 293.15 + (20.0 * np.sin(0.35 * k) * (together or camera == "forward"))
            out.append(temperature_entry(body, time, kelvin + 0.05 * np.sin(17.0 * k)))
        out.append(monitor_entry(experiment, stated, life, k, 25))
    history = record_of(tmp_path / "record", plan)
    history.take(given("all", out))
    told = Operation(history, plan).follow()
    states = {one.body: one.state for one in told.sensors}
    assert told.too_small == (("heat",) if together else ())
    assert states == {"base/forward": "ok" if together else "doubtful", "base/backward": "ok"}
    assert any("disagree with heat" in doubt for doubt in told.warnings) == together
    texts = [one.text for one in alarms_of(plan.operation, told)]
    assert any("sensors of several bodies together" in text for text in texts) == together


@pytest.mark.second
def test_status_says_which_jumps_are_found(known, tmp_path) -> None:
    entries, _ = readings(known, 26, 0.0)
    history = record_of(tmp_path / "record", known[0])
    history.take(given("all", entries))
    power = Operation(history, known[0]).power()
    assert {one.body for one in power} == {
        f"base/{camera}/M{k}" for camera in ("forward", "backward") for k in (1, 2, 3)
    }
    for one in power:
        half, most = one.sizes[:, 0], one.sizes[:, 1]
        assert np.all(np.diff(half) <= 0.0)
        assert np.all((most > half) | np.isnan(most))
