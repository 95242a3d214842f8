"""Cameras that change from field to field: what is drawn, the camera as it then is, and what a monitor reads of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from optics.frozen_map import FrozenMap
from optics.rotation import about_axis, rotation_matrix
from scenes.orbit_angle import LINES
from scenes.three_line_camera import ThreeLineCameraSpec
from twin.orbit.ground.random_field import stream

if TYPE_CHECKING:
    from scenes.orbit_calibration import OrbitCalibrationSpec

_DRIFT, _READING = 6, 7
"""Streams of a field's seed. What else is drawn of a field does not change with them."""


def drawn_drift(spec: OrbitCalibrationSpec, seed: np.random.SeedSequence) -> FrozenMap[str, np.ndarray]:
    """Line -> (4,) true d_alpha, d_beta, d_gamma (radians) and d_f (metres) during one field; empty for no drift.

    The draws of a line are the same whatever their sigmas are.

    Args:
        spec: the test.
        seed: of the field.
    """
    if not spec.drift:
        return FrozenMap({})
    unit = np.random.default_rng(stream(seed, _DRIFT)).standard_normal((len(LINES), 4))
    sigma = {name: np.array([*one.angles, one.focal_length]) for name, one in spec.drift.items()}
    return FrozenMap({name: sigma.get(name, np.zeros(4)) * row for name, row in zip(LINES, unit, strict=True)})


def drawn_readings(
    spec: OrbitCalibrationSpec, drift: Mapping[str, np.ndarray], seed: np.random.SeedSequence
) -> FrozenMap[str, np.ndarray]:
    """Line -> (4,) what the monitor reads, in the same units; empty for no monitor.

    Args:
        spec: the test.
        drift: the true one.
        seed: of the field.
    """
    if spec.monitor is None:
        return FrozenMap({})
    noise = np.random.default_rng(stream(seed, _READING)).standard_normal((len(LINES), 4))
    sigma = reading_sigma(spec) * spec.errors.switched_on
    return FrozenMap({name: drift[name] + sigma * row for name, row in zip(LINES, noise, strict=True)})


def reading_sigma(spec: OrbitCalibrationSpec) -> np.ndarray:
    """(4,) standard deviation of the monitor's readings of a camera, radians and metres. The test has a monitor."""
    assert spec.monitor is not None
    return np.array([*spec.monitor.angles, spec.monitor.focal_length])


def drifted_payload(payload: ThreeLineCameraSpec, drift: Mapping[str, np.ndarray]) -> ThreeLineCameraSpec:
    """The camera with each line turned in its own axes, Rx(d_beta) Ry(d_alpha) Rz(d_gamma), and with f + d_f."""
    lines = dict(payload.lines)
    for name, (alpha, beta, gamma, longer) in drift.items():
        line = lines[name]
        turn = (
            rotation_matrix(np.array(line.rotate)) @ about_axis(0, beta) @ about_axis(1, alpha) @ about_axis(2, gamma)
        )
        rotate = tuple(Rotation.from_matrix(turn).as_rotvec().tolist())
        lines[name] = line.model_copy(update={"rotate": rotate, "focal_length": line.focal_length + float(longer)})
    return payload.model_copy(update={"lines": FrozenMap(lines)})
