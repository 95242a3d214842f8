"""Report of a simulated pass over a patch: tables, figures, files.

Report of points measured in images: listing, tables and figures.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from scenes.specs.orbit.scene import ImagePointsSpec
from scenes.yaml.units import LENGTH, format_quantity
from twin.framework import svg
from twin.framework.artefact import Artefact, Cell, CsvFile, Data, PngFigure, SvgFigure, Table, rounded_down
from twin.framework.data_files import FrameFacts, MapGeoreference
from twin.framework.record import described
from twin.framework.report import Report, Section, answer, inputs
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images import simulate_run
from twin.orbit.images.image_points import CONSENSUS, ImagedGround, LineFrame, MatchedPoints, PatchPoints, status_text
from twin.orbit.images.patch import WRONG, Patch, judged

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import InteriorChangeSpec
    from scenes.specs.orbit.setup import SimulateSetup


def pixel_axes(axes: Axes) -> None:
    """Label the axes of an image in a figure with a few whole numbers of pixels and lines.

    The limits of the axes must be set before.
    """
    axes.set(xlabel="pixel", ylabel="line")
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")


def listing(patch: ImagedGround, points: PatchPoints) -> str:
    """Return the text of a CSV file of measured points, one row for each point and line; missing values are empty."""
    parts = []
    for sort, group in points.sorts.items():
        longitude, latitude = np.degrees(patch.frame.geographic(group.east, group.north))
        kind, number = np.where(group.check, "check", sort), np.arange(len(group.ground))
        ground = {"longitude_deg": longitude, "latitude_deg": latitude, "height_m": group.height}
        ground |= dict(zip(("x_itrs_m", "y_itrs_m", "z_itrs_m"), group.ground.T, strict=True))
        for name, line in group.lines.items():
            sigma = np.sqrt(np.diagonal(line.covariance, axis1=1, axis2=2))
            with np.errstate(invalid="ignore", divide="ignore"):
                together = line.covariance[:, 0, 1] / np.prod(sigma, axis=1)
            image = np.concatenate([line.predicted + np.array(line.first), line.image, sigma], axis=1)
            heads = ("predicted_line", "predicted_pixel", "line", "pixel", "line_sigma", "pixel_sigma")
            measured = dict(zip(heads, np.where(np.isfinite(image), image, np.nan).T, strict=True))
            measured |= {"correlation_of_sigmas": together, "template_correlation": line.correlation}
            status = {"accepted": line.accepted.astype(int), "status": [status_text(c) for c in line.status.tolist()]}
            parts.append(pd.DataFrame({"sort": kind, "point": number, "line_name": name} | ground | measured | status))
    return pd.concat(parts).to_csv(index=False, lineterminator="\n")


T = TypeVar("T")
_DPI = 110
"""Resolution of the figures, in dots per inch."""
SORTS = {"control": "orthophoto", "tie": "tie"}
"""Names in reports of the kinds of points, by key."""


def how_measured(spec: ImagePointsSpec, known: str) -> str:
    """Return a description of how points are measured in images.

    Parameters
    ----------
    spec : ImagePointsSpec
        Options of the measurement.
    known : str
        Description of the sensor that predicts the points' positions in each line's image.
    """
    return (
        "Distinct points of the orthophoto, with heights of the elevation model, and distinct points of one line's "
        f"image are transformed to each line's geometry by {known}. Templates of {spec.template} pixels are searched "
        f"{spec.search_radius} pixels to each side and fitted by least squares. Points are rejected that fail a "
        "threshold of the matching or do not follow the smooth displacement of their neighbours."
    )


def points_section(patch: Patch, points: PatchPoints, spec: ImagePointsSpec) -> Section:
    """Return the report section on the points measured in a patch: numbers, figures and listing."""
    shown = point_artefacts(patch, points, found_table(points), _true(patch, points))
    return Section("Measured points", (how_measured(spec, "the measured sensor"),), shown)


def point_artefacts(patch: ImagedGround, points: PatchPoints, *tables: Table) -> tuple[Artefact, ...]:
    """Return the report's parts on measured points: tables, figures, reasons of rejections, and listing."""
    figures = [
        PngFigure(
            f"points-{sort}",
            f"Displacement from predicted to measured, {SORTS[sort]} points",
            "Arrows: displacements less their median in the title, enlarged by the factor there; crosses: rejected "
            "by the consensus of the neighbours; points: not matched.",
            points_png(patch, group),
        )
        for sort, group in points.sorts.items()
    ]
    caption = "Each point in each line: ground coordinates, image coordinates, sigmas of the fit, status."
    listed = CsvFile("points", "Points", caption, listing(patch, points))
    return *tables, *figures, _lost_table(points), listed


def flat(points: PatchPoints, below: Callable[[MatchedPoints], Mapping[str, T]]) -> dict[str, T]:
    """Return results by kind of point and line in one mapping, with names such as "tie, forward"."""
    groups = ((sort, below(group)) for sort, group in points.sorts.items())
    return {f"{SORTS[sort]}, {name}": line for sort, lines in groups for name, line in lines.items()}


def found_table(points: PatchPoints) -> Table:
    """Return the table of the points that were matched, by kind and line."""
    matches = flat(points, lambda group: group.searched_lines)
    rows = {name: simulate_run.MATCHED(line) for name, line in matches.items() if line.accepted.any()}
    caption = (
        "Displacement from predicted to measured and sigma: medians of the accepted, px along the track and the line."
    )
    displacement = ("displacement_lines_px", "displacement_pixels_px")
    keys = ("measured", "matched", "accepted", *displacement, *(f"{key}_sigma" for key in displacement))
    return simulate_run.MATCHED.table("points-found", "Matching", caption, rows, keys, "points, line", digits=4)


def _true(patch: Patch, points: PatchPoints) -> Table:
    """Return the table that compares the measured points with their true image positions."""
    rows = {
        name: simulate_run.COMPARED(line)
        for name, line in flat(points, lambda quantity: judged(patch, quantity)).items()
    }
    caption = (
        f"Wrong: {WRONG}; counted among all measured points, those that passed the matching, and those that passed the "
        "consensus. RMS and mean error, px, and chi-square of the right points."
    )
    keys = [quantity.key for quantity in simulate_run.COMPARED][:-1]
    return simulate_run.COMPARED.table(
        "points-truth", "Comparison with the truth", caption, rows, keys, "points, line", digits=4
    )


def _lost_table(points: PatchPoints) -> Table:
    """Return the table of the reasons why points were not accepted."""
    rows: list[tuple[Cell, ...]] = []
    for sort, group in points.sorts.items():
        count = {name: line.rejections for name, line in group.searched_lines.items()}
        total: Counter[str] = Counter()
        for reasons in count.values():
            total.update(reasons)
        for text, _ in total.most_common():
            rows.append((SORTS[sort], text, ", ".join(f"{n} {c.get(text, 0)}" for n, c in count.items())))
    return Table("points-lost", "Why points were not accepted", "", ("points", "reason", "number"), rows)


def points_png(patch: ImagedGround, points: MatchedPoints) -> bytes:
    """Return a PNG of every line's frame with its points and their displacements."""
    with svg.look(f"points-{points.kind}"):
        names = list(points.searched_lines)
        figure = svg.new_figure(4.3 if len(names) > 2 else 5.6)
        panels = np.atleast_1d(figure.subplots(1, len(names)))
        for axes, name in zip(panels, names, strict=True):
            _panel(axes, name, patch.images[name], points)
        marks = [
            Line2D([], [], color=svg.YELLOW, marker=r"$\rightarrow$", ls="", ms=9, label="accepted"),
            Line2D([], [], color=svg.VERMILION, marker="x", ls="", label="rejected by consensus"),
            Line2D([], [], color=svg.SKY, marker=".", ls="", label="not matched"),
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=3, labelcolor="black")
        return svg.to_png(figure, _DPI)


def _panel(axes: Axes, name: str, image: LineFrame, points: MatchedPoints) -> None:
    """Draw one line's frame with its points and their displacements."""
    line = points.lines[name]
    _show_image(axes, name, image, alpha=0.75)
    rows, columns = image.frame.shape
    ends = *axes.get_xlim(), *axes.get_ylim()
    at, to = line.predicted + np.array(line.first), line.image
    # Adding zero removes a minus before zero.
    middle = np.round(line.median_shift, 1) + 0.0
    rest = to - at - middle
    good, against = line.accepted, line.status == CONSENSUS
    longest = float(np.quantile(np.linalg.norm(rest[good], axis=1), 0.95))
    enlarged = rounded_down(0.06 * min(rows, columns) / max(longest, 1e-3))
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / enlarged, "width": 0.004}
    effects = [Stroke(linewidth=1.2, foreground="black"), Normal()]
    axes.quiver(to[good, 1], to[good, 0], rest[good, 1], rest[good, 0], color=svg.YELLOW, path_effects=effects, **arrow)
    axes.plot(to[against, 1], to[against, 0], "x", color=svg.VERMILION, ms=6, mew=1.6)
    unmatched = ~good & ~against
    # Points that were not matched are drawn at their expected position.
    axes.plot(
        at[unmatched, 1] + middle[1], at[unmatched, 0] + middle[0], ".", color=svg.SKY, ms=5, mec="black", mew=0.4
    )
    axes.set(
        title=f"{name}: median {middle[0]:.1f} lines, {middle[1]:.1f} pixels\nresiduals enlarged {enlarged:g} ×",
        xlim=ends[:2],
        ylim=ends[2:],
    )


_PARTS = {"lens": svg.BLUE, "pixel": svg.GREEN, "diffusion": svg.ORANGE, "step": svg.SKY, "stages": svg.VERMILION}


def _images_png(run: simulate_run.Simulation) -> bytes:
    """Draw the lines' images side by side, each stretched between its 0.5% and 99.5% grey values."""
    with svg.look("simulate-images"):
        images = run.patch.images
        columns = min(len(images), 3)
        rows = -(-len(images) // columns)
        figure = svg.new_figure(0.35 + 3.5 * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
        for axes, (name, image) in zip(panels, images.items(), strict=False):
            _show_image(axes, name, image)
        for axes in panels[len(images) :]:
            axes.set_visible(False)
        return svg.to_png(figure, _DPI)


def _control_png(run: simulate_run.Simulation) -> bytes:
    """Draw orthophoto and elevation model, and return the picture as PNG."""
    with svg.look("simulate-control"):
        figure = svg.new_figure(4.6)
        photo, heights = figure.subplots(1, 2)
        control = run.patch.control
        _show_raster(photo, control.orthophoto, "gray")
        shown = _show_raster(heights, control.dem, "gist_earth")
        photo.set(title="Orthophoto", ylabel="north [km]")
        heights.set(title="Elevation model, m above the ellipsoid")
        figure.colorbar(shown, ax=heights, fraction=0.045, pad=0.02)
        return svg.to_png(figure, _DPI)


def _modulus(values: np.ndarray) -> np.ndarray:
    """Return the modulus of complex values, and real values unchanged with their sign."""
    return np.abs(values) if np.iscomplexobj(values) else values


def _transfer_figure(run: simulate_run.Simulation) -> Figure:
    """Draw each line's modulation transfer along the line and along the track, with its factors."""
    figure = svg.new_figure(3.4)
    panels = figure.subplots(1, 2, sharey=True)
    frequency = np.linspace(0.0, 0.5, 101)
    name, image = min(run.patch.images.items(), key=lambda item: item[1].motion.advance)
    optics = run.lines[name].optics
    zero = np.zeros_like(frequency)
    for axes, direction, frequencies in zip(
        panels, ("line", "track"), ((frequency, zero), (zero, frequency)), strict=True
    ):
        for part, values in optics.factors(*frequencies, image.motion).items():
            if np.ptp(values) > 1e-6:
                axes.plot(frequency, _modulus(values), color=_PARTS[part], lw=1.0, label=_NAMES[part])
        axes.plot(frequency, _modulus(optics.transfer(*frequencies, image.motion)), color=svg.INK, lw=1.8, label="all")
        step = "pixel" if direction == "line" else "line"
        axes.set(title=f"Along the {direction}, {name}", xlabel=f"cycles per {step}", ylim=(0.0, 1.03), xlim=(0.0, 0.5))
        axes.legend(loc="lower left")
        axes.grid(color=svg.LIGHT, lw=0.5)
        svg.plain_axes(axes)
    panels[0].set_ylabel("modulation transfer")
    return figure


_NAMES = {
    "lens": "lens",
    "pixel": "pixel",
    "diffusion": "charge diffusion",
    "step": "motion during a line",
    "stages": "drift over the stages",
}


def _show_image(axes: Axes, name: str, image: LineFrame, alpha: float = 1.0) -> None:
    """Show a line's image between its 0.5% and 99.5% grey values."""
    low, high = np.percentile(image.frame, (0.5, 99.5))
    window = image.window
    first, left = window.first_line - 0.5, window.first_pixel - 0.5
    ends = (left, left + window.pixels, first + window.lines, first)
    axes.imshow(image.frame, cmap="gray", vmin=low, vmax=high, extent=ends, interpolation="antialiased", alpha=alpha)
    axes.set(title=name)
    pixel_axes(axes)


def _show_raster(axes: Axes, raster: Raster, colours: str) -> AxesImage:
    """Show a map in kilometres east and north."""
    low, high = np.percentile(raster.values, (0.5, 99.5))
    rows, columns = raster.values.shape
    half = 0.5 * raster.spacing
    ends = (-half, columns * raster.spacing - half, half - rows * raster.spacing, half)
    corner = (raster.west, raster.west, raster.north, raster.north)
    extent: Any = tuple(1e-3 * (a + b) for a, b in zip(corner, ends, strict=True))
    shown = axes.imshow(raster.values, cmap=colours, vmin=low, vmax=high, extent=extent, interpolation="antialiased")
    axes.set(xlabel="east [km]")
    return shown


def sections(run: simulate_run.Simulation) -> tuple[Section, ...]:
    """Return the report's sections: images, control data, measured points, sharpness, data."""
    points, spec = run.points, run.spec.points
    measured = () if points is None or spec is None else (points_section(run.patch, points, spec),)
    return _images(run), _control(run), *measured, _sharpness(run), _data(run)


def _images(run: simulate_run.Simulation) -> Section:
    worst = max(image.error for image in run.patch.images.values())
    text = (
        "Each line's window of the same size has the patch in its middle. Interpolation of the rigorous geometry is in "
        f"error by {worst:.1g} pixels at most. The images contain the detector's fixed pattern, without radiometric "
        "correction.",
    )
    figure = PngFigure(
        "lines", "Images of the lines", "Each image between its 0.5 % and 99.5 % grey values.", _images_png(run)
    )
    caption = "Lines are counted from the start of the orbit data, pixels from the first of the line."
    keys = ("first_line", "first_pixel", "mean_dn", "smallest_dn", "largest_dn", "saturated_pixels")
    return Section("Images", text, (figure, _lines(run, "windows", "Windows and grey values", caption, keys)))


def _lines(run: simulate_run.Simulation, name: str, title: str, caption: str, keys: Sequence[str]) -> Table:
    """Return the report table of the quantities `keys`, a row for each line's image."""
    rows = {line: simulate_run.LINE(image) for line, image in run.patch.images.items()}
    return simulate_run.LINE.table(name, title, caption, rows, keys, "line", digits=4)


def _control(run: simulate_run.Simulation) -> Section:
    spec = run.spec.control
    text = (
        f"The orthophoto has pixels of {spec.spacing:g} m and another date: another sun, and {spec.changed:.0%} of the "
        f"fields look different. The elevation model has posts every {spec.dem.post:g} m and errors of "
        f"{spec.dem.sigma:g} m with a correlation length of {spec.dem.correlation:g} m. Both share an error in plan, a "
        f"shift of [{spec.shift[0]:g}, {spec.shift[1]:g}] m and a smooth part of {spec.sigma:g} m.",
    )
    figure = PngFigure(
        "control", "Control", "East and north of the patch's middle; rows of the files run south.", _control_png(run)
    )
    return Section("Orthophoto and elevation model", text, (figure,))


def _sharpness(run: simulate_run.Simulation) -> Section:
    with svg.look("simulate-transfer"):
        drawing = svg.to_svg(_transfer_figure(run))
    caption = "Up to half a cycle per sample."
    return Section("Sharpness", (), (SvgFigure("transfer", "Modulation transfer", caption, drawing),))


def _data(run: simulate_run.Simulation) -> Section:
    camera = described("camera", simulate_run.camera_data(run.laboratory))
    path = described("trajectory", simulate_run.trajectory_data(run, run.measured))
    rasters = described("georeference", simulate_run.georeference_data(run))
    truth = described("simulate-truth", simulate_run.TRUTH(run))
    parts = (
        Data("camera", "Camera", "Camera as measured in the laboratory.", camera),
        Data("trajectory", "Orbit and attitude", "Measured orbit and attitude.", path),
        Data("georeference", "Georeference", "Georeference of orthophoto and elevation model.", rasters),
        Data("truth", "Truth", "True camera, orbit, attitude and ground points; not for an analysis.", truth),
    )
    text = (
        "For other software: the images as TIFF, orthophoto (10 000 for a reflectance of 1) and elevation model "
        "(metres, 32-bit floating point) as GeoTIFF, the laboratory's camera, the measured orbit "
        "and attitude. The truth is in truth.json alone.",
    )
    return Section("Data", text, parts)


def simulation_report(run: simulate_run.Simulation) -> Report:
    """Return the report of a simulated pass over a patch: images, control, measured points and sharpness."""
    patch = run.spec.patch
    longitude, latitude = np.degrees(run.position)
    images = run.patch.images
    low = min(images, key=lambda name: min(images[name].nyquist))
    verdict, more = answer(
        f"The pass has {len(images)} images of {patch.lines} lines and {patch.pixels} pixels near "
        f"{latitude:.3f}° N, {longitude:.3f}° E, "
        "with orthophoto, elevation model, the laboratory's camera and the measured orbit and attitude",
        f"the modulation is lowest in {low}, {min(images[low].nyquist):.3f} at half a cycle per sample: see Sharpness",
    )
    files = {name: image.frame[None] for name, image in images.items()}
    files |= {"orthophoto": run.patch.control.orthophoto.values[None], "dem": run.patch.control.dem.values[None]}
    return Report(
        "Images of a patch of ground from orbit",
        verdict,
        more,
        _facts(run.setup),
        _summary(run),
        sections(run),
        files,
        warnings=_warnings(run),
        image_facts={
            "orthophoto": map_facts(run.patch.control.orthophoto, "10 000 for a reflectance of 1"),
            "dem": map_facts(run.patch.control.dem, "metres above the ellipsoid", heights=True),
        },
    )


def map_facts(raster: Raster, note: str, heights: bool = False) -> FrameFacts:
    """Return the text tags that are written into the GeoTIFF of a map."""
    longitude, latitude, *steps = list(simulate_run.GEOREFERENCE(raster).values())[3:]
    return FrameFacts(note=note, georeference=MapGeoreference(longitude, latitude, steps[0], steps[1], heights))


def _summary(run: simulate_run.Simulation) -> Table:
    """Return the summary table of the images."""
    caption = "Distance of samples on the ground and modulation transfer at half a cycle per sample, in the middle."
    keys = ("sample_along_line_m", "sample_along_track_m", "mtf_nyquist_along_line", "mtf_nyquist_along_track")
    return _lines(run, "images", "Images", caption, (*keys, "mean_dn", "rms_contrast"))


def changes_text(perturb: Mapping[str, InteriorChangeSpec]) -> str:
    """Return a text on the changes of a camera's lines since the laboratory's measurement."""
    changes = (
        f"{name} f {format_quantity(c.principal_distance, LENGTH)}, "
        f"x {format_quantity(c.principal_point[0], LENGTH)}, y {format_quantity(c.principal_point[1], LENGTH)}"
        for name, c in perturb.items()
    )
    return "; ".join(changes) or "nothing"


def _facts(setup: SimulateSetup) -> tuple[tuple[str, str], ...]:
    """Return the input quantities listed in the report."""
    test, camera = setup.test, setup.camera
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Changed since the laboratory", changes_text(test.perturb)),
        *inputs(test.errors.star_tracker, "bias"),
        *inputs(test.ground, "terrain", "texture", "light"),
        ("Samples", f"{test.oversampling} along each side of a pixel"),
        ("Description", test.description),
    )


def _warnings(run: simulate_run.Simulation) -> tuple[str, ...]:
    """Return warnings about saturated images."""
    full = [name for name, image in run.patch.images.items() if image.saturated]
    return (f"saturated pixels in {', '.join(full)}; lower ground.texture.mean or the line time",) if full else ()
