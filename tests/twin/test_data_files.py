"""What files of frames, tables and grids say of themselves to any reader, and numbers of a run as JSON holds them."""

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr

from optics.numerics.number_tree import FrozenMap
from scenes.specs.study import UNITS
from twin.framework.data_files import (
    COUNTS,
    UDUNITS_NAMES,
    WRITER,
    FrameFacts,
    GridData,
    csv_table,
    follow_cf,
    frame_files,
    netcdf,
    tiff,
)
from twin.framework.record import plain_data

FRAMES = np.arange(3 * 5 * 4, dtype=np.uint16).reshape(3, 5, 4)
FACTS = FrameFacts("forward, left area CCD", 5.5e-6, 0.01, (0.0, 720.0, 1800.0), "perturbed")


def test_tags_say_pitch_exposure_camera_and_time(tmp_path) -> None:
    content = tiff(FRAMES, FACTS)
    assert content == tiff(FRAMES, FACTS)  # no time of the day
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        assert len(file.pages) == 3
        for k, page in enumerate(file.pages):
            tags = {tag.name: tag.value for tag in page.tags.values()}
            for name in ("XResolution", "YResolution"):
                per_cm, one = tags[name]
                assert 1e-2 * one / per_cm == pytest.approx(5.5e-6, rel=1e-6)
            assert tags["ResolutionUnit"].name == "CENTIMETER"
            assert tags["Model"] == "forward, left area CCD"
            assert tags["ExposureTime"] == (10_000, 1_000_000)
            assert tags["Software"] == WRITER
            assert json.loads(tags["ImageDescription"]) == {
                "camera": "forward, left area CCD",
                "frame": k + 1,
                "pitch_um": 5.5,
                "exposure_s": 0.01,
                "time_s": FACTS.times[k],
                "note": "perturbed",
            }
    path = tmp_path / "frames.tiff"
    path.write_bytes(content)
    np.testing.assert_array_equal(tifffile.imread(path), FRAMES)
    read, pages = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)
    assert read
    np.testing.assert_array_equal(np.array(pages), FRAMES)


def test_what_nobody_knows_is_not_said() -> None:
    with tifffile.TiffFile(io.BytesIO(dict(frame_files("x", FRAMES, FrameFacts()))["images/x.tiff"])) as file:
        tags = {tag.name: tag.value for tag in file.pages[0].tags.values()}
    assert json.loads(tags["ImageDescription"]) == {"frame": 1}
    assert not {"Model", "ExposureTime"} & set(tags)


def test_no_cell_of_a_table_is_a_formula() -> None:
    """Names of users come into tables, and a spreadsheet would work them out; numbers stay numbers."""
    evil = ["=HYPERLINK(1)", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "=1"]
    same = ["-5", "+1e-3", "-.5", "-inf", "M1 = M2", "-", "", "a@b"]
    rows = list(csv.reader(io.StringIO(csv_table([evil + same, [-5.0, None]]).decode())))
    assert rows == [[f"'{cell}" for cell in evil] + same, ["-5.0", ""]]


# --- netCDF files follow CF 1.11 --------------------------------------------------------------------------------------


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
    with pytest.raises(TypeError, match="n: int64 values cannot be written; only real numbers and texts can"):
        netcdf(GridData({"n": ("x", np.arange(3), {})}, {}, {"title": "whole numbers"}))


def test_every_unit_of_results_is_known_or_a_count() -> None:
    for unit in {*UNITS.values(), *UDUNITS_NAMES, *COUNTS}:
        found = follow_cf(xr.Dataset({"a": ("x", np.zeros(2), {"units": unit})}))["a"].attrs
        assert found["units"] in UDUNITS, unit
        assert (found.get("counted_in") == unit) == (unit in COUNTS), unit


# --- numbers as JSON, from dataclasses whose fields are the keys ------------------------------------------------------


@dataclass(frozen=True)
class Place:
    x_um: float
    y_um: float


@dataclass(frozen=True)
class Shift(Place):
    sigma_um: np.ndarray
    of: Mapping[str, Place]
    rounds: tuple[Place, ...] = ()
    why: str | None = None


PLACES = FrozenMap({"b": Place(1.0, 2.0), "a": Place(3.0, 4.0)})
SHIFT = Shift(1.5, -0.0, np.array([[0.1, 0.2]]), PLACES, (Place(5, 6),))


def test_fields_are_keys_in_their_order_those_of_a_base_first() -> None:
    assert json.dumps(plain_data(SHIFT)) == (
        '{"x_um": 1.5, "y_um": -0.0, "sigma_um": [[0.1, 0.2]], '
        '"of": {"b": {"x_um": 1.0, "y_um": 2.0}, "a": {"x_um": 3.0, "y_um": 4.0}}, '
        '"rounds": [{"x_um": 5, "y_um": 6}], "why": null}'
    )


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.float64(0.1), 0.1),
        (np.float32(0.1), 0.10000000149011612),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (True, True),
        (np.array(2.5), 2.5),
        (np.array([True, False]), [True, False]),
        ((), []),
        ({}, {}),
    ],
)
def test_numbers_keep_their_kind_and_all_digits(value, plain) -> None:
    found = plain_data(value)
    assert found == plain
    assert type(found) is type(plain)


def test_plain_data_stay_as_they_are() -> None:
    once = plain_data(SHIFT)
    assert plain_data(once) == once


@pytest.mark.parametrize("value", [1j, {1: "one"}, {"a", "b"}, object(), Place, np.array([1j]), [b"bytes"]])
def test_what_json_cannot_hold_is_refused(value) -> None:
    with pytest.raises(TypeError):
        plain_data(value)
