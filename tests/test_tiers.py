"""Which tier a case belongs to."""

from types import SimpleNamespace

import pytest

from tests import conftest


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
