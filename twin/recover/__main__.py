"""``python -m twin.recover``: measured frames of a monitor, and what they say."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenes.specs.file_kinds import read_for
from scenes.yaml.named import Named
from twin.framework.cli import AsJson, BackendName, Force, Options, Out, Quiet, Strict
from twin.framework.command import Result, finished, run_command
from twin.framework.procedure import Session

if TYPE_CHECKING:
    from scenes.specs.monitor_frames import MeasurementSetup

PROGRAM = "twin.recover"

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    measurement: Annotated[
        Path, typer.Argument(readable=False, help="YAML file of the measurement, or the config.yaml of a run.")
    ],
    out: Out = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    strict: Strict = False,
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

    def work(setup: MeasurementSetup, session: Session) -> Result:
        from twin.recover.recover_run import run_recover

        run = run_recover(setup, session.backend, session.advance)
        # frames that cannot be measured are told before anything that draws is loaded
        from twin.main_job.monitor_reading import worst_checks
        from twin.recover.recover_report import KIND, recover_numbers, recover_report

        facts = {"config": setup.to_yaml(), "named": setup.plain(), "checks": worst_checks(run.readings)}
        return finished(session, KIND, recover_report(run), recover_numbers(run), program=PROGRAM, **facts)

    run_command(
        measurement.stem,
        Options(out, None, backend, force, as_json, quiet, strict=strict),
        lambda: read_for(PROGRAM, measurement, Named("scenes.specs.monitor_frames:MeasurementSetup.read")),
        work,
    )


if __name__ == "__main__":
    app()
