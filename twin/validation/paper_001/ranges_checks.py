"""Checks of the validity ranges of the formulas of paper 001 (Wang et al. 2018), with figures, tables and data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.monitor.monitor_formulas import MonitorGeometry
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob, resolve_job
from twin.framework.artefact import SYMBOLS, Cell
from twin.framework.svg import BLUE, GREEN, GREY, INK, LIGHT, ORANGE, PURPLE, VERMILION
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of
from twin.validation.paper_001 import ranges
from twin.validation.paper_001.formulas import INSTRUMENT, focal_lengths
from twin.validation.paper_001.formulas import PARAMETERS as NAMES
from twin.validation.paper_001.ranges import CALIBRATED, CLAIMED, CORRECTED, FINE, FORMS, JOINT, PRINTED

OTHER = "gf7_pair"
"""Name of an instrument whose focal length differs from that implied by Table 5; it is used in full runs only."""
FIELDS = (1.0, 1.5, 2.0, 2.4, 2.72, 2.8)
"""Field angles of the area CCDs, degrees; at smaller ones the left and right prisms overlap."""
OFFSETS_X = (-0.28, -0.24, -0.12, 0.0, 0.12, 0.24, 0.28)
OFFSETS_Y = (-0.24, -0.12, 0.12, 0.24)
"""Offsets of the monitor's sub-aperture along Y, metres; the pupil's radius is 0.32 m."""
_BY_EQUATION = {"eq2": "d_beta", "eq3": "d_alpha", "eq5": "d_gamma", "eq7": "d_f"}
_ORDER = tuple(_BY_EQUATION.values())
_SINGLE = (*(f"001.{equation}.range" for equation in _BY_EQUATION), "001.small_angles.range")
_COLOURS = {PRINTED: VERMILION, JOINT: ORANGE, CORRECTED: BLUE, CALIBRATED: GREEN}
_MARKS = {PRINTED: "o", JOINT: "D", CORRECTED: "s", CALIBRATED: "^"}
_OF_PARAMETER = {"d_alpha": VERMILION, "d_beta": BLUE, "d_gamma": GREEN, "d_f": PURPLE}
Data = dict[str, Any]
"""Contents of the data file with all ranges, to which each part of the checks adds its own."""


def _shown(name: str) -> tuple[float, str, str]:
    """Return factor, unit and name with which changes of a parameter (arcsec or um) are shown."""
    return (1e-3, "mm", " mm") if name == "d_f" else (1.0, "arcsec", "″")


def _size(value: float, name: str) -> str:
    """Return a change in arcsec or um as text, with four digits and no exponent."""
    per, _, unit = _shown(name)
    value *= per
    return (f"{value:.4g}" if value < 1e4 else f"{value:.0f}") + unit


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of the ranges of validity."""
    resolved = resolve_job(JobSpec(instrument=INSTRUMENT))
    context.progress(0.0, f"build {INSTRUMENT}")
    camera = next(iter(resolved.instrument.cameras))
    bench = ranges.Bench(ranges.variant(resolved, context.backend, camera))
    data: Data = {}
    if any(i in context.selected for i in _SINGLE):
        yield from _singles(context, resolved, bench, data)
    if "001.eq2.range.field" in context.selected:
        yield _field(context, resolved, bench, data)
    if context.wants("001.table1"):
        yield from _joint(context, data)
    if any(i.endswith(".defocus") for i in context.selected):
        yield from _defocus(context, resolved, bench, data)
    if context.wants("001.returns"):
        yield from _returns(context, resolved, bench, data)
    context.data("ranges", data)


def ranges_of(
    context: Context, resolved: ResolvedJob, bench: ranges.Bench, begin: float, share: float
) -> dict[str, list[ranges.Range]]:
    """Return the ranges of validity of each parameter in both directions."""
    wide = ranges.Bench(
        ranges.variant(resolved, context.backend, bench.cameras[0], pixels=ranges.WIDE_PX), bench, shapes=True
    )
    out: dict[str, list[ranges.Range]] = {}
    for k, name in enumerate(NAMES):
        context.progress(begin + share * k / len(NAMES), f"{resolved.instrument.name}: follow {name} by itself")
        out[name] = [ranges.single_range(bench, wide, name, sign, context.count(9, 5)) for sign in (1, -1)]
    return out


def _singles(context: Context, resolved: ResolvedJob, bench: ranges.Bench, data: Data) -> Iterator[CheckResult]:
    ranges_by_instrument = {INSTRUMENT: ranges_of(context, resolved, bench, 0.02, 0.4 if context.fast else 0.2)}
    if not context.fast:
        other = resolve_job(JobSpec(instrument=OTHER))
        second = ranges.Bench(ranges.variant(other, context.backend, next(iter(other.instrument.cameras))))
        ranges_by_instrument[OTHER] = ranges_of(context, other, second, 0.22, 0.2)
    _show_singles(context, ranges_by_instrument, data)
    geometry = bench.geometry(bench.cameras[0])
    reference_ranges = ranges_by_instrument[INSTRUMENT]
    local = bench.experiment.instrument.cameras[bench.cameras[0]].line_principal_distance
    _show_causes(context, reference_ranges, geometry, local, data)
    for equation, name in _BY_EQUATION.items():
        yield _range(context, f"001.{equation}.range", reference_ranges[name], geometry)
    yield _small(context, reference_ranges)


def limit_of(both: Sequence[ranges.Range], form: str, kind: str) -> tuple[float, str]:
    """Return the smaller limit of the two directions, in arcsec or um, and its source or what ends it, as text."""
    return min(r.limit(ranges.criterion(form, kind)) for r in both)


def limit_text(both: Sequence[ranges.Range], form: str, kind: str) -> str:
    """Return the smaller limit of the two directions for a set of formulas, with its source, as text."""
    size, whence = limit_of(both, form, kind)
    if size == 0.0:
        return "nowhere"
    ended = "" if whence in ("images", "trace") else f" ({'beam cut' if whence == ranges.VIGNETTED else whence})"
    return f"to {_size(size, both[0].parameter)}{ended}"


def _range(context: Context, identifier: str, both: list[ranges.Range], geometry: MonitorGeometry) -> CheckResult:
    """Check the range of validity of the paper's formula for one parameter."""
    name = both[0].parameter
    per, _, unit = _shown(name)
    limit, whence = limit_of(both, PRINTED, "claimed")
    window = min(r.window for r in both) * per
    f, f_x = focal_lengths(geometry)
    share = {"d_alpha": f_x / f - 1.0, "d_gamma": 2.0 * f_x / f - 1.0}.get(name)
    lost, why = min((r.lost, r.lost_why) for r in both)
    facts: dict[str, Any] = {
        "images": sum(len(r.images.size) for r in both),
        "wide": ranges.WIDE_PX,
        "last": both[0].images.size[-1] * per,
        "unit": unit,
        "gap": max(r.trace_gap for r in both),
        "window": window,
        "edge": ranges.EDGE_PX,
        "lost": lost * per,
        "why": why,
        "whence": whence,
        "printed": limit_text(both, PRINTED, "1 %"),
        "best": {kind: limit_text(both, CORRECTED, kind) for kind in ranges.KINDS},
        "fine": "0.04 mm" if name == "d_f" else "0.1″",
        "f": f,
        "f_x": f_x,
        "error": 100.0 * (share or 0.0),
    }
    explained = [] if share is None else [CLAIMED[name] / share * per]
    return context.row(identifier, limit * per, None, window, explained, **facts)


def _small(context: Context, reference_ranges: Mapping[str, list[ranges.Range]]) -> CheckResult:
    worst, where = 0.0, ""
    for name in ("d_beta", "d_alpha", "d_gamma"):
        for r in reference_ranges[name]:
            true = r.raw[PRINTED][:, 0] * r.sign
            inside = r.raw[PRINTED][:, 0] <= r.window
            arctan, linear = (true + r.raw[form][:, 1] for form in (PRINTED, JOINT))
            share = float(np.max(np.abs(linear / arctan - 1.0)[inside]))
            if share >= worst:
                worst, where = share, f"{ranges.EQUATIONS[name]} at {r.window:.4g}″"
    facts: dict[str, Any] = {"where": where, "percent": math.sqrt(0.03), "tenth": (0.3 * ARCSEC) ** (1 / 3)}
    return context.row("001.small_angles.range", worst, implied=0.0, **facts)


def _field(context: Context, resolved: ResolvedJob, bench: ranges.Bench, data: Data) -> CheckResult:
    context.progress(0.45, "move the area CCDs along the line")
    fields = [math.radians(f) for f in (FIELDS if not context.fast else (FIELDS[0], FIELDS[-1]))]
    depth = ranges.depth_of_focus(resolved, bench.cameras[0])
    points = ranges.field_study(resolved, context.backend, bench.cameras[0], fields, depth)
    _show_field(context, points, data)
    first, last = points[0], points[-1]
    k = NAMES.index("d_beta")
    ratio, bare = (last.gains[form][k] / first.gains[form][k] for form in (PRINTED, CORRECTED))
    cos2 = (math.cos(last.field) / math.cos(first.field)) ** 2
    ends = {n: f"{first.gains[PRINTED][j]:.4f} and {last.gains[PRINTED][j]:.4f}" for j, n in enumerate(NAMES)}
    facts: dict[str, Any] = {"points": points, "first": first, "last": last, "bare": bare, "ends": ends}
    return context.row("001.eq2.range.field", ratio, None, 1.0, [cos2], **facts)


def _joint(context: Context, data: Data) -> Iterator[CheckResult]:
    context.progress(0.5, "change all four at once")
    experiment = context.experiment(INSTRUMENT)
    bench = ranges.Bench(experiment)
    corners = ranges.corners(bench, context.count(8, 4))
    trials = context.count(240, 40)
    context.progress(0.65, f"{trials} random changes with noise")
    separation = ranges.separation(experiment, bench, trials, context.seed)
    _show_joint(context, corners, separation, data)
    facts: dict[str, Any] = {"trials": trials, "box": ranges.BOX_TEXT, "bench": bench}
    explained = _box_limits(bench.geometry(bench.cameras[0]))
    for k, name in enumerate(NAMES):
        share, whence = corners.limit(ranges.key(JOINT, name))
        more: dict[str, Any] = {
            "images": 16 * len(corners.images.size),
            "whence": whence,
            "corrected": corners.text(ranges.key(CORRECTED, name)),
            "calibrated": corners.text(ranges.key(CALIBRATED, name)),
            "diagonal": [separation.mean(form, name, name)[0] for form in (JOINT, CORRECTED)],
            "scatter": separation.scatter[CORRECTED][k],
            "unit": " µm" if name == "d_f" else "″",
        }
        row = f"001.table1.range.{name}"
        yield context.row(row, share, None, 1.0, explained.get(name, ()), **facts, **more)
    facts["f_by_alpha"] = separation.mean(CORRECTED, "d_f", "d_alpha")[0]
    facts["gamma_by_beta"] = separation.mean(CORRECTED, "d_gamma", "d_beta")[0]
    for read, changed, scale in (("d_alpha", "d_f", 1e3), ("d_beta", "d_gamma", 1.0)):
        value, sigma = separation.mean(CORRECTED, read, changed)
        yield context.row(f"001.table1.range.{read}.by_{changed}", value * scale, sigma * scale, 0.0, **facts)


def _box_limits(geometry: MonitorGeometry) -> dict[str, list[float]]:
    """Return the box of joint changes in which Table 1 keeps the claimed accuracy, to first order.

    It follows from the factors that the formulas of Table 1 lack.
    """
    f, f_x = focal_lengths(geometry)
    anamorphism = f_x / f
    alpha, beta, gamma, d_f = ranges.BOX
    roll = abs(geometry.d_gamma_per_beta) * beta
    change = abs(geometry.d_f_per_alpha_m) * ARCSEC * 1e6 * alpha
    worst = {
        "d_alpha": (anamorphism - 1.0) * alpha,
        "d_gamma": (2.0 * anamorphism - 1.0) * gamma + roll,
        "d_f": 0.5 * d_f + change,
    }
    return {name: [float(CLAIMED[name] / value)] for name, value in worst.items()}


def _defocus(context: Context, resolved: ResolvedJob, bench: ranges.Bench, data: Data) -> Iterator[CheckResult]:
    context.progress(0.75, "defocus, with the monitor in other parts of the pupil")
    camera = bench.cameras[0]
    depth = ranges.depth_of_focus(resolved, camera)
    slope = ranges.false_slopes(bench, CORRECTED, (-depth, -ranges.CONFOCAL, ranges.CONFOCAL, depth))
    curves = ranges.piston_curves(bench, context.count(9, 5))
    constant = {z: ranges.gains(bench, z)[CORRECTED] for z in (-depth, 0.0, depth)}
    change = np.max([np.abs(gain / constant[0.0] - 1.0) for gain in constant.values()], axis=0)
    x = OFFSETS_X if not context.fast else (-0.24, 0.0, 0.24)
    y = OFFSETS_Y if not context.fast else (0.24,)
    positions = [(v, 0.0) for v in x] + [(0.0, v) for v in y]
    pupil = ranges.pupil_study(resolved, context.backend, bench, positions, depth)
    f, f_x = focal_lengths(bench.geometry(camera))
    _show_defocus(context, slope, curves, change, pupil, (f_x, f), data)
    offset = next(iter(resolved.instrument.channels_of(camera).values())).pupil_offset[0]
    facts: dict[str, Any] = {
        "instrument": INSTRUMENT,
        "camera": camera,
        "offset": offset,
        "half": ranges.CONFOCAL,
        "depth": depth,
        "positions": positions,
        "gradient": pupil.gradient[NAMES.index("d_alpha"), 0] * ARCSEC * f_x**2,
        "across": pupil.gradient[NAMES.index("d_beta"), 1] * ARCSEC * f**2,
    }
    for equation, name in _BY_EQUATION.items():
        k = NAMES.index(name)
        edge = curves.crossing(f"{name} claimed")
        more: dict[str, Any] = {
            "slope": slope[k] * 1e-6,
            "false": abs(slope[k]) * ranges.CONFOCAL,
            "unit": " µm" if name == "d_f" else "″",
            "edge": f"{edge * 1e6:.0f} µm" if edge else "more than 4 mm",
            "change": change[k],
        }
        explained = [abs(offset) / f_x**2 / ARCSEC * depth] if name == "d_alpha" else []
        row = f"001.{equation}.defocus"
        yield context.row(row, abs(slope[k]) * depth, None, 0.0, explained, **facts, **more)


def _returns(context: Context, resolved: ResolvedJob, bench: ranges.Bench, data: Data) -> Iterator[CheckResult]:
    context.progress(0.92, "other kinds of return")
    responses = ranges.responses(resolved, context.backend, bench)
    rows: list[list[Cell]] = []
    listed = {}
    for r in responses:
        across, along, note = float(r.across.mean()), float(r.along.mean()), ranges.RETURNS[r.kind][1]
        rows.append([r.kind, across, along, *(float(g) for g in r.gain), note])
        listed[r.kind] = {
            "spot_per_line_ccd_across": r.across.tolist(),
            "spot_per_line_ccd_along": r.along.tolist(),
            "reading_over_truth": dict(zip(NAMES, r.gain.tolist(), strict=True)),
        }
        value = {
            "plane": max((across, along), key=lambda v: abs(v + 2.0)),
            "roof": along,
            "roof along": across,
            "corner": max((across, along), key=abs),
        }[r.kind]
        facts: dict[str, Any] = {
            "note": note,
            "shift": ranges.SHIFT,
            "across": _four(across),
            "along": _four(along),
            "gains": {name: _four(gain) for name, gain in zip(NAMES, r.gain, strict=True)},
        }
        row = f"001.returns.{r.kind.replace(' ', '_')}"
        yield context.row(row, value, None, -2.0, [] if r.kind == "plane" else [0.0], **facts)
    data["returns"] = listed
    context.table("returns", rows)


def _four(value: float) -> str:
    """Return a number as text with four decimals, without a minus sign before zero."""
    return f"{round(float(value), 4) + 0.0:.4f}"


# --- figures ----------------------------------------------------------------------------------------------------------


def _thinned(points: np.ndarray) -> np.ndarray:
    """Return N points, (N, 2), without those that nearly coincide with the previous one."""
    indices = [0]
    for i in range(1, len(points)):
        if points[i, 0] > 1.25 * points[indices[-1], 0]:
            indices.append(i)
    return points[indices]


@drawing("ranges-001-singles", 7.4)
def singles_svg(figure: Figure, reference_ranges: Mapping[str, Sequence[ranges.Range]]) -> None:
    """Draw a panel per parameter: error over the true change, both on logarithmic axes."""
    for axes, name in zip(figure.subplots(2, 2).ravel(), _ORDER, strict=True):
        both = reference_ranges[name]
        per, unit, _ = _shown(name)
        first = both[0]
        low, high = first.raw[PRINTED][0, 0] * per, first.lost * per
        axes.axvspan(0.85 * low, min(r.window for r in both) * per, color=LIGHT, alpha=0.55, lw=0)
        grid = np.array([low, high])
        axes.plot(grid, 0.01 * grid, "--", color=GREY, lw=1.0)
        axes.axhline(FINE[name] * per, color=INK, lw=1.0, ls=":")
        if CLAIMED[name] != FINE[name]:
            axes.axhline(CLAIMED[name] * per, color=INK, lw=1.0, ls="-.")
        for form in [PRINTED, JOINT] if name == "d_f" else [PRINTED, CORRECTED]:
            marks = _thinned(first.raw[form]) * per
            line = np.concatenate([first.raw[form], first.raw_traced[form]]) * per
            axes.plot(line[:, 0], np.abs(line[:, 1]), "-", color=_COLOURS[form], lw=1.0)
            label = f"printed {ranges.EQUATIONS[name]}" if form == PRINTED else form
            if name == "d_f" and form == PRINTED:
                label += ", the same as corrected"
            axes.plot(marks[:, 0], np.abs(marks[:, 1]), _MARKS[form], color=_COLOURS[form], ms=4.5, label=label)
        axes.set(xscale="log", yscale="log")
        axes.set_xlim(0.85 * low, 1.02 * high)
        axes.set_ylim(0.3 * np.min(np.abs(first.raw[CORRECTED][:, 1])) * per, None)
        axes.plot([], [], "--", color=GREY, lw=1.0, label="1 %")
        axes.plot([], [], ":", color=INK, lw=1.0, label="0.04 mm" if name == "d_f" else "0.1 arcsec")
        if CLAIMED[name] != FINE[name]:
            axes.plot([], [], "-.", color=INK, lw=1.0, label="2.15 arcsec")
        axes.set(xlabel=f"true {SYMBOLS[name]} [{unit}]", ylabel=f"|error| [{unit}]")
        axes.legend(loc="upper left", ncols=2)


@drawing("ranges-001-joint", 6.2)
def joint_svg(figure: Figure, corners: ranges.Corners) -> None:
    """Draw a panel per parameter: the largest error at a corner over the size of the box.

    The error is divided by the one that the paper claims.
    """
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for axes, name in zip(panels, _ORDER, strict=True):
        axes.axhline(1.0, color=INK, lw=1.0, ls=":")
        axes.axvspan(float(corners.images.size[0]), 1.0, color=LIGHT, alpha=0.55, lw=0)
        for form in (JOINT, CORRECTED, CALIBRATED):
            of = ranges.key(form, name)
            size = np.concatenate([corners.images.size, corners.traced.size])
            value = np.concatenate([corners.images.value[of], corners.traced.value[of]])
            axes.plot(size, value, "-", color=_COLOURS[form], lw=1.0)
            marks = _thinned(np.column_stack([corners.images.size, corners.images.value[of]]))
            axes.plot(marks[:, 0], marks[:, 1], _MARKS[form], color=_COLOURS[form], ms=4.5, label=form)
        axes.set(xscale="log", yscale="log")
        axes.set_xlim(float(corners.images.size[0]), corners.lost * 1.02)
        axes.set_ylabel(f"worst error of {SYMBOLS[name]} / {CLAIMED[name] * _shown(name)[0]:g} {_shown(name)[1]}")
    for axes in panels[2:]:
        axes.set_xlabel(f"size of the box, times {ranges.BOX_TEXT}")
    panels[0].legend(loc="lower right")


@drawing("ranges-001-defocus", 3.9)
def defocus_svg(figure: Figure, pupil: ranges.PupilStudy, curves: ranges.Curves, focal: tuple[float, float]) -> None:
    """Draw the false changes due to piston of the line CCD: per metre over the pupil, and over the piston."""
    left, right = figure.subplots(1, 2)
    grid = np.array([-0.3, 0.3])
    for axis, name, length, sign in ((0, "d_alpha", focal[0], -1.0), (1, "d_beta", focal[1], 1.0)):
        on_axis = np.equal(pupil.offset[:, 1 - axis], 0.0)
        slope = 1e-6 * pupil.slope[on_axis, NAMES.index(name)]
        colour = _OF_PARAMETER[name]
        left.plot(1e3 * grid, sign * 1e-6 * grid / length**2 / ARCSEC, "-", color=colour, lw=1.0)
        label = f"{SYMBOLS[name]}, sub-aperture along {'XY'[axis]}"
        left.plot(1e3 * pupil.offset[on_axis, axis], slope, "os"[axis], color=colour, ms=5.0, label=label)
    left.plot([], [], "-", color=GREY, lw=1.0, label="theory, ±h/f²")
    left.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
    left.set_xlabel("sub-aperture off the pupil's middle, h [mm]")
    left.set_ylabel("false reading [arcsec per µm of defocus]")
    left.legend(loc="upper center")
    right.axhline(1.0, color=INK, lw=1.0, ls=":")
    for name in _ORDER:
        value = curves.value[f"{name} claimed"]
        right.plot(1e6 * curves.size, value, "o-", color=_OF_PARAMETER[name], ms=3.5, lw=1.0)
        position = 1e6 * float(curves.size[-1]), float(value[-1])
        right.annotate(SYMBOLS[name], position, xytext=(6, 0), textcoords="offset points",
                       color=_OF_PARAMETER[name], va="center")  # fmt: skip
    right.set(xscale="log", yscale="log")
    right.set_xlabel("motion of the line CCD along Z [µm]")
    right.set_ylabel("false reading / (0.1″, 2.15″, 0.04 mm)")


@drawing("ranges-001-field", 3.2)
def field_svg(figure: Figure, points: Sequence[ranges.FieldPoint]) -> None:
    """Draw the relative scale error of the estimates over the field angle of the area CCDs."""
    axes = figure.subplots()
    field = np.array([p.field for p in points])
    fine = np.linspace(0.0, float(field.max()), 60)

    def gain(form: str, name: str) -> Any:
        return np.array([p.gains[form][NAMES.index(name)] for p in points])

    base = float(gain(CORRECTED, "d_beta")[0])
    axes.plot(np.degrees(fine), 100 * (base * np.cos(fine) ** 2 - 1.0), "-", color=GREY, lw=1.0)
    axes.plot(np.degrees(field), 100 * (gain(PRINTED, "d_beta") - 1.0), "o", color=INK, ms=5.0, label="Δβ printed (2)")
    for name, mark in (("d_beta", "s"), ("d_alpha", "^"), ("d_gamma", "D"), ("d_f", "v")):
        axes.plot(np.degrees(field), 100 * (gain(CORRECTED, name) - 1.0), f"{mark}-", color=_OF_PARAMETER[name],
                  ms=4.5, lw=0.8, label=f"{SYMBOLS[name]} corrected")  # fmt: skip
    axes.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
    axes.set_xlim(0.0, None)
    axes.set_xlabel("field of the area CCDs [deg]")
    axes.set_ylabel("reading / truth less 1 [%]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


# --- tables and data --------------------------------------------------------------------------------------------------


def _show_causes(
    context: Context,
    reference_ranges: Mapping[str, list[ranges.Range]],
    geometry: MonitorGeometry,
    local: float,
    data: Data,
) -> None:
    """Add the limits of every single formula, and their causes, to the report.

    ``local`` is the focal length along the line at its centre, metres.
    """
    f, f_x = focal_lengths(geometry)
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
        errors = reference_ranges[name][0].raw[form]
        inside = errors[errors[:, 0] <= reference_ranges[name][0].window]
        share = reference_ranges[name][0].sign * inside[:, 1] / inside[:, 0]
        bend = float(np.ptp(share))
        by_cause = "" if theory is None else f"{100 * theory:.3f} %"
        rows.append([SYMBOLS[name], form, f"{100 * share[-1]:.3f} %", by_cause, f"{100 * bend:.1e} %", text])
        listed.append({"change": name, "form": form, "error_over_change": float(share[-1]), "theory": theory,
                       "bend_within_the_area_ccd": bend, "cause": text})  # fmt: skip
    data["causes"] = listed
    context.table("causes", rows)


def _show_singles(
    context: Context, ranges_by_instrument: Mapping[str, Mapping[str, list[ranges.Range]]], data: Data
) -> None:
    """Add the ranges of validity of every single formula to the report."""
    rows: list[list[Cell]] = []
    listed: dict[str, dict[str, Any]] = {instrument: {} for instrument in ranges_by_instrument}
    for instrument, name in ((instrument, name) for instrument in ranges_by_instrument for name in NAMES):
        both = ranges_by_instrument[instrument][name]
        per, unit, _ = _shown(name)
        ends = min(r.window for r in both), min(r.lost for r in both)
        entry: dict[str, Any] = {f"area_ccd_ends_at_{unit}": ends[0] * per, f"beam_cut_at_{unit}": ends[1] * per}
        for form in FORMS:
            if form in (PRINTED, CORRECTED) or (form == JOINT and name == "d_f"):
                limits = (limit_text(both, form, kind) for kind in ranges.KINDS)
                rows.append([instrument, SYMBOLS[name], form, *limits, *(_size(end, name) for end in ends)])
            known = {kind: limit_of(both, form, kind) for kind in ranges.KINDS}
            entry[form] = {kind: {f"limit_{unit}": size * per, "by": by} for kind, (size, by) in known.items()}
        listed[instrument][name] = entry
    data["single_changes"] = listed
    context.table("domains", rows)
    first = next(iter(ranges_by_instrument))
    context.figure("domains-figure", singles_svg(ranges_by_instrument[first]), instrument=first)


def _show_joint(context: Context, corners: ranges.Corners, separation: ranges.Separation, data: Data) -> None:
    """Add the results for all four changes at once to the report."""
    rows: list[list[Cell]] = []
    for form in (JOINT, CORRECTED, CALIBRATED):
        for read in NAMES:
            gains = (
                separation.mean(form, read, changed)[0] * _shown(read)[0] / _shown(changed)[0] for changed in NAMES
            )
            cells = (f"{round(gain, 5) + 0.0:.5f}".replace("-", "\N{MINUS SIGN}") for gain in gains)
            boxes = (corners.text(ranges.key(form, read, fine)) for fine in (False, True))
            rows.append([form, f"{SYMBOLS[read]} [{_shown(read)[1]}]", *cells, *boxes])
    context.table("joint", rows, trials=separation.trials, box=ranges.BOX_TEXT)
    gain, sigma = (
        {form: [[separation.mean(form, r, c)[part] for c in NAMES] for r in NAMES] for form in FORMS} for part in (0, 1)
    )
    limits = {name: corners.limit(name) for name in corners.images.value}
    data["all_at_once"] = {
        "box_half_widths": {f"{n}_{ranges.UNITS[n]}": float(ranges.BOX[k]) for k, n in enumerate(NAMES)},
        "gain": gain,
        "gain_sigma": sigma,
        "gain_units": [f"{ranges.UNITS[r]} per {ranges.UNITS[c]}" for r in NAMES for c in NAMES],
        "box_share": {name: {"limit": limit, "by": by} for name, (limit, by) in limits.items()},
    }
    context.figure("joint-figure", joint_svg(corners), box=ranges.BOX_TEXT)


def _show_defocus(
    context: Context,
    slope: np.ndarray,
    curves: ranges.Curves,
    change: np.ndarray,
    pupil: ranges.PupilStudy,
    focal: tuple[float, float],
    data: Data,
) -> None:
    """Add the false changes due to defocus to the report.

    ``change`` is the change of the ratio of estimate to true change; the focal lengths are across and along the line,
    in metres.
    """
    theory = {name: 1.0 / f**2 / ARCSEC for name, f in zip(("d_alpha", "d_beta"), focal, strict=True)}
    rows: list[list[Cell]] = []
    listed: dict[str, Any] = {}
    for k, name in enumerate(NAMES):
        unit, expected = ranges.UNITS[name], theory.get(name)
        fine, claimed = (curves.crossing(f"{name} {kind}") for kind in ("fine", "claimed"))
        by_x, by_y = (float(1e-9 * gradient) for gradient in pupil.gradient[k])
        limits = (f"{1e6 * z:.0f} µm" if z else "> 4000 µm" for z in (fine, claimed))
        rows.append(
            [f"{SYMBOLS[name]} [{unit}]", f"{1e-6 * slope[k]:.4g}", f"{abs(slope[k]) * ranges.CONFOCAL:.3g}", *limits,
             f"{by_x:.4g}", f"{by_y:.4g}", f"{1e-9 * expected:.4g}" if expected else "", f"{change[k]:.1e}"]
        )  # fmt: skip
        listed[name] = {
            f"false_{unit}_per_um": float(slope[k] * 1e-6),
            "piston_for_0.1_arcsec_or_0.04_mm_um": None if fine is None else fine * 1e6,
            "piston_for_claimed_um": None if claimed is None else claimed * 1e6,
            f"by_pupil_x_{unit}_per_um_per_mm": by_x,
            f"by_pupil_y_{unit}_per_um_per_mm": by_y,
            f"theory_{unit}_per_um_per_mm": expected * 1e-9 if expected else None,
            "change_of_gain_in_a_defocused_camera": float(change[k]),
        }
    data["defocus"] = listed
    context.table("defocus", rows, small=ranges.SMALL, small_mm=1e-3 * ranges.SMALL["d_f"])
    context.figure("defocus-figure", defocus_svg(pupil, curves, focal))


def _show_field(context: Context, points: Sequence[ranges.FieldPoint], data: Data) -> None:
    """Add the results of the area CCDs at other field angles to the report."""
    rows: list[list[Cell]] = []
    listed = []
    for p in points:
        gains = {form: dict(zip(NAMES, p.gains[form].tolist(), strict=True)) for form in FORMS}
        false = {name: float(1e-6 * p.slope[NAMES.index(name)]) for name in ("d_alpha", "d_f")}
        corrected = (gains[CORRECTED][name] for name in _ORDER)
        rows.append([math.degrees(p.field), p.separation, gains[PRINTED]["d_beta"], *corrected, *false.values()])
        position: dict[str, Any] = {"field_deg": math.degrees(p.field), "separation_m": p.separation}
        by_defocus = {"false_d_alpha_arcsec_per_um": false["d_alpha"], "false_d_f_um_per_um": false["d_f"]}
        listed.append({**position, "reading_over_truth": gains, **by_defocus})
    context.table("field", rows)
    context.figure("field-figure", field_svg(points))
    data["field"] = listed


GROUP = group_of("001.ranges", run)
