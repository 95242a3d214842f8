"""FITS: header and planes of the images in it, primary or extension, cubes, scaled and compressed ones.

A plane's first row is the one stored first (NAXIS2 = 1), wherever a viewer draws it. Values are the physical ones,
BZERO + BSCALE times stored; 16-bit integers with BZERO 32768 stay integers. Undefined pixels (BLANK) are NaN.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.images.image_header import ImageError, ImageHeader, different_pages, full_scale, no_such_page

MAGIC = b"SIMPLE  ="
_SCIENCE = "SCI"
_MJD_ZERO = datetime(1858, 11, 17, tzinfo=UTC)
_NOT_IMAGES = {"ERR", "DQ", "VAR", "MASK", "WHT", "UNCERT", "BPM", "QUALITY"}
"""Names of extensions that go with an image."""


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file's list of units; what it only grumbles about is no error, but a cut-off file is."""
    # takes longer to import than most images to be read
    from astropy.io import fits

    # without a memory map: astropy maps no scaled integers, and sections read what they need anyway
    # opened here, since astropy leaves a file open that it cannot read
    with path.open("rb") as file, warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with fits.open(file, mode="readonly", memmap=False, lazy_load_hdus=False) as units:
            cut = next((str(w.message) for w in told if "truncated" in str(w.message)), "")
            if cut:
                raise ImageError(f"{path} cannot be read as an image: it is cut off ({cut})")
            yield units


def _images(units: Any) -> list[Any]:
    """The units that are images, of those with names the ones that are the measurement."""
    from astropy.io import fits

    kinds = (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU)
    found = [unit for unit in units if isinstance(unit, kinds) and len(unit.shape) >= 2 and 0 not in unit.shape]
    science = [unit for unit in found if str(unit.name).upper() == _SCIENCE]
    return science or [unit for unit in found if str(unit.name).upper() not in _NOT_IMAGES]


def _physical(unit: Any) -> np.dtype[Any]:
    """Type of a unit's values once they are scaled."""
    header = unit.header
    bits, zero, scale = int(header["BITPIX"]), float(header.get("BZERO", 0)), float(header.get("BSCALE", 1))
    if bits < 0:
        return np.dtype(f"f{-bits // 8}")
    if "BLANK" in header:
        return np.dtype("f8")
    if bits == 8 and (zero, scale) == (0.0, 1.0):
        return np.dtype("u1")
    if bits > 8 and (zero, scale) == (2.0 ** (bits - 1), 1.0):
        return np.dtype(f"u{bits // 8}")
    return np.dtype(f"i{bits // 8}") if (zero, scale) == (0.0, 1.0) else np.dtype("f8")


def _planes(units: Any) -> list[tuple[Any, tuple[int, ...]]]:
    """(unit, index of the plane in its cube) in the order of the file."""
    return [(unit, index) for unit in _images(units) for index in np.ndindex(*unit.shape[:-2])]


def fits_header(path: Path, wanted: int | None, choose: str) -> ImageHeader:
    """What the header says of all planes, or of one.

    Args:
        path: of the file.
        wanted: number of the one plane, None for all.
        choose: option that names a plane, for messages.

    Raises:
        ImageError: no image in it, or planes of several kinds.
    """
    with _opened(path) as units:
        planes = _planes(units)
        if not planes:
            raise ImageError(f"{path} holds no image: none of its {len(units)} units has rows and columns")
        if wanted is not None and not 0 <= wanted < len(planes):
            raise no_such_page(path, wanted, len(planes), choose)
        kinds: dict[str, list[int]] = {}
        for number, (unit, _) in enumerate(planes):
            if wanted in (None, number):
                kinds.setdefault(f"{unit.shape[-2]} x {unit.shape[-1]} {_physical(unit)}", []).append(number)
        if len(kinds) > 1:
            raise different_pages(path, kinds, choose)
        (numbers,) = kinds.values()
        unit = planes[numbers[0]][0]
        rows, columns = unit.shape[-2:]
        dtype = _physical(unit)
        size = math.prod((rows, columns)) * max(dtype.itemsize, 2)
        return ImageHeader("FITS", tuple(numbers), rows, columns, 1, size, full_scale(dtype))


def fits_time(path: Path) -> datetime | None:
    """When the first image was recorded, by DATE-BEG, DATE-OBS (with TIME-OBS) or MJD-OBS; None where it does not say.

    Args:
        path: of the file.
    """
    with _opened(path) as units:
        for unit in units:
            header = unit.header
            for key in ("DATE-BEG", "DATE-OBS"):
                text = str(header.get(key, "")).strip()
                if text and "T" not in text and "TIME-OBS" in header:
                    text = f"{text}T{str(header['TIME-OBS']).strip()}"
                if "T" in text:
                    time = datetime.fromisoformat(text)
                    return time if time.tzinfo else time.replace(tzinfo=UTC)
            if "MJD-OBS" in header:
                return _MJD_ZERO + timedelta(days=float(header["MJD-OBS"]))
    return None


def fits_cards(path: Path, number: int) -> dict[str, Any]:
    """Keys and values of the header of the unit that holds a plane.

    Args:
        path: of the file.
        number: of the plane.

    Raises:
        ImageError: a header that cannot be read.
    """
    try:
        with _opened(path) as units:
            header = _planes(units)[number][0].header
            return {str(key): header[key] for key in header if key}
    except ImageError:
        raise
    # what astropy finds wrong with a spoilt card cannot be foreseen
    except Exception as error:
        raise ImageError(f"{path} cannot be read as an image: its header is damaged") from error


def fits_planes(path: Path, pages: Iterable[int]) -> Iterator[NDArray[Any]]:
    """Planes (rows, columns) of physical values.

    Args:
        path: of the file.
        pages: their numbers.
    """
    with _opened(path) as units:
        planes = _planes(units)
        for number in pages:
            unit, index = planes[number]
            yield np.asarray(unit.section[(*index, slice(None), slice(None))])
