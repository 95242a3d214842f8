"""Specifications: immutable pydantic models that hold SI floats, made from plain YAML data.

A specification is the checked content of a YAML file. Quantities are text with a unit in the file and SI floats in the
model.
"""

from __future__ import annotations

import os
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as data_field
from pathlib import Path
from typing import Annotated, Any, Self, TypedDict, TypeVar, Unpack

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    StringConstraints,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, PydanticUndefined, core_schema

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown, unknown
from scenes.yaml.input_file import file_beside, is_file, unusable
from scenes.yaml.unit_fields import Terms, allowed_at, written
from scenes.yaml.units import decimal_comma
from scenes.yaml.yaml_file import YamlFile, dump_yaml

Value = TypeVar("Value")

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""A number without unit, for values that have none by nature, such as a conic constant."""
Whole = Annotated[int, Field(strict=True)]
"""An integer; 3.0 and true are refused."""
Name = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")]
"""Name of an item: letters, digits, _ and -, beginning with a letter."""
Text = Annotated[str, Field(strict=True, max_length=2000)]
"""Free text of at most 2000 characters."""
Flag = Annotated[bool, Field(strict=True)]
"""The value true or false; numbers and words are refused."""


@dataclass(frozen=True)
class Catalogued(AfterValidator):
    """Validator of a name that must be in a catalogue.

    Attributes
    ----------
    names : Iterable[str]
        Names that are allowed.
    """

    names: Iterable[str] = ()


def name_in(what: str, catalogue: Mapping[str, Any], look_up: Callable[[str], Any]) -> Catalogued:
    """Return a validator of a name in a catalogue, which changes it to the spelling of the catalogue.

    Parameters
    ----------
    what : str
        Noun for the named thing, for the error message.
    catalogue : Mapping[str, Any]
        Catalogue, whose keys are the allowed names.
    look_up : callable
        Function from a name to an entry with a ``name``; raises KeyError for an unknown name.
    """

    def check(name: str) -> str:
        try:
            return str(look_up(name).name)
        except KeyError:
            raise unknown(f"no such {what}", name, catalogue) from None

    return Catalogued(check, catalogue)


@dataclass(frozen=True, eq=False)
class OneOf:
    """Annotation of a text that must be one of the names registered when the file is read.

    Errors and JSON Schema are those of a ``Literal`` of these names.

    Attributes
    ----------
    names : callable
        Function that returns the names in the order in which a message lists them.
    """

    names: Callable[[], Iterable[str]]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Return the pydantic schema that accepts one of the names registered at this moment."""
        return core_schema.no_info_plain_validator_function(self._known)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON Schema that lists the names registered at this moment."""
        return {"enum": list(self.names()), "type": "string"}

    def _known(self, value: Any) -> str:
        names = tuple(self.names())
        if not isinstance(value, str) or value not in names:
            raise unknown("not one of the choices", value, names)
        return value


def _nothing_is_empty(value: Any) -> Any:
    """Return an empty mapping for None, which is the value of a section such as `perturb:` without contents."""
    return {} if value is None else value


def _freeze(value: Mapping[str, Value]) -> FrozenMap[str, Value]:
    return FrozenMap(value)


Seed = Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)]
"""Seed of all random numbers of a file: an integer from 0 to 2**63 - 1."""
Reference = Annotated[str, Field(strict=True, min_length=1, max_length=1000)]
"""Path of a user's file, relative to the file that refers to it."""


class Inline(str):
    """Reference that is replaced by the content itself, a mapping written where a name or path is allowed.

    As text it is the mapping's name.

    Attributes
    ----------
    yaml : YamlFile
        The mapping, with its file, lines and position where these are known, else with its position below the key of
        the reference.
    """

    yaml: YamlFile

    def __new__(cls, name: str, yaml: YamlFile) -> Self:
        """Create a reference from the mapping's name and the mapping."""
        reference = super().__new__(cls, name)
        reference.yaml = yaml
        return reference

    def __getnewargs__(self) -> tuple[str, YamlFile]:  # type: ignore[override]
        """Return the arguments from which another process creates a copy."""
        return str(self), self.yaml

    def placed(self, source: Source, key: KeyPath) -> Inline:
        """Return the reference with the position of its mapping in the file.

        Parameters
        ----------
        source : Source
            Source of the specification that has the reference.
        key : KeyPath
            Key of the reference in that specification.
        """
        if self.yaml.file or self.yaml.lines:
            return self
        full = (*source.prefix, *key)
        while full and source.lines and full not in source.lines:  # a short form has the line of a shorter key
            full = full[:-1]
        path = (*full, *self.yaml.prefix)
        return Inline(str(self), YamlFile(source.file, self.yaml.data, source.lines, path))


def _referred(value: Any, handler: ValidatorFunctionWrapHandler, within: KeyPath = ()) -> Any:
    """Return a name, a path or a mapping in the form of a reference; each may also be given as ``{camera: ...}``."""
    if isinstance(value, Inline):
        return value
    if isinstance(value, Mapping):
        if set(value) == {"camera"}:
            return _referred(value["camera"], handler, ("camera",))
        name = value.get("name")
        if not isinstance(name, str):
            allowed = "the name of a file of the library, the path of one, or what such a file says, with its `name`"
            raise Problem("neither a file nor what one says", shown(value), allowed)
        return Inline(name, YamlFile("", value, {}, within))
    return handler(value)


Ref = Annotated[
    str,
    Field(strict=True, min_length=1, max_length=1000),
    WrapValidator(_referred, json_schema_input_type=Reference | dict[str, Any]),
]
"""Reference to another specification: its name in the library (`gf7`), the path of its file relative to the file that
refers to it, or the mapping itself.

``{camera: ...}`` instead of an instrument means an instrument that consists of this camera alone. `scenes.specs.load`
reads the specification.
"""

Named = Annotated[dict[Name, Value], AfterValidator(_freeze)]
"""Mapping from names to values of one type."""
Paths = Annotated[dict[str, Value], BeforeValidator(_nothing_is_empty), AfterValidator(_freeze)]
"""Mapping from node paths to values of one type; may be left empty."""
NothingIsEmpty = BeforeValidator(_nothing_is_empty)
"""Validator of a section that may be written without contents."""


@dataclass(frozen=True, eq=False)
class Source:
    """Origin of a specification: file, lines and key path.

    All sources compare equal, so that specifications with equal values from different files are equal.

    Attributes
    ----------
    file : str
        Path as the user wrote it, "" if the specification did not come from a file.
    lines : Mapping[KeyPath, int]
        Key path -> line, counted from 1.
    prefix : KeyPath
        Key path of the specification inside the file; empty if it is the whole file.
    """

    file: str = ""
    lines: Mapping[KeyPath, int] = data_field(default_factory=dict, repr=False)
    prefix: KeyPath = ()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Source)

    def __hash__(self) -> int:
        return 0

    def line(self, key: KeyPath) -> int | None:
        """Return the line of a key, or of the nearest enclosing key that has one."""
        full = (*self.prefix, *key)
        return next((self.lines[full[:n]] for n in range(len(full), -1, -1) if full[:n] in self.lines), None)


class _IssueDetails(TypedDict, total=False):
    """Optional parts of an issue besides the problem: value in the file, values allowed, suggestion."""

    value: object
    allowed: str | None
    suggestion: str | None


class Spec(BaseModel):
    """Base of all specifications: immutable, and unknown keys are errors.

    The validator of a model is built when the first file of its kind is read (``defer_build``). A default that is
    itself a specification is therefore made by ``model_construct``, which does not validate: an ordinary instance would
    build the validator at import time.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=False, defer_build=True)

    _source: Source = PrivateAttr(default_factory=Source)

    @property
    def source(self) -> Source:
        """Origin of the specification; empty for defaults and for specifications that did not come from a file."""
        return self._source

    def with_source(self, source: Source) -> Self:
        """Return a copy of the specification with another origin."""
        copy = self.model_copy()
        copy._source = source
        return copy

    def issue(self, problem: str | Problem, key: KeyPath = (), **details: Unpack[_IssueDetails]) -> Issue:
        """Return the issue of the value at `key`, with the file and line from which it was read.

        Parameters
        ----------
        problem : str | Problem
            Short text of the fault; or a Problem, which holds everything but the key.
        key : KeyPath
            Key path in this specification.
        details : keyword arguments
            `value`, the value in the file; `allowed`, the values allowed; and `suggestion`, the nearest valid name.
        """
        if not isinstance(problem, Problem):
            value = details.get("value")
            text = None if value is None else shown(value)
            problem = Problem(problem, text, details.get("allowed"), details.get("suggestion"))
        source = self._source
        return problem.at(source.file, source.line((*key, *problem.within)), (*source.prefix, *key))

    def error(self, problem: str | Problem, key: KeyPath = (), **details: Unpack[_IssueDetails]) -> InputError:
        """Return an `InputError` with one `issue`, for the caller to raise."""
        return InputError(self.issue(problem, key, **details))

    def file_at(self, key: KeyPath, value: str, folder: Path, what: str) -> Path:
        """Return the absolute path of a file to which a specification refers.

        Parameters
        ----------
        key : KeyPath
            Key of the reference.
        value : str
            Path as written at the key.
        folder : Path
            Folder from which relative paths start.
        what : str
            Noun phrase for the expected file, for messages.

        Raises
        ------
        InputError
            There is no such file.
        """
        path = folder / value
        if is_file(path):
            return path.absolute()
        near = file_beside(path)
        suggestion = None if near is None else os.path.join(os.path.dirname(value), near)
        raise self.error(unusable(path), key, allowed=f"{what}, relative to this file", suggestion=suggestion)

    def plain(self) -> dict[str, Any]:
        """Return plain data for YAML, without keys that are None.

        Quantities are text with units that reads back to the same bits.
        """
        return self.model_dump(mode="json", exclude_none=True)


class TitledSpec(Spec):
    """Base of the specifications of files that have a name and a description.

    Attributes
    ----------
    name : str
        Name of the file's content, which results and other files refer to.
    description : str
        Description for readers; the program does not use it. Empty by default.
    """

    name: Name
    description: Text = ""

    def file_text(self, remark: str, **others: Any) -> str:
        """Return the text of a file with this content, with comments at its top; empty keys are omitted.

        Parameters
        ----------
        remark : str
            Lines of the comment.
        others : keyword arguments
            Keys of the file with other values, as plain data.
        """
        head = "".join(f"# {line}\n" for line in remark.splitlines())
        plain = {**self.plain(), **others}
        return head + dump_yaml({key: value for key, value in plain.items() if value not in ("", {})})


def require_one(
    spec: Spec, names: Sequence[str], problem: str, allowed: str | None = None, within: KeyPath = ()
) -> None:
    """Raise `Problem` unless a specification has exactly one of some keys.

    Parameters
    ----------
    spec : Spec
        Specification to check.
    names : Sequence[str]
        The keys.
    problem : str
        Text of the problem.
    allowed : str | None
        Text of what is allowed.
    within : KeyPath
        Key at which the problem is reported.

    Raises
    ------
    Problem
        None or several of the keys have a value.
    """
    present = [name for name in names if getattr(spec, name) is not None]
    if len(present) != 1:
        words = ("neither", "both") if len(names) == 2 else ("none of them", " and ".join(present))
        raise Problem(problem, words[bool(present)], allowed, within=within)


def not_empty(problem: str, allowed: str) -> AfterValidator:
    """Return a validator that refuses a list or a mapping without entries."""

    def check(value: Any) -> Any:
        if not value:
            raise Problem(problem, f"an empty {'mapping' if isinstance(value, Mapping) else 'list'}", allowed)
        return value

    return AfterValidator(check)


def short_for(key: str | None, *types: type, schema: Any = PydanticUndefined) -> BeforeValidator:
    """Return a validator that expands a short form: a value of one of the types becomes ``{key: value}``.

    Parameters
    ----------
    key : str | None
        Key for which the value is short; None for a list that holds the value.
    types : type
        Types of a value that is a short form.
    schema : type
        Type that the JSON Schema shows to editors; by default the long form.
    """

    def widen(value: Any) -> Any:
        if not isinstance(value, types):
            return value
        return [value] if key is None else {key: value}

    return BeforeValidator(widen, json_schema_input_type=schema)


SpecType = TypeVar("SpecType", bound=Spec)


def validate(model: type[SpecType], yaml: YamlFile) -> SpecType:
    """Return the specification that a YAML file holds.

    Raises
    ------
    InputError
        The file has faults; one issue for each, in the order of the file.
    """
    source = Source(yaml.file, yaml.lines, yaml.prefix)
    try:
        spec = model.model_validate(yaml.data)
    except ValidationError as error:
        # a default that follows from other keys is not a fault beside those of these keys
        details = [d for d in error.errors(include_url=False) if d["type"] != "default_factory_not_called"]
        # Pydantic does not count invalid items, so a list with some is also reported as too short.
        wrong = {detail["loc"][:-1] for detail in details} | {detail["loc"][:-2] for detail in details}
        faults = [detail for detail in details if detail["type"] != "too_short" or detail["loc"] not in wrong]
        issues = [_issue(model, fault, source) for fault in faults]
        raise InputError(*sorted(issues, key=lambda issue: issue.line or 0)) from None
    spec = spec.with_source(source)
    _set_sources(spec, source)
    return spec


def _set_sources(value: Any, source: Source) -> None:
    """Set the origin of every specification below ``value``, except defaults, which are shared."""
    parts: typing.Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Spec):
        parts = [(name, getattr(value, name)) for name in type(value).model_fields if name in value.model_fields_set]
    elif isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, tuple | list):
        parts = enumerate(value)
    for name, part in parts:
        part_source = Source(source.file, source.lines, (*source.prefix, name))
        if isinstance(part, Spec):
            part._source = part_source
        if isinstance(part, Spec | Mapping | tuple | list):
            _set_sources(part, part_source)


_NOT_A_NAME = ("not a name", "letters, digits, _ and -, beginning with a letter")
_MESSAGES = {
    **dict.fromkeys(("int_type", "int_from_float"), ("not a whole number", "a whole number")),
    "float_type": ("not a number", "a plain number, without a unit"),
    "finite_number": ("not a finite number", "a plain number, without a unit"),
    **dict.fromkeys(("bool_type", "bool_parsing"), ("neither true nor false", "true or false")),
    "string_type": ("not text", "text"),
    "string_pattern_mismatch": _NOT_A_NAME,
    **dict.fromkeys(("tuple_type", "list_type"), ("not a list", "a list: [...]")),
}
"""Type of a pydantic error -> the problem and what is allowed, where pydantic's own message is not clear enough."""
_LIMITS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def _issue(model: type[Spec], detail: ErrorDetails, source: Source) -> Issue:
    """Return the issue, with file, line and plain message, for an error that pydantic reports."""
    key, value = detail["loc"], detail["input"]
    # The fault is in the key itself, not in its value.
    of_key = bool(key) and key[-1] == "[key]"
    key = key[:-1] if of_key else key
    context: dict[str, Any] = detail.get("ctx", {})
    actual: str | None = shown(value)
    allowed = suggestion = None
    problem = detail["msg"]
    kind = detail["type"]
    if kind == "value_error" and isinstance(context.get("error"), Problem):
        cause: Problem = context["error"]
        problem, actual, suggestion = cause.problem, cause.value, cause.suggestion
        named = _named(key)
        allowed = allowed_at(_field_metadata(model, named), named, cause.allowed)
        key = (*key, *cause.within)
    elif kind == "missing":
        names = _fields(model, key[:-1])
        problem, actual = f"{key[-1]!r} is missing", None
        example = written(_field_metadata(model, key), key)
        allowed = f"{key[-1]}: {example}" if example else names_text(names)
    elif kind == "extra_forbidden":
        names = _fields(model, key[:-1])
        problem, actual, allowed = "unknown key", shown(key[-1]), names_text(names)
        suggestion = nearest(str(key[-1]), names)
    elif kind in ("model_type", "dict_type", "model_attributes_type"):
        names = _fields(model, key)
        problem, allowed = "not a mapping", f"a mapping with keys {names_text(names)}" if names else "a mapping"
    elif kind == "literal_error":
        names = list(typing.get_args(annotation_at(model, key)))
        problem, allowed = "not one of the choices", names_text(names)
        suggestion = nearest(str(value), [str(name) for name in names])
    elif of_key:
        problem, allowed = _NOT_A_NAME
    elif kind in _LIMITS:
        name, text = _LIMITS[kind]
        problem, allowed = "outside the limits", f"{text} {context[name]:g}"
    elif kind in _MESSAGES:
        problem, allowed = _MESSAGES[kind]
        if isinstance(value, str) and (comma := decimal_comma(value)) is not None:
            problem, allowed = comma.problem, comma.allowed
    elif kind == "too_short":
        problem, actual = "too few items", str(context["actual_length"])
        allowed = f"at least {context['min_length']}"
    elif kind == "too_long":
        problem, actual, allowed = "too many items", str(len(value)), f"at most {context['max_length']}"
    return Issue(problem, source.file, source.line(key), (*source.prefix, *key), actual, allowed, suggestion)


def _fields(model: type[Spec], key: KeyPath) -> list[str]:
    """Return the keys that the mapping at `key` may have; empty if any are allowed or there is no mapping."""
    annotation = annotation_at(model, key)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return list(annotation.model_fields)
    return [name for item in _field_metadata(model, key) if isinstance(item, Terms) for name in item.of]


def _named(key: KeyPath) -> KeyPath:
    """Return the key path up to its last name, without list indices at its end."""
    return _named(key[:-1]) if key and isinstance(key[-1], int) else key


def _field_metadata(model: type[Spec], key: KeyPath) -> list[Any]:
    if not key:
        return []
    owner = annotation_at(model, key[:-1])
    if isinstance(owner, type) and issubclass(owner, BaseModel) and key[-1] in owner.model_fields:
        return owner.model_fields[str(key[-1])].metadata
    return []


class ZeroIsNone:
    """Metadata of the type of an optional number for which zero has the same effect as no value."""


ZERO_IS_NONE = ZeroIsNone()


def annotation_at(model: type[Spec], key: KeyPath) -> Any:
    """Return the type that a model declares for the value at `key`, without annotations; None for no such key."""
    return _bare(_declared_at(model, key))


def metadata_at(model: type[Spec], key: KeyPath) -> tuple[Any, ...]:
    """Return the metadata of the type that a model declares for the value at `key`, also of an optional value."""
    declared = _declared_at(model, key)
    if typing.get_origin(declared) in (types.UnionType, typing.Union):
        declared = next(item for item in typing.get_args(declared) if item is not type(None))
    return getattr(declared, "__metadata__", ())


def _declared_at(model: type[Spec], key: KeyPath) -> Any:
    declared: Any = model
    for part in key:
        annotation = _bare(declared)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            field = annotation.model_fields.get(str(part))
            declared = field.annotation if field is not None else None
        else:
            # The last argument is a mapping's value type, or a tuple's item type once the ellipsis is removed.
            items = [item for item in typing.get_args(annotation) if item is not Ellipsis]
            declared = items[-1] if items else None
    return declared


def _bare(annotation: Any) -> Any:
    if typing.get_origin(annotation) is typing.Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        # an optional value: its type without None
        return _bare(next(item for item in typing.get_args(annotation) if item is not type(None)))
    return annotation
