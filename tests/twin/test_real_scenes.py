"""Files of real scenes that other projects publish: SPOT 6 as delivered, Pléiades as its ground segment writes it.

They are read from ../shared/real beside a checkout or from the folder that TWIN_REAL names, and are no part of this
project: SPOT6.XML of SaifAati/Geospatial-COSICorr3D (tests/test_dataset), a Pléiades 1B scene of CNES/shareloc
(tests/data/rpc).
"""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from twin.orbit.export.quality_run import compare_product
from twin.orbit.export.rational_polynomial import sensor_polynomial
from twin.orbit.measured.platform_files import read_scene
from twin.orbit.measured.xml_file import read_xml
from twin.validation.real.scenes import delivered_form, ground_segment_polynomials

REAL = Path(os.environ.get("TWIN_REAL", Path(__file__).parents[3] / "shared" / "real"))
needed = pytest.mark.skipif(
    not REAL.is_dir(), reason="real data are read from ../shared/real beside a checkout, or the folder TWIN_REAL names"
)


@needed
def test_spot_6_lies_where_its_file_says() -> None:
    """Ephemeris and attitude begin and end with the image. Four corners and the middle stand in the file, at the one
    height of the ground that they were computed with."""
    path = REAL / "spot6" / "SPOT6.XML"
    scene = read_scene(path)
    extent = re.search(r"<Dataset_Extent>.*?</Dataset_Extent>", path.read_text("latin-1"), re.DOTALL)
    assert extent is not None
    found = re.findall(r"<LON>(.*?)</LON>\s*<LAT>(.*?)</LAT>\s*<COL>(.*?)</COL>\s*<ROW>(.*?)</ROW>", extent.group())
    longitude, latitude, column, row = np.array(found, float).T
    assert len(row) == 5
    ground = scene.sensor.ground(row - 1.0, column - 1.0, 840.0)
    told = scene.sensor.earth.ecef(np.radians(longitude), np.radians(latitude), 840.0)
    assert np.linalg.norm(ground - told, axis=1).max() < 1.0
    model = sensor_polynomial(scene.sensor, 0, scene.read.pixels, (500.0, 1200.0))
    assert max(model.error_px) < 2.5e-3
    assert not scene.read.inertial_velocity


@pytest.mark.second
@needed
def test_a_pleiades_scene_meets_its_own_polynomials(tmp_path: Path) -> None:
    """The ground segment's numbers in the elements of DIMAP 2: velocities are against the stars, and polynomials hold
    from 160 to 240 m."""
    folder = REAL / "pleiades"
    root = read_xml(next(folder.glob("PHRDIMAP*.XML")), "a scene")
    path = tmp_path / "DIM_SCENE.XML"
    path.write_text(delivered_form(root))
    scene = read_scene(path)
    assert scene.read.inertial_velocity
    found = compare_product(scene.sensor, ground_segment_polynomials(root), str(path))
    assert found.heights == (160.0, 240.0)
    # the fit of the polynomials themselves: 0.0104 px by the product
    assert found.largest < 0.0125
