"""Triangle meshes of mirrors and boards as solid bodies, and of surfaces for the path tracer.

Prescriptions do not describe substrates; these have a thickness that is usual for lightweight mirrors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, assert_never

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.surface import Surface
from optics.numerics.array_math import UnphysicalError
from scenes.models.camera_model import CameraModel

if TYPE_CHECKING:
    import trimesh

GRID = 24
"""Cells across a mirror: the mesh departs from the surface by less than a millimetre."""

THICKNESS = 0.08
"""Smallest thickness of a mirror behind its surface, as a fraction of its longer side."""

BOARD = 0.010
"""Thickness of the focal plane's board, in metres; it stands behind the detectors."""

BOARD_EDGE = 0.020
"""Margin of the board beyond the outermost part that it carries, in metres."""

CHIP = 0.0005
"""Thickness of detector chips in drawings, in metres."""


def mirror_mesh(surface: Surface, aperture: Aperture, back: float) -> trimesh.Trimesh:
    """Return a mirror as a watertight trimesh object, for drawing: optical surface, flat back and edge."""
    import trimesh

    return trimesh.Trimesh(*mirror_triangles(surface, aperture, back), process=False)


def mirror_triangles(
    surface: Surface, aperture: Aperture, back: float, cells: int = GRID
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mirror as a closed mesh: its optical surface over the clear aperture, a flat back and an edge.

    Parameters
    ----------
    surface : Surface
        Shape, in metres.
    aperture : Aperture
        Clear aperture.
    back : float
        +1 if the substrate is on the surface's +z side, -1 if it is on its -z side.
    cells : int
        Number of cells across the mirror.

    Returns
    -------
    vertices : (V, 3) ndarray
        V vertices in the mirror's frame, in metres.
    triangles : (T, 3) ndarray of int
        Vertex numbers of T triangles, with outward winding.
    """
    x0, x1, y0, y1 = aperture.bounds
    hole = cells // 4 if isinstance(aperture, Circle) and aperture.inner else 0
    x, y, face = _grid(aperture, 0.5 * (x1 - x0), 0.5 * (y1 - y0), cells, hole)
    front = np.stack([x, y, surface.sag(x, y)], axis=-1).reshape(-1, 3)
    thickness = THICKNESS * max(x1 - x0, y1 - y0)
    rear = front.copy()
    rear[:, 2] = (front[:, 2].max() + thickness) if back > 0 else (front[:, 2].min() - thickness)
    return _closed(front, rear, face, back, cells, hole)


def lens_mesh(model: CameraModel, first: str, last: str) -> trimesh.Trimesh:
    """Return a lens as a watertight trimesh object between its two faces, in the frame of the first, for drawing."""
    import trimesh

    pose = model.mirror_pose(first).inverse() @ model.mirror_pose(last)
    edges = [model.apertures[face] for face in (first, last)]
    if type(edges[0]) is not type(edges[1]):
        edges = [edge.enclosing for edge in edges]
    sides, triangles = [], np.empty((0, 3), int)
    for face, edge in zip((first, last), edges, strict=True):
        x0, x1, y0, y1 = edge.bounds
        x, y, triangles = _grid(edge, 0.5 * (x1 - x0), 0.5 * (y1 - y0), GRID)
        sides.append(np.stack([x, y, model.surfaces[face].sag(x, y)], axis=-1).reshape(-1, 3))
    back = 1.0 if pose.translation[2] > 0.0 else -1.0
    return trimesh.Trimesh(*_closed(sides[0], pose.apply(sides[1]), triangles, back, GRID), process=False)


def _closed(
    front: np.ndarray, rear: np.ndarray, face: np.ndarray, back: float, cells: int, hole: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of a body between two grids of equal outline, with the walls between them.

    ``hole`` is the half width of a hole, in cells, and ``back`` the side of the front on which the rear lies.
    """
    n, offset, middle = cells + 1, len(front), cells // 2
    faces = [face, face[:, ::-1] + offset]
    for low, high, inward in ((0, cells, 1), *([(middle - hole, middle + hole, -1)] if hole else [])):
        up, down = np.arange(low, high), np.arange(high, low, -1)
        rim = np.concatenate([low * n + up, up * n + high, high * n + down, down * n + low])[::inward]
        after = np.roll(rim, -1)
        faces += [np.stack([rim, rim + offset, after], 1), np.stack([after, rim + offset, after + offset], 1)]
    out = np.concatenate(faces)
    return np.concatenate([front, rear]), out[:, ::-1] if back > 0 else out


def _grid(
    aperture: Aperture, half_x: float, half_y: float, cells: int, hole: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a grid of points about the middle of an aperture, and the T triangles between them.

    The grid has the outline of the aperture's mesh: a disk, ring by ring, or a box. Within ``hole`` cells of the middle
    of a ring there are no triangles.

    Returns
    -------
    tuple of ndarray
        x and y of the points, in metres; and vertex numbers of the triangles, (T, 3).
    """
    x0, x1, y0, y1 = aperture.bounds
    s, n = np.linspace(-1.0, 1.0, cells + 1), cells + 1
    u, v = np.meshgrid(s, s)
    match aperture:
        case Circle():
            ring, angle = np.maximum(np.abs(u), np.abs(v)), np.arctan2(v, u)
            if hole:
                inner, share = aperture.inner / aperture.radius, 2.0 * hole / cells
                ring = inner + (1.0 - inner) * np.maximum(ring - share, 0.0) / (1.0 - share)
            u, v = ring * np.cos(angle), ring * np.sin(angle)
        case Rectangle() | Ellipse():
            pass
        case _:
            assert_never(aperture)
    i = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    i = i[np.max(np.abs(np.stack([i % n, i // n]) + 0.5 - 0.5 * cells), axis=0) > hole]
    triangles = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    return 0.5 * (x0 + x1) + half_x * u, 0.5 * (y0 + y1) + half_y * v, triangles


def body_outline(model: CameraModel, name: str, edge: Aperture) -> Aperture:
    """Return the outline of a camera's surface: outer edge and hole of its file, or ``edge`` if the file gives none."""
    edges = model.edges.get(name, ())
    outlines = [
        edge_spec.shape
        for edge_spec in edges
        if not edge_spec.blocks and not edge_spec.rotation and isinstance(edge_spec.shape, Aperture)
    ]
    if outlines:
        edge = outlines[0]
    holes = [
        edge_spec.shape
        for edge_spec in edges
        if edge_spec.blocks and isinstance(edge_spec.shape, Circle) and not any(edge_spec.shape.centre)
    ]
    if holes and isinstance(edge, Circle) and not any(edge.centre) and edge.inner < holes[0].radius < edge.radius:
        edge = Circle(edge.radius, edge.centre, holes[0].radius)
    return edge


def behind(model: CameraModel, mirror: str) -> float:
    """Return the side of a mirror's surface on which its substrate lies: +1 toward +z, -1 toward -z.

    It is the side on which the light would continue.
    """
    k = model.mirrors.index(mirror)
    pose = model.mirror_pose(mirror)
    after = model.image_body.translation if k + 1 == len(model.mirrors) else model.vertex(model.mirrors[k + 1])
    return 1.0 if float(pose.rotation[:, 2] @ (pose.translation - after)) > 0.0 else -1.0


def board_size(model: CameraModel, pinholes: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the size of a focal plane's board along its X and Y, in metres; it is centred on the line.

    Parameters
    ----------
    model : CameraModel
        The camera.
    pinholes : list[tuple[float, float]]
        X, Y of its channels' pinholes and area CCDs in the focal plane, in metres.
    """
    line = 0.5 * model.spec.line.pixels * model.spec.line.pitch
    x = max((abs(p[0]) for p in pinholes), default=0.0)
    y = max([line, *(abs(p[1]) for p in pinholes)])
    return 2.0 * (x + BOARD_EDGE), 2.0 * (y + BOARD_EDGE)


CELLS = 10
"""Cells across a curved surface: few, because Mitsuba's search takes most of the time. The triangles of a metre-sized
mirror are then up to a millimetre off, which the refinement of intersections corrects.
"""

MARGIN = 0.01
LEAST_MARGIN = 2e-4
"""Margin of the triangles beyond the clear aperture: ``MARGIN`` as a fraction of its half-size, and at least
``LEAST_MARGIN`` metres. The chords of outline and surface must not exclude a ray that meets the surface inside its
edge.
"""


def sheet_mesh(surface: Surface, aperture: Aperture) -> tuple[np.ndarray, np.ndarray, float]:
    """Return triangles over a clear aperture and a small margin.

    Parameters
    ----------
    surface : Surface
        Shape, in metres.
    aperture : Aperture
        Clear aperture; a hole in it is covered, too.

    Returns
    -------
    vertices : (V, 3) ndarray
        Vertices in the surface's frame, in metres.
    triangles : (T, 3) ndarray of int
        Vertex numbers.
    distance : float
        Largest distance between the triangles and the surface, in metres.
    """
    cells = 2 if surface.is_plane and not isinstance(aperture, Circle) else CELLS
    x0, x1, y0, y1 = aperture.bounds
    half_x, half_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    half_x, half_y = (max((1.0 + MARGIN) * h, h + LEAST_MARGIN) for h in (half_x, half_y))
    x, y, triangles = _grid(aperture, half_x, half_y, cells)
    z = surface.sag(x, y)
    if not np.all(np.isfinite(z)):
        raise UnphysicalError("a surface ends before its clear aperture does")
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    middles = 0.5 * (vertices[triangles] + vertices[np.roll(triangles, 1, axis=1)])
    apart = np.abs(surface.sag(middles[..., 0], middles[..., 1]) - middles[..., 2])
    return vertices, triangles, 2.0 * float(np.max(apart))


def polygon_mesh(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a convex polygon of K corners, (K, 3), as a fan of triangles: vertices and vertex numbers."""
    k = np.arange(1, len(corners) - 1)
    return np.asarray(corners), np.stack([np.zeros_like(k), k, k + 1], axis=1)
