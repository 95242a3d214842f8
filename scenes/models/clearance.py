"""Whether the bodies of an instrument leave each other room: prisms, mirrors and focal-plane boards, as convex bodies.

Two convex bodies meet where their Minkowski difference contains the origin; how deep tells how far one of them has to
move. Parts of one camera are not compared with each other: the prescription gives them no substrates.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from optics.geometry.pose import Pose
from optics.geometry.solid import Face, Solid, SolidError, face_plane, solid_mesh
from optics.geometry.tree import PlacedBodies
from optics.raytrace.assembly import Assembly, Element
from scenes.models.instrument_model import Instrument, MisplacedError, key_of
from scenes.models.meshes import BOARD, CHIP, behind, board_size, mirror_triangles
from scenes.specs.instrument import BASE, CENTRAL_KEY, CENTRAL_PRISM, PRISM_0, PRISM_180, channel_of, prism_of
from scenes.yaml.errors import InputError, Issue, KeyPath

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

LEAST_GAP = 20e-6
"""Bodies nearer than this count as touching, metres: what the path tracer needs between two of them."""

PARALLEL = 1e-9
"""Sine of the angle between planes below which they have no common edge."""

_CELLS = 12  # across a mirror: the hull lies within a few tenths of a millimetre of the surface


@dataclass(frozen=True)
class Overlap:
    """Two bodies that stand in each other, or touch.

    Attributes:
        first, second: their paths.
        depth: how far one of them has to move for them to touch only; negative for a gap below ``LEAST_GAP``; metres.
        way: along which axis of the base, 0 to 2, and how far, metres with its sign, the second one is moved to leave
            ``LEAST_GAP``: of the three axes the shortest way. None where nobody asked.
    """

    first: str
    second: str
    depth: float
    way: tuple[int, float] | None = None


def convex_hull(points: np.ndarray) -> ConvexHull:
    """The hull of points (N, 3); SciPy is imported when the first is made, since who only reads a file makes none."""
    from scipy.spatial import ConvexHull

    return ConvexHull(points)


def separation(first: np.ndarray, second: np.ndarray) -> float:
    """Distance of the convex hulls of two sets of points, (P, 3) and (Q, 3), metres.

    Negative when they overlap: the shortest displacement that takes them apart, with a minus sign.
    """
    difference = convex_hull((first[:, None] - second[None]).reshape(-1, 3))
    deepest = float(np.max(difference.equations[:, 3]))  # of the origin, relative to every face
    if deepest <= 0.0:
        return deepest
    return float(np.min(_distances(difference.points[difference.simplices])))


def _distances(triangles: np.ndarray) -> np.ndarray:
    """Of the origin from triangles (T, 3, 3), which may have no area; (T,)."""
    after = np.roll(triangles, -1, axis=1)
    edges = after - triangles
    square = np.maximum(np.einsum("tki,tki->tk", edges, edges), np.finfo(np.float64).tiny)
    along = np.clip(-np.einsum("tki,tki->tk", triangles, edges) / square, 0.0, 1.0)
    to_edges = np.min(np.linalg.norm(triangles + along[..., None] * edges, axis=-1), axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(normal, axis=-1)
    # the foot of the perpendicular lies in the triangle where it is on the inner side of every edge
    inside = (area > 0.0) & np.all(np.einsum("tki,ti->tk", np.cross(triangles, after), normal) >= 0.0, axis=1)
    above = np.abs(np.einsum("ti,ti->t", triangles[:, 0], normal))
    return np.where(inside, above / np.where(inside, area, 1.0), to_edges)


def way_apart(first: np.ndarray, second: np.ndarray, room: float = LEAST_GAP) -> tuple[int, float]:
    """Shortest way along an axis that takes the convex hull of one set of points away from that of another.

    Args:
        first: (P, 3), metres.
        second: of the body that is moved, (Q, 3), metres.
        room: that is left at the end, metres.

    Returns:
        The axis, 0 to 2, and how far the second is moved along it, metres with its sign.
    """
    faces = convex_hull((first[:, None] - second[None]).reshape(-1, 3)).equations
    ways = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            slope = sign * faces[:, axis]
            ahead = slope > PARALLEL
            ways.append((float(np.min((room - faces[ahead, 3]) / slope[ahead])), axis, sign))
    least, axis, sign = min(ways)
    return axis, sign * least


def convex_bodies(instrument: Instrument, placed: PlacedBodies | None = None) -> Mapping[str, np.ndarray]:
    """Path -> corners of the body in the base frame, (P, 3), metres.

    Args:
        instrument: the instrument.
        placed: where its bodies stand; by default as designed.
    """
    placed = instrument.assembly.place() if placed is None else placed
    out = {s.path: placed.pose(s.path).apply(solid_mesh(s, placed).vertices) for s in instrument.solids}
    for camera, model in instrument.cameras.items():
        for mirror in model.mirrors:
            if model.spec.mirrors[mirror].light == "passes":
                continue
            path = f"{BASE}/{camera}/{mirror}"
            side = behind(model, mirror)
            vertices, _ = mirror_triangles(model.surfaces[mirror], model.apertures[mirror], side, _CELLS)
            out[path] = placed.pose(path).apply(vertices[convex_hull(vertices).vertices])
        path = f"{BASE}/{camera}/focal_plane"
        spots = [p for c in instrument.channels if c.camera == camera for p in (c.pinhole, c.ccd)]
        x, y = (0.5 * size for size in board_size(model, spots))
        corners = np.array([[a, b, z] for a in (-x, x) for b in (-y, y) for z in (0.0, 2.0 * CHIP + BOARD)])
        out[path] = placed.pose(path).apply(corners)
    return out


def find_overlaps(instrument: Instrument) -> tuple[Overlap, ...]:
    """All pairs of bodies that stand in each other or nearer than ``LEAST_GAP``, as designed; deepest first."""
    known = Clearances.of(instrument)
    found = [(*pair, gap) for pair, gap in zip(known.pairs, known.gaps, strict=True) if gap < LEAST_GAP]
    out = []
    for i, j, gap in sorted(found, key=lambda one: one[2]):
        first, second = (known.poses[k].apply(known.corners[k]) for k in (i, j))
        out.append(Overlap(known.paths[i], known.paths[j], -gap, way_apart(first, second)))
    return tuple(out)


def _pairs(instrument: Instrument, bodies: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Those that must not stand in each other; mirrors and board of one camera are its prescription's business."""
    prisms = {solid.path for solid in instrument.solids}
    for first, second in combinations(bodies, 2):
        if prisms & {first, second} or _camera(first) != _camera(second):
            yield first, second


def _between_boxes(first: np.ndarray, second: np.ndarray) -> float:
    """Largest gap along an axis between the boxes around two sets of points, metres; negative where they overlap."""
    low = np.maximum(first.min(axis=0), second.min(axis=0))
    high = np.minimum(first.max(axis=0), second.max(axis=0))
    return float(np.max(low - high))


@dataclass(frozen=True, eq=False)
class Clearances:
    """How far bodies may move before they can touch, for many states one after the other.

    Attributes:
        paths: of the bodies; corners: of each in its own frame, (P, 3), metres; poses: where each stands as designed.
        pairs: numbers of two bodies each, (Q, 2); gaps: (Q,) metres, no more than there is between them as designed.
    """

    paths: tuple[str, ...]
    corners: tuple[np.ndarray, ...]
    poses: tuple[Pose, ...]
    pairs: np.ndarray
    gaps: np.ndarray

    @classmethod
    def of(cls, instrument: Instrument) -> Clearances:
        """Those of an instrument as designed."""
        placed = instrument.assembly.place()
        bodies = convex_bodies(instrument, placed)
        paths = tuple(bodies)
        poses = tuple(placed.pose(path) for path in paths)
        corners = tuple(pose.inverse().apply(bodies[path]) for path, pose in zip(paths, poses, strict=True))
        number = {path: k for k, path in enumerate(paths)}
        named = list(_pairs(instrument, paths))
        gaps = []
        for first, second in named:
            gap = _between_boxes(bodies[first], bodies[second])
            gaps.append(gap if gap > LEAST_GAP else separation(bodies[first], bodies[second]))
        pairs = np.array([(number[a], number[b]) for a, b in named], int).reshape(-1, 2)
        return cls(paths, corners, poses, pairs, np.array(gaps))

    def overlaps(self, placed: PlacedBodies) -> tuple[Overlap, ...]:
        """Pairs of bodies that stand in each other, deepest first.

        Args:
            placed: where the bodies stand, in one state; how they have grown is left out.
        """
        poses = [placed.pose(path) for path in self.paths]
        moved = np.array(
            [
                np.linalg.norm(now.apply(own) - then.apply(own), axis=-1).max()
                for now, then, own in zip(poses, self.poses, self.corners, strict=True)
            ]
        )
        found = []
        for (i, j), gap in zip(self.pairs, self.gaps, strict=True):
            if gap <= 0.0 or moved[i] + moved[j] < gap:
                continue
            left = separation(poses[i].apply(self.corners[i]), poses[j].apply(self.corners[j]))
            if left < 0.0:
                found.append(Overlap(self.paths[i], self.paths[j], -left))
        return tuple(sorted(found, key=lambda overlap: -overlap.depth))


def check_clearance(instrument: Instrument) -> None:
    """Check that no two bodies stand in each other.

    Raises:
        InputError: some do; one issue for each pair, at the key that moves the more movable of the two.
    """
    issues = [_issue(instrument, overlap) for overlap in find_overlaps(instrument)]
    if issues:
        raise InputError(*issues)


def _issue(instrument: Instrument, overlap: Overlap) -> Issue:
    # of equals the later one: first cameras lead
    path = min((overlap.second, overlap.first), key=lambda path: _remedy(path)[0])
    key, allowed = remedy(instrument, path)
    mm = 1e3 * overlap.depth
    how = f"reaches {mm:.3g} mm into" if mm > 0.0 else f"is only {-1e3 * mm:.2g} um from"
    problem = f"{overlap.first} {how} {overlap.second}"
    allowed = f"{allowed} that leaves at least {1e6 * LEAST_GAP:.3g} um of room"
    if overlap.way is not None:
        axis, way = overlap.way
        allowed += f": move it by {_move_text(axis, way if path == overlap.second else -way)} of the base"
    return instrument.spec.issue(problem, key, allowed=allowed)


def _move_text(axis: int, way: float) -> str:
    """A way in words, ``+x 135 mm``, rounded up so that it is far enough."""
    digits = 10.0 ** (np.floor(np.log10(abs(1e3 * way))) - 2)
    return f"{'+' if way > 0.0 else '-'}{'xyz'[axis]} {np.ceil(abs(1e3 * way) / digits) * digits:.3g} mm"


def remedy(instrument: Instrument, path: str) -> tuple[KeyPath, str]:
    """Which key of the file moves a body, and what to choose there."""
    _, key, choice = _remedy(path)
    channel = channel_of(path)
    return key if channel is None else instrument.spec.key_of(*channel, key), choice


def _remedy(path: str) -> tuple[int, KeyPath, str]:
    """How willingly a body is moved (the first first), which key moves it, and what to choose there."""
    kind = prism_of(path)
    if path == CENTRAL_PRISM:
        return 2, (CENTRAL_KEY, "position"), "a position"
    if kind == PRISM_0:
        return 0, ("monitor", PRISM_0, "distance"), "a distance (or width, or shift)"
    if kind == PRISM_180:
        return 1, ("monitor", PRISM_180, "distance"), "a distance (or width, or a monitor field)"
    return 3, ("cameras", _camera(path), "position"), "a position"


_CLOSED = "measures and angle_errors with which its faces enclose a body, each with a part of its own"


def _camera(path: str) -> str:
    """Name of the camera that a body belongs to; "" for the central prism."""
    return "" if path == CENTRAL_PRISM else path.split("/")[1]


def check_solids(assembly: Assembly, solids: Sequence[Solid]) -> None:
    """Check that every solid is closed and that clear apertures lie on their faces.

    Raises:
        MisplacedError: names the body and the face.
    """
    placed = assembly.place()
    for solid in solids:
        try:
            solid_mesh(solid, placed)
        except SolidError as error:
            raise MisplacedError(str(error), key_of(solid.path), _CLOSED, channel_of(solid.path)) from error
        for face in solid.faces:
            for element in assembly.elements.values():
                if face.body in (element.body, element.body.rpartition("/")[0]) and face.body != solid.path:
                    _check_inside(element, face, solid, placed)


def _check_inside(element: Element, face: Face, solid: Solid, placed: PlacedBodies) -> None:
    """Check that an element's clear aperture lies on its face: behind the planes of all others, whatever the length of
    the edges that they have in common.
    """
    assert element.aperture is not None
    rim = element.aperture.outline()
    points = placed.pose(element.body).apply(np.column_stack([rim, np.zeros(len(rim))]))
    _, own = face_plane(face, placed)
    over, across = 0.0, ""
    for other in solid.faces:
        point, normal = face_plane(other, placed)
        slope = float(np.linalg.norm(normal - (normal @ own) * own))
        if other is face or slope < PARALLEL:
            continue
        beyond = float(np.max((points - point) @ normal)) / slope
        if beyond > over:
            over, across = beyond, other.name
    if over > 0.0:
        what = f"the clear aperture of {element.name} reaches {1e3 * over:.3g} mm over the edge of its face"
        camera, side = element.name.split("/")[:2]
        key, choice = _way_to_edge(solid.path, across, over)
        raise MisplacedError(f"{solid.path}: {what}, beyond {across}", key, choice, (camera, side))


def _way_to_edge(path: str, across: str, over: float) -> tuple[KeyPath, str]:
    """What to change when a clear aperture reaches over a face's edge to the face named ``across``, by so many metres,
    and what to choose there.
    """
    if path != CENTRAL_PRISM:
        return key_of(path), "a width, shift and angle_errors with faces that hold their clear apertures"
    if across == "bottom":
        return (CENTRAL_KEY, "height"), f"a height that is at least {1e3 * over:.3g} mm larger"
    smaller = f"an aperture that is at least {2e3 * over:.3g} mm smaller, or a spread that is as much larger"
    return ("monitor", "return_face", "aperture"), smaller
