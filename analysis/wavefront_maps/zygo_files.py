"""Interferograms of Zygo: MetroPro's binary .dat and Mx's .datx, which is HDF5.

Fringes become metres by the factor of the MetroPro Reference Guide (page 12-6): wavelength times interferometric scale
factor times obliquity factor. Rows are stored from the top of the picture down and are turned over here.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from analysis.wavefront_maps.wavefront_map import MapError, WavefrontMap, metres_per, unit_named

METROPRO_MAGIC = b"\x88\x1b\x03"
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
MOST_POINTS = 20_000_000
"""Of a map: 160 MB of real numbers."""
_HEADERS = {0x6F: 834, 0x70: 834, 0x71: 4096}
"""Last byte of the magic number -> smallest size of the header of that format."""
_STEPS = {0: 4096, 1: 32768, 2: 131072}
"""Phase resolution of the header -> counts per fringe."""
_INVALID = 2147483640
_LARGEST_WAVELENGTH = 1e-3
_FIELDS = {
    "header_size": (">I", 6),
    "frame_width": (">H", 52),
    "frame_height": (">H", 54),
    "frames": (">H", 56),
    "width": (">H", 68),
    "height": (">H", 70),
    "scale_factor": (">f", 164),
    "wavelength": (">f", 168),
    "obliquity": (">f", 176),
    "spacing": (">f", 184),
    "resolution": (">H", 218),
    "sign": (">H", 232),
    "codev_type": (">H", 298),
}
"""What is used of the header: form and place."""


def is_metropro(start: bytes) -> bool:
    """Whether a file that starts so is MetroPro's."""
    return start[:3] == METROPRO_MAGIC and start[3:4] != b"" and start[3] in _HEADERS


def read_metropro(path: Path) -> WavefrontMap:
    """A file of MetroPro, of any of its three header formats.

    A short file is not filled up with zeros, which would be measured values.

    Args:
        path: of the file.

    Raises:
        MapError: no phase in it, a header that cannot be, or a file that is cut off.
    """
    data = path.read_bytes()
    if len(data) < _HEADERS[data[3]]:
        raise MapError(f"{path} is cut off in its header: copy it again from the interferometer")
    head: dict[str, Any] = {key: struct.unpack_from(form, data, place)[0] for key, (form, place) in _FIELDS.items()}
    rows, columns = head["height"], head["width"]
    if not rows or not columns:
        raise MapError(f"{path} holds no phase map, only intensities: save the measurement with its phase data")
    for key in ("scale_factor", "wavelength", "obliquity"):
        if not (math.isfinite(head[key]) and head[key] > 0.0):
            raise MapError(f"{path} is damaged: its header has {key.replace('_', ' ')} {head[key]:.6g}")
    if head["wavelength"] > _LARGEST_WAVELENGTH:
        raise MapError(f"{path} is damaged: its header has wavelength {head['wavelength']:.6g} m")
    if head["resolution"] not in _STEPS:
        raise MapError(f"{path} is damaged: its header has phase resolution {head['resolution']}; 0, 1 and 2 exist")
    if rows * columns > MOST_POINTS:
        raise MapError(f"{path} has {rows} x {columns} points, more than {MOST_POINTS}: save a smaller part of it")
    start = head["header_size"] + 2 * head["frame_width"] * head["frame_height"] * head["frames"]
    one = head["header_size"] + 2 * head["frame_width"] * head["frame_height"]
    # some programs count no frame and write one
    start = one if not head["frames"] and len(data) >= one + 4 * rows * columns else start
    if len(data) < start + 4 * rows * columns or head["header_size"] < _HEADERS[data[3]]:
        raise MapError(
            f"{path} is cut off or damaged: its header wants {rows} x {columns} points from byte {start} on, the file"
            f" has {len(data)} bytes; copy it again"
        )
    counts = np.frombuffer(data, ">i4", rows * columns, start).reshape(rows, columns)[::-1]
    metres = head["wavelength"] * head["scale_factor"] * head["obliquity"] / _STEPS[head["resolution"]]
    values = np.where(counts >= _INVALID, np.nan, counts * metres)
    notes = [_of_scale(head["scale_factor"])]
    if head["sign"]:
        notes.append(
            "The header says that the sign of the data is inverted. Programs differ on whether the stored values are"
            " inverted already: state the sign, or check it."
        )
    spacing = head["spacing"] if math.isfinite(head["spacing"]) and head["spacing"] > 0.0 else math.nan
    return WavefrontMap(
        values=values,
        spacing=spacing,
        wavelength=head["wavelength"],
        what="surface" if head["codev_type"] == 1 else None,
        scale_factor=head["scale_factor"],
        obliquity=head["obliquity"],
        kind="Zygo MetroPro",
        notes=tuple(notes),
    )


def _of_scale(scale: float) -> str:
    return f"The interferometric scale factor of the file, {scale:.6g} waves per fringe, is in the values."


def read_datx(path: Path, wavelength: float | None = None) -> WavefrontMap:
    """A file of Mx, in its present layout (``Data/Surface``) or its first one (``Measurement/Surface``).

    Args:
        path: of the file.
        wavelength: metres, where the file does not say.

    Raises:
        MapError: HDF5 of another kind, or damaged.
    """
    try:
        return _datx(path, wavelength)
    except MapError:
        raise
    # what the library finds wrong with a spoilt file cannot be foreseen, nor is it said in words for a user
    except Exception as error:
        raise MapError(f"{path} cannot be read as a .datx file: it is damaged; copy it again") from error


def _datx(path: Path, stated: float | None) -> WavefrontMap:
    # imported for such a file only
    import h5py

    with h5py.File(path, "r") as file:
        found = list(_surfaces(file))
        if not found:
            raise MapError(f"{path} is HDF5, but no .datx file of Zygo: it has neither Data/Surface nor Measurement")
        surface = found[0]
        shape = surface.shape
        if len(shape) != 2 or 0 in shape or surface.dtype.kind not in "iuf":
            raise MapError(f"{path}: its surface is no map of numbers (shape {shape}, type {surface.dtype})")
        if math.prod(shape) > MOST_POINTS:
            raise MapError(f"{path} has {shape[0]} x {shape[1]} points, more than {MOST_POINTS}: save a part of it")
        if surface.external is not None or surface.is_virtual:
            raise MapError(f"{path}: its surface lies in another file; save it as one file")
        keys = _attributes(file, surface)
        stored = np.asarray(surface[()], dtype=np.float64)[::-1]
        limit = _number(keys, "No Data", float(_INVALID))
        stored = np.where(~np.isfinite(stored) | (stored >= limit), np.nan, stored)
        unit = keys.get("Unit", "")
        scale = _number(keys, "Interferometric Scale Factor", math.nan)
        obliquity = _number(keys, "Obliquity Factor", 1.0)
        wave = _number(keys, "Wavelength", math.nan)
        spacing = _spacing(surface)
    usable = math.isfinite(wave) and 0.0 < wave < _LARGEST_WAVELENGTH
    wavelength = wave if usable else stated
    if not isinstance(unit, str) or not unit:
        raise MapError(f"{path} does not say the unit of its surface; save it from Mx in fringes or nanometres")
    if unit.lower() == "fringes":
        if not (math.isfinite(scale) and scale > 0.0 and math.isfinite(obliquity) and obliquity > 0.0):
            raise MapError(f"{path} is in fringes and has no usable interferometric scale factor or obliquity factor")
        if wavelength is None:
            raise MapError(f"{path} is in fringes and does not say of which wavelength: state the wavelength")
        values = stored * obliquity * scale * wavelength
        notes = [_of_scale(scale)]
    else:
        values = stored * metres_per(path, unit_named(path, unit), wavelength)
        scale = obliquity = 1.0
        notes = [f"The file is in {unit}; no scale factor was applied."]
    if len(found) > 1:
        notes.append(f"The file has {len(found)} surfaces, of which the first was read.")
    return WavefrontMap(values, spacing, wavelength, None, scale, obliquity, "Zygo datx", tuple(notes))


def _surfaces(file: Any) -> Iterator[Any]:
    """Data sets of surfaces, in the order of their names."""
    import h5py

    for name in ("Data/Surface", "Measurement/Surface"):
        place = _held(file, name)
        if isinstance(place, h5py.Dataset):
            yield place
        elif isinstance(place, h5py.Group):
            held = (_held(place, key) for key in sorted(place))
            yield from (one for one in held if isinstance(one, h5py.Dataset))


def _held(place: Any, name: str) -> Any:
    """Return the group or data set of a name, None for none; links lead to other places, and are refused unfollowed.

    Raises
    ------
    MapError
        The name, or a part of it, is a link.
    """
    import h5py

    for part in name.split("/"):
        if not isinstance(place, h5py.Group):
            return None
        if isinstance(place.get(part, getlink=True), h5py.ExternalLink | h5py.SoftLink):
            raise MapError(
                f"{place.file.filename}: {part} is a link to another place; save it as one file, without links"
            )
        place = place.get(part)
    return place


def _attributes(file: Any, surface: Any) -> dict[str, Any]:
    """Scalars and texts among the attributes of the surface and, where these lack one, of the measurement."""
    import h5py

    general = _held(file, "Measurement/Attributes")
    out: dict[str, Any] = {}
    for holder in (general, surface):
        if isinstance(holder, h5py.Group | h5py.Dataset):
            for key, value in holder.attrs.items():
                first = np.asarray(value).reshape(-1)[:1]
                if first.size and first.dtype.kind in "OSUiuf":
                    one = first[0]
                    out[key] = one.decode("utf-8", "replace") if isinstance(one, bytes) else one
    # names of the first layout
    for old, new in (("Interf Scale Factor", "Interferometric Scale Factor"), ("Obliquity", "Obliquity Factor")):
        if old in out:
            out.setdefault(new, out[old])
    return out


def _number(keys: dict[str, Any], key: str, otherwise: float) -> float:
    value = keys.get(key, otherwise)
    return otherwise if isinstance(value, str) else float(value)


def _spacing(surface: Any) -> float:
    """Metres per pixel by the converter of x: category, unit, and parameters, the second of which it is."""
    try:
        category, _, parameters = surface.attrs["X Converter"][0]
        spacing = float(parameters[1])
    except (KeyError, IndexError, TypeError, ValueError):
        return math.nan
    name = category.decode("utf-8", "replace") if isinstance(category, bytes) else str(category)
    return spacing if name == "LateralCat" and math.isfinite(spacing) and spacing > 0.0 else math.nan
