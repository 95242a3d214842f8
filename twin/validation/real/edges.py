"""Slanted edges: the photograph of another project, beside the spatial frequency response that its program gives."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from analysis.images.image_file import ImageFile, Region
from analysis.mtf.edge_pages import grey_step, measure_pages
from analysis.mtf.slanted_edge import EdgeMtf
from twin.framework.svg import AFTER, BEFORE, INK
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.measured_data import on_files
from twin.validation.row_names import REAL

IMAGES = {"colour": "Test_edge1.tif", "mono": "Test_edge1_mono.tif"}
ORDERS = (1, 5)
"""Orders of the polynomial by which the other program follows the edge."""


def measured_edge(path: Path) -> EdgeMtf:
    """Return the MTF of the edge in a whole image, whose grey values are taken as linear."""
    source = ImageFile.open(path, None, None)
    image = source.read({"roi": Region(0, 0, source.header.rows, source.header.columns)}, "1")["roi"]
    return measure_pages(image, step=grey_step(image))


@drawing("real-edges", 3.6)
def edges_svg(figure: Figure, edges: dict[str, EdgeMtf]) -> None:
    """Draw the curves measured here and the points of the other program, along its rows."""
    printed = load_printed(REAL)
    frequency = np.array(printed.column("sfrmat5.frequency"))
    for axes, (name, edge) in zip(np.atleast_1d(figure.subplots(1, len(edges))), edges.items(), strict=True):
        fine = np.linspace(0.0, 0.5, 101)[1:]
        axes.plot(fine, [edge.at(f / np.cos(edge.angle))[0] for f in fine], color=INK, lw=1.2, label="measured here")
        for order, colour in zip(ORDERS, (AFTER, BEFORE), strict=True):
            values = printed.column(f"sfrmat5.{name}.order_{order}")
            axes.plot(frequency, values, "o", ms=4, color=colour, label=f"sfrmat5, order {order}")
        axes.set(title=IMAGES[name], xlabel="cycles per pixel along rows", ylim=(0.0, 1.0))
        axes.legend()


def _rows(context: Context, paths: list[Path], name: str, edges: dict[str, EdgeMtf]) -> Iterator[CheckResult]:
    printed = load_printed(REAL)
    frequency = np.array(printed.column("sfrmat5.frequency"))
    edge = edges[name] = measured_edge(paths[0])
    cosine = float(np.cos(edge.angle))
    values, sigmas = np.transpose([edge.at(f / cosine) for f in frequency])
    half, half_sigma = edge.frequency_at(0.5)
    for order in ORDERS:
        other = np.array(printed.column(f"sfrmat5.{name}.order_{order}"))
        worst = int(np.argmax(np.abs(values - other)))
        facts = {"values": values, "other": other, "difference": values - other, "doubt": edge.doubt or "none"}
        yield context.row(
            f"real.edges.{name}.sfr_order_{order}",
            float(abs(values - other)[worst]),
            float(sigmas[worst]),
            0.0,
            **facts,
        )
        yield context.row(
            f"real.edges.{name}.sfr50_order_{order}", half * cosine, half_sigma * cosine, cosine=100 * (1 - cosine)
        )


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the rows on slanted edges."""
    edges: dict[str, EdgeMtf] = {}
    for name, file in IMAGES.items():
        yield from on_files(context, f"real.edges.{name}", f"edge/{file}", partial(_rows, name=name, edges=edges))
    if edges:
        context.figure("sfr", edges_svg(edges))


GROUP = group_of("real.edges", run)
