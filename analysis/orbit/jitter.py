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

Oscillations of an attitude that are found in observations of it, and its course over time with a covariance.

Lines are found one after the other, the strongest first: the highest power of the periodogram is a line if its chance
is below the stated rate; then all lines found so far are fitted together, frequencies included, and the search goes on
beside them. Where moments are nearly even, a faster oscillation shows power in the search, too: each frequency up to a
stated one that explains what was found as well is an alias of it, and a line is that of them which is right but for
the false-alarm rate, or it is any of those that are named. Observations that no oscillation explains (wrong matches)
are left out, and taken up again if a line that is found later explains them.

Frequencies far beyond a search that could be what was found in it: the aliases of an uneven sampling.

Points that lie on rows, such as a grid's, are seen at moments that are nearly whole numbers of an interval, and an
oscillation faster than half of its rate looks there like a slow one. The power of all frequencies, up to the rate of
the image lines, follows at once from Fourier transforms of the observations on a fine grid of moments: with the
observations' weights w and values v,

    z(f) = sum v w exp(-2 pi i f t),   N(f) = sum w w' exp(-2 pi i f (t - t')),   power = 2 z* N^-1 z,

which is the power of the periodogram but for the nuisance and for what sine and cosine have in common. Both are little
at frequencies that are high against the inverse of the time observed; what is selected is fitted exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, optimize, stats
from scipy.interpolate import BSpline

from analysis.arrays import Array, MeasurementError
from analysis.statistics import robust_sigma

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

    Attributes
    ----------
    value : Array
        (R,) of noise with one variance, 1 if the covariances that they were whitened by are right.
    group : NDArray[np.intp]
        (R,) whole numbers from 0 on that do not fall: which observations come from the same place.
    time : Array
        (G, J) moments that those of a group compare, seconds.
    weight : Array
        (R, J, A) by radian about each axis at each moment; zero where there are fewer moments.
    nuisance : Array
        (R, P) columns of what else is unknown, of any rank.
    mix : Array
        (R, K, W) by which the noise of an observation is made of the W unit errors of each of K kinds that its group
        has. The variance of each kind, such as the coordinates of one line or the heights that are known beforehand,
        may be wrong by a factor of its own.
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

        Parameters
        ----------
        value : ArrayLike
            (R,).
        group : ArrayLike
            (R,).
        time : ArrayLike
            (G, J), seconds.
        weight : ArrayLike
            (R, J, A), by radian.
        nuisance : ArrayLike
            (R, P).
        kind : ArrayLike | None
            (R,) whole numbers from 0 on, of observations with independent errors; None for all alike.
        mix : ArrayLike | None
            (R, K, W) instead of kind.

        Raises
        ------
        JitterError
            Shapes that do not match, values that are not finite, too few observations.
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

        Notes
        -----
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

    Attributes
    ----------
    frequency : Array
        (F,) hertz, evenly spaced.
    power : Array
        (F,) sum of squares that an oscillation takes away.
    amplitude : Array
        (F, A) that is fitted about each axis, radians.
    sigma : Array
        (F, A) of an amplitude's components, radians, for noise of variance 1.
    response : Array
        (F, A) to an oscillation, as against one sight of it; 2 for two sights in opposite phase.
    blind : NDArray[np.bool_]
        (F,) whether it is looked at no further.
    turning : float
        Integral over the frequencies that are looked at of the plane's turning; see the module.
    segments : int
        Of frequencies that are looked at.
    total : float
        Sum of squares without any oscillation.
    freedom : int
        Its degrees.
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

    Raises
    ------
    JitterError
        No frequency between them is seen.
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

    Attributes
    ----------
    time : Array
        (G, J) moments, from the middle.
    columns : Array
        (G J, A C) of the observations' weights with the value and the known columns.
    pairs : Array
        (G J J, A A) of the weights with one another.
    axes : int
        A.
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


_FINE, _PADDED = 16, 4
"""Moments in a period of the highest frequency, and transformed frequencies in a resolution element: an oscillation
loses 3% of its power at most by either.
"""
_WIDEST = 2**18
"""Resolution elements that are transformed at most."""
_REGULAR = 1e-4
"""Share of the best known combination of axes that is added to all: what moves alike stays bounded."""


def farthest(given: Observations, highest: float) -> float:
    """Return the frequency up to which aliases can be looked for, hertz, at most ``highest``."""
    return min(highest, _WIDEST / given.span)


def peaks(given: Observations, lowest: float, highest: float) -> tuple[Array, Array]:
    """Return frequencies (K,), hertz, and approximate powers (K,) of all local maxima of the power, the highest first.

    Parameters
    ----------
    given : Observations
        observations.
    lowest : float
        Frequency, hertz.
    highest : float
        Likewise; lowered to `farthest`.
    """
    highest = farthest(given, highest)
    step = 1.0 / (_FINE * highest)
    count = int(np.ceil(given.span / step)) + 2
    size = fft.next_fast_len(_PADDED * count, real=True)
    first = np.searchsorted(given.group, np.arange(len(given.time)))
    value = given.rest(given.value)[:, None, None]
    seen = np.add.reduceat(given.weight * value, first, axis=0)
    pairs = np.add.reduceat(given.weight[:, :, None, :, None] * given.weight[:, None, :, None, :], first, axis=0)
    # moments that have no weight may be anything
    begin = given.ends[0]
    at = np.clip(np.rint((given.time - begin) / step).astype(np.intp), 0, count - 1)
    apart = np.rint((given.time[:, :, None] - given.time[:, None, :]) / step).astype(np.intp) % size
    frequency = np.arange(size // 2 + 1) / (size * step)
    inside = (frequency >= lowest) & (frequency <= highest)
    axes = given.axes

    def transformed(place: np.ndarray, weight: Array) -> Array:
        return np.asarray(fft.rfft(np.bincount(place.ravel(), weight.ravel(), size))[inside])

    z = np.stack([transformed(at, seen[..., a]) for a in range(axes)], axis=-1)
    normal = np.empty((len(z), axes, axes), complex)
    for a in range(axes):
        for b in range(axes):
            normal[:, a, b] = transformed(apart, pairs[..., a, b])
    own = np.einsum("faa->fa", normal).real
    best = np.maximum(own.max(axis=0), 1e-300)
    scale = 1.0 / np.sqrt(best)
    normal = normal * scale[:, None] * scale + _REGULAR * np.eye(axes)
    scaled = z * scale
    power = 2.0 * np.einsum("fa,fa->f", scaled.conj(), np.linalg.solve(normal, scaled[..., None])[..., 0]).real
    power = np.where(np.all(own >= BLIND**2 * best, axis=1), power, 0.0)
    rising = np.concatenate([[True], power[1:] >= power[:-1]])
    falling = np.concatenate([power[:-1] > power[1:], [True]])
    top = np.flatnonzero(rising & falling & (power > 0.0))
    top = top[np.argsort(-power[top])]
    return frequency[inside][top], power[top]


MOST_LINES = 20
_FAR = 5.0
"""Robust standard deviations beyond which an observation is wrong: one in two million of good ones is lost."""
_ROUNDS = 40
_ARRIVED = 1e-10
_ASTRAY = 1.0
"""Resolution elements: a fit that goes farther from the highest power has not found what makes it."""
_CELL = 1.0
"""Resolution elements to each side of a line that is fitted in which none else is sought."""
_MOST_ALIASES = 24
"""Frequencies that are fitted in place of a line, those of the highest power."""
_ALIKE = 0.8
"""Share of a line's power that an alias has at least, by the approximation that selects it."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Oscillations that were found, fitted together.

    theta(t) = sum over lines of sine sin(2 pi f (t - origin)) + cosine cos(2 pi f (t - origin)).

    Attributes
    ----------
    frequency : Array
        (K,) hertz.
    sine, cosine : Array
        (K, A) radians.
    covariance : Array
        Of frequency, sine and cosine of the first line, then of the next, (K (1 + 2 A), ...), with the variance of the
        noise that the observations show.
    chance : Array
        (K,) largest probability that noise alone would have shown one like it, anywhere in the search, when it was
        found.
    origin : float
        Moment from which phases count, seconds.
    aliases : tuple[tuple[float, ...], ...]
        (K,) other frequencies, hertz, that explain the observations as well, but for the false-alarm rate.
    """

    frequency: Array
    sine: Array
    cosine: Array
    covariance: Array
    chance: Array
    origin: float
    aliases: tuple[tuple[float, ...], ...] = ()

    @property
    def amplitude(self) -> Array:
        """(K, A) radians."""
        return np.hypot(self.sine, self.cosine)

    @property
    def phase(self) -> Array:
        """(K, A) p of amplitude sin(2 pi f t + p) with t from the epoch, radians, 0 to 2 pi."""
        at = np.arctan2(self.cosine, self.sine) - 2.0 * np.pi * self.frequency[:, None] * self.origin
        return np.asarray(np.mod(at, 2.0 * np.pi))

    @property
    def frequency_sigma(self) -> Array:
        """(K,) hertz."""
        width = 1 + 2 * self.sine.shape[1]
        return np.asarray(np.sqrt(np.diag(self.covariance)[::width]))

    @property
    def amplitude_sigma(self) -> Array:
        """(K, A) radians: of the component along the amplitude."""
        axes = self.sine.shape[1]
        out = np.zeros_like(self.sine)
        for k in range(len(self.frequency)):
            first = k * (1 + 2 * axes) + 1
            for a in range(axes):
                at = [first + a, first + axes + a]
                along = np.array([self.sine[k, a], self.cosine[k, a]])
                along = along / max(float(np.linalg.norm(along)), 1e-300)
                out[k, a] = np.sqrt(along @ self.covariance[np.ix_(at, at)] @ along)
        return out

    def design(self, seconds: ArrayLike) -> Array:
        """(T, A, K (1 + 2 A)) derivative of the attitude at times (T,) by what `covariance` is of."""
        t = np.asarray(seconds, np.float64) - self.origin
        axes, width = self.sine.shape[1], 1 + 2 * self.sine.shape[1]
        out = np.zeros((len(t), axes, width * len(self.frequency)))
        for k, f in enumerate(self.frequency):
            angle = 2.0 * np.pi * f * t
            sine, cosine = np.sin(angle), np.cos(angle)
            slope = 2.0 * np.pi * t
            out[:, :, k * width] = (slope * cosine)[:, None] * self.sine[k] - (slope * sine)[:, None] * self.cosine[k]
            for a in range(axes):
                out[:, a, k * width + 1 + a] = sine
                out[:, a, k * width + 1 + axes + a] = cosine
        return out

    def course(self, seconds: ArrayLike) -> tuple[Array, Array]:
        """Attitude (T, A), radians, at times (T,), and its covariance (T, A, A)."""
        t = np.asarray(seconds, np.float64) - self.origin
        angle = 2.0 * np.pi * t[:, None] * self.frequency
        value = np.sin(angle) @ self.sine + np.cos(angle) @ self.cosine
        by = self.design(seconds)
        return np.asarray(value), np.asarray(np.einsum("tap,pq,tbq->tab", by, self.covariance, by, optimize=True))


@dataclass(frozen=True, eq=False)
class Found:
    """A search for jitter.

    Attributes
    ----------
    lines : Lines
        That were found.
    before : Periodogram
        Periodogram of the observations, with the variances of their kinds as they were found.
    after : Periodogram
        The same beside all lines that were found.
    used : NDArray[np.bool_]
        (R,) observations that were not left out as wrong.
    factors : Array
        (K,) variance of the noise over that of the covariances, of each kind of errors.
    threshold : float
        Power of ``after`` that noise alone exceeds with the stated probability.
    beyond : float
        Frequency up to which aliases were looked for, hertz.
    """

    lines: Lines
    before: Periodogram
    after: Periodogram
    used: NDArray[np.bool_]
    factors: Array
    threshold: float
    beyond: float

    @property
    def detectable(self) -> Array:
        """(F, A) amplitude about one axis alone that reaches the threshold without noise, radians; inf where blind."""
        least = np.sqrt(self.threshold) * self.before.sigma
        return np.where(self.before.blind[:, None], np.inf, least)


def search(
    given: Observations, lowest: float, highest: float, false_alarm: float, beyond: float | None = None
) -> Found:
    """Find oscillations.

    Parameters
    ----------
    given : Observations
        What was observed.
    lowest : float
        Frequency, hertz.
    highest : float
        likewise.
    false_alarm : float
        Probability of finding any where there is none, over all frequencies looked at.
    beyond : float | None
        Frequency up to which aliases of what is found are looked for, hertz; None for ``highest``.

    Raises
    ------
    JitterError
        Observations that say nothing of jitter.
    """
    used = _good(given, None)
    used = _good(given.evened(given.taken(used).factors()), None)
    frequency: list[float] = []
    chance: list[float] = []
    aliases: list[tuple[float, ...]] = []
    lines: Lines | None = None
    reach = lowest, farthest(given, max(highest, beyond or highest))
    while True:
        kept = given.taken(used)
        factors = _beside(kept, lines).factors()
        kept = kept.evened(factors)
        now = periodogram(_beside(kept, lines), lowest, highest)
        step = _CELL / kept.span
        open_ = ~now.blind & np.all(np.abs(now.frequency[:, None] - np.array(frequency)) > step, axis=1)
        if not np.any(open_) or len(frequency) >= MOST_LINES:
            break
        best = int(np.argmax(np.where(open_, now.power, -1.0)))
        probability = float(now.chance(now.power[best]))
        if probability > false_alarm:
            break
        chances = [*chance, probability]
        try:
            fitted = _fitted(kept, np.array([*frequency, float(now.frequency[best])]), np.array(chances))
            fitted, others = _unaliased(kept, lines, fitted, reach, false_alarm)
            again = _good(given.evened(_beside(given.taken(used), fitted).factors()), fitted)
            kept = given.taken(again).evened(factors)
            fitted = _fitted(kept, fitted.frequency, np.array(chances))
            # a strong line was noise to the factors before
            kept = given.taken(again)
            factors = _beside(kept, fitted).factors()
            kept = kept.evened(factors)
            fitted = _fitted(kept, fitted.frequency, np.array(chances))
        except JitterError:
            # what is left is no oscillation beside the others, such as one whose amplitude changes
            break
        lines, used, frequency, chance = fitted, again, fitted.frequency.tolist(), chances
        aliases.append(others)
    before = now if lines is None else periodogram(kept, lowest, highest)
    if lines is None:
        axes = given.axes
        none = np.zeros((0, axes))
        lines = Lines(np.zeros(0), none, none, np.zeros((0, 0)), np.zeros(0), given.middle)
    lines = replace(lines, aliases=tuple(aliases))
    return Found(lines, before, now, used, factors, now.threshold(false_alarm), reach[1])


def _unaliased(
    kept: Observations, lines: Lines | None, fitted: Lines, reach: tuple[float, float], false_alarm: float
) -> tuple[Lines, tuple[float, ...]]:
    """Return all lines with the last one at the frequency that explains it best, and other frequencies that explain it
    as well.

    Parameters
    ----------
    kept : Observations
        Observations that are used.
    lines : Lines | None
        That were found before; None for none.
    fitted : Lines
        The same and the last.
    reach : tuple[float, float]
        Lowest and highest frequency of aliases, hertz.
    false_alarm : float
        Likelihood, against the best, above which a frequency is an alias.
    """
    beside, at, cell = _beside(kept, lines), fitted.frequency[-1], _CELL / kept.span
    frequency, power = peaks(beside, *reach)
    here = np.abs(frequency - at) <= cell
    noise, margin = _left(kept, fitted) / kept.freedom, 2.0 * np.log(1.0 / false_alarm)
    least = _ALIKE * float(power[here].max(initial=0.0)) - margin * noise
    away = np.all(np.abs(frequency[:, None] - fitted.frequency) > cell, axis=1)
    found = [(_left(kept, fitted), fitted)]
    for candidate in frequency[away & (power >= least)][:_MOST_ALIASES]:
        try:
            other = _fitted(kept, np.append(fitted.frequency[:-1], candidate), fitted.chance)
            rest = periodogram(_beside(kept, other), max(at - 2.0 * cell, reach[0]), at + 2.0 * cell)
        except JitterError:
            continue
        if rest.chance(rest.power[rest.best]) > false_alarm:
            found.append((_left(kept, other), other))
    least_square = min(square for square, _ in found)
    alike = [one for square, one in found if kept.freedom * np.log(square / least_square) <= margin]
    # what lies in the search is taken where nothing tells it apart
    line = fitted if alike[0] is fitted else min(found, key=lambda item: item[0])[1]
    return line, tuple(sorted(float(one.frequency[-1]) for one in alike if one is not line))


def _left(given: Observations, lines: Lines) -> float:
    """Return the square sum that lines and nuisance leave of the observations."""
    left = given.rest(given.value - _predicted(given, lines))
    return float(left @ left)


def _beside(given: Observations, lines: Lines | None) -> Observations:
    """Observations with all that is fitted of lines as unknowns beside the others."""
    return given if lines is None else given.beside(_columns(given, lines))


def _columns(given: Observations, lines: Lines) -> Array:
    """Derivatives of the observations by all that is fitted of lines, (R, P)."""
    by = np.zeros((len(given.value), lines.covariance.shape[0]))
    for j in range(given.time.shape[1]):
        by += np.einsum("ra,rap->rp", given.weight[:, j], lines.design(given.time[:, j])[given.group])
    return by


def _predicted(given: Observations, lines: Lines) -> Array:
    out = np.zeros(len(given.value))
    for j in range(given.time.shape[1]):
        angle = 2.0 * np.pi * (given.time[:, j, None] - lines.origin) * lines.frequency
        turn = np.sin(angle) @ lines.sine + np.cos(angle) @ lines.cosine
        out += np.sum(given.weight[:, j] * turn[given.group], axis=1)
    return out


def _good(given: Observations, lines: Lines | None) -> NDArray[np.bool_]:
    """Which observations are explained by nuisance and lines, as far as noise goes; of a place all or none."""
    value = given.value if lines is None else given.value - _predicted(given, lines)
    keep = np.ones(len(value), bool)
    for _ in range(_ROUNDS):
        known = given.taken(keep).nuisance
        x = np.linalg.lstsq(known, value[keep], rcond=1e-10)[0] if known.shape[1] else np.zeros(0)
        off = np.abs(value - given.nuisance @ x)
        worst = np.zeros(len(given.time))
        np.maximum.at(worst, given.group, off)
        again = worst[given.group] <= _FAR * max(robust_sigma(off), 1e-300)
        if np.array_equal(again, keep):
            break
        keep = again
    return keep


def _fitted(given: Observations, frequency: Array, chance: Array) -> Lines:
    """All lines together, by Gauss and Newton from these frequencies (K,).

    Raises
    ------
    JitterError
        Two of them cannot be told apart.
    """
    axes, count, value = given.axes, len(frequency), given.rest(given.value)
    f = frequency.copy()
    width = 1 + 2 * axes
    empty = np.zeros((count * width, count * width))
    for _ in range(_ROUNDS):
        waves = given.rest(given.waves(f)).reshape(len(value), -1)
        linear = np.linalg.lstsq(waves, value, rcond=None)[0].reshape(count, 2, axes)
        lines = Lines(
            f, np.asarray(linear[:, 0], np.float64), np.asarray(linear[:, 1], np.float64), empty, chance, given.middle
        )
        by = given.rest(_columns(given, lines))
        size = np.linalg.norm(by, axis=0)
        if not np.all(size > 0.0):
            raise JitterError("an oscillation that was found moves nothing")
        left = value - waves @ linear.ravel()
        u, s, vt = np.linalg.svd(by / size, full_matrices=False)
        if s[-1] < 1e-8 * s[0]:
            raise JitterError("two oscillations that were found cannot be told apart")
        step = (vt.T @ ((u.T @ left) / s)) / size
        # half a resolution element at most
        move = np.clip(step[::width], -0.5 / given.span, 0.5 / given.span)
        f = f + move
        if np.max(np.abs(move)) * given.span < _ARRIVED:
            break
    if np.max(np.abs(f - frequency)) * given.span > _ASTRAY:
        raise JitterError("an oscillation that was found is none of one frequency")
    factor = float(left @ left) / max(given.freedom - count * width, 1)
    spread = (vt.T / s**2) @ vt / size[:, None] / size
    return replace(lines, frequency=f, covariance=np.asarray(factor * spread))


@dataclass(frozen=True, eq=False)
class Course:
    """An attitude over time as a cubic spline, with the covariance of its coefficients.

    Attributes
    ----------
    knots : Array
        (K + 4,) seconds.
    coefficients : Array
        (K, A) radians.
    covariance : Array
        (K A, K A), of the coefficients of all axes of the first spline, then of the next.
    """

    knots: Array
    coefficients: Array
    covariance: Array

    def basis(self, seconds: ArrayLike) -> Array:
        """(T, K) values of the splines at times (T,) within the knots."""
        return np.asarray(BSpline.design_matrix(np.asarray(seconds, np.float64), self.knots, 3).toarray())

    def at(self, seconds: ArrayLike) -> tuple[Array, Array]:
        """Attitude (T, A), radians, at times (T,), and its covariance (T, A, A)."""
        by = self.basis(seconds)
        axes = self.coefficients.shape[1]
        spread = self.covariance.reshape(by.shape[1], axes, by.shape[1], axes)
        return by @ self.coefficients, np.asarray(np.einsum("tk,kalb,tl->tab", by, spread, by, optimize=True))


def splined(given: Observations, interval: float, sigma: float) -> Course:
    """The attitude as a cubic spline of which nothing is known but how large it may be: for jitter that is no lines.

    What differences between moments do not tell, such as its mean and blind frequencies, keeps the prior's variance.

    Parameters
    ----------
    given : Observations
        What was observed.
    interval : float
        Of the knots, seconds; oscillations of a period below two of them are not in it.
    sigma : float
        Standard deviation of a coefficient before the observations, radians.

    Raises
    ------
    JitterError
        No time between the first and the last moment.
    """
    first, last = given.ends
    if not last > first or not interval > 0.0:
        raise JitterError("a course needs moments that lie apart and an interval above zero")
    count = max(int(np.ceil((last - first) / interval)), 1)
    inner = np.linspace(first, last, count + 1)
    step = inner[1] - inner[0]
    knots = np.concatenate([first - step * np.arange(3, 0, -1), inner, last + step * np.arange(1, 4)])
    axes, splines = given.axes, len(knots) - 4
    by = np.zeros((len(given.value), splines, axes))
    for j in range(given.time.shape[1]):
        values = BSpline.design_matrix(np.clip(given.time[:, j], first, last), knots, 3).toarray()
        by += values[given.group][:, :, None] * given.weight[:, j, None]
    design = given.rest(by.reshape(len(given.value), -1))
    left = given.rest(given.value)
    normal = design.T @ design + np.eye(splines * axes) / sigma**2
    covariance = np.linalg.inv(normal)
    solved = np.asarray(covariance @ (design.T @ left), np.float64)
    return Course(knots, solved.reshape(splines, axes), np.asarray(covariance, np.float64))
