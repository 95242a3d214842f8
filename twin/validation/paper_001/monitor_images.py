"""Rendered spot images of both cameras' monitors in many states: measured displacements, formulas' readings, truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from analysis import recovery
from analysis.intersection_angle import IntersectionAngleChange
from analysis.monitoring import CameraParameters, MonitorGeometry
from optics.tree import State
from twin.experiment import MonitorExperiment
from twin.truth import Truth, trace_truth

FRAMES = 9
PARAMETERS = ("d_alpha", "d_beta", "d_gamma", "d_f")


@dataclass(frozen=True)
class Ratio:
    """A reading divided by what it should be.

    Attributes:
        value: mean of the cameras.
        sigma: its standard deviation.
        cameras: camera -> (value, sigma).
    """

    value: float
    sigma: float
    cameras: Mapping[str, tuple[float, float]]

    @classmethod
    def mean(cls, cameras: Mapping[str, tuple[float, float]]) -> Ratio:
        """Of camera -> (value, sigma); the cameras' noise is independent."""
        values, sigmas = np.array(list(cameras.values())).T
        return cls(float(values.mean()), float(np.sqrt(np.sum(sigmas**2)) / len(values)), dict(cameras))

    @property
    def text(self) -> str:
        """Each camera's own value."""
        return ", ".join(f"{name} {value:.5f} ± {sigma:.5f}" for name, (value, sigma) in self.cameras.items())


def quotient(above: tuple[float, float], below: tuple[float, float]) -> tuple[float, float]:
    """Quotient of two measured numbers, (value, sigma) each, with its sigma."""
    value = above[0] / below[0]
    return value, float(np.hypot(above[1], value * below[1]) / abs(below[0]))


class MonitorImages:
    """Nine frames before and after every state, measured; what the formulas make of the spots is worked out on demand.

    Args:
        experiment: the instrument.
        states: name -> state; both cameras' bodies may move in it.
        seed: of the noise.
        progress: takes a fraction and what is done next.
    """

    def __init__(
        self,
        experiment: MonitorExperiment,
        states: Mapping[str, State],
        seed: int,
        progress: Callable[[float, str], None],
    ) -> None:
        self.experiment = experiment
        self.motions = list(states)
        every = list(states.values())
        progress(0.0, "trace the truth")
        self.truth: Truth = trace_truth(experiment.instrument, experiment.backend, every)
        progress(0.4, "render and measure the spots")
        pieces = [piece for _, piece in experiment.measure(every, FRAMES, seed)]
        self.before = np.concatenate([p.before for p in pieces])
        self.after = np.concatenate([p.after for p in pieces])
        self.covariance = np.concatenate([p.shift_covariance for p in pieces])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.experiment.calibration.cameras)

    def geometry(self, camera: str) -> MonitorGeometry:
        """What the formulas are given of a camera."""
        return self.experiment.calibration.cameras[camera].geometry

    @property
    def first(self) -> MonitorGeometry:
        """The geometry of the first camera; both have the same prescription."""
        return self.geometry(self.cameras[0])

    @property
    def local_share(self) -> float:
        """Focal length along the line at its centre, where d_beta is taken, over the formulas' f; of both cameras."""
        cameras = self.experiment.instrument.cameras
        return float(np.mean([cameras[c].line_focal_length / self.geometry(c).focal_length_m for c in self.cameras]))

    def parameters(self) -> Mapping[str, Mapping[str, CameraParameters]]:
        """Camera -> estimator -> what it reads from the spots, (S,)."""
        cameras = self.experiment.calibration.cameras
        return recovery.estimates(self.before, self.after, self.covariance, cameras)

    def angles(self) -> Mapping[str, IntersectionAngleChange]:
        """Estimator -> change of the intersection angle, (S,)."""
        return recovery.angles(self.parameters(), self.experiment.calibration.cameras)

    def reading(self, camera: str, motion: str, estimator: str, parameter: str) -> tuple[float, float]:
        """What a formula reads of one state, and its sigma, SI."""
        found = self.parameters()[camera][estimator]
        state, k = self.motions.index(motion), PARAMETERS.index(parameter)
        return float(found.vector[state, k]), float(found.sigma[state, k])

    def true(self, camera: str, motion: str, parameter: str) -> float:
        """Traced change of one of PARAMETERS, SI."""
        return float(getattr(self.truth.cameras[camera], parameter)[self.motions.index(motion)])

    def spots(self, camera: str, motion: str, axis: str) -> tuple[float, float, float]:
        """Displacements before - after of the left and the right spot along ``axis``, X or Y, and the sigma of each,
        metres; the two sigmas are taken as equal.
        """
        state, k, column = self.motions.index(motion), self.cameras.index(camera), "YX".index(axis)
        moved = (self.before - self.after)[state, 2 * k : 2 * k + 2, column]
        pitch = self.geometry(camera).pixel_m
        variance = np.diagonal(self.covariance[state, k])[column::2]
        return float(moved[0]) * pitch, float(moved[1]) * pitch, float(np.sqrt(variance.mean())) * pitch

    def over_truth(self, motion: str, estimator: str, parameter: str) -> Ratio:
        """Reading divided by the traced change."""
        return self.over(motion, estimator, parameter, lambda camera: self.true(camera, motion, parameter))

    def over_motion(self, motion: str, estimator: str, parameter: str, amount: float) -> Ratio:
        """Reading divided by the amount of the motion."""
        return self.over(motion, estimator, parameter, lambda camera: amount)

    def over(self, motion: str, estimator: str, parameter: str, should: Callable[[str], float]) -> Ratio:
        """Reading divided by what it should be of each camera."""
        out = {}
        for camera in self.cameras:
            out[camera] = quotient(self.reading(camera, motion, estimator, parameter), (should(camera), 0.0))
        return Ratio.mean(out)
