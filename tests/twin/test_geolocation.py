"""The fast grid against the rigorous model, pixel by pixel."""

import math

import numpy as np
import pytest

from scenes.specs.orbit.setup import load_three_line_camera
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from tests.twin.orbit_bench import CirclePlatform
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import LightEffects
from twin.orbit.flight.line_camera import line_cameras, traced_line_cameras
from twin.orbit.flight.sensor import GeolocationGrid, Sensor

LINES = 10_000
UNSTEADY = CirclePlatform(wobble=math.radians(5.0 / 3600.0))
TH1 = line_cameras(load_three_line_camera("th1"))


def sensor(camera, platform=UNSTEADY) -> Sensor:
    return Sensor(camera, platform, Earth(), 0.7e-3, -3.0, LINES, LightEffects())


@pytest.mark.second
@pytest.mark.parametrize("name", ["forward", "nadir", "gf7"])
def test_grid_against_the_rigorous_model(gf7_pair, backend, name: str) -> None:
    """Random lines and pixels, also between their centres, of an image whose attitude trembles at up to 31 Hz."""
    camera = traced_line_cameras(gf7_pair, backend)["forward"] if name == "gf7" else TH1[name]
    model = sensor(camera)
    grid = GeolocationGrid.prepare(model, height=1234.0)
    assert grid.error <= 1e-6
    rng = np.random.default_rng(6)
    lines = np.concatenate([[-0.5, LINES - 0.5], rng.uniform(-0.5, LINES - 0.5, 60)])
    pixels = np.concatenate([[-0.5, camera.pixels - 0.5], rng.uniform(-0.5, camera.pixels - 0.5, 60)])
    exact = model.ground(*np.meshgrid(lines, pixels, indexing="ij"), 1234.0).reshape(62, 62, 3)
    covered = np.zeros(62, dtype=int)
    for part, points in grid.blocks(lines, pixels, block=25):
        covered[part] += 1
        # the error that was found by the grid itself holds elsewhere within a small factor: 1e-3 pixel is 5e-3 m
        assert np.max(np.linalg.norm(points - exact[part], axis=-1)) < 3.0 * grid.error + 1e-8
        line, pixel = model.image(points.reshape(-1, 3)[::31])
        expected = np.stack(np.meshgrid(lines[part], pixels, indexing="ij"), axis=-1).reshape(-1, 2)[::31]
        inside = np.isfinite(line)  # points on the very border may fall outside by rounding
        assert np.mean(inside) > 0.95
        np.testing.assert_allclose(np.stack([line, pixel], axis=-1)[inside], expected[inside], rtol=0, atol=1e-5)
    assert covered.tolist() == [1] * 62


def test_too_coarse_a_grid_would_be_seen() -> None:
    """With few nodes the error is there and the grid says so."""
    model = sensor(TH1["forward"])
    good = GeolocationGrid.prepare(model)
    coarse = GeolocationGrid(model, 0.0, 0.5 * (np.polynomial.chebyshev.chebpts1(3) + 1.0) * 12000 - 0.5, np.inf)
    (_, few), (_, many) = (next(g.blocks(np.array([50.0]), np.arange(12000.0))) for g in (coarse, good))
    assert 0.1 < np.max(np.linalg.norm(few - many, axis=-1)) < 100.0
    with pytest.raises(ValueError, match="nodes leave an error"):
        GeolocationGrid.prepare(model, tolerance=1e-12)


def test_errors() -> None:
    grid = GeolocationGrid.prepare(sensor(TH1["nadir"]))
    with pytest.raises(ValueError, match="pixel outside the line"):
        next(grid.blocks(np.array([0.0]), np.array([12000.0])))
    with pytest.raises(ValueError, match="line outside the image"):
        next(grid.blocks(np.array([10_000.0]), np.array([0.0])))
    spec = {"name": "own", "pixels": 12000, "pitch": "6.5 um"}
    past = {"past": {"look": "69 deg", "focal_length": "650 mm"}}
    cameras = line_cameras(ThreeLineCameraSpec.model_validate({**spec, "lines": past}))
    with pytest.raises(ValueError, match="misses the Earth"):
        GeolocationGrid.prepare(sensor(cameras["past"]))
