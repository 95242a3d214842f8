"""The printed and the derived formulas of paper 001: each by hand, their ratios, signs, sigma, and a plane-mirror round
trip.
"""

import math

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from analysis.monitor.monitor_formulas import (
    CameraParameters,
    MonitorGeometry,
    coefficients,
    derived,
    paper_joint,
    paper_single,
)
from tests.analysis.refusals import refuses

# Field angles far larger than real ones, so that a forgotten cos^2 cannot hide.
GEOMETRY = MonitorGeometry(7.68, 0.73, 7e-6, field_alpha_rad=0.3, field_beta_rad=0.2)
ZERO = np.zeros((4, 4))
FUNCTIONS = {"paper_single": paper_single, "paper_joint": paper_joint, "derived": derived}


def printed(y01, y11, y02, y22, x01, x11, x02, x22, g):
    """Equations (2), (3), (5), (7) typed from the page."""
    delta, f, length = g.pitch_m, g.principal_distance_m, g.separation_m
    d_beta = math.atan((((y01 - y11) + (y02 - y22)) / 2 * delta) * math.cos(g.field_beta_rad) ** 2 / (2 * f))
    d_alpha = math.atan((((x01 - x11) + (x02 - x22)) / 2 * delta) * math.cos(g.field_alpha_rad) ** 2 / (2 * f))
    d_gamma = math.atan(((x01 - x11) + (x22 - x02)) / length * delta)
    d_f = (((y11 - y01) + (y02 - y22)) / 2 * delta) * f / length
    return [d_alpha, d_beta, d_gamma, d_f]


@pytest.fixture
def spots():
    rng = np.random.default_rng(3)
    return rng.uniform(40, 55, (50, 2, 2)), rng.uniform(40, 55, (50, 2, 2))


def test_single_is_the_printed_one(spots):
    before, after = spots
    result = paper_single(before, after, ZERO, GEOMETRY)
    for b, a, found in zip(before, after, result.vector, strict=True):
        # side 0 = left = 1 of the paper; (row, column) = (y, x)
        expected = printed(b[0, 0], a[0, 0], b[1, 0], a[1, 0], b[0, 1], a[0, 1], b[1, 1], a[1, 1], GEOMETRY)
        assert found == pytest.approx(expected, rel=1e-11, abs=1e-22)


def test_joint_is_table_1(spots):
    before, after = spots
    result = paper_joint(before, after, ZERO, GEOMETRY)
    x_l, x_r = (before - after)[:, 0, 1], (before - after)[:, 1, 1]
    y_l, y_r = (before - after)[:, 0, 0], (before - after)[:, 1, 0]
    g = GEOMETRY
    alpha = (x_l + x_r) / 2 * g.pitch_m * math.cos(0.3) ** 2 / (2 * g.principal_distance_m)
    beta = (y_l + y_r) / 2 * g.pitch_m * math.cos(0.2) ** 2 / (2 * g.principal_distance_m)
    gamma = (x_l - x_r) / g.separation_m * g.pitch_m
    d_f = (-y_l + y_r) / 2 * g.pitch_m * g.principal_distance_m / (2 * g.separation_m)
    assert np.allclose(result.vector, np.stack([alpha, beta, gamma, d_f], axis=1), rtol=1e-12, atol=1e-22)


def test_derived_inverts_a_plane_mirror_return():
    """Detector shifted by d moves the image by -2 d on it; ends of a line turned by t about Z shift by -+ t L/2 along
    X.

    The shift (x, y) of the detector turns the line of sight by x/f about Y and y/f about X in the paper's sign (which
    equates them without naming axes' senses); a change of f by d_f with the line unscaled displaces the ends by
    -+ (d_f / f) L / 2 in the return, doubled by the mirror.
    """
    g = GEOMETRY
    x, y, turn, d_f = 30e-6, -20e-6, 12 * ARCSEC, 40e-6
    half = g.separation_m / 2
    shift_m = np.array([[y, x + turn * half], [y, x - turn * half]])
    image_m = -2 * shift_m + 2 * (d_f / g.principal_distance_m) * np.array([[half, 0], [-half, 0]])
    before = np.full((2, 2), 48.0)
    found = derived(before, before + image_m / g.pitch_m, ZERO, g)
    assert found.vector == pytest.approx([x / g.principal_distance_m, y / g.principal_distance_m, turn, d_f], rel=1e-9)


@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_covariance_is_propagated(name):
    """By differences of the formula itself with every spot coordinate."""
    root = np.random.default_rng(1).standard_normal((4, 4)) * 1e-2
    before = np.array([[48.0, 47.0], [46.0, 49.0]])

    def value(step):
        return FUNCTIONS[name](before, before + 3.0 + step.reshape(2, 2), root @ root.T, GEOMETRY)

    slope = np.array([(value(d).vector - value(-d).vector).ravel() / 2e-3 for d in 1e-3 * np.eye(4)]).T
    expected = slope @ root @ root.T @ slope.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(value(np.zeros(4)).covariance.reshape(4, 4) / scale, expected / scale, atol=1e-6)


def test_to_dict_units_and_shapes():
    spread = np.diag([ARCSEC, 1, 1, 1e-6]) ** 2
    out = CameraParameters.from_vector([ARCSEC, 2 * ARCSEC, -3 * ARCSEC, 4e-6], spread, 9 * spread).to_dict()
    values = {"d_alpha_arcsec": 1, "d_beta_arcsec": 2, "d_gamma_arcsec": -3, "d_f_um": 4}
    assert {key: out[key] for key in values} == pytest.approx(values)
    # what is stated to move counts in the total alone
    for key in ("d_alpha_arcsec", "d_f_um"):
        assert (out[f"{key}_sigma"], out[f"{key}_sigma_noise"]) == pytest.approx((3, 1))
    assert CameraParameters.from_vector(np.zeros((3, 4)), ZERO).to_dict()["d_f_um"] == [0.0, 0.0, 0.0]


def test_geometry_options_and_errors():
    other = MonitorGeometry(7.68, 0.73, 7e-6, principal_distance_across_m=7.0)
    assert coefficients("derived", other)[0, 1] == pytest.approx(-7e-6 / 28)
    assert coefficients("derived", other)[1, 0] == pytest.approx(-7e-6 / (4 * 7.68))
    refuses(ValueError, "separation_m", MonitorGeometry, 7.68, 0.0, 7e-6)
    refuses(ValueError, "field_beta_rad", MonitorGeometry, 7.68, 0.7, 7e-6, 0.0, 2.0)
    refuses(ValueError, "paper_single", coefficients, "paper", other)
    refuses(ValueError, "2 channels", derived, np.zeros(4), np.zeros(4), ZERO, other)
    refuses(ValueError, "finite", derived, np.full((2, 2), np.nan), np.zeros((2, 2)), ZERO, other)
