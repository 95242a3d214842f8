"""Many perturbed states of one instrument, each with noise of its own: traced, imaged, exposed and recovered together.

A state's numbers differ in the last bits with the states it is done with; so a block is always the same runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from analysis.intersection_angle import IntersectionAngleChange
from analysis.monitoring import CameraParameters
from analysis.recovery import Recovery, recover
from analysis.spot_positions import SpotError
from optics.aim import AimError
from optics.threads import one_blas_thread
from optics.trace import BeamMissedError
from optics.tree import State
from scenes.resolved import ResolvedJob
from twin.experiment import MonitorExperiment
from twin.study.base_job import Failure, Outcome
from twin.study.monitor_results import monitor_results
from twin.truth import Truth, trace_truth

Given = TypeVar("Given")
Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class MonitorRun:
    """One run.

    Attributes:
        resolved: its job.
        state: what its job perturbs.
        frames, seed: of its exposures.
    """

    resolved: ResolvedJob
    state: State
    frames: int
    seed: int


def run_together(
    experiment: MonitorExperiment, runs: Sequence[MonitorRun], before: Callable[[int, int], np.ndarray]
) -> list[Outcome]:
    """Results of runs of one instrument with one number of frames, as truth.json and recovered.json hold them.

    Args:
        experiment: the instrument.
        runs: to be done at once.
        before: number of frames and seed -> frames of the nominal state, (C, frames, rows, columns).

    Returns:
        For each run its results, or why it has none. When one run's light is lost, all runs of the group are tried
        alone, and those that are good are done together without it.
    """
    out: list[Outcome | None] = [None] * len(runs)
    left = list(range(len(runs)))
    traced = _traced(experiment, [run.state for run in runs])
    if traced is None:
        for k in left:
            try:
                _trace(experiment, [runs[k].state])
            except (AimError, BeamMissedError) as error:
                out[k] = Failure(str(error))
        left = [k for k in left if out[k] is None]
        traced = _trace(experiment, [runs[k].state for k in left]) if left else None
    if traced is None:
        return [outcome for outcome in out if outcome is not None]
    truth, photons = traced
    # runs that share their noise have the same frames before, which are then measured once
    shared = len({run.seed for run in runs}) == 1
    first = (
        before(runs[0].frames, runs[0].seed)
        if shared
        else np.stack([before(r.frames, r.seed) for r in _of(runs, left)])
    )
    after = np.empty((*photons.shape[:2], runs[0].frames, *photons.shape[2:]), np.uint16)
    for i, run in enumerate(_of(runs, left)):
        after[i : i + 1] = experiment.frames_after(photons[i : i + 1], run.frames, run.seed)
    good = list(range(len(left)))
    while good:
        try:
            with one_blas_thread():
                start = first if shared else _of(first, good)
                recovery = recover(start, _of(after, good), experiment.calibration, _centroid(runs[0]), threads=1)
        except SpotError as error:
            lost = _lost(error, experiment, good)
            for i, reason in lost.items():
                out[left[i]] = Failure(f"a spot cannot be measured ({reason})")
            good = [i for i in good if i not in lost]
            continue
        for j, i in enumerate(good):
            run, one = runs[left[i]], (_truth_of(truth, i), _recovery_of(recovery, j))
            out[left[i]] = monitor_results(run.resolved, experiment, run.state, run.frames, run.seed, *one)
        break
    return [outcome for outcome in out if outcome is not None]


def _of(things: Any, chosen: Sequence[int]) -> Any:
    """Those of the given numbers; no copy of arrays when it is all of them."""
    if len(chosen) == len(things):
        return things
    return things[list(chosen)] if isinstance(things, np.ndarray) else [things[k] for k in chosen]


def _centroid(run: MonitorRun) -> str:
    return run.resolved.job.analysis.centroid


def _traced(experiment: MonitorExperiment, states: Sequence[State]) -> tuple[Truth, np.ndarray] | None:
    try:
        return _trace(experiment, states)
    except (AimError, BeamMissedError):
        return None


def _trace(experiment: MonitorExperiment, states: Sequence[State]) -> tuple[Truth, np.ndarray]:
    """Truth, and expected photons (S, C, rows, columns)."""
    truth = trace_truth(experiment.instrument, experiment.backend, states)
    return truth, experiment.path.expected_photons(states, chunk=len(states))


def _lost(error: SpotError, experiment: MonitorExperiment, good: Sequence[int]) -> dict[int, str]:
    """State -> why its spots, before or after, cannot be measured."""
    channels = experiment.path.channels
    out: dict[int, str] = {}
    for index in error.indices:
        state, spot = divmod(index, len(channels))
        out.setdefault(good[state], f"{channels[spot].key}: {error.reasons[index]}")
    return out


def _truth_of(truth: Truth, i: int) -> Truth:
    """The truth of one of the states."""
    one = slice(i, i + 1)
    cameras = {
        name: replace(
            change,
            d_alpha=change.d_alpha[one],
            d_beta=change.d_beta[one],
            d_gamma=change.d_gamma[one],
            principal_distance=change.principal_distance[one],
            d_f=change.d_f[one],
        )
        for name, change in truth.cameras.items()
    }
    return replace(truth, cameras=cameras, angle_change=truth.angle_change[one])


def _recovery_of(recovery: Recovery, i: int) -> Recovery:
    """What the images of one of the states say."""
    one = slice(i, i + 1)
    return Recovery(
        before=recovery.before[one],
        after=recovery.after[one],
        sigma_before=recovery.sigma_before[one],
        sigma_after=recovery.sigma_after[one],
        shift_covariance=recovery.shift_covariance[one],
        parameters={
            name: {
                estimator: CameraParameters(
                    p.d_alpha_rad[one], p.d_beta_rad[one], p.d_gamma_rad[one], p.d_f_m[one], p.covariance[one]
                )
                for estimator, p in estimators.items()
            }
            for name, estimators in recovery.parameters.items()
        },
        angle={e: IntersectionAngleChange(a.change_rad[one], a.sigma_rad[one]) for e, a in recovery.angle.items()},
    )
