"""The main job as the base of a study: states of one instrument are done together, all else run by run.

A state's numbers differ in the last bits with the states it is done with; so a block is always the same runs. Most
studies change nothing but numbers under ``perturb``, so that the job of a run can be made quickly (`JobMaker`).
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
from scenes.specs.job import JobSpec, PerturbationSpec, checked_nodes
from scenes.specs.resolved import ResolvedJob, resolve
from scenes.yaml.errors import KeyPath
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import YamlFile
from twin.main_job.render_results import JobRun, RenderRun
from twin.monitor.image_quality import QUALITY, quality_dicts
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_memory import pieces
from twin.monitor.observation import Observing, observe
from twin.monitor.truth import Truth
from twin.study.runs.base_job import PHYSICS, Failure, Outcome, Run, Tree, one_line, with_values


def run_results(
    resolved: ResolvedJob, experiment: MonitorExperiment, state: State, truth: Truth, recovery: Recovery | None = None
) -> dict[str, Any]:
    """``truth`` and, with a monitor, ``recovered``: contents of truth.json and recovered.json, made by the code that
    makes the files.

    Parameters
    ----------
    resolved : ResolvedJob
        The job.
    experiment : MonitorExperiment
        Its instrument.
    state : State
        What the job perturbs.
    truth : Truth
        Of this one state.
    recovery : Recovery | None
        What its images or spots say, None without a monitor.
    """
    known: dict[str, Any] = {"resolved": resolved, "experiment": experiment, "state": state, "truth": truth}
    known |= {"frames": resolved.frames, "seed": resolved.job.render.seed, "warnings": ()}
    if recovery is None:
        return {"truth": JobRun(**known).truth_dict()}
    known |= dict.fromkeys(("photons_before", "photons_after", "before", "after"), np.empty(0))
    run = RenderRun(**known, recovery=recovery, crosstalk={})
    return {"truth": run.truth_dict(), "recovered": run.recovered_dict()}


MonitorRun = tuple[ResolvedJob, State]
"""A job, and what it perturbs."""


def _run_together(
    experiment: MonitorExperiment, runs: Sequence[MonitorRun], before: Callable[[int, int], np.ndarray]
) -> list[Outcome]:
    """Results of runs of one instrument with one number of frames, as truth.json and recovered.json hold them.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    runs : Sequence[MonitorRun]
        To be done at once.
    before : Callable[[int, int], np.ndarray]
        Number of frames and seed -> frames of the nominal state, (C, frames, rows, columns).

    Returns
    -------
    list[Outcome]
        For each run its results, or why it has none. When one run's light is lost, all runs of the group are tried
        alone, and those that are good are done together without it.
    """
    out: list[Outcome] = [Failure("not done")] * len(runs)
    frames, seeds = runs[0][0].frames, [resolved.job.render.seed for resolved, _ in runs]

    def leave(k: int, why: str) -> None:
        out[k] = Failure(why)

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = [seeds[k] for k in numbers]
        if len({*seeds}) == 1:
            # the same noise after, and the same frames before, which are then measured once
            return before(frames, own[0]), experiment.frames_after(photons, frames, own[0], np.zeros(len(own), int))
        first, after = [], []
        for part in pieces(len(own), photons[0].size * (frames + _PATTERN_FRAMES)):
            first.append(experiment.frames_before(frames, own[part]))
            after.append(experiment.frames_after(photons[part], frames, own[part], np.zeros(len(own[part]), int)))
        return np.concatenate(first), np.concatenate(after)

    how = Observing(record, runs[0][0].job.analysis.centroid, len(runs), leave=leave)
    for found in observe(experiment, [state for _, state in runs], how):
        for j, k in enumerate(found.numbers):
            (resolved, state), one = runs[k], slice(j, j + 1)
            out[k] = run_results(resolved, experiment, state, found.truth.at(one), found.recovery.at(one))
    return out


_PATTERN_FRAMES = 8
"""Frames that take as much memory as the fixed pattern of their CCDs."""


def _traced_together(experiment: MonitorExperiment, runs: Sequence[MonitorRun]) -> list[Outcome]:
    """Truth of runs of one instrument without a monitor, as truth.json holds it; when one run's light is lost, all are
    tried alone.
    """
    try:
        truth = experiment.sight.truth([state for _, state in runs])
    except PHYSICS as error:
        if len(runs) == 1:
            return [Failure(one_line(error))]
        return [found for run in runs for found in _traced_together(experiment, [run])]
    return [
        run_results(resolved, experiment, state, truth.at(slice(k, k + 1))) for k, (resolved, state) in enumerate(runs)
    ]


BLOCK = 25
"""A run's last digits depend on those that it is traced with, its block; and not on the number of workers
or where a study was interrupted.
"""
KEPT = 4
"""Instruments with their calibration that a worker keeps."""


class RenderBase:
    """``python -m twin.render``, without the crosstalk tables. It keeps instruments from one block to the next."""

    model: type[Spec] = ResolvedJob
    block = BLOCK

    def __init__(self) -> None:
        self._experiments: OrderedDict[str, MonitorExperiment] = OrderedDict()
        self._before: OrderedDict[tuple[str, int, int], np.ndarray] = OrderedDict()
        self._maker: JobMaker | None = None

    def resolve(self, file: Path | str) -> Spec:
        """Read a job with all it refers to. Raises InputError."""
        return resolve(file)

    def check(self, tree: Tree, backend: Backend) -> None:
        """Whether the perturbed nodes are there and allow what is done to them. Raises InputError."""
        resolved = read_job(tree)
        experiment = self._experiment(resolved, backend)[1]
        checked_nodes(resolved.job, experiment.instrument.nodes)
        if experiment.monitored:
            experiment.stated  # noqa: B018 - raises where the instrument does not have what is stated

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run: ``truth`` and ``recovered``; if asked for, also ``quality``, and with a course, stray
        light or targets these.
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
                if _needs_more(resolved.job):
                    out[k] = _alone(resolved, backend)
                    continue
                name, experiment = shared or self._experiment(resolved, backend)
                job = checked_nodes(resolved.job, experiment.instrument.nodes)
                resolved = resolved.with_job(job)
                state = experiment.state(resolved.job)
            except PHYSICS as error:
                out[k] = Failure(one_line(error))
                continue
            used[name] = experiment
            key = (name, resolved.frames, resolved.job.analysis.centroid)
            groups.setdefault(key, []).append((k, (resolved, state)))
        for (name, *_), members in groups.items():
            experiment = used[name]

            def before(frames: int, seed: int, name: str = name, one: MonitorExperiment = experiment) -> np.ndarray:
                return self._frames_before(name, one, frames, seed)

            own = [work for _, work in members]
            done = _run_together(experiment, own, before) if experiment.monitored else _traced_together(experiment, own)
            for (k, _), outcome in zip(members, done, strict=True):
                out[k] = outcome
            asked = [(k, state, resolved.job.render.obstructed) for k, (resolved, state) in members if resolved.quality]
            for obstructed in (True, False):
                part = [(k, state) for k, state, traced in asked if traced == obstructed]
                found = _qualities(experiment.instrument, backend, [state for _, state in part], obstructed)
                for (k, _), quality in zip(part, found, strict=True):
                    so_far = out[k]
                    if not isinstance(so_far, Failure):
                        out[k] = quality if isinstance(quality, Failure) else {**(so_far or {}), "quality": quality}
        return [outcome if outcome is not None else Failure("not done") for outcome in out]

    def _experiment(self, resolved: ResolvedJob, backend: Backend) -> tuple[str, MonitorExperiment]:
        """The instrument with its calibration, and what tells it from others."""
        parts: list[Spec | None] = [resolved.instrument, *resolved.cameras.values(), resolved.detector]
        parts.append(resolved.disturbances)
        name = json.dumps([backend.name, *(part.plain() for part in parts if part is not None)])
        if name not in self._experiments:
            self._experiments[name] = MonitorExperiment(resolved, backend)
            _forget(self._experiments)
        self._experiments.move_to_end(name)
        return name, self._experiments[name]

    def _frames_before(self, name: str, experiment: MonitorExperiment, frames: int, seed: int) -> np.ndarray:
        """Kept, since runs that share their noise share these frames."""
        key = (name, frames, seed)
        if key not in self._before:
            self._before[key] = experiment.frames_before(frames, seed)
            _forget(self._before)
        return self._before[key]


def _qualities(
    instrument: Instrument, backend: Backend, states: Sequence[State], obstructed: bool
) -> list[dict[str, Any] | Failure]:
    """Image quality of states, done together; when it cannot be in one, all are tried alone."""
    try:
        return [*quality_dicts(instrument, backend, states, obstructed)]
    except PHYSICS as error:
        if len(states) == 1:
            return [Failure(one_line(error))]
    return [found for state in states for found in _qualities(instrument, backend, [state], obstructed)]


def _alone(resolved: ResolvedJob, backend: Backend) -> Outcome:
    """A job that has more than one state, or more than spots."""
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


def _forget(kept: OrderedDict[Any, Any]) -> None:
    """Drop what was used longest ago."""
    while len(kept) > KEPT:
        kept.popitem(last=False)


PERTURB = ("job", "perturb")


class JobMaker:
    """Jobs of the runs of one study.

    Of a run that changes nothing but numbers under ``perturb`` only the perturbations of these bodies are read again,
    without their tables of displaced nodes, which a study does not vary; of any other the whole job, which takes some
    ten times as long.

    Parameters
    ----------
    tree
        Plain data of a ResolvedJob; whatever is changed is there.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree, self.base = tree, read_job(tree)

    def job(self, values: tuple[tuple[KeyPath, Any], ...]) -> ResolvedJob:
        """The job with these values.

        Raises
        ------
        InputError
            a value that the schema does not allow.
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
    """The job that plain data describe. Raises InputError."""
    resolved: ResolvedJob = validate(ResolvedJob, YamlFile("", tree, {}))
    return resolved


def _needs_more(job: JobSpec) -> bool:
    """Whether a job asks for what is not done for many states at once: a course, stray light or test targets."""
    return job.course is not None or job.render.stray is not None or bool(job.render.target_images)
