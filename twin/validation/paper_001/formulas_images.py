"""What paper 001's formulas read from rendered spot images of single motions, beside the traced truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from analysis import autocollimator
from analysis.units import ARCSEC
from optics.tree import Motion, State
from scenes.channel import BASE
from twin.experiment import MonitorExperiment
from twin.validation.paper_001 import left_right
from twin.validation.paper_001.monitor_images import MonitorImages, Ratio, quotient

SHIFT, TURN, SCALE, PISTON, FACE = 50e-6, 20 * ARCSEC, 20e-6, 50e-6, 4 * ARCSEC
"""Motions, SI: of the line CCD along X or Y, about Z; growth of the camera; line CCD along Z; turn of a return face."""


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
                local = self.experiment.instrument.cameras[camera].line_focal_length / geometry.focal_length_m
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
            f = geometry.focal_length_m if direction == "along" else geometry.focal_length_x_m
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
            out[camera] = quotient((left_right.roll_displacement(left, right), sigma / math.sqrt(2.0)), (end, 0.0))
        return Ratio.mean(out)

    def growth(self) -> Ratio:
        """Eq. (6): its mean displacement over the growth L Δf / f that (7) makes of it, with the traced Δf."""
        out = {}
        for camera in self.cameras:
            left, right, sigma = self.spots(camera, "scale", "Y")
            g = self.geometry(camera)
            should = g.separation_m * self.true(camera, "scale", "d_f") / g.focal_length_m
            moved = left_right.scale_displacement(left, right), sigma / math.sqrt(2.0)
            out[camera] = quotient(moved, (should, 0.0))
        return Ratio.mean(out)

    def growth_by_side(self) -> float:
        """Largest relative distance of one side's own displacement from the mean of (6)."""
        worst = 0.0
        for camera in self.cameras:
            left, right, _ = self.spots(camera, "scale", "Y")
            mean = left_right.scale_displacement(left, right)
            worst = max(worst, float(np.max(np.abs(np.array([-left, right]) / mean - 1.0))))
        return worst
