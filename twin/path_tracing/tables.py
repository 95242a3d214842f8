"""The prescription's numbers as flat tables in the backend's memory, one row per surface, looked up by each path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, assert_never

import numpy as np

from optics.geometry.aperture import Aperture, DiskNumbers, EllipseNumbers, RectangleNumbers, RingNumbers
from optics.geometry.sag_terms import SagTerm, kinds_of, of_kinds
from optics.geometry.surface import FigureNumbers, GridNumbers, SurfaceNumbers
from optics.geometry.zernike import triangle_size
from optics.numerics.backend import Backend
from optics.numerics.number_tree import leaves
from scenes.models.scene_surface import SceneSurface
from scenes.models.scenery import Scenery
from twin.path_tracing.finish_tables import FinishTables, upload_finishes

BLOCK = 4
BLOCKS = 8
ROW = BLOCK * BLOCKS
"""Numbers of a geometry row: 0-8 rotation world to local, 9-11 its shift, 12 curvature, 13 conic, 14-16 A4, A6, A8,
17 clearance, 18-27 two clear apertures, 28 refractive index behind, 29 number of the part plus one."""

CLEARANCE, APERTURES, INDEX, PART = 17, 18, 28, 29

APERTURE = 5
"""Numbers of a clear aperture: four that its shape has, and which shape it is."""
RING, RECTANGLE, ELLIPSE = 0.0, 1.0, 2.0

GRID_ROW = 8
_NO_GRID = (0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 0.0)
"""Numbers of a grid for surfaces without one: four by four samples of 0, whose 8 x 8 coefficients head the table."""

FINISH_ROW = 8
ROWS_PER_SURFACE = 3
"""Finishes of a surface: met from +z, met from -z, outside its clear apertures."""

MOST_EVEN = 3
MOST_BODIES = 255
MOST_DETECTORS = 255

NOMINAL_SUMS = 8
"""Sums of the nominal family per detector, one of them unused."""


class Kind:
    """Bits of a surface's kind."""

    SOLID = 1
    ENDS = 2
    BODY_SHIFT, BODY_MASK = 8, 0xFF
    DETECTOR_SHIFT, DETECTOR_MASK = 16, 0xFF


@dataclass(frozen=True)
class SurfaceForm:
    """What the shapes of a scene's surfaces consist of, and with it the kernel's code.

    Attributes:
        even: number of aspheric terms.
        terms: kinds of further terms of the sag.
        figure_order: highest order of a polynomial figure, -1 when there is none.
        grid: some surface has a figure on a grid.
        flat: all surfaces are planes without figure.
    """

    even: int
    terms: tuple[type[SagTerm], ...]
    figure_order: int
    grid: bool
    flat: bool

    @classmethod
    def of(cls, surfaces: Sequence[SceneSurface]) -> SurfaceForm:
        """What is needed for all of them."""
        shapes = [s.surface for s in surfaces]
        order = max((f.order for s in shapes if (f := s.zernike_figure) is not None), default=-1)
        grid = any(s.grid_figure is not None for s in shapes)
        flat = order < 0 and not grid and all(s.is_plane for s in shapes)
        terms = kinds_of([term for s in shapes for term in s.terms])
        return cls(max((len(s.even) for s in shapes), default=0), terms, order, grid, flat)


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Numbers of a scene (Dr.Jit arrays).

    Attributes:
        rows: (surfaces * ROW) geometry; finishes: (surfaces * 3 * FINISH_ROW).
        terms: (surfaces * 4 * blocks) numbers of all kinds of further terms; width 1 when there are none.
        figures: (surfaces * 4 * blocks) centre and coefficients of polynomial figures; width 1 when there are none.
        grids, samples: (surfaces * GRID_ROW) numbers of grid figures and the coefficients of all; likewise.
        kind: (surfaces,) bits; planes: (surfaces * 4) world normal and offset of flat faces.
        body_first, body_faces: (bodies + 1,) first surface and number of faces of each glass body.
        detectors: (detectors * 8) pixels per metre in x and y, columns, rows, first pixel.
        nominal: (detectors,) signature of the nominal family.
        pixels: of all detectors together.
        measured: tables of measured finishes, None where there are none.
    """

    rows: Any
    terms: Any
    figures: Any
    grids: Any
    samples: Any
    finishes: Any
    kind: Any
    planes: Any
    body_first: Any
    body_faces: Any
    detectors: Any
    nominal: Any
    pixels: Any
    block: Any
    measured: FinishTables | None = None

    def geometry(self, surface: Any, active: Any) -> list[Any]:
        """The row of each path's surface, ``ROW`` numbers."""
        return self._row(self.rows, surface, BLOCKS, active)

    def surface(self, number: Any, row: list[Any], form: SurfaceForm, active: Any) -> SurfaceNumbers:
        """The shape of each path's surface, whose row of the geometry is given."""
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
        return SurfaceNumbers(row[12], row[13], tuple(row[14 : 14 + form.even]), tuple(terms), figure, grid)

    def finish(self, row: Any, active: Any) -> list[Any]:
        """The finish of each path's row, ``FINISH_ROW`` numbers."""
        return self._row(self.finishes, row, FINISH_ROW // BLOCK, active)

    def detector(self, number: Any, active: Any) -> list[Any]:
        """The row of each path's detector."""
        return self._row(self.detectors, number, 2, active)

    def plane(self, surface: Any, active: Any) -> list[Any]:
        """World normal (3) and offset of a flat face."""
        return self._row(self.planes, surface, 1, active)

    def _row(self, source: Any, index: Any, blocks: int, active: Any) -> list[Any]:
        import drjit as dr

        out: list[Any] = []
        for k in range(blocks):
            out += list(dr.gather(self.block, source, index * blocks + k, active))
        return out


def upload(backend: Backend, scenery: Scenery, nominal: Mapping[str, int]) -> SceneTables:
    """Tables of a scene.

    Args:
        backend: where to.
        scenery: the surfaces.
        nominal: detector name -> signature of its nominal family.

    Raises:
        ValueError: too many bodies, detectors or aspheric terms.
    """
    import drjit as dr

    surfaces, detectors = scenery.surfaces, scenery.detectors
    bodies = list(dict.fromkeys(s.solid for s in surfaces if s.solid is not None))
    if len(bodies) > MOST_BODIES or len(detectors) > MOST_DETECTORS:
        raise ValueError(f"{len(bodies)} glass bodies, {len(detectors)} detectors: at most {MOST_BODIES} of each")
    unknown = sorted(set(nominal) - {d.name for d in detectors})
    if unknown:
        raise ValueError(f"nominal paths are given for unknown detectors: {', '.join(unknown)}")
    rows = np.zeros((len(surfaces), ROW))
    planes = np.zeros((len(surfaces), BLOCK))
    kind = np.zeros(len(surfaces), np.uint32)
    finishes = np.zeros((len(surfaces), ROWS_PER_SURFACE, FINISH_ROW))
    numbers = {d.name: i + 1 for i, d in enumerate(detectors)}
    parts = scenery.parts
    for i, s in enumerate(surfaces):
        rows[i] = _geometry(s)
        rows[i, PART] = parts.index(s.part) + 1
        normal = s.pose.rotation[:, 2]
        planes[i] = [*normal, normal @ s.pose.translation]
        kind[i] = Kind.SOLID * (s.solid is not None) | Kind.ENDS * s.ends
        if s.solid is not None:
            kind[i] |= (bodies.index(s.solid) + 1) << Kind.BODY_SHIFT
        if s.detector is not None:
            kind[i] |= numbers[s.detector] << Kind.DETECTOR_SHIFT
        finishes[i] = [finish.numbers for finish in (s.front, s.back, s.outside)]
    first, count = np.zeros(len(bodies) + 1, np.uint32), np.zeros(len(bodies) + 1, np.uint32)
    for b, body in enumerate(bodies):
        own = [i for i, s in enumerate(surfaces) if s.solid == body]
        if own != list(range(own[0], own[0] + len(own))):
            raise ValueError(f"the faces of {body!r} do not follow each other")
        first[b + 1], count[b + 1] = own[0], len(own)
    grids = np.zeros((max(len(detectors), 1), 2 * BLOCK))
    place = 0
    for i, d in enumerate(detectors):
        grids[i, :5] = [1.0 / d.pitch[0], 1.0 / d.pitch[1], d.columns, d.rows, place]
        place += d.columns * d.rows
    form = SurfaceForm.of(surfaces)
    figures, placements, samples = _figures(surfaces, form)
    signatures = np.array([nominal.get(d.name, 0) for d in detectors] or [0], np.uint64)
    out = SceneTables(
        backend.opaque(rows),
        backend.opaque(_terms(surfaces, form)),
        backend.opaque(figures),
        backend.opaque(placements),
        backend.opaque(samples),
        backend.opaque(finishes),
        backend.UInt(kind),
        backend.opaque(planes),
        backend.UInt(first),
        backend.UInt(count),
        backend.opaque(grids),
        dr.uint64_array_t(backend.Float)(signatures),
        backend.UInt(place),
        import_module(f"drjit.{backend.name}.ad").Array4f64,
        upload_finishes(backend, surfaces),
    )
    dr.make_opaque(out.kind, out.body_first, out.body_faces, out.nominal, out.pixels)
    return out


def _geometry(s: SceneSurface) -> np.ndarray:
    row = np.zeros(ROW)
    inverse = s.pose.rotation.T
    row[0:9] = inverse.ravel()
    row[9:12] = -inverse @ s.pose.translation
    even = s.surface.even
    if len(even) > MOST_EVEN:
        raise ValueError(f"{s.name}: the path tracer takes {MOST_EVEN} aspheric terms, found {len(even)}")
    row[12], row[13] = s.surface.curvature, s.surface.conic
    row[14 : 14 + len(even)] = even
    row[CLEARANCE], row[INDEX] = s.clearance, s.index
    for k in range(2):  # one alone counts twice
        start = APERTURES + k * APERTURE
        row[start : start + APERTURE] = _aperture(s.apertures[-k] if s.apertures else None)
    return row


def _blocks(numbers: int) -> int:
    """Blocks that a row of so many numbers takes."""
    return -(-numbers // BLOCK)


def _terms(surfaces: Sequence[SceneSurface], form: SurfaceForm) -> np.ndarray:
    """Rows of further terms of the sag, kind by kind."""
    if not form.terms:
        return np.zeros(1)
    rows = [list(leaves(of_kinds(s.surface.terms, form.terms)).values()) for s in surfaces]
    out = np.zeros((len(surfaces), BLOCK * _blocks(len(rows[0]))))
    out[:, : len(rows[0])] = rows
    return out


def _figures(surfaces: Sequence[SceneSurface], form: SurfaceForm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of polynomial figures and of grids, and the coefficients of all grids."""
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
    """The numbers that ``within`` reads; nothing is outside of no aperture."""
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
            return (ellipse.x, ellipse.y, ellipse.half_x, ellipse.half_y, ELLIPSE)
        case other:
            assert_never(other)


def within(x: Any, y: Any, a: Sequence[Any]) -> Any:
    """Inside a clear aperture, whose numbers (``APERTURE`` of a row) may be those of another shape for each path."""
    import drjit as dr

    box, ellipse = RectangleNumbers(*a[:4]).contains(x, y), EllipseNumbers(*a[:4]).contains(x, y)
    return dr.select(a[4] == RING, RingNumbers(*a[:4]).contains(x, y), dr.select(a[4] == RECTANGLE, box, ellipse))
