"""Base job of a study: the data that runs change, the evaluation of runs, and the responses that are recorded."""

from __future__ import annotations

import copy
import math
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, ValidationError

from analysis.arrays import MeasurementError
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from scenes.specs.procedures import Procedure
from scenes.specs.study import ResponseSpec
from scenes.yaml.errors import InputError, KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.spec import ZERO_IS_NONE, Spec, annotation_at, metadata_at, validate
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.yaml_file import YamlFile
from twin.framework.procedure import silent


@dataclass(frozen=True)
class Run:
    """One run of a study: the values that it sets in the base job, and its seed.

    Attributes
    ----------
    number : int
        Number of the run, from 0.
    values : tuple of tuple
        Key and value of each entry of the base job that the factors set.
    seed : int or None
        Seed of the run's noise; None for the base job's seed.
    """

    number: int
    values: tuple[tuple[KeyPath, Any], ...]
    seed: int | None


@dataclass(frozen=True)
class Failure:
    """Run that is physically impossible: light is lost, or its values are incompatible.

    Attributes
    ----------
    message : str
        Reason, on one line.
    """

    message: str


Outcome = Mapping[str, Any] | Failure
"""Result of a run: name of a result file without the suffix .json -> its contents; or a `Failure` with the reason."""


class BaseJob(Protocol):
    """Interface of a command that a study can vary: how its input file is read, and how its runs are evaluated."""

    @property
    def model(self) -> type[Spec]:
        """Class (data model) of the job's config.yaml."""

    @property
    def block(self) -> int:
        """Number of consecutive runs that are always evaluated together, on any worker."""

    def resolve(self, file: Path | str) -> Spec:
        """Read the job's file, or a job named in the library, with all its files; raise InputError if invalid."""

    def check(self, tree: Tree, backend: Backend) -> None:
        """Check what needs the built instrument, and raise InputError if it fails.

        It is called once, in a worker process, before the study.
        """

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Return the results of every run, or the reason of its failure.

        The numbers may depend on which runs are evaluated together, but on nothing else.
        """


PHYSICS = (InputError, PhysicalError, MeasurementError)
"""Errors of a run that is physically impossible: incompatible values, lost light, a fit without convergence.

Any other error is a fault of the program and stops the study.
"""


@dataclass(frozen=True)
class ProcedureBase:
    """Laboratory test or other procedure as the base job of a study; only its numbers are computed, run by run.

    Attributes
    ----------
    procedure : Procedure
        The test that is varied.
    """

    procedure: Procedure

    @property
    def model(self) -> type[Spec]:
        """Class (data model) of the test's set-up in its input file."""
        return self.procedure.model

    @property
    def block(self) -> int:
        """Block size 1: evaluating runs together gains nothing, and each is kept as soon as it is finished."""
        return 1

    def resolve(self, file: Path | str) -> Spec:
        """Read the test's file with all files it refers to; raise InputError if one is invalid."""
        setup: Any = self.procedure.resolve(file)
        if not isinstance(setup, self.model):
            text = "measurements cannot be varied; a study needs a simulated bench"
            raise setup.test.error(text, ("measured",), allowed="the file of a simulated test")
        return setup

    def check(self, tree: Tree, backend: Backend) -> None:
        """Do nothing, since nothing can be checked before a run."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Return the results of every run, or the reason of its failure; runs are evaluated one after the other."""
        return [self._outcome(tree, run, backend) for run in runs]

    def _outcome(self, tree: Tree, run: Run, backend: Backend) -> Outcome:
        try:
            setup: Any = validate(self.model, YamlFile("", with_values(tree, run.values), {}))
            done = self.procedure.run(setup, backend, setup.test.seed if run.seed is None else run.seed, silent)
            numbers = self.procedure.numbers(done)
        except PHYSICS as error:
            return Failure(one_line(error))
        return {self.procedure.kind: dict(numbers)}


def one_line(error: Exception) -> str:
    """Return an error's text on one line, without the file name of an input error.

    The inputs of a run are made in memory, so there is no such file.
    """
    if not str(error).strip():
        return type(error).__name__
    return "; ".join(line.strip().removeprefix("input: ") for line in str(error).splitlines() if line.strip())


Tree = dict[str, Any]
"""Plain data of a job: nested mappings, lists and single values."""


def with_entry(tree: Tree, model: type[Spec], key: KeyPath, neutral: bool = False) -> Tree:
    """Return a job's plain data in which the key path ``key`` exists; missing optional parts get their defaults.

    Parameters
    ----------
    tree : dict
        Plain data of a ``model``; not changed.
    model : type of Spec
        Data model (class) of the plain data.
    key : KeyPath
        Keys and list indices from the root.
    neutral : bool
        True to replace a missing number without a default by zero where zero has the same effect as its absence.

    Raises
    ------
    Problem
        The key does not exist; ``within`` is the part that does not fit.
    """
    out = copy.deepcopy(tree)
    node: Any = out
    for k, part in enumerate(key):
        last = k == len(key) - 1
        if isinstance(node, dict):
            node = _entry(node, model, key, k, last)
        elif isinstance(node, list):
            if not isinstance(part, int) or not 0 <= part < len(node):
                raise Problem("no such place in a list", shown(part), f"0 to {len(node) - 1}", within=(k,))
            node = node[part]
        else:
            raise Problem("a single value has nothing below it", shown(part), "a shorter key", within=(k,))
    if node is None and neutral and ZERO_IS_NONE in (metadata := metadata_at(model, key)):
        quantity = next((item for item in metadata if isinstance(item, Quantity)), None)
        out = with_values(out, [(key, 0.0 if quantity is None else quantity.format(0.0))])
    if isinstance(node, dict | list):
        below = names_text(node) if isinstance(node, dict) else f"0 to {len(node) - 1}"
        raise Problem("not a single value", shown(node), f"one of {below} after it")
    return out


def is_neutral(tree: Tree, model: type[Spec], key: KeyPath) -> bool:
    """Return True if the entries that ``with_entry`` adds to reach ``key`` do not change the job's results.

    Parameters
    ----------
    tree : dict
        Plain data of a ``model``.
    model : type of Spec
        Data model (class) of the plain data.
    key : KeyPath
        Keys and list indices from the root, which must exist in the model.
    """
    node: Any = tree
    for k, part in enumerate(key):
        if isinstance(part, int):
            node = None if node is None else node[part]
            continue
        node = None if node is None else node.get(part)
        if node is None:
            owner = annotation_at(model, key[:k])
            filled = owner.model_fields[part].default is not None if _is_model(owner) else k < len(key) - 1
            if not filled and ZERO_IS_NONE not in metadata_at(model, key[: k + 1]):
                return False
    return True


def _entry(node: Tree, model: type[Spec], key: KeyPath, k: int, last: bool) -> Any:
    """Return the value at element ``k`` of a key path in a mapping; it is created if the data model allows it.

    ``node`` is the mapping in which that key is looked up, ``model`` its data model.
    """
    part = key[k]
    if part in node:
        return node[part]
    annotation = annotation_at(model, key[:k])
    fields = _fields(annotation)
    # a mapping with free keys may get any entry, a model only its fields
    known = tuple(dict.fromkeys((*node, *fields)))
    free = typing.get_origin(annotation) is not None and not fields
    default = (
        _default(annotation_at(model, key[: k + 1])) if isinstance(part, str) and (free or part in fields) else None
    )
    if default is None and not (last and isinstance(part, str) and (free or part in fields)):
        suggestion = nearest(str(part), [str(name) for name in known])
        raise Problem("no such key", shown(part), names_text(known), suggestion, within=(k,))
    node[str(part)] = default
    return default


def _fields(annotation: Any) -> tuple[str, ...]:
    return tuple(annotation.model_fields) if _is_model(annotation) else ()


def _default(annotation: Any) -> Any:
    """Return the default of a field of a data model as plain data; None if it has no default."""
    if not _is_model(annotation):
        return {} if typing.get_origin(annotation) is dict else None
    try:
        return annotation().model_dump(mode="json", exclude_none=True)
    except ValidationError:
        return None


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def with_values(tree: Tree, values: Iterable[tuple[KeyPath, Any]]) -> Tree:
    """Return a job's plain data with new values at existing keys; unchanged parts are shared with ``tree``.

    Parameters
    ----------
    tree : dict
        Plain data; not changed.
    values : iterable of tuple
        Key path and new value of each entry that changes.
    """
    out = dict(tree)
    copied = {id(out)}
    for key, value in values:
        node: Any = out
        for part in key[:-1]:
            below = node[part]
            if id(below) not in copied:
                below = below.copy()
                copied.add(id(below))
                node[part] = below
            node = below
        node[key[-1]] = value
    return out


def leaf(tree: Any, key: KeyPath) -> Any:
    """Return the value at a key path of results.

    Parameters
    ----------
    tree : dict or list
        Results as nested mappings and lists.
    key : KeyPath
        Keys and list indices from the root of the results.

    Raises
    ------
    Problem
        The key does not exist; ``within`` is the part that does not fit.
    """
    node = tree
    for k, part in enumerate(key):
        if isinstance(node, Mapping):
            if part not in node:
                known = [str(name) for name in node]
                raise Problem("no such key", shown(part), names_text(known), nearest(str(part), known), within=(k,))
        elif not isinstance(node, list | tuple):
            raise Problem("a single value has nothing below it", shown(part), "a shorter key", within=(k,))
        elif not isinstance(part, int) or not 0 <= part < len(node):
            raise Problem("no such place in a list", shown(part), f"0 to {len(node) - 1}", within=(k,))
        node = node[part]
    return node


@dataclass(frozen=True, eq=False)
class BlockResult:
    """Responses of a block of n consecutive runs.

    Array dimensions: n runs, R responses.

    Attributes
    ----------
    values : (n, R) ndarray
        Responses in the study's order, NaN in failed runs and where the results have no number.
    sigmas : (n, R) ndarray
        Total standard deviations of the responses, NaN where none is requested.
    noises : (n, R) ndarray
        Standard deviations of the responses due to noise alone, NaN where none is requested.
    messages : tuple of str
        Reason of each failure, (n,), empty for a run that did not fail.
    seconds : float
        Computing time on the worker.
    doubts : tuple of str
        Reason why the sigma of a run that did not fail is not valid, (n,), empty where it is.
    """

    values: np.ndarray
    sigmas: np.ndarray
    noises: np.ndarray
    messages: tuple[str, ...]
    seconds: float
    doubts: tuple[str, ...]

    def fits(self, shape: tuple[int, int]) -> bool:
        """Return True if the arrays have the shape (runs, responses); data read from a file may not."""
        arrays = all(
            isinstance(item, np.ndarray) and item.shape == shape and item.dtype == float
            for item in (self.values, self.sigmas, self.noises)
        )
        texts = (self.messages, self.doubts)
        return arrays and all(len(item) == shape[0] and all(isinstance(m, str) for m in item) for item in texts)

    @property
    def failed(self) -> np.ndarray:
        """True for each of the n runs that failed, (n,)."""
        return np.array([bool(message) for message in self.messages], bool)

    @classmethod
    def of(
        cls, outcomes: Sequence[Outcome], responses: Mapping[str, ResponseSpec], seconds: float = 0.0
    ) -> BlockResult:
        """Return the responses of a block of runs, taken from the results of its runs."""
        values = np.full((len(outcomes), len(responses)), np.nan)
        sigmas, noises = (np.full(values.shape, np.nan) for _ in range(2))
        messages: list[str] = []
        for k, outcome in enumerate(outcomes):
            message = outcome.message or "failed" if isinstance(outcome, Failure) else ""
            if not isinstance(outcome, Failure):
                try:
                    for r, (name, response) in enumerate(responses.items()):
                        values[k, r] = _number(outcome, response.key, name)
                        if response.minus is not None:
                            values[k, r] -= _number(outcome, response.minus, name)
                        if response.sigma is not None:
                            sigmas[k, r] = _number(outcome, response.sigma, name)
                        if response.noise is not None:
                            noises[k, r] = _number(outcome, response.noise, name)
                except Problem as problem:
                    message = str(problem)
                    values[k] = sigmas[k] = noises[k] = np.nan
            messages.append(message)
        doubts = tuple(
            "" if isinstance(outcome, Failure) or message else _doubt(outcome)
            for outcome, message in zip(outcomes, messages, strict=True)
        )
        return cls(values, sigmas, noises, tuple(messages), seconds, doubts)

    @classmethod
    def joined(cls, parts: Sequence[BlockResult]) -> BlockResult:
        """Return the results of several blocks concatenated in the order of their runs."""
        return cls(
            np.concatenate([part.values for part in parts]),
            np.concatenate([part.sigmas for part in parts]),
            np.concatenate([part.noises for part in parts]),
            tuple(message for part in parts for message in part.messages),
            sum(part.seconds for part in parts),
            tuple(doubt for part in parts for doubt in part.doubts),
        )


CONTRADICTED = "the shifts of the spots contradict the prior on disturbances"
"""Reason, as text, why a run's sigma is not valid although the fits of its spots are good."""


def _doubt(outcome: Mapping[str, Any]) -> str:
    """Return the reason why the sigmas of a run are not valid, without numbers; an empty text if they are valid."""
    recovered = outcome.get("recovered", {})
    course = outcome.get("course", {}).get("sigma_holds", [])
    if not isinstance(recovered, Mapping) or (recovered.get("sigma_holds", True) and all(course)):
        return ""
    text = str(next(iter(recovered.get("doubts", ())), "at some times of the course"))
    # which numbers contradict differs from run to run, and that they do is one reason
    return CONTRADICTED if text.startswith("the shifts of the spots contradict the prior") else text


def _number(outcome: Mapping[str, Any], key: Any, name: str) -> float:
    """Return the number at a key path of the results, or NaN if there is none."""
    try:
        value = leaf(outcome, key)
    except Problem as problem:
        raise Problem(f"the results have no response {name!r}: {problem.problem}, {problem.value}") from None
    if value is None:
        return math.nan
    if not isinstance(value, int | float):
        raise Problem(f"the response {name!r} is not a number but {type(value).__name__}")
    return float(value)


def check_response(sample: Mapping[str, Any], key: Any) -> None:
    """Raise Problem if results like ``sample`` have no number at ``key``.

    Raises
    ------
    Problem
        There is no number; ``within`` is the part that does not fit, ``allowed`` what exists.
    """
    value = leaf(sample, key)
    if isinstance(value, Mapping):
        raise Problem("not a single number", "more below it", ", ".join(str(name) for name in value) + " after it")
    if isinstance(value, list | tuple):
        raise Problem("not a single number", f"a list of {len(value)}", f"0 to {len(value) - 1} after it")
    if isinstance(value, str):
        raise Problem("not a number", repr(value), "a key that leads to a number")
