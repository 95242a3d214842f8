"""Command ``python -m analysis.mtf``: MTF from a slanted edge or a group of bars in an image."""

from __future__ import annotations

if __name__ == "__main__":
    import os
    import sys

    def _interrupted(kind: Any, error: Any, trace: Any) -> None:
        """Print one line instead of a traceback for Ctrl-C during the imports and help that cannot be written."""
        if issubclass(kind, KeyboardInterrupt):
            sys.stderr.write("interrupted\n")
        elif isinstance(error, OSError) and error.strerror and error.filename is None:
            sys.stderr.write(f"error: cannot write to the standard output: {error.strerror}\n")
            # otherwise the interpreter would try again to write the buffers at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        else:
            sys.__excepthook__(kind, error, trace)

    sys.excepthook = _interrupted

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    image: Annotated[
        Path, typer.Argument(help="TIFF, FITS, PNG or JPEG; integers or real numbers.", show_default=False)
    ],
    roi: Annotated[
        str, typer.Option(help="Region ROW,COLUMN,HEIGHT,WIDTH in pixels; the first pixel is 0,0.", show_default=False)
    ],
    pitch: Annotated[
        str | None, typer.Option(help='Pixel pitch with its unit: "7 um", "0.007 mm". Required.', show_default=False)
    ] = None,
    pixel_size: Annotated[str | None, typer.Option(hidden=True)] = None,
    bars: Annotated[
        str | None,
        typer.Option(
            help='Measure bars of this frequency: "71.4 cycles/mm" or "0.5 cycles/pixel". Needs --dark, --bright.'
        ),
    ] = None,
    dark: Annotated[str | None, typer.Option(help="With --bars: the dark level, see below.")] = None,
    bright: Annotated[str | None, typer.Option(help="With --bars: the bright level, see below.")] = None,
    saturation: Annotated[
        float | None,
        typer.Option(help="Grey value of saturation. Default: the file type's largest, or a plateau of equal values."),
    ] = None,
    offset: Annotated[float, typer.Option(help="Grey value without light; subtracted from levels and contrast.")] = 0.0,
    frames: Annotated[
        int | None,
        typer.Option(
            min=1, help="Average this many pages of a multi-page TIFF or planes of a FITS cube. Default: all."
        ),
    ] = None,
    page: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Read this page of a TIFF or plane of a FITS cube only; the first is 0. Default: the mean of all.",
        ),
    ] = None,
    gamma: Annotated[
        str | None,
        typer.Option(
            help="Undo the tone curve of an integer image: srgb, or an exponent such as 2.2. 1: it is linear."
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(readable=False, help="Write a plot: .png, .pdf or .svg.")] = None,
    csv_file: Annotated[Path | None, typer.Option("--csv", readable=False, help="Write the curve as CSV.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout, and nothing else.")] = False,
) -> None:
    """Measure the MTF of a camera from an image of a slanted edge (ISO 12233) or of bars.

    **Edge.** Choose a region with one straight edge between a dark and a bright even area, tilted by 2 to 10 deg
    against the rows or columns: 64 x 64 pixels or more, at least 32 across the edge, the edge in its middle. A
    near-vertical or near-horizontal edge is detected; frequencies are counted along the edge's normal. sigma comes from
    the noise in the region, bias is the mean amount by which noise raises the MTF (not subtracted).

    **Bars.** Choose a region inside a group of equal bars and spaces, slightly tilted. The amplitude of the
    fundamental gives the MTF at that one frequency. --dark and --bright are the levels of spaces and bars: preferably
    images of the closed shutter and of the light without target (their mean over the same region), otherwise even
    patches ROW,COLUMN,HEIGHT,WIDTH in the image. Light that diffraction removes from a patch is not included in sigma:
    it makes the MTF too high, by about a per cent with patches 10 pixels from everything else, F/9 and 7 um.

    Grey values must be linear in light: raw frames. For a picture with a tone curve give --gamma; a JPEG without it is
    used unchanged, with a warning. Colour becomes the luminance of linear RGB (0.2126 R + 0.7152 G + 0.0722 B).

    **Pages** of a TIFF and planes of a FITS cube are averaged. If the edge moves or rotates from page to page (false
    alarm: 1 image in 10 000), the pages are aligned first, with a warning; bars that move are refused. --saturation and
    --offset are grey values linear in light.

    Example, with images of `python -m twin.render scenes/examples/targets.yaml --out runs/targets`:
    `python -m analysis.mtf runs/targets/images/forward_centre_knife_edge_along_before.tiff --roi 24,24,64,64
    --pitch "7 um" --plot mtf.png`

    Exit codes: 0 measured; 2 bad input, with a sentence that says what to change; 1 the result cannot be printed.
    With exit code 2 no file is written.
    """
    options = locals()
    # imported here, so that help is printed without loading the numerical packages
    from analysis.mtf.mtf_command import run_mtf

    run_mtf(**options)


if __name__ == "__main__":
    app()
