"""Numbers of a focal-plane alignment, as focus.json has them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np

from analysis.arrays import UM_PER_M as UM
from analysis.focal_plane.through_focus import FocusVertex
from optics.geometry.pose import rotation_vector
from twin.framework.quantity import Quantity, Record
from twin.laboratory.focus_bench import VERTEX_ERROR, BudgetLine
from twin.laboratory.focus_run import FocusRun, FocusState, Shimming, SimulatedFocus, SimulatedState
from twin.laboratory.measured_focus import RowFault
from twin.laboratory.turntable_run import DATA_FILE, likely
from twin.targets.target_images import ALONG, TRACK


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
    Quantity("peak_mtf", lambda v: v.peak, "MTF in best focus"),
    Quantity("peak_mtf_sigma", lambda v: v.peak_sigma, "standard deviation by noise"),
    Quantity("chi_square", lambda v: v.chi_square, "of the fitted curve", "χ²"),
    Quantity("degrees_of_freedom", lambda v: v.degrees_of_freedom, "points used minus three unknowns", "ν"),
    Quantity("positions", lambda v: len(v.used), "points of the curve"),
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
    Quantity("piston_um", lambda s: s.plane.piston, "height in the middle of the line"),
    Quantity("piston_um_sigma", lambda s: np.sqrt(s.plane_covariance[0, 0]), "standard deviation"),
    Quantity("slope_x_arcsec", lambda s: s.plane.slope_x, "rise along X'"),
    Quantity("slope_x_arcsec_sigma", lambda s: np.sqrt(s.plane_covariance[1, 1]), "standard deviation"),
    Quantity("slope_y_arcsec", lambda s: s.plane.slope_y, "rise along Y'"),
    Quantity("slope_y_arcsec_sigma", lambda s: np.sqrt(s.plane_covariance[2, 2]), "standard deviation"),
    Quantity("covariance", lambda s: s.plane_covariance, "of piston and slopes, metres and radians"),
    Quantity("chi_square", lambda s: s.plane.chi_square, "of the places about the plane with their own sigmas"),
    Quantity("degrees_of_freedom", lambda s: s.plane.degrees_of_freedom, "places minus three unknowns"),
    Quantity("probability", lambda s: s.plane.p_value, "of such a chi-square or a larger one"),
    Quantity("chips_um_rms", lambda s: s.plane.extra_sigma, "scatter of the CCDs about one plane"),
)
SHIMS: Record[Shimming] = Record(
    "The shim of one mounting hole.",
    Quantity("change_um", lambda s: s.plan.change, "exact change of thickness", "change", 1),
    Quantity("change_um_sigma", lambda s: s.change_sigma, "standard deviation", "sigma", 1),
    Quantity(
        "ground_um", lambda s: _ground(s.plan.rounded_change), "change that is ground", "ground", 1, converted=False
    ),
    Quantity("shim_um", lambda s: _ground(s.plan.thickness), "new thickness", "new shim", 1, converted=False),
    Quantity("slide_mm", lambda s: s.plan.slide, "displacement in the mounting surface, by hand"),
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
