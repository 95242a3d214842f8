"""What the header of an image file says, before anything is decoded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["ImageError", "ImageHeader", "full_scale"]


class ImageError(Exception):
    """A file, page or region that cannot be read; the message says what to change."""


@dataclass(frozen=True)
class ImageHeader:
    """Of the pages that belong together.

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
