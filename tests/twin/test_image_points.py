"""Points measured in rendered images, against the exact sensor; the commands that use them."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import twin.orbit.__main__ as command
from analysis.orbit.three_line_model import BIAS
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.calibration import OrbitCalibrationSpec
from scenes.specs.orbit.scene import ImagePointsSpec
from scenes.specs.orbit.setup import resolve_calibration, resolve_simulate
from tests.tiers import quick
from tests.twin.commands import edited_copy, invoke, refused
from twin.orbit.calibration.calibration_run import true_values
from twin.orbit.calibration.campaign import Campaign
from twin.orbit.calibration.campaign_adjustment import simultaneous
from twin.orbit.calibration.field_images import FieldImages
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.screening import screened
from twin.orbit.images.image_points import MatchedPoints, map_points, tie_points
from twin.orbit.images.point_judgement import judged, true_ground
from twin.orbit.images.simulate_run import Simulation, run_simulation

run = partial(invoke, command.app)
SIMULATE, CALIBRATE = (SCENES / ORBIT / f"{name}.yaml" for name in ("simulate", "calibrate_images"))
POINTS = "points: {control: 200, check: 100, tie: 200, reach: 40, template: 31}"
SIZE = "lines: 1000, pixels: 1000}"


@pytest.fixture(scope="module")
def flown() -> Simulation:
    setup = resolve_simulate(SIMULATE)
    patch = setup.test.patch.model_copy(update={"lines": 320, "pixels": 320})
    update = {"patch": patch, "points": None, "oversampling": 2}
    return run_simulation(setup.model_copy(update={"test": setup.test.model_copy(update=update)}), None, 3)


@pytest.fixture(scope="module")
def control(flown: Simulation) -> MatchedPoints:
    return map_points(flown.patch, asked().model_copy(update={"control": 60, "check": 20, "tie": 40}))


def asked() -> ImagePointsSpec:
    points = resolve_simulate(SIMULATE).test.points
    assert points is not None
    return points


@pytest.mark.second
def test_map_points_are_where_the_sensor_has_them(flown: Simulation, control: MatchedPoints) -> None:
    """0.2 px: another season's light on a 5 m pixel; the predicted places are 10 to 35 px off. None of some 60 accepted
    may be wrong: 3 px are twenty sigmas."""
    for name, found in judged(flown.patch, control).items():
        assert found.accepted >= 15
        assert np.all(found.rms < 0.2)
        assert np.all(np.abs(found.mean) < 5.0 * 0.2 / np.sqrt(found.accepted))
        assert found.wrong_accepted == 0
        # sigmas of matching are up to 1.6 too small, for light and changes are not in them
        assert 0.3 < found.chi_square / found.degrees_of_freedom < 2.56
        line = control.lines[name]
        moved = np.linalg.norm((line.place - line.predicted)[line.accepted], axis=1)
        assert moved.min() > 5.0
    share = control.check.mean()
    assert share == pytest.approx(0.25, abs=0.05)


@pytest.mark.second
def test_true_ground_is_the_map_less_its_errors(flown: Simulation, control: MatchedPoints) -> None:
    """Plan: 0.6 and -0.4 m and five times 0.5 m; height: five times 2 m, and slopes of 0.5 under 3 m."""
    east, north, height = flown.patch.frame.local(true_ground(flown.patch, control))
    for moved, shift in ((control.east - east, 0.6), (control.north - north, -0.4)):
        assert np.abs(moved - shift).max() < 2.5
        assert np.abs(moved).max() > 0.0
    assert 0.0 < np.abs(control.height - height).max() < 12.0


@pytest.mark.second
def test_tie_points_are_five_times_better(flown: Simulation, control: MatchedPoints) -> None:
    """The same ground on the same day: 0.05 px."""
    spec = asked().model_copy(update={"tie": 40})
    ties = tie_points(flown.patch, spec, control)
    assert ties.source == "nadir"
    assert ties.in_all.sum() >= 15
    for found in judged(flown.patch, ties).values():
        assert np.all(found.rms < 0.05)
        assert found.wrong_accepted == 0
    # without control the heights are read 100 m off, so that the prediction is worse, and still within reach
    alone = tie_points(flown.patch, spec)
    assert alone.in_all.sum() >= 10


# what is wrong, key, what to do about it
BAD = {
    "small patch": (("lines: 1000, pixels: 1000}", "lines: 100, pixels: 100}"), "points", ["no room", "larger patch"]),
    "even": (("template: 31", "template: 30"), "points.template", ["odd"]),
    "none": ((POINTS, "points: {control: 0, check: 0, tie: 0}"), "points", ["no points"]),
    "few": ((POINTS, "points: {control: 3}"), "points", ["too few matches", "accepted"]),
}


@pytest.mark.second
@pytest.mark.parametrize("case", quick(1, BAD))
def test_bad_input(case: str, tmp_path: Path) -> None:
    change, key, words = BAD[case]
    changes = [change] if change[0] == SIZE else [change, (SIZE, "lines: 200, pixels: 200}")]
    refused(run, "simulate", edited_copy(SIMULATE, tmp_path, *changes), key, words)


def two_patches() -> OrbitCalibrationSpec:
    test = resolve_calibration(CALIBRATE).test
    assert test.images is not None
    places = tuple(test.images.patches[k] for k in (0, 4))
    points = test.images.points.model_copy(update={"control": 40, "check": 12, "tie": 12})
    images = test.images.model_copy(
        update={"patches": places, "lines": 300, "pixels": 300, "points": points, "oversampling": 2}
    )
    return test.model_copy(update={"images": images, "fields": type(test.fields)({"Beijing": test.fields["Beijing"]})})


def parameters_fit(campaign: Campaign) -> None:
    """Interior and biases against the truth, false alarm 1e-4."""
    found = simultaneous(campaign)
    names = [*campaign.inner, *(f"{p.name} {axis}" for p in campaign.passes for axis in BIAS)]
    chosen = [k for k, n in enumerate(found.names) if n in names and found.sigma[n] > 0.0]
    error = (found.values - true_values(campaign, found.names))[chosen]
    spread = found.covariance[np.ix_(chosen, chosen)]
    assert error @ np.linalg.solve(spread, error) < chi2.isf(1e-4, len(chosen))


@pytest.mark.second
def test_calibration_from_images() -> None:
    """Two patches of one field."""
    setup = resolve_calibration(CALIBRATE)
    campaign = fly_fields(setup.model_copy(update={"test": two_patches()}), np.random.SeedSequence(5))
    assert campaign.images is not None
    done = screened(campaign)
    parameters_fit(done)
    (one,) = done.images or ()
    assert isinstance(one, FieldImages)
    assert one.screening is not None
    assert one.screening.wrong_left == 0
    assert one.screening.right_lost <= 0.02 * one.screening.entered


def test_patches_outside_are_refused(tmp_path: Path) -> None:
    first = "{pixel: 700, track: -22 km}"
    for pixel, key, words in (
        (12700, "images.patches[0].pixel", "outside"),
        (60, "images.patches", "patch 1"),
    ):
        path = edited_copy(CALIBRATE, tmp_path, (first, f"{{pixel: {pixel}, track: -22 km}}"))
        refused(run, "calibrate", path, key, [words])
