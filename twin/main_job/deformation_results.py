"""What the tables of displaced nodes were found to be: numbers and warnings, and where a run keeps the tables."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import PurePath
from typing import Any

from analysis.units import ARCSEC
from optics.numerics.frozen_map import FrozenMap
from optics.thermal.nodal_deformation import PRINTED, SEEN, NodalDeformation
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob
from twin.main_job.render_results import RenderRun

FOLDER = "deformation"
"""In the run folder: the tables of the job, so that config.yaml there repeats the run."""


def faces_of(run: RenderRun) -> Mapping[str, NodalDeformation]:
    """Body -> what its table is."""
    return run.experiment.deformed(run.resolved.job)


def table_names(job: JobSpec) -> Mapping[str, str]:
    """Body -> name of its table in the run folder."""
    return FrozenMap(
        {
            path: f"{FOLDER}/{path.replace('/', '_')}{PurePath(what.deformation.table).suffix.lower()}"
            for path, what in job.perturb.items()
            if what.deformation is not None
        }
    )


def config_text(resolved: ResolvedJob) -> str:
    """Text of the run folder's config.yaml, which names the tables beside it."""
    names = table_names(resolved.job)
    if not names:
        return resolved.to_yaml()
    perturb = dict(resolved.job.perturb)
    for path, name in names.items():
        spec = perturb[path].deformation
        assert spec is not None
        moved = spec.model_copy(update={"table": name})
        perturb[path] = perturb[path].model_copy(update={"deformation": moved})
    job = resolved.job.model_copy(update={"perturb": FrozenMap(perturb)})
    return resolved.model_copy(update={"job": job}).to_yaml()


def deformation_numbers(run: RenderRun) -> dict[str, Any]:
    """Contents of deformation.json."""
    names = table_names(run.resolved.job)
    return {"bodies": {path: {"table": names[path], **_numbers(face)} for path, face in faces_of(run).items()}}


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
