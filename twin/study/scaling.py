"""Values of the base that follow a factor: the base's own number times a power of the factor's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenes.errors import KeyPath, Problem, shown
from scenes.study_factor import FactorSpec
from scenes.units import split_quantity, unit_ratio
from twin.study.config_tree import Tree, leaf


@dataclass(frozen=True, eq=False)
class Scaling:
    """All values of a study that are scaled; several factors may scale one of them.

    Attributes:
        base: place -> number and unit as the base has them; the number is whole where the base's is.
        ratio: place -> (runs,) what the number is multiplied by.
    """

    base: Mapping[KeyPath, tuple[float | int, str]]
    ratio: Mapping[KeyPath, np.ndarray]

    def apply(self, values: dict[KeyPath, Any], run: int) -> None:
        """Scale what factors have set in a run, and add what they have not, as it stands in the base's tree."""
        for place, ratio in self.ratio.items():
            number = number_of(values[place]) if place in values else self.base[place]
            values[place] = scaled(number, float(ratio[run]))


def scaled(number: tuple[float | int, str], ratio: float) -> Any:
    """Number and unit, times a ratio, as they stand in a tree."""
    value = number[0] * ratio
    if number[1]:
        return f"{value!r} {number[1]}"
    # a count stays a whole number, or the schema refuses it
    return int(value) if isinstance(number[0], int) and value == int(value) else value


def ratios(factor: FactorSpec, tree: Tree, values: np.ndarray, unit: str) -> dict[KeyPath, np.ndarray]:
    """What the values that follow a factor are multiplied by: place -> array like ``values``.

    Args:
        factor: with its ``scales``.
        tree: of the base.
        values: of the factor.
        unit: of them, empty for pure numbers.

    Raises:
        Problem: the factor's value in the base is none that anything can be compared with, or a power does not exist.
    """
    out = {}
    for k, scale in enumerate(factor.scales):
        with np.errstate(all="ignore"):
            found = np.power(np.asarray(values, np.float64) / _nominal(factor, tree, unit), scale.power)
        if not np.all(np.isfinite(found)):
            shortage = f"power {scale.power:g} of a ratio of {values[np.argmin(np.isfinite(found))]:g}"
            raise Problem("no such number", shortage, "values greater than zero", within=("scales", k, "power"))
        out[scale.key] = found
    return out


def _nominal(factor: FactorSpec, tree: Tree, unit: str) -> float:
    """The factor's value in the base, in its own unit; 1 for a factor that is itself the ratio."""
    if not factor.places:
        return 1.0
    value = leaf(tree, factor.places[0])
    parts = split_quantity(value)
    if parts is not None and unit:
        number = parts[0] * unit_ratio(parts[1], unit)
    elif parts is None and not unit and isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value)
    else:
        raise Problem("nothing to compare it with", f"{shown(value)} in the base", "a number like the factor's")
    if number == 0.0:
        raise Problem("nothing to compare it with", "zero in the base", "scales in a factor without a key")
    return number


def number_of(value: Any) -> tuple[float | int, str]:
    """Number and unit of a value of the tree, the unit empty for a pure number.

    Raises:
        Problem: it has none.
    """
    parts = split_quantity(value)
    if parts is not None:
        return parts
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Problem("not a number", shown(value), "a key that leads to a number or a quantity")
    return value, ""
