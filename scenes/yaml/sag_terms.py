"""Terms of a surface's sag as a mapping in YAML: kinds by name, each with its numbers and their units."""

from collections.abc import Mapping
from math import isfinite
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from optics.geometry.sag_terms import SAG_TERMS, SagTerm
from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.errors import KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.quantity import Quantity
from scenes.yaml.units import format_quantity, parse_quantity, power_of_length


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
            return Quantity(power_of_length(power)).__get_pydantic_json_schema__(schema, handler)

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
                key: format_quantity(number, power_of_length(power)) if power else number
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
            raise Problem(problem, shown(name), names_text(names), nearest(str(name), names), (*within, name))
    return dict(value)


def _number(value: object, power: int, within: KeyPath) -> float:
    """A quantity in metres to a power, or a plain number."""
    try:
        if power:
            return parse_quantity(value, power_of_length(power))
    except Problem as problem:
        problem.within = within
        raise
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise Problem("not a number", shown(value), "a plain number, without a unit", within=within)
    return float(value)
