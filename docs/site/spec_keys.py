"""Every key of every sort of YAML file, read off the models that check the files: what the reference says of it."""

from __future__ import annotations

import inspect
import json
import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from pydantic import TypeAdapter, WithJsonSchema
from pydantic.fields import FieldInfo

from scenes.yaml.quantity import Quantity, Terms, Vector
from scenes.yaml.spec import Catalogued, OneOf, Spec
from scenes.yaml.units import Kind, format_quantity, unit_ratio

NAMED, NODE, LISTED = "NAME", "NODE", "[]"
"""How a key path writes what stands under a name of the user's choice, under a node's path, and the items of a list."""
_ATTRIBUTE = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)
_ARTICLE = re.compile(r"^(an?|the) ")
_SI_UNIT = re.compile(r",? (?:metres|radians|seconds|kelvin)\b")
_PLAIN = re.compile(
    r"(?!(?:true|false|null)$)[A-Za-z/][\w/.+*^-]*(?: [\w/.(+*^-][\w/.+*^()-]*)*"
    r"|[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)? [\w/^%-]+",
    re.I,
)
_WORDS = {bool: "true or false", int: "whole number", float: "number", str: "text"}


@dataclass(frozen=True)
class Takes:
    """What may stand after a key.

    Attributes:
        what: in words: "angle", "3 × length", "one of traced, ignore".
        units: that are suggested; others of the same dimension are read, too.
        limits: in words, empty for none.
        below: specifications that it holds, with what stands between in a key path: "", ".NAME", "[]".
        example: as it may be written where no shipped file has it, None where nothing is known.
        kind: measure of a quantity.
    """

    what: str
    units: tuple[str, ...] = ()
    limits: str = ""
    below: tuple[tuple[str, type[Spec]], ...] = ()
    example: Any = None
    kind: Any = None


@dataclass(frozen=True)
class Key:
    """One key of a section.

    Attributes:
        name: of the key.
        meaning: what the docstring says, without the SI unit that only the program knows.
        takes: what may stand after it.
        default: what holds where it is not written, as YAML; empty where it must be written.
        required: whether it must be written.
    """

    name: str
    meaning: str
    takes: Takes
    default: str
    required: bool


@dataclass(frozen=True)
class Section:
    """A mapping in a file: a model with its keys.

    Attributes:
        model: that checks it.
        summary: of its docstring.
        keys: in the order of the model.
        places: key paths at which it stands in the file, "" for the file itself.
    """

    model: type[Spec]
    summary: str
    keys: tuple[Key, ...]
    places: tuple[str, ...] = field(default=())


def sections(model: type[Spec]) -> tuple[Section, ...]:
    """All mappings of one sort of file, each model once, in the order in which the file's keys lead to them."""
    places: dict[type[Spec], list[str]] = {}
    _walk(model, "", places)
    return tuple(Section(one, summary(one), keys(one), tuple(where)) for one, where in places.items())


def _walk(model: type[Spec], place: str, places: dict[type[Spec], list[str]]) -> None:
    places.setdefault(model, []).append(place)
    for key in keys(model):
        for between, below in key.takes.below:
            _walk(below, f"{place}.{key.name}{between}".lstrip("."), places)


@cache
def keys(model: type[Spec]) -> tuple[Key, ...]:
    """The keys of one mapping."""
    said = attributes(model)
    out = []
    for name, info in model.model_fields.items():
        takes = taken(info.annotation, info.metadata)
        # a model of a few keys may say all in a sentence
        meaning = said.get(name) or summary(model)
        if takes.kind is not None:
            meaning = _SI_UNIT.sub("", meaning)
        # what a program calls None is a key that is not written
        meaning = re.sub(r"\bNone (?=for|where|if|when|in)", "left out ", meaning)
        default = "" if info.is_required() else default_text(info, takes)
        out.append(Key(name, meaning, takes, default, info.is_required()))
    return tuple(out)


def summary(model: type[Any]) -> str:
    """First paragraph of a docstring."""
    return " ".join((model.__doc__ or "").split("\n\n")[0].split())


def attributes(model: type[Any]) -> dict[str, str]:
    """What the docstrings of a class and of those it inherits from say of its attributes."""
    out: dict[str, str] = {}
    for one in reversed(model.__mro__):
        text = inspect.cleandoc(one.__dict__.get("__doc__") or "")
        for names, said in _ATTRIBUTE.findall(text[text.find("Attributes:") :] if "Attributes:" in text else ""):
            out |= {name: " ".join(said.split()) for name in names.split(", ")}
    return out


def taken(annotation: Any, metadata: typing.Iterable[Any] = ()) -> Takes:
    """What may stand where a model declares this type.

    Raises:
        TypeError: a type that the reference cannot describe.
    """
    annotation, marks = _unwrapped(annotation, list(metadata))
    mark: Any
    for mark in marks:
        if isinstance(mark, Quantity):
            return _quantity(mark)
        if isinstance(mark, Vector):
            one = _quantity(mark.of)
            rows = [one.example] * mark.length
            return Takes(f"{mark.length} × {one.what}", one.units, one.limits, (), rows, one.kind)
        if isinstance(mark, Terms):
            parts = [f"`{name}` ({item.kind.units[0]})" for name, item in mark.of.items()]
            name, item = next(iter(mark.of.items()))
            return Takes(f"mapping of the terms {', '.join(parts)}", (), "", (), {name: item.kind.example})
        if isinstance(mark, Catalogued):
            names = tuple(mark.names)
            return Takes(f"one of {', '.join(names)}", example=names[0])
        if isinstance(mark, OneOf):
            names = tuple(mark.names())
            return Takes(f"one of {', '.join(names)}", example=names[0])
    if typing.get_origin(annotation) is typing.Literal:
        choices = typing.get_args(annotation)
        return Takes(f"one of {', '.join(map(str, choices))}", example=choices[0])
    if isinstance(annotation, type) and issubclass(annotation, Spec):
        return Takes("mapping", below=(("", annotation),))
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        return _either([taken(one) for one in typing.get_args(annotation) if one is not types.NoneType])
    if typing.get_origin(annotation) is tuple:
        return _listed(typing.get_args(annotation), marks)
    if typing.get_origin(annotation) is dict:
        return _mapped(*typing.get_args(annotation))
    if annotation in _WORDS:
        return _plain(annotation, marks)
    if any(hasattr(mark, "__get_pydantic_json_schema__") for mark in marks):
        return _by_schema(TypeAdapter(typing.Annotated[(annotation, *marks)]).json_schema())
    raise TypeError(f"no words for {annotation!r} {marks!r}")


def _by_schema(schema: dict[str, Any]) -> Takes:
    """What a type of its own says in its JSON Schema: a mapping with its keys, at any depth.

    Raises:
        TypeError: neither a mapping with known keys nor a quantity nor a number.
    """
    if "properties" in schema:
        below = {key: _by_schema(one) for key, one in schema["properties"].items()}
        parts = [f"`{key}` in `{one.units[0]}`" if one.units else f"`{key}`: {one.what}" for key, one in below.items()]
        key, one = next(iter(below.items()))
        return Takes(f"mapping ({'; '.join(parts)})", example={key: one.example})
    if schema.get("type") == "number":
        return Takes("number", example=0.001)
    if schema.get("type") == "string" and schema.get("examples"):
        example = schema["examples"][0]
        return Takes(
            schema.get("description", "text").split(" with its unit")[0], (example.split(" ", 1)[1],), "", (), example
        )
    raise TypeError(f"no words for {schema!r}")


def _unwrapped(annotation: Any, marks: list[Any]) -> tuple[Any, list[Any]]:
    """A type without Annotated and without None, and all annotations on the way."""
    while True:
        if typing.get_origin(annotation) is typing.Annotated:
            annotation, *more = typing.get_args(annotation)
            marks = [*more, *marks]
        elif typing.get_origin(annotation) in (types.UnionType, typing.Union):
            rest = [one for one in typing.get_args(annotation) if one is not type(None)]
            if len(rest) > 1:
                break
            annotation = rest[0]
        else:
            break
    flat: list[Any] = []
    for mark in marks:
        flat += mark.metadata if isinstance(mark, FieldInfo) else [mark]
    return annotation, flat


def _quantity(mark: Quantity) -> Takes:
    units = tuple(unit or "1" for unit in mark.kind.units)
    return Takes(_ARTICLE.sub("", mark.kind.name), units, mark.limits, (), mark.kind.example, mark.kind)


def _plain(sort: type, marks: list[Any]) -> Takes:
    bounds = {name: getattr(mark, name) for mark in marks for name in ("gt", "ge", "lt", "le") if hasattr(mark, name)}
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    limits = " and ".join(f"{words[name]} {_bound(bounds[name])}" for name in words if bounds.get(name) is not None)
    example: Any = {bool: True, int: 1, float: 0.5, str: "name"}[sort]
    if sort in (int, float) and bounds:
        low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", bounds.get("lt"))
        example = low if low is not None and "gt" not in bounds else high if high is not None else example
    what = _WORDS[sort]
    schemas = [mark.json_schema or {} for mark in marks if isinstance(mark, WithJsonSchema)]
    for names in (schema["enum"] for schema in schemas if "enum" in schema):
        return Takes(f"one of {', '.join(names)}", example=names[0])
    if sort is str and any(str(getattr(mark, "pattern", None) or "").startswith("^[A-Za-z]") for mark in marks):
        what = "name"
    if sort is str and any(getattr(mark, "min_length", None) for mark in marks):
        what = "name or path"
    return Takes(what, (), limits, (), example)


def _bound(value: float) -> str:
    if value == 2**63 - 1:
        return "2⁶³ − 1"
    return f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}") if isinstance(value, int) else f"{value:g}"


def _listed(items: tuple[Any, ...], marks: list[Any]) -> Takes:
    if items[-1] is Ellipsis:
        one = taken(items[0])
        return Takes(
            f"list, each {one.what}",
            one.units,
            one.limits,
            _deeper(LISTED, one),
            None if one.example is None else [one.example],
            one.kind,
        )
    several = [taken(item) for item in items]
    first = several[0]
    if all(one.what == first.what for one in several):
        what = f"{len(items)} × {first.what}"
    else:
        what = f"list of {len(items)}: {', '.join(one.what for one in several)}"
    below = tuple(pair for one in several for pair in _deeper(LISTED, one))
    return Takes(what, first.units, first.limits, below, [one.example for one in several], first.kind)


def _mapped(name: Any, value: Any) -> Takes:
    one = taken(value)
    of = taken(name)
    free = of.what == "name"
    # what is no name of the user's choice is the path of a node, or the term of a figure
    by = "name" if free else "Zernike term" if "_is_term" in str(name) else "node"
    key = "Z5" if "_is_term" in str(name) else "name" if free else "base/forward/M2"
    what = f"mapping by {by}, each {one.what}" if one.what != "mapping" else f"mapping by {by}"
    example = None if one.example is None else {key: one.example}
    return Takes(what, one.units, one.limits, _deeper(f".{NAMED if free else NODE}", one), example, one.kind)


def _deeper(between: str, one: Takes) -> tuple[tuple[str, type[Spec]], ...]:
    return tuple((f"{between}{more}", model) for more, model in one.below)


def _either(several: list[Takes]) -> Takes:
    words = list(dict.fromkeys(one.what for one in several))
    below = tuple(pair for one in several for pair in one.below)
    return Takes(" or ".join(words), several[0].units, several[0].limits, below, several[-1].example, several[0].kind)


def default_text(info: FieldInfo, takes: Takes) -> str:
    """What holds where a key is not written, as it would be written."""
    value = info.get_default(call_default_factory=True)
    if value is None:
        return "none"
    if isinstance(value, Spec):
        return "its own defaults"
    if takes.kind is not None and isinstance(value, float):
        return quantity_text(value, takes.kind)
    if takes.kind is not None and isinstance(value, tuple) and all(isinstance(one, float) for one in value):
        return flow([quantity_text(one, takes.kind) for one in value])
    if isinstance(value, str) and not value:
        return "empty"
    if not isinstance(value, str | bool | int | float) and not value:
        return "empty"
    return flow(value)


def quantity_text(value: float, kind: Kind) -> str:
    """A quantity in a unit in which it is read easily; `format_quantity` writes few digits at any power of ten."""
    text = format_quantity(value, kind)
    if "e" not in text.split()[0]:
        return text
    numbers = {unit: value * unit_ratio(kind.si, unit) for unit in kind.units}
    return min((f"{number:.12g} {unit}" for unit, number in numbers.items()), key=len)


def flow(value: Any) -> str:
    """A value as one line of YAML."""
    if isinstance(value, typing.Mapping):
        return "{" + ", ".join(f"{key}: {flow(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(flow(one) for one in value) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, int):
        return str(value)
    # what could be read as something else stands in quotes, in the way of JSON, which YAML reads
    return str(value) if _PLAIN.fullmatch(str(value)) else json.dumps(str(value), ensure_ascii=False)


def every_key(model: type[Spec]) -> Iterator[tuple[Section, Key]]:
    """All keys of one sort of file, with the mapping that each stands in."""
    for section in sections(model):
        for key in section.keys:
            yield section, key
