"""Best compromises between two competing numbers."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from scenes.study import ParetoSpec


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """Non-dominated runs of a pair.

    Attributes:
        spec: the pair, and which way each is better.
        runs: (m,) numbers of the runs on the front, from the best x to the best y.
        x: (m,) their x.
        y: (m,) their y.
        ranks: (n,) of all runs: 0 on the front, 1 when the front is taken away, ...; -1 without numbers.
        knee: index into ``runs`` of the strongest bulge; None where the front has none.
    """

    spec: ParetoSpec
    runs: np.ndarray
    x: np.ndarray
    y: np.ndarray
    ranks: np.ndarray
    knee: int | None


def pareto_front(spec: ParetoSpec, x: np.ndarray, y: np.ndarray) -> ParetoFront:
    """The front of (n,) ``x`` and ``y``."""
    good = np.isfinite(x) & np.isfinite(y)
    costs = np.stack([x if spec.best_x == "min" else -x, y if spec.best_y == "min" else -y], axis=-1)
    ranks = np.full(len(x), -1)
    ranks[good] = ranks_of(costs[good])
    front = np.flatnonzero(ranks == 0)
    front = front[np.lexsort((front, costs[front, 1], costs[front, 0]))]
    return ParetoFront(spec, front, x[front], y[front], ranks, knee(costs[front]))


def ranks_of(costs: np.ndarray) -> np.ndarray:
    """Fronts of (n, 2) costs by non-dominated sorting: (n,) 0 for points that no other is better than or equal to in
    both and better in one, 1 for those that only points of front 0 dominate, and so on. Equal points share a front.
    """
    order = np.lexsort((costs[:, 1], costs[:, 0]))
    ranks = np.empty(len(costs), np.int64)
    # smallest second cost of every front so far; it rises with the rank, so that bisection finds the front
    lowest: list[float] = []
    before: tuple[float, float] | None = None
    rank = 0
    for k in order:
        point = (float(costs[k, 0]), float(costs[k, 1]))
        if point != before:
            # a front with a second cost that is not larger holds a point that dominates this one
            rank = bisect_right(lowest, point[1])
            if rank == len(lowest):
                lowest.append(point[1])
            else:
                lowest[rank] = point[1]
            before = point
        ranks[k] = rank
    return ranks


def knee(costs: np.ndarray) -> int | None:
    """Where a front (m, 2), in order of the first cost, lies farthest below the line through its ends.

    Both costs are scaled to the front's range. None for fewer than three different points, or when no point lies below
    the line by more than rounding.
    """
    if len(np.unique(costs, axis=0)) < 3:
        return None
    span = np.ptp(costs, axis=0)
    scaled = (costs - costs.min(axis=0)) / span
    # the ends are (0, 1) and (1, 0)
    gain = 1.0 - scaled.sum(axis=1)
    best = int(np.argmax(gain))
    return best if gain[best] > 1e-9 else None
