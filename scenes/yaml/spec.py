"""What all specifications share: immutable pydantic models that hold SI floats, know where they were read, and say what
is wrong.

A specification is what a YAML file says, checked. Quantities are text with a unit in the file and SI floats in the
model.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from dataclasses import field as data_field
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    StringConstraints,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown

Value = TypeVar("Value")

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
"""A plain number, for values that have no unit by nature, such as a conic constant."""
Whole = Annotated[int, Field(strict=True)]
"""A whole number; 3.0 and true are not."""
Name = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")]
"""A name: letters, digits, _ and -, beginning with a letter."""
Text = Annotated[str, Field(strict=True, max_length=2000)]
"""Free text."""


@dataclass(frozen=True)
class Catalogued(AfterValidator):
    """Validator of a name that a catalogue knows.

    Attributes:
        names: that may be given.
    """

    names: Iterable[str] = ()


def name_in(what: str, catalogue: Mapping[str, Any], look_up: Callable[[str], Any]) -> Catalogued:
    """A name that a catalogue knows, brought to the catalogue's own spelling.

    Args:
        what: is named, for the error message.
        catalogue: the names that may be given.
        look_up: name -> entry with a ``name``; KeyError for an unknown one.
    """

    def check(name: str) -> str:
        try:
            return str(look_up(name).name)
        except KeyError:
            raise Problem(f"no such {what}", shown(name), names_text(catalogue), nearest(name, catalogue)) from None

    return Catalogued(check, catalogue)


@dataclass(frozen=True, eq=False)
class OneOf:
    """Annotation of a text that must be one of the names that are registered somewhere when the file is read; errors
    and JSON Schema are those of a ``Literal`` of these names.

    Attributes:
        names: gives them in the order in which a message lists them.
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
            raise Problem("not one of the choices", shown(value), names_text(names), nearest(str(value), names))
        return value


def _nothing_is_empty(value: Any) -> Any:
    """`perturb:` with nothing after it means an empty mapping."""
    return {} if value is None else value


def _freeze(value: Mapping[str, Value]) -> FrozenMap[str, Value]:
    return FrozenMap(value)


Seed = Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)]
"""Of every random number."""
Reference = Annotated[str, Field(strict=True, min_length=1, max_length=1000)]
"""Name of a file in the library (`gf7`), or path of a file of one's own, relative to the file that names it."""

Named = Annotated[dict[Name, Value], AfterValidator(_freeze)]
"""A mapping from names to values of one sort."""
Paths = Annotated[dict[str, Value], BeforeValidator(_nothing_is_empty), AfterValidator(_freeze)]
"""A mapping from node paths to values of one sort; may be left empty."""
NothingIsEmpty = BeforeValidator(_nothing_is_empty)
"""For a section that may be written without contents."""


@dataclass(frozen=True, eq=False)
class Source:
    """Where a specification was read. All sources compare equal: where a value was read does not make it another value.

    Attributes:
        file: path as the user gave it, "" if it did not come from a file.
        lines: key path -> line, counted from 1.
        prefix: key path of the specification inside the file.
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


class Spec(BaseModel):
    """Base of all specifications: immutable, and unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=False)

    _source: Source = PrivateAttr(default_factory=Source)

    @property
    def source(self) -> Source:
        """Where it was read; defaults and what was made in other ways do not know."""
        return self._source

    def with_source(self, source: Source) -> "Spec":
        """The same, remembering that it was read there."""
        copy = self.model_copy()
        copy._source = source
        return copy

    def issue(
        self,
        problem: str,
        key: KeyPath = (),
        *,
        found: object = None,
        allowed: str | None = None,
        suggestion: str | None = None,
    ) -> Issue:
        """Something wrong with what stands at `key` of this specification, with the file and line it was read from."""
        source = self._source
        text = None if found is None else shown(found)
        return Issue(problem, source.file, source.line(key), (*source.prefix, *key), text, allowed, suggestion)

    def error(
        self,
        problem: str,
        key: KeyPath = (),
        *,
        found: object = None,
        allowed: str | None = None,
        suggestion: str | None = None,
    ) -> InputError:
        """An `InputError` with one `issue`, for the caller to raise."""
        return InputError(self.issue(problem, key, found=found, allowed=allowed, suggestion=suggestion))

    def plain(self) -> dict[str, Any]:
        """Plain data, ready for YAML: quantities as text with units that reads back to the same bits, nothing that is
        None.
        """
        return self.model_dump(mode="json", exclude_none=True)
