"""Refusals in one line, and files that are to be refused."""

from collections.abc import Callable

import numpy as np
import pytest


def refuses(error: type[Exception], match: str, call: Callable, *arguments: object, **options: object) -> None:
    """Assert that a call is refused with an error whose message matches."""
    with pytest.raises(error, match=match):
        call(*arguments, **options)


def spoilt(data: bytes, seed: int, head: int) -> bytes:
    """Return the bytes of a file changed, cut, repeated or put in, three of four times within so many of the first."""
    rng, nasty = np.random.default_rng(seed), [b"nan", b"-1", b"1e400", b"\xff\xff\xff\xff", b"\0\0", b"\n", b",", b"#"]
    for _ in range(rng.integers(1, 4)):
        place = int(rng.integers(min(head, len(data)) if rng.random() < 0.75 else len(data)))
        before, after, size = data[:place], data[place:], int(rng.integers(1, 40))
        changed = (bytes([rng.integers(256)]) + after[1:], after[size:], b"", after[:size] + after)
        data = before + (*changed, nasty[rng.integers(8)] + after[4:])[rng.integers(5)] or data[:1]
    return data
