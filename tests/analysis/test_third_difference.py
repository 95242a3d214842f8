"""Third differences of made-up orbit and attitude series."""

import numpy as np
import pytest

from analysis.orbit.forward_intersection import WHITE_GAIN, third_difference
from tests.analysis.refusals import refuses

RATE, RADIUS = 1.1068e-3, 6878137.0


def test_white_noise_is_recovered():
    """200 series: the mean of the sigmas to 5 standard errors, their scatter to 25 per cent (5 sigmas)."""
    noise = 0.3 * np.random.default_rng(1).standard_normal((500, 200))
    found = third_difference(np.arange(500.0), noise)
    # of 497 third differences, whose squared correlations sum up to 1 + 2 (15^2 + 6^2 + 1) / 20^2
    error = 0.3 * np.sqrt(0.5 * (1.0 + 2.0 * 262.0 / 400.0) / 497)
    assert abs(found.white_sigma.mean() - 0.3) < 5 * error / np.sqrt(200)
    assert found.white_sigma.std() == pytest.approx(error, rel=0.25)
    assert found.rms == pytest.approx(WHITE_GAIN * found.white_sigma)


@pytest.mark.parametrize(("step", "floor"), [(1.0, 6.6e-3), (10.0, 6.6)])
def test_a_smooth_orbit_leaves_its_third_derivative(step, floor):
    """n^3 a dt^3 / sqrt(2) on a circle; cubics leave rounding only."""
    time = step * np.arange(int(5700 / step))
    found = third_difference(time, RADIUS * np.column_stack([np.cos(RATE * time), np.sin(RATE * time)]))
    assert found.rms == pytest.approx((RATE * step) ** 3 * RADIUS / np.sqrt(2), rel=0.02)
    assert found.rms == pytest.approx(floor, rel=0.03)
    cubic = third_difference(np.arange(50.0), 2.0 * np.arange(50.0) ** 3)
    assert cubic.rms == pytest.approx(12.0)


def test_bad_series_are_told():
    time = np.arange(10.0)
    refuses(ValueError, "five samples", third_difference, time[:4], time[:4])
    refuses(ValueError, "finite", third_difference, time, np.where(time == 3, np.nan, time))
    refuses(ValueError, "the step after sample 4 is 2 s", third_difference, np.delete(time, 5), np.delete(time, 5))
    refuses(ValueError, "rise evenly", third_difference, time[::-1], time)
