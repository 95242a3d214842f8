"""Ways that light can take without a search: pairs of clear apertures between which nothing stands.

Most paths go the way of the light for which an instrument is made. Where no other surface reaches into the convex hull
of two clear apertures that face each other, a path that leaves the one and meets the other inside its edge has met
nothing before: the hull holds the whole way. Inside a convex glass body every face is in sight of every other one. So
the kernel first tries the surfaces that follow in nominal light, there and back, and searches the scene where a path
misses them. This decides the time that a path takes, and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Aperture, Rectangle
from optics.geometry.pose import Pose
from scenes.models.scenery import LEAST_CLEARANCE, Scenery, SceneSurface
from twin.path_tracing.path_families import decode

FACING = 0.05
"""Least cosine of a way with the normals of a curved aperture that sees all of another one: three degrees from grazing,
more than the triangles' normals depart from those of the surface."""

PLACES = 4
"""Places from which light leaves a surface: two clear apertures, on either side."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A clear aperture and a box around it.

    Attributes
    ----------
    surface : int
        Its number, -1 of a source; aperture: which of the surface's.
    middle : np.ndarray
        On the surface, world, metres; normal: there, unit, toward +z of the surface.
    corners : np.ndarray
        Of the box, world, (8, 3), metres.
    normals : np.ndarray
        Of the surface's triangles, world, (T, 3).
    solid : str | None
        Glass body, None for none.
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
        """An aperture in the plane z = 0 of a frame; bounds: x_min, x_max, y_min, y_max there."""
        x0, x1, y0, y1 = bounds
        room = LEAST_CLEARANCE
        corners = [[x, y, z] for x in (x0 - room, x1 + room) for y in (y0 - room, y1 + room) for z in (-room, room)]
        middle = pose.apply(np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0]))
        normal = pose.rotation[:, 2]
        return cls(surface, aperture, middle, normal, pose.apply(np.array(corners)), normal[None], solid)

    @property
    def radius(self) -> float:
        """Of the sphere about the middle that holds the box, metres."""
        return float(np.max(np.linalg.norm(self.corners - self.middle, axis=-1)))


@dataclass(frozen=True, eq=False)
class Way:
    """From a clear aperture to the next one of a family.

    Attributes
    ----------
    start : int
        Number of the surface that light leaves, -1 for the source.
    place : int
        From where: 2 * (number of the aperture) + (1 where it leaves toward -z).
    end : Patch
        Where it arrives.
    after : int
        Position in the list of the way that the family takes next, -1 for none, and ``behind``, 1 where that leaves the
        end toward -z.
    """

    start: int
    place: int
    end: Patch
    after: int = -1
    behind: int = 0


class ClearWays:
    """The ways along families of paths, up to their detectors, between whose ends nothing stands.

    Parameters
    ----------
    scenery
        All surfaces.
    families
        Detector -> codes of the events before it.

    Attributes
    ----------
    ways
        Of all families.
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
        self._lines: dict[str, list[tuple[int, Patch]]] = {}
        self.ways: list[Way] = []
        for name, chain in chains.items():
            line = _shortest([patches[part] for part in chain])
            if line:
                self._lines[name] = [(-1, line[0]), *self._follow(line)]

    def _follow(self, line: Sequence[Patch]) -> Iterator[tuple[int, Patch]]:
        """Add the ways of a family; their positions in the list of ways, -1 where there is none, and their ends."""
        last = -1
        for start, end in pairwise(line):
            way = self._between(start, end)
            if way is not None:
                if last >= 0:
                    self.ways[last] = replace(self.ways[last], after=len(self.ways), behind=way.place % 2)
                self.ways.append(way)
            last = -1 if way is None else len(self.ways) - 1
            yield last, end

    def line(self, family: str | None = None) -> list[tuple[int, Patch]]:
        """The apertures that a family meets, up to its detector, each with the position of the way that leads there in
        the list of ways, -1 for none; empty where nothing is known of it.

        Parameters
        ----------
        family : str | None
            Its detector, None for the first one.
        """
        return self._lines.get(family or next(iter(self._lines), ""), [])

    def from_source(self, start: Patch, family: str | None = None) -> Way | None:
        """The way from a source to the first surface of a family, None where there is none.

        Parameters
        ----------
        start : Patch
            The source's disk of places.
        family : str | None
            Its detector, None for the first one.
        """
        line = self.line(family)
        way = self._between(start, line[0][1]) if line else None
        after = line[1][0] if len(line) > 1 else -1
        return way if way is None or after < 0 else replace(way, after=after, behind=self.ways[after].place % 2)

    def _between(self, start: Patch, end: Patch) -> Way | None:
        """The way from one aperture to another, inside their glass body or in the open."""
        if start.solid is not None and start.solid == end.solid:
            return None if start.surface == end.surface else Way(start.surface, 2 * start.aperture + 1, end)
        for behind in (0, 1):
            if behind and (start.solid is not None or start.surface < 0):
                continue
            sides = (1.0,) if end.solid is not None else (1.0, -1.0)
            if _faces(start, end, 1.0 - 2.0 * behind) and any(_faces(end, start, side) for side in sides):
                if self._obstacles.leave_clear(start, end):
                    return Way(start.surface, 2 * start.aperture + behind, end)
        return None


def _shortest(choices: Sequence[Sequence[Patch]]) -> list[Patch]:
    """One aperture of each event, so that the line through their middles is the shortest; empty where an event has
    none. Light takes the shortest way, too.
    """
    if not all(choices):
        return []
    lines: list[tuple[float, list[Patch]]] = [(0.0, [patch]) for patch in choices[0]]
    for patches in choices[1:]:
        lines = [
            min(
                (
                    (length + float(np.linalg.norm(patch.middle - line[-1].middle)), [*line, patch])
                    for length, line in lines
                ),
                key=lambda one: one[0],
            )
            for patch in patches
        ]
    return min(lines, key=lambda one: one[0])[1]


def _faces(one: Patch, other: Patch, side: float) -> bool:
    """Whether the side of one aperture sees all of the other one."""
    apart = (other.corners[None] - one.corners[:, None]).reshape(-1, 3)
    if len(one.normals) == 1:
        return bool(np.min(side * (apart @ one.normals[0])) > 0.0)
    apart /= np.linalg.norm(apart, axis=-1, keepdims=True)
    return bool(np.min(side * (apart @ one.normals.T)) > FACING)


def _patches(number: int, surface: SceneSurface) -> list[Patch]:
    """The apertures of a surface that lie inside its outline."""
    inside = [surface.solid is None or _room(surface, aperture) > LEAST_CLEARANCE for aperture in surface.apertures]
    return [_patch(number, k, surface, a) for k, a in enumerate(surface.apertures) if inside[k]]


def _room(face: SceneSurface, aperture: Aperture) -> float:
    """Least distance of an aperture from the edges of a face, a convex polygon; negative when it reaches beyond."""
    corners = face.vertices[:, :2]
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.stack([along[:, 1], -along[:, 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    outward *= np.sign(np.sum(outward * (corners - corners.mean(axis=0)), axis=-1, keepdims=True))
    x0, x1, y0, y1 = aperture.bounds
    reach = np.abs(outward) * [0.5 * (x1 - x0), 0.5 * (y1 - y0)]
    far = reach.sum(axis=-1) if isinstance(aperture, Rectangle) else np.linalg.norm(reach, axis=-1)
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
    # the triangles reach beyond the aperture, and no farther than the clearance from the surface
    place = (surface.vertices - middle) @ frame.T
    low, high = place.min(axis=0) - surface.clearance, place.max(axis=0) + surface.clearance
    corners = np.array([[a, b, c] for a in (low[0], high[0]) for b in (low[1], high[1]) for c in (low[2], high[2])])
    world = pose.apply(middle + corners @ frame)
    return Patch(
        number, index, pose.apply(middle), pose.rotation @ normal, world, normals @ pose.rotation.T, surface.solid
    )


class _Obstacles:
    """Triangles of all surfaces, in the world."""

    def __init__(self, surfaces: Sequence[SceneSurface]) -> None:
        corners = [s.pose.apply(s.vertices) for s in surfaces]
        self.first = np.concatenate([[0], np.cumsum([len(c) for c in corners])[:-1]])
        self.corners = np.concatenate(corners)
        self.triangles = [c[s.triangles] for c, s in zip(corners, surfaces, strict=True)]
        self.room = [s.clearance for s in surfaces]
        self.solids = [s.solid for s in surfaces]

    def leave_clear(self, start: Patch, end: Patch) -> bool:
        """Whether no other surface reaches into the convex hull of two apertures' boxes. A convex glass body lies
        behind each of its faces, the way before it.
        """
        planes = ConvexHull(np.vstack([start.corners, end.corners])).equations
        away = self.corners @ planes[:, :3].T + planes[:, 3]
        apart = np.any(np.minimum.reduceat(away, self.first, axis=0) > np.asarray(self.room)[:, None], axis=1)
        apart[[n for n in (start.surface, end.surface) if n >= 0]] = True
        own = {start.solid, end.solid} - {None}
        apart |= [solid in own for solid in self.solids]
        return not any(_reaches(self.triangles[i], planes, self.room[i]) for i in np.flatnonzero(~apart))


def _reaches(triangles: np.ndarray, planes: np.ndarray, room: float) -> bool:
    """Whether any triangle comes nearer to the inside of all planes than ``room``."""
    away = triangles @ planes[:, :3].T + planes[:, 3] - room
    for corners, levels in zip(triangles, away, strict=True):
        if np.any(np.min(levels, axis=0) > 0.0):
            continue
        left = corners
        for plane in planes:
            left = _cut(left, left @ plane[:3] + plane[3] - room)
            if not len(left):
                break
        if len(left):
            return True
    return False


def _cut(corners: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """What of a convex polygon lies where its levels are not positive."""
    out = []
    for k, level in enumerate(levels):
        after = (k + 1) % len(levels)
        if level <= 0.0:
            out.append(corners[k])
        if (level > 0.0) != (levels[after] > 0.0):
            out.append(corners[k] + level / (level - levels[after]) * (corners[after] - corners[k]))
    return np.array(out)
