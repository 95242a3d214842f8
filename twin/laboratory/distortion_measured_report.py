"""Report of a distortion test on measured angles and spots: what was found, how well, and what limits it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from analysis.orientation.distortion_model import design
from analysis.orientation.interior import gain
from analysis.units import ARCSEC
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.laboratory.distortion_numbers import distortion_numbers
from twin.laboratory.distortion_report import ESTIMATES, dress, joint_section, typeset
from twin.laboratory.distortion_run import MeasuredDistortion
from twin.laboratory.turntable_report import DOUBTFUL, FIT_NAMES
from twin.run.artefact import Artefact, Cell, SvgFigure, Table
from twin.run.report import Report, Section, one_sentence
from twin.run.svg import BLUE, GREY, ORANGE, look, new_figure, to_svg

ZERO_SHARE = 0.3
"""Of sigma of the principal point: a zero of the angles that moves it by more is told."""


def measured_distortion_report(run: MeasuredDistortion) -> Report:
    """Report of a measured distortion test."""
    data = distortion_numbers(run)
    spec, files = run.spec, run.spec.measured
    count, sets = run.reading.shape
    first, last = np.degrees([np.min(run.compensated.fit.angle), np.max(run.compensated.fit.angle)])
    angles = (
        f"as read, each good to {format_quantity(files.angle_sigma or 0.0, ANGLE)}"
        if run.compensation is None
        else f"compensated by {FIT_NAMES[run.compensation.fit.name]} of the turntable's calibration"
    )
    return Report(
        title="Interior orientation and distortion",
        verdict=_verdict(run, data),
        lead=(typeset(run.compensated.fit.point.statement),),
        facts=(
            ("points, sets", f"{count} from {first:.3f}° to {last:.3f}°, {sets} sets, {np.sum(run.present)} spots"),
            ("angles", f"{angles}; the line's middle is imaged at {format_quantity(files.zero, ANGLE)}"),
            ("focal length, about", format_quantity(spec.focal_length, LENGTH)),
            *(("file", f"{one['file']}, {one['rows']} rows") for one in data["files"]),
            ("description", spec.description),
        ),
        summary=_summary(run, data),
        sections=(_curve(run, data), joint_section(data["joint"]), _estimates(run, data), _noise(run, data)),
        warnings=_warnings(run, data),
    )


def _limit(run: MeasuredDistortion) -> str:
    """What makes most of the principal distance's sigma."""
    fit = run.compensated.fit
    k = fit.terms.index("principal_distance")
    parts = _shares(run)
    name = max(parts, key=lambda one: parts[one])
    share = parts[name] / fit.covariance[k, k]
    return f"{name}, {100.0 * share:.0f} % of its variance"


def _shares(run: MeasuredDistortion) -> dict[str, float]:
    """Variance of the principal distance by its causes, square metres."""
    fit, means = run.compensated.fit, run.means
    k = fit.terms.index("principal_distance")
    row = gain(design(fit.angle, fit.terms))[k]
    angles = fit.noise - np.diag(np.hypot(means.sigma, run.compensated.white) ** 2)
    return {
        "the scatter between the sets": float(row**2 @ means.sigma**2),
        "the angles' covariance": float(row @ angles @ row),
        "what points scatter about a smooth curve": float(np.sum(row**2) * run.compensated.white**2),
    }


def _verdict(run: MeasuredDistortion, data: Mapping[str, Any]) -> str:
    noise, f, sigma = data["noise"], data["principal_distance_mm"], data["principal_distance_mm_sigma"]
    expected = noise["rejected_expected_of_good"]
    known = 1e6 * float(np.sqrt(np.mean(run.compensated.sigma**2)))
    return one_sentence(
        f"The balanced principal distance is {f:.4f} ± {sigma:.4f} mm, limited by {_limit(run)}",
        f"distortion is known to {known:.2f} µm, and points lie within {data['rms_compensated_um']:.2f} µm rms of a "
        "smooth curve",
        f"chi-square {data['chi_square']:.1f} for {data['degrees_of_freedom']} degrees of freedom with stated noise, "
        f"{noise['rejected']} of {int(np.sum(run.present))} spots rejected where {expected:.0f} are expected of good "
        "ones, see the noise",
    )


def _warnings(run: MeasuredDistortion, data: Mapping[str, Any]) -> tuple[str, ...]:
    out = []
    fit = run.compensated.fit
    moved = abs(fit.value("constant"))
    if moved > ZERO_SHARE * fit.sigma("principal_point"):
        sense = -1.0 if run.spec.measured.reversed else 1.0
        zero = run.spec.measured.zero + sense * run.compensated.zero
        out.append(
            f"the line's middle is imaged {run.compensated.zero / ARCSEC:.3g} arcsec from `zero`, which moves the "
            f"principal point by {1e3 * moved:.3g} mm and is in no sigma: with zero: {np.degrees(zero):.9f} deg it is "
            "gone"
        )
    f = fit.value("principal_distance")
    if abs(f / run.spec.focal_length - 1.0) > 0.05:
        out.append(
            f"the principal distance is {f:.4g} m, but `focal_length` says {run.spec.focal_length:.4g} m: are the "
            "units of angles and places right?"
        )
    if data["probability"] < DOUBTFUL:
        out.append(
            "the points scatter about a smooth curve more than the stated noise allows; the excess, "
            f"{data['noise']['white_compensated_um']:.2f} µm, is in all sigmas as if it were independent from point to "
            "point"
        )
    if run.compensation is None:
        out.append(
            "no calibration of the turntable: a dividing error with long waves passes for distortion, and no sigma "
            "holds it but `angle_sigma`"
        )
    return tuple(out)


def _summary(run: MeasuredDistortion, data: Mapping[str, Any]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (
            "balanced principal distance [mm]",
            f"{data['principal_distance_mm']:.4f}",
            data["principal_distance_mm_sigma"],
        ),
        ("principal point [mm]", f"{data['principal_point_mm']:.3f}", data["principal_point_mm_sigma"]),
        ("correlation of the two", f"{data['correlation']:.3f}", None),
        ("radial term of the joint model [mm]", f"{data['radial3_mm']:.3f}", data["radial3_mm_sigma"]),
        ("residual of smooth model [µm rms]", f"{data['rms_compensated_um']:.3f}", None),
    ]
    if run.compensation is not None:
        rows.append(("residual of smooth model, angles as read [µm rms]", f"{data['rms_raw_um']:.3f}", None))
    rows.append(("chi-square of the smooth model", f"{data['chi_square']:.1f}", None))
    rows.append(("degrees of freedom", f"{data['degrees_of_freedom']}", None))
    caption = (
        "f and p by least squares with a constant, which is the unknown zero of the angles. Balanced: the f that "
        "leaves the smallest distortion over the points; with the radial term use the joint model."
    )
    return Table("distortion-result", "Result", caption, ("", "measured", "sigma"), rows, (None, 3, 4))


def curve_svg(run: MeasuredDistortion) -> str:
    """Distortion over the field, and what is left of a smooth curve."""
    with look("distortion-curve"):
        figure = new_figure(6.0)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1.0))
        own = run.compensated
        field = np.degrees(own.fit.angle)
        series = [(run.raw, "angles as read", ORANGE, "s"), (own, "compensated angles", BLUE, "o")]
        for one, name, colour, marker in series if run.compensation is not None else series[:1]:
            style = {"fmt": marker, "color": colour, "ms": 3.5, "lw": 0.8, "label": name}
            above.errorbar(field, 1e6 * one.distortion, 1e6 * one.sigma, **style)
            below.errorbar(field, 1e6 * one.smooth.residual, 1e6 * one.means.sigma, **style)
        below.axhline(0.0, color=GREY, lw=0.8)
        above.set_title("Distortion D = L − c − f tan W + p tan² W, with its total sigma", loc="left")
        below.set_title("Distance from the smooth curve, with the sigma of the sets", loc="left")
        below.set_xlabel("field angle W [deg]")
        for axes in (above, below):
            axes.set_ylabel("µm")
            dress(axes)
        return to_svg(figure)


def _curve(run: MeasuredDistortion, data: Mapping[str, Any]) -> Section:
    text = (
        "D is what is left of the spots' places after a constant, f tan W and p tan² W. Its sigma holds the scatter of "
        "the sets, the stated errors of the angles with their covariance, and what the points scatter about a smooth "
        "curve beyond that. It does not hold what moves every centroid alike at one place of the field, as coma does.",
    )
    points: list[tuple[Cell, ...]] = [
        (
            one["point"],
            one["reading_deg"],
            one["field_deg"],
            one["position_mm"],
            one["distortion_compensated_um"],
            one["sigma_um"],
            one["residual_compensated_um"],
            one["sets_kept"],
        )
        for one in data["points"]
    ]
    heads = ("point", "reading [deg]", "W [deg]", "L [mm]", "D [µm]", "sigma [µm]", "from smooth [µm]", "sets kept")
    artefacts: tuple[Artefact, ...] = (
        SvgFigure("distortion-curve", "Distortion over the field", "Means of the sets.", curve_svg(run)),
        Table(
            "distortion-points", "Point by point", "Means of the sets kept.", heads, points, (None, 5, 5, 4, 2, 2, 2)
        ),
    )
    return Section("Distortion", text, artefacts, folded=1)


def _estimates(run: MeasuredDistortion, data: Mapping[str, Any]) -> Section:
    rows: list[tuple[Cell, ...]] = [
        (
            ESTIMATES[name],
            one["principal_distance_mm"],
            one["principal_distance_mm_sigma"],
            one["principal_point_mm"],
            one["principal_point_mm_sigma"],
            one["distortion_rms_um"],
        )
        for name, one in data["estimates"].items()
    ]
    heads = ("estimate", "f [mm]", "sigma of f [mm]", "p [mm]", "sigma of p [mm]", "D [µm rms]")
    terms = data["covariance_terms"]
    covariance: list[tuple[Cell, ...]] = [
        (name.replace("_", " "), *(float(value) for value in row))
        for name, row in zip(terms, data["covariance_mm2"], strict=True)
    ]
    text = (
        "Equations (1) to (4) (Li et al., doi 10.3788/IRLA20200143) have no constant: W has to count exactly from the "
        f"direction that is imaged to the line's middle. The constant finds it "
        f"{run.compensated.zero / ARCSEC:.3f} arcsec from the zero that was given.",
        typeset(run.compensated.fit.point.statement),
    )
    return Section(
        "Estimators and what can be observed",
        text,
        (
            Table(
                "distortion-estimates",
                "Equations (1) to (4) and fits with a constant",
                "",
                heads,
                rows,
                (None, 4, 3, 3, 3, 2),
            ),
            Table(
                "distortion-covariance",
                "Covariance of constant, f and p",
                "Square millimetres, all noise that is stated and found.",
                ("", *(name.replace("_", " ") for name in terms)),
                covariance,
            ),
        ),
    )


def _noise(run: MeasuredDistortion, data: Mapping[str, Any]) -> Section:
    noise = data["noise"]
    stated = data["stated_exposure_um"]
    text = [
        f"One spot scatters by {noise['exposure_um']:.3f} µm "
        + ("between the sets" if run.reading.shape[1] > 1 else "by its stated sigmas")
        + (f"; the table of spots states {stated:.3f} µm of it" if stated > 0.0 else "")
        + f". Beyond what is stated, points scatter by {noise['white_compensated_um']:.3f} µm about a smooth curve.",
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
            "Standard deviation by cause; their squares add up.",
            ("cause", "sigma of f [mm]", "share of variance [%]"),
            rows,
            (None, 4, 1),
        )
    ]
    gone = [*data["rejected_readings"], *data["rejected_comparisons"]]
    if gone:
        lines: list[tuple[Cell, ...]] = [
            (
                Path(one["file"]).name,
                one["line"],
                one["reading_deg"],
                f"{one['from_mean_um']:+.3f} µm" if "from_mean_um" in one else f"{one['from_mean_arcsec']:+.3f} arcsec",
            )
            for one in gone
        ]
        artefacts.append(
            Table(
                "distortion-rejected",
                "Readings that Chauvenet's criterion takes out",
                "Difference from the mean of those that stay.",
                ("file", "line", "reading [deg]", "from the mean"),
                lines,
                (None, None, 6),
            )
        )
    return Section("Noise, and what was rejected", tuple(text), tuple(artefacts), folded=1 if gone else 0)
