"""What is kept of the runs of a block or of several: the responses, and which runs failed and why."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenes.specs.study import ResponseSpec
from scenes.yaml.errors import Problem
from twin.study.runs.base_job import Failure, Outcome
from twin.study.runs.config_tree import leaf


@dataclass(frozen=True, eq=False)
class BlockResult:
    """Responses of n consecutive runs.

    Attributes:
        values: (n, R) in the order of the study's responses, NaN in runs that failed and where there is no number.
        sigmas: (n, R) their standard deviations, NaN where none is asked for.
        noises: (n, R) those by noise alone, likewise.
        messages: (n,) why a run failed, empty for one that did not.
        seconds: that a worker took for them.
        doubts: (n,) why sigma does not hold in a run that did not fail, empty where it does.
    """

    values: np.ndarray
    sigmas: np.ndarray
    noises: np.ndarray
    messages: tuple[str, ...]
    seconds: float
    doubts: tuple[str, ...]

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
        doubts = []
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
            doubts.append("" if isinstance(outcome, Failure) or message else _doubt(outcome))
        return cls(values, sigmas, noises, tuple(messages), seconds, tuple(doubts))

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
    texts = recovered.get("doubts") or [CONTRADICTED if not recovered["sigma_holds"] else "at some times of the course"]
    return str(texts[0])


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

    Raises:
        Problem: they do not; ``within`` is the part that does not fit, ``allowed`` what there is.
    """
    value = leaf(sample, key)
    if isinstance(value, Mapping):
        raise Problem("not a single number", "more below it", ", ".join(str(name) for name in value) + " after it")
    if isinstance(value, list | tuple):
        raise Problem("not a single number", f"a list of {len(value)}", f"0 to {len(value) - 1} after it")
    if isinstance(value, str):
        raise Problem("not a number", repr(value), "a key that leads to a number")
