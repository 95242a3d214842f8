"""What comes out of a path-traced run: families of paths at the detectors, images, and where all the light went; and
how the launches of a run are added up to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.models.scenery import Scenery
from twin.path_tracing.families import Touch
from twin.path_tracing.sinks import CLASSES, GHOST, NOMINAL, STRAY, Sinks
from twin.path_tracing.tables import NOMINAL_SUMS, ROWS_PER_SURFACE


@dataclass(frozen=True)
class Family:
    """All paths that reached a detector by the same events in the same order.

    Attributes:
        detector: its name.
        touches: the events before it; empty when it was not looked up.
        kind: ``nominal``, ``ghost`` (another way without scattering) or ``stray`` (scattered or diffused somewhere).
        energy: detected share of the emitted power; error: its standard error.
        count: paths.
        centroid: x, y in the detector's frame, metres.
        rms: root-mean-square size along x and y about the centroid, metres.
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

    Attributes:
        emitted: sum of the paths' weights at their start.
        absorbed: part -> power absorbed in it; detected: detector -> power detected.
        escaped: to infinity; under_way: still on its way at the step limit.
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

    Attributes:
        path: number of the path; detector: index of the detector.
        place: (N, 2) x, y in the detector's frame, metres.
        weight: detected power; length: optical path, metres.
        signature: of the family; kind: ``NOMINAL``, ``GHOST`` or ``STRAY``.
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

    Attributes:
        families: by falling energy; nominal families first.
        images: detector -> (3, rows, columns) power per pixel: nominal, ghost, stray.
        balance: of the power.
        paths: number traced.
        detections: single detections that were kept: all but the nominal families', or all.
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

        Raises:
            LookupError: no path came to it by the nominal way.
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

    Args:
        scenery: the scene.
        nominal: signature of the nominal family of each detector, 0 for none.
        keep: whether to keep single detections.
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


def event_lists(log: np.ndarray, paths: int) -> Iterable[tuple[int, ...]]:
    """Codes of each path's events, steps that passed over something left out; ``log`` as the kernel writes it."""
    return [tuple(int(c) for c in row if c) for row in log.reshape(paths, -1)]
