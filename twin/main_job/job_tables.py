"""Tables that a job names: where its run keeps them, so that config.yaml repeats it without them, and what those of
displaced nodes were found to be.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import PurePath
from typing import Any

from analysis.units import ARCSEC
from optics.numerics.frozen_map import FrozenMap
from optics.thermal.nodal_deformation import PRINTED, SEEN, NodalDeformation
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import FinishTableSpec
from scenes.specs.resolved import ResolvedJob
from twin.main_job.render_results import RenderRun


def table_names(job: JobSpec) -> Mapping[tuple[str, str], str]:
    """Body and what a table does to it, a key of its perturbation -> name of the table in the run folder."""
    named = {
        (path, kind): spec.table
        for path, what in job.perturb.items()
        for kind, spec in (("deformation", what.deformation), ("temperature", what.temperature))
        if spec is not None and spec.table is not None
    }
    return FrozenMap(
        {
            (path, kind): f"{kind}/{path.replace('/', '_')}{PurePath(table).suffix.lower()}"
            for (path, kind), table in named.items()
        }
    )


def finish_tables(job: JobSpec) -> Mapping[tuple[str, str], FinishTableSpec]:
    """Kind of surface and what is measured of it -> table, of a job's stray light."""
    stray = job.render.stray
    return FrozenMap({} if stray is None or stray.finishes is None else stray.finishes.tables)


def finish_names(job: JobSpec) -> Mapping[tuple[str, str], str]:
    """Kind of surface and what is measured of it -> name of the table in the run folder."""
    tables = finish_tables(job).items()
    return FrozenMap(
        {(kind, what): f"finish/{kind}_{what}{PurePath(t.table).suffix.lower()}" for (kind, what), t in tables}
    )


def config_text(resolved: ResolvedJob) -> str:
    """Text of the run folder's config.yaml, which names the tables beside it."""
    names, finishes = table_names(resolved.job), finish_names(resolved.job)
    if not names and not finishes:
        return resolved.to_yaml()
    perturb = dict(resolved.job.perturb)
    for (path, kind), name in names.items():
        moved = getattr(perturb[path], kind).model_copy(update={"table": name})
        perturb[path] = perturb[path].model_copy(update={kind: moved})
    render = resolved.job.render
    if finishes and render.stray is not None and render.stray.finishes is not None:
        given = finish_tables(resolved.job)
        tables = {key: given[key].model_copy(update={"table": name}) for key, name in finishes.items()}
        stray = render.stray.model_copy(update={"finishes": render.stray.finishes.with_tables(tables)})
        render = render.model_copy(update={"stray": stray})
    job = resolved.job.model_copy(update={"perturb": FrozenMap(perturb), "render": render})
    return resolved.model_copy(update={"job": job}).to_yaml()


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
