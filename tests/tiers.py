"""Cases of a test in both tiers, and the order of files."""

import random
from collections import Counter
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


def shuffled(items: list[pytest.Item], seed: int) -> list[pytest.Item]:
    """Return tests with the files, and the tests of each file, in a random order."""
    drawn = random.Random(seed)
    files = sorted({item.path for item in items})
    drawn.shuffle(files)
    rank = {path: k for k, path in enumerate(files)}
    return sorted(items, key=lambda item: (rank[item.path], drawn.random()))


LONGEST = (
    "golden/test_golden.py",
    "twin/test_scripting.py",
    "twin/test_study.py",
    "test_site.py",
    "test_wheel.py",
    "test_notebooks.py",
    "validation/test_paper_004.py",
    "test_extension_points.py",
    "twin/test_new.py",
    "twin/test_live_browser.py",
)
"""Files whose tests take about thirty seconds and more, longest first. Few tests they may be:
by their number they would come last, and one process would wait for the other.
"""


def longest_first(items: list[pytest.Item]) -> list[pytest.Item]:
    """Tests file by file as processes shall take them: those that take longest, then those of most tests."""
    files = [item.nodeid.partition("::")[0].removeprefix("tests/") for item in items]
    count, rank = Counter(files), {name: k for k, name in enumerate(LONGEST)}
    order = sorted(dict.fromkeys(files), key=lambda name: (rank.get(name, len(rank)), -count[name]))
    place = {name: k for k, name in enumerate(order)}
    return [item for _, item in sorted(zip(files, items, strict=True), key=lambda one: place[one[0]])]
