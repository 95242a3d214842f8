"""Analysis of a study: Pareto fronts, requirements, convergence, and all numbers of the report."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.statistics import proportion_interval
from scenes.specs.study import ParetoSpec, ThresholdSpec
from twin.framework.record import Quantity, Record
from twin.study.report import study_statistics as statistics
from twin.study.report.sensitivity_indices import Index, Indices, NoIndices, sensitivity_indices
from twin.study.report.study_statistics import Estimate, Response, StudyRuns


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """Non-dominated runs for a pair of quantities (factors or responses) that are both to be optimised.

    Array dimensions: m runs on the front, n runs.

    Attributes
    ----------
    spec : ParetoSpec
        The pair and the preferred direction of each.
    runs : (m,) ndarray of int
        Numbers of the runs on the front, from the best x to the best y.
    x, y : (m,) ndarray
        Values of the pair in these runs.
    ranks : (n,) ndarray of int
        Rank of every run: 0 on the front, 1 on the front of the remaining runs, and so on; -1 without numbers.
    knee : int or None
        Index into ``runs`` of the knee, the point farthest from the line between the ends; None if there is none.
    """

    spec: ParetoSpec
    runs: np.ndarray
    x: np.ndarray
    y: np.ndarray
    ranks: np.ndarray
    knee: int | None


def pareto_front(spec: ParetoSpec, x: np.ndarray, y: np.ndarray) -> ParetoFront:
    """Return the Pareto front of a pair of quantities, whose values in n runs are ``x`` and ``y``.

    Parameters
    ----------
    spec : ParetoSpec
        The pair and the preferred direction of each.
    x, y : (n,) ndarray
        Values of all runs.
    """
    good = np.isfinite(x) & np.isfinite(y)
    signs = {"min": 1.0, "max": -1.0}
    costs = np.stack([signs[spec.best_x] * x, signs[spec.best_y] * y], axis=-1)
    ranks = np.full(len(x), -1)
    ranks[good] = ranks_of(costs[good])
    front = np.flatnonzero(ranks == 0)
    front = front[np.lexsort((front, costs[front, 1], costs[front, 0]))]
    return ParetoFront(spec, front, x[front], y[front], ranks, knee(costs[front]))


def ranks_of(costs: np.ndarray) -> np.ndarray:
    """Return the Pareto rank (n,) of each run from its two costs (n, 2), by non-dominated sorting.

    Rank 0 holds the points that no other point dominates, rank 1 those that only points of rank 0 dominate, and so on.
    Equal points share a rank.

    Array dimensions: n runs.
    """
    order = np.lexsort((costs[:, 1], costs[:, 0]))
    ranks = np.empty(len(costs), np.int64)
    # smallest second cost of every front so far; it rises with the rank, so that bisection finds the front
    lowest: list[float] = []
    before: tuple[float, float] | None = None
    rank = 0
    for k in order:
        point = (float(costs[k, 0]), float(costs[k, 1]))
        if point != before:
            # a front with a second cost that is not larger holds a point that dominates this one
            rank = bisect_right(lowest, point[1])
            if rank == len(lowest):
                lowest.append(point[1])
            else:
                lowest[rank] = point[1]
            before = point
        ranks[k] = rank
    return ranks


def knee(costs: np.ndarray) -> int | None:
    """Return the index of the point of a Pareto front (m, 2) that lies farthest below the line through its ends.

    The front is sorted by the first cost, and both costs are scaled to its range. None for fewer than three different
    points, or if no point lies below the line by more than rounding.

    Array dimensions: m points.
    """
    if len(np.unique(costs, axis=0)) < 3:
        return None
    span = np.ptp(costs, axis=0)
    scaled = (costs - costs.min(axis=0)) / span
    # the ends are (0, 1) and (1, 0)
    gain = 1.0 - scaled.sum(axis=1)
    best = int(np.argmax(gain))
    return best if gain[best] > 1e-9 else None


@dataclass(frozen=True)
class Requirement:
    """Result of a requirement: how many runs of the study meet it.

    Attributes
    ----------
    name : str
        Name of the requirement; empty for all of them together.
    text : str
        The requirement as text.
    met : int
        Number of runs that meet it.
    count : int
        Number of runs with a finite value.
    runs : int
        Number of all runs, also those without a value.
    interval : tuple of float or None
        Confidence interval of the fraction that meets it, among runs with a value, in a random design; None in a grid.
    judged : Description or None
        Statistics of the response or its absolute value; None for all requirements together.
    unit : str
        Unit of the response.
    """

    name: str
    text: str
    met: int
    count: int
    runs: int
    interval: tuple[float, float] | None
    judged: statistics.Description | None
    unit: str

    @property
    def share(self) -> float | None:
        """Fraction of the runs with a value that meet the requirement; None if no run has a value."""
        return self.met / self.count if self.count else None

    @property
    def most(self) -> int:
        """Number of runs that would meet the requirement if all runs without a value did."""
        return self.met + self.runs - self.count

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Smallest and largest possible fraction of all runs that meet the requirement; None if all have a value.

        At these limits none, or all, of the runs without a value meet it. Failure may be correlated with the value that
        a run would have given, so that the confidence interval of the other runs does not hold for all runs.
        """
        return None if self.count == self.runs else (self.met / self.runs, self.most / self.runs)

    @property
    def bounds_interval(self) -> tuple[float, float] | None:
        """Confidence interval of the fraction that meets the requirement, whatever the runs without a value would give.

        It reaches from the lower confidence limit of the smallest possible fraction to the upper one of the largest;
        None in a grid.
        """
        if self.bounds is None or (self.interval is None and self.count):
            return None
        (low, _), (_, high) = (
            proportion_interval(met, self.runs, statistics.CONFIDENCE) for met in (self.met, self.most)
        )
        return low, high


def _is_met(spec: ThresholdSpec, values: np.ndarray) -> np.ndarray:
    """Return True where a value meets the requirement, (n,); NaN does not.

    Array dimensions: n runs.
    """
    judged = np.abs(values) if spec.magnitude else values
    good = np.isfinite(judged)
    if spec.at_most is not None:
        good &= judged <= spec.at_most
    if spec.at_least is not None:
        good &= judged >= spec.at_least
    return np.asarray(good)


def requirements(runs: StudyRuns) -> tuple[Requirement, ...]:
    """Return the results of all requirements of a study and, if there are several, of all together."""
    everything, known = np.ones((2, runs.count), bool)
    rows: list[tuple[str, str, np.ndarray, np.ndarray, statistics.Description | None, str]] = []
    for name, spec in runs.study.report.thresholds.items():
        response = runs.find(spec.response)
        assert isinstance(response, Response)
        good = _is_met(spec, response.values)
        everything &= good
        known &= response.good
        values = np.abs(response.values) if spec.magnitude else response.values
        description = statistics.describe(values, runs.sampled)
        rows.append((name, _text(spec), good, response.good, description, response.unit))
    if len(rows) > 1:
        rows.append(("", "all of them", everything, known, None, ""))
    out = []
    for name, text, good, finite, judged, unit in rows:
        met, count = int(np.sum(good & finite)), int(np.sum(finite))
        interval = proportion_interval(met, count, statistics.CONFIDENCE) if runs.sampled and count else None
        out.append(Requirement(name, text, met, count, runs.count, interval, judged, unit))
    return tuple(out)


def _text(spec: ThresholdSpec) -> str:
    name = f"|{spec.response}|" if spec.magnitude else spec.response
    low = f"{spec.at_least:g} ≤ " if spec.at_least is not None else ""
    high = f" ≤ {spec.at_most:g}" if spec.at_most is not None else ""
    return f"{low}{name}{high}"


QUANTILES = {"p95": 0.95, "p99.7": 0.997}
"""Name of each quantile whose convergence is reported -> its probability."""
GOALS = {"mean": 0.1, "sigma": 0.1, "p95": 0.2, "p99.7": 0.2}
"""Statistic -> half-width of its 95 % interval, in units of sigma, below which it is considered well determined."""


@dataclass(frozen=True)
class Convergence:
    """Accuracy of a statistic of the runs.

    Attributes
    ----------
    name : str
        ``mean``, ``sigma``, ``p95`` or ``p99.7``.
    relative : float or None
        Half-width of the confidence interval in units of sigma; None if it is open.
    enough : bool
        True if ``relative`` is below the goal.
    needed : int or None
        Approximate number of runs that reaches the goal; None if it cannot be estimated.
    """

    name: str
    relative: float | None
    enough: bool
    needed: int | None


def convergences(values: np.ndarray) -> tuple[Convergence, ...]:
    """Return the accuracy of the statistics of (n,) finite values; none below 20 runs and for constant values.

    Array dimensions: n runs.
    """
    n = len(values)
    if n < 20 or np.ptp(values) == 0.0:
        return ()
    about, sigma, out = statistics.describe(values, True), float(np.std(values, ddof=1)), []
    for name, estimate in zip(GOALS, (about.mean, about.std, about.p95, about.p997), strict=True):
        relative = None if estimate is None or estimate.half_width is None else estimate.half_width / sigma
        enough = relative is not None and relative <= GOALS[name]
        needed = n if enough else None if relative is None else math.ceil(n * (relative / GOALS[name]) ** 2)
        if relative is None and name in QUANTILES:
            needed = statistics.runs_for_quantile(QUANTILES[name])
        out.append(Convergence(name, relative, enough, needed))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class StudyAnalysis:
    """Analysis of all responses of a study; mappings are keyed by the name of the response.

    Attributes
    ----------
    runs : StudyRuns
        Runs of the study.
    descriptions : dict
        Statistics of responses and of reported sigmas.
    linear : dict
        Linear models; None where none can be fitted.
    effects : dict
        Main effects of a grid; empty in drawn designs.
    noise : dict
        Fraction of each response's variance that the runs report as noise.
    indices : dict
        Sensitivity indices; empty if the study does not request them.
    convergences : dict
        Convergence of the statistics; empty for grids.
    requirements : tuple of Requirement
        Requirements in the study's order, then all together.
    fronts : tuple of ParetoFront
        Pareto fronts of the requested pairs that are numbers.
    not_numbers : tuple of str
        Requested pairs that are not numbers.
    """

    runs: StudyRuns
    descriptions: Mapping[str, statistics.Description]
    linear: Mapping[str, statistics.LinearModel | None]
    effects: Mapping[str, tuple[statistics.MainEffect, ...]]
    noise: Mapping[str, statistics.NoiseShare]
    indices: Mapping[str, Indices | NoIndices]
    convergences: Mapping[str, tuple[Convergence, ...]]
    requirements: tuple[Requirement, ...]
    fronts: tuple[ParetoFront, ...]
    not_numbers: tuple[str, ...]

    @classmethod
    def of(cls, runs: StudyRuns) -> StudyAnalysis:
        """Compute statistics, models, indices, requirements and Pareto fronts of all runs."""
        everything = runs.everything
        indexed = everything if runs.study.report.sobol else ()
        fronts, wrong = [], []
        for spec in runs.study.report.pareto:
            x, y = runs.find(spec.x), runs.find(spec.y)
            if any(not series.numeric for series in (x, y)):
                wrong.append(f"{spec.x} and {spec.y}")
            else:
                # a run without a response is no compromise
                fronts.append(pareto_front(spec, x.values, y.values))
        return cls(
            runs=runs,
            descriptions={r.name: statistics.describe(r.values, runs.sampled) for r in everything},
            linear={r.name: statistics.linear_model(runs.factors, r) for r in everything},
            effects={r.name: () if runs.sampled else statistics.main_effects(runs.factors, r) for r in everything},
            noise={
                share.response: share
                for r in runs.responses
                if (share := statistics.noise_share(r, runs.study)) is not None
            },
            indices={r.name: sensitivity_indices(runs, r) for r in indexed},
            convergences={
                r.name: convergences(r.known) if runs.sampled and not r.constant else () for r in runs.responses
            },
            requirements=requirements(runs),
            fronts=tuple(fronts),
            not_numbers=tuple(wrong),
        )

    def influence(self, response: str) -> dict[str, float]:
        """Return factor -> estimated fraction of a response's variance due to it, the largest first, for sorting only.

        It is the total sensitivity index if there is one, else the squared standardised regression coefficient or the
        fraction that the main effect explains.
        """
        indices = self.indices.get(response)
        out = {factor.name: 0.0 for factor in self.runs.factors}
        std = self.descriptions[response].std
        if isinstance(indices, Indices):
            out.update({name: index.total.value for index in indices.axes for name in index.factors})
        elif self.effects[response] and std is not None and std.value > 0.0:
            out.update({effect.factor: float(np.var(effect.means)) / std.value**2 for effect in self.effects[response]})
        else:
            model = self.linear[response]
            for effect in model.effects if model is not None else ():
                # a swing over 90% of a text's values is some 3 sigma
                share = effect.swing.value / (2.0 * std.value) if std is not None and std.value > 0.0 else 0.0
                size = effect.coefficient.value if effect.coefficient is not None else share
                out[effect.factor] = size**2
        return dict(sorted(out.items(), key=lambda item: -item[1]))


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


ESTIMATE: Record[Estimate] = Record(
    "A number with its 95% interval; null where the runs do not determine it.",
    Quantity("value", lambda number: _finite(number.value), "the number"),
    Quantity("interval", lambda number: [_finite(end) for end in number.interval], "lower and upper end"),
)
EFFECT: Record[statistics.Effect] = Record(
    "Effect of a factor on a response, by the linear model and by ranks.",
    Quantity("swing", lambda e: e.swing, "change from the factor's 5% to its 95% quantile", record=ESTIMATE),
    Quantity("standardised_coefficient", lambda e: e.coefficient, "sigmas per sigma of the factor", record=ESTIMATE),
    Quantity("rank_correlation", lambda e: e.rank, "Spearman's", record=ESTIMATE),
)
LINEAR: Record[statistics.LinearModel] = Record(
    "Least squares fit of a response by all factors together.",
    Quantity("r2", lambda model: model.r2, "share of the variance that it explains"),
    Quantity("adjusted_r2", lambda model: model.adjusted, "corrected for the number of terms"),
    Quantity("effects", lambda model: {e.factor: e for e in model.effects}, "by factor", record=EFFECT),
    Quantity("not_separable", lambda model: model.not_separable, "factors whose effects the runs do not separate"),
)
MAIN_EFFECT: Record[statistics.MainEffect] = Record(
    "Means of a response over the runs of a grid, for each value of a factor.",
    Quantity("factor", lambda effect: effect.factor, "its name"),
    Quantity("levels", lambda effect: effect.levels, "its values"),
    Quantity("means", lambda effect: effect.means, "mean of the response there"),
    Quantity("swing", lambda effect: effect.swing, "largest minus smallest mean"),
)
INDEX: Record[Index] = Record(
    "Sensitivity to a factor, or to factors that vary together.",
    Quantity("first", lambda index: index.first, "share of the variance that it explains alone", record=ESTIMATE),
    Quantity("total", lambda index: index.total, "share that vanishes when it is fixed", record=ESTIMATE),
    Quantity("first_rbd_fast", lambda index: index.check, "first order by RBD-FAST, which needs no model"),
    Quantity("rbd_fast_agrees", lambda index: index.agrees, "true if that is in the interval, apart from its noise"),
)
INDICES: Record[Indices] = Record(
    "Sobol indices of a response.",
    Quantity("method", lambda a: a.method, "chaos or grid; null where there are none, with the reason"),
    Quantity("degree", lambda a: a.degree, "of the polynomials, 0 for a grid"),
    Quantity("terms", lambda a: a.terms, "number of polynomials, 0 for a grid"),
    Quantity("held_out_r2", lambda a: a.held_out, "of runs that the model was not fitted to"),
    Quantity("unexplained_share", lambda a: a.rest, "share of the variance that the model does not explain"),
    Quantity("noise_share", lambda a: a.noise, "share of the variance that the runs report as noise"),
    Quantity("factors", lambda a: {index.name: index for index in a.axes}, "by factor", record=INDEX),
)
CONVERGENCE: Record[Convergence] = Record(
    "Accuracy of a statistic of the runs.",
    Quantity("relative_half_width", lambda c: c.relative, "half the interval over sigma of the response"),
    Quantity("enough_runs", lambda c: c.enough, "true if that is below the goal"),
    Quantity("runs_needed", lambda c: c.needed, "about how many runs would reach it"),
)


@dataclass(frozen=True, eq=False)
class _ResponseAnalysis:
    """Response, or reported sigma of one, with the analysis of the study that it belongs to."""

    analysis: StudyAnalysis
    of: Response

    @property
    def numbers(self) -> statistics.Description:
        return self.analysis.descriptions[self.of.name]

    @property
    def noise(self) -> statistics.NoiseShare | None:
        return self.analysis.noise.get(self.of.name)

    def sobol(self) -> dict[str, Any] | None:
        indices = self.analysis.indices.get(self.of.name)
        if isinstance(indices, NoIndices):
            return {"method": None, "reason": indices.reason}
        return None if indices is None else INDICES(indices)


RESPONSE: Record[_ResponseAnalysis] = Record(
    "Statistics of a response over the runs that have a number, in its unit.",
    Quantity("unit", lambda a: a.of.unit, "of its numbers, empty for pure ones"),
    Quantity("sigma_of", lambda a: a.of.of or None, "response whose reported sigma this is", where_known=True),
    Quantity("count", lambda a: a.numbers.count, "runs that have a number"),
    Quantity("mean", lambda a: a.numbers.mean, "mean", record=ESTIMATE),
    Quantity("std", lambda a: a.numbers.std, "standard deviation, n - 1", record=ESTIMATE),
    Quantity("median", lambda a: a.numbers.median, "median", record=ESTIMATE),
    Quantity("p95", lambda a: a.numbers.p95, "95% of the runs lie below", record=ESTIMATE),
    Quantity("p997", lambda a: a.numbers.p997, "99.7% of the runs lie below", record=ESTIMATE),
    Quantity("min", lambda a: a.numbers.low, "smallest value"),
    Quantity("max", lambda a: a.numbers.high, "largest value"),
    Quantity("skewness", lambda a: a.numbers.normality and a.numbers.normality.skewness, "0 for a normal one"),
    Quantity("excess_kurtosis", lambda a: a.numbers.normality and a.numbers.normality.kurtosis, "0 for a normal one"),
    Quantity(
        "normality_p", lambda a: a.numbers.normality and a.numbers.normality.p, "of D'Agostino and Pearson's test"
    ),
    Quantity("p0135", lambda a: a.numbers.tails and a.numbers.tails[0], "0.135% of the runs lie below"),
    Quantity("p99865", lambda a: a.numbers.tails and a.numbers.tails[1], "99.865% of the runs lie below"),
    Quantity(
        "noise_share",
        lambda a: a.noise and a.noise.share,
        "share of the variance that the runs report as noise",
        where_known=True,
    ),
    Quantity(
        "noise_share_possible",
        lambda a: a.noise and a.noise.possible,
        "true if that is compatible with the variance of the runs",
        where_known=True,
    ),
    Quantity("linear_model", lambda a: a.analysis.linear[a.of.name], "null where none can be fitted", record=LINEAR),
    Quantity("main_effects", lambda a: a.analysis.effects[a.of.name], "of a grid", record=MAIN_EFFECT),
    Quantity("sobol", _ResponseAnalysis.sobol, "sensitivity indices, where the study asks for them", where_known=True),
    Quantity(
        "convergence",
        lambda a: {convergence.name: convergence for convergence in a.analysis.convergences.get(a.of.name, ())},
        "convergence of the statistics",
        record=CONVERGENCE,
    ),
)
REQUIREMENT: Record[Requirement] = Record(
    "Result of a requirement.",
    Quantity("name", lambda r: r.name or "all", "its name; all for all of them together"),
    Quantity("text", lambda r: r.text, "in words"),
    Quantity("met", lambda r: r.met, "runs that meet it"),
    Quantity("runs_with_a_number", lambda r: r.count, "runs that have a number"),
    Quantity("share", lambda r: r.share, "of these"),
    Quantity("interval", lambda r: r.interval, "95% interval of the share, of a drawn design"),
    Quantity("bounds", lambda r: r.bounds, "share of all runs if none, and if all, without a number meet it"),
    Quantity("bounds_interval", lambda r: r.bounds_interval, "from the lower end for none to the upper end for all"),
)
FRONT: Record[ParetoFront] = Record(
    "Pareto front of a pair.",
    Quantity("x", lambda front: front.spec.x, "name of a factor or response"),
    Quantity("y", lambda front: front.spec.y, "name of a factor or response"),
    Quantity("best_x", lambda front: front.spec.best_x, "min or max"),
    Quantity("best_y", lambda front: front.spec.best_y, "min or max"),
    Quantity("runs", lambda front: front.runs, "runs on the front, from the best x to the best y"),
    Quantity("knee_run", lambda f: None if f.knee is None else f.runs[f.knee], "run at the knee"),
)
STATISTICS: Record[StudyAnalysis] = Record(
    "statistics.json: numbers of a study's report; null where the runs do not determine a number.",
    Quantity("name", lambda a: a.runs.study.name, "of the study"),
    Quantity("design", lambda a: a.runs.kind, "kind of the design"),
    Quantity("runs", lambda a: a.runs.count, "number of runs"),
    Quantity("failed", lambda a: a.runs.failed.sum(), "runs that failed"),
    Quantity("confidence", lambda a: statistics.CONFIDENCE, "of all intervals"),
    Quantity(
        "responses",
        lambda a: {response.name: _ResponseAnalysis(a, response) for response in a.runs.everything},
        "responses, and the sigmas that the runs report for them",
        record=RESPONSE,
    ),
    Quantity("requirements", lambda a: a.requirements, "in the study's order, then all", record=REQUIREMENT),
    Quantity("pareto", lambda a: a.fronts, "of the pairs that the study asks for", record=FRONT),
)
