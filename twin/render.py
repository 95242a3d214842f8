"""Command ``python -m twin.render``: images of a perturbed instrument, and the perturbation recovered from them."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from scenes.specs.file_kinds import read_for
from scenes.yaml.named import Named
from scenes.yaml.standard_output import Terminal, print_json, to_stdout
from twin.framework import cli
from twin.framework.command import Result, run_command
from twin.framework.procedure import Session

if TYPE_CHECKING:
    from scenes.specs.resolved import ResolvedJob

RESOLVE = Named("scenes.specs.resolved:resolve")

app = cli.program()


@app.command()
@cli.with_options("export")
def main(
    # readable=False: the loader reports errors of files, in the same words for all files.
    job: Annotated[
        Path, typer.Argument(readable=False, help="YAML file of the job, e.g. scenes/examples/perturb.yaml.")
    ],
    options: cli.Options,
    frames: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Frames per state; overrides the file's.")
    ] = None,
    picture: Annotated[
        bool,
        typer.Option("--picture", help="Also render pictures of the instrument itself: picture.png and two close-ups."),
    ] = False,
    list_nodes: Annotated[
        bool,
        typer.Option(
            "--list-nodes",
            help="Print the nodes of the job's instrument, their pivots and what each allows; run nothing.",
        ),
    ] = False,
) -> None:
    """Render the monitor's spot images of a perturbed instrument and recover the perturbation from them.

    The job file names an instrument and its perturbation:

        instrument: gf7_pair

        perturb:

          base/backward/focal_plane: {rotate: [2 arcsec, -1.5 arcsec, 10 arcsec], pivot: rear_node}

          base/forward/M2: {shift: [0 um, 0 um, 3 um]}

        disturbances: launch

        render: {images: [spots], frames: 9, seed: 1}

    Every quantity carries its unit. The run folder gets the images (TIFF), the expected irradiance (netCDF),
    truth.json, recovered.json, crosstalk.json, a self-contained report.html and scene.glb. A run's own config.yaml
    can be given as the job to repeat it. The terminal, the report and recovered.json have a verdict: the result, its
    accuracy, and what limits it.

    A job with a course, a table of temperatures and motions over time (scenes/examples/orbit.yaml, launch.yaml and
    heat_soak.yaml), also gets every time's numbers and images: course.json, course.nc and
    images/CAMERA_CHANNEL_course.tiff.

    With `render: {images: [spots, knife_edge, bars]}` (also star and pinhole) test targets at infinity are imaged on
    every camera's panchromatic line CCD, in its middle and near its ends, before and after; mtf.json has the MTF
    measured in the images and that of the traced pupil (scenes/examples/targets.yaml).

    With `render: {stray: true}` ghosts and scattered light are path-traced and added to the images; stray.json lists
    them.

    With `render: {quality: true}` wavefront errors, defocus and MTF on the line CCDs are computed before and after;
    quality.json has them. Prisms and other bodies obstruct the cameras' pupils, here and in the targets' images;
    `render: {obstruction: ignore}` omits this obstruction.

    The option --list-nodes prints what can be perturbed in a job's instrument.

    With --picture the run folder also gets picture.png (the instrument), picture_prisms.png and
    picture_focal_plane.png, rendered with Mitsuba; this takes about half a minute. If Mitsuba fails, the rest of the
    run is kept and the exit code is 1.

    Example: `python -m twin.render scenes/examples/perturb.yaml --out runs/first`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    if list_nodes:
        print_nodes(job, options.backend, options.as_json)
        return

    def work(resolved: ResolvedJob, session: Session) -> Result:
        from twin.main_job.render_command import run_render

        return run_render(resolved, session, frames, options.seed, picture)

    run_command(job.stem, options, lambda: read_for("twin.render", job, RESOLVE), work)


def print_nodes(job: Path, backend: str, as_json: bool) -> None:
    """Print the nodes of a job's instrument that can be perturbed.

    Raises
    ------
    typer.Exit
        The job cannot be read or built; the error has been printed.
    """
    errors = Console(stderr=True)
    with cli.explained(errors):
        cli.check_backend(backend)
        resolved = read_for("twin.render", job, RESOLVE)
        from optics.numerics.backend import load_backend
        from scenes.models.instrument_builder import build_instrument
        from scenes.specs.perturbation import ACTIONS

        nodes = build_instrument(resolved.instrument, resolved.cameras, load_backend(backend)).nodes
    with to_stdout(errors):
        if as_json:
            allowed = {
                path: {"pivots": list(info.pivots), "allows": [action for action in ACTIONS if action in info.allows]}
                for path, info in nodes.items()
            }
            print_json({"instrument": resolved.instrument.name, "nodes": allowed})
            return
        table = cli.result_table(f"nodes of {resolved.instrument.name}")
        for head in ("node", "pivots", "allowed changes"):
            table.add_column(head, no_wrap=True)
        for path, info in nodes.items():
            actions = ", ".join(action for action in ACTIONS if action in info.allows)
            table.add_row(path, ", ".join(info.pivots), actions)
        cli.print_whole(Terminal(), table)


if __name__ == "__main__":
    app()
