"""Change of the angle between the lines of sight of two cameras, from what their monitors measured (paper 001,
Fig. 4).

Each camera hangs in the base frame at a look angle: a rotation about Y, positive toward +X (forward). Its line of
sight turns in its own frame by the rotation vector (d_beta about X, d_alpha about Y, 0); d_gamma turns about the line
of sight and leaves it. To first order only the rotation about the common axis Y counts:
change = d_alpha_forward - d_alpha_backward, where "forward" is the camera of the larger look angle. Unless the
covariance between the two cameras is given, their errors are taken as independent.
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
    """change_rad: (...) new angle minus nominal angle, rad; sigma_rad: (...) standard deviation of its error;
    sigma_noise_rad: of that what the noise of the images does, None where that is all.
    """

    change_rad: Array
    sigma_rad: Array
    sigma_noise_rad: Array | None = None

    @property
    def noise_rad(self) -> Array:
        """(...) standard deviation by the noise of the images alone, rad."""
        return self.sigma_rad if self.sigma_noise_rad is None else self.sigma_noise_rad

    def at(self, states: slice) -> IntersectionAngleChange:
        """Those of some states, along the first axis.

        Args:
            states: which.
        """
        noise = None if self.sigma_noise_rad is None else self.sigma_noise_rad[states]
        return IntersectionAngleChange(self.change_rad[states], self.sigma_rad[states], noise)

    def to_dict(self) -> dict[str, Any]:
        """change_arcsec, change_arcsec_sigma and change_arcsec_sigma_noise: floats, or nested lists for arrays."""
        return {
            "change_arcsec": (np.asarray(self.change_rad) / ARCSEC).tolist(),
            "change_arcsec_sigma": (np.asarray(self.sigma_rad) / ARCSEC).tolist(),
            "change_arcsec_sigma_noise": (np.asarray(self.noise_rad) / ARCSEC).tolist(),
        }


def first_order(forward: CameraParameters, backward: CameraParameters) -> IntersectionAngleChange:
    """d_alpha_forward - d_alpha_backward. Wrong by some (d_beta_forward - d_beta_backward)^2 / 2 * cot(angle)-sized
    terms.
    """
    change = np.asarray(forward.d_alpha_rad) - np.asarray(backward.d_alpha_rad)
    variance = forward.covariance[..., 0, 0] + backward.covariance[..., 0, 0]
    return IntersectionAngleChange(change, np.sqrt(variance))


def exact(
    forward: CameraParameters,
    backward: CameraParameters,
    forward_look_rad: float,
    backward_look_rad: float,
    across: Array | None = None,
    across_total: Array | None = None,
) -> IntersectionAngleChange:
    """Change of the angle between the two turned lines of sight in space, without approximation.

    Raises ValueError for look angles that are not within +-pi/2 and different.

    Args:
        forward: changes of the camera of the larger look angle.
        backward: of the other.
        forward_look_rad: its look angle, rad.
        backward_look_rad: likewise.
        across: (..., 4, 4) covariance of the forward with the backward parameters by noise, None for none.
        across_total: likewise of the whole error.
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

    step = 1e-5
    slopes: list[Array] = []
    for k in range(2):
        both = []
        for which in (0, 1):
            ends = []
            for sign in (1, -1):
                moved = list(given)
                pair = list(given[k])
                pair[which] = pair[which] + sign * step
                moved[k] = (pair[0], pair[1])
                ends.append(angle(moved))
            both.append((ends[0] - ends[1]) / (2 * step))
        slopes.append(np.stack(np.broadcast_arrays(*both), axis=-1))

    def sigma(own: tuple[Array, Array], shared: Array | None) -> Array:
        variance: Any = 0.0
        for slope, covariance in zip(slopes, own, strict=True):
            variance = variance + np.einsum("...i,...ij,...j->...", slope, covariance[..., :2, :2], slope)
        if shared is not None:
            variance = variance + 2 * np.einsum("...i,...ij,...j->...", slopes[0], shared[..., :2, :2], slopes[1])
        return np.sqrt(variance)

    change = angle(given) - nominal
    noise = sigma((forward.covariance, backward.covariance), across)
    if forward.total is None or backward.total is None:
        return IntersectionAngleChange(change, noise)
    return IntersectionAngleChange(change, sigma((forward.total, backward.total), across_total), noise)


def _line_of_sight(d_alpha: Array, d_beta: Array, look: float) -> Array:
    """(..., 3) unit vector in the base frame: +Z turned by the rotation vector (d_beta, d_alpha, 0), then by the look
    angle.
    """
    turn = np.hypot(d_alpha, d_beta)
    ratio = np.sinc(turn / np.pi)
    x, y, z = ratio * d_alpha, -ratio * d_beta, np.cos(turn)
    c, s = math.cos(look), math.sin(look)
    return np.stack(np.broadcast_arrays(c * x + s * z, y, c * z - s * x), axis=-1)
