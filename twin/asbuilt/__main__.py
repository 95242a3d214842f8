"""Command line program ``python -m twin.asbuilt``: as-built state of an instrument from all measurements on it."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from twin.framework.cli import program, unnamed
from twin.framework.command import add_tests

app = program(cls=unnamed(lambda args: "estimate"), no_args_is_help=True)


@app.callback()
def main() -> None:
    """Estimate the as-built state of an instrument from all measurements on it.

    The measurements are wavefronts, images of stars, foci, distortion, MTF, monitor spots, lines of sight, temperatures
    and positions. The state is the position, shape and temperature of its bodies against the drawing, and terms of the
    wavefront. The report predicts the image quality and the actuator move that would improve it.

    `python -m twin.asbuilt FILE` is `python -m twin.asbuilt estimate FILE`.

    Example: `python -m twin.asbuilt scenes/examples/asbuilt_gf7.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


add_tests(app, "asbuilt")


if __name__ == "__main__":
    app()
