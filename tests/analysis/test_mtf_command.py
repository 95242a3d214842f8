"""python -m analysis.mtf on image files: what is printed and written, and every sentence after bad input."""

import csv
import importlib.util
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from scipy.special import ndtr
from typer.testing import CliRunner

from analysis.mtf.__main__ import app

ROI = "10,20,64,64"
BLUR = 0.7
DEGREES = 5.0


def edge_frame(noise=3.0, seed=1, dark=1000.0, bright=11000.0):
    """(90, 110) uint16; an edge with a Gaussian line-spread function of 0.7 px, MTF exp(-2 (pi f 0.7)^2) by formula."""
    row, column = np.indices((90, 110)).astype(float)
    angle = math.radians(DEGREES)
    d = (column - 51.3) * math.cos(angle) - (row - 41.5) * math.sin(angle)
    mean = dark + (bright - dark) * ndtr(d / BLUR)
    return np.round(mean + np.random.default_rng(seed).normal(0, noise, mean.shape)).astype(np.uint16)


def gaussian_mtf(f):
    return math.exp(-2 * (math.pi * f * BLUR) ** 2)


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], terminal_width=200)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def run_json(*arguments):
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture
def edge_tiff(tmp_path):
    path = tmp_path / "edge.tiff"
    tifffile.imwrite(path, edge_frame())
    return path


def test_json_against_the_formula(edge_tiff):
    data = run_json(edge_tiff, "--roi", ROI, "--pixel-size", "7 um")
    f, mtf = np.array(data["frequency_cycles_per_pixel"]), np.array(data["mtf"])
    truth = np.array([gaussian_mtf(each) for each in f])
    # five sigma of the noise and the estimator's own 5e-4
    assert np.all(np.abs(mtf - truth)[f <= 0.5] < 5 * np.array(data["sigma"])[f <= 0.5] + 5e-4)
    np.testing.assert_allclose(data["frequency_cycles_per_mm"], f / 0.007)
    assert data["axis"] == "x"
    assert data["angle_deg"] == pytest.approx(DEGREES, abs=0.01)
    assert data["mtf_nyquist"] == pytest.approx(gaussian_mtf(0.5), abs=5 * data["mtf_nyquist_sigma"] + 5e-4)
    half = math.sqrt(math.log(2) / 2) / (math.pi * BLUR)
    assert data["mtf50_cycles_per_mm"] == pytest.approx(half / 0.007, abs=0.2)
    assert (data["dark_dn"], data["bright_dn"]) == pytest.approx((1000, 11000), abs=2)


def test_printed_table(edge_tiff):
    result = run(edge_tiff, "--roi", ROI, "--pixel-size", "0.007 mm")
    assert result.exit_code == 0, result.stderr
    for text in ("cycles/mm", "sigma", "MTF at Nyquist (71.4 cycles/mm): 0.0", "MTF50: 3", "near-vertical", "deg"):
        assert text in result.stdout
    row = next(line.split() for line in result.stdout.splitlines() if line.strip().startswith("28.6"))
    assert float(row[1]) == 0.2
    assert float(row[2]) == pytest.approx(gaussian_mtf(0.2), abs=0.002)


def test_files(edge_tiff, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    plot, table = out / "mtf.png", out / "mtf.csv"
    result = run(edge_tiff, "--roi", ROI, "--pixel-size", "7 um", "--plot", plot, "--csv", table)
    assert result.exit_code == 0, result.stderr
    assert {path.name for path in out.iterdir()} == {"mtf.png", "mtf.csv"}
    picture = cv2.imread(str(plot))
    assert picture.shape[1] > 1000
    assert picture.std() > 10
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    assert len(rows) == 65
    assert float(rows[32]["frequency_cycles_per_mm"]) == pytest.approx(0.5 / 0.007)
    assert float(rows[16]["mtf"]) == pytest.approx(gaussian_mtf(0.25), abs=0.002)


def test_kinds_of_images(tmp_path):
    """16-bit PNG, 8-bit colour PNG with alpha, float TIFF, colour TIFF: the same edge."""
    frame = edge_frame()
    small = np.round(edge_frame(noise=120) / 50.0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "grey16.png"), frame)
    cv2.imwrite(str(tmp_path / "colour8.png"), np.dstack([small] * 3 + [np.full_like(small, 255)]))
    tifffile.imwrite(tmp_path / "real.tif", frame.astype(np.float32))
    tifffile.imwrite(tmp_path / "colour.tif", np.dstack([frame] * 3), photometric="rgb")
    for path in sorted(tmp_path.iterdir()):
        data = run_json(path, "--roi", ROI, "--pixel-size", "7 um")
        assert data["mtf"][16] == pytest.approx(gaussian_mtf(0.25), abs=5 * data["sigma"][16] + 5e-4), path.name


def test_luminance_weighs_the_channels(tmp_path):
    frame = edge_frame().astype(float)
    colour = np.dstack([frame * 0.5, frame, frame * 0.25]).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "colour.png"), colour[..., ::-1])
    data = run_json(tmp_path / "colour.png", "--roi", ROI, "--pixel-size", "7 um")
    assert data["bright_dn"] == pytest.approx(11000 * (0.2126 * 0.5 + 0.7152 + 0.0722 * 0.25), rel=1e-3)


def test_pages_are_averaged(tmp_path):
    path = tmp_path / "pages.tiff"
    tifffile.imwrite(path, np.stack([edge_frame(50.0, seed) for seed in range(16)]), photometric="minisblack")
    all_pages = run_json(path, "--roi", ROI, "--pixel-size", "7 um")
    four = run_json(path, "--roi", ROI, "--pixel-size", "7 um", "--frames", 4)
    # the noise is estimated from some 3000 pixels of each: 2%
    assert four["noise_dark_dn"] == pytest.approx(2 * all_pages["noise_dark_dn"], rel=0.1)
    assert all_pages["noise_dark_dn"] == pytest.approx(50 / 4, rel=0.1)


def test_one_saturated_page_is_enough(tmp_path):
    pages = np.stack([edge_frame(50.0, seed) for seed in range(4)])
    pages[2, 40, 80] = 65535
    tifffile.imwrite(tmp_path / "pages.tiff", pages, photometric="minisblack")
    result = run(tmp_path / "pages.tiff", "--roi", ROI, "--pixel-size", "7 um")
    assert result.exit_code == 2
    assert "1 pixels reach the saturation level of 65535" in result.stderr


def bars_tiff(folder):
    """Bars at 0.5 cycles/pixel tilted by 4 deg with the fundamental's MTF 0.3, and two patches."""
    row, column = np.indices((64, 140)).astype(float)
    angle = math.radians(4)
    phase = 2 * math.pi * 0.5 * (column * math.cos(angle) - row * math.sin(angle))
    mean = 600 + 2 / math.pi * 1000 * 0.3 * np.cos(phase)
    mean[:, 80:110], mean[:, 110:] = 100, 1100
    frame = np.round(mean + np.random.default_rng(2).normal(0, 3, mean.shape)).astype(np.uint16)
    tifffile.imwrite(folder / "bars.tiff", frame)
    return folder / "bars.tiff"


BARS = ("--roi", "0,0,64,64", "--pixel-size", "7 um", "--dark", "5,85,50,20", "--bright", "5,115,50,20")


@pytest.mark.parametrize("frequency", ["0.5 cycles/pixel", "71.43 cycles/mm", "71.43 lp/mm"])
def test_bars(tmp_path, frequency):
    data = run_json(bars_tiff(tmp_path), *BARS, "--bars", frequency, "--offset", 50)
    assert data["mtf"] == pytest.approx(0.3, abs=5 * data["sigma"])
    assert data["frequency_cycles_per_mm"] == pytest.approx(0.5 / 0.007, abs=0.05)
    assert (data["dark_dn"], data["bright_dn"]) == pytest.approx((50, 1050), abs=1)
    printed = run(tmp_path / "bars.tiff", *BARS, "--bars", frequency)
    assert printed.exit_code == 0
    assert "MTF: 0.30" in printed.stdout
    assert "Coltman" in printed.stdout


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"--pixel-size": "7"}, 'not a length with its unit: write it as "7 um"'),
        ({"--pixel-size": "7 furlong"}, "not a length with its unit"),
        ({"--pixel-size": "-7 um"}, "must be above 0"),
        ({"--roi": "10,20,64"}, "four whole numbers ROW,COLUMN,HEIGHT,WIDTH"),
        ({"--roi": "10,20,64,640"}, "does not lie in the image of 90 rows and 110 columns"),
        ({"--roi": "10,20,16,64"}, "too small"),
        ({"--roi": "0,0,64,40"}, "edge"),
        ({"--saturation": "9000"}, "pixels reach the saturation level of 9000: lower the exposure"),
        ({"--frames": "3"}, "more than the 1 pages"),
        ({"--plot": "mtf.jpeg"}, "must end in .png or .pdf or .svg"),
        ({"--plot": "no/such/folder/mtf.png"}, "make it first"),
        ({"--csv": "mtf.txt"}, "must end in .csv"),
        ({"--bars": "0.5"}, "not a frequency with its unit"),
        ({"--bars": "0.5 cycles/pixel"}, "needs --dark and --bright"),
        ({"--dark": "0,0,9,9"}, "belong to --bars"),
    ],
)
def test_bad_input(edge_tiff, tmp_path, changed, message):
    options = {"--roi": ROI, "--pixel-size": "7 um"} | changed
    if "--plot" in options:
        options["--plot"] = str(tmp_path / options["--plot"])
    result = run(edge_tiff, *[word for pair in options.items() for word in pair])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"edge.tiff"}


def test_unreadable_images(tmp_path):
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "text.tiff").write_text("not a picture")
    for name, message in (
        ("none.tiff", "there is no image"),
        (".", "is a folder, not an image"),
        ("text.png", "cannot be read as an image"),
        ("text.tiff", "cannot be read as an image"),
    ):
        result = run(tmp_path / name, "--roi", ROI, "--pixel-size", "7 um")
        assert result.exit_code == 2
        assert message in result.stderr


def test_the_image_is_never_overwritten(tmp_path):
    path = tmp_path / "edge.png"
    cv2.imwrite(str(path), edge_frame())
    before = path.read_bytes()
    result = run(path, "--roi", ROI, "--pixel-size", "7 um", "--plot", path)
    assert result.exit_code == 2
    assert path.read_bytes() == before


def test_help_teaches():
    result = run("--help")
    assert result.exit_code == 0
    for text in ("ISO 12233", "2 to 10 deg", "linear in light", "ROW,COLUMN,HEIGHT,WIDTH", "cycles/mm", "Exit codes"):
        assert text in result.stdout


def test_the_module_is_a_command():
    spec = importlib.util.find_spec("analysis.mtf.__main__")
    assert 'if __name__ == "__main__":\n    app()' in Path(spec.origin).read_text("utf-8")
