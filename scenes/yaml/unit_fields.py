"""Quantities as fields of a specification: text with a unit in YAML, an SI float in the model, text again in YAML.

class Lens(Spec):
    focal_length: Length                                            # metres
    tilt: Annotated[float, Quantity(ANGLE, largest="5 deg")]        # radians

How the quantities of the files are written, by key: what a message shows where one is missing or cannot be read.

A kind of quantity has an example of its own; of a length that would be the 20 um of a shift, which no entrance pupil
has.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
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
    kind : units.Kind
        What it measures.
    largest : str | None
        Limit on its size (its absolute value), with unit; None for no limit.
    smallest : str | None
        Limit from below on the signed value, with unit.
    above_zero : bool
        It must be greater than zero.
    unsigned : str | None
        Of a difference: a larger one is written with its sign, since without it is hardly meant as one.
    """

    kind: units.Kind
    largest: str | None = None
    smallest: str | None = None
    above_zero: bool = False
    unsigned: str | None = None

    @cached_property
    def limits(self) -> str:
        """The limits in words, for messages and JSON Schema."""
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
        """The SI value of the text.

        Raises
        ------
        Problem
            Not a quantity of this kind, or outside the limits.
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
            meant = f"+{str(text).strip()} if it is meant as a change; at most {self.unsigned} without a sign"
            raise Problem(f"hardly meant as {self.kind.name}", shown(text), meant)
        return value

    def _lacks_sign(self, value: float) -> bool:
        return self.unsigned is not None and value > units.parse_quantity(self.unsigned, self.kind)

    def format(self, value: float) -> str:
        """Text with unit that `parse` reads back to exactly this value."""
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
    """Annotation that makes a tuple field a list of quantities of one sort and fixed length, in YAML `[0 um, 0 um, 3
    um]` or, with one unit for all, `0 0 3 um`.

    Attributes
    ----------
    of : Quantity
        What each of them is.
    length : int
        How many there are.
    alike : bool
        `3 um` is allowed, too, and means `3 3 3 um`.
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
                self.of.parse(value)  # what is wrong with it is said once
                row = [value] * self.length
            if row is None and (comma := units.decimal_comma(value)) is not None:
                raise comma
            value = row or value
        if isinstance(value, list | tuple) and len(value) == self.length:
            return value
        example = ", ".join([self.of.kind.example] * self.length)
        found = f"{len(value)} of them" if isinstance(value, list | tuple) else shown(value)
        allowed = f"{self.length} times {self.of.kind.name}: [{example}]"
        one = f"{self.of.kind.name} for all, {self.of.kind.example}, or " if self.alike else ""
        raise Problem(f"not a list of {self.length} quantities", found, one + allowed)


@dataclass(frozen=True)
class Terms:
    """Annotation that makes a mapping field a few optional quantities, each with a unit of its own.

    Attributes
    ----------
    of : Mapping[str, Quantity]
        Name -> quantity.
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
"""Radians."""
Length = Annotated[float, Quantity(units.LENGTH, largest="1000 km")]
"""Metres."""
PositiveLength = Annotated[float, Quantity(units.LENGTH, above_zero=True, largest="1000 m")]
"""Metres, greater than zero."""
Wavelength = Annotated[float, Quantity(units.LENGTH, smallest="100 nm", largest="100 um")]
"""Metres."""
AngleSigma = Annotated[float, Quantity(units.ANGLE, smallest="0 arcsec", largest="1 deg")]
"""A standard deviation, radians."""
AngleSigmas = Annotated[tuple[float, float, float], Vector(Quantity(units.ANGLE, smallest="0 arcsec", largest="1 deg"))]
"""Standard deviations about three axes, radians."""
LengthSigma = Annotated[float, Quantity(units.LENGTH, smallest="0 um", largest="5 mm")]
"""A standard deviation, metres."""
Scale = Annotated[float, Quantity(units.SCALE)]
"""A relative change, dimensionless: 1e-6 for 1 ppm."""
Time = Annotated[float, Quantity(units.TIME)]
"""Seconds."""
Temperature = Annotated[float, Quantity(units.TEMPERATURE, smallest="0 K")]
"""Kelvin, absolute."""


@dataclass(frozen=True)
class RadiusQuantity(Quantity):
    """A radius of curvature: a length, or ``flat`` for a plane, whose radius is infinite."""

    def parse(self, text: object) -> float:
        """The SI value of the text, as ``Quantity``."""
        return math.inf if text == FLAT else super().parse(text)

    def format(self, value: float) -> str:
        """Text that `parse` reads back to exactly this value."""
        return FLAT if math.isinf(value) else super().format(value)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        length = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [length, {"const": FLAT}], "description": f"{length['description']}; or {FLAT}"}


FLAT = "flat"
Radius = Annotated[float, RadiusQuantity(units.LENGTH, largest="1000 km")]
"""A radius of curvature, metres; infinite for a plane."""
AsphereTerms = Annotated[
    Mapping[str, float], Terms({f"A{n}": Quantity(units.power_of_length(1 - n)) for n in range(4, 22, 2)})
]
"""Terms of an even asphere's sag A4 r^4 + A6 r^6 + ... + A20 r^20, 1/m^3, 1/m^5, ...; those that are not written are
not there.
"""
Vector2 = Annotated[tuple[float, float], Vector(Quantity(units.LENGTH, largest="100 m"), 2)]
"""Two lengths, metres."""
Vector3 = Annotated[tuple[float, float, float], Vector(Quantity(units.LENGTH, largest="100 m"), 3)]
"""Three lengths, metres."""


class SagTerms:
    """Annotation of a mapping from names of ``SAG_TERMS`` to their numbers, those that are registered when the file is
    read; in the model the terms themselves.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Read by ``_read``, written as it was read."""
        as_text = core_schema.plain_serializer_function_ser_schema(self._written, when_used="json-unless-none")
        return core_schema.no_info_plain_validator_function(self._read, serialization=as_text)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The kinds at this moment with their numbers."""

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
        for name, given in _mapping(value, SAG_TERMS, "no such term of a sag").items():
            kind = SAG_TERMS[name]
            units = kind.POWERS
            numbers = _mapping(given, units, "unknown key", (name,))
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
    """A mapping with no other keys than these."""
    if not isinstance(value, Mapping):
        raise Problem("not a mapping", shown(value), f"a mapping with keys {names_text(names)}", within=within)
    for name in value:
        if name not in names:
            raise unknown(problem, name, names, (*within, name))
    return dict(value)


def _number(value: object, power: int, within: KeyPath) -> float:
    """A quantity in metres to a power, or a plain number."""
    try:
        if power:
            return units.parse_quantity(value, units.power_of_length(power))
    except Problem as problem:
        problem.within = within
        raise
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Problem("not a number", shown(value), "a plain number, without a unit", within=within)
    return float(value)


EXAMPLES: Mapping[str, tuple[str, ...]] = {
    "angle": ("5 deg",),
    "aperture": ("50 mm",),
    "argument": ("90 deg",),
    "back_radius": ("-0.5 m",),
    "camera_angle": ("26 deg",),
    "clearance": ("5 mm",),
    "correlation": ("500 m",),
    "diameter": ("50 mm",),
    "distance": ("0.5 m",),
    "elevation": ("45 deg",),
    "entrance_pupil": ("0.6 m",),
    "field": ("1.2 deg",),
    "field_bias": ("6 deg",),
    "parcel_size": ("100 m",),
    "focal_distance": ("0.5 m",),
    "focal_length": ("5.5 m", "10 um"),
    "front_radius": ("0.5 m",),
    "height": ("60 mm",),
    "last": ("360 deg",),
    "latitude": ("40 deg",),
    "light": ("80 percent",),
    "longest": ("2 km",),
    "longitude": ("116 deg",),
    "look": ("26 deg",),
    "noise": ("0.1 m",),
    "offset": ("5 mm",),
    "pitch": ("7 um",),
    "position": ("0.5 m",),
    "post": ("30 m",),
    "prism_0.shift": ("100 mm",),
    "pupil_offset": ("220 mm",),
    "radius": ("-2.5 m", "0.5 m"),
    "reach": ("0.2 mm",),
    "roads": ("500 m",),
    "separation": ("0.24 m",),
    "spacing": ("10 m",),
    "spectrum": ("650 nm",),
    "spread": ("60 mm",),
    "step": ("20 um", "1 deg"),
    "thickness": ("10 mm",),
    "track": ("20 km",),
    "velocity": ("0.1 m/s",),
    "wavelength": ("650 nm",),
    "white": ("80 percent",),
    "wide": ("5 deg",),
    "width": ("60 mm",),
    "x": ("1.2 deg",),
    "y": ("0.15 deg",),
    "z": ("-2 m",),
}
"""Key, or two of them, -> how its quantity may be written; the first that the key's own limits allow is shown."""


def example_of(quantity: Quantity, key: KeyPath) -> str:
    """How a quantity may be written at a key, within its limits."""
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
    """How the value of a field may be written, if it is a quantity or a row of them.

    Parameters
    ----------
    metadata : Iterable[Any]
        Annotations of the field.
    key : KeyPath
        Where it stands in the file.
    """
    for item in metadata:
        if isinstance(item, Quantity):
            return example_of(item, key)
        if isinstance(item, Vector):
            return f"[{', '.join([example_of(item.of, key)] * item.length)}]"
    return None


def allowed_at(metadata: Iterable[Any], key: KeyPath, allowed: str | None) -> str | None:
    """What may stand at a key, as the quantity's reader said it, with the key's own example in it."""
    for item in metadata:
        quantity = item.of if isinstance(item, Vector) else item
        if isinstance(quantity, Quantity) and allowed == quantity.kind.allowed:
            return quantity.kind.asked(example_of(quantity, key))
    return allowed


TimeScale = Literal["UTC", "GPS", "TAI", "TT", "GAL", "QZS", "BDT"]
"""What a clock shows."""


def _reading(value: Any) -> str:
    """What a clock read at 0 s; its form is checked where it is used."""
    if not isinstance(value, str) or not 10 < len(value) < 40:
        allowed = "a date and time such as '2011-03-05T03:05:00', in the file's time scale"
        raise Problem("not a date and time", repr(value), allowed)
    return value


ClockReading = Annotated[str, BeforeValidator(_reading)]
