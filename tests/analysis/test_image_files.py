"""Image files by other writers (Pillow, OpenCV, GDAL, astropy, its test files) are read to the same pixels."""

import gzip
import math
import os
import re
import shutil
import struct

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from analysis.images.image_file import ImageError, ImageFile, Region
from tests.analysis.refusals import refuses, spoilt

FRAMES = np.random.default_rng(1).integers(0, 65536, (3, 20, 31)).astype(np.uint16)


def read(path):
    return ImageFile.open(path).frames()


def frames_or_sentence(path):
    """Frames, or the one sentence that names the file; anything else fails."""
    try:
        return read(path)
    except ImageError as error:
        told = str(error)
    assert "\n" not in told
    assert path.name in told
    return told


@pytest.mark.second
@pytest.mark.parametrize("compression", [None, "lzw", "zlib", "deflate", "lzma", "zstd", "packbits"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_tiff_of_every_kind_is_the_same_pixels(tmp_path, compression, order, big):
    path = tmp_path / "a.tif"
    for dtype in ("u1", "u2", "u4", "i2", "f4", "f8"):
        frames = (FRAMES // 3).astype(dtype)
        tifffile.imwrite(path, frames, byteorder=order, bigtiff=big, compression=compression, photometric="minisblack")
        found = read(path)
        assert found.dtype == np.dtype(dtype)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, frames)


def test_lzw_and_deflate_by_pillow_opencv_and_gdal(tmp_path):
    frame = FRAMES[0]
    for name in ("tiff_lzw", "tiff_adobe_deflate", "tiff_deflate", "packbits"):
        Image.fromarray(frame).save(tmp_path / "a.tif", compression=name)
        np.testing.assert_array_equal(read(tmp_path / "a.tif")[0], frame)
    pages = [Image.fromarray(one) for one in FRAMES]
    pages[0].save(tmp_path / "p.tif", compression="tiff_lzw", save_all=True, append_images=pages[1:])
    np.testing.assert_array_equal(read(tmp_path / "p.tif"), FRAMES)
    for number in (1, 5, 8, 32946):
        cv2.imwrite(str(tmp_path / "b.tif"), frame, [cv2.IMWRITE_TIFF_COMPRESSION, number])
        np.testing.assert_array_equal(read(tmp_path / "b.tif")[0], frame)
    rasterio = pytest.importorskip("rasterio")
    profile = {"driver": "GTiff", "height": 20, "width": 31, "count": 1, "dtype": "uint16"}
    for more in ({"compress": "lzw", "predictor": 2}, {"compress": "deflate", "tiled": True, "blockxsize": 16,
                  "blockysize": 16}, {"BIGTIFF": "YES", "ENDIANNESS": "BIG"}):  # fmt: skip
        with rasterio.open(tmp_path / "c.tif", "w", **profile, **more) as file:
            file.write(frame, 1)
        np.testing.assert_array_equal(read(tmp_path / "c.tif")[0], frame)
    with rasterio.open(tmp_path / "d.tif", "w", **profile | {"dtype": "float32"}, compress="lzw", predictor=3) as file:
        file.write(frame.astype(np.float32), 1)
    np.testing.assert_array_equal(read(tmp_path / "d.tif")[0], frame)


def test_packed_bits_have_their_own_full_scale(tmp_path):
    """12 bits of a camera saturate at 4095 and not at 65535."""
    rasterio = pytest.importorskip("rasterio")
    frame = FRAMES[0] >> 4
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", height=20, width=31, count=1, dtype="uint16",
                       NBITS=12) as file:  # fmt: skip
        file.write(frame, 1)
    image = ImageFile.open(tmp_path / "a.tif")
    assert image.header.full_scale == 4095
    np.testing.assert_array_equal(image.frames()[0], frame)


def test_what_is_not_grey_is_told(tmp_path):
    """White that is zero is turned around, indices of a palette are refused, a turned image says that it is."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, FRAMES[0], photometric="miniswhite")
    np.testing.assert_array_equal(read(path)[0], 65535 - FRAMES[0])
    mean = ImageFile.open(path).read({"a": Region(0, 0, 20, 31)})["a"]
    np.testing.assert_array_equal(mean, 65535.0 - FRAMES[:1])
    tifffile.imwrite(path, FRAMES[0].astype(np.float32), photometric="miniswhite")
    refuses(ImageError, "largest value as black", read, path)
    Image.fromarray((FRAMES[0] >> 8).astype(np.uint8)).convert("P").save(path)
    refuses(ImageError, "palette", read, path)
    Image.fromarray(np.dstack([(FRAMES[0] >> 8).astype(np.uint8)] * 4), "CMYK").save(path)
    refuses(ImageError, r"inks \(CMYK\)", read, path)
    tifffile.imwrite(path, FRAMES[0], extratags=[(274, "H", 1, 3, True)])
    assert ImageFile.open(path).header.orientation == "orientation 3"
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([FRAMES[0]] * 3))
    refuses(ImageError, "3 colours", read, tmp_path / "a.png")
    for planes in ("contig", "separate"):
        stored = FRAMES if planes == "separate" else np.moveaxis(FRAMES, 0, -1)
        tifffile.imwrite(path, stored, photometric="rgb", planarconfig=planes)
        refuses(ImageError, "3 colours", read, path)
        grey = ImageFile.open(path).read({"a": Region(0, 1, 20, 30)})["a"]
        np.testing.assert_allclose(grey[0], np.tensordot([0.2126, 0.7152, 0.0722], FRAMES[:, :, 1:], 1), rtol=1e-12)


@pytest.mark.second
def test_fits_primary_extension_cube_and_scaling(tmp_path):
    path = tmp_path / "a.fits"
    for frames in (FRAMES, FRAMES[0], FRAMES.astype(np.int16), FRAMES.astype(np.float32), FRAMES.astype(np.int32),
                   FRAMES[None, None], (FRAMES >> 8).astype(np.uint8), FRAMES.astype(np.uint32)):  # fmt: skip
        for units in ([fits.PrimaryHDU(frames)], [fits.PrimaryHDU(), fits.ImageHDU(frames)]):
            fits.HDUList(units).writeto(path, overwrite=True)
            found = read(path)
            assert found.dtype == frames.dtype
            np.testing.assert_array_equal(found, frames.reshape(-1, 20, 31))
    fits.HDUList([fits.PrimaryHDU(), *(fits.ImageHDU(f) for f in FRAMES)]).writeto(path, overwrite=True)
    np.testing.assert_array_equal(read(path), FRAMES)
    assert ImageFile.open(path).header.full_scale == 65535
    unit = fits.PrimaryHDU(FRAMES.astype(np.float64) / 4 + 100)
    unit.scale("int16", bzero=100 + 8191.75, bscale=0.25)
    unit.writeto(path, overwrite=True)
    # the first pixel is at BZERO + BSCALE * stored, bytes as astropy wrote them, read here by hand
    raw = path.read_bytes()
    first = struct.unpack(">h", raw[2880:2882])[0]
    assert read(path)[0, 0, 0] == 100 + 8191.75 + 0.25 * first == FRAMES[0, 0, 0] / 4 + 100
    np.testing.assert_array_equal(read(path), FRAMES / 4 + 100)
    assert ImageFile.open(path).header.full_scale == math.inf
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(FRAMES, compression_type="RICE_1")]).writeto(
        path, overwrite=True
    )
    np.testing.assert_array_equal(read(path), FRAMES)


def test_fits_extensions_that_go_with_an_image_are_no_frames(tmp_path):
    path = tmp_path / "a.fits"
    other = np.zeros((9, 9), np.uint8)
    units = [fits.PrimaryHDU(), fits.ImageHDU(FRAMES, name="SCI"), fits.ImageHDU(other, name="MINE")]
    fits.HDUList(units).writeto(path)
    np.testing.assert_array_equal(read(path), FRAMES)
    fits.HDUList([fits.PrimaryHDU(FRAMES), fits.ImageHDU(other, name="DQ")]).writeto(path, overwrite=True)
    np.testing.assert_array_equal(read(path), FRAMES)
    fits.HDUList([fits.PrimaryHDU(FRAMES), fits.ImageHDU(other, name="MINE")]).writeto(path, overwrite=True)
    refuses(ImageError, r"20 x 31 uint16 \(first: 0\), 9 x 9 uint8 \(first: 3\)", read, path)
    one = ImageFile.open(path, page=1)
    np.testing.assert_array_equal(one.frames(), FRAMES[1:2])


def test_undefined_pixels_of_integers_are_not_numbers(tmp_path):
    header = fits.Header({"BLANK": -32768})
    data = FRAMES[0].astype(np.int16)
    data[3, 4] = -32768
    fits.PrimaryHDU(data, header).writeto(tmp_path / "a.fits")
    found = read(tmp_path / "a.fits")[0]
    assert math.isnan(found[3, 4])
    assert np.isnan(found).sum() == np.sum(data == -32768)


def test_only_what_is_asked_for_is_decoded(tmp_path):
    part = Region(2, 3, 5, 7)
    tifffile.imwrite(tmp_path / "a.tif", FRAMES, photometric="minisblack")
    fits.PrimaryHDU(FRAMES).writeto(tmp_path / "a.fits")
    for name in ("a.tif", "a.fits"):
        np.testing.assert_array_equal(ImageFile.open(tmp_path / name).frames(part), FRAMES[:, 2:7, 3:10])
        with pytest.raises(ImageError, match="is not inside the image of 20 rows and 31 columns"):
            ImageFile.open(tmp_path / name).frames(Region(0, 0, 21, 31))
    tifffile.imwrite(tmp_path / "b.tif", shape=(40, 4000, 4000), dtype=np.uint16, photometric="minisblack")
    with pytest.raises(ImageError, match=r"40 frames of 4000 x 4000 pixels, 1.3 GB, more than 0.5 GB: crop"):
        ImageFile.open(tmp_path / "b.tif").frames()
    assert ImageFile.open(tmp_path / "b.tif").frames(Region(0, 0, 8, 8)).shape == (40, 8, 8)


@pytest.mark.second
def test_spoilt_files_are_refused_in_one_sentence(tmp_path):
    """Random bytes changed, and files cut off: pixels or an ImageError, nothing else."""
    tifffile.imwrite(tmp_path / "a.tif", FRAMES, photometric="minisblack")
    tifffile.imwrite(tmp_path / "lzw.tif", FRAMES, photometric="minisblack", compression="lzw")
    tifffile.imwrite(tmp_path / "zip.tif", FRAMES, photometric="minisblack", compression="zlib", bigtiff=True)
    fits.PrimaryHDU(FRAMES).writeto(tmp_path / "a.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(FRAMES)]).writeto(tmp_path / "c.fits")
    cv2.imwrite(str(tmp_path / "a.png"), FRAMES[0])
    refused = 0
    for path in sorted(tmp_path.iterdir()):
        whole, other = path.read_bytes(), tmp_path / f"spoilt{path.suffix}"
        for seed in range(60):
            other.write_bytes(spoilt(whole, seed, 6000))
            told = frames_or_sentence(other)
            refused += isinstance(told, str)
            # of the file, and not of the reader's code
            assert not isinstance(told, str) or not re.search(r"unpack|shape|index|NoneType|dtype|object", told)
        other.unlink()
    assert refused > 36


def test_a_cut_off_or_packed_fits_is_named(tmp_path):
    fits.PrimaryHDU(FRAMES).writeto(tmp_path / "a.fits")
    data = (tmp_path / "a.fits").read_bytes()
    (tmp_path / "b.fits").write_bytes(data[: len(data) // 2])
    refuses(ImageError, "cut off", read, tmp_path / "b.fits")
    with gzip.open(tmp_path / "c.fits.gz", "wb") as file:
        file.write(data)
    refuses(ImageError, r"unpack it first, gunzip c\.fits\.gz", read, tmp_path / "c.fits.gz")
    shutil.copy(tmp_path / "a.fits", tmp_path / "d.tif")
    # by content, not by name
    np.testing.assert_array_equal(read(tmp_path / "d.tif"), FRAMES)


def test_a_damaged_picture_is_refused_without_a_word_of_its_library(tmp_path, capfd):
    """libjpeg goes on with what it has and tells the terminal; libpng tells it before it fails."""
    rows, columns = np.mgrid[0:64, 0:64]
    edge = np.where(columns + 0.1 * rows > 35, 200, 40).astype(np.uint8)
    for name in ("a.jpg", "a.png"):
        cv2.imwrite(str(tmp_path / name), edge)
        whole = (tmp_path / name).read_bytes()
        assert read(tmp_path / name).shape[-2:] == (64, 64)
        spoilt = bytearray(whole)
        spoilt[len(whole) // 2 : len(whole) // 2 + 40] = bytes(40)
        (tmp_path / name).write_bytes(spoilt)
        refuses(ImageError, "damaged", read, tmp_path / name)
    said = capfd.readouterr()
    assert said.err == ""


def test_a_fits_file_that_cannot_be_read_is_closed(tmp_path):
    fits.PrimaryHDU(FRAMES).writeto(tmp_path / "a.fits")
    spoilt = (
        (tmp_path / "a.fits").read_bytes().replace(b"BITPIX  =                   16", b"BITPIX  =                    x")
    )
    (tmp_path / "a.fits").write_bytes(spoilt)
    with pytest.raises(ImageError):
        read(tmp_path / "a.fits")
    opened = [
        os.readlink(f"/proc/self/fd/{k}") for k in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{k}")
    ]
    assert not [name for name in opened if name.endswith("a.fits")]
