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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, OfStates

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
        states: amounts (S, P) -> the states that they make.
        trace: S states -> what they do. Models that have the same one are traced together.
        near_px: states in which no spot moves by more are taken as linear and not traced, px.
    """

    spots: Array
    parameters: Array
    amounts: Callable[[Array], Array]
    states: Callable[[Array], Sequence[Any]]
    trace: Callable[[Sequence[Any]], Retraced]
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


@dataclass(frozen=True, eq=False)
class LinearReading:
    """What an estimator reads by derivatives in S states.

    Attributes:
        values: (S, 4 K), rad and m.
        total: (S, 4 K, 4 K) covariance of their errors.
        model: the motions by which it reads.
    """

    values: Array
    total: Array
    model: MotionModel


def read_again(
    readings: Mapping[str, LinearReading], shift: Array, noise: Array, rows: Array
) -> dict[str, tuple[Array, Curvature]]:
    """Readings (S, 4 K) of each estimator, worked out anew where they are not linear, and what was found.

    Args:
        readings: estimator -> its linear readings.
        shift: (S, D) px.
        noise: (S, D, D) px^2 of them.
        rows: (Q, 4 K) of the quantities that are judged.
    """
    steps = {title: _Steps.of(reading, shift, noise, rows) for title, reading in readings.items()}
    found = _traced_together({title: (own.model, own.x[own.far]) for title, own in steps.items()})
    return {title: own.judged(readings[title].values, found[title]) for title, own in steps.items()}


def _traced_together(wanted: Mapping[str, tuple[MotionModel, Array]]) -> dict[str, Retraced]:
    """What the states of amounts (S, P) of each model do."""
    ways: dict[int, list[str]] = {}
    for title, (model, _) in wanted.items():
        ways.setdefault(id(model.trace), []).append(title)
    out: dict[str, Retraced] = {}
    for titles in ways.values():
        states = [state for title in titles for state in wanted[title][0].states(wanted[title][1])]
        model = wanted[titles[0]][0]
        nothing = Retraced(np.empty((0, len(model.spots))), np.empty((0, len(model.parameters))))
        found, end = model.trace(states) if states else nothing, 0
        for title in titles:
            own = slice(end, end + len(wanted[title][1]))
            out[title], end = Retraced(found.spots[own], found.parameters[own]), own.stop
    return out


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of Gauss and Newton about the states that S readings of an estimator stand for.

    Attributes:
        model: of its motions.
        shift: (S, D) px; gain: G, (S, P, D); x: (S, P) motions that the readings stand for.
        sigma: (S, Q) of the quantities; rows: theirs, (Q, 4 K).
        far: states that are traced.
    """

    model: MotionModel
    shift: Array
    gain: Array
    x: Array
    sigma: Array
    rows: Array
    far: NDArray[np.intp]

    @classmethod
    def of(cls, reading: LinearReading, shift: Array, noise: Array, rows: Array) -> _Steps:
        gain = reading.model.amounts(noise)
        sigma = np.sqrt(np.maximum(np.einsum("qi,sij,qj->sq", rows, reading.total, rows), 0.0))
        far = np.flatnonzero(np.any(np.abs(shift) > reading.model.near_px, axis=1))
        return cls(reading.model, shift, gain, np.einsum("spd,sd->sp", gain, shift), sigma, rows, far)

    def in_sigmas(self, change: Array, states: slice | NDArray[np.intp]) -> Array:
        moved = np.abs(change @ self.rows.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(moved == 0.0, 0.0, moved / self.sigma[states])

    def step(self, x: Array, found: Retraced, states: slice | NDArray[np.intp]) -> Array:
        rest = self.shift[states] - found.spots + x @ self.model.spots.T
        return np.asarray(np.einsum("spd,sd->sp", self.gain[states], rest))

    def judged(self, values: Array, traced: Retraced) -> tuple[Array, Curvature]:
        """Readings (S, 4 K), worked out anew where they are not linear, by what the states that are far do."""
        model, x, every = self.model, self.x, slice(None)
        found = Retraced(x @ model.spots.T, x @ model.parameters.T)
        found.spots[self.far], found.parameters[self.far] = traced.spots, traced.parameters
        # the two are one number where everything is linear
        curved = found.parameters + (self.step(x, found, every) - x) @ model.parameters.T - x @ model.parameters.T
        off = self.in_sigmas(curved, every)
        beyond = ~np.all(off <= BEYOND, axis=1)
        out, rests = values.copy(), ~beyond
        left = np.flatnonzero(beyond & np.all(np.isfinite(off), axis=1))
        x, last = x[left], Retraced(found.spots[left], found.parameters[left])
        for _ in range(_MOST_STEPS):
            if not len(left):
                break
            x = self.step(x, last, left)
            now = model.trace(model.states(x))
            change = self.in_sigmas(now.parameters - last.parameters, left)
            done = np.all(change <= _REST, axis=1)
            out[left[done]], rests[left[done]] = now.parameters[done], True
            on = ~done & np.all(np.isfinite(change), axis=1)
            left, x, last = left[on], x[on], Retraced(now.spots[on], now.parameters[on])
        return out, Curvature(off, beyond, rests)
