"""Ground points and maps from files: systems, geoids, covariances, what is refused; what is written comes back."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from scenes.specs.orbit.measurements import GroundFileSpec, RasterFileSpec
from scenes.yaml.errors import Problem
from tests.twin import orbit_file_bench as bench
from twin.framework.data_files import tiff
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.ground.grid import GroundFrame
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images.simulate_report import map_facts
from twin.orbit.measured.ground_files import GroundFile, read_ground_points
from twin.orbit.measured.maps import Geoid, UserMap

HEADS = ("point", "latitude [deg]", "longitude [deg]", "height [m]")
SIGMAS = ("sigma_east [m]", "sigma_north [m]", "sigma_up [m]")
PLACES = np.array([[116.0, 40.0, 100.0], [-70.25, -33.5, 2500.0], [179.9999, 0.001, -20.0]])


def read(folder: Path, **said: Any) -> GroundFile:
    return read_ground_points(GroundFileSpec.model_validate(said), folder)


def table(folder: Path, rows: np.ndarray = PLACES, heads: tuple[str, ...] = HEADS) -> None:
    names = [f"p{k}" for k in range(len(rows))]
    bench.csv(folder / "g.csv", heads, names, *(map(repr, map(float, rows[:, k])) for k in (1, 0, 2)))


def exact(rows: np.ndarray = PLACES) -> np.ndarray:
    return Earth().ecef(*np.radians(rows[:, :2]).T, rows[:, 2])


def test_geodetic_places_in_every_form_are_the_same(tmp_path: Path) -> None:
    """PROJ's and our own formula of the ellipsoid differ by rounding of the longitude, 4e-16 of 6378 km."""
    table(tmp_path)
    features = [
        {"type": "Feature", "id": f"p{k}", "properties": None, "geometry": {"type": "Point", "coordinates": list(row)}}
        for k, row in enumerate(PLACES.tolist())
    ]
    (tmp_path / "g.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    lines = [f"p{k} {row[1]!r} {row[0]!r} {row[2]!r} 1 2 3" for k, row in enumerate(PLACES.tolist())]
    (tmp_path / "g.gcp").write_text("# id lat lon height sigmas\n" + "\n".join(lines) + "\n")
    xyz = [f"p{k},{','.join(map(repr, map(float, row)))}" for k, row in enumerate(exact())]
    (tmp_path / "x.csv").write_text("point,x [m],y [m],z [m]\n" + "\n".join(xyz))
    sigma = {"sigma": ["1 m", "2 m"]}
    for said in (
        {"file": "g.csv", "crs": "EPSG:4979", **sigma},
        {"file": "g.csv", "crs": "EPSG:4326", "heights": "ellipsoid", **sigma},
        {"file": "g.geojson", **sigma},
        {"file": "g.gcp", "crs": "EPSG:4979"},
        {"file": "x.csv", "crs": "EPSG:4978", **sigma},
    ):
        found = read(tmp_path, **said)
        assert list(found.points.ids) == ["p0", "p1", "p2"]
        np.testing.assert_allclose(found.points.itrs, exact(), rtol=0, atol=5e-9)


def test_a_projected_system_and_cgcs2000(tmp_path: Path) -> None:
    """UTM by PROJ's own forward formula; CGCS2000's ellipsoid is 0.1 mm smaller at the poles than that of WGS 84."""
    import pyproj

    rows = PLACES[:1]
    east, north = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32650", always_xy=True).transform(*rows[0, :2])
    heads = ("point", "east [m]", "north [m]", "height [m]")
    bench.csv(tmp_path / "g.csv", heads, ["a"], [repr(east)], [repr(north)], [100.0])
    found = read(tmp_path, file="g.csv", crs="EPSG:32650", heights="ellipsoid", sigma=["1 m", "1 m"])
    np.testing.assert_allclose(found.points.itrs, exact(rows), rtol=0, atol=1e-7)
    table(tmp_path, rows)
    found = read(tmp_path, file="g.csv", crs="EPSG:4490", heights="ellipsoid", sigma=["1 m", "1 m"])
    np.testing.assert_allclose(found.points.itrs, exact(rows), rtol=0, atol=2e-4)
    found = read(tmp_path, file="g.csv", crs="EPSG:4269", heights="ellipsoid", sigma=["1 m", "1 m"])
    assert found.accuracy is not None
    assert found.accuracy >= 1.0  # NAD83: PROJ says itself that it is good to metres only


def test_covariances_stand_along_the_axes_that_are_said(tmp_path: Path) -> None:
    rows = np.array([["a", 40.0, 116.0, 0.0, 1.0, 2.0, 3.0]], object)
    bench.csv(tmp_path / "g.csv", (*HEADS, *SIGMAS), *rows.T)
    points = read(tmp_path, file="g.csv", crs="EPSG:4979").points
    axes = east_north_up(np.radians(116.0), np.radians(40.0))
    np.testing.assert_allclose(axes @ points.covariance[0] @ axes.T, np.diag([1.0, 4.0, 9.0]), rtol=0, atol=1e-12)
    (tmp_path / "g.gcp").write_text("5, 40, 116, 0, 1, 2, 3, image1.tif, 124.5, 19.7, 0.3, 0.4\n")
    found = read(tmp_path, file="g.gcp", crs="EPSG:4979")
    np.testing.assert_allclose(found.points.covariance[0], np.diag([1.0, 4.0, 9.0]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.images["image1.tif"], [[0, 19.7, 124.5, 0.4, 0.3]])
    level = read(tmp_path, file="g.gcp", crs="EPSG:4979", sigma_axes="enu").points
    np.testing.assert_allclose(level.covariance, points.covariance, rtol=0, atol=1e-12)


@pytest.mark.parametrize("ending", ["tif", "gtx"])
def test_heights_above_a_geoid(tmp_path: Path, ending: str) -> None:
    """Bilinear between whole degrees, by the formula; across the date line. Single precision: 4e-6 m."""
    values = (0.1 * np.arange(181.0)[:, None] - 20.0 * np.cos(np.radians(np.arange(360.0) - 180.0))[None]).astype("f4")
    how = {"driver": "GTX" if ending == "gtx" else "GTiff", "width": 360, "height": 181, "count": 1, "dtype": "float32"}
    with rasterio.open(
        tmp_path / f"n.{ending}", "w", crs="EPSG:4326", transform=from_origin(-180.5, 90.5, 1.0, 1.0), **how
    ) as file:
        file.write(values, 1)
    table(tmp_path)
    said = {"file": "g.csv", "crs": "EPSG:4326", "heights": "geoid", "geoid": f"n.{ending}", "sigma": ["1 m", "1 m"]}
    height = Earth().geodetic(read(tmp_path, **said).points.itrs)[2]
    lon, lat = PLACES[:, 0], PLACES[:, 1]
    low = np.floor(lon)
    east = -20.0 * ((low + 1.0 - lon) * np.cos(np.radians(low)) + (lon - low) * np.cos(np.radians(low + 1.0)))
    np.testing.assert_allclose(height - PLACES[:, 2], 0.1 * (90.0 - lat) + east, rtol=0, atol=1e-5)


def test_a_geoid_of_a_region_reaches_to_its_outermost_nodes(tmp_path: Path) -> None:
    """Its values at all nodes, bilinear between them, and no place beyond them."""
    values = np.random.default_rng(2).uniform(-40.0, 40.0, (3, 5)).astype("f4")
    how = {"driver": "GTiff", "width": 5, "height": 3, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(tmp_path / "n.tif", "w", transform=from_origin(9.75, 51.25, 0.5, 0.5), **how) as file:
        file.write(values, 1)
    geoid = Geoid.read(tmp_path / "n.tif")
    lon, lat = np.meshgrid(10.0 + 0.5 * np.arange(5), 51.0 - 0.5 * np.arange(3))
    np.testing.assert_allclose(geoid(lon, lat), values, rtol=0, atol=1e-5)
    np.testing.assert_allclose(geoid(lon - 360.0, lat), values, rtol=0, atol=1e-5)
    assert geoid([11.75], [50.75]) == pytest.approx(np.mean(values[:2, 3:]), abs=1e-5)
    for away in ((9.999, 50.5), (12.001, 50.5), (11.0, 51.001), (11.0, 49.999)):
        with pytest.raises(Problem, match="outside the grid of the geoid"):
            geoid(*away)


# --- maps -------------------------------------------------------------------------------------------------

FRAME = GroundFrame(np.radians(116.0), np.radians(40.0))


def raster(spacing: float = 10.0) -> Raster:
    rng = np.random.default_rng(3)
    return Raster(rng.uniform(0.0, 900.0, (60, 80)).astype(np.float32), FRAME, -395.0, 290.0, spacing)


def utm(path: Path, nodata: float | None = None) -> np.ndarray:
    values = np.random.default_rng(4).uniform(10.0, 500.0, (120, 150)).astype("f4")
    if nodata is not None:
        values[20:40, 30:50] = nodata
    how = {"driver": "GTiff", "width": 150, "height": 120, "count": 1, "dtype": "float32", "crs": "EPSG:32650"}
    place = from_origin(499_000.0, 4_429_000.0, 20.0, 20.0)
    with rasterio.open(path, "w", transform=place, nodata=nodata, **how) as file:
        file.write(values, 1)
    return values


def test_a_map_that_is_written_comes_back(tmp_path: Path) -> None:
    """Values bit for bit, places to rounding of degrees: 1e-7 m."""
    here = raster()
    (tmp_path / "dem.tiff").write_bytes(tiff(here.values[None], map_facts(here, "heights", heights=True)))
    with rasterio.open(tmp_path / "dem.tiff") as file:
        assert np.array_equal(file.read(1), here.values)
        assert file.crs.to_epsg() == 4979
    there = UserMap.open(RasterFileSpec.model_validate({"file": "dem.tiff"}), tmp_path, heights=True)
    part = there.part(FRAME, (-5000.0, 5000.0, -5000.0, 5000.0), heights=True)
    assert np.array_equal(part.values, here.values)
    assert part.valid is None
    row, column = np.meshgrid(np.linspace(0, 59, 5), np.linspace(0, 79, 5))
    np.testing.assert_allclose(part.east_north(row, column), here.east_north(row, column), rtol=0, atol=1e-7)
    np.testing.assert_allclose(part.row_column(*here.east_north(row, column)), [row, column], rtol=0, atol=1e-8)
    assert part.spacing == pytest.approx(10.0, rel=1e-3)


def test_a_projected_map_keeps_its_pixels_and_its_gaps(tmp_path: Path) -> None:
    values = utm(tmp_path / "utm.tif", nodata=-9999.0)
    spec = RasterFileSpec.model_validate({"file": "utm.tif", "heights": "ellipsoid"})
    user = UserMap.open(spec, tmp_path, heights=True)
    import pyproj

    lon, lat = pyproj.Transformer.from_crs("EPSG:32650", "EPSG:4326", always_xy=True).transform(500_000.0, 4_428_000.0)
    frame = GroundFrame(np.radians(lon), np.radians(lat))
    part = user.part(frame, (-400.0, 500.0, -300.0, 600.0), heights=True)
    first = part.first
    assert first[0] > 0
    assert first[1] > 0
    rows, columns = part.values.shape
    np.testing.assert_array_equal(part.values, values[first[0] : first[0] + rows, first[1] : first[1] + columns])
    assert part.valid is not None
    # the middle of the frame is the corner of four pixels, 50 columns and rows from the map's
    np.testing.assert_allclose(
        np.add(part.row_column(np.zeros(1), np.zeros(1)), np.array(first)[:, None]), 49.5, rtol=0, atol=1e-6
    )
    grey = user.part(frame, (-400.0, 500.0, -300.0, 600.0))
    assert np.array_equal(np.isnan(grey.values), ~part.valid)
    # a map of which parts are read needs memory for the part alone
    assert part.values.size < values.size


def test_the_header_of_a_gcp_file_is_its_system(tmp_path: Path) -> None:
    """`# WKT:` as the Ames Stereo Pipeline writes it: latitude, longitude, height above its datum."""
    import pyproj

    row = "5, 40, 116, 100, 1, 2, 3, image1.tif, 124.5, 19.7, 0.3, 0.4\n"
    (tmp_path / "plain.gcp").write_text(row)
    (tmp_path / "g.gcp").write_text(f"# WKT: {pyproj.CRS('EPSG:4326').to_wkt('WKT1_GDAL')}\n# id lat lon ...\n{row}")
    plain = read(tmp_path, file="plain.gcp", crs="EPSG:4979").points
    for more in ({}, {"crs": "EPSG:4326"}):
        assert read(tmp_path, file="g.gcp", **more).points.itrs == pytest.approx(plain.itrs, abs=1e-6)
