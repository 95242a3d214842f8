"""From elementary motions to spots, lines of sight and the numbers of a run, with derivatives.

A chief ray starts at a point of the line CCD and is turned so that it goes through the middle of the stop. By the
implicit function theorem the turn per motion is -(d hit / d turn)^-1 (d hit / d motion); with it the ray is pushed
forward to the object space.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from analysis.monitor.recovery import Recovery, estimates
from optics.geometry.tree import COMPLEX_STEP, FIGURE, Motion, State
from optics.numerics.array_math import inverse, turned
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.first_order import aim_chief_rays
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import jvp
from scenes.models.instrument_model import Instrument
from scenes.specs.resolved import ResolvedJob
from twin.monitor.monitor_derivative import hit_slopes
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.motions import ElementaryMotion
from twin.monitor.truth import ACROSS, LINE_POINTS, line_in_world
from twin.study.runs.render_base import monitor_results, true_results

CAP = {"shift": 1e-3, "rotate": 3e-4, "scale": 1e-3, "figure": 1e-6}
"""Largest steps of differences, SI: they move the beam on the mirrors by a few millimetres at most."""
ROUNDING = 1e-9
"""Motions smaller than this share of a motion's size come from rounding in a composition of motions."""

Slopes = Mapping[ElementaryMotion, float]


def motion_slopes(about: State, state: Callable[[float], State], step: float) -> Slopes | None:
    """Derivative of a state's motions by a factor; None if the factor changes more than motions, figures and scales.

    Args:
        about: the state of the base.
        state: change of the factor -> the state.
        step: a change of the factor. Motions are linear in it, or nearly so where temperatures add to them.
    """
    at = [state(share * step) for share in SHARES]
    slopes: dict[ElementaryMotion, float] = {}
    for path in {path for one in at for path in one}:
        base = about.get(path, Motion())
        several = [one.get(path, base) for one in at]
        if any(_rest(motion) != _rest(base) for motion in several):
            return None
        terms = sorted({j for motion in several for j in motion.figure})
        kinds = [(kind, axis) for kind in ("rotate", "shift") for axis in range(3)]
        for kind, axis in (*kinds, ("scale", 0), *(("figure", j) for j in terms)):
            a, b, c, d = (motion.component(kind, axis) for motion in several)
            wide, narrow = (a - b) / (2.0 * step), (c - d) / step
            slope = narrow + (narrow - wide) / 3.0
            if abs(slope * step) > ROUNDING * max(abs(base.component(kind, axis)), CAP[kind] * ROUNDING):
                slopes[ElementaryMotion(path, kind, axis, base.pivot)] = slope
    return slopes


def _rest(motion: Motion) -> Motion:
    """What is no elementary motion: the pivot, and what temperatures do."""
    nothing = (0.0, 0.0, 0.0)
    return replace(motion, rotate=nothing, shift=nothing, scale=0.0, figure=FrozenMap({}))


SPOT_REACH, SIGHT_REACH = 1.0, 1e-4
"""Steps of the derivative of the formulas, px and 1: so small that what is left of them after Richardson's
extrapolation, to the fifth power, is below rounding, and so large that rounding is below 1e-11."""
SIGHT_SHARE = 5e-3
"""Largest step of directions as a share of half the field along a line, over which a principal distance is taken: its
fourth power is left of the derivative of that."""


@dataclass(frozen=True, eq=False)
class Chain:
    """One instrument and the formulas that its job applies to what is traced.

    Spots are means of rays, which are the energy centroids of the images. An instrument without a monitor has none, and
    lines of sight alone.

    Attributes:
        resolved: the job.
        experiment: its instrument.
    """

    resolved: ResolvedJob
    experiment: MonitorExperiment

    def spots(self, states: Sequence[State]) -> np.ndarray:
        """Positions (S, C, 2), row and column, px from the first pixel's centre. Raises AimError, BeamMissedError."""
        if not self.experiment.monitored:
            return np.zeros((len(states), 0, 2))
        return self.experiment.path.coarse.mean_spots(states)

    def sight(self, states: Sequence[State]) -> np.ndarray:
        """Directions of the line CCDs' points, (S, cameras, points, 3). Raises AimError, BeamMissedError."""
        return np.swapaxes(self.experiment.sight.trace(states), 0, 1)

    @cached_property
    def reach(self) -> float:
        """Step of directions of lines of sight for the formulas, radians; a narrow field takes a small one."""
        ends = self.experiment.sight.nominal[:, 0, [0, -1]]
        half = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        return float(min(SIGHT_REACH, SIGHT_SHARE * np.min(half)))

    @cached_property
    def nominal(self) -> np.ndarray:
        """Spots of the unperturbed instrument, (1, C, 2)."""
        return self.spots([{}])

    def outcome(self, state: State, spots: np.ndarray, sight: np.ndarray) -> dict[str, Any]:
        """``truth`` and ``recovered`` of one state with spots (C, 2) and directions (cameras, points, 3); ``truth``
        alone where there is no monitor.
        """
        truth = self.experiment.sight.told_by(sight[:, None])
        exposures = self.resolved.frames, self.resolved.job.render.seed
        if not self.experiment.monitored:
            return true_results(self.resolved, self.experiment, state, *exposures, truth)
        start, end = self.nominal, spots[None]
        cameras = self.experiment.cameras
        joint = np.zeros((1, 2 * end.shape[1], 2 * end.shape[1]))
        found = estimates(start, end, joint, cameras, self.experiment.disturbances, self.experiment.ground)
        none = np.zeros_like(end)
        recovery = Recovery(start, end, none, none, joint, found.parameters, found.angle, found.ground)
        return monitor_results(self.resolved, self.experiment, state, *exposures, truth, recovery)

    def moved(
        self, state: State, at: tuple[np.ndarray, np.ndarray], spots: np.ndarray, sight: np.ndarray
    ) -> tuple[list[dict[str, Any]], float]:
        """Four outcomes about a state along derivatives of its spots (C, 2) and directions (cameras, points, 3), for
        ``extrapolated``, and the step; ``at``: the state's own spots and directions.
        """
        largest = max(np.abs(spots).max(initial=0.0) / SPOT_REACH, np.abs(sight).max() / self.reach)
        step = 1.0 / float(largest) if largest > 0.0 else 1.0
        place, line = at
        return [
            self.outcome(state, place + share * step * spots, line + share * step * sight) for share in SHARES
        ], step


SHARES = (1.0, -1.0, 0.5, -0.5)
"""Shares of a step at which values for ``extrapolated`` are taken."""


def extrapolated(values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Central differences with a step and its half, extrapolated after Richardson, and how far that went.

    Args:
        values: (4, ...) at the base plus ``SHARES`` times the step.
        step: of the whole step.
    """
    wide, narrow = (values[0] - values[1]) / (2.0 * step), (values[2] - values[3]) / step
    return narrow + (narrow - wide) / 3.0, np.abs(narrow - wide) / 3.0


def sight_gradient(
    instrument: Instrument, backend: Backend, motions: Sequence[ElementaryMotion], about: State
) -> np.ndarray:
    """Derivative of the directions of ``twin.monitor.truth.LineSight.trace``.

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
    fan, q, _ = aim_chief_rays(backend, stop, points, guess, ACROSS)
    position, direction = fan.at(q)
    axes, slope = hit_slopes(backend, stop, position, direction)

    moved = np.concatenate([line_in_world(instrument, name, stepped).imag for name in names]) / COMPLEX_STEP
    place, heading = np.repeat(position, m, axis=0), np.repeat(direction, m, axis=0)

    def systems(sequence: str) -> SystemBatch:
        return assemble(assembly, [f"{name}/{sequence}" for name in names], states, steps, stepped)

    drift = jvp(backend, systems("image_to_stop"), place, heading, moved, 0.0).position[..., :2]
    turn = -turned(np.repeat(inverse(slope), m, axis=0), drift)
    to_object = systems("image_to_object")
    heading_step = np.einsum("bnk,bnkx->bnx", turn, np.repeat(axes, m, axis=0))
    pushed = jvp(backend, to_object, place, heading, moved, heading_step)
    local = pushed.traced.numpy()[1]
    # from the frame of the last element, which moves too, to the world
    assert to_object.world_tangents is not None
    pose, pose_step = (poses.rotation[:, -1] for poses in (to_object.world, to_object.world_tangents))
    world = np.einsum("bij,bnj->bni", pose, pushed.direction) + np.einsum("bij,bnj->bni", pose_step, local)
    return np.asarray(world).reshape(len(names), m, LINE_POINTS, 3)


def _named(motion: ElementaryMotion, about: State) -> State:
    """The state ``about`` in which the motion's body names its pivot and, with zero amplitude, its figure term."""
    start = about.get(motion.body, Motion(pivot=motion.pivot))
    figure = {motion.axis: 0.0, **start.figure} if motion.kind == FIGURE else start.figure
    return {**about, motion.body: replace(start, figure=figure)}
