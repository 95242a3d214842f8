"""When frames were recorded and what they are of, as far as their file says so.

The time at which a file was written or changed is not looked at: a copy has another one.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from analysis.images import fits_image, tiff_image

__all__ = ["recorded"]


def recorded(path: Path) -> tuple[datetime | None, str]:
    """Time of the first frame, UTC if the file names no time zone, None where it does not say; and the note in it.

    Args:
        path: of an image file.
    """
    # a header that cannot be read says nothing; whether the image can be is told where it is
    try:
        with path.open("rb") as file:
            magic = file.read(9)
        if magic.startswith(tiff_image.MAGIC):
            return tiff_image.tiff_origin(path)
        if magic == fits_image.MAGIC:
            return fits_image.fits_time(path), ""
    except Exception:
        return None, ""
    return None, ""
