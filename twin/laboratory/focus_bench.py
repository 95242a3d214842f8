"""Simulated bench of the focal-plane alignment: a collimator with a slanted edge, the camera, its line CCDs.

All numbers are in the focal-plane frame of the camera's prescription (X' flight direction, Y' along the line, Z' along
the light). A ``Pose`` places the focal-plane assembly in it, and the chip of each band lies at a height above the
assembly.

At every site (a position on a line CCD) the target is moved through focus, its edge recorded, the MTF measured, and the
vertex of the MTF curve, its peak, fitted.
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
from twin.framework.procedure import Advance, BenchError, silent, stream
from twin.sensors.area_detector import FixedPattern
from twin.sensors.line_ccd import LineCcd
from twin.targets.target_images import ALONG, DIRECTIONS, EdgeImager, EdgeOptics, knife_edge
from twin.targets.target_path import LocalMap, TargetPath

if TYPE_CHECKING:
    from scenes.specs.resolved import FocusSetup

_SEARCH = 0.3e-3
"""Largest defocus to either side, metres, that is searched for the best focus of the simulated optics."""


@dataclass(frozen=True, eq=False)
class Site:
    """Position on the focal plane where the edge target is imaged.

    Attributes
    ----------
    band : str
        Name of the band whose line CCD lies there.
    field : float
        Position along the line as a fraction of half the line.
    place : (2,) ndarray
        Position (X', Y') on the nominal focal plane, metres.
    point, direction : (3,) ndarray
        Point (metres) and unit direction of the chief ray in the focal-plane frame.
    imagers : mapping
        Edge (direction in which it measures the MTF) -> imager of that edge.
    defocus_per_shift : mapping
        Edge -> true defocus of the image per metre of target shift, in the direction of the edge's normal: (f of the
        camera / f of the collimator)^2, with the camera's focal length f in that direction.
    nominal_per_shift : mapping
        Edge -> the corresponding ratio by the design prescription, which the analysis may know.
    edge_focus : mapping
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
        """Position Z' of best focus, metres: the mean of the two edges' best foci, which astigmatism separates."""
        return float(np.mean([self.edge_focus[edge] for edge in DIRECTIONS]))

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the band, cycles/m."""
        return self.imagers[ALONG].ccd.band.nyquist

    def crossing(self, placement: Pose, height: float) -> np.ndarray:
        """Return the intersection of the chief ray and the chip's surface in the focal-plane frame, (3,), metres.

        Parameters
        ----------
        placement : Pose
            Position and orientation of the focal-plane assembly in the focal-plane frame.
        height : float
            Height of the chip above the assembly, along the assembly's normal, metres.
        """
        normal = placement.rotation[:, 2]
        chip = placement.translation + height * normal
        return np.asarray(self.point + self.direction * ((chip - self.point) @ normal) / (self.direction @ normal))

    def defocus(self, placement: Pose, height: float) -> float:
        """Return the defocus of the chip, positive downstream of best focus, metres."""
        return float(self.crossing(placement, height)[2] - self.best)

    def column(self, placement: Pose, height: float) -> int:
        """Return the first column of the recorded region, in whose middle the image of the edge lies."""
        imager = self.imagers[ALONG]
        along = placement.inverse().apply(self.crossing(placement, height))[1]
        middle = along / imager.ccd.band.pitch + 0.5 * (imager.ccd.band.pixels - 1)
        return int(np.clip(round(middle - 0.5 * imager.region), 0, imager.ccd.band.pixels - imager.region))

    def image(self, edge: str, placement: Pose, height: float, target_shift: float, offset: float) -> np.ndarray:
        """Return the signal of every pixel in the image of an edge, as a fraction of that in the bright area.

        Parameters
        ----------
        edge : str
            Direction in which the edge measures the MTF.
        placement : Placement
            Placement of the assembly.
        height : float
            Height of the chip above the assembly, metres.
        target_shift : float
            Shift of the target along the light, metres.
        offset : float
            Offset of the edge on the chip, metres.
        """
        moved = self.crossing(placement, height)[2] - self.defocus_per_shift[edge] * target_shift
        return self.imagers[edge].image(float(moved), offset)


@dataclass(frozen=True, eq=False)
class BudgetLine:
    """MTF budget of one band at its Nyquist frequency, in the middle of the field and at best focus.

    Attributes
    ----------
    band : str
        Name of the band.
    edge : str
        Direction in which the MTF is measured.
    factors : mapping
        Effect (such as diffraction or the pixel) -> its MTF factor.
    total : float
        MTF, the product of the factors.
    """

    band: str
    edge: str
    factors: Mapping[str, float]
    total: float


class FocusBench:
    """Simulated bench with everything that stays the same from alignment to alignment.

    Parameters
    ----------
    setup
        Test with the contents of all files that it refers to.
    backend
        Array backend of the trace.
    advance
        Called with the number of image tables done and their total.

    Raises
    ------
    InputError
        The camera cannot be built as the file specifies.
    AimError, BeamMissedError, ValueError
        The beam is lost or vignetted.
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
        """Return the defocus at which geometric blur removes all contrast at a band's Nyquist frequency, metres."""
        f_number = self.focal_length / self.setup.camera.entrance_pupil
        return 1.22 * f_number / self.ccds[band].band.nyquist

    def _build_sites(self, advance: Advance) -> tuple[Site, ...]:
        """Trace all sites and tabulate the edge's images over defocus at each."""
        test, bands = self.setup.test, self.setup.camera.bands
        keys = [(name, field) for name in bands for field in test.fields]
        half = {n: 0.5 * (b.pixels - 2.0 * test.edge.region) * b.pitch for n, b in bands.items()}
        positions = np.array([[field * half[name], bands[name].offset] for name, field in keys])
        directions = self.path.directions(positions)
        hits = self.path.positions(self.camera.as_built, directions)
        pupils = self.path.pupils(self.camera.as_built, directions, hits)
        sites = []
        for i, (name, field) in enumerate(keys):
            advance("tables of the optics", i, len(keys))
            sites.append(self._site(name, field, directions[i], hits[i], pupils[i]))
        advance("tables of the optics", len(keys), len(keys))
        return tuple(sites)

    def _site(self, band: str, field: float, direction: np.ndarray, hit: np.ndarray, pupil: PupilFunction) -> Site:
        """Build the site of one band and field point, from its traced pupil."""
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
        """Compute the MTF budget of each band at Nyquist in the middle of the field, in both directions."""
        out = []
        for name, ccd in self.ccds.items():
            site = min((s for s in self.sites if s.band == name), key=lambda s: abs(s.field))
            position = site.place[None, ::-1]
            bare = TargetPath(self.camera.assembly, ROOT, ROOT, self.camera.model, self.path.backend)
            pupil = bare.pupils({}, bare.directions(position), position)[0]
            perfect = replace(pupil, eikonal_terms=np.zeros_like(pupil.eikonal_terms))
            for edge, imager in site.imagers.items():
                f, normal = ccd.band.nyquist, imager.optics.normal
                x, y = f * normal
                designed = EdgeImager(EdgeOptics.build(pupil, ccd.band, normal, _SEARCH), ccd, imager.region)
                diffraction = _modulus(EdgeOptics.build(perfect, ccd.band, normal, _SEARCH), 0.0, f)
                design = _modulus(designed.optics, best_focus(designed, f), f)
                actual = _modulus(imager.optics, site.best, f)
                factors = {"diffraction": diffraction, "design": design / diffraction, "wavefront": actual / design}
                factors |= {k: float(v) for k, v in ccd.factors(np.array(x), np.array(y)).items()}
                out.append(BudgetLine(name, edge, factors, imager.mtf(site.best, f)))
        return tuple(out)


def _modulus(optics: EdgeOptics, defocus: float, frequency: float) -> float:
    """Return the modulus of the optics' transfer function at one spatial frequency, cycles/m."""
    return float(np.abs(optics.at(defocus, np.array([frequency])))[0])


def _longitudinal(local: LocalMap, normal: np.ndarray) -> float:
    """Return the longitudinal magnification in the direction of an edge's normal: image shift per target shift.

    A target moved by s along the axis adds s |p|^2 / 2F^2 to the optical path at the point p of the entrance pupil,
    with the collimator's focal length F. By Lagrange's invariant p = F J^T u for direction cosines u at the image and
    the Jacobian J of the map from object to image directions, so the curvature of the image's wavefront is s J J^T.
    """
    return float(np.sum((local.jacobian.T @ normal) ** 2))


def best_focus(imager: EdgeImager, frequency: float) -> float:
    """Return the defocus at which an edge's MTF at a spatial frequency (cycles/m) is largest, metres."""

    def loss(defocus: float) -> float:
        return -imager.mtf(defocus, frequency)

    coarse = np.linspace(-_SEARCH, _SEARCH, 41)
    start = int(np.argmin([loss(float(z)) for z in coarse]))
    low, high = coarse[max(start - 1, 0)], coarse[min(start + 1, len(coarse) - 1)]
    return float(minimize_scalar(loss, bounds=(low, high), method="bounded", options={"xatol": 1e-8}).x)


NYQUIST = 0.5
"""Nyquist frequency, cycles per pixel."""

VERTEX_ERROR = 0.5e-6
"""Standard deviation of the error that all fitted positions of the MTF peak have in common, metres.

It is due to the difference between the true MTF curve near its peak and the fitted form: wavefronts of 0.2 waves shift
the vertices by this much. Without noise the vertices of the example are up to 0.6 um off.
"""

VERTEX_TREND = 0.15e-6
"""Standard deviation of the variation over the focal plane of the error in the fitted MTF peaks, metres.

The variation is that from the middle to the ends of the line and of the bands, as wavefront and wavelength change.
"""

_OFFSET, _FRAMES = range(2)
_COARSE = 4
"""Smallest number of scan positions over the range of defocus in which the edge has contrast.

A coarser scan could miss the peak.
"""
_ATTEMPTS = 3
"""Largest number of times that one site is scanned through focus until its peak is found."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Pose of the focal-plane assembly and heights of its chips.

    Attributes
    ----------
    pose : Pose
        Pose of the assembly in the nominal focal-plane frame.
    heights : mapping
        Band -> height of its chip above the assembly, along Z', metres.
    """

    pose: Pose
    heights: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class SiteScan:
    """Through-focus measurement of one site, at Z positions of the target.

    Attributes
    ----------
    shift : mapping
        Edge -> shifts of the image, in the edge's direction, metres, (Z,), computed from the target's shifts.
    mtf, sigma : mapping
        Edge -> MTF at the Nyquist frequency and its standard deviation, (Z,); the latter is infinite where no edge
        could be measured.
    vertex : mapping
        Edge -> fitted peak of the MTF curve.
    frames : mapping
        Edge -> one recorded frame near the peak; empty for a table of MTF values.
    target : (Z,) ndarray
        Shifts of the target itself, metres; empty for measurements from files.
    take : int
        Number of the exposure at the first position.
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
        """Defocus of the CCD, the mean over the edges' fitted MTF peaks, positive downstream of best focus, metres."""
        return float(np.mean([v.position for v in self.vertex.values()]))

    @property
    def defocus_sigma(self) -> float:
        """Standard deviation of `defocus` due to noise, metres; ``VERTEX_ERROR``, common to all sites, adds to it."""
        return float(np.sqrt(sum(v.sigma**2 for v in self.vertex.values())) / len(self.vertex))


@dataclass(frozen=True, eq=False)
class NyquistMtf:
    """MTF of one site at the Nyquist frequency, with the target at the collimator's focus.

    Attributes
    ----------
    by_edge : mapping
        Edge (direction in which it measures the MTF) -> MTF at the Nyquist frequency and its standard deviation.
    frames : mapping
        Edge -> recorded frames, (frames, region, region), DN.
    """

    by_edge: Mapping[str, tuple[float, float]]
    frames: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Recorder:
    """Recorder of images of slanted edges, for one placement of the focal-plane assembly.

    Attributes
    ----------
    bench : FocusBench
        Bench with the camera.
    placement : Placement
        Placement of the assembly.
    seed : SeedSequence
        Seed of the noise and of the random sub-pixel position of the edge.
    patterns : mapping
        Band -> gains and offsets of its columns.
    """

    bench: FocusBench
    placement: Placement
    seed: np.random.SeedSequence
    patterns: Mapping[str, FixedPattern]

    def frames(self, number: int, edge: str, shift: float, take: int) -> np.ndarray:
        """Record frames of an edge at one site, (frames, region, region), DN.

        Parameters
        ----------
        number : int
            Number of the site.
        edge : str
            Direction in which the edge measures the MTF.
        shift : float
            Shift of the target, metres.
        take : int
            Number of the exposure, which selects its noise.
        """
        site, bench = self.bench.sites[number], self.bench
        height = self.placement.heights[site.band]
        ccd = bench.ccds[site.band]
        key = number, DIRECTIONS.index(edge), take
        offset_seed, frame_seed = (stream(self.seed, which, *key) for which in (_OFFSET, _FRAMES))
        offset = float(np.random.default_rng(offset_seed).uniform(-0.5, 0.5)) * ccd.band.pitch
        share = site.image(edge, self.placement.pose, height, shift, offset)
        photons = ccd.white_photons(bench.setup.test.white) * share
        column = site.column(self.placement.pose, height)
        return ccd.expose(photons, column, self.patterns[site.band], bench.setup.test.frames, frame_seed)

    def measure(self, number: int, edge: str, shift: float, take: int) -> tuple[float, float, np.ndarray]:
        """Record an edge; return its MTF at the Nyquist frequency, the standard deviation, and the frames.

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
        """Record an edge; return its MTF at the Nyquist frequency, standard deviation, frames, and any problem.

        For an image without a measurable edge the MTF is 0, the standard deviation infinite, and the text gives the
        reason.
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
        Recorder of one placement of the focal-plane assembly.
    advance : Advance
        Called with the number of sites done and their total.
    search : bool
        True to search the peak first over the whole range of the scan. False to assume it near zero, and search only
        where it is not.

    Raises
    ------
    BenchError
        A peak lies outside of the scan.
    """
    count = len(recorder.bench.sites)
    done: list[SiteScan] = []
    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        for result in pool.map(lambda n: _scan_site(recorder, n, search), range(count)):
            done.append(result)
            advance("through focus", len(done), count)
    return tuple(done)


def in_focus(recorder: Recorder) -> tuple[NyquistMtf, ...]:
    """Measure the MTF of every site with the target at the collimator's focus.

    Raises
    ------
    BenchError
        The edge cannot be measured at a site.
    """

    def site(number: int) -> NyquistMtf:
        try:
            takes = {edge: recorder.measure(number, edge, 0.0, 9000) for edge in DIRECTIONS}
        except EdgeError as error:
            where = recorder.bench.sites[number]
            there = f"in {where.band} at field {where.field:g}"
            problem = f"the edge cannot be measured after the alignment {there}: {error}"
            remedy = "chips closer to one plane, so that all of them can be in focus together"
            raise BenchError(problem, ("misset", "chips"), remedy) from error
        return NyquistMtf({e: (t[0], t[1]) for e, t in takes.items()}, {e: t[2] for e, t in takes.items()})

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        return tuple(pool.map(site, range(len(recorder.bench.sites))))


def _scan_site(recorder: Recorder, number: int, search: bool) -> SiteScan:
    """Measure one site through focus and fit the peaks (vertices) of its MTF curves."""
    bench = recorder.bench
    site, plan = bench.sites[number], bench.setup.test.scan
    zero = bench.geometric_zero(site.band)
    ratio = site.nominal_per_shift
    centre = _search(recorder, number, zero) if search else 0.0
    steps = plan.depth * zero / ratio[ALONG] * np.linspace(-1.0, 1.0, plan.points)
    for attempt in range(_ATTEMPTS):
        target = centre + steps
        measurements = {
            edge: [recorder.attempt(number, edge, float(s), 1000 * (attempt + 1) + k) for k, s in enumerate(target)]
            for edge in DIRECTIONS
        }
        shift = {edge: target * ratio[edge] for edge in DIRECTIONS}
        mtf = {edge: np.array([m[0] for m in measurements[edge]]) for edge in DIRECTIONS}
        sigma = {edge: np.array([m[1] for m in measurements[edge]]) for edge in DIRECTIONS}
        try:
            vertex = {edge: focus_vertex(shift[edge], mtf[edge], sigma[edge]) for edge in DIRECTIONS}
        except FocusError as problem:
            if attempt == _ATTEMPTS - 1:
                raise _lost(site, problem) from problem
            # the scan may have hit a side lobe or a flank: move to the highest point, then search the whole range
            best = int(np.argmax(sum(mtf.values())))
            again = 1000 * (_ATTEMPTS + 1) if attempt == 1 else 0  # new images for a second search
            centre = _search(recorder, number, zero, again) if attempt == 1 or not search else float(target[best])
            continue
        frames = {edge: measurements[edge][int(np.argmax(mtf[edge]))][2][0] for edge in DIRECTIONS}
        return SiteScan(shift, mtf, sigma, vertex, frames, target, 1000 * (attempt + 1))
    raise AssertionError("unreachable")


def _search(recorder: Recorder, number: int, zero: float, first: int = 0) -> float:
    """Return the target shift at which an edge's contrast along the line is highest, metres.

    The whole range of the scan is searched; ``first`` is the number of the first image.
    """
    plan = recorder.bench.setup.test.scan
    site = recorder.bench.sites[number]
    # a wide peak needs only as many positions as place some of them on the peak
    step = max(plan.step, 2.0 * zero / _COARSE)
    shift_range = plan.half_range / site.nominal_per_shift[ALONG]
    shift = np.linspace(-shift_range, shift_range, 2 * int(np.ceil(plan.half_range / step)) + 1)
    measurements = [recorder.attempt(number, ALONG, float(s), k) for k, s in enumerate(shift, first)]
    if all(np.isinf(m[1]) for m in measurements):
        there = f"in {site.band} at field {site.field:g}"
        problem = f"the edge cannot be measured anywhere through focus {there}: {measurements[0][3]}"
        raise BenchError(problem, ("edge",), "another edge, region or light")
    mtf = np.array([m[0] for m in measurements])
    best = int(np.argmax(mtf))
    if best in (0, len(shift) - 1):
        where = "the lower" if best == 0 else "the upper"
        focus = f"best focus of {site.band} at field {site.field:g}"
        problem = f"{focus} is not inside the scan: contrast is highest at {where} end"
        raise BenchError(problem, ("scan", "half_range"), "a larger half_range")
    return float(shift[best])


def _lost(site: Site, problem: FocusError) -> BenchError:
    """Return the error for a site whose scan through focus contains no best focus."""
    return BenchError(
        f"no best focus of {site.band} at field {site.field:g}: {problem}",
        ("scan",),
        "a longer reach, a smaller step, or more light and frames",
    )
