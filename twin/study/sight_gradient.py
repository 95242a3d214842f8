"""Derivative of the cameras' lines of sight by elementary motions, by forward-mode AD through the imaging path.

A chief ray starts at a point of the line CCD and is turned so that it goes through the middle of the stop. By the
implicit function theorem the turn per motion is -(d hit / d turn)^-1 (d hit / d motion); with it the ray is pushed
forward to the object space.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optics.aim import RayFan, aim, transverse_axes
from optics.array_math import inverse, turned
from optics.backend import Backend
from optics.push_forward import push_forward
from optics.system import SystemBatch, assemble
from optics.tree import COMPLEX_STEP, FIGURE, Motion, State
from scenes.instrument_model import Instrument
from twin.monitor_derivative import hit_slopes
from twin.motions import ElementaryMotion
from twin.truth import LINE_POINTS, line_in_world


def sight_gradient(
    instrument: Instrument, backend: Backend, motions: Sequence[ElementaryMotion], about: State
) -> np.ndarray:
    """Derivative of the directions of ``twin.truth.trace_sight``.

    Args:
        instrument: the instrument.
        backend: where to trace.
        motions: M elementary motions, with the pivots that the bodies have in ``about``.
        about: the state at which to differentiate.

    Returns:
        (cameras, M, LINE_POINTS, 3), world, per radian, metre or unit.

    Raises:
        AimError, BeamMissedError: the state moves the image off the mirrors.
    """
    assembly, names, m = instrument.assembly, list(instrument.cameras), len(motions)
    states = [_named(motion, about) for motion in motions]
    steps = [motion.step for motion in motions]
    placed, stepped = assembly.place([about]), assembly.place(states, steps)
    stop = assemble(assembly, [f"{name}/image_to_stop" for name in names], [about], placed=placed)
    points = np.concatenate([line_in_world(instrument, name, placed) for name in names])
    guess = np.concatenate([instrument.toward_optics(placed, name) for name in names])[:, None]
    start = np.broadcast_to(guess, points.shape)
    fan = RayFan(points, start, transverse_axes(start, np.broadcast_to([0.0, 1.0, 0.0], start.shape)))
    position, direction = fan.at(aim(backend, stop, fan, np.zeros(2))[0])
    axes, slope = hit_slopes(backend, stop, position, direction)

    moved = np.concatenate([line_in_world(instrument, name, stepped).imag for name in names]) / COMPLEX_STEP
    place, heading = np.repeat(position, m, axis=0), np.repeat(direction, m, axis=0)

    def systems(sequence: str) -> SystemBatch:
        return assemble(assembly, [f"{name}/{sequence}" for name in names], states, steps, stepped)

    drift = push_forward(backend, systems("image_to_stop"), place, heading, moved, 0.0).position[..., :2]
    turn = -turned(np.repeat(inverse(slope), m, axis=0), drift)
    to_object = systems("image_to_object")
    heading_step = np.einsum("bnk,bnkx->bnx", turn, np.repeat(axes, m, axis=0))
    pushed = push_forward(backend, to_object, place, heading, moved, heading_step)
    local = pushed.traced.numpy()[1]
    # from the frame of the last element, which moves too, to the world
    assert to_object.tangents is not None
    pose = _rotation(to_object.values[-1], to_object.count)
    pose_step = _rotation(to_object.tangents[-1], to_object.count)
    world = np.einsum("bij,bnj->bni", pose, pushed.direction) + np.einsum("bij,bnj->bni", pose_step, local)
    return np.asarray(world).reshape(len(names), m, LINE_POINTS, 3)


def _rotation(numbers: object, count: int) -> np.ndarray:
    """World rotation of an element in B systems, or its derivative, (B, 3, 3)."""
    assert isinstance(numbers, dict)
    return np.stack([np.stack([numbers[f"W{a}{b}"] for b in range(3)], -1) for a in range(3)], -2).reshape(count, 3, 3)


def _named(motion: ElementaryMotion, about: State) -> State:
    """The state ``about`` in which the motion's body names its pivot and, with zero amplitude, its figure term."""
    start = about.get(motion.body, Motion(pivot=motion.pivot))
    figure = {motion.axis: 0.0, **start.figure} if motion.kind == FIGURE else start.figure
    return {
        **about,
        motion.body: Motion(
            start.rotate,
            start.shift,
            start.pivot,
            start.scale,
            figure,
            start.stretch,
            start.index,
            start.index_gradient,
        ),
    }
