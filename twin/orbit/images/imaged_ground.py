"""What measuring points in images needs: frames with the sensors that are known of them, and a map with heights.

A simulated patch is one such piece of ground, and a user's images with his orthophoto and elevation model are another.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from twin.orbit.flight.sensor import Sensor
from twin.orbit.ground.grid import GroundFrame

BEYOND = 0.1
"""Pixels: standard deviation added to what the matching claims, for what no fit shows: another season's light (RMS of
matches 0.11 px where 0.06 is claimed), the attitude between its readings. A tie point has it where it was chosen."""


class Map(Protocol):
    """A raster whose places are known."""

    @property
    def values(self) -> np.ndarray:
        """(rows, columns)."""

    @property
    def valid(self) -> np.ndarray | None:
        """(rows, columns) bool: which values there are; None for all."""

    @property
    def spacing(self) -> float:
        """Of rows and columns on the ground, metres."""

    def east_north(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of places (row, column), whole or not, metres, broadcast."""

    def row_column(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse."""


class Place(Protocol):
    """Where a frame lies in a line's whole image."""

    @property
    def first_line(self) -> int:
        """Of its first row."""

    @property
    def first_pixel(self) -> int:
        """Of its first column."""


class Frame(Protocol):
    """What a line recorded."""

    @property
    def frame(self) -> np.ndarray:
        """Grey values, (lines, pixels)."""

    @property
    def window(self) -> Place:
        """Where it lies in the line's whole image."""

    @property
    def measured(self) -> Sensor:
        """The line as it is known on the measured trajectory."""

    @property
    def sample(self) -> tuple[float, float]:
        """Distance of pixels and of lines on the ground, metres."""

    def image_point(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Line and pixel of places of the frame (row, column), whole or not."""


class Maps(Protocol):
    """What is known of the ground."""

    @property
    def orthophoto(self) -> Map:
        """Grey values."""

    @property
    def dem(self) -> Map:
        """Heights above the ellipsoid, metres."""


class ImagedGround(Protocol):
    """A piece of ground, imaged."""

    @property
    def frame(self) -> GroundFrame:
        """Plane coordinates of the ground."""

    @property
    def images(self) -> Mapping[str, Frame]:
        """Line -> what it recorded."""

    @property
    def control(self) -> Maps:
        """Orthophoto and elevation model."""
