"""Room for recorded frames: in memory, or in a file of no name where they are many; and passes over them that hold a
part of them in memory at a time.

The frames of such a file are an array like any other. Pages of it that were read or written count as memory of the
process until it lets them go; the passes here do that after every part. The sums are exact, so that no bit depends on
the parts.
"""

from __future__ import annotations

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
"""Bytes of a state's frames that are kept in memory (more of them are in a file), and that a pass holds at a time."""


def kept_bytes(size: float) -> float:
    """Memory that frames of so many bytes take: all of them, or half of a part, since of the frames before and after
    only one is worked on at a time.
    """
    return size if size <= IN_MEMORY else 0.5 * PART


def frame_room(shape: tuple[int, ...], kind: DTypeLike = np.uint16) -> NDArray[Any]:
    """Room for frames, (..., frames, H, W); what it holds is undefined.

    Parameters
    ----------
    shape : tuple[int, ...]
        Of them all.
    kind : DTypeLike
        Of the grey values.

    Raises
    ------
    OSError
        There is no room on the disk. ``TMPDIR`` names another place.
    """
    size = np.dtype(kind).itemsize * math.prod(shape)
    if size <= IN_MEMORY:
        return np.empty(shape, kind)
    with _file(size) as file:
        return np.frombuffer(mmap.mmap(file.fileno(), size), kind).reshape(shape)


def _file(size: int) -> Any:
    """A file of no name, whose room on the disk is reserved: a full disk is said here, and kills nobody later."""
    # where temporary files are kept in memory, large ones belong there
    place = os.environ.get("TMPDIR") or ("/var/tmp" if os.path.isdir("/var/tmp") else None)
    file = tempfile.TemporaryFile(dir=place)
    try:
        os.posix_fallocate(file.fileno(), 0, max(size, 1))
    except OSError as error:
        file.close()
        named = place or tempfile.gettempdir()
        raise OSError(
            error.errno, f"{size / 1e9:.3g} GB of frames do not fit on the disk (TMPDIR names another)", named
        ) from error
    return file


def in_file(frames: np.ndarray) -> bool:
    """Whether these frames, or those that they are a part of, are in a file."""
    return _map_of(frames) is not None


def let_go(frames: np.ndarray | memoryview | bytes) -> None:
    """Let the memory of frames or contents in a file go; they stay as they are. Nothing happens to others."""
    pages = _map_of(frames)
    if pages is not None:
        pages.madvise(mmap.MADV_DONTNEED)


def _map_of(frames: Any) -> mmap.mmap | None:
    while isinstance(frames, np.ndarray):
        frames = frames.base
    frames = frames.obj if isinstance(frames, memoryview) else frames
    return frames if isinstance(frames, mmap.mmap) else None


def parts(frames: np.ndarray) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
    """Parts of frames (..., N, H, W): index of the image, and some of its frames, (n, H, W)."""
    count, each = frames.shape[-3], frames.itemsize * frames.shape[-2] * frames.shape[-1]
    some = max(1, PART // each)
    for index in np.ndindex(*frames.shape[:-3]):
        for start in range(0, count, some):
            yield index, frames[index][start : start + some]
            let_go(frames)


def mean_of(frames: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Mean over the frame axis, (..., N, H, W) to (..., H, W), as ``mean_frames`` has it."""
    if not in_file(frames):
        return mean_frames(frames)
    total = np.zeros((*frames.shape[:-3], *frames.shape[-2:]), np.int64)
    for index, some in parts(frames):
        total[index] += np.add.reduce(some, axis=0, dtype=np.int64)
    return total / frames.shape[-3]


def largest_of(frames: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Largest value over the frame axis, (..., N, H, W) to (..., H, W)."""
    if not in_file(frames):
        return np.asarray(np.max(frames, axis=-3))
    out = np.zeros((*frames.shape[:-3], *frames.shape[-2:]), frames.dtype)
    for index, some in parts(frames):
        out[index] = np.maximum(out[index], np.max(some, axis=0))
    return out


class FileRoom(io.BufferedRandom):
    """A file of no name to write contents to that are too large for the memory. It is written to as to memory."""

    def __init__(self, size: int) -> None:
        self._file = _file(size)
        super().__init__(io.FileIO(os.dup(self._file.fileno()), "r+"))

    @property
    def name(self) -> str:
        """It has none."""
        return ""

    def fileno(self) -> int:
        """None is told, so that NumPy's own writer, which does not say why it fails, is not used."""
        raise io.UnsupportedOperation("fileno")

    def contents(self) -> memoryview:
        """All that was written, as bytes that are read when they are needed."""
        self.flush()
        size = self.seek(0, io.SEEK_END)
        return memoryview(mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ))
