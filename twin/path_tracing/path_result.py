"""Result of a path-traced run: families of paths at the detectors, images, and the energy balance.

The module also has the arrays that the kernel writes to, and the sum over the launches of a run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.scenery import Scenery
from twin.path_tracing.path_families import SurfaceEvent
from twin.path_tracing.tables import NOMINAL_SUMS, ROWS_PER_SURFACE, Kind, SceneTables

NOMINAL, GHOST, STRAY = range(3)
CLASSES = 3
"""Number of classes of detected paths: nominal path; another path without scattering (ghost); scattered (stray light).
"""


@dataclass(frozen=True, eq=False)
class Accumulators:
    """Arrays that a launch adds to.

    Attributes
    ----------
    absorbed : Dr.Jit array
        (surface finishes,) weight absorbed at each, detected light included.
    left : Dr.Jit array
        (3,) weight escaped to infinity, weight still under way at the step limit, weight at the start.
    sums : Dr.Jit array
        (detectors * NOMINAL_SUMS) sums over the detections of nominal light: count, weight, its square, weighted x, y,
        x^2, y^2.
    images : Dr.Jit array
        (CLASSES * pixels of all detectors) weight.
    counter : Dr.Jit array
        (1,) number of detections to record.
    records : dict of str to Dr.Jit array
        ``signature``, ``path``, ``detector``, ``x``, ``y``, ``weight``, ``length``, ``kind``, each (capacity,).
    log : Dr.Jit array or None
        (paths * steps) code of every event; None if events are not recorded.
    capacity : int
        Number of detections that can be recorded.
    """

    absorbed: Any
    left: Any
    sums: Any
    images: Any
    counter: Any
    records: dict[str, Any]
    log: Any
    capacity: int

    @property
    def arrays(self) -> list[Any]:
        """All arrays that a launch (group of paths traced together) writes to."""
        out = [self.absorbed, self.left, self.sums, self.images, self.counter, *self.records.values()]
        return out if self.log is None else [*out, self.log]


def make_accumulators(
    backend: Backend, rows: int, detectors: int, pixels: int, capacity: int, log: int = 0
) -> Accumulators:
    """Return accumulators of zeros for a launch.

    Parameters
    ----------
    backend : Backend
        Backend that holds the arrays.
    rows : int
        Number of surface finishes.
    detectors : int
        Number of detectors.
    pixels : int
        Number of pixels of all detectors together.
    capacity : int
        Number of detections that can be recorded.
    log : int
        Number of events of all paths together that are recorded; 0 for none.
    """
    import drjit as dr

    Float, UInt = backend.Float, backend.UInt
    UInt64 = dr.uint64_array_t(Float)
    kinds = {"signature": UInt64, **dict.fromkeys(("path", "detector", "kind"), UInt)}
    kinds |= dict.fromkeys(("x", "y", "weight", "length"), Float)
    out = Accumulators(
        dr.zeros(Float, rows),
        dr.zeros(Float, 3),
        dr.zeros(Float, max(detectors, 1) * NOMINAL_SUMS),
        dr.zeros(Float, max(CLASSES * pixels, 1)),
        dr.zeros(UInt, 1),
        {name: dr.zeros(kind, capacity) for name, kind in kinds.items()},
        dr.zeros(UInt, log) if log else None,
        capacity,
    )
    dr.make_opaque(out.arrays)
    return out


@dataclass(frozen=True, eq=False)
class Arrival:
    """Light that arrives at a surface: where in its x, y (metres), the weight it absorbs, and the path's history."""

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
    accumulators: Accumulators,
    capacity: Any,
    kind: Any,
    active: Any,
    at: Arrival,
    keep_nominal: bool,
) -> None:
    """Add detected light to the detectors' images, to the sums of nominal light, and to the list of detections.

    Detections of nominal light are listed only if ``keep_nominal``; at most ``capacity`` are listed.
    """
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
        dr.scatter_add(accumulators.images, at.weight, what * tables.pixels + pixel, on_grid)
        first = NOMINAL_SUMS * number
        wx, wy = at.weight * at.x, at.weight * at.y
        for k, value in enumerate((Float(1.0), at.weight, at.weight * at.weight, wx, wy, wx * at.x, wy * at.y)):
            dr.scatter_add(accumulators.sums, value, first + k, nominal)
        wanted = detected if keep_nominal else detected & ~nominal
        slot = dr.scatter_inc(accumulators.counter, UInt(0), wanted)
        fits = wanted & (slot < capacity)
        values = {name: getattr(at, name) for name in ("signature", "path", "x", "y", "weight", "length")}
        values |= {"detector": number, "kind": what}
        for name, value in values.items():
            dr.scatter(accumulators.records[name], value, slot, fits)
        return (unused,)

    dr.if_stmt((UInt(0),), detected, write, lambda unused: (unused,), label="record", mode="symbolic")


@dataclass(frozen=True)
class Family:
    """Paths that reached a detector by the same events in the same order.

    Attributes
    ----------
    detector : str
        Name of the detector.
    surface_events : tuple of SurfaceEvent
        Events before it; empty if they were not looked up.
    kind : str
        ``nominal``, ``ghost`` (other surfaces without scattering) or ``stray`` (scattered or diffused somewhere).
    energy : float
        Detected share of the emitted power.
    error : float
        Standard error of ``energy`` due to the finite number of paths.
    count : int
        Number of paths.
    centroid : (float, float)
        Centroid x, y in the detector's frame, metres.
    rms : (float, float)
        RMS size along x and y about the centroid, metres.
    """

    detector: str
    surface_events: tuple[SurfaceEvent, ...]
    kind: str
    energy: float
    error: float
    count: int
    centroid: tuple[float, float]
    rms: tuple[float, float]

    @property
    def text(self) -> str:
        """Events of the family in one line: names of surfaces with a character for the kind of event."""
        return " ".join(str(t) for t in self.surface_events) or "(not identified)"


KINDS = {NOMINAL: "nominal", GHOST: "ghost", STRAY: "stray"}


@dataclass(frozen=True)
class Balance:
    """Energy balance: where the emitted power of all paths ends.

    Attributes
    ----------
    emitted : float
        Sum of the paths' weights at their start.
    absorbed : Mapping[str, float]
        Part -> power absorbed in it.
    detected : Mapping[str, float]
        Detector -> power detected.
    escaped : float
        Power that escaped to infinity.
    under_way : float
        Power of paths that reached the step limit.
    """

    emitted: float
    absorbed: Mapping[str, float]
    detected: Mapping[str, float]
    escaped: float
    under_way: float

    @property
    def error(self) -> float:
        """Missing power relative to the emitted power.

        It is 0 up to rounding, unless roulette or smallest probabilities of directions are used.
        """
        total = sum(self.absorbed.values()) + sum(self.detected.values()) + self.escaped + self.under_way
        return float(total / self.emitted - 1.0)


@dataclass(frozen=True, eq=False)
class Detections:
    """Single detections of N paths, as arrays with an entry for each.

    Attributes
    ----------
    path : ndarray
        Number of the path.
    detector : ndarray
        Index of the detector.
    place : (N, 2) ndarray
        Position x, y in the detector's frame, metres.
    weight : ndarray
        Detected power, relative to the emitted power.
    length : ndarray
        Optical path, metres.
    signature : ndarray
        Hash of the path's events, the same for all paths of a family.
    kind : ndarray
        ``NOMINAL``, ``GHOST`` or ``STRAY``.
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
    """Result of a run, in shares of the emitted power.

    Attributes
    ----------
    families : tuple of Family
        Families by falling energy; nominal families first.
    images : Mapping[str, (3, rows, columns) ndarray]
        Detector -> power per pixel: nominal, ghost, stray.
    balance : Balance
        Energy balance.
    paths : int
        Number of traced paths.
    detections : Detections
        Single detections: all those of ghosts and stray light, and those of nominal light only if requested.
    """

    families: tuple[Family, ...]
    images: Mapping[str, np.ndarray]
    balance: Balance
    paths: int
    detections: Detections

    def of(self, detector: str, kind: str) -> tuple[Family, ...]:
        """Return the path families of one kind (nominal, ghost or stray) at one detector, the strongest first."""
        return tuple(f for f in self.families if f.detector == detector and f.kind == kind)

    def nominal(self, detector: str) -> Family:
        """Return the nominal family of a detector: the paths that met the surfaces of nominal light in its order.

        Raises
        ------
        LookupError
            No path reached the detector along its nominal surfaces.
        """
        families = self.of(detector, "nominal")
        if not families:
            raise LookupError(f"no path reached {detector} along its nominal surfaces")
        return families[0]


SUMS = 7
"""Number of sums over the paths of a family: count, weight, its square, weighted x, y, x^2, y^2."""


@dataclass(frozen=True)
class Key:
    """Key of a family of paths whose events are not known yet: index of the detector, hash of the events, and kind."""

    detector: int
    signature: int
    kind: int


class Collector:
    """Sum of detections and power over the launches of a run.

    Parameters
    ----------
    scenery : Scenery
        Scene.
    nominal : Sequence[int]
        Hash of the events of the nominal family of each detector; 0 if it has none.
    keep : bool
        Keep single detections.
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

    def add(self, accumulators: Accumulators, emitted: float, paths: int) -> tuple[np.ndarray, np.ndarray]:
        """Add the results of a launch; return numbers and weights of the paths detected off the nominal path."""
        self.absorbed += accumulators.absorbed.numpy().reshape(self.absorbed.shape)
        self.left += accumulators.left.numpy()
        if self.images.size:
            self.images += accumulators.images.numpy().reshape(self.images.shape)
        self.emitted += emitted
        self.paths += paths
        sums = accumulators.sums.numpy().reshape(-1, NOMINAL_SUMS)
        for detector, signature in enumerate(self.nominal):
            if sums[detector, 0] > 0.0:
                self._put(Key(detector, signature, NOMINAL), sums[detector, :SUMS], -1)
        count = int(accumulators.counter.numpy()[0])
        records = {name: array.numpy()[:count] for name, array in accumulators.records.items()}
        # threads write records in random order
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
        """Add each detection off the nominal path to the sums of its family (paths with the same events)."""
        label = np.stack([r["signature"], r["detector"].astype(np.uint64), r["kind"].astype(np.uint64)], axis=-1)
        keys, first, family = np.unique(label, axis=0, return_index=True, return_inverse=True)
        family = family.ravel()
        w, x, y = r["weight"], r["x"], r["y"]
        columns = (np.ones_like(w), w, w * w, w * x, w * y, w * x * x, w * y * y)
        sums = np.stack([np.bincount(family, c, len(keys)) for c in columns], axis=-1)
        for k, (signature, detector, kind) in enumerate(keys.tolist()):
            self._put(Key(detector, signature, kind), sums[k], int(r["path"][first[k]]))

    def strongest(self, most: int) -> list[Key]:
        """Return the ``most`` families with the largest detected power among those whose events are still unknown."""
        keys = [k for k in self.sums if k.kind != NOMINAL]
        return sorted(keys, key=lambda k: -self.sums[k][1])[:most]

    def result(self, family_events: dict[Key, tuple[SurfaceEvent, ...]]) -> PathResult:
        """Return the result of the run; ``family_events`` has the events of the families that were looked up."""
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
        first = 0
        for d in detectors:
            size = d.columns * d.rows
            images[d.name] = self.images[:, first : first + size].reshape(CLASSES, *d.shape)
            first += size
        balance = Balance(self.emitted, absorbed, detected, float(self.left[0]), float(self.left[1]))
        families = [self._family(key, family_events.get(key, ())) for key in self.sums]
        families.sort(key=lambda f: (f.kind != "nominal", -f.energy))
        return PathResult(tuple(families), images, balance, self.paths, self._detections())

    def _family(self, key: Key, events: tuple[SurfaceEvent, ...]) -> Family:
        count, w, w2, wx, wy, wxx, wyy = self.sums[key].tolist()
        x, y = wx / w, wy / w
        rms = tuple(float(np.sqrt(max(second / w - mean * mean, 0.0))) for second, mean in ((wxx, x), (wyy, y)))
        # standard error of a sum of independent weights, most of them 0
        error = float(np.sqrt(max(w2 - w * w / self.paths, 0.0)))
        name = self.scenery.detectors[key.detector].name
        return Family(name, events, KINDS[key.kind], w, error, round(count), (x, y), (rms[0], rms[1]))

    def _detections(self) -> Detections:
        def joined(name: str) -> np.ndarray:
            return np.concatenate([k[name] for k in self._kept]) if self._kept else np.empty(0)

        names = ("path", "detector", "weight", "length", "signature", "kind")
        place = np.stack([joined("x"), joined("y")], axis=-1)
        return Detections(place=place, **{name: joined(name) for name in names})
