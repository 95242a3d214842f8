"""Terms of a state space: known functions of time whose amounts and time constants the filter learns from readings.

A motion changes by the sum of its terms a f(t): constants, slopes from a date, decays exp(-(t - since) / T), commanded
moves, and measured inputs, such as temperatures. An amount a is normal with mean and sigma of its prior, and a state of
`state_space` whose effect has the known gain f(t). An uncertain time constant T exp(x), x normal with mean zero, has a
second state, x minus the x of the latest point of linearisation, whose gain is the derivative a df/dx there: since a f
is linear in a, this is a Gauss-Newton step. The covariance is that of the linearised model at this point.

Gains can be uncertain themselves: the day of a move, the noise of an input's samples, an input without samples. With
the covariance V of the gains, and the means a and the covariance P of the amounts, the variance a' V a + tr(V P) is
added to a reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from analysis.arrays import Array

_STEP = 1e-4
"""Step of the central difference with respect to the logarithm of a time constant."""
_FORGOTTEN = 30.0
"""Number of time constants after which a sample has no effect on a lagged input."""
_UNKNOWN = 10.0
"""Standard deviation of an input before its samples at three readings show its scatter, in the input's unit."""
_LONGEST = 0.7
"""Largest change of the logarithm of a time constant in one linearisation, so that a poor start does not diverge."""
_CONVERGED = 0.25
"""Change of an amount or time constant, in its sigma, below which no new linearisation is needed."""


@dataclass(frozen=True, eq=False)
class Term:
    """Constant change of a motion; base class of the other terms.

    Attributes
    ----------
    name : str
        Name of the term.
    motion : int
        Index of the motion among the disturbances.
    mean, sigma : float
        Prior of the amount, in prior standard deviations of the motion.
    """

    name: str
    motion: int
    mean: float
    sigma: float

    def gain(self, time: float, x: float) -> tuple[float, float]:
        """Return the gain f at a time in seconds, with time constant T exp(x), and the gain's variance."""
        return 1.0, 0.0

    @property
    def log_sigma(self) -> float | None:
        """Standard deviation of the logarithm of the time constant; None if there is none, or if it is known."""
        return None


@dataclass(frozen=True, eq=False)
class Slope(Term):
    """Change in proportion to the time after a date, by one amount in `per` seconds; a later one breaks a slope.

    Attributes
    ----------
    since, per : float
        Date, and time in which the amount accumulates, s.
    """

    since: float
    per: float

    def gain(self, time: float, x: float) -> tuple[float, float]:
        """Return the gain f at a time in seconds, and its variance."""
        return max(time - self.since, 0.0) / self.per, 0.0


@dataclass(frozen=True, eq=False)
class Decay(Term):
    """Exponential decay from one amount at a date toward zero; before the date it is larger.

    Attributes
    ----------
    since, constant : float
        Date and time constant, s.
    spread : float or None
        Relative standard deviation of the time constant; None if it is known.
    """

    since: float
    constant: float
    spread: float | None

    def gain(self, time: float, x: float) -> tuple[float, float]:
        """Return the gain f at a time in seconds, with time constant T exp(x), and the gain's variance."""
        return float(np.exp((self.since - time) / (self.constant * np.exp(x)))), 0.0

    @property
    def log_sigma(self) -> float | None:
        """Standard deviation of the logarithm of the time constant; None if it is known."""
        return self.spread


@dataclass(frozen=True, eq=False)
class Move(Term):
    """Commanded move: a step at a date that may be uncertain.

    Attributes
    ----------
    time, time_sigma : float
        Time of the move and its standard deviation, s.
    """

    time: float
    time_sigma: float = 0.0

    def gain(self, time: float, x: float) -> tuple[float, float]:
        """Return the probability p that the move has occurred by a time in seconds, and the variance p (1 - p)."""
        late = time - self.time
        p = float(ndtr(late / self.time_sigma)) if self.time_sigma > 0.0 else float(late >= 0.0)
        return p, p * (1.0 - p)


@dataclass(frozen=True, eq=False)
class Input(Term):
    """Measured input: one amount per unit of its newest sample, its mean over a window, or its first-order lag.

    Attributes
    ----------
    times, values : (K,) ndarray
        Times of the samples, s, ascending, and their values relative to the reference.
    noise : float
        Standard deviation of a sample.
    window : float or None
        Length of the window that ends at the reading, s; None for the newest sample alone.
    relative : bool
        True for the newest sample minus the mean over the window.
    lag : float or None
        Time constant of the lag, s; None if there is none. Before its first sample an input is constant.
    spread : float or None
        Relative standard deviation of that time constant; None if it is known.
    gap : float
        Age of the newest sample above which the input counts as not measured, s.
    """

    times: Array
    values: Array
    noise: float
    window: float | None
    relative: bool
    lag: float | None
    spread: float | None
    gap: float

    @property
    def log_sigma(self) -> float | None:
        """Standard deviation of the logarithm of the lag's time constant; None if there is none or it is known."""
        return self.spread

    def gain(self, time: float, x: float) -> tuple[float, float]:
        """Return the input that acts at a time in seconds, with lag T exp(x), and its variance; NaN in a gap."""
        end = int(np.searchsorted(self.times, time, side="right"))
        if not end or time - self.times[end - 1] > self.gap:
            return float("nan"), float("nan")
        length = self.window if self.lag is None else _FORGOTTEN * self.lag * np.exp(x)
        begin = end - 1 if length is None else int(np.searchsorted(self.times, time - length, side="right"))
        begin = min(begin if self.lag is None else max(begin - 1, 0), end - 1)
        weights = np.full(end - begin, 1.0 / (end - begin))
        if self.lag is not None:
            weights = _lag_weights(self.times[begin:end], time, self.lag * float(np.exp(x)))
        elif self.relative:
            weights = -weights
            weights[-1] += 1.0
        return float(weights @ self.values[begin:end]), self.noise**2 * float(weights @ weights)


def _lag_weights(times: Array, now: float, constant: float) -> Array:
    """Return the weights (K,) of an input's samples in its first-order lag, for an input that is linear between them.

    The weights sum to one: the input is constant before the first sample and after the last.
    """
    kept = np.exp((times - now) / constant)
    weights = np.zeros(len(times))
    weights[0] += kept[0]
    weights[-1] += 1.0 - kept[-1]
    mean = np.diff(kept) * constant / np.diff(times)
    weights[1:] += kept[1:] - mean
    weights[:-1] += mean - kept[:-1]
    return weights


@dataclass(frozen=True, eq=False)
class Terms:
    """All terms of a state space, with the point at which uncertain time constants are linearised.

    Dimensions: R states, which are the T amounts and then the logarithms x of the uncertain time constants.

    Attributes
    ----------
    terms : tuple of Term
        The T terms.
    readings : (N,) ndarray
        Times of all readings, s, ascending, at which the scatter of the inputs is taken. A gain depends on earlier ones
        alone.
    point : (R,) ndarray or None
        Amounts and logarithms at which the time constants are linearised; None for the means of the prior.
    """

    terms: tuple[Term, ...]
    readings: Array
    point: Array | None = None

    @cached_property
    def curved(self) -> tuple[int, ...]:
        """Indices of the terms with uncertain time constants."""
        return tuple(k for k, term in enumerate(self.terms) if term.log_sigma is not None)

    @cached_property
    def members(self) -> tuple[int, ...]:
        """Index of the term of each of the R states."""
        return (*range(len(self.terms)), *self.curved)

    @cached_property
    def mean(self) -> Array:
        """Mean of the prior of the states, (R,)."""
        return np.concatenate([[term.mean for term in self.terms], -self.logs])

    @cached_property
    def logs(self) -> Array:
        """Logarithms x of the uncertain time constants at the point of linearisation, in the order of `curved`."""
        return np.zeros(len(self.curved)) if self.point is None else self.point[len(self.terms) :]

    @cached_property
    def sigma(self) -> Array:
        """Standard deviation of the prior of the states, (R,)."""
        return np.array([term.sigma for term in self.terms] + [self.terms[k].log_sigma or 0.0 for k in self.curved])

    @cached_property
    def motions(self) -> tuple[int, ...]:
        """Index of the motion that each of the R states changes."""
        return tuple(self.terms[k].motion for k in self.members)

    def relinearised(self, mean: Array, covariance: Array) -> Terms | None:
        """Return the terms linearised at an estimate of their states; None if the present point is near enough.

        Parameters
        ----------
        mean : (R,) ndarray
            Estimate of the states.
        covariance : (R, R) ndarray
            Its covariance.
        """
        count = len(self.terms)
        pairs = [*self.curved, *range(count, len(self.members))]
        base = np.append(self.mean[:count] if self.point is None else self.point[:count], np.zeros(len(self.curved)))
        change = (mean - base)[pairs]
        if np.all(np.abs(change) <= _CONVERGED * np.sqrt(np.maximum(np.diag(covariance)[pairs], 0.0))):
            return None
        point = np.append(mean[:count], self.logs + np.clip(mean[count:], -_LONGEST, _LONGEST))
        return replace(self, point=point)

    def _columns(self, time: float, members: Sequence[int]) -> Iterator[tuple[float, float]]:
        """Yield the gain of each of some states at a time, and its variance by noise."""
        logs = dict(zip(self.curved, self.logs.tolist(), strict=True))
        for state in members:
            k = self.members[state]
            x = logs.get(k, 0.0)
            gain, variance = self.terms[k].gain(time, x)
            if state >= len(self.terms):
                ahead, behind = (self.terms[k].gain(time, x + step)[0] for step in (_STEP, -_STEP))
                amount = self.terms[k].mean if self.point is None else float(self.point[k])
                gain, variance = amount * (ahead - behind) / (2.0 * _STEP), 0.0
            yield gain, variance

    @cached_property
    def _inputs(self) -> list[int]:
        """States whose gains are measured inputs."""
        return [state for state, k in enumerate(self.members) if isinstance(self.terms[k], Input)]

    @cached_property
    def _scatter(self) -> tuple[Array, Array, Array]:
        """Times (C,) of readings at which all inputs are measured, and sums of gains (C, r) and products (C, r, r)."""
        gains = np.array([[gain for gain, _ in self._columns(float(t), self._inputs)] for t in self.readings])
        gains = gains.reshape(len(self.readings), len(self._inputs))
        whole = np.all(np.isfinite(gains), axis=1)
        squares = gains[whole, :, None] * gains[whole, None, :]
        return self.readings[whole], np.cumsum(gains[whole], axis=0), np.cumsum(squares, axis=0)

    def missing(self, name: str) -> int:
        """Return the number of readings at which the input of a term was not measured."""
        term = next(term for term in self.terms if term.name == name)
        return sum(not np.isfinite(term.gain(float(time), 0.0)[0]) for time in self.readings)

    def gains(self, time: float) -> tuple[Array, Array]:
        """Return the gains (R,) of the states at a time in seconds, and the covariance (R, R) of their errors.

        An input that is not measured has the mean and the covariance of the readings before.
        """
        columns = np.array(list(self._columns(time, range(len(self.members))))).reshape(-1, 2)
        gains, spread = columns[:, 0], np.diag(columns[:, 1])
        absent = np.flatnonzero(~np.isfinite(gains))
        if len(absent):
            spread[absent, absent] = _UNKNOWN**2
            gains[absent] = 0.0
            times, sums, squares = self._scatter
            count = int(np.searchsorted(times, time, side="right"))
            if count > 2:
                rows = [self._inputs.index(state) for state in absent.tolist()]
                mean = sums[count - 1, rows] / count
                square = squares[count - 1][np.ix_(rows, rows)]
                gains[absent] = mean
                spread[np.ix_(absent, absent)] = (square - count * np.outer(mean, mean)) / (count - 1)
        return gains, spread
