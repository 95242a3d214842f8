"""What matching of points in line images takes of memory and time, from the headers of the images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.yaml.errors import InputError
from twin.orbit.images.simulate_cost import MEASURED_SECONDS
from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.measured.orbit_data import LineImageFileSpec
    from scenes.specs.measured.orbit_data_setup import MatchSetup

STARTED, STARTED_SECONDS = 250e6, 5.0
"""Of matching in small images: what reads maps and draws the report, most of all; bytes and seconds."""
PIXEL = 30.0
"""Bytes per pixel of all images, with the part of the maps that they show."""


def match_cost(setup: MatchSetup) -> Cost:
    """What `run_match` and its report take.

    Args:
        setup: the test; headers of its images are read. One that cannot be read is told later.
    """
    images = setup.test.images
    sizes = {name: _size(one) for name, one in images.items()}
    pixels = sum(rows * columns for rows, columns in sizes.values())
    name = max(sizes, key=lambda one: sizes[one][0])
    rows, columns = sizes[name]

    def needed(number: int) -> float:
        return STARTED + (pixels - (rows - number) * columns) * PIXEL

    whole = images[name].window is None
    key = ("images", name, *(("file",) if whole else ("window", "rows")))
    lower = Lowered(setup.test, key, rows, "rows in a `window`" if whole else "rows", needed, 32)
    return Cost(needed(rows), STARTED_SECONDS + pixels * MEASURED_SECONDS, lower)


def _size(image: LineImageFileSpec) -> tuple[int, int]:
    """Rows and columns that are matched."""
    from twin.orbit.measured.geotiff import opened

    if image.window is not None:
        return image.window.rows, image.window.columns
    try:
        with opened(image.file) as source:
            return source.height, source.width
    except InputError:
        return 0, 0
