"""Numbers with names: paths, maps over several trees, one number changed."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from optics.numerics.number_tree import leaves, map_leaves, with_leaf


@dataclass(frozen=True)
class Inner:
    slope: float | None
    terms: tuple[float | None, ...] = ()


@dataclass(frozen=True)
class Outer:
    size: float
    inner: Inner | None = None


TREE = Outer(1.0, Inner(2.0, (3.0, 4.0)))


def test_numbers_of_a_tree_by_their_paths() -> None:
    terms = {("inner", "terms", 0): 3.0, ("inner", "terms", 1): 4.0}
    assert leaves(TREE) == {("size",): 1.0, ("inner", "slope"): 2.0} | terms
    assert leaves(Outer(1.0)) == {("size",): 1.0}
    assert map_leaves(lambda x: 2.0 * x, TREE) == Outer(2.0, Inner(4.0, (6.0, 8.0)))
    assert map_leaves(lambda x: 2.0 * x, Outer(1.0)) == Outer(2.0)
    steps = Outer(10.0, Inner(None, (20.0, None)))
    assert map_leaves(lambda x, step: x if step is None else step, TREE, steps) == Outer(10.0, Inner(2.0, (20.0, 4.0)))
    assert map_leaves(lambda x, step: step, TREE, None) == Outer(None, Inner(None, (None, None)))
    assert with_leaf(TREE, ("inner", "terms", 1), 5.0) == Outer(1.0, Inner(2.0, (3.0, 5.0)))
    for wrong in (("inner", "terms", 2), ("inner",), ("c",)):
        with pytest.raises(KeyError, match="no number"):
            with_leaf(TREE, wrong, 0.0)
