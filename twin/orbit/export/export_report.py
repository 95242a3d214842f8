"""Files, quantities and report of an export.

What an export tells of the worth of its models: numbers, tables, maps and warnings.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.figure import Figure

from twin.orbit.export.export_run import Controlled, Export, ExportedLine, ProductPolynomial, Quality, SceneSource
from twin.orbit.export.ground_accuracy import TOGETHER, AccuracyMap, GroundSigma
from twin.orbit.export.line_scanner import ModelError
from twin.orbit.export.rational_polynomial import RationalPolynomial, residual_sigma
from twin.run import svg
from twin.run.artefact import Cell, SvgFigure, Table, significant
from twin.run.data_files import FrameFacts, tiff
from twin.run.quantity import Quantity, Record
from twin.run.report import Report, Section, answer

_UNLIKELY = 1e-3
"""Chance of a chi-square below which covariances of control points cannot be true."""
_MOST_PANELS = 6
_MOST_ROWS = 400
"""Of control points in a page's table."""
_OFF = 1.0
"""Pixels by which a product's polynomials may be off before a warning."""


def _over(
    values: Callable[[AccuracyMap], np.ndarray], how: Callable[[np.ndarray], float]
) -> Callable[[AccuracyMap], float]:
    return lambda found: float(how(values(found)[found.seen]))


ACCURACY: Record[AccuracyMap] = Record(
    "Errors on the ground of points over a scene, by what is uncertain of camera, orbit and attitude.",
    Quantity("height_m", lambda found: found.height, "of the ground above the ellipsoid"),
    Quantity("points", lambda found: int(np.sum(found.seen)), "of the grid, at which errors were taken"),
    Quantity("ce90_median_m", _over(lambda f: f.ce90, np.median), "circle of 90 % of the horizontal errors, median"),
    Quantity("ce90_largest_m", _over(lambda f: f.ce90, np.max), "the largest"),
    Quantity("le90_median_m", _over(lambda f: f.le90, np.median), "interval of 90 % of the vertical errors, median"),
    Quantity("le90_largest_m", _over(lambda f: f.le90, np.max), "the largest"),
    Quantity("common_m", lambda f: f.horizontal()[0], "error that points have in common, of each horizontal axis"),
    Quantity(
        "random_m",
        lambda f: f.horizontal()[1],
        "that of the measured places, likewise; heights from elsewhere are in neither",
    ),
)
CONTROL: Record[Controlled] = Record(
    "How control points corrected a line's polynomials; measured minus predicted.",
    Quantity("kind", lambda one: one.polynomial.correction.kind, "shift, or affine function of line and sample"),
    Quantity("points", lambda one: len(one.names), "how many"),
    Quantity("left_out", lambda one: _left_out(one), "names of points that lie beyond their covariances"),
    Quantity("middle_px", lambda one: one.polynomial.correction.middle, "line and sample from which places count"),
    Quantity("size_px", lambda one: one.polynomial.correction.size, "unit of places, line and sample"),
    Quantity(
        "coefficients_px",
        lambda one: one.polynomial.correction.coefficients,
        "of line and of sample: constant, and of an affine function by line and by sample",
    ),
    Quantity("covariance_px2", lambda one: one.polynomial.correction.covariance, "of them, those of the line first"),
    Quantity("chi_square", lambda one: one.polynomial.correction.chi_square, "of what is left, by the covariances"),
    Quantity("freedom", lambda one: one.polynomial.correction.freedom, "of it"),
    Quantity("probability", lambda one: one.polynomial.correction.probability, "of as large a chi-square"),
    Quantity(
        "fit_error_px",
        lambda one: max(one.polynomial.after.error_px),
        "largest difference of the written polynomials from the corrected ones",
    ),
    Quantity(
        "err_bias_m",
        lambda one: one.polynomial.after.bias_m,
        "ERR_BIAS: sigma of the correction along a horizontal axis",
    ),
    Quantity("err_rand_m", lambda one: one.polynomial.after.random_m, "ERR_RAND: what scatters beyond the covariances"),
)
PRODUCT: Record[ProductPolynomial] = Record(
    "Rational polynomials that came with a scene, minus its rigorous model.",
    Quantity("file", lambda one: one.file, "where they are from"),
    Quantity("mean_line_px", lambda one: one.mean_line, "mean difference along the track"),
    Quantity("mean_sample_px", lambda one: one.mean_sample, "along the line"),
    Quantity("rms_line_px", lambda one: one.rms_line, "root mean square about the mean, along the track"),
    Quantity("rms_sample_px", lambda one: one.rms_sample, "along the line"),
    Quantity("largest_px", lambda one: one.most, "largest of all"),
    Quantity("heights_m", lambda one: one.heights, "lowest and highest ground of the polynomials, which is compared"),
)


def _left_out(one: Controlled) -> list[str]:
    return [str(name) for name in one.names[~one.polynomial.correction.used]]


def quality_sections(run: Export) -> tuple[Section, ...]:
    """Sections of what was asked for; none for nothing."""
    quality = run.quality
    if quality is None:
        return ()
    found = []
    if quality.products:
        found.append(_product_section(quality.products))
    if quality.control:
        found.append(control_section(quality.control))
    if quality.maps:
        found.append(_map_section(quality.maps))
    return tuple(found)


def quality_answers(quality: Quality | None) -> tuple[str, ...]:
    """Sentences for the head of a page."""
    if quality is None:
        return ()
    found = []
    for name, one in quality.control.items():
        used = int(np.sum(one.polynomial.correction.used))
        bias = significant(one.polynomial.after.bias_m or 0.0, 2)
        how = "a shift" if one.polynomial.correction.kind == "shift" else "an affine function"
        found.append(
            f"{used} of {len(one.names)} control points correct the polynomials of {name} by {how}, to {bias} m on the "
            "ground along each axis"
        )
    if quality.maps:
        name, worst = max(quality.maps.items(), key=lambda item: float(np.nanmax(item[1].ce90)))
        whose = "points that the lines intersect" if name == TOGETHER else f"points of {name}"
        found.append(f"CE90 is at most {significant(float(np.nanmax(worst.ce90)), 3)} m, of {whose}")
        both = quality.maps.get(TOGETHER)
        if both is not None:
            found.append(f"LE90 of intersected points is at most {significant(float(np.nanmax(both.le90)), 3)} m")
    return tuple(found)


def quality_warnings(quality: Quality | None) -> tuple[str, ...]:
    """What a reader has to know."""
    if quality is None:
        return ()
    found = []
    for name, product in quality.products.items():
        if product.most > _OFF:
            found.append(
                f"the polynomials of the product are off the rigorous model of {name} by up to "
                f"{significant(product.most, 2)} pixels"
            )
    for name, one in quality.control.items():
        correction = one.polynomial.correction
        if left := _left_out(one):
            found.append(
                f"control points of {name} lie beyond their covariances and are left out: {', '.join(left[:10])}"
            )
        if correction.probability < _UNLIKELY:
            found.append(
                f"control points of {name} scatter by {significant(np.sqrt(correction.factor), 2)} times their sigmas: "
                "ERR_RAND states it, and sigmas of the correction are too small by as much"
            )
        if correction.freedom == 0:
            found.append(f"no control point of {name} is left over to check its correction")
    if quality.control:
        found.append("the correction by control points stands in the polynomials, not in the ISD")
    return tuple(found)


def _product_section(products: Mapping[str, ProductPolynomial]) -> Section:
    rows: list[tuple[Cell, ...]] = [
        (name, one.mean_line, one.mean_sample, one.rms_line, one.rms_sample, one.most) for name, one in products.items()
    ]
    heads = ("line", "mean, line [px]", "mean, sample [px]", "rms, line [px]", "rms, sample [px]", "largest [px]")
    title = "The product's own polynomials"
    table = Table("product_rpc", title, "Polynomials minus rigorous model; rms about the mean.", heads, rows, digits=3)
    text = (
        "A mean along the track of 12 m would be the aberration of the light, which the rigorous model does not have; "
        "an error that goes with the height, across the track where the look is oblique, refraction.",
    )
    return Section(title, text, (table,), name="product")


def control_section(control: Mapping[str, Controlled]) -> Section:
    """Corrections and residuals of every line."""
    rows: list[tuple[Cell, ...]] = []
    points: list[tuple[Cell, ...]] = []
    for name, one in control.items():
        correction = one.polynomial.correction
        at = correction.at(*correction.middle)[0]
        sigma = np.sqrt(np.diagonal(correction.covariance_at(*correction.middle)[0]))
        rows.append((name, *map(float, (at[0], sigma[0], at[1], sigma[1])), correction.chi_square, correction.freedom))
        spread = residual_sigma(correction)
        for k, point in enumerate(one.names.tolist()):
            left, allowed = correction.residual[k], spread[k]
            used = "used" if correction.used[k] else "left out"
            points.append((name, str(point), *map(float, (left[0], allowed[0], left[1], allowed[1])), used))
    heads = ("line", "line [px]", "sigma [px]", "sample [px]", "sigma [px] ", "chi-square", "freedom")
    table = Table(
        "correction", "Correction in the middle of the points", "Measured minus predicted.", heads, rows, digits=4
    )
    heads = ("line", "point", "line [px]", "sigma [px]", "sample [px]", "sigma [px] ", "")
    full = Table(
        "control", "Residuals", "After the correction, with what they are expected to be.", heads, points, digits=3
    )
    shown = (
        full
        if len(points) <= _MOST_ROWS
        else Table("control", "Residuals", f"The first {_MOST_ROWS}.", heads, points[:_MOST_ROWS], digits=3)
    )
    text = (
        "Sigmas are those of the control points on the ground and in the image, and of nothing else. A correction "
        "holds over the part of the image that the points cover.",
    )
    return Section("Control points", text, (table, shown), folded=1, name="control")


def _map_section(maps: Mapping[str, AccuracyMap]) -> Section:
    rows: list[tuple[Cell, ...]] = []
    points: list[tuple[Cell, ...]] = []
    for name, found in maps.items():
        ce, le, seen = found.ce90, found.le90, found.seen
        common, random = found.horizontal()
        values = (np.median(ce[seen]), np.max(ce[seen]), np.median(le[seen]), np.max(le[seen]), common, random)
        rows.append((_called(name), *map(float, values)))
        sigma = np.sqrt(np.einsum("nii->ni", found.covariance))
        for k in np.flatnonzero(seen):
            place = (found.line[k], found.pixel[k], np.degrees(found.longitude[k]), np.degrees(found.latitude[k]))
            points.append((_called(name), *map(float, (*place, found.height, ce[k], le[k], *sigma[k]))))
    heads = ("points of", "CE90 median [m]", "CE90 largest [m]", "LE90 median [m]", "LE90 largest [m]")
    caption = (
        "In common: errors of camera, orbit and attitude; random: of the measured places. Both are roots of the sums "
        "of the variances to the east and to the north. CE90 holds the heights' errors, too."
    )
    table = Table("accuracy", "Errors on the ground", caption, (*heads, "in common [m]", "random [m]"), rows, digits=3)
    places = ("points of", "line", "pixel", "longitude [deg]", "latitude [deg]", "height [m]", "CE90 [m]", "LE90 [m]")
    sigmas = ("sigma east [m]", "sigma north [m]", "sigma up [m]")
    grid = Table("accuracy_map", "Map", "All points of the grids.", (*places, *sigmas), points, digits=7)
    with svg.look("accuracy-map"):
        drawing = svg.to_svg(_figure(maps))
    figure = SvgFigure(
        "accuracy-map", "Map", "CE90, and LE90 of intersected points, over each image's ground.", drawing
    )
    text = (
        "CE90 is the radius of the circle that holds 90 % of the horizontal errors, by the whole covariance and not by "
        "its mean axis; LE90 is half the interval that holds 90 % of the vertical ones. Points of one line have their "
        "heights from elsewhere, and their LE90 is that of these heights.",
    )
    return Section("Accuracy on the ground", text, (table, figure, grid), folded=1, name="accuracy")


def _called(name: str) -> str:
    return "all lines, intersected" if name == TOGETHER else name


def _figure(maps: Mapping[str, AccuracyMap]) -> Figure:
    """A panel for each map."""
    panels = [(f"CE90, {_called(name)}", found, found.ce90) for name, found in maps.items()]
    panels += [(f"LE90, {_called(name)}", found, found.le90) for name, found in maps.items() if name == TOGETHER]
    panels = panels[-_MOST_PANELS:]
    wide = min(3, len(panels))
    figure = svg.new_figure(3.4 * -(-len(panels) // wide))
    for k, (title, found, values) in enumerate(panels):
        axes = figure.add_subplot(-(-len(panels) // wide), wide, k + 1)
        seen = found.seen
        longitude, latitude = np.degrees(found.longitude[seen]), np.degrees(found.latitude[seen])
        marks = axes.scatter(longitude, latitude, c=values[seen], s=26, marker="s", cmap="viridis", linewidths=0.0)
        axes.set_aspect(1.0 / max(float(np.cos(np.radians(np.mean(latitude)))), 0.05), adjustable="datalim")
        axes.set(title=f"{title} [m]", xlabel="longitude [deg]", ylabel="latitude [deg]")
        axes.ticklabel_format(useOffset=False)
        axes.locator_params(nbins=4)
        svg.plain_axes(axes)
        figure.colorbar(marks, ax=axes, shrink=0.8)
    return figure


FOLDER = "models"


def _names(line: ExportedLine) -> dict[str, str]:
    """What is written of a line -> its path in the run folder."""
    stem = f"{FOLDER}/{line.window.name}"
    names = {"isd": f"{stem}.json"}
    if line.window.frame is not None:
        names["image"] = f"{stem}.tif"
    if line.polynomial is not None:
        names["rpc"] = f"{stem}_RPC.TXT"
    return names


ISD_ERROR: Record[ModelError] = Record(
    "How far the community sensor model is from the rigorous sensor at one height, the largest over the image.",
    Quantity("height_m", lambda one: one.height_m, "above the ellipsoid"),
    Quantity("sample_px", lambda one: one.sample_px, "along the line"),
    Quantity("line_px", lambda one: one.line_px, "along the track"),
)
RPC_ERROR: Record[RationalPolynomial] = Record(
    "How far the polynomials are from the rigorous sensor between the places that were fitted.",
    Quantity("largest_line_px", lambda model: model.error_px[0], "largest difference along the track"),
    Quantity("largest_sample_px", lambda model: model.error_px[1], "largest difference along the line"),
    Quantity("rms_line_px", lambda model: model.rms_px[0], "root mean square along the track"),
    Quantity("rms_sample_px", lambda model: model.rms_px[1], "root mean square along the line"),
)
GROUND: Record[GroundSigma] = Record(
    "What the error of the camera's estimated change is on the ground, root mean square over the image.",
    Quantity("height_m", lambda one: one.height_m, "of the ground above the ellipsoid"),
    Quantity("err_bias_m", lambda one: one.bias_m, "ERR_BIAS: of each horizontal axis, in common with other images"),
    Quantity("err_rand_m", lambda one: one.random_m, "ERR_RAND: of each horizontal axis, another in every image"),
    Quantity("bias_east_m", lambda one: one.bias_east_m, "the same to the east"),
    Quantity("bias_north_m", lambda one: one.bias_north_m, "the same to the north"),
    Quantity("random_east_m", lambda one: one.random_east_m, "the random part to the east"),
    Quantity("random_north_m", lambda one: one.random_north_m, "the random part to the north"),
)
LINE: Record[ExportedLine] = Record(
    "One line's image and its models; files are paths in the run folder, None for those that were not written.",
    Quantity("lines", lambda line: line.window.sensor.lines, "how many"),
    Quantity("pixels", lambda line: line.window.pixels, "how many"),
    Quantity("first_pixel", lambda line: line.window.first_pixel, "of the image on the line"),
    Quantity("first_line_time_s", lambda line: line.window.sensor.first_line_time, "from the epoch"),
    Quantity("line_time_s", lambda line: line.window.sensor.line_time, "from one line to the next"),
    Quantity("image", lambda line: _names(line).get("image"), "GeoTIFF with the polynomials inside"),
    Quantity("isd", lambda line: _names(line)["isd"], "image support data of the community sensor model"),
    Quantity("rpc", lambda line: _names(line).get("rpc"), "rational polynomials"),
    Quantity("isd_nodes", lambda line: len(line.scanner.camera.seconds), "times at which station and attitude stand"),
    Quantity("isd_errors", lambda line: line.scanner.errors, "at every height", record=ISD_ERROR),
    Quantity("rpc_errors", lambda line: line.polynomial, "over all heights", record=RPC_ERROR),
    Quantity("rpc_refused", lambda line: line.refused or None, "why there are no polynomials"),
    Quantity(
        "ground",
        lambda line: line.ground,
        "what is uncertain of the camera's estimated change, where one was estimated",
        record=GROUND,
        where_known=True,
    ),
)
EXPORT: Record[Export] = Record(
    "export.json. Line cameras for other software.",
    Quantity("epoch_utc", lambda run: run.epoch, "second 0 of the orbit"),
    Quantity("truth", lambda run: run.truth, "whether camera and orbit are the true ones"),
    Quantity("heights_m", lambda run: run.heights, "of the ground that models were fitted to: lowest, middle, highest"),
    Quantity("lines", lambda run: run.lines, "every line and its models", record=LINE),
    Quantity(
        "accuracy",
        lambda run: (run.quality and run.quality.maps) or None,
        "line, or `together` for points that all lines intersect: errors on the ground, where they were asked for",
        record=ACCURACY,
        where_known=True,
    ),
    Quantity(
        "control",
        lambda run: (run.quality and run.quality.control) or None,
        "line: how control points corrected its polynomials, where there are some",
        record=CONTROL,
        where_known=True,
    ),
    Quantity(
        "product_rpc",
        lambda run: (run.quality and run.quality.products) or None,
        "line: the polynomials that came with a scene, where there are some",
        record=PRODUCT,
        where_known=True,
    ),
)


def export_files(run: Export) -> dict[str, bytes]:
    """Path in the run folder -> contents: ISD and RPC of every line, and its image as a GeoTIFF with the RPC inside."""
    found = {}
    for line in run.lines.values():
        names = _names(line)
        found[names["isd"]] = (json.dumps(line.scanner.isd, allow_nan=False) + "\n").encode()
        if line.polynomial is not None:
            found[names["rpc"]] = line.polynomial.text().encode()
        if line.window.frame is not None:
            facts = FrameFacts(
                line.window.name, line.window.pitch, note=f"second 0 of its orbit is {run.epoch}", place=line.polynomial
            )
            found[names["image"]] = bytes(tiff(line.window.frame[None], facts))
    return found


_ROUGH = 0.1
"""Pixels: a model that is further off is worth a warning."""


def export_report(run: Export) -> Report:
    """What was written, and how well it agrees with the rigorous sensor."""
    isd = max((max(e.sample_px, e.line_px), name) for name, line in run.lines.items() for e in line.scanner.errors)
    rpc = [(max(line.polynomial.error_px), name) for name, line in run.lines.items() if line.polynomial is not None]
    low, _, high = run.heights
    images = sum(line.window.frame is not None for line in run.lines.values())
    verdict, more = answer(
        f"The folder has {len(run.lines)} lines as community sensor models and rational polynomials"
        + (f", with {images} images" if images else ""),
        f"on ground {low:.0f} to {high:.0f} m high the sensor models are within {significant(isd[0], 2)} pixels of the "
        f"rigorous sensor ({isd[1]} is the worst)",
        f"the polynomials are within {significant(max(rpc)[0], 2)} pixels ({max(rpc)[1]})"
        if rpc
        else "there are no polynomials",
        *quality_answers(run.quality),
    )
    rows: list[tuple[Cell, ...]] = []
    for name, line in run.lines.items():
        errors = {f"{e.height_m:.0f}": e for e in line.scanner.errors}
        polynomial = line.polynomial
        most = (None, None) if polynomial is None else (max(polynomial.error_px), max(polynomial.rms_px))
        rows.append((name, *(max(e.sample_px, e.line_px) for e in errors.values()), *most))
    heights = [f"ISD at {height:.0f} m [px]" for height in run.heights]
    summary = Table(
        "models",
        "Models against the rigorous sensor",
        "Largest difference over the image, of lines and samples the larger one; of the polynomials between the places "
        "that were fitted, over all heights.",
        ("line", *heights, "RPC largest [px]", "RPC rms [px]"),
        rows,
        digits=2,
    )
    known = "camera and orbit as they truly are" if run.truth else "the laboratory's camera on the measured orbit"
    if isinstance(run.source, SceneSource):
        refracted = run.source.scene.read.refracted
        known = f"the rigorous model of the file, {'with' if refracted else 'without'} refraction"
    facts = (
        ("Lines", known),
        ("Second 0 of the orbit", run.epoch),
        ("Ground", f"{low:.0f} to {high:.0f} m above the ellipsoid"),
        ("Read", _read(run)),
    )
    return Report(
        "Line cameras for other software",
        verdict,
        more,
        facts,
        summary,
        (*_sections(run), *quality_sections(run)),
        warnings=(*_warnings(run), *quality_warnings(run.quality)),
    )


def _read(run: Export) -> str:
    if isinstance(run.source, SceneSource):
        read = run.source.scene.read
        return f"{read.profile} {read.name}, DIMAP {read.version}"
    return "the run folder of a simulation" if run.source.folder is not None else "a test without images"


def _sections(run: Export) -> tuple[Section, ...]:
    rows: list[tuple[Cell, ...]] = []
    for name, line in run.lines.items():
        files = _names(line)
        window = line.window
        size = f"{window.sensor.lines} x {window.pixels}"
        rows.append((name, size, str(window.first_pixel), *(files.get(key, "") for key in ("image", "isd", "rpc"))))
    files_table = Table(
        "files",
        "Files",
        "Paths in this folder. Software that reads an image's rational polynomials finds them inside the TIFF, or in "
        "NAME_RPC.TXT beside it.",
        ("line", "lines x pixels", "first pixel", "image", "ISD", "RPC"),
        rows,
    )
    text = (
        "The community's line scanner model (ISD) interpolates station and attitude and knows nothing of what happens "
        "to the light: light time, aberration and refraction stand in the attitude and the distortion as they are at "
        "the middle height, and what they do at others is the difference in the table.",
        "Rational polynomials are smooth: what an attitude jitters from line to line is not in them.",
        "Sensor models count the corner of the image as 0, 0, polynomials the centre of its first pixel.",
    )
    return (Section("What was written", text, (files_table,)),)


def _warnings(run: Export) -> tuple[str, ...]:
    found = []
    if isinstance(run.source, SceneSource) and run.source.scene.read.inertial_velocity:
        found.append(
            "the file's velocities are against the stars, in Earth-fixed axes: omega x P has been taken off them"
        )
    if isinstance(run.source, SceneSource) and run.source.scene.read.light_speed:
        found.append(
            "the file's LIGHT_SPEED_SETTING is true: light time and aberration are not in the model, up to 13 m along "
            "the track; compare it with the product's own polynomials"
        )
    for name, line in run.lines.items():
        if line.polynomial is None:
            found.append(f"{name} has no rational polynomials: {line.refused}")
        elif max(line.polynomial.error_px) > _ROUGH:
            found.append(
                f"the rational polynomials of {name} are off by up to {significant(max(line.polynomial.error_px), 2)} "
                "pixels, as attitude and orbit are not smooth; the ISD follows them"
            )
    return tuple(found)
