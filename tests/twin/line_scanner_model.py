"""A small reader of image support data of the USGS line scanner model: from the ground to the image.

Written from what the community's model does, and held against frozen tables of it; it shares nothing with the exporter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation


class LineScannerModel:
    """An ISD, read.

    Attributes:
        isd: its contents.
    """

    def __init__(self, isd: Mapping[str, Any]) -> None:
        self.isd = isd
        center = isd["center_ephemeris_time"]
        place, pointing = isd["instrument_position"], isd["instrument_pointing"]
        self._place = np.array(place["ephemeris_times"]) - center, 1e3 * np.array(place["positions"])
        self._turn = np.array(pointing["ephemeris_times"]) - center, np.array(pointing["quaternions"])
        coefficients = isd["optical_distortion"]["transverse"]
        self._distortion = np.array([coefficients["x"], coefficients["y"]])

    def image(self, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Line and sample of ground points (N, 3), ITRS, metres; the centre of the first pixel is 0.5, 0.5."""
        line = np.full(len(ground), 0.5 * self.isd["image_lines"])
        sample = np.full(len(ground), 0.5 * self.isd["image_samples"])
        for _ in range(15):
            here, ahead = self._ideal(ground, line), self._ideal(ground, line + 1.0)
            look, beside = self._look(sample), self._look(sample + 1.0)
            jacobian = np.stack([ahead - here, look - beside], axis=-1)
            step = np.linalg.solve(jacobian, (look - here)[..., None])[..., 0]
            line, sample = line + step[:, 0], sample + step[:, 1]
        return line, sample

    def _ideal(self, ground: np.ndarray, line: np.ndarray) -> np.ndarray:
        """Ideal image (N, 2), millimetres, of points at the moments of lines."""
        (first, start, step), f = self.isd["line_scan_rate"][0], self.isd["focal_length_model"]["focal_length"]
        seconds = start + step * (line - first + 0.5)
        turn = Rotation.from_quat(np.roll(_through_eight(*self._turn, seconds), -1, axis=1))
        look = turn.apply(ground - _through_eight(*self._place, seconds))
        return f * look[:, :2] / look[:, 2:]

    def _look(self, sample: np.ndarray) -> np.ndarray:
        """Ideal image (N, 2) of a place on the line, millimetres: the distortion turned round by Newton's method."""
        isd = self.isd
        detector = sample * isd["detector_sample_summing"] + isd["starting_detector_sample"]
        matrix = np.array([isd["focal2pixel_lines"][1:], isd["focal2pixel_samples"][1:]])
        away = np.stack([np.full_like(detector, -isd["detector_center"]["line"]), detector], axis=0)
        away[1] -= isd["detector_center"]["sample"] + isd["focal2pixel_samples"][0]
        real = np.linalg.solve(matrix, away)
        x, y = real.copy()
        one, none = np.ones_like(x), np.zeros_like(x)
        for _ in range(20):
            terms = np.stack([one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
            by_x = np.stack([none, one, none, 2 * x, y, none, 3 * x * x, 2 * x * y, y * y, none])
            by_y = np.stack([none, none, one, none, x, 2 * y, none, x * x, 2 * x * y, 3 * y * y])
            wrong = real - self._distortion @ terms
            (a, c), (b, d) = self._distortion @ by_x, self._distortion @ by_y
            x, y = (
                x + (d * wrong[0] - b * wrong[1]) / (a * d - b * c),
                y + (a * wrong[1] - c * wrong[0]) / (a * d - b * c),
            )
        return np.stack([x, y], axis=-1)


def _through_eight(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Lagrange's polynomial through the eight nodes about each time, fewer near the ends."""
    found = np.empty((len(at), values.shape[1]))
    for k, place in enumerate((at - times[0]) / (times[1] - times[0])):
        before = min(max(int(np.floor(place)), 0), len(times) - 2)
        half = min(4, before + 1, len(times) - 1 - before)
        nodes = np.arange(before - half + 1, before + half + 1)
        weights = [np.prod([(place - j) / (i - j) for j in nodes if j != i]) for i in nodes]
        found[k] = weights @ values[nodes]
    return found
