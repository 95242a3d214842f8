"""Files of wavefronts: the same map whatever the format, a real interferogram as prysm reads it, and spoilt files."""

import hashlib
import math
import os
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from astropy.io import fits

from analysis.wavefront_maps.map_files import MapError, read_map
from analysis.wavefront_maps.zernike_table import read_zernikes
from tests.analysis import wavefront_files as write
from tests.analysis.refusals import refuses, spoilt

WAVE = write.wave()


def same(found: np.ndarray, expected: np.ndarray, step: float) -> None:
    """Equal but for the rounding of a file that keeps whole steps."""
    assert found.shape == expected.shape
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) <= 0.5 * step + 1e-21


@pytest.mark.parametrize("form", [1, 2, 3])
@pytest.mark.parametrize("resolution", [0, 1, 2])
def test_metropro_of_every_form(tmp_path, form, resolution):
    path = tmp_path / "a.bin"
    write.metropro(path, WAVE, form, frames=form, resolution=resolution, obliquity=1.25)
    found = read_map(path)
    same(found.values, WAVE, 0.5 * 1.25 * 632.8e-9 / (4096, 32768, 131072)[resolution])
    assert found.spacing == pytest.approx(1e-4, rel=1e-7)
    assert found.wavelength == pytest.approx(632.8e-9, rel=1e-7)
    assert (found.scale_factor, found.obliquity, found.what) == (0.5, 1.25, None)
    assert "0.5 waves per fringe" in found.notes[0]


@pytest.mark.parametrize("frames", [0, 1])
def test_frames_that_the_header_does_not_count(tmp_path, frames):
    write.metropro(tmp_path / "a.dat", WAVE, frames=frames, counted=0)
    same(read_map(tmp_path / "a.dat").values, WAVE, 0.5 * 632.8e-9 / 32768)


def test_what_the_header_of_metropro_says(tmp_path):
    path = tmp_path / "a.dat"
    write.metropro(path, WAVE, sign=1, codev=1, spacing=0.0)
    found = read_map(path)
    assert found.what == "surface"
    assert math.isnan(found.spacing)
    assert any("sign of the data is inverted" in note for note in found.notes)


def test_a_real_interferogram_is_read_as_prysm_reads_it(tmp_path):
    """Frozen of prysm.io.read_zygo_dat (2026, whose rows grow upwards) of the original file: its phase in nanometres as
    bytes. From our metres, the stored counts come back as whole numbers, and they give its bytes to the last bit.
    """
    found = read_map(write.real_file(tmp_path))
    one = float(np.float32(6.327999813038332e-07)) * 0.5 / 32768
    counts = np.rint(found.values / one)
    np.testing.assert_array_equal(found.values, counts * one)
    assert hashlib.sha256((counts * (one * 1e9)).tobytes()).hexdigest() == (
        "3d8b5ad927f26494a6d56700019e4e01f6ce67bae08ffedc9521d6abbab9682c"
    )
    assert found.values.shape == (432, 425)
    assert np.isnan(found.values).sum() == 47241
    assert found.spacing == 0.00011792420264100656
    # two orders of multiplication differ by a rounding
    for place, nanometres in (((216, 212), -30.512206129762465), ((100, 150), -12.93872032084864)):
        assert found.values[place] * 1e9 == pytest.approx(nanometres, rel=4e-16)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("unit", ["Fringes", "NanoMeters"])
def test_datx(tmp_path, unit, old):
    path = tmp_path / "a.dat"
    write.datx(path, WAVE, unit, old)
    found = read_map(path)
    np.testing.assert_allclose(found.values, WAVE, rtol=1e-15, atol=0)
    assert (found.spacing, found.wavelength, found.kind) == (2e-4, 632.8e-9, "Zygo datx")
    assert found.scale_factor == (0.5 if unit == "Fringes" else 1.0)


def test_datx_without_a_wavelength_takes_the_stated_one(tmp_path):
    path = tmp_path / "a.datx"
    write.datx(path, WAVE, Wavelength=None)
    refuses(MapError, "state the wavelength", read_map, path)
    found = read_map(path, wavelength=632.8e-9)
    np.testing.assert_allclose(found.values, WAVE, rtol=1e-15, atol=0)


def test_the_first_of_several_surfaces_is_read_and_said(tmp_path):
    path = tmp_path / "a.datx"
    write.datx(path, WAVE)
    with h5py.File(path, "a") as file:
        file.copy("Data/Surface/{A1}", "Data/Surface/{A0}")
        file["Data/Surface/{A0}"][...] = 0.25
    found = read_map(path)
    assert found.values[3, 3] == pytest.approx(0.25 * 0.5 * 0.97 * 632.8e-9)
    assert any("2 surfaces" in note for note in found.notes)


@pytest.mark.parametrize("kind", ["WFR", "SUR"])
def test_codev(tmp_path, kind):
    path = tmp_path / "a.txt"
    write.codev(path, WAVE, kind, "NNB NDA -32768", "! a comment\n")
    found = read_map(path)
    same(found.values, WAVE, 0.6328e-6 / 2000)
    assert found.what == {"WFR": "wavefront", "SUR": "surface"}[kind]
    assert math.isnan(found.spacing)
    assert found.notes == ()
    write.codev(path, WAVE, kind, "")
    without = read_map(path)
    np.testing.assert_array_equal(without.values, found.values)
    assert "-32768" in without.notes[0]


def test_codev_as_prysm_writes_and_reads_it(tmp_path):
    """Frozen of prysm.io.write_codev_gridint and read_codev_gridint (2026), nanometres, rows growing upwards."""
    path = tmp_path / "a.int"
    path.write_text(
        "CV GRD generated by prysm\nGRD 4 4 WFR WVL 1.0 SSZ 236414.1414141414 NDA -32768\n\n"
        + "-18133\n-32768\n3830\n-32767\n14161\n30923\n5154\n-23334\n"
        + "21490\n2080\n-10450\n-14847\n-32768\n-25036\n-4705\n7944\n"
    )
    nan = math.nan
    by_prysm = [
        [nan, -105.8989104892117, -19.901516769920956, 33.602050843836786],
        [90.8998077333903, 8.798120059816279, -44.202093569750055, -62.800811792352064],
        [59.89912411877804, 130.8001281777398, 21.80072634052553, -98.6996795556505],
        [-76.70014954069643, nan, 16.2003845332194, -138.6],
    ]
    np.testing.assert_allclose(read_map(path).values * 1e9, by_prysm, rtol=5e-16, atol=0)


@pytest.mark.parametrize("flag", [0, 1, 2, 3])
def test_zemax(tmp_path, flag):
    path = tmp_path / "a.txt"
    write.zemax(path, WAVE, flag)
    found = read_map(path)
    np.testing.assert_allclose(found.values, WAVE, rtol=1e-14, atol=0)
    assert found.spacing == pytest.approx(2e-4, rel=1e-14)
    assert found.what == "surface"


def test_zemax_without_flags_derivatives_or_shift(tmp_path):
    full = write.wave(lit=False)
    for width, header in ((4, "0 0"), (5, ""), (1, "0 0"), (5, "0.5 0")):
        write.zemax(tmp_path / "a.dat", full, 0, width, header)
        found = read_map(tmp_path / "a.dat")
        np.testing.assert_allclose(found.values, full, rtol=1e-14, atol=0)
        assert any("shift" in note for note in found.notes) == (header == "0.5 0")
    # OpticStudio may write UTF-16
    text = (tmp_path / "a.dat").read_text()
    (tmp_path / "b.dat").write_bytes(text.encode("utf-16"))
    np.testing.assert_allclose(read_map(tmp_path / "b.dat").values, full, rtol=1e-14, atol=0)


def test_fits_says_its_unit(tmp_path):
    path = tmp_path / "a.fits"
    write.fits_map(path, WAVE)
    found = read_map(path)
    np.testing.assert_allclose(found.values, WAVE, rtol=1e-15, atol=0)
    assert (found.spacing, found.wavelength) == (3e-3, None)
    write.fits_map(path, WAVE, "microns")
    np.testing.assert_allclose(read_map(path).values, WAVE * 1e3, rtol=1e-15, atol=0)
    write.fits_map(path, WAVE, None)
    refuses(MapError, "does not state its unit", read_map, path)
    write.fits_map(path, WAVE, "waves")
    refuses(MapError, "does not state the wavelength", read_map, path)
    found = read_map(path, wavelength=5e-7)
    np.testing.assert_allclose(found.values, WAVE * 500.0, rtol=1e-14, atol=0)
    assert found.wavelength == 5e-7


def test_a_scale_in_arcsec_is_no_spacing(tmp_path):
    path = tmp_path / "a.fits"
    write.fits_map(path, WAVE, PIXUNIT="arcsecond")
    assert math.isnan(read_map(path).spacing)


def test_a_cube_of_fits_is_not_one_map(tmp_path):
    path = tmp_path / "a.fits"
    fits.PrimaryHDU(np.stack([WAVE, 2.0 * WAVE])).writeto(path)
    refuses(MapError, "has 2 images", read_map, path)


def test_a_text_table(tmp_path):
    path = tmp_path / "a.csv"
    write.table(path, WAVE)
    found = read_map(path)
    np.testing.assert_allclose(found.values, WAVE, rtol=1e-15, atol=0)
    assert (found.spacing, found.what, found.wavelength) == (pytest.approx(2e-4), "surface", None)
    write.table(path, WAVE, "# wavelength = 632.8 nm\n# any other text\n# unit: waves\n")
    np.testing.assert_allclose(read_map(path).values, WAVE * 632.8, rtol=1e-14, atol=0)
    path.write_text("# unit: um\n1 2 3\n4 nan 6\n")
    np.testing.assert_array_equal(read_map(path).values * 1e6, [[4, math.nan, 6], [1, 2, 3]])


def test_a_table_that_begins_like_zemax_is_a_table(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("# unit: nm\n" + "5 5 1 1 0\n" * 6)
    assert read_map(path).values.shape == (6, 5)


BAD = {
    "transmission": (lambda p: write.codev(p, WAVE, "FIL"), "transmissions"),
    "neither": (lambda p: write.codev(p, WAVE, "NNB"), "neither WFR"),
    "pixels": (lambda p: write.codev(p, WAVE, "SUR", "XSC 1.2"), "not square"),
    "word": (lambda p: write.codev(p, WAVE, "SUR", "FOO 3"), "line 2: 'FOO' is not understood"),
    "value": (lambda p: write.codev(p, WAVE, "SUR", "NDA x"), "line 2: 1 number"),
    "wavelength": (lambda p: p.write_text("t\nGRD 2 2 SUR SSZ 2\n1 2 3 4\n"), "WVL"),
    "size": (lambda p: p.write_text("t\nGRD 2 0 SUR SSZ 2 WVL 1\n1 2 3 4\n"), "grid of 2 x 0"),
    "short": (lambda p: p.write_text("t\nGRD 2 2 SUR SSZ 2 WVL 1\n1 2 3\n"), "has 3 points"),
    "zernikes": (lambda p: p.write_text("t\nZFR 2 SUR SSZ 2 WVL 1\n1 2\n"), "Zernike terms"),
    "huge": (
        lambda p: p.write_text("t\nGRD 2 2 SUR SSZ 1e-300 WVL 1e20\n1 2 3 4\n"),
        "inf m, which is too large for a wavefront",
    ),
    "unit of a table": (lambda p: write.table(p, WAVE, "# unit: m\n"), "check its unit"),
    "letters": (lambda p: p.write_text("t\nGRD 2 2 SUR SSZ 2 WVL 1\n1 2\n3 o\n"), "line 4: 'o' is not a number"),
    "steps": (lambda p: p.write_text("5 5 1 2 0 0 0\n" + "1 0 0 0 0\n" * 25), "not square pixels"),
    "flag": (lambda p: p.write_text("5 5 1 1 7 0 0\n" + "1 0 0 0 0\n" * 25), "unit flag 7"),
    "points": (lambda p: p.write_text("5 5 1 1 0 0 0\n" + "1 0 0 0 0\n" * 24), "has 24 points"),
    "phase": (lambda p: write.metropro(p, np.zeros((0, 0))), "no phase map"),
    "scale": (lambda p: write.metropro(p, WAVE, scale=0.0), "scale factor 0"),
    "dark": (lambda p: write.metropro(p, WAVE * np.nan), "no measured point"),
    "cut": (lambda p: (write.metropro(p, WAVE), p.write_bytes(p.read_bytes()[:-9])), "truncated"),
    "other hdf5": (lambda p: h5py.File(p, "w").close(), "not a .datx file"),
    "no unit": (lambda p: write.datx(p, WAVE, Unit=None), "does not state the unit"),
    "no factor": (lambda p: write.datx(p, WAVE, **{"Interferometric Scale Factor": None}), "no usable"),
    "table unit": (lambda p: write.table(p, WAVE, ""), "does not state its unit"),
    "furlongs": (lambda p: write.table(p, WAVE, "# unit: furlong\n"), "unknown unit 'furlong'"),
    "twice": (lambda p: write.table(p, WAVE, "# unit: nm\n# unit: nm\n"), "line 2: unit is stated twice"),
    "ragged": (lambda p: p.write_text("# unit: nm\n1 2\n1 2\n1 2 3\n"), "line 4: a map has"),
    "binary": (lambda p: p.write_bytes(b"\0\1\2"), "not a wavefront file of a known format"),
    "empty": (lambda p: p.write_bytes(b""), "is empty"),
    "folder": (lambda p: p.mkdir(), "is a folder"),
    "nothing": (lambda p: None, "there is no file"),
    "pipe": (os.mkfifo, "a device, a pipe or a socket"),
    "resolution": (lambda p: patched(p, 218, b"\0\3"), "phase resolution 3; 0, 1 and 2 exist"),
    "no number": (lambda p: p.write_text("5 5 1 1 0 0 0\n" + "inf 0 0 0 0\n" * 25), "a point is not a finite number"),
    "infinite": (lambda p: p.write_text("# unit: nm\n1 2\n3 inf\n"), "holds an infinite number; write nan"),
    "too many": (lambda p: unstored(p, 70_000), "70000 x 70000 points, more than"),
    "2 m": (lambda p: patched(p, 168, b"\x40\0\0\0"), "its header has wavelength 2 m"),
    "size of the phase": (lambda p: patched(p, 68, b"\xff\xff\xff\xff"), "65535 x 65535 points, more than"),
    "line": (lambda p: write.datx(p, WAVE.ravel()), "is not a map of numbers"),
}


def unstored(path, side):
    with h5py.File(path, "w") as file:
        file.create_dataset("Data/Surface/1", (side, side), "f8", chunks=True)


def patched(path, place, data):
    """A MetroPro file with other bytes in its header."""
    write.metropro(path, WAVE)
    whole = path.read_bytes()
    path.write_bytes(whole[:place] + data + whole[place + len(data) :])


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_told_with_their_name(tmp_path, case):
    path = tmp_path / "map.file"
    make, told = BAD[case]
    make(path)
    with pytest.raises(MapError) as error:
        read_map(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
    assert told in str(error.value)


def test_statements_that_are_not_needed_are_refused(tmp_path):
    path = tmp_path / "a.dat"
    write.metropro(path, WAVE)
    refuses(MapError, "cannot be read: Input/output error", read_map, "/proc/self/mem")
    refuses(MapError, "states wavelength", read_map, path, wavelength=5e-7)


@pytest.mark.parametrize("kind", [*write.WRITERS, "zernikes"])
def test_spoilt_files_are_read_or_refused_in_one_sentence(kind, tmp_path):
    path, other = tmp_path / "whole", tmp_path / "spoilt"
    write.zernikes(path) if kind == "zernikes" else write.WRITERS[kind](path, WAVE)
    whole, told = path.read_bytes(), []
    for seed in range(40):
        other.write_bytes(spoilt(whole, seed, {"dat": 834, "datx": 4000, "fits": 600}.get(kind, 120)))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                numbers = read_zernikes(other).coefficients if kind == "zernikes" else read_map(other).values
                assert np.isfinite(numbers).any(), seed
            except MapError as error:
                told.append(str(error))
    assert len(told) > 5
    assert all(str(other) in text and "\n" not in text for text in told)


@pytest.mark.parametrize("where", ["Data", "Data/Surface", "Data/Surface/{A1}", "Measurement/Attributes"])
@pytest.mark.parametrize("soft", [False, True])
def test_a_link_is_not_followed(where: str, soft: bool, tmp_path: Path) -> None:
    """A surface, or what is said of it, that lies in another file or elsewhere in this one."""
    write.datx(tmp_path / "other.h5", write.wave())
    whole = tmp_path / "whole.datx"
    write.datx(whole, write.wave())
    with h5py.File(whole, "a") as file:
        if where.startswith("Data"):
            file.move(where, "kept")
        file[where] = h5py.SoftLink("/kept") if soft else h5py.ExternalLink("other.h5", where)
    refuses(MapError, "is a link to another place", read_map, whole)


def test_a_surface_that_is_stored_in_another_file_is_refused(tmp_path: Path) -> None:
    """External storage and virtual data sets: HDF5 reads bytes of any file that they name, or fills in what is not
    there."""
    whole, name = tmp_path / "whole.datx", "Data/Surface/{A1}"
    (tmp_path / "secret.bin").write_bytes(np.ones((4, 5)).tobytes())
    for kind in ("external", "virtual"):
        write.datx(whole, WAVE)
        with h5py.File(whole, "a") as file:
            said = dict(file[name].attrs)
            del file[name]
            if kind == "external":
                surface = file.create_dataset(name, (4, 5), "f8", external=[(str(tmp_path / "secret.bin"), 0, 160)])
            else:
                layout = h5py.VirtualLayout((4, 5), "f8")
                layout[...] = h5py.VirtualSource(str(tmp_path / "other.h5"), "there", (4, 5))
                surface = file.create_virtual_dataset(name, layout)
            for key in ("Unit", "Wavelength", "Interferometric Scale Factor", "Obliquity Factor"):
                surface.attrs[key] = said[key]
        refuses(MapError, "its surface lies in another file", read_map, whole)
