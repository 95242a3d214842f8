"""The estimate of a record: it covers drawn lives, does not depend on how and when readings came, and tells what its
sensors are worth.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from scenes.yaml.errors import Problem
from tests.tiers import quick
from tests.twin.commands import invoke
from tests.twin.operation_records import (
    DAY,
    START,
    Life,
    entries_of,
    given,
    life_of,
    monitor_entry,
    plan_of,
    record_of,
    temperature_entry,
)
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.__main__ import app
from twin.operate.estimate import operation_filter as operation_module
from twin.operate.estimate.estimate_snapshot import EstimatorState, Scores, Sensor
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.reported_estimate import Course, alarms_of, beyond, inflation_factors
from twin.operate.operated_block import posterior
from twin.operate.record.entries import MICRO, Entry

KEYS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")


@pytest.fixture(scope="module")
def known(tmp_path_factory, backend):
    """A plan, its instrument and what is stated to move."""
    plan = plan_of(tmp_path_factory.mktemp("plan"))
    experiment = MonitorExperiment(plan.model, backend)
    return plan, experiment, experiment.disturbances


def followed(known, folder, entries: list[Entry], name: str = "record") -> Operation:
    history = record_of(folder / name, known[0])
    taken = history.ingest(given(name, entries))
    assert not taken.refused
    return Operation(history, known[0])


def motion(known, name: str) -> int:
    """The number of a motion."""
    return next(k for k, label in enumerate(known[2].labels) if name in label)


def off(estimate: Operation, life: Life, course: Course | None = None) -> np.ndarray:
    """Errors over sigma of a course, at all times of a life where none is given."""
    course = estimate.smoothed(life.times) if course is None else course
    true = life.changes[np.searchsorted(life.times, course.times)] @ estimate.model.rows.T
    return np.abs(course.values - true) / course.sigmas


@pytest.mark.second
def test_drawn_lives_are_covered(known, tmp_path) -> None:
    """Eight lives of 40 readings without a slip: the intersection angle, principal distances and turns, now, smoothed
    and 30 days ahead, counted within one and two sigma; lives are independent, times within one are not, so that the
    limit is that of one time of each life and quantity.
    """
    stated = known[2]
    inside: dict[str, list[np.ndarray]] = {"now": [], "smoothed": [], "ahead": []}
    for seed in range(8):
        life = life_of(stated, 150.0, 3.0, seed, {})
        until = replace(life, times=life.times[:40], motions=life.motions[:40], changes=life.changes[:40])
        estimate = followed(known, tmp_path, entries_of(known, until, seed), f"life{seed}")
        courses = (
            estimate.filter_readings().now,
            estimate.smoothed(life.times[20:21]),
            estimate.forecast(life.times[49:50]),
        )
        for found, course in zip(inside.values(), courses, strict=True):
            found.append(off(estimate, life, course)[0])
    for name, wrong in inside.items():
        ratio = np.array(wrong)
        count = len(ratio)
        for limit, share in ((1.0, 0.683), (2.0, 0.954)):
            # of any one quantity not fewer than by chance once in ten thousand times
            assert np.all((ratio < limit).sum(axis=0) >= binom.ppf(1e-4, count, share)), (name, limit)
        assert np.all(ratio < 6.0), name


@pytest.mark.second
def test_it_does_not_matter_how_readings_come(known, tmp_path, monkeypatch) -> None:
    """One by one with the estimate asked for in between, all at once, or some late: the same to the bit."""
    plan, _, stated = known
    monkeypatch.setattr(operation_module, "CHECKPOINT_READINGS", 5)
    life = life_of(stated, 60.0, 3.0, 3, {})
    entries = entries_of(known, life, 3)
    whole = followed(known, tmp_path, entries, "whole")
    result, past = whole.filter_readings().to_dict(), whole.smoothed(life.times).to_dict()
    history = record_of(tmp_path / "pieces", plan)
    for k in range(0, len(entries), 7):
        history.ingest(given(f"piece{k}", entries[k : k + 7]))
        if any(one.kind == "monitor" for one in entries[: k + 7]):
            Operation(history, plan).filter_readings()
    assert Operation(history, plan).filter_readings().to_dict() == result
    assert Operation(history, plan).smoothed(life.times).to_dict() == past
    history, estimate = record_of(tmp_path / "again", plan), None
    for k in range(0, len(entries), 7):
        history.ingest(given(f"piece{k}", entries[k : k + 7]))
        estimate = Operation(history, plan) if estimate is None else estimate.updated()
        assert estimate.estimator_state
    assert estimate is not None
    assert estimate.filter_readings().to_dict() == result
    assert estimate.smoothed(life.times).to_dict() == past
    history = record_of(tmp_path / "late", plan)
    late = [one for k, one in enumerate(entries) if k % 9 == 4]
    history.ingest(given("first", [one for one in entries if one not in late]))
    Operation(history, plan).filter_readings()
    estimate = Operation(history, plan)
    assert estimate.estimator_state
    history.ingest(given("late", late), late=True)
    assert Operation(history, plan).filter_readings().to_dict() == result
    assert estimate.updated().filter_readings().to_dict() == result


@pytest.mark.second
@pytest.mark.parametrize(("slips", "apart", "wider"), [(False, 0.2, 0.2), (True, 0.3, 2.0)])
def test_a_part_of_the_past_is_that_of_the_whole(
    known, tmp_path, monkeypatch, slips: bool, apart: float, wider: float
) -> None:
    """From where the estimate stood before it, and from the beginning: but for what jumps add that were not told, whose
    chances are found from the readings of the part, a fifth of sigma. Where jumps were told before it, one body of
    several made them by what is kept; for the whole, which is one normal, each may have had its share: sigma is wider.
    """
    stated = known[2]
    monkeypatch.setattr(operation_module, "CHECKPOINT_READINGS", 5)
    slip = motion(known, "forward/M2 shift z")
    life = life_of(stated, 120.0, 3.0, 4, {30.0: {slip: 4.0}, 80.0: {slip: -5.0}} if slips else {})
    estimate = followed(known, tmp_path, entries_of(known, life, 4))
    assert len(estimate.filter_readings().jumps) == 2 * slips
    whole = estimate.smoothed(life.times)
    for k in (5, 12, 25, 35, 39):
        part = estimate.smoothed(life.times[k : k + 1])
        assert np.all(np.abs(part.values[0] - whole.values[k]) < apart * whole.sigmas[k])
        ratio = whole.sigmas[k] / part.sigmas[0]
        assert np.all((ratio > 0.8) & (ratio < 1.0 + wider))


def test_times_of_a_pass_go_together(known, tmp_path) -> None:
    """Of each time the posterior is what `smoothed` says. Errors a minute apart are one error, and those of forty days
    are not; the difference of the angle over three days is known to what it is off by.
    """
    life = life_of(known[2], 90.0, 3.0, 8, {})
    estimate = followed(known, tmp_path, entries_of(known, life, 8))
    first = int(life.times[10]) + 3600 * MICRO
    times = [first, first + 60 * MICRO, int(life.times[11]) + 1, int(life.times[24]), int(life.times[-1]) + MICRO]
    found = posterior(estimate, times, [f"{one.group} {one.key}" for one in estimate.quantities])
    alone = estimate.smoothed(times[:-1])
    sigma = np.sqrt(np.einsum("tqtq->tq", found.covariance))
    assert np.allclose(found.mean[:-1], alone.values, rtol=0.0, atol=1e-7 * alone.sigmas.min())
    assert np.allclose(sigma[:-1], alone.sigmas, rtol=1e-6)
    share = np.einsum("tquq->tuq", found.covariance) / (sigma[:, None] * sigma)
    assert np.all(share[0, 1] > 0.99)
    assert np.all(np.abs(share[0, 3]) < 0.9)
    angle = found.names.index("intersection_angle change_arcsec")
    row = estimate.quantities[angle].row
    own = found.covariance[:, angle, :, angle]
    off = found.mean[3, angle] - found.mean[2, angle] - row @ (life.changes[24] - life.changes[11])
    assert abs(off) < 4.0 * np.sqrt(own[3, 3] + own[2, 2] - 2.0 * own[2, 3])
    cameras = posterior(estimate, times[3:])
    assert cameras.names[:4] == tuple(f"forward {key}" for key in KEYS)
    ahead = posterior(estimate, times[4:], ["forward d_f_um"])
    forecast = estimate.forecast(times[4:])
    assert ahead.mean[0, 0] == pytest.approx(forecast.values[0, 3], rel=1e-9)
    assert np.sqrt(ahead.covariance[0, 0, 0, 0]) == pytest.approx(forecast.sigmas[0, 3], rel=1e-6)
    said = found.to_dict()
    assert (said["mean"], said["covariance"]) == (found.mean.tolist(), found.covariance.tolist())
    for wrong in (times[::-1], [first, first]):
        with pytest.raises(Problem, match="out of order"):
            posterior(estimate, wrong)
    with pytest.raises(Problem, match="no such quantity"):
        posterior(estimate, times, ["forward d_g_um"])
    with pytest.raises(Problem, match="before the first reading"):
        posterior(estimate, [START - 1, START])


@pytest.mark.second
def test_a_slip_is_told_with_its_body(known, tmp_path) -> None:
    life = life_of(known[2], 120.0, 3.0, 5, {60.0: {motion(known, "backward/M2 shift z"): 4.0}})
    estimate = followed(known, tmp_path, entries_of(known, life, 5))
    (jump,) = estimate.filter_readings().jumps
    assert "base/backward/" in jump.body
    assert jump.after_us < START + 60 * DAY * MICRO <= jump.until_us
    assert np.all(off(estimate, life)[18:23] < 5.0)


@pytest.mark.second
def test_what_a_slip_does_to_the_line_is_said_with_its_sigma(known, tmp_path) -> None:
    """Of two spots a mirror's slip is read as another turn and another principal distance than the line has of it."""
    _, experiment, stated = known
    slip = motion(known, "forward/M2 shift z")
    life = life_of(stated, 60.0, 3.0, 13, {30.0: {slip: 4.0}})
    estimate = followed(known, tmp_path, entries_of(known, life, 13))
    (jump,) = estimate.filter_readings().jumps
    step = estimate.model.rows @ (4.0 * stated.parameters[:, slip])
    names = [f"{one.group} {one.key}" for one in estimate.quantities]
    for name, true in zip(names, step.tolist(), strict=True):
        _, changed, sigma = jump.line_changes[name]
        assert abs(changed - true) < 5.0 * sigma + 1e-9, name
    (one, *_) = jump.to_dict()["carried"]
    assert one["sigma"] == jump.line_changes[one["quantity"]][2]
    assert (one["share"], one["share_sigma"]) == (one["changed"] / one["read"], one["sigma"] / abs(one["read"]))
    assert [each["sigma"] for each in jump.to_dict()["sizes"]] == [sigma for *_, sigma in jump.sizes]
    # three mirrors can have moved the spots so, and they do not turn the line alike
    read, _, sigma = jump.line_changes["forward d_alpha_arcsec"]
    true = float(step[names.index("forward d_alpha_arcsec")])
    assert abs(read - true) > 0.1
    assert sigma > 0.05
    camera = experiment.cameras["forward"]
    shift = 4.0 * stated.spots[: len(camera.spot_jacobian), slip]
    alone = camera.parameter_jacobian @ np.linalg.lstsq(camera.spot_jacobian, shift, rcond=None)[0]
    read, _, _ = jump.line_changes["forward d_f_um"]
    assert read == pytest.approx(1e6 * alone[3], rel=0.05)


@pytest.mark.second
def test_an_event_steps_what_the_plan_says(known, tmp_path) -> None:
    """A slip at a known event is no alarm, and sigma before it is that of a life without."""
    life = life_of(known[2], 60.0, 3.0, 6, {31.0: {motion(known, "forward/M3 shift y"): 1.5}})
    event = Entry("event", "safe_mode", START + 31 * int(DAY) * MICRO, {}, None)
    estimate = followed(known, tmp_path, [*entries_of(known, life, 6), event])
    told = estimate.filter_readings()
    assert told.jumps == ()
    assert [(name, causes) for _, name, causes in told.events] == [("safe_mode", ("settling",))]
    assert np.all(off(estimate, life) < 5.0)


@pytest.mark.second
def test_sensors_that_die_or_repeat_themselves_are_named(known, tmp_path) -> None:
    """What heat does is 1.3 times the computed, one of two sensors dies, the other sticks: sigma covers."""
    stated = known[2]
    life = life_of(stated, 180.0, 3.0, 8, {})
    stuck: dict[str, float] = {}

    def sensor(body: str, k: int, kelvin: float) -> float | None:
        if body == "base/forward":
            return kelvin if k < 20 else None
        return kelvin if k < 30 else stuck.setdefault(body, kelvin)

    estimate = followed(known, tmp_path, entries_of(known, life, 8, 1.3, sensor))
    told = estimate.filter_readings()
    states = {one.body: one for one in told.sensors}
    assert states["base/forward"].state == "dead"
    assert states["base/backward"].state == "stuck"
    assert states["base/backward"].since_us == int(life.times[30])
    assert states["base/forward"].last_us == int(life.times[19])
    assert {(kind, subject) for _, kind, subject, _ in told.excluded} == {("temperature", "base/backward")}
    assert np.all(off(estimate, life) < 6.0)


@pytest.mark.second
def test_a_requirement_that_is_going_to_break(known, tmp_path) -> None:
    stated = known[2]
    life = life_of(stated, 60.0, 3.0, 9, {})
    estimate = followed(known, tmp_path, entries_of(known, life, 9))
    (found,) = estimate.filter_readings().requirements
    assert (found.quantity, found.unit, found.limit) == ("intersection_angle change_arcsec", "arcsec", 30.0)
    now = estimate.filter_readings().now
    column = [one.name for one in estimate.forecast([]).quantities].index("intersection_angle change_arcsec")
    chance = beyond(now.values[0, column], now.sigmas[0, column], 30.0)
    assert found.chance_now == pytest.approx(float(chance))
    tight = known[0].operation.requirements[0].model_copy(update={"limit": "1 mas"})
    plan = known[0].model_copy(update={"operation": known[0].operation.model_copy(update={"requirements": (tight,)})})
    (found,) = Operation(estimate.history, plan).filter_readings().requirements
    assert not found.holds_now
    assert found.breaks_us == int(life.times[-1])


@pytest.mark.second
def test_requirements_are_judged_at_every_reading(known, tmp_path) -> None:
    """Readings that come all at once leave the violations that the same readings show when they come one by one."""
    life = life_of(known[2], 60.0, 3.0, 9, {})
    entries, now = entries_of(known, life, 9), []
    history = record_of(tmp_path / "one_by_one", known[0])
    for time in life.times.tolist():
        history.ingest(given(str(time), [entry for entry in entries if entry.time == time]))
        now.append(Operation(history, known[0]).filter_readings().now)
    column = [one.name for one in now[0].quantities].index("intersection_angle change_arcsec")
    values, sigmas = (np.array([getattr(one, part)[0, column] for one in now]) for part in ("values", "sigmas"))
    worst = int(np.argmax(np.abs(values[:-1])))
    limit = 0.5 * (abs(values[worst]) + abs(values[-1]))
    tight = known[0].operation.requirements[0].model_copy(update={"limit": f"{limit} arcsec"})
    chances = beyond(values, sigmas, tight.largest)
    bad = np.flatnonzero(chances > 1.0 - tight.probability)
    assert 0 < len(bad)
    assert bad[-1] < len(values) - 1
    plan = known[0].model_copy(update={"operation": known[0].operation.model_copy(update={"requirements": (tight,)})})
    history = record_of(tmp_path / "at_once", plan)
    history.ingest(given("at_once", entries))
    result = Operation(history, plan).filter_readings()
    (span,) = result.violations
    assert (span.since_us, span.until_us) == (life.times[bad[0]], life.times[bad[-1]])
    assert (span.readings, span.worst_us) == (len(bad), life.times[worst])
    assert (span.value, span.sigma, span.chance) == pytest.approx((values[worst], sigmas[worst], chances[worst]))
    alarms = [alarm for alarm in alarms_of(plan.operation, result) if alarm.kind == "broken"]
    assert [alarm.time for alarm in alarms] == [span.until_us]


@pytest.mark.second
def test_times_that_nobody_knows_anything_of(known, tmp_path) -> None:
    stated = known[2]
    estimate = followed(known, tmp_path, entries_of(known, life_of(stated, 12.0, 3.0, 1, {}), 1))
    with pytest.raises(Problem, match="the time is before the first reading"):
        estimate.smoothed([START - MICRO])
    with pytest.raises(Problem, match="the time of the forecast is in the past"):
        estimate.forecast([START])
    history = record_of(tmp_path / "empty", known[0])
    with pytest.raises(Problem, match="no reading of the monitor"):
        Operation(history, known[0])


# --- sensors and scores by themselves ----------------------------------------------------------------------------


def test_a_sensor_is_dead_after_ten_of_its_intervals() -> None:
    sensor = Sensor("base")
    for k in range(5):
        sensor = sensor.updated(100 * k, 290.0 + 0.1 * k, 0.05)
    assert [sensor.state(now, True)[:2] for now in (1400, 1401)] == [("ok", 0), ("dead", 400)]
    assert Sensor("base").updated(0, 290.0, 0.05).state(10**15, True)[0] == "ok"  # of one reading there is no interval


@pytest.mark.parametrize(("step", "repeats"), [(0.1, 19), (0.01, 4), (1e-4, 3)])
def test_a_sensor_is_stuck_when_chance_does_not_repeat_it_so_often(step: float, repeats: int) -> None:
    """Rounded to a step, two readings of sigma 0.05 K agree with the chance erf(5 step / K): 0.52, 0.056 and 0.00056;
    to the power of the repeats, over all readings, at most 1e-4, and never before the third.
    """
    sensor = Sensor("base")
    for k in range(5):
        sensor = sensor.updated(k, 290.0 + step * k, 0.05)
    for k in range(repeats):
        assert not sensor.stuck
        sensor = sensor.updated(5 + k, sensor.value, 0.05)
    state, since, why = sensor.state(5 + repeats, True)
    assert (state, since, why.split()[0]) == ("stuck", 4, str(repeats + 1))
    assert not sensor.updated(99, 280.0, 0.05).stuck


def test_a_sensor_is_doubtful_when_three_of_its_last_ten_readings_are_far() -> None:
    sensor = Sensor("base")
    for white in (7.0, -6.01, 6.0):  # six standard deviations are not yet far
        sensor = sensor.with_residual(white)
    assert (sensor.outliers, sensor.state(0, True)[0]) == (2, "ok")
    sensor = sensor.with_residual(-8.0)
    assert [sensor.state(0, alone)[0] for alone in (True, False)] == ["doubtful", "ok"]
    for _ in range(7):
        sensor = sensor.with_residual(0.0)
    assert (sensor.outliers, len(sensor.recent)) == (2, 10)
    limit = np.sqrt(chi2.isf(1e-3, 4) / 4)  # a false alarm in a thousand
    for share, wrong in ((0.999, False), (1.001, True)):
        assert Sensor("base", recent=(share * limit,) * 4).disagrees == wrong
    assert not Sensor("base").disagrees


def test_scores_count_what_lies_within_and_its_mean_density() -> None:
    one = Scores().updated(np.array([0.5, -1.0, 1.0, 1.99, -2.0, 3.0]), -4.0).updated(np.array([0.0]), 2.0)
    assert (one.readings, one.components, one.within_one, one.within_two) == (2, 7, 2, 5)
    assert (one.log_score, one.chi_square) == (-1.0, pytest.approx(0.25 + 1.0 + 1.0 + 1.99**2 + 4.0 + 9.0))


def test_what_temperatures_explain_is_a_share_of_the_variance() -> None:
    whole, rest = np.random.default_rng(1).standard_normal((2, 9, 3)) + 5.0
    spread = np.stack([whole.sum(0), (whole**2).sum(0), rest.sum(0), (rest**2).sum(0)])
    found = EstimatorState(None, 0, Scores(9), scatter_sums=spread).explained
    assert found == pytest.approx(1.0 - np.var(rest, axis=0) / np.var(whole, axis=0), rel=1e-9)
    assert np.all(np.isnan(EstimatorState(None, 0, Scores(1), scatter_sums=spread).explained))


def test_sigma_is_as_wide_as_the_last_readings_ask_for() -> None:
    """The root of chi-square over its degrees of freedom, over 1, 3 or 10 readings, where chance does not explain it
    once in 3000 times; from a reading on what lasts.
    """
    calm = np.tile([8.0, 8.0], (12, 1))
    for share, wide in ((0.999, False), (1.001, True)):
        square = share * chi2.isf(1e-3 / 3, 8)
        found = inflation_factors(np.concatenate([calm, [[square, 8.0]]]), [12, 13], False)
        assert found == pytest.approx([1.0, np.sqrt(square / 8.0) if wide else 1.0])
    three = np.concatenate([calm, np.tile([20.0, 8.0], (3, 1)), calm])
    assert inflation_factors(three, [14, 15, 16], False) == pytest.approx([1.0, np.sqrt(60.0 / 24.0), 1.0])
    assert inflation_factors(three, [13, 14, 15], True) == pytest.approx([1.0, np.sqrt(60.0 / 24.0), 1.0])
    lasting = [(3, np.array([[80.0, 8.0]]))]
    assert inflation_factors(calm, [2, 3, 12], False, lasting) == pytest.approx([1.0, np.sqrt(10.0), np.sqrt(10.0)])
    assert inflation_factors(np.zeros((2, 2)), [2], False).tolist() == [1.0]
    assert beyond(np.array([0.0, 3.0]), np.array([1.0, 0.0]), 1.959964) == pytest.approx([0.05, 1.0], abs=1e-6)


# --- bad readings, decisions on them, contradicted starts ----------------------------------------------------------

BAD = 20
"""Number of the bad reading."""


def readings(known, seed: int, error: float, slips=None, scale: float = 1.0):
    """30 readings of a life of which the one number `BAD` has an error in one coordinate, px; and the life."""
    _, experiment, stated = known
    life = life_of(stated, 90.0, 3.0, seed, slips or {})
    life = replace(life, motions=scale * life.motions, changes=scale * life.changes)
    entries = [monitor_entry(experiment, stated, life, k, seed) for k in range(len(life.times))]
    place = entries[BAD].content["numbers"]["spots"]["forward"]["left"]["after"]
    place["row"] += error
    return entries, life


@pytest.mark.second
def test_a_bad_reading_is_named_left_out_and_forgotten(known, tmp_path, monkeypatch) -> None:
    """With it, one reading later and at the end; the past is that of a record without it. What is kept in between does
    not matter, to the bit.
    """
    monkeypatch.setattr(operation_module, "CHECKPOINT_READINGS", 5)
    monkeypatch.setattr(operation_module, "HEAD_READINGS", 0)
    plan = known[0]
    entries, life = readings(known, 21, 3.0)
    history = record_of(tmp_path / "record", plan)
    for k in range(len(entries)):
        history.ingest(given(f"file{k}", entries[k : k + 1]))
        if k in (BAD - 1, BAD, BAD + 1):
            estimate = Operation(history, plan)
            told = estimate.filter_readings()
            assert told.undecided == (k == BAD)
            assert any("may be an outlier" in doubt for doubt in told.warnings) == (k == BAD)
            assert np.all(off(estimate, life, told.now) < 5.0)
    told = Operation(history, plan).filter_readings()
    assert not told.jumps
    ((time, _, _, reason),) = told.excluded
    assert time == life.times[BAD]
    assert f"entry {BAD + 1}: the row of spot forward/left is" in reason
    assert told.readings == len(entries) - 1
    assert any("rejected as an outlier" in one.text for one in alarms_of(plan.operation, told))
    other = followed(known, tmp_path, entries[:BAD] + entries[BAD + 1 :], "clean").smoothed(life.times)
    assert np.all(np.abs(Operation(history, plan).smoothed(life.times).values - other.values) < 1e-6 * other.sigmas)
    assert followed(known, tmp_path, entries, "whole").filter_readings().to_dict() == told.to_dict()


@pytest.mark.second
def test_a_slip_that_looks_like_an_error_is_taken_with_the_next_reading(known, tmp_path) -> None:
    """Far above what is stated of slips: set aside at first, and then neither left out nor forgotten."""
    entries, life = readings(known, 22, 0.0, {3.0 * BAD: {motion(known, "forward/M2 shift x"): 60.0}})
    estimate = followed(known, tmp_path, entries)
    told = estimate.filter_readings()
    assert not told.excluded
    assert told.readings == len(entries)
    assert told.jumps[0].detected_us <= life.times[BAD + 1]
    assert np.all(off(estimate, life, told.now) < 5.0)


def test_a_person_decides(known, tmp_path) -> None:
    """An entry is excluded and included again by entries that are added; no row goes, and the estimate follows."""
    plan = known[0]
    entries, _ = readings(known, 23, 3.0)
    place, estimate = tmp_path / "record", followed(known, tmp_path, entries)
    history, before = estimate.history, estimate.filter_readings()
    rows = list(history.entries())
    done = invoke(app, "exclude", place, "6", "--why", "the base was turned")
    assert done.exit_code == 0, done.output
    without = Operation(history, plan).filter_readings()
    assert without.readings == before.readings - 1
    assert "entry 6 was excluded: the base was turned" in [reason for *_, reason in without.excluded]
    clean = followed(known, tmp_path, entries[:5] + entries[6:], "clean").filter_readings()
    assert np.array_equal(clean.now.values, without.now.values)
    assert "is excluded already" in invoke(app, "exclude", place, "6", "--why", "again").output
    assert invoke(app, "exclude", place, "999", "--why", "x").exit_code == 2
    assert invoke(app, "exclude", place, "6", "--why", " ").exit_code == 2
    assert invoke(app, "exclude", place, "6", "--include", "--why", "it was not").exit_code == 0
    assert Operation(history, plan).filter_readings().to_dict() == before.to_dict()
    with pytest.raises(Problem, match="no such reading"):
        history.decide(len(entries) + 1, False, "a decision is no reading")
    history.decide(BAD + 1, True, "it moved so")
    assert Operation(history, plan).filter_readings().readings == len(entries)
    assert [one for one in history.entries() if one["kind"] != "decision"] == rows
    assert len(list(history.entries("decision"))) == 3


@pytest.mark.second
def test_a_contradicted_start_stays_in_sigma(known, tmp_path) -> None:
    """All motions are twelve times as large as stated: the first readings say so, and sigma still does at the end."""
    entries, life = readings(known, 24, 0.0, scale=12.0)
    estimate = followed(known, tmp_path, entries)
    squares = estimate._unexplained(estimate.estimator_state.first_innovations)
    start = operation_module.inflation_factors(np.zeros((30, 2)), [30], False, [(0, squares)])[0]
    assert start > 2.0
    told = estimate.filter_readings()
    assert told.sigma_inflation >= start
    plain = estimate.estimator_state.filter_state
    _, covariance = estimate.model.series_filter.parameters_of(plain.mean, plain.covariance, plain.time)
    assert np.allclose(told.now.covariance[0], told.sigma_inflation**2 * covariance, rtol=1e-9)
    assert np.all(off(estimate, life) < 6.0)
    assert any("contradict the prior" in doubt for doubt in told.warnings)
    wide = estimate._sigma_inflation_at(np.array([one.time for one in entries[12:20]]))
    assert np.all(wide >= start)


@pytest.mark.parametrize("together", quick(1, [True, False]))
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
    told = followed(known, tmp_path, out).filter_readings()
    states = {one.body: one.state for one in told.sensors}
    assert told.understated_causes == (("heat",) if together else ())
    assert states == {"base/forward": "ok" if together else "doubtful", "base/backward": "ok"}
    assert any("disagree with heat" in doubt for doubt in told.warnings) == together
    texts = [one.text for one in alarms_of(plan.operation, told)]
    assert any("sensors of several bodies jointly" in text for text in texts) == together


@pytest.mark.second
def test_status_says_which_jumps_are_found(known, tmp_path) -> None:
    power = followed(known, tmp_path, readings(known, 26, 0.0)[0]).power()
    assert {one.body for one in power} == {
        f"base/{camera}/M{k}" for camera in ("forward", "backward") for k in (1, 2, 3)
    }
    for one in power:
        half, most = one.sizes[:, 0], one.sizes[:, 1]
        assert np.all(np.diff(half) <= 0.0)
        assert np.all((most > half) | np.isnan(most))
