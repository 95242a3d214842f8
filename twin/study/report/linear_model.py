"""Linear model of a response: what each factor moves, and how much of the variance a straight line explains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from twin.study.report.study_statistics import CONFIDENCE, Estimate, Factor, Interval, Response
from twin.study.runs.plan import quantiles


@dataclass(frozen=True)
class Effect:
    """What a factor does to a response, by the linear model and by ranks.

    Attributes:
        factor: its name.
        swing: change of the response from the factor's 5% to its 95% quantile, in the response's unit; of a text the
            largest minus the smallest mean of its values, the other factors equal. The quantiles are those of the
            factor's distribution where runs are drawn from it.
        coefficient: standardised regression coefficient, sigmas of the response per sigma of the factor; None for
            texts.
        rank: Spearman's rank correlation; None for texts.
        span: the factor's quantiles, or for a text its values with the smallest and the largest mean.
    """

    factor: str
    swing: Estimate
    coefficient: Estimate | None
    rank: Estimate | None
    span: tuple[float | str, float | str]


@dataclass(frozen=True)
class LinearModel:
    """Least squares fit of a response by all factors together, each by itself, without products.

    Attributes:
        r2: share of the variance that it explains, 1 for a straight line without noise.
        adjusted: the same, corrected for the number of terms.
        terms: number of coefficients, the constant included.
        effects: of each factor that varies, the largest swing first.
        cannot: names of factors whose effects the runs do not separate.
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

    Args:
        factors: of the study.
        response: to be fitted.
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

    Attributes:
        factor: its name.
        levels: (m,) its values.
        means: (m,) mean of the response there.
        swing: largest minus smallest.
    """

    factor: str
    levels: np.ndarray
    means: np.ndarray
    swing: float


def main_effects(factors: Sequence[Factor], response: Response) -> tuple[MainEffect, ...]:
    """Main effects of the factors that take several values with numbers, the largest swing first.

    Args:
        factors: of the study.
        response: of a grid.
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
