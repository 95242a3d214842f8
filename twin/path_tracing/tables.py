"""The prescription's numbers as flat tables in the backend's memory, one row per surface, looked up by each path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Rectangle
from optics.numerics.backend import Backend
from scenes.models.scene_surface import SceneSurface
from scenes.models.scenery import Scenery

BLOCK = 4
BLOCKS = 8
ROW = BLOCK * BLOCKS
"""Numbers of a geometry row: 0-8 rotation world to local, 9-11 its shift, 12 curvature, 13 1 + conic, 14-16 A4, A6, A8,
17 clearance, 18-29 two clear apertures, 30 refractive index behind, 31 number of the part plus one."""

CLEARANCE, APERTURES, INDEX, PART = 17, 18, 30, 31

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


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Numbers of a scene (Dr.Jit arrays).

    Attributes:
        rows: (surfaces * ROW) geometry; finishes: (surfaces * 3 * FINISH_ROW).
        kind: (surfaces,) bits; planes: (surfaces * 4) world normal and offset of flat faces.
        body_first, body_faces: (bodies + 1,) first surface and number of faces of each glass body.
        detectors: (detectors * 8) pixels per metre in x and y, columns, rows, first pixel.
        nominal: (detectors,) signature of the nominal family.
        pixels: of all detectors together.
    """

    rows: Any
    finishes: Any
    kind: Any
    planes: Any
    body_first: Any
    body_faces: Any
    detectors: Any
    nominal: Any
    pixels: Any
    block: Any

    def geometry(self, surface: Any, active: Any) -> list[Any]:
        """The row of each path's surface, ``ROW`` numbers."""
        return self._row(self.rows, surface, BLOCKS, active)

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
    signatures = np.array([nominal.get(d.name, 0) for d in detectors] or [0], np.uint64)
    out = SceneTables(
        backend.opaque(rows),
        backend.opaque(finishes),
        backend.UInt(kind),
        backend.opaque(planes),
        backend.UInt(first),
        backend.UInt(count),
        backend.opaque(grids),
        dr.uint64_array_t(backend.Float)(signatures),
        backend.UInt(place),
        import_module(f"drjit.{backend.name}.ad").Array4f64,
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
    row[12], row[13] = s.surface.curvature, 1.0 + s.surface.conic
    row[14 : 14 + len(even)] = even
    row[CLEARANCE], row[INDEX] = s.clearance, s.index
    row[APERTURES : APERTURES + 6] = _aperture(s.apertures[0] if s.apertures else None)
    row[APERTURES + 6 : APERTURES + 12] = _aperture(s.apertures[-1] if s.apertures else None)
    return row


def _aperture(aperture: Aperture | None) -> tuple[float, ...]:
    """Centre, inverse half-sizes, 1 for round, square of the hole's relative radius."""
    if aperture is None:
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    x, y = aperture.centre
    if isinstance(aperture, Circle):
        return (x, y, 1.0 / aperture.radius, 1.0 / aperture.radius, 1.0, (aperture.inner / aperture.radius) ** 2)
    return (x, y, 1.0 / aperture.half_x, 1.0 / aperture.half_y, float(not isinstance(aperture, Rectangle)), 0.0)
