"""Noise of measured attitude and station that image points of a pass share, by the laws of its readings.

Points exposed within a few readings have errors in common. The unknowns of the laws (`analysis.block.processes`) are
unknowns of an adjustment with a sparse prior, and the correlation of any two image points is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from analysis.block.corrections import Corrections, Part
from analysis.block.processes import Law, Support
from analysis.orbit.calibration_parameters import CalibrationField, Noise, NoiseTerm
from analysis.orbit.three_line_model import Partials, Rays

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """The laws of all fields, and how the rays meet their unknowns.

    Attributes:
        parts: field -> its laws. Station and offsets of it are along the axes of the ITRS.
        met: (field, line) -> the corrections of its rays; lines without times have none.
        spans: first and last + 1 unknown of each field.
        groups: variance group -> its unknowns.
        precision: (K, K) sparse, of all unknowns.
    """

    parts: Mapping[str, tuple[Part, ...]]
    met: Mapping[tuple[str, str], Corrections]
    spans: tuple[tuple[int, int], ...]
    groups: Mapping[str, NDArray[np.intp]]
    precision: sparse.csr_matrix

    @classmethod
    def of(cls, fields: Sequence[CalibrationField], noise: Noise) -> SharedNoise:
        """What the rays with times share; no unknowns where there are no times or no intervals."""
        parts: dict[str, tuple[Part, ...]] = {}
        met: dict[tuple[str, str], Corrections] = {}
        spans, blocks, column = [], [], 0
        groups: dict[str, list[NDArray[np.intp]]] = {}
        for one in fields:
            times = {line: r.time for line, r in one.rays.items() if r.time is not None and r.point.size}
            begin, mine = column, []
            for term in noise.terms if times else ():
                if term.interval is None:
                    continue
                support = Support.of(_law(term, term.interval), np.concatenate(list(times.values())))
                mine.append(Part(term.kind == "attitude", column, support))
                blocks.append(sparse.kron(support.precision, sparse.eye(3)))
                groups.setdefault(term.group, []).append(np.arange(column, column + support.size))
                column += support.size
            parts[one.name] = tuple(mine)
            met |= {(one.name, line): Corrections(tuple(mine), np.eye(3), time) for line, time in times.items()}
            spans.append((begin, column))
        precision = sparse.csr_matrix(sparse.block_diag(blocks)) if blocks else sparse.csr_matrix((0, 0))
        return cls(parts, met, tuple(spans), {k: np.concatenate(v) for k, v in groups.items()}, precision)

    @property
    def size(self) -> int:
        """K, unknowns."""
        return self.precision.shape[0]

    def corrected(self, name: str, line: str, rays: Rays, shared: Array) -> Rays:
        """Rays of a line of a field with the corrections (K,) applied.

        Args:
            name: of the field.
            line: of the camera.
            rays: of that line.
            shared: corrections of the noise that points share, (K,).
        """
        return _moved(rays, self.met.get((name, line)), shared)

    def corrected_at(self, name: str, rays: Rays, shared: Array) -> Rays:
        """Other rays of a field, with times.

        Args:
            name: of the field.
            rays: with times.
            shared: corrections of the noise that points share, (K,).
        """
        assert rays.time is not None
        return _moved(rays, Corrections(self.parts[name], np.eye(3), rays.time), shared)

    def rows(self, name: str, line: str, white: Array, by: Partials) -> sparse.csr_matrix:
        """Whitened rows (2n, K) of the rays of a line of a field.

        Args:
            name: of the field.
            line: of the camera.
            white: (n, 2, 2) whitens the misclosures of n rays.
            by: their derivatives.
        """
        count, met = len(white), self.met.get((name, line))
        if met is None:
            return sparse.csr_matrix((2 * count, self.size))
        slopes, columns = met.slopes(white @ by.attitude, -white @ by.ground), met.columns
        indices = np.repeat(columns[:, None], 2, axis=1).ravel()
        starts = columns.shape[1] * np.arange(2 * count + 1)
        return sparse.csr_matrix((slopes.ravel(), indices, starts), shape=(2 * count, self.size))


def _law(term: NoiseTerm, interval: float) -> Law:
    return Law(term.group, "walk" if term.walks else "white", (term.sigma,) * 3, interval)


def _moved(rays: Rays, met: Corrections | None, shared: Array) -> Rays:
    if met is None or not met.parts:
        return rays
    turn, shift = met.at(shared)
    turns = Rotation.from_rotvec(turn).as_matrix()
    return replace(rays, attitude=rays.attitude @ turns, station=rays.station + shift @ met.axes.T)
