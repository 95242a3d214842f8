"""The live twin: from a state that is sent to the server's answer, and where there is Chromium, from the touch of a
slider to painted spots and readings, in a browser beside it on the same cores.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from tests.twin.live_client import connect, numbered, state
from tests.twin.live_page import CHROMIUM, FLAGS, Command, Page, running

KNOB, FAR = "base/forward/M2 shift z", 3.0
"""What is moved, and how far: the light of one camera, as nearly all knobs do."""
OF_ALL, WARM = "base temperature", 0.1
"""The light of all cameras, and every body of both."""
WARM_UP = 5
"""States that are not counted: the first ones compile kernels."""
MOVE = """async ([count, knob, far]) => {
  const slider = document.querySelector(`#tree .knob[data-knob="${knob}"] input[type=range]`);
  const from = liveTwin.latencies.length;
  for (let k = 0; k < count; k += 1) {
    // told, not asked for again and again: a page that asks takes the time that it measures
    const painted = new Promise((done) => {
      liveTwin.painted = (told) => {
        Object.getPrototypeOf(liveTwin).painted.call(liveTwin, told);
        if (told.n === liveTwin.n && !liveTwin.dirty) done();
      };
    });
    slider.value = far * Math.sin(k / 5);
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    await painted;
    await new Promise((next) => setTimeout(next, 20));
  }
  delete liveTwin.painted;
  return liveTwin.latencies.slice(from);
}"""
DRAG = """async ([seconds, knob, far]) => {
  const slider = document.querySelector(`#tree .knob[data-knob="${knob}"] input[type=range]`);
  const end = performance.now() + 1000 * seconds;
  const from = liveTwin.latencies.length;
  for (let k = 0; performance.now() < end; k += 1) {
    slider.value = far * Math.sin(k / 20);
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    await new Promise((next) => setTimeout(next, 16));
  }
  return liveTwin.latencies.length - from;
}"""


def measure(bench: Workbench, quick: bool) -> Speed:
    """Milliseconds of the server's answers, and in the page's own clock from the input event to the task after the
    frame that shows the answer.
    """
    moves, seconds = (40, 2.0) if quick else (300, 8.0)
    with running("gf7_pair", "--port", "0", "--stay") as command:
        numbers = _answers(command, moves)
        if CHROMIUM is not None:
            numbers += _painted(command, moves, seconds)
        command.end()  # by itself, so that its time is not counted as that of other programs
    without = () if CHROMIUM else ("Chromium is not installed: what a page takes beside was not measured",)
    return Speed(numbers, without)


def _painted(command: Command, moves: int, seconds: float) -> tuple[Number, ...]:
    """From the touch of a slider to what the page shows."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as made:
        browser = made.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = Page(browser, command.address)
        page.ready()
        page.unfold("base", "base/forward", "base/forward/M2")
        page.page.uncheck("#noise")
        page.still()
        clean = _percentiles(page, moves, KNOB, FAR)
        rate = page.page.evaluate(DRAG, [seconds, KNOB, FAR]) / seconds
        page.still()
        every = _percentiles(page, moves, OF_ALL, WARM)
        page.page.evaluate(f"liveTwin.knobs.turn('{OF_ALL}', 0)")
        page.still()
        page.page.check("#noise")
        page.still()
        noisy = _percentiles(page, moves, KNOB, FAR)
        frames = page.page.evaluate("liveTwin.last.readings.frames")
        page.close()
        browser.close()
    of = f"of {moves} moves of a slider"
    return (
        Number("median_ms", clean[0], f"slider to spots and readings, expected image: median {of}", "ms"),
        Number("slow_ms", clean[1], "the same: 95th percentile", "ms"),
        Number("all_ms", every[0], "the base warmed, and with it every body: median", "ms"),
        Number("noisy_ms", noisy[0], f"with {frames} noisy frames, all estimators: median", "ms"),
        Number("noisy_slow_ms", noisy[1], "the same: 95th percentile", "ms"),
        # the page asks 60 times a second at most, so that a faster machine need not give more
        Number("rate", rate, "updates while a slider is dragged", "1/s"),
    )


def _percentiles(page: Any, moves: int, knob: str, far: float) -> tuple[float, float]:
    took = np.array(page.page.evaluate(MOVE, [moves, knob, far]))
    return float(np.median(took)), float(np.percentile(took, 95.0))


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
