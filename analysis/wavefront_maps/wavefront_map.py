"""A measured wavefront or surface as a map of metres, the error of files that hold none, and their units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError

WAVES = "waves"
"""The unit that needs a wavelength."""
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12}
_NAMES = {
    **{name: name for name in _LENGTHS},
    "micron": "um",
    "microns": "um",
    **{f"{name}{end}": unit for name, unit in (("wave", WAVES), ("meter", "m"), ("metre", "m")) for end in ("", "s")},
    **{
        f"{prefix}{name}{end}": unit
        for prefix, unit in (("centi", "cm"), ("milli", "mm"), ("micro", "um"), ("nano", "nm"), ("pico", "pm"))
        for name in ("meter", "metre")
        for end in ("", "s")
    },
}
"""Names of units in files, in small letters, to those used here."""


class MapError(MeasurementError, ValueError):
    """A file that cannot be read as a wavefront, or a map from which a number cannot be had; the message says what to
    change.
    """


@dataclass(frozen=True, eq=False)
class WavefrontMap:
    """A wavefront or a surface on a grid of square pixels.

    Rows and columns are those of a right-handed frame in which the program that wrote the file draws it: x grows with
    the column to the right, y with the row upwards, so that row 0 is the lowest one.

    Attributes:
        values: (rows, columns), optical path difference or height in metres with the sign of the file, NaN where
            nothing was measured.
        spacing: of the pixels, metres; NaN where the file does not say.
        wavelength: metres; None where the file does not say.
        what: ``wavefront`` or ``surface`` where the file says; None otherwise.
        scale_factor: waves per fringe by which the file's program multiplied (0.5 for light that meets the surface
            twice); it is in ``values``.
        obliquity: factor of oblique light, likewise.
        kind: of the file, as in ``Zygo MetroPro``.
        notes: what a reader should know of how the file was understood, whole sentences.
    """

    values: Array
    spacing: float
    wavelength: float | None
    what: str | None
    scale_factor: float = 1.0
    obliquity: float = 1.0
    kind: str = ""
    notes: tuple[str, ...] = ()

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Where something was measured, (rows, columns)."""
        return np.isfinite(self.values)


def unit_named(path: Path, text: str) -> str:
    """The unit that a file or a user means: ``m``, ``mm``, ``um``, ``nm``, ``pm``, ``cm`` or ``waves``.

    Args:
        path: of the file, for the message.
        text: its name.

    Raises:
        MapError: no such unit.
    """
    # both letters that stand for micro
    name = text.strip().strip("'\"").lower().replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    if name not in _NAMES:
        raise MapError(f"{path}: there is no unit {text.strip()[:40]!r}; m, mm, um, nm and waves are known")
    return _NAMES[name]


def metres_per(path: Path, unit: str, wavelength: float | None) -> float:
    """Metres in one unit.

    Args:
        path: of the file, for the message.
        unit: as ``unit_named`` gives it.
        wavelength: metres, None where it is not known.

    Raises:
        MapError: waves of an unknown wavelength.
    """
    if unit != WAVES:
        return _LENGTHS[unit]
    if wavelength is None:
        raise MapError(f"{path} is in waves and does not say of which wavelength: state the wavelength")
    return wavelength


def length_from(path: Path, text: str, key: str) -> float:
    """A positive length with its unit, as in ``632.8 nm``, in metres.

    Args:
        path: of the file, for the message.
        text: number and unit.
        key: what it is the length of, for the message.

    Raises:
        MapError: another text, or not a positive length.
    """
    number, _, unit = text.strip().partition(" ")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not unit.strip() or not math.isfinite(value) or value <= 0.0:
        raise MapError(f"{path}: {key} is {text.strip()[:40]!r}; a positive length with its unit is needed: 632.8 nm")
    named = unit_named(path, unit)
    if named == WAVES:
        raise MapError(f"{path}: {key} is in waves; a length is needed: 632.8 nm")
    return value * _LENGTHS[named]


def agreed(path: Path, key: str, stated: float | None, found: float | None) -> float | None:
    """The one value where file and user both give one.

    Args:
        path: of the file, for the message.
        key: of the value, for the message.
        stated: by the user, in SI units.
        found: in the file.

    Raises:
        MapError: they differ by more than a millionth.
    """
    if stated is None or found is None:
        return found if stated is None else stated
    if abs(stated - found) > 1e-6 * abs(found):
        raise MapError(f"{path} says {key} {found:.8g} m, stated is {stated:.8g} m: take the statement away")
    return found
