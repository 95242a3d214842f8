"""What the figures of a study share: panels, labels, ticks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from twin.report.svg import BLUE, GREEN, LIGHT, ORANGE, PURPLE, SKY, VERMILION, new_figure, plain_axes
from twin.study.report.study_runs import Factor, Response

COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
MARKS = ("o", "s", "^", "D", "v", "P")
MOST_POINTS = 500
"""Of a scatter: more would make the page heavy and the picture black."""
STEPS = (1, 2, 2.5, 5, 10)
"""Ticks are these times a power of ten apart."""
LONGEST = 18
"""Characters of a text on an axis."""


def panels(count: int, wide: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels, ``wide`` beside each other, each ``height`` inches high."""
    rows = -(-count // wide)
    figure = new_figure(height * rows)
    grid = figure.subplots(rows, wide, squeeze=False).ravel()
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, list(grid[:count])


def finish(axes: Axes, x_ticks: int | None = 6, y_ticks: int | None = 5) -> None:
    """The look of all panels; None leaves the ticks of an axis as they are."""
    axes.grid(color=LIGHT, lw=0.5)
    axes.set_axisbelow(True)
    plain_axes(axes)
    if x_ticks is not None:
        axes.xaxis.set_major_locator(MaxNLocator(x_ticks, steps=STEPS))
        _plain_numbers(axes, "x")
    if y_ticks is not None:
        axes.yaxis.set_major_locator(MaxNLocator(y_ticks, steps=STEPS))
        _plain_numbers(axes, "y")


def _plain_numbers(axes: Axes, which: str) -> None:
    """Whole numbers at the ticks, and not what is to be added to each, as long as they stay short."""
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    short = abs(high - low) > 1e-4 * max(abs(low), abs(high))
    axes.ticklabel_format(axis=which, style="sci", scilimits=(-3, 5), useOffset=not short)  # type: ignore[arg-type]


def short(text: str) -> str:
    """A text that fits on an axis."""
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def positions(thing: Factor | Response) -> np.ndarray:
    """(runs,) where the values stand on an axis: numbers where they are, texts at 0, 1, ..."""
    if isinstance(thing, Factor) and not thing.numeric:
        return np.array([np.flatnonzero(thing.levels == value)[0] for value in thing.values], np.float64)
    return thing.values


def name_texts(axes: Axes, thing: Factor | Response, which: str) -> None:
    """Names of the texts at an axis with ``positions``; nothing for numbers."""
    if not isinstance(thing, Factor) or thing.numeric:
        return
    places, names = np.arange(len(thing.levels)), [short(str(level)) for level in thing.levels]
    if which == "x":
        turned = sum(len(name) for name in names) > 34
        axes.set_xticks(places, names, rotation=30 if turned else 0, ha="right" if turned else "center")
        axes.set_xlim(-0.6, len(names) - 0.4)
    else:
        axes.set_yticks(places, names)
        axes.set_ylim(-0.6, len(names) - 0.4)


def some(good: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """Numbers of up to ``most`` runs of (n,) ``good``, evenly through the study."""
    found = np.flatnonzero(good)
    return found if len(found) <= most else found[np.linspace(0, len(found) - 1, most).astype(int)]


def jitter(thing: Factor | Response, seed: int) -> np.ndarray:
    """(runs,) what is added to ``positions`` so that points of one text do not hide each other."""
    if isinstance(thing, Factor) and not thing.numeric:
        return np.random.default_rng(np.random.SeedSequence(seed)).uniform(-0.2, 0.2, len(thing.values))
    return np.zeros(len(thing.values))


def bins(factor: Factor, good: np.ndarray) -> Iterator[np.ndarray]:
    """Runs of a numeric factor in groups of neighbours of equal size, or of equal value for few values."""
    levels = np.unique(factor.values[good])
    if len(levels) <= 12:
        for level in levels:
            yield np.flatnonzero(good & (factor.values == level))
        return
    order = np.flatnonzero(good)[np.argsort(factor.values[good], kind="stable")]
    count = int(np.clip(len(order) // 10, 3, 15))
    yield from np.array_split(order, count)
