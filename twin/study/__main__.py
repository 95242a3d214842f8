"""Command line program ``python -m twin.study``: design trade studies."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from os.path import isfile
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from scenes.specs.file_kinds import read_for
from twin.framework import cli
from twin.framework.command import Result, run_command

if TYPE_CHECKING:  # help waits for nothing that computes
    from twin.framework.procedure import Session
    from twin.study.runs.setup import StudySetup

app = cli.program()


@app.command()
@cli.with_options("out", "seed", "export", "quiet")
def main(
    file: Annotated[Path, typer.Argument(readable=False, help="YAML file of the study, or the config.yaml of one.")],
    options: cli.Options,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", readable=False, help="Folder of the study. Default: runs/STUDY-001, -002, ..."),
    ] = None,
    workers: cli.Workers = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Use a running Dask cluster, tls://host:8786 or tcp://host:8786. Its workers need the twin installed. "
            "Over tcp:// everybody who reaches its ports can run programs there: use it in a network of your own only. "
            "For tls:// name the certificates to scheduler, workers and this command by DASK_DISTRIBUTED__COMM__TLS "
            "variables, see docs/studies.md."
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in the folder --out.")] = False,
    gradient: Annotated[
        bool,
        typer.Option("--gradient", help="Differentiate the responses by the factors at the base, instead of the runs."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Run more runs than the study's limit.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors and warnings.")] = False,
    progress_fd: Annotated[int | None, typer.Option("--progress-fd", hidden=True, min=3)] = None,
) -> None:
    """Run a job many times with varied values and keep the responses.

    The study's file names a base job (render, lab ..., orbit ...), the factors that vary in it, a design and the
    responses that are kept; scenes/examples/study_smoke.yaml is a small one.

    The folder gets study.nc (netCDF, one dimension `run`), study.csv, study.json, report.html and config.yaml, which
    can be given in place of the file. The results do not depend on the number of workers.

    During the study, finished runs are kept in OUT.blocks beside it. After an interruption, by Ctrl-C or a power
    failure, the same command with --resume continues it. With --force the folder to be replaced is kept until the new
    study is complete.

    With --gradient no design is run: the folder gets the Jacobian at the base's values, gradient.json and gradient.csv,
    by automatic differentiation and, for comparison, by finite differences.

    Examples: `python -m twin.study scenes/examples/study_smoke.yaml --workers 2` and `python -m twin.study
    scenes/examples/study_smoke.yaml --gradient`

    Exit codes: 0 success, 2 bad input (nothing is lost), 129, 130 or 143 interrupted, 1 anything else: all runs failed,
    the program did, or a figure could not be drawn.
    """
    errors = Console(stderr=True)
    options = replace(options, out=out, quiet=quiet)
    if gradient:
        _refuse_with_gradient(
            errors, {"--workers": workers, "--scheduler": scheduler, "--resume": resume or None, "--yes": yes or None}
        )
        # drawing libraries are not needed before
        from twin.study.gradient.gradient_report import run_gradient

        run_gradient(file, options)
        return
    from twin.framework.cluster import refuse_both
    from twin.framework.run_folder import KeptWork, read_manifest
    from twin.study import study_command
    from twin.study.runs.blocks import BLOCKS
    from twin.study.runs.setup import PROGRAM, resolve_study

    def resolve() -> StudySetup:
        refuse_both(workers, scheduler)
        setup = read_for(PROGRAM, file, resolve_study)
        study_command.check_size(setup, yes)
        return setup

    def work(setup: StudySetup, session: Session) -> Result:
        folder, chosen = store.begin(), (workers, scheduler)
        if out is not None and finished and not (folder / BLOCKS).exists():
            copyfile(out / BLOCKS, folder / BLOCKS)
        console = Console(quiet=True) if options.silent else errors
        notify = partial(console.print, markup=False, highlight=False, soft_wrap=True)
        if progress_fd is None:
            return study_command.run_study(setup, session, folder, chosen, notify)
        from twin.study.scripted import pipe_progress  # what a script needs

        return study_command.run_study(setup, session, folder, chosen, notify, pipe_progress(progress_fd))

    # --resume of a finished study writes its report again
    finished = resume and out is not None and isfile(out / BLOCKS) and read_manifest(out) is not None
    command = (
        f"python -m twin.study {file}{'' if out is None else f' --out {out}'}{' --force' if options.force else ''}"
    )
    store = KeptWork(out, file.stem, "blocks", resume, options.force, command)
    run_command(file.stem, replace(options, force=options.force or finished), resolve, work, store)


def _refuse_with_gradient(errors: Console, options: Mapping[str, object]) -> None:
    """Raise an input error for options that have no meaning with --gradient."""
    with cli.explained(errors):
        for name, value in options.items():
            if value is not None:
                raise cli.InputErrorText(
                    f"--gradient differentiates at the base in this process, so {name} has no meaning"
                )


if __name__ == "__main__":
    app()
