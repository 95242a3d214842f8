"""``python -m twin.uncertainty``: what limits an instrument's monitor."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from twin.framework.cli import AsJson, BackendName, Force, Options, Out, Quiet, Seed, Strict
from twin.framework.command import Result, finished, run_command
from twin.framework.procedure import Session

if TYPE_CHECKING:
    from scenes.specs.resolved import ResolvedJob

PROGRAM, KIND = "twin.uncertainty", "uncertainty"
_MOST_STATES = 100_000

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    file: Annotated[
        Path,
        typer.Argument(
            readable=False,
            help="Job or instrument: an instrument's name of the library (gf7_pair), a YAML file, or the config.yaml "
            "of a run.",
        ),
    ],
    disturbances: Annotated[
        str | None,
        typer.Option(
            "--disturbances",
            help="What is stated to move, in place of what the file says: a name of the library (orbit) or a file.",
        ),
    ] = None,
    states: Annotated[
        int,
        typer.Option(
            "--states", min=0, max=_MOST_STATES, help="Random states to render and recover: do the sigmas hold?"
        ),
    ] = 0,
    out: Out = None,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Say what limits the readings of an instrument's monitor under its stated disturbances: standard deviations of
    every parameter, the intersection angle and points on the ground before and after a measurement, by every estimator;
    whose motions make up what is left; which motions the spots see least; and what more frames, a test field or a
    second monitor would take away.

        python -m twin.uncertainty gf7_pair

        python -m twin.uncertainty scenes/examples/perturb.yaml --disturbances orbit

        python -m twin.uncertainty monitor_pair --states 500

    With --states that many states are drawn from the disturbances, rendered, exposed and recovered (about 0.1 s each),
    and the share of intervals of 68 and 95 % that hold the truth is compared with what chance allows.

    The run folder gets report.html, uncertainty.json, config.yaml, and figures and tables in artefacts/.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """

    def resolve() -> ResolvedJob:
        from scenes.specs.resolved import resolve_with

        resolved = resolve_with(file, disturbances)
        chosen = resolved.job.render.seed if seed is None else seed
        return resolved.with_render(resolved.frames, chosen)

    def work(resolved: ResolvedJob, session: Session) -> Result:
        from twin.framework.provenance import checks_in
        from twin.uncertainty.coverage import run_uncertainty
        from twin.uncertainty.uncertainty_numbers import uncertainty_numbers
        from twin.uncertainty.uncertainty_report import uncertainty_report

        run = run_uncertainty(resolved, session.backend, states, session.advance)
        numbers = uncertainty_numbers(run)
        options = ("--states", str(states), "--seed", str(run.seed)) if states else ()
        again = (PROGRAM, "config.yaml", *options, "--backend", session.backend.name)
        facts: dict[str, Any] = {"config": resolved.to_yaml(), "named": resolved.plain(), "again": again}
        facts |= {"seed": run.seed if states else None, "checks": (*run.images.told(), *checks_in(numbers))}
        return finished(session, KIND, uncertainty_report(run), numbers, program=PROGRAM, **facts)

    run_command(file.stem, Options(out, seed, backend, force, as_json, quiet, strict=strict), resolve, work)


if __name__ == "__main__":
    app()
