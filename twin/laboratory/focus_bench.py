"""The bench of the focal-plane alignment: a collimator with a slanted edge, the camera, its line CCDs.

Frame of all numbers: the focal-plane frame of the camera as its prescription has it (X' flight direction, Y' along the
line, Z' along the light). The focal-plane assembly stands in it at a ``Pose``, and each band's chip at a height above
the assembly.

Through-focus measurement of all sites: move the target, record the edge, measure its MTF, find the vertex.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize_scalar

from analysis.focal_plane.through_focus import FocusError, FocusVertex, focus_vertex
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_pages import grey_step, measure_pages
from optics.geometry.pose import Pose
from optics.numerics.backend import Backend, cores, one_blas_thread
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import ROOT, CameraUnderTest, build_camera_under_test
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.sensors.area_detector import FixedPattern
from twin.sensors.line_ccd import LineCcd
from twin.targets.target_images import ALONG, DIRECTIONS, EdgeImager, EdgeOptics, knife_edge
from twin.targets.target_path import LocalMap, TargetPath

if TYPE_CHECKING:
    from scenes.specs.resolved import FocusSetup

_SEARCH = 0.3e-3
"""Defocus up to which best focus is looked for, metres."""


@dataclass(frozen=True, eq=False)
class Site:
    """One place of the focal plane where the edge is imaged.

    Attributes
    ----------
    band : str
        Whose line CCD.
    field : float
        Share of half the line.
    place : np.ndarray
        (X', Y') on the nominal focal plane, metres.
    point, direction : np.ndarray
        Of the chief ray in the focal-plane frame, (3,), metres and unit.
    imagers : Mapping[str, EdgeImager]
        Edge -> its images.
    defocus_per_shift : Mapping[str, float]
        Edge -> defocus of the image per metre of the target's move, as the edge's direction sees it: (f / collimator's
        f)^2 with the focal length in the direction of the edge's normal.
    nominal_per_shift : Mapping[str, float]
        The same of the prescription, which the analysis may know.
    edge_focus : Mapping[str, float]
        Edge -> Z' at which its MTF at the Nyquist frequency is largest, metres.
    """

    band: str
    field: float
    place: np.ndarray
    point: np.ndarray
    direction: np.ndarray
    imagers: Mapping[str, EdgeImager]
    defocus_per_shift: Mapping[str, float]
    nominal_per_shift: Mapping[str, float]
    edge_focus: Mapping[str, float]

    @property
    def best(self) -> float:
        """Z' of best focus: midway between those of the two edges, which astigmatism moves apart, metres."""
        return float(np.mean([self.edge_focus[edge] for edge in DIRECTIONS]))

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the band, cycles/m."""
        return self.imagers[ALONG].ccd.band.nyquist

    def crossing(self, standing: Pose, height: float) -> np.ndarray:
        """Where the chief ray meets the chip, in the focal-plane frame, (3,), metres."""
        normal = standing.rotation[:, 2]
        chip = standing.translation + height * normal
        return np.asarray(self.point + self.direction * ((chip - self.point) @ normal) / (self.direction @ normal))

    def defocus(self, standing: Pose, height: float) -> float:
        """How far the chip stands downstream of best focus, metres."""
        return float(self.crossing(standing, height)[2] - self.best)

    def column(self, standing: Pose, height: float) -> int:
        """First column of the line on which the image of the edge lies in the middle."""
        imager = self.imagers[ALONG]
        along = standing.inverse().apply(self.crossing(standing, height))[1]
        middle = along / imager.ccd.band.pitch + 0.5 * (imager.ccd.band.pixels - 1)
        return int(np.clip(round(middle - 0.5 * imager.region), 0, imager.ccd.band.pixels - imager.region))

    def image(self, edge: str, standing: Pose, height: float, target_shift: float, offset: float) -> np.ndarray:
        """Share of the white signal in every pixel, for a target moved by ``target_shift`` and an edge ``offset``."""
        moved = self.crossing(standing, height)[2] - self.defocus_per_shift[edge] * target_shift
        return self.imagers[edge].image(float(moved), offset)


@dataclass(frozen=True, eq=False)
class BudgetLine:
    """What makes a band's MTF at its Nyquist frequency, in the middle of the field and at best focus.

    Attributes
    ----------
    band : str
        name.
    edge : str
        Direction in which it is measured.
    factors : Mapping[str, float]
        Effect -> its transfer there.
    total : float
        Their product.
    """

    band: str
    edge: str
    factors: Mapping[str, float]
    total: float


class FocusBench:
    """Everything of the bench that does not change from one alignment to the next.

    Parameters
    ----------
    setup
        The test with all it refers to.
    backend
        Where to trace.
    advance
        Told how many of how many tables are done.

    Raises
    ------
    InputError
        The camera cannot be built as the file says.
    AimError, BeamMissedError, ValueError
        Its beam is lost or vignetted.
    """

    def __init__(self, setup: FocusSetup, backend: Backend, advance: Advance = silent) -> None:
        test = setup.test
        self.setup = setup
        self.camera: CameraUnderTest = build_camera_under_test(test, setup.camera, backend)
        self.collimator = test.collimator.model
        self.path = TargetPath(self.camera.assembly, ROOT, ROOT, self.camera.model, backend, self.collimator)
        self.ccds = {
            name: LineCcd.from_specs(band, setup.detectors[band.detector]) for name, band in setup.camera.bands.items()
        }
        self.focal_length = float(self.camera.model.first_order.principal_distance[0])
        self.sites = self._build_sites(advance)

    def geometric_zero(self, band: str) -> float:
        """Defocus at which geometric blur takes all contrast at a band's Nyquist frequency, metres."""
        f_number = self.focal_length / self.setup.camera.entrance_pupil
        return 1.22 * f_number / self.ccds[band].band.nyquist

    def _build_sites(self, advance: Advance) -> tuple[Site, ...]:
        test, bands = self.setup.test, self.setup.camera.bands
        keys = [(name, field) for name in bands for field in test.fields]
        half = {n: 0.5 * (b.pixels - 2.0 * test.edge.region) * b.pitch for n, b in bands.items()}
        places = np.array([[field * half[name], bands[name].offset] for name, field in keys])
        directions = self.path.directions(places)
        hits = self.path.places(self.camera.as_built, directions)
        pupils = self.path.pupils(self.camera.as_built, directions, hits)
        sites = []
        for i, (name, field) in enumerate(keys):
            advance("tables of the optics", i, len(keys))
            sites.append(self._site(name, field, directions[i], hits[i], pupils[i]))
        advance("tables of the optics", len(keys), len(keys))
        return tuple(sites)

    def _site(self, band: str, field: float, direction: np.ndarray, hit: np.ndarray, pupil: PupilFunction) -> Site:
        test, ccd = self.setup.test, self.ccds[band]
        local = self.path.local_map(self.camera.as_built, direction, ccd.band.pitch * test.edge.region)
        nominal = self.path.local_map({}, direction, ccd.band.pitch * test.edge.region)
        imagers, ratio, nominal_ratio = {}, {}, {}
        for edge in DIRECTIONS:
            shape = knife_edge(edge, test.edge.angle)
            normal = shape.mapped(local).normal
            imagers[edge] = EdgeImager(EdgeOptics.build(pupil, ccd.band, normal), ccd, test.edge.region)
            ratio[edge] = _longitudinal(local, normal)
            nominal_ratio[edge] = _longitudinal(nominal, shape.mapped(nominal).normal)
        # the pupil's mean direction in (Y', X') is the chief ray's but for coma
        v, u = pupil.centre
        ray = np.array([u, v, np.sqrt(1.0 - u * u - v * v)])
        point = np.array([hit[1], hit[0], 0.0])
        focus = {edge: best_focus(imager, ccd.band.nyquist) for edge, imager in imagers.items()}
        return Site(band, field, point[:2], point, ray, imagers, ratio, nominal_ratio, focus)

    def budget(self) -> tuple[BudgetLine, ...]:
        """What makes each band's MTF at Nyquist in the middle of the field, along the line and along the track."""
        out = []
        for name, ccd in self.ccds.items():
            site = min((s for s in self.sites if s.band == name), key=lambda s: abs(s.field))
            place = site.place[None, ::-1]
            bare = TargetPath(self.camera.assembly, ROOT, ROOT, self.camera.model, self.path.backend)
            pupil = bare.pupils({}, bare.directions(place), place)[0]
            perfect = replace(pupil, eikonal_terms=np.zeros_like(pupil.eikonal_terms))
            for edge, imager in site.imagers.items():
                f, normal = ccd.band.nyquist, imager.optics.normal
                x, y = f * normal
                designed = EdgeImager(EdgeOptics.build(pupil, ccd.band, normal, _SEARCH), ccd, imager.region)
                diffraction = _modulus(EdgeOptics.build(perfect, ccd.band, normal, _SEARCH), 0.0, f)
                design = _modulus(designed.optics, best_focus(designed, f), f)
                actual = _modulus(imager.optics, site.best, f)
                parts = {k: float(v) for k, v in ccd.factors(np.array(x), np.array(y)).items()}
                factors = {
                    "diffraction": diffraction,
                    "design": design / diffraction,
                    "wavefront": actual / design,
                    **parts,
                }
                out.append(BudgetLine(name, edge, factors, imager.mtf(site.best, f)))
        return tuple(out)


def _modulus(optics: EdgeOptics, defocus: float, frequency: float) -> float:
    return float(np.abs(optics.at(defocus, np.array([frequency])))[0])


def _longitudinal(local: LocalMap, normal: np.ndarray) -> float:
    """Longitudinal magnification in the direction of an edge's normal.

    A target moved by s adds s |p|^2 / 2F^2 to the path at p in the entrance pupil. By Lagrange's invariant p = F J^T u
    for direction cosines u at the image and the map's Jacobian J, so the image's curvature is s J J^T.
    """
    return float(np.sum((local.jacobian.T @ normal) ** 2))


def best_focus(imager: EdgeImager, frequency: float) -> float:
    """Defocus at which the MTF is largest, metres."""

    def loss(defocus: float) -> float:
        return -imager.mtf(defocus, frequency)

    coarse = np.linspace(-_SEARCH, _SEARCH, 41)
    start = int(np.argmin([loss(float(z)) for z in coarse]))
    low, high = coarse[max(start - 1, 0)], coarse[min(start + 1, len(coarse) - 1)]
    return float(minimize_scalar(loss, bounds=(low, high), method="bounded", options={"xatol": 1e-8}).x)


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

    Attributes
    ----------
    pose : Pose
        Of the assembly in the nominal focal-plane frame.
    heights : Mapping[str, float]
        Band -> height of its chip above the assembly, along Z', metres.
    """

    pose: Pose
    heights: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class SiteScan:
    """One site through focus.

    Attributes
    ----------
    shift : Mapping[str, np.ndarray]
        Edge -> moves of the target, as moves of the image in the edge's direction, metres, (Z,).
    mtf, sigma : Mapping[str, np.ndarray]
        Edge -> MTF at the Nyquist frequency, (Z,); an infinite sigma where no edge could be measured.
    vertex : Mapping[str, FocusVertex]
        Edge -> its peak.
    frames : Mapping[str, np.ndarray]
        Edge -> one recorded frame near the peak; empty of a table of MTF values.
    target : np.ndarray
        Moves of the target itself, metres, (Z,); empty of measurements.
    take : int
        Number of the exposure at its first position.
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

    Attributes
    ----------
    by_edge : Mapping[str, tuple[float, float]]
        Edge -> MTF at the Nyquist frequency and its sigma.
    frames : Mapping[str, np.ndarray]
        Edge -> recorded frames (frames, region, region).
    """

    by_edge: Mapping[str, tuple[float, float]]
    frames: Mapping[str, np.ndarray]


class Recorder:
    """Records and measures edges of one standing of the assembly.

    Parameters
    ----------
    bench
        The bench.
    standing
        Of the assembly.
    seed
        Of the noise and of where the edge happens to lie.
    patterns
        Band -> columns' gains and offsets.
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

        Raises
        ------
        EdgeError
            No edge can be measured in the image.
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

    Parameters
    ----------
    recorder : Recorder
        Of one standing.
    advance : Advance
        Told how many of how many sites are done.
    search : bool
        First look for the peak over the whole reach; without it the peak is taken to be near zero, and only where it is
        not there is it looked for.

    Raises
    ------
    BenchError
        a peak lies outside of the scan.
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

    Raises
    ------
    BenchError
        No edge can be measured there.
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
            again = 1000 * (_ATTEMPTS + 1) if attempt == 1 else 0  # images of their own for a second search
            centre = _search(recorder, number, zero, again) if attempt == 1 or not search else float(target[best])
            continue
        frames = {edge: taken[edge][int(np.argmax(mtf[edge]))][2][0] for edge in DIRECTIONS}
        return SiteScan(shift, mtf, sigma, vertex, frames, target, 1000 * (attempt + 1))
    raise AssertionError("unreachable")


def _search(recorder: Recorder, number: int, zero: float, first: int = 0) -> float:
    """Rough place of the peak, as a move of the target: where the whole reach shows most contrast along the line.
    ``first``: number of the first image.
    """
    plan = recorder.bench.setup.test.scan
    site = recorder.bench.sites[number]
    # wide peaks need no more positions than that some of them meet the peak
    step = max(plan.step, 2.0 * zero / _COARSE)
    reach = plan.reach / site.nominal_per_shift[ALONG]
    shift = np.linspace(-reach, reach, 2 * int(np.ceil(plan.reach / step)) + 1)
    taken = [recorder.attempt(number, ALONG, float(s), k) for k, s in enumerate(shift, first)]
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
