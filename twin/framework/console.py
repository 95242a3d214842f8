"""The command ``camtwin``: every program under one name, from any working directory.

``camtwin render JOB`` is ``python -m twin.render JOB``, but it never looks for modules in the working directory, not
even for one that is named ``twin.py``. Names and descriptions of the programs are listed here, so that help and
completion of the first word import none of them.
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

PROGRAMS = {
    "render": ("twin.render", "perturb an instrument, render its images, recover the changes"),
    "new": ("twin.new", "commented files: camera, job, tolerance, study, asbuilt, instrument, operation"),
    "recover": ("twin.recover", "recover the changes from measured frames"),
    "live": ("twin.live", "the twin in a browser: move a slider, the spots follow"),
    "lab": ("twin.lab", "laboratory tests: focus, distortion, turntable"),
    "orbit": ("twin.orbit", "adjust, angle, calibrate, check, export, jitter, match, monitor, simulate"),
    "study": ("twin.study", "vary any key of a job; statistics, sensitivities, gradients"),
    "design": ("twin.design", "optimise a camera, or find the layout of a monitor"),
    "tolerance": ("twin.tolerance", "tolerances with compensators: sensitivities, yield, allocation"),
    "asbuilt": ("twin.asbuilt", "state of one instrument as built, from all its measurements"),
    "operate": (
        "twin.operate",
        "init, ingest, status, forecast, alarms, exclude, products, report, export, simulate, judge",
    ),
    "camera": ("twin.camera", "wavefront, spots, MTF, distortion of a camera; refocus it"),
    "lens": ("scenes.lens", "new telescope; read and write prescriptions of Zemax, CODE V, batoid"),
    "mtf": ("analysis.mtf", "MTF from a slanted edge or bars in any image"),
    "uncertainty": ("twin.uncertainty", "uncertainty budget of a monitor, and coverage of its sigmas"),
    "compare": ("twin.compare", "differences between run folders"),
    "verify": ("twin.verify", "check that a run folder is intact and its run reproducible"),
    "export": ("twin.export", "frames and tables of a run folder for other programs"),
    "validate": ("twin.validate", "equations and tables of the papers, compared with the simulation"),
    "show": ("twin.show", "what a YAML file is, which command reads it, its keys and defaults"),
    "schema": ("scenes.schema", "JSON Schemas of the YAML files, for editors"),
    "doctor": ("twin.doctor", "check that this machine can run the twin"),
}
"""For each first word after ``camtwin``, the module that runs and its description in one line."""
COMPLETE = "_CAMTWIN_COMPLETE"
"""Environment variable by which a shell asks for completions."""
_BEFORE = __name__.removesuffix("twin.framework.console")
"""Package prefix of the modules' names if the packages are installed inside another package; otherwise empty."""


@cache
def parser(program: str) -> Any:
    """Return the Click command (or group of subcommands) that parses the arguments of a program.

    A program has a Typer application ``app`` or a function ``main``.
    """
    import typer

    module = importlib.import_module(_BEFORE + program)
    if hasattr(module, "__path__"):
        module = importlib.import_module(f"{_BEFORE}{program}.__main__")
    app = getattr(module, "app", None)
    if app is None:
        app = typer.Typer(add_completion=False)
        app.command()(module.main)
    return typer.main.get_command(app)


def _application() -> typer.Typer:
    """Return the application for help, version, completion and errors in the first word.

    Each program appears only with its one-line description.
    """
    import typer
    from typer.core import TyperCommand, TyperGroup

    class Programs(TyperGroup):
        def __init__(self, **attrs: Any) -> None:
            lines = {name: TyperCommand(name, short_help=line) for name, (_, line) in PROGRAMS.items()}
            super().__init__(**{**attrs, "commands": lines})

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Return the parser of the named program; only completion calls this."""
            name, command, rest = super().resolve_command(ctx, args)
            return name, parser(PROGRAMS[args[0]][0]) if command else command, rest

    app = typer.Typer(cls=Programs, rich_markup_mode=None, pretty_exceptions_enable=False, no_args_is_help=True)

    def show_version(asked: bool) -> None:
        if asked:
            from importlib.metadata import version

            folder = Path(__file__).resolve().parents[2]
            sys.stdout.write(f"camtwin {version('space-camera-twin')} from {folder}\n")
            raise typer.Exit

    @app.callback()
    def camtwin(
        version: bool = typer.Option(
            False, "--version", callback=show_version, is_eager=True, help="Show the version and exit."
        ),
    ) -> None:
        """Run a program of the digital twin of space mapping cameras and of their on-board autocollimation monitor.

        camtwin PROGRAM --help describes a program.
        """

    return app


def main() -> None:
    """Run the program that the first word names, with the remaining words as its arguments."""
    # inherited by processes that are started from here
    os.environ["PYTHONSAFEPATH"] = "1"
    if sys.argv[1:2] and sys.argv[1] in PROGRAMS and COMPLETE not in os.environ:
        module, _ = PROGRAMS[sys.argv.pop(1)]
        runpy.run_module(_BEFORE + module, run_name="__main__", alter_sys=True)
    else:
        try:
            _application()(prog_name="camtwin")
        except OSError as error:  # the library that writes the help does not report a full disk
            from scenes.yaml.standard_output import leave_stdout

            leave_stdout()
            sys.exit(f"error: cannot write to the standard output: {error.strerror}")
