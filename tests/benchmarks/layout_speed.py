"""What a monitor's layout knows, and a search for layouts with two workers."""

from __future__ import annotations

import time

from scenes.models.instrument_builder import build_instrument
from scenes.models.monitor_layout import MonitorDesignSetup, resolve_monitor_design
from scenes.specs.load import EXAMPLES
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import processor_s
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.design.layout_bench import LayoutBench
from twin.design.layout_search import Search
from twin.monitor.information import information_of
from twin.run.procedure import silent

PACE = pace(python=0.6, arithmetic=0.4)
EXAMPLE = EXAMPLES / "design_monitor_two.yaml"


def drawn(setup: MonitorDesignSetup, beams: int) -> MonitorDesignSetup:
    """The search without its rounds, and with so many beams."""
    search = setup.test.search.model_copy(update={"beams": beams, "layouts": beams * beams, "rounds": 0, "exact": 4})
    return setup.model_copy(update={"test": setup.test.model_copy(update={"search": search})})


def measure(bench: Workbench, quick: bool) -> Speed:
    """Processor time of both."""
    setup = drawn(resolve_monitor_design(EXAMPLE), 6 if quick else 64)
    own = LayoutBench(setup, bench.backend)
    instrument = build_instrument(setup.instrument, setup.cameras, bench.backend)
    seconds, motions = [], 0
    for _ in range(3):
        bench.look()
        begun = time.process_time()
        (found,) = information_of(instrument, list(setup.disturbances.values()), own.detector(), bench.backend)
        seconds.append(time.process_time() - begun)
        motions = len(found.disturbances.labels)
    bench.look()
    begun, clock = processor_s(), time.monotonic()
    searched = Search(own, 2, 0, None, silent).run()
    spent, clock = processor_s() - begun, time.monotonic() - clock
    built = f"{searched.compared} layouts of {searched.standing} beams, {searched.built} built"
    text = f"{built}, two workers: processor time"
    return Speed(
        (
            Number(
                "information_s",
                min(seconds[1:]),
                f"what four sides know of {motions} motions, warm: processor time",
                "s",
                PACE,
                limited=True,
            ),
            Number("search_cpu_s", spent, text, "s", PACE, limited=True),
            Number("search_s", clock, "  by the clock", "s", PACE, clock=True),
        )
    )
