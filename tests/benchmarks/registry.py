"""All benchmarks, in the order of the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from tests.benchmarks import (
    asbuilt_speed,
    block_speed,
    cut_speed,
    growth_speed,
    jacobian_speed,
    large_speed,
    layout_speed,
    live_speed,
    monitor_speed,
    path_speed,
    psf_speed,
    pushbroom_speed,
    quality_speed,
    record_speed,
    roofline_speed,
    start_speed,
    study_speed,
    table_speed,
    tolerance_speed,
    trace_speed,
)
from tests.benchmarks.number import Speed
from tests.benchmarks.stopwatch import OtherPrograms
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import INSIDE, OUTSIDE, Watch


@dataclass(frozen=True)
class Benchmark:
    """One part of the page.

    Attributes:
        name: as the user calls it.
        text: what is measured.
        measure: workbench and whether to be quick -> its numbers.
        seconds, quick_seconds: that it takes on an idle machine of two cores, for the time left.
        yardsticks: that its numbers scale with.
    """

    name: str
    text: str
    measure: Callable[[Workbench, bool], Speed]
    seconds: float
    quick_seconds: float
    yardsticks: tuple[str, ...] = INSIDE


BENCHMARKS = (
    Benchmark("trace", "sequential trace beside batoid and optiland", trace_speed.measure, 52, 8),
    Benchmark("psf", "image of a far point beside poppy", psf_speed.measure, 8, 2),
    Benchmark("monitor", "a batch of states of the monitor", monitor_speed.measure, 40, 6),
    Benchmark("roofline", "what each part of a state takes, and could take", roofline_speed.measure, 30, 12),
    Benchmark("jacobian", "derivatives in reverse and forward mode", jacobian_speed.measure, 42, 8),
    Benchmark("paths", "paths of the path tracer", path_speed.measure, 18, 10),
    Benchmark("layouts", "information of a monitor's layout, and a search for layouts", layout_speed.measure, 68, 20),
    Benchmark("pushbroom", "images of the ground", pushbroom_speed.measure, 60, 15),
    Benchmark("tables", "tables of measurements with a million rows", table_speed.measure, 30, 2),
    Benchmark("quality", "image quality with shadows and without", quality_speed.measure, 28, 5),
    Benchmark("cut", "MTF of obscured pupils and of free ones", cut_speed.measure, 26, 4),
    Benchmark("tolerance", "cameras drawn within their tolerances", tolerance_speed.measure, 65, 25),
    Benchmark("asbuilt", "the state of one instrument from its wavefronts", asbuilt_speed.measure, 8, 5),
    Benchmark("record", "one reading more in the record of an instrument", record_speed.measure, 340, 6),
    Benchmark("block", "a block of a hundred scenes with a million tie points", block_speed.measure, 600, 30),
    Benchmark("study", "the engine of trade studies", study_speed.measure, 95, 20),
    Benchmark("live", "the live twin: from a slider to painted spots and readings", live_speed.measure, 75, 30),
    Benchmark("large", "a study of ten thousand states", large_speed.measure, 310, 25),
    Benchmark(
        "growth", "how processor time grows with states, pixels, bodies and frames", growth_speed.measure, 500, 8
    ),
    Benchmark(
        "start",
        "help, a bad file, the main job with an empty and a filled cache",
        start_speed.measure,
        115,
        45,
        (*INSIDE, *OUTSIDE),
    ),
)


def measured(one: Benchmark, bench: Workbench, quick: bool) -> Speed:
    """What a benchmark gives, with its yardsticks, taken before and after it and where it looks at them itself."""
    bench.watch = Watch(one.yardsticks)
    others = OtherPrograms()
    bench.look()
    speed = one.measure(bench, quick)
    bench.look()
    return replace(speed, yardsticks=bench.watch.seconds, others=others.share)


def running_order(chosen: list[Benchmark]) -> list[Benchmark]:
    """``large`` first: it counts this process's memory, which then holds nothing of the others."""
    return sorted(chosen, key=lambda one: one.name != "large")
