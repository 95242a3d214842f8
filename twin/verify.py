"""Command ``python -m twin.verify``: checks that a run folder is unchanged and that its run can be reproduced."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.console import Console

from scenes.yaml.standard_output import Terminal, print_json, to_stdout
from twin.framework import cli, durable

app = cli.program()


@app.command()
def main(
    run: Annotated[Path, typer.Argument(readable=False, help="Run folder of any command.")],
    files: Annotated[
        bool, typer.Option("--files", help="Check only the files; repeat nothing. A second for most folders.")
    ] = False,
    keep: Annotated[
        Path | None,
        typer.Option("--keep", readable=False, metavar="DIR", help="Keep the repeated run as this run folder."),
    ] = None,
    as_json: cli.AsJson = False,
    quiet: cli.Quiet = False,
) -> None:
    """Verify a run folder: its files by their checksums, then its results by repeating the run.

    The run is repeated from the config.yaml and the inputs that the folder names, and compared number by number.

        python -m twin.verify runs/perturb-001

        python -m twin.verify runs/perturb-001 --files

    **Files.** Changed files, missing files, and files that the run did not write are named, the manifest itself
    included. Files outside the folder that the run read, such as measured frames, are compared with their checksums at
    that time.

    **Repeated run.** It takes as long as the run did, which is printed first. Every number is identical to the bit,
    equal up to rounding (1e-9 of the largest of its kind, on another processor 1e-6, or 1e-3 of its sigma), or
    different, with key, old and new value. Report pages, which contain the time, and pictures are not compared.
    Differences in the version of the program, in packages or in the processor are reported.

    Nothing is written, except with `--keep`. `python -m twin.compare RUN DIR` then compares both in a report.

    Exit codes: 0 everything is unchanged, 1 something differs, 2 it cannot be checked: no run folder, an unfinished
    run, inputs that are missing or have changed.
    """
    errors = Console(stderr=True)
    silent = as_json or quiet
    with cli.explained(errors), durable.exit_on_terminate():
        from twin.compare import verification
        from twin.compare.verification import folder_state

        if files and keep is not None:
            raise cli.InputErrorText("--files repeats nothing, so that it cannot be combined with --keep")
        if keep is not None and (keep.exists() or keep.is_symlink()):
            raise cli.InputErrorText(f"--keep: {keep} exists; choose another folder")
        state = folder_state(run)
        why, made = "" if files else verification.obstacle(state), None
        if not files and not why:
            if not silent:
                took = cli.time_text(state.manifest.wall_time_s)
                errors.print(f"repeating the run, which took {took}", markup=False, highlight=False, soft_wrap=True)
            try:
                with TemporaryDirectory(prefix="twin-verify-") as folder:
                    made = verification.repeat(state, keep or Path(folder) / "again", silent)
            except verification.CannotRepeat as error:
                why = str(error)
        done = verification.Verification(state, made, why)
    with to_stdout(errors):
        if as_json:
            print_json(done.numbers())
        elif not quiet:
            console = Terminal()
            cli.print_verdict(console, done.verdict)
            for line in done.lines():
                console.print(line, markup=False, highlight=False, soft_wrap=True)
    if done.code:
        raise typer.Exit(done.code)


if __name__ == "__main__":
    app()
