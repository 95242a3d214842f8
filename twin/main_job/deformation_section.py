"""The report's section on mirrors and faces that tables of displaced nodes deform: tables and maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from analysis.units import ARCSEC
from optics.thermal.nodal_deformation import NodalDeformation
from twin.main_job.job_tables import faces_of
from twin.main_job.render_results import RenderRun
from twin.run.artefact import Cell, SvgFigure, Table, plain
from twin.run.report import Section
from twin.run.svg import look, new_figure, signed_map, to_svg

NAMED = 1e-10
"""Terms smaller than this, metres rms, are left out of the report's table."""
_PIXELS = 220


def deformation_section(run: RenderRun) -> Section | None:
    """Numbers, terms and maps of all deformed bodies; None where there are none."""
    faces = faces_of(run)
    if not faces:
        return None
    heads = (
        *("body", "nodes", "not used", "spacing [mm]", "rotate x [arcsec]", "rotate y [arcsec]", "rotate z [arcsec]"),
        *("shift x [µm]", "shift y [µm]", "shift z [µm]", "growth [ppm]"),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            *(path, len(face.weight), face.others, 1e3 * face.spacing),
            *(turn / ARCSEC for turn in face.rotate),
            *(1e6 * move for move in face.shift),
            1e6 * face.growth,
        )
        for path, face in faces.items()
    ]
    parts = ("body", "change [nm rms]", "PV [nm]", "after Zernike [nm rms]", "PV [nm]", "after grid [nm rms]")
    left: list[tuple[Cell, ...]] = [
        (
            path,
            *(1e9 * f(v) for v in (face.change, face.residual) for f in (face.rms, face.range)),
            1e9 * face.rms(face.lost),
            1e9 * face.between,
        )
        for path, face in faces.items()
    ]
    terms = [
        (path, f"Z{j}", 1e9 * a) for path, face in faces.items() for j, a in face.figure.items() if abs(a) >= NAMED
    ]
    about = (
        "Displacements of the nodes are taken apart, each part by what the one before leaves: the rigid motion and "
        "growth nearest to the material by least squares, every node weighted with its part of the clear aperture; "
        "Zernike terms of the change of sag, along the surface's +z; and a grid that carries the rest. Nodes left out: "
        "how well the spline of every second node foretells the others, an upper limit of what the mesh does not know "
        "between its nodes."
    )
    return Section(
        "Deformed mirrors and faces",
        (about,),
        (
            Table(
                "deformation_motion",
                "Rigid motion and growth",
                "In the body's own nominal axes, about its origin. Nodes off the optical surface are not used.",
                heads,
                rows,
                (),
                5,
            ),
            Table(
                "deformation_figure",
                "Change of sag, and what each step leaves",
                "Over the clear aperture.",
                (*parts, "nodes left out [nm rms]"),
                left,
                (),
                4,
            ),
            SvgFigure(
                "deformation_maps",
                "Maps of the change of sag",
                "At the nodes: beyond the rigid motion, after the Zernike terms, and what the grid does not carry. "
                "White is zero; every map has its own scale.",
                _maps_svg(faces),
            ),
            Table(
                "deformation_terms",
                "Zernike terms",
                f"Noll's numbering, rms over the disk; those of {plain(1e9 * NAMED)} nm and more.",
                ("body", "term", "amplitude [nm]"),
                terms,
                (),
                5,
            ),
        ),
        1,
    )


def _maps_svg(faces: Mapping[str, NodalDeformation]) -> str:
    with look("deformation"):
        figure = new_figure(3.3 * len(faces))
        rows = figure.subplots(len(faces), 3, squeeze=False)
        for axes, (path, face) in zip(rows, faces.items(), strict=True):
            _maps(figure, axes, path, face)
        return to_svg(figure)


def _maps(figure: Figure, axes: Any, path: str, face: NodalDeformation) -> None:
    """Each node colours its own cell of the aperture."""
    inside = face.weight > 0.0
    places = face.places[inside]
    low, high = places.min(axis=0), places.max(axis=0)
    step = float(np.max(high - low)) / _PIXELS
    x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    distance, nearest = cKDTree(places).query(np.stack(np.meshgrid(x, y), axis=-1))
    ends = tuple(1e3 * float(v) for v in (low[0], high[0], low[1], high[1]))
    for one, title, values in (
        (axes[0], f"{path}: change of sag", face.change),
        (axes[1], f"after Z{max(face.figure)}", face.residual),
        (axes[2], "after the grid", face.lost),
    ):
        shown = np.where(distance <= 2.0 * face.spacing, 1e9 * values[inside][nearest], np.nan)
        most = max(float(np.nanmax(np.abs(shown))), 1e-6)
        picture = signed_map(one, shown, most, extent=ends, origin="lower", interpolation="nearest")
        one.set_title(
            f"{title}\n{1e9 * face.rms(values):.3g} nm rms, {1e9 * face.range(values):.3g} nm PV", fontsize=8.5
        )
        one.set_xlabel("x, mm")
        one.tick_params(labelsize=7)
        bar = figure.colorbar(picture, ax=one, shrink=0.8, pad=0.02)
        bar.ax.tick_params(labelsize=7)
    axes[0].set_ylabel("y, mm")
