"""Noise of a linear detector (EMVA Standard 1288, release 3.1, eq. 9-12 and 33-35), as a function of the mean grey
value.

Two kinds are kept apart because they behave differently in a before/after comparison:

- temporal noise (photon shot noise, read noise) is new in every frame, so the variance of a mean of N frames is 1/N of
  it;
- fixed-pattern noise (PRNU, DSNU) is the same in every frame, does not average down, and is common to all images that
  the same pixels take.

Rounding to grey values is of the one kind or of the other (`analysis.spots.noise`): new in every frame where noise
spreads over the steps, and the same in every frame, though another one in every image, where it does not.

What a detector has beyond that model is told as further terms of either kind, each by its variance; like the others
they are independent from pixel to pixel.

Grey values are in DN as recorded, with the black level and the dark signal still in.

What rounding to whole grey values does to the mean of frames.

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
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from analysis.arrays import Array

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

    Parameters
    ----------
    electrons : ArrayLike
        Mean of each pixel, of light and dark signal, >= 0: Poisson's law.
    read_e2 : ArrayLike
        Variance of normal noise, electrons squared; a number, or of the shape of ``electrons``.
    gain : float
        DN per electron.
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

    Parameters
    ----------
    variance : float
        DN^2.
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

    Parameters
    ----------
    variance : float
        Of grey values over frames, DN^2.
    doubt : float
        By how much it may be wrong, DN^2.
    """
    if variance > FINE**2 + WHOLE:
        return variance - WHOLE, variance - WHOLE
    own, least, largest = _temporal_extremes()
    fits = own[(least <= variance + doubt) & (largest >= variance - doubt)]
    return float(fits.min()), float(fits.max())


class FurtherNoise(Protocol):
    """Noise beyond the linear model, by its variance in one pixel, electrons squared."""

    @property
    def fixed_variance_e2(self) -> float:
        """Variance of a pattern that is added to every frame, whatever the signal."""
        ...

    def temporal_variance_e2(self, electrons: Any) -> Any:
        """Variance of the noise that is new in every frame, electrons squared, for a mean number of electrons per
        pixel, dark signal included; a number, or an array of the shape of ``electrons``.
        """
        ...


@dataclass(frozen=True)
class NoiseModel:
    """What a data sheet says of a detector's noise. Raises ValueError, naming the field, for impossible values.

    gain_dn_per_e: system gain K, grey values per electron, > 0.
    dark_noise_e: temporal read noise, electrons rms.
    dark_signal_e: mean dark current times exposure, electrons; it carries shot noise and is not scaled by PRNU.
    offset_dn: black level, grey values.
    prnu: photo-response non-uniformity, rms fraction of the light signal.
    dsnu_e: dark-signal non-uniformity, electrons rms.
    saturation_dn: grey value from which the response is not linear.
    further: noise beyond the linear model.
    """

    gain_dn_per_e: float
    dark_noise_e: float
    dark_signal_e: float
    offset_dn: float
    prnu: float
    dsnu_e: float
    saturation_dn: float
    further: tuple[FurtherNoise, ...] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "further":
                continue
            # of frames whose level was subtracted the dark signal, too, was, and so more than the offset
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
        """The part of the variance of one frame that does not depend on the signal: read noise, and the 1/12 DN^2 of
        rounding, temporal or not.
        """
        return (self.gain_dn_per_e * self.dark_noise_e) ** 2 + WHOLE

    @property
    def dsnu_variance_dn2(self) -> float:
        """Variance of the fixed additive patterns, DN^2."""
        further = sum(term.fixed_variance_e2 for term in self.further)
        return (self.gain_dn_per_e * self.dsnu_e) ** 2 + self.gain_dn_per_e**2 * further

    def light_signal_dn(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """The part of a mean grey value that light made, DN, >= 0: what PRNU scales."""
        return np.maximum(np.subtract(mean_signal_dn, self.dark_level_dn), 0.0)

    def frame_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Variance of one frame about its mean before rounding, DN^2, without the fixed pattern; shape of
        mean_signal_dn.

        mean_signal_dn: expected grey values as recorded, black level included. Shot noise of the light and of the dark
            signal
        is K (y - offset) (EMVA 1288 eq. 12: the photon transfer line).
        """
        return self._variance_dn2(mean_signal_dn, 1)

    def temporal_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float, frames: int) -> Any:
        """Variance of a mean of `frames` frames from new noise in each, DN^2; shape of mean_signal_dn.

        mean_signal_dn: expected grey values as recorded, black level included.
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
        """Whether read noise alone does not make rounding white at every signal."""
        return self.gain_dn_per_e * self.dark_noise_e < FINE

    def rounding_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Part of the variance of a frame that rounding causes alike in all frames of an image, DN^2; shape of
        mean_signal_dn. It does not fall with the number of frames.
        """
        if not self._rounds_coarsely:
            return np.zeros(np.shape(mean_signal_dn))
        electrons = np.maximum(np.subtract(mean_signal_dn, self.offset_dn), 0.0) / self.gain_dn_per_e
        read = self.dark_noise_e**2 + sum(term.temporal_variance_e2(electrons) for term in self.further)
        return systematic_variance(electrons, read, self.gain_dn_per_e)

    def fixed_variance_dn2(self, mean_signal_dn: NDArray[np.float64] | float) -> Any:
        """Variance over pixels of what is the same in every frame, DN^2: the pattern prnu^2 s^2 + (K dsnu)^2 with s the
        light signal, further patterns, and what rounding does to all frames alike.

        Does not fall with the number of frames. The pattern is the same draw in every image of the same pixels,
        rounding is not.
        """
        variance = self.prnu * self.light_signal_dn(mean_signal_dn)
        variance *= variance
        variance += self.dsnu_variance_dn2
        if self._rounds_coarsely:
            variance += self.rounding_variance_dn2(mean_signal_dn)
        return variance
