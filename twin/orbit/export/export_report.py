"""Files, result keys (export.json) and report of an export, with the accuracy of the exported models."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.figure import Figure

from analysis.orbit.rational_polynomial import RationalPolynomial
from twin.framework import svg
from twin.framework.artefact import Cell, SvgFigure, Table, significant
from twin.framework.data_files import FrameFacts, tiff
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer
from twin.orbit.export import export_run
from twin.orbit.export.ground_accuracy import TOGETHER, AccuracyMap, GroundSigma
from twin.orbit.export.line_scanner import ModelError
from twin.orbit.export.rational_polynomial import residual_sigma

_UNLIKELY = 1e-3
"""p-value of chi-square below which the covariances given for control points are reported as too small."""
_MOST_PANELS = 6
_MOST_ROWS = 400
"""Largest number of control points in the table of a report."""
_OFF = 1.0
"""Difference of a product's polynomials from the rigorous model, in pixels, above which there is a warning."""


def _over(
    values: Callable[[AccuracyMap], np.ndarray], statistic: Callable[[np.ndarray], float]
) -> Callable[[AccuracyMap], float]:
    return lambda accuracy: float(statistic(values(accuracy)[accuracy.valid]))


ACCURACY: Record[AccuracyMap] = Record(
    "Errors on the ground of points over a scene, by the uncertainty of camera, orbit and attitude.",
    Quantity("height_m", lambda heights: heights.height, "height of the ground above the ellipsoid"),
    Quantity("points", lambda heights: int(np.sum(heights.valid)), "number of points of the grid"),
    Quantity("ce90_median_m", _over(lambda f: f.ce90, np.median), "90% horizontal error", "CE90 median", 3),
    Quantity("ce90_largest_m", _over(lambda f: f.ce90, np.max), "largest 90% horizontal error", "CE90 largest", 3),
    Quantity("le90_median_m", _over(lambda f: f.le90, np.median), "90% vertical error", "LE90 median", 3),
    Quantity("le90_largest_m", _over(lambda f: f.le90, np.max), "largest 90% vertical error", "LE90 largest", 3),
    Quantity("common_m", lambda f: f.horizontal()[0], "error that points share, per axis", "shared", 3),
    Quantity("random_m", lambda f: f.horizontal()[1], "by measured positions, without heights", "random", 3),
)
CONTROL: Record[export_run.ControlledPolynomial] = Record(
    "Correction of a line's polynomials by control points, measured minus predicted.",
    Quantity("kind", lambda c: c.correction.kind, "shift, or affine function of line and sample"),
    Quantity("points", lambda c: len(c.names), "number of control points"),
    Quantity("rejected_points", lambda c: c.rejected_points, "names of points that lie beyond their covariances"),
    Quantity("middle_px", lambda c: c.correction.middle, "origin of the positions, line and sample"),
    Quantity("size_px", lambda c: c.correction.size, "unit of the positions, line and sample"),
    Quantity("coefficients_px", lambda c: c.correction.coefficients, "of line and sample: constant, by line, sample"),
    Quantity("covariance_px2", lambda c: c.correction.covariance, "covariance of the coefficients, line first"),
    Quantity("chi_square", lambda c: c.correction.chi_square, "chi-square of the residuals, by the covariances"),
    Quantity("freedom", lambda c: c.correction.freedom, "degrees of freedom of chi-square"),
    Quantity("probability", lambda c: c.correction.probability, "p-value of chi-square"),
    Quantity("fit_error_px", lambda c: max(c.after.error_px), "largest error of the written polynomials' fit"),
    Quantity("err_bias_m", lambda c: c.after.bias_m, "ERR_BIAS: sigma of the correction along a horizontal axis"),
    Quantity("err_rand_m", lambda c: c.after.random_m, "ERR_RAND: scatter beyond the covariances"),
)
PRODUCT: Record[export_run.ProductPolynomial] = Record(
    "Rational polynomials that came with a scene, minus its rigorous model.",
    Quantity("file", lambda p: p.file, "file of the polynomials"),
    Quantity("mean_line_px", lambda p: p.mean[0], "mean difference along the track", "mean, line", 3),
    Quantity("mean_sample_px", lambda p: p.mean[1], "mean difference along the line", "mean, sample", 3),
    Quantity("rms_line_px", lambda p: p.rms[0], "RMS about the mean, along the track", "rms, line", 3),
    Quantity("rms_sample_px", lambda p: p.rms[1], "RMS about the mean, along the line", "rms, sample", 3),
    Quantity("largest_px", lambda p: p.largest, "largest difference", "largest", 3),
    Quantity("heights_m", lambda p: p.heights, "lowest and highest ground of the polynomials, which is compared"),
)


def quality_sections(quality: export_run.Quality) -> tuple[Section, ...]:
    """Return the sections on product polynomials, control points and accuracy maps that were requested."""
    parts: list[Section] = []
    if quality.products:
        table = PRODUCT.table(
            "product_rpc",
            "The product's own polynomials",
            "Polynomials minus rigorous model; rms about the mean. A mean along the track of 12 m would be the "
            "aberration of light, which the rigorous model does not include.",
            {name: PRODUCT(product) for name, product in quality.products.items()},
            PRODUCT.headed,
            "line",
        )
        parts.append(Section(table.title, (), (table,), name="product"))
    parts += [control_section(quality.control)] if quality.control else []
    return (*parts, *([_map_section(quality.maps)] if quality.maps else ()))


def quality_answers(quality: export_run.Quality) -> tuple[str, ...]:
    """Return sentences on control points and accuracy for the beginning of a report."""
    sentences = []
    for name, controlled in quality.control.items():
        used = int(np.sum(controlled.correction.used))
        bias = significant(controlled.after.bias_m or 0.0, 2)
        form = "a shift" if controlled.correction.kind == "shift" else "an affine function"
        sentences.append(
            f"{used} of {len(controlled.names)} control points correct the polynomials of {name} by {form}, to {bias} "
            "m on the ground along each axis"
        )
    if quality.maps:
        name, worst = max(quality.maps.items(), key=lambda item: float(np.nanmax(item[1].ce90)))
        whose = "intersected points" if name == TOGETHER else f"points of {name}"
        sentences.append(f"CE90 is at most {significant(float(np.nanmax(worst.ce90)), 3)} m, of {whose}")
        intersected = quality.maps.get(TOGETHER)
        if intersected is not None:
            sentences.append(
                f"LE90 of intersected points is at most {significant(float(np.nanmax(intersected.le90)), 3)} m"
            )
    return tuple(sentences)


def quality_warnings(quality: export_run.Quality) -> tuple[str, ...]:
    """Return warnings of product polynomials and control points."""
    warnings = []
    for name, product in quality.products.items():
        if product.largest > _OFF:
            warnings.append(
                f"the polynomials of the product differ from the rigorous model of {name} by up to "
                f"{significant(product.largest, 2)} pixels"
            )
    for name, controlled in quality.control.items():
        correction = controlled.correction
        if rejected := controlled.rejected_points:
            warnings.append(
                f"control points of {name} lie beyond their covariances and are rejected: {', '.join(rejected[:10])}"
            )
        if correction.probability < _UNLIKELY:
            warnings.append(
                f"control points of {name} scatter by {significant(np.sqrt(correction.factor), 2)} times their sigmas: "
                "ERR_RAND states it, and sigmas of the correction are too small by as much"
            )
        if correction.freedom == 0:
            warnings.append(f"no redundant control point of {name} checks its correction")
    if quality.control:
        warnings.append("the correction by control points is in the polynomials, not in the ISD")
    return tuple(warnings)


def control_section(control: Mapping[str, export_run.ControlledPolynomial]) -> Section:
    """Return the report section with each line's correction by control points and its residuals."""
    rows: list[tuple[Cell, ...]] = []
    points: list[tuple[Cell, ...]] = []
    for name, line in control.items():
        correction = line.correction
        at = correction.at(*correction.middle)[0]
        sigma = np.sqrt(np.diagonal(correction.covariance_at(*correction.middle)[0]))
        middle = np.stack([at, sigma], axis=-1).ravel().tolist()
        rows.append((name, *middle, correction.chi_square, correction.freedom))
        residuals = np.stack([correction.residual, residual_sigma(correction)], axis=-1).reshape(len(line.names), -1)
        for point, numbers, used in zip(line.names.tolist(), residuals.tolist(), correction.used.tolist(), strict=True):
            points.append((name, str(point), *numbers, "used" if used else "rejected"))
    heads = ("line [px]", "sigma [px]", "sample [px]", "sigma [px] ")
    table = Table(
        "correction",
        "Correction in the middle of the points",
        "Measured minus predicted; sigmas contain only the errors of the control points on the ground and in the "
        "image.",
        ("line", *heads, "chi-square", "freedom"),
        rows,
        digits=4,
    )
    caption = f"After the correction, with expected sigmas{'; the first points' * (len(points) > _MOST_ROWS)}."
    full = Table("control", "Residuals", caption, ("line", "point", *heads, ""), points[:_MOST_ROWS], digits=3)
    return Section("Control points", (), (table, full), folded=1, name="control")


def _map_section(maps: Mapping[str, AccuracyMap]) -> Section:
    points: list[tuple[Cell, ...]] = []
    for name, accuracy in maps.items():
        coordinates = (accuracy.line, accuracy.pixel, np.degrees(accuracy.longitude), np.degrees(accuracy.latitude))
        height = np.full_like(accuracy.line, accuracy.height)
        sigma = np.sqrt(np.einsum("nii->ni", accuracy.covariance))
        columns = np.stack([*coordinates, height, accuracy.ce90, accuracy.le90, *sigma.T], axis=-1)[accuracy.valid]
        points += [(_map_title(name), *row) for row in columns.tolist()]
    table = ACCURACY.table(
        "accuracy",
        "Errors on the ground",
        "CE90: radius of the circle that holds 90 % of the horizontal errors; LE90: half the interval that holds 90 % "
        "of the vertical ones, for a single line those of its heights from another source. Shared: errors of camera, "
        "orbit and attitude; random: of the measured positions.",
        {_map_title(name): ACCURACY(accuracy) for name, accuracy in maps.items()},
        ACCURACY.headed,
        "points of",
    )
    heads = ("points of", "line", "pixel", "longitude [deg]", "latitude [deg]", "height [m]", "CE90 [m]", "LE90 [m]")
    sigmas = ("sigma east [m]", "sigma north [m]", "sigma up [m]")
    grid = Table("accuracy_map", "Map", "All points of the grids.", (*heads, *sigmas), points, digits=7)
    caption = "CE90, and LE90 of intersected points, over each image's ground."
    figure = SvgFigure("accuracy-map", "Map", caption, svg.drawn("accuracy-map", _figure, maps))
    return Section("Accuracy on the ground", (), (table, figure, grid), folded=1, name="accuracy")


def _map_title(name: str) -> str:
    return "all lines, intersected" if name == TOGETHER else name


def _figure(maps: Mapping[str, AccuracyMap]) -> Figure:
    """Draw maps of CE90 in metres, and of LE90 for intersected points, in a panel each."""
    panels = [(f"CE90, {_map_title(name)}", accuracy, accuracy.ce90) for name, accuracy in maps.items()]
    panels += [
        (f"LE90, {_map_title(name)}", accuracy, accuracy.le90) for name, accuracy in maps.items() if name == TOGETHER
    ]
    panels = panels[-_MOST_PANELS:]
    wide = min(3, len(panels))
    figure = svg.new_figure(3.4 * -(-len(panels) // wide))
    for k, (title, accuracy, values) in enumerate(panels):
        axes = figure.add_subplot(-(-len(panels) // wide), wide, k + 1)
        seen = accuracy.valid
        longitude, latitude = np.degrees(accuracy.longitude[seen]), np.degrees(accuracy.latitude[seen])
        marks = axes.scatter(longitude, latitude, c=values[seen], s=26, marker="s", cmap="viridis", linewidths=0.0)
        axes.set_aspect(1.0 / max(float(np.cos(np.radians(np.mean(latitude)))), 0.05), adjustable="datalim")
        axes.set(title=f"{title} [m]", xlabel="longitude [deg]", ylabel="latitude [deg]")
        axes.ticklabel_format(useOffset=False)
        axes.locator_params(nbins=4)
        svg.plain_axes(axes)
        figure.colorbar(marks, ax=axes, shrink=0.8)
    return figure


FOLDER = "models"
"""Name of the folder of the camera models in the run folder."""


def _names(line: export_run.ExportedLine) -> dict[str, str]:
    """Return the paths in the run folder of a line's support data (ISD), and of its image and RPC if there are any."""
    stem = f"{FOLDER}/{line.window.name}"
    names = {"isd": f"{stem}.json"}
    if line.window.frame is not None:
        names["image"] = f"{stem}.tif"
    if line.polynomial is not None:
        names["rpc"] = f"{stem}_RPC.TXT"
    return names


ISD_ERROR: Record[ModelError] = Record(
    "Largest difference of the community sensor model from the rigorous sensor over the image, at one height.",
    Quantity("height_m", lambda error: error.height_m, "height above the ellipsoid"),
    Quantity("sample_px", lambda error: error.sample_px, "difference along the line"),
    Quantity("line_px", lambda error: error.line_px, "difference along the track"),
)
RPC_ERROR: Record[RationalPolynomial] = Record(
    "Difference of the polynomials from the rigorous sensor between the fitted points.",
    Quantity("largest_line_px", lambda model: model.error_px[0], "largest difference along the track"),
    Quantity("largest_sample_px", lambda model: model.error_px[1], "largest difference along the line"),
    Quantity("rms_line_px", lambda model: model.rms_px[0], "root mean square along the track"),
    Quantity("rms_sample_px", lambda model: model.rms_px[1], "root mean square along the line"),
)
GROUND: Record[GroundSigma] = Record(
    "Error on the ground by the camera's estimated change, root mean square over the image.",
    Quantity("height_m", lambda sigma: sigma.height_m, "height of the ground above the ellipsoid"),
    Quantity("err_bias_m", lambda sigma: sigma.bias_m, "ERR_BIAS: per horizontal axis, shared with other images"),
    Quantity("err_rand_m", lambda sigma: sigma.random_m, "ERR_RAND: per horizontal axis, independent in every image"),
    Quantity("bias_east_m", lambda sigma: sigma.bias_east_m, "shared part to the east"),
    Quantity("bias_north_m", lambda sigma: sigma.bias_north_m, "shared part to the north"),
    Quantity("random_east_m", lambda sigma: sigma.random_east_m, "independent part to the east"),
    Quantity("random_north_m", lambda sigma: sigma.random_north_m, "independent part to the north"),
)
LINE: Record[export_run.ExportedLine] = Record(
    "Image and models of a line; files are paths in the run folder, null for those that were not written.",
    Quantity("lines", lambda line: line.window.sensor.lines, "number of image lines", "lines"),
    Quantity("pixels", lambda line: line.window.pixels, "number of pixels", "pixels"),
    Quantity("first_pixel", lambda line: line.window.first_pixel, "first pixel of the image", "first pixel"),
    Quantity("first_line_time_s", lambda line: line.window.sensor.first_line_time, "time from the epoch"),
    Quantity("line_time_s", lambda line: line.window.sensor.line_time, "time from one line to the next"),
    Quantity("image", lambda line: _names(line).get("image"), "GeoTIFF with the polynomials inside", "image"),
    Quantity("isd", lambda line: _names(line)["isd"], "image support data of the community sensor model", "ISD"),
    Quantity("rpc", lambda line: _names(line).get("rpc"), "rational polynomials", "RPC"),
    Quantity("isd_nodes", lambda line: len(line.scanner.camera.seconds), "number of nodes of station and attitude"),
    Quantity("isd_errors", lambda line: line.scanner.errors, "differences at every height", record=ISD_ERROR),
    Quantity("rpc_errors", lambda line: line.polynomial, "differences over all heights", record=RPC_ERROR),
    Quantity("rpc_refused", lambda line: line.refused or None, "reason why there are no polynomials"),
    Quantity("ground", lambda line: line.ground, "error by a camera's change", record=GROUND, where_known=True),
)
EXPORT: Record[export_run.Export] = Record(
    "Content of export.json: line cameras for other software.",
    Quantity("epoch_utc", lambda run: run.epoch, "second 0 of the orbit"),
    Quantity("truth", lambda run: run.truth, "true if camera and orbit are the true ones"),
    Quantity("heights_m", lambda run: run.heights, "ground to which models were fitted: lowest, middle, highest"),
    Quantity("lines", lambda run: run.lines, "models of every line", record=LINE),
    Quantity("accuracy", lambda run: run.quality.maps or None, "line or `together`", record=ACCURACY, where_known=True),
    Quantity("control", lambda run: run.quality.control or None, "by line", record=CONTROL, where_known=True),
    Quantity("product_rpc", lambda run: run.quality.products or None, "by line", record=PRODUCT, where_known=True),
)


def export_files(run: export_run.Export) -> dict[str, bytes]:
    """Return the files of an export, path -> content.

    Each line has an ISD, an RPC file, and its image as a GeoTIFF with the RPC inside.
    """
    files = {}
    for line in run.lines.values():
        names = _names(line)
        files[names["isd"]] = (json.dumps(line.scanner.isd, allow_nan=False) + "\n").encode()
        if line.polynomial is not None:
            files[names["rpc"]] = line.polynomial.text().encode()
        if line.window.frame is not None:
            note = f"second 0 of its orbit is {run.epoch}"
            facts = FrameFacts(line.window.name, line.window.pitch, note=note, georeference=line.polynomial)
            files[names["image"]] = bytes(tiff(line.window.frame[None], facts))
    return files


_ROUGH = 0.1
"""Difference of rational polynomials from the rigorous sensor, in pixels, above which there is a warning."""


def export_report(run: export_run.Export) -> Report:
    """Return the report of an export: its files, and their differences from the rigorous sensor."""
    isd = max((e.worst_px, name) for name, line in run.lines.items() for e in line.scanner.errors)
    rpc = [(max(line.polynomial.error_px), name) for name, line in run.lines.items() if line.polynomial is not None]
    (largest, worst), (low, _, high) = max(rpc, default=(0.0, "")), run.heights
    images = sum(line.window.frame is not None for line in run.lines.values())
    verdict, more = answer(
        f"The folder contains {len(run.lines)} lines as community sensor models and rational polynomials"
        + (f", with {images} images" if images else ""),
        f"on ground {low:.0f} to {high:.0f} m high the sensor models are within {significant(isd[0], 2)} pixels of the "
        f"rigorous sensor ({isd[1]} is the worst)",
        f"the rational polynomials reproduce the sensor model within {significant(largest, 2)} px (largest: {worst})"
        if rpc
        else "there are no polynomials",
        *quality_answers(run.quality),
    )
    rows: list[tuple[Cell, ...]] = []
    for name, line in run.lines.items():
        polynomial = line.polynomial
        errors_px = (None, None) if polynomial is None else (max(polynomial.error_px), max(polynomial.rms_px))
        rows.append((name, *(error.worst_px for error in line.scanner.errors), *errors_px))
    summary = Table(
        "models",
        "Models against the rigorous sensor",
        "Largest difference over the image, in lines or samples; for the polynomials, between the fitted points over "
        "all heights.",
        ("line", *(f"ISD at {height:.0f} m [px]" for height in run.heights), "RPC largest [px]", "RPC rms [px]"),
        rows,
        digits=2,
    )
    files = LINE.table(
        "files",
        "Files",
        "Paths in this folder. Software that reads an image's rational polynomials finds them inside the TIFF, or in "
        "NAME_RPC.TXT beside it. Sensor models count the corner of the image as 0, 0, polynomials the centre of its "
        "first pixel.",
        {name: LINE(line) for name, line in run.lines.items()},
        LINE.headed,
        "line",
    )
    read = "the run folder of a simulation" if run.source.folder is not None else "a test without images"
    model = "true camera and orbit" if run.truth else "the laboratory's camera on the measured orbit"
    if isinstance(run.source, export_run.SceneSource):
        scene = run.source.scene.read
        model = f"the rigorous model of the file, {'with' if scene.refracted else 'without'} refraction"
        read = f"{scene.profile} {scene.name}, DIMAP {scene.version}"
    facts = (
        ("Lines", model),
        ("Second 0 of the orbit", run.epoch),
        ("Ground", f"{low:.0f} to {high:.0f} m above the ellipsoid"),
        ("Read", read),
    )
    return Report(
        "Line cameras for other software",
        verdict,
        more,
        facts,
        summary,
        (Section("Files", (), (files,)), *quality_sections(run.quality)),
        warnings=(*_warnings(run), *quality_warnings(run.quality)),
    )


def _warnings(run: export_run.Export) -> tuple[str, ...]:
    warnings = []
    if isinstance(run.source, export_run.SceneSource) and run.source.scene.read.inertial_velocity:
        warnings.append("the file's velocities are inertial, in Earth-fixed axes: omega x P has been subtracted")
    if isinstance(run.source, export_run.SceneSource) and run.source.scene.read.light_speed:
        warnings.append(
            "the file's LIGHT_SPEED_SETTING is true: light time and aberration are not in the model, up to 13 m along "
            "the track; compare it with the product's own polynomials"
        )
    for name, line in run.lines.items():
        if line.polynomial is None:
            warnings.append(f"{name} has no rational polynomials: {line.refused}")
        elif max(line.polynomial.error_px) > _ROUGH:
            warnings.append(
                f"the rational polynomials of {name} are off by up to {significant(max(line.polynomial.error_px), 2)} "
                "pixels, because attitude and orbit are not smooth; the ISD follows them"
            )
    return tuple(warnings)
