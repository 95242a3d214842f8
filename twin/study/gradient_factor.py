"""A factor of a study as something to differentiate by: its value in the base, its spread, and what it changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scenes.errors import KeyPath, Problem, shown
from scenes.study_factor import FactorSpec
from scenes.units import split_quantity, unit_ratio
from twin.study.config_tree import leaf
from twin.study.scaling import number_of, ratios, scaled
from twin.study.setup import StudySetup


@dataclass(frozen=True, eq=False)
class GradientFactor:
    """One factor.

    Attributes:
        setup: the study.
        name: of the factor.
        unit: of its numbers, empty for pure ones.
        value: in the base.
        spread: sigma of a normal distribution, else half of the range of its values; in its unit.
        spread_of: which of the two, in words.
    """

    setup: StudySetup
    name: str
    unit: str
    value: float
    spread: float
    spread_of: str

    @classmethod
    def of(cls, setup: StudySetup, name: str) -> GradientFactor:
        """The factor of that name.

        Raises:
            InputError: it has no numbers, or the base has none where it acts.
        """
        factor = setup.study.factors[name]
        numbers = factor.numbers()
        if not numbers.numeric:
            found = shown(list(factor.scalars()))
            problem = Problem("there is no derivative by what is not a number", found, "numbers or quantities")
            raise setup.error(problem, ("factors", name, factor.kind))
        unit = numbers.unit or ""
        values = numbers.values
        if factor.kind in ("normal", "truncated"):
            spread, spread_of = values[1], "sigma"
        else:
            spread, spread_of = 0.5 * (max(values) - min(values)), "half of its range"
        if spread == 0.0:
            spread, spread_of = 1.0, "one unit"
        return cls(setup, name, unit, _in_base(setup, name, factor, unit), spread, spread_of)

    @property
    def spec(self) -> FactorSpec:
        """As the study describes it."""
        return self.setup.study.factors[self.name]

    def values(self, value: float) -> tuple[tuple[KeyPath, Any], ...]:
        """(place, what stands there) of all that the factor changes when it has this value; others are as in the base.

        Raises:
            InputError: a value that follows the factor cannot be worked out.
        """
        cell = f"{value!r} {self.unit}" if self.unit else value
        out: dict[KeyPath, Any] = dict.fromkeys(self.spec.places, cell)
        if self.spec.scales:
            tree = self.setup.tree
            try:
                found = ratios(self.spec, tree, np.array([value]), self.unit)
                out.update({place: scaled(number_of(leaf(tree, place)), float(r[0])) for place, r in found.items()})
            except Problem as problem:
                raise self.setup.error(problem, ("factors", self.name)) from None
        return tuple(out.items())


def _in_base(setup: StudySetup, name: str, factor: FactorSpec, unit: str) -> float:
    """The factor's value in the base, in its own unit; 1 for one that only scales."""
    found = [leaf(setup.tree, place) for place in factor.places]
    if not found:
        return 1.0
    numbers: list[float] = []
    for k, value in enumerate(found):
        number = _number(value, unit)
        if number is None:
            what = shown(value) if value is not None else "nothing"
            problem = Problem("the base has no number here to differentiate at", what, "a number of the factor's kind")
            raise setup.error(problem, ("factors", name, *factor.key_of(k)))
        numbers.append(number)
        # values that are written in several units agree to rounding
        if abs(number - numbers[0]) > 1e-12 * abs(numbers[0]):
            text = "the places of the factor have different values in the base, so that it has none"
            raise setup.error(Problem(text, shown(value), shown(found[0])), ("factors", name, *factor.key_of(k)))
    return numbers[0]


def _number(value: Any, unit: str) -> float | None:
    parts = split_quantity(value)
    if parts is not None and unit:
        return parts[0] * unit_ratio(parts[1], unit)
    if parts is None and not unit and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return None
