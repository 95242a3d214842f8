"""Results show themselves in a few words: what they are, their numbers with units, arrays by shape and range."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from analysis.arrays import LONGEST, shows, summary


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (2e-6, "um", "2 um"),
        (5.512, "m", "5.512 m"),
        (np.deg2rad(1.25), "deg", "1.25 deg"),
        (71428.6, "cycles/mm", "71.43 cycles/mm"),
        (True, "", "yes"),
        (None, "um", ""),
        ((1.0, -0.5), "", "(1, -0.5)"),
        (("M1", "M2"), "", "M1, M2"),
        ([f"{k}" for k in range(9)], "", "9 of them"),
        ({"forward": 1, "backward": 2}, "", "forward, backward"),
        (np.linspace(-1e-6, 2e-6, 50), "um", "50, -1 to 2 um"),
        (np.array([[np.nan, 1.0], [0.5, np.inf]]), "", "2 x 2, 0.5 to 1"),
        (np.zeros((2, 3)), "um", "2 x 3, all 0 um"),
        (np.array([True, False, True]), "", "3, 2 true"),
        (np.zeros((0, 4)), "", "0 x 4"),
        (xr.DataArray(np.arange(6.0).reshape(2, 3), dims=("channel", "row")), "DN", "2 channel x 3 row, 0 to 5 DN"),
        (xr.Dataset({"a": 1, "b": 2}), "", "a, b"),
        (SimpleNamespace(a=np.zeros(500)), "", "SimpleNamespace"),
    ],
)
def test_a_value_in_a_few_words(value: Any, unit: str, text: str) -> None:
    assert summary(value, unit) == text
    assert len(summary("word " * 100)) == LONGEST


def test_a_class_shows_its_fields() -> None:
    @shows("rms_m [um]", "inner.size", "none")
    @dataclass
    class One:
        rms_m: float
        inner: Any
        none: Any = None

    class Two(One):
        """Inherits it."""

    @shows()
    @dataclass
    class Every:
        first: int
        hidden: int = field(repr=False)
        _own: int = 3

    assert repr(One(2e-6, np.zeros(3))) == "<One: rms 2 um; size 3>"
    assert repr(Two(2e-6, np.zeros(3))) == "<Two: rms 2 um; size 3>"
    assert repr(Every(1, 2)) == "<Every: first 1>"
    with pytest.raises(ValueError, match="fields are written"):
        shows("rms um m")
