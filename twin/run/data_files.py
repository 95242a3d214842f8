"""Data and images in formats that other programs read.

They are made in memory: on a full disk HDF5 crashes the process, and nothing says why.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tifffile

if TYPE_CHECKING:
    import xarray as xr


def netcdf(data: xr.Dataset) -> bytes:
    """A data set as the contents of a netCDF-4 file; the same data give the same bytes."""
    view = data.to_netcdf(engine="h5netcdf")
    content = bytes(view)
    # xarray hands out a window on its buffer, which complains when it is thrown away with the window still open
    if isinstance(view, memoryview):
        view.release()
    return content


def csv_table(rows: Iterable[Sequence[Any]]) -> bytes:
    """Rows, the heads first, as the contents of a CSV file in UTF-8: numbers with all digits, None as an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


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


FRAME_FORMATS: dict[str, Callable[[np.ndarray], bytes]] = {"tiff": tiff}
"""Ending of a file of recorded frames -> its contents, of frames uint16 (N, H, W). A new one is added here."""


def frame_files(name: str, frames: np.ndarray, stretch: float | None = SPOT_STRETCH) -> Iterator[tuple[str, bytes]]:
    """(file, contents) of everything that a run folder has of recorded frames: all formats, and a picture to look at.

    Args:
        name: of the frames.
        frames: uint16 (N, H, W).
        stretch: of the picture, see ``preview``.
    """
    for ending, contents in FRAME_FORMATS.items():
        yield f"images/{name}.{ending}", contents(frames)
    yield f"images/{name}.png", preview_png(frames, stretch)


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
