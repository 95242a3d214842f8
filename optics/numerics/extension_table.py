"""Tables that other installed distributions extend by entry points (docs/architecture.md, "Where to add")."""

from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import EntryPoint, distribution, distributions
from typing import Any, TypeVar

# written in two parts, since in a wheel the joined word is the prefix of the modules' names
PREFIX = "space_camera_twin" + "."
"""First part of the names of entry-point groups that extend a table; the name of the table follows."""

GROUPS = (
    "camera_parameters", "centroids", "check_groups", "estimators", "forces", "frame_formats", "noise_terms",
    "procedures", "reflectors", "report_sections", "sag_terms", "samplers", "study_formats", "table_formats", "targets",
)  # fmt: skip
"""Names of all tables, which are those of the groups of entry points without ``PREFIX``."""

Value = TypeVar("Value")


class EntryPointError(Exception):
    """Error: an entry of another distribution cannot be used.

    The message names distribution, group, entry and remedy.
    """


@dataclass(frozen=True)
class Entry:
    """Entry point declared by a distribution, and the object reference that it is loaded from."""

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
    installed. Of a distribution that is installed twice, the first on the path counts.
    """
    names = {dist.name for dist in distributions() if PREFIX in (dist.read_text("entry_points.txt") or "")}
    points = [(dist, point) for dist in map(distribution, sorted(names)) for point in dist.entry_points]
    all_entries = (Entry(dist.name, dist.version, point.group, point.name, point.value) for dist, point in points)
    return tuple(entry for entry in all_entries if entry.group.startswith(PREFIX))


class ExtensionTable(UserDict[str, Value]):
    """Table of named values of this program, to which other installed distributions can add entries.

    Other distributions are searched when the table is first read, and an entry is imported when its value is requested:
    neither the program's start nor a broken entry that nobody requests costs anything.

    Parameters
    ----------
    name : str
        Name of the group of entry points, without ``PREFIX``.
    built_in : mapping of str to value
        Entries of this program, by name.
    kind : type
        Class of the values. An entry may also be a class whose instance without arguments is of that kind.
    """

    def __init__(self, name: str, built_in: Mapping[str, Value], kind: Any = Callable) -> None:
        self.group = PREFIX + name
        self._built_in, self._kind = built_in, kind

    @cached_property
    def data(self) -> dict[str, Any]:  # type: ignore[override]
        """Name -> value, or the entry point that provides it, or the error to raise if the entry point is broken."""
        table: dict[str, Any] = dict(self._built_in)
        for entry in entries():
            if entry.group == self.group and (other := table.setdefault(entry.name, entry)) is not entry:
                owner = other.distribution if isinstance(other, Entry) else "the twin or of a third distribution"
                remedy = f"rename it there, or pip uninstall {entry.distribution}"
                table[entry.name] = EntryPointError(f"{entry} has the name of an entry of {owner}; {remedy}")
        return table

    def __getitem__(self, name: str) -> Value:
        entry = self.data[name]
        if isinstance(entry, EntryPointError):
            raise entry
        value: Value = _loaded(entry, self._kind) if isinstance(entry, Entry) else entry
        return value


@cache
def _loaded(entry: Entry, kind: Any) -> Any:
    """Return the value of an entry, imported and checked against the table's kind."""
    remedy = f"repair or update it, or pip uninstall {entry.distribution}"
    try:
        value = EntryPoint(entry.name, entry.value, entry.group).load()
        value = value() if isinstance(value, type) and not isinstance(value, kind) else value
    except Exception as error:
        raise EntryPointError(f"{entry} cannot be loaded ({type(error).__name__}: {error}); {remedy}") from error
    if not isinstance(value, kind):
        raise EntryPointError(f"{entry} is of type {type(value).__name__}, not {kind.__name__}; {remedy}")
    return value
