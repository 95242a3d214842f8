"""Command ``python -m twin.recover``: recover changes of the cameras from measured frames of a monitor."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import Annotated

import typer

from twin.framework import cli
from twin.framework.command import run_test

app = cli.program()


@app.command()
@cli.with_options("seed", "export")
def main(
    measurement: Annotated[
        Path, typer.Argument(readable=False, help="YAML file of the measurement, or the config.yaml of a run.")
    ],
    options: cli.Options,
) -> None:
    """Recover what moved from measured frames of a monitor's area CCDs.

    The centroids and estimators are those of `python -m twin.render`, with total sigmas and without a truth. The
    measurement's file names the instrument and the frames, taken before and after:

        instrument: gf7_pair

        frames: run/images

    A folder holds CAMERA_CHANNEL_before.tiff and CAMERA_CHANNEL_after.tiff, as twin.render writes them; or the files
    are named for each channel, in a CSV table, or as a series with times. TIFF (also packed), FITS and PNG are read.

    An instrument without a model can be described by its geometry alone: then the shape of the spots is learnt from the
    frames before, and there is no prior on disturbances.

    Frames are searched for artefacts: hot, dead and flickering pixels, bad columns, cosmic rays, frames without light,
    saturation, uneven background, reflections, movement between frames. Each artefact is excluded or fitted and
    reported with its effect on sigma, or the frames are refused with the reason. Clean frames give exactly the numbers
    of twin.render.

    The run folder gets recovered.json, report.html, config.yaml, and figures and tables in artefacts/.

    Example: `python -m twin.recover scenes/examples/measured_frames.yaml --out runs/measured`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    run_test("recover", measurement, options)


if __name__ == "__main__":
    app()
