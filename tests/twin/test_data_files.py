"""What a TIFF file of frames says of itself to any reader."""

import csv
import io
import json

import cv2
import numpy as np
import pytest
import tifffile

from twin.framework.data_files import WRITER, FrameFacts, csv_table, frame_files, tiff

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
