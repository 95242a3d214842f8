"""``python -m twin.design``: optimise a camera's prescription with exact Jacobians; before, after, the new file."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from typing import Any

import typer

from scenes.models.camera_design import resolve_design
from twin.run.cli import AsJson, BackendName, File, Force, Options, Out, Quiet
from twin.run.command import Test, run_test

PROGRAM = "twin.design"

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    file: File,
    out: Out = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Optimise a camera's prescription: curvatures, conics, aspheric terms and places vary; the wavefront error over
    the field is made least, with the focal length, the envelope and free beams as constraints.

    Example: `python -m twin.design scenes/examples/design_gf7_short.yaml`

    The run folder gets the new camera's file in artefacts/,
    design.json, config.yaml and a report.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    run_test(PROGRAM, "", file, resolve_design, _design, Options(out, None, backend, force, as_json, quiet))


def _design() -> Test[Any]:
    from twin.design.design_report import design_report
    from twin.design.design_run import DESIGN

    return DESIGN, design_report


if __name__ == "__main__":
    app()
