"""Change of the intersection angle: signs, first order against the exact form, sigma."""

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from analysis.monitor.monitor_formulas import CameraParameters, exact
from tests.analysis.refusals import refuses

FORWARD, BACKWARD = np.deg2rad(26.0), np.deg2rad(-5.0)
SIGMA = np.diag([0.03, 0.04, 1.0, 1.0]) * ARCSEC


def camera(d_alpha=0.0, d_beta=0.0, d_gamma=0.0):
    return CameraParameters.from_vector(np.array([d_alpha, d_beta, d_gamma, 0.0]), SIGMA @ SIGMA)


def test_signs():
    """Forward camera turned forward opens the angle, backward camera turned forward closes it."""
    turn, still = camera(2 * ARCSEC), camera()
    cases = (turn, still, 1), (still, turn, -1), (turn, turn, 0), (camera(d_gamma=1e-5), still, 0)
    for forward, backward, change in cases:
        found = exact(forward, backward, FORWARD, BACKWARD)
        assert found.change_rad == pytest.approx(change * 2 * ARCSEC, rel=1e-6, abs=1e-15)
        # to first order the variances of both d_alpha
        assert found.sigma_rad == found.noise_rad == pytest.approx(0.03 * np.sqrt(2) * ARCSEC, rel=1e-4)


def test_second_order():
    """Turned apart sideways by d: cos(angle) -> cos(angle) - d^2/2-sized terms, from spherical trigonometry.

    For unit vectors with latitudes +d and -d out of the plane: cos(new) = cos^2 d cos(angle) - sin^2 d.
    """
    d = 5e-3
    change = exact(camera(d_beta=d), camera(d_beta=-d), FORWARD, BACKWARD).change_rad
    angle = FORWARD - BACKWARD
    expected = np.arccos(np.cos(d) ** 2 * np.cos(angle) - np.sin(d) ** 2) - angle
    assert change == pytest.approx(expected, rel=1e-9)
    assert change > 10 * ARCSEC


def test_errors_that_both_cameras_share():
    """A common error about Y leaves the angle alone, the opposite one counts twice; noise and total apart."""
    spread = SIGMA @ SIGMA
    one, two = (CameraParameters.from_vector(np.zeros(4), spread, 4 * spread) for _ in range(2))
    plain = exact(one, two, FORWARD, BACKWARD)
    assert plain.sigma_rad == pytest.approx(2 * plain.noise_rad)
    alike = exact(one, two, FORWARD, BACKWARD, spread, 4 * spread)
    opposite = exact(one, two, FORWARD, BACKWARD, -spread, -4 * spread)
    # differences of the finite steps' rounding
    assert alike.sigma_rad < 1e-4 * plain.sigma_rad
    assert opposite.sigma_rad == pytest.approx(np.sqrt(2) * plain.sigma_rad, rel=1e-6)


def test_sigma_of_the_exact_form_is_propagated():
    """By differences, at a large sideways turn, where d_beta counts."""
    base, quiet = np.array([0.0, 0.02, 0.0, 0.0]), CameraParameters.from_vector([0, -0.02, 0, 0], np.zeros((4, 4)))

    def change(step):
        return exact(CameraParameters.from_vector(base + step, SIGMA @ SIGMA), quiet, FORWARD, BACKWARD)

    slope = [(change(d).change_rad - change(-d).change_rad) / 2e-5 for d in 1e-5 * np.eye(4)]
    assert abs(slope[1]) > 0.01
    assert change(np.zeros(4)).sigma_rad == pytest.approx(np.linalg.norm(slope @ SIGMA), rel=1e-5)


def test_bad_look_angles():
    refuses(ValueError, "same way", exact, camera(), camera(), 0.1, 0.1)
    refuses(ValueError, "forward_look_rad", exact, camera(), camera(), np.nan, 0.1)
