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

from analysis.arrays import Array, OfStates, shows
from analysis.measurement_error import UndeterminedError
from analysis.monitor.monitoring import CameraParameters


@shows()
@dataclass(frozen=True, eq=False)
class IntersectionAngleChange(OfStates):
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
        raise UndeterminedError(
            "intersection angle: the cameras look the same way, their angle has no direction to change in"
        )
    rotations = (forward.d_alpha_rad, forward.d_beta_rad, backward.d_alpha_rad, backward.d_beta_rad)
    given = np.stack(np.broadcast_arrays(*(np.asarray(one, np.float64) for one in rotations)))
    # the angle as it is, and with each rotation a step further and back
    step = 1e-5
    moves = np.concatenate([np.zeros((1, 4)), step * np.eye(4), -step * np.eye(4)]).T
    d_alpha, d_beta, other_alpha, other_beta = given[:, None] + moves.reshape(4, 9, *(1,) * (given.ndim - 1))
    angles = _between(
        _line_of_sight(d_alpha, d_beta, forward_look_rad), _line_of_sight(other_alpha, other_beta, backward_look_rad)
    )
    each = (angles[1:5] - angles[5:]) / (2 * step)
    slopes = [np.stack([each[2 * k], each[2 * k + 1]], axis=-1) for k in range(2)]

    def sigma(own: tuple[Array, Array], shared: Array | None) -> Array:
        variance: Any = 0.0
        for slope, covariance in zip(slopes, own, strict=True):
            variance = variance + np.einsum("...i,...ij,...j->...", slope, covariance[..., :2, :2], slope)
        if shared is not None:
            variance = variance + 2 * np.einsum("...i,...ij,...j->...", slopes[0], shared[..., :2, :2], slopes[1])
        return np.sqrt(variance)

    change = angles[0] - nominal
    noise = sigma((forward.covariance, backward.covariance), across)
    if forward.total is None or backward.total is None:
        return IntersectionAngleChange(change, noise)
    return IntersectionAngleChange(change, sigma((forward.total, backward.total), across_total), noise)


def _between(u: tuple[Array, Array, Array], v: tuple[Array, Array, Array]) -> Array:
    """Angle between unit vectors given by their components."""
    (ux, uy, uz), (vx, vy, vz) = u, v
    sine = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2)
    return np.asarray(np.arctan2(sine, ux * vx + uy * vy + uz * vz))


def _line_of_sight(d_alpha: Array, d_beta: Array, look: float) -> tuple[Array, Array, Array]:
    """Components of the unit vector in the base frame: +Z turned by the rotation vector (d_beta, d_alpha, 0), then by
    the look angle.
    """
    turn = np.hypot(d_alpha, d_beta)
    ratio = np.sinc(turn / np.pi)
    x, y, z = ratio * d_alpha, -ratio * d_beta, np.cos(turn)
    c, s = math.cos(look), math.sin(look)
    return c * x + s * z, y, c * z - s * x
