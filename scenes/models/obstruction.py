"""Clearances of an instrument: bodies that block light, and bodies that overlap.

Obstruction. A 180-deg prism stands in front of its camera, since its channel uses a part of the pupil; the fraction of
the imaging beam that it blocks is reported, with the part of it that its channel uses. A monitor beam has to reach its
area CCD whole: an instrument in which a body or the edge of a clear aperture vignettes one is refused.

Overlap. Prisms, mirrors and focal-plane boards are convex bodies. Two of them overlap where their Minkowski difference
contains the origin; its depth is the distance by which one of them has to move. Parts of one camera are not compared
with each other, because the prescription does not describe substrates.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from optics.geometry.pose import Pose
from optics.geometry.solid import Face, Solid, SolidError, face_plane, solid_mesh
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import Backend
from optics.numerics.quadrature import circle, even_disk
from optics.raytrace.aim import AimError, aimed_rays, surviving_rays
from optics.raytrace.assembly import Assembly, Element, points_to_world
from optics.raytrace.element_numbers import media_along
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument, MisplacedError, key_of
from scenes.models.meshes import BOARD, CHIP, behind, board_size, mirror_triangles
from scenes.models.monitor_chain import beside
from scenes.specs.baffle import Plate
from scenes.specs.instrument import BASE, CENTRAL_KEY, CENTRAL_PRISM, PRISM_0, PRISM_180, Channel, channel_of, prism_of
from scenes.yaml.errors import InputError, Issue, KeyPath

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

LEAST_GAP = 20e-6
"""Gap between bodies below which they count as touching, in metres: the path tracer needs it between two surfaces."""

PARALLEL = 1e-9
"""Sine of the angle between planes below which they have no common edge."""

_CELLS = 12  # cells across a mirror: the hull is within a few tenths of a millimetre of the surface


@dataclass(frozen=True)
class Overlap:
    """Two bodies that overlap or touch.

    Attributes
    ----------
    first, second : str
        Paths of the bodies.
    depth : float
        Distance by which one of them has to move so that they just touch, in metres; negative for a gap below
        ``LEAST_GAP``.
    move : tuple[int, float] or None
        Axis of the base (0 to 2) and signed distance in metres by which the second body has to move to leave
        ``LEAST_GAP``, the shortest of the three axes; None if it was not computed.
    """

    first: str
    second: str
    depth: float
    move: tuple[int, float] | None = None


def convex_hull(points: np.ndarray) -> ConvexHull:
    """Return the convex hull of N points, (N, 3). SciPy is imported here, since reading a file needs no hull."""
    from scipy.spatial import ConvexHull

    return ConvexHull(points)


def separation(first: np.ndarray, second: np.ndarray) -> float:
    """Return the distance between the convex hulls of two sets of points, in metres.

    It is negative for hulls that overlap: minus the length of the shortest displacement that separates them.

    Parameters
    ----------
    first, second : (P, 3) and (Q, 3) ndarray
        P and Q points of the two bodies, in metres.
    """
    difference = convex_hull((first[:, None] - second[None]).reshape(-1, 3))
    deepest = float(np.max(difference.equations[:, 3]))  # of the origin, relative to every face
    if deepest <= 0.0:
        return deepest
    return float(np.min(_distances(difference.points[difference.simplices])))


def _distances(triangles: np.ndarray) -> np.ndarray:
    """Return the distance of the origin from each of T triangles.

    Parameters
    ----------
    triangles : (T, 3, 3) ndarray
        Three corners of each triangle; they may lie on a line.

    Returns
    -------
    (T,) ndarray
        Distances in the unit of the corners.
    """
    after = np.roll(triangles, -1, axis=1)
    edges = after - triangles
    square = np.maximum(np.einsum("tki,tki->tk", edges, edges), np.finfo(np.float64).tiny)
    along = np.clip(-np.einsum("tki,tki->tk", triangles, edges) / square, 0.0, 1.0)
    to_edges = np.min(np.linalg.norm(triangles + along[..., None] * edges, axis=-1), axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(normal, axis=-1)
    # The foot of the perpendicular lies in the triangle if it is on the inner side of every edge.
    inside = (area > 0.0) & np.all(np.einsum("tki,ti->tk", np.cross(triangles, after), normal) >= 0.0, axis=1)
    above = np.abs(np.einsum("ti,ti->t", triangles[:, 0], normal))
    return np.where(inside, above / np.where(inside, area, 1.0), to_edges)


def separating_move(first: np.ndarray, second: np.ndarray, room: float = LEAST_GAP) -> tuple[int, float]:
    """Return the shortest move along an axis that separates the convex hull of one set of points from that of another.

    Parameters
    ----------
    first : (P, 3) ndarray
        Points of the body that stays, in metres.
    second : (Q, 3) ndarray
        Points of the body that is moved, in metres.
    room : float
        Gap that remains after the move, in metres.

    Returns
    -------
    tuple[int, float]
        Axis (0 to 2) and signed distance along it, in metres.
    """
    faces = convex_hull((first[:, None] - second[None]).reshape(-1, 3)).equations
    moves = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            slope = sign * faces[:, axis]
            ahead = slope > PARALLEL
            moves.append((float(np.min((room - faces[ahead, 3]) / slope[ahead])), axis, sign))
    least, axis, sign = min(moves)
    return axis, sign * least


def convex_bodies(instrument: Instrument, placed: PlacedBodies | None = None) -> Mapping[str, np.ndarray]:
    """Return path of each body -> its P corners in the base frame, (P, 3), in metres.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    placed : PlacedBodies or None
        Positions of its bodies; by default the nominal ones.
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
    """Return all pairs of bodies that overlap or are nearer than ``LEAST_GAP`` in the nominal state, deepest first."""
    known = Clearances.of(instrument)
    close_pairs = [(*pair, gap) for pair, gap in zip(known.pairs, known.gaps, strict=True) if gap < LEAST_GAP]
    out = []
    for i, j, gap in sorted(close_pairs, key=lambda overlap: overlap[2]):
        first, second = (known.poses[k].apply(known.corners[k]) for k in (i, j))
        out.append(Overlap(known.paths[i], known.paths[j], -gap, separating_move(first, second)))
    return tuple(out)


def _pairs(instrument: Instrument, bodies: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield pairs of bodies that must not overlap; mirrors and board of the same camera are not compared."""
    prisms = {solid.path for solid in instrument.solids}
    for first, second in combinations(bodies, 2):
        if prisms & {first, second} or _camera(first) != _camera(second):
            yield first, second


def _between_boxes(first: np.ndarray, second: np.ndarray) -> float:
    """Return the largest gap along an axis between the bounding boxes of two sets of points, in metres.

    It is negative for boxes that overlap.
    """
    low = np.maximum(first.min(axis=0), second.min(axis=0))
    high = np.minimum(first.max(axis=0), second.max(axis=0))
    return float(np.max(low - high))


@dataclass(frozen=True, eq=False)
class Clearances:
    """Clearances of bodies in the nominal state, from which overlaps in many other states are found quickly.

    Attributes
    ----------
    paths : tuple[str, ...]
        Paths of the bodies.
    corners : tuple[ndarray, ...]
        Corners of each body in its own frame, (corners, 3), in metres.
    poses : tuple[Pose, ...]
        Nominal pose of each body.
    pairs : (Q, 2) ndarray of int
        Numbers of the two bodies of each of Q pairs.
    gaps : (Q,) ndarray
        Lower limit of the nominal gap of each pair, in metres.
    """

    paths: tuple[str, ...]
    corners: tuple[np.ndarray, ...]
    poses: tuple[Pose, ...]
    pairs: np.ndarray
    gaps: np.ndarray

    @classmethod
    def of(cls, instrument: Instrument) -> Clearances:
        """Return the gaps between all pairs of bodies of an instrument in its nominal state."""
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
        """Return the pairs of bodies that overlap, deepest first.

        Parameters
        ----------
        placed : PlacedBodies
            Positions of the bodies in one state; their thermal expansion is ignored.
        """
        poses = [placed.pose(path) for path in self.paths]
        moved = np.array(
            [
                np.linalg.norm(now.apply(corners) - then.apply(corners), axis=-1).max()
                for now, then, corners in zip(poses, self.poses, self.corners, strict=True)
            ]
        )
        overlaps = []
        for (i, j), gap in zip(self.pairs, self.gaps, strict=True):
            if gap <= 0.0 or moved[i] + moved[j] < gap:
                continue
            gap_now = separation(poses[i].apply(self.corners[i]), poses[j].apply(self.corners[j]))
            if gap_now < 0.0:
                overlaps.append(Overlap(self.paths[i], self.paths[j], -gap_now))
        return tuple(sorted(overlaps, key=lambda overlap: -overlap.depth))


def check_clearance(instrument: Instrument) -> None:
    """Check that no two bodies overlap.

    Raises
    ------
    InputError
        Bodies overlap; one issue for each pair, at the key that moves the more movable of the two.
    """
    issues = [_issue(instrument, overlap) for overlap in find_overlaps(instrument)]
    if issues:
        raise InputError(*issues)


def _issue(instrument: Instrument, overlap: Overlap) -> Issue:
    """Return the issue of an overlap, with the key and the distance that resolve it."""
    # Of two equally movable bodies the later one is moved, so that the first camera stays.
    path = min((overlap.second, overlap.first), key=lambda path: _remedy(path)[0])
    key, allowed = remedy(instrument, path)
    mm = 1e3 * overlap.depth
    how = f"extends {mm:.3g} mm into" if mm > 0.0 else f"is only {-1e3 * mm:.2g} um from"
    problem = f"{overlap.first} {how} {overlap.second}"
    allowed = f"{allowed} that leaves a gap of at least {1e6 * LEAST_GAP:.3g} um"
    if overlap.move is not None:
        axis, distance = overlap.move
        allowed += f": move it by {_move_text(axis, distance if path == overlap.second else -distance)} of the base"
    return instrument.spec.issue(problem, key, allowed=allowed)


def _move_text(axis: int, distance: float) -> str:
    """Return a move along an axis of the base as text, ``+x 135 mm``, rounded up so that it is far enough."""
    digits = 10.0 ** (np.floor(np.log10(abs(1e3 * distance))) - 2)
    return f"{'+' if distance > 0.0 else '-'}{'xyz'[axis]} {np.ceil(abs(1e3 * distance) / digits) * digits:.3g} mm"


def remedy(instrument: Instrument, path: str) -> tuple[KeyPath, str]:
    """Return the key of the instrument's file that moves a body, and advice on the value to choose there."""
    _, key, choice = _remedy(path)
    channel = channel_of(path)
    return key if channel is None else instrument.spec.key_of(*channel, key), choice


def _remedy(path: str) -> tuple[int, KeyPath, str]:
    """Return how easily a body can be moved (lowest first), the key that moves it, and advice on its value."""
    kind = prism_of(path)
    if path == CENTRAL_PRISM:
        return 2, (CENTRAL_KEY, "position"), "a position"
    if kind == PRISM_0:
        return 0, ("monitor", PRISM_0, "distance"), "a distance (or width, or shift)"
    if kind == PRISM_180:
        return 1, ("monitor", PRISM_180, "distance"), "a distance (or width, or a monitor field)"
    return 3, ("cameras", _camera(path), "position"), "a position"


_CLOSED = "dimensions and angle_errors with which its faces, each with some area, enclose a body"


def _camera(path: str) -> str:
    """Return the name of the camera that a body belongs to; "" for the central prism."""
    return "" if path == CENTRAL_PRISM else path.split("/")[1]


def check_solids(assembly: Assembly, solids: Sequence[Solid]) -> None:
    """Check that every solid is closed and that clear apertures lie on their faces.

    Raises
    ------
    MisplacedError
        A solid is open, or an aperture extends over the edge of its face; the message names both.
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
    """Check that an element's clear aperture lies on its face.

    It has to be behind the planes of all other faces, however short the edges are that they have in common.
    """
    assert element.aperture is not None
    rim = element.aperture.outline()
    points = placed.pose(element.body).apply(np.column_stack([rim, np.zeros(len(rim))]))
    _, face_normal = face_plane(face, placed)
    over, across = 0.0, ""
    for other in solid.faces:
        point, normal = face_plane(other, placed)
        slope = float(np.linalg.norm(normal - (normal @ face_normal) * face_normal))
        if other is face or slope < PARALLEL:
            continue
        beyond = float(np.max((points - point) @ normal)) / slope
        if beyond > over:
            over, across = beyond, other.name
    if over > 0.0:
        what = f"the clear aperture of {element.name} extends {1e3 * over:.3g} mm over the edge of its face"
        camera, side = element.name.split("/")[:2]
        key, choice = _edge_remedy(solid.path, across, over, 2.0 * element.aperture.inscribed)
        raise MisplacedError(f"{solid.path}: {what}, beyond {across}", key, choice, (camera, side))


def _edge_remedy(path: str, across: str, over: float, wide: float) -> tuple[KeyPath, str]:
    """Return the key to change when an aperture extends over the edge of its face, and advice on its value.

    Parameters
    ----------
    path : str
        Path of the body with the face.
    across : str
        Name of the neighbouring face.
    over : float
        Distance by which the aperture extends over the edge, in metres.
    wide : float
        Width of the aperture, in metres.
    """
    if path != CENTRAL_PRISM:
        return key_of(path), "a width, shift and angle_errors with faces that contain their clear apertures"
    if across == "bottom":
        return (CENTRAL_KEY, "height"), f"a height that is at least {1e3 * over:.3g} mm larger"
    if 2.0 * over >= wide:
        return (CENTRAL_KEY, "spread"), f"a spread that is at least {2e3 * over:.3g} mm larger"
    smaller = f"an aperture that is at least {2e3 * over:.3g} mm smaller, or a spread that is as much larger"
    return ("monitor", "return_face", "aperture"), smaller


RAYS = 400
"""Number of rays in a beam, spread evenly over its cross-section: fractions are accurate to about half a percent."""

_TOUCHING = 1e-6  # length inside a body below which a ray only touches it, metres
_TOUCHING_MOVED = 1e-3  # the same in a perturbed state, whose faces depart from the flat meshes
_AIM = 1e-6  # tolerance of aiming at points of a stop or face, metres
_RINGS, _AROUND = 6, 24


@dataclass(frozen=True)
class Obstruction:
    """Prism that blocks part of a beam.

    Attributes
    ----------
    body : str
        Path of the prism.
    beam : str
        Name of the beam, such as ``forward/imaging`` or ``forward/left``.
    share : float
        Blocked fraction of the beam's cross-section; for imaging the largest along the line.
    used : float
        Part of ``share``, as a fraction of the same cross-section, that the clear aperture of the prism's own channel
        uses; 0 for beams of other channels.
    """

    body: str
    beam: str
    share: float
    used: float = 0.0


def find_obstructions(instrument: Instrument, backend: Backend) -> tuple[Obstruction, ...]:
    """Return all prisms, the central one included, that block part of a beam; sorted by beam, then by body.

    Faces that belong to a monitor beam's sequence, and the glass between them, do not count as blocking it.
    """
    placed = instrument.assembly.place()
    solids = {}
    for solid in instrument.solids:
        corners = placed.pose(solid.path).apply(solid_mesh(solid, placed).vertices)
        solids[solid.path] = convex_hull(corners).equations
    obstructions: dict[tuple[str, str], Obstruction] = {}
    for camera in instrument.cameras:
        for segments in imaging_segments(instrument, backend, camera):
            for path, planes in solids.items():
                blocked = blocked_rays(segments, planes)
                if not blocked.any():
                    continue
                used = float(np.mean(blocked & _used(instrument, path, segments)))
                item = Obstruction(path, f"{camera}/imaging", float(np.mean(blocked)), used)
                if (item.beam, path) not in obstructions or obstructions[item.beam, path].share < item.share:
                    obstructions[item.beam, path] = item
    for beam in monitor_beams(instrument, backend, _disk()):
        for path, planes in solids.items():
            blocked = blocked_rays(beam.outside(path), planes)
            if blocked.any():
                obstructions[beam.channel.key, path] = Obstruction(path, beam.channel.key, float(np.mean(blocked)))
    return tuple(obstructions[name] for name in sorted(obstructions))


def blocked_rays(segments: np.ndarray, planes: np.ndarray, touching: float = _TOUCHING) -> np.ndarray:
    """Return a mask (N,) of the rays that a convex body blocks.

    Parameters
    ----------
    segments : (N, K, 2, 3) ndarray
        Start and end points of the K segments of N rays, in metres.
    planes : (F, 4) ndarray
        Planes of the body's F faces, (unit normal, offset): a point x is in the body where normal . x + offset <= 0 for
        all of them.
    touching : float
        Length inside the body, in metres, below which a ray only touches it.
    """
    start, displacement = segments[:, :, 0], segments[:, :, 1] - segments[:, :, 0]
    height = start @ planes[:, :3].T + planes[:, 3]
    slope = displacement @ planes[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -height / slope
    enter = np.max(np.where(slope < 0.0, at, 0.0), axis=-1, initial=0.0)
    leave = np.min(np.where(slope > 0.0, at, 1.0), axis=-1, initial=1.0)
    beside = np.any((slope == 0.0) & (height >= 0.0), axis=-1)
    length = (leave - enter) * np.linalg.norm(displacement, axis=-1)
    return np.asarray(np.any((length > touching) & ~beside, axis=-1))


def _disk(rays: int = RAYS) -> np.ndarray:
    """Return points spread evenly over the unit disk, (rays, 2)."""
    nodes = even_disk(rays)
    return np.stack([nodes.x, nodes.y], axis=-1)


def _full_disk() -> np.ndarray:
    """Return N points on rings over the unit disk, (N, 2), with a margin of 0.1 % inside its edge for ray aiming."""
    ring = (1.0 - 1e-3) * circle(_AROUND)
    return np.concatenate([np.zeros((1, 2)), *((k + 1) / _RINGS * ring for k in range(_RINGS))])


_WHOLE = _full_disk()


def imaging_segments(instrument: Instrument, backend: Backend, camera: str, rays: int = RAYS) -> list[np.ndarray]:
    """Trace rays from the scene to both ends and the middle of a camera's line.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    backend : Backend
        Backend that traces the rays.
    camera : str
        Name of the camera.
    rays : int
        Number N of rays in each of the three beams.

    Returns
    -------
    list of (N, K, 2, 3) ndarray
        For each beam, start and end points of the K segments of N rays, in the world, in metres.
    """
    assembly, model, placed = instrument.assembly, instrument.cameras[camera], instrument.assembly.place()
    half = 0.5 * model.spec.line.pixels * model.spec.line.pitch
    line = np.array([[0.0, y, 0.0] for y in (half, 0.0, -half)])
    points = points_to_world(placed, line_body(f"{BASE}/{camera}"), line)[0]
    stop = assembly.elements[f"{camera}/{model.spec.stop}"].aperture
    assert stop is not None
    radius = stop.inscribed
    start = np.repeat(points, rays, axis=0)[None]
    chain = assembly.sequences[f"{camera}/image_to_object"]
    target, guess = np.tile(radius * _disk(rays), (1, 3, 1)), instrument.toward_optics(placed, camera)[0]
    to_stop = assemble(assembly, [f"{camera}/image_to_stop"])
    position, direction = aimed_rays(backend, to_stop, start, guess, target, _AIM)
    systems = assemble(assembly, [chain])
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chain)), world=True)
    assert traced.world is not None
    points_along = [position[0]]
    for k, name in enumerate(chain):
        points_along.append(placed.pose(assembly.elements[name].body).apply(traced.hit(k)[0]))
    everything = placed.translation[0] - points_along[-1].mean(axis=0)
    length = 2.0 * float(np.max(np.linalg.norm(everything, axis=-1)))
    points_along.append(points_along[-1] + length * traced.numpy(traced.world)[1][0])
    return np.split(_segments(points_along), 3)


@dataclass(frozen=True, eq=False)
class MonitorBeam:
    """Light of a channel from the pinhole to the area CCD.

    Attributes
    ----------
    channel : Channel
        The channel.
    segments : (N, K, 2, 3) ndarray
        Start and end points of the K segments of N rays, in the world, in metres.
    inside : tuple[str or None, ...]
        Path of the solid in which each segment lies, None outside.
    position, direction : (N, 3) ndarray
        Points, in metres, and unit vectors of the rays at the pinhole, in the world.
    valid : (N,) ndarray of bool
        Rays that reach the area CCD.
    """

    channel: Channel
    segments: np.ndarray
    inside: tuple[str | None, ...]
    position: np.ndarray
    direction: np.ndarray
    valid: np.ndarray

    def outside(self, path: str) -> np.ndarray:
        """Return the segments of all rays that are not inside a solid: start and end points, (N, segments, 2, 3)."""
        return self.segments[:, [medium != path for medium in self.inside]]


def monitor_beams(
    instrument: Instrument, backend: Backend, points: np.ndarray, state: State | None = None
) -> list[MonitorBeam]:
    """Trace the beams of all channels.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    backend : Backend
        Backend that traces the rays.
    points : (N, 2) ndarray
        Points of the return faces that the rays meet, in units of the faces' radius.
    state : State or None
        State of the instrument; nominal by default.

    Raises
    ------
    AimError
        There are no such rays.
    """
    states = [state or {}]
    assembly, channels, placed = instrument.assembly, instrument.channels, instrument.assembly.place(states)
    radius = [assembly.elements[f"{c.key}/return_face"].aperture.inscribed for c in channels]  # type: ignore[union-attr]
    start = np.array([placed.pose(c.reticle_body).translation for c in channels])[:, None]
    guess = np.array([instrument.toward_optics(placed, c.camera)[0] for c in channels])[:, None]
    systems = assemble(assembly, [f"{c.key}/outgoing" for c in channels], states, placed=placed)
    target = np.array(radius)[:, None, None] * points
    position, direction = aimed_rays(backend, systems, start, guess, target, _AIM)
    chains = [assembly.sequences[f"{c.key}/monitor"] for c in channels]
    systems = assemble(assembly, chains, states, placed=placed)
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chains[0])))
    hits, valid = [traced.hit(k) for k in range(len(chains[0]))], traced.numpy()[3]
    out = []
    for i, (channel, chain) in enumerate(zip(channels, chains, strict=True)):
        points_of_beam = [position[i]]
        for hit, name in zip(hits, chain, strict=True):
            points_of_beam.append(placed.pose(assembly.elements[name].body).apply(hit[i]))
        media = media_along(assembly.sequence(f"{channel.key}/monitor"))
        inside = tuple(medium.solid for medium in media[:-1])
        out.append(MonitorBeam(channel, _segments(points_of_beam), inside, position[i], direction[i], valid[i]))
    return out


def check_beams(instrument: Instrument, backend: Backend) -> None:
    """Check that every monitor beam reaches its area CCD whole.

    Raises
    ------
    InputError
        The edge of a clear aperture or a body vignettes a beam; one issue for each.
    MisplacedError
        Light of a channel does not reach its return face.
    """
    try:
        beams = monitor_beams(instrument, backend, _WHOLE)
    except AimError as error:
        problem = f"light of the monitor does not reach its return faces: {error}"
        choice = "a field, prisms and a pupil_offset with which the whole beam passes the mirrors of both cameras"
        raise MisplacedError(problem, ("monitor",), choice) from error
    issues = [_vignetting_issue(instrument, backend, beam) for beam in beams if not beam.valid.all()]
    for beam, name, plate, blocked in _blocking_bodies(instrument, beams, instrument.assembly.place(), _TOUCHING):
        text = f"{name} blocks {_count(blocked)} of the beam {beam.channel.key}"
        if plate is None:
            where, choice = _beam_remedy(instrument, beam.channel, name)
        else:
            where = ("baffles", plate.name) if plate.name in instrument.spec.baffles else ("baffles",)
            choice = "a size and position beside the beam"
        issues.append(instrument.spec.issue(text, where, allowed=choice))
    if issues:
        raise InputError(*dict.fromkeys(issues))


def moved_into_beams(instrument: Instrument, backend: Backend, state: State) -> tuple[str, ...]:
    """Return warnings, without a full stop, about bodies that block monitor beams in a perturbed state.

    Edges of clear apertures vignette the simulated spots; bodies do not.
    """
    if not instrument.channels or not state:
        return ()
    try:
        beams = monitor_beams(instrument, backend, _WHOLE, state)
    except AimError:
        return ()  # The spots themselves are lost; that is reported elsewhere with its cause.
    blocked_by: dict[tuple[str, str], np.ndarray] = {}
    for beam, name, _, blocked in _blocking_bodies(
        instrument, beams, instrument.assembly.place([state]), _TOUCHING_MOVED
    ):
        # A baffle has several plates.
        blocked_by[beam.channel.key, name] = blocked | blocked_by.get((beam.channel.key, name), False)
    return tuple(
        f"{key}: {name} has moved into the beam and would block {_count(blocked)}; the spot is that of the whole beam"
        for (key, name), blocked in blocked_by.items()
    )


def _blocking_bodies(
    instrument: Instrument, beams: list[MonitorBeam], placed: PlacedBodies, touching: float
) -> Iterator[tuple[MonitorBeam, str, Plate | None, np.ndarray]]:
    """Yield each body that blocks rays of a monitor beam.

    Yields
    ------
    tuple
        Beam, name of the body or plate, the plate if it is one else None, and a mask, (N,), of the N rays blocked.
    """
    bodies = convex_bodies(instrument, placed)
    hulls = {path: convex_hull(corners).equations for path, corners in bodies.items()}
    for beam in beams:
        camera = instrument.cameras[beam.channel.camera]
        inside_camera = len(camera.mirrors)  # segments inside the camera, at each end of the beam
        for path, planes in hulls.items():
            segments = beam.outside(path)
            if path.rpartition("/")[0] == f"{BASE}/{beam.channel.camera}":
                # Substrates of the camera's own parts are unknown; the hull of its first mirror contains its light.
                first = int(path.endswith(f"/{camera.mirrors[0]}"))
                segments = beam.segments[:, inside_camera + first : -inside_camera - first]
            low, high = segments.min(axis=(0, 2)), segments.max(axis=(0, 2))
            near = np.all((low <= bodies[path].max(axis=0)) & (high >= bodies[path].min(axis=0)), axis=-1)
            if not near.any():
                continue
            blocked = blocked_rays(segments[:, near], planes, touching)
            if blocked.any():
                yield beam, path, None, blocked
        for plate in instrument.baffles:
            blocked = _crossing(beam.segments, plate, placed)
            if blocked.any():
                yield beam, f"a plate of {plate.name}", plate, blocked


def _beam_remedy(instrument: Instrument, channel: Channel, path: str) -> tuple[KeyPath, str]:
    """Return the key that takes a body out of a channel's beam, and advice on the value to choose there.

    It is a key of the body if that is a prism, else one of the beam.
    """
    if path in {solid.path for solid in instrument.solids}:
        where, choice = remedy(instrument, path)
        return where, f"{choice} beside the beam"
    where = instrument.spec.key_of(channel.camera, channel.name, ("monitor", PRISM_0, "shift"))
    return where, "a shift (or prism distance, or position on the central prism) that takes the beam past it"


def _count(taken: np.ndarray) -> str:
    """Return the number of blocked rays as text, such as "12 of 400 rays"."""
    return f"{np.sum(taken)} of {len(taken)} rays"


def _crossing(segments: np.ndarray, plate: Plate, placed: PlacedBodies) -> np.ndarray:
    """Return a mask (N,) of the rays that cross a plate.

    Parameters
    ----------
    segments : (N, K, 2, 3) ndarray
        Start and end points of the K segments of N rays, in metres.
    plate : Plate
        The plate.
    placed : PlacedBodies
        Poses of the bodies.
    """
    into = (placed.pose(plate.body) @ plate.pose).inverse()
    start, end = into.apply(segments[:, :, 0]), into.apply(segments[:, :, 1])
    crosses = start[..., 2] * end[..., 2] < 0.0
    fraction = np.where(crosses, start[..., 2] / np.where(crosses, start[..., 2] - end[..., 2], 1.0), 0.0)
    point = start + fraction[..., None] * (end - start)
    return np.asarray(np.any(crosses & plate.outline.contains(point[..., 0], point[..., 1]), axis=-1))


def _vignetting_issue(instrument: Instrument, backend: Backend, beam: MonitorBeam) -> Issue:
    """Return the issue of a vignetted beam: the element at which it loses its first rays, and by how much."""
    assembly, channel = instrument.assembly, beam.channel
    names = assembly.sequences[f"{channel.key}/monitor"]
    steps = enumerate(surviving_rays(backend, assembly, names, beam.position, beam.direction), 1)
    count, element, alive = next((n, element, alive) for n, (element, alive) in steps if not alive.all())
    off = beside(assembly, backend, names[:count], beam.position, beam.direction, ~alive)
    how = "" if off is None else f": it extends {1e3 * off:.3g} mm beyond the clear aperture"
    key = key_of(element.body)
    if element.body == channel.face_body:
        key = ("monitor", "return_face", "aperture")
    elif key[0] != "cameras":
        key = (*key, "width")
    key = instrument.spec.key_of(channel.camera, channel.name, key)
    return instrument.spec.issue(
        f"the beam {channel.key} is vignetted at {element.name} on {element.body}{how}",
        key,
        allowed="a position in the pupil, prism widths and a return face with which the whole beam passes twice",
    )


def _segments(points: list[np.ndarray]) -> np.ndarray:
    """Return start and end points, (N, K, 2, 3), of the K segments between consecutive points of N rays."""
    path = np.stack(points, axis=1)
    return np.stack([path[:, :-1], path[:, 1:]], axis=2)


def _used(instrument: Instrument, path: str, segments: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the imaging rays that pass through the entrance aperture of a prism of a monitor channel.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    path : str
        Path of the prism.
    segments : (N, K, 2, 3) ndarray
        Start and end points of the K segments of N rays, in metres.
    """
    assembly, placed = instrument.assembly, instrument.assembly.place()
    for channel in instrument.channels:
        prism = channel.prism_body(PRISM_180)
        if path == prism or path.startswith(f"{prism}/"):
            mirrors = len(instrument.cameras[channel.camera].mirrors)
            element = assembly.elements[assembly.sequences[f"{channel.key}/outgoing"][mirrors]]
            assert element.aperture is not None
            into = placed.pose(element.body).inverse()
            start, end = into.apply(segments[:, -1, 0]), into.apply(segments[:, -1, 1])
            at = start - (start[:, 2:] / (end - start)[:, 2:]) * (end - start)
            return np.asarray(element.aperture.contains(at[:, 0], at[:, 1]))
    return np.zeros(len(segments), dtype=bool)
