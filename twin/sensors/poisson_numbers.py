"""Poisson numbers of images, by exact inversion of the distribution function: one uniform number for every pixel and
frame.

The number of a mean m and a uniform u is the quantile, the smallest n whose distribution function

    F(n; m) = Q(n + 1, m)        (Q: regularised upper incomplete gamma function)

is at least u. No other distribution stands in for Poisson's: what is cheap below only says *where* the quantile is,
and wherever that leaves a choice, F itself decides.

- Means below ``TABLE_END``: a guide table (Chen and Asau 1974; Devroye, Non-Uniform Random Variate Generation, III.2.4)
  over cells of the mean and of u. The quantile grows with both, so that where it is the same at a cell's two far
  corners it is that in the whole cell; this holds for 19 of 20 numbers. For the others u is compared with F
  interpolated between the cell's two means, and within the bound of the interpolation's error with F itself.
- Means from there to ``SERIES_END``: Giles' expansion of the quantile for large means (ACM TOMS 42, 2016, Algorithm
  955) with a bound of what it leaves out; within the bound of a whole number, for one of some hundred, F is compared
  with u.
- Larger means: NumPy's ``Generator.poisson``, Hoermann's exact rejection PTRS.

u has 64 bits and is compared from the end of [0, 1] that is nearer, so that both tails are right to 2^-64. The quantile
grows with the mean: the same stream gives images of almost the same expectation almost the same noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import gammainc, gammaincc, ndtri

TABLE_END = 32.0
"""Mean from which no table is used."""
SERIES_END = 65536.0
"""Mean from which NumPy draws; SciPy's incomplete gamma functions keep all their digits in the tails up to 1e5."""

CELLS_PER_UNIT = 32
"""Cells of the mean, per electron."""
TABLE_BITS = 10
"""Bits of u that choose a cell of the table."""
_SHIFT = np.uint64(64 - TABLE_BITS)
MOST_IN_TABLE = 120
"""Numbers in the table: beyond it lies 1e-31 of the largest mean's distribution, less than the last cell of u."""
_UNDECIDED = 255
_LAST = 2**64 - 1
_INTERPOLATED = 1.01 * (1.0 / CELLS_PER_UNIT) ** 2 / 8.0
"""Largest error of a linear interpolation of F between two means of the table: dF/dm = -p(n), the second derivative is
p(n) - p(n - 1) and so nowhere larger than 1."""
_ROOM = 1 << 17
"""Numbers that are drawn at once, for arrays of a megabyte: fewer spend as much time between the calls as in them."""


@dataclass(frozen=True, eq=False)
class _Guide:
    """Quantiles in the cells of mean and u, row-major: of the mean 32 to the electron, of u 2^10.

    Attributes
    ----------
    known : np.ndarray
        The quantile where the cell has one, else ``_UNDECIDED``, uint8.
    least : np.ndarray
        The smallest in the cell, uint8.
    law : np.ndarray
        F of the numbers below ``MOST_IN_TABLE`` at the cells' means and at the table's end.
    """

    known: np.ndarray
    least: np.ndarray
    law: np.ndarray


@cache
def _guide() -> _Guide:
    means = np.arange(round(TABLE_END * CELLS_PER_UNIT) + 1) / CELLS_PER_UNIT
    buckets = 1 << TABLE_BITS
    law = gammaincc(np.arange(1.0, MOST_IN_TABLE + 1.0), means[:, None])
    # n is passed from the first edge j / 2^10 on that lies beyond F(n); at an edge the quantile is how many are passed
    first = np.floor(law * buckets).astype(np.int64) + 1
    passed = np.zeros((len(means), buckets + 2), np.int64)
    np.add.at(passed, (np.arange(len(means))[:, None], np.minimum(first, buckets + 1)), 1)
    quantile = np.cumsum(passed, axis=1)[:, : buckets + 1]
    least, most = quantile[:-1, :-1], quantile[1:, 1:]
    known = np.where(least == most, least, _UNDECIDED)
    tables = [*(table.astype(np.uint8).ravel() for table in (known, least)), law.ravel()]
    for table in tables:
        table.flags.writeable = False
    return _Guide(*tables)


@cache
def quantile_table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The guide table as kernels read it.

    Returns
    -------
    tuple[np.ndarray, np.ndarray, np.ndarray]
        The least quantile in each cell of mean and u, row-major, with the highest bit set where the cell has others,
        uint8; F of the numbers below ``MOST_IN_TABLE`` at the cells' means, one after the other; and for each row a
        bound of what a linear interpolation of F between its mean and the next is off. The second derivative of F by
        the mean is p(n) - p(n - 1), whose own derivative is a difference of two such.
    """
    guide = _guide()
    cells = np.where(guide.known == _UNDECIDED, guide.least | 128, guide.known).astype(np.uint8)
    step = 1.0 / CELLS_PER_UNIT
    chance = np.diff(guide.law.reshape(-1, MOST_IN_TABLE), axis=1, prepend=0.0)
    bend = np.abs(np.diff(chance, axis=1, prepend=0.0)).max(axis=1)
    bound = 1.01 * np.maximum(bend[:-1], bend[1:]) * (1.0 + 2.0 * step) * step**2 / 8.0
    for table in (cells, bound):
        table.flags.writeable = False
    return cells, guide.law, bound


def poisson_numbers(mean: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw independent Poisson numbers.

    Parameters
    ----------
    mean : np.ndarray
        Of any shape (...), finite and >= 0; not checked.
    count : int
        Numbers of each mean.
    rng : np.random.Generator
        Is asked for one word of 64 bits for every number, in the order of the result, and then for the numbers of means
        beyond ``SERIES_END``.

    Returns
    -------
    np.ndarray
        Whole numbers as float64, (count, ...).
    """
    (out,) = poisson_pieces(mean, count, rng, count)
    return out


def poisson_pieces(mean: np.ndarray, count: int, rng: np.random.Generator, together: int) -> Iterator[np.ndarray]:
    """The numbers of ``poisson_numbers`` some at a time, so that they need not all be held.

    Parameters
    ----------
    mean : np.ndarray
        As there.
    count : int
        As there.
    rng : np.random.Generator
        As there. When the first numbers have come, it stands where it would after all of them.
    together : int
        Numbers of each mean in a piece.

    Yields
    ------
    np.ndarray
        Whole numbers as float64, (together or fewer, ...).
    """
    flat = np.ascontiguousarray(mean, dtype=np.float64).reshape(-1)
    plan, huge = _Plan.of(flat), np.flatnonzero(flat >= SERIES_END)
    words, second = split_stream(rng, flat[huge], count, flat.size, together)
    for first in range(0, count, together):
        out = np.empty((min(together, count - first), flat.size))
        for start, end in _steps(0, len(out), flat.size):
            plan.fill(out[start:end], words_of(words, end - start, flat.size))
        if huge.size:
            out[:, huge] = second.poisson(flat[huge], (len(out), huge.size))
        yield out.reshape(len(out), *np.shape(mean))


def _steps(first: int, last: int, size: int) -> Iterator[tuple[int, int]]:
    """Ranges of numbers that are drawn at once."""
    step = max(1, _ROOM // max(size, 1))
    return ((start, min(start + step, last)) for start in range(first, last, step))


def split_stream(
    rng: np.random.Generator, huge: np.ndarray, count: int, size: int, together: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Generators of the words and of the numbers of huge means, whose streams follow each other in that of ``rng``.

    Parameters
    ----------
    rng : np.random.Generator
        Stands after both when this returns, where not all numbers are drawn together; else it is both.
    huge : np.ndarray
        Means from ``SERIES_END`` on, (H,).
    count : int
        Numbers of each mean.
    size : int
        Number of all means.
    together : int
        Numbers of each mean that are drawn at once.
    """
    if together >= count:
        return rng, rng
    words = deepcopy(rng)
    for start, end in _steps(0, count, size):
        words_of(rng, end - start, size)
    second = deepcopy(rng)
    for start, end in _steps(0, count if huge.size else 0, huge.size):
        rng.poisson(huge, (end - start, huge.size))
    return words, second


def words_of(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Words of 64 bits, (count, size); not the raw ones, which some bit generators have of 32.

    Parameters
    ----------
    rng : np.random.Generator
        Is asked for them.
    count : int
        Of each mean.
    size : int
        Number of means.
    """
    return rng.integers(0, _LAST, (count, size), dtype=np.uint64, endpoint=True)


def poisson_quantile(mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Quantiles of Poisson distributions.

    Parameters
    ----------
    mean : np.ndarray
        (N,), at least 0 and below ``SERIES_END``.
    word : np.ndarray
        u = (word + 1/2) / 2^64, uint64, (..., N).

    Returns
    -------
    np.ndarray
        The smallest whole numbers whose distribution function is at least u, float64, (..., N).
    """
    flat = np.ascontiguousarray(mean, dtype=np.float64)
    out = np.empty(word.shape)
    _Plan.of(flat).fill(out.reshape(-1, flat.size), word.reshape(-1, flat.size))
    return out


@dataclass(frozen=True, eq=False)
class _Plan:
    """Means (N,) and how the number of each is found.

    Attributes
    ----------
    mean : np.ndarray
        All means.
    row : np.ndarray
        Where a mean's row of the table begins; of larger means the first row's.
    large : np.ndarray
        Indices of the means beyond the table and below ``SERIES_END``.
    """

    mean: np.ndarray
    row: np.ndarray
    large: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray) -> _Plan:
        small = np.where(mean < TABLE_END, mean, 0.0)
        row = (small * CELLS_PER_UNIT).astype(np.int64) << TABLE_BITS
        return cls(mean, row, np.flatnonzero((mean >= TABLE_END) & (mean < SERIES_END)))

    def fill(self, out: np.ndarray, word: np.ndarray) -> None:
        """Quantiles of words (K, N), into ``out``; those of means beyond ``SERIES_END`` are left without a meaning."""
        guide = _guide()
        place = (word >> _SHIFT).view(np.int64)
        place += self.row
        known = guide.known.take(place)
        np.copyto(out, known)
        open_ = np.flatnonzero(known == _UNDECIDED)
        if open_.size:
            number = self._decided(guide, open_ % self.mean.size, place.reshape(-1)[open_], word.reshape(-1)[open_])
            out.reshape(-1)[open_] = number
        if self.large.size:
            out[:, self.large] = _by_series(self.mean[self.large], word.take(self.large, axis=1))

    def _decided(self, guide: _Guide, which: np.ndarray, place: np.ndarray, word: np.ndarray) -> np.ndarray:
        """Quantiles that the table leaves open, of the means of the given indices."""
        mean = self.mean[which]
        mean[mean >= TABLE_END] = 0.0
        number = guide.least.take(place).astype(np.int64)
        row = place >> TABLE_BITS
        u, share, at = word * 2.0**-64, mean * CELLS_PER_UNIT - row, row * MOST_IN_TABLE + number
        left, close = np.arange(number.size), []
        while left.size:
            law = guide.law.take(at)
            law += share * (guide.law.take(at + MOST_IN_TABLE) - law)
            ahead = u - law
            close.append(left[np.abs(ahead) <= _INTERPOLATED])
            on = np.flatnonzero(ahead > _INTERPOLATED)
            left, u, share, at = left[on], u[on], share[on], at[on] + 1
            number[left] += 1
        last = np.concatenate(close)
        number[last] = _climbed(number[last].astype(np.float64), mean[last], word[last])
        return number


def _tail(word: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether u lies in the upper half, and its distance from the nearer end of [0, 1]."""
    sign = word.view(np.int64) >> 63  # -1 in the upper half
    tail = (word.view(np.int64) ^ sign).astype(np.float64)
    tail += 0.5
    tail *= 2.0**-64
    return sign < 0, tail


def _beyond(number: np.ndarray, mean: np.ndarray, upper: np.ndarray, tail: np.ndarray) -> np.ndarray:
    """Whether u lies beyond F(number)."""
    below = np.empty(number.shape, bool)
    low = ~upper
    below[low] = gammaincc(number[low] + 1.0, mean[low]) < tail[low]
    below[upper] = gammainc(number[upper] + 1.0, mean[upper]) > tail[upper]
    return below


def _climbed(number: np.ndarray, mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Quantiles (N,) from numbers that are not larger; ``number`` is used up."""
    upper, tail = _tail(word)
    left = np.arange(number.size)
    while left.size:
        left = left[_beyond(number[left], mean[left], upper[left], tail[left])]
        number[left] += 1.0
    return number


def _by_series(mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Quantiles (K, N) of means (N,) from ``TABLE_END`` on."""
    upper, tail = _tail(word)
    x = ndtri(tail)
    x *= 1.0 - 2.0 * upper
    root = np.sqrt(mean)
    inverse = 1.0 / root
    square = x * x
    # the x at which Q(x, mean) = u, in falling powers of the root of the mean; the quantile is its whole part
    at = square * (1.0 / 270.0)
    at += 7.0 / 810.0
    at *= square
    at -= 8.0 / 405.0
    at *= inverse
    term = square * (1.0 / 72.0)
    term += 1.0 / 36.0
    term *= x
    at -= term
    at *= inverse
    np.multiply(square, 1.0 / 6.0, out=term)
    term += 1.0 / 3.0
    at += term
    x *= root
    at += x
    at += mean
    number = np.floor(at)
    # what the series leaves out is less than half of this from a mean of 32 on, for all u of 64 bits
    np.multiply(square, square, out=term)
    term *= square
    term *= 0.001
    term += 0.1
    term *= inverse**3
    term += 1e-14 * mean
    at -= number
    open_ = np.flatnonzero((at < term) | (at > 1.0 - term))
    if open_.size:
        flat = number.reshape(-1)
        # a number that is certainly not larger
        start = np.floor(flat[open_] + at.reshape(-1)[open_] - term.reshape(-1)[open_])
        flat[open_] = _climbed(np.maximum(start, 0.0), mean[open_ % mean.size], word.reshape(-1)[open_])
    return number
