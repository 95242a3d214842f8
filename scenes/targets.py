"""Test targets at infinity that a job renders on the line CCDs, and how they are recorded."""

from typing import Annotated

import numpy as np
from pydantic import Field

from scenes.instrument import Frames
from scenes.quantity import Quantity
from scenes.spec import Spec, Whole
from scenes.units import ANGLE, SCALE

TARGET_IMAGES = ("knife_edge", "bars", "star", "pinhole")
"""What ``render.images`` may name beside the monitor's spots."""

EdgeAngle = Annotated[float, Quantity(ANGLE, smallest="2 deg", largest="10 deg")]
White = Annotated[float, Quantity(SCALE, smallest="0.1 percent", largest="100 percent")]


class TargetsSpec(Spec):
    """How the test targets are turned and exposed.

    Attributes:
        angle: of the knife edge against the pixel columns or rows, radians.
        region: side of the recorded images, pixels.
        white: signal of a wide bright area in each frame, as a share of the full well, through a free pupil; what
            bodies in the beam take is missing.
        frames: number of frames, None for as many as there are of the spots.
    """

    angle: EdgeAngle = float(np.radians(5.0))
    region: Annotated[Whole, Field(ge=112, le=512)] = 112
    white: White = 0.6
    frames: Frames | None = None
