"""Truth and what was recovered of one monitored state, as the files of a run folder hold them, without its images."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.recovery import Recovery
from optics.tree import State
from scenes.resolved import ResolvedJob
from twin.experiment import MonitorExperiment
from twin.results import RenderRun
from twin.truth import Truth

_NOTHING = np.empty(0)


def monitor_results(
    resolved: ResolvedJob,
    experiment: MonitorExperiment,
    state: State,
    frames: int,
    seed: int,
    truth: Truth,
    recovery: Recovery,
) -> dict[str, Any]:
    """``truth`` and ``recovered``: contents of truth.json and recovered.json, made by the code that makes the files.

    Args:
        resolved: the job.
        experiment: its instrument.
        state: what the job perturbs.
        frames: of an exposure.
        seed: of its noise.
        truth: of this one state.
        recovery: what its images or spots say.
    """
    run = RenderRun(
        resolved=resolved,
        experiment=experiment,
        state=state,
        frames=frames,
        seed=seed,
        truth=truth,
        photons_before=_NOTHING,
        photons_after=_NOTHING,
        before=_NOTHING,
        after=_NOTHING,
        recovery=recovery,
        crosstalk={},
        warnings=(),
    )
    return {"truth": run.truth_dict(), "recovered": run.recovered_dict()}
