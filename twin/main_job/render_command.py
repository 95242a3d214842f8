"""The command ``python -m twin.render`` after its job is read: compute, write the run folder, print the result."""

from __future__ import annotations

from functools import partial
from typing import Any

from rich.console import Console

from optics.numerics.backend import one_blas_thread
from scenes.specs.course import moment
from scenes.specs.resolved import ResolvedJob
from twin.framework.command import Result, print_report
from twin.framework.procedure import Session
from twin.framework.record import described
from twin.framework.report import Report
from twin.framework.second_process import SecondProcess
from twin.main_job.render_folder import begin_drawing, load_drawing, write_run
from twin.main_job.render_job import render_job
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.result_sections import glance_table, result_tables
from twin.main_job.systematics import assumed
from twin.main_job.verdict import judge, recovered_numbers
from twin.monitor.image_quality import QUALITY


def run_render(resolved: ResolvedJob, session: Session, frames: int | None, seed: int | None, picture: bool) -> Result:
    """Compute a job and write its run folder.

    Parameters
    ----------
    resolved : ResolvedJob
        Job with the contents of all files that it refers to.
    session : Session
        Session of the running command.
    frames : int or None
        Number of frames of each state; None for the job's number.
    seed : int or None
        Seed of all noise; None for the job's seed.
    picture : bool
        Also render pictures of the instrument.

    Raises
    ------
    InputError
        The job's perturbation or its targets are not possible.
    """
    # a second thread of linear algebra would compete with the second process for a core
    with SecondProcess(load_drawing) as beside, one_blas_thread():
        begin = partial(begin_drawing, beside)
        run = render_job(resolved, session.backend, frames, seed, session.advance, placed=begin)
        problem = write_run(run, session, picture, beside)
    return Result(_numbers(run), lambda console: _print_result(run, console), problem)


def _numbers(run: JobRun) -> dict[str, Any]:
    """Return the data that ``--json`` prints: kind of file (truth, recovered, ...) -> contents of that JSON file."""
    parts = {"truth": run.truth_dict()}
    if isinstance(run, RenderRun):
        parts["recovered"] = recovered_numbers(run)
        if run.series is not None:
            parts["course"] = run.series.to_dict()
    elif run.quality is not None:
        parts["quality"] = QUALITY(run.quality)
    if run.targets is not None:
        parts["mtf"] = run.targets.to_dict()
    judgement = judge(run)
    texts = {"verdict": judgement.verdict, "warnings": list(judgement.warnings)}
    return {**{kind: described(kind, data) for kind, data in parts.items()}, **texts}


def _print_result(run: JobRun, console: Console) -> None:
    """Print verdict, warnings and the table that the page begins with."""
    judgement, summary, more = judge(run), result_tables(run)[0], []
    if isinstance(run, RenderRun):
        summary, more = glance_table(run), [f"{assumed(run.reading)}."]
        if run.series is not None:
            ends = " to ".join(moment(float(run.series.times[k])) for k in (0, -1))
            more += [f"All {len(run.series.times)} times from {ends} are in course.json, course.nc and the report."]
    title = f"{run.resolved.instrument.name}, {run.frames} frames, seed {run.seed}: {summary.title}"
    report = Report(title, judgement.verdict, (*judgement.more, *more), (), summary, (), warnings=judgement.warnings)
    print_report(report, console)
