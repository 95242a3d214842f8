"""What numbers of a result must be, whatever the instrument; held at run time, so that nonsense is an error.

What physics forbids, as against faults of the program: light that is lost, parts that have no room.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


class PhysicalError(Exception):
    """What was asked for cannot be, in nature or with this instrument, though each of its numbers is allowed.

    The base of all errors that say so. Who runs many jobs counts such a one as failed; any other error is a fault of
    the program, whose numbers are not to be relied on.
    """


class UnphysicalError(PhysicalError, ValueError):
    """A value that cannot be, with the others; the message says which and why."""


def hold_within(what: str, values: np.ndarray | float, low: float, high: float, rounding: float) -> None:
    """Hold values between bounds.

    Args:
        what: they are, for the message.
        values: any shape; NaN where nothing is known.
        low: smallest.
        high: largest.
        rounding: by which they may leave the bounds.

    Raises:
        UnphysicalError: one lies outside, or is infinite.
    """
    every = np.asarray(values, dtype=np.float64)
    known = every[~np.isnan(every)]
    off = np.maximum(low - known, known - high)
    if np.any(off > rounding):
        worst = float(known[int(np.argmax(off))])
        raise UnphysicalError(
            f"{what} came out as {worst:.6g}, which cannot be: it lies between {low:g} and {high:g}, to {rounding:g}"
        )


def hold_below(what: str, values: np.ndarray | float, bounds: np.ndarray | float, than: str, rounding: float) -> None:
    """Hold values below others.

    Args:
        what: they are, for the message.
        values: any shape; NaN where nothing is known.
        bounds: of a shape that broadcasts.
        than: what the bounds are.
        rounding: by which values may exceed them.

    Raises:
        UnphysicalError: one exceeds its bound.
    """
    if (worst := _worst_beyond(values, bounds, rounding, lambda apart: apart)) is not None:
        own, most = worst
        raise UnphysicalError(
            f"{what} came out as {own:.6g}, which cannot be: it is at most {than}, {most:.6g}, to {rounding:g}"
        )


def hold_equal(what: str, values: np.ndarray | float, others: np.ndarray | float, to: str, apart: float) -> None:
    """Hold values to what another way tells.

    Args:
        what: they are, for the message.
        values: any shape; NaN where nothing is known.
        others: of a shape that broadcasts.
        to: what the others are.
        apart: by which the two may differ.

    Raises:
        UnphysicalError: two differ by more.
    """
    if (worst := _worst_beyond(values, others, apart, np.abs)) is not None:
        own, second = worst
        raise UnphysicalError(
            f"{what} came out as {own:.6g}, but {to} as {second:.6g}: they differ by more than {apart:g}"
        )


def _worst_beyond(
    values: np.ndarray | float, others: np.ndarray | float, limit: float, measure: Callable[[np.ndarray], np.ndarray]
) -> tuple[float, float] | None:
    """The value and its other whose difference, as ``measure`` takes it, exceeds the limit most; None where none
    does. Pairs with a NaN are not known and count as within it.
    """
    own, second = np.broadcast_arrays(np.asarray(values, dtype=np.float64), np.asarray(others, dtype=np.float64))
    with np.errstate(invalid="ignore"):
        off = np.where(np.isnan(own) | np.isnan(second), -np.inf, measure(own - second))
    if not np.any(off > limit):
        return None
    k = int(np.argmax(off))
    return float(own.flat[k]), float(second.flat[k])
