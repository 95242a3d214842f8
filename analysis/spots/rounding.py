"""What rounding to whole grey values does to the mean of frames.

A pixel of mean level m and noise n is recorded as the integer nearest to m + n. Over pixels whose m lies anywhere
between two steps, the error is even and independent of n, with a variance of 1/12 DN^2. But part of it is the same in
every frame, and stays in the mean of however many: the mean error

    b(m) = sum over k of (-1)^k / (pi k) |phi(2 pi k)| sin(2 pi k m),

phi being the characteristic function of the noise (Widrow and Kollar, Quantization Noise, 2008, sec. 4.3 and 19.2: the
noise is a dither). Its mean square over m is sum over k of |phi(2 pi k)|^2 / (2 pi^2 k^2): for normal noise of s DN
1/12 at s = 0, a tenth of that at 0.24 DN, the limit of EMVA 1288 (release 3.1, sec. 6.4), and nothing at 1 DN. The rest
of the 1/12 is new in every frame. Light comes in electrons: where a gain is near a whole number of grey values per
electron shot noise does not spread over the steps, and the characteristic function of Poisson's law says so.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

Array = NDArray[np.float64]
WHOLE = 1.0 / 12.0
"""Variance of rounding, DN^2, in one frame."""
FINE = 1.0
"""DN of normal noise from which all of it is new in every frame: what stays is 4e-19 DN^2."""
COARSE, FEW = 0.3, 3.0
"""DN of noise, at so many DN of light, below which rings and wings of a spot are drawn in steps that all frames share:
what rounding does there is alike in neighbouring pixels, which `systematic_variance` cannot know."""
SHOWN = 0.4
"""DN of noise that grey values show to a tenth, wherever between two steps pixels stand."""
_TERMS, _NOTHING = 60, 1e-12
"""Harmonics at most, and the square of phi below which they are left out."""


def systematic_variance(electrons: ArrayLike, read_e2: ArrayLike, gain: float) -> Any:
    """Variance over pixels of what rounding does to all frames of an image alike, DN^2, of the shape of ``electrons``.

    Args:
        electrons: mean of each pixel, of light and dark signal, >= 0: Poisson's law.
        read_e2: variance of normal noise, electrons squared; a number, or of the shape of ``electrons``.
        gain: DN per electron.
    """
    mean, read = np.asarray(electrons, np.float64), np.asarray(read_e2, np.float64)
    out = np.zeros(np.broadcast_shapes(mean.shape, read.shape))
    least = float(read.min()) * gain**2
    for k in range(1, _TERMS + 1):
        normal = 4.0 * (math.pi * k) ** 2
        if normal * least > -math.log(_NOTHING):
            break
        out += np.exp(-normal * gain**2 * read - 2.0 * (1.0 - math.cos(2.0 * math.pi * k * gain)) * mean) / (
            0.5 * normal
        )
    return out


def temporal_part(variance: float) -> float:
    """Part of the variance of grey values over frames that rounding causes, DN^2. It is the mean over all places
    between two steps, for normal noise before rounding.

    Args:
        variance: DN^2.
    """

    def excess(own: float) -> float:
        return own + WHOLE - float(systematic_variance(0.0, own, 1.0)) - variance

    if variance > FINE**2 + WHOLE:
        return WHOLE
    if excess(0.0) >= 0.0:
        return variance
    return variance - float(brentq(excess, 0.0, variance, xtol=1e-12))


@cache
def _temporal_extremes() -> tuple[Array, Array, Array]:
    """Noise variances before rounding, (N,) DN^2, and the least and largest variance over frames that a pixel may have
    with each, over its places between two steps, (N,) DN^2.
    """
    sigma = np.linspace(0.0, FINE, 201)[1:, None, None]
    place = np.linspace(0.0, 0.5, 51)[:, None]
    steps = np.arange(-8.0, 9.0)
    share = ndtr((steps + 0.5 - place) / sigma) - ndtr((steps - 0.5 - place) / sigma)
    mean = (share * steps).sum(axis=-1)
    variance = (share * steps**2).sum(axis=-1) - mean**2
    own = sigma.ravel() ** 2
    return np.append(0.0, own), np.append(0.0, variance.min(axis=1)), np.append(0.25, variance.max(axis=1))


def noise_range(variance: float, doubt: float) -> tuple[float, float]:
    """Least and largest variance of normal noise before rounding, DN^2, that goes with a variance over frames of pixels
    that all stand at one place between two steps, wherever that is.

    Args:
        variance: of grey values over frames, DN^2.
        doubt: by how much it may be wrong, DN^2.
    """
    if variance > FINE**2 + WHOLE:
        return variance - WHOLE, variance - WHOLE
    own, least, largest = _temporal_extremes()
    fits = own[(least <= variance + doubt) & (largest >= variance - doubt)]
    return float(fits.min()), float(fits.max())
