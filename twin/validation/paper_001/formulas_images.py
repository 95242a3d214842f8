"""Images of single changes, measured, for the checks of paper 001's formulas.

A displacement is before - after, in any unit of length; X is across the line, Y along it, L at its +Y end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import autocollimator, recovery
from analysis.monitor.monitoring import CameraParameters, IntersectionAngleChange, MonitorGeometry
from optics.geometry.tree import Motion, State
from scenes.specs.instrument import BASE
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import Observing, observe, one_detector
from twin.monitor.truth import Truth
from twin.run.svg import BLUE, GREY, INK, LIGHT, look, new_figure, plain_axes, to_svg
from twin.validation.checks.group import Context

Value = TypeVar("Value", float, np.ndarray)
FRAMES = 9
PARAMETERS = ("d_alpha", "d_beta", "d_gamma", "d_f")
SHIFT, TURN, SCALE, PISTON, FACE = 50e-6, 20 * ARCSEC, 20e-6, 50e-6, 4 * ARCSEC
"""Motions, SI: of the line CCD along X or Y, about Z; growth of the camera; line CCD along Z; turn of a return face."""


def roll_displacement(x_left: Value, x_right: Value) -> Value:
    """Eq. (4): how far a roll of the camera moves a spot across the line."""
    return (x_left - x_right) / 2.0


def scale_displacement(y_left: Value, y_right: Value) -> Value:
    """Eq. (6): how far a change of the focal length moves a spot along the line; (y11 - y01) is minus the left Y."""
    return (y_right - y_left) / 2.0


def superposed(first: Value, second: Value) -> Value:
    """Eq. (8), of one side: the displacement by two changes at once from those by each of them."""
    return first + second


def right_of_focal_length(left: Value) -> Value:
    """Eq. (9): Y of the right spot from that of the left one when the focal length changes."""
    return -left


def right_of_rotation(left: Value) -> Value:
    """Eq. (9): the same when the line of sight turns about X."""
    return left


def parts_along(left: Value, right: Value) -> tuple[Value, Value]:
    """Eq. (10): the shares of the focal length and of the turn about X in Y."""
    return (left - right) / 2.0, (left + right) / 2.0


def parts_across(left: Value, right: Value) -> tuple[Value, Value]:
    """Eq. (11): the shares of the turn about Y and of the roll in X."""
    return (left + right) / 2.0, (left - right) / 2.0


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
        """Mean ratio of camera -> (value, sigma); the noise of the cameras is independent."""
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
        self.truth: Truth = experiment.sight.truth(every)
        progress(0.4, "render and measure the spots")
        how = Observing(one_detector(experiment, FRAMES, seed), stated=False)
        pieces = [found.recovery for found in observe(experiment, every, how)]
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
        return float(
            np.mean([cameras[c].line_principal_distance / self.geometry(c).principal_distance_m for c in self.cameras])
        )

    def parameters(self) -> Mapping[str, Mapping[str, CameraParameters]]:
        """Camera -> estimator -> what it reads from the spots, (S,)."""
        return self._estimates().parameters

    def angles(self) -> Mapping[str, IntersectionAngleChange]:
        """Estimator -> change of the intersection angle, (S,)."""
        return self._estimates().angle

    def _estimates(self) -> recovery.Estimates:
        cameras = self.experiment.calibration.cameras
        return recovery.estimates(self.before, self.after, self.covariance, cameras)

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
        pitch = self.geometry(camera).pitch_m
        variance = np.diagonal(self.covariance[state])[4 * k : 4 * k + 4][column::2]
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


class SingleMotions(MonitorImages):
    """Images of the motions that the formulas were derived for, one at a time.

    Args:
        experiment: the instrument.
        seed: of the noise.
        progress: takes a fraction and what is done next.
    """

    def __init__(self, experiment: MonitorExperiment, seed: int, progress: Callable[[float, str], None]) -> None:
        super().__init__(experiment, states_of(experiment), seed, progress)

    @property
    def field_bias(self) -> float:
        """How far off the axis of the mirrors the line stands, radians."""
        camera = self.experiment.instrument.cameras[self.cameras[0]]
        return float(camera.spec.field_bias)

    def needed_factor(self, parameter: str) -> Ratio:
        """The factor that (2) or (3) needs where it has cos²: true change times 2f over the mean spot shift.

        Along the line f is here the focal length at its centre, where d_beta is taken; across it the formula's own.
        """
        motion = {"d_beta": "along Y", "d_alpha": "along X"}[parameter]
        out = {}
        for camera in self.cameras:
            geometry = self.geometry(camera)
            local, field = 1.0, geometry.field_alpha_rad
            if parameter == "d_beta":
                model = self.experiment.instrument.cameras[camera]
                local = model.line_principal_distance / geometry.principal_distance_m
                field = geometry.field_beta_rad
            value, sigma = self.reading(camera, motion, "paper_single", parameter)
            bare = math.tan(value) / math.cos(field) ** 2 / local
            factor = self.true(camera, motion, parameter) / bare
            out[camera] = factor, abs(factor * sigma / value)
        return Ratio.mean(out)

    def displacement(self, direction: str) -> Ratio:
        """Turn of a return face, ``along`` or ``across`` the line, by (1) from the mean displacement of the spots, over
        the turn that was made; f is the focal length in that direction.
        """
        motion, axis = f"face {direction}", "Y" if direction == "along" else "X"
        out = {}
        for camera in self.cameras:
            geometry = self.geometry(camera)
            f = geometry.principal_distance_m if direction == "along" else geometry.principal_distance_across_m
            assert f is not None
            left, right, sigma = self.spots(camera, motion, axis)
            moved = 0.5 * (abs(left) + abs(right))
            turn = float(autocollimator.mirror_rotation(moved, f))
            out[camera] = turn / FACE, turn / FACE * sigma / math.sqrt(2.0) / moved
        return Ratio.mean(out)

    def roll(self) -> Ratio:
        """Eq. (4): how far the spots move across the line over how far the line CCD's ends do."""
        out = {}
        for camera in self.cameras:
            left, right, sigma = self.spots(camera, "about Z", "X")
            end = 0.5 * self.geometry(camera).separation_m * math.tan(TURN)
            out[camera] = quotient((roll_displacement(left, right), sigma / math.sqrt(2.0)), (end, 0.0))
        return Ratio.mean(out)

    def growth(self) -> Ratio:
        """Eq. (6): its mean displacement over the growth L Δf / f that (7) makes of it, with the traced Δf."""
        out = {}
        for camera in self.cameras:
            left, right, sigma = self.spots(camera, "scale", "Y")
            g = self.geometry(camera)
            should = g.separation_m * self.true(camera, "scale", "d_f") / g.principal_distance_m
            moved = scale_displacement(left, right), sigma / math.sqrt(2.0)
            out[camera] = quotient(moved, (should, 0.0))
        return Ratio.mean(out)

    def growth_by_side(self) -> float:
        """Largest relative distance of one side's own displacement from the mean of (6)."""
        worst = 0.0
        for camera in self.cameras:
            left, right, _ = self.spots(camera, "scale", "Y")
            mean = scale_displacement(left, right)
            worst = max(worst, float(np.max(np.abs(np.array([-left, right]) / mean - 1.0))))
        return worst


def _ratios_svg(ratios: Mapping[str, tuple[str, float]]) -> str:
    """A row per check: id -> (equation, measured over right)."""
    with look("formulas-001"):
        figure = new_figure(0.8 + 0.27 * len(ratios))
        axes = figure.subplots()
        axes.axvline(1.0, color=INK, lw=1.0)
        for row, (_, value) in enumerate(ratios.values()):
            axes.plot([1.0, value], [row, row], color=LIGHT, lw=4.0, solid_capstyle="butt", zorder=0)
            axes.plot([value], [row], "o", color=BLUE, ms=7.0)
            text = f"{value:.4f}".replace("-", "\N{MINUS SIGN}")
            axes.text(1.06, row, text, transform=axes.get_yaxis_transform(), ha="right", va="center")
        axes.text(1.06, -0.75, "measured", transform=axes.get_yaxis_transform(), ha="right", va="center", color=GREY)
        axes.set_yticks(range(len(ratios)), [f"{name}   {where}" for name, (where, _) in ratios.items()])
        axes.set_ylim(len(ratios) - 0.5, -0.6)
        axes.set_xlabel("measured, where 1 is a correct formula")
        axes.tick_params(axis="y", length=0)
        plain_axes(axes)
        return to_svg(figure)


def show_ratios(context: Context, name: str, title: str, found: Mapping[str, float]) -> None:
    """Draw what was measured of rows, id -> value, that are 1 where a formula is right."""
    exact = {i: (context.check(i).equation, v) for i, v in found.items() if context.check(i).printed == 1.0}
    if exact:
        caption = "Measured from images, mean of both cameras; the noise is below the size of the marks."
        context.figure(name, title, caption, _ratios_svg(exact))
