"""Merit function of a prescription: wavefront or spots over the field, and constraints, with exact derivatives.

Obstruction is evaluated in the plane of symmetry, onto which all rays are projected: every segment of every beam must
stay on that side of every other surface on which it passes in the initial prescription.

Every field's beam is a circle of the entrance pupil's diameter about the ray that meets the vertex of the stop. The
derivatives of that chief ray's launch point follow from the implicit function theorem, all others from forward-mode AD
through the trace.

Mirror prescriptions for optimisation: rotationally symmetric mirrors in one plane of symmetry, and their variables.

z runs along the parent axis, light enters toward +z, y lies in the plane of symmetry. A surface's vertex is at (0, y,
z), rotated by ``tilt`` about its own x axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface
from optics.geometry.tree import COMPLEX_STEP, Body, RigidTree
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap, Path, leaves, map_leaves, with_leaf
from optics.numerics.quadrature import PupilNodes, circle
from optics.raytrace.aim import RayFan, aim
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError, jvp, make_rays, trace

SHAPE = ("curvature", "conic", "A4", "A6", "A8")
POSE_QUANTITIES = ("z", "y", "tilt")
BIAS = "field_bias"
_STEPS = {"z": ("", "shift", 2), "y": ("", "shift", 1), "tilt": ("/face", "rotate", 0)}
_NUMBERS: Mapping[str, Path] = FrozenMap(
    {"curvature": ("surface", "curvature"), "conic": ("surface", "conic")}
    | {f"A{4 + 2 * k}": ("surface", "even", k) for k in range(3)}
)


@dataclass(frozen=True)
class Variable:
    """Number of a prescription that the optimisation may change, within bounds.

    Attributes
    ----------
    element : str
        Name of a surface; empty for the field bias.
    quantity : str
        The varied quantity: ``curvature``, ``conic``, ``A4``, ``A6`` or ``A8`` of a surface's shape; ``z``, ``y`` or
        ``tilt`` of its pose; or ``field_bias``.
    low, high : float
        Bounds, SI units.
    """

    element: str
    quantity: str
    low: float = -np.inf
    high: float = np.inf

    @property
    def name(self) -> str:
        """Name of the variable for tables and messages, e.g. ``M1 conic``."""
        return f"{self.element} {self.quantity}".strip()


@dataclass(frozen=True)
class VertexPose:
    """Position of a surface's vertex, metres, and its rotation about its x axis, radians."""

    z: float
    y: float = 0.0
    tilt: float = 0.0


@dataclass(frozen=True)
class Prescription:
    """Mirrors in the order of the light, and the image surface.

    Attributes
    ----------
    surfaces : mapping of str to Surface
        Name -> shape, the image last.
    poses : mapping of str to VertexPose
        Name -> position and tilt.
    stop : str
        Name of the mirror whose vertex the chief rays meet.
    field_bias : float
        Angle of the field's centre from the parent axis, radians.
    """

    surfaces: Mapping[str, Surface]
    poses: Mapping[str, VertexPose]
    stop: str
    field_bias: float

    def __post_init__(self) -> None:
        """Make the mappings immutable, and check that shapes, poses and stop have matching names."""
        object.__setattr__(self, "surfaces", FrozenMap(self.surfaces))
        object.__setattr__(self, "poses", FrozenMap(self.poses))
        if set(self.surfaces) != set(self.poses) or self.stop not in self.names[:-1]:
            raise ValueError("every surface needs a pose, and the stop must be one of the mirrors")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all surfaces, in the order of the light."""
        return tuple(self.surfaces)

    def value(self, variable: Variable) -> float:
        """Return the value that a variable has in this prescription, in SI units.

        Raises
        ------
        KeyError
            The prescription has no such number.
        """
        if variable.quantity == BIAS:
            return self.field_bias
        surface, pose = self.surfaces[variable.element], self.poses[variable.element]
        if variable.quantity in POSE_QUANTITIES:
            return float(getattr(pose, variable.quantity))
        if variable.quantity in ("curvature", "conic"):
            return float(getattr(surface, variable.quantity))
        term = SHAPE.index(variable.quantity) - 2 if variable.quantity in SHAPE else None
        if term is None:
            raise KeyError(variable.name)
        return surface.even[term] if term < len(surface.even) else 0.0

    def values(self, variables: Sequence[Variable]) -> np.ndarray:
        """Return the values of V variables in this prescription, (V,), in SI units."""
        return np.array([self.value(v) for v in variables])

    def with_values(self, variables: Sequence[Variable], values: np.ndarray) -> Prescription:
        """Return a copy of the prescription in which the V variables have the given values (V,), in SI units.

        Aspheric terms that a variable names and the prescription lacks are added.
        """
        surfaces, poses, bias = dict(self.surfaces), dict(self.poses), self.field_bias
        for variable, number in zip(variables, (float(v) for v in values), strict=True):
            name, quantity = variable.element, variable.quantity
            if quantity == BIAS:
                bias = number
            elif quantity in POSE_QUANTITIES:
                poses[name] = replace(poses[name], **{quantity: number})
            elif quantity == "curvature":
                surfaces[name] = replace(surfaces[name], curvature=number)
            elif quantity == "conic":
                surfaces[name] = replace(surfaces[name], conic=number)
            else:
                term = SHAPE.index(quantity) - 2
                even = list(surfaces[name].even) + [0.0] * (term + 1 - len(surfaces[name].even))
                even[term] = number
                surfaces[name] = replace(surfaces[name], even=tuple(even))
        return Prescription(surfaces, poses, self.stop, bias)

    @cached_property
    def assembly(self) -> Assembly:
        """Assembly of rigid bodies and optical elements for the ray trace, without apertures.

        Its sequence ``imaging`` leads through all surfaces to the image, ``to_stop`` ends at the stop.
        """
        bodies, elements = [], {}
        for name, surface in self.surfaces.items():
            pose = self.poses[name]
            # two bodies: shifts are along the prescription's axes, rotations about the surface's own axis
            bodies.append(Body(name, Pose(np.eye(3), np.array([0.0, pose.y, pose.z]))))
            bodies.append(Body(f"{name}/face", Pose(about_axis(0, pose.tilt))))
            interaction = Interaction.PASS if name == self.names[-1] else Interaction.REFLECT
            elements[name] = Element(name, f"{name}/face", surface, interaction)
        stop = self.names.index(self.stop)
        return Assembly(RigidTree(tuple(bodies)), elements, {"imaging": self.names, "to_stop": self.names[: stop + 1]})

    def tangents(self, variables: Sequence[Variable], sequence: str) -> SystemBatch:
        """Return V copies of the optical system, of which copy v carries the derivatives with respect to variable v.

        ``sequence`` names the elements that are traced: ``imaging`` (all, to the image) or ``to_stop`` (as far as the
        stop).
        """
        assembly = self.assembly
        no_step = (self.names[-1], "scale", 0)  # scaling the image plane has no effect
        steps = [_step(v) if v.quantity in _STEPS else no_step for v in variables]
        systems = assemble(assembly, [sequence], [{}] * len(variables), steps)
        assert systems.tangents is not None
        names = assembly.sequences[sequence]
        tables = []
        for i, name in enumerate(names):
            table = map_leaves(_or_zero, systems.values[i], systems.tangents[i])
            for n, variable in enumerate(variables):
                if variable.element == name and variable.quantity in _NUMBERS:
                    number = _NUMBERS[variable.quantity]
                    table = with_leaf(table, number, leaves(table)[number] + np.eye(len(variables))[n])
            tables.append(table)
        return replace(systems, tangents=tuple(tables))


def _or_zero(value: np.ndarray, tangent: np.ndarray | None) -> np.ndarray:
    """Return the derivative ``tangent``, or zeros of the shape of ``value`` where it is None."""
    return np.zeros_like(value) if tangent is None else tangent


def _step(variable: Variable) -> tuple[str, str, int]:
    """Return (body, kind of motion, axis) by which a ray trace is differentiated for a variable of position or tilt."""
    body, kind, axis = _STEPS[variable.quantity]
    return variable.element + body, kind, axis


LAUNCH_DISTANCE = 9.0
"""Distance of the beams' launch plane before the prescription's origin, metres: well before every mirror."""


@dataclass(frozen=True, eq=False)
class Beams:
    """Field points, entrance pupil and pupil nodes whose rays are traced to evaluate a prescription.

    Attributes
    ----------
    fields : (F, 2) ndarray
        Angles x, y of F field points from the field's centre, radians.
    diameter : float
        Diameter of the entrance pupil, metres.
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
        """Pupil coordinates of a beam's N rays, (N, 2), in units of its radius: chief ray, quadrature nodes, rim."""
        nodes = np.stack([self.nodes.x, self.nodes.y], axis=-1)
        return np.concatenate([np.zeros((1, 2)), nodes, circle(self.rim)])


@dataclass(frozen=True, eq=False)
class DesignRays:
    """Rays of the beams of F fields, N rays each, and their derivatives with respect to V variables.

    Attributes
    ----------
    position, direction : (F, N, 3) ndarray
        Positions (metres) and unit directions on the image in its own frame.
    path : (F, N) ndarray
        Optical path from the incoming wavefront through the prescription's origin, metres.
    points : (K + 1, F, N, 3) ndarray
        Launch points, and intersections with the K surfaces (image included), prescription frame, metres.
    d_position, d_direction, d_path, d_points : ndarray, optional
        Derivatives of these with respect to the variables, with a first axis of size V; None if not requested.
    d_bias : (V,) ndarray, optional
        Derivatives of the field bias with respect to the variables.
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
    """Return the directions (F, 3) of the light of F fields, and two axes (F, 2, 3) of each plane wavefront.

    The first axis is near x. ``fields`` (F, 2) are angles from the field's centre and ``bias`` is the angle of that
    centre from the parent axis, in radians. ``bias`` may be complex, to obtain derivatives by a complex step.
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
    """Trace the rays of all fields, with derivatives with respect to the variables if these are given.

    Raises
    ------
    AimError
        A chief ray does not reach the stop.
    BeamMissedError
        A ray misses a surface.
    """
    assembly = prescription.assembly
    along, axes = beam_axes(beams.fields, prescription.field_bias)
    count = len(along)
    to_stop = assemble(assembly, ["to_stop"]).take(np.zeros(count, dtype=int))
    fan = RayFan(-LAUNCH_DISTANCE * along[:, None], along[:, None], axes[:, None], moves_position=True)
    chief = fan.at(aim(backend, to_stop, fan, np.zeros((1, 2)))[0])[0][:, 0]
    offset = 0.5 * beams.diameter * beams.pupil
    launch = chief[:, None] + np.einsum("nk,fkx->fnx", offset, axes)
    heading = np.broadcast_to(along[:, None], launch.shape)
    phase = np.einsum("fnx,fx->fn", launch, along)

    imaging = assemble(assembly, ["imaging"])
    shape = launch.shape
    keep = range(len(prescription.names))
    traced = trace(backend, imaging, make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3)), keep=keep)
    position, direction, path, valid = (a[0] for a in traced.numpy())
    if not valid.all():
        raise BeamMissedError("some rays of a beam miss a surface of the prescription")
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
    """Return traced rays together with their derivatives with respect to the variables.

    ``chief`` are the launch points of the chief rays, whose derivatives follow from the condition that these rays pass
    the stop's vertex.
    """
    along, axes = beam_axes(beams.fields, prescription.field_bias)
    stepped = beam_axes(beams.fields, prescription.field_bias + 1j * COMPLEX_STEP)
    biased = np.array([v.quantity == BIAS for v in variables], dtype=float)
    along_step, axes_step = (np.multiply.outer(biased, a.imag / COMPLEX_STEP) for a in stepped)  # (V, F, ...)
    count, fields = len(variables), len(along)

    # the chief ray's start is c = -L d + a e1 + b e2 with a, b such that it meets the vertex of the stop
    chief_offset = np.einsum("fx,fkx->fk", chief, axes)
    fixed = -LAUNCH_DISTANCE * along_step + np.einsum("fk,vfkx->vfx", chief_offset, axes_step)
    single = assemble(prescription.assembly, ["to_stop"])
    twice = np.repeat(chief, 2, axis=0)[None], np.repeat(along, 2, axis=0)[None]
    slopes = jvp(backend, single, *twice, axes.reshape(1, -1, 3)).position[0, :, :2]
    slopes = np.swapaxes(slopes.reshape(fields, 2, 2), -1, -2)
    to_stop = prescription.tangents(variables, "to_stop")
    chief_rays = np.broadcast_to(chief, (count, fields, 3)), np.broadcast_to(along, (count, fields, 3))
    drift = jvp(backend, to_stop, *chief_rays, fixed, along_step).position[..., :2]
    moved = -np.linalg.solve(np.broadcast_to(slopes, (count, fields, 2, 2)), drift[..., None])[..., 0]
    chief_step = fixed + np.einsum("vfk,fkx->vfx", moved, axes)

    offset = 0.5 * beams.diameter * beams.pupil
    launch = rays.points[0]
    launch_step = chief_step[:, :, None] + np.einsum("nk,vfkx->vfnx", offset, axes_step)
    shape = launch_step.shape
    heading = np.broadcast_to(along[:, None], launch.shape)
    heading_step = np.broadcast_to(along_step[:, :, None], shape)
    systems = prescription.tangents(variables, "imaging")
    keep = range(len(prescription.names))
    flat = (count, -1, 3)
    starts = (np.broadcast_to(launch, shape), np.broadcast_to(heading, shape), launch_step, heading_step)
    position, direction, position_step, direction_step = (start.reshape(flat) for start in starts)
    pushed = jvp(backend, systems, position, direction, position_step, direction_step, keep=keep)
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
    """Targets of the merit function and limits of its constraints.

    "The line" is the line of field points with y = 0 that the camera images. L is the distance of a chief ray's image
    from that of the field's centre, and W its field angle.

    Attributes
    ----------
    wavelength : float
        Wavelength, metres.
    principal_distance : float, optional
        Required principal distance along the line, f = sum(L tan W) / sum(tan^2 W) over the fields on it, metres; None:
        free.
    envelope : float, optional
        Largest allowed extent along z over all surfaces that light meets, image included, metres; None: free.
    clearance : float, optional
        Smallest allowed distance in y between a beam and the edge of a surface that it passes, metres; None: free.
    edge_margin : float
        Width of surfaces beyond the beam footprints, metres.
    measure : str
        ``wavefront`` (rms waves, piston and tilt removed) or ``spot`` (rms about the mean, in units of the wavelength
        times the focal ratio).
    distortion : float
        Weight of distortion: factor by which the relative departure of a chief ray's image from L = f tan W is
        multiplied to give a residual of the least squares; with 0, distortion is ignored.
    anamorphism : float, optional
        Largest allowed difference of f along the line from f across it, relative to f across; None: free.
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
    """Beam segment that must pass a surface without touching it.

    Attributes
    ----------
    segment : int
        Index of the point of the rays at which the segment begins; it ends at the next point.
    surface : int
        Index of the surface.
    side : float
        Side of the surface in y on which the segment passes: +1 for +y, -1 for -y.
    """

    segment: int
    surface: int
    side: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Merit and constraints of a prescription.

    Attributes
    ----------
    residuals : (P,) ndarray
        P residuals whose squares sum to the mean square error over the fields (waves^2).
    errors : (F,) ndarray
        Rms error of each of the F fields, waves.
    principal_distance : float
        Principal distance along the imaged line (fields with y = 0), metres.
    distance_across : float
        Principal distance across the line, from the fields in the plane of symmetry, metres.
    extents : (E,) ndarray
        Extents along z from the farthest point of one surface to that of another, for all E pairs, metres.
    clearances : ndarray
        Distance in y between beams and the edge of the surface, for every passage, metres.
    d_residuals, d_principal_distance, d_distance_across, d_extents, d_clearances : ndarray, optional
        Derivatives with respect to the variables, which are the first axis; None if not requested.
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
        """Ratio of the principal distance along the imaged line to that across it, 1 without anamorphism."""
        return self.principal_distance / self.distance_across

    @property
    def envelope(self) -> float:
        """Extent along z over all surfaces including the image, metres: the largest of ``extents``."""
        return float(self.extents.max())


@dataclass(frozen=True, eq=False)
class MeritFunction:
    """Merit function of a prescription, with its constraints.

    Attributes
    ----------
    backend : Backend
        Backend of the ray trace.
    beams : Beams
        Field points, entrance pupil and pupil nodes.
    operands : Operands
        Targets and limits.
    passages : tuple of Passage
        Beam segments that must clear surfaces, each with the surface and the side (+1 for +y, -1 for -y) on which it
        passes it.
    """

    backend: Backend
    beams: Beams
    operands: Operands
    passages: tuple[Passage, ...]

    @classmethod
    def of(cls, backend: Backend, start: Prescription, beams: Beams, operands: Operands) -> MeritFunction:
        """Return a merit function whose beams pass surfaces on the same sides as they do in the prescription ``start``.

        Raises
        ------
        ValueError
            No field lies on the line (y = 0) off its centre, or the measure is unknown.
        """
        if not _on_line(beams).any() or operands.measure not in ("wavefront", "spot"):
            raise ValueError("a design needs fields on the line off its centre, and the measure 'wavefront' or 'spot'")
        points = trace_beams(backend, start, beams).points
        last, passages = len(points) - 1, []
        for segment in range(last):
            for surface in range(1, last + 1):
                if surface in (segment, segment + 1):
                    continue
                level = np.mean(points[surface, ..., 2])
                y = _crossing(points[segment], points[segment + 1], level)[..., 0]
                side = float(np.sign(np.mean(y) - np.mean(points[surface, ..., 1])))
                passages.append(Passage(segment, surface, side))
        return cls(backend, beams, operands, tuple(passages))

    def evaluate(self, prescription: Prescription, variables: Sequence[Variable] | None = None) -> Evaluation:
        """Trace and evaluate a prescription, with derivatives with respect to the variables if these are given.

        Raises
        ------
        AimError, BeamMissedError
            A beam does not pass the prescription.
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
        """Return P residuals (P,), their derivatives (V, P), and the rms errors (F,) of F fields, in waves.

        The derivatives are with respect to the V variables.
        """
        nodes = self.beams.nodes
        pupil = slice(1, 1 + nodes.count)
        weight = np.sqrt(nodes.share / len(rays.path))
        differentiate = rays.d_path is not None
        if self.operands.measure == "spot":
            unit = self.operands.wavelength * self._focal_ratio
            project = np.eye(nodes.count) - nodes.share
            value = (project @ rays.position[:, pupil, :2]) * weight[:, None] / unit
            errors = np.sqrt(np.sum(value**2, axis=(1, 2)) * len(value))
            if not differentiate:
                return value.ravel(), None, errors
            assert rays.d_position is not None
            slope = (project @ rays.d_position[:, :, pupil, :2]) * weight[:, None] / unit
            return value.ravel(), slope.reshape(len(slope), -1), errors
        if self.operands.measure != "wavefront":
            raise ValueError(f"unknown measure {self.operands.measure!r}; choose wavefront or spot")
        # eikonal about the chief ray's image; the exit pupil is assumed at infinity, an error of offset^2 / (2 R):
        # some 1e-12 m for spots of 1 um
        offset = rays.position[:, pupil] - rays.position[:, :1]
        eikonal = rays.path[:, pupil] - np.sum(rays.direction[:, pupil] * offset, axis=-1)
        basis = np.stack([np.ones(nodes.count), nodes.x, nodes.y], axis=-1)
        weighted = basis * nodes.share[:, None]
        project = np.eye(nodes.count) - basis @ np.linalg.solve(basis.T @ weighted, weighted.T)
        # the projection removes the common path of metres; the chief ray's is subtracted first to keep all digits
        value = (eikonal - rays.path[:, :1]) @ project.T * weight / self.operands.wavelength
        errors = np.sqrt(np.sum(value**2, axis=1) * len(value))
        if not differentiate:
            return value.ravel(), None, errors
        assert rays.d_position is not None
        assert rays.d_direction is not None
        assert rays.d_path is not None
        d_offset = rays.d_position[:, :, pupil] - rays.d_position[:, :, :1]
        slope = rays.d_path[:, :, pupil] - rays.d_path[:, :, :1]
        slope = slope - np.sum(rays.d_direction[:, :, pupil] * offset + rays.direction[:, pupil] * d_offset, axis=-1)
        slope = slope @ project.T * weight / self.operands.wavelength
        return value.ravel(), slope.reshape(len(slope), -1), errors

    @property
    def _focal_ratio(self) -> float:
        """Required principal distance over pupil diameter, for the unit of spot sizes; 1 if no distance is required."""
        distance = self.operands.principal_distance
        return 1.0 if distance is None else distance / self.beams.diameter

    def _principal_distance(
        self, rays: DesignRays, prescription: Prescription
    ) -> tuple[float, np.ndarray | None, np.ndarray, np.ndarray | None]:
        """Return the principal distance f along the line (metres) and the departures of its fields from L = f tan W.

        L is the distance of a chief ray's image from that of the field's centre, and W the field angle; departures are
        relative to f tan W. Four values are returned: f, its derivatives with respect to the variables, the departures,
        and their derivatives.
        """
        line = _on_line(self.beams)
        # between (tan x, tan b, 1) and (0, tan b, 1): tan W = tan x cos b, as both have the same part across x
        tangent = np.tan(self.beams.fields[line, 0])
        bias = prescription.field_bias
        size = np.sum(tangent**2)
        position = rays.position[line, 0, 0]
        slope = float(position @ tangent / size)
        sign = np.sign(slope)
        distance = abs(slope) / np.cos(bias)
        departure = position / slope - tangent
        if rays.d_position is None:
            return distance, None, departure, None
        d_position = rays.d_position[:, line, 0, 0]
        d_slope = d_position @ tangent / size
        assert rays.d_bias is not None
        d_distance = sign * d_slope / np.cos(bias) + distance * np.tan(bias) * rays.d_bias
        return distance, d_distance, departure, d_position / slope - np.outer(d_slope, position) / slope**2

    def _distance_across(self, rays: DesignRays) -> tuple[float, np.ndarray | None]:
        """Return the principal distance f across the line (metres) and its derivatives with respect to the variables.

        f = sum(L tan W) / sum(tan^2 W) over the fields in the plane of symmetry off the line, with W the field angle
        and L the distance of the chief ray's image from that of the field's centre. It is NaN where there are no such
        fields.
        """
        fields = self.beams.fields
        off_line = (fields[:, 0] == 0.0) & (fields[:, 1] != 0.0)
        centre = np.flatnonzero(np.all(fields == 0.0, axis=1))
        if not off_line.any() or not len(centre):
            return np.nan, None if rays.d_position is None else np.full(len(rays.d_position), np.nan)
        tangent = np.tan(fields[off_line, 1])
        weight = tangent / np.sum(tangent**2)
        position = rays.position[off_line, 0, 1] - rays.position[centre[0], 0, 1]
        slope = float(position @ weight)
        if rays.d_position is None:
            return abs(slope), None
        d_position = rays.d_position[:, off_line, 0, 1] - rays.d_position[:, centre, 0, 1]
        return abs(slope), np.sign(slope) * (d_position @ weight)

    def _clearance(self, rays: DesignRays, passage: Passage) -> tuple[float, np.ndarray]:
        """Return the smallest distance in y, metres, of a beam segment from a surface's edge, and its derivatives.

        The derivatives (V,) are with respect to the V variables.
        """
        points = rays.points.reshape(len(rays.points), -1, 3)
        edge = int(np.argmax(passage.side * points[passage.surface, :, 1]))
        start, end = points[passage.segment], points[passage.segment + 1]
        y, fraction = np.moveaxis(_crossing(start, end, points[passage.surface, edge, 2]), -1, 0)
        nearest = int(np.argmin(passage.side * y))
        value = passage.side * (y[nearest] - points[passage.surface, edge, 1]) - self.operands.edge_margin
        if rays.d_points is None:
            return value, np.empty(0)
        steps = rays.d_points.reshape(len(rays.d_points), len(points), -1, 3)
        a, b = steps[:, passage.segment, nearest], steps[:, passage.segment + 1, nearest]
        e = steps[:, passage.surface, edge]
        t, span = fraction[nearest], end[nearest] - start[nearest]
        d_t = np.zeros(len(steps))
        if 0.0 < t < 1.0:
            d_t = (e[:, 2] - a[:, 2] - t * (b[:, 2] - a[:, 2])) / span[2]
        return value, passage.side * (a[:, 1] + t * (b[:, 1] - a[:, 1]) + d_t * span[1] - e[:, 1])


def _on_line(beams: Beams) -> np.ndarray:
    """Return the mask (F,) of the F fields that lie on the imaged line (y = 0), away from the field's centre."""
    return np.asarray((beams.fields[:, 1] == 0.0) & (beams.fields[:, 0] != 0.0))


def _crossing(start: np.ndarray, end: np.ndarray, level: float) -> np.ndarray:
    """Return where segments meet the plane z = ``level``, or their end nearest to it where they do not reach it.

    ``start`` and ``end`` (..., 3) are the ends of the segments, metres. The result (..., 2) holds the coordinate y of
    the crossing, metres, and the fraction of the segment at which it lies.
    """
    span = end - start
    fraction = np.clip((level - start[..., 2]) / span[..., 2], 0.0, 1.0)
    return np.stack([start[..., 1] + fraction * span[..., 1], fraction], axis=-1)


def _extents(rays: DesignRays) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the extents along z of all E ordered pairs of surfaces (E,), metres, and their derivatives (V, E).

    An extent leads from the farthest point of one surface to that of the other; the largest is the envelope. The
    derivatives are with respect to the V variables.
    """
    z = rays.points[1:, ..., 2].reshape(len(rays.points) - 1, -1)
    surfaces = np.arange(len(z))
    high, low = np.argmax(z, axis=1), np.argmin(z, axis=1)
    pairs = ~np.eye(len(z), dtype=bool)
    extents = (z[surfaces, high][:, None] - z[surfaces, low])[pairs]
    if rays.d_points is None:
        return extents, None
    steps = rays.d_points[:, 1:, ..., 2].reshape(len(rays.d_points), len(z), -1)
    return extents, (steps[:, surfaces, high][:, :, None] - steps[:, surfaces, low][:, None])[:, pairs]
