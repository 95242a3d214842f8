"""From plain YAML data to a specification; what pydantic finds wrong comes out as one InputError that a user can act
on.
"""

import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.quantity import Terms
from scenes.yaml.spec import Source, Spec
from scenes.yaml.yaml_file import YamlFile

SpecType = TypeVar("SpecType", bound=Spec)


def validate(model: type[SpecType], yaml: YamlFile) -> SpecType:
    """The specification that a YAML file holds.

    Raises:
        InputError: one issue for each fault, in the order of the file.
    """
    source = Source(yaml.file, yaml.lines)
    try:
        spec = model.model_validate(yaml.data)
    except ValidationError as error:
        issues = [_issue(model, detail, source) for detail in error.errors(include_url=False)]
        raise InputError(*sorted(issues, key=lambda issue: issue.line or 0)) from None
    spec = typing.cast(SpecType, spec.with_source(source))
    _tell_parts(spec, source)
    return spec


def _tell_parts(value: Any, source: Source) -> None:
    """Let every specification below ``value`` know where it was read; defaults were not, and are shared."""
    parts: typing.Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Spec):
        parts = [(name, getattr(value, name)) for name in type(value).model_fields if name in value.model_fields_set]
    elif isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, tuple | list):
        parts = enumerate(value)
    for name, part in parts:
        own = Source(source.file, source.lines, (*source.prefix, name))
        if isinstance(part, Spec):
            part._source = own
        if isinstance(part, Spec | Mapping | tuple | list):
            _tell_parts(part, own)


def _issue(model: type[Spec], detail: ErrorDetails, source: Source) -> Issue:
    key, value = detail["loc"], detail["input"]
    # A fault of a key itself rather than of what it leads to.
    of_key = bool(key) and key[-1] == "[key]"
    key = key[:-1] if of_key else key
    context: dict[str, Any] = detail.get("ctx", {})
    found: str | None = shown(value)
    allowed = suggestion = None
    problem = detail["msg"]
    kind = detail["type"]
    if kind == "value_error" and isinstance(context.get("error"), Problem):
        cause: Problem = context["error"]
        problem, found, allowed, suggestion = cause.problem, cause.found, cause.allowed, cause.suggestion
        key = (*key, *cause.within)
    elif kind == "missing":
        names = _fields(model, key[:-1])
        problem, found = f"{key[-1]!r} is missing", None
        allowed = f"{key[-1]}: {_example(model, key)}" if _example(model, key) else names_text(names)
    elif kind == "extra_forbidden":
        names = _fields(model, key[:-1])
        problem, found, allowed = "unknown key", shown(key[-1]), names_text(names)
        suggestion = nearest(str(key[-1]), names)
    elif kind in ("model_type", "dict_type", "model_attributes_type"):
        names = _fields(model, key)
        problem, allowed = "not a mapping", f"a mapping with keys {names_text(names)}" if names else "a mapping"
    elif kind == "literal_error":
        names = list(typing.get_args(annotation_at(model, key)))
        problem, allowed = "not one of the choices", names_text(names)
        suggestion = nearest(str(value), [str(name) for name in names])
    elif of_key:
        problem, allowed = "not a name", "letters, digits, _ and -, beginning with a letter"
    elif kind.startswith(("greater_than", "less_than")):
        problem, allowed = "outside the limits", _limit(kind, context)
    elif kind in ("int_type", "int_from_float"):
        problem, allowed = "not a whole number", "a whole number"
    elif kind == "float_type":
        problem, allowed = "not a number", "a plain number, without a unit"
    elif kind == "finite_number":
        problem, allowed = "not a finite number", "a plain number, without a unit"
    elif kind in ("bool_type", "bool_parsing"):
        problem, allowed = "neither true nor false", "true or false"
    elif kind == "string_type":
        problem, allowed = "not text", "text"
    elif kind == "string_pattern_mismatch":
        problem, allowed = "not a name", "letters, digits, _ and -, beginning with a letter"
    elif kind in ("tuple_type", "list_type"):
        problem, allowed = "not a list", "a list: [...]"
    elif kind in ("too_short", "too_long"):
        problem, found = problem[0].lower() + problem[1:], None
    return Issue(problem, source.file, source.line(key), (*source.prefix, *key), found, allowed, suggestion)


def _limit(kind: str, context: dict[str, Any]) -> str:
    words = {
        "greater_than": ("gt", "greater than"),
        "greater_than_equal": ("ge", "at least"),
        "less_than": ("lt", "less than"),
        "less_than_equal": ("le", "at most"),
    }
    name, text = words[kind]
    return f"{text} {context[name]:g}"


def _fields(model: type[Spec], key: KeyPath) -> list[str]:
    """The keys that the mapping at `key` may have, empty if they are free or it is no mapping."""
    annotation = annotation_at(model, key)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return list(annotation.model_fields)
    return [name for item in _field_metadata(model, key) if isinstance(item, Terms) for name in item.of]


def _example(model: type[Spec], key: KeyPath) -> str | None:
    """How the value at `key` may be written, if it is a quantity."""
    metadata = _field_metadata(model, key)
    kinds = [item.kind for item in metadata if hasattr(item, "kind")]
    return kinds[0].example if kinds else None


def _field_metadata(model: type[Spec], key: KeyPath) -> list[Any]:
    if not key:
        return []
    owner = annotation_at(model, key[:-1])
    if isinstance(owner, type) and issubclass(owner, BaseModel) and key[-1] in owner.model_fields:
        return owner.model_fields[str(key[-1])].metadata
    return []


def annotation_at(model: type[Spec], key: KeyPath) -> Any:
    """The type that a model declares for the value at `key`, without its annotations; None if `key` leads nowhere."""
    annotation: Any = model
    for part in key:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            field = annotation.model_fields.get(str(part))
            annotation = _bare(field.annotation) if field is not None else None
        else:
            # A mapping's value type stands last, and so does the item type of a tuple without its ellipsis.
            items = [item for item in typing.get_args(annotation) if item is not Ellipsis]
            annotation = _bare(items[-1]) if items else None
    return annotation


def _bare(annotation: Any) -> Any:
    if typing.get_origin(annotation) is typing.Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        # "or None": what may be left out
        return _bare(next(item for item in typing.get_args(annotation) if item is not type(None)))
    return annotation
