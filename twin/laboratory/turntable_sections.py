"""What a laboratory report says of the turntable test."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from analysis.units import ARCSEC
from scenes.units import ANGLE, format_quantity
from twin.artefact import SvgFigure, Table
from twin.laboratory.printed_004 import CHAUVENET_RMS_ARCSEC, FIT_RMS_ARCSEC, REPEAT_RMS_ARCSEC
from twin.laboratory.turntable import TurntableRun
from twin.laboratory.turntable_figure import FIT_NAMES, drawn
from twin.trial.section import Section


def sections(run: TurntableRun) -> tuple[Section, ...]:
    """Comparison, and fits."""
    result = run.to_dict()
    return _comparison(run, result), _fits(run, result)


def _comparison(run: TurntableRun, result: Mapping[str, Any]) -> Section:
    series, plan = run.series, run.spec.calibration
    region = f"{format_quantity(plan.first, ANGLE)} to {format_quantity(plan.last, ANGLE)}"
    text = [
        f"The dividing error is the table's reading minus its true angle. It is compared with a polygon and an "
        f"autocollimator from {region} in steps of {format_quantity(plan.step, ANGLE)}: {plan.count} readings, "
        f"{plan.repeats} repeats.",
        f"Chauvenet's criterion rejects {series.rejected} of {series.comparisons.size} comparisons. It would reject "
        f"{result['rejected_expected_of_good']:.0f} on average if all were good: it trims normal noise, and the RMS "
        f"that remains is that of trimmed readings. All angles together, corrected for this, one comparison has "
        f"σ = {result['repeatability_arcsec']:.4f}″.",
        "The paper's 0.037″ is the RMS of the single readings that were kept. It is not an RMS of their mean: "
        "averaging alone would give the mean 0.081″/√10 = 0.026″ at worst, with the gross errors in it.",
    ]
    if result["suspect_angles"]:
        text.append(
            f"At {result['suspect_angles']} of the angles the kept repeats scatter more than their number allows: "
            "gross errors that hide each other. Those angles are given the sigma of their own repeats; "
            "measure them again."
        )
    paper = {"repeat_rms_arcsec": REPEAT_RMS_ARCSEC, "chauvenet_rms_arcsec": CHAUVENET_RMS_ARCSEC}
    names = {
        "repeat_rms_arcsec": "repeats, as read",
        "chauvenet_rms_arcsec": "repeats, after Chauvenet's criterion",
        "averaging_alone_rms_arcsec": "mean of all repeats, nothing rejected",
        "mean_rms_arcsec": "mean of the kept repeats",
    }
    rows = [(text_, result[key], paper.get(key)) for key, text_ in names.items()]
    table = Table(
        "turntable-repeats",
        "Repeats: the largest RMS of any angle",
        "The paper prints no RMS of a mean.",
        ("RMS of", "here, arcsec", "paper 004, arcsec"),
        rows,
        (None, 3, 3),
    )
    figure = SvgFigure(
        "turntable-comparisons",
        "Comparisons with the reference",
        "Above, all repeats; below, their RMS at each angle, and what the mean of all repeats would have at worst.",
        drawn("comparisons", run),
    )
    return Section("Regional comparison of the turntable", tuple(text), (figure, table))


def _fits(run: TurntableRun, result: Mapping[str, Any]) -> Section:
    fits, truth = result["fits"], result["truth"]["fits"]
    chosen, best = result["chosen"], result["ranking"][0]
    held = fits[chosen]["heldout_rms_arcsec"]
    subdivision = run.spec.dividing_error.subdivision
    periods = run.spec.calibration.step / subdivision.period
    text = [
        f"Five fits of the means, ranked at {len(run.held_out.angle)} held-out readings in the middle of the steps, "
        f"measured in a series of their own with σ = {result['heldout_sigma_arcsec']:.4f}″ each. Cross-validation "
        f"on the calibration points alone chooses the {FIT_NAMES[chosen]}; it has {held:.4f}″ at the held-out "
        f"readings, {'below' if held < FIT_RMS_ARCSEC else 'not below'} the paper's {FIT_RMS_ARCSEC}″."
        + ("" if best == chosen else f" There the {FIT_NAMES[best]} is the best.")
    ]
    if abs(periods - round(periods)) < 1e-6:
        text.append(
            f"A step of the calibration is {round(periods)} whole periods of the grating's signal "
            f"({subdivision.period / ARCSEC:.4g}″), so that all calibration points lie at one phase and cannot see the "
            "subdivision error. The held-out readings lie at all phases, as the readings in use do: what no fit can "
            "follow is in their residuals."
        )
    for name, failure in result["failed"].items():
        text.append(f"The {FIT_NAMES[name]} failed: {failure}.")
    rows = [
        (
            rank,
            FIT_NAMES[name],
            fits[name]["heldout_rms_arcsec"],
            fits[name]["train_rms_arcsec"],
            fits[name]["cross_validation_rms_arcsec"],
            fits[name]["effective_parameters"],
            truth[name]["true_rms_arcsec"],
            truth[name]["true_spread_arcsec"],
        )
        for rank, name in enumerate(result["ranking"], 1)
    ]
    heads = ("rank", "fit", "held out", "training points", "cross-validation", "effective parameters")
    table = Table(
        "turntable-fits",
        "The five fits, ranked at the held-out readings",
        "RMS, arcsec. The last two columns use the true curve, which no test in a laboratory has: over the whole "
        "region and all phases of the signal, and the same without a constant, which differences of angles do not see.",
        (*heads, "truth", "truth, no constant"),
        rows,
        (None, None, 4, 4, 4, 1, 4, 4),
    )
    curve = SvgFigure(
        "turntable-curve",
        "Dividing error",
        "Means with their sigmas (the scatter of the repeats and the reference), the chosen fit and the true curve "
        "without its subdivision error.",
        drawn("curve", run),
    )
    residuals = SvgFigure(
        "turntable-residuals",
        "What the fits miss",
        "Squares: held-out readings minus the fit, with the sigma of the measurement. Lines: true curve without "
        "subdivision error minus the fit.",
        drawn("residuals", run),
    )
    return Section("Fits of the dividing error", tuple(text), (curve, residuals, table))
