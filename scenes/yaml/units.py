"""Conversion between quantities as users write them, `2 arcsec`, and SI floats.

Every quantity carries its unit; a bare number is an error, even 0. A strict pattern reads the number, and only the unit
is passed to pint, which looks up names and never evaluates an expression. The conversion uses decimal arithmetic with a
single rounding at the end, so `20 um` is exactly the float 20e-6, and `format_quantity` writes text that reads back to
the same bits.
"""

import math
import re
import unicodedata
from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cache
from typing import Any

from scenes.yaml.errors import Problem, names_text, nearest, shown

_NUMBER = r"[-+]?(?:[0-9]{1,30}(?:\.[0-9]{0,30})?|\.[0-9]{1,30})(?:[eE][-+]?[0-9]{1,3})?"
_NAME = r"(?:[A-Za-zµμΩ°]{1,30}|%)(?:\^-?[1-9][0-9]?)?"
_UNIT = rf"(?:1/)?{_NAME}(?:[*/]{_NAME}){{0,3}}"
# A unit that begins with a letter may follow the number directly (2um); "1/m^3" may not, or "21/m^3" would read as 2
# 1/m^3.
_QUANTITY = re.compile(rf"({_NUMBER})(?:\s+({_UNIT})|({_NAME}(?:[*/]{_NAME}){{0,3}}))")
_BARE = re.compile(_NUMBER)
_COMMA = re.compile(r"(?<![0-9.,])([-+]?[0-9]{1,30}),([0-9]{1,30})(?![0-9]*[.,])")
_NOT_FINITE = re.compile(r"[-+]?\.?(nan|inf|infinity)\b.*", re.IGNORECASE | re.DOTALL)
LONGEST_TEXT = 100
OTHER_MINUS = tuple("\u2212\u2010\u2011\u2012\u2013\u2014\ufe63\uff0d")
"""Characters that word processors substitute for the minus sign; they look like it, but no parser reads them as one."""


@dataclass(frozen=True)
class Kind:
    """Kind of physical quantity.

    Attributes
    ----------
    name : str
        Name with its article, as used in messages: "an angle".
    si : str
        SI unit of values of this kind inside the program.
    units : tuple[str, ...]
        Units that messages suggest. Any other unit of the same dimension that pint knows is read as well.
    example : str
        A number with its unit, as an example for messages.
    writes : tuple[str, ...]
        Units used for output, the preferred one first; empty for the SI unit.
    """

    name: str
    si: str
    units: tuple[str, ...]
    example: str
    writes: tuple[str, ...] = ()

    @property
    def allowed(self) -> str:
        """Description of how a quantity of this kind may be written, for messages."""
        return self.asked(self.example)

    def asked(self, example: str) -> str:
        """Return the description of how a quantity of this kind may be written, with the given example."""
        return f"{self.name} with its unit ({names_text(self.units)}), e.g. '{example}'"


ANGLE = Kind(
    "an angle", "rad", ("arcsec", "deg", "arcmin", "mas", "mrad", "urad", "rad"), "2 arcsec", ("arcsec", "deg")
)
LENGTH = Kind("a length", "m", ("um", "mm", "m", "nm", "pm"), "20 um", ("um", "mm", "m", "nm"))
DISTANCE = Kind("a length", "m", ("km", "m", "mm"), "500 km", ("km", "m"))
"""Distance of an object, in contrast to the size of a part: kilometres come first."""
SCALE = Kind("a relative change", "", ("ppm", "percent", "um/m"), "10 ppm", ("ppm", "percent"))
TIME = Kind("a time", "s", ("ms", "s", "us"), "10 ms", ("ms", "s"))
MOMENT = Kind("a time", "s", ("min", "h", "s"), "12 min", ("min", "h", "s"))
"""Instant of an event, in contrast to a duration: minutes and hours come first."""
SPEED = Kind("a speed", "m/s", ("m/s", "km/s", "mm/s"), "7.6 km/s", ("m/s", "km/s", "mm/s"))
POWER = Kind("a power", "W", ("mW", "W", "uW", "nW"), "1 mW", ("mW", "W"))
MASS = Kind("a mass", "kg", ("kg", "g"), "20 kg", ("kg", "g"))
TEMPERATURE = Kind("a temperature", "K", ("degC", "K"), "20 degC", ("degC", "K"))
TEMPERATURE_DIFFERENCE = Kind("a temperature difference", "K", ("K", "mK"), "0.1 K")
PER_LENGTH = Kind("an inverse length", "1/m", ("1/m", "1/mm"), "0.5 1/m")
PER_LENGTH3 = Kind("an inverse length cubed", "1/m^3", ("1/m^3", "1/mm^3"), "1e-3 1/m^3")
PER_LENGTH5 = Kind("an inverse length to the fifth", "1/m^5", ("1/m^5", "1/mm^5"), "1e-3 1/m^5")
PER_LENGTH7 = Kind("an inverse length to the seventh", "1/m^7", ("1/m^7", "1/mm^7"), "1e-3 1/m^7")
TEMPERATURE_GRADIENT = Kind("a temperature gradient", "K/m", ("K/m", "mK/m"), "0.1 K/m")
FREQUENCY = Kind("a frequency", "Hz", ("Hz", "mHz", "kHz"), "0.65 Hz", ("Hz", "mHz", "kHz"))
ANGLE_SPECTRUM = Kind(
    "a spectral density of an angle", "rad^2/Hz", ("arcsec^2/Hz", "rad^2/Hz"), "0.01 arcsec^2/Hz", ("arcsec^2/Hz",)
)
"""One-sided spectral density: mean square of an angle per unit of frequency."""
EXPANSION = Kind("a thermal expansion", "1/K", ("ppm/K", "1/K"), "7.1 ppm/K", ("ppm/K", "1/K"))
KINDS = (
    *(ANGLE, LENGTH, SCALE, TIME, SPEED, POWER, MASS, TEMPERATURE, TEMPERATURE_GRADIENT, EXPANSION),
    *(FREQUENCY, ANGLE_SPECTRUM),
    *(PER_LENGTH, PER_LENGTH3, PER_LENGTH5, PER_LENGTH7),
)

_PI = Decimal("3.14159265358979323846264338327950288419716939937511")
_DEGREE = _PI / 180
_DEFINED: dict[str, dict[str, Decimal | str | int]] = {
    "rad": {
        "rad": 1,
        "mrad": "1e-3",
        "urad": "1e-6",
        "deg": _DEGREE,
        "arcmin": _DEGREE / 60,
        "arcsec": _DEGREE / 3600,
        "mas": _DEGREE / 3_600_000,
    },
    "m": {"km": 1000, "m": 1, "mm": "1e-3", "um": "1e-6", "nm": "1e-9", "pm": "1e-12"},
    "": {"ppm": "1e-6", "percent": "1e-2", "um/m": "1e-6"},
    "s": {"d": 86_400, "h": 3600, "min": 60, "s": 1, "ms": "1e-3", "us": "1e-6"},
    "m/s": {"km/s": 1000, "m/s": 1, "mm/s": "1e-3"},
    "kg*m**2/s**3": {"W": 1, "mW": "1e-3", "uW": "1e-6", "nW": "1e-9"},
    "kg": {"kg": 1, "g": "1e-3"},
    "K": {"K": 1, "mK": "1e-3"},
    "K/m": {"K/m": 1, "mK/m": "1e-3"},
    "1/K": {"1/K": 1, "ppm/K": "1e-6"},
    "1/s": {"Hz": 1, "mHz": "1e-3", "kHz": 1000},
    "rad**2*s": {"rad^2/Hz": 1, "arcsec^2/Hz": (_DEGREE / 3600) ** 2},
    "1/m": {"1/m": 1, "1/mm": 1000},
    **{f"1/m**{n}": {f"1/m^{n}": 1, f"1/mm^{n}": f"1e{3 * n}"} for n in (2, 3, 4, 5, 7)},
}
"""Base unit, as pint writes it -> the size of units in it."""
_KNOWN = {unit: (Decimal(size), base) for base, units in _DEFINED.items() for unit, size in units.items()}
"""Suggested unit -> its factor to SI and its base units.

With this table pint, which takes half a second to start, is rarely needed.
"""
_ALIASES = ("µm", "μm", "µrad", "μrad", "%", "hour", "day")
"""Further spellings of units that the regular expressions in the JSON Schemas for editors accept."""


def power_of_length(metre: int) -> Kind:
    """Return the kind of a quantity in m^``metre``, with ``metre`` an integer other than 0."""
    known = {1: LENGTH, -1: PER_LENGTH, -3: PER_LENGTH3, -5: PER_LENGTH5, -7: PER_LENGTH7}
    if metre in known:
        return known[metre]
    head, power = ("1/", -metre) if metre < 0 else ("", metre)
    units = tuple(f"{head}{unit}^{power}" for unit in ("m", "mm"))
    return Kind(f"a quantity in {units[0]}", units[0], units, f"1e-3 {units[0]}")


_CELSIUS = ("degC", "celsius", "°C")
_ZERO_CELSIUS = Decimal("273.15")


def parse_quantity(text: object, kind: Kind) -> float:
    """Return the SI value of a quantity written as number and unit.

    Parameters
    ----------
    text : object
        Text such as "-1.5 arcsec"; anything but text is refused.
    kind : Kind
        Kind of quantity that the text must have.

    Raises
    ------
    Problem
        The text has no unit or no number, the number is not finite, the unit is unknown (the nearest known one is
        suggested), or it is a unit of another kind.
    """
    if not isinstance(text, str):
        _refuse_untyped(text, kind)
    stripped = str(text).strip()
    if _NOT_FINITE.fullmatch(stripped):
        raise Problem("not a finite number", shown(text), kind.allowed)
    if _BARE.fullmatch(stripped):
        raise Problem("a number without a unit", stripped, kind.allowed)
    if stripped[:1] in OTHER_MINUS:
        raise foreign_minus(stripped)
    match = _QUANTITY.fullmatch(stripped) if len(stripped) <= LONGEST_TEXT else None
    if match is None:
        if (comma := decimal_comma(stripped)) is not None:
            raise comma
        raise Problem("not a number with a unit", shown(text), kind.allowed)
    value = _to_si(match[1], match[2] or match[3], kind)
    if not math.isfinite(value):
        raise Problem("not a finite number", shown(text), kind.allowed)
    return value


def decimal_comma(text: str) -> Problem | None:
    """Return the problem of a text whose numbers have a decimal comma; None for other text.

    The problem has the correct spelling.
    """
    if len(text) > LONGEST_TEXT or not (numbers := _COMMA.findall(text)):
        return None
    point, without = _COMMA.sub(r"\1.\2", text), _COMMA.sub(r"\1\2", text)
    if not all(_QUANTITY.fullmatch(form) or _BARE.fullmatch(form.split()[0]) for form in (point, without) if form):
        return None
    thousands = f", or {without} if thousands are meant" if all(len(digits) == 3 for _, digits in numbers) else ""
    return Problem("a number with a decimal comma", shown(text), f"write {point}{thousands}")


def foreign_minus(text: str) -> Problem:
    """Return the problem of a number that begins with one of `OTHER_MINUS`."""
    sign = text[0]
    remedy = f"the minus sign of the keyboard, '-': -{text[1:].lstrip()}"
    return Problem(f"a number with the sign U+{ord(sign):04X} ({unicodedata.name(sign).lower()})", shown(text), remedy)


def format_quantity(value: float, kind: Kind, within: float = 0.0) -> str:
    """Return text for an SI value that `parse_quantity` reads back to exactly the same float.

    A unit in which the number lies between 1 and 1000 is preferred, then one without a power of ten, then one with few
    digits, then the earlier one.

    Parameters
    ----------
    value : float
        Value in the SI unit.
    kind : Kind
        Kind of the quantity.
    within : float
        Largest allowed difference between text and value, in the SI unit: rounding errors of a computed value need not
        be written.

    Raises
    ------
    ValueError
        The value is not finite.
    """
    if not math.isfinite(value):
        raise ValueError(f"{value} has no text")
    choices = []
    for unit in kind.writes or (kind.si,):
        number = _shortest_number(value, unit, kind, within)
        if number is not None:
            handy = number == "0" or 1.0 <= abs(float(number)) < 1000.0
            choices.append((not handy, "e" in number, len(number.strip("-").replace(".", "")), f"{number} {unit}"))
    # The SI unit has factor one, so it always works.
    return min(choices, key=lambda choice: choice[:3])[3] if choices else f"{value!r} {kind.si or 'dimensionless'}"


def split_quantity(text: object) -> tuple[float, str] | None:
    """Return number and unit of a quantity of any kind; None for text that is not a quantity."""
    match = _QUANTITY.fullmatch(text.strip()) if isinstance(text, str) and len(text) <= LONGEST_TEXT else None
    if match is None or _look_up(match[2] or match[3]) is None:
        return None
    return float(match[1]), match[2] or match[3]


def split_row(text: str, length: int) -> list[str] | None:
    """Return the quantities of a row of numbers with one unit after the last, `0 0 3 um`; None for other text."""
    words = text.split() if len(text) <= length * LONGEST_TEXT else []
    numbers, unit = words[:length], " ".join(words[length:])
    if len(numbers) == length and unit and all(_BARE.fullmatch(number) for number in numbers):
        return [f"{number} {unit}" for number in numbers]
    return None


def pattern(kind: Kind, length: int = 1) -> str:
    """Return the regular expression of a quantity of a kind, for editors.

    For ``length`` > 1 it matches a row of numbers with one unit. It knows the usual units of the kind; the reader also
    accepts those that only pint knows.
    """
    looked_up = {unit: _look_up(unit) for unit in (*_KNOWN, *_ALIASES, *kind.units)}
    units = [unit for unit, match in looked_up.items() if match is not None and match[1] == _base(kind)]
    units += [unit for unit in _CELSIUS if kind == TEMPERATURE and unit not in units]
    row = rf"(?:{_NUMBER}\s+){{{length - 1}}}{_NUMBER}" if length > 1 else _NUMBER
    joined = "|".join(re.escape(unit).replace(r"\/", "/") for unit in units)
    return rf"^\s*{row}\s*(?:{joined})\s*$"


def with_unit(value: float, unit: str) -> str:
    """Return a computed number as a quantity with an explicit sign, so that it is read as a difference."""
    return f"{value:+} {unit}"


def unit_ratio(unit: str, other: str) -> float:
    """Return the factor that converts a number in ``unit`` to one in ``other``; degrees Celsius are differences here.

    Raises
    ------
    Problem
        The units measure different kinds of quantity, or one of them is unknown.
    """
    first, second = _look_up(unit), _look_up(other)
    if first is None or second is None or first[1] != second[1]:
        raise Problem(f"{unit} and {other} do not measure the same", unit, f"the unit {other}, or a multiple of it")
    with localcontext(prec=50):
        return float(first[0] / second[0])


def _shortest_number(value: float, unit: str, kind: Kind, within: float) -> str | None:
    """Return the shortest number that reads back to `value` within `within` in this unit; None beyond 17 digits."""
    with localcontext(prec=50):
        if value == 0.0 and unit not in _CELSIUS:
            return "-0" if math.copysign(1.0, value) < 0.0 else "0"
        factor = _look_up_checked(unit, kind)[0]
        exact = Decimal(value) / factor if unit not in _CELSIUS else Decimal(value) - _ZERO_CELSIUS
        for digits in range(1, 18):
            number = Decimal(f"{exact:.{digits}g}")
            if abs(_in_si(number, unit, factor) - value) <= within:
                plain = -5 <= number.adjusted() <= 6
                return format(number, "f") if plain else format(number.normalize(), "e")
    return None


def _refuse_untyped(value: object, kind: Kind) -> None:
    """Raise `Problem` if a value that should be a quantity is not text with a number and a unit."""
    if isinstance(value, float) and not math.isfinite(value):
        raise Problem("not a finite number", str(value), kind.allowed)
    if isinstance(value, int | float) and not isinstance(value, bool):
        raise Problem("a number without a unit", repr(value), kind.allowed)
    raise Problem("not a quantity", shown(value), kind.allowed)


def _to_si(number: str, unit: str, kind: Kind) -> float:
    factor = _look_up_checked(unit, kind)[0]
    with localcontext(prec=50):
        return _in_si(Decimal(number), unit, factor)


def _in_si(number: Decimal, unit: str, factor: Decimal) -> float:
    """Return the SI value of a number in a unit; ``factor`` is the size of the unit in SI."""
    return float(number + _ZERO_CELSIUS if unit in _CELSIUS else number * factor)


def _look_up_checked(unit: str, kind: Kind) -> tuple[Decimal, str]:
    """Return factor and base units of a unit; raise `Problem` if it is unknown or of another kind."""
    match = _look_up(unit)
    if match is None:
        raise _unknown(unit, kind)
    if match[1] != _base(kind) or (unit in _CELSIUS and kind != TEMPERATURE):
        other = "a temperature" if unit in _CELSIUS else _measured(match[1])
        raise Problem(
            f"{unit!r} is a unit of {other}, not of {kind.name}", unit, kind.allowed, nearest(unit, kind.units)
        )
    return match


def _unknown(unit: str, kind: Kind) -> Problem:
    return Problem(f"unknown unit {unit!r}", unit, kind.allowed, nearest(unit, kind.units))


def _measured(base: str) -> str:
    """Return the name of the kind of quantity with these base units, for messages."""
    for kind in KINDS:
        if _base(kind) == base:
            return kind.name
    return base or "a pure number"


def _base(kind: Kind) -> str:
    si = _look_up(kind.si)
    assert si is not None
    return si[1]


@cache
def _registry() -> Any:
    # Importing pint and reading its table of units takes half a second, so it is done only when a rare unit is read.
    import pint

    return pint.UnitRegistry(non_int_type=Decimal, cache_folder=None)


@cache
def _look_up(unit: str) -> tuple[Decimal, str] | None:
    """Return the factor to SI base units and the base units as text, or None for an unknown unit.

    Angles and pure numbers have the same dimension; they differ in base units, where angles keep their radian.
    """
    if not unit:
        return Decimal(1), ""
    if unit in _CELSIUS:
        return Decimal(1), "K"
    return _KNOWN.get(unit) or _look_up_by_pint(unit)


def _look_up_by_pint(unit: str) -> tuple[Decimal, str] | None:
    """Return the factor to SI base units and the base units of a unit that is not in `_KNOWN`, from pint."""
    import pint

    registry = _registry()
    try:
        parsed = registry.parse_units("percent" if unit == "%" else unit)
        factor, base = registry.get_base_units(parsed)
        # Units with an offset or a logarithm (degF, dB) have no factor.
        if registry.Quantity(Decimal(0), parsed).to_base_units().magnitude != 0:
            return None
    except (pint.errors.PintError, ValueError, TypeError, AttributeError, ArithmeticError):
        return None
    text = "" if base == registry.dimensionless else f"{base:~C}"
    return Decimal(factor), text
