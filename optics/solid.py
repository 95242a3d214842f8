"""Glass bodies bounded by flat faces: which face does what, and the mesh that the faces enclose.

A solid is convex: the points behind all of its faces. A face's frame has +z along the outward normal; the solid's own
body carries it, so that a turn of the solid turns all faces and a turn of one face's body is an angle error.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
import trimesh

from optics.polyhedron import EmptyBodyError, OpenBodyError, enclosed
from optics.pose import Pose
from optics.tree import PlacedBodies


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
        polygons: face by face, its corners in order, (K, 3), counterclockwise from outside; (0, 3) for a ground face
            that the other faces cut off.
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
        SolidError: the faces leave no room, leave the body open, or cut off one of them that is more than a ground
            surface.
    """
    own = placed.pose(solid.path, state).inverse()
    planes = [face_plane(face, placed, state) for face in solid.faces]
    normals = np.array([own.rotation @ n for _, n in planes])
    offsets = np.einsum("fi,fi->f", normals, np.array([own.apply(p) for p, _ in planes]))
    try:
        body = enclosed(normals, offsets)
    except EmptyBodyError as error:
        raise SolidError(f"{solid.path}: its faces leave no room between them") from error
    except OpenBodyError as error:
        raise SolidError(f"{solid.path}: its faces do not enclose a body; it is open on one side") from error
    for face, ring in zip(solid.faces, body.rings, strict=True):
        if not ring and face.coating is not Coating.GROUND:
            raise SolidError(f"{solid.path}: face {face.name!r} is cut off by the other faces")
    fans = [(k, (ring[0], *pair)) for k, ring in enumerate(body.rings) for pair in pairwise(ring[1:])]
    mesh = trimesh.Trimesh(body.vertices, np.array([corners for _, corners in fans]), process=False)
    return SolidMesh(mesh, np.array([k for k, _ in fans]), tuple(body.vertices[list(ring)] for ring in body.rings))
