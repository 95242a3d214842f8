"""Arrays that the path tracer's kernel writes to: absorbed light, images, sums of the nominal family, records of
everything else that is detected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optics.numerics.backend import Backend
from twin.path_tracing.tables import NOMINAL_SUMS, Kind, SceneTables

NOMINAL, GHOST, STRAY = range(3)
CLASSES = 3
"""What a detected path was: of the nominal family, of another one without scattering, scattered somewhere."""


@dataclass(frozen=True, eq=False)
class Sinks:
    """Targets of a launch.

    Attributes:
        absorbed: (rows of finishes,) weight, detected light included.
        left: (3,) weight escaped to infinity, weight still under way at the step limit, weight at the start.
        sums: (detectors * NOMINAL_SUMS) count, weight, its square, weighted x, y, x^2, y^2 of the nominal family.
        images: (CLASSES * pixels of all detectors) weight.
        counter: (1,) number of records asked for.
        records: ``signature``, ``path``, ``detector``, ``x``, ``y``, ``weight``, ``length``, ``kind``, each (room,).
        log: (paths * steps) code of every event, or None.
        room: of the records.
    """

    absorbed: Any
    left: Any
    sums: Any
    images: Any
    counter: Any
    records: dict[str, Any]
    log: Any
    room: int

    @property
    def arrays(self) -> list[Any]:
        """Everything that a launch writes to."""
        out = [self.absorbed, self.left, self.sums, self.images, self.counter, *self.records.values()]
        return out if self.log is None else [*out, self.log]


def make_sinks(backend: Backend, rows: int, detectors: int, pixels: int, room: int, log: int = 0) -> Sinks:
    """Empty targets; ``log`` is the number of events of all paths together, 0 for none."""
    import drjit as dr

    Float, UInt = backend.Float, backend.UInt
    UInt64 = dr.uint64_array_t(Float)
    kinds = {"signature": UInt64, **dict.fromkeys(("path", "detector", "kind"), UInt)}
    kinds |= dict.fromkeys(("x", "y", "weight", "length"), Float)
    out = Sinks(
        dr.zeros(Float, rows),
        dr.zeros(Float, 3),
        dr.zeros(Float, max(detectors, 1) * NOMINAL_SUMS),
        dr.zeros(Float, max(CLASSES * pixels, 1)),
        dr.zeros(UInt, 1),
        {name: dr.zeros(kind, room) for name, kind in kinds.items()},
        dr.zeros(UInt, log) if log else None,
        room,
    )
    dr.make_opaque(out.arrays)
    return out


@dataclass(frozen=True, eq=False)
class Arrival:
    """Light that arrives at surfaces: place in the surface's x, y, absorbed weight, and the path so far."""

    x: Any
    y: Any
    weight: Any
    length: Any
    signature: Any
    stray: Any
    path: Any


def record(
    backend: Backend,
    tables: SceneTables,
    sinks: Sinks,
    room: Any,
    kind: Any,
    active: Any,
    at: Arrival,
    keep_nominal: bool,
) -> None:
    """Add what detectors detect: to their images, to the sums of the nominal family, to the records."""
    import drjit as dr

    Float, UInt = backend.Float, backend.UInt
    detector = kind >> Kind.DETECTOR_SHIFT & Kind.DETECTOR_MASK
    detected = active & (detector != 0) & (at.weight > 0.0)

    def write(unused: Any) -> tuple[Any]:
        number = dr.select(detected, detector - 1, 0)
        grid = tables.detector(number, detected)
        nominal = detected & (at.signature == dr.gather(type(at.signature), tables.nominal, number, detected))
        what = dr.select(nominal, UInt(NOMINAL), dr.select(at.stray, UInt(STRAY), GHOST))
        column = dr.floor(dr.fma(at.x, grid[0], 0.5 * grid[2]))
        row = dr.floor(dr.fma(at.y, grid[1], 0.5 * grid[3]))
        on_grid = detected & (column >= 0.0) & (column < grid[2]) & (row >= 0.0) & (row < grid[3])
        pixel = UInt(dr.select(on_grid, dr.fma(row, grid[2], column) + grid[4], 0.0))
        dr.scatter_add(sinks.images, at.weight, what * tables.pixels + pixel, on_grid)
        first = NOMINAL_SUMS * number
        wx, wy = at.weight * at.x, at.weight * at.y
        for k, value in enumerate((Float(1.0), at.weight, at.weight * at.weight, wx, wy, wx * at.x, wy * at.y)):
            dr.scatter_add(sinks.sums, value, first + k, nominal)
        wanted = detected if keep_nominal else detected & ~nominal
        slot = dr.scatter_inc(sinks.counter, UInt(0), wanted)
        fits = wanted & (slot < room)
        values = {name: getattr(at, name) for name in ("signature", "path", "x", "y", "weight", "length")}
        values |= {"detector": number, "kind": what}
        for name, value in values.items():
            dr.scatter(sinks.records[name], value, slot, fits)
        return (unused,)

    dr.if_stmt((UInt(0),), detected, write, lambda unused: (unused,), label="record", mode="symbolic")
