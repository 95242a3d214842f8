"""Golden runs: every command computes what it computed before; and what would not be so is found."""

import ast
import json
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from typer.testing import CliRunner

from tests.golden.__main__ import app
from tests.golden.compare import BITWISE, CLOSE, DIFFERENT, compare, compare_elsewhere
from tests.golden.golden import FOLDER, NotComparable, check, golden_file
from tests.golden.jobs import ALL, BY_NAME, Done
from tests.golden.snapshot import IN_FULL, Reader

MANY = np.linspace(0.1, 1.0, 3 * IN_FULL)
IMAGE = np.arange(64, dtype=np.uint16).reshape(8, 8)
REPORT = """<html><body><h1>A test</h1><section id="result"><h2>Result</h2><p>The error is {error} m.</p>
<table><tr><th>Δα</th><td>{alpha}</td></tr></table><figure><svg><text>{drawn}</text></svg></figure></section>
{more}<section id="again"><h2>Reproduce</h2><table><tr><th>Seed, backend</th><td>1, llvm, float64; {took} s</td></tr>
<tr><th>Versions</th><td>numpy {version}</td></tr></table></section></body></html>"""
SECTION = '<section id="crosstalk"><h2>Crosstalk</h2></section>'


def write(out: Path, **changes) -> None:
    """A run folder with every kind of file; the changes are values in them."""
    value = {
        "alpha": 1.25,
        "text": "gf7",
        "many": MANY,
        "image": IMAGE,
        "irradiance": MANY,
        "units": "W",
        "error": 3.5,
        "drawn": "10",
        "more": SECTION,
        "took": 8.9,
        "version": "2.0",
        "wall": 3.0,
        "sum": "ab",
        "line": "1.5",
        "node": "M1",
        "point": 0.5,
        "row": 4.0,
        "shift": "3 um",
    } | changes
    out.mkdir()
    truth = {"name": value["text"], "d_alpha_arcsec": value["alpha"], "many": value["many"].tolist()}
    truth["rows"] = value["many"].reshape(-1, 3).tolist()
    (out / "truth.json").write_text(json.dumps({"d_alpha_arcsec": value["alpha"], "name": value["text"]}))
    (out / "crosstalk.json").write_text(json.dumps(truth))
    manifest = {"seed": 1, "wall_time_s": value["wall"], "versions": {"numpy": value["version"]}}
    (out / "manifest.json").write_text(json.dumps({**manifest, "sha256": {"truth.json": value["sum"]}}))
    (out / "config.yaml").write_text(f"job:\n  shift: {value['shift']}\n")
    (out / "table.csv").write_text(f"name,value\nroll,{value['row']!r}\n")
    data = xr.Dataset({"irradiance": ("pixel", value["irradiance"], {"units": value["units"]})})
    data.to_netcdf(out / "irradiance.nc", engine="h5netcdf")
    tifffile.imwrite(out / "frame.tiff", value["image"])
    page = {key: value[key] for key in ("error", "alpha", "drawn", "more", "took", "version")}
    (out / "report.html").write_text(REPORT.format(**page))
    (out / "figure.svg").write_text(f'<svg><path id="p{value["wall"]}" d="M 0 {value["line"]} L 2 3"/></svg>')
    (out / "scene.glb").write_bytes(glb(value["node"], value["point"]))


def glb(node: str, point: float) -> bytes:
    """A scene with one mesh of one point."""
    told = {
        "nodes": [{"name": node, "mesh": 0}],
        "meshes": [{}],
        "bufferViews": [{"byteOffset": 0, "byteLength": 12}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3"}],
    }
    text = json.dumps(told).encode()
    text += b" " * (-len(text) % 4)
    binary = struct.pack("<3f", point, 0.0, 1.0)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def snapshot(place: Path, code: int = 0, stdout: str = "", break_it: Callable[[Path], object] | None = None, **changes):
    """Of a run folder of its own, and of what was printed."""
    place.mkdir()
    write(place / "out", **changes)
    if break_it is not None:
        break_it(place / "out")
    done = Done(code, stdout or f"run folder: {place / 'out'}\n", "", place / "out", place)
    return json.loads(json.dumps(Reader(done).snapshot()))


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    """A run without changes."""
    return snapshot(tmp_path_factory.mktemp("golden") / "before")


@pytest.fixture
def both(before, tmp_path):
    """Function: changes -> comparison of a run without and one with them."""

    def compared(**changes):
        return compare(before, snapshot(tmp_path / "now", **changes))

    return compared


def with_one(values: np.ndarray, factor: float) -> np.ndarray:
    """One value in the middle by a factor larger."""
    out = values.astype(float)
    out[out.size // 3] *= factor
    return out


CHANGES = {
    "a number": ({"alpha": math.nextafter(1.25, 2) + 1e-9}, "truth.json / d_alpha_arcsec", "1.25"),
    "its sign": ({"alpha": -1.25}, "truth.json / d_alpha_arcsec", "-1.25"),
    "no number": ({"alpha": None}, "truth.json / d_alpha_arcsec", "None"),
    "a text": ({"text": "gf8"}, "truth.json / name", "'gf7' -> 'gf8'"),
    "one of many numbers": ({"many": with_one(MANY, 1.1)}, "crosstalk.json / many", "sum"),
    "the rows it is in": ({"many": with_one(MANY, 1.1)}, "crosstalk.json / rows / 665:798", "sum"),
    "a variable of netCDF": ({"irradiance": with_one(MANY, 1.1)}, "irradiance.nc / / / variables / irradiance", "sum"),
    "its type": ({"irradiance": MANY.astype(np.float32)}, "irradiance.nc / / / variables / irradiance", "bytes"),
    "its unit": ({"units": "mW"}, "irradiance / attrs / units", "'W' -> 'mW'"),
    "a pixel": ({"image": IMAGE + (IMAGE == 7)}, "frame.tiff / pixels", "bytes"),
    "a row of a table": ({"row": 4.5}, "table.csv / rows[0][1]", "4.0 -> 4.5"),
    "a cell of the report": ({"alpha": 2.25}, "report.html / tables[0][0][1]", "'1.25' -> '2.25'"),
    "a number in its prose": ({"error": 4.5}, "report.html / prose / Result", "->"),
    "a missing section": ({"more": ""}, "report.html / ids", "'crosstalk' -> 'again'"),
    "another section": ({"more": 2 * SECTION}, "report.html / headings", "absent"),
    "the input": ({"shift": "4 um"}, "config.yaml / job / shift", "'3 um' -> '4 um'"),
    "a line of a drawing": ({"line": "1.6"}, "figure.svg / ink", "sum"),
    "a body of the scene": ({"node": "M2"}, "scene.glb / nodes[0]", "'M1' -> 'M2'"),
    "its geometry": ({"point": 0.75}, "scene.glb / geometry / f4", "sum"),
    "the exit code": ({"code": 1}, "exit", "0 -> 1"),
    "what was printed": ({"stdout": "d_alpha 1.26\n"}, "stdout[0]", "d_alpha 1.26"),
    "a missing file": ({"break_it": lambda out: (out / "scene.glb").unlink()}, "scene.glb", "absent"),
    "another file": ({"break_it": lambda out: (out / "new.json").write_text("{}")}, "new.json", "absent"),
    "a missing figure": (
        {
            "break_it": lambda out: (out / "report.html").write_text(
                (out / "report.html").read_text().replace("<svg>", "<div>").replace("</svg>", "</div>")
            )
        },
        "report.html / figures / svg",
        "1 -> 0",
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_found(both, name) -> None:
    """Its place, and both values."""
    changes, place, told = CHANGES[name]
    found = both(**changes)
    assert found.status == DIFFERENT
    lines = [str(one) for one in found.far]
    assert any(place in line and told in line for line in lines), lines


def test_times_versions_checksums_and_folders_are_not(both) -> None:
    found = both(wall=99.0, took=12.3, version="3.0", sum="cd")
    assert found.differences == []
    assert found.status == BITWISE


def test_last_digits_are_told_from_changes(both) -> None:
    """1e-13 of a number, and of one of many: within the tolerance, but not the same bytes."""
    found = both(alpha=1.25 * (1 + 1e-13), irradiance=MANY * (1 + 1e-13), many=with_one(MANY, 1 + 1e-13))
    assert {one.place for one in found.differences if one.close} >= {
        "truth.json / d_alpha_arcsec",
        "crosstalk.json / many",
        "irradiance.nc / / / variables / irradiance / values",
    }
    numbers = {key: compare(old, new).status for key, old, new in PAIRS}
    assert numbers == {key: key.split(":")[0] for key, _, _ in PAIRS}


def test_what_is_left_of_a_balance_is_measured_against_all_light() -> None:
    """In the file of stray light and where the run states it as a check; 2e-12 of the light is a change in both."""
    for key, more in (("relative_error", {}), ("value", {"unit": "of the light"})):
        old, close, far = ({key: 4e-3 + error, **more} for error in (0.0, 2e-14, 2e-12))
        assert (compare(old, close).status, compare(old, far).status) == (CLOSE, DIFFERENT)
    old, new = ({"value": 4e-3 + error, "unit": "sigma"} for error in (0.0, 2e-14))
    assert compare(old, new).status == DIFFERENT


PAIRS = (
    (f"{BITWISE}: nan", math.nan, math.nan),
    (f"{CLOSE}: last digit", 1.0, math.nextafter(1.0, 2.0)),
    (f"{CLOSE}: sign of zero", 0.0, -0.0),
    (f"{CLOSE}: whole and real", 1.0, 1.0 + 9e-13),
    (f"{DIFFERENT}: 2e-12", 1.0, 1.0 + 2e-12),
    (f"{DIFFERENT}: nothing near zero", 0.0, 1e-300),
    (f"{DIFFERENT}: nan", math.nan, 1.0),
    (f"{DIFFERENT}: infinite", math.inf, -math.inf),
    (f"{DIFFERENT}: true is not one", True, 1),
    (f"{DIFFERENT}: text", "1.0", 1.0),
)


def test_on_another_processor(before, tmp_path) -> None:
    """Exit code and names of files count, and the numbers that are promised, each to its tolerance."""
    job = {"truth.json": 1e-9, "frame": 0.0, "irradiance.nc": 1e-12}

    def compared(name: str, **changes) -> str:
        return compare_elsewhere(before, snapshot(tmp_path / name, **changes), job).status

    assert compared("digits", alpha=1.25 * (1 + 1e-11), irradiance=MANY * (1 + 1e-15)) == BITWISE
    assert compared("not promised", many=2 * MANY, shift="4 um", error=9.0) == BITWISE
    assert compared("truth", alpha=1.25 * (1 + 1e-8)) == DIFFERENT
    assert compared("frames", image=IMAGE + 1) == DIFFERENT
    assert compared("images", irradiance=with_one(MANY, 1 + 1e-6)) == DIFFERENT
    assert compared("exit", code=1) == DIFFERENT
    assert compared("files", break_it=lambda out: (out / "scene.glb").unlink()) == DIFFERENT


def test_a_golden_file_of_other_packages_is_not_compared(monkeypatch, tmp_path) -> None:
    """And the job is not even run."""
    kept = json.loads(golden_file("schema").read_text("utf-8"))
    kept["packages"]["numpy"] = "1.0"
    (tmp_path / "schema.json").write_text(json.dumps(kept))
    monkeypatch.setattr("tests.golden.golden.FOLDER", tmp_path)
    with pytest.raises(NotComparable, match=r"numpy .* instead of 1\.0"):
        check(BY_NAME["schema"])
    with pytest.raises(NotComparable, match="--write --only design"):
        check(BY_NAME["design"])


@pytest.mark.second
def test_a_changed_golden_file_fails_the_command(monkeypatch, tmp_path) -> None:
    """A quick job from its process to the exit code."""
    kept = json.loads(golden_file("mtf_bars").read_text("utf-8"))
    (tmp_path / "mtf_bars.json").write_text(json.dumps(kept))
    monkeypatch.setattr("tests.golden.golden.FOLDER", tmp_path)
    arguments = ["--check", "--only", "mtf_bars"]
    told = CliRunner().invoke(app, arguments)
    kept["run"]["stdout"][0] = kept["run"]["stdout"][0].replace("cycles", "lines")
    (tmp_path / "mtf_bars.json").write_text(json.dumps(kept))
    broken = CliRunner().invoke(app, arguments)
    if "not compared" in told.output:
        pytest.skip(told.output)
    assert told.exit_code == 0, told.output
    if "another processor" in told.output:
        pytest.skip("nothing is promised of this job here")
    assert broken.exit_code == 1
    assert "stdout[0]: 'bars: " in broken.output
    assert CliRunner().invoke(app, ["--check", "--only", "mtf"]).exit_code == 2
    assert CliRunner().invoke(app, []).exit_code == 2


def test_every_job_has_its_file() -> None:
    assert {path.stem for path in FOLDER.glob("*.json")} == set(BY_NAME)
    assert len(BY_NAME) == len(ALL)


def test_nothing_of_the_program_is_imported() -> None:
    """So that it says the same before and after modules move; the commands' names are all it knows."""
    for path in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [one.name for one in node.names] if isinstance(node, ast.Import) else []
            assert not {name.split(".")[0] for name in names} & {"optics", "scenes", "analysis", "twin"}, path


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_NAME)
def test_a_command_computes_what_it_did(name) -> None:
    """To 1e-12; on another processor what is promised there."""
    try:
        outcome = check(BY_NAME[name])
    except NotComparable as told:
        pytest.skip(str(told))
    assert outcome.comparison.far == [], "\n".join(outcome.lines()[:60])
