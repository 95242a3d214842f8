"""Jitter of an attitude from what two or more lines saw of the same places at different moments.

A place that is seen at several moments tells how the attitude differs between them. An observation is

    value = sum over moments j of weight_j . theta(t_j) + nuisance . x + noise,

whitened, so that its noise has one variance for all. For two bands that see the ground a time dt apart it is
theta(t + dt) - theta(t), whose response to an oscillation of f hertz is 2 |sin(pi f dt)|: it is blind at k/dt.

**Periodogram.** At every frequency sine and cosine about every axis are fitted together with the nuisance, and the sum
of squares that they take away is the power. No disparity is interpolated and no even spacing is assumed, so that there
is no interpolation whose period could be found. Frequencies at which an axis is seen with less than a share of its best
response are blind: they are named and not looked at.

**False alarms.** With noise alone the power at a frequency is a chi-square of s = 2 x axes degrees of freedom, the
squared length of the noise's projection on a plane that turns with the frequency. The length R exceeds a level r
somewhere with at most the probability that it does so at the begin plus the mean number of upcrossings (Rice; Davies
1987). Of R' only the part L of the plane's slope by the frequency counts that leaves the plane:

    P(max R > r) <= segments x P(R > r) + p_R(r) / sqrt(2 pi) x integral of sqrt(tr(L' L) / s) over the frequency.

That is a bound for the very times, weights and gaps of the observations, and close for small rates. A variance of the
noise that has to be estimated from the n degrees of freedom of the rest makes the power a beta distribution at each
frequency; it is brought to the chi-square of the same tail.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError

OVERSAMPLING = 6
"""Frequencies in the inverse of the time that is observed; the highest of them has 98% of a line's power."""
BLIND = 0.1
"""Share of an axis's best response below which a frequency is blind."""
_AT_ONCE = 2_000_000
_RANK = 1e-6
"""Share of the best known combination below which one is none: lines that move alike move the ground."""
_NEVER = 1e-280
"""Probability below which none is told apart."""
_LEAST_ROWS = 30
_REWEIGHTED = 3
_LEAST_FACTOR = 0.01
"""Variance over the stated one below which none is estimated: a tenth of the stated sigma."""


class JitterError(MeasurementError, ValueError):
    """Observations that say nothing of jitter."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Whitened observations of an attitude.

    Attributes:
        value: (R,) of noise with one variance, 1 if the covariances that they were whitened by are right.
        group: (R,) whole numbers from 0 on that do not fall: which observations come from the same place.
        time: (G, J) moments that those of a group compare, seconds.
        weight: (R, J, A) by radian about each axis at each moment; zero where there are fewer moments.
        nuisance: (R, P) columns of what else is unknown, of any rank.
        mix: (R, K, W) by which the noise of an observation is made of the W unit errors of each of K kinds that its
            group has. The variance of each kind, such as the coordinates of one line or the heights that are known
            beforehand, may be wrong by a factor of its own.
    """

    value: Array
    group: NDArray[np.intp]
    time: Array
    weight: Array
    nuisance: Array
    mix: Array

    @classmethod
    def of(
        cls,
        value: ArrayLike,
        group: ArrayLike,
        time: ArrayLike,
        weight: ArrayLike,
        nuisance: ArrayLike,
        kind: ArrayLike | None = None,
        mix: ArrayLike | None = None,
    ) -> Observations:
        """Checked.

        Args:
            value: (R,).
            group: (R,).
            time: (G, J), seconds.
            weight: (R, J, A), by radian.
            nuisance: (R, P).
            kind: (R,) whole numbers from 0 on, of observations with independent errors; None for all alike.
            mix: (R, K, W) instead of kind.

        Raises:
            JitterError: shapes that do not match, values that are not finite, too few observations.
        """
        v, t, w, n = (np.array(a, np.float64) for a in (value, time, weight, nuisance))
        g = np.array(group, np.intp)
        sort = np.zeros(len(v), np.intp) if kind is None else np.array(kind, np.intp)
        shapes = v.shape, g.shape, t.shape, w.shape, n.shape
        if v.ndim != 1 or w.ndim != 3 or t.ndim != 2 or not (len(v) == len(g) == len(w) == len(n) == len(sort)):
            raise JitterError(f"observations of shapes {shapes} do not match")
        if w.shape[1] != t.shape[1] or np.any(np.diff(g) < 0) or np.any(g < 0) or np.any(g >= len(t)):
            raise JitterError(f"observations of shapes {shapes} do not match, or their groups are mixed")
        made = _unmixed(g, len(t), sort) if mix is None else np.array(mix, np.float64)
        if made.ndim != 3 or len(made) != len(v):
            raise JitterError(f"{len(v)} observations do not match mixtures of shape {made.shape}")
        if not all(np.all(np.isfinite(a)) for a in (v, t, w, n, made)):
            raise JitterError("an observation is not finite")
        found = cls(v, g, t, w, n, made)
        if found.freedom < _LEAST_ROWS:
            unknown = len(v) - found.freedom
            raise JitterError(f"{len(v)} observations with {unknown} unknowns are too few for a spectrum")
        return found

    @property
    def axes(self) -> int:
        """How many."""
        return self.weight.shape[2]

    @cached_property
    def ends(self) -> tuple[float, float]:
        """First and last moment, seconds."""
        moments = self.time[self.group][np.any(self.weight != 0.0, axis=2)]
        return (float(moments.min()), float(moments.max())) if len(moments) else (0.0, 0.0)

    @property
    def span(self) -> float:
        """From the first to the last moment, seconds."""
        return self.ends[1] - self.ends[0]

    @property
    def middle(self) -> float:
        """Moment from which phases count within this module, seconds."""
        return 0.5 * (self.ends[0] + self.ends[1])

    @cached_property
    def known(self) -> Array:
        """(R, K) orthonormal columns of the nuisance."""
        if not self.nuisance.shape[1]:
            return np.zeros((len(self.value), 0))
        size = np.linalg.norm(self.nuisance, axis=0)
        u, s, _ = np.linalg.svd(self.nuisance[:, size > 0.0] / size[size > 0.0], full_matrices=False)
        return np.asarray(u[:, s > _RANK * s[:1]])

    @property
    def freedom(self) -> int:
        """Degrees of freedom beside the nuisance."""
        return len(self.value) - self.known.shape[1]

    def rest(self, columns: Array) -> Array:
        """What of columns (R, ...) the nuisance does not explain."""
        return np.asarray(columns - np.tensordot(self.known, np.tensordot(self.known.T, columns, 1), 1))

    def waves(self, frequency: ArrayLike) -> Array:
        """Sines and cosines about all axes as they appear in the observations, (R, F, 2 A), by radian of amplitude."""
        f = np.atleast_1d(np.asarray(frequency, np.float64))
        angle = 2.0 * np.pi * (self.time[:, :, None] - self.middle) * f
        both = np.stack([np.sin(angle), np.cos(angle)], axis=-1)[self.group]
        return np.einsum("rjfk,rja->rfka", both, self.weight).reshape(len(self.value), len(f), 2 * self.axes)

    def taken(self, keep: ArrayLike) -> Observations:
        """Some of them, by mask."""
        where = np.asarray(keep)
        some, group = np.unique(self.group[where], return_inverse=True)
        value, weight, nuisance = self.value[where], self.weight[where], self.nuisance[where]
        return Observations(value, group, self.time[some], weight, nuisance, self.mix[where])

    def factors(self) -> Array:
        """Return the variance of each kind of errors over the stated one, (K,), by what the nuisance leaves.

        Combinations of the kinds that have fewer than 30 degrees of freedom, such as the difference of two lines that
        are only seen against each other, keep their stated ratio.

        Notes:
            Minimum norm quadratic unbiased estimation (Rao, J. Multivariate Analysis 1, 1971), repeated with the
            weights that it gives.
        """
        factors = np.ones(self.mix.shape[1])
        for _ in range(_REWEIGHTED):
            factors = factors * self.evened(factors)._factors()
        return factors

    def _factors(self) -> Array:
        """Return `factors` for the present weights."""
        left, known, mix = (self._of_groups(v) for v in (self.rest(self.value)[:, None], self.known, self.mix))
        by_kind = [mix[:, :, k] for k in range(mix.shape[2])]
        spread = [m @ m.swapaxes(1, 2) for m in by_kind]
        seen = [one @ known for one in spread]
        taken = [np.tensordot(known, one, ((0, 1), (0, 1))) for one in seen]
        square = np.array([np.sum((m.swapaxes(1, 2) @ left) ** 2) for m in by_kind])
        normal = np.array(
            [
                [
                    np.sum(spread[k] * spread[m]) - 2.0 * np.sum(seen[k] * seen[m]) + np.sum(taken[k] * taken[m].T)
                    for m in range(len(spread))
                ]
                for k in range(len(spread))
            ]
        )
        size, way = np.linalg.eigh(normal)
        inverse = np.where(size >= _LEAST_ROWS, 1.0 / np.maximum(size, _LEAST_ROWS), 0.0)
        return np.asarray(np.maximum(1.0 + (way * inverse) @ way.T @ (square - normal.sum(axis=1)), _LEAST_FACTOR))

    def evened(self, factors: ArrayLike) -> Observations:
        """Return the observations whitened anew, with the variance of each kind of errors multiplied by its factor
        (K,).
        """
        scaled = self.mix * np.sqrt(np.maximum(np.asarray(factors, np.float64), _NEVER))[:, None]
        mix = self._of_groups(scaled.reshape(len(scaled), -1))
        spread = mix @ mix.swapaxes(1, 2)
        # rows that a group lacks
        spread += np.where(np.any(mix != 0.0, axis=2), 0.0, 1.0)[:, :, None] * np.eye(mix.shape[1])
        root = np.linalg.inv(np.linalg.cholesky(spread))
        row = self._row

        def white(columns: Array) -> Array:
            flat = self._of_groups(columns.reshape(len(columns), -1))
            return np.asarray((root @ flat)[self.group, row].reshape(columns.shape))

        value, weight, nuisance = (white(v) for v in (self.value, self.weight, self.nuisance))
        return replace(self, value=value, weight=weight, nuisance=nuisance, mix=white(scaled))

    @cached_property
    def _row(self) -> NDArray[np.intp]:
        """Number (R,) of each observation within its group."""
        return _within(self.group, len(self.time))

    def _of_groups(self, columns: Array) -> Array:
        """Columns (R, ...) by group and number within it, (G, M, ...); zero where a group has fewer."""
        out = np.zeros((len(self.time), int(self._row.max(initial=0)) + 1, *columns.shape[1:]))
        out[self.group, self._row] = columns
        return out

    def beside(self, columns: Array) -> Observations:
        """The same with further columns (R, P) of what is unknown."""
        return replace(self, nuisance=np.concatenate([self.nuisance, columns], axis=1))


def _within(group: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Number of each observation within its group, of numbers (R,) that do not fall."""
    return np.asarray(np.arange(len(group)) - np.searchsorted(group, np.arange(count))[group])


def _unmixed(group: NDArray[np.intp], count: int, kind: NDArray[np.intp]) -> Array:
    """`Observations.mix` of observations with independent errors, of kinds (R,)."""
    row = _within(group, count)
    out = np.zeros((len(kind), int(kind.max(initial=0)) + 1, int(row.max(initial=0)) + 1))
    out[np.arange(len(kind)), kind, row] = 1.0
    return out


def _powers(time: Array, degree: int) -> Array:
    middle, half = 0.5 * (time.min() + time.max()), max(0.5 * float(np.ptp(time)), 1e-9)
    return np.asarray(np.polynomial.legendre.legvander((time - middle) / half, degree))


@dataclass(frozen=True, eq=False)
class Periodogram:
    """Power over frequency, and what it is worth.

    Attributes:
        frequency: (F,) hertz, evenly spaced.
        power: (F,) sum of squares that an oscillation takes away.
        amplitude: (F, A) that is fitted about each axis, radians.
        sigma: (F, A) of an amplitude's components, radians, for noise of variance 1.
        response: (F, A) to an oscillation, as against one sight of it; 2 for two sights in opposite phase.
        blind: (F,) whether it is looked at no further.
        turning: integral over the frequencies that are looked at of the plane's turning; see the module.
        segments: of frequencies that are looked at.
        total: sum of squares without any oscillation.
        freedom: its degrees.
    """

    frequency: Array
    power: Array
    amplitude: Array
    sigma: Array
    response: Array
    blind: NDArray[np.bool_]
    turning: float
    segments: int
    total: float
    freedom: int

    @property
    def order(self) -> int:
        """Degrees of freedom of an oscillation's amplitudes."""
        return 2 * self.amplitude.shape[1]

    def chance(self, power: ArrayLike) -> Array:
        """Largest probability that noise alone has such a power at any of the frequencies; variance of the noise
        unknown.
        """
        share = np.clip(np.asarray(power, np.float64) / self.total, 0.0, 1.0)
        single = np.maximum(stats.beta.sf(share, 0.5 * self.order, 0.5 * (self.freedom - self.order)), _NEVER)
        r = stats.chi.isf(single, self.order)
        rate = stats.chi.pdf(r, self.order) / np.sqrt(2.0 * np.pi)
        return np.asarray(np.minimum(self.segments * single + rate * self.turning, 1.0))

    def threshold(self, false_alarm: float) -> float:
        """Power that noise alone exceeds anywhere with at most this probability."""
        level = optimize.brentq(lambda x: float(np.log(self.chance(x * self.total)) - np.log(false_alarm)), 1e-9, 0.999)
        return float(level * self.total)

    @property
    def best(self) -> int:
        """Index of the highest power that is looked at."""
        return int(np.argmax(np.where(self.blind, -1.0, self.power)))

    def intervals(self) -> list[tuple[float, float]]:
        """First and last frequency of every run of blind ones."""
        edge = np.flatnonzero(np.diff(np.concatenate([[0], self.blind.astype(int), [0]])))
        return [(float(self.frequency[a]), float(self.frequency[b - 1])) for a, b in edge.reshape(-1, 2)]


def periodogram(given: Observations, lowest: float, highest: float) -> Periodogram:
    """Power between two frequencies, hertz.

    Raises:
        JitterError: no frequency between them is seen.
    """
    if not given.span > 0.0:
        raise JitterError("all observations are of one moment")
    step = 1.0 / (OVERSAMPLING * given.span)
    f = np.arange(np.ceil(lowest / step), np.floor(highest / step) + 1.0) * step
    if len(f) < 2:
        raise JitterError(f"no frequencies between {lowest:g} and {highest:g} Hz that {given.span:.3g} s tell apart")
    value, axes = given.rest(given.value), given.axes
    products = _Products.of(given, value)
    power, variance, square, turning = np.zeros(len(f)), *np.zeros((2, len(f), axes)), np.zeros(len(f))
    for begin in range(0, len(f), products.at_once):
        part = slice(begin, begin + products.at_once)
        normal, mixed, slopes, right = products.at(f[part])
        size = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 0.0))
        size = np.where(size > 0.0, size, 1.0)
        w, v = np.linalg.eigh(normal / size[:, :, None] / size[:, None, :])
        good = np.all(w > _RANK, axis=1)
        w = np.where(w > _RANK, w, np.inf)
        inverse = (v / w[:, None, :]) @ v.swapaxes(1, 2) / size[:, :, None] / size[:, None, :]
        solved = (inverse @ right[..., None])[..., 0]
        power[part] = np.sum(solved * right, axis=1)
        square[part] = np.sum(solved.reshape(-1, 2, axes) ** 2, axis=1)
        own = 0.5 * np.sum(np.diagonal(inverse, axis1=1, axis2=2).reshape(-1, 2, axes), axis=1)
        variance[part] = np.where(good[:, None], own, np.inf)
        # what of the planes' slope leaves them
        leaving = slopes - mixed.swapaxes(1, 2) @ inverse @ mixed
        rate = np.trace(inverse @ leaving, axis1=1, axis2=2)
        turning[part] = np.sqrt(np.maximum(rate, 0.0) / (2 * axes))
    sights = np.maximum(np.sum(np.any(given.weight != 0.0, axis=2), axis=1), 1)
    once = np.sqrt(0.5 * np.sum(np.sum(given.weight**2, axis=1) / sights[:, None], axis=0))
    sigma = np.sqrt(variance)
    response = 1.0 / (sigma * np.where(once > 0.0, once, np.inf))
    most = np.max(response, axis=0)
    if not np.all(most > 0.0):
        raise JitterError("an axis of the attitude moves nothing that was observed")
    blind = np.any(response < BLIND * most, axis=1)
    if np.all(blind):
        raise JitterError(f"all frequencies between {lowest:g} and {highest:g} Hz are blind")
    joined = ~blind[1:] & ~blind[:-1]
    turned = float(np.sum((0.5 * step * (turning[1:] + turning[:-1]))[joined]))
    segments = int(np.sum(~blind) - np.sum(joined))
    total = float(value @ value)
    return Periodogram(f, power, np.sqrt(square), sigma, response, blind, turned, segments, total, given.freedom)


@dataclass(frozen=True, eq=False)
class _Products:
    """Sums over the observations from which those of all waves follow, whatever the frequency.

    Attributes:
        time: (G, J) moments, from the middle.
        columns: (G J, A C) of the observations' weights with the value and the known columns.
        pairs: (G J J, A A) of the weights with one another.
        axes: A.
    """

    time: Array
    columns: Array
    pairs: Array
    axes: int

    @classmethod
    def of(cls, given: Observations, value: Array) -> _Products:
        first = np.searchsorted(given.group, np.arange(len(given.time)))
        columns = np.concatenate([value[:, None], given.known], axis=1)
        # every group has an observation, so that sums between begins are sums over groups
        by_column = np.add.reduceat(given.weight[..., None] * columns[:, None, None, :], first, axis=0)
        by_pair = np.add.reduceat(given.weight[:, :, None, :, None] * given.weight[:, None, :, None, :], first, axis=0)
        groups, moments, axes = len(given.time), given.time.shape[1], given.axes
        return cls(
            given.time - given.middle,
            by_column.reshape(groups * moments, -1),
            by_pair.reshape(groups * moments**2, axes**2),
            axes,
        )

    @property
    def at_once(self) -> int:
        """Frequencies for which the products of waves are held at a time."""
        return max(_AT_ONCE // len(self.pairs), 1)

    def at(self, frequency: Array) -> tuple[Array, Array, Array, Array]:
        """At frequencies (F,), beside the known columns: products of all waves (F, 2 A, 2 A), of waves with their
        slopes by the frequency, of slopes, and of waves with the value, (F, 2 A).
        """
        count, a = len(frequency), self.axes
        t = 2.0 * np.pi * self.time
        angle = frequency[:, None, None] * t
        sine, cosine = np.sin(angle), np.cos(angle)
        # waves and slopes: sine, cosine, and t cosine, - t sine
        single = np.stack([sine, cosine, t * cosine, -t * sine]).reshape(4, count, -1)
        with_columns = (single @ self.columns).reshape(4, count, a, -1)
        products = np.empty((4, 4, count, a, a))
        waves = (sine, cosine)
        plain: dict[tuple[int, int, str], Array] = {}
        weights = {
            "": self.pairs,
            "l": self.pairs * np.broadcast_to(t[:, None, :], (*t.shape, t.shape[1])).reshape(-1, 1),
            "jl": self.pairs * (t[:, :, None] * t[:, None, :]).reshape(-1, 1),
        }
        for j in (0, 1):
            for k in (0, 1):
                outer = (waves[j][..., :, None] * waves[k][..., None, :]).reshape(count, -1)
                for name, weight in weights.items():
                    plain[j, k, name] = (outer @ weight).reshape(count, a, a)
        for j in (0, 1):
            for k in (0, 1):
                sign = (1.0, -1.0)
                products[j, k] = plain[j, k, ""]
                products[j, 2 + k] = sign[k] * plain[j, 1 - k, "l"]
                products[2 + j, 2 + k] = sign[j] * sign[k] * plain[1 - j, 1 - k, "jl"]
        known = with_columns[..., 1:]
        found = []
        for rows, others in ((0, 0), (0, 2), (2, 2)):
            block = np.empty((count, 2, a, 2, a))
            for j in (0, 1):
                for k in (0, 1):
                    taken = known[rows + j] @ known[others + k].swapaxes(1, 2)
                    block[:, j, :, k, :] = products[rows + j, others + k] - taken
            found.append(block.reshape(count, 2 * a, 2 * a))
        right = with_columns[:2, ..., 0].swapaxes(0, 1).reshape(count, 2 * a)
        return found[0], found[1], found[2], right
