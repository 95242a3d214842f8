"""Statistics of one response over the runs that have a number, with confidence intervals, and its share of noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from scenes.specs.study import StudySpec
from scenes.yaml.errors import InputError, Issue, key_text
from twin.run.artefact import significant
from twin.study.report.study_runs import Response, StudyRuns

CONFIDENCE = 0.95
"""Of all intervals, two-sided."""
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

    Attributes:
        skewness: 0 for a normal distribution; + has its long tail above.
        kurtosis: excess, 0 for a normal distribution; + has heavy tails.
        p: how often a normal distribution gives a sample that is as far from it.
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

    Attributes:
        count: runs that have a number.
        mean, std, median, p95, p997: with intervals where the runs were drawn; std with n - 1; None without runs.
        low: smallest value.
        high: largest value.
        normality: None where it is not judged.
        tails: quantiles at `TAILS`, None where too few runs reach there.
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
    """Statistics of the finite ones of ``values`` (n,); intervals and normality only where the runs were ``drawn``.

    The intervals take the runs as independent. Evenly spread designs (Latin hypercube, Sobol) know the mean better, so
    that theirs are on the safe side.
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


def mean_interval(values: np.ndarray, confidence: float = CONFIDENCE) -> Interval:
    """Student's interval of the mean of (n,) values; open for a single one."""
    n = len(values)
    if n < 2:
        return None, None
    half = float(stats.t.ppf(0.5 + 0.5 * confidence, n - 1) * np.std(values, ddof=1) / math.sqrt(n))
    mean = float(np.mean(values))
    return mean - half, mean + half


def std_interval(values: np.ndarray, confidence: float = CONFIDENCE) -> Interval:
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
    factor = math.exp(float(stats.norm.ppf(0.5 + 0.5 * confidence)) * spread)
    return s / factor, s * factor


def quantile_interval(values: np.ndarray, q: float, confidence: float = CONFIDENCE) -> Interval:
    """Interval of the quantile ``q`` of any continuous distribution by order statistics of (n,) values.

    Each end is passed with a chance of (1 - confidence)/2 at most; an end that n values do not reach is None.
    """
    found = stats.quantile_test(values, p=q).confidence_interval(confidence)
    return (None if math.isnan(found.low) else float(found.low)), (
        None if math.isnan(found.high) else float(found.high)
    )


def runs_for_quantile(q: float, confidence: float = CONFIDENCE) -> int:
    """Number of runs from which on the interval of the quantile ``q`` has both ends."""
    side = 0.5 * (1.0 - confidence)
    # the largest of n lies below the quantile with q^n
    return math.ceil(math.log(side) / math.log(max(q, 1.0 - q)))


def share_interval(met: int, count: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Clopper and Pearson's interval of a share, ``met`` of ``count``."""
    if count == 0:
        return 0.0, 1.0
    side = 0.5 * (1.0 - confidence)
    low = float(stats.beta.ppf(side, met, count - met + 1)) if met > 0 else 0.0
    high = float(stats.beta.ppf(1.0 - side, met + 1, count - met)) if met < count else 1.0
    return low, high


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

    Attributes:
        response: its name.
        share: mean of the stated variances over the variance of the runs. By chance somewhat above 1 where nothing
            but noise varies.
        chance: how often runs vary as little or less where the stated noise is all there is.
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
