"""Gain and noise of a detector from frames in the dark and in even light (EMVA Standard 1288, release 3.1, sections 6
and 8), and the correction of frames by these.

Temporal variance is taken over the frames of a stack, so that neither fixed pattern nor an uneven light is in it; the
mean of each frame is taken off first, so that a lamp that drifts is not noise. Non-uniformities are spatial variances
of the mean frames without what is left of temporal noise; a quadratic surface is the light's and is taken off first.

Rounding to grey values is taken off as `noise` has it. Where noise is less than about half a grey value, what it
does depends on where between two steps the pixels stand, which stands in the sigmas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, Mask
from analysis.spots.frame_screening import FramesError
from analysis.spots.noise import WHOLE, NoiseModel, noise_range, systematic_variance, temporal_part
from analysis.statistics import robust_sigma

_HOT_SIGMAS = 10.0
_RESPONSE = (0.5, 1.5)
"""Range of the response of a usable pixel, relative to that of the others."""
_NOTHING = 1e-12
"""DN^2 that rounding may hide and nobody would see."""
_LEAST_LIGHT = 10.0
"""Flat over dark level, in sigmas of a pixel of one dark frame, below which there is no light in a flat frame."""


@dataclass(frozen=True)
class PhotonTransfer:
    """What dark and flat frames say of a detector; <name>_sigma its standard deviation.

    Attributes
    ----------
    gain_dn_per_e : float
        System gain K.
    dark_noise_e : float
        Temporal noise in the dark, dark current's included, electrons rms.
    dark_level_dn : float
        Mean grey value in the dark.
    prnu : float
        Photo response non-uniformity, rms share.
    dsnu_e : float
        Dark signal non-uniformity, electrons rms.
    """

    gain_dn_per_e: float
    gain_sigma: float
    dark_noise_e: float
    dark_noise_sigma: float
    dark_level_dn: float
    prnu: float
    prnu_sigma: float
    dsnu_e: float
    dsnu_sigma: float

    def noise_model(self, sheet: NoiseModel) -> NoiseModel:
        """The detector's noise by these numbers; saturation is the data sheet's.

        Parameters
        ----------
        sheet : NoiseModel
            By the data sheet.
        """
        return replace(
            sheet,
            gain_dn_per_e=self.gain_dn_per_e,
            dark_noise_e=self.dark_noise_e,
            dark_signal_e=0.0,
            offset_dn=self.dark_level_dn,
            prnu=self.prnu,
            dsnu_e=self.dsnu_e,
            further=(),
        )


@dataclass(frozen=True, eq=False)
class PixelCorrection:
    """How grey values of single pixels are made those of an even detector.

    Attributes
    ----------
    dark : Array
        (H, W) DN, taken off; its mean is kept.
    response : Array
        (H, W) share of the mean response, divided by.
    bad : Mask
        (H, W) pixels that are not corrected but left out.
    noise : NoiseModel
        Of a corrected detector: its pattern is what the corrections leave.
    """

    dark: Array
    response: Array
    bad: Mask
    noise: NoiseModel

    def corrected(self, mean: Array) -> Array:
        """Mean frame (H, W), DN, of an even detector.

        Parameters
        ----------
        mean : Array
            As recorded, (H, W) DN.
        """
        level = self.noise.dark_level_dn
        return np.asarray(level + (mean - self.dark) / self.response)


def _stack(frames: NDArray[Any], what: str) -> Array:
    values = np.asarray(frames, dtype=np.float64)
    if values.ndim != 3 or len(values) < 2:
        raise FramesError(
            f"{len(values) if values.ndim == 3 else 1} {what} frame: its noise cannot be told",
            f"two or more {what} frames of one level",
        )
    if not np.all(np.isfinite(values)):
        raise FramesError(
            f"{what} frames hold values that are not finite", f"{what} frames with a value in every pixel"
        )
    return values


def _temporal(values: Array) -> float:
    """Variance of a pixel over frames, DN^2."""
    even = values - values.mean(axis=(1, 2), keepdims=True)
    return float(np.square(even - even.mean(axis=0)).sum() / ((len(values) - 1) * values[0].size))


def _surface(image: Array, good: Mask) -> Array:
    """The quadratic surface through an image, (H, W)."""
    v, u = np.meshgrid(np.linspace(-1, 1, image.shape[0]), np.linspace(-1, 1, image.shape[1]), indexing="ij")
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]).reshape(6, -1)
    use = good.ravel()
    found = np.linalg.lstsq(basis[:, use].T, image.ravel()[use], rcond=None)[0]
    return np.asarray((found @ basis).reshape(image.shape))


def _usable(dark: Array, flat: Array) -> Mask:
    """Pixels without those that are far off in either."""
    good = np.ones(dark.shape, dtype=bool)
    for image in (dark, flat):
        away = np.abs(image - np.median(image))
        good &= away <= _HOT_SIGMAS * max(robust_sigma(away), 1e-9)
    return good


def photon_transfer(dark: NDArray[Any], flat: NDArray[Any]) -> PhotonTransfer:
    """Gain, noise and non-uniformities.

    Parameters
    ----------
    dark : NDArray[Any]
        (N, H, W) grey values without light, N >= 2.
    flat : NDArray[Any]
        (M, H, W) of even light well above the dark, M >= 2.

    Raises
    ------
    FramesError
        Too few frames, frames of different size, or no light in the flat ones.
    """
    night, day = _stack(dark, "dark"), _stack(flat, "flat")
    if night.shape[1:] != day.shape[1:]:
        raise FramesError("dark and flat frames have different sizes", "frames of one size")
    level, light = night.mean(axis=0), day.mean(axis=0)
    good = _usable(level, light)
    night, day = (np.where(good, one, np.median(one, axis=(1, 2), keepdims=True)) for one in (night, day))
    level, light = night.mean(axis=0), day.mean(axis=0)
    pixels = int(np.count_nonzero(good))
    share = good.size / pixels
    dark_variance, variance = _temporal(night) * share, _temporal(day) * share
    signal = float(light[good].mean() - level[good].mean())
    if signal < _LEAST_LIGHT * math.sqrt(max(dark_variance, 1.0 / 12.0)):
        raise FramesError(
            f"the flat frames are only {signal:.3g} DN brighter than the dark ones", "flat frames at half of saturation"
        )
    dark_steps, steps = temporal_part(dark_variance), temporal_part(variance)
    shot = variance - dark_variance + (dark_steps - steps)
    own = max(dark_variance - dark_steps, 0.0)
    dark_spread = dark_variance * math.sqrt(2.0 / (pixels * (len(night) - 1)))
    spread = math.hypot(variance * math.sqrt(2.0 / (pixels * (len(day) - 1))), dark_spread)
    if shot < 5.0 * spread:
        raise FramesError(
            "the flat frames are not noisier than the dark ones",
            "raw frames, neither averaged, smoothed nor compressed",
        )
    # of few changes of a grey value another number might have been seen; frames of even light have pixels at all places
    low, high = noise_range(dark_variance, 5.0 * dark_spread + 5.0 / (pixels * (len(night) - 1)))
    dark_doubt = max(high - own, own - low)
    if dark_doubt > 0.0:
        spread = math.hypot(spread, dark_doubt)
    if shot < 5.0 * spread:
        raise FramesError(
            f"the dark frames have noise of {math.sqrt(own):.2g} DN, so little that rounding to whole grey values "
            "hides the gain",
            "`photon_transfer: stated`, or frames with more grey values for an electron",
        )
    gain = shot / signal
    noise = math.sqrt(own) / gain
    noise_sigma = noise * math.hypot(spread / shot, 0.5 * math.sqrt(2.0 / (pixels * (len(night) - 1))))
    if dark_doubt > 0.0:
        noise_sigma = math.hypot(noise_sigma, _square_root_sigma(own, dark_doubt) / gain)
    left, dark_left = variance / len(day), dark_variance / len(night)
    stays, dark_stays = WHOLE - steps, WHOLE - dark_steps
    hidden = float(systematic_variance(0.0, low, 1.0))
    dsnu, dsnu_sigma = _pattern(level, good, (dark_left, dark_stays), hidden)
    prnu, prnu_sigma = _pattern(light - level, good, (left, dark_left, stays + dark_stays), hidden)
    return PhotonTransfer(
        gain_dn_per_e=gain,
        gain_sigma=gain * spread / shot,
        dark_noise_e=noise,
        dark_noise_sigma=noise_sigma,
        dark_level_dn=float(level[good].mean()),
        prnu=prnu / signal,
        prnu_sigma=prnu_sigma / signal,
        dsnu_e=dsnu / gain,
        dsnu_sigma=dsnu_sigma / gain,
    )


def _pattern_square(image: Array, good: Mask) -> float:
    rest = image - _surface(image, good)
    return float(np.square(rest[good]).sum() / max(np.count_nonzero(good) - 6, 1))


def _pattern(image: Array, good: Mask, noise: tuple[float, ...], hidden: float) -> tuple[float, float]:
    """Standard deviation of a pattern without the variance of noise, and its own; rounding may have made some of the
    pattern's variance, or hidden some.
    """
    square = whole = _pattern_square(image, good)
    for part in noise:
        square -= part
    spread = whole * math.sqrt(2.0 / int(np.count_nonzero(good)))
    if hidden > _NOTHING:
        spread = math.hypot(spread, hidden)
    return math.sqrt(max(square, 0.0)), _square_root_sigma(square, spread)


def _square_root_sigma(square: float, spread: float) -> float:
    return spread / (2.0 * math.sqrt(max(square, spread)))


def pixel_correction(noise: NoiseModel, dark: NDArray[Any] | None, flat: NDArray[Any] | None) -> PixelCorrection:
    """Correction of every pixel by dark and flat frames.

    What is left of the pattern is the noise of the correction, which is the same in all frames that are corrected: it
    takes the place of the detector's own pattern.

    Parameters
    ----------
    noise : NoiseModel
        Of the detector.
    dark : NDArray[Any] | None
        (N, H, W) frames without light, of the exposure of those to be corrected.
    flat : NDArray[Any] | None
        (M, H, W) of even light; None to leave the response as it is.

    Raises
    ------
    FramesError
        Too few frames, or no light in the flat ones.
    """
    night = _stack(dark if dark is not None else np.zeros((0,)), "dark")
    level = night.mean(axis=0)
    away = level - float(np.median(level))
    bad = np.abs(away) > _HOT_SIGMAS * max(robust_sigma(away), 1e-9)
    variance = _temporal(np.where(bad, np.median(night, axis=(1, 2), keepdims=True), night))
    stays = float(noise.rounding_variance_dn2(noise.dark_level_dn))
    left = math.sqrt(variance / len(night) + stays) / noise.gain_dn_per_e
    corrected = replace(noise, dsnu_e=left)
    response = np.ones_like(level)
    if flat is not None:
        day = _stack(flat, "flat")
        if day.shape[1:] != night.shape[1:]:
            raise FramesError("dark and flat frames have different sizes", "frames of one size")
        light = day.mean(axis=0) - level
        signal = float(np.median(light))
        if signal < _LEAST_LIGHT * math.sqrt(max(variance, 1.0 / 12.0)):
            raise FramesError(
                f"the flat frames are only {signal:.3g} DN brighter than the dark ones",
                "flat frames at half of saturation",
            )
        usable = ~bad & (light > _RESPONSE[0] * signal) & (light < _RESPONSE[1] * signal)
        response = light / _surface(light, usable)
        bad = bad | ~usable | (response < _RESPONSE[0]) | (response > _RESPONSE[1])
        response = np.where(bad, 1.0, response)
        stays += float(noise.rounding_variance_dn2(noise.dark_level_dn + signal))
        left = _temporal(day) / len(day) + variance / len(night) + stays
        corrected = replace(corrected, prnu=math.sqrt(left) / signal)
    return PixelCorrection(level - float(np.mean(level[~bad])) + noise.dark_level_dn, response, bad, corrected)
