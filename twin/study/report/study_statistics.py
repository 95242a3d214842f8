"""Runs of a finished study, and statistics of each response with confidence intervals and its share of noise."""

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
from twin.study.runs.plan import axes_of

_SIGNS = {"um": "µm", "us": "µs", "urad": "µrad", "percent": "%", "deg": "°"}


def typeset(unit: str) -> str:
    """A unit as the report writes it."""
    return _SIGNS.get(unit, unit)


@dataclass(frozen=True, eq=False)
class Series:
    """Values of a factor or of a response, run by run.

    Attributes:
        name: of it.
        unit: of the numbers, empty for pure numbers and texts.
        values: (runs,) float64, NaN where there is none; of some factors text.
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

    Attributes:
        spec: where the values come from.
        drawn: whether the runs are drawn from it; those of a grid are not.
    """

    spec: FactorSpec
    drawn: bool = False


@dataclass(frozen=True, eq=False)
class Response(Series):
    """What came out.

    Attributes:
        noise: (runs,) the standard deviation by noise alone that each run states for it; None without.
        of: of a standard deviation that is looked at like a response: what it belongs to; empty for responses.
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

    Attributes:
        study: as the user wrote it.
        factors: what was varied, in the study's order.
        responses: what came out, in the study's order.
        sigmas: the standard deviations that the runs state for responses, where they are not all the same.
        failed: (runs,) bool.
        messages: (runs,) why a run failed.
        doubts: (runs,) why sigma does not hold in a run, empty where it does; none of commands that do not say so.
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
            stated = {ending: data[f"{name}{ending}"].values.astype(np.float64) for ending in response.stated}
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
    """Statistics of the finite values, with intervals and a test of normality where the runs are a sample.

    The intervals take the runs as independent. Evenly spread designs (Latin hypercube, Sobol) know the mean better, so
    that theirs are on the safe side.

    Args:
        values: (n,) of a response.
        sampled: whether the runs are drawn from distributions; those of a grid are not.
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

    Args:
        values: (n,) of a response.
        q: share of the runs that lie below the quantile.
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

    Args:
        response: whose noise the runs state.
        study: which says whether runs share their noise.
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
