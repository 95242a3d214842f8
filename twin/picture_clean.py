"""From rendered light to a picture that can be looked at: grain off matt surfaces, brightness to grey values."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

BLUR, BLUR_SHARE = (6.0, 16.0), 0.025
"""Over how many pixels the light on a flat patch is averaged: limits, and share of the root of its area."""
EXPOSURE = 0.88
SHOULDER = 0.75
"""Exposed light above this is compressed, so that nothing is burnt out."""


def still_patches(seen: Sequence[tuple[np.ndarray, np.ndarray]], matt: Sequence[bool]) -> np.ndarray:
    """Numbers of the flat patches of matt surfaces, (H, W); -1 on their borders and everywhere else.

    Args:
        seen: some looks at the scene: number of the part (H, W), -1 for none, and normal (H, W, 3).
        matt: of every part, whether the light on it changes slowly.
    """
    first, square = _patches(*seen[0]), np.ones((3, 3), np.uint8)
    still = np.array([*matt, False])[seen[0][0]]
    for part, normal in seen:  # a border is a pixel that shows two things in any look, and its neighbours
        patches = _patches(part, normal)
        still &= (patches == first) & (cv2.dilate(patches, square) == cv2.erode(patches, square))
    return np.where(still, first, -1.0).astype(np.int64)


def without_grain(image: np.ndarray, patches: np.ndarray) -> np.ndarray:
    """Average the light over each patch; what belongs to none stays as it is.

    Args:
        image: (H, W, 3) rendered light.
        patches: (H, W) numbers, -1 for none.
    """
    out = image.astype(np.float32)
    for value in np.unique(patches[patches >= 0]):
        mask = patches == value
        blur = float(np.clip(BLUR_SHARE * np.sqrt(mask.sum()), *BLUR))
        margin = int(3.0 * blur)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        window = np.s_[max(rows[0] - margin, 0) : rows[-1] + margin, max(columns[0] - margin, 0) : columns[-1] + margin]
        weight = mask[window].astype(np.float32)
        light = cv2.GaussianBlur(image[window].astype(np.float32) * weight[..., None], (0, 0), blur)
        share = cv2.GaussianBlur(weight, (0, 0), blur)
        out[window][mask[window]] = (light / np.maximum(share, 1e-6)[..., None])[mask[window]]
    return out


def displayed(light: np.ndarray) -> np.ndarray:
    """Light -> sRGB grey values, uint8."""
    x = np.clip(EXPOSURE * light, 0.0, None)
    room = 1.0 - SHOULDER
    x = np.where(x > SHOULDER, SHOULDER + room * -np.expm1(-(x - SHOULDER) / room), x)
    grey = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1.0 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * np.clip(grey, 0.0, 1.0)), dtype=np.uint8)


def _patches(part: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A number for every part and direction of its surface, float32 (H, W); exact for up to 16000 parts."""
    steps = np.rint(4.0 * normal).astype(int) + 5
    return (part * 1000 + steps @ np.array([1, 10, 100])).astype(np.float32)
