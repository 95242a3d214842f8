"""Which tier a case belongs to, and which files come first."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import conftest
from tests.tiers import LONGEST, longest_first


class Marked:
    def __init__(self, *marks: str) -> None:
        self.marks = marks

    def get_closest_marker(self, name: str) -> str | None:
        return name if name in self.marks else None


@pytest.mark.parametrize(
    ("expression", "kept"), [("second", [True, False]), ("slow", [True, True]), ("", [True, True])]
)
def test_a_slow_case_of_a_test_of_the_second_tier_belongs_to_the_third(expression: str, kept: list[bool]) -> None:
    both = [Marked("second"), Marked("second", "slow")]
    left: list[Marked] = []
    hook = SimpleNamespace(pytest_deselected=lambda items: left.extend(items))
    items = list(both)
    conftest.pytest_collection_modifyitems(
        SimpleNamespace(option=SimpleNamespace(markexpr=expression), hook=hook), items
    )
    assert items == [one for one, stays in zip(both, kept, strict=True) if stays]
    assert left == [one for one, stays in zip(both, kept, strict=True) if not stays]


def test_files_that_take_longest_come_first_and_then_those_of_most_tests() -> None:
    assert [name for name in LONGEST if not (Path(__file__).parent / name).is_file()] == []
    names = ["a.py::one", f"{LONGEST[1]}::b", "c.py::one", "c.py::two", f"{LONGEST[0]}::a"]
    items = longest_first([SimpleNamespace(nodeid=f"tests/{name}") for name in names])
    assert [item.nodeid.removeprefix("tests/") for item in items] == [names[k] for k in (4, 1, 2, 3, 0)]
