"""Variance-based sensitivity indices of Sobol, first order and total, and the orthonormal functions behind them."""

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
"""Texts with more values are not taken apart."""


class _NoBasis(Exception):
    """A factor for which no functions can be made; the text says why."""


def axis_functions(axis: tuple[Factor, ...], good: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Functions 1, 2, ... of the factors of an axis at the runs: values (n, m) and degrees (m,).

    Each has mean 0 and mean square 1 under the axis' distribution, and the mean product of two is 0: of a uniform
    factor Legendre's polynomials, of a normal one Hermite's, of others, lists and texts those that Gram and Schmidt's
    method makes on the distribution itself. All functions of a text have degree 1.

    Parameters
    ----------
    axis : tuple[Factor, ...]
        Factors that vary together.
    good : np.ndarray
        (runs,) which runs are used.
    degree : int
        The highest.

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
        # a table of numbers: all its rows are equally likely, also those that no run took
        table = np.stack([np.array(factor.spec.numbers().values, np.float64) for factor in axis], axis=1)
        return _of_table(table, np.stack([factor.values[good] for factor in axis], axis=1), degree)
    if len(levels) > MOST_LEVELS:
        raise _NoBasis(f"{axis[0].name} has {len(levels)} different values")
    weights = _text_weights(axis, levels, counts)
    # switches of all levels but the first, made orthonormal
    functions = _orthonormal(np.concatenate([np.ones((len(levels), 1)), np.eye(len(levels))[:, 1:]], axis=1), weights)
    return functions[inverse.ravel()[good], 1:], np.ones(functions.shape[1] - 1, int)


def _text_weights(axis: tuple[Factor, ...], levels: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Probability of every level: of a list by how often it holds it, of a table's rows as they were drawn."""
    if len(axis) == 1:
        listed = [_text(value) for value in axis[0].spec.scalars()]
        names = [str(value) for value in np.unique(axis[0].values)[levels[:, 0]]]
        found = np.array([listed.count(name) for name in names], np.float64)
        if np.all(found > 0):
            return np.asarray(found / found.sum())
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
        reach = sigma * math.sqrt(nearest**2 + 100.0)
        low, high = max(low, mean - reach), min(high, mean + reach)
        nodes, weights = roots_legendre(200)
        places = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        z = (places - mean) / sigma
        weights = weights * np.exp(-0.5 * (z**2 - np.min(z**2)))
        return _by_recurrence(places, weights / weights.sum(), values, degree)
    if kind not in ("values", "table"):
        raise KeyError(f"there are no polynomials for a factor of kind {kind!r}")
    listed = np.array(numbers, np.float64)
    return _by_recurrence(listed, np.full(len(listed), 1.0 / len(listed)), values, degree)


def _by_recurrence(
    places: np.ndarray, weights: np.ndarray, values: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal polynomials of a discrete measure at ``values``, by Stieltjes' recurrence."""
    middle, reach = 0.5 * (places.max() + places.min()), 0.5 * np.ptp(places)
    if reach == 0.0:
        return np.empty((len(values), 0)), np.empty(0, int)
    nodes, x = (places - middle) / reach, (values - middle) / reach
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
    """Polynomials of several columns that belong together, orthonormal over the rows of the table."""
    middle, reach = table.mean(axis=0), np.maximum(np.ptp(table, axis=0), np.finfo(float).tiny)
    nodes, x = (table - middle) / reach, (values - middle) / reach
    powers = [p for p in np.ndindex(*[degree + 1] * table.shape[1]) if 0 < sum(p) <= degree]
    powers.sort(key=sum)
    kept, degrees = [np.ones(len(nodes))], [0]
    kept_x = [np.ones(len(x))]
    for power in powers:
        if len(kept) >= min(len(np.unique(nodes, axis=0)), 40):
            break
        f, f_x = np.prod(nodes**power, axis=1), np.prod(x**power, axis=1)
        size = math.sqrt(np.mean(f**2))
        for _ in range(2):  # twice is enough for orthogonality to rounding
            for g, g_x in zip(kept, kept_x, strict=True):
                part = np.mean(f * g)
                f, f_x = f - part * g, f_x - part * g_x
        norm = math.sqrt(np.mean(f**2))
        if norm > 1e-8 * size:
            kept.append(f / norm)
            kept_x.append(f_x / norm)
            degrees.append(sum(power))
    return np.stack(kept_x, axis=1)[:, 1:], np.array(degrees[1:], int)


def _orthonormal(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Columns made orthonormal under the weights, the first one 1."""
    root = np.sqrt(weights)[:, None]
    q, r = np.linalg.qr(columns * root)
    return np.asarray(q * np.sign(np.diag(r)) / root)


HIGHEST_DEGREE = 12
MOST_TERMS = 250
MOST_RUNS = 20_000
TINY = sys.float_info.min
RUNS_TO_CHOOSE = 3_000
"""The degree is chosen by this many runs, the first ones."""
RUNS_PER_TERM = 2.5
RESAMPLES = 1000
HARMONICS = 10
"""Harmonics of the factor's cycle that RBD-FAST sums."""
MANY_FAILED = 0.05
"""Share of runs without a number beyond which the others say too little of the stated distributions."""
DISAGREE = 3.0
"""Over the root of the number of runs: distance of RBD-FAST's index from the interval of polynomial chaos at which they
disagree, five standard deviations of the former for smooth responses of 100 to 300 runs."""


@dataclass(frozen=True)
class Index:
    """Sensitivity to an axis.

    Attributes
    ----------
    factors : tuple[str, ...]
        Names of the factors that vary together, mostly one.
    first : Estimate
        Share of the variance that the axis explains alone.
    total : Estimate
        Share that is gone when the axis is fixed.
    check : float | None
        First order by RBD-FAST, which needs no model; None where it cannot be used.
    agrees : bool | None
        Whether that lies within the interval of ``first``, but for its noise; None without it.
    """

    factors: tuple[str, ...]
    first: Estimate
    total: Estimate
    check: float | None = None
    agrees: bool | None = None

    @property
    def name(self) -> str:
        """All of them."""
        return " + ".join(self.factors)


@dataclass(frozen=True)
class Indices:
    """Sensitivity indices of a response.

    Attributes
    ----------
    method : str
        ``chaos``, polynomial chaos fitted to the runs, or ``grid``, the exact parts of a complete grid.
    axes : tuple[Index, ...]
        The largest total first.
    degree : int
        Of the polynomials; 0 for a grid.
    terms : int
        Of them; 0 for a grid.
    held_out : float | None
        R2 of runs that the model was not fitted to, by leaving each out in turn; None for a grid.
    rest : float
        Share of the variance that the model does not explain; 0 for a grid.
    noise : float | None
        Share of the variance that the runs state as noise, as `noise_share`; None without. By chance above 1 where
        nothing else varies.
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
    """Why there are no indices."""

    reason: str


def sensitivity_indices(runs: StudyRuns, response: Response) -> Indices | NoIndices:
    """Indices of a response, by the method that fits the design.

    No design of a study is Saltelli's, so that the indices come from the given runs. A complete grid is its own
    distribution, whose variance is taken apart exactly. Of drawn designs polynomial chaos is fitted (Sudret,
    Reliability Engineering and System Safety 93, 964, 2008); the variances are sums of its squared coefficients, less
    what their noise adds. The degree is that with the smallest error of runs left out in turn. Intervals come from 1000
    resamples of the runs. They are those of the terms that were chosen; what these leave may belong to any factor, and
    counts for the upper end of each as far as the runs do not state it as noise. Where few runs have no number, the
    intervals reach as far as any numbers within the range of the others would move them; where many have none, the
    others have another distribution than the factors, and there are no indices.

    Parameters
    ----------
    runs : StudyRuns
        Of the study.
    response : Response
        One of its responses or stated sigmas.
    """
    axes = [axis for axis in runs.axes if any(len(np.unique(f.values[response.good])) > 1 for f in axis)]
    if response.constant:
        return NoIndices("the response is constant")
    if not axes:
        return NoIndices("no factor varies")
    stated = noise_share(response, runs.study)
    noise = None if stated is None else stated.share
    if not runs.sampled:
        if not np.all(response.good):
            return NoIndices("runs of the grid are missing, and its variance cannot be taken apart")
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
    own = 0.0 if noise is None else noise * float(np.var(response.known, ddof=1))
    found = chaos.indices(own, runs.study.design.seed, ~response.good)
    return Indices("chaos", found, chaos.degree, len(chaos.coefficients), chaos.held_out, chaos.rest, noise)


def _of_grid(axes: Sequence[tuple[Factor, ...]], values: np.ndarray) -> tuple[Index, ...]:
    """Exact parts of the variance of a complete grid, all combinations equally likely."""
    total = float(np.var(values))
    out = []
    for k, axis in enumerate(axes):
        own = _cells([axis])
        others = _cells([a for j, a in enumerate(axes) if j != k])
        out.append(
            Index(
                tuple(factor.name for factor in axis),
                Estimate(_between(own, values) / total),
                Estimate(max(1.0 - _between(others, values) / total, 0.0) if len(axes) > 1 else 1.0),
            )
        )
    return tuple(sorted(out, key=lambda index: -index.total.value))


def _cells(axes: Sequence[tuple[Factor, ...]]) -> np.ndarray:
    """(runs,) number of the combination of values that each run has."""
    factors = [factor for axis in axes for factor in axis]
    if not factors:
        return np.zeros(0, int)
    codes = np.stack([np.unique(factor.values, return_inverse=True)[1] for factor in factors], axis=1)
    return np.asarray(np.unique(codes, axis=0, return_inverse=True)[1]).ravel()


def _between(cells: np.ndarray, values: np.ndarray) -> float:
    """Variance of the means of the cells."""
    if len(cells) == 0:
        return 0.0
    counts = np.bincount(cells)
    means = np.bincount(cells, values - values.mean()) / counts
    return float(np.sum(counts * means**2) / len(values))


@dataclass(frozen=True, eq=False)
class _Chaos:
    """Polynomials fitted to the runs.

    Attributes
    ----------
    terms : np.ndarray
        Per coefficient but the constant: which function of each axis, (m, axes), 0 for none.
    coefficients : np.ndarray
        (m,) of them.
    q : np.ndarray
        (n, m + 1) orthonormal columns of the fit, r its triangle.
    rest_values
        (n,) what is left, each as if its run had been left out.
    rest : float
        Share of the variance that is left.
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
        every = [axis_functions(axis, good, HIGHEST_DEGREE) for axis in axes]
        few = min(len(y), RUNS_TO_CHOOSE)
        functions = [(values[:few], degrees) for values, degrees in every]
        seen: set[bytes] = set()
        for degree, norm in itertools.product(range(1, HIGHEST_DEGREE + 1), (0.5, 0.75, 1.0)):
            terms = _terms([degrees for _, degrees in functions], degree, norm, few)
            if terms is None or terms.tobytes() in seen:
                continue
            seen.add(terms.tobytes())
            found = cls._fit(axes, functions, terms, degree, y[:few], good)
            # a little better is not better: more terms only where they pay
            if found is not None and (best is None or 1.0 - found.held_out < 0.98 * (1.0 - best.held_out)):
                best = found
        if best is None or few == len(y):
            return best
        return cls._fit(axes, every, best.terms, best.degree, y, good)

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
        left = y - middle - columns @ coefficients
        out = left / np.maximum(1.0 - np.sum(q**2, axis=1), 1e-9)
        spread = float(np.var(y))
        held_out = 1.0 - float(np.mean(out**2)) / spread
        rest = float(np.sum(left**2)) / (n - m - 1)
        total = float(np.sum(coefficients[1:] ** 2)) + rest
        return cls(axes, terms, coefficients[1:], y, q, r, degree, held_out, rest / total, good)

    def indices(self, noise: float, seed: int, missing: np.ndarray) -> tuple[Index, ...]:
        """Indices of every axis, the largest total first.

        Parameters
        ----------
        noise : float
            Variance of the noise that the runs state, 0 where they state none.
        seed : int
            Of the resamples.
        missing : np.ndarray
            (runs,) which runs have no number.
        """
        shares = self._shares()
        ends = [
            np.quantile(some, share, axis=0)
            for some, share in zip(
                self._resampled(noise, seed), (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE), strict=True
            )
        ]
        if np.any(missing):
            ends = self._with_missing(ends[0], ends[1], missing)
        low, high = np.minimum(ends[0], shares), np.maximum(ends[1], shares)
        out = []
        for k, axis in enumerate(self.axes):
            alone, whole = (Estimate(float(shares[i, k]), (float(low[i, k]), float(high[i, k]))) for i in (0, 1))
            check, reach = _rbd_fast(axis, self.good, self.y), DISAGREE / math.sqrt(len(self.y))
            agrees = None if check is None else bool(low[0, k] - reach <= check <= high[0, k] + reach)
            out.append(Index(tuple(f.name for f in axis), alone, whole, check, agrees))
        return tuple(sorted(out, key=lambda index: -index.total.value))

    def _with_missing(self, low: np.ndarray, high: np.ndarray, missing: np.ndarray) -> list[np.ndarray]:
        """Ends of intervals (2, axes) that hold for any responses of the missing runs within the range of the others.

        A run of N that is off the polynomials by d, where these have the part p of an axis, changes the variance of the
        axis by 2 p d / N, and by d^2 / N at most beside it.
        """
        functions = [axis_functions(axis, missing, HIGHEST_DEGREE)[0] for axis in self.axes]
        terms = _columns(functions, self.terms)[:, 1:] * self.coefficients
        constant = float(np.mean(self.y - (self.q @ self.r)[:, 1:] @ self.coefficients))
        away = constant + terms.sum(axis=1)
        off = np.maximum(self.y.max() - away, away - self.y.min())
        used = self.terms > 0
        parts = np.stack([terms @ (used & (used.sum(axis=1) == 1)[:, None]), terms @ used])
        variance, runs = float(np.var(self.y)), len(missing)
        moved = 2.0 / runs * np.sum(np.abs(parts) * off[:, None], axis=1) / variance
        whole = 2.0 / runs * float(np.sum(np.abs(terms.sum(axis=1)) * off)) / variance
        added = float(np.sum(off**2)) / runs / variance
        lowest = np.maximum(low - moved, 0.0) / (1.0 + whole + added)
        return [lowest, np.minimum((high + moved + added) / max(1.0 - whole, TINY), 1.0)]

    def _parts(self, squares: np.ndarray) -> np.ndarray:
        """Sums of squared coefficients (..., m): of each axis alone, and of all terms with it, (..., 2, axes). Together
        with others an axis explains no less than alone, although what is taken off for noise may be more than is there.
        """
        used = self.terms > 0
        alone = used & (used.sum(axis=1) == 1)[:, None]
        first = squares @ alone
        return np.stack([first, first + np.maximum(squares @ (used & ~alone), 0.0)], axis=-2)

    @cached_property
    def _fit_rest(self) -> tuple[np.ndarray, float]:
        """What is left at each run as if it had been left out, (n,), and the variance of what is left."""
        centred = self.y - self.y.mean()
        left = centred - self.q @ (self.q.T @ centred)
        rest = float(np.sum(left**2)) / (len(self.y) - len(self.terms) - 1)
        # rounding of a perfect fit
        rest = rest if rest >= 1e-20 * np.var(self.y) else 0.0
        return left / np.maximum(1.0 - np.sum(self.q**2, axis=1), 1e-9), rest

    @cached_property
    def _squares(self) -> np.ndarray:
        """(m,) squared coefficients; each is too large by its variance, which is taken off."""
        inverse = np.linalg.inv(self.r)
        return np.asarray(self.coefficients**2 - np.sum(inverse**2, axis=1)[1:] * self._fit_rest[1])

    def _shares(self) -> np.ndarray:
        """First order and total indices, (2, axes)."""
        whole = max(float(np.sum(self._squares)), 0.0) + self._fit_rest[1]
        return np.clip(self._parts(self._squares) / whole, 0.0, 1.0)

    def _resampled(self, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Indices of resampled runs, (b, 2, axes) each: without what the model leaves, and with all of it that is not
        noise.

        Pairs are resampled, each run with its factors and its response, so that the coefficients and the whole variance
        vary as between studies: each run as often as a Poisson variable of mean 1 says, the coefficients to first order
        by what each run does to them when it is left out.
        """
        n, m = len(self.y), len(self.terms)
        out, rest = self._fit_rest
        # of runs that the terms were not fitted to: what they are wrong by elsewhere is in it
        held_out = float(np.mean(out**2)) if rest > 0.0 else 0.0
        # few runs know their own scatter badly: as Student's distribution is wider than the normal one
        wide = float(stats.t.ppf(0.975, n - m - 1) / stats.norm.ppf(0.975))
        each = wide * (np.linalg.solve(self.r, self.q.T)[1:] * out).T
        spread = np.sum(each**2, axis=0)
        generator = np.random.default_rng(np.random.SeedSequence(seed))
        # where few runs carry what is left (a narrow peak), chance decides how many do, as in Poisson's distribution;
        # the number that carry it equally, and the upper limit of what may be expected where so many were met
        events = float(np.sum(out**2) ** 2 / np.sum(out**4)) if rest > 0.0 else 1.0
        lows, highs = [], []
        for _ in range(RESAMPLES // 100):
            more = generator.poisson(1.0, (100, n)) - 1.0
            moved = self.coefficients + more @ each
            # about the estimate: the squares of what is added are taken off
            squares = moved**2 - self.coefficients**2 - spread + self._squares
            unexplained = held_out * generator.gamma(events + 1.0, 1.0 / events, 100)
            whole = np.maximum(np.sum(squares, axis=-1), 0.0) + unexplained
            parts, whole = self._parts(squares), np.maximum(whole, TINY)[:, None, None]
            lows.append(np.clip(parts / whole, 0.0, 1.0))
            highs.append(np.clip((parts + np.maximum(unexplained - noise, 0.0)[:, None, None]) / whole, 0.0, 1.0))
        return np.concatenate(lows), np.concatenate(highs)


def _columns(functions: Sequence[np.ndarray], terms: np.ndarray) -> np.ndarray:
    """Return the constant and the products of functions (n, m + 1) that terms (m, axes) name."""
    columns = np.ones((len(functions[0]), len(terms) + 1))
    for k, values in enumerate(functions):
        used = terms[:, k] > 0
        columns[:, 1:][:, used] *= values[:, terms[used, k] - 1]
    return columns


def _terms(degrees: Sequence[np.ndarray], degree: int, norm: float, runs: int) -> np.ndarray | None:
    """Products of functions whose degrees d fulfil (sum d^norm)^(1/norm) <= degree; None for too many of them."""
    most = min(MOST_TERMS, int(runs / RUNS_PER_TERM))
    found = []
    for term in _products(degrees, 0, degree**norm + 1e-9, norm):
        found.append(term)
        if len(found) > most + 1:
            return None
    return np.array(found[1:], int)


def _products(degrees: Sequence[np.ndarray], axis: int, left: float, norm: float) -> Iterator[tuple[int, ...]]:
    if axis == len(degrees):
        yield ()
        return
    for k in range(len(degrees[axis]) + 1):
        spent = float(degrees[axis][k - 1]) ** norm if k else 0.0
        if spent <= left:
            for others in _products(degrees, axis + 1, left - spent, norm):
                yield (k, *others)


def _rbd_fast(axis: tuple[Factor, ...], good: np.ndarray, y: np.ndarray) -> float | None:
    """First order index of a factor by random balance designs, as SALib has it; None for texts, lists and few runs.

    Source: Tarantola, Gatelli and Mara, Reliability Engineering and System Safety 91, 717 (2006); bias corrected as by
    Tissot and Prieur, the same 107, 205 (2012).
    """
    factor = axis[0]
    # values that are equal have no order; the harmonics need some runs each
    if len(axis) > 1 or not factor.numeric or len(y) < 10 * HARMONICS or factor.spec.kind in ("values", "table"):
        return None
    # only studies that ask for indices need it
    from SALib.analyze import rbd_fast as method

    found = method.compute_first_order(method.permute_outputs(factor.values[good], y), HARMONICS)
    value = float(method.unskew_S1(found, HARMONICS, len(y)))
    return min(max(value, 0.0), 1.0) if math.isfinite(value) else None
