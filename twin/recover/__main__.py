"""``python -m twin.recover``: measured frames of a monitor, and what they say."""

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
    """Recover what moved from measured frames of a monitor's area CCDs, before and after: the centroids and estimators
    of `python -m twin.render`, with total sigmas and without a truth.

    The measurement's file names the instrument and the frames:

        instrument: gf7_pair

        frames: run/images

    A folder holds CAMERA_CHANNEL_before.tiff and CAMERA_CHANNEL_after.tiff, as twin.render writes them; or the files
    are named for each channel, in a CSV table, or as a series with times. TIFF (also packed), FITS and PNG are read.

    Without a model of the instrument its geometry will do: then the shape of the spots is learnt from the frames
    before, and nothing is known of what disturbances do.

    Frames are searched for what is no spot: hot, dead and flickering pixels, bad columns, cosmic rays, frames without
    light, saturation, uneven background, reflections, movement between frames. What is found is left out or fitted,
    told with its cost in sigma, or refused by name. Clean frames give what twin.render gives, to the last digit.

    The run folder gets recovered.json, report.html, config.yaml, and figures and tables in artefacts/.

    Example: `python -m twin.recover scenes/examples/measured_frames.yaml --out runs/measured`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    run_test("recover", measurement, options)


if __name__ == "__main__":
    app()
