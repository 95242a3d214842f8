"""What a prescription is judged by: wavefront or spots over the field, and constraints; with exact derivatives.

Obstruction is looked at in the plane of symmetry, onto which all rays are projected: every stretch of every beam keeps
to that side of every other surface on which it passes in the prescription that the design starts from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.design.design_rays import Beams, DesignRays, trace_beams
from optics.design.design_variables import Prescription, Variable
from optics.numerics.backend import Backend


@dataclass(frozen=True)
class Operands:
    """Operands of the merit function and its constraints.

    Attributes:
        wavelength: metres.
        principal_distance: along the line, f = sum(L tan W) / sum(tan^2 W) over the fields on it, metres; None: free.
        envelope: largest extent along z over all surfaces that light meets, image included, metres; None: free.
        clearance: least distance in y between a beam and the edge of a surface that it passes, metres; None: free.
        edge_margin: by how much surfaces are wider than the light on them, metres.
        measure: ``wavefront`` (rms waves, piston and tilt removed) or ``spot`` (rms about the mean, in units of the
            wavelength times the focal ratio).
        distortion: weight of the chief rays' departure from L = f tan W, residuals per relative departure; 0 for none.
        anamorphism: largest departure of f along the line from f across it, as a share of f across; None: free.
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

    Attributes:
        residuals: their squares sum to the mean square error over the fields (waves^2), (P,).
        errors: rms error per field in waves, (F,).
        principal_distance: metres.
        distance_across: the same across the line, of the fields in the plane of symmetry, metres.
        extents: along z from the farthest point of one surface to that of another, for all pairs, (E,), metres.
        clearances: of every passage, metres.
        d_residuals, d_principal_distance, d_distance_across, d_extents, d_clearances: derivatives, variables first;
            None if not wanted.
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

    Attributes:
        backend: where to trace.
        beams: the fields and pupils.
        operands: what is asked for.
        passages: which beams pass which surfaces.
    """

    backend: Backend
    beams: Beams
    operands: Operands
    passages: tuple[Passage, ...]

    @classmethod
    def of(cls, backend: Backend, start: Prescription, beams: Beams, operands: Operands) -> MeritFunction:
        """A merit function that takes the sides on which beams pass surfaces from the prescription ``start``.

        Raises:
            ValueError: no field lies on the line (y = 0) beside its centre, or the measure is unknown.
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

        Raises:
            AimError, BeamMissedError: light does not get through.
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
