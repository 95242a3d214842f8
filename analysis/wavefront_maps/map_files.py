"""Files of measured wavefronts, recognised by what is in them and not by their names."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from analysis.images import fits_image
from analysis.images.image_file import ImageFile
from analysis.images.image_header import ImageError
from analysis.wavefront_maps import text_grids, zygo_files
from analysis.wavefront_maps.wavefront_map import MapError, WavefrontMap, agreed, metres_per

_PUPIL_SCALE = ("PUPLSCAL", "PIXELSCL", "PIXSCALE")
"""Keys of FITS files of pupils with metres per pixel, as POPPY writes and reads them."""
_LARGEST_PIXEL, _LARGEST = 1.0, 10.0
"""Metres; beyond them a unit is wrong or a file is damaged."""


def read_map(
    path: Path, *, unit: str | None = None, wavelength: float | None = None, page: int | None = None
) -> WavefrontMap:
    """The map in a file of MetroPro, Mx, CODE V, Zemax, FITS, or in a text table.

    Args:
        path: of the file.
        unit: of the values, for FITS files and tables that do not say it themselves: m, mm, um, nm or waves.
        wavelength: metres, for files in waves that do not say it.
        page: of several images in a FITS file, from 0.

    Raises:
        MapError: a file that is not read, with what is wrong and what to do.
    """
    path = Path(path)
    if path.is_dir():
        raise MapError(f"{path} is a folder, not a file of a wavefront")
    if not path.exists():
        raise MapError(f"there is no file {path}")
    if not path.is_file():  # it could be endless, or block
        raise MapError(f"{path} is a device, a pipe or a socket, not a file of a wavefront")
    try:
        with path.open("rb") as file:
            start = file.read(16)
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is told below
            found = _read(path, start, unit, wavelength, page)
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror or 'input/output error'}") from error
    largest = np.max(np.abs(found.values), where=~np.isnan(found.values), initial=0.0)
    if largest > _LARGEST:
        raise MapError(
            f"{path} holds values of up to {largest:.3g} m, which no wavefront has: check its unit and scale"
        )
    if not np.isfinite(found.values).any():
        raise MapError(f"{path} holds no measured point: all of its {found.values.size} points are without data")
    agreed(path, "wavelength", wavelength, found.wavelength)
    # a stated wavelength also counts where it was not needed
    return found if found.wavelength is not None or wavelength is None else replace(found, wavelength=wavelength)


def _read(path: Path, start: bytes, unit: str | None, wavelength: float | None, page: int | None) -> WavefrontMap:
    if start.startswith(fits_image.MAGIC):
        return _fits(path, unit, wavelength, page)
    if page is not None:
        raise MapError(f"page {page} was named, but {path} is no FITS file with several images")
    if not start:
        raise MapError(f"{path} is empty")
    text = lines = None
    if not (zygo_files.is_metropro(start) or start.startswith(zygo_files.HDF5_MAGIC)):
        text = text_grids.text_of(path)
        lines = text_grids.lines_of(text, "!")
        if not (text_grids.is_codev(lines) or text_grids.is_zemax(lines)):
            return text_grids.read_table(path, text, unit, wavelength)
    if unit is not None:
        raise MapError(f"{path} says its unit itself: take the statement of unit {unit[:40]!r} away")
    if lines is not None:
        reader = text_grids.read_codev if text_grids.is_codev(lines) else text_grids.read_zemax
        return reader(path, lines)
    if zygo_files.is_metropro(start):
        return zygo_files.read_metropro(path)
    return zygo_files.read_datx(path, wavelength)


def _fits(path: Path, unit: str | None, wavelength: float | None, page: int | None) -> WavefrontMap:
    """An image of a FITS file; row 0 of it, which FITS viewers draw lowest, is that of the map."""
    try:
        image = ImageFile.open(path, page=page, choose="page")
        if len(image.header.pages) != 1:
            raise MapError(f"{path} has {len(image.header.pages)} images: say which with page, from 0")
        (values,) = image.frames()
        header = fits_image.fits_cards(path, image.header.pages[0])
    except ImageError as error:
        raise MapError(str(error)) from error
    written = header.get("BUNIT")
    named = text_grids.unit_agreed(path, unit, str(written) if written else None, "the key BUNIT")
    scale = next((float(header[key]) for key in _PUPIL_SCALE if isinstance(header.get(key), int | float)), math.nan)
    in_metres = "arc" not in str(header.get("PIXUNIT", "meter")).lower() and 0.0 < scale < _LARGEST_PIXEL
    metres = metres_per(path, named, wavelength)
    values = np.asarray(values, dtype=np.float64) * metres
    return WavefrontMap(
        values=values,
        spacing=scale if in_metres else math.nan,
        wavelength=wavelength,
        what="wavefront" if str(header.get("EXTNAME", "")).upper() == "OPD" else None,
        kind="FITS",
        notes=("Zeros of a FITS file count as measured; write NaN where no light is.",),
    )
