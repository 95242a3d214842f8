"""Results of several states, measurements or spots: dataclasses of arrays whose first axis counts the states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Self, cast

import numpy as np


class OfStates:
    """Base of a dataclass whose fields are arrays of S states along the first axis.

    A field may also be None, a mapping of arrays, or another result of the same states.
    """

    def at(self, states: slice) -> Self:
        """The result of some of the states.

        Args:
            states: which, along the first axis.
        """
        return type(self)(**{name: _at(getattr(self, name), states) for name in _names(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The result of several series of states, one after the other.

        Args:
            parts: at least one; a field is None in all of them or in none.
        """
        return cls(**{name: _joined([getattr(one, name) for one in parts]) for name in _names(cls)})


def _names(result: OfStates | type[OfStates]) -> list[str]:
    return [one.name for one in fields(cast(Any, result))]


def _at(value: Any, states: slice) -> Any:
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {name: _at(one, states) for name, one in value.items()}
    return value.at(states) if hasattr(value, "at") else value[states]


def _joined(values: list[Any]) -> Any:
    first = values[0]
    if first is None:
        return None
    if isinstance(first, Mapping):
        return {name: _joined([one[name] for one in values]) for name in first}
    return type(first).joined(values) if hasattr(first, "joined") else np.concatenate(values)
