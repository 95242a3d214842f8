"""Two snapshots side by side: every difference with its place, old and new value, and how far the rest agrees."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

TOLERANCE = 1e-12
"""Relative: some thousand roundings of float64, which another order of the same sums can bring about."""
OF_THE_WHOLE = ("relative_error",)
"""Keys of what is left of a balance of light: the rounding of its sums, which go by threads, is one of the whole, 1."""
OF_THE_LIGHT = "of the light"
"""Unit in which a check states the same."""
BITWISE, CLOSE, DIFFERENT = "equal bitwise", "equal to 1e-12", "different"
ABSENT = "absent"


@dataclass(frozen=True)
class Difference:
    """One place at which two snapshots differ.

    Attributes:
        place: file, then keys.
        old: value in the golden run, ABSENT where it has none.
        new: value now.
        close: whether it is within the tolerance.
    """

    place: str
    old: Any
    new: Any
    close: bool = False

    def __str__(self) -> str:
        return f"{self.place}: {_short(self.old)} -> {_short(self.new)}{' (within 1e-12)' if self.close else ''}"


@dataclass
class Comparison:
    """What a comparison found.

    Attributes:
        differences: all, in the order of the golden run.
    """

    differences: list[Difference] = field(default_factory=list)

    @property
    def far(self) -> list[Difference]:
        """Those beyond the tolerance."""
        return [one for one in self.differences if not one.close]

    @property
    def status(self) -> str:
        """BITWISE, CLOSE or DIFFERENT."""
        return DIFFERENT if self.far else CLOSE if self.differences else BITWISE


def _short(value: Any) -> str:
    text = value if value is ABSENT else repr(value)
    return text if len(text) <= 160 else f"{text[:100]} ... {text[-50:]}"


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def close(old: float, new: float, scale: float = 0.0, tolerance: float = TOLERANCE) -> bool:
    """Whether two numbers differ by no more than the tolerance, of the larger one or of a scale."""
    if old == new or (math.isnan(old) and math.isnan(new)):
        return True
    if not (math.isfinite(old) and math.isfinite(new)):
        return False
    return abs(old - new) <= tolerance * max(abs(old), abs(new), scale)


def _summaries_close(old: dict[str, Any], new: dict[str, Any], tolerance: float) -> bool:
    """Whether two summaries with other bytes are of numbers that agree, as far as their statistics tell.

    Numbers are measured against the largest of them, sums against what so many of that size come to.
    """
    fixed = ("dtype", "shape", "form", "not_finite")
    if any(old.get(key) != new.get(key) for key in fixed) or old.get("max") is None or new.get("max") is None:
        return False
    if "int" in old["dtype"] or old["dtype"] == "bool":
        return False
    peak = max(abs(old["min"]), abs(old["max"]))
    count = math.prod(old["shape"])
    scales = {"sum": peak * count, "squares": peak * peak * count, "min": peak, "max": peak}
    return all(close(old[key], new[key], scale, tolerance) for key, scale in scales.items()) and all(
        close(a, b, peak, tolerance) for a, b in zip(old["samples"], new["samples"], strict=True)
    )


def compare(old: Any, new: Any, tolerance: float = TOLERANCE, scale: float = 0.0) -> Comparison:
    """All differences of two snapshots; numbers below the scale are measured against it."""
    found = Comparison()
    _walk(old, new, "", (tolerance, scale), found.differences)
    return found


def _walk(old: Any, new: Any, place: str, limits: tuple[float, float], found: list[Difference]) -> None:
    tolerance, scale = limits
    if isinstance(old, dict) and isinstance(new, dict):
        if "bytes" in old and "bytes" in new:
            if old != new:
                found.append(Difference(place, _told(old), _told(new), _summaries_close(old, new, tolerance)))
            return
        told = old.get("unit") == new.get("unit") == OF_THE_LIGHT
        for key in [*old, *(key for key in new if key not in old)]:
            below = f"{place} / {key}" if place else str(key)
            if key not in old or key not in new:
                found.append(Difference(below, old.get(key, ABSENT), new.get(key, ABSENT)))
            else:
                whole = key in OF_THE_WHOLE or (told and key == "value")
                _walk(old[key], new[key], below, (tolerance, max(scale, 1.0) if whole else scale), found)
    elif isinstance(old, list) and isinstance(new, list):
        for k in range(max(len(old), len(new))):
            below = f"{place}[{k}]"
            if k >= len(old) or k >= len(new):
                found.append(Difference(below, old[k] if k < len(old) else ABSENT, new[k] if k < len(new) else ABSENT))
            else:
                _walk(old[k], new[k], below, limits, found)
    elif _number(old) and _number(new):
        same_bits = old == new and math.copysign(1.0, old) == math.copysign(1.0, new)
        if not same_bits and not (math.isnan(old) and math.isnan(new)):
            found.append(Difference(place, old, new, close(old, new, scale, tolerance)))
    elif type(old) is not type(new) or old != new:
        found.append(Difference(place, old, new))


def _told(one: dict[str, Any]) -> dict[str, Any]:
    return {key: one[key] for key in ("bytes", "shape", "sum", "min", "max", "form") if key in one}


def promised(snapshot: dict[str, Any], files: dict[str, float]) -> list[tuple[str, dict[str, Any], float]]:
    """The parts of a snapshot that hold on another processor, each with its tolerance.

    What is printed and what JSON and images hold is there; drawings and reports round numbers that may move.
    """
    return [
        (start, {name: part for name, part in snapshot.items() if name.startswith(start)}, tolerance)
        for start, tolerance in files.items()
    ]


def compare_elsewhere(old: dict[str, Any], new: dict[str, Any], files: dict[str, float]) -> Comparison:
    """The comparison on another processor: exit code, names of files, and what is promised there.

    Numbers below 1 of their unit (arc seconds, micrometres) are measured against 1: a truth that is zero is rounding.
    """
    found = compare({key: old[key] for key in ("exit", "files")}, {key: new[key] for key in ("exit", "files")})
    for (_, before, tolerance), (_, after, _) in zip(promised(old, files), promised(new, files), strict=True):
        found.differences += [
            one for one in compare(before, after, tolerance, 1.0).differences if not (one.close and tolerance)
        ]
    return found
