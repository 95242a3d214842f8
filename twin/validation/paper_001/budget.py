"""Paper 001's (12), what errors of spots do to the parameters, and all that is simulated for the budget's checks."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from math import sqrt

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import monitoring
from analysis.monitor.monitoring import MonitorGeometry
from analysis.monitor.recovery import measure_spots
from optics.geometry.tree import Motion
from optics.numerics.backend import cores, one_blas_thread
from scenes.specs.instrument import BASE
from scenes.specs.load import load_error_budget
from scenes.specs.resolved import resolve_budget
from twin.monitor.simulated_budget import BudgetLine, ErrorBudget, Together
from twin.monitor.truth import line_points
from twin.validation.checks.group import Context, load_printed

FRAMES = 9
"""Averaged in one measurement, (12)."""
BUDGET = "monitor_pair"
TABLE_3 = load_printed("001").numbers("table3.spot_arcsec")
TABLE_4 = load_printed("001").number("table4.spot_arcsec")
FOCAL_PLANE, LONG_PRISM = "coordinate_thermal", "prism_180_thermal"
"""Causes whose inputs are also applied by themselves."""
FEW_DRAWS = (FOCAL_PLANE, "central_prism_thermal")
"""Lines of two or three random numbers a state, which need more states than those of a prism in every channel."""
ROLL = load_printed("001").number("table5.d_gamma_arcsec") * ARCSEC
"""Table 5's error of d_gamma."""
FROM_ALL_CAUSES = frozenset(
    f"001.{name}"
    for name in (
        *("eq12", "table4.together", "table5.d_f.field", "table5.x_and_y"),
        *(f"table5.{parameter}" for parameter in ("d_beta", "d_alpha", "d_gamma", "d_f")),
    )
)
"""Checks that need all causes at once."""
_CHUNK = 40


def frame_mean(error: float, frames: int = FRAMES) -> float:
    """The random error of a mean of frames from that of a single one, (12)'s first term."""
    return error / sqrt(frames)


def root_sum(errors: Mapping[str, float]) -> float:
    """(12): the root of the sum of squares of Table 3's lines, the centroid's over the frames."""
    return sqrt(sum((frame_mean(e) if name == "centroid" else e) ** 2 for name, e in errors.items()))


def root_sum_of_squares(lines: Mapping[str, BudgetLine]) -> tuple[float, float]:
    """(12) of simulated lines and its standard deviation, radians."""
    total = root_sum({name: line.three_sigma for name, line in lines.items()})
    weight = {name: frame_mean(1.0) ** 2 if name == "centroid" else 1.0 for name in lines}
    sigma = sqrt(sum((weight[n] * line.three_sigma * line.sigma) ** 2 for n, line in lines.items())) / total
    return total, sigma


def propagated(spot: float, geometry: MonitorGeometry, estimator: str = "paper_single") -> dict[str, float]:
    """Table 5 from Table 4: errors of the parameters from that of one coordinate of one spot, all independent.

    Args:
        spot: as an angle, radians.
        geometry: of the camera.
        estimator: whose factors; (2), (3), (5), (7) or, as ``paper_joint``, Table 1's last column.

    Returns:
        d_alpha, d_beta, d_gamma in radians and d_f in metres.
    """
    pixels = spot * geometry.principal_distance_m / geometry.pitch_m
    factors = np.sqrt(np.sum(monitoring.coefficients(estimator, geometry) ** 2, axis=1))
    return dict(zip(("d_alpha", "d_beta", "d_gamma", "d_f"), (float(v) for v in factors * pixels), strict=True))


@dataclass(frozen=True, eq=False)
class BudgetImages:
    """What was simulated; what is not wanted is empty or None.

    Attributes:
        geometry: of the first camera; both are alike.
        radians_per_pixel: the unit of a spot's angle error.
        inputs: trials per line (twice as many for FEW_DRAWS), with all causes, and groups of frames.
        lines: of Table 3.
        focal_plane: true and read change of d_f by the focal plane's temperature, m.
        halved: glass path of the 180-deg prism before and after halving, m, and the ratio of its errors.
        together: all causes at once.
        scatter: of the centroid in single frames and in means of FRAMES, radians, with standard deviations.
        line_pixel: of the line CCD, metres.
        roll_pixels: how far ROLL moves the line of sight of the line's end, pixels of the line CCD.
    """

    geometry: MonitorGeometry
    radians_per_pixel: float
    inputs: tuple[int, int, int]
    lines: dict[str, BudgetLine]
    focal_plane: tuple[float, float] | None
    halved: tuple[float, float, float] | None
    together: Together | None
    scatter: tuple[tuple[float, float], tuple[float, float]] | None
    line_pixel: float
    roll_pixels: float | None


def measured(context: Context) -> BudgetImages:
    """Simulate what the selected checks need."""
    spec = load_error_budget(BUDGET)
    trials, together, groups = context.count(400, 60), context.count(1500, 80), context.count(400, 80)
    spec = spec.model_copy(update={"trials": trials, "all_together": together})
    context.progress(0.0, f"build {spec.instrument}")
    budget = ErrorBudget(spec, resolve_budget(spec), context.backend, context.seed)
    every = bool(context.selected & {"001.eq12", "001.table4.root_sum"})
    wanted = [name for name in budget.lines if every or f"001.table3.{name}" in context.selected]
    lines = {}
    for i, name in enumerate(wanted):
        context.progress(0.05 + 0.4 * i / len(wanted), name)
        lines[name] = more_trials(budget, 2 if name in FEW_DRAWS else 1).line(name)
    grown = budget.grown_focal_planes(three_sigma(budget, FOCAL_PLANE)) if FOCAL_PLANE in lines else None
    halved = None
    if "001.table3.prism_180_thermal.halved" in context.selected:
        context.progress(0.45, "half the glass path")
        halved = budget.halved_glass(three_sigma(budget, LONG_PRISM))
    scatter = None
    if "001.eq12.frames" in context.selected:
        context.progress(0.5, "means of frames")
        scatter = centroid_scatter(budget, groups)
    roll = line_end_shift(budget) if "001.table5.d_gamma.positioning" in context.selected else None
    causes = None
    if context.selected & FROM_ALL_CAUSES:
        causes = budget.together(lambda done, text: context.progress(0.55 + 0.4 * done, text))
    geometry = next(iter(budget.experiment.calibration.cameras.values())).geometry
    inputs = (trials, together, groups)
    pitch = next(iter(budget.experiment.instrument.cameras.values())).spec.line.pitch
    return BudgetImages(geometry, budget.radians_per_pixel, inputs, lines, grown, halved, causes, scatter, pitch, roll)


def three_sigma(budget: ErrorBudget, cause: str) -> float:
    """The input of a cause whose components are alike, SI."""
    return 3.0 * budget.stated.of_causes((cause,)).components[0].sigma


def more_trials(budget: ErrorBudget, factor: int) -> ErrorBudget:
    """Error budget with ``factor`` times the trials for each line."""
    other = copy(budget)
    other.spec = budget.spec.model_copy(update={"trials": factor * budget.spec.trials})
    return other


def centroid_scatter(budget: ErrorBudget, groups: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Three sigma of the energy centroid in single frames and in means of FRAMES of them, radians, each with its
    standard deviation; the same frames serve both.
    """
    setup = budget.experiment
    pattern = setup.pattern(budget.seed)
    single, mean = [], []
    for first in range(0, groups, _CHUNK):
        count = min(_CHUNK, groups - first)
        stream = np.random.SeedSequence(budget.seed, spawn_key=(12, first))
        frames = setup.detector.expose(setup.nominal_photons, pattern, count * FRAMES, setup.exposure, stream)
        grouped = frames.reshape(len(frames), count, FRAMES, *frames.shape[2:]).mean(axis=2)
        single.append(_positions(budget, frames, 1))
        mean.append(_positions(budget, grouped, FRAMES))
    out = []
    for places in (np.concatenate(single), np.concatenate(mean)):
        freedom = (len(places) - 1) * places[0].size
        variance = float(np.sum((places - places.mean(axis=0)) ** 2)) / freedom
        value = 3.0 * float(np.sqrt(variance)) * budget.radians_per_pixel
        out.append((value, value / float(np.sqrt(2.0 * freedom))))
    return out[0], out[1]


def _positions(budget: ErrorBudget, images: np.ndarray, frames: int) -> np.ndarray:
    """Energy centroids of images (C, N, H, W), px, (N, C, 2)."""
    count, spots = images.shape[1], images.shape[0]
    flat = np.swapaxes(images, 0, 1).reshape(-1, *images.shape[2:]).astype(np.float64)
    with one_blas_thread():
        found = measure_spots(flat, frames, budget.experiment.calibration, "energy", cores())
    return np.asarray(found.position.reshape(count, spots, 2))


def line_end_shift(budget: ErrorBudget) -> float:
    """How far a turn of the line CCD by ROLL moves the line of sight of its end, in pixels of the line CCD."""
    experiment = budget.experiment
    camera = next(iter(experiment.instrument.cameras))
    state = {f"{BASE}/{camera}/focal_plane": Motion(rotate=(0.0, 0.0, ROLL))}
    sight = experiment.sight.trace([{}, state])[0]
    ends = line_points(experiment.instrument, camera)[-2:]
    pixel = experiment.instrument.cameras[camera].spec.line.pitch
    per_pixel = float(np.linalg.norm(sight[0, -1] - sight[0, -2])) / float(ends[1] - ends[0]) * pixel
    return float(np.linalg.norm(sight[1, -1] - sight[0, -1])) / per_pixel
