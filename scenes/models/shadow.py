"""Shadows of an instrument's bodies in the pupils of its cameras: of prisms, baffles, and parts of other cameras.

A convex body blocks the rays that pass through it; on the stop these fill the convex outline of its corners, each
mapped to the ray that passes through it, with straight sides (on the stop they are bent by the aberrations of the
pupil, some 1e-4 of its radius). The bodies have the position and size of the state and their nominal shape. A camera's
own mirrors and board cast no shadow into its beam, as its prescription does not describe substrates.

In array shapes B is the number of images (one beam and one pupil each), N that of rays and C that of bodies or corners.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import assert_never

import numpy as np
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.polygon import area, hull, intersect
from optics.geometry.tree import PlacedBodies
from optics.numerics.array_math import solve_pairs
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import transverse_axes
from optics.raytrace.assembly import Assembly, points_to_world
from optics.raytrace.system import SystemBatch
from optics.raytrace.trace import make_rays, trace
from optics.waves.edge_shadow import StopOutlines, SurfaceEdges, converged_shadows, nodes_in_shadows
from optics.waves.imaging import ImagingRays
from optics.waves.pupil_shadow import SMALLEST, separate
from optics.waves.pupil_terms import products, to_terms
from scenes.models.camera_model import CameraModel
from scenes.models.instrument_model import Instrument
from scenes.models.obstruction import blocked_rays, convex_bodies, imaging_segments
from scenes.specs.baffle import Plate
from scenes.specs.instrument import BASE

RING_SIDES = 48
"""Number of flat segments of round plates."""

DEGREE = 6
"""Degree of the polynomials that map the stop to rays: they follow the rays of mirrors to nanometres."""

_ROOM = 5e-3
"""Nominal distance from the light between the mirrors, in metres, within which a body is considered in all states."""

_LAST = 0.999
"""Fraction of the path to the image up to which bodies count: at its end all rays meet."""

_WINDOW, _WINDOW_SIDES = 1.05, 8
"""Radius, in radii of the stop, and number of sides of a polygon around the stop to which outlines are clipped.

Clipping comes before their exact rays are traced, which are needed near the stop only.
"""

_STEPS = 4

_NODES = 5
"""Quadrature nodes along each side of a shadow's box, enough for squares of wavefronts."""


@dataclass(frozen=True, eq=False)
class Caster:
    """Convex body that may cast a shadow into a beam.

    Attributes
    ----------
    name : str
        Path of the prism, mirror or board, or name of the baffle.
    body : str
        Path of the body that carries it.
    corners : (C, 3) ndarray
        Its C corners in that body's frame, in metres.
    """

    name: str
    body: str
    corners: np.ndarray


@dataclass(frozen=True, eq=False)
class Shadows:
    """Shadows in the pupils of B images, on the stop's unit disk, as convex polygons.

    Attributes
    ----------
    pieces : (B, K, V, 2) ndarray
        Corners of K convex polygons of V corners each that do not overlap; K may be 0. They extend slightly beyond the
        disk.
    owners : tuple[str, ...]
        Name of the body that casts each polygon; if several do, the first.
    points : (B, Q) ndarray of complex
        Q quadrature nodes over all polygons within the disk, x + i y in units of the stop's radius.
    weights : (B, Q) ndarray
        Weights of the nodes: areas in units of the stop's radius squared.
    areas : (B, K) ndarray
        Area of each polygon within the disk, in the same unit.
    known : Mapping[str, ndarray] or None
        Name -> blocked fraction of the stop's area, (B,), where the polygons alone do not determine it; None where they
        do.
    """

    pieces: np.ndarray
    owners: tuple[str, ...]
    points: np.ndarray
    weights: np.ndarray
    areas: np.ndarray
    known: Mapping[str, np.ndarray] | None = None

    @classmethod
    def of(cls, outlines: list[tuple[str, np.ndarray]], count: int) -> Shadows:
        """Return the shadows of bodies in the pupils of B images.

        Parameters
        ----------
        outlines : list of tuple[str, ndarray]
            Name of each body and its outline on the stop's unit disk: V corners in each of the B pupils, (B, V, 2).
        count : int
            Number B of pupils.
        """
        casting = [(name, outline) for name, outline in outlines if np.any(area(outline) > SMALLEST)]
        pieces, numbers = separate([outline for _, outline in casting])
        pieces = pieces if casting else np.zeros((count, 0, 3, 2))
        return cls.within(pieces, tuple(casting[k][0] for k in numbers))

    @classmethod
    def within(cls, pieces: np.ndarray, owners: tuple[str, ...]) -> Shadows:
        """Return the shadows that given convex polygons form on the stop's unit disk.

        Parameters
        ----------
        pieces : (B, K, V, 2) ndarray
            V corners of K polygons in each of B pupils; the polygons do not overlap.
        owners : tuple[str, ...]
            Names of the K bodies that cast them.
        """
        return cls(pieces, owners, *nodes_in_shadows(pieces, _NODES))

    def and_edges(self, outlines: Callable[[int], StopOutlines], name: str) -> Shadows:
        """Return these shadows combined with those that the edges of the camera's own surfaces cast.

        Parameters
        ----------
        outlines : callable
            Outlines of the edges, as ``PupilEdges.outlines`` returns them.
        name : str
            Name under which ``shares`` lists the fraction that the edges block in addition to all bodies.

        Raises
        ------
        UnphysicalError
            The edges divide a pupil into too many parts.
        """
        pieces, _ = converged_shadows(outlines, len(self.pieces), tuple(np.moveaxis(self.pieces, 1, 0)))
        whole = Shadows.within(pieces, (name,) * pieces.shape[1])
        bodies = self.shares()
        rest = np.sum(whole.areas, axis=-1) / np.pi - sum(bodies.values())
        # Rounding makes it slightly negative where a body is in the shadow of an edge.
        return replace(whole, known={**bodies, name: np.maximum(rest, 0.0)})

    def shares(self) -> dict[str, np.ndarray]:
        """Return name of each body -> fraction of the stop's area that it blocks in each of B images, (B,)."""
        if self.known is not None:
            return dict(self.known)
        out: dict[str, np.ndarray] = {}
        for k, name in enumerate(self.owners):
            out[name] = out.get(name, np.zeros(len(self.pieces))) + self.areas[:, k] / np.pi
        return out


def casters(instrument: Instrument, camera: str) -> tuple[Caster, ...]:
    """Return all bodies that may cast a shadow into a camera's beam."""
    placed = instrument.assembly.place()
    root = f"{BASE}/{camera}"
    camera_parts = {f"{root}/focal_plane", *(f"{root}/{mirror}" for mirror in instrument.cameras[camera].mirrors)}
    out = [
        Caster(path, path, placed.pose(path).inverse().apply(corners))
        for path, corners in convex_bodies(instrument, placed).items()
        if path not in camera_parts
    ]
    return (*out, *(caster for plate in instrument.baffles for caster in _plate(plate)))


def _plate(plate: Plate) -> list[Caster]:
    """Return a flat plate as one convex polygon, or a ring-shaped plate as several."""
    match plate.outline:
        case Circle() as disk:
            angle = 2.0 * np.pi * np.arange(RING_SIDES + 1) / RING_SIDES
            circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            outer, inner = (np.array(disk.centre) + r * circle for r in (disk.radius, disk.inner))
            parts = [outer[:-1]]
            if disk.inner:
                parts = [np.concatenate([outer[k : k + 2], inner[k : k + 2]]) for k in range(RING_SIDES)]
        case Rectangle() as box:
            x0, x1, y0, y1 = box.bounds
            parts = [np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])]
        case _:
            assert_never(plate.outline)
    flat = [np.column_stack([part, np.zeros(len(part))]) for part in parts]
    return [Caster(plate.name, plate.body, plate.pose.apply(part)) for part in flat]


@dataclass(frozen=True, eq=False)
class TracedBeams:
    """Traced beams of B images.

    Attributes
    ----------
    assembly : Assembly
        Assembly with the camera's elements.
    placed : PlacedBodies
        Bodies in all states.
    owner : (B,) ndarray of int
        Number of the state that each image belongs to.
    systems : SystemBatch
        The B optical systems, one for each image, from the scene to the image.
    rays : ImagingRays
        Rays of the images.
    heading : (3,) or (B, 3) ndarray
        Unit vectors of their light in the world.
    nodes : PupilNodes
        Nodes at which the rays meet the stop.
    """

    assembly: Assembly
    placed: PlacedBodies
    owner: np.ndarray
    systems: SystemBatch
    rays: ImagingRays
    heading: np.ndarray
    nodes: PupilNodes


class ImagingShadows:
    """Bodies that cast shadows into the imaging beams of one camera.

    Parameters
    ----------
    instrument : Instrument
        Instrument with the camera.
    camera : str
        Name of the camera.
    backend : Backend
        Backend that traces the rays.
    """

    def __init__(self, instrument: Instrument, camera: str, backend: Backend) -> None:
        self.camera, self.backend = camera, backend
        self.casters = casters(instrument, camera)
        bodies = [caster.body for caster in self.casters]
        self._on = {body: np.flatnonzero([body == other for other in bodies]) for body in dict.fromkeys(bodies)}
        self._middles = np.array([np.mean(caster.corners, axis=0) for caster in self.casters]).reshape(-1, 3)
        self._sizes = np.array(
            [np.max(np.linalg.norm(c.corners - m, axis=-1)) for c, m in zip(self.casters, self._middles, strict=True)]
        )
        model = instrument.cameras[camera]
        self._first = f"{BASE}/{camera}/{model.mirrors[0]}"
        self._centre = instrument.assembly.tree[self._first].pivots["centre"]
        self._inner = _between_mirrors(self.casters, instrument, backend, camera)

    def cast(self, beams: TracedBeams) -> Shadows:
        """Return the shadows of the bodies in the pupils of B traced images."""
        outlines: list[tuple[str, np.ndarray]] = []
        launched = beams.rays.launched
        bundle = _Bundle.parallel(launched, beams.heading, self._end(beams), beams.nodes)
        centre, size = self._spheres(beams.placed)
        for near in np.flatnonzero(bundle.may_meet(centre[beams.owner], size[beams.owner])):
            caster = self.casters[near]
            outlines.append((caster.name, bundle.outline(_corners(caster, beams))))
        if self._inner:
            for k, (start, end) in enumerate(pairwise(self._hits(beams))):
                bundle = _Bundle.between(start, end, beams.nodes)
                for caster in self._inner.get(k, ()):
                    outlines.append((caster.name, bundle.outline(_corners(caster, beams))))
        return Shadows.of(outlines, len(launched))

    def _spheres(self, placed: PlacedBodies) -> tuple[np.ndarray, np.ndarray]:
        """Return bounding spheres of all C bodies in S states.

        Returns
        -------
        tuple of ndarray
            Centres in the world, (S, C, 3), and radii, (S, C), in metres.
        """
        count = len(placed.scale)
        centre, size = np.empty((count, len(self.casters), 3)), np.empty((count, len(self.casters)))
        for body, which in self._on.items():
            centre[:, which] = points_to_world(placed, body, self._middles[which]).real
            size[:, which] = placed.scale[:, [placed.index[body]]].real * self._sizes[which]
        return centre, size

    def _end(self, beams: TracedBeams) -> np.ndarray:
        """Return the distance along the light from its launch points to the middle of the first mirror, for B beams.

        Returns
        -------
        (B,) ndarray
            Distances in metres.
        """
        middle = points_to_world(beams.placed, self._first, np.array([self._centre])).real[:, 0]
        return np.asarray(np.sum((middle[beams.owner] - beams.rays.launched.mean(axis=1)) * beams.heading, axis=-1))

    def _hits(self, beams: TracedBeams) -> list[np.ndarray]:
        """Return the points at which the N rays of B beams meet each element in turn, in the world.

        Returns
        -------
        list of (B, N, 3) ndarray
            Points on each element, in metres.
        """
        placed, launched = beams.placed, beams.rays.launched
        chain = beams.assembly.sequences[f"{self.camera}/imaging"]
        heading = np.broadcast_to(np.broadcast_to(beams.heading, (len(launched), 3))[:, None], launched.shape)
        traced = trace(self.backend, beams.systems, make_rays(self.backend, launched, heading), keep=range(len(chain)))
        out = []
        for k, name in enumerate(chain):
            body = placed.index[beams.assembly.elements[name].body]
            rotation, shift = placed.rotation[beams.owner, body].real, placed.translation[beams.owner, body].real
            out.append(traced.hit(k) @ np.swapaxes(rotation, 1, 2) + shift[:, None])
        return out


def no_shadows(count: int) -> Shadows:
    """Return the empty shadows of a number of unobstructed pupils."""
    return Shadows.within(np.zeros((count, 0, 3, 2)), ())


class PupilEdges(SurfaceEdges):
    """Edges of a camera's surfaces as they appear in the pupils of B images, in one state of its assembly."""

    @classmethod
    def of(cls, beams: TracedBeams, model: CameraModel, camera: str, backend: Backend) -> PupilEdges:
        """Return the edges of a camera's surfaces in the pupils of traced images.

        Parameters
        ----------
        beams : TracedBeams
            Beams of the images.
        model : CameraModel
            The camera.
        camera : str
            Name of the camera in the assembly, with which its elements' names begin.
        backend : Backend
            Backend that traces the rays.
        """
        numbers = {name: model.mirrors.index(name) for name in model.edges}
        launched = beams.rays.launched
        heading = np.broadcast_to(beams.heading, (len(launched), 3))[:, None]
        sent = make_rays(backend, launched, np.broadcast_to(heading, launched.shape))
        traced = trace(backend, beams.systems, sent, keep=tuple(numbers.values()))
        points = {}
        for name, number in numbers.items():
            body = beams.assembly.elements[f"{camera}/{name}"].body
            size = beams.placed.scale[beams.owner, beams.placed.index[body]].real
            points[name] = np.asarray(traced.hit(number) / size[:, None, None])[..., :2]
        return cls(model.edges, points, beams.nodes)


@lru_cache(maxsize=8)
def imaging_shadows(instrument: Instrument, camera: str, backend: Backend) -> ImagingShadows:
    """Return the ``ImagingShadows`` of a camera, from a cache because finding the bodies takes some 0.1 s."""
    return ImagingShadows(instrument, camera, backend)


def _between_mirrors(
    casters: Sequence[Caster], instrument: Instrument, backend: Backend, camera: str
) -> dict[int, list[Caster]]:
    """Return the bodies near the nominal light between the camera's surfaces.

    Returns
    -------
    dict[int, list[Caster]]
        Number of the light path's segment -> bodies near it; 0 is from the first mirror to the second, the last one
        leads to the image.
    """
    placed = instrument.assembly.place()
    backward = np.concatenate(imaging_segments(instrument, backend, camera))
    inner = backward[:, :-1][:, ::-1]  # without the path from the scene, in the order of the light
    cube = _ROOM * np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    out: dict[int, list[Caster]] = {}
    for caster in casters:
        corners = placed.pose(caster.body).apply(caster.corners)
        planes = ConvexHull((corners[:, None] + cube).reshape(-1, 3)).equations
        for k in range(inner.shape[1]):
            if blocked_rays(inner[:, k : k + 1], planes).any():
                out.setdefault(k, []).append(caster)
    return out


def _corners(caster: Caster, beams: TracedBeams) -> np.ndarray:
    """Return the C corners of a body in the world, for each of B images, (B, C, 3), in metres."""
    return np.asarray(points_to_world(beams.placed, caster.body, caster.corners).real[beams.owner])


@dataclass(frozen=True, eq=False)
class _Bundle:
    """Rays from one surface to the next in B beams, as polynomials in the stop coordinates.

    Attributes
    ----------
    start, end : (B, K, 3) ndarray
        Coefficients of the K polynomials in the stop's x and y (``optics.waves.pupil_terms.products``) whose sums are
        the rays' points at the first and the second surface, in metres.
    middle : (B, 2, 3) ndarray
        Mean points at both surfaces, in metres.
    spread : (B, 2, 3, 2) ndarray
        Mean derivatives of the points with respect to the stop's x and y, metres per stop radius.
    along : (B, 3) ndarray
        Unit vector of the mean direction.
    axes : (B, 2, 3) ndarray
        Two unit vectors perpendicular to it.
    """

    start: np.ndarray
    end: np.ndarray
    middle: np.ndarray
    spread: np.ndarray
    along: np.ndarray
    axes: np.ndarray

    @classmethod
    def between(cls, start: np.ndarray, end: np.ndarray, nodes: PupilNodes) -> _Bundle:
        """Return the rays between the points at which N rays of B beams meet two surfaces.

        Parameters
        ----------
        start, end : (B, N, 3) ndarray
            Points on the first and the second surface, in metres.
        nodes : PupilNodes
            Points at which the N rays meet the stop.
        """
        both = np.stack([start, end], axis=1)
        weight = nodes.share
        middle = np.einsum("n,bknx->bkx", weight, both)
        # Over the disk x and y are orthogonal, and the means of their squares are 1/4.
        spread = 4.0 * np.einsum("n,ni,bknx->bkxi", weight, np.stack([nodes.x, nodes.y], axis=-1), both)
        displacement = middle[:, 1] - middle[:, 0]
        along = displacement / np.linalg.norm(displacement, axis=-1, keepdims=True)
        least = np.eye(3)[np.argmin(np.abs(along), axis=-1)]
        terms = to_terms(nodes, DEGREE) @ both
        return cls(terms[:, 0], terms[:, 1], middle, spread, along, transverse_axes(along, least))

    @classmethod
    def parallel(cls, launched: np.ndarray, heading: np.ndarray, end: np.ndarray, nodes: PupilNodes) -> _Bundle:
        """Return the rays of parallel light between a wavefront and a plane behind it.

        Parameters
        ----------
        launched : (B, N, 3) ndarray
            Points of N rays of B beams on the wavefront, in metres.
        heading : ndarray
            Unit vector of the light, (3,) or (B, 3).
        end : (B,) ndarray
            Distance from wavefront to plane, in metres.
        nodes : PupilNodes
            Points at which the N rays meet the stop.
        """
        heading = np.broadcast_to(heading, (len(launched), 3))
        far = launched - _FAR * heading[:, None]
        return cls.between(far, launched + (end[:, None] * heading)[:, None], nodes)

    def may_meet(self, centre: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Return a mask (C,) of the spheres that may touch a parallel beam in any of B images.

        Parameters
        ----------
        centre : (B, C, 3) ndarray
            Centres of C spheres, in metres.
        size : (B, C) ndarray
            Their radii, in metres.
        """
        off = (centre - self.middle[:, :1]) @ self.axes.swapaxes(1, 2)
        radius = np.linalg.norm(self.axes @ self.spread[:, 0], axis=(1, 2))
        return np.asarray(np.any(np.hypot(off[..., 0], off[..., 1]) < 1.1 * radius[:, None] + size, axis=0))

    def outline(self, corners: np.ndarray) -> np.ndarray:
        """Return the outline of a convex body on the stop's unit disk in each of B images.

        Parameters
        ----------
        corners : (B, C, 3) ndarray
            C corners of the body in the world, in metres.

        Returns
        -------
        (B, V, 2) ndarray
            V corners of the outline, in units of the stop's radius; of zero area where the body is off the beam.
        """
        corners = self._inside(corners)
        packed = np.concatenate([self._guess(corners)[0], corners], axis=-1)
        angle = 2.0 * np.pi * (np.arange(_WINDOW_SIDES) + 0.5) / _WINDOW_SIDES
        normal = np.broadcast_to(np.stack([np.cos(angle), np.sin(angle)], axis=-1), (len(packed), _WINDOW_SIDES, 2))
        clipped = intersect(hull(packed), normal, np.full(normal.shape[:2], _WINDOW))
        empty = area(clipped) < SMALLEST
        if np.all(empty):
            return np.zeros((len(clipped), 3, 2))
        out, points = clipped[..., :2], clipped[..., 2:]
        slope = self._guess(points)[1]
        for _ in range(_STEPS):
            basis = products(out[..., 0], out[..., 1], DEGREE)
            start = basis @ self.start
            displacement = basis @ self.end - start
            arm = points - start
            ahead = np.einsum("bvx,bx->bv", arm, self.along) / np.einsum("bvx,bx->bv", displacement, self.along)
            miss = np.einsum("bix,bvx->bvi", self.axes, arm - ahead[..., None] * displacement)
            out = out + solve_pairs(slope, miss)
        return np.where(empty[:, None, None], out[:, :1], out)

    def _guess(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return approximate stop coordinates of the rays that pass through given points.

        Parameters
        ----------
        points : (B, C, 3) ndarray
            C points in each of B beams, in metres.

        Returns
        -------
        tuple of ndarray
            Stop coordinates, (B, C, 2), in stop radii; and derivatives of the rays' transverse position at the points
            with respect to them, (B, C, 2, 2), in metres.
        """
        first, displacement = self.middle[:, :1], (self.middle[:, 1:] - self.middle[:, :1])
        ahead = self._ahead(points)[..., None]
        off = np.einsum("bix,bcx->bci", self.axes, points - first - ahead * displacement)
        near, far = (np.einsum("bix,bxj->bij", self.axes, self.spread[:, k])[:, None] for k in (0, 1))
        slope = near + ahead[..., None] * (far - near)
        return solve_pairs(slope, off), slope

    def _ahead(self, points: np.ndarray) -> np.ndarray:
        """Return how far along the path from the first to the second surface points lie, as a fraction of it.

        Parameters
        ----------
        points : (B, C, 3) ndarray
            C points in each of B beams, in metres.

        Returns
        -------
        (B, C) ndarray
            0 at the first surface, 1 at the second.
        """
        length = np.einsum("bx,bx->b", self.middle[:, 1] - self.middle[:, 0], self.along)
        return np.asarray(np.einsum("bcx,bx->bc", points - self.middle[:, :1], self.along) / length[:, None])

    def _inside(self, corners: np.ndarray) -> np.ndarray:
        """Return a convex body cut off at both ends of the light path.

        Parameters
        ----------
        corners : (B, C, 3) ndarray
            C corners of the body, in metres.

        Returns
        -------
        (B, D, 3) ndarray
            D points whose convex hull is the remaining part; some may be repeated.
        """
        for low, sign in ((0.0, 1.0), (-_LAST, -1.0)):
            depth = sign * self._ahead(corners) - low
            if np.all(depth >= 0.0):
                continue
            # Add the points where lines between corners cross the end; for lines that do not cross it, repeat a corner.
            i, j = np.triu_indices(corners.shape[1], 1)
            crossing = (depth[:, i] >= 0.0) != (depth[:, j] >= 0.0)
            share = depth[:, i] / np.where(crossing, depth[:, i] - depth[:, j], 1.0)
            crossings = corners[:, i] + np.where(crossing, share, 0.0)[..., None] * (corners[:, j] - corners[:, i])
            deepest = np.argmax(depth, axis=-1)
            inside = np.take_along_axis(corners, deepest[:, None, None], axis=1)
            kept = np.where((depth >= 0.0)[..., None], corners, inside)
            crossings = np.where(crossing[..., None], crossings, inside)
            corners = np.concatenate([kept, crossings], axis=1)
        return corners


_FAR = 100.0
"""Distance before the first mirror within which bodies are considered, in metres."""
