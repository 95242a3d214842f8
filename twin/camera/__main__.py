"""Command ``python -m twin.camera``: the optical analysis of a camera, and its best focus."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from scenes.specs.procedures import PROCEDURES
from twin.framework import cli
from twin.framework.command import run_test

TILT = "tilt"
"""Name of the command's option that also tilts the focal plane."""

app = cli.program()


@app.command()
@cli.with_options("seed", "export", "strict")
def main(
    file: Annotated[
        Path,
        typer.Argument(
            readable=False,
            help="Camera, instrument or job: a name of the library (gf7), a YAML file, or the config.yaml of a run.",
        ),
    ],
    options: cli.Options,
    what: Annotated[str | None, typer.Argument(hidden=True, metavar="")] = None,
    camera: Annotated[str | None, typer.Option("--camera", help="Camera to analyse, if the file has several.")] = None,
    refocus: Annotated[
        bool,
        typer.Option(
            "--refocus",
            help="Find the best image plane first, of a perturbed camera in its state; of a camera as designed, also "
            "write its file with that plane.",
        ),
    ] = False,
    perturb: Annotated[
        list[str] | None,
        typer.Option(
            "--perturb",
            metavar="TEXT",
            help='Perturb the camera, for example "M2 shift z 20 um"; may be given several times.',
        ),
    ] = None,
    temperature: Annotated[
        str | None,
        typer.Option(
            "--temperature", metavar="TEXT", help='Change the temperature of the whole camera, for example "+2 K".'
        ),
    ] = None,
    tilt: Annotated[
        bool, typer.Option("--tilt", help="With --refocus: also tilt the image plane about the line.")
    ] = False,
) -> None:
    """Analyse a camera over its field: wavefronts, spots, MTF, distortion, illumination and first-order data.

    The report shows the layout with rays as well, and through focus and field curvature. The verdict names the worst
    field and the dominant aberration.

        python -m twin.camera gf7

        python -m twin.camera gf7_pair --camera forward

        python -m twin.camera my_camera.yaml --refocus

        python -m twin.camera my_camera.yaml --perturb "M2 shift z 20 um" --perturb "M2 rotate x 3 arcsec" --refocus

    With --refocus the image plane is moved to the smallest mean square wavefront error over the field, and with
    `--refocus --tilt` it is tilted about the line as well. The motion is printed as --perturb takes it. The file of a
    camera as designed with that plane and all comments is in artefacts/, ready for use.

    With --perturb, --temperature or a job the camera is analysed in that state, and the first paragraph describes the
    effect. With --refocus, too, it is what is left after refocusing. Bodies are named by their path or its last parts,
    as in a job's file.

    The run folder gets report.html, optics.json (numbers), optics.nc (maps, spots, curves), config.yaml, and figures
    and tables in artefacts/.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    with_tilt = tilt or what is not None  # the second argument of earlier versions

    def read() -> Any:
        from scenes.specs.instrument import BASE

        if what is not None and (what != TILT or not refocus):
            raise cli.InputErrorText(f"{what!r} has no meaning here; there is --refocus --{TILT}")
        if tilt and not refocus:
            raise cli.InputErrorText(f"--{TILT} goes with --refocus")
        if what is not None:
            typer.echo(f"--refocus {TILT} is written --refocus --{TILT}; this version still reads it", err=True)
        warmed = [] if temperature is None else [f"{BASE} temperature {temperature}"]
        return procedure.resolve(file, camera).perturbed([*(perturb or ()), *warmed])

    procedure = PROCEDURES["camera"]
    # a refocused camera is not judged: its verdict states its image quality
    run = partial(procedure.run, refocus=refocus, tilt=with_tilt)
    words = (*(("--refocus",) if refocus else ()), *((f"--{TILT}",) if with_tilt else ()))
    named = file if camera is None else Path(f"{file.stem}-{camera}.yaml")
    run_test("camera", named, options, read=read, words=words, run=run, judged=not refocus)


if __name__ == "__main__":
    app()
