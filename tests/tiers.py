"""Cases of a test in more than one tier."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

_set = type(pytest.param())


def quick(count: int, cases: Iterable[Any]) -> list[Any]:
    """Cases for ``parametrize``: the default tier takes so many of them, the second tier all others without a mark.

    Several parameters of a case are a tuple; the tuple of a single parameter is a ``pytest.param`` of its own.
    """
    sets = [c if isinstance(c, _set) else pytest.param(*(c if isinstance(c, tuple) else (c,))) for c in cases]
    rest = (pytest.param(*c.values, marks=c.marks or pytest.mark.second, id=c.id) for c in sets[count:])
    return [*sets[:count], *rest]


def one_of_each(key: Callable[[Any], Any], cases: Iterable[Any]) -> list[Any]:
    """Cases for ``parametrize``: the second tier takes the first case of each key, the third tier all others.

    A case of several parameters is a tuple; ``key`` gets the case as it is.
    """
    seen: set[Any] = set()
    marked = []
    for case in cases:
        values = case if isinstance(case, tuple) else (case,)
        marked.append(pytest.param(*values, marks=pytest.mark.slow if key(case) in seen else pytest.mark.second))
        seen.add(key(case))
    return marked
