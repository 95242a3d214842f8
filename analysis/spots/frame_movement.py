"""Movement of a spot from frame to frame, and the terms by which frames are fitted to their median."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
from scipy import ndimage
from scipy.stats import chi2

from analysis.arrays import Array, Mask
from analysis.spots.noise import NoiseModel

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

    Args:
        middle: (H, W) median of the frames, DN.
        noise: of the detector.
        count: number of frames.
        follows: (H, W) pixels that follow the light.
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

    Args:
        each: gives the frames (H, W), DN, one after the other, and where they have a value.
        count: number of frames.
        middle: (H, W) their median, DN.
        follows: (H, W) pixels that follow the light.
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

    Args:
        reference: (H, W) DN.
    """
    order = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    smooth = [reference, *(ndimage.gaussian_filter(reference, 1.0, one, mode="nearest") for one in order[1:])]
    return np.stack([smooth[0] - np.median(reference), *smooth[1:], np.ones_like(reference)])


def robust_fit(basis: Array, frame: Array, weight: Array) -> tuple[Array, Array]:
    """Least squares that outliers do not pull: solution (K,) and inverse normal matrix (K, K).

    Args:
        basis: (K, H, W) terms.
        frame: (H, W) that is fitted.
        weight: (H, W) one over its variance.
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

    Args:
        offset: (N, 2) places of the frames, px.
        spread: (N, 2, 2) their covariances by noise, px^2.
        count: number of frames.
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
