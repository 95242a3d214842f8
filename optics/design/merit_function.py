"""What a prescription is judged by: wavefront or spots over the field, and constraints; with exact derivatives.

Obstruction is looked at in the plane of symmetry, onto which all rays are projected: every stretch of every beam keeps
to that side of every other surface on which it passes in the prescription that the design starts from.

Rays through a prescription for its merit, with exact derivatives by everything that may vary.

Every field's beam is a circle of the entrance pupil's diameter about the ray that meets the vertex of the stop. Where
that chief ray starts follows from the implicit function theorem, all else from forward-mode AD through the trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optics.design.design_variables import BIAS, Prescription, Variable
from optics.geometry.tree import COMPLEX_STEP
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import RayFan, aim
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, jvp, make_rays, trace

LAUNCH_DISTANCE = 9.0
"""How far before the prescription's origin beams start, metres: well before every mirror."""


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams that a prescription is evaluated by.

    Attributes
    ----------
    fields : np.ndarray
        Angles x, y about the field bias, radians, (F, 2).
    diameter : float
        Of the entrance pupil, metres.
    nodes : PupilNodes
        Quadrature over the pupil.
    rim : int
        Number of rays around the edge of each beam.
    """

    fields: np.ndarray
    diameter: float
    nodes: PupilNodes
    rim: int = 24

    @property
    def pupil(self) -> np.ndarray:
        """Pupil coordinates of a beam's rays, (N, 2): the chief ray, the nodes, the rim."""
        angle = 2.0 * np.pi * np.arange(self.rim) / self.rim
        nodes = np.stack([self.nodes.x, self.nodes.y], axis=-1)
        return np.concatenate([np.zeros((1, 2)), nodes, np.stack([np.cos(angle), np.sin(angle)], axis=-1)])


@dataclass(frozen=True, eq=False)
class DesignRays:
    """Traced beams, F fields of N rays each, and derivatives by V variables (a first axis of that size).

    Attributes
    ----------
    position, direction : np.ndarray
        On the image in its own frame, (F, N, 3).
    path : np.ndarray
        Optical path from the incoming wavefront through the prescription's origin, (F, N), metres.
    points : np.ndarray
        Launch points, hits on each surface and the image, prescription frame, (K + 1, F, N, 3).
    d_position, d_direction, d_path, d_points : np.ndarray | None
        Derivatives, (V, ...) each; None if not asked for.
    d_bias : np.ndarray | None
        Of the field bias, (V,).
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    points: np.ndarray
    d_position: np.ndarray | None = None
    d_direction: np.ndarray | None = None
    d_path: np.ndarray | None = None
    d_points: np.ndarray | None = None
    d_bias: np.ndarray | None = None


def beam_axes(fields: np.ndarray, bias: complex) -> tuple[np.ndarray, np.ndarray]:
    """Direction (F, 3) in which light of the fields travels, and two axes of its wavefront (F, 2, 3), the first near x.

    ``bias`` may be complex, for a complex step.
    """
    x, y = fields[:, 0], fields[:, 1] + bias
    along = np.stack([np.tan(x) + 0.0 * y, np.tan(y), np.ones_like(y)], axis=-1)
    along = along / np.sqrt(np.sum(along * along, axis=-1, keepdims=True))
    first = np.array([1.0, 0.0, 0.0]) - along * along[:, :1]
    first = first / np.sqrt(np.sum(first * first, axis=-1, keepdims=True))
    second = np.stack([along[:, i - 2] * first[:, i - 1] - along[:, i - 1] * first[:, i - 2] for i in range(3)], -1)
    return along, np.stack([first, second], axis=1)


def trace_beams(
    backend: Backend, prescription: Prescription, beams: Beams, variables: Sequence[Variable] | None = None
) -> DesignRays:
    """Trace all beams, and differentiate them if variables are given.

    Raises
    ------
    AimError
        a chief ray does not reach the stop.
    BeamMissedError
        a beam is lost.
    """
    assembly = prescription.assembly
    along, axes = beam_axes(beams.fields, prescription.field_bias)
    count = len(along)
    to_stop = assemble(assembly, ["to_stop"]).take(np.zeros(count, dtype=int))
    fan = RayFan(-LAUNCH_DISTANCE * along[:, None], along[:, None], axes[:, None], moves_position=True)
    chief = fan.at(aim(backend, to_stop, fan, np.zeros((1, 2)))[0])[0][:, 0]
    reach = 0.5 * beams.diameter * beams.pupil
    launch = chief[:, None] + np.einsum("nk,fkx->fnx", reach, axes)
    heading = np.broadcast_to(along[:, None], launch.shape)
    phase = np.einsum("fnx,fx->fn", launch, along)

    imaging = assemble(assembly, ["imaging"])
    shape = launch.shape
    keep = range(len(prescription.names))
    traced = trace(backend, imaging, make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3)), keep=keep)
    position, direction, path, valid = (a[0] for a in traced.numpy())
    if not valid.all():
        raise BeamMissedError("a part of a beam misses a surface of the prescription")
    hits = np.stack([traced.hit(i)[0] for i in keep])
    points = np.einsum("kij,knj->kni", imaging.world.rotation[0], hits) + imaging.world.translation[0][:, None]
    points = np.concatenate([launch[None], points.reshape(len(hits), *shape)])
    rays = DesignRays(position.reshape(shape), direction.reshape(shape), path.reshape(shape[:2]) + phase, points)
    return rays if variables is None else _differentiated(backend, prescription, beams, variables, rays, chief)


def _differentiated(
    backend: Backend,
    prescription: Prescription,
    beams: Beams,
    variables: Sequence[Variable],
    rays: DesignRays,
    chief: np.ndarray,
) -> DesignRays:
    """The rays with their derivatives."""
    along, axes = beam_axes(beams.fields, prescription.field_bias)
    turned = beam_axes(beams.fields, prescription.field_bias + 1j * COMPLEX_STEP)
    biased = np.array([v.quantity == BIAS for v in variables], dtype=float)
    along_step, axes_step = (np.multiply.outer(biased, a.imag / COMPLEX_STEP) for a in turned)  # (V, F, ...)
    count, fields = len(variables), len(along)

    # the chief ray's start is c = -L d + a e1 + b e2 with a, b such that it meets the vertex of the stop
    place = np.einsum("fx,fkx->fk", chief, axes)
    fixed = -LAUNCH_DISTANCE * along_step + np.einsum("fk,vfkx->vfx", place, axes_step)
    single = assemble(prescription.assembly, ["to_stop"])
    twice = np.repeat(chief, 2, axis=0)[None], np.repeat(along, 2, axis=0)[None]
    slopes = jvp(backend, single, *twice, axes.reshape(1, -1, 3)).position[0, :, :2]
    slopes = np.swapaxes(slopes.reshape(fields, 2, 2), -1, -2)
    to_stop = prescription.tangents(variables, "to_stop")
    every = np.broadcast_to(chief, (count, fields, 3)), np.broadcast_to(along, (count, fields, 3))
    drift = jvp(backend, to_stop, *every, fixed, along_step).position[..., :2]
    moved = -np.linalg.solve(np.broadcast_to(slopes, (count, fields, 2, 2)), drift[..., None])[..., 0]
    chief_step = fixed + np.einsum("vfk,fkx->vfx", moved, axes)

    reach = 0.5 * beams.diameter * beams.pupil
    launch = rays.points[0]
    launch_step = chief_step[:, :, None] + np.einsum("nk,vfkx->vfnx", reach, axes_step)
    shape = launch_step.shape
    heading = np.broadcast_to(along[:, None], launch.shape)
    heading_step = np.broadcast_to(along_step[:, :, None], shape)
    systems = prescription.tangents(variables, "imaging")
    keep = range(len(prescription.names))
    flat = (count, -1, 3)
    pushed = jvp(
        backend,
        systems,
        np.broadcast_to(launch, shape).reshape(flat),
        np.broadcast_to(heading, shape).reshape(flat),
        launch_step.reshape(flat),
        heading_step.reshape(flat),
        keep=keep,
    )
    assert systems.world_tangents is not None
    rotation, rotation_step = (np.swapaxes(p.rotation, 0, 1) for p in (systems.world, systems.world_tangents))
    origin_step = np.swapaxes(systems.world_tangents.translation, 0, 1)
    hits = np.stack([pushed.traced.hit(k) for k in keep])
    hit_steps = np.stack([pushed.hits[k] for k in keep])
    points = np.einsum("kvij,kvnj->kvni", rotation, hit_steps) + np.einsum("kvij,kvnj->kvni", rotation_step, hits)
    points = np.swapaxes((points + origin_step[:, :, None]).reshape(len(hits), *shape), 0, 1)
    phase = np.einsum("vfnx,fx->vfn", launch_step, along) + np.einsum("fnx,vfx->vfn", launch, along_step)
    return replace(
        rays,
        d_position=pushed.position.reshape(shape),
        d_direction=pushed.direction.reshape(shape),
        d_path=pushed.path.reshape(shape[:3]) + phase,
        d_points=np.concatenate([launch_step[:, None], points], axis=1),
        d_bias=biased,
    )


@dataclass(frozen=True)
class Operands:
    """Operands of the merit function and its constraints.

    Attributes
    ----------
    wavelength : float
        metres.
    principal_distance : float | None
        Along the line, f = sum(L tan W) / sum(tan^2 W) over the fields on it, metres; None: free.
    envelope : float | None
        Largest extent along z over all surfaces that light meets, image included, metres; None: free.
    clearance : float | None
        Least distance in y between a beam and the edge of a surface that it passes, metres; None: free.
    edge_margin : float
        By how much surfaces are wider than the light on them, metres.
    measure : str
        ``wavefront`` (rms waves, piston and tilt removed) or ``spot`` (rms about the mean, in units of the wavelength
        times the focal ratio).
    distortion : float
        Weight of the chief rays' departure from L = f tan W, residuals per relative departure; 0 for none.
    anamorphism : float | None
        Largest departure of f along the line from f across it, as a share of f across; None: free.
    """

    wavelength: float
    principal_distance: float | None = None
    envelope: float | None = None
    clearance: float | None = None
    edge_margin: float = 0.005
    measure: str = "wavefront"
    distortion: float = 0.0
    anamorphism: float | None = None


@dataclass(frozen=True)
class Passage:
    """A stretch of the beams that passes a surface: between points ``stretch`` and the next, on which side in y."""

    stretch: int
    surface: int
    side: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A prescription's merit.

    Attributes
    ----------
    residuals : np.ndarray
        Their squares sum to the mean square error over the fields (waves^2), (P,).
    errors : np.ndarray
        Rms error per field in waves, (F,).
    principal_distance : float
        metres.
    distance_across : float
        The same across the line, of the fields in the plane of symmetry, metres.
    extents : np.ndarray
        Along z from the farthest point of one surface to that of another, for all pairs, (E,), metres.
    clearances : np.ndarray
        Of every passage, metres.
    d_residuals, d_principal_distance, d_distance_across, d_extents, d_clearances : np.ndarray | None
        Derivatives, variables first; None if not wanted.
    """

    residuals: np.ndarray
    errors: np.ndarray
    principal_distance: float
    distance_across: float
    extents: np.ndarray
    clearances: np.ndarray
    d_residuals: np.ndarray | None = None
    d_principal_distance: np.ndarray | None = None
    d_distance_across: np.ndarray | None = None
    d_extents: np.ndarray | None = None
    d_clearances: np.ndarray | None = None

    @property
    def anamorphism(self) -> float:
        """Principal distance along the line over that across it."""
        return self.principal_distance / self.distance_across

    @property
    def envelope(self) -> float:
        """Extent along z over all surfaces, metres."""
        return float(self.extents.max())


@dataclass(frozen=True, eq=False)
class MeritFunction:
    """The merit function of a prescription, and what its constraints ask for.

    Attributes
    ----------
    backend : Backend
        Where to trace.
    beams : Beams
        The fields and pupils.
    operands : Operands
        What is asked for.
    passages : tuple[Passage, ...]
        Which beams pass which surfaces.
    """

    backend: Backend
    beams: Beams
    operands: Operands
    passages: tuple[Passage, ...]

    @classmethod
    def of(cls, backend: Backend, start: Prescription, beams: Beams, operands: Operands) -> MeritFunction:
        """A merit function that takes the sides on which beams pass surfaces from the prescription ``start``.

        Raises
        ------
        ValueError
            No field lies on the line (y = 0) beside its centre, or the measure is unknown.
        """
        if not _on_line(beams).any() or operands.measure not in ("wavefront", "spot"):
            raise ValueError("a design needs fields on the line off its centre, and the measure wavefront or spot")
        points = trace_beams(backend, start, beams).points
        last, passages = len(points) - 1, []
        for stretch in range(last):
            for surface in range(1, last + 1):
                if surface in (stretch, stretch + 1):
                    continue
                level = np.mean(points[surface, ..., 2])
                y = _crossing(points[stretch], points[stretch + 1], level)[..., 0]
                side = float(np.sign(np.mean(y) - np.mean(points[surface, ..., 1])))
                passages.append(Passage(stretch, surface, side))
        return cls(backend, beams, operands, tuple(passages))

    def evaluate(self, prescription: Prescription, variables: Sequence[Variable] | None = None) -> Evaluation:
        """Trace and evaluate a prescription, with derivatives by the variables if they are given.

        Raises
        ------
        AimError, BeamMissedError
            Light does not get through.
        """
        rays = trace_beams(self.backend, prescription, self.beams, variables)
        residuals, d_residuals, errors = self._errors(rays)
        distance, d_distance, departure, d_departure = self._principal_distance(rays, prescription)
        across, d_across = self._distance_across(rays)
        extents, d_extents = _extents(rays)
        clearances = [self._clearance(rays, passage) for passage in self.passages]
        if self.operands.distortion:
            residuals = np.concatenate([residuals, self.operands.distortion * departure])
        value = np.array([c for c, _ in clearances])
        if d_residuals is None:
            return Evaluation(residuals, errors, distance, across, extents, value)
        if self.operands.distortion:
            assert d_departure is not None
            d_residuals = np.concatenate([d_residuals, self.operands.distortion * d_departure], axis=1)
        slopes = np.stack([slope for _, slope in clearances], axis=1)
        values = residuals, errors, distance, across, extents, value
        return Evaluation(*values, d_residuals, d_distance, d_across, d_extents, slopes)

    def _errors(self, rays: DesignRays) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Residuals (P,), their derivatives (V, P), and errors per field (F,) in waves."""
        nodes = self.beams.nodes
        own = slice(1, 1 + nodes.count)
        weight = np.sqrt(nodes.share / len(rays.path))
        differentiate = rays.d_path is not None
        if self.operands.measure == "spot":
            unit = self.operands.wavelength * self._focal_ratio
            project = np.eye(nodes.count) - nodes.share
            value = (project @ rays.position[:, own, :2]) * weight[:, None] / unit
            errors = np.sqrt(np.sum(value**2, axis=(1, 2)) * len(value))
            if not differentiate:
                return value.ravel(), None, errors
            assert rays.d_position is not None
            slope = (project @ rays.d_position[:, :, own, :2]) * weight[:, None] / unit
            return value.ravel(), slope.reshape(len(slope), -1), errors
        if self.operands.measure != "wavefront":
            raise ValueError(f"a design has no measure {self.operands.measure!r}; there are wavefront and spot")
        # eikonal about the chief ray's image; the exit pupil is taken as far away, which matters by offset^2 / (2 R):
        # some 1e-12 m for spots of 1 um
        offset = rays.position[:, own] - rays.position[:, :1]
        eikonal = rays.path[:, own] - np.sum(rays.direction[:, own] * offset, axis=-1)
        basis = np.stack([np.ones(nodes.count), nodes.x, nodes.y], axis=-1)
        weighted = basis * nodes.share[:, None]
        project = np.eye(nodes.count) - basis @ np.linalg.solve(basis.T @ weighted, weighted.T)
        # the projection takes a metre of common path out; before that the mean, so that no digits are lost
        value = (eikonal - rays.path[:, :1]) @ project.T * weight / self.operands.wavelength
        errors = np.sqrt(np.sum(value**2, axis=1) * len(value))
        if not differentiate:
            return value.ravel(), None, errors
        assert rays.d_position is not None
        assert rays.d_direction is not None
        assert rays.d_path is not None
        d_offset = rays.d_position[:, :, own] - rays.d_position[:, :, :1]
        slope = rays.d_path[:, :, own] - rays.d_path[:, :, :1]
        slope = slope - np.sum(rays.d_direction[:, :, own] * offset + rays.direction[:, own] * d_offset, axis=-1)
        slope = slope @ project.T * weight / self.operands.wavelength
        return value.ravel(), slope.reshape(len(slope), -1), errors

    @property
    def _focal_ratio(self) -> float:
        distance = self.operands.principal_distance
        return 1.0 if distance is None else distance / self.beams.diameter

    def _principal_distance(
        self, rays: DesignRays, prescription: Prescription
    ) -> tuple[float, np.ndarray | None, np.ndarray, np.ndarray | None]:
        """Distance f (metres), its derivatives; relative departures of the line's fields from L = f tan W, theirs."""
        line = _on_line(self.beams)
        # between (tan x, tan b, 1) and (0, tan b, 1): tan W = tan x cos b, as both have the same part across x
        tangent = np.tan(self.beams.fields[line, 0])
        bias = prescription.field_bias
        size = np.sum(tangent**2)
        place = rays.position[line, 0, 0]
        slope = float(place @ tangent / size)
        sign = np.sign(slope)
        distance = abs(slope) / np.cos(bias)
        departure = place / slope - tangent
        if rays.d_position is None:
            return distance, None, departure, None
        d_place = rays.d_position[:, line, 0, 0]
        d_slope = d_place @ tangent / size
        assert rays.d_bias is not None
        d_distance = sign * d_slope / np.cos(bias) + distance * np.tan(bias) * rays.d_bias
        return distance, d_distance, departure, d_place / slope - np.outer(d_slope, place) / slope**2

    def _distance_across(self, rays: DesignRays) -> tuple[float, np.ndarray | None]:
        """Distance f across the line, f = sum(L tan W) / sum(tan^2 W) over the fields in the plane of symmetry beside
        the line, L from the image of the field's centre (metres), and its derivatives; NaN where there are none.
        """
        fields = self.beams.fields
        beside = (fields[:, 0] == 0.0) & (fields[:, 1] != 0.0)
        centre = np.flatnonzero(np.all(fields == 0.0, axis=1))
        if not beside.any() or not len(centre):
            return np.nan, None if rays.d_position is None else np.full(len(rays.d_position), np.nan)
        tangent = np.tan(fields[beside, 1])
        weight = tangent / np.sum(tangent**2)
        place = rays.position[beside, 0, 1] - rays.position[centre[0], 0, 1]
        slope = float(place @ weight)
        if rays.d_position is None:
            return abs(slope), None
        d_place = rays.d_position[:, beside, 0, 1] - rays.d_position[:, centre, 0, 1]
        return abs(slope), np.sign(slope) * (d_place @ weight)

    def _clearance(self, rays: DesignRays, passage: Passage) -> tuple[float, np.ndarray]:
        """Least distance in y between a stretch of the beams and a surface's edge, and its derivatives (V,)."""
        points = rays.points.reshape(len(rays.points), -1, 3)
        edge = int(np.argmax(passage.side * points[passage.surface, :, 1]))
        start, end = points[passage.stretch], points[passage.stretch + 1]
        y, share = np.moveaxis(_crossing(start, end, points[passage.surface, edge, 2]), -1, 0)
        nearest = int(np.argmin(passage.side * y))
        value = passage.side * (y[nearest] - points[passage.surface, edge, 1]) - self.operands.edge_margin
        if rays.d_points is None:
            return value, np.empty(0)
        steps = rays.d_points.reshape(len(rays.d_points), len(points), -1, 3)
        a, b = steps[:, passage.stretch, nearest], steps[:, passage.stretch + 1, nearest]
        e = steps[:, passage.surface, edge]
        t, way = share[nearest], end[nearest] - start[nearest]
        d_t = np.zeros(len(steps))
        if 0.0 < t < 1.0:
            d_t = (e[:, 2] - a[:, 2] - t * (b[:, 2] - a[:, 2])) / way[2]
        return value, passage.side * (a[:, 1] + t * (b[:, 1] - a[:, 1]) + d_t * way[1] - e[:, 1])


def _on_line(beams: Beams) -> np.ndarray:
    """Which fields lie on the line, off its centre; (F,)."""
    return np.asarray((beams.fields[:, 1] == 0.0) & (beams.fields[:, 0] != 0.0))


def _crossing(start: np.ndarray, end: np.ndarray, level: float) -> np.ndarray:
    """Where stretches (..., 3) cross the plane z = level, or their nearer end: y, share of the way (..., 2)."""
    way = end - start
    share = np.clip((level - start[..., 2]) / way[..., 2], 0.0, 1.0)
    return np.stack([start[..., 1] + share * way[..., 1], share], axis=-1)


def _extents(rays: DesignRays) -> tuple[np.ndarray, np.ndarray | None]:
    """Extent along z from each surface to each other one, (E,), the largest is the envelope; derivatives (V, E)."""
    z = rays.points[1:, ..., 2].reshape(len(rays.points) - 1, -1)
    at = np.arange(len(z))
    high, low = np.argmax(z, axis=1), np.argmin(z, axis=1)
    pairs = ~np.eye(len(z), dtype=bool)
    extents = (z[at, high][:, None] - z[at, low])[pairs]
    if rays.d_points is None:
        return extents, None
    steps = rays.d_points[:, 1:, ..., 2].reshape(len(rays.d_points), len(z), -1)
    return extents, (steps[:, at, high][:, :, None] - steps[:, at, low][:, None])[:, pairs]
