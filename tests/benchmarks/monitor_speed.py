"""States of the pair's monitor: 2 cameras, 4 spots, 9 frames, centroids and all estimators; a batch, and one alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from optics.geometry.tree import Motion, State
from scenes.specs.instrument import BASE
from tests.benchmarks.workbench import Number, Speed, Work, Workbench, in_turns
from twin.monitor.observation import ObservationOptions, StateReader, observe, shared_detector
from twin.sensors.poisson_numbers import poisson_pieces

STATES, QUICK_STATES = 200, 25
FRAMES = 9
ROUNDS = 5


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
    list(
        observe(
            setup,
            random_states(QUICK_STATES, 1),
            ObservationOptions(shared_detector(setup, FRAMES, 1), use_prior=False),
        )
    )
    count = QUICK_STATES if quick else STATES
    states = random_states(count, 2)

    def batch(_: Any) -> list[Any]:
        return list(observe(setup, states, ObservationOptions(shared_detector(setup, FRAMES, 1), use_prior=False)))

    rounds = 1 if quick else ROUNDS
    spent = in_turns({"batch": Work(batch)}, rounds)["batch"]
    assert sum(len(found.numbers) for found in spent.result) == count
    wall, cpu = 1e3 * spent.wall_s / count, 1e3 * spent.cpu_s / count
    reader = StateReader(setup, FRAMES, 1)

    def one(noise: bool) -> Work:
        return Work(lambda state: reader.read(state, noise), lambda: random_states(1, 3)[0], 1 if quick else 10)

    for noise in (True, False):
        reader.read(states[0], noise)
    alone = in_turns({"one": one(False), "frames": one(True)}, rounds)
    light = setup.nominal_photons * setup.detector.quantum_efficiency
    rng = np.random.Generator(np.random.SFC64(1))
    numbers = Work(lambda _: [list(poisson_pieces(mean, FRAMES, rng, FRAMES)) for mean in light])
    drawn = in_turns({"numbers": numbers}, rounds)
    expected, noisy = (1e3 * alone[name].cpu_s for name in ("one", "frames"))
    each = 1e9 * drawn["numbers"].cpu_s / (FRAMES * light.size)
    return Speed(
        (
            Number("states_per_s", 1e3 / wall, f"monitor states, batch of {count}", "states/s"),
            Number("ms_per_state", wall, "  wall time of a state", "ms"),
            Number("cpu_ms_per_state", cpu, "  processor time", "ms"),
            Number("one_ms", expected, "  one alone, expected images: processor time", "ms"),
            Number("frames_ms", noisy, "  one alone, noisy frames: processor time", "ms"),
            Number("poisson_ns", each, "  a Poisson number, processor time", "ns"),
        )
    )
