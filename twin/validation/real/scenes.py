"""Real scenes with their rigorous models, and a real orbit: published polynomials, corners and states of others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import Array
from analysis.orbit.rational_polynomial import RationalPolynomial
from analysis.statistics import rms
from twin.framework.svg import AFTER, BEFORE, INK
from twin.orbit.export.quality_run import compare_product
from twin.orbit.export.rational_polynomial import read_rpc, sensor_polynomial
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects
from twin.orbit.measured.orbit_files import read_oem
from twin.orbit.measured.platform_files import read_scene
from twin.orbit.measured.xml_file import Element, read_xml
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.measured_data import on_files
from twin.validation.row_names import REAL

EFFECTS: Mapping[str, LightEffects] = {
    "rpc": NO_EFFECTS,
    "light_time": replace(NO_EFFECTS, light_time=True),
    "aberration": replace(NO_EFFECTS, aberration=True),
    "refraction": replace(NO_EFFECTS, refraction=True),
}
"""Row -> effects on the light that the rigorous model includes."""
_EPOCH = "2000-01-01T00:00:00Z"


def ground_segment_polynomials(root: Element) -> RationalPolynomial:
    """Return the polynomials that a Pleiades ground segment computed of its own model; its pixels count from 1."""
    model = root.single("Geoposition", "Rational_Sensor_Model", "Global_RFM")
    row, column = (model.single("Inverse_Model", f"F_{name}").floats(40).reshape(2, 20) for name in ("ROW", "COL"))
    axes = [model.single("RFM_Validity", name) for name in ("Row", "Col", "Lat", "Lon", "Alt")]
    scale, offset = (np.array([axis.number(key) for axis in axes]) for key in "AB")
    return RationalPolynomial(offset - [1.0, 1.0, 0.0, 0.0, 0.0], scale, *row, *column)


def delivered_form(root: Element) -> str:
    """Return the ground segment's model of a Pleiades scene in the elements of a delivered DIMAP 2 file."""
    model = root.single("Geometric_Data", "Sensor_Model_Characteristics")
    size, span = root.single("Raster_Dimensions"), model.single("UTC_Sensor_Model_Range")
    points = "".join(
        f"<Point><LOCATION_XYZ>{point.words('LOCATION_VALUES')}</LOCATION_XYZ>"
        f"<VELOCITY_XYZ>{point.words('VELOCITY_VALUES')}</VELOCITY_XYZ><TIME>{point.words('UTC_TIME')}</TIME></Point>"
        for point in model.all("Sensor_Ephemeris", "Point_List", "Point")
    )
    attitude, viewing = model.single("Sensor_Attitudes"), model.single("Sensor_Viewing_Model")
    quaternions = "".join(
        f"<Q{k}><DEGREE>{part.words('DEGREE')}</DEGREE><COEFFICIENTS>{part.words('COEFFICIENTS')}</COEFFICIENTS></Q{k}>"
        for k, part in enumerate(attitude.single("Polynomial_Models", f"Q{k}") for k in range(4))
    )
    looks = "".join(
        f"<{new}_{k}>{value}</{new}_{k}>"
        for old, new in (("PsiX", "XLOS"), ("PsiY", "YLOS"))
        for k, value in enumerate(viewing.words("Viewing_Directions", f"{old}_Model", "COEFFICIENTS").split())
    )
    return f"""<Dimap_Document>
      <Metadata_Identification><METADATA_FORMAT version="2.15">DIMAP</METADATA_FORMAT>
        <METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification>
      <Raster_Data><Raster_Dimensions><NROWS>{size.words("NROWS")}</NROWS><NCOLS>{size.words("NCOLS")}</NCOLS>
      </Raster_Dimensions></Raster_Data>
      <Geometric_Data><Refined_Model><Time><Time_Range><START>{span.words("START")}</START>
        <END>{span.words("END")}</END></Time_Range>
        <Time_Stamp><LINE_PERIOD unit="ms">{model.words("SENSOR_LINE_PERIOD")}</LINE_PERIOD></Time_Stamp></Time>
      <Ephemeris><Point_List>{points}</Point_List></Ephemeris>
      <Attitudes><Polynomial_Quaternions><OFFSET>{attitude.words("OFFSET")}</OFFSET>
        <SCALE>{attitude.words("SCALE")}</SCALE>{quaternions}</Polynomial_Quaternions></Attitudes>
      <Geometric_Calibration><Instrument_Calibration><Swath_Range>
        <FIRST_COL>{viewing.words("Position_In_Retina", "FIRST_COL")}</FIRST_COL></Swath_Range>
        <Polynomial_Look_Angles>{looks}</Polynomial_Look_Angles></Instrument_Calibration></Geometric_Calibration>
      </Refined_Model></Geometric_Data></Dimap_Document>"""


def _pleiades(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    root = read_xml(paths[0], "the metadata of a Pleiades scene")
    polynomials = ground_segment_polynomials(root)
    alone = 0.0
    with TemporaryDirectory() as folder:
        path = Path(folder) / "DIM_SCENE.XML"
        path.write_text(delivered_form(root), "utf-8")
        for name, effects in EFFECTS.items():
            scene = read_scene(path, None, effects)
            difference = compare_product(scene.sensor, polynomials, str(path))
            alone = difference.largest if name == "rpc" else alone
            implied = {"rpc": 0.0, "refraction": alone}.get(name)
            facts: dict[str, Any] = {"rms": difference.rms, "mean": difference.mean, "heights": difference.heights}
            yield context.row(f"real.pleiades.{name}", difference.largest, None, implied, **facts)


def _rpcm(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    printed = load_printed(REAL).content.data["rpcm"]
    keys = ("latitude", "longitude", "height")
    latitude, longitude, height = (np.array(printed[key], np.float64) for key in keys)
    largest = 0.0
    for path in paths:
        there = np.array(printed[path.stem], np.float64).reshape(-1, 2)
        here = np.stack(read_rpc(path).image(latitude, longitude, height), axis=-1)
        largest = max(largest, float(np.abs(here - there).max()))
    yield context.row("real.rpcm.projection", largest, None, 0.0, images=len(paths))


def _spot_6(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    scene = read_scene(paths[0])
    height = load_printed(REAL).number("spot6.height_m")
    (extent,) = read_xml(paths[0], "the metadata of a SPOT 6 scene").iter("Dataset_Extent")
    points = (*extent.all("Vertex"), extent.single("Center"))
    keys = ("LON", "LAT", "COL", "ROW")
    longitude, latitude, column, row = np.array([[point.number(key) for key in keys] for point in points]).T
    ground = scene.sensor.ground(row - 1.0, column - 1.0, height)
    corners = scene.sensor.earth.ecef(np.radians(longitude), np.radians(latitude), height)
    distance = np.linalg.norm(ground - corners, axis=1)
    yield context.row("real.spot6.corners", float(distance.max()), None, 0.0, distance=distance)
    model = sensor_polynomial(scene.sensor, 0, scene.read.pixels, (height - 350.0, height + 350.0))
    yield context.row("real.spot6.model", float(max(model.error_px)), None, 0.0)


STRIDES = (2, 6, 12)
"""Numbers of states of which one is kept, for the interpolation between the kept ones."""


@drawing("real-orbit", 3.0)
def orbit_svg(figure: Figure, errors: Mapping[str, tuple[Array, Array]]) -> None:
    """Draw the interpolation error at the states halfway between those that were kept."""
    axes = figure.subplots()
    for (name, (time, error)), colour in zip(errors.items(), (AFTER, INK, BEFORE), strict=True):
        axes.semilogy(time / 60.0, 1e3 * np.maximum(error, 1e-9), color=colour, lw=1.0, label=f"a state every {name}")
    axes.set(xlabel="time [min]", ylabel="error of position [mm]")
    axes.legend()


def _orbit(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    orbit = read_oem(paths[0])
    time = np.asarray(orbit.clock.second - orbit.clock.second[0], np.float64)
    attitude, index = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), np.arange(len(time))
    errors: dict[str, tuple[Array, Array]] = {}
    for stride in STRIDES:
        kept, ends = slice(None, None, stride), time[[0, -1]]
        # interpolation does not ask for the frame
        table = PlatformTable.of(_EPOCH, time[kept], orbit.position[kept], None, ends, attitude)
        trajectory = TabulatedTrajectory(table)
        halfway = (index % stride == stride // 2) & (time <= time[kept][-1])
        error = np.linalg.norm(trajectory.position(time[halfway]) - orbit.position[halfway], axis=1)
        errors[f"{stride * np.median(np.diff(time)):.0f} s"] = time[halfway], error
        if stride == STRIDES[0]:
            facts: dict[str, Any] = {"states": len(error), "method": trajectory.interpolation}
            yield context.row("real.oem.left_out", 1e3 * float(error.max()), None, 0.0, **facts)
    # one interval from the ends, where the prediction holds
    measured = 1e3 * rms(error[1:-1])
    yield context.row("real.oem.predicted", measured, None, 1e3 * trajectory.interpolation_error)
    context.figure("orbit", orbit_svg(errors))


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the rows on rigorous models and orbits."""
    yield from on_files(context, "real.pleiades", "pleiades/PHRDIMAP*.XML", _pleiades)
    yield from on_files(context, "real.rpcm", "s2p_triplet/img_0[1-3].tif", _rpcm)
    yield from on_files(context, "real.spot6", "spot6/SPOT6.XML", _spot_6)
    yield from on_files(context, "real.oem", "oem/*.oem", _orbit)


GROUP = group_of("real.scenes", run)
