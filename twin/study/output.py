"""Files of a finished study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from twin.data_file import netcdf
from twin.reference_frames import described
from twin.run_folder import MANIFEST
from twin.study.block_result import BlockResult
from twin.study.dataset import make_dataset, parquet, summary, table
from twin.study.folder import PROGRAM, StudyFolder
from twin.study.plan import Plan
from twin.study.report import write_report
from twin.versions import versions


@dataclass(frozen=True)
class StudyFacts:
    """How a study was run; the only things in its folder that are not the same each time.

    Attributes:
        backend: where it was traced.
        started: seconds since the epoch.
        seconds: that this command took for the runs it computed.
        computed: number of these.
        workers: processes.
        warnings: what the user was told.
    """

    backend: str
    started: float
    seconds: float
    computed: int
    workers: int
    warnings: tuple[str, ...]


def write_study(plan: Plan, result: BlockResult, facts: StudyFacts, folder: StudyFolder) -> dict[str, Any]:
    """Write study.nc, study.csv, study.parquet, study.json, report.html and, last, the manifest.

    Returns:
        Contents of study.json.
    """
    data = make_dataset(plan, result)
    numbers = described(
        "study",
        {
            **summary(data, plan),
            "seconds": facts.seconds,
            "runs_computed": facts.computed,
            "states_per_second": facts.computed / facts.seconds if facts.computed else None,
            "worker_seconds": result.seconds,
        },
    )
    (folder.path / MANIFEST).unlink(missing_ok=True)
    folder.write("config.yaml", plan.setup.to_yaml().encode())
    folder.write("study.nc", netcdf(data))
    folder.write("study.csv", table(data))
    content = parquet(data)
    if content is not None:
        folder.write("study.parquet", content)
    folder.write_json("study.json", numbers)
    write_report(data, plan, folder.path)
    manifest = {
        "program": PROGRAM,
        "versions": versions(),
        "backend": facts.backend,
        "seed": plan.setup.study.design.seed,
        "runs": plan.runs,
        "failed": int(result.failed.sum()),
        "started_unix_s": facts.started,
        "wall_time_s": facts.seconds,
        "workers": facts.workers,
        "warnings": list(facts.warnings),
        "sha256": folder.checksums(),
    }
    folder.write_json(MANIFEST, manifest)
    return numbers
