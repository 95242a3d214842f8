"""Report of a focal-plane alignment from a measured through-focus series: what was found, how well, and what limits
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from analysis.focal_plane.through_focus import QUARTIC, FocusVertex
from analysis.units import ARCMIN
from analysis.units import UM_PER_M as UM
from scenes.yaml.units import LENGTH, format_quantity
from twin.laboratory.focus_alignment import Alignment
from twin.laboratory.focus_numbers import focus_numbers
from twin.laboratory.focus_plots import FIELD_COLOURS
from twin.laboratory.focus_report import focus_report
from twin.laboratory.measured_focus import MeasuredAlignment
from twin.laboratory.turntable_report import DOUBTFUL
from twin.run.artefact import Artefact, Cell, SvgFigure, Table, fixed
from twin.run.report import Report, Section, one_sentence
from twin.run.svg import GREY, INK, look, new_figure, plain_axes, to_svg
from twin.targets.target_images import DIRECTION_NAMES

MOVED = {
    "image": "image, along the light",
    "target": "target, along the light",
    "focal_plane": "CCD, along the light",
}
_COLUMNS, _MOST_PANELS = 5, 10


def any_focus_report(run: Alignment | MeasuredAlignment) -> Report:
    """Report of an alignment on a simulated bench or of a measured one."""
    return measured_focus_report(run) if isinstance(run, MeasuredAlignment) else focus_report(run)


def measured_focus_report(run: MeasuredAlignment) -> Report:
    """Report of a measured alignment."""
    data = focus_numbers(run)
    spec, mount = run.spec, run.spec.mount
    level = run.level
    edges = " and ".join(DIRECTION_NAMES[edge] for edge in run.edges)
    return Report(
        "Focal-plane alignment",
        _verdict(run, data),
        (),
        (
            ("Places", f"{len(run.sites)} of {len(_bands(run))} bands, MTF {edges}"),
            ("Moved", MOVED[spec.measured.moved]),
            (
                "Level of the line",
                "not read: the turn about Z′ stays" if level is None else f"{level.angle / ARCMIN:.3f} arcmin",
            ),
            (
                "Mount",
                f"{len(mount.holes)} holes, surface inclined by {np.degrees(mount.tilt):g}°, shims of "
                f"{format_quantity(mount.thickness, LENGTH)} ground in steps of {format_quantity(mount.step, LENGTH)}",
            ),
            *(("File", f"{one['file']}, {one['rows']} rows") for one in data["files"]),
            ("Description", spec.description),
        ),
        _summary(data),
        (_shims(data), _plane(run, data), _curves(run, data)),
        warnings=_warnings(run, data),
    )


def _bands(run: MeasuredAlignment) -> list[str]:
    return list(dict.fromkeys(site.band for site in run.sites))


def _verdict(run: MeasuredAlignment, data: Mapping[str, Any]) -> str:
    plane = data["plane"]
    chips, noise = plane["chips_um_rms"], UM * float(np.sqrt(np.mean(run.defocus_sigma**2)))
    limit = (
        f"by the CCDs, which do not stand in one plane by {chips:.1f} µm rms, and no shim takes that away"
        if chips > noise
        else f"by the noise of each place, {noise:.1f} µm rms"
    )
    gone = len(run.no_edge)
    return one_sentence(
        f"The CCDs stand up to {data['confocal_um_max']:.1f} ± {data['confocal_um_sigma']:.1f} µm from best focus",
        f"new shims will bring them within {data['expected_confocal_um_max']:.1f} ± "
        f"{data['expected_confocal_um_sigma']:.1f} µm, limited {limit}",
        f"chi-square of the plane {plane['chi_square']:.1f} for {plane['degrees_of_freedom']} degrees of freedom, of "
        f"the curves through focus {data['curves_chi_square']:.0f} for {data['curves_degrees_of_freedom']}",
        f"{gone} images without a measurable edge" if gone else "",
        "see the shims",
    )


def _warnings(run: MeasuredAlignment, data: Mapping[str, Any]) -> tuple[str, ...]:
    out = []
    square, freedom = run.chi_square
    if freedom and chi2.sf(square, freedom) < DOUBTFUL:
        out.append(
            f"the curves through focus scatter more than their sigmas allow, chi-square {square:.0f} for {freedom} "
            "degrees of freedom: sigmas of the MTF are too small, or the curves have another form; sigmas of the "
            f"places are too small by about {np.sqrt(square / freedom):.1f}; those of plane and shims hold what places "
            "scatter"
        )
    if len(run.edges) == 1:
        out.append(
            f"one direction only, {DIRECTION_NAMES[run.edges[0]]}: with astigmatism best focus is midway between two"
        )
    if run.level is None:
        out.append("the line's level was not read: shims that tilt the assembly can turn the line, see the shims")
    if not data["plane"]["degrees_of_freedom"]:
        out.append("three places give a plane and nothing to judge it by: no sigma knows of CCDs off one plane")
    return tuple(out)


def _summary(data: Mapping[str, Any]) -> Table:
    plane = data["plane"]
    rows: list[tuple[Cell, ...]] = [
        ("largest distance from best focus [µm]", data["confocal_um_max"], data["confocal_um_sigma"]),
        ("piston of the plane [µm]", plane["piston_um"], plane["piston_um_sigma"]),
        ("slope along X′ [arcsec]", plane["slope_x_arcsec"], plane["slope_x_arcsec_sigma"]),
        ("slope along Y′ [arcsec]", plane["slope_y_arcsec"], plane["slope_y_arcsec_sigma"]),
        ("CCDs off one plane [µm rms]", plane["chips_um_rms"], None),
    ]
    rows += [
        (f"change of shim {name.removeprefix('hole_')} [µm]", one["change_um"], one["change_um_sigma"])
        for name, one in data["shims"].items()
    ]
    caption = "Plane: best focus minus CCD. Sigmas hold noise, CCDs off one plane, and an error common to all vertices."
    return Table("alignment", "Result", caption, ("", "measured", "sigma"), rows, (None, 2, 2))


def _shims(data: Mapping[str, Any]) -> Section:
    rows = [
        (
            name.removeprefix("hole_"),
            f"{fixed(one['change_um'], 1)} ± {one['change_um_sigma']:.1f}",
            fixed(one["ground_um"], 1),
            fixed(one["shim_um"], 1),
            fixed(float(np.linalg.norm(one["slide_mm"])), 3),
        )
        for name, one in data["shims"].items()
    ]
    text = (
        f"The turn in the mounting surface of {fixed(data['turn_by_hand_arcmin'], 2)} arcmin is set by hand; without "
        f"it the line would be off its wanted level by {fixed(data['line_level_without_turn_arcmin'], 2)} arcmin, "
        "as the mounting surface is not parallel to the focal plane.",
    )
    heads = ("hole", "change [µm]", "ground [µm]", "new shim [µm]", "slide [mm]")
    return Section("Shims", text, (Table("shims-1", "Shims", "Changes of thickness under each hole.", heads, rows),))


def _plane(run: MeasuredAlignment, data: Mapping[str, Any]) -> Section:
    plane = data["plane"]
    rows: list[tuple[Cell, ...]] = [
        (one["band"], one["x_mm"], one["y_mm"], one["defocus_um"], one["defocus_um_sigma"], one["residual_um"])
        for one in data["sites"]
    ]
    text = (
        f"Chi-square of the plane is {plane['chi_square']:.1f} for {plane['degrees_of_freedom']} degrees of freedom "
        "with the places' own sigmas. What the places scatter beyond them, "
        f"{plane['chips_um_rms']:.1f} µm rms, is in the weights and in all sigmas of plane and shims: CCDs that are "
        "not in one plane, curvature of the field, sigmas that are too small.",
        f"All vertices share an error of {UM * run.spec.vertex_error:.2g} µm by the form of the curve; "
        f"{UM * run.spec.vertex_trend:.2g} µm of it change from the middle to the ends; both are in the sigmas.",
    )
    heads = ("band", "x [mm]", "y [mm]", "CCD downstream of focus [µm]", "sigma [µm]", "from the plane [µm]")
    artefacts: tuple[Artefact, ...] = (
        SvgFigure(
            "defocus",
            "Where the CCDs stand",
            "Measured with one sigma by noise; lines: the plane that the shims take away.",
            defocus_svg(run),
        ),
        Table("places", "Places", "", heads, rows, (None, 3, 3, 2, 2, 2)),
    )
    return Section("Plane", text, artefacts, folded=1)


def _curves(run: MeasuredAlignment, data: Mapping[str, Any]) -> Section:
    rows: list[tuple[Cell, ...]] = [
        (
            one["band"],
            one["x_mm"],
            one["y_mm"],
            DIRECTION_NAMES[edge],
            curve["vertex_um"],
            curve["vertex_um_sigma"],
            f"{curve['peak_mtf']:.4f} ± {curve['peak_mtf_sigma']:.4f}",
            curve["chi_square"],
            curve["degrees_of_freedom"],
            f"{curve['positions_used']} of {curve['positions']}",
        )
        for one in data["sites"]
        for edge, curve in one["curves"].items()
    ]
    heads = ("band", "x [mm]", "y [mm]", "direction", "vertex [µm]", "sigma [µm]", "peak", "χ²", "ν", "positions")
    artefacts: list[Artefact] = [
        SvgFigure(
            "through-focus",
            "Through focus",
            "MTF with one sigma and the fitted curve, by band; black: the CCD.",
            through_focus_svg(run),
        ),
        Table(
            "curves", "Curves through focus", "Vertices as moves of the image.", heads, rows, (None, 3, 3, None, 2, 2)
        ),
    ]
    if data["images_without_edge"]:
        gone = [(Path(one["file"]).name, one["line"], one["reason"]) for one in data["images_without_edge"]]
        heads_ = ("file", "line", "reason")
        note = "They have no weight."
        artefacts.insert(1, Table("no-edge", "Images without a measurable edge", note, heads_, gone))
    text = (
        "The main peak of every curve is fitted by v = p (1 − u + 0.3 u²), u = a (z − z₀)², over the positions where "
        "it is above half of its peak; best focus of a place is midway between its directions.",
    )
    return Section("Through focus", text, tuple(artefacts), folded=1)


def through_focus_svg(run: MeasuredAlignment) -> str:
    """Curves through focus of every band, both directions."""
    bands = _bands(run)[:_MOST_PANELS]
    with look("through-focus"):
        rows = -(-len(bands) // _COLUMNS)
        figure = new_figure(3.0 * rows + 0.3)
        panels = figure.subplots(rows, min(len(bands), _COLUMNS), squeeze=False, sharey=True).ravel()
        for axes, band in zip(panels, bands, strict=False):
            own = [k for k, site in enumerate(run.sites) if site.band == band]
            for number, k in enumerate(own):
                colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
                scan = run.scans[k]
                for marker, edge in zip("os", scan.vertex, strict=False):
                    good = np.isfinite(scan.sigma[edge])
                    at, value, sigma = (each[edge][good] for each in (scan.shift, scan.mtf, scan.sigma))
                    fill = colour if marker == "o" else "white"
                    axes.errorbar(UM * at, value, sigma, fmt=marker, ms=2.6, lw=0.7, color=colour, mfc=fill)
                    place = np.linspace(np.min(at), np.max(at), 101)
                    axes.plot(UM * place, _form(scan.vertex[edge], place), color=colour, lw=0.8)
            axes.axvline(0.0, color=INK, lw=0.8)
            axes.set(title=band or "all places", xlabel="move of the image [µm]", ylim=(0.0, None))
            plain_axes(axes)
        panels[0].set_ylabel("MTF (○ filled: along the line,\nopen: along the track)")
        for axes in panels[len(bands) :]:
            axes.set_visible(False)
        return to_svg(figure)


def _form(vertex: FocusVertex, place: np.ndarray) -> np.ndarray:
    """The fitted curve, where it is above a third of its peak."""
    u = -0.5 * vertex.curvature / vertex.peak * (place - vertex.position) ** 2
    value = vertex.peak * (1.0 - u + QUARTIC * u**2)
    return np.where((value > vertex.peak / 3.0) & (u < 0.5 / QUARTIC), value, np.nan)


def defocus_svg(run: MeasuredAlignment) -> str:
    """Defocus of every place, and the fitted plane."""
    plane = run.shimming.plane
    with look("defocus"):
        figure = new_figure(3.4)
        axes = figure.subplots()
        for k, band in enumerate(_bands(run)):
            own = [i for i, site in enumerate(run.sites) if site.band == band]
            colour = FIELD_COLOURS[k % len(FIELD_COLOURS)]
            places = np.array([run.sites[i].place for i in own])
            along = 1e3 * places[:, 1]
            axes.errorbar(
                along,
                UM * run.defocus[own],
                UM * run.defocus_sigma[own],
                fmt="o",
                ms=3.5,
                lw=1.0,
                color=colour,
                label=band or "all places",
            )
            for x in np.unique(places[:, 0]):
                line = np.array([[x, y] for y in (np.min(places[:, 1]), np.max(places[:, 1]))])
                axes.plot(1e3 * line[:, 1], -UM * plane.plane(line)[0], color=colour, lw=0.8, alpha=0.7)
        axes.axhline(0.0, color=GREY, lw=0.7)
        axes.set(xlabel="along the line Y′ [mm]", ylabel="CCD downstream of focus [µm]")
        plain_axes(axes)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=max(len(labels), 1))
        return to_svg(figure)
