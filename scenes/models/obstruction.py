"""Which prisms stand in the way of light: of the imaging beams, and of monitor beams that are not their own.

A 180-deg prism has to stand before its camera, since its channel uses a part of the pupil; what it takes of the imaging
beam is reported, and how much of that its channel uses. A monitor beam has to get to its area CCD whole: an instrument
in which a body or the edge of a clear aperture takes a part of one is refused.

Whether the bodies of an instrument leave each other room: prisms, mirrors and focal-plane boards, as convex bodies.

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
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import Backend
from optics.numerics.quadrature import even_disk
from optics.raytrace.aim import AimError, RayFan, aim, surviving_rays, transverse_axes
from optics.raytrace.assembly import Assembly, Element, points_to_world
from optics.raytrace.element_numbers import media_along
from optics.raytrace.system import SystemBatch, assemble
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
"""Bodies nearer than this count as touching, metres: what the path tracer needs between two of them."""

PARALLEL = 1e-9
"""Sine of the angle between planes below which they have no common edge."""

_CELLS = 12  # across a mirror: the hull lies within a few tenths of a millimetre of the surface


@dataclass(frozen=True)
class Overlap:
    """Two bodies that stand in each other, or touch.

    Attributes
    ----------
    first, second : str
        Their paths.
    depth : float
        How far one of them has to move for them to touch only; negative for a gap below ``LEAST_GAP``; metres.
    way : tuple[int, float] | None
        Along which axis of the base, 0 to 2, and how far, metres with its sign, the second one is moved to leave
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

    Parameters
    ----------
    first : np.ndarray
        (P, 3), metres.
    second : np.ndarray
        Of the body that is moved, (Q, 3), metres.
    room : float
        That is left at the end, metres.

    Returns
    -------
    tuple[int, float]
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

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    placed : PlacedBodies | None
        Where its bodies stand; by default as designed.
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

    Attributes
    ----------
    paths : tuple[str, ...]
        Of the bodies; corners: of each in its own frame, (P, 3), metres; poses: where each stands as designed.
    pairs : np.ndarray
        Numbers of two bodies each, (Q, 2); gaps: (Q,) metres, no more than there is between them as designed.
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

        Parameters
        ----------
        placed : PlacedBodies
            Where the bodies stand, in one state; how they have grown is left out.
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

    Raises
    ------
    InputError
        Some do; one issue for each pair, at the key that moves the more movable of the two.
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

    Raises
    ------
    MisplacedError
        Names the body and the face.
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
        key, choice = _way_to_edge(solid.path, across, over, 2.0 * element.aperture.inscribed)
        raise MisplacedError(f"{solid.path}: {what}, beyond {across}", key, choice, (camera, side))


def _way_to_edge(path: str, across: str, over: float, wide: float) -> tuple[KeyPath, str]:
    """What to change when a clear aperture of a width reaches over a face's edge to the face named ``across``, by so
    many metres, and what to choose there.
    """
    if path != CENTRAL_PRISM:
        return key_of(path), "a width, shift and angle_errors with faces that hold their clear apertures"
    if across == "bottom":
        return (CENTRAL_KEY, "height"), f"a height that is at least {1e3 * over:.3g} mm larger"
    if 2.0 * over >= wide:
        return (CENTRAL_KEY, "spread"), f"a spread that is at least {2e3 * over:.3g} mm larger"
    smaller = f"an aperture that is at least {2e3 * over:.3g} mm smaller, or a spread that is as much larger"
    return ("monitor", "return_face", "aperture"), smaller


RAYS = 400
"""Rays in a beam, spread evenly over its cross-section: shares are good to about half a percent."""

_TOUCHING = 1e-6  # length inside a body below which a ray only touches it, metres
_TOUCHING_MOVED = 1e-3  # the same in a perturbed state, whose faces are not where flat meshes have them
_AIM = 1e-6  # how well rays meet their places on a stop or face, metres
_RINGS, _AROUND = 6, 24


@dataclass(frozen=True)
class Obstruction:
    """A prism in a beam.

    Attributes
    ----------
    body : str
        Path of the prism.
    beam : str
        e.g. ``forward/imaging`` or ``forward/left``.
    share : float
        Of the beam's cross-section that it takes; for imaging the largest along the line.
    used : float
        Part of ``share`` that its own channel's clear aperture uses; 0 for beams that it has no business in.
    """

    body: str
    beam: str
    share: float
    used: float = 0.0


def find_obstructions(instrument: Instrument, backend: Backend) -> tuple[Obstruction, ...]:
    """All prisms, the central one included, that take a part of a beam; by beam, then by body.

    Faces that a monitor beam means to meet, and the glass between them, are not in its way.
    """
    placed = instrument.assembly.place()
    solids = {}
    for solid in instrument.solids:
        corners = placed.pose(solid.path).apply(solid_mesh(solid, placed).vertices)
        solids[solid.path] = convex_hull(corners).equations
    found: dict[tuple[str, str], Obstruction] = {}
    for camera in instrument.cameras:
        for segments in imaging_segments(instrument, backend, camera):
            for path, planes in solids.items():
                taken = rays_taken(segments, planes)
                if not taken.any():
                    continue
                used = float(np.mean(taken & _used(instrument, path, segments)))
                new = Obstruction(path, f"{camera}/imaging", float(np.mean(taken)), used)
                if (new.beam, path) not in found or found[new.beam, path].share < new.share:
                    found[new.beam, path] = new
    for beam in monitor_beams(instrument, backend, _disk()):
        for path, planes in solids.items():
            taken = rays_taken(beam.outside(path), planes)
            if taken.any():
                found[beam.channel.key, path] = Obstruction(path, beam.channel.key, float(np.mean(taken)))
    return tuple(found[name] for name in sorted(found))


def rays_taken(segments: np.ndarray, planes: np.ndarray, touching: float = _TOUCHING) -> np.ndarray:
    """Which rays, segments (N, K, 2, 3), go through the body ``planes`` . (x, 1) <= 0, (F, 4), for more than
    ``touching`` metres; (N,).
    """
    start, way = segments[:, :, 0], segments[:, :, 1] - segments[:, :, 0]
    height = start @ planes[:, :3].T + planes[:, 3]
    slope = way @ planes[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -height / slope
    enter = np.max(np.where(slope < 0.0, at, 0.0), axis=-1, initial=0.0)
    leave = np.min(np.where(slope > 0.0, at, 1.0), axis=-1, initial=1.0)
    beside = np.any((slope == 0.0) & (height >= 0.0), axis=-1)
    length = (leave - enter) * np.linalg.norm(way, axis=-1)
    return np.asarray(np.any((length > touching) & ~beside, axis=-1))


def _disk(rays: int = RAYS) -> np.ndarray:
    """Points spread evenly over the unit disk, (rays, 2)."""
    nodes = even_disk(rays)
    return np.stack([nodes.x, nodes.y], axis=-1)


def _whole() -> np.ndarray:
    """Points over a unit disk out to its edge, but for what aiming leaves open, (N, 2)."""
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.zeros((1, 2)), *((k + 1) / _RINGS * (1.0 - 1e-3) * ring for k in range(_RINGS))])


_WHOLE = _whole()


def imaging_segments(instrument: Instrument, backend: Backend, camera: str, rays: int = RAYS) -> list[np.ndarray]:
    """Rays from the scene to both ends and the middle of the line, (N, K, 2, 3) each, world.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    backend : Backend
        Where to trace.
    camera : str
        whose.
    rays : int
        N, in each of the three beams.
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
    position, direction = _aimed(
        instrument, backend, camera, f"{camera}/image_to_stop", start, np.tile(radius * _disk(rays), (3, 1))
    )
    systems = assemble(assembly, [chain])
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chain)), world=True)
    assert traced.world is not None
    places = [position[0]]
    for k, name in enumerate(chain):
        places.append(placed.pose(assembly.elements[name].body).apply(traced.hit(k)[0]))
    everything = placed.translation[0] - places[-1].mean(axis=0)
    reach = 2.0 * float(np.max(np.linalg.norm(everything, axis=-1)))
    places.append(places[-1] + reach * traced.numpy(traced.world)[1][0])
    return np.split(_segments(places), 3)


@dataclass(frozen=True, eq=False)
class MonitorBeam:
    """A channel's light from the pinhole to the area CCD.

    Attributes
    ----------
    channel : Channel
        whose.
    segments : np.ndarray
        Of its N rays, (N, K, 2, 3), world.
    inside : tuple[str | None, ...]
        The solid around each segment.
    position, direction : np.ndarray
        Of the rays at the pinhole, (N, 3) each, world.
    valid : np.ndarray
        Which rays get there, (N,).
    """

    channel: Channel
    segments: np.ndarray
    inside: tuple[str | None, ...]
    position: np.ndarray
    direction: np.ndarray
    valid: np.ndarray

    def outside(self, path: str) -> np.ndarray:
        """Segments that are not inside a solid, (N, K', 2, 3)."""
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
        Where to trace.
    points : np.ndarray
        Of the return faces that the rays meet, (N, 2), the faces' radius being 1.
    state : State | None
        Of the instrument; as designed unless one is given.

    Raises
    ------
    AimError
        No such rays.
    """
    states = [state or {}]
    assembly, channels, placed = instrument.assembly, instrument.channels, instrument.assembly.place(states)
    radius = [assembly.elements[f"{c.key}/return_face"].aperture.inscribed for c in channels]  # type: ignore[union-attr]
    start = np.array([placed.pose(c.reticle_body).translation for c in channels])[:, None]
    guess = np.array([instrument.toward_optics(placed, c.camera)[0] for c in channels])[:, None]
    systems = assemble(assembly, [f"{c.key}/outgoing" for c in channels], states, placed=placed)
    target = np.array(radius)[:, None, None] * points
    position, direction = _through(backend, systems, start, guess, target)
    chains = [assembly.sequences[f"{c.key}/monitor"] for c in channels]
    systems = assemble(assembly, chains, states, placed=placed)
    traced = trace(backend, systems, make_rays(backend, position, direction), keep=range(len(chains[0])))
    hits, valid = [traced.hit(k) for k in range(len(chains[0]))], traced.numpy()[3]
    out = []
    for i, (channel, chain) in enumerate(zip(channels, chains, strict=True)):
        places = [position[i]]
        for hit, name in zip(hits, chain, strict=True):
            places.append(placed.pose(assembly.elements[name].body).apply(hit[i]))
        media = media_along(assembly.sequence(f"{channel.key}/monitor"))
        inside = tuple(medium.solid for medium in media[:-1])
        out.append(MonitorBeam(channel, _segments(places), inside, position[i], direction[i], valid[i]))
    return out


def check_beams(instrument: Instrument, backend: Backend) -> None:
    """Check that every monitor beam gets to its area CCD whole.

    Raises
    ------
    InputError
        The edge of a clear aperture or a body takes a part of one; one issue for each.
    MisplacedError
        Light of a channel does not get to its return face.
    """
    try:
        beams = monitor_beams(instrument, backend, _WHOLE)
    except AimError as error:
        problem = f"light of the monitor does not get to its return faces: {error}"
        choice = "a field, prisms and a pupil_offset with which the mirrors of both cameras carry the whole beam"
        raise MisplacedError(problem, ("monitor",), choice) from error
    issues = [_cut(instrument, backend, beam) for beam in beams if not beam.valid.all()]
    for beam, what, plate, taken in _standing_in(instrument, beams, instrument.assembly.place(), _TOUCHING):
        text = f"{what} stands in the beam {beam.channel.key} and takes {_count(taken)}"
        if plate is None:
            where, choice = _way_out(instrument, beam.channel, what)
        else:
            where = ("baffles", plate.name) if plate.name in instrument.spec.baffles else ("baffles",)
            choice = "a size and place beside the beam"
        issues.append(instrument.spec.issue(text, where, allowed=choice))
    if issues:
        raise InputError(*dict.fromkeys(issues))


def moved_into_beams(instrument: Instrument, backend: Backend, state: State) -> tuple[str, ...]:
    """What stands in beams of the monitor in a perturbed state, sentences without their end. Edges of clear apertures
    cut the spots' light by themselves; bodies do not.
    """
    if not instrument.channels or not state:
        return ()
    try:
        beams = monitor_beams(instrument, backend, _WHOLE, state)
    except AimError:
        return ()  # the spots themselves are lost, which is said with its cause
    together: dict[tuple[str, str], np.ndarray] = {}
    for beam, what, _, taken in _standing_in(instrument, beams, instrument.assembly.place([state]), _TOUCHING_MOVED):
        # a baffle has several plates
        together[beam.channel.key, what] = taken | together.get((beam.channel.key, what), False)
    return tuple(
        f"{key}: {what} has moved into the beam and would take {_count(taken)}; the spot is that of the whole beam"
        for (key, what), taken in together.items()
    )


def _standing_in(
    instrument: Instrument, beams: list[MonitorBeam], placed: PlacedBodies, touching: float
) -> Iterator[tuple[MonitorBeam, str, Plate | None, np.ndarray]]:
    """Beam, body or plate in words, the plate if it is one, and which of the beam's rays it takes, (N,)."""
    bodies = convex_bodies(instrument, placed)
    hulls = {path: convex_hull(corners).equations for path, corners in bodies.items()}
    for beam in beams:
        camera = instrument.cameras[beam.channel.camera]
        within = len(camera.mirrors)  # segments inside the camera, on the way out and on the way back
        for path, planes in hulls.items():
            segments = beam.outside(path)
            if path.rpartition("/")[0] == f"{BASE}/{beam.channel.camera}":
                # the prescription gives its own parts no substrates there, and its first mirror's hull holds its light
                first = int(path.endswith(f"/{camera.mirrors[0]}"))
                segments = beam.segments[:, within + first : -within - first]
            low, high = segments.min(axis=(0, 2)), segments.max(axis=(0, 2))
            near = np.all((low <= bodies[path].max(axis=0)) & (high >= bodies[path].min(axis=0)), axis=-1)
            if not near.any():
                continue
            taken = rays_taken(segments[:, near], planes, touching)
            if taken.any():
                yield beam, path, None, taken
        for plate in instrument.baffles:
            taken = _crossing(beam.segments, plate, placed)
            if taken.any():
                yield beam, f"a plate of {plate.name}", plate, taken


def _way_out(instrument: Instrument, channel: Channel, path: str) -> tuple[KeyPath, str]:
    """Which key takes a body out of a channel's beam, and what to choose there: that of a prism, else the beam's."""
    if path in {solid.path for solid in instrument.solids}:
        where, choice = remedy(instrument, path)
        return where, f"{choice} beside the beam"
    where = instrument.spec.key_of(channel.camera, channel.name, ("monitor", PRISM_0, "shift"))
    return where, "a shift (or prism distance, or place on the central prism) that leads the beam past it"


def _count(taken: np.ndarray) -> str:
    return f"{np.sum(taken)} of its {len(taken)} rays"


def _crossing(segments: np.ndarray, plate: Plate, placed: PlacedBodies) -> np.ndarray:
    """Which rays, segments (N, K, 2, 3), go through a plate, (N,)."""
    into = (placed.pose(plate.body) @ plate.pose).inverse()
    start, end = into.apply(segments[:, :, 0]), into.apply(segments[:, :, 1])
    through = start[..., 2] * end[..., 2] < 0.0
    share = np.where(through, start[..., 2] / np.where(through, start[..., 2] - end[..., 2], 1.0), 0.0)
    at = start + share[..., None] * (end - start)
    return np.asarray(np.any(through & plate.outline.contains(at[..., 0], at[..., 1]), axis=-1))


def _cut(instrument: Instrument, backend: Backend, beam: MonitorBeam) -> Issue:
    """At which element a beam loses its first rays, and by how much."""
    assembly, channel = instrument.assembly, beam.channel
    names = assembly.sequences[f"{channel.key}/monitor"]
    steps = enumerate(surviving_rays(backend, assembly, names, beam.position, beam.direction), 1)
    count, element, alive = next((n, element, alive) for n, (element, alive) in steps if not alive.all())
    off = beside(assembly, backend, names[:count], beam.position, beam.direction, ~alive)
    how = "" if off is None else f": it reaches {1e3 * off:.3g} mm beyond the clear aperture"
    key = key_of(element.body)
    if element.body == channel.face_body:
        key = ("monitor", "return_face", "aperture")
    elif key[0] != "cameras":
        key = (*key, "width")
    key = instrument.spec.key_of(channel.camera, channel.name, key)
    return instrument.spec.issue(
        f"the beam {channel.key} is cut at {element.name} on {element.body}{how}",
        key,
        allowed="a place in the pupil, prism widths and a return face with which the whole beam passes twice",
    )


def _segments(places: list[np.ndarray]) -> np.ndarray:
    """Segments (N, K, 2, 3) between consecutive places of N rays."""
    way = np.stack(places, axis=1)
    return np.stack([way[:, :-1], way[:, 1:]], axis=2)


def _aimed(
    instrument: Instrument, backend: Backend, camera: str, sequence: str, start: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from points (1, N, 3) of a focal plane through targets (N, 2) of a sequence's last element."""
    guess = instrument.toward_optics(instrument.assembly.place(), camera)[0]
    return _through(backend, assemble(instrument.assembly, [sequence]), start, guess, target[None])


def _through(
    backend: Backend, systems: SystemBatch, start: np.ndarray, guess: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from points (B, N or 1, 3), first sent along ``guess``, through targets (B, N, 2) of the last element."""
    start, guess = (np.broadcast_to(a, (*target.shape[:2], 3)) for a in (start, guess))
    fan = RayFan(start, guess, transverse_axes(guess, np.broadcast_to([0.0, 1.0, 0.0], guess.shape)))
    q, _ = aim(backend, systems, fan, target, tolerance=_AIM)
    return fan.at(q)


def _used(instrument: Instrument, path: str, segments: np.ndarray) -> np.ndarray:
    """Which imaging rays (N, K, 2, 3) pass the clear aperture through which a channel's beam enters a prism, (N,)."""
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
