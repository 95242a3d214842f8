"""What paper 001's formulas read from rendered spot images of single motions, beside the traced truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from analysis.monitoring import ARCSEC, MonitorGeometry
from analysis.recovery import Recovery
from optics.tree import Motion, State
from scenes.channel import BASE
from twin.experiment import MonitorExperiment
from twin.truth import Truth, trace_truth

FRAMES = 9
SHIFT, TURN, SCALE, PISTON, FACE = 50e-6, 20 * ARCSEC, 20e-6, 50e-6, 4 * ARCSEC
"""Motions, SI: of the line CCD along X or Y, about Z; growth of the camera; line CCD along Z; turn of a return face."""
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


def states_of(experiment: MonitorExperiment) -> dict[str, State]:
    """Motion -> state in which both cameras make it."""
    planes = [f"{BASE}/{name}/focal_plane" for name in experiment.instrument.cameras]
    faces = [channel.face_body for channel in experiment.instrument.channels]

    def moved(bodies: list[str], motion: Motion) -> State:
        return dict.fromkeys(bodies, motion)

    return {
        "along X": moved(planes, Motion(shift=(SHIFT, 0.0, 0.0))),
        "along Y": moved(planes, Motion(shift=(0.0, SHIFT, 0.0))),
        "about Z": moved(planes, Motion(rotate=(0.0, 0.0, TURN))),
        "piston": moved(planes, Motion(shift=(0.0, 0.0, PISTON))),
        "scale": moved([f"{BASE}/{name}" for name in experiment.instrument.cameras], Motion(scale=SCALE)),
        "face across": moved(faces, Motion(rotate=(FACE, 0.0, 0.0))),
        "face along": moved(faces, Motion(rotate=(0.0, FACE, 0.0))),
    }


class SingleMotions:
    """Nine frames before and after every motion, what the formulas read from them, and the truth.

    Args:
        experiment: the instrument.
        seed: of the noise.
        progress: takes a fraction and what is done next.
    """

    def __init__(self, experiment: MonitorExperiment, seed: int, progress: Callable[[float, str], None]) -> None:
        self.experiment = experiment
        states = states_of(experiment)
        self.motions = list(states)
        progress(0.0, "trace the truth")
        self.truth: Truth = trace_truth(experiment.instrument, experiment.backend, list(states.values()))
        progress(0.4, "render and measure the spots")
        every = list(states.values())
        self.recovery: Recovery = next(experiment.measure(every, FRAMES, seed, chunk=len(every)))[1]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.recovery.parameters)

    def geometry(self, camera: str) -> MonitorGeometry:
        """What the formulas are given of a camera."""
        return self.experiment.geometry(camera)

    @property
    def first(self) -> MonitorGeometry:
        """The geometry of the first camera; both have the same prescription."""
        return self.geometry(self.cameras[0])

    def true(self, camera: str, motion: str, parameter: str) -> float:
        """Traced change of one of PARAMETERS, SI."""
        return float(getattr(self.truth.cameras[camera], parameter)[self.motions.index(motion)])

    def reading(self, camera: str, motion: str, estimator: str, parameter: str) -> tuple[float, float]:
        """What a formula reads, and its sigma, SI."""
        found = self.recovery.parameters[camera][estimator]
        state, k = self.motions.index(motion), PARAMETERS.index(parameter)
        return float(found.vector[state, k]), float(found.sigma[state, k])

    def over_truth(self, motion: str, estimator: str, parameter: str) -> Ratio:
        """Reading divided by the traced change."""
        return self._ratio(motion, estimator, parameter, lambda camera: self.true(camera, motion, parameter))

    def over_motion(self, motion: str, estimator: str, parameter: str, amount: float) -> Ratio:
        """Reading divided by the amount of the motion."""
        return self._ratio(motion, estimator, parameter, lambda camera: amount)

    def _ratio(self, motion: str, estimator: str, parameter: str, should: Callable[[str], float]) -> Ratio:
        out = {}
        for camera in self.cameras:
            value, sigma = self.reading(camera, motion, estimator, parameter)
            out[camera] = value / should(camera), sigma / abs(should(camera))
        return Ratio.mean(out)

    def needed_factor(self) -> Ratio:
        """The factor that (2) needs where it has cos²β: true Δβ times 2f over the mean spot shift.

        f is here the focal length along the line at its centre, where Δβ is taken.
        """
        out = {}
        for camera in self.cameras:
            geometry = self.geometry(camera)
            value, sigma = self.reading(camera, "along Y", "paper_single", "d_beta")
            local = self.experiment.instrument.cameras[camera].line_focal_length / geometry.focal_length_m
            bare = math.tan(value) / math.cos(geometry.field_beta_rad) ** 2 / local
            factor = self.true(camera, "along Y", "d_beta") / bare
            out[camera] = factor, abs(factor * sigma / value)
        return Ratio.mean(out)

    def displacement(self, direction: str) -> Ratio:
        """Mean spot displacement over f tan 2θ for a return face turned ``along`` or ``across`` the line; f is the
        focal length in that direction.
        """
        state, axis = self.motions.index(f"face {direction}"), 0 if direction == "along" else 1
        moved = np.abs(self.recovery.after[state] - self.recovery.before[state])[:, axis]
        out = {}
        for k, camera in enumerate(self.cameras):
            geometry = self.geometry(camera)
            f = geometry.focal_length_m if direction == "along" else geometry.focal_length_x_m
            assert f is not None
            to_ratio = geometry.pixel_m / (f * math.tan(2 * FACE))
            spread = self.recovery.shift_covariance[state, k][axis::2, axis::2]
            sigma = 0.5 * math.sqrt(float(spread.sum()))
            out[camera] = float(moved[2 * k : 2 * k + 2].mean()) * to_ratio, sigma * to_ratio
        return Ratio.mean(out)
