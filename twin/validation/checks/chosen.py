"""Inputs that a paper does not print and that are chosen here: how far they may move before a row fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from twin.run.artefact import plain, significant

FARTHEST = 100.0
"""Factor on an input up to which its limit is looked for."""
_STEP = 1.1
_HALVINGS = 20


@dataclass(frozen=True)
class InputRange:
    """A chosen input and where the row stays as it is, all other inputs being what they are.

    Attributes:
        name: what it is.
        value: as chosen; None where it is no number.
        unit: of the numbers; "1" for a factor.
        low, high: limits; None where there is none within a factor of `FARTHEST`, or the row does not agree.
        agrees: whether the row does.
        said: where else the row holds, where the input is no number.
    """

    name: str
    value: float | None
    unit: str
    low: float | None
    high: float | None
    agrees: bool
    said: str = ""

    @property
    def text(self) -> str:
        """For a reader: the value, and its limits to two digits."""
        if self.value is None:
            return f"{self.name}, {self.said}"
        unit = "" if self.unit == "1" else f" {self.unit}"
        if not self.agrees:
            return f"{self.name} {plain(self.value, 4)}{unit}"
        if self.low is not None and self.high is not None:
            limits = f"from {_two(self.low)} to {_two(self.high)}{unit}"
        elif self.high is not None:
            limits = f"up to {_two(self.high)}{unit}"
        else:
            limits = "whatever it is" if self.low is None else f"from {_two(self.low)}{unit}"
        return f"{self.name} {plain(self.value, 4)}{unit}, holds {limits}"


def _two(value: float) -> str:
    """Two digits; an exponent would be noise."""
    return significant(value, 2, floor=0.0)


@dataclass(frozen=True)
class Chosen:
    """An input that was chosen, and how the measured value goes with it.

    Attributes:
        name: what it is, a phrase.
        value: as chosen, not zero.
        unit: of it.
        response: what is measured, in the row's unit, when the input is so many times what it is.
    """

    name: str
    value: float
    unit: str
    response: Callable[[float], float]

    @classmethod
    def power(cls, name: str, value: float, unit: str, measured: float, exponent: float = 1.0) -> Chosen:
        """An input that the measured value goes with as its power: 1 where it is proportional to it."""
        return cls(name, value, unit, lambda factor: measured * factor**exponent)

    def range(self, holds: Callable[[float], bool], agrees: bool) -> InputRange:
        """Where a row stays as it is.

        Args:
            holds: whether a measured value agrees.
            agrees: whether that of the row does; if not, no limits are looked for.
        """
        low = high = None
        if agrees:
            low, high = (self._limit(holds, step) for step in (1.0 / _STEP, _STEP))
        low, high = (None if end is None else self.value * end for end in (low, high))
        return InputRange(self.name, self.value, self.unit, low, high, agrees)

    def _limit(self, holds: Callable[[float], bool], step: float) -> float | None:
        """Factor at which the row begins to fail, going by a step; None where it does not."""
        inside, outside = 1.0, step
        while holds(self.response(outside)):
            if not 1.0 / FARTHEST <= outside <= FARTHEST:
                return None
            inside, outside = outside, outside * step
        for _ in range(_HALVINGS):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if holds(self.response(middle)) else (inside, middle)
        return inside


@dataclass(frozen=True)
class Supposed:
    """A choice that is no number.

    Attributes:
        name: what it is, a phrase with the choice.
        said: where else the row holds, found by trying.
    """

    name: str
    said: str

    def range(self, holds: Callable[[float], bool], agrees: bool) -> InputRange:
        """As of a number, with nothing to look for."""
        return InputRange(self.name, None, "1", None, None, agrees, self.said)
