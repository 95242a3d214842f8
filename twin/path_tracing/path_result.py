"""What came out of a path-traced run: families of paths at the detectors, images, and where all the light went."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin.path_tracing.families import Touch
from twin.path_tracing.sinks import GHOST, NOMINAL, STRAY


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
