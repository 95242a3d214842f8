"""TIFF and BigTIFF of either byte order: header and pages, uncompressed, LZW, deflate and what imagecodecs knows."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from analysis.images.image_header import ImageError, ImageHeader, different_pages, full_scale, no_such_page

# what it logs of a spoilt file would stand beside the sentence in which the file is refused
tifffile.logger().addHandler(logging.NullHandler())

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First four bytes."""
_ICC_PROFILE, _ORIENTATION, _EXIF = 34675, 274, 34665
_AXES = {"YX": (0, 1, None), "YXS": (0, 1, 2), "SYX": (1, 2, 0)}
"""Where rows, columns and channels stand in a page."""
_GREY = {"MINISWHITE", "MINISBLACK", "RGB"}
_OTHERS = {
    "PALETTE": "numbers of a palette's colours",
    "MASK": "a mask",
    "SEPARATED": "inks (CMYK)",
    "YCBCR": "YCbCr colours",
    "CIELAB": "Lab colours",
}


def _page(file: tifffile.TiffFile, number: int) -> tifffile.TiffPage:
    page = file.pages[number]
    assert isinstance(page, tifffile.TiffPage)
    return page


def tiff_header(path: Path, wanted: int | None, choose: str) -> ImageHeader:
    """What the header says of all full pages, or of one.

    Args:
        path: of the file.
        wanted: number of the one page, None for all but thumbnails and masks.
        choose: option that names a page, for messages.

    Raises:
        ImageError: no pages, pages of several kinds, no grey values or colours linear in light.
    """
    with tifffile.TiffFile(path) as file:
        file.pages.useframes = False
        count = len(file.pages)
        sizes: dict[tuple[Any, ...], list[int]] = {}
        for number in range(count) if wanted is None else [wanted] if 0 <= wanted < count else []:
            page = _page(file, number)
            # thumbnails and masks say that they are
            if wanted is not None or not (page.is_reduced or page.is_mask):
                sizes.setdefault((page.shape, page.dtype, page.axes), []).append(number)
        if not sizes:
            raise ImageError(f"{path} has no pages") if wanted is None else no_such_page(path, wanted, count, choose)
        if len(sizes) > 1:
            kinds = {f"{' x '.join(map(str, s))} {d}": numbers for (s, d, _), numbers in sizes.items()}
            raise different_pages(path, kinds, choose)
        ((shape, dtype, axes), numbers) = next(iter(sizes.items()))
        page = _page(file, numbers[0])
        if dtype is None or dtype.kind not in "uif":
            raise ImageError(f"{path} holds {dtype} values; grey values must be integers or real numbers")
        if axes not in _AXES:
            raise ImageError(f"{path} has axes {axes}; pages of rows and columns are needed")
        compressed = str(page.compression.name)
        photometric = str(getattr(page.photometric, "name", page.photometric))
        # the decoder of JPEG turns YCbCr into RGB
        if photometric not in _GREY and not (photometric == "YCBCR" and "JPEG" in compressed):
            what = _OTHERS.get(photometric, f"colours of the kind {photometric}")
            raise ImageError(f"{path} holds {what}; save it as grey values, or as RGB linear in light")
        bits, coded = 8 * dtype.itemsize, ""
        if bits == 8 and "JPEG" in compressed:
            coded = "its 8-bit pages are compressed as JPEG"
        elif bits == 8 and _ICC_PROFILE in page.tags:
            coded = "its 8-bit pages have a colour profile"
        orientation = page.tags.valueof(_ORIENTATION, 1)
        rows, columns, channels = (1 if place is None else shape[place] for place in _AXES[axes])
        used = page.bitspersample if isinstance(page.bitspersample, int) else None
        return ImageHeader(
            kind="TIFF",
            pages=tuple(numbers),
            rows=rows,
            columns=columns,
            channels=channels,
            page_bytes=math.prod(shape) * dtype.itemsize,
            full_scale=full_scale(dtype, used),
            coded=coded,
            inverted=photometric == "MINISWHITE",
            turned="" if orientation == 1 else f"orientation {orientation}",
        )


def tiff_origin(path: Path) -> tuple[datetime | None, str]:
    """When the first page was recorded, by Exif's DateTimeOriginal, None where it does not say; and the ``note`` in a
    description that is JSON, as this program writes it.

    Args:
        path: of the file.
    """
    with tifffile.TiffFile(path) as file:
        page = _page(file, 0)
        exif, told = page.tags.valueof(_EXIF) or {}, str(page.description)
    note = str(json.loads(told).get("note", "")) if told.startswith("{") else ""
    found = re.fullmatch(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)\0?", str(exif.get("DateTimeOriginal", "")))
    if found is None:
        return None, note
    fraction = re.sub(r"\D", "", str(exif.get("SubsecTimeOriginal", "")))[:6]
    text = "{}-{}-{}T{}".format(*found.groups()) + (f".{fraction:0<6}" if fraction else "")
    return datetime.fromisoformat(text).replace(tzinfo=UTC), note


def tiff_pages(path: Path, pages: Iterable[int], check: Callable[[], None]) -> Iterator[NDArray[Any]]:
    """Every page, (rows, columns) or with channels last; of an uncompressed one only what is looked at is read.

    Args:
        path: of the file.
        pages: their numbers.
        check: called before a page is decoded as a whole.
    """
    with tifffile.TiffFile(path) as file:
        for number in pages:
            page = _page(file, number)
            if page.is_contiguous and page.dtype is not None:
                stored = page.dtype.newbyteorder(file.byteorder)
                data = file.filehandle.memmap_array(stored, page.shape, page.dataoffsets[0])
            else:
                check()
                data = page.asarray()
            yield np.moveaxis(data, page.axes.index("S"), -1) if "S" in page.axes else data
