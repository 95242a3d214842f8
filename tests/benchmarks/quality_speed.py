"""Image quality of the stereo pair in many perturbed states, with the shadows of its bodies and without, in turns.

States come in blocks, as a study hands them over; processor time, since shadows add no work that the threads share.
"""

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
from twin.monitor.image_quality import quality_dicts
from twin.study.runs.render_base import BLOCK

BLOCKS, QUICK_BLOCKS = 4, 1
ROUNDS = 5
PACE = pace(python=0.4, arithmetic=0.4, memory=0.2)


def random_states(count: int, seed: int) -> list[State]:
    """Second and third mirrors off by 5 um and 2 arcsec, focal planes by 10 um and 5 arcsec."""
    rng = np.random.default_rng(seed)

    def motion(shift: float, turn: float) -> Motion:
        (x, y, z), (a, b, c) = shift * rng.normal(size=3), turn * ARCSEC * rng.normal(size=3)
        return Motion(rotate=(a, b, c), shift=(x, y, z))

    bodies = {"M2": (5e-6, 2.0), "M3": (5e-6, 2.0), "focal_plane": (1e-5, 5.0)}
    return [
        {f"{BASE}/{c}/{body}": motion(*errors) for c in ("forward", "backward") for body, errors in bodies.items()}
        for _ in range(count)
    ]


def measure(bench: Workbench, quick: bool) -> Speed:
    """States per second of all cameras together, and what shadows cost."""
    pair = bench.instrument("gf7_pair")
    blocks = [random_states(BLOCK, seed) for seed in range(QUICK_BLOCKS if quick else BLOCKS)]

    def all_blocks(obstruction: bool) -> Any:
        return [quality_dicts(pair, bench.backend, states, obstruction) for states in blocks]

    works = {"shadows": Work(lambda _: all_blocks(True)), "free": Work(lambda _: all_blocks(False))}
    in_turns(works, 1)  # compiles, and finds the bodies
    spent = in_turns(works, 1 if quick else ROUNDS, bench.look)
    lost = [s["cameras"]["forward"]["light_lost"]["centre"] for block in spent["shadows"].result for s in block]
    assert min(lost) > 0.05
    count = len(blocks) * BLOCK
    shadows, free = (spent[name] for name in ("shadows", "free"))
    return Speed(
        (
            Number(
                "states_per_s",
                count / shadows.wall_s,
                f"image quality with shadows, {BLOCK} at once",
                "states/s",
                PACE,
                True,
                clock=True,
            ),
            Number(
                "cpu_ms_per_state", 1e3 * shadows.cpu_s / count, "  processor time of a state", "ms", PACE, limited=True
            ),
            Number(
                "free_cpu_ms_per_state",
                1e3 * free.cpu_s / count,
                "  of a state without shadows",
                "ms",
                PACE,
                limited=True,
            ),
            Number("ratio_free", shadows.cpu_s / free.cpu_s, "  with shadows over without", limited=True),
        )
    )
