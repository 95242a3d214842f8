"""What the ground knows of the nominal instrument before it is launched: all that the analysis of the images may
use.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.monitor.ground_error import GroundGeometry
from analysis.monitor.monitoring import MonitorGeometry
from analysis.short_repr import shows
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_template import SpotTemplate

Array = NDArray[np.float64]
PAIR = ("left", "right")
"""Names of the channels at the +Y and at the -Y end of a line, which paper 001 numbers 1 and 2."""


@shows()
@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Calibration of one camera's monitor.

    geometry: what the formulas of paper 001 need.
    look_rad: nominal look angle about the base's Y, rad.
    spot_jacobian: (2 n, P) px per unit of motion for the camera's n spots, row and column of one after the other.
    parameter_jacobian: (4, P) d_alpha, d_beta, d_gamma (rad), d_f (m) per unit of motion.
    motions: names of the P motions that the `model` estimator assumes.
    channels: names of the camera's channels, in the order of its spots.
    """

    geometry: MonitorGeometry
    look_rad: float
    spot_jacobian: Array
    parameter_jacobian: Array
    motions: tuple[str, ...]
    channels: tuple[str, ...] = PAIR

    @property
    def pair(self) -> tuple[int, int] | None:
        """Numbers of the left and of the right spot among the camera's own, which the printed formulas are about; None
        where it has no such pair.
        """
        if not set(PAIR) <= set(self.channels):
            return None
        left, right = (self.channels.index(name) for name in PAIR)
        return left, right


@shows()
@dataclass(frozen=True, eq=False)
class MonitorCalibration:
    """Calibration of an instrument's monitor.

    cameras: name -> calibration, in the order of the spots, camera by camera.
    template: calibrated shapes of all spots, in that order.
    noise: of the area CCDs.
    ground: of a pair whose altitude is known, else None.
    """

    cameras: Mapping[str, CameraCalibration]
    template: SpotTemplate
    noise: NoiseModel
    ground: GroundGeometry | None = None

    @property
    def spots(self) -> int:
        """Number of spots, C."""
        return sum(len(camera.channels) for camera in self.cameras.values())
