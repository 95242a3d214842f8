"""Checks without their figures, where a test wants only the verdicts."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from matplotlib.figure import Figure


@contextmanager
def undrawn() -> Iterator[None]:
    """Context in which SVG figures are put together but come out empty; rendering them takes most of a fast check."""
    draw = Figure.savefig

    def savefig(figure: Figure, out, **options) -> None:
        if options.get("format") == "svg":
            out.write("<svg></svg>")
        else:
            draw(figure, out, **options)

    with patch.object(Figure, "savefig", savefig):
        yield
