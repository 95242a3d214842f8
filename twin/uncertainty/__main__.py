"""Command ``python -m twin.uncertainty``: what limits the readings of an instrument's monitor."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from scenes.specs.procedures import PROCEDURES
from twin.framework import cli
from twin.framework.command import run_test

_MOST_STATES = 100_000

app = cli.program()


@app.command()
@cli.with_options("export")
def main(
    file: Annotated[
        Path,
        typer.Argument(
            readable=False,
            help="Job or instrument: the name of an instrument in the library (gf7_pair), a YAML file, or the "
            "config.yaml of a run.",
        ),
    ],
    options: cli.Options,
    disturbances: Annotated[
        str | None,
        typer.Option(
            "--disturbances",
            help="Prior on disturbances, instead of that of the file: a name of the library (orbit) or a file.",
        ),
    ] = None,
    states: Annotated[
        int,
        typer.Option(
            "--states",
            min=0,
            max=_MOST_STATES,
            help="Number of random states to render and recover, to check the coverage of the sigmas.",
        ),
    ] = 0,
) -> None:
    """Analyse what limits the readings of an instrument's monitor under its prior on disturbances.

    The report has standard deviations of every parameter, the intersection angle and points on the ground before and
    after a measurement, for every estimator; the motions that make up the remaining variance; the motions that the
    spots observe least; and the effect of more frames, a test field or a second monitor.

        python -m twin.uncertainty gf7_pair

        python -m twin.uncertainty scenes/examples/perturb.yaml --disturbances orbit

        python -m twin.uncertainty monitor_pair --states 500

    With --states, that many states are drawn from the prior, rendered, exposed and recovered (about 0.1 s each), and
    the share of 68 and 95 % intervals that contain the truth is compared with what chance allows.

    The run folder gets report.html, uncertainty.json, config.yaml, and figures and tables in artefacts/.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    procedure = PROCEDURES["uncertainty"]
    read, run = partial(procedure.resolve, file, disturbances), partial(procedure.run, states=states)
    words = ("--states", str(states)) if states else ()
    run_test("uncertainty", file, options, read=read, words=words, run=run, seeded=states > 0)


if __name__ == "__main__":
    app()
