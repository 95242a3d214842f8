"""Files of real scenes that other projects publish: SPOT 6 as delivered, Pléiades as its ground segment writes it.

They are read from ../shared/real beside a checkout or from the folder that TWIN_REAL names, and are no part of this
project: SPOT6.XML of SaifAati/Geospatial-COSICorr3D (tests/test_dataset), a Pléiades 1B scene of CNES/shareloc
(tests/data/rpc).
"""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from analysis.orbit.rational_polynomial import RationalPolynomial
from twin.orbit.export.quality_run import compare_product
from twin.orbit.export.rational_polynomial import sensor_polynomial
from twin.orbit.measured.platform_files import read_scene

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


def polynomials(root: ET.Element) -> RationalPolynomial:
    """The ground segment's polynomials of the same file; rows and columns count from 1."""
    model = root.find("Geoposition/Rational_Sensor_Model/Global_RFM")
    row, column = (
        np.array(model.findtext(f"Inverse_Model/F_{name}").split(), float).reshape(2, 20) for name in ("ROW", "COL")
    )
    axes = [model.find(f"RFM_Validity/{name}") for name in ("Row", "Col", "Lat", "Lon", "Alt")]
    scale, offset = (np.array([float(one.findtext(key)) for one in axes]) for key in "AB")
    return RationalPolynomial(offset - [1.0, 1.0, 0.0, 0.0, 0.0], scale, *row, *column)


@pytest.mark.second
@needed
def test_a_pleiades_scene_meets_its_own_polynomials(tmp_path: Path) -> None:
    """The ground segment's numbers in the elements of DIMAP 2: velocities are against the stars, and polynomials hold
    from 160 to 240 m."""
    folder = REAL / "pleiades"
    root = ET.parse(next(folder.glob("PHRDIMAP*.XML"))).getroot()
    model = root.find("Geometric_Data/Sensor_Model_Characteristics")
    size, span = root.find("Raster_Dimensions"), model.find("UTC_Sensor_Model_Range")
    points = "".join(
        f"<Point><LOCATION_XYZ>{p.findtext('LOCATION_VALUES')}</LOCATION_XYZ>"
        f"<VELOCITY_XYZ>{p.findtext('VELOCITY_VALUES')}</VELOCITY_XYZ><TIME>{p.findtext('UTC_TIME')}</TIME></Point>"
        for p in model.iterfind("Sensor_Ephemeris/Point_List/Point")
    )
    attitude = model.find("Sensor_Attitudes")
    turns = "".join(ET.tostring(attitude.find(f"Polynomial_Models/Q{k}"), "unicode") for k in range(4))
    viewing = model.find("Sensor_Viewing_Model")
    looks = "".join(
        f"<{new}_{k}>{value}</{new}_{k}>"
        for old, new in (("PsiX", "XLOS"), ("PsiY", "YLOS"))
        for k, value in enumerate(viewing.findtext(f"Viewing_Directions/{old}_Model/COEFFICIENTS").split())
    )
    path = tmp_path / "DIM_SCENE.XML"
    path.write_text(f"""<Dimap_Document>
      <Metadata_Identification><METADATA_FORMAT version="2.15">DIMAP</METADATA_FORMAT>
        <METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification>
      <Raster_Data><Raster_Dimensions><NROWS>{size.findtext("NROWS")}</NROWS><NCOLS>{size.findtext("NCOLS")}</NCOLS>
      </Raster_Dimensions></Raster_Data>
      <Geometric_Data><Refined_Model><Time><Time_Range><START>{span.findtext("START")}</START>
        <END>{span.findtext("END")}</END></Time_Range>
        <Time_Stamp><LINE_PERIOD unit="ms">{model.findtext("SENSOR_LINE_PERIOD")}</LINE_PERIOD></Time_Stamp></Time>
      <Ephemeris><Point_List>{points}</Point_List></Ephemeris>
      <Attitudes><Polynomial_Quaternions><OFFSET>{attitude.findtext("OFFSET")}</OFFSET>
        <SCALE>{attitude.findtext("SCALE")}</SCALE>{turns}</Polynomial_Quaternions></Attitudes>
      <Geometric_Calibration><Instrument_Calibration><Swath_Range>
        <FIRST_COL>{viewing.findtext("Position_In_Retina/FIRST_COL")}</FIRST_COL></Swath_Range>
        <Polynomial_Look_Angles>{looks}</Polynomial_Look_Angles></Instrument_Calibration></Geometric_Calibration>
      </Refined_Model></Geometric_Data></Dimap_Document>""")
    scene = read_scene(path)
    assert scene.read.inertial_velocity
    found = compare_product(scene.sensor, polynomials(root), str(path))
    assert found.heights == (160.0, 240.0)
    # the fit of the polynomials themselves: 0.0104 px by the product
    assert found.largest < 0.0125
