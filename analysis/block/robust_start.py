"""Robust start of a block adjustment: weights that gross errors of any size cannot corrupt.

Least squares spreads an error of hundreds of sigmas over all unknowns, so that residuals no longer show which
measurement has it. Three steps precede the tests of the adjustment:

1. Every ground point is intersected alone, for unchanged unknowns, with Huber's weights (`intersection`).
2. The whole block is adjusted with Huber's weights until these settle. Their scale is the median residual of each group
   of observations while that exceeds the stated sigmas: at first all residuals contain the errors of orbits, attitudes
   or rational polynomials. The sum that is minimised is convex, so that the start does not matter, and a measurement
   moves the unknowns by a bounded amount.
3. For these unknowns the measurements of each point are tested against each other (`consistent`). A measurement is
   rejected if the others contradict it and no other measurement explains the contradiction nearly as well (data
   snooping, Baarda 1968); where several explain it, as along the common direction of the looks, all of them are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from analysis.arrays import Array, Indices
from analysis.block.point_reduction import Packets, State
from analysis.block.reweighting import SETTLED, limits, standardised_packets

S = TypeVar("S", bound=State)
_PIECE = 20_000
"""Number of measurements that are linearised at once, which limits the memory."""
_STEPS = 40
"""Largest number of steps of an intersection: Huber's weights halve the effect of a gross error in a step."""
_CONVERGED = 1e-3
"""Step of an intersected point, in sigmas, that ends its iteration."""
_ROUNDS = 20
"""Largest number of rounds of reweighting of the whole block."""
_SETTLED = 1e-3
"""Mean change of the weights that ends the reweighting; the tests that follow determine the final weights."""
_LOOSE = 1e-10
"""Weight in 1/m^2 that keeps undetermined points invertible; sigma of 100 km in each coordinate."""
_SPARE = 2.0
"""Factor on the limit of rejection before the tests of the adjustment, for errors of the unknowns at the start."""
Miss = tuple[Indices, Array, Array]
"""Indices of measurements of a set, their whitened misclosures (n, d) and the derivatives by the point (n, d, 3)."""


def linearised(sets: Sequence[Packets], state: State, points: NDArray[np.bool_]) -> list[list[Miss]]:
    """Return the equations of the measurements of selected points, in pieces for each set of observations."""
    equations: list[list[Miss]] = []
    for packets in sets:
        which = np.flatnonzero(points[packets.point])
        pieces = np.split(which, np.arange(_PIECE, len(which), _PIECE)) if len(which) else []
        equations.append([])
        for piece in pieces:
            miss, _, by_point = packets.linearised(piece, state.x, state.ground[packets.point[piece]])
            equations[-1].append((piece, miss, by_point))
    return equations


def _solved(
    sets: Sequence[Packets], equations: list[list[Miss]], weight: Sequence[Array], count: int
) -> tuple[Array, Array]:
    """Return the covariances (m, 3, 3) and the least-squares steps (m, 3), in metres, of points for fixed unknowns."""
    normal, pull = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for packets, pieces, weights in zip(sets, equations, weight, strict=True):
        for which, miss, by_point in pieces:
            weighted = by_point * weights[which][:, None, None]
            np.add.at(normal, packets.point[which], np.swapaxes(weighted, 1, 2) @ by_point)
            np.add.at(pull, packets.point[which], np.einsum("ndi,nd->ni", weighted, miss))
    inverse = np.linalg.inv(normal + _LOOSE * np.eye(3))
    return np.asarray(inverse), np.asarray(-np.einsum("nij,nj->ni", inverse, pull))


def _sizes(equations: list[list[Miss]], sets: Sequence[Packets]) -> tuple[Array, ...]:
    """Return the norms of the whitened residuals of every measurement, by set; zero for those without equations."""
    sizes = tuple(np.zeros(len(packets.point)) for packets in sets)
    for size, pieces in zip(sizes, equations, strict=True):
        for which, miss, _ in pieces:
            size[which] = np.linalg.norm(miss, axis=1)
    return sizes


@cache
def _median(rows: int) -> float:
    """Return the median norm of the residuals of a good measurement of some equations."""
    return float(np.sqrt(chi2.median(rows)))


def scales(sets: Sequence[Packets], sizes: Sequence[Array]) -> dict[str, float]:
    """Return by how much the median residual of each group exceeds that of its stated sigmas, at least 1."""
    groups: dict[str, list[Array]] = {}
    for packets, size in zip(sets, sizes, strict=True):
        groups.setdefault(packets.group, []).append(size / _median(packets.rows))
    norms = {group: np.sort(np.concatenate(parts)) for group, parts in groups.items()}
    # the lower median of two measurements is that of the better one
    return {group: max(1.0, float(size[(len(size) - 1) // 2])) for group, size in norms.items()}


def _huber(sets: Sequence[Packets], sizes: Sequence[Array]) -> tuple[Array, ...]:
    """Return Huber's weights of all measurements at the scales of their groups."""
    scale = scales(sets, sizes)
    return tuple(
        np.minimum(1.0, scale[packets.group] * limits(packets.rows)[0] / np.maximum(size, 1e-300))
        for packets, size in zip(sets, sizes, strict=True)
    )


def intersection(sets: Sequence[Packets], state: S) -> S:
    """Return the state with all points intersected for its unknowns, with Huber's weights of their measurements."""
    active = np.ones(len(state.ground), bool)
    weight = state.weight
    ground, size = state.ground.copy(), _sizes([[] for _ in sets], sets)
    for _ in range(_STEPS):
        equations = linearised(sets, replace(state, ground=ground), active)
        for k, new in enumerate(_sizes(equations, sets)):
            size[k][active[sets[k].point]] = new[active[sets[k].point]]
        weight = _huber(sets, size)
        inverse, step = _solved(sets, equations, weight, len(ground))
        ground[active] += step[active]
        sigma = np.sqrt(np.trace(inverse, axis1=1, axis2=2))
        active &= np.linalg.norm(step, axis=1) > _CONVERGED * sigma
        if not np.any(active):
            break
    return replace(state, ground=ground, weight=weight)


def screened(sets: Sequence[Packets], state: S, solve: Callable[[S], S]) -> S:
    """Return the state of an adjustment with Huber's weights that have settled.

    Parameters
    ----------
    sets : sequence of Packets
        Observations.
    state : State
        State with the points intersected.
    solve : callable
        Function from a state to that after a step of the adjustment with its weights.
    """
    everything = np.ones(len(state.ground), bool)
    for _ in range(_ROUNDS):
        state = solve(state)
        weight = _huber(sets, _sizes(linearised(sets, state, everything), sets))
        changes = [np.abs(a - b) for a, b in zip(weight, state.weight, strict=True)]
        change = float(np.mean(np.concatenate(changes)))
        state = replace(state, weight=weight)
        if change < _SETTLED:
            break
    return state


def consistent(sets: Sequence[Packets], state: State) -> tuple[Array, ...]:
    """Return weights 1 of measurements that agree with the others of their point for fixed unknowns, and 0 elsewhere.

    All equations have full weight here and are linearised at the robust position of the point. A point that keeps fewer
    than three equations has no weight at all.
    """
    weight = tuple(np.ones(len(packets.point)) for packets in sets)
    active = np.ones(len(state.ground), bool)
    most = int(np.max(sum(np.bincount(packets.point, minlength=len(active)) for packets in sets), initial=0))
    for _ in range(most):
        equations = linearised(sets, state, active)
        inverse, step = _solved(sets, equations, weight, len(active))
        square: list[Array] = []
        for packets, pieces, weights in zip(sets, equations, weight, strict=True):
            square.append(np.zeros(len(packets.point)))
            for which, miss, by_point in pieces:
                point = packets.point[which]
                residual = miss + np.einsum("ndi,ni->nd", by_point, step[point])
                cofactor = by_point @ inverse[point] @ np.swapaxes(by_point, 1, 2)
                standard = standardised_packets(residual, cofactor, weights[which], 1.0)
                square[-1][which] = np.sum(standard**2, axis=1)
        bad = contradicted(sets, square, weight, _SPARE)
        active[:] = False
        for packets, wrong, weights in zip(sets, bad, weight, strict=True):
            active[packets.point[wrong & (weights > 0.0)]] = True
            weights[wrong] = 0.0
        if not np.any(active):
            break
    lost = equations_left(sets, weight, len(active)) < 3
    return tuple(np.where(lost[packets.point], 0.0, w) for packets, w in zip(sets, weight, strict=True))


def contradicted(
    sets: Sequence[Packets], square: Sequence[Array], weight: Sequence[Array], spare: float = 1.0
) -> tuple[NDArray[np.bool_], ...]:
    """Return masks of the measurements that the others of their point contradict.

    They are those beyond the limit of rejection that have no weight, or whose squared standardised residual is the
    largest of the measurements of their point that have, or below it by less than chance explains: without any of these
    the others would agree.

    Parameters
    ----------
    sets : sequence of Packets
        Observations.
    square : sequence of (n,) ndarray
        Squared standardised residuals of the measurements of each set; each is the amount by which chi-square falls
        without the measurement.
    weight : sequence of (n,) ndarray
        Weights of the measurements, 0 if they are rejected so far.
    spare : float
        Factor on the limit.
    """
    count = 1 + max((int(packets.point.max(initial=0)) for packets in sets), default=0)
    largest = np.zeros(count)
    for packets, size, w in zip(sets, square, weight, strict=True):
        np.maximum.at(largest, packets.point, np.where(w > SETTLED, size, 0.0))
    masks = []
    for packets, size, w in zip(sets, square, weight, strict=True):
        limit = limits(packets.rows)[1] ** 2
        masks.append((size > spare**2 * limit) & ((w <= SETTLED) | (size >= largest[packets.point] - limit)))
    return tuple(masks)


def equations_left(sets: Sequence[Packets], weight: Sequence[Array], count: int, least: float = 0.0) -> Indices:
    """Return the number of equations (m,) of each of m points whose weights exceed a limit."""
    rows = np.zeros(count, np.intp)
    for packets, w in zip(sets, weight, strict=True):
        np.add.at(rows, packets.point, packets.rows * (w > least))
    return rows
