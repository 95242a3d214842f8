"""Formulas broken on purpose, and checks without their figures, where a test wants only the verdicts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from matplotlib.figure import Figure

Broken = Callable[[Any], Any]
"""The right function -> the wrong one."""


@contextmanager
def undrawn() -> Iterator[None]:
    """Context in which SVG figures are put together but come out empty; rendering them takes most of a fast check."""
    draw = Figure.savefig

    def savefig(figure: Figure, out, **options) -> None:
        if options.get("format") == "svg":
            out.write("<svg></svg>")
        else:
            draw(figure, out, **options)

    with patch.object(Figure, "savefig", savefig):
        yield


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
