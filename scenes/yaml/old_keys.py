"""Keys that have another name now: the old one is read for one version, with a note where it stands.

A specification declares them, ``old_keys: ClassVar[OldKeys] = {"pixel": "pitch"}``. Whoever validates a file collects
those that it met (`met`), so that they are told and messages find the lines of what stands under them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from scenes.yaml.errors import Issue, KeyPath, Problem

OldKeys: TypeAlias = Mapping[str, str]
"""Name until the last version -> name now."""


@dataclass
class Met:
    """What was renamed while one file was validated.

    Attributes:
        places: the mapping or list of the file, the old name in it, the new one.
    """

    places: list[tuple[Any, str, str]] = field(default_factory=list)

    def by_path(self, data: Any) -> dict[KeyPath, str]:
        """Key path of every old name, as it stands in the file -> new name; of a list the path of the list."""
        found: dict[KeyPath, str] = {}
        for held, path in _containers(data, ()) if self.places else ():
            for place, old, new in self.places:
                if place is held:
                    found[(*path, old) if isinstance(held, Mapping) else path] = new
        return found


_MET: ContextVar[Met | None] = ContextVar("met", default=None)
_TOLD: set[tuple[str, int | None, KeyPath]] = set()


@contextmanager
def met() -> Iterator[Met]:
    """Collect the old names that are met within."""
    own = Met()
    token = _MET.set(own)
    try:
        yield own
    finally:
        _MET.reset(token)


def note(place: Any, old: str, new: str) -> None:
    """Say that a mapping, or a list of names, of the file that is being validated has an old name."""
    own = _MET.get()
    if own is not None:
        own.places.append((place, old, new))


def under_new_names(value: Any, renamed: OldKeys) -> Any:
    """A mapping with its keys' new names; anything else as it is.

    Raises:
        Problem: a key stands there under both names.
    """
    if not isinstance(value, Mapping):
        return value
    old = [key for key in renamed if key in value]
    for key in old:
        if renamed[key] in value:
            raise Problem(f"{key!r} is the old name of {renamed[key]!r}", "both", renamed[key], within=(key,))
        note(value, key, renamed[key])
    return {renamed.get(key, key): one for key, one in value.items()} if old else value


def tell(file: str, lines: Mapping[KeyPath, int | None], renamed: Mapping[KeyPath, str]) -> None:
    """Write a note on stderr for every old name, once in a process."""
    for path, new in renamed.items():
        line = lines.get(path)
        if (file, line, path) not in _TOLD:
            _TOLD.add((file, line, path))
            issue = Issue(f"is called {new!r} now; the old name is read for one version", file, line, path)
            sys.stderr.write(f"note: {issue}\n")


def new_lines(lines: Mapping[KeyPath, int], renamed: Mapping[KeyPath, str]) -> Mapping[KeyPath, int]:
    """Key path -> line, also by the new names."""
    if not renamed:
        return lines

    def path_now(path: KeyPath) -> KeyPath:
        return tuple(renamed.get(path[: k + 1], one) for k, one in enumerate(path))

    return {**lines, **{path_now(path): line for path, line in lines.items()}}


def _containers(data: Any, path: KeyPath) -> Iterator[tuple[Any, KeyPath]]:
    """Every mapping and list of plain data with its key path."""
    items: Iterator[tuple[Any, Any]] | None = None
    if isinstance(data, Mapping):
        items = iter(data.items())
    elif isinstance(data, Sequence) and not isinstance(data, str):
        items = iter(enumerate(data))
    if items is None:
        return
    yield data, path
    for key, one in items:
        yield from _containers(one, (*path, key))
