"""Whether times and image coordinates lie inside a span, decided in one way for the whole program.

Ends of spans are sums and differences of decimal numbers, which meet to rounding and not to the last bit. An orbit that
ends with the last line of an image covers the image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROUNDING = 1e-6
"""Seconds, lines or pixels by which a value may lie outside a span, as files write times to the microsecond. A low
satellite moves by 8 mm in it, over which a curve through its readings goes on smoothly: rounding costs no accuracy.
"""
_DIGITS = 1e-15
"""Relative rounding of an end far from zero, nine units in the last place."""


def in_span(value: ArrayLike, first: ArrayLike, last: ArrayLike) -> NDArray[np.bool_]:
    """Return whether values lie between two ends, to rounding; both ends belong to the span.

    Args:
        value: seconds, lines or pixels, shape (...); NaN lies in no span.
        first: lower end, broadcastable to (...); may be infinite.
        last: upper end, likewise.

    Returns:
        Shape (...).
    """
    v, a, b = (np.asarray(one, np.float64) for one in (value, first, last))
    return np.asarray((v >= a - ROUNDING - _DIGITS * np.abs(a)) & (v <= b + ROUNDING + _DIGITS * np.abs(b)))


def number_of(value: float, values: Sequence[float]) -> int | None:
    """Return the number of the entry, from 0, that a value equals to rounding; None where there is none."""
    nearest = min(range(len(values)), key=lambda k: abs(values[k] - value), default=None)
    return None if nearest is None or not in_span(value, values[nearest], values[nearest]) else nearest
