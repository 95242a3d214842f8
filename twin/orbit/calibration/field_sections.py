"""What a report says of single fields, of measured passes, of points in images, and of errors that the fit does
not show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orbit.calibration_parameters import OFFSET
from analysis.orbit.three_line_model import BIAS
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.artefact import Cell, PngFigure, SvgFigure, Table
from twin.framework.quantity import Quantity, Record
from twin.framework.report import Section
from twin.orbit.calibration.calibration_numbers import IMAGES
from twin.orbit.calibration.calibration_plots import figure_svg
from twin.orbit.calibration.calibration_run import CalibrationRun
from twin.orbit.calibration.campaign import Campaign
from twin.orbit.calibration.field_images import Screening
from twin.orbit.calibration.influences import SURPRISE, DatumRow, LightRow
from twin.orbit.calibration.screening import ground_sample, meeting_of
from twin.orbit.images.image_points import BEYOND
from twin.orbit.images.point_judgement import WRONG
from twin.orbit.images.point_report import points_png


def fields_section(run: CalibrationRun) -> Section:
    """Every field by itself, and the scatter over the fields."""
    rows: list[tuple[Cell, ...]] = []
    for one in run.campaign.passes:
        alone = run.fields[one.name].adjustment
        bias = alone.bias(one.name) / ARCSEC
        errors = [] if one.known_truth is None else (bias - one.bias / ARCSEC).tolist()
        rows.append((one.name, float(np.degrees(one.latitude)), *map(float, bias), *errors, alone.p_value))
    truth = ("Δ roll", "Δ pitch", "Δ yaw") if run.truth is not None else ()
    table = Table(
        "fields",
        "Each field by itself",
        f"Roll, pitch and yaw of the bias, arcseconds{', and minus the truth at the middle' * bool(truth)}. "
        "An offset of the orbit, which these unknowns do not have, goes into roll and pitch: 0.3 m are 0.1 arcsec.",
        ("field", "latitude [deg]", *BIAS, *truth, "chance of the fit"),
        rows,
        (None, 1, *(3,) * (len(BIAS) + len(truth) + 1)),
    )
    found = run.repeatability
    if not found:
        return Section("Fields", ("One field alone does not repeat.",), (table,))
    scatter: list[tuple[Cell, ...]] = []
    for r in found:
        angle = r.name in BIAS
        scale, shown = (ARCSEC, "arcsec") if angle else (1e-3, "mm")
        held = r.sigma == 0.0
        scatter.append(
            (r.name, shown, None if held else r.scatter / scale, None if held else r.sigma / scale, r.p_value)
        )
    inner = [r for r in found if r.name not in BIAS and r.sigma > 0.0]
    worst = max(inner, key=lambda r: r.scatter)
    largest = max((r for r in found if r.name in BIAS), key=lambda r: r.scatter)
    text = (
        f"From field to field the interior orientation repeats to {1e3 * worst.scatter:.4f} mm or better (standard "
        f"deviation, {worst.name}). The biases scatter by up to {largest.scatter / ARCSEC:.2f} arcsec "
        f"({largest.name}).",
        "Against the sigmas of single fields, in the table, a scatter is what their points allow, not a camera that "
        "changes, unless the chance is small. y of the outer lines goes with yaw, and both are known far less well "
        "than their sum.",
    )
    repeats = Table(
        "repeatability",
        "Repeatability over the fields",
        "Standard deviation over the fields, sigma that a field's adjustment claims, chance of such a scatter by this "
        "sigma alone. Small for a bias means that it really differs from field to field. Without numbers: held "
        "(gauge).",
        ("parameter", "unit", "scatter", "claimed σ", "chance"),
        scatter,
        (None, None, 4, 4, 3),
    )
    return Section("Fields", text, (repeats, table))


def biases_section(run: CalibrationRun) -> Section:
    """Biases against latitude, and what this means for the schemes."""
    figure = SvgFigure(
        "bias-latitude",
        "Bias of the attitude against latitude",
        "From the adjustment of all fields, which knows of the orbit's offsets. The error bars of yaw are common to "
        "all fields (y of the outer lines); its differences are known far better.",
        figure_svg("bias-latitude", run),
    )
    if not run.latitude:
        few = "There are too few fields, or all at one latitude, to tell a drift with latitude from the season."
        return Section("Biases against latitude", (few,), (figure,))
    spec = run.campaign.spec
    true = season = np.zeros(0)
    if run.truth is not None:
        # measured to true is the inverse of the drift of the measured attitude
        errors = run.campaign.simulated.errors
        true = -np.array(errors.star_tracker.thermal.amplitude) * errors.switched_on / ARCSEC
        season = np.array(errors.season) / ARCSEC
    rows: list[tuple[Cell, ...]] = []
    for k, fit in enumerate(run.latitude):
        numbers = (fit.amplitude, fit.amplitude_sigma, fit.constant, fit.constant_sigma, fit.remainder)
        amplitude, amplitude_sigma, constant, constant_sigma, left = (float(v / ARCSEC) for v in numbers)
        rows.append(
            (
                fit.axis,
                amplitude,
                amplitude_sigma,
                *true[k : k + 1].tolist(),
                constant,
                constant_sigma,
                fit.chi_square,
                fit.degrees_of_freedom,
                fit.p_value,
                left,
                *season[k : k + 1].tolist(),
            )
        )
    table = Table(
        "bias-fits",
        "Amplitude × sin(latitude − reference) + constant",
        f"Arcseconds; the reference is the middle of the fields, {np.degrees(run.latitude[0].reference):.1f}°. "
        "Chi-square with the biases' own covariance; what remains beside it is the season, and the sigmas of amplitude "
        "and constant contain it.",
        (
            "axis",
            "amplitude",
            "σ",
            *["true amplitude"] * len(true[:1]),
            "constant",
            "σ",
            "chi-square",
            "degrees",
            "chance",
            "remains, 1σ",
            *["true season"] * len(true[:1]),
        ),
        rows,
        (None, 2, 2, *(2,) * len(true[:1]), 2, 2, 1, None, 3, 2, *(2,) * len(true[:1])),
    )
    values = np.array([[run.together.value(f"{p.name} {axis}") for p in run.campaign.passes] for axis in BIAS[:2]])
    spread = float(np.hypot(*values.std(axis=1, ddof=1)))
    metres, most = spread * run.campaign.passes[0].altitude, max(len(s) for s in spec.schemes)
    weak = [f.axis for f in run.latitude if abs(f.amplitude) < 2.0 * f.amplitude_sigma]
    seen = f"in this campaign the drift does not show in {', '.join(weak)}" if weak else "the drift shows in all axes"
    reach = np.ptp(np.sin(run.latitude[0].latitude - run.latitude[0].reference))
    rest = ", ".join(f"{f.remainder / ARCSEC:.2f} arcsec in {f.axis}" for f in run.latitude)
    degrees = np.degrees(np.ptp(run.latitude[0].latitude))
    text = (
        f"The fields lie within {degrees:.0f}° of latitude, where the sine changes by {reach:.2f}, so that a drift of "
        f"1 arcsec amplitude makes {reach:.2f} arcsec between the first and the last. Beside it there remain {rest}, "
        f"the season of each field: {seen} at two sigmas. More fields, or the same ones in all seasons, would tell "
        "them apart.",
        f"Roll and pitch of the fields scatter by {spread / ARCSEC:.2f} arcsec together, {metres:.1f} m on the "
        f"ground. By the rules of a mean, one field's bias leaves another field {np.sqrt(2.0) * metres:.1f} m RMS in "
        f"plan, and the mean of {most} fields {np.sqrt(1.0 + 1.0 / most) * metres:.1f} m, beside the noise of its "
        "own: averaging helps by less than a third, and no number of fields goes below the scatter itself. Only a "
        "field's own parameters do, or a reading of the bias in every pass.",
    )
    return Section("Biases against latitude", text, (figure, table))


_LISTED = 12
"""Names that a text lists at most."""


def measured_section(run: CalibrationRun) -> Section:
    """Points and residuals of every pass, errors of check points in pixels of the ground, what no sigma contains."""
    campaign = run.campaign
    rows: list[tuple[Cell, ...]] = []
    sizes: list[tuple[Cell, ...]] = []
    own = list(run.schemes.values())[-1]
    for one in campaign.passes:
        gone = campaign.rejected.get(one.name)
        meeting = meeting_of(campaign, one, run.fields[one.name].adjustment)
        lost = (
            (None, None, None) if gone is None else (len(gone.points), len(gone.check_points), _factors(gone.factors))
        )
        alone = run.fields[one.name].adjustment
        rows.append(
            (
                one.name,
                int(one.is_control.sum()),
                one.tie_count,
                len(one.check_ground),
                *lost,
                alone.chi_square / max(alone.degrees_of_freedom, 1),
                alone.p_value,
                meeting.chi_square / max(meeting.degrees_of_freedom, 1),
            )
        )
        for line in one.data.sensors:
            along, across = ground_sample(one, line)
            pixel = float(np.sqrt(along * across))
            errors = own[one.name]
            sizes.append(
                (one.name, line, along, across, errors.plan_rms / pixel, errors.height_rms / pixel, errors.count)
            )
    points = Table(
        "measured-points",
        "Points of every pass",
        "Left out: image points that robust weights gave up, check points whose rays do not meet. Factor: on the given "
        "sigmas of image points of the lines, by the residuals of those that remain. Chi-square over its degrees of "
        "freedom, of the pass calibrated by itself and of the rays of its check points with these parameters.",
        (
            "pass",
            "control",
            "ties",
            "check",
            "image points left out",
            "check left out",
            "factor",
            "χ²/dof",
            "chance",
            "check χ²/dof",
        ),
        rows,
        (None, None, None, None, None, None, None, 2, 3, 2),
    )
    pixels = Table(
        "measured-pixels",
        "Pixels on the ground, and errors of check points in them",
        "Ground sample distance of the middle of each line, metres; RMS errors of the check points by the pass's own "
        "parameters, in ground pixels (root of along times across).",
        ("pass", "line", "along the track [m]", "across [m]", "plan [px]", "height [px]", "check points"),
        sizes,
        (None, None, 3, 3, 2, 2, None),
    )
    return Section("Measurements", (*_screening(run), *_limits(run)), (points, pixels))


def _factors(found: Mapping[str, float]) -> str:
    """Factors of the lines in words: one where all lines have the same."""
    texts = {line: f"{v:.2f}" for line, v in found.items()}
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return ", ".join(f"{line} {v}" for line, v in texts.items())


def _screening(run: CalibrationRun) -> tuple[str, ...]:
    """What was left out, by name."""
    if not run.campaign.rejected:
        return ("No image point was left out: the file says `screening: none`.",)
    found = []
    for name, gone in run.campaign.rejected.items():
        listed = ", ".join(f"{point} in {line}" for point, line in gone.points[:_LISTED])
        more = f" and {len(gone.points) - _LISTED} more" if len(gone.points) > _LISTED else ""
        checks = ", ".join(gone.check_points[:_LISTED])
        text = f"{name}: {gone.left} of {gone.entered} image points are used"
        text += f"; left out {listed}{more}" if listed else "; none is left out"
        text += f"; check points that lie elsewhere or whose rays do not meet: {checks}." if checks else "."
        found.append(text)
    return tuple(found)


def _limits(run: CalibrationRun) -> tuple[str, ...]:
    """What makes the sigmas, and what they do not contain."""
    noise, campaign = run.campaign.noise, run.campaign
    one = campaign.passes[0]
    focal = float(np.mean([m.interior[0] for m in campaign.laboratory.values()]))
    ground = one.altitude / focal
    # white noise of the readings by their spline, in metres on the ground, beside that of the image
    parts = {
        "image points": noise.image * ground,
        "readings of the attitude": noise.attitude * one.altitude,
        "slow errors of the attitude": noise.slow_attitude * one.altitude,
        "readings of the orbit": noise.station,
        "control points": float(
            np.sqrt(np.mean(np.trace(one.control_covariance[one.is_control], axis1=1, axis2=2) / 3.0))
        ),
    }
    listed = ", ".join(f"{name} {value:.2g} m" for name, value in sorted(parts.items(), key=lambda v: -v[1]) if value)
    return (
        f"One standard deviation on the ground at nadir, of a single ray to a single point of {one.name}: {listed}. "
        "The first of these limits the result; more points make it smaller but for slow errors of the attitude.",
        "The sigmas contain these, as the tables and the file state them. They do not contain what all points of a "
        "pass share and no point shows: a wrong datum of the control points, a wrong time, an atmosphere unlike the "
        "standard one, and biases that drift during the pass where nothing tells them. Errors at check points are "
        "against their given coordinates and contain the errors of these; n points tell an RMS to 1/√(2n) of itself.",
    )


SCREENED: Record[Screening] = Record(
    "Image points of a field in the adjustment.",
    Quantity("entered", lambda s: s.entered, "image points of control and tie points"),
    Quantity("wrong", lambda s: s.wrong_entered, "wrong places among them"),
    Quantity("rejected", lambda s: s.entered - s.left, "image points that the adjustment leaves out"),
    Quantity("right_rejected", lambda s: s.right_lost, "right places among those that it leaves out"),
    Quantity("wrong_left", lambda s: s.wrong_left, "wrong places that it keeps"),
    Quantity("check_points", lambda s: s.check_entered, "check points before the test of their intersection"),
    Quantity("check_left", lambda s: s.check_left, "check points after it"),
    Quantity("wrong_check_left", lambda s: s.wrong_check_left, "kept ones with a wrong place in a line", "wrong left"),
)
_SORTS = {"control": "orthophoto", "tie": "tie"}


def images_section(campaign: Campaign) -> Section:
    """Numbers of points that were matched, lost and wrong, by field, sort and line."""
    assert campaign.images is not None
    spec = campaign.simulated.images
    assert spec is not None
    data = IMAGES(campaign)
    total = data["total"]
    screened = SCREENED.table(
        "image-points",
        "Image points in the adjustment",
        "Of points that every line has. Rejected: robust weight zero (IGG), for check points rays that do not meet.",
        {one.name: SCREENED(one.screening) for one in campaign.images if one.screening is not None},
        label="field",
    )
    counts = [len(p.control_ground[p.control.control]) for p in campaign.passes]
    text = (
        f"In each field {len(spec.patches)} patches of {spec.lines} x {spec.pixels} pixels are rendered by every line. "
        f"Of {total['found']} places that matching found, {total['wrong_found']} are wrong "
        f"({100.0 * total['wrong_found'] / total['found']:.1f}%), mostly on fields that look different in the "
        f"orthophoto; thresholds of the matching leave {total['wrong_matched']} of {total['matched']}, the "
        f"neighbours' agreement {total['wrong_accepted']} of {total['accepted']}, the adjustment "
        f"{total['wrong_left']} of {total['left']} image points ({total['check_left']} check points: "
        f"{total['wrong_check_left']}). The neighbours' test costs {total['right_rejected_by_consensus']} right ones, "
        f"the adjustment {total['right_rejected_by_adjustment']}.",
        f"{' and '.join(str(c) for c in counts)} control points are left. Their image points weigh by the covariances "
        f"of the matching and {BEYOND:g} px beyond them, for what no fit shows. Matches of the three "
        "lines with one piece of the orthophoto err alike, by its noise and its "
        "other light; that moves the adjusted point and hardly shows in residuals, so that the fit looks better than "
        "its sigmas. The orthophoto's error in plan is nearly one for all points of a patch: each of n points has been "
        "given n times its variance, so that the patch counts once. A shift that the whole orthophoto shares is a "
        "wrong datum and goes into the biases; no sigma contains it.",
    )
    first = campaign.images[0]
    figures = [
        PngFigure(
            f"points-{sort}",
            f"From predicted to found, {_SORTS[sort]} points, first patch of {first.name}",
            "Arrows: what is left after the median displacement, enlarged as the title says; crosses: rejected by the "
            "neighbours; points: not matched.",
            points_png(first.shown, points),
        )
        for sort, points in first.patches[0].points.sorts.items()
    ]
    return Section("Points in images", text, (_matching(data["fields"]), screened, *figures))


def _matching(fields: Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]]) -> Table:
    keys = ("right_rejected_by_consensus", "rms_lines_px", "rms_pixels_px", "chi_square_ratio")
    rows: list[tuple[Cell, ...]] = []
    for field, sorts in fields.items():
        for sort, lines in sorts.items():
            for line, n in lines.items():
                wrong = [f"{n[f'wrong_{passed}']} of {n[passed]}" for passed in ("found", "matched", "accepted")]
                rows.append((field, _SORTS[sort], line, *wrong, *(n[key] for key in keys)))
    return Table(
        "image-matching",
        "Matching",
        f"Wrong: {WRONG}; "
        "before any test, after the thresholds of matching, after consensus. RMS along the track and the line, px, and "
        "chi-square of the errors over degrees of freedom, of right places.",
        (
            "field",
            "points",
            "line",
            "wrong before",
            "after matching",
            "after consensus",
            "right lost",
            "RMS track",
            "RMS line",
            "χ²/dof",
        ),
        rows,
        (None, None, None, None, None, None, None, 3, 3, 2),
    )


def light_section(run: CalibrationRun) -> Section:
    """What each effect does that is not taken out of the image points."""
    if len(run.light) < 2:
        return Section("Effects on the light", ("None is on.",))
    pitch = run.campaign.passes[0].data.pitch
    sizes: list[tuple[Cell, ...]] = []
    rows: list[tuple[Cell, ...]] = []
    for row in run.light:
        name = _left(row)
        if row.left:
            moved = [float(v / pitch[line]) for line in run.campaign.lines for v in row.moved[line]]
            sizes.append((name, *moved))
        inner, turned = row.most(run.campaign.inner), row.most(tuple(n for n in row.shift if n.split()[-1] in BIAS))
        shifts = [f"{who} {by:+.1f} σ" if row.left else "" for who, by in (inner, turned)]
        rows.append(
            (f"{name} left in" if row.left else name, *astuple(row.before), *astuple(row.after), *shifts, row.p_value)
        )
    pixels = Table(
        "light-pixels",
        "How far image points move",
        "RMS over the check points, pixels, x along the track and y along the line.",
        ("effect", *(f"{line} {axis}" for line in run.campaign.lines for axis in "xy")),
        sizes,
        (None, *(3,) * (2 * len(run.campaign.lines))),
    )
    effects = Table(
        "light",
        "What is not taken out of the image points",
        "RMS at check points, mean of the fields, metres: by the laboratory's camera, and by each field's own "
        "parameters; the unknowns of the simultaneous adjustment that move by the most of their sigmas; chance of the "
        "fit, with the noise of the readings counted as independent.",
        ("case", "plan before", "height before", "plan after", "height after", "interior", "bias", "chance of the fit"),
        rows,
        (None, 2, 2, 2, 2, None, None, 3),
    )
    left = run.light[-1]
    most, ratio = left.most(run.campaign.inner)
    text = (
        "Light time, aberration and refraction are in the image points. The analysis takes them out by its own models "
        "of them, with the laboratory's camera and the measured orbit and attitude: for each image point, the "
        "direction in which it looks and the straight line to the place that it sees are projected into the image, "
        "and the point is moved by the difference. That the camera is 100 m wrong on the ground matters to some "
        "thousandths of a pixel, most of it because the heights of check points, which refraction depends on, are "
        "first known to 100 m.",
        "Left in, they do hardly any harm where a camera is used as it was calibrated: biases and principal points "
        f"take them up, the mean error in plan goes from {run.light[0].after.plan_rms:.3f} m to "
        f"{left.after.plan_rms:.3f} m. But parameters are then "
        f"wrong ({most} by {1e6 * left.shift[most]:+.1f} µm, {abs(ratio):.1f} sigmas), which the "
        "fit need not show, and they are no longer those of the camera: seen from another height, or by a satellite "
        "that tilts, the light does something else.",
        "The corrections use the same models of the atmosphere and of the light as the simulation: they show that the "
        "method is right, not how well an atmosphere is known."
        if run.truth is not None
        else "Refraction is that of the standard atmosphere; how far the day's air differed from it is in no sigma.",
    )
    return Section("Effects on the light", text, (pixels, effects))


def datum_section(run: CalibrationRun) -> Section:
    """What a common shift of the control points does, and what is suspicious."""
    rows: list[tuple[Cell, ...]] = []
    for row in run.datum:
        name, change = row.most
        where = ", ".join(f"{v:g} m {axis}" for v, axis in zip(row.shift, ("east", "north", "up"), strict=True) if v)
        where = f"lines {1e3 * row.late:g} ms late" if row.late else where
        bias = [float(v / ARCSEC) for v in row.bias]
        rows.append(
            (
                where,
                *bias,
                f"{name} {1e6 * change:+.1f} µm",
                *_sizes(row),
                *map(float, row.offset),
                row.fit,
                row.p_value,
                *astuple(row.after),
            )
        )
    table = Table(
        "datum",
        "All control points in a wrong datum",
        "Mean changes of the fields' biases, arcseconds; the element of the interior that changes most; the one that "
        "changes by the most of its sigmas, what makes one sigma of it, and from what on an unknown is beyond what "
        "launch leaves to expect, which gives a warning; mean changes of the orbit's offsets, metres; change of the "
        "chi-square and chance of the fit; RMS at check points in the right datum, each field with its own parameters, "
        "metres.",
        (
            "wrong by",
            *BIAS,
            "interior",
            "in sigmas",
            "one sigma at",
            "warned from",
            *OFFSET,
            "Δ chi-square",
            "chance of the fit",
            "plan after [m]",
            "height after [m]",
        ),
        rows,
        (None, 2, 2, 2, None, None, None, None, 3, 3, 3, 1, 3, 2, 2),
    )
    launch = run.campaign.spec.launch
    roll, inner = (format_quantity(v, k) for v, k in ((launch.bias[0], ANGLE), (launch.interior, LENGTH)))
    metres = SURPRISE * launch.bias[0] * run.campaign.passes[0].altitude
    text = [
        "A shift that all control points share in plan is a turn of the camera by shift over altitude, and one in "
        "height a change of all principal distances and of the outer lines' x. Biases and interior take it up, the "
        "orbit's offsets, which their prior holds, hardly do, and the fit need not show it. Check points of the same "
        "wrong datum would not show it either. Lines whose clock is late move everything along the track.",
        f"What remains is to ask whether the parameters are believable. The file expects {roll} (roll) and {inner} "
        f"(interior) of a launch; beyond {SURPRISE:g} times this there is a warning, which is {metres:.0f} m of "
        "shift across the track.",
    ]
    if run.surprises:
        listed = ", ".join(f"{s.name} ({s.ratio:.1f}σ)" for s in run.surprises[:6])
        text.append(f"Beyond what is expected here: {listed}.")
    else:
        text.append("Nothing is beyond what is expected here.")
    return Section("Datum of the control points", tuple(text), (table,))


def _sizes(row: DatumRow) -> tuple[str, str, str]:
    """The element of the interior that moves most in sigmas, what moves it by one, what gives a warning."""
    name, sigmas = row.most_sigmas
    scale, unit = (1e3, "ms") if row.late else (1.0, "m")
    warned = "never" if row.warned is None else f"{scale * row.warned:.3g} {unit}"
    return f"{name} {sigmas:.1f} σ", f"{scale * row.size / max(sigmas, 1e-9):.3g} {unit}", warned


def _left(row: LightRow) -> str:
    if not row.left:
        return "nothing left in"
    return "all" if len(row.left) > 2 else " and ".join(name.replace("_", " ") for name in row.left)
