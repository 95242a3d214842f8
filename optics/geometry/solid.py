"""Convex bodies: what half-spaces enclose, exactly, and solids of glass with flat faces.

Planes that almost meet in one point or almost coincide leave edges of nanometres, and no tolerance tells there which
corners are one. So bodies are cut out of a large box with integers, plane by plane: every corner is the exact meeting
point of three given planes, every question of sides has the exact answer, and two faces always share their edge. Edges
too short for floating-point meshes are then taken out one by one, as long as the surface stays closed.

A solid is convex: the points behind all of its faces. A face's frame has +z along the outward normal; the solid's own
body carries it, so that a turn of the solid turns all faces and a turn of one face's body is an angle error.
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

if TYPE_CHECKING:  # takes a third of a second
    import trimesh

REACH = 100.0
"""A body that reaches farther from the origin counts as open, metres."""

MERGED = 1e-7
"""Edges shorter than this are taken out, and a body thinner than this is none, metres: a metre in single precision, in
which paths are traced, has steps of 6e-8 m."""

_BITS = 60
"""Planes are rounded to 2**-60, 1e-18 of a unit normal or a metre: far below the rounding of doubles."""

_Plane = tuple[int, int, int, int]
"""Normal and offset, n . x <= d."""

_Corner = tuple[int, int, int, int]
"""Homogeneous x, y, z, w with w > 0."""

_Rings = dict[int, list[int]]
"""Face -> its corners, counterclockwise from outside."""


class OpenBodyError(PhysicalError, ValueError):
    """The half-spaces do not bound a body."""


class EmptyBodyError(PhysicalError, ValueError):
    """No body, or one thinner than MERGED, lies in all half-spaces."""


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """A convex body.

    Attributes
    ----------
    vertices : np.ndarray
        Its corners, (V, 3), metres.
    rings : tuple[tuple[int, ...], ...]
        For each half-space the corners of its face, counterclockwise from outside; empty when the half-space leaves no
        face, or none wider than ``MERGED``. Every edge is in two of them, once each way.
    """

    vertices: np.ndarray
    rings: tuple[tuple[int, ...], ...]


def enclosed(normals: np.ndarray, offsets: np.ndarray) -> Polyhedron:
    """The body of all x with normals . x <= offsets.

    Parameters
    ----------
    normals : np.ndarray
        Outward unit vectors, (F, 3).
    offsets : np.ndarray
        Along them from the origin, (F,), metres.

    Raises
    ------
    OpenBodyError, EmptyBodyError
        There is no such body.
    """
    count = len(offsets)
    planes = [_integers((*n, d)) for n, d in zip(normals.tolist(), offsets.tolist(), strict=True)]
    corners, rings = _box(planes, count)
    for k in range(count):
        _cut(corners, rings, planes, k)
    if any(k >= count for k in rings):
        raise OpenBodyError("open on one side")
    used = sorted({v for ring in rings.values() for v in ring})
    number = {v: i for i, v in enumerate(used)}
    vertices = np.array([[c / corners[v][3] for c in corners[v][:3]] for v in used])  # correctly rounded
    depth = offsets - np.min(vertices @ normals.T, axis=0)
    if np.min(depth[list(rings)]) < MERGED:
        raise EmptyBodyError("no room")
    outlines = {k: [number[v] for v in ring] for k, ring in rings.items()}
    _merge(vertices, outlines)
    used = sorted({v for ring in outlines.values() for v in ring})
    number = {v: i for i, v in enumerate(used)}
    return Polyhedron(vertices[used], tuple(tuple(number[v] for v in outlines.get(k, ())) for k in range(count)))


def _integers(plane: Iterable[float]) -> _Plane:
    a, b, c, d = (round(ldexp(value, _BITS)) for value in plane)
    return a, b, c, d


def _box(planes: list[_Plane], first: int) -> tuple[list[_Corner], _Rings]:
    """Corners and faces of the box to cut from; its planes are added to ``planes``, beginning with number ``first``."""
    reach = int(REACH)
    corners = [(x, y, z, 1) for x in (-reach, reach) for y in (-reach, reach) for z in (-reach, reach)]
    outlines = {(-1, 0, 0): (0, 1, 3, 2), (1, 0, 0): (4, 6, 7, 5), (0, -1, 0): (0, 4, 5, 1)}
    outlines |= {(0, 1, 0): (2, 3, 7, 6), (0, 0, -1): (0, 2, 6, 4), (0, 0, 1): (1, 5, 7, 3)}
    rings = {}
    for k, (normal, ring) in enumerate(outlines.items()):
        planes.append(_integers((*normal, REACH)))
        rings[first + k] = list(ring)
    return corners, rings


def _cut(corners: list[_Corner], rings: _Rings, planes: Sequence[_Plane], k: int) -> None:
    """Cut off what lies beyond plane number ``k``; a plane that cuts nothing off leaves no face."""
    a, b, c, d = planes[k]
    side = {}
    for v in {v for ring in rings.values() for v in ring}:
        x, y, z, w = corners[v]
        height = a * x + b * y + c * z - d * w
        side[v] = (height > 0) - (height < 0)
    if min(side.values()) >= 0:
        raise EmptyBodyError("no room")
    if max(side.values()) <= 0:
        return
    face_at = {(u, v): face for face, ring in rings.items() for u, v in _edges(ring)}
    new: dict[tuple[int, int], int] = {}
    after: dict[int, int] = {}  # along the cut
    for face, ring in list(rings.items()):
        if all(side[v] >= 0 for v in ring):
            del rings[face]
            continue
        kept = []
        for u, v in _edges(ring):
            if side[u] <= 0:
                kept.append(u)
            if side[u] * side[v] < 0:
                edge = (min(u, v), max(u, v))
                if edge not in new:
                    new[edge] = len(corners)
                    corners.append(_meeting(planes[face], planes[face_at[v, u]], planes[k]))
                    side[new[edge]] = 0
                kept.append(new[edge])
        rings[face] = kept
        after.update({v: u for u, v in _edges(kept) if side[u] == side[v] == 0})
    start = next(iter(after))
    cap = [start]
    while after[cap[-1]] != start:
        cap.append(after[cap[-1]])
    rings[k] = cap


def _edges(ring: Sequence[int]) -> Iterable[tuple[int, int]]:
    """Consecutive corners of a ring, closed."""
    return zip(ring, (*ring[1:], ring[0]), strict=True)


def _meeting(p: _Plane, q: _Plane, r: _Plane) -> _Corner:
    """Where three planes meet in one point, by Cramer's rule."""
    qr = (q[1] * r[2] - q[2] * r[1], q[2] * r[0] - q[0] * r[2], q[0] * r[1] - q[1] * r[0])
    rp = (r[1] * p[2] - r[2] * p[1], r[2] * p[0] - r[0] * p[2], r[0] * p[1] - r[1] * p[0])
    pq = (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])
    w = p[0] * qr[0] + p[1] * qr[1] + p[2] * qr[2]
    x, y, z = (p[3] * s + q[3] * t + r[3] * u for s, t, u in zip(qr, rp, pq, strict=True))
    return (x, y, z, w) if w > 0 else (-x, -y, -z, -w)


def _merge(vertices: np.ndarray, rings: _Rings) -> None:
    """Take out edges shorter than ``MERGED``, the shortest first: one end takes the other's place.

    A corner stays where it is or goes, so that all that are left are corners of the exact body. An edge whose end
    cannot go without tearing the surface stays.
    """
    while True:
        edges = {(u, v) for ring in rings.values() for u, v in _edges(ring) if u < v}
        lengths = {(u, v): float(np.linalg.norm(vertices[u] - vertices[v])) for u, v in edges}
        for u, v in sorted((e for e in edges if lengths[e] < MERGED), key=lambda e: (lengths[e], e)):
            changed = _without(rings, u, v)
            if changed is not None:
                rings.clear()
                rings.update(changed)
                break
        else:
            return


def _without(rings: _Rings, u: int, v: int) -> _Rings | None:
    """The faces with corner v drawn into its neighbour u; None when they would not be those of a body any more."""
    out = {}
    for face, ring in rings.items():
        merged = [u if w == v else w for w in ring]
        merged = [w for w, after in _edges(merged) if w != after]
        if len(merged) > 2:
            out[face] = merged
    if len(out) < 4 or any(len(set(ring)) < len(ring) for ring in out.values()):
        return None
    edges = {edge: face for face, ring in out.items() for edge in _edges(ring)}
    closed = len(edges) == sum(map(len, out.values())) and all((b, a) in edges for a, b in edges)
    common = Counter(
        frozenset(pair) for f, g in combinations(out.values(), 2) for pair in combinations(set(f) & set(g), 2)
    )
    # two corners that two faces share are an edge, and no other two faces share them
    return out if closed and all(tuple(pair) in edges and count == 1 for pair, count in common.items()) else None


class Coating(Enum):
    """What a face is made to do."""

    MIRROR = "mirror"  # metallised: reflects from inside and outside
    TRANSMITTING = "transmitting"  # polished, anti-reflection coated
    TOTAL = "total"  # polished, bare: reflects totally from inside beyond the critical angle
    GROUND = "ground"  # ground and blackened: absorbs and scatters


class SolidError(PhysicalError, ValueError):
    """The faces do not enclose a body."""


@dataclass(frozen=True)
class Face:
    """One face.

    Attributes
    ----------
    name : str
        Within the solid, e.g. ``window``, ``roof_a``.
    body : str
        Path of the tree's body that carries it (the solid's own, or a child of it when the face can have an error of
        its own).
    coating : Coating
        What it does.
    pose : Pose
        Of the face in that body's frame, +z outward.
    """

    name: str
    body: str
    coating: Coating
    pose: Pose = Pose()  # noqa: RUF009 - immutable


@dataclass(frozen=True)
class Solid:
    """A glass body.

    Attributes
    ----------
    path : str
        Path of its body in the tree.
    material : str
        Name in the catalogues ``optics.materials.glass`` and ``optics.materials.material``.
    faces : tuple[Face, ...]
        All faces; their inner half-spaces meet in the body.
    transparent : bool
        False for a body of which only the outer faces are used (light never goes inside).
    """

    path: str
    material: str
    faces: tuple[Face, ...]
    transparent: bool = True


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """The body as a triangle mesh in the frame of the solid's body, metres.

    Attributes
    ----------
    vertices : np.ndarray
        Corners, (V, 3).
    triangles : np.ndarray
        Closed, with outward winding, (T, 3).
    face_of : np.ndarray
        (T,) index into ``Solid.faces``.
    polygons : tuple[np.ndarray, ...]
        Face by face, its corners in order, (K, 3), counterclockwise from outside; (0, 3) for a ground face that the
        other faces cut off.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    face_of: np.ndarray
    polygons: tuple[np.ndarray, ...]

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The same for who measures or draws it."""
        import trimesh

        return trimesh.Trimesh(self.vertices, self.triangles, process=False)


def face_plane(face: Face, placed: PlacedBodies, state: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Point and outward unit normal of a face in the world, (3,) each.

    Parameters
    ----------
    face : Face
        Of a solid.
    placed : PlacedBodies
        Bodies of S states.
    state : int
        Which of them.
    """
    pose = placed.pose(face.body, state)
    scale = float(placed.scale[state, placed.index[face.body]].real)
    return pose.apply(scale * face.pose.translation), pose.rotation @ face.pose.rotation[:, 2]


def solid_mesh(solid: Solid, placed: PlacedBodies) -> SolidMesh:
    """Mesh of the body that the faces enclose.

    Raises
    ------
    SolidError
        The faces leave no room, leave the body open, or cut off one of them that is more than a ground surface.
    """
    own = placed.pose(solid.path).inverse()
    planes = [face_plane(face, placed, 0) for face in solid.faces]
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
    faces, triangles = (np.array(column) for column in zip(*fans, strict=True))
    return SolidMesh(body.vertices, triangles, faces, tuple(body.vertices[list(ring)] for ring in body.rings))
