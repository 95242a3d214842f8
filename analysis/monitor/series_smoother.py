"""Filtered and smoothed changes of the cameras over a series of measurements, at any times.

The motions of the prior are a normal process: those of one law have the covariance rho(t, t') of that law in time, so
that shifts s and parameters p at two times have the covariances

    cov(s, s') = sum rho A C A',   cov(p, s') = sum rho B C A',   cov(p, p') = sum rho B C B',

sums over the laws. Changes are counted from the calibration, where nothing had moved, or from a reference time of the
same process; rho(t, t') is then rho(t, t') - rho(t, t0) - rho(t', t0) + rho(t0, t0). With the noise N of all shifts
together the Cholesky factor of S = cov(s, s') + N, in the order of time, whitens the shifts one after the other: u =
L^-1 s are the innovations of a Kalman filter, the parts of each shift that the shifts before it do not predict. The
estimate from the first n shifts is then the sum of the first n products

    p(t) = sum_n (L^-1 cov(s, p(t)))_n u_n,

filtered where the sum ends with the last shift up to t, smoothed where it includes all: the values and covariances of
the Kalman filter and of the Rauch-Tung-Striebel smoother, without their state space, and also for noise that is not
white in time (Kailath, Sayed, Hassibi, Linear Estimation, 2000, ch. 4; Rasmussen, Williams, Gaussian Processes for
Machine Learning, 2006, ch. 2). The sum of squares of u is the chi-square of the series.

Where the prior has jumps, these are searched for first (`jump_detection`), and those detected are events of the
process: steps of unknown size, between two measurements at an unknown time, so that sigma is wide there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from analysis.arrays import Array, UndeterminedError
from analysis.monitor import jump_detection
from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances, TimeLaw
from analysis.statistics import limit_of

Numbers = NDArray[np.int_]
LARGEST = 2400
"""Largest number of shifts in one factorisation, 46 MB: 300 times of two cameras.

A longer series is processed in sections of a third of that, each from its own measurements and as many before and after
it, so that its sigmas are those of the measurements used.
"""
_AT_ONCE = 64
"""Number of times whose covariances with all shifts are held in memory at once."""


class ShiftNoise(Protocol):
    """Interface of the noise of a series of spot shifts, which gives the joint covariance of any measurements."""

    def covariance(self, images: Numbers) -> Array:
        """Return the covariance of the shifts of some measurements, (n D, n D) px^2, one measurement after the other.

        Dimensions: n measurements, D spot coordinates (row and column of every spot).

        Parameters
        ----------
        images : (n,) ndarray of int
            Indices of the measurements in the order of the shifts.
        """
        ...


@dataclass(frozen=True, eq=False)
class SeriesChanges:
    """Changes of K cameras at T times.

    Attributes
    ----------
    values : (T, 4 K) ndarray
        Changes d_alpha, d_beta, d_gamma (rad), d_f (m) of one camera after the other.
    noise : (T, 4 K, 4 K) ndarray
        Covariance of the errors of `values` due to the noise of the shifts.
    total : (T, 4 K, 4 K) ndarray
        Covariance of the total error.
    """

    values: Array
    noise: Array
    total: Array


@dataclass(frozen=True, eq=False)
class SmoothedSeries:
    """Changes of all cameras over a series.

    Dimensions: M measurements.

    Attributes
    ----------
    filtered : SeriesChanges
        Changes from the measurements up to each time.
    smoothed : SeriesChanges
        Changes from all measurements.
    innovations : (M,) ndarray
        Chi-square of each measurement, in the order given, against its prediction by those before, each with D degrees
        of freedom.
    consistency : Consistency
        Test of the whole series.
    jumps : tuple of Jump or None
        Detected jumps in the order of time; None where the prior has no jumps. Filtered changes include them from their
        time on, as if they had been known then.
    """

    filtered: SeriesChanges
    smoothed: SeriesChanges
    innovations: Array
    consistency: Consistency
    jumps: tuple[jump_detection.Jump, ...] | None = None


@dataclass(frozen=True, eq=False)
class WhiteNoise:
    """Noise that is independent from measurement to measurement.

    Dimensions: D spot coordinates (row and column of every spot).

    Attributes
    ----------
    each : (D, D) ndarray
        Covariance of one measurement, px^2.
    """

    each: Array

    def covariance(self, images: Numbers) -> Array:
        """Return the (n D, n D) covariance of n measurements, px^2.

        Dimensions: D spot coordinates (row and column of every spot).
        """
        return np.asarray(np.kron(np.eye(len(images)), self.each), np.float64)


def _series(
    disturbances: Disturbances, measured: ArrayLike, shifts: ArrayLike, noise: ShiftNoise | Array
) -> tuple[Array, Numbers, Array, ShiftNoise]:
    """Check a series and return its ascending times, their order, its values and its noise."""
    when, values = np.asarray(measured, np.float64), np.asarray(shifts, np.float64)
    size = len(disturbances.spots)
    if when.ndim != 1 or values.shape != (len(when), size) or not len(when):
        raise ValueError(f"series: {when.shape} times need values ({when.size}, {size}), found {values.shape}")
    if not (np.all(np.isfinite(when)) and np.all(np.isfinite(values))):
        raise ValueError("series: times and values must be finite; exclude missing values")
    if not hasattr(noise, "covariance"):
        noise = np.asarray(noise, np.float64)
        if noise.shape != (size, size):
            raise ValueError(f"series: noise must be the covariance ({size}, {size}) of one time, found {noise.shape}")
        noise = WhiteNoise(noise)
    order = np.argsort(when, kind="stable")
    return when[order], order, values, noise


def window_of(values: int) -> int:
    """Return the number of measurements that are processed at once, so that memory is limited.

    Parameters
    ----------
    values : int
        Number of values (spot coordinates) in each measurement.
    """
    return max(3, LARGEST // values)


def smooth_series(
    disturbances: Disturbances,
    measured: ArrayLike,
    shifts: ArrayLike,
    noise: ShiftNoise | Array,
    times: ArrayLike,
    reference: float | None = None,
) -> SmoothedSeries:
    """Estimate the changes over a series of measurements, filtered and smoothed, at any times, with covariance.

    Dimensions: M measurements, D spot coordinates (row and column of every spot), T times, P parameters.

    Parameters
    ----------
    disturbances : Disturbances
        Prior on the motions and their covariance in time. Motions that may jump are searched for first.
    measured : (M,) array_like
        Times of the measurements, in seconds, in any order; equal times are repeated measurements of one state.
    shifts : (M, D) array_like
        Measured values, such as shifts of spots, in the units of ``disturbances.spots``.
    noise : (D, D) ndarray or ShiftNoise
        Covariance of one measurement, independent from time to time, or an object with the covariance of all.
    times : (T,) array_like
        Times at which changes are wanted, in seconds, in any order.
    reference : float, optional
        Time from which changes are counted, in seconds; by default they are counted from the calibration.

    Returns
    -------
    SmoothedSeries
        `filtered` and `smoothed`, each with `values` (T, P), `noise` and `total` covariances (T, P, P); `consistency`,
        the chi-square of the series; and `jumps`.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, correlated motions with different laws, or measurements
        without noise that repeat each other.

    Notes
    -----
    The values are those of a Kalman filter and of the Rauch-Tung-Striebel smoother (Kailath, Sayed and Hassibi, Linear
    Estimation, 2000, ch. 4), written as a Gaussian process.

    Examples
    --------
    A drift of one unit with a correlation time of 10 s, measured every second with a noise of 0.5 units:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(12)
    >>> time = np.arange(100.0)
    >>> law = analysis.TimeLaw(drift_s=10.0)
    >>> drift = np.linalg.cholesky(law.covariance(time[:, None], time)) @ rng.standard_normal(100)
    >>> prior = analysis.Disturbances.of([[1.0]], [[1.0]], [law])
    >>> values = drift[:, None] + 0.5 * rng.standard_normal((100, 1))
    >>> series = analysis.smooth_series(prior, time, values, np.array([[0.25]]), time)
    >>> sigma = np.sqrt(series.smoothed.total[50, 0, 0]), np.sqrt(series.filtered.total[50, 0, 0])
    >>> np.round(sigma, 2)
    array([0.32, 0.37])
    >>> error = series.smoothed.values[:, 0] - drift
    >>> round(float(np.sqrt(np.mean(error**2))), 2)
    0.32
    >>> series.consistency.agrees
    True
    """
    wanted = np.asarray(times, np.float64)
    when, order, shifts, noise = _series(disturbances, measured, shifts, noise)
    jumps = None
    if any(law.jump for law in disturbances.laws):
        jumps, disturbances = _Search(disturbances, when, shifts, noise, order, reference).jumps()
    model = _Process(disturbances, reference)
    width, count = len(disturbances.parameters), len(wanted)
    changes = {
        which: SeriesChanges(np.empty((count, width)), np.empty((count, width, width)), np.empty((count, width, width)))
        for which in ("filtered", "smoothed")
    }
    squares = np.empty(len(when))
    for piece, window in _pieces(len(when), window_of(shifts.shape[1])):
        indices = order[window]
        part = _Factor(model, when[window], shifts[indices], noise.covariance(indices))
        inside = slice(piece.start - window.start, piece.stop - window.start)
        squares[indices[inside]] = part.squares[inside]
        # times from the first of the piece to that of the next; those before all measurements belong to the first piece
        first = -np.inf if piece.start == 0 else when[piece.start]
        last = np.inf if piece.stop == len(when) else when[piece.stop]
        mine = np.flatnonzero((wanted >= first) & (wanted < last))
        for k in range(0, len(mine), _AT_ONCE):
            part.estimate(wanted, mine[k : k + _AT_ONCE], changes["filtered"], changes["smoothed"])
    degrees = shifts.size
    whole = Consistency(float(squares.sum()), degrees, float(limit_of(FALSE_ALARM, degrees)))
    return SmoothedSeries(changes["filtered"], changes["smoothed"], squares, whole, jumps)


def detect_jumps(
    disturbances: Disturbances,
    measured: ArrayLike,
    shifts: ArrayLike,
    noise: ShiftNoise | Array,
    reference: float | None = None,
) -> tuple[jump_detection.Jump, ...]:
    """Detect steps at unknown times in a series of measurements by generalised likelihood ratios.

    Dimensions: M measurements, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    disturbances : Disturbances
        Motions and their laws in time; those with ``TimeLaw(jump=True)`` may step. `jump_false_alarm` is the
        probability of detecting any step in a series without one.
    measured : (M,) array_like
        Times of the measurements, in seconds, in any order; equal times are repeated measurements of one state.
    shifts : (M, D) array_like
        Measured values, in the units of ``disturbances.spots``.
    noise : (D, D) ndarray or ShiftNoise
        Covariance of one measurement, independent from time to time, or an object with the covariance of all.
    reference : float, optional
        Time from which changes are counted, in seconds; by default they are counted from the calibration.

    Returns
    -------
    tuple of Jump
        Detected steps in the order of time, each with `body`, `sizes`, `sigmas`, and the times `after` and `until`
        between which it is most likely.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, or correlated motions with different laws.

    Notes
    -----
    Willsky and Jones, IEEE Trans. Automat. Contr. 21, 108 (1976); the false-alarm rate is bounded by Boole's inequality
    over all times and motions.

    Examples
    --------
    A step of 4 units between the measurements at 59 s and 60 s, beside a drift of one unit:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(13)
    >>> time = np.arange(100.0)
    >>> law = analysis.TimeLaw(drift_s=200.0)
    >>> drift = np.linalg.cholesky(law.covariance(time[:, None], time)) @ rng.standard_normal(100)
    >>> prior = analysis.Disturbances.of([[1.0, 3.0]], [[1.0, 3.0]], [law, analysis.TimeLaw(jump=True)])
    >>> noise = np.array([[0.25]])
    >>> values = drift[:, None] + 0.5 * rng.standard_normal((100, 1))
    >>> analysis.detect_jumps(prior, time, values, noise)
    ()
    >>> values[60:] += 4.0
    >>> (jump,) = analysis.detect_jumps(prior, time, values, noise)
    >>> jump.after, jump.until, round(3.0 * jump.sizes[0], 1), round(3.0 * jump.sigmas[0], 1)
    (59.0, 60.0, 3.2, 0.3)
    """
    when, order, values, errors = _series(disturbances, measured, shifts, noise)
    return _Search(disturbances, when, values, errors, order, reference).jumps()[0]


class _Search:
    """Search for jumps in a series.

    Dimensions: M measurements, D spot coordinates (row and column of every spot).

    Parameters
    ----------
    prior : Disturbances
        Prior of the motions with their laws in time.
    when : (M,) ndarray
        Times of the measurements, s, ascending.
    shifts : (M, D) ndarray
        Shifts in their original order, px.
    noise : ShiftNoise
        Noise of the shifts.
    order : (M,) ndarray of int
        Indices of the shifts in the order of time.
    reference : float or None
        Time from which changes are counted, s; None for the calibration.
    """

    def __init__(
        self,
        prior: Disturbances,
        when: Array,
        shifts: Array,
        noise: ShiftNoise,
        order: Numbers,
        reference: float | None,
    ) -> None:
        self.prior, self.when, self.shifts, self.noise, self.order = prior, when, shifts, noise, order
        self.reference, self.may = reference, jump_detection.candidates(prior)

    def jumps(self) -> tuple[tuple[jump_detection.Jump, ...], Disturbances]:
        """Return all detected jumps with their sizes, in the order of time, and the prior with these jumps."""
        detected = self._further([])
        if len(detected) > 1:
            # the first jumps were found without knowledge of the others
            for k in reversed(range(len(detected))):
                others = detected[:k] + detected[k + 1 :]
                again = self._look(others)
                detected = others if again is None else [*detected[:k], again, *detected[k + 1 :]]
            detected = self._further(detected)
        detected.sort(key=lambda jump: jump.until)
        model = jump_detection.with_jumps(self.prior, detected)
        if any(law.every_s is not None for law in self.prior.laws):
            all_steps = self._steps(model)
            looks = len(self.may) * sum(len(jump.until) for jump in all_steps)
            model = jump_detection.with_subthreshold_jumps(model, all_steps, self.prior, looks, float(self.when[-1]))
        return tuple(self._sized(jump, model) for jump in detected), model

    def _further(self, detected: list[jump_detection.Jump]) -> list[jump_detection.Jump]:
        while len(detected) < jump_detection.MOST and (jump := self._look(detected)) is not None:
            detected = [*detected, jump]
        return detected

    def _look(self, known: list[jump_detection.Jump]) -> jump_detection.Jump | None:
        """Return the most likely jump that is not known yet if it is significant; None otherwise."""
        jump = jump_detection.most_likely_jump(
            self._steps(jump_detection.with_jumps(self.prior, known)), self.may, self.prior
        )
        return jump if jump is not None and jump.false_alarm <= self.prior.jump_false_alarm else None

    def _steps(self, model: Disturbances) -> list[jump_detection.Steps]:
        return [
            jump_detection.steps(part.root, part.white, part.when, piece, self.reference)
            for part, piece in self._factors(model)
        ]

    def _sized(self, jump: jump_detection.Jump, model: Disturbances) -> jump_detection.Jump:
        for part, piece in self._factors(model):
            if jump.until in part.when[piece]:
                return jump_detection.with_sizes(jump, self.prior, part.root, part.white, part.when, self.reference)
        raise AssertionError(f"a jump at {jump.until} s is at no measurement")

    def _factors(self, model: Disturbances) -> Iterator[tuple[_Factor, slice]]:
        """Yield for each section of a series its factorised measurements, and the range in which it finds jumps."""
        process = _Process(model, self.reference)
        for piece, window in _pieces(len(self.when), window_of(self.shifts.shape[1])):
            indices = self.order[window]
            part = _Factor(process, self.when[window], self.shifts[indices], self.noise.covariance(indices))
            yield part, slice(piece.start - window.start, piece.stop - window.start)


def _pieces(count: int, window: int) -> Iterator[tuple[slice, slice]]:
    """Yield the consecutive sections of a series, and for each the wider range of measurements it is computed from."""
    if count <= window:
        yield slice(0, count), slice(0, count)
        return
    step = window // 3
    for start in range(0, count, step):
        stop = min(start + step, count)
        yield slice(start, stop), slice(max(0, start - step), min(count, stop + step))


class _Process:
    """Covariances over time of spot shifts and camera parameters under the prior's time laws."""

    def __init__(self, prior: Disturbances, reference: float | None) -> None:
        self.reference = reference
        self.parts: list[tuple[TimeLaw, Array, Array, Array]] = []
        laws = list(dict.fromkeys(prior.laws))
        for law in laws:
            follows_law = np.array([other == law for other in prior.laws])
            if np.any(prior.correlation[np.ix_(follows_law, ~follows_law)]):
                raise ValueError("smoother: motions with different laws in time cannot be correlated")
            spots, parameters = prior.spots[:, follows_law], prior.parameters[:, follows_law]
            correlation = prior.correlation[np.ix_(follows_law, follows_law)]
            across = parameters @ correlation
            self.parts.append((law, spots @ correlation @ spots.T, across @ spots.T, across @ parameters.T))

    def _covariance(self, law: TimeLaw, first_times: Array, second_times: Array) -> Array:
        """Return the covariance of motions with a time law between two sets of times, (n, m).

        Dimensions: n times of the first set, m times of the second set.
        """
        out = law.covariance(first_times[:, None], second_times)
        if self.reference is None:
            return out
        since, until = (law.covariance(times, self.reference) for times in (first_times, second_times))
        return np.asarray(out - since[:, None] - until + law.covariance(self.reference, self.reference))

    def shifts(self, times: Array) -> Array:
        """Return the prior covariance of the spot shifts in n measurements, (n D, n D) px^2.

        Dimensions: n measurements, D spot coordinates (row and column of every spot).
        """
        return _together([(self._covariance(law, times, times), spots) for law, spots, _, _ in self.parts])

    def across(self, times: Array, wanted: Array) -> Array:
        """Return the prior cross-covariance of spot shifts with camera parameters, (n D, m 4 K).

        Dimensions: n measurements, D spot coordinates (row and column of every spot), m wanted times, K cameras.
        """
        return _together([(self._covariance(law, times, wanted), cross.T) for law, _, cross, _ in self.parts])

    def parameters(self, wanted: Array) -> Array:
        """Return the prior covariance of the camera parameters at each time, (m, 4 K, 4 K).

        Dimensions: m wanted times, K cameras.
        """
        width = len(self.parts[0][3])
        out = np.zeros((len(wanted), width, width))
        for law, _, _, covariance in self.parts:
            share = law.covariance(wanted, wanted)
            if self.reference is not None:
                then = law.covariance(self.reference, self.reference)
                share = share + then - 2.0 * law.covariance(wanted, self.reference)
            out += share[:, None, None] * covariance
        return out


def _together(parts: list[tuple[Array, Array]]) -> Array:
    """Return the covariance of values at several times: sum over time laws of a Kronecker product.

    The factors are each law's covariance over time and its covariance over coordinates.
    """
    return np.asarray(sum(np.kron(time, block) for time, block in parts))


class _Factor:
    """Measurements of one window, transformed in the order of time to independent numbers of unit variance."""

    def __init__(self, process: _Process, when: Array, shifts: Array, noise: Array) -> None:
        self.process, self.when, self.each = process, when, shifts.shape[1]
        try:
            self.root = np.asarray(np.linalg.cholesky(process.shifts(when) + noise), np.float64)
        except np.linalg.LinAlgError as error:
            raise UndeterminedError("smoother: shifts that repeat the same information need noise") from error
        self.white = solve_triangular(self.root, shifts.ravel(), lower=True)
        self._noise = noise
        self.squares = np.sum(self.white.reshape(shifts.shape) ** 2, axis=1)

    @cached_property
    def noise(self) -> Array:
        """Covariance of the whitened shifts due to the noise of the shifts alone, (n D, n D).

        Dimensions: n measurements, D spot coordinates (row and column of every spot).
        """
        left = solve_triangular(self.root, self._noise, lower=True)
        return np.asarray(solve_triangular(self.root, left.T, lower=True))

    def estimate(self, times: Array, at: Numbers, filtered: SeriesChanges, smoothed: SeriesChanges) -> None:
        """Compute the filtered and smoothed camera changes at selected times and write them into the given results.

        Dimensions: T times.

        Parameters
        ----------
        times : (T,) ndarray
            All times, s.
        at : ndarray of int
            Indices of the times to process.
        filtered : SeriesChanges
            Filtered changes at all times, into which the results are written.
        smoothed : SeriesChanges
            Smoothed changes at all times, into which the results are written.
        """
        wanted = times[at]
        prior = self.process.parameters(wanted)
        weights = solve_triangular(self.root, self.process.across(self.when, wanted), lower=True)
        weights = weights.reshape(len(weights), len(wanted), -1)
        lengths = self.each * np.searchsorted(self.when, wanted, side="right")
        for k, number in enumerate(at):
            for last, out in ((lengths[k], filtered), (len(weights), smoothed)):
                weight = weights[:last, k]
                out.values[number] = weight.T @ self.white[:last]
                out.noise[number] = weight.T @ self.noise[:last, :last] @ weight
                out.total[number] = _positive(prior[k], weight.T @ weight)


def _positive(prior: Array, gained: Array) -> Array:
    """Return the prior covariance minus its reduction by measurements, without negative variances due to rounding."""
    size = np.sqrt(np.diag(prior))
    scale = np.where(size > 0.0, size, 1.0)
    left = (prior - gained) / scale[:, None] / scale
    values, vectors = np.linalg.eigh(0.5 * (left + left.T))
    if values[0] >= 0.0:
        return np.asarray(0.5 * (left + left.T) * scale[:, None] * scale)
    return np.asarray((vectors * np.clip(values, 0.0, None)) @ vectors.T * scale[:, None] * scale)
