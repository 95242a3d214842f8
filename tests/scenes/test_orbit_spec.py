"""Orbits, attitudes and their errors in files: units, limits, and what is said of mistakes."""

import math

import pytest
from pydantic import TypeAdapter

from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec, UtcTime, parse_utc
from scenes.yaml.errors import InputError, Problem
from scenes.yaml.spec import Spec, validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml

PASSING = """
epoch: 2011-03-05T03:05:00Z
before: 5 min
after: 90 s
passing: {longitude: 116 deg, latitude: 40 deg, altitude: 500 km, direction: ascending, inclination: 97.4 deg}
"""
ELEMENTS = """
epoch: 2011-03-05T03:05Z
elements: {altitude: 500 km, eccentricity: 0.001, node_local_time: 10.5 h, perigee: 90 deg, argument: 140 deg}
"""
STATE = """
epoch: 2011-03-05T03:05:00.125Z
state: {position: [6878 km, 0 km, 1 m], velocity: [0 m/s, -960.5 m/s, 7.5 km/s]}
"""
ERRORS = """
gps: {interval: 1 s, noise: [1 m, 1 m, 2 m], drift: [10 cm, 0 m, 0 m], correlation_time: 30 min}
star_tracker:
  noise: [2 arcsec, 2 arcsec, 15 arcsec]
  bias: [10 arcsec, -0.1 deg, 0 arcsec]
  thermal: {amplitude: [1 arcsec, 2 arcsec, 0 arcsec], reference: 40 deg}
"""


def read(model: type[Spec], text: str) -> Spec:
    return validate(model, parse_yaml(text))


def test_values_are_si() -> None:
    spec = read(OrbitSpec, PASSING)
    assert (spec.epoch, spec.before, spec.after) == ("2011-03-05T03:05:00Z", 300.0, 90.0)
    assert spec.passing.longitude == pytest.approx(math.radians(116), rel=1e-15)
    assert (spec.passing.altitude, spec.passing.direction) == (500e3, "ascending")
    assert read(OrbitSpec, ELEMENTS).elements.node_local_time == 37800.0
    state = read(OrbitSpec, STATE).state
    assert (state.position, state.velocity) == ((6878e3, 0.0, 1.0), (0.0, -960.5, 7500.0))
    earth = read(EarthSpec, "{ut1_utc: -150 ms, polar_motion: [0.1 arcsec, -200 mas]}")
    assert earth.ut1_utc == -0.15
    assert earth.polar_motion == pytest.approx([math.radians(0.1 / 3600), -math.radians(0.2 / 3600)], rel=1e-15)
    errors = read(ErrorsSpec, ERRORS)
    assert (errors.gps.drift, errors.gps.correlation_time) == ((0.1, 0.0, 0.0), 1800.0)
    assert errors.star_tracker.bias[1] == pytest.approx(-math.radians(0.1), rel=1e-15)


def test_what_is_not_written() -> None:
    spec = read(OrbitSpec, "epoch: 2011-03-05T03:05:00Z\npassing: {longitude: 116 deg, latitude: 40 deg}")
    assert (spec.passing.direction, spec.passing.altitude, spec.passing.inclination) == ("descending", 500e3, None)
    assert read(AttitudeSpec, "{}") == AttitudeSpec(nadir="geodetic", steering="none")
    # nothing is wrong unless it is written
    zero = read(ErrorsSpec, "{}")
    assert not any((*zero.gps.noise, *zero.gps.drift, *zero.gps.velocity))
    assert not any((*zero.star_tracker.noise, *zero.star_tracker.bias, *zero.star_tracker.thermal.amplitude))
    assert (EarthSpec().ut1_utc, EarthSpec().polar_motion) == (0.0, (0.0, 0.0))


@pytest.mark.parametrize(
    ("model", "text"),
    [
        (OrbitSpec, PASSING),
        (OrbitSpec, ELEMENTS),
        (OrbitSpec, STATE),
        (ErrorsSpec, ERRORS),
        (AttitudeSpec, "{nadir: geocentric, steering: yaw, offset: [0.1 deg, 0 deg, -2 arcsec]}"),
        (EarthSpec, "{ut1_utc: -150 ms, polar_motion: [0.1 arcsec, -200 mas]}"),
    ],
)
def test_it_reads_back(model: type[Spec], text: str) -> None:
    spec = read(model, text)
    again = read(model, dump_yaml(spec.plain()))
    assert again == spec
    assert hash(again) == hash(spec)
    assert model.model_json_schema()["additionalProperties"] is False


def test_distances_are_written_in_kilometres() -> None:
    assert read(OrbitSpec, PASSING).plain()["passing"]["altitude"] == "500 km"


@pytest.mark.parametrize(
    ("model", "text", "old", "new", "words"),
    [
        (OrbitSpec, PASSING, "altitude: 500 km", "altitude: 500", ["passing.altitude", "without a unit", "500 km"]),
        (OrbitSpec, PASSING, "altitude: 500 km", "altitude: 500 m", ["passing.altitude", "at least 150 km"]),
        (OrbitSpec, PASSING, "latitude: 40 deg", "latitude: 91 deg", ["passing.latitude", "at most 90 deg"]),
        (OrbitSpec, PASSING, "ascending", "upward", ["passing.direction"]),
        (OrbitSpec, PASSING, "2011-03-05T03:05:00Z", "2011-03-05T03:05:00", ["epoch", "without its zone"]),
        (OrbitSpec, PASSING, "2011-03-05T03:05:00Z", "2011-02-30T03:05:00Z", ["epoch", "no such date"]),
        (OrbitSpec, PASSING, "5 min", "-5 min", ["before", "outside the limits"]),
        (OrbitSpec, PASSING, "passing:", "pasing:", ["pasing", "did you mean 'passing'"]),
        (OrbitSpec, ELEMENTS, "argument: 140 deg", "perige: 1 deg", ["elements.argument", "missing"]),
        (OrbitSpec, ELEMENTS, "perigee: 90 deg", "node: 90 deg", ["elements", "either node or node_local_time"]),
        (OrbitSpec, ELEMENTS, "node_local_time: 10.5 h, ", "", ["elements", "either node or node_local_time"]),
        (OrbitSpec, ELEMENTS, "0.001", "0.2", ["elements.eccentricity", "from 0 to 0.1"]),
        (OrbitSpec, ELEMENTS, "10.5 h", "25 h", ["elements.node_local_time", "24 h"]),
        (OrbitSpec, STATE, "0 m/s, -960", "0 m, -960", ["velocity", "is a unit of a length, not of a speed"]),
        (OrbitSpec, STATE, "[6878 km, 0 km, 1 m]", "[6878 km, 0 km]", ["position", "not a list of 3"]),
        (ErrorsSpec, ERRORS, "[1 m, 1 m, 2 m]", "[1 m, 1 m, -2 m]", ["gps.noise", "at least 0 m"]),
        (ErrorsSpec, ERRORS, "interval: 1 s", "interval: 0 s", ["gps.interval", "greater than zero"]),
        (ErrorsSpec, ERRORS, "amplitude: [1 arcsec", "amplitude: [1 m", ["thermal.amplitude", "unit of a length"]),
    ],
)
def test_mistakes(model: type[Spec], text: str, old: str, new: str, words: list[str]) -> None:
    assert text.count(old) == 1
    with pytest.raises(InputError) as caught:
        read(model, text.replace(old, new))
    for word in words:
        assert word in str(caught.value)


def test_an_orbit_is_given_once() -> None:
    with pytest.raises(InputError, match=r"the orbit is not given once; found none of them"):
        read(OrbitSpec, "epoch: 2011-03-05T03:05:00Z")
    both = ELEMENTS + "passing: {longitude: 116 deg, latitude: 40 deg}"
    with pytest.raises(InputError, match="passing and elements"):
        read(OrbitSpec, both)
    with pytest.raises(InputError, match="no length"):
        read(OrbitSpec, ELEMENTS + "before: 0 s\nafter: 0 s")


@pytest.mark.parametrize(
    ("found", "problem"),
    [
        (20110305, "not a date and time"),
        (None, "not a date and time"),
        ("5 March 2011", "not a date and time"),
        ("2011-03-05", "not a date and time"),
        ("2011-03-05T03:05:00+08:00", "not a date and time"),
        ("2011-03-05T03:05:00", "without its zone"),
        ("2016-12-31T23:59:60Z", "no such date or time"),
        ("2011-13-05T03:05:00Z", "no such date or time"),
        ("1960-03-05T03:05:00Z", "outside the years"),
        ("2100-03-05T03:05:00Z", "outside the years"),
    ],
)
def test_times_that_are_refused(found: object, problem: str) -> None:
    with pytest.raises(Problem, match=problem) as caught:
        parse_utc(found)
    assert "2011-03-05T03:05:00Z" in str(caught.value.allowed)


def test_times_that_are_read() -> None:
    for text in ("2011-03-05T03:05Z", "2011-03-05T03:05:00Z", " 2011-03-05T03:05:00.123456Z "):
        assert parse_utc(text) == text.strip()
    assert TypeAdapter(UtcTime).json_schema()["examples"] == ["2011-03-05T03:05:00Z"]
