"""Statistics of studies against functions whose distributions, effects and indices are known exactly."""

import itertools
import json
import math

import numpy as np
import pytest
from scipy import stats

from scenes.specs.study import ParetoSpec
from tests.twin.study_data import columns, dataset, study_of
from twin.study.report.study_analysis import convergences, pareto_front, ranks_of
from twin.study.report.study_report import summary
from twin.study.report.study_statistics import describe, quantile_ranks, runs_for_quantile, share_interval, std_interval

FALSE_ALARM = 1e-6
"""Of each statistical test; seeds are fixed, so that it passes always or never."""
PI = math.pi


def draws(n: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(5.0, 2.0, n)


def test_quantiles_of_a_normal_sample() -> None:
    n = 40_000
    found = describe(draws(n), sampled=True)
    z = -stats.norm.ppf(FALSE_ALARM / 2.0)
    for estimate, q in (
        (found.median, 0.5),
        (found.p95, 0.95),
        (found.p997, 0.997),
        *zip(found.tails, (0.00135, 0.99865), strict=True),
    ):
        place = 5.0 + 2.0 * stats.norm.ppf(q)
        # the sample quantile's standard deviation is sqrt(q(1-q)/n)/density
        sigma = math.sqrt(q * (1.0 - q) / n) / stats.norm.pdf(place, 5.0, 2.0)
        assert abs(getattr(estimate, "value", estimate) - place) < z * sigma
    assert abs(found.mean.value - 5.0) < z * 2.0 / math.sqrt(n)
    assert abs(found.std.value - 2.0) < z * 2.0 / math.sqrt(2.0 * n)
    assert found.normality.normal
    assert not describe(np.exp(draws(500)), sampled=True).normality.normal


@pytest.mark.parametrize("q", [0.5, 0.95])
def test_intervals_hold_what_they_promise(q) -> None:
    """Over 2000 samples of 60: order statistics at least 95%, the standard deviation's near 95%."""
    samples = np.random.default_rng(8).normal(0.0, 1.0, (2000, 60))
    low, high = quantile_ranks(60, q)
    ordered = np.sort(samples, axis=1)
    truth = stats.norm.ppf(q)
    inside = np.ones(2000, bool) if low is None else ordered[:, low] <= truth
    inside &= np.ones(2000, bool) if high is None else ordered[:, high] >= truth
    # binomial, 5 sigma of 2000 trials
    assert inside.mean() > 0.95 - 5.0 * math.sqrt(0.95 * 0.05 / 2000)
    ends = np.array([std_interval(sample) for sample in samples[:500]])
    share = np.mean((ends[:, 0] <= 1.0) & (ends[:, 1] >= 1.0))
    # asymptotic: 60 runs cost some 3% of coverage, beside 5 sigma of 500 trials
    assert 0.92 - 5.0 * math.sqrt(0.05 / 500) < share < 0.999


def test_ranks_by_the_binomial_distribution() -> None:
    low, high = quantile_ranks(100, 0.5)
    # textbook: for the median of 100 the 40th and the 61st value
    assert (low, high) == (39, 60)
    assert runs_for_quantile(0.997) == 1228
    assert quantile_ranks(1227, 0.997)[1] is None
    assert quantile_ranks(1228, 0.997)[1] == 1227


def test_clopper_pearson() -> None:
    for met, count in ((0, 10), (3, 17), (10, 10), (500, 1000)):
        known = stats.binomtest(met, count).proportion_ci(0.95, "exact")
        np.testing.assert_allclose(share_interval(met, count), (known.low, known.high), rtol=1e-9)


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


THREE = "{{a: {{key: [job, a], {0}}}, b: {{key: [job, b], {0}}}, c: {{key: [job, c], {0}}}}}".format(
    f"uniform: [{-PI}, {PI}]"
)


@pytest.mark.parametrize("kind", ["monte_carlo", "latin_hypercube", "sobol"])
def test_ishigami(kind) -> None:
    """Ishigami and Homma's function, a = 7, b = 0.1: indices in closed form."""
    study = study_of(THREE, f"{{kind: {kind}, runs: 1024, seed: 1}}", report="{sobol: true}")
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
    low, high = np.quantile(x["u"], (0.05, 0.95))
    assert model["effects"]["u"]["swing"]["value"] == pytest.approx(-0.5 * (high - low), rel=1e-9)
    assert model["effects"]["n"]["standardised_coefficient"]["value"] == pytest.approx(1.5 * np.std(x["n"]) / np.std(y))
    assert model["effects"]["w"]["swing"]["value"] == pytest.approx(5.0, rel=1e-9)
    assert model["effects"]["t"]["rank_correlation"]["value"] == pytest.approx(stats.spearmanr(x["t"], y).statistic)


def test_noise_is_left_over_and_intervals_hold_the_truth() -> None:
    factors = "{a: {key: [job, a], normal: {mean: 0, sigma: 1}}, b: {key: [job, b], normal: {mean: 0, sigma: 1}}}"
    inside = 0
    for seed in range(30):
        study = study_of(factors, f"{{kind: monte_carlo, runs: 150, seed: {seed}}}", report="{sobol: true}")
        x = columns(study)
        y = 2.0 * x["a"] + x["b"] + np.random.default_rng(100 + seed).normal(0.0, 1.0, 150)
        model = summary(dataset(study, {"y": y}), study)["responses"]["y"]
        low, high = model["sobol"]["factors"]["a"]["total"]["interval"]
        inside += low <= 4.0 / 6.0 <= high
        # the share of the noise is 1/6; of 150 runs its standard deviation is some 0.02
        assert model["sobol"]["unexplained_share"] == pytest.approx(1.0 / 6.0, abs=0.11)
    # 30 intervals of 95%: fewer than 23 happen once in 40 000 such sets
    assert inside >= 23


def test_a_grid_is_taken_apart_exactly() -> None:
    factors = "{a: {key: [job, a], values: [-1, 0, 1]}, b: {key: [job, b], range: [-2 um, 2 um], count: 5}}"
    study = study_of(factors, "{kind: grid}", report="{sobol: true}")
    x = columns(study)
    found = summary(dataset(study, {"y": 3.0 * x["a"] + x["b"] + x["a"] * x["b"]}), study)["responses"]["y"]
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
    json.dumps(found, allow_nan=False)
    assert summary(dataset(study, {"y": y}, failed), study) == found
