"""docs/promises.md: every promise names tests that would fail, and these are there."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/promises.md"
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`( \((?:second|slow)\))?")


def promises(text: str) -> list[str]:
    """Items of the lists, each as one line."""
    items = re.findall(r"^- (.*(?:\n  .*)*)", text, re.M)
    return [" ".join(item.split()) for item in items]


@cache
def functions_in(file: Path) -> dict[str, str]:
    """Name of every test of a file -> the mark of the tier that all of its cases belong to, "" for the default."""
    tree = ast.parse(file.read_text("utf-8"))
    marks = [ast.unparse(node) for node in tree.body if isinstance(node, ast.Assign)]
    every = [mark for mark in marks if mark.startswith("pytestmark")]

    def tier(decorators: list[str]) -> str:
        marks = [one for one in decorators if "param" not in one]
        return next((name for name in ("slow", "second") if any(f"mark.{name}" in one for one in marks)), "")

    return {
        node.name: tier([*every, *map(ast.unparse, node.decorator_list)])
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    }


PROMISES = promises(PAGE.read_text("utf-8"))


def test_there_are_promises_of_every_kind() -> None:
    text = PAGE.read_text("utf-8")
    parts = re.split(r"^## ", text, flags=re.M)[1:]
    assert len(parts) >= 8
    assert all(promises(part) for part in parts)
    assert sum(map(len, map(promises, parts))) == len(PROMISES) >= 35


@pytest.mark.parametrize("promise", PROMISES, ids=[re.sub(r"\W+", "-", one)[:48] for one in PROMISES])
def test_a_promise_names_tests_that_are_there(promise) -> None:
    named = TEST.findall(promise)
    assert named, "no test would fail"
    assert len(named) == promise.count("::"), "a test that is not written as the others"
    for file, name, tier in named:
        there = functions_in(ROOT / file)
        assert name in there, f"{file} has no {name}"
        assert there[name] == tier.strip(" ()"), f"{name} belongs to the {there[name] or 'default'} tier"


def test_a_promise_without_a_test_would_be_found() -> None:
    first, second = promises("# page\n- one thing\n  and more `tests/a.py::test_b` (slow)\n- another\n\ntext\n")
    assert TEST.findall(first) == [("tests/a.py", "test_b", " (slow)")]
    assert TEST.findall(second) == []
