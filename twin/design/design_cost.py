"""What a search for a camera or for a monitor's layout takes of memory and time, from what its file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.run.cost import Cost

if TYPE_CHECKING:
    from scenes.models.camera_design import CameraDesignSetup
    from scenes.models.monitor_layout import MonitorDesignSetup

CAMERA_BYTES, CAMERA_SECONDS = 158e6, 3.0
"""Of an optimisation, whatever it optimises, and what it takes beside its starts; bytes and seconds."""
START_SECONDS = 11.5
"""Seconds of a start; each searches until it is settled."""


def camera_design_cost(setup: CameraDesignSetup) -> Cost:
    """What `run_design` and its report take.

    Args:
        setup: the optimisation.
    """
    return Cost(CAMERA_BYTES, CAMERA_SECONDS + setup.test.starts * START_SECONDS)


LAYOUT_BYTES, LAYOUT_SECONDS = 340e6, 10.0
"""Of a search for layouts with few beams; bytes and seconds."""
BEAM_SECONDS, CHANGED_SECONDS = 0.56, 1.1
"""Seconds of a beam that is tried alone, and of one that a round changes."""
BUILT_SECONDS, COMPARED_SECONDS, REFINED_SECONDS = 0.2, 1e-3, 20.0
"""Seconds of a layout that is built as a whole, of a combination that is compared, and of a step of refinement."""


def monitor_design_cost(setup: MonitorDesignSetup) -> Cost:
    """What `run_monitor_design` and its report take, on one core.

    Args:
        setup: the search.
    """
    plan = setup.test.search
    one = plan.beams * BEAM_SECONDS + plan.rounds * plan.changed * CHANGED_SECONDS
    one += (plan.rounds + 1) * (plan.exact * BUILT_SECONDS + plan.layouts * COMPARED_SECONDS)
    return Cost(LAYOUT_BYTES, LAYOUT_SECONDS + (plan.starts + 1) * one + plan.refine * REFINED_SECONDS)
