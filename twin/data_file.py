"""Data in formats that other programs read, as the contents of files.

They are made in memory: on a full disk HDF5 crashes the process, and nothing says why.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

import xarray as xr


def netcdf(data: xr.Dataset) -> bytes:
    """A data set as the contents of a netCDF-4 file; the same data give the same bytes."""
    view = data.to_netcdf(engine="h5netcdf")
    content = bytes(view)
    # xarray hands out a window on its buffer, which complains when it is thrown away with the window still open
    if isinstance(view, memoryview):
        view.release()
    return content


def csv_table(rows: Iterable[Sequence[Any]]) -> bytes:
    """Rows, the heads first, as the contents of a CSV file in UTF-8: numbers with all digits, None as an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
