"""The table of all runs of a study, and what it takes of the memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scenes.specs.study import GRID
from scenes.yaml.errors import InputError, KeyPath, Problem
from scenes.yaml.spec import validate
from scenes.yaml.units import with_unit
from scenes.yaml.yaml_file import YamlFile
from twin.run.memory import Lowered, require_memory
from twin.study.runs.base_job import Run, leaf, with_values
from twin.study.runs.sampling import Scaling, draw, extremes, number_of, ratios, run_count, scaled
from twin.study.runs.setup import StudySetup


@dataclass(frozen=True, eq=False)
class Column:
    """Values of one factor.

    Attributes:
        name: of the factor.
        unit: of the numbers; empty for pure numbers and for texts.
        values: (runs,) float64, int64, bool or text.
    """

    name: str
    unit: str
    values: np.ndarray

    def cell(self, run: int) -> Any:
        """The value of a run as it stands in the base's tree."""
        value = self.values[run].item()
        return with_unit(value, self.unit) if self.unit else value


@dataclass(frozen=True, eq=False)
class Plan:
    """All runs of a study.

    Attributes:
        setup: the study.
        columns: values of every factor, in the study's order.
    """

    setup: StudySetup
    columns: tuple[Column, ...]

    @classmethod
    def of(cls, setup: StudySetup) -> Plan:
        """The plan of a study.

        Raises:
            InputError: a factor takes a value that the base's schema does not allow.
        """
        sampled = draw(setup.study)
        plan = cls(setup, tuple(_column(setup, name, values) for name, values in sampled.items()))
        plan.check()
        return plan

    @property
    def runs(self) -> int:
        """Number of runs."""
        return run_count(self.setup.study)

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-self.runs // self.setup.job.block)

    def block(self, number: int) -> range:
        """Numbers of the runs of a block."""
        size = self.setup.job.block
        return range(number * size, min((number + 1) * size, self.runs))

    @cached_property
    def scaling(self) -> Scaling:
        """Values of the base that follow factors.

        Raises:
            InputError: a value that is no number, or a power that does not exist.
        """
        base: dict[KeyPath, tuple[float | int, str]] = {}
        ratio: dict[KeyPath, np.ndarray] = {}
        for column in self.columns:
            factor = self.setup.study.factors[column.name]
            for k, scale in enumerate(factor.scales):
                try:
                    base[scale.key] = number_of(leaf(self.setup.tree, scale.key))
                except Problem as problem:
                    raise self.setup.error(problem, ("factors", column.name, "scales", k, "key")) from None
            for place, found in self._ratios(column, column.values).items():
                ratio[place] = ratio[place] * found if place in ratio else found
        return Scaling(base, ratio)

    def _ratios(self, column: Column, values: np.ndarray) -> dict[KeyPath, np.ndarray]:
        factor = self.setup.study.factors[column.name]
        try:
            return ratios(factor, self.setup.base, values, column.unit) if factor.scales else {}
        except Problem as problem:
            raise self.setup.error(problem, ("factors", column.name)) from None

    @cached_property
    def seeds(self) -> np.ndarray | None:
        """Seed of every run, (runs,) int64; None when all have the base's."""
        if self.setup.study.noise == "shared":
            return None
        seed = self.setup.study.design.seed
        words = (np.random.SeedSequence(seed, spawn_key=(i,)).generate_state(1, np.uint64)[0] for i in range(self.runs))
        return np.array([int(word) >> 1 for word in words], np.int64)

    def run(self, number: int) -> Run:
        """One run."""
        factors = self.setup.study.factors
        values = {place: c.cell(number) for c in self.columns for place in factors[c.name].places}
        self.scaling.apply(values, number)
        return Run(number, tuple(values.items()), None if self.seeds is None else int(self.seeds[number]))

    def runs_of(self, blocks: range) -> Iterator[list[Run]]:
        """Runs of some blocks, block by block."""
        for block in blocks:
            yield [self.run(number) for number in self.block(block)]

    def check(self) -> None:
        """Try each factor's smallest and largest value, and every text, in the base, one factor at a time.

        The schema's limits are intervals, so that what lies between two good values is good. Values that only together
        cannot be are found when they are run, and fail alone.

        Raises:
            InputError: at the factor's line.
        """
        for column in self.columns:
            factor = self.setup.study.factors[column.name]
            for value in _telling(column, extremes(factor)):
                cell = with_unit(value, column.unit) if column.unit else value
                found = self._ratios(column, np.array([value]))
                follow = [(place, scaled(self.scaling.base[place], float(ratio[0]))) for place, ratio in found.items()]
                self._check_value(column.name, [*((place, cell) for place in factor.places), *follow])

    def _check_value(self, name: str, values: list[tuple[Any, Any]]) -> None:
        tree = with_values(self.setup.tree, values)
        try:
            validate(self.setup.job.model, YamlFile("", tree, {}))
        except InputError as error:
            factor, issue = self.setup.study.factors[name], error.issues[0]
            problem = Problem(issue.problem, issue.found, issue.allowed, issue.suggestion)
            raise self.setup.error(problem, ("factors", name, factor.kind)) from None


def _column(setup: StudySetup, name: str, sampled: np.ndarray) -> Column:
    factor = setup.study.factors[name]
    numbers = factor.numbers()
    if factor.kind not in ("values", "table"):
        return Column(name, numbers.unit or "", _like(setup, name, sampled))
    if numbers.numeric:
        listed = np.array(numbers.values, np.float64)
        # a whole number beyond these is none of a base job, which says so when it reads it
        whole = numbers.whole and bool(np.all(np.abs(listed) < 2.0**53))
        return Column(name, numbers.unit or "", (listed.astype(np.int64) if whole else listed)[sampled])
    scalars = factor.scalars()
    if all(isinstance(value, bool) for value in scalars):
        return Column(name, "", np.array(scalars, bool)[sampled])
    if not all(isinstance(value, str) for value in scalars):
        problem = Problem("values of different sorts", None, "all numbers, all quantities, or all texts")
        raise setup.error(problem, ("factors", name, factor.kind))
    return Column(name, "", np.array(scalars, np.str_)[sampled])


def _like(setup: StudySetup, name: str, sampled: np.ndarray) -> np.ndarray:
    """Numbers without a unit become whole where the base has a whole number and all of them are."""
    factor = setup.study.factors[name]
    node = leaf(setup.tree, factor.places[0]) if factor.places else None
    whole = isinstance(node, int) and not isinstance(node, bool) and factor.unit is None
    return sampled.astype(np.int64) if whole and np.all(sampled == np.rint(sampled)) else sampled


def _telling(column: Column, limits: list[float]) -> list[Any]:
    """Values of a factor that are tried: all texts and switches, of numbers the smallest and the largest."""
    if column.values.dtype.kind in "US":
        return list(dict.fromkeys(column.values.tolist()))
    if column.values.dtype.kind == "b":
        return sorted(set(column.values.tolist()))
    low, high = column.values.min().item(), column.values.max().item()
    if column.values.dtype.kind == "f" and limits:
        low, high = min(low, *limits), max(high, *limits)
    return [low, high]


STARTED = 110e6
"""Memory that a study of any size takes when its report is written, beside the imported program, bytes."""
CELL = 120.0
"""Memory that a number of a run takes as it is computed and kept, in the data set, and in the table of text that
becomes a file; bytes."""
_KEPT = 5
"""Columns of every study: number, failed, message, doubt, seed."""


def study_bytes(setup: StudySetup, runs: int) -> float:
    """Memory of the process that keeps the results, beside the imported program, bytes.

    Args:
        setup: the study.
        runs: of it.
    """
    responses = setup.study.responses.values()
    columns = _KEPT + len(setup.study.factors) + sum(1 + len(one.stated) for one in responses)
    return STARTED + CELL * columns * runs


def require_study_memory(setup: StudySetup) -> None:
    """See whether the results of all runs fit into the memory that is free and that the study may use. How long they
    take a first block of runs tells before the others begin (`twin.study.runs.engine`).

    Args:
        setup: the study.

    Raises:
        InputError: they do not; with the number of runs that would.
    """
    study, runs = setup.study, run_count(setup.study)
    key: KeyPath = ("factors",) if study.design.kind == GRID else ("design", "runs")
    lower = Lowered(study, key, runs, "runs", lambda n: study_bytes(setup, n))
    require_memory(lower, started=0.0, own=study.limits.bytes, own_key="limits.memory")
