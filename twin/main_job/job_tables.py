"""Tables that a job names: where its run keeps them, so that config.yaml repeats it without them, and what those of
displaced nodes were found to be.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import PurePath
from typing import Any

from optics.numerics.number_tree import FrozenMap
from optics.thermal.nodal_deformation import PRINTED, SEEN, NodalDeformation
from scenes.models.job_state import HeatedBody, HeatedFace
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import FinishTableSpec
from scenes.specs.resolved import ResolvedJob
from twin.framework.quantity import Quantity, Record
from twin.main_job.render_results import JobRun


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


def faces_of(run: JobRun) -> Mapping[str, NodalDeformation]:
    """Body -> what its table is."""
    return run.experiment.deformed(run.resolved.job)


def heated_of(run: JobRun) -> Mapping[str, HeatedBody]:
    """Body -> what its table of temperatures is.

    Args:
        run: of the job.
    """
    return run.experiment.heated(run.resolved.job)


BENT: Record[NodalDeformation] = Record(
    "What a table of displaced nodes was found to be.",
    Quantity("nodes", lambda face: len(face.weight), "nodes on the optical surface"),
    Quantity("nodes_not_used", lambda face: face.others, "nodes off the optical surface"),
    Quantity("spacing_mm", lambda face: face.spacing, "distance of neighbouring nodes"),
    Quantity("rotate_arcsec", lambda face: face.rotate, "rigid rotation about X, Y and Z"),
    Quantity("shift_um", lambda face: face.shift, "rigid shift along X, Y and Z"),
    Quantity("growth_ppm", lambda face: face.growth, "relative growth"),
    Quantity("change_rms_nm", lambda face: face.rms(face.change), "change of sag beyond rigid motion and growth"),
    Quantity("change_pv_nm", lambda face: face.range(face.change), "peak to valley of that change"),
    Quantity("figure_nm", lambda face: {f"Z{j}": a for j, a in face.figure.items()}, "Zernike terms of the change"),
    Quantity("residual_rms_nm", lambda face: face.rms(face.residual), "what the Zernike terms leave"),
    Quantity("residual_pv_nm", lambda face: face.range(face.residual), "peak to valley of what they leave"),
    Quantity("not_carried_rms_nm", lambda face: face.rms(face.lost), "what the grid of the rest does not carry"),
    Quantity("between_nodes_rms_nm", lambda face: face.between, "error of nodes that are foretold by the others"),
    Quantity(
        "mesh_prints_through", lambda face: face.printed_through, "whether what is left changes from node to node"
    ),
)
_WARMED_FACE: Record[HeatedFace] = Record(
    "What temperatures that are not linear do to an optical face, in its own nominal axes.",
    Quantity("rotate_arcsec", lambda face: face.motion.rotate, "rotation about X, Y and Z"),
    Quantity("shift_nm", lambda face: face.motion.shift, "shift along X, Y and Z"),
    Quantity("growth_ppm", lambda face: face.motion.stretch, "relative growth"),
    Quantity("figure_nm", lambda face: {f"Z{j}": a for j, a in face.motion.figure.items()}, "Zernike terms of its sag"),
    Quantity("not_carried_rms_nm", lambda face: face.lost, "what the Zernike terms do not carry"),
    Quantity("coarser_elements_rms_nm", lambda face: face.unmeshed, "by how much coarser finite elements differ"),
)
WARMED: Record[HeatedBody] = Record(
    "What a table of temperatures was found to be.",
    Quantity("nodes", lambda body: body.nodes, "nodes of the table"),
    Quantity("spacing_mm", lambda body: body.spacing, "distance of neighbouring nodes"),
    Quantity("linear_change_k", lambda body: body.linear.change, "change at the body's origin of the linear field"),
    Quantity("linear_gradient_k_per_m", lambda body: body.linear.gradient, "gradient of the linear field"),
    Quantity("not_linear_rms_k", lambda body: body.left[0], "what the linear field leaves, RMS over the volume"),
    Quantity("not_linear_largest_k", lambda body: body.left[1], "what it leaves at most"),
    Quantity("between_nodes_rms_k", lambda body: body.between, "error of nodes that are foretold by the others"),
    Quantity(
        "outside_share",
        lambda body: None if body.coverage is None else body.coverage.outside,
        "share of the body's volume beyond the nodes",
    ),
    Quantity(
        "farthest_mm",
        lambda body: None if body.coverage is None else body.coverage.farthest,
        "largest distance of the body from any node",
    ),
    Quantity("index_path_not_carried_nm", lambda body: body.index_path, "optical path that no linear index carries"),
    Quantity("faces", lambda body: body.faces, "its optical faces", record=_WARMED_FACE),
)


def table_numbers(run: JobRun, kind: str) -> dict[str, Any]:
    """Contents of deformation.json or temperature.json.

    Args:
        run: of the job.
        kind: what its tables hold, ``deformation`` or ``temperature``.
    """
    names = table_names(run.resolved.job)
    found = (
        {path: BENT(face) for path, face in faces_of(run).items()}
        if kind == "deformation"
        else {path: WARMED(body) for path, body in heated_of(run).items()}
    )
    return {"bodies": {path: {"table": names[path, kind], **numbers} for path, numbers in found.items()}}


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
