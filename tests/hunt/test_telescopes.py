"""Telescopes with stop planes, dummies, folds, holes and stated edges: shadows and figures as by hand."""

from __future__ import annotations

import pytest

from tests.hunt.hunt import RIGHT
from tests.hunt.legal_telescopes import telescopes


@pytest.mark.parametrize(
    ("first", "cases"),
    [(8, 2), pytest.param(0, 30, marks=pytest.mark.slow), pytest.param(1000, 300, marks=pytest.mark.slow)],
)
def test_shadows_and_figures_of_telescopes_are_those_by_hand(tmp_path, backend, first: int, cases: int) -> None:
    wrong = [f"{o.case}: {o.kind}: {o.text}" for o in telescopes(first, cases, tmp_path, backend) if o.kind != RIGHT]
    assert not wrong
