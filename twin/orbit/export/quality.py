"""What exported models are worth: their errors on the ground by what is uncertain of camera and way, how control points
correct the polynomials, and how a product's own polynomials agree with its rigorous model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.orbit.image_correction import LEAST_POINTS, Kind
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.measured.pass_files import GroundFileSpec
from scenes.yaml.errors import InputError, Issue, names_text
from twin.orbit.export.export_run import Export, ExportedLine, SceneSource
from twin.orbit.export.ground_accuracy import AccuracyMap, CameraUncertainty, maps_of
from twin.orbit.export.polynomial_control import ControlledPolynomial, controlled, polynomial_correction
from twin.orbit.export.rational_polynomial import RationalPolynomial
from twin.orbit.export.rpc_files import read_rpc
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.dimap_sensor import DimapScene
from twin.orbit.measured.ground_files import GroundFile, read_ground_points
from twin.orbit.measured.text_file import text_lines

Array = NDArray[np.float64]
_COMPARED = (15, 15, 3)


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Control points with their places in images.

    Attributes:
        file: that they are from.
        read: what it holds; places count from the centre of the first pixel.
        kind: of the correction that they determine.
    """

    file: str
    read: GroundFile
    kind: Kind


@dataclass(frozen=True, eq=False)
class Wishes:
    """What is asked for beside the models.

    Attributes:
        uncertainty: of camera and way; None for no map.
        control: points that correct the polynomials; None for none.
    """

    uncertainty: CameraUncertainty | None = None
    control: ControlPoints | None = None


@dataclass(frozen=True, eq=False)
class Controlled:
    """A line's polynomials after control.

    Attributes:
        names: (N,) of the points.
        polynomial: before, after, and what is between.
    """

    names: NDArray[np.object_]
    polynomial: ControlledPolynomial


@dataclass(frozen=True)
class ProductPolynomial:
    """Rational polynomials that came with a product, against its rigorous model, over the image and the heights that
    were modelled; polynomials minus rigorous.

    Attributes:
        file: where they are from.
        mean_line, mean_sample: mean difference, pixels.
        rms_line, rms_sample: root mean square about the mean, pixels.
        most: largest of all differences, pixels.
    """

    file: str
    mean_line: float
    mean_sample: float
    rms_line: float
    rms_sample: float
    most: float


@dataclass(frozen=True, eq=False)
class Quality:
    """What the models of an export are worth.

    Attributes:
        maps: line, or `together` for points that all lines intersect -> errors on the ground; empty where nobody asked.
        control: line -> how control points corrected its polynomials.
        products: line -> polynomials that came with it.
    """

    maps: Mapping[str, AccuracyMap]
    control: Mapping[str, Controlled]
    products: Mapping[str, ProductPolynomial]


def read_control(path: Path, kind: Kind) -> ControlPoints:
    """Control points of a .gcp file of the Ames Stereo Pipeline.

    Args:
        path: of it; without a header `# WKT:` its latitudes and longitudes are those of WGS 84, heights above it.
        kind: of the correction.

    Raises:
        InputError: it cannot be read, or has no places in images.
    """
    if path.suffix.lower() != ".gcp":
        raise InputError(Issue("not a .gcp file", str(path), allowed="control points with places in images, .gcp"))
    stated = any("WKT:" in line for line in text_lines(path, "a .gcp file") if line.lstrip().startswith("#"))
    spec = GroundFileSpec(file=str(path), crs=None if stated else "EPSG:4979")
    found = read_ground_points(spec, Path())
    if not found.images:
        allowed = "after the sigmas of each point: image, column, row, two sigmas"
        raise InputError(Issue("control points without places in images", str(path), allowed=allowed))
    return ControlPoints(str(path), found, kind)


def with_quality(run: Export, wishes: Wishes) -> Export:
    """The export with what was asked for: corrected polynomials, ERR_BIAS and ERR_RAND in them, notes in the ISD.

    Args:
        run: its models.
        wishes: what is asked for.

    Raises:
        InputError: control points that are of none of the images, or do not determine a correction.
    """
    lines = dict(run.lines)
    products = _products(run, run.source.scene) if isinstance(run.source, SceneSource) else {}
    control = {}
    if wishes.control is not None:
        control = _controlled(wishes.control, lines)
        for name, one in control.items():
            lines[name] = replace(lines[name], polynomial=one.polynomial.after)
    maps: Mapping[str, AccuracyMap] = {}
    if wishes.uncertainty is not None:
        places = {n: (x.window.sensor, x.window.first_pixel, x.window.pixels) for n, x in lines.items()}
        maps = maps_of(places, wishes.uncertainty, run.heights[1])
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
        f"on ground {found.height:.0f} m high points of this line have CE90 up to {found.ce90[worst]:.4g} m, of camera, "
        f"orbit and attitude; covariance there, east east, east north, north north: {a:.6g} {b:.6g} {c:.6g} m^2",
        f"of it in common to all points {bias:.4g} m, another in every point {random:.4g} m: roots of the sums of the "
        "variances to the east and to the north, root mean square over the image",
    )
    isd = {**line.scanner.isd, "notes": [*line.scanner.isd["notes"], *notes]}
    return replace(line, polynomial=polynomial, scanner=replace(line.scanner, isd=FrozenMap(isd)))


def _controlled(control: ControlPoints, lines: Mapping[str, ExportedLine]) -> dict[str, Controlled]:
    """Line -> its polynomials after control."""
    images = control.read.images
    found = {}
    for name, line in lines.items():
        rows = images.get(name)
        rows = next((r for image, r in images.items() if Path(image).stem == name), None) if rows is None else rows
        if rows is None and len(images) == 1 and len(lines) == 1:
            rows = next(iter(images.values()))
        if rows is None or line.polynomial is None:
            continue
        point = rows[:, 0].astype(np.intp)
        ground = control.read.points.taken(point)
        spread = rows[:, 3:, None] ** 2 * np.eye(2)
        try:
            correction = polynomial_correction(
                line.polynomial, ground.itrs, ground.covariance, rows[:, 1:3], spread, control.kind
            )
            after = controlled(line.polynomial, correction)
        except ValueError as error:
            allowed = f"{LEAST_POINTS[control.kind]} points or more, spread over the image of {name}"
            raise InputError(Issue(str(error), control.file, allowed=allowed)) from None
        found[name] = Controlled(ground.ids, after)
    if not found:
        allowed = names_text(f"{name}.tif" for name in lines)
        raise InputError(
            Issue("no control point is in one of the images", control.file, None, (), names_text(images), allowed)
        )
    return found


def _products(run: Export, scene: DimapScene) -> Mapping[str, ProductPolynomial]:
    """Polynomials that stand beside a scene's file, where it names some."""
    folder = Path(scene.read.file).parent
    (name, line), *_ = run.lines.items()
    for href in scene.read.rpc:
        path = folder / href
        # names in a file lead nowhere else
        if Path(href).name == href and path.is_file():
            return FrozenMap({name: _compared(line.window.sensor, read_rpc(path), run.heights, str(path))})
    return FrozenMap()


def _compared(
    sensor: Sensor, model: RationalPolynomial, heights: tuple[float, float, float], file: str
) -> ProductPolynomial:
    axes = (
        np.linspace(0.0, sensor.lines - 1.0, _COMPARED[0]),
        np.linspace(0.0, sensor.camera.pixels - 1.0, _COMPARED[1]),
        np.linspace(heights[0], heights[2], _COMPARED[2]),
    )
    line, pixel, height = (v.ravel() for v in np.meshgrid(*axes, indexing="ij"))
    longitude, latitude, _ = sensor.earth.geodetic(sensor.ground(line, pixel, height))
    there = np.stack(model.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    off = there - np.stack([line, pixel], axis=-1)
    mean, rms = np.mean(off, axis=0), np.std(off, axis=0)
    found = [float(value) for value in (*mean, *rms)]
    return ProductPolynomial(file, found[0], found[1], found[2], found[3], float(np.max(np.abs(off))))
