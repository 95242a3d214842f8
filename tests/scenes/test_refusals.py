"""Every refusal of a file of scenes: a good file is read, and each change of it is refused at its line and key.

The cases stand in ``refusals/*.txt``. A section begins with ``## name | reader | file`` (and ``| second`` for the
second tier), followed by the text of the good file (``@path`` for a file of scenes, ``=name`` for a layout of
monitors, ``>path`` for the config.yaml of a file of scenes, which a user may have changed) and ``--``. Every row
below is

    OLD => NEW :: LINE KEY :: word ; word

OLD stands once in the good file; an empty OLD is the whole file, ``^OLD`` the first of several, ``~`` the OLD of the
row above, ``@a.b.0`` a key of its YAML tree whose value is replaced (or lost, if NEW is empty). Two changes are joined
by `` && ``, a line break is written ``\\n``, a control character ``␁``. The name of another file that is blamed
precedes LINE, which is ``?`` for none; ``+1`` behind KEY counts further messages; of ``!word`` the message has nothing.
In place of LINE and KEY ``ok`` says that the changed file is read as well: the value is just within its limits.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from scenes.lens import camera_reader
from scenes.specs import disturbances, spectrum
from scenes.specs.load import SCENES
from scenes.yaml import node_table
from scenes.yaml.errors import InputError, key_text
from tests.scenes.refusals import readers
from tests.scenes.refusals.tables import Section, changed, sections


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
        wrong = [w for w in words.split(" ; ") if (w.removeprefix("!").replace("\\n", "\n") in told) == (w[:1] == "!")]
        return f"{wrong} of: {told}" if wrong else ""
    return "" if where == "ok" else "not refused"


@pytest.mark.parametrize(
    "section", [pytest.param(one, id=one.name, marks=[pytest.mark.second] * one.second) for one in sections()]
)
def test_faults_are_told_where_they_stand(section: Section, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Also, a good file is read: what refuses everything would pass all else."""
    name, *kind = section.reader.split()
    reader = getattr(readers, name)
    read = (reader(*kind) if kind else reader)(tmp_path, request.getfixturevalue)
    path, text = tmp_path / section.file, section.text
    if text.startswith(">"):
        text = read(SCENES / text[1:].strip()).to_yaml()
    path.write_text(text, "utf-8")
    read(path)
    wrong, old = [], ""
    for row in section.rows:
        first, arrow, rest = (" " + row).partition(" => ")
        old = old if first == " ~" else first[1:]
        if fault := judged(read, path, text, old + arrow + rest):
            wrong.append(f"{row}\n    {fault}")
    assert not wrong, "\n" + "\n".join(wrong)


MESH = "heat.csv => {table: heat.vtu, unit: m, values: K, field: b}"
LIMITS = (
    (node_table, "MOST_NODES", 15, "temperatures", "", "nodes; allowed: at most 15"),
    (node_table, "LARGEST_TABLE", 99, "heated", MESH, "heat.vtu: too large"),
    (spectrum, "MOST_SAMPLES", 5, "filter", "", "table: the table has too many rows; found 6"),
    (disturbances, "MOST_JOINT", 2, "joint disturbances", "", "components: too many components; found 3"),
    (
        camera_reader,
        "SAME",
        0.0,
        "camera of a prescription",
        "",
        "rays of the camera differ from those of the prescription",
    ),
)


@pytest.mark.parametrize(
    ("module", "limit", "value", "name", "change", "words"), LIMITS, ids=[one[1] for one in LIMITS]
)
def test_a_good_file_is_refused_beyond_a_limit(
    module: ModuleType, limit: str, value: float, name: str, change: str, words: str, tmp_path, monkeypatch, request
) -> None:
    """Limits that no small file reaches are lowered to below what a good file has."""
    section = next(one for one in sections() if one.name == name)
    path = tmp_path / section.file
    path.write_text(changed(section.text, change) if change else section.text, "utf-8")
    read = getattr(readers, section.reader)(tmp_path, request.getfixturevalue)
    read(path)
    monkeypatch.setattr(module, limit, value)
    with pytest.raises(InputError, match=words):
        read(path)
