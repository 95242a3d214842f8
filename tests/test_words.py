"""The retired words of docs/glossary.md stay out of identifiers and keys, and no docstring begins as a fragment."""

import ast
import re
from collections.abc import Iterator, Set
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("optics", "analysis", "scenes", "twin")
OPENINGS = re.compile(r"(Of|The same|As|Its|What|Whether)\b(?!-)")
"""Words that begin a fragment; a docstring begins with a verb in the imperative or a noun phrase."""


def retired_words(mark: str = "yes") -> set[str]:
    """Return what the glossary's table "Retired words" marks in its last column, such as ``left_out``."""
    table = (ROOT / "docs/glossary.md").read_text("utf-8").split("## Retired words")[1]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("|")]
    return {text.strip().replace(" ", "_") for row in rows if row[2] == mark for text in re.split("[,/]", row[0])}


def identifiers(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the names of functions, classes, arguments, stored attributes and variables, each with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name, node.lineno
            case ast.arg():
                yield node.arg, node.lineno
            case ast.Attribute(ctx=ast.Store()):
                yield node.attr, node.lineno
            case ast.Name(ctx=ast.Store()):
                yield node.id, node.lineno


def keys(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the keys of dictionaries and the names of quantities of records, each with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.Dict():
                names = (key for key in node.keys if isinstance(key, ast.Constant) and isinstance(key.value, str))
                yield from ((key.value, key.lineno) for key in names if key.value.isidentifier())
            case ast.Call(func=ast.Name(id="Quantity"), args=[ast.Constant(value=str(key)), *_]):
                yield key, node.lineno


def offences(source: str, retired: Set[str], whole: Set[str] | None = None) -> list[str]:
    """Return the identifiers of a source text that contain a retired word, and its docstrings that are fragments.

    With ``whole``, its keys are checked too, and names that are one of these words are offences.
    """
    tree = ast.parse(source)
    words = re.compile(f"(^|_)({'|'.join(sorted(retired))})(_|$)")
    listed = [*identifiers(tree), *(() if whole is None else keys(tree))]
    names = [
        f"{line}: {name}"
        for name, line in listed
        if words.search(name.lower()) or name.lower().strip("_") in (whole or ())
    ]
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [(node, ast.get_docstring(node) or "") for node in ast.walk(tree) if isinstance(node, documented)]
    return names + [f"{getattr(node, 'lineno', 1)}: {text[:60]}" for node, text in texts if OPENINGS.match(text)]


def test_retired_words_stay_away() -> None:
    retired, whole, out = retired_words(), retired_words("as a whole name"), []
    assert min(len(retired), len(whole)) > 10
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            path = file.relative_to(ROOT).as_posix()
            out += [f"{path}:{offence}" for offence in offences(file.read_text("utf-8"), retired, whole)]
    assert not out, "\n".join(out)


def test_a_retired_word_is_noticed() -> None:
    source = '"""Of the spots."""\n\ndef fit(told, *, x):\n    x.untold_sum = told\n    for Told in x:\n        pass\n'
    assert len(offences(source, {"told", "untold"})) == 4
    assert offences('def fit():\n    """Fit."""\n    told_by = "told"\n', {"told"}) == ["3: told_by"]
    assert not offences('def fit():\n    """Assemble a fit."""\n    toldness = {"told": 1}\n', {"told"})
    assert offences('a = {"told_by": 1}\nb = Quantity("told", len)\n', {"told"}, {"own"}) == ["1: told_by", "2: told"]
    assert offences("_own = owner = 1\nfor one_thread, one in x: pass\n", {"told"}, {"own", "one"}) == [
        "1: _own",
        "2: one",
    ]
    assert offences("_left_out = left = out = 1\n", {"left_out"}) == ["1: _left_out"]
