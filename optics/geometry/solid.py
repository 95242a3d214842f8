"""Convex bodies as exact intersections of half-spaces, and glass solids with flat faces.

Planes that almost meet in one point or almost coincide leave edges of nanometres, where no tolerance can decide which
corners coincide. Bodies are therefore cut out of a large box in integer arithmetic, plane by plane: every corner is the
exact intersection of three given planes, every side test is exact, and two adjacent faces always share their edge.
Edges too short for floating-point meshes are then removed one by one, as long as the surface stays closed.

A solid is convex: the set of points behind all of its faces. A face's frame has +z along the outward normal. The
solid's own body carries it, so that a rotation of the solid rotates all faces, and a rotation of one face's body is an
angle error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import combinations, pairwise
from math import ldexp
from typing import TYPE_CHECKING

import numpy as np

from optics.geometry.pose import Pose
from optics.geometry.tree import PlacedBodies
from optics.numerics.array_math import PhysicalError

if TYPE_CHECKING:  # imported late: it takes 0.3 s
    import trimesh

MAX_EXTENT = 100.0
"""Half-width of the box from which bodies are cut, metres; a body that reaches farther from the origin counts as open.
"""

MERGE_LENGTH = 1e-7
"""Length below which edges are removed, and thickness below which a body counts as empty, metres.

A metre in single precision, in which paths are traced, has steps of 6e-8 m.
"""

_BITS = 60
"""Number of binary places to which planes are rounded: 2**-60 is 1e-18 of a unit normal or a metre.

That is far below the rounding of float64 numbers.
"""

_Plane = tuple[int, int, int, int]
"""Half-space of points x with n . x <= d: the three components of its normal n, and its offset d, as integers."""

_Corner = tuple[int, int, int, int]
"""Corner in homogeneous integer coordinates (x, y, z, w) with w > 0: the point (x, y, z) / w."""

_Rings = dict[int, list[int]]
"""Face number -> indices of the corners of that face, counterclockwise as seen from outside."""


class OpenBodyError(PhysicalError, ValueError):
    """Error: half-spaces do not bound a body, as their intersection is infinite."""


class EmptyBodyError(PhysicalError, ValueError):
    """Error: half-spaces have no common body, or one thinner than ``MERGE_LENGTH``."""


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """Convex polyhedron.

    Attributes
    ----------
    vertices : (V, 3) ndarray
        V corners, metres.
    rings : tuple of tuple of int
        For each half-space the corners of its face, counterclockwise as seen from outside; empty when the half-space
        has no face, or none wider than ``MERGE_LENGTH``. Every edge is in two rings, once in each direction.
    """

    vertices: np.ndarray
    rings: tuple[tuple[int, ...], ...]


def half_space_intersection(normals: np.ndarray, offsets: np.ndarray) -> Polyhedron:
    """Return the convex body of all points x with normals . x <= offsets.

    Parameters
    ----------
    normals : (F, 3) ndarray
        Outward unit normals of F planes.
    offsets : (F,) ndarray
        Distances of the planes from the origin along the normals, metres.

    Raises
    ------
    OpenBodyError
        The half-spaces do not bound a body.
    EmptyBodyError
        The half-spaces have no common body.
    """
    count = len(offsets)
    planes = [_integers((*n, d)) for n, d in zip(normals.tolist(), offsets.tolist(), strict=True)]
    corners, rings = _box(planes, count)
    for k in range(count):
        _remove_beyond(corners, rings, planes, k)
    if any(k >= count for k in rings):
        raise OpenBodyError("the half-spaces leave the body open on one side")
    used = sorted({v for ring in rings.values() for v in ring})
    number = {v: i for i, v in enumerate(used)}
    vertices = np.array([[c / corners[v][3] for c in corners[v][:3]] for v in used])  # correctly rounded
    depth = offsets - np.min(vertices @ normals.T, axis=0)
    if np.min(depth[list(rings)]) < MERGE_LENGTH:
        raise EmptyBodyError("the half-spaces enclose no volume")
    outlines = {k: [number[v] for v in ring] for k, ring in rings.items()}
    _merge(vertices, outlines)
    used = sorted({v for ring in outlines.values() for v in ring})
    number = {v: i for i, v in enumerate(used)}
    return Polyhedron(vertices[used], tuple(tuple(number[v] for v in outlines.get(k, ())) for k in range(count)))


def _integers(plane: Iterable[float]) -> _Plane:
    """Return a plane's normal and offset as integers in units of 2**-60."""
    a, b, c, d = (round(ldexp(value, _BITS)) for value in plane)
    return a, b, c, d


def _box(planes: list[_Plane], first: int) -> tuple[list[_Corner], _Rings]:
    """Return corners and faces of the large box from which bodies are cut, and append its planes to ``planes``.

    The six planes of the box get the numbers ``first``, ``first`` + 1, and so on.
    """
    extent = int(MAX_EXTENT)
    corners = [(x, y, z, 1) for x in (-extent, extent) for y in (-extent, extent) for z in (-extent, extent)]
    outlines = {(-1, 0, 0): (0, 1, 3, 2), (1, 0, 0): (4, 6, 7, 5), (0, -1, 0): (0, 4, 5, 1)}
    outlines |= {(0, 1, 0): (2, 3, 7, 6), (0, 0, -1): (0, 2, 6, 4), (0, 0, 1): (1, 5, 7, 3)}
    rings = {}
    for k, (normal, ring) in enumerate(outlines.items()):
        planes.append(_integers((*normal, MAX_EXTENT)))
        rings[first + k] = list(ring)
    return corners, rings


def _remove_beyond(corners: list[_Corner], rings: _Rings, planes: Sequence[_Plane], k: int) -> None:
    """Cut off the part of a body beyond plane number ``k``; a plane that cuts nothing off makes no face.

    ``corners`` and ``rings`` are the corners and faces of the body, which are changed.
    """
    a, b, c, d = planes[k]
    side = {}
    for v in {v for ring in rings.values() for v in ring}:
        x, y, z, w = corners[v]
        height = a * x + b * y + c * z - d * w
        side[v] = (height > 0) - (height < 0)
    if min(side.values()) >= 0:
        raise EmptyBodyError("the half-spaces enclose no volume")
    if max(side.values()) <= 0:
        return
    face_at = {(u, v): face for face, ring in rings.items() for u, v in _edges(ring)}
    new: dict[tuple[int, int], int] = {}
    after: dict[int, int] = {}  # along the cut
    for face, ring in list(rings.items()):
        if all(side[v] >= 0 for v in ring):
            del rings[face]
            continue
        new_ring = []
        for u, v in _edges(ring):
            if side[u] <= 0:
                new_ring.append(u)
            if side[u] * side[v] < 0:
                edge = (min(u, v), max(u, v))
                if edge not in new:
                    new[edge] = len(corners)
                    corners.append(_intersection(planes[face], planes[face_at[v, u]], planes[k]))
                    side[new[edge]] = 0
                new_ring.append(new[edge])
        rings[face] = new_ring
        after.update({v: u for u, v in _edges(new_ring) if side[u] == side[v] == 0})
    start = next(iter(after))
    cap = [start]
    while after[cap[-1]] != start:
        cap.append(after[cap[-1]])
    rings[k] = cap


def _edges(ring: Sequence[int]) -> Iterable[tuple[int, int]]:
    """Return pairs of consecutive corners of a closed ring; the last is joined to the first."""
    return zip(ring, (*ring[1:], ring[0]), strict=True)


def _intersection(p: _Plane, q: _Plane, r: _Plane) -> _Corner:
    """Return the intersection of three planes, by Cramer's rule."""
    qr = (q[1] * r[2] - q[2] * r[1], q[2] * r[0] - q[0] * r[2], q[0] * r[1] - q[1] * r[0])
    rp = (r[1] * p[2] - r[2] * p[1], r[2] * p[0] - r[0] * p[2], r[0] * p[1] - r[1] * p[0])
    pq = (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])
    w = p[0] * qr[0] + p[1] * qr[1] + p[2] * qr[2]
    x, y, z = (p[3] * s + q[3] * t + r[3] * u for s, t, u in zip(qr, rp, pq, strict=True))
    return (x, y, z, w) if w > 0 else (-x, -y, -z, -w)


def _merge(vertices: np.ndarray, rings: _Rings) -> None:
    """Remove edges shorter than ``MERGE_LENGTH``, the shortest first, by merging one end into the other.

    A corner stays where it is or disappears, so that all remaining ones are corners of the exact body. An edge whose
    end cannot be removed without opening the surface stays.
    """
    while True:
        edges = {(u, v) for ring in rings.values() for u, v in _edges(ring) if u < v}
        lengths = {(u, v): float(np.linalg.norm(vertices[u] - vertices[v])) for u, v in edges}
        for u, v in sorted((e for e in edges if lengths[e] < MERGE_LENGTH), key=lambda e: (lengths[e], e)):
            changed = _without(rings, u, v)
            if changed is not None:
                rings.clear()
                rings.update(changed)
                break
        else:
            return


def _without(rings: _Rings, u: int, v: int) -> _Rings | None:
    """Return the faces with corner v merged into its neighbour u, or None if they would no longer bound a body."""
    remaining = {}
    for face, ring in rings.items():
        merged = [u if w == v else w for w in ring]
        merged = [w for w, after in _edges(merged) if w != after]
        if len(merged) > 2:
            remaining[face] = merged
    if len(remaining) < 4 or any(len(set(ring)) < len(ring) for ring in remaining.values()):
        return None
    edges = {edge: face for face, ring in remaining.items() for edge in _edges(ring)}
    closed = len(edges) == sum(map(len, remaining.values())) and all((b, a) in edges for a, b in edges)
    common = Counter(
        frozenset(pair) for f, g in combinations(remaining.values(), 2) for pair in combinations(set(f) & set(g), 2)
    )
    # two corners common to two faces must form an edge, and belong to no other pair of faces
    return remaining if closed and all(tuple(pair) in edges and count == 1 for pair, count in common.items()) else None


class Coating(Enum):
    """Surface treatment of a face of a glass solid, which decides whether it reflects, transmits or absorbs."""

    MIRROR = "mirror"  # metallised: reflects from inside and outside
    TRANSMITTING = "transmitting"  # polished, anti-reflection coated
    TOTAL = "total"  # polished, bare: reflects totally from inside beyond the critical angle
    GROUND = "ground"  # ground and blackened: absorbs and scatters


class SolidError(PhysicalError, ValueError):
    """Error: the faces of a solid do not enclose a body."""


@dataclass(frozen=True)
class Face:
    """Flat face of a solid.

    Attributes
    ----------
    name : str
        Name within the solid, e.g. ``window``, ``roof_a``.
    body : str
        Path of the rigid body that carries it (the solid's own, or a child of it when the face can have an angle error
        of its own).
    coating : Coating
        Surface treatment.
    pose : Pose
        Pose of the face in that body's frame, +z outward.
    """

    name: str
    body: str
    coating: Coating
    pose: Pose = Pose()  # noqa: RUF009 - immutable


@dataclass(frozen=True)
class Solid:
    """Glass body with flat faces.

    Attributes
    ----------
    path : str
        Path of its rigid body in the tree of bodies.
    material : str
        Name in the catalogues ``optics.materials.glass`` and ``optics.materials.material``.
    faces : tuple of Face
        All faces; the solid is the intersection of their inner half-spaces.
    transparent : bool
        False for a body of which only the outer faces are used (light never goes inside).
    """

    path: str
    material: str
    faces: tuple[Face, ...]
    transparent: bool = True


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """Triangle mesh of a solid in the frame of the solid's body, metres.

    Attributes
    ----------
    vertices : (V, 3) ndarray
        V corners.
    triangles : (T, 3) ndarray
        Corner indices of the T triangles of a closed mesh with outward winding.
    face_of : (T,) ndarray
        Index of each triangle's face in ``Solid.faces``.
    polygons : tuple of (K, 3) ndarray
        K corners of each face in order, counterclockwise as seen from outside; (0, 3) for a ground face that the other
        faces cut off.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    face_of: np.ndarray
    polygons: tuple[np.ndarray, ...]

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """Triangle mesh as a trimesh object, for measuring and drawing."""
        import trimesh

        return trimesh.Trimesh(self.vertices, self.triangles, process=False)


def face_plane(face: Face, placed: PlacedBodies, state: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a point and the outward unit normal of a face in world coordinates, (3,) each.

    Parameters
    ----------
    face : Face
        Face of a solid.
    placed : PlacedBodies
        World poses of the bodies in S states.
    state : int
        Index of the state.
    """
    pose = placed.pose(face.body, state)
    scale = float(placed.scale[state, placed.index[face.body]].real)
    return pose.apply(scale * face.pose.translation), pose.rotation @ face.pose.rotation[:, 2]


def solid_mesh(solid: Solid, placed: PlacedBodies) -> SolidMesh:
    """Return the mesh of the body that a solid's faces enclose.

    Raises
    ------
    SolidError
        The faces enclose nothing, leave the body open, or cut off a face that is not ground.
    """
    to_body = placed.pose(solid.path).inverse()
    planes = [face_plane(face, placed, 0) for face in solid.faces]
    normals = np.array([to_body.rotation @ n for _, n in planes])
    offsets = np.einsum("fi,fi->f", normals, np.array([to_body.apply(p) for p, _ in planes]))
    try:
        body = half_space_intersection(normals, offsets)
    except EmptyBodyError as error:
        raise SolidError(f"{solid.path}: its faces enclose no volume") from error
    except OpenBodyError as error:
        raise SolidError(f"{solid.path}: its faces do not enclose a body; it is open on one side") from error
    for face, ring in zip(solid.faces, body.rings, strict=True):
        if not ring and face.coating is not Coating.GROUND:
            raise SolidError(f"{solid.path}: face {face.name!r} is cut off by the other faces")
    fans = [(k, (ring[0], *pair)) for k, ring in enumerate(body.rings) for pair in pairwise(ring[1:])]
    faces, triangles = (np.array(column) for column in zip(*fans, strict=True))
    return SolidMesh(body.vertices, triangles, faces, tuple(body.vertices[list(ring)] for ring in body.rings))
