"""``python -m twin.compare``: differences between run folders."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from scenes.yaml.yaml_file import dump_yaml
from twin.framework import cli
from twin.framework.command import Result, finished, run_command
from twin.framework.procedure import Session

DIFFERENT = 1
"""Exit code if results differ; it is that of the program diff."""

app = cli.program()


@app.command()
@cli.with_options("seed", "export", "backend", "strict")
def main(
    runs: Annotated[list[Path], typer.Argument(readable=False, help="Run folders; the first is the reference.")],
    options: cli.Options,
    rtol: Annotated[float, typer.Option(min=0.0, max=1.0, help="Relative tolerance of numbers.")] = 1e-9,
    sigmas: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Tolerance of numbers with a sigma, in sigmas; recorded frames are ignored. Default: --rtol."
        ),
    ] = None,
) -> None:
    """Compare run folders of one kind: inputs, results and images.

    Any run folders of one command can be compared: two jobs that differ in one perturbation, one job before and after
    a change of the program, the same study with other seeds. Times and durations are ignored.

    For example:

        python -m twin.compare runs/perturb-001 runs/perturb-002 --sigmas 3

    The folder gets compare.json, tables as CSV, and a report with the images side by side.

    Exit codes: 0 no result differs, 1 results differ, 2 bad input.
    """

    def work(prepared: None, session: Session) -> Result:
        from twin.compare.compare_report import KIND, PROGRAM, compare, compare_report, numbers

        comparison = compare(runs, rtol, sigmas)
        report = replace(compare_report(comparison), code=0 if comparison.same else DIFFERENT)
        limits = ["--rtol", f"{rtol:g}"] + ([] if sigmas is None else ["--sigmas", f"{sigmas:g}"])
        config = {"runs": [str(run) for run in runs], "rtol": rtol, "sigmas": sigmas}
        facts = {"config": dump_yaml(config), "again": (PROGRAM, *map(str, runs), *limits), "input_paths": tuple(runs)}
        return finished(session, KIND, report, numbers(comparison), backend="", program=PROGRAM, **facts)

    run_command("compare", options, lambda: None, work)


if __name__ == "__main__":
    app()
