"""The live twin: from a state that is sent to the server's answer."""

from __future__ import annotations

import time

import numpy as np

from tests.benchmarks.workbench import Number, Speed, Workbench
from tests.twin.live_client import connect, numbered, state
from tests.twin.live_page import Command, running

KNOB, FAR = "base/forward/M2 shift z", 3.0
"""What is moved, and how far: the light of one camera, as nearly all knobs do."""
OF_ALL, WARM = "base temperature", 0.1
"""The light of all cameras, and every body of both."""
WARM_UP = 5
"""States that are not counted: the first ones compile kernels."""


def measure(bench: Workbench, quick: bool) -> Speed:
    """Milliseconds of the server's answers."""
    with running("gf7_pair", "--port", "0", "--stay") as command:
        numbers = _answers(command, 40 if quick else 300)
        command.end()  # by itself, so that its time is not counted as that of other programs
    return Speed(numbers)


def _answers(command: Command, moves: int) -> tuple[Number, ...]:
    """The server's answers to states that follow each other as those of a slider do."""
    kinds = (
        ("answer_ms", KNOB, FAR, 0, "a state sent to the server's answer, expected image: median"),
        ("answer_all_ms", OF_ALL, WARM, 0, "  the base warmed, and with it every body"),
        ("answer_noisy_ms", KNOB, FAR, 9, "  with 9 noisy frames, all estimators"),
    )
    out, number = [], 0
    with connect(*command.place) as line:
        for key, knob, far, frames, text in kinds:
            took = []
            for k in range(moves + WARM_UP):
                number += 1
                asked = {knob: far * float(np.sin(k / 5))}
                begun = time.perf_counter()
                line.send(state(number, knobs=asked, noise=frames > 0, frames=max(1, frames), seed=5))
                while isinstance(told := line.recv(120.0), str) or numbered(told) != number:
                    pass
                took.append(time.perf_counter() - begun)
                time.sleep(0.02)
            median = 1e3 * float(np.median(took[WARM_UP:]))
            out.append(Number(key, median, text, "ms"))
    return tuple(out)
