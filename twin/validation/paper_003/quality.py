"""Third differences of orbit and attitude over the fields, against the errors that the data truly have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.orbit.third_difference import third_difference
from scenes.orbit_setup import CalibrationSetup
from twin.orbit.calibration.campaign import Campaign, FieldPass

_EDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Quality:
    """Passes of all campaigns, (N, K, 3): metres for the orbit's x, y, z in the Earth-fixed frame, radians for roll,
    pitch, yaw of the attitude against the orbital frame.

    Attributes:
        orbit, attitude: RMS of the third differences of what is measured.
        orbit_sigma, attitude_sigma: standard deviation of a reading that they imply.
        orbit_error: RMS of measured minus true. attitude_error: of measured against true, less its mean over the pass.
        attitude_jump: standard deviation of a reading's own error, from measured less true of neighbouring readings.
    """

    orbit: np.ndarray
    attitude: np.ndarray
    orbit_sigma: np.ndarray
    attitude_sigma: np.ndarray
    orbit_error: np.ndarray
    attitude_error: np.ndarray
    attitude_jump: np.ndarray


def quality_of(setup: CalibrationSetup, campaigns: Sequence[Campaign]) -> Quality:
    """Third differences of every pass; truth from the true trajectories."""
    rows = [[_pass(setup, p) for p in one.passes] for one in campaigns]
    return Quality(*(np.array([[p[k] for p in row] for row in rows]) for k in range(7)))


def _pass(setup: CalibrationSetup, one: FieldPass) -> tuple[np.ndarray, ...]:
    errors, measured, true = setup.test.errors, one.measured, one.trajectory
    fixes, looks = (
        _readings(measured.first, measured.last, v) for v in (errors.gps.interval, errors.star_tracker.interval)
    )
    place, turn = measured.position(fixes), measured.body_to_itrs(looks)
    frame = np.swapaxes(true.orbital_to_itrs(looks), 1, 2)
    orbit = third_difference(fixes, place)
    attitude = third_difference(looks, Rotation.from_matrix(frame @ turn).as_rotvec())
    away = place - true.position(fixes)
    error = Rotation.from_matrix(np.swapaxes(true.body_to_itrs(looks), 1, 2) @ turn).as_rotvec()
    error = error - error.mean(axis=0)
    # two readings apart by one step: what is slow cancels, white noise counts twice
    jump = np.sqrt(0.5 * np.mean(np.diff(error, axis=0) ** 2, axis=0))
    rms = (np.sqrt(np.mean(v**2, axis=0)) for v in (away, error))
    return orbit.rms, attitude.rms, orbit.white_sigma, attitude.white_sigma, *rms, jump


def _readings(first: float, last: float, interval: float) -> np.ndarray:
    """Times of the readings inside the span, seconds."""
    return interval * np.arange(np.ceil(first / interval - _EDGE), np.floor(last / interval + _EDGE) + 1.0)
