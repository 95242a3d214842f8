"""Functions and classes that are named by module and name, and imported when they are used.

A kind of file that a user writes: its model, how it is told from others, and the command that reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from operator import attrgetter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenes.yaml.spec import Spec

_BEFORE = __name__.removesuffix("scenes.yaml.named")
_OURS = ("analysis", "optics", "scenes", "twin")
"""The packages that a wheel holds within one, and what stands before their names there (docs/wheel)."""


@dataclass(frozen=True)
class Named:
    """A function or a class that is imported when it is used.

    Attributes
    ----------
    path : str
        Module and name, ``twin.laboratory.export:export_focus``; of a method ``module:Class.method``.
    """

    path: str

    def get(self) -> Any:
        """The function or the class."""
        module, _, name = self.path.partition(":")
        before = _BEFORE if module.partition(".")[0] in _OURS else ""
        return attrgetter(name)(import_module(before + module))

    def __call__(self, *values: Any, **named: Any) -> Any:
        """Import the function and call it."""
        return self.get()(*values, **named)


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes
    ----------
    name : str
        Of its JSON Schema.
    described : str
        Model of what it may say, as `Named` takes its name; with a dot before it one of `scenes.specs`.
    what : str
        It is, with article, for messages.
    needs : str
        Keys, in words, that the model requires and few other kinds have: a file without them is known to be of another
        kind before the model is imported.
    command : str
        That reads it, as the user calls it; empty for what only other files name.
    place : str
        Where other files name it; empty for what only a command reads.
    one_of : str
        Keys, in words, of which it has at least one.
    """

    name: str
    described: str
    what: str
    needs: str = ""
    command: str = ""
    place: str = ""
    one_of: str = ""

    @property
    def model(self) -> type[Spec]:
        """What it may say."""
        model: type[Spec] = Named(f"scenes.specs{self.described}" if self.described[0] == "." else self.described).get()
        return model

    def may_be(self, keys: set[str]) -> bool:
        """Whether a file with these keys can be one of this kind, by what is known before the model is imported."""
        return keys >= set(self.needs.split()) and (not self.one_of or bool(keys & set(self.one_of.split())))

    def strangers(self, keys: set[str]) -> int | None:
        """How many of the keys are none of this kind's; None if one that it needs is missing."""
        if not self.may_be(keys):
            return None
        fields = self.model.model_fields
        needed = {name for name, item in fields.items() if item.is_required()}
        return len(keys - set(fields)) if needed <= keys else None
