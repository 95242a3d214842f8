"""What a report says of a simulated pass."""

from __future__ import annotations

from twin.artefact import Cell, Data, PngFigure, SvgFigure, Table
from twin.orbit.images.figure import control_png, images_png, transfer_svg
from twin.orbit.images.flight import Simulation
from twin.orbit.images.point_sections import points_section
from twin.orbit.images.to_json import camera_data, georeference, trajectory_data, truth_data
from twin.reference_frames import described
from twin.trial.section import Section


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
        "lines", "What the lines recorded", "Grey values between 0.5% and 99.5% of each image.", images_png(run)
    )
    table = Table(
        "windows",
        "Windows and grey values",
        "Lines count from the begin of the orbit data, pixels from the first of the line.",
        ("line", "first line", "first pixel", "mean, DN", "smallest", "largest", "saturated"),
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
        "control", "Control", "East and north of the patch's middle; rows of the files go south.", control_png(run)
    )
    return Section("Orthophoto and elevation model", text, (figure,))


def _sharpness(run: Simulation) -> Section:
    text = (
        "An oblique line sees the ground under a larger pixel than it advances by in a line's time: along the track "
        "its pixels overlap, which blurs at half a cycle per line but hides nothing. Motion during a line blurs by one "
        "line.",
    )
    figure = SvgFigure(
        "transfer", "Modulation transfer", "Up to half a cycle per sample; before any noise.", transfer_svg(run)
    )
    return Section("Sharpness", text, (figure,))


def _data(run: Simulation) -> Section:
    errors, control = run.spec.errors, run.patch.control
    gps, star = errors.gps.interval, errors.star_tracker.interval
    rasters = {"orthophoto": georeference(control.orthophoto), "dem": georeference(control.dem)}
    camera = described("camera", camera_data(run.laboratory))
    path = described("trajectory", trajectory_data(run.measured, gps, star))
    truth = described("simulate-truth", truth_data(run))
    parts = (
        Data("camera", "Camera", "As the laboratory measured it.", camera),
        Data("trajectory", "Orbit and attitude", "As measured.", path),
        Data("georeference", "Georeference", "Of orthophoto and elevation model.", described("georeference", rasters)),
        Data("truth", "Truth", "Camera, orbit, attitude, ground points; not for an analysis.", truth),
    )
    text = (
        "For other software: the images as TIFF, orthophoto (10 000 for a reflectance of 1) and elevation model "
        "(metres, 32-bit floating point) as TIFF with their georeference, the laboratory's camera, the measured orbit "
        "and attitude. What only the truth knows is kept apart in truth.json.",
    )
    return Section("Data", text, parts)
