"""A life that could have been: amounts of every stated motion over time, drawn by the laws of their disturbances.

Each law is drawn exactly at any times, without steps between them, so that readings may be as far apart as they like:
a drift is an Ornstein-Uhlenbeck process, a period the real part of a turning random pointer, and steps come by chance
at a stated mean rate, or at the dates of events. Nothing here uses the filter or the smoother that such lives test.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scenes.models.disturbances import Component, StatedMotions
from scenes.specs.disturbances import TimeLawSpec
from twin.operate.record.entries import MICRO
from twin.run.random_streams import stream

Array = NDArray[np.float64]
Moments = NDArray[np.int64]

_MOTIONS, _JUMPS, _EVENTS, _DATES, _COEFFICIENTS = 10, 11, 12, 13, 14
"""Random streams of a seed; the exposures of the detectors have the first ones (`MonitorExperiment.frames_after`)."""
_MARGIN = 0.1
"""Part of a life at its beginning and its end in which no date of an event is drawn: something has to be seen of what
it does."""


@dataclass(frozen=True)
class Step:
    """Motions that stepped at one moment.

    Attributes:
        time: microseconds of TAI since 2000.
        cause: of the disturbances file.
        body: whose motions; empty where those of all bodies of the cause stepped, by an event.
        event: that made them step; empty for a jump at a time that nobody knows.
        sizes: (M,) SI, zero for what did not step.
    """

    time: int
    cause: str
    body: str
    event: str
    sizes: Array


@dataclass(frozen=True, eq=False)
class Life:
    """What every stated motion of an instrument does at T times.

    Attributes:
        times: (T,) microseconds of TAI since 2000, rising.
        components: M of them.
        drawn: (T, M) SI, as the laws say and without steps.
        steps: in the order of time.
        dates: when which event came: microseconds, name.
        coefficients: body with a temperature -> by which part its temperature does more to light than is computed.
    """

    times: Moments
    components: tuple[Component, ...]
    drawn: Array
    steps: tuple[Step, ...]
    dates: tuple[tuple[int, str], ...]
    coefficients: Mapping[str, float]

    @cached_property
    def amounts(self) -> Array:
        """(T, M) SI, steps included."""
        out = self.drawn.copy()
        for step in self.steps:
            out[self.times >= step.time] += step.sizes
        return out

    @cached_property
    def acting(self) -> Array:
        """(T, M) SI as they act on light: of a temperature that a sensor would read, more or less of it by the body's
        coefficient.
        """
        factor = [1.0 + self.coefficients.get(c.body, 0.0) * (c.kind == "temperature") for c in self.components]
        return np.asarray(self.amounts * np.array(factor))

    @cached_property
    def temperatures(self) -> dict[str, Array]:
        """Body -> (T,) change of its temperature against the instrument's, kelvin."""
        out: dict[str, Array] = {}
        for k, one in enumerate(self.components):
            if one.kind == "temperature":
                out[one.body] = out.get(one.body, np.zeros(len(self.times))) + self.amounts[:, k]
        return out


def drawn_life(
    stated: StatedMotions,
    times: Moments,
    zero: int,
    seed: int,
    causes: Mapping[str, Sequence[str]],
    dates: Sequence[tuple[int, str]] | None = None,
    coefficient_error: float = 0.0,
) -> Life:
    """Draw what every motion does.

    Args:
        stated: the motions and their laws of time.
        times: (T,) microseconds of TAI since 2000, rising.
        zero: from which the laws count their seconds, likewise.
        seed: of everything that is drawn; what one cause draws does not depend on the others.
        causes: event -> names of the causes whose motions step when it comes.
        dates: when which event comes; None to draw one date for each.
        coefficient_error: standard deviation of what a body's temperature does to light beyond what is computed,
            relative.
    """
    seconds = (times - zero) / MICRO
    own, drawn = causes_of(stated), np.zeros((len(times), len(stated.components)))
    steps: list[Step] = []
    for number, (cause, where) in enumerate(own.items()):
        rng = np.random.default_rng(stream(seed, _MOTIONS, number))
        root = _root(stated.correlation[np.ix_(where, where)])
        size = stated.sigma[where]
        drawn[:, where] = drawn_course(stated.laws[where[0]], seconds, rng, len(where)) @ root * size
        steps += _jumps(stated, cause, where, times, np.random.default_rng(stream(seed, _JUMPS, number)))
    came = _drawn_dates(sorted(causes), times, seed) if dates is None else tuple(sorted(dates))
    for number, (moment, name) in enumerate(came):
        for k, cause in enumerate(causes.get(name, ())):
            rng = np.random.default_rng(stream(seed, _EVENTS, number, k))
            steps.append(Step(moment, cause, "", name, _step(stated, own.get(cause, []), rng)))
    rng = np.random.default_rng(stream(seed, _COEFFICIENTS))
    warm = dict.fromkeys(c.body for c in stated.components if c.kind == "temperature")
    coefficients = dict(zip(warm, (coefficient_error * rng.standard_normal(len(warm))).tolist(), strict=True))
    return Life(times, stated.components, drawn, tuple(sorted(steps, key=_when)), came, coefficients)


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


def _jumps(
    stated: StatedMotions, cause: str, where: Sequence[int], times: Moments, rng: np.random.Generator
) -> Iterator[Step]:
    """Steps of a cause whose law is a jump with a mean time between two: those of one body come together."""
    every = stated.laws[where[0]].jump
    if every is None:
        return
    span = (int(times[-1]) - int(times[0])) / MICRO
    for body in dict.fromkeys(stated.components[k].body for k in where):
        own = [k for k in where if stated.components[k].body == body]
        for second in np.sort(rng.uniform(0.0, span, rng.poisson(span / every))).tolist():
            yield Step(int(times[0]) + round(second * MICRO), cause, body, "", _step(stated, own, rng))


def _step(stated: StatedMotions, where: Sequence[int], rng: np.random.Generator) -> Array:
    """(M,) SI by which some motions step, together as they are correlated; others by nothing."""
    out = np.zeros(len(stated.components))
    root = _root(stated.correlation[np.ix_(where, where)])
    out[list(where)] = rng.standard_normal(len(where)) @ root * stated.sigma[list(where)]
    return out


def _root(correlation: Array) -> Array:
    """Symmetric root of a correlation matrix."""
    values, vectors = np.linalg.eigh(correlation)
    return np.asarray((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T)


def _drawn_dates(events: Sequence[str], times: Moments, seed: int) -> tuple[tuple[int, str], ...]:
    """One date for each event, as likely at any time of a life but for its ends."""
    first, span = int(times[0]), int(times[-1]) - int(times[0])
    rng = np.random.default_rng(stream(seed, _DATES))
    shares = rng.uniform(_MARGIN, 1.0 - _MARGIN, len(events)).tolist()
    return tuple(sorted((first + round(share * span), name) for share, name in zip(shares, events, strict=True)))


def _when(step: Step) -> tuple[int, str, str]:
    return step.time, step.cause, step.body
