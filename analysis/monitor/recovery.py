"""From the monitor's images to the changes of every camera: centroids, all estimators, the intersection angle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.monitor import intersection_angle, model_fit, monitoring
from analysis.monitor.calibration import CameraCalibration, MonitorCalibration
from analysis.monitor.intersection_angle import IntersectionAngleChange
from analysis.monitor.monitoring import CameraParameters, shift_covariance
from analysis.spots.centroid import energy_centroid, gaussian_fit, mean_frames
from analysis.spots.likelihood import maximum_likelihood_fit
from analysis.spots.spot_positions import SpotPositions, difference_covariance

__all__ = ["CENTROIDS", "ESTIMATORS", "Recovery", "angles", "estimates", "measure_spots", "recover"]

Array = NDArray[np.float64]
ESTIMATORS = ("paper_single", "paper_joint", "derived", "model")
CENTROIDS = ("ml", "gaussian", "energy")


@dataclass(frozen=True, eq=False)
class Recovery:
    """What the images say, for S states.

    before, after: (S, C, 2) spot positions (row, column), px; sigma_before, sigma_after: their standard deviations.
    shift_covariance: (S, cameras, 4, 4) px^2 of after - before.
    parameters: camera -> estimator -> changes with arrays of shape (S,).
    angle: estimator -> change of the intersection angle, arrays (S,); empty unless there are two cameras.
    """

    before: Array
    after: Array
    sigma_before: Array
    sigma_after: Array
    shift_covariance: Array
    parameters: Mapping[str, Mapping[str, CameraParameters]]
    angle: Mapping[str, IntersectionAngleChange]


def measure_spots(
    mean: Array, frames: int, calibration: MonitorCalibration, centroid: str = "ml", threads: int = 1
) -> SpotPositions:
    """Centre of every spot of mean frames (B, H, W), B a multiple of the number of spots, in the calibration's order.

    centroid: `ml` (the calibrated shape), `gaussian` or `energy` (the paper's).
    Raises SpotError for spots that cannot be measured.
    """
    if centroid == "ml":
        return maximum_likelihood_fit(mean, frames, calibration.noise, calibration.template, threads=threads)
    if centroid == "gaussian":
        return gaussian_fit(mean, frames, calibration.noise)
    if centroid == "energy":
        return energy_centroid(mean, frames, calibration.noise)
    raise ValueError(f"recovery: no centroid {centroid!r}; there are {', '.join(CENTROIDS)}")


def recover(
    before: NDArray[np.uint16],
    after: NDArray[np.uint16],
    calibration: MonitorCalibration,
    centroid: str = "ml",
    threads: int = 1,
) -> Recovery:
    """Recover all parameters.

    before: (C, frames, H, W) or (S, C, frames, H, W) grey values of the nominal state.
    after: (S, C, frames, H, W) grey values of the states to be measured.
    calibration: of the nominal instrument; C must be its number of spots.
    """
    states, spots, frames = after.shape[0], after.shape[1], after.shape[2]
    if spots != calibration.spots or before.shape[-4] != spots:
        raise ValueError(f"recovery: the calibration has {calibration.spots} spots, the images {spots}")
    first = measure_spots(_flat(mean_frames(before)), before.shape[-3], calibration, centroid, threads)
    second = measure_spots(_flat(mean_frames(after)), frames, calibration, centroid, threads)
    spread = difference_covariance(first, second, calibration.noise).reshape(states, len(calibration.cameras), 2, 2, 2)
    joint = shift_covariance(spread[:, :, 0], spread[:, :, 1])
    start = np.broadcast_to(first.position.reshape(-1, spots, 2), (states, spots, 2))
    end = second.position.reshape(states, spots, 2)
    parameters = estimates(start, end, joint, calibration.cameras)
    return Recovery(
        before=start,
        after=end,
        sigma_before=np.broadcast_to(_sigma(first).reshape(-1, spots, 2), (states, spots, 2)),
        sigma_after=_sigma(second).reshape(states, spots, 2),
        shift_covariance=joint,
        parameters=parameters,
        angle=angles(parameters, calibration.cameras),
    )


def estimates(
    start: Array, end: Array, joint: Array, cameras: Mapping[str, CameraCalibration]
) -> dict[str, dict[str, CameraParameters]]:
    """All estimators on spot positions.

    start, end: (S, C, 2) spot positions (row, column) before and after, px, two of each camera in their order.
    joint: (S, cameras, 4, 4) covariance of after - before, px^2; all zero for positions without noise.
    cameras: what is calibrated of each.
    Returns camera -> estimator -> changes with arrays of shape (S,).
    """
    parameters: dict[str, dict[str, CameraParameters]] = {}
    for k, (name, camera) in enumerate(cameras.items()):
        pair = slice(2 * k, 2 * k + 2)
        shift = (end[:, pair] - start[:, pair]).reshape(-1, 4)
        formula = (start[:, pair], end[:, pair], joint[:, k], camera.geometry)
        parameters[name] = {
            "paper_single": monitoring.paper_single(*formula),
            "paper_joint": monitoring.paper_joint(*formula),
            "derived": monitoring.derived(*formula),
            "model": model_fit.fit(shift, joint[:, k], camera.spot_jacobian, camera.parameter_jacobian, camera.motions),
        }
    return parameters


def _flat(mean: Array) -> Array:
    return mean.reshape(-1, *mean.shape[-2:])


def _sigma(positions: SpotPositions) -> Array:
    return np.stack([positions.sigma_row, positions.sigma_column], axis=-1)


def angles(
    parameters: Mapping[str, Mapping[str, CameraParameters]], cameras: Mapping[str, CameraCalibration]
) -> dict[str, IntersectionAngleChange]:
    """Change of the angle between the two lines of sight, by every estimator; the forward camera is the reference."""
    if len(parameters) != 2:
        return {}
    one, two = sorted(parameters, key=lambda name: -cameras[name].look_rad)
    looks = cameras[one].look_rad, cameras[two].look_rad
    return {name: intersection_angle.exact(parameters[one][name], parameters[two][name], *looks) for name in ESTIMATORS}
