"""What bodies of an instrument take of the beams of one of its cameras, in many states: prisms, housings, baffles,
parts of other cameras, each where the state puts it. The camera's own mirrors are its prescription's matter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.raytrace.system import assemble
from optics.waves.imaging import imaging_rays
from scenes.models.shadow import TracedBeams
from scenes.specs.tolerance import ToleranceSetup
from twin.targets.target_path import TargetPath

KIND = "obstruction"
RINGS = 7
"""Rings of the rays over the stop, as those of an image's quality."""
AT_ONCE = 40
"""States traced in one launch, to bound memory."""


def require_bodies(setup: ToleranceSetup, path: TargetPath) -> None:
    """Raise InputError where a budget asks for an obstruction and nothing can stand in the beams of the camera."""
    for name, merit in setup.test.merits.items():
        if merit.kind == KIND and (path.shadows is None or not path.shadows.casters):
            problem = f"no body of {setup.base.instrument.name} can stand in the beams of {path.name}"
            allowed = "an instrument with a monitor, baffles or another camera; or other merits"
            raise setup.test.error(problem, ("merits", name, "kind"), allowed=allowed)


def obstructed_shares(
    path: TargetPath, states: Sequence[State], directions: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Share of the stop's area that bodies together take of every beam, (S, F).

    Args:
        path: the camera's, with its shadows.
        states: S states.
        directions: of the light, world, (F, 3).
        start: a point of each beam before the first mirror, world, (F, 3).

    Raises:
        AimError, BeamMissedError: the light of a state is lost.
        UnphysicalError: shadows that cannot be.
    """
    assert path.shadows is not None
    nodes, fields = quadrature.disk(RINGS), len(directions)
    axis = path.assembly.nominal_pose(path.root).rotation[:, 1]
    out = np.empty((len(states), fields))
    for first in range(0, len(states), AT_ONCE):
        some = states[first : first + AT_ONCE]
        placed, owner = path.assembly.place(some), np.repeat(np.arange(len(some)), fields)
        imaging, to_stop = (
            assemble(path.assembly, [f"{path.name}/{way}"], some, placed=placed).take(owner)
            for way in ("imaging", "to_stop")
        )
        heading, launch = (np.tile(one, (len(some), 1)) for one in (directions, start))
        rays = imaging_rays(path.backend, imaging, to_stop, heading, launch, path.stop, nodes, first=axis)
        shadows = path.shadows.cast(TracedBeams(path.assembly, placed, owner, imaging, rays, heading, nodes))
        out[first : first + len(some)] = np.sum(shadows.areas, axis=1).reshape(-1, fields) / np.pi
    return out
