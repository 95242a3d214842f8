"""Drawing of docs/growth.svg, the growth of processor time with problem size, from the numbers of a benchmark.

To measure and draw it again:

    python -m tests.benchmarks --only growth --json > docs/figures/growth.json python -m docs.figures.growth
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from twin.framework.svg import BLUE, GREY, INK, look, new_figure, to_svg

ROOT = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_name("growth.json")
PICTURE = ROOT / "docs/growth.svg"
TITLES = {
    "states": ("states, one frame of 48 × 48 px", "states"),
    "pixels": ("one state's images and a frame", "pixels on a side of each CCD"),
    "bodies": ("100 states placed", "bodies"),
    "frames": ("frames of 96 × 96 px", "frames"),
}


def times(numbers: dict[str, float], key: str) -> tuple[np.ndarray, np.ndarray]:
    """Return sizes and seconds of one growth.

    Parameters
    ----------
    numbers : dict[str, float]
        Numbers of the benchmark.
    key : str
        Key of the growth, one of ``TITLES``.
    """
    seconds = {int(m[1]): value for name, value in numbers.items() if (m := re.fullmatch(rf"{key}_(\d+)_s", name))}
    sizes = np.array(sorted(seconds))
    return sizes, np.array([seconds[size] for size in sizes.tolist()])


def drawn(numbers: dict[str, float]) -> str:
    """Return the picture as SVG.

    Parameters
    ----------
    numbers : dict[str, float]
        Numbers of the benchmark ``growth``.
    """
    with look("growth"):
        figure = new_figure(2.9)
        panels = figure.subplots(1, len(TITLES))
        for panel, (key, (title, label)) in zip(panels, TITLES.items(), strict=True):
            sizes, seconds = times(numbers, key)
            panel.loglog(sizes, seconds, "o-", color=BLUE, markersize=4, linewidth=1.2)
            slope = numbers[f"{key}_slope"]
            line = seconds[-1] * (sizes / sizes[-1]) ** slope
            panel.loglog(sizes, line, "--", color=GREY, linewidth=0.8)
            panel.set_title(title)
            panel.set_xlabel(label)
            panel.text(0.05, 0.9, f"slope {slope:.2f}", transform=panel.transAxes, color=INK)
        panels[0].set_ylabel("processor time [s]")
        return to_svg(figure)


if __name__ == "__main__":
    PICTURE.write_text(drawn(json.loads(FILE.read_text("utf-8"))["growth"]), "utf-8")
