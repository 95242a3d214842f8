"""What measuring points in images needs: frames with the sensors that are known of them, and a map with heights.

A simulated patch is one such piece of ground, and a user's images with his orthophoto and elevation model are another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin.orbit.flight.sensor import Sensor
from twin.orbit.ground.grid import GroundFrame
from twin.orbit.ground.orthophoto import Map, Maps
from twin.orbit.images.pushbroom import Window

BEYOND = 0.1
"""Pixels: standard deviation added to what the matching claims, for what no fit shows: another season's light (RMS of
matches 0.11 px where 0.06 is claimed), the attitude between its readings. A tie point has it where it was chosen."""


@dataclass(frozen=True, eq=False)
class LineFrame:
    """What a line recorded.

    Attributes:
        frame: grey values, (lines, pixels), columns as pixels of the line.
        window: where it lies in the line's whole image.
        measured: the line as the user knows it, on the measured trajectory.
        sample: distance of two pixels along the line, and of two lines, on the ground in the window's middle, metres.
    """

    frame: np.ndarray
    window: Window
    measured: Sensor
    sample: tuple[float, float]

    def image_point(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Line and pixel of places of the frame (row, column), whole or not."""
        return self.window.first_line + np.asarray(row), self.window.first_pixel + np.asarray(column)


@dataclass(frozen=True, eq=False)
class ImagedGround:
    """A piece of ground, imaged.

    Attributes:
        frame: plane coordinates of the ground, metres east and north of the patch's middle.
        images: line -> what it recorded.
        control: orthophoto and elevation model.
    """

    frame: GroundFrame
    images: Mapping[str, LineFrame]
    control: Maps[Map]
