"""Grey values of a user's images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scenes.yaml.errors import InputError, Issue
from twin.framework.memory import Lowered, require_memory
from twin.orbit.measured.maps import LARGEST_PART, opened

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import ImageWindowSpec, LineImageFileSpec
    from scenes.specs.orbit.rational import RationalImageSpec

_PIXEL = 30.0
"""Memory per pixel of an image, including the part of the maps that shows the same ground, in bytes."""


def read_pixels(
    spec: LineImageFileSpec | RationalImageSpec, part: ImageWindowSpec | None, count: int
) -> NDArray[np.generic]:
    """Return grey values (rows, columns) of an image or of a part of it.

    Parameters
    ----------
    spec : LineImageFileSpec or RationalImageSpec
        Path and band of the image.
    part : ImageWindowSpec or None
        Part of the image; None for all of it.
    count : int
        Number of such images, which must fit into the memory together.

    Raises
    ------
    InputError
        The file cannot be read, or the image is too large.
    """
    file = str(spec.file)
    with opened(file) as source:
        from rasterio.windows import Window as Part

        if not 1 <= spec.band <= source.count:
            raise spec.error("no such band", ("band",), value=spec.band, allowed=f"1 to {source.count}")
        shape = (source.height, source.width)
        row, column, rows, columns = (
            (0, 0, *shape) if part is None else (part.row, part.column, part.rows, part.columns)
        )
        if row + rows > shape[0] or column + columns > shape[1]:
            allowed = f"within {shape[0]} rows and {shape[1]} columns"
            raise spec.error("a window outside of the image", ("window",), allowed=allowed)
        if rows * columns > LARGEST_PART:
            value, allowed = f"{rows} x {columns} pixels", f"a `window:` of at most {LARGEST_PART:.0e} pixels"
            raise spec.error("too large an image to be matched at once", ("window",), value=value, allowed=allowed)
        key = ("file",) if part is None else ("window", "rows")
        unit = "rows in a `window`" if part is None else "rows"
        require_memory(Lowered(spec, key, rows, unit, lambda n: n * columns * count * _PIXEL, 32))
        values = np.asarray(source.read(spec.band, window=Part(column, row, columns, rows)))
    if values.dtype.kind not in "uif":
        raise InputError(Issue("not grey values", file, value=str(values.dtype), allowed="real numbers"))
    if not np.all(np.isfinite(values)):
        raise InputError(Issue("grey values that are not finite", file, allowed="images without gaps, or a `window:`"))
    return values if values.dtype == np.uint16 else values.astype(np.float32)
