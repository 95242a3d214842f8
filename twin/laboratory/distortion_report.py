"""Report of a distortion test: the main table, figures, sections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.spots.centroid import mean_frames
from analysis.units import ARCSEC
from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.laboratory.distortion_numbers import distortion_numbers
from twin.laboratory.distortion_run import DistortionRun, MeasuredDistortion, SimulatedDistortion, rms
from twin.laboratory.turntable_report import FIT_NAMES
from twin.run.artefact import FAR, Cell, OwnDecimals, SvgFigure, Table, decimals_for
from twin.run.data_files import FrameFacts
from twin.run.report import Report, Section, one_sentence
from twin.run.svg import BLUE, GREY, INK, LIGHT, ORANGE, VERMILION, look, new_figure, plain_axes, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RAW, COMPENSATED = "angles as read", "compensated angles"


def curve_svg(run: SimulatedDistortion) -> str:
    """Distortion over the field, and its error against the truth."""
    with look("distortion-curve"):
        figure = new_figure(6.4)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1.0))
        field = np.degrees(run.compensated.fit.angle)
        above.plot(field, 1e6 * run.true_distortion, color=INK, lw=1.0, label="exact chief rays")
        for measured, name, colour, marker, shift in (
            (run.raw, RAW, ORANGE, "s", -0.005),
            (run.compensated, COMPENSATED, BLUE, "o", 0.005),
        ):
            style = {"fmt": marker, "color": colour, "ms": 3.5, "lw": 0.8, "label": name}
            above.errorbar(field + shift, 1e6 * measured.distortion, 1e6 * measured.sigma, **style)
            below.errorbar(field + shift, 1e6 * run.error(measured), 1e6 * measured.sigma, **style)
        below.axhline(0.0, color=GREY, lw=0.8)
        above.set_title("Distortion D = L − c − f tan W + p tan² W", loc="left")
        below.set_title("Measured − true", loc="left")
        below.set_xlabel("field angle W [deg]")
        for axes in (above, below):
            axes.set_ylabel("µm")
            dress(axes)
        return to_svg(figure)


def points_svg(run: SimulatedDistortion) -> str:
    """Each point's error and its departure from a smooth curve, raw and compensated."""
    with look("distortion-points"):
        figure = new_figure(4.6)
        both = run.raw, run.compensated
        panels = {
            "Error of the distortion against the truth": [1e6 * np.abs(run.error(one)) for one in both],
            "Distance from the smooth curve": [1e6 * np.abs(one.smooth.residual) for one in both],
        }
        every = figure.subplots(len(panels), 1)
        for axes, (title, (raw, compensated)) in zip(every, panels.items(), strict=True):
            number = np.arange(1, len(raw) + 1)
            axes.bar(number - 0.2, raw, 0.4, color=ORANGE, label=f"{RAW}, rms {_rms(raw):.2f} µm")
            axes.bar(number + 0.2, compensated, 0.4, color=BLUE, label=f"{COMPENSATED}, rms {_rms(compensated):.2f} µm")
            axes.set_title(title, loc="left")
            axes.set_ylabel("µm")
            axes.set_xlim(0.0, len(raw) + 1.0)
            dress(axes)
        every[-1].set_xlabel("point")
        return to_svg(figure)


def spot_svg(run: SimulatedDistortion) -> str:
    """The spot in the middle of the field, and the row through its centre."""
    with look("distortion-spot"):
        figure = new_figure(3.6)
        picture, profile = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
        point = len(run.record.column) // 2
        image = mean_frames(run.record.frames[point, 0])
        pitch = run.bench.ccd.band.pitch
        column = run.spots.position[point, 0] + run.bench.design_offset[point]
        column = column / pitch + run.bench.middle_column - run.record.column[point, 0]
        row = run.spots.row[point, 0]
        shown = picture.imshow(image, cmap="gray", interpolation="nearest", origin="upper")
        picture.plot(column, row, "+", color=VERMILION, ms=12, mew=1.4)
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        radius = run.bench.radius
        picture.plot(column + radius * np.cos(angle), row + radius * np.sin(angle), color=BLUE, lw=0.9)
        picture.set(xlabel="column, along the line", ylabel="row, along the track")
        figure.colorbar(shown, ax=picture, label="DN")
        values = image[round(row)]
        profile.step(np.arange(len(values)), values, where="mid", color=BLUE, lw=1.0, label="row through the centre")
        profile.axvline(column, color=VERMILION, lw=0.9, label="energy centroid")
        profile.set(xlabel="column", ylabel="DN")
        dress(profile, columns=1)
        return to_svg(figure)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def dress(axes: Axes, columns: int = 3) -> None:
    """A light grid, a legend and room for it; columns: of the legend."""
    low, high = axes.get_ylim()
    # room for the legend above the data
    axes.set_ylim(low, high + 0.18 * (high - low))
    axes.grid(axis="y", color=LIGHT, lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper right" if columns == 1 else "upper center", ncols=columns)
    plain_axes(axes)


Array = NDArray[np.float64]
SHOWN = 3
"""Points whose frames are kept: first, middle, last."""


def distortion_report(run: DistortionRun) -> Report:
    """Report of a distortion test."""
    if isinstance(run, MeasuredDistortion):
        from twin.laboratory.distortion_measured_report import measured_distortion_report

        return measured_distortion_report(run)
    assert isinstance(run, SimulatedDistortion)
    data = distortion_numbers(run)
    truth, test = data["truth"], run.setup.test
    fit = run.compensated.fit
    count, sets = run.record.reading.shape
    numbers = np.linspace(0, count - 1, SHOWN).astype(int)
    width = run.bench.images.width
    facts = FrameFacts(f"{test.camera}, line CCD {test.band}", run.bench.ccd.band.pitch, note="spot of the pinhole")
    return Report(
        title="Interior orientation and distortion",
        verdict=_verdict(data, truth),
        lead=(typeset(fit.point.statement),),
        facts=(
            ("camera", f"{test.camera}, band {test.band}"),
            (
                "points, sets",
                f"{count} over ±{np.degrees(run.bench.turn[-1]):.3f}°, {sets} sets of {test.frames} frames",
            ),
            (
                "pinhole",
                f"{format_quantity(test.pinhole, LENGTH)} in a collimator of "
                f"{format_quantity(test.collimator.focal_length, LENGTH)}: {width:.1f} pixels in the image",
            ),
            ("turntable", f"{run.setup.turntable.name}, dividing error by {FIT_NAMES[run.compensation.fit.name]}"),
            (
                "spots along the track",
                f"over {truth['row_smile_um']:.0f} µm: smile of the mapping and tilt of the axis",
            ),
        ),
        summary=_summary(data),
        sections=(_curve(run), _compensation(run), joint_section(data["joint"]), _estimates(run), _noise(run, data)),
        images=FrozenMap({f"spot-{i + 1:02d}": run.record.frames[i, 0] for i in numbers}),
        image_facts=FrozenMap({f"spot-{i + 1:02d}": facts for i in numbers}),
        warnings=_warnings(run),
    )


def _verdict(data: Mapping[str, Any], truth: Mapping[str, Any]) -> str:
    found, sigma = data["principal_distance_mm"], data["principal_distance_mm_sigma"]
    ratio = abs(found - truth["principal_distance_mm"]) / sigma
    well = "within" if ratio <= FAR else "outside"
    with_it, without = truth["error_rms_compensated_um"], truth["error_rms_raw_um"]
    gain = "compensating them helps" if with_it < without else "compensating them does not help"
    return one_sentence(
        f"The balanced principal distance is {found:.3f} ± {sigma:.3f} mm, {well} {FAR:g} σ of the truth "
        f"({truth['principal_distance_mm']:.3f} mm, {ratio:.1f} σ)",
        f"distortion is measured to {with_it:.2f} µm rms with compensated angles and {without:.2f} µm with angles as "
        f"read: {gain}, see the curve and the compensation",
    )


def typeset(text: str) -> str:
    """A statement of the analysis, which is plain ASCII, as the report and the terminal show it."""
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


def _warnings(run: SimulatedDistortion) -> tuple[str, ...]:
    out = []
    kept = int(np.sum(run.truth.gross & run.means.keep))
    if kept:
        out.append(f"gross errors that Chauvenet's criterion does not find and that stay in the means: {kept}")
    left = run.bench.true_offset - run.bench.design_offset
    slope = float(np.polyfit(np.tan(run.bench.turn), left, 1)[0])
    sigma = run.compensated.fit.sigma("principal_distance")
    if abs(slope) > 0.5 * sigma:
        out.append(
            "as-built coma that grows over the field moves energy centroids against chief rays and f by "
            f"{1e6 * slope:.0f} µm, which no sigma holds ({1e6 * sigma:.0f} µm): measure the wavefront at several "
            "fields"
        )
    return tuple(out)


def _summary(data: Mapping[str, Any]) -> Table:
    truth = data["truth"]
    rows: list[tuple[Cell, ...]] = [
        (
            "balanced principal distance [mm]",
            # six digits, which tables show of a number, are too few here
            f"{data['principal_distance_mm']:.4f}",
            data["principal_distance_mm_sigma"],
            f"{truth['principal_distance_mm']:.4f}",
        ),
        (
            "principal point [mm]",
            data["principal_point_mm"],
            data["principal_point_mm_sigma"],
            truth["principal_point_mm"],
        ),
        ("correlation of the two", data["correlation"], None, None),
        ("residual of smooth model, raw angles [µm rms]", data["rms_raw_um"], None, None),
        ("residual of smooth model, compensated [µm rms]", data["rms_compensated_um"], None, None),
        ("error of distortion, raw angles [µm rms]", truth["error_rms_raw_um"], None, None),
        ("error of distortion, compensated [µm rms]", truth["error_rms_compensated_um"], None, None),
    ]
    caption = (
        "f and p with compensated angles, by least squares with a constant, which is the unknown zero of the angles. "
        "Balanced: the f that leaves the smallest distortion over the points; with a radial term use the joint model."
    )
    return Table("distortion-result", "Result", caption, ("", "measured", "sigma", "truth"), rows, (None, 3, 3, 3))


def _curve(run: SimulatedDistortion) -> Section:
    own = run.compensated
    ratio = rms(run.error(own) / own.sigma)
    text = (
        "D is what is left of the spots' places after a constant, f tan W and p tan² W, measured and true alike. "
        "Error bars hold the scatter of the sets, the covariance of the turntable's calibration (compensated angles "
        "only) and what the points scatter about a smooth curve beyond that. With angles as read the long waves of "
        "the dividing error pass for distortion, and no error bar knows of them.",
        f"The errors are {ratio:.2f} sigma rms with compensated angles, "
        f"{rms(run.error(run.raw) / run.raw.sigma):.2f} with angles as read.",
    )
    figure = SvgFigure(
        "distortion-curve",
        "Distortion over the field",
        "Above: measured with sigma, and by exact chief rays of the as-built camera. Below: the error.",
        curve_svg(run),
    )
    return Section("Distortion", text, (figure,))


def _compensation(run: SimulatedDistortion) -> Section:
    raw, own = run.raw, run.compensated
    pairs: tuple[tuple[str, Array, Array], ...] = (
        ("error of the distortion (needs the truth)", 1e6 * run.error(raw), 1e6 * run.error(own)),
        ("distance from the smooth curve", 1e6 * raw.smooth.residual, 1e6 * own.smooth.residual),
        ("RMS of distortion over the sets", 1e6 * raw.rms_over_sets, 1e6 * own.rms_over_sets),
    )
    rows: list[tuple[Cell, ...]] = [
        (name, a, b, 100.0 * (1.0 - b / a), float(np.max(np.abs(first))), float(np.max(np.abs(second))))
        for name, first, second in pairs
        for a, b in ((rms(first), rms(second)),)
    ]
    text = (
        "How much an RMS falls with compensated angles depends on what else is in it. That of the distortion itself "
        "holds the design's distortion, which a dividing error may even cancel in part, so that it can rise. The "
        "distance from a smooth curve does not see the long waves of the dividing error. Only the error against the "
        "truth tells what compensation brings. It differs from table to table: the constant, f and p take up what is "
        "longer than the field.",
    )
    table = Table(
        "distortion-reduction",
        "What compensation brings",
        "RMS over the points, and the largest.",
        ("quantity", "raw [µm]", "compensated [µm]", "reduction [%]", "largest raw [µm]", "largest compensated [µm]"),
        rows,
        (None, 2, 2, 0, 1, 1),
    )
    figure = SvgFigure(
        "distortion-points",
        "Point by point",
        "Without the design's distortion.",
        points_svg(run),
    )
    return Section("Raw and compensated angles", text, (figure, table))


ESTIMATES = {
    "eq2": "(2): f and p",
    "eq3": "(3): balanced f, p = 0",
    "eq4": "(4): p, with balanced f of (3)",
    "eq2_zero_from_constant": "(2), W counted from the fitted zero",
    "constant": "constant, balanced f, p (taken)",
    "constant_radial3": "constant, f, p, radial (joint)",
}
"""Estimate -> what it is, for readers."""


def joint_section(joint: Mapping[str, Any]) -> Section:
    """The terms of one model that belong together, as they reproduce the spots and as a payload's file has them.

    Args:
        joint: of distortion.json.
    """
    text = (
        "With a radial term f is the slope in the middle of the field; the balanced f, which leaves the smallest "
        "distortion without such a term, is another. Terms of one table belong together: the f of one with the radial "
        "term of the other would miss the spots at the edge by more than half of the radial distortion there.",
    )

    def table(name: str, title: str, caption: str, part: Mapping[str, Any], suffix: str, shown: list[str]) -> Table:
        size, sigma = np.array(part[f"values{suffix}"]), np.array(part[f"sigma{suffix}"])
        spread = np.array(part["covariance_mm2" if suffix else "covariance"]) / np.outer(sigma, sigma)
        rows: list[tuple[Cell, ...]] = [
            (label, *(OwnDecimals(v, decimals_for(own)) for v in (value, own)), *(float(v) for v in row))
            for label, value, own, row in zip(shown, size, sigma, spread, strict=True)
        ]
        heads = ("", "measured", "sigma", *(f"correlation: {label.split(' [')[0]}" for label in shown))
        return Table(name, title, caption, heads, rows, (None, None, None, *(3 for _ in shown)))

    names = [f"{name.replace('_', ' ')} [mm]" for name in joint["terms"]]
    line = ["axis [arcsec]", "focal_length f [mm]", "principal_point y0 [mm]", "k1 [1/m²]"]
    return Section(
        "Joint model",
        text,
        (
            table("distortion-joint", "Joint model", f"{typeset(joint['model'])}.", joint, "_mm", names),
            table(
                "distortion-line",
                "The same as a line of a payload's file",
                "tan θ = (y − y0) (1 + k1 (y − y0)²) / f from the camera's Z, which stands at `axis` from the zero of "
                "the angles; focal_length, principal_point: [0 mm, y0] and k1 with the signs of a payload's file.",
                joint["line"],
                "",
                line,
            ),
        ),
    )


def _estimates(run: SimulatedDistortion) -> Section:
    mm = 1e3
    rows: list[tuple[Cell, ...]] = [
        (
            ESTIMATES[name],
            mm * e.f,
            None if e.f_sigma is None else mm * e.f_sigma,
            mm * (e.f - e.f_true),
            mm * e.p,
            None if e.p_sigma is None else mm * e.p_sigma,
            mm * (e.p - e.p_true),
            1e6 * e.error,
        )
        for name, e in run.estimates.items()
    ]
    zero = (run.compensated.zero - run.truth.zero) / ARCSEC
    text = (
        "Equations (1) to (4) (Li et al., doi 10.3788/IRLA20200143) have no constant: W has to count exactly from the "
        "direction that is imaged to the line's middle. The middle was put on the pinhole to "
        f"{run.truth.zero / ARCSEC:.2f} arcsec, and the compensation at that reading has an error of its own. (2) "
        "turns such an offset into a principal point, (3) leaves it in the distortion of every point. The constant "
        f"finds it: {run.compensated.zero / ARCSEC:.2f} arcsec, "
        f"{zero:+.3f} arcsec from the truth.",
        "With a radial term f is another quantity, the slope in the middle of the field, and not the slope that "
        "leaves the smallest distortion: the two differ by definition, and the error is counted against each one's "
        "own truth.",
        typeset(run.compensated.fit.point.statement),
    )
    estimates = Table(
        "distortion-estimates",
        "Equations (1) to (4) and fits with a constant",
        "All with compensated angles. Errors are against the same estimate from exact chief rays at the true angles.",
        (
            *("estimate", "f [mm]", "sigma of f [mm]", "error of f [mm]"),
            *("p [mm]", "sigma of p [mm]", "error of p [mm]", "error of D [µm rms]"),
        ),
        rows,
        (None, 4, 3, 3, 2, 2, 2, 2),
    )
    return Section("Estimators and what can be observed", text, (estimates,))


def _noise(run: SimulatedDistortion, data: Mapping[str, Any]) -> Section:
    noise, truth = data["noise"], data["truth"]
    plan = run.setup.turntable.dividing_error
    about = run.compensated.fit.value("principal_distance")
    text = (
        f"One exposure scatters by {noise['exposure_um']:.2f} µm between the sets; the table's repeatability, "
        f"{format_quantity(plan.repeatability, ANGLE)}, makes {1e6 * about * plan.repeatability:.2f} µm of it and "
        f"noise of the frames {noise['centroid_um']:.3f} µm. Chauvenet's criterion takes out {noise['rejected']} of "
        f"{run.record.reading.size} exposures, {noise['rejected_expected_of_good']:.0f} of them expected without any "
        f"gross error; {truth['gross_errors']} had one.",
        f"Differences of the line's columns move a spot by {noise['centroid_columns_um']:.3f} µm; every row of a TDI "
        "line sees the same columns.",
        f"Beyond this, points scatter by {noise['white_compensated_um']:.2f} µm about a smooth curve "
        f"({noise['white_raw_um']:.2f} µm with angles as read): the subdivision error, which the calibration's steps "
        "cannot see.",
    )
    figure = SvgFigure(
        "distortion-spot",
        "A spot, enlarged",
        "Mean of the frames of one exposure in the middle of the field; the cross is the energy centroid, the "
        "circle its window.",
        spot_svg(run),
    )
    return Section("Spots and noise", text, (figure,))
