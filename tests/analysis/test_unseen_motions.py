"""What no spot shows of stated motions, against a null space of the spots that is worked out here."""

import numpy as np
import pytest
from scipy.linalg import null_space

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.model_fit import error_floor, unobservable_modes
from tests.analysis.stated_motions import correlation_of, disturbances

MOTIONS, SPOTS, PARAMETERS = 14, 4, 3
SWING, DRIFT = TimeLaw(period_s=5000.0, drift_s=50_000.0), TimeLaw(drift_s=900.0)


def stated(seed: int, laws: tuple[TimeLaw, ...] = (SWING,) * MOTIONS, correlated: bool = True) -> Disturbances:
    rng = np.random.default_rng(seed)
    labels = [f"body{k // 2} shift {'xy'[k % 2]}" for k in range(MOTIONS)]
    see, tell = (rng.standard_normal((n, MOTIONS)) for n in (SPOTS, PARAMETERS))
    return disturbances(laws, see, tell, labels, correlation_of(rng, laws) if correlated else None)


def hidden(one: Disturbances, rows: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Covariance by motions of one law that lie in the null space N of the spots: R N N' R' with C = R R', independent
    numbers x of unit variance, spots A R x, and N of A R. No inverse of a covariance enters.
    """
    root = np.linalg.cholesky(one.correlation[np.ix_(own, own)])
    space = null_space(one.spots[:, own] @ root)
    does = rows @ one.parameters[:, own] @ root @ space
    return does @ does.T


@pytest.mark.parametrize("seed", [1, 2])
def test_the_floor_is_what_the_null_space_of_the_spots_does(seed: int) -> None:
    rows = np.random.default_rng(seed + 10).standard_normal((2, PARAMETERS))
    one = stated(seed)
    np.testing.assert_allclose(error_floor(one, rows), hidden(one, rows, np.arange(MOTIONS)), rtol=1e-9, atol=1e-12)
    two = stated(seed, (SWING,) * 8 + (DRIFT,) * 6)
    parts = hidden(two, rows, np.arange(8)) + hidden(two, rows, np.arange(8, MOTIONS))
    np.testing.assert_allclose(error_floor(two, rows), parts, rtol=1e-9, atol=1e-12)


def test_modes_move_quantities_and_no_spot() -> None:
    one, rows = stated(3), np.eye(PARAMETERS)
    scale = np.array([1.0, 2.0, 0.5])
    modes = unobservable_modes(one, rows, scale)
    assert len(modes) == PARAMETERS
    for mode in modes:
        assert np.abs(one.spots @ mode.motions).max() < 1e-9
        assert mode.spots < 1e-9
        np.testing.assert_allclose(one.parameters @ mode.motions, mode.quantities, rtol=1e-9)
        assert np.linalg.norm(mode.quantities / scale) == pytest.approx(mode.sigma, rel=1e-9)
        assert sum(mode.bodies.values()) == pytest.approx(1.0, rel=1e-9)
    # together they are the floor
    whole = sum(np.outer(mode.quantities, mode.quantities) for mode in modes)
    np.testing.assert_allclose(whole, error_floor(one, rows), rtol=1e-8, atol=1e-12)
    assert [mode.sigma for mode in modes] == sorted((mode.sigma for mode in modes), reverse=True)
