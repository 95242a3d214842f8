"""Laws of time as covariances of two times: positive semidefinite whatever the times, those of stationary motions as
their correlations, and steps, trends and relaxations as what they stand for.
"""

import math

import numpy as np
import pytest

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.limits import calibrated_sigma
from analysis.monitor.series_smoother import smooth_series
from tests.analysis.stated_motions import SpotNoise, disturbances

STATIONARY = (
    TimeLaw(white=True),
    TimeLaw(),
    TimeLaw(drift_s=50.0),
    TimeLaw(period_s=90.0),
    TimeLaw(drift_s=200.0, period_s=70.0),
)
TREND = TimeLaw(trend_s=80.0, since_s=10.0)
RELAXATION, EVENT = TimeLaw(relaxation_s=25.0, since_s=20.0), TimeLaw(event=((30.0, 1.0),))


def stated(laws, seed: int = 0, spots: int = 3) -> Disturbances:
    """A motion for each law, seen by all spots."""
    rng = np.random.default_rng(seed)
    return disturbances(laws, rng.standard_normal((spots, len(laws))), rng.standard_normal((4, len(laws))))


def test_stationary_laws_are_their_correlations_over_the_gap() -> None:
    gap = np.array([0.0, 7.0, 45.0, 90.0])
    damped = np.exp(-gap / 200.0) * np.cos(2.0 * np.pi * gap / 70.0)
    for law, kept in zip(
        STATIONARY, (gap == 0.0, 1.0 + 0.0 * gap, np.exp(-gap / 50.0), np.cos(gap * np.pi / 45.0), damped), strict=True
    ):
        np.testing.assert_allclose(law.covariance(25.0 + gap, 25.0), kept, rtol=0, atol=1e-15)
        for away, one in zip(gap, kept, strict=True):
            assert stated([law]).between(25.0, 25.0 + away).sigmas == pytest.approx(np.sqrt(2.0 * (1.0 - one)))


@pytest.mark.parametrize(
    ("law", "shape"),
    [
        (TREND, lambda t: (t - 10.0) / 80.0),
        (RELAXATION, lambda t: np.where(t > 20.0, 1.0 - np.exp(-(t - 20.0) / 25.0), 0.0)),
        (EVENT, lambda t: np.where(t >= 30.0, 1.0, 0.0)),
    ],
)
@pytest.mark.parametrize("reference", [None, 40.0])
def test_a_shape_of_unknown_size_is_the_fit_of_its_size(law: TimeLaw, shape, reference: float | None) -> None:
    """Its size by regularised least squares, and the parameters by it, at all times."""
    rng = np.random.default_rng(4)
    one = stated((law,))
    measured, times = np.linspace(0.0, 100.0, 26), np.linspace(-10.0, 150.0, 33)
    zero = 0.0 if reference is None else shape(np.array(reference))
    rows = np.kron((shape(measured) - zero)[:, None], one.spots)
    shifts = rows[:, 0] * 1.3 + 0.1 * rng.standard_normal(len(rows))
    found = smooth_series(one, measured, shifts.reshape(26, 3), SpotNoise(0.01 * np.eye(3)), times, reference)
    variance = 1.0 / (float(rows[:, 0] @ rows[:, 0]) / 0.01 + 1.0)
    size = variance * float(rows[:, 0] @ shifts) / 0.01
    along = (shape(times) - zero)[:, None] * one.parameters[:, 0]
    assert found.smoothed.values == pytest.approx(along * size, abs=1e-9)
    sigma = np.sqrt(np.diagonal(found.smoothed.total, 0, 1, 2))
    assert sigma == pytest.approx(np.abs(along) * math.sqrt(variance), abs=1e-7)
    assert size == pytest.approx(1.3, abs=5.0 * math.sqrt(variance))


def test_a_step_at_an_unsure_moment_is_widened_between_the_readings() -> None:
    """Half-way through the gap it has come with a chance of one half: variance 1/4 of its size squared, and the mean of
    both sides; outside the gap nothing is widened."""
    one = stated((TimeLaw(event=((40.0, 0.0), (60.0, 1.0))),))
    measured = np.array([20.0, 40.0, 60.0, 80.0])
    shifts = np.outer([0.0, 0.0, 1.0, 1.0], one.spots[:, 0])
    found = smooth_series(one, measured, shifts, SpotNoise(1e-8 * np.eye(3)), [30.0, 45.0, 50.0, 70.0])
    share = found.smoothed.values[:, 0] / one.parameters[0, 0]
    spread = found.smoothed.total[:, 0, 0] / one.parameters[0, 0] ** 2
    assert share == pytest.approx([0.0, 0.25, 0.5, 1.0], abs=1e-6)
    assert spread == pytest.approx([0.0, 0.1875, 0.25, 0.0], abs=1e-6)


def test_a_calibration_knows_what_has_not_begun() -> None:
    """What a test field gave is spoiled by an event after it, and by a jump; not by an event before it."""
    field, noise, rows = 1e-12 * np.eye(4), 1e8 * np.eye(3), np.eye(4)[:1]
    size = {}
    for name, law in {
        "before": TimeLaw(event=((-5.0, 1.0),)),
        "after": TimeLaw(event=((5.0, 1.0),)),
        "jump": TimeLaw(jump=True),
        "trend": TimeLaw(trend_s=100.0),
    }.items():
        one = stated((law,))
        size[name] = float(calibrated_sigma(rows, one, noise, field, 10.0)[0] / abs(one.parameters[0, 0]))
    assert size == pytest.approx({"before": 0.0, "after": 1.0, "jump": 1.0, "trend": 0.1}, abs=1e-4)
