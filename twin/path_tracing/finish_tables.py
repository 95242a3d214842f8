"""Measured finishes in the path tracer: coatings and BSDFs as tables in the backend's memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.materials import finish, scatter
from optics.materials.finish import Finish
from optics.materials.scatter import DrawnScatter
from optics.numerics.backend import Backend
from scenes.models.scene_surface import SceneSurface

_HEADER = 8
"""Numbers of a scatter table: rings, sectors, first share, first of the rings' sums, first of the sectors' sums, first
cosine, first azimuth, 1 where half of the draws are mirrored."""
MARKS = 4
"""Numbers of a finish: its coating and its scatter table, each counted from 1 with 0 for none, and 1 where all that it
reflects is what the table scatters."""


@dataclass(frozen=True, eq=False)
class FinishTables:
    """Measured finishes of a scene (Dr.Jit arrays).

    Attributes:
        marks: (surfaces * 3 * MARKS).
        coatings: (coatings * (STEPS + 1) * 2) reflectance and transmittance.
        headers: (scatter tables * _HEADER); numbers: what they point to.
        most_rings, most_sectors: of all tables.
    """

    backend: Backend
    marks: Any
    coatings: Any
    headers: Any
    numbers: Any
    most_rings: int
    most_sectors: int

    def of(self, row: Any, active: Any) -> list[Any]:
        """The marks of each path's finish."""
        return [self._get(self.marks, row * MARKS + k, active) for k in range(MARKS - 1)]

    def shares(self, marks: Sequence[Any], cosine: Any, active: Any) -> tuple[Any, Any]:
        """Reflectance and transmittance of the coatings of paths that have one, by the cosine on the side of air."""
        number, k, w = self._place(marks[0], cosine, finish.STEPS)
        first = 2 * ((finish.STEPS + 1) * number + k)
        has = active & (marks[0] > 0.5)
        low, high = ([self._get(self.coatings, first + n + step, has) for n in (0, 1)] for step in (0, 2))
        return (1.0 - w) * low[0] + w * high[0], (1.0 - w) * low[1] + w * high[1]

    def total(self, marks: Sequence[Any], cosine: Any, active: Any) -> Any:
        """Total integrated scatter of the tables of paths that have one."""
        number, k, w = self._place(marks[1], cosine, scatter.STEPS)
        has = active & (marks[1] > 0.5)
        first = self._uint(self._get(self.headers, _HEADER * number + 2, has)) + k
        return (1.0 - w) * self._get(self.numbers, first, has) + w * self._get(self.numbers, first + 1, has)

    def draw(self, marks: Sequence[Any], cosine: Any, specular: Any, side: Any, u: Sequence[Any], active: Any) -> Any:
        """A scattered direction of paths whose finish has a table.

        Args:
            marks: of their finishes.
            cosine: of incidence.
            specular: unit vector of the specular direction.
            side: unit normal on the side to which the light leaves.
            u: four random numbers.
            active: which paths.
        """
        import drjit as dr

        number, k, w = self._place(marks[1], cosine, scatter.STEPS)
        has = active & (marks[1] > 0.5)
        header = [self._get(self.headers, _HEADER * number + n, has) for n in range(_HEADER)]
        rings, sectors, share, ring_sums, sector_sums, cosines, azimuths = (self._uint(v) for v in header[:7])
        low, high = self._get(self.numbers, share + k, has), self._get(self.numbers, share + k + 1, has)
        # one of the two angles of incidence beside the path's own, by the power that it has there
        upper = u[0] * ((1.0 - w) * low + w * high) < w * high
        k = dr.select(upper, k + 1, k)
        ring, along = self._search(ring_sums + k * (rings + 1), rings, self.most_rings, u[1], has)
        row = sector_sums + (k * rings + ring) * (sectors + 1)
        sector, across = self._search(row, sectors, self.most_sectors, u[2], has)
        c = self._between(cosines + ring, along, has)
        p = self._between(azimuths + sector, across, has)
        p = dr.select((header[7] > 0.5) & (u[3] < 0.5), -p, p)
        lean = side - dr.dot(side, specular) * specular
        # at normal incidence the azimuth starts anywhere
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
        """Number of the table, interval of the angle of incidence and place in it."""
        import drjit as dr

        angle = dr.acos(dr.clip(cosine, 0.0, 1.0)) * (2.0 * steps / np.pi)
        k = dr.minimum(self._uint(angle), steps - 1)
        return self._uint(dr.maximum(mark, 1.0)) - 1, k, angle - self.backend.Float(k)

    def _search(self, first: Any, count: Any, most: int, u: Any, active: Any) -> tuple[Any, Any]:
        """Cell in whose interval of cumulative shares u lies, and where in it."""
        import drjit as dr

        found = dr.binary_search(
            0,
            most - 1,
            lambda i: (i + 1 < count) & (self._get(self.numbers, first + dr.minimum(i, count - 1) + 1, active) <= u),
        )
        low, high = self._get(self.numbers, first + found, active), self._get(self.numbers, first + found + 1, active)
        return found, dr.select(high > low, (u - low) / (high - low), 0.5)

    def _between(self, first: Any, place: Any, active: Any) -> Any:
        low, high = self._get(self.numbers, first, active), self._get(self.numbers, first + 1, active)
        return low + place * (high - low)

    def _get(self, source: Any, index: Any, active: Any) -> Any:
        import drjit as dr

        return dr.gather(self.backend.Float, source, index, active)

    def _uint(self, value: Any) -> Any:
        return self.backend.UInt(value)


def measured(finish: Finish) -> bool:
    """Whether a finish has a table."""
    return finish.coating is not None or finish.table is not None


def upload_finishes(backend: Backend, surfaces: Sequence[SceneSurface]) -> FinishTables | None:
    """The measured finishes of a scene, None where there are none."""
    finishes = [f for s in surfaces for f in (s.front, s.back, s.outside)]
    if not any(measured(f) for f in finishes):
        return None
    # a coating of glass also says what goes through
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
        headers[i] = _header(table.drawn, sum(map(len, numbers)))
        drawn = table.drawn
        numbers += [a.ravel() for a in (drawn.share, drawn.rings, drawn.sectors, drawn.cosines, drawn.azimuths)]
    return FinishTables(
        backend,
        backend.opaque(marks),
        backend.opaque(np.concatenate([c.drawn(through).ravel() for c, through in coats]) if coats else np.zeros(2)),
        backend.opaque(headers),
        backend.opaque(np.concatenate(numbers)),
        max((t.rings for t in tables), default=1),
        max((t.sectors for t in tables), default=1),
    )


def _header(drawn: DrawnScatter, first: int) -> list[float]:
    sizes = [drawn.share.size, drawn.rings.size, drawn.sectors.size, drawn.cosines.size]
    starts = first + np.concatenate([[0], np.cumsum(sizes)])
    rings, sectors = len(drawn.cosines) - 1, len(drawn.azimuths) - 1
    return [float(v) for v in (rings, sectors, *starts, drawn.mirrored)]
