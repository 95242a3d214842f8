"""Reader of image files as grey values that are linear in light: TIFF, FITS, PNG and JPEG.

It reads regions of all pages, or frames as they are stored. The header (size, type of the numbers, tone curve) is read
first, so that an image that does not fit into memory is refused before it is decoded. Of an uncompressed TIFF and of a
FITS file only the required part is read.

FITS: header and planes of the images in the file, primary or extension, cubes, scaled and compressed ones. A plane's
first row is the one stored first (NAXIS2 = 1), wherever a viewer draws it. Values are the physical ones, BZERO + BSCALE
times stored; 16-bit integers with BZERO 32768 stay integers. Undefined pixels (BLANK) are NaN.

TIFF and BigTIFF of either byte order: header and pages, uncompressed, LZW, deflate and the codecs of imagecodecs.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import struct
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from analysis.arrays import Array


class ImageError(Exception):
    """Error raised for a file, page or region that cannot be read; the message says what to change."""


@dataclass(frozen=True)
class ImageHeader:
    """Header of the pages of an image file that belong together.

    Attributes
    ----------
    kind : str
        TIFF, FITS, PNG or JPEG.
    pages : tuple of int
        Numbers of the pages in the file; the first is 0.
    rows, columns : int
        Size of every page, pixels.
    channels : int
        1 for grey, 2 with alpha, 3 and more for colour.
    page_bytes : int
        Size of a decoded page, bytes.
    full_scale : float
        Largest grey value of the file's type; infinity for signed and real numbers.
    coded : str
        Reason why grey values probably follow a tone curve instead of the light; empty if there is none.
    inverted : bool
        True if the largest value is black.
    orientation : str
        Orientation in which the file says that rows and columns are to be drawn, where it differs from the order in
        which they are stored; empty if not.
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
    orientation: str = ""


def full_scale(dtype: np.dtype[Any], bits: int | None = None) -> float:
    """Return the largest value of a number type, of which perhaps not all bits are used.

    It is infinity for signed and real numbers.

    Parameters
    ----------
    dtype : dtype
        Type of the decoded pages.
    bits : int or None
        Bits of a sample in the file.
    """
    if dtype.kind != "u":
        return math.inf
    return float(2 ** min(8 * dtype.itemsize, bits or 64) - 1)


def different_pages(path: Path, kinds: dict[str, list[int]], choose: str) -> ImageError:
    """Return the error to be raised for pages of a file that differ in size or type, so that they are no series.

    Parameters
    ----------
    path : Path
        Path of the file.
    kinds : dict of str to list of int
        Page numbers by the description of their kind.
    choose : str
        Option with which the user can select a page; empty if there is none.
    """
    listed = ", ".join(f"{kind} (first: {numbers[0]})" for kind, numbers in list(kinds.items())[:4])
    remedy = f"select one with {choose} NUMBER" if choose else "save those that belong together as a separate file"
    return ImageError(f"{path} has pages of different sizes or types, {listed}: {remedy}")


def no_such_page(path: Path, page: int, count: int, choose: str) -> ImageError:
    """Return the error to be raised for a page that does not exist in a file.

    Parameters
    ----------
    path : Path
        Path of the file.
    page : int
        Number of the page.
    count : int
        Number of pages in the file.
    choose : str
        Option with which the user selected the page.
    """
    return ImageError(f"{choose or 'page'} {page} does not exist: {path} has {count} pages, the first is 0")


PNG_MAGIC, JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Number of channels after decoding, for each colour type of the PNG format."""


def png_header(path: Path) -> ImageHeader:
    """Read size, type and tone curve of a PNG.

    Parameters
    ----------
    path : Path
        Path of the file.

    Raises
    ------
    ImageError
        The file is truncated or damaged.
    """
    rows = columns = depth = colour = 0
    coded, name, damaged = "", b"", f"{path} cannot be read as an image: it is cut off or damaged"
    with path.open("rb") as file:
        file.seek(8)
        while name != b"IEND" and len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            data, check = file.read(length), file.read(4)
            # libpng would report a wrong checksum to the terminal only
            if len(check) < 4 or struct.unpack(">I", check)[0] != zlib.crc32(data, zlib.crc32(name)):
                raise ImageError(damaged)
            if name == b"IHDR" and length == 13:
                columns, rows, depth, colour = struct.unpack(">IIBB", data[:10])
            elif not rows:  # another chunk precedes the header
                raise ImageError(damaged)
            elif name == b"gAMA" and length == 4:
                gamma = struct.unpack(">I", data)[0] * 1e-5
                if not coded and abs(gamma - 1.0) > 0.01:
                    coded = f"it gives gamma {gamma:.4g}"
            elif name in (b"sRGB", b"iCCP"):
                coded = "it has a colour profile" if name == b"iCCP" else "it is marked as sRGB"
    if not (rows and columns and name == b"IEND"):
        raise ImageError(damaged)
    if colour not in _PNG_CHANNELS:
        raise ImageError(f"{path} cannot be read as an image: PNG has no colour type {colour}")
    channels = _PNG_CHANNELS[colour]
    dtype = np.dtype(np.uint16 if depth == 16 else np.uint8)
    size = rows * columns * channels * dtype.itemsize
    return ImageHeader("PNG", (0,), rows, columns, channels, size, full_scale(dtype), coded)


def jpeg_header(path: Path) -> ImageHeader:
    """Read the size of a JPEG, at whatever position its tables are.

    Parameters
    ----------
    path : Path
        Path of the file.

    Raises
    ------
    ImageError
        The file is truncated, damaged, or not of 8 bits.
    """
    data = path.read_bytes()
    position = 2
    while position + 9 < len(data):
        if data[position] != 0xFF:
            break
        marker = data[position + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:
            position += 1 if marker == 0xFF else 2
            continue
        # start of frame, but not the tables of Huffman and arithmetic coding
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            depth, rows, columns, channels = struct.unpack(">BHHB", data[position + 4 : position + 10])
            if not (rows and columns and depth == 8) or data.rfind(b"\xff\xd9") < position:
                break
            # four channels are decoded to three
            size = rows * columns * min(channels, 3)
            return ImageHeader("JPEG", (0,), rows, columns, min(channels, 3), size, 255.0, "it is a JPEG of 8 bits")
        position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    raise ImageError(f"{path} cannot be read as an image: it is cut off or damaged, or not a JPEG of 8 bits")


FITS_MAGIC = b"SIMPLE  ="
_SCIENCE = "SCI"
_MJD_ZERO = datetime(1858, 11, 17, tzinfo=UTC)
_NOT_IMAGES = {"ERR", "DQ", "VAR", "MASK", "WHT", "UNCERT", "BPM", "QUALITY"}
"""Names of FITS extensions that accompany an image, such as errors, masks and weights."""


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a FITS file and yield its list of units; a truncated file is an error, other warnings are ignored."""
    # imported here, as the import takes longer than reading most images
    from astropy.io import fits

    # No memory map: astropy maps no scaled integers, and sections read only the required part. The file is opened
    # here, since astropy leaves a file open that it cannot read.
    with path.open("rb") as file, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with fits.open(file, mode="readonly", memmap=False, lazy_load_hdus=False) as units:
            truncated = next((str(w.message) for w in caught if "truncated" in str(w.message)), "")
            if truncated:
                raise ImageError(f"{path} cannot be read as an image: it is cut off ({truncated})")
            yield units


def _images(units: Any) -> list[Any]:
    """Return the image units of a FITS file; if some are named as the measurement (not error or mask), only these."""
    from astropy.io import fits

    kinds = (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU)
    images = [unit for unit in units if isinstance(unit, kinds) and len(unit.shape) >= 2 and 0 not in unit.shape]
    science = [unit for unit in images if str(unit.name).upper() == _SCIENCE]
    return science or [unit for unit in images if str(unit.name).upper() not in _NOT_IMAGES]


def _physical(unit: Any) -> np.dtype[Any]:
    """Return the number type of a FITS unit's values after scaling (BZERO, BSCALE)."""
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
    """Return (unit, index of the plane in its cube) of all planes in the order of the file."""
    return [(unit, index) for unit in _images(units) for index in np.ndindex(*unit.shape[:-2])]


def fits_header(path: Path, wanted: int | None, choose: str) -> ImageHeader:
    """Read the header of all planes of a FITS file, or of one.

    Parameters
    ----------
    path : Path
        Path of the file.
    wanted : int or None
        Number of the one plane; None for all.
    choose : str
        Option that selects a plane, for messages.

    Raises
    ------
    ImageError
        The file has no image, or planes of several kinds.
    """
    with _opened(path) as units:
        planes = _planes(units)
        if not planes:
            raise ImageError(f"{path} contains no image: none of its {len(units)} units has rows and columns")
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
    """Return the recording time of the first image of a FITS file; None if it is not given.

    The time is that of DATE-BEG, DATE-OBS (with TIME-OBS) or MJD-OBS.

    Parameters
    ----------
    path : Path
        Path of the file.
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
    """Return the keywords and values of the FITS header of the unit that contains a plane.

    Parameters
    ----------
    path : Path
        Path of the file.
    number : int
        Number of the plane.

    Raises
    ------
    ImageError
        The header cannot be read.
    """
    try:
        with _opened(path) as units:
            header = _planes(units)[number][0].header
            return {str(key): header[key] for key in header if key}
    except ImageError:
        raise
    # astropy may raise any exception for a damaged card
    except Exception as error:
        raise ImageError(f"{path} cannot be read as an image: its header is damaged") from error


def fits_planes(path: Path, pages: Iterable[int]) -> Iterator[NDArray[Any]]:
    """Yield image planes (rows, columns) of a FITS file as physical values (BZERO + BSCALE times stored)."""
    with _opened(path) as units:
        planes = _planes(units)
        for number in pages:
            unit, index = planes[number]
            yield np.asarray(unit.section[(*index, slice(None), slice(None))])


# its log messages about a damaged file would appear beside the error message of this program
tifffile.logger().addHandler(logging.NullHandler())

TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First four bytes of a TIFF or BigTIFF of either byte order."""
_ICC_PROFILE, _ORIENTATION, _EXIF = 34675, 274, 34665
_AXES = {"YX": (0, 1, None), "YXS": (0, 1, 2), "SYX": (1, 2, 0)}
"""Positions of rows, columns and channels among the axes of a TIFF page, by the name of the axes' order."""
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
    """Read the header of all full pages of a TIFF, or of one.

    Parameters
    ----------
    path : Path
        Path of the file.
    wanted : int or None
        Number of the one page; None for all but thumbnails and masks.
    choose : str
        Option that selects a page, for messages.

    Raises
    ------
    ImageError
        The file has no pages, pages of several kinds, or neither grey values nor RGB colours.
    """
    with tifffile.TiffFile(path) as file:
        file.pages.useframes = False
        count = len(file.pages)
        sizes: dict[tuple[Any, ...], list[int]] = {}
        for number in range(count) if wanted is None else [wanted] if 0 <= wanted < count else []:
            page = _page(file, number)
            # thumbnails and masks are marked as such
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
            raise ImageError(f"{path} contains {dtype} values; grey values must be integers or real numbers")
        if axes not in _AXES:
            raise ImageError(f"{path} has axes {axes}; pages of rows and columns are needed")
        compressed = str(page.compression.name)
        photometric = str(getattr(page.photometric, "name", page.photometric))
        # the JPEG decoder converts YCbCr to RGB
        if photometric not in _GREY and not (photometric == "YCBCR" and "JPEG" in compressed):
            content = _OTHERS.get(photometric, f"colours of the kind {photometric}")
            raise ImageError(f"{path} contains {content}; save it as grey values, or as RGB linear in light")
        bits, coded = 8 * dtype.itemsize, ""
        if bits == 8 and "JPEG" in compressed:
            coded = "its 8-bit pages are compressed as JPEG"
        elif bits == 8 and _ICC_PROFILE in page.tags:
            coded = "its 8-bit pages have a colour profile"
        orientation = page.tags.valueof(_ORIENTATION, 1)
        rows, columns, channels = (1 if axis is None else shape[axis] for axis in _AXES[axes])
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
            orientation="" if orientation == 1 else f"orientation {orientation}",
        )


def tiff_origin(path: Path) -> tuple[datetime | None, str]:
    """Return the recording time of a TIFF's first page and the ``note`` in its description.

    The time is Exif's DateTimeOriginal, None if it is not given. The note is read from a description in JSON, as this
    program writes it.

    Parameters
    ----------
    path : Path
        Path of the file.
    """
    with tifffile.TiffFile(path) as file:
        page = _page(file, 0)
        exif, description = page.tags.valueof(_EXIF) or {}, str(page.description)
    note = str(json.loads(description).get("note", "")) if description.startswith("{") else ""
    match = re.fullmatch(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)\0?", str(exif.get("DateTimeOriginal", "")))
    if match is None:
        return None, note
    fraction = re.sub(r"\D", "", str(exif.get("SubsecTimeOriginal", "")))[:6]
    text = "{}-{}-{}T{}".format(*match.groups()) + (f".{fraction:0<6}" if fraction else "")
    return datetime.fromisoformat(text).replace(tzinfo=UTC), note


def tiff_pages(path: Path, pages: Iterable[int], check: Callable[[], None]) -> Iterator[NDArray[Any]]:
    """Yield the pages of a TIFF, each (rows, columns) or with the channels last.

    Of an uncompressed page only the part that is accessed is read.

    Parameters
    ----------
    path : Path
        Path of the file.
    pages : iterable of int
        Numbers of the pages.
    check : callable
        Function called before a page is decoded as a whole.
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


MOST_BYTES = 1 << 29
"""Largest size of one decoded page, and of the frames of one file together, bytes."""
MOST_PIXELS = 4_000_000
"""Largest number of pixels of a region: the fits need some 250 bytes for each."""
MOST_STACKED = 16_000_000
"""Largest number of pixels of a region, summed over all pages."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_LARGEST_GAMMA = 5.0
_GZIP = b"\x1f\x8b"
_OF_CODEC = re.compile(rb"JPEG|libpng|grfmt_|loadsave")
_INSIDE = (struct.error, ArithmeticError, AssertionError, AttributeError, LookupError, TypeError)
"""Exceptions of libraries that read a damaged file; their messages describe the library's own code."""


@dataclass(frozen=True)
class Region:
    """Rectangle of pixels, given by its first row and column (counted from 0) and its size."""

    row: int
    column: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices of rows and of columns that cut the region out of an array (rows, columns)."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)


@dataclass(frozen=True)
class ImageFile:
    """Image file whose header has been read.

    Attributes
    ----------
    path : Path
        Path of the file.
    header : ImageHeader
        Header of the pages that are used.
    """

    path: Path
    header: ImageHeader

    @classmethod
    def open(cls, path: Path, frames: int | None = None, page: int | None = None, choose: str = "--page") -> ImageFile:
        """Open an image file and read its header.

        Parameters
        ----------
        path : Path
            Path of the file.
        frames : int or None
            Number of pages to use, from the first on; None for all.
        page : int or None
            Number of the only page to use, from 0; None for all.
        choose : str
            Option with which the user selects a page, for messages; empty if there is none.

        Raises
        ------
        ImageError
            The file is not a readable image, has pages of different sizes, or has no such page.
        """
        try:
            if path.is_dir():
                raise ImageError(f"{path} is a folder, not an image")
            if not path.exists():
                raise ImageError(f"there is no image {path}")
            if not path.is_file():  # reading could block or never end
                raise ImageError(f"{path} is a device, a pipe or a socket, not an image")
            header = _header(path, page, choose)
        except ImageError:
            raise
        # reading a damaged file may raise any exception
        except Exception as error:
            raise ImageError(f"{path} cannot be read as an image ({_reason(error)})") from error
        if page is not None and page not in header.pages:
            raise no_such_page(path, page, len(header.pages), choose)
        if frames is not None and frames > len(header.pages):
            raise ImageError(f"--frames {frames} is more than the {len(header.pages)} pages of {path}")
        if header.inverted and not math.isfinite(header.full_scale):
            raise ImageError(f"{path} defines its largest value as black, but real numbers have no largest one")
        return cls(path, replace(header, pages=header.pages[:frames]))

    def read(self, regions: dict[str, Region], gamma: str | None = None) -> dict[str, Array]:
        """Read regions of all pages as grey values linear in light, (P, H, W) by name.

        Dimensions: P pages, H rows, W columns.

        Parameters
        ----------
        regions : dict of str to Region
            Regions to read by name; names are options of the command, for messages.
        gamma : str or None
            Tone curve of the file, ``srgb`` or the exponent as text; None and "1" for none.

        Raises
        ------
        ImageError
            A region is not inside the image or too large, the image is too large, or it cannot be decoded.
        """
        for name, region in regions.items():
            self._check(name, region)
            size = len(self.header.pages) * region.height * region.width
            if size > MOST_STACKED:
                raise ImageError(
                    f"{name} has {region.height} x {region.width} pixels in {len(self.header.pages)} pages; at most"
                    f" {MOST_STACKED} in all fit into memory: choose a smaller region, or fewer pages with --frames"
                )
        whole = self.header.full_scale
        linear = tone_curve(gamma, whole)
        shape = len(self.header.pages)
        out = {name: np.empty((shape, r.height, r.width)) for name, r in regions.items()}
        with np.errstate(over="ignore", invalid="ignore"):
            for number, data in enumerate(self._decoded()):
                for name, region in regions.items():
                    stored = np.asarray(data[region.slices], dtype=np.float64)
                    out[name][number] = _luminance(whole - stored if self.header.inverted else stored, linear, whole)
        return out

    def frames(self, region: Region | None = None) -> NDArray[Any]:
        """Return all pages as they are stored, (frames, H, W) in the file's type and the machine's byte order.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        region : Region or None
            Part of every page; None for all of it.

        Raises
        ------
        ImageError
            The image has colours, is too large, or cannot be decoded.
        """
        return np.stack(list(self.pages(region)))

    def pages(self, region: Region | None = None) -> Iterator[NDArray[Any]]:
        """Yield the pages of `frames`, (H, W) each, one at a time.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        region : Region or None
            Part of every page; None for all of it.

        Raises
        ------
        ImageError
            The image has colours, is too large, or cannot be decoded.
        """
        head = self.header
        if head.channels > 2:
            raise ImageError(f"{self.path} has {head.channels} colours; frames of a monochrome detector are needed")
        part = Region(0, 0, head.rows, head.columns) if region is None else region
        self._check("region", part, math.inf)
        size = head.page_bytes * len(head.pages) * part.height * part.width / (head.rows * head.columns)
        if size > MOST_BYTES:
            raise ImageError(
                f"{self.path} has {len(head.pages)} frames of {part.height} x {part.width} pixels,"
                f" {1e-9 * size:.1f} GB, more than {1e-9 * MOST_BYTES:.1f} GB: crop the images first, or use fewer"
                " frames"
            )
        for data in self._decoded():
            grey = np.array(data[part.slices])
            grey = grey[..., 0] if grey.ndim == 3 else grey
            grey = grey.astype(grey.dtype.newbyteorder("="), copy=False)
            yield int(head.full_scale) - grey if head.inverted else grey

    def _check(self, name: str, region: Region, most: float = MOST_PIXELS) -> None:
        down, right = region.row + region.height, region.column + region.width
        if region.height == 0 or region.width == 0 or down > self.header.rows or right > self.header.columns:
            where = ",".join(map(str, (region.row, region.column, region.height, region.width)))
            raise ImageError(
                f"{name} {where} is not inside the image of {self.header.rows} rows and {self.header.columns} columns"
            )
        if region.height * region.width > most:
            raise ImageError(
                f"{name} has {region.height} x {region.width} pixels; at most {most} fit into memory:"
                " choose a smaller region"
            )

    def _decoded(self) -> Iterator[NDArray[Any]]:
        """Yield the decoded pages, each (rows, columns) or with the channels last.

        Raises
        ------
        ImageError
            A page cannot be decoded, or differs from the header.
        """
        try:
            for data in self._stored():
                if data.shape[:2] != (self.header.rows, self.header.columns):
                    raise ImageError(f"{self.path} contains another number of rows or columns than its header states")
                yield data
        except ImageError:
            raise
        except Exception as error:
            raise ImageError(f"{self.path} cannot be read as an image ({_reason(error)})") from error

    def _stored(self) -> Iterator[NDArray[Any]]:
        if self.header.kind == "TIFF":
            yield from tiff_pages(self.path, self.header.pages, self._check_memory)
            return
        self._check_memory()
        if self.header.kind == "FITS":
            yield from fits_planes(self.path, self.header.pages)
            return
        data, corrupt = _imread(self.path)
        if data is None or corrupt:
            raise ImageError(f"{self.path} cannot be read as an image: it is damaged")
        yield data[..., 2::-1] if data.ndim == 3 else data

    def _check_memory(self) -> None:
        head = self.header
        if head.page_bytes > MOST_BYTES:
            remedy = "crop the image first, or save it as an uncompressed TIFF, of which only the region is read"
            raise ImageError(
                f"{self.path} of {head.rows} x {head.columns} pixels needs {1e-9 * head.page_bytes:.1f} GB when"
                f" decoded, more than {1e-9 * MOST_BYTES:.1f} GB: {remedy}"
            )


def _imread(path: Path) -> tuple[NDArray[Any] | None, bool]:
    """Return the pixels of a PNG or JPEG, and True if its library found the data corrupt.

    libjpeg continues with incomplete data and reports that to the terminal only, so its output is captured here.
    """
    try:
        terminal = os.dup(2)
    except OSError:  # closed
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED), False
    with tempfile.TemporaryFile() as output:
        os.dup2(output.fileno(), 2)
        try:
            data = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
        output.seek(0)
        lines = output.read().splitlines(keepends=True)
    messages = [line for line in lines if _OF_CODEC.search(line)]
    if len(messages) < len(lines):  # lines that another thread has written
        os.write(2, b"".join(line for line in lines if line not in messages))
    return data, any(b"extraneous" not in line for line in messages)


def _header(path: Path, page: int | None, choose: str) -> ImageHeader:
    with path.open("rb") as file:
        start = file.read(16)
    if start[:4] in TIFF_MAGIC:
        return tiff_header(path, page, choose)
    if start.startswith(FITS_MAGIC):
        return fits_header(path, page, choose)
    if start.startswith(PNG_MAGIC):
        return png_header(path)
    if start.startswith(JPEG_MAGIC):
        return jpeg_header(path)
    packed = f": unpack it first, gunzip {path.name}" if start.startswith(_GZIP) else ": give a TIFF, FITS, PNG or JPEG"
    raise ImageError(f"{path} cannot be read as an image{packed}")


def _reason(error: Exception) -> str:
    """Return the reason of an error in one line, without the internals of the reading library."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return "it does not fit into memory"
    # a codec that is not installed is reported by a ValueError
    if isinstance(error, _INSIDE) or (isinstance(error, ValueError) and "requires" not in text):
        return "it is damaged"
    return text or "it is damaged"


def tone_curve(gamma: str | None, full_scale: float) -> Callable[[Array], Array]:
    """Return the function from the file's grey values to grey values that are linear in light.

    Both range up to the full scale of the file's number type. ``gamma`` names the tone curve: ``srgb`` or an exponent.

    Raises
    ------
    ImageError
        There is no such curve, or no full scale.
    """
    if gamma is None or gamma == "1":
        return lambda grey: grey
    try:
        exponent = 2.4 if gamma == "srgb" else float(gamma)
    except ValueError:
        exponent = math.nan
    if not 1.0 / _LARGEST_GAMMA <= exponent <= _LARGEST_GAMMA:
        raise ImageError(
            f"--gamma {gamma!r} is not a tone curve: write srgb, or an exponent such as 2.2 (1 for grey values that are"
            " linear in light)"
        )
    if not math.isfinite(full_scale):
        raise ImageError("--gamma is for integer grey values; real numbers have no full scale")

    def power(grey: Array) -> Array:
        share = grey / full_scale
        if gamma == "srgb":
            # IEC 61966-2-1
            return full_scale * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** exponent)
        return np.asarray(full_scale * share**exponent)

    return power


def _luminance(colour: Array, linear: Callable[[Array], Array], full_scale: float) -> Array:
    """Return the luminance (H, W) of grey (H, W) or of (H, W, RGB and perhaps alpha).

    Dimensions: H rows, W columns.
    """
    if colour.ndim == 2:
        return linear(colour)
    if colour.shape[-1] < 3:
        return linear(colour[..., 0])
    grey = linear(colour[..., :3]) @ _LUMINANCE
    # one saturated channel makes the sum invalid
    return np.where((colour[..., :3] >= full_scale).any(axis=-1), full_scale, grey)


def recording_origin(path: Path) -> tuple[datetime | None, str]:
    """Return the recording time of an image file's first frame, and its note.

    The time is UTC if the file names no time zone, None if it gives no time. The time at which a file was written or
    changed does not count: a copy has another one.

    Parameters
    ----------
    path : Path
        Path of the image file.
    """
    # an unreadable header gives no time; whether the image is readable is checked when it is read
    try:
        with path.open("rb") as file:
            magic = file.read(9)
        if magic.startswith(TIFF_MAGIC):
            return tiff_origin(path)
        if magic == FITS_MAGIC:
            return fits_time(path), ""
    except Exception:
        return None, ""
    return None, ""
