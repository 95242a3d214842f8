"""Which tests run, and in which order."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.tiers import LONGEST, longest_first, quick


def item(name: str) -> SimpleNamespace:
    return SimpleNamespace(nodeid=f"tests/{name}", path=Path("tests", name.partition("::")[0]))


def test_files_that_take_longest_come_first_and_then_those_of_most_tests() -> None:
    assert [name for name in LONGEST if not (Path(__file__).parent / name).is_file()] == []
    names = ["a.py::one", f"{LONGEST[1]}::b", "c.py::one", "c.py::two", f"{LONGEST[0]}::a"]
    assert longest_first(list(map(item, names))) == [item(names[k]) for k in (4, 1, 2, 3, 0)]


def test_cases_of_the_second_tier() -> None:
    first, second = quick(1, [(1, "a"), pytest.param(2, "b", id="two")])
    assert (first.values, list(first.marks)) == ((1, "a"), [])
    assert (second.values, second.id, [mark.name for mark in second.marks]) == ((2, "b"), "two", ["second"])
