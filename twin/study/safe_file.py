"""Files that outlive a failure of the power."""

from __future__ import annotations

import os
from pathlib import Path

PARTIAL = ".partial"


def write_safely(place: Path, content: bytes) -> None:
    """Write a file so that under its name it is whole or not there, whenever the power fails.

    Until then it is a hidden file beside its place that ends in ``PARTIAL``.

    Raises:
        OSError: the disk is full, or gone.
    """
    partial = place.with_name(f".{place.name}{PARTIAL}")
    with partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(place)
    folder = os.open(place.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
