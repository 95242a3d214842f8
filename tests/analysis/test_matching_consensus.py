"""Consensus of displacements that are made up: wrong ones out, right ones in at the stated rate."""

import numpy as np
import pytest
from scipy import stats

from analysis.matching.matches import consensus
from tests.analysis.refusals import refuses


def scene(seed, count, wrong, sigma=0.05, height=False):
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, 3000, (count, 2))
    row, column = ((place - 1500) / 1500).T
    level = rng.uniform(0, 800, count)
    shift = np.stack([8 + 3 * row - 2 * column * row, -5 + column + 2 * row**2], axis=1)
    shift[:, 0] += 0.004 * level if height else 0.0
    bad = rng.random(count) < wrong
    size = np.broadcast_to(sigma, count)[:, None]
    found = place + shift + size * rng.standard_normal((count, 2))
    found[bad] = place[bad] + rng.uniform(-40, 40, (bad.sum(), 2))
    return place, found, level, bad, shift


@pytest.mark.second
def test_covariances_weigh_and_scatter_is_what_they_lack():
    """Sigmas from 0.02 to 0.5 px: at the stated rate none of them is lost for being poor."""
    sigma = np.random.default_rng(1).uniform(0.02, 0.5, 2000)
    place, found, _, bad, _ = scene(2, 2000, 0.2, sigma)
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    result = consensus(place, found, covariance=covariance, false_alarm=0.01)
    # two normal errors of unit variance: Rayleigh's distribution
    assert result.limit == pytest.approx(stats.rayleigh.isf(0.01))
    lost = (~result.accepted & ~bad).sum()
    # a scatter estimated slightly above 0 lowers the rate a little
    low, high = stats.binom.ppf([1e-5, 1 - 1e-5], (~bad).sum(), 0.01)
    assert 0.5 * low <= lost <= high
    assert result.scatter < 0.02
    assert (result.accepted & bad).sum() <= 5
    # half of the variance is not stated: it is found
    honest = consensus(place, found, covariance=0.5 * covariance)
    assert honest.scatter > 0.03
    assert (~honest.accepted & ~bad).sum() < 0.02 * (~bad).sum()


def test_correlated_covariances_are_counted_with_their_sign():
    """Errors of 0.3 px along one diagonal and 0.03 px along the other: the distance is Mahalanobis's, of which right
    matches beyond the limit are lost at the stated rate. With the other sign they would lie ten times too far out."""
    rng = np.random.default_rng(8)
    place, exact, _, _, _ = scene(8, 1000, 0.0, 0.0)
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    spread = turn @ np.diag([0.3**2, 0.03**2]) @ turn.T
    assert spread[0, 1] > 0.04
    found = exact + rng.standard_normal((1000, 2)) @ np.linalg.cholesky(spread).T
    result = consensus(place, found, covariance=np.tile(spread, (1000, 1, 1)))
    assert (~result.accepted).sum() <= stats.binom.ppf(1 - 1e-5, 1000, 1.5e-3)
    rest = found - place - result.field(place)
    whole = spread + result.scatter**2 * np.eye(2)
    # the last fit moves after the last distances by less than it would take to change who is accepted
    by_hand = np.sqrt(np.einsum("ni,ij,nj->n", rest, np.linalg.inv(whole), rest))
    assert result.distance == pytest.approx(by_hand, rel=1e-6, abs=1e-6)
    assert result.scatter < 0.02


def test_five_that_agree_are_the_least():
    place = np.random.default_rng(10).uniform(0, 100, (5, 2))
    assert consensus(place, place + 3.0, degree=0).accepted.all()
    shift = np.where(np.arange(5) == 2, 30.0, 3.0)[:, None]
    four = consensus(place, place + shift, degree=0)
    assert not four.accepted.any()
    assert "no consensus: 4 of 5 matches agree" in four.text


def test_height_takes_parallax():
    place, found, level, bad, _ = scene(3, 300, 0.3, height=True)
    with_height = consensus(place, found, height=level)
    assert with_height.scatter == pytest.approx(0.05, rel=0.25)
    assert (~with_height.accepted & ~bad).sum() <= 4
    without = consensus(place, found)
    assert without.scatter > 0.3
    refuses(ValueError, "heights exactly if", with_height.field, place)


def test_nothing_agrees():
    rng = np.random.default_rng(4)
    place = rng.uniform(0, 1000, (200, 2))
    result = consensus(place, place + rng.uniform(-40, 40, (200, 2)))
    assert not result.accepted.any()
    assert "no consensus" in result.text


def test_missing_matches_take_no_part_and_bad_input_is_told():
    place, found, _, _, _ = scene(5, 100, 0.2)
    found[:10] = np.nan
    result = consensus(place, found, degree=1, largest_scatter=5.0)
    assert not result.accepted[:10].any()
    assert np.isnan(result.distance[:10]).all()
    refuses(ValueError, "5 usable matches do not carry 6 terms; need 12", consensus, place[10:15], found[10:15])
    refuses(ValueError, r"covariances \(100, 2, 2\)", consensus, place, found, covariance=np.zeros((100, 2)))
    refuses(ValueError, "degree of 0 to 3", consensus, place, found, degree=4)
    # an exact field leaves no scatter
    exact = consensus(place, place + 3.0)
    assert exact.accepted.all()
    assert exact.scatter < 1e-8
