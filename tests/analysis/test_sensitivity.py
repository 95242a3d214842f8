"""Figs. 3-5 of paper 000 on the synthetic descending pass near 40 N 116 E, in ECEF.

Change of the intersection angle: signs, first order against the exact form, sigma.
"""

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from analysis.monitor.monitor_formulas import CameraParameters, exact
from analysis.orbit.planes import METHODS, Station, sensitivity
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import SCENE, noisy

PAIRS = {"alpha": ("forward", "nadir"), "beta": ("nadir", "backward")}


def table(scene=SCENE, method="tls", **options):
    strips = dict(zip(scene.points, scene.strips(1.5), strict=True))
    return sensitivity(Station.of(scene.station, 0.5), strips, PAIRS, method=method, **options)


@pytest.mark.second
@pytest.mark.parametrize("method", METHODS)
def test_linear_derivative_agrees_with_recomputation(method):
    """Second order of 10 m over 500 km is 2e-5 of the slope, with factors up to 5. On noisy points, where the
    derivative leaves out terms of residual over spread (2 m / 17 km)."""
    scene = noisy(SCENE, np.random.default_rng(2), 1.5, 0.5)
    for row in table(scene, method):
        assert row.change[:, 0] == pytest.approx(0, abs=0)
        assert np.abs(row.change[:, -1] / 10.0 - row.slope).max() < 1e-3 * 2e-6
        assert np.abs(row.change[:, 1] - row.slope).max() < 1e-3 * 2e-6


@pytest.mark.parametrize("amounts", [[0, 1], [1, 2, 3], [0, 2, 1], [0, 1, np.nan], np.zeros((3, 3))])
def test_bad_amounts(amounts):
    refuses(ValueError, "rising numbers", table, amounts=amounts)


# --- intersection angle -----------------------------------------------------------------------------------------------

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
    refuses(ValueError, "lines of sight are parallel", exact, camera(), camera(), 0.1, 0.1)
    refuses(ValueError, "forward_look_rad", exact, camera(), camera(), np.nan, 0.1)
