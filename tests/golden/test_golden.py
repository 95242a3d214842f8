"""Golden runs: every command computes what it computed before, on any machine; and what would not be so is found."""

import json
import math
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray as xr
from typer.testing import CliRunner

from tests.golden.__main__ import app
from tests.golden.compare import BITWISE, CLOSE, DIFFERENT, EXCEPTIONS, allowed, compare, limits, printed_close
from tests.golden.digest import condensed, flattened, is_number, skeleton
from tests.golden.golden import FOLDER, check, golden_file
from tests.golden.jobs import ALL, BY_NAME, Done, Printed, Runner
from tests.golden.snapshot import Reader
from tests.tiers import quick

MANY = np.linspace(0.1, 1.0, 6000)
IMAGE = np.arange(64, dtype=np.uint16).reshape(8, 8)
SECTION = '<section id="crosstalk"><h2>Crosstalk</h2></section>'
REPORT = """<h1>A test</h1><section id="result"><h2>Result</h2><p>The error is {error} m.</p>
<table><tr><th>Δα</th><td>{alpha}</td></tr></table><figure><svg><text>10</text></svg></figure></section>{more}
<section id="again"><h2>Reproduce</h2><table><tr><th>Seed</th><td>1, llvm, float64; {took} s</td></tr>
<tr><th>Versions</th><td>numpy {version}</td></tr></table></section>"""
TEXTS = {
    "truth.json": '{{"d_alpha_arcsec": {alpha}, "name": "{text}", "many": {many}, "rows": {rows}}}',
    "manifest.json": '{{"wall_time_s": {wall}, "versions": {{"a": "{version}"}}, "sha256": {{"truth.json": "{sum}"}}}}',
    "config.yaml": "job:\n  shift: {shift}\n",
    "table.csv": "name,value\nroll,{row}\n",
    "report.html": REPORT,
    "figure.svg": '<svg><path id="p{wall}" d="M 0 {line} L 2 3"/></svg>',
}
"""A run folder with a file of every kind."""
PLAIN = {"alpha": 1.25, "text": "gf7", "many": MANY, "image": IMAGE, "light": MANY, "units": "W", "error": 3.5}
PLAIN |= {"more": SECTION, "took": 8.9, "version": "2.0", "wall": 3.0, "sum": "ab", "line": "1.5", "row": 4.0}
PLAIN |= {"shift": "3 um"}


def write(out: Path, **changes) -> None:
    """Write the run folder; the changes are values in it."""
    value = PLAIN | changes
    out.mkdir()
    data = xr.Dataset({"irradiance": ("pixel", value["light"], {"units": value["units"]})})
    data.to_netcdf(out / "irradiance.nc", engine="h5netcdf")
    tifffile.imwrite(out / "frame.tiff", value["image"])
    many = value["many"]
    plain = {**value, "many": many.tolist(), "rows": many.reshape(-1, 3).tolist(), "alpha": json.dumps(value["alpha"])}
    for name, text in TEXTS.items():
        (out / name).write_text(text.format(**plain))


def snapshot(place: Path, code: int = 0, stdout: str = "", break_it: Callable[[Path], object] | None = None, **changes):
    """Of a run folder of its own, and of what was printed."""
    place.mkdir()
    write(place / "out", **changes)
    if break_it is not None:
        break_it(place / "out")
    printed = Printed(code, stdout or f"run folder: {place / 'out'}\n", "")
    return json.loads(json.dumps(Reader(Done((printed,), place / "out", place)).snapshot()))


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    """A run without changes."""
    return snapshot(tmp_path_factory.mktemp("golden") / "before")


@pytest.fixture
def both(before, tmp_path):
    """Function: changes -> comparison of a run without and one with them."""

    def compared(**changes):
        return compare("test", before, snapshot(tmp_path / "now", **changes))

    return compared


def with_one(values: np.ndarray, factor: float) -> np.ndarray:
    """One value in the middle by a factor larger."""
    out = values.astype(float)
    out[out.size // 3] *= factor
    return out


def without_figure(out: Path) -> None:
    text = (out / "report.html").read_text()
    (out / "report.html").write_text(text.replace("<svg>", "<div>").replace("</svg>", "</div>"))


CHANGES = {
    "a number": ({"alpha": 1.25 * (1 + 2e-7)}, "truth.json / d_alpha_arcsec", "1.25"),
    "a text": ({"text": "gf8"}, "truth.json / name", "'gf7' -> 'gf8'"),
    "one of many numbers": ({"many": with_one(MANY, 1.1)}, "truth.json / many / mean", "->"),
    "a variable of netCDF": ({"light": with_one(MANY, 1.1)}, "variables / irradiance / values / rms", "->"),
    "its unit": ({"units": "mW"}, "irradiance / attrs / units", "'W' -> 'mW'"),
    "pixels": ({"image": IMAGE + 2 * (IMAGE > 40)}, "frame.tiff / pixels / mean", "->"),
    "a row of a table": ({"row": 4.5}, "table.csv / columns / value[0]", "4.0 -> 4.5"),
    "a cell of the report": ({"alpha": 2.25}, "report.html / tables[0] / numbers", "'1.25' -> '2.25'"),
    "a number in its prose": ({"error": 4.5}, "report.html / prose / Result", "'3.5' -> '4.5'"),
    "a missing section": ({"more": ""}, "report.html / ids", "'crosstalk' -> 'again'"),
    "the input": ({"shift": "4 um"}, "config.yaml / job / shift", "->"),
    "a line of a drawing": ({"line": "1.6"}, "figure.svg / ink / at[1]", "1.5 -> 1.6"),
    "the exit code": ({"code": 1}, "exit[0]", "0 -> 1"),
    "what was printed": ({"stdout": "d_alpha 1.26\n"}, "stdout[0][0]", "d_alpha 1.26"),
    "a missing file": ({"break_it": lambda out: (out / "table.csv").unlink()}, "table.csv", "absent"),
    "a missing figure": ({"break_it": without_figure}, "report.html / figures / svg", "1 -> 0"),
}


@pytest.mark.second
@pytest.mark.parametrize("name", quick(8, CHANGES))
def test_a_change_is_found(both, name) -> None:
    """Its place, and both values."""
    changes, place, told = CHANGES[name]
    found = both(**changes)
    assert found.status == DIFFERENT
    lines = [str(one) for one in found.far]
    assert any(place in line and told in line for line in lines), lines


def test_times_versions_checksums_and_folders_are_no_change(both) -> None:
    found = both(wall=99.0, took=12.3, version="3.0", sum="cd")
    assert (found.far, found.status) == ([], BITWISE)


def test_last_digits_of_another_machine_are_within_the_limits(both) -> None:
    """Also one count more in a pixel, whose noise a last digit can move over a threshold."""
    found = both(alpha=1.25 * (1 + 1e-8), light=MANY * (1 + 1e-9), many=MANY * (1 + 1e-9), image=IMAGE + (IMAGE == 7))
    assert found.status == CLOSE, found.far


RECORD = """{"d_f_um": 2.0, "d_f_um_sigma": 0.5, "d_f_um_true": 2.0, "d_f_um_sigma_true": 0.25, "row": [1.0, 2.0],
"row_sigma": [0.1, 0.2], "value": 3.0, "sigma": 0.1, "plain": 4.0, "zero": 1e-17, "list": [1e-9, 5.0], "count": 3,
"cameras": {"a": {"x": 1.0, "x_sigma": 0.1}, "b": {"x": 7.0, "x_sigma": 0.2}}, "small": 1e-3, "small_sigma": 0.5}"""
LIMITS = """{"d_f_um": 5e-4, "d_f_um_sigma": 5e-8, "d_f_um_true": 2.5e-4, "row[0]": 1e-4, "row[1]": 2e-4, "value": 1e-4,
"row_sigma[0]": 2e-8, "plain": 4e-7, "list[0]": 5e-7, "cameras / #each / x[1]": 2e-4, "small": 1e-6,
"cameras / #each / x_sigma[0]": 1e-8}"""


def test_numbers_of_reports_are_numbers_with_either_minus_sign() -> None:
    assert skeleton("p = 9e−82, −2.5e−5 mm, 3e-43, 1.0") == ("p = #, # mm, #, #", ["9e−82", "−2.5e−5", "3e-43", "1.0"])
    assert printed_close("9e−82", "8.9e−82") == printed_close("9e-82", "8.9e-82")


def test_limits_are_a_thousandth_of_sigma_or_1e_7_of_the_number() -> None:
    """By the naming rules of docs/conventions.md; a sigma itself has no sigma; whole numbers have no limit."""
    found, wanted = limits(condensed(json.loads(RECORD))), json.loads(LIMITS)
    assert {place: found[place] for place in wanted} == pytest.approx(wanted, rel=1e-9)
    assert "count" not in found
    assert 1e-17 < found["zero"] < 1e-13
    long = condensed({"x": [float(k) for k in range(1, 30)], "x_sigma": [0.5 + k for k in range(29)]})
    assert limits(long)["x / at[0]"] == pytest.approx(5e-4)
    assert limits({"x": condensed(long["x"])})["x / max"] == pytest.approx(29e-7)


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("d 1.25 um", "d 1.26 um", True),
        ("d 1.25 um", "d 1.27 um", False),
        ("d -0.00 um", "d 0.01 um", True),
        ("1.2e-05", "1.2e-04", False),
        ("d 1.25 um", "d 1.25 mm", False),
        ("1.5", None, False),
    ],
)
def test_printed_numbers_have_a_unit_of_their_last_digit(old, new, same) -> None:
    assert printed_close(old, new) is same


# --- all golden files ------------------------------------------------------------------------------------


@cache
def kept(name: str) -> tuple[Any, dict[str, Any], dict[str, float]]:
    """A golden run: its tree, its leaves, and the limits of its numbers."""
    tree = json.loads(golden_file(name).read_text("utf-8"))["run"]
    return tree, flattened(tree), allowed(name, tree)


def numbers(name: str) -> Iterator[tuple[str, float, float]]:
    """(place, number, limit) of all real numbers of a golden run that are compared and no zeros."""
    _, values, limit = kept(name)
    for place, value in values.items():
        if place in limit and is_number(value) and value and not math.isinf(limit[place]):
            yield place, value, limit[place]


@pytest.mark.second
def test_a_wrong_number_is_found_wherever_it_stands() -> None:
    """Of each real number of each golden file ten times it and, if it is not small beside its standard deviation, its
    list or the counts of an image, 1 % more.
    """
    total = tenfold = percent = 0
    for name in BY_NAME:
        for _, value, limit in numbers(name):
            total += 1
            tenfold += abs(9.0 * value) <= limit
            percent += abs(0.01 * value) <= limit
    assert total > MOST_NUMBERS
    assert tenfold <= SMALL_TENFOLD * total, (tenfold, total)
    assert percent <= SMALL_PERCENT * total, (percent, total)


MOST_NUMBERS, SMALL_TENFOLD, SMALL_PERCENT = 50_000, 0.02, 0.07
"""Real numbers of all golden files at least, and shares of those that are so small beside what they stand with."""


@pytest.mark.second
def test_exceptions_are_of_something_and_have_a_reason() -> None:
    places = [f"{name} / {place}" for name in BY_NAME for place in kept(name)[1]]
    for one in EXCEPTIONS:
        assert len(one.reason.split()) >= 5
        share = sum(one.matches(place) for place in places) / len(places)
        assert 0.0 < share < 0.05, one


def test_golden_files_are_small_and_one_for_each_job() -> None:
    assert {path.stem for path in FOLDER.glob("*.json")} == set(BY_NAME)
    assert len(BY_NAME) == len(ALL)
    assert sum(path.stat().st_size for path in FOLDER.glob("*.json")) < 3e6


NO_RESULT = {"twin.doctor": "it tells what this machine has", "twin.framework.doctor_probe": "the doctor's own"}
"""Programs without a golden run, and why."""


def test_every_command_has_a_golden_run() -> None:
    """Every module that can be started, and of those with subcommands each of them."""
    from twin.framework.console import PROGRAMS, parser

    root = FOLDER.parents[1]
    started = {module for module, _ in PROGRAMS.values()}
    for package in ("optics", "scenes", "analysis", "twin"):
        for path in (root / package).rglob("*.py"):
            if path.name == "__main__.py" or '__name__ == "__main__"' in path.read_text("utf-8"):
                started.add(".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__main__"))
    run = [" ".join(words) for job in ALL for words in job.commands]
    for module in started - set(NO_RESULT):
        below = getattr(parser(module), "commands", {})
        for command in below or [""]:
            words = f"{module} {command}".strip().removesuffix(" camera")  # that is meant where none is said
            assert any(f"{words} " in f"{one} " for one in run), words


@pytest.fixture(scope="session")
def runner() -> Iterator[Runner]:
    # where tables wrap their titles depends on how long the paths in them are
    with tempfile.TemporaryDirectory(prefix="golden-", dir="/tmp") as folder, Runner(Path(folder)) as one:
        yield one


@pytest.mark.second
@pytest.mark.parametrize("name", BY_NAME)
def test_a_command_computes_what_it_did(name, runner) -> None:
    if name in ("live", "live_camera", "operate"):
        pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
    outcome = check(BY_NAME[name], runner)
    assert outcome.comparison.far == [], "\n".join(line[:400] for line in outcome.lines()[:40])


@pytest.mark.second
def test_a_changed_golden_file_fails_the_command(monkeypatch, tmp_path) -> None:
    """A quick job from its process to the exit code: whatever the packages, and one number 1 % off is told."""
    kept = json.loads(golden_file("mtf_edge").read_text("utf-8"))
    kept["packages"]["numpy"] = "1.0"
    text = json.dumps(kept)
    monkeypatch.setattr("tests.golden.golden.FOLDER", tmp_path)
    (tmp_path / "mtf_edge.json").write_text(text)
    arguments = ["--check", "--only", "mtf_edge"]
    same = CliRunner().invoke(app, arguments)
    assert same.exit_code == 0, same.output
    assert "instead of 1.0" in same.output
    column = kept["run"]["curve.csv"]["columns"]
    column[list(column)[-1]]["rms"] *= 1.01
    (tmp_path / "mtf_edge.json").write_text(json.dumps(kept))
    broken = CliRunner().invoke(app, arguments)
    assert broken.exit_code == 1
    assert "curve.csv / columns" in broken.output
    assert "0 of 1 jobs" in broken.output
    missing = CliRunner().invoke(app, ["--check", "--only", "mtf_bars"])
    assert missing.exit_code == 1
    assert "--write --only mtf_bars" in missing.output
    assert CliRunner().invoke(app, ["--check", "--only", "mtf"]).exit_code == 2
    assert CliRunner().invoke(app, []).exit_code == 2
