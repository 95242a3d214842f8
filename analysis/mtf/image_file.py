"""Regions of an image file as grey values that are linear in light: TIFF, PNG and JPEG.

The header is read first, so that what would not fit into memory is refused before it is decoded. Of an uncompressed
TIFF nothing but the regions is read.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

__all__ = ["GAMMAS", "ImageError", "ImageFile", "Region"]

Array = NDArray[np.float64]
MOST_BYTES = 1 << 29
"""Of one page when it is decoded."""
MOST_PIXELS = 4_000_000
"""Of one region: the fits need some 250 bytes for each."""
GAMMAS = ("srgb", "1", "2.2")
"""Examples of the tone curves."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_ICC_PROFILE = 34675
_LARGEST_GAMMA = 5.0


class ImageError(Exception):
    """A file, page or region that cannot be read; the message says what to change."""


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
    """What the header of a file says.

    Attributes:
        path: of the file.
        kind: TIFF, PNG or JPEG.
        pages: numbers of the pages that are averaged, the first is 0.
        rows, columns: of every page.
        page_bytes: of a decoded page.
        full_scale: largest grey value that the file's type holds, infinity for real numbers.
        coded: why grey values probably follow a tone curve and not the light; empty if nothing says so.
    """

    path: Path
    kind: str
    pages: tuple[int, ...]
    rows: int
    columns: int
    page_bytes: int
    full_scale: float
    coded: str

    @classmethod
    def open(cls, path: Path, frames: int | None = None, page: int | None = None) -> ImageFile:
        """Read the header.

        Args:
            path: of the file.
            frames: number of pages to average, from the first on; None for all.
            page: the only page to read, from 0; None to average.

        Raises:
            ImageError: not a readable image, pages of different sizes, or no such page.
        """
        try:
            if path.is_dir():
                raise ImageError(f"{path} is a folder, not an image")
            if not path.is_file():
                raise ImageError(f"there is no image {path}")
            with path.open("rb") as file:
                start = file.read(16)
            if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
                image = _tiff_header(path, page)
            elif start.startswith(b"\x89PNG\r\n\x1a\n"):
                image = _png_header(path)
            elif start.startswith(b"\xff\xd8\xff"):
                image = _jpeg_header(path)
            else:
                raise ImageError(f"{path} cannot be read as an image: give a TIFF, PNG or JPEG")
        except ImageError:
            raise
        # readers of spoilt files fail in ways that cannot be foreseen
        except Exception as error:
            raise ImageError(f"{path} cannot be read as an image ({error or type(error).__name__})") from error
        if page is not None and page not in image.pages:
            raise ImageError(f"--page {page} does not exist: {path} has {len(image.pages)} pages, the first is 0")
        if frames is not None and frames > len(image.pages):
            raise ImageError(f"--frames {frames} is more than the {len(image.pages)} pages of {path}")
        return replace(image, pages=image.pages[:frames])

    def read(
        self, regions: dict[str, Region], gamma: str | None = None, saturation: float | None = None
    ) -> dict[str, Array]:
        """Mean grey values over the pages, name -> (H, W), linear in light.

        A pixel that is saturated in one page counts as saturated: its mean is put at that level.

        Args:
            regions: name -> what to read; names are options of the command, for messages.
            gamma: tone curve of the file, ``srgb`` or the exponent as text; None and "1" for none.
            saturation: grey value of saturation, linear in light; None for the full scale.

        Raises:
            ImageError: a region beyond the image or too large, too large an image, or one that cannot be decoded.
        """
        for name, region in regions.items():
            self._check(name, region)
        linear = tone_curve(gamma, self.full_scale)
        limit = self.full_scale if saturation is None else saturation
        total = {name: np.zeros((r.height, r.width)) for name, r in regions.items()}
        largest = {name: np.full((r.height, r.width), -np.inf) for name, r in regions.items()}
        try:
            # sums of huge real numbers may overflow; what is not finite is refused where it is measured
            with np.errstate(over="ignore", invalid="ignore"):
                for data in self._decoded():
                    if data.shape[:2] != (self.rows, self.columns):
                        raise ImageError(f"{self.path} holds another number of rows or columns than its header says")
                    for name, region in regions.items():
                        grey = _luminance(np.asarray(data[region.slices], dtype=np.float64), linear, self.full_scale)
                        total[name] += grey
                        np.maximum(largest[name], grey, out=largest[name])
        except ImageError:
            raise
        except Exception as error:
            raise ImageError(f"{self.path} cannot be read as an image ({error or type(error).__name__})") from error
        out = {}
        for name, value in total.items():
            mean = value / len(self.pages)
            out[name] = np.where(largest[name] >= limit, np.maximum(mean, limit), mean)
        return out

    def _check(self, name: str, region: Region) -> None:
        down, right = region.row + region.height, region.column + region.width
        if region.height == 0 or region.width == 0 or down > self.rows or right > self.columns:
            where = ",".join(map(str, (region.row, region.column, region.height, region.width)))
            raise ImageError(f"{name} {where} does not lie in the image of {self.rows} rows and {self.columns} columns")
        if region.height * region.width > MOST_PIXELS:
            raise ImageError(
                f"{name} has {region.height} x {region.width} pixels, more than {MOST_PIXELS} do not fit into memory:"
                " choose a smaller region"
            )

    def _decoded(self) -> Iterator[NDArray[Any]]:
        """Every page, (rows, columns) or with channels last."""
        if self.kind == "TIFF":
            yield from self._tiff_pages()
            return
        self._check_memory()
        data = cv2.imread(str(self.path), cv2.IMREAD_UNCHANGED)
        if data is None:
            raise ImageError(f"{self.path} cannot be read as an image: it is damaged")
        yield data[..., 2::-1] if data.ndim == 3 else data

    def _tiff_pages(self) -> Iterator[NDArray[Any]]:
        with tifffile.TiffFile(self.path) as file:
            for number in self.pages:
                page = _page(file, number)
                if page.is_contiguous and page.dtype is not None:
                    stored = page.dtype.newbyteorder(file.byteorder)
                    data = file.filehandle.memmap_array(stored, page.shape, page.dataoffsets[0])
                else:
                    self._check_memory()
                    data = page.asarray()
                yield np.moveaxis(data, page.axes.index("S"), -1) if "S" in page.axes else data

    def _check_memory(self) -> None:
        if self.page_bytes > MOST_BYTES:
            remedy = "cut the region out first, or save it as an uncompressed TIFF, of which only the region is read"
            raise ImageError(
                f"{self.path} of {self.rows} x {self.columns} pixels fills {1e-9 * self.page_bytes:.1f} GB when it is"
                f" decoded, more than {1e-9 * MOST_BYTES:.1f} GB: {remedy}"
            )


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


def _page(file: tifffile.TiffFile, number: int) -> tifffile.TiffPage:
    page = file.pages[number]
    assert isinstance(page, tifffile.TiffPage)
    return page


def _tiff_header(path: Path, wanted: int | None) -> ImageFile:
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
            if wanted is None:
                raise ImageError(f"{path} has no pages")
            raise ImageError(f"--page {wanted} does not exist: {path} has {count} pages, the first is 0")
        if len(sizes) > 1:
            kinds = [
                f"{' x '.join(map(str, shape))} {dtype} (first: {numbers[0]})"
                for (shape, dtype, _), numbers in sizes.items()
            ]
            raise ImageError(
                f"{path} has pages of different sizes or types, {', '.join(kinds[:4])}: say which with --page NUMBER"
            )
        ((shape, dtype, axes), numbers) = next(iter(sizes.items()))
        page = _page(file, numbers[0])
        if dtype is None or dtype.kind not in "uif":
            raise ImageError(f"{path} holds {dtype} values; grey values must be integers or real numbers")
        if axes not in ("YX", "YXS", "SYX"):
            raise ImageError(f"{path} has axes {axes}; pages of rows and columns are needed")
        bits, compressed = 8 * dtype.itemsize, str(page.compression.name)
        coded = ""
        if bits == 8 and "JPEG" in compressed:
            coded = "its 8-bit pages are compressed as JPEG"
        elif bits == 8 and _ICC_PROFILE in page.tags:
            coded = "its 8-bit pages have a colour profile"
        rows, columns = shape[1:] if axes == "SYX" else shape[:2]
    return ImageFile(
        path, "TIFF", tuple(numbers), rows, columns, math.prod(shape) * dtype.itemsize, _full_scale(dtype), coded
    )


def _png_header(path: Path) -> ImageFile:
    rows = columns = depth = colour = 0
    coded, ended = "", False
    with path.open("rb") as file:
        file.seek(8)
        while head := file.read(8):
            length, name = struct.unpack(">I4s", head)
            if name == b"IHDR":
                columns, rows, depth, colour = struct.unpack(">IIBB", file.read(10))
                length -= 10
            elif name == b"gAMA":
                gamma = struct.unpack(">I", file.read(4))[0] * 1e-5
                length -= 4
                if not coded and abs(gamma - 1.0) > 0.01:
                    coded = f"it says gamma {gamma:.4g}"
            elif name in (b"sRGB", b"iCCP"):
                coded = "it has a colour profile" if name == b"iCCP" else "it says sRGB"
            elif name == b"IEND":
                ended = True
                break
            # the checksum is four bytes
            file.seek(length + 4, 1)
    if not (rows and columns and ended):
        raise ImageError(f"{path} cannot be read as an image: it is cut off or damaged")
    if colour not in _PNG_CHANNELS:
        raise ImageError(f"{path} cannot be read as an image: PNG has no colour type {colour}")
    channels = _PNG_CHANNELS[colour]
    dtype = np.dtype(np.uint16 if depth == 16 else np.uint8)
    size = rows * columns * channels * dtype.itemsize
    return ImageFile(path, "PNG", (0,), rows, columns, size, _full_scale(dtype), coded)


_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Colour type of a PNG -> channels that it is decoded to."""


def _jpeg_header(path: Path) -> ImageFile:
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
            return ImageFile(path, "JPEG", (0,), rows, columns, size, 255.0, "it is a JPEG of 8 bits")
        place += 2 + struct.unpack(">H", data[place + 2 : place + 4])[0]
    raise ImageError(f"{path} cannot be read as an image: it is cut off or damaged, or not a JPEG of 8 bits")


def _full_scale(dtype: np.dtype[Any]) -> float:
    return float(np.iinfo(dtype).max) if dtype.kind == "u" else math.inf
