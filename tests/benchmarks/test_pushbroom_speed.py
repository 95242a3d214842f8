"""Speed of rendering images of the ground."""

import os
import time

import numpy as np
import pytest

from scenes.orbit_scene import ControlSpec, GroundSpec
from tests.twin.pushbroom_bench import LINES, PLACE, lines
from twin.orbit.images.patch import fly_patch

LIMIT_S = 60.0


@pytest.mark.slow
def test_a_large_patch(benchmark) -> None:
    """2000 x 2000 pixels in three lines, with ground and control, in less than 60 s on two cores: 120 s of work."""
    lines()
    begin, wall = os.times(), time.monotonic()
    size = (2000, 2000)
    patch = benchmark.pedantic(
        lambda: fly_patch(lines(), PLACE, size, GroundSpec(), ControlSpec(), np.random.SeedSequence(1)), rounds=1
    )
    end = os.times()
    spent = end.user + end.system - begin.user - begin.system
    benchmark.extra_info["cpu_s"], benchmark.extra_info["wall_s"] = spent, time.monotonic() - wall
    assert {patch.images[k].frame.shape for k in LINES} == {size}
    assert spent <= 2.0 * LIMIT_S, spent
