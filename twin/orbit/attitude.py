"""How the satellite holds itself: the orbital frame, nadir pointing and yaw steering.

The orbital frame has Z down, X forward and Y = Z x X, which lies to the right of the track and against the orbit's
angular momentum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optics.rotation import rotation_matrix
from twin.orbit.earth import Earth, curvature_radii, east_north_up

if TYPE_CHECKING:
    from scenes.orbit_spec import AttitudeSpec


@dataclass(frozen=True)
class Attitude:
    """A law of attitude.

    Attributes:
        geodetic: Z points along the ellipsoid's normal through the satellite; else to the Earth's centre.
        yaw_steering: X lies along the motion of the point below over the turning Earth, so that the image of that point
            moves square to a line along Y; else along the velocity against the stars.
        offset: rotation vector of the body against the orbital frame, radians.
    """

    geodetic: bool = True
    yaw_steering: bool = False
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_spec(cls, spec: AttitudeSpec) -> Attitude:
        """From what the file says."""
        return cls(spec.nadir == "geodetic", spec.steering == "yaw", spec.offset)

    def orbital_to_itrs(self, position: np.ndarray, velocity: np.ndarray, inertial_velocity: np.ndarray) -> np.ndarray:
        """Axes of the orbital frame as columns: x_itrs = matrix @ x_orbital.

        Args:
            position: ITRS, metres, shape (..., 3).
            velocity: against the turning Earth, m/s, shape (..., 3).
            inertial_velocity: against the stars, in axes of the ITRS, m/s, shape (..., 3).

        Returns:
            Shape (..., 3, 3).
        """
        chosen = velocity if self.yaw_steering else inertial_velocity
        if self.geodetic:
            lon, lat, height = Earth().geodetic(position)
            level = east_north_up(lon, lat)
            up = level[..., 2, :]
            east, north = (np.sum(level[..., k, :] * chosen, axis=-1) for k in (0, 1))
            if self.yaw_steering:
                # the point below moves slower than the satellite, and not alike along and across the meridian
                meridian, normal = curvature_radii(lat)
                east, north = east * normal / (normal + height), north * meridian / (meridian + height)
            forward = east[..., None] * level[..., 0, :] + north[..., None] * level[..., 1, :]
        else:
            # the point below runs along its own radius as well, which moves it along the line of sight only
            up = position / np.linalg.norm(position, axis=-1, keepdims=True)
            forward = chosen - np.sum(chosen * up, axis=-1, keepdims=True) * up
        x = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
        return np.stack([x, np.cross(-up, x), -up], axis=-1)

    def body_to_itrs(self, position: np.ndarray, velocity: np.ndarray, inertial_velocity: np.ndarray) -> np.ndarray:
        """Axes of the body as columns, (..., 3, 3): x_itrs = matrix @ x_body; arguments as `orbital_to_itrs`."""
        return self.orbital_to_itrs(position, velocity, inertial_velocity) @ rotation_matrix(self.offset)
