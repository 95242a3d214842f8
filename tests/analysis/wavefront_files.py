"""Small files of wavefronts of every kind, by the definitions of the formats."""

import lzma
import struct
from pathlib import Path

import h5py
import numpy as np
from astropy.io import fits

WAVELENGTH = 632.8e-9
REAL = Path(__file__).with_name("metropro_interferogram.dat.xz")
"""A measurement of a real part with a Zygo interferometer: sample_files/valid_zygo_dat_file.dat of prysm by Brandon
Dube, under the MIT licence beside it. Header and phase are to the byte those of the original; its intensities, which
nothing here reads, are zeros, so that it packs to 0.2 MB.
"""


def wave(rows: int = 12, columns: int = 14, lit: bool = True) -> np.ndarray:
    """A map in metres, y growing with the row, with a notch that has no symmetry where nothing was measured."""
    y, x = np.meshgrid(np.arange(rows) - 5.0, np.arange(columns) - 6.0, indexing="ij")
    values = 1e-9 * (20.0 * x - 7.0 * y + 1.3 * x * y + 0.7 * x**2)
    values[0, :3] = np.nan
    values[-1, -1] = np.nan
    return values if lit else np.nan_to_num(values)


def real_file(folder: Path) -> Path:
    path = folder / "real.dat"
    path.write_bytes(lzma.decompress(REAL.read_bytes()))
    return path


def metropro(
    path: Path, values: np.ndarray, form: int = 1, frames: int = 1, counted: int | None = None, **header: float
) -> None:
    """MetroPro's: header of 834 or 4096 bytes, intensities, then counts from the top row down."""
    size = 4096 if form == 3 else 834
    head = bytearray(size)
    known = {"scale": 0.5, "obliquity": 1.0, "resolution": 1, "sign": 0, "codev": 0, "spacing": 1e-4} | header
    rows, columns = values.shape
    struct.pack_into(">4sHI", head, 0, bytes([0x88, 0x1B, 0x03, 0x6E + form]), form, size)
    struct.pack_into(">HHH", head, 52, 5, 4, frames if counted is None else counted)
    struct.pack_into(">HHI", head, 68, columns, rows, 4 * rows * columns)
    struct.pack_into(">fff", head, 164, known["scale"], WAVELENGTH, 0.0)
    struct.pack_into(">fff", head, 176, known["obliquity"], 0.0, known["spacing"])
    struct.pack_into(">H", head, 218, known["resolution"])
    struct.pack_into(">H", head, 232, known["sign"])
    struct.pack_into(">H", head, 298, known["codev"])
    counts = (4096, 32768, 131072)[known["resolution"]]
    one = np.float32(WAVELENGTH) * np.float64(known["scale"]) * known["obliquity"] / counts
    stored = np.where(np.isnan(values), 2147483640, np.rint(np.nan_to_num(values) / (one or 1.0))).astype(">i4")
    path.write_bytes(bytes(head) + bytes(2 * 5 * 4 * frames) + stored[::-1].tobytes())


def datx(path: Path, values: np.ndarray, unit: str = "Fringes", old: bool = False, **changed: object) -> None:
    """Of Mx: fringes, or another unit, with what makes metres of them in the surface's attributes."""
    scale = {"Fringes": 0.5 * 0.97 * WAVELENGTH, "NanoMeters": 1e-9}[unit]
    stored = np.where(np.isnan(values), 1e30, np.nan_to_num(values) / scale)[::-1]
    keys = {
        "No Data": [1e30],
        "Unit": np.array([unit.encode()], dtype=h5py.string_dtype()),
        "Wavelength": [WAVELENGTH],
        "Interferometric Scale Factor": [0.5],
        "Obliquity Factor": [0.97],
    } | changed
    converter = np.dtype(
        [("Category", h5py.string_dtype()), ("BaseUnit", h5py.string_dtype()), ("Parameters", h5py.vlen_dtype("f8"))]
    )
    with h5py.File(path, "w") as file:
        surface = file.create_dataset("Measurement/Surface" if old else "Data/Surface/{A1}", data=stored)
        for key, value in keys.items():
            if value is not None:
                surface.attrs[key] = value
        lateral = np.empty(1, converter)
        lateral[0] = (b"LateralCat", b"Pixels", np.array([0.0, 2e-4, 0.0, 1.0]))
        surface.attrs.create("X Converter", lateral, dtype=converter)
        file.create_group("Attributes/{B2}").attrs["Property Bag List"] = np.array([b"x"])


def codev(path: Path, values: np.ndarray, kind: str = "SUR", header: str = "NDA -32768", comments: str = "") -> None:
    """CODE V's: whole numbers, 2000 in a wave of 0.6328 um, from the top row down."""
    counts = np.where(np.isnan(values), -32768, np.rint(np.nan_to_num(values) / 0.6328e-6 * 2000)).astype(int)[::-1]
    rows, columns = values.shape
    text = "\n".join(" ".join(map(str, row)) for row in counts.reshape(-1, 7))
    path.write_text(f"{comments}a title\nGRD {columns} {rows} {kind} WVL 0.6328 SSZ 2000 {header}\n{text}\n")


def zemax(path: Path, values: np.ndarray, flag: int = 0, width: int = 5, header: str = "0 0") -> None:
    """Zemax's: a line for each point from the top left on, in mm, cm, inches or metres."""
    unit = (1e-3, 1e-2, 25.4e-3, 1.0)[flag]
    rows, columns = values.shape
    text = [f"! a comment\n{columns} {rows} {2e-4 / unit!r} {2e-4 / unit!r} {flag} {header}".rstrip()]
    for one in values[::-1].ravel():
        sag = repr(float(np.nan_to_num(one) / unit))
        text.append(sag if width == 1 else " ".join([sag, "0 0 0", str(int(np.isnan(one)))][: width - 2]))
    path.write_text("\r\n".join(text) + "\r\n", newline="")


def fits_map(path: Path, values: np.ndarray, unit: str | None = "nm", **cards: object) -> None:
    image = fits.PrimaryHDU(values * 1e9)
    image.header["PUPLSCAL"] = (3e-3, "m per pixel")
    if unit:
        image.header["BUNIT"] = unit
    image.header.update(cards)
    image.writeto(path, overwrite=True)


def table(path: Path, values: np.ndarray, head: str = "# unit: nm\n# spacing: 0.2 mm\n# what: surface\n") -> None:
    path.write_text(head + "\n".join(", ".join(map(repr, map(float, row))) for row in values[::-1] * 1e9) + "\n")


def zernikes(path: Path) -> None:
    head = "# order: fringe\n# normalised: peak\n# unit: nm\nfield [deg],Z4,Z5,Z7\n"
    path.write_text(head + "-1,10,20,-5\n0,11,2,3\n")


WRITERS = {"dat": metropro, "datx": datx, "int": codev, "zemax": zemax, "fits": fits_map, "table": table}
