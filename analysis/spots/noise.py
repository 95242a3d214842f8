"""Noise model of a linear detector as a function of the mean grey value, with the noise of rounding.

The model is that of EMVA Standard 1288, release 3.1, eq. 9-12 and 33-35. Grey values are in DN as recorded, with the
black level and the dark signal still in. Two kinds of noise are kept apart because they behave differently in a
before/after comparison:

- temporal noise (photon shot noise, read noise) is new in every frame, so the variance of a mean of N frames is 1/N of
  it;
- fixed-pattern noise (PRNU, DSNU) is the same in every frame, does not average down, and is common to all images that
  the same pixels take.

Noise of a detector beyond that model is described by further terms of either kind, each by its variance; like the
others they are independent from pixel to pixel.

Rounding belongs to the first kind where other noise spreads over several grey values. Where it does not, the rounding
error is the same in every frame of an image, but differs from image to image. A pixel of mean level m and noise n is
recorded as the integer nearest to m + n. Over pixels whose m lies anywhere between two grey values, the error is
symmetric and uncorrelated with n, with a variance of 1/12 DN^2. Part of it is the same in every frame, and stays in the
mean of any number of frames: the mean error

    b(m) = sum over k of (-1)^k / (pi k) |phi(2 pi k)| sin(2 pi k m),

phi being the characteristic function of the noise (Widrow and Kollar, Quantization Noise, 2008, sec. 4.3 and 19.2: the
noise is a dither). Its mean square over m is the sum over k of |phi(2 pi k)|^2 / (2 pi^2 k^2): for normal noise of s DN
it is 1/12 at s = 0, a tenth of that at 0.24 DN, the limit of EMVA 1288 (release 3.1, sec. 6.4), and negligible at 1 DN.
The rest of the 1/12 is new in every frame. Light comes in electrons: where the gain is near a whole number of grey
values per electron, shot noise does not spread over the steps, which the characteristic function of Poisson's law takes
into account.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from analysis.arrays import Array
from optics.numerics.arguments import check_fields

ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance of the rounding error in one frame, DN^2."""
FINE = 1.0
"""Rms of normal noise, DN, from which the rounding error is new in every frame: the systematic part is 4e-19 DN^2."""
COARSE, FEW = 0.3, 3.0
"""RMS noise, DN, below which rounding errors are correlated, and the light signal, DN, at which it is computed.

Rings and wings of a spot then show the same steps of grey values in all frames, and the rounding error is correlated
between neighbouring pixels, which `systematic_variance` does not model.
"""
MEASURABLE = 0.4
"""Rms noise, DN, from which the variance of grey values gives the noise to a tenth at any level between two steps."""
_TERMS, _NOTHING = 60, 1e-12
"""Largest number of harmonics of the rounding error, and size below which they are neglected.

The size is the square of the noise's characteristic function at the harmonic.
"""


def systematic_variance(electrons: ArrayLike, read_e2: ArrayLike, gain: float) -> Any:
    """Return the variance over pixels of the rounding error that all frames of an image share, DN^2.

    Parameters
    ----------
    electrons : array_like
        Mean number of electrons of each pixel, from light and dark signal, >= 0; their noise follows Poisson's law. The
        result has their shape.
    read_e2 : array_like
        Variance of the normal noise, electrons squared; a number, or of the shape of ``electrons``.
    gain : float
        System gain, DN per electron.
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
    """Return the part of the variance of a pixel's grey values over frames that rounding causes, DN^2.

    The result is the mean over all levels between two steps, for normal noise before rounding.

    Parameters
    ----------
    variance : float
        Variance of the grey values over frames, DN^2.
    """

    def excess(true_variance: float) -> float:
        return true_variance + ROUNDING_VARIANCE - float(systematic_variance(0.0, true_variance, 1.0)) - variance

    if variance > FINE**2 + ROUNDING_VARIANCE:
        return ROUNDING_VARIANCE
    if excess(0.0) >= 0.0:
        return variance
    return variance - float(brentq(excess, 0.0, variance, xtol=1e-12))


@cache
def _temporal_extremes() -> tuple[Array, Array, Array]:
    """Return a table of noise variances before rounding and of the variances over frames that each may give, DN^2.

    The three arrays are the variances before rounding, and the smallest and the largest variance over the levels of a
    pixel between two steps.
    """
    sigma = np.linspace(0.0, FINE, 201)[1:, None, None]
    level = np.linspace(0.0, 0.5, 51)[:, None]
    steps = np.arange(-8.0, 9.0)
    share = ndtr((steps + 0.5 - level) / sigma) - ndtr((steps - 0.5 - level) / sigma)
    mean = (share * steps).sum(axis=-1)
    variance = (share * steps**2).sum(axis=-1) - mean**2
    true_variance = sigma.ravel() ** 2
    return np.append(0.0, true_variance), np.append(0.0, variance.min(axis=1)), np.append(0.25, variance.max(axis=1))


def noise_range(variance: float, doubt: float) -> tuple[float, float]:
    """Return the smallest and largest noise variance before rounding that agree with a measured variance, DN^2.

    All pixels are assumed to lie at one unknown level between two steps.

    Parameters
    ----------
    variance : float
        Variance of the grey values over frames, DN^2.
    doubt : float
        Largest error of that variance, DN^2.
    """
    if variance > FINE**2 + ROUNDING_VARIANCE:
        return variance - ROUNDING_VARIANCE, variance - ROUNDING_VARIANCE
    true_variance, least, largest = _temporal_extremes()
    fits = true_variance[(least <= variance + doubt) & (largest >= variance - doubt)]
    return float(fits.min()), float(fits.max())


class FurtherNoise(Protocol):
    """Interface of noise beyond the linear model, by its variances in one pixel, electrons squared."""

    @property
    def fixed_variance_e2(self) -> float:
        """Variance over pixels of a pattern that is the same in every frame at any signal, electrons squared."""
        ...

    def temporal_variance_e2(self, electrons: Any) -> Any:
        """Return the variance of the noise that is new in every frame, electrons squared.

        Parameters
        ----------
        electrons : float or ndarray
            Mean number of electrons per pixel, dark signal included.
        """
        ...


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a detector as its data sheet gives it.

    With the default values a grey value is an electron, and the only noise is shot noise and rounding.

    Attributes
    ----------
    gain_dn_per_e : float
        System gain K, grey values per electron, > 0.
    dark_noise_e : float
        Temporal read noise, electrons rms.
    dark_signal_e : float
        Mean dark current times exposure, electrons; it carries shot noise and is not scaled by PRNU.
    offset_dn : float
        Black level, grey values.
    prnu : float
        Photo-response non-uniformity, rms fraction of the light signal.
    dsnu_e : float
        Dark-signal non-uniformity, electrons rms.
    saturation_dn : float
        Grey value above which the response is not linear.
    further : tuple of FurtherNoise
        Noise beyond the linear model.

    Raises
    ------
    ValueError
        A value is impossible; the message names the field.

    Examples
    --------
    A signal of 2000 electrons is recorded as 1100 DN. Its variance is that of shot noise, read noise and rounding,
    0.25 (2000 + 100) + 1/12 DN^2 (photon transfer line):

    >>> import analysis
    >>> noise = analysis.NoiseModel(gain_dn_per_e=0.5, dark_noise_e=10.0, offset_dn=100.0)
    >>> round(float(noise.frame_variance_dn2(1100.0)), 3)
    525.083
    >>> round(float(noise.temporal_variance_dn2(1100.0, frames=25)), 3)
    21.003
    >>> noise.dark_level_dn
    100.0

    A response that varies by 1 % from pixel to pixel does not average down:

    >>> uneven = analysis.NoiseModel(prnu=0.01)
    >>> round(float(uneven.fixed_variance_dn2(1000.0)), 3)
    100.082
    """

    gain_dn_per_e: float = 1.0
    dark_noise_e: float = 0.0
    dark_signal_e: float = 0.0
    offset_dn: float = 0.0
    prnu: float = 0.0
    dsnu_e: float = 0.0
    saturation_dn: float = math.inf
    further: tuple[FurtherNoise, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "further" or (field.name == "saturation_dn" and value == math.inf):
                continue
            # the offset may be negative: the level subtracted from frames contains the dark signal as well
            if not math.isfinite(value) or (value < 0 and field.name != "offset_dn"):
                raise ValueError(f"noise model: {field.name} must be finite and >= 0, found {value!r}")
        if self.gain_dn_per_e == 0:
            raise ValueError("noise model: gain_dn_per_e must be > 0")
        if self.saturation_dn <= self.dark_level_dn:
            raise ValueError(
                f"noise model: saturation_dn {self.saturation_dn} must lie above the dark level {self.dark_level_dn} DN"
            )

    @property
    def dark_level_dn(self) -> float:
        """Mean grey value without light, DN: black level and dark signal."""
        return self.offset_dn + self.gain_dn_per_e * self.dark_signal_e

    @property
    def dark_variance_dn2(self) -> float:
        """Signal-independent variance of one frame, DN^2: read noise, and 1/12 DN^2 of rounding, temporal or not."""
        return (self.gain_dn_per_e * self.dark_noise_e) ** 2 + ROUNDING_VARIANCE

    @property
    def dsnu_variance_dn2(self) -> float:
        """Variance over pixels of the fixed patterns that do not depend on the light, DN^2."""
        further = sum(term.fixed_variance_e2 for term in self.further)
        return (self.gain_dn_per_e * self.dsnu_e) ** 2 + self.gain_dn_per_e**2 * further

    def light_signal_dn(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Return the part of a mean grey value that light causes, DN, >= 0; PRNU scales with it."""
        return np.maximum(np.subtract(mean_signal_dn, self.dark_level_dn), 0.0)

    def frame_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Return the variance of one frame about its mean before rounding, DN^2, without the fixed pattern.

        Shot noise of the light and of the dark signal is K (y - offset) (EMVA 1288 eq. 12: the photon transfer line).

        Parameters
        ----------
        mean_signal_dn : float or ndarray
            Expected grey values as recorded, black level included; the result has their shape.
        """
        return self._variance_dn2(mean_signal_dn, 1)

    def temporal_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float, frames: int) -> Any:
        """Return the variance of a mean of `frames` frames due to the noise that is new in each, DN^2.

        Parameters
        ----------
        mean_signal_dn : float or ndarray
            Expected grey values as recorded, black level included; the result has their shape.
        frames : int
            Number of frames averaged.
        """
        if int(frames) != frames or frames < 1:
            raise ValueError(f"noise model: frames must be an integer >= 1, found {frames!r}")
        variance = self._variance_dn2(mean_signal_dn, frames)
        if self._rounds_coarsely:
            variance -= self.rounding_variance_dn2(mean_signal_dn) / frames
        return variance

    def _variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float, frames: int) -> Any:
        variance = np.maximum(np.subtract(mean_signal_dn, self.offset_dn), 0.0)
        variance *= self.gain_dn_per_e / frames
        variance += self.dark_variance_dn2 / frames
        if self.further:
            electrons = np.maximum(np.subtract(mean_signal_dn, self.offset_dn), 0.0) / self.gain_dn_per_e
            for term in self.further:
                variance += self.gain_dn_per_e**2 / frames * term.temporal_variance_e2(electrons)
        return variance

    @property
    def _rounds_coarsely(self) -> bool:
        """True if read noise alone does not make the rounding error new in every frame at every signal."""
        return self.gain_dn_per_e * self.dark_noise_e < FINE

    def rounding_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Return the variance of the rounding error that all frames of an image share, DN^2.

        It does not fall with the number of frames.

        Parameters
        ----------
        mean_signal_dn : float or ndarray
            Expected grey values as recorded, black level included; the result has their shape.
        """
        if not self._rounds_coarsely:
            return np.zeros(np.shape(mean_signal_dn))
        electrons = np.maximum(np.subtract(mean_signal_dn, self.offset_dn), 0.0) / self.gain_dn_per_e
        read = self.dark_noise_e**2 + sum(term.temporal_variance_e2(electrons) for term in self.further)
        return systematic_variance(electrons, read, self.gain_dn_per_e)

    def fixed_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Return the variance over pixels of the noise that is the same in every frame, DN^2.

        It is that of the pattern, prnu^2 s^2 + (K dsnu)^2 with s the light signal in DN and K the gain in DN per
        electron, of further patterns, and of the rounding error that all frames share. It does not fall with the number
        of frames. The pattern is the same in every image of the same pixels; the rounding error is not.

        Parameters
        ----------
        mean_signal_dn : float or ndarray
            Expected grey values as recorded, black level included; the result has their shape.
        """
        variance = self.prnu * self.light_signal_dn(mean_signal_dn)
        variance *= variance
        variance += self.dsnu_variance_dn2
        if self._rounds_coarsely:
            variance += self.rounding_variance_dn2(mean_signal_dn)
        return variance
