"""What becomes of a three-line camera: changes since the laboratory that stay, and a drift of its lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from optics.geometry.pose import about_axis, rotation_matrix
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import OrbitCalibrationSpec
    from scenes.specs.orbit.simulate import OrbitSimulateSpec


def changed_payload(
    spec: OrbitCalibrationSpec | OrbitSimulateSpec, payload: ThreeLineCameraSpec
) -> ThreeLineCameraSpec:
    """The camera as it is after launch.

    Args:
        spec: a test, whose ``changes`` name lines.
        payload: as the laboratory has measured it.
    """
    lines = {}
    for name, line in payload.lines.items():
        if name in spec.changes:
            change = spec.changes[name]
            point = tuple(a + b for a, b in zip(line.principal_point, change.principal_point, strict=True))
            focal = line.focal_length + change.focal_length
            line = line.model_copy(update={"focal_length": focal, "principal_point": point})
        lines[name] = line
    return payload.model_copy(update={"lines": FrozenMap(lines)})


def drifted_payload(payload: ThreeLineCameraSpec, drift: Mapping[str, np.ndarray]) -> ThreeLineCameraSpec:
    """The camera with each line turned in its own axes, Rx(d_beta) Ry(d_alpha) Rz(d_gamma), and with f + d_f.

    Args:
        payload: the camera.
        drift: line -> (4,) d_alpha, d_beta, d_gamma (radians) and d_f (metres).
    """
    lines = dict(payload.lines)
    for name, (alpha, beta, gamma, longer) in drift.items():
        line = lines[name]
        turn = (
            rotation_matrix(np.array(line.rotate)) @ about_axis(0, beta) @ about_axis(1, alpha) @ about_axis(2, gamma)
        )
        rotate = tuple(Rotation.from_matrix(turn).as_rotvec().tolist())
        lines[name] = line.model_copy(update={"rotate": rotate, "focal_length": line.focal_length + float(longer)})
    return payload.model_copy(update={"lines": FrozenMap(lines)})
