"""The states that the monitor's readings stand for, traced again: what they do to spots and cameras exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from analysis.monitor import model_fit
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.parameters import CameraCalibration
from analysis.monitor.recovery import MotionModel, Retraced
from optics.geometry.tree import Motion, State
from optics.numerics.array_math import PhysicalError
from scenes.models.disturbances import StatedMotions, states_of
from scenes.models.thermal_model import ThermalModel
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.motions import ElementaryMotion, line_family
from twin.monitor.truth import LineSight

NEAR = 3.0
"""Shift of a spot, px, up to which stated motions are taken as linear. What is not linear is a product of two motions:
a shift s by one times an angle by the other, s over the distance of the spots, some 10 000 px. For 3 px that is 1e-3
px, the noise of a spot, while sigmas of a statement are tens of times larger; the few motions of `model` are traced
again in every state."""
LOST = (PhysicalError, ArithmeticError)
"""What says that a state cannot be traced."""


def motion_models(
    path: MonitorPath,
    sight: LineSight,
    cameras: Mapping[str, CameraCalibration],
    thermal: ThermalModel,
    stated: StatedMotions | None,
    disturbances: Disturbances | None,
) -> dict[str, MotionModel]:
    """Estimator -> the motions by which it reads: the line families of all cameras, and what is stated to move.

    Args:
        path: the monitor's light.
        sight: what the cameras see.
        cameras: their calibration, in the order of the spots.
        thermal: of the instrument.
        stated: what moves, None for nothing.
        disturbances: the same with its derivatives.
    """
    trace = partial(_traced, path, sight)
    out = {"model": _of_families(cameras, trace)}
    if stated is not None and disturbances is not None:
        states = partial(_stated_states, stated, thermal)
        out["posterior"] = MotionModel(
            disturbances.spots, disturbances.parameters, disturbances.best_amounts, states, trace, NEAR
        )
    return out


# What a model calls are functions of the module: a run is sent to the process that draws it, with all that it holds.


def _stated_states(stated: StatedMotions, thermal: ThermalModel, amounts: np.ndarray) -> list[State]:
    """The states of stated amounts (S, P), standard deviations."""
    return states_of(amounts * stated.sigma, stated.components, thermal)


def _of_families(cameras: Mapping[str, CameraCalibration], trace: Callable[[Sequence[State]], Retraced]) -> MotionModel:
    """Each camera's four motions of paper 001."""
    families = {name: line_family(name) for name in cameras}
    own, count = _spots_of(cameras), sum(map(len, families.values()))
    spots, parameters = np.zeros((own[-1].stop, count)), np.zeros((4 * len(cameras), count))
    for k, (camera, at) in enumerate(zip(cameras.values(), own, strict=True)):
        block = slice(4 * k, 4 * k + 4)
        spots[at, block], parameters[block, block] = camera.spot_jacobian, camera.parameter_jacobian
    every = [motion for family in families.values() for motion in family]
    return MotionModel(spots, parameters, partial(_family_amounts, cameras), partial(_together, every), trace)


def _spots_of(cameras: Mapping[str, CameraCalibration]) -> list[slice]:
    """Where the coordinates of each camera's spots stand among all."""
    ends = np.cumsum([0, *(2 * len(camera.channels) for camera in cameras.values())]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def _family_amounts(cameras: Mapping[str, CameraCalibration], noise: np.ndarray) -> np.ndarray:
    """Covariance of the shifts (S, D, D), px^2 -> gain of the cameras' own motions, (S, P, D)."""
    own = _spots_of(cameras)
    out = np.zeros((len(noise), 4 * len(cameras), own[-1].stop))
    for k, (camera, at) in enumerate(zip(cameras.values(), own, strict=True)):
        block = slice(4 * k, 4 * k + 4)
        out[:, block, at] = model_fit.gain(noise[:, at, at], camera.spot_jacobian, np.eye(4), camera.motions)
    return out


def _together(motions: Sequence[ElementaryMotion], amounts: np.ndarray) -> list[State]:
    """The states in which motions of some bodies, all about one pivot of each, have some amounts (S, P), SI."""
    return [_one_together(motions, row) for row in amounts.tolist()]


def _one_together(motions: Sequence[ElementaryMotion], amounts: Sequence[float]) -> State:
    out: dict[str, Motion] = {}
    for motion, amount in zip(motions, amounts, strict=True):
        new, old = motion.motion(amount), out.get(motion.body, Motion(pivot=motion.pivot))
        out[motion.body] = Motion(
            rotate=_sum(old.rotate, new.rotate),
            shift=_sum(old.shift, new.shift),
            scale=old.scale + new.scale,
            pivot=motion.pivot,
        )
    return out


def _sum(one: tuple[float, float, float], two: tuple[float, float, float]) -> tuple[float, float, float]:
    return one[0] + two[0], one[1] + two[1], one[2] + two[2]


def _traced(path: MonitorPath, sight: LineSight, states: Sequence[State]) -> Retraced:
    """What S states do; NaN for one whose light is lost."""
    try:
        return traced_states(path, sight, states)
    except LOST:
        if len(states) == 1:
            return Retraced(*(np.full((1, n), np.nan) for n in (2 * len(path.channels), 4 * len(path.cameras))))
    parts = [_traced(path, sight, [state]) for state in states]
    return Retraced(np.concatenate([p.spots for p in parts]), np.concatenate([p.parameters for p in parts]))


def traced_states(path: MonitorPath, sight: LineSight, states: Sequence[State]) -> Retraced:
    """Means of the rays on the area CCDs against those at rest, and what the line CCDs see.

    Args:
        path: the monitor's light.
        sight: what the cameras see.
        states: S states.

    Raises:
        AimError, BeamMissedError: light of one of them is lost.
    """
    placed = path.instrument.assembly.place(states)
    shifts = np.moveaxis(path.coarse_trace(states, placed).place - path.place_at_rest, 1, 0).reshape(len(states), -1)
    changes = sight.truth(states, placed).cameras.values()
    rows = [np.stack([c.d_alpha, c.d_beta, c.d_gamma, c.d_f], axis=1) for c in changes]
    return Retraced(shifts, np.concatenate(rows, axis=1))
