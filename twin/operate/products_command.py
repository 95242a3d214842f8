"""The command that writes what an operation's estimate says for one time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenes.yaml.errors import Problem
from scenes.yaml.standard_output import FAILURE, print_error
from twin.operate.followed import PlanFile, operation_of
from twin.operate.terminal import Place, line, require_record, tell, told
from twin.run import durable
from twin.run.cli import AsJson, InputErrorText, Quiet

if TYPE_CHECKING:
    from twin.orbit.export.export_run import ExportSource


def products(
    record: Place,
    plan: PlanFile = None,
    moment: Annotated[
        str | None,
        typer.Option("--time", metavar="UTC", help="Of the estimate; that of the scene where it is not given."),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            readable=False,
            help="YAML file of a test of intersection angles with the instrument, or its run folder: camera, orbit and "
            "attitude of a scene whose camera models are wanted.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(readable=False, help="Folder for them; it must not be there yet.")] = Path(
        "products"
    ),
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write what the estimate says for one time: models of a scene's cameras as they were then (ISD and RPC00B with
    ERR_BIAS and ERR_RAND), the state of the instrument as a job for twin.render (state.yaml), and what is uncertain of
    it as a prior for twin.asbuilt (prior.yaml). products.json says from when to when they hold.

    Example: `python -m twin.operate products record --scene scenes/orbit/angle_gf7.yaml --time 2026-03-05T03:05:00Z`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    require_record(record)
    from twin.operate.record.entries import one_line
    from twin.operate.record.history import History

    with told() as errors, History(record) as history:
        from optics.numerics.backend import load_backend
        from twin.operate.product_files import product_files, summary
        from twin.operate.products import made
        from twin.orbit.export.export_run import read_source

        if out.exists():
            raise InputErrorText(f"--out: {out} is there already; name a folder that is not")
        source = None if scene is None else read_source(scene)
        time = _time(moment, source)
        operation = operation_of(history, plan, errors, quiet)
        try:
            one = made(operation, history, time, source, load_backend())
        except Problem as problem:
            raise InputErrorText(one_line(problem)) from None
        files, numbers = product_files(one)
        try:
            for folder in sorted({out, *((out / name).parent for name in files)}):
                durable.make_folders(folder)
            durable.write_all_safely((out / name, content) for name, content in files.items())
        except OSError as error:
            print_error(errors, f"{out}: {error.strerror or error}; what is there is not all of the products")
            raise typer.Exit(FAILURE) from None
        tell(errors, as_json, quiet, numbers, lambda console: line(console, summary(one)))


def _time(moment: str | None, scene: ExportSource | None) -> int:
    """Of the estimate, microseconds of TAI since 2000. Raises InputErrorText."""
    from twin.operate.products import scene_time
    from twin.operate.record.entries import one_line
    from twin.operate.record.sources import moment_said

    if moment is not None:
        return moment_said("--time", moment)
    try:
        if scene is not None:
            return scene_time(scene)
    except Problem as problem:
        raise InputErrorText(f"--scene: {one_line(problem)}") from None
    raise InputErrorText("of which time? --time UTC, or --scene FILE, which has one")
