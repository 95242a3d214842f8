"""The main job as the base of a study: states of one instrument are done together, all else run by run."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optics.backend import Backend
from scenes.job import check_nodes
from scenes.resolved import ResolvedJob, resolve
from scenes.spec import Spec
from twin.experiment import MonitorExperiment
from twin.image_quality import quality_dicts
from twin.results import quality_dict
from twin.study.base_job import Failure, Outcome, Run
from twin.study.bench_base import PHYSICS, one_line
from twin.study.config_tree import Tree
from twin.study.monitor_block import MonitorRun, run_together
from twin.study.perturbed_job import PERTURB, JobMaker, needs_more, read_job

BLOCK = 25
"""A run's last digits depend on those that it is traced with, its block; and not on the number of workers, the size
of the chunks or where a study was interrupted.
"""
KEPT = 4
"""Instruments with their calibration that a worker keeps."""


class RenderBase:
    """``python -m twin.render``, without the crosstalk tables. It keeps instruments from one block to the next."""

    def __init__(self) -> None:
        self._experiments: OrderedDict[str, MonitorExperiment] = OrderedDict()
        self._before: OrderedDict[tuple[str, int, int], np.ndarray] = OrderedDict()
        self._makers: OrderedDict[int, JobMaker] = OrderedDict()

    @property
    def model(self) -> type[Spec]:
        """A job with all it refers to."""
        return ResolvedJob

    @property
    def block(self) -> int:
        """As many states as are done together."""
        return BLOCK

    def resolve(self, file: Path | str) -> Spec:
        """Read a job with all it refers to. Raises InputError."""
        return resolve(file)

    def check(self, tree: Tree, backend: Backend) -> None:
        """Whether the perturbed nodes are there and allow what is done to them. Raises InputError."""
        resolved = read_job(tree)
        check_nodes(resolved.job, self._experiment(resolved, backend)[1].instrument.nodes)

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run: ``truth`` and ``recovered``; if asked for, also ``quality``, and with a course, stray
        light or targets these.
        """
        maker = self._maker(tree)
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
                if needs_more(resolved.job):
                    out[k] = _alone(resolved, backend)
                    continue
                name, experiment = shared or self._experiment(resolved, backend)
                check_nodes(resolved.job, experiment.instrument.nodes)
                state = experiment.state(resolved.job)
            except PHYSICS as error:
                out[k] = Failure(one_line(error))
                continue
            used[name] = experiment
            work = MonitorRun(resolved, state, resolved.frames, resolved.job.render.seed)
            groups.setdefault((name, work.frames, resolved.job.analysis.centroid), []).append((k, work))
        for (name, *_), members in groups.items():
            experiment = used[name]

            def before(frames: int, seed: int, name: str = name, one: MonitorExperiment = experiment) -> np.ndarray:
                return self._frames_before(name, one, frames, seed)

            for (k, _), outcome in zip(members, run_together(experiment, [w for _, w in members], before), strict=True):
                out[k] = outcome
            renders = [(k, work.state, work.resolved.job.render) for k, work in members]
            asked = [(k, state, render.obstructed) for k, state, render in renders if render.quality]
            for obstructed in (True, False):
                part = [(k, state) for k, state, own in asked if own == obstructed]
                found = quality_dicts(experiment.instrument, backend, [state for _, state in part], obstructed)
                for (k, _), quality in zip(part, found, strict=True):
                    done = out[k]
                    out[k] = done if isinstance(done, Failure) else {**(done or {}), "quality": quality}
        return [outcome if outcome is not None else Failure("not done") for outcome in out]

    def _maker(self, tree: Tree) -> JobMaker:
        """The tree of a study is the same object from block to block."""
        if id(tree) not in self._makers or self._makers[id(tree)].tree is not tree:
            self._makers[id(tree)] = JobMaker(tree)
            _forget(self._makers)
        return self._makers[id(tree)]

    def _experiment(self, resolved: ResolvedJob, backend: Backend) -> tuple[str, MonitorExperiment]:
        """The instrument with its calibration, and what tells it from others."""
        parts = (resolved.instrument, *resolved.cameras.values(), resolved.detector)
        name = json.dumps([backend.name, *(part.plain() for part in parts)])
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


def _alone(resolved: ResolvedJob, backend: Backend) -> Outcome:
    """A job that has more than one state, or more than spots."""
    from twin.render_job import render_job

    run = render_job(resolved, backend)
    out: dict[str, Any] = {
        "truth": run.truth_dict(),
        "recovered": run.recovered_dict(),
        "crosstalk": {name: table.to_dict() for name, table in run.crosstalk.items()},
    }
    for name, part in (("course", run.course), ("stray", run.stray), ("mtf", run.targets)):
        if part is not None:
            out[name] = part.to_dict()
    if run.quality is not None:
        out["quality"] = quality_dict(run.quality)
    return out


def _forget(kept: OrderedDict[Any, Any]) -> None:
    """Drop what was used longest ago."""
    while len(kept) > KEPT:
        kept.popitem(last=False)
