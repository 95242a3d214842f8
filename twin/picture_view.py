"""Cameras of the pictures: where they stand so that given points fill the picture, and where a point appears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera; +Z of the base frame is up in the picture.

    Attributes:
        eye: where it stands, metres.
        forward, right, up: unit vectors in the base frame.
        half_width: tangent of half the horizontal field.
        width, height: of the picture, pixels.
    """

    eye: np.ndarray
    forward: np.ndarray
    right: np.ndarray
    up: np.ndarray
    half_width: float
    width: int
    height: int

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (N, 3) -> column and row, (N, 2) pixels from the picture's top left corner."""
        away = np.asarray(points, dtype=float) - self.eye
        scale = 0.5 * self.width / self.half_width / (away @ self.forward)
        return np.stack(
            [0.5 * self.width + scale * (away @ self.right), 0.5 * self.height - scale * (away @ self.up)], axis=-1
        )

    def pixel_at(self, points: np.ndarray) -> float:
        """Size of a pixel in the middle of points, metres."""
        depth = float((np.asarray(points) - self.eye).mean(axis=0) @ self.forward)
        return 2.0 * self.half_width * depth / self.width

    @property
    def horizontal_field(self) -> float:
        """Horizontal field of view, degrees."""
        return float(np.degrees(2.0 * np.arctan(self.half_width)))


def looking(azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forward, right and up of a camera that stands at an azimuth (from +X toward +Y) and elevation, degrees."""
    a, e = np.radians([azimuth, elevation])
    forward = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return forward, right, np.cross(right, forward)


def framed(
    points: np.ndarray,
    azimuth: float,
    elevation: float,
    field: float,
    size: tuple[int, int],
    margin: float = 0.04,
) -> View:
    """The nearest camera of a direction that has all points in its picture.

    Args:
        points: (N, 3), metres.
        azimuth: of the camera as seen from the points, from +X toward +Y, degrees.
        elevation: likewise, toward +Z, degrees.
        field: horizontal field of view, degrees.
        size: width and height, pixels.
        margin: share of the width that stays free on every side.
    """
    width, height = size
    forward, right, up = looking(azimuth, elevation)
    half_width = float(np.tan(np.radians(0.5 * field)))
    depth = points @ forward
    slope = np.array([1.0 - 2.0 * margin, height / width - 2.0 * margin]) * half_width
    middle, distance = np.zeros(2), np.zeros(2)
    for i, axis in enumerate((right, up)):
        # both edges of the picture touch the outermost points: |across - middle| = slope (depth - distance)
        across = points @ axis
        high, low = np.max(across - slope[i] * depth), np.max(-across - slope[i] * depth)
        middle[i], distance[i] = 0.5 * (high - low), -0.5 * (high + low) / slope[i]
    eye = middle[0] * right + middle[1] * up + float(distance.min()) * forward
    return View(eye, forward, right, up, half_width, width, height)
