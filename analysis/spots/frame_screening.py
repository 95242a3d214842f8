"""Frames of one spot in one state, compared with each other: what is not the same in all of them.

The reference is the median of the frames. Each frame is fitted to it by its light, its level and a small movement
(first and second derivatives of the reference), and what sticks out of that by more than noise does is left out of the
mean: cosmic rays and other transients pixel by pixel, frames without the light or unlike the others as a whole. What is
the same in every frame is found by `static_defects`.

The mean of clean frames is that of `centroid.mean_frames`, to the bit. False alarms: a set of clean frames is changed
once in 1 / FALSE_ALARM.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import chi2, norm

from analysis.measurement_error import MeasurementError
from analysis.spots import rounding
from analysis.spots.centroid import mean_frames
from analysis.spots.noise import NoiseModel

__all__ = [
    "FALSE_ALARM",
    "Finding",
    "FramesError",
    "ScreenedFrames",
    "noise_ratio",
    "screen_frames",
    "shown_noise",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
FALSE_ALARM = 1e-6
"""Chance that a test finds something in clean frames of one spot in one state."""
GROWTH_SIGMAS = 3.5
"""Neighbours of a transient belong to it from this on."""
_DIM = 0.5
"""Share of the light of the brightest frame below which a frame does not hold the spot."""
_UNLIKE = 0.01
"""Share of its pixels from which a whole frame is unlike the others."""
_FEWEST_UNLIKE = 40
_BORDER_PX = 4
_SATURATION_SIGMAS = 4.0
_LEAST_SHARE, _UNKNOWN, _LEAST_DRIFT_DN = 1e-3, 1e12, 0.5
_ROUNDS = 20
"""In which the cut-off of differences follows the noise that is found."""
_MOST_MOVES, _SMALL_PX, _LARGEST_PX = 4, 0.1, 5.0
"""A frame that has moved by more than the second is compared with the reference there, so often at most, up to the
third."""
_NOISE_OFF, _MOST_SIGMAS = 0.15, 4.0
"""By which the noise of frames may differ from the stated one, as a share of that; and where single differences are cut
off, in standard deviations, for cosmic rays."""
_LIT = 0.02
"""Share of the peak from which a pixel is in the light, where movement and smear look like noise."""
_MEDIAN = math.pi / 2.0
"""Variance of a median over that of a mean, of many normal numbers."""


class FramesError(MeasurementError, ValueError):
    """Frames that cannot be used.

    Attributes:
        remedy: what to do about it.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem)
        self.remedy = remedy


@dataclass(frozen=True)
class Finding:
    """What was found, and what became of it.

    Attributes:
        kind: what it is, a few words.
        text: how much and where, and what was done.
        corrects: whether the measurement was changed for it.
    """

    kind: str
    text: str
    corrects: bool = True


@dataclass(frozen=True, eq=False)
class ScreenedFrames:
    """What is used of the frames of one spot in one state.

    Attributes:
        mean: (H, W) DN.
        counts: (H, W) frames that each pixel is the mean of.
        good: (H, W) pixels that can be used.
        frames: number of frames that are used.
        recorded: number of frames that there are.
        jitter: (2, 2) px^2, covariance of the spot's place over the frames beyond noise; zeros where none is seen.
        findings: what was found.
    """

    mean: Array
    counts: Array
    good: Mask
    frames: int
    recorded: int
    jitter: Array
    findings: tuple[Finding, ...]

    @property
    def clean(self) -> bool:
        """Whether nothing was changed."""
        return not any(finding.corrects for finding in self.findings)


def screen_frames(frames: NDArray[Any], noise: NoiseModel, bad: Mask | None = None) -> ScreenedFrames:
    """Leave out what is not the same in all frames, and what is saturated.

    Args:
        frames: (N, H, W) grey values as recorded, integers or real numbers; NaN for pixels without a value.
        noise: of the detector.
        bad: (H, W) pixels that are known to be bad; None for none.

    Raises:
        FramesError: too few of the frames hold the light, or none of their pixels can be used.
    """
    values = np.asarray(frames, dtype=np.float64)
    finite = np.isfinite(values)
    known = np.zeros(values.shape[1:], dtype=bool) if bad is None else bad
    findings: list[Finding] = []
    if np.any(known):
        findings.append(Finding("bad pixels", f"{np.count_nonzero(known)} of the bad-pixel map are left out"))
    if not np.all(finite):
        count = np.count_nonzero(~finite.all(axis=0))
        findings.append(Finding("undefined pixels", f"{count} without a value are left out"))
    values = np.where(finite, values, 0.0)
    kept = _lit(values, finite & ~known, findings)
    hits = ~finite
    model = np.zeros_like(values)
    jitter = np.zeros((2, 2))
    if len(kept) > 1:
        found = _compared(values[kept], finite[kept], known, noise)
        unlike = found.unlike()
        if np.any(unlike):
            names = _numbers(kept[unlike])
            findings.append(Finding("spoilt frames", f"{names} unlike the others are left out"))
            if np.count_nonzero(~unlike) < 0.5 * len(values):
                raise FramesError(
                    f"{len(values) - np.count_nonzero(~unlike)} of {len(values)} frames are unlike the others or dark",
                    "record frames of one state under one name, with the light on",
                )
            kept = kept[~unlike]
            found = _compared(values[kept], finite[kept], known, noise) if len(kept) > 1 else found
        if len(kept) > 1:
            hits[kept] |= found.hits
            model[kept] = found.model
            findings += found.findings()
            jitter = found.jitter
    saturated = _saturated(values[kept], noise) & ~known
    if np.any(saturated):
        findings.append(
            Finding("saturation", f"{np.count_nonzero(saturated)} pixels at and beside saturated ones are left out")
        )
    used, lost = values[kept], hits[kept]
    counts = len(kept) - np.count_nonzero(lost, axis=0).astype(np.float64)
    # a pixel that flickers in more than a third of the frames is no detector of light
    flickers = (counts < np.ceil(2.0 / 3.0 * len(kept))) & ~known
    if np.any(flickers & finite.any(axis=0)):
        findings.append(Finding("flickering pixels", f"{np.count_nonzero(flickers)} are left out"))
    good = ~known & ~saturated & ~flickers
    whole = len(kept) == len(values) and not np.any(hits)
    if whole and np.issubdtype(frames.dtype, np.integer):
        mean = mean_frames(frames)
    else:
        mean = np.where(lost, model[kept], used).mean(axis=0)
    return ScreenedFrames(mean, np.maximum(counts, 1.0), good, len(kept), len(values), jitter, tuple(findings))


def _numbers(frames: NDArray[np.intp]) -> str:
    """``frames 2, 5``, counted from 1."""
    shown = ", ".join(str(k + 1) for k in frames[:8])
    more = f" and {len(frames) - 8} more" if len(frames) > 8 else ""
    return f"frame{'s' * (len(frames) > 1)} {shown}{more}"


def _lit(values: Array, usable: Mask, findings: list[Finding]) -> NDArray[np.intp]:
    """Numbers of the frames that hold the light."""
    edge = np.ones(values.shape[1:], dtype=bool)
    edge[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = False
    inside = usable.all(axis=0)
    border = inside & edge if np.any(inside & edge) else edge
    level = np.median(values[:, border], axis=1)
    light = ((values - level[:, None, None]) * inside).sum(axis=(1, 2))
    # the brightest but for a few: a frame may be bright by accident
    reference = float(np.sort(light)[max(len(light) - 1 - len(light) // 4, 0)])
    dark = light < _DIM * reference
    kept = np.flatnonzero(~dark)
    if 2 * len(kept) < len(values):
        raise FramesError(
            f"{len(values) - len(kept)} of {len(values)} frames hold less than half of the light",
            "record frames of one state under one name, with the light on",
        )
    if np.any(dark):
        findings.append(Finding("missing light", f"{_numbers(np.flatnonzero(dark))} without the spot are left out"))
    return kept


@dataclass(frozen=True, eq=False)
class _Compared:
    """N frames against their reference: model and hits (N, H, W), light and level (N,) with the largest sigma of a
    level, offsets (N, 2) px and their covariance (N, 2, 2).
    """

    model: Array
    hits: Mask
    light: Array
    level: Array
    level_sigma: float
    offset: Array
    spread: Array
    jitter: Array

    def unlike(self) -> Mask:
        """Which frames as a whole."""
        count = np.count_nonzero(self.hits, axis=(1, 2))
        return np.asarray(count > max(_UNLIKE * self.hits[0].size, _FEWEST_UNLIKE))

    def findings(self) -> list[Finding]:
        out = []
        if np.any(self.hits):
            struck = np.flatnonzero(self.hits.any(axis=(1, 2)))
            count = np.count_nonzero(self.hits)
            out.append(Finding("cosmic rays", f"{count} pixels of {_numbers(struck)} are left out"))
        if np.any(self.jitter):
            rms = math.sqrt(float(np.trace(self.jitter)))
            out.append(Finding("movement between frames", f"{rms:.2g} px rms; its share in the mean is added to sigma"))
        drift = float(np.ptp(self.level))
        if drift > max(12.0 * self.level_sigma, _LEAST_DRIFT_DN):
            out.append(Finding("drifting level", f"by {drift:.3g} DN over the frames; it is fitted", corrects=False))
        flicker = float(np.ptp(self.light))
        if flicker > 0.02:
            out.append(Finding("changing light", f"by {100.0 * flicker:.2g} % over the frames", corrects=False))
        return out


def _compared(values: Array, finite: Mask, bad: Mask, noise: NoiseModel) -> _Compared:
    count = len(values)
    # what is saturated does not follow the light
    usable = finite & ~bad & ~_saturated(values, noise)
    blind = np.flatnonzero(~usable.any(axis=(1, 2)))
    if blind.size:
        raise FramesError(
            f"every pixel of {_numbers(blind)} is saturated or known to be bad",
            "frames below saturation, and a map of bad pixels that leaves some",
        )
    threshold = float(norm.isf(FALSE_ALARM / (2.0 * values.size)))
    if count > 2:
        reference = np.broadcast_to(
            np.median(np.where(finite, values, np.median(values, axis=0)), axis=0), values.shape
        )
        excess = 1.0 + _MEDIAN / count
    else:
        reference, excess = values[::-1], 2.0
    model, hits = np.empty_like(values), np.zeros(values.shape, dtype=bool)
    light, level, sigmas = np.empty((3, count))
    offset, spread = np.empty((count, 2)), np.empty((count, 2, 2))
    z = np.empty_like(values)
    # of a median the same for all frames that have not moved
    still = _basis(reference[0]) if count > 2 else None
    for k, frame in enumerate(values):
        weight = usable[k] / (excess * noise.frame_variance_dn2(reference[k]))
        place = np.zeros(2)
        for _ in range(_MOST_MOVES):
            if np.any(place):
                basis = _basis(ndimage.shift(reference[k], place, order=3, mode="nearest"))
            else:
                basis = _basis(reference[k]) if still is None else still
            solution, inverse = _robust(basis, frame, weight)
            # of frames without light nothing can be said
            share = max(abs(float(solution[0])), _LEAST_SHARE)
            further = -solution[1:3] / share
            if np.max(np.abs(further)) < _SMALL_PX or np.max(np.abs(place + further)) > _LARGEST_PX:
                break
            place = place + further
        model[k] = np.tensordot(solution, basis, 1)
        sigma = np.sqrt(excess * noise.frame_variance_dn2(model[k]))
        z[k] = np.where(usable[k], (frame - model[k]) / sigma, 0.0)
        light[k], level[k], sigmas[k] = solution[0], solution[-1], math.sqrt(max(float(inverse[-1, -1]), 0.0))
        # a spot that has moved by d is its reference minus d times the slope
        offset[k] = place + further
        spread[k] = np.clip(inverse[1:3, 1:3], -_UNKNOWN, _UNKNOWN) / share**2
    # of two frames that differ the brighter one was struck
    struck = z > threshold if count == 2 else np.abs(z) > threshold
    for k in range(count):
        hits[k] = _grown(struck[k], np.abs(z[k]) > GROWTH_SIGMAS)
    moved = _jitter(offset, spread, count)
    return _Compared(model, hits, light, level, float(sigmas.max()), offset, spread, moved)


def noise_ratio(
    frames: NDArray[Any], noise: NoiseModel, usable: Mask | None = None, where: Mask | None = None
) -> float | None:
    """Noise of frames that hold the light, beside the spot, over the stated one, by the differences of each to the
    next; None where they agree, and where frames cannot show it.

    Every pair of frames has a say, and the middle one counts, lest one spoilt frame is taken for noise.

    Args:
        frames: (N, H, W) grey values of one state.
        noise: of the detector, as stated.
        usable: (N, H, W) pixels that are good; None for all.
        where: (H, W) pixels to look at; None for those beside the spot.
    """
    values = np.asarray(frames, dtype=np.float64)
    good = np.ones(values.shape, dtype=bool) if usable is None else usable
    try:
        kept = _lit(values, good, [])
    except FramesError:
        return None
    values, good = values[kept], good[kept]
    if len(values) < 2:
        return None
    middle = np.median(values, axis=0)
    low = float(np.median(middle))
    if noise.frame_variance_dn2(low) < rounding.SHOWN**2 + rounding.WHOLE:
        # frames show what rounding makes of it, more or less, as pixels stand between two steps
        return None
    beside = middle < low + _LIT * (float(middle.max()) - low) if where is None else where
    sigma = np.sqrt(2.0 * noise.frame_variance_dn2(middle))
    squares, fewest = [], values[0].size
    for k in range(1, len(values)):
        chosen = beside & good[k] & good[k - 1]
        if not np.any(chosen):
            continue
        difference = (values[k] - values[k - 1])[chosen]
        z2 = ((difference - np.median(difference)) / sigma[chosen]) ** 2
        square = 1.0
        for _ in range(_ROUNDS):
            before, square = square, max(float(np.minimum(z2, _MOST_SIGMAS**2 * square).mean()), 1e-12)
            # noise that is not more than stated is told at once
            if square < (1.0 + _NOISE_OFF) ** 2 or square < 1.001 * before:
                break
        squares.append(square)
        fewest = min(fewest, z2.size)
    if not squares:
        return None
    ratio = math.sqrt(float(np.median(squares)))
    spread = math.sqrt(1.5 / (2.0 * fewest))
    return ratio if max(ratio, 1.0 / ratio) > 1.0 + max(_NOISE_OFF, 6.0 * spread) else None


def shown_noise(frames: NDArray[Any], noise: NoiseModel, ratio: float | None) -> NoiseModel:
    """The detector with the noise that its frames show, where that is more than stated: what is more is taken for read
    noise.

    Args:
        frames: (N, H, W) grey values.
        noise: as stated.
        ratio: see `noise_ratio`.
    """
    if ratio is None or ratio <= 1.0:
        return noise
    own = float(noise.frame_variance_dn2(float(np.median(frames))))
    read = noise.dark_noise_e**2 + (ratio**2 - 1.0) * own / noise.gain_dn_per_e**2
    return replace(noise, dark_noise_e=math.sqrt(read))


def _basis(reference: Array) -> Array:
    """(7, H, W): the reference, its first and second derivatives, and 1."""
    order = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    smooth = [reference, *(ndimage.gaussian_filter(reference, 1.0, one, mode="nearest") for one in order[1:])]
    return np.stack([*smooth, np.ones_like(reference)])


def _robust(basis: Array, frame: Array, weight: Array) -> tuple[Array, Array]:
    """Least squares that outliers do not pull: solution and inverse normal matrix."""
    flat, y = basis.reshape(len(basis), -1), frame.ravel()
    scale = np.sqrt(np.maximum((flat**2).mean(axis=1), 1e-300))
    design, base = flat / scale[:, None], weight.ravel()
    # most pixels are background, of which the median is no outlier
    solution = np.zeros(len(basis))
    solution[0] = scale[0]
    w = base
    for _ in range(4):
        z = np.abs(y - solution @ design) * np.sqrt(base)
        w = base * np.where(z > 3.0, (3.0 / np.maximum(z, 3.0)) ** 2, 1.0)
        normal = (design * w) @ design.T
        solution = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(len(normal)), (design * w) @ y)
    inverse = np.linalg.pinv((design * w) @ design.T, hermitian=True)
    return solution / scale, inverse / np.outer(scale, scale)


def _grown(seed: Mask, grows: Mask) -> Mask:
    """The seeds and all of ``grows`` that hangs together with them."""
    if not np.any(seed):
        return seed
    return np.asarray(ndimage.binary_propagation(seed, np.ones((3, 3)), seed | grows))


def _jitter(offset: Array, spread: Array, count: int) -> Array:
    """Covariance of the places beyond noise, zeros where noise explains them."""
    if count < 3:
        return np.zeros((2, 2))
    away = offset - offset.mean(axis=0)
    chi = float(np.einsum("ki,kij,kj->", away, np.linalg.pinv(spread, hermitian=True), away))
    if chi <= chi2.isf(FALSE_ALARM, 2 * (count - 1)):
        return np.zeros((2, 2))
    value, vector = np.linalg.eigh(away.T @ away / (count - 1) - spread.mean(axis=0))
    # known from few frames only: what makes the mean of the error's square over it 1 (Hotelling's T^2 in a plane)
    few = (count - 1) / max(count - 4, 0.5)
    return np.asarray((vector * np.maximum(value, 0.0) * few) @ vector.T)


def _saturated(values: Array, noise: NoiseModel) -> Mask:
    """Pixels that are saturated in most frames, and those beside them, whose charge may have run over."""
    limit = noise.saturation_dn - _SATURATION_SIGMAS * math.sqrt(noise.frame_variance_dn2(noise.saturation_dn))
    clipped = np.median(values, axis=0) >= limit
    return np.asarray(ndimage.binary_dilation(clipped, np.ones((3, 3)))) if np.any(clipped) else clipped
