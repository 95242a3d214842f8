"""What an export tells of the worth of its models: numbers, tables, maps and warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.figure import Figure

from twin.orbit.export.export_run import Controlled, Export, ProductPolynomial, Quality
from twin.orbit.export.ground_accuracy import TOGETHER, AccuracyMap
from twin.orbit.export.polynomial_control import residual_sigma
from twin.run import svg
from twin.run.artefact import Cell, SvgFigure, Table, significant
from twin.run.quantity import Quantity, Record
from twin.run.report import Section

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
