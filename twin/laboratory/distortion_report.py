"""Report of a distortion test: results, accuracy and what limits it; for a simulated bench also the true values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orientation.interior import design
from analysis.statistics import gain, rms
from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera_tests import MeasuredDistortionSpec
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.artefact import FAR, Artefact, Cell, DecimalNumber, SvgFigure, Table, decimals_for
from twin.framework.data_files import FrameFacts
from twin.framework.report import Report, Section, answer
from twin.framework.svg import BLUE, GREY, INK, LIGHT, ORANGE, drawn, new_figure, plain_axes
from twin.laboratory import distortion_run, turntable_run
from twin.laboratory.distortion_run import DISTORTION, ESTIMATE, POINTS, TRUTH, DistortionRun, SimulatedDistortion
from twin.laboratory.turntable_report import FIT_NAMES, rejected_table
from twin.laboratory.turntable_run import DOUBTFUL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RAW, COMPENSATED = "angles as read", "compensated angles"
SHOWN = 3
"""Number of points (angles) of the test whose frames are saved: first, middle, last."""
ZERO_SHARE = 0.3
"""Ratio above which a shift of the principal point due to an error of the angles' zero is reported.

The ratio is that of the shift to the standard deviation of the principal point.
"""


def distortion_report(run: DistortionRun) -> Report:
    """Return the report of a distortion test: results, accuracy, figures and tables."""
    data = DISTORTION(run)
    verdict, more = _verdict(run, data)
    simulated = run if isinstance(run, SimulatedDistortion) else None
    frames, facts = _frames(simulated) if simulated is not None else ({}, {})
    sections = [_curve(run, data), _joint(data["joint"]), _estimates(run, data), _noise(run, data)]
    if run.compensation is not None:
        sections.insert(1, _compensation(run))
    return Report(
        title="Interior orientation and distortion",
        verdict=verdict,
        lead=(*more, _typeset(run.compensated.fit.point.sentence)),
        facts=_facts(run, data),
        summary=_summary(run, data),
        sections=tuple(sections),
        images=FrozenMap(frames),
        image_facts=FrozenMap(facts),
        warnings=_warnings(run, data),
    )


def _frames(run: SimulatedDistortion) -> tuple[dict[str, np.ndarray], dict[str, FrameFacts]]:
    """Return the frames of a simulated bench that are saved, by name, and facts about each for the report."""
    test = run.setup.test
    facts = FrameFacts(f"{test.camera}, line CCD {test.band}", run.bench.ccd.band.pitch, note="spot of the pinhole")
    numbers = np.linspace(0, len(run.reading) - 1, SHOWN).astype(int)
    names = {f"spot-{i + 1:02d}": run.record.frames[i, 0] for i in numbers}
    return names, dict.fromkeys(names, facts)


def _facts(run: DistortionRun, data: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return the facts about the distortion test, as pairs of label and text."""
    count, sets = run.reading.shape
    first, last = np.degrees([np.min(run.compensated.fit.angle), np.max(run.compensated.fit.angle)])
    facts = [("points, sets", f"{count} from {first:.3f}° to {last:.3f}°, {sets} sets, {np.sum(run.present)} spots")]
    if run.compensation is not None:
        angles = f"compensated with the {FIT_NAMES[run.compensation.fit.name]} of the turntable's calibration"
    if isinstance(run.test, MeasuredDistortionSpec):
        files = run.test.measured
        if run.compensation is None:
            angles = f"as read, each with σ = {format_quantity(files.angle_sigma or 0.0, ANGLE)}"
        facts += [
            ("angles", f"{angles}; the line's middle is imaged at {format_quantity(files.zero, ANGLE)}"),
            ("approximate principal distance", format_quantity(run.approximate_f, LENGTH)),
            *(("file", f"{file['file']}, {file['rows']} rows") for file in data["files"]),
        ]
    if isinstance(run, SimulatedDistortion):
        test = run.setup.test
        facts += [
            ("angles", f"{angles}, {run.setup.turntable.name}"),
            ("camera", f"{test.camera}, band {test.band}, {test.frames} frames of each spot"),
            (
                "pinhole",
                f"{format_quantity(test.pinhole, LENGTH)} in a collimator of "
                f"{format_quantity(test.collimator.focal_length, LENGTH)}: {run.bench.images.width:.1f} pixels in the "
                "image",
            ),
        ]
    return (*facts, ("description", run.test.description))


def _limit(run: DistortionRun) -> str:
    """Return the largest contribution to the variance of the principal distance, as text."""
    fit = run.compensated.fit
    k = fit.terms.index("principal_distance")
    parts = _shares(run)
    name = max(parts, key=lambda cause: parts[cause])
    share = parts[name] / fit.covariance[k, k]
    return f"{name} ({100.0 * share:.0f} % of its variance)"


def _shares(run: DistortionRun) -> dict[str, float]:
    """Return cause -> its contribution to the variance of the principal distance, square metres."""
    fit, means = run.compensated.fit, run.means
    k = fit.terms.index("principal_distance")
    row = gain(design(fit.angle, fit.terms))[k]
    angles = fit.noise - np.diag(np.hypot(means.sigma, run.compensated.white) ** 2)
    return {
        "the scatter between the sets": float(row**2 @ means.sigma**2),
        "the errors of the angles": float(row @ angles @ row),
        "the scatter of the points about a smooth curve": float(np.sum(row**2) * run.compensated.white**2),
    }


def _verdict(run: DistortionRun, data: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    """Return the verdict on the measured distortion and the sentences that follow it."""
    noise, f, sigma = data["noise"], data["principal_distance_mm"], data["principal_distance_mm_sigma"]
    expected, truth = noise["rejected_expected_by_chance"], data.get("truth")
    distortion_text = f"distortion has σ = {1e6 * float(np.sqrt(np.mean(run.compensated.sigma**2))):.2f} µm"
    truth_text = ""
    if truth is not None:
        ratio = abs(f - truth["principal_distance_mm"]) / sigma
        within = "within" if ratio <= FAR else "outside"
        truth_text = f", {within} {FAR:g} σ of the truth ({truth['principal_distance_mm']:.4f} mm, {ratio:.1f} σ)"
        with_it, without = truth["error_rms_compensated_um"], truth["error_rms_raw_um"]
        gain = "compensation helps" if with_it < without else "compensation does not help"
        distortion_text += (
            f" and true errors of {with_it:.2f} µm rms, with uncompensated angles {without:.2f} µm: {gain}"
        )
    return answer(
        f"The balanced principal distance is {f:.4f} ± {sigma:.4f} mm{truth_text}, limited by {_limit(run)}",
        distortion_text,
        f"points scatter by {data['rms_compensated_um']:.2f} µm rms about a smooth curve",
        f"chi-square is {data['chi_square']:.1f} for {data['degrees_of_freedom']} degrees of freedom with the "
        "specified noise",
        f"{noise['rejected']} of {int(np.sum(run.present))} spots were rejected, {expected:.0f} expected by chance: "
        "see the noise",
    )


def _typeset(text: str) -> str:
    """Convert a plain ASCII statement of the analysis to the symbols of report and terminal."""
    for plain, shown in (
        ("+-", "±"),
        ("tan^2", "tan²"),
        ("tan^3", "tan³"),
        (" um", " µm"),
        (" deg", "°"),
        (" - ", " − "),
        ("= -", "= −"),
    ):
        text = text.replace(plain, shown)
    return text


def _warnings(run: DistortionRun, data: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings about the measurements and their analysis."""
    out = []
    fit = run.compensated.fit
    f, sigma = fit.value("principal_distance"), fit.sigma("principal_distance")
    if isinstance(run, SimulatedDistortion):
        kept = int(np.sum(run.truth.gross & run.means.keep))
        if kept:
            out.append(f"gross errors that Chauvenet's criterion does not reject and that remain in the means: {kept}")
        left = run.bench.true_offset - run.bench.design_offset
        slope = float(np.polyfit(np.tan(run.bench.field_angle), left, 1)[0])
        if abs(slope) > 0.5 * sigma:
            out.append(
                "as-built coma that increases over the field shifts energy centroids against chief rays and f by "
                f"{1e6 * slope:.0f} µm, which is not in the sigma of f ({1e6 * sigma:.0f} µm): measure the wavefront "
                "at several fields"
            )
    if run.readings is not None:
        out += run.readings.file.doubts
        if not run.readings.numbered and run.reading.shape[1] > 1:
            out.append(
                "spots of a point have no set numbers and count as independent exposures: the sigma of a mean of four"
                " is half that of a single one; add a column 'set' if they belong to sets"
            )
    moved = abs(fit.value("constant"))
    if isinstance(run.test, MeasuredDistortionSpec) and moved > ZERO_SHARE * fit.sigma("principal_point"):
        sense = -1.0 if run.test.measured.reversed else 1.0
        zero = run.test.measured.zero + sense * run.compensated.zero
        out.append(
            f"the line's middle is imaged {run.compensated.zero / ARCSEC:.3g} arcsec from `zero`, which moves the "
            f"principal point by {1e3 * moved:.3g} mm and is not in the sigmas; zero: {np.degrees(zero):.9f} deg "
            "removes this shift"
        )
    if abs(f / run.approximate_f - 1.0) > 0.05:
        out.append(
            f"the principal distance is {f:.4g} m, but `principal_distance` says {run.approximate_f:.4g} m: are the "
            "units of angles and positions right?"
        )
    if data["probability"] < DOUBTFUL:
        out.append(
            "the points scatter about a smooth curve more than the specified noise allows; the excess, "
            f"{data['noise']['white_compensated_um']:.2f} µm, is included in all sigmas as independent from point to "
            "point"
        )
    if run.compensation is None:
        out.append(
            "no calibration of the turntable: a dividing error of long period is not distinguishable from distortion, "
            "and only `angle_sigma` covers it"
        )
    return tuple(out)


def _summary(run: DistortionRun, data: Mapping[str, Any]) -> Table:
    """Return the table of principal distance, principal point and distortion with their sigmas."""
    truth = data.get("truth")
    keys = ["principal_distance_mm", "principal_point_mm", "correlation", "radial3_mm", "rms_compensated_um"]
    keys += [*(["rms_raw_um"] * (run.compensation is not None)), "chi_square", "degrees_of_freedom"]
    rows = DISTORTION.lines(data, keys, truth)
    if truth:
        rows += [(*row, None, None) for row in TRUTH.lines(truth, ("error_rms_raw_um", "error_rms_compensated_um"))]
    caption = (
        "f and p by least squares with a constant for the unknown zero of the angles. Balanced: the f that "
        "leaves the smallest distortion over the points; with the radial term use the joint model."
    )
    heads = ("", "measured", "sigma", "truth")[: len(rows[0])]
    return Table("distortion-result", "Result", caption, heads, rows)


def _curve(run: DistortionRun, data: Mapping[str, Any]) -> Section:
    """Return the report section on the measured distortion over the field."""
    text, caption = [], "Means of the sets."
    if isinstance(run, SimulatedDistortion):
        with_it, without = (rms(run.error(d) / d.sigma) for d in (run.compensated, run.raw))
        text.append(
            f"The errors are {with_it:.2f} sigma rms with compensated angles, {without:.2f} with angles as read."
        )
        caption += " Line: exact chief rays of the as-built camera."
    keys = ["point", "reading_deg", "field_deg", "position_mm", "distortion_compensated_um"]
    keys += ["distortion_compensated_um_sigma", "residual_compensated_um", "sets_kept"]
    artefacts: tuple[Artefact, ...] = (
        SvgFigure(
            "distortion-curve", "Distortion over the field", caption, drawn("distortion-curve", _curve_figure, run)
        ),
        POINTS.table("distortion-points", "Point by point", "Means of the accepted sets.", data["points"], keys),
    )
    return Section("Distortion", tuple(text), artefacts, folded=1)


def _compensation(run: DistortionRun) -> Section:
    """Return the section that compares distortion from raw angles and from angles corrected for the dividing error."""
    raw, compensated = run.raw, run.compensated
    pairs = {
        "residual from the smooth curve": (raw.smooth.residual, compensated.smooth.residual),
        "RMS of distortion over the sets": (raw.rms_over_sets, compensated.rms_over_sets),
    }
    if isinstance(run, SimulatedDistortion):
        pairs["error of the distortion (needs the truth)"] = (run.error(raw), run.error(compensated))
    rows: list[tuple[Cell, ...]] = []
    for name, values in pairs.items():
        before, after = (1e6 * rms(value) for value in values)
        largest = [1e6 * float(np.max(np.abs(value))) for value in values]
        rows.append((name, before, after, 100.0 * (1.0 - after / before) if before else None, *largest))
    table = Table(
        "distortion-reduction",
        "Effect of the compensation",
        "RMS over the points, and largest absolute value.",
        ("quantity", "raw [µm]", "compensated [µm]", "reduction [%]", "largest raw [µm]", "largest compensated [µm]"),
        rows,
        (None, 2, 2, 0, 1, 1),
    )
    return Section("Raw and compensated angles", (), (table,))


ESTIMATES = {
    "eq2": "(2): f and p",
    "eq3": "(3): balanced f, p = 0",
    "eq4": "(4): p, with balanced f of (3)",
    "eq2_zero_from_constant": "(2), W counted from the fitted zero",
    "constant": "constant, balanced f, p (adopted)",
    "constant_radial3": "constant, f, p, radial (joint)",
}
"""Key of an estimate by an equation or fit -> its description in reports."""


def _joint(joint: Mapping[str, Any]) -> Section:
    """Return the report section on the joint model, which fits a radial distortion term with the orientation.

    It gives the parameters as fitted, and converted to those of a line in a payload's file.

    Parameters
    ----------
    joint : mapping
        Record ``joint`` of distortion.json.
    """
    text = ("Use the terms of one table together: with a radial term f is the slope in the middle of the field.",)

    def table(name: str, title: str, caption: str, part: Mapping[str, Any], suffix: str, shown: list[str]) -> Table:
        size, sigma = np.array(part[f"values{suffix}"]), np.array(part[f"values{suffix}_sigma"])
        spread = np.array(part["covariance_mm2" if suffix else "covariance"]) / np.outer(sigma, sigma)
        rows: list[tuple[Cell, ...]] = [
            (label, *(DecimalNumber(v, decimals_for(s)) for v in (value, s)), *(float(v) for v in row))
            for label, value, s, row in zip(shown, size, sigma, spread, strict=True)
        ]
        heads = ("", "measured", "sigma", *(f"correlation: {label.split(' [')[0]}" for label in shown))
        return Table(name, title, caption, heads, rows, (None, None, None, *(3 for _ in shown)))

    names = [f"{name.replace('_', ' ')} [mm]" for name in joint["terms"]]
    line = ["axis [arcsec]", "principal_distance f [mm]", "principal_point y0 [mm]", "k1 [1/m²]"]
    return Section(
        "Joint model",
        text,
        (
            table("distortion-joint", "Joint model", f"{_typeset(joint['model'])}.", joint, "_mm", names),
            table(
                "distortion-line",
                "Joint model as a line of a payload's file",
                "tan θ = (y − y0) (1 + k1 (y − y0)²) / f from the camera's Z, which is at the angle `axis` from the "
                "zero of the angles; principal_distance, principal_point: [0 mm, y0] and k1 as in a payload's file.",
                joint["line"],
                "",
                line,
            ),
        ),
    )


def _estimates(run: DistortionRun, data: Mapping[str, Any]) -> Section:
    """Return the report section on the estimates by each equation, and on which quantities they can determine."""
    heads, digits = (["estimate", *(q.shown_head for q in ESTIMATE)], [None, *(q.decimals for q in ESTIMATE)])
    rows: list[tuple[Cell, ...]] = [(ESTIMATES[name], *record.values()) for name, record in data["estimates"].items()]
    constant_text = (
        "Equations (1) to (4) (Li et al., doi 10.3788/IRLA20200143) have no constant: W must count exactly from the "
        "direction that is imaged to the line's middle. The fitted constant places it "
        f"{run.compensated.zero / ARCSEC:.3f} arcsec from the specified zero"
    )
    text, caption = [f"{constant_text}."], "All with compensated angles." if run.compensation is not None else ""
    if isinstance(run, SimulatedDistortion):
        zero_error = (run.compensated.zero - run.truth.zero) / ARCSEC
        text = [
            f"{constant_text}, {zero_error:+.3f} arcsec from the truth: the middle was aligned to the pinhole within "
            f"{run.truth.zero / ARCSEC:.2f} arcsec, and the compensation at that reading has an error, too."
        ]
        caption += " Errors: difference from the same estimate with exact chief rays at the true angles."
        heads, digits = [*heads, "error of f [mm]", "error of p [mm]", "error of D, rms [µm]"], [*digits, 3, 2, 2]
        pairs = [(estimate, run.true_estimates[name]) for name, estimate in run.estimates.items()]
        errors = [(1e3 * (e.f - t.f), 1e3 * (e.p - t.p), 1e6 * rms(e.distortion - t.distortion)) for e, t in pairs]
        rows = [(*row, *error) for row, error in zip(rows, errors, strict=True)]
    title = "Equations (1) to (4) and fits with a constant"
    return Section(
        "Estimators and observability",
        (*text, _typeset(run.compensated.fit.point.sentence)),
        (Table("distortion-estimates", title, caption, heads, rows, digits),),
    )


def _noise(run: DistortionRun, data: Mapping[str, Any]) -> Section:
    """Return the report section on the noise of the spots and on rejected spots."""
    noise, specified = data["noise"], data["specified_exposure_um"]
    text = [
        f"One spot scatters by {noise['exposure_um']:.3f} µm "
        + ("between the sets" if run.reading.shape[1] > 1 else "by its specified sigmas")
        + (f", of which noise of its position is {specified:.3f} µm" if specified > 0.0 else "")
        + f". Beyond the specified noise, points scatter by {noise['white_compensated_um']:.3f} µm about a smooth curve"
        + ("." if run.compensation is None else f", {noise['white_raw_um']:.3f} µm with angles as read.")
    ]
    if data["across_range_um"] is not None:
        text.append(f"Across the line the spots range over {data['across_range_um']:.0f} µm.")
    causes = _shares(run)
    total = sum(causes.values())
    rows: list[tuple[Cell, ...]] = [
        (name, 1e3 * float(np.sqrt(value)), 100.0 * value / total) for name, value in causes.items()
    ]
    artefacts: list[Artefact] = [
        Table(
            "distortion-causes",
            "What limits the principal distance",
            "Standard deviation by cause; the variances add up.",
            ("cause", "sigma of f [mm]", "share of variance [%]"),
            rows,
            (None, 4, 1),
        )
    ]
    for record, key, what in (
        (distortion_run.REJECTED, "rejected_readings", "Readings"),
        (turntable_run.REJECTED, "rejected_comparisons", "Comparisons of the turntable"),
    ):
        if rejected := data.get(key):
            artefacts.append(rejected_table(record, f"distortion-{key.replace('_', '-')}", what, rejected))
    folded = len([artefact for artefact in artefacts if artefact.name.startswith("distortion-rejected")])
    return Section("Noise and rejected spots", tuple(text), tuple(artefacts), folded)


def _curve_figure(run: DistortionRun) -> Figure:
    """Draw distortion over the field, residuals from a smooth curve and, for a simulated bench, the error."""
    known = isinstance(run, SimulatedDistortion)
    figure = new_figure(8.0 if known else 6.0)
    panels = figure.subplots(2 + known, 1, sharex=True, height_ratios=(1.25, 1.0, 1.0)[: 2 + known])
    field = np.degrees(run.compensated.fit.angle)
    if isinstance(run, SimulatedDistortion):
        panels[0].plot(field, 1e6 * run.true_distortion, color=INK, lw=1.0, label="exact chief rays")
        panels[2].set_title("Measured − true, with the total sigma", loc="left")
    series = [(run.raw, RAW, ORANGE, "s", -0.005), (run.compensated, COMPENSATED, BLUE, "o", 0.005)]
    for data, name, colour, marker, shift in series if run.compensation is not None else series[:1]:
        style = {"fmt": marker, "color": colour, "ms": 3.5, "lw": 0.8, "label": name}
        panels[0].errorbar(field + shift, 1e6 * data.distortion, 1e6 * data.sigma, **style)
        panels[1].errorbar(field + shift, 1e6 * data.smooth.residual, 1e6 * data.means.sigma, **style)
        if isinstance(run, SimulatedDistortion):
            panels[2].errorbar(field + shift, 1e6 * run.error(data), 1e6 * data.sigma, **style)
    panels[0].set_title("Distortion D = L − c − f tan W + p tan² W, with its total sigma", loc="left")
    panels[1].set_title("Residual from the smooth curve, with the sigma of the means", loc="left")
    panels[-1].set_xlabel("field angle W [deg]")
    for axes in panels:
        axes.set_ylabel("µm")
        _dress(axes)
    for axes in panels[1:]:
        axes.axhline(0.0, color=GREY, lw=0.8)
    return figure


def _dress(axes: Axes) -> None:
    """Add a light grid to axes, and a legend with room above the data."""
    low, high = axes.get_ylim()
    # room for the legend above the data
    axes.set_ylim(low, high + 0.18 * (high - low))
    axes.grid(axis="y", color=LIGHT, lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper center", ncols=3)
    plain_axes(axes)
