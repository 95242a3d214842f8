"""Search, verdicts and consensus: right matches found far off, wrong ones recognised, reasons given."""

import numpy as np
import pytest

from analysis.matching.correlation import MatchOptions, Reason, _second, distinct_points, search
from analysis.matching.matches import Matches, match
from tests.analysis.refusals import refuses
from tests.analysis.texture_image import Texture, detected

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
    found = match(image, patches, places, reach=10)
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
    assert np.isnan(found.place[[4, 5, 6, 7, 8]]).all()
    # more than the reach away, and an image with missing pixels
    far = match(image, texture.patches([[50.0, 50.0]]), [[50.0, 64.0]], reach=10)
    assert not far.accepted[0]
    holes = image.astype(float)
    holes[352, 352] = np.nan
    assert match(holes, texture.patches([[350.0, 350.0]]), [[350.0, 350.0]], reach=10).reason[0] == Reason.IMAGE
    # at the image's side the window is cut, and the point is found all the same
    side = match(image, texture.patches([[17.3, 150.4]]), [[20.0, 150.0]], reach=10)
    assert side.accepted[0]
    assert side.place[0] == pytest.approx([17.3, 150.4], abs=0.15)


def test_repeated_pattern_is_ambiguous_and_an_edge_is_uncertain():
    rows, columns = np.mgrid[:200.0, :200.0]
    periodic = 800 + 100 * np.sin(2 * np.pi * rows / 9) + 100 * np.sin(2 * np.pi * columns / 9)
    found = match(detected(periodic, 1), periodic[None, 85:116, 85:116], [[100.0, 100.0]], reach=20)
    assert found.reason[0] == Reason.AMBIGUOUS
    edge = 800 + 200 * np.tanh((columns - 100.2) / 2)
    found = match(detected(edge, 2), edge[None, 85:116, 85:116], [[100.0, 100.0]], reach=10)
    assert not found.accepted[0]


@pytest.mark.second
def test_search_is_good_to_tenths(texture, frame, points):
    places = points[:100] + 0.3
    peaks = search(frame, texture.patches(places), places + np.array([30.0, -30.0]), 40)
    assert np.all(peaks.reason == Reason.ACCEPTED)
    assert np.abs(peaks.place - places).max() < 0.25
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
    found = match(frame, np.zeros((0, 31, 31)), np.zeros((0, 2)), reach=10)
    assert found.place.shape == (0, 2)
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
    strict = match(frame, patches, points[:30], reach=5, options=MatchOptions(largest_sigma=0.005))
    assert np.all(strict.reason == Reason.UNCERTAIN)
    low = match(frame, patches, points[:30], reach=5, options=MatchOptions(saturation=700.0))
    assert np.all(low.reason == Reason.SATURATED)
