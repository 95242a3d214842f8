"""Exact derivatives of all spots of the pair's monitor, counted in forward traces of the same rays, processor time.

Reverse mode: 8 coordinates by 95 and by 618 motions. Forward mode: derivatives of all rays, per motion.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from optics.numerics import quadrature
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.monitor.monitor_derivative import every_motion, ray_tangents, spot_gradient
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.motions import line_family, other_motions

RULE, QUICK_RULE = (158, 632), (16, 64)
"""Rings and arms: 100 000 rays in each of 4 channels; few."""
ROUNDS = 3
FORWARD_MOTIONS = 2
PACE = pace(arithmetic=0.5, memory=0.5)


def measure(bench: Workbench, quick: bool) -> Speed:
    """How many forward traces a Jacobian costs."""
    pair = bench.instrument("gf7_pair")
    path = MonitorPath(pair, bench.backend, quadrature.disk(*(QUICK_RULE if quick else RULE)))
    aimed = path.nominal
    systems = assemble(pair.assembly, [f"{c.key}/monitor" for c in path.channels]).upload(bench.backend)
    rays = make_rays(bench.backend, np.broadcast_to(aimed.position, aimed.direction.shape), aimed.direction)
    named = [m for camera in pair.cameras for m in (*line_family(camera), *other_motions(pair, camera))]
    some = list({m.step: m for m in named}.values())
    every = every_motion(pair)
    few = some[:FORWARD_MOTIONS]

    def plain(_: object) -> None:
        trace(bench.backend, systems, rays)
        dr.sync_thread()

    works = {
        "trace": Work(plain, repeats=3),
        "some": Work(lambda _: spot_gradient(path, some)),
        "every": Work(lambda _: spot_gradient(path, every)),
        "forward": Work(lambda _: ray_tangents(path, few)),
    }
    in_turns(works, 1)  # compiles
    spent = in_turns(works, 1 if quick else ROUNDS, bench.look)
    one = spent["trace"].cpu_s
    per_motion = spent["forward"].cpu_s / one / len(few)
    total = path.nodes.count * len(path.channels)
    text = f"Jacobian of 8 coordinates by {{}} motions, reverse, {total} rays"
    return Speed(
        (
            Number("forward_trace_cpu_ms", 1e3 * one, f"monitor trace, {total} rays, processor time", "ms", PACE),
            Number("reverse_traces", spent["some"].cpu_s / one, text.format(len(some)), "traces", limited=True),
            Number("reverse_every_traces", spent["every"].cpu_s / one, text.format(len(every)), "traces", limited=True),
            Number("forward_traces_per_motion", per_motion, "  forward mode, each motion", "traces"),
        )
    )
