"""Files of a validation's run folder."""

from __future__ import annotations

from twin.run_folder import MANIFEST, RunFolder
from twin.validation.report import render_report
from twin.validation.runner import Validation
from twin.versions import versions


def write_validation(validation: Validation, folder: RunFolder) -> None:
    """Write everything into an open run folder: validation.json, report.html, the groups' artefacts, the manifest."""
    for run in validation.runs:
        for artefact in run.artefacts:
            folder.write_bytes(run.place(artefact), artefact.content())
    folder.write_json("validation.json", validation.to_dict())
    folder.write_text("report.html", render_report(validation))
    manifest = {
        "program": "twin.validate",
        "versions": versions(),
        "backend": validation.backend,
        "seed": validation.seed,
        "only": validation.only,
        "started_unix_s": validation.started,
        "wall_time_s": validation.seconds,
        "sha256": folder.checksums(),
    }
    folder.write_json(MANIFEST, manifest)
