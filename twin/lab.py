"""``python -m twin.lab``: laboratory tests of a camera, rendered or from files of measurements, and measured (paper
004).
"""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import typer

from scenes.specs.resolved import resolve_distortion_test, resolve_focus_test, resolve_turntable_test
from twin.laboratory.laboratory_tests import LABORATORY_TESTS, export_distortion, export_focus, export_turntable
from twin.run.command import add_test

PROGRAM = "twin.lab"

app = typer.Typer(
    add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, no_args_is_help=True
)


@app.callback()
def main() -> None:
    """Test a camera in the laboratory as paper 004 does: every image is rendered through the traced camera, noise
    included, and only images and readings reach the analysis.

    With `measured:` in the test's file, tables and images of a real bench go through the same analysis
    (docs/measured_laboratory.md); `--export DIR` writes a simulated bench's as such files.

    Examples of all three files are in scenes/lab, and of measurements in scenes/lab/measured. The run folder gets
    config.yaml, the numbers as JSON, a self-contained report.html, figures and tables in artefacts/ and recorded
    frames in images/.

    Example: `python -m twin.lab turntable scenes/lab/turntable.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


add_test(
    app,
    PROGRAM,
    "focus",
    resolve_focus_test,
    LABORATORY_TESTS["focus"],
    """Align a mis-set focal plane: through-focus MTF of a slanted edge in every field and band, a weighted plane,
    shims, and the same again.

    focus.json holds, for every round, the confocal error, the line's level, MTF at Nyquist by band and the shims,
    and under `truth` what the exact trace says.

    Example: `python -m twin.lab focus scenes/lab/focus.yaml`
    """,
    export_focus,
)

add_test(
    app,
    PROGRAM,
    "distortion",
    resolve_distortion_test,
    LABORATORY_TESTS["distortion"],
    """Measure principal distance, principal point and distortion: a pinhole's spots on the line CCD while a turntable
    turns the camera, with raw and with compensated angles.

    distortion.json: `rms_raw_um` and `rms_compensated_um` are what a laboratory can state, the scatter of the points
    about a smooth curve; how wrong the distortion is stands under `truth`, `error_rms_raw_um` and
    `error_rms_compensated_um`.

    Example: `python -m twin.lab distortion scenes/lab/distortion.yaml`
    """,
    export_distortion,
)

add_test(
    app,
    PROGRAM,
    "turntable",
    resolve_turntable_test,
    LABORATORY_TESTS["turntable"],
    """Calibrate a turntable's dividing error by regional comparison and compare five fits of it on held-out angles.

    Example: `python -m twin.lab turntable scenes/lab/turntable.yaml --seed 2`
    """,
    export_turntable,
)


if __name__ == "__main__":
    app()
