"""Cameras that drift from field to field in an in-orbit calibration, with and without an on-board monitor."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.flight import ThermalDriftSpec
from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.calibration.campaign import line_model
from twin.orbit.calibration.campaign_adjustment import simultaneous
from twin.orbit.calibration.schemes import (
    FieldErrors,
    adjust_field_with_readings,
    adjust_with_readings,
    flown,
    height_per_arcsec,
    with_monitor,
)
from twin.orbit.calibration.schemes import tested as at_checks
from twin.orbit.flight.line_camera import drifted_payload

EXAMPLE = SCENES / ORBIT / "calibrate_monitor.yaml"
WHOLE = CalibrationSetup.read(EXAMPLE)
KEPT = ("Beijing", "Anhui", "Xinjiang")
SEED = np.random.SeedSequence(3)


def setup_with(exact: bool = False) -> CalibrationSetup:
    """Three fields of the example; exact: no noise, and no bias that changes from field to field or in a pass."""
    test = WHOLE.test
    update: dict[str, object] = {"fields": FrozenMap({k: test.fields[k] for k in KEPT}), "schemes": (KEPT[:1], KEPT)}
    if exact:
        tracker = test.errors.star_tracker.model_copy(update={"thermal": ThermalDriftSpec()})
        errors = {"switched_on": False, "season": (0.0, 0.0, 0.0), "star_tracker": tracker}
        update["errors"] = test.errors.model_copy(update=errors)
    return WHOLE.model_copy(update={"test": test.model_copy(update=update)})


def test_the_drifted_camera_is_the_one_of_the_analysis() -> None:
    """To rounding: 1e-15 of f and of a rotation's elements, 1e-9 of the drift."""
    drift = {"backward": np.array([30 * ARCSEC, -20 * ARCSEC, 50 * ARCSEC, 40e-6])}
    turned = line_model(drifted_payload(WHOLE.camera, drift), "backward")
    expected = line_model(WHOLE.camera, "backward").drifted(drift["backward"])
    np.testing.assert_allclose(turned.to_body, expected.axes, rtol=0, atol=1e-14)
    assert turned.interior[0] == pytest.approx(expected.principal_distance, abs=1e-15)


@pytest.mark.second
def test_exact_readings_return_everything() -> None:
    """Places of the sensor are solved to 1e-12 m; 1e-6 of the drift is 20 pm, and 1e-6 of 1 um is as good."""
    campaign = flown(setup_with(exact=True), 1.0, SEED)
    found = adjust_with_readings(campaign)
    for one in campaign.passes:
        assert np.abs(one.truth.drift["forward"]).max() > 0.1 * ARCSEC
        assert not np.any(one.truth.drift["nadir"])
        cameras = found.cameras_of(one.name)
        for line in LINES:
            np.testing.assert_allclose(
                cameras[line].drift[:3], one.truth.drift[line][:3], rtol=1e-6, atol=1e-6 * ARCSEC
            )
            np.testing.assert_allclose(cameras[line].drift[3], one.truth.drift[line][3], rtol=1e-6, atol=1e-11)
            np.testing.assert_allclose(cameras[line].interior, campaign.truth[line].interior, rtol=0, atol=1e-11)
        errors = at_checks(campaign, one, cameras, found.bias(one.name))
        assert max(errors.plan_rms, errors.height_rms) < 1e-4  # 1e-6 of 40 arcsec of bias, over 500 km
    assert with_monitor(campaign).schemes["1"].height_rms < 1e-3


@pytest.mark.second
def test_drift_without_a_monitor_shifts_heights_as_its_angle_says() -> None:
    """By hand, over a flat Earth: 1 arcsec of one outer line is H / sin(2 look) per radian, 3.2 m; the curved Earth
    takes 7% off. Heights of a field differ by its d_alpha, forward less backward, against the mean of all, to the same
    few per cent of metres per arcsec over latitudes, and d_beta, d_gamma and d_f act at the ends of the line."""
    setup = setup_with(exact=True)
    campaign = flown(setup, 1.0, SEED)
    metres = height_per_arcsec(flown(setup, 0.0, SEED))
    by_hand = setup.test.altitude / np.sin(np.radians(50.0)) * ARCSEC
    assert abs(metres) == pytest.approx(by_hand, rel=0.1)
    found = simultaneous(campaign)
    angle = np.array([(p.truth.drift["forward"] - p.truth.drift["backward"])[0] / ARCSEC for p in campaign.passes])
    height = [at_checks(campaign, p, found.cameras, found.bias(p.name)).error[:, 2].mean() for p in campaign.passes]
    # cameras that do not have the drift see the opposite of it
    assert np.array(height) == pytest.approx(-metres * (angle - angle.mean()), abs=0.05 * abs(metres) * np.ptp(angle))
    assert np.ptp(height) > 1.0


@pytest.mark.second
def test_a_constant_error_of_the_monitor_goes_into_the_interior() -> None:
    """1 arcsec of the forward line in all readings is 3.15 um of x, f times it, and no error of heights. In the reading
    of one tested pass alone it is that pass's error, metres per arcsec."""
    campaign = flown(setup_with(exact=True), 1.0, SEED)
    wrong = np.array([ARCSEC, 0.0, 0.0, 0.0])

    def off(one):
        return replace(one, readings=FrozenMap({**one.readings, "forward": one.readings["forward"] + wrong}))

    all_off = replace(campaign, passes=tuple(off(p) for p in campaign.passes))
    found = adjust_with_readings(all_off)
    moved = abs(found.value("forward x") - campaign.truth["forward"].interior[1])
    assert moved == pytest.approx(0.65 * ARCSEC, rel=0.01)
    assert with_monitor(all_off).together.height_rms < 0.02
    alone = adjust_field_with_readings(campaign, campaign.passes[0])
    last = off(campaign.passes[-1])
    cameras = {k: alone.cameras[k].drifted(last.readings[k]) for k in LINES}
    errors = at_checks(campaign, last, cameras, alone.bias(KEPT[0]))
    assert FieldErrors.pooled([errors]).height_rms == pytest.approx(abs(height_per_arcsec(campaign)), rel=0.05)
