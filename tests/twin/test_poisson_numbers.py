"""Poisson numbers of images against the distribution itself, from means of 1e-6 to 1e6, tails included.

Statistical limits are chi-square or binomial quantiles with a false-alarm rate of 1e-6 per test.
"""

import numpy as np
import pytest
from scipy.special import gammainc, gammaincc

import twin.sensors.poisson_numbers as module
from twin.sensors.poisson_numbers import SERIES_END, TABLE_END, poisson_numbers, poisson_quantile

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


@pytest.mark.parametrize("kind", [np.random.SFC64, np.random.MT19937])
def test_mixed_means_are_independent_and_each_has_its_own(kind) -> None:
    """All ways of one call, also of a generator whose words have 32 bits: means, variances, and neighbours, frames and
    means that do not know of each other."""
    mean = np.array([0.0, 1e-4, 0.5, 7.0, 31.0, 33.0, 900.0, 7e4, 3e5])
    number = poisson_numbers(mean, 200_000, np.random.Generator(kind(2)))
    assert np.all(number[:, 0] == 0.0)
    assert 3 <= np.count_nonzero(number[:, 1]) <= 48  # of 20: 1e-6 on either side
    scaled = (number[:, 2:] - mean[2:]) / np.sqrt(mean[2:])
    within = 5.0 / np.sqrt(len(scaled))  # 6e-7 for each of the 42 numbers
    assert np.all(np.abs(scaled.mean(axis=0)) < within)
    between = scaled.T @ scaled / len(scaled)
    assert np.all(np.abs(np.diag(between) - 1.0) < within * np.sqrt(2.0 + 1.0 / mean[2:]))
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
