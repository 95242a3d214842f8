"""Test targets in the main job: files, mtf.json, the report, and errors that say what to change."""

import json
import re
from functools import partial

import numpy as np
import pytest
import tifffile
import yaml

import twin.render as command
from scenes.specs.load import LIBRARY
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED
from twin.targets.target_images import DIRECTIONS, POSITIONS

run = partial(invoke, command.app)
FRAMES, REGION = 4, 112
STATES = ("before", "after")
# false alarms of one in a million, two-sided, of some 12 comparisons
FAR = 5.3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of an instrument with one camera: M2 moves, and the camera turns by 2 arcsec about X."""
    place = tmp_path_factory.mktemp("targets")
    instrument = yaml.safe_load((LIBRARY / "instruments" / "gf7_pair.yaml").read_text())
    instrument["name"], instrument["cameras"] = "single", {"one": instrument["cameras"]["forward"]}
    del instrument["baffles"]
    (place / "single.yaml").write_text(yaml.safe_dump(instrument))
    (place / "job.yaml").write_text(
        "instrument: single.yaml\n"
        "perturb:\n"
        "  base/one: {rotate: [2 arcsec, 0 arcsec, 0 arcsec]}\n"
        "  base/one/M2: {shift: [0 um, 0 um, 30 um]}\n"
        f"render: {{images: [knife_edge], frames: 2, targets: {{frames: {FRAMES}}}}}\n"
    )
    done = run(place / "job.yaml", "--out", place / "run")
    assert done.exit_code == 0, done.output
    (place / "said.txt").write_text(done.stdout)
    return place


@pytest.fixture(scope="module")
def mtf(folder):
    return json.loads((folder / "run" / "mtf.json").read_text())


@pytest.mark.second
def test_files(folder, mtf):
    pages = tifffile.imread(folder / "run" / "images" / "one_left_knife_edge_track_after.tiff")
    assert pages.dtype == np.uint16
    assert pages.shape == (FRAMES, REGION, REGION)
    # dark above, white at 60% of the well below, less what the prisms take: 0.6 x 16000 DN on the black level of 100 DN
    lost = mtf["truth"]["cameras"]["one"]["places"]["left"]["light_lost"]["after"]
    assert 0.05 < lost < 0.06
    assert pages[:, :30].max() < 300
    assert pages[:, -30:].mean() == pytest.approx(9600.0 * (1.0 - lost) + 100.0, rel=0.002)


@pytest.mark.second
def test_measured_agrees_with_truth(mtf):
    assert mtf["frames"] == FRAMES
    camera, truth = mtf["cameras"]["one"], mtf["truth"]["cameras"]["one"]
    assert camera["band"] == "P"
    assert camera["nyquist_per_mm"] == pytest.approx(1.0 / 14e-3, rel=1e-12)
    assert list(camera["places"]) == ["left", "centre", "right"]
    assert camera["places"]["left"]["along_mm"] > 100.0  # left is +Y', near the end of a line of 229 mm
    for place in POSITIONS:
        for direction in DIRECTIONS:
            for when in STATES:
                found, true = (side["places"][place][direction][when] for side in (camera, truth))
                assert abs(found["mtf_nyquist"] - true["mtf_nyquist"]) < FAR * found["mtf_nyquist_sigma"] + 5e-4
                assert 0.0 <= found["mtf_nyquist_noise_bias"] < 1e-3
                # one sigma at full light; the report's curve is no line of guesses
                assert found["mtf_nyquist_sigma"] < 4e-3
                assert found["curve"]["frequency_per_mm"] == true["curve"]["frequency_per_mm"]
                assert found["curve"]["frequency_per_mm"][32] == pytest.approx(1.0 / 14e-3, rel=1e-12)
                assert found["curve"]["mtf"][32] == pytest.approx(found["mtf_nyquist"], rel=1e-9)
                # the light in a shadow, by numbers of nodes that are not the same
                assert true["curve"]["mtf"][0] == pytest.approx(1.0, abs=1e-7)
            drop = [truth["places"][place][direction][when]["mtf_nyquist"] for when in STATES]
            assert drop[1] < 0.95 * drop[0]  # 30 um of M2 defocus the camera


@pytest.mark.second
def test_what_cannot_be_measured_is_said(folder, tmp_path):
    """White beyond the well's linear range: no MTF, a warning that says why, and the rest of the run is kept."""
    text = (
        (folder / "job.yaml").read_text().replace("frames: 4}", "frames: 4, white: 100 percent}, obstruction: ignore")
    )
    (tmp_path / "single.yaml").write_text((folder / "single.yaml").read_text())
    (tmp_path / "job.yaml").write_text(text)
    done = run(tmp_path / "job.yaml", "--out", tmp_path / "run", "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["mtf"]
    centre = found["cameras"]["one"]["places"]["centre"]["along"]["after"]
    assert centre["mtf_nyquist"] is None
    assert centre["curve"] is None
    assert found["truth"]["cameras"]["one"]["places"]["centre"]["along"]["after"]["mtf_nyquist"] > 0.1
    warnings = json.loads((tmp_path / "run" / "manifest.json").read_text())["warnings"]
    assert any("knife edge (along) at the centre of one after" in w and "saturation" in w for w in warnings)
    assert "not measurable" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize(("text", "says"), REFUSED["target_jobs"])
def test_bad_input(tmp_path, text, says):
    short = re.sub(r"pixels: \d+", "pixels: 200", (LIBRARY / "cameras" / "gf7.yaml").read_text())
    (tmp_path / "short.yaml").write_text(short)
    instrument = "{camera: short.yaml}" if "region: 200" in text else "gf7_pair"
    (tmp_path / "job.yaml").write_text(f"instrument: {instrument}\n{text}\n")
    done = run(tmp_path / "job.yaml", "--out", tmp_path / "run")
    assert done.exit_code == 2
    assert says in done.output
    assert not (tmp_path / "run").exists()
