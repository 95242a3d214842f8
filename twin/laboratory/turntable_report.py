"""Report of a turntable test: results, accuracy and what limits it; for a simulated table also the true values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from analysis.turntable.dividing_error import covered, gaps
from scenes.specs.camera_tests import MeasuredTurntableSpec
from scenes.yaml.units import ANGLE, format_quantity
from twin.framework import svg
from twin.framework.artefact import Artefact, DecimalNumber, SvgFigure, Table
from twin.framework.record import Record
from twin.framework.report import Report, Section, answer
from twin.laboratory import turntable_run
from twin.laboratory.turntable_run import DOUBTFUL, TURNTABLE, TurntableModel, TurntableRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIT_NAMES = {
    "piecewise_linear": "piecewise linear",
    "polynomial": "polynomial",
    "cubic_spline": "cubic spline",
    "fourier": "Fourier series",
    "network": "network",
}
"""Key of a fit of the dividing error -> its name in reports."""
COLOURS = {
    "piecewise_linear": svg.ORANGE,
    "polynomial": svg.PURPLE,
    "cubic_spline": svg.BLUE,
    "fourier": svg.GREEN,
    "network": svg.VERMILION,
}
_CURVE_POINTS = 801


def comparison_figure(run: TurntableRun) -> Figure:
    """Draw all comparisons minus the mean of the accepted ones, and their RMS at each angle.

    The RMS is drawn before and after the rejection of outliers.
    """
    series = run.series
    angle = np.degrees(series.angle)
    off = series.from_mean / ARCSEC
    spread = np.linspace(-0.12, 0.12, series.repeats) * np.degrees(series.step)
    positions = angle[:, None] + spread
    keep = series.keep
    figure = svg.new_figure(5.2)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    top.plot(positions[keep], off[keep], ".", color=svg.BLUE, ms=3.5, label=f"accepted, {np.sum(keep)}")
    rejected = series.excluded_comparisons
    top.plot(positions[rejected], off[rejected], "x", color=svg.VERMILION, ms=5.5, label=f"rejected, {series.rejected}")
    top.set(title="Comparisons minus the mean of those accepted at their angle", ylabel="arcsec")
    top.margins(y=0.18)
    top.legend(loc="upper right", ncols=2)
    bottom.plot(angle, series.rms_before / ARCSEC, "o-", color=svg.GREY, ms=3.5, lw=0.9, label="all repeats")
    bottom.plot(
        angle, series.rms_after / ARCSEC, "o-", color=svg.BLUE, ms=3.5, lw=0.9, label="after Chauvenet's criterion"
    )
    bottom.axhline(series.averaging_alone / ARCSEC, color=svg.INK, lw=0.8, ls="--", label="averaging alone, largest")
    bottom.set(title="RMS of single comparisons", ylabel="arcsec", xlabel="reading of the table [deg]")
    bottom.set_ylim(0.0, 1.35 * float(np.max(series.rms_before)) / ARCSEC)
    bottom.legend(loc="upper right", ncols=3)
    for axes in (top, bottom):
        svg.gridded(axes)
    return figure


def curve_figure(run: TurntableRun) -> Figure:
    """Draw the measured dividing error with the chosen fit and, for a simulated table, the true curve."""
    series, held = run.series, run.held_out
    chosen = run.choice.chosen
    at = np.linspace(*run.compensation.region, _CURVE_POINTS)
    figure = svg.new_figure(3.6)
    axes = figure.subplots()
    if run.model is not None:
        axes.plot(np.degrees(at), _slow_truth(run.model, at) / ARCSEC, color=svg.INK, lw=2.4, alpha=0.35, label="truth")
    fitted = np.where(covered(series.angle, at), run.fits[chosen](at) / ARCSEC, np.nan)
    axes.plot(np.degrees(at), fitted, color=COLOURS[chosen], lw=1.1, label=f"chosen fit: {FIT_NAMES[chosen]}")
    for points, mark, colour, label in ((series, "o", svg.INK, "calibrated"), (held, "s", svg.VERMILION, "held out")):
        if points is None:
            continue
        axes.errorbar(
            np.degrees(points.angle),
            points.mean / ARCSEC,
            points.sigma / ARCSEC,
            fmt=mark,
            color=colour,
            mfc="white" if points is held else colour,
            ms=3.5,
            lw=0.8,
            capsize=1.5,
            label=f"{label}, mean ± σ",
        )
    axes.set(title="Dividing error, reading − true angle", ylabel="arcsec", xlabel="reading of the table [deg]")
    axes.margins(x=0.01, y=0.12)
    axes.legend(loc="best", ncols=2)
    svg.gridded(axes)
    return figure


def residual_figure(run: TurntableRun) -> Figure:
    """Draw the held-out points minus each fit of the dividing error, best fit first.

    For a simulated table the true curve minus the fit is drawn too.
    """
    at = np.linspace(*run.compensation.region, _CURVE_POINTS)
    held = run.held_out
    assert held is not None
    truth = None if run.model is None else _slow_truth(run.model, at)
    most = 1.15 * max(float(np.max(np.abs(run.held_out_residual(name)))) for name in run.ranking) / ARCSEC
    figure = svg.new_figure(1.35 * len(run.ranking) + 0.5)
    panels = np.atleast_1d(figure.subplots(len(run.ranking), 1, sharex=True, sharey=True))
    for name, axes in zip(run.ranking, panels, strict=True):
        fit = run.fits[name]
        residual = run.held_out_residual(name)
        axes.axhline(0.0, color=svg.GREY, lw=0.7)
        if truth is not None:
            axes.plot(np.degrees(at), (truth - fit(at)) / ARCSEC, color=COLOURS[name], lw=1.3)
        axes.errorbar(
            np.degrees(held.angle),
            residual / ARCSEC,
            held.sigma / ARCSEC,
            fmt="s",
            color=svg.INK,
            mfc="white",
            ms=3,
            lw=0.7,
        )
        rms = float(np.sqrt(np.mean(residual**2))) / ARCSEC
        axes.set_title(f"{FIT_NAMES[name]}: {rms:.4f} arcsec RMS at the held-out readings", loc="left")
        axes.set_ylabel("arcsec")
        axes.set_ylim(-most, most)
    panels[-1].set_xlabel("reading of the table [deg]")
    panels[-1].margins(x=0.01)
    for axes in panels:
        svg.gridded(axes)
    return figure


def _slow_truth(model: TurntableModel, at: np.ndarray) -> np.ndarray:
    """Return the true dividing error without the subdivision error, whose period is too short for a plot."""
    error = model.error
    return error(at) - error.parts["subdivision"](at)


def _readings(run: TurntableRun) -> str:
    """Describe the turntable readings that were compared with the reference: number, range and repeats."""
    series = run.series
    first, last = np.degrees(run.compensation.region)
    least, most = int(np.min(series.counts)), int(np.max(series.counts))
    repeats = f"{most}" if least == most else f"{least} to {most}"
    return (
        f"{first:.6g} deg to {last:.6g} deg, {np.degrees(series.step):.4g} deg apart in the median: "
        f"{len(series.angle)} readings, {repeats} repeats"
    )


def _comparison(run: TurntableRun, result: Mapping[str, Any]) -> Section:
    """Return the section on the comparisons of turntable readings with the reference."""
    series = run.series
    text = [
        f"Chauvenet's criterion rejects {series.rejected} of {np.sum(series.taken)} comparisons. By chance it would "
        f"reject {result['rejected_expected_by_chance']:.0f} on average if all were good: it trims normal noise, and "
        "the RMS that remains is that of trimmed readings, for which the σ of one comparison is corrected."
    ]
    if result["suspect_angles"]:
        text.append(
            f"At {result['suspect_angles']} of the angles the accepted repeats scatter more than their number allows: "
            "gross errors that mask each other. Those angles get the sigma of their own repeats; measure them again."
        )
    figure = SvgFigure(
        "turntable-comparisons",
        "Comparisons with the reference",
        "Above, all repeats; below, their RMS at each angle, and the largest RMS of the mean of all repeats.",
        svg.drawn("turntable-comparisons", comparison_figure, run),
    )
    return Section("Regional comparison of the turntable", tuple(text), (figure,))


def _fits(run: TurntableRun, result: Mapping[str, Any]) -> Section:
    """Return the section on the functions fitted to the dividing error."""
    fits, chosen, held, model = result["fits"], result["chosen"], run.held_out, run.model
    best = result["ranking"][0]
    ranking_text = (
        "ranked by cross-validation: there are no held-out readings, so that an error with a period below the step "
        "is not detected"
        if held is None
        else f"ranked at {len(held.angle)} held-out readings, measured in a separate series with "
        f"σ = {result['heldout_arcsec_sigma']:.4f} arcsec each"
    )
    held_out_text = (
        ""
        if held is None
        else f"; its RMS residual at the held-out readings is {fits[chosen]['heldout_rms_arcsec']:.4f} arcsec"
    )
    text = [
        f"Fits of the means, {ranking_text}. Cross-validation on the calibration points alone chooses the "
        f"{FIT_NAMES[chosen]}{held_out_text}."
        + ("" if held is None or best == chosen else f" The {FIT_NAMES[best]} has the smallest residual there.")
    ]
    text += [f"The {FIT_NAMES[name]} failed: {failure}." for name, failure in result["failed"].items()]
    drawn = "the chosen fit" if model is None else "the chosen fit and the true curve without its subdivision error"
    artefacts: list[Artefact] = [
        SvgFigure(
            "turntable-curve",
            "Dividing error",
            f"Means with their sigmas (the scatter of the repeats and the reference), {drawn}.",
            svg.drawn("turntable-curve", curve_figure, run),
        )
    ]
    if held is not None:
        note = "Squares: held-out readings minus the fit, with the sigma of the measurement."
        note += "" if model is None else " Lines: true curve without subdivision error minus the fit."
        artefacts.append(
            SvgFigure(
                "turntable-residuals",
                "Residuals of the fits",
                note,
                svg.drawn("turntable-residuals", residual_figure, run),
            )
        )
    artefacts += [_ranking(result), _left(run, result)]
    rejected = result.get("rejected_readings")
    if rejected:
        artefacts.append(rejected_table(turntable_run.REJECTED, "turntable-rejected", "Comparisons", rejected))
    return Section("Fits of the dividing error", tuple(text), tuple(artefacts), folded=1 if rejected else 0)


def rejected_table(record: Record[Any], name: str, what: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of rows that Chauvenet's criterion rejects, with the lines of their files."""
    note, shown = "Difference from the mean of the accepted ones.", [{**r, "file": Path(r["file"]).name} for r in rows]
    return record.table(name, f"{what} that Chauvenet's criterion rejects", note, shown)


def _ranking(result: Mapping[str, Any]) -> Table:
    """Return the table of the RMS residuals of all fits, the best first.

    For a simulated table it also has their true errors.
    """
    fits, truth = result["fits"], result.get("truth")
    keys = ["heldout_rms_arcsec", "train_rms_arcsec", "cross_validation_rms_arcsec", "effective_parameters"]
    note = "RMS, the best fit first."
    if truth is not None:
        note += (
            " The last two columns use the true curve, which no test in a laboratory has: over the whole region and "
            "all phases of the signal, and without a constant, which differences of angles do not show."
        )
        fits = {name: {**fit, **truth["fits"][name]} for name, fit in fits.items()}
        keys += [quantity.key for quantity in turntable_run.TRUE_FIT]
    rows = {FIT_NAMES[name]: fits[name] for name in result["ranking"]}
    return Record("A fit.", *turntable_run.FIT, *turntable_run.TRUE_FIT).table(
        "turntable-fits", "The fits", note, rows, keys, "fit"
    )


def _noise(run: TurntableRun) -> float:
    """Return the sigma of a compensated angle due to noise of the calibration, RMS over the readings, arcsec."""
    return float(np.sqrt(np.mean(np.diag(run.compensation.fit.covariance(run.series.angle))))) / ARCSEC


def _left(run: TurntableRun, result: Mapping[str, Any]) -> Table:
    """Return the table of the error that remains in an angle after compensation."""
    noise = "noise of the calibration, mean over its readings [arcsec]", DecimalNumber(_noise(run), 4)
    lines = [noise, *turntable_run.COMPENSATION.lines(result["compensation"])]
    title = "Remaining error of a compensated angle"
    return Table("turntable-sigma", title, "Without the repeatability of one comparison.", ("part", "σ"), lines)


def turntable_report(run: TurntableRun) -> Report:
    """Return the report of a turntable test: dividing error, fits, remaining error, figures and tables."""
    data, spec = TURNTABLE(run), run.spec
    chosen, parts, truth = data["chosen"], data["compensation"], data.get("truth")
    sigma = float(np.sqrt(np.mean(run.compensation.sigma(run.series.angle) ** 2))) / ARCSEC
    names = {"common": "an offset common to all readings", "smooth": "the misfit between the calibrated points"}
    names["white"] = "errors independent from reading to reading"
    size = {name: parts[f"{part}_arcsec"] for part, name in names.items()}
    size["the noise of the calibration"] = _noise(run)
    limit = max(size, key=lambda name: size[name])
    span = float(np.ptp(run.series.mean)) / ARCSEC
    missed = data["fits"][chosen]["heldout_rms_arcsec"]
    missed_text = "" if missed is None else f", with errors of {missed:.3f} arcsec RMS at held-out angles"
    missed_text += (
        "" if truth is None else f" and true errors of {truth['fits'][chosen]['true_rms_arcsec']:.3f} arcsec RMS"
    )
    verdict, more = answer(
        f"The dividing error spans {span:.2f} arcsec",
        f"the {FIT_NAMES[chosen]} compensates it to σ = {sigma:.3f} arcsec{missed_text}, limited by {limit}",
        f"repeats scatter by {data['repeatability_arcsec']:.3f} arcsec",
        f"{data['rejected']} of {int(np.sum(run.series.taken))} comparisons were rejected, "
        f"{data['rejected_expected_by_chance']:.0f} expected by chance: see the remaining error of a compensated angle",
    )
    judged_key = "cross_validation_rms_arcsec" if run.held_out is None else "heldout_rms_arcsec"
    by = "by cross-validation" if run.held_out is None else "on held-out angles"
    keys = ("repeat_rms_arcsec", "chauvenet_rms_arcsec", "averaging_alone_rms_arcsec", "mean_rms_arcsec")
    rows = [
        *TURNTABLE.lines(data, (*keys, "repeatability_arcsec")),
        ("compensated angle, σ, RMS over the readings [arcsec]", DecimalNumber(sigma, 3)),
    ]
    for name in data["ranking"]:
        head = f"{FIT_NAMES[name]} {by}{', chosen' if name == chosen else ''} [arcsec]"
        rows.append((head, DecimalNumber(data["fits"][name][judged_key], 3)))
    certified = spec.measured.reference if isinstance(spec, MeasuredTurntableSpec) else spec.reference.calibration
    return Report(
        "Dividing error of the turntable",
        verdict,
        more,
        (
            ("Calibration", _readings(run)),
            ("Reference", f"σ = {format_quantity(certified, ANGLE)} at each position, by its certificate"),
            *(("File", f"{file['file']}, {file['rows']} rows") for file in data.get("files", ())),
            ("Description", spec.description),
        ),
        Table("dividing-error", "Result", f"Fits in the order of their RMS {by}.", ("", "RMS"), rows),
        (_comparison(run, data), _fits(run, data)),
        warnings=_warnings(run, data),
    )


def _warnings(run: TurntableRun, data: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings about the measurements and the fits of the dividing error."""
    warnings = []
    if run.too_few:
        warnings.append(f"too few angles for: {', '.join(FIT_NAMES[name] for name in run.too_few)}")
    if run.held_out is None:
        warnings.append(
            "no held-out readings: the sigmas do not include errors with a period below the step, as the subdivision "
            "error"
        )
    elif (tail := float(chi2.sf(data["heldout_chi_square"], data["heldout_degrees_of_freedom"]))) < DOUBTFUL:
        warnings.append(
            "held-out readings scatter more than the compensation's covariance: chi-square "
            f"{data['heldout_chi_square']:.0f} "
            f"for {data['heldout_degrees_of_freedom']} degrees of freedom, p = {tail:.2g}"
        )
    if len(holes := np.degrees(gaps(run.series.angle))):
        arcs = ", ".join(f"{first:.9g} to {last:.9g} deg" for first, last in holes)
        warnings.append(f"the calibration has gaps in which no reading is compensated: {arcs}")
    warnings += [doubt for table in run.tables for doubt in table.file.doubts]
    if data["suspect_angles"]:
        warnings.append(
            f"angles whose accepted repeats scatter more than their number allows: {data['suspect_angles']}"
        )
    return tuple(warnings)
