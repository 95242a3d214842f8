"""Cases of a test in more than one tier."""

from collections.abc import Iterable
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
