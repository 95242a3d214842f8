"""From the monitor's images to the changes of every camera: centroids, all estimators, the intersection angle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.monitor import intersection_angle, model_fit, monitoring
from analysis.monitor.calibration import CameraCalibration, MonitorCalibration
from analysis.monitor.intersection_angle import IntersectionAngleChange
from analysis.monitor.monitoring import CameraParameters, MonitorGeometry, shift_covariance
from analysis.spots.centroid import energy_centroid, gaussian_fit, mean_frames
from analysis.spots.likelihood import maximum_likelihood_fit
from analysis.spots.spot_positions import SpotPositions, difference_covariance

__all__ = ["CENTROIDS", "ESTIMATORS", "Estimator", "Recovery", "angles", "estimates", "measure_spots", "recover"]

Array = NDArray[np.float64]
CENTROIDS = ("ml", "gaussian", "energy")

Reading = Callable[[Array, Array, Array, CameraCalibration], CameraParameters]
"""Spot positions before and after, (S, 2 sides, 2) px, covariance of after - before, (S, 4, 4) px^2 (zeros without
noise), and what is calibrated of the camera -> the camera's changes, arrays (S,).
"""


@dataclass(frozen=True)
class Estimator:
    """How shifts of a camera's two spots become changes of the camera.

    title: for readers, a word or two. note: for readers, what it is. coefficients: of a calibrated camera, the (4, 4)
        matrix of its readings to first order as `monitoring.coefficients` gives it.
    reading: what it says; None where the matrix is all of it.
    """

    title: str
    note: str
    coefficients: Callable[[CameraCalibration], Array]
    reading: Reading | None = None

    def parameters(self, before: Array, after: Array, covariance: Array, camera: CameraCalibration) -> CameraParameters:
        """The camera's changes, see `Reading`.

        Args:
            before: spot positions of the nominal state, (..., 2 sides, 2), row and column, px.
            after: of the states, likewise.
            covariance: of after - before, (..., 4, 4), px^2.
            camera: its calibration.
        """
        if self.reading is not None:
            return self.reading(before, after, covariance, camera)
        return CameraParameters.from_vector(*monitoring.linear(self.coefficients(camera), before, after, covariance))


def _formula(
    name: str,
    title: str,
    note: str,
    formula: Callable[[ArrayLike, ArrayLike, ArrayLike, MonitorGeometry], CameraParameters] | None = None,
) -> Estimator:
    """A set of formulas of `monitoring`."""
    reading: Reading | None = None
    if formula is not None:
        exact = formula

        def reading(before: Array, after: Array, covariance: Array, camera: CameraCalibration) -> CameraParameters:
            return exact(before, after, covariance, camera.geometry)

    return Estimator(title, note, lambda camera: monitoring.coefficients(name, camera.geometry), reading)


def _model_coefficients(camera: CameraCalibration) -> Array:
    gain: Array = camera.parameter_jacobian @ np.linalg.pinv(camera.spot_jacobian, rcond=1e-14)
    return gain


def _model(before: Array, after: Array, covariance: Array, camera: CameraCalibration) -> CameraParameters:
    shift = (after - before).reshape(-1, 4)
    return model_fit.fit(shift, covariance, camera.spot_jacobian, camera.parameter_jacobian, camera.motions)


ESTIMATORS: dict[str, Estimator] = {
    "paper_single": _formula(
        "paper_single",
        "printed, single",
        "eqs. (2), (3), (5), (7) of Wang et al. (2018) as printed",
        monitoring.paper_single,
    ),
    "paper_joint": _formula("paper_joint", "printed, joint", "joint changes as Wang et al. (2018) print them"),
    "derived": _formula(
        "derived",
        "derived",
        "the same spot coordinates with the factors of a plane return, plate scale and distortion calibrated",
    ),
    "model": Estimator(
        "model",
        "weighted least squares on all spot coordinates with the Jacobian of the traced instrument",
        _model_coefficients,
        _model,
    ),
}
"""Name in the results -> estimator, in the order of tables. A new one is added here: it then stands in recovered.json,
crosstalk.json, the tables and the figures.
"""


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

    Raises SpotError for spots that cannot be measured.

    Args:
        mean: mean frames, (B, H, W), grey values.
        frames: number of frames of each mean.
        calibration: of the nominal instrument.
        centroid: `ml` (the calibrated shape), `gaussian` or `energy` (the paper's).
        threads: for the fits; results do not depend on it.
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

    Args:
        before: (C, frames, H, W) or (S, C, frames, H, W) grey values of the nominal state.
        after: (S, C, frames, H, W) grey values of the states to be measured.
        calibration: of the nominal instrument; C must be its number of spots.
        centroid: `ml`, `gaussian` or `energy`.
        threads: for the fits; results do not depend on it.
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

    Returns camera -> estimator -> changes with arrays of shape (S,).

    Args:
        start: (S, C, 2) spot positions (row, column) before, px, two of each camera in their order.
        end: those after, likewise.
        joint: (S, cameras, 4, 4) covariance of after - before, px^2; all zero for positions without noise.
        cameras: what is calibrated of each.
    """
    parameters: dict[str, dict[str, CameraParameters]] = {}
    for k, (name, camera) in enumerate(cameras.items()):
        pair = slice(2 * k, 2 * k + 2)
        seen = (start[:, pair], end[:, pair], joint[:, k], camera)
        parameters[name] = {title: estimator.parameters(*seen) for title, estimator in ESTIMATORS.items()}
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
