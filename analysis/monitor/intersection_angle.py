"""Change of the angle between the lines of sight of two cameras, from what their monitors measured (paper 001,
Fig. 4).

Each camera hangs in the base frame at a look angle: a rotation about Y, positive toward +X (forward). Its line of
sight turns in its own frame by the rotation vector (d_beta about X, d_alpha about Y, 0); d_gamma turns about the line
of sight and leaves it. To first order only the rotation about the common axis Y counts:
change = d_alpha_forward - d_alpha_backward, where "forward" is the camera of the larger look angle. The two cameras'
errors are taken as independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.monitor.monitoring import CameraParameters
from analysis.units import ARCSEC

__all__ = ["IntersectionAngleChange", "exact", "first_order"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IntersectionAngleChange:
    """change_rad: (...) new angle minus nominal angle, rad; sigma_rad: (...) its standard deviation."""

    change_rad: Array
    sigma_rad: Array

    def to_dict(self) -> dict[str, Any]:
        """change_arcsec and change_arcsec_sigma: floats, or nested lists for arrays."""
        return {
            "change_arcsec": (np.asarray(self.change_rad) / ARCSEC).tolist(),
            "change_arcsec_sigma": (np.asarray(self.sigma_rad) / ARCSEC).tolist(),
        }


def first_order(forward: CameraParameters, backward: CameraParameters) -> IntersectionAngleChange:
    """d_alpha_forward - d_alpha_backward. Wrong by some (d_beta_forward - d_beta_backward)^2 / 2 * cot(angle)-sized
    terms.
    """
    change = np.asarray(forward.d_alpha_rad) - np.asarray(backward.d_alpha_rad)
    variance = forward.covariance[..., 0, 0] + backward.covariance[..., 0, 0]
    return IntersectionAngleChange(change, np.sqrt(variance))


def exact(
    forward: CameraParameters, backward: CameraParameters, forward_look_rad: float, backward_look_rad: float
) -> IntersectionAngleChange:
    """Change of the angle between the two turned lines of sight in space, without approximation.

    forward_look_rad, backward_look_rad: look angles, rad, within +-pi/2 and different. Raises ValueError otherwise.
    """
    for name, look in (("forward", forward_look_rad), ("backward", backward_look_rad)):
        if not (math.isfinite(look) and abs(look) < math.pi / 2):
            raise ValueError(f"intersection angle: {name}_look_rad must be within +-pi/2, found {look!r}")
    nominal = abs(forward_look_rad - backward_look_rad)
    if nominal < 1e-3:
        raise ValueError("intersection angle: the cameras look the same way, their angle has no direction to change in")
    looks = (forward_look_rad, backward_look_rad)
    given = [(np.asarray(c.d_alpha_rad, np.float64), np.asarray(c.d_beta_rad, np.float64)) for c in (forward, backward)]

    def angle(values: list[tuple[Array, Array]]) -> Array:
        u, v = (_line_of_sight(a, b, look) for (a, b), look in zip(values, looks, strict=True))
        return np.asarray(np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.sum(u * v, axis=-1)))

    variance: Any = 0.0
    step = 1e-5
    for k, camera in enumerate((forward, backward)):
        slopes = []
        for which in (0, 1):
            ends = []
            for sign in (1, -1):
                moved = list(given)
                pair = list(given[k])
                pair[which] = pair[which] + sign * step
                moved[k] = (pair[0], pair[1])
                ends.append(angle(moved))
            slopes.append((ends[0] - ends[1]) / (2 * step))
        slope = np.stack(np.broadcast_arrays(*slopes), axis=-1)
        variance = variance + np.einsum("...i,...ij,...j->...", slope, camera.covariance[..., :2, :2], slope)
    return IntersectionAngleChange(angle(given) - nominal, np.sqrt(variance))


def _line_of_sight(d_alpha: Array, d_beta: Array, look: float) -> Array:
    """(..., 3) unit vector in the base frame: +Z turned by the rotation vector (d_beta, d_alpha, 0), then by the look
    angle.
    """
    turn = np.hypot(d_alpha, d_beta)
    ratio = np.sinc(turn / np.pi)
    x, y, z = ratio * d_alpha, -ratio * d_beta, np.cos(turn)
    c, s = math.cos(look), math.sin(look)
    return np.stack(np.broadcast_arrays(c * x + s * z, y, c * z - s * x), axis=-1)
