"""Passes of an in-orbit calibration adjusted on tie points before check points are intersected."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import twin.orbit.__main__ as command
from optics.frozen_map import FrozenMap
from scenes.load import LIBRARY, ORBIT
from scenes.orbit_angle import EffectsSpec
from scenes.orbit_setup import CalibrationSetup, resolve_calibration
from scenes.orbit_spec import ThermalDriftSpec
from tests.twin.commands import invoke, refused
from twin.orbit.calibration.campaign import fly_fields
from twin.orbit.calibration.schemes import tested as at_checks
from twin.orbit.calibration.strip import adjusted_strip, field_with_ties
from twin.orbit.calibration.strip import tested_in_strip as in_strip

run = partial(invoke, command.app)
EXAMPLE = LIBRARY / ORBIT / "calibrate_strip.yaml"
WHOLE = resolve_calibration(EXAMPLE)
ARCSEC = np.pi / 648000


def setup_with(slow: float) -> CalibrationSetup:
    """One field, no effects on the light and no drift with latitude; slow errors of so many arcseconds.

    Readings every 0.5 s are a quarter of the example's unknowns.
    """
    test = WHOLE.test
    tracker = test.errors.star_tracker
    update = {
        "interval": 0.5,
        "thermal": ThermalDriftSpec(),
        "slow": tracker.slow.model_copy(update={"noise": (slow * ARCSEC,) * 3}),
    }
    errors = test.errors.model_copy(update={"star_tracker": tracker.model_copy(update=update)})
    none = EffectsSpec(light_time=False, aberration=False, refraction=False)
    changes = {"fields": FrozenMap({"Beijing": test.fields["Beijing"]}), "schemes": (("Beijing",),), "effects": none}
    changes |= {"errors": errors, "strip": test.strip.model_copy(update={"ties": 200})}
    return WHOLE.model_copy(update={"test": test.model_copy(update=changes)})


def test_slow_errors_are_taken_out() -> None:
    """Four passes with the true camera, 5 arcsec every 20 s. The covariances predict 0.45 of the height RMS with 500
    ties, of four independent passes each mean square is known to 70%: less than all of it has a chance above 0.99."""
    squares = []
    for seed in range(4):
        campaign = fly_fields(setup_with(5.0), np.random.SeedSequence(seed))
        one = campaign.passes[0]
        strip = adjusted_strip(campaign, one, campaign.truth, one.bias)
        before = at_checks(campaign, one, campaign.truth, one.bias)
        after = in_strip(campaign, one, strip, campaign.truth, one.bias)
        squares.append((before.height_rms**2, after.height_rms**2))
        assert 1e-6 < strip.p_value < 1.0 - 1e-6
    before, after = np.sqrt(np.mean(squares, axis=0))
    assert after < 0.75 * before


def test_ties_do_not_change_what_else_is_drawn() -> None:
    setup = setup_with(0.0)
    none = setup.model_copy(update={"test": setup.test.model_copy(update={"strip": None})})
    plain, tied = (fly_fields(s, np.random.SeedSequence(5)) for s in (none, setup))
    one = tied.passes[0]
    np.testing.assert_array_equal(plain.passes[0].control_images["aft"].line, one.control_images["aft"].line)
    assert not plain.passes[0].ties
    assert tied.noise.slow_attitude == 0.0
    field = field_with_ties(tied, one)
    assert field.control.sum() == setup.test.points.control
    assert len(field.ground) == setup.test.points.control + 200


BAD = {
    "few ties": ("ties: 300", "ties: 5", "strip.ties", ["too few tie points", "20 or more"]),
    "long strip": ("length: 360 km", "length: 990 km", "span", ["shorter than the field"]),
    "exact": ("image: 0.3", "image: 0.3\n  switched_on: false", "strip", ["nothing to adjust"]),
    "interval": ("interval: 20 s", "interval: 0 s", "errors.star_tracker.slow.interval", ["greater than zero"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, tmp_path: Path) -> None:
    old, new, key, words = BAD[case]
    text = EXAMPLE.read_text("utf-8")
    assert text.count(old) == 1, old
    path = tmp_path / "small.yaml"
    path.write_text(text.replace(old, new), "utf-8")
    refused(run, "calibrate", path, key, words)
