"""Before an adjustment: do points lie where their image points look, and does a single image point tell anything?

Both faults else come out as combinations that the points cannot tell: robust weights give up points that are kilometres
off, and then too few are left; noise that is larger than what a launch changes leaves everything open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise
from analysis.orbit.ray_noise import ray_covariance
from analysis.orbit.three_line_model import BIAS, INTERIOR, LineModel, misclosure, partials

Array = NDArray[np.float64]
FARTHEST = 2e3
"""Metres on the ground. No launch, no datum moves half of the points farther: an arc minute is 150 m, a second of a
clock 7 km."""
_EXPECTED = 20.0
"""Sigmas of the start values; points that are farther off than these say are not what was photographed."""


class FarPointsError(CalibrationError):
    """Points lie kilometres from where their image points look, or contradict each other beyond repair."""


class NoiseError(CalibrationError):
    """A single image point is as uncertain as what is to be found. largest: the source that is most of it, "image",
    "attitude", "slow attitude", "station" or "control".
    """

    def __init__(self, message: str, largest: str) -> None:
        super().__init__(message)
        self.largest = largest


def single_ray(fields: Sequence[CalibrationField], cameras: Mapping[str, LineModel], noise: Noise) -> dict[str, float]:
    """Source -> standard deviation of one image point in x or y, metres, median of all: each source of noise alone.

    Args:
        fields: their rays.
        cameras: line -> camera at the start values.
        noise: of image, attitude and station.
    """
    alone = {"image": replace(noise, attitude=0.0, station=0.0, slow_attitude=0.0)}
    tiny = 1e-6 * noise.image
    for term in noise.terms:
        key = term.group.replace(" ", "_")
        alone[term.group] = replace(alone["image"], image=tiny, **{key: term.sigma})
    found: dict[str, list[Array]] = {group: [] for group in alone}
    found["control"] = []
    for one in fields:
        for line, rays in one.rays.items():
            by = partials(cameras[line], rays, one.ground[rays.point], np.zeros(3), np.zeros(3))
            for group, part in alone.items():
                found[group].append(_mean_square(ray_covariance(part, rays, by, shared=True)))
            given = np.where(one.control[:, None, None], one.covariance, 0.0)[rays.point]
            found["control"].append(_mean_square(by.ground @ given @ np.swapaxes(by.ground, 1, 2)))
    return {group: float(np.sqrt(np.median(np.concatenate(rows)))) for group, rows in found.items()}


def check_places(
    fields: Sequence[CalibrationField], cameras: Mapping[str, LineModel], start: Mapping[str, float] | None = None
) -> None:
    """Do control points lie where their image points look, by the start values?

    Args:
        fields: with their control points.
        cameras: line -> camera at the start values.
        start: name -> sigma of a start value, metres or radians; None where nothing is said.

    Raises:
        FarPointsError: half of a field's control points lie farther off than `FARTHEST`, and than 20 sigmas of the
            start values.
    """
    for one in fields:
        far, expected = [], []
        for line, rays in one.rays.items():
            some = rays.taken(one.control[rays.point])
            if not some.point.size:
                continue
            camera, ground = cameras[line], one.ground[some.point]
            distance = np.linalg.norm(ground - some.station, axis=1) / float(camera.principal_distance)
            miss = misclosure(camera, some, ground, np.zeros(3), np.zeros(3))
            far.append(distance * np.linalg.norm(miss, axis=1))
            told = [(start or {}).get(f"{one.name} {n}", 0.0) * float(camera.principal_distance) for n in BIAS[:2]]
            told += [(start or {}).get(f"{line} {n}", 0.0) for n in INTERIOR[1:]]
            expected.append(distance * float(np.linalg.norm(told)))
        if not far:
            continue
        median, limit = float(np.median(np.concatenate(far))), float(np.median(np.concatenate(expected)))
        if median > max(FARTHEST, _EXPECTED * limit):
            raise FarPointsError(
                f"calibration: half of the control points of {one.name} lie {median / 1e3:.3g} km or more from where"
                f" their image points look by the start values, where {limit / 1e3:.2g} km are expected (one sigma)"
            )


def _mean_square(covariance: Array) -> Array:
    """(n,) of the two axes of (n, 2, 2)."""
    return np.asarray(0.5 * np.trace(covariance, axis1=1, axis2=2))
