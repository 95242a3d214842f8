"""Focal-plane alignment as paper 004 carries it out (section 2): through-focus MTF of every field and band, a weighted
plane, shims at the mounting holes, and the same again; on a simulated bench or from a measured through-focus series.

The analysis gets MTF values, readings of a theodolite, the nominal focal length and the drawing of the mount. Where a
simulated assembly really stands is drawn from the seed and known to the images alone.

Numbers of a focal-plane alignment, as focus.json has them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from analysis.arrays import UM_PER_M as UM
from analysis.focal_plane.plane_fit import (
    FocalPlaneFit,
    LineLevel,
    Mount,
    ObservabilityError,
    RigidMotion,
    ShimError,
    ShimPlan,
    fit_focal_plane,
    shim_plan,
)
from analysis.focal_plane.through_focus import FocusVertex
from optics.geometry.pose import Pose, about_axis, rotation_matrix, rotation_vector
from optics.numerics.backend import Backend, cores
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.collimator import TooNarrowError
from scenes.specs.camera_tests import FocusTestSpec, MeasuredFocusSpec
from scenes.specs.resolved import ExperimentSetup, FocusSetup, MeasuredFocusSetup
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.framework.record import Quantity, Record
from twin.laboratory import focus_bench
from twin.laboratory.focus_bench import VERTEX_ERROR, BudgetLine, FocusBench, NyquistMtf, Recorder, SiteScan, Standing
from twin.laboratory.measured_focus import FocusReadings, RowFault, read_focus
from twin.laboratory.turntable_run import DATA_FILE, likely
from twin.sensors.area_detector import FixedPattern
from twin.targets.target_images import ALONG, TRACK

_MISSET, _PATTERNS, _LEVEL, _SETTING, _SCAN = range(5)
_GREY, _EDGE_PIXEL = 2.0, 57.0
"""Bytes per pixel of a frame that is kept, and of one of an edge while it is exposed and measured."""


@dataclass(frozen=True, eq=False)
class FocusState:
    """The assembly as it stands, measured at N sites.

    Attributes
    ----------
    scans : tuple[SiteScan, ...]
        Through focus, site by site.
    level : LineLevel | None
        Of the line by the theodolite; None if nobody read it.
    """

    scans: tuple[SiteScan, ...]
    level: LineLevel | None

    @property
    def defocus(self) -> np.ndarray:
        """Measured, (N,), metres, positive where the CCD stands downstream of best focus."""
        return np.array([scan.defocus for scan in self.scans])

    @property
    def defocus_sigma(self) -> np.ndarray:
        """Standard deviation of `defocus` by noise, (N,), metres."""
        return np.array([scan.defocus_sigma for scan in self.scans])

    @property
    def skew(self) -> tuple[float, float]:
        """Return by how much the places move together if curves may be skewed, and its sigma by noise, metres.

        It is the weighted mean over the places of an edge's direction, and the mean of the directions.
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
        """Largest distance of any site from best focus and its sigma by noise, metres."""
        return float(np.max(np.abs(self.defocus))), float(np.max(self.defocus_sigma))


@dataclass(frozen=True, eq=False)
class SimulatedState(FocusState):
    """The assembly on the simulated bench, measured and true.

    Attributes
    ----------
    level : LineLevel
        There is always one.
    bench : FocusBench
        Where it stands.
    standing : Standing
        truth.
    focus : tuple[NyquistMtf, ...]
        MTF with the target at the collimator's focus, site by site; empty when it was not measured.
    true_defocus : np.ndarray
        How far each site's CCD stands downstream of best focus, (N,), metres.
    true_level : float
        Turn of the line about Z', radians.
    shims : Shimming | None
        What led to it; None for the first standing.
    """

    level: LineLevel
    bench: FocusBench
    standing: Standing
    focus: tuple[NyquistMtf, ...]
    true_defocus: np.ndarray
    true_level: float
    shims: Shimming | None

    def of_band(self, band: str) -> list[int]:
        """Numbers of a band's sites."""
        return [k for k, site in enumerate(self.bench.sites) if site.band == band]

    def mtf(self, edge: str) -> dict[str, tuple[float, float]]:
        """Band -> measured MTF at the Nyquist frequency for edges of a direction, mean of the fields, and its sigma."""
        out = {}
        for band in self.bench.ccds:
            values, sigmas = np.array([self.focus[k].by_edge[edge] for k in self.of_band(band)]).T
            out[band] = float(np.mean(values)), float(np.sqrt(np.sum(sigmas**2)) / len(sigmas))
        return out

    def true_place(self, number: int) -> float:
        """Z' at which the chief ray of a site meets its chip, metres."""
        site = self.bench.sites[number]
        return float(site.crossing(self.standing.pose, self.standing.heights[site.band])[2])

    @property
    def true_mtf(self) -> dict[str, float]:
        """Band -> MTF along the track at the Nyquist frequency by the traced pupils, mean of the fields."""
        sites = self.bench.sites
        return {
            band: float(np.mean([sites[k].imagers[TRACK].mtf(self.true_place(k), sites[k].nyquist) for k in which]))
            for band in self.bench.ccds
            for which in [self.of_band(band)]
        }


@dataclass(frozen=True, eq=False)
class Shimming:
    """One round's decision: the fitted plane and the shims.

    Attributes
    ----------
    plane, plan : FocalPlaneFit
        As fitted and as decided.
    vertex_error : float
        That all vertices share, one sigma, metres.
    vertex_trend : float
        By how much it changes from the middle to the ends of the places, one sigma, metres.
    """

    plane: FocalPlaneFit
    plan: ShimPlan
    vertex_error: float = focus_bench.VERTEX_ERROR
    vertex_trend: float = focus_bench.VERTEX_TREND

    @property
    def systematic(self) -> np.ndarray:
        """Sigmas of piston, slope_x and slope_y by the vertices' own error, (3,), metres and radians: the part that is
        the same in every alignment of a camera.
        """
        reach = np.max(np.abs(self.plane.position), axis=0)
        return np.array([self.vertex_error, *(self.vertex_trend / reach)])

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) of piston, slope_x, slope_y against the true plane: noise and the vertices' own error."""
        return self.plane.noise_covariance + np.diag(self.systematic**2)

    @property
    def plane_covariance(self) -> np.ndarray:
        """Covariance (3, 3) of piston, slope_x, slope_y of a plane for all CCDs: as `covariance`, and what the measured
        CCDs are off one plane.
        """
        return self.plane.covariance + np.diag(self.systematic**2)

    @property
    def change_sigma(self) -> np.ndarray:
        """Standard deviation of the shims' exact changes, (H,), metres, the vertices' own error included."""
        holes, up = self.plan.mount.holes, self.plan.mount.normal
        lever = np.cross(holes, up)
        # a piston moves along Z', a slope along X' turns about -Y' and one along Y' about X'
        gain = np.column_stack([np.full(len(holes), up[2]), -lever[:, 1], lever[:, 0]])
        return np.sqrt(np.diag(self.plan.change_covariance) + (gain * self.systematic) ** 2 @ np.ones(3))

    @property
    def expected(self) -> tuple[float, float]:
        """Largest distance of a site from best focus that is expected on the new shims, after rounding, and its sigma,
        metres.
        """
        left, spread = self.plane.predicted_defocus()
        left = left + self.plan.focus_error(self.plane.position)
        worst = int(np.argmax(np.abs(left)))
        return float(np.abs(left[worst])), float(np.hypot(np.sqrt(spread[worst, worst]), self.vertex_error))


@dataclass(frozen=True, eq=False, kw_only=True)
class FocusRun:
    """One alignment, on a simulated bench or from a measured through-focus series.

    Attributes
    ----------
    test : FocusTestSpec | MeasuredFocusSpec
        What its file says.
    seed : int
        Of what was drawn.
    bands : tuple[str, ...]
        Whose CCD stands at each of the N sites; an empty name where a table does not say.
    places : np.ndarray
        (X', Y') of the sites, (N, 2), metres.
    states : tuple[FocusState, ...]
        The standings that were measured.
    shimmings : tuple[Shimming, ...]
        What was decided after each of them; a simulated bench also measures what the last one leads to.
    readings : FocusReadings | None
        As read from files; None for a simulated bench.
    """

    test: FocusTestSpec | MeasuredFocusSpec
    seed: int
    bands: tuple[str, ...]
    places: np.ndarray
    states: tuple[FocusState, ...]
    shimmings: tuple[Shimming, ...]
    readings: FocusReadings | None = None

    @property
    def edges(self) -> tuple[str, ...]:
        """Directions that were measured."""
        return tuple(self.states[0].scans[0].vertex)

    @property
    def chi_square(self) -> tuple[float, int]:
        """Chi-square of all curves through focus of the first standing together, and their degrees of freedom."""
        every = [vertex for scan in self.states[0].scans for vertex in scan.vertex.values()]
        return sum(v.chi_square for v in every), sum(v.degrees_of_freedom for v in every)


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedFocus(FocusRun):
    """An alignment on the simulated bench, which also knows the truth.

    Attributes
    ----------
    bench : FocusBench
        With all that was set up.
    states : tuple[SimulatedState, ...]
        One more than there are shimmings.
    """

    bench: FocusBench
    states: tuple[SimulatedState, ...]

    @cached_property
    def budget(self) -> tuple[BudgetLine, ...]:
        """What makes the MTF, as `FocusBench.budget` traces it."""
        return self.bench.budget()

    def true_plane(self, number: int) -> np.ndarray:
        """What ``shimmings[number].plane`` should have been: piston and slopes (3,) of the true defocus with the same
        weights.
        """
        plane = self.shimmings[number].plane
        weight = 1.0 / np.sqrt(plane.sigma**2 + plane.extra_sigma**2)
        design = np.column_stack([np.ones(len(weight)), plane.position]) * weight[:, None]
        terms, *_ = np.linalg.lstsq(design, -self.states[number].true_defocus * weight, rcond=None)
        return np.asarray(terms)


def run_focus(setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent) -> FocusRun:
    """``python -m twin.lab focus``.

    Raises
    ------
    InputError
        The camera cannot be built as the file says; a table of measurements cannot be used.
    BenchError
        What the file asks for cannot be done.
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
        raise BenchError(str(error), ("as_built",), "a camera whose whole beam gets through") from error
    _check_light(bench)
    return align(bench, seed, advance)


def _require_memory(setup: FocusSetup) -> None:
    """See whether the frames in focus, and those of one edge in each thread, fit into the memory."""
    test = setup.test
    series = 2 * test.rounds * len(setup.camera.bands) * len(test.fields)  # of edges in two directions
    each = test.edge.region**2 * (series * _GREY + cores() * _EDGE_PIXEL)
    require_memory(Lowered(test, ("frames",), test.frames, "frames", lambda frames: frames * each))


def align_files(spec: MeasuredFocusSpec, seed: int = 0, advance: Advance = silent) -> FocusRun:
    """Read the series, find best focus at every place, fit the plane and decide on shims.

    Parameters
    ----------
    spec : MeasuredFocusSpec
        Of the test.
    seed : int
        Of the command; nothing is drawn.
    advance : Advance
        Told of the progress.

    Raises
    ------
    InputError
        a table or an image cannot be used, or no best focus can be told from it.
    BenchError
        The mount does not allow the motion.
    """
    found = read_focus(spec.measured, advance)
    level = None if spec.measured.level is None else LineLevel(spec.measured.level.angle, spec.measured.level.sigma)
    state = FocusState(found.scans, level)
    present = np.array(spec.shims or [spec.mount.thickness] * len(spec.mount.holes))
    try:
        move, noise = state.skew
        # what the skew of the curves says beyond its noise all places share
        shared = float(np.sqrt(spec.vertex_error**2 + max(move**2 - noise**2, 0.0)))
        shimming = decide(found.places, state, mount_of(spec), present, (shared, spec.vertex_trend))
    except ObservabilityError as error:
        raise found.table.error(0, "x", str(error).removeprefix("focal plane: ")) from error
    return FocusRun(
        test=spec,
        seed=seed,
        bands=found.bands,
        places=found.places,
        states=(state,),
        shimmings=(shimming,),
        readings=found,
    )


def _check_light(bench: FocusBench) -> None:
    """BenchError when the bright side of the edge would saturate, which would falsify its MTF."""
    most = {name: ccd.largest_white for name, ccd in bench.ccds.items()}
    name = min(most, key=lambda n: most[n])
    white = bench.setup.test.white
    if white > most[name]:
        raise BenchError(
            f"the bright side of the edge, {100 * white:g}% of the full well, saturates pixels of {name}",
            ("white",),
            f"{np.floor(100 * most[name]):.0f} percent or less",
        )


def align(bench: FocusBench, seed: int, advance: Advance = silent) -> SimulatedFocus:
    """Mis-set the focal plane at random and align it.

    Raises
    ------
    BenchError
        Best focus lies outside of the scan, or the mount does not allow the motion.
    """
    test = bench.setup.test
    standing = misset(bench, seed)
    patterns = _patterns(bench, seed)
    mount = mount_of(test)
    present = np.full(len(test.mount.holes), test.mount.thickness)
    places = np.array([site.place for site in bench.sites])
    states = [_look(bench, standing, patterns, seed, None, 0, advance)]
    shimmings: list[Shimming] = []
    for number in range(test.rounds):
        shimming = decide(places, states[-1], mount, present)
        present = shimming.plan.thickness
        shimmings.append(shimming)
        setting = np.random.default_rng(stream(seed, _SETTING, number)).normal(0.0, test.level)
        standing = Standing(_moved(standing.pose, shimming.plan, mount, float(setting)), standing.heights)
        states.append(_look(bench, standing, patterns, seed, shimming, number + 1, advance))
    return SimulatedFocus(
        test=test,
        seed=seed,
        bands=tuple(site.band for site in bench.sites),
        places=places,
        states=tuple(states),
        shimmings=tuple(shimmings),
        bench=bench,
    )


def decide(
    places: np.ndarray,
    state: FocusState,
    mount: Mount,
    present: np.ndarray,
    vertex: tuple[float, float] = (focus_bench.VERTEX_ERROR, focus_bench.VERTEX_TREND),
) -> Shimming:
    """The plane through best focus and the shims that bring the assembly there.

    Parameters
    ----------
    places : np.ndarray
        X', Y' of the sites, (N, 2), metres.
    state : FocusState
        As measured; without a level of the line its turn stays as it is.
    mount : Mount
        Where the shims are.
    present : np.ndarray
        Their thickness, (H,), metres.
    vertex : tuple[float, float]
        Error that all vertices share and its trend, metres.

    Raises
    ------
    ObservabilityError
        The places do not tell a slope.
    BenchError
        The mount does not allow the motion.
    """
    # the plane wants how far best focus lies downstream of the CCD
    plane = fit_focal_plane(places, -state.defocus, state.defocus_sigma, estimate_extra=True)
    return Shimming(plane, plan_shims(plane.correction(state.level), mount, present), *vertex)


def misset(bench: FocusBench, seed: int) -> Standing:
    """How the assembly stands at the beginning, drawn from the seed."""
    spec = bench.setup.test.misset
    random = np.random.default_rng(stream(seed, _MISSET))
    rotation = rotation_matrix(np.array(spec.rotate) * random.standard_normal(3))
    shift = np.array(spec.shift) * random.standard_normal(3)
    heights = {name: float(spec.chips * random.standard_normal()) for name in bench.ccds}
    return Standing(Pose(rotation, shift), heights)


def mount_of(test: FocusTestSpec | MeasuredFocusSpec) -> Mount:
    """The mounting surface as its drawing has it, in the assembly's frame.

    Raises
    ------
    BenchError
        Holes that cannot carry a tilt.
    """
    spec = test.mount
    try:
        return Mount.of(np.array(spec.holes), about_axis(1, spec.tilt)[:, 2], spec.clearance, spec.step)
    except ShimError as error:
        raise BenchError(str(error), ("mount", "holes"), "three holes or more that span a plane") from error


def plan_shims(correction: RigidMotion, mount: Mount, present: np.ndarray) -> ShimPlan:
    """Shims for a correction.

    Raises
    ------
    BenchError
        The mount does not allow the motion.
    """
    try:
        return shim_plan(correction, mount, present)
    except ShimError as error:
        if error.slides:
            slide, far = max(zip(error.slides, error.holes, strict=True))
            raise BenchError(
                f"the alignment would slide hole_{far + 1} by {1e3 * slide:.3g} mm in the mounting surface, "
                f"the screws allow {1e3 * mount.clearance:.3g} mm",
                ("mount", "clearance"),
                "more clearance, or a smaller misset",
            ) from error
        raise BenchError(str(error), ("mount", "thickness"), "thicker shims to begin with") from error


def line_turn(pose: Pose) -> float:
    """Turn of the line about Z', radians."""
    x, y, _ = pose.rotation[:, 1]
    return float(np.arctan2(-x, y))


def recorder_of(
    bench: FocusBench, standing: Standing, seed: int, number: int, patterns: Mapping[str, FixedPattern] | None = None
) -> Recorder:
    """What records the edges of a standing: the same frames whenever it is asked for the same ones.

    Parameters
    ----------
    bench : FocusBench
        The bench.
    standing : Standing
        Of the assembly.
    seed : int
        Of the alignment.
    number : int
        Of the round before it, 0 for none.
    patterns : Mapping[str, FixedPattern] | None
        Of the columns; None to draw them, always the same.
    """
    drawn = _patterns(bench, seed) if patterns is None else patterns
    return Recorder(bench, standing, stream(seed, _SCAN, number), drawn)


def _patterns(bench: FocusBench, seed: int) -> dict[str, FixedPattern]:
    """Fixed pattern of the columns of each band."""
    return {name: ccd.pattern(stream(seed, _PATTERNS, k)) for k, (name, ccd) in enumerate(bench.ccds.items())}


def _look(
    bench: FocusBench,
    standing: Standing,
    patterns: Mapping[str, FixedPattern],
    seed: int,
    shims: Shimming | None,
    number: int,
    advance: Advance,
) -> SimulatedState:
    """Measure one standing of the assembly. Only the first one needs to be searched for focus."""
    recorder = recorder_of(bench, standing, seed, number, patterns)
    name = "through focus, before" if number == 0 else f"through focus, round {number}"
    scans = focus_bench.scan(recorder, lambda _, done, total: advance(name, done, total), search=number == 0)
    sigma = bench.setup.test.level
    true = line_turn(standing.pose)
    read = true + float(np.random.default_rng(stream(seed, _LEVEL, number)).normal(0.0, sigma))
    return SimulatedState(
        scans,
        LineLevel(read, sigma),
        bench,
        standing,
        focus_bench.in_focus(recorder) if number > 0 else (),
        np.array([site.defocus(standing.pose, standing.heights[site.band]) for site in bench.sites]),
        true,
        shims,
    )


def _moved(pose: Pose, plan: ShimPlan, mount: Mount, setting: float) -> Pose:
    """The assembly on its new shims, its turn in the mounting surface set with an error of ``setting`` radians."""
    achieved = plan.achieved
    turned = rotation_matrix(setting * mount.normal) @ achieved.matrix
    return pose @ Pose(turned, achieved.shift)


def _holes(values: Iterable[Any]) -> dict[str, Any]:
    """Values of the mounting holes, (H, ...), by the holes' names."""
    return {f"hole_{k + 1}": value for k, value in enumerate(values)}


def _ground(metres: Any) -> Any:
    """Whole steps of the workshop in micrometres; beyond picometres there is only rounding."""
    return np.round(UM * np.asarray(metres), 6)


def _mtf(state: SimulatedState, edge: str, which: int) -> dict[str, float]:
    return {band: pair[which] for band, pair in state.mtf(edge).items()}


def _shims(state: SimulatedState) -> Shimming:
    assert state.shims is not None
    return state.shims


SITES: Record[SimulatedState] = Record(
    "One band's CCD in one field.",
    Quantity("band", lambda s: [site.band for site in s.bench.sites], "name of the band"),
    Quantity("field", lambda s: [site.field for site in s.bench.sites], "share of half the line"),
    Quantity("defocus_um", lambda s: s.defocus, "how far the CCD stands downstream of best focus"),
    Quantity("defocus_um_sigma", lambda s: s.defocus_sigma, "standard deviation by noise"),
)
CORRECTION: Record[Shimming] = Record(
    "Motion that the measurement asks for. Its sigmas hold noise and the error that all vertices share.",
    Quantity("rotation_arcmin", lambda s: s.plan.wanted.rotation, "rotation vector about X', Y', Z'"),
    Quantity("shift_um", lambda s: s.plan.wanted.shift, "shift along X', Y', Z'"),
    Quantity("piston_um_sigma", lambda s: np.sqrt(s.covariance[0, 0]), "of the shift along Z'"),
    Quantity("slope_x_arcsec_sigma", lambda s: np.sqrt(s.covariance[1, 1]), "of the rise of best focus along X'"),
    Quantity("slope_y_arcsec_sigma", lambda s: np.sqrt(s.covariance[2, 2]), "of the rise of best focus along Y'"),
)
STATE: Record[SimulatedState] = Record(
    "The assembly as it was measured.",
    Quantity("confocal_um_max", lambda s: s.confocal[0], "largest distance of a CCD from best focus"),
    Quantity("confocal_um_sigma", lambda s: np.hypot(s.confocal[1], VERTEX_ERROR), "noise and error of the vertices"),
    Quantity("line_level_arcmin", lambda s: s.level.angle, "turn of the line about Z', by the theodolite"),
    Quantity("line_level_arcmin_sigma", lambda s: s.level.sigma, "standard deviation of the theodolite"),
    Quantity("sites", SITES.rows, "all bands in all fields"),
)
ROUND: Record[SimulatedState] = Record(
    "The assembly on new shims, and how they were decided.",
    *STATE,
    Quantity("mtf_nyquist", lambda s: _mtf(s, TRACK, 0), "band -> MTF along the track, mean of the fields"),
    Quantity("mtf_nyquist_sigma", lambda s: _mtf(s, TRACK, 1), "band -> its standard deviation by noise"),
    Quantity("mtf_nyquist_along_line", lambda s: _mtf(s, ALONG, 0), "band -> MTF along the line, mean of the fields"),
    Quantity("mtf_nyquist_along_line_sigma", lambda s: _mtf(s, ALONG, 1), "band -> its standard deviation by noise"),
    Quantity("shims_um", lambda s: _holes(_ground(_shims(s).plan.thickness)), "thickness by hole", converted=False),
    Quantity(
        "shim_changes_um", lambda s: _holes(_ground(_shims(s).plan.rounded_change)), "thicker by hole", converted=False
    ),
    Quantity("slides_mm", lambda s: _holes(_shims(s).plan.slide), "displacement in the mounting surface, by hole"),
    Quantity("turn_by_hand_arcmin", lambda s: _shims(s).plan.turn, "rotation about the normal of the mounting surface"),
    Quantity("line_level_without_turn_arcmin", lambda s: _shims(s).plan.level_coupling, "error of level without it"),
    Quantity("correction", _shims, "motion that was asked for", record=CORRECTION),
    Quantity("chips_um_rms", lambda s: _shims(s).plane.extra_sigma, "scatter of the CCDs about one plane"),
)
BUDGET: Record[BudgetLine] = Record(
    "What makes one band's MTF at the Nyquist frequency in one direction.",
    Quantity("band", lambda line: line.band, "name of the band"),
    Quantity("direction", lambda line: line.edge, "along the line or the track"),
    Quantity("factors", lambda line: line.factors, "effect -> its transfer"),
    Quantity("total", lambda line: line.total, "product of the factors"),
)
TRUE_STATE: Record[SimulatedState] = Record(
    "The assembly as it stands, by the exact trace.",
    Quantity("confocal_um_max", lambda s: np.max(np.abs(s.true_defocus)), "largest distance from best focus"),
    Quantity("line_level_arcmin", lambda s: s.true_level, "turn of the line about Z'"),
    Quantity("mtf_nyquist", lambda s: s.true_mtf, "band -> MTF along the track, mean of the fields"),
    Quantity("rotation_arcmin", lambda s: rotation_vector(s.standing.pose.rotation), "of the assembly"),
    Quantity("shift_um", lambda s: s.standing.pose.translation, "of the assembly"),
    Quantity("chip_height_um", lambda s: s.standing.heights, "band -> height of its chip above the assembly"),
    Quantity("defocus_um", lambda s: s.true_defocus, "of the sites, in the order of `sites`"),
)
TRUTH: Record[SimulatedFocus] = Record(
    "What the analysis does not know.",
    Quantity("initial", lambda r: r.states[0], "as the assembly was mis-set", record=TRUE_STATE),
    Quantity("rounds", lambda r: r.states[1:], "after each round", record=TRUE_STATE),
)
SIMULATED: Record[SimulatedFocus] = Record(
    "focus.json of a simulated bench.",
    Quantity("camera", lambda r: r.bench.setup.camera.name, "name of the camera"),
    Quantity("seed", lambda r: r.seed, "seed of all that was drawn"),
    Quantity("initial", lambda r: r.states[0], "before the first round", record=STATE),
    Quantity("rounds", lambda r: r.states[1:], "after each round", record=ROUND),
    Quantity("mtf_budget", lambda r: r.budget, "in the middle of the field", record=BUDGET),
    Quantity("truth", lambda r: r, "by the exact trace", record=TRUTH),
)
CURVE: Record[FocusVertex] = Record(
    "A curve through focus.",
    Quantity("vertex_um", lambda v: v.position, "best focus as a move of the image", "vertex", 2),
    Quantity("vertex_um_sigma", lambda v: v.sigma, "standard deviation by noise", "sigma", 2),
    Quantity("peak_mtf", lambda v: v.peak, "MTF in best focus", "peak", 4),
    Quantity("peak_mtf_sigma", lambda v: v.peak_sigma, "standard deviation by noise", "sigma of it", 4),
    Quantity("chi_square", lambda v: v.chi_square, "of the fitted curve", "χ²", 2),
    Quantity("degrees_of_freedom", lambda v: v.degrees_of_freedom, "points used minus three unknowns", "ν"),
    Quantity("positions", lambda v: len(v.used), "points of the curve", "positions"),
    Quantity("positions_used", lambda v: np.sum(v.used), "points near the peak that the fit uses", "used"),
)
_Standing: TypeAlias = tuple[FocusRun, FocusState, Shimming]
PLACES: Record[_Standing] = Record(
    "One place of the focal plane, before the shims are changed.",
    Quantity("band", lambda s: list(s[0].bands), "name of the band"),
    Quantity("x_mm", lambda s: s[0].places[:, 0], "X', in the flight direction", "x", 3),
    Quantity("y_mm", lambda s: s[0].places[:, 1], "Y', along the line", "y", 3),
    Quantity("defocus_um", lambda s: s[1].defocus, "from best focus to the CCD", "CCD downstream of focus", 2),
    Quantity("defocus_um_sigma", lambda s: s[1].defocus_sigma, "standard deviation by noise", "sigma", 2),
    Quantity("residual_um", lambda s: s[2].plane.residual, "best focus minus the fitted plane", "from the plane", 2),
    Quantity(
        "curves", lambda s: [{e: CURVE(v) for e, v in scan.vertex.items()} for scan in s[1].scans], "by direction"
    ),
)
PLANE: Record[Shimming] = Record(
    "The weighted plane of best focus minus CCD. Its sigmas hold the error that all vertices share.",
    Quantity("piston_um", lambda s: s.plane.piston, "piston of the plane", decimals=2),
    Quantity("piston_um_sigma", lambda s: np.sqrt(s.plane_covariance[0, 0]), "standard deviation"),
    Quantity("slope_x_arcsec", lambda s: s.plane.slope_x, "slope along X′", decimals=2),
    Quantity("slope_x_arcsec_sigma", lambda s: np.sqrt(s.plane_covariance[1, 1]), "standard deviation"),
    Quantity("slope_y_arcsec", lambda s: s.plane.slope_y, "slope along Y′", decimals=2),
    Quantity("slope_y_arcsec_sigma", lambda s: np.sqrt(s.plane_covariance[2, 2]), "standard deviation"),
    Quantity("covariance", lambda s: s.plane_covariance, "of piston and slopes, metres and radians"),
    Quantity("chi_square", lambda s: s.plane.chi_square, "of the places about the plane with their own sigmas"),
    Quantity("degrees_of_freedom", lambda s: s.plane.degrees_of_freedom, "places minus three unknowns"),
    Quantity("probability", lambda s: s.plane.p_value, "of such a chi-square or a larger one"),
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
    "A row of the table with what is wrong with it or with its image.",
    Quantity("file", lambda one: one.file, "the table that names it"),
    Quantity("line", lambda one: one.line, "line of the table"),
    Quantity("reason", lambda one: one.reason, "why"),
)


def _standing(run: FocusRun) -> _Standing:
    return run, run.states[0], run.shimmings[0]


MEASURED: Record[FocusRun] = Record(
    "focus.json of a measured series. Expected: on the new shims, after rounding, where places are best predicted.",
    Quantity("name", lambda r: r.test.name, "name of the test"),
    Quantity("seed", lambda r: r.seed, "of the command; nothing is drawn"),
    Quantity("confocal_um_max", lambda r: r.states[0].confocal[0], "largest distance of a CCD from best focus"),
    Quantity(
        "confocal_um_sigma",
        lambda r: np.hypot(r.states[0].confocal[1], r.shimmings[0].vertex_error),
        "noise and error of the vertices",
    ),
    Quantity("line_level_arcmin", lambda r: r.states[0].level and r.states[0].level.angle, "turn about Z'"),
    Quantity("line_level_arcmin_sigma", lambda r: r.states[0].level and r.states[0].level.sigma, "standard deviation"),
    Quantity("plane", lambda r: r.shimmings[0], "that the shims take away", record=PLANE),
    Quantity("correction", lambda r: r.shimmings[0], "motion that is asked for", record=CORRECTION),
    Quantity("shims", lambda r: _holes(SHIMS.rows(r.shimmings[0])), "by hole"),
    Quantity("turn_by_hand_arcmin", lambda r: r.shimmings[0].plan.turn, "rotation in the mounting surface"),
    Quantity("line_level_without_turn_arcmin", lambda r: r.shimmings[0].plan.level_coupling, "error without it"),
    Quantity("expected_confocal_um_max", lambda r: r.shimmings[0].expected[0], "largest expected distance"),
    Quantity("expected_confocal_um_sigma", lambda r: r.shimmings[0].expected[1], "standard deviation"),
    Quantity("skew_um", lambda r: r.states[0].skew[0], "move of all vertices if curves may be skewed"),
    Quantity("skew_um_sigma", lambda r: r.states[0].skew[1], "standard deviation by noise"),
    Quantity("curves_chi_square", lambda r: r.chi_square[0], "of all curves through focus together"),
    Quantity("curves_degrees_of_freedom", lambda r: r.chi_square[1], "of all curves through focus together"),
    Quantity("curves_agree", lambda r: likely(*r.chi_square), "whether that is likely"),
    Quantity("sites", lambda r: PLACES.rows(_standing(r)), "all places"),
    Quantity("images_without_edge", lambda r: r.readings and r.readings.no_edge, "not measured", record=ROW_FAULT),
    Quantity("images_with_structure", lambda r: r.readings and r.readings.uneven, "doubtful", record=ROW_FAULT),
    Quantity("rows_excluded", lambda r: r.readings and r.readings.excluded, "off their curves", record=ROW_FAULT),
    Quantity("files", lambda r: r.readings and [r.readings.file], "that were read", record=DATA_FILE),
)


def focus_numbers(run: FocusRun) -> dict[str, Any]:
    """Contents of focus.json without its frames."""
    return SIMULATED(run) if isinstance(run, SimulatedFocus) else MEASURED(run)
