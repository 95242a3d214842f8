"""Command line program ``python -m twin.design``: optimise a camera's prescription, or find the layout of a monitor."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from optics.numerics.backend import cores
from scenes.specs.file_kinds import kind_of
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import read_yaml
from twin.framework import cli
from twin.framework.command import add_tests, run_test


def _meant(args: Sequence[str]) -> str:
    """Return the subcommand (``camera`` or ``monitor``) that the file among the arguments requires."""
    return "monitor" if any(_is_layout(word) for word in args if not word.startswith("-")) else "camera"


def _is_layout(word: str) -> bool:
    """Return True if an argument is the path of a file that specifies a search for a monitor's layout.

    A file with errors counts too if it is of this kind; its command reports the errors.
    """
    try:
        kind = kind_of(read_yaml(word).data)
    except InputError:
        return False
    return kind is not None and kind.name == "monitor_design"


app = cli.program(cls=cli.unnamed(_meant), no_args_is_help=True)


@app.callback()
def main() -> None:
    """Optimise a camera's prescription, or find the layout of a pair's monitor.

    The subcommand may be omitted: the file determines it.

    Examples: `python -m twin.design camera scenes/examples/design_gf7_short.yaml` and `python -m twin.design monitor
    scenes/examples/design_monitor_two.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


add_tests(app, "design", apart=("monitor",))


@app.command("monitor")
@cli.with_options("export", "strict")
def monitor(
    file: cli.File,
    options: cli.Options,
    workers: Annotated[
        int | None, typer.Option(min=0, max=1024, help="Number of worker processes. Default: one for each core.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted search.")] = False,
) -> None:
    """Find the layout of a pair's monitor: number of beams, their positions in the pupil and their prisms.

    Layouts are compared by the accuracy of the cameras' parameters under the specified disturbances, by the obstructed
    share of the pupil, and by mass.

    Example: `python -m twin.design monitor scenes/examples/design_monitor_two.yaml --workers 2`

    The run folder gets the instruments of the best layouts in artefacts/, layouts.json, config.yaml and a report.
    During the run, finished work is kept in OUT.search beside it; with --resume the same command continues from there.
    The result depends neither on the number of workers nor on interruptions.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.framework.run_folder import KeptWork

    count = cores() if workers is None else workers

    def run(*arguments: Any) -> Any:
        return PROCEDURES["design monitor"].run(*arguments, workers=count, journal=store.begin() / "trials.journal")

    store = KeptWork(options.out, file.stem, "search", resume)
    run_test("design monitor", file, options, store, run=run)


if __name__ == "__main__":
    app()
