"""Report of a simulated pass over a patch: tables, figures, files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.artefact import Cell, Data, PngFigure, SvgFigure, Table
from twin.framework.data_files import FrameFacts, MapPlace
from twin.framework.reference_frames import described
from twin.framework.report import Report, Section, answer
from twin.framework.svg import (
    BLUE,
    GREEN,
    INK,
    LIGHT,
    ORANGE,
    SKY,
    VERMILION,
    look,
    new_figure,
    plain_axes,
    to_png,
    to_svg,
)
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images import simulate_numbers
from twin.orbit.images.patch import LineImage
from twin.orbit.images.point_report import pixel_axes, points_section
from twin.orbit.images.simulate_run import Simulation

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import SimulateSetup


_DPI = 110
_PARTS = {"lens": BLUE, "pixel": GREEN, "diffusion": ORANGE, "step": SKY, "stages": VERMILION}


def _images_png(run: Simulation) -> bytes:
    """The lines' images side by side, each stretched between its 0.5% and 99.5% grey values."""
    with look("simulate-images"):
        images = run.patch.images
        columns = min(len(images), 3)
        rows = -(-len(images) // columns)
        figure = new_figure(0.35 + 3.5 * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
        for axes, (name, image) in zip(panels, images.items(), strict=False):
            _show_image(axes, name, image)
        for axes in panels[len(images) :]:
            axes.set_visible(False)
        return to_png(figure, _DPI)


def _control_png(run: Simulation) -> bytes:
    """Orthophoto and elevation model."""
    with look("simulate-control"):
        figure = new_figure(4.6)
        photo, heights = figure.subplots(1, 2)
        control = run.patch.control
        _show_raster(photo, control.orthophoto, "gray")
        shown = _show_raster(heights, control.dem, "gist_earth")
        photo.set(title="Orthophoto", ylabel="north [km]")
        heights.set(title="Elevation model, m above the ellipsoid")
        figure.colorbar(shown, ax=heights, fraction=0.045, pad=0.02)
        return to_png(figure, _DPI)


def _transfer_svg(run: Simulation) -> str:
    """MTF along the line and along the track, all lines and the parts of the first that looks obliquely."""
    with look("simulate-transfer"):
        return to_svg(_transfer_figure(run))


def _modulus(values: np.ndarray) -> np.ndarray:
    """Modulus of complex values; real ones keep their sign."""
    return np.abs(values) if np.iscomplexobj(values) else values


def _transfer_figure(run: Simulation) -> Figure:
    figure = new_figure(3.4)
    panels = figure.subplots(1, 2, sharey=True)
    frequency = np.linspace(0.0, 0.5, 101)
    name, image = min(run.patch.images.items(), key=lambda item: item[1].motion.advance)
    optics = run.lines[name].optics
    zero = np.zeros_like(frequency)
    for axes, direction, place in zip(panels, ("line", "track"), ((frequency, zero), (zero, frequency)), strict=True):
        for part, values in optics.factors(*place, image.motion).items():
            if np.ptp(values) > 1e-6:
                axes.plot(frequency, _modulus(values), color=_PARTS[part], lw=1.0, label=_NAMES[part])
        axes.plot(frequency, _modulus(optics.transfer(*place, image.motion)), color=INK, lw=1.8, label="all")
        step = "pixel" if direction == "line" else "line"
        axes.set(title=f"Along the {direction}, {name}", xlabel=f"cycles per {step}", ylim=(0.0, 1.03), xlim=(0.0, 0.5))
        axes.legend(loc="lower left")
        axes.grid(color=LIGHT, lw=0.5)
        plain_axes(axes)
    panels[0].set_ylabel("modulation transfer")
    return figure


_NAMES = {
    "lens": "lens",
    "pixel": "pixel",
    "diffusion": "charge diffusion",
    "step": "motion during a line",
    "stages": "drift over the stages",
}


def _show_image(axes: Axes, name: str, image: LineImage) -> None:
    low, high = np.percentile(image.frame, (0.5, 99.5))
    window = image.window
    first, left = window.first_line - 0.5, window.first_pixel - 0.5
    ends = (left, left + window.pixels, first + window.lines, first)
    axes.imshow(image.frame, cmap="gray", vmin=low, vmax=high, extent=ends, interpolation="antialiased")
    axes.set(title=name)
    pixel_axes(axes)


def _show_raster(axes: Axes, raster: Raster, colours: str) -> AxesImage:
    low, high = np.percentile(raster.values, (0.5, 99.5))
    rows, columns = raster.values.shape
    half = 0.5 * raster.spacing
    ends = (
        raster.west - half,
        raster.west + columns * raster.spacing - half,
        raster.north - rows * raster.spacing + half,
        raster.north + half,
    )
    extent = 1e-3 * ends[0], 1e-3 * ends[1], 1e-3 * ends[2], 1e-3 * ends[3]
    shown = axes.imshow(raster.values, cmap=colours, vmin=low, vmax=high, extent=extent, interpolation="antialiased")
    axes.set(xlabel="east [km]")
    return shown


def sections(run: Simulation) -> tuple[Section, ...]:
    """Images, control, measured points, sharpness, data."""
    points, spec = run.points, run.spec.points
    measured = () if points is None or spec is None else (points_section(run.patch, points, spec),)
    return _images(run), _control(run), *measured, _sharpness(run), _data(run)


def _images(run: Simulation) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, image in run.patch.images.items():
        window, frame = image.window, image.frame
        levels = float(frame.mean()), int(frame.min()), int(frame.max())
        rows.append((name, str(window.first_line), str(window.first_pixel), *levels, image.saturated))
    worst = max(image.error for image in run.patch.images.values())
    text = (
        "Each line's window of the same size has the patch in its middle. Every sample of the ground is looked at by "
        "the rigorous sensor with light time, aberration and refraction as the file says, met with the terrain, and "
        "taken to the pixels by the transfer function of lens, pixels and motion; the detector makes grey values "
        f"of the photons. Places that are interpolated between rigorous ones are off by {worst:.1g} pixels at most.",
        "Slopes are lit by Lambert's law and the sky; they throw no shadows. A line's pixels differ by the detector's "
        "fixed pattern, and no radiometric correction has been made.",
    )
    figure = PngFigure(
        "lines", "What the lines recorded", "Grey values between 0.5% and 99.5% of each image.", _images_png(run)
    )
    table = Table(
        "windows",
        "Windows and grey values",
        "Lines count from the begin of the orbit data, pixels from the first of the line.",
        ("line", "first line", "first pixel", "mean [DN]", "smallest", "largest", "saturated"),
        rows,
        (None, None, None, 1, None, None, None),
    )
    return Section("Images", text, (figure, table))


def _control(run: Simulation) -> Section:
    spec = run.spec.control
    text = (
        f"The orthophoto has {spec.spacing:g} m and was taken on another date: another sun, and {spec.changed:.0%} of "
        f"the fields look different. The elevation model has posts every {spec.dem.post:g} m and errors of "
        f"{spec.dem.sigma:g} m that are alike over {spec.dem.correlation:g} m. Both share an error in plan, a shift of "
        f"[{spec.shift[0]:g}, {spec.shift[1]:g}] m and a smooth part of {spec.sigma:g} m.",
    )
    figure = PngFigure(
        "control", "Control", "East and north of the patch's middle; rows of the files go south.", _control_png(run)
    )
    return Section("Orthophoto and elevation model", text, (figure,))


def _sharpness(run: Simulation) -> Section:
    text = (
        "An oblique line sees the ground under a larger pixel than it advances by in a line's time: along the track "
        "its pixels overlap, which blurs at half a cycle per line but hides nothing. Motion during a line blurs by one "
        "line.",
    )
    figure = SvgFigure(
        "transfer", "Modulation transfer", "Up to half a cycle per sample; before any noise.", _transfer_svg(run)
    )
    return Section("Sharpness", text, (figure,))


def _data(run: Simulation) -> Section:
    camera = described("camera", simulate_numbers.camera_data(run.laboratory))
    path = described("trajectory", simulate_numbers.trajectory_data(run, run.measured))
    rasters = described("georeference", simulate_numbers.georeference_data(run))
    truth = described("simulate-truth", simulate_numbers.TRUTH(run))
    parts = (
        Data("camera", "Camera", "As the laboratory measured it.", camera),
        Data("trajectory", "Orbit and attitude", "As measured.", path),
        Data("georeference", "Georeference", "Of orthophoto and elevation model.", rasters),
        Data("truth", "Truth", "Camera, orbit, attitude, ground points; not for an analysis.", truth),
    )
    text = (
        "For other software: the images as TIFF, orthophoto (10 000 for a reflectance of 1) and elevation model "
        "(metres, 32-bit floating point) as GeoTIFF, the laboratory's camera, the measured orbit "
        "and attitude. What only the truth knows is kept apart in truth.json.",
    )
    return Section("Data", text, parts)


def simulation_report(run: Simulation) -> Report:
    """Report of a pass."""
    patch = run.spec.patch
    longitude, latitude = np.degrees(run.place)
    images = run.patch.images
    low = min(images, key=lambda name: min(images[name].nyquist))
    full = [name for name, image in images.items() if image.saturated]
    verdict, more = answer(
        f"The pass has {len(images)} images of {patch.lines} lines and {patch.pixels} pixels near "
        f"{latitude:.3f}° N, {longitude:.3f}° E, "
        "with orthophoto, elevation model, the laboratory's camera and the measured orbit and attitude",
        f"the modulation is lowest in {low}, {min(images[low].nyquist):.3f} at half a cycle per sample: see Sharpness",
        f"pixels are saturated in {', '.join(full)}" if full else "",
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
    """What the TIFF of a map says of itself: a GeoTIFF."""
    longitude, latitude, *steps = list(simulate_numbers.GEOREFERENCE(raster).values())[3:]
    return FrameFacts(note=note, place=MapPlace(longitude, latitude, steps[0], steps[1], heights))


def _summary(run: Simulation) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, image in run.patch.images.items():
        contrast = 100.0 * float(image.frame.std() / image.frame.mean())
        rows.append((name, *image.sample, *image.nyquist, float(image.frame.mean()), contrast))
    return Table(
        "images",
        "Images",
        "Distance of samples on the ground and modulation transfer at half a cycle per sample, in the patch's middle.",
        ("line", "along line [m]", "along track [m]", "MTF line", "MTF track", "mean [DN]", "contrast [%]"),
        rows,
        (None, 3, 3, 3, 3, 1, 1),
    )


def _facts(setup: SimulateSetup) -> tuple[tuple[str, str], ...]:
    test, camera = setup.test, setup.camera
    terrain, light = test.ground.terrain, test.ground.light
    relief = "its own relief" if terrain.relief is None else f"relief {format_quantity(terrain.relief, LENGTH)} rms"
    kind = (
        "Jacksboro fault, 3 arc seconds, moved" if terrain.kind == "real" else f"fractal, exponent {terrain.exponent:g}"
    )
    sun = f"{format_quantity(light.elevation, ANGLE)} high in {format_quantity(light.azimuth, ANGLE)}"
    changes = "; ".join(
        f"{name} f {format_quantity(c.principal_distance, LENGTH)}, "
        f"x {format_quantity(c.principal_point[0], LENGTH)}, y {format_quantity(c.principal_point[1], LENGTH)}"
        for name, c in test.perturb.items()
    )
    bias = ", ".join(format_quantity(v, ANGLE) for v in test.errors.star_tracker.bias)
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Changed since the laboratory", changes or "nothing"),
        ("Bias of the star trackers", f"[{bias}]"),
        ("Terrain", f"{kind}; {format_quantity(terrain.height, LENGTH)} high, {relief}"),
        ("Ground", f"cells of {test.ground.texture.spacing:g} m, reflectance {test.ground.texture.mean:g}"),
        ("Sun", sun),
        ("Samples", f"{test.oversampling} along each side of a pixel"),
        ("Description", test.description),
    )


def _warnings(run: Simulation) -> tuple[str, ...]:
    full = [name for name, image in run.patch.images.items() if image.saturated]
    return (f"saturated pixels in {', '.join(full)}; lower ground.texture.mean or the line time",) if full else ()
