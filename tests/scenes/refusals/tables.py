"""Tables of files that are refused: good files, and changes of them."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from scenes.specs.load import SCENES
from scenes.yaml.yaml_file import parse_yaml
from tests.scenes import monitor_layouts

FOLDER = Path(__file__).parent


class Section(NamedTuple):
    """A good file, what reads it, and its changes."""

    name: str
    reader: str
    file: str
    text: str
    rows: list[str]
    second: bool


def sections() -> list[Section]:
    """Return all sections of all tables."""
    found = []
    for table in sorted(FOLDER.glob("*.txt")):
        for part in re.split(r"^## ", table.read_text("utf-8"), flags=re.M)[1:]:
            head, _, rest = part.partition("\n")
            text, _, rows = rest.partition("--\n")
            if text.startswith("@"):
                text = (SCENES / text[1:].strip()).read_text("utf-8")
            elif text.startswith("="):
                text = monitor_layouts.text_of(getattr(monitor_layouts, text[1:].strip())())
            name, reader, file, *second = (one.strip() for one in head.split("|"))
            found.append(Section(name, reader, file, text, [r for r in rows.split("\n") if r], bool(second)))
    return found


def changed(text: str, changes: str) -> str:
    """Return the good file's text with changes."""
    for change in changes.split(" && "):
        old, _, new = (" " + change).partition(" => ")
        old, new = (one.replace("\\n", "\n").replace("\\t", "\t").replace("␁", "\1") for one in (old[1:], new))
        if old.startswith("@"):
            text = with_key(text, old[1:].split("."), new)
        elif old.startswith("^"):
            assert old[1:] in text, old
            text = text.replace(old[1:], new, 1)
        elif old:
            assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times"
            text = text.replace(old, new)
        else:
            text = new
    return text


def with_key(text: str, key: list[str], new: str) -> str:
    """Return a YAML text with another value of one key."""
    tree = parse_yaml(text).data
    place: Any = tree
    for part in key[:-1]:
        place = place[int(part) if isinstance(place, list) else part]
    last: Any = int(key[-1]) if isinstance(place, list) else key[-1]
    if new:
        place[last] = yaml.safe_load(new)
    else:
        del place[last]
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=10_000)


@cache
def good(name: str) -> str:
    """Return the good file of a section."""
    return next(one.text for one in sections() if one.name == name)
