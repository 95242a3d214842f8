"""Passes of an in-orbit calibration adjusted on tie points before check points are intersected."""

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.stats import chi2

from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import EffectsSpec
from scenes.specs.orbit.flight import ThermalDriftSpec
from scenes.specs.orbit.setup import CalibrationSetup
from tests.twin.strip_prediction import predicted
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.schemes import adjusted_strip
from twin.orbit.calibration.schemes import tested as at_checks
from twin.orbit.calibration.schemes import tested_in_strip as in_strip

EXAMPLE = SCENES / ORBIT / "calibrate_strip.yaml"
WHOLE = CalibrationSetup.read(EXAMPLE)
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


@pytest.mark.second
def test_slow_errors_are_taken_out_as_the_covariances_say() -> None:
    """Two passes with the true camera, 5 arcsec every 20 s, 200 ties; false alarm 1e-3 for each limit.

    Looked at are the three shapes of height errors over the points that gain most (variances fall to a tenth, a
    quarter, a half): what is left of them and what was taken out are independent and each have their predicted
    variance. Nothing taken out is refused for certain.
    """
    fits, passes = np.zeros(2), 2
    for seed in range(passes):
        campaign = fly_fields(setup_with(5.0), np.random.SeedSequence(seed))
        one = campaign.passes[0]
        strip = adjusted_strip(campaign, one, campaign.truth, one.bias)
        before = at_checks(campaign, one, campaign.truth, one.bias)
        after = in_strip(campaign, one, strip, campaign.truth, one.bias)
        assert 1e-6 < strip.p_value < 1.0 - 1e-6
        heights = [law[:, 2, :, 2] for law in predicted(campaign, one)]
        gains, shapes = eigh(*heights)
        left, taken = (after.error[:, 2] @ shapes, (before.error - after.error)[:, 2] @ shapes)
        fits += np.sum(left[-3:] ** 2), np.sum(taken[-3:] ** 2 / (gains[-3:] - 1.0))
        assert gains[-1] > 5.0
    for fit in fits:
        assert 5e-4 < chi2.sf(fit, passes * 3) < 1.0 - 5e-4
    # of the RMS; it changes with places of points by some thousandths
    assert np.sqrt(np.trace(heights[1]) / np.trace(heights[0])) == pytest.approx(0.52, abs=0.01)
