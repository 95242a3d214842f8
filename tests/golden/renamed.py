"""Names of results that are others now, read off the note to users, docs/renamed.md: an older golden file is held
against a run by them.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[2] / "docs/renamed.md"
_ROW = re.compile(r"^\| (all|`[^|]+`) \| `([^`]+)` \| `([^`]+)` \| [\d.]+ \|$", re.M)


@cache
def table() -> tuple[tuple[tuple[str, ...], list[str], str], ...]:
    """(files, none for all; old key below the keys that it stands below; new key) of every row."""
    rows = _ROW.findall(PAGE.read_text("utf-8"))
    return tuple((tuple(re.findall(r"`([^`]+)`", files)), old.split("."), new) for files, old, new in rows)


def name_now(path: list[str], file: str) -> str:
    """The name now of the last key of a path."""
    for files, old, new in table():
        if (files and file not in files) or len(path) < len(old) or path[-len(old) : -1] != old[:-1]:
            continue
        own, last = path[-1], old[-1]
        if own == last:
            return new
        if last.startswith("*") and own.endswith(last[1:]) and own != last[1:]:
            return own.removesuffix(last[1:]) + new[1:]
    return path[-1]


def names_of_now(snapshot: dict[str, Any]) -> dict[str, Any]:
    """A snapshot of an older version with the names that results have now: files by name, what was printed."""
    return {place: _named(place.rpartition("/")[2], part) for place, part in snapshot.items()}


def fields_of_now(kept: dict[str, Any]) -> dict[str, Any]:
    """Fields of an older version's files, likewise."""
    return {place: _named_fields(place.rpartition("/")[2], part) for place, part in kept.items()}


def _named(file: str, part: Any) -> Any:
    if file.endswith(".csv") and isinstance(part, dict) and isinstance(part.get("head"), list):
        return part | {"head": [_head(head, file) if isinstance(head, str) else head for head in part["head"]]}
    return _tree(part, file, []) if file.endswith((".json", ".nc")) or file == "stdout" else part


def _tree(tree: Any, file: str, above: list[str]) -> Any:
    if isinstance(tree, list):
        return [_tree(one, file, above) for one in tree]
    if not isinstance(tree, dict):
        return tree
    if isinstance(kind := tree.get("schema"), str):
        file, above = f"{kind.partition(' ')[0]}.json", []
    return {name_now([*above, key], file): _tree(one, file, [*above, key]) for key, one in tree.items()}


def _head(head: str, file: str) -> str:
    name, bracket, unit = head.partition(" [")
    return f"{name_now([name], file)}{bracket}{unit}"


def _named_fields(file: str, part: dict[str, Any]) -> dict[str, Any]:
    if "columns" in part:
        return part | {"columns": [_head(head, file) for head in part["columns"]]}
    if "fields" in part:
        return part | {"fields": {_path(path, file): sort for path, sort in part["fields"].items()}}
    return part


def _path(path: str, file: str) -> str:
    """A path of fields by the names of now; what stands in braces is names of the run's own."""
    parts = re.findall(r"(?:\{[^}]*\}|[^.{])+", path)
    plain = [part.replace("[]", "") for part in parts]
    return ".".join(
        part if "{" in part else part.replace(plain[k], name_now(plain[: k + 1], file), 1)
        for k, part in enumerate(parts)
    )
