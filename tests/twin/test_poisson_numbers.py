"""Poisson numbers of images against the distribution itself, from means of 1e-6 to 1e6, tails included.

Statistical limits are chi-square or binomial quantiles with a false-alarm rate of 1e-6 per test.
"""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy import stats
from scipy.special import gammainc, gammaincc

import twin.sensors.poisson_numbers as module
from twin.sensors.poisson_numbers import SERIES_END, TABLE_END, poisson_numbers, poisson_quantile

FALSE_ALARM = 1e-6
LAST = np.uint64(2**64 - 1)


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


def words(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.integers(0, LAST, shape, dtype=np.uint64, endpoint=True)


def is_quantile(number: np.ndarray, mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Whether F(n - 1) < u <= F(n), by SciPy's functions alone; the upper half of u by the upper tail."""
    upper = word > np.uint64(2**63 - 1)
    tail = (np.where(upper, LAST - word, word).astype(float) + 0.5) / 2.0**64

    def reached(k: np.ndarray) -> np.ndarray:
        return np.where(upper, gammainc(k + 1.0, mean) <= tail, gammaincc(k + 1.0, mean) >= tail)

    return reached(number) & ((number == 0.0) | ~reached(np.maximum(number - 1.0, 0.0)))


@pytest.mark.parametrize(
    ("low", "high"), [(1e-6, 0.5), (0.5, 8.0), (8.0, TABLE_END), (TABLE_END, 300.0), (300.0, SERIES_END)]
)
def test_every_number_is_the_quantile(low, high) -> None:
    """Table, interpolation and expansion never decide otherwise than the distribution function, out to u = 2^-60."""
    rng = np.random.default_rng(3)
    mean = np.minimum(low * (high / low) ** rng.random(20_000), np.nextafter(high, 0.0))
    word = words(rng, (9, mean.size))
    for k, shift in enumerate((10, 20, 30, 40)):
        word[2 * k] >>= np.uint64(shift)
        word[2 * k + 1] = LAST - (word[2 * k + 1] >> np.uint64(shift))
    number = poisson_quantile(mean, word)
    assert np.array_equal(number, np.floor(number))
    assert is_quantile(number, mean, word).all()
    # the check sees a number that is one off
    assert not is_quantile(number + 1.0, mean, word).any()


def test_edges_of_the_cells() -> None:
    """Means on the table's own, just below and above, u at the first and last of each of its cells."""
    steps = np.concatenate([np.arange(0, 33) / 32.0, np.arange(1, 33), [TABLE_END, 1000.0, SERIES_END - 1.0]])
    mean = np.concatenate([steps, np.nextafter(steps, 1e9), np.nextafter(steps[1:], 0.0)])
    edge = np.arange(1024, dtype=np.uint64) << np.uint64(54)
    word = np.concatenate([edge, edge + np.uint64(2**54 - 1)])[:, None].repeat(mean.size, axis=1)
    number = poisson_quantile(mean, word)
    assert is_quantile(number, mean, word).all()
    assert np.all(np.diff(number[np.argsort(word[:, 0], kind="stable")], axis=0) >= 0)
    assert np.all(np.diff(number[:, np.argsort(mean, kind="stable")], axis=1) >= 0)
    assert np.all(number[:, mean == 0.0] == 0.0)


@pytest.mark.parametrize("mean", [0.7, 20.0, 31.9, 40.0, 1234.5, 65000.0])
def test_the_distribution_function_keeps_its_digits_in_both_tails(mean) -> None:
    """SciPy's, against sums with 40 digits, to 9 sigma and to 1e-11 of itself (rounding of the mean gives 9 eps
    root(mean) at 9 sigma, 5e-13 at the largest; the series that SciPy sums lose some ten times as much)."""
    spread = np.sqrt(mean)
    last = int(mean + 40.0 * spread + 60.0)
    with localcontext() as context:
        context.prec = 40
        term, below, chances = (-Decimal(mean)).exp(), Decimal(0), []
        for k in range(last):
            below += term
            chances.append(below)
            term *= Decimal(mean) / (k + 1)
        for number in np.unique(np.maximum(np.floor(mean + np.arange(-9.0, 9.5, 1.5) * spread), 0.0)):
            lower = chances[int(number)]
            upper = chances[-1] - lower
            assert gammaincc(number + 1.0, mean) == pytest.approx(float(lower), rel=1e-11)
            assert gammainc(number + 1.0, mean) == pytest.approx(float(upper), rel=1e-11)


def chi_square(number: np.ndarray, mean: float) -> float:
    """Chance of a chi-square as large, over single numbers or some 200 bins of equal probability, and both tails."""
    law = stats.poisson(mean)
    tails = np.array([1e-6, 1e-5, 1e-4, 1e-3])
    at = np.unique(np.concatenate([law.ppf(tails), law.ppf(np.linspace(0.0, 1.0, 202)[1:-1]), law.isf(tails)]))
    expected = np.diff(np.concatenate([[0.0], law.cdf(at), [1.0]])) * number.size
    found = np.bincount(np.searchsorted(at, number), minlength=at.size + 1)
    while expected.size > 1 and expected.min() < 5.0:  # bins too small for a chi-square go with their neighbour
        k = int(np.argmin(expected))
        other = k - 1 if k else 1
        expected[other] += expected[k]
        found[other] += found[k]
        expected, found = np.delete(expected, k), np.delete(found, k)
    if expected.size == 1:
        return 1.0
    return float(stats.chi2.sf(np.sum((found - expected) ** 2 / expected), expected.size - 1))


@pytest.mark.parametrize("mean", [1e-6, 1e-3, 0.02, 0.3, 1.0, 5.5, 12.3, 31.99, 32.0, 33.3, 150.0, 1e4, 65535.9, 1e6])
def test_numbers_are_poisson(mean) -> None:
    number = poisson_numbers(np.full((40, 50), mean), 500, generator(7)).ravel()
    assert chi_square(number, mean) > FALSE_ALARM
    total = number.sum()
    assert stats.poisson(mean * number.size).cdf(total) > FALSE_ALARM / 2
    assert stats.poisson(mean * number.size).sf(total) > FALSE_ALARM / 2
    # the test sees a mean that is off by six sigma of what can be known
    if mean >= 1e-3:
        off = mean + 6.0 * np.sqrt(mean / number.size)
        assert min(chi_square(number, off), 2.0 * stats.poisson(off * number.size).cdf(total)) < 1e-5


def test_the_far_tails_have_their_share() -> None:
    """Beyond 4.5 sigma, where an approximation by a normal number would be wrong by several times itself."""
    mean, count = np.array([9.0, 25.0, 60.0, 4000.0]), 1_500_000
    number = poisson_numbers(mean, count, generator(5))
    for k, law in enumerate(stats.poisson(each) for each in mean):
        high = law.isf(1e-5)
        chance = float(law.sf(high))
        seen = int((number[:, k] > high).sum())
        assert stats.binom(count, chance).cdf(seen) > FALSE_ALARM / 2
        assert stats.binom(count, chance).sf(seen - 1) > FALSE_ALARM / 2


def test_mixed_means_are_independent_and_each_has_its_own() -> None:
    """All ways of one call: neighbours, frames and means do not know of each other."""
    mean = np.array([0.0, 1e-4, 0.5, 7.0, 31.0, 33.0, 900.0, 7e4, 3e5])
    number = poisson_numbers(mean, 200_000, generator(2))
    assert np.all(number[:, 0] == 0.0)
    scaled = (number[:, 2:] - mean[2:]) / np.sqrt(mean[2:])
    within = 5.0 / np.sqrt(len(scaled))  # 6e-7 for each of the 42 numbers
    between = scaled.T @ scaled / len(scaled)
    assert np.all(np.abs(between - np.diag(np.diag(between))) < within)
    later = scaled[1:].T @ scaled[:-1] / (len(scaled) - 1)
    assert np.all(np.abs(later) < within)


def test_the_pieces_do_not_matter(monkeypatch) -> None:
    mean = np.random.default_rng(1).exponential(20.0, (30, 41))
    whole = poisson_numbers(mean, 7, generator(4))
    assert whole.shape == (7, 30, 41)
    for room in (1, 5000):
        monkeypatch.setattr(module, "_ROOM", room)
        assert np.array_equal(poisson_numbers(mean, 7, generator(4)), whole)
    # views, other layouts and a single number
    assert np.array_equal(poisson_numbers(np.asfortranarray(mean), 7, generator(4)), whole)
    assert poisson_numbers(np.array(3.0), 2, generator(4)).shape == (2,)


def test_a_mean_that_hardly_changes_changes_hardly_a_number() -> None:
    """Of 1e5 numbers of a mean of 9, one changes for each 1e-5 electrons, and no other with it."""
    mean = np.full(100_000, 9.0)
    one, other = (poisson_numbers(mean + step, 1, generator(6)) for step in (0.0, 1e-4))
    changed = np.abs(other - one)
    assert changed.max() <= 1.0
    assert stats.poisson(10.0).cdf(changed.sum()) > FALSE_ALARM
    assert stats.poisson(10.0).sf(changed.sum() - 1) > FALSE_ALARM


@pytest.mark.parametrize("kind", [np.random.SFC64, np.random.PCG64, np.random.MT19937, np.random.Philox])
def test_any_generator_will_do(kind) -> None:
    """Also one whose own words have 32 bits."""
    number = poisson_numbers(np.full(100_000, 6.0), 2, np.random.Generator(kind(5)))
    assert chi_square(number.ravel(), 6.0) > FALSE_ALARM
