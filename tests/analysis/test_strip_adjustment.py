"""A pass adjusted on its tie points, without control: exactness, sigmas, datum, and how much it gains."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from analysis.calibration.strip_adjustment import adjust_strip
from analysis.orbit.calibration_parameters import CalibrationError, Noise
from tests.analysis.refusals import refuses
from tests.analysis.test_three_line_model import ARCSEC, PITCH, cameras, make_rays, observe, orbit

BIAS = np.array([40.0, -60.0, 90.0]) * ARCSEC
NODE = 2.4
WHITE = Noise(0.3 * PITCH, 0.5 * ARCSEC, 0.05, attitude_interval=0.125, station_interval=1.0)
SLOW = replace(WHITE, slow_attitude=5.0 * ARCSEC, slow_interval=10.0)


def strip(seed, count, seconds):
    """Exact pass over points that the nadir line sees within `seconds`."""
    rng = np.random.default_rng(seed)
    station, attitude = orbit(NODE, seconds * rng.uniform(-0.5, 0.5, count))
    direction = station / np.linalg.norm(station, axis=1, keepdims=True)
    direction = direction + rng.uniform(-25e3, 25e3, count)[:, None] * attitude[:, :, 1] / 6371e3
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    height = rng.uniform(0.0, 2000.0, count)
    points = direction * (6378137.0 * (1 - direction[:, 2] ** 2 / 298.257) + height)[:, None]
    return observe(points, NODE, cameras(), BIAS)


def adjusted(rays, noise):
    return adjust_strip(rays, cameras(), noise, bias=BIAS)


def test_exact_rays_are_left_alone():
    """1e-15 m of rounding in an image of 0.3 px is 1e-9 of a sigma; coordinates of 6.4e6 m are rounded to 1e-9 m."""
    view = strip(1, 60, 7.0)
    found = adjusted(make_rays(view), SLOW)
    assert np.abs(found.ground - view.points).max() < 1e-6
    assert found.chi_square < 1e-12
    for row in make_rays(view).values():
        corrected = found.corrected(row)
        assert np.abs(corrected.attitude - row.attitude).max() < 1e-6 * SLOW.attitude
        assert np.abs(corrected.station - row.station).max() < 1e-6 * SLOW.station


@pytest.mark.second
def test_sigmas_are_right():
    """30 passes: the errors of one point of each, and the residuals of all; two-sided false alarm 1e-6 each."""
    rng, view, total, fit = np.random.default_rng(2), strip(2, 30, 3.0), np.zeros(2), np.zeros(2)
    for k in range(30):
        found = adjusted(make_rays(view, rng, SLOW), SLOW)
        error = found.ground[k] - view.points[k]
        total += (error @ np.linalg.solve(found.covariance[k], error), 3)
        fit += (found.chi_square, found.degrees_of_freedom)
    for square, degrees in (total, fit):
        assert 5e-7 < stats.chi2.sf(square, degrees) < 1 - 5e-7


@pytest.mark.second
def test_the_datum_keeps_its_prior():
    """A common roll is left to the prior to some per cent, ends of the pass apart; a common pitch is told."""
    found = adjusted(make_rays(strip(5, 600, 15.0), np.random.default_rng(5), SLOW), SLOW)
    told = {d.name: d.after / d.before for d in found.datum}
    assert set(told) == {"roll", "pitch", "yaw", "roll rate", "pitch rate", "yaw rate"}
    assert max(told.values()) <= 1.0
    assert told["roll"] > 0.85
    assert told["yaw"] > 0.85
    assert told["pitch"] < 0.75
    before = {d.name: d.before for d in found.datum}
    # three separate looks of about 15 s, each sees slow errors at 10 s: two or three independent ones for each
    assert 5 * ARCSEC / np.sqrt(9) < before["roll"] < 5 * ARCSEC / np.sqrt(3)


def test_points_of_one_line_and_bad_input():
    rays = make_rays(strip(7, 30, 5.0), np.random.default_rng(7), WHITE)
    some = {k: r.taken(r.point != 3) if k != "backward" else r for k, r in rays.items()}
    found = adjusted(some, WHITE)
    assert np.isnan(found.ground[3]).all()
    assert np.isfinite(np.delete(found.ground, 3, axis=0)).all()
    assert found.degrees_of_freedom == 2 * 29 * 3 - 3 * 29
    refuses(CalibrationError, "these rays have no times", found.corrected, replace(rays["nadir"], time=None))
    refuses(CalibrationError, "needs the times", adjusted, rays, Noise(PITCH, ARCSEC))
    refuses(CalibrationError, "needs the times", adjusted, {k: replace(r, time=None) for k, r in rays.items()}, WHITE)
