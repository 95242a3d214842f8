"""Time and memory of a block grow with its points, and no faster."""

import time
import tracemalloc

import numpy as np
import pytest

from analysis.block.block import Term
from analysis.block.block_adjustment import adjust_block
from analysis.block.processes import Law
from optics.numerics.threads import one_blas_thread
from tests.analysis.drawn_blocks import ARCSEC, Plan, draw

SIZES = (10_000, 20_000, 40_000)


@pytest.mark.slow
@one_blas_thread()
def test_time_and_memory_are_linear_in_points():
    laws = (
        Term(Law("tracker bias", "constant", (3 * ARCSEC,) * 3), "tracker"),
        Term(Law("attitude", "white", (0.5 * ARCSEC,) * 3, 0.5)),
        Term(Law("walk", "walk", (0.3 * ARCSEC,) * 3, 0.5)),
    )
    seconds, memory = [], []
    for ties in SIZES:
        drawn = draw(Plan(ties=ties, attitude=laws, terrain=None, footprints=0), np.random.default_rng(1))
        tracemalloc.start()
        clock = time.process_time()
        found = adjust_block(drawn.block)
        seconds.append(time.process_time() - clock)
        memory.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert found.p_value > 1e-4

    # four times the points: at most five times the time and the memory, whatever does not grow with them
    assert seconds[2] < 5.0 * seconds[0]
    assert memory[2] < 5.0 * memory[0]
    # from the second size on, what a point takes falls or stays: 30% for the clock of a busy machine
    assert seconds[2] / SIZES[2] < 1.3 * seconds[1] / SIZES[1]
    assert memory[2] / SIZES[2] < 1.1 * memory[1] / SIZES[1]
