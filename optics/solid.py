"""Glass bodies bounded by flat faces: which face does what, and the mesh that the faces enclose.

A solid is convex: the points behind all of its faces. A face's frame has +z along the outward normal; the solid's own
body carries it, so that a turn of the solid turns all faces and a turn of one face's body is an angle error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import trimesh
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from optics.pose import Pose
from optics.tree import PlacedBodies

ON_PLANE = 1e-9
"""Distance below which a vertex counts as lying on a face, metres."""


class Coating(Enum):
    """What a face is made to do."""

    MIRROR = "mirror"  # metallised: reflects from inside and outside
    TRANSMITTING = "transmitting"  # polished, anti-reflection coated
    TOTAL = "total"  # polished, bare: reflects totally from inside beyond the critical angle
    GROUND = "ground"  # ground and blackened: absorbs and scatters


class SolidError(ValueError):
    """The faces do not enclose a body."""


@dataclass(frozen=True)
class Face:
    """One face.

    Attributes:
        name: within the solid, e.g. ``window``, ``roof_a``.
        body: path of the tree's body that carries it (the solid's own, or a child of it when the face can have an
            error of its own).
        coating: what it does.
        pose: of the face in that body's frame, +z outward.
    """

    name: str
    body: str
    coating: Coating
    pose: Pose = Pose()  # noqa: RUF009 - immutable


@dataclass(frozen=True)
class Solid:
    """A glass body.

    Attributes:
        path: path of its body in the tree.
        material: name in the catalogues ``optics.glass`` and ``optics.material``.
        faces: all faces; their inner half-spaces meet in the body.
        transparent: False for a body of which only the outer faces are used (light never goes inside).
    """

    path: str
    material: str
    faces: tuple[Face, ...]
    transparent: bool = True


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """The body as a triangle mesh in the frame of the solid's body, metres.

    Attributes:
        mesh: watertight, outward winding.
        face_of: (triangles,) index into ``Solid.faces``.
        polygons: face by face, its corners in order, (K, 3), counterclockwise from outside.
    """

    mesh: trimesh.Trimesh
    face_of: np.ndarray
    polygons: tuple[np.ndarray, ...]


def face_plane(face: Face, placed: PlacedBodies, state: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Point and outward unit normal of a face in the world, (3,) each."""
    pose = placed.pose(face.body, state)
    scale = float(placed.scale[state, placed.index[face.body]].real)
    return pose.apply(scale * face.pose.translation), pose.rotation @ face.pose.rotation[:, 2]


def solid_mesh(solid: Solid, placed: PlacedBodies, state: int = 0) -> SolidMesh:
    """Mesh of the body that the faces enclose.

    Raises:
        SolidError: the faces leave no room, leave the body open, or a face is cut off by the others.
    """
    own = placed.pose(solid.path, state).inverse()
    planes = [face_plane(face, placed, state) for face in solid.faces]
    normals = np.array([own.rotation @ n for _, n in planes])
    offsets = np.einsum("fi,fi->f", normals, np.array([own.apply(p) for p, _ in planes]))
    corners = _corners(solid.path, normals, offsets)
    polygons = tuple(_polygon(solid, k, corners, normals[k], offsets[k]) for k in range(len(solid.faces)))
    vertices, triangles, face_of = _triangulate(polygons)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    if not mesh.is_watertight or mesh.volume <= 0.0:
        raise SolidError(f"{solid.path}: its faces do not enclose a body; the mesh is not watertight")
    return SolidMesh(mesh, face_of, polygons)


def _corners(path: str, normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Corners of the polyhedron normals . x <= offsets, (V, 3)."""
    # the centre of the largest sphere inside; bounded, so that an open body is found as one of huge size
    bounds = [(-1e3, 1e3)] * 3 + [(0.0, 1e3)]
    rows = np.column_stack([normals, np.ones(len(normals))])
    found = linprog([0.0, 0.0, 0.0, -1.0], rows, offsets, bounds=bounds)
    if found.status != 0 or found.x[3] < ON_PLANE:
        raise SolidError(f"{path}: its faces leave no room between them")
    if found.x[3] > 1e2:
        raise SolidError(f"{path}: its faces do not enclose a body; it is open on one side")
    try:
        with np.errstate(divide="ignore", invalid="ignore"):  # corners at infinity are found below
            corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), found.x[:3]).intersections
    except QhullError as error:
        raise SolidError(f"{path}: its faces do not enclose a body; it is open on one side") from error
    if not np.all(np.isfinite(corners)) or np.abs(corners).max() > 1e2:
        raise SolidError(f"{path}: its faces do not enclose a body; it is open on one side")
    return np.asarray(corners)


def _polygon(solid: Solid, k: int, corners: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Corners on one face, counterclockwise from outside, each once."""
    on = corners[np.abs(corners @ normal - offset) < ON_PLANE]
    kept: list[np.ndarray] = []
    for corner in on:
        if all(np.linalg.norm(corner - other) > 10.0 * ON_PLANE for other in kept):
            kept.append(corner)
    if len(kept) < 3:
        raise SolidError(f"{solid.path}: face {solid.faces[k].name!r} is cut off by the other faces")
    points = np.array(kept)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    arm = points - points.mean(axis=0)
    return np.asarray(points[np.argsort(np.arctan2(arm @ np.cross(normal, across), arm @ across))])


def _triangulate(polygons: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shared vertices, fans of triangles, and which polygon each came from."""
    vertices: list[np.ndarray] = []
    triangles, face_of = [], []
    for k, polygon in enumerate(polygons):
        index = []
        for corner in polygon:
            near = next((i for i, v in enumerate(vertices) if np.linalg.norm(v - corner) < 100.0 * ON_PLANE), None)
            if near is None:
                vertices.append(corner)
            index.append(len(vertices) - 1 if near is None else near)
        for i in range(1, len(index) - 1):
            triangles.append((index[0], index[i], index[i + 1]))
            face_of.append(k)
    return np.array(vertices), np.array(triangles), np.array(face_of)
