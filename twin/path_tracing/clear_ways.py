"""Clear path segments: pairs of clear apertures with nothing between them, which need no search for the next surface.

Most paths follow the light for which an instrument is designed. Where no other surface extends into the convex hull of
two clear apertures that face each other, a path that leaves the one and meets the other inside its edge has met nothing
before, since the hull contains the whole segment. Inside a convex glass body every face is visible from every other
face. The kernel therefore first tries the surfaces that follow in nominal light, in both directions, and searches the
scene only where a path misses them. This affects computing time alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter

import numpy as np
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Aperture, Rectangle
from optics.geometry.pose import Pose
from scenes.models.scenery import LEAST_CLEARANCE, Scenery, SceneSurface
from twin.path_tracing.path_families import decode

FACING = 0.05
"""Smallest cosine between a segment and the normals of a curved aperture for which it counts as wholly visible.

It is three degrees from grazing, more than the triangles' normals differ from those of the surface.
"""

EXITS = 4
"""Number of ways in which light can leave a surface: through either of two clear apertures, toward +z or toward -z."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Clear aperture with a box around it.

    Attributes
    ----------
    surface : int
        Index of the surface, -1 for a source.
    aperture : int
        Index of the clear aperture of the surface.
    middle : (3,) ndarray
        Middle of the aperture on the surface, world frame, metres.
    normal : (3,) ndarray
        Unit normal there, toward +z of the surface.
    corners : (8, 3) ndarray
        Corners of the box, world frame, metres.
    normals : (T, 3) ndarray
        Unit normals of the T triangles of the surface, world frame.
    solid : str or None
        Glass body of the surface; None if it belongs to no glass body.
    """

    surface: int
    aperture: int
    middle: np.ndarray
    normal: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    solid: str | None

    @classmethod
    def flat(
        cls,
        surface: int,
        aperture: int,
        pose: Pose,
        bounds: tuple[float, float, float, float],
        solid: str | None = None,
    ) -> Patch:
        """Make a patch in the plane z = 0 of a frame; ``bounds`` are x_min, x_max, y_min, y_max there, metres."""
        x0, x1, y0, y1 = bounds
        margin = LEAST_CLEARANCE
        corners = [
            [x, y, z] for x in (x0 - margin, x1 + margin) for y in (y0 - margin, y1 + margin) for z in (-margin, margin)
        ]
        middle = pose.apply(np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0]))
        normal = pose.rotation[:, 2]
        return cls(surface, aperture, middle, normal, pose.apply(np.array(corners)), normal[None], solid)

    @property
    def radius(self) -> float:
        """Radius of the sphere about the middle that contains the box, in metres."""
        return float(np.max(np.linalg.norm(self.corners - self.middle, axis=-1)))


@dataclass(frozen=True, eq=False)
class Segment:
    """Clear path segment, with no surface in between, from an aperture to the next one that nominal light meets.

    Attributes
    ----------
    start : int
        Index of the surface that light leaves, -1 for the source.
    exit_side : int
        How light leaves that surface: 2 * (index of the aperture) + (1 where it leaves toward -z).
    end : Patch
        Aperture at the end.
    after : int
        Index, in the list of segments, of the next one along the same family of paths; -1 if there is none.
    behind : int
        1 where the next segment leaves the end toward -z.
    """

    start: int
    exit_side: int
    end: Patch
    after: int = -1
    behind: int = 0


class ClearSegments:
    """Clear segments (path segments with no surface in between) of the nominal light paths to the detectors.

    A family of paths is all paths that meet the same surfaces in the same order; there is one nominal family per
    detector.

    Parameters
    ----------
    scenery : Scenery
        All surfaces.
    families : Mapping[str, Sequence[int]]
        Detector -> events (surface and what happens there) of its nominal family, as the numbers of
        ``path_families.code``.

    Attributes
    ----------
    segments : list of Segment
        Segments of all families.
    """

    def __init__(self, scenery: Scenery, families: Mapping[str, Sequence[int]]) -> None:
        parts, surfaces = scenery.parts, scenery.surfaces
        sites = {s.detector: parts.index(s.part) for s in surfaces if s.detector is not None}
        chains = {name: [*(decode(code)[0] for code in codes), sites[name]] for name, codes in families.items()}
        met = {part for chain in chains.values() for part in chain}
        patches: dict[int, list[Patch]] = {part: [] for part in met}
        for number, surface in enumerate(surfaces):
            part = parts.index(surface.part)
            if part in met:
                patches[part] += _patches(number, surface)
        self._obstacles = _Obstacles(surfaces)
        self._apertures: dict[str, list[tuple[int, Patch]]] = {}
        self.segments: list[Segment] = []
        for name, chain in chains.items():
            line = _shortest([patches[part] for part in chain])
            if line:
                self._apertures[name] = [(-1, line[0]), *self._follow(line)]

    def _follow(self, line: Sequence[Patch]) -> Iterator[tuple[int, Patch]]:
        """Add the clear segments between successive apertures of a light path to the list of segments.

        Yields the index of each segment (-1 where it is not clear) and the aperture at its end.
        """
        last = -1
        for start, end in pairwise(line):
            segment = self._between(start, end)
            if segment is not None:
                if last >= 0:
                    self.segments[last] = replace(
                        self.segments[last], after=len(self.segments), behind=segment.exit_side % 2
                    )
                self.segments.append(segment)
            last = -1 if segment is None else len(self.segments) - 1
            yield last, end

    def apertures(self, family: str | None = None) -> list[tuple[int, Patch]]:
        """Return the apertures that the nominal light of a detector meets, each with the index of the segment to it.

        The index is -1 where that segment is not clear. The list is empty for an unknown detector.

        Parameters
        ----------
        family : str or None
            Name of the detector, None for the first one.
        """
        return self._apertures.get(family or next(iter(self._apertures), ""), [])

    def from_source(self, start: Patch, family: str | None = None) -> Segment | None:
        """Return the straight path from a source to the first surface that the nominal light of a detector meets.

        The result is None if another surface may block this path.

        Parameters
        ----------
        start : Patch
            Emitting disk of the source.
        family : str or None
            Name of the detector, None for the first one.
        """
        line = self.apertures(family)
        segment = self._between(start, line[0][1]) if line else None
        after = line[1][0] if len(line) > 1 else -1
        if segment is None or after < 0:
            return segment
        return replace(segment, after=after, behind=self.segments[after].exit_side % 2)

    def _between(self, start: Patch, end: Patch) -> Segment | None:
        """Return the segment from one aperture to another, or None if another surface may lie between.

        Both lie in the same glass body, or outside all glass.
        """
        if start.solid is not None and start.solid == end.solid:
            return None if start.surface == end.surface else Segment(start.surface, 2 * start.aperture + 1, end)
        for behind in (0, 1):
            if behind and (start.solid is not None or start.surface < 0):
                continue
            sides = (1.0,) if end.solid is not None else (1.0, -1.0)
            if _faces(start, end, 1.0 - 2.0 * behind) and any(_faces(end, start, side) for side in sides):
                if self._obstacles.leave_clear(start, end):
                    return Segment(start.surface, 2 * start.aperture + behind, end)
        return None


def _shortest(choices: Sequence[Sequence[Patch]]) -> list[Patch]:
    """Choose one clear aperture for each event of a path so that the line through the apertures' middles is shortest.

    By Fermat's principle it is then the nominal path. The result is empty where an event has no aperture.
    """
    if not all(choices):
        return []
    lines: list[tuple[float, list[Patch]]] = [(0.0, [patch]) for patch in choices[0]]
    for patches in choices[1:]:
        longer = (
            [(length + float(np.linalg.norm(end.middle - line[-1].middle)), [*line, end]) for length, line in lines]
            for end in patches
        )
        lines = [min(candidates, key=itemgetter(0)) for candidates in longer]
    return min(lines, key=itemgetter(0))[1]


def _faces(patch: Patch, other: Patch, side: float) -> bool:
    """Return True if all of one aperture is visible from the given side of the other."""
    apart = (other.corners[None] - patch.corners[:, None]).reshape(-1, 3)
    if len(patch.normals) == 1:
        return bool(np.min(side * (apart @ patch.normals[0])) > 0.0)
    apart /= np.linalg.norm(apart, axis=-1, keepdims=True)
    return bool(np.min(side * (apart @ patch.normals.T)) > FACING)


def _patches(number: int, surface: SceneSurface) -> list[Patch]:
    """Return the apertures of a surface that lie inside its outline."""
    inside = [
        surface.solid is None or _edge_distance(surface, aperture) > LEAST_CLEARANCE for aperture in surface.apertures
    ]
    return [_patch(number, k, surface, a) for k, a in enumerate(surface.apertures) if inside[k]]


def _edge_distance(face: SceneSurface, aperture: Aperture) -> float:
    """Return the smallest distance of an aperture from the edges of a convex face; negative where it extends beyond."""
    corners = face.vertices[:, :2]
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.stack([along[:, 1], -along[:, 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    outward *= np.sign(np.sum(outward * (corners - corners.mean(axis=0)), axis=-1, keepdims=True))
    x0, x1, y0, y1 = aperture.bounds
    half_extent = np.abs(outward) * [0.5 * (x1 - x0), 0.5 * (y1 - y0)]
    far = half_extent.sum(axis=-1) if isinstance(aperture, Rectangle) else np.linalg.norm(half_extent, axis=-1)
    return float(np.min(np.sum(outward * (corners - [0.5 * (x0 + x1), 0.5 * (y0 + y1)]), axis=-1) - far))


def _patch(number: int, index: int, surface: SceneSurface, aperture: Aperture) -> Patch:
    pose = surface.pose
    if surface.surface.is_plane and surface.surface.figure is None:
        return Patch.flat(number, index, pose, aperture.bounds, surface.solid)
    x0, x1, y0, y1 = aperture.bounds
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    middle = np.array([x, y, surface.surface.sag(np.array([x]), np.array([y]))[0]])
    corner = surface.vertices[surface.triangles]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normals *= np.sign(normals[:, 2:]) / np.linalg.norm(normals, axis=-1, keepdims=True)
    normal = normals.mean(axis=0)
    normal /= np.linalg.norm(normal)
    frame = np.vstack([np.linalg.svd(normal[None])[2][1:], normal])
    # the triangles extend beyond the aperture, but depart from the surface by no more than the clearance
    place = (surface.vertices - middle) @ frame.T
    low, high = place.min(axis=0) - surface.clearance, place.max(axis=0) + surface.clearance
    corners = np.array([[a, b, c] for a in (low[0], high[0]) for b in (low[1], high[1]) for c in (low[2], high[2])])
    world = pose.apply(middle + corners @ frame)
    return Patch(
        number, index, pose.apply(middle), pose.rotation @ normal, world, normals @ pose.rotation.T, surface.solid
    )


class _Obstacles:
    """Triangles of all surfaces, in the world frame, which may obstruct a path segment."""

    def __init__(self, surfaces: Sequence[SceneSurface]) -> None:
        corners = [s.pose.apply(s.vertices) for s in surfaces]
        self.first = np.concatenate([[0], np.cumsum([len(c) for c in corners])[:-1]])
        self.corners = np.concatenate(corners)
        self.triangles = [c[s.triangles] for c, s in zip(corners, surfaces, strict=True)]
        self.margin = [s.clearance for s in surfaces]
        self.solids = [s.solid for s in surfaces]

    def leave_clear(self, start: Patch, end: Patch) -> bool:
        """Return True if no other surface extends into the convex hull of the boxes about two apertures.

        Faces of the glass bodies of the two apertures do not count: a convex body lies behind each of its faces, and so
        does the segment if it is inside.
        """
        planes = ConvexHull(np.vstack([start.corners, end.corners])).equations
        away = self.corners @ planes[:, :3].T + planes[:, 3]
        apart = np.any(np.minimum.reduceat(away, self.first, axis=0) > np.asarray(self.margin)[:, None], axis=1)
        apart[[n for n in (start.surface, end.surface) if n >= 0]] = True
        bodies = {start.solid, end.solid} - {None}
        apart |= [solid in bodies for solid in self.solids]
        return not any(_reaches(self.triangles[i], planes, self.margin[i]) for i in np.flatnonzero(~apart))


def _reaches(triangles: np.ndarray, planes: np.ndarray, margin: float) -> bool:
    """Return True if any triangle comes closer than ``margin`` metres to the convex region inside all planes."""
    away = triangles @ planes[:, :3].T + planes[:, 3] - margin
    for corners, levels in zip(triangles, away, strict=True):
        if np.any(np.min(levels, axis=0) > 0.0):
            continue
        left = corners
        for plane in planes:
            left = _clip(left, left @ plane[:3] + plane[3] - margin)
            if not len(left):
                break
        if len(left):
            return True
    return False


def _clip(corners: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return the part of a convex polygon where a linear function is zero or negative.

    ``levels`` are the values of the function at the polygon's corners.
    """
    out = []
    for k, level in enumerate(levels):
        after = (k + 1) % len(levels)
        if level <= 0.0:
            out.append(corners[k])
        if (level > 0.0) != (levels[after] > 0.0):
            out.append(corners[k] + level / (level - levels[after]) * (corners[after] - corners[k]))
    return np.array(out)
