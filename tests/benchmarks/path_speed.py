"""Path tracer: paths per second through three mirrors, and out and back through all prisms; time for stray light.

A path per second of two cores is counted in the processor time of all threads: what the neighbours on a shared machine
take does not count.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from scenes.models.instrument_model import Instrument
from scenes.models.scenery import build_scenery
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.workbench import Workbench
from tests.twin.path_bench import IDEAL, scene_beam
from twin.path_tracing.families import nominal_codes
from twin.path_tracing.source import DiskSource
from twin.path_tracing.stray_light import monitor_families, pinhole, trace_stray
from twin.path_tracing.tracer import PathTracer

PATHS, PATHS_BACK, QUICK_PATHS = 1 << 19, 1 << 18, 1 << 15
CORES = 2
ROUNDS = 7
STRAY_PATHS, STRAY_SIGMA = 1 << 19, 1e-7
"""Paths of one source, and the standard deviation, in spots, that its stray light on its area CCD is to have."""


def imaging(bench: Workbench, chosen: Instrument, paths: int) -> Callable[[int], Any]:
    """Light of a far point into the forward camera; most of it has to reach the focal plane."""
    scenery = build_scenery(chosen, {}, IDEAL, whole_focal_planes=True)
    detector = "forward/focal_plane"
    tracer = PathTracer(bench.backend, scenery, {detector: nominal_codes(scenery, chosen.assembly, "forward/imaging")})
    middle, heading, across = scene_beam(chosen, bench.backend)
    source = DiskSource(middle, heading, across, 0.28)

    def work(seed: int) -> Any:
        return tracer.run(source, paths, seed)

    assert work(0).nominal(detector).count > 0.8 * paths  # the prisms stand in the rest
    return work


def out_and_back(bench: Workbench, chosen: Instrument, paths: int) -> Callable[[int], Any]:
    """Light of a reticle through camera and prisms and back, 25 surfaces; all paths go into the return face."""
    channel = chosen.channels[0]
    scenery = build_scenery(chosen, {}, IDEAL)
    tracer = PathTracer(bench.backend, scenery, monitor_families(scenery, chosen))
    wide = pinhole(chosen, bench.backend, {}, channel)
    assert wide.narrow is not None
    source = DiskSource(wide.centre, wide.axis, wide.across, wide.radius, wide.cone, wide.narrow, 1.0 - 1e-9)

    def work(seed: int) -> Any:
        return tracer.run(source, paths, seed)

    assert work(0).nominal(f"{channel.key}/area_ccd").count > 0.6 * paths
    return work


def stray(bench: Workbench, chosen: Instrument, paths: int) -> Callable[[int], float]:
    """Relative variance of the stray light of a source on its area CCD, in spots squared."""
    channel = chosen.channels[0]
    name = f"{channel.key}/area_ccd"

    def work(seed: int) -> float:
        run = trace_stray(chosen, bench.backend, {}, paths, seed, channels=[channel]).runs[channel.key]
        errors = [f.error for f in run.families if f.detector == name and f.kind != "nominal"]
        return float(np.sum(np.square(errors))) / run.nominal(name).energy ** 2

    work(0)
    return work


def measure(bench: Workbench, quick: bool) -> Speed:
    """Paths per second of two cores, and processor time for a standard deviation of stray light."""
    numbers = []
    chosen = bench.instrument("gf7_pair")
    for name, prepare, full in (("imaging", imaging, PATHS), ("out_and_back", out_and_back, PATHS_BACK)):
        paths = QUICK_PATHS if quick else full
        run, seeds = prepare(bench, chosen, paths), itertools.count()
        work = Work(lambda _, run=run, seeds=seeds: run(next(seeds)))
        spent = in_turns({"paths": work}, 1 if quick else ROUNDS)["paths"]
        text = f"paths of gf7_pair, {name.replace('_', ' ')}, two cores"
        numbers.append(Number(f"{name}_paths_per_s", paths * CORES / spent.cpu_s, text, "paths/s"))
    faint, seeds = stray(bench, chosen, QUICK_PATHS if quick else STRAY_PATHS), itertools.count()
    spent = in_turns({"stray": Work(lambda _: faint(next(seeds)))}, 1 if quick else ROUNDS)["stray"]
    text = f"processor time for stray light of one source to {STRAY_SIGMA:g} of a spot"
    seconds = spent.cpu_s * spent.result / STRAY_SIGMA**2
    numbers.append(Number("stray_s", seconds, text, "s"))
    return Speed(tuple(numbers))
