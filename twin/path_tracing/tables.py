"""Numbers of the prescription and of measured surface finishes, as flat tables in the backend's memory.

Each path reads the numbers of the surfaces that it meets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, assert_never

import numpy as np

from optics.geometry.aperture import Aperture, DiskNumbers, EllipseNumbers, RectangleNumbers, RingNumbers
from optics.geometry.sag_terms import SagTerm, kinds_of, of_kinds
from optics.geometry.surface import FigureNumbers, GridNumbers, SurfaceNumbers
from optics.geometry.zernike import triangle_size
from optics.materials import fresnel_scatter
from optics.materials.fresnel_scatter import Finish, ScatterSampling
from optics.numerics.backend import Backend
from optics.numerics.number_tree import leaves
from scenes.models.scenery import Scenery, SceneSurface
from twin.path_tracing.clear_ways import EXITS, Segment

_HEADER = 8
"""Count of numbers at the head of a scatter table.

They are: number of rings and of sectors; indices of the first share, of the first of the rings' cumulative sums, of the
first of the sectors', of the first cosine and of the first azimuth; and 1 where half of the random directions are
mirrored.
"""
MARKS = 4
"""Count of the numbers by which a surface finish refers to its measured tables.

They are the number of its coating table and of its scatter table, each counted from 1 with 0 if there is none; 1 where
all that it reflects is what the table scatters, else 0; and an unused one.
"""


@dataclass(frozen=True, eq=False)
class FinishTables:
    """Measured surface finishes of a scene, as Dr.Jit arrays.

    Attributes
    ----------
    marks : Dr.Jit array
        (surfaces * 3 * MARKS) numbers of the tables that every finish refers to, see ``MARKS``.
    coatings : Dr.Jit array
        (coatings * (STEPS + 1) * 2) reflectance and transmittance.
    headers : Dr.Jit array
        (scatter tables * _HEADER) headers.
    numbers : Dr.Jit array
        Numbers that the headers point to.
    most_rings, most_sectors : int
        Largest number of rings and of sectors of all tables.
    """

    backend: Backend
    marks: Any
    coatings: Any
    headers: Any
    numbers: Any
    most_rings: int
    most_sectors: int

    def of(self, row: Any, active: Any) -> list[Any]:
        """Return the ``MARKS`` numbers by which each path's surface finish refers to its coating and scatter tables."""
        return [self._get(self.marks, row * MARKS + k, active) for k in range(MARKS - 1)]

    def shares(self, marks: Sequence[Any], cosine: Any, active: Any) -> tuple[Any, Any]:
        """Return reflectance and transmittance of the measured coatings that paths meet.

        ``marks`` are the numbers of their tables, and ``cosine`` is that of the angle between path and normal on the
        side of air.
        """
        number, k, w = self._place(marks[0], cosine, fresnel_scatter.COATING_STEPS)
        first = 2 * ((fresnel_scatter.COATING_STEPS + 1) * number + k)
        has = active & (marks[0] > 0.5)
        low, high = ([self._get(self.coatings, first + n + step, has) for n in (0, 1)] for step in (0, 2))
        return (1.0 - w) * low[0] + w * high[0], (1.0 - w) * low[1] + w * high[1]

    def total(self, marks: Sequence[Any], cosine: Any, active: Any) -> Any:
        """Return the total integrated scatter at each path's angle of incidence, for paths with a scatter table."""
        number, k, w = self._place(marks[1], cosine, fresnel_scatter.STEPS)
        has = active & (marks[1] > 0.5)
        first = self._uint(self._get(self.headers, _HEADER * number + 2, has)) + k
        return (1.0 - w) * self._get(self.numbers, first, has) + w * self._get(self.numbers, first + 1, has)

    def draw(self, marks: Sequence[Any], cosine: Any, specular: Any, side: Any, u: Sequence[Any], active: Any) -> Any:
        """Draw a scattered direction for paths whose surface finish has a scatter table.

        Parameters
        ----------
        marks : sequence of Dr.Jit arrays
            Numbers of the tables of their finishes, see ``MARKS``.
        cosine : Dr.Jit array
            Cosine of the angle of incidence.
        specular : Dr.Jit Vector3
            Unit vector of the specular direction.
        side : Dr.Jit Vector3
            Unit normal on the side to which the light leaves.
        u : sequence of Dr.Jit arrays
            Four uniform random numbers in [0, 1).
        active : Dr.Jit mask
            Mask of the paths.
        """
        import drjit as dr

        number, k, w = self._place(marks[1], cosine, fresnel_scatter.STEPS)
        has = active & (marks[1] > 0.5)
        header = [self._get(self.headers, _HEADER * number + n, has) for n in range(_HEADER)]
        rings, sectors, share, ring_sums, sector_sums, cosines, azimuths = (self._uint(v) for v in header[:7])
        low, high = self._get(self.numbers, share + k, has), self._get(self.numbers, share + k + 1, has)
        # draw one of the two neighbouring angles of incidence, by its interpolated power
        upper = u[0] * ((1.0 - w) * low + w * high) < w * high
        k = dr.select(upper, k + 1, k)
        ring, along = self._search(ring_sums + k * (rings + 1), rings, self.most_rings, u[1], has)
        row = sector_sums + (k * rings + ring) * (sectors + 1)
        sector, across = self._search(row, sectors, self.most_sectors, u[2], has)
        c = self._between(cosines + ring, along, has)
        p = self._between(azimuths + sector, across, has)
        p = dr.select((header[7] > 0.5) & (u[3] < 0.5), -p, p)
        lean = side - dr.dot(side, specular) * specular
        # at normal incidence the origin of the azimuth is arbitrary
        other = self.backend.Vector3(
            dr.select(dr.abs(specular.x) < 0.6, 1.0, 0.0), dr.select(dr.abs(specular.x) < 0.6, 0.0, 1.0), 0.0
        )
        other = other - dr.dot(other, specular) * specular
        e = dr.normalize(dr.select(dr.squared_norm(lean) > 1e-20, lean, other))
        h = dr.cross(specular, e)
        s = dr.safe_sqrt(1.0 - c * c)
        sine, cosine_p = dr.sincos(p)
        out = c * specular + s * (cosine_p * e + sine * h)
        below = dr.minimum(dr.dot(out, side), 0.0)
        return dr.normalize(out - 2.0 * below * side)

    def _place(self, mark: Any, cosine: Any, steps: int) -> tuple[Any, Any, Any]:
        """Return the table's number from 0, the interval of the angle of incidence, and the fraction of it, 0 to 1."""
        import drjit as dr

        angle = dr.acos(dr.clip(cosine, 0.0, 1.0)) * (2.0 * steps / np.pi)
        k = dr.minimum(self._uint(angle), steps - 1)
        return self._uint(dr.maximum(mark, 1.0)) - 1, k, angle - self.backend.Float(k)

    def _search(self, first: Any, count: Any, most: int, u: Any, active: Any) -> tuple[Any, Any]:
        """Return the cell whose interval of cumulative shares contains a random number u, and u's place in it, 0 to 1.

        ``first`` is the index of the first cumulative share, ``count`` the number of cells, at most ``most``.
        """
        import drjit as dr

        cell = dr.binary_search(
            0,
            most - 1,
            lambda i: (i + 1 < count) & (self._get(self.numbers, first + dr.minimum(i, count - 1) + 1, active) <= u),
        )
        low, high = self._get(self.numbers, first + cell, active), self._get(self.numbers, first + cell + 1, active)
        return cell, dr.select(high > low, (u - low) / (high - low), 0.5)

    def _between(self, first: Any, place: Any, active: Any) -> Any:
        low, high = self._get(self.numbers, first, active), self._get(self.numbers, first + 1, active)
        return low + place * (high - low)

    def _get(self, source: Any, index: Any, active: Any) -> Any:
        import drjit as dr

        return dr.gather(self.backend.Float, source, index, active)

    def _uint(self, value: Any) -> Any:
        return self.backend.UInt(value)


def measured(finish: Finish) -> bool:
    """Return True if a surface finish has a measured table of its coating or its scattering."""
    return finish.coating is not None or finish.table is not None


def upload_finishes(backend: Backend, surfaces: Sequence[SceneSurface]) -> FinishTables | None:
    """Upload the measured finishes of a scene; return None if there are none."""
    finishes = [f for s in surfaces for f in (s.front, s.back, s.outside)]
    if not any(measured(f) for f in finishes):
        return None
    # a coating of glass has a transmittance as well
    coats = list(dict.fromkeys((f.coating, f.transmission > 0.0) for f in finishes if f.coating is not None))
    tables = list(dict.fromkeys(f.table for f in finishes if f.table is not None))
    marks = np.zeros((len(finishes), MARKS))
    for i, f in enumerate(finishes):
        if f.coating is not None:
            marks[i, 0] = coats.index((f.coating, f.transmission > 0.0)) + 1
        if f.table is not None:
            marks[i, 1] = tables.index(f.table) + 1
            marks[i, 2] = float(f.scattered_only)
    headers, numbers = np.zeros((max(len(tables), 1), _HEADER)), [np.zeros(1)]
    for i, table in enumerate(tables):
        headers[i] = _header(table.sampling, sum(map(len, numbers)))
        drawn = table.sampling
        numbers += [a.ravel() for a in (drawn.share, drawn.rings, drawn.sectors, drawn.cosines, drawn.azimuths)]
    return FinishTables(
        backend,
        backend.opaque(marks),
        backend.opaque(np.concatenate([c.sampled(through).ravel() for c, through in coats]) if coats else np.zeros(2)),
        backend.opaque(headers),
        backend.opaque(np.concatenate(numbers)),
        max((t.rings for t in tables), default=1),
        max((t.sectors for t in tables), default=1),
    )


def _header(drawn: ScatterSampling, first: int) -> list[float]:
    sizes = [drawn.share.size, drawn.rings.size, drawn.sectors.size, drawn.cosines.size]
    starts = first + np.concatenate([[0], np.cumsum(sizes)])
    rings, sectors = len(drawn.cosines) - 1, len(drawn.azimuths) - 1
    return [float(v) for v in (rings, sectors, *starts, drawn.mirrored)]


BLOCK = 4
BLOCKS = 8
ROW = BLOCK * BLOCKS
"""Count of numbers that describe a surface in the geometry table.

By index: 0-8 rotation from the world frame to the surface's, 9-11 shift of the same transform, 12 distance beyond the
surface at which the search for the next one starts, 13 refractive index behind, 14 index of the part plus one, 15
reciprocal of the refractive index, 16-25 two clear apertures, 26 bits of the kind, 28-31 indices of the first clear
segment for each way of leaving the surface, 0 if there is none.
"""

CLEARANCE, INDEX, PART, INVERSE, APERTURES, KIND, SEGMENTS = 12, 13, 14, 15, 16, 26, 28
KINDS = (20, 25, KIND)
"""Positions, in a surface's row of the geometry table, of numbers that encode a kind (of aperture or of surface)."""

CURVES = 2
"""Number of memory blocks that describe a curved surface: curvature, conic, and aspheric terms A4, A6, A8."""

APERTURE = 5
"""Count of numbers of a clear aperture: four of its shape (for an ellipse the reciprocals of its semi-axes), and the
kind of shape.
"""
RING, RECTANGLE, ELLIPSE = 0.0, 1.0, 2.0

GRID_ROW = 8
_NO_GRID = (0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 0.0)
"""Numbers of a grid for surfaces without one: four by four samples of 0, whose 8 x 8 coefficients are first in the
table.
"""

FINISH_ROW = 8
"""Count of numbers of a surface finish in the table of finishes.

They are reflectance (-1 for bare glass), transmission, diffuse share, share of the scatter lobe; scale, exponent and
kind of the lobe, and its area.
"""
ROWS_PER_SURFACE = 3
"""Number of finishes of a surface: met from +z, met from -z, outside its clear apertures."""

SEGMENT = 8
"""Count of numbers by which a clear segment is described, see ``segment_table``."""

MOST_EVEN = 3
MOST_BODIES = 255
MOST_DETECTORS = 255

NOMINAL_SUMS = 8
"""Number of sums over the detections of nominal light per detector (``path_result.SUMS``), one of them unused."""


class Kind:
    """Bits of the number that describes a surface: face of a glass solid, ends at its clear apertures, curved.

    Further bits hold the numbers of its glass body and of its detector.
    """

    SOLID = 1
    ENDS = 2
    CURVED = 4
    BODY_SHIFT, BODY_MASK = 8, 0xFF
    DETECTOR_SHIFT, DETECTOR_MASK = 16, 0xFF


@dataclass(frozen=True)
class SurfaceForm:
    """Components of the shapes of a scene's surfaces, which determine the kernel's code.

    Attributes
    ----------
    even : int
        Number of aspheric terms.
    terms : tuple of type[SagTerm]
        Kinds of further terms of the sag.
    figure_order : int
        Highest order of a polynomial figure, -1 if there is none.
    grid : bool
        Some surface has a figure on a grid.
    flat : bool
        All surfaces are planes without figure.
    mixed : bool
        Some surfaces are planes without figure, and some are not.
    """

    even: int
    terms: tuple[type[SagTerm], ...]
    figure_order: int
    grid: bool
    flat: bool
    mixed: bool

    @classmethod
    def of(cls, surfaces: Sequence[SceneSurface]) -> SurfaceForm:
        """Return the components of shape that at least one of the surfaces has."""
        shapes = [s.surface for s in surfaces]
        order = max((f.order for s in shapes if (f := s.zernike_figure) is not None), default=-1)
        grid = any(s.grid_figure is not None for s in shapes)
        flat = [s.is_plane and s.figure is None for s in shapes]
        terms = kinds_of([term for s in shapes for term in s.terms])
        even = max((len(s.even) for s in shapes), default=0)
        return cls(even, terms, order, grid, all(flat), any(flat) and not all(flat))


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Numbers of a scene, as Dr.Jit arrays.

    Attributes
    ----------
    rows : Dr.Jit array
        (surfaces * ROW) geometry.
    curves : Dr.Jit array
        (surfaces * CURVES * BLOCK) curvature, conic and aspheric terms.
    terms : Dr.Jit array
        (surfaces * 4 * blocks) numbers of all kinds of further terms; width 1 if there are none.
    figures : Dr.Jit array
        (surfaces * 4 * blocks) centre and coefficients of polynomial figures; width 1 if there are none.
    grids, samples : Dr.Jit array
        (surfaces * GRID_ROW) numbers of grid figures, and the coefficients of all; width 1 if there are none.
    finishes : Dr.Jit array
        (surfaces * 3 * FINISH_ROW) surface finishes.
    planes : Dr.Jit array
        (surfaces * 4) world normal and offset of flat faces.
    body_first, body_faces : Dr.Jit array
        (bodies + 1,) first surface and number of faces of each glass body.
    detectors : Dr.Jit array
        (detectors * 8) pixels per metre in x and y, columns, rows, first pixel.
    nominal : Dr.Jit array
        (detectors,) hash of the events of each detector's nominal light.
    pixels : Dr.Jit array
        Number of pixels of all detectors together.
    segments : Dr.Jit array
        ((2 + segments) * SEGMENT) clear segments, see ``segment_table``.
    measured : FinishTables or None
        Tables of measured finishes, None if there are none.
    """

    rows: Any
    curves: Any
    terms: Any
    figures: Any
    grids: Any
    samples: Any
    finishes: Any
    planes: Any
    body_first: Any
    body_faces: Any
    detectors: Any
    nominal: Any
    pixels: Any
    segments: Any
    block: Any
    host_rows: np.ndarray
    host_finishes: np.ndarray
    measured: FinishTables | None = None

    def geometry(self, surface: Any, active: Any) -> list[Any]:
        """Return the ``ROW`` numbers (pose, apertures, kind) of the surface that each path meets."""
        return self._row(self.rows, surface, BLOCKS, active)

    def surface(self, number: Any, form: SurfaceForm, active: Any) -> SurfaceNumbers:
        """Return the numbers that describe the shape of the surface that each path meets."""
        c = self._row(self.curves, number, CURVES, active)
        figure = grid = None
        terms: list[SagTerm] = []
        if form.terms:
            sizes = [len(kind.POWERS) for kind in form.terms]
            f = self._row(self.terms, number, _blocks(sum(sizes)), active)
            for kind, size in zip(form.terms, sizes, strict=True):
                terms.append(kind(*f[:size]))
                f = f[size:]
        if form.figure_order >= 0:
            size = triangle_size(form.figure_order)
            f = self._row(self.figures, number, _blocks(2 + size), active)
            figure = FigureNumbers(f[0], f[1], tuple(f[2 : 2 + size]))
        if form.grid:
            grid = GridNumbers(*self._row(self.grids, number, GRID_ROW // BLOCK, active)[:7])
        return SurfaceNumbers(c[0], c[1], tuple(c[2 : 2 + form.even]), tuple(terms), figure, grid)

    def finish(self, row: Any, active: Any) -> list[Any]:
        """Return reflectance, transmission, diffuse share and share of the lobe of the finish that each path meets.

        A reflectance of -1 stands for bare glass.
        """
        return self._row(self.finishes, 2 * row, 1, active)

    def lobe(self, row: Any) -> Callable[[Any], list[Any]]:
        """Return a function that gives scale, exponent, kind and area of each active path's scatter lobe."""
        return lambda active: self._row(self.finishes, 2 * row + 1, 1, active)

    def detector(self, number: Any, active: Any) -> list[Any]:
        """Return pixels per metre in x and y, columns, rows and first pixel of each path's detector."""
        return self._row(self.detectors, number, 2, active)

    def plane(self, surface: Any, active: Any) -> list[Any]:
        """Return world normal (3) and offset of a flat face."""
        return self._row(self.planes, surface, 1, active)

    def segment(self, number: Any, active: Any) -> list[Any]:
        """Return the ``SEGMENT`` numbers of the clear segment that each path is on."""
        return self._row(self.segments, number, SEGMENT // BLOCK, active)

    def _row(self, source: Any, index: Any, blocks: int, active: Any) -> list[Any]:
        import drjit as dr

        out: list[Any] = []
        for k in range(blocks):
            out += list(dr.gather(self.block, source, index * blocks + k, active))
        return out


def glass_bodies(surfaces: Sequence[SceneSurface]) -> list[str]:
    """Return the glass bodies in the order of their numbers, which count from 1."""
    return list(dict.fromkeys(s.solid for s in surfaces if s.solid is not None))


def upload(
    backend: Backend, scenery: Scenery, nominal: Mapping[str, int], segments: Sequence[Segment] = ()
) -> SceneTables:
    """Upload the tables of a scene.

    Parameters
    ----------
    backend : Backend
        Backend that holds the tables.
    scenery : Scenery
        Surfaces.
    nominal : Mapping[str, int]
        Detector name -> hash of the events of its nominal light, see ``path_families.signature``.
    segments : Sequence[Segment]
        Clear segments.

    Raises
    ------
    ValueError
        Too many bodies, detectors or aspheric terms.
    """
    import drjit as dr

    surfaces, detectors = scenery.surfaces, scenery.detectors
    bodies = glass_bodies(surfaces)
    if len(bodies) > MOST_BODIES or len(detectors) > MOST_DETECTORS:
        raise ValueError(f"{len(bodies)} glass bodies, {len(detectors)} detectors: at most {MOST_BODIES} of each")
    rows = np.zeros((len(surfaces), ROW))
    planes = np.zeros((len(surfaces), BLOCK))
    kind = np.zeros(len(surfaces), np.uint32)
    curves = np.zeros((len(surfaces), CURVES * BLOCK))
    finishes = np.zeros((len(surfaces), ROWS_PER_SURFACE, FINISH_ROW))
    numbers = {d.name: i + 1 for i, d in enumerate(detectors)}
    parts = scenery.parts
    for i, s in enumerate(surfaces):
        rows[i] = _geometry(s)
        normal = s.pose.rotation[:, 2]
        planes[i] = [*normal, normal @ s.pose.translation]
        curves[i] = _curves(s)
        curved = not s.surface.is_plane or s.surface.figure is not None
        kind[i] = Kind.SOLID * (s.solid is not None) | Kind.ENDS * s.ends | Kind.CURVED * curved
        if s.solid is not None:
            kind[i] |= (bodies.index(s.solid) + 1) << Kind.BODY_SHIFT
        if s.detector is not None:
            kind[i] |= numbers[s.detector] << Kind.DETECTOR_SHIFT
        finishes[i] = [_finish(finish) for finish in (s.front, s.back, s.outside)]
        rows[i, PART], rows[i, KIND] = parts.index(s.part) + 1, kind[i]
    for number, segment in reversed(list(enumerate(segments))):
        rows[segment.start, SEGMENTS + segment.exit_side] = number + 2
    first, count = np.zeros(len(bodies) + 1, np.uint32), np.zeros(len(bodies) + 1, np.uint32)
    for b, body in enumerate(bodies):
        faces = [i for i, s in enumerate(surfaces) if s.solid == body]
        if faces != list(range(faces[0], faces[0] + len(faces))):
            raise ValueError(f"the faces of {body!r} do not follow each other")
        first[b + 1], count[b + 1] = faces[0], len(faces)
    grids = np.zeros((max(len(detectors), 1), 2 * BLOCK))
    first_pixel = 0
    for i, d in enumerate(detectors):
        grids[i, :5] = [1.0 / d.pitch[0], 1.0 / d.pitch[1], d.columns, d.rows, first_pixel]
        first_pixel += d.columns * d.rows
    form = SurfaceForm.of(surfaces)
    figures, placements, samples = _figures(surfaces, form)
    signatures = np.array([nominal.get(d.name, 0) for d in detectors] or [0], np.uint64)
    out = SceneTables(
        backend.opaque(rows),
        backend.opaque(curves),
        backend.opaque(_terms(surfaces, form)),
        backend.opaque(figures),
        backend.opaque(placements),
        backend.opaque(samples),
        backend.opaque(finishes),
        backend.opaque(planes),
        backend.UInt(first),
        backend.UInt(count),
        backend.opaque(grids),
        dr.uint64_array_t(backend.Float)(signatures),
        backend.UInt(first_pixel),
        backend.opaque(segment_table(segments)),
        import_module(f"drjit.{backend.name}.ad").Array4f64,
        rows,
        finishes,
        upload_finishes(backend, surfaces),
    )
    dr.make_opaque(out.body_first, out.body_faces, out.nominal, out.pixels)
    return out


def segment_table(segments: Sequence[Segment], source: Segment | None = None) -> np.ndarray:
    """Return the numbers of clear segments, (2 + segments, SEGMENT).

    The first line stands for no segment, the second for that of the source, and all others follow. A line has the
    middle of the aperture at the end and the index of the next segment; then its normal, scaled to the reciprocal of
    its radius, and the code 4 * surface + 2 * aperture + side to which light leaves for the next segment.
    """
    out = np.zeros((2 + len(segments), SEGMENT))
    for row, segment in zip(out[1:], (source, *segments), strict=True):
        if segment is not None:
            row[:4] = [*segment.end.middle, segment.after + 2 if segment.after >= 0 else 0]
            row[4:] = [
                *segment.end.normal / segment.end.radius,
                EXITS * segment.end.surface + 2 * segment.end.aperture + segment.behind,
            ]
    return out


def _geometry(s: SceneSurface) -> np.ndarray:
    row = np.zeros(ROW)
    inverse = s.pose.rotation.T
    row[0:9] = inverse.ravel()
    row[9:12] = -inverse @ s.pose.translation
    row[CLEARANCE], row[INDEX], row[INVERSE] = s.clearance, s.index, 1.0 / s.index
    for k in range(2):  # a single aperture is stored twice
        start = APERTURES + k * APERTURE
        row[start : start + APERTURE] = _aperture(s.apertures[-k] if s.apertures else None)
    return row


def _curves(s: SceneSurface) -> np.ndarray:
    row = np.zeros(CURVES * BLOCK)
    even = s.surface.even
    if len(even) > MOST_EVEN:
        raise ValueError(f"{s.name}: the path tracer takes {MOST_EVEN} aspheric terms, found {len(even)}")
    row[: 2 + len(even)] = [s.surface.curvature, s.surface.conic, *even]
    return row


def _finish(finish: Finish) -> list[float]:
    reflectance, transmission, bare, diffuse, share, scale, exponent, kind = finish.numbers
    area = 1.0 if finish.scatter is None else fresnel_scatter.lobe_area(scale, exponent)
    return [-1.0 if bare else reflectance, transmission, diffuse, share, scale, exponent, kind, area]


def _blocks(numbers: int) -> int:
    """Return the number of memory blocks that hold a given count of numbers."""
    return -(-numbers // BLOCK)


def _terms(surfaces: Sequence[SceneSurface], form: SurfaceForm) -> np.ndarray:
    """Return the numbers of further sag terms of all surfaces, ordered by the kind of term."""
    if not form.terms:
        return np.zeros(1)
    rows = [list(leaves(of_kinds(s.surface.terms, form.terms)).values()) for s in surfaces]
    out = np.zeros((len(surfaces), BLOCK * _blocks(len(rows[0]))))
    out[:, : len(rows[0])] = rows
    return out


def _figures(surfaces: Sequence[SceneSurface], form: SurfaceForm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of polynomial figures and of grids of all surfaces, and the coefficients of all grids."""
    polynomials, grids, samples = np.zeros(1), np.zeros(1), np.zeros(1)
    if form.figure_order >= 0:
        size = 2 + triangle_size(form.figure_order)
        polynomials = np.zeros((len(surfaces), BLOCK * _blocks(size)))
        for i, s in enumerate(surfaces):
            if (terms := s.surface.zernike_figure) is not None:
                numbers = terms.numbers(form.figure_order)
                polynomials[i, :size] = [numbers.x, numbers.y, *numbers.coefficients]
    if form.grid:
        grids, tables = np.zeros((len(surfaces), GRID_ROW)), [np.zeros(64)]
        grids[:, :7] = _NO_GRID
        for i, s in enumerate(surfaces):
            if (grid := s.surface.grid_figure) is not None:
                grids[i, :7] = list(leaves(grid.numbers).values())
                grids[i, 6] = sum(len(table) for table in tables)
                tables.append(grid.spline.ravel())
        samples = np.concatenate(tables)
    return polynomials, grids, samples


def _aperture(aperture: Aperture | None) -> tuple[float, ...]:
    """Return the numbers of an aperture that ``within`` reads; without an aperture, no point is outside."""
    if aperture is None:
        return (0.0, 0.0, np.inf, 0.0, RING)
    match aperture.numbers():
        case DiskNumbers() as disk:
            return (disk.x, disk.y, disk.radius_squared, 0.0, RING)
        case RingNumbers() as ring:
            return (ring.x, ring.y, ring.radius_squared, ring.hole_squared, RING)
        case RectangleNumbers() as box:
            return (box.x, box.y, box.half_x, box.half_y, RECTANGLE)
        case EllipseNumbers() as ellipse:
            return (ellipse.x, ellipse.y, 1.0 / ellipse.half_x, 1.0 / ellipse.half_y, ELLIPSE)
        case other:
            assert_never(other)


def within(x: Any, y: Any, a: Sequence[Any]) -> Any:
    """Return True where x and y, in metres, are inside a clear aperture.

    ``a`` has the ``APERTURE`` numbers of the aperture, which may be of a different shape for each path.
    """
    import drjit as dr

    box = RectangleNumbers(*a[:4]).contains(x, y)
    # divisions are slow, so the table has the reciprocals of the semi-axes
    u, v = (x - a[0]) * a[2], (y - a[1]) * a[3]
    ellipse = dr.fma(u, u, v * v) <= 1.0
    return dr.select(a[4] == RING, RingNumbers(*a[:4]).contains(x, y), dr.select(a[4] == RECTANGLE, box, ellipse))
