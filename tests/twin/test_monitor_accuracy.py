"""Without noise: what the images say about the motions that paper 001 is derived for, against the exact trace."""

import itertools

import numpy as np
import pytest

from analysis.monitor import model_fit, monitoring
from analysis.monitor.monitoring import PER_SI
from analysis.monitor.recovery import measure_spots
from analysis.units import ARCSEC
from optics.geometry.tree import Motion
from scenes.specs.instrument import BASE
from twin.monitor.truth import trace_truth

SHIFT, TURN, SCALE = 50e-6, 20 * ARCSEC, 20e-6  # the largest motions that are claimed
ALONE = [tuple(sign * (i == k) for i in range(4)) for k in range(4) for sign in (1, -1)]
TOGETHER = list(itertools.product((1, -1), repeat=4))
MODEL_LIMIT = np.array([1e-3, 1e-3, 0.02, 0.2])  # arcsec, arcsec, arcsec, um
DERIVED_LIMIT = 0.01


def family_state(cameras, signs):
    x, y, turn, scale = signs
    state = {}
    for name in cameras:
        state[f"{BASE}/{name}"] = Motion(scale=scale * SCALE)
        state[f"{BASE}/{name}/focal_plane"] = Motion(rotate=(0, 0, turn * TURN), shift=(x * SHIFT, y * SHIFT, 0))
    return state


@pytest.fixture(scope="module", params=["gf7_pair", "monitor_pair"])
def measured(request, experiment, backend):
    """(states, truth (S, 4), noise-free shifts (S, 4) px, calibration) of every camera."""
    setup = experiment(request.param)
    cameras = list(setup.instrument.cameras)
    signs = ALONE + TOGETHER
    states = [family_state(cameras, s) for s in signs]
    truth = trace_truth(setup.instrument, backend, states)
    photons = setup.path.expected_photons(states)
    calibration = setup.calibration
    first = measure_spots(setup.expected_frames(setup.nominal_photons), 9, calibration).position
    images = setup.expected_frames(photons).reshape(-1, *photons.shape[2:])
    shift = measure_spots(images, 9, calibration).position.reshape(len(states), -1, 2) - first
    out = {}
    for k, name in enumerate(cameras):
        change = truth.cameras[name]
        true = np.stack([change.d_alpha, change.d_beta, change.d_gamma, change.d_f], axis=-1) * PER_SI
        out[name] = (true, shift[:, 2 * k : 2 * k + 2].reshape(-1, 4), calibration.cameras[name])
    return np.array(signs), out


def test_model_recovers_the_family(measured):
    signs, cameras = measured
    worst = np.zeros(4)
    for true, shift, calibration in cameras.values():
        gain = model_fit.gain(np.zeros((4, 4)), calibration.spot_jacobian, calibration.parameter_jacobian)
        worst = np.maximum(worst, np.max(np.abs(shift @ gain.T * PER_SI - true), axis=0))
        assert np.max(np.abs(true), axis=0) == pytest.approx([1.5, 1.5, 20, 150], rel=0.3)  # not a test of nothing
    assert len(signs) == 24
    assert np.all(worst < MODEL_LIMIT), worst


def test_derived_formulas_are_good_to_one_percent(measured):
    signs, cameras = measured
    checked = 0
    for true, shift, calibration in cameras.values():
        reading = shift @ monitoring.coefficients("derived", calibration.geometry).T * PER_SI
        moved = signs != 0  # alone: the parameter that is moved; together: all four
        error = np.abs(reading / np.where(moved, true, 1.0) - 1.0)[moved]
        assert np.max(error) < DERIVED_LIMIT, np.max(error)
        checked += error.size
    assert checked == 2 * (8 + 16 * 4)
