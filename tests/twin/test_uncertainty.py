"""What limits a monitor, and whether its sigmas hold in images of random states: ``python -m twin.uncertainty``."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2, norm, t

from analysis.arrays import ARCSEC
from analysis.monitor import limits as theory
from analysis.monitor.monitor_formulas import GroundGeometry
from optics.geometry.tree import Motion
from optics.numerics.backend import load_backend
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.twin.commands import invoke
from tests.twin.study_bench import TEXTS, refusals
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import trace_truth
from twin.uncertainty import __main__ as command
from twin.uncertainty import coverage
from twin.uncertainty.coverage import FALSE, HALF_WIDTHS, Coverage, run_states
from twin.uncertainty.monitor_limits import BEST, expected_covariance, find_limits
from twin.uncertainty.uncertainty_numbers import STATES, uncertainty_numbers
from twin.uncertainty.uncertainty_report import uncertainty_report

FRAMES = 9
TOGETHER, SHAKEN = TEXTS["together"], TEXTS["shaken"]
"""Correlated disturbances, and a launch that brings one of three states' spots off their CCDs."""


@cache
def bench(instrument, disturbances):
    """The experiment and its limits."""
    told = disturbances if "\n" in disturbances else f"disturbances: {disturbances}\n"
    resolved = resolve_job(validate(JobSpec, parse_yaml(f"instrument: {instrument}\n{told}", "job.yaml")))
    experiment = MonitorExperiment(resolved, load_backend())
    return experiment, find_limits(experiment, expected_covariance(experiment, FRAMES), FRAMES)


def check_states(instrument, disturbances, count):
    """Coverage, errors and chi-square of random states; false alarms ``FALSE`` in each of the three."""
    experiment, limits = bench(instrument, disturbances)
    found = run_states(experiment, limits.quantities, count, FRAMES, seed=11)
    assert found.outliers == ()
    n, every = found.measured, found.measured == count
    tail = 0.5 * FALSE / (len(found.errors) * len(found.quantities))
    for name in found.errors:
        # sigmas of a reading are those of the limits, which no image was drawn for, but for the noise: that is the mean
        # of six states, which meet other pixels, and most of what is left of d_f with two beams, where it is 5 % low
        mean = np.sqrt(np.mean(found.sigmas[name] ** 2, axis=0))
        noisy = limits.splits[name].noise > 0.1 * limits.splits[name].sigma ** 2
        assert np.all(np.abs(mean / limits.splits[name].sigma - 1.0) < np.where(noisy, 0.1, 0.02))
        if every or name == BEST:
            square = n * found.ratio(name) ** 2
            assert np.all((square > chi2.ppf(tail, n)) & (square < chi2.isf(tail, n))), (name, found.ratio(name))
        if name != BEST:
            # the mean difference of squared errors, state by state: nothing is better beyond chance
            gap = found.errors[name] ** 2 - found.errors[BEST] ** 2
            spread = gap.std(axis=0, ddof=1) / np.sqrt(n)
            assert np.all(gap.mean(axis=0) > -t.isf(tail, n - 1) * spread), name
    assert (found.alarms <= found.alarm_limit, found.doubted) == (True, 0)
    if every:
        freedom, total = n * experiment.disturbances.spots.shape[0], float(np.sum(found.chi_square))
        assert chi2.ppf(0.5 * FALSE, freedom) < total < chi2.isf(0.5 * FALSE, freedom)
    return found


@pytest.mark.second
def test_sigmas_hold_in_a_few_states():
    found = check_states("gf7_pair", TOGETHER, 40)
    assert set(found.errors) >= {"paper_single", "derived", "model", "posterior"}
    # a sigma of the noise alone would not: it is a hundredth of the errors
    _, limits = bench("gf7_pair", TOGETHER)
    noise = np.sqrt(limits.splits[BEST].noise)
    assert np.all(found.rms(BEST) > 20.0 * noise)


@pytest.mark.second
def test_what_rests_on_the_stated_numbers(monkeypatch):
    """2 nm of coma of each mirror, that nobody measured: of the height's sigma they are three quarters of the
    elasticity, and twice as large they make it 1.8 times as large. Warnings of the instrument are the run's.
    """
    experiment, found = bench("gf7_pair", "orbit")
    monkeypatch.setattr(coverage, "MonitorExperiment", lambda *given: experiment)
    monkeypatch.setattr(coverage, "find_limits", lambda *given, **more: found)
    monkeypatch.setattr(coverage, "blur_warnings", lambda *given: ("blurred",))
    run = coverage.run_uncertainty(experiment.resolved, load_backend())
    assert run.warnings == ("blurred",)
    assert uncertainty_report(run).warnings[0] == "blurred"
    numbers = uncertainty_numbers(run)
    assert "blurred" in uncertainty_report(run).with_verdict(numbers)["warnings"]
    height = numbers["quantities"]["ground"]["height_m"]
    sigma, first = height["after"][BEST]["sigma"], height["elasticities"][0]
    assert (first["number"], first["value"], first["unit"]) == ("mirror_figure figure Z7", 2.0, "nm")
    assert first["elasticity"] == pytest.approx(0.756, abs=0.01)
    # sigma with the part of one number doubled: its square grows by three times the elasticity
    assert first["doubled"] == pytest.approx(sigma * np.sqrt(1.0 + 3.0 * first["elasticity"]))
    tail = height["student_t"]
    assert tail["half_width_997"] > 4.0 * tail["half_width_68"] > 4.0 * sigma
    assert 0.01 < tail["beyond_3_sigma"] < 0.1


@pytest.mark.second
def test_states_whose_spots_leave_their_ccd_are_left_out_and_counted():
    """As often as the linear model says, within binomial limits."""
    experiment, limits = bench("monitor_pair", SHAKEN)
    count = 24
    found = run_states(experiment, limits.quantities, count, 1, seed=2)
    lost = count - found.measured
    assert limits.outside > 0.1
    assert binom.ppf(1e-4, count, limits.outside) <= lost <= binom.isf(1e-4, count, limits.outside)
    assert len(found.chi_square) == found.measured == len(found.truth)


@pytest.mark.second
def test_every_state_has_noise_of_its_own():
    """Frames before and after of two states in equal light; whichever others are exposed with it."""
    experiment, _ = bench("gf7_pair", "orbit")
    light = np.stack([experiment.nominal_photons] * 2)
    frames = np.concatenate(coverage._exposed(experiment, light, 1, 5, np.array([0, 7])))
    for k in range(4):
        for other in range(k):
            assert np.mean(frames[k] == frames[other]) < 0.2
    alone = np.concatenate(coverage._exposed(experiment, light[:1], 1, 5, np.array([7])))
    np.testing.assert_array_equal(alone, frames[1::2])


@pytest.mark.second
def test_states_do_not_depend_on_how_many_are_drawn_at_once(monkeypatch):
    experiment, limits = bench("gf7_pair", "orbit")
    whole = run_states(experiment, limits.quantities, 6, 1, seed=3)
    monkeypatch.setattr("twin.uncertainty.coverage.CHUNK", 4)
    parts = run_states(experiment, limits.quantities, 6, 1, seed=3)
    np.testing.assert_array_equal(whole.truth, parts.truth)
    np.testing.assert_array_equal(whole.errors[BEST], parts.errors[BEST])
    other = run_states(experiment, limits.quantities, 6, 1, seed=4)
    assert np.all(other.errors[BEST] != whole.errors[BEST])


@pytest.mark.second
def test_sigmas_are_those_of_the_joint_normal_distribution():
    """Motions, shifts and noise as one normal distribution, conditioned on the shifts by dense matrices."""
    _, limits = bench("gf7_pair", TOGETHER)
    stated, rows = limits.disturbances, limits.rows
    motions = stated.correlation
    assert np.count_nonzero(motions - np.eye(len(motions))) > 10
    seen, asked = stated.spots, rows @ stated.parameters
    total = seen @ motions @ seen.T + limits.noise
    left = asked @ motions @ asked.T - asked @ motions @ seen.T @ np.linalg.solve(total, seen @ motions @ asked.T)
    np.testing.assert_allclose(limits.splits[BEST].sigma, np.sqrt(np.diag(left)), rtol=1e-6)
    np.testing.assert_allclose(limits.splits[BEST].sigma_before, np.sqrt(np.diag(asked @ motions @ asked.T)), rtol=1e-9)
    # four times the frames are a quarter of the noise; a share of the variance is left without any
    for name, noise in (("more_frames", 0.25 * limits.noise), ("no_noise", 1e-9 * limits.noise)):
        total = seen @ motions @ seen.T + noise
        other = asked @ motions @ asked.T - asked @ motions @ seen.T @ np.linalg.solve(total, seen @ motions @ asked.T)
        (remedy,) = (one for one in limits.remedies if one.name == name)
        np.testing.assert_allclose(remedy.sigma, np.sqrt(np.diag(other)), rtol=1e-4)
    np.testing.assert_allclose(limits.from_prior, np.diag(other) / np.diag(left), rtol=1e-4)
    # a motion that is known is one of zero variance, whatever goes with it
    label, sigma = next(iter(limits.sigma_if_known.items()))
    own = np.array([one == label for one in stated.labels])
    rest = motions - motions[:, own] @ np.linalg.pinv(motions[np.ix_(own, own)]) @ motions[own]
    total = seen @ rest @ seen.T + limits.noise
    known = asked @ rest @ asked.T - asked @ rest @ seen.T @ np.linalg.solve(total, seen @ rest @ asked.T)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(known)), rtol=1e-6)


def counted(factor=1.0, alarms=0, doubted=0):
    """Return what 400 states would give whose errors are ``factor`` times what their sigmas say."""
    quantities = bench("gf7_pair", "orbit")[1].quantities
    sigmas = np.tile(np.arange(1.0, len(quantities) + 1.0), (400, 1))
    errors = factor * np.random.default_rng(4).standard_normal(sigmas.shape) * sigmas
    levels = np.repeat([[0.68], [0.95]], len(quantities), axis=1)
    named = ({BEST: value} for value in (errors, sigmas, levels))
    return Coverage(quantities, 400, np.zeros(sigmas.shape), *named, np.ones(400), alarms, doubted)


def test_counts_of_random_states_are_held_against_the_binomial_distribution():
    assert pytest.approx(norm.ppf([0.84, 0.975])) == HALF_WIDTHS
    good = counted()
    errors, sigmas = good.errors[BEST], good.sigmas[BEST]
    assert good.rms(BEST) == pytest.approx(np.sqrt(np.sum(errors**2, axis=0) / 400))
    assert good.ratio(BEST) == pytest.approx(np.linalg.norm(errors / sigmas, axis=0) / 20.0)
    for level, share in enumerate((0.68, 0.95)):
        width = norm.ppf(0.5 + 0.5 * share)
        assert good.covered(BEST, level).tolist() == np.sum(np.abs(errors / sigmas) <= width, axis=0).tolist()
        # a chance of 1 % for all counts of two levels, with two ends each
        count = errors.shape[1]
        low, high = binom.interval(1.0 - 0.01 / (2 * count), 400, share)
        assert good.limits(BEST, level).tolist() == [[low] * count, [high] * count]
    # of 400 states one in a thousand is an alarm: of two there is a chance of 6 %, of more than three 0.1 %
    assert good.alarm_limit == binom.ppf(0.99, 400, 1e-3) == 2
    assert good.sigma_agrees
    told = STATES(good)["estimators"][BEST][good.quantities[1].group][good.quantities[1].key]
    assert [400.0 * told[f"covered_{level}"] for level in (68, 95)] == [good.covered(BEST, k)[1] for k in (0, 1)]
    assert (told["rms"], told["rms_over_sigma"]) == (good.rms(BEST)[1], good.ratio(BEST)[1])
    for other in (counted(1.25), counted(0.8), counted(alarms=3), counted(doubted=1)):
        assert not other.sigma_agrees
    assert counted(alarms=2).sigma_agrees
    assert {outlier[3] for outlier in counted(1.25).outliers} == {0.68, 0.95}


@pytest.mark.second
def test_doubts_about_random_states_are_warnings():
    """Each where it holds, and no other."""
    experiment, limits = bench("gf7_pair", "orbit")
    run = coverage.UncertaintyRun(experiment.resolved, replace(limits, outside=0.0), 1)
    assert uncertainty_report(run).warnings == ()
    assert uncertainty_report(replace(run, coverage=counted(alarms=2))).warnings == ()
    limits = run.limits
    for changes, text in (
        ({"limits": replace(limits, outside=0.3)}, "In 30.0 % of all states of the prior orbit a spot leaves"),
        ({"limits": replace(limits, without="no room")}, "it cannot be built: no room"),
        ({"coverage": counted(doubted=1)}, "in 1 of 400 random states spots differ from their calibration"),
        ({"coverage": counted(alarms=3)}, "in 3 of 400 random states the shifts contradict the prior"),
        ({"coverage": counted(1.25)}, "sigmas do not hold in the random states: posterior of"),
    ):
        (said,) = uncertainty_report(replace(run, **changes)).warnings
        assert text in said


@pytest.mark.second
def test_shares_add_up_to_the_variance():
    for disturbances in ("orbit", TOGETHER):
        _, limits = bench("gf7_pair", disturbances)
        for name, split in limits.splits.items():
            for q in range(len(limits.quantities)):
                lines = limits.lines(name, q)
                total = sum(share for _, share in lines) + split.noise[q] / split.sigma[q] ** 2
                assert total == pytest.approx(1.0, rel=1e-9)
                assert sum(share for _, share in limits.lines("", q)) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.second
def test_a_second_monitor_and_other_remedies_never_harm():
    experiment, _ = bench("gf7_pair", "orbit")
    limits = find_limits(experiment, expected_covariance(experiment, FRAMES), FRAMES, second_monitor=True)
    now = limits.splits[BEST].sigma
    found = {remedy.name: remedy.sigma for remedy in limits.remedies}
    assert set(found) == {"more_frames", "no_noise", "field_now", "field_day", "field_month", "second_monitor"}
    assert all(np.all(sigma <= now * (1 + 1e-9)) for sigma in found.values())
    # it sees other places of the mirrors: figures show, which noise does not explain
    assert np.all(found["second_monitor"] < 0.97 * now)
    assert limits.without == ""


def test_the_truth_on_the_ground_is_that_of_turned_rays(backend):
    """At the line's middle, by the traced changes of both cameras, whichever body it was that moved."""
    experiment, limits = bench("gf7_pair", "orbit")
    states = [
        {"base/forward": Motion(rotate=(3 * ARCSEC, 2 * ARCSEC, 1 * ARCSEC))},
        {"base/backward/M2": Motion(shift=(2e-6, 3e-6, 1e-6))},
        {"base/forward/focal_plane": Motion(shift=(5e-6, 5e-6, 0)), "base/backward": Motion(rotate=(0, 2 * ARCSEC, 0))},
    ]
    truth = trace_truth(experiment.instrument, backend, states)
    ground = experiment.ground
    assert isinstance(ground, GroundGeometry)
    error = truth.ground_error(ground)
    rows = {q.key: q.row for q in limits.quantities if q.group == theory.GROUND_GROUP}
    values = np.concatenate([[c.d_alpha, c.d_beta, c.d_gamma, c.d_f] for c in truth.cameras.values()])
    linear = np.stack([row @ values for row in rows.values()], axis=1)
    assert np.max(np.abs(error), axis=0).min() > 1.0
    np.testing.assert_allclose(error, linear, atol=1e-4 * np.abs(error).max())
    # plain: two stations from which the changed rays meet in the point, and the calibrated rays from there
    looks = [experiment.instrument.spec.cameras[name].look for name in truth.cameras]
    for k in range(len(states)):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for c, (look, incidence, far) in enumerate(zip(looks, ground.incidences_rad, ground.ranges_m, strict=True)):
            nominal = Rotation.from_euler("y", incidence).apply([0.0, 0.0, 1.0])
            turn = Rotation.from_euler("y", incidence - look)
            station = -far * turn.apply(truth.lines[c, 1 + k]) / np.linalg.norm(truth.lines[c, 1 + k])
            taken = turn.apply(truth.lines[c, 0])
            assert taken == pytest.approx(nominal, abs=1e-3)
            square = np.eye(3) - np.outer(taken, taken) / (taken @ taken)
            normal, right = normal + square, right + square @ station
        along, across, down = np.linalg.solve(normal, right)
        assert error[k] == pytest.approx([along, across, -down], abs=1e-7)


@pytest.mark.parametrize(("words", "found"), refusals("uncertainty"))
def test_bad_input_is_one_message(tmp_path, words, found):
    job = tmp_path / "job.yaml"
    job.write_text("instrument: gf7_pair\ndisturbances: none\n")
    result = invoke(command.app, *(word.format(job=job) for word in words), "--out", tmp_path / "out")
    assert result.exit_code == 2, result.output
    assert re.search(found, result.output.replace("\n", " ")), result.output
    assert not (tmp_path / "out").exists()


def test_disturbances_that_change_no_camera_leave_nothing_to_measure(monkeypatch):
    experiment, _ = bench("gf7_pair", "orbit")
    monkeypatch.setattr(coverage, "MonitorExperiment", lambda *given: experiment)
    monkeypatch.setattr(coverage, "expected_covariance", lambda *given: None)
    monkeypatch.setattr(coverage, "find_limits", lambda *given, **more: None)
    with pytest.raises(InputError, match="no disturbance of the prior changes a camera"):
        coverage.run_uncertainty(experiment.resolved, load_backend())
