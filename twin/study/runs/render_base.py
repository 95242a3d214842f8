"""The main job as the base of a study: states of one instrument are done together, all else run by run.

A state's numbers differ in the last bits with the states it is done with; so a block is always the same runs. Most
studies change nothing but numbers under ``perturb``, so that the job of a run can be made quickly (`JobMaker`).
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from analysis.monitor.recovery import Recovery
from optics.geometry.tree import State
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.instrument_model import Instrument
from scenes.specs.job import JobSpec, PerturbationSpec, checked_nodes
from scenes.specs.job_tables import TableTemperatureSpec
from scenes.specs.resolved import ResolvedJob, resolve
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem
from scenes.yaml.quantity import Quantity, Vector
from scenes.yaml.spec import Spec, annotation_at, validate
from scenes.yaml.yaml_file import YamlFile
from twin.main_job.render_results import JobRun, RenderRun
from twin.monitor.image_quality import QUALITY, quality_dicts
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_memory import pieces
from twin.monitor.observation import Observing, observe
from twin.monitor.truth import Truth
from twin.study.runs.base_job import PHYSICS, Failure, Outcome, Run, Tree, one_line, with_values

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


def true_results(
    resolved: ResolvedJob, experiment: MonitorExperiment, state: State, frames: int, seed: int, truth: Truth
) -> dict[str, Any]:
    """``truth`` of an instrument without a monitor: contents of truth.json; arguments as of `monitor_results`."""
    run = JobRun(
        resolved=resolved, experiment=experiment, state=state, frames=frames, seed=seed, truth=truth, warnings=()
    )
    return {"truth": run.truth_dict()}


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


def _run_together(
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
    out: list[Outcome] = [Failure("not done")] * len(runs)
    shared = len({run.seed for run in runs}) == 1

    def leave(k: int, why: str) -> None:
        out[k] = Failure(why)

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = [runs[k] for k in numbers]
        if shared:
            # the same noise after, and the same frames before, which are then measured once
            frames, seed = own[0].frames, own[0].seed
            return before(frames, seed), experiment.frames_after(photons, frames, seed, np.zeros(len(own), int))
        first, after = [], []
        for part in pieces(len(own), photons[0].size * (own[0].frames + _PATTERN_FRAMES)):
            seeds = [run.seed for run in own[part]]
            first.append(experiment.frames_before(own[0].frames, seeds))
            after.append(experiment.frames_after(photons[part], own[0].frames, seeds, np.zeros(len(seeds), int)))
        return np.concatenate(first), np.concatenate(after)

    how = Observing(record, runs[0].resolved.job.analysis.centroid, len(runs), leave=leave)
    for found in observe(experiment, [run.state for run in runs], how):
        for j, k in enumerate(found.numbers):
            run, one = runs[k], slice(j, j + 1)
            told = found.truth.at(one), found.recovery.at(one)
            out[k] = monitor_results(run.resolved, experiment, run.state, run.frames, run.seed, *told)
    return out


_PATTERN_FRAMES = 8
"""Frames that take as much memory as the fixed pattern of their CCDs."""


def _traced_together(experiment: MonitorExperiment, runs: Sequence[MonitorRun]) -> list[Outcome]:
    """Truth of runs of one instrument without a monitor, as truth.json holds it; when one run's light is lost, all are
    tried alone.
    """
    try:
        truth = experiment.sight.truth([run.state for run in runs])
    except PHYSICS as error:
        if len(runs) == 1:
            return [Failure(one_line(error))]
        return [found for run in runs for found in _traced_together(experiment, [run])]
    return [
        true_results(run.resolved, experiment, run.state, run.frames, run.seed, truth.at(slice(k, k + 1)))
        for k, run in enumerate(runs)
    ]


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
        """Number of states that are done together."""
        return BLOCK

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
            work = MonitorRun(resolved, state, resolved.frames, resolved.job.render.seed)
            groups.setdefault((name, work.frames, resolved.job.analysis.centroid), []).append((k, work))
        for (name, *_), members in groups.items():
            experiment = used[name]

            def before(frames: int, seed: int, name: str = name, one: MonitorExperiment = experiment) -> np.ndarray:
                return self._frames_before(name, one, frames, seed)

            own = [work for _, work in members]
            done = _run_together(experiment, own, before) if experiment.monitored else _traced_together(experiment, own)
            for (k, _), outcome in zip(members, done, strict=True):
                out[k] = outcome
            asked = [
                (k, work.state, work.resolved.job.render.obstructed) for k, work in members if work.resolved.quality
            ]
            for obstructed in (True, False):
                part = [(k, state) for k, state, traced in asked if traced == obstructed]
                found = _qualities(experiment.instrument, backend, [state for _, state in part], obstructed)
                for (k, _), quality in zip(part, found, strict=True):
                    so_far = out[k]
                    if not isinstance(so_far, Failure):
                        out[k] = quality if isinstance(quality, Failure) else {**(so_far or {}), "quality": quality}
        return [outcome if outcome is not None else Failure("not done") for outcome in out]

    def _maker(self, tree: Tree) -> JobMaker:
        """The tree of a study is the same object from block to block."""
        if id(tree) not in self._makers or self._makers[id(tree)].tree is not tree:
            self._makers[id(tree)] = JobMaker(tree)
            _forget(self._makers)
        return self._makers[id(tree)]

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
Reader = Callable[[object], float]


class JobMaker:
    """Jobs of the runs of one study.

    A number under ``perturb`` is read by its field's own validator and put into a copy of the base's job, which takes
    some 10 us; any other value needs the whole job to be read again, 1 ms.

    Args:
        tree: plain data of a ResolvedJob; whatever is changed is there.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.base = read_job(tree)
        self._plain = {path: _numbers(what) for path, what in self.base.job.perturb.items()}
        self._readers: dict[KeyPath, Reader | None] = {}

    def job(self, values: tuple[tuple[KeyPath, Any], ...]) -> ResolvedJob:
        """The job with these values.

        Raises:
            InputError: a value that the schema does not allow.
        """
        if not values:
            return self.base
        readers = [self._reader(key) for key, _ in values]
        if any(reader is None for reader in readers):
            return read_job(with_values(self.tree, values))
        changed: dict[str, dict[str, Any]] = {}
        for (key, value), reader in zip(values, readers, strict=True):
            node = str(key[2])
            if node not in changed:
                changed[node] = _copy(self._plain[node])
            assert reader is not None
            try:
                _put(changed[node], key[3:], reader(value))
            except Problem as problem:
                issue = Issue(problem.problem, "", None, key, problem.found, problem.allowed, problem.suggestion)
                raise InputError(issue) from None
        perturb = dict(self.base.job.perturb)
        perturb.update({node: _spec(parts) for node, parts in changed.items()})
        job = self.base.job.model_copy(update={"perturb": FrozenMap(perturb)})
        return self.base.model_copy(update={"job": job})

    def _reader(self, key: KeyPath) -> Reader | None:
        if key not in self._readers:
            inside = key[:2] == PERTURB and len(key) > 3 and key[2] in self._plain
            quantity = quantity_at(PerturbationSpec, key[3:]) if inside else None
            self._readers[key] = quantity.parse if quantity is not None else None
        return self._readers[key]


def read_job(tree: Tree) -> ResolvedJob:
    """The job that plain data describe. Raises InputError."""
    resolved: ResolvedJob = validate(ResolvedJob, YamlFile("", tree, {}))
    return resolved


def quantity_at(model: type[Spec], key: KeyPath) -> Quantity | None:
    """The quantity that a model has at ``key``: a field, a component of a vector, an entry of a mapping; else None."""
    for k, part in enumerate(key):
        owner = annotation_at(model, key[:k])
        if isinstance(owner, type) and issubclass(owner, BaseModel) and part in owner.model_fields:
            metadata, rest = owner.model_fields[str(part)].metadata, key[k + 1 :]
            for item in metadata:
                if isinstance(item, Quantity) and not rest:
                    return item
                if isinstance(item, Vector) and len(rest) == 1:
                    return item.of
        elif k == len(key) - 1:
            return _of_mapping(model, key[:k])
    return None


def _of_mapping(model: type[Spec], key: KeyPath) -> Quantity | None:
    """The quantity that the entries of the mapping at ``key`` are: ``Annotated[float, Quantity(...)]``."""
    arguments = getattr(annotation_at(model, key), "__args__", ())
    metadata = getattr(arguments[-1], "__metadata__", ()) if arguments else ()
    return next((item for item in metadata if isinstance(item, Quantity)), None)


def _numbers(what: PerturbationSpec) -> dict[str, Any]:
    """A perturbation as nested dictionaries and lists of SI numbers, and its deformation as it is."""
    heat = what.temperature
    return {
        "rotate": list(what.rotate),
        "shift": list(what.shift),
        "pivot": what.pivot,
        "figure": dict(what.figure),
        **{name: getattr(what, name) for name in ("scale", "radius", "conic", "index", "abbe")},
        "temperature": None if heat is None else {**dict(heat), "gradient": list(heat.gradient)},
        "deformation": what.deformation,
    }


def _copy(parts: Mapping[str, Any]) -> dict[str, Any]:
    heat = parts["temperature"]
    return {
        **parts,
        "rotate": list(parts["rotate"]),
        "shift": list(parts["shift"]),
        "figure": dict(parts["figure"]),
        "temperature": None if heat is None else {**heat, "gradient": list(heat["gradient"])},
    }


def _put(parts: Any, key: KeyPath, value: float) -> None:
    for part in key[:-1]:
        parts = parts[part]
    parts[key[-1]] = value


def _spec(parts: Mapping[str, Any]) -> PerturbationSpec:
    # every number has been read by its own validator, and no validator of the class looks at several at once
    heat = parts["temperature"]
    return PerturbationSpec.model_construct(
        rotate=tuple(parts["rotate"]),
        shift=tuple(parts["shift"]),
        pivot=parts["pivot"],
        figure=FrozenMap(parts["figure"]),
        **{name: parts[name] for name in ("scale", "radius", "conic", "index", "abbe")},
        temperature=None
        if heat is None
        else TableTemperatureSpec.model_construct(**{**heat, "gradient": tuple(heat["gradient"])}),
        deformation=parts["deformation"],
    )


def _needs_more(job: JobSpec) -> bool:
    """Whether a job asks for what is not done for many states at once: a course, stray light or test targets."""
    return job.course is not None or job.render.stray is not None or bool(job.render.target_images)
