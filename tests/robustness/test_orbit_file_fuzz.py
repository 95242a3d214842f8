"""Truncated, mis-encoded and hostile files of a pass: orbits, attitudes, Earth orientation, ground points, maps and
image support data. They are read, or refused with the file and, where one can be told, the line; nothing else. ISD and
rational polynomials are written and never read, but an ISD is JSON that `twin.compare` and `twin.export` read.
"""

import json
import random
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from scenes.specs.measured.pass_files import GroundFileSpec, PlatformFilesSpec
from scenes.yaml.errors import InputError, Issue
from tests.robustness.mutate import BYTES, spoilt
from tests.twin import orbit_file_bench as bench
from twin.orbit.measured.ccsds import read_aem, read_oem
from twin.orbit.measured.earth_orientation import read_earth_orientation
from twin.orbit.measured.geotiff import open_raster
from twin.orbit.measured.ground_files import read_ground_points
from twin.orbit.measured.platform_files import platform_table, read_platform
from twin.orbit.measured.sp3 import read_sp3

LONGEST = 30.0
"""Seconds for one file, on a machine that has other work, too."""
CSV_CLOCK = {"frame": "ITRS", "time_scale": "UTC"}
TURN = {**CSV_CLOCK, "scalar": "last", "turns": "body_to_frame", "body_axes": bench.AXES}
DAYS = range(55620, 55632)


@cache
def contents(kind: str) -> bytes:
    """A right file of a kind, short enough to be spoilt and read thousands of times."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "file"
        match kind:
            case "sp3":
                bench.sp3(path, step=6.0)
            case "oem":
                bench.oem(path, step=6.0)
            case "aem":
                bench.aem(path, step=6.0)
            case "orbit.csv":
                bench.orbit_csv(path, step=6.0)
            case "attitude.csv":
                bench.attitude_csv(path, step=6.0)
            case "eop.csv":
                rows = [f"{day},-0.15{k:02d},0.001{k},0.323{k},0.11,-0.19" for k, day in enumerate(DAYS)]
                path.write_text("mjd,ut1_utc [s],x_pole [arcsec],y_pole [arcsec],dx [mas],dy [mas]\n" + "\n".join(rows))
            case "ground.csv":
                rows = [f"a{k},40.0{k}23456,116.0{k}23456,51{k}.34,0.5,0.5,1.0" for k in range(8)]
                path.write_text(
                    "point,latitude [deg],longitude [deg],height [m],sigma_east [m],sigma_north [m],sigma_up [m]\n"
                    + "\n".join(rows)
                )
            case "ground.gcp":
                path.write_text(
                    "\n".join(
                        f"{k} 40.0{k} 116.0{k} 51{k}.3 0.5 0.5 1.0 nadir.tif 55{k} 103{k} 0.3 0.3" for k in range(8)
                    )
                )
            case "ground.geojson":
                sigmas = {"sigma_east": 0.5, "sigma_north": 0.5, "sigma_up": 1.0, "role": "control"}
                features = [
                    {
                        "type": "Feature",
                        "id": f"a{k}",
                        "geometry": {"type": "Point", "coordinates": [116.0 + 0.01 * k, 40.0, 510.3]},
                        "properties": sigmas,
                    }
                    for k in range(6)
                ]
                path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
            case _:
                values = np.arange(24 * 20, dtype=np.uint16).reshape(24, 20)
                profile = {
                    "driver": "GTiff",
                    "height": 24,
                    "width": 20,
                    "count": 1,
                    "dtype": "uint16",
                    "crs": "EPSG:4326",
                }
                with rasterio.open(path, "w", transform=from_origin(116.0, 40.0, 1e-4, 1e-4), **profile) as map_:
                    map_.write(values, 1)
        return path.read_bytes()


def ground(path: Path) -> object:
    crs = {} if path.suffix == ".geojson" else {"crs": "EPSG:4979"}
    return read_ground_points(GroundFileSpec.model_validate({"file": path.name, **crs}), path.parent)


def platform(path: Path, turned: bool) -> object:
    """The table of a pass, one file of which is spoilt."""
    for name in ("orbit.csv", "attitude.csv"):
        other = path.parent / f"whole_{name}"
        if not other.exists():
            other.write_bytes(contents(name))
    files = {"orbit": "whole_orbit.csv", "attitude": "whole_attitude.csv", "attitude" if turned else "orbit": path.name}
    spec = PlatformFilesSpec.model_validate(
        {"orbit": {"file": files["orbit"], **CSV_CLOCK}, "attitude": {"file": files["attitude"], **TURN}}
    )
    return platform_table(*read_platform(spec, path.parent))


def raster(path: Path) -> object:
    return open_raster(path)


READERS: dict[str, Callable[[Path], object]] = {
    "sp3": lambda path: read_sp3(path, "L51"),
    "oem": read_oem,
    "aem": read_aem,
    "orbit.csv": lambda path: platform(path, turned=False),
    "attitude.csv": lambda path: platform(path, turned=True),
    "eop.csv": read_earth_orientation,
    "ground.csv": ground,
    "ground.gcp": ground,
    "ground.geojson": ground,
    "map.tif": raster,
}
NO_LINES = {"map.tif"}
"""Kinds whose files have none."""


def issues_of(work: Callable[[], object]) -> tuple[Issue, ...]:
    try:
        work()
    except InputError as error:
        return error.issues
    return ()


def spoilt_bytes(content: bytes, chance: random.Random) -> bytes:
    """A file that is no text: cut off, or with other bytes."""
    if chance.randrange(3) == 0:
        return content[: chance.randrange(len(content))]
    for _ in range(chance.choice((1, 2, 4))):
        content = chance.choice(BYTES)(content, chance)
    return content


def check(folder: Path, kind: str, count: int, seed: int) -> tuple[int, int, int]:
    """How many spoilt files were read and refused, and of these with a line."""
    content, chance = contents(kind), random.Random(seed)
    path, done = folder / f"spoilt_{kind}", [0, 0, 0]
    for k in range(count):
        path.write_bytes((spoilt_bytes if kind in NO_LINES else spoilt)(content, chance))
        begun = time.monotonic()
        issues = issues_of(lambda: READERS[kind](path))
        done[bool(issues)] += 1
        done[2] += any(issue.line for issue in issues)
        assert all(Path(issue.file).name == path.name and "\n" not in str(issue) for issue in issues), (k, issues)
        assert time.monotonic() - begun < LONGEST, k
    return done[0], done[1], done[2]


@pytest.mark.parametrize("kind", READERS)
def test_spoilt_files_of_a_pass_are_read_or_refused(tmp_path: Path, kind: str) -> None:
    read, refused, lined = check(tmp_path, kind, 40, 1)
    assert refused >= 8
    assert read + refused == 40
    assert lined or kind in NO_LINES


@pytest.mark.slow
@pytest.mark.parametrize("kind", READERS)
def test_two_thousand_spoilt_files_of_a_pass_are_read_or_refused(tmp_path: Path, kind: str) -> None:
    read, refused, lined = check(tmp_path, kind, 2000, 2)
    assert refused >= 400
    assert read >= 10
    assert lined >= 0.5 * refused or kind in NO_LINES
