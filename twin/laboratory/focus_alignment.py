"""Focal-plane alignment, rendered and carried out as paper 004 does (section 2): through-focus MTF of every field and
band, a weighted plane, shims at the mounting holes, and the same again.

The analysis gets frames, readings of a theodolite, the nominal focal length and the drawing of the mount. Where the
assembly really stands is drawn from the seed and known to the images alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from analysis.focal_plane.plane_fit import FocalPlaneFit, LineLevel, RigidMotion, fit_focal_plane
from analysis.focal_plane.shims import Mount, ShimError, ShimPlan, shim_plan
from optics.geometry.pose import Pose, about_axis, rotation_matrix
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.collimator import TooNarrowError
from twin.laboratory.focus_bench import BudgetLine, FocusBench
from twin.laboratory.focus_scan import (
    VERTEX_ERROR,
    VERTEX_TREND,
    NyquistMtf,
    Recorder,
    SiteScan,
    Standing,
    in_focus,
    scan,
)
from twin.run.procedure import Advance, BenchError, silent
from twin.run.random_streams import stream
from twin.sensors.area_detector import FixedPattern

if TYPE_CHECKING:
    from scenes.specs.camera_tests import FocusTestSpec, MeasuredFocusSpec
    from scenes.specs.resolved import FocusSetup

_MISSET, _PATTERNS, _LEVEL, _SETTING, _SCAN = range(5)


@dataclass(frozen=True, eq=False)
class State:
    """The assembly as it stands, measured and true.

    Attributes:
        standing: truth.
        scans: site by site.
        level: of the line by the theodolite.
        focus: MTF with the target at the collimator's focus, site by site; empty when it was not measured.
        true_defocus: (N,) how far each site's CCD stands downstream of best focus, metres.
        true_level: turn of the line about Z', radians.
    """

    standing: Standing
    scans: tuple[SiteScan, ...]
    level: LineLevel
    focus: tuple[NyquistMtf, ...]
    true_defocus: np.ndarray
    true_level: float

    @property
    def defocus(self) -> np.ndarray:
        """Measured, (N,), metres, positive where the CCD stands downstream of best focus."""
        return np.array([s.defocus for s in self.scans])

    @property
    def defocus_sigma(self) -> np.ndarray:
        """Its sigma, (N,), metres."""
        return np.array([s.defocus_sigma for s in self.scans])


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
    vertex_error: float = VERTEX_ERROR
    vertex_trend: float = VERTEX_TREND

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) of piston, slope_x and slope_y against the true plane: noise and the vertices' own error."""
        return self.plane.noise_covariance + np.diag(self.systematic**2)

    @property
    def systematic(self) -> np.ndarray:
        """(3,) part of the sigmas that is the same in every alignment of a camera: the vertices' own error."""
        reach = np.max(np.abs(self.plane.place), axis=0)
        return np.array([self.vertex_error, *(self.vertex_trend / reach)])

    @property
    def systematic_changes(self) -> np.ndarray:
        """(H, H) covariance of the shims' changes by the vertices' own error, square metres."""
        holes, up = self.plan.mount.holes, self.plan.mount.normal
        lever = np.cross(holes, up)
        # a piston moves along Z', a slope along X' turns about -Y' and one along Y' about X'
        gain = np.column_stack([np.full(len(holes), up[2]), -lever[:, 1], lever[:, 0]])
        return np.asarray((gain * self.systematic**2) @ gain.T)


@dataclass(frozen=True, eq=False)
class Alignment:
    """A whole alignment: ``len(shimmings) + 1`` states, each shimming between two of them."""

    bench: FocusBench
    seed: int
    states: tuple[State, ...]
    shimmings: tuple[Shimming, ...]

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


def run_focus(setup: FocusSetup, backend: Backend, seed: int, advance: Advance = silent) -> Alignment:
    """Build the bench and align: ``python -m twin.lab focus``.

    Raises:
        InputError: the camera cannot be built as the file says.
        BenchError: what the file asks for cannot be done.
    """
    mount_of(setup.test)
    try:
        bench = FocusBench(setup, backend, advance)
    except TooNarrowError as error:
        raise BenchError(str(error), ("collimator", "aperture"), "a wider collimator") from error
    except (AimError, BeamMissedError, ValueError) as error:
        raise BenchError(str(error), ("as_built",), "a camera whose whole beam gets through") from error
    _check_light(bench)
    return align(bench, seed, advance)


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


def align(bench: FocusBench, seed: int, advance: Advance = silent) -> Alignment:
    """Mis-set the focal plane at random and align it.

    Raises:
        BenchError: best focus lies outside of the scan, or the mount does not allow the motion.
    """
    test = bench.setup.test
    standing = misset(bench, seed)
    patterns = _patterns(bench, seed)
    mount = mount_of(test)
    present = np.full(len(test.mount.holes), test.mount.thickness)
    states: list[State] = [_look(bench, standing, patterns, seed, 0, advance)]
    shimmings: list[Shimming] = []
    places = np.array([site.place for site in bench.sites])
    for number in range(test.rounds):
        state = states[-1]
        shimming = decide(places, state.defocus, state.defocus_sigma, state.level, mount, present)
        plan = shimming.plan
        assert plan.thickness is not None
        present = plan.thickness
        shimmings.append(shimming)
        setting = np.random.default_rng(stream(seed, _SETTING, number)).normal(0.0, test.level)
        standing = Standing(_moved(standing.pose, plan, mount, float(setting)), standing.heights)
        states.append(_look(bench, standing, patterns, seed, number + 1, advance))
    return Alignment(bench, seed, tuple(states), tuple(shimmings))


def decide(
    places: np.ndarray,
    defocus: np.ndarray,
    sigma: np.ndarray,
    level: LineLevel | None,
    mount: Mount,
    present: np.ndarray,
    vertex: tuple[float, float] = (VERTEX_ERROR, VERTEX_TREND),
) -> Shimming:
    """The plane through best focus and the shims that bring the assembly there, whichever bench it stands on.

    Args:
        places: (N, 2) X', Y' of the sites, metres.
        defocus: (N,) how far each CCD stands downstream of best focus, metres.
        sigma: (N,) of it by noise, metres.
        level: of the line; None to leave its turn as it is.
        mount: where the shims are.
        present: (H,) their thickness, metres.
        vertex: error that all vertices share and its trend, metres.

    Raises:
        ObservabilityError: the places do not tell a slope.
        BenchError: the mount does not allow the motion.
    """
    # the plane wants how far best focus lies downstream of the CCD
    plane = fit_focal_plane(places, -defocus, sigma, estimate_extra=True)
    return Shimming(plane, plan_shims(plane.correction(level), mount, present), *vertex)


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
    bench: FocusBench,
    standing: Standing,
    seed: int,
    number: int,
    patterns: Mapping[str, FixedPattern] | None = None,
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
    """Of each band's columns."""
    return {name: ccd.pattern(stream(seed, _PATTERNS, k)) for k, (name, ccd) in enumerate(bench.ccds.items())}


def _look(
    bench: FocusBench,
    standing: Standing,
    patterns: Mapping[str, FixedPattern],
    seed: int,
    number: int,
    advance: Advance,
) -> State:
    """Measure one standing of the assembly. Only the first one needs to be searched for focus."""
    recorder = recorder_of(bench, standing, seed, number, patterns)
    name = "through focus, before" if number == 0 else f"through focus, round {number}"
    scans = scan(recorder, lambda _, done, total: advance(name, done, total), search=number == 0)
    sigma = bench.setup.test.level
    true = line_turn(standing.pose)
    read = true + float(np.random.default_rng(stream(seed, _LEVEL, number)).normal(0.0, sigma))
    return State(
        standing,
        scans,
        LineLevel(read, sigma, np.zeros(2), 0.0, 0),
        in_focus(recorder) if number > 0 else (),
        np.array([site.defocus(standing.pose, standing.heights[site.band]) for site in bench.sites]),
        true,
    )


def _moved(pose: Pose, plan: ShimPlan, mount: Mount, setting: float) -> Pose:
    """The assembly on its new shims, its turn in the mounting surface set with an error of ``setting`` radians."""
    achieved = plan.achieved
    turned = rotation_matrix(setting * mount.normal) @ achieved.matrix
    return pose @ Pose(turned, achieved.shift)
