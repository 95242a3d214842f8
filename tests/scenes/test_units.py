"""Quantities: exact values, exact round trips, examples in messages, and refusals that say what is allowed."""

import importlib
import math
import pkgutil
import random
import sys
from collections.abc import Iterator

import pytest

import scenes.specs
from scenes.yaml import units
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Spec
from scenes.yaml.unit_fields import EXAMPLES, Quantity, Vector, example_of

EXACT = {
    units.LENGTH: {"20 um": 20e-6, "20um": 20e-6, " 20  µm ": 20e-6, "650 nm": 650e-9, "-11851.78535 mm": -11.85178535,
             "+.5 m": 0.5, "3e-2 m": 0.03, "0 m": 0.0},
    units.SCALE: {"10 ppm": 10e-6, "1 %": 0.01, "2 um/m": 2e-6},
    units.TIME: {"10 ms": 0.01},
    units.SPEED: {"7.6 km/s": 7600.0, "36 km/hour": 10.0},
    units.POWER: {"2 mW": 0.002},
    units.TEMPERATURE: {"20 degC": 293.15, "20 °C": 293.15},
    units.TEMPERATURE_DIFFERENCE: {"0.1 K": 0.1},
    units.PER_LENGTH3: {"1e-3 1/m^3": 1e-3, "1 1/mm^3": 1e9},
    units.PER_LENGTH5: {"2 m^-5": 2.0},
    units.ANGLE: {"180 deg": math.pi, "1 rad": 1.0},
}  # fmt: skip
NOT_FINITE = (float("nan"), float("inf"), "nan m", "-inf m", "1e999 m")
NO_QUANTITY = (
    *("9**9**9 m", "__import__('os') m", "1 m^99999999", "1 " + "m*" * 500 + "m", "9" * 10_000 + " m", "٣ m"),
    *("two um", ""),
)
REFUSED = [
    *((found, units.LENGTH, "not a quantity", None) for found in (True, None, ["1 m"])),
    *((found, units.LENGTH, "not a finite number", None) for found in NOT_FINITE),
    *((found, units.LENGTH, "not a number with a unit", None) for found in NO_QUANTITY),
    ("21/m^3", units.PER_LENGTH3, "not a number with a unit", None),
    ("2 Um", units.LENGTH, "unknown unit 'Um'", "um"),
    ("3 dB", units.SCALE, "unknown unit", None),
    ("1 rad", units.SCALE, "'rad' is a unit of an angle, not of a relative change", None),
    ("2 sec", units.ANGLE, "'sec' is a unit of a time, not of an angle", "arcsec"),
]
KEPT = {
    units.ANGLE: ("2 arcsec", "-1.5 arcsec", "26 deg"),
    units.LENGTH: ("20 um", "650 nm", "-6.74535927468851 m"),
    units.SPEED: ("7.61 km/s",),
    units.DISTANCE: ("500 km",),
    units.SCALE: ("10 ppm",),
    units.TEMPERATURE: ("20 degC",),
}


def test_exact_values() -> None:
    for kind, texts in EXACT.items():
        assert {text: units.parse_quantity(text, kind) for text in texts} == texts
    assert units.parse_quantity("2 arcsec", units.ANGLE) == pytest.approx(2 * math.pi / 648000, rel=4e-16)


def test_refused() -> None:
    for text, kind, problem, suggestion in REFUSED:
        with pytest.raises(Problem) as caught:
            units.parse_quantity(text, kind)
        assert problem in str(caught.value), text
        assert caught.value.suggestion == suggestion, text
        assert kind.example in caught.value.allowed, text


def test_text_reads_back_to_the_same_bits() -> None:
    generator = random.Random(1)
    checked = 0
    for kind in (*units.KINDS, units.TEMPERATURE_DIFFERENCE):
        values = [generator.uniform(-1, 1) * 10 ** generator.uniform(-12, 8) for _ in range(100)]
        for value in [*values, 0.0, 5e-324, -1.7976931348623157e308]:
            assert units.parse_quantity(units.format_quantity(value, kind), kind) == value
            checked += 1
    assert checked > 1000
    assert math.copysign(1.0, units.parse_quantity(units.format_quantity(-0.0, units.LENGTH), units.LENGTH)) == -1.0


def test_text_comes_out_as_it_went_in() -> None:
    for kind, texts in KEPT.items():
        assert tuple(units.format_quantity(units.parse_quantity(text, kind), kind) for text in texts) == texts


def test_lengths_above_a_kilometre_have_no_power_of_ten() -> None:
    assert [units.format_quantity(value, units.LENGTH) for value in (6e3, 5e5, -7e6)] == [
        "6000 m",
        "500000 m",
        "-7000000 m",
    ]


def test_no_text_for_what_is_not_finite() -> None:
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="has no text"):
            units.format_quantity(value, units.LENGTH)


def test_the_units_that_are_suggested_are_those_of_pint() -> None:
    """They are kept in a table, since asking pint takes half a second; factors to the last digits of its arithmetic."""
    import scenes.schema  # noqa: F401 - all specifications, and with them all kinds

    modules = [module for name, module in sys.modules.items() if name.startswith("scenes.")]
    kinds = [item for module in modules for item in vars(module).values() if isinstance(item, units.Kind)]
    assert len(kinds) > 15
    suggested = {unit for kind in kinds for unit in (*kind.units, *kind.writes, kind.si)} - {"", "degC"}
    assert suggested <= set(units._KNOWN)
    for unit, (factor, base) in units._KNOWN.items():
        asked = units._look_up_by_pint(unit)
        assert asked is not None
        assert asked[1] == base
        assert abs(asked[0] / factor - 1) < 1e-26


def test_a_minus_that_is_none_is_named() -> None:
    for sign in units.OTHER_MINUS:
        with pytest.raises(Problem, match=f"U\\+{ord(sign):04X}") as caught:
            units.parse_quantity(f"{sign} 3 um", units.LENGTH)
        assert caught.value.allowed.endswith(": -3 um")


def test_a_decimal_comma_is_told() -> None:
    for text, kind, write in (
        ("3,5 um", units.LENGTH, "write 3.5 um"),
        ("-0,25um", units.LENGTH, "write -0.25um"),
        ("1,5e-3 1/m^3", units.PER_LENGTH3, "write 1.5e-3 1/m^3"),
        ("1,500 m", units.LENGTH, "write 1.500 m, or 1500 m if thousands are meant"),
        ("3,5", units.LENGTH, "write 3.5"),
    ):
        with pytest.raises(Problem, match="a number with a decimal comma") as caught:
            units.parse_quantity(text, kind)
        assert caught.value.allowed == write
    for text in ("1,2,3 um", "M1,2", "a,b", "," + "1" * 200):
        with pytest.raises(Problem) as caught:
            units.parse_quantity(text, units.LENGTH)
        assert "decimal comma" not in str(caught.value)


for module in pkgutil.walk_packages(scenes.specs.__path__, "scenes.specs."):
    importlib.import_module(module.name)


def kinds(spec: type[Spec]) -> Iterator[type[Spec]]:
    for one in spec.__subclasses__():
        yield one
        yield from kinds(one)


QUANTITIES = {
    (spec.__name__, name): item.of if isinstance(item, Vector) else item
    for spec in kinds(Spec)
    for name, field in spec.model_fields.items()
    for item in field.metadata
    if isinstance(item, Quantity | Vector)
}


def test_every_example_is_allowed() -> None:
    assert len(QUANTITIES) > 150
    for (_, name), quantity in QUANTITIES.items():
        quantity.parse(example_of(quantity, (name,)))


def test_an_example_is_of_its_key() -> None:
    names = {name for _, name in QUANTITIES}
    assert {key.rpartition(".")[2] for key in EXAMPLES} <= names
    pupil = QUANTITIES["CameraSpec", "entrance_pupil"]
    assert example_of(pupil, ("entrance_pupil",)) == "0.6 m"
    assert example_of(QUANTITIES["Prism0Spec", "shift"], ("monitor", "prism_0", "shift")) == "100 mm"
