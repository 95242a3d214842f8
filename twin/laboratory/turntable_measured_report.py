"""Report of a turntable test on measured readings: what was found, how well, and what limits it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from analysis.units import ARCSEC
from scenes.yaml.units import ANGLE, format_quantity
from twin.laboratory.turntable_numbers import turntable_numbers
from twin.laboratory.turntable_report import FIT_NAMES, comparison_section, figure_svg
from twin.laboratory.turntable_run import MeasuredTurntable, TurntableRun
from twin.run.artefact import Artefact, SvgFigure, Table, fixed
from twin.run.report import Report, Section, one_sentence

DOUBTFUL = 1e-3
"""Chance below which a chi-square is told as a warning."""


def _readings(run: TurntableRun) -> str:
    """The same of measured ones."""
    series = run.series
    first, last = np.degrees(run.compensation.region)
    least, most = int(np.min(series.counts)), int(np.max(series.counts))
    repeats = f"{most}" if least == most else f"{least} to {most}"
    return (
        f"{first:.6g} deg to {last:.6g} deg, {np.degrees(series.step):.4g} deg apart in the median: "
        f"{len(series.angle)} readings, {repeats} repeats"
    )


def _measured_fits(run: TurntableRun, result: Mapping[str, Any]) -> Section:
    """Fits of measured comparisons: nothing that only a truth could tell."""
    fits, chosen, held = result["fits"], result["chosen"], run.held_out
    judged = (
        "ranked by cross-validation: there are no held-out readings, so that an error with a period below the step "
        "stays unseen"
        if held is None
        else f"ranked at {len(held.angle)} held-out readings, measured in a series of their own with "
        f"σ = {result['heldout_sigma_arcsec']:.4f} arcsec each"
    )
    text = [
        f"Fits of the means, {judged}. Cross-validation on the calibration points alone chooses the "
        f"{FIT_NAMES[chosen]}.",
        "A compensated angle keeps an error, the same whenever its reading comes back: the noise of the calibration "
        "that the fit passes on, and three misfits beyond it. The repeatability of a reading in use comes "
        "on top and averages out.",
    ]
    text += [f"The {FIT_NAMES[name]} failed: {failure}." for name, failure in result["failed"].items()]
    rows = [
        (
            rank,
            FIT_NAMES[name],
            fits[name]["heldout_rms_arcsec"],
            fits[name]["train_rms_arcsec"],
            fits[name]["cross_validation_rms_arcsec"],
            fits[name]["effective_parameters"],
        )
        for rank, name in enumerate(result["ranking"], 1)
    ]
    heads = ("rank", "fit", "held out", "training points", "cross-validation", "effective parameters")
    parts = result["compensation"]
    noise = float(np.sqrt(np.mean(np.diag(run.compensation.fit.covariance(run.series.angle))))) / ARCSEC
    left = Table(
        "turntable-sigma",
        "What is left of a compensated angle, σ",
        "Noise: of the calibration, mean over its readings. Common: a constant, which no difference sees. "
        "Smooth: along the curve over one step. White: new from reading to reading, as the subdivision error is.",
        ("part", "arcsec"),
        (
            ("noise of the calibration", noise),
            ("common", parts["common_arcsec"]),
            ("smooth", parts["smooth_arcsec"]),
            ("white", parts["white_arcsec"]),
            ("repeatability of one comparison, not in it", result["repeatability_arcsec"]),
        ),
        (None, 4),
    )
    judgement = [
        (
            f"chosen fit at {len(run.series.angle)} calibrated readings, sigmas of the means",
            result["fit_chi_square"],
            result["fit_degrees_of_freedom"],
        )
    ]
    if held is not None:
        text_ = f"at {len(held.angle)} held-out readings, all that the compensation states"
        judgement.append((text_, result["heldout_chi_square"], result["heldout_degrees_of_freedom"]))
    artefacts: list[Artefact] = [
        SvgFigure(
            "turntable-curve",
            "Dividing error",
            "Means with their sigmas (the scatter of the repeats and the reference) and the chosen fit.",
            figure_svg("curve", run),
        ),
        Table("turntable-fits", "The fits", "RMS, arcsec.", heads, rows, (None, None, 4, 4, 4, 1)),
        left,
        Table(
            "turntable-chi-square",
            "Chi-square",
            "Far above the degrees of freedom, the fit misses more than noise; the misfits stand for it.",
            ("of", "chi-square", "degrees of freedom"),
            judgement,
            (None, 1, 1),
        ),
    ]
    if held is not None:
        note = "Held-out readings minus the fit, with the sigma of the measurement."
        artefacts.insert(1, SvgFigure("turntable-residuals", "What the fits miss", note, figure_svg("residuals", run)))
    gone = result["rejected_readings"]
    if gone:
        lines = [(Path(one["file"]).name, one["line"], one["reading_deg"], one["from_mean_arcsec"]) for one in gone]
        artefacts.append(
            Table(
                "turntable-rejected",
                "Comparisons that Chauvenet's criterion takes out",
                "Difference from the mean of those that stay.",
                ("file", "line", "reading [deg]", "from the mean [arcsec]"),
                lines,
                (None, None, 6, 3),
            )
        )
    return Section("Fits of the dividing error", tuple(text), tuple(artefacts), folded=1 if gone else 0)


def measured_turntable_report(run: MeasuredTurntable) -> Report:
    """Report of measured readings."""
    data = turntable_numbers(run)
    chosen, parts = data["chosen"], data["compensation"]
    sigma = float(np.sqrt(np.mean(run.compensation.sigma(run.series.angle) ** 2))) / ARCSEC
    names = {"common": "an offset common to all readings", "smooth": "what the fit misses between its points"}
    names["white"] = "what changes from reading to reading"
    size = {part: parts[f"{part}_arcsec"] for part in names}
    noise = float(np.sqrt(np.mean(np.diag(run.compensation.fit.covariance(run.series.angle))))) / ARCSEC
    worst = max(size, key=lambda part: size[part])
    limit = names[worst] if size[worst] > noise else "the noise of the calibration"
    span = float(np.ptp(run.series.mean)) / ARCSEC
    missed = data["fits"][chosen]["heldout_rms_arcsec"]
    judged = "" if missed is None else f" and misses held-out angles by {missed:.3f} arcsec RMS"
    verdict = one_sentence(
        f"The dividing error spans {span:.2f} arcsec; the {FIT_NAMES[chosen]} compensates it to σ = {sigma:.3f} arcsec"
        f"{judged}, limited by {limit}",
        f"repeats scatter by {data['repeatability_arcsec']:.3f} arcsec, {data['rejected']} of "
        f"{int(np.sum(run.series.taken))} comparisons rejected where "
        f"{data['rejected_expected_of_good']:.0f} are expected of good ones, see what is left of a compensated angle",
    )
    rows = [
        ("repeats, largest RMS of an angle", fixed(data["repeat_rms_arcsec"], 3)),
        ("the same after Chauvenet's criterion", fixed(data["chauvenet_rms_arcsec"], 3)),
        ("one comparison, σ of all angles together", fixed(data["repeatability_arcsec"], 3)),
        ("compensated angle, σ, mean over the readings", fixed(sigma, 3)),
    ]
    key = "cross_validation_rms_arcsec" if run.held_out is None else "heldout_rms_arcsec"
    by = "by cross-validation" if run.held_out is None else "on held-out angles"
    rows += [
        (f"{FIT_NAMES[name]} {by}{', chosen' if name == chosen else ''}", fixed(data["fits"][name][key], 3))
        for name in data["ranking"]
    ]
    warnings = []
    if run.too_few:
        few = ", ".join(FIT_NAMES[name] for name in run.too_few)
        warnings.append(f"too few angles for: {few}")
    if run.held_out is None:
        warnings.append(
            "no held-out readings: an error with a period below the step, as the subdivision error, is in no sigma here"
        )
    elif (tail := float(chi2.sf(data["heldout_chi_square"], data["heldout_degrees_of_freedom"]))) < DOUBTFUL:
        warnings.append(
            f"held-out readings scatter more than the compensation states: chi-square {data['heldout_chi_square']:.0f} "
            f"for {data['heldout_degrees_of_freedom']} degrees of freedom, by chance once in {1.0 / tail:.0f}"
        )
    if data["suspect_angles"]:
        warnings.append(f"angles whose kept repeats scatter more than their number allows: {data['suspect_angles']}")
    return Report(
        "Dividing error of the turntable",
        verdict,
        (),
        (
            ("Calibration", _readings(run)),
            ("Reference", f"its certificate: {format_quantity(run.spec.measured.reference, ANGLE)} at each position"),
            *(("File", f"{one['file']}, {one['rows']} rows") for one in data["files"]),
            ("Description", run.spec.description),
        ),
        Table("dividing-error", "Result", f"Fits in the order of their RMS {by}.", ("RMS", "arcsec"), rows),
        (comparison_section(run, data, _readings(run)), _measured_fits(run, data)),
        warnings=tuple(warnings),
    )
