"""Implementation of ``python -m twin.study``: run a study and write its folder."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from scenes.yaml.standard_output import BAD_INPUT, print_error
from twin.framework import cli, cluster, memory, provenance
from twin.framework.command import Result
from twin.framework.procedure import WRITE, Session
from twin.framework.run_folder import write_manifest
from twin.study.runs.blocks import BLOCKS, Engine, journal_of
from twin.study.runs.plan import Plan, require_study_memory, run_count
from twin.study.runs.setup import PROGRAM, StudySetup, base_of

START = "start the workers and do the first runs"
"""Name of the first stage in the progress display."""


def check_size(setup: StudySetup, confirmed: bool) -> None:
    """Raise InputError if a study has more runs than its limit allows or than fit in memory.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    confirmed : bool
        True if the user has confirmed that the limit may be exceeded.

    Raises
    ------
    InputError
        The study has too many runs, or their results do not fit in memory.
    """
    limit, runs = setup.study.limits.runs, run_count(setup.study)
    if runs > limit and not confirmed:
        raise setup.error(
            f"the study has {runs} runs, more than its limit of {limit}",
            ("limits", "runs"),
            allowed="a larger limit, or the option --yes",
        )
    require_study_memory(setup)


def run_study(
    setup: StudySetup,
    session: Session,
    store: Path,
    chosen: tuple[int | None, str | None],
    notify: Callable[[str], None],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Result:
    """Run the missing runs of a study and write its run folder.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    session : Session
        Session of the command.
    store : Path
        Folder in which finished blocks of runs are stored.
    chosen : tuple
        Number of local processes (None: one per core), and address of a running cluster (None: none).
    notify : callable
        Function that receives the estimate of the computing time.
    progress : callable
        Function that receives the numbers of finished and of all runs.

    Raises
    ------
    InputError, InputErrorText, RunFolderError
        The input is invalid.
    Incomplete
        Not all runs could be done.
    """
    plan, base, folder = Plan.of(setup), base_of(setup), session.folder
    errors, warnings = Console(stderr=True), list[str]()

    def warn(*texts: str) -> None:
        for text in texts:
            warnings.append(text)
            errors.print(f"warning: {text}", style="yellow", markup=False, soft_wrap=True)

    def advance(done: int, total: int) -> None:
        session.advance("runs", done, total)
        progress(done, total)

    # imported late, so that errors in a study's file are reported quickly
    from scenes.models.camera_sharpness import blur_warnings, cameras_of
    from twin.sensors.area_detector import coarse_warnings

    session.advance(START, 0, 1)
    with journal_of(setup, store / BLOCKS) as journal:
        engine = Engine(plan, journal, session.backend.name, advance, notify, warn)
        input_warnings = blur_warnings(base, session.backend) if cameras_of(base) else ()
        input_warnings = (*input_warnings, *coarse_warnings(base))
        warn(*input_warnings)
        count = 0
        if engine.missing:
            with cluster.chosen_workers(*chosen, warn, setup.study.limits) as workers:
                engine.run(workers, memory.largest_memory())
                count = workers.count
        advance(plan.runs, plan.runs)
        result = engine.result()
    session.advance(WRITE, 0, 1)
    # nor are drawing libraries and the like
    from twin.study.report.study_report import write_report
    from twin.study.report.study_statistics import StudyRuns, impossible_noise
    from twin.study.study_files import write_data

    numbers = write_data(plan, result, engine.seconds, engine.computed, folder)
    folder.write_bytes(BLOCKS, (store / BLOCKS).read_bytes())
    report = write_report(numbers.data, plan, folder, numbers.files, (*input_warnings, *numbers.unwritten))
    warn(*(text for text in report.warnings if text not in warnings))
    failed = int(result.failed.sum())
    entries: dict[str, Any] = {"backend": session.backend.name, "seed": setup.study.design.seed, "workers": count}
    entries |= {"runs": plan.runs, "failed": failed, "warnings": warnings, "inputs": provenance.inputs_in(setup.tree)}
    entries["again"] = [PROGRAM, "config.yaml", "--backend", session.backend.name, "--yes"]
    write_manifest(folder, PROGRAM, session.started, engine.seconds, **entries)
    missing = [*numbers.unwritten, *report.undrawn]
    if failed == plan.runs:
        missing.insert(0, f"all {failed} runs failed, see report.html")
    fault = impossible_noise(StudyRuns.of(numbers.data, setup.study))
    if fault is not None:  # everything is written: only what the file says of a response is wrong
        print_error(errors, str(fault))
    results = {**numbers.summary, "verdict": report.verdict, "warnings": warnings}
    return Result(
        results, lambda console: _show(results, console), "; ".join(missing), 0 if fault is None else BAD_INPUT
    )


def _show(numbers: dict[str, Any], console: Console) -> None:
    from twin.framework.artefact import cell_text, decimals_for, fixed, unit_for_reports

    table = cli.result_table(f"{numbers['name']}: {numbers['runs']} runs, {numbers['failed']} failed")
    for head in ("response", "unit", "mean", "std", "95%", "99.7%"):
        table.add_column(head, justify="left" if head in ("response", "unit") else "right", no_wrap=True)
    for name, r in numbers["responses"].items():
        # as many digits as the standard error of the mean justifies
        known = r["std"] is not None and r["std"] > 0.0
        decimals = decimals_for(r["std"] / math.sqrt(numbers["runs"])) if known else None
        values = (r[key] for key in ("mean", "std", "p95", "p997"))
        cells = (cell_text(v) if v is None or decimals is None else fixed(v, decimals) for v in values)
        table.add_row(name, unit_for_reports(r["unit"]), *cells)
    cli.print_verdict(console, numbers["verdict"], warned=bool(numbers["warnings"]))
    cli.print_whole(console, table)
