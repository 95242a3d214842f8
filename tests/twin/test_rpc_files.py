"""Rational polynomials from files, and corrected by control points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from analysis.orbit.rational_polynomial import Kind, RationalPolynomial, image_correction
from tests.tiers import quick
from tests.twin.dimap_bench import Scene, rpc, write
from twin.framework.data_files import FrameFacts, tiff
from twin.orbit.export.rational_polynomial import (
    corrected_polynomial,
    image_slope,
    polynomial_correction,
    read_rpc,
    sensor_polynomial,
)
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.measured.platform_files import read_scene

SCENE = Scene()
HEIGHTS = (0.0, 2000.0)


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory):
    return read_scene(write(tmp_path_factory.mktemp("scene"), SCENE)).sensor


@pytest.fixture(scope="module")
def model(sensor) -> RationalPolynomial:
    return sensor_polynomial(sensor, 0, SCENE.pixels, HEIGHTS)


def parts(model: RationalPolynomial) -> np.ndarray:
    names = ("offset", "scale", "line_numerator", "line_denominator", "sample_numerator", "sample_denominator")
    return np.concatenate([getattr(model, name) for name in names])


def ground_points(sensor, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Places in the image (N, 2), and their ground, ITRS (N, 3)."""
    random = np.random.default_rng(seed)
    place = random.uniform(100.0, [SCENE.lines - 100.0, SCENE.pixels - 100.0], (count, 2))
    return place, sensor.ground(*place.T, random.uniform(*HEIGHTS, count))


@pytest.mark.parametrize("bias", [(None, None), (1.25, 0.5)])
def test_what_is_written_comes_back(tmp_path: Path, model: RationalPolynomial, bias) -> None:
    stated = replace(model, bias_m=bias[0], random_m=bias[1])
    (tmp_path / "a_RPC.TXT").write_text(stated.text())
    (tmp_path / "a.tif").write_bytes(tiff(np.zeros((1, 32, 32), np.uint16), FrameFacts(georeference=stated)))
    for name in ("a_RPC.TXT", "a.tif"):
        found = read_rpc(tmp_path / name)
        assert np.array_equal(parts(found), parts(stated)), name
        assert (found.bias_m, found.random_m) == bias
    # GDAL itself reads the errors, where they are stated, and the offsets
    with rasterio.open(tmp_path / "a.tif") as image:
        told = image.rpcs
    assert (told.err_bias, told.err_rand) in (bias, (-1.0, -1.0))
    assert told.line_off == pytest.approx(model.offset[0], rel=1e-12)
    for version in ("2.15", "3.0"):
        (tmp_path / "RPC.XML").write_text(rpc(model, version))
        # offsets of version 2 are written with 1 added
        np.testing.assert_allclose(parts(read_rpc(tmp_path / "RPC.XML")), parts(model), rtol=0, atol=1e-11)


def test_slopes_are_those_of_the_rigorous_sensor(sensor, model: RationalPolynomial) -> None:
    _, itrs = ground_points(sensor, 12, 1)
    longitude, latitude, height = Earth().geodetic(itrs)
    found = image_slope(model, latitude, longitude, height)
    level = east_north_up(longitude, latitude)
    for k in range(3):
        ends = [np.stack(sensor.image(itrs + sign * level[:, k]), axis=-1) for sign in (5.0, -5.0)]
        # steps of 10 m, of which the sensor's own inverse is right to 1e-7 px
        np.testing.assert_allclose(found[:, :, k], (ends[0] - ends[1]) / 10.0, rtol=0, atol=2e-7)


@pytest.mark.parametrize("kind", quick(1, ["shift", "affine"]))
def test_errors_on_the_ground_are_errors_in_the_image(sensor, model: RationalPolynomial, kind: Kind) -> None:
    """By slopes of the rigorous sensor, with steps of 10 m; and polynomials that are corrected have the correction
    inside, to 1e-5 px of their fit.
    """
    place, itrs = ground_points(sensor, 12, 2)
    longitude, latitude, height = Earth().geodetic(itrs)
    where = np.degrees(latitude), np.degrees(longitude), height
    predicted = np.stack(model.image(*where), axis=-1)
    seen = place + np.random.default_rng(1).normal((12.0, -31.0), 1.0, (12, 2))
    on_ground, in_image = np.diag([0.5, 0.4, 0.8]) ** 2, np.array([[0.09, 0.02], [0.02, 0.16]])
    spreads = np.tile(on_ground, (12, 1, 1)), np.tile(in_image, (12, 1, 1))
    found = polynomial_correction(model, itrs, spreads[0], seen, spreads[1], kind, screened=False)
    ends = [[np.stack(sensor.image(itrs + sign * axis), -1) for sign in (5.0, -5.0)] for axis in np.eye(3)]
    slope = np.stack([(one - other) / 10.0 for one, other in ends], axis=-1)
    wanted = image_correction(
        predicted, seen, in_image + slope @ on_ground @ slope.swapaxes(1, 2), kind, screened=False
    )
    np.testing.assert_allclose(found.at(*place.T), wanted.at(*place.T), rtol=1e-6)
    np.testing.assert_allclose(found.covariance_at(*place.T), wanted.covariance_at(*place.T), rtol=1e-5)
    assert (found.chi_square, found.freedom) == (pytest.approx(wanted.chi_square, rel=1e-5), wanted.freedom)
    after = np.stack(corrected_polynomial(model, found).image(*where), axis=-1)
    np.testing.assert_allclose(after, predicted + found.at(*predicted.T), rtol=0, atol=1e-5)


@pytest.mark.second
def test_err_bias_and_err_rand(sensor, model: RationalPolynomial) -> None:
    """Of a shift: its sigma times the pixels on the ground, root mean square of the two horizontal axes (GDAL, RFC 22).
    What scatters beyond the sigmas is the other.
    """
    place, itrs = ground_points(sensor, 40, 4)
    none, spread = np.tile(1e-8 * np.eye(3), (40, 1, 1)), np.tile(0.04 * np.eye(2), (40, 1, 1))
    noise = np.random.default_rng(5).standard_normal((40, 2))
    middle = 0.5 * (np.array([SCENE.lines, SCENE.pixels]) - 1.0)
    ground = sensor.ground(middle[0] + [0.0, 1.0, 0.0], middle[1] + [0.0, 0.0, 1.0], 1000.0)
    size = np.linalg.norm(ground[1:] - ground[0], axis=1) / np.sqrt(2.0)
    quiet = corrected_polynomial(model, polynomial_correction(model, itrs, none, place + 0.2 * noise, spread, "shift"))
    assert quiet.bias_m == pytest.approx(0.2 * np.hypot(*size) / np.sqrt(40.0), rel=0.02)
    assert quiet.random_m == 0.0
    rough = corrected_polynomial(
        model, polynomial_correction(model, itrs, none, place + noise, spread, "shift", screened=False)
    )
    assert rough.bias_m == pytest.approx(quiet.bias_m, rel=1e-6)
    assert rough.random_m == pytest.approx(np.sqrt(1.0 - 0.04) * np.hypot(*size), rel=0.25)  # 40 points: 11 %
