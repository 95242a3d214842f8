"""Consensus of displacements that are made up: wrong ones out, right ones in at the stated rate.

Search, verdicts and consensus: right matches found far off, wrong ones recognised, reasons given.
"""

import numpy as np
import pytest
from scipy import stats

from analysis.matching.correlation import MatchOptions, Reason, _second, distinct_points, search
from analysis.matching.matches import Matches, consensus, match_windows
from tests.analysis.refusals import refuses
from tests.analysis.texture_image import Texture, detected


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
    refuses(ValueError, "heights if, and only if", with_height.field, place)


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
    refuses(ValueError, "5 usable matches are too few for 6 terms; need 12", consensus, place[10:15], found[10:15])
    refuses(ValueError, r"covariances \(100, 2, 2\)", consensus, place, found, covariance=np.zeros((100, 2)))
    refuses(ValueError, "degree of 0 to 3", consensus, place, found, degree=4)
    # an exact field leaves no scatter
    exact = consensus(place, place + 3.0)
    assert exact.accepted.all()
    assert exact.scatter < 1e-8


# --- matching matches -------------------------------------------------------------------------------------------------

SIZE = 800


@pytest.fixture(scope="module")
def texture():
    return Texture(1)


@pytest.fixture(scope="module")
def frame(texture):
    return detected(texture.grid(np.arange(SIZE), np.arange(SIZE)), 1)


@pytest.fixture(scope="module")
def points(frame):
    return distinct_points(frame, 500, spacing=12, border=60)


def test_reasons(texture):
    """Each in its own corner of one image; no exception."""
    image = detected(texture.grid(np.arange(400), np.arange(400)), 5)
    flat = np.random.default_rng(6)
    image[200:300, 0:100] = flat.poisson(800, (100, 100))
    image[200:300, 100:200] = 777
    image[0:100, 200:300] = np.minimum(image[0:100, 200:300].astype(int) + 64700, 65535)
    places = np.array(
        [[50, 50], [250, 50], [250, 150], [50, 250], [5, 50], [900, 50], [60, 60], [50, np.nan], [350, 350]], float
    )
    patches = texture.patches(np.nan_to_num(places, nan=50.0))
    patches[6, 3, 4] = np.nan
    patches[8] = 5.0
    found = match_windows(image, patches, places, search_radius=10)
    expected = [
        Reason.ACCEPTED,
        Reason.FLAT,
        Reason.FLAT,
        Reason.SATURATED,
        Reason.OUTSIDE,
        Reason.OUTSIDE,
        Reason.TEMPLATE,
    ]
    expected += [Reason.TEMPLATE, Reason.FLAT]
    # noise alone may also peak on the window's border, which little texture explains
    assert [Reason(int(r)) for r in found.reason] == expected
    assert found.texts[3] == "pixels of the image under the template are saturated"
    assert np.isnan(found.position[[4, 5, 6, 7, 8]]).all()
    # more than the reach away, and an image with missing pixels
    far = match_windows(image, texture.patches([[50.0, 50.0]]), [[50.0, 64.0]], search_radius=10)
    assert not far.accepted[0]
    holes = image.astype(float)
    holes[352, 352] = np.nan
    assert (
        match_windows(holes, texture.patches([[350.0, 350.0]]), [[350.0, 350.0]], search_radius=10).reason[0]
        == Reason.IMAGE
    )
    # at the image's side the window is cut, and the point is found all the same
    side = match_windows(image, texture.patches([[17.3, 150.4]]), [[20.0, 150.0]], search_radius=10)
    assert side.accepted[0]
    assert side.position[0] == pytest.approx([17.3, 150.4], abs=0.15)


def test_repeated_pattern_is_ambiguous_and_an_edge_is_uncertain():
    rows, columns = np.mgrid[:200.0, :200.0]
    periodic = 800 + 100 * np.sin(2 * np.pi * rows / 9) + 100 * np.sin(2 * np.pi * columns / 9)
    found = match_windows(detected(periodic, 1), periodic[None, 85:116, 85:116], [[100.0, 100.0]], search_radius=20)
    assert found.reason[0] == Reason.AMBIGUOUS
    edge = 800 + 200 * np.tanh((columns - 100.2) / 2)
    found = match_windows(detected(edge, 2), edge[None, 85:116, 85:116], [[100.0, 100.0]], search_radius=10)
    assert not found.accepted[0]


@pytest.mark.second
def test_search_is_good_to_tenths(texture, frame, points):
    places = points[:100] + 0.3
    peaks = search(frame, texture.patches(places), places + np.array([30.0, -30.0]), 40)
    assert np.all(peaks.reason == Reason.ACCEPTED)
    assert np.abs(peaks.position - places).max() < 0.25
    # noise alone leaves 0.96 of it, 0.3 px off along both axes some 0.93
    assert peaks.value.min() > 0.85
    assert peaks.ratio.max() < 0.7
    short = search(frame, texture.patches(places), places + np.array([30.0, -30.0]), 10)
    assert short.value.max() < 0.8
    refuses(ValueError, "improve the prediction", search, frame, texture.patches(places), places, 0)


def test_sigma_is_that_of_the_worst_direction():
    """An ellipse of errors with axes of 0.1 and 0.04 px, turned all ways; a circle has no worst direction."""
    turn = np.radians(np.arange(0, 180, 15))
    axis = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    covariance = 0.04**2 * np.eye(2) + (0.1**2 - 0.04**2) * axis[:, :, None] * axis[:, None, :]
    covariance[-1] = 0.04**2 * np.eye(2)
    one, accepted = np.ones(len(turn)), np.ones(len(turn), bool)
    found = Matches(np.zeros((len(turn), 2)), covariance, one, one, accepted, np.zeros(len(turn), np.int8))
    assert found.sigma == pytest.approx(np.where(np.arange(len(turn)) < len(turn) - 1, 0.1, 0.04), rel=1e-12)


def test_no_points_are_an_empty_result(frame):
    found = match_windows(frame, np.zeros((0, 31, 31)), np.zeros((0, 2)), search_radius=10)
    assert found.position.shape == (0, 2)
    assert found.covariance.shape == (0, 2, 2)
    assert found.text == "0 of 0 accepted"


def test_points_are_distinct_and_spread(texture, frame, points):
    assert np.array_equal(points, distinct_points(frame, 500, spacing=12, border=60))
    assert points.min() >= 60
    assert points.max() < SIZE - 60
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 1000 * np.eye(500)
    assert apart.min() >= 12
    # quarters of the image have their share: 125 of 500, from one cell a point to some per cent
    quarter = (points >= SIZE / 2) @ [1, 2]
    assert np.bincount(quarter, minlength=4).min() > 105
    # stripes of 20 px with a fifth of the contrast: cells of 30 px hold some of both and take the better
    weak = np.arange(SIZE) // 20 % 2 == 1
    grey = texture.grid(np.arange(SIZE), np.arange(SIZE))
    striped = detected(np.where(weak, 800 + 0.2 * (grey - 800), grey), 2)
    chosen = distinct_points(striped, 300, spacing=12, border=60)
    assert len(chosen) == 300
    assert weak[chosen[:, 1].astype(int)].mean() < 0.1
    assert len(distinct_points(np.random.default_rng(4).poisson(800, (300, 300)), 200, spacing=10, border=10)) < 5
    for even in (7.0, np.nan):
        assert len(distinct_points(np.full((100, 100), even), 20, spacing=5, border=5)) == 0
    refuses(ValueError, "leaves nothing", distinct_points, frame, 5, spacing=5, border=400)


def test_second_peaks_count_from_four_pixels_on():
    """The main lobe is three pixels to each side."""
    for down, across in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1)):
        field = np.zeros((41, 41), np.float32)
        field[20, 20] = 0.9
        field[20 + 3 * down, 20 + 3 * across] = 0.7
        assert _second(field, 20, 20) == 0.0
        field[20 + 4 * down, 20 + 4 * across] = 0.6
        # a lower one within 5 x 5 pixels of a higher is its slope
        assert _second(field, 20, 20) == 0.0
        field[20 + 3 * down, 20 + 3 * across] = 0.0
        assert _second(field, 20, 20) == pytest.approx(0.6)
    corner = np.full((9, 9), -0.5, np.float32)
    corner[0, 1] = 0.8
    assert _second(corner, 0, 1) == 0.0


@pytest.mark.second
def test_thresholds_are_options(texture, frame, points):
    patches = texture.patches(points[:30])
    strict = match_windows(frame, patches, points[:30], search_radius=5, options=MatchOptions(largest_sigma=0.005))
    assert np.all(strict.reason == Reason.UNCERTAIN)
    low = match_windows(frame, patches, points[:30], search_radius=5, options=MatchOptions(saturation=700.0))
    assert np.all(low.reason == Reason.SATURATED)
