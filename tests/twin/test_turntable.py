"""The simulated turntable test: signs, the class of the paper's figures, held-out angles, sigmas, the contract, and
inputs that cannot be used.

Chi-square tests have a false-alarm rate of 1e-4 each, two-sided; seeds are fixed, so that they pass or fail for good.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.turntable.dividing_error import choose, compensate
from scenes.specs.load import EXAMPLES, LAB, load_named
from scenes.specs.turntable import DividingErrorSpec, TurntableTestSpec
from scenes.yaml.errors import InputError
from twin.laboratory.turntable_bench import DividingError, TurntableModel
from twin.laboratory.turntable_run import run_turntable

ARCSEC = math.pi / 648000
FALSE_ALARM = 1e-4
SPEC = load_named(TurntableTestSpec, LAB, "turntable")
FILE = EXAMPLES.parent / "lab" / "turntable.yaml"


def with_plan(**changes: object) -> TurntableTestSpec:
    return SPEC.model_copy(update={"calibration": SPEC.calibration.model_copy(update=changes)})


def test_sign_and_inverse() -> None:
    model = TurntableModel(SPEC, 2)
    reading = np.radians(np.linspace(92.0, 112.0, 501))
    np.testing.assert_allclose(reading - model.stand(reading), model.error(reading), rtol=0.0, atol=1e-15)
    # rounding of angles of 2 rad, and of their 144 000-fold in the subdivision error
    np.testing.assert_allclose(model.read(model.stand(reading)), reading, rtol=0.0, atol=2e-15)
    series = model.calibrate()
    # the mean of comparisons is reading - true angle, to its noise and the reference's: 5 sigma
    assert np.max(np.abs(series.mean - model.error(series.angle))) < 5.0 * np.max(series.sigma)
    assert np.std(model.error(series.angle)) > 5.0 * np.max(series.sigma)
    scatter = model.stand(np.full(4000, 1.7), np.random.default_rng(1)) - model.stand(1.7)
    # 4000 values: 1.1%, 4 sigma
    assert np.std(scatter) == pytest.approx(SPEC.dividing_error.repeatability, rel=0.045)
    # the subdivision's slope enlarges it by some hundredths
    scatter = model.read(np.full(4000, 1.7), np.random.default_rng(2)) - model.read(1.7)
    assert np.std(scatter) == pytest.approx(SPEC.dividing_error.repeatability, rel=0.1)


def test_parts_have_the_sizes_of_the_file() -> None:
    """Mean squares of 200 tables over the expected ones; a part of n coefficients has 200 n degrees of freedom if all
    its harmonics are alike, and fewer if they are not.
    """
    spec = SPEC.dividing_error
    tables = [DividingError.draw(spec, seed) for seed in range(200)]
    expected = {
        "axis": (spec.axis, 4.0),
        "eccentricity": (spec.eccentricity, 2.0),
        "subdivision": (spec.subdivision.rms, 6.0),
        "graduation": (spec.graduation.rms, _freedom(spec)),
    }
    for name, (size, freedom) in expected.items():
        ratio = np.mean([table.parts[name].rms ** 2 for table in tables]) / size**2
        low, high = chi2.ppf([0.5 * FALSE_ALARM, 1.0 - 0.5 * FALSE_ALARM], 200.0 * freedom) / (200.0 * freedom)
        assert low < ratio < high, name


def _freedom(spec: DividingErrorSpec) -> float:
    """Satterthwaite's number for a sum of unequal squares."""
    g = spec.graduation
    variance = np.arange(g.first, g.last + 1.0) ** (-2.0 * g.slope)
    return float(2.0 * np.sum(variance) ** 2 / np.sum(variance**2))


def test_calibration_cannot_see_the_subdivision_error() -> None:
    """Every step is 50 periods: one value at all calibrated readings, all phases at the held-out ones."""
    model = TurntableModel(SPEC, 3)
    subdivision = model.error.parts["subdivision"]
    period = SPEC.dividing_error.subdivision.period
    reading = np.radians(np.linspace(92.0, 92.5, 333))
    np.testing.assert_allclose(subdivision(reading + period), subdivision(reading), rtol=0.0, atol=1e-9 * ARCSEC)
    assert np.ptp(subdivision(model.calibrate().angle)) < 1e-9 * ARCSEC
    assert np.std(subdivision(model.held_out().angle)) > 0.5 * subdivision.rms


@pytest.mark.second
def test_held_out_residuals_and_sigmas() -> None:
    """40 tables with two quick fits: below the paper's 0.2 arcsec at angles that no fit saw, and what is left after
    correction has the variance that is stated, over the whole region and as a slope over the camera's field.
    """
    everywhere = np.sort(np.random.default_rng(5).uniform(*np.radians([92.0, 112.0]), 150))
    field = SPEC.camera_angle + np.radians(np.linspace(-1.25, 1.25, 55))
    slope = field - field.mean()
    squares, ratio = 0.0, []
    for seed in range(40):
        model = TurntableModel(SPEC, seed)
        series, held = model.calibrate(), model.held_out()
        made = compensate(series, choose(series, names=("piecewise_linear", "cubic_spline")), held)
        assert np.sqrt(np.mean((held.mean - made.error(held.angle)) ** 2)) < 0.1 * ARCSEC
        left = made.error(field) - model.error(field)
        squares += (slope @ left) ** 2 / (slope @ made.covariance(field) @ slope)
        left = made.error(everywhere) - model.error(everywhere)
        ratio.append(np.mean(left**2) / np.mean(made.sigma(everywhere) ** 2))
    low, high = chi2.ppf([0.5 * FALSE_ALARM, 1.0 - 0.5 * FALSE_ALARM], 40)
    assert low < squares < high
    # each table has one constant of the subdivision's phase with half of the variance: 4 sigma of the mean of 40
    assert np.mean(ratio) == pytest.approx(1.0, abs=4.0 * np.std(ratio) / math.sqrt(40.0))


def test_without_errors_the_truth_comes_out() -> None:
    zero = SPEC.dividing_error.model_copy(
        update={
            "repeatability": 0.0,
            "subdivision": SPEC.dividing_error.subdivision.model_copy(update={"rms": 0.0}),
            # waves of 6 deg and longer, which the spline follows
            "graduation": SPEC.dividing_error.graduation.model_copy(update={"last": 60}),
        }
    )
    reference = SPEC.reference.model_copy(update={"calibration": 0.0, "noise": 0.0, "gross_probability": 0.0})
    spec = SPEC.model_copy(update={"dividing_error": zero, "reference": reference})
    done = run_turntable(spec, 1, names=("cubic_spline",))
    inside = slice(400, -400)
    left = done.fits["cubic_spline"](done.truth_readings) - done.true_error
    # fourth order of the step, 0.005 (2 pi 0.5 / 6)^4 of 0.5 arcsec, is 2e-4
    assert np.max(np.abs(left[inside])) < 1e-3 * ARCSEC


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("step: 0.5 deg", "step: 0.3 deg", "the region is no whole number of steps"),
        ("last: 112 deg", "last: 92 deg", "all angles would be the same"),
        ("last: 112 deg", "last: 90 deg", "before the first"),
        ("  repeats: 10                   # paper", "  repeats: 1", "one repeat only"),
        ("spread: 18 arcsec", "spread: 0.25 deg", "would reach the calibrated ones"),
        ("camera_angle: 102 deg", "camera_angle: 113 deg", "outside of the calibrated region"),
        ("last: 150", "last: 2", "last harmonic is below the first"),
        ("rms: 0.025 arcsec", "rms: 0.025", "without a unit"),
    ],
)
def test_bad_files(old: str, new: str, text: str, tmp_path: Path) -> None:
    source = FILE.read_text("utf-8")
    assert source.count(old) == 1
    path = tmp_path / "turntable.yaml"
    path.write_text(source.replace(old, new), "utf-8")
    with pytest.raises(InputError, match=text) as caught:
        load_named(TurntableTestSpec, LAB, path)
    assert caught.value.line


def test_too_few_angles_for_a_fit() -> None:
    coarse = with_plan(step=math.radians(4.0))
    with pytest.raises(InputError, match=r"too few angles for the fit 'network'.*6 angles, 5 of them"):
        run_turntable(coarse, 1)
    assert run_turntable(coarse, 1, names=("piecewise_linear",)).choice.chosen == "piecewise_linear"
