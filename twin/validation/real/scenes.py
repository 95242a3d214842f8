"""Real scenes with their rigorous models, and a real orbit: published polynomials, corners and states of others."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import Array
from analysis.orbit.rational_polynomial import RationalPolynomial
from twin.framework.svg import AFTER, BEFORE, INK
from twin.orbit.export.quality_run import compare_product
from twin.orbit.export.rational_polynomial import sensor_polynomial
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.measured.orbit_files import read_oem
from twin.orbit.measured.platform_files import read_scene
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.measured_data import on_files

EFFECTS: Mapping[str, LightEffects] = {
    "rpc": NO_EFFECTS,
    "light_time": replace(NO_EFFECTS, light_time=True),
    "aberration": replace(NO_EFFECTS, aberration=True),
    "refraction": replace(NO_EFFECTS, refraction=True),
}
"""Row -> effects on the light that the rigorous model includes."""
_EPOCH = "2000-01-01T00:00:00Z"


def ground_segment_polynomials(root: ET.Element) -> RationalPolynomial:
    """Return the polynomials that a Pleiades ground segment computed of its own model; its pixels count from 1."""
    model = _found(root, "Geoposition/Rational_Sensor_Model/Global_RFM")
    row, column = (
        np.array(_text(model, f"Inverse_Model/F_{name}").split(), float).reshape(2, 20) for name in ("ROW", "COL")
    )
    axes = [_found(model, f"RFM_Validity/{name}") for name in ("Row", "Col", "Lat", "Lon", "Alt")]
    scale, offset = (np.array([float(_text(one, key)) for one in axes]) for key in "AB")
    return RationalPolynomial(offset - [1.0, 1.0, 0.0, 0.0, 0.0], scale, *row, *column)


def delivered_form(root: ET.Element) -> str:
    """Return the ground segment's model of a Pleiades scene in the elements of a delivered DIMAP 2 file."""
    model = _found(root, "Geometric_Data/Sensor_Model_Characteristics")
    size, span = _found(root, "Raster_Dimensions"), _found(model, "UTC_Sensor_Model_Range")
    points = "".join(
        f"<Point><LOCATION_XYZ>{_text(p, 'LOCATION_VALUES')}</LOCATION_XYZ>"
        f"<VELOCITY_XYZ>{_text(p, 'VELOCITY_VALUES')}</VELOCITY_XYZ><TIME>{_text(p, 'UTC_TIME')}</TIME></Point>"
        for p in model.iterfind("Sensor_Ephemeris/Point_List/Point")
    )
    attitude, viewing = _found(model, "Sensor_Attitudes"), _found(model, "Sensor_Viewing_Model")
    turns = "".join(ET.tostring(_found(attitude, f"Polynomial_Models/Q{k}"), "unicode") for k in range(4))
    looks = "".join(
        f"<{new}_{k}>{value}</{new}_{k}>"
        for old, new in (("PsiX", "XLOS"), ("PsiY", "YLOS"))
        for k, value in enumerate(_text(viewing, f"Viewing_Directions/{old}_Model/COEFFICIENTS").split())
    )
    return f"""<Dimap_Document>
      <Metadata_Identification><METADATA_FORMAT version="2.15">DIMAP</METADATA_FORMAT>
        <METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification>
      <Raster_Data><Raster_Dimensions><NROWS>{_text(size, "NROWS")}</NROWS><NCOLS>{_text(size, "NCOLS")}</NCOLS>
      </Raster_Dimensions></Raster_Data>
      <Geometric_Data><Refined_Model><Time><Time_Range><START>{_text(span, "START")}</START>
        <END>{_text(span, "END")}</END></Time_Range>
        <Time_Stamp><LINE_PERIOD unit="ms">{_text(model, "SENSOR_LINE_PERIOD")}</LINE_PERIOD></Time_Stamp></Time>
      <Ephemeris><Point_List>{points}</Point_List></Ephemeris>
      <Attitudes><Polynomial_Quaternions><OFFSET>{_text(attitude, "OFFSET")}</OFFSET>
        <SCALE>{_text(attitude, "SCALE")}</SCALE>{turns}</Polynomial_Quaternions></Attitudes>
      <Geometric_Calibration><Instrument_Calibration><Swath_Range>
        <FIRST_COL>{_text(viewing, "Position_In_Retina/FIRST_COL")}</FIRST_COL></Swath_Range>
        <Polynomial_Look_Angles>{looks}</Polynomial_Look_Angles></Instrument_Calibration></Geometric_Calibration>
      </Refined_Model></Geometric_Data></Dimap_Document>"""


def _found(element: ET.Element, path: str) -> ET.Element:
    found = element.find(path)
    if found is None:
        raise ValueError(f"the file has no element {path} below {element.tag}")
    return found


def _text(element: ET.Element, path: str) -> str:
    return _found(element, path).text or ""


def _pleiades(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    root = ET.parse(paths[0]).getroot()
    polynomials = ground_segment_polynomials(root)
    alone = 0.0
    with TemporaryDirectory() as folder:
        path = Path(folder) / "DIM_SCENE.XML"
        path.write_text(delivered_form(root), "utf-8")
        for name, effects in EFFECTS.items():
            scene = read_scene(path, None, effects)
            found = compare_product(scene.sensor, polynomials, str(path))
            alone = found.largest if name == "rpc" else alone
            implied = {"rpc": 0.0, "refraction": alone}.get(name)
            facts: dict[str, Any] = {"rms": found.rms, "mean": found.mean, "heights": found.heights}
            yield context.row(f"real.pleiades.{name}", found.largest, None, implied, **facts)


def _spot_6(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    scene = read_scene(paths[0])
    text = paths[0].read_text("latin-1")
    extent = re.search(r"<Dataset_Extent>.*?</Dataset_Extent>", text, re.DOTALL)
    height = load_printed("real").number("spot6.height_m")
    pattern = r"<LON>(.*?)</LON>\s*<LAT>(.*?)</LAT>\s*<COL>(.*?)</COL>\s*<ROW>(.*?)</ROW>"
    longitude, latitude, column, row = np.array(re.findall(pattern, extent.group() if extent else ""), float).T
    ground = scene.sensor.ground(row - 1.0, column - 1.0, height)
    stated = scene.sensor.earth.ecef(np.radians(longitude), np.radians(latitude), height)
    distance = np.linalg.norm(ground - stated, axis=1)
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
    turn, index = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), np.arange(len(time))
    errors: dict[str, tuple[Array, Array]] = {}
    for stride in STRIDES:
        kept, ends = slice(None, None, stride), time[[0, -1]]
        # interpolation does not ask for the frame
        table = PlatformTable.of(_EPOCH, time[kept], orbit.position[kept], None, ends, turn)
        trajectory = TabulatedTrajectory(table)
        halfway = (index % stride == stride // 2) & (time <= time[kept][-1])
        error = np.linalg.norm(trajectory.position(time[halfway]) - orbit.position[halfway], axis=1)
        errors[f"{stride * np.median(np.diff(time)):.0f} s"] = time[halfway], error
        if stride == STRIDES[0]:
            facts: dict[str, Any] = {"states": len(error), "method": trajectory.interpolation}
            yield context.row("real.oem.left_out", 1e3 * float(error.max()), None, 0.0, **facts)
    # one interval from the ends, where the prediction holds
    measured = 1e3 * float(np.sqrt(np.mean(error[1:-1] ** 2)))
    yield context.row("real.oem.predicted", measured, None, 1e3 * trajectory.interpolation_error)
    context.figure("orbit", orbit_svg(errors))


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the rows on rigorous models and orbits."""
    yield from on_files(context, "real.pleiades", "pleiades/PHRDIMAP*.XML", _pleiades)
    yield from on_files(context, "real.spot6", "spot6/SPOT6.XML", _spot_6)
    yield from on_files(context, "real.oem", "oem/*.oem", _orbit)


GROUP = group_of("real.scenes", run)
