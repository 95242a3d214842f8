"""Tables that other installed distributions extend by entry points (docs/architecture.md, "Where to add")."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import EntryPoint, distribution, distributions
from typing import Any, TypeVar

# not in one word: in a wheel that is what stands before the modules' names
PREFIX = "space_camera_twin" + "."
"""Beginning of the names of the groups of entry points; the name of the table follows."""

Value = TypeVar("Value")


class EntryPointError(Exception):
    """An entry of another distribution cannot be used; the message names distribution, group, entry and remedy."""


@dataclass(frozen=True)
class Entry:
    """An entry point that a distribution declares, and what it is loaded from."""

    distribution: str
    version: str
    group: str
    name: str
    value: str

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}: the entry {self.name} = {self.value} of {self.group}"


@cache
def entries() -> tuple[Entry, ...]:
    """Return the entries of all tables, in the order of the distributions' names.

    Only distributions whose entry points mention ``PREFIX`` are parsed, which takes 3 ms instead of 8 with 200
    installed. Of a distribution that is installed twice the first one on the path counts.
    """
    names = {found.name for found in distributions() if PREFIX in (found.read_text("entry_points.txt") or "")}
    points = [(found, point) for found in map(distribution, sorted(names)) for point in found.entry_points]
    every = (Entry(found.name, found.version, point.group, point.name, point.value) for found, point in points)
    return tuple(entry for entry in every if entry.group.startswith(PREFIX))


class ExtensionTable(UserDict[str, Value]):
    """A table of this program with the entries of other distributions behind its own.

    Other distributions are looked for when the table is read first, and an entry is imported when its value is asked
    for: neither a program's start nor a broken entry that nobody asks for costs anything.

    Parameters
    ----------
    name
        Of the group of entry points, without ``PREFIX``.
    own
        Entries of this program, by name.
    kind
        Class of the values. An entry may also be a class whose instance without arguments is of that kind.
    """

    def __init__(self, name: str, own: Mapping[str, Value], kind: Any = Callable) -> None:
        self.group = PREFIX + name
        self._own, self._kind = own, kind

    @cached_property
    def data(self) -> dict[str, Any]:  # type: ignore[override]
        """Name -> value, or the entry that the value is loaded from, or the error that reading it is."""
        found: dict[str, Any] = dict(self._own)
        for entry in entries():
            if entry.group == self.group and (other := found.setdefault(entry.name, entry)) is not entry:
                owner = other.distribution if isinstance(other, Entry) else "the twin or of a third distribution"
                remedy = f"rename it there, or pip uninstall {entry.distribution}"
                found[entry.name] = EntryPointError(f"{entry} has the name of an entry of {owner}; {remedy}")
        return found

    def __getitem__(self, name: str) -> Value:
        found = self.data[name]
        if isinstance(found, EntryPointError):
            raise found
        value: Value = _loaded(found, self._kind) if isinstance(found, Entry) else found
        return value


@cache
def _loaded(entry: Entry, kind: Any) -> Any:
    remedy = f"mend or update it, or pip uninstall {entry.distribution}"
    try:
        found = EntryPoint(entry.name, entry.value, entry.group).load()
        found = found() if isinstance(found, type) and not isinstance(found, kind) else found
    except Exception as error:
        raise EntryPointError(f"{entry} cannot be loaded ({type(error).__name__}: {error}); {remedy}") from error
    if not isinstance(found, kind):
        raise EntryPointError(f"{entry} is of type {type(found).__name__}, not {kind.__name__}; {remedy}")
    return found
