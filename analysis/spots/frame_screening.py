"""Screening of the frames of one spot in one state: pixels and frames that disagree with others are excluded.

The reference is the median of the frames. Each frame is fitted to it by its light, its level and a small movement
(first and second derivatives of the reference). Residuals larger than the noise are excluded from the mean: cosmic rays
and other transients pixel by pixel, frames without the light or unlike the others as a whole. Defects that are the same
in every frame are found by `static_defects`.

The mean of clean frames equals that of `centroid.mean_frames` to the last bit. False alarms: a set of clean frames is
changed with a probability of FALSE_ALARM.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice, pairwise, repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import chi2, norm

from analysis.arrays import Array, Mask, MeasurementError
from analysis.spots.noise import MEASURABLE, ROUNDING_VARIANCE, NoiseModel

FALSE_ALARM = 1e-6
"""Probability that a test rejects anything in clean frames of one spot in one state."""
MEDIAN = math.pi / 2.0
"""Ratio of the variance of the median to that of the mean, for many normally distributed numbers."""
MOST_MOVES = 4
"""Greatest number of iterations in which a frame's movement is fitted, and in which the centroid of its light is found.
"""
_SLOPES, _SMOOTHED = 2.0 / (8.0 * math.pi), 1.0 / (4.0 * math.pi * 1.5**2)
"""Variances of smoothed white noise, relative to the variance of the noise before smoothing.

The first is that of both slopes (sum, per px^2) after a Gaussian of 1 px standard deviation, the second that of the
values after a Gaussian of 1.5 px.
"""
_FAINT, _UNSURE = 0.01, 0.1
"""Fractions of the summed squared slopes of the median image that may be due to noise.

Above the first, only pixels about the spot are used to fit movements; above the second, over these pixels, a movement
cannot be detected.
"""
_LEAST_MOVED_PX, _FARTHEST_PX, _ABOUT_PX, _ALIGNED = 0.3, 12.0, 10.0, 64
"""Rules for aligning moved frames before their median is taken.

They are the smallest median movement and the largest movement for which frames are aligned, in pixels; the radius of
the light whose centroid gives each frame's position, in pixels; and the number of frames of the median.
"""


def reliable_pixels(middle: Array, noise: NoiseModel, count: int, follows: Mask) -> Mask | None:
    """Return the pixels by which light and movement of frames are fitted, (H, W); None if noise dominates slopes.

    For a bright spot these are all pixels. The median of faint frames is noise where there is no light, and so are its
    slopes, so that only the pixels about the spot are used.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    middle : (H, W) ndarray
        Median of the frames, DN.
    noise : NoiseModel
        Noise of the detector.
    count : int
        Number of frames.
    follows : (H, W) ndarray of bool
        Pixels that respond to light, so that they are neither dead nor saturated.
    """
    slopes = sum(ndimage.gaussian_filter(middle, 1.0, order, mode="nearest") ** 2 for order in ((1, 0), (0, 1)))
    low = float(np.median(middle))
    variance = MEDIAN / count * float(noise.frame_variance_dn2(low)) + noise.dsnu_variance_dn2
    if variance * _SLOPES * middle.size < _FAINT * float(np.sum(slopes)):
        return np.ones(middle.shape, dtype=bool)
    # smoothing keeps the light and leaves a tenth of the noise
    smooth = np.where(follows, ndimage.gaussian_filter(middle, 1.5, mode="nearest") - low, 0.0)
    labels, _ = ndimage.label(smooth > 5.0 * math.sqrt(variance * _SMOOTHED))
    top = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    if labels[top] == 0:
        return None
    near = np.asarray(ndimage.binary_dilation(labels == labels[top], np.ones((3, 3)), iterations=2))
    reliable = variance * _SLOPES * np.count_nonzero(near) < _UNSURE * float(np.sum(slopes, where=near))
    return near if reliable else None


def aligned_median(
    each: Callable[[], Iterator[tuple[Array, Mask]]], count: int, middle: Array, follows: Mask
) -> tuple[Array, Array]:
    """Return the median of the frames shifted to a common position, and each frame's displacement, (N, 2) px.

    Where the frames hardly move, these are the plain median and zeros. Positions are first moments of the light about
    the brightest pixel of the median.

    Dimensions: N frames, H rows, W columns.

    Parameters
    ----------
    each : callable
        Function that yields the frames, (H, W) DN, one after the other, each with the mask of its defined pixels.
    count : int
        Number of frames.
    middle : (H, W) ndarray
        Median of the frames, DN.
    follows : (H, W) ndarray of bool
        Pixels that respond to the light.
    """
    low = float(np.median(middle))
    bright = ndimage.gaussian_filter(np.where(follows, middle - low, 0.0), 2.0)
    row, column = np.indices(middle.shape)
    positions = np.empty((count, 2))
    for k, (frame, finite) in enumerate(each()):
        at = np.array(np.unravel_index(int(np.argmax(bright)), middle.shape), np.float64)
        light = np.where(finite & follows, frame - low, 0.0)
        for _ in range(MOST_MOVES):
            inside = np.hypot(row - at[0], column - at[1]) < _ABOUT_PX
            weight = np.maximum(light * inside, 0.0)
            total = float(weight.sum())
            at = np.array([(weight * row).sum(), (weight * column).sum()]) / total if total > 0.0 else at
        positions[k] = at
    positions -= np.median(positions, axis=0)
    # the median, so that a cosmic ray in the light of one frame does not count as movement
    away = np.hypot(positions[:, 0], positions[:, 1])
    if np.median(away) < _LEAST_MOVED_PX or np.max(away) > _FARTHEST_PX:
        return middle, np.zeros_like(positions)
    moved = [
        ndimage.shift(frame, -position, order=3, mode="nearest")
        for (frame, _), position in zip(islice(each(), _ALIGNED), positions, strict=False)
    ]
    return np.median(moved, axis=0), positions


def frame_basis(reference: Array) -> Array:
    """Return the terms that frames are fitted by, (7, H, W).

    They are the reference above its median, its first and second derivatives, and 1.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    reference : (H, W) ndarray
        Reference image, DN.
    """
    order = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    smooth = [reference, *(ndimage.gaussian_filter(reference, 1.0, orders, mode="nearest") for orders in order[1:])]
    return np.stack([smooth[0] - np.median(reference), *smooth[1:], np.ones_like(reference)])


def robust_fit(basis: Array, frame: Array, weight: Array) -> tuple[Array, Array]:
    """Fit terms to a frame by robust least squares; return solution (K,) and inverse normal matrix (K, K).

    Dimensions: K terms, H rows, W columns.

    Parameters
    ----------
    basis : (K, H, W) ndarray
        Terms of the fit.
    frame : (H, W) ndarray
        Frame, DN.
    weight : (H, W) ndarray
        Reciprocal of the variance of each pixel.
    """
    flat, y = basis.reshape(len(basis), -1), frame.ravel()
    scale = np.sqrt(np.maximum((flat**2).mean(axis=1), 1e-300))
    design, base = flat / scale[:, None], weight.ravel()
    # start from the reference itself, since most pixels are background
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


def position_scatter(offset: Array, spread: Array, count: int) -> Array:
    """Return the covariance of the spot's positions over the frames beyond noise, (2, 2) px^2; zeros if none.

    Dimensions: N frames.

    Parameters
    ----------
    offset : (N, 2) ndarray
        Positions of the spot in the frames, px.
    spread : (N, 2, 2) ndarray
        Covariances of these due to noise, px^2.
    count : int
        Number of frames.
    """
    if count < 3:
        return np.zeros((2, 2))
    away = offset - offset.mean(axis=0)
    chi = float(np.einsum("ki,kij,kj->", away, np.linalg.pinv(spread, hermitian=True), away))
    if chi <= chi2.isf(FALSE_ALARM, 2 * (count - 1)):
        return np.zeros((2, 2))
    value, vector = np.linalg.eigh(away.T @ away / (count - 1) - spread.mean(axis=0))
    # the covariance is known from few frames only: this factor makes the mean squared error over it 1 (Hotelling's T^2)
    few = (count - 1) / max(count - 4, 0.5)
    return np.asarray((vector * np.maximum(value, 0.0) * few) @ vector.T)


Released = Callable[[NDArray[Any]], None]
_BATCH_BYTES = 1 << 25
"""Number of bytes of frames that are processed at a time, to limit memory."""
GROWTH_SIGMAS = 3.5
"""Residual, in sigmas, above which a pixel next to a transient (cosmic ray) counts as part of it."""
_DIM = 0.5
"""Fraction of the brightest frame's light below which a frame counts as not containing the spot."""
_UNLIKE = 0.01
"""Fraction of deviating pixels in a frame from which on the whole frame is rejected."""
_FEWEST_UNLIKE = 40
_BORDER_PX = 4
_SATURATION_SIGMAS = 4.0
_LEAST_SHARE, _UNKNOWN, _LEAST_DRIFT_DN = 1e-3, 1e12, 0.5
_ROUNDS = 20
"""Greatest number of iterations in which the clipping limit of differences is adapted to the noise."""
_SMALL_PX, _LARGEST_PX = 0.1, 5.0
"""Movements in pixels: above the first, a frame is compared with the shifted reference; the second is the largest."""
_NOISE_OFF, _MOST_SIGMAS = 0.15, 4.0
"""Tolerated relative difference between measured and specified noise, and clipping limit of differences, in sigmas.

The limit excludes cosmic rays from the estimate of the noise.
"""
_ILLUMINATED = 0.02
"""Fraction of the peak from which a pixel is illuminated, so that movement and smear look like noise there."""
_LEAST_LEVEL_DN = 1.0
"""Smallest difference of the frames' level below the dark level, DN, that counts as a subtracted dark level."""


class FramesError(MeasurementError, ValueError):
    """Error raised for frames that cannot be used.

    Attributes
    ----------
    remedy : str
        Advice on what to do about it.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem)
        self.remedy = remedy


@dataclass(frozen=True)
class Finding:
    """A defect of the frames and its treatment.

    Attributes
    ----------
    kind : str
        Kind of defect, in a few words.
    text : str
        Extent, position and treatment.
    corrects : bool
        True if the measurement was changed because of the defect.
    """

    kind: str
    text: str
    corrects: bool = True


@dataclass(frozen=True, eq=False)
class ScreenedFrames:
    """Usable part of the frames of one spot in one state.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    mean : (H, W) ndarray
        Mean frame, DN.
    counts : (H, W) ndarray
        Number of frames averaged in each pixel.
    good : (H, W) ndarray of bool
        Usable pixels.
    frames : int
        Number of frames used.
    recorded : int
        Number of frames recorded.
    jitter : (2, 2) ndarray
        Covariance of the spot's position over the frames beyond noise, px^2; zeros where none is detected.
    findings : tuple of Finding
        Defects that were found.
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
        """True if no defect of the frames changed the measurement."""
        return not any(finding.corrects for finding in self.findings)


def _in_memory(frames: NDArray[Any]) -> None:
    """Do nothing: the default for `released` if the frames are in memory and no file has to be released."""


@dataclass(frozen=True, eq=False)
class _Stack:
    """Frames of one state, of which a few at a time are in memory as floating-point numbers.

    Dimensions: N frames, H rows, W columns, K frames that are processed.

    Attributes
    ----------
    frames : (N, H, W) ndarray
        Grey values as recorded.
    numbers : (K,) ndarray of int
        Indices of the frames that are processed.
    bad : (H, W) ndarray of bool
        Pixels that are unusable in all frames.
    released : callable
        Function called after some frames, which may lie in a file, have been read.
    blank : bool
        True to set bad pixels to 0.
    """

    frames: NDArray[Any]
    numbers: NDArray[np.intp]
    bad: Mask
    released: Released
    blank: bool = False

    @classmethod
    def of(cls, frames: NDArray[Any], bad: Mask | None, released: Released, blank: bool = False) -> _Stack:
        """Return the stack of all recorded frames of one state."""
        known = np.zeros(frames.shape[1:], dtype=bool) if bad is None else bad
        return cls(frames, np.arange(len(frames)), known, released, blank)

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of a frame."""
        return self.frames.shape[1], self.frames.shape[2]

    def taken(self, numbers: NDArray[np.intp]) -> _Stack:
        """Return the stack of some of the frames, selected by their indices among all recorded frames."""
        return replace(self, numbers=numbers)

    def each(self, backwards: bool = False) -> Iterator[tuple[Array, Mask]]:
        """Yield each frame's values (H, W), 0 where undefined, and the mask of its defined pixels.

        Dimensions: H rows, W columns.
        """
        each = self.frames.itemsize * self.frames[0].size
        for k, number in enumerate(self.numbers[::-1] if backwards else self.numbers):
            yield self._read(self.frames[number], self.bad)
            if (k + 1) * each // _BATCH_BYTES != k * each // _BATCH_BYTES:
                self.released(self.frames)
        self.released(self.frames)

    def _read(self, frames: NDArray[Any], bad: Mask) -> tuple[Array, Mask]:
        values = np.asarray(frames, dtype=np.float64)
        finite = np.isfinite(values)
        return np.where(finite & ~bad if self.blank else finite, values, 0.0), finite

    def known(self) -> tuple[Mask, Mask]:
        """Return two masks (H, W): the pixels that are defined in all frames, and those that are defined in any.

        Dimensions: H rows, W columns.
        """
        all_frames, any_frame = np.ones(self.shape, dtype=bool), np.zeros(self.shape, dtype=bool)
        if np.issubdtype(self.frames.dtype, np.integer):
            return all_frames, ~any_frame
        for _, finite in self.each():
            all_frames &= finite
            any_frame |= finite
        return all_frames, any_frame

    def median(self, filled: bool = False) -> Array:
        """Return the median over the frames, (H, W).

        Dimensions: H rows, W columns.

        Parameters
        ----------
        filled : bool
            True to replace undefined values by that median instead of 0.
        """
        out = np.empty(self.shape)
        rows = max(1, _BATCH_BYTES // (24 * len(self) * self.shape[1]))
        batch = max(1, _BATCH_BYTES // (self.frames.itemsize * self.frames[0].size))
        for start in range(0, self.shape[0], rows):
            band = slice(start, start + rows)
            values = np.empty((len(self), *out[band].shape))
            finite = np.empty(values.shape, dtype=bool)
            for first in range(0, len(self), batch):
                part = slice(first, first + batch)
                values[part], finite[part] = self._read(self.frames[self.numbers[part], band], self.bad[band])
                self.released(self.frames)
            out[band] = np.median(values, axis=0)
            if filled and not finite.all():
                out[band] = np.median(np.where(finite, values, out[band]), axis=0)
        return out


def screen_frames(
    frames: NDArray[Any], noise: NoiseModel, bad: Mask | None = None, released: Released = _in_memory
) -> ScreenedFrames:
    """Exclude saturated pixels and everything that differs between the frames, and average the rest.

    Few of the frames are in memory at a time as floating-point numbers, so that a file may hold many.

    Dimensions: N frames, H rows, W columns.

    Parameters
    ----------
    frames : (N, H, W) ndarray
        Grey values as recorded, integers or real numbers; NaN for undefined pixels.
    noise : NoiseModel
        Noise of the detector.
    bad : (H, W) ndarray of bool or None
        Pixels that are known to be bad; None if there is none.
    released : callable
        Function called after some frames have been read, so that their memory can be released.

    Raises
    ------
    FramesError
        Too few of the frames contain the light, or none of their pixels can be used.
    """
    stack = _Stack.of(frames, bad, released)
    known, (finite, defined) = stack.bad, stack.known()
    findings: list[Finding] = []
    if np.any(known):
        findings.append(Finding("bad pixels", f"{np.count_nonzero(known)} of the bad-pixel map are excluded"))
    if not np.all(finite):
        findings.append(Finding("undefined pixels", f"{np.count_nonzero(~finite)} without a value are excluded"))
    kept = _illuminated(stack, finite & ~known, noise, findings)
    comparison: _Compared | None = None
    jitter = np.zeros((2, 2))
    if len(kept) > 1:
        comparison = _compared(stack.taken(kept), noise)
        unlike = comparison.unlike()
        if np.any(unlike):
            names = _numbers(kept[unlike])
            findings.append(Finding("corrupted frames", f"{names} unlike the others excluded"))
            if np.count_nonzero(~unlike) < 0.5 * len(frames):
                raise FramesError(
                    f"{len(frames) - np.count_nonzero(~unlike)} of {len(frames)} frames are unlike the others or dark",
                    "record frames of one state under one name, with the light on",
                )
            kept = kept[~unlike]
            comparison = _compared(stack.taken(kept), noise) if len(kept) > 1 else None
        if comparison is not None:
            findings += comparison.findings()
            jitter = comparison.jitter
    used = stack.taken(kept)
    saturated = _saturated(used, noise) & ~known
    if np.any(saturated):
        findings.append(
            Finding("saturation", f"{np.count_nonzero(saturated)} saturated and neighbouring pixels are excluded")
        )
    total, lost = _summed(used, comparison)
    counts = len(kept) - lost
    # a pixel that is rejected in more than a third of the frames is unusable
    flickers = (counts < np.ceil(2.0 / 3.0 * len(kept))) & ~known
    if np.any(flickers & defined):
        findings.append(Finding("flickering pixels", f"{np.count_nonzero(flickers)} are excluded"))
    good = ~known & ~saturated & ~flickers
    mean = total / len(kept)
    return ScreenedFrames(mean, np.maximum(counts, 1.0), good, len(kept), len(frames), jitter, tuple(findings))


def _summed(used: _Stack, comparison: _Compared | None) -> tuple[Array, Array]:
    """Return the sum over the frames, with rejected values replaced, and the number of summed frames.

    Both arrays have the shape (H, W), the sum in DN. Rejected values are replaced by the model of their frame. The sum
    of whole numbers is exact; divided by ``len(used)`` it is the mean of `centroid.mean_frames`.

    Dimensions: H rows, W columns.
    """
    total, lost = np.zeros(used.shape), np.zeros(used.shape)
    for k, (values, finite) in enumerate(used.each()):
        gone = ~finite
        if comparison is None:
            values[gone] = 0.0
        else:
            where, instead = comparison.replaced[k]
            values.flat[where] = instead
            gone.flat[where] = True
        total += values
        lost += gone
    return total, lost


def _numbers(frames: NDArray[np.intp]) -> str:
    """Return the text ``frames 2, 5``, counted from 1."""
    shown = ", ".join(str(k + 1) for k in frames[:8])
    more = f" and {len(frames) - 8} more" if len(frames) > 8 else ""
    return f"frame{'s' * (len(frames) > 1)} {shown}{more}"


def _illuminated(stack: _Stack, inside: Mask, noise: NoiseModel, findings: list[Finding]) -> NDArray[np.intp]:
    """Return the indices of the frames that contain the spot's light; ``inside`` are pixels usable in all of them."""
    edge = np.ones(stack.shape, dtype=bool)
    edge[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = False
    border = inside & edge if np.any(inside & edge) else edge
    light = np.array([((values - np.median(values[border])) * inside).sum() for values, _ in stack.each()])
    # the upper quartile, since a few frames may be bright by accident
    reference = float(np.sort(light)[max(len(light) - 1 - len(light) // 4, 0)])
    # the sum over a faint spot is mostly noise and must not count as missing light
    spread = math.sqrt(np.count_nonzero(inside) * float(noise.frame_variance_dn2(noise.dark_level_dn)))
    dark = light < min(_DIM * reference, reference - 5.0 * spread)
    kept = np.flatnonzero(~dark)
    if 2 * len(kept) < len(light):
        raise FramesError(
            f"{len(light) - len(kept)} of {len(light)} frames contain less than half of the light",
            "record frames of one state under one name, with the light on",
        )
    if np.any(dark):
        findings.append(Finding("missing light", f"{_numbers(np.flatnonzero(dark))} without the spot excluded"))
    return kept


@dataclass(frozen=True, eq=False)
class _Compared:
    """Comparison of N frames with a reference image: fitted light, level and displacement, and rejected pixels.

    The fields hold for each frame the number of rejected pixels (N,), the pixels that its model replaces with their
    values, light and level (N,) with the largest sigma of each, displacements (N, 2) in px and their covariance (N, 2,
    2).
    """

    pixels: int
    hits: NDArray[np.int64]
    replaced: tuple[tuple[NDArray[np.intp], Array], ...]
    light: Array
    level: Array
    level_sigma: float
    light_sigma: float
    offset: Array
    spread: Array
    jitter: Array

    def unlike(self) -> Mask:
        """Return the mask of the frames that deviate as a whole, (N,).

        Dimensions: N frames.
        """
        return np.asarray(self.hits > max(_UNLIKE * self.pixels, _FEWEST_UNLIKE))

    def findings(self) -> list[Finding]:
        out = []
        if np.any(self.hits):
            struck = np.flatnonzero(self.hits)
            out.append(Finding("cosmic rays", f"{self.hits.sum()} pixels of {_numbers(struck)} are excluded"))
        if np.any(self.jitter):
            rms = math.sqrt(float(np.trace(self.jitter)))
            out.append(Finding("movement between frames", f"{rms:.2g} px rms; included in sigma"))
        drift = float(np.ptp(self.level))
        if drift > max(12.0 * self.level_sigma, _LEAST_DRIFT_DN):
            out.append(Finding("drifting level", f"{drift:.3g} DN over the frames; fitted", corrects=False))
        flicker = float(np.ptp(self.light))
        if flicker > max(0.02, 12.0 * self.light_sigma):
            out.append(Finding("changing light", f"{100.0 * flicker:.2g} % over the frames", corrects=False))
        return out


def _compared(stack: _Stack, noise: NoiseModel) -> _Compared:
    count, pixels = len(stack), stack.frames[0].size
    # saturated pixels do not respond to the light
    follows = ~stack.bad & ~_saturated(stack, noise)
    blind = np.flatnonzero([not np.any(finite & follows) for _, finite in stack.each()])
    if blind.size:
        raise FramesError(
            f"every pixel of {_numbers(blind)} is saturated or known to be bad",
            "frames below saturation, and a map of bad pixels that leaves some",
        )
    threshold = float(norm.isf(FALSE_ALARM / (2.0 * count * pixels)))
    # the basis is the same for all frames that have not moved
    median = stack.median(filled=True) if count > 2 else None
    positions = np.zeros((count, 2))
    reliable: Mask | None = np.ones(stack.shape, dtype=bool)
    if median is not None:
        reliable = reliable_pixels(median, noise, count, follows)
        if reliable is not None and np.all(reliable):
            median, positions = aligned_median(stack.each, len(stack), median, follows)
    still = None if median is None else frame_basis(median)
    excess = 1.0 + MEDIAN / count if count > 2 else 2.0
    others = repeat(median) if median is not None else (values for values, _ in stack.each(backwards=True))
    light, level, sigmas, light_sigmas = np.empty((4, count))
    offset, spread = np.empty((count, 2)), np.empty((count, 2, 2))
    hits, replaced = np.empty(count, np.int64), []
    for k, ((frame, finite), reference) in enumerate(zip(stack.each(), others, strict=False)):
        usable = finite & follows
        weight = usable / (excess * noise.frame_variance_dn2(reference))
        weight = weight if reliable is None else weight * reliable
        position = positions[k]
        for _ in range(MOST_MOVES):
            if np.any(position):
                basis = frame_basis(ndimage.shift(reference, position, order=3, mode="nearest"))
            else:
                basis = frame_basis(reference) if still is None else still
            solution, inverse = robust_fit(basis, frame, weight)
            # without light a movement is undefined
            share = max(abs(float(solution[0])), _LEAST_SHARE)
            further = -solution[1:3] / share
            if np.max(np.abs(further)) < _SMALL_PX or np.max(np.abs(position + further)) > _LARGEST_PX:
                break
            position = position + further
        model = np.tensordot(solution, basis, 1)
        sigma = np.sqrt(excess * noise.frame_variance_dn2(model))
        z = np.where(usable, (frame - model) / sigma, 0.0)
        light[k], level[k], sigmas[k] = solution[0], solution[-1], math.sqrt(max(float(inverse[-1, -1]), 0.0))
        light_sigmas[k] = math.sqrt(max(float(inverse[0, 0]), 0.0))
        # a spot that has moved by d is its reference minus d times the slope
        offset[k] = position + further
        spread[k] = np.clip(inverse[1:3, 1:3], -_UNKNOWN, _UNKNOWN) / share**2
        # of two frames that differ, the brighter one was hit
        struck = _grown(z > threshold if count == 2 else np.abs(z) > threshold, np.abs(z) > GROWTH_SIGMAS)
        where = np.flatnonzero(struck | ~finite)
        hits[k] = np.count_nonzero(struck)
        replaced.append((where, model.flat[where]))
    moved = np.zeros((2, 2)) if reliable is None else position_scatter(offset, spread, count)
    known = float(sigmas.max()), float(light_sigmas.max())
    return _Compared(pixels, hits, tuple(replaced), light, level, *known, offset, spread, moved)


def noise_ratio(
    frames: NDArray[Any],
    noise: NoiseModel,
    bad: Mask | None = None,
    where: Mask | None = None,
    released: Released = _in_memory,
) -> float | None:
    """Return the ratio of the frames' rms noise to the specified one; None if they agree.

    The noise is that of the differences of each frame to the next, beside the spot, among frames that contain the
    light. The result is the median over all pairs, so that one corrupted frame is not taken for noise. It is also None
    if the frames cannot show the noise.

    Dimensions: N frames, H rows, W columns.

    Parameters
    ----------
    frames : (N, H, W) ndarray
        Grey values of one state; NaN for undefined pixels.
    noise : NoiseModel
        Specified noise of the detector.
    bad : (H, W) ndarray of bool or None
        Unusable pixels; None if there is none.
    where : (H, W) ndarray of bool or None
        Pixels to use; None for those beside the spot.
    released : callable
        Function called after some frames have been read, so that their memory can be released.
    """
    stack = _Stack.of(frames, bad, released, blank=True)
    try:
        kept = _illuminated(stack, stack.known()[0] & ~stack.bad, noise, [])
    except FramesError:
        return None
    stack = stack.taken(kept)
    if len(stack) < 2:
        return None
    middle = stack.median()
    low = float(np.median(middle))
    if noise.frame_variance_dn2(low) < MEASURABLE**2 + ROUNDING_VARIANCE:
        # the variance of the grey values depends on the level between two steps
        return None
    beside = middle < low + _ILLUMINATED * (float(middle.max()) - low) if where is None else where
    beside = beside & ~stack.bad
    sigma = np.sqrt(2.0 * noise.frame_variance_dn2(middle))
    squares, fewest = [], middle.size
    for (last, before), (values, good) in pairwise(stack.each()):
        chosen = beside & good & before
        if not np.any(chosen):
            continue
        difference = (values - last)[chosen]
        z2 = ((difference - np.median(difference)) / sigma[chosen]) ** 2
        square = 1.0
        for _ in range(_ROUNDS):
            known, square = square, max(float(np.minimum(z2, _MOST_SIGMAS**2 * square).mean()), 1e-12)
            # noise within the specification needs no further iteration
            if square < (1.0 + _NOISE_OFF) ** 2 or square < 1.001 * known:
                break
        squares.append(square)
        fewest = min(fewest, z2.size)
    if not squares:
        return None
    ratio = math.sqrt(float(np.median(squares)))
    spread = math.sqrt(1.5 / (2.0 * fewest))
    return ratio if max(ratio, 1.0 / ratio) > 1.0 + max(_NOISE_OFF, 6.0 * spread) else None


def observed_noise(
    frames: NDArray[Any],
    noise: NoiseModel,
    ratio: float | None,
    bad: Mask | None = None,
    released: Released = _in_memory,
) -> NoiseModel:
    """Return the noise model with any excess noise of the frames added as read noise.

    Dimensions: N frames, H rows, W columns.

    Parameters
    ----------
    frames : (N, H, W) ndarray
        Grey values.
    noise : NoiseModel
        Specified noise of the detector.
    ratio : float or None
        Result of `noise_ratio`.
    bad : (H, W) ndarray of bool or None
        Unusable pixels; None if there is none.
    released : callable
        Function called after some frames have been read, so that their memory can be released.
    """
    if ratio is None or ratio <= 1.0:
        return noise
    # the median over all pixels, most of which have no light
    level = float(np.median(_Stack.of(frames, bad, released, blank=True).median()))
    variance = float(noise.frame_variance_dn2(level))
    read = noise.dark_noise_e**2 + (ratio**2 - 1.0) * variance / noise.gain_dn_per_e**2
    return replace(noise, dark_noise_e=math.sqrt(read))


def subtracted_level(
    frames: NDArray[Any], noise: NoiseModel, bad: Mask | None = None, released: Released = _in_memory
) -> float:
    """Return by how many DN the frames' level lies below the dark level of the detector; 0 if not significant.

    Light only adds, so that a level below the dark level was subtracted from the frames. Their shot noise is that of
    the light above the remaining level.

    Dimensions: N frames, H rows, W columns.

    Parameters
    ----------
    frames : (N, H, W) ndarray
        Grey values.
    noise : NoiseModel
        Noise of the detector.
    bad : (H, W) ndarray of bool or None
        Unusable pixels; None if there is none.
    released : callable
        Function called after some frames have been read, so that their memory can be released.
    """
    stack = _Stack.of(frames, bad, released, blank=True)
    middle = stack.median()[~stack.bad]
    away = noise.dark_level_dn - float(np.median(middle))
    pixel = noise.dark_variance_dn2 / len(stack) + noise.dsnu_variance_dn2
    # a median of whole numbers is up to half a grey value off
    return away if away > _LEAST_LEVEL_DN + 6.0 * math.sqrt(MEDIAN * pixel / middle.size) else 0.0


def _grown(seed: Mask, grows: Mask) -> Mask:
    """Return the marked pixels ``seed`` and all pixels of ``grows`` that are connected to them."""
    if not np.any(seed):
        return seed
    return np.asarray(ndimage.binary_propagation(seed, np.ones((3, 3)), seed | grows))


def _saturated(stack: _Stack, noise: NoiseModel) -> Mask:
    """Return the pixels that are saturated in most frames, and their neighbours, which may hold overflowed charge."""
    limit = noise.saturation_dn - _SATURATION_SIGMAS * math.sqrt(noise.frame_variance_dn2(noise.saturation_dn))
    clipped = stack.median() >= limit
    return np.asarray(ndimage.binary_dilation(clipped, np.ones((3, 3)))) if np.any(clipped) else clipped
