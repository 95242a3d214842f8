"""Image files as grey values that are linear in light: TIFF, FITS, PNG and JPEG; regions of all pages, or
frames as they are in the file.

The header is read first, so that what would not fit into memory is refused before it is decoded. Of an uncompressed
TIFF and of a FITS file nothing but what is asked for is read.
"""

from __future__ import annotations

import math
import os
import re
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.images import fits_image, tiff_image
from analysis.images.image_header import JPEG_MAGIC, PNG_MAGIC, ImageError, ImageHeader, jpeg_header, png_header

MOST_BYTES = 1 << 29
"""Largest size of one decoded page, and of the frames of one file together."""
MOST_PIXELS = 4_000_000
"""Largest region: the fits need some 250 bytes for each pixel."""
MOST_STACKED = 16_000_000
"""Largest region in all pages together."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_LARGEST_GAMMA = 5.0
_GZIP = b"\x1f\x8b"
_OF_CODEC = re.compile(rb"JPEG|libpng|grfmt_|loadsave")
_INSIDE = (struct.error, ArithmeticError, AssertionError, AttributeError, LookupError, TypeError)
"""What readers of spoilt files stumble over; the words of these are about their own code."""


@dataclass(frozen=True)
class Region:
    """Pixels from row and column (the first is 0) on."""

    row: int
    column: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """For an array (rows, columns)."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)


@dataclass(frozen=True)
class ImageFile:
    """An image file whose header has been read.

    Attributes:
        path: of the file.
        header: of the pages that are used.
    """

    path: Path
    header: ImageHeader

    @classmethod
    def open(cls, path: Path, frames: int | None = None, page: int | None = None, choose: str = "--page") -> ImageFile:
        """Read the header.

        Args:
            path: of the file.
            frames: number of pages to use, from the first on; None for all.
            page: the only page to use, from 0; None for all.
            choose: by which option the user names a page, empty if there is none; for messages.

        Raises:
            ImageError: not a readable image, pages of different sizes, or no such page.
        """
        try:
            if path.is_dir():
                raise ImageError(f"{path} is a folder, not an image")
            if not path.exists():
                raise ImageError(f"there is no image {path}")
            if not path.is_file():  # it could be endless, or block
                raise ImageError(f"{path} is a device, a pipe or a socket, not an image")
            header = _header(path, page, choose)
        except ImageError:
            raise
        # readers of spoilt files fail in ways that cannot be foreseen
        except Exception as error:
            raise ImageError(f"{path} cannot be read as an image ({_reason(error)})") from error
        if page is not None and page not in header.pages:
            raise ImageError(
                f"{choose or 'page'} {page} does not exist: {path} has {len(header.pages)} pages, the first is 0"
            )
        if frames is not None and frames > len(header.pages):
            raise ImageError(f"--frames {frames} is more than the {len(header.pages)} pages of {path}")
        if header.inverted and not math.isfinite(header.full_scale):
            raise ImageError(f"{path} says that its largest value is black, but real numbers have no largest one")
        return cls(path, replace(header, pages=header.pages[:frames]))

    def read(self, regions: dict[str, Region], gamma: str | None = None) -> dict[str, Array]:
        """Grey values of all pages, name -> (P, H, W), linear in light.

        Args:
            regions: name -> what to read; names are options of the command, for messages.
            gamma: tone curve of the file, ``srgb`` or the exponent as text; None and "1" for none.

        Raises:
            ImageError: a region beyond the image or too large, too large an image, or one that cannot be decoded.
        """
        for name, region in regions.items():
            self._check(name, region)
            size = len(self.header.pages) * region.height * region.width
            if size > MOST_STACKED:
                raise ImageError(
                    f"{name} has {region.height} x {region.width} pixels in {len(self.header.pages)} pages, more than"
                    f" {MOST_STACKED} in all do not fit into memory: choose a smaller region, or fewer pages with"
                    " --frames"
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
        """All pages as they are, (frames, H, W) in the file's type, the byte order being the machine's.

        Args:
            region: part of every page, None for all of it.

        Raises:
            ImageError: colours, too large an image, or one that cannot be decoded.
        """
        return np.stack(list(self.pages(region)))

    def pages(self, region: Region | None = None) -> Iterator[NDArray[Any]]:
        """The pages of `frames`, (H, W) each, one at a time.

        Args:
            region: as there.

        Raises:
            ImageError: as there.
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
                f" {1e-9 * size:.1f} GB, more than {1e-9 * MOST_BYTES:.1f} GB: cut the region out first, or take fewer"
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
                f"{name} {where} does not lie in the image of {self.header.rows} rows and {self.header.columns} columns"
            )
        if region.height * region.width > most:
            raise ImageError(
                f"{name} has {region.height} x {region.width} pixels, more than {most} do not fit into memory:"
                " choose a smaller region"
            )

    def _decoded(self) -> Iterator[NDArray[Any]]:
        """Every page, (rows, columns) or with channels last.

        Raises:
            ImageError: it cannot be decoded, or is not what the header says.
        """
        try:
            for data in self._stored():
                if data.shape[:2] != (self.header.rows, self.header.columns):
                    raise ImageError(f"{self.path} holds another number of rows or columns than its header says")
                yield data
        except ImageError:
            raise
        except Exception as error:
            raise ImageError(f"{self.path} cannot be read as an image ({_reason(error)})") from error

    def _stored(self) -> Iterator[NDArray[Any]]:
        if self.header.kind == "TIFF":
            yield from tiff_image.tiff_pages(self.path, self.header.pages, self._check_memory)
            return
        self._check_memory()
        if self.header.kind == "FITS":
            yield from fits_image.fits_planes(self.path, self.header.pages)
            return
        data, told = _imread(self.path)
        if data is None or told:
            raise ImageError(f"{self.path} cannot be read as an image: it is damaged")
        yield data[..., 2::-1] if data.ndim == 3 else data

    def _check_memory(self) -> None:
        head = self.header
        if head.page_bytes > MOST_BYTES:
            remedy = "cut the region out first, or save it as an uncompressed TIFF, of which only the region is read"
            raise ImageError(
                f"{self.path} of {head.rows} x {head.columns} pixels fills {1e-9 * head.page_bytes:.1f} GB when it is"
                f" decoded, more than {1e-9 * MOST_BYTES:.1f} GB: {remedy}"
            )


def _imread(path: Path) -> tuple[NDArray[Any] | None, bool]:
    """Pixels of a PNG or JPEG, and whether its library found the data corrupt: libjpeg goes on with what it has, and
    tells nobody but the terminal.
    """
    try:
        terminal = os.dup(2)
    except OSError:  # closed
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED), False
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            data = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
        said.seek(0)
        lines = said.read().splitlines(keepends=True)
    told = [line for line in lines if _OF_CODEC.search(line)]
    if len(told) < len(lines):  # of a thread that has something to say
        os.write(2, b"".join(line for line in lines if line not in told))
    return data, any(b"extraneous" not in line for line in told)


def _header(path: Path, page: int | None, choose: str) -> ImageHeader:
    with path.open("rb") as file:
        start = file.read(16)
    if start[:4] in tiff_image.MAGIC:
        return tiff_image.tiff_header(path, page, choose)
    if start.startswith(fits_image.MAGIC):
        return fits_image.fits_header(path, page, choose)
    if start.startswith(PNG_MAGIC):
        return png_header(path)
    if start.startswith(JPEG_MAGIC):
        return jpeg_header(path)
    packed = f": unpack it first, gunzip {path.name}" if start.startswith(_GZIP) else ": give a TIFF, FITS, PNG or JPEG"
    raise ImageError(f"{path} cannot be read as an image{packed}")


def _reason(error: Exception) -> str:
    """Reason of an error in one line, without what only the reader's author understands."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return "it does not fit into memory"
    # a codec that is not installed is named by a ValueError
    if isinstance(error, _INSIDE) or (isinstance(error, ValueError) and "requires" not in text):
        return "it is damaged"
    return text or "it is damaged"


def tone_curve(gamma: str | None, full_scale: float) -> Callable[[Array], Array]:
    """From the file's grey values to grey values linear in light, both up to the full scale.

    Raises:
        ImageError: no such curve, or no full scale.
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
    """(H, W) from grey (H, W) or (H, W, RGB and perhaps alpha)."""
    if colour.ndim == 2:
        return linear(colour)
    if colour.shape[-1] < 3:
        return linear(colour[..., 0])
    grey = linear(colour[..., :3]) @ _LUMINANCE
    # one saturated channel spoils the sum
    return np.where((colour[..., :3] >= full_scale).any(axis=-1), full_scale, grey)


def recorded(path: Path) -> tuple[datetime | None, str]:
    """Time of the first frame, UTC if the file names no time zone, None where it does not say; and the note in it.

    The time at which a file was written or changed does not count: a copy has another one.

    Args:
        path: of an image file.
    """
    # a header that cannot be read says nothing; whether the image can be is told where it is
    try:
        with path.open("rb") as file:
            magic = file.read(9)
        if magic.startswith(tiff_image.MAGIC):
            return tiff_image.tiff_origin(path)
        if magic == fits_image.MAGIC:
            return fits_image.fits_time(path), ""
    except Exception:
        return None, ""
    return None, ""
