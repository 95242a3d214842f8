"""Third differences of made-up orbit and attitude series."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.orbit.third_difference import WHITE_GAIN, WHITE_LAG, third_difference

RATE, RADIUS = 1.1068e-3, 6878137.0


def test_white_noise_is_recovered_with_its_uncertainty():
    """200 series: the mean of the sigmas to 5 standard errors, their scatter as stated to 25 per cent (5 sigmas)."""
    noise = 0.3 * np.random.default_rng(1).standard_normal((500, 200))
    found = third_difference(np.arange(500.0), noise)
    assert abs(found.white_sigma.mean() - 0.3) < 5 * found.white_sigma_error.mean() / np.sqrt(200)
    assert found.white_sigma.std() == pytest.approx(found.white_sigma_error.mean(), rel=0.25)
    assert found.rms == pytest.approx(WHITE_GAIN * found.white_sigma)
    # false alarm 6e-5 each and a little more in a finite series: three of 200 has a chance of 1e-5
    assert np.sum(~found.white) < 3


def test_white_is_told_at_four_standard_deviations_of_the_lag():
    """Scatter of the lag over 4000 series of white noise, known to 1.1 per cent; the limit to 7 per cent of it."""
    found = third_difference(np.arange(1003.0), np.random.default_rng(3).standard_normal((1003, 4000)))
    limit = 4.0 * found.lag.std()
    for side in (-1.0, 1.0):
        lag = WHITE_LAG + side * limit * np.array([1 - 0.07, 1 + 0.07])
        assert replace(found, lag=lag).white.tolist() == [True, False]


@pytest.mark.parametrize(("step", "floor"), [(1.0, 6.6e-3), (10.0, 6.6)])
def test_a_smooth_orbit_leaves_its_third_derivative(step, floor):
    """n^3 a dt^3 / sqrt(2) on a circle, whose third differences are not white; cubics leave rounding only."""
    time = step * np.arange(int(5700 / step))
    found = third_difference(time, RADIUS * np.column_stack([np.cos(RATE * time), np.sin(RATE * time)]))
    assert found.rms == pytest.approx((RATE * step) ** 3 * RADIUS / np.sqrt(2), rel=0.02)
    assert found.rms == pytest.approx(floor, rel=0.03)
    assert np.all(found.lag > 0.9)
    assert not np.any(found.white)
    cubic = third_difference(np.arange(50.0), 2.0 * np.arange(50.0) ** 3)
    assert cubic.rms == pytest.approx(12.0)


def test_biases_and_drifts_are_not_seen_and_smoothing_hides_noise():
    rng = np.random.default_rng(2)
    noise, time = rng.standard_normal(4000), np.arange(4000.0)
    plain = third_difference(time, noise)
    assert third_difference(time, noise + 100.0 + 0.5 * time).rms == pytest.approx(plain.rms, rel=1e-9)
    smoothed = third_difference(time, np.convolve(noise, np.ones(9) / 9, "same"))
    # the mean of nine has a third of the sigma; third differences say 1/9 sqrt(2 x 6 / 20), far too good
    assert smoothed.white_sigma[0] == pytest.approx(np.sqrt(12 / 20) / 9, rel=0.1)
    assert not smoothed.white[0]


def test_angles_turn_over():
    time = np.arange(100.0)
    angle = 0.3 * time
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    assert third_difference(time, wrapped).rms[0] > 1.0
    assert third_difference(time, wrapped, angle=True).rms[0] < 1e-12


def test_bad_series_are_told():
    time = np.arange(10.0)
    with pytest.raises(ValueError, match="five samples"):
        third_difference(time[:4], time[:4])
    with pytest.raises(ValueError, match="finite"):
        third_difference(time, np.where(time == 3, np.nan, time))
    with pytest.raises(ValueError, match="the step after sample 4 is 2 s"):
        third_difference(np.delete(time, 5), np.delete(time, 5))
    with pytest.raises(ValueError, match="rise evenly"):
        third_difference(time[::-1], time)


def test_constants_of_white_noise_are_those_of_the_binomials():
    weights = np.array([1.0, -3.0, 3.0, -1.0])
    overlap = np.correlate(weights, weights, "full")
    assert pytest.approx(np.sqrt(overlap[3])) == WHITE_GAIN
    assert overlap[4] / overlap[3] == WHITE_LAG
