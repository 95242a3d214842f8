"""Detection of attitude jitter from two or more lines that saw the same ground points at different times.

A ground point that is seen at several times measures how the attitude differs between them. An observation is

    value = sum over times j of weight_j . theta(t_j) + nuisance . x + noise,

whitened to unit variance. For two bands that see the ground a time dt apart it is theta(t + dt) - theta(t), whose
response to an oscillation of frequency f is 2 |sin(pi f dt)|: it is blind at k/dt.

**Periodogram.** At every frequency, sine and cosine about every axis are fitted together with the nuisance parameters;
the reduction of the sum of squares is the power. Disparities are neither interpolated nor assumed evenly spaced, so
that no period of an interpolation can appear. Frequencies at which the response of an axis is below a share of its
maximum are blind: they are listed and excluded from the search.

**False alarms.** With noise alone the power at a frequency is a chi-square of s = 2 x axes degrees of freedom, the
squared length of the noise's projection on a plane that rotates with the frequency. The probability that the length R
exceeds a level r somewhere is at most the probability that it does so at the start plus the mean number of upcrossings
(Rice; Davies 1987). Of the derivative R', only the part L of the plane's derivative with respect to frequency that is
orthogonal to the plane counts:

    P(max R > r) <= segments x P(R > r) + p_R(r) / sqrt(2 pi) x integral of sqrt(tr(L' L) / s) over the frequency.

This bound holds for the actual times, weights and gaps of the observations, and is tight for small rates. If the noise
variance is estimated from the n degrees of freedom of the residuals, the power at each frequency follows a beta
distribution; it is converted to the chi-square with the same tail probability.

**Lines** (oscillations) are detected one after the other, the strongest first: the highest power of the periodogram is
a line if its false-alarm probability is below the specified rate; then all lines detected so far are fitted together,
frequencies included, and the search continues with them as unknowns. If the times are nearly even, a faster oscillation
shows power in the search, too: every frequency up to a specified one that explains the line as well is an alias of it.
The line reported is one of these frequencies; which of them is right is decided up to the false-alarm rate, and the
others are listed. Observations that no oscillation explains (mismatches) are excluded, and included again if a line
that is detected later explains them.

**Aliases** far beyond the search: points on the rows of a grid are seen at times that are nearly multiples of an
interval, and an oscillation faster than half of that rate looks like a slow one. The power of all frequencies, up to
the rate of the image lines, follows at once from Fourier transforms of the observations on a fine grid of times: with
the observations' weights w and values v,

    z(f) = sum v w exp(-2 pi i f t),   N(f) = sum w w' exp(-2 pi i f (t - t')),   power = 2 z* N^-1 z,

which is the power of the periodogram except for the nuisance and the correlation of sine and cosine. Both are small at
frequencies well above the inverse of the observed time; the candidates selected are fitted exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, optimize, stats
from scipy.interpolate import BSpline

from analysis.arrays import Array, MeasurementError
from analysis.statistics import robust_sigma

OVERSAMPLING = 6
"""Number of periodogram frequencies per inverse of the observed time span. The nearest of them then has at least 98 %
of the power of an oscillation.
"""
BLIND = 0.1
"""Response of the observations to an oscillation about an axis, as a fraction of the largest response at any frequency,
below which a frequency counts as blind.
"""
_AT_ONCE = 2_000_000
"""Number of (pair of observation times) x (frequency) products that are computed in one block, which limits the memory.
"""
_RANK = 1e-6
"""Smallest singular value or eigenvalue, relative to the largest, of a combination of unknowns that counts as
determined. An equal motion of all lines cannot be told from a displacement of the ground points.
"""
_NEVER = 1e-280
"""Lower bound of computed probabilities and variance factors, which keeps logarithms and roots finite."""
_LEAST_ROWS = 30
"""Smallest number of degrees of freedom of a spectrum or of an estimated variance factor."""
_REWEIGHTED = 3
"""Number of iterations in which the variances of the kinds of errors are estimated."""
_LEAST_FACTOR = 0.01
"""Smallest variance factor that is estimated; sigma is then a tenth of the a-priori one."""


class JitterError(MeasurementError, ValueError):
    """Error raised for observations that do not allow a jitter analysis."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of attitude differences between exposure times, whitened to unit noise variance.

    Attributes
    ----------
    value : (R,) ndarray
        R observed values, such as image disparities divided by their sigma; their noise has unit variance if the
        covariances used for whitening are right.
    group : (R,) ndarray of int
        Number of the ground point of each observation, from 0 on, in ascending order.
    time : (G, J) ndarray
        The J times at which each of G ground points was observed, in seconds.
    weight : (R, J, A) ndarray
        Derivative of each observation with respect to the attitude angle about each of A axes at each time, per radian;
        zero where a group has fewer times.
    nuisance : (R, P) ndarray
        Derivatives of the observations with respect to P nuisance parameters, such as heights of the points; their rank
        may be lower than P.
    mix : (R, K, W) ndarray
        Mixing matrix by which the W unit errors of each of K kinds in a group make up the noise of an observation. The
        variance of each kind, such as the coordinates of one line or the heights known beforehand, may be wrong by a
        factor of its own.
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
        """Return observations of attitude differences after checking shapes and values.

        Parameters
        ----------
        value : (R,) array_like
            R observed values, whitened to unit noise variance.
        group : (R,) array_like of int
            Number of the ground point of each observation, ascending.
        time : (G, J) array_like
            The J times at which each of G ground points was observed, in seconds.
        weight : (R, J, A) array_like
            Derivatives of the observations with respect to the attitude angles about A axes at these times, per radian.
        nuisance : (R, P) array_like
            Derivatives of the observations with respect to P nuisance parameters.
        kind : (R,) array_like of int, optional
            Kind of each observation, from 0 on, where errors are independent; all alike by default.
        mix : (R, K, W) array_like, optional
            Instead of `kind`, the matrix by which W unit errors of each of K kinds make up the noise of an observation.

        Raises
        ------
        JitterError
            Shapes do not match, values are not finite, or there are too few observations.
        """
        v, t, w, n = (np.array(a, np.float64) for a in (value, time, weight, nuisance))
        g = np.array(group, np.intp)
        kinds = np.zeros(len(v), np.intp) if kind is None else np.array(kind, np.intp)
        shapes = v.shape, g.shape, t.shape, w.shape, n.shape
        if v.ndim != 1 or w.ndim != 3 or t.ndim != 2 or not (len(v) == len(g) == len(w) == len(n) == len(kinds)):
            raise JitterError(f"observations of shapes {shapes} do not match")
        if w.shape[1] != t.shape[1] or np.any(np.diff(g) < 0) or np.any(g < 0) or np.any(g >= len(t)):
            raise JitterError(f"observations of shapes {shapes} do not match, or their groups are mixed")
        mixing = _unmixed(g, len(t), kinds) if mix is None else np.array(mix, np.float64)
        if mixing.ndim != 3 or len(mixing) != len(v):
            raise JitterError(f"{len(v)} observations do not match mixtures of shape {mixing.shape}")
        if not all(np.all(np.isfinite(a)) for a in (v, t, w, n, mixing)):
            raise JitterError("an observation is not finite")
        observations = cls(v, g, t, w, n, mixing)
        if observations.freedom < _LEAST_ROWS:
            unknown = len(v) - observations.freedom
            raise JitterError(f"{len(v)} observations with {unknown} unknowns are too few for a spectrum")
        return observations

    @property
    def axes(self) -> int:
        """Number of body axes, A, about which the attitude is analysed."""
        return self.weight.shape[2]

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Earliest and latest observation time, in seconds."""
        moments = self.time[self.group][np.any(self.weight != 0.0, axis=2)]
        return (float(moments.min()), float(moments.max())) if len(moments) else (0.0, 0.0)

    @property
    def span(self) -> float:
        """Time from the first to the last observation, in seconds."""
        return self.ends[1] - self.ends[0]

    @property
    def middle(self) -> float:
        """Middle of the observation times, in seconds, from which phases of oscillations count within this module."""
        return 0.5 * (self.ends[0] + self.ends[1])

    @cached_property
    def known(self) -> Array:
        """Orthonormal basis of the space that the nuisance derivatives of the R observations span, (R, rank)."""
        if not self.nuisance.shape[1]:
            return np.zeros((len(self.value), 0))
        size = np.linalg.norm(self.nuisance, axis=0)
        u, s, _ = np.linalg.svd(self.nuisance[:, size > 0.0] / size[size > 0.0], full_matrices=False)
        return np.asarray(u[:, s > _RANK * s[:1]])

    @property
    def freedom(self) -> int:
        """Number of observations minus the number of independent nuisance parameters."""
        return len(self.value) - self.known.shape[1]

    def rest(self, columns: Array) -> Array:
        """Return the part of vectors of R observations, (R, ...), that the nuisance parameters cannot explain.

        It is the projection orthogonal to the nuisance derivatives.
        """
        return np.asarray(columns - np.tensordot(self.known, np.tensordot(self.known.T, columns, 1), 1))

    def waves(self, frequency: ArrayLike) -> Array:
        """Return the responses of the observations to attitude oscillations (sine and cosine) of given frequencies.

        The result has shape (R, F, 2 A) for R observations, F frequencies in hertz and A axes; it is the value of an
        observation per radian of amplitude.
        """
        f = np.atleast_1d(np.asarray(frequency, np.float64))
        angle = 2.0 * np.pi * (self.time[:, :, None] - self.middle) * f
        both = np.stack([np.sin(angle), np.cos(angle)], axis=-1)[self.group]
        return np.einsum("rjfk,rja->rfka", both, self.weight).reshape(len(self.value), len(f), 2 * self.axes)

    def taken(self, keep: ArrayLike) -> Observations:
        """Return the observations that a boolean mask, with one element for each observation, selects."""
        where = np.asarray(keep)
        groups, group = np.unique(self.group[where], return_inverse=True)
        value, weight, nuisance = self.value[where], self.weight[where], self.nuisance[where]
        return Observations(value, group, self.time[groups], weight, nuisance, self.mix[where])

    def factors(self) -> Array:
        """Return the estimated factor on the variance of each of K kinds of errors, (K,).

        The estimate uses the residuals after fitting the nuisance parameters.

        Combinations of the kinds that have fewer than 30 degrees of freedom, such as the difference of two lines that
        are only seen against each other, keep their a-priori ratio.

        Notes
        -----
        Minimum norm quadratic unbiased estimation (Rao, J. Multivariate Analysis 1, 1971), iterated with the weights
        that it yields.
        """
        estimate = np.ones(self.mix.shape[1])
        for _ in range(_REWEIGHTED):
            estimate = estimate * self.rewhitened(estimate)._factors()
        return estimate

    def _factors(self) -> Array:
        """Return the variance factors of the K kinds of errors from one iteration of `factors`, (K,).

        They are relative to the variances that the present whitening assumes.
        """
        left, known, mix = (self._of_groups(v) for v in (self.rest(self.value)[:, None], self.known, self.mix))
        by_kind = np.moveaxis(mix, 2, 0)
        spread = by_kind @ by_kind.swapaxes(-1, -2)
        products = spread @ known
        projected = np.einsum("gip,kgiq->kpq", known, products)
        square = np.sum((by_kind.swapaxes(-1, -2) @ left) ** 2, axis=(1, 2, 3))
        normal = np.einsum("kgij,mgij->km", spread, spread) - 2.0 * np.einsum("kgip,mgip->km", products, products)
        normal += np.einsum("kpq,mqp->km", projected, projected)
        size, axes = np.linalg.eigh(normal)
        inverse = np.where(size >= _LEAST_ROWS, 1.0 / np.maximum(size, _LEAST_ROWS), 0.0)
        return np.asarray(np.maximum(1.0 + (axes * inverse) @ axes.T @ (square - normal.sum(axis=1)), _LEAST_FACTOR))

    def rewhitened(self, factors: ArrayLike) -> Observations:
        """Return the observations whitened with the variance of each of K kinds of errors times its factor (K,)."""
        scaled = self.mix * np.sqrt(np.maximum(np.asarray(factors, np.float64), _NEVER))[:, None]
        mix = self._of_groups(scaled.reshape(len(scaled), -1))
        spread = mix @ mix.swapaxes(1, 2)
        # unit variance for the rows that a group lacks
        spread += np.where(np.any(mix != 0.0, axis=2), 0.0, 1.0)[:, :, None] * np.eye(mix.shape[1])
        root = np.linalg.inv(np.linalg.cholesky(spread))
        row = self._row

        def white(columns: Array) -> Array:
            flat = self._of_groups(columns.reshape(len(columns), -1))
            return np.asarray((root @ flat)[self.group, row].reshape(columns.shape))

        value, weight, nuisance = (white(v) for v in (self.value, self.weight, self.nuisance))
        return replace(self, value=value, weight=weight, nuisance=nuisance, mix=white(scaled))

    def sums(self, columns: Array) -> Array:
        """Return the sums of vectors of R observations (R, ...) over each of G ground points, (G, ...)."""
        # every group has an observation, so that reduceat sums over whole groups
        return np.asarray(np.add.reduceat(columns, np.searchsorted(self.group, np.arange(len(self.time))), axis=0))

    @property
    def pairs(self) -> Array:
        """Sums over each ground point of the products of weights at two times about two axes, (G, J, J, A, A)."""
        return self.sums(self.weight[:, :, None, :, None] * self.weight[:, None, :, None, :])

    @cached_property
    def _row(self) -> NDArray[np.intp]:
        """Position of each of R observations among those of its ground point, counted from 0."""
        return _within(self.group, len(self.time))

    def _of_groups(self, columns: Array) -> Array:
        """Return vectors of R observations arranged by ground point, (G, M, ...), padded with zeros.

        G is the number of ground points and M the largest number of observations of one point.
        """
        out = np.zeros((len(self.time), int(self._row.max(initial=0)) + 1, *columns.shape[1:]))
        out[self.group, self._row] = columns
        return out

    def beside(self, columns: Array) -> Observations:
        """Return the R observations with P more nuisance parameters, given by their derivatives (R, P)."""
        return replace(self, nuisance=np.concatenate([self.nuisance, columns], axis=1))


def _within(group: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return the position of each of R observations among those of its ground point, counted from 0.

    `group` is ascending.
    """
    return np.asarray(np.arange(len(group)) - np.searchsorted(group, np.arange(count))[group])


def _unmixed(group: NDArray[np.intp], count: int, kind: NDArray[np.intp]) -> Array:
    """Return the mixing matrix (`Observations.mix`) of R observations with independent errors, each of one kind."""
    row = _within(group, count)
    out = np.zeros((len(kind), int(kind.max(initial=0)) + 1, int(row.max(initial=0)) + 1))
    out[np.arange(len(kind)), kind, row] = 1.0
    return out


def _powers(time: Array, degree: int) -> Array:
    middle, half = 0.5 * (time.min() + time.max()), max(0.5 * float(np.ptp(time)), 1e-9)
    return np.asarray(np.polynomial.legendre.legvander((time - middle) / half, degree))


@dataclass(frozen=True, eq=False)
class Periodogram:
    """Power of attitude oscillations as a function of frequency, with its significance.

    Attributes
    ----------
    frequency : (F,) ndarray
        F evenly spaced frequencies, in hertz.
    power : (F,) ndarray
        Reduction of the weighted sum of squares by fitting an oscillation of this frequency about all axes.
    amplitude : (F, A) ndarray
        Fitted amplitude about each of A axes, in radians.
    sigma : (F, A) ndarray
        Standard deviation of an amplitude's components for unit noise variance, in radians.
    response : (F, A) ndarray
        RMS response of the observations relative to an observation of the attitude at one time; 2 if each observation
        compares two times of opposite phase.
    blind : (F,) ndarray of bool
        True for frequencies excluded from the search.
    turning : float
        Integral over the searched frequencies of the rate at which the plane of sine and cosine rotates; it enters the
        false-alarm bound of the module.
    segments : int
        Number of contiguous intervals of searched frequencies.
    total : float
        Sum of squares without any oscillation.
    freedom : int
        Degrees of freedom of the total.
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
        """Number of amplitudes of one oscillation: sine and cosine about each axis."""
        return 2 * self.amplitude.shape[1]

    def p_value(self, power: ArrayLike) -> Array:
        """Return an upper bound of the probability that noise alone reaches a power at any searched frequency.

        The noise variance is estimated from the residuals, with `freedom` degrees of freedom.
        """
        share = np.clip(np.asarray(power, np.float64) / self.total, 0.0, 1.0)
        single = np.maximum(stats.beta.sf(share, 0.5 * self.order, 0.5 * (self.freedom - self.order)), _NEVER)
        r = stats.chi.isf(single, self.order)
        rate = stats.chi.pdf(r, self.order) / np.sqrt(2.0 * np.pi)
        return np.asarray(np.minimum(self.segments * single + rate * self.turning, 1.0))

    def threshold(self, false_alarm: float) -> float:
        """Return the power that noise alone exceeds anywhere with at most the probability `false_alarm`."""
        level = optimize.brentq(
            lambda x: float(np.log(self.p_value(x * self.total)) - np.log(false_alarm)), 1e-9, 0.999
        )
        return float(level * self.total)

    @property
    def best(self) -> int:
        """Index of the highest power among the searched frequencies."""
        return int(np.argmax(np.where(self.blind, -1.0, self.power)))

    def intervals(self) -> list[tuple[float, float]]:
        """Return the first and the last frequency, in hertz, of every interval excluded from the search as blind."""
        edge = np.flatnonzero(np.diff(np.concatenate([[0], self.blind.astype(int), [0]])))
        return [(float(self.frequency[a]), float(self.frequency[b - 1])) for a, b in edge.reshape(-1, 2)]


def periodogram(observations: Observations, lowest: float, highest: float) -> Periodogram:
    """Compute the periodogram between two frequencies, in hertz.

    Raises
    ------
    JitterError
        All observations have the same time, the interval holds no resolvable frequency, an axis has no effect on the
        observations, or all frequencies are blind.
    """
    if not observations.span > 0.0:
        raise JitterError("all observations have the same time")
    step = 1.0 / (OVERSAMPLING * observations.span)
    f = np.arange(np.ceil(lowest / step), np.floor(highest / step) + 1.0) * step
    if len(f) < 2:
        raise JitterError(
            f"no frequencies between {lowest:g} and {highest:g} Hz that {observations.span:.3g} s resolve"
        )
    value, axes = observations.rest(observations.value), observations.axes
    products = _Products.of(observations, value)
    power, variance, square, rotation_rate = np.zeros(len(f)), *np.zeros((2, len(f), axes)), np.zeros(len(f))
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
        mean_variance = 0.5 * np.sum(np.diagonal(inverse, axis1=1, axis2=2).reshape(-1, 2, axes), axis=1)
        variance[part] = np.where(good[:, None], mean_variance, np.inf)
        # part of the planes' slope that is orthogonal to them
        leaving = slopes - mixed.swapaxes(1, 2) @ inverse @ mixed
        rate = np.trace(inverse @ leaving, axis1=1, axis2=2)
        rotation_rate[part] = np.sqrt(np.maximum(rate, 0.0) / (2 * axes))
    sights = np.maximum(np.sum(np.any(observations.weight != 0.0, axis=2), axis=1), 1)
    once = np.sqrt(0.5 * np.sum(np.sum(observations.weight**2, axis=1) / sights[:, None], axis=0))
    sigma = np.sqrt(variance)
    response = 1.0 / (sigma * np.where(once > 0.0, once, np.inf))
    most = np.max(response, axis=0)
    if not np.all(most > 0.0):
        raise JitterError("an axis of the attitude has no effect on the observations")
    blind = np.any(response < BLIND * most, axis=1)
    if np.all(blind):
        raise JitterError(f"all frequencies between {lowest:g} and {highest:g} Hz are blind")
    joined = ~blind[1:] & ~blind[:-1]
    rotation = float(np.sum((0.5 * step * (rotation_rate[1:] + rotation_rate[:-1]))[joined]))
    segments = int(np.sum(~blind) - np.sum(joined))
    total = float(value @ value)
    return Periodogram(
        f, power, np.sqrt(square), sigma, response, blind, rotation, segments, total, observations.freedom
    )


@dataclass(frozen=True, eq=False)
class _Products:
    """Precomputed sums over the observations, from which scalar products of waves of any frequency follow quickly.

    Attributes
    ----------
    time : (G, J) ndarray
        The J observation times of each of G ground points, from the middle of all times, in seconds.
    columns : (G J, A C) ndarray
        Products of the attitude derivatives with the observed value and the nuisance basis, C vectors in all.
    pairs : (G J J, A A) ndarray
        Products of the attitude derivatives at two times of one point.
    axes : int
        Number of axes, A.
    """

    time: Array
    columns: Array
    pairs: Array
    axes: int

    @classmethod
    def of(cls, observations: Observations, value: Array) -> _Products:
        columns = np.concatenate([value[:, None], observations.known], axis=1)
        by_column = observations.sums(observations.weight[..., None] * columns[:, None, None, :])
        by_pair = observations.pairs
        groups, moments, axes = len(observations.time), observations.time.shape[1], observations.axes
        return cls(
            observations.time - observations.middle,
            by_column.reshape(groups * moments, -1),
            by_pair.reshape(groups * moments**2, axes**2),
            axes,
        )

    @property
    def at_once(self) -> int:
        """Number of frequencies whose wave products are held in memory at a time."""
        return max(_AT_ONCE // len(self.pairs), 1)

    def at(self, frequency: Array) -> tuple[Array, Array, Array, Array]:
        """Return the scalar products of waves and of their derivatives with respect to frequency, at F frequencies.

        Frequencies are in hertz. Waves are the observations' responses to unit sines and cosines, made orthogonal to
        the nuisance parameters.

        Returns
        -------
        tuple of ndarray
            Products of all waves with one another, of waves with their slopes with respect to frequency, and of slopes,
            each (F, 2 A, 2 A) for A axes, and of waves with the observed values, (F, 2 A).
        """
        count, a = len(frequency), self.axes
        t = 2.0 * np.pi * self.time
        angle = frequency[:, None, None] * t
        sine, cosine = np.sin(angle), np.cos(angle)
        # waves and slopes: sine, cosine, and t cosine, - t sine
        waves = np.stack([sine, cosine, t * cosine, -t * sine])
        with_columns = (waves.reshape(4, count, -1) @ self.columns).reshape(4, count, a, -1)
        known = with_columns[..., 1:]
        blocks = []
        for rows, others in ((0, 0), (0, 2), (2, 2)):
            block = np.empty((count, 2, a, 2, a))
            for j, k in product((0, 1), (0, 1)):
                first, second = rows + j, others + k
                outer = (waves[first][..., :, None] * waves[second][..., None, :]).reshape(count, -1)
                projection = known[first] @ known[second].swapaxes(1, 2)
                block[:, j, :, k, :] = (outer @ self.pairs).reshape(count, a, a) - projection
            blocks.append(block.reshape(count, 2 * a, 2 * a))
        right = with_columns[:2, ..., 0].swapaxes(0, 1).reshape(count, 2 * a)
        return blocks[0], blocks[1], blocks[2], right


_FINE, _PADDED = 16, 4
"""Sampling of the periodogram: grid times per period of the highest frequency, and frequencies per resolution.

The resolution is the inverse of the length of the series. An oscillation loses at most 3 % of its power by either.
"""
_WIDEST = 2**18
"""Largest number of resolution elements (inverse of the observed time span) over which the Fourier transform of the
alias search extends.
"""
_REGULAR = 1e-4
"""Regularisation of the amplitudes about all axes, as a fraction of the weight of the best determined combination of
axes. It keeps amplitudes finite where observations cannot separate two axes.
"""


def farthest(observations: Observations, highest: float) -> float:
    """Return the highest frequency, in hertz, up to which aliases can be searched, at most ``highest``."""
    return min(highest, _WIDEST / observations.span)


def peaks(observations: Observations, lowest: float, highest: float) -> tuple[Array, Array]:
    """Return frequencies, in hertz, and approximate powers of the K maxima of the periodogram, the highest first.

    Parameters
    ----------
    observations : Observations
        Observations of the attitude.
    lowest : float
        Lowest frequency, in hertz.
    highest : float
        Highest frequency, in hertz; lowered to `farthest`.
    """
    highest = farthest(observations, highest)
    step = 1.0 / (_FINE * highest)
    count = int(np.ceil(observations.span / step)) + 2
    size = fft.next_fast_len(_PADDED * count, real=True)
    sums = observations.sums(observations.weight * observations.rest(observations.value)[:, None, None])
    pairs = observations.pairs
    # times without weight are clipped to the grid
    begin = observations.ends[0]
    at = np.clip(np.rint((observations.time - begin) / step).astype(np.intp), 0, count - 1)
    apart = np.rint((observations.time[:, :, None] - observations.time[:, None, :]) / step).astype(np.intp) % size
    frequency = np.arange(size // 2 + 1) / (size * step)
    inside = (frequency >= lowest) & (frequency <= highest)
    axes = observations.axes

    def transformed(index: np.ndarray, weight: Array) -> Array:
        return np.asarray(fft.rfft(np.bincount(index.ravel(), weight.ravel(), size))[inside])

    z = np.stack([transformed(at, sums[..., a]) for a in range(axes)], axis=-1)
    normal = np.empty((len(z), axes, axes), complex)
    for a in range(axes):
        for b in range(axes):
            normal[:, a, b] = transformed(apart, pairs[..., a, b])
    diagonal = np.einsum("faa->fa", normal).real
    best = np.maximum(diagonal.max(axis=0), 1e-300)
    scale = 1.0 / np.sqrt(best)
    normal = normal * scale[:, None] * scale + _REGULAR * np.eye(axes)
    scaled = z * scale
    power = 2.0 * np.einsum("fa,fa->f", scaled.conj(), np.linalg.solve(normal, scaled[..., None])[..., 0]).real
    power = np.where(np.all(diagonal >= BLIND**2 * best, axis=1), power, 0.0)
    rising = np.concatenate([[True], power[1:] >= power[:-1]])
    falling = np.concatenate([power[:-1] > power[1:], [True]])
    top = np.flatnonzero(rising & falling & (power > 0.0))
    top = top[np.argsort(-power[top])]
    return frequency[inside][top], power[top]


MOST_LINES = 20
"""Largest number of oscillations (spectral lines) that a search detects."""
_FAR = 5.0
"""Robust standard deviations beyond which an observation is excluded as wrong; of normally distributed observations it
excludes one in two million.
"""
_ROUNDS = 40
"""Largest number of iterations of a fit or of an exclusion."""
_ARRIVED = 1e-10
"""Largest change of a frequency at convergence, in resolution elements (the inverse of the observed time span)."""
_ASTRAY = 1.0
"""Largest change of a frequency from the highest power, in resolution elements (the inverse of the observed time span);
a fit that moves farther has converged to another line.
"""
_CELL = 1.0
"""Half width of the interval around a fitted line in which no other line is sought, in resolution elements (the inverse
of the observed time span).
"""
_MOST_ALIASES = 24
"""Largest number of alias frequencies that are tried instead of a detected line's frequency, those of highest power
first.
"""
_SIMILAR = 0.8
"""Smallest approximate power of a candidate alias, as a fraction of the power of the detected oscillation."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Detected oscillations (spectral lines) of an attitude, fitted together.

    The attitude angle about each axis at time t is the sum over the lines of sine * sin(2 pi f (t - origin)) + cosine *
    cos(2 pi f (t - origin)), f being the frequency of a line.

    Attributes
    ----------
    frequency : (K,) ndarray
        Frequencies of the K lines, in hertz.
    sine, cosine : (K, A) ndarray
        Amplitudes of the sine and the cosine about each of A axes, in radians.
    covariance : (K (1 + 2 A), K (1 + 2 A)) ndarray
        Covariance of frequency, sine and cosine of the first line, then of the next, with the noise variance estimated
        from the observations.
    p_value : (K,) ndarray
        Upper bound of the probability that noise alone would have shown such a line anywhere in the search.
    origin : float
        Reference time of the phases, in seconds.
    aliases : tuple of tuple of float
        For each line, other frequencies in hertz that explain the observations as well, at the false-alarm rate.
    """

    frequency: Array
    sine: Array
    cosine: Array
    covariance: Array
    p_value: Array
    origin: float
    aliases: tuple[tuple[float, ...], ...] = ()

    @property
    def amplitude(self) -> Array:
        """Amplitudes of the K lines about each of A axes, (K, A), in radians: the root of sine^2 + cosine^2."""
        return np.hypot(self.sine, self.cosine)

    @property
    def phase(self) -> Array:
        """Phase p of each of K lines about each of A axes, (K, A), in radians, 0 to 2 pi.

        The angle is amplitude * sin(2 pi f t + p), with the frequency f in hertz and the time t in seconds from the
        epoch.
        """
        at = np.arctan2(self.cosine, self.sine) - 2.0 * np.pi * self.frequency[:, None] * self.origin
        return np.asarray(np.mod(at, 2.0 * np.pi))

    @property
    def frequency_sigma(self) -> Array:
        """Standard deviations of the frequencies of the K lines, in hertz."""
        width = 1 + 2 * self.sine.shape[1]
        return np.asarray(np.sqrt(np.diag(self.covariance)[::width]))

    @property
    def amplitude_sigma(self) -> Array:
        """Standard deviations of the amplitudes of K lines about A axes, (K, A), in radians."""
        axes, width = self.sine.shape[1], 1 + 2 * self.sine.shape[1]
        parts = [slice(k + 1, k + width) for k in range(0, len(self.covariance), width)]
        blocks = np.array([self.covariance[part, part] for part in parts]).reshape(-1, 2, axes, 2, axes)
        along = np.stack([self.sine, self.cosine], axis=1) / np.maximum(self.amplitude, 1e-300)[:, None]
        return np.sqrt(np.einsum("kia,kiaja,kja->ka", along, blocks, along))

    def design(self, seconds: ArrayLike) -> Array:
        """Return the derivatives of the attitude at T times with respect to frequency, sine and cosine of each line.

        The result has shape (T, A, K (1 + 2 A)) for A axes and K lines, in the order of `covariance`.
        """
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
        """Return the attitude angles of all lines together at T times, about A axes, and their covariance.

        Angles are (T, A) in radians, covariances (T, A, A) in rad^2, times in seconds.
        """
        by = self.design(seconds)
        spread = np.einsum("tap,pq,tbq->tab", by, self.covariance, by, optimize=True)
        return self.angles(seconds), np.asarray(spread)

    def angles(self, seconds: ArrayLike) -> Array:
        """Return the attitude angles of all lines together at T times about A axes, (T, A), in radians."""
        angle = 2.0 * np.pi * (np.asarray(seconds, np.float64) - self.origin)[:, None] * self.frequency
        return np.asarray(np.sin(angle) @ self.sine + np.cos(angle) @ self.cosine)


@dataclass(frozen=True, eq=False)
class JitterSearch:
    """Result of a search for attitude oscillations (jitter) in R observations.

    Attributes
    ----------
    lines : Lines
        Detected oscillations.
    before : Periodogram
        Periodogram of the observations, with the final variance factors of their kinds.
    after : Periodogram
        Periodogram with all detected lines as unknowns.
    used : (R,) ndarray of bool
        False for observations excluded as wrong.
    factors : (K,) ndarray
        Estimated factor on the a-priori variance of each of K kinds of errors.
    threshold : float
        Power in ``after`` that noise alone exceeds with the specified false-alarm probability.
    beyond : float
        Highest frequency at which aliases were searched, in hertz.
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
        """Smallest detectable amplitude at each of F frequencies about each of A axes alone, (F, A), in radians.

        It is the amplitude whose power without noise equals the threshold; infinite at blind frequencies.
        """
        least = np.sqrt(self.threshold) * self.before.sigma
        return np.where(self.before.blind[:, None], np.inf, least)


def search(
    observations: Observations, lowest: float, highest: float, false_alarm: float, beyond: float | None = None
) -> JitterSearch:
    """Detect oscillations of an attitude.

    Parameters
    ----------
    observations : Observations
        Observations of the attitude.
    lowest : float
        Lowest frequency of the search, in hertz.
    highest : float
        Highest frequency of the search, in hertz.
    false_alarm : float
        Probability of a detection where there is no oscillation, over all searched frequencies.
    beyond : float, optional
        Highest frequency at which aliases of the detected lines are searched, in hertz; ``highest`` by default.

    Raises
    ------
    JitterError
        The observations do not allow a jitter analysis.
    """
    used = _good(observations, None)
    used = _good(observations.rewhitened(observations.taken(used).factors()), None)
    frequency: list[float] = []
    p_values: list[float] = []
    aliases: list[tuple[float, ...]] = []
    lines: Lines | None = None
    alias_band = lowest, farthest(observations, max(highest, beyond or highest))
    while True:
        used_observations = observations.taken(used)
        factors = _beside(used_observations, lines).factors()
        used_observations = used_observations.rewhitened(factors)
        current = periodogram(_beside(used_observations, lines), lowest, highest)
        step = _CELL / used_observations.span
        searchable = ~current.blind & np.all(np.abs(current.frequency[:, None] - np.array(frequency)) > step, axis=1)
        if not np.any(searchable) or len(frequency) >= MOST_LINES:
            break
        best = int(np.argmax(np.where(searchable, current.power, -1.0)))
        probability = float(current.p_value(current.power[best]))
        if probability > false_alarm:
            break
        with_line = np.array([*p_values, probability])
        try:
            fitted = _fitted(used_observations, np.array([*frequency, current.frequency[best]]), with_line)
            fitted, alternatives = _unaliased(used_observations, lines, fitted, alias_band, false_alarm)
            good = _good(observations.rewhitened(_beside(observations.taken(used), fitted).factors()), fitted)
            used_observations = observations.taken(good).rewhitened(factors)
            fitted = _fitted(used_observations, fitted.frequency, with_line)
            # the factors were estimated before with the new line as noise
            used_observations = observations.taken(good)
            factors = _beside(used_observations, fitted).factors()
            used_observations = used_observations.rewhitened(factors)
            fitted = _fitted(used_observations, fitted.frequency, with_line)
        except JitterError:
            # the rest is not a stationary oscillation; its amplitude may change, for example
            break
        lines, used, frequency, p_values = fitted, good, fitted.frequency.tolist(), with_line.tolist()
        aliases.append(alternatives)
    before = current if lines is None else periodogram(used_observations, lowest, highest)
    if lines is None:
        axes = observations.axes
        none = np.zeros((0, axes))
        lines = Lines(np.zeros(0), none, none, np.zeros((0, 0)), np.zeros(0), observations.middle)
    lines = replace(lines, aliases=tuple(aliases))
    return JitterSearch(lines, before, current, used, factors, current.threshold(false_alarm), alias_band[1])


def find_jitter(
    time: ArrayLike,
    angle: ArrayLike,
    sigma: float,
    lowest: float,
    highest: float,
    *,
    lag: float | None = None,
    false_alarm: float = 1e-3,
) -> Lines:
    """Find the oscillations of an attitude in a series of angles, at any times, with a bounded false-alarm rate.

    Parameters
    ----------
    time : (n,) array_like
        Times of the n observations, in seconds, in any order.
    angle : (n,) or (n, A) array_like
        Angles about A axes, in radians; with `lag`, angle at ``time + lag`` minus angle at ``time``, as two bands or
        two rows of chips show it.
    sigma : float
        Standard deviation of the noise of each angle, in radians. The search estimates a factor on it.
    lowest, highest : float
        Range of the search, in hertz.
    lag : float, optional
        Time between the two moments that each observation compares, in seconds; None for angles themselves.
    false_alarm : float
        Probability of finding any oscillation in noise alone.

    Returns
    -------
    Lines
        Oscillations, K of them: `frequency` (K,), ``amplitude`` and `phase` (K, A) with `frequency_sigma` and
        `amplitude_sigma`, strongest first.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, or too few observations.

    Notes
    -----
    Sine, cosine, a constant and a drift about every axis are fitted together at each frequency. The false-alarm rate
    bounds the maximum of the periodogram (Davies, Biometrika 74, 33 (1987)).

    Examples
    --------
    An oscillation of 0.5 urad at 1.3 Hz in a minute of noise of 0.3 urad:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(9)
    >>> time = np.sort(rng.uniform(0, 60, 150))
    >>> angle = 0.5e-6 * np.sin(2 * np.pi * 1.3 * time) + 0.3e-6 * rng.standard_normal(150)
    >>> lines = analysis.find_jitter(time, angle, 0.3e-6, lowest=0.1, highest=2.0)
    >>> np.round(lines.frequency, 2), np.round(lines.amplitude[:, 0] * 1e6, 1)
    (array([1.3]), array([0.5]))
    >>> analysis.find_jitter(time, 0.3e-6 * rng.standard_normal(150), 0.3e-6, 0.1, 2.0).frequency.size
    0

    Two bands that see the ground 0.2 s apart show the difference of the angle:

    >>> seen = 0.5e-6 * (np.sin(2 * np.pi * 1.3 * (time + 0.2)) - np.sin(2 * np.pi * 1.3 * time))
    >>> seen = seen + 0.2e-6 * rng.standard_normal(150)
    >>> lines = analysis.find_jitter(time, seen, 0.2e-6, 0.1, 2.0, lag=0.2)
    >>> np.round(lines.frequency, 2), np.round(lines.amplitude[:, 0] * 1e6, 1)
    (array([1.3]), array([0.5]))
    """
    moments, values = np.asarray(time, np.float64), np.asarray(angle, np.float64)
    values = values[:, None] if values.ndim == 1 else values
    if moments.ndim != 1 or values.ndim != 2 or len(values) != len(moments) or not (np.isfinite(sigma) and sigma > 0):
        raise JitterError(
            f"jitter: need times (n,), angles (n,) or (n, axes) and a positive sigma, found {moments.shape},"
            f" {np.shape(angle)}, {sigma}"
        )
    axes = values.shape[1]
    signs, shifts = ((1.0,), (0.0,)) if lag is None else ((-1.0, 1.0), (0.0, lag))
    weight = np.tile(np.array(signs)[:, None, None] * np.eye(axes), (len(moments), 1, 1, 1)).transpose(0, 2, 1, 3)
    drift = np.stack([np.ones_like(moments), moments - np.mean(moments)], axis=1)
    rows = values.ravel() / sigma, np.repeat(np.arange(len(moments)), axes), moments[:, None] + np.array(shifts)
    weights = weight.reshape(-1, len(signs), axes) / sigma
    return search(Observations.of(*rows, weights, np.kron(drift, np.eye(axes))), lowest, highest, false_alarm).lines


def _unaliased(
    observations: Observations, lines: Lines | None, fitted: Lines, band: tuple[float, float], false_alarm: float
) -> tuple[Lines, tuple[float, ...]]:
    """Return all oscillations (lines) with the last one at its most likely frequency, and its aliases, in hertz.

    Parameters
    ----------
    observations : Observations
        Observations that are used.
    lines : Lines or None
        Lines detected before, or None if this is the first.
    fitted : Lines
        These lines and the last one.
    band : tuple of float
        Lowest and highest frequency between which aliases are searched, in hertz.
    false_alarm : float
        Likelihood ratio to the best frequency above which a frequency is an alias.
    """
    beside, at, cell = _beside(observations, lines), fitted.frequency[-1], _CELL / observations.span
    frequency, power = peaks(beside, *band)
    near = np.abs(frequency - at) <= cell
    noise, margin = _left(observations, fitted) / observations.freedom, 2.0 * np.log(1.0 / false_alarm)
    least = _SIMILAR * float(power[near].max(initial=0.0)) - margin * noise
    distinct = np.all(np.abs(frequency[:, None] - fitted.frequency) > cell, axis=1)
    fits = [(_left(observations, fitted), fitted)]
    for candidate in frequency[distinct & (power >= least)][:_MOST_ALIASES]:
        try:
            other = _fitted(observations, np.append(fitted.frequency[:-1], candidate), fitted.p_value)
            rest = periodogram(_beside(observations, other), max(at - 2.0 * cell, band[0]), at + 2.0 * cell)
        except JitterError:
            continue
        if rest.p_value(rest.power[rest.best]) > false_alarm:
            fits.append((_left(observations, other), other))
    least_square = min(square for square, _ in fits)
    equivalent = [
        lines_fit for square, lines_fit in fits if observations.freedom * np.log(square / least_square) <= margin
    ]
    # a frequency within the search is preferred unless another is significantly better
    line = fitted if equivalent[0] is fitted else min(fits, key=lambda item: item[0])[1]
    return line, tuple(sorted(float(lines_fit.frequency[-1]) for lines_fit in equivalent if lines_fit is not line))


def _left(observations: Observations, lines: Lines) -> float:
    """Return the sum of squared residuals of the observations after fitting nuisance parameters and oscillations."""
    residual = observations.rest(observations.value - _predicted(observations, lines))
    return float(residual @ residual)


def _beside(observations: Observations, lines: Lines | None) -> Observations:
    """Return the observations with all parameters of the oscillations as additional nuisance parameters."""
    return observations if lines is None else observations.beside(_columns(observations, lines))


def _columns(observations: Observations, lines: Lines) -> Array:
    """Return the derivatives of R observations with respect to the P parameters of the oscillations, (R, P)."""
    design = np.zeros((len(observations.value), lines.covariance.shape[0]))
    for j in range(observations.time.shape[1]):
        design += np.einsum(
            "ra,rap->rp", observations.weight[:, j], lines.design(observations.time[:, j])[observations.group]
        )
    return design


def _predicted(observations: Observations, lines: Lines) -> Array:
    out = np.zeros(len(observations.value))
    for j in range(observations.time.shape[1]):
        out += np.sum(observations.weight[:, j] * lines.angles(observations.time[:, j])[observations.group], axis=1)
    return out


def _good(observations: Observations, lines: Lines | None) -> NDArray[np.bool_]:
    """Return a mask of the observations that nuisance parameters and oscillations explain within the noise.

    Either all or no observations of a ground point are used.
    """
    value = observations.value if lines is None else observations.value - _predicted(observations, lines)
    keep = np.ones(len(value), bool)
    for _ in range(_ROUNDS):
        nuisance = observations.taken(keep).nuisance
        x = np.linalg.lstsq(nuisance, value[keep], rcond=1e-10)[0] if nuisance.shape[1] else np.zeros(0)
        residual = np.abs(value - observations.nuisance @ x)
        worst = np.zeros(len(observations.time))
        np.maximum.at(worst, observations.group, residual)
        good = worst[observations.group] <= _FAR * max(robust_sigma(residual), 1e-300)
        if np.array_equal(good, keep):
            break
        keep = good
    return keep


def _fitted(observations: Observations, frequency: Array, p_value: Array) -> Lines:
    """Fit K oscillations together by Gauss-Newton from their start frequencies, in hertz.

    Raises
    ------
    JitterError
        Two lines cannot be separated, a line has no effect, or a fit leaves the neighbourhood of its start frequency.
    """
    axes, count, value = observations.axes, len(frequency), observations.rest(observations.value)
    f = frequency.copy()
    width = 1 + 2 * axes
    empty = np.zeros((count * width, count * width))
    for _ in range(_ROUNDS):
        waves = observations.rest(observations.waves(f)).reshape(len(value), -1)
        linear = np.asarray(np.linalg.lstsq(waves, value, rcond=None)[0], np.float64).reshape(count, 2, axes)
        lines = Lines(f, linear[:, 0], linear[:, 1], empty, p_value, observations.middle)
        design = observations.rest(_columns(observations, lines))
        size = np.linalg.norm(design, axis=0)
        if not np.all(size > 0.0):
            raise JitterError("a detected oscillation has no effect on the observations")
        residual = value - waves @ linear.ravel()
        u, s, vt = np.linalg.svd(design / size, full_matrices=False)
        if s[-1] < 1e-8 * s[0]:
            raise JitterError("two detected oscillations cannot be separated")
        step = (vt.T @ ((u.T @ residual) / s)) / size
        # limit the step to half a resolution element
        move = np.clip(step[::width], -0.5 / observations.span, 0.5 / observations.span)
        f = f + move
        if np.max(np.abs(move)) * observations.span < _ARRIVED:
            break
    if np.max(np.abs(f - frequency)) * observations.span > _ASTRAY:
        raise JitterError("a detected oscillation has no constant frequency")
    factor = float(residual @ residual) / max(observations.freedom - count * width, 1)
    spread = (vt.T / s**2) @ vt / size[:, None] / size
    return replace(lines, frequency=f, covariance=np.asarray(factor * spread))


@dataclass(frozen=True, eq=False)
class Course:
    """Attitude angles as functions of time (cubic splines), with the covariance of their coefficients.

    Attributes
    ----------
    knots : (K + 4,) ndarray
        Knots of the spline, in seconds.
    coefficients : (K, A) ndarray
        Coefficients of the K B-splines about each of A axes, in radians.
    covariance : (K A, K A) ndarray
        Covariance of the coefficients: all axes of the first B-spline, then of the next, in rad^2.
    """

    knots: Array
    coefficients: Array
    covariance: Array

    def basis(self, seconds: ArrayLike) -> Array:
        """Return the values of the K B-splines at T times within the knots, in seconds, as (T, K)."""
        return np.asarray(BSpline.design_matrix(np.asarray(seconds, np.float64), self.knots, 3).toarray())

    def at(self, seconds: ArrayLike) -> tuple[Array, Array]:
        """Return the attitude angles about A axes at T times, and their covariance.

        Angles are (T, A) in radians, covariances (T, A, A) in rad^2, times in seconds.
        """
        by = self.basis(seconds)
        axes = self.coefficients.shape[1]
        spread = self.covariance.reshape(by.shape[1], axes, by.shape[1], axes)
        return by @ self.coefficients, np.asarray(np.einsum("tk,kalb,tl->tab", by, spread, by, optimize=True))


def fit_spline(observations: Observations, interval: float, sigma: float) -> Course:
    """Estimate the attitude as a cubic spline with a prior on its size only, for jitter that is not sinusoidal.

    Components that differences between times do not determine, such as the mean and blind frequencies, keep the prior's
    variance.

    Parameters
    ----------
    observations : Observations
        Observations of the attitude.
    interval : float
        Spacing of the knots, in seconds; the spline does not contain periods shorter than two intervals.
    sigma : float
        A-priori standard deviation of a coefficient, in radians.

    Raises
    ------
    JitterError
        All observations have the same time, or the interval is not positive.
    """
    first, last = observations.ends
    if not last > first or not interval > 0.0:
        raise JitterError("a spline of the attitude needs distinct times and a positive interval")
    count = max(int(np.ceil((last - first) / interval)), 1)
    inner = np.linspace(first, last, count + 1)
    step = inner[1] - inner[0]
    knots = np.concatenate([first - step * np.arange(3, 0, -1), inner, last + step * np.arange(1, 4)])
    axes, splines = observations.axes, len(knots) - 4
    by = np.zeros((len(observations.value), splines, axes))
    for j in range(observations.time.shape[1]):
        values = BSpline.design_matrix(np.clip(observations.time[:, j], first, last), knots, 3).toarray()
        by += values[observations.group][:, :, None] * observations.weight[:, j, None]
    design = observations.rest(by.reshape(len(observations.value), -1))
    value = observations.rest(observations.value)
    normal = design.T @ design + np.eye(splines * axes) / sigma**2
    covariance = np.linalg.inv(normal)
    solved = np.asarray(covariance @ (design.T @ value), np.float64)
    return Course(knots, solved.reshape(splines, axes), np.asarray(covariance, np.float64))
