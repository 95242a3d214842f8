"""Files of a validation's run folder."""

from __future__ import annotations

from twin.run_folder import MANIFEST, RunFolder
from twin.validation.report import render_report
from twin.validation.runner import Validation
from twin.validation.summary import SUMMARY, summary_files
from twin.versions import versions


def write_validation(validation: Validation, folder: RunFolder) -> None:
    """Write validation.json, validation.html, summary/, the groups' artefacts and the manifest."""
    for run in validation.runs:
        for artefact in run.artefacts:
            folder.write_bytes(run.place(artefact), artefact.content())
    folder.write_json("validation.json", validation.to_dict())
    folder.write_text("validation.html", render_report(validation))
    for name, content in summary_files(validation).items():
        folder.write_bytes(f"{SUMMARY}/{name}", content)
    manifest = {
        "program": "twin.validate",
        "versions": versions(),
        "backend": validation.backend,
        "seed": validation.seed,
        "only": validation.only,
        "fast": validation.fast,
        "started_unix_s": validation.started,
        "wall_time_s": validation.seconds,
        "sha256": folder.checksums(),
    }
    folder.write_json(MANIFEST, manifest)
