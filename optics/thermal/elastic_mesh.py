"""Finite-element meshes of mirror substrates and of glass prisms."""

from itertools import pairwise
from typing import Any, assert_never

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from skfem import MeshHex1, MeshHex2, MeshTet1

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.surface import Surface
from optics.numerics.array_math import UnphysicalError

MERGE_DISTANCE = 1e-3
"""Distance, relative to the mesh's spacing, below which two corners of a body are merged.

The effect of a facet so small is far below the resolution of the elements.
"""

_FLAT = 1e-9  # relative thickness below which a body counts as flat
_PLANE = 1e-11  # relative distance from a common plane below which two triangles are one face
_INNER_SQUARE = 0.55  # half-diagonal of the inner block of a disk's mesh, in radii; gives about equal cells


def mirror_mesh(surface: Surface, aperture: Aperture, thickness: float, behind: float, cells: int) -> MeshHex2:
    """Return a mesh of hexahedra with 27 nodes each that fill a mirror between its optical face and a plane back.

    Every node of the face lies on the surface.

    A rectangle is a grid; a disk is a square block with four blocks around it, so that no cell has a straight angle; a
    disk with a hole is a ring of blocks.

    Parameters
    ----------
    surface : Surface
        The optical face, in its own frame (metres), with its figure.
    aperture : Circle, Rectangle or Ellipse
        Outline of the substrate (its edge is a cylinder or, also about an ellipse, a box along z).
    thickness : float
        Smallest distance along z from the face to the back, metres.
    behind : float
        Side of the face where the substrate lies: +1 toward +z, -1 toward -z.
    cells : int
        Number of cells across the longer width; the number of layers through the thickness follows from it (at least
        2).

    Raises
    ------
    ValueError
        A size is impossible, or the aperture extends beyond the surface's domain.
    """
    if behind not in (1.0, -1.0):
        raise ValueError(f"a substrate lies on side +1 or -1 of its face, found behind = {behind}")
    if not 0.0 < thickness < np.inf or cells < 2:
        raise ValueError(f"a substrate needs a positive thickness and 2 cells or more, found {thickness} m and {cells}")
    x0, x1, y0, y1 = aperture.bounds
    layers = max(2, round(cells * thickness / max(x1 - x0, y1 - y0)))
    match aperture:
        case Circle():
            mesh = MeshHex2.from_mesh(_extruded(*_disk_blocks(cells, aperture.inner > 0.0), layers))
            u, v, depth = mesh.doflocs
            x, y = _on_disk(u, v, aperture.inner / aperture.radius)
            x, y = aperture.centre[0] + aperture.radius * x, aperture.centre[1] + aperture.radius * y
        case Rectangle() | Ellipse():
            mesh = MeshHex2.from_mesh(_extruded(*_grid(aperture, cells), layers))
            u, v, depth = mesh.doflocs
            x, y = 0.5 * (x0 + x1) + 0.5 * (x1 - x0) * u, 0.5 * (y0 + y1) + 0.5 * (y1 - y0) * v
        case _:
            assert_never(aperture)
    sag = surface.sag(x, y)
    if not np.all(np.isfinite(sag)):
        raise UnphysicalError("the aperture extends beyond the domain of its surface")
    back = behind * (np.max(behind * sag) + thickness)
    # as a displacement from the sag, so that the nodes of the face have exactly this sag
    z = sag + depth * (back - sag)
    return _right_handed(MeshHex2(np.stack([x, y, z]), mesh.t))


def _grid(aperture: Aperture, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return V vertices (V, 2) and Q quadrilaterals (Q, 4) of a grid over [-1, 1]^2, nearly square on the aperture."""
    x0, x1, y0, y1 = aperture.bounds
    wide = max(x1 - x0, y1 - y0)
    nx, ny = (max(2, round(cells * w / wide)) for w in (x1 - x0, y1 - y0))
    return _tensor(np.linspace(-1.0, 1.0, nx + 1), np.linspace(-1.0, 1.0, ny + 1))


def _tensor(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and quadrilaterals of the grid of all pairs of coordinates from ``a`` and ``b``.

    The vertex of a[i] and b[j] has the index i * len(b) + j.
    """
    number = np.arange(len(a) * len(b)).reshape(len(a), len(b))
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    return np.stack([np.repeat(a, len(b)), np.tile(b, len(a))], axis=-1), np.stack([c.ravel() for c in corners], axis=1)


def _disk_blocks(cells: int, hole: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and quadrilaterals of a disk's blocks, in coordinates (u, v) in which the disk is a square.

    The inner block is |u|, |v| <= 1/2, the rings around it are squares up to 1.
    """
    side = max(2, cells // 2)
    rings = max(2, cells // 4)
    s = np.linspace(-1.0, 1.0, side + 1)[:-1]
    ones = np.ones_like(s)
    outline = np.concatenate([np.stack(p, axis=-1) for p in ((s, -ones), (ones, s), (-s, ones), (-ones, -s))])
    size = np.linspace(0.5, 1.0, rings + 1)
    points = (size[:, None, None] * outline).reshape(-1, 2)
    number = np.arange(len(points)).reshape(rings + 1, len(outline))
    after = np.roll(number, -1, axis=1)
    quads = np.stack([c.ravel() for c in (number[:-1], number[1:], after[1:], after[:-1])], axis=1)
    if hole:
        return points, quads
    inner, block = _tensor(np.linspace(-0.5, 0.5, side + 1), np.linspace(-0.5, 0.5, side + 1))
    # one number for the vertices that the inner block shares with the first ring
    index = {tuple(p): i for i, p in enumerate(np.rint(inner * 2 * side).astype(int).tolist())}
    renumbered = np.arange(len(points)) + len(inner)
    for i, p in enumerate(np.rint(points[: len(outline)] * 2 * side).astype(int).tolist()):
        renumbered[i] = index[tuple(p)]
    renumbered[len(outline) :] -= len(outline)
    return np.concatenate([inner, points[len(outline) :]]), np.concatenate([block, renumbered[quads]])


def _on_disk(u: np.ndarray, v: np.ndarray, inner: float) -> tuple[np.ndarray, np.ndarray]:
    """Map the square coordinates (u, v) of ``_disk_blocks`` to the unit disk with a hole of radius ``inner``."""
    size = np.maximum(np.abs(u), np.abs(v))
    safe = np.where(size > 0.0, size, 1.0)
    along = np.where(np.abs(u) >= np.abs(v), v * np.sign(u), u * np.sign(v)) / safe  # place on a side, -1..1
    t = 0.25 * np.pi * along
    cosine, sine = np.cos(t), np.sin(t)
    flat = np.abs(u) >= np.abs(v)
    on_circle = (
        np.where(flat, np.sign(u) * cosine, np.sign(v) * sine),
        np.where(flat, np.sign(u) * sine, np.sign(v) * cosine),
    )
    outer = np.clip(2.0 * size - 1.0, 0.0, 1.0)  # 0 on and in the inner block, 1 on the rim
    if inner > 0.0:
        radius = inner + (1.0 - inner) * outer
        return on_circle[0] * radius, on_circle[1] * radius
    half = _INNER_SQUARE / np.sqrt(2.0)
    block = (1.0 - outer) * half / np.maximum(safe, 0.5)
    return block * u + outer * on_circle[0], block * v + outer * on_circle[1]


def _extruded(plane: np.ndarray, quads: np.ndarray, layers: int) -> MeshHex1:
    """Return a mesh of hexahedra above quadrilaterals of a plane, in ``layers`` layers from depth 0 to 1."""
    count = len(plane)
    depth = np.linspace(0.0, 1.0, layers + 1)
    points = np.concatenate([np.column_stack([plane, np.full(count, d)]) for d in depth])
    near = np.concatenate([quads + k * count for k in range(layers)])
    a, b, c, d = near.T
    # scikit-fem's order of a hexahedron: the corners 000, 001, 010, 100, 011, 101, 110, 111 of the unit cube, here
    # with x along a-b, y along a-d and z along the depth
    corners = [a, a + count, d, b, d + count, b + count, c, c + count]
    return MeshHex1(np.ascontiguousarray(points.T), np.array(corners, np.int32))


def _right_handed(mesh: MeshHex2) -> MeshHex2:
    """Return the mesh after a check that no cell is inverted (all volumes have one sign)."""
    volume = mesh.mapping().detDF(np.array([[0.1, 0.9, 0.5], [0.1, 0.9, 0.5], [0.1, 0.9, 0.5]]))
    if not (np.all(volume > 0.0) or np.all(volume < 0.0)):
        raise UnphysicalError("the face is too steep for its mesh: a cell is inverted")
    return mesh


def polyhedron_mesh(vertices: Any, spacing: float) -> MeshTet1:
    """Return tetrahedra that fill a convex polyhedron exactly.

    The body is divided into tetrahedra from its middle over the middles of its faces. Then every edge longer than
    ``spacing`` is halved, the longest of each tetrahedron first (Rivara, Int. J. Numer. Meth. Eng. 20, 745 (1984)).
    Halving keeps volumes positive and faces plane, needs no repair and turns long thin tetrahedra into compact ones.

    Parameters
    ----------
    vertices : (V, 3) array_like
        V corners of the polyhedron in any order, metres.
    spacing : float
        Length of the longest edge of the mesh, metres.

    Raises
    ------
    ValueError
        The points do not span a body, or one of them lies inside the hull of the others, so that the intended body
        cannot be convex.
    """
    points = np.asarray(vertices, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4 or not np.all(np.isfinite(points)):
        raise ValueError(f"a polyhedron needs four or more finite vertices (V, 3), found shape {points.shape}")
    if not 0.0 < spacing < np.inf:
        raise ValueError(f"a mesh needs a positive spacing, found {spacing}")
    size = float(np.max(np.ptp(points, axis=0)))
    middle = np.mean(points, axis=0)
    if np.linalg.svd(points - middle, compute_uv=False)[-1] <= _FLAT * size:
        raise UnphysicalError("the polyhedron is degenerate: its vertices lie in a plane")
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise UnphysicalError(f"the polyhedron is degenerate: {str(error).splitlines()[0]}") from error
    depth = np.max(points @ hull.equations[:, :3].T + hull.equations[:, 3], axis=1)
    if np.min(depth) < -_FLAT * size:
        raise UnphysicalError(
            f"the polyhedron is not convex: vertex {int(np.argmin(depth))} lies inside the others' hull"
        )
    hull = ConvexHull(_separated(points[hull.vertices], MERGE_DISTANCE * spacing))
    fans = [_fan(corners, faces) for corners, faces in _slabs(*_faces(hull, _PLANE * size), spacing)]
    first = np.cumsum([0, *(len(n) for n, _ in fans)])
    nodes, number = np.unique(np.concatenate([n for n, _ in fans]), axis=0, return_inverse=True)
    tetrahedra = number.ravel()[np.concatenate([t + k for (_, t), k in zip(fans, first[:-1], strict=True)])]
    nodes, tetrahedra = _bisected(nodes, tetrahedra, spacing)
    volumes = _volumes(nodes, tetrahedra)
    skin = _skin_area(nodes, tetrahedra)
    if np.min(volumes) <= 0.0 or abs(np.sum(volumes) / hull.volume - 1.0) + abs(skin / hull.area - 1.0) > 1e-9:
        raise UnphysicalError(
            f"the polyhedron's mesh is not watertight: {np.sum(volumes)} m^3 in {skin} m^2 of skin instead of "
            f"{hull.volume} m^3 in {hull.area} m^2"
        )
    return MeshTet1(np.ascontiguousarray(nodes.T), np.ascontiguousarray(tetrahedra.T, np.int32))


def _volumes(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the signed volumes of T tetrahedra, (T,), in m^3."""
    a, b, c, d = (nodes[tetrahedra[:, k]] for k in range(4))
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0)


def _skin_area(nodes: np.ndarray, tetrahedra: np.ndarray) -> float:
    """Return the area of the triangles that belong to one tetrahedron only: the body's surface, if neighbours fit."""
    triangles = np.sort(tetrahedra[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    unique, times = np.unique(triangles, axis=0, return_counts=True)
    a, b, c = (nodes[unique[times == 1, k]] for k in range(3))
    return float(np.sum(np.linalg.norm(np.cross(b - a, c - a), axis=1)) / 2.0)


_Edges = list[tuple[int, int]]
"""Directed edges of one face as pairs of corner indices, with the face on their left as seen from outside."""


def _separated(points: np.ndarray, least: float) -> np.ndarray:
    """Return those of P points (P, 3) that are farther than ``least`` metres from all those selected before.

    The result (K, 3) holds K points.
    """
    selected: list[np.ndarray] = []
    for point in points:
        if all(np.linalg.norm(point - other) > least for other in selected):
            selected.append(point)
    return np.array(selected)


def _faces(hull: ConvexHull, tolerance: float) -> tuple[np.ndarray, list[_Edges]]:
    """Return the V corners (V, 3) and the faces of a convex hull; neighbouring triangles in one plane are one face.

    A face is defined by its edges and not by the points in its plane: whatever the tolerance, neighbours fit.
    """
    points, triangles = hull.points, hull.simplices.copy()
    corners = points[triangles]
    inward = np.einsum("ti,ti->t", np.cross(*np.moveaxis(np.diff(corners, axis=1), 1, 0)), hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward, ::-1]
    face = np.arange(len(triangles))
    for i, neighbours in enumerate(hull.neighbors):
        for j in neighbours:
            heights = points[triangles[j]] @ hull.equations[i, :3] + hull.equations[i, 3]
            if np.max(np.abs(heights)) <= tolerance:
                face[face == face[j]] = face[i]
    out = []
    for number in np.unique(face):
        edges = {(int(t[k]), int(t[k - 2])) for t in triangles[face == number] for k in range(3)}
        out.append([(u, v) for u, v in sorted(edges) if (v, u) not in edges])
    return points, out


def _slabs(corners: np.ndarray, faces: list[_Edges], spacing: float) -> list[tuple[np.ndarray, list[_Edges]]]:
    """Cut a long body across its length into parts about as long as it is wide; return corners and faces of each.

    Cuts stay away from the corners, so that no part is a splinter. Neighbours share identical corners.
    """
    middle = np.mean(corners, axis=0)
    axes = np.linalg.svd(corners - middle)[2]
    target = max(spacing, float(np.ptp((corners - middle) @ axes[1])))
    nodes, along = list(corners), ((corners - middle) @ axes[0]).tolist()
    cuts: list[float] = []
    for low, high in pairwise(sorted(along)):
        count = round((high - low) / target)
        cuts += [low + (high - low) * (k + 0.5) / count for k in range(count)]
    pieces = []
    for height in cuts:
        new: dict[tuple[int, int], int] = {}
        parts: tuple[list[_Edges], list[_Edges]] = ([], [])  # below, above
        section: _Edges = []
        for edges in faces:
            halves: tuple[_Edges, _Edges] = ([], [])
            ends = {}
            for u, v in edges:
                side = along[u] > height
                if side == (along[v] > height):
                    halves[side].append((u, v))
                    continue
                key = (min(u, v), max(u, v))
                if key not in new:
                    a, b = key
                    fraction = (height - along[a]) / (along[b] - along[a])
                    new[key] = len(nodes)
                    nodes.append(nodes[a] + fraction * (nodes[b] - nodes[a]))
                    along.append(height)
                halves[side].append((u, new[key]))
                halves[not side].append((new[key], v))
                ends[side] = new[key]
            if ends:  # the two crossings of the face's outline
                halves[False].append((ends[False], ends[True]))
                halves[True].append((ends[True], ends[False]))
                section.append((ends[True], ends[False]))
            for part, piece in zip(parts, halves, strict=True):
                if piece:
                    part.append(piece)
        pieces.append([*parts[0], section])
        faces = [*parts[1], [(v, u) for u, v in section]]
    return [(np.array(nodes), piece) for piece in [*pieces, faces]]


def _fan(corners: np.ndarray, faces: list[_Edges]) -> tuple[np.ndarray, np.ndarray]:
    """Return tetrahedra from a convex body's middle over the triangles from each face's middle to its edges."""
    used = sorted({corner for edges in faces for edge in edges for corner in edge})
    number = {corner: k for k, corner in enumerate(used)}
    nodes = [*corners[used], np.mean(corners[used], axis=0)]
    tetrahedra = []
    for edges in faces:
        # in an order that does not depend on the piece, so that the neighbour's face gets exactly the same middle
        nodes.append(np.mean(corners[sorted({corner for edge in edges for corner in edge})], axis=0))
        tetrahedra += [(len(used), number[u], number[v], len(nodes) - 1) for u, v in edges]
    chosen = np.array(tetrahedra)
    # all have the same orientation
    return np.array(nodes), chosen if np.sum(_volumes(np.array(nodes), chosen)) > 0.0 else chosen[:, [0, 2, 1, 3]]


def _bisected(nodes: np.ndarray, tetrahedra: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Halve edges until none is longer than ``spacing`` metres.

    Each round halves the edges that are the longest in *every* tetrahedron around them. No tetrahedron has two of them,
    so its two halves fit their neighbours; and the longest edge of the mesh is always among them, so the process ends.
    """
    pairs = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
    while True:
        ends = np.sort(tetrahedra[:, pairs], axis=-1)  # (T, 6, 2)
        edges, edge_index = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
        edge_index = edge_index.reshape(-1, 6)
        length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
        # equal lengths must not be ordered by rounding errors: compare 9 digits, then the index
        rank = np.empty(len(edges), int)
        rank[np.lexsort((np.arange(len(edges)), np.round(length / spacing, 9)))] = np.arange(len(edges))
        longest = edge_index[np.arange(len(edge_index)), np.argmax(rank[edge_index], axis=1)]
        around = np.bincount(edge_index.ravel(), minlength=len(edges))
        bisected = (np.bincount(longest, minlength=len(edges)) == around) & (length > spacing * (1.0 + 1e-9))
        if not np.any(bisected):
            return nodes, tetrahedra
        new = np.cumsum(bisected) - 1 + len(nodes)
        nodes = np.concatenate([nodes, 0.5 * (nodes[edges[bisected, 0]] + nodes[edges[bisected, 1]])])
        split = bisected[longest]
        old, edge = tetrahedra[split], longest[split]
        halves = [np.where(old == edges[edge, k][:, None], new[edge][:, None], old) for k in (0, 1)]
        tetrahedra = np.concatenate([tetrahedra[~split], *halves])
