"""Through-focus measurement of all sites: move the target, record the edge, measure its MTF, find the vertex."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from analysis.focal_plane.through_focus import FocusError, FocusVertex, focus_vertex
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_pages import grey_step, measure_pages
from optics.geometry.pose import Pose
from optics.numerics.backend import cores, one_blas_thread
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.laboratory.focus_bench import FocusBench, Site
from twin.sensors.area_detector import FixedPattern
from twin.targets.target_images import ALONG, DIRECTIONS

NYQUIST = 0.5
"""Cycles per pixel."""

VERTEX_ERROR = 0.5e-6
"""Error that the form of the curve near its peak leaves in all vertices alike, metres, one sigma: wavefronts of 0.2
waves shift them by so much. Without noise the vertices of the example are up to 0.6 um off."""

VERTEX_TREND = 0.15e-6
"""By how much this error changes from the middle to the ends of the line and of the bands, metres, one sigma, since the
wavefront and the wavelength do."""

_OFFSET, _FRAMES = range(2)
_COARSE = 4
"""Positions of the first scan that lie within the defocus at which all contrast is gone, at least."""
_ATTEMPTS = 3


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
        shift: edge -> moves of the target, as moves of the image in the edge's direction, metres, (Z,).
        mtf, sigma: edge -> MTF at the Nyquist frequency, (Z,); an infinite sigma where no edge could be measured.
        vertex: edge -> its peak.
        frames: edge -> one recorded frame near the peak; empty of a table of MTF values.
        target: moves of the target itself, metres, (Z,); empty of measurements.
        take: number of the exposure at its first position.
    """

    shift: Mapping[str, np.ndarray]
    mtf: Mapping[str, np.ndarray]
    sigma: Mapping[str, np.ndarray]
    vertex: Mapping[str, FocusVertex]
    frames: Mapping[str, np.ndarray]
    target: np.ndarray
    take: int = 0

    @property
    def defocus(self) -> float:
        """How far the CCD stands downstream of best focus, midway between the edges' vertices, metres."""
        return float(np.mean([v.position for v in self.vertex.values()]))

    @property
    def defocus_sigma(self) -> float:
        """Standard deviation of `defocus` from noise, metres; ``VERTEX_ERROR``, the same for all sites, adds to it."""
        return float(np.sqrt(sum(v.sigma**2 for v in self.vertex.values())) / len(self.vertex))


@dataclass(frozen=True, eq=False)
class NyquistMtf:
    """Edges of one site with the target at the collimator's focus.

    Attributes:
        by_edge: edge -> MTF at the Nyquist frequency and its sigma.
        frames: edge -> recorded frames (frames, region, region).
    """

    by_edge: Mapping[str, tuple[float, float]]
    frames: Mapping[str, np.ndarray]


class Recorder:
    """Records and measures edges of one standing of the assembly.

    Args:
        bench: the bench.
        standing: of the assembly.
        seed: of the noise and of where the edge happens to lie.
        patterns: band -> columns' gains and offsets.
    """

    def __init__(
        self, bench: FocusBench, standing: Standing, seed: np.random.SeedSequence, patterns: Mapping[str, FixedPattern]
    ) -> None:
        self.bench = bench
        self.standing = standing
        self.seed = seed
        self.patterns = patterns

    def frames(self, number: int, edge: str, shift: float, take: int) -> np.ndarray:
        """Frames (frames, region, region) of an edge at site ``number``, the target moved by ``shift`` metres; ``take``
        tells one exposure from another.
        """
        site, bench = self.bench.sites[number], self.bench
        height = self.standing.heights[site.band]
        ccd = bench.ccds[site.band]
        way = DIRECTIONS.index(edge)
        offset_seed, frame_seed = (stream(self.seed, which, number, way, take) for which in (_OFFSET, _FRAMES))
        offset = float(np.random.default_rng(offset_seed).uniform(-0.5, 0.5)) * ccd.band.pitch
        share = site.image(edge, self.standing.pose, height, shift, offset)
        photons = ccd.white_photons(bench.setup.test.white) * share
        column = site.column(self.standing.pose, height)
        return ccd.expose(photons, column, self.patterns[site.band], bench.setup.test.frames, frame_seed)

    def measure(self, number: int, edge: str, shift: float, take: int) -> tuple[float, float, np.ndarray]:
        """MTF at the Nyquist frequency, its sigma, and the frames.

        Raises:
            EdgeError: no edge can be measured in the image.
        """
        frames = self.frames(number, edge, shift, take)
        ccd = self.bench.ccds[self.bench.sites[number].band]
        # the bench's light is even
        return *measure_pages(frames, noise=ccd.noise, step=grey_step(frames), even=True).at(NYQUIST), frames

    def attempt(self, number: int, edge: str, shift: float, take: int) -> tuple[float, float, np.ndarray, str]:
        """Measure like ``measure``, but give MTF 0 with infinite sigma, and the reason, for an image that is too
        blurred or otherwise unusable.
        """
        try:
            return *self.measure(number, edge, shift, take), ""
        except EdgeError as error:
            return 0.0, np.inf, np.zeros((1, 1, 1), np.uint16), str(error)


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
    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        for result in pool.map(lambda n: _scan_site(recorder, n, search), range(count)):
            done.append(result)
            advance("through focus", len(done), count)
    return tuple(done)


def in_focus(recorder: Recorder) -> tuple[NyquistMtf, ...]:
    """MTF of every site with the target at the collimator's focus.

    Raises:
        BenchError: no edge can be measured there.
    """

    def site(number: int) -> NyquistMtf:
        try:
            takes = {edge: recorder.measure(number, edge, 0.0, 9000) for edge in DIRECTIONS}
        except EdgeError as error:
            where = recorder.bench.sites[number]
            raise BenchError(
                f"the edge cannot be measured after the alignment in {where.band} at field {where.field:g}: {error}",
                ("misset", "chips"),
                "chips nearer to one plane, so that all of them come into focus together",
            ) from error
        return NyquistMtf({e: (t[0], t[1]) for e, t in takes.items()}, {e: t[2] for e, t in takes.items()})

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        return tuple(pool.map(site, range(len(recorder.bench.sites))))


def _scan_site(recorder: Recorder, number: int, search: bool) -> SiteScan:
    bench = recorder.bench
    site, plan = bench.sites[number], bench.setup.test.scan
    zero = bench.geometric_zero(site.band)
    ratio = site.nominal_per_shift
    centre = _search(recorder, number, zero) if search else 0.0
    steps = plan.depth * zero / ratio[ALONG] * np.linspace(-1.0, 1.0, plan.points)
    for attempt in range(_ATTEMPTS):
        target = centre + steps
        taken = {
            edge: [recorder.attempt(number, edge, float(s), 1000 * (attempt + 1) + k) for k, s in enumerate(target)]
            for edge in DIRECTIONS
        }
        shift = {edge: target * ratio[edge] for edge in DIRECTIONS}
        mtf = {edge: np.array([one[0] for one in taken[edge]]) for edge in DIRECTIONS}
        sigma = {edge: np.array([one[1] for one in taken[edge]]) for edge in DIRECTIONS}
        try:
            vertex = {edge: focus_vertex(shift[edge], mtf[edge], sigma[edge]) for edge in DIRECTIONS}
        except FocusError as problem:
            if attempt == _ATTEMPTS - 1:
                raise _lost(site, problem) from problem
            # the first scan may have met a side lobe or a flank: go to the highest point, then look everywhere again
            best = int(np.argmax(sum(mtf.values())))
            centre = _search(recorder, number, zero) if attempt == 1 or not search else float(target[best])
            continue
        frames = {edge: taken[edge][int(np.argmax(mtf[edge]))][2][0] for edge in DIRECTIONS}
        return SiteScan(shift, mtf, sigma, vertex, frames, target, 1000 * (attempt + 1))
    raise AssertionError("unreachable")


def _search(recorder: Recorder, number: int, zero: float) -> float:
    """Rough place of the peak, as a move of the target: where the whole reach shows most contrast along the line."""
    plan = recorder.bench.setup.test.scan
    site = recorder.bench.sites[number]
    # wide peaks need no more positions than that some of them meet the peak
    step = max(plan.step, 2.0 * zero / _COARSE)
    reach = plan.reach / site.nominal_per_shift[ALONG]
    shift = np.linspace(-reach, reach, 2 * int(np.ceil(plan.reach / step)) + 1)
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
