"""The command ``python -m twin.render`` after its job is read: compute, write the run folder, print the result."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from optics.numerics.backend import one_blas_thread
from scenes.specs.course import moment
from scenes.specs.resolved import ResolvedJob
from twin.framework.artefact import decimals_for, fixed, residual_text
from twin.framework.cli import print_verdict, print_whole, result_table
from twin.framework.command import Result, print_warnings
from twin.framework.procedure import Session
from twin.framework.reference_frames import described
from twin.framework.second_process import SecondProcess
from twin.main_job.render_folder import begin_drawing, load_drawing, write_run
from twin.main_job.render_job import render_job
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.systematics import assumed
from twin.main_job.verdict import judge, recovered_numbers
from twin.monitor.image_quality import AT_FIELDS, POSITIONS, QUALITY
from twin.targets.target_images import DIRECTIONS
from twin.targets.target_images import POSITIONS as TARGET_POSITIONS
from twin.targets.target_measurement import TargetRun

_DASH = "\N{EM DASH}"
NUMBER = 7
"""Width of most number columns in the terminal's table, in characters."""
_WIDE = 90
"""Smallest terminal width, in characters, at which the table also shows the part of sigma due to noise."""

_ALONG = dict(zip(DIRECTIONS, ("along line", "along track"), strict=True))
"""Direction of the MTF -> its name in the terminal."""


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
    """Print the verdict, the table of results, notes and warnings of a run."""
    judgement = judge(run)
    print_verdict(console, judgement.verdict, warned=bool(judgement.warnings))
    remarks = list(judgement.more)
    if isinstance(run, RenderRun):
        print_whole(console, _table(run, console.width >= _WIDE))
        remarks.append(f"{assumed(run.reading)}.")
    else:
        print_whole(console, _changes(run))
    for line in remarks:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if run.targets is not None:
        lines = _mtf_table(run.targets)
        if lines is not None:
            console.print(lines)
    if isinstance(run, RenderRun) and run.series is not None:
        count, ends = len(run.series.times), [moment(float(run.series.times[k])) for k in (0, -1)]
        console.print(
            f"course: {count} times from {ends[0]} to {ends[1]} are in course.json, course.nc and the report.",
            highlight=False,
        )
    print_warnings(console, judgement.warnings)


def _mtf_table(targets: TargetRun) -> Table | None:
    """Return the table of MTF at Nyquist from the knife edges, before -> after (true); None if there are none."""
    title = f"MTF with the pixel at Nyquist from the knife edge ({targets.frames} frames)"
    title += "\nbefore -> after, true values below"
    table = result_table(title)
    for head in ("", *TARGET_POSITIONS):
        table.add_column(head, no_wrap=True)
    for name, camera in targets.cameras.items():
        for direction in DIRECTIONS:
            pairs = [
                (measured.before.edges[direction], measured.after.edges[direction])
                for measured in camera.places.values()
                if direction in measured.before.edges
            ]
            if not pairs:
                return None
            cells = [
                f"{' -> '.join('none' if edge.nyquist is None else f'{edge.nyquist[0]:.3f}' for edge in pair)}\n"
                f"[dim]{' -> '.join(f'{edge.true_nyquist:.3f}' for edge in pair)}[/]"
                for pair in pairs
            ]
            table.add_row(f"[bold]{escape(name)}[/] {escape(camera.band)}, {_ALONG[direction]}", *cells)
    return table


def _head(name: str) -> str:
    """Return an estimator's name, broken into lines where it is wider than the numbers below it."""
    words = [
        word if len(word) <= NUMBER else f"{word[: NUMBER - 2]}-\n{word[NUMBER - 2 :]}" for word in name.split("_")
    ]
    return "\n".join(words)


def _changes(run: JobRun) -> Table:
    """Return the table of true changes, wavefront error and MTF of an instrument without a monitor."""
    table = result_table(f"{run.resolved.instrument.name}: what changes, by exact tracing")
    for head in ("", "change"):
        table.add_column(head, justify="right" if head else "left", no_wrap=True)
    group = ""
    for of, parameter, value in run.true_changes():
        if of != group:
            group = of
            table.add_row(f"[bold]{escape(group)}[/]")
        table.add_row(escape(parameter.label), fixed(value, parameter.decimals, sign=True))
    if run.quality is None:
        return table
    for name, camera in run.quality.cameras.items():
        table.add_row(f"[bold]{escape(name)}[/], left / centre / right", "before -> after")
        for quantity in (AT_FIELDS[key] for key in ("wfe_rms_waves", "mtf_along_line", "mtf_along_track")):
            before, after = quantity.value(camera)
            field_indices = [run.quality.fields.index(field) for field in POSITIONS.values()]
            table.add_row(
                escape(quantity.shown_head), " / ".join(f"{before[k]:.4f} -> {after[k]:.4f}" for k in field_indices)
            )
    return table


def _table(run: RenderRun, wide: bool) -> Table:
    """Return the table of the changes by every estimator beside the true changes, with sigma and error.

    Sigma and error are those of the estimator that the verdict uses.
    """
    title = f"{run.resolved.instrument.name}: recovered from the images ({run.frames} frames, seed {run.seed})"
    if run.series is not None:
        title += f"\nat {moment(float(run.series.times[run.series.shown]))} of the course"
    table = result_table(title)
    table.padding, table.show_edge = 0, False  # for 80 columns
    table.add_column("", no_wrap=True)
    judged = run.judged
    sigmas = ["σ", "σ of\nnoise"] if wide else ["σ"]
    for head in ("true", *map(_head, run.estimators), *sigmas, "error", "in σ"):
        table.add_column(head, justify="right", no_wrap=True)

    group = ""
    for rows in run.reading.table.by_change():
        judged_row = next(row for row in rows if row.estimator == judged)
        if judged_row.where != group:
            group = judged_row.where
            table.add_row(f"[bold]{escape(group)}[/]")
        finest = min((row.sigma for row in rows if row.sigma > 0.0), default=0.0)
        cells = [
            fixed(judged_row.true, decimals_for(finest)),
            *(_DASH if math.isnan(row.value) else row.shown(row.value) for row in rows),
            judged_row.shown(judged_row.sigma),
            *([fixed(judged_row.noise, decimals_for(judged_row.noise))] if wide else []),
            judged_row.shown(judged_row.error, sign=True),
            residual_text(judged_row.ratio),
        ]
        if math.isnan(judged_row.sigma):
            cells[-2:] = [_DASH, _DASH]
        table.add_row(escape(judged_row.parameter.label), *cells)
    return table
