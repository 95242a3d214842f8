"""Monte Carlo cameras of a tolerance budget: random cameras within the tolerances, computed on all cores.

They are computed as the runs of a study (``twin.study``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.specs.study import StudySpec
from scenes.specs.tolerance import ToleranceSetup, ToleranceSpec
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import YamlFile
from twin.camera.varied_beams import AT_ONCE
from twin.framework import cluster, memory
from twin.framework.procedure import Advance, silent
from twin.framework.run_folder import JOURNAL
from twin.study.runs.base_job import BlockResult, Failure, Outcome, Run, Tree, one_line, with_values
from twin.study.runs.blocks import Engine, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup
from twin.tolerance.tolerance_bench import ToleranceBench

KIND = "tolerance"
"""Name of the base command in the study that computes the random cameras."""
DRAWS = "draws"
"""Key of the random parameters of the cameras in the study's input data."""


class ToleranceBase:
    """Base job of the study of random cameras; it computes merits and compensator moves of every camera."""

    model: type[Spec] = ToleranceSetup
    block = AT_ONCE

    def __init__(self) -> None:
        self._benches: dict[int, tuple[Tree, ToleranceBench]] = {}

    def resolve(self, file: Path | str) -> Spec:
        """Read a budget; raise InputError if it is invalid."""
        return ToleranceSetup.read(file)

    def check(self, tree: Tree, backend: Backend) -> None:
        """Raise InputError if a name in the budget does not exist."""
        self._bench(tree, backend)

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Return merits and compensator moves of every random camera, or the reason why it has no light."""
        out: list[Outcome] = [Failure("not done")] * len(runs)
        groups: dict[str, list[int]] = {}
        others: dict[str, tuple[Any, ...]] = {}
        for k, run in enumerate(runs):
            other = tuple((key, value) for key, value in run.values if key[0] != DRAWS)
            groups.setdefault(repr(other), []).append(k)
            others[repr(other)] = other
        for name, members in groups.items():
            varied_tree = with_values(tree, others[name]) if others[name] else tree
            for k, outcome in zip(
                members, self._together(varied_tree, [runs[k] for k in members], backend), strict=True
            ):
                out[k] = outcome
        return out

    def _together(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        bench = self._bench(tree, backend)
        index = {number.name: k for k, number in enumerate(bench.numbers)}
        x = np.zeros((len(runs), len(index)))
        x[:] = [float(tree[DRAWS].get(name, 0.0)) for name in index]
        for s, run in enumerate(runs):
            for key, value in run.values:
                if key[0] == DRAWS:
                    x[s, index[str(key[1])]] = float(value)
        seeds = [tree["test"].get("seed", 0) if run.seed is None else run.seed for run in runs]
        return outcomes(bench, x, seeds)

    def _bench(self, tree: Tree, backend: Backend) -> ToleranceBench:
        """Return the nominal camera of a budget given as plain data; it is kept between blocks with the same data."""
        known = self._benches.get(id(tree))
        if known is None or known[0] is not tree:
            setup = validate(ToleranceSetup, YamlFile("", tree, {}))
            self._benches = {id(tree): (tree, ToleranceBench(setup, backend))}
        return self._benches[id(tree)][1]


def outcomes(bench: ToleranceBench, x: np.ndarray, seeds: Sequence[int]) -> list[Outcome]:
    """Trace and adjust cameras and return their merits and compensator moves.

    Parameters
    ----------
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits.
    x : (S, K) ndarray
        K varied parameters of S cameras in units of their sizes (the limit of a tolerance, the standard deviation of a
        figure term).
    seeds : sequence of int
        Seeds of the adjustment errors of the S cameras.
    """
    errors = adjustment_errors(bench, seeds)
    tried = bench.adjust_cameras(x * bench.sizes, errors)
    values = bench.values(tried.parts)
    out: list[Outcome] = []
    for s, problem in enumerate(tried.problems):
        if problem:
            out.append(Failure(one_line(RuntimeError(problem))))
            continue
        named = zip(bench.merits, values[s].tolist(), strict=True)
        moved = zip(bench.compensators, tried.moves[s].tolist(), strict=True)
        results = {
            "merits": {merit.name: value for merit, value in named},
            "moves": {number.name: move for number, move in moved},
            "settled_waves": float(tried.settled[s]),
        }
        out.append({KIND: results})
    return out


def adjustment_errors(bench: ToleranceBench, seeds: Sequence[int]) -> np.ndarray | None:
    """Return random errors of the compensator moves in standard deviations, (S, C); None for exact moves.

    Array dimensions: S cameras, C compensators.
    """
    if not np.any((bench.grid_steps > 0.0) | (bench.accuracies > 0.0)):
        return None
    return np.stack([np.random.default_rng([seed, 1]).standard_normal(len(bench.ranges)) for seed in seeds])


def distribution_of(tolerance: ToleranceSpec) -> dict[str, Any]:
    """Return the distribution of a tolerance in units of its limit, in the form of a study's file."""
    if tolerance.measured is not None:
        return {"values": list(tolerance.measured_shares)}
    middle = tolerance.mean_share
    ends = [middle - 1.0, middle + 1.0]
    if tolerance.law == "uniform":
        return {"uniform": ends}
    if tolerance.law == "ends":
        return {"values": ends}
    return {"truncated": {"mean": middle, "sigma": 1.0 / tolerance.sigmas, "limits": ends}}


def sampling_study(setup: ToleranceSetup, bench: ToleranceBench, samples: int, seed: int) -> StudySetup:
    """Return the study that computes random cameras of a budget.

    Parameters
    ----------
    setup : ToleranceSetup
        Tolerance budget.
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits.
    samples : int
        Number of cameras.
    seed : int
        Seed of the random numbers.
    """
    test = setup.test
    factors: dict[str, Any] = {}
    for number in bench.numbers:
        entry = test.tolerances[number.entry]
        law = {"normal": {"mean": 0.0, "sigma": 1.0}} if entry.spectrum else distribution_of(entry)
        factors[number.name.replace(" ", "_")] = {"key": [DRAWS, number.name], **law}
    responses = {
        **{f"merit_{merit.name}": {"key": [KIND, "merits", merit.name]} for merit in bench.merits},
        **{f"move_{entry.name}": {"key": [KIND, "moves", entry.name]} for entry in bench.compensators},
        "settled": {"key": [KIND, "settled_waves"]},
    }
    data = {
        "name": "tolerance",
        "base": {"command": KIND, "file": "config.yaml"},
        "factors": factors,
        "design": {"kind": "monte_carlo", "runs": samples, "seed": seed},
        "responses": responses,
        "limits": test.limits.plain(),
    }
    study = validate(StudySpec, YamlFile("", data, {}))
    tree = setup.plain()
    tree[DRAWS] = dict.fromkeys((number.name for number in bench.numbers), 0.0)
    return StudySetup(study, tree, tree)


@dataclass(frozen=True, eq=False)
class Samples:
    """Monte Carlo cameras of a budget with their merits and compensator moves.

    Array dimensions: S cameras, K varied parameters, M merits, C compensators.

    Attributes
    ----------
    x : (S, K) ndarray
        Varied parameters in units of their sizes (the limit of a tolerance, the standard deviation of a figure term).
    values : (S, M) ndarray
        Merits, SI units; NaN for a camera without light.
    moves : (S, C) ndarray
        Moves of the compensators, SI units.
    settled : (S,) ndarray
        Change of the rms wavefront error by a further step of the adjustments, waves; it shows convergence.
    seeds : (S,) ndarray of int
        Seeds of the adjustment errors.
    problems : tuple of str
        Reason why a camera has no light, (S,); empty where it has light.
    seconds : float
        Computing time.
    """

    x: np.ndarray
    values: np.ndarray
    moves: np.ndarray
    settled: np.ndarray
    seeds: np.ndarray
    problems: tuple[str, ...]
    seconds: float = field(default=0.0, compare=False)


@dataclass(frozen=True)
class Workforce:
    """Processes that trace the random cameras.

    Attributes
    ----------
    workers : int or None
        Number of processes; None for one per core.
    scheduler : str or None
        Address of a running Dask cluster; None for local processes.
    journal : Path or None
        Folder of the journal of finished work, from which a run can be resumed; None to compute without a journal in
        this process alone.
    warn : callable
        Function that receives warnings about the computation.
    """

    workers: int | None = None
    scheduler: str | None = None
    journal: Path | None = None
    warn: Callable[[str], None] = field(default=lambda text: None, compare=False)


def draw_samples(
    setup: ToleranceSetup,
    bench: ToleranceBench,
    backend: Backend,
    samples: int,
    seed: int,
    force: Workforce,
    part: str = "samples",
    advance: Advance = silent,
) -> Samples:
    """Generate random cameras and trace them; the results do not depend on the number of workers.

    Parameters
    ----------
    setup : ToleranceSetup
        Tolerance budget.
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits, in this process.
    backend : Backend
        Array backend of the ray trace.
    samples : int
        Number of cameras.
    seed : int
        Seed of the random numbers.
    force : Workforce
        Processes that trace the cameras.
    part : str
        Name of this stage of the work, for the journal and the progress.
    advance : Advance
        Callback that reports progress.

    Raises
    ------
    RunFolderError
        The journal belongs to a different run, or cannot be written.
    Incomplete
        The engine of studies could not finish all runs.
    """
    study = sampling_study(setup, bench, samples, seed)
    plan = Plan.of(study)
    x = _parameters(plan)
    seeds = plan.seeds if plan.seeds is not None else np.zeros(samples, np.int64)
    advance(part, 0, samples)
    if force.journal is None:
        block_results = []
        for numbers in map(plan.block, range(plan.blocks)):
            rows = slice(numbers.start, numbers.stop)
            block_results.append(BlockResult.of(outcomes(bench, x[rows], seeds[rows].tolist()), study.study.responses))
            advance(part, numbers.stop, samples)
        result = BlockResult.joined(block_results)
    else:
        result = _by_engine(plan, backend, force, force.journal / f"{part}{JOURNAL}", part, advance)
    merits, moves = len(bench.merits), len(bench.compensators)
    values = result.values
    return Samples(
        x, values[:, :merits], values[:, merits : merits + moves], values[:, -1], seeds, result.messages, result.seconds
    )


def draw_parameters(setup: ToleranceSetup, bench: ToleranceBench, count: int, seed: int) -> np.ndarray:
    """Return the random parameters of N cameras, in units of their sizes, without tracing them, (N, K)."""
    return _parameters(Plan.of(sampling_study(setup, bench, count, seed)))


def _parameters(plan: Plan) -> np.ndarray:
    return np.stack([column.values for column in plan.columns], axis=-1).astype(np.float64)


def _by_engine(plan: Plan, backend: Backend, force: Workforce, file: Path, part: str, advance: Advance) -> BlockResult:
    with journal_of(plan.setup, file, "budget") as journal:
        done = partial(advance, part)
        engine = Engine(plan, journal, backend.name, done, warn=force.warn)
        if engine.missing:
            limits = plan.setup.study.limits
            with cluster.chosen_workers(force.workers, force.scheduler, force.warn, limits) as workers:
                engine.run(workers, memory.largest_memory())
        return engine.result()
