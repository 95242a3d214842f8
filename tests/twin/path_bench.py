"""Small scenes for the path tracer's tests: glass bodies, mirrors and screens, made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, Face, Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body, RigidTree
from optics.materials.fresnel_scatter import ABSORBER, BARE, Finish
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from scenes.models.camera_model import LINE_AXIS, collimated, field_direction
from scenes.models.scenery import (
    Detector,
    Finishes,
    Scenery,
    SceneSurface,
    detector_surface,
    mirror_surface,
    solid_surfaces,
)

if TYPE_CHECKING:
    from twin.path_tracing.path_result import PathResult

IDEAL = Finishes(
    mirror=Finish(reflectance=1.0),
    mirror_back=ABSORBER,
    coated=Finish(transmission=1.0),
    ground=ABSORBER,
    detector=Finish(records=True),
    board=ABSORBER,
)
"""Nothing is lost or scattered on the way: for checks of geometry."""

PERFECT = Finish(records=True)
"""A detector that records all of its light."""


def frame(normal: tuple[float, float, float], point: tuple[float, float, float]) -> Pose:
    """A face's pose: +z along the normal."""
    z = np.array(normal, float) / np.linalg.norm(normal)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], axis=-1), np.array(point, float))


def slab(half: float, thickness: float, sides: Coating = Coating.GROUND) -> Solid:
    """A plane-parallel plate from z = 0 to z = thickness."""
    faces = [
        Face("entry", "glass", Coating.TRANSMITTING, frame((0, 0, -1), (0, 0, 0))),
        Face("exit", "glass", Coating.TRANSMITTING, frame((0, 0, 1), (0, 0, thickness))),
    ]
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        faces.append(Face(f"side{k}", "glass", sides, frame((x, y, 0), (half * x, half * y, 0))))
    return Solid("glass", "N-BK7", tuple(faces))


def screen(name: str, pose: Pose, half: float, pixels: int = 10) -> tuple[SceneSurface, Detector]:
    """A perfect detector that looks along its +z."""
    grid = Detector(name, pixels, pixels, (2.0 * half / pixels, 2.0 * half / pixels))
    return detector_surface(grid, pose, Finishes(detector=PERFECT, board=ABSORBER)), grid


def facing(z: float) -> Pose:
    """Pose of a screen at z that looks toward -z."""
    return Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, z]))


def glass_scene(
    solid: Solid,
    index: float,
    coated: Finish = BARE,
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    far: float = 0.5,
) -> Scenery:
    """One glass body at the origin between two large screens: ``front`` at z = -far, ``behind`` at z = far."""
    tree = RigidTree((Body("glass", Pose(rotation_matrix(np.array(turn)), np.zeros(3))),))
    assembly = Assembly(tree, {}, {}, {"glass": index})
    faces = solid_surfaces(solid, assembly, assembly.place(), {}, Finishes(coated=coated, ground=ABSORBER))
    behind, front = (
        screen("behind", facing(far), 1.0),
        screen("front", Pose(np.eye(3), np.array([0.0, 0.0, -far])), 1.0),
    )
    return Scenery((*faces, behind[0], front[0]), (behind[1], front[1]))


def flat_mirror(finish: Finish, radius: float = 0.1) -> tuple[SceneSurface, ...]:
    """A flat mirror in z = 0, lit from +z."""
    element = Element("mirror", "mirror", plane(), Interaction.REFLECT, Circle(radius))
    placed = Assembly(RigidTree((Body("mirror"),)), {"mirror": element}, {}).place()
    return (mirror_surface(element, placed, Finishes(mirror=finish, mirror_back=ABSORBER)),)


def scene_beam(instrument, backend, x: float = 0.0, y: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle of the beam of a field in front of the forward camera, its direction and two axes across, world."""
    model = instrument.cameras["forward"]
    direction = field_direction(model.spec, x, y)
    to_stop = assemble(model.bare_assembly(False), [model.mirrors[:2]])
    middle = collimated(backend, to_stop, direction[None], np.zeros((1, 2)))[0, 0]
    to_world = instrument.assembly.nominal_pose("base/forward") @ model.camera_frame.inverse()
    heading = to_world.rotation @ direction
    first = to_world.rotation @ (LINE_AXIS - (LINE_AXIS @ direction) * direction)
    first /= np.linalg.norm(first)
    return to_world.apply(middle), heading, np.stack([first, np.cross(heading, first)])


class Compared(NamedTuple):
    """Runs of the light of a channel with clear ways and with a search alone, and steps along nominal light of both."""

    runs: list[PathResult]
    steps: list[Sequence[Any]]
    toward: str


def ways_and_search(
    backend, instrument, scenery: Scenery, paths: int, sampling=None, state=None, channel: int = 0
) -> Compared:
    """Trace the pinhole's light of a channel with clear ways and with a search, with the same random numbers."""
    from twin.path_tracing.stray_light import monitor_families, pinhole
    from twin.path_tracing.tracer import BALANCED, PathTracer

    chosen = instrument.channels[channel]
    toward, families = f"{chosen.key}/area_ccd", monitor_families(scenery, instrument)
    source = pinhole(instrument, backend, state or {}, chosen)
    tracers = [PathTracer(backend, scenery, families, sampling or BALANCED, segments) for segments in (True, False)]
    assert [tracer.features().segments for tracer in tracers] == [True, False]
    steps = [tracer.nominal_steps(source, toward, paths) for tracer in tracers]
    return Compared([tracer.run(source, paths, 4, keep=True, toward=toward) for tracer in tracers], steps, toward)
