"""python -m twin.export: frames as FITS that twin.recover reads, tables with units, from run folders of any command."""

import io
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from astropy.io import fits

from analysis.images.image_file import ImageFile
from scenes.specs.monitor_frames import MeasurementSetup
from scenes.specs.resolved import resolve
from tests.twin.commands import files, invoke
from tests.twin.study_bench import ROOT
from twin.export.__main__ import app
from twin.export.export_run import RecordedFrames, expected_fits, frames_fits, read_frames
from twin.framework.data_files import (
    TABLE_FORMATS,
    DataColumn,
    DataTable,
    FrameFacts,
    MapGeoreference,
    MissingPackage,
    csv_table,
    tiff,
)
from twin.framework.run_folder import RunFolder, write_manifest
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_files import irradiance_file, write_results
from twin.main_job.render_job import render_job
from twin.recover.recover_run import recover_numbers, run_recover

JOB = ROOT / "tests/golden/jobs/perturb.yaml"
SEED, FRAMES = 5, 3


@pytest.fixture(scope="module")
def job(backend):
    return render_job(resolve(JOB), backend, FRAMES, SEED)


@pytest.fixture(scope="module")
def run(job, tmp_path_factory) -> Path:
    """A run folder as the main job writes it, with its points as a pass would have them."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    points = [["sort", "point", "line", "height_m", "status"], ["tie", 0, 3.5, 120.25, ""], ["tie", 1, "", 7.0, "dark"]]
    with RunFolder(folder) as target:
        write_results(job, target)
        target.write_bytes("irradiance.nc", irradiance_file(job))
        target.write_bytes("artefacts/points.csv", csv_table(points))
        write_manifest(target, "twin.render", 0.0, 1.0, seed=SEED)
    return folder


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory) -> dict[str, Path]:
    """Format of tables -> folder of an export."""
    place = tmp_path_factory.mktemp("exports")
    for tables in TABLE_FORMATS:
        frames = "fits" if tables == "fits" else "none"
        done = invoke(app, run, "--tables", tables, "--frames", frames, "--out", place / tables, "--quiet")
        assert done.exit_code == 0, done.output
    return {tables: place / tables for tables in TABLE_FORMATS}


# --- frames ----------------------------------------------------------------------------------------------


@pytest.mark.second
def test_exported_frames_give_the_same_readings_to_the_bit(job, exported, backend, tmp_path) -> None:
    file = tmp_path / "measurement.yaml"
    file.write_text(f"instrument: gf7_pair\ndisturbances: orbit\nframes: {exported['fits'] / 'images'}\n")
    found = run_recover(MeasurementSetup.read(file), backend, experiment=job.experiment)
    expected = rounded(job.recovered_dict())
    numbers = recover_numbers(found)
    assert {key: numbers[key] for key in expected} == expected
    assert found.last.recovered_dict() == job.recovered_dict()


def test_times_maps_and_heights_say_where_and_when_they_are(tmp_path) -> None:
    shape = (2, 5, 4)
    frames = np.arange(math.prod(shape), dtype=np.uint16).reshape(shape)
    facts = FrameFacts("forward, left area CCD", 5.5e-6, 0.01, (0.0, 720.0), "a course")
    (tmp_path / "a.tiff").write_bytes(tiff(frames, facts))
    recorded = read_frames(tmp_path / "a.tiff")
    content = frames_fits(recorded, [])
    assert content == frames_fits(recorded, [])  # no time of the day
    with fits.open(io.BytesIO(content)) as file:
        assert file["FRAMES"].data["time"].tolist() == [0.0, 720.0]
        assert file["FRAMES"].columns["time"].unit == "s"
        assert file["FRAMES"].data["frame"].tolist() == [1, 2]
        assert file[0].header["XPIXSZ"] == 5.5
    for heights, dtype in ((True, np.float32), (False, np.uint16)):
        place = MapGeoreference(116.0, 40.0, 2e-5, -1e-5, heights)
        (tmp_path / "map.tiff").write_bytes(
            tiff(frames[:1].astype(dtype), FrameFacts(georeference=place, note="a map"))
        )
        with fits.open(io.BytesIO(frames_fits(read_frames(tmp_path / "map.tiff"), []))) as file:
            header = file[0].header
            assert [header[key] for key in ("LON0", "LAT0", "DLON", "DLAT")] == pytest.approx(
                [116.0, 40.0, 2e-5, -1e-5], rel=1e-12
            )
            assert header.get("BUNIT") == ("m" if heights else None)
            np.testing.assert_array_equal(file[0].data, frames[:1])
    # a course's expected images have the times of their planes
    data = xr.Dataset(
        {"photons": (("time", "channel", "row", "column"), np.ones((2, 1, 5, 4)), {"long_name": "expected"})},
        {"time": [0.0, 720.0], "channel": ["forward/left"]},
        {"pitch_m": 5e-6},
    )
    with fits.open(io.BytesIO(expected_fits(data, []))) as file:
        assert file["TIMES"].data["time"].tolist() == [0.0, 720.0]
        assert file[1].header["AXIS3"] == "time"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.int32, np.float32, np.float64])
def test_numbers_of_any_sort_stay_what_they_are(dtype, tmp_path) -> None:
    ends = np.iinfo(dtype) if np.issubdtype(dtype, np.integer) else np.finfo(dtype)
    frames = np.array([[[ends.min, 0, 1], [2, 3, ends.max]]], dtype)
    path = tmp_path / "a.fits"
    path.write_bytes(frames_fits(RecordedFrames(frames, ({"frame": 1},)), [("SEED", 2**63 - 1, "of all")]))
    read = ImageFile.open(path).frames()
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, frames)
    assert fits.getheader(path)["SEED"] == 2**63 - 1


# --- tables ----------------------------------------------------------------------------------------------


def read_back(path: Path) -> dict[str, list]:
    """Column -> values; None for none."""
    if path.suffix == ".parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        return parquet.read_table(path).to_pydict()
    with fits.open(path) as file:
        file.verify("exception")
        out = {name: file[1].data[name].tolist() for name in file[1].columns.names}
    return {name: [None if isinstance(v, float) and math.isnan(v) else v for v in col] for name, col in out.items()}


@pytest.mark.parametrize("form", TABLE_FORMATS)
def test_nasty_values_come_back(form, tmp_path) -> None:
    """Whole numbers to their last digit, tiny and huge ones, nothing, words with signs and quotes."""
    if form == "parquet":
        pytest.importorskip("pyarrow")
    texts = ['a, "b"', "Δα ± 3 µm", None]
    table = DataTable(
        "nasty",
        "Δα of the χ² × 2",
        (
            DataColumn.of("whole", [2**63 - 1, -(2**63), 0], "", "whole numbers"),
            DataColumn.of("beyond", [2**64, 1, None], "", "larger than 64 bits"),
            DataColumn.of("real", [5e-324, -1.7976931348623157e308, None], "um", "numbers"),
            DataColumn.of("text", texts, "", "words"),
        ),
        {"frame of Δα": "µm and °, " * 30},
    )
    content = TABLE_FORMATS[form](table)
    assert content == TABLE_FORMATS[form](table)
    path = tmp_path / f"nasty.{form}"
    path.write_bytes(content)
    if form == "csv":
        rows = content.decode().splitlines()
        assert rows[0] == "whole,beyond,real [um],text"
        assert rows[1].startswith(f"{2**63 - 1},{2**64},5e-324,")
        return
    found = read_back(path)
    assert found["whole"] == [2**63 - 1, -(2**63), 0]
    assert found["beyond"][:2] == [str(2**64), "1"]
    assert found["real"] == [5e-324, -1.7976931348623157e308, None]
    assert found["text"] == ([*texts[:2], None] if form == "parquet" else ['a, "b"', "d alpha +- 3 um", ""])


def test_files_that_are_no_frames_of_a_run_are_refused(tmp_path) -> None:
    colours = np.zeros((8, 8, 3), np.uint8)
    tifffile.imwrite(tmp_path / "a.tiff", colours, photometric="rgb", description="{}", metadata=None)
    tifffile.imwrite(tmp_path / "b.tiff", colours[..., 0], description="[1]", metadata=None)
    for name, told in (
        ("a", "pages of uint8 with 3 axes are not recorded frames"),
        ("b", "the description of a page is not that of a run's frame"),
    ):
        with pytest.raises(ValueError, match=told):
            read_frames(tmp_path / f"{name}.tiff")


def test_columns_that_make_no_table_are_refused() -> None:
    one = DataColumn.of("a", [1.0], "", "one")
    for columns in ((one, one), (one, DataColumn.of("b", [1.0, 2.0], "", "two"))):
        with pytest.raises(ValueError, match="columns must have the same length and different names"):
            DataTable("t", "a title", columns)
    assert one.unit == ""
    with pytest.raises(KeyError):
        DataTable("t", "a title", (one,)).column("b")


@pytest.mark.second
def test_without_pyarrow_parquet_is_refused_with_what_to_do(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingPackage):
        TABLE_FORMATS["parquet"](DataTable("t", "t", (DataColumn.of("a", [1], "", "one"),)))
    done = invoke(app, run, "--tables", "parquet", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "pip install -e .[parquet]" in done.stderr
    assert files(tmp_path) == set()


def test_frames_that_do_not_come_back_are_not_handed_out(tmp_path, monkeypatch) -> None:
    """Every file is read back before the folder appears."""
    frames, other = np.arange(8, dtype=np.uint16).reshape(2, 2, 2), np.zeros((2, 2, 2), np.uint16)
    with RunFolder(tmp_path / "run") as folder:
        folder.write_bytes("images/a.tiff", tiff(frames, FrameFacts()))
        write_manifest(folder, "twin.lab", 0.0, 1.0, test="focus")
    options = ("--tables", "none", "--quiet", "--out")
    assert invoke(app, tmp_path / "run", *options, tmp_path / "good").exit_code == 0
    np.testing.assert_array_equal(fits.getdata(tmp_path / "good/images/a.fits"), frames)
    monkeypatch.setattr(
        "twin.export.export_run.frames_fits",
        lambda recorded, cards: frames_fits(replace(recorded, frames=other), cards),
    )
    with pytest.raises(RuntimeError, match=r"images/a\.fits does not contain the frames written to it"):
        invoke(app, tmp_path / "run", *options, tmp_path / "bad")
    assert not (tmp_path / "bad").exists()


# --- the command -----------------------------------------------------------------------------------------


@pytest.mark.second
def test_a_file_that_was_changed_since_is_told(run, tmp_path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    picture = copy / "images/forward_left_after.tiff"
    frames = tifffile.imread(picture)
    picture.write_bytes(tiff(frames + np.uint16(1), replace(FrameFacts(), camera="forward, left area CCD")))
    done = invoke(app, copy, "--tables", "none", "--out", tmp_path / "out")
    assert done.exit_code == 0
    assert "images/forward_left_after.tiff has changed since its run" in " ".join(done.stdout.split())
    np.testing.assert_array_equal(fits.getdata(tmp_path / "out/images/forward_left_after.fits"), frames + 1)


@pytest.mark.second
@pytest.mark.parametrize(
    ("spoil", "options", "said"),
    [
        (lambda run: shutil.rmtree(run), (), "no such folder"),
        (lambda run: (run / "manifest.json").unlink(), (), "not a run folder"),
        (lambda run: (run / "truth.json").unlink(), (), "truth.json: file of the run is missing"),
        (lambda run: (run / "truth.json").write_text('{"cameras": '), (), "truth.json:1: not JSON"),
        (lambda run: (run / "truth.json").write_bytes(b"\xff\xfe"), (), "truth.json:1: not UTF-8 text"),
        (lambda run: (run / "artefacts/points.csv").write_text("a,b\n1\n"), (), "rows of different lengths"),
        (
            lambda run: (run / "images/forward_left_after.tiff").write_bytes(b"II*\0"),
            (),
            "forward_left_after.tiff: cannot",
        ),
        (lambda run: (run / "irradiance.nc").write_bytes(b"CDF"), (), "irradiance.nc: cannot be read"),
        (lambda run: None, ("--tables", "parket"), "did you mean 'parquet'"),
        (lambda run: None, ("--frames", "tiff"), "--frames: no such format"),
        (lambda run: None, ("--frames", "none", "--tables", "none"), "exports nothing"),
    ],
)
def test_what_cannot_be_exported_is_refused(run, tmp_path, spoil, options, said) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    spoil(copy)
    done = invoke(app, copy, *options, "--out", tmp_path / "out")
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


def test_a_run_without_what_is_asked_for_is_told(tmp_path) -> None:
    with RunFolder(tmp_path / "empty") as folder:
        folder.write_text("note.txt", "nothing")
        write_manifest(folder, "twin.lab", 0.0, 1.0, test="focus")
    done = invoke(app, tmp_path / "empty", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "this run has nothing to export" in done.stderr
    assert "twin.lab focus" in done.stderr
