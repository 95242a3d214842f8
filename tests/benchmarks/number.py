"""Numbers of the benchmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Number:
    """One measured number.

    Attributes:
        key: name in the JSON, which ends in the unit; a ratio or a count has none.
        value: the number.
        text: what it is, for the table.
        unit: for the table.
    """

    key: str
    value: float
    text: str
    unit: str = ""


@dataclass(frozen=True)
class Speed:
    """The numbers of one benchmark, and remarks that belong beside them."""

    numbers: tuple[Number, ...]
    notes: tuple[str, ...] = ()

    @property
    def data(self) -> dict[str, float]:
        """Key -> value."""
        return {number.key: number.value for number in self.numbers}


def shown(value: float) -> str:
    """Return a number with three digits; powers of ten where it is tiny."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(digits, 0)}f}"
