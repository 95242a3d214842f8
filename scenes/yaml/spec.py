"""Specifications: immutable pydantic models that hold SI floats, made from plain YAML data.

A specification is what a YAML file says, checked. Quantities are text with a unit in the file and SI floats in the
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
"""A plain number, for values that have no unit by nature, such as a conic constant."""
Whole = Annotated[int, Field(strict=True)]
"""A whole number; 3.0 and true are not."""
Name = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")]
"""A name: letters, digits, _ and -, beginning with a letter."""
Text = Annotated[str, Field(strict=True, max_length=2000)]
"""Free text."""
Flag = Annotated[bool, Field(strict=True)]
"""True or false, and no number or word."""


@dataclass(frozen=True)
class Catalogued(AfterValidator):
    """Validator of a name that a catalogue knows.

    Attributes
    ----------
    names : Iterable[str]
        That may be given.
    """

    names: Iterable[str] = ()


def name_in(what: str, catalogue: Mapping[str, Any], look_up: Callable[[str], Any]) -> Catalogued:
    """A name that a catalogue knows, brought to the catalogue's own spelling.

    Parameters
    ----------
    what : str
        Is named, for the error message.
    catalogue : Mapping[str, Any]
        The names that may be given.
    look_up : Callable[[str], Any]
        Name -> entry with a ``name``; KeyError for an unknown one.
    """

    def check(name: str) -> str:
        try:
            return str(look_up(name).name)
        except KeyError:
            raise unknown(f"no such {what}", name, catalogue) from None

    return Catalogued(check, catalogue)


@dataclass(frozen=True, eq=False)
class OneOf:
    """Annotation of a text that must be one of the names that are registered somewhere when the file is read; errors
    and JSON Schema are those of a ``Literal`` of these names.

    Attributes
    ----------
    names : Callable[[], Iterable[str]]
        Gives them in the order in which a message lists them.
    """

    names: Callable[[], Iterable[str]]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Checked by ``_known``."""
        return core_schema.no_info_plain_validator_function(self._known)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The names at this moment."""
        return {"enum": list(self.names()), "type": "string"}

    def _known(self, value: Any) -> str:
        names = tuple(self.names())
        if not isinstance(value, str) or value not in names:
            raise unknown("not one of the choices", value, names)
        return value


def _nothing_is_empty(value: Any) -> Any:
    """`perturb:` with nothing after it means an empty mapping."""
    return {} if value is None else value


def _freeze(value: Mapping[str, Value]) -> FrozenMap[str, Value]:
    return FrozenMap(value)


Seed = Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)]
"""Seed of every random number."""
Reference = Annotated[str, Field(strict=True, min_length=1, max_length=1000)]
"""Path of a file of one's own, relative to the file that names it."""


class Inline(str):
    """A reference in whose place stands the mapping itself; as text it is the mapping's name.

    Attributes
    ----------
    yaml : YamlFile
        The mapping; with its file, lines and place where these are known, else with its place below the key of the
        reference.
    """

    yaml: YamlFile

    def __new__(cls, name: str, yaml: YamlFile) -> Self:
        """Make one of the mapping's name and the mapping."""
        reference = super().__new__(cls, name)
        reference.yaml = yaml
        return reference

    def __getnewargs__(self) -> tuple[str, YamlFile]:  # type: ignore[override]
        """What a copy in another process is made of."""
        return str(self), self.yaml

    def placed(self, source: Source, key: KeyPath) -> Inline:
        """Return the reference with the place of its mapping.

        Parameters
        ----------
        source : Source
            Of the specification that has the reference.
        key : KeyPath
            Of the reference there.
        """
        if self.yaml.file or self.yaml.lines:
            return self
        full = (*source.prefix, *key)
        while full and source.lines and full not in source.lines:  # the key of which the reference is the short form
            full = full[:-1]
        place = (*full, *self.yaml.prefix)
        return Inline(str(self), YamlFile(source.file, self.yaml.data, source.lines, place))


def _referred(value: Any, handler: ValidatorFunctionWrapHandler, within: KeyPath = ()) -> Any:
    """Take a name, a path or a mapping, each also as ``{camera: ...}``."""
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
"""Reference to another specification: its name in the library (`gf7`), the path of its file, relative to the file that
names it, or the mapping itself. ``{camera: ...}`` of an instrument is the camera by itself. `scenes.specs.load` reads
what it refers to.
"""

Named = Annotated[dict[Name, Value], AfterValidator(_freeze)]
"""A mapping from names to values of one sort."""
Paths = Annotated[dict[str, Value], BeforeValidator(_nothing_is_empty), AfterValidator(_freeze)]
"""A mapping from node paths to values of one sort; may be left empty."""
NothingIsEmpty = BeforeValidator(_nothing_is_empty)
"""For a section that may be written without contents."""


@dataclass(frozen=True, eq=False)
class Source:
    """Where a specification was read. All sources compare equal: where a value was read does not make it another value.

    Attributes
    ----------
    file : str
        Path as the user gave it, "" if it did not come from a file.
    lines : Mapping[KeyPath, int]
        Key path -> line, counted from 1.
    prefix : KeyPath
        Key path of the specification inside the file.
    """

    file: str = ""
    lines: Mapping[KeyPath, int] = data_field(default_factory=dict, repr=False)
    prefix: KeyPath = ()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Source)

    def __hash__(self) -> int:
        return 0

    def line(self, key: KeyPath) -> int | None:
        """The line of this key, or of the nearest thing around it that has one."""
        full = (*self.prefix, *key)
        return next((self.lines[full[:n]] for n in range(len(full), -1, -1) if full[:n] in self.lines), None)


class _Told(TypedDict, total=False):
    """What a message says beside what is wrong."""

    found: object
    allowed: str | None
    suggestion: str | None


class Spec(BaseModel):
    """Base of all specifications: immutable, and unknown keys are errors.

    What checks a model is built when the first file of its kind is read (``defer_build``). A default that is itself a
    specification is therefore made by ``model_construct``, which needs no checks: an instance of the class would have
    them built at the import.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=False, defer_build=True)

    _source: Source = PrivateAttr(default_factory=Source)

    @property
    def source(self) -> Source:
        """Where it was read; defaults and what was made in other ways do not know."""
        return self._source

    def with_source(self, source: Source) -> Self:
        """Return the specification with another place where it was read."""
        copy = self.model_copy()
        copy._source = source
        return copy

    def issue(self, problem: str | Problem, key: KeyPath = (), **told: Unpack[_Told]) -> Issue:
        """Something wrong with what stands at `key`, with the file and line it was read from.

        Parameters
        ----------
        problem : str | Problem
            What is wrong; or a Problem, which says all but the key.
        key : KeyPath
            In this specification.
        told : Unpack[_Told]
            Found (what stands there), allowed (what may stand there) and suggestion (the nearest valid name).
        """
        if not isinstance(problem, Problem):
            found = told.get("found")
            text = None if found is None else shown(found)
            problem = Problem(problem, text, told.get("allowed"), told.get("suggestion"))
        source = self._source
        return problem.at(source.file, source.line((*key, *problem.within)), (*source.prefix, *key))

    def error(self, problem: str | Problem, key: KeyPath = (), **told: Unpack[_Told]) -> InputError:
        """An `InputError` with one `issue`, for the caller to raise."""
        return InputError(self.issue(problem, key, **told))

    def file_at(self, key: KeyPath, value: str, folder: Path, what: str) -> Path:
        """The absolute path of a file that a specification names.

        Parameters
        ----------
        key : KeyPath
            That names it.
        value : str
            Its path, as it is written there.
        folder : Path
            That relative paths start from.
        what : str
            The file should be, for messages.

        Raises
        ------
        InputError
            There is none.
        """
        path = folder / value
        if is_file(path):
            return path.absolute()
        meant = file_beside(path)
        suggestion = None if meant is None else os.path.join(os.path.dirname(value), meant)
        raise self.error(unusable(path), key, allowed=f"{what}, relative to this file", suggestion=suggestion)

    def plain(self) -> dict[str, Any]:
        """Plain data, ready for YAML: quantities as text with units that reads back to the same bits, nothing that is
        None.
        """
        return self.model_dump(mode="json", exclude_none=True)


class TitledSpec(Spec):
    """Base of the files that have a name of their own.

    Attributes
    ----------
    name : Name
        As the file is called.
    description : Text
        For people.
    """

    name: Name
    description: Text = ""

    def file_text(self, remark: str, **others: Any) -> str:
        """Text of a file that says this, with remarks at its top; keys without a value are left out.

        Parameters
        ----------
        remark : str
            Lines of comment.
        others : Any
            Plain data of keys that are to be written in place of their own.
        """
        head = "".join(f"# {line}\n" for line in remark.splitlines())
        plain = {**self.plain(), **others}
        return head + dump_yaml({key: value for key, value in plain.items() if value not in ("", {})})


def one_given(spec: Spec, names: Sequence[str], problem: str, allowed: str | None = None, within: KeyPath = ()) -> None:
    """Refuse a specification that has none or several of the keys of which it needs one.

    Parameters
    ----------
    spec : Spec
        That was read.
    names : Sequence[str]
        Of the keys.
    problem : str
        What is wrong then.
    allowed : str | None
        What may be written.
    within : KeyPath
        The key at which that is told.

    Raises
    ------
    Problem
        Not one of them is given.
    """
    given = [name for name in names if getattr(spec, name) is not None]
    if len(given) != 1:
        words = ("neither", "both") if len(names) == 2 else ("none of them", " and ".join(given))
        raise Problem(problem, words[bool(given)], allowed, within=within)


def not_empty(problem: str, allowed: str) -> AfterValidator:
    """Validator that refuses a list or a mapping without entries."""

    def check(value: Any) -> Any:
        if not value:
            raise Problem(problem, f"an empty {'mapping' if isinstance(value, Mapping) else 'list'}", allowed)
        return value

    return AfterValidator(check)


def short_for(key: str | None, *types: type, schema: Any = PydanticUndefined) -> BeforeValidator:
    """Validator of what may be written short: a value of one of the types stands for ``{key: value}``, or for a list
    that holds it if the key is None.

    Parameters
    ----------
    key : str | None
        Which the value stands for.
    types : type
        Of a value that is short for it.
    schema : Any
        What editors are told that may be written; by default the long form.
    """

    def widen(value: Any) -> Any:
        if not isinstance(value, types):
            return value
        return [value] if key is None else {key: value}

    return BeforeValidator(widen, json_schema_input_type=schema)


SpecType = TypeVar("SpecType", bound=Spec)


def validate(model: type[SpecType], yaml: YamlFile) -> SpecType:
    """The specification that a YAML file holds.

    Raises
    ------
    InputError
        One issue for each fault, in the order of the file.
    """
    source = Source(yaml.file, yaml.lines, yaml.prefix)
    try:
        spec = model.model_validate(yaml.data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        # A list with wrong items is too short only because they are not counted.
        wrong = {detail["loc"][:-1] for detail in details} | {detail["loc"][:-2] for detail in details}
        told = [one for one in details if one["type"] != "too_short" or one["loc"] not in wrong]
        issues = [_issue(model, detail, source) for detail in told]
        raise InputError(*sorted(issues, key=lambda issue: issue.line or 0)) from None
    spec = spec.with_source(source)
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


_NOT_A_NAME = ("not a name", "letters, digits, _ and -, beginning with a letter")
_SAID = {
    **dict.fromkeys(("int_type", "int_from_float"), ("not a whole number", "a whole number")),
    "float_type": ("not a number", "a plain number, without a unit"),
    "finite_number": ("not a finite number", "a plain number, without a unit"),
    **dict.fromkeys(("bool_type", "bool_parsing"), ("neither true nor false", "true or false")),
    "string_type": ("not text", "text"),
    "string_pattern_mismatch": _NOT_A_NAME,
    **dict.fromkeys(("tuple_type", "list_type"), ("not a list", "a list: [...]")),
}
"""Pydantic's kind of an error -> what is wrong, and what is allowed, where its own words do not say it."""
_LIMITS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


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
        problem, found, suggestion = cause.problem, cause.found, cause.suggestion
        named = _named(key)
        allowed = allowed_at(_field_metadata(model, named), named, cause.allowed)
        key = (*key, *cause.within)
    elif kind == "missing":
        names = _fields(model, key[:-1])
        problem, found = f"{key[-1]!r} is missing", None
        example = written(_field_metadata(model, key), key)
        allowed = f"{key[-1]}: {example}" if example else names_text(names)
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
        problem, allowed = _NOT_A_NAME
    elif kind in _LIMITS:
        name, text = _LIMITS[kind]
        problem, allowed = "outside the limits", f"{text} {context[name]:g}"
    elif kind in _SAID:
        problem, allowed = _SAID[kind]
        if isinstance(value, str) and (comma := decimal_comma(value)) is not None:
            problem, allowed = comma.problem, comma.allowed
    elif kind == "too_short":
        problem, found = "too few items", str(context["actual_length"])
        allowed = f"at least {context['min_length']}"
    elif kind == "too_long":
        problem, found, allowed = "too many items", str(len(value)), f"at most {context['max_length']}"
    return Issue(problem, source.file, source.line(key), (*source.prefix, *key), found, allowed, suggestion)


def _fields(model: type[Spec], key: KeyPath) -> list[str]:
    """The keys that the mapping at `key` may have, empty if they are free or it is no mapping."""
    annotation = annotation_at(model, key)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return list(annotation.model_fields)
    return [name for item in _field_metadata(model, key) if isinstance(item, Terms) for name in item.of]


def _named(key: KeyPath) -> KeyPath:
    """The key up to its last name: without the place in a row."""
    return _named(key[:-1]) if key and isinstance(key[-1], int) else key


def _field_metadata(model: type[Spec], key: KeyPath) -> list[Any]:
    if not key:
        return []
    owner = annotation_at(model, key[:-1])
    if isinstance(owner, type) and issubclass(owner, BaseModel) and key[-1] in owner.model_fields:
        return owner.model_fields[str(key[-1])].metadata
    return []


class ZeroIsNone:
    """Metadata of the type of a number that may be absent: zero has the same effect as no value."""


ZERO_IS_NONE = ZeroIsNone()


def annotation_at(model: type[Spec], key: KeyPath) -> Any:
    """The type that a model declares for the value at `key`, without its annotations; None if `key` leads nowhere."""
    return _bare(_declared_at(model, key))


def metadata_at(model: type[Spec], key: KeyPath) -> tuple[Any, ...]:
    """Return the metadata of the type that a model declares for the value at `key`, of an optional value, too."""
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
            # A mapping's value type stands last, and so does the item type of a tuple without its ellipsis.
            items = [item for item in typing.get_args(annotation) if item is not Ellipsis]
            declared = items[-1] if items else None
    return declared


def _bare(annotation: Any) -> Any:
    if typing.get_origin(annotation) is typing.Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        # "or None": what may be left out
        return _bare(next(item for item in typing.get_args(annotation) if item is not type(None)))
    return annotation
