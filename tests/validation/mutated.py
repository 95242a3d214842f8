"""Formulas broken on purpose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

Broken = Callable[[Any], Any]
"""The right function -> the wrong one."""


def break_it(monkeypatch: pytest.MonkeyPatch, places: Any, name: str, broken: Broken) -> None:
    """Put a broken function in the place of the right one, wherever it is looked up."""
    for place in places if isinstance(places, tuple) else (places,):
        monkeypatch.setattr(place, name, broken(getattr(place, name)))


def times(factor: float) -> Broken:
    """Return a function as it is, but for a factor."""
    return lambda right: lambda *given: factor * np.asarray(right(*given))


def with_fields(**changes: Callable[[Any], Any]) -> Broken:
    """Return a function as it is, but for fields of its result: name -> their value from the right result."""

    def broken(right):
        def wrong(*given, **named):
            found = right(*given, **named)
            return replace(found, **{name: change(found) for name, change in changes.items()})

        return wrong

    return broken
