"""Checks of the focal-plane alignment of paper 004 (Li et al. 2020): coupling, MTF, accuracy and result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from analysis.arrays import ARCMIN, ARCSEC, MM_PER_M, UM_PER_M, Array
from analysis.focal_plane.plane_fit import RigidMotion, ShimPlan, fit_focal_plane, shim_plan
from analysis.focal_plane.through_focus import focus_vertex
from analysis.mtf.slanted_edge import EdgeMtf, slanted_edge_mtf
from analysis.statistics import rms
from optics.geometry.pose import Pose, rotation_matrix
from optics.numerics.backend import one_blas_thread
from scenes.specs.resolved import FocusSetup
from twin.framework.artefact import Cell
from twin.framework.svg import AFTER, BEFORE, INK, LIGHT
from twin.laboratory.focus_bench import NYQUIST, FocusBench
from twin.laboratory.focus_run import FocusState, SimulatedFocus, align, line_rotation, mount_of
from twin.targets.target_images import TRACK
from twin.validation.check import CheckResult, Chosen, mean_of
from twin.validation.group import Context, drawing, group_of, load_printed

MTF_NYQUIST = load_printed("004").numbers("table1.mtf_nyquist")
CONFOCAL_MM = load_printed("004").number("alignment.confocal_mm")
LINE_LEVEL_ARCMIN = load_printed("004").number("alignment.line_level_arcmin")
PARAMETERS = ("Δα", "Δβ", "Δγ", "Δx", "Δy", "Δz")
ADJUSTMENTS = ("tilt about the surface's x", "tilt about its y", "turn in it", "slide along x", "slide along y", "lift")
"""Names of the six adjustments of the mount: tilts and height are set by shims, the others by hand."""
LIMITS = np.array([10.0 * ARCSEC, 10.0 * ARCSEC, 10.0 * ARCSEC, 7e-6, 7e-6, 5e-6])
"""Smallest significant change of each of the six parameters, radians and metres.

They are the theodolite's 10 arcsec, a panchromatic pixel, and a step of the shims.
"""
TEST = "focus"
ALIGNMENTS, FAST_ALIGNMENTS = 12, 1
"""Numbers of simulated focal-plane alignments from random initial misalignments, in a full and in a fast run."""

_ALL_LOSSES = "what the scene file assumes beyond the paper, in waves, pixels or line periods, times"


def effects(bench: FocusBench, inclined: float = 1.0) -> Array:
    """Return the change of each of the focal plane's six parameters due to each of six adjustments, (6, 6).

    The unit is radians or metres. The size of each adjustment is the initial error of the assembly. The changes Δα, Δβ
    and Δz are those of the plane through the traced defocus of all sites; Δγ is the rotation of the line, Δx and Δy the
    displacement of its middle.

    Parameters
    ----------
    bench : FocusBench
        Bench with the mount.
    inclined : float
        Factor on the inclination of the mounting surface.
    """
    test = bench.setup.test
    surface = test.mount.model_copy(update={"tilt": inclined * test.mount.tilt})
    mount = mount_of(test.model_copy(update={"mount": surface}))
    up, centre = mount.normal, mount.holes.mean(axis=0)
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    size_rotation, size_shift = np.array(test.misset.rotate), np.array(test.misset.shift)
    none = np.zeros(3)
    steps = [(size * axis, none) for size, axis in zip(size_rotation, (x, y, up), strict=True)]
    steps += [(none, size * axis) for size, axis in zip(size_shift, (x, y, up), strict=True)]
    start = _parameters(bench, Pose(np.eye(3), none))
    out = []
    for vector, shift in steps:
        rotation = rotation_matrix(vector)
        pose = Pose(rotation, centre - rotation @ centre + shift)
        out.append(_parameters(bench, pose) - start)
    return np.array(out)


def _parameters(bench: FocusBench, pose: Pose) -> Array:
    defocus = np.array([site.defocus(pose, 0.0) for site in bench.sites])
    positions = np.array([site.place for site in bench.sites])
    piston, slope_x, slope_y = np.linalg.lstsq(np.column_stack([np.ones(len(positions)), positions]), defocus)[0]
    # a rotation (a, b, c) lifts a point by a Y' - b X'
    return np.array([slope_y, -slope_x, line_rotation(pose), *pose.translation[:2], piston])


def _coupling(context: Context, bench: FocusBench) -> CheckResult:
    """Check the paper's statement on how many parameters the adjustments of the mount couple."""
    change = effects(bench)
    tilt = float(np.degrees(bench.setup.test.mount.tilt))
    changed = "; ".join(
        f"{name} changes {', '.join(p for p, s in zip(PARAMETERS, row, strict=True) if s)}"
        for name, row in zip(ADJUSTMENTS, np.abs(change) > LIMITS, strict=True)
    )
    facts: dict[str, Any] = {
        "sites": bench.sites,
        "changed": changed,
        "lost": abs(change[0, 2] / change[0, 0]),
        "tilt": tilt,
    }
    chosen = Chosen("inclination of the mounting surface", tilt, "deg", lambda factor: coupled(effects(bench, factor)))
    row = "004.alignment.coupling"
    return context.row(row, coupled(change), explained=[3.0], inputs=[chosen], **facts)


def coupled(change: Array) -> float:
    """Return the number of parameters in the largest set that adjustments couple one after the other.

    ``change`` is the matrix that `effects` returns.
    """
    seen = np.abs(change) > LIMITS
    _, family = connected_components((seen.T @ seen).astype(float), directed=False)
    return float(np.bincount(family).max())


@dataclass(frozen=True, eq=False)
class Plan:
    """Correction of the focal plane planned from the MTF curves of an alignment's first state."""

    alignment: SimulatedFocus

    @cached_property
    def motion(self) -> RigidMotion:
        """Motion of the assembly that corrects the focal plane."""
        state = self.alignment.states[0]
        where, sigma = measured_defocus(state)
        # the plane wants how far best focus lies downstream of the CCD
        return fit_focal_plane(self.alignment.positions, -where, sigma, estimate_extra=True).correction(state.level)

    @cached_property
    def shims(self) -> ShimPlan:
        """Changes of the shims under the assembly that the correction requires."""
        test = self.alignment.bench.setup.test
        return shim_plan(self.motion, mount_of(test), np.full(len(test.mount.holes), test.mount.thickness))

    @cached_property
    def moved(self) -> Pose:
        """True pose of the assembly after exactly the planned motion."""
        return self.alignment.states[0].placement.pose @ Pose(self.motion.matrix, self.motion.shift)

    @property
    def residual(self) -> Array:
        """True defocus of the N sites after the planned motion, (N,), metres."""
        heights = self.alignment.states[0].placement.heights
        return np.array([site.defocus(self.moved, heights[site.band]) for site in self.alignment.bench.sites])

    @property
    def asked(self) -> Array:
        """Changes of the shims at H holes that the true defocus and line rotation require, (H,), metres."""
        alignment = self.alignment
        piston, slope_x, slope_y = alignment.true_plane(0)
        mount = mount_of(alignment.bench.setup.test)
        # first the line is turned level, then Z' into the normal of the plane of best focus
        normal = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
        axis = np.cross([0.0, 0.0, 1.0], normal)
        angle = np.arcsin(np.linalg.norm(axis))
        tilt = rotation_matrix(axis / np.linalg.norm(axis) * angle)
        rotation = rotation_matrix(np.array([0.0, 0.0, -alignment.states[0].true_level]))
        moved = mount.holes @ (tilt @ rotation).T + np.array([0.0, 0.0, piston])
        return np.asarray((moved - mount.holes) @ mount.normal)


def measured_defocus(state: FocusState) -> tuple[Array, Array]:
    """Return the measured defocus of the CCDs at N sites, downstream of best focus, and its sigma, (N,), metres.

    It is measured by MTF curves through focus.
    """
    out = []
    for scan in state.scans:
        vertices = [focus_vertex(scan.shift[edge], scan.mtf[edge], scan.sigma[edge]) for edge in scan.shift]
        sigma = np.sqrt(sum(v.sigma**2 for v in vertices)) / len(vertices)
        out.append((np.mean([v.position for v in vertices]), sigma))
    where, sigmas = np.array(out).T
    return where, sigmas


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the checks, from alignments with random misalignments.

    If only checks of the MTF are selected, a single alignment is simulated.
    """
    context.progress(0.0, "build the bench")
    with one_blas_thread():
        bench = FocusBench(FocusSetup.read(TEST), context.backend)
        if "004.alignment.coupling" in context.selected:
            yield _coupling(context, bench)
            if len(context.selected) == 1:
                return
        alignments = measured_alignments(context, bench)
        count = "One alignment" if len(alignments) == 1 else f"{len(alignments)} alignments"
        facts: dict[str, Any] = {"alignments": count, "sites": bench.sites}
        if context.wants(*(f"004.table1.{name}" for name in (*MTF_NYQUIST, "frequency"))):
            yield from _mtf(context, alignments, {**facts, "alignments": count.lower()})
        if context.wants(*(f"004.alignment.{name}" for name in ("defocus", "plane", "constraint", "shims"))):
            yield from _measured(context, alignments, facts)
        if context.wants(*(f"004.alignment.{name}" for name in ("confocal", "level", "rounds"))):
            yield from _reached(context, alignments, facts)


def measured_alignments(context: Context, bench: FocusBench) -> list[SimulatedFocus]:
    """Simulate alignments of the focal plane with rendered edges, each with its own random misalignment."""
    count = context.count(ALIGNMENTS, FAST_ALIGNMENTS) if context.wants("004.alignment") else 1
    alignments = []
    for k, seed in enumerate(np.random.SeedSequence(context.seed).generate_state(count)):
        share = 0.1 + 0.9 * k / count
        context.progress(share, f"alignment {k + 1} of {count}")
        alignments.append(align(bench, int(seed)))
    return alignments


def _edges(alignment: SimulatedFocus, band: str) -> list[EdgeMtf]:
    """Measure the MTF along the track from edges at the fields of a band, after the alignment."""
    noise, focus = alignment.bench.ccds[band].noise, alignment.states[-1].focus
    stacks = [f.frames[TRACK] for f, site in zip(focus, alignment.bench.sites, strict=True) if site.band == band]
    return [
        slanted_edge_mtf(frames.mean(axis=0), noise=noise, frames=len(frames), uniform_light=True) for frames in stacks
    ]


def _losses(factors: Mapping[str, float], value: float) -> list[Chosen]:
    """Return the factors of an MTF that the paper does not print, as inputs of the check.

    The logarithm of each factor is proportional to the square of its cause's size, as for small wavefront errors
    (Maréchal), diffusion and small motions.
    """
    product = float(np.prod(list(factors.values())))
    wavefront = factors["wavefront"]
    return [
        Chosen("wavefront error as built, times", 1.0, "1", lambda factor: value * wavefront ** (factor**2 - 1.0)),
        Chosen(_ALL_LOSSES, 1.0, "1", lambda factor: value * product ** (factor**2 - 1.0)),
    ]


def _slope(edges: Sequence[EdgeMtf]) -> float:
    """Return -d ln(frequency) / d ln(MTF) of the measured MTF curves at the Nyquist frequency."""
    below, there = (float(np.mean([edge.at(share * NYQUIST)[0] for edge in edges])) for share in (0.9, 1.0))
    return float(np.log(1.0 / 0.9) / np.log(below / there))


def _mtf(context: Context, alignments: Sequence[SimulatedFocus], facts: Mapping[str, Any]) -> Iterator[CheckResult]:
    alignment = alignments[0]
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
        # of the traced pupils, along the track, where the chips stand after the alignment
        true = float(np.mean([a.states[-1].true_mtf[band] for a in alignments]))
        rows.append([band, f"{printed:.2f}", *(f"{v:.4f}" for v in (value, sigma, true, perfect, *rest.values()))])
        more: dict[str, Any] = {
            "edges": edges,
            "fields": alignment.bench.setup.test.fields,
            "true": true,
            "perfect": perfect,
        }
        inputs = _losses(rest, value)
        yield context.row(f"004.table1.{band}", value, sigma, inputs=inputs, lost=rest, **facts, **more)
        logs.append((_slope(edges), float(np.prod(list(rest.values())))))
    each = np.array(ratios)
    bands = dict(zip(MTF_NYQUIST, each.mean(axis=1), strict=True))
    value, sigma = mean_of(each.mean(axis=1))
    slope, lost = np.mean(logs, axis=0)
    chosen = Chosen(_ALL_LOSSES, 1.0, "1", lambda factor: value * lost ** ((factor**2 - 1.0) * slope))
    yield context.row("004.table1.frequency", value, sigma, 1.0, inputs=[chosen], each=each, bands=bands)
    context.table("table1", rows)


def _measured(
    context: Context, alignments: Sequence[SimulatedFocus], facts: Mapping[str, Any]
) -> Iterator[CheckResult]:
    """Check the results of the through-focus analysis against those of the traced pupils."""
    looks = [(a.states[0], a.states[-1]) for a in alignments]
    error = np.array([[measured_defocus(state)[0] - state.true_defocus for state in pair] for pair in looks])
    span = [a.states[0].true_defocus for a in alignments]
    more: dict[str, Any] = {"before": error[:, 0], "after": error[:, 1], "error": error, "span": span}
    yield context.row("004.alignment.defocus", UM_PER_M * rms(error), None, 0.0, **facts, **more)
    plans = [Plan(a) for a in alignments]
    residual = np.array([MM_PER_M * np.max(np.abs(p.residual)) for p in plans])
    moved = [(a, p.moved, a.states[0].placement.heights) for a, p in zip(alignments, plans, strict=True)]
    more = {"left": _list(residual, 4)}
    yield context.row("004.alignment.plane", float(np.max(residual)), inputs=[_chips(moved)], **facts, **more)
    rotations = np.array([abs(line_rotation(p.moved)) / ARCMIN for p in plans])
    begin = np.array([abs(a.states[0].true_level) / ARCMIN for a in alignments])
    value = float(np.max(rotations))
    more = {"begin": _list(begin, 2), "rotations": _list(rotations, 2)}
    yield context.row("004.alignment.constraint", value, inputs=[_theodolite(alignments, value)], **facts, **more)
    asked, changes = (np.array(values) for values in ([p.asked for p in plans], [p.shims.change for p in plans]))
    alone = np.array([abs(p.shims.level_coupling) / ARCMIN for p in plans])
    more = {"holes": asked.shape[1], "asked": asked, "alone": _list(alone, 2)}
    yield context.row("004.alignment.shims", UM_PER_M * rms(changes - asked), None, 0.0, **facts, **more)


def _chips(poses: Sequence[tuple[SimulatedFocus, Pose, Mapping[str, float]]]) -> Chosen:
    """Return the glueing errors of the line CCDs, in millimetres, as an input that the paper does not print.

    The largest distance from best focus depends on them.
    """
    flat, as_glued = (
        np.array([[s.defocus(pose, share * heights[s.band]) for s in a.bench.sites] for a, pose, heights in poses])
        for share in (0.0, 1.0)
    )
    spread = poses[0][0].bench.setup.test.misset.chips
    return Chosen(
        "scatter of the glued chips", UM_PER_M * spread, "µm",
        lambda factor: float(MM_PER_M * np.max(np.abs(flat + factor * (as_glued - flat)))),
    )  # fmt: skip


def _theodolite(alignments: Sequence[SimulatedFocus], value: float) -> Chosen:
    """Return the error of measuring and setting the line's rotation as an input that the paper does not print.

    The result is proportional to it.
    """
    return Chosen.power(
        "error of the theodolite and of the setting", alignments[0].bench.setup.test.level / ARCSEC, "arcsec", value
    )


def _reached(context: Context, alignments: Sequence[SimulatedFocus], facts: Mapping[str, Any]) -> Iterator[CheckResult]:
    """Check the final result of repeated measuring and shimming."""
    plan = alignments[0].bench.setup.test
    far = np.array([[MM_PER_M * np.max(np.abs(s.true_defocus)) for s in a.states] for a in alignments])
    rotations = np.array([[abs(s.true_level) / ARCMIN for s in a.states] for a in alignments])
    ends = [(a, a.states[-1].placement.pose, a.states[-1].placement.heights) for a in alignments]
    more: dict[str, Any] = {"before": _list(far[:, 0], 2), "after": _list(far[:, -1], 4)}
    value = float(np.max(far[:, -1]))
    yield context.row("004.alignment.confocal", value, inputs=[_chips(ends)], **facts, **more)
    more = {"before": _list(rotations[:, 0], 2), "after": _list(rotations[:, -1], 2), "level": plan.level}
    value = float(np.max(rotations[:, -1]))
    yield context.row("004.alignment.level", value, inputs=[_theodolite(alignments, value)], **facts, **more)
    within_limits = (far <= CONFOCAL_MM) & (rotations <= LINE_LEVEL_ARCMIN)
    rounds = np.where(within_limits.any(axis=1), np.argmax(within_limits, axis=1), far.shape[1])
    more = {"none": np.sum(rounds == 0), "once": np.sum(rounds == 1), "step": plan.mount.step}
    more["again"] = [_second_round(a) for a in alignments]
    needed = float(np.max(rounds))
    share = max(float(np.max(far[:, -1])) / CONFOCAL_MM, float(np.max(rotations[:, -1])) / LINE_LEVEL_ARCMIN)
    chosen = Chosen("what one round leaves, times", 1.0, "1", lambda k: needed if k * share <= 1.0 else needed + 1.0)
    yield context.row("004.alignment.rounds", needed, inputs=[chosen], **facts, **more)
    context.figure("alignments", alignment_svg(far, rotations, CONFOCAL_MM, LINE_LEVEL_ARCMIN))


@drawing("alignments-004", 3.6)
def alignment_svg(
    figure: Figure, far: NDArray[np.float64], rotations: NDArray[np.float64], far_bound: float, rotation_bound: float
) -> None:
    """Draw the results of A alignments before and after, and those of the paper.

    Shown are the largest distance from best focus in each of S states, in mm, and the rotation of the line, in arcmin,
    both (A, S).
    """
    labels = ("farthest CCD from best focus [mm]", "turn of the line [arcmin]")
    panels = zip(figure.subplots(1, 2), (far, rotations), (far_bound, rotation_bound), labels, strict=True)
    for axes, values, bound, label in panels:
        number = np.arange(1, len(values) + 1)
        axes.axhspan(1e-4, bound, color=LIGHT, alpha=0.6, lw=0)
        axes.vlines(number, values[:, -1], values[:, 0], color=LIGHT, lw=1.0)
        axes.plot(number, values[:, 0], "o", color=BEFORE, ms=6.0, mec=INK, mew=0.4, label="before")
        axes.plot(number, values[:, -1], "D", color=AFTER, ms=5.0, label="after one round")
        axes.set_yscale("log")
        axes.set_ylim(0.4 * float(np.min(values)), 2.5 * float(np.max(values)))
        axes.set_xlim(0.3, len(values) + 0.7)
        axes.set_xticks(number)
        axes.set(xlabel="alignment", ylabel=label)
    figure.axes[0].legend(loc="best")


def _second_round(alignment: SimulatedFocus) -> float:
    """Return the largest change of a shim that the last measurement would still require, metres."""
    state = alignment.states[-1]
    where, sigma = measured_defocus(state)
    motion = fit_focal_plane(alignment.positions, -where, sigma, estimate_extra=True).correction()
    present = alignment.shimmings[-1].plan.thickness
    return float(np.max(np.abs(shim_plan(motion, mount_of(alignment.test), present).change)))


def _list(values: Array, digits: int) -> str:
    """Return the values as text, or their range if there are many."""
    if len(values) > 4:
        return f"{np.min(values):.{digits}f} to {np.max(values):.{digits}f}"
    return ", ".join(f"{value:.{digits}f}" for value in values)


GROUP = group_of("004.focus", run)
