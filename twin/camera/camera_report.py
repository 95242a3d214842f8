"""Report of a camera analysis: verdict, first-order data, and all plots and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from optics.camera.ghosts import DETECTOR
from optics.camera.prescription import ABERRATIONS
from optics.geometry import zernike
from optics.numerics.array_math import PhysicalError
from scenes.models.camera_design import file_with_plane
from scenes.models.camera_sharpness import FIELDS, field_text
from twin.camera import camera_plots as plots
from twin.camera.aberrations import COEFFICIENTS
from twin.camera.camera_results import Mtf
from twin.camera.camera_run import CameraRun, built_text, camera_data, perturbed_text, refocus_text, verdict
from twin.camera.camera_view import dimensions, layout_figure
from twin.camera.colour import Colours
from twin.camera.first_order_data import FIRST_ORDER, detector_beyond_field, unmodelled_obscuration
from twin.framework.artefact import (
    Artefact,
    CameraFile,
    Cell,
    Piece,
    PngFigure,
    SvgFigure,
    Table,
    Undrawn,
    fixed,
    significant,
)
from twin.framework.data_files import netcdf
from twin.framework.report import Report, Section, answer
from twin.framework.svg import look, to_svg
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.picture_scene import still_png
from twin.pictures.scene_file import TUBE, scene_bytes, viewer_page

_TABLE_TERMS = 15
"""Number of Zernike terms in the report's table of fields; all terms are in optics.json and optics.nc."""


def camera_report(run: CameraRun) -> Report:
    """Build the report of a camera analysis: verdict, first-order data, layout, image quality over the field."""
    texts = refocus_text(run), built_text(run), perturbed_text(run)
    solid, files = solid_view(run)
    verdict_text, more = answer(*verdict(run), "see the wavefronts and the layout")
    refocused = [_refocus(run)] if run.refocus is not None else []
    images = [_energy(run)] if run.images is not None else []
    sections = [_layout(run, solid), *refocused, _wavefronts(run), _spots(run), *images, _mtf(run), *_colours(run)]
    sections += [_through_focus(run), _field(run), _third_order(run), _ghosts(run)]
    sections += [_bodies(run)] if run.quality is not None else []
    return Report(
        f"Camera {run.setup.title}",
        verdict_text,
        (*more, *(text for text in texts if text), _first_order_text(run)),
        _facts(run),
        first_order_table(run),
        tuple(sections),
        files={"optics.nc": netcdf(camera_data(run)), **files},
    )


def _figure(name: str, title: str, caption: str, draw: Callable[..., Figure], *drawn: Any) -> SvgFigure:
    """Return a figure of the report as SVG; the function ``draw`` draws it from the arguments ``drawn``."""
    with look(name):
        return SvgFigure(name, title, caption, to_svg(draw(*drawn)))


def _first_order_text(run: CameraRun) -> str:
    """Return a sentence on focal length, F-number and other first-order data, and on the obscuration."""
    n, d = FIRST_ORDER(run.first_order), run.distortion
    blocked = ", ".join(f"{body} {100 * share:.1f}%" for body, share in n["obscuration"].items())
    obscuration = f"{'further ' if run.optics.model.edges else ''}obscuration by its own parts"
    unmodelled = unmodelled_obscuration(run.optics.model, run.first_order.obscuration)
    return (
        f"f {n['focal_length_m']:.4g} m, F/{n['f_number']:.3g}, field {n['field_deg'][0]:.3g} by "
        f"{n['field_deg'][1]:.3g} deg; principal distance along the line {d.line_distance:.6g} m, "
        f"distortion at most {round(1e6 * d.line_largest, 6):.3g} µm there; "
        + (f"its edges block {100.0 * _blocked(run):.1f} % of the light; " if run.optics.model.edges else "")
        + (f"{obscuration}: {blocked}." if blocked else f"no {obscuration}.")
        + "".join(f" {text}." for text in (unmodelled, detector_beyond_field(run.first_order)) if text)
    )


def _blocked(run: CameraRun) -> float:
    """Return the share of the light that edges block in the middle of the field."""
    return next(wave.vignetted for wave in run.waves if wave.field == (0.0, 0.0))


def _facts(run: CameraRun) -> tuple[tuple[str, str], ...]:
    """Return the head of the report as pairs of label and text: camera, description, mirrors, wavelength, fields."""
    spec = run.camera
    facts = [("Camera", spec.name)]
    if spec.description:
        facts.append(("Description", spec.description))
    if run.setup.instrument is not None:
        facts.append(("Mounted", f"as {run.setup.mounted} of {run.setup.where}"))
    fields = (
        "angles along the line and along the track from the middle of the field; the first is positive at the line's"
    )
    return (
        *facts,
        ("Mirrors", ", ".join(f"{m} (stop)" if m == spec.stop else m for m in spec.mirrors)),
        ("Design wavelength", f"{1e9 * spec.wavelength:.0f} nm, the unit of waves"),
        ("Fields", f"{fields} left end (+Y)"),
    )


def first_order_table(run: CameraRun) -> Table:
    """Return the report's first table: focal length, F-number, pupils, apertures and other first-order data."""
    n = FIRST_ORDER(run.first_order)
    further = "further " if run.optics.model.edges else ""
    state = "as perturbed" if run.perturbed else "as built" if run.optics.built else "as designed"

    def far(value: float | None) -> str:
        return f"{value:.4g} m" if value is not None and abs(value) < 1e4 else "infinite"

    first = next(name for name, surface in run.camera.mirrors.items() if surface.light != "passes")
    rows: list[tuple[str, str]] = [
        ("worst wavefront error", f"{run.worst[0]:.4g} waves rms at {field_text(run.camera, run.worst[1])}"),
        ("focal length", f"{n['focal_length_m']:.7g} m"),
        ("back focal length", f"{n['back_focal_length_m']:.7g} m"),
        ("principal distance in the middle", f"line {n['principal_distance_along_line_m']:.7g} m, "
         f"track {n['principal_distance_along_track_m']:.7g} m"),
        ("principal distance of the line", f"{run.distortion.line_distance:.6f} m"),
        ("F-number", f"{n['f_number']:.3f}"),
        ("working F-number", f"{n['working_f_number']:.3f} (line {n['working_f_number_along_line']:.3f}, "
         f"track {n['working_f_number_along_track']:.3f})"),
        ("entrance pupil", f"{1e3 * n['entrance_pupil_m']:.5g} mm, "
         f"{_before(n['entrance_pupil_before_first_mirror_m'])} {first}"),
        ("exit pupil", f"{far(n['exit_pupil_m'])}, {_before(n['exit_pupil_before_image_m'])} the image"),
        ("chief rays at the image", "{:.3f} deg from its normal in the middle, at most {:.3f} deg".format(
            *n["chief_ray_angle_deg"])),
        ("field of view", "{:.4g} × {:.4g} deg".format(*n["field_deg"])),
        ("image", "{:.2f} × {:.2f} mm".format(*n["image_mm"])),
        ("plate scale", f"{n['plate_scale_arcsec_per_mm']:.4f} arcsec/mm"),
        ("pixel" if "line" in run.camera.model_fields_set else "pixel (the camera file has no line: λF)",
         f"{n['pitch_um']:.4g} µm, {n['pixel_arcsec']:.4f} arcsec"),
        ("Airy disk", f"{n['airy_radius_um']:.3f} µm radius, {n['airy_radius_um'] / n['pitch_um']:.2f} pixels"),
        ("sampling", f"λF / pixel {n['sampling_lambda_f_per_pixel']:.3f} (2 samples the cut-off); "
         f"Nyquist {n['nyquist_per_mm']:.2f}, cut-off {n['cutoff_per_mm']:.1f} cycles/mm"),
        ("length along the axis", f"{n['length_m']:.4f} m"),
        *([("light blocked by edges", f"{100.0 * _blocked(run):.2f} % in the middle")] if further else []),
        (f"{further}obscuration by its own parts" + (", as designed" if state != "as designed" else ""),
         ", ".join(f"{b} {100 * s:.2f}%" for b, s in n["obscuration"].items()) or "none"),
    ]  # fmt: skip
    if "detector_mm" in n:
        line, size = run.camera.line, "{:.2f} × {:.2f} mm".format(*n["detector_mm"])
        rows.append(("detector", f"{line.pixels} × {line.rows} pixels, {size}"))
    if n["hole_radius_mm"]:
        holes = ", ".join(f"{b} needs a hole of at least {r:.1f} mm radius" for b, r in n["hole_radius_mm"].items())
        rows.append(("central holes", f"{holes} (not in the file; specify edges: [{{blocks: circle, radius: ...}}])"))
    on_axis = run.optics.model.axis.on_axis
    axis_text = "the axis" if on_axis else "the middle of the field, as no light arrives along the axis"
    caption = (
        f"The camera {state}, at {1e9 * run.camera.wavelength:.0f} nm. Focal lengths, F-number and pupils are "
        f"paraxial, about {axis_text}; all else refers to the middle of the field unless specified, on the actual "
        "image plane."
    )
    return Table("first-order", "First-order data", caption, ("quantity", "value"), rows)


_NO_DISTANCE = 1e-9
"""Largest distance of a pupil that is at a surface but for rounding, metres."""


def _before(distance: float | None) -> str:
    """Format a signed distance, metres, as "0.5 m before", "0.5 m behind", "at" or "infinitely far from".

    A positive distance is before; None and distances beyond 10 km are infinite.
    """
    if distance is None or abs(distance) > 1e4:
        return "infinitely far from"
    if abs(distance) < _NO_DISTANCE:
        return "at"
    return f"{abs(distance):.4g} m {'before' if distance > 0.0 else 'behind'}"


def _layout(run: CameraRun, solid: Artefact) -> Section:
    """Return the section with drawings of the mirrors, lenses and rays, and the view in three dimensions."""
    model, backend = run.optics.model, run.optics.path.backend
    caption = "To scale, in the prescription's frame; mirrors with their clear apertures; dash-dotted: the parent axis."
    figure = _figure("layout", "Layout with rays", caption, layout_figure, model, backend)
    rows: list[list[Cell]] = [[start, end, 1e3 * size] for start, end, size in dimensions(model)]
    about = "Along straight lines between vertices; overall: the parts with their clear apertures, along z, y and x."
    table = Table("dimensions", "Dimensions", about, ("from", "to", "mm"), rows, (None, None, 3))
    return Section("Layout", (), (figure, table, solid))


def _refocus(run: CameraRun) -> Section:
    """Return the section that compares the focal plane and wavefront errors before and after refocusing."""
    assert run.refocus is not None
    refocused = run.refocus
    rows: list[list[Cell]] = [
        [plots.degrees_text(run, field), float(b), float(a)]
        for field, b, a in zip(FIELDS, refocused.errors_before, refocused.errors_after, strict=True)
    ]
    text = (
        f"Image plane with the least mean square wavefront error over {len(FIELDS)} fields"
        + (", position and tilt" if refocused.tilt else "")
        + ". All other results refer to the refocused camera."
    )
    file: tuple[Artefact, ...] = ()
    if run.camera is not run.setup.camera:
        name = f"{run.setup.camera.name}_refocused"
        new = file_with_plane(run.setup.camera, refocused.after, name)
        about = "Its file, which differs in name and image plane only."
        file = (CameraFile(name.lower(), "The refocused camera", about, new),)
    artefacts: tuple[Artefact, ...] = (
        _figure("refocus", "Before and after", "Waves rms, logarithmic scale.", plots.refocus_figure, run),
        *file,
        Table("refocus-fields", "Wavefront error by field", "Waves rms.", ("field", "before", "after"), rows,
              (None, 4, 4)),
    )  # fmt: skip
    return Section("Refocused", (text,), artefacts)


def _wavefronts(run: CameraRun) -> Section:
    """Return the report's section on wavefront errors over the field."""
    heads = ["", *(plots.degrees_text(run, w.field) for w in run.waves)]
    rows: list[list[Cell]] = [
        ["rms", *(w.rms for w in run.waves)],
        ["peak to valley", *(w.peak_to_valley for w in run.waves)],
        ["Strehl ratio", *(w.strehl for w in run.waves)],
    ]
    for j in range(4, _TABLE_TERMS + 1):
        term_values = (w.parts if w.is_vignetted else w.coefficients for w in run.waves)
        rows.append([f"Z{j} {zernike.name(j)}", *(float(terms[j - 1]) for terms in term_values)])
    caption = "Waves; Zernike terms in Noll's order, waves rms, piston and tilt removed."
    vignetted = [w for w in run.waves if w.is_vignetted]
    if vignetted:
        sets = "; ".join(dict.fromkeys(w.polynomials for w in vignetted))
        caption += f" Polynomials: {sets}. Circle terms fitted to the same light are in optics.json."
        caption += f" The relative error of the rms is {max(w.accuracy for w in vignetted):.1g}, by a finer quadrature."
    table = Table("zernike", "Wavefront error by field", caption, heads, rows, (None, *[4] * len(run.waves)))
    kinds = ", ".join(f"{kind} {size:.3g}" for kind, size in run.limits[:3])
    text = f"At the worst field, {field_text(run.camera, run.worst[1])}: {kinds} waves rms."
    over_field = "Rms wavefront error; the ring marks the worst field."
    over_stop = (
        "Over the stop, x along the line to the right, y along the track upward; common colour scale. Positive where "
        "the wavefront is ahead."
    )
    figures = (
        _figure("wavefront-field", "Over the field", over_field, plots.error_figure, run),
        _figure("wavefront-maps", "Maps", over_stop, plots.wavefront_figure, run),
        _figure("zernike-bars", "Zernike terms", "In the middle and at the worst field.", plots.zernike_figure, run),
    )
    return Section("Wavefront", (text,), (*figures, table))


def _spots(run: CameraRun) -> Section:
    """Return the report's section with spot diagrams over the field."""
    rows: list[list[Cell]] = [
        [plots.degrees_text(run, s.field), 1e6 * s.rms, *(1e6 * s.rms_along), 1e6 * s.farthest, s.rms / s.airy]
        for s in run.spots
    ]
    heads = ("field", "rms [µm]", "along line [µm]", "along track [µm]", "largest [µm]", "rms / Airy radius")
    caption = "Hexapolar rays about the spot's centroid, in boxes of equal size; circle: Airy disk."
    figure = _figure("spots", "Spot diagrams", caption, plots.spot_figure, run)
    table = Table("spot-sizes", "Spot sizes by field", "Radii about the centroid.", heads, rows, (None, *[3] * 5))
    about = (
        "Ray minus chief ray on the focal plane, in the direction of the fan; wavefront error against the chief ray."
    )
    fans = _figure("ray-fans", "Ray fans", about, plots.fans_figure, run)
    return Section("Spots", (), (figure, fans, table))


def _energy(run: CameraRun) -> Section:
    """Return the section on point images and their energy."""
    images = run.images
    assert images is not None
    rows: list[list[Cell]] = [
        [plots.degrees_text(run, psf.field), *(None if v is None else 1e6 * v for v in (half, most)), float(pixel)]
        for psf, half, most, pixel in zip(
            images.psfs, images.radius_of(0.5), images.radius_of(0.8), images.pixel, strict=True
        )
    ]
    heads = ("field", "50 % within [µm]", "80 % within [µm]", "light in a pixel")
    about = (
        "Optics alone at the design wavelength, peak 1, about the chief ray, half as wide again as the circle of 90 % "
        "of the light; the grid shows pixels of the line."
    )
    caption = "Light within circles and squares about the centroid; half widths of squares."
    artefacts = (
        _figure("point-images", "Point images", about, plots.images_figure, run),
        _figure("energy", "Encircled and ensquared energy", caption, plots.energy_figure, run),
        Table("energy-table", "Energy by field", "Radii of circles; a pixel is centred on the image.", heads, rows,
              (None, 2, 2, 3)),
    )  # fmt: skip
    return Section("Point images", (), artefacts)


def _third_order(run: CameraRun) -> Section:
    """Return the section on third-order aberrations by surface."""
    title, third = "Third-order aberrations", run.third_order
    if third is None:
        return Section(title, ("No Seidel sums: they are defined for surfaces centred on one axis.",))
    rows: list[list[Cell]] = [[name, *map(float, row)] for name, row in zip(third.sums.names, third.waves, strict=True)]
    rows.append(["sum", *map(float, third.waves.sum(axis=0))])
    names = (*ABERRATIONS, "axial colour", "lateral colour")
    heads = ["surface", *(f"{a} {c}" for a, c, _ in zip(names, COEFFICIENTS, third.waves.T, strict=False))]
    text = (
        "Seidel sums of the nominal camera about its axis, as wavefront coefficients at the rim of the stop and the "
        "corner of the field that is farthest from the axis. Surfaces with large terms of opposite signs are sensitive "
        f"to alignment. Petzval curvature {significant(third.sums.petzval, 4, floor=1e-9)} /m."
    )
    table = Table("third-order", "Coefficients by surface", "Waves.", heads, rows, (None, *[3] * (len(heads) - 1)))
    return Section(title, (text,), (table,))


MOST_GHOSTS = 15
"""Number of ghosts in the report's table, the strongest; all are in optics.json and optics.nc."""


def _ghosts(run: CameraRun) -> Section:
    """Return the section on ghosts by two reflections."""
    ghosts, image = run.ghosts, run.camera.image
    if not ghosts:
        return Section("Ghosts", ("No refracting surfaces: no ghosts.",))
    share = DETECTOR if image.reflectance is None else image.reflectance
    text = (
        "Light in the middle of the field that is reflected twice, at two faces of lenses or at the detector and a "
        "face. Faces reflect by Fresnel's formulas or as the file states, the detector "
        f"{100 * share:.3g} %, mirrors all light. The strongest of {len(ghosts)} is {ghosts[0].back}, then "
        f"{ghosts[0].forward}, with {ghosts[0].irradiance:.2g} of the image's irradiance."
    )
    rows: list[list[Cell]] = [
        [g.back, g.forward, fixed(1e3 * g.focus, 3, True) if np.isfinite(g.focus) else "infinite",
         1e3 * g.diameter, f"{g.energy:.3g}", f"{g.irradiance:.3g}"]
        for g in ghosts[:MOST_GHOSTS]
    ]  # fmt: skip
    heads = ("back", "forward", "focus [mm]", "spot [mm]", "energy", "irradiance")
    caption = (
        "Focus: paraxial, from the image plane along the light. Spot: diameter of the traced light. Energy and "
        "irradiance: relative to the image, whose diameter is that of its spot or Airy disk."
    )
    table = Table("ghosts", "Ghosts, the strongest first", caption, heads, rows, (None, None, None, 3, None, None))
    return Section("Ghosts", (text,), (table,))


def _mtf(run: CameraRun) -> Section:
    """Return the report's section on the MTF over the field."""
    if not run.mtfs:
        return Section("MTF", (f"No MTF: {run.without_mtf}.",))
    text = (
        f"Optics alone, at {1e9 * run.camera.wavelength:.0f} nm, without the effects of pixels, charge and motion; "
        "with the pixel: `render: {quality: true}` in a job. "
        f"Nyquist is {1e-3 * run.optics.nyquist:.4g} cycles/mm."
    )
    if change := max(mtf.accuracy for mtf in run.mtfs):
        text += " Edges vignette the pupil; with a third of the lines through it the curves change by at most "
        text += f"{change:.1g}."
    caption = "Along the line and along the track; dashed: diffraction limit."
    figure = _figure("mtf", "MTF of the optics by field", caption, plots.mtf_figure, run)
    rows = [_at_nyquist(run, mtf) for mtf in run.mtfs]
    return Section(
        "MTF", (text,), (figure, Table("mtf-nyquist", "MTF of the optics at Nyquist", "", _HEADS, rows, _DIGITS))
    )


_HEADS = ("field", "along line", "along track", "limit along line", "limit along track")
_DIGITS = (None, 3, 3, 3, 3)


def _at_nyquist(run: CameraRun, mtf: Mtf) -> list[Cell]:
    """Return the row of a table with a field, the MTF at Nyquist along line and track, and its diffraction limits."""
    limits = (float(np.interp(mtf.nyquist, mtf.frequency, row)) for row in mtf.limit)
    return [plots.degrees_text(run, mtf.field), *map(float, mtf.at(mtf.nyquist)), *limits]


def _colours(run: CameraRun) -> list[Section]:
    """Return the sections on lateral and axial colour of lenses and on polychromatic image quality."""
    colours = run.colours
    if colours is None:
        return []
    ends = " to ".join(f"{1e9 * w:.6g}" for w in colours.spectrum.ends)
    return [*_lenses(run, colours, ends), _light(run, colours, ends)]


def _lenses(run: CameraRun, colours: Colours, ends: str) -> list[Section]:
    """Return the section on lateral and axial colour; none for a camera without lenses."""
    lateral, second = colours.lateral_primary, colours.lateral_secondary
    axial, other = colours.axial_primary, colours.axial_secondary
    if colours.lateral is None or lateral is None or second is None or axial is None or other is None:
        return []
    rows: list[list[Cell]] = [
        [plots.degrees_text(run, place), *(float(1e6 * v) for v in (*lateral[f], *second[f], axial[f], other[f]))]
        for f, place in enumerate(colours.fields)
    ]
    heads = ("field", "lateral, line [µm]", "lateral, track [µm]", "secondary, line [µm]", "secondary, track [µm]",
             "axial [µm]", "secondary [µm]")  # fmt: skip
    widest = float(np.max(np.linalg.norm(np.ptp(colours.lateral, axis=1), axis=-1)))
    text = (
        f"Light of {ends} nm, reference {1e9 * colours.reference:.6g} nm. Chief rays of one field spread over at most "
        f"{1e6 * widest:.3g} µm, {widest / run.camera.line.pitch:.2g} pixels. In the middle of the field the "
        f"focus of the shortest wavelength lies {1e6 * axial[0]:+.4g} µm from that of the longest, that of the "
        f"reference {1e6 * other[0]:+.4g} µm from the mean of both."
    )
    about = "Chief-ray position of each wavelength relative to that of the reference; dotted: the reference."
    along = (
        "Position of the least rms wavefront error of each wavelength; positive is downstream, away from the optics."
    )
    caption = "Primary: shortest minus longest wavelength. Secondary: reference minus the mean of both."
    figures = (
        _figure("lateral-colour", "Lateral colour", about, plots.lateral_figure, run),
        _figure("axial-colour", "Axial colour", along, plots.axial_figure, run),
        Table("colour", "Colour by field", caption, heads, rows, (None, *[3] * 6)),
    )
    return [Section("Colour", (text,), figures)]


def _light(run: CameraRun, colours: Colours, ends: str) -> Section:
    """Return the section on polychromatic MTF and point images."""
    title = "Polychromatic image quality"
    if not colours.mtfs:
        return Section(title, (f"No MTF: {colours.without_mtf or run.without_mtf}.",))
    both = zip(colours.mtfs, colours.psfs, strict=True)
    rows: list[list[Cell]] = [[*_at_nyquist(run, mtf), float(psf.strehl)] for mtf, psf in both]
    title_of_table, heads = "Polychromatic MTF of the optics at Nyquist", (*_HEADS, "Strehl ratio")
    count = len(colours.mtfs[0].wavelengths)
    exact = "spectral lines, summed exactly" if colours.spectrum.lines else f"accurate to {colours.error:.1g}"
    text = (
        f"Light of {ends} nm, weighted by the spectrum, at {count} wavelengths: {exact}. All wavelengths are referred "
        "to one point of the image, so that lateral and axial colour blur it."
    )
    caption = "MTF by field; below: point images (square root of irradiance) about the design wavelength's chief ray."
    figure = _figure("light-mtf", "MTF of the optics and point images", caption, plots.light_mtf_figure, run)
    table = Table("light-mtf-nyquist", title_of_table, "", heads, rows, (*_DIGITS, 3))
    return Section(title, (text,), (figure, table))


def _through_focus(run: CameraRun) -> Section:
    """Return the section on image quality through focus."""
    best = 1e6 * run.focus.best
    where = f"{fixed(abs(best), 1)} µm {'downstream' if best > 0.0 else 'upstream'} of the focal plane"
    text = f"Best focus over these fields is {where}." if np.isfinite(best) else "The light has no focus."
    caption = "The detector moves along its normal; positive is downstream, away from the optics."
    return Section("Through focus", (text,), (_figure("focus", "Through focus", caption, plots.focus_figure, run),))


def _field(run: CameraRun) -> Section:
    """Return the section on distortion, field curvature and illumination."""
    d, curves = run.distortion, run.curves
    half = float(np.max(np.abs(d.position)))
    point, both = d.line_point
    text = (
        f"Along the line: principal distance {d.line_distance:.6f} m with the principal point in the line's middle, "
        f"distortion {1e6 * d.line_rms:.3g} µm rms and at most {1e6 * d.line_largest:.3g} µm, "
        f"{100 * d.line_largest / half:.2g}% of half the line. Fitted together: {both:.6f} m and a principal point "
        f"{fixed(1e3 * point, 3)} mm off.",
        f"Over the whole field: the best-fitting distortion-free camera has f {d.distance:.6f} m and its principal "
        f"point at ({fixed(1e3 * d.point[0], 3)}, {fixed(1e3 * d.point[1], 3)}) mm from the line's middle, near the "
        f"parent axis; distortion relative to it is {significant(1e6 * d.rms)} µm rms, at most "
        f"{significant(1e6 * d.largest)} µm.",
    )
    x = np.degrees(curves.share * run.camera.field.x)
    rows: list[list[Cell]] = [
        [float(a), *(float(1e6 * v[k]) for v in (curves.focus_line, curves.focus_track, curves.focus)),
         float(curves.illumination[k]), float(curves.vignetted[k])]
        for k, a in enumerate(x)
    ]  # fmt: skip
    heads = ("field [deg]", "focus line [µm]", "focus track [µm]", "focus [µm]", "illumination", "vignetted")
    line: list[list[Cell]] = [
        [1e3 * float(p), float(np.degrees(w)), 1e6 * float(r)]
        for p, w, r in zip(d.position, d.angle, d.residual, strict=True)
    ]
    against = "Left: relative to the distortion-free camera with the best principal distance and point. Right: "
    against += "along the line."
    bent = "Along the line. Illumination: solid angle of the beam seen from the focal plane."
    line_heads = ("L [mm]", "W [deg]", "distortion [µm]")
    artefacts = (
        _figure("distortion", "Distortion", against, plots.distortion_figure, run),
        _figure("field-curves", "Focus and illumination", bent, plots.curves_figure, run),
        Table("field-curves-table", "Along the line", "", heads, rows, (3, 2, 2, 2, 5, 4)),
        Table("distortion-line", "Distortion along the line", "", line_heads, line, (3, 5, 3)),
    )
    return Section("Over the field", text, artefacts)


def _bodies(run: CameraRun) -> Section:
    """Return the report's section on bodies of the instrument that block part of the camera's beam."""
    assert run.quality is not None
    rows: list[list[Cell]] = [
        [body, *(100.0 * float(v) for v in share[0])] for body, share in run.quality.bodies.items()
    ]
    rows.append(["all bodies, fraction of the light", *(100.0 * float(v) for v in run.quality.light_lost[0])])
    text = "Bodies of the instrument that obscure the beam. MTF and through focus exclude the light that they block."
    heads = ("body", "right end [%]", "middle [%]", "left end [%]")
    table = Table("bodies", "Fraction of the beam blocked", "", heads, rows, (None, 2, 2, 2))
    return Section("In the instrument", (text,), (table,))


TITLE = "In three dimensions"

_IMAGE = '<div class="card"><img src="{0}" alt="{1}"></div>'
_FIGURE = (
    '<h3>{0}</h3>\n<figure><a href="view.html">{1}</a>\n<figcaption>Mirrors and lenses with their clear apertures, and '
    'beams of the middle and both ends of the line. <a href="view.html">view.html</a> turns with the mouse; '
    '<a href="scene.glb">scene.glb</a> is the same scene for other programs.</figcaption></figure>'
)


def solid_view(run: CameraRun) -> tuple[Artefact, Mapping[str, bytes]]:
    """Return the figure of a camera in its state, and the contents of view.html and scene.glb by name.

    A camera through which no light finds its way from the ends of the line has a note in place of the figure, and no
    files.
    """
    state, length = run.optics.state, run.first_order.length
    tube = min(TUBE, 6e-4 * length)
    try:
        instrument = run.instrument
        paths = trace_light_paths(instrument, run.optics.path.backend, state, length)
    except PhysicalError as error:
        return Undrawn("view", TITLE, "", f"{type(error).__name__}: {error}"), {}
    scene = scene_bytes(instrument, state, paths, tube)
    still = PngFigure("view", TITLE, "", still_png(instrument, paths))
    image = Markup(_IMAGE).format(still.address, f"{run.setup.title} {TITLE.lower()}")
    moved = run.perturbed.words if run.perturbed is not None else ""
    page = viewer_page(f"Camera {run.setup.title}", scene, moved, image)
    return (
        Piece("view", "", "", Markup(_FIGURE).format(TITLE, image), within=""),
        {"view.html": page.encode(), "scene.glb": scene},
    )
