"""How statistics settle with the number of runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from twin.study.report.statistics import (
    Interval,
    mean_interval,
    quantile_interval,
    runs_for_quantile,
    std_interval,
)

QUANTILES = {"p95": 0.95, "p99.7": 0.997}
GOALS = {"mean": 0.1, "sigma": 0.1, "p95": 0.2, "p99.7": 0.2}
"""Half of the 95% interval, in units of sigma, below which a statistic counts as known."""
POINTS = 40


@dataclass(frozen=True, eq=False)
class Course:
    """A statistic of the first n runs.

    Attributes:
        name: mean, sigma, p95 or p99.7.
        counts: (m,) numbers of runs.
        values: (m,) the statistic.
        low: (m,) lower end of its interval, NaN where there is none.
        high: (m,) upper end.
        relative: half the interval at the end, in units of sigma; None where it is open.
        enough: whether that is below the goal.
        needed: about how many runs would reach it; None where it cannot be told.
    """

    name: str
    counts: np.ndarray
    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    relative: float | None
    enough: bool
    needed: int | None


def courses(values: np.ndarray) -> tuple[Course, ...]:
    """Of (n,) finite values in the order of the runs; none for fewer than 20 and for constant values."""
    n = len(values)
    if n < 20 or np.ptp(values) == 0.0:
        return ()
    counts = np.unique(np.rint(np.geomspace(10, n, POINTS)).astype(int))
    sigma = float(np.std(values, ddof=1))
    rows: dict[str, list[tuple[float, Interval]]] = {name: [] for name in GOALS}
    for count in counts:
        part = values[:count]
        ordered = np.sort(part)
        rows["mean"].append((float(np.mean(part)), mean_interval(part)))
        rows["sigma"].append((float(np.std(part, ddof=1)), std_interval(part)))
        for name, q in QUANTILES.items():
            rows[name].append((float(np.quantile(ordered, q)), quantile_interval(ordered, q)))
    return tuple(_course(name, counts, row, sigma) for name, row in rows.items())


def _course(name: str, counts: np.ndarray, row: list[tuple[float, Interval]], sigma: float) -> Course:
    low = np.array([math.nan if ends[0] is None else ends[0] for _, ends in row])
    high = np.array([math.nan if ends[1] is None else ends[1] for _, ends in row])
    half = 0.5 * (high[-1] - low[-1]) / sigma
    relative = float(half) if math.isfinite(half) else None
    n, goal = int(counts[-1]), GOALS[name]
    enough = relative is not None and relative <= goal
    needed = n if enough else None if relative is None else math.ceil(n * (relative / goal) ** 2)
    if relative is None and name in QUANTILES:
        needed = runs_for_quantile(QUANTILES[name])
    return Course(name, counts, np.array([value for value, _ in row]), low, high, relative, enough, needed)
