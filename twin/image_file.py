"""Recorded frames as files: TIFF for analysis, PNG to look at."""

from __future__ import annotations

import io

import cv2
import numpy as np
import tifffile

SPOT_STRETCH = 30.0
"""Steepness of an asinh stretch that shows faint diffraction rings beside a spot's core."""

ENLARGE = 4
LARGEST_ENLARGED = 600
"""Rows or columns from which a picture is shown as large as it is."""


def tiff(frames: np.ndarray) -> bytes:
    """Frames (N, H, W) as a TIFF file of N pages."""
    # made in memory: on a full disk NumPy's writer does not say why it failed
    stream = io.BytesIO()
    tifffile.imwrite(stream, frames, photometric="minisblack")
    return stream.getvalue()


def preview(frames: np.ndarray, stretch: float | None = SPOT_STRETCH) -> np.ndarray:
    """Eight-bit picture of the mean of frames (N, H, W), enlarged; ``stretch`` None keeps grey values in proportion."""
    mean = frames.mean(axis=0)
    low, high = (np.percentile(mean, 5) if stretch else mean.min()), mean.max()
    level = np.clip((mean - low) / max(high - low, 1.0), 0.0, 1.0)
    if stretch:
        level = np.arcsinh(stretch * level) / np.arcsinh(stretch)
    factor = ENLARGE if max(mean.shape) < LARGEST_ENLARGED else 1
    return np.kron(np.uint8(np.rint(255.0 * level)), np.ones((factor, factor), np.uint8))


def preview_png(frames: np.ndarray, stretch: float | None = SPOT_STRETCH) -> bytes:
    """``preview`` as a PNG file."""
    ok, encoded = cv2.imencode(".png", preview(frames, stretch))
    if not ok:
        raise OSError("the preview cannot be encoded as PNG")
    return bytes(encoded.tobytes())
