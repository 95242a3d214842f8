"""A life that could have been: amounts of every stated motion over time, drawn by the laws of their disturbances.

Laws without steps are drawn by `scenes.models.drawn_motions`; steps come by chance at a stated mean rate, or at the
dates of events. Nothing here uses the filter or the smoother that such lives test.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scenes.models.disturbances import Component, StatedMotions, correlation_root
from scenes.models.drawn_motions import causes_of, drawn_motions
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
    drawn = drawn_motions(stated, seconds, lambda number: np.random.default_rng(stream(seed, _MOTIONS, number)))
    own, steps = causes_of(stated), list[Step]()
    for number, (cause, where) in enumerate(own.items()):
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
    root = correlation_root(stated.correlation[np.ix_(where, where)])
    out[list(where)] = rng.standard_normal(len(where)) @ root * stated.sigma[list(where)]
    return out


def _drawn_dates(events: Sequence[str], times: Moments, seed: int) -> tuple[tuple[int, str], ...]:
    """One date for each event, as likely at any time of a life but for its ends."""
    first, span = int(times[0]), int(times[-1]) - int(times[0])
    rng = np.random.default_rng(stream(seed, _DATES))
    shares = rng.uniform(_MARGIN, 1.0 - _MARGIN, len(events)).tolist()
    return tuple(sorted((first + round(share * span), name) for share, name in zip(shares, events, strict=True)))


def _when(step: Step) -> tuple[int, str, str]:
    return step.time, step.cause, step.body
