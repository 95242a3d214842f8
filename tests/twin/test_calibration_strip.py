"""Passes of an in-orbit calibration adjusted on tie points before check points are intersected."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.stats import chi2

import twin.orbit.__main__ as command
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import EffectsSpec
from scenes.specs.orbit.flight import ThermalDriftSpec
from scenes.specs.orbit.setup import CalibrationSetup, resolve_calibration
from tests.twin.commands import invoke, refused
from tests.twin.strip_prediction import predicted
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.schemes import averaged
from twin.orbit.calibration.schemes import tested as at_checks
from twin.orbit.calibration.strip import adjusted_strip, calibrated_with_ties, field_with_ties
from twin.orbit.calibration.strip import tested_in_strip as in_strip

run = partial(invoke, command.app)
EXAMPLE = SCENES / ORBIT / "calibrate_strip.yaml"
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


def mean_squares(before: np.ndarray, after: np.ndarray, passes: int) -> np.ndarray:
    """(2, draws) mean squares of so many passes by covariances (n, n) before and after: what an adjustment takes out is
    independent of what it leaves."""
    rng, drawn = np.random.default_rng(9), 20000
    rows = []
    for covariance in (after, before - after):
        values, axes = np.linalg.eigh(covariance)
        half = axes * np.sqrt(np.maximum(values, 0.0))
        rows.append(rng.standard_normal((drawn * passes, len(half))) @ half.T)
    both = np.array([rows[0] + rows[1], rows[0]])
    return np.mean(both.reshape(2, drawn, -1) ** 2, axis=2)


@pytest.mark.slow
def test_slow_errors_are_taken_out_as_the_covariances_say() -> None:
    """Four passes with the true camera, 5 arcsec every 20 s, 200 ties; false alarm 1e-3 for each limit.

    Mean squares of heights before and after, and their ratio, lie within what draws with all covariances give. Points
    share the few slow errors of a pass, so that these limits are wide. Sharper is a look at the three shapes of height
    errors over the points that gain most (variances fall to a tenth, a quarter, a half): what is left of them and
    what was taken out are independent and each have their predicted variance. Nothing taken out is refused for certain.
    """
    squares, fits, expected = [], np.zeros(2), []
    for seed in range(4):
        campaign = fly_fields(setup_with(5.0), np.random.SeedSequence(seed))
        one = campaign.passes[0]
        strip = adjusted_strip(campaign, one, campaign.truth, one.bias)
        before = at_checks(campaign, one, campaign.truth, one.bias)
        after = in_strip(campaign, one, strip, campaign.truth, one.bias)
        squares.append((before.height_rms**2, after.height_rms**2))
        assert 1e-6 < strip.p_value < 1.0 - 1e-6
        law = predicted(campaign, one, None)
        expected.append((law.before[:, 2, :, 2], law.after[:, 2, :, 2]))
        gains, shapes = eigh(*expected[-1])
        left, taken = (after.error[:, 2] @ shapes, (before.error - after.error)[:, 2] @ shapes)
        fits += np.sum(left[-3:] ** 2), np.sum(taken[-3:] ** 2 / (gains[-3:] - 1.0))
        assert gains[-1] > 5.0
    for fit in fits:
        assert 5e-4 < chi2.sf(fit, 4 * 3) < 1.0 - 5e-4
    drawn, found = mean_squares(*expected[0], 4), np.mean(squares, axis=0)
    for value, row in ((found[0], drawn[0]), (found[1], drawn[1]), (found[1] / found[0], drawn[1] / drawn[0])):
        least, most = np.quantile(row, [5e-4, 1.0 - 5e-4])
        assert least < value < most
    # of the RMS; it changes with places of points by some thousandths
    ratio = np.sqrt(np.trace(expected[0][1]) / np.trace(expected[0][0]))
    assert ratio == pytest.approx(0.52, abs=0.01)


@pytest.mark.slow
def test_errors_with_ties_are_those_of_the_covariances() -> None:
    """Three passes, each by its own parameters; plan and height, two-sided false alarm 1e-3 each."""
    squares = []
    for seed in range(3):
        campaign = fly_fields(setup_with(2.0), np.random.SeedSequence(20 + seed))
        one = campaign.passes[0]
        cameras, bias = averaged(campaign, [calibrated_with_ties(campaign, one)], [one.name])
        found = in_strip(campaign, one, adjusted_strip(campaign, one, cameras, bias), cameras, bias)
        squares.append((found.plan_rms**2, found.height_rms**2))
    after = predicted(campaign, one, "ties").after
    count = len(after)
    plan, height = after[:, :2, :, :2].reshape(2 * count, -1), after[:, 2, :, 2]
    for value, covariance, axes in zip(np.mean(squares, axis=0), (plan, height), (2, 1), strict=True):
        law = axes * mean_squares(covariance, covariance, 3)[1]
        least, most = np.quantile(law, [5e-4, 1.0 - 5e-4])
        assert least < value < most


@pytest.mark.second
def test_command(tmp_path: Path) -> None:
    """One field, few ties, readings every 0.5 s."""
    text = EXAMPLE.read_text("utf-8")
    start = text.index("  Anhui:")
    text = text[:start] + text[text.index("schemes:") :]
    for old, new in (
        ("  - [Beijing, Anhui]\n", ""),
        ("ties: 300", "ties: 80"),
        ("interval: 0.125 s", "interval: 0.5 s"),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path, out = tmp_path / "small.yaml", tmp_path / "run"
    path.write_text(text, "utf-8")
    result = run("calibrate", path, "--out", out, "--json")
    assert result.exit_code == 0, result.stderr
    strips = json.loads((out / "calibration.json").read_text("utf-8"))["strips"]
    assert strips["ties"] == {"Beijing": 80}
    assert set(strips["schemes"]) == {"1", "2"}
    for scheme in strips["schemes"].values():
        assert set(scheme) == {"without_ties", "with_ties"}
    # one field: the scheme of its parameters and its own are the same
    assert strips["schemes"]["1"] == strips["schemes"]["2"]
    assert "Adjustment of the strips" in (out / "report.html").read_text("utf-8")


def test_ties_do_not_change_what_else_is_drawn() -> None:
    setup = setup_with(0.0)
    none = setup.model_copy(update={"test": setup.test.model_copy(update={"strip": None})})
    plain, tied = (fly_fields(s, np.random.SeedSequence(5)) for s in (none, setup))
    one = tied.passes[0]
    np.testing.assert_array_equal(plain.passes[0].control_images["backward"].line, one.control_images["backward"].line)
    assert not plain.passes[0].ties
    assert tied.noise.slow_attitude == 0.0
    field = field_with_ties(tied, one)
    assert field.control.sum() == setup.test.points.control
    assert len(field.ground) == setup.test.points.control + 200


BAD = {
    "few ties": ("ties: 300", "ties: 5", "strip.ties", ["too few tie points", "20 or more"]),
    "long strip": ("length: 360 km", "length: 990 km", "strip.length", ["tie points", "shorter strip"]),
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
