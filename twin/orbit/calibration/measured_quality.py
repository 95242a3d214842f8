"""What measurements alone tell of a calibration: do rays of check points meet, how large is a pixel on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from analysis.orbit.adjustment import Adjustment
from analysis.orbit.forward_intersection import intersect
from twin.orbit.calibration.campaign import Campaign, FieldPass


@dataclass(frozen=True)
class Meeting:
    """How well the rays of check points meet, by the sigmas of image points and readings.

    Attributes:
        chi_square: of all of them.
        degrees_of_freedom: two for each ray less three for each point.
    """

    chi_square: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one. Points exposed within a few readings err alike, and the
        calibration's own errors are in it.
        """
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))


def meeting_of(campaign: Campaign, one: FieldPass, adjustment: Adjustment) -> Meeting:
    """Of a pass's check points, by cameras and bias of an adjustment.

    Raises:
        CalibrationError: they cannot be intersected.
    """
    found = intersect(one.check, adjustment.cameras_of(one.name), campaign.noise, bias=adjustment.bias(one.name))
    seen = found.rays > 1
    return Meeting(float(np.sum(found.chi_square[seen])), int(np.sum(2 * found.rays[seen] - 3)))


def ground_sample(one: FieldPass, line: str) -> tuple[float, float]:
    """Ground sample distance of the middle of a line's image along and across the track, metres."""
    sensor = one.data.sensors[line]
    row = one.control_images.get(line)
    middle = 0.5 * (sensor.lines - 1) if row is None or not len(row.line) else float(np.mean(row.line))
    pixel = 0.5 * (sensor.camera.pixels - 1)
    step = 0.5 if 0.0 <= middle - 0.5 and middle + 0.5 <= sensor.lines - 1 else 0.25
    places = np.array([[middle - step, pixel], [middle + step, pixel], [middle, pixel - step], [middle, pixel + step]])
    ground = sensor.ground(places[:, 0], places[:, 1], one.data.height)
    along, across = (float(np.linalg.norm(ground[k + 1] - ground[k])) / (2.0 * step) for k in (0, 2))
    return along, across
