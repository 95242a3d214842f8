"""States of the pair's monitor: 2 cameras, 4 spots, 9 frames, centroids and all estimators; a batch, and one alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.units import ARCSEC
from optics.geometry.tree import Motion, State
from scenes.specs.instrument import BASE
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.monitor.observation import Observing, StateReader, observe, one_detector
from twin.sensors.poisson_numbers import poisson_numbers

STATES, QUICK_STATES = 200, 25
FRAMES = 9
ROUNDS = 5
PACE = pace(python=0.4, arithmetic=0.4, memory=0.2)
ALONE = pace(python=0.7, arithmetic=0.3)
DRAWN = pace(arithmetic=1.0)
WANTED_MS = 8.0
"""Processor time of a state of a batch."""


def random_states(count: int, seed: int) -> list[State]:
    """Both focal planes turned and shifted."""
    rng = np.random.default_rng(seed)

    def motion() -> Motion:
        x, y, z = 1e-5 * rng.normal(size=3)
        return Motion(rotate=(0.0, 0.0, 5 * ARCSEC * rng.normal()), shift=(x, y, z))

    return [{f"{BASE}/{c}/focal_plane": motion() for c in ("forward", "backward")} for _ in range(count)]


def measure(bench: Workbench, quick: bool) -> Speed:
    """Milliseconds per state, amortised over a batch; calibration and kernels are not what is timed."""
    setup = bench.experiment("gf7_pair")
    list(observe(setup, random_states(QUICK_STATES, 1), Observing(one_detector(setup, FRAMES, 1), stated=False)))
    count = QUICK_STATES if quick else STATES
    states = random_states(count, 2)

    def batch(_: Any) -> list[Any]:
        return list(observe(setup, states, Observing(one_detector(setup, FRAMES, 1), stated=False)))

    rounds = 1 if quick else ROUNDS
    spent = in_turns({"batch": Work(batch)}, rounds, bench.look)["batch"]
    assert sum(len(found.numbers) for found in spent.result) == count
    wall, cpu = 1e3 * spent.wall_s / count, 1e3 * spent.cpu_s / count
    reader = StateReader(setup, FRAMES, 1)

    def one(noise: bool) -> Work:
        return Work(lambda state: reader.read(state, noise), lambda: random_states(1, 3)[0], 1 if quick else 10)

    for noise in (True, False):
        reader.read(states[0], noise)
    alone = in_turns({"one": one(False), "frames": one(True)}, rounds, bench.look)
    light = setup.nominal_photons * setup.detector.quantum_efficiency
    rng = np.random.Generator(np.random.SFC64(1))
    drawn = in_turns(
        {"numbers": Work(lambda _: [poisson_numbers(one, FRAMES, rng) for one in light])}, rounds, bench.look
    )
    expected, noisy = (1e3 * alone[name].cpu_s for name in ("one", "frames"))
    numbers = 1e9 * drawn["numbers"].cpu_s / (FRAMES * light.size)
    return Speed(
        (
            Number("states_per_s", 1e3 / wall, f"monitor states, batch of {count}", "states/s", PACE, True, clock=True),
            Number("ms_per_state", wall, "  wall time of a state", "ms", PACE, limited=True, clock=True),
            Number("cpu_ms_per_state", cpu, "  processor time", "ms", PACE, limited=True, target=WANTED_MS),
            Number("one_ms", expected, "  one alone, expected images: processor time", "ms", ALONE, limited=True),
            Number("frames_ms", noisy, "  one alone, noisy frames: processor time", "ms", ALONE, limited=True),
            Number("poisson_ns", numbers, "  a Poisson number, processor time", "ns", DRAWN, limited=True),
        )
    )
