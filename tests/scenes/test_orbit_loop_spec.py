"""Files of a monitor in a loop: units, defaults, and what is said of mistakes."""

import math
from pathlib import Path

import pytest

from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.setup import LoopSetup, resolve_loop
from tests.scenes.orbit_files import assert_told, write

ARCSEC = math.pi / 648000.0
SMALL = """
name: small
instrument: gf7_pair
readings: {every: 10 min, count: 3}
corrections:
  pointing:
    {camera: forward, quantity: d_alpha, mechanism: base/forward rotate y, gain: 0.8, step: 0.05 arcsec,
     range: 2.03 arcsec}
  roll: {camera: backward, quantity: d_beta, gain: 1}
  focus:
    {camera: forward, quantity: defocus, mechanism: forward/focal_plane shift z, gain: 0.5, delay: 1, dead_band: 2 um}
orbit: {epoch: 2021-06-21T02:40:00Z, before: 2 min, after: 22 min, passing: {longitude: 116 deg, latitude: 60 deg}}
ground: {points: 4, first: 3000, last: 29000}
seed: 2
"""


def test_example_and_its_config() -> None:
    setup = resolve_loop(SCENES / ORBIT / "loop.yaml")
    assert setup.pair == ("forward", "backward")
    assert setup.disturbances is not None
    assert "metering" in setup.disturbances.causes
    assert len(setup.test.readings.times) == 25


def test_units_and_defaults(tmp_path: Path) -> None:
    setup = resolve_loop(write(tmp_path, SMALL))
    test = setup.test
    assert setup.disturbances is not None
    assert setup.disturbances.name == "orbit"
    assert test.readings.times == (0.0, 600.0, 1200.0)
    pointing, roll, focus = (test.corrections[name] for name in ("pointing", "roll", "focus"))
    assert pointing.smallest == pytest.approx(0.05 * ARCSEC, rel=1e-12)
    # whole steps alone: 40 of them
    assert pointing.largest == pytest.approx(2.0 * ARCSEC, rel=1e-12)
    assert (roll.mechanism, roll.smallest, roll.largest, roll.band, roll.delay) == (None, None, None, 0.0, 0)
    assert focus.motion == ("forward/focal_plane", "shift", "z", "")
    assert focus.band == pytest.approx(2e-6, rel=1e-12)
    # a run's config.yaml gives the same again
    again = resolve_loop(write(tmp_path, setup.to_yaml()))
    assert isinstance(again, LoopSetup)
    assert again.to_yaml() == setup.to_yaml()


@pytest.mark.parametrize(
    "mistake",
    [
        ("camera: backward", "camera: upward", "corrections.roll.camera", ("no camera of the pair", "forward")),
        ("step: 0.05 arcsec", "step: 0.05 um", "corrections.pointing.step", ("angle",)),
        ("step: 0.05 arcsec", "step: 0 arcsec", "corrections.pointing.step", ("not greater than zero",)),
        ("range: 2.03 arcsec", "range: 0.03 arcsec", "corrections.pointing.range", ("less than one step",)),
        (
            "base/forward rotate y",
            "base/forward scale",
            "corrections.pointing.mechanism",
            ("no motion of a mechanism",),
        ),
        ("base/forward rotate y", "base/forward rotate", "corrections.pointing.mechanism", ("rotate x, rotate y",)),
        ("dead_band: 2 um", "dead_band: 2 arcsec", "corrections.focus.dead_band", ("length",)),
        ("mechanism: forward/focal_plane shift z, ", "", "corrections.focus.quantity", ("no processing corrects",)),
        (
            "quantity: d_beta, gain: 1",
            "quantity: d_beta, gain: 1, response: 2",
            "corrections.roll.response",
            ("does what",),
        ),
        ("gain: 0.8", "gain: -0.8", "corrections.pointing.gain", ("0",)),
        ("delay: 1", "delay: 1.5", "corrections.focus.delay", ()),
        ("quantity: d_beta", "quantity: d_delta", "corrections.roll.quantity", ("d_alpha", "defocus")),
        ("seed: 2", "images: {times: [7 min]}", "images.times", ("the time of a reading",)),
        ("seed: 2", "images: {times: [10 min], points: {tie: 0}}", "images.points", ("no points",)),
        ("count: 3", "count: 4", "readings", ("outside the orbit data",)),
    ],
)
def test_mistakes(tmp_path: Path, mistake) -> None:
    assert_told(resolve_loop, tmp_path, SMALL, mistake)


def test_something_has_to_move(tmp_path: Path) -> None:
    right = SMALL.replace("instrument: gf7_pair", "instrument: gf7_pair\ndisturbances: orbit")
    assert_told(
        resolve_loop,
        tmp_path,
        right,
        ("disturbances: orbit", "disturbances: none", "disturbances", ("nothing is stated to move",)),
    )
