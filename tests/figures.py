"""Figures that are put together, but come out empty: drawing them takes most of a command that is quick."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from matplotlib.figure import Figure


@contextmanager
def undrawn() -> Iterator[None]:
    """Context in which no figure is drawn as SVG."""
    draw = Figure.savefig

    def savefig(figure: Figure, out: Any, **options: Any) -> None:
        if options.get("format") == "svg" and hasattr(out, "write"):
            out.write("<svg></svg>")
        else:
            draw(figure, out, **options)

    with patch.object(Figure, "savefig", savefig):
        yield
