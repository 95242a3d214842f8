"""Path tracer: paths per second through three mirrors, and out and back through all prisms.

A path per second of two cores is counted in the processor time of all threads: what the neighbours on a shared machine
take does not count.
"""

from __future__ import annotations

import time

import pytest

from scenes.scene_surface import IDEAL
from scenes.scenery import build_scenery
from tests.twin.path_bench import scene_beam
from twin.path_tracing.families import nominal_codes
from twin.path_tracing.source import DiskSource
from twin.path_tracing.stray import monitor_families, pinhole
from twin.path_tracing.tracer import PathTracer

PATHS = 1 << 19
PATHS_BACK = 1 << 18
CORES = 2
ROUNDS = 2
MOST_ROUNDS = 15
"""More rounds while a machine that others use too keeps the caches warm for them."""

LEAST_IMAGING = 3.0e6
LEAST_OUT_AND_BACK = 0.5e6


def fastest(work, paths: int, least: float) -> float:
    """Paths per second of two cores, the best of some rounds."""
    best = 0.0
    for turn in range(MOST_ROUNDS):
        start = time.process_time()
        work(turn)
        best = max(best, paths * CORES / (time.process_time() - start))
        if turn + 1 >= ROUNDS and best > 1.05 * least:
            break
    return best


@pytest.mark.parametrize("name", ["gf7_pair", "monitor_pair"])
def test_three_mirrors(benchmark, backend, instrument, name: str) -> None:
    chosen = instrument(name)
    scenery = build_scenery(chosen, {}, IDEAL, whole_focal_planes=True)
    detector = "forward/focal_plane"
    tracer = PathTracer(backend, scenery, {detector: nominal_codes(scenery, chosen.assembly, "forward/imaging")})
    middle, heading, across = scene_beam(chosen, backend)
    source = DiskSource(middle, heading, across, 0.28)

    def work(seed: int = 0):
        return tracer.run(source, PATHS, seed, look_up=0)

    result = work()
    assert result.nominal(detector).count > 0.8 * PATHS  # the prisms stand in the rest
    rate = fastest(work, PATHS, LEAST_IMAGING)
    benchmark.pedantic(work, rounds=1)
    benchmark.extra_info["paths_per_second_of_two_cores"] = rate
    assert rate > LEAST_IMAGING


@pytest.mark.parametrize("name", ["gf7_pair", "monitor_pair"])
def test_out_and_back_through_prisms(benchmark, backend, instrument, name: str) -> None:
    chosen = instrument(name)
    channel = chosen.channels[0]
    scenery = build_scenery(chosen, {}, IDEAL)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, chosen))
    wide = pinhole(chosen, backend, {}, channel)
    assert wide.narrow is not None
    # all paths into the return face: 25 surfaces each
    source = DiskSource(wide.centre, wide.axis, wide.across, wide.radius, wide.cone, wide.narrow, 1.0 - 1e-9)

    def work(seed: int = 0):
        return tracer.run(source, PATHS_BACK, seed, look_up=0)

    assert work().nominal(f"{channel.key}/area_ccd").count > 0.6 * PATHS_BACK
    rate = fastest(work, PATHS_BACK, LEAST_OUT_AND_BACK)
    benchmark.pedantic(work, rounds=1)
    benchmark.extra_info["paths_per_second_of_two_cores"] = rate
    assert rate > LEAST_OUT_AND_BACK
