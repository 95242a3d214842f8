"""Frequencies far beyond a search that could be what was found in it: the aliases of an uneven sampling.

Points that lie on rows, such as a grid's, are seen at moments that are nearly whole numbers of an interval, and an
oscillation faster than half of its rate looks there like a slow one. The power of all frequencies, up to the rate of
the image lines, follows at once from Fourier transforms of the observations on a fine grid of moments: with the
observations' weights w and values v,

    z(f) = sum v w exp(-2 pi i f t),   N(f) = sum w w' exp(-2 pi i f (t - t')),   power = 2 z* N^-1 z,

which is the power of the periodogram but for the nuisance and for what sine and cosine have in common. Both are little
at frequencies that are high against the inverse of the time observed; what is selected is fitted exactly.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from analysis.orbit.jitter_spectrum import BLIND, Array, Observations

_FINE, _PADDED = 16, 4
"""Moments in a period of the highest frequency, and transformed frequencies in a resolution element: an oscillation
loses 3% of its power at most by either.
"""
_WIDEST = 2**18
"""Resolution elements that are transformed at most."""
_REGULAR = 1e-4
"""Share of the best known combination of axes that is added to all: what moves alike stays bounded."""


def farthest(given: Observations, highest: float) -> float:
    """Return the frequency up to which aliases can be looked for, hertz, at most ``highest``."""
    return min(highest, _WIDEST / given.span)


def peaks(given: Observations, lowest: float, highest: float) -> tuple[Array, Array]:
    """Return frequencies (K,), hertz, and approximate powers (K,) of all local maxima of the power, the highest first.

    Args:
        given: observations.
        lowest: frequency, hertz.
        highest: likewise; lowered to `farthest`.
    """
    highest = farthest(given, highest)
    step = 1.0 / (_FINE * highest)
    count = int(np.ceil(given.span / step)) + 2
    size = fft.next_fast_len(_PADDED * count, real=True)
    first = np.searchsorted(given.group, np.arange(len(given.time)))
    value = given.rest(given.value)[:, None, None]
    seen = np.add.reduceat(given.weight * value, first, axis=0)
    pairs = np.add.reduceat(given.weight[:, :, None, :, None] * given.weight[:, None, :, None, :], first, axis=0)
    # moments that have no weight may be anything
    begin = given.ends[0]
    at = np.clip(np.rint((given.time - begin) / step).astype(np.intp), 0, count - 1)
    apart = np.rint((given.time[:, :, None] - given.time[:, None, :]) / step).astype(np.intp) % size
    frequency = np.arange(size // 2 + 1) / (size * step)
    inside = (frequency >= lowest) & (frequency <= highest)
    axes = given.axes

    def transformed(place: np.ndarray, weight: Array) -> Array:
        return np.asarray(fft.rfft(np.bincount(place.ravel(), weight.ravel(), size))[inside])

    z = np.stack([transformed(at, seen[..., a]) for a in range(axes)], axis=-1)
    normal = np.empty((len(z), axes, axes), complex)
    for a in range(axes):
        for b in range(axes):
            normal[:, a, b] = transformed(apart, pairs[..., a, b])
    own = np.einsum("faa->fa", normal).real
    best = np.maximum(own.max(axis=0), 1e-300)
    scale = 1.0 / np.sqrt(best)
    normal = normal * scale[:, None] * scale + _REGULAR * np.eye(axes)
    scaled = z * scale
    power = 2.0 * np.einsum("fa,fa->f", scaled.conj(), np.linalg.solve(normal, scaled[..., None])[..., 0]).real
    power = np.where(np.all(own >= BLIND**2 * best, axis=1), power, 0.0)
    rising = np.concatenate([[True], power[1:] >= power[:-1]])
    falling = np.concatenate([power[:-1] > power[1:], [True]])
    top = np.flatnonzero(rising & falling & (power > 0.0))
    top = top[np.argsort(-power[top])]
    return frequency[inside][top], power[top]
