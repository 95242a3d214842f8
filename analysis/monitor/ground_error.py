"""What changes of a stereo pair's cameras do to points on the ground that are located with the cameras as they were.

Both cameras fly along one circular orbit over a sphere, look down along the track at their look angles, and see a point
one after the other; attitude and orbit are known. A ray at the look angle a meets the ground at the incidence i,
R sin i = (R + h) sin a, after the slant range R sin(i - a) / sin a. A changed camera's ray is the nominal one turned
and, off the line's middle, scaled by the change of its principal distance; the point is found where both rays are
nearest to each other (least squares of the distances). Axes on the ground: along the track, across it (to the right),
up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.arrays import Array, OfStates, shows
from analysis.measurement_error import UndeterminedError

EARTH_RADIUS_M = 6_371_000.0
"""Mean radius (IUGG). The Earth's flattening and turn change the figures here by less than 1 %."""
_PLACES = 9
"""Places along the line over which RMS values are taken."""


@shows()
@dataclass(frozen=True, eq=False)
class GroundError(OfStates):
    """Errors of points on the ground for S states.

    Attributes:
        error_m: (S, 3) along the track, across it and up at the middle of the line, when the cameras' changes are
            ignored: found minus true.
        sigma_m: (S, 3) what is left of it when the cameras are corrected by the estimate, one standard deviation;
            sigma_noise_m: of that what the noise does.
        plan_rms_m, height_rms_m: (S,) likewise, RMS over the line: of both plan axes together, and of the height.
    """

    error_m: Array
    sigma_m: Array
    sigma_noise_m: Array
    plan_rms_m: Array
    height_rms_m: Array


@dataclass(frozen=True)
class GroundGeometry:
    """A pair of line cameras over the ground.

    Attributes:
        altitude_m: of the orbit.
        cameras: names of the two, in the calibration's order.
        looks_rad: their look angles, forward positive.
        half_field: tangent of half the field across the track that both lines see, of each.

    Raises:
        ValueError: a camera does not look at the Earth, or both look the same way.
    """

    altitude_m: float
    cameras: tuple[str, str]
    looks_rad: tuple[float, float]
    half_field: tuple[float, float]

    def __post_init__(self) -> None:
        """Check the geometry."""
        if any(abs(math.sin(a)) * (EARTH_RADIUS_M + self.altitude_m) >= EARTH_RADIUS_M for a in self.looks_rad):
            raise UndeterminedError("ground error: a camera looks past the Earth")
        if abs(self.looks_rad[0] - self.looks_rad[1]) < 1e-3:
            raise UndeterminedError("ground error: the cameras look the same way, their rays do not meet in one point")

    @cached_property
    def incidences_rad(self) -> tuple[float, float]:
        """Angles of the rays from the vertical at the ground."""
        ratio = 1.0 + self.altitude_m / EARTH_RADIUS_M
        first, second = (math.asin(ratio * math.sin(a)) for a in self.looks_rad)
        return first, second

    @cached_property
    def ranges_m(self) -> tuple[float, float]:
        """Slant ranges in the plane of the orbit."""
        first, second = (
            EARTH_RADIUS_M * math.sin(i - a) / math.sin(a) if abs(a) > 1e-9 else self.altitude_m
            for i, a in zip(self.incidences_rad, self.looks_rad, strict=True)
        )
        return first, second

    @cached_property
    def matrices(self) -> Array:
        """(places, 3, 8): metres along, across and up for changes of the first camera, then of the second: d_alpha,
        d_beta, d_gamma (rad), d_f / f. The middle of the line is the middle one.
        """
        reach = min(r * t for r, t in zip(self.ranges_m, self.half_field, strict=True))
        return np.stack([self._at(c) for c in np.linspace(-reach, reach, _PLACES)])

    def _at(self, across: float) -> Array:
        """(3, 8) at one distance across the track, metres."""
        normal, right = np.zeros((3, 3)), []
        for incidence, far in zip(self.incidences_rad, self.ranges_m, strict=True):
            t = across / far
            ray = np.array([0.0, t, 1.0])
            # turns (d_beta, d_alpha, d_gamma) about X, Y, Z of the camera; a longer f narrows the field
            change = np.array([[1.0, 0.0, -t, 0.0], [0.0, -1.0, 0.0, -t], [0.0, t, 0.0, 0.0]])
            c, s = math.cos(incidence), math.sin(incidence)
            level = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])  # along, right, down
            ray, change = level @ ray, level @ change
            square = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            normal += square
            right.append(square @ change * far)
        # rays are taken to lie where they lay: points are found where the change is missing
        found = -np.linalg.solve(normal, np.concatenate(right, axis=1))
        found[2] *= -1.0  # up
        return found

    def rows(self, principal_distances_m: tuple[float, float]) -> Array:
        """(places, 3, 8) as `matrices`, for d_f in metres.

        Args:
            principal_distances_m: of the two cameras.
        """
        out = self.matrices.copy()
        for k, f in enumerate(principal_distances_m):
            out[..., 4 * k + 3] /= f
        return out

    def found(self, true: Array, assumed: Array) -> Array:
        """Error (..., 3) along, across and up of points that are located along assumed rays, exactly.

        Args:
            true: (..., 2, 3) directions of the two rays in the base frame as they are (X along the track, Z down).
            assumed: likewise, as they are taken to be.
        """
        normal: Any = 0.0
        right: Any = 0.0
        for k, (incidence, look, far) in enumerate(
            zip(self.incidences_rad, self.looks_rad, self.ranges_m, strict=True)
        ):
            turn = incidence - look
            c, s = math.cos(turn), math.sin(turn)
            level = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
            real, taken = (np.asarray(v, np.float64)[..., k, :] @ level.T for v in (true, assumed))
            down = np.linalg.norm(taken, axis=-1, keepdims=True)
            taken = taken / down
            station = -far * real / np.linalg.norm(real, axis=-1, keepdims=True)
            square = np.eye(3) - taken[..., :, None] * taken[..., None, :]
            normal = normal + square
            right = right + np.einsum("...ij,...j->...i", square, station)
        out = np.linalg.solve(normal, right[..., None])[..., 0]
        return np.asarray(out * np.array([1.0, 1.0, -1.0]))

    def error(
        self, values: Array, noise: Array, total: Array, principal_distances_m: tuple[float, float]
    ) -> GroundError:
        """Errors on the ground by estimated changes, and what correcting by them leaves.

        Args:
            values: (S, 8) estimated changes, rad and m.
            noise: (S, 8, 8) their covariance by noise.
            total: (S, 8, 8) of their error.
            principal_distances_m: of the two cameras.
        """
        rows = self.rows(principal_distances_m)
        middle = rows[_PLACES // 2]
        left = np.einsum("pai,sij,paj->spa", rows, total, rows)
        return GroundError(
            error_m=values @ middle.T,
            sigma_m=np.sqrt(np.einsum("ai,sij,aj->sa", middle, total, middle)),
            sigma_noise_m=np.sqrt(np.einsum("ai,sij,aj->sa", middle, noise, middle)),
            plan_rms_m=np.sqrt(left[..., :2].sum(axis=-1).mean(axis=-1)),
            height_rms_m=np.sqrt(left[..., 2].mean(axis=-1)),
        )
