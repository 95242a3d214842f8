"""What comes out of a path-traced run: families of paths at the detectors, images, and where all the light went; the
arrays that the kernel writes to, and how the launches of a run are added up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.scenery import Scenery
from twin.path_tracing.path_families import Touch
from twin.path_tracing.tables import NOMINAL_SUMS, ROWS_PER_SURFACE, Kind, SceneTables

NOMINAL, GHOST, STRAY = range(3)
CLASSES = 3
"""What a detected path was: of the nominal family, of another one without scattering, scattered somewhere."""


@dataclass(frozen=True, eq=False)
class Sinks:
    """Targets of a launch.

    Attributes
    ----------
    absorbed : Any
        (rows of finishes,) weight, detected light included.
    left : Any
        (3,) weight escaped to infinity, weight still under way at the step limit, weight at the start.
    sums : Any
        (detectors * NOMINAL_SUMS) count, weight, its square, weighted x, y, x^2, y^2 of the nominal family.
    images : Any
        (CLASSES * pixels of all detectors) weight.
    counter : Any
        (1,) number of records asked for.
    records : dict[str, Any]
        ``signature``, ``path``, ``detector``, ``x``, ``y``, ``weight``, ``length``, ``kind``, each (room,).
    log : Any
        (paths * steps) code of every event, or None.
    room : int
        Of the records.
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


@dataclass(frozen=True)
class Family:
    """All paths that reached a detector by the same events in the same order.

    Attributes
    ----------
    detector : str
        Its name.
    touches : tuple[Touch, ...]
        The events before it; empty when it was not looked up.
    kind : str
        ``nominal``, ``ghost`` (another way without scattering) or ``stray`` (scattered or diffused somewhere).
    energy : float
        Detected share of the emitted power; error: its standard error.
    count : int
        paths.
    centroid : tuple[float, float]
        x, y in the detector's frame, metres.
    rms : tuple[float, float]
        Root-mean-square size along x and y about the centroid, metres.
    """

    detector: str
    touches: tuple[Touch, ...]
    kind: str
    energy: float
    error: float
    count: int
    centroid: tuple[float, float]
    rms: tuple[float, float]

    @property
    def text(self) -> str:
        """The family in one line."""
        return " ".join(str(t) for t in self.touches) or "(not looked up)"


KINDS = {NOMINAL: "nominal", GHOST: "ghost", STRAY: "stray"}


@dataclass(frozen=True)
class Balance:
    """Where the emitted power went.

    Attributes
    ----------
    emitted : float
        Sum of the paths' weights at their start.
    absorbed : Mapping[str, float]
        Part -> power absorbed in it; detected: detector -> power detected.
    escaped : float
        To infinity; under_way: still on its way at the step limit.
    """

    emitted: float
    absorbed: Mapping[str, float]
    detected: Mapping[str, float]
    escaped: float
    under_way: float

    @property
    def error(self) -> float:
        """What is missing, relative to the emitted power; exactly 0 up to rounding unless roulette or floors are on."""
        total = sum(self.absorbed.values()) + sum(self.detected.values()) + self.escaped + self.under_way
        return float(total / self.emitted - 1.0)


@dataclass(frozen=True, eq=False)
class Detections:
    """Single detections: arrays of one entry each.

    Attributes
    ----------
    path : np.ndarray
        Number of the path; detector: index of the detector.
    place : np.ndarray
        (N, 2) x, y in the detector's frame, metres.
    weight : np.ndarray
        Detected power; length: optical path, metres.
    signature : np.ndarray
        Of the family; kind: ``NOMINAL``, ``GHOST`` or ``STRAY``.
    """

    path: np.ndarray
    detector: np.ndarray
    place: np.ndarray
    weight: np.ndarray
    length: np.ndarray
    signature: np.ndarray
    kind: np.ndarray


@dataclass(frozen=True, eq=False)
class PathResult:
    """Outcome of a run, in shares of the emitted power.

    Attributes
    ----------
    families : tuple[Family, ...]
        By falling energy; nominal families first.
    images : Mapping[str, np.ndarray]
        Detector -> (3, rows, columns) power per pixel: nominal, ghost, stray.
    balance : Balance
        Of the power.
    paths : int
        Number traced.
    detections : Detections
        Single detections that were kept: all but the nominal families', or all.
    """

    families: tuple[Family, ...]
    images: Mapping[str, np.ndarray]
    balance: Balance
    paths: int
    detections: Detections

    def of(self, detector: str, kind: str) -> tuple[Family, ...]:
        """Families of one kind at one detector, by falling energy."""
        return tuple(f for f in self.families if f.detector == detector and f.kind == kind)

    def nominal(self, detector: str) -> Family:
        """The nominal family of a detector.

        Raises
        ------
        LookupError
            No path came to it by the nominal way.
        """
        found = self.of(detector, "nominal")
        if not found:
            raise LookupError(f"no path reached {detector} by its nominal way")
        return found[0]


SUMS = 7
"""Count, weight, its square, weighted x, y, x^2, y^2."""


@dataclass(frozen=True)
class Key:
    """A family before it is looked up: index of the detector, signature, kind."""

    detector: int
    signature: int
    kind: int


class Collector:
    """Adds up what launches have written; one per run.

    Parameters
    ----------
    scenery
        The scene.
    nominal
        Signature of the nominal family of each detector, 0 for none.
    keep
        Whether to keep single detections.
    """

    def __init__(self, scenery: Scenery, nominal: Sequence[int], keep: bool = False) -> None:
        self.keep = keep
        self.scenery = scenery
        self.nominal = tuple(nominal)
        self.absorbed = np.zeros((len(scenery.surfaces), ROWS_PER_SURFACE))
        self.left = np.zeros(3)
        self.images = np.zeros((CLASSES, sum(d.columns * d.rows for d in scenery.detectors)))
        self.sums: dict[Key, np.ndarray] = {}
        self.examples: dict[Key, int] = {}
        self.emitted = 0.0
        self.paths = 0
        self._kept: list[dict[str, np.ndarray]] = []

    def add(self, sinks: Sinks, emitted: float, paths: int) -> tuple[np.ndarray, np.ndarray]:
        """Add one launch; returns path numbers and weights of what was detected off the nominal families."""
        self.absorbed += sinks.absorbed.numpy().reshape(self.absorbed.shape)
        self.left += sinks.left.numpy()
        if self.images.size:
            self.images += sinks.images.numpy().reshape(self.images.shape)
        self.emitted += emitted
        self.paths += paths
        sums = sinks.sums.numpy().reshape(-1, NOMINAL_SUMS)
        for detector, signature in enumerate(self.nominal):
            if sums[detector, 0] > 0.0:
                self._put(Key(detector, signature, NOMINAL), sums[detector, :SUMS], -1)
        count = int(sinks.counter.numpy()[0])
        records = {name: array.numpy()[:count] for name, array in sinks.records.items()}
        # threads write in any order
        order = np.lexsort((records["length"], records["path"]))
        records = {name: values[order] for name, values in records.items()}
        if self.keep:
            self._kept.append(records)
        others = {name: values[records["kind"] != NOMINAL] for name, values in records.items()}
        if len(others["path"]):
            self._sort_in(others)
        return others["path"], others["weight"]

    def _put(self, key: Key, sums: np.ndarray, example: int) -> None:
        self.sums[key] = self.sums.get(key, 0.0) + sums
        self.examples.setdefault(key, example)

    def _sort_in(self, r: dict[str, np.ndarray]) -> None:
        """Add detections off the nominal families to the sums of theirs."""
        label = np.stack([r["signature"], r["detector"].astype(np.uint64), r["kind"].astype(np.uint64)], axis=-1)
        keys, first, family = np.unique(label, axis=0, return_index=True, return_inverse=True)
        family = family.ravel()
        w, x, y = r["weight"], r["x"], r["y"]
        columns = (np.ones_like(w), w, w * w, w * x, w * y, w * x * x, w * y * y)
        sums = np.stack([np.bincount(family, c, len(keys)) for c in columns], axis=-1)
        for k, (signature, detector, kind) in enumerate(keys.tolist()):
            self._put(Key(detector, signature, kind), sums[k], int(r["path"][first[k]]))

    def strongest(self, most: int) -> list[Key]:
        """The families that carry most energy and whose ways are not known beforehand."""
        keys = [k for k in self.sums if k.kind != NOMINAL]
        return sorted(keys, key=lambda k: -self.sums[k][1])[:most]

    def result(self, ways: dict[Key, tuple[Touch, ...]]) -> PathResult:
        """The run's outcome; ``ways`` names the events of the families that were looked up."""
        surfaces, detectors = self.scenery.surfaces, self.scenery.detectors
        absorbed: dict[str, float] = {}
        detected = {d.name: 0.0 for d in detectors}
        for surface, rows in zip(surfaces, self.absorbed, strict=True):
            seen = float(rows[0]) if surface.detector is not None else 0.0
            if surface.detector is not None:
                detected[surface.detector] += seen
            stays = float(rows.sum()) - seen
            if stays:
                absorbed[surface.part] = absorbed.get(surface.part, 0.0) + stays
        images = {}
        place = 0
        for d in detectors:
            size = d.columns * d.rows
            images[d.name] = self.images[:, place : place + size].reshape(CLASSES, *d.shape)
            place += size
        balance = Balance(self.emitted, absorbed, detected, float(self.left[0]), float(self.left[1]))
        families = [self._family(key, ways.get(key, ())) for key in self.sums]
        families.sort(key=lambda f: (f.kind != "nominal", -f.energy))
        return PathResult(tuple(families), images, balance, self.paths, self._detections())

    def _family(self, key: Key, way: tuple[Touch, ...]) -> Family:
        count, w, w2, wx, wy, wxx, wyy = self.sums[key].tolist()
        x, y = wx / w, wy / w
        rms = tuple(float(np.sqrt(max(second / w - mean * mean, 0.0))) for second, mean in ((wxx, x), (wyy, y)))
        # of a sum of independent weights, most of them 0
        error = float(np.sqrt(max(w2 - w * w / self.paths, 0.0)))
        name = self.scenery.detectors[key.detector].name
        return Family(name, way, KINDS[key.kind], w, error, round(count), (x, y), (rms[0], rms[1]))

    def _detections(self) -> Detections:
        def joined(name: str) -> np.ndarray:
            return np.concatenate([k[name] for k in self._kept]) if self._kept else np.empty(0)

        names = ("path", "detector", "weight", "length", "signature", "kind")
        place = np.stack([joined("x"), joined("y")], axis=-1)
        return Detections(place=place, **{name: joined(name) for name in names})
