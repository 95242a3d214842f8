"""Ground: exact coordinates, one function of height, spectra and shares as asked for, light by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from scenes.specs.orbit.scene import ControlSpec, LightSpec, TerrainSpec, TextureSpec
from tests.tiers import quick
from twin.orbit.flight.earth import Earth
from twin.orbit.ground.grid import GroundFrame, SplineGrid, Terrain, correlated_field, fractal_field
from twin.orbit.ground.orthophoto import SCALE, Extent, apparent, make_control, reflectance
from twin.orbit.images.image_points import ReferenceHeights

SEED = np.random.SeedSequence(7)
FRAME = GroundFrame(np.radians(116.0), np.radians(40.0))
EXTENT = Extent(-1500.0, 1500.0, -1200.0, 1300.0)
TEXTURE = TextureSpec()
FRACTAL = TerrainSpec.model_validate({"kind": "fractal", "relief": "90 m", "height": "700 m"})


def test_local_coordinates_are_exact() -> None:
    """To rounding of a point 6400 km from the centre, 100 km away, and lengths as on the ellipsoid at the middle."""
    east, north, height = np.array([0.0, -5e4, 1e5]), np.array([0.0, 3e4, -9e4]), np.array([0.0, 4000.0, -300.0])
    found = FRAME.local(FRAME.itrs(east, north, height))
    assert np.stack(found) == pytest.approx(np.stack([east, north, height]), abs=1e-7)
    longitude, latitude, up = Earth().geodetic(FRAME.itrs(0.0, 0.0, 12.0))
    assert (longitude, latitude) == pytest.approx((FRAME.longitude, FRAME.latitude), rel=1e-14)
    assert up == pytest.approx(12.0, abs=2e-9)
    steps = FRAME.itrs(np.array([-1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0, 1.0]), 0.0)
    assert np.linalg.norm(steps[1] - steps[0]) == pytest.approx(2.0, rel=1e-9)
    assert np.linalg.norm(steps[3] - steps[2]) == pytest.approx(2.0, rel=1e-9)


@pytest.mark.second
@pytest.mark.parametrize("spec", quick(1, [TerrainSpec(), FRACTAL]), ids=["real", "fractal"])
def test_one_function(spec: TerrainSpec) -> None:
    """On a grid and at places the same number, to rounding; slopes are its derivatives; it goes on beyond its edges."""
    terrain = Terrain.from_spec(spec, 4000.0, SEED)
    east, north = np.linspace(-21e3, 23e3, 157), np.linspace(-19e3, 18e3, 131)
    places = np.meshgrid(east, north)
    height = terrain.height(*places)
    assert terrain.on_grid(east, north) == pytest.approx(height, abs=1e-9)
    low, high = terrain.limits
    assert low < height.min() < height.max() < high
    slopes = terrain.slopes(east, north)
    for slope, step in zip(slopes, ((0.05, 0.0), (0.0, 0.05)), strict=True):
        ahead, behind = (terrain.height(places[0] + s * step[0], places[1] + s * step[1]) for s in (1.0, -1.0))
        # a second derivative that changes by 0.1 in a post of 30 m: 1e-6
        assert slope == pytest.approx((ahead - behind) / 0.1, abs=1e-5)


def test_the_real_terrain_has_the_heights_of_its_posts() -> None:
    """The file's heights, to the offset; 3 arc seconds are 93 m to the north and 74 m to the east at 36.6 degrees."""
    terrain = Terrain.real(TerrainSpec.model_validate({"height": "100 m"}))
    assert terrain.surface.spacing == pytest.approx((74.6, 92.5), abs=0.3)
    rows, columns = terrain.surface.coefficients.shape
    assert (rows, columns) == (344, 403)
    east = terrain.surface.first[0] + terrain.surface.spacing[0] * np.arange(columns)
    north = terrain.surface.first[1] + terrain.surface.spacing[1] * np.arange(rows)
    posts = terrain.on_grid(east, north)
    assert posts.max() - posts.min() == pytest.approx(1076.0 - 236.0, abs=1e-6)
    assert posts.mean() == pytest.approx(100.0, abs=1e-6)
    assert np.abs(posts - np.rint(posts - posts[0, 0]) - posts[0, 0]).max() < 1e-6
    # mirrored at the outer posts
    beyond = np.array([137.0])
    outside, inside = (terrain.height(np.array([east[-1]]) + s * beyond, beyond) for s in (1.0, -1.0))
    assert outside == pytest.approx(inside, abs=1e-9)
    half = Terrain.real(TerrainSpec.model_validate({"relief": "60 m"}))
    assert half.on_grid(east, north).std() == pytest.approx(60.0, rel=1e-9)


def test_a_fractal_has_its_relief_and_exponent() -> None:
    """Mean power on rings of frequency follows the power law; each ring has hundreds of numbers, so 15%."""
    spacing, exponent = 30.0, 2.2
    field = fractal_field((512, 512), spacing, exponent, 6000.0, SEED).astype(float)
    assert field.std() == pytest.approx(1.0, abs=1e-5)
    power = np.abs(np.fft.fft2(field)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(512, spacing), np.fft.fftfreq(512, spacing)))
    ring = [power[(frequency > a) & (frequency < 1.1 * a)].mean() for a in (1e-3, 1e-2)]
    level = [((1.05 * a) ** 2 + 6000.0**-2) ** -exponent for a in (1e-3, 1e-2)]
    assert ring[0] / ring[1] == pytest.approx(level[0] / level[1], rel=0.15)


def test_a_correlated_field_has_its_covariance() -> None:
    """Of 200 fields with 3 x 5 independent patches each, 3000 numbers: 5 sigma are 0.09; also where cells are coarser
    than the correlation."""
    drawn = np.array([correlated_field((40, 60), 25.0, 100.0, np.random.SeedSequence(k)) for k in range(200)])
    for lag, expected in ((0, 1.0), (4, np.exp(-0.5)), (12, np.exp(-4.5)), (50, 0.0)):
        found = np.mean(drawn[:, :, : 60 - lag] * drawn[:, :, lag:])
        assert found == pytest.approx(expected, abs=0.09)
    white = np.array([correlated_field((40, 60), 25.0, 2.0, np.random.SeedSequence(k)) for k in range(20)])
    assert white.std() == pytest.approx(1.0, abs=0.03)


def test_nothing_beyond_the_ground() -> None:
    ground = reflectance(EXTENT, TEXTURE, SEED)
    corners = np.array([EXTENT.west, EXTENT.east]), np.array([EXTENT.south, EXTENT.north])
    assert np.all(np.isfinite(ground(*corners)))
    with pytest.raises(ValueError, match="outside the grid of the ground"):
        ground(corners[0] * 1.1, corners[1])


def test_heights_beside_a_gap_of_a_map_are_unknown() -> None:
    """A place needs all four posts around it; of these a gap takes one away, and the map's edge others."""
    valid = np.ones((7, 9), bool)
    valid[2, 5] = False
    posts = np.add.outer(10.0 * np.arange(7.0), np.arange(9.0)).astype(np.float32)
    heights = ReferenceHeights.of(SimpleNamespace(values=posts, valid=valid, row_column=lambda e, n: (n, e)))
    north, east = np.meshgrid(np.arange(-0.5, 7.0), np.arange(-0.5, 9.0), indexing="ij")
    found = heights(east, north)
    unknown = {(k, j) for k, j in np.argwhere(np.isnan(found)) if 0 < k < 7 and 0 < j < 9}
    assert unknown == {(2, 5), (2, 6), (3, 5), (3, 6)}
    assert np.isnan([found[0], found[-1]]).all()
    assert np.isnan([found[:, 0], found[:, -1]]).all()
    assert found[5, 3] == pytest.approx(47.0, abs=0.3)


def test_light_by_hand() -> None:
    """A plane that rises by 0.2 to the east, sun in the east at 40 degrees: Lambert with the plane's normal."""
    grey = SplineGrid(np.full((40, 40), 0.3, np.float32), (5.0, 5.0), (-100.0, -100.0))
    posts = 500.0 + 0.2 * 10.0 * np.arange(-100, 101) * np.ones((201, 1))
    plane = Terrain.through(posts, (10.0, 10.0), (-1000.0, -1000.0))
    light = LightSpec.model_validate(
        {"elevation": "40 deg", "azimuth": "90 deg", "transmission": 0.6, "sky": 0.1, "path": 0.05}
    )
    normal = np.array([-0.2, 0.0, 1.0]) / np.hypot(0.2, 1.0)
    sine, cosine = np.sin(np.radians(40.0)), np.cos(np.radians(40.0))
    expected = 0.6 * 0.3 * (0.9 * normal @ [cosine, 0.0, sine] + 0.1 * sine) + 0.05
    assert apparent(grey, plane, light).coefficients == pytest.approx(np.full((40, 40), expected), rel=1e-5)
    # away from the sun it is darker than level ground
    assert expected < apparent(grey, Terrain.flat(0.0), light).coefficients[0, 0]


@pytest.mark.second
def test_control_errors() -> None:
    """Without noise and smoothing the map shows the ground moved by its error; the elevation model's errors have their
    sigma: 3 km x 2.5 km hold 75 independent patches of 200 m, 5 sigma of the rms are 40%."""
    terrain = Terrain.from_spec(FRACTAL, 3000.0, SEED)
    exact = ControlSpec.model_validate(
        {
            "mtf": 0.999999,
            "noise": 0.0,
            "changed": 0.0,
            "shift": ["6 m", "-4 m"],
            "sigma": "0.5 m",
            "dem": {"sigma": "0 m"},
        }
    )
    known = make_control(FRAME, EXTENT, terrain, TEXTURE, exact, SEED, np.random.SeedSequence(9))
    photo, dem = known.orthophoto, known.dem
    row, column = np.array([40, 300, 700]), np.array([900, 55, 420])
    east, north = photo.east_north(row, column)
    off = known.error(east, north)
    assert np.hypot(off[0] - 6.0, off[1] + 4.0).max() < 5.0 * 0.5 * np.sqrt(2.0)
    full = apparent(reflectance(EXTENT, TEXTURE, SEED), terrain, exact.light)
    expected = SCALE * full(east - off[0], north - off[1])
    assert photo.values[row, column] == pytest.approx(expected, abs=1.5)
    back = photo.row_column(east, north)
    assert np.stack(back) == pytest.approx(np.stack([row, column]), abs=1e-9)
    row, column = np.array([3, 40, 80]), np.array([90, 12, 50])
    east, north = dem.east_north(row, column)
    off = known.error(east, north)
    assert dem.values[row, column] == pytest.approx(terrain.height(east - off[0], north - off[1]), abs=1e-3)
    noisy = exact.model_copy(update={"dem": exact.dem.model_copy(update={"sigma": 3.0})})
    other = make_control(FRAME, EXTENT, terrain, TEXTURE, noisy, SEED, np.random.SeedSequence(9)).dem
    assert (other.values - dem.values).std() == pytest.approx(3.0, rel=0.4)
