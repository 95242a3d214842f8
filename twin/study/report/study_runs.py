"""Runs of a finished study as the statistics want them: factors, responses and what is known of the design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr

from scenes.specs.samplers import GRID
from scenes.specs.study import NOISE, FactorSpec, StudySpec

_SIGNS = {"um": "µm", "us": "µs", "urad": "µrad", "percent": "%", "deg": "°"}


def typeset(unit: str) -> str:
    """A unit as the report writes it."""
    return _SIGNS.get(unit, unit)


@dataclass(frozen=True, eq=False)
class Factor:
    """What was varied.

    Attributes:
        name: of the factor.
        unit: of the numbers, empty for pure numbers and texts.
        values: (runs,) float64, or text.
        spec: where the values come from.
        drawn: whether the runs are drawn from it; those of a grid are not.
    """

    name: str
    unit: str
    values: np.ndarray
    spec: FactorSpec
    drawn: bool = False

    @property
    def numeric(self) -> bool:
        """Whether the values are numbers."""
        return self.values.dtype.kind == "f"

    @cached_property
    def levels(self) -> np.ndarray:
        """The different values, numbers in order, texts in the order of the study."""
        found = np.unique(self.values)
        if self.numeric:
            return found
        first = [int(np.argmax(self.values == value)) for value in found]
        return np.asarray(found[np.argsort(first, kind="stable")])

    @property
    def label(self) -> str:
        """Name with unit."""
        return f"{self.name}, {typeset(self.unit)}" if self.unit else self.name


@dataclass(frozen=True, eq=False)
class Response:
    """What came out.

    Attributes:
        name: of the response.
        unit: empty for pure numbers.
        values: (runs,) float64, NaN where there is none.
        noise: (runs,) the standard deviation by noise alone that each run states for it; None without.
        of: of a standard deviation that is looked at like a response: what it belongs to; empty for responses.
    """

    name: str
    unit: str
    values: np.ndarray
    noise: np.ndarray | None = None
    of: str = ""

    @cached_property
    def good(self) -> np.ndarray:
        """(runs,) where there is a finite number."""
        return np.isfinite(self.values)

    @cached_property
    def known(self) -> np.ndarray:
        """The finite numbers."""
        return np.asarray(self.values[self.good])

    @cached_property
    def constant(self) -> bool:
        """Whether all numbers are the same, or differ by rounding."""
        if len(self.known) == 0:
            return True
        # 64 units in the last place: what sums over a few hundred terms lose
        return bool(np.ptp(self.known) <= 64.0 * np.finfo(float).eps * np.max(np.abs(self.known)))

    @property
    def label(self) -> str:
        """Name with unit."""
        return f"{self.name}, {typeset(self.unit)}" if self.unit else self.name


@dataclass(frozen=True, eq=False)
class StudyRuns:
    """All runs of a study.

    Attributes:
        study: as the user wrote it.
        factors: what was varied, in the study's order.
        responses: what came out, in the study's order.
        sigmas: the standard deviations that the runs state for responses, where they are not all the same.
        failed: (runs,) bool.
        messages: (runs,) why a run failed.
        doubts: (runs,) why sigma does not hold in a run, empty where it does; none of commands that do not say so.
    """

    study: StudySpec
    factors: tuple[Factor, ...]
    responses: tuple[Response, ...]
    sigmas: tuple[Response, ...]
    failed: np.ndarray
    messages: tuple[str, ...]
    doubts: tuple[str, ...] = ()

    @classmethod
    def of(cls, data: xr.Dataset, study: StudySpec) -> StudyRuns:
        """The runs of a data set as ``twin.study.study_files.make_dataset`` makes it."""
        drawn = study.design.kind != GRID
        factors = tuple(
            Factor(name, str(data[name].attrs.get("units", "")), _factor_values(data[name].values), spec, drawn)
            for name, spec in study.factors.items()
        )
        responses, sigmas = [], []
        for name, response in study.responses.items():
            unit = str(data[name].attrs.get("units", ""))
            stated = {ending: data[f"{name}{ending}"].values.astype(np.float64) for ending in response.stated}
            responses.append(Response(name, unit, data[name].values.astype(np.float64), stated.get(NOISE)))
            own = [Response(f"{name}{ending}", unit, sigma, None, name) for ending, sigma in stated.items()]
            sigmas += [one for one in own if not one.constant]
        messages = tuple(str(m) for m in data["message"].values.tolist()) if "message" in data else ()
        doubts = tuple(str(m) for m in data["doubt"].values.tolist()) if "doubt" in data else ()
        failed = data["failed"].values.astype(bool)
        return cls(study, factors, tuple(responses), tuple(sigmas), failed, messages, doubts)

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.failed)

    @property
    def kind(self) -> str:
        """Kind of the design."""
        return self.study.design.kind

    @property
    def sampled(self) -> bool:
        """Whether the runs are a sample of distributions; those of a grid are not."""
        return self.kind != GRID

    @property
    def everything(self) -> tuple[Response, ...]:
        """Responses, then the stated standard deviations."""
        return (*self.responses, *self.sigmas)

    @cached_property
    def axes(self) -> tuple[tuple[Factor, ...], ...]:
        """Factors that vary independently: each alone, columns of one table together."""
        groups: dict[str, list[Factor]] = {}
        for factor in self.factors:
            table = factor.spec.table
            groups.setdefault(f"table {table.file}" if table is not None else factor.name, []).append(factor)
        return tuple(tuple(group) for group in groups.values())

    def find(self, name: str) -> Factor | Response:
        """A factor or response by its name."""
        things: Sequence[Factor | Response] = (*self.factors, *self.responses, *self.sigmas)
        return next(thing for thing in things if thing.name == name)


def _factor_values(values: np.ndarray) -> np.ndarray:
    """Numbers as float64, texts as text; switches, which the data set holds as 8-bit numbers, as no and yes."""
    if values.dtype.kind in "OUS":
        return np.array([str(value) for value in values.tolist()], np.str_)
    if values.dtype.itemsize == 1:
        return np.where(values.astype(bool), "yes", "no")
    return np.asarray(values, np.float64)
