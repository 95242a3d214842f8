"""Report sections on image quality, targets, stray light, and deformed or heated bodies, if a job requests them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from twin.framework.artefact import (
    FAR,
    Artefact,
    Cell,
    Marked,
    SvgFigure,
    Table,
    fixed,
    plain,
    residual,
    residual_cell,
    significant,
)
from twin.framework.report import Section
from twin.main_job.render_files import DEFORMATION, HEATED_BODY
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.result_sections import IN_PAGE, figure
from twin.main_job.verdict import sharpness_lost
from twin.monitor.image_quality import AT_FIELDS, POSITIONS, WAVELENGTH, CameraQuality, ImageQuality
from twin.path_tracing.stray_light import FAMILY
from twin.targets.target_images import DIRECTION_NAMES, DIRECTIONS
from twin.targets.target_measurement import NYQUIST, BarReading, CameraTargets, EdgeReading, TargetRun

_WHEN = ("before", "after")
FREE = "obstruction by bodies is ignored: `obstruction: ignore`"


def quality_section(run: JobRun, drawn: Mapping[str, str]) -> Section | None:
    """Return the section on wavefront errors, focus and MTF of the line CCDs; None if not requested."""
    quality = run.quality
    if quality is None:
        return None
    rows: list[list[Cell]] = []
    bands: dict[int, str] = {}
    for name, camera in quality.cameras.items():
        first, last = (plain(1e9 * wavelength) for wavelength in camera.wavelengths)
        light = f"{first} nm" if first == last else f"{first} to {last} nm"
        nyquist = plain(1e-3 * camera.nyquist, 4)
        bands[len(rows)] = f"Camera {name}, MTF with the pixel in light of {light}, Nyquist {nyquist} cycles/mm"
        rows += _quality_rows(name, camera, quality)
    bodies = "; ".join(f"in {name} {', '.join(camera.bodies) or 'nothing'}" for name, camera in quality.cameras.items())
    obstruction_text = f"{FREE[0].upper()}{FREE[1:]}."
    if quality.obstruction:
        obstruction_text = f"The pupils include the obstruction by bodies in the beams: {bodies}."
    caption = (
        "At fixed pixels of each line CCD, at its middle and at its left (+Y′) and right end. "
        f"Wavefront errors are rms over the pupil at {plain(1e9 * WAVELENGTH)} nm, without piston and tilt. "
        "Best focus is counted along the light: + is behind the CCD. The MTF with the pixel is that of the traced "
        "pupil over the named light, times the pixel's and, where the camera describes them, those of charge "
        "diffusion and TDI; `python -m twin.camera` has that of the optics alone. "
        f"{obstruction_text} Means and worst values: "
        f"`quality.json`. The CSV has all {len(quality.fields)} fields."
    )
    parts: list[Artefact] = [
        Table(
            "quality",
            "",
            caption,
            ("", *_WHEN * len(POSITIONS)),
            rows,
            over=(("", 1), *((position, len(_WHEN)) for position in POSITIONS)),
            bands=bands,
            within=IN_PAGE,
            full=_table_of_all_fields(quality),
        )
    ]
    if quality.obstruction:
        caption = (
            "Pupils seen from three places of each line CCD, in units of their mean radius, and the light that is "
            "lost before → after. Dark: shadows of bodies in the beam, before; orange: after."
        )
        parts.append(figure(drawn, "pupils", caption))
    share, where, change = sharpness_lost(quality)
    loss = significant(100.0 * share, 2, floor=0.0)
    loss_text = f"The largest loss of MTF with the pixel at Nyquist is {loss} %, {where}: {change}."
    loss_text = loss_text if share > 0.0 else "The perturbation does not lower the MTF with the pixel at Nyquist."
    return Section("Image quality", (loss_text,), tuple(parts), name="quality")


def _quality_rows(name: str, camera: CameraQuality, quality: ImageQuality) -> list[list[Cell]]:
    rows: list[list[Cell]] = []
    for quantity in AT_FIELDS:
        values = quantity.shown_value(quantity.value(camera))
        row: list[Cell] = [quantity.shown_head]
        for position, field in POSITIONS.items():
            for s, when in enumerate(_WHEN):
                value = float(values[s, quality.fields.index(field)])
                text = fixed(value, quantity.decimals or 0, sign=quantity.key == "defocus_um")
                row.append(Marked(text, "", "number", f"quality.{name}.{quantity.key}.{position}.{when}"))
        rows.append(row)
    return rows


def _table_of_all_fields(quality: ImageQuality) -> Table:
    """Return the table of image quality with all digits at every field, including those that the report leaves out."""
    positions = {quality.fields.index(field): position for position, field in POSITIONS.items()}
    rows: list[list[Cell]] = []
    for name, camera in quality.cameras.items():
        values = [quantity.shown_value(quantity.value(camera)) for quantity in AT_FIELDS]
        for s, when in enumerate(_WHEN):
            for k, field in enumerate(quality.fields):
                numbers = (float(quantity_values[s, k]) for quantity_values in values)
                rows.append([name, when, float(field), positions.get(k, ""), *numbers])
    heads = ["camera", "state", "field", "place", *(quantity.shown_head for quantity in AT_FIELDS)]
    return Table("quality", "Image quality", "", heads, rows)


METHODS = {"edge": "ISO 12233 slanted edge", "bars": "fundamental of tilted bars"}
TITLES = {"edge": "knife edge", "bars": "bars"}
_DECIMALS = 4
"""Number of decimals of an MTF in the tables."""


def target_section(run: JobRun, drawn: Mapping[str, str]) -> Section | None:
    """Return the section with images of targets and the MTF measured in them; None if not requested."""
    targets = run.targets
    if targets is None:
        return None
    images = run.resolved.job.render.target_images
    kinds = [kind for kind, image in (("edge", "knife_edge"), ("bars", "bars")) if image in images]
    about = (
        "Targets at infinity are fixed in the directions that three places of each line CCD see in the nominal "
        "state. Their images are rendered through the traced pupil, over the band, with pixel, charge diffusion and "
        f"TDI; {targets.frames} frames each, bright areas at {plain(100.0 * run.resolved.targets.white)} % of the full "
        f"well{', less the light that bodies in the beams block' if targets.obstruction else f'; {FREE}'}."
    )
    if kinds:
        methods = ", ".join(METHODS[kind] for kind in kinds)
        about += (
            f" The MTF with the pixel is measured in these frames alone ({methods}) and compared with that of the "
            "traced pupil and the detector."
        )
    parts: list[Artefact] = [_mtf_table(targets, kinds)] if kinds else []
    curves = [name for name in targets.cameras if f"mtf {name}" in drawn]
    for k, name in enumerate(curves):
        caption = f"Camera {name}: MTF with the pixel along the edge's normal."
        if k == 0:
            squares = ", squares: of the bars" if "bars" in kinds else ""
            caption += (
                " Lines: traced pupil and detector. Dots: measured in the images of the knife edge"
                f"{squares}. Below each panel measured − true of the edge in thousandths, with bands of ±2 σ of the "
                "noise; where the MTF vanishes, noise can only increase it. Dotted: Nyquist frequency."
            )
        parts.append(figure(drawn, f"mtf {name}", caption, count=k))
    for k, name in enumerate(targets.cameras):
        caption = (
            f"Camera {name}: mean of {targets.frames} frames, columns along the line (+Y′ to the right), rows along "
            "the track (+X′ downward), grey from the darkest to the brightest pixel of each image, in proportion to "
            "the signal unless noted. The window follows the image by whole pixels. Files: "
            f"`images/{name}_PLACE_TARGET_before.tiff` and `…_after.tiff`."
        )
        title = f"Images of the targets, camera {name}"
        parts.append(figure(drawn, f"targets {name}", caption, title, count=k))
    return Section("Test targets and MTF", (about,), tuple(parts), len(targets.cameras), "targets")


def _mtf_table(targets: TargetRun, kinds: list[str]) -> Table:
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    bands: dict[int, str] = {}
    biases = []
    for name, camera in targets.cameras.items():
        nyquist, pitch = plain(1e-3 * NYQUIST / camera.pitch, 4), plain(1e6 * camera.pitch)
        bands[len(rows)] = f"Camera {name}, band {camera.band}, Nyquist {nyquist} cycles/mm, {pitch} µm pixels"
        for position, images in camera.positions.items():
            biases += [edge.nyquist_bias for shots in images.shots.values() for edge in shots.edges.values()]
            for direction in DIRECTIONS:
                row: list[Cell] = [f"{position}, {DIRECTION_NAMES[direction]}"]
                for kind in kinds:
                    for when, shots in images.shots.items():
                        reading = (shots.edges if kind == "edge" else shots.bars)[direction]
                        row += _mtf_cells(f"mtf.{name}.{position}.{direction}.{when}.{kind}", reading)
                move = fixed(1e6 * float(images.shift[DIRECTIONS.index(direction)]), 2, sign=True)
                rows.append([*row, Marked(f"{move} {DIRECTION_NAMES[direction]}", "", "number")])
        full += _mtf_rows(name, camera)
    known_biases = [bias for bias in biases if bias is not None]
    amount = f"at most {significant(max(known_biases), 2, floor=0.0)}" if known_biases else "an unknown amount"
    caption = f"Below each value: (measured − true) in units of σ, ● within {FAR:g} σ, ▲ beyond."
    if "edge" in kinds:
        caption += f" At Nyquist, noise biases the knife edge's values by {amount} on average, which is not corrected."
    if "bars" in kinds:
        caption += (
            " Bars are tilted at the Nyquist frequency; their fundamental is normalised by frames with the shutter "
            "closed and of uniform light, since in an area beside the bars diffraction tails lower the contrast by 1 %."
        )
    heads = ["camera", "band", "place", "direction", "state", "target", "MTF with the pixel at Nyquist", "sigma"]
    heads += ["true", "along the line [cycles/px]", "along the track [cycles/px]", "true on the axis"]
    return Table(
        "mtf",
        "MTF with the pixel at Nyquist, measured (±1 σ from noise) and true; move of the image on the line CCD, traced",
        f"{caption} More: `mtf.json`.",
        ("Place, direction of the MTF", *("before", "true", "after", "true") * len(kinds), "image moves [µm]"),
        rows,
        over=(("", 1), *((TITLES[kind], 4) for kind in kinds), ("", 1)),
        bands=bands,
        within=IN_PAGE,
        full=Table("mtf", "MTF", "", heads, full),
    )


def _mtf_rows(name: str, camera: CameraTargets) -> list[list[Cell]]:
    """Return table rows with the MTF measured in each of a camera's targets, with all digits."""
    rows: list[list[Cell]] = []
    for position, targets in camera.positions.items():
        for direction in DIRECTIONS:
            for when, shots in targets.shots.items():
                for kind, reading in (("edge", shots.edges.get(direction)), ("bars", shots.bars.get(direction))):
                    if reading is not None:
                        value, sigma = reading.nyquist or (None, None)
                        where: list[Cell] = [name, camera.band, position, DIRECTION_NAMES[direction], when, kind]
                        true: list[Cell] = [reading.true_nyquist, *reading.at_nyquist, reading.true_axis]
                        rows.append([*where, value, sigma, *true])
    return rows


def _mtf_cells(key: str, reading: EdgeReading | BarReading) -> tuple[Marked, Marked]:
    """Return the table cells of a measured MTF at Nyquist and of its true value."""
    true = Marked(fixed(reading.true_nyquist, _DECIMALS), "", "truth", f"{key}.true")
    measured = reading.nyquist
    if measured is None:
        return Marked("not measurable", "", "number", key), true
    value, sigma = measured
    text = f"{fixed(value, _DECIMALS)} ± {fixed(sigma, _DECIMALS)}"
    return residual_cell(text, residual(value - reading.true_nyquist, sigma), key), true


_STRONGEST = 4
"""Number of stray-light path families listed for each source, the strongest first."""


def stray_section(run: RenderRun) -> Section | None:
    """Return the section on stray light in the perturbed state, with its path families; None if not requested.

    A path family contains all ghost and scatter paths that meet the same surfaces in the same order.
    """
    if run.stray is None:
        return None
    after = run.stray.after
    shares = after.share(run.photons_after - after.photons)
    amounts: list[list[Cell]] = []
    families: list[list[Cell]] = []
    surfaces: list[list[Cell]] = []
    full: list[dict[str, Any]] = []
    for i, channel in enumerate(run.experiment.path.channels):
        here = f"{channel.key}/area_ccd"
        detected = [f for f in after.traced.relative(channel.key) if f.family.detector == here]
        by_kind = [sum(f.share for f in detected if f.family.kind == kind) for kind in ("ghost", "stray")]
        amounts.append([channel.key, float(shares[i]), *by_kind, float(after.photons[i].max())])
        records = [FAMILY(family) for family in detected]
        full += [{**family, "surfaces": " ".join(family["surfaces"])} for family in records]
        for family in records[:_STRONGEST]:
            share, sigma = family["relative_to_nominal"], family["relative_to_nominal_sigma"]
            size = f"{significant(share)} ± {significant(sigma, 1)}"
            numbers = (size, fixed(family["x_um"], 1), fixed(family["y_um"], 1))
            cells = (Marked(text, "", "number") for text in numbers)
            families.append([channel.key, family["kind"], family["name"], *cells])
            surfaces.append([channel.key, family["name"], _surface_list(family["surfaces"]) or "not identified"])
    keys = [*(family.key for family in FAMILY if family.key != "surfaces"), "surfaces"]
    amount_heads = ("area CCD", "all / spot", "ghosts / spot", "scattered / spot", "brightest pixel [photons]")
    parts: list[Artefact] = [
        Table(
            "stray-families",
            "Strongest families on the CCD of their source's channel; x, y from its middle",
            "A ghost is named by its reflections at faces that nominal light passes, and their number. All "
            "families, surface by surface: `stray.json` and the CSV.",
            ("Area CCD", "kind", "events", "share", "x [µm]", "y [µm]"),
            families,
            within=IN_PAGE,
            full=FAMILY.table("stray_families", "Families", "", full, keys),
        ),
        Table("stray", "Amounts", "", amount_heads, amounts, digits=3, within=IN_PAGE),
        Table(
            "stray_surfaces",
            "Surface by surface",
            "Surfaces in order: > transmitted, no mark reflected, * scattered, ~ diffused, ! outside the clear "
            "aperture.",
            ("Area CCD", "events", "surfaces in order"),
            surfaces,
            within=IN_PAGE,
        ),
    ]
    blocked: list[list[Cell]] = [[o.body, o.beam, 100.0 * o.share, 100.0 * o.used] for o in run.stray.obstructions]
    if blocked:
        heads = ["prism", "beam", "blocked [%]", "of this used by its channel [%]"]
        title = "Prisms that block part of a beam's cross-section, nominal instrument"
        parts.append(Table("stray_prisms", title, "", heads, blocked, (None, None, 1, 1), within=IN_PAGE))
    paths = f"{after.paths:,}".replace(",", "\N{THIN SPACE}")
    about = (
        f"{paths} paths from every pinhole through the perturbed instrument, each identified by the surfaces that it "
        "met. The nominal path is the spot itself. All other light is part of the images and listed here, relative to "
        "the spot."
    )
    return Section("Ghosts and stray light", (about,), tuple(parts), len(parts) - 2, "stray")


def _surface_list(surfaces: list[str]) -> str:
    """Return the names of surfaces in order, without the prefix that all paths through prisms share.

    The prefix is ``base/<camera>/monitor/<channel>/``.
    """
    prisms = [step for step in surfaces if "/monitor/" in step]
    common = "/".join(prisms[0].split("/")[:4]) + "/" if prisms else ""
    return " \N{RIGHTWARDS ARROW} ".join(step.removeprefix(common) for step in surfaces)


_SHOWN_ANGLES = np.arange(0.0, 90.0, 10.0)
"""Angles of incidence, in degrees, at which coatings are tabulated; those beyond the coating's table are omitted."""


def finish_section(run: RenderRun) -> Section | None:
    """Return the section on measured scatter and coatings of surfaces; None if there are none.

    The values shown are those at the monitor's wavelength.
    """
    measured = None if run.stray is None else run.stray.measured
    if measured is None or not (measured.scatter or measured.coatings):
        return None
    tables = []
    if measured.scatter:
        rows: list[tuple[Cell, ...]] = []
        for kind, scatter in measured.scatter.items():
            rms = scatter.table.reciprocity()
            for angle, specified in zip(scatter.table.incidence, scatter.tis, strict=True):
                total = scatter.table.total(float(angle))
                unequal: Cell = "" if np.isnan(rms) else 100.0 * rms
                rows.append((kind, float(np.degrees(angle)), 100.0 * total, 100.0 * specified, unequal))
        heads = ["surfaces", "incidence [deg]", "total scatter [%]", "specified in the file [%]"]
        heads += ["not reciprocal [% rms]"]
        text = "Shares of the incident light. Total scatter is the integral of the table, which the paths use."
        tables.append(Table("finish_scatter", "Measured scattering", text, heads, rows, (), 4))
    if measured.coatings:
        coating_rows: list[tuple[Cell, ...]] = []
        for kind, coating in measured.coatings.items():
            through = kind == "coated"
            for degrees in _SHOWN_ANGLES:
                if degrees == 0.0 or np.radians(degrees) <= coating.angles[-1]:
                    reflected, passed = coating.at(float(np.radians(degrees)), through)
                    coating_rows.append((kind, float(degrees), 100.0 * reflected, 100.0 * passed if through else ""))
        columns = ("surfaces", "incidence in air [deg]", "reflected [%]", "transmitted [%]")
        text = "At the monitor's wavelength, for unpolarised light."
        tables.append(Table("finish_coatings", "Measured coatings", text, columns, coating_rows, (), 4))
    about = "Surfaces with measured scatter or coatings; all others have built-in finishes."
    return Section("Measured finishes", (about,), tuple(tables), 1)


NAMED = 1e-10
"""Smallest amplitude of a Zernike term of a deformation that the report's table shows, in metres RMS."""


def _flat(numbers: Mapping[str, Any], *keys: str) -> list[Cell]:
    """Return the numbers that results hold under some keys as table cells; a vector gives one cell for each axis."""
    values = [numbers[key] for key in keys]
    return [number for value in values for number in (value if isinstance(value, list) else [value])]


def deformation_section(run: JobRun) -> Section | None:
    """Return the section with size, Zernike terms and maps of the deformation of bodies; None if there are none."""
    if not run.deformed:
        return None
    from twin.main_job.target_plots import deformation_svg  # what draws takes long to import

    motion = "nodes", "nodes_not_used", "spacing_mm", "rotate_arcsec", "shift_um", "growth_ppm"
    heads = ["body", "nodes", "not used", "spacing [mm]", *(f"rotate {axis} [arcsec]" for axis in "xyz")]
    heads += [*(f"shift {axis} [µm]" for axis in "xyz"), "scale [ppm]"]
    sizes = "change_rms_nm", "change_pv_nm", "residual_rms_nm", "residual_pv_nm", "not_carried_rms_nm"
    left = ["body", "change [nm rms]", "PV [nm]", "after Zernike [nm rms]", "PV [nm]", "after grid [nm rms]"]
    records = {path: DEFORMATION(face) for path, face in run.deformed.items()}
    terms = [
        (path, term, size)
        for path, numbers in records.items()
        for term, size in numbers["figure_nm"].items()
        if abs(size) >= 1e9 * NAMED
    ]
    parts = (
        Table(
            "deformation_motion",
            "Rigid motion and scale",
            "In the body's nominal axes, about its origin. Nodes off the optical surface are not used.",
            heads,
            [[path, *_flat(numbers, *motion)] for path, numbers in records.items()],
            digits=5,
        ),
        Table(
            "deformation_figure",
            "Change of sag, and residuals of the fits",
            "Over the clear aperture.",
            [*left, "cross-validation [nm rms]"],
            [[path, *_flat(numbers, *sizes, "between_nodes_rms_nm")] for path, numbers in records.items()],
            digits=4,
        ),
        SvgFigure(
            "deformation_maps",
            "Maps of the change of sag",
            "At the nodes: without the rigid motion, after the Zernike terms, and after the grid. White is zero; every "
            "map has its own scale.",
            deformation_svg(run.deformed),
        ),
        Table(
            "deformation_terms",
            "Zernike terms",
            f"Noll's numbering, rms over the disk; terms of at least {plain(1e9 * NAMED)} nm.",
            ("body", "term", "amplitude [nm]"),
            terms,
            digits=5,
        ),
    )
    return Section("Deformed mirrors and faces", (), parts, 1)


def heat_section(run: JobRun) -> Section | None:
    """Return the section on bodies whose temperatures come from tables of nodes; None if there are none."""
    if not run.heated:
        return None
    keys = ["nodes", "spacing_mm", "linear_change_k", "linear_gradient_k_per_m"]
    keys += ["not_linear_rms_k", "not_linear_largest_k", "between_nodes_rms_k"]
    heads = ["body", "nodes", "spacing [mm]", "change [K]", *(f"gradient {axis} [K/m]" for axis in "xyz")]
    heads += ["not linear [K rms]", "largest [K]", "cross-validation [K rms]", "outside [%]", "farthest [mm]"]
    rows: list[list[Cell]] = []
    for path, numbers in ((path, HEATED_BODY(body)) for path, body in run.heated.items()):
        share = numbers["outside_share"]
        outside: list[Cell] = ["", ""] if share is None else [100.0 * share, numbers["farthest_mm"]]
        rows.append([path, *_flat(numbers, *keys), *outside])
    faces: list[list[Cell]] = [
        [
            *(face, change.motion.rotate[0] / ARCSEC, change.motion.rotate[1] / ARCSEC, 1e9 * change.motion.shift[2]),
            *(1e9 * change.figure_rms, 1e9 * change.lost, 1e9 * change.mesh_error),
        ]
        for body in run.heated.values()
        for face, change in body.faces.items()
    ]
    caption = (
        "Changes from the instrument's temperature. Outside: share of the body's volume beyond the nodes; farthest: "
        "largest distance from any node. Cross-validation: error of every second node, interpolated from the others."
    )
    title = "Temperatures, and their linear part"
    tables = [Table("temperature_tables", title, caption, heads, rows, digits=4)]
    if faces:
        caption = "In the face's nominal axes. Coarser elements: the difference that coarser finite elements make."
        heads = ["face", "rotate x [arcsec]", "rotate y [arcsec]", "shift z [nm]", "figure [nm rms]"]
        heads += ["not carried [nm rms]", "coarser elements [nm rms]"]
        title = "Effect of the nonlinear part on optical faces"
        tables.append(Table("temperature_faces", title, caption, heads, faces, digits=4))
    return Section("Bodies with tabulated temperatures", (), tuple(tables), 1)
