"""State space of the disturbances: the motions of the prior as a process from one reading to the next.

Every law in time of `analysis.monitor.disturbances`, except its products with probabilities, is a process of finitely
many states, so that the covariances

    g(t) g(t') exp(-|t - t'| / D) cos(2 pi (t - t') / T) C(min(t, t'))

(g growth of a trend, D correlation time, T period of an oscillation, C variance of steps) are those of states with a
decay, a rotation, an amplitude g and a variance C(t) that steps add to (Sarkka, Solin, Applied Stochastic Differential
Equations, 2019, ch. 12). Motions of one law with the same effect on spots and parameters need no separate states: for M
motions the states are the singular vectors of their effect on the D + P outputs, at most D + P of them. Steps, those of
events and those of jumps, change one common level.

Temperatures of bodies that have a sensor keep separate states, since sensors read them, and so does the factor by which
the real effect of heat on light exceeds the computed one: the product of the two is taken to second order.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.learned_terms import Terms

_INTERVALS = 200
"""Number of intervals between readings whose state transitions are kept in memory."""
_NOTHING = 1e-12
"""Singular value of the scaled effects of motions on the outputs, relative to the largest, that is only rounding."""


@dataclass(frozen=True, eq=False)
class HeatInputs:
    """Temperatures of bodies that sensors read, as inputs of the state space with uncertain effect on the light.

    Dimensions: m motions.

    Attributes
    ----------
    motions : (m,) ndarray of int
        Indices of the disturbances that are temperatures or gradients of bodies with sensors.
    sensors : tuple of str
        Names of the S sensors.
    rows : (S, m) ndarray
        Temperature at each sensor for one standard deviation of each motion, K.
    factors : (m,) ndarray of int
        Index of the factor by which the effect of each motion on light differs from the computed one.
    names : tuple of str
        Names of the factors, which are those of the bodies.
    sigma : float
        Standard deviation of a factor before any reading.
    """

    motions: NDArray[np.int_]
    sensors: tuple[str, ...]
    rows: Array
    factors: NDArray[np.int_]
    names: tuple[str, ...]
    sigma: float


_Stepping = tuple[tuple[TimeLaw, Array], ...]
_Kind = Literal["level", "law", "heat", "factor", "term", "reference"]


@dataclass(frozen=True, eq=False)
class _Block:
    """States that represent all motions of one time law.

    Dimensions: D spot coordinates (row and column of every spot), P parameters.

    Attributes
    ----------
    kind : str
        `level` for everything that changes by steps, `law` for another time law, `heat` for temperatures with sensors,
        `factor` for the factors of the effect of heat, `term` for learned terms, `reference` for the error of the
        reference positions.
    law : TimeLaw
        Law in time.
    at : slice
        Range of the block's states among all; for a law with a period the first half is the cosine part, the second the
        sine part.
    outputs : (D + P, r) ndarray
        Effect of the first r states on spot coordinates (px) and parameters, where the law's amplitude is 1.
    covariance : (r, r) ndarray
        Covariance of the states where the law's own variance is 1.
    motions : tuple of int
        Indices of the disturbances that they represent.
    steps : tuple of (TimeLaw, (r, r) ndarray)
        Laws and covariances of events and jumps, for the level alone.
    """

    kind: _Kind
    law: TimeLaw
    at: slice
    outputs: Array
    covariance: Array
    motions: tuple[int, ...] = ()
    steps: _Stepping = ()

    @property
    def rank(self) -> int:
        return int(self.outputs.shape[1])


@dataclass(frozen=True, eq=False)
class _Transition:
    """Change of the states over an interval between two times.

    Dimensions: n states of the filter.

    Attributes
    ----------
    kept : (n,) ndarray
        Factor by which each state decays over the interval, 0 to 1.
    kept_both : (n, n) ndarray
        Factor by which the product of two states decays over the interval.
    rotated : tuple of (slice, ndarray)
        For each law with a period its states, and the matrix of their rotation.
    gained : (n, n) ndarray
        Process noise: covariance that the time laws without events add to the states in the interval.
    """

    kept: Array
    kept_both: Array
    rotated: tuple[tuple[slice, Array], ...]
    gained: Array


@dataclass(frozen=True, eq=False)
class StateSpace:
    """Process of all disturbances, and of the error of the reference that all shifts are counted from.

    Attributes
    ----------
    prior : Disturbances
        Prior with D spot coordinates and P parameters.
    reference_noise : (D, D) ndarray or None
        Noise of the reference's spots, the same error in every shift, px^2; None if there is none.
    heat : HeatInputs or None
        Temperatures that sensors read; None if there is none.
    stepping : tuple of int
        Indices of motions of any law that may step, beside those with a law of steps.
    terms : Terms or None
        Known functions of time with learned amounts, such as decays and commanded moves; None if there are none.

    Raises
    ------
    ValueError
        Motions of different laws are correlated.
    """

    prior: Disturbances
    reference_noise: Array | None = None
    heat: HeatInputs | None = None
    stepping: tuple[int, ...] = ()
    terms: Terms | None = None
    _blocks: tuple[_Block, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        object.__setattr__(self, "_blocks", tuple(self._made()))

    def _made(self) -> list[_Block]:
        prior = self.prior
        outputs = self.outputs_of(range(len(prior.labels)))
        scale = np.abs(outputs).max(axis=1, initial=0.0)
        scale = np.where(scale > 0.0, scale, 1.0)[:, None]
        raw = np.zeros(len(prior.labels), bool)
        if self.heat is not None:
            raw[self.heat.motions] = True
        laws = list(dict.fromkeys(prior.laws))
        members = {law: np.array([other == law for other in prior.laws]) for law in laws}
        for law in laws:
            if np.any(prior.correlation[np.ix_(members[law], ~members[law])]):
                raise ValueError("state space: motions with different laws in time cannot be correlated")
        out: list[_Block] = []

        def add(
            kind: _Kind,
            law: TimeLaw,
            columns: Array,
            covariance: Array,
            motions: NDArray[np.intp],
            steps: _Stepping = (),
        ) -> None:
            start = out[-1].at.stop if out else 0
            at = slice(start, start + columns.shape[1] * (1 if law.period_s is None else 2))
            out.append(_Block(kind, law, at, columns, covariance, tuple(motions.tolist()), steps))

        level = np.array([_is_level(law) for law in prior.laws], bool) & ~raw
        if np.any(level) or self.stepping:
            spanning = level.copy()
            spanning[list(self.stepping)] = True
            basis, _ = _spanned(outputs[:, spanning] / scale)
            steps = []
            for law in filter(_is_level, laws):
                mine = members[law] & ~raw
                at = basis.T @ (outputs[:, mine] / scale)
                effect = at @ prior.correlation[np.ix_(mine, mine)] @ at.T
                steps.append((law, 0.5 * (effect + effect.T)))
            none = np.zeros((basis.shape[1],) * 2)
            add("level", TimeLaw(), scale * basis, none, np.flatnonzero(level), tuple(steps))
        for law in laws:
            mine = members[law] & ~raw
            if not _is_level(law) and np.any(mine):
                values, vectors = np.linalg.eigh(prior.correlation[np.ix_(mine, mine)])
                moved = outputs[:, mine] @ (vectors * np.sqrt(np.clip(values, 0.0, None)))
                basis, sizes = _spanned(moved / scale)
                add("law", law, scale * (basis * sizes), np.eye(basis.shape[1]), np.flatnonzero(mine))
        if self.heat is not None:
            for law in laws:
                mine = members[law] & raw
                if np.any(mine):
                    correlation = prior.correlation[np.ix_(mine, mine)]
                    add("heat", law, outputs[:, mine], correlation, np.flatnonzero(mine))
            factors = len(self.heat.names)
            spread = self.heat.sigma**2 * np.eye(factors)
            add("factor", TimeLaw(), np.zeros((len(scale), factors)), spread, np.empty(0, int))
        if self.reference_noise is not None:
            rows = np.zeros((len(scale), self.width))
            rows[: self.width] = np.eye(self.width)
            add("reference", TimeLaw(), rows, self.reference_noise, np.empty(0, int))
        if self.terms is not None:
            moved = np.array(self.terms.motions, int)
            add("term", TimeLaw(), outputs[:, moved], np.diag(self.terms.sigma**2), moved)
        return out

    @cached_property
    def size(self) -> int:
        """Number of states of all time laws together."""
        return self._blocks[-1].at.stop if self._blocks else 0

    @property
    def width(self) -> int:
        """Number of spot coordinates (row and column of every spot)."""
        return int(self.prior.spots.shape[0])

    def outputs_of(self, motions: Sequence[int] | range) -> Array:
        """Return the effect of motions of one standard deviation, (D + P, m): spots in px, then parameters.

        Dimensions: D spot coordinates (row and column of every spot), P parameters.

        Parameters
        ----------
        motions : sequence of int
            Indices of m motions.
        """
        indices = list(motions)
        return np.concatenate([self.prior.spots[:, indices], self.prior.parameters[:, indices]])

    @property
    def level(self) -> slice:
        """Range, among all states, of those that steps (events and jumps) change."""
        return self._blocks[0].at if self._blocks else slice(0, 0)

    def level_of(self, motions: Sequence[int]) -> Array:
        """Return the change of the states by a step of one standard deviation of each of some motions, (n, m).

        Dimensions: n states of the filter.

        Parameters
        ----------
        motions : sequence of int
            Indices of m motions that jump or have events.
        """
        out = np.zeros((self.size, len(motions)))
        block = self._blocks[0]
        out[block.at] = self._coordinates(block, motions)
        return out

    @cached_property
    def level_inverse(self) -> Array:
        """Least-squares inverse of the effect of the level states on the outputs, (n, D + P).

        Dimensions: n states of the filter, D spot coordinates (row and column of every spot), P parameters.
        """
        block = self._blocks[0]
        scale = np.abs(block.outputs).max(axis=1, initial=0.0)
        scale = np.where(scale > 0.0, scale, 1.0)
        out = np.zeros((self.size, len(scale)))
        out[block.at] = np.linalg.pinv(block.outputs / scale[:, None]) / scale
        return out

    def _coordinates(self, block: _Block, motions: Sequence[int]) -> Array:
        """Return the states of a block that have the same effect on the outputs as some motions, (r, m).

        Dimensions: r states of the block, m motions.
        """
        scale = np.abs(block.outputs).max(axis=1, initial=0.0)
        scale = np.where(scale > 0.0, scale, 1.0)[:, None]
        return np.asarray(np.linalg.lstsq(block.outputs / scale, self.outputs_of(motions) / scale, rcond=None)[0])

    def start(self, time: float) -> tuple[Array, Array]:
        """Return mean (n,) and covariance (n, n) of the states before any reading.

        Dimensions: n states of the filter.

        Parameters
        ----------
        time : float
            Time, s.
        """
        spread = np.zeros((self.size, self.size))
        for block in self._blocks:
            self._add(spread, block, block.covariance * _variance(block.law, time))
            for law, steps in block.steps:
                self._add(spread, block, _step_variance(law, time) * steps)
        mean = np.zeros(self.size)
        if self.terms is not None:
            mean[self.term_states] = self.terms.mean
        return mean, spread

    @staticmethod
    def _add(spread: Array, block: _Block, what: Array) -> None:
        parts = [block.at] if block.law.period_s is None else _halves(block.at)
        for part in parts:
            spread[part, part] += what

    def moved(self, states: Array, then: float, now: float, back: bool = False) -> Array:
        """Return states, or vectors that propagate like states, at another time, without process noise, (..., n, k).

        Dimensions: n states of the filter, k columns.

        Parameters
        ----------
        states : (..., n, k) ndarray
            k columns, each a vector of the n states.
        then : float
            Time of the states, s.
        now : float
            Later time, s.
        back : bool
            True to use the transposed transition, which a smoother needs from ``now`` to ``then``.
        """
        if now == then:
            return states
        over = self._transition(now - then)
        out = np.asarray(states * over.kept[:, None])
        for at, rotation in over.rotated:
            out[..., at, :] = (rotation.T if back else rotation) @ out[..., at, :]
        return out

    def moved_both(self, square: Array, then: float, now: float, back: bool = False) -> Array:
        """Return a covariance, or a matrix that propagates as one, at another time, (n, n).

        The result is symmetric to the last bit if the input is.

        Dimensions: n states of the filter.

        Parameters
        ----------
        square : (n, n) ndarray
            Covariance.
        then : float
            Time of the covariance, s.
        now : float
            Later time, s.
        back : bool
            True to use the transposed transition, which a smoother needs from ``now`` to ``then``.
        """
        if now == then:
            return square
        over = self._transition(now - then)
        out = np.asarray(square * over.kept_both)
        for at, rotation in over.rotated:
            rotation = rotation.T if back else rotation
            strip = rotation @ out[at]
            rotated = strip[:, at] @ rotation.T
            strip[:, at] = 0.5 * (rotated + rotated.T)
            out[at], out[:, at] = strip, strip.T
        return out

    def _transition(self, over: float) -> _Transition:
        if over not in self._transitions:
            if len(self._transitions) > _INTERVALS:
                self._transitions.clear()
            kept, rotated, gained = np.ones(self.size), [], np.zeros((self.size, self.size))
            for block in self._blocks:
                kept[block.at] = _kept(block.law, over)
                if not block.law.event:
                    self._add(gained, block, (1.0 - _kept(block.law, over) ** 2) * block.covariance)
            for at, period, still, quarter in self._turning:
                angle = 2.0 * math.pi * over / period
                rotated.append((at, math.cos(angle) * still + math.sin(angle) * quarter))
            self._transitions[over] = _Transition(kept, kept[:, None] * kept, tuple(rotated), gained)
        return self._transitions[over]

    @cached_property
    def _turning(self) -> list[tuple[slice, float, Array, Array]]:
        """Return for each law with a period its states, the period, and the rotations by zero and a quarter period."""
        blocks = [block for block in self._blocks if block.law.period_s is not None]
        quarters = [np.kron([[0.0, -1.0], [1.0, 0.0]], np.eye(block.rank)) for block in blocks]
        periods = [float(block.law.period_s or 0.0) for block in blocks]
        return [
            (b.at, t, np.eye(2 * b.rank), np.asarray(q, np.float64))
            for b, t, q in zip(blocks, periods, quarters, strict=True)
        ]

    @cached_property
    def _transitions(self) -> dict[float, _Transition]:
        """Cache of state transitions by the length of the interval in seconds, since few different intervals occur."""
        return {}

    def spread(self, covariance: Array, then: float, now: float) -> Array:
        """Return the covariance of the states at a later time, with the process noise since then, (n, n).

        Dimensions: n states of the filter.

        Parameters
        ----------
        covariance : (n, n) ndarray
            Covariance at ``then``.
        then : float
            Time of the covariance, s.
        now : float
            Later time, s.
        """
        if now == then:
            return covariance
        out = self.moved_both(covariance, then, now)
        out += self._transition(now - then).gained
        for block in self._stepping_blocks:
            if block.law.event:
                kept = _kept(block.law, now - then) ** 2
                gained = _variance(block.law, now) - kept * _variance(block.law, then)
                self._add(out, block, max(gained, 0.0) * block.covariance)
            for law, steps in block.steps:
                if (gained := _step_variance(law, now) - _step_variance(law, then)) > 0.0:
                    self._add(out, block, gained * steps)
        return out

    @cached_property
    def _stepping_blocks(self) -> tuple[_Block, ...]:
        """Blocks of states with events, whose variance depends on the time and not on the interval alone."""
        return tuple(block for block in self._blocks if block.law.event or any(law.event for law, _ in block.steps))

    def outputs(self, mean: Array, covariance: Array, time: float) -> tuple[Array, Array, Array]:
        """Return the outputs (spot shifts and camera parameters) that states cause at a time.

        The result holds their values (D + P,), their derivatives with respect to the states (D + P, n), and the
        covariance of the second-order terms (D + P, D + P).

        Dimensions: D spot coordinates (row and column of every spot), P parameters, n states of the filter.

        Parameters
        ----------
        mean : (n,) ndarray
            Mean of the states at ``time``.
        covariance : (n, n) ndarray
            Covariance of the states.
        time : float
            Time, s.
        """
        values, rows, left = self.acting(self._rows(time), mean, covariance)
        return values, rows, left + self._gain_noise(mean, covariance, time)

    def _gain_noise(self, mean: Array, covariance: Array, time: float) -> Array | float:
        """Return the covariance (D + P, D + P) of the outputs due to uncertain gains of the terms; 0 without terms."""
        if self.terms is None:
            return 0.0
        at, spread = self.term_states, self._gains(time)[1]
        if not np.any(spread):
            return 0.0
        effect = self.basis[:, at]
        return np.asarray(effect @ (spread * (np.outer(mean[at], mean[at]) + covariance[at, at])) @ effect.T)

    def _gains(self, time: float) -> tuple[Array, Array]:
        assert self.terms is not None
        if time not in self._gains_at:
            self._gains_at.clear()
            self._gains_at[time] = self.terms.gains(time)
        return self._gains_at[time]

    @cached_property
    def _gains_at(self) -> dict[float, tuple[Array, Array]]:
        return {}

    @cached_property
    def term_states(self) -> slice:
        """Range, among all states, of those of the terms."""
        return next((block.at for block in self._blocks if block.kind == "term"), slice(0, 0))

    def acting(self, rows: Array, mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Return linear combinations of the states, in which estimated factors multiply the effect of temperatures.

        The results are values (R,), derivatives with respect to the states (R, n), and the covariance of the
        second-order terms.

        Dimensions: R combinations, n states of the filter.

        Parameters
        ----------
        rows : (R, n) ndarray
            Coefficients, for temperatures with the computed effect of heat.
        mean : (n,) ndarray
            Mean of the states.
        covariance : (n, n) ndarray
            Covariance of the states.
        """
        left = np.zeros((len(rows), len(rows)))
        if self.heat is None:
            return rows @ mean, rows, left
        rows = rows.copy()
        values = rows @ mean
        plain = rows.copy()
        for factor, at in self._heated:
            heat_rows = plain[:, at]
            values += heat_rows @ (mean[factor] * mean[at] + covariance[factor, at])
            rows[:, at] = (1.0 + mean[factor]) * heat_rows
            rows[:, factor] = heat_rows @ mean[at]
        return values, rows, self._second(plain, plain, covariance)

    def _second(self, rows: Array, others: Array, across: Array) -> Array:
        """Return the second-order part of the covariance of products of heat factors and temperatures, (R, R').

        Dimensions: R combinations, n states of the filter.

        Parameters
        ----------
        rows : (R, n) ndarray
            Coefficients, for temperatures with the computed effect of heat.
        others : (R', n) ndarray
            Coefficients on the states at another time or the same.
        across : (n, n) ndarray
            Covariance of the states with those at the other time.
        """
        out = np.zeros((len(rows), len(others)))
        for factor, at in self._heated if self.heat is not None else ():
            second = across[factor, factor] * across[np.ix_(at, at)] + np.outer(across[at, factor], across[factor, at])
            out += rows[:, at] @ second @ others[:, at].T
        return out

    def outputs_jointly(self, means: Array, covariance: Array, times: Array) -> tuple[Array, Array]:
        """Return the outputs at T times, (T, D + P), and their joint covariance, (T, D + P, T, D + P).

        Dimensions: D spot coordinates (row and column of every spot), P parameters, n states of the filter.

        Parameters
        ----------
        means : (T, n) ndarray
            Means of the states.
        covariance : (T, n, T, n) ndarray
            Joint covariance of the states.
        times : (T,) ndarray
            Times, s.
        """
        count, plain = len(times), [self._rows(float(time)).copy() for time in times]
        single = [self.acting(plain[k], means[k], covariance[k, :, k]) for k in range(count)]
        values = np.array([mean for mean, _, _ in single]).reshape(count, len(self.basis))
        out = np.empty((count, len(self.basis), count, len(self.basis)))
        for i, j in itertools.product(range(count), repeat=2):
            across = covariance[i, :, j]
            out[i, :, j] = single[i][1] @ across @ single[j][1].T + self._second(plain[i], plain[j], across)
            out[i, :, j] += self._gain_noise(means[i], across, float(times[i])) if i == j else 0.0
        return values, out

    def _rows(self, time: float) -> Array:
        if time not in self._rows_at:
            self._rows_at.clear()
            rows = self.basis.copy()
            for block in self._growing_blocks:
                rows[:, block.at] *= _gain(block.law, time)
            if self.terms is not None:
                rows[:, self.term_states] *= self._gains(time)[0]
            self._rows_at[time] = rows
        return self._rows_at[time]

    @cached_property
    def _growing_blocks(self) -> tuple[_Block, ...]:
        """Blocks of states of trends and relaxations, whose effect on the outputs depends on the time."""
        return tuple(block for block in self._blocks if (block.law.trend_s, block.law.relaxation_s) != (None, None))

    @cached_property
    def _rows_at(self) -> dict[float, Array]:
        return {}

    @cached_property
    def basis(self) -> Array:
        """Derivatives of the outputs with respect to the n states if all time laws have the amplitude 1, (D + P, n).

        Outputs are D spot coordinates (row and column of every spot), in px, then P camera parameters.
        """
        rows = np.zeros((self.width + self.prior.parameters.shape[0], self.size))
        for block in self._blocks:
            rows[:, block.at.start : block.at.start + block.rank] = block.outputs
        return rows

    @cached_property
    def _heat_states(self) -> dict[int, int]:
        """Mapping from the index of each motion that is a temperature with a sensor to the index of its state."""
        heat = [block for block in self._blocks if block.kind == "heat"]
        return {motion: block.at.start + k for block in heat for k, motion in enumerate(block.motions)}

    @cached_property
    def factors(self) -> slice:
        """Range, among all states, of the relative excess of the real effect of heat over the computed one."""
        return next((block.at for block in self._blocks if block.kind == "factor"), slice(0, 0))

    @cached_property
    def _heated(self) -> list[tuple[int, NDArray[np.int_]]]:
        """Pairs of the index of each factor's state and the indices of the states that it acts on."""
        assert self.heat is not None
        states = np.array([self._heat_states[k] for k in self.heat.motions.tolist()], int)
        return [(self.factors.start + f, states[self.heat.factors == f]) for f in range(len(self.heat.names))]

    def heat_outputs(self, mean: Array, time: float) -> Array:
        """Return the part of the outputs (spots, parameters) due to the heat of bodies with sensors, (D + P,).

        Dimensions: D spot coordinates (row and column of every spot), P parameters, n states of the filter.

        Parameters
        ----------
        mean : (n,) ndarray
            Mean of the states.
        time : float
            Time, s.
        """
        rows, out = self._rows(time), np.zeros(self.width + self.prior.parameters.shape[0])
        for factor, at in self._heated if self.heat is not None else ():
            out += (1.0 + mean[factor]) * (rows[:, at] @ mean[at])
        return out

    def sensor_rows(self, sensors: Sequence[int], time: float) -> Array:
        """Return the derivatives of sensor temperatures with respect to the states, (s, n) K.

        Dimensions: s sensors, n states of the filter.

        Parameters
        ----------
        sensors : sequence of int
            Indices of the sensors.
        time : float
            Time, s.
        """
        assert self.heat is not None
        out = np.zeros((len(sensors), self.size))
        for motion, column in zip(self.heat.motions.tolist(), self.heat.rows.T, strict=True):
            out[:, self._heat_states[motion]] = _gain(self.prior.laws[motion], time) * column[list(sensors)]
        return out

    def motion_gain(self, time: float, steps: Sequence[tuple[Sequence[int], float]] = ()) -> tuple[Array, Array]:
        """Return the matrix (M, n) from states to motions, and the covariance (M, M) of the motions for known states.

        Motions are in prior standard deviations.

        Dimensions: M motions, n states of the filter.

        Parameters
        ----------
        time : float
            Time, s.
        steps : sequence of (sequence of int, float)
            Motions that have stepped in addition to their laws, and the variance of the step relative to the prior.
        """
        count = len(self.prior.labels)
        rows, left = np.zeros((count, self.size)), np.zeros((count, count))
        stepped = np.zeros((count, count))
        for motions, variance in steps:
            at = np.ix_(list(motions), list(motions))
            stepped[at] += variance * self.prior.correlation[at]
        for block in self._blocks:
            if block.kind == "heat":
                for k, motion in enumerate(block.motions):
                    rows[motion, block.at.start + k] = _gain(block.law, time)
            if block.kind == "term":
                rows[list(block.motions), np.arange(block.at.start, block.at.stop)] = self._gains(time)[0]
            if block.kind not in ("level", "law"):
                continue
            idx = list(block.motions)
            if block.kind == "level":
                idx = sorted({*idx, *np.flatnonzero(np.diag(stepped)).tolist()})
                root = np.array(
                    [math.sqrt(_step_variance(law, time)) if _is_level(law) else 0.0 for law in map(self._law, idx)]
                )
                prior = root[:, None] * self.prior.correlation[np.ix_(idx, idx)] * root + stepped[np.ix_(idx, idx)]
            else:
                prior = _variance(block.law, time) * self.prior.correlation[np.ix_(idx, idx)]
            at_states = self._coordinates(block, idx)
            across = prior @ at_states.T
            gain = across @ np.linalg.pinv(at_states @ across, rcond=1e-10, hermitian=True)
            amplitude = _gain(block.law, time)
            rows[np.ix_(idx, range(block.at.start, block.at.start + block.rank))] += amplitude * gain
            left[np.ix_(idx, idx)] += amplitude**2 * (prior - gain @ across.T)
        return rows, left

    def _law(self, motion: int) -> TimeLaw:
        return self.prior.laws[motion]


def _is_level(law: TimeLaw) -> bool:
    """Return True for a time law that changes by steps alone."""
    plain = (law.drift_s, law.period_s, law.trend_s, law.relaxation_s) == (None,) * 4
    return plain and not law.white


def _spanned(columns: Array) -> tuple[Array, Array]:
    """Return orthonormal vectors that span the columns of a matrix, and their singular values."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    significant = sizes > _NOTHING * max(sizes[0], 1e-300)
    return np.asarray(left[:, significant]), np.asarray(sizes[significant])


def _halves(at: slice) -> tuple[slice, slice]:
    middle = (at.start + at.stop) // 2
    return slice(at.start, middle), slice(middle, at.stop)


def _kept(law: TimeLaw, over: float) -> float:
    """Return the factor, 0 to 1, by which a state of a time law decays over a time in seconds."""
    if law.white:
        return 0.0 if over > 0.0 else 1.0
    return 1.0 if law.drift_s is None else math.exp(-over / law.drift_s)


def _variance(law: TimeLaw, time: float) -> float:
    return float(law.step_probability(time)) if law.event else 1.0


def _step_variance(law: TimeLaw, time: float) -> float:
    """Return the variance of all steps of a time law up to a time in seconds, relative to that of one step."""
    if law.jump:
        return 0.0
    return float(law.step_probability(time)) if law.event else 1.0


def _gain(law: TimeLaw, time: float) -> float:
    """Return the amplitude of a trend or a relaxation at a time in seconds, in prior standard deviations."""
    if law.trend_s is None and law.relaxation_s is None:
        return 1.0
    return float(law.amplitude(np.array(time)))
