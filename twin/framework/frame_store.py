"""Storage of recorded frames, in memory or in an unnamed file if they are large, and reductions over parts of them.

The frames in such a file are an ordinary array. Its pages that were read or written count as memory of the process
until they are released; the reductions here release them after every part. Sums are exact, so that results do not
depend on the parts.
"""

import io
import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from analysis.spots.centroid import mean_frames

IN_MEMORY = PART = 1 << 26
"""Largest size, in bytes, of frames that are kept in memory (larger ones are in a file), and size of the parts in which
sums and maxima over frames are computed.
"""


def resident_bytes(size: float) -> float:
    """Return the resident memory, in bytes, that frames of ``size`` bytes take.

    Frames in memory take their whole size; frames in a file take half of a part, since only one of the two states
    (before and after) is worked on at a time.
    """
    return size if size <= IN_MEMORY else 0.5 * PART


def allocate_frames(shape: tuple[int, ...], kind: DTypeLike = np.uint16) -> NDArray[Any]:
    """Return an uninitialised array for frames, (..., frames, H, W).

    Parameters
    ----------
    shape : tuple of int
        Shape of the array.
    kind : dtype
        Type of the grey values.

    Returns
    -------
    ndarray
        Array in memory, or in an unnamed file if it exceeds IN_MEMORY.

    Raises
    ------
    OSError
        The disk is full. ``TMPDIR`` names another folder.
    """
    size = np.dtype(kind).itemsize * math.prod(shape)
    if size <= IN_MEMORY:
        return np.empty(shape, kind)
    with _file(size) as file:
        return np.frombuffer(mmap.mmap(file.fileno(), size), kind).reshape(shape)


def _file(size: int) -> Any:
    """Open an unnamed file and reserve its space, so that a full disk raises an error here instead of a later crash."""
    # /var/tmp takes large files even where /tmp is in memory
    folder = os.environ.get("TMPDIR") or ("/var/tmp" if os.path.isdir("/var/tmp") else None)
    file = tempfile.TemporaryFile(dir=folder)
    try:
        os.posix_fallocate(file.fileno(), 0, max(size, 1))
    except OSError as error:
        file.close()
        named = folder or tempfile.gettempdir()
        raise OSError(
            error.errno,
            f"{size / 1e9:.3g} GB of frames do not fit on the disk (set TMPDIR to use another folder)",
            named,
        ) from error
    return file


def in_file(frames: np.ndarray) -> bool:
    """Return True if these frames, or the array of which they are a view, are in a file."""
    return _map_of(frames) is not None


def release_memory(frames: np.ndarray | memoryview | bytes) -> None:
    """Release the memory of frames or contents in a file; their values stay, and arrays in memory are unaffected."""
    pages = _map_of(frames)
    if pages is not None:
        pages.madvise(mmap.MADV_DONTNEED)


def _map_of(frames: Any) -> mmap.mmap | None:
    """Return the memory map that holds the frames, or None."""
    while isinstance(frames, np.ndarray):
        frames = frames.base
    frames = frames.obj if isinstance(frames, memoryview) else frames
    return frames if isinstance(frames, mmap.mmap) else None


def parts(frames: np.ndarray) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
    """Yield parts of stored frames (..., N, H, W): index of the image, and n of its N frames, (n, H, W)."""
    count, each = frames.shape[-3], frames.itemsize * frames.shape[-2] * frames.shape[-1]
    length = max(1, PART // each)
    for index in np.ndindex(*frames.shape[:-3]):
        for start in range(0, count, length):
            yield index, frames[index][start : start + length]
            release_memory(frames)


def mean_of(frames: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return the mean over N frames of H x W pixels, (..., N, H, W) to (..., H, W), without loading all of them."""
    if not in_file(frames):
        return mean_frames(frames)
    total = np.zeros((*frames.shape[:-3], *frames.shape[-2:]), np.int64)
    for index, part in parts(frames):
        total[index] += np.add.reduce(part, axis=0, dtype=np.int64)
    return total / frames.shape[-3]


def largest_of(frames: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the maximum of each pixel over N frames of H x W pixels, (..., N, H, W) to (..., H, W)."""
    if not in_file(frames):
        return np.asarray(np.max(frames, axis=-3))
    out = np.zeros((*frames.shape[:-3], *frames.shape[-2:]), frames.dtype)
    for index, part in parts(frames):
        out[index] = np.maximum(out[index], np.max(part, axis=0))
    return out


class FileBuffer(io.BufferedRandom):
    """Unnamed file for contents that are too large for memory, written to like a buffer in memory."""

    def __init__(self, size: int) -> None:
        self._file = _file(size)
        super().__init__(io.FileIO(os.dup(self._file.fileno()), "r+"))

    @property
    def name(self) -> str:
        """Empty name, which libraries ask for: the file has none."""
        return ""

    def fileno(self) -> int:
        """Raise UnsupportedOperation, so that NumPy's own writer is not used: it does not report why writing failed."""
        raise io.UnsupportedOperation("fileno")

    def contents(self) -> memoryview:
        """Return everything written, as bytes that are read when needed."""
        self.flush()
        size = self.seek(0, io.SEEK_END)
        return memoryview(mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ))
