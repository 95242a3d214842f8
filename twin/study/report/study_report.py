"""The report of a study: ``report.html``, the files it shows and ``statistics.json``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import xarray as xr

from scenes.specs.study import StudySpec
from twin.run.artefact import Artefact, Undrawn
from twin.run.owned_files import every_file
from twin.run.page import artefact_content, environment, place, reproduce
from twin.run.run_folder import json_text
from twin.run.versions import versions
from twin.study.report.conclusions import conclusions, design_title, verdict, warnings
from twin.study.report.study_analysis import StudyAnalysis, plain_data, summary
from twin.study.report.study_runs import StudyRuns
from twin.study.report.study_sections import factor_table, own_file, response_table, sections
from twin.study.runs.plan import Plan
from twin.study.runs.study_folder import PROGRAM, StudyFolder

__all__ = ["report_files", "summary", "write_report"]

TEMPLATE = "study.html.j2"
STATISTICS = "statistics.json"
ARTEFACTS = "artefacts"


@dataclass(frozen=True, eq=False)
class StudyReport:
    """A report.

    Attributes:
        verdict: that it begins with.
        contents: of its files, by their paths in the study's folder.
        undrawn: what could not be drawn, a sentence each.
    """

    verdict: str
    contents: dict[str, bytes]
    undrawn: tuple[str, ...]


def write_report(
    data: xr.Dataset, plan: Plan, folder: StudyFolder, files: Sequence[str], given: Sequence[str] = ()
) -> StudyReport:
    """Write ``report.html``, ``statistics.json`` and the folder ``artefacts`` into the study's folder.

    Args:
        data: as ``twin.study.study_files.make_dataset`` makes it.
        plan: the study; ``plan.setup.study.report`` says what is asked for.
        folder: of the study; it is complete but for the manifest, which is written afterwards.
        files: of the data set, in that folder.
        given: what is wrong with what the study is given, to be told before all else.

    Returns:
        The verdict that it begins with, and what could not be drawn.
    """
    made = report_files(data, plan.setup.study, files, given)
    contents = made.contents
    # what an earlier report showed may not be there any more
    there = [name for name in every_file(folder.path) if name.split("/")[0] == ARTEFACTS and name not in contents]
    folder.remove(there)
    folder.write_all(contents)
    return made


def report_files(
    data: xr.Dataset,
    study: StudySpec,
    files: Sequence[str] = ("study.nc", "study.csv"),
    given: Sequence[str] = (),
) -> StudyReport:
    """The report with all its files; arguments as of ``write_report``."""
    found = StudyAnalysis.of(StudyRuns.of(data, study))
    responses, factors = response_table(found), factor_table(found.runs)
    parts = sections(found)
    shown = (responses, factors, *(a for section in parts for a in section.artefacts))
    undrawn = tuple(artefact.note for artefact in shown if isinstance(artefact, Undrawn))
    contents = {place(artefact): artefact.content() for artefact in shown if own_file(artefact)}
    said = verdict(found)
    contents[STATISTICS] = json_text({**plain_data(found), "verdict": said}).encode()
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
            warnings=[*given, *undrawn, *warnings(found)],
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
            command=reproduce((PROGRAM, "config.yaml")),
            versions=versions(),
        )
    )
    contents["report.html"] = page.encode()
    return StudyReport(said, contents, undrawn)


def _shown(artefact: Artefact) -> dict[str, Any]:
    if artefact.name == "factors":
        return artefact_content(artefact, "config.yaml")
    return artefact_content(artefact, place(artefact) if own_file(artefact) else STATISTICS)
