"""One number of the benchmarks page: what was measured, and how it is to be judged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tests.benchmarks.yardsticks import Pace


@dataclass(frozen=True)
class Number:
    """What was measured.

    Attributes:
        key: in the JSON, ends in the unit (a ratio or a count has none).
        value: measured.
        text: what it is, for the table.
        unit: for the table.
        pace: what it scales with; None for what no machine changes: ratios, counts, slopes and bytes.
        least: more is better, as of a rate; else less is.
        limited: whether it has a limit (`tests.benchmarks.limits`).
        target: what is asked for on the machine of reference; to miss it is no failure.
        clock: it is of the wall clock, and so is judged only where nothing else runs.
    """

    key: str
    value: float
    text: str
    unit: str = ""
    pace: Pace | None = None
    least: bool = False
    limited: bool = False
    target: float | None = None
    clock: bool = False

    def at_reference(self, now: Mapping[str, float], reference: Mapping[str, float]) -> float:
        """The value on the machine of reference.

        Args:
            now, reference: yardstick -> seconds here and there.
        """
        if self.pace is None:
            return self.value
        slowness = self.pace.slowness(now, reference)
        return self.value * slowness if self.least else self.value / slowness


def keeps(value: float, bound: float, least: bool) -> bool:
    """Whether a value is at least or at most its bound; NaN is not."""
    return value >= bound if least else value <= bound


def shown(value: float) -> str:
    """Three digits, with commas; powers of ten for what is tiny."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(digits, 0)}f}"


@dataclass(frozen=True)
class Speed:
    """What one benchmark gave.

    Attributes:
        numbers: of the page.
        notes: remarks that belong beside them.
        yardsticks: yardstick -> seconds while it ran.
        others: share of the machine that other programs took meanwhile; NaN if nobody knows.
    """

    numbers: tuple[Number, ...]
    notes: tuple[str, ...] = ()
    yardsticks: Mapping[str, float] = field(default_factory=dict)
    others: float = float("nan")

    def __getitem__(self, key: str) -> float:
        """A number's value as measured."""
        return self.data[key]

    @property
    def data(self) -> dict[str, Any]:
        """Key -> value as measured."""
        return {number.key: number.value for number in self.numbers}

    def at_reference(self, reference: Mapping[str, float]) -> dict[str, float]:
        """Key -> value on the machine of reference, of those that scale."""
        return {n.key: n.at_reference(self.yardsticks, reference) for n in self.numbers if n.pace is not None}
