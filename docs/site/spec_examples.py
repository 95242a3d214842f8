"""An example of every key that is known to be right: taken from a shipped file, or made up and checked by the model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from docs.site.spec_keys import NAMED, NODE, Key, Section, every_key, flow, keys, taken
from scenes.schema import MODELS
from scenes.specs.load import SCENES
from scenes.yaml.errors import InputError
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import YamlFile, read_yaml

LONGEST = 70
"""Characters of an example in a table; of longer ones a shorter one is looked for."""
BY_HAND = Path(__file__).with_name("examples.yaml")
"""Model -> mappings with keys that no shipped file has, and that mean more than what could be made up."""


@dataclass(frozen=True)
class Example:
    """A mapping that the model takes, with the key in it.

    Attributes:
        mapping: plain data, as read from YAML.
        key: that it is an example of.
        file: that it stands in, None for one that is made up.
    """

    mapping: dict[str, Any]
    key: str
    file: Path | None

    @property
    def text(self) -> str:
        """The key and its value as one line of YAML."""
        return f"{self.key}: {flow(self.mapping[self.key])}"


@cache
def shipped() -> dict[str, tuple[Path, ...]]:
    """Sort of file -> the shipped files of that sort, in order.

    Raises:
        ValueError: a shipped file that is of no sort, or of several.
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
    """The sorts of file that a file can be read as."""
    yaml = _read(path)
    out = []
    for kind, model in MODELS.items():
        if not isinstance(yaml.data, dict) or not set(yaml.data) <= set(model.model_fields):
            continue
        try:
            validate(model, yaml)
        except InputError:
            continue
        out.append(kind)
    return tuple(out)


@cache
def _read(path: Path) -> YamlFile:
    return read_yaml(path)


@cache
def _instances(kind: str) -> dict[type[Spec], list[tuple[dict[str, Any], Path | None]]]:
    """Every mapping of each model in the shipped files of a sort."""
    found: dict[type[Spec], list[tuple[dict[str, Any], Path | None]]] = {}
    for path in shipped()[kind]:
        for model, data in _mappings(MODELS[kind], _read(path).data):
            found.setdefault(model, []).append((data, path))
    return found


def _mappings(model: type[Spec], data: Any) -> Iterator[tuple[type[Spec], dict[str, Any]]]:
    if not isinstance(data, dict):
        return
    yield model, data
    for name, info in model.model_fields.items():
        if name in data:
            for between, below in taken(info.annotation, info.metadata).below:
                for part in _reached(data[name], between):
                    yield from _mappings(below, part)


def _reached(value: Any, between: str) -> Iterator[Any]:
    """What stands at ``.NAME`` or ``[]`` below a value."""
    if not between:
        yield value
    elif between.startswith((f".{NAMED}", f".{NODE}")) and isinstance(value, dict):
        for one in value.values():
            yield from _reached(one, between[len(NAMED) + 1 :])
    elif between.startswith("[]") and isinstance(value, list):
        for one in value:
            yield from _reached(one, between.removeprefix("[]"))


def example(kind: str, section: Section, key: Key) -> Example:
    """An example of a key in that sort of file.

    Raises:
        LookupError: none was found and none could be made up; `BY_HAND` is the place for one.
    """
    return _example(kind, section.model, key.name)


@cache
def _example(kind: str, model: type[Spec], name: str) -> Example:
    """Asked for by pages and, again and again, by tests."""
    (key,) = (one for one in keys(model) if one.name == name)
    known = [(data, path) for data, path in _instances(kind).get(model, []) if key.name in data]
    elsewhere = [
        (data, path) for other in MODELS for data, path in _instances(other).get(model, []) if key.name in data
    ]
    for data, path in sorted(known or elsewhere, key=lambda one: len(flow(one[0][key.name]))):
        if accepted(model, data) and (len(flow(data[key.name])) <= LONGEST or key.takes.below):
            return Example(data, key.name, path)
    for data in _by_hand().get(model.__name__, ()):
        if key.name in data:
            if not accepted(model, data):
                raise LookupError(f"{BY_HAND.name}: {model.__name__} does not take {flow(data)}")
            return Example(data, key.name, None)
    bases = [data for other in (kind, *MODELS) for data, _ in _instances(other).get(model, [])]
    for base in (*bases, least(model)):
        for value in _values(key):
            if accepted(model, {**base, key.name: value}):
                return Example({**base, key.name: value}, key.name, None)
    for data, path in known or elsewhere:
        if accepted(model, data):
            return Example(data, key.name, path)
    raise LookupError(f"{kind}: no example of {model.__name__}.{key.name}; {BY_HAND.name} is the place for one")


@cache
def _by_hand() -> dict[str, list[dict[str, Any]]]:
    return dict(read_yaml(BY_HAND).data)


def accepted(model: type[Spec], data: Any) -> bool:
    """Whether the model takes the mapping."""
    try:
        model.model_validate(data)
    except (ValidationError, InputError):
        return False
    return True


def least(model: type[Spec]) -> dict[str, Any]:
    """The smallest mapping of a model: what must be written, made up."""
    out = {}
    for key in keys(model):
        if key.required:
            values = list(_values(key))
            out[key.name] = values[0] if values else None
    return out


def _values(key: Key) -> Iterator[Any]:
    """Values that may be right."""
    takes = key.takes
    if key.name == "description":
        yield "what it is for"
    if takes.kind is not None and isinstance(takes.example, str):
        yield takes.example
        yield from (f"{number} {unit}" for unit in takes.kind.units for number in (1, 5, 20, 100))
    elif takes.example == ["name"]:
        yield from (["name"], ["forward", "backward"])
    elif takes.example is not None:
        yield takes.example
    for between, below in takes.below:
        value: Any = least(below)
        for step in reversed([part for part in between.replace("[]", ".[]").split(".") if part]):
            value = [value] if step == "[]" else {"base/forward/M2" if step == NODE else "name": value}
        yield value


def examples(kind: str) -> dict[tuple[type[Spec], str], Example]:
    """Example of every key of one sort of file."""
    return {(section.model, key.name): example(kind, section, key) for section, key in every_key(MODELS[kind])}
