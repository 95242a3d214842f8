"""Files of a monitored orbit: units, defaults, the way to the instrument, and what is said of mistakes."""

import math
from pathlib import Path

import pytest

from scenes.schema import json_schema
from scenes.specs.load import LIBRARY, ORBIT, SCENES, load_instrument
from scenes.specs.orbit.monitor import MotionSpec
from scenes.specs.orbit.setup import MonitorSetup, resolve_monitor
from scenes.yaml.errors import InputError
from tests.scenes.orbit_files import assert_told, write

EXAMPLE = SCENES / ORBIT / "monitor.yaml"
SMALL = """
name: small
instrument: gf7_pair
reference: 5 min
interval: 10 min
course:
  times: [0 min, 5 min, 10 min, 15 min, 20 min]
  temperature:
    base/forward: {change: [0 K, 0.1 K, 0.2 K, 0.1 K, 0 K]}
motion:
  base/backward: {rotate: [0 arcsec, 1 arcsec, 0 arcsec], begin: 5 min, duration: 10 min}
orbit:
  epoch: 2021-06-21T02:40:00Z
  before: 2 min
  after: 22 min
  passing: {longitude: 116 deg, latitude: 60 deg}
ground: {points: 4, first: 3000, last: 29000}
"""


def test_example() -> None:
    setup = resolve_monitor(EXAMPLE)
    assert setup.instrument == load_instrument("gf7_pair")
    assert setup.pair == ("forward", "backward")
    test = setup.test
    assert (test.interval, test.step, test.referred) == (600.0, 300.0, 0)
    assert test.motion["base/forward"].rotate[1] == pytest.approx(math.radians(1.2 / 3600.0), rel=1e-15)


def test_what_is_not_written(tmp_path: Path) -> None:
    test = resolve_monitor(write(tmp_path, SMALL)).test
    assert test.apply == ("d_alpha", "d_beta", "d_gamma", "d_f")
    assert test.compared == (300.0, 600.0, 1200.0)
    assert test.errors.gps.noise == (0.0, 0.0, 0.0)
    assert (test.errors.star_tracker.bias, test.errors.image) == ((0.0, 0.0, 0.0), 0.3)


def test_measurements_count_from_the_reference_to_both_sides(tmp_path: Path) -> None:
    test = resolve_monitor(write(tmp_path, SMALL)).test
    assert test.measured(600.0) == [1, 3]
    assert test.measured(300.0) == [0, 1, 2, 3, 4]
    assert test.measured(1200.0) == [1]


def test_a_motion_is_a_step_a_ramp_or_a_swing() -> None:
    turn = (0.0, 1e-6, 0.0)
    step = MotionSpec.model_construct(rotate=turn, begin=10.0, duration=0.0, period=None)
    assert [step.share(t) for t in (9.9, 10.0, 1e4)] == [0.0, 1.0, 1.0]
    ramp = MotionSpec.model_construct(rotate=turn, begin=10.0, duration=20.0, period=None)
    assert [ramp.share(t) for t in (0.0, 15.0, 40.0)] == [0.0, 0.25, 1.0]
    swing = MotionSpec.model_construct(rotate=turn, begin=10.0, duration=0.0, period=40.0)
    assert [swing.share(t) for t in (10.0, 20.0, 40.0)] == pytest.approx([0.0, 1.0, -1.0])


def test_config_reads_back_to_the_same_values(tmp_path: Path) -> None:
    setup = resolve_monitor(EXAMPLE).with_seed(7)
    again = resolve_monitor(write(tmp_path, setup.to_yaml()))
    assert isinstance(again, MonitorSetup)
    assert again == setup
    assert again.test.seed == 7
    assert again.to_yaml() == setup.to_yaml()


# change of the small file, key that is named, what is said
BAD = {
    "interval": ("interval: 10 min", "interval: 25 min", "interval", ["longer than the course", "at most 20 min"]),
    "no multiple": ("interval: 10 min", "interval: 7 min", "interval", ["no multiple", "did you mean '5 min'"]),
    "intervals": ("interval: 10 min", "interval: 10 min\nintervals: [5 min, 12 min]", "intervals", ["no multiple"]),
    "outside": ("after: 22 min", "after: 18 min", "course.times", ["outside the orbit data", "20 min", "longer orbit"]),
    "before": ("reference: 5 min", "reference: 6 min", "reference", ["not one of", "did you mean '5 min'"]),
    "uneven": ("10 min, 15 min, 20 min]", "10 min, 16 min, 20 min]", "course.times", ["not evenly spaced"]),
    "unknown camera": (
        "interval: 10",
        "cameras: [forward, nadir]\ninterval: 10",
        "cameras",
        ["no camera with a monitor", "nadir", "forward, backward, which have monitors"],
    ),
    "one camera": ("interval: 10", "cameras: [forward]\ninterval: 10", "cameras", ["not a pair", "two different"]),
    "twice": ("interval: 10", "cameras: [forward, forward]\ninterval: 10", "cameras", ["not a pair"]),
    "instrument": ("instrument: gf7_pair", "instrument: gf7_par", "instrument", ["did you mean 'gf7_pair'"]),
    "nothing moves": ("rotate: [0 arcsec, 1 arcsec, 0 arcsec], ", "", "motion.base/backward", ["nothing moves"]),
    "two motions": ("duration: 10 min", "duration: 10 min, period: 1 h", "motion.base/backward", ["either duration"]),
    "pixel": ("last: 29000", "last: 32768", "ground.last", ["outside the line", "32767.5"]),
    "apply": ("interval: 10", "apply: []\ninterval: 10", "apply", ["at least one of d_alpha"]),
    "no temperatures": (
        "change: [0 K, 0.1 K, 0.2 K, 0.1 K, 0 K]",
        "change: [0 K]",
        "course.temperature.base/forward.change",
        ["not one entry"],
    ),
    "unknown key": ("interval: 10", "intervall: 10", "intervall", ["did you mean 'interval'"]),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_are_told(case: str, tmp_path: Path) -> None:
    assert_told(resolve_monitor, tmp_path, SMALL, BAD[case])


def test_an_instrument_of_one_camera(tmp_path: Path) -> None:
    text = (LIBRARY / "instruments" / "gf7_pair.yaml").read_text("utf-8")
    kept = [row for row in text.splitlines() if not row.lstrip().startswith("backward")]
    (tmp_path / "own.yaml").write_text("\n".join(kept), "utf-8")
    path = write(tmp_path, SMALL.replace("gf7_pair", "own.yaml"))
    with pytest.raises(InputError, match=r"no stereo pair.*forward in gf7_pair.*two cameras"):
        resolve_monitor(path)


def test_schema_for_editors() -> None:
    schema = json_schema("orbit_monitor")
    assert {"instrument", "course", "interval", "reference", "orbit", "ground"} <= set(schema["required"])
