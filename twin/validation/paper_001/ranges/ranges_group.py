"""The checks of how far paper 001's formulas hold."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.monitoring import MonitorGeometry
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob, resolve_job
from twin.run.artefact import Data
from twin.validation.checks.check import CheckResult
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_001.ranges import defocus, show, turns
from twin.validation.paper_001.ranges import defocus as returns
from twin.validation.paper_001.ranges.curves import CALIBRATED, JOINT, PRINTED, Bench
from twin.validation.paper_001.ranges.curves import CORRECTED as FORM
from twin.validation.paper_001.ranges.defocus import variant
from twin.validation.paper_001.ranges.turns import NAMES, Range, criterion

INSTRUMENT, OTHER = "monitor_pair", "gf7_pair"
"""The camera that Table 5 implies; and one of another focal length, in full runs."""
FIELDS = (1.0, 1.5, 2.0, 2.4, 2.72, 2.8)
"""Fields of the area CCDs, degrees. At smaller fields the left and right prisms overlap."""
OFFSETS_X = (-0.28, -0.24, -0.12, 0.0, 0.12, 0.24, 0.28)
OFFSETS_Y = (-0.24, -0.12, 0.12, 0.24)
"""Offsets of the sub-aperture, metres; the pupil's radius is 0.32 m."""
_SINGLE = ("001.eq2.range", "001.eq3.range", "001.eq5.range", "001.eq7.range", "001.small_angles.range")
_BY_EQUATION = {"eq2": "d_beta", "eq3": "d_alpha", "eq5": "d_gamma", "eq7": "d_f"}


def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    resolved = resolve_job(JobSpec(instrument=INSTRUMENT))
    context.progress(0.0, f"build {INSTRUMENT}")
    camera = next(iter(resolved.instrument.cameras))
    bench = Bench(variant(resolved, context.backend, camera))
    data: dict[str, object] = {}
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
    context.add(Data("ranges", "All ranges as data", "Limits, gains and coefficients with their units.", data))


def ranges_of(
    context: Context, resolved: ResolvedJob, bench: Bench, begin: float, share: float
) -> dict[str, list[Range]]:
    """Parameter -> its ranges in both directions."""
    wide = Bench(variant(resolved, context.backend, bench.cameras[0], pixels=turns.WIDE_PX), bench, shapes=True)
    out: dict[str, list[Range]] = {}
    for k, name in enumerate(NAMES):
        context.progress(begin + share * k / len(NAMES), f"{resolved.instrument.name}: follow {name} by itself")
        out[name] = [turns.single_range(bench, wide, name, sign, context.count(9, 5)) for sign in (1, -1)]
    return out


def _singles(context: Context, resolved: ResolvedJob, bench: Bench, data: dict[str, object]) -> Iterator[CheckResult]:
    ranges = {INSTRUMENT: ranges_of(context, resolved, bench, 0.02, 0.4 if context.fast else 0.2)}
    if not context.fast:
        other = resolve_job(JobSpec(instrument=OTHER))
        second = Bench(variant(other, context.backend, next(iter(other.instrument.cameras))))
        ranges[OTHER] = ranges_of(context, other, second, 0.22, 0.2)
    show.singles_shown(context, ranges, data)
    geometry = bench.geometry(bench.cameras[0])
    own = ranges[INSTRUMENT]
    local = bench.experiment.instrument.cameras[bench.cameras[0]].line_principal_distance
    show.causes_shown(context, own, geometry, local, data)
    for equation, name in _BY_EQUATION.items():
        yield _range(context, f"001.{equation}.range", own[name], geometry)
    yield _small(context, own)


def _range(context: Context, identifier: str, both: list[Range], geometry: MonitorGeometry) -> CheckResult:
    """The printed formula's range of one parameter."""
    name = both[0].parameter
    per, unit = (1e-3, "mm") if name == "d_f" else (1.0, "″")
    claimed = turns.CLAIMED[name]
    limit, whence = min(r.limit(criterion(PRINTED, "claimed")) for r in both)
    window = min(r.window for r in both)
    f, f_x = geometry.principal_distance_m, geometry.principal_distance_across_m or geometry.principal_distance_m
    share = {"d_alpha": f_x / f - 1.0, "d_gamma": 2.0 * f_x / f - 1.0}.get(name)
    explained = [] if share is None else [claimed / share * per]
    error = 100.0 * (share or 0.0)
    images = sum(len(r.images.size) for r in both)
    gap = max(r.trace_gap for r in both)
    lost, why = min((r.lost, r.lost_why) for r in both)
    best = {k: show.limit_text(both, FORM, k, per) for k in turns.KINDS}
    how = (
        f"{images} sizes in both directions, noise-free images of area CCDs of {turns.WIDE_PX} px through the "
        f"centroid and (2)–(7), truth by exact trace; beyond {both[0].images.size[-1] * per:.3g} {unit} traced spots, "
        f"which agree with the rendered ones to {gap:.0e} px. The instrument's own area CCDs end at "
        f"{window * per:.4g} {unit} (a spot {turns.EDGE_PX:g} px from the outermost pixels); at "
        f"{lost * per:.4g} {unit} {why}. "
        f"Printed: 1 % holds {show.limit_text(both, PRINTED, '1 %', per)}, the limit here is known from {whence}. "
        f"Corrected: 1 % {best['1 %']}, {show.fine_text(name)} {best['fine']}."
    )
    return context.check(identifier).evaluate(
        limit * per, None, how.replace(" ″", "″"), window * per, explained, facts={"f": f, "f_x": f_x, "error": error}
    )


def _small(context: Context, own: Mapping[str, list[Range]]) -> CheckResult:
    worst, where = 0.0, ""
    for name in ("d_beta", "d_alpha", "d_gamma"):
        for r in own[name]:
            true = r.raw[PRINTED][:, 0] * r.sign
            inside = r.raw[PRINTED][:, 0] <= r.window
            arctan, linear = (true + r.raw[form][:, 1] for form in (PRINTED, JOINT))
            share = float(np.max(np.abs(linear / arctan - 1.0)[inside]))
            if share >= worst:
                worst, where = share, f"{turns.EQUATIONS[name]} at {r.window:.4g}″"
    how = (
        f"(2), (3), (5) with arctangent against Table 1's forms of Δβ, Δα, Δγ, both fed with the images of the "
        f"single changes up to the window's edge; the largest share is at {where}. Where tan x were the only fault, "
        f"1 % would be reached at x = {math.degrees(math.sqrt(0.03)):.0f}° and 0.1″ at "
        f"{(0.3 * ARCSEC) ** (1 / 3) / ARCSEC:.0f}″: it limits nothing."
    )
    return context.check("001.small_angles.range").evaluate(worst, None, how, 0.0)


def _field(context: Context, resolved: ResolvedJob, bench: Bench, data: dict[str, object]) -> CheckResult:
    context.progress(0.45, "move the area CCDs along the line")
    fields = FIELDS if not context.fast else (FIELDS[0], FIELDS[-1])
    depth = defocus.depth_of_focus(resolved, bench.cameras[0])
    points = defocus.field_study(resolved, context.backend, bench.cameras[0], [math.radians(f) for f in fields], depth)
    show.field_shown(context, points, data)
    first, last = points[0], points[-1]
    k = NAMES.index("d_beta")
    ratio = last.gains[PRINTED][k] / first.gains[PRINTED][k]
    cos2 = (math.cos(last.field) / math.cos(first.field)) ** 2
    bare = last.gains[FORM][k] / first.gains[FORM][k]
    how = (
        f"The instrument built anew with its area CCDs at {len(points)} fields from {fields[0]:g}° to {fields[-1]:g}° "
        f"(L from {first.separation:.3f} to {last.separation:.3f} m); nearer to the middle the prisms of both channels "
        f"stand in each other. Without cos²β the same ratio is {bare:.5f}. Of the others, printed, at the ends: "
        + ", ".join(
            f"{name} {first.gains[PRINTED][j]:.4f} and {last.gains[PRINTED][j]:.4f}" for j, name in enumerate(NAMES)
        )
        + ". cos²β would be wrong by 1 % at a field of 5.7°."
    )
    return context.check("001.eq2.range.field").evaluate(ratio, None, how, 1.0, [cos2])


def _joint(context: Context, data: dict[str, object]) -> Iterator[CheckResult]:
    context.progress(0.5, "change all four at once")
    experiment = context.experiment(INSTRUMENT)
    bench = Bench(experiment)
    corners = turns.corners(bench, context.count(8, 4))
    trials = context.count(240, 40)
    context.progress(0.65, f"{trials} random changes with noise")
    found = turns.separation(experiment, bench, trials, context.seed)
    show.joint_shown(context, corners, found, data)
    geometry = bench.geometry(bench.cameras[0])
    setup = (
        f"{trials} random states of both cameras, all four uniform in {turns.BOX_TEXT}, through "
        f"{bench.frames} noisy frames each; reading = K · true + constant by least squares."
    )
    explained = _box_limits(geometry)
    for k, name in enumerate(NAMES):
        share, whence = corners.limit(turns.key(JOINT, name))
        diagonal = [found.mean(form, name, name) for form in (JOINT, FORM)]
        how = (
            f"{16 * len(corners.images.size)} noise-free images of both cameras at the 16 corners of boxes "
            f"{turns.BOX_TEXT} times a size, 1 of which just fills the area CCDs; beyond that traced spots; "
            f"this limit is known from {whence}. Corrected factors: {corners.text(turns.key(FORM, name))}; with the "
            f"two calibrated gradients: {corners.text(turns.key(CALIBRATED, name))}. {setup} Its diagonal: "
            f"{diagonal[0][0]:.4f} by Table 1, {diagonal[1][0]:.4f} corrected; it leaves "
            f"{found.scatter[FORM][k]:.2g} {_plain(turns.UNITS[name])} rms."
        ).replace(" ″", "″")
        yield context.check(f"001.table1.range.{name}").evaluate(share, None, how, 1.0, explained.get(name, ()))
    yield from _crosstalk(context, found, setup)


def _box_limits(geometry: MonitorGeometry) -> dict[str, list[float]]:
    """To first order, the box in which Table 1 stays within the claims, from the factors that it lacks."""
    anamorphism = (
        geometry.principal_distance_across_m or geometry.principal_distance_m
    ) / geometry.principal_distance_m
    alpha, beta, gamma, f = turns.BOX
    roll = abs(geometry.d_gamma_per_beta) * beta
    growth = abs(geometry.d_f_per_alpha_m) * ARCSEC * 1e6 * alpha
    worst = {
        "d_alpha": (anamorphism - 1.0) * alpha,
        "d_gamma": (2.0 * anamorphism - 1.0) * gamma + roll,
        "d_f": 0.5 * f + growth,
    }
    return {name: [float(turns.CLAIMED[name] / value)] for name, value in worst.items()}


def _crosstalk(context: Context, found: turns.Separation, setup: str) -> Iterator[CheckResult]:
    for pair, scale in (("d_alpha.by_d_f", 1e3), ("d_beta.by_d_gamma", 1.0)):
        identifier = f"001.table1.range.{pair}"
        read, _, changed = pair.partition(".by_")
        value, sigma = found.mean(FORM, read, changed)
        f_by_alpha, gamma_by_beta = found.mean(FORM, "d_f", "d_alpha")[0], found.mean(FORM, "d_gamma", "d_beta")[0]
        how = (
            f"{setup} Corrected factors. Larger are what no spot shows: Δf per Δα {f_by_alpha:.2f} µm/″ and Δγ per Δβ "
            f"{gamma_by_beta:.4f}, by the distortion of the off-axis camera."
        )
        yield context.check(identifier).evaluate(value * scale, sigma * scale, how, 0.0)


def _defocus(context: Context, resolved: ResolvedJob, bench: Bench, data: dict[str, object]) -> Iterator[CheckResult]:
    context.progress(0.75, "defocus, with the monitor in other parts of the pupil")
    camera = bench.cameras[0]
    depth = defocus.depth_of_focus(resolved, camera)
    half = defocus.CONFOCAL
    slope = defocus.false_slopes(bench, FORM, (-depth, -half, half, depth))
    curves = defocus.piston_curves(bench, context.count(9, 5))
    constant = {z: defocus.gains(bench, z) for z in (-depth, 0.0, depth)}
    x = OFFSETS_X if not context.fast else (-0.24, 0.0, 0.24)
    y = OFFSETS_Y if not context.fast else (0.24,)
    places = [(v, 0.0) for v in x] + [(0.0, v) for v in y]
    pupil = defocus.pupil_study(resolved, context.backend, bench, places, depth)
    geometry = bench.geometry(camera)
    f, f_x = geometry.principal_distance_m, geometry.principal_distance_across_m or geometry.principal_distance_m
    show.defocus_shown(context, slope, curves, constant, pupil, (f_x, f), data)
    offset = next(iter(resolved.instrument.channels_of(camera).values())).pupil_offset[0]
    theory = {"d_alpha": abs(offset) / f_x**2 / ARCSEC}
    gradient = pupil.gradient[NAMES.index("d_alpha"), 0] * ARCSEC * f_x**2
    across = pupil.gradient[NAMES.index("d_beta"), 1] * ARCSEC * f**2
    for equation, name in _BY_EQUATION.items():
        identifier = f"001.{equation}.defocus"
        k = NAMES.index(name)
        unit = _plain(turns.UNITS[name])
        edge = curves.crossing(f"{name} claimed")
        how = (
            f"Noise-free images of {INSTRUMENT}, camera {camera}, sub-aperture {1e3 * offset:.0f} mm off the pupil's "
            f"middle along X, line CCD moved along Z by ±{half * 1e6:.0f} µm (paper 004's reach) and "
            f"±{depth * 1e6:.0f} µm (2λN²); corrected factors. False reading: {slope[k] * 1e-6:.3g} {unit} per µm, so "
            f"{abs(slope[k]) * half:.2g} {unit} at {half * 1e6:.0f} µm; what section 3.3 and Table 5 claim is reached "
            "at "
            + (f"{edge * 1e6:.0f} µm." if edge else "more than 4 mm.")
            + " The motion also changes the reading of a change of 1 by less than "
            f"{max(abs(g[FORM][k] / constant[0.0][FORM][k] - 1.0) for g in constant.values()):.0e}."
        ).replace(" ″", "″")
        explained = []
        if name in theory:
            how += (
                f" Over {len(places)} places of the sub-aperture it changes by {gradient:.3f}/f_x² along X; along Y Δβ "
                f"changes by {across:.3f}/f²."
            )
            explained = [theory[name] * depth]
        elif name == "d_beta":
            how += f" A sub-aperture off along Y would read zh/f² here ({across:.3f} of it by images)."
        yield context.check(identifier).evaluate(abs(slope[k]) * depth, None, how, 0.0, explained)


def _returns(context: Context, resolved: ResolvedJob, bench: Bench, data: dict[str, object]) -> Iterator[CheckResult]:
    context.progress(0.92, "other kinds of return")
    found = {r.kind: r for r in returns.responses(resolved, context.backend, bench)}
    show.returns_shown(context, list(found.values()), data)
    for kind, identifier in (("plane", "001.returns.plane"), ("roof", "001.returns.roof"),
                             ("roof along", "001.returns.roof_along"), ("corner", "001.returns.corner")):  # fmt: skip
        r = found[kind]
        across, along = float(r.across.mean()), float(r.along.mean())
        value = {
            "plane": max((across, along), key=lambda v: abs(v + 2.0)),
            "roof": along,
            "roof along": across,
            "corner": max((across, along), key=abs),
        }[kind]
        how = (
            f"Noise-free images with this return in place of the facets ({r.note}); the line CCD moved by "
            f"{returns.SHIFT * 1e6:g} µm: {_four(across)} across the line, {_four(along)} along it. Corrected readings "
            "over truth: " + ", ".join(f"{name} {_four(g)}" for name, g in zip(NAMES, r.gain, strict=True)) + "."
        )
        yield context.check(identifier).evaluate(value, None, how, -2.0, [] if kind == "plane" else [0.0])


def _four(value: float) -> str:
    """Four decimals, and no minus sign before zero."""
    return f"{round(float(value), 4) + 0.0:.4f}"


def _plain(unit: str) -> str:
    """A table unit in prose."""
    return {"arcsec": "″", "um": "µm"}[unit]


GROUP = group_of("001.ranges", run)
