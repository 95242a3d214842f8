"""Figures of test targets: MTF curves against the truth, and the images before and after."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from twin.report.svg import BLUE, GREY, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg
from twin.target_images import DIRECTIONS
from twin.target_result import NYQUIST, BarReading, CameraTargets, EdgeReading

COLOURS = {"before": BLUE, "after": VERMILION}
MARKS = {"before": "o", "after": "D"}
BAND = 2.0
"""Half width of the band about a measured curve, sigma."""
EVERY = 2
"""Every how many-th frequency gets a dot."""
TITLES = dict(zip(DIRECTIONS, ("along the line", "along the track"), strict=True))
IMAGE_NAMES = {
    "knife_edge_along": "knife edge,\nMTF along line",
    "knife_edge_track": "knife edge,\nMTF along track",
    "bars_along": "bars,\nMTF along line",
    "bars_track": "bars,\nMTF along track",
    "star": "star",
    "pinhole": "pinhole",
}


def curves_svg(name: str, camera: CameraTargets) -> str:
    """Measured and true MTF, a row for each direction and a column for each place."""
    with look(f"mtf-{name}"):
        figure = new_figure(5.6)
        panels = figure.subplots(len(DIRECTIONS), len(camera.places), sharex=True, sharey=True, squeeze=False)
        for column, (place, targets) in enumerate(camera.places.items()):
            for row, direction in enumerate(DIRECTIONS):
                axes = panels[row, column]
                plain_axes(axes)
                axes.grid(color=LIGHT, lw=0.5)
                axes.set_axisbelow(True)
                nyquist = 1e-3 * NYQUIST / camera.pitch
                axes.axvline(nyquist, color=GREY, lw=0.9, ls=(0, (1, 2)), zorder=0)
                for when, shots in targets.shots.items():
                    _curve(axes, when, shots.edges[direction])
                    if direction in shots.bars:
                        _bars(axes, when, shots.bars[direction], camera.pitch)
                axes.set(xlim=(0.0, 2.0 * nyquist), ylim=(0.0, 1.03))
                axes.set_title(f"{place}, {TITLES[direction]}", loc="left")
                if column == 0:
                    axes.set_ylabel("MTF")
                if row == len(DIRECTIONS) - 1:
                    axes.set_xlabel("frequency [cycles/mm]")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        unique = dict(zip(labels, handles, strict=True))
        figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=len(unique))
        return to_svg(figure)


def _curve(axes: Axes, when: str, edge: EdgeReading) -> None:
    colour, frequency = COLOURS[when], 1e-3 * edge.frequency
    axes.plot(frequency, edge.true, color=colour, lw=1.3, label=f"true, {when}")
    found = edge.measured
    if found is None:
        return
    axes.fill_between(
        frequency, found.mtf - BAND * found.sigma, found.mtf + BAND * found.sigma, color=colour, alpha=0.25, lw=0.0
    )
    axes.plot(
        frequency[::EVERY], found.mtf[::EVERY], MARKS[when], color=colour, ms=3.2, mec="white", mew=0.4,
        label=f"measured, {when}",
    )  # fmt: skip


def _bars(axes: Axes, when: str, bars: BarReading, pitch: float) -> None:
    if bars.measured is not None:
        # bars of both states stand at one frequency
        axes.plot(
            1e-3 * NYQUIST / pitch, bars.measured.mtf, "s", color="none", mec=COLOURS[when], mew=1.3, ms=6.5,
            label=f"bars, {when}",
        )  # fmt: skip


def images_svg(name: str, camera: CameraTargets) -> str:
    """Mean images, a row for each target, and before and after side by side for each place."""
    columns = [(place, when) for place in camera.places for when in COLOURS]
    names = list(next(iter(camera.places.values())).before.frames)
    with look(f"targets-{name}"):
        figure = new_figure(0.45 + 1.68 * len(names), {"w_pad": 0.02, "h_pad": 0.02, "wspace": 0.01, "hspace": 0.01})
        grid = figure.subplots(len(names), len(columns), squeeze=False)
        for column, (place, when) in enumerate(columns):
            shots = camera.places[place].shots[when]
            for row, target in enumerate(names):
                axes = grid[row, column]
                mean = np.asarray(shots.frames[target].mean(axis=0))
                axes.imshow(mean, cmap="gray", interpolation="none")
                axes.set_xticks([])
                axes.set_yticks([])
                if row == 0:
                    axes.set_title(f"{place}, {when}")
                if column == 0:
                    axes.set_ylabel(IMAGE_NAMES[target])
        return to_svg(figure)
