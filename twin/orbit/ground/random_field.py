"""Random fields on a regular grid with a given spectrum, by filtering white noise; they repeat beyond their edges."""

from __future__ import annotations

import numpy as np
from scipy import fft

from optics.threads import cores

_CORRELATION_MARGIN = 4.0
"""Correlation lengths by which a correlated field is drawn larger, so that opposite edges are independent."""


def stream(seed: np.random.SeedSequence, number: int) -> np.random.SeedSequence:
    """A random stream of a seed, by number; unlike ``spawn`` it leaves the seed as it is and can be repeated."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number), pool_size=seed.pool_size)


def fractal_field(
    shape: tuple[int, int], spacing: float, exponent: float, longest: float, seed: np.random.SeedSequence
) -> np.ndarray:
    """A field of zero mean and unit rms whose amplitude spectrum falls like frequency^-exponent.

    Args:
        shape: rows and columns.
        spacing: of the grid, metres.
        exponent: for a surface of fractal dimension D it is 4 - D, between 1 and 2; mountains have about 2.
        longest: wavelength above which the spectrum stays level, metres.
        seed: of the noise.

    Returns:
        float32, of the shape.
    """
    spectrum = _white_spectrum(shape, seed)
    along = fft.rfftfreq(shape[1], spacing) ** 2 + longest**-2.0
    for row, across in enumerate(fft.fftfreq(shape[0], spacing)):
        spectrum[row] *= ((along + across**2) ** (-0.5 * exponent)).astype(np.float32)
    field = np.asarray(fft.irfft2(spectrum, s=shape, workers=cores(), overwrite_x=True))
    field -= field.mean()
    field /= np.sqrt(np.mean(np.square(field), dtype=np.float64))
    return field


def correlated_field(shape: tuple[int, int], spacing: float, length: float, seed: np.random.SeedSequence) -> np.ndarray:
    """A field whose values have zero expectation, unit standard deviation and correlation exp(-(distance/length)^2/2).

    Args:
        shape: rows and columns.
        spacing: of the grid, metres.
        length: of the correlation, metres.
        seed: of the noise.

    Returns:
        float32, of the shape.
    """
    spare = int(np.ceil(_CORRELATION_MARGIN * length / spacing))
    larger = (fft.next_fast_len(shape[0] + spare, True), fft.next_fast_len(shape[1] + spare, True))
    rows, columns = (_root_of_covariance(count, spacing / length) for count in larger)
    spectrum = _white_spectrum(larger, seed)
    spectrum *= rows[:, None]
    spectrum *= columns[: spectrum.shape[1]]
    return np.asarray(fft.irfft2(spectrum, s=larger, workers=cores(), overwrite_x=True))[: shape[0], : shape[1]]


def _root_of_covariance(count: int, step: float) -> np.ndarray:
    """Square root of the transform of the covariance along one axis, whose grid closes to a ring, (count,)."""
    distance = step * np.minimum(np.arange(count), count - np.arange(count))
    # the covariance of a ring is not quite positive: what is below zero is rounding
    return np.sqrt(np.maximum(fft.fft(np.exp(-0.5 * distance**2)).real, 0.0)).astype(np.float32)


def _white_spectrum(shape: tuple[int, int], seed: np.random.SeedSequence) -> np.ndarray:
    noise = np.random.Generator(np.random.SFC64(seed)).standard_normal(shape, dtype=np.float32)
    return np.asarray(fft.rfft2(noise, workers=cores()))
