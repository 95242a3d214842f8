"""Focal-plane alignment as paper 004 carries it out (section 2): through-focus MTF of every field and band, a weighted
plane, shims at the mounting holes, and the same again; on a simulated bench or from a measured through-focus series.

The analysis gets MTF values, readings of a theodolite, the nominal focal length and the drawing of the mount. Where a
simulated assembly really stands is drawn from the seed and known to the images alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

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
from optics.geometry.pose import Pose, about_axis, rotation_matrix
from optics.numerics.backend import Backend, cores
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.collimator import TooNarrowError
from scenes.specs.camera_tests import FocusTestSpec, MeasuredFocusSpec
from scenes.specs.resolved import ExperimentSetup, FocusSetup, MeasuredFocusSetup
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.laboratory import focus_bench
from twin.laboratory.focus_bench import BudgetLine, FocusBench, NyquistMtf, Recorder, SiteScan, Standing
from twin.laboratory.measured_focus import FocusReadings, read_focus
from twin.sensors.area_detector import FixedPattern
from twin.targets.target_images import TRACK

_MISSET, _PATTERNS, _LEVEL, _SETTING, _SCAN = range(5)
_GREY, _EDGE_PIXEL = 2.0, 57.0
"""Bytes per pixel of a frame that is kept, and of one of an edge while it is exposed and measured."""


@dataclass(frozen=True, eq=False)
class FocusState:
    """The assembly as it stands, measured at N sites.

    Attributes:
        scans: through focus, site by site.
        level: of the line by the theodolite; None if nobody read it.
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

    Attributes:
        level: there is always one.
        bench: where it stands.
        standing: truth.
        focus: MTF with the target at the collimator's focus, site by site; empty when it was not measured.
        true_defocus: how far each site's CCD stands downstream of best focus, (N,), metres.
        true_level: turn of the line about Z', radians.
        shims: what led to it; None for the first standing.
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

    Attributes:
        plane, plan: as fitted and as decided.
        vertex_error: that all vertices share, one sigma, metres.
        vertex_trend: by how much it changes from the middle to the ends of the places, one sigma, metres.
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
        reach = np.max(np.abs(self.plane.place), axis=0)
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
        left = left + self.plan.focus_error(self.plane.place)
        worst = int(np.argmax(np.abs(left)))
        return float(np.abs(left[worst])), float(np.hypot(np.sqrt(spread[worst, worst]), self.vertex_error))


@dataclass(frozen=True, eq=False, kw_only=True)
class FocusRun:
    """One alignment, on a simulated bench or from a measured through-focus series.

    Attributes:
        test: what its file says.
        seed: of what was drawn.
        bands: whose CCD stands at each of the N sites; an empty name where a table does not say.
        places: (X', Y') of the sites, (N, 2), metres.
        states: the standings that were measured.
        shimmings: what was decided after each of them; a simulated bench also measures what the last one leads to.
        readings: as read from files; None for a simulated bench.
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

    Attributes:
        bench: with all that was set up.
        states: one more than there are shimmings.
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
        design = np.column_stack([np.ones(len(weight)), plane.place]) * weight[:, None]
        terms, *_ = np.linalg.lstsq(design, -self.states[number].true_defocus * weight, rcond=None)
        return np.asarray(terms)


def run_focus(setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent) -> FocusRun:
    """``python -m twin.lab focus``.

    Raises:
        InputError: the camera cannot be built as the file says; a table of measurements cannot be used.
        BenchError: what the file asks for cannot be done.
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

    Args:
        spec: of the test.
        seed: of the command; nothing is drawn.
        advance: told of the progress.

    Raises:
        InputError: a table or an image cannot be used, or no best focus can be told from it.
        BenchError: the mount does not allow the motion.
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

    Raises:
        BenchError: best focus lies outside of the scan, or the mount does not allow the motion.
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

    Args:
        places: X', Y' of the sites, (N, 2), metres.
        state: as measured; without a level of the line its turn stays as it is.
        mount: where the shims are.
        present: their thickness, (H,), metres.
        vertex: error that all vertices share and its trend, metres.

    Raises:
        ObservabilityError: the places do not tell a slope.
        BenchError: the mount does not allow the motion.
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

    Raises:
        BenchError: holes that cannot carry a tilt.
    """
    spec = test.mount
    try:
        return Mount.of(np.array(spec.holes), about_axis(1, spec.tilt)[:, 2], spec.clearance, spec.step)
    except ShimError as error:
        raise BenchError(str(error), ("mount", "holes"), "three holes or more that span a plane") from error


def plan_shims(correction: RigidMotion, mount: Mount, present: np.ndarray) -> ShimPlan:
    """Shims for a correction.

    Raises:
        BenchError: the mount does not allow the motion.
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

    Args:
        bench: the bench.
        standing: of the assembly.
        seed: of the alignment.
        number: of the round before it, 0 for none.
        patterns: of the columns; None to draw them, always the same.
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
