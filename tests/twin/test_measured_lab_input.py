"""Measurements that cannot be used: each is told with file, line, column and remedy, exit code 2, and nothing is kept;
tables of a million rows.
"""

import csv
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from analysis.turntable.dividing_error import CalibrationSeries, expected_rejections, normal_reduction, rejection_rate
from scenes.specs.load import SCENES
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError
from tests.tiers import quick
from tests.twin.study_bench import REFUSED
from twin.lab import app
from twin.laboratory.focus_report import focus_report
from twin.laboratory.focus_run import align_files

EXAMPLES = SCENES / "lab" / "measured"
TABLE = {"turntable": "comparisons.csv", "distortion": "spots.csv", "focus": "mtf.csv"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "measured"
    shutil.copytree(EXAMPLES, place)
    return place


def edited(path: Path, change: Callable[[list[list[str]]], object]) -> None:
    with path.open(newline="") as stream:
        rows = list(csv.reader(stream))
    change(rows)
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)


def cell(line: int, head: str, value: str) -> Callable[[list[list[str]]], None]:
    def change(rows: list[list[str]]) -> None:
        rows[line - 1][rows[0].index(head)] = value

    return change


def head(old: str, new: str) -> Callable[[list[list[str]]], None]:
    def change(rows: list[list[str]]) -> None:
        rows[0][rows[0].index(old)] = new

    return change


def without(name: str) -> Callable[[list[list[str]]], None]:
    def change(rows: list[list[str]]) -> None:
        k = rows[0].index(name)
        for row in rows:
            del row[k]

    return change


def only(count: int) -> Callable[[list[list[str]]], None]:
    return lambda rows: rows.__delitem__(slice(count + 1, None))


def copied(line: int) -> Callable[[list[list[str]]], None]:
    return lambda rows: rows.append(list(rows[line - 1]))


def numbered(rows: list[list[str]]) -> None:
    """Every stop of the table under two numbers, so that two have the same readings."""
    rows[0].insert(0, "position")
    for k, row in enumerate(rows[1:]):
        row.insert(0, str(k // 5))


def scaled(name: str, factor: float) -> Callable[[list[list[str]]], None]:
    def change(rows: list[list[str]]) -> None:
        k = rows[0].index(name)
        for row in rows[1:]:
            row[k] = repr(float(row[k]) * factor)

    return change


def crowded(rows: list[list[str]]) -> None:
    """Points without numbers, in one set, each a little beside the last."""
    rows[:] = [[cell for j, cell in enumerate(row) if rows[0][j] not in ("point", "set")] for row in rows[:2]]
    k = rows[0].index("reading [deg]")
    rows[2:] = [[*rows[1][:k], repr(float(rows[1][k]) + 1e-4 * n), *rows[1][k + 1 :]] for n in range(1, 3001)]


def countless(rows: list[list[str]]) -> None:
    """As many repeats of one reading as there are readings."""
    rows[1:] = [[f"{92 + 1e-3 * k}", "0", "0.1"] for k in range(5600)] + [["92", f"{k}", "0.1"] for k in range(1, 5600)]


def misplaced(rows: list[list[str]]) -> None:
    """Positions of ten repeats each, and one repeat that stands at the next."""
    rows[0].insert(0, "position")
    for k, row in enumerate(rows[1:]):
        row.insert(0, str(k // 10))
    rows[3][0], rows[3][rows[0].index("repeat")] = "1", "77"


def spread_out(rows: list[list[str]]) -> None:
    k = rows[0].index("x [mm]")
    rows[2:] = [[*rows[1][:k], str(n), *rows[1][k + 1 :]] for n in range(3000)]


def spoilt_by(how: list[Any]) -> Callable[[list[list[str]]], object]:
    """A change of a table: the name of its function here and what that takes, or several of them."""
    if isinstance(how[0], list):
        return lambda rows: [spoilt_by(one)(rows) for one in how]
    return globals()[how[0]](*how[1:]) if how[1:] else globals()[how[0]]


TABLES: list[tuple[str, Callable, str | None]] = [
    *((command, spoilt_by(how), told) for command, how, told in REFUSED["laboratory_tables"]),
    ("turntable", lambda rows: rows[5].append("1"), ":6: 4 cells under 3 heads"),
    ("focus", lambda rows: rows.__delitem__(slice(3, 9)), "no best focus of P"),
]


@pytest.mark.parametrize(("command", "spoil", "told"), quick(16, TABLES))
def test_bad_tables(folder: Path, tmp_path: Path, command: str, spoil: Callable, told: str | None) -> None:
    edited(folder / TABLE[command], spoil)
    done = CliRunner().invoke(app, [command, str(folder / f"{command}.yaml"), "--out", str(tmp_path / "run")])
    text = " ".join(done.output.split())
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    if told is None:  # odd, but nothing that a table could know
        assert done.exit_code in (0, 2)
        return
    assert done.exit_code == 2, text
    assert any(one in text for one in told.split("|")), text
    assert TABLE[command] in text or f"{command}.yaml" in text
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("command", "old", "new", "told"), quick(9, map(tuple, REFUSED["laboratory_files"])))
def test_bad_files(folder: Path, tmp_path: Path, command: str, old: str, new: str, told: str) -> None:
    file = folder / f"{command}.yaml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    done = CliRunner().invoke(app, [command, str(file), "--out", str(tmp_path / "run")])
    said = " ".join(done.output.split())
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    if command == "focus" and old.startswith("thickness"):
        # these shims all become thicker: thin ones are no obstacle
        assert done.exit_code in (0, 2)
        return
    assert done.exit_code == 2, said
    assert any(one in said for one in told.split("|")), said
    assert not (tmp_path / "run").exists()


# --- images ----------------------------------------------------------------------------------------------


def edge(defocus: float, direction: str, seed: int) -> np.ndarray:
    """An edge blurred by a Gaussian that grows with defocus, made without the twin: 64 x 64, 12 bits, noise of 4 DN."""
    v, u = np.mgrid[0:640, 0:640] / 10.0
    across, along = (u, v) if direction == "along" else (v, u)
    sharp = (across - 32.0 - np.tan(np.radians(5.0)) * (along - 32.0) > 0.0).astype(np.float32)
    width = 10.0 * np.hypot(0.45, 0.004e6 * defocus)
    wide = cv2.GaussianBlur(sharp, (0, 0), float(width), borderType=cv2.BORDER_REPLICATE)
    image = 300.0 + 2500.0 * cv2.resize(wide, (64, 64), interpolation=cv2.INTER_AREA)
    return np.uint16(image + np.random.default_rng(seed).normal(0.0, 4.0, (64, 64)))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images through focus at four places, best focus 20 um upstream of the CCD at one end to 40 um at the other."""
    folder = tmp_path_factory.mktemp("images")
    rows = [["x [mm]", "y [mm]", "edge", "shift [um]", "file"]]
    for n, (x, y) in enumerate(((0, -100), (0, 100), (20, -100), (20, 100))):
        for way in ("along", "track"):
            for k, shift in enumerate(np.linspace(-150.0, 90.0, 9)):
                focus = -30.0e-6 - 1e-7 * y
                name = f"{n}_{way}_{k}.tiff"
                tifffile.imwrite(folder / name, edge(1e-6 * shift - focus, way, 100 * n + 10 * k + len(way)))
                rows.append([str(x), str(y), way, f"{shift:.3f}", name])
    with (folder / "images.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)
    return folder


@pytest.fixture
def stack(folder: Path, images: Path) -> Path:
    """The same beside a test's file, to spoil."""
    shutil.copytree(images, folder, dirs_exist_ok=True)
    text = (folder / "focus.yaml").read_text().replace("mtf: mtf.csv  ", "images: images.csv")
    (folder / "focus.yaml").write_text(text)
    return folder


@pytest.mark.second
def test_a_stack_that_the_twin_did_not_make(stack: Path) -> None:
    run = align_files(PROCEDURES["lab focus"].resolve(stack / "focus.yaml").test)  # type: ignore[arg-type]
    true = np.array([-20e-6, -40e-6, -20e-6, -40e-6])
    by_place = {tuple(np.rint(1e3 * place)): k for k, place in enumerate(run.positions)}
    order = [by_place[place] for place in ((0, -100), (0, 100), (20, -100), (20, 100))]
    # a Gaussian's curve is even, its form another than a pupil's: half a micrometre is stated for that
    sigma = np.hypot(run.states[0].defocus_sigma[order], run.test.vertex_error)
    assert np.all(np.abs(run.states[0].defocus[order] - true) < 4.0 * sigma)
    sigma_y = float(np.sqrt(run.shimmings[0].plane.covariance[2, 2])) + run.shimmings[0].systematic[2]
    assert abs(run.shimmings[0].plane.slope_y - 1e-4) < 4.0 * sigma_y
    assert sigma_y < 1e-5
    assert not run.readings.no_edge


@pytest.mark.second
def test_an_image_in_uneven_light_is_named(stack: Path) -> None:
    """A light that is no plane; one that is costs sigma alone."""
    row, column = np.mgrid[-1:1:64j, -1:1:64j]
    for name, light in (("2_along_4", 1.0 - 0.1 * column**2), ("1_track_3", 1.0 + 0.1 * row + 0.1 * column)):
        image = tifffile.imread(stack / f"{name}.tiff")
        tifffile.imwrite(stack / f"{name}.tiff", np.uint16(light * image))
    run = align_files(PROCEDURES["lab focus"].resolve(stack / "focus.yaml").test)
    with (stack / "images.csv").open() as stream:
        line = next(k for k, text in enumerate(stream, 1) if "2_along_4" in text)
    assert [fault.line for fault in run.readings.uneven] == [line]
    assert f"1 images have a doubtful sigma (lines {line} of" in " ".join(focus_report(run).warnings)


def more(*columns: tuple[str, str]) -> Callable[[Path], None]:
    """Further columns of the table of images, every row with the same values."""

    def change(rows: list[list[str]]) -> None:
        for k, row in enumerate(rows):
            row.extend(name if k == 0 else value for name, value in columns)

    return lambda place: edited(place / "images.csv", change)


def noisy(band: str, saturation: float) -> Callable[[Path], object]:
    """The noise of a band's detector in the test's file, and a column of bands."""
    noise = f"{{gain_dn_per_e: 0.06, dark_noise_e: 4, offset_dn: 100, saturation_dn: {saturation}}}"

    def change(place: Path) -> None:
        more(("band", "P"))(place)
        file = place / "focus.yaml"
        file.write_text(file.read_text().replace("moved: image", f"moved: image\n  noise: {{{band}: {noise}}}"))

    return change


REGION = ("row", "0"), ("column", "0"), ("height", "90"), ("width", "90")
IMAGES = [
    (lambda place: (place / "0_along_3.tiff").unlink(), "there is no image"),
    (lambda place: (place / "0_along_3.tiff").write_bytes(b"II*\0" + bytes(20)), "has no pages"),
    (lambda place: (place / "0_along_3.tiff").write_text("no image"), "cannot be read as an image"),
    (lambda place: tifffile.imwrite(place / "0_along_3.tiff", np.zeros((64, 64, 3), np.uint8)), "3 colours"),
    (more(("row", "0")), "part of a region only"),
    (more(("page", "3")), "does not exist"),
    (more(("page", "-1")), "page: out of range"),
    (more(("per shift", "1")), "moved: target"),
    (more(*REGION), "is not inside the image"),
    (noisy("Q", 4095), "noise.Q: no image is of this band; allowed: P"),
    (noisy("P", 50), "saturation_dn 50.0 must lie above the dark level"),
    (lambda place: edited(place / "images.csv", without("file")), "no column 'file'"),
    (lambda place: edited(place / "images.csv", cell(4, "file", "")), ":4: file: an empty cell"),
    (lambda place: edited(place / "images.csv", cell(4, "file", "..")), "is a folder, not an image"),
]


@pytest.mark.second
@pytest.mark.parametrize(("spoil", "told"), IMAGES)
def test_bad_images(stack: Path, tmp_path: Path, spoil: Callable[[Path], object], told: str) -> None:
    spoil(stack)
    done = CliRunner().invoke(app, ["focus", str(stack / "focus.yaml"), "--out", str(tmp_path / "run")])
    text = " ".join(done.output.split())
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == 2, text
    assert told in text, text
    assert re.search(r"(images\.csv|focus\.yaml):\d+: ", text), text


@pytest.mark.second
def test_images_without_an_edge_are_told_and_have_no_weight(stack: Path) -> None:
    test = PROCEDURES["lab focus"].resolve(stack / "focus.yaml").test
    before = align_files(test)  # type: ignore[arg-type]
    flat = np.random.default_rng(1).normal(1000.0, 4.0, (64, 64)).astype(np.uint16)
    tifffile.imwrite(stack / "0_along_8.tiff", flat)
    after = align_files(test)  # type: ignore[arg-type]
    (lost,) = after.readings.no_edge
    assert lost.line == 10
    assert np.all(np.abs(after.states[0].defocus - before.states[0].defocus) < 3.0 * before.states[0].defocus_sigma)
    for k in range(9):
        tifffile.imwrite(stack / f"0_along_{k}.tiff", flat)
    with pytest.raises(InputError, match="reason for its first image without an edge"):
        align_files(test)  # type: ignore[arg-type]


# --- size, and series of unequal length ------------------------------------------------------------------


def test_series_of_unequal_length() -> None:
    """The noise of all angles together is right whatever the numbers of repeats; 4000 of 3 to 12, 1% is 3 sigma."""
    rng = np.random.default_rng(4)
    counts = rng.integers(3, 13, 4000)
    present = np.arange(12) < counts[:, None]
    series = CalibrationSeries(
        np.arange(4000.0), np.where(present, rng.normal(0.0, 2.0, present.shape), 7e3), present=present
    )
    assert series.repeatability == pytest.approx(2.0, rel=0.012)
    assert not np.any(series.keep & ~present)
    expected = expected_rejections(series.counts)
    assert abs(series.rejected - expected) < 4.0 * np.sqrt(expected)
    # of equal numbers it is what it was for one
    assert normal_reduction(np.full(5, 10)) == normal_reduction(10)
    assert expected_rejections(np.full(41, 10)) == rejection_rate(10) * 410
