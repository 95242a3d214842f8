"""Are the motions that a reading stands for small enough to be linear? The reading is compared with a retraced state.

An estimator reads parameters by motions x of which it knows, s = A x and p = B x for the spots and the parameters; its
x = G s are an estimate of them. Traced again, the instrument in the state x has the spots s(x) and the parameters p(x).
One step of Gauss and Newton about x,

    p(x) + B (x' - x),   x' = G (s - s(x) + A x),

differs from the linear reading B G s by what is not linear. Where that is more than `BEYOND` standard deviations of
any quantity the steps go on to their end, and the reading is p of it (Nocedal and Wright, Numerical Optimization, 2006,
sec. 10.3). Derivatives stay those of the instrument at rest: they change by as many parts as the motions are radians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.states import OfStates

__all__ = ["BEYOND", "Curvature", "MotionModel", "Retraced", "read_again"]

Array = NDArray[np.float64]
BEYOND = 3.0
"""Sigmas of a quantity by which a linear reading may be off before it is worked out anew."""
_REST = 1e-2
"""Sigmas by which the last step may move a quantity."""
_MOST_STEPS = 20


@dataclass(frozen=True, eq=False)
class Retraced:
    """What S states do, exactly.

    Attributes:
        spots: (S, D) shifts, px; NaN in a state whose light is lost.
        parameters: (S, 4 K) changes, rad and m, likewise.
    """

    spots: Array
    parameters: Array


@dataclass(frozen=True, eq=False)
class MotionModel:
    """The motions that an estimator knows of.

    Attributes:
        spots: A, (D, P) px per unit of each motion.
        parameters: B, (4 K, P) rad and m, likewise.
        amounts: covariance of the shifts (S, D, D), px^2 -> G, (S, P, D) units per px.
        trace: amounts (S, P) -> what these states do.
        near_px: states in which no spot moves by more are taken as linear and not traced, px.
    """

    spots: Array
    parameters: Array
    amounts: Callable[[Array], Array]
    trace: Callable[[Array], Retraced]
    near_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Curvature(OfStates):
    """What retraced states say of the linear readings of an estimator in S states.

    Attributes:
        off: (S, Q) what the linear reading of each quantity is off by, sigmas; NaN where the state cannot be traced.
        beyond: (S,) whether it is too much, so that the readings are those of the last step.
        rests: (S,) whether the steps came to rest; true where none were needed.
    """

    off: Array
    beyond: NDArray[np.bool_]
    rests: NDArray[np.bool_]

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(S,) whether the readings are right, linear or not."""
        return self.rests

    def worst(self, state: int = 0) -> tuple[int, float]:
        """Number of the quantity whose linear reading is off by most, and by how many sigmas."""
        size = np.abs(self.off[state])
        if not np.any(np.isfinite(size)):
            return 0, np.inf
        worst = int(np.nanargmax(size))
        return worst, float(size[worst])


def read_again(
    values: Array, shift: Array, noise: Array, total: Array, rows: Array, model: MotionModel
) -> tuple[Array, Curvature]:
    """Readings (S, 4 K), worked out anew where they are not linear, and what was found.

    Args:
        values: linear readings, (S, 4 K), rad and m.
        shift: (S, D) px.
        noise: (S, D, D) px^2 of them.
        total: (S, 4 K, 4 K) covariance of the readings' errors.
        rows: (Q, 4 K) of the quantities that are judged.
        model: of the motions by which the estimator reads.
    """
    gain = model.amounts(noise)
    sigma = np.sqrt(np.maximum(np.einsum("qi,sij,qj->sq", rows, total, rows), 0.0))

    def in_sigmas(change: Array, states: slice | NDArray[np.intp]) -> Array:
        moved = np.abs(change @ rows.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(moved == 0.0, 0.0, moved / sigma[states])

    def step(x: Array, found: Retraced, states: slice | NDArray[np.intp]) -> Array:
        return np.einsum("spd,sd->sp", gain[states], shift[states] - found.spots + x @ model.spots.T)

    every = slice(None)
    x = np.einsum("spd,sd->sp", gain, shift)
    found = Retraced(x @ model.spots.T, x @ model.parameters.T)
    far = np.flatnonzero(np.any(np.abs(shift) > model.near_px, axis=1))
    if len(far):
        traced = model.trace(x[far])
        found.spots[far], found.parameters[far] = traced.spots, traced.parameters
    # the two are one number where everything is linear
    curved = found.parameters + (step(x, found, every) - x) @ model.parameters.T - x @ model.parameters.T
    off = in_sigmas(curved, every)
    beyond = ~np.all(off <= BEYOND, axis=1)
    out, rests = values.copy(), ~beyond
    left = np.flatnonzero(beyond & np.all(np.isfinite(off), axis=1))
    x, last = x[left], Retraced(found.spots[left], found.parameters[left])
    for _ in range(_MOST_STEPS):
        if not len(left):
            break
        x = step(x, last, left)
        now = model.trace(x)
        change = in_sigmas(now.parameters - last.parameters, left)
        done = np.all(change <= _REST, axis=1)
        out[left[done]], rests[left[done]] = now.parameters[done], True
        on = ~done & np.all(np.isfinite(change), axis=1)
        left, x, last = left[on], x[on], Retraced(now.spots[on], now.parameters[on])
    return out, Curvature(off, beyond, rests)
