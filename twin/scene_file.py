"""``scene.glb``: the perturbed instrument and its light paths in three dimensions, for any glTF viewer.

The scene is in the base frame, in metres (X = flight direction, Y = along the line CCDs, Z toward the scene). Every
body of the tree is a node whose name is the body's path; a viewer shows the tree as the twin has it. Mirrors have their
true shape and clear aperture; figure errors, far too small to be seen, are left out. What has no size of its own
(board, reticle) is given one that is easy to see; the light-sensitive faces are to scale.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from optics.aperture import Aperture, Circle
from optics.solid import solid_mesh
from optics.surface import Surface
from optics.tree import State
from scenes.channel import BASE, Channel
from scenes.instrument_model import Instrument
from twin.experiment import MonitorExperiment
from twin.light_paths import RIM, Beam, LightPaths, trace_light_paths

GRID = 24
"""Cells across a mirror: the mesh departs from the surface by less than a millimetre."""

BOARD = 0.010
"""Thickness of the focal plane's board, metres; it stands behind the detectors."""
CHIP = 0.0005
LINE_WIDTH = 0.002
RETICLE = 0.0005
"""Thickness of chips, width of the line CCD and radius of the reticle as drawn, metres."""
TUBE = 0.0015
TUBE_SIDES = 5
"""Radius of drawn rays, metres, and their number of sides."""

_WORLD = "world"


def _metal(
    red: int, green: int, blue: int, metallic: float = 0.55, roughness: float = 0.25, alpha: int = 255
) -> PBRMaterial:
    return PBRMaterial(
        baseColorFactor=[red, green, blue, alpha],
        metallicFactor=metallic,
        roughnessFactor=roughness,
        alphaMode="BLEND" if alpha < 255 else "OPAQUE",
        doubleSided=True,
    )


MIRROR = _metal(205, 208, 214)
DARK = _metal(60, 64, 72, 0.2, 0.7)
SILICON = _metal(40, 60, 130, 0.3, 0.3)
BRASS = _metal(200, 160, 60)
GLASS = _metal(120, 190, 210, 0.1, 0.1, 110)
BLOCK = _metal(150, 170, 185, 0.2, 0.3)
IMAGING = (_metal(0, 114, 178, 0.0, 0.8), _metal(86, 180, 233, 0.0, 0.8))
MONITOR = (_metal(213, 94, 0, 0.0, 0.8), _metal(230, 159, 0, 0.0, 0.8))


def write_scene(experiment: MonitorExperiment, state: State, place: Path) -> None:
    """Write the instrument in a perturbed state as binary glTF.

    Args:
        experiment: the instrument and where to trace.
        state: what is perturbed.
        place: the file, ``scene.glb``.
    """
    paths = trace_light_paths(experiment.instrument, experiment.backend, state)
    place.write_bytes(build_scene(experiment.instrument, paths).export(file_type="glb"))


def build_scene(instrument: Instrument, paths: LightPaths) -> trimesh.Scene:
    """The scene as a tree of nodes with the bodies' names."""
    meshes = body_meshes(instrument, paths)
    scene = trimesh.Scene(base_frame=_WORLD)
    placed = paths.placed
    for body in instrument.assembly.tree.bodies:
        parent = body.parent or _WORLD
        pose = placed.pose(body.path)
        relative = placed.pose(body.parent).inverse() @ pose if body.parent else pose
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = relative.rotation, relative.translation
        scene.graph.update(body.path, parent, matrix=matrix)
        mesh = meshes.get(body.path)
        if mesh is not None:
            mesh.vertices = mesh.vertices * placed.scale[0, placed.index[body.path]].real
            scene.geometry[body.path] = mesh
            scene.graph.update(body.path, parent, matrix=matrix, geometry=body.path)
    for beam in paths.beams:
        name = f"light/{beam.camera}/{beam.name.replace(' ', '_')}"
        scene.geometry[name] = _tubes(beam, list(instrument.cameras).index(beam.camera))
        scene.graph.update(name, _WORLD, matrix=np.eye(4), geometry=name)
    return scene


def body_meshes(instrument: Instrument, paths: LightPaths) -> dict[str, trimesh.Trimesh]:
    """Body path -> mesh in the body's own frame, metres, unscaled."""
    out: dict[str, trimesh.Trimesh] = {}
    for camera, model in instrument.cameras.items():
        chief = paths.of(camera, monitor=False)[0].vertices[0]
        for i, mirror in enumerate(model.mirrors):
            path = f"{BASE}/{camera}/{mirror}"
            travel = paths.placed.pose(path).rotation.T @ (chief[i + 1] - chief[i])
            mesh = mirror_mesh(model.surfaces[mirror], model.apertures[mirror], 1.0 if travel[2] > 0 else -1.0)
            out[path] = _painted(mesh, MIRROR)
        plane = f"{BASE}/{camera}/focal_plane"
        line = model.spec.line.pixels * model.spec.line.pitch
        channels = [c for c in instrument.channels if c.camera == camera]
        reach_y = 2.0 * max(0.5 * line, *(abs(c.ccd[1]) for c in channels)) + 0.04
        reach_x = 2.0 * max(abs(c.pinhole[0]) for c in channels) + 0.04
        # light arrives along +Z of the focal plane, so what carries the detectors stands on the +Z side
        out[plane] = _painted(_box((reach_x, reach_y, BOARD), 2.0 * CHIP + 0.5 * BOARD), DARK)
        out[f"{plane}/line"] = _painted(_box((LINE_WIDTH, line, CHIP), 0.5 * CHIP), SILICON)
        for channel in channels:
            out.update(_channel_meshes(instrument, channel))
    for solid in instrument.solids:
        out[solid.path] = _painted(solid_mesh(solid, paths.placed).mesh, GLASS if solid.transparent else BLOCK)
    return out


def _channel_meshes(instrument: Instrument, channel: Channel) -> dict[str, trimesh.Trimesh]:
    ccd = instrument.spec.monitor.area_ccd
    face = instrument.assembly.elements[f"{channel.key}/return_face"].aperture
    assert isinstance(face, Circle)
    disc = trimesh.creation.cylinder(radius=face.radius, height=CHIP, sections=48)  # a coating, as thick as can be seen
    disc.apply_translation([0.0, 0.0, 0.5 * CHIP])
    reticle = trimesh.creation.cylinder(radius=RETICLE, height=CHIP, sections=24)
    reticle.apply_translation([0.0, 0.0, 0.5 * CHIP])
    size = (ccd.columns * ccd.pitch, ccd.rows * ccd.pitch, CHIP)
    return {
        channel.ccd_body: _painted(_box(size, -0.5 * CHIP), SILICON),  # faces the light along its own +Z
        channel.reticle_body: _painted(reticle, BRASS),
        channel.face_body: _painted(disc, MIRROR),
    }


def mirror_mesh(surface: Surface, aperture: Aperture, back: float) -> trimesh.Trimesh:
    """Watertight mesh of a mirror: its optical surface over the clear aperture, a flat back and an edge.

    Args:
        surface: shape, metres.
        aperture: clear aperture.
        back: +1 when the substrate is on the surface's +z side, -1 when on its -z side.
    """
    x0, x1, y0, y1 = aperture.bounds
    s = np.linspace(-1.0, 1.0, GRID + 1)
    u, v = np.meshgrid(s, s)
    if isinstance(aperture, Circle):  # square onto disk, ring by ring
        ring, angle = np.maximum(np.abs(u), np.abs(v)), np.arctan2(v, u)
        u, v = ring * np.cos(angle), ring * np.sin(angle)
    x, y = 0.5 * (x0 + x1) + 0.5 * (x1 - x0) * u, 0.5 * (y0 + y1) + 0.5 * (y1 - y0) * v
    z = surface.sag(x, y)
    thickness = 0.08 * max(x1 - x0, y1 - y0)
    flat = (z.max() + thickness) if back > 0 else (z.min() - thickness)
    n = GRID + 1
    front = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    rear = front.copy()
    rear[:, 2] = flat
    i = (np.arange(GRID)[:, None] * n + np.arange(GRID)).ravel()
    face = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    up, down = np.arange(GRID), np.arange(GRID, 0, -1)
    rim = np.concatenate([up, up * n + GRID, GRID * n + down, down * n])
    after = np.roll(rim, -1)
    offset = n * n
    edge = np.concatenate([np.stack([rim, rim + offset, after], 1), np.stack([after, rim + offset, after + offset], 1)])
    faces = np.concatenate([face, face[:, ::-1] + offset, edge])
    return trimesh.Trimesh(np.concatenate([front, rear]), faces[:, ::-1] if back > 0 else faces, process=False)


def _box(size: tuple[float, float, float], z: float) -> trimesh.Trimesh:
    """A box centred on (0, 0, z)."""
    box = trimesh.creation.box(extents=size)
    box.apply_translation([0.0, 0.0, z])
    return box


def _painted(mesh: trimesh.Trimesh, material: PBRMaterial) -> trimesh.Trimesh:
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh


def _tubes(beam: Beam, camera: int) -> trimesh.Trimesh:
    """The middle ray and some edge rays of a beam as thin tubes."""
    rays = beam.vertices[[0, *(1 + k * RIM // 4 for k in range(4))]]
    start, end = rays[:, :-1].reshape(-1, 3), rays[:, 1:].reshape(-1, 3)
    along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
    helper = np.where(np.abs(along[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    e1 = np.cross(along, helper)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    e2 = np.cross(along, e1)
    t = 2.0 * np.pi * np.arange(TUBE_SIDES) / TUBE_SIDES
    ring = TUBE * (np.cos(t)[:, None] * e1[:, None] + np.sin(t)[:, None] * e2[:, None])
    vertices = np.concatenate([start[:, None] + ring, end[:, None] + ring], axis=1)
    k = np.arange(TUBE_SIDES)
    next_k = np.roll(k, -1)
    sides = np.concatenate(
        [np.stack([k, next_k, k + TUBE_SIDES], 1), np.stack([next_k, next_k + TUBE_SIDES, k + TUBE_SIDES], 1)]
    )
    faces = sides + 2 * TUBE_SIDES * np.arange(len(start))[:, None, None]
    palette = MONITOR if beam.is_monitor else IMAGING
    return _painted(trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False), palette[camera % 2])
