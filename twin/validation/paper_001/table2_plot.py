"""Picture of paper 001's principle experiment: the bench with its rays, and the differences from row to row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.units import ARCSEC
from optics.numerics.quadrature import PupilNodes
from scenes.models.autocollimator_model import UNITS, mirror_body
from twin.laboratory.autocollimator_bench import Reader, ReadingTable
from twin.laboratory.autocollimator_images import AutocollimatorPath
from twin.run.svg import BLUE, GREY, INK, LIGHT, ORANGE, VERMILION, look, to_png
from twin.validation.checks.printed import load_printed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 130
_ACROSS = PupilNodes(np.array([0.0, 0.0, 0.0]), np.array([-1.0, 0.0, 1.0]), np.full(3, 1.0 / 3.0))
_TITLES = {
    "X": "about X: mirror 1 − mirror 2",
    "Y": "about Y: mirror 1 − mirror 2 / cos 30°",
    "Z": "about Z: turntable − mirror 2 / sin 60°",
}


def bench_png(reader: Reader, tables: Sequence[ReadingTable]) -> bytes:
    """The picture as PNG.

    Args:
        reader: of the experiment.
        tables: rendered benches, each with the series of Table 2.
    """
    from matplotlib.figure import Figure

    with look("principle"):
        figure = Figure(figsize=(13.0, 7.4), layout="constrained", facecolor="white")
        grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0))
        axes = figure.add_subplot(grid[:, 0])
        _bench(axes, AutocollimatorPath(reader.path(reader.spec.programme.wide).bench, reader.backend, _ACROSS))
        for i, axis in enumerate(_TITLES):
            _differences(figure.add_subplot(grid[i, 1]), tables, axis, i == 2)
        return to_png(figure, DPI)


def _plan(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (..., 3) of the bench lie on paper, seen from above (X up): Z to the right, Y down, millimetres."""
    return 1e3 * points[..., 2], -1e3 * points[..., 1]


def _bench(axes: Axes, path: AutocollimatorPath) -> None:
    from matplotlib.patches import Circle

    bench, spec = path.bench, path.bench.spec
    placed = bench.assembly.place()
    for n, unit in enumerate(UNITS):
        colour = (BLUE, VERMILION)[n]
        for ray in path.polylines({})[n]:
            axes.plot(*_plan(ray), color=colour, lw=0.8, alpha=0.8)
        frame = bench.frame(unit)
        front = -spec.autocollimator.distance * frame[:, 2]
        across, view = frame[:, 1], frame[:, 2]
        lens = spec.autocollimator.lens
        rim = 0.5 * lens.diameter * np.array([-1.0, 1.0])[:, None] * across
        for depth in (0.0, lens.thickness):
            axes.plot(*_plan(front - depth * view + rim), color=INK, lw=1.2)
        image = front - (lens.thickness + lens.focal_distance) * view
        chip = 0.5 * spec.autocollimator.area_ccd.columns * spec.autocollimator.area_ccd.pitch
        axes.plot(*_plan(image + np.array([-chip, chip])[:, None] * across), color=INK, lw=4)
        mirror = placed.pose(mirror_body(unit))
        edge = 0.5 * spec.mirrors.aperture * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        axes.plot(*_plan(mirror.apply(edge)), color=INK, lw=3.5)
        # the names stand beside the beams, away from the other autocollimator
        beside = across * (-1.0 if unit == 1 else 1.0)
        place: dict[str, Any] = {"ha": "center" if unit == 1 else "left", "va": "center"}
        axes.annotate(f"autocollimator {unit}", _plan(image + 0.05 * beside + 0.14 * view), color=colour, **place)
        axes.annotate(f"mirror {unit}", _plan(mirror.translation + 0.05 * beside - 0.06 * view), **place)
        for vector, name in ((across, "Y"), (view, "Z")):
            tip = _plan(0.1 * vector)
            axes.annotate("", tip, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2})
            axes.annotate(f"{name}$_{unit}$", _plan(0.122 * vector), color=colour, ha="center", va="center")
    axes.add_patch(Circle((0.0, 0.0), 1e3 * (spec.mirrors.radius + 0.03), fill=False, color=GREY, lw=1.0, ls="--"))
    axes.annotate("turntable", (140.0, 175.0), color=GREY, ha="center")
    title = f"From above (X toward you), mirrors {np.degrees(bench.between):.0f}° apart; mm"
    axes.set(aspect="equal", title=title, xlabel="Z", ylabel="−Y")
    axes.grid(color=LIGHT, lw=0.5)


def _differences(axes: Axes, tables: Sequence[ReadingTable], axis: str, last: bool) -> None:
    for k, table in enumerate(tables):
        result = table[axis]
        first, second = result.columns
        start = result.series.angles if axis == "Z" else first
        label = f"rendered, {len(tables)} bench{'es' if len(tables) > 1 else ''}" if k == 0 else None
        axes.plot(result.series.angles / ARCSEC, (start - second) / ARCSEC, color=BLUE, lw=0.9, alpha=0.6, label=label)
    printed = load_printed("001")
    turns, mirror_1 = (printed.column("table2.turn_arcsec"), printed.columns("table2.mirror_1_arcsec"))
    difference = np.array(turns if axis == "Z" else mirror_1[axis]) - printed.columns("table2.mirror_2_arcsec")[axis]
    axes.plot(turns, difference, "o-", color=ORANGE, ms=4, lw=1.2, label="printed Table 2")
    axes.axhline(0.0, color=GREY, lw=0.7)
    axes.set(title=_TITLES[axis], ylabel="arcsec")
    if last:
        axes.set_xlabel("turn of the table, arcsec")
        most = max(float(np.max(np.abs(t["Z"].columns[0]))) for t in tables) / ARCSEC
        text = f"mirror 1: rendered at most {most:.1f}″ (it turns about its normal), printed {mirror_1['Z'][-1]}″"
        axes.text(0.02, 0.04, text, transform=axes.transAxes, color=INK, fontsize=8)
    axes.legend(loc="upper left", fontsize=8)
    axes.margins(y=0.2)
    axes.grid(color=LIGHT, lw=0.5)
