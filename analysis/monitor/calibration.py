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
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_template import SpotTemplate

__all__ = ["CameraCalibration", "MonitorCalibration"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Calibration of one camera's monitor.

    geometry: what the formulas of paper 001 need.
    look_rad: nominal look angle about the base's Y, rad.
    spot_jacobian: (4, P) px per unit of motion, rows [left row, left column, right row, right column].
    parameter_jacobian: (4, P) d_alpha, d_beta, d_gamma (rad), d_f (m) per unit of motion.
    motions: names of the P motions that the `model` estimator assumes.
    """

    geometry: MonitorGeometry
    look_rad: float
    spot_jacobian: Array
    parameter_jacobian: Array
    motions: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MonitorCalibration:
    """Calibration of an instrument's monitor.

    cameras: name -> calibration, in the order of the spots: each camera has two spots, left before right.
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
        """Number of spots, C = 2 x cameras."""
        return 2 * len(self.cameras)
