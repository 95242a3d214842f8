"""The report's sections on bodies that tables of displaced nodes deform and that tables of temperatures warm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from analysis.arrays import ARCSEC
from optics.thermal.nodal_deformation import NodalDeformation
from twin.framework.artefact import Cell, SvgFigure, Table, plain
from twin.framework.report import Section
from twin.framework.svg import look, new_figure, signed_map, to_svg
from twin.main_job.job_tables import BENT, WARMED, faces_of, heated_of
from twin.main_job.render_results import JobRun

NAMED = 1e-10
"""Terms smaller than this, metres rms, are left out of the report's table."""
_PIXELS = 220
_HEADS = (
    *("body", "nodes", "spacing [mm]", "change [K]", "gradient x [K/m]", "gradient y [K/m]", "gradient z [K/m]"),
    *("not linear [K rms]", "largest [K]", "nodes left out [K rms]", "outside [%]", "farthest [mm]"),
)
_FACES = (
    *("face", "rotate x [arcsec]", "rotate y [arcsec]", "shift z [nm]", "figure [nm rms]"),
    *("not carried [nm rms]", "coarser elements [nm rms]"),
)


def deformation_section(run: JobRun) -> Section | None:
    """Numbers, terms and maps of all deformed bodies; None where there are none."""
    faces = faces_of(run)
    if not faces:
        return None
    heads = (
        *("body", "nodes", "not used", "spacing [mm]", "rotate x [arcsec]", "rotate y [arcsec]", "rotate z [arcsec]"),
        *("shift x [µm]", "shift y [µm]", "shift z [µm]", "growth [ppm]"),
    )
    found = {path: BENT(face) for path, face in faces.items()}
    rows: list[tuple[Cell, ...]] = [
        (
            *(path, told["nodes"], told["nodes_not_used"], told["spacing_mm"]),
            *(*told["rotate_arcsec"], *told["shift_um"], told["growth_ppm"]),
        )
        for path, told in found.items()
    ]
    parts = ("body", "change [nm rms]", "PV [nm]", "after Zernike [nm rms]", "PV [nm]", "after grid [nm rms]")
    sizes = ("change_rms_nm", "change_pv_nm", "residual_rms_nm", "residual_pv_nm", "not_carried_rms_nm")
    left: list[tuple[Cell, ...]] = [
        (path, *(told[key] for key in (*sizes, "between_nodes_rms_nm"))) for path, told in found.items()
    ]
    terms = [
        (path, term, size)
        for path, told in found.items()
        for term, size in told["figure_nm"].items()
        if abs(size) >= 1e9 * NAMED
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


def heat_section(run: JobRun) -> Section | None:
    """Numbers of all bodies that tables of temperatures warm; None where there are none."""
    bodies = heated_of(run)
    if not bodies:
        return None
    rows: list[tuple[Cell, ...]] = [
        (
            *(path, told["nodes"], told["spacing_mm"], told["linear_change_k"], *told["linear_gradient_k_per_m"]),
            *(told["not_linear_rms_k"], told["not_linear_largest_k"], told["between_nodes_rms_k"]),
            *(("", "") if body.coverage is None else (100.0 * told["outside_share"], told["farthest_mm"])),
        )
        for (path, body), told in zip(bodies.items(), map(WARMED, bodies.values()), strict=True)
    ]
    faces: list[tuple[Cell, ...]] = [
        (
            *(face, change.motion.rotate[0] / ARCSEC, change.motion.rotate[1] / ARCSEC, 1e9 * change.motion.shift[2]),
            *(1e9 * change.figure_rms, 1e9 * change.lost, 1e9 * change.unmeshed),
        )
        for body in bodies.values()
        for face, change in body.faces.items()
    ]
    tables = [
        Table(
            "temperature_tables",
            "Temperatures, and what of them is linear",
            "Changes from the instrument's temperature. Outside: share of the body's volume beyond the nodes; farthest "
            "from any node. Nodes left out: how well every second one is foretold by the others.",
            _HEADS,
            rows,
            (),
            4,
        )
    ]
    if faces:
        tables.append(
            Table(
                "temperature_faces",
                "What is not linear does to optical faces",
                "In the face's own nominal axes. Coarser elements: by how much these would differ.",
                _FACES,
                faces,
                (),
                4,
            )
        )
    about = (
        "Temperatures are linear between the nodes. The linear field nearest to them over the body's volume acts like "
        "every linear temperature: growth, bending, index, and what the body carries. The rest deforms the body's own "
        "finite elements, held at three points."
    )
    return Section("Bodies warmed by tables", (about,), tuple(tables), 1)
