"""A budget for a monitor state: the work that each of its parts must do, what it takes, and its share of the machine.

The peaks are measured in the same run on one core: a loop of fused multiply-adds in registers, and a copy of arrays
that no cache holds. The least time of a part is the longer one of its operations at the first and its bytes at the
second; its share of the peak is that over the processor time it takes. Operations are counted in the formulas, in
float64 (transcendental functions as eight, random words as ten and normal numbers as fifteen), and bytes are those that
a part must read and write once. So a share says how far a part is from what the machine could do, whatever else the
machine does: both times are processor times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.monitor.recovery import measure_spots, recovery_of
from analysis.spots.centroid import mean_frames
from analysis.spots.fit_state import fit_states, widened
from analysis.spots.spot_positions import difference_covariance
from optics.geometry.tree import Motion, State
from optics.numerics.threads import one_blas_thread, one_kernel_thread
from optics.raytrace.assembly import Interaction
from optics.raytrace.element_numbers import Structure
from optics.raytrace.system import assemble
from optics.raytrace.trace import FURTHER_STEPS, NEWTON_STEPS
from optics.waves.diffraction import image
from optics.waves.field_samples import FieldSamples
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import COPY_BYTES, FMA_FLOPS, copy, fused_multiplies, pace
from twin.monitor.image_sampling import disagreement
from twin.monitor.monitor_beams import MAP_TERMS
from twin.monitor.monitor_experiment import MonitorExperiment

STATES, QUICK_STATES = 40, 8
FRAMES, SEED = 9, 1
ROUNDS, QUICK_ROUNDS = 5, 1
PACE = pace(python=0.4, arithmetic=0.4, memory=0.2)
TURN, SHIFT = 1e-6, 2e-7
"""Motions of every body, radians and metres rms."""
_FUNCTION, _WORD, _NORMAL = 8, 10, 15


def moving_states(experiment: MonitorExperiment, count: int, seed: int) -> list[State]:
    """States in which every body moves but the base."""
    rng = np.random.default_rng(seed)
    paths = [body.path for body in experiment.instrument.assembly.tree.bodies if body.parent]

    def motion() -> Motion:
        turn, shift = TURN * rng.normal(size=3), SHIFT * rng.normal(size=3)
        return Motion(rotate=(turn[0], turn[1], turn[2]), shift=(shift[0], shift[1], shift[2]))

    return [{path: motion() for path in paths} for _ in range(count)]


@dataclass(frozen=True)
class Part:
    """One part of a state.

    Attributes:
        key, text: its name.
        flops, bytes: that a state must have.
        do: works on all states of the batch.
    """

    key: str
    text: str
    flops: float
    bytes: float
    do: Callable[[Any], Any]


def peaks(rounds: int) -> tuple[float, float]:
    """Operations a second of one core by fused multiply-adds, and bytes a second of one copy, by processor time."""
    multiply, copied = fused_multiplies(), copy()
    works = {"fma": Work(lambda _: multiply(), repeats=50), "copy": Work(lambda _: copied(), repeats=5)}
    with one_kernel_thread():
        spent = in_turns(works, rounds)
    return FMA_FLOPS / spent["fma"].cpu_s, COPY_BYTES / spent["copy"].cpu_s


def crossing_flops(structure: Structure) -> float:
    """Operations by which a ray passes one element: into its frame, to its surface, and on."""
    lens = structure.even and structure.interaction is Interaction.REFRACT
    level = 16.0 + 4.0 * structure.even + (structure.figure_order + 1.0) * (structure.figure_order + 2.0)
    out = 33.0 + (12.0 if structure.plane else 40.0) + (10.0 if structure.aperture is not None else 0.0)
    if structure.even or structure.figure_order >= 0 or structure.terms:
        steps = NEWTON_STEPS + (FURTHER_STEPS if structure.terms or lens else 0) + 1
        out += steps * (level + 14.0)
    if structure.interaction is Interaction.PASS:
        return out
    return out + level + (40.0 if structure.interaction is Interaction.REFRACT else 22.0)


def parts_of(experiment: MonitorExperiment, states: Sequence[State]) -> tuple[list[Part], Callable[[Any], Any]]:
    """The parts of states in their order, each on what the one before gave, and all of them in one."""
    path, count, channels = experiment.path, len(states), len(experiment.path.channels)
    tree = experiment.instrument.assembly
    placed = tree.place(states)
    known = path.coarse_trace(states, placed)
    number = int(np.median(path.class_of(known)))  # a few spots far off have more nodes
    beams = path.class_beams(number)
    rays = beams.rays(states, known)
    second = path._second_field(states, known, number)
    field, response = beams.field_of(rays), path._response_of(known)
    y, x = (path.grid(axis, response.reach) for axis in (0, 1))
    waves = image(field, x, y, True)
    photons = response.apply(waves).reshape(channels, count, *path.shape).swapaxes(0, 1)
    photons = photons * path.light_per_pixel[:, None, None]
    before = experiment.frames_before(FRAMES, SEED)
    after = experiment.frames_after(photons, FRAMES, SEED)
    calibration = experiment.calibration

    def spots(frames: np.ndarray) -> Any:
        mean = mean_frames(frames)
        return measure_spots(mean.reshape(-1, *mean.shape[-2:]), FRAMES, calibration)

    first, then = (widened(one, fit_states(one).widening) for one in (spots(before), spots(after)))

    def estimated(_: Any) -> Any:
        spread = difference_covariance(first, then, calibration.noise)
        return recovery_of(first, then, spread, calibration)

    def second_rays(_: Any) -> Any:
        return path._second_field(states, known, number)

    def systems(_: Any) -> Any:
        here = tree.place(states)
        names = [[f"{c.key}/{way}" for c in path.channels] for way in ("outgoing", "monitor")]
        return [assemble(tree, own, states, placed=here) for own in names]

    pixels, size = path.shape[0] * path.shape[1], waves.shape[1] * waves.shape[2]
    nodes, others, scouts = (n.nodes.count * channels for n in (beams, path._second[number], path.scout))
    way = sum(crossing_flops(one) for one in known.back.structure)
    out = sum(crossing_flops(one) for one in known.outgoing.structure)
    bodies = len(tree.tree.bodies)
    loaded = 40.0 * 8.0 * channels * (len(known.back.structure) + len(known.outgoing.structure))
    k = 2.0 * np.pi / field.wavelength
    width = [0.5 * k * path.pitch * float(np.max(np.ptp(cosine, axis=1))) for cosine in (field.u, field.v)]
    samples = [FieldSamples.of(g.count, w, True) for g, w in zip((x, y), width, strict=True)]
    columns, rows = (g.count if s is None else s.count for g, s in zip((x, y), samples, strict=True))
    sum_flops = nodes * (3.0 * 2.0 * _FUNCTION + 6.0 * (columns + 0.5 * rows) + 4.0 * rows * columns)
    sum_flops += channels * (4.0 * y.count * rows * columns + 4.0 * y.count * columns * x.count + 4.0 * size)
    rank = calibration.template.row_factors.shape[-1]
    step = pixels * (6.0 * rank + 8.0 + 12.0 + 2.0 * 16.0 + 8.0)
    correlation = 3.0 * 2.5 * pixels * np.log2(pixels) + 6.0 * pixels
    fit = channels * (2.0 * step * (1.0 + 1.0 / 9.0) + correlation + pixels * 40.0)
    chief = len(experiment.instrument.cameras) * 41.0
    maps = 8.0 * 2.0 * MAP_TERMS + 30.0
    drawn = channels * pixels * FRAMES
    parts = [
        Part("place", "bodies placed, numbers of systems", bodies * 300.0, bodies * 13.0 * 8.0 + loaded, systems),
        Part(
            "aim",
            "rays aimed at the return faces",
            scouts * (3.0 * out + way + 60.0),
            scouts * 13.0 * 8.0 + loaded,
            lambda _: path.coarse_trace(states, placed),
        ),
        Part(
            "trace",
            "rays of the images traced",
            nodes * (way + 60.0),
            nodes * 15.0 * 8.0,
            lambda _: beams.rays(states, known),
        ),
        Part("wave", "wavefronts", nodes * maps, nodes * 12.0 * 8.0, lambda _: beams.field_of(rays)),
        Part(
            "second",
            "second rays that check them",
            others * (way + 60.0 + maps),
            others * 15.0 * 8.0,
            second_rays,
        ),
        Part(
            "sum",
            "Fourier sums",
            sum_flops,
            nodes * 4.0 * 8.0 + channels * size * 8.0,
            lambda _: image(field, x, y, True),
        ),
        Part(
            "check",
            "16 pixels of each image again",
            others * (8.0 * (2.0 * _FUNCTION + 10.0) + 16.0 * 8.0),
            others * 4.0 * 8.0 + channels * size * 8.0,
            lambda _: disagreement(waves, second, x, y),
        ),
        Part(
            "pixels",
            "pixel response",
            2.0 * channels * pixels * float(response.kernel.size),
            channels * (size + pixels) * 8.0,
            lambda _: response.apply(waves),
        ),
        Part(
            "expose",
            f"{FRAMES} frames exposed",
            drawn * (_WORD + _WORD + _NORMAL + 12.0),
            drawn * 2.0 + channels * pixels * 24.0,
            lambda _: experiment.frames_after(photons, FRAMES, SEED),
        ),
        Part("fit", "means and spots fitted", fit, drawn * 2.0 + channels * pixels * 4.0 * 8.0, lambda _: spots(after)),
        Part(
            "estimate",
            "covariances and all estimators",
            channels * pixels * 20.0 + 20_000.0,
            channels * pixels * 3.0 * 8.0,
            estimated,
        ),
        Part(
            "truth",
            "chief rays of the line CCDs",
            chief * 8.0 * 150.0,
            chief * 13.0 * 8.0,
            lambda _: experiment.sight.truth(states, placed),
        ),
    ]

    def all_of_it(_: Any) -> Any:
        from twin.monitor.observation import Observing, observe

        def record(light: np.ndarray, numbers: np.ndarray) -> tuple[Any, np.ndarray]:
            return measured, experiment.frames_after(light, FRAMES, SEED, numbers)

        return list(observe(experiment, states, Observing(record, chunk=count, stated=False)))

    measured = (first, fit_states(first).reshaped(channels))
    return parts, all_of_it


def table(parts: Sequence[Part], spent: Mapping[str, float], flops: float, copied: float) -> list[Number]:
    """Milliseconds of processor time and share of the peak of each part.

    Args:
        parts: of a state.
        spent: seconds of a state by the parts' keys.
        flops: a second at the peak.
        copied: bytes a second likewise.
    """
    numbers = []
    for part in parts:
        least = max(part.flops / flops, part.bytes / copied)
        what = f"  {part.text} ({1e-6 * part.flops:.3g} Mflop, {1e-6 * part.bytes:.2g} MB)"
        numbers.append(Number(f"{part.key}_ms", 1e3 * spent[part.key], what, "ms", PACE))
        numbers.append(Number(f"{part.key}_share", least / spent[part.key], "    share of the peak", least=True))
    return numbers


def measure(bench: Workbench, quick: bool) -> Speed:
    """Processor time of each part of a state with nine noisy frames in which every body moves, and of a whole one."""
    experiment = bench.experiment("gf7_pair")
    count, rounds = (QUICK_STATES, QUICK_ROUNDS) if quick else (STATES, ROUNDS)
    states = moving_states(experiment, count, 2)
    with ExitStack() as stack:
        stack.enter_context(one_blas_thread())
        stack.enter_context(one_kernel_thread())
        parts, whole = parts_of(experiment, states)
        works = {part.key: Work(part.do) for part in parts}
        for work in (whole, *(one.do for one in works.values())):
            work(None)
        flops, copied = peaks(rounds)
        spent = in_turns({**works, "whole": Work(whole)}, rounds, bench.look)
    seconds = {key: one.cpu_s / count for key, one in spent.items()}
    together = sum(seconds[part.key] for part in parts)
    least = sum(max(part.flops / flops, part.bytes / copied) for part in parts)
    head = (
        Number(
            "flops_per_s", flops, "peak of one core: fused multiply-adds in registers, float64", "flop/s", least=True
        ),
        Number("bytes_per_s", copied, "  copy, read and written", "B/s", least=True),
        Number(
            "cpu_ms_per_state",
            1e3 * seconds["whole"],
            f"a state of {count}, every body moving",
            "ms",
            PACE,
            limited=True,
        ),
        Number("parts_ms", 1e3 * together, "  all parts, each by itself", "ms", PACE),
        Number("least_ms", 1e3 * least, "  at the peak", "ms", PACE),
        Number("share", float(least / seconds["whole"]), "  share of the peak", least=True, limited=True),
    )
    return Speed((*head, *table(parts, seconds, flops, copied)))
