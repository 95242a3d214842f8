"""netCDF files by the conventions that readers of such files know: CF 1.11 (Climate and Forecast).

CF knows units by UDUNITS and quantities by its table of standard names, in which a camera has few. A unit that UDUNITS
does not know (pixels, waves, grey values) is a count: its ``units`` are 1, and ``counted_in`` says of what.
"""

from __future__ import annotations

import importlib.metadata
import io
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from optics.numerics.frozen_map import FrozenMap

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11"
SPELT: Mapping[str, str] = FrozenMap({"deg": "degree", "mas": "milliarcsec"})
"""Unit as the program writes it -> as UDUNITS does; all that are in neither mapping are the same."""
COUNTS = frozenset(("px", "waves", "DN", "photons"))
"""Units that count something."""
WRITER = "space-camera-twin"


def netcdf(data: xr.Dataset) -> bytes:
    """A data set as the contents of a netCDF-4 file by CF 1.11; the same data give the same bytes.

    Args:
        data: with ``title`` among its attributes; of every variable ``long_name`` and of numbers ``units``, which are 1
            where there are none.
    """
    told = follow_cf(data)
    # coordinates have no gaps
    view = told.to_netcdf(engine="h5netcdf", encoding={name: {"_FillValue": None} for name in told.coords})
    content = bytes(view)
    # xarray hands out a window on its buffer, which complains when it is thrown away with the window still open
    if isinstance(view, memoryview):
        view.release()
    return content


def read_netcdf(content: bytes) -> xr.Dataset:
    """The data set in the bytes of a netCDF file, loaded whole; units of time stay as they are written.

    Raises:
        Exception: the file is damaged, in whatever way the libraries stumble over it; also where they would only warn.
    """
    import h5py
    import xarray as xr

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # where HDF5 cannot open it, h5netcdf would leave half an object that prints an error of its own later
        with h5py.File(io.BytesIO(content)):
            pass
        # read from memory, since of a damaged file the library leaves the file open
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf", decode_timedelta=False) as data:
            return data.load()


def follow_cf(data: xr.Dataset) -> xr.Dataset:
    """The data set with the attributes that CF asks for; values are the same."""
    version = f"{WRITER} {importlib.metadata.version(WRITER)}"
    # CF wants a history, which begins here; it names no time, so that the same run gives the same bytes
    said = {"Conventions": CONVENTIONS, "source": f"simulation by {version}", "history": f"written by {version}"}
    out = data.assign_attrs({**data.attrs, **said})
    for name in out.variables:
        variable = out.variables[name]
        numbers = variable.dtype.kind in "iufb"
        out[name].attrs = _units(variable.attrs, numbers)
    return out


def _units(attributes: Mapping[Any, Any], numbers: bool) -> dict[str, Any]:
    """Attributes of a variable with units that UDUNITS knows; texts have none."""
    rest = {str(key): value for key, value in attributes.items() if key != "units"}
    if not numbers:
        return rest
    unit = str(attributes.get("units", ""))
    counted, _, how = unit.partition(" ")
    if counted in COUNTS:
        return {"units": "1", "counted_in": " ".join(filter(None, (counted, how))), **rest}
    return {"units": SPELT.get(unit, unit) or "1", **rest}
