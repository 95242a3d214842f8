"""netCDF files follow CF 1.11: units that UDUNITS knows, names of quantities, no gaps in coordinates."""

import io

import h5py
import numpy as np
import pytest
import xarray as xr

from scenes.specs.study import UNITS
from twin.framework.data_files import COUNTS, SPELT, GridData, follow_cf, netcdf

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


def test_without_xarray_the_file_is_the_same_to_the_byte() -> None:
    """With coordinates of an axis, of an axis that has another name, of none, with texts, and in either precision."""
    photons = (("state", "row"), np.array([[1.0, np.nan], [3.0, 4.0]]), {"units": "photons", "long_name": "photons"})
    coords = {
        "state": ("state", ["before", "after"], {"long_name": "when"}),
        "y": ("row", np.array([0.0, 1e-5]), {"units": "m", "long_name": "place"}),
        "wavelength": ((), 6.5e-7, {"units": "m", "long_name": "of the light"}),
    }
    mean = ("state", np.array([1.0, 3.5]), {"units": "deg", "long_name": "angle"})
    single = ("row", np.array([0.1, np.nan], np.float32), {"units": "photons", "long_name": "of a course"})
    data = GridData({"photons": photons, "mean": mean, "single": single}, coords, {"title": "a test", "pitch_m": 1e-5})
    content = netcdf(data)
    assert content == netcdf(data.to_xarray())
    with pytest.raises(TypeError, match="n: neither real numbers nor texts: int64"):
        netcdf(GridData({"n": ("x", np.arange(3), {})}, {}, {"title": "whole numbers"}))


def test_every_unit_of_results_is_known_or_a_count() -> None:
    for unit in {*UNITS.values(), *SPELT, *COUNTS}:
        found = follow_cf(xr.Dataset({"a": ("x", np.zeros(2), {"units": unit})}))["a"].attrs
        assert found["units"] in UDUNITS, unit
        assert (found.get("counted_in") == unit) == (unit in COUNTS), unit
