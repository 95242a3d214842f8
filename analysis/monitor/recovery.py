"""From the monitor's images to the changes of every camera: centroids, all estimators, the intersection angle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, OfStates, shows
from analysis.monitor import intersection_angle
from analysis.monitor.curvature import Curvature, LinearReading, MotionModel, read_again
from analysis.monitor.disturbances import Consistency, Disturbances, consistency
from analysis.monitor.estimators import PARAMETERS_EACH, Shifts, applicable
from analysis.monitor.ground_error import GroundError, GroundGeometry
from analysis.monitor.intersection_angle import IntersectionAngleChange
from analysis.monitor.limits import quantities
from analysis.monitor.monitoring import CameraParameters
from analysis.monitor.parameters import CameraCalibration, MonitorCalibration
from analysis.monitor.spot_evidence import SpotEvidence
from analysis.spots.centroid import CENTROIDS, mean_frames
from analysis.spots.likelihood import FitStates, fit_states, require_rest, widened
from analysis.spots.spot_positions import NoiseParts, SpotPositions, difference_covariance, noise_parts

MeasuredSpots: TypeAlias = tuple[SpotPositions, FitStates]
"""Spots with how good their fits are."""


@shows()
@dataclass(frozen=True, eq=False)
class Estimates:
    """What all estimators make of spot positions, for S states.

    parameters: camera -> estimator -> changes with arrays of shape (S,).
    angle: estimator -> change of the intersection angle, arrays (S,); empty unless there are two cameras.
    ground: estimator -> errors on the ground, arrays (S,); empty unless the altitude of a pair is known.
    curvature: estimator -> whether its motions are small enough to be linear; of those that were traced again.
    """

    parameters: Mapping[str, Mapping[str, CameraParameters]]
    angle: Mapping[str, IntersectionAngleChange]
    ground: Mapping[str, GroundError]
    curvature: Mapping[str, Curvature] = field(default_factory=dict)


@shows("parameters", "before [px]", "after [px]", "sigma_after [px]")
@dataclass(frozen=True, eq=False)
class Recovery(OfStates):
    """What the images say, for S states.

    before, after: (S, C, 2) spot positions (row, column), px; sigma_before, sigma_after: their standard deviations.
    shift_covariance: (S, 2 C, 2 C) px^2 of ``shift``; spots are independent of each other.
    parameters: camera -> estimator -> changes with arrays of shape (S,).
    angle: estimator -> change of the intersection angle, arrays (S,); empty unless there are two cameras.
    ground: estimator -> errors on the ground, arrays (S,); empty unless the altitude of a pair is known.
    parts: noise of the positions before (C spots) and after (S C), for series of measurements; None unless kept.
    evidence: what the fits of the spots say of their sigmas; None where nobody judged them.
    curvature: estimator -> whether its motions are small enough to be linear; of those that were traced again.
    """

    before: Array
    after: Array
    sigma_before: Array
    sigma_after: Array
    shift_covariance: Array
    parameters: Mapping[str, Mapping[str, CameraParameters]]
    angle: Mapping[str, IntersectionAngleChange]
    ground: Mapping[str, GroundError] = field(default_factory=dict)
    parts: tuple[NoiseParts, NoiseParts] | None = None
    evidence: SpotEvidence | None = None
    curvature: Mapping[str, Curvature] = field(default_factory=dict)

    def at(self, states: slice) -> Recovery:
        """The recovery of some states, without ``parts``.

        Args:
            states: which.
        """
        return OfStates.at(replace(self, parts=None), states)

    @property
    def shift(self) -> Array:
        """(S, 2 C) after - before in the order of the spots, row and column, px."""
        return (self.after - self.before).reshape(len(self.after), -1)

    def consistency(
        self, disturbances: Disturbances, state: int = 0, others: Mapping[str, Array] | None = None
    ) -> Consistency:
        """Do the shifts of one state agree with what is stated?

        Args:
            disturbances: stated.
            state: its number.
            others: see `analysis.monitor.disturbances.consistency`.
        """
        return consistency(self.shift[state], self.shift_covariance[state], disturbances, others)


def measure_spots(
    mean: Array, frames: int, calibration: MonitorCalibration, centroid: str = "ml", threads: int = 1
) -> SpotPositions:
    """Centre of every spot of mean frames (B, H, W), B a multiple of the number of spots, in the calibration's order.

    Raises SpotError for spots that cannot be measured, and for those whose fit does not come to rest.

    Args:
        mean: mean frames, (B, H, W), grey values.
        frames: number of frames of each mean.
        calibration: of the nominal instrument.
        centroid: name of a method of `analysis.spots.centroid.CENTROIDS`.
        threads: for the fits; results do not depend on it.
    """
    if centroid not in CENTROIDS:
        raise ValueError(f"recovery: no centroid {centroid!r}; there are {', '.join(CENTROIDS)}")
    return require_rest(CENTROIDS[centroid](mean, frames, calibration.noise, calibration.template, threads))


def judged_spots(
    mean: Array, frames: int, calibration: MonitorCalibration, centroid: str = "ml", threads: int = 1
) -> tuple[SpotPositions, FitStates]:
    """Measure spots with the sigmas that their fits leave them, and judge the fits, (B / C, C).

    Args:
        mean: as of `measure_spots`, as all others.
        frames: of each mean.
        calibration: of the nominal instrument.
        centroid: `ml`, `gaussian` or `energy`.
        threads: for the fits.
    """
    found = measure_spots(mean, frames, calibration, centroid, threads)
    states = fit_states(found)
    return widened(found, states.widening), states.reshaped(calibration.template.count)


def recover(
    before: NDArray[Any] | MeasuredSpots,
    after: NDArray[Any],
    calibration: MonitorCalibration,
    centroid: str = "ml",
    threads: int = 1,
    disturbances: Disturbances | None = None,
    keep_parts: bool = False,
    motions: Mapping[str, MotionModel] | None = None,
    frames: int | None = None,
) -> Recovery:
    """Recover all parameters.

    Args:
        before: (C, frames, H, W) or (S, C, frames, H, W) grey values of the nominal state, or what `judged_spots` gave
            of them.
        after: (S, C, frames, H, W) grey values of the states to be measured.
        calibration: of the nominal instrument; C must be its number of spots.
        centroid: `ml`, `gaussian` or `energy`.
        threads: for the fits; results do not depend on it.
        disturbances: what is stated to move; without it there is no `posterior`, and all sigmas are those of the noise
            alone.
        keep_parts: of the noise, which are large.
        motions: estimator -> the motions by which it reads, traced again to see whether they are linear; None to take
            them so.
        frames: of which each image is the mean, (C, H, W) and (S, C, H, W); None where these are frames.
    """
    spots = after.shape[1]
    axis = -4 if frames is None else -3
    if spots != calibration.spots or (isinstance(before, np.ndarray) and before.shape[axis] != spots):
        raise ValueError(f"recovery: the calibration has {calibration.spots} spots, the images {spots}")

    def judged(images: NDArray[Any]) -> MeasuredSpots:
        mean, count = (mean_frames(images), images.shape[-3]) if frames is None else (np.asarray(images, float), frames)
        return judged_spots(_flat(mean), count, calibration, centroid, threads)

    first, fits = judged(before) if isinstance(before, np.ndarray) else before
    second, more = judged(after)
    spread = difference_covariance(first, second, calibration.noise)
    evidence = SpotEvidence(fits, more)
    return recovery_of(first, second, spread, calibration, disturbances, keep_parts, evidence, motions)


def recovery_of(
    first: SpotPositions,
    second: SpotPositions,
    covariance: Array,
    calibration: MonitorCalibration,
    disturbances: Disturbances | None = None,
    keep_parts: bool = False,
    evidence: SpotEvidence | None = None,
    motions: Mapping[str, MotionModel] | None = None,
) -> Recovery:
    """What spots say that have been measured already.

    Args:
        first: C spots of the nominal state, or S C, with their maps.
        second: S C spots of the states to be measured, state by state, likewise.
        covariance: (S C, 2, 2) px^2 of their differences.
        calibration: of the nominal instrument; C must be its number of spots.
        disturbances: as of `recover`.
        keep_parts: of the noise, which are large.
        evidence: what the fits say; the positions are those of `judged_spots`.
        motions: as of `recover`.
    """
    spots = calibration.spots
    states = second.row.size // spots
    spread = joint(covariance.reshape(states, spots, 2, 2))
    start = np.broadcast_to(first.position.reshape(-1, spots, 2), (states, spots, 2))
    end = second.position.reshape(states, spots, 2)
    found = estimates(start, end, spread, calibration.cameras, disturbances, calibration.ground, motions)
    return Recovery(
        before=start,
        after=end,
        sigma_before=np.broadcast_to(_sigma(first).reshape(-1, spots, 2), (states, spots, 2)),
        sigma_after=_sigma(second).reshape(states, spots, 2),
        shift_covariance=spread,
        parameters=found.parameters,
        angle=found.angle,
        ground=found.ground,
        parts=(noise_parts(first, calibration.noise), noise_parts(second, calibration.noise)) if keep_parts else None,
        evidence=evidence,
        curvature=found.curvature,
    )


def estimates(
    start: Array,
    end: Array,
    covariance: Array,
    cameras: Mapping[str, CameraCalibration],
    disturbances: Disturbances | None = None,
    ground: GroundGeometry | None = None,
    motions: Mapping[str, MotionModel] | None = None,
) -> Estimates:
    """All estimators on spot positions.

    Args:
        start: (S, C, 2) spot positions (row, column) before, px, one camera's after the other's.
        end: those after, likewise.
        covariance: (S, 2 C, 2 C) of after - before, px^2; all zero for positions without noise.
        cameras: what is calibrated of each.
        disturbances: what is stated to move, None for nothing.
        ground: of a pair whose altitude is known.
        motions: as of `recover`.
    """
    shifts = Shifts(start, end, covariance, cameras, disturbances)
    found: dict[str, tuple[Array, Array, Array | None]] = {}
    curvature: dict[str, Curvature] = {}
    readings: dict[str, LinearReading] = {}
    for title, estimator in applicable(cameras, disturbances).items():
        gain, values = estimator.gain(shifts), estimator.read(shifts)
        noise = gain @ shifts.covariance @ np.swapaxes(gain, -1, -2)
        total = None if disturbances is None else noise + disturbances.misfit(gain)
        if motions is not None and title in motions:
            readings[title] = LinearReading(values, noise if total is None else total, motions[title])
        found[title] = values, noise, total
    if readings:
        rows = np.stack([quantity.row for quantity in quantities(cameras, ground)])
        for title, (values, own) in read_again(readings, shifts.vector, shifts.covariance, rows).items():
            found[title], curvature[title] = (values, *found[title][1:]), own
    return replace(estimates_of(found, cameras, ground), curvature=curvature)


def estimates_of(
    found: Mapping[str, tuple[Array, Array, Array | None]],
    cameras: Mapping[str, CameraCalibration],
    ground: GroundGeometry | None = None,
) -> Estimates:
    """What follows from changes of all cameras together: those of each, of their angle, on the ground.

    Args:
        found: estimator -> (S, 4 K) changes, and (S, 4 K, 4 K) covariances by noise and of the whole error; None for
            the last where nothing is stated to move.
        cameras: what is calibrated of each.
        ground: of a pair whose altitude is known.
    """
    parameters: dict[str, dict[str, CameraParameters]] = {name: {} for name in cameras}
    angle: dict[str, IntersectionAngleChange] = {}
    errors: dict[str, GroundError] = {}
    own = [slice(PARAMETERS_EACH * k, PARAMETERS_EACH * (k + 1)) for k in range(len(cameras))]
    for title, (values, noise, total) in found.items():
        for name, part in zip(cameras, own, strict=True):
            whole = None if total is None else total[..., part, part]
            parameters[name][title] = CameraParameters.from_vector(values[..., part], noise[..., part, part], whole)
        if len(cameras) == 2:
            one, two = _pair(cameras)
            first, second = (own[list(cameras).index(name)] for name in (one, two))
            across = noise[..., first, second], None if total is None else total[..., first, second]
            looks = cameras[one].look_rad, cameras[two].look_rad
            both = parameters[one][title], parameters[two][title]
            angle[title] = intersection_angle.exact(*both, *looks, *across)
            if ground is not None:
                distances = [camera.geometry.principal_distance_m for camera in cameras.values()]
                f = (distances[0], distances[1])
                errors[title] = ground.error(values, noise, noise if total is None else total, f)
    return Estimates(parameters, angle, errors)


def joint(covariance: Array) -> Array:
    """(S, 2 C, 2 C) from the covariances (S, C, 2, 2) of C spots, which are independent of each other.

    Args:
        covariance: px^2.
    """
    states, spots = covariance.shape[:2]
    out = np.zeros((states, spots, 2, spots, 2))
    for i in range(spots):
        out[:, i, :, i] = covariance[:, i]
    return out.reshape(states, 2 * spots, 2 * spots)


def _flat(mean: Array) -> Array:
    return mean.reshape(-1, *mean.shape[-2:])


def _sigma(positions: SpotPositions) -> Array:
    return np.stack([positions.sigma_row, positions.sigma_column], axis=-1)


def _pair(cameras: Mapping[str, CameraCalibration]) -> tuple[str, str]:
    """The forward camera, the reference of the angle between two, and the other."""
    one, two = sorted(cameras, key=lambda name: -cameras[name].look_rad)
    return one, two
