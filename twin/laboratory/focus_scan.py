"""Through-focus measurement of all sites: move the target, record the edge, measure its MTF, find the vertex."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from analysis.edge_location import EdgeError
from analysis.slanted_edge import measure_edge
from analysis.through_focus import FocusError, FocusVertex, focus_vertex
from optics.pose import Pose
from optics.threads import cores
from twin.detector import FixedPattern
from twin.laboratory.bench_error import BenchError
from twin.laboratory.focus_bench import ALONG, EDGES, FocusBench, Site
from twin.laboratory.result import Advance, silent

NYQUIST = 0.5
"""Cycles per pixel."""

_OFFSET, _FRAMES, _PATTERN = range(3)
_COARSE_SITES = 4
"""Positions of the first scan that lie within the defocus at which all contrast is gone, at least."""


@dataclass(frozen=True, eq=False)
class Standing:
    """Where the focal-plane assembly and its chips stand.

    Attributes:
        pose: of the assembly in the nominal focal-plane frame.
        heights: band -> height of its chip above the assembly, along Z', metres.
    """

    pose: Pose
    heights: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class SiteScan:
    """One site through focus.

    Attributes:
        shift: moves of the target, as moves of the image, metres, (Z,).
        mtf, sigma: mean of both edges at the Nyquist frequency, (Z,).
        vertex: its peak; the CCD stands downstream of best focus by the vertex's position.
        frame: one recorded frame near the peak.
    """

    shift: np.ndarray
    mtf: np.ndarray
    sigma: np.ndarray
    vertex: FocusVertex
    frame: np.ndarray


@dataclass(frozen=True, eq=False)
class NyquistMtf:
    """Measured MTF at the Nyquist frequency with the target at the collimator's focus: edge -> (value, sigma)."""

    by_edge: Mapping[str, tuple[float, float]]


class Recorder:
    """Records and measures edges of one standing of the assembly.

    Args:
        bench: the bench.
        standing: of the assembly.
        seed: of the noise and of where the edge happens to lie.
        patterns: band -> columns' gains and offsets.
    """

    def __init__(
        self,
        bench: FocusBench,
        standing: Standing,
        seed: np.random.SeedSequence,
        patterns: Mapping[str, FixedPattern],
    ) -> None:
        self.bench = bench
        self.standing = standing
        self.seed = seed
        self.patterns = patterns

    def frames(self, number: int, edge: str, shift: float, take: int) -> np.ndarray:
        """Frames (frames, region, region) of an edge at site ``number``, the image moved by ``shift``; ``take`` tells
        one exposure from another.
        """
        site, bench = self.bench.sites[number], self.bench
        height = self.standing.heights[site.band]
        ccd = bench.ccds[site.band]
        offset_seed, frame_seed = (self._stream(which, number, EDGES.index(edge), take) for which in (_OFFSET, _FRAMES))
        offset = float(np.random.default_rng(offset_seed).uniform(-0.5, 0.5)) * ccd.band.pitch
        share = site.image(edge, self.standing.pose, height, shift / bench.image_per_target_shift, offset)
        photons = ccd.white_photons(bench.setup.test.white) * share
        column = site.column(self.standing.pose, height)
        return ccd.expose(photons, column, self.patterns[site.band], bench.setup.test.frames, frame_seed)

    def measure(self, number: int, edge: str, shift: float, take: int) -> tuple[float, float, np.ndarray]:
        """MTF at the Nyquist frequency, its sigma, and the first frame.

        Raises:
            EdgeError: no edge can be measured in the image.
        """
        frames = self.frames(number, edge, shift, take)
        ccd = self.bench.ccds[self.bench.sites[number].band]
        result = measure_edge(frames.mean(axis=0), noise=ccd.noise, frames=len(frames))
        value, sigma = result.at(NYQUIST)
        return value, sigma, frames[0]

    def attempt(self, number: int, edge: str, shift: float, take: int) -> tuple[float, float, np.ndarray, str]:
        """As ``measure``; where the image is too blurred, or otherwise not good for it, MTF 0 with an infinite sigma,
        and the reason.
        """
        try:
            return *self.measure(number, edge, shift, take), ""
        except EdgeError as error:
            return 0.0, np.inf, np.zeros((1, 1), np.uint16), str(error)

    def _stream(self, *key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(self.seed.entropy, spawn_key=(*self.seed.spawn_key, *key))


def scan(recorder: Recorder, advance: Advance = silent, search: bool = True) -> tuple[SiteScan, ...]:
    """Measure all sites through focus.

    Args:
        recorder: of one standing.
        advance: told how many of how many sites are done.
        search: first look for the peak over the whole reach; without it the peak is taken to be near zero, and only
            where it is not there is it looked for.

    Raises:
        BenchError: a peak lies outside of the scan.
    """
    count = len(recorder.bench.sites)
    done: list[SiteScan] = []
    with ThreadPoolExecutor(cores()) as pool:
        for result in pool.map(lambda n: _scan_site(recorder, n, search), range(count)):
            done.append(result)
            advance("through focus", len(done), count)
    return tuple(done)


def in_focus(recorder: Recorder) -> tuple[NyquistMtf, ...]:
    """MTF of every site with the target at the collimator's focus."""

    def site(number: int) -> NyquistMtf:
        takes = {edge: recorder.measure(number, edge, 0.0, 9000) for edge in EDGES}
        return NyquistMtf({edge: (value, sigma) for edge, (value, sigma, _) in takes.items()})

    with ThreadPoolExecutor(cores()) as pool:
        return tuple(pool.map(site, range(len(recorder.bench.sites))))


def _scan_site(recorder: Recorder, number: int, search: bool) -> SiteScan:
    bench = recorder.bench
    site, plan = bench.sites[number], bench.setup.test.scan
    zero = bench.geometric_zero(site.band)
    centre = _search(recorder, number, zero) if search else 0.0
    half = plan.depth * zero
    for attempt in range(3):
        shift = centre + np.linspace(-half, half, plan.points)
        taken = [
            [recorder.attempt(number, edge, float(s), 1000 * (attempt + 1) + k) for edge in EDGES]
            for k, s in enumerate(shift)
        ]
        value = np.array([[one[0] for one in both] for both in taken])
        sigma = np.array([[one[1] for one in both] for both in taken])
        mean, error = value.mean(axis=1), np.sqrt(np.sum(sigma**2, axis=1)) / len(EDGES)
        try:
            vertex = focus_vertex(shift, mean, error)
            return SiteScan(shift, mean, error, vertex, taken[int(np.argmax(mean))][0][2])
        except FocusError as problem:
            if attempt == 2:
                raise _lost(site, problem) from problem
            centre = _search(recorder, number, zero) if attempt == 0 else float(shift[np.argmax(mean)])
    raise AssertionError("unreachable")


def _search(recorder: Recorder, number: int, zero: float) -> float:
    """Rough place of the peak: where the scan over the whole reach shows most contrast along the line."""
    plan = recorder.bench.setup.test.scan
    site = recorder.bench.sites[number]
    # wide peaks need no more positions than that some of them meet the peak
    step = max(plan.step, 2.0 * zero / _COARSE_SITES)
    shift = np.linspace(-plan.reach, plan.reach, 2 * int(np.ceil(plan.reach / step)) + 1)
    taken = [recorder.attempt(number, ALONG, float(s), k) for k, s in enumerate(shift)]
    if all(np.isinf(one[1]) for one in taken):
        raise BenchError(
            f"the edge cannot be measured anywhere through focus in {site.band} at field {site.field:g}: {taken[0][3]}",
            ("edge",),
            "another edge, region or light",
        )
    mtf = np.array([one[0] for one in taken])
    best = int(np.argmax(mtf))
    if best in (0, len(shift) - 1):
        where = "the lower" if best == 0 else "the upper"
        raise BenchError(
            f"best focus of {site.band} at field {site.field:g} is not inside the scan: most contrast at {where} end",
            ("scan", "reach"),
            "a longer reach",
        )
    return float(shift[best])


def _lost(site: Site, problem: FocusError) -> BenchError:
    return BenchError(
        f"no best focus of {site.band} at field {site.field:g}: {problem}",
        ("scan",),
        "a longer reach, a smaller step, or more light and frames",
    )
