"""python -m analysis.mtf on image files: what is printed and written, and every sentence after bad input."""

import json
import math
import resource
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import yaml
from scipy.special import ndtr

from analysis.mtf.__main__ import app
from analysis.mtf.bar_mtf import measure_bar_pages
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_pages import measure_pages
from tests.analysis.refusals import refuses
from tests.tiers import quick
from tests.twin.commands import invoke

ROI = "10,20,64,64"
BLUR = 0.7
DEGREES = 5.0


def edge_frame(noise=3.0, seed=1, dark=1000.0, bright=11000.0, shift=0.0, turn=0.0):
    """(90, 110) uint16; an edge with a Gaussian line-spread function of 0.7 px, MTF exp(-2 (pi f 0.7)^2) by formula."""
    row, column = np.indices((90, 110)).astype(float)
    angle = math.radians(DEGREES) + turn
    d = (column - 51.3 - shift) * math.cos(angle) - (row - 41.5) * math.sin(angle)
    mean = dark + (bright - dark) * ndtr(d / BLUR)
    return np.round(mean + np.random.default_rng(seed).normal(0, noise, mean.shape)).astype(np.uint16)


def gaussian_mtf(f):
    return math.exp(-2 * (math.pi * f * BLUR) ** 2)


run = partial(invoke, app, terminal_width=200)


EDGE = ("--roi", ROI, "--pitch", "7 um")


def run_json(*arguments):
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def refused(said, *arguments):
    result = run(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in " ".join(result.stderr.split())


def warning(*arguments):
    """What is said beside the result."""
    result = run(*arguments)
    assert result.exit_code == 0, result.stderr
    return " ".join(result.stderr.split())


def right(data, f=0.25, more=5e-4):
    at = round(64 * f)
    assert data["mtf"][at] == pytest.approx(gaussian_mtf(f), abs=5 * data["sigma"][at] + more)


@pytest.fixture
def edge_tiff(tmp_path):
    path = tmp_path / "edge.tiff"
    tifffile.imwrite(path, edge_frame())
    return path


def test_json_against_the_formula(edge_tiff):
    data = run_json(edge_tiff, "--roi", ROI, "--pitch", "7 um")
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
    refused("--pitch is given twice", edge_tiff, *EDGE, "--pixel-size", "7 um")


def test_bars_with_even_fields(tmp_path):
    """Levels from images of even fields, their mean over the region; patches beside the bars may be wrong."""
    frame = tifffile.imread(bars_tiff(tmp_path))
    for name, level in (("dark", 100.0), ("bright", 1100.0)):
        noisy = level + np.random.default_rng(int(level)).normal(0, 3, frame.shape)
        tifffile.imwrite(tmp_path / f"{name}.tiff", np.round(noisy).astype(np.uint16))
    both = [word for name in ("dark", "bright") for word in (f"--{name}", tmp_path / f"{name}.tiff")]
    told = [tmp_path / "bars.tiff", *BARS[:4], "--bars", "0.5 cycles/pixel"]
    data = run_json(*told, *both)
    assert data["mtf"] == pytest.approx(0.3, abs=5 * data["sigma"])
    assert (data["dark_dn"], data["bright_dn"]) == pytest.approx((100, 1100), abs=0.5)
    tifffile.imwrite(tmp_path / "bright.tiff", np.full((64, 64), 1100, np.uint16))
    refused("different numbers of rows or columns", *told, *both)
    refused("or an image of an even field", *told, "--dark", "none.tiff", "--bright", "0,0,9,9")


def test_luminance_weighs_the_channels(tmp_path):
    frame = edge_frame().astype(float)
    colour = np.dstack([frame * 0.5, frame, frame * 0.25]).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "colour.png"), colour[..., ::-1])
    data = run_json(tmp_path / "colour.png", "--roi", ROI, "--pitch", "7 um")
    assert data["bright_dn"] == pytest.approx(11000 * (0.2126 * 0.5 + 0.7152 + 0.0722 * 0.25), rel=1e-3)


@pytest.mark.parametrize(("far", "turn"), quick(1, [(0.3, 0.005), (4.0, 0.0)]))
def test_pages_between_which_the_edge_moves_are_laid_over_each_other(tmp_path, far, turn):
    """Their mean gave 0.0220 +- 0.0017 for 0.0891 where it moves by 1 px rms, and not a word."""
    rng = np.random.default_rng(7)
    shift, turned = far * rng.normal(size=6), turn * rng.normal(size=6)
    pages = [edge_frame(30.0, k, shift=s, turn=t) for k, (s, t) in enumerate(zip(shift, turned, strict=True))]
    tifffile.imwrite(tmp_path / "pages.tiff", np.stack(pages), photometric="minisblack")
    result = run(tmp_path / "pages.tiff", *EDGE, "--json")
    assert "the pages were aligned" in " ".join(result.stderr.split())
    data = json.loads(result.stdout)
    right(data)
    right(data, 0.5)
    # six pages of a noise of 30 know as much as one of 12
    assert data["mtf_nyquist_sigma"] < 0.002
    assert data["pages"]["aligned"]
    place, wanted = np.array(data["pages"]["position_px"]), shift - 0.5 * np.tan(turned)
    moved = (place - place.mean() - wanted + wanted.mean()) / np.array(data["pages"]["position_px_sigma"])
    assert np.max(np.abs(moved)) < 5.0


@pytest.mark.second
@pytest.mark.parametrize("imagej", [False, True])
def test_still_pages_are_averaged_to_the_bit(tmp_path, imagej):
    """One page in 10 000 images would be aligned by chance."""
    pages = np.stack([edge_frame(30.0, k) for k in range(9)])
    tifffile.imwrite(tmp_path / "pages.tiff", pages, photometric="minisblack", imagej=imagej)
    for more, used in (((), 9), (("--frames", 4), 4)):
        tifffile.imwrite(tmp_path / "mean.tiff", pages[:used].mean(axis=0))
        several, mean = run_json(tmp_path / "pages.tiff", *EDGE, *more), run_json(tmp_path / "mean.tiff", *EDGE)
        for key in ("mtf", "sigma", "noise_bias", "position_px", "angle_deg"):
            assert several[key] == mean[key]
        assert not several["pages"]["aligned"]
        # of some 3000 pixels of each side: 2 %
        assert several["noise_dark_dn"] == pytest.approx(30.0 / used**0.5, rel=0.1)


def test_rounding_and_repeated_pages_enter_the_sigma(tmp_path):
    """Of 20 grey values without noise the MTF at Nyquist was 0.0635 with a sigma of 4e-7 for 0.0891."""
    small = edge_frame(0.0, 5, 3.0, 23.0).astype(np.uint8)
    found = []
    for count, said in ((1, "rounding does not average out"), (7, "6 pages are identical to another one")):
        tifffile.imwrite(tmp_path / "one.tiff", np.stack([small] * count), photometric="minisblack")
        words = (tmp_path / "one.tiff", *EDGE, "--saturation", 255)
        found.append(run_json(*words))
        assert said in warning(*words)
    first, again = found
    assert (first["mtf"], first["sigma"]) == (again["mtf"], again["sigma"])
    for f in (0.1, 0.25, 0.5):
        at, sigma = round(64 * f), first["sigma"][round(64 * f)]
        assert first["mtf"][at] == pytest.approx(gaussian_mtf(at / 64), abs=4 * sigma)
        assert 0.002 < sigma < 0.03
    assert first["noise_dark_dn"] == pytest.approx(12**-0.5, rel=0.1)


def page(shift, seed):
    return edge_frame(30.0, seed, shift=shift)[10:74, 20:84].astype(float)


def flat(seed):
    return 6000.0 + np.random.default_rng(seed).normal(0, 30, (64, 64))


SOFT = 6000.0 + 5000.0 * np.tanh((np.arange(64) - 31) / 12.0)
PAGES = {
    "it is even apart from noise": lambda: [flat(1), flat(2)],
    "single pages are too noisy": lambda: [page(-12, 1), page(12, 2), flat(3)],
    "page 6, not counting copies, shows no edge": lambda: [*(page(k / 2, k) for k in range(6)), flat(9)],
    "4000000 in all are possible": lambda: [page(12 * (-1) ** (k % 2), k % 10) + k for k in range(1000)],
    "the edge does not have the same shape in them": lambda: [
        *(page(k / 2, k) for k in range(4)),
        SOFT + 0.01 * flat(9),
    ],
    "within 10 px of the region's side": lambda: [*(page(k / 5, k) for k in range(20)), page(25, 99)],
}


@pytest.mark.parametrize("said", quick(4, PAGES))
def test_pages_that_cannot_be_measured_together(said):
    refuses(EdgeError, said, measure_pages, np.stack(PAGES[said]()))


def test_pages_of_different_size_must_be_chosen(tmp_path):
    """They were read by the first one alone, without a word."""
    path = tmp_path / "mixed.tiff"
    with tifffile.TiffWriter(path) as file:
        file.write(edge_frame(3.0, 1)[:80, :100])
        file.write(edge_frame(3.0, 2))
    refused("80 x 100 uint16 (first: 0), 90 x 110 uint16 (first: 1)", path, *EDGE)
    refused("--page NUMBER", path, *EDGE)
    for page in (0, 1):
        right(run_json(path, *EDGE, "--page", page), 0.5)
    refused("is not inside", path, "--roi", "10,20,80,64", "--pitch", "7 um", "--page", 0)
    # a thumbnail says that it is one
    with tifffile.TiffWriter(path) as file:
        file.write(edge_frame())
        file.write(edge_frame()[::8, ::8], subfiletype=1)
    assert warning(path, *EDGE) == ""


def srgb(linear):
    """Coded share of full scale, IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055)


def test_tone_curves(tmp_path):
    """A JPEG of 8 bits gives a warning, and the right MTF with the curve that it was made with."""
    linear = edge_frame(60.0) / 14000.0
    for gamma, coded in (("srgb", srgb(linear)), ("2.2", linear ** (1 / 2.2))):
        path = tmp_path / f"{gamma}.jpg"
        cv2.imwrite(str(path), np.round(255 * coded).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 100])
        assert "warning: " in warning(path, *EDGE)
        assert "--gamma srgb" in warning(path, *EDGE)
        assert abs(run_json(path, *EDGE)["mtf"][16] - gaussian_mtf(0.25)) > 0.02
        assert warning(path, *EDGE, "--gamma", gamma) == ""
        data = run_json(path, *EDGE, "--gamma", gamma)
        right(data, more=2e-3)  # JPEG's own quantisation at quality 100 is below one grey value
        assert data["bright_dn"] == pytest.approx(255 * 11000 / 14000, abs=1.0)
    assert warning(path, *EDGE, "--gamma", "1") == ""
    tifffile.imwrite(tmp_path / "real.tiff", edge_frame().astype(np.float32))
    assert warning(tmp_path / "real.tiff", *EDGE, "--gamma", "1") == ""
    for gamma in ("srgb", "2.2"):
        refused("real numbers have no full scale", tmp_path / "real.tiff", *EDGE, "--gamma", gamma)


def test_a_tiff_of_8_bits_with_a_colour_profile_gives_a_warning(tmp_path):
    frame = np.round(edge_frame() / 60.0)
    for dtype, profile, warned in ((np.uint8, True, True), (np.uint16, True, False), (np.uint8, False, False)):
        tifffile.imwrite(tmp_path / "one.tiff", frame.astype(dtype), iccprofile=bytes(200) if profile else None)
        assert ("its 8-bit pages have a colour profile" in warning(tmp_path / "one.tiff", *EDGE)) == warned


def test_a_png_that_names_its_curve_gives_a_warning_and_one_of_no_known_colour_type_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "plain.png"), edge_frame())
    data = (tmp_path / "plain.png").read_bytes()
    assert warning(tmp_path / "plain.png", *EDGE) == ""
    for name, content, warned in ((b"gAMA", 45455, True), (b"gAMA", 100000, False), (b"sRGB", None, True)):
        body = b"\0" if content is None else content.to_bytes(4, "big")
        (tmp_path / "named.png").write_bytes(data[:33] + chunk(name, body) + data[33:])
        assert ("warning" in warning(tmp_path / "named.png", *EDGE)) is warned
    (tmp_path / "odd.png").write_bytes(data[:8] + chunk(b"IHDR", data[16:25] + b"\5" + data[26:29]) + data[33:])
    refused("no colour type 5", tmp_path / "odd.png", *EDGE)


def chunk(name, content):
    """Of a PNG."""
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")


def test_images_beyond_memory_are_refused_by_their_header(tmp_path):
    path, packed = tmp_path / "huge.png", tmp_path / "huge.tiff"
    cv2.imwrite(str(path), np.zeros((8, 8), np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[:8] + chunk(b"IHDR", (30_000).to_bytes(4, "big") * 2 + data[24:29]) + data[33:])
    begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused("of 30000 x 30000 pixels needs 0.9 GB when decoded, more than 0.5 GB: crop the image", path, *EDGE)
    refused("choose a smaller region", path, "--roi", "0,0,20000,20000", "--pitch", "7 um")
    size, one = (30_000, 30_000), iter([b"x"])
    tifffile.imwrite(packed, shape=size, dtype=np.uint16, compression="zlib", tile=size, data=one)
    refused("1.8 GB", packed, *EDGE)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - begin < 100_000  # kB


@pytest.mark.second
def test_of_a_plain_tiff_only_the_region_is_read(tmp_path):
    """A sparse file of 1.8 GB that holds the edge in one corner, low byte first or last."""
    path = tmp_path / "large.tiff"
    for order in "<>":
        tifffile.imwrite(path, shape=(30_000, 30_000), dtype=order + "u2", byteorder=order)
        stored = tifffile.memmap(path)
        stored[29_900:29_990, 29_800:29_910] = edge_frame()
        stored.flush()
        del stored
        begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        right(run_json(path, "--roi", "29910,29820,64,64", "--pitch", "7 um"))
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - begin < 200_000


def test_one_saturated_page_is_enough(tmp_path):
    pages = np.stack([edge_frame(50.0, seed) for seed in range(4)])
    pages[2, 40, 80] = 65535
    tifffile.imwrite(tmp_path / "pages.tiff", pages, photometric="minisblack")
    refused("1 pixels reach the saturation level of 65535", tmp_path / "pages.tiff", *EDGE)


def bars_pages(folder):
    """Image of bars that stand still, noise of five pages, and these pages."""
    still = tifffile.imread(bars_tiff(folder)).astype(float)
    noisy = [np.random.default_rng(k).normal(0, 3, still.shape) for k in range(5)]
    return still, noisy, np.stack([np.round(still + noise) for noise in noisy]).astype(np.uint16)


def test_pages_of_bars_that_stand_still(tmp_path):
    _, _, pages = bars_pages(tmp_path)
    tifffile.imwrite(tmp_path / "pages.tiff", pages, photometric="minisblack")
    assert run_json(tmp_path / "pages.tiff", *BARS, "--bars", HALF)["mtf"] == pytest.approx(0.3, abs=0.003)
    # four differences of five pages in each of 4096 rounded pixels: 0.6 per cent
    found = measure_bar_pages(pages[:, :64, :64], pages[:, 5:55, 85:105], pages[:, 5:55, 115:135], 0.5, step=1.0)
    assert found.page_noise[0] == pytest.approx((9 + 1 / 12) ** 0.5, rel=0.025)


def test_bars_that_move_are_refused_and_flat_levels_have_a_sigma(tmp_path):
    """The mean of bars that move by 0.2 px gave 0.2425 +- 0.0001 for 0.3; levels without noise had no sigma."""
    still, noisy, pages = bars_pages(tmp_path)
    words = (*BARS, "--bars", HALF)
    for page, noise, shift in zip(pages, noisy, (0.0, 0.3, -0.3, 0.1, 0.2), strict=True):
        page[:, :64] = np.round(bars_mean(shift)[:, :64] + noise[:, :64])
    tifffile.imwrite(tmp_path / "pages.tiff", pages, photometric="minisblack")
    refused("the bars move by 0.2", tmp_path / "pages.tiff", *words)
    flat = np.round(still).astype(np.uint16)
    flat[:, 80:110], flat[:, 110:] = 100, 1100
    tifffile.imwrite(tmp_path / "flat.tiff", flat)
    assert "levels: 100.0 ± 0.3 and 1100.0 ± 0.3" in run(tmp_path / "flat.tiff", *words).stdout
    assert "rounding does not average out" in warning(tmp_path / "flat.tiff", *words)


def bars_mean(shift=0.0):
    """Bars at 0.5 cycles/pixel tilted by 4 deg with the fundamental's MTF 0.3, and two patches."""
    row, column = np.indices((64, 140)).astype(float)
    phase = math.pi * ((column - shift) * math.cos(math.radians(4)) - row * math.sin(math.radians(4)))
    mean = 600 + 2 / math.pi * 1000 * 0.3 * np.cos(phase)
    mean[:, 80:110], mean[:, 110:] = 100, 1100
    return mean


def bars_tiff(folder):
    frame = bars_mean() + np.random.default_rng(2).normal(0, 3, (64, 140))
    tifffile.imwrite(folder / "bars.tiff", np.round(frame).astype(np.uint16))
    return folder / "bars.tiff"


HALF = "0.5 cycles/pixel"
BARS = ("--roi", "0,0,64,64", "--pitch", "7 um", "--dark", "5,85,50,20", "--bright", "5,115,50,20")


@pytest.mark.parametrize("frequency", ["0.5 cycles/pixel", "71.43 cycles/mm", "71.43 lp/mm"])
def test_bars(tmp_path, frequency):
    data = run_json(bars_tiff(tmp_path), *BARS, "--bars", frequency, "--offset", 50)
    assert data["mtf"] == pytest.approx(0.3, abs=5 * data["sigma"])
    assert data["frequency_cycles_per_mm"] == pytest.approx(0.5 / 0.007, abs=0.05)
    assert (data["dark_dn"], data["bright_dn"]) == pytest.approx((50, 1050), abs=1)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        *yaml.safe_load(Path(__file__).with_name("mtf_options.yaml").read_text("utf-8")),
        ({"--roi": "9" * 5000 + ",20,64,64"}, "four whole numbers"),
        ({"--csv": "a" * 300 + ".csv"}, "File name too long"),
    ],
)
def test_bad_input(edge_tiff, tmp_path, changed, message):
    options = {"--roi": ROI, "--pitch": "7 um"} | changed
    if "--plot" in options:
        options["--plot"] = str(tmp_path / options["--plot"])
    result = run(edge_tiff, *[word for pair in options.items() for word in pair if pair[1] is not None])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"edge.tiff"}


def test_unreadable_images(tmp_path):
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "text.tiff").write_text("not a picture")
    cases = {"none.tiff": "there is no image", ".": "is a folder, not an image"}
    for name, said in (cases | dict.fromkeys(("text.png", "text.tiff"), "cannot be read as an image")).items():
        refused(said, tmp_path / name, *EDGE)


def test_the_image_is_never_overwritten(tmp_path):
    path = tmp_path / "edge.png"
    cv2.imwrite(str(path), edge_frame())
    before = path.read_bytes()
    result = run(path, "--roi", ROI, "--pitch", "7 um", "--plot", path)
    assert result.exit_code == 2
    assert path.read_bytes() == before
