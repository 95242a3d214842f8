"""``python -m twin.study``: design trade studies."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.run import cli
from twin.study.progress_bar import Told, tell_through

if TYPE_CHECKING:  # help waits for nothing that computes
    from twin.study.runs.engine import Estimate
    from twin.study.runs.engine import Progress as EngineProgress
    from twin.study.runs.study_folder import StudyFolder
    from twin.study.study_command import StudyOptions, StudyRun

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    file: Annotated[Path, typer.Argument(readable=False, help="YAML file of the study, or the config.yaml of one.")],
    out: Annotated[
        Path | None, typer.Option(readable=False, help="Folder of the study. Default: runs/STUDY-001, -002, ...")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of worker processes. Default: one for each core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Use a running Dask cluster, tls://host:8786 or tcp://host:8786. Its workers need the twin installed. "
            "Over tcp:// everybody who reaches its ports can run programs there: use it in a network of your own only. "
            "For tls:// name the certificates to scheduler, workers and this command by DASK_DISTRIBUTED__COMM__TLS "
            "variables, see docs/studies.md."
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the study in the folder --out.")] = False,
    force: cli.Force = False,
    gradient: Annotated[
        bool,
        typer.Option("--gradient", help="Differentiate the responses by the factors at the base, instead of the runs."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Run more runs than the study's limit.")] = False,
    backend: cli.BackendName = "llvm",
    as_json: cli.AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors and warnings.")] = False,
    strict: cli.Strict = False,
    progress_fd: Annotated[int | None, typer.Option("--progress-fd", hidden=True, min=3)] = None,
) -> None:
    """Run a job many times with varied values and keep the numbers that matter.

    The study's file names a base job (render, lab ..., orbit ...), the factors that vary in it, a design and the
    responses that are kept; scenes/examples/study_smoke.yaml is a small one.

    The folder gets study.nc (netCDF, one dimension `run`), study.csv, study.json, report.html and config.yaml, which
    can be given in place of the file. The numbers do not depend on the number of workers.

    While it runs, finished pieces are kept below DIR/chunks. A study that was broken off, by Ctrl-C or a power
    failure, is gone on with by the same command and --resume. With --force the folder that is to be replaced stands
    until the new study is complete; meanwhile that grows in .NAME.next beside it.

    With --gradient it runs no design: the folder gets the Jacobian at the base's own values, gradient.json and
    gradient.csv, by automatic differentiation and beside it by differences.

    Examples: `python -m twin.study scenes/examples/study_smoke.yaml --workers 2` and
    `python -m twin.study scenes/examples/study_smoke.yaml --gradient`

    Exit codes: 0 success, 2 bad input (nothing is lost), 129, 130 or 143 interrupted, 1 anything else: all runs failed,
    the program did, or a figure could not be drawn.
    """
    from twin.run.cluster import ClusterError
    from twin.study import study_command
    from twin.study.runs.engine import IncompleteError, ProgramFault

    errors = Console(stderr=True)
    options = study_command.StudyOptions(out, workers, scheduler, resume, force, yes, backend)
    place: list[StudyFolder] = []
    if gradient:
        _refuse_with_gradient(errors, options)
        # drawing libraries are not needed before
        from twin.study.gradient.gradient_report import run_gradient

        run_gradient(file, cli.Options(out, None, backend, force, as_json, quiet, strict=strict))
        return
    with cli.explained(errors):
        told = (lambda done, total: None) if progress_fd is None else tell_through(progress_fd)
        display = _Display(errors, quiet or as_json, told)
        try:
            with display.bar, display.heartbeat:
                run = study_command.run_study(file, options, display.progress(), place.append)
        except (study_command.Broken, ProgramFault, IncompleteError, ClusterError, OSError) as error:
            if isinstance(error, ProgramFault):
                errors.print(error.trace, markup=False, highlight=False, soft_wrap=True)
            said = (error.strerror or error) if isinstance(error, OSError) else error
            print_error(errors, f"{said}{_how_to_go_on(file, place)}")
            raise typer.Exit(error.code if isinstance(error, study_command.Broken) else FAILURE) from None
    with to_stdout(errors, f"the study is complete in {run.folder}"):
        if as_json:
            print_json(run.numbers)
        elif not quiet:
            _print_result(run)
    if run.numbers["failed"] == run.numbers["runs"]:
        print_error(errors, f"all {run.numbers['runs']} runs failed, see {run.folder / 'report.html'}")
        raise typer.Exit(FAILURE)
    if run.missing:
        print_error(errors, f"{'; '.join(run.missing)}; all else is in {run.folder}")
        raise typer.Exit(FAILURE)
    if run.fault is not None:
        # everything is written: only what the file says of a response is wrong
        with cli.explained(errors):
            raise run.fault
    if strict:
        cli.end_strictly(errors, run.numbers)


def _refuse_with_gradient(errors: Console, options: StudyOptions) -> None:
    """Refuse options that mean nothing with --gradient."""
    words = ("--workers", "--scheduler", "--resume", "--yes")
    given = (options.workers, options.scheduler, options.resume or None, options.confirmed or None)
    with cli.explained(errors):
        for name, value in zip(words, given, strict=True):
            if value is not None:
                raise cli.InputErrorText(
                    f"--gradient differentiates at the base in this process, so {name} has no meaning"
                )


def _how_to_go_on(file: Path, place: list[StudyFolder]) -> str:
    if not (place and place[0].resumable):
        return "; nothing was kept"
    return f"; what is done is kept, go on with: python -m twin.study {file} --out {place[0].target} --resume"


class _Display:
    """What the user sees while a study runs: lines on stderr, and a bar where it is a terminal."""

    def __init__(self, console: Console, silent: bool, told: Told = lambda done, total: None) -> None:
        self.console, self.silent, self._told = console, silent, told
        self.bar = Progress(
            TextColumn("runs"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=console,
            disable=silent or not console.is_terminal,
            transient=True,
        )
        self._task = self.bar.add_task("runs", total=None, rate="")
        self._began: tuple[float, int] | None = None
        self._standing = cli.Standing("start the workers and a pilot")
        self.heartbeat = cli.heartbeat(console, lambda: str(self._standing), silent)

    def progress(self) -> EngineProgress:
        """What the engine calls."""
        from twin.study.runs.engine import Progress as EngineProgress

        return EngineProgress(start=self._start, done=self._done, warn=self._warn)

    def _say(self, text: str) -> None:
        if not self.silent:
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def _warn(self, text: str) -> None:
        self.console.print(f"warning: {text}", style="yellow", markup=False, soft_wrap=True)

    def _start(self, estimate: Estimate) -> None:
        there = f" ({estimate.there} are there already)" if estimate.there else ""
        self._say(
            f"{estimate.runs} runs{there} in {estimate.blocks} blocks and {estimate.chunks} chunks on "
            f"{estimate.workers} worker{'s' if estimate.workers > 1 else ''}; about {cli.time_text(estimate.seconds)}, "
            f"{1e-9 * estimate.memory:.1f} GB; {1e3 * estimate.state_seconds:.3g} ms a run"
        )

    def _done(self, done: int, total: int) -> None:
        self._told(done, total)
        now = time.monotonic()
        if self._began is None:
            self._began = (now, done)
        rate = (done - self._began[1]) / max(now - self._began[0], 1e-9)
        text = f"{rate:.3g}/s" if done > self._began[1] else ""
        self.bar.update(self._task, completed=done, total=total, rate=text)
        if done < total:
            self._standing.advance("runs", done, total)
        else:
            self._standing.advance("write the results", 0, 1)


def _print_result(run: StudyRun) -> None:
    from twin.run.artefact import cell_text

    numbers = run.numbers
    title = f"{numbers['name']}: {numbers['runs']} runs, {numbers['failed']} failed"
    table = cli.result_table(title)
    for head in ("response", "unit", "mean", "std", "95%", "99.7%"):
        table.add_column(head, justify="left" if head in ("response", "unit") else "right", no_wrap=True)
    for name, r in numbers["responses"].items():
        table.add_row(name, r["unit"], *(cell_text(r[key]) for key in ("mean", "std", "p95", "p997")))
    console = Terminal()
    cli.print_verdict(console, run.verdict)
    cli.print_whole(console, table)
    cli.print_place(console, run.folder)


if __name__ == "__main__":
    app()
