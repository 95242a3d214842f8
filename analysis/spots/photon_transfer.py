"""Photon-transfer measurement of a detector's gain and noise, and correction of frames by dark and flat frames.

The method is that of EMVA Standard 1288, release 3.1, sections 6 and 8. Temporal variance is taken over the frames of a
stack, so that neither the fixed pattern nor uneven light contributes; the mean of each frame is subtracted first, so
that a drifting lamp does not count as noise. Non-uniformities are spatial variances of the mean frames minus the
remaining temporal noise; a quadratic surface is attributed to the light and subtracted first.

Rounding to grey values is subtracted as modelled in `noise`. Where noise is less than about half a grey value, the
effect of rounding depends on the pixels' level between two steps; this uncertainty is included in the sigmas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, Mask
from analysis.spots.frame_screening import FramesError
from analysis.spots.noise import ROUNDING_VARIANCE, NoiseModel, noise_range, systematic_variance, temporal_part
from analysis.statistics import robust_sigma

_HOT_SIGMAS = 10.0
_RESPONSE = (0.5, 1.5)
"""Smallest and largest response to light of a usable pixel, relative to that of the other pixels."""
_NOTHING = 1e-12
"""Variance of the rounding error, DN^2, below which its uncertainty is neglected."""
_LEAST_LIGHT = 10.0
"""Smallest level of flat over dark frames, in sigmas of a pixel of one dark frame, that counts as light."""


@dataclass(frozen=True)
class PhotonTransfer:
    """Gain, noise and non-uniformities of a detector, measured from dark and flat frames.

    An attribute <name>_sigma is the standard deviation of <name>.

    Attributes
    ----------
    gain_dn_per_e : float
        System gain K, DN per electron.
    dark_noise_e : float
        Temporal noise in the dark, including that of the dark current, electrons rms.
    dark_level_dn : float
        Mean grey value in the dark.
    prnu : float
        Photo-response non-uniformity, rms fraction.
    dsnu_e : float
        Dark-signal non-uniformity, electrons rms.
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
        """Return a noise model of the measured values, with the saturation of the data sheet.

        Parameters
        ----------
        sheet : NoiseModel
            Noise model of the data sheet.
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
    """Correction of single pixels by dark level and response.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    dark : (H, W) ndarray
        Dark level that is subtracted, DN; its mean is kept.
    response : (H, W) ndarray
        Response of each pixel relative to the mean response, by which frames are divided.
    bad : (H, W) ndarray of bool
        Pixels that are excluded instead of corrected.
    noise : NoiseModel
        Noise of a corrected image, whose fixed pattern is what the corrections leave.
    """

    dark: Array
    response: Array
    bad: Mask
    noise: NoiseModel

    def corrected(self, mean: Array) -> Array:
        """Return the corrected mean frame, (H, W) DN.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        mean : (H, W) ndarray
            Mean frame as recorded, DN.
        """
        level = self.noise.dark_level_dn
        return np.asarray(level + (mean - self.dark) / self.response)


def _stack(frames: NDArray[Any], what: str) -> Array:
    values = np.asarray(frames, dtype=np.float64)
    if values.ndim != 3 or len(values) < 2:
        raise FramesError(
            f"{len(values) if values.ndim == 3 else 1} {what} frame: its noise cannot be measured",
            f"two or more {what} frames of one level",
        )
    if not np.all(np.isfinite(values)):
        raise FramesError(
            f"{what} frames contain values that are not finite", f"{what} frames with a value in every pixel"
        )
    return values


def _temporal(values: Array) -> float:
    """Return the variance over the frames of a stack, mean over its pixels, DN^2."""
    even = values - values.mean(axis=(1, 2), keepdims=True)
    return float(np.square(even - even.mean(axis=0)).sum() / ((len(values) - 1) * values[0].size))


def _surface(image: Array, good: Mask) -> Array:
    """Return the quadratic surface fitted to an image, (H, W).

    Dimensions: H rows, W columns.
    """
    v, u = np.meshgrid(np.linspace(-1, 1, image.shape[0]), np.linspace(-1, 1, image.shape[1]), indexing="ij")
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]).reshape(6, -1)
    use = good.ravel()
    coefficients = np.linalg.lstsq(basis[:, use].T, image.ravel()[use], rcond=None)[0]
    return np.asarray((coefficients @ basis).reshape(image.shape))


def _usable(dark: Array, flat: Array) -> Mask:
    """Return the pixels (H, W) that are no outliers in the dark or in the flat frame.

    Dimensions: H rows, W columns.
    """
    good = np.ones(dark.shape, dtype=bool)
    for image in (dark, flat):
        away = np.abs(image - np.median(image))
        good &= away <= _HOT_SIGMAS * max(robust_sigma(away), 1e-9)
    return good


def photon_transfer(dark: NDArray[Any], flat: NDArray[Any]) -> PhotonTransfer:
    """Measure gain, noise and non-uniformity of a detector from dark and flat frames (photon transfer, EMVA 1288).

    Dimensions: N frames, H rows, W columns, M frames.

    Parameters
    ----------
    dark : (N, H, W) ndarray
        Grey values without light, N >= 2.
    flat : (M, H, W) ndarray
        Grey values in even light well above the dark level, M >= 2.

    Returns
    -------
    PhotonTransfer
        `gain_dn_per_e`, `dark_noise_e`, `dark_level_dn`, `prnu` and `dsnu_e`, with the standard deviations `gain_sigma`
        and so on; `noise_model` makes a `NoiseModel` of them.

    Raises
    ------
    ValueError
        There are too few frames, the frames differ in size, or the flat frames show no light.

    Examples
    --------
    A detector of 0.5 DN per electron, 8 electrons of read noise and 1 % of response non-uniformity:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(2)
    >>> response = 1 + 0.01 * rng.standard_normal((64, 64))
    >>> def frames(electrons):
    ...     signal = rng.poisson(electrons * response, (16, 64, 64)) + 8 * rng.standard_normal((16, 64, 64))
    ...     return np.round(100 + 0.5 * signal)
    >>> detector = analysis.photon_transfer(frames(0), frames(20000))
    >>> round(detector.gain_dn_per_e, 2), round(detector.dark_noise_e, 1), round(detector.prnu, 3)
    (0.5, 7.9, 0.01)
    >>> abs(detector.gain_dn_per_e - 0.5) < 3 * detector.gain_sigma
    True
    """
    night, day = _stack(dark, "dark"), _stack(flat, "flat")
    if night.shape[1:] != day.shape[1:]:
        raise FramesError("dark and flat frames have different sizes", "frames of one size")
    level, light = night.mean(axis=0), day.mean(axis=0)
    good = _usable(level, light)
    night, day = (np.where(good, stack, np.median(stack, axis=(1, 2), keepdims=True)) for stack in (night, day))
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
    dark_rest = max(dark_variance - dark_steps, 0.0)
    dark_spread = dark_variance * math.sqrt(2.0 / (pixels * (len(night) - 1)))
    spread = math.hypot(variance * math.sqrt(2.0 / (pixels * (len(day) - 1))), dark_spread)
    if shot < 5.0 * spread:
        raise FramesError(
            "the flat frames are not noisier than the dark ones",
            "raw frames, neither averaged, smoothed nor compressed",
        )
    # few changes of a grey value give an uncertain variance; in even light the pixels lie at all levels between steps
    low, high = noise_range(dark_variance, 5.0 * dark_spread + 5.0 / (pixels * (len(night) - 1)))
    dark_doubt = max(high - dark_rest, dark_rest - low)
    if dark_doubt > 0.0:
        spread = math.hypot(spread, dark_doubt)
    if shot < 5.0 * spread:
        raise FramesError(
            f"the dark frames have noise of {math.sqrt(dark_rest):.2g} DN, so little that rounding to whole grey "
            "values hides the gain",
            "`photon_transfer: stated`, or frames with more grey values per electron",
        )
    gain = shot / signal
    noise = math.sqrt(dark_rest) / gain
    noise_sigma = noise * math.hypot(spread / shot, 0.5 * math.sqrt(2.0 / (pixels * (len(night) - 1))))
    if dark_doubt > 0.0:
        noise_sigma = math.hypot(noise_sigma, _square_root_sigma(dark_rest, dark_doubt) / gain)
    left, dark_left = variance / len(day), dark_variance / len(night)
    stays, dark_stays = ROUNDING_VARIANCE - steps, ROUNDING_VARIANCE - dark_steps
    rounding = float(systematic_variance(0.0, low, 1.0))
    dsnu, dsnu_sigma = _pattern(level, good, (dark_left, dark_stays), rounding)
    prnu, prnu_sigma = _pattern(light - level, good, (left, dark_left, stays + dark_stays), rounding)
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


def _pattern(image: Array, good: Mask, noise: tuple[float, ...], rounding: float) -> tuple[float, float]:
    """Return the standard deviation over pixels of a fixed pattern, corrected for noise, and its uncertainty.

    ``rounding`` is the variance by which rounding may have changed the pattern, in either direction.
    """
    square = whole = _pattern_square(image, good)
    for part in noise:
        square -= part
    spread = whole * math.sqrt(2.0 / int(np.count_nonzero(good)))
    if rounding > _NOTHING:
        spread = math.hypot(spread, rounding)
    return math.sqrt(max(square, 0.0)), _square_root_sigma(square, spread)


def _square_root_sigma(square: float, spread: float) -> float:
    return spread / (2.0 * math.sqrt(max(square, spread)))


def pixel_correction(noise: NoiseModel, dark: NDArray[Any] | None, flat: NDArray[Any] | None) -> PixelCorrection:
    """Compute the correction of every pixel from dark and flat frames.

    The residual pattern is the noise of the correction, which is the same in all corrected frames: it takes the place
    of the detector's own pattern.

    Dimensions: N frames, H rows, W columns, M frames.

    Parameters
    ----------
    noise : NoiseModel
        Noise of the detector.
    dark : (N, H, W) ndarray or None
        Frames without light, with the exposure of those to be corrected.
    flat : (M, H, W) ndarray or None
        Frames in even light; None to leave the response uncorrected.

    Raises
    ------
    FramesError
        There are too few frames, or the flat frames show no light.
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
