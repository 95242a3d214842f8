"""What an adjustment leaves out: score tests against adjustments that know, false alarms, stated walks.

What a calibration cannot tell: the same whatever the units, the order and the choice of unknowns, and no more than
the data leave open; what keeps its start values has their sigma.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import subspace_angles
from scipy.spatial.transform import Rotation

from analysis.calibration.adjustment import FALSE_ALARM, FarPointsError, NoiseError, Steps, adjust
from analysis.calibration.normal_equations import SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import (
    WORST,
    CalibrationError,
    Gauge,
    Noise,
    Parameters,
    Prior,
    RankError,
    Unknowns,
    free_basis,
    null_vectors,
)
from analysis.orbit.three_line_model import LineModel
from tests.analysis.refusals import refuses
from tests.analysis.test_adjustment import BIAS, HOLD_XY, INNER, LABORATORY, NOISE, measured, seen, truth
from tests.analysis.test_three_line_model import ARCSEC, PITCH, cameras, field_points, mounting, observe

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
    change = still.rates.bias @ -rate
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
        assert min(blind.slow_variations.p_value, blind.rates.p_value) < FALSE_ALARM
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
    steps = found.omitted_terms_test(Steps((("nadir", 0.0),)))
    assert 0.2 * PITCH < steps.sigma[1] < PITCH
    assert steps.estimate[1] == pytest.approx(8e-6, abs=5 * steps.sigma[1])
    assert steps.estimate[0] == pytest.approx(0.0, abs=5 * steps.sigma[0])


# --- null space -------------------------------------------------------------------------------------------------------

FREE = Gauge(start=WORST)
HOLD_SIX = Gauge(held=("nadir x", "forward f", "nadir f", "backward f", "nadir y", "Beijing yaw"))


def middle(count=3):
    """A pass over a few points that all lines see within 1 mm of their middle: f and yaw hardly move their images."""
    points = field_points(np.random.default_rng(4), 300, 2.4)
    seen = observe(points, 2.4, cameras(), BIAS)
    near = np.argsort(np.max([np.abs(y) for y in seen.y.values()], axis=0))[:count]
    return observe(points[near], 2.4, cameras(), BIAS)


MIDDLE = middle()


def equations(field, unknowns=None, noise=NOISE):
    parameters, shared = Parameters.of([field], LABORATORY, unknowns or Unknowns()), SharedNoise.of([field], noise)
    count = sum(len(r.point) for r in field.rays.values())
    state = State(parameters.start, (field.ground,), np.zeros(shared.size))
    weights = Weights(np.ones(count), {"image": 1.0})
    return parameters, assemble([field], LABORATORY, parameters, state, noise, (), weights, shared)


def random_system(rng, size=12, opened=4):
    """A normal matrix whose open and other combinations have sigmas that coincide in part, in mixed units."""
    turn = np.linalg.qr(rng.standard_normal((size, size)))[0]
    sigma = np.concatenate([np.full(opened - 1, 5.0 * WORST), [1e3 * WORST], np.geomspace(1e-7, 1e-6, size - opened)])
    scale = 10.0 ** rng.uniform(-3, 3, size)
    image = turn @ np.diag(sigma**-2.0) @ turn.T
    return image / scale[:, None] / scale, scale, turn[:, :opened]


def same_space(first, second):
    # the normal matrix holds 1e-16 of its largest eigenvalue: 1e14, against the gap of 1e12 to the open ones
    return first.shape == second.shape and np.max(subspace_angles(first, second)) < 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_the_open_space_is_that_of_the_matrix_whatever_units_order_and_basis(seed):
    rng = np.random.default_rng(seed)
    reduced, scale, opened = random_system(rng)
    found = null_vectors(reduced, WORST * scale)
    assert same_space(found, opened)
    # another unit of each unknown: metres, millimetres, arcseconds
    unit = 10.0 ** rng.uniform(-6, 6, len(scale))
    assert same_space(null_vectors(reduced * unit[:, None] * unit, WORST * scale / unit), opened)
    # another order
    order = rng.permutation(len(scale))
    assert same_space(null_vectors(reduced[np.ix_(order, order)], WORST * scale[order]), opened[order])
    # combinations as unknowns, square to each other in image motion
    turn = np.linalg.qr(rng.standard_normal((len(scale), len(scale))))[0]
    image = turn.T @ (scale[:, None] * reduced * scale) @ turn
    assert same_space(turn @ null_vectors(image, np.full(len(scale), WORST)), opened)


def test_a_gauge_closes_what_data_leave_open_and_nothing_else():
    """Three points near the middle of the lines: every combination that start values observe is known to `WORST` or
    worse by the data, whichever way their space is cut, and all that is square to it better."""
    parameters, at = equations(measured(MIDDLE))
    scale = parameters.scale
    freedom = free_basis(at.reduced, at.length, scale, parameters.names, FREE)
    image = scale[:, None] * at.reduced * scale
    closed = (freedom.rows * WORST * scale).T
    assert closed.T @ closed == pytest.approx(np.eye(6), abs=1e-9)
    assert len(freedom.opened) == 6
    basis = np.linalg.qr(closed, mode="complete")[0][:, 6:]
    assert np.linalg.eigvalsh(closed.T @ image @ closed).max() < WORST**-2
    assert np.linalg.eigvalsh(basis.T @ image @ basis).min() > WORST**-2
    # not coupled: nothing of what is solved for moves with what is closed
    mixed = basis.T @ image @ closed
    assert np.abs(mixed).max() < 1e-6 * WORST**-2
    # differences of x are known to some micrometres, and the mean angle of three rays to the noise
    sigma = np.linalg.eigvalsh(basis.T @ image @ basis) ** -0.5
    assert np.sum(sigma < 3e-6) >= 4
    # no single unknown of these is in the closed space with more than what the data leave of it
    for line in ("forward", "backward"):
        vector = np.zeros(len(scale))
        vector[[parameters.names.index(f"{line} x"), parameters.names.index("nadir x")]] = 1.0, -1.0
        # f is counted at the ends of the line, 17 of its own: lines mounted 35 arcsec askew move x by 3e-3 of that
        assert np.linalg.norm(closed.T @ vector) < 1e-2


def test_held_unknowns_hide_what_follows_them():
    """nadir x off by 0.1 mm: pitch and the other x follow, and `sigma_with` says so."""
    field = measured(middle(60), np.random.default_rng(7))
    found = adjust([field], LABORATORY, NOISE, gauge=HOLD_SIX)
    nadir = LABORATORY["nadir"]
    shifted = {**LABORATORY, "nadir": nadir.with_interior(nadir.interior + np.array([0, 1e-4, 0]))}
    moved = adjust([field], shifted, NOISE, gauge=HOLD_SIX)
    change = found.follow @ [1e-4, 0, 0, 0, 0, 0]
    for k, name in enumerate(found.names):
        assert moved.values[k] - found.values[k] == pytest.approx(change[k], rel=1e-3, abs=1e-3 * found.sigma[name])
    told = found.sigma_with({"nadir x": 1e-4})
    assert told["nadir x"] == pytest.approx(1e-4, rel=1e-12)
    assert told["forward x"] == pytest.approx(1e-4, rel=0.01)
    assert told["Beijing pitch"] == pytest.approx(1e-4 / 0.65, rel=0.01)
    assert told["Beijing pitch"] > 10 * found.sigma["Beijing pitch"]
    refuses(CalibrationError, "no unknown is called", found.sigma_with, {"forward x": 1e-4})


def test_nothing_determined_and_bad_gauges_are_told():
    lonely = measured(middle(2))
    vague = Noise(1e4 * PITCH, 1e3 * ARCSEC)
    refuses(NoiseError, r"noise too large: .* image 6\.5e", adjust, [lonely], LABORATORY, vague, gauge=FREE)
    with pytest.raises(CalibrationError, match="of start values must be positive"):
        adjust([lonely], LABORATORY, NOISE, gauge=Gauge(start=0.0))


LAUNCH = Gauge(
    held=("nadir x", "nadir y"),
    start=dict.fromkeys(INNER, 0.0001) | {f"Beijing {n}": 40.0 * ARCSEC for n in ("roll", "pitch", "yaw")},
)


def long_camera(focal=5.5):
    """A camera of 12 000 pixels and three lines, and how wide it sees from 500 km."""
    half = 6000 * PITCH
    models = {k: LineModel.of(mounting(k), (focal, 0.0, 0.0), half_length=half) for k in LABORATORY}
    return models, 0.8 * half / focal * 500e3


def test_noise_distance_and_rank_are_three_messages():
    models, wide = long_camera()
    rng, noise = np.random.default_rng(3), NOISE
    view = observe(field_points(rng, 12, 2.4, half=wide), 2.4, models, BIAS)
    field = measured(view, rng, noise)
    with pytest.raises(NoiseError, match=r"noise too large: .* attitude") as caught:
        adjust([field], models, replace(noise, attitude=600.0 * ARCSEC))
    assert caught.value.largest == "attitude"
    moved = replace(field, ground=field.ground + np.array([0.0, 7e3, 0.0]))
    for robust in (None, "igg"):
        with pytest.raises(FarPointsError, match=r"half of the control points of Beijing lie .* km"):
            adjust([moved], models, noise, gauge=LAUNCH, robust=robust)
    # half of them by 1.5 km, either way: no median tells it, but nothing is left that fits
    apart = replace(field, ground=field.ground + np.where(np.arange(12) % 2, 1.5e3, -1.5e3)[:, None] * [0, 1, 0])
    refuses(FarPointsError, "contradict each other", adjust, [apart], models, noise, gauge=LAUNCH, robust="igg")
    narrow = observe(field_points(rng, 12, 2.4, half=1.0), 2.4, models, BIAS)
    refuses(RankError, "forward f", adjust, [measured(narrow, rng, noise)], models, noise, gauge=LAUNCH)
