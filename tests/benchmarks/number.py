"""One number of the benchmarks page, with the limit that it has to keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Limit:
    """A bound: at least (``least``) or at most so much."""

    bound: float
    least: bool = False

    def met(self, value: float) -> bool:
        """Whether a number keeps to it; NaN does not."""
        return value >= self.bound if self.least else value <= self.bound

    @property
    def text(self) -> str:
        """With its sign."""
        return f"{'>=' if self.least else '<='} {self.bound:,g}"


@dataclass(frozen=True)
class Number:
    """What was measured.

    Attributes:
        key: in the JSON, ends in the unit (a ratio or a count has none).
        value: measured.
        text: what it is, for the table.
        unit: for the table.
        limit: if there is one.
    """

    key: str
    value: float
    text: str
    unit: str = ""
    limit: Limit | None = None

    @property
    def met(self) -> bool:
        """Whether it keeps to its limit, if it has one."""
        return self.limit is None or self.limit.met(self.value)


@dataclass(frozen=True)
class Speed:
    """What one benchmark gave: its numbers, and remarks that belong beside them."""

    numbers: tuple[Number, ...]
    notes: tuple[str, ...] = ()

    def __getitem__(self, key: str) -> float:
        """A number's value."""
        return self.data[key]

    @property
    def data(self) -> dict[str, Any]:
        """Key -> value."""
        return {number.key: number.value for number in self.numbers}
