"""Circles and intervals that hold a share of errors, against closed forms and draws."""

import numpy as np
import pytest

from analysis.orbit.forward_intersection import (
    circle_of_points,
    circular_error,
    interval_of_points,
    linear_error,
    predicted,
    realised,
)
from tests.analysis.refusals import refuses


def test_closed_forms() -> None:
    """Rayleigh's distribution for a round covariance, the normal one along a line."""
    for share in (0.5, 0.9, 0.95, 0.99):
        assert circular_error(4.0 * np.eye(2), share) == pytest.approx(2.0 * np.sqrt(-2.0 * np.log1p(-share)), rel=1e-9)
        line = linear_error(9.0, share)
        assert circular_error(np.diag([9.0, 0.0]), share) == pytest.approx(line, rel=1e-7)
    assert linear_error(1.0) == pytest.approx(1.6448536, rel=1e-7)
    assert circular_error(np.zeros((2, 2))) == 0.0


@pytest.mark.parametrize("ratio", [0.03, 0.2, 0.6])
def test_turned_ellipses_hold_their_share_of_draws(ratio: float) -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = turn @ np.diag([2.5, 2.5 * ratio]) ** 2 @ turn.T
    radius = circular_error(np.stack([covariance, 0.25 * covariance]))
    assert radius[1] == pytest.approx(0.5 * radius[0], rel=1e-12)
    draws = np.random.default_rng(2).standard_normal((400_000, 2)) @ np.linalg.cholesky(covariance).T
    # 400 000 draws: the share has a sigma of 5e-4
    assert np.mean(np.hypot(*draws.T) < radius[0]) == pytest.approx(0.9, abs=2e-3)


def test_a_set_of_points_holds_its_share_of_draws() -> None:
    spread = np.stack([np.diag([9.0, 0.0]), np.eye(2)])
    radius = circle_of_points(spread)
    sigma = np.array([[3.0, 0.0], [1.0, 1.0]])
    draws = np.random.default_rng(3).standard_normal((2, 200_000, 2)) * sigma[:, None]
    # 400 000 draws: the share has a sigma of 5e-4
    assert np.mean(np.hypot(draws[..., 0], draws[..., 1]) < radius) == pytest.approx(0.9, abs=2e-3)
    assert circle_of_points(np.stack([spread[0]] * 3)) == pytest.approx(float(circular_error(spread[0])), rel=1e-9)


def test_what_is_no_covariance_or_share() -> None:
    refuses(ValueError, "negative", circular_error, np.diag([1.0, -1.0]))
    for share in (0.0, 1.0, 90.0):
        refuses(ValueError, "share", circular_error, np.eye(2), share)


def test_shares_of_errors_are_those_of_their_prediction() -> None:
    """Errors at the pole of x, where up is x and east is y: shares of draws against the prediction."""
    assert interval_of_points(np.array([9.0])) == pytest.approx(3 * 1.644854, rel=1e-5)
    error = np.random.default_rng(1).standard_normal((40_000, 3)) * [2.0, 1.0, 3.0]
    place = np.tile([6378137.0, 0.0, 0.0], (len(error), 1))
    found, said = realised(place, error), predicted(place[:1], np.diag([4.0, 1.0, 9.0])[None])
    assert (found.ce90, found.le90) == pytest.approx((said.ce90, said.le90), rel=0.02)
