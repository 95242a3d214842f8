"""`python -m twin.lab` as a user runs it: results, the run folder, exit codes, messages."""

import hashlib
import json
import re
from functools import partial
from pathlib import Path

import pytest
import tifffile

import twin.lab as command
from scenes.specs.load import LAB, LIBRARY, SCENES
from tests.tiers import quick
from tests.twin.commands import files, invoke, refused

run = partial(invoke, command.app)
FOCUS = SCENES / LAB / "focus.yaml"
TURNTABLE = SCENES / LAB / "turntable.yaml"
BANDS, FIELDS = ("B1", "B4"), ("-0.9", "0.9")
CHANGES = {
    "camera: gf7\n": "camera: own_camera.yaml\n",
    "fields: [-0.9, -0.45, 0, 0.45, 0.9]": "fields: [-0.9, 0.9]",
    "points: 9": "points: 7",
    "reach: 1.4 mm": "reach: 0.5 mm",
    "step: 0.08 mm": "step: 0.15 mm",
    "shift: [0.2 mm, 0.2 mm, 0.3 mm]": "shift: [0.1 mm, 0.1 mm, 0.1 mm]",
}


def write_focus(folder: Path, **changes: str) -> Path:
    """A focus test of two narrow bands and two fields, with more changes of its text."""
    camera = (LIBRARY / "cameras" / "gf7.yaml").read_text("utf-8")
    for band in ("P", "B2", "B3"):
        camera, count = re.subn(rf"  {band}:\n.*\n.*\n", "", camera, count=1)
        assert count == 1
    (folder / "own_camera.yaml").write_text(camera.replace("name: gf7", "name: own_camera"), "utf-8")
    text = FOCUS.read_text("utf-8")
    for old, new in {**CHANGES, **changes}.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "small.yaml"
    path.write_text(text, "utf-8")
    return path


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A run: its folder and what it printed."""
    folder = tmp_path_factory.mktemp("lab")
    path = write_focus(folder)
    result = run("focus", path, "--out", folder / "run", "--seed", 5, "--json")
    assert result.exit_code == 0, result.stderr
    return folder / "run", result


def test_result(done) -> None:
    folder, result = done
    data = json.loads(result.stdout)
    assert result.stderr == ""
    assert data == json.loads((folder / "focus.json").read_text("utf-8"))
    assert data["seed"] == 5
    (end,) = data["rounds"]
    assert {"confocal_um_max", "line_level_arcmin", "mtf_nyquist", "shims_um"} <= set(end)
    assert set(end["mtf_nyquist"]) == set(BANDS)
    assert set(end["shims_um"]) == {f"hole_{k}" for k in (1, 2, 3, 4)}
    assert data["truth"]["rounds"][0]["confocal_um_max"] < 40.0


def test_run_folder(done) -> None:
    folder, _ = done
    images = {f"images/{b}_field{k}_{e}" for b in BANDS for k in (1, 2) for e in ("along", "track")}
    artefacts = {"alignment.csv", "defocus.svg", "edges.svg", "mtf-budget.csv", "mtf-curves.svg", "mtf.csv"}
    artefacts |= {"places.csv", "curves.csv", "shims-1.csv", "through-focus.svg"}
    expected = {"manifest.json", "config.yaml", "focus.json", "report.html"}
    expected |= {f"artefacts/{name}" for name in artefacts}
    expected |= {f"{name}.{kind}" for name in images for kind in ("tiff", "png")}
    assert files(folder) == expected
    manifest = json.loads((folder / "manifest.json").read_text("utf-8"))
    assert manifest["seed"] == 5
    assert set(manifest["sha256"]) == expected - {"manifest.json"}
    for name, digest in manifest["sha256"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    frames = tifffile.imread(folder / "images" / "B1_field1_along.tiff")
    assert frames.shape == (4, 64, 64)
    assert str(frames.dtype) == "uint16"


def test_report_is_self_contained_and_names_its_files(done) -> None:
    folder, _ = done
    text = (folder / "report.html").read_text("utf-8")
    for name in files(folder) - {"report.html", "manifest.json"}:
        if not name.endswith(".png"):
            assert f'href="{name}"' in text, name
    # nothing is fetched: every link is a file of the run, and pictures and styles are inside
    links = set(re.findall(r'(?:href|src)="([^"]*)"', text))
    assert {link for link in links if not link.startswith(("#", "data:"))} <= files(folder)
    assert not re.search(r"@import|url\(\s*['\"]?http|<script[^>]+src|<link[^>]+href", text)


@pytest.mark.second
def test_turntable(tmp_path: Path) -> None:
    """With half the angles and fewer folds than the example."""
    text = TURNTABLE.read_text("utf-8")
    for old, new in {"step: 0.5 deg ": "step: 1 deg ", "folds: 10 ": "folds: 2 "}.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = tmp_path / "short.yaml"
    path.write_text(text, "utf-8")
    result = run("turntable", path, "--out", tmp_path / "run", "--json")
    assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    assert {"repeat_rms_arcsec", "chauvenet_rms_arcsec", "fits", "chosen"} <= set(data)
    assert {"report.html", "turntable.json", "config.yaml", "manifest.json"} <= files(tmp_path / "run")


# what is wrong, where it is said, and what to do about it
BAD = {
    "no such camera": ({"camera: gf7\n": "camera: gf8\n"}, "camera", ["no such name", "did you mean 'gf7'"]),
    "no such mirror": ({"  M3: {figure": "  M4: {figure"}, "as_built.M4", ["M4", "M1"]),
    "unknown key": ({"frames: 4": "frame: 4"}, "frame", ["did you mean 'frames'"]),
    "small region": ({"region: 64": "region: 8"}, "edge.region", ["8", "32"]),
    "narrow collimator": (
        {"aperture: 0.8 m ": "aperture: 0.5 m "},
        "collimator.aperture",
        ["500 mm", "a wider collimator"],
    ),
    "too much light": ({"white: 60 percent": "white: 120 percent"}, "white", ["saturates", "98 percent or less"]),
    "holes on a line": (
        {"[60 mm, -150 mm, -30 mm]": "[-60 mm, 0 mm, -30 mm]", "    - [60 mm, 150 mm, -30 mm]\n": ""},
        "mount.holes",
        ["on one line", "span a plane"],
    ),
    "clearance": ({"clearance: 1 mm": "clearance: 1 um"}, "mount.clearance", ["slide hole_", "more clearance"]),
    "short scan": (
        {"reach: 1.4 mm": "reach: 0.04 mm", "step: 0.08 mm": "step: 0.015 mm"},
        "scan.reach",
        ["focus", "reach"],
    ),
}


@pytest.mark.parametrize("name", quick(3, BAD))
def test_bad_input(name: str, tmp_path: Path) -> None:
    changes, key, words = BAD[name]
    path = write_focus(tmp_path, **changes)
    line = refused(run, "focus", path, key, words)
    # the line it names is the one that holds the key
    assert key.split(".")[-1] in path.read_text("utf-8").splitlines()[line - 1]


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    result = run("focus", tmp_path / "none.yaml", "--out", tmp_path / "run")
    assert result.exit_code == 2
    assert "none.yaml: no such file" in result.stderr
    assert list(tmp_path.iterdir()) == []
