"""Execution of the selected groups of checks; one that fails is reported and does not stop the others."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from optics.numerics.backend import Backend
from twin.framework.artefact import Artefact
from twin.framework.provenance import versions
from twin.validation.check import SKIPPED, VERDICTS, CheckResult, Verdict
from twin.validation.group import CheckGroup, Context
from twin.validation.registry import Selection

SCHEMA = "space-camera-twin/validation"
SCHEMA_VERSION = 2
"""Version of validation.json; it rises when a key changes its meaning or is removed."""

FILES = "artefacts"
"""Folder of the groups' figures, tables and data in the run folder; each group has a subfolder named by its prefix."""

Progress = Callable[[float, str], None]
"""Function that is called with the finished work, in estimated seconds out of ``rough_seconds``, and its name."""


@dataclass(frozen=True, eq=False)
class GroupRun:
    """Results of one group of checks.

    Attributes
    ----------
    group : CheckGroup
        Group that was run.
    results : tuple of CheckResult
        Results in the order of the group's checks.
    artefacts : tuple of Artefact
        Figures and tables for the report.
    seconds : float
        Computing time.
    files : tuple of str
        Files that the group wrote itself, relative to the run folder.
    """

    group: CheckGroup
    results: tuple[CheckResult, ...]
    artefacts: tuple[Artefact, ...]
    seconds: float
    files: tuple[str, ...] = ()

    def path_of(self, artefact: Artefact) -> str:
        """Return the path, in the run folder, of a figure, table or data file of the group."""
        return f"{FILES}/{self.group.prefix}/{artefact.name}.{artefact.kind}"


@dataclass(frozen=True, eq=False)
class Validation:
    """Results of a validation.

    Attributes
    ----------
    runs : tuple of GroupRun
        Results group by group.
    backend : str
        Backend of the ray trace.
    seed : int
        Seed of all noise.
    only : str or None
        Selection as the user gave it; None for all checks.
    fast : bool
        True for fewer trials.
    started : float
        Time of the start, in seconds since the epoch.
    seconds : float
        Computing time.
    written : bool
        True if the results go into a run folder.
    """

    runs: tuple[GroupRun, ...]
    backend: str
    seed: int
    only: str | None
    started: float
    seconds: float
    fast: bool = False
    written: bool = False

    @property
    def results(self) -> tuple[CheckResult, ...]:
        """All results, sorted by paper and then in the order of the groups."""
        return tuple(sorted((r for run in self.runs for r in run.results), key=lambda r: r.paper))

    @property
    def counts(self) -> dict[Verdict, int]:
        """Number of checks with each verdict."""
        return {verdict: sum(r.verdict == verdict for r in self.results) for verdict in VERDICTS}

    @property
    def unexpected(self) -> tuple[tuple[CheckResult, Verdict], ...]:
        """Results whose verdict differs from the expected one, and the expected verdict, failed checks included."""
        expected = {check.id: check.expected for run in self.runs for check in run.group.checks}
        results = (r for r in self.results if r.verdict != SKIPPED)
        return tuple((r, expected[r.id]) for r in results if r.verdict != expected[r.id])

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for validation.json."""
        return {
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "checks": [result.to_dict() for result in self.results],
            "counts": dict(self.counts),
            "verdicts": dict(VERDICTS),
            "unexpected": [
                {"id": result.id, "verdict": result.verdict, "expected": expected}
                for result, expected in self.unexpected
            ],
            "groups": [
                {
                    "prefix": run.group.prefix,
                    "title": run.group.title,
                    "seconds": run.seconds,
                    "artefacts": [
                        {"name": a.name, "title": a.title, "file": run.path_of(a) if self.written else None}
                        for a in run.artefacts
                    ],
                    "files": list(run.files),
                }
                for run in self.runs
            ],
            "only": self.only,
            "fast": self.fast,
            "seed": self.seed,
            "backend": self.backend,
            "versions": versions(),
            "started_unix_s": self.started,
            "wall_time_s": self.seconds,
        }


def rough_seconds(selections: Sequence[Selection], fast: bool = False) -> float:
    """Return the estimated computing time of groups, in seconds."""
    return sum(selection.group.rough_seconds(fast) for selection in selections)


def run_checks(
    selections: Sequence[Selection],
    backend: Backend,
    seed: int,
    only: str | None = None,
    fast: bool = False,
    progress: Progress = lambda done, text: None,
    folder: Path | None = None,
    real: Path = Path(),
) -> Validation:
    """Run groups of checks one after the other.

    Parameters
    ----------
    selections : sequence of Selection
        Groups with the ids to be checked.
    backend : Backend
        Backend of the ray trace.
    seed : int
        Seed of all noise.
    only : str or None
        Selection as the user gave it, kept in the results.
    fast : bool
        True for fewer trials, as in continuous integration.
    progress : Progress
        Called whenever a group advances.
    folder : Path or None
        Open run folder; None if nothing is written.
    real : Path
        Folder of the measured data of others.

    Returns
    -------
    Validation
        Results of all groups.
    """
    started, clock = time.time(), time.monotonic()
    context_of = partial(Context, backend, seed, fast=fast, real=real, experiments={})
    runs = []
    done = 0.0
    for selection in selections:
        seconds = selection.group.rough_seconds(fast)
        advance = partial(_advance, progress, done, selection.group, seconds)
        runs.append(_run_group(selection, partial(context_of, report_progress=advance), advance, folder))
        done += seconds
    progress(done, "done")
    took = time.monotonic() - clock
    return Validation(tuple(runs), backend.name, seed, only, started, took, fast, written=folder is not None)


def _advance(progress: Progress, start: float, group: CheckGroup, seconds: float, fraction: float, text: str) -> None:
    """Report how much of a group is done, as part of the progress of all groups."""
    progress(start + fraction * seconds, f"{group.prefix}: {text}")


def _run_group(
    selection: Selection, context_of: Callable[..., Context], advance: Progress, folder: Path | None
) -> GroupRun:
    group = selection.group
    group_folder = None if folder is None else folder / FILES / group.prefix
    if group_folder is not None:
        group_folder.mkdir(parents=True)
    checks = {check.id: check for check in group.checks}
    results_by_id = {name: checks[name].without_comparison() for name in selection.ids if checks[name].not_checkable}
    wanted = selection.ids - set(results_by_id)
    context = context_of(selected=wanted, checks=checks, folder=group_folder, texts=group.artefacts)
    begin = last = time.monotonic()
    why = "the group gave no result for it"
    advance(0.0, "start")
    try:
        for result in group.run(context) if wanted else ():
            now = time.monotonic()
            _keep(replace(result, seconds=now - last), results_by_id, group, wanted)
            last = now
    except Exception as error:
        why = _sentence(error)
        if wanted <= results_by_id.keys():  # raised after the last answer, which nothing else would show
            results_by_id.popitem()
    results = []
    for check in group.checks:
        if check.id in results_by_id:
            results.append(results_by_id[check.id])
        elif check.id in selection.ids:
            results.append(replace(check.failed(why), seconds=time.monotonic() - last))
            last = time.monotonic()
    files = _files(group_folder)
    return GroupRun(group, tuple(results), tuple(context.artefacts), time.monotonic() - begin, files)


def _keep(result: CheckResult, results: dict[str, CheckResult], group: CheckGroup, wanted: frozenset[str]) -> None:
    """Add the result of a check to the results of its group.

    Raises
    ------
    ValueError
        The group has no such check, or has already given a result for it.
    """
    if result.id not in group.ids:
        raise ValueError(f"the group {group.prefix} answered {result.id}, which it does not hold")
    if result.id in results:
        raise ValueError(f"the group {group.prefix} answered {result.id} twice")
    if result.id in wanted:
        results[result.id] = result


def _sentence(error: Exception) -> str:
    """Return the message of an error, with the line of code that raised it, for the report."""
    text = " ".join(str(error).split()) or "no message"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text} (in {frame.name}, {Path(frame.filename).name}:{frame.lineno})"


def _files(group_folder: Path | None) -> tuple[str, ...]:
    """Return the files that a group put into its folder, relative to the run folder; an empty folder is removed."""
    if group_folder is None:
        return ()
    files = tuple(
        sorted(p.relative_to(group_folder.parents[1]).as_posix() for p in group_folder.rglob("*") if p.is_file())
    )
    if not files:
        for folder in (group_folder, group_folder.parent):
            if not any(folder.iterdir()):
                folder.rmdir()
    return files
