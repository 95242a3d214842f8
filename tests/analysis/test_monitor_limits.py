"""Stated disturbances, the posterior under them and what limits it, against plain linear algebra and statistics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2, ncx2

from analysis.monitor import limits
from analysis.monitor.disturbances import FALSE_ALARM, Consistency, TimeLaw, consistency
from analysis.monitor.estimators import Shifts, applicable
from analysis.monitor.monitor_formulas import MonitorGeometry
from analysis.monitor.parameters import CameraCalibration
from tests.analysis.stated_motions import correlation_of, disturbances
from tests.tiers import quick

LOOKS = (0.45, -0.09)


def a_statement(seed=1, count=24, cameras=2, correlated=True):
    """Random derivatives of the sizes that instruments have: px, rad and m for one standard deviation."""
    rng = np.random.default_rng(seed)
    laws = tuple(TimeLaw(drift_s=3600.0) if k % 2 else TimeLaw() for k in range(count))
    see, tell = rng.standard_normal((2, 4 * cameras, count))
    tell *= np.tile([1e-6, 1e-6, 1e-6, 1e-5], cameras)[:, None]
    labels = [f"base/b{k // 3} shift {'xyz'[k % 3]}" for k in range(count)]
    sigmas, correlation = rng.uniform(0.5, 2.0, count), correlation_of(rng, laws) if correlated else None
    return disturbances(laws, see, tell, labels, correlation, sigmas)


def a_noise(seed=2, count=8, size=0.2):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((count, count))
    return size**2 * (np.eye(count) + 0.1 * root @ root.T)


def some_cameras(cameras=2):
    out = {}
    for k in range(cameras):
        rng = np.random.default_rng(50 + k)
        spots = np.array([[1.0, 0.1, 0.5, 0.4], [0.1, 1.0, 0.7, 0.0], [1.0, 0.1, 0.5, -0.4], [0.1, 1.0, -0.7, 0.0]])
        out[f"c{k}"] = CameraCalibration(
            geometry=MonitorGeometry(5.5, 0.4, 12e-6),
            look_rad=LOOKS[k],
            spot_jacobian=1e6 * spots * rng.uniform(0.9, 1.1, 4),
            parameter_jacobian=np.diag([0.18, 0.18, 1.0, 5.5]),
            motions=("x", "y", "turn", "scale"),
        )
    return out


def unit_rows(stated):
    return np.eye(len(stated.parameters))


@pytest.mark.parametrize("correlated", [False, True])
def test_the_posterior_is_that_of_dense_linear_algebra_over_all_motions(correlated):
    """Information form: precision of the motions C^-1 + A' R^-1 A, then their mean and covariance through B."""
    stated, noise = a_statement(correlated=correlated), a_noise()
    a, b, weight = stated.spots, stated.parameters, np.linalg.inv(noise)
    spread = np.linalg.inv(np.linalg.inv(stated.correlation) + a.T @ weight @ a)
    gain = stated.best_gain(noise)
    scale = np.sqrt(np.diag(stated.parameter_covariance))
    # inverses of matrices with condition numbers of some 1e4: 1e-16 becomes 1e-11
    np.testing.assert_allclose(gain / scale[:, None], b @ spread @ a.T @ weight / scale[:, None], atol=1e-10)
    total = stated.misfit(gain) + gain @ noise @ gain.T
    np.testing.assert_allclose(total / np.outer(scale, scale), b @ spread @ b.T / np.outer(scale, scale), atol=1e-10)


def test_total_sigmas_of_every_estimator_are_those_of_the_linear_model():
    """Errors of an estimator are G (A x + n) - B x: their covariance written out, and its shares."""
    stated, noise, cameras = a_statement(), a_noise(), some_cameras()
    still = np.zeros((1, 4, 2))
    estimators = applicable(cameras, stated)
    assert len(estimators) == 5
    for name, estimator in estimators.items():
        gain = estimator.gain(Shifts(still, still, noise[None], cameras, stated))[0]
        split = limits.split(unit_rows(stated), stated, noise, gain)
        off = gain @ stated.spots - stated.parameters
        total = off @ stated.correlation @ off.T + gain @ noise @ gain.T
        np.testing.assert_allclose(split.sigma**2, np.diag(total), rtol=1e-9, err_msg=name)
        before = stated.parameters @ stated.correlation @ stated.parameters.T
        np.testing.assert_allclose(split.sigma_before**2, np.diag(before), rtol=1e-12)


def test_motions_of_no_size_change_nothing():
    stated, noise, rows = a_statement(correlated=False), a_noise(), np.eye(8)
    some = stated.scaled([0.0 if k < 5 else 1.0 for k in range(24)])
    fewer = disturbances(stated.laws[5:], stated.spots[:, 5:], stated.parameters[:, 5:], stated.labels[5:])
    np.testing.assert_allclose(some.best_gain(noise), fewer.best_gain(noise), rtol=1e-10)
    left = limits.posterior_sigma(rows, fewer, noise)
    np.testing.assert_allclose(limits.posterior_sigma(rows, some, noise), left, rtol=1e-10)
    # without correlations a motion that is known is one of no size
    np.testing.assert_allclose(limits.sigma_if_known(rows, stated, noise, [stated.labels[:5]])[0], left, rtol=1e-9)


def test_the_motions_that_hide_change_the_quantity_by_what_is_left():
    stated, noise = a_statement(), a_noise()
    row = np.zeros(8)
    row[2] = 1e6
    seen = limits.least_seen(row, stated, noise)
    left = limits.posterior_sigma(row[None], stated, noise)[0]
    assert seen.change == pytest.approx(left, rel=1e-8)
    assert row @ stated.parameters @ seen.amounts == pytest.approx(left, rel=1e-8)
    # the most probable of all that do so: least of x' Q^-1 x, which is 1 for it
    weight = np.linalg.inv(stated.correlation) + stated.spots.T @ np.linalg.inv(noise) @ stated.spots
    assert seen.amounts @ weight @ seen.amounts == pytest.approx(1.0, rel=1e-6)
    rng = np.random.default_rng(6)
    b = row @ stated.parameters
    for _ in range(20):
        other = seen.amounts + 0.1 * rng.standard_normal(24)
        other *= left / (b @ other)
        assert other @ weight @ other > 1.0


def test_a_test_field_takes_away_what_stays_and_not_what_is_forgotten():
    stated, noise, rows = a_statement(correlated=False), a_noise(), np.eye(8)
    exact = 1e-12 * np.diag(np.diag(stated.parameter_covariance))
    later = limits.calibrated_sigma(rows, stated, noise, exact, 1e9)
    now = limits.calibrated_sigma(rows, stated, noise, exact, 0.0)
    open_end = limits.posterior_sigma(rows, stated, noise)
    # at once the field's own error is left: 1e-6 of the spread before
    assert np.all(now <= 1.01e-6 * np.sqrt(np.diag(stated.parameter_covariance)))
    assert np.all((later > 100.0 * now) & (later < open_end))
    forgets = replace(stated, laws=(TimeLaw(drift_s=1.0),) * 24)
    np.testing.assert_allclose(limits.calibrated_sigma(rows, forgets, noise, exact, 1e9), open_end, rtol=1e-9)
    # all constant: the field's error, and the noise of two measurements
    stays = replace(stated, laws=(TimeLaw(),) * 24)
    np.testing.assert_allclose(limits.calibrated_sigma(rows, stays, noise, exact, 1e9), now, rtol=1e-6)


def test_rows_of_the_angle_and_of_parameters():
    cameras = some_cameras()
    found = limits.quantities(cameras)
    keys = ["d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um"]
    assert [(q.group, q.key) for q in found][:8] == [(name, key) for name in ("c0", "c1") for key in keys]
    for some, first in ((found, 1.0), (limits.quantities(dict(reversed(cameras.items()))), -1.0)):
        # the forward camera's d_alpha minus the other's, whichever stands first
        assert some[-1].group == limits.ANGLE_GROUP
        assert some[-1].row[[0, 4]] == pytest.approx(first * found[0].row[0] * np.array([1.0, -1.0]))


@pytest.mark.second
@pytest.mark.parametrize("cameras", quick(1, [1, 2]))
def test_false_alarms_and_power_of_the_chi_square(cameras):
    """1000 drawn shifts. Noise is a hundredth of the motions, so that three times them are three times the spread
    to 1e-4."""
    stated, count = a_statement(cameras=cameras), 4 * cameras
    noise, rng = a_noise(count=count, size=0.01), np.random.default_rng(7)
    for times, rate in ((1.0, FALSE_ALARM), (3.0, Consistency.power(3.0, count))):
        root = np.linalg.cholesky(times**2 * stated.spot_covariance + noise)
        found = sum(not consistency(root @ one, noise, stated).agrees for one in rng.standard_normal((1000, count)))
        assert binom.ppf(1e-4, 1000, rate) <= found <= binom.isf(1e-4, 1000, rate)
    power = ncx2.sf(chi2.isf(FALSE_ALARM, count) / 9.0, count, 0.0)
    assert Consistency.power(3.0, count) == pytest.approx(power, rel=1e-9)
