"""Statistics of studies against functions whose distributions, effects and indices are known exactly."""

import itertools
import math
import re
from collections import Counter

import numpy as np
import pytest
from scipy import stats

from analysis.statistics import proportion_interval
from scenes.specs.study import ParetoSpec
from tests.twin.study_bench import TEXTS
from tests.twin.study_data import columns, dataset, study_of
from twin.study.report import study_statistics as estimates
from twin.study.report.sensitivity_indices import NoIndices, axis_functions, sensitivity_indices
from twin.study.report.study_analysis import STATISTICS, StudyAnalysis, convergences, pareto_front, ranks_of
from twin.study.report.study_report import main_factors, warnings
from twin.study.report.study_statistics import linear_model
from twin.study.runs.plan import quantiles

FALSE_ALARM = 1e-6
"""Of each statistical test; seeds are fixed, so that it passes always or never."""
PI = math.pi


def summary(data, study):
    return STATISTICS(StudyAnalysis.of(estimates.StudyRuns.of(data, study)))


def draws(n: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(5.0, 2.0, n)


@pytest.mark.parametrize("q", [0.5, 0.95])
def test_intervals_hold_what_they_promise(q) -> None:
    """Over 2000 samples of 60: order statistics at least 95%, the standard deviation's near 95%."""
    samples = np.random.default_rng(8).normal(0.0, 1.0, (2000, 60))
    low, high = estimates.quantile_interval(np.arange(60.0), q)
    ordered, truth = np.sort(samples, axis=1), stats.norm.ppf(q)
    inside = ordered[:, int(low)] <= truth
    inside &= high is None or ordered[:, int(high)] >= truth
    # binomial, 5 sigma of 2000 trials
    assert inside.mean() > 0.95 - 5.0 * math.sqrt(0.95 * 0.05 / 2000)
    ends = np.array([estimates.std_interval(sample) for sample in samples[:500]])
    share = np.mean((ends[:, 0] <= 1.0) & (ends[:, 1] >= 1.0))
    # asymptotic: 60 runs cost some 3% of coverage, beside 5 sigma of 500 trials
    assert 0.92 - 5.0 * math.sqrt(0.05 / 500) < share < 0.999


def test_ranks_by_the_binomial_distribution() -> None:
    low, high = estimates.quantile_interval(np.arange(100.0), 0.5)
    # textbook: for the median of 100 the 40th and the 61st value
    assert (low, high) == (39, 60)
    assert estimates.runs_for_quantile(0.997) == 1228
    assert estimates.quantile_interval(np.arange(1227.0), 0.997)[1] is None
    assert estimates.quantile_interval(np.arange(1228.0), 0.997)[1] == 1227
    for met, count in ((0, 10), (3, 17), (10, 10), (500, 1000)):
        low, high = proportion_interval(met, count, 0.95)
        # the ends are those of which so many or more, or fewer, come with a chance of 2.5 %
        assert low == 0.0 if met == 0 else stats.binom.sf(met - 1, count, low) == pytest.approx(0.025, rel=1e-9)
        assert high == 1.0 if met == count else stats.binom.cdf(met, count, high) == pytest.approx(0.025, rel=1e-9)


@pytest.mark.second
@pytest.mark.parametrize("ways", list(itertools.product(("min", "max"), repeat=2)))
def test_fronts_by_brute_force(ways) -> None:
    rng = np.random.default_rng(4)
    # whole numbers: many equal points and ties
    x, y = rng.integers(0, 12, (2, 120)).astype(float)
    x[5] = np.nan
    front = pareto_front(ParetoSpec(x="a", y="b", best_x=ways[0], best_y=ways[1]), x, y)
    cost = np.stack([x if ways[0] == "min" else -x, y if ways[1] == "min" else -y], axis=1)
    left, rank = set(range(120)) - {5}, 0
    assert front.ranks[5] == -1
    while left:
        best = {i for i in left if not any(np.all(cost[j] <= cost[i]) and np.any(cost[j] < cost[i]) for j in left)}
        assert set(np.flatnonzero(front.ranks == rank).tolist()) == best
        left, rank = left - best, rank + 1
    assert rank > 5
    assert set(front.runs.tolist()) == set(np.flatnonzero(front.ranks == 0).tolist())


def test_knee() -> None:
    x = np.linspace(0.1, 1.0, 91)
    front = pareto_front(ParetoSpec(x="a", y="b"), x, 0.1 / x)
    # scaled to its range the hyperbola is symmetric: the knee has y = x
    assert x[front.runs[front.knee]] == pytest.approx(math.sqrt(0.1), abs=0.006)  # half a step and rounding
    assert pareto_front(ParetoSpec(x="a", y="b"), x, 1.0 - x).knee is None
    assert len(ranks_of(np.empty((0, 2)))) == 0


def three(reach: float) -> str:
    """Three factors that are even within this."""
    return "{" + ", ".join(f"{n}: {{key: [job, {n}], uniform: [{-reach}, {reach}]}}" for n in "abc") + "}"


@pytest.mark.second
def test_ishigami() -> None:
    """Ishigami and Homma's function, a = 7, b = 0.1: indices in closed form."""
    study = study_of(three(PI), "{kind: monte_carlo, runs: 1024, seed: 1}", report="{sobol: true}")
    x = columns(study)
    y = np.sin(x["a"]) + 7.0 * np.sin(x["b"]) ** 2 + 0.1 * x["c"] ** 4 * np.sin(x["a"])
    found = summary(dataset(study, {"y": y}), study)["responses"]["y"]["sobol"]
    v1, v2, v13 = 0.5 * (1.0 + 0.1 * PI**4 / 5.0) ** 2, 49.0 / 8.0, 0.01 * PI**8 * (1.0 / 18.0 - 1.0 / 50.0)
    v = v1 + v2 + v13
    known = {"a": (v1 / v, (v1 + v13) / v), "b": (v2 / v, v2 / v), "c": (0.0, v13 / v)}
    assert found["held_out_r2"] > 0.99
    for name, (first, total) in known.items():
        # what a polynomial that explains 99% can be wrong by
        assert found["factors"][name]["first"]["value"] == pytest.approx(first, abs=0.01)
        assert found["factors"][name]["total"]["value"] == pytest.approx(total, abs=0.01)
        # an estimate of 1024 runs; its error for 10 harmonics is some 0.02 to 0.05
        assert found["factors"][name]["first_rbd_fast"] == pytest.approx(first, abs=0.1)


FACTORS = (
    "{n: {key: [job, a], normal: {mean: 3 um, sigma: 2 um}}, u: {key: [job, b], uniform: [0 K, 12 K]}, "
    "t: {key: [job, c], truncated: {mean: 1 K, sigma: 1 K, limits: [0 K, 4 K]}}, "
    "l: {key: [job, d], values: [1, 2, 6]}, w: {key: [job, e], values: [silica, zerodur, glass]}}"
)


def test_a_linear_function_is_taken_apart_exactly() -> None:
    """All kinds of factor; without noise the coefficients and the indices are exact but for rounding."""
    study = study_of(FACTORS, "{kind: monte_carlo, runs: 200, seed: 1}", report="{sobol: true}")
    x = columns(study)
    words = {"silica": 0.0, "zerodur": 5.0, "glass": 2.5}
    y = 1.5 * x["n"] - 0.5 * x["u"] + 2.0 * x["t"] + x["l"] + np.array([words[w] for w in x["w"]])
    found = summary(dataset(study, {"y": y}), study)["responses"]["y"]
    cut = stats.truncnorm(-1.0, 3.0, 1.0, 1.0).var()
    parts = {"n": 9.0, "u": 0.25 * 12.0, "t": 4.0 * cut, "l": np.var([1.0, 2.0, 6.0]), "w": np.var([0.0, 5.0, 2.5])}
    whole = sum(parts.values())
    for name, part in parts.items():
        index = found["sobol"]["factors"][name]
        assert index["first"]["value"] == pytest.approx(part / whole, abs=1e-9)
        assert index["total"]["value"] == pytest.approx(part / whole, abs=1e-9)
    model = found["linear_model"]
    assert model["r2"] == pytest.approx(1.0, abs=1e-12)
    # between the 5% and the 95% quantile of an even spread over 12 K, whatever the runs drew
    assert model["effects"]["u"]["swing"]["value"] == pytest.approx(-0.5 * 0.9 * 12.0, rel=1e-9)
    assert model["effects"]["n"]["standardised_coefficient"]["value"] == pytest.approx(1.5 * np.std(x["n"]) / np.std(y))
    assert model["effects"]["w"]["swing"]["value"] == pytest.approx(5.0, rel=1e-9)
    assert model["effects"]["t"]["rank_correlation"]["value"] == pytest.approx(stats.spearmanr(x["t"], y).statistic)


STATED = "{y: {key: [r, y_um], noise: [r, y_um_sigma_noise]}}"
TWO_TERMS = "{a: {key: [job, a], normal: {mean: 0, sigma: 1}}, b: {key: [job, b], uniform: [-1, 1]}, "
Z95 = stats.norm.ppf(0.95)


def test_the_linear_model_is_that_of_dense_least_squares() -> None:
    """Estimates, White's covariance (HC3, MacKinnon and White 1985) and adjusted R2 by dense matrices, of 12 runs."""
    study = study_of(TWO_TERMS[:-2] + "}", "{kind: monte_carlo, runs: 12, seed: 4}")
    x = columns(study)
    y = x["a"] + x["a"] ** 2 + 2.0 * x["b"]
    runs = estimates.StudyRuns.of(dataset(study, {"y": y}), study)
    found = linear_model(runs.factors, runs.responses[0])
    matrix = np.stack([np.ones(12), x["a"], x["b"]], axis=1)
    inverse = np.linalg.inv(matrix.T @ matrix)
    beta = inverse @ matrix.T @ y
    left, leverage = y - matrix @ beta, np.einsum("ij,jk,ik->i", matrix, inverse, matrix)
    covariance = inverse @ (matrix.T * (left / (1.0 - leverage)) ** 2) @ matrix @ inverse
    half = stats.t.ppf(0.975, 12 - 3) * np.sqrt(np.diag(covariance))
    effects = {effect.factor: effect for effect in found.effects}
    for k, (name, range_) in enumerate((("a", 2.0 * Z95), ("b", 1.8)), start=1):
        swing = effects[name].swing
        assert swing.value == pytest.approx(range_ * beta[k], rel=1e-9)
        assert swing.interval == pytest.approx((range_ * (beta[k] - half[k]), range_ * (beta[k] + half[k])), rel=1e-9)
        rank = effects[name].rank
        # Fisher's transform with the variance of Bonett and Wright, Psychometrika 65, 23 (2000)
        z = math.sqrt((1.0 + 0.5 * rank.value**2) / 9.0) * stats.norm.ppf(0.975)
        ends = np.tanh(np.arctanh(rank.value) + np.array([-z, z]))
        assert rank.interval == pytest.approx(tuple(ends), rel=1e-9)
    assert found.r2 == pytest.approx(1.0 - np.sum(left**2) / np.sum((y - y.mean()) ** 2), rel=1e-12)
    assert found.adjusted == pytest.approx(1.0 - np.sum(left**2) / 9.0 / np.var(y, ddof=1), rel=1e-12)
    assert linear_model(runs.factors, estimates.Response("y", "", np.where(np.arange(12) < 4, y, np.nan))) is None


def test_statistics_of_few_runs_are_those_of_scipy() -> None:
    """Five and 25 runs, of which a degree of freedom more or less is seen."""
    for n in (5, 25):
        values = draws(n)
        found = estimates.describe(np.append(values, np.nan), sampled=True)
        assert found.count == n
        ends = stats.t.interval(0.95, n - 1, stats.tmean(values), stats.sem(values))
        assert (*found.mean.interval, found.mean.value) == pytest.approx((*ends, stats.tmean(values)), rel=1e-12)
        assert found.std.value == pytest.approx(stats.tstd(values), rel=1e-12)
        # Bonett, Computational Statistics and Data Analysis 50, 775 (2006), without its small-sample constant
        spread = math.sqrt((stats.kurtosis(values, fisher=False) - (n - 3) / (n - 1)) / (4.0 * n))
        log = np.log(stats.tstd(values)) + np.array([-1.0, 1.0]) * stats.norm.ppf(0.975) * spread
        assert np.log(found.std.interval) == pytest.approx(log, rel=1e-12)
        assert (found.low, found.high) == (values.min(), values.max())
        assert (found.median.value, found.p95.value) == pytest.approx(np.percentile(values, (50.0, 95.0)), rel=1e-12)
        shape = found.normality
        assert (shape is None) == (n < 20)
    expected = (stats.skew(values), stats.kurtosis(values), stats.normaltest(values).pvalue)
    assert (shape.skewness, shape.kurtosis, shape.p) == pytest.approx(expected, rel=1e-12)
    many = draws(40_000)
    found = estimates.describe(many, sampled=True)
    places = np.percentile(many, (99.7, 0.135, 99.865))
    assert (found.p997.value, *found.tails) == pytest.approx(places, rel=1e-12)
    ends = np.sqrt((len(many) - 1) / stats.chi2.ppf((0.975, 0.025), len(many) - 1)) * np.std(many, ddof=1)
    # a sample's kurtosis is 3 +- 0.025
    assert np.ptp(estimates.std_interval(many)) == pytest.approx(np.ptp(ends), rel=0.03)
    assert estimates.mean_interval(many[:1]) == estimates.std_interval(many[:3]) == (None, None)
    assert estimates.describe(np.array([np.nan]), True).count == 0


def test_the_share_of_noise_is_the_chi_square_of_equal_sigmas() -> None:
    """Six runs that state the same noise have the chance of a test of their variance; others that of Satterthwaite."""
    response = estimates.Response("y", "um", draws(6), np.full(6, 3.0))
    study = study_of(NOISY, "{kind: monte_carlo, runs: 6, seed: 1}", STATED)
    found = estimates.noise_share(response, study)
    assert found.share == pytest.approx(9.0 / np.var(response.values, ddof=1), rel=1e-12)
    assert found.p_value == pytest.approx(
        stats.chi2.cdf(np.sum((response.values - response.values.mean()) ** 2) / 9.0, 5)
    )
    one = np.array([3.0] + [1e-6] * 5)
    # one run has all of the noise: 5 / 6 of a degree of freedom
    found = estimates.noise_share(estimates.Response("y", "um", draws(6), one), study)
    assert found.p_value == pytest.approx(stats.chi2.cdf(5.0 / 6.0 / found.share, 5.0 / 6.0), rel=1e-6)


def holds(estimate, truth: float) -> bool:
    """Whether an interval holds a number, but for rounding."""
    low, high = estimate.interval
    return low - 1e-12 * abs(truth) <= truth <= high + 1e-12 * abs(truth)


@pytest.mark.second
@pytest.mark.parametrize("stated", [True, False])
def test_intervals_of_indices_hold_the_truth(stated) -> None:
    """Over 100 studies of 60 runs, with noise that the runs state, or not: then it may belong to any factor."""
    normal = TWO_TERMS.replace("uniform: [-1, 1]", "normal: {mean: 0, sigma: 1}")
    factors = normal + "c: {key: [job, c], uniform: [-1, 1]}}"
    parts = {"a": (1.0, 2.0), "b": (0.0, 1.0), "c": (0.0, 0.0)}
    inside, widths = Counter(), []
    for seed in range(100):
        study = study_of(factors, f"{{kind: monte_carlo, runs: 60, seed: {seed}}}", STATED, "{sobol: true}")
        x = columns(study)
        y = x["a"] * (1.0 + x["b"]) + np.random.default_rng(500 + seed).normal(0.0, 0.3, 60)
        sigma = np.full(60, 0.3 if stated else np.nan)
        runs = estimates.StudyRuns.of(dataset(study, {"y": y, "y_sigma_noise": sigma}), study)
        for index in sensitivity_indices(runs, runs.responses[0]).axes:
            first, total = parts[index.name]
            inside[index.name, "first"] += holds(index.first, first / 2.09)
            inside[index.name, "total"] += holds(index.total, total / 2.09)
        widths.append(index.total.half_width)
    assert len(inside) == 6
    assert min(inside.values()) >= stats.binom.ppf(FALSE_ALARM, 100, 0.94), inside
    # and they are no wider than the noise that may be a factor's: the last factor does little or nothing
    assert np.median(widths) < (0.06 if stated else 0.2)


def indices_of(function, runs: int, seed: int, failed=lambda y: np.zeros(len(y), bool), sigma: float = math.nan):
    """Runs of a known function of three uniform factors, and their indices."""
    stated = STATED if math.isfinite(sigma) else "{y: {key: [a, b_um]}}"
    study = study_of(three(1.0), f"{{kind: monte_carlo, runs: {runs}, seed: {seed}}}", stated, "{sobol: true}")
    y = function(columns(study))
    values = {"y": y} if stated != STATED else {"y": y, "y_sigma_noise": np.full(runs, sigma)}
    data = dataset(study, values, failed(y))
    found = estimates.StudyRuns.of(data, study)
    return found, sensitivity_indices(found, found.responses[0])


def test_many_failed_runs_leave_no_indices() -> None:
    """Where 2 a + b is large runs fail: the exact shares 0.8 and 0.2 are those of a variance that no run shows."""
    _, found = indices_of(lambda x: 2.0 * x["a"] + x["b"], 200, 1, lambda y: y > 0.5)
    assert isinstance(found, NoIndices)
    assert "of 200 runs have no number" in found.reason


def test_too_many_texts_have_no_indices() -> None:
    for count in (20, 21):
        listed = ", ".join(f"t{k}" for k in range(count))
        study = study_of(
            f"{{w: {{key: [job, w], values: [{listed}]}}}}", "{kind: sobol, runs: 256}", report="{sobol: true}"
        )
        runs = estimates.StudyRuns.of(dataset(study, {"y": np.arange(256.0)}), study)
        found = sensitivity_indices(runs, runs.responses[0])
        assert ("w has 21 different values" in getattr(found, "reason", "")) == (count == 21)


@pytest.mark.second
def test_few_failed_runs_widen_the_intervals() -> None:
    """The truth of all runs, 0.8, 0.2 and 0, is within; what fits the others exactly alone would be told to 1e-10."""
    for seed in range(3):
        _, found = indices_of(lambda x: 2.0 * x["a"] + x["b"], 200, seed, lambda y: y > np.sort(y)[-4])
        for index in found.axes:
            truth = {"a": 0.8, "b": 0.2, "c": 0.0}[index.name]
            for low, high in (index.first.interval, index.total.interval):
                assert low <= truth <= high
                # three of 200 values of up to 2.5 sigma either side make some percent of the variance, each way
                assert high - low > 0.02


@pytest.mark.second
def test_a_total_index_is_no_less_than_the_first_order() -> None:
    """A step with noise, of which 40 runs show little: without care half of the totals were less."""
    for seed in range(8):
        _, found = indices_of(lambda x: (x["a"] > 0.6) + 0.2 * x["b"], 40, seed)
        for index in found.axes:
            assert index.total.value >= index.first.value
            assert all(t >= f for t, f in zip(index.total.interval, index.first.interval, strict=True))


@pytest.mark.second
def test_methods_that_disagree_are_said() -> None:
    """A wave of nearly five periods that no polynomial follows, and noise stated that is as large and is not there."""
    runs, found = indices_of(lambda x: np.cos(4.8 * PI * x["a"]) + 0.3 * x["b"], 400, 1, sigma=math.sqrt(0.5))
    wrong = next(index for index in found.axes if index.name == "a")
    assert wrong.check > 0.8
    assert wrong.agrees is False
    told = warnings(StudyAnalysis.of(runs))
    assert any("of a by polynomial chaos and by RBD-FAST do not agree" in text for text in told)
    for seed in range(4):
        _, good = indices_of(lambda x: x["a"] * (1.0 + x["b"]) + 0.3 * x["c"], 100, seed)
        assert all(index.agrees for index in good.axes)


def test_a_grid_is_taken_apart_exactly() -> None:
    factors = "{a: {key: [job, a], values: [-1, 0, 1]}, b: {key: [job, b], range: [-2 um, 2 um], count: 5}}"
    study = study_of(factors, "{kind: grid}", STATED, report="{sobol: true}")
    x = columns(study)
    data = dataset(study, {"y": 3.0 * x["a"] + x["b"] + x["a"] * x["b"], "y_sigma_noise": 2.0 + x["b"]})
    analysis = StudyAnalysis.of(estimates.StudyRuns.of(data, study))
    said = {r.name: main_factors(analysis, r) for r in analysis.runs.everything}
    assert {name: text.split()[0] for name, text in said.items()} == {"y": "a", "y_sigma_noise": "b"}
    found = summary(data, study)["responses"]["y"]
    # variances of -1, 0, 1 and of -2 ... 2
    a, b = 9.0 * 2.0 / 3.0, 2.0
    both = 2.0 / 3.0 * 2.0
    whole = a + b + both
    index = found["sobol"]["factors"]
    assert index["a"]["first"]["value"] == pytest.approx(a / whole, rel=1e-12)
    assert index["a"]["total"]["value"] == pytest.approx((a + both) / whole, rel=1e-12)
    assert index["b"]["first"]["value"] == pytest.approx(b / whole, rel=1e-12)
    assert found["mean"]["interval"] == [None, None]
    assert found["main_effects"][0]["factor"] == "a"
    np.testing.assert_allclose(found["main_effects"][0]["means"], [-3.0, 0.0, 3.0], atol=1e-12)


@pytest.mark.second
def test_enough_runs() -> None:
    few, many = ({c.name: c for c in convergences(draws(n))} for n in (100, 20_000))
    assert not few["mean"].enough
    # 1.96/sqrt(n) = 0.1 needs 384 runs; Student's factor and the sample's sigma change it by a few percent
    assert few["mean"].needed == pytest.approx(384, rel=0.05)
    assert few["p99.7"].needed == 1228
    assert all(course.enough for course in many.values())
    assert convergences(np.ones(50)) == ()


def test_requirements_count_runs_with_numbers() -> None:
    study = study_of(
        "{a: {key: [job, a], uniform: [-1 um, 1 um]}}",
        "{kind: monte_carlo, runs: 50, seed: 2}",
        report="{thresholds: {t: {response: y, at_most: 0.5, magnitude: true}, z: {response: y, at_least: 0}}}",
    )
    y = columns(study)["a"]
    failed = np.arange(50) < 5
    found = summary(dataset(study, {"y": y}, failed), study)
    kept = y[5:]
    both = (np.abs(kept) <= 0.5) & (kept >= 0.0)
    assert [r["met"] for r in found["requirements"]] == [np.sum(np.abs(kept) <= 0.5), np.sum(kept >= 0.0), both.sum()]
    assert {r["runs_with_a_number"] for r in found["requirements"]} == {45}
    assert found["failed"] == 5
    # whatever the five would have given
    one = found["requirements"][0]
    assert one["bounds"] == [one["met"] / 50, (one["met"] + 5) / 50]
    assert one["bounds_interval"] == [
        proportion_interval(one["met"], 50, 0.95)[0],
        proportion_interval(one["met"] + 5, 50, 0.95)[1],
    ]
    # a run that stands on its limit meets it
    edge = summary(dataset(study, {"y": np.tile([-0.5, 0.5, 0.0, 0.6, -0.6], 10)}), study)["requirements"]
    assert [r["met"] for r in edge] == [30, 30, 20]


NOISY = "{a: {key: [job, a], uniform: [-1, 1]}}"


def noisy_runs(n: int, seed: int, stated: float, noise: str = "own") -> estimates.StudyRuns:
    """Runs with noise of 1 um alone, which state ``stated``."""
    study = study_of(NOISY, f"{{kind: monte_carlo, runs: {n}, seed: {seed}}}\nnoise: {noise}", STATED)
    y = np.random.default_rng(seed).normal(0.0, 1.0, n)
    return estimates.StudyRuns.of(dataset(study, {"y": y, "y_sigma_noise": np.full(n, stated)}), study)


def test_a_share_of_noise_above_one_is_an_error_and_not_cut_off() -> None:
    """The total sigma in place of the noise's: 76 times it, a share of 5800."""
    runs = noisy_runs(200, 1, 76.0)
    share = estimates.noise_share(runs.responses[0], runs.study)
    # variance of 200 runs: 10% by chance
    assert share.share == pytest.approx(76.0**2, rel=0.5)
    fault = estimates.impossible_noise(runs)
    assert fault.key == ("responses", "y", "noise")
    assert re.search(r"responses\.y\.noise: the reported noise variance is \d+ times.*_sigma_noise", str(fault))
    # noise that all runs share is no part of what they differ by
    shared = noisy_runs(200, 1, 76.0, noise="shared")
    assert estimates.noise_share(shared.responses[0], shared.study) is None
    assert estimates.impossible_noise(shared) is None


@pytest.mark.parametrize("limits", [(-0.5, 2.0), (6.0, 7.0), (12.0, 15.0), (-60.0, -45.0), (1e3, 1e3 + 1.0)])
def test_a_normal_distribution_cut_far_from_its_mean(limits) -> None:
    """Draws by scipy's distribution, which works in logarithms; polynomials orthonormal on it, by exact quantiles."""
    study = study_of(
        f"{{t: {{key: [job, t], truncated: {{mean: 0, sigma: 1, limits: [{limits[0]}, {limits[1]}]}}}}}}",
        "{kind: latin_hypercube, runs: 2000, seed: 1}",
    )
    spec = study.factors["t"]
    u = (np.arange(200_000) + 0.5) / 200_000
    x = quantiles(spec, u)
    assert np.all(np.diff(x) >= 0.0)
    assert limits[0] <= x[0] < x[-1] <= limits[1]
    cut = stats.truncnorm(*limits)
    # rounding of places beside the distance from the nearer limit, 1/45 or more of which a sigma is
    np.testing.assert_allclose(x[::5000], cut.ppf(u[::5000]), rtol=1e-9)
    functions, _ = axis_functions((estimates.Factor("t", "", x, spec),), np.ones(len(x), bool), 2)
    # midpoints of 200 000 equal parts: of a fourth power over an exponential tail the last ones lack some 0.003
    np.testing.assert_allclose(functions.T @ functions / len(x), np.eye(2), atol=1e-2)


WARNED = TEXTS["warned"]


@pytest.mark.parametrize("text", [None, *WARNED])
def test_what_a_reader_must_know_is_a_warning(text) -> None:
    """Each warning is there where it holds, and no other; a study of good runs has none."""
    case = WARNED.get(text, {})
    n = case.get("runs", 60)
    study = study_of(NOISY, f"{{kind: monte_carlo, runs: {n}, seed: 2}}", STATED)
    y = columns(study)["a"]
    y[n - case.get("missing", 0) :] = np.nan
    data = dataset(
        study, {"y": y, "y_sigma_noise": np.full(n, case.get("noise", 0.1))}, np.arange(n) < case.get("failed", 0)
    )
    doubts = np.where(np.arange(n) < case.get("doubts", 0), "σ does not hold: chi-square (12 of 8)", "")
    told = warnings(StudyAnalysis.of(estimates.StudyRuns.of(data.assign(doubt=("run", doubts.astype(object))), study)))
    wanted = {one for one in WARNED if one == text or (case.get("failed", 0) > 3 and one.startswith("failed"))}
    assert {one for one in WARNED for line in told if one in line} == wanted
    assert len(told) == len(wanted)
    if "doubts" in case:
        assert "chi-square (3 runs). The column doubt" in told[0]
