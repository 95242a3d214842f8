"""Frames of one spot in one state, compared with each other: what is not the same in all of them.

The reference is the median of the frames. Each frame is fitted to it by its light, its level and a small movement
(first and second derivatives of the reference), and what sticks out of that by more than noise does is left out of the
mean: cosmic rays and other transients pixel by pixel, frames without the light or unlike the others as a whole. What is
the same in every frame is found by `static_defects`.

The mean of clean frames is that of `centroid.mean_frames`, to the bit. False alarms: a set of clean frames is changed
once in 1 / FALSE_ALARM.

Movement of a spot from frame to frame, and the terms by which frames are fitted to their median.
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
from analysis.spots.noise import SHOWN, WHOLE, NoiseModel

FALSE_ALARM = 1e-6
"""Chance that a test finds something in clean frames of one spot in one state."""
MEDIAN = math.pi / 2.0
"""Variance of a median over that of a mean, of many normal numbers."""
MOST_MOVES = 4
"""Steps in which a frame that has moved is followed, and in which the place of its light is found."""
_SLOPES, _SMOOTHED = 2.0 / (8.0 * math.pi), 1.0 / (4.0 * math.pi * 1.5**2)
"""Variance of both slopes of white noise through a normal distribution of 1 px, and of what one of 1.5 px leaves of it,
over its own."""
_FAINT, _UNSURE = 0.01, 0.1
"""Share of noise in the squares of the slopes of a median from which only pixels about the spot count, and from which a
movement cannot be told."""
_LEAST_MOVED_PX, _FARTHEST_PX, _ABOUT_PX, _ALIGNED = 0.3, 12.0, 10.0, 64
"""Movement (in the median, and the farthest of a frame) for which frames are aligned before their median is taken, the
radius of the light that says where each is, and the number of frames of that median."""


def shown_pixels(middle: Array, noise: NoiseModel, count: int, follows: Mask) -> Mask | None:
    """Pixels (H, W) by which the light and the movement of frames are fitted: all of a bright spot. The median of faint
    frames is noise where there is no light, and its slopes are, so that only those about the spot count; None where
    the slopes there are noise as well.

    Parameters
    ----------
    middle : Array
        (H, W) median of the frames, DN.
    noise : NoiseModel
        Of the detector.
    count : int
        Number of frames.
    follows : Mask
        (H, W) pixels that follow the light.
    """
    slopes = sum(ndimage.gaussian_filter(middle, 1.0, one, mode="nearest") ** 2 for one in ((1, 0), (0, 1)))
    low = float(np.median(middle))
    variance = MEDIAN / count * float(noise.frame_variance_dn2(low)) + noise.dsnu_variance_dn2
    if variance * _SLOPES * middle.size < _FAINT * float(np.sum(slopes)):
        return np.ones(middle.shape, dtype=bool)
    # the same light in a tenth of the noise
    smooth = np.where(follows, ndimage.gaussian_filter(middle, 1.5, mode="nearest") - low, 0.0)
    own, _ = ndimage.label(smooth > 5.0 * math.sqrt(variance * _SMOOTHED))
    at = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    if own[at] == 0:
        return None
    about = np.asarray(ndimage.binary_dilation(own == own[at], np.ones((3, 3)), iterations=2))
    known = variance * _SLOPES * np.count_nonzero(about) < _UNSURE * float(np.sum(slopes, where=about))
    return about if known else None


def aligned(
    each: Callable[[], Iterator[tuple[Array, Mask]]], count: int, middle: Array, follows: Mask
) -> tuple[Array, Array]:
    """The median of frames that are moved to one place, and by how much (N, 2) each is off that; the plain median and
    zeros where they hardly move. Places are first moments of the light about the brightest pixel of the median.

    Parameters
    ----------
    each : Callable[[], Iterator[tuple[Array, Mask]]]
        Gives the frames (H, W), DN, one after the other, and where they have a value.
    count : int
        Number of frames.
    middle : Array
        (H, W) their median, DN.
    follows : Mask
        (H, W) pixels that follow the light.
    """
    low = float(np.median(middle))
    bright = ndimage.gaussian_filter(np.where(follows, middle - low, 0.0), 2.0)
    row, column = np.indices(middle.shape)
    places = np.empty((count, 2))
    for k, (frame, finite) in enumerate(each()):
        at = np.array(np.unravel_index(int(np.argmax(bright)), middle.shape), np.float64)
        light = np.where(finite & follows, frame - low, 0.0)
        for _ in range(MOST_MOVES):
            inside = np.hypot(row - at[0], column - at[1]) < _ABOUT_PX
            weight = np.maximum(light * inside, 0.0)
            total = float(weight.sum())
            at = np.array([(weight * row).sum(), (weight * column).sum()]) / total if total > 0.0 else at
        places[k] = at
    places -= np.median(places, axis=0)
    # in the median, lest a cosmic ray in the light of a frame is taken for movement
    away = np.hypot(places[:, 0], places[:, 1])
    if np.median(away) < _LEAST_MOVED_PX or np.max(away) > _FARTHEST_PX:
        return middle, np.zeros_like(places)
    moved = [
        ndimage.shift(frame, -place, order=3, mode="nearest")
        for (frame, _), place in zip(islice(each(), _ALIGNED), places, strict=False)
    ]
    return np.median(moved, axis=0), places


def basis_of(reference: Array) -> Array:
    """(7, H, W): the reference over its median, its first and second derivatives, and 1.

    Parameters
    ----------
    reference : Array
        (H, W) DN.
    """
    order = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    smooth = [reference, *(ndimage.gaussian_filter(reference, 1.0, one, mode="nearest") for one in order[1:])]
    return np.stack([smooth[0] - np.median(reference), *smooth[1:], np.ones_like(reference)])


def robust_fit(basis: Array, frame: Array, weight: Array) -> tuple[Array, Array]:
    """Least squares that outliers do not pull: solution (K,) and inverse normal matrix (K, K).

    Parameters
    ----------
    basis : Array
        (K, H, W) terms.
    frame : Array
        (H, W) that is fitted.
    weight : Array
        (H, W) one over its variance.
    """
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


def place_scatter(offset: Array, spread: Array, count: int) -> Array:
    """Covariance (2, 2) of the places beyond noise, px^2; zeros where noise explains them.

    Parameters
    ----------
    offset : Array
        (N, 2) places of the frames, px.
    spread : Array
        (N, 2, 2) their covariances by noise, px^2.
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
    # known from few frames only: what makes the mean of the error's square over it 1 (Hotelling's T^2 in a plane)
    few = (count - 1) / max(count - 4, 0.5)
    return np.asarray((vector * np.maximum(value, 0.0) * few) @ vector.T)


Released = Callable[[NDArray[Any]], None]
_HELD = 1 << 25
"""Bytes of frames that are worked on at a time."""
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
_SMALL_PX, _LARGEST_PX = 0.1, 5.0
"""A frame that has moved by more than the first is compared with the reference there, up to the second."""
_NOISE_OFF, _MOST_SIGMAS = 0.15, 4.0
"""By which the noise of frames may differ from the stated one, as a share of that; and where single differences are cut
off, in standard deviations, for cosmic rays."""
_LIT = 0.02
"""Share of the peak from which a pixel is in the light, where movement and smear look like noise."""
_LEAST_LEVEL_DN = 1.0
"""By which the level of frames is below the dark level before it counts as subtracted."""


class FramesError(MeasurementError, ValueError):
    """Frames that cannot be used.

    Attributes
    ----------
    remedy
        What to do about it.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem)
        self.remedy = remedy


@dataclass(frozen=True)
class Finding:
    """What was found, and what became of it.

    Attributes
    ----------
    kind : str
        What it is, a few words.
    text : str
        How much and where, and what was done.
    corrects : bool
        Whether the measurement was changed for it.
    """

    kind: str
    text: str
    corrects: bool = True


@dataclass(frozen=True, eq=False)
class ScreenedFrames:
    """What is used of the frames of one spot in one state.

    Attributes
    ----------
    mean : Array
        (H, W) DN.
    counts : Array
        (H, W) frames that each pixel is the mean of.
    good : Mask
        (H, W) pixels that can be used.
    frames : int
        Number of frames that are used.
    recorded : int
        Number of frames that there are.
    jitter : Array
        (2, 2) px^2, covariance of the spot's place over the frames beyond noise; zeros where none is seen.
    findings : tuple[Finding, ...]
        What was found.
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


def _kept(frames: NDArray[Any]) -> None:
    """Frames that are in memory anyway."""


@dataclass(frozen=True, eq=False)
class _Stack:
    """Frames of one state of which a few at a time are in memory as real numbers.

    Attributes
    ----------
    frames : NDArray[Any]
        (N, H, W) grey values as recorded.
    numbers : NDArray[np.intp]
        (K,) of the frames that are looked at.
    bad : Mask
        (H, W) pixels that are of no use in any frame.
    released : Released
        Is told when some frames have been gone over, which may lie in a file.
    blank : bool
        Whether bad pixels are taken as 0.
    """

    frames: NDArray[Any]
    numbers: NDArray[np.intp]
    bad: Mask
    released: Released
    blank: bool = False

    @classmethod
    def of(cls, frames: NDArray[Any], bad: Mask | None, released: Released, blank: bool = False) -> _Stack:
        """All frames."""
        known = np.zeros(frames.shape[1:], dtype=bool) if bad is None else bad
        return cls(frames, np.arange(len(frames)), known, released, blank)

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.frames.shape[1], self.frames.shape[2]

    def taken(self, numbers: NDArray[np.intp]) -> _Stack:
        """Some of the frames, by their numbers among all."""
        return replace(self, numbers=numbers)

    def each(self, backwards: bool = False) -> Iterator[tuple[Array, Mask]]:
        """Frame after frame: (H, W) its values, 0 where it has none, and where it has one."""
        each = self.frames.itemsize * self.frames[0].size
        for k, number in enumerate(self.numbers[::-1] if backwards else self.numbers):
            yield self._read(self.frames[number], self.bad)
            if (k + 1) * each // _HELD != k * each // _HELD:
                self.released(self.frames)
        self.released(self.frames)

    def _read(self, frames: NDArray[Any], bad: Mask) -> tuple[Array, Mask]:
        values = np.asarray(frames, dtype=np.float64)
        finite = np.isfinite(values)
        return np.where(finite & ~bad if self.blank else finite, values, 0.0), finite

    def known(self) -> tuple[Mask, Mask]:
        """(H, W) pixels that have a value in all frames, and in any."""
        every, some = np.ones(self.shape, dtype=bool), np.zeros(self.shape, dtype=bool)
        if np.issubdtype(self.frames.dtype, np.integer):
            return every, ~some
        for _, finite in self.each():
            every &= finite
            some |= finite
        return every, some

    def median(self, filled: bool = False) -> Array:
        """(H, W) medians over the frames.

        Parameters
        ----------
        filled : bool
            Where a frame has no value it has that median, instead of 0.
        """
        out = np.empty(self.shape)
        rows = max(1, _HELD // (24 * len(self) * self.shape[1]))
        some = max(1, _HELD // (self.frames.itemsize * self.frames[0].size))
        for start in range(0, self.shape[0], rows):
            own = slice(start, start + rows)
            values = np.empty((len(self), *out[own].shape))
            finite = np.empty(values.shape, dtype=bool)
            for first in range(0, len(self), some):
                part = slice(first, first + some)
                values[part], finite[part] = self._read(self.frames[self.numbers[part], own], self.bad[own])
                self.released(self.frames)
            out[own] = np.median(values, axis=0)
            if filled and not finite.all():
                out[own] = np.median(np.where(finite, values, out[own]), axis=0)
        return out


def screen_frames(
    frames: NDArray[Any], noise: NoiseModel, bad: Mask | None = None, released: Released = _kept
) -> ScreenedFrames:
    """Leave out what is not the same in all frames, and what is saturated.

    Few of the frames are in memory at a time as real numbers, so that there may be many of them in a file.

    Parameters
    ----------
    frames : NDArray[Any]
        (N, H, W) grey values as recorded, integers or real numbers; NaN for pixels without a value.
    noise : NoiseModel
        Of the detector.
    bad : Mask | None
        (H, W) pixels that are known to be bad; None for none.
    released : Released
        Is told when some frames have been gone over.

    Raises
    ------
    FramesError
        Too few of the frames hold the light, or none of their pixels can be used.
    """
    stack = _Stack.of(frames, bad, released)
    known, (finite, defined) = stack.bad, stack.known()
    findings: list[Finding] = []
    if np.any(known):
        findings.append(Finding("bad pixels", f"{np.count_nonzero(known)} of the bad-pixel map are left out"))
    if not np.all(finite):
        findings.append(Finding("undefined pixels", f"{np.count_nonzero(~finite)} without a value are left out"))
    kept = _lit(stack, finite & ~known, noise, findings)
    found: _Compared | None = None
    jitter = np.zeros((2, 2))
    if len(kept) > 1:
        found = _compared(stack.taken(kept), noise)
        unlike = found.unlike()
        if np.any(unlike):
            names = _numbers(kept[unlike])
            findings.append(Finding("spoilt frames", f"{names} unlike the others are left out"))
            if np.count_nonzero(~unlike) < 0.5 * len(frames):
                raise FramesError(
                    f"{len(frames) - np.count_nonzero(~unlike)} of {len(frames)} frames are unlike the others or dark",
                    "record frames of one state under one name, with the light on",
                )
            kept = kept[~unlike]
            found = _compared(stack.taken(kept), noise) if len(kept) > 1 else None
        if found is not None:
            findings += found.findings()
            jitter = found.jitter
    used = stack.taken(kept)
    saturated = _saturated(used, noise) & ~known
    if np.any(saturated):
        findings.append(
            Finding("saturation", f"{np.count_nonzero(saturated)} pixels at and beside saturated ones are left out")
        )
    total, lost = _summed(used, found)
    counts = len(kept) - lost
    # a pixel that flickers in more than a third of the frames is no detector of light
    flickers = (counts < np.ceil(2.0 / 3.0 * len(kept))) & ~known
    if np.any(flickers & defined):
        findings.append(Finding("flickering pixels", f"{np.count_nonzero(flickers)} are left out"))
    good = ~known & ~saturated & ~flickers
    mean = total / len(kept)
    return ScreenedFrames(mean, np.maximum(counts, 1.0), good, len(kept), len(frames), jitter, tuple(findings))


def _summed(used: _Stack, found: _Compared | None) -> tuple[Array, Array]:
    """(H, W) sums over the frames, in which what is lost has its model's value, and how many are lost. Of whole numbers
    the sum is exact, and by ``len(used)`` the mean of `centroid.mean_frames`.
    """
    total, lost = np.zeros(used.shape), np.zeros(used.shape)
    for k, (values, finite) in enumerate(used.each()):
        gone = ~finite
        if found is None:
            values[gone] = 0.0
        else:
            where, instead = found.replaced[k]
            values.flat[where] = instead
            gone.flat[where] = True
        total += values
        lost += gone
    return total, lost


def _numbers(frames: NDArray[np.intp]) -> str:
    """``frames 2, 5``, counted from 1."""
    shown = ", ".join(str(k + 1) for k in frames[:8])
    more = f" and {len(frames) - 8} more" if len(frames) > 8 else ""
    return f"frame{'s' * (len(frames) > 1)} {shown}{more}"


def _lit(stack: _Stack, inside: Mask, noise: NoiseModel, findings: list[Finding]) -> NDArray[np.intp]:
    """Numbers of the frames that hold the light; ``inside`` are the pixels that can be used in all of them."""
    edge = np.ones(stack.shape, dtype=bool)
    edge[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = False
    border = inside & edge if np.any(inside & edge) else edge
    light = np.array([((values - np.median(values[border])) * inside).sum() for values, _ in stack.each()])
    # the brightest but for a few: a frame may be bright by accident
    reference = float(np.sort(light)[max(len(light) - 1 - len(light) // 4, 0)])
    # the sum of faint light is noise, which is no missing light
    spread = math.sqrt(np.count_nonzero(inside) * float(noise.frame_variance_dn2(noise.dark_level_dn)))
    dark = light < min(_DIM * reference, reference - 5.0 * spread)
    kept = np.flatnonzero(~dark)
    if 2 * len(kept) < len(light):
        raise FramesError(
            f"{len(light) - len(kept)} of {len(light)} frames hold less than half of the light",
            "record frames of one state under one name, with the light on",
        )
    if np.any(dark):
        findings.append(Finding("missing light", f"{_numbers(np.flatnonzero(dark))} without the spot are left out"))
    return kept


@dataclass(frozen=True, eq=False)
class _Compared:
    """N frames of so many pixels against their reference: of each the number of pixels that were hit (N,), and which
    pixels its model replaces by what values; light and level (N,) with the largest sigma of each, offsets (N, 2) px and
    their covariance (N, 2, 2).
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
        """Which frames as a whole."""
        return np.asarray(self.hits > max(_UNLIKE * self.pixels, _FEWEST_UNLIKE))

    def findings(self) -> list[Finding]:
        out = []
        if np.any(self.hits):
            struck = np.flatnonzero(self.hits)
            out.append(Finding("cosmic rays", f"{self.hits.sum()} pixels of {_numbers(struck)} are left out"))
        if np.any(self.jitter):
            rms = math.sqrt(float(np.trace(self.jitter)))
            out.append(Finding("movement between frames", f"{rms:.2g} px rms; its share in the mean is added to sigma"))
        drift = float(np.ptp(self.level))
        if drift > max(12.0 * self.level_sigma, _LEAST_DRIFT_DN):
            out.append(Finding("drifting level", f"by {drift:.3g} DN over the frames; it is fitted", corrects=False))
        flicker = float(np.ptp(self.light))
        if flicker > max(0.02, 12.0 * self.light_sigma):
            out.append(Finding("changing light", f"by {100.0 * flicker:.2g} % over the frames", corrects=False))
        return out


def _compared(stack: _Stack, noise: NoiseModel) -> _Compared:
    count, pixels = len(stack), stack.frames[0].size
    # what is saturated does not follow the light
    follows = ~stack.bad & ~_saturated(stack, noise)
    blind = np.flatnonzero([not np.any(finite & follows) for _, finite in stack.each()])
    if blind.size:
        raise FramesError(
            f"every pixel of {_numbers(blind)} is saturated or known to be bad",
            "frames below saturation, and a map of bad pixels that leaves some",
        )
    threshold = float(norm.isf(FALSE_ALARM / (2.0 * count * pixels)))
    # of a median the same for all frames that have not moved
    middle = stack.median(filled=True) if count > 2 else None
    places = np.zeros((count, 2))
    shown: Mask | None = np.ones(stack.shape, dtype=bool)
    if middle is not None:
        shown = shown_pixels(middle, noise, count, follows)
        if shown is not None and np.all(shown):
            middle, places = aligned(stack.each, len(stack), middle, follows)
    still = None if middle is None else basis_of(middle)
    excess = 1.0 + MEDIAN / count if count > 2 else 2.0
    others = repeat(middle) if middle is not None else (values for values, _ in stack.each(backwards=True))
    light, level, sigmas, light_sigmas = np.empty((4, count))
    offset, spread = np.empty((count, 2)), np.empty((count, 2, 2))
    hits, replaced = np.empty(count, np.int64), []
    for k, ((frame, finite), reference) in enumerate(zip(stack.each(), others, strict=False)):
        usable = finite & follows
        weight = usable / (excess * noise.frame_variance_dn2(reference))
        weight = weight if shown is None else weight * shown
        place = places[k]
        for _ in range(MOST_MOVES):
            if np.any(place):
                basis = basis_of(ndimage.shift(reference, place, order=3, mode="nearest"))
            else:
                basis = basis_of(reference) if still is None else still
            solution, inverse = robust_fit(basis, frame, weight)
            # of frames without light nothing can be said
            share = max(abs(float(solution[0])), _LEAST_SHARE)
            further = -solution[1:3] / share
            if np.max(np.abs(further)) < _SMALL_PX or np.max(np.abs(place + further)) > _LARGEST_PX:
                break
            place = place + further
        model = np.tensordot(solution, basis, 1)
        sigma = np.sqrt(excess * noise.frame_variance_dn2(model))
        z = np.where(usable, (frame - model) / sigma, 0.0)
        light[k], level[k], sigmas[k] = solution[0], solution[-1], math.sqrt(max(float(inverse[-1, -1]), 0.0))
        light_sigmas[k] = math.sqrt(max(float(inverse[0, 0]), 0.0))
        # a spot that has moved by d is its reference minus d times the slope
        offset[k] = place + further
        spread[k] = np.clip(inverse[1:3, 1:3], -_UNKNOWN, _UNKNOWN) / share**2
        # of two frames that differ the brighter one was struck
        struck = _grown(z > threshold if count == 2 else np.abs(z) > threshold, np.abs(z) > GROWTH_SIGMAS)
        where = np.flatnonzero(struck | ~finite)
        hits[k] = np.count_nonzero(struck)
        replaced.append((where, model.flat[where]))
    moved = np.zeros((2, 2)) if shown is None else place_scatter(offset, spread, count)
    known = float(sigmas.max()), float(light_sigmas.max())
    return _Compared(pixels, hits, tuple(replaced), light, level, *known, offset, spread, moved)


def noise_ratio(
    frames: NDArray[Any],
    noise: NoiseModel,
    bad: Mask | None = None,
    where: Mask | None = None,
    released: Released = _kept,
) -> float | None:
    """Noise of frames that hold the light, beside the spot, over the stated one, by the differences of each to the
    next; None where they agree, and where frames cannot show it.

    Every pair of frames has a say, and the middle one counts, lest one spoilt frame is taken for noise.

    Parameters
    ----------
    frames : NDArray[Any]
        (N, H, W) grey values of one state; NaN for pixels without a value.
    noise : NoiseModel
        Of the detector, as stated.
    bad : Mask | None
        (H, W) pixels that are not to be used; None for none.
    where : Mask | None
        (H, W) pixels to look at; None for those beside the spot.
    released : Released
        Is told when some frames have been gone over.
    """
    stack = _Stack.of(frames, bad, released, blank=True)
    try:
        kept = _lit(stack, stack.known()[0] & ~stack.bad, noise, [])
    except FramesError:
        return None
    stack = stack.taken(kept)
    if len(stack) < 2:
        return None
    middle = stack.median()
    low = float(np.median(middle))
    if noise.frame_variance_dn2(low) < SHOWN**2 + WHOLE:
        # frames show what rounding makes of it, more or less, as pixels stand between two steps
        return None
    beside = middle < low + _LIT * (float(middle.max()) - low) if where is None else where
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
            # noise that is not more than stated is told at once
            if square < (1.0 + _NOISE_OFF) ** 2 or square < 1.001 * known:
                break
        squares.append(square)
        fewest = min(fewest, z2.size)
    if not squares:
        return None
    ratio = math.sqrt(float(np.median(squares)))
    spread = math.sqrt(1.5 / (2.0 * fewest))
    return ratio if max(ratio, 1.0 / ratio) > 1.0 + max(_NOISE_OFF, 6.0 * spread) else None


def shown_noise(
    frames: NDArray[Any], noise: NoiseModel, ratio: float | None, bad: Mask | None = None, released: Released = _kept
) -> NoiseModel:
    """The detector with the noise that its frames show, where that is more than stated: what is more is taken for read
    noise.

    Parameters
    ----------
    frames : NDArray[Any]
        (N, H, W) grey values.
    noise : NoiseModel
        As stated.
    ratio : float | None
        See `noise_ratio`.
    bad : Mask | None
        As there.
    released : Released
        As there.
    """
    if ratio is None or ratio <= 1.0:
        return noise
    # of the medians of all pixels, most of which have no light
    level = float(np.median(_Stack.of(frames, bad, released, blank=True).median()))
    own = float(noise.frame_variance_dn2(level))
    read = noise.dark_noise_e**2 + (ratio**2 - 1.0) * own / noise.gain_dn_per_e**2
    return replace(noise, dark_noise_e=math.sqrt(read))


def subtracted_level(
    frames: NDArray[Any], noise: NoiseModel, bad: Mask | None = None, released: Released = _kept
) -> float:
    """Return by how much the level of frames beside the spot is below the detector's dark level, DN; 0 where it is not.

    Light only adds, so that a level of frames below that in the dark was subtracted from them. Their shot noise is that
    of the light above the level that is left.

    Parameters
    ----------
    frames : NDArray[Any]
        (N, H, W) grey values.
    noise : NoiseModel
        Of the detector.
    bad : Mask | None
        (H, W) pixels that are not to be used; None for none.
    released : Released
        Is told when some frames have been gone over.
    """
    stack = _Stack.of(frames, bad, released, blank=True)
    middle = stack.median()[~stack.bad]
    away = noise.dark_level_dn - float(np.median(middle))
    pixel = noise.dark_variance_dn2 / len(stack) + noise.dsnu_variance_dn2
    # a median of whole numbers stands up to half a grey value off
    return away if away > _LEAST_LEVEL_DN + 6.0 * math.sqrt(MEDIAN * pixel / middle.size) else 0.0


def _grown(seed: Mask, grows: Mask) -> Mask:
    """The seeds and all of ``grows`` that hangs together with them."""
    if not np.any(seed):
        return seed
    return np.asarray(ndimage.binary_propagation(seed, np.ones((3, 3)), seed | grows))


def _saturated(stack: _Stack, noise: NoiseModel) -> Mask:
    """Pixels that are saturated in most frames, and those beside them, whose charge may have run over."""
    limit = noise.saturation_dn - _SATURATION_SIGMAS * math.sqrt(noise.frame_variance_dn2(noise.saturation_dn))
    clipped = stack.median() >= limit
    return np.asarray(ndimage.binary_dilation(clipped, np.ones((3, 3)))) if np.any(clipped) else clipped
