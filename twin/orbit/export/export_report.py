"""Files, quantities and report of an export.

What an export tells of the worth of its models: numbers, tables, maps and warnings.
"""

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
from twin.orbit.export.export_run import Controlled, Export, ExportedLine, ProductPolynomial, Quality, SceneSource
from twin.orbit.export.ground_accuracy import TOGETHER, AccuracyMap, GroundSigma
from twin.orbit.export.line_scanner import ModelError
from twin.orbit.export.rational_polynomial import residual_sigma

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
    Quantity("ce90_median_m", _over(lambda f: f.ce90, np.median), "of 90 % of horizontal errors", "CE90 median", 3),
    Quantity("ce90_largest_m", _over(lambda f: f.ce90, np.max), "the largest", "CE90 largest", 3),
    Quantity("le90_median_m", _over(lambda f: f.le90, np.median), "of 90 % of vertical errors", "LE90 median", 3),
    Quantity("le90_largest_m", _over(lambda f: f.le90, np.max), "the largest", "LE90 largest", 3),
    Quantity("common_m", lambda f: f.horizontal()[0], "that points have in common, of each axis", "in common", 3),
    Quantity("random_m", lambda f: f.horizontal()[1], "of measured places, without heights", "random", 3),
)
CONTROL: Record[Controlled] = Record(
    "How control points corrected a line's polynomials; measured minus predicted.",
    Quantity("kind", lambda one: one.correction.kind, "shift, or affine function of line and sample"),
    Quantity("points", lambda one: len(one.names), "how many"),
    Quantity("left_out", lambda one: one.left_out, "names of points that lie beyond their covariances"),
    Quantity("middle_px", lambda one: one.correction.middle, "line and sample from which places count"),
    Quantity("size_px", lambda one: one.correction.size, "unit of places, line and sample"),
    Quantity(
        "coefficients_px", lambda one: one.correction.coefficients, "of line and sample: constant, by line, sample"
    ),
    Quantity("covariance_px2", lambda one: one.correction.covariance, "of them, those of the line first"),
    Quantity("chi_square", lambda one: one.correction.chi_square, "of what is left, by the covariances"),
    Quantity("freedom", lambda one: one.correction.freedom, "of it"),
    Quantity("probability", lambda one: one.correction.probability, "of as large a chi-square"),
    Quantity("fit_error_px", lambda one: max(one.after.error_px), "largest of the written polynomials' fit"),
    Quantity("err_bias_m", lambda one: one.after.bias_m, "ERR_BIAS: sigma of the correction along a horizontal axis"),
    Quantity("err_rand_m", lambda one: one.after.random_m, "ERR_RAND: what scatters beyond the covariances"),
)
PRODUCT: Record[ProductPolynomial] = Record(
    "Rational polynomials that came with a scene, minus its rigorous model.",
    Quantity("file", lambda one: one.file, "where they are from"),
    Quantity("mean_line_px", lambda one: one.mean[0], "mean difference along the track", "mean, line", 3),
    Quantity("mean_sample_px", lambda one: one.mean[1], "along the line", "mean, sample", 3),
    Quantity("rms_line_px", lambda one: one.rms[0], "root mean square about the mean, along the track", "rms, line", 3),
    Quantity("rms_sample_px", lambda one: one.rms[1], "along the line", "rms, sample", 3),
    Quantity("largest_px", lambda one: one.most, "largest of all", "largest", 3),
    Quantity("heights_m", lambda one: one.heights, "lowest and highest ground of the polynomials, which is compared"),
)


def quality_sections(quality: Quality) -> tuple[Section, ...]:
    """Sections of what was asked for; none for nothing."""
    parts: list[Section] = []
    if quality.products:
        table = PRODUCT.table(
            "product_rpc",
            "The product's own polynomials",
            "Polynomials minus rigorous model; rms about the mean. A mean along the track of 12 m would be the "
            "aberration of the light, which the rigorous model does not have.",
            {name: PRODUCT(one) for name, one in quality.products.items()},
            PRODUCT.headed,
            "line",
        )
        parts.append(Section(table.title, (), (table,), name="product"))
    parts += [control_section(quality.control)] if quality.control else []
    return (*parts, *([_map_section(quality.maps)] if quality.maps else ()))


def quality_answers(quality: Quality) -> tuple[str, ...]:
    """Sentences for the head of a page."""
    found = []
    for name, one in quality.control.items():
        used = int(np.sum(one.correction.used))
        bias = significant(one.after.bias_m or 0.0, 2)
        how = "a shift" if one.correction.kind == "shift" else "an affine function"
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


def quality_warnings(quality: Quality) -> tuple[str, ...]:
    """Warnings of polynomials and control points."""
    found = []
    for name, product in quality.products.items():
        if product.most > _OFF:
            found.append(
                f"the polynomials of the product are off the rigorous model of {name} by up to "
                f"{significant(product.most, 2)} pixels"
            )
    for name, one in quality.control.items():
        correction = one.correction
        if left := one.left_out:
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


def control_section(control: Mapping[str, Controlled]) -> Section:
    """Corrections and residuals of every line."""
    rows: list[tuple[Cell, ...]] = []
    points: list[tuple[Cell, ...]] = []
    for name, one in control.items():
        correction = one.correction
        at = correction.at(*correction.middle)[0]
        sigma = np.sqrt(np.diagonal(correction.covariance_at(*correction.middle)[0]))
        middle = np.stack([at, sigma], axis=-1).ravel().tolist()
        rows.append((name, *middle, correction.chi_square, correction.freedom))
        left = np.stack([correction.residual, residual_sigma(correction)], axis=-1).reshape(len(one.names), -1)
        for point, numbers, used in zip(one.names.tolist(), left.tolist(), correction.used.tolist(), strict=True):
            points.append((name, str(point), *numbers, "used" if used else "left out"))
    heads = ("line [px]", "sigma [px]", "sample [px]", "sigma [px] ")
    table = Table(
        "correction",
        "Correction in the middle of the points",
        "Measured minus predicted; sigmas are those of the control points on the ground and in the image, and of "
        "nothing else.",
        ("line", *heads, "chi-square", "freedom"),
        rows,
        digits=4,
    )
    caption = f"After the correction, with what they are expected to be{'; the first' * (len(points) > _MOST_ROWS)}."
    full = Table("control", "Residuals", caption, ("line", "point", *heads, ""), points[:_MOST_ROWS], digits=3)
    return Section("Control points", (), (table, full), folded=1, name="control")


def _map_section(maps: Mapping[str, AccuracyMap]) -> Section:
    points: list[tuple[Cell, ...]] = []
    for name, found in maps.items():
        places = (found.line, found.pixel, np.degrees(found.longitude), np.degrees(found.latitude))
        height = np.full_like(found.line, found.height)
        sigma = np.sqrt(np.einsum("nii->ni", found.covariance))
        columns = np.stack([*places, height, found.ce90, found.le90, *sigma.T], axis=-1)[found.seen]
        points += [(_called(name), *row) for row in columns.tolist()]
    table = ACCURACY.table(
        "accuracy",
        "Errors on the ground",
        "CE90: radius of the circle that holds 90 % of the horizontal errors; LE90: half the interval that holds 90 % "
        "of the vertical ones, of one line those of its heights from elsewhere. In common: errors of camera, orbit and "
        "attitude; random: of the measured places.",
        {_called(name): ACCURACY(found) for name, found in maps.items()},
        ACCURACY.headed,
        "points of",
    )
    heads = ("points of", "line", "pixel", "longitude [deg]", "latitude [deg]", "height [m]", "CE90 [m]", "LE90 [m]")
    sigmas = ("sigma east [m]", "sigma north [m]", "sigma up [m]")
    grid = Table("accuracy_map", "Map", "All points of the grids.", (*heads, *sigmas), points, digits=7)
    caption = "CE90, and LE90 of intersected points, over each image's ground."
    figure = SvgFigure("accuracy-map", "Map", caption, svg.drawn("accuracy-map", _figure, maps))
    return Section("Accuracy on the ground", (), (table, figure, grid), folded=1, name="accuracy")


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
    Quantity("lines", lambda line: line.window.sensor.lines, "how many", "lines"),
    Quantity("pixels", lambda line: line.window.pixels, "how many", "pixels"),
    Quantity("first_pixel", lambda line: line.window.first_pixel, "of the image on the line", "first pixel"),
    Quantity("first_line_time_s", lambda line: line.window.sensor.first_line_time, "from the epoch"),
    Quantity("line_time_s", lambda line: line.window.sensor.line_time, "from one line to the next"),
    Quantity("image", lambda line: _names(line).get("image"), "GeoTIFF with the polynomials inside", "image"),
    Quantity("isd", lambda line: _names(line)["isd"], "image support data of the community sensor model", "ISD"),
    Quantity("rpc", lambda line: _names(line).get("rpc"), "rational polynomials", "RPC"),
    Quantity("isd_nodes", lambda line: len(line.scanner.camera.seconds), "times at which station and attitude stand"),
    Quantity("isd_errors", lambda line: line.scanner.errors, "at every height", record=ISD_ERROR),
    Quantity("rpc_errors", lambda line: line.polynomial, "over all heights", record=RPC_ERROR),
    Quantity("rpc_refused", lambda line: line.refused or None, "why there are no polynomials"),
    Quantity("ground", lambda line: line.ground, "uncertain of a camera's change", record=GROUND, where_known=True),
)
EXPORT: Record[Export] = Record(
    "export.json. Line cameras for other software.",
    Quantity("epoch_utc", lambda run: run.epoch, "second 0 of the orbit"),
    Quantity("truth", lambda run: run.truth, "whether camera and orbit are the true ones"),
    Quantity("heights_m", lambda run: run.heights, "of the ground that models were fitted to: lowest, middle, highest"),
    Quantity("lines", lambda run: run.lines, "every line and its models", record=LINE),
    Quantity("accuracy", lambda run: run.quality.maps or None, "line or `together`", record=ACCURACY, where_known=True),
    Quantity("control", lambda run: run.quality.control or None, "by line", record=CONTROL, where_known=True),
    Quantity("product_rpc", lambda run: run.quality.products or None, "by line", record=PRODUCT, where_known=True),
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
            note = f"second 0 of its orbit is {run.epoch}"
            facts = FrameFacts(line.window.name, line.window.pitch, note=note, place=line.polynomial)
            found[names["image"]] = bytes(tiff(line.window.frame[None], facts))
    return found


_ROUGH = 0.1
"""Pixels: a model that is further off is worth a warning."""


def export_report(run: Export) -> Report:
    """What was written, and how well it agrees with the rigorous sensor."""
    isd = max((e.worst_px, name) for name, line in run.lines.items() for e in line.scanner.errors)
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
        polynomial = line.polynomial
        most = (None, None) if polynomial is None else (max(polynomial.error_px), max(polynomial.rms_px))
        rows.append((name, *(one.worst_px for one in line.scanner.errors), *most))
    summary = Table(
        "models",
        "Models against the rigorous sensor",
        "Largest difference over the image, of lines and samples the larger one; of the polynomials between the places "
        "that were fitted, over all heights.",
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
    known = "camera and orbit as they truly are" if run.truth else "the laboratory's camera on the measured orbit"
    if isinstance(run.source, SceneSource):
        scene = run.source.scene.read
        known = f"the rigorous model of the file, {'with' if scene.refracted else 'without'} refraction"
        read = f"{scene.profile} {scene.name}, DIMAP {scene.version}"
    facts = (
        ("Lines", known),
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
        (Section("What was written", (), (files,)), *quality_sections(run.quality)),
        warnings=(*_warnings(run), *quality_warnings(run.quality)),
    )


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
