"""Mutators of images and data sets: what stands in them and what they say of it, in a file that is still one."""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from typing import Any

import cv2
import h5py
import numpy as np
import tifffile
from astropy.io import fits

Pixels = np.ndarray[Any, np.dtype[Any]]


def _read(content: bytes) -> Pixels:
    """Pixels of a TIFF, FITS, PNG or JPEG file."""
    if content[:4] in (b"II*\0", b"MM\0*", b"II+\0"):
        return np.asarray(tifffile.imread(io.BytesIO(content)))
    if content.startswith(b"SIMPLE"):
        with fits.open(io.BytesIO(content)) as units:
            return np.array(units[0].data)
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("no image")
    return pixels


def _written(pixels: Pixels, content: bytes, **how: Any) -> bytes:
    """Pixels as a file of the same format; tags of a GeoTIFF and notes go."""
    out = io.BytesIO()
    if content.startswith(b"SIMPLE"):
        fits.PrimaryHDU(pixels).writeto(out)
        return out.getvalue()
    if content[:4] in (b"II*\0", b"MM\0*", b"II+\0"):
        tifffile.imwrite(out, pixels, **how)
        return out.getvalue()
    ok, coded = cv2.imencode(".png" if content.startswith(b"\x89PNG") else ".jpg", pixels)
    if not ok:
        raise ValueError("no image")
    return bytes(coded)


def _image(change: Callable[[Pixels, random.Random], Pixels]) -> Callable[[bytes, random.Random], bytes]:
    def changed(content: bytes, chance: random.Random) -> bytes:
        return _written(change(_read(content), chance), content)

    changed.__name__ = change.__name__
    return changed


def level(pixels: Pixels, chance: random.Random) -> Pixels:
    """All dark, all saturated, one value, or darker and brighter than any image."""
    top = np.iinfo(pixels.dtype).max if pixels.dtype.kind in "ui" else 1e38
    sort = chance.randrange(5)
    if sort < 3:
        return np.full_like(pixels, (0, top, top // 2)[sort])
    factor = chance.choice((0.01, 0.1, 3.0, 30.0))
    return np.clip(pixels * factor, 0, top).astype(pixels.dtype)


def patched(pixels: Pixels, chance: random.Random) -> Pixels:
    """A patch, row or column of one value."""
    out = pixels.copy()
    rows, columns = out.shape[-2:]
    a, b = sorted((chance.randrange(rows), chance.randrange(rows)))
    c, d = sorted((chance.randrange(columns), chance.randrange(columns)))
    top = np.iinfo(out.dtype).max if out.dtype.kind in "ui" else 1e30
    out[..., a : b + 1, c : d + 1] = chance.choice((0, 1, top))
    return out


def noise(pixels: Pixels, chance: random.Random) -> Pixels:
    """Noise in place of the image."""
    rng = np.random.default_rng(chance.randrange(2**32))
    top = np.iinfo(pixels.dtype).max if pixels.dtype.kind in "ui" else 1e4
    return (rng.uniform(0.0, top * chance.choice((1.0, 0.01)), pixels.shape)).astype(pixels.dtype)


def cut(pixels: Pixels, chance: random.Random) -> Pixels:
    """Fewer rows and columns, or pages."""
    rows, columns = (chance.choice((1, 2, 5, n // 2, n - 1, n)) for n in pixels.shape[-2:])
    return pixels[: chance.choice((1, len(pixels)))][..., :rows, :columns]


def turned(pixels: Pixels, chance: random.Random) -> Pixels:
    """Mirrored, or on its side."""
    return chance.choice((pixels[..., ::-1], pixels[..., ::-1, :], np.swapaxes(pixels, -1, -2))).copy()


def kind(pixels: Pixels, chance: random.Random) -> Pixels:
    """Other numbers of the same values, some of which are none."""
    sort = chance.choice(("f4", "f8", "i2", "i4", "u1", "u4", "f4 nan", "f4 inf", "f8 huge"))
    out = pixels.astype(sort[:2])
    if " " in sort:
        out = out.copy()
        out.flat[chance.randrange(out.size)] = {"nan": np.nan, "inf": np.inf, "huge": 1e300}[sort[3:]]
    return out


def depth(pixels: Pixels, chance: random.Random) -> Pixels:
    """More or fewer dimensions: pages, colours."""
    return chance.choice(
        (pixels[None], np.stack([pixels] * 3, axis=-1), np.concatenate([pixels] * 2), pixels.reshape(-1)[: 10**4][None])
    )


def packed(content: bytes, chance: random.Random) -> bytes:
    """The same pixels, written in another way."""
    pixels = _read(content)
    if content[:2] not in (b"II", b"MM"):
        raise ValueError("no TIFF")
    how = chance.choice(
        (
            {"compression": "zlib"},
            {"compression": "lzw"},
            {"bigtiff": True},
            {"byteorder": ">"},
            {"tile": (16, 16)},
            {"photometric": "miniswhite"},
            {"description": "x" * 5000},
            {"description": '{"note": [1, null]}'},
            {"description": "[]"},
            {"description": '{"note": {}, "frames": "x"}'},
        )
    )
    return _written(pixels, content, **how)


def number(content: bytes, chance: random.Random) -> bytes:
    """A number of the head, where sizes, offsets and counts stand, is another one."""
    out = bytearray(content)
    size = chance.choice((1, 2, 4, 8))
    last = max(1, min(len(out) - size, chance.choice((64, 400, len(out)))))
    at = chance.randrange(last) // size * size
    value = chance.choice((0, 1, 2**7, 2**15 - 1, 2**16, 2**31 - 1, 2**32 - 1, 2**63 - 1)) % 2 ** (8 * size)
    out[at : at + size] = value.to_bytes(size, chance.choice(("little", "big")))
    return bytes(out)


def card(content: bytes, chance: random.Random) -> bytes:
    """A card of a FITS file's head is another one."""
    if not content.startswith(b"SIMPLE"):
        raise ValueError("no FITS")
    end = content.index(b"END" + b" " * 77) // 80
    out, at = bytearray(content), 80 * chance.randrange(end)
    key = bytes(out[at : at + 8])
    values = ("0", "-1", "1", "99999999", "T", "'x'", "1e400", "NaN", "", "-64", "17", "2147483647")
    new = chance.choice(
        (key, b"NAXIS3  ", b"BSCALE  ", b"BZERO   ", b"BLANK   ", b"XTENSION", b"DATE-OBS", b"EXPTIME ")
    )
    out[at : at + 80] = (new + b"= " + f"{chance.choice(values):>20}".encode()).ljust(80)
    return bytes(out)


IMAGES = (*(_image(one) for one in (level, patched, noise, cut, turned, kind, depth)), *(packed, number, number, card))


# --- data sets (netCDF-4, which is HDF5)


def _data_set(change: Callable[[h5py.File, str, random.Random], None]) -> Callable[[bytes, random.Random], bytes]:
    """A change of a variable as one of a file."""

    def changed(content: bytes, chance: random.Random) -> bytes:
        out = io.BytesIO(content)
        with h5py.File(out, "r+") as data:
            names: list[str] = []
            data.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
            change(data, chance.choice(sorted(names)), chance)
        return out.getvalue()

    changed.__name__ = change.__name__
    return changed


def _replaced(data: h5py.File, name: str, values: Any) -> None:
    about = dict(data[name].attrs)
    del data[name]
    item = data.create_dataset(name, data=values)
    for key, value in about.items():
        if key not in ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates"):
            item.attrs[key] = value


def lost_variable(data: h5py.File, name: str, chance: random.Random) -> None:
    """A variable is missing."""
    del data[name]


def other_values(data: h5py.File, name: str, chance: random.Random) -> None:
    """Values that are none, infinite or extreme, in all of a variable."""
    values = np.asarray(data[name][()])
    if values.dtype.kind not in "fiu":
        raise ValueError("no numbers")
    new = chance.choice((0, 1, -1, np.nan, np.inf, 1e300)) if values.dtype.kind == "f" else chance.choice((0, 1, 100))
    data[name][...] = np.full_like(values, new)


def other_shape(data: h5py.File, name: str, chance: random.Random) -> None:
    """A variable of another shape, beside dimensions that are as they were."""
    values = np.asarray(data[name][()])
    _replaced(data, name, chance.choice((values.reshape(-1)[:1], values.reshape(-1), values[None], values.flat[0])))


def other_kind(data: h5py.File, name: str, chance: random.Random) -> None:
    """Texts for numbers, whole numbers for others."""
    values = np.asarray(data[name][()])
    sort = chance.choice(("S8", "i1", "f4", "u8"))
    _replaced(data, name, np.resize(np.nan_to_num(values.astype("f8")), values.shape).astype(sort))


def other_note(data: h5py.File, name: str, chance: random.Random) -> None:
    """An attribute of a variable, or of the file, is another one or missing."""
    notes = (data[name] if chance.random() < 0.6 else data).attrs
    keys = [key for key in notes if key not in ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME")]
    key = chance.choice(sorted(keys))
    if chance.random() < 0.3:
        del notes[key]
    else:
        notes[key] = chance.choice(("", "x", "days since 1970-01-01", "m" * 2000, 5, -1.5, [1, 2, 3], "\u202e"))


DATA_SETS = (*map(_data_set, (lost_variable, other_values, other_shape, other_kind, other_note)), number)
