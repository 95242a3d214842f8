"""What a job is to a study: a tree of values that runs change, what evaluates the runs, and what is kept of them."""

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
    """One run of a study.

    Attributes
    ----------
    number : int
        From 0.
    values : tuple[tuple[KeyPath, Any], ...]
        (place, value) of everything the factors change in the base's tree.
    seed : int | None
        Of its noise; None for the base's own.
    """

    number: int
    values: tuple[tuple[KeyPath, Any], ...]
    seed: int | None


@dataclass(frozen=True)
class Failure:
    """A run that cannot be: light is lost, or its values do not go together.

    Attributes
    ----------
    message : str
        Why, one line.
    """

    message: str


Outcome = Mapping[str, Any] | Failure
"""Results by file, as the run folder's JSON files without .json hold them; or why there are none."""


class BaseJob(Protocol):
    """A command that a study can vary."""

    @property
    def model(self) -> type[Spec]:
        """What its config.yaml describes."""

    @property
    def block(self) -> int:
        """Consecutive runs that are always evaluated together, whoever does it."""

    def resolve(self, file: Path | str) -> Spec:
        """Read its file, or the name of one in the library, with all it refers to. Raises InputError."""

    def check(self, tree: Tree, backend: Backend) -> None:
        """What can only be told with the job built; called once, in a worker, before the study. Raises InputError."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run. The numbers may depend on which runs are done together, but on nothing else."""


PHYSICS = (InputError, PhysicalError, MeasurementError)
"""What says that a run cannot be: its values do not go together, light is lost, a fit finds no end. Any other error is
a fault of the program and stops the study.
"""


@dataclass(frozen=True)
class ProcedureBase:
    """A test, one run after the other; only its numbers are made.

    Attributes
    ----------
    procedure : Procedure
        The test.
    """

    procedure: Procedure

    @property
    def model(self) -> type[Spec]:
        """The test's set-up."""
        return self.procedure.model

    @property
    def block(self) -> int:
        """One: nothing is gained by doing several together, and each is kept as soon as it is done."""
        return 1

    def resolve(self, file: Path | str) -> Spec:
        """Read the test with all it refers to. Raises InputError."""
        setup: Any = self.procedure.resolve(file)
        if not isinstance(setup, self.model):
            text = "measurements cannot be varied; a study needs a simulated bench"
            raise setup.test.error(text, ("measured",), allowed="the file of a simulated test")
        return setup

    def check(self, tree: Tree, backend: Backend) -> None:
        """Nothing more can be told before a run."""

    def evaluate(self, tree: Tree, runs: Sequence[Run], backend: Backend) -> list[Outcome]:
        """Outcome of every run, one after the other."""
        return [self._one(tree, run, backend) for run in runs]

    def _one(self, tree: Tree, run: Run, backend: Backend) -> Outcome:
        try:
            setup: Any = validate(self.model, YamlFile("", with_values(tree, run.values), {}))
            done = self.procedure.run(setup, backend, setup.test.seed if run.seed is None else run.seed, silent)
            numbers = self.procedure.numbers(done)
        except PHYSICS as error:
            return Failure(one_line(error))
        return {self.procedure.kind: dict(numbers)}


def one_line(error: Exception) -> str:
    """What went wrong, on one line; an input error without the file it does not have."""
    if not str(error).strip():
        return type(error).__name__
    return "; ".join(line.strip().removeprefix("input: ") for line in str(error).splitlines() if line.strip())


Tree = dict[str, Any]


def with_place(tree: Tree, model: type[Spec], key: KeyPath, neutral: bool = False) -> Tree:
    """The tree in which ``key`` leads to a single value; what is missing but may be there is made with its defaults.

    Parameters
    ----------
    tree : Tree
        Plain data of a ``model``; not changed.
    model : type[Spec]
        What the tree describes.
    key : KeyPath
        Keys and list indices from the root.
    neutral : bool
        Whether a number without a default, which would be None, is zero where zero has the same effect.

    Raises
    ------
    Problem
        It leads nowhere; ``within`` is the part that does not fit.
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


def says_nothing(tree: Tree, model: type[Spec], key: KeyPath) -> bool:
    """Return whether all that ``with_place`` adds for ``key`` has the same effect as its absence.

    Parameters
    ----------
    tree : Tree
        Plain data of a ``model``.
    model : type[Spec]
        What the tree describes.
    key : KeyPath
        Keys and list indices from the root, which lead somewhere.
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
    """What stands below ``key[k]`` in a mapping, made if it may be there."""
    part = key[k]
    if part in node:
        return node[part]
    annotation = annotation_at(model, key[:k])
    fields = _fields(annotation)
    # a mapping with free keys may get another entry, one with fields only those that it may have
    known = tuple(dict.fromkeys((*node, *fields)))
    free = typing.get_origin(annotation) is not None and not fields
    made = _default(annotation_at(model, key[: k + 1])) if isinstance(part, str) and (free or part in fields) else None
    if made is None and not (last and isinstance(part, str) and (free or part in fields)):
        suggestion = nearest(str(part), [str(name) for name in known])
        raise Problem("no such key", shown(part), names_text(known), suggestion, within=(k,))
    node[str(part)] = made
    return made


def _fields(annotation: Any) -> tuple[str, ...]:
    return tuple(annotation.model_fields) if _is_model(annotation) else ()


def _default(annotation: Any) -> Any:
    """Plain data of what a value is when nothing is said of it; None if there is no such thing."""
    if not _is_model(annotation):
        return {} if typing.get_origin(annotation) is dict else None
    try:
        return annotation().model_dump(mode="json", exclude_none=True)
    except ValidationError:
        return None


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def with_values(tree: Tree, values: Iterable[tuple[KeyPath, Any]]) -> Tree:
    """The tree with other values at places that are there; what is not changed is shared with ``tree``.

    Parameters
    ----------
    tree : Tree
        Plain data; not changed.
    values : Iterable[tuple[KeyPath, Any]]
        (place, value) of all that changes.
    """
    out = dict(tree)
    own = {id(out)}
    for key, value in values:
        node: Any = out
        for part in key[:-1]:
            below = node[part]
            if id(below) not in own:
                below = below.copy()
                own.add(id(below))
                node[part] = below
            node = below
        node[key[-1]] = value
    return out


def leaf(tree: Any, key: KeyPath) -> Any:
    """What stands at ``key`` of results.

    Parameters
    ----------
    tree : Any
        Plain data.
    key : KeyPath
        Keys and list indices from its root.

    Raises
    ------
    Problem
        Nothing does; ``within`` is the part that does not fit.
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
    """Responses of n consecutive runs.

    Attributes
    ----------
    values : np.ndarray
        (n, R) in the order of the study's responses, NaN in runs that failed and where there is no number.
    sigmas : np.ndarray
        (n, R) their standard deviations, NaN where none is asked for.
    noises : np.ndarray
        (n, R) those by noise alone, likewise.
    messages : tuple[str, ...]
        (n,) why a run failed, empty for one that did not.
    seconds : float
        That a worker took for them.
    doubts : tuple[str, ...]
        (n,) why sigma does not hold in a run that did not fail, empty where it does.
    """

    values: np.ndarray
    sigmas: np.ndarray
    noises: np.ndarray
    messages: tuple[str, ...]
    seconds: float
    doubts: tuple[str, ...]

    def fits(self, shape: tuple[int, int]) -> bool:
        """Return whether these are results of so many runs and responses, as a file may hold anything."""
        arrays = all(
            isinstance(one, np.ndarray) and one.shape == shape and one.dtype == float
            for one in (self.values, self.sigmas, self.noises)
        )
        texts = (self.messages, self.doubts)
        return arrays and all(len(one) == shape[0] and all(isinstance(m, str) for m in one) for one in texts)

    @property
    def failed(self) -> np.ndarray:
        """(n,) whether a run failed."""
        return np.array([bool(message) for message in self.messages], bool)

    @classmethod
    def of(
        cls, outcomes: Sequence[Outcome], responses: Mapping[str, ResponseSpec], seconds: float = 0.0
    ) -> BlockResult:
        """The responses of some outcomes."""
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
        """Several, one after the other."""
        return cls(
            np.concatenate([part.values for part in parts]),
            np.concatenate([part.sigmas for part in parts]),
            np.concatenate([part.noises for part in parts]),
            tuple(message for part in parts for message in part.messages),
            sum(part.seconds for part in parts),
            tuple(doubt for part in parts for doubt in part.doubts),
        )


CONTRADICTED = "the shifts of the spots contradict the stated disturbances"
"""Why sigma does not hold where the fits of the spots are good."""


def _doubt(outcome: Mapping[str, Any]) -> str:
    """Why the sigmas of what was recovered do not hold, without its numbers; empty where they do."""
    recovered = outcome.get("recovered", {})
    course = outcome.get("course", {}).get("sigma_holds", [])
    if not isinstance(recovered, Mapping) or (recovered.get("sigma_holds", True) and all(course)):
        return ""
    text = str(next(iter(recovered.get("doubts", ())), "at some times of the course"))
    # which numbers contradict differs from run to run, and that they do is one reason
    return CONTRADICTED if text.startswith("the shifts of the spots contradict the prior") else text


def _number(outcome: Mapping[str, Any], key: Any, name: str) -> float:
    """The number at a key of the results; NaN where they hold none."""
    try:
        value = leaf(outcome, key)
    except Problem as problem:
        raise Problem(f"the results have no response {name!r}: {problem.problem}, {problem.found}") from None
    if value is None:
        return math.nan
    if not isinstance(value, int | float):
        raise Problem(f"the response {name!r} is not a number but {type(value).__name__}")
    return float(value)


def check_response(sample: Mapping[str, Any], key: Any) -> None:
    """Check that results like ``sample`` have a number at ``key``.

    Raises
    ------
    Problem
        They do not; ``within`` is the part that does not fit, ``allowed`` what there is.
    """
    value = leaf(sample, key)
    if isinstance(value, Mapping):
        raise Problem("not a single number", "more below it", ", ".join(str(name) for name in value) + " after it")
    if isinstance(value, list | tuple):
        raise Problem("not a single number", f"a list of {len(value)}", f"0 to {len(value) - 1} after it")
    if isinstance(value, str):
        raise Problem("not a number", repr(value), "a key that leads to a number")
