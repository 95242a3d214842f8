"""What stated motions may do over time: amounts drawn by the laws of their disturbances.

Each law is drawn exactly at any times, without steps between them, so that times may be as far apart as they like: a
drift is an Ornstein-Uhlenbeck process, a period the real part of a turning random pointer.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from optics.numerics.array_math import covariance_root
from scenes.models.disturbances import StatedMotions
from scenes.specs.disturbances import TimeLawSpec

Array = NDArray[np.float64]


def drawn_motions(stated: StatedMotions, seconds: Array, source: Callable[[int], np.random.Generator]) -> Array:
    """Amounts (T, M) of all motions, SI, without jumps.

    Args:
        stated: the motions and their laws of time.
        seconds: (T,) rising, from which the laws count.
        source: number of a cause -> of what is drawn of it, so that no cause depends on the others.
    """
    out = np.zeros((len(seconds), len(stated.components)))
    for number, where in enumerate(causes_of(stated).values()):
        course = drawn_course(stated.laws[where[0]], seconds, source(number), len(where))
        out[:, where] = course @ covariance_root(stated.correlation[np.ix_(where, where)]) * stated.sigma[where]
    return out


def drawn_course(law: TimeLawSpec, seconds: Array, rng: np.random.Generator, count: int) -> Array:
    """Independent courses (T, count) of unit standard deviation that have the covariance of a law of time.

    Args:
        law: of all of them. A jump does nothing here: its times are drawn for a body.
        seconds: (T,) rising.
        rng: source of what is drawn.
        count: how many.
    """
    each = (len(seconds), count)
    if law.kind == "white":
        return rng.standard_normal(each)
    if law.kind == "jump" or law.jump is not None:
        return np.zeros(each)
    if law.period is None:
        out = _drifting(law.drift, seconds, rng, count)
    else:
        # the real part of a random pointer that turns once in a period, and forgets where it was if it drifts
        turn = (2.0 * math.pi / law.period * seconds)[:, None]
        along = _drifting(law.drift, seconds, rng, count)
        out = along * np.cos(turn) + _drifting(law.drift, seconds, rng, count) * np.sin(turn)
    since = seconds - (law.since or 0.0)
    if law.trend is not None:
        out = out * (since / law.trend)[:, None]
    if law.relaxation is not None:
        out = out * -np.expm1(-np.maximum(since, 0.0) / law.relaxation)[:, None]
    if law.event is not None:
        out = out * (seconds >= law.event)[:, None]
    return np.asarray(out)


def _drifting(drift: float | None, seconds: Array, rng: np.random.Generator, count: int) -> Array:
    """(T, count) of unit variance that forget where they were in ``drift`` seconds; None for never."""
    unit = rng.standard_normal((len(seconds), count))
    if drift is None:
        return np.broadcast_to(unit[:1], unit.shape)
    kept = np.exp(-np.diff(seconds) / drift)
    fresh = np.sqrt(-np.expm1(-2.0 * np.diff(seconds) / drift))
    for k, (part, new) in enumerate(zip(kept, fresh, strict=True)):
        unit[k + 1] = part * unit[k] + new * unit[k + 1]
    return unit


def causes_of(stated: StatedMotions) -> dict[str, list[int]]:
    """Cause -> numbers of its components."""
    out: dict[str, list[int]] = {}
    for k, one in enumerate(stated.components):
        out.setdefault(one.cause, []).append(k)
    return out
