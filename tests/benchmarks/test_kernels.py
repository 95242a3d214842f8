"""What speed rests on and can be told without a clock: kernels compiled once."""

import drjit as dr
import pytest

from tests.benchmarks.monitor_speed import random_states
from twin.monitor.truth import trace_truth


@pytest.mark.second
def test_other_numbers_compile_no_new_kernel(experiment, backend) -> None:
    setup = experiment("gf7_pair")

    def work(seed: int) -> None:
        states = random_states(5, seed)
        setup.path.expected_photons(states)
        trace_truth(setup.instrument, backend, states)

    work(1)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work(2)
        launched = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(launched) > 5
    assert all(kernel["cache_hit"] for kernel in launched)
