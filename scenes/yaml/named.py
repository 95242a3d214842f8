"""Functions and classes named by text and imported on first use, and the description of a kind of input file.

A `FileKind` holds the model of a YAML file, the keys that distinguish it from other kinds, and the command that reads
it.
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
"""Packages of this program. An installed wheel holds them inside one package; `_BEFORE` is the prefix of their names
there (docs/wheel).
"""


@dataclass(frozen=True)
class Named:
    """Reference to a function or a class, which is imported when it is first used.

    Attributes
    ----------
    path : str
        Module and name, such as ``twin.laboratory.export:export_focus``; ``module:Class.method`` for a method.
    """

    path: str

    def get(self) -> Any:
        """Import the module and return the function or class."""
        module, _, name = self.path.partition(":")
        before = _BEFORE if module.partition(".")[0] in _OURS else ""
        return attrgetter(name)(import_module(before + module))

    def __call__(self, *values: Any, **named: Any) -> Any:
        """Import the function and call it with these arguments."""
        return self.get()(*values, **named)


@dataclass(frozen=True)
class FileKind:
    """Kind of input file, one row of file_kinds.csv.

    Attributes
    ----------
    name : str
        Name of the kind, and of its JSON Schema.
    described : str
        Name of the pydantic model of the file's contents, as ``module:Class``; a leading dot means a module of
        `scenes.specs`.
    what : str
        Noun phrase for messages, with its article: "a focus test".
    needs : str
        Required keys that few other kinds have, separated by spaces. A file without them is ruled out before the model
        is imported.
    command : str
        Command that reads the file, as the user types it; empty for a file that only other files refer to.
    place : str
        Key of another file whose value is the path of such a file; empty for a file that only a command reads.
    one_of : str
        Keys, separated by spaces, at least one of which the file has.
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
        """Pydantic model of the file's contents."""
        model: type[Spec] = Named(f"scenes.specs{self.described}" if self.described[0] == "." else self.described).get()
        return model

    def count_unknown(self, keys: set[str]) -> int | None:
        """Return the number of keys that this kind does not have; None if a required key is missing."""
        if not keys >= set(self.needs.split()) or (self.one_of and not keys & set(self.one_of.split())):
            return None
        fields = self.model.model_fields
        needed = {name for name, item in fields.items() if item.is_required()}
        return len(keys - set(fields)) if needed <= keys else None
