"""The report of a study: ``report.html``, the files it shows and ``statistics.json``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from scenes.specs.study import StudySpec
from twin.run.artefact import Artefact
from twin.run.page import artefact_content, environment, place, reproduce
from twin.run.versions import versions
from twin.study.report.conclusions import conclusions, design_title, verdict, warnings
from twin.study.report.study_analysis import StudyAnalysis, plain_data, summary
from twin.study.report.study_runs import StudyRuns
from twin.study.report.study_sections import factor_table, own_file, response_table, sections
from twin.study.runs.plan import Plan
from twin.study.runs.study_folder import PROGRAM

__all__ = ["summary", "write_report", "write_study_report"]

TEMPLATE = "study.html.j2"
STATISTICS = "statistics.json"
ARTEFACTS = "artefacts"


def write_report(data: xr.Dataset, plan: Plan, folder: Path, files: Sequence[str], given: Sequence[str] = ()) -> str:
    """Write ``report.html``, ``statistics.json`` and the folder ``artefacts`` into the study's folder.

    Args:
        data: as ``twin.study.study_files.make_dataset`` makes it.
        plan: the study; ``plan.setup.study.report`` says what is asked for.
        folder: of the study; it is complete but for the manifest, which is written afterwards.
        files: of the data set, in that folder.
        given: what is wrong with what the study is given, to be told before all else.

    Returns:
        The verdict that it begins with.
    """
    return write_study_report(data, plan.setup.study, folder, files, given)


def write_study_report(
    data: xr.Dataset,
    study: StudySpec,
    folder: Path,
    files: Sequence[str] = ("study.nc", "study.csv"),
    given: Sequence[str] = (),
) -> str:
    """As ``write_report``, for a study whose base is not at hand."""
    found = StudyAnalysis.of(StudyRuns.of(data, study))
    responses, factors = response_table(found), factor_table(found.runs)
    parts = sections(found)
    # what an earlier report showed may not be there any more
    shutil.rmtree(folder / ARTEFACTS, ignore_errors=True)
    (folder / ARTEFACTS).mkdir()
    for artefact in (responses, factors, *(a for section in parts for a in section.artefacts)):
        if own_file(artefact):
            (folder / place(artefact)).write_bytes(artefact.content())
    said = verdict(found)
    text = json.dumps({**plain_data(found), "verdict": said}, indent=2, allow_nan=False) + "\n"
    (folder / STATISTICS).write_text(text, encoding="utf-8")
    page = (
        environment(__package__)
        .get_template(TEMPLATE)
        .render(
            title=study.name,
            verdict=said,
            study=study,
            runs=found.runs,
            failed=int(found.runs.failed.sum()),
            design=design_title(found.runs.kind),
            warnings=[*given, *warnings(found)],
            conclusions=conclusions(found),
            responses=_shown(responses),
            factors=_shown(factors),
            sections=[
                {
                    "title": section.title,
                    "folded": section.folded,
                    "text": section.text,
                    "artefacts": [_shown(a) for a in section.artefacts],
                }
                for section in parts
            ],
            files=files,
            command=reproduce(PROGRAM, "config.yaml"),
            versions=versions(),
        )
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
    return said


def _shown(artefact: Artefact) -> dict[str, Any]:
    if artefact.name == "factors":
        return artefact_content(artefact, "config.yaml")
    return artefact_content(artefact, place(artefact) if own_file(artefact) else STATISTICS)
