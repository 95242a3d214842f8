"""Poisson random numbers of images by exact inversion of the distribution function, from one uniform number each.

The number for a mean m and a uniform u is the quantile, the smallest n whose distribution function

    F(n; m) = Q(n + 1, m)        (Q: regularised upper incomplete gamma function)

is at least u. No other distribution is used instead of Poisson's: the fast methods below only bracket the quantile, and
where more than one number remains possible, F itself is compared with u.

- Means below ``TABLE_END``: a guide table (Chen and Asau 1974; Devroye, Non-Uniform Random Variate Generation, III.2.4)
  over cells of the mean and of u. The quantile grows with both, so if it is equal at a cell's two opposite corners it
  is equal in the whole cell; this holds for 19 of 20 numbers. For the others u is compared with F interpolated between
  the cell's two means, and within the error bound of the interpolation with F itself.
- Means from there to ``SERIES_END``: Giles' expansion of the quantile for large means (ACM TOMS 42, 2016, Algorithm
  955) with a bound of its remainder; if a whole number is within the bound, for about one of a hundred, F is compared
  with u.
- Larger means: NumPy's ``Generator.poisson``, Hoermann's exact rejection PTRS.

u has 64 bits and is compared from the nearer end of [0, 1], so that both tails are accurate to 2^-64. The quantile
grows with the mean: the same stream gives images of almost equal expectation almost equal noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import gammainc, gammaincc, ndtri

TABLE_END = 32.0
"""Mean below which Poisson quantiles are taken from a table."""
SERIES_END = 65536.0
"""Mean below which Poisson quantiles are computed by Giles' expansion; above, NumPy's generator draws the numbers.

SciPy's incomplete gamma functions keep full precision in the tails up to means of 1e5.
"""

CELLS_PER_UNIT = 32
"""Number of cells of the table of quantiles per unit of the mean (one electron)."""
TABLE_BITS = 10
"""Number of bits of the uniform number u that select a cell of the table of quantiles."""
_SHIFT = np.uint64(64 - TABLE_BITS)
MOST_IN_TABLE = 120
"""Count of whole numbers, from 0, for which the table has the distribution function.

Larger ones have a probability of 1e-31 for the largest mean, less than the last cell of u.
"""
_UNDECIDED = 255
_LAST = 2**64 - 1
_INTERPOLATED = 1.01 * (1.0 / CELLS_PER_UNIT) ** 2 / 8.0
"""Largest error of a linear interpolation of the distribution function F between two means of the table.

With the probability p(n) of the number n, dF/dm = -p(n) for the mean m, so the second derivative is p(n) - p(n - 1),
nowhere larger than 1.
"""
_ROOM = 1 << 17
"""Count of random numbers drawn at once, for arrays of a megabyte.

With fewer, the function calls take as long as the work.
"""
DRAWING_BYTES = 128 * _ROOM
"""Temporary memory of a thread that draws numbers, in bytes, in addition to the piece that it returns (measured)."""


@dataclass(frozen=True, eq=False)
class _Guide:
    """Table of Poisson quantiles in cells of the mean and of the uniform number u.

    It is row-major: 32 cells of the mean per electron, 2^10 cells of u.

    Attributes
    ----------
    known : ndarray of uint8
        Quantile if the cell has only one, otherwise ``_UNDECIDED``.
    least : ndarray of uint8
        Smallest quantile in the cell.
    law : ndarray
        Poisson distribution function of the whole numbers below ``MOST_IN_TABLE``, for the means at which cells begin
        and for that at the table's end.
    """

    known: np.ndarray
    least: np.ndarray
    law: np.ndarray


@cache
def _guide() -> _Guide:
    """Return the table of the smallest Poisson quantile in each cell of mean and uniform number u, computed once.

    It covers all means below ``TABLE_END``.
    """
    means = np.arange(round(TABLE_END * CELLS_PER_UNIT) + 1) / CELLS_PER_UNIT
    buckets = 1 << TABLE_BITS
    law = gammaincc(np.arange(1.0, MOST_IN_TABLE + 1.0), means[:, None])
    # n is passed at the first edge j / 2^10 beyond F(n); the quantile at an edge is the count of passed numbers
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


def poisson_pieces(mean: np.ndarray, count: int, rng: np.random.Generator, together: int) -> Iterator[np.ndarray]:
    """Yield independent Poisson numbers, some draws at a time, to limit memory.

    Parameters
    ----------
    mean : (...) ndarray
        Means, finite and >= 0; not checked.
    count : int
        Number of draws for each mean.
    rng : np.random.Generator
        Generator: one word of 64 bits for every number, in the order of the result, then the numbers of means beyond
        ``SERIES_END``. Once the first piece is returned, its state is that after all numbers.
    together : int
        Number of draws for each mean in a piece.

    Yields
    ------
    (together or fewer, ...) ndarray
        Whole numbers as float64.
    """
    flat = np.ascontiguousarray(mean, dtype=np.float64).reshape(-1)
    parts = [slice(start, start + _ROOM) for start in range(0, flat.size, _ROOM)]
    plans, huge = [_Plan.of(flat[part]) for part in parts], np.flatnonzero(flat >= SERIES_END)
    words, second = _split_stream(rng, flat[huge], count, flat.size, together)
    for first in range(0, count, together):
        out = np.empty((min(together, count - first), flat.size))
        for start, end in _steps(0, len(out), flat.size):
            for part, plan in zip(parts, plans, strict=True):  # more than one only if each step is a single draw
                plan.fill(out[start:end, part], _words_of(words, end - start, plan.mean.size))
        if huge.size:
            out[:, huge] = second.poisson(flat[huge], (len(out), huge.size))
        yield out.reshape(len(out), *np.shape(mean))


def _steps(first: int, last: int, size: int) -> Iterator[tuple[int, int]]:
    """Return successive ranges (start, end), from ``first`` to ``last``, of draws that are made at once.

    ``size`` is the number of means; a range has about ``_ROOM`` numbers.
    """
    step = max(1, _ROOM // max(size, 1))
    return ((start, min(start + step, last)) for start in range(first, last, step))


def _split_stream(
    rng: np.random.Generator, huge: np.ndarray, count: int, size: int, together: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Return two random generators: one for 64-bit words, one for Poisson numbers of means from ``SERIES_END`` on.

    The stream of the second follows that of the first in the stream of ``rng``.

    Dimensions: H means.

    Parameters
    ----------
    rng : np.random.Generator
        Generator. Unless all numbers are drawn at once, it is advanced beyond both streams; otherwise it serves as
        both.
    huge : (H,) ndarray
        Means from ``SERIES_END`` on.
    count : int
        Number of draws for each mean.
    size : int
        Number of all means.
    together : int
        Number of draws for each mean at once.
    """
    if together >= count:
        return rng, rng
    words = deepcopy(rng)
    for start, end in _steps(0, count, size):
        _words_of(rng, end - start, size)
    second = deepcopy(rng)
    for start, end in _steps(0, count if huge.size else 0, huge.size):
        rng.poisson(huge, (end - start, huge.size))
    return words, second


def _words_of(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Draw random words of 64 bits, (count, size).

    They are not raw words of the bit generator, which have 32 bits in some.

    Parameters
    ----------
    rng : np.random.Generator
        Generator.
    count : int
        Number of words for each mean.
    size : int
        Number of means.
    """
    return rng.integers(0, _LAST, (count, size), dtype=np.uint64, endpoint=True)


@dataclass(frozen=True, eq=False)
class _Plan:
    """Means (N,), sorted by the method that draws their numbers: table, series or NumPy.

    Dimensions: N means.

    Attributes
    ----------
    mean : ndarray
        All means.
    row : ndarray
        Start of each mean's row in the table; for larger means that of the first row.
    large : ndarray
        Indices of the means beyond the table and below ``SERIES_END``.
    """

    mean: np.ndarray
    row: np.ndarray
    large: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray) -> _Plan:
        """Return the means sorted by the method that each needs: table, series, or NumPy's generator."""
        small = np.where(mean < TABLE_END, mean, 0.0)
        row = (small * CELLS_PER_UNIT).astype(np.int64) << TABLE_BITS
        return cls(mean, row, np.flatnonzero((mean >= TABLE_END) & (mean < SERIES_END)))

    def fill(self, out: np.ndarray, word: np.ndarray) -> None:
        """Write the Poisson quantiles of random words (K, N) into ``out``.

        Entries of means from ``SERIES_END`` on are meaningless.

        Dimensions: K draws, N means.
        """
        guide = _guide()
        cell = (word >> _SHIFT).view(np.int64)
        cell += self.row
        known = guide.known.take(cell)
        np.copyto(out, known)
        open_ = np.flatnonzero(known == _UNDECIDED)
        if open_.size:
            number = self._decided(guide, open_ % self.mean.size, cell.reshape(-1)[open_], word.reshape(-1)[open_])
            out.reshape(-1)[open_] = number
        if self.large.size:
            out[:, self.large] = _by_series(self.mean[self.large], word.take(self.large, axis=1))

    def _decided(self, guide: _Guide, which: np.ndarray, cell: np.ndarray, word: np.ndarray) -> np.ndarray:
        """Return the Poisson quantiles of random words whose cell of the table has more than one quantile.

        Parameters
        ----------
        guide : _Guide
            Table of quantiles.
        which : ndarray of int
            Indices of their means.
        cell : ndarray of int
            Indices of their cells.
        word : ndarray of uint64
            Random words.
        """
        mean = self.mean[which]
        mean[mean >= TABLE_END] = 0.0
        number = guide.least.take(cell).astype(np.int64)
        row = cell >> TABLE_BITS
        u, share, index = word * 2.0**-64, mean * CELLS_PER_UNIT - row, row * MOST_IN_TABLE + number
        left, close = np.arange(number.size), []
        while left.size:
            law = guide.law.take(index)
            law += share * (guide.law.take(index + MOST_IN_TABLE) - law)
            ahead = u - law
            close.append(left[np.abs(ahead) <= _INTERPOLATED])
            on = np.flatnonzero(ahead > _INTERPOLATED)
            left, u, share, index = left[on], u[on], share[on], index[on] + 1
            number[left] += 1
        last = np.concatenate(close)
        number[last] = _climbed(number[last].astype(np.float64), mean[last], word[last])
        return number


def _tail(word: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for 64-bit words, whether u = (word + 1/2) / 2^64 exceeds 1/2, and the smaller of u and 1 - u."""
    sign = word.view(np.int64) >> 63  # -1 in the upper half
    tail = (word.view(np.int64) ^ sign).astype(np.float64)
    tail += 0.5
    tail *= 2.0**-64
    return sign < 0, tail


def _beyond(number: np.ndarray, mean: np.ndarray, upper: np.ndarray, tail: np.ndarray) -> np.ndarray:
    """Return True where the uniform number u exceeds the Poisson distribution function at ``number``.

    u is given as in the result of ``_tail``: whether it is in the ``upper`` half, and its distance from the nearer end.
    """
    below = np.empty(number.shape, bool)
    low = ~upper
    below[low] = gammaincc(number[low] + 1.0, mean[low]) < tail[low]
    below[upper] = gammainc(number[upper] + 1.0, mean[upper]) > tail[upper]
    return below


def _climbed(number: np.ndarray, mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Return Poisson quantiles (N,) of random words, found by counting upward from lower bounds ``number``.

    The lower bounds are overwritten.

    Dimensions: N means.
    """
    upper, tail = _tail(word)
    left = np.arange(number.size)
    while left.size:
        left = left[_beyond(number[left], mean[left], upper[left], tail[left])]
        number[left] += 1.0
    return number


def _by_series(mean: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Return Poisson quantiles (K, N) of means (N,) from ``TABLE_END`` on, by Giles' expansion.

    Dimensions: K draws, N means.
    """
    upper, tail = _tail(word)
    x = ndtri(tail)
    x *= 1.0 - 2.0 * upper
    root = np.sqrt(mean)
    inverse = 1.0 / root
    square = x * x
    # the x with Q(x, mean) = u, in falling powers of the root of the mean; the quantile is its integer part
    quantile = square * (1.0 / 270.0)
    quantile += 7.0 / 810.0
    quantile *= square
    quantile -= 8.0 / 405.0
    quantile *= inverse
    term = square * (1.0 / 72.0)
    term += 1.0 / 36.0
    term *= x
    quantile -= term
    quantile *= inverse
    np.multiply(square, 1.0 / 6.0, out=term)
    term += 1.0 / 3.0
    quantile += term
    x *= root
    quantile += x
    quantile += mean
    number = np.floor(quantile)
    # the remainder of the series is less than half of this for means from 32 on and all u of 64 bits
    np.multiply(square, square, out=term)
    term *= square
    term *= 0.001
    term += 0.1
    term *= inverse**3
    term += 1e-14 * mean
    quantile -= number
    open_ = np.flatnonzero((quantile < term) | (quantile > 1.0 - term))
    if open_.size:
        flat = number.reshape(-1)
        # a lower bound of the quantile
        start = np.floor(flat[open_] + quantile.reshape(-1)[open_] - term.reshape(-1)[open_])
        flat[open_] = _climbed(np.maximum(start, 0.0), mean[open_ % mean.size], word.reshape(-1)[open_])
    return number
