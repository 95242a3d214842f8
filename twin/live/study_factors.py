"""A study's factors as knobs, and the values that they have in one of its runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from scenes.specs.study import DesignSpec, FactorSpec
from scenes.yaml.errors import KeyPath
from scenes.yaml.units import split_quantity, unit_ratio, with_unit
from twin.live.knobs import AXES, KINDS, knob_name
from twin.study.runs.config_tree import Tree, leaf, with_values
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup


@dataclass(frozen=True)
class FactorKnob:
    """A study's factor that is a number.

    Attributes:
        name: as the study calls it.
        unit: of the numbers; empty for pure numbers.
        low, high: the study's smallest and largest value.
        value: where it begins: in the study's base, for a ratio 1, or in the run that was opened.
        whole: whether it counts.
        knobs: knob of a body -> how many of its units one of the factor's is; empty for what changes the instrument
            itself, which is then built anew.
    """

    name: str
    unit: str
    low: float
    high: float
    value: float
    whole: bool
    knobs: Mapping[str, float]

    def plain(self) -> dict[str, Any]:
        """As the page gets it."""
        return asdict(self)

    def scalar(self, value: float) -> Any:
        """A value as a study's file writes it."""
        number = int(value) if self.whole and value == int(value) else value
        return with_unit(number, self.unit) if self.unit else number

    def beginning(self, scalar: Any) -> FactorKnob:
        """The same where it begins at a value of a run, which a distribution may have drawn from beyond the range."""
        value = _number(scalar, self.unit, self.value)
        return replace(self, value=value, low=min(self.low, value), high=max(self.high, value))


def factor_knobs(setup: StudySetup) -> tuple[FactorKnob, ...]:
    """Of all of a study's factors that are numbers."""
    turned = (_factor(name, factor, setup) for name, factor in setup.study.factors.items())
    return tuple(factor for factor in turned if factor is not None)


def base_with(setup: StudySetup, scalars: Mapping[str, Any]) -> Tree:
    """The study's base where factors have these values, and all that follows them does.

    Args:
        setup: the study.
        scalars: factor -> value as a study's file writes it; the others leave the base as it is.

    Raises:
        InputError: a value that cannot be.
    """
    factors = {name: _fixed(setup.study.factors[name], scalar) for name, scalar in scalars.items()}
    one = setup.study.model_copy(update={"factors": factors, "design": DesignSpec(kind="grid")})
    return with_values(setup.tree, Plan.of(StudySetup(one, setup.tree)).run(0).values)


def _fixed(factor: FactorSpec, scalar: Any) -> FactorSpec:
    """The factor with this value alone."""
    kept = {"key": factor.key, "keys": factor.keys, "scales": factor.scales}
    return FactorSpec.model_validate({**{k: v for k, v in kept.items() if v}, "values": (scalar,)})


def _factor(name: str, factor: FactorSpec, setup: StudySetup) -> FactorKnob | None:
    """The knob of a factor; None where it is no number."""
    numbers = factor.numbers()
    if not numbers.numeric or not len(numbers):
        return None
    unit = numbers.unit or ""
    values = list(numbers.values)
    if factor.kind in ("normal", "truncated"):
        mean, sigma = values[:2]
        values = [mean - 4.0 * sigma, mean + 4.0 * sigma] if factor.kind == "normal" else values[2:]
    base = 1.0
    if factor.places:
        base = _number(leaf(setup.tree, factor.places[0]), unit, values[0])
    knobs = {} if factor.scales else _knobs(factor.places, unit)
    return FactorKnob(name, unit, min(*values, base), max(*values, base), base, numbers.whole, knobs)


def _number(value: Any, unit: str, otherwise: float) -> float:
    """A value of the base in the factor's unit."""
    if isinstance(value, int | float):
        return float(value)
    part = split_quantity(value)
    if part is None:
        return otherwise
    number, own = part
    return float(number) if own == unit else float(number) / unit_ratio(unit, own)


def _knobs(places: tuple[KeyPath, ...], unit: str) -> dict[str, float]:
    """Knobs that stand for the places of a factor; none where any is something else."""
    out = {}
    for place in places:
        found = _knob(place)
        if found is None:
            return {}
        name, own = found
        out[name] = 1.0 if unit == own else unit_ratio(unit, own) if unit else 0.0
    return out


def _knob(place: KeyPath) -> tuple[str, str] | None:
    """Name and unit of the knob that a place in a resolved job is."""
    match place:
        case ("job", "perturb", str(node), ("rotate" | "shift") as kind, int(axis)):
            return knob_name(node, kind, AXES[axis]), KINDS[kind].unit
        case ("job", "perturb", str(node), "figure", str(term)):
            return knob_name(node, "figure", term), KINDS["figure"].unit
        case ("job", "perturb", str(node), "scale"):
            return knob_name(node, "scale", ""), KINDS["scale"].unit
        case ("job", "perturb", str(node), "temperature", "change"):
            return knob_name(node, "temperature", ""), KINDS["temperature"].unit
        case ("job", "perturb", str(node), "temperature", "gradient", int(axis)):
            return knob_name(node, "gradient", AXES[axis]), KINDS["gradient"].unit
    return None
