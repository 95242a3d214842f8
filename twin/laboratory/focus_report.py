"""Report of a focal-plane alignment: results, accuracy and what limits it; for a simulated bench also the true values.

Its plots show the MTF curves through focus, the defocus of the CCDs, MTF curves over frequency and recorded edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from analysis.arrays import ARCMIN, UM_PER_M
from analysis.arrays import UM_PER_M as UM
from analysis.focal_plane.through_focus import QUARTIC, FocusVertex
from analysis.mtf.slanted_edge import slanted_edge_mtf
from scenes.specs.camera_tests import MeasuredFocusSpec
from scenes.yaml.units import LENGTH, format_quantity
from twin.framework import svg
from twin.framework.artefact import Artefact, Cell, SvgFigure, Table, fixed
from twin.framework.record import Record
from twin.framework.report import Report, Section, answer
from twin.laboratory import focus_run
from twin.laboratory.focus_run import FocusRun, FocusState, Shimming, SimulatedFocus, SimulatedState
from twin.laboratory.turntable_run import DOUBTFUL
from twin.targets.target_images import ALONG, DIRECTION_NAMES, DIRECTIONS, TRACK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIELD_COLOURS = (svg.BLUE, svg.GREEN, svg.ORANGE, svg.VERMILION, svg.PURPLE)
EDGE_COLOURS = {ALONG: svg.BLUE, TRACK: svg.VERMILION}
PER_MM = 1e-3
"""Factor from cycles/m to cycles/mm."""
_COLUMNS, _MOST_BANDS = 5, 10


def _shown(run: FocusRun) -> list[tuple[int, FocusState, str]]:
    """Return number, state and title of the first and the last state (placement of the focal plane) measured."""
    last = len(run.states) - 1
    return [(0, run.states[0], "before"), (last, run.states[last], "after")] if last else [(0, run.states[0], "")]


def through_focus_figure(run: FocusRun) -> Figure:
    """Draw the MTF through focus of every band, in both directions, before the first and after the last shims."""
    bands, shown = list(dict.fromkeys(run.bands))[:_MOST_BANDS], _shown(run)
    columns, each = min(len(bands), _COLUMNS), -(-len(bands) // _COLUMNS)
    figure = svg.new_figure(3.0 * each * len(shown) + 0.3)
    grid = figure.subplots(each * len(shown), columns, squeeze=False, sharey=True)
    for (_, state, when), panels in zip(shown, np.split(grid, len(shown)), strict=True):
        for axes, band in zip(panels.ravel(), bands, strict=False):
            _curves(axes, run, state, band)
            axes.set_title(", ".join(part for part in (band, when) if part) or "all sites")
        for axes in panels.ravel()[len(bands) :]:
            axes.set_visible(False)
        panels[0, 0].set_ylabel("MTF with the pixel (○ filled: along the line,\nopen: along the track)")
    for axes in grid[-1]:
        axes.set_xlabel("shift of the image [µm]")
    return figure


def _curves(axes: Axes, run: FocusRun, state: FocusState, band: str) -> None:
    """Draw the measured MTF and the fitted curves through focus of one band."""
    scans = [scan for scan, name in zip(state.scans, run.bands, strict=True) if name == band]
    for number, scan in enumerate(scans):
        colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
        for edge, vertex in scan.vertex.items():
            good = np.isfinite(scan.sigma[edge])
            shift, value, sigma = (each[edge][good] for each in (scan.shift, scan.mtf, scan.sigma))
            fill = colour if edge == ALONG else "white"
            axes.errorbar(UM * shift, value, sigma, fmt="o", ms=2.6, lw=0.7, color=colour, mfc=fill)
            positions = np.linspace(np.min(shift), np.max(shift), 101)
            axes.plot(UM * positions, _form(vertex, positions), color=colour, lw=0.8)
    axes.axvline(0.0, color=svg.INK, lw=0.8)
    axes.set_ylim(bottom=0.0)
    svg.plain_axes(axes)


def _form(vertex: FocusVertex, positions: np.ndarray) -> np.ndarray:
    """Return the fitted MTF curve at given positions where it is above a third of its peak, NaN elsewhere."""
    u = -0.5 * vertex.curvature / vertex.peak * (positions - vertex.position) ** 2
    value = vertex.peak * (1.0 - u + QUARTIC * u**2)
    return np.where((value > vertex.peak / 3.0) & (u < 0.5 / QUARTIC), value, np.nan)


def defocus_figure(run: FocusRun) -> Figure:
    """Draw the defocus at every site before the first and after the last shims, with the fitted plane.

    For a simulated bench the true defocus is drawn too.
    """
    shown = _shown(run)
    figure = svg.new_figure(3.4)
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, (number, state, when) in zip(panels, shown, strict=True):
        _defocus(axes, run, number, state)
        axes.set(title=when, xlabel="along the line Y′ [mm]")
    panels[0].set_ylabel("CCD downstream of focus [µm]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=max(len(labels), 1))
    return figure


def _defocus(axes: Axes, run: FocusRun, number: int, state: FocusState) -> None:
    """Draw the defocus of the sites in one state (placement of the focal plane), band by band."""
    for k, band in enumerate(dict.fromkeys(run.bands)):
        of_band = np.array(run.bands) == band
        colour, positions = FIELD_COLOURS[k % len(FIELD_COLOURS)], run.positions[of_band]
        along, sigma = 1e3 * positions[:, 1], UM * state.defocus_sigma[of_band]
        style: dict[str, Any] = {"fmt": "o", "ms": 3.5, "lw": 1.0, "color": colour, "label": band or "all sites"}
        axes.errorbar(along, UM * state.defocus[of_band], sigma, **style)
        if isinstance(state, SimulatedState):
            axes.plot(along, UM * state.true_defocus[of_band], "_", ms=11, color=colour, alpha=0.8)
        if number < len(run.shimmings):
            for x in np.unique(positions[:, 0]):
                line = np.array([[x, y] for y in (np.min(positions[:, 1]), np.max(positions[:, 1]))])
                plane = run.shimmings[number].plane.plane(line)[0]
                axes.plot(1e3 * line[:, 1], -UM * plane, color=colour, lw=0.8, alpha=0.7)
    if isinstance(state, SimulatedState):
        axes.plot([], [], "_", ms=11, color=svg.GREY, label="truth")
    axes.axhline(0.0, color=svg.INK, lw=0.7)
    svg.plain_axes(axes)


def _middle(run: SimulatedFocus, band: str) -> int:
    """Return the number of the site of a band that is nearest to the middle of the field."""
    sites = run.bench.sites
    return min((i for i, s in enumerate(sites) if s.band == band), key=lambda i: abs(sites[i].field))


def mtf_figure(run: SimulatedFocus) -> Figure:
    """Draw the measured and true MTF curves in the middle of the field after the alignment."""
    bench, state = run.bench, run.states[-1]
    figure = svg.new_figure(3.0)
    panels = figure.subplots(1, len(bench.ccds), sharey=True, squeeze=False)[0]
    for axes, band in zip(panels, bench.ccds, strict=True):
        number = _middle(run, band)
        site, ccd = bench.sites[number], bench.ccds[band]
        defocus = state.true_chip_z(number)
        for edge in DIRECTIONS:
            frames = state.focus[number].frames[edge]
            measured = slanted_edge_mtf(frames.mean(axis=0), noise=ccd.noise, frames=len(frames), uniform_light=True)
            frequency = measured.frequency / ccd.band.pitch
            true = np.abs(site.imagers[edge].transfer(defocus, frequency))
            colour, shown, mtf, margin = EDGE_COLOURS[edge], PER_MM * frequency, measured.mtf, 2.0 * measured.sigma
            axes.fill_between(shown, mtf - margin, mtf + margin, color=colour, alpha=0.25, lw=0)
            axes.plot(shown, mtf, color=colour, lw=1.2, label=DIRECTION_NAMES[edge])
            label = "truth" if edge == TRACK else None
            axes.plot(shown, true, color=svg.INK, lw=0.8, ls="--", label=label)
        axes.axvline(PER_MM * ccd.band.nyquist, color=svg.GREY, lw=0.8, ls=":")
        axes.set(title=band, xlabel="cycles/mm", xlim=(0.0, PER_MM / ccd.band.pitch), ylim=(0.0, 1.02))
        svg.plain_axes(axes)
    panels[0].set_ylabel("MTF with the pixel")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


MOVED = {"image": "image, along the light", "target": "target, along the light", "focal_plane": "CCD, along the light"}
"""Description in reports of the part that was moved through focus, by its name in the file."""


def focus_report(run: FocusRun) -> Report:
    """Return the report of a focal-plane alignment: results, accuracy, figures and tables."""
    data = focus_run.focus_numbers(run)
    sections = (_shims(run), _plane(run), _curve_section(run))
    if isinstance(run, SimulatedFocus):
        return Report(
            f"Focal-plane alignment of {run.bench.setup.camera.name}",
            *_alignment_verdict(run, data),
            _bench_facts(run),
            _rounds(data),
            (*sections, _mtf_section(run, data)),
            _edge_frames(run),
        )
    assert isinstance(run.test, MeasuredFocusSpec)
    summary, warnings = _summary(data), _warnings(run, data)
    return Report(
        "Focal-plane alignment", *_verdict(run, data), _facts(run, run.test), summary, sections, warnings=warnings
    )


def _alignment_verdict(run: SimulatedFocus, data: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    """Return the verdict on a simulated alignment and the sentences that follow it."""
    end = data["rounds"][-1]
    true, chips = data["truth"]["rounds"][-1]["confocal_um_max"], end["chips_um_rms"]
    rounds = len(run.shimmings)
    return answer(
        f"{'One round' if rounds == 1 else f'{rounds} rounds'} of shims moved the CCDs from "
        f"{data['initial']['confocal_um_max']:.0f} µm to {end['confocal_um_max']:.1f} ± "
        f"{end['confocal_um_sigma']:.1f} µm from best focus (truth: {true:.1f} µm), in every "
        f"field and band, and the line to {abs(end['line_level_arcmin']):.2f} arcmin of level",
        f"the CCDs scatter about one plane by {chips:.1f} µm rms, which no shim corrects" if chips > 0.0 else "",
        "see the rounds of the alignment and the MTF",
    )


def _edge_frames(run: SimulatedFocus) -> dict[str, np.ndarray]:
    """Return file name -> frames of all edges recorded after the alignment."""
    fields = run.bench.setup.test.fields
    return {
        f"{site.band}_field{fields.index(site.field) + 1}_{edge}": scan.frames[edge]
        for site, scan in zip(run.bench.sites, run.states[-1].focus, strict=True)
        for edge in DIRECTIONS
    }


def _facts(run: FocusRun, test: MeasuredFocusSpec) -> tuple[tuple[str, str], ...]:
    """Return the facts about a measured series, as pairs of label and text."""
    mount, level, file = test.mount, run.states[0].level, run.readings and run.readings.file
    edges = " and ".join(DIRECTION_NAMES[edge] for edge in run.edges)
    unread = "not read: the rotation about Z′ is not corrected"
    read = unread if level is None else f"{level.angle / ARCMIN:.3f} arcmin"
    return (
        ("Sites", f"{len(run.positions)} in {len(set(run.bands))} bands, MTF {edges}"),
        ("Scanned by moving", MOVED[test.measured.moved]),
        ("Level of the line", read),
        (
            "Mount",
            f"{len(mount.holes)} holes, surface inclined by {np.degrees(mount.tilt):g}°, shims of "
            f"{format_quantity(mount.thickness, LENGTH)} ground in steps of {format_quantity(mount.step, LENGTH)}",
        ),
        ("File", f"{file.file}, {file.rows} rows" if file else ""),
        ("Description", test.description),
    )


def _thousands(value: float) -> str:
    """Format a large number with narrow spaces between groups of three digits."""
    return f"{value:,.0f}".replace(",", "\u202f")


def _bench_facts(run: SimulatedFocus) -> tuple[tuple[str, str], ...]:
    """Return the facts about a simulated bench, as pairs of label and text."""
    setup = run.bench.setup
    test, camera = setup.test, setup.camera
    bands = ", ".join(
        f"{name} {1e9 * b.spectrum.ends[0]:.0f}–{1e9 * b.spectrum.ends[1]:.0f} nm, {UM_PER_M * b.pitch:g} µm"
        for name, b in camera.bands.items()
    )
    level, ccds = test.white, run.bench.ccds.items()
    electrons = ", ".join(f"{name} {_thousands(level * ccd.detector.full_well_e)} e" for name, ccd in ccds)
    return (
        (
            "Camera",
            f"{camera.name}: f {run.bench.focal_length:.3f} m (geometric mean of both directions), pupil "
            f"{camera.entrance_pupil:g} m; {bands}",
        ),
        (
            "Collimator",
            f"f {test.collimator.focal_length:g} m, aperture {test.collimator.aperture:g} m; a slanted edge of "
            f"{np.degrees(test.edge.angle):g}° at its focus, regions of {test.edge.region} × {test.edge.region} pixels",
        ),
        ("Light", f"bright side at {100 * level:.0f}% of the full well ({electrons}); {test.frames} frames averaged"),
        ("Fields", ", ".join(f"{f:g}".replace("-", "−") for f in test.fields) + " of half the line, all bands"),
        (
            "Mount",
            f"{len(test.mount.holes)} holes, surface inclined by {np.degrees(test.mount.tilt):g}° against the focal "
            f"plane, shims ground in steps of {UM_PER_M * test.mount.step:g} µm",
        ),
    )


def _rounds(data: Mapping[str, Any]) -> Table:
    """Return the table of focus errors before the alignment and after each round of shims.

    It gives the largest distance of a CCD from best focus, and the rotation of the line.
    """
    stages = [("before", data["initial"], data["truth"]["initial"])]
    for k, (measured, true) in enumerate(zip(data["rounds"], data["truth"]["rounds"], strict=True)):
        stages.append((f"after round {k + 1}", measured, true))
    rows = []
    for name, measured, true in stages:
        rows.append(
            (
                name,
                f"{measured['confocal_um_max']:.1f} ± {measured['confocal_um_sigma']:.1f}",
                fixed(true["confocal_um_max"], 1),
                f"{fixed(measured['line_level_arcmin'], 2)} ± {measured['line_level_arcmin_sigma']:.2f}",
                fixed(true["line_level_arcmin"], 2),
            )
        )
    return Table(
        "alignment",
        "Before and after",
        "Confocal error: largest distance of any CCD from best focus, over all fields and bands.",
        ("", "confocal error [µm]", "true", "line level [arcmin]", "true"),
        rows,
    )


def _verdict(run: FocusRun, data: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    """Return the verdict on a measured series and the sentences that follow it."""
    plane = data["plane"]
    chips, noise = plane["chips_um_rms"], UM_PER_M * float(np.sqrt(np.mean(run.states[0].defocus_sigma ** 2)))
    limit = (
        f"by the scatter of the CCDs about one plane, {chips:.1f} µm rms, which no shim corrects"
        if chips > noise
        else f"by the noise of each site, {noise:.1f} µm rms"
    )
    without_edge = len(data["images_without_edge"])
    return answer(
        f"The CCDs are up to {data['confocal_um_max']:.1f} ± {data['confocal_um_sigma']:.1f} µm from best focus",
        f"new shims will bring them within {data['expected_confocal_um_max']:.1f} ± "
        f"{data['expected_confocal_um_sigma']:.1f} µm, limited {limit}",
        f"chi-square of the plane is {plane['chi_square']:.1f} for {plane['degrees_of_freedom']} degrees of freedom, "
        f"of the curves through focus {data['curves_chi_square']:.0f} for {data['curves_degrees_of_freedom']}",
        f"{without_edge} {'image has' if without_edge == 1 else 'images have'} no measurable edge"
        if without_edge
        else "",
        "see the shims",
    )


def _warnings(run: FocusRun, data: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings of the report on a measured series."""
    out = []
    square, freedom = run.chi_square
    if freedom and chi2.sf(square, freedom) < DOUBTFUL:
        out.append(
            f"the curves through focus scatter more than their sigmas allow, chi-square {square:.0f} for {freedom} "
            "degrees of freedom: the sigmas of the MTF are too small, or the curves have another form. The sigmas of "
            f"the sites are too small by a factor of about {np.sqrt(square / freedom):.1f}; those of plane and shims "
            "include the scatter of the sites"
        )
    move, noise = run.states[0].skew
    if run.readings and chi2.sf((move / noise) ** 2, 1) < DOUBTFUL:
        out.append(
            f"the curves are wider on one side of their peaks than on the other: all sites may be shifted by"
            f" {UM_PER_M * move:+.1f} ± {UM_PER_M * noise:.1f} µm. The common error of"
            f" {UM_PER_M * run.shimmings[0].vertex_error:.1f} µm in the sigmas of plane and shims covers this"
        )
    for name, faults in (("rows are excluded", "excluded"), ("images have a doubtful sigma", "uneven")):
        rows = getattr(run.readings, faults, ())
        if rows:
            where = f"lines {', '.join(str(row.line) for row in rows[:9])}{', ...' if len(rows) > 9 else ''}"
            out.append(f"{len(rows)} {name} ({where} of {rows[0].file}); reason for the first: {rows[0].reason}")
    out += run.readings.file.doubts if run.readings else ()
    if len(run.edges) == 1:
        out.append(
            f"one direction only, {DIRECTION_NAMES[run.edges[0]]}: with astigmatism best focus lies midway between the "
            "two"
        )
    if run.states[0].level is None:
        out.append("the line's level was not read: shims that tilt the assembly can rotate the line, see the shims")
    if not data["plane"]["degrees_of_freedom"]:
        out.append("three sites determine a plane without redundancy: the sigmas do not include CCDs off one plane")
    return tuple(out)


def _summary(data: Mapping[str, Any]) -> Table:
    """Return the table of the largest distance from best focus, the fitted plane and the shims, with sigmas."""
    plane = data["plane"]
    rows: list[tuple[Cell, ...]] = [
        ("largest distance from best focus [µm]", data["confocal_um_max"], data["confocal_um_sigma"]),
        *focus_run.PLANE.lines(plane, ("piston_um", "slope_x_arcsec", "slope_y_arcsec", "chips_um_rms")),
    ]
    rows += [
        (f"change of shim {name.removeprefix('hole_')} [µm]", shim["change_um"], shim["change_um_sigma"])
        for name, shim in data["shims"].items()
    ]
    sources = "noise, CCDs off one plane, and an error common to all vertices"
    caption = f"Plane: best focus minus CCD. Sigmas include {sources}."
    return Table("alignment", "Result", caption, ("", "measured", "sigma"), rows, (None, 2, 2))


def _shims(run: FocusRun) -> Section:
    """Return the section on the shims of every round."""
    tables = []
    for number, shimming in enumerate(run.shimmings, 1):
        rows = {
            f"{hole}": {**shim, "slide_mm": float(np.linalg.norm(shim["slide_mm"]))}
            for hole, shim in enumerate(focus_run.SHIMS.rows(shimming), 1)
        }
        title = "Shims" if len(run.shimmings) == 1 else f"Shims of round {number}"
        caption = (
            "Changes of thickness under each hole. The rotation in the mounting surface of "
            f"{fixed(shimming.plan.rotation / ARCMIN, 2)} arcmin is set by hand; without it the line would deviate "
            f"from its nominal level by {fixed(shimming.plan.level_coupling / ARCMIN, 2)} arcmin, as the mounting "
            "surface is not parallel to the focal plane."
        )
        tables.append(focus_run.SHIMS.table(f"shims-{number}", title, caption, rows, label="hole"))
    return Section("Shims", (), tuple(tables))


def _last(run: FocusRun) -> tuple[FocusRun, FocusState, Shimming]:
    """Return the run, the last state to which a plane was fitted, and that plane with its shims."""
    number = len(run.shimmings) - 1
    return run, run.states[number], run.shimmings[number]


def _plane(run: FocusRun) -> Section:
    """Return the section on the fitted plane of best focus from which the last shims were computed."""
    *_, shimming = last = _last(run)
    plane = shimming.plane
    text = (
        f"Chi-square of the plane is {plane.chi_square:.1f} for {plane.degrees_of_freedom} degrees of freedom "
        "with the sites' sigmas by noise. The scatter of the sites beyond them, "
        f"{UM_PER_M * plane.extra_sigma:.1f} µm rms, is included in the weights and in all sigmas of plane and shims.",
        f"All vertices have a common error of {UM_PER_M * shimming.vertex_error:.2g} µm by the form of the curve; "
        f"{UM_PER_M * shimming.vertex_trend:.2g} µm of it change from the middle to the ends. The sigmas include both.",
    )
    keys = ("band", "x_mm", "y_mm", "defocus_um", "defocus_um_sigma", "residual_um")
    caption = "Measured, with one sigma by noise; lines: the plane that the shims correct."
    if isinstance(run, SimulatedFocus):
        caption += " Dashes: truth from the traced pupils."
    artefacts: tuple[Artefact, ...] = (
        SvgFigure("defocus", "Defocus of the CCDs", caption, svg.drawn("defocus", defocus_figure, run)),
        focus_run.SITE.table("places", "Sites", "Before the last shims.", focus_run.SITE.rows(last), keys),
    )
    return Section("Plane", text, artefacts, folded=1)


def _curve_section(run: FocusRun) -> Section:
    """Return the section on the curves through focus of the last state to which a plane was fitted."""
    rows = [
        {**site, "direction": DIRECTION_NAMES[edge], **curve}
        for site in focus_run.SITE.rows(_last(run))
        for edge, curve in site["curves"].items()
    ]
    where = [focus_run.SITE[key] for key in ("band", "x_mm", "y_mm")]
    record = Record("A curve.", *where, focus_run.BUDGET["direction"], *focus_run.CURVE)
    drawn = "MTF with one sigma and the fitted curve, by band; black: the CCD."
    artefacts: list[Artefact] = [
        SvgFigure("through-focus", "Through focus", drawn, svg.drawn("through-focus", through_focus_figure, run)),
        record.table("curves", "Curves through focus", "Vertices as shifts of the image.", rows),
    ]
    if run.readings and run.readings.no_edge:
        without_edge = [{**focus_run.ROW_FAULT(row), "file": Path(row.file).name} for row in run.readings.no_edge]
        title, note = "Images without a measurable edge", "These images have no weight."
        artefacts.insert(1, focus_run.ROW_FAULT.table("no-edge", title, note, without_edge))
    return Section("Through focus", (), tuple(artefacts), folded=1)


def _mtf_section(run: SimulatedFocus, data: Mapping[str, Any]) -> Section:
    """Return the section on the MTF at the Nyquist frequency and the factors that it is the product of."""
    end, true = data["rounds"][-1], data["truth"]["rounds"][-1]
    rows = [
        (
            band,
            f"{end['mtf_nyquist'][band]:.4f} ± {end['mtf_nyquist_sigma'][band]:.4f}",
            f"{true['mtf_nyquist'][band]:.4f}",
            f"{end['mtf_nyquist_along_line'][band]:.4f} ± {end['mtf_nyquist_along_line_sigma'][band]:.4f}",
        )
        for band in run.bench.ccds
    ]
    names = list(data["mtf_budget"][0]["factors"])
    budget = [
        [line["band"], DIRECTION_NAMES[line["direction"]]]
        + [f"{value:.3f}" for value in (*(line["factors"][n] for n in names), line["total"])]
        for line in data["mtf_budget"]
    ]
    return Section(
        "MTF with the pixel at the Nyquist frequency",
        (),
        (
            Table(
                "mtf",
                "Measured in focus, mean over the fields",
                "Sigma by noise; truth from the traced pupils at the true positions of the CCDs.",
                ("band", "along the track", "along the track, true", "along the line"),
                rows,
            ),
            Table(
                "mtf-budget",
                "MTF budget in the middle of the field",
                "Transfer factor of each effect at Nyquist, from the trace and the data sheets; diffraction: the pupil "
                "without aberrations; design: aberrations of the prescription, at best focus of each direction; "
                "wavefront: errors of camera and collimator, at best focus midway between the directions.",
                ("band", "direction", *(n.replace("_", " ").replace("tdi", "TDI") for n in names), "product"),
                budget,
            ),
            SvgFigure(
                "mtf-curves",
                "MTF curves in the middle of the field, after the alignment",
                "Measured from the slanted edge, with two sigma; dashed: the traced pupil times the detector's "
                "factors. Dotted: Nyquist frequency.",
                svg.drawn("mtf-curves", mtf_figure, run),
            ),
        ),
    )
