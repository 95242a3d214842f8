"""Variance-based (Sobol) sensitivity indices, first order and total, with bases for polynomial chaos."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats
from scipy.special import roots_legendre

from twin.study.report.study_statistics import CONFIDENCE, LEAST, Estimate, Factor, Response, StudyRuns, noise_share

MOST_LEVELS = 20
"""Largest number of different text values of a factor for which sensitivity indices are computed."""


class _NoBasis(Exception):
    """Error that no polynomial basis can be made for a factor, with the reason as text."""


def axis_functions(axis: tuple[Factor, ...], good: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the orthonormal basis functions of an input axis at the runs, and their degrees.

    An axis is one factor, or several that vary together. Each function has mean 0 and mean square 1 under the axis'
    distribution, and different ones are orthogonal: Legendre polynomials for a uniform factor, Hermite polynomials for
    a normal one, Gram-Schmidt on the distribution itself for others, for lists and for texts. All functions of a text
    have degree 1.

    Parameters
    ----------
    axis : tuple of Factor
        Factors that vary together.
    good : (runs,) ndarray of bool
        True for the n runs that are used.
    degree : int
        Highest degree.

    Returns
    -------
    tuple of ndarray
        Values (n, m) of m functions at n runs, and their degrees (m,).

    Raises
    ------
    _NoBasis
        The axis has too many different texts.
    """
    if len(axis) == 1 and axis[0].numeric:
        return _of_number(axis[0], axis[0].values[good], degree)
    rows = np.stack([np.unique(factor.values, return_inverse=True)[1] for factor in axis], axis=1)
    levels, inverse, counts = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    if all(factor.numeric for factor in axis):
        # all rows of a table of numbers are equally likely, also those that no run has drawn
        table = np.stack([np.array(factor.spec.numbers().values, np.float64) for factor in axis], axis=1)
        return _of_table(table, np.stack([factor.values[good] for factor in axis], axis=1), degree)
    if len(levels) > MOST_LEVELS:
        raise _NoBasis(f"{axis[0].name} has {len(levels)} different values")
    weights = _text_weights(axis, levels, counts)
    # switches of all levels but the first, made orthonormal
    functions = _orthonormal(np.concatenate([np.ones((len(levels), 1)), np.eye(len(levels))[:, 1:]], axis=1), weights)
    return functions[inverse.ravel()[good], 1:], np.ones(functions.shape[1] - 1, int)


def _text_weights(axis: tuple[Factor, ...], levels: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the probability of every text value of a factor: its frequency in a list, or among the rows of a table."""
    if len(axis) == 1:
        listed = [_text(value) for value in axis[0].spec.scalars()]
        names = [str(value) for value in np.unique(axis[0].values)[levels[:, 0]]]
        frequencies = np.array([listed.count(name) for name in names], np.float64)
        if np.all(frequencies > 0):
            return np.asarray(frequencies / frequencies.sum())
    return np.asarray(counts / counts.sum())


def _text(value: object) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)


def _of_number(factor: Factor, values: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    numbers: tuple[float, ...] = factor.spec.numbers().values
    kind = factor.spec.kind
    orders = np.arange(1, degree + 1)
    if kind in ("range", "uniform"):
        x = (2.0 * values - numbers[0] - numbers[1]) / (numbers[1] - numbers[0])
        vander = np.polynomial.legendre.legvander(x, degree)[:, 1:]
        return vander * np.sqrt(2.0 * orders + 1.0), orders
    if kind == "normal":
        x = (values - numbers[0]) / numbers[1]
        scale = np.array([1.0 / math.sqrt(math.factorial(k)) for k in orders])
        return np.polynomial.hermite_e.hermevander(x, degree)[:, 1:] * scale, orders
    if kind == "truncated":
        mean, sigma, low, high = numbers
        # further out the density is below exp(-50) of its largest within the limits, which may lie far from the mean
        nearest = (min(max(mean, low), high) - mean) / sigma
        half_range = sigma * math.sqrt(nearest**2 + 100.0)
        low, high = max(low, mean - half_range), min(high, mean + half_range)
        nodes, weights = roots_legendre(200)
        points = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        z = (points - mean) / sigma
        weights = weights * np.exp(-0.5 * (z**2 - np.min(z**2)))
        return _by_recurrence(points, weights / weights.sum(), values, degree)
    if kind not in ("values", "table"):
        raise KeyError(f"there are no polynomials for a factor of kind {kind!r}")
    listed = np.array(numbers, np.float64)
    return _by_recurrence(listed, np.full(len(listed), 1.0 / len(listed)), values, degree)


def _by_recurrence(
    points: np.ndarray, weights: np.ndarray, values: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the orthonormal polynomials of a discrete measure at ``values``, by Stieltjes' recurrence."""
    middle, half_range = 0.5 * (points.max() + points.min()), 0.5 * np.ptp(points)
    if half_range == 0.0:
        return np.empty((len(values), 0)), np.empty(0, int)
    nodes, x = (points - middle) / half_range, (values - middle) / half_range
    most = min(degree, len(np.unique(nodes)) - 1)
    before, now = np.zeros(len(nodes)), np.ones(len(nodes))
    before_x, now_x = np.zeros(len(x)), np.ones(len(x))
    beta = 0.0
    out = []
    for _ in range(most):
        alpha = np.sum(weights * nodes * now**2)
        following = (nodes - alpha) * now - beta * before
        following_x = (x - alpha) * now_x - beta * before_x
        beta = math.sqrt(np.sum(weights * following**2))
        before, before_x = now, now_x
        now, now_x = following / beta, following_x / beta
        out.append(now_x)
    return np.stack(out, axis=1), np.arange(1, most + 1)


def _of_table(table: np.ndarray, values: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal polynomials of several columns of a table that vary together, at given values.

    They are orthonormal over the rows of the table.
    """
    middle, scale = table.mean(axis=0), np.maximum(np.ptp(table, axis=0), np.finfo(float).tiny)
    nodes, x = (table - middle) / scale, (values - middle) / scale
    powers = [p for p in np.ndindex(*[degree + 1] * table.shape[1]) if 0 < sum(p) <= degree]
    powers.sort(key=sum)
    basis, degrees = [np.ones(len(nodes))], [0]
    basis_x = [np.ones(len(x))]
    for power in powers:
        if len(basis) >= min(len(np.unique(nodes, axis=0)), 40):
            break
        f, f_x = np.prod(nodes**power, axis=1), np.prod(x**power, axis=1)
        size = math.sqrt(np.mean(f**2))
        for _ in range(2):  # twice is enough for orthogonality to rounding
            for g, g_x in zip(basis, basis_x, strict=True):
                part = np.mean(f * g)
                f, f_x = f - part * g, f_x - part * g_x
        norm = math.sqrt(np.mean(f**2))
        if norm > 1e-8 * size:
            basis.append(f / norm)
            basis_x.append(f_x / norm)
            degrees.append(sum(power))
    return np.stack(basis_x, axis=1)[:, 1:], np.array(degrees[1:], int)


def _orthonormal(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the columns of a matrix orthonormalised under the given weights; the first column must be constant."""
    root = np.sqrt(weights)[:, None]
    q, r = np.linalg.qr(columns * root)
    return np.asarray(q * np.sign(np.diag(r)) / root)


HIGHEST_DEGREE = 12
"""Highest total degree of the polynomials of a polynomial chaos model."""
MOST_TERMS = 250
"""Largest number of terms of a polynomial chaos model."""
MOST_RUNS = 20_000
"""Largest number of runs to which a polynomial chaos model is fitted."""
TINY = sys.float_info.min
"""Smallest positive normal float64, a lower limit for divisors so that none is zero."""
RUNS_TO_CHOOSE = 3_000
"""Largest number of runs used to select the polynomial degree; of more runs only the first ones are used."""
RUNS_PER_TERM = 2.5
"""Smallest number of runs per term of a polynomial chaos model."""
RESAMPLES = 1000
"""Number of bootstrap resamples for the confidence intervals of the indices."""
HARMONICS = 10
"""Number of harmonics whose power RBD-FAST (random balance designs) sums."""
MANY_FAILED = 0.05
"""Fraction of runs without a result above which the other runs do not represent the specified distributions."""
DISAGREE = 3.0
"""Distance from which the RBD-FAST index and the confidence interval of the polynomial chaos index disagree.

It is divided by the square root of the number of runs, and amounts to five standard deviations of RBD-FAST for smooth
responses of 100 to 300 runs.
"""


@dataclass(frozen=True)
class Index:
    """Sensitivity indices of an axis of the input space: one factor, or several that vary together.

    Attributes
    ----------
    factors : tuple of str
        Names of the factors that vary together, mostly one.
    first : Estimate
        First-order index: fraction of the variance that the axis explains alone.
    total : Estimate
        Total index: fraction of the variance that vanishes when the axis is fixed.
    check : float or None
        First-order index by RBD-FAST (random balance designs), which needs no model; None where it cannot be used.
    agrees : bool or None
        True if ``check`` lies within the interval of ``first``, apart from its noise; None without ``check``.
    """

    factors: tuple[str, ...]
    first: Estimate
    total: Estimate
    check: float | None = None
    agrees: bool | None = None

    @property
    def name(self) -> str:
        """Names of the factors that vary together, joined to one text."""
        return " + ".join(self.factors)


@dataclass(frozen=True)
class Indices:
    """Sensitivity indices of a response.

    Attributes
    ----------
    method : str
        ``chaos`` for polynomial chaos fitted to the runs, or ``grid`` for the exact decomposition of a complete grid.
    axes : tuple of Index
        Indices, the largest total first.
    degree : int
        Degree of the polynomials; 0 for a grid.
    terms : int
        Number of polynomials; 0 for a grid.
    held_out : float or None
        Leave-one-out cross-validated R²; None for a grid.
    rest : float
        Fraction of the variance that the model does not explain; 0 for a grid.
    noise : float or None
        Fraction of the variance due to the noise that the runs report; None if they report none. It may exceed 1 by
        chance where only noise varies.
    """

    method: str
    axes: tuple[Index, ...]
    degree: int
    terms: int
    held_out: float | None
    rest: float
    noise: float | None


@dataclass(frozen=True)
class NoIndices:
    """Result for a response whose sensitivity indices cannot be computed, with the reason as text."""

    reason: str


def sensitivity_indices(runs: StudyRuns, response: Response) -> Indices | NoIndices:
    """Compute the sensitivity indices of a response by the method that fits the design.

    No design of a study is Saltelli's, so that the indices are estimated from the available runs. The variance of a
    complete grid is decomposed exactly. Polynomial chaos is fitted to random designs (Sudret, Reliability Engineering
    and System Safety 93, 964, 2008); the partial variances are sums of its squared coefficients, corrected for their
    noise. The degree is selected by leave-one-out cross-validation. Intervals come from 1000 bootstrap resamples of the
    runs, for the selected terms; the unexplained variance, without the part that is reported noise, may be due to any
    factor and is added to the upper end of each. If a few runs have no result, the intervals are widened for any values
    within the range of the others; if many have none, the others do not follow the distributions of the factors, and
    there are no indices.

    Parameters
    ----------
    runs : StudyRuns
        Runs of the study.
    response : Response
        One of its responses or reported sigmas.
    """
    axes = [axis for axis in runs.axes if any(len(np.unique(f.values[response.good])) > 1 for f in axis)]
    if response.constant:
        return NoIndices("the response is constant")
    if not axes:
        return NoIndices("no factor varies")
    reported_noise = noise_share(response, runs.study)
    noise = None if reported_noise is None else reported_noise.share
    if not runs.sampled:
        if not np.all(response.good):
            return NoIndices("runs of the grid are missing, and its variance cannot be decomposed")
        return Indices("grid", _of_grid(axes, response.values), 0, 0, None, 0.0, noise)
    n = len(response.known)
    if n < LEAST:
        return NoIndices(f"{n} runs are too few; {LEAST} or more are needed")
    if runs.count - n > MANY_FAILED * runs.count:
        without = f"{runs.count - n} of {runs.count} runs have no number"
        return NoIndices(f"{without}, so that the others do not follow the distributions of the factors")
    good = response.good & (np.cumsum(response.good) <= MOST_RUNS)
    try:
        chaos = _Chaos.fitted(axes, good, response.values[good])
    except _NoBasis as error:
        return NoIndices(str(error))
    if chaos is None:
        return NoIndices(f"{n} runs are too few for {len(axes)} factors")
    noise_variance = 0.0 if noise is None else noise * float(np.var(response.known, ddof=1))
    indices = chaos.indices(noise_variance, runs.study.design.seed, ~response.good)
    return Indices("chaos", indices, chaos.degree, len(chaos.coefficients), chaos.held_out, chaos.rest, noise)


def _of_grid(axes: Sequence[tuple[Factor, ...]], values: np.ndarray) -> tuple[Index, ...]:
    """Return the exact sensitivity indices for a complete grid of runs, with all combinations equally likely."""
    total = float(np.var(values))
    out = []
    for k, axis in enumerate(axes):
        cells = _cells([axis])
        others = _cells([a for j, a in enumerate(axes) if j != k])
        first = _between(cells, values) / total
        whole = max(1.0 - _between(others, values) / total, 0.0) if len(axes) > 1 else 1.0
        out.append(Index(tuple(factor.name for factor in axis), Estimate(first), Estimate(whole)))
    return tuple(sorted(out, key=lambda index: -index.total.value))


def _cells(axes: Sequence[tuple[Factor, ...]]) -> np.ndarray:
    """Return for each run a number that identifies its combination of the factors' values, (runs,)."""
    factors = [factor for axis in axes for factor in axis]
    if not factors:
        return np.zeros(0, int)
    codes = np.stack([np.unique(factor.values, return_inverse=True)[1] for factor in factors], axis=1)
    return np.asarray(np.unique(codes, axis=0, return_inverse=True)[1]).ravel()


def _between(cells: np.ndarray, values: np.ndarray) -> float:
    """Return the variance, over the runs, of the mean value of each run's cell (combination of factor values)."""
    if len(cells) == 0:
        return 0.0
    counts = np.bincount(cells)
    means = np.bincount(cells, values - values.mean()) / counts
    return float(np.sum(counts * means**2) / len(values))


@dataclass(frozen=True, eq=False)
class _Chaos:
    """Polynomial chaos model fitted to the runs.

    Array dimensions: m terms, n runs.

    Attributes
    ----------
    terms : (m, axes) ndarray of int
        For each term the index of its basis function of each axis (group of factors), 0 for the constant.
    coefficients : (m,) ndarray
        Coefficients of the terms.
    q, r : ndarray
        QR decomposition of the design matrix (n, m + 1), whose first column is the constant.
    held_out : float
        Leave-one-out cross-validated R².
    rest : float
        Fraction of the variance that is not explained.
    """

    axes: Sequence[tuple[Factor, ...]]
    terms: np.ndarray
    coefficients: np.ndarray
    y: np.ndarray
    q: np.ndarray
    r: np.ndarray
    degree: int
    held_out: float
    rest: float
    good: np.ndarray

    @classmethod
    def fitted(cls, axes: Sequence[tuple[Factor, ...]], good: np.ndarray, y: np.ndarray) -> _Chaos | None:
        best: _Chaos | None = None
        all_functions = [axis_functions(axis, good, HIGHEST_DEGREE) for axis in axes]
        few = min(len(y), RUNS_TO_CHOOSE)
        functions = [(values[:few], degrees) for values, degrees in all_functions]
        tried: set[bytes] = set()
        for degree, norm in itertools.product(range(1, HIGHEST_DEGREE + 1), (0.5, 0.75, 1.0)):
            terms = _terms([degrees for _, degrees in functions], degree, norm, few)
            if terms is None or terms.tobytes() in tried:
                continue
            tried.add(terms.tobytes())
            model = cls._fit(axes, functions, terms, degree, y[:few], good)
            # more terms only if they reduce the cross-validation error by more than 2 %
            if model is not None and (best is None or 1.0 - model.held_out < 0.98 * (1.0 - best.held_out)):
                best = model
        if best is None or few == len(y):
            return best
        return cls._fit(axes, all_functions, best.terms, best.degree, y, good)

    @classmethod
    def _fit(
        cls,
        axes: Sequence[tuple[Factor, ...]],
        functions: Sequence[tuple[np.ndarray, np.ndarray]],
        terms: np.ndarray,
        degree: int,
        y: np.ndarray,
        good: np.ndarray,
    ) -> _Chaos | None:
        n, m = len(y), len(terms)
        columns = _columns([values for values, _ in functions], terms)
        q, r = np.linalg.qr(columns)
        size = np.abs(np.diag(r))
        if size.min() < 1e-6 * size.max():
            return None
        middle = y.mean()
        coefficients = np.linalg.solve(r, q.T @ (y - middle))
        residuals = y - middle - columns @ coefficients
        out = residuals / np.maximum(1.0 - np.sum(q**2, axis=1), 1e-9)
        spread = float(np.var(y))
        held_out = 1.0 - float(np.mean(out**2)) / spread
        rest = float(np.sum(residuals**2)) / (n - m - 1)
        total = float(np.sum(coefficients[1:] ** 2)) + rest
        return cls(axes, terms, coefficients[1:], y, q, r, degree, held_out, rest / total, good)

    def indices(self, noise: float, seed: int, missing: np.ndarray) -> tuple[Index, ...]:
        """Return the sensitivity indices of every axis (group of factors), the largest total index first.

        Parameters
        ----------
        noise : float
            Noise variance that the runs report, 0 if they report none.
        seed : int
            Seed of the bootstrap.
        missing : (runs,) ndarray of bool
            True for runs without a result.
        """
        shares = self._shares()
        ends = [
            np.quantile(samples, share, axis=0)
            for samples, share in zip(
                self._resampled(noise, seed), (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE), strict=True
            )
        ]
        if np.any(missing):
            ends = self._with_missing(ends[0], ends[1], missing)
        low, high = np.minimum(ends[0], shares), np.maximum(ends[1], shares)
        out = []
        for k, axis in enumerate(self.axes):
            alone, whole = (Estimate(float(shares[i, k]), (float(low[i, k]), float(high[i, k]))) for i in (0, 1))
            check, tolerance = _rbd_fast(axis, self.good, self.y), DISAGREE / math.sqrt(len(self.y))
            agrees = None if check is None else bool(low[0, k] - tolerance <= check <= high[0, k] + tolerance)
            out.append(Index(tuple(f.name for f in axis), alone, whole, check, agrees))
        return tuple(sorted(out, key=lambda index: -index.total.value))

    def _with_missing(self, low: np.ndarray, high: np.ndarray, missing: np.ndarray) -> list[np.ndarray]:
        """Widen confidence intervals (2, axes) to allow for runs without a result.

        Their results may lie anywhere in the range of the others.

        In N runs, a run whose response departs from the polynomials by d, and in which the terms of an axis sum to p,
        changes the variance due to that axis by 2 p d / N, and by at most d^2 / N in addition.
        """
        functions = [axis_functions(axis, missing, HIGHEST_DEGREE)[0] for axis in self.axes]
        terms = _columns(functions, self.terms)[:, 1:] * self.coefficients
        constant = float(np.mean(self.y - (self.q @ self.r)[:, 1:] @ self.coefficients))
        predicted = constant + terms.sum(axis=1)
        off = np.maximum(self.y.max() - predicted, predicted - self.y.min())
        used = self.terms > 0
        parts = np.stack([terms @ (used & (used.sum(axis=1) == 1)[:, None]), terms @ used])
        variance, runs = float(np.var(self.y)), len(missing)
        moved = 2.0 / runs * np.sum(np.abs(parts) * off[:, None], axis=1) / variance
        whole = 2.0 / runs * float(np.sum(np.abs(terms.sum(axis=1)) * off)) / variance
        added = float(np.sum(off**2)) / runs / variance
        lowest = np.maximum(low - moved, 0.0) / (1.0 + whole + added)
        return [lowest, np.minimum((high + moved + added) / max(1.0 - whole, TINY), 1.0)]

    def _parts(self, squares: np.ndarray) -> np.ndarray:
        """Return the sums of squared coefficients of each axis, alone and with its interactions, (..., 2, axes).

        ``squares`` holds the squared coefficients (..., m) of m terms. With interactions an axis explains no less than
        alone, although the noise correction may exceed the sum.
        """
        used = self.terms > 0
        alone = used & (used.sum(axis=1) == 1)[:, None]
        first = squares @ alone
        return np.stack([first, first + np.maximum(squares @ (used & ~alone), 0.0)], axis=-2)

    @cached_property
    def _fit_rest(self) -> tuple[np.ndarray, float]:
        """Leave-one-out residuals of the n runs, (n,), and the residual variance."""
        centred = self.y - self.y.mean()
        residuals = centred - self.q @ (self.q.T @ centred)
        rest = float(np.sum(residuals**2)) / (len(self.y) - len(self.terms) - 1)
        # rounding of a perfect fit
        rest = rest if rest >= 1e-20 * np.var(self.y) else 0.0
        return residuals / np.maximum(1.0 - np.sum(self.q**2, axis=1), 1e-9), rest

    @cached_property
    def _squares(self) -> np.ndarray:
        """Squared coefficients of the m terms, (m,), minus the coefficients' variances, by which they are biased."""
        inverse = np.linalg.inv(self.r)
        return np.asarray(self.coefficients**2 - np.sum(inverse**2, axis=1)[1:] * self._fit_rest[1])

    def _shares(self) -> np.ndarray:
        """Return the first-order and the total sensitivity index of each axis (group of factors), (2, axes)."""
        whole = max(float(np.sum(self._squares)), 0.0) + self._fit_rest[1]
        return np.clip(self._parts(self._squares) / whole, 0.0, 1.0)

    def _resampled(self, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return bootstrapped first-order and total indices, without and with the residual variance that is not noise.

        Both arrays have the shape (resamples, 2, axes). Runs, pairs of factor values and response, are resampled, so
        that coefficients and total variance vary as between studies. Each run is weighted by a Poisson variable of mean
        1; the coefficients change to first order by the leave-one-out influence of each run.
        """
        n, m = len(self.y), len(self.terms)
        out, rest = self._fit_rest
        # leave-one-out residuals also contain the prediction error between the runs
        held_out = float(np.mean(out**2)) if rest > 0.0 else 0.0
        # few runs know their own scatter badly: as Student's distribution is wider than the normal one
        wide = float(stats.t.ppf(0.975, n - m - 1) / stats.norm.ppf(0.975))
        influence = wide * (np.linalg.solve(self.r, self.q.T)[1:] * out).T
        spread = np.sum(influence**2, axis=0)
        generator = np.random.default_rng(np.random.SeedSequence(seed))
        # if few runs carry the residual variance (a narrow peak), their number has a Poisson distribution:
        # the effective number of such runs, and a gamma distribution for the expected number given it
        events = float(np.sum(out**2) ** 2 / np.sum(out**4)) if rest > 0.0 else 1.0
        lows, highs = [], []
        for _ in range(RESAMPLES // 100):
            more = generator.poisson(1.0, (100, n)) - 1.0
            moved = self.coefficients + more @ influence
            # centred on the estimate: the expected squares of the perturbations are subtracted
            squares = moved**2 - self.coefficients**2 - spread + self._squares
            unexplained = held_out * generator.gamma(events + 1.0, 1.0 / events, 100)
            whole = np.maximum(np.sum(squares, axis=-1), 0.0) + unexplained
            parts, whole = self._parts(squares), np.maximum(whole, TINY)[:, None, None]
            lows.append(np.clip(parts / whole, 0.0, 1.0))
            highs.append(np.clip((parts + np.maximum(unexplained - noise, 0.0)[:, None, None]) / whole, 0.0, 1.0))
        return np.concatenate(lows), np.concatenate(highs)


def _columns(functions: Sequence[np.ndarray], terms: np.ndarray) -> np.ndarray:
    """Return the design matrix (n, m + 1): a constant column, then the product of basis functions of each term.

    ``terms`` holds for each of m terms the index of its function of each axis; n is the number of runs.
    """
    columns = np.ones((len(functions[0]), len(terms) + 1))
    for k, values in enumerate(functions):
        used = terms[:, k] > 0
        columns[:, 1:][:, used] *= values[:, terms[used, k] - 1]
    return columns


def _terms(degrees: Sequence[np.ndarray], degree: int, norm: float, runs: int) -> np.ndarray | None:
    """Return the products of basis functions of limited degree; None if there are too many for the number of runs.

    A product is included if (sum d^norm)^(1/norm) <= degree, where d is the degree of its function of each axis
    (hyperbolic truncation). Each row holds the indices of the functions.
    """
    most = min(MOST_TERMS, int(runs / RUNS_PER_TERM))
    terms = []
    for term in _products(degrees, 0, degree**norm + 1e-9, norm):
        terms.append(term)
        if len(terms) > most + 1:
            return None
    return np.array(terms[1:], int)


def _products(degrees: Sequence[np.ndarray], axis: int, remaining: float, norm: float) -> Iterator[tuple[int, ...]]:
    if axis == len(degrees):
        yield ()
        return
    for k in range(len(degrees[axis]) + 1):
        spent = float(degrees[axis][k - 1]) ** norm if k else 0.0
        if spent <= remaining:
            for others in _products(degrees, axis + 1, remaining - spent, norm):
                yield (k, *others)


def _rbd_fast(axis: tuple[Factor, ...], good: np.ndarray, y: np.ndarray) -> float | None:
    """Return a factor's first-order index by random balance designs (SALib); None for texts, lists, few runs.

    Source: Tarantola, Gatelli and Mara, Reliability Engineering and System Safety 91, 717 (2006); bias correction of
    Tissot and Prieur, ibid. 107, 205 (2012).
    """
    factor = axis[0]
    # values that are equal have no order; the harmonics need some runs each
    if len(axis) > 1 or not factor.numeric or len(y) < 10 * HARMONICS or factor.spec.kind in ("values", "table"):
        return None
    # only studies that ask for indices need it
    from SALib.analyze import rbd_fast as method

    index = method.compute_first_order(method.permute_outputs(factor.values[good], y), HARMONICS)
    value = float(method.unskew_S1(index, HARMONICS, len(y)))
    return min(max(value, 0.0), 1.0) if math.isfinite(value) else None
