"""Figures, tables and data of the range studies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.monitoring import MonitorGeometry
from twin.run.artefact import SYMBOLS, Cell
from twin.run.svg import BLUE, GREEN, GREY, INK, LIGHT, ORANGE, PURPLE, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.group import Context
from twin.validation.paper_001.ranges import turns
from twin.validation.paper_001.ranges.curves import CALIBRATED, CORRECTED, FORMS, JOINT, PRINTED, Curves
from twin.validation.paper_001.ranges.defocus import CONFOCAL, SMALL, FieldPoint, PupilStudy, Response

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {PRINTED: VERMILION, JOINT: ORANGE, CORRECTED: BLUE, CALIBRATED: GREEN}
_MARKS = {PRINTED: "o", JOINT: "D", CORRECTED: "s", CALIBRATED: "^"}
_OF_PARAMETER = {"d_alpha": VERMILION, "d_beta": BLUE, "d_gamma": GREEN, "d_f": PURPLE}
_ORDER = ("d_beta", "d_alpha", "d_gamma", "d_f")


def _scale(name: str) -> tuple[float, str]:
    return (1e-3, "mm") if name == "d_f" else (1.0, "arcsec")


def _thinned(points: np.ndarray) -> np.ndarray:
    """Points (N, 2) without those that nearly coincide with the one before."""
    kept = [0]
    for i in range(1, len(points)):
        if points[i, 0] > 1.25 * points[kept[-1], 0]:
            kept.append(i)
    return points[kept]


def singles_svg(ranges: Mapping[str, Sequence[turns.Range]]) -> str:
    """A panel per parameter: error over the true change, both on logarithmic axes."""
    with look("ranges-001-singles"):
        figure = new_figure(7.4)
        panels = figure.subplots(2, 2).ravel()
        for axes, name in zip(panels, _ORDER, strict=True):
            both = ranges[name]
            per, unit = _scale(name)
            first = both[0]
            low, high = first.raw[PRINTED][0, 0] * per, first.lost * per
            axes.axvspan(0.85 * low, min(r.window for r in both) * per, color=LIGHT, alpha=0.55, lw=0)
            grid = np.array([low, high])
            axes.plot(grid, 0.01 * grid, "--", color=GREY, lw=1.0)
            axes.axhline(turns.FINE[name] * per, color=INK, lw=1.0, ls=":")
            if turns.CLAIMED[name] != turns.FINE[name]:
                axes.axhline(turns.CLAIMED[name] * per, color=INK, lw=1.0, ls="-.")
            shown = [PRINTED, JOINT] if name == "d_f" else [PRINTED, CORRECTED]
            for form in shown:
                marks = _thinned(first.raw[form]) * per
                line = np.concatenate([first.raw[form], first.raw_traced[form]]) * per
                axes.plot(line[:, 0], np.abs(line[:, 1]), "-", color=_COLOURS[form], lw=1.0)
                label = f"printed {turns.EQUATIONS[name]}" if form == PRINTED else form
                if name == "d_f" and form == PRINTED:
                    label += ", the same as corrected"
                axes.plot(marks[:, 0], np.abs(marks[:, 1]), _MARKS[form], color=_COLOURS[form], ms=4.5, label=label)
            _log(axes)
            axes.set_xlim(0.85 * low, 1.02 * high)
            axes.set_ylim(0.3 * np.min(np.abs(first.raw[CORRECTED][:, 1])) * per, None)
            axes.plot([], [], "--", color=GREY, lw=1.0, label="1 %")
            axes.plot([], [], ":", color=INK, lw=1.0, label="0.04 mm" if name == "d_f" else "0.1 arcsec")
            if turns.CLAIMED[name] != turns.FINE[name]:
                axes.plot([], [], "-.", color=INK, lw=1.0, label="2.15 arcsec")
            axes.set_xlabel(f"true {SYMBOLS[name]} [{unit}]")
            axes.set_ylabel(f"|error| [{unit}]")
            axes.legend(loc="upper left", ncols=2)
        return to_svg(figure)


def joint_svg(corners: turns.Corners, forms: Sequence[str]) -> str:
    """A panel per parameter: worst corner as a share of the claim over the share of the box."""
    with look("ranges-001-joint"):
        figure = new_figure(6.2)
        panels = figure.subplots(2, 2, sharex=True).ravel()
        for axes, name in zip(panels, _ORDER, strict=True):
            axes.axhline(1.0, color=INK, lw=1.0, ls=":")
            axes.axvspan(float(corners.images.size[0]), 1.0, color=LIGHT, alpha=0.55, lw=0)
            for form in forms:
                of = turns.key(form, name)
                size = np.concatenate([corners.images.size, corners.traced.size])
                value = np.concatenate([corners.images.value[of], corners.traced.value[of]])
                axes.plot(size, value, "-", color=_COLOURS[form], lw=1.0)
                marks = _thinned(np.column_stack([corners.images.size, corners.images.value[of]]))
                axes.plot(marks[:, 0], marks[:, 1], _MARKS[form], color=_COLOURS[form], ms=4.5, label=form)
            _log(axes)
            axes.set_xlim(float(corners.images.size[0]), corners.lost * 1.02)
            limit = f"{turns.CLAIMED[name] * _scale(name)[0]:g} {_scale(name)[1]}"
            axes.set_ylabel(f"worst error of {SYMBOLS[name]} / {limit}")
        for axes in panels[2:]:
            axes.set_xlabel(f"size of the box, times {turns.BOX_TEXT}")
        panels[0].legend(loc="lower right")
        return to_svg(figure)


def defocus_svg(pupil: PupilStudy, curves: Curves, focal: tuple[float, float]) -> str:
    """False readings per piston over the pupil, and over the piston."""
    with look("ranges-001-defocus"):
        figure = new_figure(3.9)
        left, right = figure.subplots(1, 2)
        grid = np.array([-0.3, 0.3])
        for axis, name, length, sign in ((0, "d_alpha", focal[0], -1.0), (1, "d_beta", focal[1], 1.0)):
            own = np.equal(pupil.offset[:, 1 - axis], 0.0)
            k = turns.NAMES.index(name)
            slope = 1e-6 * pupil.slope[own, k]
            colour = _OF_PARAMETER[name]
            left.plot(1e3 * grid, sign * 1e-6 * grid / length**2 / ARCSEC, "-", color=colour, lw=1.0)
            letter = "XY"[axis]
            left.plot(1e3 * pupil.offset[own, axis], slope, "o" if axis == 0 else "s", color=colour, ms=5.0,
                      label=f"{SYMBOLS[name]}, sub-aperture along {letter}")  # fmt: skip
        left.plot([], [], "-", color=GREY, lw=1.0, label="theory, ±h/f²")
        left.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
        left.set_xlabel("sub-aperture off the pupil's middle, h [mm]")
        left.set_ylabel("false reading [arcsec per µm of defocus]")
        left.legend(loc="upper center")
        plain_axes(left)
        right.axhline(1.0, color=INK, lw=1.0, ls=":")
        ends = {}
        for name in _ORDER:
            value = curves.value[f"{name} claimed"]
            right.plot(1e6 * curves.size, value, "o-", color=_OF_PARAMETER[name], ms=3.5, lw=1.0)
            ends[name] = float(value[-1])
        _log(right)
        for name, end in ends.items():
            place = 1e6 * float(curves.size[-1]), end
            right.annotate(SYMBOLS[name], place, xytext=(6, 0), textcoords="offset points",
                           color=_OF_PARAMETER[name], va="center")  # fmt: skip
        right.set_xlabel("motion of the line CCD along Z [µm]")
        right.set_ylabel("false reading / (0.1″, 2.15″, 0.04 mm)")
        return to_svg(figure)


def field_svg(points: Sequence[FieldPoint]) -> str:
    """Deviation of the readings' scale over the field."""
    with look("ranges-001-field"):
        figure = new_figure(3.2)
        axes = figure.subplots()
        field = np.array([p.field for p in points])
        fine = np.linspace(0.0, float(field.max()), 60)

        def gain(form: str, name: str) -> Any:
            return np.array([p.gains[form][turns.NAMES.index(name)] for p in points])

        base = float(gain(CORRECTED, "d_beta")[0])
        axes.plot(np.degrees(fine), 100 * (base * np.cos(fine) ** 2 - 1.0), "-", color=GREY, lw=1.0)
        axes.plot(
            np.degrees(field), 100 * (gain(PRINTED, "d_beta") - 1.0), "o", color=INK, ms=5.0, label="Δβ printed (2)"
        )
        for name, mark in (("d_beta", "s"), ("d_alpha", "^"), ("d_gamma", "D"), ("d_f", "v")):
            axes.plot(np.degrees(field), 100 * (gain(CORRECTED, name) - 1.0), f"{mark}-", color=_OF_PARAMETER[name],
                      ms=4.5, lw=0.8, label=f"{SYMBOLS[name]} corrected")  # fmt: skip
        axes.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
        axes.set_xlim(0.0, None)
        axes.set_xlabel("field of the area CCDs [deg]")
        axes.set_ylabel("reading / truth less 1 [%]")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        plain_axes(axes)
        return to_svg(figure)


def _log(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_axes(axes)


_GAIN_TEXT = "reading over truth"
_SHOWN = {"d_alpha": "arcsec", "d_beta": "arcsec", "d_gamma": "arcsec", "d_f": "mm"}
_PER = {"d_alpha": 1.0, "d_beta": 1.0, "d_gamma": 1.0, "d_f": 1e3}


def _signed(value: float) -> str:
    """Five decimals, with a minus sign and none before zero."""
    return f"{round(value, 5) + 0.0:.5f}".replace("-", "\N{MINUS SIGN}")


def fine_text(parameter: str) -> str:
    """The absolute limit in words."""
    return "0.04 mm" if parameter == "d_f" else "0.1″"


def limit_of(both: Sequence[turns.Range], form: str, kind: str) -> tuple[float, str]:
    """Limit in the worse of the two directions, table units, and whence it is known or what ends it."""
    return min(r.limit(turns.criterion(form, kind)) for r in both)


def limit_text(both: Sequence[turns.Range], form: str, kind: str, per: float) -> str:
    """The limit of `limit_of` in words."""
    size, whence = limit_of(both, form, kind)
    unit = "mm" if both[0].parameter == "d_f" else "″"
    if size == 0.0:
        return "nowhere"
    if whence not in ("images", "trace"):
        ended = {turns.CUT: "beam cut"}.get(whence, whence)
        return f"to {fixed_digits(size * per)} {unit} ({ended})".replace(" ″", "″")
    return f"to {fixed_digits(size * per)} {unit}".replace(" ″", "″")


def fixed_digits(value: float) -> str:
    """Four significant digits without an exponent."""
    return f"{value:.4g}" if value < 1e4 else f"{value:.0f}"


def causes_shown(
    context: Context,
    own: Mapping[str, list[turns.Range]],
    geometry: MonitorGeometry,
    local: float,
    data: dict[str, object],
) -> None:
    """What limits every formula by itself; ``local``: focal length along the line at its centre, metres."""
    f, f_x = geometry.principal_distance_m, geometry.principal_distance_across_m or geometry.principal_distance_m
    cos2 = math.cos(geometry.field_beta_rad) ** 2
    causes: tuple[tuple[str, str, float | None, str], ...] = (
        ("d_beta", PRINTED, cos2 * local / f - 1.0, "cos²β, which does not belong; f at the line's centre for f"),
        ("d_beta", CORRECTED, local / f - 1.0, "f of the whole line for f at its centre (distortion)"),
        ("d_alpha", PRINTED, f_x / f - 1.0, "f along the line for f across it (anamorphism)"),
        ("d_alpha", CORRECTED, None, "distortion between the line's centre and its ends"),
        ("d_gamma", PRINTED, 2.0 * f_x / f - 1.0, "doubling by the reflection left out; anamorphism"),
        ("d_gamma", CORRECTED, f / local * 1.0 - 1.0, "f of the whole line for f at its centre (distortion)"),
        ("d_f", PRINTED, None, "distortion: the spots are at the ends, Δf is of the whole line"),
        ("d_f", JOINT, -0.5, "half of (7)"),
    )
    rows: list[list[Cell]] = []
    listed = []
    for name, form, theory, text in causes:
        errors = own[name][0].raw[form]
        inside = errors[errors[:, 0] <= own[name][0].window]
        share = own[name][0].sign * inside[:, 1] / inside[:, 0]
        bend = float(np.ptp(share))
        rows.append(
            [SYMBOLS[name], form, f"{100 * share[-1]:.3f} %", "" if theory is None else f"{100 * theory:.3f} %",
             f"{100 * bend:.1e} %", text]
        )  # fmt: skip
        listed.append({"change": name, "form": form, "error_over_change": float(share[-1]), "theory": theory,
                       "bend_within_the_area_ccd": bend, "cause": text})  # fmt: skip
    data["causes"] = listed
    context.table(
        "causes",
        "What limits each formula, one change at a time",
        "Error over the change at the area CCD's edge, from images; what the named cause alone gives; and by how "
        "much the share changes from the smallest change to the edge: the formulas are wrong in scale, not bent.",
        ("change", "form", "measured", "by the cause", "bend", "cause"),
        rows,
    )


def singles_shown(
    context: Context, ranges: Mapping[str, Mapping[str, list[turns.Range]]], data: dict[str, object]
) -> None:
    """Domains of every formula by itself."""
    rows: list[list[Cell]] = []
    found: dict[str, object] = {}
    for instrument, own in ranges.items():
        of_instrument: dict[str, object] = {}
        for name in turns.NAMES:
            both = own[name]
            per, unit = (1e-3, "mm") if name == "d_f" else (1.0, "arcsec")
            window = min(r.window for r in both) * per
            lost = min(r.lost for r in both)
            entry: dict[str, object] = {f"area_ccd_ends_at_{unit}": window, f"beam_cut_at_{unit}": lost * per}
            for form in FORMS:
                cells = [limit_text(both, form, kind, per) for kind in turns.KINDS]
                if form in (PRINTED, CORRECTED) or (form == JOINT and name == "d_f"):
                    ends = [f"{fixed_digits(x)} {'mm' if name == 'd_f' else '″'}" for x in (window, lost * per)]
                    rows.append([instrument, SYMBOLS[name], form, *cells, *(x.replace(" ″", "″") for x in ends)])
                entry[form] = {
                    kind: {f"limit_{unit}": limit_of(both, form, kind)[0] * per, "by": limit_of(both, form, kind)[1]}
                    for kind in turns.KINDS
                }
            of_instrument[name] = entry
        found[instrument] = of_instrument
    data["single_changes"] = found
    context.table(
            "domains",
            "How far each formula holds, one change at a time",
            "The worse of the two directions. Printed: (2), (3), (5), (7). Corrected: f_x for Δα, half of Δγ times "
            "f/f_x, no cos²β, (7). Beam cut: an aperture begins to cut the monitor's beam. Claimed: 0.1″ of Δα and "
            "Δβ, 2.15″ of Δγ, 0.04 mm of Δf. Up to the end of the larger area CCD from images, from there by trace.",
            ("instrument", "change", "form", "within 1 %", "within 0.1″ or 0.04 mm", "within what is claimed",
             "area CCD ends at", "aperture cuts the beam at"),
            rows,
        )  # fmt: skip
    first = next(iter(ranges))
    context.figure(
        "domains-figure",
        f"Error of each formula over the size of the change, {first}",
        "Marks: noise-free rendered images through the centroid; lines: exact trace. Shaded: what the instrument's "
        "area CCDs can record. At the right end an aperture begins to cut the beam.",
        singles_svg(ranges[first]),
    )


def joint_shown(context: Context, corners: turns.Corners, found: turns.Separation, data: dict[str, object]) -> None:
    """All four at once."""
    rows: list[list[Cell]] = []
    for form in (JOINT, CORRECTED, CALIBRATED):
        for read in turns.NAMES:
            gains = [found.mean(form, read, changed)[0] * _PER[changed] / _PER[read] for changed in turns.NAMES]
            rows.append(
                [form, f"{SYMBOLS[read]} [{_SHOWN[read]}]", *(_signed(value) for value in gains),
                 corners.text(turns.key(form, read)), corners.text(turns.key(form, read, fine=True))]
            )  # fmt: skip
    heads = (
        "form", "reading", *(f"per {SYMBOLS[n]} [{_SHOWN[n]}]" for n in turns.NAMES), "box within the claim",
        "box within 0.1″ or 0.04 mm",
    )  # fmt: skip
    context.table(
        "joint",
        "All four changes at once",
        f"Readings of {found.trials} random states regressed on the true changes, mean of both cameras. Box: "
        f"how many times {turns.BOX_TEXT} may be taken until the error at any of its 16 corners passes the "
        "limit.",
        heads,
        rows,
    )
    data["all_at_once"] = {
        "box_half_widths": {f"{n}_{turns.UNITS[n]}": float(turns.BOX[k]) for k, n in enumerate(turns.NAMES)},
        "gain": {form: [[found.mean(form, r, c)[0] for c in turns.NAMES] for r in turns.NAMES] for form in FORMS},
        "gain_sigma": {form: [[found.mean(form, r, c)[1] for c in turns.NAMES] for r in turns.NAMES] for form in FORMS},
        "gain_units": [f"{turns.UNITS[r]} per {turns.UNITS[c]}" for r in turns.NAMES for c in turns.NAMES],
        "box_share": {name: {"limit": corners.limit(name)[0], "by": corners.limit(name)[1]}
                      for name in corners.images.value},
    }  # fmt: skip
    context.figure(
        "joint-figure",
        "All four changes at once: the worst of 16 corners over the size of the box",
        f"1 on the horizontal axis is {turns.BOX_TEXT}, which just keeps the spots on the area CCDs. Marks: "
        "images; lines: exact trace, until an aperture cuts a beam.",
        joint_svg(corners, (JOINT, CORRECTED, CALIBRATED)),
    )


def defocus_shown(
    context: Context,
    slope: np.ndarray,
    curves: Curves,
    constant: Mapping[float, Mapping[str, np.ndarray]],
    pupil: PupilStudy,
    focal: tuple[float, float],
    data: dict[str, object],
) -> None:
    """False readings by defocus; ``focal``: across and along the line, metres."""
    f_x, f = focal
    theory = {"d_alpha": (1.0 / f_x**2 / ARCSEC, None), "d_beta": (None, 1.0 / f**2 / ARCSEC)}
    rows: list[list[Cell]] = []
    listed: dict[str, object] = {}
    for k, name in enumerate(turns.NAMES):
        unit = turns.UNITS[name]
        limits = [curves.crossing(f"{name} {kind}") for kind in ("fine", "claimed")]
        gain_change = max(abs(g[CORRECTED][k] / constant[0.0][CORRECTED][k] - 1.0) for g in constant.values())
        cells: list[Cell] = [f"{1e-9 * pupil.gradient[k, axis]:.4g}" for axis in (0, 1)]
        expected = [t for t in theory.get(name, ()) if t is not None]
        rows.append(
            [f"{SYMBOLS[name]} [{unit}]", f"{1e-6 * slope[k]:.4g}", f"{abs(slope[k]) * CONFOCAL:.3g}",
             *(f"{1e6 * z:.0f} µm" if z else "> 4000 µm" for z in limits), *cells,
             f"{1e-9 * expected[0]:.4g}" if expected else "", f"{gain_change:.1e}"]
        )  # fmt: skip
        listed[name] = {
            f"false_{unit}_per_um": float(slope[k] * 1e-6),
            "piston_for_0.1_arcsec_or_0.04_mm_um": None if limits[0] is None else limits[0] * 1e6,
            "piston_for_claimed_um": None if limits[1] is None else limits[1] * 1e6,
            f"by_pupil_x_{unit}_per_um_per_mm": float(pupil.gradient[k, 0] * 1e-9),
            f"by_pupil_y_{unit}_per_um_per_mm": float(pupil.gradient[k, 1] * 1e-9),
            f"theory_{unit}_per_um_per_mm": expected[0] * 1e-9 if expected else None,
            "change_of_gain_in_a_defocused_camera": float(gain_change),
        }
    data["defocus"] = listed
    context.table(
            "defocus",
            "False readings by defocus between before and after",
            "Corrected factors, reading minus truth. Pupil: by how much the reading per µm changes for each mm by "
            "which the sub-aperture is off the pupil's middle; theory 1/f_x² and 1/f². Last column: change of the "
            f"reading of single changes ({SMALL['d_alpha']:g}″, {SMALL['d_beta']:g}″, {SMALL['d_gamma']:g}″, "
            f"{1e-3 * SMALL['d_f']:g} mm) in a camera that is out of focus by ±2λN² before and after.",
            ("reading", "per µm of piston", "at 40 µm", "0.1″ or 0.04 mm at", "claimed error at",
             "per µm and mm along X", "per µm and mm along Y", "theory, size", "gain, defocused"),
            rows,
        )  # fmt: skip
    context.figure(
        "defocus-figure",
        "Defocus and the place of the monitor's beam in the pupil",
        "Left: false Δα over the sub-aperture's X, false Δβ over its Y, images and theory z h/f². Right: false "
        "readings of the instrument as built over the motion of the line CCD along Z.",
        defocus_svg(pupil, curves, (f_x, f)),
    )


def field_shown(context: Context, points: Sequence[FieldPoint], data: dict[str, object]) -> None:
    """The area CCDs at other fields."""
    shown = ((PRINTED, "d_beta"), (CORRECTED, "d_beta"), (CORRECTED, "d_alpha"), (CORRECTED, "d_gamma"),
             (CORRECTED, "d_f"))  # fmt: skip
    rows: list[list[Cell]] = [
        [math.degrees(p.field), p.separation, *(float(p.gains[form][turns.NAMES.index(n)]) for form, n in shown),
         float(1e-6 * p.slope[turns.NAMES.index("d_alpha")]), float(1e-6 * p.slope[turns.NAMES.index("d_f")])]
        for p in points
    ]  # fmt: skip
    context.table(
            "field",
            "The area CCDs nearer to the middle of the line",
            f"The instrument built anew; {_GAIN_TEXT} of a single change each, and false readings by defocus.",
            ("field [deg]", "L [m]", *(f"{SYMBOLS[n]} {form}" for form, n in shown), "false Δα [arcsec/µm]",
             "false Δf [µm/µm]"),
            rows,
            (2, 4, 5, 5, 5, 5, 5, 6, 5),
        )  # fmt: skip
    context.figure(
        "field-figure",
        "Scale of the readings over the field of the area CCDs",
        "Reading over truth less one. Only the printed cos²β depends on the field: it follows cos²β (line), the "
        "corrected forms stay within 0.4 %.",
        field_svg(points),
    )
    data["field"] = [
        {"field_deg": math.degrees(p.field), "separation_m": p.separation,
         "reading_over_truth": {form: dict(zip(turns.NAMES, p.gains[form].tolist(), strict=True)) for form in FORMS},
         "false_d_alpha_arcsec_per_um": float(p.slope[0] * 1e-6), "false_d_f_um_per_um": float(p.slope[3] * 1e-6)}
        for p in points
    ]  # fmt: skip


def returns_shown(context: Context, found: Sequence[Response], data: dict[str, object]) -> None:
    """Kinds of return."""
    rows: list[list[Cell]] = [
        [r.kind, float(r.across.mean()), float(r.along.mean()), *(float(g) for g in r.gain), r.note] for r in found
    ]
    context.table(
        "returns",
        "Kinds of return",
        "Motion of the spots over that of the line CCD, and corrected readings over truth, by noise-free images.",
        ("return", "across the line", "along the line", *(f"{SYMBOLS[n]} read / true" for n in turns.NAMES), "remark"),
        rows,
        (None, 4, 4, 4, 4, 4, 4),
    )
    data["returns"] = {
        r.kind: {"spot_per_line_ccd_across": r.across.tolist(), "spot_per_line_ccd_along": r.along.tolist(),
                 "reading_over_truth": dict(zip(turns.NAMES, r.gain.tolist(), strict=True))}
        for r in found
    }  # fmt: skip
