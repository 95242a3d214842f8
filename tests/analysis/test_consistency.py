"""The predictive chi-square: its limit at any false-alarm rate, what noise does to it; by which estimator is judged."""

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.monitor.disturbances import Disturbances, TimeLaw, consistency
from analysis.monitor.estimators import ESTIMATORS, applicable, preferred_estimator
from tests.analysis.refusals import refuses
from tests.analysis.stated_motions import disturbances

COUNT, MOTIONS = 8, 12


@pytest.fixture(scope="module")
def stated() -> Disturbances:
    rng = np.random.default_rng(11)
    names = [f"body{k // 3} shift {'xyz'[k % 3]}" for k in range(MOTIONS)]
    see, tell = rng.standard_normal((2, COUNT, MOTIONS))
    return disturbances((TimeLaw(),) * MOTIONS, see, 1e-6 * tell, names)


@pytest.mark.parametrize("rate", [1e-3, 1e-3 / 21, 0.05])
def test_the_limit_is_that_of_the_rate(stated, rate) -> None:
    noise = 1e-4 * np.eye(COUNT)
    found = consistency(np.zeros(COUNT), noise, stated, false_alarm=rate)
    assert chi2.sf(found.limit, found.degrees) == pytest.approx(rate, rel=1e-9)
    assert (found.false_alarm, found.agrees, found.sigma_noise) == (rate, True, 0.0)
    # just below and just beyond
    shift = stated.spots[:, 0]
    square = consistency(shift, noise, stated).chi_square
    for times, agrees in ((0.999, True), (1.001, False)):
        one = consistency(shift * np.sqrt(found.limit / square) * times, noise, stated, false_alarm=rate)
        assert one.agrees is agrees


@pytest.mark.second
def test_noise_moves_the_chi_square_by_what_is_said(stated) -> None:
    """Over draws of the noise on one shift; 4000 of them tell a scatter to 1.1 %, of which 5 sigma are allowed."""
    noise = np.diag(np.linspace(1e-4, 4e-4, COUNT))
    shift = stated.spots @ np.random.default_rng(2).standard_normal(MOTIONS)
    found = consistency(shift, noise, stated)
    draws = np.random.default_rng(5).standard_normal((4000, COUNT)) * np.sqrt(np.diag(noise))
    many = [consistency(shift + one, noise, stated) for one in draws]
    assert np.std([one.chi_square for one in many]) == pytest.approx(found.sigma_noise, rel=0.056)
    # the chance is curved, too: some per cent of 0.02 around it
    assert np.std([one.p_value for one in many]) == pytest.approx(found.p_value_sigma_noise, rel=0.1)


def test_judged_is_the_best_that_stands_in_the_results(stated) -> None:
    assert preferred_estimator(applicable({}, stated)) == "posterior"
    assert preferred_estimator(applicable({}, None)) == "model"
    assert preferred_estimator(reversed(list(ESTIMATORS))) == "posterior"
    refuses(ValueError, "results without posterior or model: there are derived", preferred_estimator, ["derived"])
