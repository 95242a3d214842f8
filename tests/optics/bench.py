"""Small optical benches for the tests: elements one after the other, traced from given rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.geometry.aperture import Aperture
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.geometry.tree import Body, RigidTree, State
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace

REFLECT, REFRACT, PASS = Interaction.REFLECT, Interaction.REFRACT, Interaction.PASS


@dataclass(frozen=True)
class Stage:
    """One element: its shape, what it does and where it stands."""

    surface: Surface
    interaction: Interaction = REFLECT
    pose: Pose = Pose()  # noqa: RUF009 - immutable
    aperture: Aperture | None = None
    index_after: float = 1.0


def at(z: float) -> Pose:
    return Pose(np.eye(3), np.array([0.0, 0.0, z]))


def build(*stages: Stage, base: Pose | None = None) -> Assembly:
    """Elements e0, e1, ... in one sequence ``all``, where a base is given on one body that carries all of them."""
    names = [f"{'' if base is None else 'base/'}e{i}" for i in range(len(stages))]
    elements = {
        n: Element(n, n, s.surface, s.interaction, s.aperture, s.index_after)
        for n, s in zip(names, stages, strict=True)
    }
    carrier = () if base is None else (Body("base", base, {"corner": (0.4, -0.2, 0.3)}),)
    tree = RigidTree((*carrier, *(Body(n, s.pose) for n, s in zip(names, stages, strict=True))))
    return Assembly(tree, elements, {"all": tuple(names)})


def run(
    backend: Backend, assembly: Assembly, position: np.ndarray, direction: np.ndarray, state: State | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """World position (N, 3), direction (N, 3), path (N,), valid (N,) after the last element."""
    systems = assemble(assembly, ["all"], [state or {}])
    traced = trace(backend, systems, make_rays(backend, position, direction), world=True)
    assert traced.world is not None
    position, direction, path, valid = (a[0] for a in traced.numpy(traced.world))
    return position, direction, path, valid


def unit(*vector: float) -> np.ndarray:
    v = np.array(vector, dtype=float)
    return v / np.linalg.norm(v)


def disk_points(n: int, radius: float, seed: int = 1) -> np.ndarray:
    """n random points of a disk, (n, 2)."""
    rng = np.random.default_rng(seed)
    r, t = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([r * np.cos(t), r * np.sin(t)], axis=-1)


def beam(points: np.ndarray, z: float, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays from points (N, 2) of the plane z, all in one direction."""
    position = np.column_stack([points, np.full(len(points), z)])
    return position, np.broadcast_to(direction, position.shape)
