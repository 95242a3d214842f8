"""The ten-line examples of docs/orbit_files.md are files that can be read."""

import re
from pathlib import Path

import numpy as np
import pytest

from scenes.specs.orbit.measurements import GroundFileSpec, PlatformFilesSpec
from twin.orbit.flight.earth import Earth
from twin.orbit.measured.earth_orientation import read_earth_orientation
from twin.orbit.measured.ground_files import read_ground_points
from twin.orbit.measured.platform_files import platform_table, read_platform

PAGE = Path(__file__).resolve().parents[2] / "docs/orbit_files.md"
BLOCKS = re.findall(r"^```csv\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
assert len(BLOCKS) == 8  # and all are read here
GPS = {"frame": "ITRS", "time_scale": "GPS"}
TURN = {"scalar": "last", "turns": "body_to_frame", "body_axes": ["forward", "right", "down"]}
ANGLES = {"sequence": "xyz", "nadir": "geodetic", "steering": "yaw", "body_axes": ["forward", "right", "down"]}


def block(start: str) -> str:
    (found,) = [text for text in BLOCKS if text.startswith(start)]
    return found


@pytest.mark.parametrize("orbit", ["CCSDS_OEM", "date_time,x"])
@pytest.mark.parametrize("attitude", ["date_time,q1", "date_time,roll"])
def test_orbits_and_attitudes(tmp_path: Path, orbit: str, attitude: str) -> None:
    """The same pass at 500 km in an inertial and in the Earth-fixed frame; the attitude has a second of it."""
    (tmp_path / "orbit").write_text(block(orbit))
    (tmp_path / "attitude").write_text(block(attitude))
    flown = {"file": "orbit"} if orbit == "CCSDS_OEM" else {"file": "orbit", **GPS, "offset": "15 s"}
    turned = {"file": "attitude", "time_scale": "UTC", **(TURN if "q1" in attitude else ANGLES)}
    turned["frame"] = "ITRS" if "q1" in attitude else "orbital"
    earth = {"ut1_utc": "-0.1523 s"}
    spec = PlatformFilesSpec.model_validate({"orbit": flown, "attitude": turned, "earth": earth})
    table = platform_table(*read_platform(spec, tmp_path))
    height = Earth().geodetic(table.position)[2]
    assert np.all(np.abs(height - 505e3) < 5e3)
    assert np.all(np.abs(np.linalg.norm(table.velocity, axis=1) - 7650.0) < 200.0)
    np.testing.assert_allclose(np.diff(table.orbit_time), 1.0, rtol=0, atol=1e-9)


def test_earth_orientation(tmp_path: Path) -> None:
    (tmp_path / "eop.csv").write_text(block("mjd"))
    assert len(read_earth_orientation(tmp_path / "eop.csv").mjd) == 4


def test_ground_points(tmp_path: Path) -> None:
    for name, start in (("g.csv", "point,lat"), ("g.gcp", "1 40"), ("g.geojson", '{"type"')):
        (tmp_path / name).write_text(block(start))
        crs = {} if name == "g.geojson" else {"crs": "EPSG:4979"}
        found = read_ground_points(GroundFileSpec.model_validate({"file": name, **crs}), tmp_path)
        lon, lat, height = Earth().geodetic(found.points.itrs[0])
        np.testing.assert_allclose(np.degrees([lon, lat]), [116.0123456, 40.0123456], rtol=0, atol=1e-10)
        assert float(height) == pytest.approx(512.34, abs=1e-6)
