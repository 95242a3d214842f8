"""What exported models are worth: errors on the ground, polynomials after control, a product's own polynomials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from analysis.orbit.image_correction import LEAST_POINTS
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue, names_text
from twin.orbit.export.export_run import (
    Controlled,
    ControlPoints,
    Export,
    ExportedLine,
    ProductPolynomial,
    Quality,
    SceneSource,
    Wishes,
)
from twin.orbit.export.ground_accuracy import AccuracyMap, maps_of
from twin.orbit.export.polynomial_control import controlled, polynomial_correction
from twin.orbit.export.rational_polynomial import RationalPolynomial, read_rpc
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.platform_files import DimapScene

_COMPARED = (15, 15, 3)
"""Lines, pixels and heights at which polynomials are compared."""


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

    Args:
        control: points with their places in images.
        name: of the image, without its ending.
        polynomial: of it.
        alone: whether it is the only one, whatever the points' only image is called.

    Raises:
        InputError: points that do not determine a correction.
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
        return Controlled(ground.ids, controlled(polynomial, correction))
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
    mean, rms = np.mean(off, axis=0), np.std(off, axis=0)
    found = [float(value) for value in (*mean, *rms)]
    heights = float(low), float(high)
    return ProductPolynomial(file, found[0], found[1], found[2], found[3], float(np.max(np.abs(off))), heights)
