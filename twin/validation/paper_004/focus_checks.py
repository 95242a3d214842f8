"""Checks of paper 004's focal-plane alignment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from analysis.arrays import ARCMIN, ARCSEC, MM_PER_M, UM_PER_M, Array
from analysis.focal_plane.plane_fit import RigidMotion, ShimPlan, fit_focal_plane, shim_plan
from analysis.focal_plane.through_focus import focus_vertex
from analysis.mtf.slanted_edge import EdgeMtf, measure_edge
from optics.geometry.pose import Pose, rotation_matrix
from optics.numerics.backend import one_blas_thread
from scenes.specs.resolved import resolve_focus
from twin.laboratory.focus_bench import FocusBench
from twin.laboratory.focus_run import FocusState, SimulatedFocus, align, line_turn, mount_of
from twin.laboratory.focus_scan import NYQUIST
from twin.run.artefact import Cell
from twin.run.svg import AFTER, BEFORE, INK, LIGHT, look, new_figure, plain_axes, to_svg
from twin.targets.target_images import TRACK
from twin.validation.checks.check import Check, CheckResult, Chosen, mean_of
from twin.validation.checks.group import Context, group_of, load_printed

MTF_NYQUIST = load_printed("004").numbers("table1.mtf_nyquist")
CONFOCAL_MM = load_printed("004").number("alignment.confocal_mm")
LINE_LEVEL_ARCMIN = load_printed("004").number("alignment.line_level_arcmin")
PARAMETERS = ("Δα", "Δβ", "Δγ", "Δx", "Δy", "Δz")
ADJUSTMENTS = ("tilt about the surface's x", "tilt about its y", "turn in it", "slide along x", "slide along y", "lift")
"""Tilts and lift by shims, the others by hand."""
LIMITS = np.array([10.0 * ARCSEC, 10.0 * ARCSEC, 10.0 * ARCSEC, 7e-6, 7e-6, 5e-6])
"""What counts as a change: the theodolite's 10 arcsec, a panchromatic pixel, a step of the shims."""
TEST = "focus"
ALIGNMENTS, FAST_ALIGNMENTS = 12, 1
"""Alignments from random mis-settings."""

_ALL_LOSSES = "what the scene file assumes beyond the paper, in waves, pixels or line periods, times"


def effects(bench: FocusBench, inclined: float = 1.0) -> Array:
    """Change of each parameter (6) by each adjustment (6), as far as the assembly is mis-set: radians and metres.

    Δα, Δβ and Δz are those of the plane through the traced defocus of all sites; Δγ is the line's turn, Δx and Δy where
    its middle goes.

    Args:
        bench: with the mount.
        inclined: factor on the inclination of the mounting surface.
    """
    test = bench.setup.test
    surface = test.mount.model_copy(update={"tilt": inclined * test.mount.tilt})
    mount = mount_of(test.model_copy(update={"mount": surface}))
    up, centre = mount.normal, mount.holes.mean(axis=0)
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    size_turn, size_shift = np.array(test.misset.rotate), np.array(test.misset.shift)
    none = np.zeros(3)
    steps = [(size * axis, none) for size, axis in zip(size_turn, (x, y, up), strict=True)]
    steps += [(none, size * axis) for size, axis in zip(size_shift, (x, y, up), strict=True)]
    start = _parameters(bench, Pose(np.eye(3), none))
    out = []
    for turn, shift in steps:
        rotation = rotation_matrix(turn)
        pose = Pose(rotation, centre - rotation @ centre + shift)
        out.append(_parameters(bench, pose) - start)
    return np.array(out)


def _parameters(bench: FocusBench, pose: Pose) -> Array:
    defocus = np.array([site.defocus(pose, 0.0) for site in bench.sites])
    places = np.array([site.place for site in bench.sites])
    piston, slope_x, slope_y = np.linalg.lstsq(np.column_stack([np.ones(len(places)), places]), defocus)[0]
    # a rotation (a, b, c) lifts a point by a Y' - b X'
    return np.array([slope_y, -slope_x, line_turn(pose), *pose.translation[:2], piston])


def evaluate_coupling(check: Check, bench: FocusBench) -> CheckResult:
    """How many parameters the adjustments of the mount tie together."""
    change = effects(bench)
    seen = np.abs(change) > LIMITS
    text = "; ".join(
        f"{name} changes {', '.join(p for p, s in zip(PARAMETERS, row, strict=True) if s)}"
        for name, row in zip(ADJUSTMENTS, seen, strict=True)
    )
    lost = change[0, 2] / change[0, 0]
    how = (
        "Exact motions of the assembly on its mount, by as much as it is mis-set, and the traced defocus of "
        f"{len(bench.sites)} sites: {text}. A tilt about the surface's x costs the line {abs(lost):.2f} of it in "
        "level. Counted is what exceeds 10″, a pixel of 7 µm, or a shim step of 5 µm. The inclination of the mounting "
        f"surface, {np.degrees(bench.setup.test.mount.tilt):g}°, and its distance from the focal plane are assumed, "
        "for the paper prints neither."
    )
    inclination = Chosen(
        "inclination of the mounting surface", float(np.degrees(bench.setup.test.mount.tilt)), "deg",
        lambda factor: coupled(effects(bench, factor)),
    )  # fmt: skip
    return check.evaluate(coupled(change), None, how, explained=[3.0], inputs=[inclination])


def coupled(change: Array) -> float:
    """Parameters in the largest set that adjustments tie together, one after the other; change: as of `effects`."""
    seen = np.abs(change) > LIMITS
    _, family = connected_components((seen.T @ seen).astype(float), directed=False)
    return float(np.bincount(family).max())


@dataclass(frozen=True, eq=False)
class Plan:
    """What the analysis makes of the MTF curves of an alignment's first state.

    Attributes:
        alignment: with the curves and the truth.
    """

    alignment: SimulatedFocus

    @cached_property
    def motion(self) -> RigidMotion:
        """Motion of the assembly that corrects the focal plane."""
        state = self.alignment.states[0]
        where, sigma = measured_defocus(state)
        # the plane wants how far best focus lies downstream of the CCD
        return fit_focal_plane(self.alignment.places, -where, sigma, estimate_extra=True).correction(state.level)

    @cached_property
    def shims(self) -> ShimPlan:
        """Under the assembly."""
        test = self.alignment.bench.setup.test
        return shim_plan(self.motion, mount_of(test), np.full(len(test.mount.holes), test.mount.thickness))

    @cached_property
    def moved(self) -> Pose:
        """Where the assembly would truly stand after exactly the motion wanted."""
        return self.alignment.states[0].standing.pose @ Pose(self.motion.matrix, self.motion.shift)

    @property
    def left(self) -> Array:
        """True defocus of every site there, (N,), metres."""
        heights = self.alignment.states[0].standing.heights
        return np.array([site.defocus(self.moved, heights[site.band]) for site in self.alignment.bench.sites])

    @property
    def asked(self) -> Array:
        """Changes of the shims (H,), metres, for the traced defocus and the true turn of the line."""
        alignment = self.alignment
        piston, slope_x, slope_y = alignment.true_plane(0)
        mount = mount_of(alignment.bench.setup.test)
        # first the line is turned level, then Z' into the normal of the plane of best focus
        normal = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
        axis = np.cross([0.0, 0.0, 1.0], normal)
        angle = np.arcsin(np.linalg.norm(axis))
        tilt = rotation_matrix(axis / np.linalg.norm(axis) * angle)
        turn = rotation_matrix(np.array([0.0, 0.0, -alignment.states[0].true_level]))
        moved = mount.holes @ (tilt @ turn).T + np.array([0.0, 0.0, piston])
        return np.asarray((moved - mount.holes) @ mount.normal)


def measured_defocus(state: FocusState) -> tuple[Array, Array]:
    """How far each CCD stands downstream of best focus by its MTF curves, and sigma, (N,), metres."""
    out = []
    for scan in state.scans:
        vertices = [focus_vertex(scan.shift[edge], scan.mtf[edge], scan.sigma[edge]) for edge in scan.shift]
        sigma = np.sqrt(sum(v.sigma**2 for v in vertices)) / len(vertices)
        out.append((np.mean([v.position for v in vertices]), sigma))
    where, sigmas = np.array(out).T
    return where, sigmas


def run(context: Context) -> Iterator[CheckResult]:
    """Align mis-set focal planes, one if only the MTF is wanted."""
    context.progress(0.0, "build the bench")
    with one_blas_thread():
        bench = FocusBench(resolve_focus(TEST), context.backend)
        if "004.alignment.coupling" in context.selected:
            yield evaluate_coupling(context.check("004.alignment.coupling"), bench)
            if len(context.selected) == 1:
                return
        alignments = measured_alignments(context, bench)
        for evaluate in (_mtf, _measured, _reached):
            yield from evaluate(context, alignments)


def measured_alignments(context: Context, bench: FocusBench) -> list[SimulatedFocus]:
    """Alignments from rendered edges."""
    count = context.count(ALIGNMENTS, FAST_ALIGNMENTS) if context.wants("004.alignment") else 1
    alignments = []
    for k, seed in enumerate(np.random.SeedSequence(context.seed).generate_state(count)):
        share = 0.1 + 0.9 * k / count
        context.progress(share, f"alignment {k + 1} of {count}")
        alignments.append(align(bench, int(seed)))
    return alignments


def _edges(alignment: SimulatedFocus, band: str) -> list[EdgeMtf]:
    """Edges along the track at the fields of a band, measured after the alignment."""
    noise, focus = alignment.bench.ccds[band].noise, alignment.states[-1].focus
    stacks = [f.frames[TRACK] for f, site in zip(focus, alignment.bench.sites, strict=True) if site.band == band]
    return [measure_edge(frames.mean(axis=0), noise=noise, frames=len(frames), even=True) for frames in stacks]


def _true_mtf(alignment: SimulatedFocus, band: str) -> float:
    """MTF of the traced pupils at the Nyquist frequency, along the track, where the chips stand after the alignment."""
    return alignment.states[-1].true_mtf[band]


def _losses(factors: Mapping[str, float], value: float) -> list[Chosen]:
    """An MTF's inputs that the paper does not print: the log of each factor goes as the square of its size, as that of
    small wavefront errors (Maréchal), of diffusion and of small motions does.
    """
    every = float(np.prod(list(factors.values())))
    wavefront = factors["wavefront"]
    return [
        Chosen("wavefront error as built, times", 1.0, "1", lambda factor: value * wavefront ** (factor**2 - 1.0)),
        Chosen(_ALL_LOSSES, 1.0, "1", lambda factor: value * every ** (factor**2 - 1.0)),
    ]


def _slope(edges: Sequence[EdgeMtf]) -> float:
    """Change of the logarithm of the frequency that has an MTF, per change of the MTF's logarithm; at Nyquist."""
    below, there = (float(np.mean([edge.at(share * NYQUIST)[0] for edge in edges])) for share in (0.9, 1.0))
    return float(np.log(1.0 / 0.9) / np.log(below / there))


def _mtf(context: Context, alignments: Sequence[SimulatedFocus]) -> Iterator[CheckResult]:
    if not context.wants(*(f"004.table1.{name}" for name in (*MTF_NYQUIST, "frequency"))):
        return
    alignment = alignments[0]
    true = {band: float(np.mean([_true_mtf(a, band) for a in alignments])) for band in MTF_NYQUIST}
    budget = {line.band: line.factors for line in alignment.bench.budget() if line.edge == TRACK}
    rows: list[list[Cell]] = []
    ratios, logs = [], []
    for band, printed in MTF_NYQUIST.items():
        edges = [edge for a in alignments for edge in _edges(a, band)]
        values, sigmas = np.array([edge.at(NYQUIST) for edge in edges]).T
        value, sigma = float(np.mean(values)), float(np.sqrt(np.sum(sigmas**2)) / len(sigmas))
        ratios.append([edge.frequency_at(printed)[0] / NYQUIST for edge in edges])
        factors = budget[band]
        perfect = factors["diffraction"] * factors["pixel"]
        rest = {name.replace("_", " "): v for name, v in factors.items() if name not in ("diffraction", "pixel")}
        numbers = (value, sigma, true[band], perfect, *rest.values())
        rows.append([band, f"{printed:.2f}", *(f"{number:.4f}" for number in numbers)])
        lost = ", ".join(f"{name} {v:.3f}" for name, v in rest.items())
        how = (
            f"{len(edges)} rendered slanted edges along the track, at {len(alignment.bench.setup.test.fields)} fields "
            f"after {_alignments(len(alignments)).lower()}; traced truth there {true[band]:.4f}. A perfect camera with "
            f"these pixels has {perfect:.3f}; what the scene file assumes beyond the paper takes the rest ({lost})."
        )
        yield context.check(f"004.table1.{band}").evaluate(value, sigma, how, inputs=_losses(rest, value))
        logs.append((_slope(edges), float(np.prod(list(rest.values())))))
    each = np.array(ratios)
    by_band = ", ".join(f"{band} {value:.3f}" for band, value in zip(MTF_NYQUIST, each.mean(axis=1), strict=True))
    how = (
        f"{each.size} rendered slanted edges; by band {by_band}. At half the Nyquist frequency the values would be far "
        "higher, at twice as much there is hardly any contrast left."
    )
    value, sigma = mean_of(each.mean(axis=1))
    slope, lost = np.mean(logs, axis=0)
    chosen = Chosen(_ALL_LOSSES, 1.0, "1", lambda factor: value * lost ** ((factor**2 - 1.0) * slope))
    yield context.check("004.table1.frequency").evaluate(value, sigma, how, 1.0, inputs=[chosen])
    context.table(
        "table1",
        "Table 1: MTF at the Nyquist frequency",
        "Along the track, mean over the fields. Perfect: diffraction and pixel alone, in the middle of the field; "
        "beside it the factors that make the difference.",
        ("band", "printed", "measured", "sigma", "true", "perfect", *rest),
        rows,
    )


def _measured(context: Context, alignments: Sequence[SimulatedFocus]) -> Iterator[CheckResult]:
    """What the analysis makes of the curves, against the traced pupils."""
    if not context.wants(*(f"004.alignment.{n}" for n in ("defocus", "plane", "constraint", "shims"))):
        return
    count, sites = len(alignments), len(alignments[0].bench.sites)
    looks = [(a.states[0], a.states[-1]) for a in alignments]
    error = np.array([[measured_defocus(state)[0] - state.true_defocus for state in pair] for pair in looks])
    before, after = (UM_PER_M * float(np.sqrt(np.mean(error[:, k] ** 2))) for k in (0, 1))
    span = UM_PER_M * float(np.max(np.abs([a.states[0].true_defocus for a in alignments])))
    how = (
        f"{_alignments(count)}, {sites} fields and bands, edges in two directions through focus: {before:.2f} µm RMS "
        f"before, where CCDs stand up to {span:.0f} µm off, {after:.2f} µm after; largest "
        f"{UM_PER_M * np.max(np.abs(error)):.1f} µm. Truth: focus of the traced pupils."
    )
    total = UM_PER_M * float(np.sqrt(np.mean(error**2)))
    yield context.check("004.alignment.defocus").evaluate(total, None, how, 0.0)
    plans = [Plan(a) for a in alignments]
    left = np.array([MM_PER_M * np.max(np.abs(p.left)) for p in plans])
    how = (
        f"{_alignments(count)}: plane through the measured defocus of the {sites} sites, the assembly moved by exactly "
        f"that: {_list(left, 4)} mm. What stays is how the chips were glued, and curvature of field."
    )
    moved = [(a, p.moved, a.states[0].standing.heights) for a, p in zip(alignments, plans, strict=True)]
    value = float(np.max(left))
    yield context.check("004.alignment.plane").evaluate(value, None, how, inputs=[_chips(moved)])
    turns = np.array([abs(line_turn(p.moved)) / ARCMIN for p in plans])
    begin = np.array([abs(a.states[0].true_level) / ARCMIN for a in alignments])
    how = f"{_alignments(count)}: before {_list(begin, 2)}′, after {_list(turns, 2)}′; the theodolite errs by 10″."
    value = float(np.max(turns))
    yield context.check("004.alignment.constraint").evaluate(value, None, how, inputs=[_theodolite(alignments, value)])
    asked = np.array([p.asked for p in plans])
    changes = np.array([p.shims.change for p in plans])
    alone = np.array([abs(p.shims.level_coupling) / ARCMIN for p in plans])
    how = (
        f"{_alignments(count)}, {asked.shape[1]} holes: changes up to {UM_PER_M * np.max(np.abs(asked)):.0f} µm. The "
        "surface of the mount is inclined, so that shims alone, without a turn by hand, would cost the line's level "
        f"{_list(alone, 2)}′."
    )
    value = UM_PER_M * float(np.sqrt(np.mean((changes - asked) ** 2)))
    yield context.check("004.alignment.shims").evaluate(value, None, how, 0.0)


def _chips(placed: Sequence[tuple[SimulatedFocus, Pose, Mapping[str, float]]]) -> Chosen:
    """How the line CCDs were glued, on which the largest distance from best focus hangs, millimetres."""
    flat, as_glued = (
        np.array([[s.defocus(pose, share * heights[s.band]) for s in a.bench.sites] for a, pose, heights in placed])
        for share in (0.0, 1.0)
    )
    spread = placed[0][0].bench.setup.test.misset.chips
    return Chosen(
        "scatter of the glued chips", UM_PER_M * spread, "µm",
        lambda factor: float(MM_PER_M * np.max(np.abs(flat + factor * (as_glued - flat)))),
    )  # fmt: skip


def _theodolite(alignments: Sequence[SimulatedFocus], value: float) -> Chosen:
    """What the line's turn is measured and set with, and is proportional to."""
    return Chosen.power(
        "error of the theodolite and of the setting", alignments[0].bench.setup.test.level / ARCSEC, "arcsec", value
    )


def _reached(context: Context, alignments: Sequence[SimulatedFocus]) -> Iterator[CheckResult]:
    """What the loop of measuring, shimming and measuring reaches."""
    if not context.wants(*(f"004.alignment.{n}" for n in ("confocal", "level", "rounds"))):
        return
    count = len(alignments)
    plan = alignments[0].bench.setup.test
    far = np.array([[MM_PER_M * np.max(np.abs(s.true_defocus)) for s in a.states] for a in alignments])
    turns = np.array([[abs(s.true_level) / ARCMIN for s in a.states] for a in alignments])
    sites = f"{_alignments(count)} of {len(alignments[0].bench.sites)} fields and bands, by the traced pupils"
    how = f"{sites}: before {_list(far[:, 0], 2)} mm, after {_list(far[:, -1], 4)} mm."
    after = [(a, a.states[-1].standing.pose, a.states[-1].standing.heights) for a in alignments]
    yield context.check("004.alignment.confocal").evaluate(float(np.max(far[:, -1])), None, how, inputs=[_chips(after)])
    how = (
        f"{_alignments(count)}: before {_list(turns[:, 0], 2)}′, after {_list(turns[:, -1], 2)}′; theodolite and "
        f"setting have {plan.level / ARCMIN:.2f}′ each."
    )
    value = float(np.max(turns[:, -1]))
    yield context.check("004.alignment.level").evaluate(value, None, how, inputs=[_theodolite(alignments, value)])
    kept = (far <= CONFOCAL_MM) & (turns <= LINE_LEVEL_ARCMIN)
    rounds = np.where(kept.any(axis=1), np.argmax(kept, axis=1), far.shape[1])
    more = [_second_round(a) for a in alignments]
    how = (
        f"{_alignments(count)}: {int(np.sum(rounds == 0))} needed none, {int(np.sum(rounds == 1))} needed one. A "
        f"second round would change a shim by {UM_PER_M * max(more):.1f} µm at most; shims are ground in steps of "
        f"{UM_PER_M * plan.mount.step:g} µm."
    )
    value = float(np.max(rounds))
    share = max(float(np.max(far[:, -1])) / CONFOCAL_MM, float(np.max(turns[:, -1])) / LINE_LEVEL_ARCMIN)
    chosen = Chosen("what one round leaves, times", 1.0, "1", lambda k: value if k * share <= 1.0 else value + 1.0)
    yield context.check("004.alignment.rounds").evaluate(value, None, how, inputs=[chosen])
    context.figure(
        "alignments",
        "One round of shims",
        "Every alignment before and after, true values. Grey: within what the paper reached.",
        alignment_svg(far, turns, CONFOCAL_MM, LINE_LEVEL_ARCMIN),
    )


def alignment_svg(far: NDArray[np.float64], turns: NDArray[np.float64], far_bound: float, turn_bound: float) -> str:
    """Alignments before and after.

    Args:
        far: largest distance from best focus of each state, mm, (A, S).
        turns: of the line, arcmin, (A, S).
        far_bound: what the paper reached, mm.
        turn_bound: what it reached, arcmin.
    """
    with look("alignments-004"):
        figure = new_figure(3.6)
        for axes, values, bound, label in zip(
            figure.subplots(1, 2),
            (far, turns),
            (far_bound, turn_bound),
            ("farthest CCD from best focus [mm]", "turn of the line [arcmin]"),
            strict=True,
        ):
            number = np.arange(1, len(values) + 1)
            axes.axhspan(1e-4, bound, color=LIGHT, alpha=0.6, lw=0)
            axes.vlines(number, values[:, -1], values[:, 0], color=LIGHT, lw=1.0)
            axes.plot(number, values[:, 0], "o", color=BEFORE, ms=6.0, mec=INK, mew=0.4, label="before")
            axes.plot(number, values[:, -1], "D", color=AFTER, ms=5.0, label="after one round")
            axes.set_yscale("log")
            axes.set_ylim(0.4 * float(np.min(values)), 2.5 * float(np.max(values)))
            axes.set_xlim(0.3, len(values) + 0.7)
            axes.set_xticks(number)
            axes.set_xlabel("alignment")
            axes.set_ylabel(label)
            plain_axes(axes)
        figure.axes[0].legend(loc="best")
        return to_svg(figure)


def _second_round(alignment: SimulatedFocus) -> float:
    """Largest change of a shim that the last measurement asks for, metres."""
    state = alignment.states[-1]
    where, sigma = measured_defocus(state)
    motion = fit_focal_plane(alignment.places, -where, sigma, estimate_extra=True).correction()
    present = alignment.shimmings[-1].plan.thickness
    return float(np.max(np.abs(shim_plan(motion, mount_of(alignment.test), present).change)))


def _alignments(count: int) -> str:
    return "One alignment" if count == 1 else f"{count} alignments"


def _list(values: Array, digits: int) -> str:
    """The values, or their range where there are many."""
    if len(values) > 4:
        return f"{np.min(values):.{digits}f} to {np.max(values):.{digits}f}"
    return ", ".join(f"{value:.{digits}f}" for value in values)


GROUP = group_of("004.focus", run)
