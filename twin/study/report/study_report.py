"""The report of a study: ``report.html``, the files it shows and ``statistics.json``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import xarray as xr

from scenes.specs.study import StudySpec
from twin.run.artefact import Undrawn
from twin.run.owned_files import every_file
from twin.run.page import links, report_page
from twin.run.report import Report, Section
from twin.run.run_folder import json_text
from twin.study.report.conclusions import conclusions, design_title, verdict, warnings
from twin.study.report.study_analysis import StudyAnalysis, plain_data, summary
from twin.study.report.study_runs import StudyRuns
from twin.study.report.study_sections import STATISTICS, factor_table, response_table, sections
from twin.study.report.study_wording import plural
from twin.study.runs.plan import Plan
from twin.study.runs.study_folder import PROGRAM, StudyFolder

__all__ = ["report_files", "summary", "write_report"]

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
    said, runs = verdict(found), found.runs
    about = (
        f"{plural(runs.count, 'run')} of {study.base.command}, {int(runs.failed.sum())} of them failed; "
        f"{design_title(runs.kind)}, seed {study.design.seed}."
    )
    report = Report(
        study.name,
        said,
        (*([study.description] if study.description else ()), about),
        (),
        response_table(found),
        (Section("Factors", (), (factor_table(runs),)), *sections(found)),
        conclusions=tuple(conclusions(found)),
    )
    undrawn = tuple(artefact.note for artefact in report.artefacts if isinstance(artefact, Undrawn))
    report = replace(report, warnings=(*given, *undrawn, *warnings(found)))
    contents = {artefact.file: artefact.content() for artefact in report.artefacts if artefact.within is None}
    contents[STATISTICS] = json_text({**plain_data(found), "verdict": said}).encode()
    numbers = links((*files, "study.json", STATISTICS, "config.yaml"))
    contents["report.html"] = report_page(report, (PROGRAM, "config.yaml"), [("Numbers", numbers)]).encode()
    return StudyReport(said, contents, undrawn)
