"""Runs of a finished study, and statistics of each response with confidence intervals and its share of noise.

Linear model of a response: what each factor moves, and how much of the variance a straight line explains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from scipy import stats

from scenes.specs.study import GRID, NOISE, FactorSpec, StudySpec
from scenes.yaml.errors import InputError, Issue, key_text
from twin.framework.artefact import significant
from twin.study.runs.plan import axes_of, quantiles

_SIGNS = {"um": "µm", "us": "µs", "urad": "µrad", "percent": "%", "deg": "°"}


def typeset(unit: str) -> str:
    """A unit as the report writes it."""
    return _SIGNS.get(unit, unit)


@dataclass(frozen=True, eq=False)
class Series:
    """Values of a factor or of a response, run by run.

    Attributes
    ----------
    name : str
        Of it.
    unit : str
        Of the numbers, empty for pure numbers and texts.
    values : np.ndarray
        (runs,) float64, NaN where there is none; of some factors text.
    """

    name: str
    unit: str
    values: np.ndarray

    @property
    def label(self) -> str:
        """Name with unit."""
        return f"{self.name}, {typeset(self.unit)}" if self.unit else self.name

    @property
    def numeric(self) -> bool:
        """Whether the values are numbers."""
        return self.values.dtype.kind == "f"

    @cached_property
    def levels(self) -> np.ndarray:
        """The different values, numbers in order, texts in the order of the study."""
        found = np.unique(self.values)
        if self.numeric:
            return found
        first = [int(np.argmax(self.values == value)) for value in found]
        return np.asarray(found[np.argsort(first, kind="stable")])


@dataclass(frozen=True, eq=False)
class Factor(Series):
    """What was varied.

    Attributes
    ----------
    spec : FactorSpec
        Where the values come from.
    drawn : bool
        Whether the runs are drawn from it; those of a grid are not.
    """

    spec: FactorSpec
    drawn: bool = False


@dataclass(frozen=True, eq=False)
class Response(Series):
    """What came out.

    Attributes
    ----------
    noise : np.ndarray | None
        (runs,) the standard deviation by noise alone that each run states for it; None without.
    of : str
        Of a standard deviation that is looked at like a response: what it belongs to; empty for responses.
    """

    noise: np.ndarray | None = None
    of: str = ""

    @cached_property
    def good(self) -> np.ndarray:
        """(runs,) where there is a finite number."""
        return np.isfinite(self.values)

    @cached_property
    def known(self) -> np.ndarray:
        """The finite numbers."""
        return np.asarray(self.values[self.good])

    @cached_property
    def constant(self) -> bool:
        """Whether all numbers are the same, or differ by rounding."""
        if len(self.known) == 0:
            return True
        # 64 units in the last place: what sums over a few hundred terms lose
        return bool(np.ptp(self.known) <= 64.0 * np.finfo(float).eps * np.max(np.abs(self.known)))


@dataclass(frozen=True, eq=False)
class StudyRuns:
    """All runs of a study.

    Attributes
    ----------
    study : StudySpec
        As the user wrote it.
    factors : tuple[Factor, ...]
        What was varied, in the study's order.
    responses : tuple[Response, ...]
        What came out, in the study's order.
    sigmas : tuple[Response, ...]
        The standard deviations that the runs state for responses, where they are not all the same.
    failed : np.ndarray
        (runs,) bool.
    messages : tuple[str, ...]
        (runs,) why a run failed.
    doubts : tuple[str, ...]
        (runs,) why sigma does not hold in a run, empty where it does; none of commands that do not say so.
    """

    study: StudySpec
    factors: tuple[Factor, ...]
    responses: tuple[Response, ...]
    sigmas: tuple[Response, ...]
    failed: np.ndarray
    messages: tuple[str, ...]
    doubts: tuple[str, ...] = ()

    @classmethod
    def of(cls, data: xr.Dataset, study: StudySpec) -> StudyRuns:
        """The runs of a data set as ``twin.study.study_files.make_dataset`` makes it."""
        drawn = study.design.kind != GRID
        factors = tuple(
            Factor(name, str(data[name].attrs.get("units", "")), _factor_values(data[name].values), spec, drawn)
            for name, spec in study.factors.items()
        )
        responses, sigmas = [], []
        for name, response in study.responses.items():
            unit = str(data[name].attrs.get("units", ""))
            stated = {ending: data[f"{name}{ending}"].values.astype(np.float64) for ending in response.sigma_keys}
            responses.append(Response(name, unit, data[name].values.astype(np.float64), stated.get(NOISE)))
            own = [Response(f"{name}{ending}", unit, sigma, None, name) for ending, sigma in stated.items()]
            sigmas += [one for one in own if not one.constant]
        messages = tuple(str(m) for m in data["message"].values.tolist()) if "message" in data else ()
        doubts = tuple(str(m) for m in data["doubt"].values.tolist()) if "doubt" in data else ()
        failed = data["failed"].values.astype(bool)
        return cls(study, factors, tuple(responses), tuple(sigmas), failed, messages, doubts)

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.failed)

    @property
    def kind(self) -> str:
        """Kind of the design."""
        return self.study.design.kind

    @property
    def sampled(self) -> bool:
        """Whether the runs are a sample of distributions; those of a grid are not."""
        return self.kind != GRID

    @property
    def everything(self) -> tuple[Response, ...]:
        """Responses, then the stated standard deviations."""
        return (*self.responses, *self.sigmas)

    @cached_property
    def axes(self) -> tuple[tuple[Factor, ...], ...]:
        """Factors that vary independently: each alone, columns of one table together."""
        by_name = {factor.name: factor for factor in self.factors}
        return tuple(tuple(by_name[name] for name in names) for names in axes_of(self.study))

    def find(self, name: str) -> Series:
        """A factor or response by its name."""
        things: Sequence[Series] = (*self.factors, *self.responses, *self.sigmas)
        return next(thing for thing in things if thing.name == name)


def _factor_values(values: np.ndarray) -> np.ndarray:
    """Numbers as float64, texts as text; switches, which the data set holds as 8-bit numbers, as no and yes."""
    if values.dtype.kind in "OUS":
        return np.array([str(value) for value in values.tolist()], np.str_)
    if values.dtype.itemsize == 1:
        return np.where(values.astype(bool), "yes", "no")
    return np.asarray(values, np.float64)


CONFIDENCE = 0.95
"""Two-sided confidence of all intervals."""
LEAST = 20
"""With fewer runs no distribution is judged."""
UNLIKELY = 0.01
"""A distribution is called not normal when a normal one would give such a sample less often."""
TAILS = (0.00135, 0.99865)
"""Quantiles that lie at -3 and +3 sigma of a normal distribution."""

Interval = tuple[float | None, float | None]


@dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval; None for an end that the runs cannot tell."""

    value: float
    interval: Interval = (None, None)

    @property
    def half_width(self) -> float | None:
        """Half the interval, None without one."""
        low, high = self.interval
        return None if low is None or high is None else 0.5 * (high - low)


@dataclass(frozen=True)
class Normality:
    """D'Agostino and Pearson's test of skewness and kurtosis.

    Attributes
    ----------
    skewness : float
        0 for a normal distribution; + has its long tail above.
    kurtosis : float
        Excess, 0 for a normal distribution; + has heavy tails.
    p : float
        How often a normal distribution gives a sample that is as far from it.
    """

    skewness: float
    kurtosis: float
    p: float

    @property
    def normal(self) -> bool:
        """Whether nothing speaks against it."""
        return self.p >= UNLIKELY


@dataclass(frozen=True)
class Description:
    """Statistics of a response.

    Attributes
    ----------
    count : int
        Runs that have a number.
    mean, std, median, p95, p997 : Estimate | None
        With intervals where the runs were drawn; std with n - 1; None without runs.
    low : float | None
        Smallest value.
    high : float | None
        Largest value.
    normality : Normality | None
        None where it is not judged.
    tails : tuple[float, float] | None
        Quantiles at `TAILS`, None where too few runs reach there.
    """

    count: int
    mean: Estimate | None = None
    std: Estimate | None = None
    median: Estimate | None = None
    p95: Estimate | None = None
    p997: Estimate | None = None
    low: float | None = None
    high: float | None = None
    normality: Normality | None = None
    tails: tuple[float, float] | None = None


def describe(values: np.ndarray, sampled: bool) -> Description:
    """Statistics of the finite values, with intervals and a test of normality where the runs are a sample.

    The intervals take the runs as independent. Evenly spread designs (Latin hypercube, Sobol) know the mean better, so
    that theirs are on the safe side.

    Parameters
    ----------
    values : np.ndarray
        (n,) of a response.
    sampled : bool
        Whether the runs are drawn from distributions; those of a grid are not.
    """
    good = values[np.isfinite(values)]
    n = len(good)
    if n == 0:
        return Description(0)
    ordered = np.sort(good)
    quantiles = [
        Estimate(float(np.quantile(ordered, q)), quantile_interval(ordered, q) if sampled else (None, None))
        for q in (0.5, 0.95, 0.997)
    ]
    std = None
    if n > 1:
        std = Estimate(float(np.std(good, ddof=1)), std_interval(good) if sampled else (None, None))
    reach = n * TAILS[0] >= 1.0
    return Description(
        count=n,
        mean=Estimate(float(np.mean(good)), mean_interval(good) if sampled else (None, None)),
        std=std,
        median=quantiles[0],
        p95=quantiles[1],
        p997=quantiles[2],
        low=float(ordered[0]),
        high=float(ordered[-1]),
        normality=normality(good) if sampled else None,
        tails=(float(np.quantile(ordered, TAILS[0])), float(np.quantile(ordered, TAILS[1]))) if reach else None,
    )


def mean_interval(values: np.ndarray) -> Interval:
    """Student's interval of the mean of (n,) values; open for a single one."""
    n = len(values)
    if n < 2:
        return None, None
    half = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, n - 1) * np.std(values, ddof=1) / math.sqrt(n))
    mean = float(np.mean(values))
    return mean - half, mean + half


def std_interval(values: np.ndarray) -> Interval:
    """Interval of the standard deviation of (n,) values, n - 1.

    In the logarithm, with the variance (k - (n-3)/(n-1)) / (4n) that follows from the kurtosis k of the values; for a
    normal distribution it is that of chi-square for large n. Open below four values.
    """
    n = len(values)
    if n < 4:
        return None, None
    s = float(np.std(values, ddof=1))
    if s == 0.0:
        return 0.0, 0.0
    kurtosis = float(np.mean((values - np.mean(values)) ** 4) / np.var(values) ** 2)
    spread = math.sqrt(max(kurtosis - (n - 3) / (n - 1), 0.0) / (4.0 * n))
    factor = math.exp(float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE)) * spread)
    return s / factor, s * factor


def quantile_interval(values: np.ndarray, q: float) -> Interval:
    """Interval of the quantile ``q`` of any continuous distribution by order statistics of (n,) values.

    Each end is passed with a chance of (1 - CONFIDENCE)/2 at most; an end that n values do not reach is None.

    Parameters
    ----------
    values : np.ndarray
        (n,) of a response.
    q : float
        Share of the runs that lie below the quantile.
    """
    found = stats.quantile_test(values, p=q).confidence_interval(CONFIDENCE)
    return (None if math.isnan(found.low) else float(found.low)), (
        None if math.isnan(found.high) else float(found.high)
    )


def runs_for_quantile(q: float) -> int:
    """Number of runs from which on the interval of the quantile ``q`` has both ends."""
    side = 0.5 * (1.0 - CONFIDENCE)
    # the largest of n lies below the quantile with q^n
    return math.ceil(math.log(side) / math.log(max(q, 1.0 - q)))


def normality(values: np.ndarray) -> Normality | None:
    """Test of (n,) values; None for fewer than 20 and for constant ones."""
    if len(values) < LEAST or np.ptp(values) == 0.0:
        return None
    p = float(stats.normaltest(values).pvalue)
    return Normality(float(stats.skew(values)), float(stats.kurtosis(values)), p)


FALSE_ALARM = 1e-6
"""How often noise that is stated rightly, and all that varies, is called impossible; of a response."""


@dataclass(frozen=True)
class NoiseShare:
    """Noise against all that varies in a response.

    Attributes
    ----------
    response : str
        Its name.
    share : float
        Mean of the stated variances over the variance of the runs. By chance somewhat above 1 where nothing but noise
        varies.
    chance : float
        How often runs vary as little or less where the stated noise is all there is.
    """

    response: str
    share: float
    chance: float

    @property
    def possible(self) -> bool:
        """Whether the stated noise may be a part of what varies."""
        return self.chance >= FALSE_ALARM


def noise_share(response: Response, study: StudySpec) -> NoiseShare | None:
    """The share of a response, None where its noise is not stated, does not vary or nothing varies.

    Of independent normal noise the sum of squares is chi-square; where the runs differ in noise its degrees of freedom
    are those of Satterthwaite, Biometrics Bulletin 2, 110 (1946).

    Parameters
    ----------
    response : Response
        Whose noise the runs state.
    study : StudySpec
        Which says whether runs share their noise.
    """
    # noise that all runs have in common is a part of what they do not differ by
    if response.noise is None or study.noise == "shared" or response.constant:
        return None
    stated = response.noise[response.good] ** 2
    stated = stated[np.isfinite(stated)]
    if len(stated) < 2 or not np.any(stated):
        return None
    share = float(np.mean(stated) / np.var(response.known, ddof=1))
    freedom = (len(stated) - 1) * float(np.mean(stated) ** 2 / np.mean(stated**2))
    return NoiseShare(response.name, share, float(stats.chi2.cdf(freedom / share, freedom)))


def impossible(runs: StudyRuns) -> InputError | None:
    """What is wrong with noise that is more than all that varies, each at its key; None where all is possible."""
    study = runs.study
    issues: list[Issue] = []
    for response in runs.responses:
        one = noise_share(response, study)
        if one is None or one.possible:
            continue
        key = study.responses[one.response].noise
        assert key is not None
        times = significant(one.share, 3)
        text = f"states a variance of noise {times} times that of all runs: not the noise of {one.response}"
        remedy = "the standard deviation by noise alone, for readings the key that ends in _sigma_noise"
        found = study.error(text, ("responses", one.response, "noise"), found=key_text(key), allowed=remedy)
        issues += found.issues
    return InputError(*issues) if issues else None


@dataclass(frozen=True)
class Effect:
    """What a factor does to a response, by the linear model and by ranks.

    Attributes
    ----------
    factor : str
        Its name.
    swing : Estimate
        Change of the response from the factor's 5% to its 95% quantile, in the response's unit; of a text the largest
        minus the smallest mean of its values, the other factors equal. The quantiles are those of the factor's
        distribution where runs are drawn from it.
    coefficient : Estimate | None
        Standardised regression coefficient, sigmas of the response per sigma of the factor; None for texts.
    rank : Estimate | None
        Spearman's rank correlation; None for texts.
    span : tuple[float | str, float | str]
        The factor's quantiles, or for a text its values with the smallest and the largest mean.
    """

    factor: str
    swing: Estimate
    coefficient: Estimate | None
    rank: Estimate | None
    span: tuple[float | str, float | str]


@dataclass(frozen=True)
class LinearModel:
    """Least squares fit of a response by all factors together, each by itself, without products.

    Attributes
    ----------
    r2 : float
        Share of the variance that it explains, 1 for a straight line without noise.
    adjusted : float
        The same, corrected for the number of terms.
    terms : int
        Number of coefficients, the constant included.
    effects : tuple[Effect, ...]
        Of each factor that varies, the largest swing first.
    cannot : tuple[str, ...]
        Names of factors whose effects the runs do not separate.
    """

    r2: float
    adjusted: float
    terms: int
    effects: tuple[Effect, ...]
    cannot: tuple[str, ...] = ()


def linear_model(factors: Sequence[Factor], response: Response) -> LinearModel | None:
    """The model, None when the response is constant or there are too few runs for it.

    Intervals are those of White's covariance in MacKinnon and White's form HC3, which stays true when what the model
    leaves is not equally large everywhere. Of standardised coefficients they hold what the drawn factors and responses
    scatter by, too: sum over the runs of what each does to the coefficient. Columns of the matrix that follow from
    others are left out.

    Parameters
    ----------
    factors : Sequence[Factor]
        Of the study.
    response : Response
        To be fitted.
    """
    good = response.good
    y = response.values[good]
    n = len(y)
    if response.constant:
        return None
    blocks: list[tuple[Factor, np.ndarray]] = []
    cannot = []
    seen = np.ones((n, 1))
    for factor in factors:
        columns = _columns(factor, good)
        if columns.shape[1] == 0:
            continue
        joined = np.concatenate([seen, columns], axis=1)
        if np.linalg.matrix_rank(joined / np.linalg.norm(joined, axis=0)) < joined.shape[1]:
            cannot.append(factor.name)
            continue
        seen = joined
        blocks.append((factor, columns))
    terms = seen.shape[1]
    if not blocks or n < terms + 2:
        return None
    q, r = np.linalg.qr(seen)
    coefficients = np.linalg.solve(r, q.T @ y)
    # rounding is no effect
    coefficients = np.where(np.abs(coefficients) < 1e-12 * np.std(y), 0.0, coefficients)
    rest = y - seen @ coefficients
    leverage = np.minimum(np.sum(q**2, axis=1), 1.0 - 1e-9)
    bread = np.linalg.solve(r, q.T) * (rest / (1.0 - leverage))
    # rounding of a perfect fit
    bread = bread if float(np.std(rest)) > 1e-12 * float(np.std(y)) else 0.0 * bread
    t = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, n - terms))
    total = float(np.sum((y - y.mean()) ** 2))
    r2 = 1.0 - float(np.sum(rest**2)) / total
    effects = []
    first = 1
    for factor, columns in blocks:
        own = slice(first, first + columns.shape[1])
        first += columns.shape[1]
        effects.append(_effect(factor, good, y, coefficients[own], bread[own], t))
    effects.sort(key=lambda effect: -abs(effect.swing.value))
    adjusted = 1.0 - (1.0 - r2) * (n - 1) / (n - terms)
    return LinearModel(r2, adjusted, terms, tuple(effects), tuple(cannot))


def _columns(factor: Factor, good: np.ndarray) -> np.ndarray:
    """(n, m) columns of a factor: its number about the mean in sigmas, or for a text a switch per further value."""
    values = factor.values[good]
    if factor.numeric:
        span = np.ptp(values) if len(values) else 0.0
        return np.empty((len(values), 0)) if span == 0.0 else ((values - values.mean()) / values.std())[:, None]
    levels = [level for level in factor.levels if np.any(values == level)]
    switches = [(values == level).astype(np.float64) for level in levels[1:]]
    return np.stack(switches, axis=1) if switches else np.empty((len(values), 0))


def _effect(
    factor: Factor, good: np.ndarray, y: np.ndarray, coefficient: np.ndarray, moved: np.ndarray, t: float
) -> Effect:
    """``moved`` (m, n): what each run does to each coefficient; ``t`` of Student's distribution for one interval."""
    values = factor.values[good]
    if not factor.numeric:
        levels = [level for level in factor.levels if np.any(values == level)]
        means = np.concatenate([[0.0], coefficient])
        first, last = int(np.argmin(means)), int(np.argmax(means))
        ends = (str(levels[first]), str(levels[last]))
        return Effect(factor.name, _largest_difference(means, moved, t), None, None, ends)
    low, high = _span(factor, values)
    b, own = float(coefficient[0]), moved[0]
    spread = float(np.std(y))
    # a standardised coefficient moves with the sigmas of the runs, too, which belong to the same runs
    widths = 0.5 * (((values - values.mean()) / values.std()) ** 2 - ((y - y.mean()) / spread) ** 2) / len(y)
    rank = float(stats.spearmanr(values, y).statistic)
    return Effect(
        factor.name,
        _estimate(b, own, (high - low) / float(values.std()), t),
        _estimate(b, own + b * widths, 1.0 / spread, t),
        Estimate(rank, _rank_interval(rank, len(y))),
        (low, high),
    )


def _span(factor: Factor, values: np.ndarray) -> tuple[float, float]:
    """The 5% and 95% quantiles of a factor: of its distribution, which is known, where the runs are drawn from it."""
    if factor.drawn:
        low, high = quantiles(factor.spec, np.array([0.05, 0.95]))
    else:
        low, high = np.quantile(values, (0.05, 0.95))
    return float(low), float(high)


def _largest_difference(means: np.ndarray, moved: np.ndarray, t: float) -> Estimate:
    """Largest difference of two of (m,) means, the first of which is 0 by definition. The interval covers all pairs at
    once, after Bonferroni, so that it stays true although the largest is looked for.
    """
    moved = np.concatenate([np.zeros((1, moved.shape[1])), moved])
    first, last = np.triu_indices(len(means), 1)
    size = np.abs(means[last] - means[first])
    # as many times less often as there are pairs; in sigmas of a normal distribution about the one of Student's
    wide = t * float(stats.norm.isf(0.5 * (1.0 - CONFIDENCE) / len(size)) / stats.norm.isf(0.5 * (1.0 - CONFIDENCE)))
    half = wide * np.linalg.norm(moved[last] - moved[first], axis=1)
    return Estimate(float(np.max(size)), (max(float(np.max(size - half)), 0.0), float(np.max(size + half))))


def _estimate(value: float, moved: np.ndarray, scale: float, t: float) -> Estimate:
    half = t * math.sqrt(float(np.sum(moved**2)))
    return Estimate(scale * value, (scale * (value - half), scale * (value + half)))


def _rank_interval(rank: float, n: int) -> Interval:
    """Fisher's, with the variance (1 + r^2/2)/(n - 3) of Bonett and Wright for ranks."""
    if n < 10:
        return None, None
    if abs(rank) > 1.0 - 1e-12:
        return rank, rank
    z = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE))
    half = z * math.sqrt((1.0 + 0.5 * rank**2) / (n - 3))
    return math.tanh(math.atanh(rank) - half), math.tanh(math.atanh(rank) + half)


@dataclass(frozen=True, eq=False)
class MainEffect:
    """Means of a response over the runs of a grid, for each value of a factor.

    Attributes
    ----------
    factor : str
        Its name.
    levels : np.ndarray
        (m,) its values.
    means : np.ndarray
        (m,) mean of the response there.
    swing : float
        Largest minus smallest.
    """

    factor: str
    levels: np.ndarray
    means: np.ndarray
    swing: float


def main_effects(factors: Sequence[Factor], response: Response) -> tuple[MainEffect, ...]:
    """Main effects of the factors that take several values with numbers, the largest swing first.

    Parameters
    ----------
    factors : Sequence[Factor]
        Of the study.
    response : Response
        Of a grid.
    """
    out = []
    for factor in factors:
        parts = [(level, response.values[(factor.values == level) & response.good]) for level in factor.levels]
        parts = [(level, part) for level, part in parts if len(part)]
        if len(parts) < 2:
            continue
        means = np.array([part.mean() for _, part in parts])
        out.append(MainEffect(factor.name, np.array([level for level, _ in parts]), means, float(np.ptp(means))))
    return tuple(sorted(out, key=lambda effect: -effect.swing))
