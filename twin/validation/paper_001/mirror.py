"""Section 1.1's principle on a bare plane mirror, by exact trace."""

from __future__ import annotations

import math

import numpy as np

from optics.assembly import Assembly
from optics.backend import Backend
from optics.element import Element, Interaction
from optics.surface import plane
from optics.system import assemble
from optics.trace import make_rays, trace
from optics.tree import Body, Motion, RigidTree
from twin.validation.check import Check, CheckResult

MIRROR_TURNS = tuple(math.radians(angle) for angle in (1 / 3600, 1 / 60, 0.5, 2.0, 10.0))


def judge(check: Check, backend: Backend) -> CheckResult:
    """Whether the reflected ray turns by twice the turn of the mirror."""
    turns = np.array(MIRROR_TURNS)
    turned, moved = mirror_turns(backend, turns)
    ratio = turned / turns
    worst = float(ratio[np.argmax(np.abs(ratio - 2.0))])
    screen = float(np.max(np.abs(moved / np.tan(2 * turns) - 1.0)))
    how = (
        f"Exact trace of a ray off a plane mirror at {len(turns)} angles from 1 arcsec to 10°; the ratio farthest from "
        f"2 counts. On a screen at distance f the ray moves by f tan 2θ, as (1) says, to {screen:.0e} of it."
    )
    return check.judge(worst, None, how)


def mirror_turns(backend: Backend, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn of the reflected ray, radians, and how far it moves on a screen at unit distance, for turns of a mirror."""
    mirror = Element("mirror", "mirror", plane(), Interaction.REFLECT)
    assembly = Assembly(RigidTree((Body("mirror"),)), {"mirror": mirror}, {"path": ("mirror",)})
    states = [{"mirror": Motion(rotate=(float(turn), 0.0, 0.0))} for turn in (0.0, *turns)]
    rays = make_rays(backend, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
    traced = trace(backend, assemble(assembly, ["path"], states), rays, world=True)
    _, direction, _, _ = traced.numpy(traced.world)
    start, after = direction[0, 0], direction[1:, 0]
    turned = np.arctan2(np.linalg.norm(np.cross(start, after), axis=-1), after @ start)
    return turned, np.linalg.norm(after / (after @ start)[:, None] - start, axis=-1)
