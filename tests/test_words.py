"""The retired words of docs/glossary.md stay out of identifiers, and no docstring begins as a fragment."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("optics", "analysis", "scenes", "twin")
OPENINGS = re.compile(r"(Of|The same|As|Its|What|Whether)\b(?!-)")
"""Words that begin a fragment; a docstring begins with a verb in the imperative or a noun phrase."""


def retired_words() -> set[str]:
    """Return what the glossary's table "Retired words" marks as retired in identifiers, such as ``left_out``."""
    table = (ROOT / "docs/glossary.md").read_text("utf-8").split("## Retired words")[1]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("|")]
    return {text.strip().replace(" ", "_") for row in rows if row[2] == "yes" for text in re.split("[,/]", row[0])}


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


def offences(source: str, retired: set[str]) -> list[str]:
    """Return the identifiers of a source text that contain a retired word, and its docstrings that are fragments."""
    tree = ast.parse(source)
    words = re.compile(f"(^|_)({'|'.join(sorted(retired))})(_|$)")
    names = [f"{line}: {name}" for name, line in identifiers(tree) if words.search(name.lower())]
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [(node, ast.get_docstring(node) or "") for node in ast.walk(tree) if isinstance(node, documented)]
    return names + [f"{getattr(node, 'lineno', 1)}: {text[:60]}" for node, text in texts if OPENINGS.match(text)]


def test_retired_words_stay_away() -> None:
    retired, found = retired_words(), []
    assert len(retired) > 10
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            found += [f"{file.relative_to(ROOT)}:{offence}" for offence in offences(file.read_text("utf-8"), retired)]
    assert not found, "\n".join(found)


def test_a_retired_word_is_noticed() -> None:
    source = '"""Of the spots."""\n\ndef fit(told, *, x):\n    x.untold_sum = told\n    for Told in x:\n        pass\n'
    assert len(offences(source, {"told", "untold"})) == 4
    assert offences('def fit():\n    """Fit."""\n    told_by = "told"\n', {"told"}) == ["3: told_by"]
    assert not offences('def fit():\n    """Assemble a fit."""\n    toldness = {"told": 1}\n', {"told"})
    assert offences("_left_out = left = out = 1\n", {"left_out"}) == ["1: _left_out"]
