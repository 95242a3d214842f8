"""Rendering images of the ground: a patch in three lines, with ground and control."""

from __future__ import annotations

import os
import time

import numpy as np

from scenes.specs.orbit.scene import ControlSpec, GroundSpec
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from tests.twin.pushbroom_bench import LINES, PLACE, lines
from twin.orbit.images.patch import fly_patch

SIZE, QUICK_SIZE = 2000, 200
PACE = pace(memory=0.5, python=0.25, arithmetic=0.25)
WANTED_CPU_S = 120.0
"""60 s on two cores."""


def measure(bench: Workbench, quick: bool) -> Speed:
    """Processor time, since others may use the machine too, and pixels per second as they went by."""
    lines()
    side = QUICK_SIZE if quick else SIZE
    begun, wall = os.times(), time.perf_counter()
    patch = fly_patch(lines(), PLACE, (side, side), GroundSpec(), ControlSpec(), np.random.SeedSequence(1))
    end, wall = os.times(), time.perf_counter() - wall
    assert {patch.images[k].frame.shape for k in LINES} == {(side, side)}
    spent = end.user + end.system - begun.user - begun.system
    text = f"pushbroom images, {len(LINES)} of {side} x {side} pixels"
    return Speed(
        (
            Number("pixels_per_s", len(LINES) * side * side / wall, text, "pixels/s", PACE, True, clock=True),
            Number("cpu_s", spent, "  processor time", "s", PACE, limited=True, target=None if quick else WANTED_CPU_S),
            Number("wall_s", wall, "  wall time", "s", PACE, clock=True),
        )
    )
