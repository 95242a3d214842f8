"""Every key of every kind of YAML file, from the JSON Schemas of the models that check the files, with examples."""

from __future__ import annotations

import inspect
import json
import re
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from scenes.schema import MODELS, WithUnits
from scenes.specs.load import SCENES
from scenes.yaml.errors import InputError
from scenes.yaml.spec import Catalogued, Spec, validate
from scenes.yaml.yaml_file import YamlFile, read_yaml

NAMED, NODE, LISTED = ".NAME", ".NODE", "[]"
"""Notation in key paths for an item under a user's name, under a node's path, and for the items of a list."""
LONGEST = 70
"""Characters of an example in a table above which a shorter example is sought."""
BY_HAND = Path(__file__).with_name("examples.yaml")
"""File with model -> mappings for keys that no shipped file has; missing keys are taken from a shipped mapping."""
_ATTRIBUTE = re.compile(r"^(\w+(?:, \w+)*)(?: : .*)?\n((?:(?: {4}.*)?\n)*(?: {4}.*))", re.MULTILINE)
"""One attribute of a class under NumPy's heading: its names, and the indented text below them."""
_QUANTITY = re.compile(r"(?:an? |the )?(.*) with its unit \((.*)\), e\.g\. '[^']*'(?:; (.*))?")
_SI_UNIT = re.compile(r",? (?:in )?(?:metres|radians|seconds|kelvin)\b")
_PLAIN = re.compile(
    r"(?!(?:true|false|null)$)[A-Za-z/][\w/.+*^-]*(?: [\w/.(+*^-][\w/.+*^()-]*)*"
    r"|[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)? [\w/^%-]+",
    re.I,
)
_WORDS = {"boolean": "true or false", "integer": "whole number", "number": "number", "string": "text"}
_BOUNDS = {
    "exclusiveMinimum": "greater than",
    "minimum": "at least",
    "exclusiveMaximum": "less than",
    "maximum": "at most",
}


@dataclass(frozen=True)
class Takes:
    """Values that a key allows.

    Attributes
    ----------
    what : str
        Type in words: "angle", "3 × length", "one of traced, ignore".
    units : tuple[str, ...]
        Suggested units; others of the same dimension are read, too.
    limits : str
        Limits in words, empty for none.
    below : tuple[tuple[str, str], ...]
        Names of the specifications that it contains, each after the part of the key path before it: "", ".NAME", "[]".
    """

    what: str
    units: tuple[str, ...] = ()
    limits: str = ""
    below: tuple[tuple[str, str], ...] = ()

    def within(self, what: str, between: str) -> Takes:
        """Return the same values as items of a list or mapping."""
        each = "" if what.startswith("mapping") and self.what == "mapping" else f", each {self.what}"
        below = tuple((f"{between}{more}", model) for more, model in self.below)
        return Takes(f"{what}{each}", self.units, self.limits, below)


@dataclass(frozen=True)
class Key:
    """Key of a mapping.

    Attributes
    ----------
    name : str
        Name of the key.
    meaning : str
        Description in the docstring, without the SI unit, which applies to the program only.
    takes : Takes
        Values that it allows.
    default : str
        Default value, as YAML; empty for a required key.
    below : tuple[tuple[str, type[Spec]], ...]
        Models of its content, each after the part of the key path before it.
    """

    name: str
    meaning: str
    takes: Takes
    default: str
    below: tuple[tuple[str, type[Spec]], ...]


def sections(model: type[Spec]) -> dict[type[Spec], list[str]]:
    """Return the key paths of all mappings of a kind of file, by model, in the order of the keys; "" is the file."""
    places: dict[type[Spec], list[str]] = {}

    def walk(here: type[Spec], place: str) -> None:
        places.setdefault(here, []).append(place)
        for key in keys(here):
            for between, below in key.below:
                walk(below, f"{place}.{key.name}{between}".lstrip("."))

    walk(model, "")
    return places


@cache
def keys(model: type[Spec]) -> tuple[Key, ...]:
    """Return the keys of one mapping."""
    schema, said, out = model.model_json_schema(schema_generator=WithUnits), attributes(model), []
    for field, item in schema["properties"].items():
        info = model.model_fields[field]
        parts = list(_parts((info.annotation, *info.metadata)))
        catalogue = [", ".join(part.names) for part in parts if isinstance(part, Catalogued)]
        takes = Takes(f"one of {catalogue[0]}") if catalogue else taken(item)
        # A model of a few keys may describe all of them in its summary.
        meaning = said.get(field) or summary(model)
        if takes.units:
            meaning = _SI_UNIT.sub("", meaning)
        # None in the program is a key that is not written.
        meaning = re.sub(r"\bNone (?=for|where|if|when|in)", "left out ", meaning)
        models = {part.__name__: part for part in parts if inspect.isclass(part) and issubclass(part, Spec)}
        # Other models of the schema have a page of their own.
        below = tuple((between, models[name]) for between, name in takes.below if name in models)
        out.append(Key(field, meaning, takes, "" if info.is_required() else _default(item, takes), below))
    return tuple(out)


def _parts(hints: typing.Iterable[Any]) -> Iterator[Any]:
    """Yield types and annotations at any depth of type hints."""
    for hint in hints:
        yield hint
        yield from _parts(typing.get_args(hint))


def summary(model: type[Any]) -> str:
    """Return the first paragraph of a docstring."""
    return " ".join((model.__doc__ or "").split("\n\n")[0].split())


def attributes(model: type[Any]) -> dict[str, str]:
    """Return the descriptions of attributes in the docstrings of a class and its bases."""
    out: dict[str, str] = {}
    for base in reversed(model.__mro__):
        text = inspect.cleandoc(base.__dict__.get("__doc__") or "").partition("Attributes\n----------\n")[2]
        for names, meaning in _ATTRIBUTE.findall(text):
            out |= {name: " ".join(meaning.split()) for name in names.split(", ")}
    return out


def taken(schema: Mapping[str, Any]) -> Takes:
    """Return the values that a JSON Schema allows for a key.

    Raises
    ------
    TypeError
        The schema has a form that the reference cannot describe.
    """
    if "$ref" in schema:
        return Takes("mapping", below=(("", re.split("__|/", schema["$ref"])[-1]),))
    if "anyOf" in schema:
        return _either(schema["anyOf"])
    if "enum" in schema:
        return Takes(f"one of {', '.join(map(str, schema['enum']))}")
    if "const" in schema:
        return Takes(f"`{schema['const']}`")
    if found := _QUANTITY.fullmatch(schema.get("description", "")):
        units = tuple(unit or "1" for unit in re.split(", | or ", found[2]))
        return Takes(found[1], units, found[3] or "")
    if schema["type"] == "object":
        return _mapping(schema)
    if schema["type"] == "array":
        return _list(schema)
    limits = " and ".join(f"{words} {bound_text(schema[name])}" for name, words in _BOUNDS.items() if name in schema)
    if schema.get("pattern", "").startswith("^[A-Za-z]"):
        return Takes("name")
    return Takes("name or path" if schema.get("minLength") else _WORDS[schema["type"]], limits=limits)


def _either(schemas: list[dict[str, Any]]) -> Takes:
    """Return the values that any of several schemas allows."""
    # A mapping without keys represents the file that a name means; a vector may be a text as well.
    named = [one for one in schemas if one.get("type") != "null" and one.get("additionalProperties") is not True]
    alike = {json.dumps(one.get("items", one).get("description", one)): one for one in reversed(named)}
    several = [taken(one) for one in reversed(alike.values())]
    words = list(dict.fromkeys(one.what for one in several))
    what = (", or " if any(", each" in word for word in words) else " or ").join(words)
    return Takes(what, several[0].units, several[0].limits, tuple(pair for one in several for pair in one.below))


def _list(schema: Mapping[str, Any]) -> Takes:
    """Return the values of a list."""
    items = schema.get("prefixItems") or [schema["items"]] * schema.get("minItems", 0)
    if not items or schema.get("maxItems") != len(items):
        return taken(schema["items"]).within("list", LISTED)
    several = [taken(one) for one in items]
    words = [one.what for one in several]
    what = f"{len(items)} × {words[0]}" if len(set(words)) == 1 else f"list of {len(items)}: {', '.join(words)}"
    below = tuple((f"{LISTED}{more}", model) for one in several for more, model in one.below)
    return Takes(what, several[0].units, several[0].limits, tuple(dict.fromkeys(below)))


def _mapping(schema: Mapping[str, Any]) -> Takes:
    """Return the values of a mapping."""
    if "properties" in schema:
        each = {key: taken(one) for key, one in schema["properties"].items()}
        parts = (f"`{key}` in `{one.units[0]}`" if one.units else f"`{key}`: {one.what}" for key, one in each.items())
        return Takes(f"mapping ({'; '.join(parts)})")
    ((pattern, item),) = schema.get("patternProperties", {"": schema.get("additionalProperties")}).items()
    if pattern.startswith("^[A-Za-z]"):
        return taken(item).within("mapping by name", NAMED)
    terms = pattern.startswith("^Z") or "propertyNames" in schema
    return taken(item).within(f"mapping by {'Zernike term' if terms else 'node'}", NODE)


def bound_text(value: float) -> str:
    """Return a limit as the reference writes it."""
    if value == 2**63 - 1:
        return "2⁶³ − 1"
    return f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}") if isinstance(value, int) else f"{value:g}"


def _default(schema: Mapping[str, Any], takes: Takes) -> str:
    """Return the default of a key as a file would write it."""
    value = schema.get("default", {})
    if value is None:
        return "none"
    if "$ref" in schema or (takes.below and value):
        return "its own defaults"
    text = flow(value) if value or isinstance(value, bool | int | float) else "empty"
    # Prefer a unit that needs no power of ten.
    return re.sub(r"([\d.]+e\+\d+) um", lambda found: f"{1e-6 * float(found[1]):g} m", text)


def flow(value: Any) -> str:
    """Return a value as one line of YAML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(flow(one) for one in value) + "]"
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    # Texts that YAML could read as another type are quoted as in JSON.
    return value if isinstance(value, str) and _PLAIN.fullmatch(value) else json.dumps(value, ensure_ascii=False)


# --- examples --------------------------------------------------------------------------------------------


@cache
def shipped() -> dict[str, tuple[Path, ...]]:
    """Return the shipped files of each kind, in order.

    Raises
    ------
    ValueError
        A shipped file is of no kind, or of several.
    """
    out: dict[str, list[Path]] = {kind: [] for kind in MODELS}
    for path in sorted(SCENES.rglob("*.yaml")):
        kinds = kinds_of(path)
        if len(kinds) != 1:
            raise ValueError(f"{path.name} can be read as: {', '.join(kinds) or 'nothing'}")
        out[kinds[0]].append(path)
    return {kind: tuple(paths) for kind, paths in out.items()}


@cache
def kinds_of(path: Path) -> tuple[str, ...]:
    """Return the kinds of file that a file can be read as."""
    yaml = _read(path)
    out = []
    for kind, model in MODELS.items():
        if isinstance(yaml.data, dict) and set(yaml.data) <= set(model.model_fields):
            try:
                validate(model, yaml)
            except InputError:
                continue
            out.append(kind)
    return tuple(out)


@cache
def _read(path: Path) -> YamlFile:
    """Return the content of a YAML file, cached."""
    return read_yaml(path)


@cache
def _instances(kind: str) -> dict[type[Spec], list[dict[str, Any]]]:
    """Return every mapping of each model in the shipped files of a kind."""
    found: dict[type[Spec], list[dict[str, Any]]] = {}
    for path in shipped()[kind]:
        for model, data in _mappings(MODELS[kind], _read(path).data):
            found.setdefault(model, []).append(data)
    return found


def _mappings(model: type[Spec], data: Any) -> Iterator[tuple[type[Spec], dict[str, Any]]]:
    """Yield all specifications within one, as plain data; nothing where a name takes the place of a mapping."""
    if isinstance(data, dict):
        yield model, data
        for key in keys(model):
            for between, below in key.below if key.name in data else ():
                values = [data[key.name]]
                for step in re.findall(r"\.\w+|\[\]", between):
                    sort = list if step == LISTED else dict
                    held = (value for value in values if isinstance(value, sort))
                    values = [one for value in held for one in (value.values() if sort is dict else value)]
                for value in values:
                    yield from _mappings(below, value)


@cache
def example(kind: str, model: type[Spec], name: str) -> dict[str, Any]:
    """Return a mapping that a model accepts, with the key in it, from a shipped file or `BY_HAND`.

    Raises
    ------
    LookupError
        There is no such mapping.
    """
    (key,) = (one for one in keys(model) if one.name == name)
    shipped_ones = [data for other in (kind, *MODELS) for data in _instances(other).get(model, ())]
    having = [data for data in _instances(kind).get(model, ()) if name in data]
    having = having or [data for data in shipped_ones if name in data]
    short = (data for data in having if key.takes.below or len(flow(data[name])) <= LONGEST)
    by_hand = [data for base in model.__mro__ for data in read_by_hand().get(base.__name__, ()) if name in data]
    candidates = [
        *sorted(short, key=lambda data: len(flow(data[name]))),
        *({**base, **data} for data in by_hand for base in ({}, *shipped_ones)),
        *having,
    ]
    for data in candidates:
        if accepted(model, data):
            return data
    raise LookupError(f"{kind}: no example of {model.__name__}.{name}; {BY_HAND.name} is the place for one")


@cache
def read_by_hand() -> dict[str, list[dict[str, Any]]]:
    """Return the mappings of ``BY_HAND`` by the name of their model."""
    return dict(read_yaml(BY_HAND).data)


def accepted(model: type[Spec], data: Any) -> bool:
    """Return True if the model accepts the mapping."""
    try:
        model.model_validate(data)
    except (ValidationError, InputError):
        return False
    return True
