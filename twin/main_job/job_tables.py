"""Where a run keeps the tables that its job names, so that its config.yaml repeats it without them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import FinishTableSpec
from scenes.specs.resolved import ResolvedJob


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
