"""Command ``python -m twin.lab``: laboratory tests of a camera (paper 004, Li et al. 2020).

The tests are simulated, or evaluated from files of measurements.
"""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from twin.framework.cli import program
from twin.framework.command import add_tests

app = program(no_args_is_help=True)


@app.callback()
def main() -> None:
    """Test a camera in the laboratory as paper 004 (Li et al. 2020) does.

    Every image is rendered through the traced camera, noise included, and only images and readings reach the analysis.

    With `measured:` in the test's file, tables and images of a real bench go through the same analysis
    (docs/measured_laboratory.md); `--export DIR` writes those of a simulated bench as such files.

    Examples of all three files are in scenes/lab, and of measurements in scenes/lab/measured. The run folder gets
    config.yaml, the numbers as JSON, a self-contained report.html, figures and tables in artefacts/ and recorded frames
    in images/.

    Example: `python -m twin.lab turntable scenes/lab/turntable.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


add_tests(app, "lab")


if __name__ == "__main__":
    app()
