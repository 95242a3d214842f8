"""What the tables of displaced nodes were found to be: numbers and warnings."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from analysis.units import ARCSEC
from optics.thermal.nodal_deformation import PRINTED, SEEN, NodalDeformation
from twin.main_job.job_tables import table_names
from twin.main_job.render_results import RenderRun


def faces_of(run: RenderRun) -> Mapping[str, NodalDeformation]:
    """Body -> what its table is."""
    return run.experiment.deformed(run.resolved.job)


def deformation_numbers(run: RenderRun) -> dict[str, Any]:
    """Contents of deformation.json."""
    names = table_names(run.resolved.job)
    faces = faces_of(run).items()
    return {"bodies": {path: {"table": names[path, "deformation"], **_numbers(face)} for path, face in faces}}


def _numbers(face: NodalDeformation) -> dict[str, Any]:
    return {
        "nodes": len(face.weight),
        "nodes_not_used": face.others,
        "spacing_mm": 1e3 * face.spacing,
        "rotate_arcsec": [turn / ARCSEC for turn in face.rotate],
        "shift_um": [1e6 * move for move in face.shift],
        "growth_ppm": 1e6 * face.growth,
        "change_rms_nm": 1e9 * face.rms(face.change),
        "change_pv_nm": 1e9 * face.range(face.change),
        "figure_nm": {f"Z{j}": 1e9 * a for j, a in face.figure.items()},
        "residual_rms_nm": 1e9 * face.rms(face.residual),
        "residual_pv_nm": 1e9 * face.range(face.residual),
        "not_carried_rms_nm": 1e9 * face.rms(face.lost),
        "between_nodes_rms_nm": 1e9 * face.between,
        "mesh_prints_through": face.printed_through,
    }


def deformation_warnings(faces: Mapping[str, NodalDeformation], planes: Collection[str] = ()) -> tuple[str, ...]:
    """What the user should know of the meshes.

    Args:
        faces: body -> what its table is.
        planes: of these, faces of glass in a run with stray light, which takes them as planes.
    """
    bent = {path: 1e9 * faces[path].rms(faces[path].change) for path in planes}
    out = [
        f"{path}: stray light takes faces of glass as planes, without the {size:.3g} nm rms by which its table bends it"
        for path, size in bent.items()
    ]
    for path, face in faces.items():
        rest, between, lost = (1e9 * value for value in (face.rms(face.residual), face.between, face.rms(face.lost)))
        if face.printed_through:
            out.append(
                f"{path}: the mesh prints through: nodes left out are foretold to {between:.3g} nm rms only, of a "
                f"residual of {rest:.3g} nm after Z{max(face.figure)}; it changes from node to node "
                f"({1e3 * face.spacing:.3g} mm), so refine the mesh, or doubt what the residual does to images"
            )
        if face.rms(face.lost) > max(SEEN, PRINTED * face.rms(face.residual)):
            out.append(
                f"{path}: {lost:.3g} nm rms of the surface's change are finer than its grid and not carried; "
                "give the nodes of the clear aperture alone, or fewer"
            )
    return tuple(out)
