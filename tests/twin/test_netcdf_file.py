"""netCDF files follow CF 1.11: units that UDUNITS knows, names of quantities, no gaps in coordinates."""

import io

import h5py
import numpy as np
import pytest
import xarray as xr

from scenes.specs.study import UNITS
from twin.run.data_files import COUNTS, SPELT, follow_cf, netcdf

UDUNITS = {
    *("arcsec", "arcmin", "milliarcsec", "degree", "rad", "urad", "mrad", "pm", "nm", "um", "mm", "m", "km"),
    *("us", "ms", "s", "K", "mK", "percent", "ppm", "mW", "W", "K/m", "m/s", "1/m", "1"),
}
"""Units of which UDUNITS 2.2 was asked (by cf_units 3): it knows them, and knows none of COUNTS."""


def data_set() -> xr.Dataset:
    variables = {
        "shift": (("run", "axis"), np.array([[1.0, np.nan], [3.0, 4.0]]), {"units": "px", "long_name": "shift"}),
        "error": ("run", np.array([0.1, 0.2]), {"units": "waves rms", "long_name": "error"}),
        "angle": ("run", np.array([0.1, 0.2]), {"units": "mas", "long_name": "angle"}),
        "share": ("run", np.array([1, 0], np.int8), {"units": "", "long_name": "share"}),
        "why": ("run", np.array(["", "it was dark"], object), {"units": "", "long_name": "why"}),
    }
    coords = {"run": ("run", np.array([0.0, 1.0]), {"units": "s", "long_name": "time"})}
    return xr.Dataset(variables, coords, {"title": "a test", "reference_frames": "none"})


@pytest.mark.second
def test_units_are_those_that_udunits_knows_and_the_numbers_stay() -> None:
    given = data_set()
    content = netcdf(given)
    assert content == netcdf(given)  # no time of the day
    with h5py.File(io.BytesIO(content)) as file:
        told = {name: {k: v for k, v in file[name].attrs.items() if k in ("units", "counted_in")} for name in file}
        assert told["shift"] == {"units": "1", "counted_in": "px"}
        assert told["error"] == {"units": "1", "counted_in": "waves rms"}
        assert told["angle"] == {"units": "milliarcsec"}
        assert told["share"] == {"units": "1"}
        assert told["why"] == {}
        assert file.attrs["Conventions"] == "CF-1.11"
        assert "_FillValue" not in file["run"].attrs
        assert np.isnan(file["shift"].attrs["_FillValue"])
    with xr.open_dataset(io.BytesIO(content), engine="h5netcdf", decode_timedelta=False) as read:
        for name in given.variables:
            np.testing.assert_array_equal(read[name].values, given[name].values)
    assert given["shift"].attrs["units"] == "px"  # what a script holds keeps its units


@pytest.mark.parametrize("unit", sorted({*UNITS.values(), *SPELT, *COUNTS}))
def test_every_unit_of_results_is_known_or_a_count(unit: str) -> None:
    data = xr.Dataset({"a": ("x", np.zeros(2), {"units": unit})})
    found = follow_cf(data)["a"].attrs
    assert found["units"] in UDUNITS
    assert (found.get("counted_in") == unit) == (unit in COUNTS)
