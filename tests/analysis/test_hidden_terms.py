"""What an adjustment leaves out: score tests against adjustments that know, false alarms, stated walks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from analysis.calibration.adjustment import FALSE_ALARM, Steps, adjust
from analysis.orbit.calibration_parameters import CalibrationError, Prior, Unknowns
from tests.analysis.test_adjustment import HOLD_XY, LABORATORY, NOISE, measured, seen, truth
from tests.analysis.test_three_line_model import ARCSEC, PITCH

VIEW = seen(1, 40)


def turned(field, course):
    """Measured attitude with a course of errors: seconds (n,) to rotation vectors (n, 3)."""
    rays = {
        k: replace(r, attitude=r.attitude @ Rotation.from_rotvec(course(r.time)).as_matrix())
        for k, r in field.rays.items()
    }
    return replace(field, rays=rays)


def random_walk(rng, sigma, first=-50.0, last=50.0, step=0.01):
    time = np.arange(first, last, step)
    values = np.cumsum(sigma * np.sqrt(step) * rng.standard_normal((len(time), 3)), axis=0)
    values -= values[len(time) // 2]
    return lambda t: np.stack([np.interp(t, time, v) for v in values.T], axis=-1)


def test_the_effect_of_a_rate_is_that_of_a_pass_that_drifts():
    """Exact points: the estimates move by what `moved` says, to second order; the estimate is the rate."""
    rate = 0.01 * ARCSEC * np.array([1.0, -0.7, 0.4])
    still, drifting = (
        adjust([f], LABORATORY, NOISE, gauge=HOLD_XY)
        for f in (measured(VIEW), turned(measured(VIEW), lambda t: t[:, None] * rate))
    )
    # the unknown goes from the measured attitude to the true one
    change = still.rates.moved @ -rate
    sigma = np.sqrt(np.diag(still.covariance))
    free = sigma > 0
    assert np.abs(change / np.where(free, sigma, 1.0)).max() > 0.5
    # biases of 90 arcsec times turns of 0.3 arcsec are the second order
    error = (drifting.values - still.values - change)[free] / sigma[free]
    assert np.abs(error).max() < 5e-3
    assert drifting.rates.estimate == pytest.approx(-rate, rel=1e-2)
    assert drifting.rates.chi_square == pytest.approx(
        drifting.chi_square - solved_for(turned(measured(VIEW), lambda t: t[:, None] * rate)).chi_square, rel=1e-2
    )


def solved_for(field, sigma=1e3 * ARCSEC, noise=NOISE):
    """With a rate of the field as an unknown."""
    priors = [Prior({f"Beijing {n} rate": 1.0}, 0.0, sigma) for n in ("roll", "pitch", "yaw")]
    return adjust([field], LABORATORY, noise, gauge=HOLD_XY, unknowns=Unknowns(rate="field"), priors=priors)


@pytest.mark.second
def test_a_random_walk_shows_in_the_residuals_and_stated_it_is_in_the_sigmas():
    """Ten passes, 1 arcsec in a root of a second: silent sigmas are 10 wrong, residuals tell every time; stated, the
    interior's errors have their sigmas (chi-square, false alarm 1e-4), and the component of variance finds the walk."""
    rng, total, blind_total, size = np.random.default_rng(8), 0.0, 0.0, 0
    noise = replace(NOISE, attitude_walk=1.0 * ARCSEC)
    for _ in range(10):
        field = turned(measured(VIEW, rng), random_walk(rng, 1.0 * ARCSEC))
        blind, told = (adjust([field], LABORATORY, n, gauge=HOLD_XY) for n in (NOISE, noise))
        assert min(blind.courses.p_value, blind.rates.p_value) < FALSE_ALARM
        inner = [k for k, n in enumerate(told.names) if n not in HOLD_XY.held and "Beijing" not in n]
        for found in (blind, told):
            error, spread = (found.values - truth(found.names))[inner], found.covariance[np.ix_(inner, inner)]
            square = error @ np.linalg.solve(spread, error)
            total, blind_total = (total + square, blind_total) if found is told else (total, blind_total + square)
        size += len(inner)
    assert 5e-5 < stats.chi2.sf(total, size) < 1 - 5e-5
    assert blind_total > 100 * size
    trial = replace(NOISE, attitude_walk=0.3 * ARCSEC)
    found = adjust([field], LABORATORY, trial, gauge=HOLD_XY, variance_components=("attitude walk",))
    assert 0.5 < 0.3 * np.sqrt(found.factors["attitude walk"]) < 2.0
    assert found.factors["image"] == 1.0


def test_a_walk_needs_times():
    field = measured(VIEW)
    untimed = replace(field, rays={k: replace(r, time=None) for k, r in field.rays.items()})
    with pytest.raises(CalibrationError, match="needs the times"):
        adjust([untimed], LABORATORY, replace(NOISE, attitude_walk=ARCSEC), gauge=HOLD_XY)


def test_a_step_between_chips_is_estimated_with_its_threshold():
    """8 um in y of half the nadir line; false alarm 1e-6 of 5 sigma. Its sigma is the field's threshold."""
    field = measured(VIEW, np.random.default_rng(9))
    nadir = field.rays["nadir"]
    image = nadir.image + np.where(nadir.image[:, 1:] > 0.0, [0.0, 8e-6], 0.0)
    found = adjust(
        [replace(field, rays=field.rays | {"nadir": replace(nadir, image=image)})], LABORATORY, NOISE, gauge=HOLD_XY
    )
    steps = found.unseen(Steps((("nadir", 0.0),)))
    assert 0.2 * PITCH < steps.sigma[1] < PITCH
    assert steps.estimate[1] == pytest.approx(8e-6, abs=5 * steps.sigma[1])
    assert steps.estimate[0] == pytest.approx(0.0, abs=5 * steps.sigma[0])
