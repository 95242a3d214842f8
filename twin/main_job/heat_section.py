"""What the tables of temperatures were found to be: their numbers, and the report's section."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from analysis.units import ARCSEC
from scenes.models.nodal_bodies import HeatedBody
from twin.main_job.job_tables import table_names
from twin.main_job.render_results import RenderRun
from twin.run.artefact import Cell, Table
from twin.run.report import Section

_HEADS = (
    *("body", "nodes", "spacing [mm]", "change [K]", "gradient x [K/m]", "gradient y [K/m]", "gradient z [K/m]"),
    *("not linear [K rms]", "largest [K]", "nodes left out [K rms]", "outside [%]", "farthest [mm]"),
)
_FACES = (
    *("face", "rotate x [arcsec]", "rotate y [arcsec]", "shift z [nm]", "figure [nm rms]"),
    *("not carried [nm rms]", "coarser elements [nm rms]"),
)


def heated_of(run: RenderRun) -> Mapping[str, HeatedBody]:
    """Body -> what its table is."""
    return run.experiment.heated(run.resolved.job)


def heat_numbers(run: RenderRun) -> dict[str, Any]:
    """Contents of temperature.json."""
    names = table_names(run.resolved.job)
    bodies = heated_of(run).items()
    return {"bodies": {path: {"table": names[path, "temperature"], **_numbers(body)} for path, body in bodies}}


def _numbers(body: HeatedBody) -> dict[str, Any]:
    covered = body.coverage
    return {
        "nodes": body.nodes,
        "spacing_mm": 1e3 * body.spacing,
        "linear_change_k": body.linear.change,
        "linear_gradient_k_per_m": list(body.linear.gradient),
        "not_linear_rms_k": body.left[0],
        "not_linear_largest_k": body.left[1],
        "between_nodes_rms_k": body.between,
        "outside_share": None if covered is None else covered.outside,
        "farthest_mm": None if covered is None else 1e3 * covered.farthest,
        "index_path_not_carried_nm": 1e9 * body.index_path,
        "faces": {
            face: {
                "rotate_arcsec": [turn / ARCSEC for turn in change.motion.rotate],
                "shift_nm": [1e9 * move for move in change.motion.shift],
                "growth_ppm": 1e6 * change.motion.stretch,
                "figure_nm": {f"Z{j}": 1e9 * a for j, a in change.motion.figure.items()},
                "not_carried_rms_nm": 1e9 * change.lost,
                "coarser_elements_rms_nm": 1e9 * change.unmeshed,
            }
            for face, change in body.faces.items()
        },
    }


def heat_section(run: RenderRun) -> Section | None:
    """Numbers of all bodies that tables of temperatures warm; None where there are none."""
    bodies = heated_of(run)
    if not bodies:
        return None
    rows: list[tuple[Cell, ...]] = [
        (
            *(path, body.nodes, 1e3 * body.spacing, body.linear.change, *body.linear.gradient, *body.left),
            body.between,
            *(("", "") if body.coverage is None else (100.0 * body.coverage.outside, 1e3 * body.coverage.farthest)),
        )
        for path, body in bodies.items()
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
