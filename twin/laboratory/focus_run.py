"""Focal-plane alignment by paper 004 (Li et al. 2020, section 2), on a simulated bench or from measured series.

A round measures the through-focus MTF in every field and band, fits a weighted plane through best focus and computes
the shims at the mounting holes. A simulated bench mounts the shims and measures again.

The analysis gets MTF values, readings of a theodolite, the nominal focal length and the drawing of the mount. The true
placement of a simulated assembly is drawn from the seed and affects only the images.

The records at the end define the contents of focus.json.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from analysis.arrays import UM_PER_M as UM
from analysis.focal_plane import plane_fit
from analysis.focal_plane.through_focus import FocusVertex
from optics.geometry.pose import Pose, about_axis, rotation_matrix, rotation_vector
from optics.numerics.backend import Backend, cores
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.collimator import TooNarrowError
from scenes.specs.camera_tests import FocusTestSpec, MeasuredFocusSpec
from scenes.specs.resolved import ExperimentSetup, FocusSetup, MeasuredFocusSetup
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent, stream
from twin.framework.record import Quantity, Record
from twin.laboratory import focus_bench
from twin.laboratory.focus_bench import VERTEX_ERROR, BudgetLine, FocusBench, NyquistMtf, Placement, Recorder, SiteScan
from twin.laboratory.measured_focus import FocusReadings, RowFault, read_focus
from twin.laboratory.turntable_run import DATA_FILE, likely
from twin.sensors.area_detector import FixedPattern
from twin.targets.target_images import ALONG, TRACK

_MISSET, _PATTERNS, _LEVEL, _SETTING, _SCAN = range(5)
_GREY, _EDGE_PIXEL = 2.0, 57.0
"""Memory per pixel, in bytes: of a stored frame, and of a frame of an edge while it is exposed and measured."""


@dataclass(frozen=True, eq=False)
class FocusState:
    """Measurement of one state (placement of the focal-plane assembly) at N sites, which are positions on its CCDs.

    Attributes
    ----------
    scans : tuple of SiteScan
        Through-focus measurements of the sites.
    level : LineLevel or None
        Level of the line by the theodolite; None if it was not read.
    """

    scans: tuple[SiteScan, ...]
    level: plane_fit.LineLevel | None

    @property
    def defocus(self) -> np.ndarray:
        """Measured defocus of the CCDs at the N sites, (N,), metres, positive downstream of best focus."""
        return np.array([scan.defocus for scan in self.scans])

    @property
    def defocus_sigma(self) -> np.ndarray:
        """Standard deviation of the defocus at the N sites due to noise, (N,), metres."""
        return np.array([scan.defocus_sigma for scan in self.scans])

    @property
    def skew(self) -> tuple[float, float]:
        """Shift of all fitted MTF peaks if the curves may be skewed, and its sigma due to noise, metres.

        It is the weighted mean over the sites for each direction of the MTF, averaged over the directions.
        """
        moves, squares = [], []
        for edge in self.scans[0].vertex:
            curves = [scan.vertex[edge] for scan in self.scans]
            weight = np.array([1.0 / max(curve.skew_sigma, 1e-12) ** 2 for curve in curves])
            moves.append(np.average([curve.skew for curve in curves], weights=weight))
            squares.append(1.0 / weight.sum())
        return float(np.mean(moves)), float(np.sqrt(np.sum(squares)) / len(moves))

    @property
    def confocal(self) -> tuple[float, float]:
        """Largest distance of a CCD from best focus and its standard deviation due to noise, metres."""
        return float(np.max(np.abs(self.defocus))), float(np.max(self.defocus_sigma))


@dataclass(frozen=True, eq=False)
class SimulatedState(FocusState):
    """Measurement of one state on the simulated bench, with the true values.

    Dimensions: N sites (positions on the CCDs).

    Attributes
    ----------
    level : LineLevel
        Level of the line, which is always read.
    bench : FocusBench
        Bench that measured it.
    placement : Placement
        True placement of the assembly.
    focus : tuple of NyquistMtf
        MTF of the sites with the target at the collimator's focus; empty when it was not measured.
    true_defocus : (N,) ndarray
        True defocus of the CCDs at the N sites, metres, positive downstream of best focus.
    true_level : float
        True rotation of the line about Z', radians.
    shims : Shimming or None
        Shims that led to this placement; None for the first one.
    """

    level: plane_fit.LineLevel
    bench: FocusBench
    placement: Placement
    focus: tuple[NyquistMtf, ...]
    true_defocus: np.ndarray
    true_level: float
    shims: Shimming | None

    def of_band(self, band: str) -> list[int]:
        """Return the numbers of the sites that lie on a band's CCD."""
        return [k for k, site in enumerate(self.bench.sites) if site.band == band]

    def mtf(self, edge: str) -> dict[str, tuple[float, float]]:
        """Return band -> measured MTF at the Nyquist frequency in one direction, mean of the fields, and its sigma."""
        out = {}
        for band in self.bench.ccds:
            values, sigmas = np.array([self.focus[k].by_edge[edge] for k in self.of_band(band)]).T
            out[band] = float(np.mean(values)), float(np.sqrt(np.sum(sigmas**2)) / len(sigmas))
        return out

    def true_chip_z(self, number: int) -> float:
        """Return the true Z' of the intersection of a site's chief ray with its chip, metres."""
        site = self.bench.sites[number]
        return float(site.crossing(self.placement.pose, self.placement.heights[site.band])[2])

    @property
    def true_mtf(self) -> dict[str, float]:
        """Band -> MTF along the track at the Nyquist frequency by the traced pupils, mean of the fields."""
        sites = self.bench.sites
        return {
            band: float(np.mean([sites[k].imagers[TRACK].mtf(self.true_chip_z(k), sites[k].nyquist) for k in which]))
            for band in self.bench.ccds
            for which in [self.of_band(band)]
        }


@dataclass(frozen=True, eq=False)
class Shimming:
    """Fitted plane of best focus, and the shims computed from it, of one round.

    A vertex is the fitted peak of an MTF curve through focus.

    Attributes
    ----------
    plane : FocalPlaneFit
        Plane fitted to best focus minus CCD.
    plan : ShimPlan
        Shims and motion of the assembly.
    vertex_error : float
        Standard deviation of the error that all vertices have in common, metres.
    vertex_trend : float
        Standard deviation of its change from the middle to the ends of the sites, metres.
    """

    plane: plane_fit.FocalPlaneFit
    plan: plane_fit.ShimPlan
    vertex_error: float = focus_bench.VERTEX_ERROR
    vertex_trend: float = focus_bench.VERTEX_TREND

    @property
    def systematic(self) -> np.ndarray:
        """Sigmas of the plane's piston and slopes along X' and Y' due to the common error of the MTF peaks, (3,).

        They are in metres and radians. This error is the same in every alignment of a camera.
        """
        half_extent = np.max(np.abs(self.plane.position), axis=0)
        return np.array([self.vertex_error, *(self.vertex_trend / half_extent)])

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) of the plane's piston (m) and slopes along X' and Y' (rad).

        It is due to noise and to the error that all fitted MTF peaks have in common.
        """
        return self.plane.noise_covariance + np.diag(self.systematic**2)

    @property
    def plane_covariance(self) -> np.ndarray:
        """Covariance (3, 3) of piston (m) and slopes (rad) of a plane that represents all CCDs.

        It is `covariance` plus the scatter of the measured CCDs about one plane.
        """
        return self.plane.covariance + np.diag(self.systematic**2)

    @property
    def change_sigma(self) -> np.ndarray:
        """Standard deviation of the unrounded changes of the H shims, (H,), metres.

        It includes the error that all fitted MTF peaks have in common.
        """
        holes, up = self.plan.mount.holes, self.plan.mount.normal
        lever = np.cross(holes, up)
        # a piston moves along Z'; a slope along X' is a rotation about -Y', one along Y' about X'
        gain = np.column_stack([np.full(len(holes), up[2]), -lever[:, 1], lever[:, 0]])
        return np.sqrt(np.diag(self.plan.change_covariance) + (gain * self.systematic) ** 2 @ np.ones(3))

    @property
    def expected(self) -> tuple[float, float]:
        """Expected largest distance of a CCD from best focus on the new, rounded shims, and its sigma, metres."""
        left, spread = self.plane.predicted_defocus()
        left = left + self.plan.focus_error(self.plane.position)
        worst = int(np.argmax(np.abs(left)))
        return float(np.abs(left[worst])), float(np.hypot(np.sqrt(spread[worst, worst]), self.vertex_error))


@dataclass(frozen=True, eq=False, kw_only=True)
class FocusRun:
    """Alignment on a simulated bench or from a measured through-focus series.

    Attributes
    ----------
    test : FocusTestSpec or MeasuredFocusSpec
        Specification from the test's file.
    seed : int
        Seed of all random numbers.
    bands : tuple of str
        Band of the CCD at each of the N sites; empty where a table has no bands.
    positions : (N, 2) ndarray
        Positions (X', Y') of the sites, metres.
    states : tuple of FocusState
        Measured states.
    shimmings : tuple of Shimming
        Plane and shims after each of them; a simulated bench also measures the state on the last shims.
    readings : FocusReadings or None
        Series that was read from files; None for a simulated bench.
    """

    test: FocusTestSpec | MeasuredFocusSpec
    seed: int
    bands: tuple[str, ...]
    positions: np.ndarray
    states: tuple[FocusState, ...]
    shimmings: tuple[Shimming, ...]
    readings: FocusReadings | None = None

    @property
    def edges(self) -> tuple[str, ...]:
        """Directions in which the MTF was measured, along the line and along the track."""
        return tuple(self.states[0].scans[0].vertex)

    @property
    def chi_square(self) -> tuple[float, int]:
        """Chi-square of all MTF curves through focus of the first state together, and its degrees of freedom."""
        vertices = [vertex for scan in self.states[0].scans for vertex in scan.vertex.values()]
        return sum(v.chi_square for v in vertices), sum(v.degrees_of_freedom for v in vertices)


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedFocus(FocusRun):
    """Alignment on the simulated bench, with the true values.

    Attributes
    ----------
    bench : FocusBench
        Bench of the alignment.
    states : tuple of SimulatedState
        Measured states, one more than there are rounds of shims.
    """

    bench: FocusBench
    states: tuple[SimulatedState, ...]

    @cached_property
    def budget(self) -> tuple[BudgetLine, ...]:
        """MTF budget of the bands at the Nyquist frequency: the factors of which the MTF is the product."""
        return self.bench.budget()

    def true_plane(self, number: int) -> np.ndarray:
        """Return piston and slopes, (3,), of the plane fitted to the true defocus, metres and radians.

        The sites have the weights of the measured fit, ``shimmings[number].plane``.
        """
        plane = self.shimmings[number].plane
        weight = 1.0 / np.sqrt(plane.sigma**2 + plane.extra_sigma**2)
        design = np.column_stack([np.ones(len(weight)), plane.position]) * weight[:, None]
        terms, *_ = np.linalg.lstsq(design, -self.states[number].true_defocus * weight, rcond=None)
        return np.asarray(terms)


def run_focus(setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent) -> FocusRun:
    """Run the alignment of ``python -m twin.lab focus``, simulated or from measurements.

    Raises
    ------
    InputError
        The camera cannot be built as the file specifies, or a table of measurements cannot be used.
    BenchError
        The test cannot be carried out as its file specifies.
    """
    if isinstance(setup, MeasuredFocusSetup):
        return align_files(setup.test, seed, advance)
    assert isinstance(setup, FocusSetup)
    mount_of(setup.test)
    _require_memory(setup)
    try:
        bench = FocusBench(setup, backend, advance)
    except TooNarrowError as error:
        raise BenchError(str(error), ("collimator", "aperture"), "a wider collimator") from error
    except (AimError, BeamMissedError, ValueError) as error:
        raise BenchError(str(error), ("as_built",), "a camera whose beam passes without vignetting") from error
    _check_light(bench)
    return align(bench, seed, advance)


def _require_memory(setup: FocusSetup) -> None:
    """Raise an error unless all frames in focus, and the frames of one edge per thread, fit into memory."""
    test = setup.test
    series = 2 * test.rounds * len(setup.camera.bands) * len(test.fields)  # of edges in two directions
    bytes_per_frame = test.edge.region**2 * (series * _GREY + cores() * _EDGE_PIXEL)
    require_memory(Lowered(test, ("frames",), test.frames, "frames", lambda frames: frames * bytes_per_frame))


def align_files(spec: MeasuredFocusSpec, seed: int = 0, advance: Advance = silent) -> FocusRun:
    """Read a measured series, find best focus at every site, fit the plane and compute the shims.

    Parameters
    ----------
    spec : MeasuredFocusSpec
        Specification of the test.
    seed : int
        Seed of the command, which is only reported: no random numbers are needed.
    advance : Advance
        Called with the progress.

    Raises
    ------
    InputError
        A table or an image cannot be used, or best focus cannot be determined from it.
    BenchError
        The mount does not allow the motion.
    """
    readings = read_focus(spec.measured, advance)
    level = (
        None
        if spec.measured.level is None
        else plane_fit.LineLevel(spec.measured.level.angle, spec.measured.level.sigma)
    )
    state = FocusState(readings.scans, level)
    present = np.array(spec.shims or [spec.mount.thickness] * len(spec.mount.holes))
    try:
        skew, noise = state.skew
        # skew of the curves beyond its noise is an error common to all sites
        shared = float(np.sqrt(spec.vertex_error**2 + max(skew**2 - noise**2, 0.0)))
        shimming = plan_shimming(readings.positions, state, mount_of(spec), present, (shared, spec.vertex_trend))
    except plane_fit.ObservabilityError as error:
        raise readings.table.error(0, "x", str(error).removeprefix("focal plane: ")) from error
    return FocusRun(
        test=spec,
        seed=seed,
        bands=readings.bands,
        positions=readings.positions,
        states=(state,),
        shimmings=(shimming,),
        readings=readings,
    )


def _check_light(bench: FocusBench) -> None:
    """Raise BenchError if the bright side of the edge would saturate, which would falsify its MTF."""
    most = {name: ccd.largest_white for name, ccd in bench.ccds.items()}
    name = min(most, key=lambda n: most[n])
    white = bench.setup.test.white
    if white > most[name]:
        problem = f"the bright side of the edge, {100 * white:g}% of the full well, saturates pixels of {name}"
        raise BenchError(problem, ("white",), f"{np.floor(100 * most[name]):.0f} percent or less")


def align(bench: FocusBench, seed: int, advance: Advance = silent) -> SimulatedFocus:
    """Simulate an alignment: misalign the focal plane at random, then measure and shim it in rounds.

    Raises
    ------
    BenchError
        Best focus lies outside of the scan, or the mount does not allow the motion.
    """
    test = bench.setup.test
    placement = draw_placement(bench, seed)
    patterns = _patterns(bench, seed)
    mount = mount_of(test)
    present = np.full(len(test.mount.holes), test.mount.thickness)
    positions = np.array([site.place for site in bench.sites])
    states = [_measure_placement(bench, placement, patterns, seed, None, 0, advance)]
    shimmings: list[Shimming] = []
    for number in range(test.rounds):
        shimming = plan_shimming(positions, states[-1], mount, present)
        present = shimming.plan.thickness
        shimmings.append(shimming)
        setting = np.random.default_rng(stream(seed, _SETTING, number)).normal(0.0, test.level)
        placement = Placement(_on_new_shims(placement.pose, shimming.plan, mount, float(setting)), placement.heights)
        states.append(_measure_placement(bench, placement, patterns, seed, shimming, number + 1, advance))
    return SimulatedFocus(
        test=test,
        seed=seed,
        bands=tuple(site.band for site in bench.sites),
        positions=positions,
        states=tuple(states),
        shimmings=tuple(shimmings),
        bench=bench,
    )


def plan_shimming(
    positions: np.ndarray,
    state: FocusState,
    mount: plane_fit.Mount,
    present: np.ndarray,
    vertex: tuple[float, float] = (focus_bench.VERTEX_ERROR, focus_bench.VERTEX_TREND),
) -> Shimming:
    """Fit the plane through best focus and compute the shims that bring the assembly there.

    Parameters
    ----------
    positions : (N, 2) ndarray
        Positions X', Y' of the N sites, metres.
    state : FocusState
        Measured state; without a level of the line its rotation about Z' is not corrected.
    mount : Mount
        Mounting surface with its holes.
    present : (H,) ndarray
        Present thickness of the H shims, metres.
    vertex : tuple of float
        Standard deviations of the error common to all fitted MTF peaks and of its trend, metres.

    Raises
    ------
    ObservabilityError
        The sites do not determine a slope.
    BenchError
        The mount does not allow the motion.
    """
    # the plane is fitted to the distance of best focus downstream of the CCD
    plane = plane_fit.fit_focal_plane(positions, -state.defocus, state.defocus_sigma, estimate_extra=True)
    return Shimming(plane, plan_shims(plane.correction(state.level), mount, present), *vertex)


def draw_placement(bench: FocusBench, seed: int) -> Placement:
    """Return the random misaligned placement of the focal plane at the beginning, which the seed determines."""
    spec = bench.setup.test.misset
    random = np.random.default_rng(stream(seed, _MISSET))
    rotation = rotation_matrix(np.array(spec.rotate) * random.standard_normal(3))
    shift = np.array(spec.shift) * random.standard_normal(3)
    heights = {name: float(spec.chips * random.standard_normal()) for name in bench.ccds}
    return Placement(Pose(rotation, shift), heights)


def mount_of(test: FocusTestSpec | MeasuredFocusSpec) -> plane_fit.Mount:
    """Return the mounting surface with its holes, as specified by the drawing, in the assembly's frame.

    Raises
    ------
    BenchError
        The holes cannot carry a tilt.
    """
    spec = test.mount
    try:
        return plane_fit.Mount.of(np.array(spec.holes), about_axis(1, spec.tilt)[:, 2], spec.clearance, spec.step)
    except plane_fit.ShimError as error:
        raise BenchError(str(error), ("mount", "holes"), "three holes or more that span a plane") from error


def plan_shims(correction: plane_fit.RigidMotion, mount: plane_fit.Mount, present: np.ndarray) -> plane_fit.ShimPlan:
    """Compute the shims that move the focal-plane assembly by a correction.

    ``present`` is the present thickness of each shim, metres.

    Raises
    ------
    BenchError
        The mount does not allow the motion.
    """
    try:
        return plane_fit.shim_plan(correction, mount, present)
    except plane_fit.ShimError as error:
        if error.slides:
            slide, far = max(zip(error.slides, error.holes, strict=True))
            limit = f"but the screws allow {1e3 * mount.clearance:.3g} mm"
            problem = (
                f"the alignment would slide hole_{far + 1} by {1e3 * slide:.3g} mm in the mounting surface, {limit}"
            )
            raise BenchError(problem, ("mount", "clearance"), "more clearance, or a smaller misset") from error
        raise BenchError(str(error), ("mount", "thickness"), "thicker shims to begin with") from error


def line_rotation(pose: Pose) -> float:
    """Return the rotation of the line about Z' in a pose of the assembly, radians."""
    x, y, _ = pose.rotation[:, 1]
    return float(np.arctan2(-x, y))


def recorder_of(
    bench: FocusBench, placement: Placement, seed: int, number: int, patterns: Mapping[str, FixedPattern] | None = None
) -> Recorder:
    """Return the recorder of edge images for a placement of the assembly; equal arguments give equal frames.

    Parameters
    ----------
    bench : FocusBench
        Bench with the camera.
    placement : Placement
        Placement of the assembly.
    seed : int
        Seed of the alignment.
    number : int
        Number of the round before this placement, 0 for none.
    patterns : mapping, optional
        Band -> fixed pattern of its columns; by default drawn from the seed.
    """
    drawn = _patterns(bench, seed) if patterns is None else patterns
    return Recorder(bench, placement, stream(seed, _SCAN, number), drawn)


def _patterns(bench: FocusBench, seed: int) -> dict[str, FixedPattern]:
    """Return band -> fixed pattern (gain and offset) of the columns of its line CCD, drawn from the seed."""
    return {name: ccd.pattern(stream(seed, _PATTERNS, k)) for k, (name, ccd) in enumerate(bench.ccds.items())}


def _measure_placement(
    bench: FocusBench,
    placement: Placement,
    patterns: Mapping[str, FixedPattern],
    seed: int,
    shims: Shimming | None,
    number: int,
    advance: Advance,
) -> SimulatedState:
    """Measure one placement of the assembly; only for the first one is focus searched over the whole range."""
    recorder = recorder_of(bench, placement, seed, number, patterns)
    name = "through focus, before" if number == 0 else f"through focus, round {number}"
    scans = focus_bench.scan(recorder, lambda _, done, total: advance(name, done, total), search=number == 0)
    sigma = bench.setup.test.level
    true_angle = line_rotation(placement.pose)
    reading = true_angle + float(np.random.default_rng(stream(seed, _LEVEL, number)).normal(0.0, sigma))
    return SimulatedState(
        scans,
        plane_fit.LineLevel(reading, sigma),
        bench,
        placement,
        focus_bench.in_focus(recorder) if number > 0 else (),
        np.array([site.defocus(placement.pose, placement.heights[site.band]) for site in bench.sites]),
        true_angle,
        shims,
    )


def _on_new_shims(pose: Pose, plan: plane_fit.ShimPlan, mount: plane_fit.Mount, setting: float) -> Pose:
    """Return the pose of the assembly on its new shims.

    Its rotation in the mounting surface is set with an error of ``setting`` radians.
    """
    achieved = plan.achieved
    rotated = rotation_matrix(setting * mount.normal) @ achieved.matrix
    return pose @ Pose(rotated, achieved.shift)


def _holes(values: Iterable[Any]) -> dict[str, Any]:
    """Return name of the mounting hole -> value, from an array of the H holes' values, (H, ...)."""
    return {f"hole_{k + 1}": value for k, value in enumerate(values)}


def _ground(metres: Any) -> Any:
    """Return shim thicknesses in micrometres, from metres in whole grinding steps, without rounding residue.

    They are rounded to picometres.
    """
    return np.round(UM * np.asarray(metres), 6)


def _mtf(state: SimulatedState, edge: str, which: int) -> dict[str, float]:
    """Return band -> MTF at the Nyquist frequency in one direction, or its sigma.

    ``which`` is 0 for the MTF and 1 for its sigma.
    """
    return {band: pair[which] for band, pair in state.mtf(edge).items()}


def _shims(state: SimulatedState) -> Shimming:
    """Return the shims with which the focal plane came to the placement of a state."""
    assert state.shims is not None
    return state.shims


SITES: Record[SimulatedState] = Record(
    "One band's CCD in one field.",
    Quantity("band", lambda s: [site.band for site in s.bench.sites], "name of the band"),
    Quantity(
        "field", lambda s: [site.field for site in s.bench.sites], "position along the line, fraction of half the line"
    ),
    Quantity("defocus_um", lambda s: s.defocus, "defocus of the CCD, positive downstream of best focus"),
    Quantity("defocus_um_sigma", lambda s: s.defocus_sigma, "standard deviation by noise"),
)
CORRECTION: Record[Shimming] = Record(
    "Motion that corrects the measured defocus. Its sigmas include noise and the error common to all vertices.",
    Quantity("rotation_arcmin", lambda s: s.plan.wanted.rotation, "rotation vector about X', Y', Z'"),
    Quantity("shift_um", lambda s: s.plan.wanted.shift, "shift along X', Y', Z'"),
    Quantity("piston_um_sigma", lambda s: np.sqrt(s.covariance[0, 0]), "standard deviation of the shift along Z'"),
    Quantity(
        "slope_x_arcsec_sigma",
        lambda s: np.sqrt(s.covariance[1, 1]),
        "standard deviation of the slope of best focus along X'",
    ),
    Quantity(
        "slope_y_arcsec_sigma",
        lambda s: np.sqrt(s.covariance[2, 2]),
        "standard deviation of the slope of best focus along Y'",
    ),
)
STATE: Record[SimulatedState] = Record(
    "Measured state of the assembly.",
    Quantity("confocal_um_max", lambda s: s.confocal[0], "largest distance of a CCD from best focus"),
    Quantity("confocal_um_sigma", lambda s: np.hypot(s.confocal[1], VERTEX_ERROR), "noise and error of the vertices"),
    Quantity("line_level_arcmin", lambda s: s.level.angle, "rotation of the line about Z', by the theodolite"),
    Quantity("line_level_arcmin_sigma", lambda s: s.level.sigma, "standard deviation of the theodolite"),
    Quantity("sites", SITES.rows, "all bands in all fields"),
)
ROUND: Record[SimulatedState] = Record(
    "Measured state of the assembly on new shims, and the shims.",
    *STATE,
    Quantity(
        "mtf_nyquist", lambda s: _mtf(s, TRACK, 0), "band -> MTF with the pixel along the track, mean of the fields"
    ),
    Quantity("mtf_nyquist_sigma", lambda s: _mtf(s, TRACK, 1), "band -> its standard deviation by noise"),
    Quantity(
        "mtf_nyquist_along_line",
        lambda s: _mtf(s, ALONG, 0),
        "band -> MTF with the pixel along the line, mean of the fields",
    ),
    Quantity("mtf_nyquist_along_line_sigma", lambda s: _mtf(s, ALONG, 1), "band -> its standard deviation by noise"),
    Quantity("shims_um", lambda s: _holes(_ground(_shims(s).plan.thickness)), "thickness by hole", converted=False),
    Quantity(
        "shim_changes_um",
        lambda s: _holes(_ground(_shims(s).plan.rounded_change)),
        "change of thickness by hole",
        converted=False,
    ),
    Quantity("slides_mm", lambda s: _holes(_shims(s).plan.slide), "displacement in the mounting surface, by hole"),
    Quantity(
        "rotation_by_hand_arcmin",
        lambda s: _shims(s).plan.rotation,
        "rotation about the normal of the mounting surface",
    ),
    Quantity(
        "line_level_without_rotation_arcmin",
        lambda s: _shims(s).plan.level_coupling,
        "error of level without this rotation",
    ),
    Quantity("correction", _shims, "motion that corrects the measured defocus", record=CORRECTION),
    Quantity("chips_um_rms", lambda s: _shims(s).plane.extra_sigma, "scatter of the CCDs about one plane"),
)
BUDGET: Record[BudgetLine] = Record(
    "MTF budget of one band at the Nyquist frequency in one direction.",
    Quantity("band", lambda line: line.band, "name of the band"),
    Quantity("direction", lambda line: line.edge, "along the line or the track"),
    Quantity("factors", lambda line: line.factors, "effect -> its transfer factor"),
    Quantity("total", lambda line: line.total, "product of the factors"),
)
TRUE_STATE: Record[SimulatedState] = Record(
    "True state of the assembly, by the exact trace.",
    Quantity("confocal_um_max", lambda s: np.max(np.abs(s.true_defocus)), "largest distance from best focus"),
    Quantity("line_level_arcmin", lambda s: s.true_level, "rotation of the line about Z'"),
    Quantity("mtf_nyquist", lambda s: s.true_mtf, "band -> MTF with the pixel along the track, mean of the fields"),
    Quantity(
        "rotation_arcmin", lambda s: rotation_vector(s.placement.pose.rotation), "rotation vector of the assembly"
    ),
    Quantity("shift_um", lambda s: s.placement.pose.translation, "shift of the assembly"),
    Quantity("chip_height_um", lambda s: s.placement.heights, "band -> height of its chip above the assembly"),
    Quantity("defocus_um", lambda s: s.true_defocus, "defocus of the CCDs in the order of `sites`"),
)
TRUTH: Record[SimulatedFocus] = Record(
    "Truth, which the analysis does not know.",
    Quantity("initial", lambda r: r.states[0], "before the first round", record=TRUE_STATE),
    Quantity("rounds", lambda r: r.states[1:], "after each round", record=TRUE_STATE),
)
SIMULATED: Record[SimulatedFocus] = Record(
    "focus.json of a simulated bench.",
    Quantity("camera", lambda r: r.bench.setup.camera.name, "name of the camera"),
    Quantity("seed", lambda r: r.seed, "seed of all that was drawn"),
    Quantity("initial", lambda r: r.states[0], "before the first round", record=STATE),
    Quantity("rounds", lambda r: r.states[1:], "after each round", record=ROUND),
    Quantity("mtf_budget", lambda r: r.budget, "MTF budget in the middle of the field", record=BUDGET),
    Quantity("truth", lambda r: r, "truth by the exact trace", record=TRUTH),
)
CURVE: Record[FocusVertex] = Record(
    "A curve through focus.",
    Quantity("vertex_um", lambda v: v.position, "best focus as a shift of the image", "vertex", 2),
    Quantity("vertex_um_sigma", lambda v: v.sigma, "standard deviation by noise", "sigma", 2),
    Quantity("peak_mtf", lambda v: v.peak, "MTF in best focus", "peak", 4),
    Quantity("peak_mtf_sigma", lambda v: v.peak_sigma, "standard deviation by noise", "sigma of it", 4),
    Quantity("chi_square", lambda v: v.chi_square, "chi-square of the fitted curve", "χ²", 2),
    Quantity("degrees_of_freedom", lambda v: v.degrees_of_freedom, "points used minus three unknowns", "ν"),
    Quantity("positions", lambda v: len(v.used), "points of the curve", "positions"),
    Quantity("positions_used", lambda v: np.sum(v.used), "points near the peak that the fit uses", "used"),
)
_PlaneState: TypeAlias = tuple[FocusRun, FocusState, Shimming]
SITE: Record[_PlaneState] = Record(
    "One site of the focal plane, before the shims are changed.",
    Quantity("band", lambda s: list(s[0].bands), "name of the band"),
    Quantity("x_mm", lambda s: s[0].positions[:, 0], "X', in the flight direction", "x", 3),
    Quantity("y_mm", lambda s: s[0].positions[:, 1], "Y', along the line", "y", 3),
    Quantity(
        "defocus_um",
        lambda s: s[1].defocus,
        "defocus of the CCD, positive downstream of best focus",
        "CCD downstream of focus",
        2,
    ),
    Quantity("defocus_um_sigma", lambda s: s[1].defocus_sigma, "standard deviation by noise", "sigma", 2),
    Quantity("residual_um", lambda s: s[2].plane.residual, "best focus minus the fitted plane", "from the plane", 2),
    Quantity(
        "curves",
        lambda s: [{e: CURVE(v) for e, v in scan.vertex.items()} for scan in s[1].scans],
        "direction -> curve through focus",
    ),
)
PLANE: Record[Shimming] = Record(
    "Weighted plane of best focus minus CCD. Its sigmas include the error common to all vertices.",
    Quantity("piston_um", lambda s: s.plane.piston, "piston of the plane", decimals=2),
    Quantity("piston_um_sigma", lambda s: np.sqrt(s.plane_covariance[0, 0]), "standard deviation"),
    Quantity("slope_x_arcsec", lambda s: s.plane.slope_x, "slope along X′", decimals=2),
    Quantity("slope_x_arcsec_sigma", lambda s: np.sqrt(s.plane_covariance[1, 1]), "standard deviation"),
    Quantity("slope_y_arcsec", lambda s: s.plane.slope_y, "slope along Y′", decimals=2),
    Quantity("slope_y_arcsec_sigma", lambda s: np.sqrt(s.plane_covariance[2, 2]), "standard deviation"),
    Quantity("covariance", lambda s: s.plane_covariance, "covariance of piston and slopes, metres and radians"),
    Quantity(
        "chi_square",
        lambda s: s.plane.chi_square,
        "chi-square of the sites about the plane, with their sigmas by noise",
    ),
    Quantity("degrees_of_freedom", lambda s: s.plane.degrees_of_freedom, "sites minus three unknowns"),
    Quantity("probability", lambda s: s.plane.p_value, "p-value of this chi-square"),
    Quantity("chips_um_rms", lambda s: s.plane.extra_sigma, "scatter of the CCDs about one plane, RMS", decimals=2),
)
SHIMS: Record[Shimming] = Record(
    "The shim of one mounting hole.",
    Quantity("change_um", lambda s: s.plan.change, "exact change of thickness", "change", 1),
    Quantity("change_um_sigma", lambda s: s.change_sigma, "standard deviation", "sigma", 1),
    Quantity(
        "ground_um", lambda s: _ground(s.plan.rounded_change), "change that is ground", "ground", 1, converted=False
    ),
    Quantity("shim_um", lambda s: _ground(s.plan.thickness), "new thickness", "new shim", 1, converted=False),
    Quantity("slide_mm", lambda s: s.plan.slide, "displacement in the mounting surface, by hand", "slide", 3),
)
ROW_FAULT: Record[RowFault] = Record(
    "Row of the table with the reason why it, or its image, is excluded or doubtful.",
    Quantity("file", lambda fault: fault.file, "path of the table"),
    Quantity("line", lambda fault: fault.line, "line of the table"),
    Quantity("reason", lambda fault: fault.reason, "reason"),
)


def _first_plane(run: FocusRun) -> _PlaneState:
    """Return the run, its first state, and the plane fitted to that state's best foci."""
    return run, run.states[0], run.shimmings[0]


MEASURED: Record[FocusRun] = Record(
    "focus.json of a measured series. Expected values: on the new shims, after rounding, by the best prediction.",
    Quantity("name", lambda r: r.test.name, "name of the test"),
    Quantity("seed", lambda r: r.seed, "seed of the command; nothing is drawn"),
    Quantity("confocal_um_max", lambda r: r.states[0].confocal[0], "largest distance of a CCD from best focus"),
    Quantity(
        "confocal_um_sigma",
        lambda r: np.hypot(r.states[0].confocal[1], r.shimmings[0].vertex_error),
        "noise and error of the vertices",
    ),
    Quantity("line_level_arcmin", lambda r: r.states[0].level and r.states[0].level.angle, "rotation about Z'"),
    Quantity("line_level_arcmin_sigma", lambda r: r.states[0].level and r.states[0].level.sigma, "standard deviation"),
    Quantity("plane", lambda r: r.shimmings[0], "plane that the shims correct", record=PLANE),
    Quantity("correction", lambda r: r.shimmings[0], "motion that corrects the measured defocus", record=CORRECTION),
    Quantity("shims", lambda r: _holes(SHIMS.rows(r.shimmings[0])), "hole -> shim"),
    Quantity(
        "rotation_by_hand_arcmin",
        lambda r: r.shimmings[0].plan.rotation,
        "rotation about the normal of the mounting surface",
    ),
    Quantity(
        "line_level_without_rotation_arcmin", lambda r: r.shimmings[0].plan.level_coupling, "error of level without it"
    ),
    Quantity(
        "expected_confocal_um_max",
        lambda r: r.shimmings[0].expected[0],
        "expected largest distance of a CCD from best focus",
    ),
    Quantity("expected_confocal_um_sigma", lambda r: r.shimmings[0].expected[1], "standard deviation"),
    Quantity("skew_um", lambda r: r.states[0].skew[0], "common shift of all vertices if curves may be skewed"),
    Quantity("skew_um_sigma", lambda r: r.states[0].skew[1], "standard deviation by noise"),
    Quantity("curves_chi_square", lambda r: r.chi_square[0], "chi-square of all curves through focus"),
    Quantity("curves_degrees_of_freedom", lambda r: r.chi_square[1], "degrees of freedom of all curves"),
    Quantity("curves_agree", lambda r: likely(*r.chi_square), "true if its p-value is 0.001 or more"),
    Quantity("sites", lambda r: SITE.rows(_first_plane(r)), "all sites"),
    Quantity(
        "images_without_edge",
        lambda r: r.readings and r.readings.no_edge,
        "images without a measurable edge",
        record=ROW_FAULT,
    ),
    Quantity(
        "images_with_structure",
        lambda r: r.readings and r.readings.uneven,
        "images whose sigma is doubtful",
        record=ROW_FAULT,
    ),
    Quantity("rows_excluded", lambda r: r.readings and r.readings.excluded, "rows off their curves", record=ROW_FAULT),
    Quantity("files", lambda r: r.readings and [r.readings.file], "files that were read", record=DATA_FILE),
)


def focus_numbers(run: FocusRun) -> dict[str, Any]:
    """Return the contents of focus.json, all results of the alignment as plain data, without the frames."""
    return SIMULATED(run) if isinstance(run, SimulatedFocus) else MEASURED(run)
