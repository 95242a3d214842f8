"""Every refusal of a file of scenes: a good file is read, and each change of it is refused at its line and key.

The cases stand in ``refusals/*.txt``. A section begins with ``## name | reader | file`` (and ``| second`` for the second
tier), followed by the text of the good file (``@path`` for a file of scenes, ``=name`` for a layout of monitors) and
``--``. Every row below is

    OLD => NEW :: LINE KEY :: word ; word

OLD stands once in the good file; an empty OLD is the whole file, ``^OLD`` the first of several, ``~`` the OLD of the row
above, ``@a.b.0`` a key of its YAML tree whose value is replaced (or lost, if NEW is empty). Two changes are joined by
`` && ``, a line break is written ``\\n``. LINE is preceded by the name of another file if that is blamed, and is ``?`` for
none; ``+1`` behind KEY counts further messages. In place of LINE and KEY ``ok`` says that the changed file is read as
well: the value is just within its limits.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from scenes.specs.load import SCENES
from scenes.yaml.errors import InputError, key_text
from tests.scenes import monitor_layouts
from tests.scenes.refusals import readers

FOLDER = Path(__file__).parent / "refusals"


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
        old, new = (one.replace("\\n", "\n").replace("\\t", "\t") for one in (old[1:], new))
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
    tree = yaml.safe_load(text)
    place: Any = tree
    for part in key[:-1]:
        place = place[int(part) if isinstance(place, list) else part]
    last: Any = int(key[-1]) if isinstance(place, list) else key[-1]
    if new:
        place[last] = yaml.safe_load(new)
    else:
        del place[last]
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=10_000)


def judged(read: Callable[[Path], object], path: Path, text: str, row: str) -> str:
    """Return what is wrong with how a row's file is taken, nothing if all is well."""
    change, _, rest = row.partition(" :: ")
    where, _, words = rest.partition(" :: ")
    path.write_text(changed(text, change), "utf-8")
    try:
        read(path)
    except InputError as error:
        (issue, *more), told = error.issues, str(error)
        line = "?" if issue.line is None else str(issue.line)
        name = Path(issue.file).name
        found = f"{'' if name == path.name else name + ' '}{line} {key_text(issue.key)}".strip()
        found += f" +{len(more)}" if more else ""
        if found != where:
            return f"told at {found!r}: {told}"
        missing = [word for word in words.split(" ; ") if word.replace("\\n", "\n") not in told]
        return f"{missing} not in: {told}" if missing else ""
    return "" if where == "ok" else "not refused"


@pytest.mark.parametrize(
    "section", [pytest.param(one, id=one.name, marks=[pytest.mark.second] * one.second) for one in sections()]
)
def test_faults_are_told_where_they_stand(section: Section, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Also, a good file is read: what refuses everything would pass all else."""
    read = getattr(readers, section.reader)(tmp_path, request.getfixturevalue)
    path = tmp_path / section.file
    path.write_text(section.text, "utf-8")
    read(path)
    wrong, old = [], ""
    for row in section.rows:
        first, arrow, rest = (" " + row).partition(" => ")
        old = old if first == " ~" else first[1:]
        if text := judged(read, path, section.text, old + arrow + rest):
            wrong.append(f"{row}\n    {text}")
    assert not wrong, "\n" + "\n".join(wrong)
