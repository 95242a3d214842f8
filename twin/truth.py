"""The truth about a perturbed instrument, by exact chief rays in the base frame; no formula of the papers enters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.assembly import points_to_world
from optics.backend import Backend
from optics.line_of_sight import LineChange, chief_directions, line_change
from optics.system import assemble
from optics.tree import Motion, State
from scenes.instrument_model import BASE, Instrument

LINE_POINTS = 41
"""Points of the line CCD over which roll and principal distance are taken."""


@dataclass(frozen=True, eq=False)
class Truth:
    """True changes of every camera for S states.

    Attributes:
        cameras: camera -> changes, arrays of shape (S,).
        principal_distance: camera -> nominal principal distance, metres.
        angle: angle between the two lines of sight in the nominal state, radians (NaN unless there are two cameras).
        angle_change: its change, (S,), radians.
    """

    cameras: dict[str, LineChange]
    principal_distance: dict[str, float]
    angle: float
    angle_change: np.ndarray


def trace_truth(instrument: Instrument, backend: Backend, states: Sequence[State]) -> Truth:
    """Trace the lines of sight of all cameras in all states.

    Raises:
        AimError, BeamMissedError: a perturbation moves the image off the mirrors.
    """
    every: list[State] = [{}, *states]
    assembly = instrument.assembly
    placed = assembly.place(every)
    names = list(instrument.cameras)
    points, guesses, positions = [], [], []
    for name in names:
        model = instrument.cameras[name]
        half = 0.5 * model.spec.line.pixels * model.spec.line.pitch
        position = np.linspace(-half, half, LINE_POINTS)
        body = f"{BASE}/{name}/focal_plane/line"
        line = np.stack([np.zeros_like(position), position, np.zeros_like(position)], axis=-1)
        points.append(points_to_world(placed, body, line))
        local = model.focal_plane.rotation.T @ -model.image_direction
        guesses.append(placed.rotation[:, placed.index[f"{BASE}/{name}/focal_plane"]] @ local)
        positions.append(position)
    sight, _, _ = chief_directions(
        backend,
        assemble(assembly, [f"{name}/image_to_stop" for name in names], every, placed=placed),
        assemble(assembly, [f"{name}/image_to_object" for name in names], every, placed=placed),
        np.concatenate(points),
        np.concatenate(guesses)[:, None],
        np.array([0.0, 1.0, 0.0]),
    )
    sight = sight.reshape(len(names), len(every), LINE_POINTS, 3)
    cameras: dict[str, LineChange] = {}
    principal: dict[str, float] = {}
    for i, name in enumerate(names):
        change = line_change(sight[i], positions[i], instrument.camera_axes(name))
        cameras[name] = change
        principal[name] = change.nominal_distance
    axes = sight[:, :, LINE_POINTS // 2]
    if len(names) == 2:
        angle = np.arctan2(np.linalg.norm(np.cross(axes[0], axes[1]), axis=-1), np.sum(axes[0] * axes[1], axis=-1))
    else:
        angle = np.full(len(every), np.nan)
    return Truth(cameras, principal, float(angle[0]), angle[1:] - angle[0])


def truth_jacobian(
    instrument: Instrument, backend: Backend, camera: str, motions: Sequence[tuple[str, Motion]]
) -> np.ndarray:
    """Derivative of one camera's true parameters by unit motions, by central differences of the exact trace.

    Args:
        instrument: the instrument.
        backend: where to trace.
        camera: whose parameters.
        motions: (body, small motion): the difference is taken over +- that motion and divided by its size, so give
            motions of about 1e-6 (rad, m or relative), for which truncation and rounding are both below 1e-8.

    Returns:
        (4, M): d_alpha, d_beta, d_gamma (rad) and d_f (m) per the given motion.
    """
    states: list[State] = [{body: motion} for body, motion in motions]
    states += [{body: _reversed(motion)} for body, motion in motions]
    change = trace_truth(instrument, backend, states).cameras[camera]
    rows = np.stack([change.d_alpha, change.d_beta, change.d_gamma, change.d_f])
    m = len(motions)
    return np.asarray(0.5 * (rows[:, :m] - rows[:, m:]))


def _reversed(motion: Motion) -> Motion:
    rx, ry, rz = motion.rotate
    sx, sy, sz = motion.shift
    figure = {j: -a for j, a in motion.figure.items()}
    return Motion((-rx, -ry, -rz), (-sx, -sy, -sz), motion.pivot, -motion.scale, figure)
