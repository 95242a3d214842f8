"""Numbers of a loop along an orbit, as loop.json has them."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.monitor.model_fit import UnseenMode
from scenes.specs.course import moment
from twin.orbit.loop.line_images import ImagedPair
from twin.orbit.loop.loop_run import GAIN_MARGIN, PHASE_MARGIN_DEG, LoopFacts, LoopPass, LoopRun, height_rms
from twin.orbit.monitoring.monitoring_numbers import SUMMARY
from twin.orbit.monitoring.monitoring_run import rms
from twin.run.artefact import significant
from twin.run.quantity import Quantity, Record

MOST_MOTIONS = 8
"""Motions that a mode names."""


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def focus_true(run: LoopRun, one: LoopPass, camera: str) -> Array:
    """(T,) true defocus, metres."""
    return one.true(one.unit(run.model.row(camera, "defocus")))


def focus_told(run: LoopRun, one: LoopPass, camera: str) -> tuple[Array, Array]:
    """(T,) defocus as the posterior says it, and its sigma, metres."""
    return one.told(one.unit(run.model.row(camera, "defocus")))


FOCUS: Record[tuple[LoopRun, LoopPass, str]] = Record(
    "Focus of one camera, best focus less line CCD, over the moments.",
    Quantity("defocus_um", lambda of: focus_true(*of), "true"),
    Quantity("told_um", lambda of: focus_told(*of)[0], "as the posterior says it"),
    Quantity("told_um_sigma", lambda of: focus_told(*of)[1], "standard deviation of its error"),
    Quantity("defocus_rms_um", lambda of: rms(focus_true(*of)), "RMS over the moments"),
    Quantity("mtf_along_line", lambda of: of[1].mtf[of[2]][:, 0], "at Nyquist, mean over the fields"),
    Quantity("mtf_along_track", lambda of: of[1].mtf[of[2]][:, 1], "likewise"),
)
SERIES: Record[LoopPass] = Record(
    "Errors of each moment.",
    Quantity(
        "angle_arcsec", lambda one: one.true(one.angle) + 0.0, "true error of the angle between the lines of sight"
    ),
    Quantity("angle_told_arcsec", lambda one: one.told(one.angle)[0] + 0.0, "as the posterior says it"),
    Quantity("angle_told_arcsec_sigma", lambda one: one.told(one.angle)[1], "standard deviation of its error"),
    Quantity("height_m", lambda one: one.heights.camera + 0.0, "mean height error by the cameras"),
    Quantity("height_told_m", lambda one: one.told(one.slopes)[0] + 0.0, "as the posterior says it"),
    Quantity("height_told_m_sigma", lambda one: one.told(one.slopes)[1], "standard deviation of its error"),
    Quantity("height_rms_m", lambda one: one.heights.height, "RMS of all errors at the points"),
    Quantity("chi_square", lambda one: one.course.chi_square, "of each reading against its prediction"),
)


IMAGES: Record[tuple[LoopPass, ImagedPair]] = Record(
    "A pair of rendered line images, its points matched and intersected.",
    Quantity("time_s", lambda of: float(of[0].course.times[of[1].moment]), "of the reading before them", "time", 0),
    Quantity("points", lambda of: len(of[1].errors), "that were matched", "points"),
    Quantity("sought", lambda of: of[1].sought, "points that were sought"),
    Quantity("height_m", lambda of: of[1].height[0], "mean height error of the points", "height", 3),
    Quantity("height_m_sigma", lambda of: of[1].height[1], "of it by the scatter of the points", "σ", 3),
    Quantity(
        "drawn_height_m", lambda of: float(of[0].heights.bias[of[1].moment]), "by drawn points", "drawn points", 3
    ),
    Quantity(
        "camera_height_m",
        lambda of: float(of[0].heights.camera[of[1].moment]),
        "by the cameras alone",
        "by the cameras",
        3,
    ),
    Quantity("matching_lines_px", lambda of: float(of[1].matching[0]), "RMS across the line", "matching across", 3),
    Quantity("matching_pixels_px", lambda of: float(of[1].matching[1]), "RMS along the line", "along", 3),
    Quantity("stated_lines_px", lambda of: float(of[1].sigma[0]), "sigma that matching states", "stated across", 3),
    Quantity("stated_pixels_px", lambda of: float(of[1].sigma[1]), "likewise", "along", 3),
)


def _foci(of: tuple[LoopRun, LoopPass]) -> float:
    return rms(np.concatenate([focus_true(*of, name) for name in of[0].pair]))


def _contradicted(of: tuple[LoopRun, LoopPass]) -> str:
    course, label = of[1].course, "closed" if of[1] is of[0].closed else "open"
    where = "" if (at := course.contradiction) is None else f", first at {moment(float(course.times[at]))}"
    return (
        f"with the loop {label} the readings contradict what is stated to move{where}: chi-square "
        f"{course.chi_square.sum():.4g} of {course.degrees} degrees of freedom, limit {course.limit:.4g}; the "
        "posterior's sigmas are not reliable"
    )


PASS: Record[tuple[LoopRun, LoopPass]] = Record(
    "One way through the moments.",
    Quantity("angle_rms_arcsec", lambda of: rms(of[1].true(of[1].angle)), "RMS error of the angle", "angle", 3),
    Quantity(
        "angle_sigma_rms_arcsec", lambda of: rms(of[1].told(of[1].angle)[1]), "of its sigma by the posterior", "σ", 3
    ),
    Quantity("height_camera_rms_m", lambda of: height_rms(of[1]), "mean height error by the cameras", "height", 3),
    Quantity(
        "height_sigma_rms_m", lambda of: rms(of[1].told(of[1].slopes)[1]), "of its sigma by the posterior", "σ", 3
    ),
    Quantity("height_rms_m", lambda of: of[1].heights.height_rms, "of all errors in height", "all errors", 3),
    Quantity("defocus_rms_um", _foci, "defocus of the pair's cameras together", "defocus", 2),
    Quantity("mtf_least", lambda of: min(float(of[1].mtf[n].min()) for n in of[0].pair), "at Nyquist", "least MTF", 3),
    Quantity("heights", lambda of: SUMMARY(of[1].heights), "errors at the check points", converted=False),
    Quantity("focus", lambda of: {name: (*of, name) for name in of[0].model.cameras}, "by camera", record=FOCUS),
    Quantity("series", lambda of: of[1], "over the moments", record=SERIES),
    Quantity("images", lambda of: [(of[1], one) for one in of[1].images] or None, record=IMAGES, where_known=True),
    Quantity("chi_square", lambda of: float(of[1].course.chi_square.sum()), "of all readings"),
    Quantity("degrees_of_freedom", lambda of: of[1].course.degrees, "of chi-square"),
    Quantity("chi_square_limit", lambda of: of[1].course.limit, "of chi-square"),
    Quantity("agrees", lambda of: of[1].course.agrees, "whether readings are as stated", warning=_contradicted),
)


def positions(run: LoopRun, name: str) -> Array:
    """(T,) where a mechanism is told to stand when images are taken, in its unit."""
    k = [one.name for one in run.model.correctors].index(name)
    return np.asarray(run.closed.course.positions[:, k] / run.model.correctors[k].unit[1] + 0.0)


def _unstable_alone(of: tuple[LoopRun, str, LoopFacts]) -> str:
    limit, delay = of[2].margins.limit, of[2].corrector.spec.delay
    return (
        f"{of[1]} is unstable by itself: its loop gain of {of[2].loop_gain:.3g} is not below {limit:.3g}, the limit of "
        f"a delay of {delay}"
    )


CORRECTION: Record[tuple[LoopRun, str, LoopFacts]] = Record(
    "One correction.",
    Quantity("camera", lambda of: of[2].corrector.spec.camera, "whose quantity it is"),
    Quantity("quantity", lambda of: of[2].corrector.spec.quantity, "of the posterior"),
    Quantity("mechanism", lambda of: of[2].corrector.spec.mechanism, "null for the processing on the ground"),
    Quantity("gain", lambda of: of[2].corrector.spec.gain, "stated"),
    Quantity("delay", lambda of: of[2].corrector.spec.delay, "readings"),
    Quantity("loop_gain", lambda of: of[2].loop_gain, "with what the spots tell of the mechanism's own error"),
    Quantity("seen", lambda of: _seen(*of), "share of a mechanism's own error that a reading tells", where_known=True),
    Quantity("gain_limit", lambda of: of[2].margins.limit, "below which this loop is stable"),
    Quantity("gain_margin", lambda of: _known(of[2].margins.gain), "the limit over the loop gain; null for gain 0"),
    Quantity("phase_margin_deg", lambda of: _known(of[2].margins.phase_deg), converted=False),
    Quantity("stable", lambda of: of[2].margins.stable, "by itself", warning=_unstable_alone),
    Quantity(
        "cycle_steps", lambda of: None if of[2].cycle is None else of[2].cycle.steps, "of the limit cycle, peak to peak"
    ),
    Quantity("unit", lambda of: of[2].corrector.unit[0], "of positions"),
    Quantity(
        "positions", lambda of: positions(of[0], of[1]), "over the moments, when images are taken", converted=False
    ),
    Quantity("held_s", lambda of: [float(of[0].closed.course.times[k]) for k in of[2].ends], "when its range ended"),
)


def _seen(run: LoopRun, name: str, facts: LoopFacts) -> float | None:
    k = [one.name for one in run.model.correctors].index(name)
    return None if facts.corrector.motion is None else float(run.model.seen[k])


def motions_of(run: LoopRun, mode: UnseenMode) -> list[dict[str, Any]]:
    """The largest motions of a mode, with their amounts for one standard deviation of it."""
    stated = run.model.stated
    order = np.argsort(-np.abs(mode.motions), kind="stable")[:MOST_MOTIONS]
    return [
        {"motion": stated.labels[k], "amount": float(mode.motions[k] * stated.sigmas[k]), "unit": stated.units[k]}
        for k in order.tolist()
    ]


MODE: Record[tuple[LoopRun, UnseenMode]] = Record(
    "Motions that no spot shows, for one standard deviation.",
    Quantity("height_m", lambda of: float(of[1].quantities[0]), "of height error"),
    Quantity("angle_arcsec", lambda of: angle_of(*of), "of the angle"),
    Quantity("defocus_first_um", lambda of: float(of[1].quantities[1]), "of the pair's first camera"),
    Quantity("defocus_second_um", lambda of: float(of[1].quantities[2]), "of its second"),
    Quantity("largest_spot_px", lambda of: of[1].spots, "by which the motions move a spot"),
    Quantity("bodies", lambda of: dict(of[1].bodies), "body -> share of the variance"),
    Quantity("motions", lambda of: motions_of(*of), "the largest, with their amounts", converted=False),
)


def angle_of(run: LoopRun, mode: UnseenMode) -> float:
    """What a mode does to the angle, radians."""
    return float(run.open.angle @ run.model.stated.parameters @ mode.motions)


def _near_limit(run: LoopRun) -> str:
    gains = f"{significant(run.margin, 3)} times the stated ones"
    if not run.stable:
        return f"the loops together are unstable: largest eigenvalue {run.radius:.3g}; gains below {gains} are stable"
    nearest = min(run.loops, key=lambda name: run.loops[name].margins.gain)
    return (
        f"the loop is barely stable: gains of {gains} make it unstable, phase margin {run.phase_deg:.0f} deg; it "
        f"amplifies what it should take away. Usual are {GAIN_MARGIN:g} times and {PHASE_MARGIN_DEG:g} deg at least: "
        f"lower gains, that of {nearest} first"
    )


LOOP: Record[LoopRun] = Record(
    "loop.json.",
    Quantity("seed", lambda run: run.seed, "of all random numbers"),
    Quantity(
        "height_closed_rms_m", lambda run: height_rms(run.closed), "mean height error by the cameras, loop closed"
    ),
    Quantity("height_open_rms_m", lambda run: height_rms(run.open), "the same with the loop open"),
    Quantity("height_sigma_rms_m", lambda run: rms(run.closed.told(run.closed.slopes)[1]), "sigma by the posterior"),
    Quantity("height_unseen_rms_m", lambda run: rms(run.unseen[0]), "what no spot shows, one standard deviation"),
    Quantity("angle_closed_rms_arcsec", lambda run: rms(run.closed.true(run.closed.angle)), "loop closed"),
    Quantity("angle_open_rms_arcsec", lambda run: rms(run.open.true(run.open.angle)), "loop open"),
    Quantity("gain_margin", lambda run: _known(run.margin), "of all loops together"),
    Quantity("phase_margin_deg", lambda run: _known(run.phase_deg), "the smallest", converted=False),
    Quantity("spectral_radius", lambda run: run.radius, "of all loops together; below 1 errors decay"),
    Quantity("stable", lambda run: run.stable, "whether it is; the warning is that of its margins"),
    Quantity("margins_hold", lambda run: run.margins_hold, "whether they are large enough", warning=_near_limit),
    Quantity("made_worse", lambda run: list(run.worse), "errors that are larger with the loop closed"),
    Quantity("largest_ratios", lambda run: run.ratios, "quantity -> largest error of the posterior over its sigma"),
    Quantity("ratio_limit", lambda run: run.ratio_limit, "of these"),
    Quantity("times_s", lambda run: run.closed.course.times, "of the readings"),
    Quantity("corrections", lambda run: {n: (run, n, one) for n, one in run.loops.items()}, record=CORRECTION),
    Quantity("closed", lambda run: PASS((run, run.closed)), "with the corrections", converted=False),
    Quantity("open", lambda run: PASS((run, run.open)), "without", converted=False),
    Quantity("bare", lambda run: SUMMARY(run.bare), "by the true cameras: image, orbit, attitude", converted=False),
    Quantity("unseen", lambda run: [(run, mode) for mode in run.modes], "what no spot shows", record=MODE),
    Quantity("unseen_height_m", lambda run: run.unseen[0], "one standard deviation, over the moments"),
    Quantity("unseen_defocus_um", lambda run: run.unseen[1:, 0], "likewise, of the pair"),
)
