"""Statistics of the responses of a finished study: descriptions, noise shares, linear models and main effects."""

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
    """Return a unit as the report writes it, with typographic symbols."""
    return _SIGNS.get(unit, unit)


@dataclass(frozen=True, eq=False)
class Series:
    """Values of a factor or of a response, run by run.

    Attributes
    ----------
    name : str
        Name of the factor or response.
    unit : str
        Unit of the numbers, empty for pure numbers and texts.
    values : (runs,) ndarray
        Values as float64, NaN where there is none; text for some factors.
    """

    name: str
    unit: str
    values: np.ndarray

    @property
    def label(self) -> str:
        """Name of the factor or response with its unit, for the label of an axis."""
        return f"{self.name}, {typeset(self.unit)}" if self.unit else self.name

    @property
    def numeric(self) -> bool:
        """True if the values of the factor or response are numbers, not texts."""
        return self.values.dtype.kind == "f"

    @cached_property
    def levels(self) -> np.ndarray:
        """Distinct values of the factor or response, numbers in ascending order, texts in the order of the study."""
        distinct = np.unique(self.values)
        if self.numeric:
            return distinct
        first = [int(np.argmax(self.values == value)) for value in distinct]
        return np.asarray(distinct[np.argsort(first, kind="stable")])


@dataclass(frozen=True, eq=False)
class Factor(Series):
    """Factor of a study, an input that varies, with its value in each run.

    Attributes
    ----------
    spec : FactorSpec
        Distribution or list of its values.
    drawn : bool
        True if the values are drawn at random from it; those of a grid are not.
    """

    spec: FactorSpec
    drawn: bool = False


@dataclass(frozen=True, eq=False)
class Response(Series):
    """Response of a study, a result number, with its value in each run.

    Attributes
    ----------
    noise : (runs,) ndarray or None
        Standard deviation due to noise alone that each run reports; None if the runs report none.
    of : str
        For a reported standard deviation treated as a response, the response to which it belongs; empty for responses.
    """

    noise: np.ndarray | None = None
    of: str = ""

    @cached_property
    def good(self) -> np.ndarray:
        """True for each run whose value is a finite number, (runs,)."""
        return np.isfinite(self.values)

    @cached_property
    def known(self) -> np.ndarray:
        """Values of the response that are finite numbers, without those of failed runs."""
        return np.asarray(self.values[self.good])

    @cached_property
    def constant(self) -> bool:
        """True if the response has the same value in all runs, within rounding."""
        if len(self.known) == 0:
            return True
        # 64 units in the last place, the rounding error of sums over a few hundred terms
        return bool(np.ptp(self.known) <= 64.0 * np.finfo(float).eps * np.max(np.abs(self.known)))


@dataclass(frozen=True, eq=False)
class StudyRuns:
    """All runs of a study.

    Attributes
    ----------
    study : StudySpec
        Specification in the study's file.
    factors : tuple of Factor
        Factors in the study's order.
    responses : tuple of Response
        Responses in the study's order.
    sigmas : tuple of Response
        Standard deviations that the runs report for responses, if they are not all equal.
    failed : (runs,) ndarray of bool
        True for a run that failed.
    messages : tuple of str
        Reason of each failure, (runs,).
    doubts : tuple of str
        Reason why the reported sigma is not valid in a run, (runs,), empty where it is; an empty tuple for commands
        that report none.
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
        """Return the runs of a data set of ``twin.study.study_files.make_dataset``."""
        drawn = study.design.kind != GRID
        factors = tuple(
            Factor(name, str(data[name].attrs.get("units", "")), _factor_values(data[name].values), spec, drawn)
            for name, spec in study.factors.items()
        )
        responses, sigmas = [], []
        for name, response in study.responses.items():
            unit = str(data[name].attrs.get("units", ""))
            sigma_values = {ending: data[f"{name}{ending}"].values.astype(np.float64) for ending in response.sigma_keys}
            responses.append(Response(name, unit, data[name].values.astype(np.float64), sigma_values.get(NOISE)))
            reported = [Response(f"{name}{ending}", unit, sigma, None, name) for ending, sigma in sigma_values.items()]
            sigmas += [series for series in reported if not series.constant]
        messages = tuple(str(m) for m in data["message"].values.tolist()) if "message" in data else ()
        doubts = tuple(str(m) for m in data["doubt"].values.tolist()) if "doubt" in data else ()
        failed = data["failed"].values.astype(bool)
        return cls(study, factors, tuple(responses), tuple(sigmas), failed, messages, doubts)

    @property
    def count(self) -> int:
        """Number of runs of the study."""
        return len(self.failed)

    @property
    def kind(self) -> str:
        """Kind of the design: a grid, Latin hypercube, Sobol or Monte Carlo."""
        return self.study.design.kind

    @property
    def sampled(self) -> bool:
        """True if the runs are a random sample of the factors' distributions; those of a grid are not."""
        return self.kind != GRID

    @property
    def everything(self) -> tuple[Response, ...]:
        """All responses, followed by the standard deviations that the runs report for them."""
        return (*self.responses, *self.sigmas)

    @cached_property
    def axes(self) -> tuple[tuple[Factor, ...], ...]:
        """Groups of factors that vary independently: single factors, or the columns of one table."""
        by_name = {factor.name: factor for factor in self.factors}
        return tuple(tuple(by_name[name] for name in names) for names in axes_of(self.study))

    def find(self, name: str) -> Series:
        """Return a factor or response by its name."""
        series: Sequence[Series] = (*self.factors, *self.responses, *self.sigmas)
        return next(item for item in series if item.name == name)


def _factor_values(values: np.ndarray) -> np.ndarray:
    """Return a factor's values from the data set: numbers as float64, texts as text, and switches as "no" and "yes".

    Switches are 8-bit integers in the data set.
    """
    if values.dtype.kind in "OUS":
        return np.array([str(value) for value in values.tolist()], np.str_)
    if values.dtype.itemsize == 1:
        return np.where(values.astype(bool), "yes", "no")
    return np.asarray(values, np.float64)


CONFIDENCE = 0.95
"""Two-sided confidence level of all intervals in the report."""
LEAST = 20
"""Smallest number of runs for which distributions are tested and sensitivity indices computed."""
UNLIKELY = 0.01
"""p-value below which the test of normality rejects a normal distribution."""
TAILS = (0.00135, 0.99865)
"""Probabilities of the two reported extreme quantiles: those of a normal distribution at -3 and +3 sigma."""

Interval = tuple[float | None, float | None]


@dataclass(frozen=True)
class Estimate:
    """Number with its confidence interval.

    An end of the interval is None where the runs do not determine it.
    """

    value: float
    interval: Interval = (None, None)

    @property
    def half_width(self) -> float | None:
        """Half the width of the interval; None if an end is open."""
        low, high = self.interval
        return None if low is None or high is None else 0.5 * (high - low)


@dataclass(frozen=True)
class Normality:
    """Test of normality of D'Agostino and Pearson, by skewness and kurtosis.

    Attributes
    ----------
    skewness : float
        0 for a normal distribution; positive for a long upper tail.
    kurtosis : float
        Excess kurtosis, 0 for a normal distribution; positive for heavy tails.
    p : float
        p-value of the test.
    """

    skewness: float
    kurtosis: float
    p: float

    @property
    def normal(self) -> bool:
        """True if normality is not rejected."""
        return self.p >= UNLIKELY


@dataclass(frozen=True)
class Description:
    """Descriptive statistics of a response.

    Attributes
    ----------
    count : int
        Number of runs with a finite value.
    mean, std, median, p95, p997 : Estimate or None
        Estimates, with confidence intervals if the runs are a random sample; std with n - 1; None without runs.
    low, high : float or None
        Smallest and largest value.
    normality : Normality or None
        Test of normality; None if it is not tested.
    tails : tuple of float or None
        Quantiles at ``TAILS``; None if there are too few runs.
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
    """Return statistics of the finite values, with intervals and a test of normality for sampled runs.

    The intervals assume independent runs. Stratified designs (Latin hypercube, Sobol) determine the mean better, so
    that their intervals are conservative.

    Array dimensions: n runs.

    Parameters
    ----------
    values : (n,) ndarray
        Values of a response.
    sampled : bool
        True if the runs are drawn from distributions; those of a grid are not.
    """
    good = values[np.isfinite(values)]
    n = len(good)
    if n == 0:
        return Description(0)
    ordered = np.sort(good)
    median, p95, p997 = (
        Estimate(float(np.quantile(ordered, q)), quantile_interval(ordered, q) if sampled else (None, None))
        for q in (0.5, 0.95, 0.997)
    )
    std = None
    if n > 1:
        std = Estimate(float(np.std(good, ddof=1)), std_interval(good) if sampled else (None, None))
    enough = n * TAILS[0] >= 1.0
    mean = Estimate(float(np.mean(good)), mean_interval(good) if sampled else (None, None))
    tails = (float(np.quantile(ordered, TAILS[0])), float(np.quantile(ordered, TAILS[1]))) if enough else None
    shape = normality(good) if sampled else None
    return Description(n, mean, std, median, p95, p997, float(ordered[0]), float(ordered[-1]), shape, tails)


def mean_interval(values: np.ndarray) -> Interval:
    """Return Student's confidence interval of the mean of n values; its ends are unknown (None) for a single value."""
    n = len(values)
    if n < 2:
        return None, None
    half = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, n - 1) * np.std(values, ddof=1) / math.sqrt(n))
    mean = float(np.mean(values))
    return mean - half, mean + half


def std_interval(values: np.ndarray) -> Interval:
    """Return the confidence interval of the standard deviation of n values; None at both ends for n below four.

    The interval is symmetric in the logarithm, whose variance (k - (n-3)/(n-1)) / (4n) follows from the kurtosis k (3
    for a normal distribution) of the values; for a normal distribution it equals the chi-square interval for large n.
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
    """Return the distribution-free confidence interval of the quantile ``q``, from order statistics.

    Each end is exceeded with a probability of at most (1 - CONFIDENCE)/2; an end that n values do not reach is None.

    Parameters
    ----------
    values : (n,) ndarray
        Values of a response.
    q : float
        Probability of the quantile.
    """
    interval = stats.quantile_test(values, p=q).confidence_interval(CONFIDENCE)
    return (None if math.isnan(interval.low) else float(interval.low)), (
        None if math.isnan(interval.high) else float(interval.high)
    )


def runs_for_quantile(q: float) -> int:
    """Return the smallest number of runs for which the interval of the quantile ``q`` has both ends."""
    side = 0.5 * (1.0 - CONFIDENCE)
    # the largest of n lies below the quantile with q^n
    return math.ceil(math.log(side) / math.log(max(q, 1.0 - q)))


def normality(values: np.ndarray) -> Normality | None:
    """Test n values for normality; None for fewer than 20 values and for constant ones."""
    if len(values) < LEAST or np.ptp(values) == 0.0:
        return None
    p = float(stats.normaltest(values).pvalue)
    return Normality(float(stats.skew(values)), float(stats.kurtosis(values)), p)


FALSE_ALARM = 1e-6
"""Probability, for each response, that a correctly reported noise is rejected as impossibly large.

It is valid where noise causes all of the variance.
"""


@dataclass(frozen=True)
class NoiseShare:
    """Reported noise of a response relative to its variance over the runs.

    Attributes
    ----------
    response : str
        Name of the response.
    share : float
        Mean of the reported noise variances divided by the variance of the runs; slightly above 1 by chance if only
        noise varies.
    p_value : float
        p-value: probability of a variance over the runs as small as this one or smaller, if nothing but the reported
        noise varied.
    """

    response: str
    share: float
    p_value: float

    @property
    def possible(self) -> bool:
        """True if the reported noise is compatible with the variance of the runs."""
        return self.p_value >= FALSE_ALARM


def noise_share(response: Response, study: StudySpec) -> NoiseShare | None:
    """Return the fraction of a response's variance that its reported noise explains; None if that is not defined.

    It is not defined if no noise is reported, all runs share the same noise, or nothing varies. The sum of squares of
    independent normal noise has a chi-square distribution; where the noise differs between runs, its degrees of freedom
    are those of Satterthwaite, Biometrics Bulletin 2, 110 (1946).

    Parameters
    ----------
    response : Response
        Response with the noise that the runs report.
    study : StudySpec
        Study, which specifies whether runs share their noise.
    """
    # noise common to all runs does not contribute to their variance
    if response.noise is None or study.noise == "shared" or response.constant:
        return None
    variances = response.noise[response.good] ** 2
    variances = variances[np.isfinite(variances)]
    if len(variances) < 2 or not np.any(variances):
        return None
    share = float(np.mean(variances) / np.var(response.known, ddof=1))
    freedom = (len(variances) - 1) * float(np.mean(variances) ** 2 / np.mean(variances**2))
    return NoiseShare(response.name, share, float(stats.chi2.cdf(freedom / share, freedom)))


def impossible_noise(runs: StudyRuns) -> InputError | None:
    """Return an error about all responses whose reported noise exceeds their variance; None if there is none."""
    study = runs.study
    issues: list[Issue] = []
    for response in runs.responses:
        share = noise_share(response, study)
        if share is None or share.possible:
            continue
        key = study.responses[share.response].noise
        assert key is not None
        times = significant(share.share, 3)
        text = (
            f"the reported noise variance is {times} times the variance of all runs: not the noise of {share.response}"
        )
        remedy = "the standard deviation by noise alone, for readings the key that ends in _sigma_noise"
        error = study.error(text, ("responses", share.response, "noise"), value=key_text(key), allowed=remedy)
        issues += error.issues
    return InputError(*issues) if issues else None


@dataclass(frozen=True)
class Effect:
    """Effect of a factor on a response, by the linear model and by ranks.

    Attributes
    ----------
    factor : str
        Name of the factor.
    swing : Estimate
        Change of the response as the factor goes from its 5 % to its 95 % quantile, in the response's unit; for a text
        the largest minus the smallest mean of its values, at equal other factors. The quantiles are those of the
        factor's distribution where runs are drawn from it.
    coefficient : Estimate or None
        Standardised regression coefficient, in sigmas of the response per sigma of the factor; None for texts.
    rank : Estimate or None
        Spearman's rank correlation; None for texts.
    span : tuple
        The two quantiles of the factor, or for a text its values with the smallest and the largest mean.
    """

    factor: str
    swing: Estimate
    coefficient: Estimate | None
    rank: Estimate | None
    span: tuple[float | str, float | str]


@dataclass(frozen=True)
class LinearModel:
    """Least-squares fit of a response linear in all factors, without interactions.

    Attributes
    ----------
    r2 : float
        Coefficient of determination, 1 for a straight line without noise.
    adjusted : float
        Coefficient of determination adjusted for the number of terms.
    terms : int
        Number of coefficients, with the constant.
    effects : tuple of Effect
        Effect of each factor that varies, the largest swing first.
    cannot : tuple of str
        Names of factors whose effects the runs do not separate from those of other factors.
    """

    r2: float
    adjusted: float
    terms: int
    effects: tuple[Effect, ...]
    not_separable: tuple[str, ...] = ()


def linear_model(factors: Sequence[Factor], response: Response) -> LinearModel | None:
    """Fit the linear model of a response; None if the response is constant or there are too few runs.

    Intervals use the heteroscedasticity-consistent covariance HC3 of MacKinnon and White. Intervals of standardised
    coefficients also contain the scatter of the sampled factors and responses, by the sum over the runs of the
    influence of each on the coefficient. Collinear columns of the design matrix are excluded.

    Parameters
    ----------
    factors : sequence of Factor
        Factors of the study.
    response : Response
        Response to be fitted.
    """
    good = response.good
    y = response.values[good]
    n = len(y)
    if response.constant:
        return None
    blocks: list[tuple[Factor, np.ndarray]] = []
    not_separable = []
    design = np.ones((n, 1))
    for factor in factors:
        columns = _columns(factor, good)
        if columns.shape[1] == 0:
            continue
        joined = np.concatenate([design, columns], axis=1)
        if np.linalg.matrix_rank(joined / np.linalg.norm(joined, axis=0)) < joined.shape[1]:
            not_separable.append(factor.name)
            continue
        design = joined
        blocks.append((factor, columns))
    terms = design.shape[1]
    if not blocks or n < terms + 2:
        return None
    q, r = np.linalg.qr(design)
    coefficients = np.linalg.solve(r, q.T @ y)
    # rounding is no effect
    coefficients = np.where(np.abs(coefficients) < 1e-12 * np.std(y), 0.0, coefficients)
    rest = y - design @ coefficients
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
        rows = slice(first, first + columns.shape[1])
        first += columns.shape[1]
        effects.append(_effect(factor, good, y, coefficients[rows], bread[rows], t))
    effects.sort(key=lambda effect: -abs(effect.swing.value))
    adjusted = 1.0 - (1.0 - r2) * (n - 1) / (n - terms)
    return LinearModel(r2, adjusted, terms, tuple(effects), tuple(not_separable))


def _columns(factor: Factor, good: np.ndarray) -> np.ndarray:
    """Return a factor's columns of the design matrix, (n, m) for n runs: standardised numbers, or text indicators.

    A factor with texts has one column of 0 and 1 for each value but the first; one with numbers has a single column.
    """
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
    """Return the effect of a factor on a response from its coefficients in the linear model.

    Parameters
    ----------
    factor : Factor
        Factor.
    good : (runs,) ndarray of bool
        True for the n runs that are used.
    y : (n,) ndarray
        Response.
    coefficient : (m,) ndarray
        Coefficients of the factor's m columns of the design matrix.
    moved : (m, n) ndarray
        Influence of each run on each coefficient.
    t : float
        Quantile of Student's distribution for the confidence interval.
    """
    values = factor.values[good]
    if not factor.numeric:
        levels = [level for level in factor.levels if np.any(values == level)]
        means = np.concatenate([[0.0], coefficient])
        first, last = int(np.argmin(means)), int(np.argmax(means))
        ends = (str(levels[first]), str(levels[last]))
        return Effect(factor.name, _largest_difference(means, moved, t), None, None, ends)
    low, high = _span(factor, values)
    b, influence = float(coefficient[0]), moved[0]
    spread = float(np.std(y))
    # a standardised coefficient also depends on the standard deviations of the same runs
    widths = 0.5 * (((values - values.mean()) / values.std()) ** 2 - ((y - y.mean()) / spread) ** 2) / len(y)
    rank = float(stats.spearmanr(values, y).statistic)
    return Effect(
        factor.name,
        _estimate(b, influence, (high - low) / float(values.std()), t),
        _estimate(b, influence + b * widths, 1.0 / spread, t),
        Estimate(rank, _rank_interval(rank, len(y))),
        (low, high),
    )


def _span(factor: Factor, values: np.ndarray) -> tuple[float, float]:
    """Return the 5 % and 95 % quantiles of a factor: of its distribution if it is random, else of its values."""
    if factor.drawn:
        low, high = quantiles(factor.spec, np.array([0.05, 0.95]))
    else:
        low, high = np.quantile(values, (0.05, 0.95))
    return float(low), float(high)


def _largest_difference(means: np.ndarray, moved: np.ndarray, t: float) -> Estimate:
    """Return the largest difference between two of m means, with its confidence interval; the first mean is 0.

    ``means`` has the shape (m,). The interval covers all pairs simultaneously (Bonferroni), so that it remains valid
    for the largest.
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
    """Return Fisher's confidence interval of a rank correlation of n pairs.

    Its variance is that of Bonett and Wright, (1 + r^2/2)/(n - 3), with r the rank correlation.
    """
    if n < 10:
        return None, None
    if abs(rank) > 1.0 - 1e-12:
        return rank, rank
    z = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE))
    half = z * math.sqrt((1.0 + 0.5 * rank**2) / (n - 3))
    return math.tanh(math.atanh(rank) - half), math.tanh(math.atanh(rank) + half)


@dataclass(frozen=True, eq=False)
class MainEffect:
    """Mean of a response over the runs of a grid, for each of the m values of one factor.

    Attributes
    ----------
    factor : str
        Name of the factor.
    levels : (m,) ndarray
        Values of the factor.
    means : (m,) ndarray
        Mean of the response at each value.
    swing : float
        Largest minus smallest mean.
    """

    factor: str
    levels: np.ndarray
    means: np.ndarray
    swing: float


def main_effects(factors: Sequence[Factor], response: Response) -> tuple[MainEffect, ...]:
    """Return the main effects of the factors with at least two values, the largest swing first.

    Parameters
    ----------
    factors : sequence of Factor
        Factors of the study.
    response : Response
        Response of a grid.
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
