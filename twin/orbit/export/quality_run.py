"""The worth of exported models: errors on the ground, polynomials after control, a product's own polynomials.

Rational polynomials that come alone, without a rigorous model, corrected by control points.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from analysis.orbit.image_correction import LEAST_POINTS
from analysis.orbit.rational_polynomial import RationalPolynomial
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue, names_text
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.artefact import Table
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, answer
from twin.orbit.export.export_report import CONTROL, FOLDER, control_section, quality_answers, quality_warnings
from twin.orbit.export.export_run import (
    Controlled,
    ControlPoints,
    Export,
    ExportedLine,
    ProductPolynomial,
    Quality,
    SceneSource,
    no_bands,
)
from twin.orbit.export.ground_accuracy import AccuracyMap, CameraUncertainty, maps_of
from twin.orbit.export.rational_polynomial import controlled, is_rpc, polynomial_correction, read_rpc
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.platform_files import DimapScene

_COMPARED = (15, 15, 3)
"""Lines, pixels and heights at which polynomials are compared."""


def with_quality(run: Export, uncertainty: CameraUncertainty | None, points: ControlPoints | None) -> Export:
    """The export with what was asked for: corrected polynomials, ERR_BIAS and ERR_RAND in them, notes in the ISD.

    Parameters
    ----------
    run : Export
        Its models.
    uncertainty : CameraUncertainty | None
        Of camera and way; None for no map.
    points : ControlPoints | None
        That correct the polynomials; None for none.

    Raises
    ------
    InputError
        Control points that are of none of the images, or do not determine a correction.
    """
    lines = dict(run.lines)
    products = _products(run, run.source.scene) if isinstance(run.source, SceneSource) else {}
    control = {} if points is None else _controlled(points, lines)
    for name, one in control.items():
        lines[name] = replace(lines[name], polynomial=one.after)
    maps: Mapping[str, AccuracyMap] = {}
    if uncertainty is not None:
        places = {n: (x.window.sensor, x.window.first_pixel, x.window.pixels) for n, x in lines.items()}
        maps = maps_of(places, uncertainty, run.heights[1])
        lines = {name: _with_errors(line, maps[name], name in control) for name, line in lines.items()}
    return replace(run, lines=FrozenMap(lines), quality=Quality(FrozenMap(maps), FrozenMap(control), products))


def _with_errors(line: ExportedLine, found: AccuracyMap, is_controlled: bool) -> ExportedLine:
    """A line whose models state its errors. What control points determine is not what camera and way leave open."""
    polynomial, (bias, random) = line.polynomial, found.horizontal()
    if polynomial is not None and not is_controlled:
        old = (polynomial.bias_m or 0.0, polynomial.random_m or 0.0)
        polynomial = replace(polynomial, bias_m=float(np.hypot(bias, old[0])), random_m=float(np.hypot(random, old[1])))
    worst = np.nanargmax(found.ce90)
    (a, b), (_, c) = found.covariance[worst, :2, :2]
    notes = (
        f"on ground {found.height:.0f} m high points have CE90 up to {found.ce90[worst]:.4g} m, of camera, orbit "
        f"and attitude; covariance there, east east, east north, north north: {a:.6g} {b:.6g} {c:.6g} m^2",
        f"of it in common to all points {bias:.4g} m, of measured places {random:.4g} m: root mean square of a "
        "horizontal axis over the image",
    )
    isd = {**line.scanner.isd, "notes": [*line.scanner.isd["notes"], *notes]}
    return replace(line, polynomial=polynomial, scanner=replace(line.scanner, isd=FrozenMap(isd)))


def _controlled(control: ControlPoints, lines: Mapping[str, ExportedLine]) -> dict[str, Controlled]:
    """Line -> its polynomials after control."""
    found: dict[str, Controlled] = {}
    for name, line in lines.items():
        if line.polynomial is not None:
            one = controlled_line(control, name, line.polynomial, len(lines) == 1)
            found |= {} if one is None else {name: one}
    if not found:
        problem, allowed = "no control point is in one of the images", names_text(f"{name}.tif" for name in lines)
        raise InputError(Issue(problem, control.file, None, (), names_text(control.read.images), allowed))
    return found


def controlled_line(
    control: ControlPoints, name: str, polynomial: RationalPolynomial, alone: bool
) -> Controlled | None:
    """Polynomials of an image after control; None where no point is in it.

    Parameters
    ----------
    control : ControlPoints
        Points with their places in images.
    name : str
        Of the image, without its ending.
    polynomial : RationalPolynomial
        Of it.
    alone : bool
        Whether it is the only one, whatever the points' only image is called.

    Raises
    ------
    InputError
        Points that do not determine a correction.
    """
    images = control.read.images
    rows = next((places for image, places in images.items() if name in (image, Path(image).stem)), None)
    if rows is None and alone and len(images) == 1:
        rows = next(iter(images.values()))
    if rows is None:
        return None
    ground = control.read.points.taken(rows[:, 0].astype(np.intp))
    spread = rows[:, 3:, None] ** 2 * np.eye(2)
    try:
        correction = polynomial_correction(
            polynomial, ground.itrs, ground.covariance, rows[:, 1:3], spread, control.kind
        )
        return Controlled(ground.ids, correction, controlled(polynomial, correction))
    except ValueError as error:
        allowed = f"{LEAST_POINTS[control.kind]} points or more, spread over the image of {name}"
        raise InputError(Issue(str(error), control.file, allowed=allowed)) from None


def _products(run: Export, scene: DimapScene) -> Mapping[str, ProductPolynomial]:
    """Polynomials that stand beside a scene's file, where it names some."""
    folder = Path(scene.read.file).parent
    (name, line), *_ = run.lines.items()
    for href in scene.read.rpc:
        path = folder / href
        # names in a file lead nowhere else
        if Path(href).name == href and path.is_file():
            return FrozenMap({name: compared(line.window.sensor, read_rpc(path), str(path))})
    return FrozenMap()


def compared(sensor: Sensor, model: RationalPolynomial, file: str) -> ProductPolynomial:
    """Return how far polynomials are from the sensor over the heights that they cover: beyond them they say nothing."""
    low, high = (model.offset[4] + sign * model.scale[4] for sign in (-1.0, 1.0))
    axes = (
        np.linspace(0.0, sensor.lines - 1.0, _COMPARED[0]),
        np.linspace(0.0, sensor.camera.pixels - 1.0, _COMPARED[1]),
        np.linspace(low, high, _COMPARED[2]),
    )
    line, pixel, height = (v.ravel() for v in np.meshgrid(*axes, indexing="ij"))
    longitude, latitude, _ = sensor.earth.geodetic(sensor.ground(line, pixel, height))
    there = np.stack(model.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    off = there - np.stack([line, pixel], axis=-1)
    (line_mean, sample_mean), (line_rms, sample_rms) = off.mean(axis=0).tolist(), off.std(axis=0).tolist()
    most, heights = float(np.max(np.abs(off))), (float(low), float(high))
    return ProductPolynomial(file, (line_mean, sample_mean), (line_rms, sample_rms), most, heights)


_ENDING = re.compile(r"(_RPC|_rpc)$")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")


@dataclass(frozen=True, eq=False)
class PolynomialSource:
    """Rational polynomials of a file.

    Attributes
    ----------
    name : str
        Of the image that they belong to, as far as the file's name tells it.
    file : str
        That they are from.
    polynomial : RationalPolynomial
        As they were read.
    config : str
        The file's path, as YAML.
    """

    name: str
    file: str
    polynomial: RationalPolynomial
    config: str


@dataclass(frozen=True, eq=False)
class PolynomialExport:
    """Polynomials after control.

    Attributes
    ----------
    source : PolynomialSource
        What was read.
    control : Controlled
        What the points made of it.
    """

    source: PolynomialSource
    control: Controlled


def read_polynomial_source(path: Path, band: str | None = None) -> PolynomialSource | None:
    """Rational polynomials, where a file holds them alone; None for another file.

    Parameters
    ----------
    path : Path
        Of it.
    band : str | None
        That was asked for, which polynomials do not have.

    Raises
    ------
    InputError
        It holds polynomials that cannot be read, or a band is asked for.
    """
    if not path.is_file() or not is_rpc(path):
        return None
    if band is not None:
        raise no_bands(path, band)
    name = _UNSAFE.sub("_", _ENDING.sub("", path.stem)) or "image"
    return PolynomialSource(name, str(path), read_rpc(path), dump_yaml({"source": str(path)}))


def run_polynomial_export(
    source: PolynomialSource, uncertainty: CameraUncertainty | None, points: ControlPoints | None
) -> PolynomialExport:
    """Correct the polynomials.

    Parameters
    ----------
    source : PolynomialSource
        What was read.
    uncertainty : CameraUncertainty | None
        Which only a rigorous model can have.
    points : ControlPoints | None
        That correct them.

    Raises
    ------
    InputError
        There are none, they do not determine a correction, or something was asked for that takes a rigorous model.
    """
    if uncertainty is not None:
        allowed = "a source with a rigorous model for --position-sigma, --attitude-sigma and the like"
        raise InputError(Issue("polynomials alone know no camera and no orbit", source.file, allowed=allowed))
    if points is None:
        raise InputError(Issue("nothing to do with polynomials alone", source.file, allowed="--control points.gcp"))
    found = controlled_line(points, source.name, source.polynomial, alone=True)
    if found is None:
        problem = "no control point is in the image of these polynomials"
        raise InputError(Issue(problem, points.file, allowed=f"points in {source.name}.tif"))
    return PolynomialExport(source, found)


POLYNOMIALS: Record[PolynomialExport] = Record(
    "export.json of rational polynomials alone.",
    Quantity("source", lambda run: run.source.file, "that they were read from"),
    Quantity("rpc", lambda run: _file(run), "path in the run folder of the corrected ones"),
    Quantity("control", lambda run: {run.source.name: run.control}, "how points corrected them", record=CONTROL),
)


def _file(run: PolynomialExport) -> str:
    return f"{FOLDER}/{run.source.name}_RPC.TXT"


def polynomial_files(run: PolynomialExport) -> dict[str, bytes]:
    """Path in the run folder -> contents."""
    return {_file(run): run.control.after.text().encode()}


def polynomial_report(run: PolynomialExport) -> Report:
    """Report of the correction."""
    quality = Quality(control=FrozenMap({run.source.name: run.control}))
    verdict, more = answer(*quality_answers(quality))
    before, after = run.source.polynomial, run.control.after
    rows = list(zip(("line", "sample"), before.offset[:2].tolist(), after.offset[:2].tolist(), strict=True))
    table = Table("polynomials", "Offsets", "Middle of the image, pixels.", ("of", "before [px]", "after [px]"), rows)
    size = " x ".join(f"{2.0 * value:.0f}" for value in before.scale[:2])
    low, high = before.offset[4] + np.array([-1.0, 1.0]) * before.scale[4]
    facts = (("Read", run.source.file), ("Image", f"{size} pixels"), ("Ground", f"{low:.0f} to {high:.0f} m high"))
    warnings = tuple(one for one in quality_warnings(quality) if "ISD" not in one)
    sections = (control_section(quality.control),)
    return Report("Corrected rational polynomials", verdict, more, facts, table, sections, warnings=warnings)
