"""Accuracy of exported models: errors on the ground, correction by control points, a product's polynomials.

Rational polynomials that come without a rigorous model can also be corrected with control points.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from analysis.orbit.rational_polynomial import LEAST_POINTS, RationalPolynomial
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue, names_text
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.artefact import Table
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, answer
from twin.orbit.export import export_run
from twin.orbit.export.export_report import CONTROL, FOLDER, control_section, quality_answers, quality_warnings
from twin.orbit.export.ground_accuracy import AccuracyMap, CameraUncertainty, accuracy_maps
from twin.orbit.export.rational_polynomial import corrected_polynomial, is_rpc, polynomial_correction, read_rpc
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.platform_files import DimapScene

_COMPARED = (15, 15, 3)
"""Number of lines, pixels and heights of the grid on which polynomials are compared with the rigorous model."""


def with_quality(
    run: export_run.Export, uncertainty: CameraUncertainty | None, points: export_run.ControlPoints | None
) -> export_run.Export:
    """Return the export with the requested corrections of its polynomials and errors (ERR_BIAS, ERR_RAND).

    Parameters
    ----------
    run : Export
        Exported models.
    uncertainty : CameraUncertainty or None
        Uncertainty of camera and trajectory; None for no map.
    points : ControlPoints or None
        Control points that correct the polynomials; None for no correction.

    Raises
    ------
    InputError
        No control point lies in an image, or the points do not determine a correction.
    """
    lines = dict(run.lines)
    products = _products(run, run.source.scene) if isinstance(run.source, export_run.SceneSource) else {}
    control = {} if points is None else _controlled(points, lines)
    for name, controlled in control.items():
        lines[name] = replace(lines[name], polynomial=controlled.after)
    maps: Mapping[str, AccuracyMap] = {}
    if uncertainty is not None:
        windows = {n: (x.window.sensor, x.window.first_pixel, x.window.pixels) for n, x in lines.items()}
        maps = accuracy_maps(windows, uncertainty, run.heights[1])
        lines = {name: _with_errors(line, maps[name], name in control) for name, line in lines.items()}
    quality = export_run.Quality(FrozenMap(maps), FrozenMap(control), products)
    return replace(run, lines=FrozenMap(lines), quality=quality)


def _with_errors(line: export_run.ExportedLine, accuracy: AccuracyMap, is_controlled: bool) -> export_run.ExportedLine:
    """Return a line whose models contain its errors on the ground (ERR_BIAS and ERR_RAND).

    Polynomials corrected by control points keep the errors of the correction.
    """
    polynomial, (bias, random) = line.polynomial, accuracy.horizontal()
    if polynomial is not None and not is_controlled:
        all_bias, all_random = np.hypot((bias, random), (polynomial.bias_m or 0.0, polynomial.random_m or 0.0)).tolist()
        polynomial = replace(polynomial, bias_m=all_bias, random_m=all_random)
    worst = np.nanargmax(accuracy.ce90)
    (a, b), (_, c) = accuracy.covariance[worst, :2, :2]
    notes = (
        f"on ground {accuracy.height:.0f} m high points have CE90 up to {accuracy.ce90[worst]:.4g} m, of camera, orbit "
        f"and attitude; covariance there, east east, east north, north north: {a:.6g} {b:.6g} {c:.6g} m^2",
        f"of it in common to all points {bias:.4g} m, of measured places {random:.4g} m: root mean square of a "
        "horizontal axis over the image",
    )
    isd = {**line.scanner.isd, "notes": [*line.scanner.isd["notes"], *notes]}
    return replace(line, polynomial=polynomial, scanner=replace(line.scanner, isd=FrozenMap(isd)))


def _controlled(
    control: export_run.ControlPoints, lines: Mapping[str, export_run.ExportedLine]
) -> dict[str, export_run.ControlledPolynomial]:
    """Return the polynomials of each line corrected by control points."""
    controlled: dict[str, export_run.ControlledPolynomial] = {}
    for name, line in lines.items():
        if line.polynomial is not None:
            corrected = correct_line(control, name, line.polynomial, len(lines) == 1)
            controlled |= {} if corrected is None else {name: corrected}
    if not controlled:
        problem, allowed = "no control point lies in any of the images", names_text(f"{name}.tif" for name in lines)
        raise InputError(Issue(problem, control.file, None, (), names_text(control.read.images), allowed))
    return controlled


def correct_line(
    control: export_run.ControlPoints, name: str, polynomial: RationalPolynomial, alone: bool
) -> export_run.ControlledPolynomial | None:
    """Return the polynomials of an image corrected by control points; None where no point lies in it.

    Parameters
    ----------
    control : ControlPoints
        Points with their image positions.
    name : str
        Name of the image, without its ending.
    polynomial : RationalPolynomial
        Polynomials of the image.
    alone : bool
        True if it is the only image; points of a single image are then used whatever that image is called.

    Raises
    ------
    InputError
        The points do not determine a correction.
    """
    images = control.read.images
    rows = next((points for image, points in images.items() if name in (image, Path(image).stem)), None)
    if rows is None and alone and len(images) == 1:
        rows = next(iter(images.values()))
    if rows is None:
        return None
    ground = control.read.points.taken(rows[:, 0].astype(np.intp))
    spread = rows[:, 3:, None] ** 2 * np.eye(2)
    try:
        points = ground.itrs, ground.covariance, rows[:, 1:3], spread
        correction = polynomial_correction(polynomial, *points, control.kind)
        return export_run.ControlledPolynomial(ground.ids, correction, corrected_polynomial(polynomial, correction))
    except ValueError as error:
        allowed = f"{LEAST_POINTS[control.kind]} points or more, spread over the image of {name}"
        raise InputError(Issue(str(error), control.file, allowed=allowed)) from None


def _products(run: export_run.Export, scene: DimapScene) -> Mapping[str, export_run.ProductPolynomial]:
    """Return the comparison of the polynomials that a scene's file names with its rigorous model; empty if none."""
    folder = Path(scene.read.file).parent
    (name, line), *_ = run.lines.items()
    for href in scene.read.rpc:
        path = folder / href
        # names in a file must not lead to another folder
        if Path(href).name == href and path.is_file():
            return FrozenMap({name: compare_product(line.window.sensor, read_rpc(path), str(path))})
    return FrozenMap()


def compare_product(sensor: Sensor, model: RationalPolynomial, file: str) -> export_run.ProductPolynomial:
    """Compare a product's polynomials with the rigorous sensor, over the heights for which they are valid."""
    low, high = (model.offset[4] + sign * model.scale[4] for sign in (-1.0, 1.0))
    axes = (
        np.linspace(0.0, sensor.lines - 1.0, _COMPARED[0]),
        np.linspace(0.0, sensor.camera.pixels - 1.0, _COMPARED[1]),
        np.linspace(low, high, _COMPARED[2]),
    )
    line, pixel, height = (v.ravel() for v in np.meshgrid(*axes, indexing="ij"))
    longitude, latitude, _ = sensor.earth.geodetic(sensor.ground(line, pixel, height))
    predicted = np.stack(model.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    difference = predicted - np.stack([line, pixel], axis=-1)
    (line_mean, sample_mean), (line_rms, sample_rms) = difference.mean(axis=0).tolist(), difference.std(axis=0).tolist()
    largest, heights = float(np.max(np.abs(difference))), (float(low), float(high))
    return export_run.ProductPolynomial(file, (line_mean, sample_mean), (line_rms, sample_rms), largest, heights)


_ENDING = re.compile(r"(_RPC|_rpc)$")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")


@dataclass(frozen=True, eq=False)
class PolynomialSource:
    """Rational polynomials of a file.

    Attributes
    ----------
    name : str
        Name of their image, from the name of the file.
    file : str
        File of the polynomials.
    polynomial : RationalPolynomial
        Polynomials as they were read.
    config : str
        Path of the file, as YAML.
    """

    name: str
    file: str
    polynomial: RationalPolynomial
    config: str


@dataclass(frozen=True, eq=False)
class PolynomialExport:
    """Polynomials corrected by control points.

    Attributes
    ----------
    source : PolynomialSource
        Polynomials before the correction.
    control : ControlledPolynomial
        Correction and corrected polynomials.
    """

    source: PolynomialSource
    control: export_run.ControlledPolynomial


def read_polynomial_source(path: Path, band: str | None = None) -> PolynomialSource | None:
    """Read rational polynomials from a file that contains them alone; return None for another file.

    Parameters
    ----------
    path : Path
        Path of the file.
    band : str, optional
        Requested band, which polynomials do not have.

    Raises
    ------
    InputError
        The polynomials cannot be read, or a band is requested.
    """
    if not path.is_file() or not is_rpc(path):
        return None
    if band is not None:
        raise export_run.band_error(path, band)
    name = _UNSAFE.sub("_", _ENDING.sub("", path.stem)) or "image"
    return PolynomialSource(name, str(path), read_rpc(path), dump_yaml({"source": str(path)}))


def run_polynomial_export(
    source: PolynomialSource, uncertainty: CameraUncertainty | None, points: export_run.ControlPoints | None
) -> PolynomialExport:
    """Correct rational polynomials by control points.

    Parameters
    ----------
    source : PolynomialSource
        Polynomials of a file.
    uncertainty : CameraUncertainty or None
        Must be None: uncertainties need a rigorous model.
    points : ControlPoints or None
        Control points that correct them.

    Raises
    ------
    InputError
        There are no control points, they do not determine a correction, or an option needs a rigorous model.
    """
    if uncertainty is not None:
        allowed = "a source with a rigorous model for --position-sigma, --attitude-sigma and the like"
        raise InputError(Issue("uncertainties need a rigorous model", source.file, allowed=allowed))
    if points is None:
        raise InputError(Issue("polynomials alone need control points", source.file, allowed="--control points.gcp"))
    controlled = correct_line(points, source.name, source.polynomial, alone=True)
    if controlled is None:
        problem = "no control point lies in the image of these polynomials"
        raise InputError(Issue(problem, points.file, allowed=f"points in {source.name}.tif"))
    return PolynomialExport(source, controlled)


POLYNOMIALS: Record[PolynomialExport] = Record(
    "Content of export.json for rational polynomials alone.",
    Quantity("source", lambda run: run.source.file, "file of the polynomials"),
    Quantity("rpc", lambda run: _file(run), "path of the corrected polynomials in the run folder"),
    Quantity("control", lambda run: {run.source.name: run.control}, "correction by control points", record=CONTROL),
)


def _file(run: PolynomialExport) -> str:
    return f"{FOLDER}/{run.source.name}_RPC.TXT"


def polynomial_files(run: PolynomialExport) -> dict[str, bytes]:
    """Return the file of the corrected polynomials, path in the run folder -> content."""
    return {_file(run): run.control.after.text().encode()}


def polynomial_report(run: PolynomialExport) -> Report:
    """Return the report of polynomials corrected by control points: correction, residuals and remaining errors."""
    quality = export_run.Quality(control=FrozenMap({run.source.name: run.control}))
    verdict, more = answer(*quality_answers(quality))
    before, after = run.source.polynomial, run.control.after
    rows = list(zip(("line", "sample"), before.offset[:2].tolist(), after.offset[:2].tolist(), strict=True))
    table = Table("polynomials", "Offsets", "Middle of the image, pixels.", ("of", "before [px]", "after [px]"), rows)
    size = " x ".join(f"{2.0 * value:.0f}" for value in before.scale[:2])
    low, high = before.offset[4] + np.array([-1.0, 1.0]) * before.scale[4]
    facts = (("Read", run.source.file), ("Image", f"{size} pixels"), ("Ground", f"{low:.0f} to {high:.0f} m high"))
    warnings = tuple(warning for warning in quality_warnings(quality) if "ISD" not in warning)
    sections = (control_section(quality.control),)
    return Report("Corrected rational polynomials", verdict, more, facts, table, sections, warnings=warnings)
