"""Recorded frames and expected images as FITS, whose header names every quantity with its unit and has no WCS.

A file has the frames as one cube, columns, rows, frames. Row 0 of the CCD is the first row that is stored (NAXIS2 = 1),
column 0 the first pixel in it: places are those of docs/conventions.md. Grey values are unsigned 16-bit integers as
recorded, by FITS' own way of storing them (BZERO 32768).
"""

from __future__ import annotations

import importlib.metadata
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr

from scenes.specs.resolved import ResolvedJob
from twin.run.data_files import WRITER, ascii_text

Card = tuple[str, str | int | float, str]
"""Keyword, value, and what it is with its unit in brackets."""
_SCALE, _TIE, _KEYS = 33550, 33922, 34735
_GEODETIC_3D = 4979
_CHECKED = "of the file as it was written"
_PLACES = (
    "Row 0 is the first row stored (NAXIS2 = 1), column 0 the first pixel of",
    "a row; (0, 0) is the centre of the first pixel. No world coordinates.",
)


@dataclass(frozen=True, eq=False)
class RecordedFrames:
    """What a TIFF file of a run holds.

    Attributes:
        frames: (N, H, W) grey values as recorded.
        pages: what each page says of itself (``FrameFacts.page``).
        place: of a map, (longitude, latitude, per column, per row) of its first pixel's centre in degrees; else None.
        heights: whether the values are heights in metres.
    """

    frames: np.ndarray
    pages: tuple[Mapping[str, Any], ...]
    place: tuple[float, float, float, float] | None = None
    heights: bool = False


def read_frames(path: Path) -> RecordedFrames:
    """Frames of a TIFF file that a run has written.

    Raises:
        ValueError, KeyError: it is not such a file.
    """
    with tifffile.TiffFile(path) as file:
        frames = np.stack([page.asarray() for page in file.pages])
        pages = tuple(json.loads(page.description) for page in file.pages)
        tags = {tag.code: tag.value for tag in file.pages[0].tags.values()}
    if frames.ndim != 3 or frames.dtype.kind not in "uif":
        raise ValueError(f"pages of {frames.dtype.name} with {frames.ndim - 1} axes are no recorded frames")
    if not all(isinstance(page, Mapping) for page in pages):
        raise ValueError("a page says of itself what no page of a run does")
    if _SCALE not in tags:
        return RecordedFrames(frames, pages)
    across, down, _ = tags[_SCALE]
    _, _, _, longitude, latitude, _ = tags[_TIE]
    place = (longitude + 0.5 * across, latitude - 0.5 * down, across, -down)
    return RecordedFrames(frames, pages, place, tags[_KEYS][-1] == _GEODETIC_3D)


def run_cards(program: str, seed: int) -> list[Card]:
    """What made the run."""
    writer = f"{WRITER} {importlib.metadata.version(WRITER)}"
    return [
        ("CREATOR", writer, "program that wrote this file"),
        ("PROGRAM", program, "command that made the run"),
        ("SEED", seed, "of everything that was drawn"),
    ]


def detector_cards(job: ResolvedJob) -> list[Card]:
    """The monitor's area CCD by its data sheet (EMVA 1288), and its light."""
    detector, light = job.area_detector, job.instrument.autocollimator
    return [
        ("INSTRUME", ascii_text(job.instrument.name), "instrument"),
        ("DETECTOR", ascii_text(detector.name), "data sheet of the area CCD"),
        ("WAVELEN", light.wavelength, "[m] wavelength of the monitor's light"),
        ("GAIN", 1.0 / detector.system_gain_dn_per_e, "[electron/adu] 1 / K of EMVA 1288"),
        ("QE", detector.quantum_efficiency, "[electron/photon] quantum efficiency"),
        ("RDNOISE", detector.dark_noise_e, "[electron] temporal noise in the dark, rms"),
        ("DARKCUR", detector.dark_current_e_per_s, "[electron/s] mean dark current"),
        ("FULLWELL", detector.full_well_e, "[electron] saturation capacity"),
        ("SATURATE", detector.saturation_dn, "[adu] where the response ends"),
        ("PEDESTAL", detector.offset_dn, "[adu] grey value of no signal"),
        ("BITDEPTH", detector.bit_depth, "[bit] of the converter"),
        ("PRNU", detector.prnu, "[1] relative response of pixels, rms"),
        ("DSNU", detector.dsnu_e, "[electron] dark signal of pixels, rms"),
    ]


def frames_fits(recorded: RecordedFrames, cards: Iterable[Card]) -> bytes:
    """A FITS file of recorded frames; the same frames give the same bytes.

    Args:
        recorded: the frames.
        cards: of the header, beside those that the frames give.
    """
    from astropy.io import fits

    first = recorded.pages[0]
    unit = fits.PrimaryHDU(recorded.frames)
    own: list[Card] = []
    if recorded.heights:
        own.append(("BUNIT", "m", "values are heights above the ellipsoid"))
    elif recorded.place is None:
        own.append(("BUNIT", "adu", "values are grey values (DN)"))
    own += [
        ("NFRAMES", len(recorded.frames), "frames in this file, along axis 3"),
        ("AXIS1", "column", "what axis 1 counts"),
        ("AXIS2", "row", "what axis 2 counts"),
        ("AXIS3", "frame", "what axis 3 counts"),
    ]
    if "camera" in first:
        own.append(("CAMERA", ascii_text(first["camera"]), "whose CCD it is"))
    if "note" in first:
        own.append(("NOTE", ascii_text(first["note"]), "what else is to be known"))
    if "pitch_um" in first:
        own.append(("XPIXSZ", first["pitch_um"], "[um] pixel pitch along a row"))
        own.append(("YPIXSZ", first["pitch_um"], "[um] pixel pitch along a column"))
    if "exposure_s" in first:
        own.append(("EXPTIME", first["exposure_s"], "[s] exposure of each frame"))
    if recorded.place is not None:
        longitude, latitude, across, down = recorded.place
        own += [
            ("LON0", longitude, "[deg] longitude of the first pixel's centre"),
            ("LAT0", latitude, "[deg] latitude of the first pixel's centre"),
            ("DLON", across, "[deg] of longitude per column"),
            ("DLAT", down, "[deg] of latitude per row"),
        ]
    _put(unit, [*own, *cards])
    units = [unit]
    if "time_s" in first:
        units.append(_times("FRAMES", "frame", [page["time_s"] for page in recorded.pages]))
    return _bytes(units)


def expected_fits(data: xr.Dataset, cards: Sequence[Card]) -> bytes:
    """A FITS file of expected images, photons per pixel and frame: of each channel an extension with all its states.

    Args:
        data: as irradiance.nc and course.nc hold it, (state or time, channel, row, column).
        cards: of the first header.
    """
    from astropy.io import fits

    primary = fits.PrimaryHDU()
    _put(primary, list(cards))
    units: list[Any] = [primary]
    for name, variable in data.data_vars.items():
        first = str(variable.dims[0])
        for k, channel in enumerate(data["channel"].values):
            unit = fits.ImageHDU(variable.values[:, k])
            own: list[Card] = [
                ("EXTNAME", f"{channel} {name}", "channel and quantity"),
                ("BUNIT", "photon", "expected, per pixel and frame"),
                ("QUANTITY", ascii_text(str(variable.attrs["long_name"])), "what the values are"),
                ("AXIS1", "column", "what axis 1 counts"),
                ("AXIS2", "row", "what axis 2 counts"),
                ("AXIS3", first, "what axis 3 counts"),
                ("XPIXSZ", round(1e6 * float(data.attrs["pitch_m"]), 9), "[um] pixel pitch along a row"),
                ("YPIXSZ", round(1e6 * float(data.attrs["pitch_m"]), 9), "[um] pixel pitch along a column"),
            ]
            if first == "state":
                own += [(f"STATE{s}", str(state), f"plane {s}") for s, state in enumerate(data["state"].values, 1)]
            _put(unit, own)
            units.append(unit)
    if "time" in data.coords:
        units.append(_times("TIMES", "plane", data["time"].values.tolist()))
    return _bytes(units)


def _times(name: str, counted: str, times: Sequence[float]) -> Any:
    """Times of frames or planes."""
    from astropy.io import fits

    columns = [
        fits.Column(counted, "J", array=np.arange(1, len(times) + 1)),
        fits.Column("time", "D", "s", array=np.asarray(times, np.float64)),
    ]
    unit = fits.BinTableHDU.from_columns(columns, name=name)
    unit.header["TCOMM1"] = f"{counted} along axis 3"
    unit.header["TCOMM2"] = "since the beginning of the course"
    return unit


def _put(unit: Any, cards: Sequence[Card]) -> None:
    for keyword, value, about in cards:
        unit.header[keyword] = (value, about)
    if unit.data is not None:
        for line in _PLACES:
            unit.header.add_comment(line)


def _bytes(units: Sequence[Any]) -> bytes:
    from astropy.io import fits

    for unit in units:
        # a text of our own in place of astropy's, which is the time of the day
        unit.add_checksum(when=_CHECKED)
    out = io.BytesIO()
    fits.HDUList(list(units)).writeto(out)
    return out.getvalue()
