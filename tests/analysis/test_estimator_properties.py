"""Laws of the estimators, whatever the numbers: what moves, grows or changes places in the input does so in the end."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.focal_plane.plane_fit import fit_focal_plane
from analysis.matching.least_squares import least_squares
from analysis.monitor.intersection_angle import exact
from analysis.monitor.monitoring import CameraParameters, MonitorGeometry, derived, paper_joint, paper_single
from analysis.orbit.angles import angles_between
from analysis.orbit.planes import Station, Strip, fit_plane
from analysis.orientation.interior import fit_interior_orientation
from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.noise import NoiseModel
from optics.geometry.pose import rotation_matrix
from tests.analysis.texture_image import Texture
from tests.tiers import quick

NOISE = NoiseModel(0.06, 16.0, 0.0, 64.0, 0.01, 5.0, 4095.0)
FORMULAS = {"paper_single": paper_single, "paper_joint": paper_joint, "derived": derived}
PLAIN = MonitorGeometry(5.5, 0.24, 12e-6, 0.1, 0.02)


def blob(row: float, column: float, size: int = 64) -> np.ndarray:
    """A smooth spot that is no Gaussian, in grey values."""
    r, c = np.indices((size, size))
    far = ((r - row) / 4.0) ** 2 + ((c - column) / 5.0) ** 2 + 0.05 * (r - row) * (c - column) / 20.0
    return 64.0 + 2500.0 / (1.0 + far) ** 4


def arrays(*shape: int, most: float = 1.0) -> st.SearchStrategy[np.ndarray]:
    count = int(np.prod(shape))
    return st.lists(st.floats(-most, most), min_size=count, max_size=count).map(lambda v: np.array(v).reshape(shape))


PLACE = st.floats(30.0, 34.0)


@pytest.mark.parametrize("estimate", quick(1, [energy_centroid, gaussian_fit]))
@settings(max_examples=12)
@given(row=PLACE, column=PLACE, down=st.integers(-6, 6), across=st.integers(-6, 6))
def test_a_spot_that_moves_by_whole_pixels(estimate, row, column, down, across) -> None:
    """Its centroid does, to what the iterations leave (1e-7 px); the spot's wings move over the image's edge."""
    images = np.stack([blob(row, column), blob(row + down, column + across)])
    first, second = estimate(images, 9, NOISE).position
    limit = 1e-5 if estimate is gaussian_fit else 2e-3
    np.testing.assert_allclose(second - first, [down, across], rtol=0, atol=limit)


@settings(max_examples=12)
@given(row=PLACE, column=PLACE, gain=st.floats(0.3, 1.4), sky=st.floats(0.0, 300.0))
def test_the_energy_centroid_knows_no_brightness_and_no_background(row, column, gain, sky) -> None:
    """Both drop out of the first moment exactly; what is left is where the window comes to rest."""
    image = blob(row, column)
    first, second = energy_centroid(np.stack([image, 64.0 + gain * (image - 64.0) + sky]), 9, NOISE).position
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-6)


@pytest.mark.parametrize("estimate", [energy_centroid, gaussian_fit])
@settings(max_examples=12)
@given(row=PLACE, column=PLACE)
def test_an_image_in_the_mirror(estimate, row, column) -> None:
    image = blob(row, column)
    plain, flipped, turned = estimate(np.stack([image, image[::-1], image.T]), 9, NOISE).position
    np.testing.assert_allclose(flipped, [63.0 - plain[0], plain[1]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(turned, plain[::-1], rtol=0, atol=1e-6)


SPOTS = arrays(2, 2, most=20.0)


@pytest.mark.parametrize("name", FORMULAS)
@given(start=SPOTS, shift=SPOTS)
def test_exchanging_the_sides_and_the_times(name, start, shift) -> None:
    """Left for right: d_gamma and d_f change their sign, d_alpha and d_beta stay. Before for after: all change it.
    Sigmas stay.
    """
    covariance = np.diag([1.0, 2.0, 3.0, 4.0]) * 1e-4
    formula = FORMULAS[name]
    found = formula(start, start + shift, covariance, PLAIN)
    swapped = covariance[np.ix_([2, 3, 0, 1], [2, 3, 0, 1])]
    sides = formula(start[::-1], (start + shift)[::-1], swapped, PLAIN)
    # the spots' positions are rounded to 4e-15 px, pixels of 12 um over metres
    np.testing.assert_allclose(sides.vector, found.vector * [1, 1, -1, -1], rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(sides.sigma, found.sigma, rtol=1e-12)
    times = formula(start + shift, start, covariance, PLAIN)
    np.testing.assert_allclose(times.vector, -found.vector, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("name", ["paper_joint", "derived"])
@given(one=SPOTS, two=SPOTS, factor=st.floats(-3.0, 3.0))
def test_linear_formulas_are_linear(name, one, two, factor) -> None:
    zero, nothing = np.zeros((2, 2)), np.zeros((4, 4))

    def vector(shift: np.ndarray) -> np.ndarray:
        return FORMULAS[name](zero, shift, nothing, PLAIN).vector

    np.testing.assert_allclose(vector(one + factor * two), vector(one) + factor * vector(two), rtol=1e-11, atol=1e-18)


@given(turns=arrays(2, 3, most=1e-3), common=st.floats(-1e-2, 1e-2))
def test_the_intersection_angle_knows_no_common_pitch(turns, common) -> None:
    """Both cameras turned alike about Y leave it; turned by alpha alone, it changes by the difference exactly."""

    def camera(alpha: float, beta: float, gamma: float) -> CameraParameters:
        return CameraParameters.from_vector([alpha, beta, gamma, 0.0], np.zeros((4, 4)))

    still = exact(camera(common, 0.0, turns[0, 2]), camera(common, 0.0, turns[1, 2]), 0.45, -0.09).change_rad
    assert abs(still) < 1e-15
    pair = [camera(t[0], 0.0, t[2]) for t in turns]
    assert abs(exact(*pair, 0.45, -0.09).change_rad - (pair[0].d_alpha_rad - pair[1].d_alpha_rad)) < 1e-15
    # with turns about X as well it changes by second order of them only, over the tangent of the angle
    pair = [camera(*t) for t in turns]
    assert (
        abs(exact(*pair, 0.45, -0.09).change_rad - (pair[0].d_alpha_rad - pair[1].d_alpha_rad))
        < 1e-15 + 5.0 * np.abs(turns).max() ** 2
    )


def _strips(noise: np.ndarray) -> list[np.ndarray]:
    """Points (20, 3) on three strips below a station at the origin, some hundred kilometres away, with errors."""
    across = np.linspace(-0.06, 0.06, 20)
    looks = (0.43, 0.02, -0.44)
    rays = [np.stack([np.full(20, np.tan(look)), across, np.full(20, -1.0)], -1) for look in looks]
    return [5e5 * ray + 2.0 * noise[k] for k, ray in enumerate(rays)]


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), turn=arrays(3, most=1.8), move=arrays(3, most=6e6), scale=st.floats(0.5, 2.0))
def test_planes_turn_with_their_points(seed, turn, move, scale) -> None:
    """Total least squares in a frame that is turned, moved and scaled gives the turned normals, the same angles and the
    same sigmas. Coordinates of 6e6 m keep 1e-9 m, which over 5e5 m is 2e-15 a point.
    """
    frame = rotation_matrix(turn)
    normals, found = [], []
    for axes, shift, unit in ((np.eye(3), np.zeros(3), 1.0), (frame, move, scale)):
        station = Station.of(shift, 0.5 * unit)
        points = [unit * p @ axes.T + shift for p in _strips(np.random.default_rng(seed).standard_normal((3, 20, 3)))]
        planes = [fit_plane(station, Strip.of(p, 2.0 * unit)) for p in points]
        normals.append(np.array([p.normal for p in planes]) @ axes)
        found.append(angles_between(planes, [(0, 1), (1, 2)]))
    facing = np.sign(np.sum(normals[0] * normals[1], axis=1))
    np.testing.assert_allclose(normals[1] * facing[:, None], normals[0], rtol=0, atol=2e-13)
    np.testing.assert_allclose(found[1].values, found[0].values, rtol=0, atol=2e-13)
    np.testing.assert_allclose(found[1].sigma, found[0].sigma, rtol=1e-6)


PLACES = np.random.default_rng(2).uniform(-0.1, 0.1, (12, 2))


@given(defocus=arrays(12, most=1e-4), plane=arrays(3, most=1e-4), order=st.permutations(range(12)))
def test_a_plane_that_is_added_is_found(defocus, plane, order) -> None:
    """Whatever the scatter, in whatever order the places come; residuals stay."""
    sigma = np.linspace(1e-6, 3e-6, 12)
    first = fit_focal_plane(PLACES, defocus, sigma)
    order = list(order)
    added = (defocus + plane[0] + PLACES @ plane[1:])[order]
    second = fit_focal_plane(PLACES[order], added, sigma[order])
    before, after = (np.array([f.piston, f.slope_x, f.slope_y]) for f in (first, second))
    np.testing.assert_allclose(after - before, plane, rtol=0, atol=1e-15)
    np.testing.assert_allclose(second.residual, first.residual[order], rtol=0, atol=1e-17)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-10, atol=1e-25)


ANGLES = np.radians(np.linspace(-1.2, 1.2, 21)) + 1e-4


@given(noise=arrays(21, most=1e-6), point=st.floats(-1e-2, 1e-2), scale=st.floats(0.2, 5.0))
def test_interior_orientation_in_the_mirror_and_grown(noise, point, scale) -> None:
    """Places and angles counted the other way: f stays, constant and principal point change their sign. Places in
    another unit: all grow alike.
    """
    terms = ("constant", "principal_distance", "principal_point")
    tangent = np.tan(ANGLES)
    where = 2e-5 + 5.5 * tangent - point * tangent**2 + noise
    plain = fit_interior_orientation(where, ANGLES, 1e-6, terms)
    mirrored = fit_interior_orientation(-where[::-1], -ANGLES[::-1], 1e-6, terms)
    grown = fit_interior_orientation(scale * where, ANGLES, scale * 1e-6, terms)
    # a metre of f is 1e-16 / tan(1.2 deg)^2 uncertain in p by rounding
    np.testing.assert_allclose(mirrored.values, plain.values * [-1, 1, -1], rtol=0, atol=1e-11)
    np.testing.assert_allclose(grown.values, scale * plain.values, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(grown.chi_square, plain.chi_square, rtol=1e-6, atol=1e-9)


TEXTURE = Texture(5)
IMAGE = TEXTURE.grid(np.arange(120), np.arange(120))
SEEN = np.array([[60.2, 59.6], [52.7, 66.1]])
PATCHES = TEXTURE.patches(SEEN)


@pytest.mark.second
@settings(max_examples=10)
@given(down=st.integers(-9, 9), across=st.integers(-9, 9), gain=st.floats(0.5, 2.0), offset=st.floats(-200.0, 500.0))
def test_matching_follows_the_image_and_knows_no_radiometry(down, across, gain, offset) -> None:
    """An image that begins elsewhere moves the matches by whole pixels; gain and offset leave them. Iterations rest at
    1e-3 px and less.
    """
    start = SEEN + np.array([[0.4, -0.3], [-0.5, 0.2]])
    first = least_squares(IMAGE, PATCHES, start)
    rows, columns = slice(max(down, 0), 120 + min(down, 0)), slice(max(across, 0), 120 + min(across, 0))
    moved = np.array([rows.start, columns.start])
    second = least_squares(gain * IMAGE[rows, columns] + offset, PATCHES, start - moved)
    turned = least_squares(IMAGE.T, PATCHES.transpose(0, 2, 1), start[:, ::-1])
    assert np.all(first.reason == 0)
    np.testing.assert_allclose(first.place, SEEN, rtol=0, atol=0.02)
    np.testing.assert_allclose(second.place + moved, first.place, rtol=0, atol=1e-8)
    np.testing.assert_allclose(turned.place[:, ::-1], first.place, rtol=0, atol=1e-8)
