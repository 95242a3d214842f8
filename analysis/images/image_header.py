"""What the header of an image file says before anything is decoded: its size, its numbers and its tone curve."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


class ImageError(Exception):
    """A file, page or region that cannot be read; the message says what to change."""


@dataclass(frozen=True)
class ImageHeader:
    """Header of the pages that belong together.

    Attributes:
        kind: TIFF, FITS, PNG or JPEG.
        pages: their numbers in the file, the first is 0.
        rows, columns: of every page.
        channels: 1 of grey, 2 with alpha, 3 and more of colour.
        page_bytes: of a decoded page.
        full_scale: largest grey value that the file's type holds, infinity for signed and real numbers.
        coded: why grey values probably follow a tone curve and not the light; empty if nothing says so.
        inverted: the largest value is black.
        turned: how the file says that rows and columns are to be drawn, where it is not the order in which they are
            stored; empty if it is.
    """

    kind: str
    pages: tuple[int, ...]
    rows: int
    columns: int
    channels: int
    page_bytes: int
    full_scale: float
    coded: str = ""
    inverted: bool = False
    turned: str = ""


def full_scale(dtype: np.dtype[Any], bits: int | None = None) -> float:
    """Largest value of a type, of which perhaps not all bits are used; infinity for signed and real numbers.

    Args:
        dtype: of the decoded pages.
        bits: of a sample in the file.
    """
    if dtype.kind != "u":
        return math.inf
    return float(2 ** min(8 * dtype.itemsize, bits or 64) - 1)


def different_pages(path: Path, kinds: dict[str, list[int]], choose: str) -> ImageError:
    """The error for pages that do not belong together.

    Args:
        path: of the file.
        kinds: what they are -> their numbers.
        choose: by which option the user can name one, empty for none.
    """
    listed = ", ".join(f"{kind} (first: {numbers[0]})" for kind, numbers in list(kinds.items())[:4])
    remedy = f"say which with {choose} NUMBER" if choose else "save those that belong together as a file of their own"
    return ImageError(f"{path} has pages of different sizes or types, {listed}: {remedy}")


def no_such_page(path: Path, page: int, count: int, choose: str) -> ImageError:
    """The error for a page that is not there.

    Args:
        path: of the file.
        page: its number.
        count: of pages.
        choose: by which option it was named.
    """
    return ImageError(f"{choose or 'page'} {page} does not exist: {path} has {count} pages, the first is 0")


PNG_MAGIC, JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Colour type of a PNG -> channels that it is decoded to."""


def png_header(path: Path) -> ImageHeader:
    """Size, type and named tone curve of a PNG.

    Args:
        path: of the file.

    Raises:
        ImageError: it is cut off or damaged.
    """
    rows = columns = depth = colour = 0
    coded, name, damaged = "", b"", f"{path} cannot be read as an image: it is cut off or damaged"
    with path.open("rb") as file:
        file.seek(8)
        while name != b"IEND" and len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            data, check = file.read(length), file.read(4)
            # libpng would tell the terminal of it
            if len(check) < 4 or struct.unpack(">I", check)[0] != zlib.crc32(data, zlib.crc32(name)):
                raise ImageError(damaged)
            if name == b"IHDR" and length == 13:
                columns, rows, depth, colour = struct.unpack(">IIBB", data[:10])
            elif not rows:  # something stands before it
                raise ImageError(damaged)
            elif name == b"gAMA" and length == 4:
                gamma = struct.unpack(">I", data)[0] * 1e-5
                if not coded and abs(gamma - 1.0) > 0.01:
                    coded = f"it says gamma {gamma:.4g}"
            elif name in (b"sRGB", b"iCCP"):
                coded = "it has a colour profile" if name == b"iCCP" else "it says sRGB"
    if not (rows and columns and name == b"IEND"):
        raise ImageError(damaged)
    if colour not in _PNG_CHANNELS:
        raise ImageError(f"{path} cannot be read as an image: PNG has no colour type {colour}")
    channels = _PNG_CHANNELS[colour]
    dtype = np.dtype(np.uint16 if depth == 16 else np.uint8)
    size = rows * columns * channels * dtype.itemsize
    return ImageHeader("PNG", (0,), rows, columns, channels, size, full_scale(dtype), coded)


def jpeg_header(path: Path) -> ImageHeader:
    """Size of a JPEG; wherever its tables stand.

    Args:
        path: of the file.

    Raises:
        ImageError: it is cut off, damaged, or not of 8 bits.
    """
    data = path.read_bytes()
    place = 2
    while place + 9 < len(data):
        if data[place] != 0xFF:
            break
        marker = data[place + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:
            place += 1 if marker == 0xFF else 2
            continue
        # start of frame, but not the tables of Huffman and arithmetic coding
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            depth, rows, columns, channels = struct.unpack(">BHHB", data[place + 4 : place + 10])
            if not (rows and columns and depth == 8) or data.rfind(b"\xff\xd9") < place:
                break
            # three channels, also of four
            size = rows * columns * min(channels, 3)
            return ImageHeader("JPEG", (0,), rows, columns, min(channels, 3), size, 255.0, "it is a JPEG of 8 bits")
        place += 2 + struct.unpack(">H", data[place + 2 : place + 4])[0]
    raise ImageError(f"{path} cannot be read as an image: it is cut off or damaged, or not a JPEG of 8 bits")
