"""Fields of a specification that are quantities: text with a unit in YAML, SI floats in the model.

    class Lens(Spec):
        focal_length: Length                                            # metres
        tilt: Annotated[float, Quantity(ANGLE, largest="5 deg")]        # radians

`EXAMPLES` has an example of a quantity for a key, for messages where it is missing or cannot be read: the example of
its kind, such as 20 um for a length, would be misleading for an entrance pupil.
"""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from optics.geometry.sag_terms import SAG_TERMS, SagTerm
from optics.numerics.number_tree import FrozenMap
from scenes.yaml import units
from scenes.yaml.errors import KeyPath, Problem, key_text, names_text, shown, unknown


@dataclass(frozen=True)
class Quantity:
    """Annotation that makes a float field a quantity with limits.

    Attributes
    ----------
    kind : Kind
        Kind of the quantity.
    largest : str | None
        Largest absolute value, with unit; None for no limit.
    smallest : str | None
        Smallest signed value, with unit; None for no limit.
    above_zero : bool
        True if the value must be greater than zero.
    unsigned : str | None
        Largest value, with unit, that may be written without a sign, for a difference: a larger unsigned value is
        probably meant as an absolute one. None for no limit.
    """

    kind: units.Kind
    largest: str | None = None
    smallest: str | None = None
    above_zero: bool = False
    unsigned: str | None = None

    @cached_property
    def limits(self) -> str:
        """Text of the limits, for messages and JSON Schema."""
        parts = []
        if self.above_zero:
            parts.append("greater than zero")
        if self.smallest is not None:
            parts.append(f"at least {self.smallest}")
        if self.largest is not None:
            parts.append(f"at most {self.largest} in size")
        if self.unsigned is not None:
            parts.append(f"with a sign if greater than {self.unsigned}")
        return " and ".join(parts)

    def parse(self, text: object) -> float:
        """Return the SI value of a text.

        Raises
        ------
        Problem
            The text is not a quantity of this kind, or is outside the limits.
        """
        value = units.parse_quantity(text, self.kind)
        outside = (
            (self.above_zero and not value > 0.0)
            or (self.smallest is not None and value < units.parse_quantity(self.smallest, self.kind))
            or (self.largest is not None and math.fabs(value) > units.parse_quantity(self.largest, self.kind))
        )
        if outside:
            raise Problem("outside the limits", shown(text), self.limits)
        if self._lacks_sign(value) and not str(text).lstrip().startswith("+"):
            remedy = f"+{str(text).strip()} if it is meant as a change; at most {self.unsigned} without a sign"
            raise Problem(f"hardly meant as {self.kind.name}", shown(text), remedy)
        return value

    def _lacks_sign(self, value: float) -> bool:
        return self.unsigned is not None and value > units.parse_quantity(self.unsigned, self.kind)

    def format(self, value: float) -> str:
        """Return text with a unit that `parse` reads back to exactly this value."""
        return ("+" if self._lacks_sign(value) else "") + units.format_quantity(value, self.kind)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self.parse, serialization=core_schema.plain_serializer_function_ser_schema(self.format, when_used="json")
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        limits = f"; {self.limits}" if self.limits else ""
        return {
            "type": "string",
            "pattern": units.pattern(self.kind),
            "description": f"{self.kind.allowed}{limits}",
            "examples": [self.kind.example],
        }


@dataclass(frozen=True)
class Vector:
    """Annotation that makes a tuple field a list of quantities of one kind and fixed length.

    In YAML it is `[0 um, 0 um, 3 um]` or, with one unit for all, `0 0 3 um`.

    Attributes
    ----------
    of : Quantity
        Annotation of each item.
    length : int
        Number of items.
    alike : bool
        True if one number, `3 um`, may stand for equal components, `3 3 3 um`.
    """

    of: Quantity
    length: int = 3
    alike: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        item = self.of.__get_pydantic_core_schema__(float, handler)
        items = core_schema.tuple_positional_schema([item] * self.length)
        return core_schema.no_info_before_validator_function(self._check_length, items)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        item = self.of.__get_pydantic_json_schema__(schema, handler)
        listed = {"type": "array", "items": item, "minItems": self.length, "maxItems": self.length}
        text = {
            "type": "string",
            "pattern": units.pattern(self.of.kind, self.length),
            "description": item["description"],
        }
        return {"anyOf": [listed, text, *([item] if self.alike else [])]}

    def _check_length(self, value: object) -> object:
        if isinstance(value, str):
            row = units.split_row(value, self.length)
            if row is None and self.alike:
                self.of.parse(value)  # raises the problem of a single quantity
                row = [value] * self.length
            if row is None and (comma := units.decimal_comma(value)) is not None:
                raise comma
            value = row or value
        if isinstance(value, list | tuple) and len(value) == self.length:
            return value
        example = ", ".join([self.of.kind.example] * self.length)
        actual = f"{len(value)} of them" if isinstance(value, list | tuple) else shown(value)
        allowed = f"{self.length} times {self.of.kind.name}: [{example}]"
        single = f"{self.of.kind.name} for all, {self.of.kind.example}, or " if self.alike else ""
        raise Problem(f"not a list of {self.length} quantities", actual, single + allowed)


@dataclass(frozen=True)
class Terms:
    """Annotation that makes a mapping field a set of optional quantities, each with its own unit.

    Attributes
    ----------
    of : Mapping[str, Quantity]
        Name of a term -> kind and limits of its quantity.
    """

    of: Mapping[str, Quantity]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        fields = {
            name: core_schema.typed_dict_field(item.__get_pydantic_core_schema__(float, handler), required=False)
            for name, item in self.of.items()
        }
        terms = core_schema.typed_dict_schema(fields, extra_behavior="forbid")
        return core_schema.no_info_after_validator_function(FrozenMap, terms)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        items = {name: item.__get_pydantic_json_schema__(schema, handler) for name, item in self.of.items()}
        return {"type": "object", "properties": items, "additionalProperties": False}


Angle = Annotated[float, Quantity(units.ANGLE)]
"""Angle, in radians."""
Length = Annotated[float, Quantity(units.LENGTH, largest="1000 km")]
"""Length, in metres."""
PositiveLength = Annotated[float, Quantity(units.LENGTH, above_zero=True, largest="1000 m")]
"""Length greater than zero, in metres."""
Wavelength = Annotated[float, Quantity(units.LENGTH, smallest="100 nm", largest="100 um")]
"""Wavelength, in metres."""
AngleSigma = Annotated[float, Quantity(units.ANGLE, smallest="0 arcsec", largest="1 deg")]
"""Standard deviation of an angle, in radians."""
AngleSigmas = Annotated[tuple[float, float, float], Vector(Quantity(units.ANGLE, smallest="0 arcsec", largest="1 deg"))]
"""Standard deviations of the angles about three axes, in radians."""
LengthSigma = Annotated[float, Quantity(units.LENGTH, smallest="0 um", largest="5 mm")]
"""Standard deviation of a length, in metres."""
Scale = Annotated[float, Quantity(units.SCALE)]
"""Relative change, without unit: 1e-6 for 1 ppm."""
Time = Annotated[float, Quantity(units.TIME)]
"""Time, in seconds."""
Temperature = Annotated[float, Quantity(units.TEMPERATURE, smallest="0 K")]
"""Absolute temperature, in kelvin."""


@dataclass(frozen=True)
class RadiusQuantity(Quantity):
    """Radius of curvature: a length, or ``flat`` for a plane, whose radius is infinite."""

    def parse(self, text: object) -> float:
        """Return the radius that a text gives, in metres; infinity for ``flat``."""
        return math.inf if text == FLAT else super().parse(text)

    def format(self, value: float) -> str:
        """Return text that `parse` reads back to exactly this value."""
        return FLAT if math.isinf(value) else super().format(value)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        length = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [length, {"const": FLAT}], "description": f"{length['description']}; or {FLAT}"}


FLAT = "flat"
Radius = Annotated[float, RadiusQuantity(units.LENGTH, largest="1000 km")]
"""Radius of curvature, in metres; infinite for a plane."""
AsphereTerms = Annotated[
    Mapping[str, float], Terms({f"A{n}": Quantity(units.power_of_length(1 - n)) for n in range(4, 22, 2)})
]
"""Coefficients of an even asphere's sag A4 r^4 + A6 r^6 + ... + A20 r^20, in 1/m^3, 1/m^5, ...; terms that are not
written are zero.
"""
Vector2 = Annotated[tuple[float, float], Vector(Quantity(units.LENGTH, largest="100 m"), 2)]
"""Two lengths, in metres."""
Vector3 = Annotated[tuple[float, float, float], Vector(Quantity(units.LENGTH, largest="100 m"), 3)]
"""Three lengths, in metres."""


class SagTerms:
    """Annotation of a mapping from names in ``SAG_TERMS`` to their coefficients; the model holds the terms themselves.

    The names are those registered when the file is read.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the pydantic schema that reads sag terms from a file and writes them in the form of the file."""
        as_text = core_schema.plain_serializer_function_ser_schema(self._written, when_used="json-unless-none")
        return core_schema.no_info_plain_validator_function(self._read, serialization=as_text)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON Schema of the sag terms registered at this moment, with their coefficients."""

        def value(power: int) -> JsonSchemaValue:
            if not power:
                return {"type": "number"}
            return Quantity(units.power_of_length(power)).__get_pydantic_json_schema__(schema, handler)

        kinds = {name: {key: value(power) for key, power in kind.POWERS.items()} for name, kind in SAG_TERMS.items()}
        terms = {
            name: {"type": "object", "properties": keys, "additionalProperties": False} for name, keys in kinds.items()
        }
        return {"type": "object", "properties": terms, "additionalProperties": False}

    def _read(self, value: object) -> FrozenMap[str, SagTerm]:
        terms = {}
        for name, coefficients in _mapping(value, SAG_TERMS, "no such term of a sag").items():
            kind = SAG_TERMS[name]
            units = kind.POWERS
            numbers = _mapping(coefficients, units, "unknown key", (name,))
            terms[name] = kind(**{key: _number(numbers[key], units[key], (name, key)) for key in numbers})
        return FrozenMap(terms)

    def _written(self, terms: Mapping[str, SagTerm]) -> dict[str, dict[str, object]]:
        return {
            name: {
                key: units.format_quantity(number, units.power_of_length(power)) if power else number
                for key, power in term.POWERS.items()
                if (number := getattr(term, key)) != 0.0
            }
            for name, term in terms.items()
        }


def _mapping(value: object, names: Mapping[str, Any], problem: str, within: KeyPath = ()) -> dict[str, Any]:
    """Return a mapping that has no other keys than `names`; raise `Problem` otherwise."""
    if not isinstance(value, Mapping):
        raise Problem("not a mapping", shown(value), f"a mapping with keys {names_text(names)}", within=within)
    for name in value:
        if name not in names:
            raise unknown(problem, name, names, (*within, name))
    return dict(value)


def _number(value: object, power: int, within: KeyPath) -> float:
    """Return the SI value of a quantity in a power of metres, or a number without unit for the power 0."""
    try:
        if power:
            return units.parse_quantity(value, units.power_of_length(power))
    except Problem as problem:
        problem.within = within
        raise
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Problem("not a number", shown(value), "a plain number, without a unit", within=within)
    return float(value)


def _examples() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the keys of the table beside this module with their examples."""
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as stream:
        for key, *texts in list(csv.reader(stream))[1:]:
            yield key, tuple(filter(None, texts))


EXAMPLES: Mapping[str, tuple[str, ...]] = FrozenMap(_examples())
"""Key, or its last two parts -> examples of its quantity; the first one within the key's limits is shown."""


def example_of(quantity: Quantity, key: KeyPath) -> str:
    """Return an example of a quantity at a key, within its limits."""
    limits = (text for text in (quantity.smallest, quantity.largest) if text is not None)
    known = (text for n in (2, 1) for text in EXAMPLES.get(key_text(key[-n:]), ()))
    for text in (*known, quantity.kind.example, *limits):
        try:
            quantity.parse(text)
        except Problem:
            continue
        return text
    return quantity.kind.example


def written(metadata: Iterable[Any], key: KeyPath) -> str | None:
    """Return an example of the value of a field that is a quantity or a list of them; None for others.

    Parameters
    ----------
    metadata : Iterable[Any]
        Annotations of the field.
    key : KeyPath
        Key path of the value in the file.
    """
    for item in metadata:
        if isinstance(item, Quantity):
            return example_of(item, key)
        if isinstance(item, Vector):
            return f"[{', '.join([example_of(item.of, key)] * item.length)}]"
    return None


def allowed_at(metadata: Iterable[Any], key: KeyPath, allowed: str | None) -> str | None:
    """Return the text of what is allowed at a key, with an example for this key instead of that of the kind."""
    for item in metadata:
        quantity = item.of if isinstance(item, Vector) else item
        if isinstance(quantity, Quantity) and allowed == quantity.kind.allowed:
            return quantity.kind.asked(example_of(quantity, key))
    return allowed


TimeScale = Literal["UTC", "GPS", "TAI", "TT", "GAL", "QZS", "BDT"]
"""Time scale of a clock: UTC, that of a navigation system, or an atomic time."""


def _reading(value: Any) -> str:
    """Check that a value looks like a date and time; its form is checked where it is used."""
    if not isinstance(value, str) or not 10 < len(value) < 40:
        allowed = "a date and time such as '2011-03-05T03:05:00', in the file's time scale"
        raise Problem("not a date and time", repr(value), allowed)
    return value


ClockReading = Annotated[str, BeforeValidator(_reading)]
"""Date and time, in the file's time scale, at which the times of a table are 0 s."""
