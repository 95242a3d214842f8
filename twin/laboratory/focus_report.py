"""Report of a focal-plane alignment: the main table, sections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from analysis.units import ARCMIN
from analysis.units import UM_PER_M as UM
from twin.laboratory.focus_alignment import Alignment
from twin.laboratory.focus_numbers import focus_numbers
from twin.laboratory.focus_plots import defocus_svg, edges_svg, mtf_svg, through_focus_svg
from twin.run.artefact import SvgFigure, Table, fixed
from twin.run.report import Report, Section, one_sentence
from twin.targets.target_images import ALONG, DIRECTION_NAMES, DIRECTIONS, TRACK


def focus_report(alignment: Alignment) -> Report:
    """Report of an alignment."""
    first, last = alignment.states[0], alignment.states[-1]
    bench = alignment.bench
    data = focus_numbers(alignment)
    end = data["rounds"][-1]
    true, chips = data["truth"]["rounds"][-1]["confocal_um_max"], end["chips_um_rms"]
    verdict = one_sentence(
        f"{_number(len(alignment.shimmings))} of shims brought the CCDs from "
        f"{UM * np.max(np.abs(first.defocus)):.0f} µm to {end['confocal_um_max']:.1f} ± "
        f"{end['confocal_um_sigma']:.1f} µm from best focus (truly {true:.1f} µm), in every "
        f"field and band, and the line to {abs(end['line_level_arcmin']):.2f} arcmin of level",
        f"the CCDs do not stand in one plane, by {chips:.1f} µm rms, which no shim takes away" if chips > 0.0 else "",
        "see the rounds of the alignment and the MTF",
    )
    images = {
        f"{bench.sites[i].band}_field{k}_{edge}": scan.frames[edge]
        for i, scan in enumerate(last.focus)
        for edge in DIRECTIONS
        for k in [bench.setup.test.fields.index(bench.sites[i].field) + 1]
    }
    return Report(
        f"Focal-plane alignment of {bench.setup.camera.name}",
        verdict,
        (),
        _facts(alignment),
        _summary(data),
        (_alignment_section(alignment), _mtf_section(alignment, data), _shim_section(alignment)),
        images,
    )


def _number(rounds: int) -> str:
    return "One round" if rounds == 1 else f"{rounds} rounds"


def _thousands(value: float) -> str:
    """A large number with narrow spaces."""
    return f"{value:,.0f}".replace(",", "\u202f")


def _facts(alignment: Alignment) -> tuple[tuple[str, str], ...]:
    setup = alignment.bench.setup
    test, camera = setup.test, setup.camera
    bands = ", ".join(
        f"{name} {1e9 * b.spectrum[0]:.0f}–{1e9 * b.spectrum[1]:.0f} nm, {UM * b.pitch:g} µm"
        for name, b in camera.bands.items()
    )
    level = test.white
    electrons = ", ".join(
        f"{name} {_thousands(level * ccd.detector.full_well_e)} e" for name, ccd in alignment.bench.ccds.items()
    )
    return (
        (
            "Camera",
            f"{camera.name}: f {alignment.bench.focal_length:.3f} m (geometric mean of both directions), pupil "
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
            f"plane, shims ground in steps of {UM * test.mount.step:g} µm",
        ),
    )


def _summary(data: Mapping[str, Any]) -> Table:
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


def _alignment_section(alignment: Alignment) -> Section:
    text = (
        "The target is moved through the collimator's focus; a slanted edge is recorded at every position in both "
        "directions, and its MTF at the band's Nyquist frequency is fitted by its main peak. The image moves along the "
        "line's direction with f² of that direction over the collimator's f², which differ by "
        f"{100 * _anamorphism(alignment):.1f}% in this camera; each direction is reduced with its own.",
        "Best focus is midway between those of the two directions, which astigmatism moves apart.",
    )
    figures = (
        SvgFigure(
            "through-focus",
            "Through focus",
            "Measured MTF at Nyquist with one sigma; dotted, the fitted best focus of each field. Black: the CCD.",
            through_focus_svg(alignment),
        ),
        SvgFigure(
            "defocus",
            "Where the CCDs stand",
            "Points: measured with one sigma. Dashes: truth from the traced pupils.",
            defocus_svg(alignment),
        ),
    )
    return Section("Alignment", text, figures)


def _anamorphism(alignment: Alignment) -> float:
    site = alignment.bench.sites[0]
    return float(abs(site.nominal_per_shift[TRACK] / site.nominal_per_shift[ALONG] - 1.0))


def _mtf_section(alignment: Alignment, data: Mapping[str, Any]) -> Section:
    end, true = data["rounds"][-1], data["truth"]["rounds"][-1]
    rows = [
        (
            band,
            f"{end['mtf_nyquist'][band]:.4f} ± {end['mtf_nyquist_sigma'][band]:.4f}",
            f"{true['mtf_nyquist'][band]:.4f}",
            f"{end['mtf_nyquist_along_line'][band]:.4f} ± {end['mtf_nyquist_along_line_sigma'][band]:.4f}",
        )
        for band in alignment.bench.ccds
    ]
    names = list(data["mtf_budget"][0]["factors"])
    budget = [
        (
            line["band"],
            DIRECTION_NAMES[line["direction"]],
            *(f"{line['factors'][n]:.3f}" for n in names),
            f"{line['total']:.3f}",
        )
        for line in data["mtf_budget"]
    ]
    text = (
        "The MTF along the track has everything in it: optics, pixel, charge diffusion and the motion of the image "
        "over the stages.",
        "The camera as designed would have the product of diffraction, design and pixel. The others are the "
        "degradations that camera and test declare.",
    )
    return Section(
        "MTF at the Nyquist frequency",
        text,
        (
            Table(
                "mtf",
                "Measured in focus, mean over the fields",
                "The noise's sigma; truth from the traced pupils at the places where the CCDs really stand.",
                ("band", "along the track", "along the track, true", "along the line"),
                rows,
            ),
            Table(
                "mtf-budget",
                "What makes it, in the middle of the field",
                "Transfer of each effect at Nyquist, from the trace and the data sheets; diffraction: the pupil "
                "without aberrations; design: those of the prescription, at best focus of each direction; "
                "wavefront: the camera's and the collimator's errors, at best focus midway between the directions.",
                ("band", "direction", *(n.replace("_", " ").replace("tdi", "TDI") for n in names), "product"),
                budget,
            ),
            SvgFigure(
                "mtf-curves",
                "MTF curves in the middle of the field, after the alignment",
                "Measured from the slanted edge, with two sigma; dashed: the traced pupil times the detector's "
                "factors. Dotted: Nyquist frequency.",
                mtf_svg(alignment),
            ),
            SvgFigure("edges", "Recorded edges", "First frame in the middle of the field.", edges_svg(alignment)),
        ),
    )


def _shim_section(alignment: Alignment) -> Section:
    tables = []
    for number, shimming in enumerate(alignment.shimmings):
        plan = shimming.plan
        assert plan.thickness is not None
        rows = [
            (
                f"{k + 1}",
                f"{fixed(UM * float(plan.change[k]), 1)} ± {UM * float(plan.change_sigma[k]):.1f}",
                fixed(UM * float(plan.rounded_change[k]), 0),
                fixed(UM * float(plan.thickness[k]), 0),
                fixed(1e3 * float(np.linalg.norm(plan.slide[k])), 3),
            )
            for k in range(len(plan.thickness))
        ]
        tables.append(
            Table(
                f"shims-{number + 1}",
                f"Shims of round {number + 1}",
                "Changes of thickness under each hole; their sigma has in it that the sites do not lie on one plane "
                f"({UM * shimming.plane.extra_sigma:.1f} µm rms: chips, curvature of field). The turn in the mounting "
                f"surface of {fixed(plan.turn / ARCMIN, 2)} arcmin is set by hand; without it the line would be off "
                f"level by {fixed(plan.level_coupling / ARCMIN, 2)} arcmin, "
                "since the mounting surface is not parallel to the focal plane.",
                ("hole", "change [µm]", "ground [µm]", "new shim [µm]", "slide [mm]"),
                rows,
            )
        )
    return Section("Shims", (), tuple(tables))
