"""Scene of a picture: its camera, materials and lighting.

Bodies come from ``twin.pictures.scene_file``, so that a picture and ``scene.glb`` show the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
import trimesh
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from scenes.models.instrument_model import Instrument
from scenes.models.meshes import behind
from scenes.specs.instrument import BASE
from twin.pictures import scene_file
from twin.pictures.light_paths import LightPaths


@dataclass(frozen=True, eq=False)
class View:
    """Pinhole camera of a picture; +Z of the base frame is up in the picture.

    Attributes
    ----------
    eye : (3,) ndarray
        Position in the base frame, metres.
    forward, right, up : (3,) ndarray
        Unit vectors in the base frame.
    half_width : float
        Tangent of half the horizontal field.
    width, height : int
        Size of the picture, pixels.
    """

    eye: np.ndarray
    forward: np.ndarray
    right: np.ndarray
    up: np.ndarray
    half_width: float
    width: int
    height: int

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points (N, 3) in the base frame to columns and rows.

        Returns
        -------
        (N, 2) ndarray
            Pixels from the picture's top left corner.
        """
        away = np.asarray(points, dtype=float) - self.eye
        scale = 0.5 * self.width / self.half_width / (away @ self.forward)
        return np.stack(
            [0.5 * self.width + scale * (away @ self.right), 0.5 * self.height - scale * (away @ self.up)], axis=-1
        )

    def pixel_at(self, points: np.ndarray) -> float:
        """Return the size of a pixel at the mean depth of points, metres."""
        depth = float((np.asarray(points) - self.eye).mean(axis=0) @ self.forward)
        return 2.0 * self.half_width * depth / self.width

    @property
    def horizontal_field(self) -> float:
        """Horizontal field of view, degrees."""
        return float(np.degrees(2.0 * np.arctan(self.half_width)))


def looking(azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the forward, right and up vectors of a camera that looks at the scene from a given direction.

    ``azimuth`` is from +X toward +Y and ``elevation`` toward +Z, both in degrees.
    """
    a, e = np.radians([azimuth, elevation])
    forward = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return forward, right, np.cross(right, forward)


def framed(
    points: np.ndarray, azimuth: float, elevation: float, field: float, size: tuple[int, int], margin: float = 0.04
) -> View:
    """Return the nearest camera in a direction whose picture contains all points.

    Parameters
    ----------
    points : (N, 3) ndarray
        Points in the base frame, metres.
    azimuth : float
        Azimuth of the camera seen from the points, from +X toward +Y, degrees.
    elevation : float
        Elevation of the camera seen from the points, toward +Z, degrees.
    field : float
        Horizontal field of view, degrees.
    size : tuple of int
        Width and height, pixels.
    margin : float
        Free margin on every side, as a fraction of the width.
    """
    width, height = size
    forward, right, up = looking(azimuth, elevation)
    half_width = float(np.tan(np.radians(0.5 * field)))
    depth = points @ forward
    slope = np.array([1.0 - 2.0 * margin, height / width - 2.0 * margin]) * half_width
    middle, distance = np.zeros(2), np.zeros(2)
    for i, axis in enumerate((right, up)):
        # both edges of the picture touch the outermost points: |across - middle| = slope (depth - distance)
        across = points @ axis
        high, low = np.max(across - slope[i] * depth), np.max(-across - slope[i] * depth)
        middle[i], distance[i] = 0.5 * (high - low), -0.5 * (high + low) / slope[i]
    eye = middle[0] * right + middle[1] * up + float(distance.min()) * forward
    return View(eye, forward, right, up, half_width, width, height)


SMOOTH = 0.35
"""Angle between two facets, radians, below which their common edge is not drawn, as they belong to a curved surface."""
BEAM_PIXELS, EDGE_PIXELS = 1.0, 0.55
"""Radius of drawn light beams and of drawn edges of glass, in picture pixels at the middle of the instrument."""
GLOW = 1.3
"""Radiance of drawn beams; that of the floor is about 0.9."""
FLOOR = "floor"
GAP = 0.05
"""Distance from the lowest point of the instrument to the floor, metres."""

_GLASS_EDGE = (0.03, 0.12, 0.15)


def _coloured(colour: Sequence[float], **more: float) -> dict[str, Any]:
    """Return Mitsuba's description of a two-sided surface of one colour, linear red, green and blue."""
    bsdf = {"type": "principled", "base_color": {"type": "rgb", "value": list(colour)}, **more}
    return {"type": "twosided", "bsdf": bsdf}


_BSDF: dict[str, dict[str, Any]] = {
    "mirror": {
        "type": "twosided",
        "bsdf": {
            "type": "conductor",
            "material": "none",
            "specular_reflectance": {"type": "rgb", "value": [0.93, 0.935, 0.94]},
        },
    },
    "substrate": _coloured([0.30, 0.29, 0.275], roughness=0.45, specular=0.4),
    "block": _coloured([0.32, 0.42, 0.48], roughness=0.25, specular=0.5),
    "board": _coloured([0.025, 0.028, 0.034], roughness=0.45),
    "silicon": _coloured([0.06, 0.16, 0.62], metallic=0.6, roughness=0.35),
    "gold": _coloured([0.95, 0.66, 0.2], metallic=0.9, roughness=0.3),
    "glass": {
        "type": "dielectric",
        "int_ior": 1.457,
        "ext_ior": 1.0,
        "specular_transmittance": {"type": "rgb", "value": [0.80, 0.93, 0.95]},
    },
    "edge": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": _GLASS_EDGE}}},
    "lamp": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
    "floor": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.80, 0.80, 0.80]}},
}
_MATERIALS = (
    (scene_file.MIRROR, "mirror"),
    (scene_file.DARK, "board"),
    (scene_file.SILICON, "silicon"),
    (scene_file.BRASS, "gold"),
    (scene_file.GLASS, "glass"),
    (scene_file.BLOCK, "block"),
)
"""Pairs of a body's material in ``scene.glb`` and the name of the corresponding material of the rendered picture."""


@dataclass(frozen=True, eq=False)
class Part:
    """Mesh of one material.

    Attributes
    ----------
    body : str
        Path of the body to which it belongs; ``light/...`` for beams, ``floor``.
    mesh : Trimesh
        Mesh in the base frame, metres.
    bsdf : mapping
        Mitsuba's description of the material.
    radiance : tuple of float, or None
        Emitted red, green and blue.
    matt : bool
        True if light on it varies slowly: neither mirror nor glass, and no thin line.
    """

    body: str
    mesh: trimesh.Trimesh
    bsdf: Mapping[str, Any]
    radiance: tuple[float, float, float] | None = None
    matt: bool = True


def studio_parts(instrument: Instrument, paths: LightPaths, pixel: float) -> list[Part]:
    """Return all meshes of a picture: the instrument's bodies, edges of glass, light beams and the floor.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    paths : LightPaths
        Beams of the instrument and poses of its bodies.
    pixel : float
        Size of a picture's pixel at the instrument, metres, from which the thickness of lines follows.
    """
    scene = scene_file.build_scene(instrument, paths, tube=BEAM_PIXELS * pixel)
    backs = {
        f"{BASE}/{camera}/{mirror}": behind(model, mirror)
        for camera, model in instrument.cameras.items()
        for mirror in model.mirrors
        if model.spec.mirrors[mirror].light is None
    } | {solid.path: -1.0 for solid in instrument.solids if scene_file.is_mirror(solid)}
    parts: list[Part] = []
    lowest = np.inf
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph.get(name)
        local_mesh = scene.geometry[geometry]
        world = trimesh.Trimesh(local_mesh.vertices, local_mesh.faces, process=False)
        world.apply_transform(matrix)
        lowest = min(lowest, float(world.bounds[0, 2]))
        material = local_mesh.visual.material
        if name.startswith("light/"):
            colour = _linear(material.baseColorFactor[:3])
            parts.append(Part(name, world, _BSDF["lamp"], tuple(GLOW * colour), False))
            continue
        kind = next((kind for known, kind in _MATERIALS if known is material), "")
        if name in backs:
            polished = local_mesh.face_normals[:, 2] * backs[name] < -0.5
            parts.append(Part(name, _part_of(world, polished), _BSDF["mirror"], matt=False))
            parts.append(Part(name, _part_of(world, ~polished), _BSDF["substrate"]))
        else:
            matt = kind not in ("mirror", "glass")
            parts.append(Part(name, world, _BSDF.get(kind) or _paint(material), matt=matt))
        if kind in ("glass", "block"):
            parts.append(Part(name, _edges(world, EDGE_PIXELS * pixel), _BSDF["edge"], matt=False))
    parts.append(Part(FLOOR, _floor(lowest - GAP), _BSDF["floor"]))
    return parts


def still_png(instrument: Instrument, paths: LightPaths, size: tuple[int, int] = (1100, 660)) -> bytes:
    """Draw an instrument by shaded facets, the farthest first, on a transparent ground; return the PNG file.

    ``size`` is the largest width and height, pixels; each has two samples.
    """
    scene = scene_file.build_scene(instrument, replace(paths, beams=()))
    bodies = points_in_world(scene)
    rays = [scene_file.drawn_rays(beam) for beam in paths.beams]
    whole = np.concatenate([*bodies.values(), *(ray.reshape(-1, 3) for ray in rays)])
    extent = np.ptp(whole, axis=0)
    order = [2, 0, 1] if np.argmax(extent) == 2 else [0, 1, 2]  # what is tall lies down
    view = framed(whole[:, order], -65.0, 20.0, 20.0, size)
    corners, colours = [], []
    for name, vertices in bodies.items():
        mesh = scene.geometry[scene.graph[name][1]]
        triangles = _pieces(vertices[:, order][mesh.faces], float(np.linalg.norm(extent)) / _PIECES)
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        facing = np.abs(normal @ view.forward) / np.maximum(np.linalg.norm(normal, axis=-1), np.finfo(float).tiny)
        colour = np.tile(np.asarray(mesh.visual.material.baseColorFactor) / 255.0, (len(triangles), 1))
        colour[:, :3] *= 0.45 + 0.55 * facing[:, None]
        corners.append(triangles[:, [0, 1, 2, 2]])
        colours.append(colour)
    share = np.linspace(0.0, 1.0, _PIECES + 1)[:, None, None, None]
    half_width = 0.6 * view.pixel_at(whole[:, order])
    for beam, ray in zip(paths.beams, rays, strict=True):
        points = ray[:, :-1, order] + share * (ray[:, 1:, order] - ray[:, :-1, order])
        start, end = points[:-1].reshape(-1, 3), points[1:].reshape(-1, 3)
        wide = np.cross(end - start, view.forward)
        wide *= half_width / np.maximum(np.linalg.norm(wide, axis=-1, keepdims=True), 1e-300)
        corners.append(np.stack([start - wide, start + wide, end + wide, end - wide], axis=1))
        colours.append(np.tile(scene_file.beam_colour(instrument, beam), (len(start), 1)))
    facets, colour = np.concatenate(corners), np.concatenate(colours)
    far = np.argsort(-facets.mean(axis=1) @ view.forward)
    flat = view.project(facets.reshape(-1, 3)).reshape(-1, 4, 2)
    top, bottom = np.floor(np.min(flat[..., 1])) - 24.0, np.ceil(np.max(flat[..., 1])) + 24.0
    figure = Figure(figsize=(size[0] / 100.0, (bottom - top) / 100.0), dpi=200)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, size[0]), ylim=(bottom, top))
    axes.set_axis_off()
    axes.add_collection(PolyCollection(list(flat[far]), facecolors=colour[far], linewidths=0.0, antialiased=False))
    out = BytesIO()
    figure.savefig(out, format="png", transparent=True, metadata={"Software": None})
    return out.getvalue()


_PIECES = 40
"""Longest edge of a drawn facet, whose inverse is a fraction of the scene; facets are drawn in order of their middles.
"""


def _pieces(triangles: np.ndarray, longest: float) -> np.ndarray:
    """Return triangles, (T, 3, 3), halved across their longest edges until no edge is longer than ``longest``."""
    out = []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=-1)
        out.append(triangles[np.max(edges, axis=1) <= longest])
        rest = np.max(edges, axis=1) > longest
        first = np.argmax(edges[rest], axis=1)
        rows = np.arange(len(first))
        a, b, c = (triangles[rest][rows, (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(out)


def points_in_world(scene: trimesh.Scene) -> dict[str, np.ndarray]:
    """Return the vertices of every mesh in the base frame, name of its node -> (N, 3), metres."""
    out = {}
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph.get(name)
        out[name] = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
    return out


def _paint(material: Any) -> dict[str, Any]:
    """Return Mitsuba's description of a glTF material of ``scene.glb``."""
    metallic, roughness = float(material.metallicFactor), float(material.roughnessFactor)
    return _coloured(_linear(material.baseColorFactor[:3]).tolist(), metallic=metallic, roughness=roughness)


def _part_of(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh of the faces of another mesh that are selected by a mask or by indices."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces[faces], process=False)


def _edges(mesh: trimesh.Trimesh, radius: float) -> trimesh.Trimesh:
    """Return the sharp edges of a body as thin rods of this radius, metres."""
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > SMOOTH]
    rods = [
        trimesh.creation.cylinder(radius=radius, segment=mesh.vertices[ends], sections=6)
        for ends in sharp
        if np.ptp(mesh.vertices[ends], axis=0).max() > 0.0
    ]
    joined = trimesh.util.concatenate(rods)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def _floor(height: float, half_size: float = 500.0) -> trimesh.Trimesh:
    """Return the floor as a square of half side ``half_size`` at the height z = ``height``, metres."""
    corners = half_size * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    corners[:, 2] = height
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def _linear(colour: Any) -> np.ndarray:
    """Convert sRGB grey values, 0..255, to linear values, 0..1."""
    value = np.asarray(colour, dtype=float) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _studio_light(mi: Any, view: View, rows: int = 128) -> dict[str, Any]:
    """Return soft light from all sides, two large soft boxes near the camera and a dark horizon opposite."""
    theta = np.pi * (np.arange(rows) + 0.5) / rows
    phi = 2.0 * np.pi * (np.arange(2 * rows) + 0.5) / (2 * rows)
    polar, azimuth = np.meshgrid(theta, phi, indexing="ij")
    # Mitsuba's maps have +Y up; to_world below turns it to +Z, and longitude then runs from +Y toward +X
    toward = np.stack([np.sin(polar) * np.sin(azimuth), np.sin(polar) * np.cos(azimuth), np.cos(polar)], axis=-1)
    height = toward[..., 2]
    flat = -np.array([view.forward[0], view.forward[1], 0.0])
    flat /= np.linalg.norm(flat)  # horizontally toward the camera
    side = np.array([view.right[0], view.right[1], 0.0])
    # mirrors reflect the horizon behind the camera's target, which is dark near the floor for contrast with the floor
    opposite = np.clip(toward @ -flat, 0.0, 1.0)
    rise = np.clip(height / 0.75, 0.0, 1.0)
    level = 0.55 + 0.45 * np.clip(height, 0.0, 1.0)
    level = level + np.sqrt(opposite) * (0.10 + 1.0 * rise**1.5 - level)
    for direction, half_angle, strength in (
        (0.60 * flat - 0.75 * side + 0.85 * np.array([0, 0, 1]), 0.55, 1.5),
        (0.45 * flat + 0.90 * side + 0.80 * np.array([0, 0, 1]), 0.40, 0.9),
    ):
        angle = np.arccos(np.clip(toward @ (direction / np.linalg.norm(direction)), -1.0, 1.0))
        level = level + strength / (1.0 + np.exp((angle - half_angle) / 0.05))
    colour = np.repeat(level[..., None], 3, axis=-1).astype(np.float32)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(colour),
        "to_world": mi.ScalarTransform4f().rotate([1.0, 0.0, 0.0], 90.0),
    }


def load_studio(mi: Any, parts: list[Part], view: View) -> Any:
    """Return a ``mi.Scene`` of the parts under the studio's light; shapes have the order of the parts."""
    names = [f"part{i:04d}" for i in range(len(parts))]
    description: dict[str, Any] = {"type": "scene", "light": _studio_light(mi, view)}
    for name, part in zip(names, parts, strict=True):
        description[name] = _mesh(mi, name, part)
    scene = mi.load_dict(description, optimize=False)
    if [shape.id() for shape in scene.shapes()] != names:
        raise AssertionError("mitsuba has put the shapes of a scene in another order")
    return scene


def _mesh(mi: Any, name: str, part: Part) -> Any:
    """Return a part as a mesh of Mitsuba."""
    smooth = trimesh.graph.smooth_shade(part.mesh, angle=SMOOTH)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(dict(part.bsdf))
    if part.radiance is not None:
        # no light is sampled toward the many thin beams; a ray that meets one sees it
        light = {"type": "area", "sampling_weight": 0.0, "radiance": {"type": "rgb", "value": list(part.radiance)}}
        properties["emitter"] = mi.load_dict(light)
    mesh = mi.Mesh(name, len(smooth.vertices), len(smooth.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(smooth.vertices, dtype=np.float32).ravel())
    parameters["vertex_normals"] = mi.Float(np.ascontiguousarray(smooth.vertex_normals, dtype=np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(smooth.faces, dtype=np.uint32).ravel())
    parameters.update()
    return mesh
