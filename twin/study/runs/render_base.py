"""Main job as the base job of a study: states of one instrument are evaluated together, other jobs run by run.

The last bits of a state's numbers depend on the states it is traced with, so a block always holds the same runs. Most
studies change only numbers under ``perturb``, for which the job of a run is built quickly (`JobMaker`).
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from analysis.monitor.recovery import Recovery
from optics.geometry.tree import State
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.instrument_model import Instrument
from scenes.specs.job import PerturbationSpec, checked_nodes
from scenes.specs.resolved import ResolvedJob, resolve
from scenes.yaml.errors import KeyPath
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import YamlFile
from twin.camera.refocus import job_state_in_focus
from twin.main_job.render_results import JobRun, RenderRun
from twin.monitor.image_quality import QUALITY, quality_dicts
from twin.monitor.monitor_experiment import MonitorExperiment, pieces
from twin.monitor.observation import ObservationOptions, observe
from twin.monitor.truth import Truth
from twin.study.runs.base_job import PHYSICS, Failure, Outcome, Run, Tree, one_line, with_values


def run_results(
    resolved: ResolvedJob, experiment: MonitorExperiment, state: State, truth: Truth, recovery: Recovery | None = None
) -> dict[str, Any]:
    """Return the contents of truth.json and, with a monitor, of recovered.json, for one state.

    Parameters
    ----------
    resolved : ResolvedJob
        Job with the contents of all files that it refers to.
    experiment : MonitorExperiment
        Instrument of the job.
    state : State
        Perturbed state.
    truth : Truth
        True changes of this state, by exact ray trace.
    recovery : Recovery, optional
        Estimates from its images or spots, None without a monitor.
    """
    known: dict[str, Any] = {"resolved": resolved, "experiment": experiment, "state": state, "truth": truth}
    known |= {"frames": resolved.frames, "seed": resolved.job.render.seed, "warnings": ()}
    if recovery is None:
        return {"truth": JobRun(**known).truth_dict()}
    known |= dict.fromkeys(("photons_before", "photons_after", "before", "after"), np.empty(0))
    run = RenderRun(**known, recovery=recovery, crosstalk={})
    return {"truth": run.truth_dict(), "recovered": run.recovered_dict()}


MonitorRun = tuple[ResolvedJob, State]
"""Run of an instrument with a monitor: its job and the perturbed state that the job describes."""


def _run_together(
    experiment: MonitorExperiment, runs: Sequence[MonitorRun], before: Callable[[int, int], np.ndarray]
) -> list[Outcome]:
    """Return the results of runs of one instrument, all with the same number of frames.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument that is evaluated.
    runs : sequence of MonitorRun
        Runs to be evaluated together.
    before : callable
        Function of the number of frames and the seed that returns the frames of the nominal state, (C, frames, rows,
        columns) for C area CCDs.

    Returns
    -------
    list of Outcome
        Results of each run, as in truth.json and recovered.json, or the reason of its failure. If one run's light is
        lost, all runs of the group are tried alone, and the others are then evaluated together.
    """
    out: list[Outcome] = [Failure("not done")] * len(runs)
    frames, seeds = runs[0][0].frames, [resolved.job.render.seed for resolved, _ in runs]

    def leave(k: int, why: str) -> None:
        out[k] = Failure(why)

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        run_seeds = [seeds[k] for k in numbers]
        if len({*seeds}) == 1:
            # the same noise after, and the same frames before, which are then measured once
            return before(frames, run_seeds[0]), experiment.frames_after(
                photons, frames, run_seeds[0], np.zeros(len(run_seeds), int)
            )
        first, after = [], []
        for part in pieces(len(run_seeds), photons[0].size * (frames + _PATTERN_FRAMES)):
            first.append(experiment.frames_before(frames, run_seeds[part]))
            after.append(
                experiment.frames_after(photons[part], frames, run_seeds[part], np.zeros(len(run_seeds[part]), int))
            )
        return np.concatenate(first), np.concatenate(after)

    how = ObservationOptions(record, runs[0][0].job.analysis.centroid, len(runs), omit=leave)
    for batch in observe(experiment, [state for _, state in runs], how):
        for j, k in enumerate(batch.numbers):
            (resolved, state), item = runs[k], slice(j, j + 1)
            out[k] = run_results(resolved, experiment, state, batch.truth.at(item), batch.recovery.at(item))
    return out


_PATTERN_FRAMES = 8
"""Memory of the fixed pattern (pixel offsets and gains) of the CCDs, in units of the memory of one frame of each."""


def _traced_together(experiment: MonitorExperiment, runs: Sequence[MonitorRun]) -> list[Outcome]:
    """Return the true changes of runs of one instrument without a monitor, as in truth.json.

    If one run's light is lost, all are evaluated alone.
    """
    try:
        truth = experiment.sight.truth([state for _, state in runs])
    except PHYSICS as error:
        if len(runs) == 1:
            return [Failure(one_line(error))]
        return [outcome for run in runs for outcome in _traced_together(experiment, [run])]
    return [
        run_results(resolved, experiment, state, truth.at(slice(k, k + 1))) for k, (resolved, state) in enumerate(runs)
    ]


BLOCK = 25
"""Number of runs in a block, which are evaluated together.

A run's last digits depend on the other runs of its block. Since blocks are fixed, they depend neither on the number of
workers nor on interruptions.
"""
KEPT = 4
"""Number of calibrated instruments that a worker keeps in memory."""


class RenderBase:
    """Base job ``python -m twin.render`` without the crosstalk tables.

    It keeps calibrated instruments between blocks of runs.
    """

    model: type[Spec] = ResolvedJob
    block = BLOCK

    def __init__(self) -> None:
        self._experiments: OrderedDict[str, MonitorExperiment] = OrderedDict()
        self._before: OrderedDict[tuple[str, int, int], np.ndarray] = OrderedDict()
        self._maker: JobMaker | None = None

    def resolve(self, file: Path | str) -> Spec:
        """Read a job's file with all files it refers to; raise InputError if one is invalid."""
        return resolve(file)

    def check(self, tree: Tree, backend: Backend) -> None:
        """Raise InputError if a perturbed body does not exist or does not allow its perturbation."""
        resolved = read_job(tree)
        experiment = self._experiment(resolved, backend)[1]
        checked_nodes(resolved.job, experiment.instrument.nodes)
        if experiment.monitored:
            experiment.prior  # noqa: B018 - raises where the instrument does not have what is stated

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Return the results of every run: ``truth`` and ``recovered``, and further results on request.

        The further results are ``quality`` (image quality), and those of a time series of states, stray light or
        targets.
        """
        if self._maker is None or self._maker.tree is not tree:  # the same object from block to block
            self._maker = JobMaker(tree)
        maker = self._maker
        out: list[Outcome | None] = [None] * len(runs)
        groups: dict[tuple[Any, ...], list[tuple[int, MonitorRun]]] = {}
        used: dict[str, MonitorExperiment] = {}
        same = all(key[:2] == PERTURB for run in runs for key, _ in run.values)
        shared = self._experiment(maker.base, backend) if same else None
        for k, run in enumerate(runs):
            try:
                resolved = maker.job(run.values)
                if run.seed is not None:
                    resolved = resolved.with_render(resolved.frames, run.seed)
                job = resolved.job  # time series, stray light and targets are computed run by run
                if job.course is not None or job.render.stray is not None or job.render.target_images:
                    out[k] = _alone(resolved, backend)
                    continue
                name, experiment = shared or self._experiment(resolved, backend)
                job = checked_nodes(resolved.job, experiment.instrument.nodes)
                resolved = resolved.with_job(job)
                state = job_state_in_focus(experiment, resolved.job)
            except PHYSICS as error:
                out[k] = Failure(one_line(error))
                continue
            used[name] = experiment
            key = (name, resolved.frames, resolved.job.analysis.centroid)
            groups.setdefault(key, []).append((k, (resolved, state)))
        for (name, *_), members in groups.items():
            experiment = used[name]

            def before(frames: int, seed: int, name: str = name, pair: MonitorExperiment = experiment) -> np.ndarray:
                return self._frames_before(name, pair, frames, seed)

            pairs = [work for _, work in members]
            done = (
                _run_together(experiment, pairs, before)
                if experiment.monitored
                else _traced_together(experiment, pairs)
            )
            for (k, _), outcome in zip(members, done, strict=True):
                out[k] = outcome
            asked = [(k, state, resolved.job.render.obstructed) for k, (resolved, state) in members if resolved.quality]
            for obstructed in (True, False):
                part = [(k, state) for k, state, traced in asked if traced == obstructed]
                qualities = _qualities(experiment.instrument, backend, [state for _, state in part], obstructed)
                for (k, _), quality in zip(part, qualities, strict=True):
                    so_far = out[k]
                    if not isinstance(so_far, Failure):
                        out[k] = quality if isinstance(quality, Failure) else {**(so_far or {}), "quality": quality}
        return [outcome if outcome is not None else Failure("not done") for outcome in out]

    def _experiment(self, resolved: ResolvedJob, backend: Backend) -> tuple[str, MonitorExperiment]:
        """Return the instrument with its calibration, and a name that identifies it."""
        parts: list[Spec | None] = [resolved.instrument, *resolved.cameras.values(), resolved.detector]
        parts.append(resolved.disturbances)
        name = json.dumps([backend.name, *(part.plain() for part in parts if part is not None)])
        if name not in self._experiments:
            self._experiments[name] = MonitorExperiment(resolved, backend)
            _forget(self._experiments)
        self._experiments.move_to_end(name)
        return name, self._experiments[name]

    def _frames_before(self, name: str, experiment: MonitorExperiment, frames: int, seed: int) -> np.ndarray:
        """Return the frames before the perturbation; they are cached, because runs with the same noise share them."""
        key = (name, frames, seed)
        if key not in self._before:
            self._before[key] = experiment.frames_before(frames, seed)
            _forget(self._before)
        return self._before[key]


def _qualities(
    instrument: Instrument, backend: Backend, states: Sequence[State], obstructed: bool
) -> list[dict[str, Any] | Failure]:
    """Return the image quality of states, computed together; if one state fails, all are computed alone."""
    try:
        return [*quality_dicts(instrument, backend, states, obstructed)]
    except PHYSICS as error:
        if len(states) == 1:
            return [Failure(one_line(error))]
    return [quality for state in states for quality in _qualities(instrument, backend, [state], obstructed)]


def _alone(resolved: ResolvedJob, backend: Backend) -> Outcome:
    """Return the results of a job with several states, or with results other than monitor spots."""
    from twin.main_job.render_job import render_job

    run = render_job(resolved, backend)
    out: dict[str, Any] = {"truth": run.truth_dict()}
    if isinstance(run, RenderRun):
        out["recovered"] = run.recovered_dict()
        out["crosstalk"] = {name: table.to_dict() for name, table in run.crosstalk.items()}
        out |= {name: part.to_dict() for name, part in (("course", run.series), ("stray", run.stray)) if part}
    if run.targets is not None:
        out["mtf"] = run.targets.to_dict()
    if run.quality is not None:
        out["quality"] = QUALITY(run.quality)
    return out


def _forget(cache: OrderedDict[Any, Any]) -> None:
    """Drop the least recently used items of a cache beyond ``KEPT``."""
    while len(cache) > KEPT:
        cache.popitem(last=False)


PERTURB = ("job", "perturb")
"""Beginning of the key paths of perturbations in the plain data of the base job."""


class JobMaker:
    """Builder of the jobs of the runs of one study.

    For a run that changes only numbers under ``perturb``, only the perturbations of these bodies are validated again,
    without their tables of displaced nodes, which a study does not vary. Any other run needs the whole job, which takes
    about ten times as long.

    Parameters
    ----------
    tree : dict
        Plain data of a ResolvedJob, with an entry at every place that runs change.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree, self.base = tree, read_job(tree)

    def job(self, values: tuple[tuple[KeyPath, Any], ...]) -> ResolvedJob:
        """Return the job of a run in which these key paths have these values.

        Raises
        ------
        InputError
            The schema does not allow a value.
        """
        if not values:
            return self.base
        tree, perturb = with_values(self.tree, values), dict(self.base.job.perturb)
        if any(key[:2] != PERTURB or key[2] not in perturb for key, _ in values):
            return read_job(tree)
        for node in {str(key[2]) for key, _ in values}:
            plain = {name: value for name, value in tree["job"]["perturb"][node].items() if name != "deformation"}
            try:
                changed = PerturbationSpec.model_validate(plain)
            except ValidationError:
                return read_job(tree)  # which says where it is wrong
            perturb[node] = changed.model_copy(update={"deformation": perturb[node].deformation})
        job = self.base.job.model_copy(update={"perturb": FrozenMap(perturb)})
        return self.base.model_copy(update={"job": job})


def read_job(tree: Tree) -> ResolvedJob:
    """Return the job that plain data describe; raise InputError if they are invalid."""
    resolved: ResolvedJob = validate(ResolvedJob, YamlFile("", tree, {}))
    return resolved
