"""Array types, unit factors, measurement errors and short representations of result objects.

Measured data and results are in SI units and radians inside the program. An angle in arc seconds is ``angle / ARCSEC``
and a length in micrometres is ``length * UM_PER_M``; these two forms round only once.

The decorator `shows` gives a class a ``__repr__`` of chosen fields with units, arrays by shape and range:

>>> from dataclasses import dataclass
>>> @shows("rms [um]", "rays [um]")
... @dataclass
... class Spot:
...     rms: float  # metres
...     rays: np.ndarray  # metres
>>> Spot(2e-6, np.zeros((217, 2)))
<Spot: rms 2 um; rays 217 x 2, all 0 um>

`StateArrays` is the base of results of several states, measurements or spots, whose first axis counts the states.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from math import degrees
from typing import Any, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

ARCSEC = math.pi / 180 / 3600
"""One second of arc, in radians."""

ARCMIN = 60.0 * ARCSEC
"""One minute of arc, in radians."""

UM_PER_M, MM_PER_M = 1e6, 1e3
"""Micrometres in a metre, and millimetres in a metre."""


class MeasurementError(Exception):
    """Error raised when measurements cannot give the quantity asked for: no spot, too few readings, no convergence.

    Base class of all such errors. A caller that evaluates many measurements counts one that raises it as failed; any
    other exception is a fault of the program.
    """


class UndeterminedError(MeasurementError, ValueError):
    """Error raised when measurements do not determine a quantity; the message says which one and why."""


Array = NDArray[np.float64]
"""Array of float64."""
Indices = NDArray[np.intp]
"""Array of integer indices, as NumPy uses them."""
Mask = NDArray[np.bool_]
"""Array of truth values that selects elements of another array."""
PER_SI: Mapping[str, float] = {
    "mm": MM_PER_M,
    "um": UM_PER_M,
    "nm": 1e9,
    "arcsec": 1.0 / ARCSEC,
    "deg": degrees(1.0),
    "cycles/mm": 1.0 / MM_PER_M,
    "percent": 100.0,
}
"""Number of each unit in one SI unit. A unit that is not listed is printed after the unscaled number."""

LONGEST, MOST, FEW = 70, 400, 4
"""Limits of the short texts of ``__repr__``: greatest number of characters of one value, and of the whole text.

The third number is the greatest number of elements of an array or list that are printed one by one.
"""

_FIELD = re.compile(r"(?P<path>[\w.]+)(?: \[(?P<unit>[^\]]+)\])?")
_SI_ENDING = re.compile(r"_(rad|m|s)$")
Kind = TypeVar("Kind", bound=type)


def shows(*chosen: str) -> Callable[[Kind], Kind]:
    """Return a decorator that gives a class a short ``__repr__`` of chosen fields; subclasses inherit it.

    Parameters
    ----------
    chosen : str
        Fields, each written ``name``, or ``name [unit]`` for a value held in SI units. A name may be a property, or a
        dotted path to one (``report.verdict``). Without any, all fields that the dataclass's default repr would print.
    """
    parsed = [match for text in chosen if (match := _FIELD.fullmatch(text)) is not None]
    if len(parsed) != len(chosen):
        raise ValueError(f"fields are written 'name' or 'name [unit]', found {chosen}")

    def shown(self: Any) -> str:
        named = [(entry["path"], entry["unit"] or "") for entry in parsed] or _default_fields(self)
        parts = []
        for path, unit in named:
            if text := summary(_value(self, path), unit):
                parts.append(f"{_label(path, unit)} {text}")
        text = f"{type(self).__name__}: {'; '.join(parts)}" if parts else type(self).__name__
        return f"<{_shortened(text, MOST)}>"

    def take(kind: Kind) -> Kind:
        kind.__repr__ = shown  # type: ignore[assignment]
        return kind

    return take


def summary(value: Any, unit: str = "") -> str:
    """Return a value as a short text with its unit; an empty text for None and for empty containers.

    Parameters
    ----------
    value : Any
        The value, in SI units if `unit` is a unit of `PER_SI`.
    unit : str
        Unit in which the value is printed.
    """
    if value is None or (isinstance(value, tuple | list | Mapping | str) and not value):
        return ""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, str):
        return _shortened(" ".join(value.split()), LONGEST)
    if isinstance(value, int | np.integer):
        return _with(f"{value}", unit)
    if isinstance(value, float | np.floating):
        return _with(_number(float(value), unit), unit)
    if isinstance(value, Mapping):
        return _named(value)
    dims = getattr(value, "dims", None)
    if dims is not None and hasattr(value, "data_vars"):
        return _named(value.data_vars)
    if dims is not None and hasattr(value, "values"):
        size = " x ".join(f"{n} {name}" for name, n in zip(dims, value.shape, strict=True))
        return f"{size}{_range(np.asarray(value.values), unit)}"
    if isinstance(value, tuple | list) and not all(isinstance(element, int | float | np.number) for element in value):
        texts = [element if isinstance(element, str) else summary(element, unit) for element in value]
        return _shortened(", ".join(texts), LONGEST) if len(value) <= FEW else f"{len(value)} of them"
    if isinstance(value, np.ndarray | tuple | list):
        return _array(np.asarray(value), unit)
    text = repr(value)
    # a long repr, or the default one with a memory address, is replaced by the name of the class
    return text if len(text) <= LONGEST and " object at 0x" not in text else type(value).__name__


def _default_fields(value: Any) -> list[tuple[str, str]]:
    """Return the fields that a dataclass's default repr would print, each without a unit."""
    if not is_dataclass(value):
        return []
    return [(item.name, "") for item in fields(value) if item.repr and not item.name.startswith("_")]


def _label(path: str, unit: str) -> str:
    """Return a field's name for readers: blanks instead of underscores, without a unit suffix that does not apply."""
    name = path.rpartition(".")[2]
    return (_SI_ENDING.sub("", name) if unit else name).replace("_", " ")


def _value(owner: Any, path: str) -> Any:
    for name in path.split("."):
        owner = getattr(owner, name)
    return owner


def _shortened(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _with(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text


def _number(value: float, unit: str) -> str:
    return f"{value * PER_SI.get(unit, 1.0):.4g}"


def _named(value: Mapping[Any, Any]) -> str:
    return _shortened(", ".join(str(name) for name in value), LONGEST)


def _array(values: np.ndarray, unit: str) -> str:
    if values.ndim == 1 and values.size == 1 and values.dtype.kind in "iuf":
        return _with(_number(float(values[0]), unit), unit)
    if values.ndim == 1 and 0 < values.size <= FEW and values.dtype.kind in "iuf":
        return _with(f"({', '.join(_number(float(v), unit) for v in values)})", unit)
    if values.ndim == 0:
        return summary(values.item(), unit)
    return f"{' x '.join(str(n) for n in values.shape)}{_range(values, unit)}"


def _range(values: np.ndarray, unit: str) -> str:
    """Return ", low to high unit" of the finite elements of an array, or an empty text if there are none."""
    if values.dtype.kind == "b":
        return f", {np.count_nonzero(values)} true"
    if values.dtype.kind not in "iuf" or not values.size:
        return ""
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not finite.size:
        return ", none finite"
    low, high = (_number(float(v), unit) for v in (finite.min(), finite.max()))
    return _with(f", all {low}" if low == high else f", {low} to {high}", unit)


class StateArrays:
    """Base class of dataclasses whose fields are arrays with one element for each of S states along the first axis.

    A state is whatever the rows of a result belong to: an epoch, a measurement or a spot.

    A field may also be None, a mapping of arrays, or another result of the same states.
    """

    def at(self, states: slice) -> Self:
        """Return a result that contains only the selected states.

        Parameters
        ----------
        states : slice
            Range of states to keep, along the first axis of all arrays.
        """
        return type(self)(**{name: _at(getattr(self, name), states) for name in _names(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the results of several series of states joined along the first axis.

        Parameters
        ----------
        parts : sequence of the class
            At least one result; a field is None in all of them or in none.
        """
        return cls(**{name: _joined([getattr(part, name) for part in parts]) for name in _names(cls)})


def _names(result: StateArrays | type[StateArrays]) -> list[str]:
    return [item.name for item in fields(cast(Any, result))]


def _at(value: Any, states: slice) -> Any:
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {name: _at(part, states) for name, part in value.items()}
    return value.at(states) if hasattr(value, "at") else value[states]


def _joined(values: list[Any]) -> Any:
    first = values[0]
    if first is None:
        return None
    if isinstance(first, Mapping):
        return {name: _joined([value[name] for value in values]) for name in first}
    return type(first).joined(values) if hasattr(first, "joined") else np.concatenate(values)
